# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Event log of a session: each change is logged once, at a limited rate if it keeps changing."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from uncertain_lti.base.english import plural
from uncertain_lti.model.alarm_rule import CONTAINMENT
from uncertain_lti.monitor.reason import WHY
from uncertain_lti.monitor.session import OK, WARN, Session
from uncertain_lti.monitor.verdict import Verdict
from uncertain_lti.sampling.status import Status

_BURST, _REFILL = 6, 10.0  # lines on one subject at once, and s until one more is allowed
_SHOWN = 5  # states that one line names


class _Matter:
    """Something that changes, and its value in the last line logged."""

    def __init__(self, logged: Any) -> None:
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
        self._matters: dict[str, _Matter] = {}
        self._alarm, self._alarm_since = False, 0.0
        self._named = False  # whether the start of this alarm was logged
        self._latest, self._unnamed = "", 0  # of alarms whose start was not: the line of the last one, their number
        self._counters: Counter[str] = Counter()
        self._unreadable: Counter[str] = Counter()
        self._ceased, self._judged = 0.0, False
        self._cause = ("", 0.0)  # why there are no verdicts, and since when

    def begin(self, session: Session, now: float) -> None:
        """A session starts, with no sample."""
        self._alarm, self._named, self._latest, self._unnamed = session.alarm, session.alarm, "", 0
        self._counters, self._unreadable = Counter(session.sampler.counters), Counter(session.unreadable)
        self._ceased, self._judged = now, False
        self._cause = ("", now)
        self._matters.clear()

    def _matter(self, name: str) -> _Matter:
        if name not in self._matters:
            self._matters[name] = _Matter(True if name == "arming" else None)
        return self._matters[name]

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
            line = f"alarm, {', '.join(by[:_SHOWN]) if by else session.rule_text()}{left}"
            jumped = [] if cause is None else session.jumps_of(cause)
            line += f"; {', '.join(jumped[:_SHOWN])}" if jumped else ""
            if frozen:
                line = f"alarm, frozen: {'; '.join(session.frozen_text(moved) for moved in frozen[:_SHOWN])}"
            line += "; it lasts until ~/reset" if session.rule.latch else ""
            self._alarm_since = now
            self._named = self._matter("alarm").may(now)
            if self._named:
                self._log(WARN, f"{line}{self._left_out(self._unnamed)}")
            else:
                self._latest, self._unnamed = line, self._unnamed + 1
        elif self._named:
            self._log(OK, f"the alarm is over after {now - self._alarm_since:.3g} s{why}")
            self._named = False

    def _left_out(self, number: int) -> str:
        """How many alarms no line names."""
        self._unnamed = 0
        return f" ({plural(number, 'alarm')} before it {'is' if number == 1 else 'are'} not logged)" if number else ""

    def _catch_up(self, now: float) -> None:
        """Name the last of the alarms that were left out, as soon as a line may be logged."""
        if self._unnamed and self._matter("alarm").may(now):
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
            self._look_at_likeness(session, now)
        matter = self._matter("problems")
        new = [problem for problem in problems if problem not in (matter.logged or ())]
        if matter.becomes(tuple(problems) or None, now):
            for problem in new[:_SHOWN]:
                self._log(OK, problem)
        if self._matter("arming").becomes(session.arming.on, now):
            condition = session.arming.condition or "there is no condition any more"
            self._log(OK, session.arming.why_off() or f"alarms count from now on: {condition}")
        if session.caught_up and self._matter("catching up").becomes((session.reordered, session.caught_up), now):
            self._log(OK, session.caught_up)
        if (lags := session.lags) and self._matter("lags").becomes(tuple(lags), now):
            clock = session.sampler.clock
            for topic, lag in lags.items():
                self._log(OK, f"stamps on {topic} lag those on {clock} by {lag:.3g} s, more than a step")
        for topic in session.types:
            if topic != session.sampler.clock:
                self._look_at_topic(session, topic, now, timeout, publishers.get(topic, 0))
        self._look_at_verdicts(session, now, timeout)

    def _look_at_likeness(self, session: Session, now: float) -> None:
        """Log what the alarm looks like, once there are verdicts enough, and when another fault is named."""
        like = session.likeness()
        if like is not None and like.words and self._matter("likeness").becomes((self._alarm_since, like.label), now):
            self._log(OK, f"the alarm {like.words}")

    def _look_at_topic(self, session: Session, topic: str, now: float, timeout: float, publishers: int) -> None:
        heard = session.heard(topic)
        if heard is None:
            return  # the line on verdicts has it
        held = session.held(topic)
        age = now - heard
        silent = age > max(timeout, held) or (age > timeout and math.isinf(held) and not publishers)
        if self._matter(f"silence {topic}").becomes(silent or None, now):
            held_on = " and no publisher any more; its last values are held" if math.isinf(held) else ""
            self._log(OK, f"no message on {topic} for {age:.1f} s{held_on}" if silent else f"messages on {topic} again")

    def _look_at_verdicts(self, session: Session, now: float, timeout: float) -> None:
        without = session.without_verdict(now)
        matter = self._matter("verdicts")
        if session.verdicts and without <= timeout:
            if matter.becomes("", now):
                again = f"judging again, after {now - without - self._ceased:.1f} s without a verdict"
                self._log(OK, again if self._judged else self._judging(session))
                self._judged = True
            self._counters, self._unreadable = Counter(session.sampler.counters), Counter(session.unreadable)
            self._ceased = now - without
        elif without > timeout:
            why = self._why(session, now, timeout) or matter.logged or "no two samples have come one after the other"
            if why != self._cause[0]:
                self._cause = (why, now)
            # another cause than the one logged may be that of the moment in which messages arrive again
            lasting = not matter.logged or now - self._cause[1] >= timeout
            if lasting and matter.becomes(why, now):
                self._log(OK, f"no verdict {f'for {without:.1f} s' if session.verdicts else 'yet'}: {why}")

    def _judging(self, session: Session) -> str:
        text = f"judging {', '.join(session.model.state_names)}; alarm when {session.rule_text()}"
        return f"{text}; masked: {', '.join(session.monitor.masked)}" if session.monitor.masked else text

    def _why(self, session: Session, now: float, timeout: float) -> str:
        """Why there are no verdicts, without numbers that change from one call to the next; or nothing."""
        never = [topic for topic in session.types if session.heard(topic) is None]
        found = [f"nothing received on {', '.join(never)}"] if never else []
        clock = session.sampler.clock
        if clock not in never and session.silent_for(now) > timeout / 2:
            return "; ".join([f"no message on {clock}", *found])
        since = session.sampler.counters - self._counters
        if signals := session.lacking(self._counters):
            found.append(f"{', '.join(signals)} missing, stale or not finite")
        for status, name in (
            (Status.GAP, "gaps"),
            (Status.RESET, "resets"),
            (Status.STEP, Status.STEP.value),
            (Status.MODE, Status.MODE.value),
            (Status.FROZEN, Status.FROZEN.value),
        ):
            if since[name]:
                found.append(WHY[status])
        dropped = [status.value for status in Status if status.dropped and since[status.value]]
        if dropped:
            found.append(f"messages on {clock} are dropped ({', '.join(dropped)})")
        unreadable = session.unreadable - self._unreadable
        found += [f"{topic}: a message {session.why_unreadable[topic]}" for topic in sorted(unreadable)]
        return "; ".join(found)


def _digits(value: float, by: float) -> int:
    """Digits of a value that show a difference."""
    ratio = abs(value / by) if by else math.inf
    return min(max(7, math.ceil(math.log10(ratio)) + 2), 17) if 1.0 < ratio < math.inf else 7


def _left(session: Session, verdict: Verdict) -> str:
    """The states that left their bounds, and by how much."""
    numbers = zip(
        session.model.state_names, *(verdict.numbers(n) for n in ("flags", "state", "lower", "upper")), strict=True
    )
    left = []
    for name, flag, value, lower, upper in numbers:
        if flag == 1.0 and name not in session.monitor.masked:
            side, by = ("above", value - upper) if value > upper else ("below", lower - value)
            digits = _digits(value, by)
            left.append(
                f"{name} = {value:.{digits}g} is {float(f'{by:.3g}'):.7g} {side} its bounds "
                f"{lower:.{digits}g} to {upper:.{digits}g}"
            )
    more = len(left) - _SHOWN
    return ", ".join(left[:_SHOWN]) + (f", and {more} more" if more > 0 else "")
