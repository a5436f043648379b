# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The steady state and scales that a signals file leaves open, without numbers that stand for no value."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from uncertain_lti.base.arrays import Array, runs
from uncertain_lti.kernel.arithmetic import stretches
from uncertain_lti.signals.signal_map import Signal

CODE_APART, CODE_OTHERS, CODE_LEAST, CODE_SIZE, MOST_CODES = 300.0, 10, 900.0, 1e9, 4
"""What makes a number one that stands for no value: distance over the range of the others, of which there are so many,
and its least size; or its size alone. At most so many are told apart."""


def too_small(low: float, high: float) -> bool:
    """Whether no number of a range can stand for no value."""
    return -CODE_LEAST < low and high < CODE_LEAST


def codes(values: Array) -> dict[float, int]:
    """Numbers that stand for no value, such as 2.146e9 as a position.

    A number is one if it is the least or the greatest of all, at least CODE_LEAST, stands there exactly several times,
    and lies CODE_APART times as far from the others as these spread; or if it is beyond CODE_SIZE where the others stay
    below a thousandth.

    `values` (samples,): in recorded units.
    """
    if len(values) and too_small(float(values.min()), float(values.max())):
        return {}  # the usual case, in a fraction of the time
    rest = values[np.isfinite(values)]
    found: dict[float, int] = {}
    while len(rest) and len(found) < MOST_CODES:
        for extreme in (float(rest.max()), float(rest.min())):
            others = rest[rest != extreme]
            count = len(rest) - len(others)
            if not len(others):
                return found
            low, high = float(others.min()), float(others.max())
            apart = max(extreme - high, low - extreme)
            several = count > 1 and abs(extreme) >= CODE_LEAST and apart > CODE_APART * (high - low)
            several = several and len(np.unique(others[:1000])) >= CODE_OTHERS
            if several or (abs(extreme) >= CODE_SIZE and max(abs(low), abs(high)) < 1e-3 * CODE_SIZE):
                found[extreme], rest = count, others
                break
        else:
            return found
    return found


SHARED_LEAST, SHARED_APART, SHARED_BY = 99.0, 0.1, 3
"""What makes a whole number of several columns one that stands for no value: its least size, how far from the others of
each of so many columns it lies, over their range; and farther than the range of one of them."""


def shared_codes(columns: Sequence[Array]) -> set[float]:
    """Numbers that stand for no value in a table, such as -200 of each sensor: the least, or greatest, of several."""
    apart: dict[float, list[float]] = {}
    for values in columns:
        rest = values[np.isfinite(values)]
        for extreme in {float(rest.min()), float(rest.max())} if len(rest) else ():
            others = rest[rest != extreme]
            if extreme % 1 == 0 and abs(extreme) >= SHARED_LEAST and 0 < len(others) < len(rest) - 1:
                low, high = float(others.min()), float(others.max())
                far = max(extreme - high, low - extreme) / ((high - low) or 1.0)
                apart.setdefault(extreme, []).extend([far] * (far > SHARED_APART))
    return {code for code, each in apart.items() if len(each) >= SHARED_BY and max(each) > 1.0}


STILL_SAMPLES = 10
"""A still stretch has at least this many samples."""
STILL_BAND = 0.05
"""In a still stretch every signal stays within this share of its own range; doubled until there is one."""
STOP_OTHERS, STOP_SHARE, STOP_SPEED = 20, 0.5, 0.5
"""What makes a signal's extreme value an end stop: so many other values that it takes, the share of a stretch that is
there, and the speed at which it arrives, relative to its usual one."""


def still_stretches(values: Array, span: Array, band: float = STILL_BAND) -> list[tuple[int, int]]:
    """Disjoint stretches [start, stop) in which every column stays within band x span.

    Greedy from the left: a stretch grows while the difference between its greatest and least value is at most
    band x span in every column, and counts from STILL_SAMPLES samples on. A value that is not finite ends it.

    `values` (samples, signals): recorded units; `span` (signals,): range of each signal over all recordings.
    """
    return stretches(values, band * span, STILL_SAMPLES)


def end_stops(recordings: Sequence[Array]) -> list[list[float]]:
    """Values at which signals are held by a limit: saturated sensors, joints at their stops, clipped commands.

    The least or the greatest value of a signal is one if the signal takes STOP_OTHERS other values, is held there
    exactly for STILL_SAMPLES samples, and arrives at it at STOP_SPEED of its usual speed: what settles by itself slows
    down first, as the temperature of a machine that cools does. 0 is none; it is where machines rest.

    `recordings` (samples, signals): in recorded units; NaN where there is none.
    """
    found: list[list[float]] = []
    for j in range(recordings[0].shape[1] if recordings else 0):
        columns = [r[:, j] for r in recordings]
        pooled = np.concatenate(columns)
        pooled = pooled[np.isfinite(pooled)]
        ends = {float(pooled.min()), float(pooled.max())} - {0.0} if len(pooled) else set()
        moving = np.concatenate([np.abs(np.diff(c)) for c in columns])
        moving = moving[moving > 0]  # NaN compares false
        stops = []
        for end in sorted(ends):
            if np.count_nonzero(pooled == end) < STILL_SAMPLES or len(np.unique(pooled)) <= STOP_OTHERS:
                continue
            speeds = [speed for c in columns for speed in _arrivals(c, end)]
            if speeds and np.median(speeds) >= STOP_SPEED * np.median(moving):
                stops.append(end)
        found.append(stops)
    return found


def _at(values: Array, stops: Iterable[float]) -> bool:
    """Whether a signal (samples,) is at an end stop for most of a stretch."""
    return any(np.mean(values == stop) >= STOP_SHARE for stop in stops)


def _arrivals(column: Array, end: float) -> list[float]:
    """Mean step over the samples before each time that a signal comes to be held at a value."""
    speeds = []
    for start, stop in runs(column == end):
        before = column[max(start - STILL_SAMPLES, 0) : start]
        if stop - start >= STILL_SAMPLES and len(before) > 1 and np.isfinite(before).all():
            speeds.append(float(np.abs(np.diff(before)).mean()))
    return speeds


def resolve_auto(signals: Sequence[Signal], recordings: Sequence[Array]) -> tuple[list[float], list[float], str]:
    """Numbers for steady and scale where a signal says auto, and the rule applied, in words.

    steady: median over the longest still stretch (see `still_stretches`; the band is doubled until a stretch is found),
    without `codes`, and if there is another one without those at `end_stops`. scale: the largest magnitude of the
    medians over all still stretches of all recordings, measured in recorded units, or the range (largest less least
    value) where that is 0, or 1 where the range is 0 too.

    `recordings` (samples, signals): in recorded units.
    """
    pooled = np.concatenate(recordings, dtype=float)
    pooled[~np.isfinite(pooled)] = np.nan
    finite = np.split(pooled, np.cumsum([len(r) for r in recordings])[:-1])  # no copies: there may be much of it
    left = []
    for j, signal in enumerate(signals):  # of a number that stands for none there is no steady state
        for code, count in codes(pooled[:, j]).items():
            left.append(f"{signal.name} {code:.9g} in {count}")
            pooled[pooled[:, j] == code, j] = np.nan
    seen = np.isfinite(pooled).any(axis=0)
    span = np.zeros(len(signals))
    ends = (end.reduce(pooled, axis=0, initial=np.nan) for end in (np.fmax, np.fmin))
    span[seen] = np.subtract(*ends)[seen]
    for band in (STILL_BAND * 2.0**k for k in range(7)):  # up to beyond every range
        found = [r[a:b] for r in finite for a, b in still_stretches(r, span, band)]
        if found:
            break
    if found:
        medians = np.array([np.median(part, axis=0) for part in found])
        stops = end_stops(finite)
        first = [{float(r[0, j]) for r in finite if len(r)} for j in range(len(signals))]
        held = [[j for j in range(len(signals)) if _at(part[:, j], stops[j])] for part in found]
        lengths = list(map(len, found))
        longest = int(np.argmax(lengths))

        def rank(k: int) -> tuple[int, int]:
            """Away from end stops; else at none but those at which a recording begins, as machines do at rest."""
            begins = all(_at(found[k][:, j], first[j] & set(stops[j])) for j in held[k])
            return 2 if not held[k] else int(begins), lengths[k]

        chosen = max(range(len(found)), key=rank)
        still = medians[chosen]
        words = f"{lengths[chosen]} still samples (every signal within {band:.0%} of its range)"
        if held[longest] and not rank(longest)[0]:
            names = ", ".join(signals[j].name for j in held[longest])
            at_stop = f"with {names} at an end stop"
            words += f", all of them {at_stop}: give `steady` yourself" * (chosen == longest)
            words += f", not the {lengths[longest]} {at_stop}" * (chosen != longest)
    else:  # fewer than STILL_SAMPLES finite samples in a row
        still = np.zeros(len(signals))
        still[seen] = np.nanmedian(pooled[:, seen], axis=0)
        medians = still[None, :]
        words = "all samples (no still stretch)"
    if left:
        words += f", without samples that seem to stand for no value ({', '.join(left)})"
    magnitude = np.abs(medians).max(axis=0)
    scales = np.where(magnitude > 1e-9 * span, magnitude, span)
    scales = np.where(scales > 0, scales, 1.0)
    steady = [float(still[i]) if s.steady == "auto" else float(s.steady) for i, s in enumerate(signals)]
    scale = [float(scales[i]) if s.scale == "auto" else float(s.scale) for i, s in enumerate(signals)]
    return steady, scale, words
