# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Session: one model on live messages; takes messages, returns verdicts and reports, and needs no rclpy."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from uncertain_lti.base.english import shortlist
from uncertain_lti.model.repeats import Moved
from uncertain_lti.monitor.deployed import condition_words
from uncertain_lti.monitor.frozen import frozen_words, repeat_words
from uncertain_lti.monitor.likeness import Likeness
from uncertain_lti.monitor.live_rule import Rule as Rule
from uncertain_lti.monitor.live_rule import listed_states as listed_states
from uncertain_lti.monitor.outputs import JUDGED
from uncertain_lti.monitor.reason import WHY
from uncertain_lti.monitor.stream import FUTURE, SHOWN, Period, Stream
from uncertain_lti.monitor.stream import topic_types as topic_types
from uncertain_lti.recordings.message_reader import UnreadableError
from uncertain_lti.sampling.counters import MISSING, TOO_OLD, Counters
from uncertain_lti.sampling.status import Status

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

    def report(self, now: float, state_timeout: float, problems: Sequence[str] = ()) -> list[Report]:
        """Statuses of the monitor and of each state since the last call."""
        period = self.pass_over(now)
        without = self.without_verdict(now)
        reports = [self._report_monitor(period, now, without, state_timeout, problems)]
        for i, name in enumerate(self.model.state_names):
            reports.append(self._report_state(i, name, period, without, state_timeout))
        return reports

    def _report_monitor(
        self, period: Period, now: float, without: float, timeout: float, problems: Sequence[str]
    ) -> Report:
        never = [topic for topic in self.types if self.heard(topic) is None]
        complaints, calm = list(problems), list[str]()
        if period.last_unknown is not None:
            why = self.model.why_unknown(period.last_unknown.before)
            complaints.append(f"regime not fitted in {period.unknown} of {period.verdicts} verdicts: {why}")
        if outside := period.outside - period.unknown:
            complaints.append(f"outside the fitted domain in {outside} of {period.verdicts} verdicts")
        for status in (Status.GAP, Status.RESET, Status.MISSING, Status.STEP, Status.MODE, Status.FROZEN):
            if period.statuses[status]:
                which = ""
                if status is Status.MISSING:
                    which = f" ({shortlist(self.lacking(period.counters), SHOWN)})"
                why = WHY[status]
                if status is Status.MODE and period.last_unlisted is not None:
                    why = self.model.why_unlisted(period.last_unlisted.before)
                complaints.append(f"{period.statuses[status]} samples without a verdict: {why}{which}")
        dropped = sum(count for status, count in period.statuses.items() if status.dropped)
        if dropped:
            which = ", ".join(f"{status.value} {count}" for status, count in period.statuses.items() if status.dropped)
            complaints.append(f"{dropped} messages dropped ({which})")
        if late := self.late - period.late:
            complaints.append(f"{late} messages came too late")
        if self.unreadable.total() > period.unreadable:
            complaints += [f"{topic}: a message {why}" for topic, why in self.why_unreadable.items()]
        if self.future.total() > period.future:
            complaints.append(f"{self.future.total() - period.future} stamps lie over {FUTURE:g} s in the future")
        if off := self.arming.why_off():
            (complaints if self.arming.on is None else calm).append(off)
        complaints += [jump for jump in period.jumps[:SHOWN] if jump not in self.reasons.by]
        if self.monitor.masked:
            calm.append(f"masked: {', '.join(self.monitor.masked)}")
        if self.latched and not self.monitor.alarm:
            complaints.insert(0, "alarm: latched until ~/reset")
        silent = self.silent_for(now)
        frozen = [self.frozen_text(moved) for moved in period.frozen.values()]
        if frozen and self.monitor.alarm and silent <= timeout:
            level = ERROR
            complaints.insert(0, f"alarm: frozen: {'; '.join(frozen)}")
        elif without > timeout or not self.verdicts:
            level = ERROR if self.latched else STALE
            if self.monitor.alarm:
                complaints.insert(0, "alarm: it was on at the last verdict")
            if silent > timeout and self.heard(self.sampler.clock) is not None:
                complaints.insert(0, f"no message on {self.sampler.clock} for {silent:.1f} s")
            else:
                complaints.insert(0, f"no verdict for {without:.1f} s" if self.verdicts else "no verdict yet")
            if never:
                complaints.insert(1, f"nothing ever received on {', '.join(never)}")
        elif period.alarm:
            level = ERROR
            if self.monitor.alarm or not self.latched:
                complaints.insert(0, f"alarm: {self.reasons.by or self.rule_text()}")
            if (like := self.likeness()) is not None and like.words:
                complaints.insert(1, like.words)
        else:
            level = WARN if complaints else OK
        well = f"{period.verdicts} verdicts" if period.verdicts else f"last verdict {without:.1f} s ago"
        message = "; ".join([*(complaints or [f"{well}, all well"]), *calm])
        return Report(level, "monitor", message, self.counts(now))

    def reason(self, now: float, timeout: float) -> str:
        """What holds the alarm, or why there is no verdict, as published on ~/reason."""
        text = self.reasons.text
        if self.without_verdict(now) <= timeout or "no verdict:" in text:
            return text
        silent = self.silent_for(now) > timeout
        why = f"no message on {self.sampler.clock}" if silent else "no sample could be judged"
        said = f"no verdict for more than {timeout:g} s: {why}"
        return f"{text}; {said}" if self.alarm else said

    def why_no_condition(self, data: bytes) -> str:
        """Why a message of the enable condition's topic says nothing on it, in words; empty if it does."""
        condition = self.arming.condition
        assert condition is not None
        try:
            (value,) = self._condition_reader(condition, self.enable_type).read(data)[1]
        except UnreadableError as error:
            return f"{condition.topic}: a message {error}"
        return "" if value == value else f"{condition.topic} comes without a number in {condition.field.text}"

    def likeness(self) -> Likeness | None:
        """What the alarm that is on, or was on last, looks like."""
        return self.explainer.likeness()

    def frozen_text(self, moved: Moved) -> str:
        """What is said of a frozen state."""
        assert self.model.repeats is not None
        return frozen_words(self.model.state_names[moved.state], moved, self.model.repeats)

    def lacking(self, before: Counter[str]) -> list[str]:
        """Signals that samples had no value of since some counters."""
        since = Counters(self.sampler.counters - before)
        lacking = since.of(MISSING) | since.of(TOO_OLD)
        return [signal.name for signal in self.model.signals if signal.name in lacking]

    def rule_text(self) -> str:
        """The rules of the alarm in words."""
        return ", or ".join(rule.words for rule in self.monitor.alarms.rules)

    def whole_rule_text(self) -> str:
        """The alarm rule in words, with everything that it depends on."""
        rule = self.rule
        parts = [f"alarm when {self.rule_text()}", f"margin {self.monitor.rule.margin:g}"]
        parts += [f"masked: {', '.join(self.monitor.masked)}"] if self.monitor.masked else []
        parts += condition_words(self.arming.condition, rule.grace, rule.latch)
        return ", ".join(parts)

    def _report_state(self, i: int, name: str, period: Period, without: float, timeout: float) -> Report:
        values = {"verdicts": str(self.verdicts), "violations": str(self.violations[i])}
        masked = name in self.monitor.masked
        values["masked"] = str(int(masked))
        violated = period.violations[i]
        if self.last is not None:
            values |= {
                output.name: repr(self.last.numbers(output.position)[i]) for output in JUDGED if output.of == "states"
            }
            if not period.verdicts:  # the clock is slower than the reports
                violated = int(self.last.numbers("flags")[i] == 1.0)
        age = f"last verdict {without:.1f} s ago: "
        if i in period.frozen:
            level, message = ERROR, f"frozen: {self.frozen_text(period.frozen[i]).removeprefix(name).lstrip()}"
        elif without > timeout:
            level, message = STALE, f"no verdict for {without:.1f} s" if self.verdicts else "no verdict yet"
        elif (lost := period.withheld[i]) and lost >= period.verdicts:
            level, message = WARN, "no verdict: it needs a state that is frozen"
        elif violated:
            level = OK if masked else ERROR if period.alarm else WARN
            message = f"outside its bounds in {violated} of {period.verdicts} verdicts"
            message = message if period.verdicts else f"{age}outside its bounds"
        elif self.last is None:
            level, message = STALE, "no verdict yet"
        else:
            level, message = OK, f"{age}within its bounds"
            if period.verdicts:
                message = f"within its bounds in {period.verdicts} verdicts"
        if i in period.repeating and i not in period.frozen and self.model.repeats is not None:
            longest = self.model.repeats.longest_repeat_s[i]
            level, message = max(level, WARN), f"{message}; {repeat_words(period.repeating[i].seconds, longest)}"
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
            "unexpected errors": str(self.failures),
            "verdicts": str(self.verdicts),
            "violations": repr(rule.violations),
            "window": repr(rule.window),
            "margin": repr(rule.margin),
            "late messages": str(self.late),
            "put in order": str(self.reordered),
            "dropped": str(sum(counters[status.value] for status in Status if status.dropped)),
        }
        if self.last is not None:
            for label, nearest in self.monitor.alarms.nearest(self.last.statistics.tolist()).items():
                counts[label], counts[f"{label} threshold"] = repr(nearest.value), repr(nearest.threshold)
                counts[f"{label} state"] = nearest.state
        for name in ("samples", "gaps", "resets", "missing"):
            counts[name] = str(counters[name])
        for name, count in sorted(counters.items()):
            counts.setdefault(name, str(count))
        lags = self.lags
        for topic in self.types:
            counts[f"received {topic}"] = str(self.received[topic])
            if self.unreadable[topic]:
                counts[f"unreadable {topic}"] = str(self.unreadable[topic])
            if self.future[topic]:
                counts[f"future {topic}"] = str(self.future[topic])
            if topic in lags:
                counts[f"lag {topic}"] = repr(round(lags[topic], 6))
            if (heard := self.heard(topic)) is not None:
                counts[f"age {topic}"] = repr(round(now - heard, 3))
        return counts
