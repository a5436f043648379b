# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Passes over all transitions: sums, the search for samples outside, and the count by the verdict's arithmetic."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from operator import add
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array, Index
from uncertain_lti.identification.assembly import scaled_eigenvalues
from uncertain_lti.identification.problem import Block, Columns, Partition
from uncertain_lti.kernel.arithmetic import Blocks, near_bounds, occupy, pair_count, sums_of, verdicts

T = TypeVar("T", "Moments", "Judged")


def _merged(a: T, b: T, least: Collection[str], greatest: Collection[str]) -> T:
    """Sums of two parts, but for fields of which the least or the greatest is taken; None where a part has none."""

    def both(name: str) -> Any:
        of = getattr(a, name), getattr(b, name)
        if of[0] is None or of[1] is None:
            return None
        return (np.minimum if name in least else np.maximum if name in greatest else add)(*of)

    return type(a)(**{field.name: both(field.name) for field in fields(a)})


@dataclass
class Moments:
    """Sums over all transitions, which the objectives need whatever N is; they add up over partitions.

    `plain_gram` (q, q): Σ (Δt ψ)(Δt ψ)ᵀ; `gram` (n, q, q): the same per row, weighted by w_ii; None where weights do
    not differ between samples; `coupled` (n q, n q): the same for full weights; None otherwise; `centre` (r, r): Σ (Δt
    φ)(Δt φ)ᵀ, the normal equations of the unweighted squared distance of the bounds' centre; `target` (r, n): their
    right-hand sides, one per row of the model; `rate_square` (n,): Σ (x_next - x)²; `width_sum` (q,): Σ Δt ψ; `low`
    (p,): least z; `high` (p,): greatest z; `dt_min`: shortest step, s; `dt_max`: longest step, s; `count`: number of
    transitions; `visits` (R,): transitions of which each block has the largest weight.
    """

    plain_gram: Array
    gram: Array | None
    coupled: Array | None
    centre: Array
    target: Array
    rate_square: Array
    width_sum: Array
    low: Array
    high: Array
    dt_min: float
    dt_max: float
    count: int
    visits: NDArray[np.intp]

    def __add__(self, other: Moments) -> Moments:
        return _merged(self, other, ("low", "dt_min"), ("high", "dt_max"))

    def __sub__(self, other: Moments) -> Moments:
        """The sums without those over some of the transitions; ranges stay."""
        names = ("plain_gram", "centre", "target", "rate_square", "width_sum", "count", "visits")
        return replace(self, **{name: getattr(self, name) - getattr(other, name) for name in names})

    def one_block(self) -> Moments:
        """The sums with one block for all, but those of weights: the weights of a schedule add up to 1."""
        count = len(self.visits)

        def fold(sums: Array) -> Array:
            return np.asarray(sums.reshape(count, len(sums) // count, -1).sum(axis=0))

        centre, plain = (fold(fold(square).T).T for square in (self.centre, self.plain_gram))
        sums = replace(self, plain_gram=plain, gram=None, coupled=None, centre=centre, target=fold(self.target))
        return replace(sums, width_sum=fold(self.width_sum).ravel(), visits=np.array([self.count]))

    @property
    def phi_scale(self) -> Array:
        """Root mean square of Δt φ, (r,); 0 where a column is all zero."""
        return np.sqrt(np.diagonal(self.centre) / self.count)

    @property
    def psi_scale(self) -> Array:
        """Root mean square of Δt ψ, (q,); 0 where a column is all zero."""
        return np.sqrt(np.diagonal(self.plain_gram) / self.count)

    @property
    def rate_scale(self) -> Array:
        """Root mean square of x_next - x, (n,); 1 where it is 0."""
        scale = np.sqrt(self.rate_square / self.count)
        return np.where(scale > 0, scale, 1.0)


def _given(block: Block, columns: Columns) -> tuple[Array, Array, Array, Array | None, Blocks | None, Array | None]:
    """A piece as the kernel takes it: z, Δt, next states, what they are counted from, schedule, scheduling vectors."""
    regimes = columns.regimes
    if regimes is None:
        return block.z, block.dt, block.x_next, block.base, None, None
    return block.z, block.dt, block.x_next, block.base, regimes.schedule.table, regimes.vectors(block.z, block.s)


def occupied(partition: Partition, least: Array, greatest: Array, cells: int, stride: int) -> NDArray[np.bool_]:
    """Cells of every pair of signals that some of the transitions start in (`model.domain.Occupancy`).

    `least` (p,): least z of all data; `greatest` (p,): greatest z of all data; Returns (pairs, cells, cells): true if
    one lies in the cell.
    """
    found = np.zeros((pair_count(partition.p), cells, cells), dtype=bool)
    for block in partition.blocks():
        occupy(block.z[:, ::stride], least, greatest, found)
    return found


Numbered = tuple[Index, Block]
"""Positions among all transitions, and these."""


def moments(part: Partition, offset: int = 0, stride: int = 0) -> tuple[Moments, list[Numbered]]:
    """One pass for everything in `Moments`, and a sample of the transitions."""
    columns, n = part.columns, part.n
    sums: Moments | None = None
    sampled: list[Numbered] = []
    for block in part.blocks():
        if stride:
            first = -(block.start + offset) % stride
            index = np.arange(first, len(block), stride)
            sampled.append((index + (block.start + offset), block.subset(index)))
        weights, (i, j) = block.weights, np.triu_indices(n)
        factors = None if weights.ndim == 1 else weights.T if weights.ndim == 2 else weights[:, i, j].T
        plain, grams, centre, target, square, width, visits = sums_of(
            n, *_given(block, columns), *columns.extra, factors
        )
        coupled = None
        if weights.ndim == 3:
            parts = np.empty((n, len(plain), n, len(plain)))
            parts[i, :, j] = parts[j, :, i] = grams
            coupled = parts.reshape(n * len(plain), -1)
        ends = block.z.min(axis=1), block.z.max(axis=1), float(block.dt.min()), float(block.dt.max())
        by_row = np.stack(grams) if weights.ndim == 2 else None
        found = Moments(plain, by_row, coupled, centre, target, square, width, *ends, len(block), visits)
        sums = found if sums is None else sums + found
    assert sums is not None
    return sums, sampled


def by_row(numbered: Sequence[Numbered], n: int) -> list[Samples]:
    """Transitions as every row sees them, what is not its own held once for all."""
    index, blocks = zip(*numbered, strict=True)
    z, dt = np.hstack([b.z for b in blocks]), np.concatenate([b.dt for b in blocks])
    rate = (np.hstack([b.x_next for b in blocks]) - np.hstack([b.origin for b in blocks])) / dt
    root = np.hstack([np.broadcast_to(b.root_weights(), (n, len(b))) for b in blocks])
    order = np.concatenate(index)
    s = _joined([b.s for b in blocks])
    return [Samples(order, z, rate[i], dt, root[i], s) for i in range(n)]


def _joined(parts: Sequence[Any]) -> Any:
    """Arrays side by side; None if there are none."""
    there = [part for part in parts if part is not None]
    return np.hstack(there) if there else None


@dataclass(frozen=True)
class Samples:
    """Some transitions as one row sees them.

    `index` (K,): position among all transitions; `z` (p, K): [x; u]; `rate` (K,): (x_next - x) / Δt of the row, 1/s;
    `dt` (K,): Δt, s; `root_weight` (K,): √w_ii; `s` (q, K): scheduling signals that are neither state nor control.
    """

    index: Index
    z: Array
    rate: Array
    dt: Array
    root_weight: Array
    s: Array | None = None

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, chosen: Index | NDArray[np.bool_] | slice) -> Samples:
        every = (getattr(self, field.name) for field in fields(self))
        some: list[Any] = [None if values is None else values[..., chosen] for values in every]
        return Samples(*some)

    def among(self, others: Samples) -> bool:
        """Whether others, in order of index, hold all of these."""
        at = np.searchsorted(others.index, self.index)
        return not len(at) or bool(at.max() < len(others) and (others.index[at] == self.index).all())

    @classmethod
    def join(cls, parts: Sequence[Samples], p: int) -> Samples:
        """All of them, in order of index, each index once."""
        parts = [s for s in parts if len(s)]
        if not parts:
            nothing = np.empty(0)
            return cls(np.empty(0, dtype=np.intp), np.empty((p, 0)), nothing, nothing, nothing)
        if len(parts) == 1:
            return parts[0]
        whole = cls(*(_joined([getattr(s, field.name) for s in parts]) for field in fields(cls)))
        if (np.diff(whole.index) > 0).all():
            return whole
        return whole[np.unique(whole.index, return_index=True)[1]]


@dataclass(frozen=True)
class Candidate:
    """A solution to check on all samples, and the units in which its slack is measured.

    `theta` (r, n): nominal elements, one column per row of the model, 1/s; `d` (q, n): half-widths of the same shape;
    `size_unit` (q,): the size of a sample is size_unit·ψ; `scale` (n,): slack of row i is divided by size x scale_i;
    `limit` (n,): δ of (11); None for (10); `reach` (n,): samples are wanted that have less slack than this from leaving
    the bounds; `room` (n,): and those that have less slack than this from being wider than the limit; `most`: samples
    per row at most; `rows`: rows of the model that are looked at; the arrays above have one element or column for each.
    """

    theta: Array
    d: Array
    size_unit: Array
    scale: Array
    limit: Array | None
    reach: Array
    room: Array
    most: int
    rows: Index


def scan(part: Partition, candidate: Candidate, offset: int = 0) -> list[tuple[list[Samples], float]]:
    """Samples whose slack is below the reach, per row, in parts that follow one another: one pass.

    The slack of a sample is its distance from leaving the bounds (8)(9), or from being wider than (11) allows, in
    scaled units; negative if it is outside. If more than `most` samples of a row qualify, those of least slack
    are returned, and the reach is the least slack of the others.
    """
    rows, most = candidate.rows, candidate.most
    of = candidate.theta, candidate.d, candidate.size_unit, candidate.scale
    reach = np.minimum(candidate.reach, 1e100)  # inf asks for all, and inf x 0 is nothing
    found: list[list[tuple[Samples, Array]]] = [[] for _ in rows]  # with the slack of each

    def keep_nearest(i: int, limit: int) -> None:
        if sum(len(slack) for _, slack in found[i]) <= limit:
            return
        parts, slacks = zip(*found[i], strict=True)
        nearest, least = _nearest(np.concatenate(slacks), most)
        reach[i] = min(reach[i], least)
        ends = np.cumsum([len(slack) for slack in slacks])
        each = zip(parts, slacks, np.split(nearest, np.searchsorted(nearest, ends[:-1])), [0, *ends], strict=False)
        found[i] = [(part[k - start], slack[k - start]) for part, slack, k, start in each]

    for block in part.blocks():
        limit = None if candidate.limit is None else candidate.limit[:, None] / block.root_weights()[rows]
        given = *_given(block, part.columns), *part.columns.extra
        chosen, slack = near_bounds(part.n, *given, *of, reach, candidate.room, limit, rows)
        edges = np.searchsorted(chosen, len(block) * np.arange(len(rows) + 1))
        near = []
        for i, (first, end) in enumerate(pairwise(edges.tolist())):
            nearest, least = _nearest(slack[first:end], most)
            near.append(nearest + first)
            reach[i] = min(reach[i], least)
        seen = _seen(block, rows, chosen[np.concatenate(near)], offset)
        for i, (k, end) in enumerate(zip(near, np.cumsum([len(k) for k in near]).tolist(), strict=True)):
            found[i].append((seen[end - len(k) : end], slack[k]))
            keep_nearest(i, 2 * most)
    for i in range(len(rows)):
        keep_nearest(i, most)
    held = reach if candidate.limit is None else np.minimum(reach, candidate.room)
    return [([samples for samples, _ in each], end) for each, end in zip(found, held.tolist(), strict=True)]


def _nearest(slack: Array, most: int) -> tuple[Index, float]:
    """The samples of least slack, at most this many, in order, and the least slack of the others."""
    if len(slack) <= most:
        return np.arange(len(slack)), np.inf
    order = np.argpartition(slack, most)
    return np.sort(order[:most]), float(slack[order[most]])


def _seen(block: Block, rows: Index, chosen: Index, offset: int) -> Samples:
    """Transitions of a piece as rows of the model see them, together; chosen (K,): row x length of it + transition."""
    of, k = np.divmod(chosen, len(block))
    row, dt, root = rows[of], block.dt[k], block.root_weights()
    rate = (block.x_next[row, k] - block.origin[row, k]) / dt
    s = None if block.s is None else np.take(block.s, k, axis=1)
    weights = root[row, k if root.shape[1] > 1 else 0]
    return Samples(k + (block.start + offset), np.take(block.z, k, axis=1), rate, dt, weights, s)


@dataclass(frozen=True)
class Judged:
    """What the bounds of a model are on transitions.

    `outside` (n,): transitions outside, by row; `largest` (n,): largest width per step, normalised; `weighted` (n,):
    largest √w_ii x width, normalised; `total` (n,): Σ r of the utilisation r = (x_next - centre) / half; `products`
    (n, n): Σ r rᵀ; `widths` (R, n): of each block of a schedule the sum of the widths at transitions of which it has
    the largest weight; `widest` (R, n): the largest of these.
    """

    outside: NDArray[np.intp]
    largest: Array
    weighted: Array
    total: Array
    products: Array
    widths: Array
    widest: Array

    def __add__(self, other: Judged) -> Judged:
        return _merged(self, other, (), ("largest", "weighted", "widest"))


class Envelope(Protocol):
    """What gives bounds: the model over one step, or the elements of a horizon."""

    @property
    def tables(self) -> tuple[Array, Array, Array]:
        """Nominal elements and half-widths of the rates, and what the step does not multiply."""
        ...


def judge(part: Partition, model: Envelope) -> Judged:
    """Bounds (6)(7) of all transitions, by the arithmetic of `UncertainLTI.bounds`."""
    given = ((*_given(block, part.columns), block.root_weights()) for block in part.blocks())
    first, *others = (Judged(*verdicts(model.tables, *some)) for some in given)
    return sum(others, first)


def in_a_row(part: Partition, share: float) -> tuple[Array, int]:
    """Σ w wᵀ of two transitions in a row, w = [φ_k; y_k; φ_{k-1}; y_{k-1}], and how many there are.

    φ = Δt [z; 1], y = x_next - x; looked at is the first share of each piece.
    """
    total, count = np.zeros((2 * (part.n + part.p + 1),) * 2), 0
    for block in part.blocks():
        one = slice(0, math.ceil(share * len(block)))
        z, dt, x_next = block.z[:, one], block.dt[one], block.x_next[:, one]
        rows = np.vstack([dt * z, dt, x_next - block.origin[:, one]])
        follows = (z[: part.n, 1:] == x_next[:, :-1]).all(axis=0)
        both = np.vstack([rows[:, 1:], rows[:, :-1]])[:, follows]
        total += both @ both.T
        count += both.shape[1]
    return total, count


def moving_from_rest(part: Partition, offset: int = 0) -> tuple[int, int, int, float]:
    """Samples with x = u = 0 and a successor that is not 0: how many; of the first its number, a state, its step."""
    count, first = 0, (0, 0, 0.0)
    for block in part.blocks():
        rest = np.flatnonzero(~block.z.any(axis=0))
        moving = np.argwhere(block.x_next[:, rest].T != 0.0)
        if len(moving) and not count:
            k, state = rest[moving[0, 0]], moving[0, 1]
            first = int(k) + block.start + offset, int(state), float(block.x_next[state, k])
        count += len(np.unique(moving[:, 0]))
    return count, *first


def steps(part: Partition) -> Array:
    """Step of every transition, (N,): Δt, s."""
    return np.concatenate([block.dt for block in part.blocks()])


def least_eigenvalue(part: Partition) -> float:
    """Least eigenvalue of any full weight, its diagonal scaled to ones."""
    return min(float(scaled_eigenvalues(block.weights)[:, 0].min()) for block in part.blocks())
