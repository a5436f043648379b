# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""How the turbofan is run: schedules over the power lever, steady states, the closed-loop controller."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import UncertainLTIError
from uncertain_lti.model.operating_point import OperatingPoint
from uncertain_lti.plants.turbofan import Engine, GasPath, GasPathSolver, Health, engine
from uncertain_lti.plants.turbofan_gas import T_STANDARD

IDLE, MAXIMUM = 12.0, 68.0
"""Power-lever angle, deg."""


def power(pla: float) -> float:
    """Lever position between idle, 0, and the maximum regime, 1."""
    if not IDLE <= pla <= MAXIMUM:
        raise UncertainLTIError(f"turbofan: PLA is {pla:g} deg; it must be from {IDLE:g} to {MAXIMUM:g}")
    return (pla - IDLE) / (MAXIMUM - IDLE)


def fan_speed(pla: float, plant: Engine) -> float:
    """Scheduled fan speed, rpm: 50 % at idle, flatter towards the maximum (chosen)."""
    share: float = 0.5 + 0.5 * power(pla) ** 0.75
    return share * plant.design.fan_speed


def nozzle_area(pla: float, plant: Engine) -> float:
    """Scheduled throat area, m^2: opened by 20 % at idle, to keep thrust low and the fan away from surge (chosen)."""
    return float(plant.nozzle_area * (1.0 + 0.20 * (1.0 - power(pla)) ** 1.2))


def vanes(low: float, high: float, plant: Engine) -> tuple[float, float]:
    """Scheduled angles, deg, of fan and compressor vanes at spool speeds in rpm.

    The compressor's inlet temperature, which its corrected speed needs, is taken from the fan speed, as its rise goes
    nearly with the square of that.
    """
    n = low / plant.design.fan_speed
    share = T_STANDARD / plant.compressor.T_design
    n_high = high / plant.design.compressor_speed / (share + (1.0 - share) * n * n) ** 0.5
    return plant.fan.schedule(n), plant.compressor.schedule(n_high)


@dataclass(frozen=True)
class Trim:
    """A steady state and its gas path.

    `pla`: power-lever angle, deg; `x` (5,): states in recorded units; `u` (4,): controls in recorded units; `path`: the
    gas path there.
    """

    pla: float
    x: Array
    u: Array
    path: GasPath


def trim(pla: float, plant: Engine | None = None, health: Health | None = None) -> Trim:
    """Steady state at a lever angle: fan speed, area and vanes by schedule, fuel and compressor speed by balance."""
    from scipy.optimize import root

    plant, health = plant or engine(), health or Health()
    d, low, area = plant.design, fan_speed(pla, plant), nozzle_area(pla, plant)
    solver = GasPathSolver(plant)

    def at(q: Array) -> tuple[list[float], list[float]]:
        high = float(q[0]) * d.compressor_speed
        fan_vane, compressor_vane = vanes(low, high, plant)
        return [low, high, 0.0, 0.0, 0.0], [float(q[1]) * plant.fuel, area, fan_vane, compressor_vane]

    def imbalance(q: Array) -> Array:
        x, u = at(q)
        path = plant.gas_path(x, u, health, solver)
        loss = d.mechanical_efficiency
        return np.array(
            [
                path.low_turbine_power * loss / path.fan_power - 1.0,
                path.high_turbine_power * loss / path.compressor_power - 1.0,
            ]
        )

    # from the maximum downwards in small steps: each steady state is the guess for the next
    q = np.ones(2)
    steps = max(1, round((MAXIMUM - pla) / 2.0))
    for k in range(1, steps + 1):
        angle = MAXIMUM + (pla - MAXIMUM) * k / steps
        low, area = fan_speed(angle, plant), nozzle_area(angle, plant)
        found = root(imbalance, q, tol=1e-13, options={"factor": 0.1})
        q = found.x
        if np.abs(found.fun).max() > 1e-9:
            raise UncertainLTIError(f"turbofan: no steady state at PLA {angle:g} deg: {found.message}")
    x, u = at(q)
    path = plant.gas_path(x, u, health, solver)
    x[2:] = [path.P3, path.P5, path.T5]
    return Trim(pla, np.array(x), np.array(u), path)


@cache
def operating_point() -> OperatingPoint:
    """PLA 68 deg, scaled by the largest steady magnitude from idle to there (Leibov's normalisation)."""
    trims = [trim(pla) for pla in np.linspace(IDLE, MAXIMUM, 15)]
    X = np.abs([t.x for t in trims]).max(axis=0)
    U = np.abs([t.u for t in trims]).max(axis=0)
    return OperatingPoint(trims[-1].x, trims[-1].u, X, U)


class Controller:
    """Fan speed follows the lever; compressor speed, turbine temperature and the fuel's rate are limited.

    One step per sample. Fuel is the lesser of a proportional-integral law on the fan speed's error and of a cap that
    integrates the distance to the nearer limit; the cap has no proportional part and stays above the law while no limit
    is near, so that noise is not rectified. Gains are chosen for a response of about a second.

    `plant`: the engine; `start`: the steady state that the controller takes over; `dt`: step, s.
    """

    PROPORTIONAL, INTEGRAL = 2.0, 4.0  # relative fuel over relative speed: 1, 1/s
    CAP, CLEARANCE = 4.0, 0.05  # relative fuel over relative distance, 1/s; relative fuel
    FUEL_RATE = 0.35  # kg/s^2
    AREA_RATE = 0.04  # m^2/s
    VANE_RATE = 40.0  # deg/s
    LEAST_FUEL = 0.07  # of the design's
    COMPRESSOR_LIMIT = 1.01  # of the design speed
    TEMPERATURE_LIMIT = 1.03  # of the design's

    def __init__(self, plant: Engine, start: Trim, dt: float) -> None:
        self._plant, self._dt = plant, dt
        self._limits = (
            self.COMPRESSOR_LIMIT * plant.design.compressor_speed,
            self.TEMPERATURE_LIMIT * float(operating_point().x_s[4]),
        )
        self._command = start.u.copy()
        self._offset = start.x[0] - fan_speed(start.pla, plant)  # a steady state is one of the loop, to the last bit
        self._correction = 0.0  # of the integral, relative fuel, from the steady state
        self._start = float(start.u[0])
        self._cap = self._start / plant.fuel + self.CLEARANCE

    def step(self, pla: float, x: Array) -> Array:
        """Commands from the lever and the measured states, once per sample.

        `x` (5,): measured states, recorded units; Returns (4,): commands, recorded units.
        """
        fuel, dt, u = self._plant.fuel, self._dt, self._command.copy()
        demand = fan_speed(pla, self._plant) + self._offset
        error = float((demand - x[0]) / demand)
        distance = min(1.0 - float(x[1]) / self._limits[0], 1.0 - float(x[4]) / self._limits[1])
        self._correction += self.INTEGRAL * dt * error
        wanted = self._start + fuel * (self._correction + self.PROPORTIONAL * error)
        self._cap = min(self._cap + self.CAP * dt * distance, wanted / fuel + self.CLEARANCE)
        limited = max(min(wanted, self._cap * fuel), self.LEAST_FUEL * fuel)
        u[0] += min(max(limited - u[0], -self.FUEL_RATE * dt), self.FUEL_RATE * dt)
        if u[0] != wanted:  # the integral does not run on while something else holds the fuel
            self._correction -= self.INTEGRAL * dt * error
        targets = (nozzle_area(pla, self._plant), *vanes(float(x[0]), float(x[1]), self._plant))
        for j, (target, rate) in enumerate(
            zip(targets, (self.AREA_RATE, self.VANE_RATE, self.VANE_RATE), strict=True), start=1
        ):
            u[j] += min(max(target - u[j], -rate * dt), rate * dt)
        self._command = u
        return u.copy()
