# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Criteria (10) and (11) to their exact optimum by solving on the few samples that matter."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from time import perf_counter

import numpy as np

from uncertain_lti.base.arrays import Array, Index, on_cores, one_by_one, return_memory
from uncertain_lti.base.errors import FitError
from uncertain_lti.base.progress import CountedStep
from uncertain_lti.base.text import plural
from uncertain_lti.identification.fleet import Fleet
from uncertain_lti.identification.passes import Candidate, Judged, Samples
from uncertain_lti.identification.programmes import GOOD, WIDTH_SLACK, Programmes
from uncertain_lti.identification.regimes import tied_blocks
from uncertain_lti.identification.row import JOIN, LEAST, InfeasibleError
from uncertain_lti.identification.structure import Structure

_FURTHER = 2.5
"""After the first pass, samples are held whose slack is up to this many times as large: few are left there."""
SUBSAMPLE = 10_000
"""Transitions of the first solve, evenly spaced; up to twice as many are held as a whole."""
_FURTHEST, _MANY = 4_000, 100
"""Transitions that join them, those furthest from least squares, about: nearly all that decide are among them. With
as many unknowns a row its programmes take longer than the pass that finds them."""
MAX_ROUNDS, FEW_ROUNDS = 200, 60
Settle = Callable[[Programmes], None]
_HELD_BYTES = 180_000_000
"""Memory for the samples of the rows that are proven together, about."""
_NEAREST = 4_000
"""Samples of a row, about, that are told of after its proof: those of least slack."""
_SILENCE = 2.0
"""After so long, s, a word on how far the rows are."""
_REMEDY = "a state may follow from the others exactly: leave it out, or fix its row by structure"


@dataclass
class Solution:
    """Elements, one column per row of the model, and how they were found.

    `theta` (r, n): nominal elements, 1/s; `d` (q, n): half-widths; `violation` (n,): largest violation left, in units
    of the size of a sample; `delta` (n,): optimum of (11) on the working set, a lower bound of the optimum over all
    samples; None for (10); `rounds`: programmes solved on the working set; `passes`: passes over all transitions;
    `working`: size of the working set of each row; `solvers`: names of those that found it; `gap`: how far (10) is
    above a lower bound of its optimum at most, relative; inf if no bound was found, None for (11).
    """

    theta: Array
    d: Array
    violation: Array
    delta: Array | None = None
    rounds: int = 0
    passes: int = 1
    working: list[int] = field(default_factory=list)
    solvers: set[str] = field(default_factory=set)
    gap: float | None = None


class WorkingSet:
    """Candidate on a working set, slack of all samples in one pass, the least slack joins, until none is negative.

    A pass also brings every sample whose slack is small. How far slack can change is bounded by how far the scaled
    unknowns change (the size of a sample is linear in |z|), so while they change less than the slack that was
    brought, no other sample can leave its bounds, and the proof of optimality needs no further pass.

    `fleet`: the data; `structure`: as in `fit`; `progress`: called with one line of text per pass; `near`: elements,
    (r, n) and (q, n), of a fit to nearly the same data, where rows of _MANY unknowns start.
    """

    def __init__(
        self,
        fleet: Fleet,
        structure: Structure | None = None,
        progress: Callable[[str], None] | None = None,
        near: tuple[Array, Array] | None = None,
    ) -> None:
        self.fleet = fleet
        self._near = near
        self.progress = progress or (lambda text: None)
        self.whole = fleet.N <= 2 * SUBSAMPLE
        self._stride = 1 if self.whole else fleet.N // SUBSAMPLE
        self.sums, self._first = fleet.moments(self._stride)
        structure = structure or Structure(fleet.n, fleet.p - fleet.n)
        columns = fleet.columns
        self.tied = tied_blocks(self.sums, columns, fleet.p)
        bounds, shared = structure.unknowns(columns.names, self.tied)
        self.shared = shared
        self.half_limits = bounds[2:]  # least and largest half-widths that the structure allows, (q, n) each
        self.rows = [
            Programmes(i, self.sums, columns, bounds, None if shared is None else [first[:, i] for first in shared])
            for i in range(fleet.n)
        ]
        self.solvers: set[str] = set()
        self.passes = 1
        self._row_rounds = np.zeros(fleet.n, dtype=np.intp)  # each row has its own thread
        self._reach = np.zeros((2, fleet.n))  # in these scales of the rows
        self._reach_scales = np.full(fleet.n, np.nan)
        self._nearest_of: dict[int, Index] = {}  # of rows that were released
        self.keeps = False  # working sets of rows that are done, which choosing what to discard looks into
        self._together = False  # (10) with full weights: the rows meet in the objective
        self._like: Programmes | None = None  # the row that held samples last
        self._told = ""  # how far the rows are, before what is said of a pass

    def solve(self, criterion: str) -> Solution:
        """Solve (10), or (11)."""
        return self.quadratic() if criterion == "qp" else self.linear()

    def objective(self, criterion: str, d: Array, judged: Judged) -> Array:
        """Value of (10), (1,), or of δ in every row of (11), (n,); `d` (q, n): half-widths, as they were judged."""
        if criterion == "lp":
            return judged.weighted
        if self.sums.coupled is not None:
            flat = d.T.ravel()
            return np.array([4.0 * flat @ self.sums.coupled @ flat])
        weights = np.ones(self.fleet.n) if self.fleet.weights is None else self.fleet.weights
        grams = (self.sums.plain_gram * weight for weight in weights) if self.sums.gram is None else self.sums.gram
        return np.array([sum(4.0 * half @ gram @ half for half, gram in zip(d.T, grams, strict=True))])

    def above(self, criterion: str, objective: Array, reference: Array, judged: Judged) -> float:
        """How far above its reference at most, relative; an envelope that is rounding has no distance."""
        least = LEAST * self.sums.rate_scale
        floor = least * judged.weighted / np.where(judged.largest > 0, judged.largest, 1.0)
        if criterion == "qp":
            floor = np.array([float(floor @ floor) * self.sums.count])
        return float(np.max((objective - reference) / np.maximum(np.maximum(objective, floor), 1e-300), initial=0.0))

    def nearest(self) -> list[Index]:
        """Of each row that is proven the transitions nearest to their bounds, or the widest, in order."""
        released = self._nearest_of
        return [released[row.i] if row.i in released else row.nearest(_NEAREST) for row in self.rows]

    def quadratic(self) -> Solution:
        """Solve (10)."""
        if self.sums.coupled is not None:
            return self._coupled_quadratic()
        self._solve(self._settle_quadratic)
        gaps = np.array(on_cores(Programmes.duality_gap, [(row,) for row in self.rows]))
        again = [row for row in self.rows if row.unknown and not gaps[row.i] + row.lifted_loss() <= GOOD]
        for row, answer, value in self._again(again, self._settle_quadratic, self._lifted):
            gaps[row.i] = row.duality_gap()
            if not gaps[row.i] + row.lifted_loss() <= GOOD:
                gaps[row.i] = min(gaps[row.i], row.linear_gap())
            now = self._lifted(row) if row.outside() <= max(1e-6, row.tolerance) else np.inf
            if value <= now * (1.0 + GOOD):  # nothing gained: the elements stay
                gaps[row.i] = max(gaps[row.i] + value / max(now, 1e-300) - 1.0, 0.0) if now < np.inf else np.inf
                row.keep(answer)
        return replace(self._solution(), gap=float(gaps.max(initial=0.0)))

    def _again(
        self, rows: list[Programmes], settle: Settle, value: Callable[[Programmes], float]
    ) -> list[tuple[Programmes, tuple[Array, Array, float], float]]:
        """Solve rows once more, in refined coordinates; what a solver cannot improve stays as it was.

        Returns each row with its answer of before, and the value that this had.
        """
        before = [(row, row.answer(), value(row)) for row in rows]

        def improve(row: Programmes) -> None:
            theta, d, limit = row.theta.copy(), row.d.copy(), row.limit
            try:
                settle(row)
            except FitError:
                row.take(theta, d, limit)

        for group in self._groups(rows) if rows else []:
            on_cores(self._refine, [(row,) for row in group if not row.refined])
            self._settle_and_prove(improve, group)
        return before

    def _refine(self, row: Programmes) -> None:
        """Refine a row with the first samples at hand, which it may have released."""
        if not self.whole:
            self._hold(row, self._first[row.i])
        row.refine()

    def _settle_quadratic(self, row: Programmes) -> None:
        self._settle_or_refine(row, Programmes.quadratic, polish=True)

    def _settle_or_refine(self, row: Programmes, solve: Callable[[Programmes], str], polish: bool = False) -> None:
        """Settle a row, in refined coordinates if it does not settle in those of its steps."""
        if not row.refined:
            try:
                self._settle(row, solve, polish)
                return
            except FitError:
                row.refine()
        self._settle(row, solve, polish)

    def _lifted(self, row: Programmes) -> float:
        """Part of the row in the objective of (10), with the half-widths lifted over what is violated."""
        _, d = row.scaled()
        scaled = row.value(d + row.outside())
        return scaled * row.scale**2 + row.least_value() * row.scale**2

    def _coupled_quadratic(self) -> Solution:
        """(10) with full weights: one row after the other, in refined coordinates if that is not good."""
        self._together, gap = True, np.inf
        with suppress(FitError):
            self._solve(self._settle_in_turn)
            gap = self.coupled_gap()
        if not gap <= GOOD:
            for row in self.rows:
                if not row.refined:
                    row.refine()
            self._settle_and_prove(self._settle_in_turn, self.rows)
            gap = self.coupled_gap()
        return replace(self._solution(), gap=gap)

    def _settle_in_turn(self, _: Programmes) -> None:
        """(10) with full weights by one row at a time, the others as they are.

        The rows meet in the objective alone, which is convex and smooth, so going round them descends to the optimum
        of all; and rows whose widths differ by many orders of magnitude never share a programme.
        """
        assert self.sums.coupled is not None
        before = np.inf
        for _number in range(MAX_ROUNDS):
            for row in self.rows:
                if row.unknown:
                    row.join_others(self.sums.coupled, [other.d for other in self.rows])
                self._settle(row, Programmes.among, polish=True)
            flat = np.concatenate([row.d for row in self.rows])
            value = float(flat @ self.sums.coupled @ flat)
            if value >= before * (1.0 - 1e-11):
                return
            before = value

    def coupled_gap(self) -> float:
        """As `Programmes.linear_gap`, with full weights: the rows meet in the objective alone.

        Unlike without full weights, the objective may fall as a half-width grows, by rounding at least: there the
        linearisation has no minimum but for what the squared widths themselves allow (`_at_most`).
        """
        coupled = self.sums.coupled
        assert coupled is not None
        flat = np.concatenate([row.d for row in self.rows])
        slopes = (coupled @ flat).reshape(len(self.rows), -1)
        diagonals, scale = np.diagonal(coupled).reshape(slopes.shape), self.sums.psi_scale
        weights = (diagonals[:, scale > 0] / scale[scale > 0] ** 2).max(axis=1, initial=0.0)  # Σ w_ii, about
        least = sum(row.least_value() * row.scale**2 * weight for row, weight in zip(self.rows, weights, strict=True))
        value = max(0.5 * float(flat @ slopes.ravel()), least, 1e-300)
        above = 0.0
        for row, slope, diagonal in zip(self.rows, slopes, diagonals, strict=True):
            if not row.unknown:
                continue
            slope = row.psi_columns.take(slope) * row.unit_psi * row.scale
            largest = float(np.abs(slope).max(initial=0.0))
            _, d = row.scaled()
            falls = bool((slope < 0.0).any())
            if not falls and largest * (float(d.sum()) + 1.0) <= 1e-12 * value:  # nothing to gain
                continue
            try:
                most = self._at_most(row, diagonal) if falls else None
                above += float(slope @ d) - row.least_linear(slope / largest, most) * largest
            except FitError:
                return np.inf
        return float(max(above, 0.0) / value)

    @cached_property
    def _least_eigenvalue(self) -> float:
        """Of any full weight."""
        return max(self.fleet.least_eigenvalue(), 1e-300)

    def _at_most(self, row: Programmes, diagonal: Array) -> Array:
        """Largest scaled half-widths that the optimum of (10) with full weights can have, (q,) of the free ones.

        Σ w' W w over the samples is at least λ Σ w_ii w_i², with λ the least eigenvalue of any W whose diagonal is
        scaled to ones; and no product of two half-widths of a row is negative, so that each alone is bounded. What
        the row is now, lifted over what it violates, is no less than the optimum on the samples held.

        `diagonal` (q,): of Σ (Δt ψ)(Δt ψ)ᵀ w_ii.
        """
        coupled = self.sums.coupled
        assert coupled is not None
        flat = np.concatenate([other.d + other.outside() * other.size_unit * other.scale for other in self.rows])
        square = 4.0 * float(flat @ coupled @ flat)  # some room for what the structure does not let be lifted
        own = row.psi_columns.take(diagonal) * (row.unit_psi * row.scale) ** 2
        return np.asarray(np.sqrt(square / (self._least_eigenvalue * np.maximum(own, 1e-300))))

    def linear(self) -> Solution:
        """Solve (11), then least sum of squared widths among its optima, then the centre."""
        deltas = np.zeros(self.fleet.n)

        def settle(row: Programmes) -> None:
            boxed = row.unknown and row.box is not None
            row.exact |= not boxed and row.columns.count > 1  # of many blocks the weight is seldom small enough
            if not row.exact:
                try:
                    if boxed:
                        self._settle(row, Programmes.nominal)
                        row.face()  # or it was no optimum
                    else:
                        self._settle(row, Programmes.regularised, polish=True)
                except FitError:
                    row.exact = True
            if row.exact:
                row.limit = None if row.limit is None else float(deltas[row.i]) / row.limit_unit
                self._settle_or_refine(row, Programmes.linear)
            if row.limit is None:  # nothing unknown: the structure fixes the widths
                row.limit = float((row.width * row.half).max(initial=0.0))
            deltas[row.i] = row.limit * row.limit_unit
            row.allowed = row.limit = row.limit * (1.0 + WIDTH_SLACK)  # room for the ties
            if row.exact or boxed:
                self._settle(row, Programmes.bounded, polish=True)

        self._solve(settle)
        unknown = [row for row in self.rows if row.unknown]
        bounds = deltas.copy()
        bounds[[row.i for row in unknown]] = on_cores(self._least_width, [(row,) for row in unknown])
        above = deltas > (1.0 + WIDTH_SLACK) * bounds + 1e-13 * np.array([row.scale for row in self.rows])
        again = [row for row in unknown if above[row.i] and not row.exact]
        for row in again:  # the weight relative to δ was too large for these
            row.exact = True
        for group in self._groups(again):
            self._settle_and_prove(settle, group)
        bounds[[row.i for row in again]] = [self._least_width(row) for row in again]
        again = [row for row in unknown if row.collinear() or not self._above(row, bounds) <= GOOD]
        again = [row for row in again if not row.refined]
        for row in again:
            row.exact = True
        for row, answer, width in self._again(again, settle, self._largest_width):
            bounds[row.i] = self._least_width(row)
            if width <= self._largest_width(row) * (1.0 + GOOD):  # nothing gained: the elements stay
                row.keep(answer)
        return self._solution(np.minimum(deltas, bounds))

    def _least_width(self, row: Programmes) -> float:
        """A lower bound of δ."""
        return (row.least if row.exact or row.box is not None else row.least_width()) * row.limit_unit

    def _above(self, row: Programmes, bounds: Array) -> float:
        """How far the largest width of a row will be above its bound at most, relative."""
        least = LEAST * row.rms_step * float(row.samples.root_weight.max(initial=0.0))
        return (self._largest_width(row) - float(bounds[row.i])) / max(float(bounds[row.i]), least, 1e-300)

    def _largest_width(self, row: Programmes) -> float:
        """√w x width of a row at most, with the half-widths lifted over what is left outside."""
        _, d = row.scaled()
        inside, _ = row.slacks()
        lift = max(0.0, -float(inside.min(initial=0.0)))
        return float((row.width * (row.psi @ d + row.half + lift)).max(initial=0.0)) * row.limit_unit

    def violation(self, theta: Array, d: Array) -> Array:
        """Largest violation of given elements over all transitions: one pass.

        `theta` (r, n): nominal elements, 1/s; `d` (q, n): half-widths; Returns (n,): in scaled units; 0 where none is
        violated.
        """
        for row in self.rows:
            row.take(theta[:, row.i], d[:, row.i])
        everything = np.full(self.fleet.n, np.inf)
        found = self.fleet.scan(self._candidate(everything, everything, 1, self.rows))
        for row, (samples, _) in zip(self.rows, found, strict=True):
            self._hold(row, samples)
        return self._solution().violation

    def _solution(self, delta: Array | None = None) -> Solution:
        for row in self.rows:  # a solver may stop close to what cannot be
            if row.outside() > 1e-8 and (found := row.contradiction()):
                raise InfeasibleError(row.i, *found)
        return Solution(
            np.column_stack([row.theta for row in self.rows]),
            np.column_stack([row.d for row in self.rows]),
            np.array([row.outside() * row.scale if row.kept is None else row.kept for row in self.rows]),
            delta,
            int(self._row_rounds.sum()),
            self.passes,
            [len(row.pool) for row in self.rows],
            self.solvers,
        )

    # --- all samples ---

    def _solve(self, settle: Settle) -> None:
        """Solve all rows and prove them, those together whose samples fit in memory."""
        began, done = perf_counter(), 0
        for rows in self._groups(self.rows):
            if done:
                self._told = f"{self._say_left(began, done, len(self.rows))}; "
            self._start(rows)
            self._settle_and_prove(settle, rows)
            done += len(rows)
        self._told = ""

    def _start(self, rows: list[Programmes]) -> None:
        """Begin with the first samples and those furthest from least squares, or those next to bounds that are near."""
        many = max(row.r + row.q for row in rows) >= _MANY
        near = self._near if many else None
        for row in rows:
            self._hold(row, self._first[row.i])
            row.start(near and (near[0][:, row.i], near[1][:, row.i]))
        if not self.whole and many:
            share = _FURTHEST / self.fleet.N
            reach = np.zeros(self.fleet.n)
            reach[[row.i for row in rows]] = [float(np.quantile(row.slack(), share)) for row in rows]
            found = self.fleet.scan(self._candidate(reach, reach, 2 * _FURTHEST, rows))
            self.passes += 1
            for row, (samples, _) in zip(rows, found, strict=True):
                self._hold(row, Samples.join([self._first[row.i], samples], self.fleet.p))
        for row in rows:
            row.widen_pool(4 * (row.r + row.q), None if near is None else np.inf)

    def _each(self, rows: list[Programmes], settle: Settle) -> None:
        """Settle rows on all cores, though PIQP holds the lock; with full weights, all at once."""
        if self._together:
            settle(rows[0])
            return
        began = said = perf_counter()
        for number, _ in enumerate(one_by_one(settle, [(row,) for row in rows]), start=1):
            if perf_counter() - said > _SILENCE and number < len(rows) and not self._in_groups:
                said = perf_counter()
                self._say_left(began, number, len(rows))

    def _say_left(self, began: float, done: int, total: int) -> str:
        left = (perf_counter() - began) / done * (total - done)
        text = f"row {done + 1} of {total}, about {left:.0f} s left"
        self.progress(CountedStep(text, done + 1, total))
        return text

    @property
    def _in_groups(self) -> bool:
        """The samples of all rows do not fit in memory together; `_solve` then tells how far the rows are."""
        return len(self._groups(self.rows)) > 1

    def _groups(self, rows: list[Programmes]) -> list[list[Programmes]]:
        """Rows whose samples fit in memory together; with full weights, all."""
        if self._together or self.whole:
            return [rows]
        columns, count = self.fleet.columns, self.fleet.columns.count
        each = 8 * SUBSAMPLE * (3 * self.fleet.p + len(columns.nominal) + len(columns.half)) * count
        size = max(1, _HELD_BYTES // each)
        size += size % 2  # as many for either of two cores
        return [rows[k : k + size] for k in range(0, len(rows), size)]

    def _settle_and_prove(self, settle: Settle, rows: list[Programmes]) -> None:
        """Settle rows on what they hold, and, if there are more samples than that, hold the solution against all."""
        self._each(rows, settle)
        if not self.whole:
            self._prove(settle, rows)
            if self._in_groups:
                for row in rows:
                    self._nearest_of[row.i] = row.nearest(_NEAREST)
                    row.release(self.keeps)
                return_memory()

    def _prove(self, settle: Settle, rows: list[Programmes]) -> None:
        """Hold the solution against all samples, and solve again, until it contains them all."""
        looked_for = 2 * SUBSAMPLE // 5 + self.fleet.N // 2500
        share, most = looked_for / self.fleet.N, 3 * looked_for // 2
        further = 1.0
        for _ in range(MAX_ROUNDS):
            for row in rows:  # the samples held after a pass are those of least slack: keep the first reach
                if self._reach_scales[row.i] != row.scale:
                    evenly = row.samples.index % self._stride == 0
                    self._reach[:, row.i], self._reach_scales[row.i] = row.reach(share, evenly), row.scale
            wanted = further * self._reach
            found = self.fleet.scan(self._candidate(wanted[0], wanted[1], most, rows))
            further = _FURTHER  # few are left near the bounds, and what is held need not be looked for again
            self.passes += 1
            before = [(row.theta.copy(), row.d.copy(), row.limit, row.scale) for row in rows]
            todo = []
            left = 0
            for row, (samples, _) in zip(rows, found, strict=True):
                self._hold(row, samples)
                left += int((row.slack() < -row.tolerance).sum())
                if row.widen_pool():
                    todo.append(row)
            said = f"pass {self.passes}: {plural(left, 'sample')} outside, working set {self._sizes()}"
            self.progress(f"{self._told}{said}")  # of which a log shows one now and then
            if not todo:
                return
            self._each(todo, settle)
            moved = [self._moved(row, *old) for row, old in zip(rows, before, strict=True)]
            near = zip(rows, moved, found, strict=True)
            again = [row for row, change, (_, held) in near if not (change == 0.0 or change < held)]
            if not again:
                return
            rows = self.rows if self._together else again
        raise FitError(f"the working set did not settle in {MAX_ROUNDS} passes; scale the signals to order one")

    def _candidate(self, reach: Array, room: Array, most: int, rows: list[Programmes]) -> Candidate:
        limits = [row.limit * row.limit_unit for row in rows if row.limit is not None]
        limit = np.array(limits) if len(limits) == len(rows) else None
        which = np.array([row.i for row in rows], dtype=np.intp)
        return Candidate(
            np.column_stack([row.theta for row in rows]),
            np.column_stack([row.d for row in rows]),
            rows[0].size_unit if self.shared is None else np.column_stack([row.size_unit for row in rows]),
            np.array([row.scale for row in rows]),
            limit,
            reach[which],
            room[which],
            most,
            which,
        )

    def _moved(self, row: Programmes, theta: Array, d: Array, limit: float | None, scale: float) -> float:
        """Largest change of any sample's slack, in scaled units, since theta, d and the limit."""
        if row.scale != scale:
            return np.inf
        if limit is not None and row.limit is not None and row.limit < limit * (1.0 - 1e-12):
            return np.inf  # the optimum over more samples is no less, so this is rare
        p, columns = self.fleet.p, self.fleet.columns
        unit = row.size_unit.reshape(columns.count, -1)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = np.where(unit > 0, 1.0 / unit, 0.0)
            per_column = np.abs(row.d - d).reshape(unit.shape) * inverse
            change = np.abs(row.theta - theta).reshape(columns.count, -1)
            per_column[:, :p] += change[:, :p] * inverse[:, :p]
        nominal, half = columns.nominal, columns.half
        still = [k for k, term in enumerate(half, start=p) if not term.times_dt]
        for j, term in enumerate(nominal, start=p):  # |c| <= size x ..., by the term of the size that is constant
            if term in half:
                k, most = p + half.index(term), 1.0
            elif still:
                k, most = still[0], self.sums.dt_max
            else:
                continue
            per_column[:, k] += change[:, j] * most * inverse[:, k]
        return float(per_column.max(initial=0.0)) / row.scale * (1.0 + 1e-9)

    def _hold(self, row: Programmes, samples: Samples) -> None:
        row.hold(samples, self._like)
        self._like = row

    def _sizes(self) -> str:
        sizes = [len(row.pool) for row in self.rows]
        return "/".join(map(str, sizes)) if len(sizes) <= 12 else f"of {min(sizes)} to {max(sizes)} a row"

    # --- held samples ---

    def _settle(self, row: Programmes, solve: Callable[[Programmes], str], polish: bool = False) -> None:
        if not row.unknown:
            self._row_rounds[row.i] += 1
            return  # a sample that it does not contain contradicts it, as of any row that is settled
        for number in range(MAX_ROUNDS if row.refined else FEW_ROUNDS):
            self._solve_or_contradict(row, solve)
            self._row_rounds[row.i] += 1
            # most rows settle in 15 rounds; where rounding makes nearly every sample active, all of them may join
            most = None if number < 40 else max(JOIN, 2 * (row.r + row.q)) * 2 ** min(number - 40, 20)
            if row.widen_pool(most):
                continue
            if not polish:
                return
            row.polish()
            if not row.widen_pool(most):
                return
        raise FitError(f"row {row.i}: no working set after {MAX_ROUNDS} rounds; {_REMEDY}")

    def _solve_or_contradict(self, row: Programmes, solve: Callable[[Programmes], str]) -> None:
        try:
            self.solvers.add(solve(row))
        except FitError:
            if found := row.contradiction():
                raise InfeasibleError(row.i, *found) from None
            raise
