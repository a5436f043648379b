# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The optimum of a criterion over all transitions, lifted until the verdict's own arithmetic finds none outside.

Of an envelope over several steps the transitions are windows: h transitions in a row give one of step T from x_k with
the mean control ū; the state at its end is counted from x̂, the run of the model or of the least squares of its
elements. What is unknown is linear again, so working set, proof and repair are those of one step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from uncertain_lti.base.arrays import LARGEST, Array, one_thread_each
from uncertain_lti.base.errors import FitError
from uncertain_lti.base.text import plural
from uncertain_lti.identification.fleet import Fleet
from uncertain_lti.identification.passes import Envelope, Judged
from uncertain_lti.identification.problem import Columns, Problem, Regimes, solve_as_written
from uncertain_lti.identification.programmes import GOOD
from uncertain_lti.identification.structure import Structure
from uncertain_lti.identification.working_set import Solution, WorkingSet
from uncertain_lti.model.horizon import Horizon, Run, Widths
from uncertain_lti.model.uncertain_lti import UncertainLTI

E = TypeVar("E", bound=Envelope)

_EPS = float(np.finfo(np.float64).eps)
_ROUNDS = 40
_UNKNOWN = frozenset({"c", "v"})
_COMPARED = 20_000  # transitions, about, on which two runs are compared
_ROUNDING = 1e-12  # a smaller distance is none
_LOOKED_AT = 100_000  # windows, about, that mean and covariance of the residuals are taken from
WIDER = 1.1
"""An envelope whose mean half-width is this many times the largest move of a state over as many steps is useless: that
the state stays where it is, give or take what it ever moved, says more."""


def repair(
    build: Callable[[Array, Array], E],
    engine: WorkingSet,
    solution: Solution,
    names: Sequence[str],
    sizes: Array | None,
    gentle: bool,
) -> tuple[E, Array, Judged]:
    """Lift the half-widths of a solution until `Fleet.judge` finds nothing outside in any row.

    A solver leaves a violation of at most `violation` x (scaled size of the sample), and the size is linear in |z|,
    so lifting each element by violation x its unit covers it in every sample. What is left is rounding: a few ulps
    of |θ| + d for the products and sums and, for the state's own element, of 1 / Δt for the addition of x. What the
    structure fixes stays, to the bit; the other elements of the row cover its rounding.

    `sizes` (n,): largest |x| that the rates are added to; default that of the states. What the step does not multiply
    covers it; `gentle`: begin with less than an ulp; Returns (q, n): lifted.
    """
    fleet, sums, theta, d = engine.fleet, engine.sums, solution.theta, solution.d
    shared = None if engine.shared is None else engine.shared[1]
    units = np.column_stack([row.size_unit for row in engine.rows])
    n, p, columns = fleet.n, fleet.p, fleet.columns
    free = units > 0
    low, high = engine.half_limits
    fixed = low == high
    movable = free & ~fixed
    carried = np.ones(n)
    if not gentle:  # what is fixed covers nothing of its size, so that the others cover it
        largest = [*(sums.dt_max * np.maximum(-sums.low, sums.high)), *(sums.dt_max**t.times_dt for t in columns.half)]
        carried += np.tile(largest, columns.count) @ (units * fixed)
    lifted = np.where(fixed, d, d + units * carried * np.maximum(solution.violation, 0.0))
    blocks = (columns.count, -1, n)
    nominal, own = np.zeros(d.shape).reshape(blocks), np.zeros(d.shape).reshape(blocks)
    elements = np.abs(theta).reshape(blocks)
    nominal[:, :p] = elements[:, :p]
    for k, term in enumerate(columns.half, start=p):
        if term in columns.nominal:
            nominal[:, k] = elements[:, p + columns.nominal.index(term)]
        if not term.times_dt and sizes is not None:
            own[:, k] = sizes
    own[:, np.arange(n), np.arange(n)] = 1.0 / sums.dt_min
    base = np.clip(lifted, low, high)
    rounding = nominal.reshape(d.shape) + base + own.reshape(d.shape)
    for i in np.flatnonzero((fixed & (rounding > 0)).any(axis=0)):  # the others carry what these cannot
        share = float(sums.psi_scale @ (rounding[:, i] * fixed[:, i]))
        rounding[:, i] += units[:, i] * share
    if shared is not None:  # they stay equal to the bit
        most = np.zeros(d.shape)
        np.maximum.at(most, (shared, np.arange(n)), rounding)
        rounding = most[shared, np.arange(n)]
    todo = np.ones(n, dtype=bool)
    lifted = base
    for attempt in range(-6 if gentle else 0, _ROUNDS):
        ulps = 2.0 ** (attempt + 2) * _EPS * rounding * movable
        lifted = np.where(todo, np.minimum(base + ulps, high), lifted)
        model = build(theta, lifted)
        judged = fleet.judge(model)
        todo = judged.outside > 0
        if not todo.any():
            return model, lifted, judged
        if not movable[:, todo].any(axis=0).all():
            break
    row = int(np.argmax(todo))
    if fixed[free[:, row], row].any():
        raise FitError(
            f"structure: with half-widths that are fixed, '{names[row]}' leaves "
            f"{plural(int(judged.outside[row]), 'transition')} outside, by rounding at least; let a half-width of "
            f"this row be free, or use an additive term"
        )
    raise FitError(
        f"containment could not be repaired in row {int(np.argmax(todo))}: the signals differ too much in scale; "
        f"give steady and scale that bring them to order one"
    )


@dataclass(frozen=True)
class Optimum(Generic[E]):
    """What contains every transition, as near to the optimum as was found.

    `envelope`: lifted; `criterion`: as in `fit`; `objective` (1,): of (10), or δ of each row of (11), (n,); `gap`: how
    far it is above the optimum at most, relative; inf if that is not known; `judged`: of all transitions; `mean_width`
    (n,): per step, normalised; `solution`: before it was lifted.
    """

    envelope: E
    criterion: str
    objective: Array
    gap: float
    judged: Judged
    mean_width: Array
    solution: Solution

    def reached(self) -> dict[str, Any]:
        """How good it is, for the model file."""
        return {
            "objective": self.objective if self.criterion == "lp" else float(self.objective[0]),
            "optimality_gap": self.gap if np.isfinite(self.gap) else None,
        }

    def widths(self, X: Array) -> dict[str, Any]:
        """How wide it is, for the model file; `X` (n,): scales of the states."""
        return {
            "mean_width": self.mean_width,
            "max_width": self.judged.largest,
            "mean_width_recorded": self.mean_width * X,
            "max_width_recorded": self.judged.largest * X,
            "violations": 0,  # `repair` has counted them, by the verdict's own arithmetic
        }


def optimum(
    engine: WorkingSet,
    criterion: str,
    build: Callable[[Array, Array], E],
    names: Sequence[str],
    method: str = "working-set",
    sizes: Array | None = None,
) -> Optimum[E]:
    """The optimum of a criterion, lifted until the verdict's own arithmetic finds nothing outside.

    `sizes` (n,): as in `repair`.
    """
    solution = engine.solve(criterion) if method == "working-set" else _as_written(engine, criterion)
    envelope, d, judged = repair(build, engine, solution, names, sizes, False)
    reference = engine.objective(criterion, solution.d, judged) if solution.delta is None else solution.delta
    if not engine.above(criterion, engine.objective(criterion, d, judged), reference, judged) <= GOOD:
        gentler = repair(build, engine, solution, names, sizes, True)
        if (engine.objective(criterion, *gentler[1:]) < engine.objective(criterion, d, judged)).any():
            envelope, d, judged = gentler
    objective = engine.objective(criterion, d, judged)
    gap = engine.above(criterion, objective, reference, judged) + (solution.gap or 0.0)
    mean_width = 2.0 * (engine.sums.width_sum @ d) / engine.sums.count
    return Optimum(envelope, criterion, objective, gap, judged, mean_width, solution)


def _as_written(engine: WorkingSet, criterion: str) -> Solution:
    """Solve the whole problem by cvxpy, and measure what it left outside."""
    (problem,) = engine.fleet.partitions
    assert isinstance(problem, Problem)
    theta, d, objective = solve_as_written(problem, criterion)
    solver = "cvxpy with OSQP" if criterion == "qp" else "cvxpy with HiGHS"
    return Solution(theta, d, engine.violation(theta, d), objective if criterion == "lp" else None, solvers={solver})


def run_of(problem: Problem, structure: Structure | None = None) -> Run:
    """The least squares of the elements of a model, one step ahead."""
    rows = WorkingSet(Fleet.of(problem), structure).rows
    for row in rows:
        row.start()
    theta, d = (np.column_stack([getattr(row, name) for row in rows]) for name in ("theta", "d"))
    found = problem.columns.arrays(theta, d)
    return Run(found["A"], found["B"], found.get("c", np.zeros(found["A"].shape[:-1])))


@one_thread_each()
def better_run(model: UncertainLTI, problem: Problem, steps: Sequence[int], structure: Structure | None) -> Run | None:
    """What is to be run over the windows: the least squares of one step where nearer than the model, which is None.

    Compared is the largest distance of a window's end from the run with a linear correction, which is what widths are
    made of: its geometric mean over horizons and states. Of many transitions, pieces of the recordings are looked at.
    """
    lengths = sorted(set(steps))
    k, signals = problem.order, _signals(problem)
    dt, after = problem.dt, problem.x_next
    piece = max(20 * lengths[-1], 1000)
    if len(dt) > _COMPARED:
        starts = np.linspace(0, len(dt) - piece, max(_COMPARED // piece, 1)).astype(np.intp)
        some = np.unique((starts[:, None] + np.arange(piece)).ravel())
        k, signals, dt, after = k[some], signals[:, some], dt[some], after[:, some]

    def distance(which: UncertainLTI) -> float:
        logs = []
        for windows in which.windows(k, signals, dt, lengths):
            left = (after[:, windows.last] - windows.run).T
            if not np.isfinite(left).all():
                return np.inf
            phi = np.vstack([windows.z[: problem.p], np.ones(len(left))]).T
            left = left - phi @ np.linalg.lstsq(phi, left, rcond=None)[0]
            logs.append(np.log(np.maximum(np.abs(left).max(axis=0, initial=0.0), _ROUNDING)))
        return float(np.mean(logs)) if logs else 0.0

    run = run_of(problem, structure)
    return run if distance(model.replace(run=run)) < distance(model) else None


def _signals(problem: Problem) -> Array:
    """[x; u; s] of the transitions, one column for each."""
    return problem.z if problem.s is None else np.vstack([problem.z, problem.s])


@one_thread_each()
def fit_horizons(
    model: UncertainLTI,
    problem: Problem,
    steps: Sequence[int],
    widths: Widths | Mapping[int, Widths] = "growing",
    criterion: str = "qp",
    progress: Callable[[str], None] | None = None,
) -> tuple[tuple[Horizon, ...], list[dict[str, Any]], list[str], set[str]]:
    """Envelopes of a fitted model over several steps: with facts of each, what was left out, and solvers."""
    solvers: set[str] = set()
    found: list[Horizon] = []
    facts: list[dict[str, Any]] = []
    messages: list[str] = []
    p = problem.p
    axes = 0 if model.schedule is None else len(model.schedule.axes)
    regimes = None if model.schedule is None else Regimes(model.schedule, tuple(range(p, p + axes)))
    columns = Columns(_UNKNOWN, regimes)
    lengths = sorted(set(steps))
    for windows in model.windows(problem.order, _signals(problem), problem.dt, lengths):
        if progress is not None:
            progress(f"horizon of {windows.steps} steps: {plural(len(windows.start), 'window')}")
        few = 2 * (p + 1) * columns.count
        if len(windows.start) < few:
            messages.append(
                f"no horizon of {windows.steps} steps: {plural(len(windows.start), 'window')} of so many transitions "
                f"in a row, and {few} are needed; give shorter horizons, or longer recordings"
            )
            continue
        largest = np.maximum(windows.run.max(axis=1), -windows.run.min(axis=1))
        if not (largest <= LARGEST).all():
            name = model.state_names[int(np.argmax(~(largest <= LARGEST)))]
            messages.append(
                f"no horizon of {windows.steps} steps: the nominal model runs away, '{name}' beyond all numbers; give "
                f"shorter horizons"
            )
            continue
        last = windows.last
        unbroken = len(last) == int(last[-1]) - int(last[0]) + 1
        part = Problem(
            windows.z[:p],
            problem.x_next[:, int(last[0]) : int(last[-1]) + 1] if unbroken else problem.x_next[:, last],
            windows.time,
            problem.weights if problem.weights.ndim == 1 else problem.weights[last],
            windows.z[p:] if axes else None,
            windows.run,
            source=problem.source[windows.start],
            k=problem.k[windows.start],
            columns=columns,
        )
        kind = widths[windows.steps] if isinstance(widths, Mapping) else widths
        horizon, fact = _fitted(model, part, windows.steps, kind, criterion, largest)
        solvers |= fact.pop("solvers")
        move = part.largest_moves()
        if (0.5 * fact["mean_width"] > WIDER * move).all():
            messages.append(
                f"no horizon of {windows.steps} steps: its envelope is wider than if every state stayed where it was "
                f"(half-widths x {float((0.5 * fact['mean_width'] / np.maximum(move, 1e-300)).min()):.3g} of the "
                f"largest move, or more): the nominal model runs away over so many steps; give shorter horizons"
            )
            continue
        found.append(horizon)
        facts.append(fact)
    return tuple(found), facts, messages, solvers


def _fitted(
    model: UncertainLTI, part: Problem, steps: int, widths: Widths, criterion: str, largest: Array
) -> tuple[Horizon, dict[str, Any]]:
    """One horizon."""
    n, m = part.n, part.p - part.n
    constant = Structure(n, m, fixed={"dA": np.zeros((n, n)), "dB": np.zeros((n, m))})
    engine = WorkingSet(Fleet.of(part), constant if widths == "constant" else None)

    def build(theta: Array, d: Array) -> Horizon:
        return Horizon(steps, **part.columns.arrays(theta, d), widths=widths)

    try:
        found = optimum(engine, criterion, build, model.state_names, sizes=largest)
    except FitError as error:
        raise FitError(f"horizon of {steps} steps: {error}") from None
    some = part if part.N <= 2 * _LOOKED_AT else part.subset(slice(None, None, part.N // _LOOKED_AT))
    fleet = Fleet.of(some)
    residuals = fleet.residuals(found.envelope, fleet.judge(found.envelope), own_law=False)
    return found.envelope.with_residuals(residuals), {
        "solvers": found.solution.solvers,
        "steps": steps,
        "seconds": float(np.median(part.dt)),
        "widths": widths,
        "windows": part.N,
        **found.widths(model.operating_point.X),
        **found.reached(),
    }
