# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The turbofan in operation: steady states, its controller, faults, and the recordings that result.

Every run is sampled at 0.025 s; controls are recorded as commands and held between samples. Readings are rounded to
1e-9 of their scale, so that a steady state is steady to the last bit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import UncertainLTIError
from uncertain_lti.base.text import plural
from uncertain_lti.model.operating_point import OperatingPoint
from uncertain_lti.plants.leibov import CONTROL_TOPIC, DT_NS, JOINT_STATE, STATE_TOPIC
from uncertain_lti.plants.turbofan import HEALTHY, STATES, T_STANDARD, GasPath, GasPathSolver, Health, engine
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.signal_map import Signal, SignalMap

STATE_UNITS = ("rpm", "rpm", "Pa", "Pa", "K")
CONTROLS = ("main_fuel_flow", "nozzle_throat_area", "fan_inlet_guide_vane_angle", "compressor_outlet_guide_vane_angle")
CONTROL_UNITS = ("kg/s", "m^2", "deg", "deg")
IDLE, MAXIMUM = 12.0, 68.0
"""Power-lever angle, deg."""
DT = DT_NS * 1e-9
"""Step, s: that of the paper."""
START_NS = 1_136_073_600 * 10**9
"""Stamp of the first sample of every run, ns: a simulated clock, the first second of 2006."""
RESOLUTION = 1e-9
"""Of a reading, over its scale."""
PULSE = 3.75
"""Width of a pulse and of the rest after it, s."""
PROPORTION = np.array([1.0, 0.3, 0.5, 0.5])
"""Height of the pulses of each control, over its scale, for an amplitude of 1: a nozzle or a vane acts more than fuel
does for the same share of its range, and none may push the engine off its maps."""
SAMPLES = {"pulses": 1201, "check": 101, "levels": 2401}
"""Usual samples of each manoeuvre."""
HOLD = 0.2
"""A command older than this is not in force, s."""

CHECK = ((0.0, MAXIMUM), (DT, 60.0))
LEVELS = ((0.0, 68.0), (4.0, 64.0), (9.0, 67.0), (13.0, 61.0), (18.0, 65.0), (22.0, 60.0), (27.0, 66.0), (32.0, 63.0),
          (36.0, 68.0), (42.0, 62.0), (47.0, 64.0), (52.0, 61.0), (56.0, 68.0))  # fmt: skip
"""(instant s, lever deg): the lever jumps and stays. CHECK is the paper's, with the jump at the second sample."""


def power(pla: float) -> float:
    """Lever position between idle, 0, and the maximum regime, 1."""
    if not IDLE <= pla <= MAXIMUM:
        raise UncertainLTIError(f"turbofan: PLA is {pla:g} deg; it must be from {IDLE:g} to {MAXIMUM:g}")
    return (pla - IDLE) / (MAXIMUM - IDLE)


def fan_speed(pla: float) -> float:
    """Scheduled fan speed, rpm: 50 % at idle, flatter towards the maximum (chosen)."""
    share: float = 0.5 + 0.5 * power(pla) ** 0.75
    return share * engine().design.fan_speed


def nozzle_area(pla: float) -> float:
    """Scheduled throat area, m^2: opened by 20 % at idle, to keep thrust low and the fan away from surge (chosen)."""
    return float(engine().nozzle_area * (1.0 + 0.20 * (1.0 - power(pla)) ** 1.2))


def vanes(low: float, high: float) -> tuple[float, float]:
    """Scheduled angles, deg, of fan and compressor vanes at spool speeds in rpm.

    The compressor's inlet temperature, which its corrected speed needs, is taken from the fan speed, as its rise goes
    nearly with the square of that.
    """
    plant = engine()
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


def trim(pla: float) -> Trim:
    """Steady state at a lever angle: fan speed, area and vanes by schedule, fuel and compressor speed by balance."""
    from scipy.optimize import root

    plant, solver = engine(), GasPathSolver(engine())

    def at(q: Array) -> tuple[list[float], list[float]]:
        low, high = fan_speed(angle), float(q[0]) * plant.design.compressor_speed
        return [low, high, 0.0, 0.0, 0.0], [float(q[1]) * plant.fuel, nozzle_area(angle), *vanes(low, high)]

    def imbalance(q: Array) -> Array:
        path, loss = solver.solve(*at(q), HEALTHY), plant.design.mechanical_efficiency
        low, high = path.low_turbine_power * loss, path.high_turbine_power * loss
        return np.array([low / path.fan_power - 1.0, high / path.compressor_power - 1.0])

    # from the maximum downwards in small steps: each steady state is the guess for the next
    q = np.ones(2)
    steps = max(1, round((MAXIMUM - pla) / 2.0))
    for k in range(1, steps + 1):
        angle = MAXIMUM + (pla - MAXIMUM) * k / steps
        found = root(imbalance, q, tol=1e-13, options={"factor": 0.1})
        q = found.x
        if np.abs(found.fun).max() > 1e-9:
            raise UncertainLTIError(f"turbofan: no steady state at PLA {angle:g} deg: {found.message}")
    x, u = at(q)
    path = solver.solve(x, u, HEALTHY)
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

    `start`: the steady state that the controller takes over.
    """

    PROPORTIONAL, INTEGRAL = 2.0, 4.0  # relative fuel over relative speed: 1, 1/s
    CAP, CLEARANCE = 4.0, 0.05  # relative fuel over relative distance, 1/s; relative fuel
    FUEL_RATE = 0.35  # kg/s^2
    AREA_RATE = 0.04  # m^2/s
    VANE_RATE = 40.0  # deg/s
    LEAST_FUEL = 0.07  # of the design's
    COMPRESSOR_LIMIT = 1.01  # of the design speed
    TEMPERATURE_LIMIT = 1.03  # of the design's

    def __init__(self, start: Trim) -> None:
        hottest = self.TEMPERATURE_LIMIT * float(operating_point().x_s[4])
        self._limits = self.COMPRESSOR_LIMIT * engine().design.compressor_speed, hottest
        self._command = start.u.copy()
        self._offset = start.x[0] - fan_speed(start.pla)  # a steady state is one of the loop, to the last bit
        self._correction = 0.0  # of the integral, relative fuel, from the steady state
        self._start = float(start.u[0])
        self._cap = self._start / engine().fuel + self.CLEARANCE

    def step(self, pla: float, x: Array) -> Array:
        """Commands from the lever and the measured states, once per sample.

        `x` (5,): measured states, recorded units; Returns (4,): commands, recorded units.
        """
        fuel, dt, u = engine().fuel, DT, self._command.copy()
        demand = fan_speed(pla) + self._offset
        error = float((demand - x[0]) / demand)
        distance = min(1.0 - float(x[1]) / self._limits[0], 1.0 - float(x[4]) / self._limits[1])
        self._correction += self.INTEGRAL * dt * error
        wanted = self._start + fuel * (self._correction + self.PROPORTIONAL * error)
        self._cap = min(self._cap + self.CAP * dt * distance, wanted / fuel + self.CLEARANCE)
        limited = max(min(wanted, self._cap * fuel), self.LEAST_FUEL * fuel)
        u[0] += min(max(limited - u[0], -self.FUEL_RATE * dt), self.FUEL_RATE * dt)
        if u[0] != wanted:  # the integral does not run on while something else holds the fuel
            self._correction -= self.INTEGRAL * dt * error
        most = dt * np.array([self.AREA_RATE, self.VANE_RATE, self.VANE_RATE])
        u[1:] += np.clip(np.array([nozzle_area(pla), *vanes(float(x[0]), float(x[1]))]) - u[1:], -most, most)
        self._command = u
        return u.copy()


@cache
def turbofan_signals() -> SignalMap:
    """States and controls as the plant node publishes them, around PLA 68 deg; `config/signals/turbofan.yaml`."""
    point = operating_point()

    states = zip(STATES, STATE_UNITS, _rounded(point.x_s, point.X).tolist(), point.X.tolist(), strict=True)
    controls = zip(CONTROLS, CONTROL_UNITS, point.u_s.tolist(), point.U.tolist(), strict=True)

    def signal(topic: str, name: str, unit: str, steady: float, scale: float, hold: float | None = None) -> Signal:
        return Signal(name, topic, f"position[{name}]", steady, scale, unit, JOINT_STATE, hold)

    return SignalMap(
        tuple(signal(STATE_TOPIC, *row) for row in states),
        tuple(signal(CONTROL_TOPIC, *row, HOLD) for row in controls),
        clock=STATE_TOPIC,
        max_gap=2.5 * DT,
        time={STATE_TOPIC: "header", CONTROL_TOPIC: "header"},
        source="turbofan",
    )


KINDS = {
    "fuel_stuck": "the fuel flow stays where it is, whatever is commanded",
    "nozzle_stuck": "the nozzle area stays where it is, whatever is commanded",
    "sensor_bias": "the reading of the compressor exit pressure jumps by 2 % of its scale",
    "sensor_drift": "the reading of the turbine exit temperature drifts by 0.2 % of its scale per second",
    "compressor_wear": "the compressor loses efficiency at 0.1 % per second, down to 3 % less",
    "fan_damage": "the fan loses 2 % of its efficiency at once",
}
"""Kinds of fault, each with what happens; the sizes are the ones below."""

BIAS, DRIFT = 0.02, 0.002  # of the scale; of the scale per s
WEAR, WORST_WEAR = 0.001, 0.03  # of the efficiency per s; at most
DAMAGE = 0.02  # of the efficiency


@dataclass(frozen=True)
class Fault:
    """A kind of fault and the instant of its onset.

    `kind`: one of KINDS; `at`: onset, s after the first sample; `size`: of the fault, over the size that KINDS states:
    2 is a bias, a drift, a rate of wear or a loss twice as large.
    """

    kind: str
    at: float
    size: float = 1.0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise UncertainLTIError(f"turbofan: there is no fault '{self.kind}'; there are {', '.join(KINDS)}")
        if not 0.0 < self.size < math.inf:
            raise UncertainLTIError(f"turbofan: a fault of size {self.size:g}; it must be a positive number")
        if self.size != 1.0 and self.kind.endswith("stuck"):
            stuck = "what is stuck has no size, leave it 1"
            raise UncertainLTIError(f"turbofan: {self.kind} of size {self.size:g}; {stuck}")

    def health(self, t: float) -> Health:
        """Efficiency factors at one instant."""
        if self.kind == "compressor_wear" and t > self.at:
            return Health(compressor=1.0 - self.size * min(WEAR * (t - self.at), WORST_WEAR))
        if self.kind == "fan_damage" and t >= self.at:
            return Health(fan=1.0 - self.size * DAMAGE)
        return HEALTHY

    def reading(self, t: float, x: Array, X: Array) -> Array:
        """What the sensors read.

        `x` (5,): states, recorded units; `X` (5,): scales of the states; Returns (5,): readings; `x` itself where no
        sensor is at fault.
        """
        if t < self.at or not self.kind.startswith("sensor"):
            return x
        x, bias = x.copy(), self.kind == "sensor_bias"
        i = STATES.index("compressor_exit_total_pressure" if bias else "turbine_exit_total_temperature")
        x[i] += self.size * (BIAS if bias else DRIFT * (t - self.at)) * X[i]
        return x

    def stuck(self, t: float) -> int | None:
        """Position of the control that no longer follows its command, if any."""
        stuck = {"fuel_stuck": "main_fuel_flow", "nozzle_stuck": "nozzle_throat_area"}.get(self.kind)
        return None if stuck is None or t < self.at else CONTROLS.index(stuck)


@dataclass(frozen=True)
class Run:
    """One run of the plant.

    `samples`: number of samples, at least 2; `amplitude`: height of the pulses of an open-loop run, see `pulses`,
    negative downwards, around the steady state at the first angle of `lever`; None for a closed-loop run along `lever`;
    `lever`: (instant s, angle deg) of each jump of the lever; `noise`: standard deviation of every reading, over its
    scale; `seed`: seed of the noise; `fault`: what goes wrong; None for a healthy run.
    """

    samples: int
    amplitude: float | None = None
    lever: tuple[tuple[float, float], ...] = ((0.0, MAXIMUM),)
    noise: float = 0.0
    seed: int = 0
    fault: Fault | None = None

    def __post_init__(self) -> None:
        if self.samples < 2:
            raise UncertainLTIError(f"turbofan: a run of {plural(self.samples, 'sample')}; it must have at least 2")
        if self.noise < 0:
            raise UncertainLTIError(f"turbofan: noise is {self.noise:g}; it must be 0 or more")

    def angle(self, t: float) -> float:
        """Angle of the lever at one instant, deg."""
        return next(pla for since, pla in reversed(self.lever) if since <= t + 1e-9)


def pulses(t: float, amplitude: float) -> Array:
    """Deviation of the controls over their scales: one pulse on each in turn, separated by rests.

    1.875 s of rest, then for each control 3.75 s of pulse and 3.75 s of rest: 30 s, as in the numerical example of
    Leibov (2006).

    Returns (4,): normalised deviations.
    """
    u = np.zeros(len(CONTROLS))
    number, phase = divmod(t - PULSE / 2.0, 2.0 * PULSE)
    if 0 <= number < len(CONTROLS) and phase < PULSE:
        u[int(number)] = amplitude * PROPORTION[int(number)]
    return u


def simulate(run: Run, start_ns: int = START_NS) -> Transient:
    """Run the engine: readings and commands, sample by sample.

    Between samples the nonlinear equations are integrated by SciPy's DOP853 to a relative tolerance of 1e-9, with the
    commands held.
    """
    point, rng = operating_point(), np.random.default_rng(run.seed)
    begin, solver = trim(run.lever[0][1]), GasPathSolver(engine())
    controller = Controller(replace(begin, x=_rounded(begin.x, point.X)))
    x, actual = begin.x.copy(), begin.u.copy()
    x_read, u_sent = np.empty((run.samples, 5)), np.empty((run.samples, 4))
    fault = run.fault or Fault("fan_damage", np.inf)
    for k in range(run.samples):
        t = k * DT
        reading = fault.reading(t, x, point.X)
        if run.noise:
            reading = reading + run.noise * point.X * rng.standard_normal(5)
        x_read[k] = _rounded(reading, point.X)
        if run.amplitude is None:
            u_sent[k] = controller.step(run.angle(t), x_read[k])
        else:
            u_sent[k] = begin.u + point.U * pulses(t, run.amplitude)
        if k + 1 == run.samples:
            break
        stuck, held = fault.stuck(t), actual
        actual = u_sent[k].copy()
        if stuck is not None:
            actual[stuck] = held[stuck]
        x = _advance(solver, x, actual, point.X, fault.health(t))
    t_ns, signals = start_ns + DT_NS * np.arange(run.samples, dtype=np.int64), turbofan_signals()
    return Transient(t_ns, x_read, u_sent, name="turbofan", signals=signals, max_gap=signals.max_gap)


def _advance(solver: GasPathSolver, x: Array, u: Array, X: Array, health: Health) -> Array:
    """x after one step under u."""
    plant, controls = engine(), u.tolist()

    def rate(_: float, z: Array) -> Array:
        return plant.derivative((z * X).tolist(), controls, health, solver) / X

    from scipy.integrate import solve_ivp  # the node says its parameters without it

    found = solve_ivp(rate, (0.0, DT), x / X, method="DOP853", rtol=1e-9, atol=1e-11, first_step=DT)
    if not found.success:
        raise UncertainLTIError(f"turbofan: the step was not integrated: {found.message}")
    return np.asarray(found.y[:, -1] * X)


def _rounded(x: Array, X: Array) -> Array:
    return np.asarray(np.round(x / X / RESOLUTION) * RESOLUTION * X)


def make_run(
    manoeuvre: str,
    amplitude: float = 0.0,
    noise: float = 0.0,
    seed: int = 0,
    fault: str = "",
    fault_at: float = 24.0,
    samples: int = 0,
) -> Run:
    """A run by name."""
    if manoeuvre not in SAMPLES:
        raise UncertainLTIError(f"turbofan: there is no manoeuvre '{manoeuvre}'; there are {', '.join(SAMPLES)}")
    if (manoeuvre == "pulses") != (amplitude != 0.0):
        raise UncertainLTIError("turbofan: an amplitude other than 0 is for pulses, and pulses need one")
    lever = LEVELS if manoeuvre == "levels" else CHECK
    wrong = Fault(fault, fault_at) if fault else None
    return Run(samples or SAMPLES[manoeuvre], amplitude or None, lever, noise, seed, wrong)


SMALL, LARGE = 0.05, 0.30
"""Amplitudes: of the paper's transient (it gives none; this is chosen), and larger than the check's excursion."""
NOISE = 1e-4
