# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The gas in the turbofan: properties of air and burnt kerosene, and the components that it flows through.

Ideal gas whose specific heat is linear in temperature, c_p = (a + b T) + w (a_k + b_k T), with w the mass fraction of
burnt fuel. The four coefficients are least-squares fits, 280 to 1750 K, to the polynomials of P. P. Walsh and
P. Fletcher, Gas Turbine Performance (2nd ed., 2004), section 3.3; the greatest error is 2.2 %. The linear form makes
enthalpy and entropy explicit both ways, so that no component needs an iteration. R is that of dry air throughout.

The maps of compressors, turbines and nozzle are smooth, in the usual low-order forms (work coefficient over flow
coefficient for a compressor, Stodola's ellipse for a turbine); their constants are chosen, not measured on any engine.

Units: K, J/kg, J/(kg K), kg/s, Pa, m^2.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, log, sqrt

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

    `flow`: corrected design flow, kg/s; `work`: corrected design work, J/kg; `efficiency`: isentropic, at the design
    point; `T_design`: inlet temperature at the design point, K; corrected speed is relative to it; `exponent`: how fast
    the flow falls with speed: more stages, more compressibility, higher; `steepening`: how much faster at low speed;
    `slope`: how fast work falls with flow: speed lines are steep in a multi-stage compressor; `curvature`: of the speed
    lines; `closing`: loss of flow per closing of the vanes, 1/deg; `deloading`: loss of work per closing of the vanes,
    1/deg: pre-swirl lowers the work; `narrow`: loss of efficiency off the design flow coefficient; `off_speed`: loss of
    efficiency off the design speed; `off_vane`: loss of efficiency off the scheduled vane angle, 1/deg^2; `vane_low`:
    scheduled vane angle at `n_low`, deg; `n_low`: corrected speed over design at which the vanes are at `vane_low`.
    """

    flow: float  # corrected design flow, kg/s
    work: float  # corrected design work, J/kg
    efficiency: float  # isentropic, at the design point
    T_design: float  # inlet temperature at the design point, K: corrected speed is relative to it
    exponent: float  # how fast the flow falls with speed: more stages, more compressibility, higher
    steepening: float  # and the more so at low speed
    slope: float  # how fast work falls with flow: speed lines are steep in a multi-stage compressor
    curvature: float
    closing: float  # 1/deg
    deloading: float  # 1/deg: pre-swirl lowers the work
    narrow: float
    off_speed: float
    off_vane: float  # 1/deg^2
    vane_low: float  # deg, scheduled angle at `n_low`
    n_low: float

    def schedule(self, n: float) -> float:
        """Vane angle that suits the corrected speed n, deg: a straight line, 0 at n = 1, `vane_low` at `n_low`."""
        return self.vane_low * min(max((1.0 - n) / (1.0 - self.n_low), -0.2), 1.2)

    def run(
        self, speed: float, phi: float, vane: float, P: float, T: float, health: float
    ) -> tuple[float, float, float, float]:
        """One operating condition."""
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
        return flow, P * pressure_ratio(T, ideal, 0.0), temperature(h + work, 0.0), efficiency


@dataclass(frozen=True)
class TurbineMap:
    """Flow by Stodola's ellipse, efficiency over the ratio of blade speed to spouting velocity.

    W sqrt(T) / P = capacity sqrt(1 - (p / P)^2)
    efficiency    = efficiency (1 - narrow (nu - 1)^2),  nu = speed / sqrt(ideal drop) over its design value

    `capacity`: flow capacity, kg sqrt(K) / (s Pa); `efficiency`: isentropic, at the design point; `drop`: ideal
    enthalpy drop at the design point, J/kg; `narrow`: loss of efficiency off the design velocity ratio.
    """

    capacity: float  # kg sqrt(K) / (s Pa)
    efficiency: float
    drop: float  # ideal enthalpy drop at the design point, J/kg
    narrow: float

    def run(self, speed: float, drop: float, P: float, T: float, w: float) -> tuple[float, float, float]:
        """One operating condition."""
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
