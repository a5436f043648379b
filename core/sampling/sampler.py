"""Sampler: a stream of messages becomes samples (t, x, u), with one meaning offline and live."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.english import plural
from uncertain_lti.base.errors import SignalError
from uncertain_lti.base.limits import LONGEST_S
from uncertain_lti.signals.field_path import FieldPath
from uncertain_lti.signals.signal_map import SignalMap

_TWO_PI = 2.0 * math.pi
BUFFERED_MESSAGES = 10_000
"""Messages kept per topic that wait for a later sample; at this many, all but the later half and the one that the
open sample has chosen so far are forgotten."""
REMEMBERED_SAMPLES = 100
"""Closed samples that a message is held against to see whether it came late."""
KEPT_OVER_A_JUMP = 100
"""Messages kept per topic, whatever has been chosen, once its time has stepped back and the clock's has not yet."""


LONGEST_NS = 2**62
"""Longer than any recording; what is longer still counts as this."""


def to_ns(seconds: float) -> int:
    """Seconds to whole nanoseconds, `LONGEST_NS` at most."""
    return min(round(seconds * 1e9), LONGEST_NS) if math.isfinite(seconds) else LONGEST_NS


class Status(StrEnum):
    """What became of one clock message."""

    OK = "ok"  # the transition that ends in this sample can be judged
    FIRST = "first"  # first sample of a recording
    RESET = "reset"  # time stepped back by more than max_gap: first sample of a new segment
    GAP = "gap"  # the step is longer than max_gap: first sample of a new segment
    MISSING = "missing"  # a signal at either end is missing, stale, NaN or infinite
    EQUAL = "equal stamp"  # dropped: the instant of the sample before
    SHORT = "short step"  # dropped: less than min_step after the sample before
    LATE = "late"  # dropped: at most max_gap before the sample before
    UNSTAMPED = "no stamp"  # dropped: header time is wanted and the stamp is zero

    @property
    def dropped(self) -> bool:
        """The message made no sample."""
        return self in (Status.EQUAL, Status.SHORT, Status.LATE, Status.UNSTAMPED)

    @property
    def opens_segment(self) -> bool:
        """The sample has no predecessor."""
        return self in (Status.FIRST, Status.RESET, Status.GAP)


class Step:
    """One decided clock message: the sample k+1 at t_ns and the transition that ends in it.

    before (n + m) holds x and u of sample k, after (n) holds x of sample k+1, all in recorded units, with NaN for
    what is missing; x (n,), u (m,) and x_next (n,) are the same as arrays. dt is Δt_k in s. Without a sample k
    (first, reset) x and u are all NaN and dt is NaN; for a dropped message x_next is NaN as well.
    """

    __slots__ = ("status", "t_ns", "arrival_ns", "dt", "before", "after")

    def __init__(
        self, status: Status, t_ns: int, arrival_ns: int, dt: float, before: Sequence[float], after: Sequence[float]
    ) -> None:
        self.status, self.t_ns, self.arrival_ns, self.dt = status, t_ns, arrival_ns, dt
        self.before, self.after = before, after

    @property
    def x(self) -> NDArray[np.float64]:
        """State at t_k (n,)."""
        return np.array(self.before[: len(self.after)], dtype=np.float64)

    @property
    def u(self) -> NDArray[np.float64]:
        """Controls at t_k (m,)."""
        return np.array(self.before[len(self.after) :], dtype=np.float64)

    @property
    def x_next(self) -> NDArray[np.float64]:
        """State at t_{k+1} (n,)."""
        return np.array(self.after, dtype=np.float64)


Told = tuple[int, int]
"""Stamp, 0 where there is none, and arrival of a message, ns."""


@dataclass(frozen=True)
class Standing:
    """Where a sampler stands whose messages have come in order; see `Sampler.standing`.

    sample: the clock message that opened sample k, and its values. dt: the step to it, s. before: [x; u] of sample k-1.
    topics: of each topic but the clock's the instant of its last message, the last closed sample, and the messages
    that may still be chosen with their values. previous: of each topic the last of its angles that are unwrapped.
    lines: of each delayed control its values at the samples closed last, as many as the delay.
    """

    sample: tuple[Told, Sequence[float]]
    dt: float
    before: Sequence[float]
    topics: Mapping[str, tuple[int | None, Told | None, Sequence[tuple[Told, Sequence[float]]]]]
    previous: Mapping[str, Sequence[float]]
    lines: Sequence[Sequence[float]]


@dataclass(slots=True)
class _Message:
    arrival: int
    stamp: int | None
    values: list[float]

    @classmethod
    def told(cls, told: Told, values: Sequence[float] = ()) -> _Message:
        return cls(told[1], told[0] or None, list(values))

    def tell(self) -> Told:
        return self.stamp or 0, self.arrival


class _Topic:
    """Messages of one topic that may still be chosen, and how far it got."""

    __slots__ = (
        "header",
        "clock_has_stamps",
        "kept",
        "forgotten",
        "last",
        "left",
        "ahead",
        "behind",
        "leave",
        "closed",
        "unwrap",
        "previous",
        "steady",
    )

    def __init__(self, header: bool, clock_has_stamps: bool, unwrap: list[int], steady: list[float]) -> None:
        self.header, self.clock_has_stamps = header, clock_has_stamps
        self.kept: deque[_Message] = deque()
        self.forgotten: dict[bool, tuple[int, int]] = {}  # first and last stamp, arrival of what there was no room for
        self.last: dict[bool, int] = {}  # instant of the last message with a stamp, and of the last one without
        self.left = False, 0  # whether by stamps, and the instant from which its time last stepped back
        self.ahead = False  # its time has stepped back, the clock's perhaps not yet
        self.behind = False  # the clock's time has stepped back, its own not yet
        self.leave: tuple[_Message, _Message] | None = None  # a sample of the pass before, and what it has chosen
        self.closed: deque[tuple[_Message, _Message | None]] = deque(maxlen=REMEMBERED_SAMPLES)  # and what they chose
        self.unwrap = unwrap
        self.steady = steady
        self.previous = list(steady)

    def steps_back(self, message: _Message, limit: int) -> bool:
        """Whether a message is more than limit before the last one on the same clock."""
        stamped = message.stamp is not None
        instant = message.arrival if message.stamp is None else message.stamp
        last = self.last.get(stamped, instant)
        self.last[stamped] = instant
        if instant < last - limit:
            self.left = stamped, last
            return True
        if self.ahead and self.left[0] is stamped and instant >= self.left[1]:
            self.ahead = False  # single messages had stepped back, and no time
        return False

    def came_late(self, message: _Message) -> bool:
        """Whether a closed sample would have chosen this message."""
        for sample, chosen in reversed(self.closed):
            behind = _behind(sample, message)
            if behind < 0:
                break
            if chosen is None or behind <= _behind(sample, chosen):
                return True
        return False

    def choose(self, sample: _Message) -> _Message | None:
        """The message with the greatest stamp at or before the sample, ties to the latest arrival.

        None where there is none, or it has been forgotten.
        """
        if self.leave is not None and self.leave[0] is sample:
            return self.leave[1]
        chosen, age = None, 2**63
        for message in self.kept:
            behind = _behind(sample, message)
            if 0 <= behind <= age:
                chosen, age = message, behind
        for by_stamp, (first, last) in self.forgotten.items():
            instant = sample.stamp if by_stamp else sample.arrival
            if instant is None or (first <= instant and max(instant - last, 0) < age):
                return None  # perhaps; there may be nothing between the sample and what would be chosen
        return chosen

    def keep(self, message: _Message, sample: _Message | None) -> None:
        """Take a message that may be chosen; sample is the open one."""
        if len(self.kept) >= BUFFERED_MESSAGES:
            held = None if sample is None else self.choose(sample)
            older = [self.kept.popleft() for _ in range(len(self.kept) // 2)]
            if held is not None and any(m is held for m in older):
                self.kept.appendleft(held)
            for m in older:
                if sample is None or _behind(sample, m) < 0:
                    by_stamp = self.clock_has_stamps and m.stamp is not None
                    instant = m.arrival if m.stamp is None or not by_stamp else m.stamp
                    first, last = self.forgotten.get(by_stamp, (instant, instant))
                    self.forgotten[by_stamp] = min(first, instant), max(last, instant)
        self.kept.append(message)

    def start_anew(self, sample: _Message | None, message: _Message) -> None:
        """The topic's time has stepped back to a message, as in a bag that is played again; the last pass is forgotten.

        The open sample may be of that pass too, where the clock has not stepped back yet: not since the topic last did,
        or there is the topic that never followed, and the sample is nearer to the time that it leaves only now.
        """
        if self.behind and sample is not None:
            instant = sample.stamp if self.left[0] else sample.arrival
            if instant is not None and abs(instant - self.left[1]) < abs(_behind(sample, message)):
                self.behind = False
        held = None if sample is None or self.behind else self.choose(sample)
        self.leave = (sample, held) if sample is not None and held is not None else None
        self.kept.clear()
        self.forgotten.clear()
        self.closed.clear()
        self.ahead, self.behind = not self.behind, False
        self.previous = list(self.steady)

    def close(self, sample: _Message, chosen: _Message | None, reset: bool) -> None:
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

    def _forget_until(self, sample: _Message) -> None:
        """What was forgotten of the time before a sample that has chosen matters to no later one."""
        for by_stamp, (first, last) in list(self.forgotten.items()):
            instant = sample.stamp if by_stamp else sample.arrival
            if instant is not None and last <= instant:
                del self.forgotten[by_stamp]
            elif instant is not None:
                self.forgotten[by_stamp] = max(first, instant + 1), last

    @property
    def in_order(self) -> bool:
        """Nothing has been forgotten, and the topic's time has not stepped back before that of the clock."""
        return not (self.forgotten or self.leave or self.ahead)

    def unwrapped(self, values: list[float]) -> list[float]:
        for i in self.unwrap:
            if math.isfinite(values[i]):
                values[i] += _TWO_PI * round((self.previous[i] - values[i]) / _TWO_PI)
                self.previous[i] = values[i]
        return values


def _behind(sample: _Message, message: _Message) -> int:
    """Age of a message at a sample, in ns: between the stamps where both have one, else between arrivals."""
    if sample.stamp is not None and message.stamp is not None:
        return sample.stamp - message.stamp
    return sample.arrival - message.arrival


class Sampler:
    """Messages in order of arrival in, one `Step` per clock message out, as soon as it is decided.

    A clock message opens sample k at its instant; the next accepted clock message closes it, and only then are
    u(t_k) and the states of other topics fixed: the message with the greatest stamp <= t_k among those arrived,
    ties to the latest arrival. A step is decided when its second sample opens, or, where states come from more
    than one topic, when that sample closes. Nothing is resampled.

    Parameters
    ----------
    signals : SignalMap
        With clock, max_gap and a time source for every topic resolved (`bag.read_transients` and the model
        file do that).

    Attributes
    ----------
    counters : Counter
        samples, gaps, resets and missing; dropped messages by status value; `late <topic>` for messages that came
        after the sample they belonged to was closed; `missing <signal>` and `stale <signal>` per sample.

    Raises
    ------
    SignalError
        Something in the map is not resolved.
    """

    def __init__(self, signals: SignalMap) -> None:
        if signals.clock is None or signals.max_gap is None:
            raise SignalError(f"{signals.source}: clock and max_gap must be resolved before sampling")
        unsaid = [t for t in signals.topics if t not in signals.time]
        if unsaid:
            raise SignalError(f"{signals.source}: the time source of {', '.join(unsaid)} is not resolved")
        self.signals = signals
        self.clock = signals.clock
        self.max_gap_ns = to_ns(signals.max_gap)
        self.min_step_ns = to_ns(signals.min_step)
        skew_ns = self.max_gap_ns if signals.max_skew is None else to_ns(signals.max_skew)
        n = len(signals.states)
        self._n, self._nm = n, len(signals.signals)
        self._where = {topic: signals.on(topic) for topic in signals.topics}
        # Most often a topic carries signals that stand side by side; then they are copied as one.
        self._span = {
            topic: slice(where[0], where[-1] + 1) if where == list(range(where[0], where[-1] + 1)) else None
            for topic, where in self._where.items()
        }
        self._max_age = [skew_ns] * n + [
            LONGEST_NS if c.max_hold is None else to_ns(c.max_hold) for c in signals.controls
        ]
        self._least_max_age = {t: min(self._max_age[i] for i in where) for t, where in self._where.items()}
        self._one_topic = all(s.topic == self.clock for s in signals.states)
        self._clock_is_x = self._where[self.clock] == list(range(n))
        self._unknown = [math.nan] * self._nm
        self._delays = [(n + j, c.delay) for j, c in enumerate(signals.controls) if c.delay]
        self._topics: dict[str, _Topic] = {}
        for topic, where in self._where.items():
            here = [signals.signals[i] for i in where]
            unwrap = [i for i, s in enumerate(here) if FieldPath(s.field).unwrap]
            steady = [0.0 if s.steady == "auto" else s.steady for s in here]
            self._topics[topic] = _Topic(
                signals.time[topic] == "header", signals.time[self.clock] == "header", unwrap, steady
            )
        self.counters: Counter[str] = Counter()
        self._open: _Message | None = None  # sample k: the clock message that opened it
        self._open_status = Status.FIRST
        self._open_dt = math.nan
        self._before: list[float] | None = None  # z of sample k-1, fixed when it closed
        self._history: dict[int, deque[float]] = {}

    def push(self, topic: str, arrival_ns: int, stamp_ns: int | None, values: Sequence[float]) -> list[Step]:
        """Take one message; return the clock messages that it decided (none, one, or seldom two).

        Parameters
        ----------
        topic : str
            One of `signals.topics`.
        arrival_ns : int
            Log time, or live the node clock at receipt.
        stamp_ns : int or None
            Header stamp; None, zero or less where there is none. Ignored for topics that go by log time.
        values : sequence of float
            The topic's signals in the order of `signals.on(topic)`.
        """
        state = self._topics[topic]
        stamp = stamp_ns if state.header and stamp_ns is not None and stamp_ns > 0 else None
        message = _Message(arrival_ns, stamp, list(values))
        if len(message.values) != len(self._where[topic]):
            raise ValueError(
                f"{topic}: {plural(len(message.values), 'value')} for {plural(len(self._where[topic]), 'signal')}"
            )
        if topic == self.clock:
            return self._push_clock(state, message)
        if state.steps_back(message, self.max_gap_ns):
            state.start_anew(self._open, message)
        elif state.came_late(message):
            self.counters[f"late {topic}"] += 1
        if state.unwrap:
            state.unwrapped(message.values)
        state.keep(message, self._open)
        return []

    def _push_clock(self, state: _Topic, message: _Message) -> list[Step]:
        instant = message.stamp if state.header else message.arrival
        if instant is None:
            return [self._dropped(Status.UNSTAMPED, message.arrival, message)]
        steps: list[Step] = []
        status, dt = Status.FIRST, math.nan
        if self._open is not None:
            step = instant - self._instant(self._open)
            if step == 0:
                return [self._dropped(Status.EQUAL, instant, message)]
            if 0 < step < self.min_step_ns:
                return [self._dropped(Status.SHORT, instant, message)]
            if -self.max_gap_ns <= step < 0:
                return [self._dropped(Status.LATE, instant, message)]
            status = Status.OK if 0 < step <= self.max_gap_ns else Status.GAP if step > 0 else Status.RESET
            dt = step * 1e-9 if step > 0 else math.nan
        opens = status is not Status.OK  # a segment
        if opens:
            state.previous = list(state.steady)
        if state.unwrap:
            state.unwrapped(message.values)
        if (closing := self._open) is not None:
            z = self._fix(closing, final=True, reset=status is Status.RESET)
            if not self._one_topic:
                steps.append(self._step(self._open_status, closing, self._open_dt, self._before, z[: self._n]))
            self._before = z
        if opens:
            self._history = {}
        if self._one_topic:
            x_next = message.values if self._clock_is_x else self._states_of(message)
            steps.append(self._step(status, message, dt, self._before, x_next))
        self._open, self._open_status, self._open_dt = message, status, dt
        self.counters["samples"] += 1
        if status is Status.GAP:
            self.counters["gaps"] += 1
        elif status is Status.RESET:
            self.counters["resets"] += 1
        return steps

    def _states_of(self, message: _Message) -> list[float]:
        """States that a clock message carries (n,), NaN for the others."""
        x = [math.nan] * self._n
        for i, value in zip(self._where[self.clock], message.values, strict=True):
            if i < self._n:
                x[i] = value
        return x

    def _instant(self, sample: _Message) -> int:
        return sample.arrival if sample.stamp is None else sample.stamp

    def _dropped(self, status: Status, instant: int, message: _Message) -> Step:
        self.counters[status.value] += 1
        return Step(status, instant, message.arrival, math.nan, self._unknown, self._unknown[: self._n])

    def _step(
        self,
        status: Status,
        message: _Message,
        dt: float,
        before: list[float] | None,
        x_next: list[float],
    ) -> Step:
        if before is None or status is Status.FIRST or status is Status.RESET:
            before = self._unknown
        if status is Status.OK and not (all_finite(before) and all_finite(x_next)):
            status = Status.MISSING
            self.counters["missing"] += 1
        return Step(status, self._instant(message), message.arrival, dt, before, x_next)

    def _fix(self, sample: _Message, final: bool, reset: bool = False) -> list[float]:
        """z = [x; u] of the open sample from what has arrived; final: the sample closes now; reset: by a step back."""
        z = self._unknown.copy()
        for topic, where in self._where.items():
            span = self._span[topic]
            if topic == self.clock:
                chosen, age = sample, 0
            else:
                state = self._topics[topic]
                found = state.choose(sample)
                if final:
                    state.close(sample, found, reset)
                if found is None:
                    continue
                chosen, age = found, _behind(sample, found)
            if span is not None and (topic == self.clock or age <= self._least_max_age[topic]):
                z[span] = chosen.values
                continue
            for i, value in zip(where, chosen.values, strict=True):
                if topic == self.clock or age <= self._max_age[i]:
                    z[i] = value
                elif final:
                    self.counters[f"stale {self.signals[i].name}"] += 1
        for i, delay in self._delays:
            line = self._history.setdefault(i, deque(maxlen=delay + 1))
            line = line if final else line.copy()
            line.append(z[i])
            z[i] = line[0] if len(line) > delay else math.nan
        if final and not all_finite(z):
            for signal, value in zip(self.signals.signals, z, strict=True):
                if not math.isfinite(value):
                    self.counters[f"missing {signal.name}"] += 1
        return z

    def places(self, topic: str) -> tuple[list[int], list[int], list[int]]:
        """Where a topic's values stand in [x; u], the age up to which each may be used, ns, and which are unwrapped."""
        where = self._where[topic]
        return list(where), [self._max_age[i] for i in where], list(self._topics[topic].unwrap)

    def kept(self, topic: str) -> list[tuple[Told, Sequence[float]]]:
        """Messages of a topic that may still be chosen, in order of arrival."""
        return [(message.tell(), message.values) for message in self._topics[topic].kept]

    @property
    def delays(self) -> list[tuple[int, int]]:
        """Place in [x; u] of each delayed control, and by how many samples."""
        return list(self._delays)

    @property
    def one_topic(self) -> bool:
        """All states are on the clock topic; otherwise a step is decided when its second sample closes."""
        return self._one_topic

    def latest(self) -> tuple[int, list[float]] | None:
        """(t_ns, [x; u] (n + m)) of the open sample with what is known so far; None before the first sample."""
        if self._open is None:
            return None
        return self._instant(self._open), self._fix(self._open, final=False)

    def standing(self) -> Standing | None:
        """What is needed to go on elsewhere; None where messages have not come in order, or not yet long enough."""
        others = {topic: state for topic, state in self._topics.items() if topic != self.clock}
        if self._open is None or not all(state.in_order for state in others.values()):
            return None
        lines = [self._history.get(i, ()) for i, _ in self._delays]
        if any(len(line) < delay for line, (_, delay) in zip(lines, self._delays, strict=True)):
            return None
        if not self._one_topic and (self._open_status is not Status.OK or self._before is None):
            return None
        return Standing(
            (self._open.tell(), self._open.values),
            self._open_dt,
            self._unknown if self._before is None else self._before,
            {
                topic: (
                    state.last.get(state.header),
                    state.closed[-1][0].tell() if state.closed else None,
                    self.kept(topic),
                )
                for topic, state in others.items()
            },
            {topic: [state.previous[i] for i in state.unwrap] for topic, state in self._topics.items()},
            [list(line)[-delay:] for line, (_, delay) in zip(lines, self._delays, strict=True)],
        )

    def go_on(
        self,
        topics: Mapping[str, tuple[int | None, Sequence[tuple[Told, Sequence[float]]], Sequence[tuple[Told, Told]]]],
        previous: Mapping[str, Sequence[float]],
    ) -> None:
        """Messages were taken to elsewhere since `standing`; what they count for is told apart.

        Parameters
        ----------
        topics : mapping
            Of each topic but the clock's the instant of its last message, the messages that may still be chosen, and
            each sample closed meanwhile beside the message that it chose, `REMEMBERED_SAMPLES` of them at most.
        previous : mapping
            As in `Standing`.
        """
        for topic, (last, kept, closed) in topics.items():
            state = self._topics[topic]
            if last is not None:
                state.last[state.header] = last
            state.kept = deque(_Message.told(*message) for message in kept)
            state.closed.extend((_Message.told(told), _Message.told(chosen)) for told, chosen in closed)
        for topic, angles in previous.items():
            state = self._topics[topic]
            for i, angle in zip(state.unwrap, angles, strict=True):
                state.previous[i] = angle

    def go_on_from(
        self,
        sample: tuple[Told, Sequence[float]],
        dt: float,
        before: Sequence[float],
        lines: Sequence[Sequence[float]],
    ) -> None:
        """A sample was opened elsewhere; sample, dt, before and lines as in `Standing`."""
        self._open = _Message.told(*sample)
        self._open_status, self._open_dt, self._before = Status.OK, dt, list(before)
        for (i, delay), line in zip(self._delays, lines, strict=True):
            self._history[i] = deque(line, maxlen=delay + 1)


def all_finite(values: Sequence[float]) -> bool:
    """Whether all are finite."""
    return math.isfinite(sum(values)) or all(map(math.isfinite, values))  # a sum of finite numbers may overflow


def median_step_ns(instants: Sequence[NDArray[np.int64]], min_step_ns: int = 0) -> int | None:
    """Median of the forward steps of clock instants over all recordings, ns; None where there is no step.

    Equal stamps and steps back do not count; an instant less than min_step_ns after the one before is passed over,
    as the sampler does.
    """
    pooled = np.concatenate([np.empty(0, np.int64), *(_forward_steps(i, min_step_ns) for i in instants)])
    return int(np.median(pooled)) if pooled.size else None


def _forward_steps(instants: NDArray[np.int64], min_step_ns: int) -> NDArray[np.int64]:
    steps = np.diff(instants)
    forward = steps[steps > 0]
    if (forward >= min_step_ns).all():
        return forward
    longer = []
    last = int(instants[0])
    for instant in instants.tolist()[1:]:
        if instant - last >= min_step_ns:
            longer.append(instant - last)
        elif instant >= last:
            continue
        last = instant
    return np.array(longer, dtype=np.int64)


def resolve(
    signals: SignalMap,
    instants: Mapping[str, Sequence[NDArray[np.int64]]],
    time: Mapping[str, str],
) -> SignalMap:
    """Fill in clock, max_gap and time sources by the stated rules.

    Parameters
    ----------
    signals : SignalMap
    instants : mapping
        Per topic the instants of its messages in each recording, (messages,) ns, by that topic's time source.
    time : mapping
        Per topic `header` or `log`.

    Raises
    ------
    SignalError
        The clock has fewer than two distinct instants, or max_skew is given and no state is on another topic.
    """
    if signals.max_skew is not None and len({s.topic for s in signals.states}) == 1:
        raise SignalError(
            f"{signals.source}: max_skew limits the age of states from another topic than the clock, and all states "
            f"are on {signals.states[0].topic}; leave it out (the age of a control is limited by max_hold)"
        )
    min_step_ns = to_ns(signals.min_step)
    medians = {t: median_step_ns(instants[t], min_step_ns) for t in dict.fromkeys(s.topic for s in signals.states)}
    clock = signals.clock or max(medians, key=lambda t: medians[t] or 0)
    step = medians[clock]
    if step is None:
        count = sum(len(i) for i in instants[clock])
        raise SignalError(
            f"{clock}: {plural(count, 'message')} without a forward step in time, so no transition; "
            f"record longer, or set `topics: {{{clock}: {{time: log}}}}` if its stamps stand still"
        )
    max_gap = signals.max_gap if signals.max_gap is not None else min(2.5 * step * 1e-9, LONGEST_S)
    return replace(
        signals,
        clock=clock,
        max_gap=max_gap,
        time={t: "header" if time[t] == "header" else "log" for t in signals.topics},
    )
