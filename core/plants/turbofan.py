# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The turbofan as one system: gas, components, design point, gas path, spools and sensors, its linearisation.

A two-spool mixed-flow turbofan of low bypass ratio at sea level and rest, of the class of the Klimov RD-33 (see
docs/turbofan.md). Stations: 2 fan face, 13 fan exit, 3 compressor exit, 4 combustor exit, 45 between the turbines,
5 behind the turbine, 16 bypass at the mixer, 6 mixed, 8 nozzle throat. Units: K, J/kg, J/(kg K), kg/s, Pa, m^2.

Ideal gas whose specific heat is linear in temperature, c_p = (a + b T) + w (a_k + b_k T), with w the mass fraction of
burnt fuel. The four coefficients are least-squares fits, 280 to 1750 K, to the polynomials of P. P. Walsh and
P. Fletcher, Gas Turbine Performance (2nd ed., 2004), section 3.3; the greatest error is 2.2 %. The linear form makes
enthalpy and entropy explicit both ways, so that no component needs an iteration. R is that of dry air throughout.

The maps of compressors, turbines and nozzle are smooth, in the usual low-order forms (work coefficient over flow
coefficient for a compressor, Stodola's ellipse for a turbine); their constants are chosen, not measured on any engine.

The gas path is quasi-steady: at given spool speeds and controls the flows match at once. The volumes of such an engine
store 10 to 30 ms of flow, so that their pressures settle at 100 1/s and more, faster than the step of 0.025 s that is
recorded. What is slower are the sensors: a pressure probe with its line and a thermocouple are lags of 45 to 70 ms.
The pressures and the temperature among the states are these sensors' readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from math import exp, inf, isfinite, log, pi, sqrt

import numpy as np
from numpy.typing import ArrayLike

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import UncertainLTIError

R = 287.05
AIR_A, AIR_B = 954.28, 0.17327
FUEL_A, FUEL_B = 760.66, 1.0786
T_REFERENCE = 298.15
"""Temperature of the heating value, K."""
HEATING_VALUE = 43.1e6
"""Lower heating value of kerosene, J/kg (Walsh and Fletcher)."""


def cp(T: float, w: float) -> float:
    """Specific heat at constant pressure."""
    return AIR_A + w * FUEL_A + (AIR_B + w * FUEL_B) * T


def gamma(T: float, w: float) -> float:
    """Ratio of specific heats."""
    heat = cp(T, w)
    return heat / (heat - R)


def enthalpy(T: float, w: float) -> float:
    """Sensible enthalpy over 0 K."""
    return (AIR_A + w * FUEL_A) * T + 0.5 * (AIR_B + w * FUEL_B) * T * T


def temperature(h: float, w: float) -> float:
    """Temperature at which `enthalpy` is h."""
    a, b = AIR_A + w * FUEL_A, AIR_B + w * FUEL_B
    return (sqrt(a * a + 2.0 * b * h) - a) / b


def pressure_ratio(T1: float, T2: float, w: float) -> float:
    """p2 / p1 of an isentropic change from T1 to T2."""
    return exp(((AIR_A + w * FUEL_A) * log(T2 / T1) + (AIR_B + w * FUEL_B) * (T2 - T1)) / R)


def isentropic_temperature(T1: float, ratio: float, w: float) -> float:
    """Temperature after an isentropic change."""
    a, b = AIR_A + w * FUEL_A, AIR_B + w * FUEL_B
    target = a * log(T1) + b * T1 + R * log(ratio)
    T2: float = T1 * ratio ** (R / cp(T1, w))
    for _ in range(5):  # Newton's method on a nearly linear function of log T: quadratic from the first step
        T2 -= T2 * (a * log(T2) + b * T2 - target) / (a + b * T2)
    return T2


def mass_flow(area: float, P: float, T: float, w: float, p: float) -> float:
    """Flow through a passage from total conditions (P, T) to static pressure p, choked where p is low, kg/s.

    Isentropic with gamma at T. Where p exceeds P the flow is reversed at the same magnitude of ratio, which keeps
    a solver's trial steps defined; no converged point lies there.
    """
    g = gamma(T, w)
    ratio = p / P
    if ratio >= 1.0:
        return -area * P / sqrt(R * T) * sqrt(2.0 * (ratio - 1.0))
    ratio = max(ratio, (2.0 / (g + 1.0)) ** (g / (g - 1.0)))
    x: float = ratio ** (1.0 / g)
    return area * P / sqrt(R * T) * x * sqrt(2.0 * g / (g - 1.0) * (1.0 - ratio / x))


T_STANDARD, P_STANDARD = 288.15, 101325.0
"""Sea level, international standard atmosphere; K, Pa."""


@dataclass(frozen=True)
class CompressorMap:
    """Corrected flow, work and efficiency over corrected speed, flow coefficient and guide-vane angle.

    With n the corrected speed over its design value, a the vane angle in degrees (positive closes) and phi the flow
    coefficient over its design value:

        W sqrt(theta) / delta = flow n^(exponent + steepening (1 - n)) (1 - closing a) phi
        work / theta          = work n^2 (1 - deloading a - slope (phi - 1) - curvature (phi - 1)^2)
        efficiency            = efficiency (1 - narrow (phi - 1)^2 - off_speed (n - 1)^2 - off_vane (a - schedule)^2)
    """

    flow: float  # corrected design flow, kg/s
    work: float  # corrected design work, J/kg
    efficiency: float  # isentropic, at the design point
    T_design: float  # inlet temperature at the design point, K: corrected speed is relative to it
    exponent: float  # how fast the flow falls with speed: more stages, more compressibility, higher
    steepening: float  # and the more so at low speed
    slope: float  # how fast work falls with flow: speed lines are steep in a multi-stage compressor
    curvature: float  # of the speed lines
    closing: float  # loss of flow per closing of the vanes, 1/deg
    deloading: float  # loss of work per closing of the vanes, 1/deg: pre-swirl lowers the work
    narrow: float  # loss of efficiency off the design flow coefficient
    off_speed: float  # off the design speed
    off_vane: float  # off the scheduled vane angle, 1/deg^2
    vane_low: float  # deg, scheduled angle at `n_low`
    n_low: float  # corrected speed over design

    def schedule(self, n: float) -> float:
        """Vane angle that suits the corrected speed n, deg: a straight line, 0 at n = 1, `vane_low` at `n_low`."""
        return self.vane_low * min(max((1.0 - n) / (1.0 - self.n_low), -0.2), 1.2)

    def run(
        self, speed: float, phi: float, vane: float, P: float, T: float, health: float
    ) -> tuple[float, float, float]:
        """Flow, exit pressure and exit temperature at one operating condition."""
        theta = T / self.T_design
        n = speed / sqrt(theta)
        d = phi - 1.0
        flow = self.flow * n ** (self.exponent + self.steepening * (1.0 - n)) * (1.0 - self.closing * vane) * phi
        flow *= (P / P_STANDARD) / sqrt(T / T_STANDARD)
        work = self.work * n * n * (1.0 - self.deloading * vane - self.slope * d - self.curvature * d * d)
        work *= T / T_STANDARD
        off = vane - self.schedule(n)
        efficiency = self.efficiency * health
        efficiency *= 1.0 - self.narrow * d * d - self.off_speed * (n - 1.0) ** 2 - self.off_vane * off * off
        h = enthalpy(T, 0.0)
        ideal = temperature(h + efficiency * work, 0.0)
        return flow, P * pressure_ratio(T, ideal, 0.0), temperature(h + work, 0.0)


@dataclass(frozen=True)
class TurbineMap:
    """Flow by Stodola's ellipse, efficiency over the ratio of blade speed to spouting velocity.

    W sqrt(T) / P = capacity sqrt(1 - (p / P)^2)
    efficiency    = efficiency (1 - narrow (nu - 1)^2),  nu = speed / sqrt(ideal drop) over its design value
    """

    capacity: float  # kg sqrt(K) / (s Pa)
    efficiency: float  # isentropic, at the design point
    drop: float  # ideal enthalpy drop at the design point, J/kg
    narrow: float  # loss of efficiency off the design velocity ratio

    def run(self, speed: float, drop: float, P: float, T: float, w: float) -> tuple[float, float, float]:
        """Flow, exit pressure and exit temperature at one operating condition."""
        h = enthalpy(T, w)
        ratio = pressure_ratio(T, temperature(h - drop, w), w)
        flow = self.capacity * P / sqrt(T) * sqrt(max(1.0 - ratio * ratio, 1e-12))
        d = speed / sqrt(drop / self.drop) - 1.0
        efficiency = self.efficiency * (1.0 - self.narrow * d * d)
        return flow, P * ratio, temperature(h - efficiency * drop, w)


def burn(air: float, T: float, fuel: float, efficiency: float) -> tuple[float, float]:
    """Combustor: exit temperature from the heat balance."""
    w = fuel / (air + fuel)
    heat = (1.0 - w) * (enthalpy(T, 0.0) - enthalpy(T_REFERENCE, 0.0)) + w * efficiency * HEATING_VALUE
    return temperature(enthalpy(T_REFERENCE, w) + heat, w), w


def nozzle(area: float, P: float, T: float, w: float, ambient: float, velocity: float) -> tuple[float, float]:
    """Convergent nozzle."""
    flow = mass_flow(area, P, T, w, ambient)
    g = gamma(T, w)
    throat = max(ambient, P * (2.0 / (g + 1.0)) ** (g / (g - 1.0)))
    jet = sqrt(max(2.0 * g / (g - 1.0) * R * T * (1.0 - (throat / P) ** ((g - 1.0) / g)), 0.0))
    return flow, flow * jet * velocity + area * (throat - ambient)


# --- engine ---

STATES = (
    "fan_speed",
    "compressor_speed",
    "compressor_exit_total_pressure",
    "turbine_exit_total_pressure",
    "turbine_exit_total_temperature",
)


@dataclass(frozen=True)
class DesignPoint:
    """What the engine is sized from: the maximum regime without afterburner, PLA 68 deg.

    Flow, pressure ratio and bypass ratio are those published for the RD-33; the turbine inlet temperature is the one
    that gives its thrust in a cycle without cooling air; the others are typical of the class, and chosen.
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
    mechanical_efficiency: float = 0.99  # of either spool
    velocity_coefficient: float = 0.985  # of the nozzle
    core_mach: float = 0.50  # in the mixing plane, behind the turbine
    fan_speed: float = 11000.0  # rpm
    compressor_speed: float = 15500.0  # rpm


LOW_INERTIA, HIGH_INERTIA = 16.0, 7.25
"""Moments of inertia of the spools of fan and compressor, kg m^2, chosen for the paper's modes (docs/turbofan.md)."""
LAGS = (0.055, 0.045, 0.070)
"""Of the sensors of the pressures behind compressor and turbine and of the temperature behind that, s, likewise."""


@dataclass(frozen=True)
class Health:
    """Factors on the efficiencies of fan and compressor; 1 is healthy."""

    fan: float = 1.0
    compressor: float = 1.0


HEALTHY = Health()


@dataclass(frozen=True)
class GasPath:
    """Everything at one operating condition; the stations are those of the module's docstring.

    P: total pressures, Pa; T: total temperatures, K; `w6`: mass fraction of burnt fuel at station 6; W: flows, kg/s;
    `fuel`: kg/s; `thrust`: gross, N; `fan_power`, `compressor_power`: taken by each, W; `high_turbine_power`: given by
    the turbine of the compressor's spool, W; `low_turbine_power`: by that of the fan's spool, W; `residual`: largest
    relative mismatch of the five flow balances.
    """

    P3: float
    T4: float
    P5: float
    T5: float
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
    residual: float

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
    """The nonlinear engine, sized at its design point; states and controls in recorded units."""

    def __init__(self) -> None:
        d = self.design = DesignPoint()
        core = d.flow / (1.0 + d.bypass_ratio)
        bypass = d.flow - core

        def compressor(T: float, ratio: float, efficiency: float) -> tuple[float, float]:
            """Work J/kg and exit temperature K."""
            h = enthalpy(T, 0.0)
            work = (enthalpy(isentropic_temperature(T, ratio, 0.0), 0.0) - h) / efficiency
            return work, temperature(h + work, 0.0)

        fan_work, T13 = compressor(T_STANDARD, d.fan_ratio, d.fan_efficiency)
        P13 = P_STANDARD * d.fan_ratio
        work, T3 = compressor(T13, d.compressor_ratio, d.compressor_efficiency)
        P4 = P13 * d.compressor_ratio * (1.0 - d.combustor_loss)
        fuel = _fuel_for(core, T3, d.turbine_inlet, d.combustion_efficiency)
        T4, w4 = burn(core, T3, fuel, d.combustion_efficiency)
        W4 = core + fuel

        def turbine(P: float, T: float, power: float, efficiency: float) -> tuple[TurbineMap, float, float]:
            """Map, exit pressure Pa and exit temperature K of a turbine that gives this power, W."""
            h = enthalpy(T, w4)
            drop = power / d.mechanical_efficiency / (W4 * efficiency)
            ratio = pressure_ratio(T, temperature(h - drop, w4), w4)
            made = TurbineMap(W4 * sqrt(T) / P / sqrt(1.0 - ratio * ratio), efficiency, drop, narrow=0.3)
            return made, P * ratio, temperature(h - efficiency * drop, w4)

        self.high_turbine, P45, T45 = turbine(P4, T4, core * work, d.high_turbine_efficiency)
        self.low_turbine, P5, T5 = turbine(P45, T45, d.flow * fan_work, d.low_turbine_efficiency)
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
        g = gamma(T5, w4)
        plane = P5 * (1.0 + 0.5 * (g - 1.0) * d.core_mach**2) ** (-g / (g - 1.0))
        P16 = P13 * (1.0 - d.bypass_loss)
        self.core_area = W4 / mass_flow(1.0, P5, T5, w4, plane)
        self.bypass_area = bypass / mass_flow(1.0, P16, T13, 0.0, plane)
        self._bypass_loss = d.bypass_loss / (bypass * sqrt(T13) / P13) ** 2
        P6, T6, w6 = self._mix(W4, P5, T5, w4, bypass, P16, T13)
        self.nozzle_area = (W4 + bypass) / mass_flow(1.0, P6, T6, w6, P_STANDARD)
        self.fuel = fuel
        self._plane = plane

    def _mix(
        self, W5: float, P5: float, T5: float, w5: float, W16: float, P16: float, T16: float
    ) -> tuple[float, float, float]:
        """Mixed total pressure (by mass, less the loss), temperature and fuel mass fraction."""
        W6 = W5 + W16
        w6 = W5 * w5 / W6
        P6 = (W5 * P5 + W16 * P16) / W6 * (1.0 - self.design.mixer_loss)
        h6 = (W5 * enthalpy(T5, w5) + W16 * enthalpy(T16, 0.0)) / W6
        return P6, temperature(h6, w6), w6

    # --- gas path ---

    def _path(
        self, q: Sequence[float], x: Sequence[float], u: Sequence[float], health: Health
    ) -> tuple[Array, GasPath]:
        """Mismatch of the five flow balances and all stations at a trial q.

        q: flow coefficients of fan and compressor, ideal drops of both turbines, static mixing pressure, over design.
        """
        d = self.design
        fuel, area, fan_vane, compressor_vane = u
        low, high = x[0] / d.fan_speed, x[1] / d.compressor_speed
        W2, P13, T13 = self.fan.run(low, q[0], fan_vane, P_STANDARD, T_STANDARD, health.fan)
        W25, P3, T3 = self.compressor.run(high, q[1], compressor_vane, P13, T13, health.compressor)
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
        core = mass_flow(self.core_area, P5, T5, w, plane)
        bypass = mass_flow(self.bypass_area, P16, T13, 0.0, plane)
        mismatch = np.array([flow4 / W4 - 1.0, flow45 / W4 - 1.0, core / W4 - 1.0, (bypass - W16) / W2, W8 / W6 - 1.0])
        path = GasPath(
            P3, T4, P5, T5, T6, w6, W2, W25, W4, W16, W8, fuel, thrust,
            fan_power=W2 * (enthalpy(T13, 0.0) - enthalpy(T_STANDARD, 0.0)),
            compressor_power=W25 * (enthalpy(T3, 0.0) - enthalpy(T13, 0.0)),
            high_turbine_power=W4 * (enthalpy(T4, w) - enthalpy(T45, w)),
            low_turbine_power=W4 * (enthalpy(T45, w) - enthalpy(T5, w)),
            residual=float(np.abs(mismatch).max()),
        )  # fmt: skip
        return mismatch, path

    def derivative(
        self, x: Sequence[float], u: Sequence[float], health: Health = HEALTHY, solver: GasPathSolver | None = None
    ) -> Array:
        """dx/dt (5,) in recorded units per s."""
        path = (solver or GasPathSolver(self)).solve(x, u, health)
        loss, radian = self.design.mechanical_efficiency, 2.0 * pi / 60.0
        low, high = LOW_INERTIA * (x[0] * radian), HIGH_INERTIA * (x[1] * radian)
        fan = (path.low_turbine_power * loss - path.fan_power) / low / radian
        compressor = (path.high_turbine_power * loss - path.compressor_power) / high / radian
        sensors = [(now - read) / lag for now, read, lag in zip((path.P3, path.P5, path.T5), x[2:], LAGS, strict=True)]
        return np.array([fan, compressor, *sensors])

    def linearise(self, x: ArrayLike, u: ArrayLike, X: ArrayLike, U: ArrayLike) -> tuple[Array, Array]:
        """A (5, 5) and B (5, 4), 1/s, of deviations from (x, u) over the scales X and U, by central differences."""
        step, n, at, scales = 1e-5, len(STATES), np.concatenate([x, u]).astype(np.float64), np.concatenate([X, U])
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
    """

    TOLERANCE = 1e-12
    ROUNDING = 1e-10  # accepted where a step gains nothing more

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._q = np.ones(5)
        self._inverse: Array | None = None

    def solve(self, x: Sequence[float], u: Sequence[float], health: Health) -> GasPath:
        """Matched gas path at spool speeds x[:2] and controls u, to a relative mismatch of 1e-12."""
        path = self._newton(x, u, health) or self._approach(x, u, health)
        if path is None:
            speeds = f"fan speed {x[0]:.0f} rpm, compressor speed {x[1]:.0f} rpm"
            controls = f"fuel {u[0]:.3f} kg/s, nozzle area {u[1]:.4f} m^2, vanes {u[2]:.1f} and {u[3]:.1f} deg"
            where = f"{speeds}, {controls}; keep closer to the working line"
            raise UncertainLTIError(f"turbofan: no matched gas path at {where}")
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
                break
        return path

    def _newton(self, x: Sequence[float], u: Sequence[float], health: Health) -> GasPath | None:
        def attempt(q: Array) -> tuple[Array, float, GasPath | None]:
            """Mismatch, the largest of it and the path; infinite where the components are not defined for a trial."""
            try:
                mismatch, path = self._engine._path(q.tolist(), x, u, health)
            except (ValueError, ZeroDivisionError, OverflowError, TypeError):
                return q, inf, None
            return mismatch, path.residual if isfinite(path.residual) else inf, path

        q = self._q
        mismatch, size, path = attempt(q)
        for _ in range(60):
            if not self.TOLERANCE < size < inf:
                break
            fresh = self._inverse is None
            if self._inverse is None:
                columns = [attempt(moved) for moved in q + 1e-7 * np.eye(5)]
                if any(beyond == inf for _, beyond, _ in columns):
                    return None
                try:
                    self._inverse = np.linalg.inv(np.column_stack([(c - mismatch) / 1e-7 for c, *_ in columns]))
                except np.linalg.LinAlgError:
                    return None
            step = self._inverse @ mismatch
            step *= min(1.0, 0.3 / max(float(np.abs(step).max()), 1e-300))  # keeps flows and drops positive
            for length in 0.5 ** np.arange(20 if fresh else 1):
                found, smaller, there = attempt(q - length * step)
                if smaller < size:
                    break
            if smaller >= size and fresh:
                break
            if smaller > 0.1 * size:
                self._inverse = None
            if smaller < size:
                q, mismatch, size, path = q - length * step, found, smaller, there
        if size > self.ROUNDING:
            self._inverse = path = None
        else:
            self._q = q
        return path


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
