# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Memory: what a fit keeps of its recordings, so that a later one with further recordings can be proven the optimum.

Kept are the sums that the objectives need, the transitions that decide, and of the others, by recording, how far they
are from mattering. With the size of a transition

    size² = (Δt φ)ᵀ P⁻¹ (Δt φ) + (Δt ψ)ᵀ Q⁻¹ (Δt ψ),

P and Q the means of the squares over all, its slack, half-width less |x_next - centre|, falls at most by size times
(Δθᵀ P Δθ + Δdᵀ Q Δd)^(1/2) as the elements change by Δθ and Δd (Cauchy and Schwarz). What half-widths of additive
terms change is known exactly as well, so that they may be left out of Δd.
"""

from __future__ import annotations

import hashlib
from base64 import b64decode, b64encode
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array, Index
from uncertain_lti.base.errors import FitError
from uncertain_lti.identification.columns import Columns
from uncertain_lti.identification.passes import Moments, moments
from uncertain_lti.identification.problem import Problem
from uncertain_lti.model.terms import ARRAYS
from uncertain_lti.model.uncertain_lti import UncertainLTI

BYTES, _PER_STATE, _MOST = 720_000, 90_000, 8_000_000
"""What is kept at most, of all and per state, unless those that decide take more; in the file it takes a third more."""
_GROUPS = 32
"""Recordings, or groups of them, that are told apart at most, of each fit and update."""
_AGAIN = "fit again with all recordings"


class Recording(NamedTuple):
    """A recording that was fitted: its name, and what its transitions are recognised by."""

    name: str
    mark: str

    @classmethod
    def of(cls, name: str, problem: Problem) -> Recording:
        """That of these transitions."""
        return cls(name, _mark((problem.z_columns, problem.next_columns, problem.dt)))


@dataclass(frozen=True)
class Margins:
    """How far transitions that were not kept are from mattering, at the elements of the fit that left them out.

    `theta` (r, n), `d` (q, n): these elements; `nominal` (r, r), `half` (q, q): roots L of P = L Lᵀ and of Q; `steps`
    (2,): shortest and longest Δt, s; `widest` (n,): largest half-width; `groups` (recordings,): the group of each, -1
    for none; of each group `ratio`, `least` (G, n): least slack over size, least slack; `narrow_ratio`, `narrow_least`
    (G, n): the same of `widest` less the half-width; `most`, `narrow_most` (G,): greatest size.
    """

    theta: Array
    d: Array
    nominal: Array
    half: Array
    steps: Array
    widest: Array
    groups: Array
    ratio: Array
    least: Array
    most: Array
    narrow_ratio: Array
    narrow_least: Array
    narrow_most: Array

    def unproven(self, theta: Array, d: Array, widest: Array | None, columns: Columns) -> NDArray[np.bool_]:
        """Groups (G,) of which some transition may be outside with these elements, or wider than `widest` (n,)."""
        more, p = d - self.d, len(d) - len(columns.half)
        nominal = _norms(self.nominal, theta - self.theta)
        inside, narrow = np.zeros((2, *self.ratio.shape), dtype=bool)
        for known in (True, False):  # what additive terms change: exactly, or with all others
            gain, growth, others = np.zeros(len(self.widest)), np.zeros(len(self.widest)), more.copy()
            for j, term in enumerate(columns.half if known else (), start=p):
                each = np.outer(self.steps if term.times_dt else np.ones(1), more[j])
                gain, growth, others[j] = gain + each.min(axis=0), growth + each.max(axis=0), 0.0
            both = _norms(self.half, others)
            falls, rises = (np.minimum(both, _norms(self.half, f(others, 0.0))) for f in (np.minimum, np.maximum))
            inside |= _least_after(self.ratio, self.least, self.most, gain, np.hypot(nominal, falls)) >= 0.0
            if widest is not None:
                room = widest - self.widest - growth
                after = _least_after(self.narrow_ratio, self.narrow_least, self.narrow_most, room, rises)
                narrow |= after >= -1e-12 * widest
        return np.asarray(~(inside & narrow if widest is not None else inside).all(axis=1))


def _norms(root: Array, change: Array) -> Array:
    """(Δᵀ L Lᵀ Δ)^(1/2) of each column (n,), with room for rounding."""
    return np.asarray(np.linalg.norm(root.T @ change, axis=0)) * (1.0 + 1e-6)


def _least_after(ratio: Array, least: Array, most: Array, gain: Array, moved: Array) -> Array:
    """The least that slack + gain - moved x size can be, where slack >= max(least, ratio x size) and size <= most."""
    largest = np.broadcast_to(most[:, None], ratio.shape)
    kink = np.divide(least, ratio, out=np.zeros(ratio.shape), where=ratio > 0.0)
    worst = np.where(ratio > moved, np.minimum(kink, largest), largest)
    return np.asarray(np.maximum(least, ratio * worst) + gain - moved * worst)


@dataclass(frozen=True)
class Memory:
    """What a model keeps of its recordings.

    `kept`: transitions that decide, `source` being the number of their recording; `rest`: sums over the others, None
    if there are none; `margins`: of the others, of each fit and update; `recordings`: all of them.
    """

    kept: Problem
    rest: Moments | None
    margins: tuple[Margins, ...]
    recordings: tuple[Recording, ...]

    def to_dict(self, model: UncertainLTI) -> dict[str, Any]:
        """As it is in the file of its model."""
        of = self.kept
        kept = {"z": of.z_columns, "next": of.next_columns, "dt": of.dt, "source": of.source, "k": of.k}
        return {
            "of": _mark_of(model),
            "columns": sorted(of.columns.names),
            "recordings": [list(recording) for recording in self.recordings],
            "weights": _text(of.weights),
            "kept": {name: _text(values) for name, values in kept.items()},
            "rest": None if self.rest is None else _texts(self.rest),
            "margins": [_texts(each) for each in self.margins],
        }

    @classmethod
    def of(cls, model: UncertainLTI) -> Memory:
        """That of a model; refused with the reason if there is none, or if it is of another model."""
        facts, data = model.fit_summary, model.memory
        for there, what in (
            (model.schedule is not None, "is scheduled"),
            (model.horizons, "has horizons"),
            (facts.get("discard"), "was fitted with transitions to be discarded"),
            (
                facts.get("weights", "ones") not in ("ones", "per state") or facts.get("count", "sample") != "sample",
                "was fitted with weights that differ between samples",
            ),
        ):
            if there:
                raise FitError(f"the model {what}, and only a plain one can be updated; {_AGAIN}")
        if not data:
            raise FitError(f"the model keeps nothing of its recordings, so it cannot be updated; {_AGAIN}")
        if data.get("of") != _mark_of(model):
            raise FitError(f"the model was changed after its fit, and what its file keeps is of another; {_AGAIN}")
        try:
            z, x_next, dt, source, k = (_array(data["kept"][name]) for name in ("z", "next", "dt", "source", "k"))
            columns, weights = Columns(frozenset(data["columns"])), _array(data["weights"])
            kept = Problem(z, x_next, dt, source.astype(np.intp), k.astype(np.intp), weights, columns)
            rest = None
            if data["rest"] is not None:
                found: dict[str, Any] = {name: _array(text) for name, text in data["rest"].items()}
                found |= {name: found[name].item() for name in ("dt_min", "dt_max")}
                found |= {"count": int(found["count"].item()), "visits": found["visits"].astype(np.intp)}
                rest = Moments(**{"gram": None, "coupled": None, **found})
            margins = tuple(Margins(**{name: _array(text) for name, text in each.items()}) for each in data["margins"])
            return cls(kept, rest, margins, tuple(Recording(*each) for each in data["recordings"]))
        except (TypeError, ValueError, KeyError, AttributeError):
            raise FitError(f"field 'memory' of the model file is damaged; {_AGAIN}") from None

    def unproven(self, model: Any, widest: Array | None) -> list[str]:
        """Names of recordings of which some transition may be outside a model, as of `Margins.unproven`."""
        found, columns = set[int](), self.kept.columns
        for each in self.margins:
            wrong = np.flatnonzero(each.unproven(*_elements(model, columns), widest, columns))
            found |= set(np.flatnonzero(np.isin(each.groups, wrong)).tolist())
        return list(dict.fromkeys(self.recordings[number].name for number in sorted(found)))


def remembered(
    model: UncertainLTI,
    problem: Problem,
    recordings: Sequence[Recording],
    rest: Moments | None = None,
    margins: Sequence[Margins] = (),
) -> dict[str, Any] | None:
    """What the file of a model keeps of transitions, beside what was kept of others already.

    None if there is no room for those that decide. `problem`: `source` being the number of the recording, rising.
    """
    n, p, widths = model.n, problem.p, model.fit_summary["criterion"] == "lp"
    unknowns = problem.columns.unknowns(p)
    taken = sum(getattr(one, field.name).size for one in margins for field in fields(one))
    taken += 4 * n * min(len(recordings), _GROUPS) + 2 * n * unknowns + 4 * (p + 2) ** 2
    each = p + n + 3
    room = max(min(n * _PER_STATE, BYTES), min(12 * n * unknowns * each, _MOST)) // 8
    most = (room - taken) // each
    if problem.N > most:
        narrow = most // (3 * n) if widths else 0
        if (count := most // n - narrow) <= unknowns:
            return None
        sums = moments(problem)[0]
        measure = _Measure.of(model, problem, sums if rest is None else sums + rest)
        kept = measure.nearest(problem, count, narrow)
        chosen = problem.subset(kept)
        left = sums - moments(chosen)[0]
        rest = left if rest is None else rest + left
        margins = (*margins, measure.margins(problem, kept, len(recordings)))
        problem = chosen
    return Memory(problem, rest, tuple(margins), tuple(recordings)).to_dict(model)


@dataclass(frozen=True)
class _Measure:
    """Slack and size of transitions at the elements of a model; attributes as those of `Margins`."""

    model: UncertainLTI
    columns: Columns
    nominal: Array
    half: Array
    steps: Array
    widest: Array

    @classmethod
    def of(cls, model: UncertainLTI, problem: Problem, sums: Moments) -> _Measure:
        nominal, half = _root(sums.centre / sums.count), _root(sums.plain_gram / sums.count)
        widest = 0.5 * np.asarray(model.fit_summary["max_width"])
        return cls(model, problem.columns, nominal, half, np.array([sums.dt_min, sums.dt_max]), widest)

    def over(self, problem: Problem) -> Iterator[tuple[slice, tuple[Array, Array], tuple[Array, Array]]]:
        """Of the transitions of each block slack (n, K) and size (K,), and the same of how much narrower they are."""
        to_nominal, to_half = np.linalg.inv(self.nominal), np.linalg.inv(self.half)
        for block in problem.blocks():
            wide = np.square(to_half @ (self.columns.psi(block.z, block.dt, None) * block.dt)).sum(axis=0)
            size = np.square(to_nominal @ (self.columns.phi(block.z, None) * block.dt)).sum(axis=0) + wide
            centre, half = self.model.columns_centre_and_half(np.ascontiguousarray(block.z), block.dt)
            slack, narrow = half - np.abs(block.x_next - centre), np.maximum(self.widest[:, None] - half, 0.0)
            yield slice(block.start, block.start + len(block)), (slack, np.sqrt(size)), (narrow, np.sqrt(wide))

    def nearest(self, problem: Problem, count: int, narrow_count: int) -> Index:
        """The transitions of least slack for their size, so many per row, and those least narrow for theirs."""
        counts, n = (count, narrow_count), self.model.n
        best = [(np.full((n, c), 1e300), np.zeros((n, c), np.intp)) for c in counts]
        for part, *measured in self.over(problem):
            for number, (slack, size) in enumerate(measured[: 2 if narrow_count else 1]):
                values, held = best[number]
                near = np.flatnonzero((slack <= values.max(axis=1)[:, None] * size).any(axis=0))
                values = np.hstack([values, slack[:, near] / np.maximum(size[near], 1e-300)])
                least = np.argpartition(values, counts[number], axis=1)[:, : counts[number]]
                index = np.broadcast_to(near + part.start, (n, len(near)))
                held = np.take_along_axis(np.hstack([held, index]), least, axis=1)
                best[number] = np.take_along_axis(values, least, axis=1), held
        return np.unique(np.concatenate([held[values < 1e300] for values, held in best]))

    def margins(self, problem: Problem, kept: Index, recordings: int) -> Margins:
        """Those of the transitions that are not kept."""
        left = np.ones(problem.N, dtype=bool)
        left[kept] = False
        present = np.unique(problem.source[left])
        groups = np.full(recordings, -1)
        for number, some in enumerate(np.array_split(present, min(len(present), _GROUPS))):
            groups[some] = number
        count = int(groups.max(initial=-1)) + 1
        ratios, leasts = np.full((2, 2, count, self.model.n), np.inf)
        greatest = np.zeros((2, count))
        for part, *measured in self.over(problem):
            of = groups[problem.source[part]]
            starts = np.flatnonzero(np.diff(of, prepend=-2))
            for number, (slack, size) in enumerate(measured):
                slack[:, ~left[part]], size[~left[part]] = np.inf, 0.0  # they count for none, not even the last group
                ratio = np.minimum.reduceat(slack / np.maximum(size, 1e-300), starts, axis=1).T
                np.minimum.at(ratios[number], of[starts], ratio)
                np.minimum.at(leasts[number], of[starts], np.minimum.reduceat(slack, starts, axis=1).T)
                np.maximum.at(greatest[number], of[starts], np.maximum.reduceat(size, starts))
        return Margins(
            *_elements(self.model, self.columns),
            self.nominal,
            self.half,
            self.steps,
            self.widest,
            groups.astype(np.float64),
            *(ratios[0], leasts[0], greatest[0]),
            *(ratios[1], leasts[1], greatest[1]),
        )


def _root(gram: Array) -> Array:
    """L of L Lᵀ, a little more than a Gram matrix; columns that are 0 everywhere do not count."""
    scale = np.maximum(np.sqrt(np.diagonal(gram)), 1e-150)
    return np.asarray(scale[:, None] * np.linalg.cholesky(gram / np.outer(scale, scale) + 1e-9 * np.eye(len(gram))))


def _elements(model: Any, columns: Columns) -> tuple[Array, Array]:
    """Elements as `Columns.arrays` takes them."""
    theta = [model.A.T, model.B.T, *(getattr(model, term.nominal)[None] for term in columns.nominal)]
    d = [model.dA.T, model.dB.T, *(getattr(model, term.half)[None] for term in columns.half)]
    return np.vstack(theta), np.vstack(d)


def _mark(arrays: Sequence[Array]) -> str:
    mark = hashlib.sha256()
    for row in (row for array in arrays for row in np.atleast_2d(array)):
        mark.update(np.ascontiguousarray(row, dtype="<f8").data)
    return mark.hexdigest()[:16]


def _mark_of(model: UncertainLTI) -> str:
    """What a model is recognised by: its elements and its operating point."""
    return _mark(
        [*(getattr(model, name) for name in ARRAYS), model.operating_point.steady, model.operating_point.scale]
    )


def _text(values: Any) -> list[Any]:
    array = np.atleast_1d(np.asarray(values, dtype="<f8"))
    return [*array.shape, b64encode(np.ascontiguousarray(array).tobytes()).decode()]


def _texts(part: Margins | Moments) -> dict[str, Any]:
    each = {field.name: getattr(part, field.name) for field in fields(part)}
    return {name: _text(values) for name, values in each.items() if values is not None}


def _array(text: Sequence[Any]) -> Array:
    *shape, data = text
    return np.frombuffer(b64decode(data, validate=True), dtype="<f8").reshape(shape).astype(np.float64)
