"""Small dense programmes to high accuracy: the solvers that the working set calls, each with its fallback."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.errors import FitError

Array = NDArray[np.float64]

FEASIBLE = 1e-9
"""Largest violation, in scaled units, of an answer that counts as solved; the repair covers it."""


def solve_qp(H: Array, f: Array, G: Array, h: Array, lower: Array, upper: Array) -> tuple[Array, str]:
    """Minimise ½ ξᵀHξ + fᵀξ subject to G ξ >= h, lower <= ξ <= upper.

    H must be positive definite, everything scaled to order one. DAQP (dual active set, exact to rounding) first;
    PIQP, then OSQP with polishing, where it gives up.

    Returns
    -------
    ξ : array (variables,)
    solver : str
        Who solved it.

    Raises
    ------
    FitError
        No solver returned a feasible answer.
    """
    # a diagonal scaling makes a badly scaled Hessian harmless to every solver
    s = 1.0 / np.sqrt(np.maximum(np.diagonal(H), 1e-300))
    H, f, G, lower, upper = H * np.outer(s, s), f * s, G * s, lower / s, upper / s
    norm = np.maximum(np.abs(G).max(axis=1, initial=0.0), 1e-300)
    G, h = G / norm[:, None], h / norm
    best: tuple[float, Array, str] | None = None
    for name, solver in (("DAQP", _daqp), ("PIQP", _piqp), ("OSQP", _osqp)):
        answer = solver(H, f, G, h, lower, upper)
        if answer is None or not np.isfinite(answer).all():
            continue
        answer = np.clip(answer, lower, upper)
        violation = float(np.max(h - G @ answer, initial=0.0))
        if best is None or violation < best[0]:
            best = (violation, answer * s, name)
        if violation <= FEASIBLE:
            return answer * s, name
    if best is not None and best[0] <= 1e-4:  # the repair makes it contained; the gap reported says how good it is
        return best[1], best[2]
    raise FitError("no solver (DAQP, PIQP, OSQP) could solve the quadratic programme; scale the signals to order one")


def _daqp(H: Array, f: Array, G: Array, h: Array, lower: Array, upper: Array) -> Array | None:
    import daqp

    size = len(f)
    bupper = np.concatenate([np.minimum(upper, 1e30), np.full(len(h), 1e30)])
    blower = np.concatenate([np.maximum(lower, -1e30), h])
    sense = np.zeros(size + len(h), dtype=np.int32)
    x, _, flag, _ = daqp.solve(
        np.ascontiguousarray(H), f, np.ascontiguousarray(G), bupper, blower, sense, primal_tol=1e-11, iter_limit=20_000
    )
    return np.asarray(x, dtype=np.float64) if flag == 1 else None


def _piqp(H: Array, f: Array, G: Array, h: Array, lower: Array, upper: Array) -> Array | None:
    import piqp

    solver = piqp.DenseSolver()
    solver.settings.eps_abs = 1e-12
    solver.settings.eps_rel = 1e-12
    solver.settings.max_iter = 500
    solver.setup(H, f, None, None, G, h, np.full(len(h), np.inf), lower, upper)
    status = solver.solve()
    done = (piqp.PIQP_SOLVED, piqp.PIQP_MAX_ITER_REACHED)
    return np.array(solver.result.x, dtype=np.float64) if status in done else None


def _osqp(H: Array, f: Array, G: Array, h: Array, lower: Array, upper: Array) -> Array | None:
    import osqp
    import scipy.sparse as sparse

    solver = osqp.OSQP()
    rows = sparse.vstack([sparse.csc_matrix(G), sparse.identity(len(f))], format="csc")
    solver.setup(
        sparse.csc_matrix(np.triu(H)),
        f,
        rows,
        np.concatenate([h, lower]),
        np.concatenate([np.full(len(h), np.inf), upper]),
        eps_abs=1e-9,
        eps_rel=1e-9,
        max_iter=100_000,
        polishing=True,
        verbose=False,
    )
    result = solver.solve()
    return None if result.x is None or result.x[0] is None else np.asarray(result.x, dtype=np.float64)


class Simplex:
    """A linear programme minimise costᵀξ, rows·ξ >= h, that grows by rows: HiGHS dual simplex, warm started.

    Parameters
    ----------
    cost, lower, upper : array (variables,)
    """

    def __init__(self, cost: Array, lower: Array, upper: Array) -> None:
        import highspy

        self._highs: Any = highspy.Highs()
        for option, value in (
            ("output_flag", False),
            ("solver", "simplex"),
            ("threads", 1),
            ("primal_feasibility_tolerance", 1e-10),
            ("dual_feasibility_tolerance", 1e-10),
        ):
            self._highs.setOptionValue(option, value)
        infinity = highspy.kHighsInf
        self._infinity = infinity
        self._size = len(cost)
        self._optimal = highspy.HighsModelStatus.kOptimal
        for c, low, high in zip(cost, lower, upper, strict=True):
            self._highs.addVar(max(low, -infinity), min(high, infinity))
            self._highs.changeColCost(self._highs.getNumCol() - 1, c)

    def add(self, rows: Array, h: Array) -> None:
        """Add rows·ξ >= h; rows (K, variables), h (K,)."""
        count = len(rows)
        starts = np.arange(count, dtype=np.int32) * self._size
        index = np.tile(np.arange(self._size, dtype=np.int32), count)
        self._highs.addRows(
            count, h, np.full(count, self._infinity), rows.size, starts, index, np.ascontiguousarray(rows).ravel()
        )

    def solve(self) -> Array:
        """Optimal ξ; raises FitError where there is none."""
        self._highs.run()
        if self._highs.getModelStatus() != self._optimal:
            self._highs.clearSolver()  # a warm start can go astray; from scratch then
            self._highs.setOptionValue("simplex_scale_strategy", 2)
            self._highs.run()
        if self._highs.getModelStatus() != self._optimal:
            status = self._highs.modelStatusToString(self._highs.getModelStatus())
            raise FitError(f"HiGHS could not solve the linear programme ({status}); scale the signals to order one")
        return np.asarray(self._highs.getSolution().col_value, dtype=np.float64)
