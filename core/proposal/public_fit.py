# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""fit() as users call it: a monitor, with the terms, the schedule and the horizons that the recordings carry."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

from numpy.typing import ArrayLike

from uncertain_lti.base.arrays import spread
from uncertain_lti.base.errors import FitError, SignalError
from uncertain_lti.base.text import plural
from uncertain_lti.identification import fitting
from uncertain_lti.identification.archive import fit_archive, refuse_auto
from uncertain_lti.identification.problem import check_criterion
from uncertain_lti.identification.regimes import Knots, asked_by, check_names, signals_of, unused
from uncertain_lti.identification.structure import Structure
from uncertain_lti.model.alarm_rule import Rule, checked_rules
from uncertain_lti.model.horizon import Widths
from uncertain_lti.model.operating_point import OperatingPoint
from uncertain_lti.model.schedule import Schedule
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.proposal.search import choose_ends, choose_horizons, choose_knots, knots_of, lengths_of
from uncertain_lti.recordings.formats import group_recordings
from uncertain_lti.recordings.recording import Recording
from uncertain_lti.sampling.reading import load_signals, read_transients, refuse_copies
from uncertain_lti.sampling.transient import Transient, listed_transients
from uncertain_lti.signals.signal_map import SignalMap
from uncertain_lti.signals.values import Additive, Criterion, HorizonRule, WidthChoice
from uncertain_lti.validation.monitor_fit import choose_monitored, monitored_like, point_of
from uncertain_lti.validation.panel import check_rate

SAMPLE = 2e7
"""Numbers of the recordings of an archive that are left out in turn, at most: 160 MB."""


def fit(
    transients: Sequence[Transient] | Transient,
    criterion: Criterion | None = None,
    weights: ArrayLike | Sequence[ArrayLike] | None = None,
    additive: Additive | None = None,
    operating_point: OperatingPoint | None = None,
    *,
    transient_weights: Sequence[float] | None = None,
    count: Literal["sample", "transient"] = "sample",
    structure: Structure | None = None,
    schedule: Schedule | Mapping[str, Knots] | None = None,
    horizons: HorizonRule | Mapping[str, Any] | Sequence[int] | Literal["auto"] | None = None,
    widths: WidthChoice | None = None,
    discard: float = 0,
    method: Literal["working-set", "cvxpy"] = "working-set",
    describe_data: bool = True,
    seek_carriers: bool = False,
    alarm: Literal["panel", "containment"] | Sequence[Rule] = "panel",
    false_alarms: float | None = None,
    progress: Callable[[str], None] | None = None,
    groups: Sequence[Any] | str | None = None,
) -> UncertainLTI:
    """Fit dx/dt = (A ± ΔA) x + (B ± ΔB) u so that the one-step bounds contain every recorded sample, and arm it.

    Without options it gives a monitor: criterion and additive term are chosen, and the thresholds of a small fixed
    panel of alarm rules are learnt, by what is left out of the fit (`validation.panel`): recordings or groups, or
    blocks of a single recording. What is given by hand is kept: `fit(transients, "qp", additive="none",
    alarm="containment")` is the paper's form.

    Leibov (2006), eq. (10), the least sum of squared widths weighted by W, or eq. (11), the least largest width
    per row. Ties: for (11) the least sum of squared widths among its optima; then, for both, the least sum of
    squared distances of the bounds' centre from the recorded next sample.

    Parameters
    ----------
    transients : Transient or sequence of Transient
        Recordings, of any lengths, of the same states and controls; never joined to one another.
    criterion : {"qp", "lp"}, optional
        Eq. (10) or eq. (11). Default: (11), or (10) if its panel sees clearly smaller jumps (0.9 of the size, geometric
        mean over the states, on what was fitted and on what was left out).
    weights : array (n,), (N, n), (N, n, n), or a list with one of the latter two per transient, optional
        W(t_{k+1}) for step k of N; positive; full matrices symmetric positive definite. Off-diagonal elements
        couple the rows in (10); (11) uses the diagonal. Default ones.
    additive : {"none", "disturbance", "noise", "both"}, optional
        Further terms: disturbance c with half-width dc, half-width v of measurement noise (noise). Default:
        that of the signals file, else noise, or both chosen in the same way.
    operating_point : OperatingPoint, optional
        Steady state and scales; default: those of the transients' signals, or values used as they are; where criterion
        and additive are left open too, the medians are tried as steady state with (10) and both terms.
    transient_weights : sequence of float, optional
        One factor per transient on the weights of all its samples.
    count : {"sample", "transient"}
        In (10) and (11), every sample weighs the same, or every transient does, however long it is.
    structure : Structure, optional
        Elements that are known, or bounded. Default: the rules of the signals file, if it has any.
    schedule : Schedule or mapping, optional
        Of a scheduled (piecewise-linear) model. A mapping has one or two signals, a state, a control or a further
        scheduling signal, each with its knots in recorded units, with `Modes`, or with how many knots: then from the
        least to the greatest recorded value, the inner ones where they shrink the largest residuals most; or with
        "auto": as many as the recordings carry, by what is left out of the fit (`choose_knots`), with the table in
        `model.fit_summary["schedule"]`. Default: that of the signals file, else one block. With a
        schedule and an additive term c is unknown, too: it moves the steady state from knot to knot.
    horizons : HorizonRule, mapping, sequence of int or "auto", optional
        Envelopes over several steps beside that of one: numbers of steps; `{"seconds": [0.1, 0.5]}`;
        `{"longest": 1.0}`, a geometric set of horizons up to so many seconds, of which those stay that hold on what is
        left out of the fit (`choose_horizons`); or "auto": the longest is chosen as well. The table is in
        `model.fit_summary["horizon_choice"]`. Default: that of the signals file, else none.
    widths : {"auto", "growing", "constant"}, optional
        Half-widths over these horizons: growing with |x| and |u|, the same everywhere, or what holds better on what is
        left out. Default: that of the signals file, else auto.
    discard : int or float, default 0
        Budget of transitions that need not be contained: a whole number, or a share of all below 1. They are chosen by
        their effect on the objective and listed in `model.fit_summary["discarded"]`, next to the widths with them.
    method : {"working-set", "cvxpy"}
        cvxpy states the whole problem as written (OSQP, HiGHS); slow, without tie-breaks, for comparison.
    describe_data : bool, default True
        Say in `model.fit_summary["messages"]` what the user should know; a fit of many need not.
    seek_carriers : bool
        Say there as well which few transitions make a state's envelope much wider than the others need. Takes several
        times as long as the fit; beyond 200 000 transitions it is not sought.
    alarm : {"panel", "containment"} or sequence of AlarmRule or StatisticRule, default "panel"
        What raises the alarm: the panel, with what it promises in `model.fit_summary["alarm"]`; a sample outside its
        bounds; or these rules.
    false_alarms : float, optional
        False alarms per hour at most, the upper limit with 90 % confidence, that the panel is learnt for. Default: what
        the recordings can show. If they cannot show the rate, thresholds rise, by half at most, until no recording
        passes those of the others, and the summary says so.
    progress : callable, optional
        Called with one line of text per pass over the data, and per discard.
    groups : sequence or str, optional
        What is left out together: one name per recording, or a key, as in `validate`.

    Returns
    -------
    UncertainLTI
        With zero training transitions outside its own `bounds`. `fit_summary["messages"]` says in words what the user
        should know; `fit_summary["optimality_gap"]` is the relative distance of the objective from a lower bound of
        the optimum, None if no bound was found.

    Raises
    ------
    FitError
        The transients do not match, there are too few transitions, or no envelope exists (names the sample); groups
        are given and nothing is left out.
    """
    transients = listed_transients(transients)
    fitting.common_signals(transients)
    if criterion is not None:
        check_criterion(criterion)
    _check_alarm(alarm, false_alarms)
    signals = transients[0].signals
    if additive is None and signals is not None:
        additive = signals.additive
    options: dict[str, Any] = {"criterion": criterion or "lp", "additive": additive or "noise", "count": count}
    messages: list[str] = []
    learns = alarm == "panel" and method == "working-set"
    if learns:
        refuse_copies(transients)
    for_controls_as_they_are = (weights, transient_weights, operating_point, structure)
    if learns and all(given is None for given in for_controls_as_they_are):
        at, why = choose_ends(transients, groups=groups, **options)
        if why:
            transients = [t.controls_at(at) for t in transients]
            messages.append(why)
            signals = transients[0].signals
    options |= {"weights": weights, "operating_point": operating_point, "structure": structure}
    options |= {"discard": discard, "method": method}
    asked = schedule
    if asked is None:
        asked = {} if signals is None else asked_by(signals)
    given = asked if isinstance(asked, Mapping) else {}
    automatic = [name for name, knots in given.items() if isinstance(knots, str) and knots == "auto"]
    rule = _horizons_asked_for(signals, horizons, widths)
    leaves_out = alarm == "panel" or automatic or (rule is not None and rule.leaves_out)
    if groups is not None and not leaves_out:
        raise FitError("groups are given, and the fit leaves nothing out; leave them out, or take the panel as alarm")
    if automatic and transient_weights is not None:
        raise FitError(
            f"the knots of '{automatic[0]}' are auto, which leaves recordings out, and transient_weights are for all "
            f"of them; give the knots, or count='transient'"
        )
    if automatic and structure is None:
        _no_knots_named(signals, automatic[0])
    choosing = {"groups": groups, "progress": progress}
    asked, added, said = _with_knots(transients, asked, automatic, options | choosing)
    messages += said
    lengths: dict[int, Widths] = {}
    if rule is not None:
        if rule.leaves_out and transient_weights is not None:
            raise FitError(
                "horizons are chosen by leaving recordings out, and transient_weights are for all of them; give steps "
                "or seconds with widths, or count='transient'"
            )
        lengths, facts, said = _over(transients, rule, options | choosing | {"schedule": asked})
        added |= facts
        messages += said
    options |= {"schedule": asked, "horizons": list(lengths), "widths": lengths, "transient_weights": transient_weights}
    options["drop_horizons"] = not (rule and (rule.steps or rule.seconds))
    options |= {"describe_data": describe_data, "seek_carriers": seek_carriers, "progress": progress}
    if learns:
        ways = _ways(criterion, additive, bool(asked))
        if len(ways) > 2 and operating_point is None:
            ways.append({"criterion": "qp", "additive": "both", "centred": True})
        taken = choose_monitored(transients, ways, groups=groups, false_alarms=false_alarms, **options)
        model = taken.finished()
        if taken.centred:
            messages.append(
                "deviations are measured from the medians of the recordings, where the alarm sees clearly smaller "
                "jumps; an operating point, criterion or additive term given by hand keeps the steady state"
            )
    else:
        model = fitting.fit(transients, **options)
        if not isinstance(alarm, str):
            model = model.replace(alarm=alarm)
    return _saying(model, messages, added)


def _with_knots(
    transients: Sequence[Transient],
    asked: Schedule | Mapping[str, Knots],
    automatic: Sequence[str],
    options: Mapping[str, Any],
) -> tuple[Schedule | Mapping[str, Knots], dict[str, Any], list[str]]:
    """A schedule with the knots of the automatic signals chosen, one after the other; the tables, and sentences."""
    first = transients[0]
    chosen: dict[str, Knots] = dict(asked) if isinstance(asked, Mapping) else {}
    check_names(chosen, first.signal_names)
    tables: list[Any] = []
    messages: list[str] = []
    for number, name in enumerate(automatic):
        others = {other: knots for other, knots in chosen.items() if other not in automatic[number:]}
        best, table = choose_knots(transients, name, others, **options)
        assert best.model is not None, "without a fit to everything with one knot it raises"
        tables.append(table)
        messages.append(f"schedule: {plural(best.count, 'knot')} on {name}: {table['reason']}")
        chosen = {**chosen, name: knots_of(best.model, name) or 1}
        asked = best.model.schedule or {}  # to the bit as it was judged
    messages += unused(first.scheduling_names, [*signals_of(asked, first.signal_names), *automatic])
    return asked, {"schedule": tables} if tables else {}, messages


def _over(
    transients: Sequence[Transient], rule: HorizonRule, options: Mapping[str, Any]
) -> tuple[dict[int, Widths], dict[str, Any], list[str]]:
    """Half-widths of each number of steps that a rule asks for, or that is chosen; then with the table, and why."""
    steps = lengths_of(rule, transients)
    if not rule.leaves_out:
        return dict.fromkeys(steps, "growing" if rule.widths == "growing" else "constant"), {}, []
    first, point = transients[0], options["operating_point"]
    on = signals_of(options["schedule"], first.signal_names)
    point = point and point.scheduled_on([name in on for name in first.scheduling_names])
    own = {**options, "operating_point": point}
    lengths, choice = choose_horizons([t.scheduled_on(on) for t in transients], rule, steps, **own)
    listed = f"horizons of {', '.join(map(str, sorted(lengths)))} steps" if lengths else "no horizons"
    return lengths, {"horizon_choice": choice}, [f"{listed}: {choice['reason']}"]


def _saying(model: UncertainLTI, messages: Sequence[str], added: Mapping[str, Any]) -> UncertainLTI:
    """The model with further sentences, and facts, in its summary."""
    if not (added or messages):
        return model
    there = model.fit_summary.get("messages", [])
    return model.replace(fit_summary={**model.fit_summary, **added, "messages": [*there, *messages]})


def fit_many(
    paths: Sequence[str | os.PathLike[str]],
    signals: SignalMap | str | os.PathLike[str],
    criterion: Criterion | None = None,
    additive: Additive | None = None,
    *,
    schedule: Schedule | Mapping[str, Knots] | None = None,
    alarm: Literal["panel", "containment"] | Sequence[Rule] = "panel",
    false_alarms: float | None = None,
    progress: Callable[[str], None] | None = None,
    **where: Any,
) -> UncertainLTI:
    """`fit` over recordings that together need not fit in memory: the optimum of all, with what some of them leave out.

    Criterion, additive term and panel are those of a `fit` of recordings from the whole row that have SAMPLE numbers
    together; `where`: cache or client, as for `fit_archive`.
    """
    _check_alarm(alarm, false_alarms)
    if not isinstance(signals, SignalMap):
        signals = load_signals(signals, paths)
    additive = additive or signals.additive
    asked = asked_by(signals) if schedule is None else schedule
    refuse_auto(signals.scheduled_on(signals_of(asked, [s.name for s in signals.signals])))
    taken, some, messages = None, list[Transient](), list[str]()
    if alarm == "panel":
        bags = group_recordings(paths, indexed=True, layout=signals.table)
        some, total = _some(bags, signals), len(bags)
        del bags  # of tables their numbers
        ways, said = _ways(criterion, additive, bool(asked)), {"describe_data": False, "progress": progress}
        at, why = choose_ends(some, criterion=criterion or "lp", additive=additive or "noise")
        if why:
            some, messages = [t.controls_at(at) for t in some], [why]
            assert some[0].signals is not None
            signals = replace(signals, controls=some[0].signals.controls)
        own = {"schedule": asked, "operating_point": point_of(some[0]), "false_alarms": false_alarms}
        taken = choose_monitored(some, ways, **own, **said)
        criterion, additive = (taken.model.fit_summary[name] for name in ("criterion", "additive"))
    model = fit_archive(
        paths, signals, criterion or "lp", additive or "noise", schedule=schedule, progress=progress, **where
    )
    if taken is None:
        return model if isinstance(alarm, str) else model.replace(alarm=alarm)
    note = f"learnt on {len(some)} of {plural(total, 'recording')}, as many as memory is for"
    note *= len(some) < total
    return _saying(monitored_like(taken, model, some, false_alarms, note).finished(), messages, {})


def _check_alarm(alarm: str | Sequence[Rule], false_alarms: float | None) -> None:
    """Refuse an alarm that there is not, and a rate for one that is not learnt."""
    if not isinstance(alarm, str):
        checked_rules(alarm)
    elif alarm not in ("panel", "containment"):
        raise FitError(f"alarm is {alarm!r}; it must be panel, containment, or a list of rules")
    if false_alarms is not None and alarm != "panel":
        raise FitError("false_alarms is what the panel is learnt for; leave alarm or false_alarms out")
    check_rate(false_alarms)


def _some(bags: Sequence[Recording], signals: SignalMap) -> list[Transient]:
    """Recordings spread over the whole row, with SAMPLE numbers together."""
    found: dict[int, Transient] = {}
    left = SAMPLE
    for i in spread(len(bags)):
        (run,) = read_transients(bags[i].parts if len(bags[i].parts) > 1 else bags[i].path, signals)
        size = run.x.size + run.u.size + run.s.size
        if size > left and found:
            break
        found[i] = run if size <= left else run.replace(slice(0, int(len(run) * left / size)))
        left -= size
    some = [found[i] for i in sorted(found)]
    refuse_copies(some)
    return some


def _ways(criterion: str | None, additive: str | None, scheduled: bool) -> list[dict[str, Any]]:
    """Criteria and additive terms to choose from, the simplest first."""
    every = (additive,) if additive else ("noise",) if scheduled else ("noise", "both")
    criteria = (criterion,) if criterion else ("lp", "qp")
    return [{"criterion": one, "additive": terms} for terms in every for one in criteria]


def _horizons_asked_for(
    signals: SignalMap | None,
    horizons: HorizonRule | Mapping[str, Any] | Sequence[int] | Literal["auto"] | None,
    widths: WidthChoice | None,
) -> HorizonRule | None:
    """The horizons that a fit is asked for, by its arguments or by the signals file; by an empty list none."""
    rule = signals.horizons if signals is not None and horizons is None else None
    try:
        if horizons is not None and not (isinstance(horizons, Sequence) and not horizons):
            rule = HorizonRule.of(dict(horizons) if isinstance(horizons, Mapping) else horizons)
        if widths is not None and rule is not None:
            rule = replace(rule, widths=widths)
    except SignalError as error:
        raise FitError(str(error)) from None
    if widths is not None and rule is None:
        raise FitError(f"widths are {widths}, and no horizons are asked for; give horizons as well")
    return rule


def _no_knots_named(signals: SignalMap | None, name: str) -> None:
    """Refuse a structure that names knots which are not chosen yet."""
    if signals is None or not isinstance(signals.structure, list):
        return
    for k, rule in enumerate(signals.structure):
        if isinstance(rule, Mapping) and rule.get("knot", "all") != "all":
            raise FitError(
                f"{signals.source}: structure[{k}]: knot is {rule['knot']!r}, and the knots of '{name}' are auto, so "
                f"it is not known which there will be; give the knots, or leave knot out"
            )
