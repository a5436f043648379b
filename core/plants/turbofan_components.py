# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Performance of the turbofan's components: smooth analytical maps of compressors, turbines and the nozzle.

The forms are the usual low-order ones (work coefficient over flow coefficient for a compressor, Stodola's ellipse for
a turbine); their constants are chosen, not measured on any engine, and each field has the reason in a comment.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

from uncertain_lti.plants import turbofan_gas as gas

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
        h = gas.enthalpy(T, 0.0)
        ideal = gas.temperature(h + efficiency * work, 0.0)
        return flow, P * gas.pressure_ratio(T, ideal, 0.0), gas.temperature(h + work, 0.0), efficiency


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
        h = gas.enthalpy(T, w)
        ratio = gas.pressure_ratio(T, gas.temperature(h - drop, w), w)
        flow = self.capacity * P / sqrt(T) * sqrt(max(1.0 - ratio * ratio, 1e-12))
        d = speed / sqrt(drop / self.drop) - 1.0
        efficiency = self.efficiency * (1.0 - self.narrow * d * d)
        return flow, P * ratio, gas.temperature(h - efficiency * drop, w)


def burn(air: float, T: float, fuel: float, efficiency: float) -> tuple[float, float]:
    """Combustor: exit temperature from the heat balance."""
    w = fuel / (air + fuel)
    heat = (1.0 - w) * (gas.enthalpy(T, 0.0) - gas.enthalpy(gas.T_REFERENCE, 0.0)) + w * efficiency * gas.HEATING_VALUE
    return gas.temperature(gas.enthalpy(gas.T_REFERENCE, w) + heat, w), w


def nozzle(area: float, P: float, T: float, w: float, ambient: float, velocity: float) -> tuple[float, float]:
    """Convergent nozzle."""
    flow = gas.mass_flow(area, P, T, w, ambient)
    g = gas.gamma(T, w)
    throat = max(ambient, P * (2.0 / (g + 1.0)) ** (g / (g - 1.0)))
    jet = sqrt(max(2.0 * g / (g - 1.0) * gas.R * T * (1.0 - (throat / P) ** ((g - 1.0) / g)), 0.0))
    return flow, flow * jet * velocity + area * (throat - ambient)
