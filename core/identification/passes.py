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

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array, Index
from uncertain_lti.identification.assembly import scaled_eigenvalues
from uncertain_lti.identification.cells import Cells, Whole
from uncertain_lti.identification.columns import Columns, Regimes
from uncertain_lti.identification.problem import Block, Partition, Problem
from uncertain_lti.identification.products import gram_of, product
from uncertain_lti.kernel.arithmetic import occupy, pair_count, utilisations


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
        def both(a: Array | None, b: Array | None) -> Array | None:
            return None if a is None or b is None else a + b

        return Moments(
            self.plain_gram + other.plain_gram,
            both(self.gram, other.gram),
            both(self.coupled, other.coupled),
            self.centre + other.centre,
            self.target + other.target,
            self.rate_square + other.rate_square,
            self.width_sum + other.width_sum,
            np.minimum(self.low, other.low),
            np.maximum(self.high, other.high),
            min(self.dt_min, other.dt_min),
            max(self.dt_max, other.dt_max),
            self.count + other.count,
            self.visits + other.visits,
        )

    def one_block(self) -> Moments:
        """The sums of the same transitions with one block for all: the weights of a schedule add up to 1."""
        count = len(self.visits)
        if count == 1:
            return self
        n = len(self.rate_square)

        def fold(sums: Array, *axes: int) -> Array:
            for axis in axes:
                size = sums.shape[axis] // count
                split = (*sums.shape[:axis], count, size, *sums.shape[axis + 1 :])
                sums = sums.reshape(split).sum(axis=axis)
            return sums

        coupled = None
        if self.coupled is not None:
            q = len(self.plain_gram)
            folded = fold(self.coupled.reshape(n, q, n, q), 1, 3)
            coupled = folded.reshape(n * q // count, n * q // count)
        return replace(
            self,
            plain_gram=fold(self.plain_gram, 0, 1),
            gram=None if self.gram is None else fold(self.gram, 1, 2),
            coupled=coupled,
            centre=fold(self.centre, 0, 1),
            target=fold(self.target, 0),
            width_sum=fold(self.width_sum, 0),
            visits=np.array([self.count]),
        )

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


_PIECE = 2**18
"""Numbers of z and x_next in a piece: they stay in the cache, and numpy is long enough at each operation on them for
other threads not to wait for the interpreter."""
_FEW = 256
"""Transitions of a piece that are worth judging one by one."""
_FEW_ALL = 20_000
"""Transitions up to which a scan spends its time elsewhere."""
_KEPT = 2**20
"""Transitions of a schedule up to which those in memory are kept sorted from one pass to the next: a copy of them."""
_NARROW = 1e8
"""Half-widths are so many times as large as rounding where the order of the sums does not show in a utilisation."""
_EPS, _TINY = float(np.finfo(np.float64).eps), 1e-290
"""Relative rounding of one operation, twice; and more than underflow can add up to."""


def _pieces(part: Partition) -> Iterator[Block]:
    """All transitions, in pieces of a size that suits the cache."""
    most = max(_PIECE // (part.p + part.n), 2048)
    for block in part.blocks():
        if len(block) <= most:
            yield block
            continue
        for start in range(0, len(block), most):
            yield block.piece(start, start + most)


def _sorted_pieces(part: Partition, regimes: Regimes) -> Iterator[tuple[Block, Cells, Block]]:
    """As `_pieces`, with how each is sorted, and sorted; in memory that is kept for the next pass."""
    kept = part.sorted_pieces if isinstance(part, Problem) and part.N <= _KEPT else None
    if kept:
        yield from kept
        return
    found = []
    for block in _pieces(part):
        cells = Cells.of(regimes, block)
        piece = block, cells, cells.sort(block)
        if kept is not None:
            found.append(piece)
        yield piece
    if kept is not None:
        kept.extend(found)


def _pieces_as_sorted(part: Partition) -> Iterator[tuple[Block, Cells | None, Block]]:
    """As `_sorted_pieces`; without a schedule the pieces as they are."""
    if part.columns.regimes is not None:
        yield from _sorted_pieces(part, part.columns.regimes)
        return
    for block in _pieces(part):
        yield block, None, block


def occupied(partition: Partition, least: Array, greatest: Array, cells: int, stride: int) -> NDArray[np.bool_]:
    """Cells of every pair of signals that some of the transitions start in (`model.domain.Occupancy`).

    `least` (p,): least z of all data; `greatest` (p,): greatest z of all data; Returns (pairs, cells, cells): true if
    one lies in the cell.
    """
    found = np.zeros((pair_count(partition.p), cells, cells), dtype=bool)
    for block in partition.blocks():
        occupy(block.z[:, ::stride], least, greatest, found)
    return found


def moments(part: Partition, offset: int = 0, stride: int = 0) -> tuple[Moments, list[Samples]]:
    """One pass for everything in `Moments`, and a sample of the transitions."""
    columns, n, p = part.columns, part.n, part.p
    q = columns.count * (p + len(columns.half))
    sums: Moments | None = None
    sampled: list[Block] = []
    index: list[Index] = []
    for block, sorting, some in _pieces_as_sorted(part):
        if stride:
            first = -(block.start + offset) % stride
            sampled.append(block.every(first, stride))
            index.append(np.arange(first, len(block), stride) + (block.start + offset))
        cells, block = sorting or Whole(), some
        # a constant step goes into the sums
        constant = bool((block.dt == block.dt[0]).all())
        unit = float(block.dt[0]) if constant else 1.0
        plain = columns.plain_phi(block.z)
        plain = plain if constant else plain * block.dt
        own = np.empty((p + len(columns.half), len(block)))
        np.abs(plain[:p], out=own[:p])  # Δt > 0
        for row, term in zip(own[p:], columns.half, strict=True):
            row[:] = (block.dt if term.times_dt else 1.0) / unit
        phi, psi = cells.spread(plain), cells.spread(own)
        step = block.x_next - block.origin
        weights = block.weights
        gram = np.stack([cells.gram(psi, weights[:, i]) for i in range(n)]) if weights.ndim == 2 else None
        coupled = None
        if weights.ndim == 3:
            parts = np.empty((n, q, n, q))
            for i in range(n):
                for j in range(i, n):
                    parts[i, :, j] = cells.gram(psi, weights[:, i, j])
                    parts[j, :, i] = parts[i, :, j].T
            coupled = parts.reshape(n * q, n * q)
        found = Moments(
            cells.gram(psi) * unit**2,
            None if gram is None else gram * unit**2,
            None if coupled is None else coupled * unit**2,
            cells.gram(phi) * unit**2,
            cells.against(phi, step) * unit,
            np.einsum("ik,ik->i", step, step),
            cells.total(psi) * unit,
            block.z.min(axis=1),
            block.z.max(axis=1),
            float(block.dt.min()),
            float(block.dt.max()),
            len(block),
            cells.visits(len(block)),
        )
        sums = found if sums is None else sums + found
    if sums is None:
        raise ValueError("a partition without transitions")
    return sums, _per_row(sampled, index, n, p)


def _per_row(blocks: list[Block], index: list[Index], n: int, p: int) -> list[Samples]:
    """Transitions as every row sees them."""
    if not blocks:
        return [Samples.join([], p)] * n
    z, dt = np.hstack([b.z for b in blocks]), np.concatenate([b.dt for b in blocks])
    rate = (np.hstack([b.x_next for b in blocks]) - np.hstack([b.origin for b in blocks])) / dt
    root = np.hstack([np.broadcast_to(b.root_weights(), (n, len(b))) for b in blocks])
    order = np.concatenate(index)
    s = _joined([b.s for b in blocks])
    return [Samples(order, z, rate[i], dt, root[i], s) for i in range(n)]


def _joined(parts: Sequence[Array | None]) -> Array | None:
    """Scheduling signals side by side; None if there are none."""
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

    def __getitem__(self, chosen: Index | NDArray[np.bool_]) -> Samples:
        return Samples(
            self.index[chosen],
            self.z[:, chosen],
            self.rate[chosen],
            self.dt[chosen],
            self.root_weight[chosen],
            None if self.s is None else self.s[:, chosen],
        )

    @classmethod
    def join(cls, parts: Sequence[Samples], p: int) -> Samples:
        """All of them, in order of index, each index once."""
        parts = [s for s in parts if len(s)]
        if not parts:
            nothing = np.empty(0)
            return cls(np.empty(0, dtype=np.intp), np.empty((p, 0)), nothing, nothing, nothing)
        if len(parts) == 1:
            return parts[0]
        index, first = np.unique(np.concatenate([s.index for s in parts]), return_index=True)
        further = _joined([s.s for s in parts])
        return cls(
            index,
            np.hstack([s.z for s in parts])[:, first],
            np.concatenate([s.rate for s in parts])[first],
            np.concatenate([s.dt for s in parts])[first],
            np.concatenate([s.root_weight for s in parts])[first],
            None if further is None else further[:, first],
        )


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


def scan(part: Partition, candidate: Candidate, offset: int = 0) -> list[tuple[Samples, float]]:
    """Samples whose slack is below the reach, per row: one pass.

    The slack of a sample is its distance from leaving the bounds (8)(9), or from being wider than (11) allows, in
    scaled units; negative if it is outside. If more than `most` samples of a row qualify, those of least slack
    are returned, and the reach is the least slack of the others.
    """
    columns, p = part.columns, part.p
    theta, d = np.ascontiguousarray(candidate.theta.T), np.ascontiguousarray(candidate.d.T)
    n = len(theta)
    rows = slice(part.n) if n == part.n else candidate.rows  # a slice is no copy
    found: list[_Near] = []
    kept = np.zeros(n, dtype=np.intp)
    reach = np.minimum(candidate.reach, 1e100)  # inf asks for all, and inf x 0 is nothing

    # slack < reach is a comparison with half-widths that are smaller, for the width of (11) larger, by the reach
    def shifted() -> Array:
        unit = candidate.size_unit.T
        inner = d - (reach * candidate.scale)[:, None] * unit
        if candidate.limit is None:
            return inner
        outer = d + (np.minimum(reach, candidate.room) * candidate.scale)[:, None] * unit
        return np.vstack([inner, outer])

    halves = shifted()
    for block, cells, some in _pieces_as_sorted(part):
        times = product if cells is None else cells.product
        # a constant step goes into the elements, unless the transitions are too few for it to save time
        step = float(block.dt[0]) if part.N > _FEW_ALL and (block.dt == block.dt[0]).all() else None
        if cells is not None:
            residual = cells.product(theta * (step or 1.0), columns.plain_phi(some.z))
        else:
            residual = product(theta[:, :p] * (step or 1.0), block.z)
            if columns.drift:
                residual += theta[:, p:] * (step or 1.0)
        rate = some.x_next[rows] - some.origin[rows]
        if not step:
            rate /= some.dt
        residual -= rate
        np.abs(residual, out=residual)
        half = times(halves * (step or 1.0), columns.plain_psi(some.z, some.dt))
        below = residual > half[:n]
        if candidate.limit is not None:
            width = half[n:]
            if not step:
                width *= some.dt
            root = some.root_weights()
            below |= width > candidate.limit[:, None] / (2.0 * (root if len(root) == 1 else root[rows]))
        chosen = np.flatnonzero(below)
        distance = residual.ravel()[chosen] / (step or 1.0)
        if cells is not None:
            chosen, sorting = cells.before(chosen)
            distance = distance[sorting]
        if not len(chosen):
            continue
        found.append(_near(candidate, block, columns, chosen, distance, offset))
        kept += np.bincount(found[-1].row, minlength=n)
        if (kept > 2 * candidate.most).any():
            near = _Near.join(found)
            each, reach = _least(near, n, candidate.most, reach)
            found, kept = [near[np.sort(np.concatenate(each))]], np.array([len(some) for some in each])
            halves = shifted()
    samples = [Samples.join([], p)] * n
    if found:
        near = _Near.join(found)
        each, reach = _least(near, n, candidate.most, reach)
        samples = [near.samples[some] for some in each]
    held = reach if candidate.limit is None else np.minimum(reach, candidate.room)
    return list(zip(samples, held.tolist(), strict=True))


@dataclass(frozen=True)
class _Near:
    """Samples of several rows with their slack; those of a row are in order of index."""

    row: Index
    samples: Samples
    slack: Array

    def __getitem__(self, chosen: Index) -> _Near:
        return _Near(self.row[chosen], self.samples[chosen], self.slack[chosen])

    @classmethod
    def join(cls, parts: Sequence[_Near]) -> _Near:
        """One after the other."""
        if len(parts) == 1:
            return parts[0]
        samples = [part.samples for part in parts]
        return cls(
            np.concatenate([part.row for part in parts]),
            Samples(
                np.concatenate([s.index for s in samples]),
                np.hstack([s.z for s in samples]),
                np.concatenate([s.rate for s in samples]),
                np.concatenate([s.dt for s in samples]),
                np.concatenate([s.root_weight for s in samples]),
                _joined([s.s for s in samples]),
            ),
            np.concatenate([part.slack for part in parts]),
        )


def _near(candidate: Candidate, block: Block, columns: Columns, chosen: Index, residual: Array, offset: int) -> _Near:
    """Samples of a piece; chosen (K,): row of the candidate x length of the piece + transition; residual (K,)."""
    row, k = np.divmod(chosen, len(block))
    which = candidate.rows[row]
    z, dt = block.z[:, k], block.dt[k]
    root = block.root_weights()
    s = None if block.s is None else block.s[:, k]
    psi = columns.psi(z, dt, s)
    samples = Samples(
        k + (block.start + offset),
        z,
        (block.x_next[which, k] - block.origin[which, k]) / dt,
        dt,
        root[which, k if root.shape[1] > 1 else 0],
        s,
    )
    half = np.einsum("qk,qk->k", candidate.d[:, row], psi)
    slack = half - residual
    if candidate.limit is not None:
        slack = np.minimum(slack, candidate.limit[row] / (2.0 * samples.root_weight * dt) - half)
    unit = candidate.size_unit
    size = unit @ psi if unit.ndim == 1 else np.einsum("qk,qk->k", unit[:, row], psi)
    size[size == 0.0] = 1.0  # at rest without an additive term nothing but rest is contained
    return _Near(row, samples, slack / (size * candidate.scale[row]))


def _least(near: _Near, rows: int, most: int, reach: Array) -> tuple[list[Index], Array]:
    """Positions of the samples of least slack, at most this many per row, and the slack below which none is missing."""
    each, reach = [], reach.copy()
    for i in range(rows):
        own = np.flatnonzero(near.row == i)
        if len(own) > most:
            order = np.argpartition(near.slack[own], most)
            reach[i] = near.slack[own[order[most]]]
            own = np.sort(own[order[:most]])
        each.append(own)
    return each, reach


@dataclass(frozen=True)
class Judged:
    """What the bounds of a model are on transitions.

    `outside` (n,): transitions outside, by row; `largest` (n,): largest width per step, normalised; `weighted` (n,):
    largest √w_ii x width, normalised.
    """

    outside: NDArray[np.intp]
    largest: Array
    weighted: Array

    def __add__(self, other: Judged) -> Judged:
        return Judged(
            self.outside + other.outside,
            np.maximum(self.largest, other.largest),
            np.maximum(self.weighted, other.weighted),
        )


class Envelope(Protocol):
    """What gives bounds: the model over one step, or the elements of a horizon."""

    @property
    def tables(self) -> tuple[Array, Array, Array]:
        """Nominal elements and half-widths of the rates, and what the step does not multiply."""
        ...

    def columns_centre_and_half(
        self, z: Array, dt: Array, centre: Array, half: Array, base: Array | None = None
    ) -> None:
        """Centre and half-width of the bounds of samples in columns, into given arrays.

        `z` (n + m + q, K): normalised [x; u; s]; `dt` (K,): s; `centre, half` (n, K): take the result; `base` (n, K):
        what the rates are added to; default the states.
        """


def judge(part: Partition, model: Envelope) -> Judged:
    """Bounds (6)(7) of all transitions, by the arithmetic of `UncertainLTI.bounds`."""
    zeros = np.zeros(part.n)
    total = Judged(np.zeros(part.n, dtype=np.intp), zeros, zeros)
    for block, cells, some in _pieces_as_sorted(part):
        quick = block.weights.ndim == 1
        found = _judged_in_doubt(some, model, total.largest, cells) if quick else None
        total = total + (found or _judged(block, model))
    return total


def _judged(block: Block, model: Envelope) -> Judged:
    """`judge` of one piece, every transition by the verdict's arithmetic."""
    inside, half = _inside_and_half(model, block)
    largest = 2.0 * half.max(axis=1)
    if block.weights.ndim == 1:
        weighted = largest * np.sqrt(block.weights)
    else:
        weighted = 2.0 * (half * block.root_weights()).max(axis=1)
    return Judged(len(block) - np.count_nonzero(inside, axis=1), largest, weighted)


def _inside_and_half(model: Envelope, block: Block) -> tuple[NDArray[np.bool_], Array]:
    """The verdict on each row of each transition, and its half-width, both (n, K)."""
    centre, half = _centre_and_half(model, block)
    inside: NDArray[np.bool_] = centre - half <= block.x_next
    centre += half
    inside &= block.x_next <= centre
    return inside, half


def _centre_and_half(model: Envelope, block: Block) -> tuple[Array, Array]:
    """Of each transition, both (n, K)."""
    centre, half = np.empty(block.x_next.shape), np.empty(block.x_next.shape)
    base = () if block.base is None else (block.base,)
    model.columns_centre_and_half(block.signals, block.dt, centre, half, *base)
    return centre, half


@dataclass(frozen=True)
class _Quick:
    """Bounds of some transitions by sums in another order than the verdict's, and how far they can be off.

    `distance` (n, K): centre less x_next; `half` (n, K): half-width less the floor; `floor` (n,): part of every half-
    width; `widest` (n,): no half-width less the floor is larger; `error` (n,): no distance is off by more; `relative`:
    rounding of the sums, relative to what they add.
    """

    distance: Array
    half: Array
    floor: Array
    widest: Array
    error: Array
    relative: float

    @classmethod
    def of(cls, block: Block, model: Envelope, cells: Cells | None) -> _Quick:
        """Of some transitions; `cells` is how they are sorted, where the model has a schedule."""
        with np.errstate(over="ignore", invalid="ignore"):  # values that it cannot carry: no error is finite
            return cls._of(block, model.tables, cells)

    @classmethod
    def _of(cls, block: Block, tables: tuple[Array, Array, Array], cells: Cells | None) -> _Quick:
        # blended elements are no larger than those of the blocks
        nominal, spread, v = tables if cells is None else (np.abs(table).max(axis=0) for table in tables)
        n, p = block.n, len(block.z)
        drift, steady = nominal[:, p:].sum(axis=1), spread[:, p:].sum(axis=1)  # beyond z the regressors are 1
        longest = float(block.dt.max())
        psi = np.abs(block.z)
        most = psi.max(axis=1)
        constant = cells is None and float(block.dt.min()) == longest
        widest, floor = longest * (spread[:, :p] @ most), v
        if constant:
            floor = longest * steady + v
        else:
            widest = widest + longest * steady
        if cells is not None:
            widest, floor = widest + v, np.zeros(n)
        size = longest * (np.abs(nominal[:, :p]) @ most + np.abs(nominal[:, p:]).sum(axis=1)) + widest + floor
        size += most[:n] if block.base is None else np.abs(block.base).max(axis=1)
        relative = 8.0 * (p + 8) * _EPS
        error = relative * size + _TINY
        if constant:  # the step goes into the elements
            own = np.eye(n, p) if block.base is None else 0.0
            distance = product(nominal[:, :p] * longest + own, block.z)
            half = product(spread[:, :p] * longest, psi)
            if drift.any():
                distance += (drift * longest)[:, None]
        elif cells is None:
            distance, half = product(nominal[:, :p], block.z), product(spread[:, :p], psi)
            distance += drift[:, None]
            half += steady[:, None]
            distance *= block.dt
            half *= block.dt
        else:
            distance, half = _blended(cells, block, psi, tables)
        if block.base is not None:
            distance += block.base
        elif not constant:
            distance += block.z[:n]
        distance -= block.x_next
        return cls(distance, half, floor, widest, error, relative)


def _blended(cells: Cells, block: Block, psi: Array, tables: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """Centre less the states, and half-width, of sorted transitions; psi: |z|."""
    nominal, spread, v = tables
    n, p = block.n, len(psi)
    step = float(block.dt[0])
    constant = bool((block.dt == step).all())

    def rates(table: Array, regressors: Array, always: Array) -> Array:
        """Of elements of all blocks (R, n, q), and of (R, n) for a regressor of 1 that no step multiplies."""
        one = table[:, :, p:].sum(axis=2)  # beyond z the regressors are 1
        table = table[:, :, :p]
        if constant:  # the step goes into the elements
            table, one = table * step, one * step + always
        elements = np.concatenate([table, one[:, :, None]], axis=2).transpose(1, 0, 2).reshape(n, -1)
        found = cells.product(elements, np.vstack([regressors, np.ones((1, len(block)))]))
        if not constant:
            found *= block.dt
            found += cells.product(always.T, np.ones((1, len(block))))
        return found

    return rates(nominal, block.z, np.zeros_like(v)), rates(spread, psi, v)


def _judged_in_doubt(block: Block, model: Envelope, known: Array, cells: Cells | None) -> Judged | None:
    """`_judged` to the bit, from the transitions alone that the rounding of a faster arithmetic leaves in doubt.

    A transition that is inside, or narrower than the widest, by more than any order of the sums can differ is so by the
    verdict's arithmetic too; the others are judged by it. The bound is that of a sum of k products, k ε Σ |a b| (Higham
    2002, section 3.1), with room to spare.

    `known` (n,): widths that were found already; transitions that are narrower need not be judged.
    """
    quick = _Quick.of(block, model, cells)
    error, half, widest, floor = quick.error, quick.half, quick.widest, quick.floor
    if not np.isfinite(error).all():
        return None
    n, distance, relative = block.n, quick.distance, quick.relative
    np.abs(distance, out=distance)
    distance += (error - floor)[:, None]
    doubtful: NDArray[np.bool_] = np.any(distance > half, axis=0)
    # rounding keeps the order, so the widest is where the half-width without the floor, added last, is the largest
    doubt = 2.0 * (relative * widest + _TINY)
    for i, least in enumerate(half.max(axis=1) - doubt):
        if 2.0 * (least + 2.0 * doubt[i] + floor[i]) * (1.0 + relative) < known[i]:
            continue
        if widest[i] == 0.0:
            doubtful[0] = True
        else:
            doubtful |= half[i] >= least
    chosen = np.flatnonzero(doubtful)
    if len(chosen) > _FEW:
        return None
    outside, largest = np.zeros(n, dtype=np.intp), np.zeros(n)
    if len(chosen):
        padded = np.resize(chosen, _FEW)  # a fixed number, as `ordered_sum` tries each shape first
        inside, widths = _inside_and_half(model, block.take(padded))
        outside = len(chosen) - np.count_nonzero(inside[:, : len(chosen)], axis=1)
        largest = 2.0 * widths.max(axis=1)
    return Judged(outside, largest, largest * np.sqrt(block.weights))


def envelope_sums(part: Partition, model: Envelope, stride: int) -> tuple[Array, ...]:
    """Sums over all transitions of what the envelope is there.

    That is the residual x_next - centre of every transition, the utilisation (x_next - centre) / half, their products,
    and the widths per step at the transitions of each block, those of which it has the largest weight.

    Returns (2, n): Σ r of the utilisation, then of the residual; Returns (2, n, n): Σ r rᵀ of the same; Returns (R, n):
    of each block of a schedule the sum of the widths, normalised; Returns (R, n): of each block of a schedule the
    largest width; Returns (K, n): some residuals; Returns (K, n): their half-widths.
    """
    columns, n = part.columns, part.n
    total, products = np.zeros((2, n)), np.zeros((2, n, n))
    some: list[list[Array]] = [[], []]
    widths, largest = np.zeros((columns.count, n)), np.zeros((columns.count, n))
    for block, cells, ordered in _pieces_as_sorted(part):
        quick = _Quick.of(ordered, model, cells)
        half = quick.half + quick.floor[:, None]
        for k, where, there in () if cells is None else cells.main_parts():
            own = 2.0 * half[:, where] * there
            widths[k] += own.sum(axis=1)
            largest[k] = np.maximum(largest[k], own.max(axis=1))
        if (half.min(axis=1) > _NARROW * quick.error).all():
            left = -quick.distance
            r = left / half
        else:
            centre, half = _centre_and_half(model, block)
            left = block.x_next - centre
            r = utilisations(left, half)
        for i, values in enumerate((r, left)):
            total[i] += values.sum(axis=1)
            products[i] += gram_of(values, values)
        for kept, values in zip(some, (left, half), strict=True):
            kept.append(values[:, ::stride].T.copy())
    return total, products, widths, largest, np.concatenate(some[0]), np.concatenate(some[1])


def moving_from_rest(part: Partition) -> tuple[int, int, float]:
    """Samples with x = u = 0 and a successor that is not 0."""
    count, state, step = 0, 0, 0.0
    for block in part.blocks():
        rest = ~block.z.any(axis=0)
        if rest.any():
            moves = np.abs(block.x_next[:, rest])
            count += int(moves.any(axis=0).sum())
            if moves.max() > step:
                state, step = int(moves.max(axis=1).argmax()), float(moves.max())
    return count, state, step


def steps(part: Partition) -> Array:
    """Step of every transition.

    Returns (N,): Δt, s.
    """
    return np.concatenate([block.dt for block in part.blocks()])


def least_eigenvalue(part: Partition) -> float:
    """Least eigenvalue of any full weight, its diagonal scaled to ones."""
    return min(float(scaled_eigenvalues(block.weights)[:, 0].min()) for block in part.blocks())
