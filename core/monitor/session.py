# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Session: one model on live messages, its reports for diagnostics, and the log of its changes; needs no rclpy."""

from __future__ import annotations

import math
import time
import traceback
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from uncertain_lti.base.text import plural, shortlist
from uncertain_lti.model.alarm_rule import CONTAINMENT
from uncertain_lti.model.domain import vouched
from uncertain_lti.model.repeats import Moved
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.deployed import Days, conditions_in_words
from uncertain_lti.monitor.deployed import Rule as Rule
from uncertain_lti.monitor.outputs import JUDGED
from uncertain_lti.monitor.reason import TOO_LARGE, why_not
from uncertain_lti.monitor.stream import FUTURE, SHOWN, Period, Stream
from uncertain_lti.monitor.stream import topic_types as topic_types
from uncertain_lti.monitor.verdict import Verdict
from uncertain_lti.recordings.message_reader import UnreadableError
from uncertain_lti.sampling.clock import LATE, MISSING, TOO_OLD, Counters, Status
from uncertain_lti.signals.field_path import FieldPath
from uncertain_lti.signals.signal import Signal

_BURST, _REFILL = 6, 10.0  # lines on one subject at once, and s until one more is allowed
_PAUSES, _CEASED = 20, 20  # pauses that tell a steady topic, and times the longest that it has ceased after
_LOGGED = 5.0  # s between two log entries on unexpected errors
OK, WARN, ERROR, STALE = 0, 1, 2, 3
"""Levels of diagnostic_msgs/DiagnosticStatus."""


@dataclass(frozen=True)
class Report:
    """One diagnostic status.

    `level`: OK, WARN, ERROR or STALE; `name`: `monitor`, or the state; `message`: A sentence; `values`: texts by name,
    numbers among them as `repr` writes them.
    """

    level: int
    name: str
    message: str
    values: Mapping[str, str]


class Session(Stream):
    """A stream that reports on itself, in the words and levels of diagnostics; takes what `Stream` takes."""

    def __init__(self, model: UncertainLTI, *args: Any, **kwargs: Any) -> None:
        super().__init__(model, *args, **kwargs)
        self.days = Days(model)
        self._vouched = vouched(model)
        self._steady: dict[str, tuple[float, float, int]] = {}  # of topics: heard, longest pause before, pauses
        self._at_verdict = Counter(self.sampler.counters), Counter(self.unreadable)

    def report(self, now: float, state_timeout: float, problems: Sequence[str] = ()) -> list[Report]:
        """Statuses of the monitor and of each state since the last call."""
        period = self.pass_over()
        if period.verdicts and self.last is not None and not period.alarm:
            self.days.take(self.last.t_ns, period.largest)
        monitor = self._report_monitor(period, now, state_timeout, problems)
        states = range(self.model.n)
        return [monitor, *(self._report_state(i, period, self.without_verdict(now), state_timeout) for i in states)]

    def _report_monitor(self, period: Period, now: float, timeout: float, problems: Sequence[str]) -> Report:
        without, never = self.without_verdict(now), self._unheard()
        complaints, calm = list(problems), list[str]()
        for some, quiet in (self._judged_in(period), self._taken_in(period, now, timeout)):
            complaints += some
            calm += quiet
        if self.monitor.masked:
            calm.append(f"masked: {', '.join(self.monitor.masked)}")
        if self.latched and not self.monitor.alarm:
            complaints.insert(0, "alarm: latched until ~/reset")
        calm += self.days.words
        silent, frozen = self.silent_for(now), [self.frozen_text(moved) for moved in period.frozen.values()]
        if frozen and self.monitor.alarm and silent <= timeout:
            level = ERROR
            complaints.insert(0, f"alarm: frozen: {'; '.join(frozen)}")
        elif without > timeout or not self.verdicts:
            level = ERROR if self.latched else STALE
            if self.monitor.alarm:
                complaints.insert(0, "alarm: it was on at the last verdict")
            if silent > timeout and self.heard(self.sampler.clock) is not None:
                complaints.insert(0, f"no message on {self.sampler.clock} for {silent:.1f} s")
                complaints += [why for why in self.absent(self.model.signals) if why not in complaints]
            else:
                complaints.insert(0, f"no verdict for {without:.1f} s" if self.verdicts else "no verdict yet")
            complaints[1:1] = never
        elif period.alarm:
            level = ERROR
            if self.monitor.alarm or not self.latched:
                complaints.insert(0, f"alarm: {self.reasons.by or self.rule_text()}")
            if (like := self.explainer.likeness()) is not None and like.words:
                complaints.insert(1, like.words)
        else:
            level = WARN if complaints else OK
        well = f"{period.verdicts} verdicts" if period.verdicts else f"last verdict {without:.1f} s ago"
        message = "; ".join([*(complaints or [f"{well}, all well"]), *calm])
        return Report(level, "monitor", message, self.counts(now))

    def _judged_in(self, period: Period) -> tuple[list[str], list[str]]:
        """What there is to say of the verdicts of a period that is a warning, and what is none."""
        unknown = []
        if period.last_unknown is not None:
            why = self.model.why_unknown(period.last_unknown.before)
            unknown = [f"regime not fitted in {period.unknown} of {period.verdicts} verdicts: {why}"]
        outside = period.outside - period.unknown
        if not outside:
            return unknown, []
        text = f"outside the fitted domain in {outside} of {period.verdicts} verdicts"
        if where := period.last_outside and self.model.why_outside(period.last_outside.before):
            text += f": {where}"
        many = outside > self._vouched * period.verdicts
        return (unknown + [text], []) if many else (unknown, [text])

    def _taken_in(self, period: Period, now: float, timeout: float) -> tuple[list[str], list[str]]:
        """What there is to say of the messages of a period that is a warning, and what is none."""
        complaints, calm = list[str](), list[str]()
        lacking, came_late = self.lacking(period.counters), self.came_late(period.counters)
        for status in (Status.GAP, Status.RESET, Status.MISSING, Status.STEP, Status.MODE, Status.FROZEN):
            if count := period.statuses[status]:
                why = why_not(status, self.model)
                if status is Status.MODE and period.last_unlisted is not None:
                    why = self.model.why_unlisted(period.last_unlisted.before)
                if status is Status.MISSING:
                    names = shortlist([signal.name for signal in lacking], SHOWN)
                    why = f"{why} ({names})" if names else TOO_LARGE
                complaints.append(f"{plural(count, 'sample')} without a verdict: {why}")
        complaints += self.absent(lacking)
        complaints += self.ceased(now, timeout).values()
        if dropped := Counter({status.value: n for status, n in period.statuses.items() if status.dropped}):
            which = ", ".join(f"{kind} {n}" for kind, n in dropped.items())
            coarse = self.coarse_clock(period.statuses[Status.EQUAL])
            complaints.append(f"{plural(dropped.total(), 'message')} dropped ({which}){coarse}")
        if came_late:
            complaints.append(f"{plural(came_late, 'message')} came too late")
        if period.unreadable:
            complaints += [f"{topic}: a message {why}" for topic, why in self.why_unreadable.items()]
        if period.future:
            complaints.append(f"{period.future} stamps lie over {FUTURE:g} s in the future")
        if off := self.arming.why_off():
            (complaints if self.arming.on is None else calm).append(off)
        complaints += [jump for jump in period.jumps[:SHOWN] if jump not in self.reasons.by]
        return complaints, calm

    def reason(self, now: float, timeout: float) -> str:
        """What holds the alarm, or why there is no verdict, as published on ~/reason."""
        text = self.reasons.text
        if self.judging(now, timeout) or self.without_verdict(now) <= timeout or "no verdict:" in text:
            return text
        said = f"no verdict for more than {timeout:g} s: {self.why_none(now, timeout) or 'no sample could be judged'}"
        return f"{text}; {said}" if self.alarm else said

    def judging(self, now: float, timeout: float) -> bool:
        """Whether verdicts come; what `why_none` has is counted from the last time that they did."""
        if judging := bool(self.verdicts) and self.without_verdict(now) <= timeout:
            self._at_verdict = Counter(self.sampler.counters), Counter(self.unreadable)
        return judging

    def why_none(self, now: float, timeout: float) -> str:
        """Why there are no verdicts, without numbers that change from one call to the next; or nothing."""
        counters, unreadable = self._at_verdict
        found, clock = self._unheard(), self.sampler.clock
        if self.heard(clock) is not None and self.silent_for(now) > timeout / 2:
            return "; ".join([f"no message on {clock}", *found, *self.absent(self.model.signals)])
        since = self.sampler.counters - counters
        if lacking := self.lacking(counters):
            found.append(f"{shortlist([signal.name for signal in lacking])} missing, stale or not finite")
            found += self.absent(lacking)
        counted = {Status.GAP: "gaps", Status.RESET: "resets"}
        kinds = Status.GAP, Status.RESET, Status.STEP, Status.MODE, Status.FROZEN
        found += [why_not(kind, self.model) for kind in kinds if since[counted.get(kind, kind.value)]]
        dropped = [status.value for status in Status if status.dropped and since[status.value]]
        if dropped:
            coarse = self.coarse_clock(since[Status.EQUAL.value], since[Status.UNSTAMPED.value])
            found.append(f"messages on {clock} are dropped ({', '.join(dropped)}){coarse}")
        found += [f"{topic}: a message {self.why_unreadable[topic]}" for topic in sorted(self.unreadable - unreadable)]
        found = found or self.absent(self.model.signals)
        return "; ".join(found or ["messages wait to be put in order"] * (self._catches_up is not None))

    def _unheard(self) -> list[str]:
        """Topics of which nothing has come since the start, in words."""
        never = [topic for topic in self.types if self.heard(topic) is None]
        return [f"nothing received on {shortlist(never)}"] * bool(never)

    def ceased(self, now: float, timeout: float) -> dict[str, str]:
        """Topics that came steadily and do no more, while their last values count for ever, and what is said of them.

        Each call looks whether they have come since the one before, so it must be called often.
        """
        found = {}
        for topic in self.types:
            heard = self.heard(topic)
            if heard is None or topic == self.sampler.clock or math.isfinite(self.held(topic)):
                continue
            before, longest, count = self._steady.get(topic, (heard, 0.0, 0))
            if heard > before:
                usual = count < _PAUSES or heard - before <= _CEASED * longest
                longest, count = max(longest, heard - before) if usual else longest, count + 1
            self._steady[topic] = heard, longest, count
            if count >= _PAUSES and now - heard > max(timeout, _CEASED * longest):
                every = f"at least every {longest:.2g} s before"
                found[topic] = f"no message on {topic} for {now - heard:.0f} s, and {every}; its last values count on"
        return found

    def why_no_condition(self) -> str:
        """Why the last message of the enable condition's topic says nothing on it, in words; empty if it does."""
        condition, data = self.arming.condition, self._newest.get(self.enable_topic)
        if condition is None or data is None:
            return ""
        try:
            reader = self._condition_reader(condition, self.enable_type)
            (value,) = reader.read(data)[1]
        except UnreadableError as error:
            return f"{condition.topic}: a message {error}"
        if value == value:
            return ""
        absent = condition.field.absent(reader.decode(data))
        return f"{condition.topic} comes without a number in {condition.field.text}" + f": {absent}" * bool(absent)

    def frozen_text(self, moved: Moved) -> str:
        """What is said of a frozen state."""
        return f"{self.model.state_names[moved.state]} {moved.words}"

    def lacking(self, before: Counter[str]) -> list[Signal]:
        """Signals that samples had no value of since some counters."""
        since = Counters(self.sampler.counters - before)
        lacking = since.of(MISSING) | since.of(TOO_OLD)
        return [signal for signal in self.model.signals if signal.name in lacking]

    def came_late(self, before: Counter[str]) -> int:
        """Messages that came after their sample was closed, since some counters."""
        return sum(Counters(self.sampler.counters - before).of(LATE).values())

    def absent(self, lacking: Iterable[Signal]) -> list[str]:
        """What the last message of each topic has not of what is read from it, the first of these signals in words."""
        found: dict[str, str] = {}
        for signal in lacking:
            data, reader = self._newest.get(signal.topic), self._readers[signal.topic]
            with suppress(UnreadableError):
                if data is not None and not found.get(signal.topic) and any(v != v for v in reader.read(data)[1]):
                    found[signal.topic] = FieldPath(signal.field).absent(reader.decode(data))
        return [f"{topic}: {why}" for topic, why in found.items() if why]

    def coarse_clock(self, equal: int, none: int = 0) -> str:
        """What to do about equal times of receipt by a simulated clock, or before it has any; empty of stamps."""
        if not equal + none or self.model.signals.time.get(self.sampler.clock) != "log":
            return ""
        often = "/clock moves more seldom than they come; play with --clock, or by ros2 bag with --clock-topics-all"
        return f": {often if equal else 'no time has come on /clock; start what publishes it'}"

    def rule_text(self) -> str:
        """The rules of the alarm in words."""
        return ", or ".join(self.reasons.words.values())

    def whole_rule_text(self) -> str:
        """The alarm rule in words, with everything that it depends on."""
        rule = self.rule
        parts = [f"alarm when {self.rule_text()}", f"margin {self.monitor.rule.margin:g}"]
        parts += conditions_in_words(self.monitor, self.arming.condition, rule.grace, rule.latch)
        return ", ".join(parts)

    def _report_state(self, i: int, period: Period, without: float, timeout: float) -> Report:
        name = self.model.state_names[i]
        masked, violated = name in self.monitor.masked, period.violations[i]
        values = {"verdicts": str(self.verdicts), "violations": str(self.violations[i]), "masked": str(int(masked))}
        if self.last is not None:
            of_states = [output for output in JUDGED if output.of == "states"]
            values |= {output.name: repr(self.last.numbers(output.position)[i]) for output in of_states}
            if not period.verdicts:  # the clock is slower than the reports
                violated = int(self.last.numbers("flags")[i] == 1.0)
        if i in period.frozen:
            level, message = ERROR, f"frozen: {period.frozen[i].words}"
        elif without > timeout:
            level, message = STALE, f"no verdict for {without:.1f} s" if self.verdicts else "no verdict yet"
        elif (lost := period.withheld[i]) and lost >= period.verdicts:
            level, message = WARN, "no verdict: it needs a state that is frozen"
        elif self.last is None:
            level, message = STALE, "no verdict yet"
        else:
            level = OK if masked or not violated else ERROR if period.alarm else WARN
            where, some = ("outside its bounds", f"{violated} of ") if violated else ("within its bounds", "")
            message = f"{where} in {some}{period.verdicts} verdicts"
            message = message if period.verdicts else f"last verdict {without:.1f} s ago: {where}"
        if i in period.repeating and i not in period.frozen:
            level, message = max(level, WARN), f"{message}; {period.repeating[i].words}"
        return Report(level, name, f"{message} (masked)" if masked else message, values)

    def counts(self, now: float) -> dict[str, str]:
        """Counters by name: what was received, judged, dropped, late and missing, and how old each topic is.

        Of each statistic of the alarm also the value of the state that is nearest to its threshold, and both.
        """
        counters = self.sampler.counters
        rule = self.monitor.rule
        counts = {
            "alarm": str(int(self.alarm)),
            "latched": str(int(self.latched)),
            "armed": {True: "1", False: "0", None: "unknown"}[self.arming.on],
            "alarms": str(self.alarms),
            "verdicts": str(self.verdicts),
            "rule violations": repr(rule.violations),
            "rule window": repr(rule.window),
            "rule margin": repr(rule.margin),
            "late messages": str(self.late),
            "put in order": str(self.reordered),
            "dropped": str(sum(counters[status.value] for status in Status if status.dropped)),
        }
        if self.last is not None:
            for label, nearest in self.monitor.alarms.nearest(self.last.statistics.tolist()).items():
                counts[label], counts[f"{label} threshold"] = repr(nearest.value), repr(nearest.threshold)
                counts[f"{label} state"] = nearest.state
        counts |= {name: str(counters[name]) for name in ("samples", "gaps", "resets", "missing")}
        for name, count in sorted(counters.items()):
            counts.setdefault(name, str(count))
        lags = self.lags
        for topic in self.types:
            counts[f"received {topic}"] = str(self.received.get(topic, 0))
            for name, counted in (("unreadable", self.unreadable), ("future", self.future)):
                if counted[topic]:
                    counts[f"{name} {topic}"] = str(counted[topic])
            if topic in lags:
                counts[f"lag {topic}"] = repr(round(lags[topic], 6))
            if (heard := self.heard(topic)) is not None:
                counts[f"age {topic}"] = repr(round(now - heard, 3))
        return counts


class _Matter:
    """Something that changes, and its value in the last line logged."""

    def __init__(self, logged: Any = None) -> None:
        self.logged = logged
        self._lines, self._at = float(_BURST), -math.inf

    def may(self, now: float) -> bool:
        """Whether a line may be logged now; counts it."""
        self._lines = min(_BURST, self._lines + (now - self._at) / _REFILL)
        self._at = now
        if self._lines < 1.0:
            return False
        self._lines -= 1.0
        return True

    def becomes(self, value: Any, now: float) -> bool:
        """Whether this is new and may be logged; otherwise it stays new."""
        if value == self.logged or not self.may(now):
            return False
        self.logged = value
        return True


class EventLog:
    """Logs alarms with the states that left their bounds, verdicts that begin and cease, inputs that fall silent.

    `log`: takes a level of `session` (WARN for the alarm, OK for all else) and a line.
    """

    def __init__(self, log: Callable[[int, str], None]) -> None:
        self._log = log
        self._alarm, self._alarm_since = False, 0.0

    def begin(self, session: Session, now: float) -> None:
        """A session starts, with no sample."""
        self._alarm = self._named = session.alarm  # the latter: whether the start of this alarm was logged
        self._latest, self._unnamed = "", 0  # of alarms whose start was not: the line of the last one, their number
        self._lasted, self._judged = 0.0, False
        self._cause = ("", now)  # why there are no verdicts, and since when
        self._matters = defaultdict[str, _Matter](_Matter, arming=_Matter(True))

    def turned(self, session: Session, verdicts: Iterable[Verdict], now: float, why: str = "") -> None:
        """Log the alarm if it has changed: its start with the states that left their bounds, its end if the start was.

        Of many alarms some starts are left out; the next line, at most 10 s later, counts them and names the last.
        """
        if session.alarm == self._alarm:
            return
        self._alarm = session.alarm
        if session.alarm:
            frozen = next((v.frozen for v in verdicts if v.alarm and v.frozen), ())
            cause = next((v for v in verdicts if v.alarm and (v.violated or v.raised)), session.last)
            left = f": {_left(session, cause)}" if cause is not None and cause.violated else ""
            raised = () if cause is None else cause.raised
            by = [reason.words for reason in raised if reason.label != CONTAINMENT]
            by = by or list(dict.fromkeys(session.reasons.words[reason.label] for reason in raised))
            line = f"alarm, {', '.join(by[:SHOWN]) if by else session.rule_text()}{left}"
            jumped = [] if cause is None else session.jumps_of(cause)
            line += f"; {', '.join(jumped[:SHOWN])}" if jumped else ""
            if frozen:
                line = f"alarm, frozen: {'; '.join(session.frozen_text(moved) for moved in frozen[:SHOWN])}"
            if late := session.came_late(session.period.counters):
                line += f"; {plural(late, 'message')} came too late just before"
            line += "; it lasts until ~/reset" if session.rule.latch else ""
            self._alarm_since = now
            self._named = self._matters["alarm"].may(now)
            if self._named:
                self._log(WARN, f"{line}{self._left_out(self._unnamed)}")
            else:
                self._latest, self._unnamed = line, self._unnamed + 1
        elif self._named:
            self._log(OK, f"the alarm is over after {now - self._alarm_since:.3g} s{why}")

    def _left_out(self, number: int) -> str:
        """How many alarms no line names."""
        self._unnamed = 0
        return f" ({plural(number, 'alarm')} before it {'is' if number == 1 else 'are'} not logged)" if number else ""

    def _catch_up(self, now: float) -> None:
        """Name the last of the alarms that were left out, as soon as a line may be logged."""
        if self._unnamed and self._matters["alarm"].may(now):
            over = "" if self._alarm else "; it is over"
            self._log(WARN, f"{self._latest}{over}{self._left_out(self._unnamed - 1)}")
            self._named = self._alarm

    def look(
        self, session: Session, now: float, timeout: float, publishers: Mapping[str, int], problems: Sequence[str]
    ) -> None:
        """Log what has changed since the last call."""
        self.turned(session, (), now)
        self._catch_up(now)
        if session.monitor.alarm and self._named:
            like = session.explainer.likeness()
            if like and like.words and self._matters["likeness"].becomes((self._alarm_since, like.label), now):
                self._log(OK, f"the alarm {like.words}")
        known, clock, lags = self._matters["problems"].logged or (), session.sampler.clock, session.lags
        condition = session.arming.condition or "there is no condition any more"
        way = {topic: "lag" if s > 0.0 else "lead" for topic, s in lags.items()}
        lag = [f"stamps on {t} {way[t]} those on {clock} by {abs(s):.3g} s, more than a step" for t, s in lags.items()]
        resets = session.sampler.counters["resets"]
        if session.reasons.rivals:  # then it is their stamps that step back
            self._matters["resets"].logged = resets
        for name, value, lines in (
            ("resets", resets, [f"time steps back on {clock}: a new segment begins"] * bool(resets)),
            ("problems", tuple(problems) or None, [problem for problem in problems if problem not in known][:SHOWN]),
            ("arming", session.arming.on, [session.arming.why_off() or f"alarms count from now on: {condition}"]),
            ("drift", session.days.words, session.days.words),
            ("catching up", (session.reordered, session.caught_up), [session.caught_up] * bool(session.caught_up)),
            ("lags", tuple(lags), lag),
        ):
            if (lines or name == "problems") and self._matters[name].becomes(value, now):
                for line in lines:
                    self._log(OK, line)
        ceased, alike = session.ceased(now, timeout), dict[str, list[str]]()
        for topic in session.types:
            if topic != clock:
                said = self._of_topic(session, topic, now, timeout, publishers.get(topic, 0), ceased.get(topic, ""))
                alike.setdefault(said, []).append(topic)
        for said in filter(None, alike):
            self._log(OK, said.replace("{topics}", shortlist(alike[said])))
        self._look_at_verdicts(session, now, timeout)

    def _of_topic(self, session: Session, topic: str, now: float, timeout: float, publishers: int, ceased: str) -> str:
        heard = session.heard(topic)
        if heard is None:
            return ""  # the line on verdicts has it
        held, age = session.held(topic), now - heard
        gone = age > timeout and math.isinf(held) and not publishers
        silent = age > max(timeout, held) or gone or bool(ceased)
        lacks = f"no message on {{topics}} for {age:.1f} s{' and no publisher any more' * gone}"
        said = (lacks if gone else ceased or lacks) if silent else "messages on {topics} again"
        return said if self._matters[f"silence {topic}"].becomes(silent or None, now) else ""

    def _look_at_verdicts(self, session: Session, now: float, timeout: float) -> None:
        without, matter = session.without_verdict(now), self._matters["verdicts"]
        if session.judging(now, timeout):
            if matter.becomes("", now):
                masked = f"; masked: {', '.join(session.monitor.masked)}" if session.monitor.masked else ""
                first = f"judging {shortlist(session.model.state_names)}; alarm when {session.rule_text()}{masked}"
                again = f"judging again, after {self._lasted:.1f} s without a verdict"
                self._log(OK, again if self._judged else first)
                self._judged = True
        elif without > timeout:
            self._lasted = without
            why = session.why_none(now, timeout) or matter.logged or "no two samples have come one after the other"
            if why != self._cause[0]:
                self._cause = (why, now)
            # another cause than the one logged may be that of the moment in which messages arrive again
            lasting = not matter.logged or now - self._cause[1] >= timeout
            if lasting and matter.becomes(why, now):
                self._log(OK, f"no verdict {f'for {without:.1f} s' if session.verdicts else 'yet'}: {why}")


def _digits(value: float, by: float) -> int:
    """Digits of a value that show a difference."""
    ratio = abs(value / by) if by else math.inf
    return min(max(7, math.ceil(math.log10(ratio)) + 2), 17) if 1.0 < ratio < math.inf else 7


def _left(session: Session, verdict: Verdict) -> str:
    """The states that left their bounds, and by how much."""
    numbers = (verdict.numbers(kind) for kind in ("flags", "state", "lower", "upper"))
    left = []
    for name, flag, value, lower, upper in zip(session.model.state_names, *numbers, strict=True):
        if flag == 1.0 and name not in session.monitor.masked:
            side, by = ("above", value - upper) if value > upper else ("below", lower - value)
            digits = _digits(value, by)
            left.append(
                f"{name} = {value:.{digits}g} is {float(f'{by:.3g}'):.7g} {side} its bounds "
                f"{lower:.{digits}g} to {upper:.{digits}g}"
            )
    more = len(left) - SHOWN
    return ", ".join(left[:SHOWN]) + (f", and {more} more" if more > 0 else "")


class Failures:
    """Unexpected errors: their number, and the last one.

    `log`: takes an entry for the log; `count`: errors so far.
    """

    def __init__(self, log: Callable[[str], None]) -> None:
        self._log = log
        self.count, self._last, self._reported = 0, "", 0
        self._logged: dict[str, float] = {}  # where: when

    def note(self, where: str, error: Exception) -> None:
        """Count an error, and log it unless one from the same place was logged just before."""
        self.count += 1
        self._last = f"{where}: {error!r}"[:300]
        now = time.monotonic()
        if now - self._logged.get(where, -_LOGGED) >= _LOGGED:
            self._logged[where] = now
            trace = "".join(traceback.format_exception(error))
            self._log(f"unexpected error {self.count}, {where}; the node goes on\n{trace}")

    def problems(self) -> list[str]:
        """What went wrong since the last report."""
        return [f"{plural(self.count, 'unexpected error')}, the last {self._last}"] * (self.count > self._reported)

    def reported(self) -> None:
        """The errors so far are in a report."""
        self._reported = self.count
