# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Long recordings drawn by pixel: what of them each column of a figure shows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array, Mask
from uncertain_lti.monitor.verdicts import Verdicts
from uncertain_lti.sampling.transient import Transient

PIXELS = 1200
"""Stretches of time that a longer recording is drawn in."""


def forward(t: Array) -> tuple[Array, int]:
    """Times that never go back: after a step back the next pass follows the one before.

    `t` (samples,): times, s; Returns (samples,): the same, or counted from 0 where there is a step back, s.
    """
    steps = np.diff(t)
    loops = int((steps < 0).sum())
    if not loops:
        return t, 0
    ahead = steps[steps > 0]
    steps[steps < 0] = float(np.median(ahead)) if len(ahead) else 1.0
    return np.concatenate([[0.0], np.cumsum(steps)]), loops


class TimeAxis:
    """Time axis of a recording: s since the first sample; the passes of a looped one follow each other.

    `transient`: the recording.
    """

    def __init__(self, transient: Transient) -> None:
        self.t, self.loops = forward(transient.t)

    @property
    def label(self) -> str:
        """Label of the axis, which says when passes were put one behind the other."""
        return "time [s]" + (f", {self.loops + 1} passes one behind the other" if self.loops else "")


@dataclass(frozen=True)
class DrawnColumns:
    """What of a recording is drawn: its samples, or stretches of time with all of their samples.

    `t` (P,): where each is drawn, s; `starts` (P,): first sample of each; `stop`: end of the last one; `binned`:
    whether they are stretches of time, not samples; `judged, alarm` (P,): whether any of its samples has a verdict, and
    an alarm; `after` (P,): whether something lies between it and the one before; `edges` (P, 2): begin and end of each,
    s.
    """

    t: Array
    starts: NDArray[np.intp]
    stop: int
    binned: bool
    judged: Mask
    alarm: Mask
    after: Mask
    edges: Array

    @classmethod
    def of(cls, verdicts: Verdicts, t: Array, span: tuple[float, float] | None, always: bool = False) -> DrawnColumns:
        """Choose what is drawn of a recording.

        `t` (samples,): times, s, of its `TimeAxis`.
        """
        first, stop = 0, len(t)
        if span is not None:
            first, stop = int(np.searchsorted(t, span[0])), int(np.searchsorted(t, span[1], side="right"))
        here = t[first:stop]
        count = len(here)
        broken = np.zeros(count, dtype=bool)
        broken[1:] = np.diff(verdicts.transient.segment[first:stop]) != 0
        if count <= 2 * PIXELS and not always:
            starts = np.arange(first, stop)
            before = np.concatenate([here[:1], here[:-1]])
            judged, alarm = verdicts.judged[first:stop], verdicts.alarm[first:stop]
            return cls(here, starts, stop, False, judged, alarm, broken, np.column_stack([before, here]))
        low, high = (float(here[0]), float(here[-1])) if count else (0.0, 1.0)
        cells = np.linspace(low, high if high > low else low + 1.0, min(PIXELS, max(count, 1)) + 1)
        places = np.searchsorted(here, cells[:-1])
        ends = np.append(places[1:], count)
        filled = np.flatnonzero(ends > places)
        starts = (places[filled] + first).astype(np.intp)
        any_of = [np.logical_or.reduceat(a[:stop], starts) for a in (verdicts.judged, verdicts.alarm)]
        centre = (cells[filled] + cells[filled + 1]) / 2
        after = np.zeros(len(filled), dtype=bool)
        after[1:] = np.diff(filled) > 1
        return cls(
            centre, starts, stop, True, any_of[0], any_of[1], after, np.column_stack([cells[filled], cells[filled + 1]])
        )

    @classmethod
    def detailed(
        cls, t: Array, segment: NDArray[np.int32], judged: Mask, alarm: Mask, near: Mask, most: int
    ) -> DrawnColumns:
        """Every sample if there are few; else stretches of samples, and every sample around some instants.

        `t` (samples,): times, s, of a `TimeAxis`; `segment` (samples,): changes where two samples are not joined;
        `judged, alarm` (samples,): whether a sample has a verdict, and an alarm; `near` (samples,): instants that are
        worth every sample around them.
        """
        count = len(t)
        broken = np.zeros(count, dtype=bool)
        broken[1:] = np.diff(segment) != 0
        chosen = np.ones(count, dtype=bool)
        if count > most:
            chosen = broken | (np.arange(count) % math.ceil(2 * count / most) == 0)
            onsets = np.flatnonzero(near & ~np.concatenate([[False], near[:-1]]))
            onsets = onsets[:: math.ceil(len(onsets) / max(most // 20, 1)) or 1]
            reach = min(most // (4 * max(len(onsets), 1)), 2000)
            change = np.zeros(count + 1, dtype=np.int64)
            np.add.at(change, np.maximum(onsets - reach, 0), 1)
            np.add.at(change, np.minimum(onsets + reach + 1, count), -1)
            inside = np.cumsum(change)[:count] > 0
            chosen |= inside | np.concatenate([[False], inside[:-1]])
            chosen[:1] = True
        starts = np.flatnonzero(chosen)
        last = np.append(starts[1:], count)[: len(starts)] - 1
        any_of = [np.logical_or.reduceat(a, starts) if count else a for a in (judged, alarm)]
        edges = np.column_stack([t[np.maximum(starts - 1, 0)], t[last]])
        binned = len(starts) < count
        return cls((t[starts] + t[last]) / 2, starts, count, binned, any_of[0], any_of[1], broken[starts], edges)

    def least(self, values: Array) -> Array:
        """Least value of each.

        `values` (samples,): one value per sample of the recording; Returns (P,): naN only if there is no other value.
        """
        return self._reduced(np.fmin, values)

    def greatest(self, values: Array) -> Array:
        """Greatest value of each.

        `values` (samples,): one value per sample of the recording; Returns (P,): naN only if there is no other value.
        """
        return self._reduced(np.fmax, values)

    def _reduced(self, which: np.ufunc, values: Array) -> Array:
        if not self.binned:
            return values[self.starts]
        reduced: Array = which.reduceat(np.ascontiguousarray(values[: self.stop]), self.starts)
        return reduced

    def worst(self, verdicts: Verdicts, state: int, values: Array) -> tuple[Array, Array, Array]:
        """The worst sample of each in which a state is violated.

        `values` (samples,): the state; Returns (v,): where each is drawn, s; Returns (v,): value of the worst sample;
        Returns (v,): its utilisation.
        """
        flags, utilisation = verdicts.flags[:, state], verdicts.utilisation[:, state]
        bad = np.flatnonzero(self.greatest(flags) == 1.0)
        if not self.binned:
            rows = self.starts[bad]
        else:
            ends = np.append(self.starts[1:], self.stop)
            rows = np.array([_worst_row(flags, utilisation, self.starts[b], ends[b]) for b in bad], dtype=np.intp)
        return self.t[bad], values[rows], utilisation[rows]

    def broken(self, *values: Array) -> list[Array]:
        """Times and values with NaN wherever something lies between.

        `*values` (P,): what is drawn over the times.
        """
        at = np.flatnonzero(self.after)
        return [np.insert(array, at, np.nan) for array in (self.t, *values)]

    def alarms(self) -> list[tuple[float, float]]:
        """Each stretch of alarm, from the verdict that raised it to the one that ended it."""
        if self.binned:
            return self.spans(self.alarm)
        runs = np.flatnonzero(np.diff(np.concatenate([[False], self.alarm, [False]]).astype(np.int8))).reshape(-1, 2)
        return [(float(self.t[a]), float(self.t[min(b, len(self.t) - 1)] - self.t[a])) for a, b in runs]

    def spans(self, which: Mask) -> list[tuple[float, float]]:
        """Each run of what is marked.

        `which` (P,): what is marked.
        """
        edges = np.flatnonzero(np.diff(np.concatenate([[False], which, [False]]).astype(np.int8))).reshape(-1, 2)
        return [(float(self.edges[a, 0]), float(self.edges[b - 1, 1] - self.edges[a, 0])) for a, b in edges]


def _worst_row(flags: Array, utilisation: Array, start: int, stop: int) -> int:
    """The violated sample that lies farthest out."""
    rows = np.flatnonzero(flags[start:stop] == 1.0) + start
    return int(rows[np.argmax(np.abs(utilisation[rows]))])
