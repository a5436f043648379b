# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The optimum of a criterion over all transitions, with the half-widths that the verdict's own arithmetic needs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.cores import one_thread_each
from uncertain_lti.identification import formulation
from uncertain_lti.identification.passes import Judged, Moments
from uncertain_lti.identification.problem import Problem
from uncertain_lti.identification.programmes import GOOD
from uncertain_lti.identification.repair import E, repair
from uncertain_lti.identification.row import LEAST
from uncertain_lti.identification.working_set import Solution, WorkingSet


def optimum(
    engine: WorkingSet,
    criterion: str,
    build: Callable[[Array, Array], E],
    names: Sequence[str],
    method: str = "working-set",
    sizes: Array | None = None,
) -> tuple[E, Array, Judged, Array, float, Solution]:
    """The optimum of a criterion, lifted until the verdict's own arithmetic finds nothing outside.

    `sizes` (n,): as in `repair`; Returns (q, n): its half-widths; Returns (1,): of (10), or δ of each row of (11).
    """
    fleet, sums = engine.fleet, engine.sums
    if method == "working-set":
        with one_thread_each():
            solution = engine.quadratic() if criterion == "qp" else engine.linear()
    else:
        solution = _as_written(engine, criterion)
    limits = engine.half_limits

    def repaired(gentle: bool) -> tuple[E, Array, Judged]:
        return repair(
            build,
            fleet,
            sums,
            solution.theta,
            solution.d,
            solution.violation,
            limits,
            np.column_stack([row.size_unit for row in engine.rows]),
            None if engine.shared is None else engine.shared[1],
            gentle,
            names,
            sizes,
        )

    envelope, d, judged = repaired(False)
    reference = _criterion(engine, criterion, solution.d, judged) if solution.delta is None else solution.delta
    if not _relative(_criterion(engine, criterion, d, judged), reference, criterion, sums, judged) <= GOOD:
        gentler = repaired(True)
        if (_criterion(engine, criterion, *gentler[1:]) < _criterion(engine, criterion, d, judged)).any():
            envelope, d, judged = gentler
    objective = _criterion(engine, criterion, d, judged)
    gap = _relative(objective, reference, criterion, sums, judged) + (solution.gap or 0.0)
    return envelope, d, judged, objective, gap, solution


def _criterion(engine: WorkingSet, criterion: str, d: Array, judged: Judged) -> Array:
    """Value of (10), (1,), or of δ in every row of (11), (n,)."""
    return np.array([_objective(engine.sums, d, engine.weights)]) if criterion == "qp" else judged.weighted


def _relative(objective: Array, reference: Array, criterion: str, sums: Moments, judged: Judged) -> float:
    """How far an objective is above its reference at most, relative; an envelope that is rounding has no distance."""
    least = LEAST * sums.rate_scale
    floor = least * judged.weighted / np.where(judged.largest > 0, judged.largest, 1.0)
    if criterion == "qp":
        floor = np.array([float(floor @ floor) * sums.count])
    return float(np.max((objective - reference) / np.maximum(np.maximum(objective, floor), 1e-300), initial=0.0))


def _as_written(engine: WorkingSet, criterion: str) -> Solution:
    """Solve the whole problem by cvxpy, and measure what it left outside."""
    (problem,) = engine.fleet.partitions
    assert isinstance(problem, Problem)
    theta, d, objective = formulation.solve(problem, criterion)
    solver = "cvxpy with OSQP" if criterion == "qp" else "cvxpy with HiGHS"
    return Solution(theta, d, engine.violation(theta, d), objective if criterion == "lp" else None, solvers={solver})


def _objective(sums: Moments, d: Array, weights: Array | None) -> float:
    """Value of (10); weights (n,) where they are constant in time."""
    if sums.coupled is not None:
        flat = d.T.ravel()
        return float(4.0 * flat @ sums.coupled @ flat)
    n = d.shape[1]
    grams = [
        sums.gram[i] if sums.gram is not None else sums.plain_gram * (weights[i] if weights is not None else 1.0)
        for i in range(n)
    ]
    return float(sum(4.0 * d[:, i] @ grams[i] @ d[:, i] for i in range(n)))
