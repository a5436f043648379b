# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Structure: what is known of single elements before the fit."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import Array, numbers
from uncertain_lti.base.errors import FitError
from uncertain_lti.base.text import finite_data, plural
from uncertain_lti.model.schedule import Schedule
from uncertain_lti.model.terms import ADDITIVE, HALF_WIDTHS, NOMINAL, SHAPES, TERMS
from uncertain_lti.model.uncertain_lti import UncertainLTI

_KEYS = {"state", "from", "nominal", "half_width", "knot", "shared"}


Rows = Sequence[tuple[NDArray[np.bool_], Any]]
"""Which of [x; u] rows have, and the states whose rows they are."""
EVERY: Rows = [(np.ones(1, dtype=bool), slice(None))]
"""Rows that have all of [x; u], however many they are."""


def rows_of(model: UncertainLTI) -> Rows:
    """Which of [x; u] the rows of a model have, each set once: what its structure keeps apart confounds no row."""
    if not model.signals.structure:
        return EVERY
    has = np.concatenate([np.abs(model.A) + model.dA, np.abs(model.B) + model.dB], axis=-1) > 0
    sets, of = np.unique(has.reshape(-1, model.n, model.n + model.m).any(axis=0), axis=0, return_inverse=True)
    return [(row, np.flatnonzero(of.ravel() == i)) for i, row in enumerate(sets)]


def own_of(columns: NDArray[np.intp], row: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Those of some columns of [x; u; further terms] that a row has."""
    return columns[(columns >= len(row)) | row[np.minimum(columns, len(row) - 1)]]


class Structure:
    """Elements fixed to values, or kept within bounds.

    Parameters
    ----------
    n : int
        Number of states.
    m : int
        Number of controls.
    fixed : mapping, optional
        From "A", "B", "c", "dA", "dB", "dc" or "v" to an array of that shape: a number fixes the element, NaN leaves
        it free.
    lower : mapping of str to ArrayLike, optional
        Lower bounds by the same names; NaN for none. A sign constraint is a bound of 0. Half-widths are never below 0.
    upper : mapping of str to ArrayLike, optional
        Upper bounds of the same shape.
    blocks : int, optional
        Of a scheduled model whose blocks differ in what is known of them: every array has a first axis of that
        length. Default: what is known holds for every block, however many there are.
    shared : mapping, optional
        By the same names arrays of bool of the shape of one block: True for an element that is the same in all
        blocks.

    Raises
    ------
    FitError
        A name or shape is unknown, or an element is bounded to nothing; names the element.
    """

    def __init__(
        self,
        n: int,
        m: int,
        fixed: Mapping[str, ArrayLike] | None = None,
        lower: Mapping[str, ArrayLike] | None = None,
        upper: Mapping[str, ArrayLike] | None = None,
        *,
        blocks: int | None = None,
        shared: Mapping[str, ArrayLike] | None = None,
    ) -> None:
        self.n, self.m, self.blocks = n, m, blocks
        one_block = {name: SHAPES[name].shape(n, m) for name in (*NOMINAL, *HALF_WIDTHS)}
        self._shapes = {name: shape if blocks is None else (blocks, *shape) for name, shape in one_block.items()}
        self.shared = {name: np.zeros(shape, dtype=bool) for name, shape in one_block.items()}
        for name, values in (shared or {}).items():
            self._known(name)
            if np.shape(values) != one_block[name] or np.asarray(values).dtype != np.bool_:
                raise FitError(f"structure: shared {name} must be true or false for each element, {one_block[name]}")
            self.shared[name] = np.array(values)
        least = {name: 0.0 if name in HALF_WIDTHS else -math.inf for name in one_block}
        self.lower: dict[str, Array] = {name: np.full(shape, least[name]) for name, shape in self._shapes.items()}
        self.upper: dict[str, Array] = {name: np.full(shape, math.inf) for name, shape in self._shapes.items()}
        for given, targets in ((lower, (self.lower,)), (upper, (self.upper,)), (fixed, (self.lower, self.upper))):
            for name, values in (given or {}).items():
                for target in targets:
                    said = self._read(name, values)
                    target[name] = np.where(np.isnan(said), target[name], said)
        for name in self._shapes:
            low, high = self.lower[name], self.upper[name]
            if ((low == math.inf) | (high == -math.inf)).any():
                raise FitError(f"structure: {name} is to be infinite; give finite numbers, NaN for a free element")
            wrong = np.argwhere(low > high)
            if len(wrong):
                at = tuple(wrong[0].tolist())
                raise FitError(
                    f"structure: {name}{list(at)} is to be at least {low[at]:g} and at most {high[at]:g}; "
                    f"mend one of them"
                )
            if name in HALF_WIDTHS and (low < 0).any():
                at = tuple(np.argwhere(low < 0)[0].tolist())
                raise FitError(f"structure: {name}{list(at)} is a half-width and cannot be below 0")

    @property
    def rows(self) -> NDArray[np.bool_]:
        """Which of [x; u] each row may have, (n, n + m)."""
        free = {name: (self.lower[name] != 0.0) | (self.upper[name] != 0.0) for name in ("A", "dA", "B", "dB")}
        every = np.concatenate([free["A"] | free["dA"], free["B"] | free["dB"]], axis=-1)
        return np.asarray(every.reshape(-1, self.n, self.n + self.m).any(axis=0))

    @property
    def together(self) -> NDArray[np.bool_]:
        """Which two of [x; u] some row may have, (n + m, n + m); a row has its own state, too, if some row has it."""
        rows = self.rows
        np.fill_diagonal(rows, np.diagonal(rows) | np.asarray(rows.any(axis=0))[: self.n])
        return np.asarray(rows.T @ rows)

    @property
    def free(self) -> NDArray[np.bool_]:
        """Of which of [x; u] some row may have anything, (n + m,), where no more is said; none otherwise."""
        used, said = np.asarray(self.rows.any(axis=0)), 0
        for name, low in self.lower.items():
            unbounded = (low == (0.0 if name in HALF_WIDTHS else -math.inf)) & (self.upper[name] == math.inf)
            said += int(np.count_nonzero(~unbounded))
        no_more = self.blocks is None and said == 2 * self.n * np.count_nonzero(~used)
        return used if no_more else np.zeros_like(used)

    @property
    def _shares(self) -> bool:
        """Some element is the same in all blocks."""
        return any(array.any() for array in self.shared.values())

    def _known(self, name: str) -> None:
        if name not in self._shapes:
            raise FitError(f"structure: there is no '{name}'; there are {', '.join(self._shapes)}")

    def _read(self, name: str, values: ArrayLike) -> Array:
        self._known(name)
        return numbers(values, f"structure: {name}", self._shapes[name], FitError)

    @classmethod
    def from_rules(
        cls,
        rules: Any,
        states: Sequence[str],
        controls: Sequence[str],
        source: str = "structure",
        schedule: Schedule | None = None,
    ) -> Structure:
        """From the list under `structure:` in a signals file; `source`: what errors call it.

        Each rule names elements by `state` (the row; `*` for all) and `from` (a state, a control, `disturbance`,
        `noise` or `*` for every state and control), and gives `nominal` and/or `half_width`: a number, or
        {min: a, max: b}. A later rule overrides an earlier one.

        Of a scheduled model, `knot` names the knot or mode that a rule holds for, by its number from 1 on (a list of
        numbers if there are two scheduling signals), or all, which is the default; `shared: true` has the elements be
        the same at all of them.
        """
        n, m = len(states), len(controls)
        structure = cls(n, m, blocks=None if schedule is None else schedule.blocks)
        if not isinstance(rules, list):
            raise FitError(f"{source}: a list of rules is wanted, not {type(rules).__name__}")
        for number, rule in enumerate(rules):
            here = f"{source}[{number}]"
            if not isinstance(rule, dict) or not {"state", "from"} <= set(rule) <= _KEYS:
                raise FitError(
                    f"{here}: a rule has the keys state, from, and nominal and/or half_width, or shared; and knot, if "
                    f"it is not for all knots"
                )
            which = _blocks(rule.get("knot", "all"), schedule, f"{here}: knot")
            same = rule.get("shared", False)
            if not isinstance(same, bool):
                raise FitError(f"{here}: shared is {same!r}; write true or false")
            if "shared" in rule and "knot" in rule and rule["knot"] != "all":
                raise FitError(f"{here}: what is shared is so at all knots; leave out knot, or shared")
            rows = range(n) if rule["state"] == "*" else [_position(rule["state"], states, f"{here}: state")]
            word = "disturbance" if rule["from"] == "drift" else rule["from"]  # as rules had it before
            each = [("A", "dA", j) for j in range(n)] + [("B", "dB", j) for j in range(m)]
            columns: Sequence[tuple[str, str, *tuple[int, ...]]]
            columns = each if word == "*" else [(term.nominal, term.half) for term in ADDITIVE if word == term.word]
            columns = columns or [each[_position(word, (*states, *controls), f"{here}: from")]]
            for i in rows:
                for nominal, half, *column in columns:
                    at = (i, *column)
                    for key, name in (("nominal", nominal), ("half_width", half)):
                        if "shared" in rule and name and (key in rule or not {"nominal", "half_width"} & set(rule)):
                            structure.shared[name][at] = same
                        if key in rule:
                            if not name:
                                raise FitError(f"{here}: {rule['from']} has no nominal value; say half_width")
                            low, high = _range(rule[key], f"{here}: {key}")
                            low = max(low, 0.0) if name in HALF_WIDTHS and low == -math.inf else low
                            for block in which:
                                structure.lower[name][(*block, *at)] = low
                                structure.upper[name][(*block, *at)] = high
        shared = None if schedule is None else structure.shared
        return cls(n, m, lower=structure.lower, upper=structure.upper, blocks=structure.blocks, shared=shared)

    def to_dict(self) -> dict[str, Any]:
        """`lower`, `upper` and `shared` for the model file; null for no bound."""
        data: dict[str, Any] = {"lower": self.lower, "upper": self.upper}
        if self._shares:
            data["shared"] = self.shared
        found: dict[str, Any] = finite_data(data)
        return found

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], n: int, m: int) -> Structure:
        """From what `to_dict` returned."""
        kinds = {"lower": np.float64, "upper": np.float64} | ({"shared": np.bool_} if "shared" in data else {})
        try:
            sides = {
                side: {name: a for name, values in data[side].items() if (a := np.array(values, dtype=kind)).size}
                for side, kind in kinds.items()
            }
            blocks = len(sides["lower"]["A"]) if sides["lower"]["A"].ndim == 3 else None
        except (AttributeError, KeyError, TypeError, ValueError):
            raise FitError("structure: the model file does not hold it as it was written; fit again") from None
        return cls(n, m, **sides, blocks=blocks)

    def unknowns(
        self, names: Collection[str], tied: Sequence[int] = (0,)
    ) -> tuple[list[Array], list[NDArray[np.intp]] | None]:
        """Bounds of the unknowns in their order, and which of them are one; None if each is its own.

        `names`: arrays of the additive terms that the fit has; `tied`: of each block the one whose elements it has.
        Bounds are the least and the greatest theta, (r, n) each, and the least and the greatest d, (q, n). Those that
        are one: of each theta, and of each d, the position of the first of them.
        """
        additive = [name for which in ("nominal", "half") for term in ADDITIVE if (name := getattr(term, which))]
        for name in additive:
            forced = (self.lower[name] > 0) | (self.upper[name] < 0)
            if name not in names and forced.any():
                raise FitError(f"structure: {name} is not 0, and the fit has no such term; choose another additive")
        if self.blocks not in (None, len(tied)):
            raise FitError(f"structure is for {plural(self.blocks, 'block')}, and the fit has {len(tied)}")
        shares = any(r != block for r, block in enumerate(tied)) or (self._shares and len(tied) > 1)
        bounds, first = list[Array](), list[NDArray[np.intp]]()
        for which in ("nominal", "half"):
            low, high = (
                np.vstack([row for r in tied for row in self._columns(side, which, names, r)])
                for side in (self.lower, self.upper)
            )
            if shares:
                same = np.vstack(self._columns(self.shared, which, names, None))
                place = np.arange(len(same))[:, None]
                first.append(np.vstack([np.where(same, place, r * len(same) + place) for r in tied]))
                low, high = _narrowed(low, high, first[-1])
            bounds += [low, high]
        return bounds, first if shares else None

    def _columns(
        self, arrays: Mapping[str, NDArray[Any]], which: str, names: Collection[str], block: int | None
    ) -> list[NDArray[Any]]:
        """The arrays of the unknowns of a block, one row per column of the regressors; None for those of one block."""
        return [
            np.atleast_2d((arrays[name] if self.blocks is None or block is None else arrays[name][block]).T)
            for term in TERMS
            if (name := getattr(term, which)) and (term.required or name in names)
        ]


def _narrowed(low: Array, high: Array, first: NDArray[np.intp]) -> tuple[Array, Array]:
    """Bounds that hold for every element that is one with others; `first`: as of `Structure.unknowns`."""
    rows = np.arange(low.shape[1])
    most, least = np.full(low.shape, -math.inf), np.full(high.shape, math.inf)
    np.maximum.at(most, (first, rows), low)
    np.minimum.at(least, (first, rows), high)
    low, high = most[first, rows], least[first, rows]
    if (low > high).any():
        raise FitError(
            "structure: an element that is the same at several knots has other bounds at each of them, which no "
            "number meets; give it one rule for all knots"
        )
    return low, high


def _blocks(knot: Any, schedule: Schedule | None, where: str) -> Sequence[tuple[int, ...]]:
    """Blocks that a rule holds for, as their arrays are indexed: without a schedule they have no axis of them."""
    if knot == "all":
        return [()] if schedule is None else [(r,) for r in range(schedule.blocks)]
    if schedule is None:
        raise FitError(f"{where} is {knot!r}, and the model has no schedule; leave it out")
    numbers = knot if isinstance(knot, list) else [knot]
    sizes = [len(axis) for axis in schedule.axes]
    wanted = "a number" if len(sizes) == 1 else "a list of two numbers"
    if len(numbers) != len(sizes) or any(isinstance(k, bool) or not isinstance(k, int) for k in numbers):
        raise FitError(f"{where} is {knot!r}; write {wanted}, or all")
    for k, axis in zip(numbers, schedule.axes, strict=True):
        if not 1 <= k <= len(axis):
            raise FitError(f"{where} is {knot!r}; '{axis.signal}' has {len(axis)}, counted from 1")
    return [(schedule.indices.index(tuple(k - 1 for k in numbers)),)]


def _position(name: Any, names: Sequence[str], where: str) -> int:
    if name not in names:
        raise FitError(f"{where}: there is no '{name}'; there are {', '.join(names)}")
    return list(names).index(name)


def _number(value: Any) -> Any:
    """A number that YAML 1.1 reads as text, such as 1.0e9; any other value as it is."""
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


def _range(value: Any, where: str) -> tuple[float, float]:
    if isinstance(value, dict) and value and set(value) <= {"min", "max"}:
        low, high = value.get("min", -math.inf), value.get("max", math.inf)
    else:
        low = high = value
    low, high = _number(low), _number(high)
    for number in (low, high):
        if isinstance(number, bool) or not isinstance(number, (int, float)) or math.isnan(number):
            raise FitError(f"{where} is {value!r}; write a number, or {{min: a, max: b}}")
    return float(low), float(high)
