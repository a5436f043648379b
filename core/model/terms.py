# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Terms of the uncertain model, in one table (name, shape, regressor, where the width goes), and arrays of them.

The model is linear in every term. With phi the regressors of the nominal elements and psi those of the half-widths,

    centre = x + dt * (sum of nominal * phi)
    half   = dt * (sum of half-widths * psi), plus those that dt does not multiply

Programmes, bounds, model file, monitor and reports take the terms from `TERMS`.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from uncertain_lti.base.arrays import LARGEST, Array, real
from uncertain_lti.base.errors import ModelError
from uncertain_lti.base.text import plural
from uncertain_lti.kernel.arithmetic import Blocks, centre_and_half


@dataclass(frozen=True)
class Term:
    """One term: nominal elements and half-widths on one regressor.

    `nominal`: name of the nominal elements; empty if there are none; `half`: name of their half-widths, all >= 0;
    `regressor`: what the elements multiply: the state, the control, or 1. The half-widths multiply its absolute value;
    `times_dt`: whether the term is a rate (1/s), which the step multiplies; `required`: whether a model must state it;
    otherwise it is 0 by default; `word`: what rules of a signals file and reports call an additive
    term; empty for the others.
    """

    nominal: str
    half: str
    regressor: Literal["x", "u", "1"]
    times_dt: bool
    required: bool
    word: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its arrays, nominal elements first."""
        return (self.nominal, self.half) if self.nominal else (self.half,)

    def shape(self, n: int, m: int) -> tuple[int, ...]:
        """Shape of its arrays."""
        return {"x": (n, n), "u": (n, m), "1": (n,)}[self.regressor]


TERMS = (
    Term("A", "dA", "x", True, True),
    Term("B", "dB", "u", True, True),
    Term("c", "dc", "1", True, False, "disturbance"),
    Term("", "v", "1", False, False, "noise"),
)
"""Every term, in the order in which the bounds sum their columns."""

ADDITIVE = tuple(term for term in TERMS if not term.required)
"""The terms that a fit has or not, each on the regressor 1."""
_RATES = tuple(term for term in TERMS if term.times_dt)
NOMINAL = tuple(term.nominal for term in TERMS if term.nominal)
"""Names of the nominal elements."""
HALF_WIDTHS = tuple(term.half for term in TERMS)
"""Names of the half-widths."""
REQUIRED = tuple(name for k in (0, 1) for t in TERMS if t.required for name in t.names[k : k + 1])
"""Names of what a model must state, nominal elements first: A, B, dA, dB."""
ARRAYS = (*REQUIRED, *(name for term in TERMS if not term.required for name in term.names))
"""Names of all arrays of a model, in the order of its file and of its constructor."""
SHAPES = {name: term for term in TERMS for name in term.names}
"""The term of each array."""


class Elements:
    """The arrays of one envelope, read-only; with a schedule of R blocks each has a leading axis of R.

    `given`: by the names of `ARRAYS`; what is not there, or is None and not required, is 0. `where`: begins the name of
    each in errors; `lead`: (R,), or () without a schedule; default as A has it.
    """

    A: Array
    B: Array
    dA: Array
    dB: Array
    c: Array
    dc: Array
    v: Array

    def __init__(self, given: Mapping[str, Any], where: str = "", lead: tuple[int, ...] | None = None) -> None:
        A, B = (checked(given[name], f"{where}{name}", None) for name in ("A", "B"))
        lead = A.shape[:-2][:1] if lead is None else lead
        each = f", once for each of {plural(lead[0], 'block')}" if lead else ""
        n, m = A.shape[-1] if A.ndim else 0, B.shape[-1] if B.size else 0
        if A.shape != (*lead, n, n) or n == 0:
            raise ModelError(f"{where}A has shape {A.shape}; it must be square, one row per state{each}")
        if B.size and B.shape != (*lead, n, m):
            raise ModelError(f"{where}B has shape {B.shape}; it must have {plural(n, 'row')}, one per state{each}")
        for name in ARRAYS:
            shape = (*lead, *SHAPES[name].shape(n, m))
            absent = name not in given or (given[name] is None and name not in REQUIRED)
            array = checked(np.zeros(shape) if absent else given[name], f"{where}{name}", shape, name in HALF_WIDTHS)
            array.flags.writeable = False
            setattr(self, name, array)

    @property
    def n(self) -> int:
        """Number of states."""
        return int(self.A.shape[-1])

    @property
    def m(self) -> int:
        """Number of controls."""
        return int(self.B.shape[-1])

    @property
    def arrays(self) -> dict[str, Array]:
        """All of them, by name."""
        return {name: getattr(self, name) for name in ARRAYS}

    @cached_property
    def tables(self) -> tuple[Array, Array, Array]:
        """Nominal elements and half-widths (n, n + m + 1) on [x; u; 1], and what dt does not multiply (n,)."""
        rows = self.v.shape
        every = [term.nominal for term in _RATES], [term.half for term in _RATES]
        each = ([getattr(self, name).reshape(*rows, -1) for name in names] for names in every)
        nominal, half = (np.concatenate(arrays, axis=-1) for arrays in each)
        return nominal, half, reduce(np.add, [getattr(self, term.half) for term in TERMS if not term.times_dt])

    def centre_and_half_at(
        self, z: Array, dt: Array, base: Array | None = None, blocks: Blocks | None = None, s: Array | None = None
    ) -> tuple[Array, Array]:
        """Centre and half-width (n, K) of the envelope at normalised [x; u] = z (n + m, K).

        `dt` (K,): s; `base` (n, K): what the rates are added to, default the states; `blocks`, `s` (axes, K): of a
        schedule, and where it is.
        """
        centre, half = np.empty((self.n, len(dt))), np.empty((self.n, len(dt)))
        centre_and_half(self.tables, z, dt, centre, half, blocks, s, base)
        return centre, half

    def fits(self, other: Elements, name: str) -> None:
        """Refuse the elements of another envelope, called so, if it has other states, controls or blocks."""
        if (other.A.shape, other.B.shape) != (self.A.shape, self.B.shape):
            raise ModelError(
                f"{name}: A {other.A.shape} and B {other.B.shape} do not fit the model, whose A is {self.A.shape} and "
                f"B {self.B.shape}"
            )

    def blocks_to_list(self, names: Sequence[str] = ARRAYS) -> list[dict[str, Any]]:
        """Of each block the arrays of these names, as they are in a model file."""
        blocks = range(len(self.A)) if self.A.ndim > 2 else [...]
        return [{name: getattr(self, name)[r].tolist() for name in names} for r in blocks]


def checked(value: ArrayLike, name: str, shape: tuple[int, ...] | None, half_width: bool = False) -> Array:
    """An array of a model, held to its shape."""
    try:
        if isinstance(value, Sequence) and not _numbers_only(value):
            raise TypeError
        array = real(value)
    except (TypeError, ValueError, OverflowError):
        raise ModelError(f"field '{name}' is not an array of numbers") from None
    if shape is not None and array.shape != shape:
        if array.size == 0 and 0 in shape:
            return np.zeros(shape)
        raise ModelError(f"field '{name}' has shape {array.shape}; it must be {shape}")
    if not np.isfinite(array).all():
        raise ModelError(f"field '{name}' holds a number that is not finite")
    if (np.abs(array) > LARGEST).any():
        raise ModelError(f"field '{name}' holds a number above {LARGEST:g}, which the arithmetic cannot carry")
    if half_width and (array < 0).any():
        raise ModelError(f"field '{name}' holds a negative half-width")
    return array


def is_whole(value: Any) -> bool:
    """Whether it is a whole number, and no truth value."""
    return isinstance(value, int) and not isinstance(value, bool)


def is_number(value: Any) -> bool:
    """Whether it is a finite number, and no truth value."""
    try:
        return not isinstance(value, bool) and isinstance(value, (int, float)) and math.isfinite(value)
    except OverflowError:
        return False


def _numbers_only(value: Any) -> bool:
    """No texts, truth values or nulls, which numpy would turn into numbers."""
    if isinstance(value, (list, tuple)):
        return all(_numbers_only(v) for v in value)
    return not isinstance(value, (str, bool)) and value is not None


def blocks_of(
    data: Any,
    name: str,
    n: int,
    m: int,
    blocks: int | None,
    names: Sequence[str] = ARRAYS,
    needed: Collection[str] = REQUIRED,
    also: Collection[str] = (),
) -> dict[str, Array]:
    """The arrays of the blocks of a schedule, or of the only one, of a model file."""
    if not isinstance(data, list) or len(data) != (blocks or 1):
        one_each = "" if blocks is None else ", one per knot or mode"
        raise ModelError(f"field '{name}' must be a list of {plural(blocks or 1, 'block')}{one_each}")
    arrays: dict[str, list[Array]] = {array: [] for array in names}
    for r, block in enumerate(data):
        object_of(block, f"{name}[{r}]", {*names, *also}, needed)
        for array, values in arrays.items():
            shape = SHAPES[array].shape(n, m)
            value = np.zeros(shape) if block.get(array) is None else block[array]
            values.append(checked(value, f"{name}[{r}].{array}", shape, array in HALF_WIDTHS))
    return {array: values[0] if blocks is None else np.stack(values) for array, values in arrays.items()}


def object_of(
    data: Any, name: str, known: Collection[str] | None = None, needed: Collection[str] = (), remedy: str = ""
) -> dict[str, Any]:
    """An object of a model file, its fields checked."""
    if not isinstance(data, Mapping):
        raise ModelError(f"field '{name}' is not an object")
    within = f"{name}." if name else ""
    for key in needed:
        if key not in data:
            raise ModelError(f"field '{within}{key}' is missing; {remedy or 'fit the model again'}")
    for key in data:
        if known is not None and key not in known:
            unknown = f"{within}{reprlib.repr(key)[1:-1]}"
            raise ModelError(f"unknown field '{unknown}'; known are {', '.join(sorted(known))}")
    return dict(data)
