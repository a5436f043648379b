# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""fit(): recorded transients to an uncertain linear model."""

from __future__ import annotations

import math
import platform
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from numbers import Integral, Real
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from uncertain_lti.base.arrays import LARGEST, WORTH_THREADS, Array, Index, on_cores, one_thread_each, return_memory
from uncertain_lti.base.errors import FitError, SignalError, refuse_other
from uncertain_lti.base.text import moment, plural
from uncertain_lti.identification.assembly import assemble, median_step
from uncertain_lti.identification.diagnosis import describe, of_sums
from uncertain_lti.identification.discard import carriers, choose_discards
from uncertain_lti.identification.fleet import Fleet
from uncertain_lti.identification.memory import Recording, elements_of, remembered
from uncertain_lti.identification.optimum import Optimum, better_run, fit_horizons, optimum
from uncertain_lti.identification.passes import Judged, Moments
from uncertain_lti.identification.problem import Problem, Regimes, check_criterion
from uncertain_lti.identification.regimes import Knots, asked_by, scheduled_by, signals_of
from uncertain_lti.identification.row import InfeasibleError
from uncertain_lti.identification.structure import Structure
from uncertain_lti.identification.working_set import WorkingSet
from uncertain_lti.model.domain import Domain, Sampling, largest_steps
from uncertain_lti.model.horizon import MOST_STEPS, Widths
from uncertain_lti.model.operating_point import OperatingPoint
from uncertain_lti.model.repeats import Found, repeats_in, together
from uncertain_lti.model.schedule import BlockData, Schedule
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.sampling.transient import Transient, listed_transients
from uncertain_lti.signals.field_path import FieldPath
from uncertain_lti.signals.signal_map import Signal, SignalMap
from uncertain_lti.signals.values import Additive, Criterion

SMALL = 1e-4
"""Optimality gap from which on it is worth a word."""
_LARGE = 100_000_000  # numbers that all rows go through, from which on a fit leaves much memory behind


def fit(
    transients: Sequence[Transient] | Transient,
    criterion: Criterion = "qp",
    weights: ArrayLike | Sequence[ArrayLike] | None = None,
    additive: Additive | None = None,
    operating_point: OperatingPoint | None = None,
    *,
    transient_weights: Sequence[float] | None = None,
    count: Literal["sample", "transient"] = "sample",
    structure: Structure | None = None,
    schedule: Schedule | Mapping[str, Knots] | None = None,
    horizons: Sequence[int] = (),
    widths: Widths | Mapping[int, Widths] = "growing",
    drop_horizons: bool = False,
    discard: float = 0,
    method: Literal["working-set", "cvxpy"] = "working-set",
    describe_data: bool = True,
    seek_carriers: bool = False,
    progress: Callable[[str], None] | None = None,
    near: UncertainLTI | None = None,
) -> UncertainLTI:
    """`uncertain_lti.fit` with a schedule that is known: nothing is chosen here by what is left out.

    `drop_horizons`: a horizon that the recordings cannot carry is left out with a message, not refused; `near`: a fit
    to nearly the same transitions, from which one of many unknowns a row starts.
    """
    transients = listed_transients(transients)
    _refuse_wrong(criterion, method, horizons, operating_point, structure)
    signals = common_signals(transients)
    schedule = asked_by(signals) if schedule is None else schedule
    on = signals_of(schedule, [s.name for s in signals.signals])
    if operating_point is not None:
        operating_point = operating_point.scheduled_on([s.name in on for s in signals.scheduling])
    transients, signals = [t.scheduled_on(on) for t in transients], signals.scheduled_on(on)
    operating_point = _point_of(signals, operating_point)
    signals = _at(signals, operating_point)
    if additive is None:
        additive = signals.additive or "none"
    scheduled = scheduled_by(schedule, signals, lambda: assemble(transients, operating_point, None, additive))
    structure = structure or structure_of(signals, scheduled)
    _refuse_unlike(structure, signals, method)
    problem = assemble(
        transients,
        operating_point,
        weights,
        additive,
        transient_weights=transient_weights,
        count=count,
        regimes=None if scheduled is None else Regimes.of(scheduled, signals),
    )

    def where(index: int) -> str:
        of, k = transients[problem.source[index]], int(problem.k[index])
        return f"the step from sample {k} of {of.name} (t = {moment(of.t[k])} s)"

    whole = Fleet([problem])
    whole.check_solvable(where, [s.name for s in signals.states])

    discarded: list[tuple[int, float]] = []
    if budget := _budget(discard, problem.N):
        if (left := problem.N - budget) < (unknowns := problem.columns.unknowns(problem.p)):
            raise FitError(
                f"discard is {discard!r}, which leaves {plural(left, 'transition')} for {unknowns} unknowns per row; "
                f"discard {problem.N - unknowns} at most, or record more"
            )
        before = fit_fleet(whole, signals, criterion, structure=structure, describe_data=False, where=where)
        discarded = choose_discards(problem, criterion, structure, budget, progress)
        every, problem = problem, problem.without(np.array([index for index, _ in discarded], dtype=np.intp))
    fleet = Fleet.of(problem) if method == "working-set" else Fleet([problem])
    plain = scheduled is None and problem.weights.ndim == 1 and not budget and method == "working-set"
    keeps = plain and describe_data and not horizons
    model = fit_fleet(
        fleet,
        signals,
        criterion,
        structure=structure,
        method=method,
        progress=progress,
        dt_median=median_step(problem.dt),
        describe_data=describe_data,
        describe_on=problem,
        transients=transients,
        discarded=len(discarded),
        seek_carriers=seek_carriers,
        near=near if scheduled is None else None,
        remember=partial(_memory, problem, transients, fleet) if keeps else None,
        where=where,
    )
    weighted = weights is not None or transient_weights is not None
    facts = {
        **model.fit_summary,
        "additive": additive,
        "weights": {1: "per state", 2: "per sample", 3: "full"}[problem.weights.ndim] if weighted else "ones",
        "count": count,
        "transients": len(transients),
        "segments": sum(t.segments for t in transients),
        "sources": [{"file": t.name} for t in transients],
    }
    if structure is not None:
        facts["structure"] = structure.to_dict()
    if budget:
        facts["discard"] = discard
        facts["discarded"] = [_discarded(every, transients, *one) for one in discarded]
        keys = ("objective", "mean_width", "max_width", "mean_width_recorded")
        facts["with_discarded"] = {key: before.fit_summary[key] for key in keys}
    if not horizons:
        return model.replace(fit_summary=facts)
    lengths = [int(h) for h in horizons]
    model = model.replace(run=better_run(model, problem, lengths, structure))
    over, facts["horizons"], dropped, solvers = fit_horizons(model, problem, lengths, widths, criterion, progress)
    if dropped and not drop_horizons:
        raise FitError(dropped[0])
    if "messages" in facts or dropped:
        facts["messages"] = [*facts.get("messages", []), *dropped]
    facts["versions"] = versions({*facts["solver"]["names"], *solvers})
    return model.replace(fit_summary=facts, horizons=over, run=model.run if over else None)


def _refuse_wrong(criterion: str, method: str, horizons: Sequence[Any], operating_point: Any, structure: Any) -> None:
    """Refuse what is asked for of a fit where no recording is needed to see that it is wrong."""
    check_criterion(criterion)
    if method not in ("working-set", "cvxpy"):
        raise FitError(f"method is {method!r}; it must be working-set or cvxpy")
    if horizons and method != "working-set":
        raise FitError("method cvxpy states one step; leave horizons out, or use the working-set method")
    if any(isinstance(h, bool) or not isinstance(h, (int, np.integer)) or not 2 <= h <= MOST_STEPS for h in horizons):
        raise FitError(f"horizons are {list(horizons)}; give whole numbers of steps, 2 to {MOST_STEPS}")
    for given, kind in ((operating_point, OperatingPoint), (structure, Structure)):
        if given is not None:
            refuse_other(given, kind, kind.__name__, f"give one, as {kind.__name__}(...) makes it", FitError)


def _refuse_unlike(structure: Structure | None, signals: SignalMap, method: str) -> None:
    n, m = len(signals.states), len(signals.controls)
    if structure is not None and (structure.n, structure.m) != (n, m):
        raise FitError(
            f"structure is for {plural(structure.n, 'state')} and {plural(structure.m, 'control')}, not {n} and {m}"
        )
    if structure is not None and method == "cvxpy":
        raise FitError("method cvxpy takes no structure; use the working-set method")


def _point_of(signals: SignalMap, given: OperatingPoint | None) -> OperatingPoint:
    """The operating point that is given, if it has the sizes of the signals; default that of the signals."""
    if given is None:
        return OperatingPoint.of(signals.states, signals.controls, signals.scheduling)
    n, m, q = len(signals.states), len(signals.controls), len(signals.scheduling)
    if (len(given.x_s), len(given.u_s)) != (n, m):
        raise FitError(
            f"the operating point has {plural(len(given.x_s), 'state')} and {plural(len(given.u_s), 'control')}, "
            f"the transients {n} and {m}"
        )
    if len(given.s_s) != q:
        raise FitError(
            f"the operating point has {plural(len(given.s_s), 'further scheduling signal')}, the transients {q}; "
            f"give s_s and S"
        )
    return given


def _discarded(problem: Problem, transients: Sequence[Transient], index: int, effect: float) -> dict[str, Any]:
    """A transition that was left out, for the model file."""
    of, k = transients[problem.source[index]], int(problem.k[index])
    return {"file": of.name, "k": k, "t": float(of.t[k]), "t_ns": int(of.t_ns[k]), "effect": effect}


def _memory(
    problem: Problem, transients: Sequence[Transient], fleet: Fleet, model: UncertainLTI, nearest: Sequence[Index]
) -> dict[str, Any] | None:
    """What the file of a plain model keeps of its recordings."""
    edges = np.searchsorted(problem.source, np.arange(len(transients) + 1)).tolist()
    each = zip(transients, edges[:-1], edges[1:], strict=True)
    recordings = [Recording.of(t.name, problem.subset(slice(a, b))) for t, a, b in each]
    return remembered(model, problem, recordings, fleet.sums, nearest)


@one_thread_each()
def fit_fleet(
    fleet: Fleet,
    signals: SignalMap,
    criterion: str,
    *,
    structure: Structure | None = None,
    method: str = "working-set",
    progress: Callable[[str], None] | None = None,
    dt_median: float | None = None,
    describe_data: bool = True,
    describe_on: Problem | None = None,
    transients: Sequence[Transient] = (),
    discarded: int = 0,
    seek_carriers: bool = False,
    near: UncertainLTI | None = None,
    remember: Callable[[UncertainLTI, list[Index]], dict[str, Any] | None] | None = None,
    where: Callable[[int], str] = "transition {}".format,
) -> UncertainLTI:
    """`fit` on transitions that are already normalised, wherever they lie.

    `describe_on`: the transitions, where they are all at hand; `remember`: what the model's file keeps, of the model
    and `WorkingSet.nearest`; `where`: what a transition is called.
    """
    if large := fleet.N * fleet.p * fleet.n > _LARGE:
        return_memory()
    with np.errstate(over="ignore", invalid="ignore"):  # of what is refused next
        engine = WorkingSet(fleet, structure, progress, None if near is None else elements_of(near, fleet.columns))
    sums, regimes = engine.sums, fleet.columns.regimes
    _refuse_tiny(signals, np.maximum(-sums.low, sums.high))
    domain = _domain(fleet, sums, structure)
    scheduled: dict[str, Any] = {}
    if regimes is not None:
        each = enumerate(zip(sums.visits.tolist(), engine.tied, strict=True))
        data = [BlockData(count, None if block == r else block) for r, (count, block) in each]
        scheduled = {"schedule": regimes.schedule, "block_data": data}

    def build(theta: Array, d: Array) -> UncertainLTI:
        return UncertainLTI(
            **fleet.columns.arrays(theta, d),
            **scheduled,
            signals=signals,
            sampling=Sampling(dt_median, sums.dt_min, sums.dt_max),
            domain=domain,
        )

    try:
        found = optimum(engine, criterion, build, [s.name for s in signals.states], method)
    except InfeasibleError as error:
        raise _contradiction(error, where(error.index), signals) from None
    nearest = engine.nearest() if remember is not None else []
    del engine  # with the samples that its rows hold
    if large:
        return_memory()
    model, judged = found.envelope, found.judged
    facts = _facts(found, method, sums)

    def said() -> tuple[int, list[str]] | None:
        if not describe_data:
            return None
        if describe_on is None:
            rank, messages = of_sums(model, fleet, sums, found.mean_width)
        else:
            few = None
            if seek_carriers and describe_on.N == sums.count and method == "working-set":
                with suppress(FitError, InfeasibleError):  # a fit that is done does not end for what is said of it
                    few = carriers(describe_on, structure)
            gone = discarded if criterion == "qp" else None
            rank, messages = describe(model, describe_on, sums, found.mean_width, transients, few, gone)
        return rank, messages + distance_in_words(found.gap)

    memory = (lambda: None) if remember is None else partial(remember, model.replace(fit_summary=facts), nearest)
    afterwards = (
        memory,
        said,
        partial(fleet.residuals, model, judged, structure is None or structure.free),
        *(partial(repeats_in, model, t) for t in transients),
    )
    kept, words, residuals, *seen = on_cores(lambda of: of(), [(of,) for of in afterwards], sums.count > WORTH_THREADS)
    if words is not None:
        facts["rank"], facts["messages"] = words
    if transients:
        model = with_repeats(model, seen)
    if large:
        return_memory()
    return model.replace(fit_summary=facts, residuals=residuals, memory=kept)


def _facts(found: Optimum[UncertainLTI], method: str, sums: Moments) -> dict[str, Any]:
    model, solution = found.envelope, found.solution
    facts: dict[str, Any] = {
        "criterion": found.criterion,
        **found.reached(),
        "transitions": sums.count,
        **found.widths(model.operating_point.X),
        "spectral_radius": None if model.sampling.dt_median is None else model.spectral_radius(),
        "solver": {
            "method": method,
            "names": sorted(solution.solvers),
            "rounds": solution.rounds,
            "passes": solution.passes,
            "working_set": solution.working,
        },
        "versions": versions(solution.solvers),
    }
    if model.schedule is not None:
        facts["blocks"] = _block_facts(model, sums.visits, found.judged)
    return facts


def _refuse_tiny(signals: SignalMap, largest_values: Array) -> None:
    for signal, largest in zip(signals.signals, largest_values.tolist(), strict=False):
        if 0.0 < largest < 1.0 / LARGEST:
            raise FitError(
                f"'{signal.name}' never exceeds {largest:.3g} over its scale, less than the arithmetic can carry "
                f"({1.0 / LARGEST:g}); give it a smaller scale or another unit, or leave it out"
            )


def _domain(fleet: Fleet, sums: Moments, structure: Structure | None) -> Domain:
    n, low, high = fleet.n, sums.low, sums.high
    measure, anywhere = fleet.occupancy(low, high), None
    if structure is not None and fleet.columns.regimes is None:
        measure = measure and measure.among(structure.together)
        unused = ~np.logical_or.reduce(structure.rows)
        anywhere = unused.tolist() if unused.any() else None
    return Domain(low[:n], high[:n], low[n:], high[n:], measure, anywhere=anywhere)


def structure_of(signals: SignalMap, schedule: Schedule | None) -> Structure | None:
    """What the signals file knows of single elements."""
    if not signals.structure:
        return None
    names = ([s.name for s in signals.states], [s.name for s in signals.controls])
    return Structure.from_rules(signals.structure, *names, f"{signals.source}: structure", schedule)


def with_repeats(model: UncertainLTI, found: Sequence[Found]) -> UncertainLTI:
    """A model with the exact repeats and the largest steps of its recordings, from what each of them has."""
    domain = replace(model.domain, step_max=largest_steps(model, found))
    return model.replace(repeats=together(model.n, found), domain=domain)


def _block_facts(model: UncertainLTI, visits: Index, judged: Judged) -> list[dict[str, Any]]:
    """Of each block its transitions, those of which it has the largest weight, and the widths there."""
    each = zip(model.blocks, visits.tolist(), judged.widths, judged.widest, strict=True)
    return [
        {
            "transitions": count,
            "mean_width": total / count if count else None,
            "max_width": largest if count else None,
            "spectral_radius": None if model.sampling.dt_median is None else block.spectral_radius(),
        }
        for block, count, total, largest in each
    ]


def distance_in_words(gap: float) -> list[str]:
    """What the user should know if the answer is not proven to be the optimum."""
    remedy = (
        "the containment holds; the signals may be nearly collinear or exact, so leave one out, or fix what is known "
        "by structure"
    )
    if not np.isfinite(gap):
        return [f"no bound of the distance from the optimum was found, so narrower widths may exist: {remedy}"]
    if gap > SMALL:
        return [f"the objective is {100 * gap:.2g} % above the optimum at most: {remedy}"]
    return []


def _contradiction(error: InfeasibleError, where: str, signals: SignalMap) -> FitError:
    """The error for a transition that the structure cannot contain."""
    signal = signals.states[error.row]
    distance = f"{error.distance * float(signal.scale):.3g} {signal.unit}".rstrip()
    remedy = "free a half-width of this row, or use an additive term"
    if not error.together:
        return FitError(
            f"structure: '{signal.name}' cannot contain {where}, which stays {distance} outside at best; {remedy}"
        )
    return FitError(
        f"structure: '{signal.name}' cannot contain {where} and {plural(error.together, 'other transition')} at once: "
        f"each alone can be inside, together one stays outside (this one by {distance} if they share it); {remedy}"
    )


def _budget(discard: Any, transitions: int) -> int:
    """Number of transitions that may be discarded: a whole number, or a share below 1."""
    whole, number = isinstance(discard, Integral), isinstance(discard, Real) and not isinstance(discard, bool)
    if not (number and math.isfinite(discard) and discard >= 0) or (not whole and discard >= 1):
        raise FitError(f"discard is {discard!r}; give a whole number of transitions, or a share below 1")
    return int(discard) if whole else int(discard * transitions)


def common_signals(transients: Sequence[Transient]) -> SignalMap:
    """Signals of recordings, which must all be read alike."""
    if not transients:
        raise FitError("no transients; give at least one recording")

    def named(t: Transient) -> str:
        each = t.state_names, t.control_names, t.scheduling_names
        of = [", ".join(names) or "none" for names in each]
        return f"states {of[0]}, controls {of[1]} and scheduling signals {of[2]}"

    first = transients[0]
    for other in transients[1:]:
        if named(other) != named(first):
            raise FitError(
                f"{other.name} has {named(other)}, {first.name} has {named(first)}; read all recordings with one "
                f"signals file"
            )
        if other.step != first.step:
            raise FitError(f"{other.name} has step {other.step or 'recorded'}, {first.name} {first.step or 'recorded'}")
        if other.ends != first.ends:
            raise FitError(f"{other.name} has controls at other ends of steps than {first.name}; give all the same at")
        if other.signals != first.signals:
            raise FitError(f"{other.name} and {first.name} were read with different signals; read them together")
    if first.signals is not None:
        return first.signals
    return SignalMap(
        tuple(Signal(name, "", _field(name, f"x{i + 1}")) for i, name in enumerate(first.state_names)),
        tuple(
            Signal(name, "", _field(name, f"u{j + 1}"), at=first.ends[j]) for j, name in enumerate(first.control_names)
        ),
        tuple(Signal(name, "", _field(name, f"s{j + 1}")) for j, name in enumerate(first.scheduling_names)),
        max_gap=None if np.isinf(first.max_gap) else first.max_gap,
        min_step=first.min_step,
        step=first.step or "recorded",
        source="arrays",
    )


def _field(name: str, otherwise: str) -> str:
    """The name of a column if it is a field path."""
    try:
        FieldPath(name)
    except SignalError:
        return otherwise
    return name


def _at(signals: SignalMap, point: OperatingPoint) -> SignalMap:
    each = zip(signals.signals, point.steady.tolist(), point.scale.tolist(), strict=True)
    return signals.replace_signals([replace(s, steady=a, scale=b) for s, a, b in each])


_PACKAGES = {
    "DAQP": ("daqp",),
    "PIQP": ("piqp",),
    "HiGHS simplex": ("highspy",),
    "cvxpy with OSQP": ("cvxpy", "osqp"),
    "cvxpy with HiGHS": ("cvxpy", "highspy"),
}
"""Of each solver, as a fit names it, what has to be the same for the same answer."""


@cache
def _version(package: str) -> str:
    from importlib.metadata import version

    return version(package)


def versions(solvers: Collection[str]) -> dict[str, str]:
    """Versions of what a fit was computed with: this package, Python, numpy and these solvers."""
    from uncertain_lti import __version__

    packages = ["numpy", *sorted({package for name in solvers for package in _PACKAGES[name]})]
    own = {"uncertain-lti": __version__, "python": platform.python_version()}
    return own | {package: _version(package) for package in packages}
