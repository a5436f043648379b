# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""tune(): what `fit` does not do by itself, delays, schedules and memories, tried by what their panels see."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import FitError, TransientError, UncertainLTIError
from uncertain_lti.base.progress import CountedStep
from uncertain_lti.base.text import plural
from uncertain_lti.identification import fitting
from uncertain_lti.identification.assembly import assemble
from uncertain_lti.identification.evidence import autocorrelation, late_controls, size_of
from uncertain_lti.model.schedule import Axis, Schedule
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.envelope_monitor import EnvelopeMonitor
from uncertain_lti.proposal.public_fit import fit
from uncertain_lti.proposal.search import COUNTS, PAYS, Score, score_of, thinned
from uncertain_lti.sampling.clock import longest_step
from uncertain_lti.sampling.transient import Transient, controls_as, listed_transients
from uncertain_lti.signals.field_path import Memory
from uncertain_lti.signals.signal_map import Signal, with_rules
from uncertain_lti.signals.values import Additive
from uncertain_lti.validation.monitor_fit import CLEARLY, fit_monitored, point_of
from uncertain_lti.validation.panel import worth

PROMISING, SIGNALS = 0.9, 2
"""Largest least-squares residual with three knots, relative to one, up to which a signal is tried; and how many are."""
TRANSITIONS = 4000
"""Transitions by which promising signals are found, about; of larger recordings pieces are taken."""
FEWEST_STEPS, MOST_STEPS = 3, 0.05
"""A control whose steps are events changes in at least so many transitions, and in at most this share of them."""


@dataclass(frozen=True)
class Remembered:
    """A memory that may be added to the signals.

    `of`: the state or control whose samples it takes; `memory`: how.
    """

    of: str
    memory: Memory

    @property
    def name(self) -> str:
        """Name of the new signal."""
        what = {"lag": "before", "diff": "change", "rate": "rate"}[self.memory.kind]
        return f"{self.of}_{what}" + (f"_{self.memory.samples}" if self.memory.samples > 1 else "")


@dataclass(frozen=True)
class Setting:
    """One way to fit.

    `words`: what it is, in words; `options`: arguments of `fit`; knots of a schedule are stated by their number;
    `memories`: lags and rates that are added to the controls; `delays`: controls that are taken so many samples
    earlier.
    """

    words: str
    options: Mapping[str, Any]
    memories: tuple[Remembered, ...] = ()
    delays: tuple[tuple[str, int], ...] = ()

    def prepared(self, transients: Sequence[Transient]) -> list[Transient]:
        """The recordings with the delays and memories of this setting."""
        if self.delays:
            transients = [with_delays(t, dict(self.delays)) for t in transients]
        return remember(transients, self.memories) if self.memories else list(transients)

    def beside(self, what: str, **changes: Any) -> Setting:
        """This one with something more."""
        return replace(self, words=f"{self.words}, {what}", **changes)


def delays(transients: Sequence[Transient], best: Setting) -> Iterator[list[Setting]]:
    """Controls that are taken earlier: those that then explain more, and all of them by one sample."""
    first = transients[0]
    signals = () if first.signals is None else first.signals.controls
    remembered = {s.name for s in signals if s.memory is not None}
    names = list(first.control_names)
    low = np.min([np.nanmin(t.u, axis=0) for t in transients], axis=0)
    high = np.max([np.nanmax(t.u, axis=0) for t in transients], axis=0)
    moving = {name: 1 for j, name in enumerate(names) if name not in remembered and high[j] > low[j]}
    if not moving or "arrival" in first.ends:
        return
    sets = [moving]
    with suppress(FitError):  # too few of them follow one another
        few = thinned(transients, 5 * TRANSITIONS)
        problem = assemble(few, point_of(first), None, best.options.get("additive", "noise"))
        late = {names[j]: samples for j, (samples, _) in late_controls(problem).items() if names[j] in moving}
        sets = [late, *(s for s in sets if s != late)] if late else sets
    for chosen in sets:
        said = ", ".join(f"{name} {plural(count, 'sample')} earlier" for name, count in chosen.items())
        words = "all controls 1 sample earlier" if len(chosen) > 1 and chosen is moving else said
        yield [best.beside(words, delays=tuple(chosen.items()))]


def schedules(transients: Sequence[Transient], best: Setting) -> Iterator[list[Setting]]:
    """Schedules on each promising signal."""
    found = promise(thinned(transients, TRANSITIONS))
    signals = [name for name in sorted(found, key=lambda name: found[name]) if found[name] <= PROMISING][:SIGNALS]
    for name in signals:
        yield [
            best.beside(f"{count} knots on {name}", options={**best.options, "schedule": {name: count}})
            for count in COUNTS
        ]


def memories(transients: Sequence[Transient], best: Setting) -> Iterator[list[Setting]]:
    """Lags and rates of states whose residuals follow from sample to sample, and of controls that seldom change."""
    delayed = replace(best, memories=()).prepared(transients)
    for some in memory_candidates(delayed, best.options.get("additive", "noise")):
        yield [best.beside(f"with {', '.join(one.name for one in some)}", memories=some)]


def remember(transients: Sequence[Transient], memories: Sequence[Remembered]) -> list[Transient]:
    """Recordings with further controls that follow from their own earlier samples, none over a lost one."""
    instants = [t.t_ns for t in transients]
    usual, longest = (longest_step(instants, recalls=recalls) for recalls in (False, bool(memories)))

    def parted(t: Transient) -> Transient:
        if not math.isclose(t.max_gap, usual, rel_tol=1e-3):  # as somebody said
            return t
        signals = t.signals
        if signals is not None and signals.max_gap is not None:
            signals = replace(signals, max_gap=longest)
        return t.replace(max_gap=longest, signals=signals)

    return [with_memories(parted(t), memories) for t in transients]


def memory_candidates(transients: Sequence[Transient], additive: Additive = "noise") -> list[tuple[Remembered, ...]]:
    """Sets of memories that may narrow the envelope, by what least squares leaves unexplained.

    Of the states whose residual follows from sample to sample (`Autocorrelation.follows`) the rates (the
    differences, if the step is constant) and the values one sample earlier; of the controls that seldom change the
    values one sample earlier, and their changes.
    """
    first = transients[0]
    try:
        problem = assemble(transients, point_of(first), None, additive)
    except FitError:
        return []
    taken = {*first.signal_names}
    remembered = {r.of for r in first.signals.recalled} if first.signals is not None else set()
    found = autocorrelation(problem)
    follow = [i for i in range(problem.n) if found is not None and found.follows(i) and i not in remembered]
    rate = "rate" if first.step is None else "diff"
    changes = np.count_nonzero(np.diff(problem.z.T, axis=0), axis=0)
    seldom = (changes >= FEWEST_STEPS) & (changes <= MOST_STEPS * problem.N)
    events = [j for j in range(problem.n, problem.p) if seldom[j] and j not in remembered]
    names = [*first.state_names, *first.control_names]
    sets = [
        tuple(Remembered(names[i], Memory(kind)) for i in group)  # type: ignore[arg-type]
        for group, kinds in ((follow, (rate, "lag")), (events, ("lag", "diff")))
        for kind in kinds
        if group
    ]
    return [chosen for chosen in sets if not taken & {one.name for one in chosen}]


def choose_memories(transients: Sequence[Transient], additive: Additive) -> tuple[tuple[Remembered, ...], float]:
    """Which lags, rates or differences are worth having on left-out data, and the mean width over that without them.

    Of the sets of `memory_candidates` those for the states are tried on about 5 TRANSITIONS transitions, leaving out in
    turn, then, beside the best of them, those for the controls; the best is taken if it sees jumps smaller by PAYS.
    """
    sets = memory_candidates(thinned(transients, 5 * TRANSITIONS), additive)
    if not sets:
        return (), 1.0

    def scored(memories: tuple[Remembered, ...]) -> Score:
        runs = thinned(remember(transients, memories), 5 * TRANSITIONS)
        model = fitting.fit(runs, schedule={}, describe_data=False, additive=additive)
        return score_of(runs, model, None, {"additive": additive})[0]

    chosen: tuple[Remembered, ...] = ()
    try:
        before = best = scored(())
    except FitError:
        return (), 1.0
    for names in (transients[0].state_names, transients[0].control_names):
        found = [(best, chosen)]
        for some in (s for s in sets if s[0].of in names):
            with suppress(FitError):
                found.append((scored((*chosen, *some)), (*chosen, *some)))
        after, beside = min((one for one in found if one[0].holds(before)), key=lambda one: one[0].figure)
        if after.figure < PAYS * best.figure:
            best, chosen = after, beside
    return chosen, best.width / before.width


def promise(transients: Sequence[Transient]) -> dict[str, float]:
    """How far the largest residuals of least squares shrink with three knots on each signal.

    The knots are the ends of the signal and one of a few places between, the best.
    """
    first, steps = transients[0], [t.transitions() for t in transients]
    names = first.signal_names
    each = ([getattr(step, name) for step in steps] for name in ("x", "u", "s", "x_next", "dt"))
    x, u, s, x_next, dt = map(np.concatenate, each)
    z = np.column_stack([x, u])
    phi = dt * np.vstack([(z / size_of(z)).T, np.ones(len(z))])
    if len(z) < 9 * len(phi):
        return dict.fromkeys(names, 1.0)
    move = x_next - x
    floor = np.maximum(1e-9 * np.ptp(x, axis=0), 1e-300)
    whole = np.maximum(_largest(phi, move), floor)
    found = {}
    for name, values in zip(names, np.column_stack([z, s]).T, strict=True):
        low, high = float(values.min()), float(values.max())
        places = {0.5 * (low + high), *np.quantile(values, [0.25, 0.5, 0.75]).tolist()}
        found[name] = 1.0
        for place in sorted(p for p in places if low < p < high):
            weights = Schedule((Axis(name, knots=(low, place, high)),)).weights(values[None])
            left = _largest((weights[:, None] * phi[None]).reshape(-1, len(z)), move)
            found[name] = min(found[name], float(np.exp(np.mean(np.log(np.maximum(left, floor) / whole)))))
    return found


def _largest(phi: Array, move: Array) -> Array:
    """Mean of the largest hundredth of the least-squares residuals of each state; phi (r, N), move (N, n)."""
    theta = np.linalg.lstsq(phi.T, move, rcond=None)[0]
    left = np.sort(np.abs(move - phi.T @ theta), axis=0)
    return np.asarray(left[-max(1, len(left) // 100) :].mean(axis=0))


class _SpentError(Exception):
    """The budget is spent."""


@dataclass(frozen=True, eq=False)
class Tuned:
    """What `tune` chose, and all it tried.

    Parameters
    ----------
    model : UncertainLTI
        With its panel; `fit_summary["alarm"]` says what it promises and `fit_summary["tune"]` what was tried.
    reason : str
        Why this way.
    trials : tuple of dict
        Every way with the size of the jumps that it sees, over those of `fit` alone, or why it was refused.
    """

    model: UncertainLTI
    reason: str
    trials: tuple[dict[str, Any], ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain data for the model file and for `--json`.

        Returns
        -------
        dict
            The reason, and a row for each way.
        """
        return {"reason": self.reason, "trials": list(self.trials)}


def tune(
    transients: Sequence[Transient] | Transient,
    false_alarms: float | None = None,
    *,
    budget: float = math.inf,
    groups: Sequence[Any] | str | None = None,
    faulty: Mapping[str, Sequence[Transient]] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Tuned:
    """Try what `fit` does not do by itself, and take what sees clearly smaller jumps on left-out data.

    Controls taken earlier, schedules, and lags and rates of states are tried in turn, each beside the best so far, with
    the panel learnt anew. A way is taken if the jumps that its panel sees are smaller by CLEARLY than those
    of the best so far, and if it misses none of the recordings with a fault that `fit` alone sees.

    Parameters
    ----------
    transients : Transient or sequence of Transient
        Recordings of the healthy machine.
    false_alarms : float, optional
        As in `fit`.
    budget : float, optional
        Nothing new is begun after so many s, and what is under way then is broken off; the result then depends on how
        fast the machine is. Ctrl-C does the same.
    groups : sequence or str, optional
        As in `validate`.
    faulty : mapping of str to sequence of Transient, optional
        Recordings with a fault, by what it is.
    progress : callable, optional
        Called with one line of text per way.

    Returns
    -------
    Tuned
        The model with the best panel, and what was tried.

    Raises
    ------
    FitError
        The budget is not positive, or `fit` alone cannot learn a panel.
    """
    transients = listed_transients(transients)
    if not budget > 0:
        raise FitError(f"budget is {budget}; give a positive number of seconds")
    until = time.monotonic() + budget
    model = fit(transients, false_alarms=false_alarms, groups=groups, progress=progress)
    transients = [controls_as(t, model.signals.controls) for t in transients]
    alarm = model.fit_summary["alarm"]
    if "biases" not in alarm:
        raise FitError(f"fit alone cannot learn an alarm, so nothing can be compared: {alarm['not_learnt']}")
    options = {name: model.fit_summary[name] for name in ("criterion", "additive")}
    options |= {"centred": True} if alarm.get("centred") else {}
    best, least = Setting("as fit does", options), alarm["figure"]
    base, trials = least, [_row(best.words, least, least, model)]
    missed = _missed(model, best, faulty or {})
    reason = "no way sees clearly smaller jumps on left-out data than fit alone"

    def hurried(text: str) -> None:
        if time.monotonic() > until:
            raise _SpentError
        if progress is not None:
            progress(CountedStep(text, len(trials), max(len(trials) + 1, 12)))

    shared: dict[str, Any] = {"groups": groups, "false_alarms": false_alarms, "progress": hurried}

    def attempt(setting: Setting) -> bool:
        nonlocal best, least, model, reason, missed
        hurried(setting.words)
        try:
            runs = setting.prepared(transients)
            found = fit_monitored(runs, **{"schedule": {}, **setting.options, **shared})
            if found.panel is None:
                raise FitError(found.why)
            kind, headline = worth(found.model, found.panel)
            if kind == "none":
                raise FitError(headline)
        except UncertainLTIError as error:
            trials.append({"way": setting.words, "refused": str(error)})
            return False
        made, size = found.finished(), found.panel.figure
        unseen = _missed(made, setting, faulty or {})
        trials.append(_row(setting.words, size, base, made))
        if size > CLEARLY * least or unseen - missed:
            return False
        best, least, model, missed = setting, size, made, unseen
        reason = f"{setting.words}: it sees jumps of {least / base:.2g} of the size that fit alone sees"
        return True

    try:
        for further in (delays, schedules, memories):
            for settings in further(transients, best):
                for setting in settings:  # more and more, as long as they see more
                    if not attempt(setting):
                        break
    except (_SpentError, KeyboardInterrupt):
        reason += "; the time ran out before every way was tried"
    said = Tuned(model, reason, tuple(trials)).to_dict()
    return Tuned(model.replace(fit_summary={**model.fit_summary, "tune": said}), reason, tuple(trials))


def _missed(model: UncertainLTI, setting: Setting, faulty: Mapping[str, Sequence[Transient]]) -> set[tuple[str, int]]:
    """Recordings with a fault that raise no alarm."""
    monitor = EnvelopeMonitor(model)
    every = ((label, *one) for label, runs in faulty.items() for one in enumerate(setting.prepared(runs)))
    return {(label, k) for label, k, run in every if not monitor.check(run).alarm.any()}


def _row(words: str, size: float, base: float, model: UncertainLTI) -> dict[str, Any]:
    """One way in the table: sizes of jumps, widths over the ranges, false alarms."""
    span = model.domain.span(model.operating_point.X)
    width = np.asarray(model.fit_summary["mean_width_recorded"])
    share = np.divide(width, span, out=np.full(model.n, np.inf), where=span > 0)
    return {
        "way": words,
        "size": size / base,
        "width_over_range": float(share.max()) if np.isfinite(share).all() else None,
        "limit_per_hour": model.fit_summary["alarm"]["limit_per_hour"],
    }


def with_memories(transient: Transient, memories: Sequence[Remembered]) -> Transient:
    """The same run with further controls that follow from earlier samples of its states and controls."""
    places = {name: j for j, name in enumerate([*transient.state_names, *transient.control_names])}
    z, signals = np.hstack([transient.x, transient.u]), transient.signals
    u = np.column_stack([transient.u, *(recall(transient, z[:, places[one.of]], one.memory) for one in memories)])
    if signals is None:
        return transient.replace(u=u, control_names=(*transient.control_names, *(one.name for one in memories)))
    added = [memory_of(signals[places[one.of]], one.memory, one.name) for one in memories]
    rules = with_rules(signals.structure, {one.name: one.of for one in memories})
    return transient.replace(u=u, signals=replace(signals, controls=(*signals.controls, *added), structure=rules))


def with_delays(transient: Transient, delays: Mapping[str, int]) -> Transient:
    """The same run with some controls taken so many samples earlier, as `delay` in a signals file does."""
    u, signals = transient.u.copy(), transient.signals
    for j, name in enumerate(transient.control_names):
        if name in delays:
            u[:, j] = recall(transient, u[:, j], Memory("lag", delays[name]))
    if signals is not None:
        controls = [replace(s, delay=s.delay + delays[s.name]) if s.name in delays else s for s in signals.controls]
        signals = replace(signals, controls=tuple(controls))
    return transient.replace(u=u, signals=signals)


def memory_of(signal: Signal, memory: Memory, name: str) -> Signal:
    """A memory of a signal, as a control."""
    steady = signal.steady if memory.kind == "lag" else 0.0
    if signal.delay:
        samples = signal.delay + memory.samples if memory.kind == "lag" else 0
        if not samples:
            raise TransientError(f"'{signal.name}' is delayed, and has no {memory.kind}; take it of the field itself")
        memory = Memory("lag", samples)
    return replace(
        signal, name=name, field=memory.of(signal.field), steady=steady, unit=memory.unit(signal.unit), delay=0
    )


def recall(transient: Transient, values: Array, memory: Memory) -> Array:
    """What each sample takes from the samples up to it, as the `Sampler` has it.

    `values` (N+1,): of the field itself; Returns (N+1,): NaN where the segment has too few samples before.
    """
    place = np.arange(len(values))
    opens = np.diff(transient.segment, prepend=-1) != 0
    source = place - memory.samples
    there = source >= np.maximum.accumulate(np.where(opens, place, 0))
    past = np.where(there, values[np.maximum(source, 0)], math.nan)
    dt = np.concatenate([[math.nan], transient.dt])[: len(values)]  # of the step that leads to each
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        return np.asarray(memory.taken(values, past, dt))
