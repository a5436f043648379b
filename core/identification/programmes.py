# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The small programmes of a row on its working set: (10), (11), their ties, and what bounds them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any, Self

import numpy as np

from uncertain_lti.base.arrays import Array, Index
from uncertain_lti.base.errors import FitError
from uncertain_lti.identification import solvers
from uncertain_lti.identification.row import COLLINEAR, TOLERANCE, Row

TIE_BREAK = 1e-8
"""Weight of the squared distance of the centre relative to the squared half-widths.

|rate - centre| <= half-width for every sample, so the sum of squared distances is at most that of squared half-widths,
and the optimum of the sum is within TIE_BREAK (relative) of the optimum of (10) alone, with the centre that the stated
tie-break asks for.
"""
ROUGH = 1e-4
"""Violation, in scaled units, up to which a first answer is worth judging: how good it is, is measured at the end."""
WIDTH_SLACK = 2e-8
"""Relative room above δ of (11) in which its ties are broken: closer to δ, what they are is rounding."""
BOUNDED_TIE_BREAK = 1e-5
"""The same as TIE_BREAK among the optima of (11), a set so thin that the active-set solver needs the larger weight."""
REGULARISATION = 1e-4
"""Weight of the squared widths relative to δ in (11), for a solver of strictly convex programmes.

With a weight that is small enough, and a small one is, the minimum of the sum is that of δ, and among its optima that
of the squared widths. Whether it was is seen from the optimum of δ alone, at the end.
"""
_ATTEMPTS = ((1.0, 1e-10), (10.0, 1e-8), (100.0, 1e-6))  # factor on the tie-break's weight, ridge of the centre
_ROWS = {"quadratic": 2, "nominal": 2, "regularised": 3}
"""Rows of a sample in each kind of programme."""
_LIKE = 1e4
"""Factor on the tie-break's weight with which an interior point looks for what is active."""
_POSITIVE = 1e-9
"""Relative multiplier of (11) above which it is none of rounding."""
_HELD = 12
"""Rows per unknown that the simplex method keeps from one working set to the next; its steps take longer with more."""
GOOD = 1e-7
"""Relative distance from the optimum, repair included, above which a row is solved again, in refined coordinates."""


class Programmes(Row):
    """A row with its programmes, and what their solvers start from; takes the arguments of `Row`."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._unit = 1.0  # of the δ that the nominal elements alone decide, in units of the row's limit
        self.allowed = 0.0  # δ that the ties may have, in the same units
        self.exact = False  # (11) by the simplex method
        self.least = 0.0  # δ of (11) that it or `nominal` found, in the same units as the limit
        self._face: solvers.Face | None = None
        self.attempt: tuple[float, float] = _ATTEMPTS[0]
        self._last: dict[str, solvers.Answer] = {}  # to the last programme of a kind
        self._start_simplex_afresh()

    def _start_simplex_afresh(self) -> None:
        self._simplex: solvers.Simplex | None = None
        self._known: Index = np.empty(0, dtype=np.intp)

    def refine(self) -> None:
        """Go over to refined coordinates of the row, in which solvers start afresh."""
        super().refine()
        self.attempt, self._last = _ATTEMPTS[0], {}
        self._start_simplex_afresh()

    def release(self, whole: bool = False) -> None:
        """Hold the working set alone; unless the whole of it, what the last programmes rest on and the nearest."""
        slack, pool = self.slack(), self.pool
        kept, active = np.full(len(pool), whole), {kind: self._sides(kind) for kind in self._last}
        kept[np.argsort(slack[pool])[: self.r + self.q]] = True
        for sides in active.values():
            if sides is not None:
                kept[: sides.shape[1]] |= sides.any(axis=0)
        more = np.setdiff1d(np.flatnonzero(slack < 0.0), pool)  # outside by rounding
        self.pool = np.concatenate([pool[kept], more])
        self.hold(self.samples[np.sort(self.pool)])
        for kind, last in self._last.items():
            if last.active is not None and (sides := active[kind]) is not None:
                some = sides[:, kept[: sides.shape[1]]]
                some = np.pad(some, ((0, 0), (0, len(self.pool) - some.shape[1]))).ravel()
                start, asked = last.active[: len(last.xi)], last.active[len(last.active) - len(self.asked) :]
                self._last[kind] = replace(last, active=np.concatenate([start, some, asked]))
        self._start_simplex_afresh()

    def drop(self, index: int) -> None:
        """Take a transition out of what the row holds."""
        super().drop(index)
        self._start_simplex_afresh()

    def trial(self) -> Self:
        """A row that can be solved on its own, from where the last programmes of this one ended."""
        trial = super().trial()
        trial._last = dict(self._last)
        trial._start_simplex_afresh()
        return trial

    def _solve(
        self,
        kind: str,
        objective: Callable[[float, float], tuple[Array, Array]],
        G: Array,
        h: Array,
        lower: Array,
        upper: Array,
        any_solver: bool = False,
    ) -> tuple[Array, str]:
        """Solve a programme whose rows are some for each sample of the pool, from where the last of its kind ended.

        objective(factor on the tie-break, ridge) -> H, f. Raises FitError where DAQP, or any solver, gives up.
        """
        feasible = solvers.FEASIBLE if self.refined else ROUGH
        last, known, start = self._last.get(kind), self._sides(kind), None
        if last is not None and last.active is not None and known is not None and len(self.pool):
            known = known[:, : len(self.pool)]  # the pool grows, but for discards
            start = np.zeros(len(lower) + len(h) + len(self.asked), dtype=np.int32)
            start[: len(lower)] = last.active[: len(lower)]
            there = start[len(lower) : len(lower) + len(h)].reshape(known.shape[0], -1)
            there[:, : known.shape[1]] = known
        begin = np.zeros(len(lower)) if last is None else last.xi
        if last is None and self.basis is None:
            begin[: self.r] = self.scaled()[0]
        limits = *self._with_asked(G, h), lower, upper
        moves_on = kind == "regularised" and last is not None  # with its tie-break
        inside = len(lower) >= solvers.MANY and not moves_on
        accurate = len(lower) >= solvers.VERY_MANY and kind == "quadratic"
        for self.attempt in _ATTEMPTS:
            programme = solvers.Programme(*objective(*self.attempt), *limits)
            like = objective(_LIKE * self.attempt[0], self.attempt[1]) if inside else None
            try:
                answer = solvers.solve_near(programme, begin, start, feasible, like=like, accurate=accurate)
                break
            except FitError:
                continue
        else:
            if not any_solver:
                raise FitError("DAQP could not solve the quadratic programme")
            answer = solvers.solve_qp(solvers.Programme(*objective(*self.attempt), *limits), feasible=feasible)
        self._last[kind] = answer
        return answer.xi, answer.solver

    def _sides(self, kind: str) -> solvers.Sense | None:
        """Which rows of each sample were active in the last programme of a kind, (rows, samples of its pool)."""
        last = self._last.get(kind)
        if last is None or last.active is None:
            return None
        return last.active[len(last.xi) : len(last.active) - len(self.asked)].reshape(_ROWS[kind], -1)

    def carrying(self, slack: float) -> Index:
        """Samples whose absence may lower the optimum of (10): with multipliers, or next to the edge if none are known.

        Without another one the same multipliers prove the same optimum.
        """
        sides = self._sides("quadratic")
        if sides is None or sides.shape[1] != len(self.pool):
            return np.flatnonzero(self.slack() < slack)
        return np.asarray(self.pool[(sides != 0).any(axis=0)])

    def _active_sets(self, kind: str, count: int) -> list[solvers.Sense | None]:
        """What to make multipliers of: what was active in the last programme of a kind and size, then the slack."""
        last = self._last.get(kind)
        return [None] if last is None or last.active is None or len(last.active) != count else [last.active, None]

    def quadratic(self) -> str:
        """Solve (10) on the working set; of many unknowns, with what is next to join it."""
        if self.r + self.q >= solvers.VERY_MANY:
            self.widen_pool((self.r + self.q) // 2, np.inf)

        def objective(factor: float, ridge: float) -> tuple[Array, Array]:
            return self.hessian(self.gram, self.gradient, factor * TIE_BREAK, ridge)

        limits = *self.containment(self.pool), self.lower, self.upper
        answer, solver = self._solve("quadratic", objective, *limits, any_solver=True)
        self.store(answer)
        return solver

    def regularised(self) -> str:
        """Solve (11) with a little of the squared widths on the working set."""
        size = self.r + self.q

        def objective(factor: float, ridge: float) -> tuple[Array, Array]:
            H, f = self.hessian(self.plain, self.plain_gradient, factor * BOUNDED_TIE_BREAK, ridge)
            whole = REGULARISATION * np.eye(size + 1)
            whole[:size, :size] = REGULARISATION * H
            return whole, np.append(REGULARISATION * f, 1.0)

        limits = np.append(self.lower, 0.0), np.append(self.upper, np.inf)
        answer, solver = self._solve("regularised", objective, *self.rows(self.pool), *limits)
        self.store_limited(answer)
        return solver

    def nominal(self) -> str:
        """Solve (11) on the working set for the nominal elements alone, with half-widths of one size (`box`)."""
        box = self.box
        assert box is not None
        if "nominal" not in self._last:
            self._set_unit()

        def objective(factor: float, ridge: float) -> tuple[Array, Array]:
            weight = factor * REGULARISATION * BOUNDED_TIE_BREAK
            H = REGULARISATION * np.eye(self.r + 1)
            H[:-1, :-1] = weight * (self.centre + ridge * np.eye(self.r))
            return H, np.append(-weight * self.target, 1.0)

        limits = np.append(self.lower[: self.r], 0.0), np.append(self.upper[: self.r], np.inf)
        answer, solver = self._solve("nominal", objective, *self._distances(self.pool), *limits)
        delta, self._face = answer[-1] * self._unit, None
        self.store_limited(np.concatenate([answer[:-1], box * delta, [delta]]))
        return solver

    def _set_unit(self) -> None:
        self._unit = float(np.median(self.width[self.pool] if len(self.pool) else self.width))

    def linear(self) -> str:
        """Solve (11) on the working set, by the simplex method."""
        box = self.box
        if box is not None and self._simplex is None:
            self._set_unit()
        G, h = self.rows(self.pool) if box is None else self._distances(self.pool)
        kinds = 3 if box is None else 2
        number = self._numbers(kinds)
        if self._simplex is None:  # of each sample the side that it is on, and its width
            self._simplex = self.minimax(nominal_alone=box is not None)
            theta, d = self.scaled()
            away = self.plain_phi[self.pool] @ theta - self.y[self.pool]
            half = self.psi[self.pool] @ d + self.half[self.pool]
            outside = np.concatenate([away + half, half - away]) < 0.0
            width = outside.reshape(2, -1).any(axis=0)
            wanted = np.concatenate([outside, width]) if box is None else outside
        else:
            wanted = G @ self._simplex.solution() - h < -TOLERANCE
            idle = self._simplex.idle(_HELD * (G.shape[1] - 1))
            idle = idle[idle >= len(self.asked)]  # those come first, and stay
            if len(idle):
                self._simplex.drop(idle)
                self._known = np.delete(self._known, idle - len(self.asked))
        others = ~np.isin(number, self._known)  # rows that the simplex method does not have
        while True:  # of a sample few have more than one row that matters
            wanted &= others
            if wanted.any():
                self._simplex.add(G[wanted], h[wanted])
                self._known = np.concatenate([self._known, number[wanted]])
                others &= ~wanted
            answer = self._simplex.solve()
            wanted = G @ answer - h < -TOLERANCE
            if not (wanted & others).any():
                break
        if box is not None:
            delta = answer[-1] * self._unit
            answer = np.concatenate([answer[:-1], box * delta, [delta]])
        self.least, self._face = float(answer[-1]), None
        self.store_limited(answer)
        return "HiGHS simplex"

    @property
    def box(self) -> Array | None:
        """Scaled half-widths with which every sample is as wide as any other, by 1 in units of the limit.

        With them the largest distance of a recorded next sample from the centre is all that (11) has to make small:
        where half-widths exceed it nowhere, those of one size do so nowhere either. So the nominal elements are the
        only unknowns of δ, and what other half-widths are among its optima is left to the ties. None where the
        structure or the recordings have no such half-widths.
        """
        sums, columns = self.sums, self.columns
        least_known = self.fixed_d.any() or (self.lower[self.r :] > 0.0).any()
        if least_known or sums.gram is not None or sums.coupled is not None or not len(self.samples):
            return None
        for k, term in enumerate(columns.half, start=len(sums.low)):
            wanted, found = np.zeros((columns.count, len(self.d) // columns.count)), np.zeros(len(self.d))
            wanted[:, k] = 1.0
            unknown = wanted.ravel()[self.free_psi]
            self.psi_columns.put(found, unknown)
            there = self.size_unit > 0.0  # the others are 0 in every sample
            constant = not term.times_dt or sums.dt_min == sums.dt_max
            all_of_it = np.array_equal(found[there], wanted.ravel()[there])
            if constant and all_of_it and np.isinf(self.upper[self.r :][unknown > 0.0]).all():
                box = unknown / (self.unit_psi * self.scale)
                return np.asarray(box / (self.width[0] * float(self.psi[0] @ box)))
        return None

    def _distances(self, pool: Index) -> tuple[Array, Array]:
        """G [θ δ] >= h: the centre of samples of the pool is no further from the next sample than δ allows.

        δ is in units of order one, whatever the weights are.
        """
        width = self.width[pool] / self._unit
        unit = np.minimum(1.0, 1.0 / width)
        phi, y = self.along(pool) * (width * unit)[:, None], self.y[pool] * width * unit
        sides = np.hstack([phi, unit[:, None]]), np.hstack([-phi, unit[:, None]])
        return np.vstack(sides), np.concatenate([y, -y])

    def least_width(self) -> float:
        """A lower bound of δ, in units of scale, by multipliers; -inf where there are none."""
        bound = -np.inf
        assert self.limit is not None
        G, h = self._with_asked(*self.rows(self.pool))
        xi, cost = np.append(np.concatenate(self.scaled()), self.limit), np.append(np.zeros(self.r + self.q), 1.0)
        low, high = np.append(self.lower, 0.0), np.append(self.upper, np.inf)
        for active in self._active_sets("regularised", len(xi) + len(h)):
            bound = max(bound, solvers.linear_bound(cost, G, h, low, high, xi, active)[0])
            if self.limit <= (1.0 + 2.0 * WIDTH_SLACK) * bound:
                break
        return bound

    def minimax(self, nominal_alone: bool = False) -> solvers.Simplex:
        """Minimise δ, the last unknown, after all others or the nominal elements alone."""
        size = self.r if nominal_alone else self.r + self.q
        cost = np.append(np.zeros(size), 1.0)
        simplex = solvers.Simplex(cost, np.append(self.lower[:size], 0.0), np.append(self.upper[:size], np.inf))
        simplex.add(*self._with_asked(np.empty((0, len(cost))), np.empty(0)))
        return simplex

    def duality_gap(self) -> float:
        """How far the squared widths of this row are above the optimum at most, relative to it, by the dual objective.

        The programme that is solved adds the tie-break and the ridge to the squared widths; both are bounded. inf
        where the columns are so collinear that the ridge is not.
        """
        if not self.unknown:
            return 0.0
        theta, d = self.scaled()
        factor, ridge = self.attempt
        if self.basis is not None:
            theta = np.linalg.lstsq(self.basis, theta, rcond=None)[0].astype(np.float64)
        H, f = self.hessian(self.gram, self.gradient, factor * TIE_BREAK, ridge)
        xi = np.concatenate([theta, d])
        programme = solvers.Programme(H, f, *self._with_asked(*self.containment(self.pool)), self.lower, self.upper)
        objective, value = float(0.5 * xi @ H @ xi + f @ xi), max(self.value(d), self.least_value())
        above = np.inf
        for active in self._active_sets("quadratic", len(f) + len(programme.h)):
            above = min(above, objective - solvers.dual_bound(programme, xi, active))
            if above <= GOOD * value:
                break
        weight = factor * TIE_BREAK * float(np.diagonal(self.gram).min(initial=1.0))
        spread = max(float(d @ self.plain @ d), 0.0)
        smallest = self._least_effect()
        largest = (self.rms_step / self.scale + np.sqrt(spread) + float(np.abs(self.half).max(initial=0.0))) ** 2
        lifted = 0.5 * weight * ridge * 4.0 * largest / smallest if smallest > 1e-13 else np.inf
        ties = factor * TIE_BREAK * (1.0 if self.sums.gram is None else float(len(d)))
        return float(max(above, 0.0) + lifted) / value + ties

    def _least_effect(self) -> float:
        """Least mean square effect that unknowns of unit length have on the centre, but for those that have none.

        A state or control that schedules the model moves with the drift of all knots: some elements can change
        together without moving any sample, and of those no one needs to be large.
        """
        free = np.isinf(self.lower[: self.r]) & np.isinf(self.upper[: self.r])
        values, directions = np.linalg.eigh(self.centre)
        for value, direction in zip(values.tolist(), directions.T, strict=True):
            if value > 1e-13 or not free[np.abs(direction) > COLLINEAR].all():
                return float(value)
            along = direction if self.basis is None else self.basis @ direction
            if np.abs(self.plain_phi @ along).max(initial=0.0) > COLLINEAR:
                return float(value)
        return 1.0

    def among(self) -> str:
        """(10) with full weights, of this row given the others.

        If another row is wider by many orders of magnitude, what it weighs here is as many times steeper than the
        row's own part. Either this row follows it, and is solved in its units, or the row is as narrow as can be.
        """
        try:
            return self.quadratic()
        except FitError:
            steep = float(np.abs(self.gradient).max(initial=0.0))
            if steep <= 1.0:
                raise
        if -self.gradient.min() >= self.gradient.max():
            H, f = self.hessian(self.gram, self.gradient, TIE_BREAK)
            G, h = self._with_asked(*self.containment(self.pool))
            answer = solvers.solve_qp(
                solvers.Programme(H, f / steep, G, h / steep, self.lower / steep, self.upper / steep)
            )
            self.store(answer.xi * steep)
            return answer.solver
        self.store(self._narrowest(self.gradient / steep))
        return "HiGHS simplex"

    def collinear(self) -> bool:
        """Tell whether columns are so alike that the simplex method's tolerance is none on the envelope."""
        return self.r > 0 and not self.refined and self._least_effect() < 1e-8

    def least_linear(self, cost: Array, most: Array | None = None) -> float:
        """Minimise costᵀ d over scaled half-widths that contain the working set.

        `cost` (q,): of the free half-widths; `most` (q,): they are no larger than this.
        """
        return float(cost @ self._narrowest(cost, most)[self.r :])

    def _narrowest(self, cost: Array, most: Array | None = None) -> Array:
        """Scaled unknowns with that minimum."""
        upper = self.upper.copy()
        if most is not None:
            upper[self.r :] = np.minimum(upper[self.r :], most)
        simplex = solvers.Simplex(np.concatenate([np.zeros(self.r), cost]), self.lower, upper)
        simplex.add(*self._with_asked(*self.containment(self.pool)))
        return simplex.solve()

    def linear_gap(self) -> float:
        """As `duality_gap`, by the simplex method.

        (10) is convex, so its optimum is no less than its linearisation here at any elements that contain
        the working set. It needs neither multipliers nor a Hessian that can be inverted.
        """
        _, d = self.scaled()
        slope = self.gram @ d + self.gradient
        largest = float(np.abs(slope).max(initial=0.0))
        if largest == 0.0:
            return 0.0
        try:
            least = self.least_linear(slope / largest) * largest
        except FitError:
            return np.inf
        return max(float(slope @ d) - least, 0.0) / max(self.value(d), self.least_value())

    def rows(self, pool: Index) -> tuple[Array, Array]:
        """G [ξ δ] >= h: (8), (9) and the limit on the width for samples of the pool."""
        G, h = self.containment(pool)
        width = self.width[pool]
        unit = np.minimum(1.0, 1.0 / width)[:, None]  # δ - width x (ψ d + half) >= 0, scaled to order one
        rows = np.hstack([np.zeros((len(pool), self.r)), -width[:, None] * self.psi[pool], np.ones((len(pool), 1))])
        limits = np.concatenate([h, width * self.half[pool] * unit[:, 0]])
        return np.vstack([np.hstack([G, np.zeros((len(G), 1))]), rows * unit]), limits

    def bounded(self) -> str:
        """Least squared widths, then the centre, among what is as good by (11), sought from an optimum of it.

        What has a price is met with equality in every optimum, so it stays as it is.
        """
        face = self.face()
        G, h = self.rows(self.pool)
        rows, limits = self._with_asked(G[:, :-1], h - G[:, -1] * self.allowed)
        more = len(self.pool) - face.samples.shape[1]  # the pool grew since
        tight = np.concatenate([face.bounds, np.pad(face.samples, ((0, 0), (0, more))).ravel(), face.asked])
        H, f = self.hessian(self.plain, self.plain_gradient, BOUNDED_TIE_BREAK)
        limits = np.minimum(limits - rows @ face.xi, 0.0)  # the optimum satisfies them, but for rounding
        programme = solvers.Programme(H, f + H @ face.xi, rows, limits, self.lower - face.xi, self.upper - face.xi)
        self.attempt, step, solver = _ATTEMPTS[0], np.zeros(len(face.xi)), ""
        with suppress(FitError):  # or the ties stay as they are
            step, solver = solvers.solve_on_face(programme, tight)
        self.store_limited(np.append(face.xi + step, self.allowed))
        return solver or ("HiGHS simplex" if self.exact else self._last["nominal"].solver)

    def face(self) -> solvers.Face:
        """Where the optima of (11) are, on the working set of the last that was found.

        Raises FitError where no multipliers prove that it was one.
        """
        if self._face is None:
            box, count = self.box, len(self.pool)
            kinds = 3 if box is None else 2
            xi, prices = self._priced(kinds) if self.exact else self._proven()
            size = len(xi) - 1
            tight = np.abs(prices) > _POSITIVE * np.abs(prices).max(initial=0.0)
            bounds, samples, asked = np.split(tight, [size, len(tight) - len(self.asked)])
            samples = samples.reshape(kinds, count)
            if box is not None:  # a sample that is as far off as it may be is as wide as it may be
                xi = np.concatenate([xi[:-1], box * (xi[-1] * self._unit), xi[-1:]])
                bounds, samples = np.pad(bounds, (0, self.q)), np.vstack([samples, samples.any(axis=0)])
            self._face = solvers.Face(xi[:-1], bounds, samples, asked)
        return self._face

    def _priced(self, kinds: int) -> tuple[Array, Array]:
        """[ξ δ] of the simplex method, and its prices of [bounds of ξ; rows of the pool; what is asked]."""
        assert self._simplex is not None
        duals, number, asked = self._simplex.duals(), self._numbers(kinds), len(self.asked)
        order, prices = np.argsort(number), np.zeros(len(number))
        prices[order[np.searchsorted(number, self._known, sorter=order)]] = duals[asked:]
        return self._simplex.solution(), np.concatenate([self._simplex.reduced_costs()[:-1], prices, duals[:asked]])

    def _proven(self) -> tuple[Array, Array]:
        """The same of `nominal`, by the multipliers that prove its δ, which becomes `least`."""
        xi = self._last["nominal"].xi
        G, h = self._with_asked(*self._distances(self.pool))
        limits = np.append(self.lower[: self.r], 0.0), np.append(self.upper[: self.r], np.inf)
        for active in self._active_sets("nominal", len(xi) + len(h)):
            bound, prices = solvers.linear_bound(np.eye(len(xi))[-1], G, h, *limits, xi, active)
            if xi[-1] <= (1.0 + WIDTH_SLACK) * bound:
                self.least = bound * self._unit
                return xi, np.delete(prices, len(xi) - 1)
        raise FitError("no multipliers prove the least largest width")

    def _numbers(self, kinds: int) -> Index:
        """A number for each row of the samples of the pool, by which the simplex method's are known."""
        index = self.samples.index[self.pool]
        return np.asarray(kinds * np.tile(index, kinds) + np.repeat(np.arange(kinds), len(index)))

    def polish(self) -> None:
        """Solve for the centre again, with the half-widths as they are: the tie-break on its own.

        Beside the squared widths it weighs so little that their rounding shows in the elements.
        """
        if self.r == 0:
            return
        phi, psi = self.along(self.pool), self.psi[self.pool]
        half = psi @ (self.d[self.free_psi] / (self.unit_psi * self.scale)) + self.half[self.pool]
        y = self.y[self.pool]
        try:
            inside = self._with_asked(np.vstack([phi, -phi]), np.concatenate([y - half, -y - half]))
            H, limits = self.centre + self.attempt[1] * np.eye(self.r), (self.lower[: self.r], self.upper[: self.r])
            programme = solvers.Programme(H, -self.target, *inside, *limits)
            feasible = solvers.FEASIBLE if self.refined else ROUGH
            if self.r < solvers.MANY:
                answer = solvers.solve_qp(programme, any_solver=False, feasible=feasible)
            else:
                begin = self.scaled()[0] if self.basis is None else np.zeros(self.r)
                answer = solvers.solve_near(programme, begin, feasible=feasible, like=programme[:2])
        except FitError:  # the half-widths leave no room at all
            return
        self.store_theta(answer.xi)

    def contradiction(self) -> tuple[int, float, int] | None:
        """A sample that no elements within the structure can contain, alone or with others."""

        def least(pool: Index) -> tuple[Array, Array, Array]:
            simplex = self.minimax()
            G, h = self.containment(pool)
            simplex.add(np.hstack([G, np.ones((len(G), 1))]), h)
            answer = simplex.solve()
            prices = np.abs(simplex.duals()[len(self.asked) :]).reshape(2, -1).sum(axis=0)
            return answer, (h - G @ answer[:-1]).reshape(2, -1).max(axis=0), prices

        answer, short, prices = least(self.pool)
        if answer[-1] <= 1e-9:
            return None
        against = np.flatnonzero(prices > 1e-9 * prices.max(initial=0.0))  # they prove that there is no answer
        worst = int(against[np.argmax(short[against])]) if len(against) else int(np.argmax(short))
        distance, together = float(answer[-1]), len(against) - 1
        for position in against[np.argsort(-short[against])]:
            alone = float(least(self.pool[[position]])[0][-1])
            if alone > 1e-9:
                worst, distance, together = int(position), alone, 0
                break
        sample = int(self.pool[worst])
        return int(self.samples.index[sample]), distance * float(self.sizes(sample)) * self.scale, max(together, 0)

    def _with_asked(self, G: Array, h: Array) -> tuple[Array, Array]:
        """Rows G ξ >= h, and what the structure asks of θ if that is no bound of an unknown."""
        if not len(self.asked):
            return G, h
        rows = np.hstack([self.asked, np.zeros((len(self.asked), G.shape[1] - self.r))])
        return np.vstack([G, rows]), np.concatenate([h, self.asked_limits])
