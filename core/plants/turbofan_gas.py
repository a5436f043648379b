# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Thermodynamic properties of air and of kerosene's combustion products.

Ideal gas whose specific heat is linear in temperature, c_p = (a + b T) + w (a_k + b_k T), with w the mass fraction of
burnt fuel. The four coefficients are least-squares fits, 280 to 1750 K, to the polynomials of P. P. Walsh and
P. Fletcher, Gas Turbine Performance (2nd ed., 2004), section 3.3; the greatest error is 2.2 %. The linear form makes
enthalpy and entropy explicit both ways, so that no component needs an iteration. R is that of dry air throughout.

Units: K, J/kg, J/(kg K), kg/s, Pa, m^2.
"""

from __future__ import annotations

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
