# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Small dense programmes to high accuracy: the solvers that the working set calls, each with its fallback."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array, Index
from uncertain_lti.base.errors import FitError

Sense = NDArray[np.int32]

FEASIBLE = 1e-9
"""Largest violation, in scaled units, of an answer that counts as solved; the repair covers it."""

_SLIGHT = 1e-11
"""The same of a row that the programme left out."""
_HOLD = 1e-2
"""Share of the largest weight with which a step is held back that mends what an answer violates."""
_MENDED = 1e-12
"""What is not worth mending."""
_FIRMER = (1.0, 1e3, 1e6)
"""Factors on it, tried in turn: the firmer, the finer is the solver's tolerance."""
_NEAR = 2
"""Rows per unknown that a programme begins with."""
MANY = 60
"""Unknowns from which on an interior point finds what is active sooner than an active-set method."""
_ALONG, _FIXED = 1e-6, 1e-9
"""Relative singular value below which rows leave a direction, and relative size of a row that does not see it."""
_ANEW, _FAR, _NEAR_INSIDE = 0.02, 0.05, 3
"""Then: violated rows per unknown from which on it begins anew, and those from which on it takes more rows, so many."""
VERY_MANY = 150
"""Unknowns of (10) from which on its accurate answers, proven by equations, take less time than to move on by steps."""
_INDEPENDENT = 1e-10
"""Relative size below which what a row adds to others is rounding."""


@dataclass(frozen=True)
class Face:
    """Where the optima of (11) are: what is met with equality in all of them, and one of them.

    `xi` (r + q,): that one; `bounds` (r + q,): which bounds of ξ; `samples` (3, K): which rows of the first K samples
    of the pool, as of `Programmes.rows`; `asked`: which rows of what the structure asks.
    """

    xi: Array
    bounds: NDArray[np.bool_]
    samples: NDArray[np.bool_]
    asked: NDArray[np.bool_]


@dataclass(frozen=True)
class Answer:
    """Minimiser ξ of a programme.

    `xi` (variables,): ξ; `solver`: who found it; `active`: of [bounds of ξ; rows of G]: 0 not active, 1 at the upper, 3
    at the lower bound (DAQP's words); None where the solver does not report it.
    """

    xi: Array
    solver: str
    active: Sense | None


class Programme(NamedTuple):
    """Minimise ½ ξᵀHξ + fᵀξ subject to G ξ >= h, lower <= ξ <= upper; everything scaled to order one.

    `H` (v, v): positive definite; `f` (v,): linear term; `G` (K, v): rows of the constraints; `h` (K,): their lower
    limits; `lower` (v,): bounds of ξ; -inf for none; `upper` (v,): bounds of ξ; inf for none.
    """

    H: Array
    f: Array
    G: Array
    h: Array
    lower: Array
    upper: Array

    def held(self, hold: float, xi: Array) -> Programme:
        """The same with half of `hold` times the square of the distance from ξ (v,) more."""
        return self._replace(H=self.H + hold * np.eye(len(xi)), f=self.f - hold * xi)


def solve_qp(
    of: Programme,
    active: Sense | None = None,
    any_solver: bool = True,
    feasible: float = FEASIBLE,
    equations: bool = False,
) -> Answer:
    """Minimise a programme; `equations`: what is active may well be so to the last row.

    DAQP (dual active set, exact to rounding) first; PIQP if it gives up or returns what violates a row by more than
    `FEASIBLE`. DAQP's tolerance is one on rows in the metric of H, coarse where H hardly weighs an unknown: what it
    leaves is mended with the step held back.
    """
    answer, violation = _solved(of, active, any_solver, feasible, equations)
    hold = _HOLD * float(np.diagonal(of.H).max(initial=0.0))
    for factor in _FIRMER:
        while violation > _MENDED and answer.active is not None:
            try:
                nearer, left = _solved(of.held(factor * hold, answer.xi), answer.active, False, feasible, equations)
            except FitError:
                break
            if left > 0.1 * violation:
                break
            answer, violation = replace(nearer, active=answer.active), left  # what the objective itself rests on
    return answer


def _solved(
    of: Programme, active: Sense | None, any_solver: bool, feasible: float, equations: bool
) -> tuple[Answer, float]:
    """The answer of the first solver that has a good one, and by how much it violates a row."""
    scaled, s = _scaled(of)
    best: tuple[float, Answer] | None = None
    in_turn = _SOLVERS if any_solver else _SOLVERS[:1]
    if equations and active is not None:
        in_turn = (("PIQP", _by_equations), *in_turn)
    for name, solver in in_turn:
        answer, found = solver(scaled, active)
        if answer is None or not np.isfinite(answer).all():
            continue
        answer = np.clip(answer, scaled.lower, scaled.upper) * s
        violation = float(np.max(of.h - of.G @ answer, initial=0.0))  # not that of what was scaled for the solver
        if best is None or violation < best[0]:
            best = (violation, Answer(answer, name, found))
        if violation <= FEASIBLE:
            break
    if best is not None and best[0] <= feasible:
        return best[1], best[0]
    names = ", ".join(name for name, _ in _SOLVERS)
    raise FitError(f"no solver ({names}) could solve the quadratic programme; scale the signals to order one")


def _scaled(of: Programme) -> tuple[Programme, Array]:
    """A programme whose Hessian has a diagonal of ones, harmless to every solver, and the unit of each unknown."""
    s = 1.0 / np.sqrt(np.maximum(np.diagonal(of.H), 1e-300))
    G = of.G * s
    norm = np.abs(G).max(axis=1, initial=0.0)
    norm[norm == 0.0] = 1.0
    return Programme(of.H * np.outer(s, s), of.f * s, G / norm[:, None], of.h / norm, of.lower / s, of.upper / s), s


def solve_near(
    of: Programme,
    xi: Array,
    active: Sense | None = None,
    feasible: float = FEASIBLE,
    any_solver: bool = False,
    like: tuple[Array, Array] | None = None,
    accurate: bool = False,
) -> Answer:
    """As `solve_qp`, with the rows that are near at ξ alone, and then those that the answer violates.

    A strictly convex programme has one minimiser, so it does not matter which other rows were left out. `like`: H and f
    of a better conditioned objective whose minimiser has nearly the same rows active: an interior point starts there,
    and if `accurate` again wherever rows are violated.
    """
    (G, h), size = of[2:4], len(of.f)
    slack = G @ xi - h
    wanted = slack < -_SLIGHT
    far = like is not None and (active is None or np.count_nonzero(wanted) > _FAR * size)
    if active is not None:
        wanted |= active[size:] > 0
    near = (_NEAR_INSIDE if far else _NEAR) * size
    wanted[np.argpartition(slack, near)[:near] if len(slack) > near else slice(None)] = True
    few = 0.0 if accurate else _ANEW * size
    while True:
        start = None if active is None else np.concatenate([active[:size], active[size:][wanted]])
        some = of._replace(G=G[wanted], h=h[wanted])
        if like is not None and (start is None or np.count_nonzero(slack[wanted] < -_SLIGHT) > few):
            start = _active_inside(some._replace(H=like[0], f=like[1]), 1e-12 if accurate else 1e-9)
        answer = solve_qp(some, start, any_solver, feasible, accurate)
        if answer.active is None:
            active = None
        else:
            active = np.zeros(size + len(h), dtype=np.int32)
            active[:size] = answer.active[:size]
            active[size:][wanted] = answer.active[size:]
        slack = G @ answer.xi - h
        left = ~wanted & (slack < -_SLIGHT)
        if not left.any():
            return Answer(answer.xi, answer.solver, active)
        wanted |= left


_Found = tuple[Array | None, Sense | None]


def _daqp(of: Programme, active: Sense | None) -> _Found:
    import daqp

    size, count = len(of.f), len(of.h)
    bupper = np.concatenate([np.minimum(of.upper, 1e30), np.full(count, 1e30)])
    blower = np.concatenate([np.maximum(of.lower, -1e30), of.h])
    H, G = np.ascontiguousarray(of.H), np.ascontiguousarray(of.G)
    cold = np.zeros(size + count, dtype=np.int32)
    for sense in (cold,) if active is None else (active.copy(), cold):
        given = H, of.f, G, bupper, blower, sense
        x, _, flag, info = daqp.solve(*given, primal_tol=1e-11, iter_limit=20_000, cycle_tol=100)
        if flag == 1:
            multiplier = np.asarray(info["lam"])
            found = np.where(multiplier < 0, 3, np.where(multiplier > 0, 1, 0)).astype(np.int32)
            return np.asarray(x, dtype=np.float64), found
    return None, None


def _by_equations(of: Programme, active: Sense | None) -> _Found:
    """The minimiser where what an interior point says is active is so, by the equations of that, as multipliers prove.

    With H = L Lᵀ and L⁻¹ Cᵀ = Q R, of what is active, C ξ = l: Lᵀ ξ = Q (R⁻ᵀ l + Qᵀ g) - g and R λ = R⁻ᵀ l + Qᵀ g,
    g = L⁻¹ f.
    """
    from scipy.linalg import lapack, solve_triangular

    assert active is not None
    C, limits, _ = _binding(*of[2:], np.zeros_like(of.f), active)
    L, failed = lapack.dpotrf(of.H, lower=1)
    if failed or not 0 < len(limits) <= len(of.f):
        return None, None
    whitened = solve_triangular(L, np.column_stack([C, of.f]), lower=True)
    (Q, R), g = np.linalg.qr(whitened[:, :-1]), whitened[:, -1]
    diagonal = np.abs(np.diagonal(R))
    if diagonal.min() <= _INDEPENDENT * diagonal.max():
        return None, None
    along = solve_triangular(R, limits, trans="T") + Q.T @ g
    xi = solve_triangular(L, Q @ along - g, lower=True, trans="T")
    slack = np.concatenate([of.G @ xi - of.h, xi - of.lower, of.upper - xi])
    proven = (solve_triangular(R, along) >= 0.0).all() and (slack + _SLIGHT >= 0.0).all()
    return (xi, active) if proven else (None, None)


def _inside(of: Programme, accuracy: float, iterations: int) -> Any:
    import piqp

    solver = piqp.DenseSolver()
    solver.settings.eps_abs = accuracy
    solver.settings.eps_rel = accuracy
    solver.settings.max_iter = iterations
    solver.setup(of.H, of.f, None, None, of.G, of.h, np.full(len(of.h), np.inf), of.lower, of.upper)
    done = (piqp.PIQP_SOLVED, piqp.PIQP_MAX_ITER_REACHED)
    return solver.result if solver.solve() in done else None


def _piqp(of: Programme, _: Sense | None) -> _Found:
    found = _inside(of, 1e-12, 500)
    return (None if found is None else np.array(found.x, dtype=np.float64)), None


_USUAL = 40
"""Steps of an interior point, which takes some 20: from where it stands still another solver goes on as well."""


def _active_inside(of: Programme, accuracy: float) -> Sense | None:
    """What an interior point says is active: by the ratio of multiplier and slack, as much as can be independent."""
    found, size = _inside(_scaled(of)[0], accuracy, _USUAL), len(of.f)
    if found is None:
        return None
    multiplier = np.concatenate([found.z_bl, found.z_bu, found.z_l])
    slack = np.concatenate([found.s_bl, found.s_bu, found.s_l])
    share = multiplier / np.maximum(multiplier + slack, 1e-300)
    largest = np.argsort(-share)[:size]
    largest = largest[share[largest] > 0.5]
    upper = (size <= largest) & (largest < 2 * size)
    active = np.zeros(size + len(of.h), dtype=np.int32)
    active[np.where(largest < size, largest, largest - size)] = np.where(upper, 1, 3)
    return active


_SOLVERS = (("DAQP", _daqp), ("PIQP", _piqp))


def dual_bound(of: Programme, xi: Array, active: Sense | None = None) -> float:
    """A lower bound of the optimum of `solve_qp`, whoever found ξ: the dual objective at multipliers made for ξ.

    Any non-negative multipliers λ give a bound, -½ |L⁻¹(Cᵀλ - f)|² + lᵀλ with H = L Lᵀ and C ξ >= l what is active at
    ξ; those that balance the gradient there, Cᵀλ = f + Hξ, give a tight one where ξ is optimal. They are found by
    least squares, in the units of the gradient and in those of L, of which either can be the better. -inf where
    there are none.

    `xi` (v,): ξ, near the optimum; `active`: as of `Answer`; without it what has next to no slack.
    """
    from scipy.linalg import solve_triangular
    from scipy.optimize import nnls

    s = 1.0 / np.sqrt(np.maximum(np.diagonal(of.H), 1e-300))  # as in `solve_qp`
    C, limits, _ = _binding(*of[2:], xi, active)
    best = -np.inf
    try:
        L = np.linalg.cholesky(of.H * np.outer(s, s))
        whitened, linear = (solve_triangular(L, (v.T * s).T, lower=True) for v in (C, of.f))
        attempts = ((C, of.f + of.H @ xi), (whitened, linear + L.T @ (xi / s)))
    except np.linalg.LinAlgError:  # not definite, to rounding
        return best
    for columns, gradient in attempts:
        unit = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        try:
            multiplier = nnls(columns / unit, gradient)[0] / unit if len(limits) else np.empty(0)
        except RuntimeError:  # too many iterations
            continue
        left = whitened @ multiplier - linear
        best = max(best, float(limits @ multiplier - 0.5 * left @ left))
    return best


def linear_bound(
    cost: Array, G: Array, h: Array, lower: Array, upper: Array, xi: Array, active: Sense | None = None
) -> tuple[float, Array]:
    """As `dual_bound`, of the linear programme minimise costᵀξ subject to G ξ >= h, lower <= ξ <= upper.

    Returns also the multipliers that prove it, (v + K,) of [bounds of ξ; rows of G].
    """
    from scipy.optimize import nnls

    size = len(xi)
    C, limits, which = _binding(G, h, lower, upper, xi, active)
    unit, prices = np.maximum(np.linalg.norm(C, axis=0), 1e-300), np.zeros(size + len(h))
    try:
        multiplier = nnls(C / unit, cost)[0] / unit
    except RuntimeError:  # too many iterations
        return -np.inf, prices
    np.add.at(prices, np.where(which < size, which, which - size), multiplier)
    left = float(np.abs(C @ multiplier - cost).sum())
    return float(limits @ multiplier) if left <= _SLIGHT else -np.inf, prices


def _binding(
    G: Array, h: Array, lower: Array, upper: Array, xi: Array, active: Sense | None
) -> tuple[Array, Array, Index]:
    """Columns (v, k) and limits (k,) of what is active, as lower bounds; by the slack at ξ where it is not known.

    Returns also which they are, (k,) of [lower bounds; upper bounds; rows of G].
    """
    size = len(xi)
    rows, limits = np.vstack([np.eye(size), -np.eye(size), G]), np.concatenate([lower, -upper, h])
    if active is None:
        near = rows @ xi - limits <= 1e-7 * np.maximum(np.abs(rows).max(axis=1), 1.0)
    else:
        near = np.concatenate([active[:size] == 3, active[:size] == 1, active[size:] > 0])
    return rows[near].T, limits[near], np.flatnonzero(near)


def solve_on_face(of: Programme, tight: NDArray[np.bool_]) -> tuple[Array, str]:
    """Minimise a programme, which a step of 0 does not violate, along what leaves some bounds and rows as they are.

    What is left of the others is no longer thin, so that DAQP, whose tolerance is one in the metric of H, does not have
    to find its way between two sides that all but touch. `tight` (v + K,): of [bounds of ξ; rows of G] those. Returns
    ξ (v,) and the solver, "" where nothing is left to solve.
    """
    rows, s = np.vstack([np.eye(len(of.f)), of.G]), 1.0 / np.sqrt(np.maximum(np.diagonal(of.H), 1e-300))
    unit = np.maximum(np.abs(rows * s).max(axis=1), 1e-300)
    _, values, right = np.linalg.svd((rows * s / unit[:, None])[tight])
    along = s[:, None] * right[int((values > _ALONG * values.max(initial=0.0)).sum()) :].T
    if not along.shape[1]:
        return np.zeros(len(s)), ""
    low, high = (np.flatnonzero(np.isfinite(bound)) for bound in (of.lower, of.upper))
    G = np.vstack([of.G, np.eye(len(s))[low], -np.eye(len(s))[high]]) @ along
    h = np.concatenate([of.h, of.lower[low], -of.upper[high]])
    moves = np.abs(G).max(axis=1) > _FIXED * np.concatenate([unit[len(s) :], unit[low], unit[high]])
    free = np.full(along.shape[1], np.inf)
    programme = Programme(along.T @ of.H @ along, along.T @ of.f, G[moves], h[moves], -free, free)
    answer = solve_near(programme, np.zeros(len(free)), any_solver=True)
    return along @ answer.xi, answer.solver


_ITERATIONS = 50
"""Steps of the simplex method per variable: on degenerate programmes it may go round for ever; most take under 5."""
_REMEDIES: tuple[dict[str, Any], ...] = (
    {"simplex_scale_strategy": 2},
    {"presolve": "off"},
    {"primal_feasibility_tolerance": 1e-9, "dual_feasibility_tolerance": 1e-9},
    {"simplex_strategy": 4},
)
"""Options that are set one after the other, from scratch each time, if the simplex method finds no optimum."""


class Simplex:
    """A linear programme minimise costᵀξ, rows·ξ >= h, that grows by rows: HiGHS dual simplex, warm started.

    `cost` (variables,): linear objective; `lower` (variables,): bounds of ξ; -inf for none; `upper` (variables,):
    bounds of ξ; inf for none.
    """

    def __init__(self, cost: Array, lower: Array, upper: Array) -> None:
        import highspy

        self._highs: Any = highspy.Highs()
        self._set({"output_flag": False, "solver": "simplex", "threads": 1})
        self._set({"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10})
        self._infinity = highspy.kHighsInf
        self._size = size = len(cost)
        self._rows, self._limits = np.empty((0, len(cost))), np.empty(0)
        self._optimal = highspy.HighsModelStatus.kOptimal
        self._endless = highspy.HighsModelStatus.kIterationLimit
        self._set({"simplex_iteration_limit": _ITERATIONS * (size + 100)})
        self._highs.addVars(size, np.maximum(lower, -self._infinity), np.minimum(upper, self._infinity))
        self._highs.changeColsCost(size, np.arange(size, dtype=np.int32), cost)

    def _set(self, options: dict[str, Any]) -> None:
        for option, value in options.items():
            self._highs.setOptionValue(option, value)

    def add(self, rows: Array, h: Array) -> None:
        """Add rows·ξ >= h.

        `rows` (K, variables): rows of the constraints; `h` (K,): their lower limits.
        """
        count = len(rows)
        self._rows = np.vstack([self._rows, rows])
        self._limits = np.concatenate([self._limits, h])
        starts = np.arange(count, dtype=np.int32) * self._size
        index = np.tile(np.arange(self._size, dtype=np.int32), count)
        values, upper = np.ascontiguousarray(rows).ravel(), np.full(count, self._infinity)
        self._highs.addRows(count, h, upper, rows.size, starts, index, values)

    def hold(self, rows: Iterable[int], h: Iterable[float]) -> None:
        """Ask rows·ξ >= h of rows that are there already."""
        for row, least in zip(rows, h, strict=True):
            self._highs.changeRowBounds(row, max(least, -self._infinity), self._infinity)

    def duals(self) -> Array:
        """What the optimum found last would rise by, per unit by which h rises.

        Returns (rows,): one per row.
        """
        return np.asarray(self._highs.getSolution().row_dual, dtype=np.float64)

    def reduced_costs(self) -> Array:
        """As `duals`, of the bounds of ξ, (variables,)."""
        return np.asarray(self._highs.getSolution().col_dual, dtype=np.float64)

    def drop(self, rows: Index) -> None:
        """Take rows out that the optimum found last does not rest on; it stays, and so does what it starts from.

        `rows` (K,): their numbers; those after them move up.
        """
        self._highs.deleteRows(len(rows), rows.astype(np.int32))
        self._rows, self._limits = np.delete(self._rows, rows, axis=0), np.delete(self._limits, rows)

    def idle(self, most: int) -> Index:
        """Rows that the optimum found last is furthest from, of those that it does not rest on.

        Returns (K,): their numbers; none if there are no more rows than that.
        """
        import highspy

        if len(self._rows) <= most:
            return np.empty(0, dtype=np.intp)
        basic = np.array([s == highspy.HighsBasisStatus.kBasic for s in self._highs.getBasis().row_status])
        slack = self._rows @ self.solution() - self._limits
        slack[~basic] = -np.inf
        furthest = np.argsort(-slack)[: len(slack) - most]
        found: Index = np.sort(furthest[slack[furthest] > FEASIBLE])
        return found

    def solution(self) -> Array:
        """The optimum found last.

        Returns (variables,): ξ.
        """
        return np.asarray(self._highs.getSolution().col_value, dtype=np.float64)

    def solve(self) -> Array:
        """Minimise.

        Returns (variables,): optimal ξ.
        """
        self._highs.run()
        cycled = 0
        for remedy in _REMEDIES:
            cycled += self._highs.getModelStatus() == self._endless
            if self._highs.getModelStatus() == self._optimal or cycled > 1:
                break
            self._highs.clearSolver()  # a warm start can go astray; from scratch then
            self._set(remedy)
            self._highs.run()
        if self._highs.getModelStatus() != self._optimal:
            status = self._highs.modelStatusToString(self._highs.getModelStatus())
            raise FitError(f"HiGHS could not solve the linear programme ({status}); scale the signals to order one")
        return self.solution()
