# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""CatchUp: messages that wait, at the start and after a stall, until every topic has come as far as the others."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from statistics import median

from uncertain_lti.sampling.instants import to_ns

WINDOW = 4.0
"""s of steady time that messages wait at most: Fast DDS asks every 3 s for what a reliable reader has missed."""
STALL = 0.2
"""s without any message after which topics may arrive one after another."""
MOST = 20_000
"""Messages that wait at most."""

_QUIET = STALL  # s that messages wait at least: a longer pause counts as another stall
_BURST = 5  # stamps that advance this many times as fast as the steady time come in a burst
_LAG = 0.1  # s that stamps may lag more than they did before a stall, and nothing is held back any more
_PACE = 0.1  # stamps whose pace differs from that of the steady time by a larger share have no usual lag
_JUMP = 1.0  # s that the clock topic may advance beyond its pace between two looks, or its lags are of another time
_LAGS = 50  # looks, of which the usual lag is found
_PROMPT = 3  # messages one after the other that come at their pace show by how much a topic usually lags

Waiting = tuple[str, int, bytes]
"""Topic, arrival in ns, and data of one message."""


class _Progress:
    """How far the stamps of one topic have come."""

    def __init__(self) -> None:
        self._last: deque[tuple[float, int]] = deque(maxlen=10)  # steady time and stamp of the last that went on
        self.at = 0.0  # steady time of the last message, s
        self.newest = 0  # stamp, ns
        self.behind = 0  # ns, the last message behind the clock topic
        self.prompt: deque[int] = deque(maxlen=_LAGS)  # ns, the last messages behind the clock topic, none in a burst
        self.most_behind, self.least_behind = -(2**63), 2**63  # ns behind the clock topic, of messages in a burst
        self.first_behind = -(2**63)  # ns, the first message behind the clock topic

    def advance(self, stamp: int, now: float) -> int:
        """Take a stamp; the step from the greatest one before. One that is no greater is no progress."""
        step = stamp - self.newest if self.newest else 0
        self.at = now
        if stamp > self.newest:
            self.newest = stamp
            self._last.append((now, stamp))
        return step

    def in_burst(self, messages: int) -> bool:
        """Whether the last messages came much sooner one after the other than their steps are long."""
        if len(self._last) < 2:
            return False
        then, stamp = self._last[max(0, len(self._last) - messages)]
        return (self._last[-1][0] - then) * _BURST < (self.newest - stamp) * 1e-9

    @property
    def longest_step(self) -> int:
        """Of the last stamps, ns; 0 where only one has come."""
        stamps = [stamp for _, stamp in self._last]
        return max((b - a for a, b in zip(stamps, stamps[1:], strict=False)), default=0)


class Lags:
    """By how much stamps usually lag: those of the clock topic behind the steady time, of others behind the clock's.

    `since`: steady time, s; of messages heard up to then it is not known when they came: they waited.
    """

    def __init__(self) -> None:
        self.since = -math.inf
        self._seen: deque[tuple[float, int]] = deque(maxlen=_LAGS)
        self._behind: dict[str, deque[tuple[float, int]]] = {}

    def look(self, heard: float, stamp_ns: int) -> None:
        """Note the last message of the clock topic; to be called now and then."""
        if heard <= self.since:
            return
        if not self._seen:
            self._seen.append((heard, stamp_ns))
        elif heard > (before := self._seen[-1])[0]:
            if not 0.0 <= (stamp_ns - before[1]) * 1e-9 <= _JUMP + 2 * _BURST * (heard - before[0]):
                self._seen.clear()
                self._behind.clear()
            self._seen.append((heard, stamp_ns))

    def look_at(self, topic: str, heard: float, stamp_ns: int) -> None:
        """Note the last message of another topic, after that of the clock topic."""
        seen = self._behind.setdefault(topic, deque(maxlen=_LAGS))
        unknown = max(self.since, seen[-1][0] if seen else -math.inf)
        if self._seen and heard >= self._seen[0][0] and heard > unknown:
            (first, began), (clock_heard, clock) = self._seen[0], self._seen[-1]
            pace = (clock - began) * 1e-9 / (clock_heard - first) if clock_heard > first else 1.0
            seen.append((heard, clock + round((heard - clock_heard) * pace * 1e9) - stamp_ns))

    def usual(self) -> float | None:
        """The smallest lag of the clock topic lately, s."""
        if len(self._seen) < 2:
            return None
        (first, stamp), (last, newest) = self._seen[0], self._seen[-1]
        if abs((newest - stamp) * 1e-9 - (last - first)) > _PACE * (last - first):
            return None
        return min(heard - stamp * 1e-9 for heard, stamp in self._seen)

    def behind(self) -> dict[str, int]:
        """How far the other topics are usually behind the clock topic, ns; those that are known."""
        seen = {topic: [behind for _, behind in looks] for topic, looks in self._behind.items()}
        return {topic: round(median(looks)) for topic, looks in seen.items() if len(looks) >= _PROMPT}


class CatchUp:
    """Messages in order of arrival in, messages in an order in which no sample closes before its controls are here.

    When a monitor starts, or goes on after a stall, the middleware delivers what it held back in bursts, one topic
    after another. Messages wait here until each topic has been heard, has come as far as the clock topic, and stamps
    advance no faster than the time; after a stall, also until stamps lag no more than they did before. They wait at
    most `longest` seconds. If topics came in bursts, messages are then released in the order in which they would have
    come: by their stamps, those of a topic that usually lags behind the clock topic by more than a step so much later;
    otherwise as they came. The order within a topic never changes. At a start
    there can be no verdict before every topic has been heard: until then each message waits the full time, in case the
    missing topic arrives in a burst.

    `clock`: clock topic; its time is that of its header stamps; `stamped`: further topics whose time is that of their
    header stamps; `awaited`: those of them that are expected to arrive; `step`: expected step of the clock topic, s;
    `max_gap_ns`: A step back of more than this is a reset, ns; `longest`: how long a message waits at most, s; `start`:
    whether the monitor starts; otherwise it goes on after a stall; `lags`: those before;
    `since`: steady time of the last message before the stall, s; `over`: every message has
    been released, and none need wait any longer; `reordered`: messages that were released after one that came later;
    `behind_ns`: how far a topic was behind the clock topic at most, ns, while it arrived in a burst; `took`: how long
    the first message waited, s.
    """

    def __init__(
        self,
        clock: str,
        stamped: Sequence[str],
        awaited: Sequence[str],
        step: float,
        max_gap_ns: int,
        longest: float,
        start: bool,
        lags: Lags | None = None,
        since: float = 0.0,
    ) -> None:
        self._clock, self._never, self._step_ns = clock, {clock, *awaited}, to_ns(step)
        self._longest, self._max_gap_ns, self._start = longest, max_gap_ns, start
        self._lag, self._behind = (lags.usual(), lags.behind()) if lags is not None else (None, {})
        self._since = since
        self._progress = {topic: _Progress() for topic in (clock, *stamped)}
        self._waiting: deque[tuple[int, float, int, Waiting]] = deque()  # number, steady time, stamp, message
        self._recent: deque[tuple[float, int]] = deque()  # steady time and stamp of clock messages
        self._number, self._began, self._heard, self._until = 0, 0.0, 0.0, math.inf
        self._arrival_ns = -(2**63)  # of the last message released
        self._stepped_back = self._clock_in_burst = False
        self._most_behind = -math.inf  # clock topic, s more than before the stall
        self.over, self.reordered, self.behind_ns, self.took = False, 0, 0, 0.0

    def put(self, topic: str, arrival_ns: int, data: bytes, stamp_ns: int | None, now: float) -> None:
        """Have a message wait."""
        if not self._number:
            self._began, self._until = now, now + self._longest
        self._waiting.append((self._number, now, stamp_ns or 0, (topic, arrival_ns, data)))
        self._number += 1
        progress = self._progress.get(topic)
        if progress is None or not stamp_ns:
            return
        if topic in self._never:
            self._never.remove(topic)
            self._heard = now
            if self._start:
                self._until = now + self._longest
        first = not progress.newest
        self._stepped_back |= progress.advance(stamp_ns, now) < -self._max_gap_ns
        if topic == self._clock:
            if self._lag is not None:
                self._most_behind = max(self._most_behind, now - stamp_ns * 1e-9 - self._lag)
            self._clock_in_burst |= progress.in_burst(3)  # one that comes late by a step comes with the next one
            self._recent.append((now, stamp_ns))
            while self._recent[0][0] < now - _QUIET:
                self._recent.popleft()
        else:
            self._compare(progress, first, now)

    def _compare(self, progress: _Progress, first: bool, now: float) -> None:
        """How far a message is behind the clock topic."""
        clock = self._progress[self._clock]
        if not clock.newest:
            return
        before, progress.behind = progress.behind, clock.newest - progress.newest
        if first:
            progress.first_behind = progress.behind
        elif progress.in_burst(2):
            progress.most_behind = max(progress.most_behind, before, progress.behind)
            progress.least_behind = min(progress.least_behind, progress.behind)
            progress.prompt.clear()
        elif not clock.in_burst(2):
            since = min(to_ns(now - clock.at), clock.longest_step or self._step_ns)
            progress.prompt.append(progress.behind + since)

    def lag(self, topic: str) -> int:
        """How far a topic is usually behind the clock topic, ns; 0 where that is no more than a step."""
        prompt = self._progress[topic].prompt
        found = self._behind.get(topic, round(median(prompt)) if prompt else 0)
        return found if found > self._step_ns else 0

    def _bursts(self) -> dict[str, int]:
        """Topics with stamps and their lags, ns, if one of them came in bursts; otherwise none."""
        lags = {topic: self.lag(topic) for topic in self._progress if topic != self._clock}
        bursts = False
        for topic, lag in lags.items():
            progress = self._progress[topic]
            late = progress.most_behind - lag
            early = lag > 0 and (self._clock_in_burst or lag - progress.least_behind > 3 * self._step_ns // 2)
            known = topic in self._behind or progress.prompt  # else one message may have been held up, or always lags
            alone = progress.first_behind - lag if known else 0
            if early or late > (self._step_ns // 2 if lag else 0) or alone > self._step_ns:
                bursts = True
                self.behind_ns = max(self.behind_ns, late, alone)  # 0 if the clock topic was late
        return lags if bursts else {}

    def ready(self, now: float) -> list[Waiting]:
        """Messages that need not wait any longer, in the order in which they are to be taken."""
        full = len(self._waiting) > MOST
        if self._never and self._start and not full:
            return self._release(now - self._longest)
        if full or now >= self._until or (not self._never and self._in_step(now)):
            return self.finish(now)
        return []

    def finish(self, now: float) -> list[Waiting]:
        """Release everything."""
        self.over, self.took = True, now - self._began if self._number else 0.0
        return self._release(math.inf)

    def _in_step(self, now: float) -> bool:
        """Whether each topic has come as far as the clock topic, and none goes on in a burst."""
        if now - self._heard < _QUIET:
            return False
        while self._recent and self._recent[0][0] < now - _QUIET:
            self._recent.popleft()
        if self._recent and (self._recent[-1][1] - self._recent[0][1]) * 1e-9 > _BURST * _QUIET:
            return False
        if self._is_behind():
            return False
        clock = self._progress[self._clock].newest
        for topic, progress in self._progress.items():
            if not progress.newest or topic == self._clock:
                continue
            behind = clock - progress.newest - self.lag(topic)
            silent = now - progress.at > _QUIET and not progress.in_burst(10)  # else more is on the way
            if behind > (progress.longest_step or self._step_ns) and not silent:
                return False
        return True

    def _is_behind(self) -> bool:
        """Whether the clock topic still lags as only messages do that were sent during the stall, or since.

        The stamps of a recording that was paused lag as much, and go on to; those of what was held back come nearer.
        """
        clock = self._progress[self._clock]
        if self._lag is None or not clock.newest:
            return False
        more = clock.at - clock.newest * 1e-9 - self._lag
        return _LAG < more <= clock.at - self._since + _LAG and more < self._most_behind - _LAG

    def _release(self, until: float) -> list[Waiting]:
        """Those that came before a steady time, and what belongs before them."""
        lags = {} if self._stepped_back else self._bursts()
        if not lags:
            released = []
            while self._waiting and self._waiting[0][1] < until:
                released.append(self._waiting.popleft()[3])
            return released
        by_topic: dict[str, deque[tuple[int, float, int, Waiting]]] = {}
        for entry in self._waiting:
            by_topic.setdefault(entry[3][0], deque()).append(entry)
        clock = by_topic.pop(self._clock, deque())
        order: list[tuple[int, float, int, Waiting]] = []
        while clock and clock[0][1] < until:
            sample = clock.popleft()
            belonging = []
            for entries in by_topic.values():
                while entries and _belongs(entries[0], sample, lags):
                    belonging.append(entries.popleft())
            order += sorted(belonging)  # as they came
            order.append(sample)
        rest = sorted([*clock, *(entry for entries in by_topic.values() for entry in entries)])
        let_go = sum(entry[1] < until for entry in rest)  # they came in this order
        order += rest[:let_go]
        self._waiting = deque(rest[let_go:])
        return self._in_order(order)

    def _in_order(self, order: list[tuple[int, float, int, Waiting]]) -> list[Waiting]:
        released, last = [], -1
        for number, _, _, (topic, arrival_ns, data) in order:
            self.reordered += number < last
            last = max(last, number)
            self._arrival_ns = max(arrival_ns, self._arrival_ns + 1)
            released.append((topic, self._arrival_ns, data))
        return released


def _belongs(
    entry: tuple[int, float, int, Waiting], sample: tuple[int, float, int, Waiting], lags: dict[str, int]
) -> bool:
    """Whether a message would have come before a sample: by stamps if both have one, else by arrival."""
    if entry[2] and sample[2]:
        return entry[2] + lags.get(entry[3][0], 0) <= sample[2]
    return entry[3][1] <= sample[3][1]
