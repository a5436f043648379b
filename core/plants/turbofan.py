# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The turbofan as one system: design point, gas path, spools and sensors, its linearisation.

A two-spool mixed-flow turbofan of low bypass ratio at sea level and rest, of the class of the Klimov RD-33 (see
docs/turbofan.md). Stations: 2 fan face, 13 fan exit, 3 compressor exit, 4 combustor exit, 45 between the turbines,
5 behind the turbine, 16 bypass at the mixer, 6 mixed, 8 nozzle throat.

The gas path is quasi-steady: at given spool speeds and controls the flows match at once. The volumes of such an engine
store 10 to 30 ms of flow, so that their pressures settle at 100 1/s and more, faster than the step of 0.025 s that is
recorded. What is slower are the sensors: a pressure probe with its line and a thermocouple are lags of 45 to 70 ms.
The pressures and the temperature among the states are these sensors' readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from math import pi, sqrt

import numpy as np
from numpy.typing import ArrayLike

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import UncertainLTIError
from uncertain_lti.plants import turbofan_gas as gas
from uncertain_lti.plants.turbofan_gas import P_STANDARD, T_STANDARD, CompressorMap, TurbineMap, burn, nozzle

STATES = (
    "fan_speed",
    "compressor_speed",
    "compressor_exit_total_pressure",
    "turbine_exit_total_pressure",
    "turbine_exit_total_temperature",
)
STATE_UNITS = ("rpm", "rpm", "Pa", "Pa", "K")
CONTROLS = (
    "main_fuel_flow",
    "nozzle_throat_area",
    "fan_inlet_guide_vane_angle",
    "compressor_outlet_guide_vane_angle",
)
CONTROL_UNITS = ("kg/s", "m^2", "deg", "deg")


@dataclass(frozen=True)
class DesignPoint:
    """What the engine is sized from: the maximum regime without afterburner, PLA 68 deg.

    Flow, pressure ratio and bypass ratio are those published for the RD-33; the turbine inlet temperature is the one
    that gives its thrust in a cycle without cooling air; the others are typical of the class, and chosen.

    `flow`: air flow, kg/s; `fan_ratio`: pressure ratio of the fan; `compressor_ratio`: pressure ratio of the
    compressor; `bypass_ratio`: bypass flow over core flow; `turbine_inlet`: temperature in front of the turbine, K;
    `fan_efficiency`: isentropic; `compressor_efficiency`: isentropic; `high_turbine_efficiency`: isentropic;
    `low_turbine_efficiency`: isentropic; `combustion_efficiency`: share of the heating value that is released;
    `combustor_loss`: share of total pressure; `bypass_loss`: share of total pressure; `mixer_loss`: share of total
    pressure, in mixer, jet pipe and unlit afterburner; `mechanical_efficiency`: of either spool;
    `velocity_coefficient`: of the nozzle; `core_mach`: in the mixing plane, behind the turbine; `fan_speed`: rpm;
    `compressor_speed`: rpm.
    """

    flow: float = 76.0  # kg/s
    fan_ratio: float = 3.15
    compressor_ratio: float = 6.9
    bypass_ratio: float = 0.49
    turbine_inlet: float = 1440.0  # K
    fan_efficiency: float = 0.82  # isentropic, and so below
    compressor_efficiency: float = 0.84
    high_turbine_efficiency: float = 0.87
    low_turbine_efficiency: float = 0.88
    combustion_efficiency: float = 0.99
    combustor_loss: float = 0.05  # share of total pressure
    bypass_loss: float = 0.03
    mixer_loss: float = 0.03  # mixer, jet pipe and unlit afterburner
    mechanical_efficiency: float = 0.99
    velocity_coefficient: float = 0.985
    core_mach: float = 0.50  # in the mixing plane, behind the turbine
    fan_speed: float = 11000.0  # rpm
    compressor_speed: float = 15500.0  # rpm


@dataclass(frozen=True)
class Rotors:
    """Moments of inertia and sensor lags, chosen for the modes of the paper (see docs/turbofan.md).

    `low`: moment of inertia of the fan's spool, kg m^2; `high`: moment of inertia of the compressor's spool, kg m^2;
    `compressor_pressure`: lag of the sensor behind the compressor, s; `turbine_pressure`: lag of the pressure sensor
    behind the turbine, s; `turbine_temperature`: lag of the temperature sensor behind the turbine, s.
    """

    low: float = 16.0
    high: float = 7.25
    compressor_pressure: float = 0.055
    turbine_pressure: float = 0.045
    turbine_temperature: float = 0.070


@dataclass(frozen=True)
class Health:
    """Factors on the efficiencies of fan and compressor; 1 is healthy.

    `fan`: factor on the fan's efficiency; `compressor`: factor on the compressor's efficiency.
    """

    fan: float = 1.0
    compressor: float = 1.0


@dataclass(frozen=True)
class GasPath:
    """Everything at one operating condition; the stations are those of the module's docstring.

    P: total pressures, Pa; T: total temperatures, K; `w6`: mass fraction of burnt fuel at station 6; W: flows, kg/s;
    `fuel`: kg/s; `thrust`: gross, N; `fan_power`, `compressor_power`: taken by each, W; `high_turbine_power`: given by
    the turbine of the compressor's spool, W; `low_turbine_power`: by that of the fan's spool, W; `residual`: largest
    relative mismatch of the five flow balances.
    """

    P3: float
    T3: float
    T4: float
    P5: float
    T5: float
    P13: float
    T13: float
    P6: float
    T6: float
    w6: float
    W2: float
    W25: float
    W4: float
    W16: float
    W8: float
    fuel: float
    thrust: float
    fan_power: float
    compressor_power: float
    high_turbine_power: float
    low_turbine_power: float
    residual: float  # largest relative mismatch of the five flow balances

    @property
    def bypass_ratio(self) -> float:
        """Bypass flow over core flow."""
        return self.W16 / self.W25

    @property
    def overall_pressure_ratio(self) -> float:
        """P3 / P2."""
        return self.P3 / P_STANDARD

    @property
    def specific_consumption(self) -> float:
        """kg/(kgf h), as engines of this class are quoted."""
        return self.fuel * 3600.0 / (self.thrust / 9.80665)


class Engine:
    """The nonlinear engine, sized at its design point.

    States and controls in recorded units, in the order of STATES and CONTROLS.

    `design`: sizes; `rotors`: inertias and sensor lags.
    """

    def __init__(self) -> None:
        d = self.design = DesignPoint()
        self.rotors = Rotors()
        core = d.flow / (1.0 + d.bypass_ratio)
        bypass = d.flow - core

        def compressor(T: float, ratio: float, efficiency: float) -> tuple[float, float]:
            """Work J/kg and exit temperature K."""
            h = gas.enthalpy(T, 0.0)
            work = (gas.enthalpy(gas.isentropic_temperature(T, ratio, 0.0), 0.0) - h) / efficiency
            return work, gas.temperature(h + work, 0.0)

        fan_work, T13 = compressor(T_STANDARD, d.fan_ratio, d.fan_efficiency)
        P13 = P_STANDARD * d.fan_ratio
        work, T3 = compressor(T13, d.compressor_ratio, d.compressor_efficiency)
        P4 = P13 * d.compressor_ratio * (1.0 - d.combustor_loss)
        fuel = _fuel_for(core, T3, d.turbine_inlet, d.combustion_efficiency)
        T4, w4 = burn(core, T3, fuel, d.combustion_efficiency)
        W4 = core + fuel

        def turbine(
            P: float, T: float, power: float, efficiency: float, narrow: float
        ) -> tuple[TurbineMap, float, float]:
            """Map, exit pressure Pa and exit temperature K of a turbine that gives this power, W."""
            h = gas.enthalpy(T, w4)
            drop = power / d.mechanical_efficiency / (W4 * efficiency)
            ratio = gas.pressure_ratio(T, gas.temperature(h - drop, w4), w4)
            capacity = W4 * sqrt(T) / P / sqrt(1.0 - ratio * ratio)
            return (
                TurbineMap(capacity, efficiency, drop, narrow),
                P * ratio,
                gas.temperature(h - efficiency * drop, w4),
            )

        self.high_turbine, P45, T45 = turbine(P4, T4, core * work, d.high_turbine_efficiency, 0.3)
        self.low_turbine, P5, T5 = turbine(P45, T45, d.flow * fan_work, d.low_turbine_efficiency, 0.3)
        self.fan = CompressorMap(
            d.flow, fan_work, d.fan_efficiency, T_STANDARD,
            exponent=1.1, steepening=0.8, slope=1.3, curvature=1.5, closing=0.008, deloading=0.006,
            narrow=1.2, off_speed=0.25, off_vane=1.0e-4, vane_low=30.0, n_low=0.5,
        )  # fmt: skip
        self.compressor = CompressorMap(
            core * sqrt(T13 / T_STANDARD) / (P13 / P_STANDARD), work * T_STANDARD / T13, d.compressor_efficiency, T13,
            exponent=2.6, steepening=0.0, slope=2.6, curvature=2.5, closing=0.008, deloading=0.004,
            narrow=2.0, off_speed=0.6, off_vane=1.0e-4, vane_low=20.0, n_low=0.75,
        )  # fmt: skip
        g = gas.gamma(T5, w4)
        plane = P5 * (1.0 + 0.5 * (g - 1.0) * d.core_mach**2) ** (-g / (g - 1.0))
        P16 = P13 * (1.0 - d.bypass_loss)
        self.core_area = W4 / gas.mass_flow(1.0, P5, T5, w4, plane)
        self.bypass_area = bypass / gas.mass_flow(1.0, P16, T13, 0.0, plane)
        self._bypass_loss = d.bypass_loss / (bypass * sqrt(T13) / P13) ** 2
        P6, T6, w6 = self._mix(W4, P5, T5, w4, bypass, P16, T13)
        self.nozzle_area = (W4 + bypass) / gas.mass_flow(1.0, P6, T6, w6, P_STANDARD)
        self.fuel = fuel
        self._plane = plane

    def _mix(
        self, W5: float, P5: float, T5: float, w5: float, W16: float, P16: float, T16: float
    ) -> tuple[float, float, float]:
        """Mixed total pressure (by mass, less the loss), temperature and fuel mass fraction."""
        W6 = W5 + W16
        w6 = W5 * w5 / W6
        P6 = (W5 * P5 + W16 * P16) / W6 * (1.0 - self.design.mixer_loss)
        h6 = (W5 * gas.enthalpy(T5, w5) + W16 * gas.enthalpy(T16, 0.0)) / W6
        return P6, gas.temperature(h6, w6), w6

    # --- gas path ---

    def _path(
        self, q: Sequence[float], x: Sequence[float], u: Sequence[float], health: Health
    ) -> tuple[Array, GasPath]:
        """Mismatch of the five flow balances and all stations at a trial q.

        q: flow coefficients of fan and compressor, ideal drops of both turbines and static pressure in the mixing
        plane, each over its design value.
        """
        d = self.design
        fuel, area, fan_vane, compressor_vane = u
        low, high = x[0] / d.fan_speed, x[1] / d.compressor_speed
        W2, P13, T13, _ = self.fan.run(low, q[0], fan_vane, P_STANDARD, T_STANDARD, health.fan)
        W25, P3, T3, _ = self.compressor.run(high, q[1], compressor_vane, P13, T13, health.compressor)
        T4, w = burn(W25, T3, fuel, d.combustion_efficiency)
        W4 = W25 + fuel
        P4 = P3 * (1.0 - d.combustor_loss)
        flow4, P45, T45 = self.high_turbine.run(high, q[2] * self.high_turbine.drop, P4, T4, w)
        flow45, P5, T5 = self.low_turbine.run(low, q[3] * self.low_turbine.drop, P45, T45, w)
        W16 = W2 - W25
        P16 = P13 * (1.0 - self._bypass_loss * W16 * W16 * T13 / (P13 * P13))
        plane = q[4] * self._plane
        P6, T6, w6 = self._mix(W4, P5, T5, w, W16, P16, T13)
        W6 = W4 + W16
        W8, thrust = nozzle(area, P6, T6, w6, P_STANDARD, d.velocity_coefficient)
        mismatch = np.array(
            [
                flow4 / W4 - 1.0,
                flow45 / W4 - 1.0,
                gas.mass_flow(self.core_area, P5, T5, w, plane) / W4 - 1.0,
                (gas.mass_flow(self.bypass_area, P16, T13, 0.0, plane) - W16) / W2,
                W8 / W6 - 1.0,
            ]
        )
        path = GasPath(
            P3, T3, T4, P5, T5, P13, T13, P6, T6, w6, W2, W25, W4, W16, W8, fuel, thrust,
            fan_power=W2 * (gas.enthalpy(T13, 0.0) - gas.enthalpy(T_STANDARD, 0.0)),
            compressor_power=W25 * (gas.enthalpy(T3, 0.0) - gas.enthalpy(T13, 0.0)),
            high_turbine_power=W4 * (gas.enthalpy(T4, w) - gas.enthalpy(T45, w)),
            low_turbine_power=W4 * (gas.enthalpy(T45, w) - gas.enthalpy(T5, w)),
            residual=float(np.abs(mismatch).max()),
        )  # fmt: skip
        return mismatch, path

    def gas_path(
        self, x: Sequence[float], u: Sequence[float], health: Health | None = None, solver: GasPathSolver | None = None
    ) -> GasPath:
        """Matched gas path at spool speeds x[:2] and controls u, to a relative mismatch of 1e-12."""
        return (solver or GasPathSolver(self)).solve(x, u, health or Health())

    def derivative(
        self, x: Sequence[float], u: Sequence[float], health: Health | None = None, solver: GasPathSolver | None = None
    ) -> Array:
        """Rate of the states.

        Returns (5,): dx/dt, recorded units per s.
        """
        path = self.gas_path(x, u, health, solver)
        r, loss = self.rotors, self.design.mechanical_efficiency
        radian = 2.0 * pi / 60.0
        low, high = x[0] * radian, x[1] * radian
        return np.array(
            [
                (path.low_turbine_power * loss - path.fan_power) / (r.low * low) / radian,
                (path.high_turbine_power * loss - path.compressor_power) / (r.high * high) / radian,
                (path.P3 - x[2]) / r.compressor_pressure,
                (path.P5 - x[3]) / r.turbine_pressure,
                (path.T5 - x[4]) / r.turbine_temperature,
            ]
        )

    def linearise(
        self, x: ArrayLike, u: ArrayLike, X: ArrayLike, U: ArrayLike, step: float = 1e-5
    ) -> tuple[Array, Array]:
        """A and B of the scaled deviations, by central differences.

        `x` (5,): states of the operating point, recorded units; `u` (4,): its controls; `X` (5,): scales of the states;
        `U` (4,): scales of the controls; Returns (5, 5): A, 1/s; Returns (5, 4): B, 1/s.
        """
        n, at, scales = len(STATES), np.concatenate([x, u]).astype(np.float64), np.concatenate([X, U])
        solver, columns = GasPathSolver(self), []
        for change in np.diag(step * scales):
            ends = (at + change).tolist(), (at - change).tolist()
            above, below = (self.derivative(z[:n], z[n:], solver=solver) for z in ends)
            columns.append((above - below) / (2.0 * step) / scales[:n])
        both = np.column_stack(columns)
        return both[:, :n], both[:, n:]


class GasPathSolver:
    """Newton's method for the gas path, started from the solution before.

    The Jacobian is kept as long as it serves, and computed again by differences where convergence is slow. If the step
    from the last condition is too large, the condition is approached from the design point in several.

    `engine`: the engine whose flows are matched.
    """

    TOLERANCE = 1e-12
    ROUNDING = 1e-10  # accepted where a step gains nothing more

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._q = np.ones(5)
        self._inverse: Array | None = None

    def solve(self, x: Sequence[float], u: Sequence[float], health: Health) -> GasPath:
        """Matched gas path; see `Engine.gas_path`."""
        path = self._newton(x, u, health)
        if path is None:
            path = self._approach(x, u, health)
        if path is None:
            raise UncertainLTIError(
                f"turbofan: no matched gas path at fan speed {x[0]:.0f} rpm, compressor speed {x[1]:.0f} rpm, fuel "
                f"{u[0]:.3f} kg/s, nozzle area {u[1]:.4f} m^2, vanes {u[2]:.1f} and {u[3]:.1f} deg; keep closer to "
                f"the working line"
            )
        return path

    def _approach(self, x: Sequence[float], u: Sequence[float], health: Health) -> GasPath | None:
        d = self._engine.design
        start = np.array([d.fan_speed, d.compressor_speed, self._engine.fuel, self._engine.nozzle_area, 0.0, 0.0])
        goal = np.array([x[0], x[1], *u])
        self._q, self._inverse = np.ones(5), None
        path = None
        for share in np.linspace(0.0, 1.0, 21):
            here = (start + share * (goal - start)).tolist()
            here[2] = float(start[2] * (goal[2] / start[2]) ** share)  # near the working line, unlike a straight way
            path = self._newton(here[:2], here[2:], health)
            if path is None:
                return None
        return path

    def _newton(self, x: Sequence[float], u: Sequence[float], health: Health) -> GasPath | None:
        q = self._q
        mismatch, path = self._try(q, x, u, health)
        for _ in range(60):
            if path is None or path.residual <= self.TOLERANCE:
                break
            fresh = self._inverse is None
            if self._inverse is None:
                self._inverse = self._jacobian_inverse(q, mismatch, x, u, health)
            if self._inverse is None:
                return None
            step = self._inverse @ mismatch
            step *= min(1.0, 0.3 / max(float(np.abs(step).max()), 1e-300))  # keeps flows and drops positive
            for length in 0.5 ** np.arange(20 if fresh else 1):
                found, there = self._try(q - length * step, x, u, health)
                if there is not None and there.residual < path.residual:
                    break
                there = None
            if there is None and fresh:
                break
            if there is None or there.residual > 0.1 * path.residual:
                self._inverse = None
            if there is not None:
                q, mismatch, path = q - length * step, found, there
        if path is None or path.residual > self.ROUNDING:
            self._inverse = None
            return None
        self._q = q
        return path

    def _try(self, q: Array, x: Sequence[float], u: Sequence[float], health: Health) -> tuple[Array, GasPath | None]:
        """As `Engine._path`; None where the trial lies outside what the components are defined for."""
        try:
            mismatch, path = self._engine._path(q.tolist(), x, u, health)
        except (ValueError, ZeroDivisionError, OverflowError, TypeError):
            return q, None
        return (mismatch, path) if np.isfinite(path.residual) else (q, None)

    def _jacobian_inverse(
        self, q: Array, mismatch: Array, x: Sequence[float], u: Sequence[float], health: Health
    ) -> Array | None:
        jacobian = np.empty((5, 5))
        step = 1e-7
        for j in range(5):
            moved = q.copy()
            moved[j] += step
            column, path = self._try(moved, x, u, health)
            if path is None:
                return None
            jacobian[:, j] = (column - mismatch) / step
        try:
            inverse = np.linalg.inv(jacobian).astype(np.float64)
        except np.linalg.LinAlgError:
            return None
        return inverse


def _fuel_for(air: float, T3: float, T4: float, efficiency: float) -> float:
    """Fuel flow, kg/s, that heats air kg/s from T3 to T4."""
    fuel = 0.02 * air
    for _ in range(30):
        here = burn(air, T3, fuel, efficiency)[0]
        slope = (burn(air, T3, fuel * 1.001, efficiency)[0] - here) / (0.001 * fuel)
        fuel -= (here - T4) / slope
    return fuel


@cache
def engine() -> Engine:
    """The engine with its default sizes."""
    return Engine()
