# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The rules of `Sampler` on a whole recording at once, where its topics only ever go forward.

What a sample is fixed to depends on what had arrived when the next one came. In a recording all of that is there
at once, so the message with the greatest stamp at or before a sample is found by bisection among those that had
arrived. Left to the `Sampler`: time that steps back by more than max_gap, a topic that has some messages with a
stamp and some without beside a clock that goes by stamps, and messages that wait longer than it remembers them.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.sampling.angles import TURN, nearest_branch
from uncertain_lti.sampling.counters import INVALID, LATE, MISSING, TOO_OLD, Counters
from uncertain_lti.sampling.instants import to_ns
from uncertain_lti.sampling.recall import recall
from uncertain_lti.sampling.sampler import BUFFERED_MESSAGES, REMEMBERED_SAMPLES
from uncertain_lti.sampling.status import Status
from uncertain_lti.signals.field_path import FieldPath
from uncertain_lti.signals.functions import Memory
from uncertain_lti.signals.signal_map import SignalMap

Integers = NDArray[np.int64]
Values = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Samples:
    """Samples of one recording.

    `t_ns` (N,): instants, ns; `x` (N, n): states; NaN for what is missing; `held` (N, m + q): controls, then further
    scheduling signals; those of sample k act from t[k] on, and are NaN where nothing follows that they lead to; of a
    control at the arrival it is the value of sample k+1;
    `counters`: those of the `Sampler`.
    """

    t_ns: Integers
    x: Values
    held: Values
    counters: Counters


@dataclass(frozen=True)
class Decisions:
    """What became of each clock message of a recording, in the order in which it was decided.

    `arrival` (M,): arrival of the message that decided it, ns; `t_ns` (M,): its own instant, ns; `dropped` (M,): it
    made no sample. The others are the samples of `sample_arrays`, one after the other; `by` (M,): which clock message
    decided it, counted in order of arrival.
    """

    arrival: Integers
    t_ns: Integers
    dropped: Mask
    by: Integers


class _BackwardError(Exception):
    """This recording is left to the Sampler."""


def sample_arrays(
    signals: SignalMap, topic: Integers, arrival: Integers, stamp: Integers, values: Sequence[Values]
) -> Samples | None:
    """Samples as the `Sampler` gives them, to the last bit and count; None where it has to be asked.

    `topic` (messages,): position in `signals.topics` of each message, in order of arrival; `arrival` (messages,): log
    time, ns; `stamp` (messages,): header stamp, ns; zero or less where there is none; `values` (messages of the topic,
    signals on it): one array per topic.
    """
    if (arrival[1:] < arrival[:-1]).any():
        return None
    try:
        return _Sampling(signals, topic, arrival, stamp, values).run()
    except _BackwardError:
        return None


def decided(
    signals: SignalMap, topic: Integers, arrival: Integers, stamp: Integers, values: Sequence[Values]
) -> Decisions:
    """When the `Sampler` decides each clock message.

    A sample is decided by its own message, or, where that lacks states or controls of its instant
    (`SignalMap.decided_at_once`), by the next one that opens a sample; without a next one it is not decided. A message
    that is dropped is decided at once.

    `topic` (messages,): as for `sample_arrays`, in any order of time; `arrival` (messages,): as for `sample_arrays`;
    `stamp` (messages,): as for `sample_arrays`; `values` (messages of the topic, signals on it): as for
    `sample_arrays`.
    """
    sampling = _Sampling(signals, topic, arrival, stamp, values)
    clock = sampling.topics[signals.clock or ""]
    by_header = signals.time[signals.clock or ""] == "header"
    usable = clock.stamp > 0 if by_header else np.ones(len(clock.order), dtype=bool)
    instants = np.where(usable, clock.stamp, clock.arrival) if by_header else clock.arrival
    kept = np.flatnonzero(usable)[sampling._accepted(instants[usable])[0]]
    dropped = np.ones(len(instants), dtype=bool)
    dropped[kept] = False
    by = np.arange(len(instants))  # position of the message that decides
    if not signals.decided_at_once:
        by[kept[:-1]] = kept[1:]
        by[kept[-1:]] = len(instants)
    order = np.lexsort((np.arange(len(by)), ~dropped, by))
    order = order[by[order] < len(instants)]
    return Decisions(clock.arrival[by[order]], instants[order], dropped[order], by[order])


@dataclass(frozen=True)
class _Messages:
    """Messages of one topic; order is their place among all, stamp 0 or less where none counts."""

    order: Integers
    arrival: Integers
    stamp: Integers
    values: Values

    def take(self, which: Mask | Integers) -> _Messages:
        return _Messages(self.order[which], self.arrival[which], self.stamp[which], self.values[which])


class _Sampling:
    def __init__(
        self, signals: SignalMap, topic: Integers, arrival: Integers, stamp: Integers, values: Sequence[Values]
    ) -> None:
        assert signals.max_gap is not None and signals.clock is not None
        self.signals = signals
        self.n = len(signals.states)
        self.max_gap, self.min_step = to_ns(signals.max_gap), to_ns(signals.min_step)
        self.max_age = [to_ns(signals.longest_age(i)) for i in range(len(signals))]
        self.counters: Counters = Counters()
        self.topics: dict[str, _Messages] = {}
        for position, name in enumerate(signals.topics):
            order = np.flatnonzero(topic == position)
            usable = stamp[order] if signals.time[name] == "header" else np.zeros_like(order)
            self.topics[name] = _Messages(order, arrival[order], usable, self._admitted(name, values[position]))

    def run(self) -> Samples:
        """All samples; raises _BackwardError."""
        signals = self.signals
        assert signals.clock is not None
        by_header = signals.time[signals.clock] == "header"
        messages = self.topics.pop(signals.clock)
        if by_header:
            usable = messages.stamp > 0
            self._count(Status.UNSTAMPED.value, ~usable)
            messages = messages.take(usable)
        kept, opens, back = self._accepted(messages.stamp if by_header else messages.arrival)
        if back.any() and self.topics:
            raise _BackwardError
        samples = messages.take(kept)
        self._count("samples", np.ones(len(kept), dtype=bool))
        self._count("gaps", opens[1:] & ~back[1:])
        self._count("resets", back)
        own = self._unwrapped(signals.clock, samples.values, opens)

        closed = max(len(kept) - 1, 0)
        z = np.full((closed, len(signals.signals)), math.nan)
        z[:, signals.on(signals.clock)] = own[:closed]
        for name, others in self.topics.items():
            self._fix(name, others, samples, z)
        self._recall(z, samples.stamp if by_header else samples.arrival, opens)
        for signal, column in zip(signals.signals, z.T, strict=True):
            self._count_of(MISSING, signal.name, ~np.isfinite(column))
        return self._samples(samples.stamp if by_header else samples.arrival, z, own, opens, back)

    def _admitted(self, topic: str, values: Values) -> Values:
        """Values with NaN for those that do not count, which are counted."""
        result = values
        for column, position in enumerate(self.signals.on(topic)):
            signal = self.signals[position]
            if signal.valid is None and not signal.ignore:
                continue
            low, high = signal.valid or (-math.inf, math.inf)
            own = values[:, column]
            refused = (own < low) | (own > high) | np.isin(own, list(signal.ignored))
            self._count_of(INVALID, signal.name, refused)
            result = result.copy() if result is values else result
            result[refused, column] = math.nan
        return result

    def _count(self, what: str, which: Mask) -> None:
        if number := int(np.count_nonzero(which)):
            self.counters[what] += number

    def _count_of(self, kind: str, name: str, which: Mask) -> None:
        if number := int(np.count_nonzero(which)):
            self.counters.add(kind, name, number)

    def _accepted(self, instants: Integers) -> tuple[Integers, Mask, Mask]:
        """Clock messages that make samples; which of these open a segment, and which step back to do so."""
        steps = np.diff(instants)
        if (steps >= max(self.min_step, 1)).all():
            kept = np.arange(len(instants))
        else:  # dropping one changes the step of the next, so one after the other
            positions: list[int] = []
            last = 0
            for position, instant in enumerate(instants.tolist()):
                step = instant - last
                if not positions or step < -self.max_gap or step >= max(self.min_step, 1):
                    positions.append(position)
                    last = instant
                else:
                    self.counters[(Status.SHORT if step > 0 else Status.LATE if step else Status.EQUAL).value] += 1
            kept = np.array(positions, dtype=np.int64)
            steps = np.diff(instants[kept])
        opens, back = np.ones(len(kept), dtype=bool), np.zeros(len(kept), dtype=bool)
        opens[1:] = (steps > self.max_gap) | (steps < 0)
        back[1:] = steps < 0
        return kept, opens, back

    def _unwrapped(self, topic: str, values: Values, opens: Mask) -> Values:
        """Values with angles on the branch nearest to the one before, or to steady where `opens`."""
        result = values
        for column, position in enumerate(self.signals.on(topic)):
            signal = self.signals[position]
            if FieldPath(signal.field).unwrap:
                result = result.copy() if result is values else result
                result[:, column] = _unwrap(values[:, column], self.signals.branch(position), opens)
        return result

    def _fix(self, name: str, others: _Messages, samples: _Messages, z: Values) -> None:
        """Fill in what the samples take from another topic than the clock."""
        stamped = others.stamp > 0
        for instants in (others.stamp[stamped], others.arrival[~stamped]):
            if (np.diff(instants) < -self.max_gap).any():
                raise _BackwardError
        if self.signals.time[self.signals.clock or ""] == "log" or not stamped.any():
            time, at = others.arrival, samples.arrival
        elif stamped.all():
            time, at = others.stamp, samples.stamp
        else:
            raise _BackwardError
        arrived = np.searchsorted(others.order, samples.order[1:])  # how many had, when each sample closed
        chosen = _latest(time, at[:-1], arrived)
        opened = np.searchsorted(others.order, samples.order[:-1])
        if (opened - chosen >= BUFFERED_MESSAGES // 2)[chosen >= 0].any():
            raise _BackwardError  # the Sampler may have forgotten it before the sample opened
        self._count_of(LATE, name, self._late(others, samples, time, at[:-1], chosen))

        values = self._unwrapped(name, others.values, np.zeros(len(others.order), dtype=bool))
        there = chosen >= 0
        which = chosen[there]
        age = at[:-1][there] - time[which]
        for column, position in enumerate(self.signals.on(name)):
            fresh = age <= self.max_age[position]
            self._count_of(TOO_OLD, self.signals[position].name, ~fresh)
            z[there, position] = np.where(fresh, values[which, column], math.nan)

    def _late(self, others: _Messages, samples: _Messages, time: Integers, at: Integers, chosen: Integers) -> Mask:
        """Messages that a closed sample would have chosen: if any, the first of those after them does."""
        closed = np.searchsorted(samples.order, others.order) - 1  # samples closed when each message arrived
        first = np.maximum(np.searchsorted(at, time), closed - REMEMBERED_SAMPLES)
        after = np.flatnonzero(first < closed)
        before = chosen[first[after]]
        late = np.zeros(len(time), dtype=bool)
        late[after] = (before < 0) | (time[before] <= time[after])
        return late

    def _recall(self, z: Values, instants: Integers, opens: Mask) -> None:
        """Shift, or take the differences of, what follows from earlier samples of the segment."""
        step = self.signals.step
        dt = np.diff(instants, prepend=0)[: len(z)] * 1e-9 if isinstance(step, str) else np.full(len(z), step)
        for position, signal in enumerate(self.signals):
            memory = Memory("lag", signal.delay) if signal.delay else signal.memory
            if memory is not None:
                z[:, position] = recall(z[:, position], memory, dt, opens[: len(z)])

    def _samples(self, instants: Integers, z: Values, own: Values, opens: Mask, back: Mask) -> Samples:
        n, on_clock = self.n, self.signals.on(self.signals.clock or "")
        if self.signals.decided_at_once:  # when the sample opens
            at_end = np.full((len(instants), len(self.signals)), math.nan)
            at_end[:, on_clock] = own
        else:
            at_end = z.copy()
            for position in self.signals.arrivals:
                at_end[back[1 : len(z) + 1], position] = math.nan
        count = len(at_end)
        x, held = at_end[:, :n].copy(), np.full((count, len(self.signals.held)), math.nan)
        held[:-1] = z[: max(count - 1, 0), n:]
        for position in self.signals.arrivals:
            held[:-1, position - n] = at_end[1:, position]
        held[:-1][back[1:count]] = math.nan
        for position in known_of_the_last(self.signals):
            held[-1:, position - n] = at_end[-1:, position]
        finite: Mask = np.asarray(np.isfinite(x).all(axis=1))
        known: Mask = finite[:-1] & np.isfinite(held[:-1]).all(axis=1)
        self._count("missing", ~opens[1:count] & ~(known & finite[1:]))
        return Samples(instants[:count].copy(), x, held, self.counters)


def known_of_the_last(signals: SignalMap) -> list[int]:
    """Positions of the controls that the last sample of a recording has, although it is not closed."""
    if not signals.decided_at_once:
        return []
    held = [i for i in signals.on(signals.clock or "") if i >= len(signals.states)]
    return [i for i in held if signals[i].at == "departure" and not signals[i].delay and not signals[i].memory]


def _latest(time: Integers, at: Integers, arrived: Integers) -> Integers:
    """For each of `at` the message with the greatest time until then, ties to the last, among the first `arrived`.

    -1 where there is none.
    """
    if (time[1:] >= time[:-1]).all():
        return np.minimum(np.searchsorted(time, at, side="right"), arrived) - 1
    waiting: list[tuple[int, int]] = []
    every = time.tolist()
    chosen = []
    for until, count in zip(at.tolist(), arrived.tolist(), strict=True):
        for number in range(len(waiting), count):
            bisect.insort(waiting, (every[number], number))
        place = bisect.bisect_right(waiting, (until, count)) - 1
        chosen.append(waiting[place][1] if place >= 0 else -1)
    return np.array(chosen, dtype=np.int64)


def _unwrap(values: Values, steady: float, opens: Mask) -> Values:
    """Each angle on the branch nearest to the last finite one, or to steady where there is none since `opens`."""
    result = values + 0.0
    finite = np.flatnonzero(np.isfinite(values))
    if not len(finite):
        return result
    segment = np.cumsum(opens)[finite]
    last = np.concatenate([[steady], result[finite[:-1]]])
    last[1:][segment[1:] != segment[:-1]] = steady
    with np.errstate(over="ignore", invalid="ignore"):
        near = np.abs(last - values[finite]) < 0.49 * TURN
    if near.all():  # the usual case: no turn to add
        return np.where(np.isfinite(values), result, values)
    previous = steady
    begins = opens.tolist()
    unwrapped = values.tolist()
    for i, value in enumerate(unwrapped):
        if begins[i]:
            previous = steady
        if math.isfinite(value):
            try:
                unwrapped[i] = previous = nearest_branch(value, previous)
            except OverflowError:
                raise _BackwardError from None
    return np.array(unwrapped)
