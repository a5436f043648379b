# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Discards: the few transitions whose absence narrows the envelope most."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from uncertain_lti.base.arrays import Array, Index
from uncertain_lti.base.progress import CountedStep
from uncertain_lti.identification.fleet import Fleet
from uncertain_lti.identification.problem import Problem
from uncertain_lti.identification.programmes import Programmes
from uncertain_lti.identification.structure import Structure
from uncertain_lti.identification.working_set import WorkingSet

_ACTIVE = 1e-7
"""Slack, in scaled units, below which a sample carries the envelope."""
FEW, FEW_SHARE = 12, 0.005
"""Largest number of transitions, and largest share of all, that count as few."""
MUCH, ENOUGH = 2.0, 1.2
"""Mean width with the few over that without them, from which on they are worth a word; what is left of the latter."""
LARGEST, MOST_ELEMENTS, LONGEST_ROW = 200_000, 300, 32
"""Transitions, elements of A and B of all blocks, and those of a row, up to which the few are sought: some seconds."""


@dataclass(frozen=True)
class Carriers:
    """Few transitions that carry the width of the envelope.

    `transitions`: positions in the problem; `factor` (n,): mean width of each state with them, over that without: of
    MUCH or more they carry it.
    """

    transitions: tuple[int, ...]
    factor: Array


def choose_discards(
    problem: Problem,
    criterion: str,
    structure: Structure | None,
    budget: int,
    progress: Callable[[str], None] | None = None,
) -> list[tuple[int, float]]:
    """Greedy choice: again and again the transition whose absence lowers the objective most.

    Only a transition on the edge of some row's bounds can have an effect; each of them is tried by solving the rows
    it carries without it. A discarded transition need not be contained in any row. It stops early when none has an
    effect.
    """
    chosen: list[tuple[int, float]] = []
    greedy = _greedy(WorkingSet(Fleet([problem]), structure), criterion)
    for number in range(1, budget + 1):
        if progress is not None:
            progress(CountedStep(f"discard {number} of {budget}", number, budget))
        if (found := next(greedy, None)) is None:
            break
        chosen.append(found)
    return chosen


def carriers(problem: Problem, structure: Structure | None) -> Carriers | None:
    """The few transitions that make the envelope of some state much wider than the others need: what discards choose.

    By criterion (10), which is fast. None if there are none such, if the problem is large, or if
    its weights couple the rows.
    """
    budget = min(FEW, int(FEW_SHARE * problem.N))
    row = problem.p * problem.columns.count
    large = problem.N > LARGEST or problem.n * row > MOST_ELEMENTS or row > LONGEST_ROW
    if not budget or large or problem.weights.ndim == 3:
        return None
    engine = WorkingSet(Fleet([problem]), structure)
    chosen: list[int] = []
    widths = []
    for index, _ in _greedy(engine, "qp"):
        widths.append(_mean_widths(engine))
        if len(chosen) == budget:
            break
        chosen.append(index)
    else:
        widths.append(_mean_widths(engine))
    width = np.array(widths)
    much = (width[0] > 0) & (width[0] >= MUCH * width[-1])
    enough = [int(np.argmax(width[:, i] <= ENOUGH * width[-1, i])) for i in np.flatnonzero(much)]
    if not enough:
        return None
    few = np.array(chosen[: max(enough)])
    rest = WorkingSet(Fleet([problem.without(few)]), structure)  # the rows above held some transitions only
    rest.quadratic()
    factor = width[0] / np.maximum(_mean_widths(rest), 1e-6 * width[0])
    return Carriers(tuple(few.tolist()), factor) if (factor >= MUCH).any() else None


def _mean_widths(engine: WorkingSet) -> Array:
    return np.array([float(engine.sums.width_sum @ row.d) for row in engine.rows]) / engine.sums.count


def _greedy(engine: WorkingSet, criterion: str) -> Iterator[tuple[int, float]]:
    """Again and again the transition whose absence lowers the objective most: its number, its share of the objective.

    It is taken out once the next is asked for. It ends when none has an effect.
    """
    engine.keeps = True
    engine.solve(criterion)
    first = np.array([_value(row, criterion, engine.fleet.weights) for row in engine.rows])
    unit = np.full(len(first), max(float(first.sum()), 1e-300)) if criterion == "qp" else np.maximum(first, 1e-300)
    gains: list[dict[int, float]] = [{} for _ in engine.rows]
    stale, find = set(range(len(engine.rows))), _gains if criterion == "qp" else _linear_gains
    while True:
        for i in stale:
            gains[i] = find(engine, engine.rows[i]) if engine.rows[i].unknown else {}
        total: dict[int, float] = {}
        for i, row_gains in enumerate(gains):
            for index, gain in row_gains.items():
                total[index] = total.get(index, 0.0) + gain / unit[i]
        if not total or max(total.values()) <= 1e-12:
            return
        index = max(total, key=lambda k: (total[k], -k))
        yield index, total[index]
        stale = set()
        for row, row_gains in zip(engine.rows, gains, strict=True):
            row.drop(index)
            if index in row_gains:
                _solve(engine, row, criterion)
                stale.add(row.i)


def _value(row: Programmes, criterion: str, weights: Array | None) -> float:
    if criterion == "lp":
        return (row.limit or 0.0) * row.limit_unit
    d = row.d[row.free_psi] / (row.unit_psi * row.scale)
    weight = 1.0 if weights is None else float(weights[row.i])
    return weight * row.largest * row.scale**2 * float(d @ row.gram @ d + 2.0 * row.gradient @ d)


def _gains(engine: WorkingSet, row: Programmes) -> dict[int, float]:
    """Fall of the row's part of (10) without each of the samples that carry it."""
    value = _value(row, "qp", engine.fleet.weights)
    gains = {}
    for index in row.samples.index[row.carrying(_ACTIVE)].tolist():
        trial = row.trial()
        trial.drop(index)
        _solve(engine, trial, "qp")
        gains[index] = value - _value(trial, "qp", engine.fleet.weights)
    return gains


def _linear_gains(engine: WorkingSet, row: Programmes) -> dict[int, float]:
    """Fall of δ of (11) in the same way, by one programme whose rows are released in turn.

    δ falls only without a sample that has a price (a dual variable) in the optimum: without another one the same
    prices prove the same δ. The simplex method goes on from the optimum before, so each takes a few pivots.
    """
    trial = row.trial()
    simplex = trial.minimax()
    owner, least = np.full(len(trial.asked), -1), np.full(len(trial.asked), -np.inf)

    def add(pool: Index) -> None:
        nonlocal owner, least
        rows, h = trial.rows(pool)
        simplex.add(rows, h)
        owner, least = np.concatenate([owner, np.tile(pool, len(h) // len(pool))]), np.concatenate([least, h])

    def solve(without: int = -1) -> float:
        while True:
            answer = simplex.solve()
            trial.store(answer[:-1])
            trial.limit = float(answer[-1])
            slack = trial.slack()
            slack[trial.pool] = np.inf
            if without >= 0:
                slack[without] = np.inf
            outside = np.flatnonzero(slack < -trial.tolerance)
            if not len(outside):
                return float(answer[-1])
            add(outside)
            trial.pool = np.concatenate([trial.pool, outside])

    add(trial.pool)
    value = solve()
    gains = {}
    for sample in np.unique(owner[(np.abs(simplex.duals()) > 1e-12) & (owner >= 0)]).tolist():
        rows = np.flatnonzero(owner == sample)
        simplex.hold(rows.tolist(), np.full(len(rows), -np.inf))
        gains[int(row.samples.index[sample])] = (value - solve(sample)) * row.limit_unit
        simplex.hold(rows.tolist(), least[rows])
    return gains


def _solve(engine: WorkingSet, row: Programmes, criterion: str) -> None:
    if criterion == "lp":
        row.limit = None
    engine._settle(row, Programmes.quadratic if criterion == "qp" else Programmes.linear)
