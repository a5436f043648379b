# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Stream: live messages of one model in, verdicts and counts out."""

from __future__ import annotations

import math
from array import array
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Any

import cython

from uncertain_lti.base.errors import ModelError
from uncertain_lti.model.domain import jumps_in_words
from uncertain_lti.model.repeats import Moved
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.alarm import Arming, Condition
from uncertain_lti.monitor.catch_up import STALL, WINDOW, CatchUp, Waiting
from uncertain_lti.monitor.deployed import Rule
from uncertain_lti.monitor.envelope_monitor import EnvelopeMonitor
from uncertain_lti.monitor.likeness import Explainer
from uncertain_lti.monitor.reason import QUIET, Reasons
from uncertain_lti.monitor.verdict import Foreseen, Verdict
from uncertain_lti.recordings.message_reader import MessageReader, UnreadableError
from uncertain_lti.sampling.clock import LATE, MISSING, Status, to_ns
from uncertain_lti.sampling.sampler import Sampler, all_finite
from uncertain_lti.signals.field_path import FieldPath, TypeFields

SHOWN = 5
"""Signals that a report names."""
FUTURE = 1.0
"""s that a stamp may be ahead of the clock before it is reported."""

_LOOKS, _MOST_LOOKS = 3, 50  # looks at the stamps of a topic by which its usual lag is known, and of the last ones
_OK = Status.OK  # looking up one of an enumeration is slow
_FUTURE_NS = to_ns(FUTURE)
_NOTHING: tuple[Verdict, ...] = ()


@dataclass
class Period:
    """What has happened since the last report.

    `counters`: of the sampler when it began; `alarm`: the alarm was raised at some time in it; `largest` (n,): largest
    |utilisation|; `unreadable, future`: messages that could not be read, or were stamped so; `verdicts`: verdicts
    given in it; `outside`: those from outside the fitted domain; `unknown`: of these those of a regime that was not
    fitted; `last_unknown`: the last of them; `last_outside`: the last of the others; `last_unlisted`: the last in it on
    a mode that the model does not list; `frozen, repeating`: by number of the state, the last repeat of those that were
    frozen, and of others that repeat for longer than ever in the fit; `withheld`: by number of the state, samples
    without a verdict on it as it needs a frozen one; `violations`: by number of the state; `jumps`: the first jumps
    larger than any of the fit, in words; `statuses`: of the samples in it.
    """

    counters: Counter[str]
    alarm: bool
    largest: array[float]
    unreadable: int = 0
    future: int = 0
    verdicts: int = 0
    outside: int = 0
    unknown: int = 0
    last_unknown: Verdict | None = None
    last_outside: Verdict | None = None
    last_unlisted: Verdict | None = None
    frozen: dict[int, Moved] = field(default_factory=dict)
    withheld: Counter[int] = field(default_factory=Counter)
    repeating: dict[int, Moved] = field(default_factory=dict)
    violations: Counter[int] = field(default_factory=Counter)
    jumps: list[str] = field(default_factory=list)
    statuses: Counter[Status] = field(default_factory=Counter)


def topic_types(model: UncertainLTI, source: str, type_fields: TypeFields) -> dict[str, str]:
    """Message type of each topic that a model reads, with every field path checked."""
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
        if topic not in model.signals.time:
            raise ModelError(f"{source}: sampling.time says nothing of {topic}; write header or log")
    return types


@cython.cclass
class Stream:
    """Samples and judges the messages of one model, and keeps count.

    `model`: fitted to a recording; `rule`: the alarm rule; `types`: from `topic_types`; `type_fields`: type name ->
    {field name: FieldType}; `make_reader`: type name and paths -> `MessageReader`; `now`: A steady time in s, as
    everywhere below; `arming`: of the session before: where the condition asks for the same field, what is known of
    that stays; `catch_up`: how long messages wait in `accept` at most, s; 0 for not at all; `latched`: an alarm has
    been raised that lasts until `reset`; `enable_topic`: topic of the enable condition; empty without one; `period`:
    what has happened since the last report; `reordered`: messages that were taken after one that came later;
    `caught_up`: what the last catching up came to, in words; empty as long as no message was put in order.
    """

    __dict__: dict[str, Any]  # what is not needed for every message; the others need no look-up
    model: UncertainLTI = cython.declare(object, visibility="public")
    rule: Rule = cython.declare(object, visibility="readonly")
    monitor: EnvelopeMonitor = cython.declare(object, visibility="readonly")
    sampler: Sampler = cython.declare(object, visibility="readonly")
    reasons: Reasons = cython.declare(object, visibility="readonly")
    arming: Arming = cython.declare(object, visibility="readonly")
    period: Period = cython.declare(object, visibility="readonly")
    received: dict[str, int] = cython.declare(dict, visibility="readonly")
    last: Verdict | None = cython.declare(object, visibility="readonly")
    latched: bool = cython.declare(cython.bint, visibility="public")
    enable_topic: str = cython.declare(object, visibility="readonly")
    verdicts: int = cython.declare(object, visibility="readonly")
    alarms: int = cython.declare(object, visibility="readonly")
    _readers: dict[str, MessageReader] = cython.declare(dict, visibility="readonly")
    _heard: dict[str, float]
    _newest: dict[str, bytes] = cython.declare(dict, visibility="readonly")  # the last message of each topic
    _stall: cython.double
    _judged: cython.double
    _came: cython.double
    _quiet: cython.Py_ssize_t  # verdicts without an alarm since the last one with
    _catches_up: Any = cython.declare(object, visibility="readonly")
    _reads_condition: Any

    def __init__(
        self,
        model: UncertainLTI,
        rule: Rule,
        types: Mapping[str, str],
        type_fields: TypeFields,
        make_reader: Callable[[str, Sequence[FieldPath]], MessageReader],
        now: float,
        arming: Arming | None = None,
        catch_up: float = WINDOW,
    ) -> None:
        self.model, self._model_types = model, types
        self._type_fields, self._make_reader = type_fields, make_reader
        signals = model.signals
        self._readers = {
            topic: make_reader(types[topic], [FieldPath(signals.signals[i].field) for i in signals.on(topic)])
            for topic in signals.topics
        }
        stamped = [topic for topic in signals.topics if signals.time[topic] == "header"]
        self._stamped = [topic for topic in stamped if topic != signals.clock]
        waits = signals.clock in stamped and bool(self._stamped) and catch_up > 0.0  # arrivals are in order as they are
        self._window, self._stall = catch_up, max(STALL, 5 * (model.sampling.dt_median or 0.0)) if waits else math.inf
        self.arming = arming if arming is not None else Arming(None, 0)
        self.latched, self.enable_topic, self.enable_type = False, "", ""
        self._newest: dict[str, bytes] = {}
        self._follow(rule)
        self.restart(now)

    def restart(self, now: float) -> None:
        """Forget every message, verdict and count; keep the last value of the enable condition."""
        self._start()
        self.unreadable: Counter[str] = Counter()
        self.why_unreadable: dict[str, str] = {}
        self.future: Counter[str] = Counter()
        self._strange: set[str] = set()  # topics with messages that name no signal
        self.received: dict[str, int] = {}  # setting an item of a Counter is slow
        self.verdicts = self.alarms = 0
        self.violations = [0] * self.model.n
        self.last: Verdict | None = None
        self._heard: dict[str, float] = {}
        self._began, self._judged, self._came = now, -math.inf, now
        self._behind: dict[str, deque[float]] = {}
        self._looked = 0, -math.inf  # the newest stamp at the last look, and when its message came
        awaited = [self.sampler.clock, *self._stamped]
        self._catches_up = CatchUp(awaited, self._window, start=True) if math.isfinite(self._stall) else None
        self.reordered, self.caught_up = 0, ""
        self.pass_over()

    def _start(self) -> None:
        self.sampler = Sampler(self.model.signals)
        self.reset()
        self.arming.restart()

    def follow(self, rule: Rule) -> None:
        """Judge by another alarm rule from now on.

        The alarm starts cleared, and one that is raised is latched if the rule asks for it. A rule equal to the
        present one changes nothing.
        """
        if rule != self.rule:
            raised = self.alarm
            self._follow(rule)
            self.latched = rule.latch and raised

    def _follow(self, rule: Rule) -> None:
        monitor, condition, enable_type, reader = self._prepared(rule)
        self.monitor, self.rule = monitor, rule
        self.explainer, self._quiet = Explainer(self.model), 0
        self.reasons = Reasons(self.model, monitor.alarms.rules)
        self.enable_type, self._reads_condition = enable_type, reader
        self.arming = Arming(condition, to_ns(rule.grace), self.arming.said_on(condition))
        self.enable_topic = condition.topic if condition else ""

    def go_on_from(self, other: Stream) -> None:
        """Keep what the previous session knows: the last values of topics that both read alike, and a latched alarm.

        States start over; controls would not arrive again if they are sent on a change only.
        """
        mine, theirs = self.model.signals, other.model.signals
        self._newest.update(other._newest)
        for topic in self.types:
            if topic in other._heard:
                self._heard[topic] = other._heard[topic]
        for topic in mine.topics:
            fields = {theirs.signals[i].field: k for k, i in enumerate(theirs.on(topic))}
            wanted = [mine.signals[i].field for i in mine.on(topic)]
            alike = other._model_types.get(topic) == self._model_types[topic] and set(wanted) <= set(fields)
            clocks = topic in (self.sampler.clock, other.sampler.clock)
            if clocks or not alike or theirs.time.get(topic) != mine.time[topic]:
                continue
            for stamp, arrival, values in other.sampler.kept(topic):
                self.sampler.push(topic, arrival, stamp or None, [values[fields[field]] for field in wanted])
        if all(topic in self._heard for topic in self._model_types):
            self._catches_up = None  # the stream is the same
        self._came = other._came
        if other.enable_type and not self.enable_type and other.arming.said_on(self.arming.condition) is not None:
            self.found_enable_type(other.enable_type)
        self.latched = self.rule.latch and other.alarm

    def check(self, rule: Rule) -> None:
        """Raise what `follow` would raise."""
        self._prepared(rule)

    def _prepared(self, rule: Rule) -> tuple[EnvelopeMonitor, Condition | None, str, MessageReader | None]:
        monitor = rule.monitor(self.model)
        condition = Condition.parse(rule.enable)
        enable_type, reader = "", None
        if condition is not None:
            found = self.enable_type if condition.topic == self.enable_topic else ""
            enable_type = rule.enable_type or self._model_types.get(condition.topic, found)
            if enable_type:
                reader = self._condition_reader(condition, enable_type)
        return monitor, condition, enable_type, reader

    def _condition_reader(self, condition: Condition, type_name: str) -> MessageReader:
        if self._model_types.get(condition.topic, type_name) != type_name:
            raise ModelError(
                f"parameter enable: {condition.topic} carries {self._model_types[condition.topic]} in the model, and "
                f"enable_type says {type_name}; leave enable_type empty"
            )
        condition.field.check(condition.topic, type_name, self._type_fields)
        return self._make_reader(type_name, [condition.field])

    def found_enable_type(self, type_name: str) -> None:
        """Take the type of the condition's topic from the graph."""
        assert self.arming.condition is not None
        self._reads_condition = self._condition_reader(self.arming.condition, type_name)
        self.enable_type = type_name
        self._newest.pop(self.enable_topic, None)  # it was of another type

    @property
    def types(self) -> dict[str, str]:
        """Topics to listen to with their types, as far as these are known."""
        types = dict(self._model_types)
        if self.enable_type:
            types[self.enable_topic] = self.enable_type
        return types

    @property
    def decoded(self) -> dict[str, int]:
        """Messages per topic that were decoded by the middleware, as they fitted no layout."""
        return {topic: reader.decoded for topic, reader in self._readers.items()}

    @property
    def alarm(self) -> bool:
        """The alarm, as published on ~/violation."""
        return self.latched or self.monitor.alarm

    def reset(self) -> None:
        """End a latched alarm, and forget the verdicts in its window."""
        self.monitor.reset()
        self.latched = False
        self.reasons.reset()

    def failed(self) -> None:
        """Start over after an unexpected error: what was half done must not be joined to what follows."""
        latched, counters = self.latched, self.sampler.counters
        self._start()
        self.latched, self.sampler.counters = latched, counters

    @property
    def lags(self) -> dict[str, float]:
        """Topics whose stamps lag those of the clock topic by more than a step, and by how much, s; negative: lead."""
        step = self.model.sampling.dt_median or math.inf
        lags = {topic: median(behind) for topic, behind in self._behind.items() if len(behind) >= _LOOKS}
        return {topic: lag for topic, lag in lags.items() if abs(lag) > step}

    def _look_at_lags(self) -> None:
        """Compare stamps; how fast they go by the steady clock, as where a recording is played, the last look tells."""
        latest, clock = self.sampler.latest(), self._heard.get(self.sampler.clock, 0.0)
        if latest is None or clock <= self._looked[1]:
            return
        before = self._looked[1]
        pace, self._looked = (latest[0] - self._looked[0]) / (clock - before), (latest[0], clock)
        if pace <= 0.0:  # the first look, or time has stepped back
            return
        for topic in self._stamped:
            kept = self.sampler.kept(topic)
            if kept and kept[-1][0] and self._heard[topic] > before:  # else the pace's error counts for all the time
                behind = self._behind.setdefault(topic, deque(maxlen=_MOST_LOOKS))
                behind.append((latest[0] - kept[-1][0] + pace * (self._heard[topic] - clock)) * 1e-9)

    def accept(
        self, topic: str, arrival_ns: int, data: bytes, now: float, sent_ns: int = 0, late: float = 0.0
    ) -> Sequence[Waiting]:
        """Receive one serialised message, and tell which messages are to be taken now.

        That is this message, except at the start and after a stall, when messages wait until topics have caught
        up with each other (`CatchUp`). Then `release` has to be called every now and then.

        `sent_ns`: when it was published, by the clock of its publisher; 0 if that is not known; `late`: s since then.
        """
        before, self._came = self._came, now
        self._newest[topic] = data
        if self._catches_up is None:
            if now - before <= self._stall:
                return ((topic, arrival_ns, data),)
            lately = [t for t in self._stamped if self._heard.get(t, -math.inf) >= before - self._stall]
            self._catches_up = CatchUp([self.sampler.clock, *lately], self._window, start=False)
        if topic in self._readers:
            self._heard[topic] = now
        self._catches_up.put((topic, arrival_ns, data), sent_ns, late, now)
        return self.release(now)

    def release(self, now: float, all_of_them: bool = False) -> Sequence[Waiting]:
        """Messages that need not wait any longer."""
        waits = self._catches_up
        if waits is None:
            if math.isfinite(self._stall):
                self._look_at_lags()
            return ()
        before = waits.reordered
        released = waits.finish(now) if all_of_them else waits.ready(now)
        self.reordered += waits.reordered - before
        if waits.over:
            self._catches_up = None
            if waits.reordered:
                self.caught_up = (
                    f"topics arrived one after another, up to {waits.late:.3g} s late; "
                    f"{waits.reordered} messages were put in order, for which verdicts waited {waits.took:.2f} s"
                )
        return released

    def take(self, topic: str, arrival_ns: int, data: bytes, now: float) -> tuple[Sequence[Verdict], bool]:
        """Take one serialised message."""
        self.received[topic] = self.received.get(topic, 0) + 1
        heard: cython.double = self._heard.get(topic, math.nan)
        self._heard[topic] = now
        if topic == self.enable_topic and self._reads_condition is not None:
            self._learn_condition(topic, data)
        reader = self._readers.get(topic)
        if reader is None:
            return _NOTHING, False
        try:
            stamp_ns, values = reader.read(data)
        except UnreadableError as error:
            self._note_unreadable(topic, error)
            return _NOTHING, False  # as in a recording: it is left out, and the values before it are kept
        if reader.strange:
            self._pass_over(topic, heard)
            return _NOTHING, False
        if stamp_ns is not None and 0 < arrival_ns < stamp_ns - _FUTURE_NS:  # 0: before the first tick of /clock
            self.future[topic] += 1
            self.period.future += 1
        sampler = self.sampler
        if topic != sampler.clock:
            sampler.push(topic, arrival_ns, stamp_ns, values)  # decides nothing
            return _NOTHING, False
        if not arrival_ns and self.model.signals.time[topic] == "log":  # as `record` leaves it out
            sampler.counters[Status.UNSTAMPED.value] += 1
            return _NOTHING, False
        samples = sampler.number
        verdicts = []
        for step in sampler.push(topic, arrival_ns, stamp_ns, values):
            before = self.alarm
            if self.monitor.starts_over(step):
                self.arming.restart(self.monitor.last_ns)
            # a dropped message is no sample and changes nothing; asking every status for that would cost more
            if step.status is _OK:
                armed = self.arming.at(step.t_ns)
            else:
                armed = step.status.dropped or self.arming.at(step.t_ns, self.monitor.steps_back(step))
            verdict = self.monitor.judge(step, armed)
            self.latched = self.latched or (self.rule.latch and verdict.alarm)
            verdicts.append(verdict)
            self._count(verdict, before, now)
        return verdicts, sampler.number > samples

    @cython.cfunc
    def _learn_condition(self, topic: str, data: bytes) -> None:
        assert self._reads_condition is not None
        try:
            (value,) = self._reads_condition.read(data)[1]
        except UnreadableError as error:
            if topic not in self._readers:
                self._note_unreadable(topic, error)
            return  # as in a recording: the value before it is kept
        if self._reads_condition.strange:
            return
        self.arming.learn(value)
        if not self.arming.on:
            self.monitor.reset()

    def know_rivals(self, topics: Iterable[str]) -> None:
        """Have messages of several publishers on these topics come by turns; those of states should be of one."""
        strange = self._strange
        rivals = [t for t in topics if t in self.received and t not in strange and not self.held(t)]
        said = "several publishers send by turns, and are taken for one; stop all but one"
        self.reasons.rivals = f"{', '.join(rivals)}: {said}" if rivals else ""

    @cython.cfunc
    def _pass_over(self, topic: str, heard: cython.double) -> None:
        """A message of another publisher, which names no signal of the model: as in a recording it does not count."""
        self._strange.add(topic)
        if self.verdicts and heard == heard:
            self._heard[topic] = heard
        else:  # there may be nobody who names them
            for i in self.model.signals.on(topic):
                self.sampler.counters.add(MISSING, self.model.signals[i].name)

    @cython.cfunc
    def _note_unreadable(self, topic: str, error: UnreadableError) -> None:
        self.unreadable[topic] += 1
        self.period.unreadable += 1
        self.why_unreadable[topic] = str(error)[:200]

    @cython.cfunc
    def _count(self, verdict: Verdict, alarm_before: cython.bint, now: cython.double) -> None:
        period = self.period
        judged: cython.bint = verdict.judged
        if judged:
            self.last, self._judged = verdict, now
            self.verdicts += 1
            period.verdicts += 1
            if not verdict.withheld:
                verdict.reach(period.largest)
        reasons = self.reasons
        if verdict.ordinary and not self.latched and reasons.text == QUIET and not reasons.rivals:
            self._quiet += 1
            return
        if verdict.status is not _OK:
            period.statuses[verdict.status] += 1
            if verdict.status in (Status.STEP, Status.MODE, Status.FROZEN):  # the sampler does not know the model
                self.sampler.counters[verdict.status.value] += 1
            if verdict.status is Status.MODE:
                period.last_unlisted = verdict
        elif verdict.withheld:
            self.sampler.counters[Status.FROZEN.value] += 1
        period.withheld.update(verdict.withheld)
        period.frozen.update({moved.state: moved for moved in verdict.frozen})
        period.repeating.update({moved.state: moved for moved in verdict.repeating})
        alarm: cython.bint = verdict.alarm or self.latched
        reasons.take(verdict, alarm)
        if alarm:
            period.alarm = True
            self.alarms += not alarm_before
        if not judged:
            return
        if verdict.alarm:
            table, outside = verdict.horizon_utilisation, verdict.outside_domain
            self.explainer.push(table, verdict.lower, verdict.upper, self._quiet, outside)
            self._quiet = 0
        else:
            self._quiet += 1
        period.outside += verdict.outside_domain
        if verdict.unknown_regime:
            period.unknown += 1
            period.last_unknown = verdict
        elif verdict.outside_domain:
            period.last_outside = verdict
        if verdict.violated:
            if len(period.jumps) < SHOWN:
                period.jumps.extend(self.jumps_of(verdict))
            for i, flag in enumerate(verdict.numbers("flags")):
                if flag == 1.0:
                    self.violations[i] += 1
                    period.violations[i] += 1

    def jumps_of(self, verdict: Verdict) -> list[str]:
        """What is said of states that left their bounds by a jump larger than any of the fit."""
        if not verdict.violated:
            return []
        flags = zip(self.model.state_names, verdict.numbers("flags"), strict=True)
        counted = [0.0 if name in self.monitor.masked else flag for name, flag in flags]
        return jumps_in_words(self.model, verdict.before, verdict.numbers("state"), counted)

    def predict(self) -> Verdict | None:
        """Bounds for one median step after the open sample, as `EnvelopeMonitor.expect` gives them.

        None where a signal is missing, or the model does not know its median step.
        """
        dt, latest = self.model.sampling.dt_median, self.sampler.latest()
        if dt is None or latest is None:
            return None
        t_ns, z = latest
        return self.monitor.expect(t_ns + round(dt * 1e9), z, dt) if all_finite(z) else None

    def foresee(self) -> Foreseen | None:
        """Bounds at the end of the longest horizon after the open sample, as `EnvelopeMonitor.foresee` gives them."""
        dt, latest = self.model.sampling.dt_median, self.sampler.latest()
        if dt is None or latest is None or not all_finite(latest[1]):
            return None
        return self.monitor.foresee(*latest, dt)

    @property
    def late(self) -> int:
        """Messages that arrived after their sample was closed."""
        return sum(self.sampler.counters.of(LATE).values())

    def heard(self, topic: str) -> float | None:
        """When the last message of a topic arrived."""
        return self._heard.get(topic)

    def held(self, topic: str) -> float:
        """How long all the last values of a topic may be used, s; for ever of that of the enable condition."""
        on = self.model.signals.on(topic)
        if any(i < self.model.n for i in on):
            return 0.0
        holds = [self.model.signals[i].max_hold for i in on]
        return min((math.inf if hold is None else hold for hold in holds), default=math.inf)

    def without_verdict(self, now: float) -> float:
        """Time since the last verdict, or since the start."""
        return now - max(self._judged, self._began)

    @property
    def between_verdicts(self) -> float:
        """Time from one to the next at most, s: a longer step has none."""
        sampling = self.model.sampling
        return 2.0 * (sampling.dt_max or sampling.dt_median or 0.0)

    def silent_for(self, now: float) -> float:
        """Time since the last message of the clock topic."""
        return now - self._heard.get(self.sampler.clock, self._began)

    def pass_over(self) -> Period:
        """Begin another period for `report`."""
        period = self.period
        self.period = Period(Counter(self.sampler.counters), self.alarm, array("d", bytes(8 * self.model.n)))
        return period
