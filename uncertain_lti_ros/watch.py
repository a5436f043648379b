"""Watch: one model at work, messages in, verdicts and health out; everything of the live node that needs no rclpy."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.errors import ModelError
from uncertain_lti.model import UncertainLTI
from uncertain_lti.monitor import EnvelopeMonitor, Verdict
from uncertain_lti.sampler import Sampler, Status
from uncertain_lti.signals import FieldPath, TypeFields

Array = NDArray[np.float64]

OK, WARN, ERROR, STALE = 0, 1, 2, 3
"""Levels of diagnostic_msgs/DiagnosticStatus."""


@dataclass(frozen=True)
class Rule:
    """Alarm rule as the parameters give it; 0 stands for what the model says."""

    violations: int = 0
    window: int = 0
    margin: float = 0.0

    def monitor(self, model: UncertainLTI) -> EnvelopeMonitor:
        """Monitor of this model under this rule; raises ModelError where the two do not fit."""
        return EnvelopeMonitor(model, self.violations or None, self.window or None, self.margin or None)


@dataclass(frozen=True)
class Report:
    """One diagnostic status; values are texts, numbers among them as `repr` writes them."""

    level: int
    name: str
    message: str
    values: Mapping[str, str]


@dataclass
class _Period:
    """What has happened since the last report."""

    began: float
    verdicts: int = 0
    outside: int = 0
    alarm: bool = False
    violations: Counter[int] = field(default_factory=Counter)
    statuses: Counter[Status] = field(default_factory=Counter)
    late: int = 0


def topic_types(model: UncertainLTI, source: str, type_fields: TypeFields) -> dict[str, str]:
    """Message type of each topic that a model reads, with every field path held against it.

    Raises
    ------
    ModelError
        The model names no topics or types, or two types for one topic.
    SignalError
        A type is not installed, or a field is not in it.
    """
    types: dict[str, str] = {}
    for signal in model.signals.signals:
        if not (signal.topic and signal.type):
            raise ModelError(
                f"{source}: signal '{signal.name}' has no {'type' if signal.topic else 'topic'}, as the model was "
                f"fitted to arrays; fit it to a recording, so that topics and types are in the file"
            )
        if types.setdefault(signal.topic, signal.type) != signal.type:
            raise ModelError(
                f"{source}: {signal.topic} is given as {types[signal.topic]} and as {signal.type}; mend the file"
            )
    for topic, type_name in types.items():
        model.signals.check(topic, type_name, type_fields)
    return types


class Watch:
    """Samples and judges the messages of one model, and keeps count.

    Parameters
    ----------
    model : UncertainLTI
    rule : Rule
    types : mapping
        From `topic_types`.
    now : float
        A steady time in s, as everywhere below.

    Raises
    ------
    ModelError
        The rule does not fit.
    SignalError
        The model does not say how samples are cut.
    """

    def __init__(self, model: UncertainLTI, rule: Rule, types: Mapping[str, str], now: float) -> None:
        self.model, self.types = model, types
        self.monitor = rule.monitor(model)
        signals = model.signals
        self._read: dict[str, list[Callable[[Any], float]]] = {
            topic: [FieldPath(signals.signals[i].field).read for i in signals.on(topic)] for topic in signals.topics
        }
        self.restart(now)

    def restart(self, now: float) -> None:
        """Forget every message, verdict and count."""
        self.sampler = Sampler(self.model.signals)
        self.monitor.reset()
        self.unreadable: Counter[str] = Counter()
        self.received: Counter[str] = Counter()
        self.verdicts = self.alarms = 0
        self.violations = [0] * self.model.n
        self.last: Verdict | None = None
        self._heard: dict[str, float] = {}
        self._began, self._judged = now, -math.inf
        self._period = _Period(now)

    def follow(self, rule: Rule) -> None:
        """Judge by another alarm rule from now on; the alarm starts anew.

        Raises
        ------
        ModelError
            The rule does not fit; the old one stays.
        """
        self.monitor = rule.monitor(self.model)

    def take(
        self, topic: str, arrival_ns: int, stamp_ns: int | None, message: Any, now: float
    ) -> tuple[list[Verdict], bool]:
        """Take one message; return the clock messages it decided, and whether it opened a sample."""
        self.received[topic] += 1
        self._heard[topic] = now
        try:
            values = [read(message) for read in self._read[topic]]
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
            self.unreadable[topic] += 1  # the topic's type was checked, so this is a message that fills it oddly
            values = [math.nan] * len(self._read[topic])
        samples = self.sampler.counters["samples"]
        verdicts = []
        for step in self.sampler.push(topic, arrival_ns, stamp_ns, values):
            before = self.monitor.alarm
            verdict = self.monitor.judge(step)
            verdicts.append(verdict)
            self._count(verdict, before, now)
        return verdicts, self.sampler.counters["samples"] > samples

    def _count(self, verdict: Verdict, alarm_before: bool, now: float) -> None:
        period = self._period
        period.statuses[verdict.status] += 1
        self.alarms += verdict.alarm and not alarm_before
        period.alarm |= verdict.alarm
        if not verdict.judged:
            return
        self.last, self._judged = verdict, now
        self.verdicts += 1
        period.verdicts += 1
        period.outside += verdict.outside_domain
        for i in np.flatnonzero(verdict.flags == 1.0).tolist():
            self.violations[i] += 1
            period.violations[i] += 1

    def predict(self) -> tuple[int, Array, Array] | None:
        """(t_ns, lower (n,), upper (n,)) for one median step after the open sample, in recorded units.

        None where a signal is missing, or the model does not know its median step.
        """
        dt, latest = self.model.sampling.dt_median, self.sampler.latest()
        if dt is None or latest is None:
            return None
        t_ns, x, u = latest
        if not (np.isfinite(x).all() and np.isfinite(u).all()):
            return None
        lower, upper = self.monitor.predict(x, u, dt)
        return t_ns + round(dt * 1e9), lower, upper

    @property
    def late(self) -> int:
        """Messages that came after the sample they belonged to was closed."""
        return sum(count for name, count in self.sampler.counters.items() if name.startswith("late /"))

    def silent_for(self, now: float) -> float:
        """Seconds since the last message of the clock topic."""
        return now - self._heard.get(self.sampler.clock, self._began)

    def report(self, now: float, state_timeout: float, problems: Sequence[str] = ()) -> list[Report]:
        """Statuses of the monitor and of each state since the last call.

        A state without a verdict for state_timeout s is STALE, never contained. problems are what the outside has
        to say (publishers that cannot be heard, lost messages); they make the monitor's status at least WARN.
        """
        period, self._period = self._period, _Period(now)
        self._period.alarm = self.monitor.alarm
        self._period.late = self.late
        without = now - max(self._judged, self._began)
        reports = [self._report_monitor(period, now, without, state_timeout, problems)]
        for i, name in enumerate(self.model.state_names):
            reports.append(self._report_state(i, name, period, without, state_timeout))
        return reports

    def _report_monitor(
        self, period: _Period, now: float, without: float, timeout: float, problems: Sequence[str]
    ) -> Report:
        never = [topic for topic in self.types if topic not in self._heard]
        complaints = list(problems)
        if period.outside:
            complaints.append(f"outside the fitted domain in {period.outside} of {period.verdicts} verdicts")
        for status in (Status.GAP, Status.RESET, Status.MISSING):
            if period.statuses[status]:
                complaints.append(f"{period.statuses[status]} samples without a verdict: {_WHY[status]}")
        dropped = sum(count for status, count in period.statuses.items() if status.dropped)
        if dropped:
            which = ", ".join(f"{status.value} {count}" for status, count in period.statuses.items() if status.dropped)
            complaints.append(f"{dropped} messages dropped ({which})")
        if late := self.late - period.late:
            complaints.append(f"{late} messages came too late")
        if without > timeout:
            level = STALE
            silent = self.silent_for(now)
            if silent > timeout and self.sampler.clock in self._heard:
                complaints.insert(0, f"no message on {self.sampler.clock} for {silent:.1f} s")
            else:
                complaints.insert(0, f"no verdict for {without:.1f} s" if self.verdicts else "no verdict yet")
            if never:
                complaints.insert(1, f"nothing ever received on {', '.join(never)}")
        elif period.alarm:
            level = ERROR
            complaints.insert(0, f"alarm: {self._rule_text()}")
        else:
            level = WARN if complaints else OK
        message = "; ".join(complaints) or f"{period.verdicts} verdicts, all well"
        return Report(level, "monitor", message, self.counts(now))

    def _rule_text(self) -> str:
        rule = self.monitor.rule
        return f"at least {rule.violations} of {rule.window} verdicts violated"

    def _report_state(self, i: int, name: str, period: _Period, without: float, timeout: float) -> Report:
        values = {"verdicts": str(self.verdicts), "violations": str(self.violations[i])}
        violated = period.violations[i]
        if self.last is not None:
            for key in ("state", "lower", "upper", "utilisation"):
                values[key] = repr(float(getattr(self.last, key)[i]))
            if not period.verdicts:  # the clock is slower than the reports
                violated = int(self.last.flags[i] == 1.0)
        age = f"last verdict {without:.1f} s ago: "
        if without > timeout:
            level, message = STALE, f"no verdict for {without:.1f} s" if self.verdicts else "no verdict yet"
        elif violated:
            level = ERROR if period.alarm else WARN
            message = f"outside its bounds in {violated} of {period.verdicts} verdicts"
            message = message if period.verdicts else f"{age}outside its bounds"
        elif self.last is None:
            level, message = STALE, "no verdict yet"
        else:
            level, message = OK, f"{age}within its bounds"
            if period.verdicts:
                message = f"within its bounds in {period.verdicts} verdicts"
        return Report(level, name, message, values)

    def counts(self, now: float) -> dict[str, str]:
        """Counters by name: what was received, judged, dropped, late and missing, and how old each topic is."""
        counters = self.sampler.counters
        rule = self.monitor.rule
        counts = {
            "alarm": str(int(self.monitor.alarm)),
            "alarms": str(self.alarms),
            "verdicts": str(self.verdicts),
            "violations": repr(rule.violations),
            "window": repr(rule.window),
            "margin": repr(rule.margin),
            "late": str(self.late),
            "dropped": str(sum(counters[status.value] for status in Status if status.dropped)),
        }
        for name in ("samples", "gaps", "resets", "missing"):
            counts[name] = str(counters[name])
        for name, count in sorted(counters.items()):
            counts.setdefault(name, str(count))
        for topic in self.types:
            counts[f"received {topic}"] = str(self.received[topic])
            if self.unreadable[topic]:
                counts[f"unreadable {topic}"] = str(self.unreadable[topic])
            if topic in self._heard:
                counts[f"age {topic}"] = repr(round(now - self._heard[topic], 3))
        return counts


_WHY = {
    Status.GAP: "the step is longer than max_gap",
    Status.RESET: "time stepped back",
    Status.MISSING: "a signal is missing, stale or not finite",
}
