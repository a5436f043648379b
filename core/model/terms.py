# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Terms of the uncertain model, in one table: name, shape, regressor, and where the width goes.

The model is linear in every term. With phi the regressors of the nominal elements and psi those of the half-widths,

    centre = x + dt * (sum of nominal * phi)
    half   = dt * (sum of half-widths * psi), plus those that dt does not multiply

Programmes, bounds, model file, monitor and reports take the terms from `TERMS`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from uncertain_lti.base.arrays import Array


@dataclass(frozen=True)
class Term:
    """One term: nominal elements and half-widths on one regressor.

    `nominal`: name of the nominal elements; empty if there are none; `half`: name of their half-widths, all >= 0;
    `regressor`: what the elements multiply: the state, the control, or 1. The half-widths multiply its absolute value;
    `times_dt`: whether the term is a rate (1/s), which the step multiplies; `required`: whether a model must state it;
    otherwise it is 0 by default; `meaning`: in words; `word`: what rules of a signals file and reports call an additive
    term; empty for the others.
    """

    nominal: str
    half: str
    regressor: Literal["x", "u", "1"]
    times_dt: bool
    required: bool
    meaning: str
    word: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its arrays, nominal elements first."""
        return (self.nominal, self.half) if self.nominal else (self.half,)

    def shape(self, n: int, m: int) -> tuple[int, ...]:
        """Shape of its arrays."""
        return {"x": (n, n), "u": (n, m), "1": (n,)}[self.regressor]


TERMS = (
    Term("A", "dA", "x", True, True, "state matrix"),
    Term("B", "dB", "u", True, True, "control matrix"),
    Term("c", "dc", "1", True, False, "disturbance", "disturbance"),
    Term("", "v", "1", False, False, "measurement noise", "noise"),
)
"""Every term, in the order in which the bounds sum their columns."""

ADDITIVE = tuple(term for term in TERMS if not term.required)
"""The terms that a fit has or not, each on the regressor 1."""
_RATES = tuple(term for term in TERMS if term.times_dt)
HALF_WIDTHS = tuple(term.half for term in TERMS)
"""Names of the half-widths."""
REQUIRED = tuple(name for k in (0, 1) for t in TERMS if t.required for name in t.names[k : k + 1])
"""Names of what a model must state, nominal elements first: A, B, dA, dB."""
ARRAYS = (*REQUIRED, *(name for term in TERMS if not term.required for name in term.names))
"""Names of all arrays of a model, in the order of its file and of its constructor."""
SHAPES = {name: term for term in TERMS for name in term.names}
"""The term of each array."""


def regressors(x: Array, u: Array) -> Array:
    """phi of the terms that the step multiplies: [x; u; 1].

    `x` (n, ...): normalised states; `u` (m, ...): normalised controls; Returns (n + m + 1, ...): φ; ψ is its absolute
    value.
    """
    one = np.ones((1, *x.shape[1:]))
    return np.concatenate([{"x": x, "u": u, "1": one}[term.regressor] for term in _RATES])


def tables(arrays: dict[str, Array]) -> tuple[Array, Array, Array]:
    """Nominal elements and half-widths of the rates side by side, and what dt does not multiply.

    Returns (n, n + m + 1): one column for each of `regressors`; Returns (n,): sum of the half-widths of the other
    terms.
    """

    def side_by_side(which: str) -> Array:
        columns = [arrays[getattr(term, which)] for term in _RATES]
        return np.concatenate([column.reshape(*rows, -1) for column in columns], axis=-1)

    rows = arrays["v"].shape
    others = [arrays[term.half] for term in TERMS if not term.times_dt]
    return side_by_side("nominal"), side_by_side("half"), np.sum(others, axis=0) if len(others) > 1 else others[0]
