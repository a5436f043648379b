# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""CatchUp: messages that wait, at the start and after a stall, and are taken in the order in which they were sent."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

WINDOW = 4.0
"""s of steady time that messages wait at most: Fast DDS asks every 3 s for what a reliable reader has missed."""
STALL = 0.2
"""s without any message after which topics may arrive one after another."""
LATE = 0.1
"""s that a message may be on its way longer than others, and is not held up."""
MOST = 20_000
"""Messages that wait at most."""

_QUIET = STALL  # s that messages wait at least: a longer pause counts as another stall
_BURST = 5  # messages that come this many times as fast as they were sent come in a burst

Waiting = tuple[str, int, bytes]
"""Topic, arrival in ns, and data of one message."""


def arrival_of(received_ns: int, taken_ns: int, before_ns: int) -> int:
    """When a message arrived, ns: as the middleware received it, if it says; not before the message before."""
    if not 0 < received_ns <= taken_ns:
        received_ns = taken_ns
    return before_ns if received_ns < before_ns <= taken_ns else received_ns


class _Way:
    """How messages of one topic come: by how much later than they were sent."""

    def __init__(self) -> None:
        self._lately: deque[tuple[float, int, float]] = deque()  # steady time, sent, and s on the way, of a while

    def add(self, now: float, sent_ns: int, late: float) -> None:
        """Take one message."""
        self._lately.append((now, sent_ns, late))
        while len(self._lately) > 2 and self._lately[0][0] < now - _QUIET:
            self._lately.popleft()

    def is_calm(self, now: float, least: float) -> bool:
        """Whether nothing came in a burst lately, and nothing more is on the way; `least`: s that any message took."""
        late = [late for at, _, late in self._lately if at >= now - _QUIET]
        if late and max(late) - min(late) > LATE:
            return False
        if len(self._lately) < 2 or self._lately[-1][2] < least + LATE:
            return True
        (before, first, _), (last, sent, _) = self._lately[-2], self._lately[-1]
        apart = (sent - first) * 1e-9
        return apart / _BURST <= last - before <= apart + LATE  # after a longer pause more is behind it

    def ahead_ns(self, now: float) -> int:
        """By how much the clock of the sender is behind, ns: messages are on the way for long, and all as long."""
        late = [late for _, _, late in self._lately]
        same = len(late) > 2 and self._lately[-1][0] >= now - _QUIET and max(late) - min(late) < LATE / 2
        return round(min(late) * 1e9) if same and abs(min(late)) > LATE else 0


class CatchUp:
    """Messages in order of arrival in, messages in the order in which they were sent out.

    When a monitor starts, or goes on after a stall, the middleware delivers what it held back in bursts, one topic
    after another. Messages wait here until each awaited topic has been heard and none comes in a burst any more, at
    most `longest` seconds. They are released by the time at which their publishers sent them, corrected where the clock
    of another machine differs. At a start there can be no verdict before every topic has been heard: until then each
    message waits the full time, in case the missing topic arrives in a burst.

    `awaited`: topics that are expected to arrive; `start`: whether the monitor starts; otherwise it goes on after a
    stall; `over`: every message has been released, and none need wait any longer; `reordered`: messages that were
    released after one that came later; `late`: s that a message was on its way at most; `took`: how long the first
    message waited, s.
    """

    def __init__(self, awaited: Sequence[str], longest: float, start: bool) -> None:
        self._never, self._longest, self._start = {*awaited}, longest, start
        self._ways: dict[str, _Way] = {}
        self._waiting: list[tuple[int, float, int, Waiting]] = []  # number, steady time, sent, message
        self._number, self._began, self._heard, self._until = 0, 0.0, 0.0, math.inf
        self._least = math.inf  # s that a message was on its way
        self._arrival_ns = -(2**63)  # of the last message released
        self.over, self.reordered, self.late, self.took = False, 0, 0.0, 0.0

    def put(self, message: Waiting, sent_ns: int, late: float, now: float) -> None:
        """Have a message wait; `sent_ns`: when it was sent, 0 if that is not known; `late`: s on its way."""
        if not self._number:
            self._began, self._until = now, now + self._longest
        self._waiting.append((self._number, now, sent_ns, message))
        self._number += 1
        topic = message[0]
        self._ways.setdefault(topic, _Way()).add(now, sent_ns, late)
        self._least, self.late = min(self._least, late), max(self.late, late)
        if topic in self._never:
            self._never.remove(topic)
            self._heard = now
            if self._start:
                self._until = now + self._longest

    def ready(self, now: float) -> list[Waiting]:
        """Messages that need not wait any longer, in the order in which they are to be taken."""
        full = len(self._waiting) > MOST
        if self._never and self._start and not full:
            return self._release(now, now - self._longest)
        quiet = not self._never and now - self._heard >= _QUIET
        if full or now >= self._until or (quiet and all(w.is_calm(now, self._least) for w in self._ways.values())):
            return self.finish(now)
        return []

    def finish(self, now: float) -> list[Waiting]:
        """Release everything."""
        self.over, self.took = True, now - self._began if self._number else 0.0
        return self._release(now, math.inf)

    def _release(self, now: float, until: float) -> list[Waiting]:
        """Those that came before a steady time, and what was sent before them."""
        ahead = {topic: way.ahead_ns(now) for topic, way in self._ways.items()}
        last, keyed = dict[str, int](), list[tuple[int, int]]()
        latest = 0
        for place, (_, _, sent_ns, message) in enumerate(self._waiting):
            topic = message[0]
            at = max(sent_ns + ahead[topic] if sent_ns else latest, last.get(topic, 0))  # in order within a topic
            last[topic], latest = at, max(at, latest)
            keyed.append((at, place))
        order = [self._waiting[place] for _, place in sorted(keyed)]
        count = max((i + 1 for i, entry in enumerate(order) if entry[1] < until), default=0)
        self._waiting = sorted(order[count:])
        released, newest = list[Waiting](), -1
        for number, _, _, (topic, arrival_ns, data) in order[:count]:
            self.reordered += number < newest
            newest = max(number, newest)
            self._arrival_ns = max(arrival_ns, self._arrival_ns)
            released.append((topic, self._arrival_ns, data))
        return released
