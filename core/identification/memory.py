# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Memory: what a fit keeps of its recordings, so that a later one with further recordings can be proven the optimum.

Kept are the sums that the objectives need, the transitions that decide, to the bit, and of the others boxes: in what
range the values of a few that follow each other are, in a byte each and rounded outwards, and what room they leave.
Room is linear in the elements with coefficients within the box, so that an interval of each product bounds what is
left of it at other elements.
"""

from __future__ import annotations

import hashlib
from base64 import b64decode, b64encode
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import WORTH_THREADS, Array, Index, on_cores
from uncertain_lti.base.errors import FitError
from uncertain_lti.identification.passes import Moments, moments
from uncertain_lti.identification.problem import Block, Columns, Problem
from uncertain_lti.kernel.arithmetic import boxes_of
from uncertain_lti.model.terms import ARRAYS
from uncertain_lti.model.uncertain_lti import UncertainLTI

BYTES, _PER_STATE, _MOST = 720_000, 90_000, 8_000_000
"""What is kept at most, of all and per state, unless those that decide take more; in the file it takes a third more."""
_STEPS = 254
"""In so many steps the range of a value is divided in the file; with one to round outwards they fill a byte."""
_LOOKED_AT = 1000
"""Transitions at least by which a recording is recognised, if it has as many."""
_AGAIN = "fit again with all recordings"
DAMAGED = f"field 'memory' of the model file is damaged; {_AGAIN}"
"""Of what an update needs, here and in `validation.panel`."""
_FACTS = ("criterion", "additive", "transitions", "transients", "segments", "sources")  # of its fit, for an update


class Recording(NamedTuple):
    """A recording that was fitted: its name, and what its transitions are recognised by."""

    name: str
    mark: str

    @classmethod
    def of(cls, name: str, problem: Problem) -> Recording:
        """That of these transitions."""
        some = problem.subset(np.arange(0, problem.N, max(1, problem.N // _LOOKED_AT)))
        return cls(name, _mark((some.z, some.x_next, some.dt, np.array([problem.N]))))


@dataclass(frozen=True)
class Boxes:
    """What is known of transitions that were not kept, a few of one recording together.

    `low`, `high` (p + 1, K): range of [Δt z; Δt]; `room` (2 n or 3 n, K): the least distance of x_next from the upper
    bound, from the lower one, and of the half-width from the largest one; `source` (K,): number of the recording.
    """

    low: Array
    high: Array
    room: Array
    source: NDArray[np.intp]

    @classmethod
    def of(
        cls, model: UncertainLTI, block: Block, source: NDArray[np.intp], widest: Array | None, numbers: Index
    ) -> Boxes:
        """Of transitions that are in a box together; `numbers` (K,): that of each, in order, -1 for none."""
        number, first = np.unique(numbers, return_index=True)
        first, count = first[number >= 0], int(number[-1]) + 1
        of = boxes_of(model.tables, block.z, block.dt, block.x_next, block.base, widest, numbers, count)
        return cls(*of, source[first])

    @classmethod
    def join(cls, parts: Sequence[Boxes]) -> Boxes:
        """All of them, by recording."""
        every = cls(*(np.concatenate([getattr(part, f.name) for part in parts], axis=-1) for f in fields(cls)))
        return every[np.argsort(every.source, kind="stable")]

    def __getitem__(self, index: Index | NDArray[np.bool_]) -> Boxes:
        return Boxes(*(getattr(self, field.name)[..., index] for field in fields(self)))

    def fewer(self, first: int, share: float) -> Boxes:
        """About this share of them, those that follow each other in one; `first`: of those before these."""
        starts = np.flatnonzero(np.diff(_numbers(self.source, first, share), prepend=-1))
        low, room = (np.minimum.reduceat(values, starts, axis=1) for values in (self.low, self.room))
        return Boxes(low, np.maximum.reduceat(self.high, starts, axis=1), room, self.source[starts])

    def after(self, columns: Columns, before: UncertainLTI, model: Any, widths: Array) -> Boxes:
        """With the room that another model leaves at least, whose largest widths are `widths` (n,)."""
        theta, d = map(np.subtract, elements_of(model, columns), elements_of(before, columns))
        even, (least, largest) = [-1] * len(columns.nominal), self._sizes(columns)
        z_low, z_high = (np.vstack([end[:-1], end[even]]) for end in (self.low, self.high))
        (falls, rises), (less, more) = _products(theta, z_low, z_high), _products(d, least, largest)
        changes = [falls + less, less - rises]
        if len(self.room) > 2 * len(widths):
            wider = 0.5 * (widths - np.asarray(before.fit_summary["max_width"]))
            changes.append(wider[:, None] - more + 1e-11 * widths[:, None])
        return replace(self, room=self.room + np.vstack(changes))

    def widest(self, columns: Columns, model: Any) -> Array:
        """Width per step (n,) that a model has at most in one of them."""
        return np.asarray(2.0 * (elements_of(model, columns)[1].T @ self._sizes(columns)[1]).max(axis=1))

    def _sizes(self, columns: Columns) -> list[Array]:
        """Least and largest regressors of the half-widths, (q, K) each."""
        nearer = np.maximum(np.maximum(self.low, -self.high), 0.0)
        farther = np.maximum(np.abs(self.low), np.abs(self.high))
        ones, steps = np.ones(len(self.source)), [term.times_dt for term in columns.half]
        return [np.vstack([end[:-1], *(end[-1] if of else ones for of in steps)]) for end in (nearer, farther)]

    def to_dict(self, recordings: int) -> dict[str, Any]:
        """As it is in the file, rounded to the side of less room."""
        low, high = (np.sign(end) * np.sqrt(np.abs(end)) for end in (self.low, self.high))  # finest near 0, at rest
        least, top = low.min(axis=1)[:, None], self.room.max(axis=1, initial=0.0)[:, None]
        step = (high.max(axis=1)[:, None] - least) / _STEPS
        low, high = ((end - least) / np.where(step > 0.0, step, 1.0) for end in (low, high))
        room = 255.0 * (np.maximum(self.room, 0.0) / np.where(top > 0.0, top, 1.0)) ** 0.25
        parts = {"low": np.floor(low - 1e-6), "high": np.ceil(high + 1e-6), "room": np.floor(room - 1e-6)}
        counts = np.bincount(self.source, minlength=recordings)
        units = {"least": least, "step": step, "top": top, "counts": counts}
        found = {name: as_text(np.maximum(values, 0.0), "u1") for name, values in parts.items()}
        return found | {name: as_text(values) for name, values in units.items()}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Boxes:
        """As the file has it."""
        least, step, top, counts = (of_text(data[name]) for name in ("least", "step", "top", "counts"))
        low, high, room = (of_text(data[name], "u1") for name in ("low", "high", "room"))
        source = np.repeat(np.arange(len(counts)), counts.astype(np.intp))
        low, high = ((least + step * end) * np.abs(least + step * end) for end in (low, high))
        return cls(low, high, top * (room / 255.0) ** 4, source)


def _numbers(source: NDArray[np.intp], first: int, share: float) -> Index:
    """Numbers (K,) from 0 of boxes, about this share of what goes into them, those of one recording that follow."""
    number = (share * np.arange(first, first + len(source))).astype(np.intp)
    return np.cumsum((np.diff(number, prepend=-1) | np.diff(source, prepend=-1)) != 0) - 1


def _products(change: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Least and largest of Δᵀ v for values v within (q, K), (n, K) each."""
    rise, fall = np.maximum(change, 0.0).T, np.minimum(change, 0.0).T
    return rise @ low + fall @ high, rise @ high + fall @ low


@dataclass(frozen=True)
class Memory:
    """What a model keeps of its recordings.

    `kept`: transitions that decide, `source` being the number of their recording; `rest`: sums over the others, and
    `boxes` of them; None if there are none; `recordings`: all of them.
    """

    kept: Problem
    rest: Moments | None
    boxes: Boxes | None
    recordings: tuple[Recording, ...]

    def to_dict(self, model: UncertainLTI) -> dict[str, Any]:
        """As it is in the file of its model."""
        of = self.kept
        kept = {"z": of.z, "next": of.x_next, "dt": of.dt, "source": of.source, "k": of.k}
        return {
            "of": _mark_of(model),
            "columns": sorted(of.columns.names),
            "recordings": [list(recording) for recording in self.recordings],
            "weights": as_text(of.weights),
            "kept": {name: as_text(values) for name, values in kept.items()},
            "rest": self.rest and {name: as_text(of) for name, of in vars(self.rest).items() if of is not None},
            "boxes": None if self.boxes is None else self.boxes.to_dict(len(self.recordings)),
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
        if lost := [name for name in _FACTS if name not in facts]:
            raise FitError(f"field 'fit' of the model file lacks {', '.join(lost)}; {_AGAIN}")
        if data.get("of") != _mark_of(model):
            raise FitError(f"the model was changed after its fit, and what its file keeps is of another; {_AGAIN}")
        try:
            z, x_next, dt, source, k = (of_text(data["kept"][name]) for name in ("z", "next", "dt", "source", "k"))
            columns, weights = Columns(frozenset(data["columns"])), of_text(data["weights"])
            whose: dict[str, Any] = {"source": source.astype(np.intp), "k": k.astype(np.intp)}
            kept = Problem(z, x_next, dt, weights, **whose, columns=columns)
            rest = None
            if data["rest"] is not None:
                found: dict[str, Any] = {name: of_text(text) for name, text in data["rest"].items()}
                found |= {name: found[name].item() for name in ("dt_min", "dt_max")}
                found |= {"count": int(found["count"].item()), "visits": found["visits"].astype(np.intp)}
                rest = Moments(**{"gram": None, "coupled": None, **found})
            boxes = None if data["boxes"] is None else Boxes.from_dict(data["boxes"])
            return cls(kept, rest, boxes, tuple(Recording(*each) for each in data["recordings"]))
        except (TypeError, ValueError, KeyError, AttributeError):
            raise FitError(DAMAGED) from None

    def unproven(self, boxes: Boxes | None) -> list[str]:
        """Names of recordings of which these, with what room is left, do not prove that all is inside."""
        found = [] if boxes is None else np.unique(boxes.source[(boxes.room < 0.0).any(axis=0)]).tolist()
        return list(dict.fromkeys(self.recordings[number].name for number in found))


def remembered(
    model: UncertainLTI,
    problem: Problem,
    recordings: Sequence[Recording],
    sums: Moments,
    nearest: Sequence[Index],
    rest: Moments | None = None,
    boxes: Boxes | None = None,
) -> dict[str, Any] | None:
    """What the file of a model keeps of transitions, beside what was kept of others already.

    None if there is no room for those that decide. `problem`: `source` being the number of the recording, rising;
    `sums`: over its transitions; `nearest`: of `WorkingSet`; `boxes`: with the room that the model leaves.
    """
    n, p, widths = model.n, problem.p, model.fit_summary["criterion"] == "lp"
    unknowns, each, box = problem.columns.unknowns(p), 8 * (p + n + 3), 2 * (p + 1) + (3 if widths else 2) * n
    room = min(n * _PER_STATE, BYTES) - 32 * (p + 2) ** 2
    first = 0 if boxes is None else len(boxes.source)
    most = max(room // 2, min(12 * n * unknowns * (p + n + 3), _MOST)) // each
    most = max(most, (room - (problem.N + first) * box) // (each - box))  # where all others have a box of their own
    if problem.N > most:
        if most <= n * unknowns:
            return None
        widest = 0.5 * np.asarray(model.fit_summary["max_width"]) if widths else None
        kept = _nearest(model, problem, sums if rest is None else sums + rest, nearest, widest, most)
        left = np.ones(problem.N, dtype=bool)
        left[kept] = False
        if not problem.columns.half:  # at rest there is no room, and no model changes that
            left &= problem.z.any(axis=0)
        chosen = problem.subset(kept)
        share = min(max(room - most * each, room // 5) // box / (first + problem.N - len(kept)), 1.0)
        tasks = []
        for block in problem.blocks():
            part = slice(block.start, block.start + len(block))
            numbers, of = np.full(len(block), -1), np.flatnonzero(left[part])
            numbers[of] = _numbers(problem.source[part][of], first, share)
            first += len(of)
            if len(of):
                tasks.append((model, block, problem.source[part], widest, numbers))
        parts = [] if boxes is None else [boxes.fewer(0, share)]
        parts += on_cores(Boxes.of, tasks, problem.N > WORTH_THREADS)
        others = sums - moments(chosen)[0]
        problem, rest, boxes = chosen, others if rest is None else rest + others, Boxes.join(parts)
    return Memory(problem, rest, boxes, tuple(recordings)).to_dict(model)


def _nearest(
    model: UncertainLTI, problem: Problem, sums: Moments, held: Sequence[Index], widest: Array | None, most: int
) -> Index:
    """The transitions of least room for their size, in each row alike, and those of the largest widths; so many.

    `held`: of each row those to choose from where there are many, in order.

    The size of a transition is (Δt φ)ᵀ P⁻¹ (Δt φ) + (Δt ψ)ᵀ Q⁻¹ (Δt ψ), its root, P and Q the means of the squares
    over all: by so much its room may change as the elements do.
    """
    n, some = model.n, np.arange(problem.N)
    if problem.N > 8 * most:
        some = np.unique(np.concatenate([of_row[: 8 * most // n] for of_row in held]))
    of = problem.subset(some)
    phi, psi = of.phi().T * of.dt, of.psi().T * of.dt
    to_nominal, to_half = (np.linalg.inv(_root(gram / sums.count)) for gram in (sums.centre, sums.plain_gram))
    wide = np.square(to_half @ psi).sum(axis=0)
    size = np.square(to_nominal @ phi).sum(axis=0) + wide
    *_, room = boxes_of(model.tables, of.z, of.dt, of.x_next, None, widest, np.arange(len(some)), len(some))
    near = np.minimum(room[:n], room[n : 2 * n]) / np.sqrt(np.maximum(size, 1e-300))
    if widest is not None:
        differ = room[2 * n :].max(axis=1) > 1e-9 * widest  # where noise alone makes the widths, none is wider
        near = np.vstack([near, room[2 * n :][differ] / np.sqrt(np.maximum(wide, 1e-300))])
    count = min(12 * most // n, near.shape[1])  # the same transition is near in many rows
    nearest = np.sort(np.argpartition(near, count - 1, axis=1)[:, :count], axis=1)
    order = np.take_along_axis(nearest, np.argsort(np.take_along_axis(near, nearest, 1), axis=1, kind="stable"), 1)
    index, first = np.unique(order.T, return_index=True)
    return np.sort(some[index[np.argsort(first)[:most]]])


def _root(gram: Array) -> Array:
    """L of L Lᵀ, a little more than a Gram matrix; columns that are 0 everywhere do not count."""
    scale = np.maximum(np.sqrt(np.diagonal(gram)), 1e-150)
    return np.asarray(scale[:, None] * np.linalg.cholesky(gram / np.outer(scale, scale) + 1e-9 * np.eye(len(gram))))


def elements_of(model: Any, columns: Columns) -> tuple[Array, Array]:
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
    point = model.operating_point
    return _mark([*(getattr(model, name) for name in ARRAYS), point.steady, point.scale])


def as_text(values: Any, form: str = "<f8") -> list[Any]:
    """Numbers as the file of a model has them, to the bit: shape, then base64."""
    array = np.atleast_1d(np.asarray(values)).astype(form)
    return [*array.shape, b64encode(np.ascontiguousarray(array).tobytes()).decode()]


def of_text(text: Sequence[Any], form: str = "<f8") -> Array:
    """Of `as_text`; of one number (1,)."""
    *shape, data = text
    return np.frombuffer(b64decode(data, validate=True), dtype=form).reshape(shape).astype(np.float64)
