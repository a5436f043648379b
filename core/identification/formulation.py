# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Criteria (10) and (11) as written (docs/theory.md), in cvxpy: an independent second answer, for tests and `fit`."""

from __future__ import annotations

from typing import Any

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import FitError
from uncertain_lti.identification.problem import Problem


def solve(problem: Problem, criterion: str, solver: str | None = None, **options: Any) -> tuple[Array, Array, Array]:
    """Solve (10), or (11) row by row, over all samples at once.

    Returns (r, n): nominal elements, one column per row of the model, 1/s; Returns (q, n): half-widths of the same
    shape.
    """
    import cvxpy as cp

    dt = problem.dt[:, None]
    phi, psi, increment = problem.phi() * dt, problem.psi() * dt, problem.rate() * dt
    # columns of order one: the same problem, and the difference between an answer and none for first-order solvers
    unit_phi, unit_psi, unit_y = (_unit(a) for a in (phi, psi, increment))
    phi, psi, increment = phi / unit_phi, psi / unit_psi, increment / unit_y
    n = problem.n
    theta, d = cp.Variable((phi.shape[1], n)), cp.Variable((psi.shape[1], n), nonneg=True)
    centre, half = phi @ theta, psi @ d
    contained = [centre - half <= increment, centre + half >= increment]
    width = 2.0 * half
    if criterion == "qp":
        weights = problem.weights
        if weights.ndim == 3:
            chol = np.linalg.cholesky(weights * np.outer(unit_y, unit_y))  # W = L Lᵀ, so wᵀW w = |Lᵀ w|²
            terms = [cp.sum([cp.multiply(chol[:, j, i], width[:, j]) for j in range(i, n)]) for i in range(n)]
            objective = cp.sum([cp.sum_squares(t) for t in terms])
        else:
            root = np.sqrt(problem.row_weights()) * unit_y
            objective = cp.sum_squares(cp.multiply(root, width))
        scale = float(np.mean(unit_y) ** 2)
        programme = cp.Problem(cp.Minimize(objective / scale), contained)
        if solver is None:
            solver = cp.OSQP
            options = {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 200_000, "polishing": True} | options
        _run(programme, solver, options)
        values = np.array([programme.value * scale])
    elif criterion == "lp":
        root = np.sqrt(problem.row_weights())
        delta = cp.Variable(n, nonneg=True)
        limited = [cp.multiply(root[:, i], width[:, i]) <= delta[i] for i in range(n)]
        programme = cp.Problem(cp.Minimize(cp.sum(delta)), contained + limited)  # rows do not meet
        _run(programme, solver or cp.HIGHS, options)
        values = np.asarray(delta.value) * unit_y
    else:
        raise FitError(f"criterion is {criterion!r}; it must be qp or lp")
    return (
        np.asarray(theta.value) / unit_phi[:, None] * unit_y,
        np.maximum(np.asarray(d.value), 0.0) / unit_psi[:, None] * unit_y,
        values,
    )


def _unit(columns: Array) -> Array:
    size = np.sqrt(np.mean(columns**2, axis=0))
    return np.where(size > 0, size, 1.0)


def _run(programme: Any, solver: str, options: dict[str, Any]) -> None:
    import cvxpy as cp

    try:
        programme.solve(solver=solver, **options)
    except cp.error.SolverError as error:
        raise FitError(f"cvxpy with {solver} found no optimum ({error}); use the working-set method") from None
    if programme.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        raise FitError(f"cvxpy with {solver} ended as '{programme.status}'; use the working-set method")
