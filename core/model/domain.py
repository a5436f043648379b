# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Where a model applies: the steps and the ranges that its fit saw."""

from __future__ import annotations

import math
import reprlib
from base64 import b64decode, b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import LARGEST, Array
from uncertain_lti.base.errors import ModelError
from uncertain_lti.base.text import apart, list_of, numbers_of, plural, shortlist
from uncertain_lti.kernel.arithmetic import outside_domain, pair_count
from uncertain_lti.model.operating_point import recorded
from uncertain_lti.model.terms import is_whole, object_of


@dataclass(frozen=True)
class Sampling:
    """Median, shortest and longest step of the recordings that a model was fitted to, s; None where none was."""

    dt_median: float | None = None
    dt_min: float | None = None
    dt_max: float | None = None

    @property
    def step_range(self) -> tuple[float, float]:
        """Shortest and longest step that is judged, s: half of and twice those that the model was fitted to."""
        least = 0.0 if self.dt_min is None else 0.5 * self.dt_min
        return least, np.inf if self.dt_max is None else 2.0 * self.dt_max


MOST_CELLS = 24
"""Cells per range: two values apart by less than about two of them are not told apart."""
_PER_CELL = 16


def cells_for(count: int) -> int:
    """How many cells each range is divided into; 0 if the samples are too few to say where there were none."""
    cells = min(MOST_CELLS, math.isqrt(count // _PER_CELL))
    return cells if cells >= 4 else 0


@dataclass(frozen=True, eq=False)
class Occupancy:
    """Which combinations of two signals the fit saw: for each pair of them a grid over their ranges.

    A box holds every level between two that were fitted, and every jump from one level to another; a grid does not.

    `cells`: cells per range; `occupied` (pairs, cells, cells): pairs 01, 02, 12, ... of signals; a cell is true if a
    fitted sample lies in it or in one next to it.
    """

    cells: int
    occupied: NDArray[np.bool_]

    @classmethod
    def of(cls, visited: NDArray[np.bool_]) -> Occupancy:
        """From the cells that fitted samples lie in.

        `visited` (pairs, cells, cells): without their neighbours.
        """
        wide = np.pad(visited, ((0, 0), (1, 1), (1, 1)))
        cells = visited.shape[1]
        near = [wide[:, i : i + cells, j : j + cells] for i in range(3) for j in range(3)]
        return cls(cells, np.logical_or.reduce(near))

    def among(self, together: NDArray[np.bool_]) -> Occupancy:
        """The same, but that any combination counts as seen of two signals that no row of the model has both.

        `together` (n + m, n + m): which two some row has.
        """
        apart = [not together[pair] for pair in combinations(range(len(together)), 2)]
        return Occupancy(self.cells, self.occupied | np.array(apart or [False])[:, None, None])

    def within(self, before: Domain, low: Array, high: Array) -> NDArray[np.bool_]:
        """The same combinations on a grid of as many cells over larger ranges; every cell that a cell lies in.

        `before`: whose ranges the grid has now; `low`, `high` (n + m,): the larger ones.
        """
        span, edges = np.maximum(high - low, 1e-300), np.arange(self.cells) / self.cells
        least = np.concatenate((before.x_min, before.u_min))
        own = np.concatenate((before.x_max, before.u_max)) - least
        begin = ((least - low) / span)[:, None] + (own / span)[:, None] * edges
        end = begin + (wide := (own / span / self.cells)[:, None])
        begin[:, :1] -= wide + 2e-9  # an outermost cell has a neighbour now, which is near what lies at its edge
        end[:, -1:] += wide + 2e-9
        first, last = (np.clip((e * self.cells).astype(int), 0, self.cells - 1) for e in (begin + 1e-9, end - 1e-9))
        cells = np.arange(self.cells)[:, None]
        lies = (cells >= first[:, None]) & (cells <= np.maximum(first, last)[:, None])  # (n + m, larger, own)
        pairs = list(combinations(range(len(low)), 2)) or [(0, 0)]
        return np.array([lies[i] @ held @ lies[j].T for (i, j), held in zip(pairs, self.occupied, strict=True)])

    def to_dict(self) -> dict[str, Any]:
        """As it stands in a model file."""
        return {"cells": self.cells, "occupied": b64encode(np.packbits(self.occupied).tobytes()).decode()}

    @classmethod
    def from_dict(cls, data: Any, size: int) -> Occupancy:
        """From a model file."""
        keys = "cells", "occupied"
        cells, text = (object_of(data, "domain.measure", keys, keys)[key] for key in keys)
        if not (is_whole(cells) and 2 <= cells <= 64):
            must = "it must be a whole number, 2 to 64"
            raise ModelError(f"field 'domain.measure.cells' is {reprlib.repr(cells)}; {must}")
        shape = (pair_count(size), cells, cells)
        try:
            packed = np.frombuffer(b64decode(text, validate=True), dtype=np.uint8)
        except (TypeError, ValueError):
            raise ModelError("field 'domain.measure.occupied' is not base64; fit the model again") from None
        if len(packed) != (size_of := -(-math.prod(shape) // 8)):
            raise ModelError(
                f"field 'domain.measure.occupied' holds {len(packed)} bytes, and {plural(size, 'signal')} with {cells} "
                f"cells take {size_of}; fit the model again"
            )
        return cls(cells, np.unpackbits(packed, count=math.prod(shape)).astype(bool).reshape(shape))


@dataclass(frozen=True)
class Domain:
    """Normalised ranges seen in the fit, and the combinations in them; without end where nothing was fitted.

    `x_min` (n,): least states; `x_max` (n,): greatest states; `u_min` (m,): least controls; `u_max` (m,): greatest
    controls; `measure`: combinations within the box; `step_max` (n,): largest change of each state in one step,
    normalised; default unknown; `anywhere` (n + m,): signals that the structure has in no row, which have no range to
    leave; default none.
    """

    x_min: Array
    x_max: Array
    u_min: Array
    u_max: Array
    measure: Occupancy | None = None
    step_max: Array | None = None
    anywhere: Sequence[bool] | None = None

    @property
    def least(self) -> Array:
        """Least [x; u] (n + m,)."""
        return self._end((self.x_min, self.u_min), -LARGEST)

    @property
    def greatest(self) -> Array:
        """Greatest [x; u] (n + m,)."""
        return self._end((self.x_max, self.u_max), LARGEST)

    def span(self, X: Array) -> Array:
        """Recorded range of each state (n,), by the scale of each."""
        return (self.x_max - self.x_min) * X

    def _end(self, of: tuple[Array, Array], beyond: float) -> Array:
        ends = np.concatenate(of)
        return ends if self.anywhere is None else np.where(self.anywhere, beyond, ends)

    def beyond(self, z: Array) -> NDArray[np.bool_]:
        """Whether columns z = [x; u; ...] (n + m + q, K) leave the box in some element by more than a tenth of it."""
        return np.asarray(outside_domain(z[: len(self.least)], self.least, self.greatest))

    def outside(self, x: ArrayLike, u: ArrayLike) -> NDArray[np.bool_]:
        """Whether z = [x; u] leaves the box as `beyond` says, or is a combination that was not fitted."""
        x, u = np.asarray(x, dtype=np.float64), np.asarray(u, dtype=np.float64)
        lead = np.broadcast_shapes(x.shape[:-1], u.shape[:-1])
        z = np.concatenate([np.broadcast_to(v, (*lead, v.shape[-1])) for v in (x, u)], axis=-1)
        occupied = None if self.measure is None else self.measure.occupied
        columns = z.reshape(-1, z.shape[-1]).T
        return np.asarray(outside_domain(columns, self.least, self.greatest, occupied)).reshape(lead)


UNVOUCHED, STRANGE = 0.2, 0.5
"""Share of the verdicts outside the fitted domain from which on their quiet says nothing, unless what was left out of a
fit had as many; there, or in alarm from early on, from which on the machine may be another, whatever was left out."""
_PAIRS_IN, _NAMED = 2000, 3  # samples whose combinations are looked at, and signals or pairs of them that are named


def vouched(model: Any) -> float:
    """Share of the verdicts that may be outside the fitted domain: the alarm was learnt on what was left out."""
    parts = [part for part in list_of((model.validation or {}).get("part")) if isinstance(part, Mapping)]
    counts = [numbers_of([part.get("outside_domain"), part.get("verdicts")], 2) for part in parts]
    shares = [outside / judged for outside, judged in filter(None, counts) if judged > 0]
    return float(min(max([UNVOUCHED, *shares]), STRANGE))


def outside_in_words(model: Any, z: Array) -> str:
    """Which signals of some samples [x; u; ...] (n + m + q, K), normalised, lie beyond what was fitted, and where.

    Those that do most often come first; then the pairs of signals whose combination was not fitted, where no signal
    lies beyond its own range.
    """
    domain, point, found = model.domain, model.operating_point, []
    least, greatest, signals = domain.least, domain.greatest, model.signals.signals
    z = z[: len(least)]
    beyond = np.array([outside_domain(z[i : i + 1], least[i : i + 1], greatest[i : i + 1]) for i in range(len(z))])
    for i in np.argsort(-beyond.sum(axis=1), kind="stable")[: beyond.any(axis=1).sum()].tolist():
        there = z[i, beyond[i]]
        ends = np.array([there.min(), there.max(), least[i], greatest[i]])
        low, high, *fitted = apart(recorded(ends, float(point.steady[i]), float(point.scale[i])).tolist())
        at = " to ".join(dict.fromkeys((low, high)))
        found.append(f"{signals[i].name} at {at} (fitted: {' to '.join(fitted)})")
    others = np.flatnonzero(~beyond.any(axis=0))
    if domain.measure is None or len(others) <= z.shape[1] // 2:
        return shortlist(found, _NAMED)
    some = np.ascontiguousarray(z[:, others[:: -(-len(others) // _PAIRS_IN)]])
    counts = {
        (i, j): int(outside_domain(some[[i, j]], least[[i, j]], greatest[[i, j]], held[None]).sum())
        for (i, j), held in zip(combinations(range(len(z)), 2), domain.measure.occupied, strict=False)
    }
    pairs = sorted((pair for pair, count in counts.items() if count), key=lambda pair: -counts[pair])
    named = [f"{signals[i].name} with {signals[j].name}" for i, j in pairs]
    together = [f"combinations of {shortlist(named, _NAMED)} that were not fitted"] if named else []
    return "; ".join([*filter(None, [shortlist(found, _NAMED)]), *together])


def largest_steps(model: Any, found: Iterable[Any]) -> Array:
    """The largest change of each state in one transition (n,), normalised; `found`: of recordings, `repeats.Found`."""
    largest = np.max([np.zeros(model.n), *(one.largest for one in found)], axis=0)
    return np.asarray(np.minimum(largest / model.operating_point.X, LARGEST))


def jumps(model: Any, before: ArrayLike, after: ArrayLike) -> tuple[Array, Array]:
    """How far states moved in one step, where that is farther than ever in the fit.

    Returns (n,): the largest of the fit, recorded units; infinite where that is not known.
    """
    known = model.domain.step_max
    limit = np.full(model.n, np.inf) if known is None else known * model.operating_point.X
    with np.errstate(over="ignore", invalid="ignore"):
        change = np.asarray(after, dtype=np.float64) - np.asarray(before, dtype=np.float64)
    # the product with the scale rounds: what is as large as the largest of the fit is not larger
    return np.where(np.abs(change) > limit * (1.0 + 1e-9), change, 0.0), limit


def jump_words(name: str, change: float, largest: float) -> str:
    """What is said of a jump."""
    return f"{name} jumped by {change:.3g} in one step (at most {largest:.3g} in the fit)"


def jumps_in_words(model: Any, before: Sequence[float], after: Sequence[float], flags: Sequence[float]) -> list[str]:
    """What is said of the states that jumped out of their bounds."""
    if model.domain.step_max is None:
        return []
    change, limit = jumps(model, before[: model.n], after)
    rows = zip(model.state_names, change.tolist(), limit.tolist(), flags, strict=True)
    return [jump_words(name, by, most) for name, by, most, flag in rows if by and flag == 1.0]
