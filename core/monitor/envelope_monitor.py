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

import math
import struct
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.english import plural, times
from uncertain_lti.base.errors import ModelError, refuse_other
from uncertain_lti.base.html_table import html_table, name_with_unit, number_text
from uncertain_lti.base.limits import LARGEST
from uncertain_lti.model.alarm_rule import AlarmRule, Rule, with_containment
from uncertain_lti.model.bounds import (
    FLAGS,
    LOWER,
    RESIDUAL,
    UPPER,
    UTILISATION,
    Judgement,
    contained,
    lower_of,
    normalised,
    upper_of,
    utilisation_of,
)
from uncertain_lti.model.repeats import Moved
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.alarm import Alarm, Raised, residual_row
from uncertain_lti.monitor.arming import Armed
from uncertain_lti.monitor.frozen import Bounds, FrozenWatch, Looked
from uncertain_lti.sampling.sampler import Step
from uncertain_lti.sampling.status import Status
from uncertain_lti.sampling.transient import Transient, Transitions

NUMBERS = ("flags", "lower", "upper", "state", "utilisation")
"""Numbers of a verdict, for each state."""
_OF_JUDGEMENT = {"lower": LOWER, "upper": UPPER, "utilisation": UTILISATION, "flags": FLAGS}


class Verdict:
    """Verdict on one clock message.

    Numbers of each state, n each, are computed when they are asked for, by `numbers`, by `packed`, or as a new array by
    the attribute of that name: a live monitor makes one verdict per message, and often only the alarm is
    needed. They are `flags` (0 contained, 1 violated, NaN no verdict), `lower`, `upper` and `state` (the bounds that
    were judged and the sample, recorded units) and `utilisation` ((x_next - centre) / half, with half before the
    margin); NaN where there is no verdict.

    Parameters
    ----------
    step : Step
        The clock message.
    alarm : bool
        The alarm after this verdict.
    judgement : Judgement or None
        None if there is no verdict.
    status : Status, optional
        In place of that of the step, where the monitor gives no verdict on it.
    alarms : Alarm, optional
        The rules after it, whose statistics and reasons it keeps.
    longer : buffer of doubles, optional
        Utilisation by the model's horizons, horizon after horizon; for models that have some.
    looked : Looked, optional
        What the step says of repeats.

    Attributes
    ----------
    frozen, repeating : tuple of Moved
        States that are frozen, and others that repeat for longer than ever in the fit.
    """

    __slots__ = (
        "t_ns",
        "arrival_ns",
        "status",
        "outside_domain",
        "unknown_regime",
        "alarm",
        "frozen",
        "repeating",
        "_after",
        "_judgement",
        "_before",
        "_alarms",
        "_rules",
        "_statistics",
        "_longer",
    )

    frozen: tuple[Moved, ...]
    repeating: tuple[Moved, ...]

    def __init__(
        self,
        step: Step,
        alarm: bool,
        judgement: Judgement | None,
        status: Status | None = None,
        alarms: Alarm | None = None,
        longer: Any = None,
        looked: Looked | None = None,
    ) -> None:
        self.frozen, self.repeating = (looked.frozen, looked.repeating) if looked is not None else ((), ())
        self.t_ns, self.arrival_ns, self.status = step.t_ns, step.arrival_ns, status or step.status
        self._after, self._before = step.after, step.before
        self.outside_domain = judgement is not None and judgement.outside_domain
        self.unknown_regime = judgement is not None and judgement.unknown_regime
        self.alarm = alarm
        self._judgement, self._longer = judgement, longer
        self._alarms = alarms
        self._statistics: array[float] | None = None
        self._rules: tuple[int, ...] = ()
        if alarms is not None:
            self._rules = alarms.raised()
            if alarms.names and judgement is not None:
                self._statistics = alarms.values()

    def __repr__(self) -> str:
        if not self.judged:
            return f"Verdict({self.status.value}: no verdict)"
        left = int((self.flags == 1.0).sum())
        said = f"{left} of {plural(len(self.flags), 'state')} violated" if left else "contained"
        return f"Verdict({said}{', ' + self._where if self.outside_domain else ''}{', ALARM' * self.alarm})"

    @property
    def _where(self) -> str:
        return "in a regime that was not fitted" if self.unknown_regime else "outside the fitted domain"

    @property
    def judged(self) -> bool:
        """Whether there is a verdict, the message being neither dropped nor without a complete transition."""
        return self._judgement is not None

    @property
    def violated(self) -> bool:
        """Some state left its bounds."""
        return self._judgement is not None and not self._judgement.contained

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self._after)

    @property
    def statistic_names(self) -> tuple[str, ...]:
        """Names of `statistics`, `energy/fan_speed` for example; none where the alarm has containment rules alone."""
        return () if self._alarms is None else self._alarms.names

    @property
    def statistics(self) -> Array:
        """Each statistic over its threshold (S,): beyond 1 and -1 it raises the alarm; NaN without a verdict."""
        if self._statistics is None:
            return np.full(len(self.statistic_names), np.nan)
        return np.array(self._statistics, dtype=np.float64)

    @property
    def raised(self) -> tuple[Raised, ...]:
        """Which rules raise the alarm, with state, horizon and the statistic over its threshold.

        None without an alarm, and none without a verdict, where the alarm stays as it was.
        """
        if self._alarms is None or not self._rules or self._judgement is None:
            return ()
        return self._alarms.reasons(self._rules, self.statistics.tolist(), self.horizon_utilisation, self.flags)

    @property
    def horizons(self) -> int:
        """Number of horizons of the model."""
        return 0 if self._longer is None else len(self._longer) // self.n

    def numbers(self, name: str) -> list[float]:
        """Numbers of one kind.

        Parameters
        ----------
        name : str
            One of `NUMBERS`, horizon_utilisation, row by row, or statistics.

        Returns
        -------
        list of float (n,)
            As the attribute of that name.
        """
        if name == "state":
            return list(self._after)
        if name == "horizon_utilisation":
            return [*self.numbers("utilisation"), *(() if self._longer is None else self._longer)]
        if name == "statistics":
            return list[float](self.statistics.tolist())
        if self._judgement is None:
            return [math.nan] * len(self._after)
        return list[float](self._judgement.numbers(_OF_JUDGEMENT[name]).tolist())

    def packed(self, name: str) -> bytes:
        """The same as bytes.

        Parameters
        ----------
        name : str
            One of `NUMBERS`, horizon_utilisation, row by row, or statistics.

        Returns
        -------
        bytes
            Little-endian doubles.
        """
        found = self._after
        if name == "statistics":
            return self.statistics.tobytes() if self._statistics is None else self._statistics.tobytes()
        if name == "horizon_utilisation":
            return self.packed("utilisation") + (b"" if self._longer is None else bytes(self._longer.tobytes()))
        if name != "state":
            if self._judgement is not None:
                return bytes(self._judgement.numbers(_OF_JUDGEMENT[name]).tobytes())
            found = [math.nan] * len(found)
        return _packer(len(found))(*found)

    @property
    def before(self) -> list[float]:
        """[x; u; s] of the sample before, in recorded units (n + m + q,)."""
        return list(self._before)

    @property
    def flags(self) -> Array:
        """0 contained, 1 violated, NaN no verdict (n,)."""
        return np.array(self.numbers("flags"), dtype=np.float64)

    @property
    def state(self) -> Array:
        """The sample judged, in recorded units (n,)."""
        return np.array(self._after, dtype=np.float64)

    @property
    def lower(self) -> Array:
        """Lower bound that was judged, in recorded units (n,)."""
        return np.array(self.numbers("lower"), dtype=np.float64)

    @property
    def upper(self) -> Array:
        """Upper bound that was judged, in recorded units (n,)."""
        return np.array(self.numbers("upper"), dtype=np.float64)

    @property
    def utilisation(self) -> Array:
        """Where between its bounds the sample lies (n,)."""
        return np.array(self.numbers("utilisation"), dtype=np.float64)

    @property
    def horizon_utilisation(self) -> Array:
        """The same for one step and for each of the model's horizons (H, n); NaN where a window is broken."""
        longer = () if self._longer is None else self._longer
        return np.concatenate([self.utilisation, longer]).reshape(-1, self.n)


@dataclass(frozen=True)
class Foreseen:
    """Bounds at an instant to come.

    Parameters
    ----------
    t_ns : int
        The instant, ns.
    lower, upper : array (n,)
        The bounds, recorded units.
    """

    t_ns: int
    lower: Array
    upper: Array

    def packed(self, name: str) -> bytes:
        """The bounds as bytes.

        Parameters
        ----------
        name : str
            lower or upper.

        Returns
        -------
        bytes
            Little-endian doubles.
        """
        return bytes((self.lower if name == "lower" else self.upper).astype("<f8").tobytes())


@cache
def _packer(n: int) -> Callable[..., bytes]:
    return struct.Struct(f"<{n}d").pack


@dataclass(frozen=True, repr=False)
class Verdicts:
    """Verdicts over one transient, one row per sample k = 0..N; row k judges the arrival at t_k.

    Parameters
    ----------
    transient : Transient
        What was judged.
    flags : array (N+1, n)
        0 contained, 1 violated, NaN no verdict.
    lower : array (N+1, n)
        Lower bounds, recorded units; NaN without a verdict.
    upper : array (N+1, n)
        Upper bounds, recorded units; NaN without a verdict.
    utilisation : array (N+1, n)
        (x_next - centre) / half, with half before the margin.
    judged : array (N+1,) of bool
        Whether there is a verdict.
    outside_domain : array (N+1,) of bool
        z(t_{k-1}) lies outside the ranges seen in the fit.
    alarm : array (N+1,) of bool
        The alarm after each sample.
    unfitted_step : array (N+1,) of bool
        The step is out of the fitted range, so there is no verdict.
    unlisted_mode : array (N+1,) of bool
        The model lists no such mode of its scheduling signal, so there is no verdict.
    unknown_regime : array (N+1,) of bool
        A scheduling signal lies beyond the end knots, or no recording visited the regime; then the sample counts as
        outside the domain, too.
    frozen : array (N+1, n) of bool
        The state repeats exactly although the model moves it, so there is no verdict.
    thawed : array (N+1,) of bool
        A state was frozen one sample before and is not any more, so there is no verdict either.
    repeating : array (N+1, n) of bool
        The state repeats exactly for longer than ever in the fit, and is not frozen.
    statistics : array (N+1, S)
        Each statistic of the alarm over its threshold: beyond 1 and -1 it raises the alarm; NaN without a verdict.
    rule_alarms : array (N+1, rules) of bool
        Which rules raise the alarm after each sample.
    alarms : Alarm
        The rules, with their `labels` and the `names` of the statistics.
    longer_utilisation : array (N+1, horizons, n)
        Utilisation by each of the model's horizons; NaN where its window is broken.
    asked : array (N+1,) of bool, optional
        Whether a verdict was asked for; default all.
    """

    transient: Transient
    flags: Array
    lower: Array
    upper: Array
    utilisation: Array
    judged: NDArray[np.bool_]
    outside_domain: NDArray[np.bool_]
    alarm: NDArray[np.bool_]
    unfitted_step: NDArray[np.bool_]
    unlisted_mode: NDArray[np.bool_]
    unknown_regime: NDArray[np.bool_]
    frozen: NDArray[np.bool_]
    thawed: NDArray[np.bool_]
    repeating: NDArray[np.bool_]
    statistics: Array
    rule_alarms: NDArray[np.bool_]
    alarms: Alarm
    longer_utilisation: Array
    asked: NDArray[np.bool_] | None = None

    def __repr__(self) -> str:
        judged, left = int(self.judged.sum()), int(self.violated.sum())
        raised = int(np.count_nonzero(np.diff(np.concatenate([[False], self.alarm]).astype(np.int8)) == 1))
        said = f"{1 - left / judged:.3%} inside all bounds" if judged else "none possible"
        alarm = f"alarm raised {times(raised)}" if raised else "no alarm"
        return f"Verdicts({self.transient.name!r}: {plural(judged, 'verdict')}, {said}, {alarm})"

    def _repr_html_(self) -> str:
        """Violations and widths of each state."""
        transient, judged = self.transient, self.judged
        count, rows = int(judged.sum()), []
        units = [s.unit for s in transient.signals.states] if transient.signals else [""] * self.flags.shape[1]
        for i, (name, unit) in enumerate(zip(transient.state_names, units, strict=True)):
            bad = np.flatnonzero(self.flags[:, i] == 1.0)
            width = (self.upper - self.lower)[judged, i]
            rows.append(
                [
                    name_with_unit(name, unit),
                    str(len(bad)),
                    f"{1 - len(bad) / count:.3%}" if count else "–",
                    number_text(float(width.mean())) if count else "–",
                    number_text(float(width.max())) if count else "–",
                    f"{transient.t[bad[0]]:.4f} s" if len(bad) else "–",
                ]
            )
        return html_table(repr(self), ("state", "violations", "inside", "mean width", "largest", "first"), rows)

    def statuses(self) -> list[Status]:
        """Status of each sample.

        Returns
        -------
        list of Status
            N+1, as of `Transient.statuses`, with STEP where a step is out of the range of the fit, MODE where the
            model lists no such mode, FROZEN where a state is frozen, and UNASKED where no verdict was asked for.
        """
        kinds = self.transient.statuses()
        for k in np.flatnonzero(~self.judged):
            if kinds[k] is Status.OK:  # but for the two below, a value is beyond what the arithmetic carries
                kinds[k] = Status.MISSING
        frozen = self.frozen.any(axis=1) | self.thawed
        for which, kind in (
            (self.unfitted_step, Status.STEP),
            (self.unlisted_mode, Status.MODE),
            (frozen, Status.FROZEN),
        ):
            for k in np.flatnonzero(which):
                kinds[k] = kind
        if self.asked is not None:
            for k in np.flatnonzero(~self.asked):
                kinds[k] = Status.UNASKED
        return kinds

    @property
    def horizon_utilisation(self) -> Array:
        """Utilisation for one step and for each of the model's horizons (N+1, H, n); NaN where a window is broken."""
        return np.concatenate([self.utilisation[:, None], self.longer_utilisation], axis=1)

    @property
    def statistic_names(self) -> tuple[str, ...]:
        """Names of `statistics`, `energy/fan_speed` for example; none where the alarm has containment rules alone."""
        return self.alarms.names

    def raised(self, k: int) -> tuple[Raised, ...]:
        """Which rules raise the alarm after one sample.

        Parameters
        ----------
        k : int
            The sample.

        Returns
        -------
        tuple of Raised
            With state, horizon and the statistic over its threshold; none without an alarm or a verdict.
        """
        if not self.judged[k]:
            return ()
        rules = np.flatnonzero(self.rule_alarms[k]).tolist()
        return self.alarms.reasons(rules, self.statistics[k].tolist(), self.horizon_utilisation[k], self.flags[k])

    @property
    def state(self) -> Array:
        """The samples, in recorded units (N+1, n)."""
        return self.transient.x

    @property
    def violated(self) -> NDArray[np.bool_]:
        """Whether some state left its bounds, (N+1,)."""
        left: NDArray[np.bool_] = (self.flags == 1.0).any(axis=1)
        return left


def _alarm_spans(t_ns: NDArray[np.int64], armed: Armed | None) -> list[tuple[int, int]]:
    """[start, stop) of samples over which the alarm goes on from a cleared one; others raise none."""
    count = len(t_ns)
    restarts = np.zeros(count, dtype=bool)
    restarts[1:] = np.diff(t_ns) < 0
    counts = np.ones(count, dtype=bool)
    if armed is not None:
        counts, restarts = armed.counts, restarts | armed.cleared
    edges = np.flatnonzero(restarts | np.append(True, counts[1:] != counts[:-1])[:count])
    if not count:
        return []
    return [(int(a), int(b)) for a, b in zip(edges, [*edges[1:], count], strict=True) if counts[a]]


class EnvelopeMonitor:
    """Judges one-step transitions by the bounds of a model, and raises the alarm while one of its rules does.

    A sample is contained when lower <= x_next <= upper in the normalised quantities, nothing else (Leibov (2006),
    eqs. (8)(9)). Every rule of the alarm (m of n violations, a statistic over a window) looks at the last verdicts
    (messages without a verdict do not count) and starts over when time jumps back. A step shorter than half of, or
    longer than twice, those that the model was fitted to has no verdict. Nor has one at whose end a state is frozen
    (`frozen`), which raises the alarm.

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

    def __init__(
        self,
        model: UncertainLTI,
        violations: int | None = None,
        window: int | None = None,
        margin: float | None = None,
        masked: Sequence[str] = (),
        rules: Sequence[Rule] | None = None,
    ) -> None:
        refuse_other(model, UncertainLTI, "model", "read a file with UncertainLTI.load first", ModelError)
        if rules is not None:
            model = model.replace(alarm=rules)
        self.model = model
        rule = model.alarm_rule
        self.rule = AlarmRule(
            rule.violations if violations is None else violations,
            rule.window if window is None else window,
            rule.margin if margin is None else margin,
        )
        other = any(given is not None for given in (violations, window, margin))
        every = with_containment(model.alarm, self.rule) if other else model.alarm
        names = model.state_names
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
        self._frozen_alarm = False
        own = np.diagonal(model.A).tolist() if model.schedule is None else None
        self._own: list[float] | None = own
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
        return FrozenWatch(self.model.repeats, self.rule.margin, self._counted.tolist())

    def _forget_repeats(self) -> None:
        self._frozen_alarm = False
        if self.frozen_watch is not None:
            self.frozen_watch.forget()

    def _bounds_of(self, step: Step, judgement: Judgement) -> Bounds:
        """What the watch asks for if a state repeats."""
        own = self._own
        if own is None:
            point = self.model.operating_point
            z = normalised(np.array(step.before, dtype=np.float64), point.steady, point.scale)
            own = self.model.own_rates(z[:, None])[:, 0].tolist()
        return judgement.numbers(LOWER).tolist(), judgement.numbers(UPPER).tolist(), own

    def predict(self, x: ArrayLike, u: ArrayLike, dt: float, s: ArrayLike = ()) -> tuple[Array, Array]:
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
        """
        z = np.concatenate([np.asarray(a, dtype=np.float64) for a in (x, u, s)])
        verdict = self.expect(0, z.tolist(), dt)
        return verdict.lower, verdict.upper

    def expect(self, t_ns: int, z: Sequence[float], dt: float) -> Verdict:
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
        return self.look(Step(Status.OK, t_ns, 0, dt, z, z[: self.model.n]))

    def foresee(self, t_ns: int, z: Sequence[float], dt: float) -> Foreseen | None:
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
        if not self.model.horizons:
            return None
        steps, point = max(self.model.steps), self.model.operating_point
        now = normalised(np.array(z, dtype=np.float64), point.steady, point.scale)
        columns = np.repeat(now[:, None], steps, axis=1)
        found = None
        with np.errstate(over="ignore", invalid="ignore"):
            for windows, centre, half in self.model.envelopes(np.arange(steps), columns, np.full(steps, dt)):
                if len(windows.last):
                    found = tuple(of(centre[:, 0], half[:, 0], self.rule.margin) for of in (lower_of, upper_of))
        if found is None or not np.isfinite(found).all():
            return None
        lower, upper = (point.recorded_x(np.asarray(bound)) for bound in found)
        return Foreseen(t_ns + steps * round(dt * 1e9), lower, upper)

    def look(self, step: Step) -> Verdict:
        """Verdict on a complete step, not counted for the alarm.

        Parameters
        ----------
        step : Step
            With a complete transition.

        Returns
        -------
        Verdict
            With the alarm as it was.
        """
        return Verdict(step, self.alarm, self._judge.judge(step.before, step.after, step.dt))

    def judge(self, step: Step, armed: bool = True) -> Verdict:
        """Verdict on one step of the sampler.

        Parameters
        ----------
        step : Step
            Of the sampler.
        armed : bool, default True
            Whether it may count for the alarm; otherwise there is none, and the window is empty afterwards.

        Returns
        -------
        Verdict
            With the alarm after it.
        """
        alarms, watch = self.alarms, self.frozen_watch
        if step.status is Status.RESET or not armed:
            alarms.reset()
            self._frozen_alarm = False
        judgement, status, looked = None, step.status, None
        if status is Status.OK:
            if not contained(self._shortest, step.dt, self._longest):
                status = Status.STEP
            elif not -LARGEST <= min(step.before) <= max(step.before) <= LARGEST:  # the bounds would be no numbers
                status = Status.MISSING
            elif (judgement := self._judge.judge(step.before, step.after, step.dt)) is None:
                status = Status.MODE
        if judgement is not None and watch is not None:
            looked = watch.look(step.t_ns, step.dt, step.before, step.after, partial(self._bounds_of, step, judgement))
            self._frozen_alarm = armed and bool(looked.frozen)
            if looked.no_verdict:
                judgement, status = None, Status.FROZEN
        elif not status.dropped:
            self._forget_repeats()
        longer = self._nothing
        if self._runs is not None:
            if judgement is not None:
                longer = self._runs.push(step.before, step.after, step.dt)
            elif not status.dropped:  # what was dropped is no sample, and the next follows the one before
                self._runs.reset()
        if judgement is not None and armed:
            alarms.push(step.dt, judgement.violation, self._table(judgement, longer) if alarms.needs_table else None)
        return Verdict(step, self.alarm, judgement, status, alarms, longer, looked)

    def _table(self, judgement: Judgement, longer: Any) -> array[float]:
        """Utilisation for one step and for each horizon, then the residuals likewise, row by row."""
        utilisation, residual = array("d", judgement.numbers(UTILISATION)), array("d", judgement.numbers(RESIDUAL))
        if self._runs is None:
            return utilisation + residual
        return utilisation + array("d", longer) + residual + array("d", self._runs.residuals)

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
        instead = "read a recording with read_transients first, and give one after the other"
        refuse_other(transient, Transient, "the recording", instead, ModelError)
        model, point = self.model, self.model.operating_point
        if transient.x.shape[1] != model.n or transient.u.shape[1] != model.m:
            raise ModelError(
                f"{transient.name}: {plural(transient.x.shape[1], 'state')} and "
                f"{plural(transient.u.shape[1], 'control')}, and the "
                f"model has {model.n} and {model.m}"
            )
        if transient.s.shape[1] != model.q:
            raise ModelError(
                f"{transient.name}: {plural(transient.s.shape[1], 'further scheduling signal')}, and the model has "
                f"{model.q}; read it with the signals of the model"
            )
        if transient.step != model.sampling.step:
            transient = transient.replace(step=model.sampling.step or "recorded")
        steps = transient.transitions()
        count, n = len(transient), model.n
        fitted = np.asarray(contained(self._shortest, steps.dt, self._longest))
        unfitted_step, unlisted_mode = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
        if not fitted.all():
            unfitted_step[steps.k[~fitted] + 1] = True
            steps = steps.take(fitted)
        sizes = [np.abs(values).max(axis=1, initial=0.0) for values in (steps.x, steps.u, steps.s)]
        carried = np.asarray(np.max(sizes, axis=0) <= LARGEST)
        if not carried.all():
            steps = steps.take(carried)
        listed, unknown = model.regime(model.normalised_columns(steps))
        if not listed.all():
            unlisted_mode[steps.k[~listed] + 1] = True
            steps, unknown = steps.take(listed), unknown[listed]
        arrival = steps.k + 1
        flags, lower = np.full((count, n), np.nan), np.full((count, n), np.nan)
        upper, utilisation = np.full((count, n), np.nan), np.full((count, n), np.nan)
        judged, outside = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
        with np.errstate(over="ignore", invalid="ignore"):  # a value far beyond its bounds is beyond all numbers
            z, x_next = model.normalised_columns(steps), point.normalise_x(steps.x_next)
            flags[arrival], low, high, utilisation[arrival], residual = self._judge_all(z, steps.dt, x_next)
            lower[arrival], upper[arrival] = point.recorded_x(low), point.recorded_x(high)
        frozen, thawed, repeating = self._look_all(transient, steps, z, lower, upper)
        if (without := frozen.any(axis=1) | thawed).any():
            for numbers in (flags, lower, upper, utilisation):
                numbers[without] = np.nan
            kept = ~without[arrival]
            steps, arrival, z, x_next = steps.take(kept), arrival[kept], z[:, kept], x_next[kept]
            residual, unknown = residual[kept], unknown[kept]
        longer = np.full((count, len(model.horizons), n), np.nan)
        longer[arrival], longer_residual = model.over_horizons(steps.k, z, steps.dt, x_next)
        judged[arrival] = True
        unknown_regime = np.zeros(count, dtype=bool)
        unknown_regime[arrival] = unknown
        outside[arrival] = unknown | model.domain.outside(z[:n].T, z[n : n + model.m].T)
        violated = ((flags == 1.0) & self._counted).any(axis=1)
        alarms = Alarm(self.alarms.rules, model, self._counted)
        statistics = np.full((count, len(alarms.names)), np.nan)
        alarm, each = np.zeros(count, dtype=bool), np.zeros((count, len(alarms.rules)), dtype=bool)
        dt, half = np.zeros(count), residual_row(model) if alarms.needs_table else 0
        dt[arrival] = steps.dt
        table = np.empty((count, 2 * half, n))
        if half:
            table[:, 0], table[:, 1:half] = utilisation, longer
            table[arrival, half], table[arrival, half + 1 :] = residual, longer_residual
        for start, stop in _alarm_spans(transient.t_ns, armed):
            part = slice(start, stop)
            on = np.flatnonzero(judged[part]) + start
            after, by_rule, statistics[on] = alarms.over(dt[on], violated[on], table[on])
            held = np.cumsum(judged[part])  # without a verdict the alarm stays as it was
            alarm[part] = np.concatenate([[False], after])[held]
            each[part] = np.concatenate([np.zeros((1, len(alarms.rules)), dtype=bool), by_rule])[held]
        alarm |= frozen.any(axis=1) & (True if armed is None else armed.counts)
        return Verdicts(
            transient, flags, lower, upper, utilisation, judged, outside, alarm, unfitted_step, unlisted_mode,
            unknown_regime, frozen, thawed, repeating, statistics, each, alarms, longer,
        )  # fmt: skip

    def _look_all(
        self, transient: Transient, steps: Transitions, z: Array, lower: Array, upper: Array
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
        """`frozen`, `thawed` and `repeating` of `Verdicts`, by the watch of `judge`, where some state repeats."""
        count, n = lower.shape
        frozen, repeating = np.zeros((count, n), dtype=bool), np.zeros((count, n), dtype=bool)
        thawed = np.zeros(count, dtype=bool)
        watch = self._watch()
        if watch is None:
            return frozen, thawed, repeating
        repeats = np.asarray((steps.x == steps.x_next).any(axis=1))
        after = np.concatenate([[False], repeats[:-1] & (np.diff(steps.k) == 1)]) if len(repeats) else repeats
        rows = np.flatnonzero(repeats | after)  # what follows a repeat may thaw
        own = self.model.own_rates(z[:, rows]).T
        at = steps.k[rows] + 1
        taken = (steps.dt[rows], steps.x[rows], steps.x_next[rows], lower[at], upper[at], own)
        last, given = -1, list[list[float]]()

        def bounds() -> Bounds:
            lower, upper, own = given
            return lower, upper, own

        for k, t_ns, dt, x, x_next, *three in zip(
            at.tolist(), transient.t_ns[at].tolist(), *(a.tolist() for a in taken), strict=True
        ):
            if k != last + 1:
                watch.forget()
            last, given = k, three
            looked = watch.look(t_ns, dt, x, x_next, bounds)
            thawed[k] = looked.thawed
            for moved in looked.frozen:
                frozen[k, moved.state] = True
            for moved in looked.repeating:
                repeating[k, moved.state] = True
        return frozen, thawed, repeating

    def _judge_all(self, z: Array, dt: Array, x_next: Array) -> tuple[Array, Array, Array, Array, Array]:
        """flags, lower, upper, utilisation, residual of transitions [x; u; s] (n + m + q, K), (K,), (K, n)."""
        columns = np.empty((self.model.n, len(dt))), np.empty((self.model.n, len(dt)))
        self.model.columns_centre_and_half(z, dt, *columns)
        centre, half = (a.T for a in columns)
        lower, upper = lower_of(centre, half, self.rule.margin), upper_of(centre, half, self.rule.margin)
        flags = np.where(contained(lower, x_next, upper), 0.0, 1.0)
        residual = x_next - centre
        return flags, np.asarray(lower), np.asarray(upper), np.asarray(utilisation_of(residual, half)), residual
