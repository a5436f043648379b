"""Criteria (10) and (11) to their exact optimum by solving on the few samples that matter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.errors import FitError
from uncertain_lti.identification.problem import BLOCK, Moments, Problem
from uncertain_lti.identification.solvers import Simplex, solve_qp

Array = NDArray[np.float64]
Index = NDArray[np.intp]

SUBSAMPLE = 10_000
"""Transitions of the first solve; full passes only correct it."""
TOLERANCE = 1e-11
"""Violation, in scaled units, below which a sample counts as contained; the repair lifts the rest."""
TIE_BREAK = 1e-8
"""Weight of the squared distance of the centre beside the squared widths.

|rate - centre| <= half-width for every sample, so the sum of squared distances is at most a quarter of (10), and
the optimum of the sum is within TIE_BREAK / 4 (relative) of the optimum of (10) alone, with the centre that the
stated tie-break asks for.
"""
WIDTH_SLACK = 1e-9
"""Relative room above δ of (11) in which its ties are broken; a solver needs some."""
BOUNDED_TIE_BREAK = 1e-5
"""The same among the optima of (11), a set so thin that the active-set solver needs the larger weight."""
MAX_ROUNDS = 200


@dataclass
class Solution:
    """theta (r, n) and d (q, n), unscaled columns per row i of the model, and how they were found.

    objective (n,): of the working set before the repair, so at most the optimum over all samples; violation (n,):
    largest violation left, in scaled units; delta (n,): optimum of (11) where that is the criterion.
    """

    theta: Array
    d: Array
    objective: Array
    violation: Array
    delta: Array | None = None
    rounds: int = 0
    passes: int = 0
    working: list[int] = field(default_factory=list)
    solvers: set[str] = field(default_factory=set)


class WorkingSet:
    """Candidate on a pool of samples, one pass over all samples, the most violated join the pool, until none is left.

    Parameters
    ----------
    problem : Problem
    moments : Moments
    progress : callable, optional
        Called with one line of text per full pass.
    """

    def __init__(self, problem: Problem, moments: Moments, progress: Callable[[str], None] | None = None) -> None:
        self.problem, self.moments = problem, moments
        self.progress = progress or (lambda text: None)
        self.free_phi = np.flatnonzero(moments.phi_scale > 0)
        self.free_psi = np.flatnonzero(moments.psi_scale > 0)
        self.phi_unit = 1.0 / moments.phi_scale[self.free_phi]
        self.psi_unit = 1.0 / moments.psi_scale[self.free_psi]
        self.r, self.q = len(self.free_phi), len(self.free_psi)
        n = problem.n
        self.coupled = moments.coupled is not None
        self.groups: list[tuple[int, ...]] = [(i,) for i in range(n)]
        self.pools: list[Index] = [np.empty(0, dtype=np.intp) for _ in range(n)]
        self.solution = Solution(
            np.zeros((len(moments.phi_scale), n)),
            np.zeros((len(moments.psi_scale), n)),
            np.zeros(n),
            np.zeros(n),
        )
        unit = self.phi_unit
        self._centre = moments.centre[np.ix_(self.free_phi, self.free_phi)] * np.outer(unit, unit) / problem.N
        self._target = moments.target[self.free_phi] * unit[:, None] / (problem.N * moments.rate_scale)
        unit = self.psi_unit
        within = np.ix_(self.free_psi, self.free_psi)
        self._plain = moments.plain_gram[within] * np.outer(unit, unit) / problem.N
        self._gram = [g[within] * np.outer(unit, unit) / problem.N for g in moments.gram]
        self._limit: Array | None = None  # δ of (11) per row while widths are bounded

    # --- the two criteria ---

    def quadratic(self) -> Solution:
        """Criterion (10)."""
        if self.coupled:
            self.groups = [tuple(range(self.problem.n))]
        self._start()
        self._iterate(self._solve_quadratic)
        return self.solution

    def linear(self) -> Solution:
        """Criterion (11), then least sum of squared widths among its optima, then the centre."""
        self._start()
        self._limit = np.full(self.problem.n, np.inf)
        self._simplex: list[tuple[Simplex, Index]] = []
        self._iterate(self._solve_linear)
        delta = self._limit.copy()
        self.solution.delta = delta
        self._limit = delta * (1.0 + WIDTH_SLACK)
        self._iterate(self._solve_bounded)
        self.solution.objective = delta
        return self.solution

    def violation(self) -> Array:
        """Largest violation of the solution as it stands, in scaled units, (n,): one pass."""
        return self._violators(None, 1)[1]

    # --- one row, or all rows where weights couple them, on the pool ---

    def _rows(self, i: int, samples: Index) -> tuple[Array, Array, Array]:
        """Scaled φ (K, r), ψ (K, q) and increment (K,) of row i, each divided by the sample's scaled size."""
        dt = self.problem.dt[samples, None]
        phi = self.problem.phi(samples)[:, self.free_phi] * dt * self.phi_unit
        psi = self.problem.psi(samples)[:, self.free_psi] * dt * self.psi_unit
        size = psi.sum(axis=1)
        y = self.problem.rate(samples)[:, i] * dt[:, 0] / self.moments.rate_scale[i]
        size = np.where(size > 0, size, 1.0)
        return phi / size[:, None], psi / size[:, None], y / size

    def _containment(self, i: int, samples: Index) -> tuple[Array, Array]:
        """G ξ >= h for ξ = [θ d] of row i: (8) and (9)."""
        phi, psi, y = self._rows(i, samples)
        return np.vstack([np.hstack([phi, psi]), np.hstack([-phi, psi])]), np.concatenate([y, -y])

    def _width_rows(self, i: int, samples: Index) -> Array:
        """a with a·d = √w_ii x (width) in units of rate_scale, (K, q)."""
        dt = self.problem.dt[samples, None]
        psi = self.problem.psi(samples)[:, self.free_psi] * dt * self.psi_unit
        return np.asarray(2.0 * np.sqrt(self.problem.row_weights(samples)[:, i, None]) * psi)

    def _store(self, i: int, theta: Array, d: Array) -> None:
        scale = self.moments.rate_scale[i]
        self.solution.theta[self.free_phi, i] = theta * self.phi_unit * scale
        self.solution.d[self.free_psi, i] = np.maximum(d, 0.0) * self.psi_unit * scale

    def _hessian(self, group: tuple[int, ...], gram: Array, tie_break: float) -> tuple[Array, Array]:
        """Squared widths, plus the tie-break on the centre; variables [θ d] row after row."""
        block = self.r + self.q
        H = np.zeros((block * len(group), block * len(group)))
        f = np.zeros(block * len(group))
        for position, i in enumerate(group):
            theta = slice(position * block, position * block + self.r)
            for other in range(len(group)):
                d_a = slice(position * block + self.r, (position + 1) * block)
                d_b = slice(other * block + self.r, (other + 1) * block)
                H[d_a, d_b] = gram[position * self.q : (position + 1) * self.q, other * self.q : (other + 1) * self.q]
            diagonal = np.diagonal(gram)[position * self.q : (position + 1) * self.q]
            weight = tie_break * float(diagonal.min(initial=1.0))
            H[theta, theta] = weight * (self._centre + 1e-10 * np.eye(self.r))
            f[theta] = -weight * self._target[:, i]
        ridge = np.zeros(len(f))
        for position in range(len(group)):
            d = slice(position * block + self.r, (position + 1) * block)
            ridge[d] = 1e-13 * np.diagonal(H)[d]
        H[np.diag_indices(len(f))] += ridge
        return H, f

    def _bounds(self, rows: int) -> tuple[Array, Array]:
        lower = np.tile(np.concatenate([np.full(self.r, -np.inf), np.zeros(self.q)]), rows)
        return lower, np.full(len(lower), np.inf)

    def _solve_quadratic(self, group: tuple[int, ...]) -> None:
        scale = self.moments.rate_scale[list(group)]
        if self.coupled:
            assert self.moments.coupled is not None
            q_all = len(self.moments.psi_scale)
            keep = (np.array(group)[:, None] * q_all + self.free_psi).ravel()
            unit = (scale[:, None] * self.psi_unit).ravel()
            gram = self.moments.coupled[np.ix_(keep, keep)] * np.outer(unit, unit) / self.problem.N
            gram /= np.diagonal(gram).max(initial=1e-300)
        else:
            gram = self._gram[group[0] if len(self._gram) > 1 else 0]
        H, f = self._hessian(group, gram, TIE_BREAK)
        block = self.r + self.q
        parts = [self._containment(i, self.pools[i]) for i in group]
        G = np.zeros((sum(len(h) for _, h in parts), block * len(group)))
        start = 0
        for position, (rows, _) in enumerate(parts):
            G[start : start + len(rows), position * block : (position + 1) * block] = rows
            start += len(rows)
        answer, solver = solve_qp(H, f, G, np.concatenate([h for _, h in parts]), *self._bounds(len(group)))
        self.solution.solvers.add(solver)
        for position, i in enumerate(group):
            part = answer[position * block : (position + 1) * block]
            self._store(i, part[: self.r], part[self.r :])

    def _solve_linear(self, group: tuple[int, ...]) -> None:
        (i,) = group
        assert self._limit is not None
        simplex, known = self._simplex_of(i)
        fresh = np.setdiff1d(self.pools[i], known)
        if len(fresh):
            G, h = self._containment(i, fresh)
            simplex.add(np.hstack([G, np.zeros((len(G), 1))]), h)
            widths = self._width_rows(i, fresh)
            size = np.maximum(widths.max(axis=1, keepdims=True, initial=0.0), 1.0)
            simplex.add(np.hstack([np.zeros((len(fresh), self.r)), -widths / size, 1.0 / size]), np.zeros(len(fresh)))
            self._simplex[i] = (simplex, self.pools[i])
        answer = simplex.solve()
        self.solution.solvers.add("HiGHS simplex")
        self._store(i, answer[: self.r], answer[self.r : -1])
        self._limit[i] = max(answer[-1], 0.0) * self.moments.rate_scale[i]

    def _simplex_of(self, i: int) -> tuple[Simplex, Index]:
        while len(self._simplex) < self.problem.n:
            cost = np.zeros(self.r + self.q + 1)
            cost[-1] = 1.0
            lower, upper = self._bounds(1)
            simplex = Simplex(cost, np.append(lower, 0.0), np.append(upper, np.inf))
            self._simplex.append((simplex, np.empty(0, dtype=np.intp)))
        return self._simplex[i]

    def _solve_bounded(self, group: tuple[int, ...]) -> None:
        (i,) = group
        assert self._limit is not None
        H, f = self._hessian(group, self._plain, BOUNDED_TIE_BREAK)
        G, h = self._containment(i, self.pools[i])
        limit = self._limit[i] / self.moments.rate_scale[i]
        widths = self._width_rows(i, self.pools[i])
        if limit > 0:
            widths, limit = widths / limit, 1.0
        G = np.vstack([G, np.hstack([np.zeros((len(widths), self.r)), -widths])])
        h = np.concatenate([h, np.full(len(widths), -limit)])
        answer, solver = solve_qp(H, f, G, h, *self._bounds(1))
        self.solution.solvers.add(solver)
        self._store(i, answer[: self.r], answer[self.r :])

    # --- the loop ---

    def _start(self) -> None:
        """Pools of the samples farthest from the least-squares centre, relative to their size."""
        ridge = 1e-12 * np.eye(self.r)
        theta: Array = np.linalg.lstsq(self._centre + ridge, self._target, rcond=None)[0].astype(np.float64)
        for i in range(self.problem.n):
            self._store(i, theta[:, i], np.zeros(self.q))
        blocks = -(-self.problem.N // BLOCK)
        for i, found in enumerate(self._violators(None, max(2, 4 * (self.r + self.q) // blocks))[0]):
            self.pools[i] = found

    def _iterate(self, solve: Callable[[tuple[int, ...]], None]) -> None:
        count = self.problem.N
        if count > 2 * SUBSAMPLE:
            stride = np.linspace(0, count - 1, SUBSAMPLE).astype(np.intp)
            self._until_contained(solve, np.unique(np.concatenate([stride, *self.pools])))
        self._until_contained(solve, None)

    def _until_contained(self, solve: Callable[[tuple[int, ...]], None], among: Index | None) -> None:
        todo = list(self.groups)
        per_block = 64 if among is not None or self.problem.N <= 8 * SUBSAMPLE else 12
        for _ in range(MAX_ROUNDS):
            for group in todo:
                solve(group)
            self.solution.rounds += 1
            found, worst = self._violators(among, per_block)
            self.solution.violation = worst
            if among is None:
                left = sum(map(len, found))
                self.progress(f"pass {self.solution.passes}: {left} samples outside, working set {self._sizes()}")
            added = []
            for i, samples in enumerate(found):
                fresh = np.setdiff1d(samples, self.pools[i])
                if len(fresh):
                    self.pools[i] = np.concatenate([self.pools[i], fresh])
                    added.append(i)
            todo = [g for g in self.groups if any(i in added for i in g)]
            if not todo:
                self.solution.working = [len(pool) for pool in self.pools]
                return
        raise FitError(
            f"the working set did not settle in {MAX_ROUNDS} rounds ({self._sizes()} samples); "
            f"scale the signals to order one"
        )

    def _sizes(self) -> str:
        return "/".join(str(len(pool)) for pool in self.pools)

    def _violators(self, among: Index | None, per_block: int) -> tuple[list[Index], Array]:
        """The most violated samples of each row, and the largest violation (n,), in one pass over the data."""
        problem, scale = self.problem, self.moments.rate_scale
        psi_unit = np.zeros(len(self.moments.psi_scale))
        psi_unit[self.free_psi] = self.psi_unit
        theta, d = self.solution.theta, self.solution.d
        found: list[list[Index]] = [[] for _ in range(problem.n)]
        worst = np.zeros(problem.n)
        if among is None:
            self.solution.passes += 1
            parts: list[slice | Index] = list(problem.blocks())
        else:
            parts = [among]
        for part in parts:
            psi = problem.psi(part)
            size = psi @ psi_unit
            size[size == 0.0] = np.inf  # rest without an additive term: nothing can be contained there but rest
            half = psi @ d
            excess = np.abs(problem.rate(part) - problem.phi(part) @ theta)
            excess -= half
            excess /= size[:, None]
            excess /= scale
            if self._limit is not None and np.isfinite(self._limit).all():
                width = 2.0 * half * problem.dt[part, None] * np.sqrt(problem.row_weights(part))
                over = width / np.maximum(self._limit, 1e-300) - 1.0
                excess = np.maximum(excess, over)
            peaks = excess.max(axis=0)
            worst = np.maximum(worst, peaks)
            for i in np.flatnonzero(peaks > TOLERANCE):
                column = excess[:, i]
                outside = np.flatnonzero(column > TOLERANCE)
                if len(outside) > per_block:
                    outside = outside[np.argpartition(column[outside], -per_block)[-per_block:]]
                found[i].append(outside + part.start if isinstance(part, slice) else part[outside])
        empty = np.empty(0, dtype=np.intp)
        return [np.concatenate(f) if f else empty for f in found], worst
