# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The clock: whole nanoseconds, the status of each of its messages, and what a signals file leaves open of it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import LONGEST_S
from uncertain_lti.base.errors import SignalError
from uncertain_lti.base.text import plural
from uncertain_lti.signals.signal_map import SignalMap, TimeSource


class Status(StrEnum):
    """What became of one clock message."""

    OK = "ok"  # the transition that ends in this sample can be judged
    FIRST = "first"  # first sample of a recording
    RESET = "reset"  # time stepped back by more than max_gap: first sample of a new segment
    GAP = "gap"  # the step is longer than max_gap: first sample of a new segment
    MISSING = "missing"  # a signal at either end is missing, stale, not finite, or too large for the bounds
    STEP = "step out of range"  # the step is shorter or longer than those that the model was fitted to
    MODE = "mode not in the model"  # the scheduling signal has a value that the model does not list
    FROZEN = "frozen"  # a state repeats exactly although the nominal model moves it: no value of this instant
    UNASKED = "outside the time asked for"  # a check from one instant to another leaves the rest alone
    EQUAL = "equal stamp"  # dropped: the instant of the sample before
    SHORT = "short step"  # dropped: less than min_step after the sample before
    LATE = "late"  # dropped: at most max_gap before the sample before
    UNSTAMPED = "no stamp"  # dropped: header time is wanted and the stamp is zero

    @property
    def dropped(self) -> bool:
        """The message made no sample."""
        return self in (Status.EQUAL, Status.SHORT, Status.LATE, Status.UNSTAMPED)


_LONGEST, _LONGEST_REMEMBERED = 2.5, 1.5
"""Median steps up to which a longer one is no gap; of signals that recall others one over a lost sample is: what they
recall is of another time there."""
_JITTERING = 0.01
"""Share of steps beyond the shorter of these from which on it is jitter and no loss."""
LATE, TOO_OLD, MISSING, INVALID = "late", "stale", "missing", "invalid"
"""Kinds that are counted per topic (late) or per signal."""


class Counters(Counter[str]):
    """Counts by flat name, as diagnostics and `--json` show them: `samples`, `gaps`, `late /topic`, `stale signal`.

    `of` gives the counts of one kind by topic or signal, so that nobody takes the names apart.
    """

    def add(self, kind: str, name: str, count: int = 1) -> None:
        """Count something of a topic or signal."""
        self[f"{kind} {name}"] += count

    def of(self, kind: str) -> dict[str, int]:
        """Counts of one kind."""
        start = f"{kind} "
        return {key[len(start) :]: count for key, count in self.items() if key.startswith(start) and count}


_EVEN, _COARSE, _PAUSE = 200, 8, 10
"""Steps over which an even clock is told from one that loses samples; most units in a step that is coarse; times that a
pause between bursts is longer than most steps."""
LONGEST_NS = 2**62
"""Longer than any recording; what is longer still counts as this."""


def to_ns(seconds: float) -> int:
    """Seconds to whole nanoseconds."""
    if abs(seconds) < LONGEST_NS * 1e-9:
        return round(seconds * 1e9)
    return -LONGEST_NS if seconds < 0 else LONGEST_NS


def median_step_ns(instants: Sequence[NDArray[np.int64]], min_step_ns: int = 0) -> int | None:
    """Median of the forward steps of clock instants over all recordings.

    Equal stamps and steps back do not count; an instant less than min_step_ns after the one before is passed over,
    as the sampler does.

    `instants` (messages,): of each recording, ns.
    """
    steps = _pooled(instants, min_step_ns)
    return int(np.median(steps)) if steps.size else None


def passed(t_ns: NDArray[np.int64]) -> float:
    """Time from the first to the last of some instants, s; a step back of the clock, which begins anew, takes none."""
    return float(np.maximum(np.diff(t_ns), 0).sum()) * 1e-9


def longest_step(instants: Sequence[NDArray[np.int64]], min_step_ns: int = 0, recalls: bool = False) -> float:
    """Longest step that is no gap where nobody says, s; inf without a forward step.

    `instants` (messages,): of each recording, ns; `recalls`: some signals are earlier values of others.
    """
    steps = _pooled(instants, min_step_ns)
    if not steps.size:
        return math.inf
    step = int(np.median(steps))
    even = recalls and np.count_nonzero(steps > _LONGEST_REMEMBERED * step) <= _JITTERING * len(steps)
    return min((_LONGEST_REMEMBERED if even else _LONGEST) * step * 1e-9, LONGEST_S)


def _pooled(instants: Sequence[NDArray[np.int64]], min_step_ns: int) -> NDArray[np.int64]:
    return np.concatenate([np.empty(0, np.int64), *(_forward_steps(i, min_step_ns) for i in instants)])


def _forward_steps(instants: NDArray[np.int64], min_step_ns: int) -> NDArray[np.int64]:
    steps = np.diff(instants)
    forward = steps[steps > 0]
    if (forward >= min_step_ns).all():
        return forward
    longer, last = [], int(instants[0])
    for instant in instants.tolist()[1:]:
        if instant - last >= min_step_ns:
            longer.append(instant - last)
        elif instant >= last:
            continue
        last = instant
    return np.array(longer, dtype=np.int64)


def period_ns(instants: Sequence[NDArray[np.int64]], min_step_ns: int) -> int:
    """Period of a clock that samples evenly, whatever its stamps do, over all recordings, of which one moves forward.

    The median of the time that 100 samples take (fewer of short recordings), divided by their number: a stamp that is
    late, or a sample that is lost, changes few of these.

    `instants` (messages,): of each recording, ns.
    """
    steps = [_forward_steps(i, min_step_ns) for i in instants]
    over = max(1, min(100, max(map(len, steps)) // 4))
    times = [np.concatenate([np.zeros(1, np.int64), np.cumsum(s)]) for s in steps]
    return max(1, round(float(np.median(np.concatenate([t[over:] - t[:-over] for t in times]))) / over))


def coarse_ns(instants: Sequence[NDArray[np.int64]]) -> int | None:
    """Unit to which an even clock's stamps are rounded, so coarse that its steps differ; None if no such clock.

    Stamps of even samples stay within rounding of a line; where samples are lost, or uneven, they leave it. There is no
    such clock of recordings that each have a rate of their own.

    `instants` (messages,): of each recording, ns.
    """
    of_each = [np.diff(i) for i in instants if len(i) > 1]
    steps = np.concatenate([np.empty(0, np.int64), *of_each])
    if len(steps) < _EVEN or steps.min() <= 0:
        return None
    unit, usual, own = int(np.gcd.reduce(steps)), int(np.median(steps)), [int(np.median(each)) for each in of_each]
    same = np.concatenate([each == middle for each, middle in zip(of_each, own, strict=True)])
    if usual > _COARSE * unit or same.mean() > 0.99 or max(own) - min(own) > unit:
        return None
    count, line = np.arange(_EVEN + 1), []
    for each in instants:
        for start in range(0, len(each) - _EVEN, _EVEN):
            part = each[start : start + _EVEN + 1] - each[start]
            if np.diff(part).max() <= usual + 2 * unit:  # no break in it
                line.append(np.ptp(part - np.polyval(np.polyfit(count, part, 1), count)) <= 1.6 * unit)
    return unit if line and np.mean(line) >= 0.8 else None


def even_ns(stamps: Sequence[NDArray[np.int64]]) -> int | None:
    """Period of a clock nearly all of whose steps are the same (messages,), ns; None if they are not."""
    steps = _pooled(stamps, 0)
    period = int(np.median(steps)) if len(steps) >= _EVEN else 0
    return period if period > 0 and np.mean(np.abs(steps - period) <= 0.02 * period) >= 0.98 else None


def longest_pause(instants: Sequence[NDArray[np.int64]]) -> float | None:
    """Longest step that is no gap of an even clock whose messages come in bursts, s; None if no such clock.

    However they come, a hundred take about the same time.

    `instants` (messages,): of each recording, ns.
    """
    steps = _pooled(instants, 0)
    pauses = steps[steps > _PAUSE * np.median(steps)] if len(steps) >= _EVEN else steps[:0]
    if len(pauses) < 0.02 * len(steps) or pauses.sum() <= 0.9 * steps.sum():
        return None
    short, long = np.percentile(np.concatenate([i[100:] - i[:-100] for i in instants]), [10, 90])
    return round(1.5e-9 * float(np.percentile(pauses, 99)), 3) if 0 < long < 1.5 * short else None


def resolve(
    signals: SignalMap,
    instants: Mapping[str, Sequence[NDArray[np.int64]]],
    time: Mapping[str, str],
) -> SignalMap:
    """Fill in clock, max_gap, a constant step and time sources by the stated rules."""
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
        remedy = f"record longer, or set `topics: {{{clock}: {{time: log}}}}` if its stamps stand still"
        none = f"{plural(count, 'message')} without a forward step in time, so no transition"
        raise SignalError(f"{signals.source}: {clock}: {none}; {remedy}")
    max_gap, constant = signals.max_gap, signals.step
    if max_gap is None:
        max_gap = longest_step(instants[clock], min_step_ns, bool(signals.recalled))
    if constant == "constant":
        constant = period_ns(instants[clock], min_step_ns) * 1e-9
    sources: dict[str, TimeSource] = {t: "header" if time[t] == "header" else "log" for t in signals.topics}
    return replace(signals, clock=clock, max_gap=max_gap, step=constant, time=sources)
