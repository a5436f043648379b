# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Sampler: a stream of messages becomes samples (t, x, u), with one meaning offline and live."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any

import cython
import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.english import plural
from uncertain_lti.base.errors import SignalError
from uncertain_lti.sampling.angles import nearest_branch
from uncertain_lti.sampling.counters import INVALID, LATE, MISSING, TOO_OLD, Counters
from uncertain_lti.sampling.instants import to_ns
from uncertain_lti.sampling.status import Status
from uncertain_lti.signals.field_path import FieldPath
from uncertain_lti.signals.signal_map import Signal, SignalMap

BUFFERED_MESSAGES = 10_000
"""Messages kept per topic that wait for a later sample; at this many, all but the later half and the one that the
open sample has chosen so far are forgotten."""
REMEMBERED_SAMPLES = 100
"""Closed samples that a message is compared with to find whether it came late."""
KEPT_OVER_A_JUMP = 100
"""Messages kept per topic, whatever has been chosen, once its time has stepped back and the clock's has not yet."""

_OK, _FIRST, _GAP, _RESET, _MISSING = (
    Status.OK,
    Status.FIRST,
    Status.GAP,
    Status.RESET,
    Status.MISSING,
)  # looking up one of an enumeration is slow
_LAG, _DIFF, _RATE = 0, 1, 2


@cython.cclass
class Step:
    """One decided clock message: the sample k+1 and the transition that ends in it.

    All values are in recorded units, with NaN for what is missing. Without a sample k (first, reset) x and u are all
    NaN and dt is NaN; for a dropped message x_next is NaN as well.

    `status`: what became of the message; `t_ns`: instant t_{k+1}, ns; `arrival_ns`: arrival of the message, ns; `dt`:
    Δt_k, s; `before`: x, u and the further scheduling signals s of sample k; `after`: x of sample k+1.
    """

    status: Status = cython.declare(object, visibility="readonly")
    t_ns: int = cython.declare(object, visibility="readonly")
    arrival_ns: int = cython.declare(object, visibility="readonly")
    dt: float = cython.declare(cython.double, visibility="readonly")
    before: Sequence[float] = cython.declare(object, visibility="readonly")
    after: Sequence[float] = cython.declare(object, visibility="readonly")

    def __init__(
        self, status: Status, t_ns: Any, arrival_ns: Any, dt: float, before: Sequence[float], after: Sequence[float]
    ) -> None:
        self.status, self.t_ns, self.arrival_ns, self.dt = status, t_ns, arrival_ns, dt
        self.before, self.after = before, after

    @property
    def x(self) -> NDArray[np.float64]:
        """State at t_k (n,)."""
        return np.array(self.before[: len(self.after)], dtype=np.float64)

    @property
    def u(self) -> NDArray[np.float64]:
        """Controls at t_k, and after them the further scheduling signals (m + q,)."""
        return np.array(self.before[len(self.after) :], dtype=np.float64)

    @property
    def x_next(self) -> NDArray[np.float64]:
        """State at t_{k+1} (n,)."""
        return np.array(self.after, dtype=np.float64)


@cython.cclass
class _Message:
    """One message: arrival and stamp in ns, 0 for no stamp, and its values."""

    arrival: cython.longlong
    stamp: cython.longlong
    values: list[float]
    given: Any  # the values as received, where one of them does not count

    def __init__(self, arrival: cython.longlong, stamp: cython.longlong, values: list[float]) -> None:
        self.arrival, self.stamp, self.values, self.given = arrival, stamp, values, None


@cython.cclass
class _Topic:
    """Messages of one topic that may still be chosen, and how far it got."""

    name: str
    where: list[int]  # place of each of its values in [x; u]
    side_by_side: cython.bint  # most often they are: then they are copied as one
    first: cython.Py_ssize_t
    max_age: list[int]  # ns, of each value
    least_max_age: cython.longlong
    header: cython.bint
    clock_has_stamps: cython.bint
    kept: deque[_Message]
    forgotten: dict[bool, tuple[int, int]]  # first and last stamp, arrival of what there was no room for
    last: dict[bool, int]  # instant of the last message with a stamp, and of the last one without
    left: tuple[bool, int]  # whether by stamps, and the instant from which its time last stepped back
    ahead: cython.bint  # its time has stepped back, the clock's perhaps not yet
    behind: cython.bint  # the clock's time has stepped back, its own not yet
    leave: Any  # a sample before the step back and what it has chosen, or None
    closed: deque[tuple[_Message, _Message | None]]  # and what they chose
    limited: list[tuple[int, Signal]]  # those of which not every value counts
    unwrap: list[int]
    previous: list[float]
    steady: list[float]

    def __init__(self, signals: SignalMap, name: str, max_age: list[int]) -> None:
        self.name, self.where = name, signals.on(name)
        self.first = self.where[0]
        self.side_by_side = self.where == list(range(self.first, self.first + len(self.where)))
        self.max_age = [max_age[i] for i in self.where]
        self.least_max_age = min(self.max_age)
        self.header, self.clock_has_stamps = (signals.time[topic] == "header" for topic in (name, signals.clock or ""))
        here = [signals[i] for i in self.where]
        self.unwrap = [i for i, signal in enumerate(here) if FieldPath(signal.field).unwrap]
        self.limited = [(i, signal) for i, signal in enumerate(here) if signal.valid is not None or signal.ignore]
        self.steady = [signals.branch(i) for i in self.where]
        self.kept = deque()
        self.forgotten, self.last = {}, {}
        self.left = False, 0
        self.ahead = self.behind = False
        self.leave = None
        self.closed = deque(maxlen=REMEMBERED_SAMPLES)
        self.previous = list(self.steady)

    @cython.cfunc
    def steps_back(self, message: _Message, limit: cython.longlong) -> cython.bint:
        """Whether a message is more than limit before the last one on the same clock."""
        stamped = message.stamp != 0
        instant = message.stamp or message.arrival
        last = self.last.get(stamped, instant)
        self.last[stamped] = instant
        if instant < last - limit:
            self.left = stamped, last
            return True
        if self.ahead and self.left[0] is stamped and instant >= self.left[1]:
            self.ahead = False  # single messages had stepped back, and no time
        return False

    @cython.cfunc
    def came_late(self, message: _Message) -> cython.bint:
        """Whether a closed sample would have chosen this message."""
        for sample, chosen in reversed(self.closed):
            behind = _behind(sample, message)
            if behind < 0:
                break
            if chosen is None or behind <= _behind(sample, chosen):
                return True
        return False

    @cython.cfunc
    def choose(self, sample: _Message) -> _Message | None:
        """The message with the greatest stamp at or before the sample, ties to the latest arrival.

        None where there is none, or it has been forgotten.
        """
        if self.leave is not None and self.leave[0] is sample:
            return self.leave[1]
        age: cython.longlong = 2**63 - 1
        behind: cython.longlong
        message: _Message
        chosen = None
        for message in self.kept:
            behind = _behind(sample, message)
            if 0 <= behind <= age:
                chosen, age = message, behind
        for by_stamp, (first, last) in self.forgotten.items():
            instant = sample.stamp if by_stamp else sample.arrival
            if (by_stamp and not instant) or (first <= instant and max(instant - last, 0) < age):
                return None  # perhaps; there may be nothing between the sample and what would be chosen
        return chosen

    @cython.cfunc
    def keep(self, message: _Message, sample: _Message | None) -> None:
        """Take a message that may be chosen; sample is the open one."""
        m: _Message
        if len(self.kept) >= BUFFERED_MESSAGES:
            held = None if sample is None else self.choose(sample)
            older = [self.kept.popleft() for _ in range(len(self.kept) // 2)]
            if held is not None and any(m is held for m in older):
                self.kept.appendleft(held)
            for m in older:
                if sample is None or _behind(sample, m) < 0:
                    by_stamp = self.clock_has_stamps and m.stamp != 0
                    instant = m.stamp if by_stamp else m.arrival
                    first, last = self.forgotten.get(by_stamp, (instant, instant))
                    self.forgotten[by_stamp] = min(first, instant), max(last, instant)
        self.kept.append(message)

    @cython.cfunc
    def start_anew(self, sample: _Message | None, message: _Message) -> None:
        """The topic's time has stepped back to a message, as in a bag that is played again; the last pass is forgotten.

        The open sample may be of that pass too, where the clock has not stepped back yet: not since the topic last did,
        or there is the topic that never followed, and the sample is nearer to the time that it leaves only now.
        """
        if self.behind and sample is not None:
            instant = sample.stamp if self.left[0] else sample.arrival
            if not (self.left[0] and not instant) and abs(instant - self.left[1]) < abs(_behind(sample, message)):
                self.behind = False
        held = None if sample is None or self.behind else self.choose(sample)
        self.leave = (sample, held) if sample is not None and held is not None else None
        self.kept.clear()
        self.forgotten.clear()
        self.closed.clear()
        self.ahead, self.behind = not self.behind, False
        self.previous = list(self.steady)

    @cython.cfunc
    def close(self, sample: _Message, chosen: _Message | None, reset: cython.bint) -> None:
        """Forget what no later sample can choose.

        Where time jumps, later samples are earlier: what came before them on the new time is kept.
        """
        jumps = reset or (self.ahead and len(self.kept) < KEPT_OVER_A_JUMP)
        if self.leave is not None:  # chosen is not among those kept
            jumps, self.leave = True, None
        if chosen is not None and not jumps:
            kept = self.kept
            while kept[0] is not chosen and _behind(sample, kept[0]) >= 0:  # most often this is all
                kept.popleft()
            if len(kept) > 1:
                self.kept = deque(m for m in kept if m is chosen or _behind(sample, m) < 0)
            if self.forgotten:
                self._forget_until(sample)
        if reset:
            self.behind = not self.ahead
            self.ahead = False
            self.closed.clear()  # nothing of this pass can be late for a sample of the one before
        else:
            self.closed.append((sample, chosen))

    @cython.cfunc
    def _forget_until(self, sample: _Message) -> None:
        """What was forgotten of the time before a sample that has chosen matters to no later one."""
        for by_stamp, (first, last) in list(self.forgotten.items()):
            instant = sample.stamp if by_stamp else sample.arrival
            if by_stamp and not instant:
                continue
            if last <= instant:
                del self.forgotten[by_stamp]
            else:
                self.forgotten[by_stamp] = max(first, instant + 1), last

    @cython.cfunc
    def unwrapped(self, values: list[float]) -> list[float]:
        for i in self.unwrap:
            if math.isfinite(values[i]):
                values[i] = nearest_branch(values[i], self.previous[i])
                self.previous[i] = values[i]
        return values


@cython.cfunc
@cython.inline
@cython.exceptval(check=False)
def _behind(sample: _Message, message: _Message) -> cython.longlong:
    """Age of a message at a sample, in ns: between the stamps where both have one, else between arrivals."""
    if sample.stamp != 0 and message.stamp != 0:
        return sample.stamp - message.stamp
    return sample.arrival - message.arrival


@cython.cfunc
@cython.inline
@cython.exceptval(check=False)
def _instant(sample: _Message) -> cython.longlong:
    return sample.stamp or sample.arrival


@cython.cclass
class Sampler:
    """Messages in order of arrival in, one `Step` per clock message out, as soon as it is decided.

    A clock message opens sample k at its instant; the next accepted clock message closes it, and only then are
    u(t_k) and the states of other topics fixed: the message with the greatest stamp <= t_k among those arrived,
    ties to the latest arrival. A step is decided when its second sample opens, or, where states come from more
    than one topic or a control at the arrival from another one, when that sample closes. Nothing is resampled.

    `signals`: with clock, max_gap and a time source for every topic resolved (`reading.read_transients` and the model
    file do that); `counters`: samples, gaps, resets and missing; dropped messages by status value; `late <topic>` for
    messages that came after the sample they belonged to was closed; `missing <signal>` and `stale <signal>` per sample;
    `invalid <signal>` per message whose value is outside `valid` or in `ignore`.
    """

    signals = cython.declare(object, visibility="readonly")
    clock = cython.declare(str, visibility="readonly")
    counters = cython.declare(object, visibility="public")
    max_gap_ns: cython.longlong
    min_step_ns: cython.longlong
    _n: cython.Py_ssize_t
    _topics: dict[str, _Topic]
    _clock: _Topic
    _others: list[_Topic]
    _at_once: cython.bint  # the clock message carries all that the step to it needs
    _arrivals: list[int]  # places of the controls that act as they are at the end of a step
    _clock_is_x: cython.bint
    _unknown: list[float]
    _no_state: list[float]
    _memories: list[tuple[int, int, int]]  # place, samples back, and which function
    _period: cython.double  # s; 0 where Δt is that of the stamps
    _open: Any  # sample k: the clock message that opened it
    _open_status: Any
    _open_dt: cython.double
    _before: Any  # z of sample k-1, fixed when it closed
    _history: dict[int, deque[float]]

    def __init__(self, signals: SignalMap) -> None:
        if signals.clock is None or signals.max_gap is None:
            raise SignalError(f"{signals.source}: clock and max_gap must be resolved before sampling")
        if signals.step == "constant":
            raise SignalError(f"{signals.source}: the constant step must be resolved before sampling")
        unsaid = [t for t in signals.topics if t not in signals.time]
        if unsaid:
            raise SignalError(f"{signals.source}: the time source of {', '.join(unsaid)} is not resolved")
        self.signals, self.clock = signals, signals.clock
        self.max_gap_ns, self.min_step_ns = to_ns(signals.max_gap), to_ns(signals.min_step)
        n = self._n = len(signals.states)
        max_age = [to_ns(signals.longest_age(i)) for i in range(len(signals))]
        self._topics = {topic: _Topic(signals, topic, max_age) for topic in signals.topics}
        self._clock = self._topics[signals.clock]
        self._others = [topic for topic in self._topics.values() if topic is not self._clock]
        self._at_once, self._arrivals = signals.decided_at_once, list(signals.arrivals)
        self._clock_is_x = self._clock.where == list(range(n))
        self._unknown, self._no_state = [math.nan] * len(signals), [math.nan] * n
        self._memories = []
        for i, signal in enumerate(signals):
            memory = signal.memory
            if signal.delay or (memory is not None and memory.kind == "lag"):
                self._memories.append((i, memory.samples if memory is not None else signal.delay, _LAG))
            elif memory is not None:
                self._memories.append((i, 1, _DIFF if memory.kind == "diff" else _RATE))
        self._period = 0.0 if isinstance(signals.step, str) else signals.step
        self.counters = Counters()
        self._open = self._before = None
        self._open_status, self._open_dt = _FIRST, math.nan
        self._history = {}

    def push(self, topic: str, arrival_ns: int, stamp_ns: int | None, values: Sequence[float]) -> list[Step]:
        """Take one message."""
        state: _Topic = self._topics[topic]
        stamp: cython.longlong = stamp_ns if state.header and stamp_ns is not None and stamp_ns > 0 else 0
        message = _Message(arrival_ns, stamp, list(values))
        if len(message.values) != len(state.where):
            raise ValueError(
                f"{topic}: {plural(len(message.values), 'value')} for {plural(len(state.where), 'signal')}"
            )
        for i, signal in state.limited:
            if not signal.admits(message.values[i]):
                if message.given is None:
                    message.given = list(message.values)
                message.values[i] = math.nan
                self.counters.add(INVALID, signal.name)
        if state is self._clock:
            return self._push_clock(message)
        if state.steps_back(message, self.max_gap_ns):
            state.start_anew(self._open, message)
        elif state.came_late(message):
            self.counters.add(LATE, topic)
        if state.unwrap:
            state.unwrapped(message.values)
        state.keep(message, self._open)
        return []

    @cython.cfunc
    def _push_clock(self, message: _Message) -> list[Step]:
        state: _Topic = self._clock
        instant: cython.longlong = message.stamp if state.header else message.arrival
        step: cython.longlong
        opens: cython.bint
        dt: cython.double = math.nan
        if state.header and not instant:
            return [self._dropped(Status.UNSTAMPED, message.arrival, message)]
        steps: list[Step] = []
        status = _FIRST
        closing = self._open
        if closing is not None:
            step = instant - _instant(closing)
            if step == 0:
                return [self._dropped(Status.EQUAL, instant, message)]
            if 0 < step < self.min_step_ns:
                return [self._dropped(Status.SHORT, instant, message)]
            if -self.max_gap_ns <= step < 0:
                return [self._dropped(Status.LATE, instant, message)]
            status = _OK if 0 < step <= self.max_gap_ns else _GAP if step > 0 else _RESET
            dt = step * 1e-9 if step > 0 else math.nan
            if self._period > 0.0 and status is _OK:
                dt = self._period
        opens = status is not _OK  # a segment
        if opens:
            state.previous = list(state.steady)
        if state.unwrap:
            state.unwrapped(message.values)
        if closing is not None:
            z = self._fix(closing, True, status is _RESET)
            if not self._at_once:
                at_end = self._unknown if status is _RESET else z
                steps.append(self._step(self._open_status, closing, self._open_dt, at_end, z[: self._n]))
            self._before = z
        if opens:
            self._history = {}
        if self._at_once:
            x_next, at_end = message.values, self._unknown
            if not self._clock_is_x:
                at_end = self._unknown.copy()
                self._put(state, message, at_end)
                x_next = at_end[: self._n]
            steps.append(self._step(status, message, dt, at_end, x_next))
        self._open, self._open_status, self._open_dt = message, status, dt
        self.counters["samples"] += 1
        if status is _GAP:
            self.counters["gaps"] += 1
        elif status is _RESET:
            self.counters["resets"] += 1
        return steps

    @cython.cfunc
    def _dropped(self, status: Status, instant: cython.longlong, message: _Message) -> Step:
        self.counters[status.value] += 1
        return Step(status, instant, message.arrival, math.nan, self._unknown, self._no_state)

    @cython.cfunc
    def _step(
        self, status: Status, message: _Message, dt: cython.double, at_end: list[float], x_next: list[float]
    ) -> Step:
        """The step to a sample; at_end: z there, as far as it is known when the step is decided."""
        before = self._before
        if before is None or status is _FIRST or status is _RESET:
            before = self._unknown
        elif self._arrivals:
            before = list(before)
            for i in self._arrivals:
                before[i] = at_end[i]
        if status is _OK and not (all_finite(before) and all_finite(x_next)):
            status = _MISSING
            self.counters["missing"] += 1
        return Step(status, _instant(message), message.arrival, dt, before, x_next)

    @cython.cfunc
    def _fix(self, sample: _Message, final: cython.bint, reset: cython.bint) -> list[float]:
        """z = [x; u] of the open sample from what has arrived; final: the sample closes now; reset: by a step back."""
        z = self._unknown.copy()
        state: _Topic
        chosen: _Message
        age: cython.longlong
        self._put(self._clock, sample, z)
        for state in self._others:
            found = state.choose(sample)
            if final:
                state.close(sample, found, reset)
            if found is None:
                continue
            chosen = found
            age = _behind(sample, chosen)
            if age <= state.least_max_age:
                self._put(state, chosen, z)
                continue
            for i, value, longest in zip(state.where, chosen.values, state.max_age, strict=True):
                if age <= longest:
                    z[i] = value
                elif final:
                    self.counters.add(TOO_OLD, self.signals[i].name)
        for i, back, kind in self._memories:
            line = self._history.setdefault(i, deque(maxlen=back + 1))
            line = line if final else line.copy()
            line.append(z[i])
            if len(line) <= back:
                z[i] = math.nan
            elif kind == _LAG:
                z[i] = line[0]
            elif kind == _DIFF:
                z[i] = line[1] - line[0]
            else:
                z[i] = (line[1] - line[0]) / self._open_dt
        if final and not all_finite(z):
            for signal, value in zip(self.signals, z, strict=True):
                if not math.isfinite(value):
                    self.counters.add(MISSING, signal.name)
        return z

    @cython.cfunc
    def _put(self, state: _Topic, message: _Message, z: list[float]) -> None:
        if state.side_by_side:
            z[state.first : state.first + len(state.where)] = message.values
            return
        for i, value in zip(state.where, message.values, strict=True):
            z[i] = value

    def kept(self, topic: str) -> list[tuple[int, int, list[float]]]:
        """Messages of a topic that may still be chosen, oldest first."""
        state: _Topic = self._topics[topic]
        message: _Message
        found = []
        for message in state.kept:
            values = message.values
            if message.given is not None:
                values = [given if math.isnan(v) else v for v, given in zip(values, message.given, strict=True)]
            found.append((message.stamp, message.arrival, values))
        return found

    def latest(self) -> tuple[int, list[float]] | None:
        """The open sample with what is known so far."""
        if self._open is None:
            return None
        return _instant(self._open), self._fix(self._open, False, False)


def all_finite(values: Sequence[float]) -> bool:
    """Whether all are finite."""
    return math.isfinite(sum(values)) or all(map(math.isfinite, values))  # a sum of finite numbers may overflow
