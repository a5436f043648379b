# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""A circuit of resistor, capacitor and saturating coil under a random voltage: its regime is the current."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from uncertain_lti.base.arrays import Array
from uncertain_lti.sampling.transient import Transient

R, C, L = 3.0, 270e-9, 50e-6
"""Resistance, ohm; capacitance, F; inductance of the coil without current, H."""
SATURATION = 5.0
"""Current around which the coil saturates, A."""
STEP_NS = 500
"""Step of a run, ns: a 46th of the period of small oscillations."""
BANDWIDTH = 150e3
"""Of the voltage, Hz."""
SUBSTEPS = 10


def inductance(current: ArrayLike) -> Array:
    """Of the coil: L at no current, a tenth of it far above SATURATION.

    The coil of the nonlinear circuit in Forgione and Piga, "Continuous-time system identification with neural
    networks", European Journal of Control 59, 2021.
    """
    magnitude = np.abs(np.asarray(current, dtype=np.float64))
    falls: Array = 0.5 - np.arctan(5.0 * (magnitude - SATURATION)) / np.pi
    return L * (0.9 * falls + 0.1)


def coil_runs(
    seeds: Sequence[int],
    samples: int = 501,
    volts: float = 40.0,
    magnitude: bool = False,
    act: Callable[[Array], Array] | None = None,
    *,
    onset: int = 0,
    more_resistance: float = 1.0,
    more_inductance: float = 1.0,
) -> list[Transient]:
    """Runs from rest: V_C (V) and I_L (A) under V_IN (V), held between samples; integrated by Runge-Kutta, no noise."""
    h = STEP_NS * 1e-9 / SUBSTEPS
    pole = math.exp(-2.0 * math.pi * BANDWIDTH * STEP_NS * 1e-9)
    warm = 200
    white = np.column_stack([np.random.default_rng(seed).standard_normal(samples + warm) for seed in seeds])
    u = np.zeros_like(white)
    for k in range(1, len(u)):
        u[k] = pole * u[k - 1] + math.sqrt(1.0 - pole * pole) * white[k]
    u = volts * u[warm:]
    given = u if act is None else act(u)

    def rate(x: Array, v: Array) -> Array:
        return np.stack([x[1] / C, (v - x[0] - r_factor * R * x[1]) / (l_factor * inductance(x[1]))])

    x = np.zeros((samples, 2, len(seeds)))
    for k in range(samples - 1):
        at = x[k]
        r_factor, l_factor = (more_resistance, more_inductance) if k >= onset else (1.0, 1.0)
        for _ in range(SUBSTEPS):
            a = rate(at, given[k])
            b = rate(at + 0.5 * h * a, given[k])
            c = rate(at + 0.5 * h * b, given[k])
            at = at + h / 6.0 * (a + 2.0 * b + 2.0 * c + rate(at + h * c, given[k]))
        x[k + 1] = at
    runs = []
    for i, seed in enumerate(seeds):
        further: dict[str, Any] = {"s": np.abs(x[:, 1:, i]), "scheduling_names": ["I_L_magnitude"]} if magnitude else {}
        runs.append(
            Transient(
                STEP_NS * np.arange(samples, dtype=np.int64),
                x[:, :, i],
                u[:, i : i + 1],
                name=f"coil, seed {seed}",
                state_names=["V_C", "I_L"],
                control_names=["V_IN"],
                **further,
            )
        )
    return runs
