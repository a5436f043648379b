# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""EnvelopeMonitor: samples in, verdicts and alarm out; the only place where either is made."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise
from typing import Any, SupportsFloat

import cython
import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import Array, Integers, Mask, numbers, on_cores
from uncertain_lti.base.errors import ModelError, refuse_other
from uncertain_lti.kernel import arithmetic as kernel
from uncertain_lti.kernel.arithmetic import LOWER, RESIDUAL, UPPER, UTILISATION, Judgement, all_carried
from uncertain_lti.model.alarm_rule import AlarmRule, Rule, with_containment
from uncertain_lti.model.operating_point import normalise_columns, normalised
from uncertain_lti.model.repeats import Bounds, FrozenWatch, Partly, followed, needs
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.alarm import Alarm, Armed, Arming, back_and_restarts, steps_back
from uncertain_lti.monitor.verdict import Foreseen, Verdict, Verdicts
from uncertain_lti.sampling.clock import Status
from uncertain_lti.sampling.sampler import Step, all_finite
from uncertain_lti.sampling.transient import Transient, Transitions


def _alarm_spans(t_ns: Integers, armed: Armed) -> list[tuple[int, int]]:
    """[start, stop) of samples over which the alarm goes on from a cleared one; others raise none."""
    counts, count = armed.counts, len(t_ns)
    _, restarts = back_and_restarts(t_ns)
    edges = np.flatnonzero(restarts | armed.cleared | np.append(True, counts[1:] != counts[:-1])[:count])
    return [(a, b) for a, b in pairwise([*edges.tolist(), count]) if counts[a]]


_OK, _RESET = Status.OK, Status.RESET  # an enum looks its members up at each use
_BEYOND_NS = 2**63 - 1  # later than any instant
_PIECE = 200_000  # numbers that one thread takes at a time
Whole = int  # C would make a whole number of an `int` that is none


@cython.cclass
class EnvelopeMonitor:
    """Judges one-step transitions by the bounds of a model, and raises the alarm while one of its rules does.

    A sample is contained when lower <= x_next <= upper in the normalised quantities, nothing else (Leibov (2006),
    eqs. (8)(9)). Every rule of the alarm (m of n violations, a statistic over a window) looks at the last verdicts
    (messages without a verdict do not count) and starts over when time jumps back. A step shorter than half of, or
    longer than twice, those that the model was fitted to has no verdict. Nor has a state whose row needs one that is
    frozen (`frozen`), which raises the alarm; the others are judged.

    Parameters
    ----------
    model : UncertainLTI
        Gives the bounds and the rules of the alarm.
    violations : int, optional
        In place of that of the rule for one-step containment.
    window : int, optional
        In place of that of the same rule, in verdicts.
    margin : float, optional
        In place of that of the same rule. If there is no such rule, giving any of the three adds one.
    masked : sequence of str, optional
        States that are judged like the others, and never count for the alarm.
    rules : sequence of AlarmRule or StatisticRule, optional
        In place of all rules of the model.

    Attributes
    ----------
    rule : AlarmRule
        For one-step containment; its margin is that of the flags.
    alarms : Alarm
        All rules, and what raises the alarm.

    Raises
    ------
    ModelError
        violations, window or margin are out of range, masked names no state of the model, or all, or the model has not
        what a rule needs.
    """

    model: UncertainLTI = cython.declare(object, visibility="readonly")
    rule: AlarmRule = cython.declare(object, visibility="readonly")
    alarms: Alarm = cython.declare(object, visibility="readonly")
    masked: tuple[str, ...] = cython.declare(object, visibility="readonly")
    frozen_watch: FrozenWatch | None = cython.declare(object, visibility="readonly")
    _counted: Any

    _judge: Any
    _runs: Any
    _nothing: Any
    _own: Any
    _frozen_alarm: cython.bint
    last_ns: int = cython.declare(cython.longlong, visibility="readonly")
    _before_ns: cython.longlong
    _back_from_ns: cython.longlong
    _shortest: cython.double
    _longest: cython.double

    def __init__(
        self,
        model: UncertainLTI,
        violations: Whole | None = None,
        window: Whole | None = None,
        margin: float | None = None,
        masked: Sequence[str] = (),
        rules: Sequence[Rule] | None = None,
    ) -> None:
        refuse_other(model, UncertainLTI, "model", "read a file with UncertainLTI.load first", ModelError)
        if rules is not None:
            model = model.replace(alarm=rules)
        self.model = model
        given: dict[str, Any] = {"violations": violations, "window": window, "margin": margin}
        given = {name: value for name, value in given.items() if value is not None}
        self.rule = replace(model.alarm_rule, **given)
        every = with_containment(model.alarm, self.rule) if given else model.alarm
        names = model.state_names
        refuse_other(masked, Iterable, "masked", "give the names of states", ModelError)
        masked = [masked] if isinstance(masked, str) else list(masked)
        for name in masked:
            if name not in names:
                raise ModelError(f"masked state '{name}' is not in the model; its states are {', '.join(names)}")
        self.masked = tuple(name for name in names if name in masked)
        if len(self.masked) == len(names):
            raise ModelError("every state of the model is masked; leave at least one that can raise the alarm")
        self._counted = np.array([name not in masked for name in names])

        self._judge = model.judge_of(self.rule.margin, self._counted)
        self.alarms = Alarm(every, model, self._counted)
        self._runs = model.runs_of(self._judge)
        self._nothing = None if self._runs is None else np.full(model.n * len(model.horizons), np.nan)
        self.frozen_watch = self._watch()
        self.last_ns = self._before_ns = _BEYOND_NS  # instants of the last two samples
        self._back_from_ns = -_BEYOND_NS  # the one before these, if the last one stepped back from it
        self._frozen_alarm = False
        self._own = np.diagonal(model.A).tolist() if model.schedule is None else None
        self._shortest, self._longest = model.sampling.step_range

    def __repr__(self) -> str:
        rule = self.rule
        masked = f", {', '.join(self.masked)} masked" if self.masked else ""
        others = "".join(f"; {r.words}" for r in self.alarms.rules if r is not rule)
        return (
            f"EnvelopeMonitor({self.model!r}; alarm {rule.violations} of {rule.window}, "
            f"margin {rule.margin:g}{others}{masked})"
        )

    @property
    def alarm(self) -> bool:
        """The alarm after the last verdict, or that of a state that is frozen."""
        return self.alarms.alarm or self._frozen_alarm

    def reset(self) -> None:
        """Forget the recent verdicts and the alarm.

        Windows of the horizons go on, and a state that stays frozen raises the alarm again.
        """
        self.alarms.reset()
        self._frozen_alarm = False

    def _watch(self) -> FrozenWatch | None:
        """What tells frozen states; None if the model knows no repeats."""
        if self.model.repeats is None:
            return None
        dt = self.model.sampling.dt_median or 0.0
        return FrozenWatch(self.model.repeats, self.rule.margin, self._counted.tolist(), needs(self.model), dt)

    def _bounds_of(self, step: Step, judgement: Judgement) -> Bounds:
        """What the watch asks for if a state repeats."""
        point = self.model.operating_point
        z = normalised(np.array(step.before, dtype=np.float64), point.steady, point.scale)[:, None]
        own = self.model.own_rates(z)[:, 0].tolist() if self._own is None else self._own
        outside = judgement.unknown_regime or bool(self.model.domain.beyond(z)[0])
        return judgement.numbers(LOWER).tolist(), judgement.numbers(UPPER).tolist(), own, outside

    def predict(self, x: ArrayLike, u: ArrayLike, dt: SupportsFloat, s: ArrayLike = ()) -> tuple[Array, Array]:
        """Bounds one step ahead, recorded units.

        Parameters
        ----------
        x : array (n,)
            State, recorded units.
        u : array (m,)
            Control, recorded units.
        dt : float
            Step, s.
        s : array (q,), optional
            Further scheduling signals, recorded units.

        Returns
        -------
        array (n,)
            Lower bound; NaN for a mode that the model does not list.
        array (n,)
            Upper bound.

        Raises
        ------
        ModelError
            x, u or s has another length.
        """
        given = (x, "x", self.model.n), (u, "u", self.model.m), (s, "s", self.model.q)
        z = np.concatenate([numbers(values, name, (count,), ModelError) for values, name, count in given])
        verdict = self.expect(0, z.tolist(), dt)
        return verdict.lower, verdict.upper

    def expect(self, t_ns: int, z: ArrayLike, dt: SupportsFloat) -> Verdict:
        """`predict` as a verdict, not counted for the alarm.

        Parameters
        ----------
        t_ns : int
            Instant for which the bounds are, ns.
        z : sequence of float (n + m + q,)
            [x; u; s] before it, recorded units.
        dt : float
            Step, s.

        Returns
        -------
        Verdict
            Its `lower` and `upper` are the bounds.
        """
        before, step_s = self._given(z, dt)
        step = Step(Status.OK, t_ns, 0, step_s, before, before[: len(self._counted)])
        return Verdict(step, self.alarm, self._judge.judge(step.before, step.after, step.dt))

    def foresee(self, t_ns: int, z: ArrayLike, dt: SupportsFloat) -> Foreseen | None:
        """Bounds at the end of the longest horizon, if controls and further scheduling signals stay as they are.

        Parameters
        ----------
        t_ns : int
            Instant of the sample, ns.
        z : sequence of float (n + m + q,)
            [x; u; s] there, recorded units.
        dt : float
            Each step, s.

        Returns
        -------
        Foreseen or None
            By the margin of the one-step rule; None without horizons, and where the nominal run leaves all numbers.
        """
        before, step_s = self._given(z, dt)
        bounds = None if self._runs is None else self._runs.foresee(before, step_s)
        if bounds is None or not all_finite(bounds):
            return None
        return Foreseen(t_ns + max(self.model.steps) * round(step_s * 1e9), bounds)

    def _given(self, z: ArrayLike, dt: SupportsFloat) -> tuple[list[float], float]:
        total = self.model.n + self.model.m + self.model.q
        if isinstance(z, list) and len(z) == total and isinstance(dt, float) and set(map(type, z)) == {float}:
            return z, dt  # of a sampler, for every sample
        return numbers(z, "z", (total,), ModelError).tolist(), float(numbers(dt, "dt", (), ModelError))

    def steps_back(self, step: Step) -> bool:
        """Whether time steps back with a sample that `judge` has not taken yet.

        Parameters
        ----------
        step : Step
            Of the sampler.

        Returns
        -------
        bool
            Perhaps with this one alone, an outlier.
        """
        return step.status is _RESET and steps_back(step.t_ns, self.last_ns, self._before_ns)

    def starts_over(self, step: Step) -> bool:
        """Whether the alarm starts over at a sample that `judge` has not taken yet.

        Parameters
        ----------
        step : Step
            Of the sampler.

        Returns
        -------
        bool
            Time stepped back before it, and stays there.
        """
        return self._back_from_ns > -_BEYOND_NS and not step.status.dropped and step.t_ns <= self._back_from_ns

    def _judgement(self, step: Step) -> Any:
        try:
            return self._judge.judge(step.before, step.after, step.dt)
        except ValueError as error:  # of a step made by hand
            raise ModelError(f"step: {error}; give [x; u; s] before and x after") from None

    def judge(self, step: Step, armed: bool = True) -> Verdict:
        """Verdict on one step of the sampler.

        Parameters
        ----------
        step : Step
            Of the sampler, or `uncertain_lti.sampling.sampler.Step(Status.OK, t_ns, t_ns, dt, z, x_next)` of two
            samples, z = [x; u; s] of the first, recorded units; Status is that of `uncertain_lti.sampling.clock`.
        armed : bool, default True
            Whether it may count for the alarm; otherwise there is none, and the window is empty afterwards.

        Returns
        -------
        Verdict
            With the alarm after it.
        """
        refuse_other(step, Step, "step", "give a Step of a Sampler", ModelError)
        alarms, watch = self.alarms, self.frozen_watch
        if self.starts_over(step) or not armed:
            alarms.reset()
            self._frozen_alarm = False
        withheld: tuple[int, ...] = ()
        if step.status is _OK or not step.status.dropped:
            self._back_from_ns = self.last_ns if self.steps_back(step) else -_BEYOND_NS
            self._before_ns, self.last_ns = self.last_ns, step.t_ns
        judgement, status, looked = None, step.status, None
        if status is _OK:
            if not self._shortest <= step.dt <= self._longest:
                status = Status.STEP
            elif not all_carried(step.before):  # the bounds would be no numbers
                status = Status.MISSING
            elif (judgement := self._judgement(step)) is None:
                status = Status.MODE
        if judgement is not None and watch is not None:
            bounds = partial(self._bounds_of, step, judgement)
            looked = watch.look(step.t_ns, step.dt, step.before, step.after, bounds)
            self._frozen_alarm = armed and bool(looked.frozen)
            if withheld := looked.withheld:
                if np.delete(self._counted, withheld).any():
                    judgement = Partly(judgement, withheld, self._counted)
                else:
                    judgement, status = None, Status.FROZEN
        elif judgement is None and not status.dropped:
            self._frozen_alarm = False
            if watch is not None:
                watch.forget()
        longer = self._nothing
        if self._runs is not None:
            if judgement is not None and not withheld:
                longer = self._runs.push(step.before, step.after, step.dt)
            elif not status.dropped:  # what was dropped is no sample, and the next follows the one before
                self._runs.reset()
        if judgement is not None and armed:
            alarms.push(step.dt, judgement.violation, self._table(judgement, longer) if alarms.needs_table else None)
        return Verdict(step, alarms.alarm or self._frozen_alarm, judgement, status, alarms, longer, looked, armed)

    @cython.cfunc
    def _table(self, judgement: Any, longer: Any) -> array[float]:
        """Utilisation for one step and for each horizon, then the residuals likewise where they are needed."""
        table = array("d", judgement.numbers(UTILISATION))
        if self._runs is not None:
            table += array("d", longer)
        if self.alarms.needs_residual:
            table += array("d", judgement.numbers(RESIDUAL))
            if self._runs is not None:
                table += array("d", longer if longer is self._nothing else self._runs.residuals)
        return table

    def check(self, transient: Transient, armed: Armed | None = None) -> Verdicts:
        """Verdicts over a whole transient, from a cleared alarm; the same bits as `judge` step by step.

        Parameters
        ----------
        transient : Transient
            In recorded units.
        armed : Armed, optional
            Which samples may raise the alarm, of `Arming.over`; default all.

        Returns
        -------
        Verdicts
            One row per sample.

        Raises
        ------
        ModelError
            The transient has other numbers of states or controls than the model.
        """
        model, point = self.model, self.model.operating_point
        transient = model.own_signals_of(transient)
        step = None if isinstance(model.signals.step, str) else model.signals.step
        if transient.step != step:
            transient = transient.replace(step=step or "recorded")
        steps = transient.transitions()
        count, n = len(transient), model.n
        armed = Arming(None, 0).over(transient.t_ns) if armed is None else armed
        refuse_other(armed, Armed, "armed", "give what Arming.over returns, or leave it out", ModelError)
        if not armed.asked.all():
            steps = steps.take(armed.asked[steps.k] & armed.asked[steps.k + 1])
        fitted = (self._shortest <= steps.dt) & (steps.dt <= self._longest)
        unfitted_step = np.zeros(count, dtype=bool)
        if not fitted.all():
            unfitted_step[steps.k[~fitted] + 1] = True
            steps = steps.take(fitted)
        marks = np.zeros(count, dtype=np.uint8)
        first = (RESIDUAL, UTILISATION) if self.alarms.needs_residual else (UTILISATION,)
        seen = self._numbers(transient, steps, first, marks)
        judged, left, violated, unlisted_mode = (
            (marks & mark) > 0 for mark in (kernel.JUDGED, kernel.LEFT, kernel.VIOLATION, kernel.UNLISTED)
        )
        if np.count_nonzero(judged) < len(steps.k):
            steps = steps.take(judged[steps.k + 1])
        frozen, withheld, repeating, why = self._look_all(transient, steps, marks)
        whole = steps
        if withheld.any():
            part = np.asarray(withheld.any(axis=1))
            rows = np.flatnonzero(part)
            flags = np.asarray(
                self._numbers(transient, steps.take(part[steps.k + 1]), (kernel.FLAGS,))[kernel.FLAGS][rows] == 1.0
            )
            judged &= ~withheld[:, self._counted].all(axis=1)
            flags &= ~withheld[rows] & judged[rows, None]
            left[rows], violated[rows] = flags.any(axis=1), (flags & self._counted).any(axis=1)
            whole = steps.take((judged & ~part)[steps.k + 1])  # the run of a horizon needs every state
        _blank(seen, judged, withheld)

        @cache
        def numbers() -> list[Array]:
            later = self._numbers(transient, steps, [kind for kind in range(UTILISATION + 1) if kind not in first])
            _blank(later, judged, withheld)
            return [one if other is None else other for one, other in zip(seen, later, strict=True)]

        longer, longer_residual = np.full((2, len(model.horizons), count, n), np.nan)
        if model.horizons:
            arrival, x_next = whole.k + 1, np.empty((n, len(whole.k)))
            normalise_columns(transient.x[1:], whole.k, point.x_s, point.X, x_next)
            found = model.over_horizons(whole.k, model.normalised_columns(whole), whole.dt, x_next.T)
            for values, one in zip((longer, longer_residual), found, strict=True):
                values[:, arrival] = one.transpose(1, 0, 2)
        outside, unknown_regime = (judged & ((marks & mark) > 0) for mark in (kernel.OUTSIDE, kernel.UNKNOWN))
        each, dt = np.zeros((count, len(self.alarms.rules)), dtype=bool), np.zeros(count)
        dt[steps.k + 1] = steps.dt
        rows_of = [seen[UTILISATION], *longer, seen[RESIDUAL], *longer_residual]
        spans = _alarm_spans(transient.t_ns, armed)

        def over(**into: Any) -> Mask:
            alarms = Alarm(self.alarms.rules, model, self._counted)  # threads may ask for the statistics at once
            return alarms.over(spans, dt, violated, rows_of, judged, **into)

        @cache
        def statistics() -> tuple[Array, NDArray[np.int16]]:
            values = np.full((count, len(self.alarms.names)), np.nan)
            blamed = np.full(each.shape, -1, dtype=np.int16)
            over(values=values, blamed=blamed)
            return values, blamed

        alarm = over(each=each)
        if why:
            alarm |= frozen.any(axis=1) & armed.counts
        return Verdicts(
            transient, numbers, seen[UTILISATION], judged, left, outside, alarm, unfitted_step, unlisted_mode,
            unknown_regime, frozen, withheld, repeating, statistics, each, self.alarms, longer.transpose(1, 0, 2),
            longer_residual.transpose(1, 0, 2), why, armed.asked, armed.counts,
        )  # fmt: skip

    def _look_all(
        self, transient: Transient, steps: Transitions, marks: NDArray[np.uint8]
    ) -> tuple[Mask, Mask, Mask, dict[tuple[int, int], str]]:
        """`frozen`, `withheld`, `repeating`, `why_frozen` of `Verdicts`, by the watch of `judge`."""
        frozen, withheld, repeating = (np.zeros((len(transient), self.model.n), dtype=bool) for _ in range(3))
        why: dict[tuple[int, int], str] = {}
        watch, some = self._watch(), steps.rows(marks, 1) & kernel.REPEATS > 0
        if watch is not None and some.any():
            at, given = followed(self.model, transient.t_ns, steps, some, self.rule.margin)
            codes, withheld[at + 1], because = watch.look_all(given)
            frozen[at + 1], repeating[at + 1] = codes > kernel.LONGER, codes == kernel.LONGER
            for row, state in np.argwhere(codes > kernel.LONGER).tolist():
                why[int(at[row]) + 1, state] = because(row, state)
        return frozen, withheld, repeating, why

    def _numbers(
        self, transient: Transient, steps: Transitions, kinds: Sequence[int], marks: NDArray[np.uint8] | None = None
    ) -> list[Any]:
        """Arrays of some kinds of numbers, None of the others, that `Judge.judge_rows` fills in on all cores."""
        count = len(transient)
        numbers = [np.empty((count, self.model.n)) if kind in kinds else None for kind in range(UTILISATION + 1)]
        pieces = len(steps.k) * (self.model.n + self.model.m) // _PIECE + 1
        ends = np.linspace(0, len(steps.k), pieces + 1).astype(int).tolist()
        judges = [self.model.judge_of(self.rule.margin, self._counted) for _ in ends[1:]]  # each has room of its own
        given = [(judge, steps.k[a:b], steps.dt[a:b]) for judge, (a, b) in zip(judges, pairwise(ends), strict=True)]
        x, u, s = transient.x, transient.u, transient.s
        on_cores(lambda judge, k, dt: judge.judge_rows(x, u, s, k, dt, numbers, marks), given)
        return numbers


def _blank(numbers: Sequence[Any], judged: Mask, withheld: Mask) -> None:
    """NaN in place of numbers without a verdict."""
    missing, some = np.flatnonzero(~judged), bool(withheld.any())
    for values in numbers:
        if values is not None:
            values[missing] = np.nan
            if some:
                values[withheld] = np.nan
