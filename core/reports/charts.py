# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Charts over time: what is drawn of a recording, said once; images, the report and the interactive page draw it.

A long recording is drawn in columns. Each has the least and the greatest value of its samples, and a mark wherever a
single sample of it was violated, so that nothing is hidden.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array, Index, Mask, runs
from uncertain_lti.base.text import named, plural
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.alarm import Raised
from uncertain_lti.monitor.verdict import Verdicts

PIXELS = 1200
"""Columns of an image."""
FEW = 8
"""States that are drawn one by one; more become the rows of a map."""
FARTHEST = 1000.0
"""Utilisation and score that are drawn at most."""
Spans = list[tuple[float, float]]


def forward(t: Array) -> tuple[Array, int]:
    """Times (samples,) in s that never go back, and how many passes follow the first: each begins after the last."""
    steps = np.diff(t)
    loops = int((steps < 0).sum())
    if not loops:
        return t, 0
    ahead = steps[steps > 0]
    steps[steps < 0] = float(np.median(ahead)) if len(ahead) else 1.0
    return np.concatenate([[0.0], np.cumsum(steps)]), loops


@dataclass(frozen=True)
class Columns:
    """Stretches of samples that are drawn as one; of a short recording every sample.

    `starts` (P,): first sample of each; `stop`: end of the last; `t` (P,): where each is drawn, s; `edges` (P, 2): its
    begin and end, s; `apart` (P,): whether it is not joined to the one before; `binned`: whether some hold several
    samples; `alarm, judged` (P,): whether any of its samples has one; `loops`: passes after the first.
    """

    starts: Index
    stop: int
    t: Array
    edges: Array
    apart: Mask
    binned: bool
    alarm: Mask
    judged: Mask
    loops: int = 0

    @classmethod
    def of(
        cls, t: Array, segment: NDArray[np.int32] | None = None, judged: Mask | None = None, alarm: Mask | None = None,
        near: Mask | None = None, most: int = PIXELS, span: tuple[float, float] | None = None,
    ) -> Columns:  # fmt: skip
        """At most about `most` columns (two per pixel where all samples fit), finer around instants that are `near`."""
        t, loops = forward(t)
        low, high = span or (-math.inf, math.inf)
        first, stop = int(np.searchsorted(t, low)), int(np.searchsorted(t, high, side="right"))
        count = stop - first
        here = slice(first, stop)
        broken = np.zeros(count, dtype=bool)
        if segment is not None:
            broken[1:] = np.diff(segment[here]) != 0
        chosen = np.ones(count, dtype=bool)
        if count > 2 * most:
            joined = broken if int(broken.sum()) <= most // 2 else np.zeros(count, dtype=bool)
            chosen = joined | (np.arange(count) % math.ceil(count / most * (1 if near is None else 2)) == 0)
            if near is not None:
                onsets = [begin for begin, _ in runs(near[here])]
                onsets = onsets[:: math.ceil(len(onsets) / max(most // 20, 1)) or 1]
                reach = min(most // (4 * max(len(onsets), 1)), 2000)
                for onset in onsets:
                    chosen[max(onset - reach, 0) : onset + reach + 2] = True
        starts = np.flatnonzero(chosen) + first
        ends = np.append(starts[1:], stop)[: len(starts)]
        apart = broken[starts - first]
        begins = np.where(apart, t[starts], t[np.maximum(starts - 1, first)]) if count else t[:0]
        edges, middle = np.column_stack([begins, t[ends - 1]]), (t[starts] + t[ends - 1]) / 2
        nowhere = np.zeros(len(t), dtype=bool)
        raised, known = (_some(nowhere if a is None else a, starts, stop) for a in (alarm, judged))
        return cls(starts, stop, middle, edges, apart, len(starts) < count, raised, known, loops)

    @property
    def label(self) -> str:
        """Label of the axis, which says when passes were put one behind the other."""
        return "time [s]" + (f", {self.loops + 1} passes one behind the other" if self.loops else "")

    @property
    def limits(self) -> tuple[float, float]:
        """Begin and end of what is drawn, s."""
        low, high = (float(self.edges[0, 0]), float(self.edges[-1, 1])) if len(self.t) else (0.0, 1.0)
        return low, high if high > low else low + 1.0

    @cached_property
    def alarms(self) -> Spans:
        """Each stretch of alarm, from the verdict that raised it to the one that ended it."""
        if self.binned:
            return self._spans(self.alarm)
        return [(float(self.t[a]), float(self.t[min(b, len(self.t) - 1)])) for a, b in runs(self.alarm)]

    @cached_property
    def silent(self) -> Spans:
        """Each stretch without a verdict, pauses of the recording too."""
        which = ~self.judged
        if not self.binned:
            which[:1] = False
        pauses = [(float(self.edges[k - 1, 1]), float(self.edges[k, 0])) for k in np.flatnonzero(self.apart) if k]
        return sorted(self._spans(which) + pauses)

    def _spans(self, which: Mask) -> Spans:
        return [(float(self.edges[a, 0]), float(self.edges[b - 1, 1])) for a, b in runs(which)]

    def extremes(self, values: Array) -> tuple[Array, Array]:
        """Least and greatest of each column (P, k) of the finite ones of some values (samples, k)."""
        return self.reduced(values, np.fmin), self.reduced(values, np.fmax)

    def reduced(self, values: Array, which: np.ufunc) -> Array:
        """`np.fmin` or `np.fmax` of each column (P, k) of some values (samples, k)."""
        if not self.binned:
            return values[self.starts]
        found = np.empty((len(self.starts), values.shape[1]))
        for c, (a, b) in enumerate(zip(self.starts.tolist(), [*self.starts[1:].tolist(), self.stop], strict=True)):
            which.reduce(np.ascontiguousarray(values[a:b].T), axis=1, out=found[c])  # faster than along the rows
        return found

    def some(self, which: Mask) -> Mask:
        """Whether any sample of each column (P,) is marked."""
        return _some(which, self.starts, self.stop)

    def worst(self, bad: Mask, utilisation: Array, values: Array) -> Array:
        """Of each column (P,) the value at its violated sample that lies farthest out; NaN where none is."""
        found = np.full(len(self.starts), np.nan)
        first = int(self.starts[0]) if len(self.starts) else self.stop
        rows = np.flatnonzero(bad[first : self.stop]) + first
        order = rows[np.argsort(np.abs(utilisation[rows]), kind="stable")]
        found[np.searchsorted(self.starts, order, side="right") - 1] = values[order]
        return found


def _some(which: Mask, starts: Index, stop: int) -> Mask:
    return np.logical_or.reduceat(which[:stop], starts) if len(starts) else which[:0]


@dataclass(frozen=True)
class Series:
    """One quantity: `low` (P,) of each column and, where that differs, `high` (P,); `role` chooses how it looks."""

    role: str
    low: Array
    high: Array | None = None


@dataclass(frozen=True)
class Panel:
    """Series over one axis.

    `limits`: of the axis; `marks` (P,): violated values, NaN where none is; `levels`: lines across; `count`: violated
    samples; `note`: what stands at its right.
    """

    title: str
    series: tuple[Series, ...]
    unit: str = ""
    limits: tuple[float, float] = (0.0, 1.0)
    marks: Array | None = None
    levels: tuple[float, ...] = ()
    count: int = 0
    note: str = ""

    @property
    def heading(self) -> str:
        """Name and unit."""
        return named(self.title, self.unit)


@dataclass(frozen=True)
class Map:
    """Rows of a size over time, `values` (rows, P): 1 is the bound, beyond it is violated, NaN unknown."""

    heading: str
    rows: tuple[str, ...]
    values: Array
    note: str = ""
    count: int = 0


@dataclass(frozen=True)
class Chart:
    """Panels over the time of one recording; `heading`: of the recording; `keys`: roles and words of the legend."""

    heading: str
    columns: Columns
    panels: tuple[Panel | Map, ...]
    keys: tuple[tuple[str, str], ...]


ALARMED = (("alarm", "alarm"), ("silent", "no verdict"))
MAPPED = (("full", "at its bound"), ("violated", "violated"), *ALARMED)


def columns_of(
    verdicts: Verdicts, most: int = PIXELS, span: tuple[float, float] | None = None, fine: bool = False
) -> Columns:
    """Columns of a recording that was checked; `fine` has every sample around violations and alarms."""
    run = verdicts.transient
    near = verdicts.violated | verdicts.alarm if fine else None
    return Columns.of(run.t, run.segment, verdicts.judged, verdicts.alarm, near, most, span)


def alarm_chart(model: UncertainLTI, verdicts: Verdicts, columns: Columns, most: int = 6) -> Chart:
    """What happened and when: the alarm's score over its threshold, then the states that did it."""
    panel, states = alarm_panel(model, verdicts, columns)
    below = utilisation_chart(model, verdicts, columns, np.argsort(-states, kind="stable")[:most].tolist())
    keys = (("score", "score, utilisation"), ("bounds", "inside the bounds"), ("violated", "violated"), *ALARMED)
    return Chart(below.heading, columns, (panel, *below.panels), keys)


def alarm_panel(model: UncertainLTI, verdicts: Verdicts, columns: Columns) -> tuple[Panel, Array]:
    """The alarm's score over its threshold, and what each state had to do with it (n,)."""
    score, states = scores(model, verdicts, columns)
    raised: Sequence[Raised] = ()
    if columns.alarm.any():
        first = int(columns.starts[columns.alarm.argmax()])
        raised = sorted(verdicts.raised(first + int(verdicts.alarm[first:].argmax())), key=lambda by: -abs(by.value))
    return score_panel(columns, score, f"raised by {raised[0].what}; " if raised else ""), states


def score_panel(columns: Columns, score: Array, first: str = "") -> Panel:
    """A score (P,) over its threshold, which it is never below while the alarm is up; `first`: what raised it."""
    score = np.where(columns.alarm, np.fmax(score, 1.0), score)
    greatest, never = float(np.nanmax(score, initial=0.0)), "never over it" if np.isfinite(score).any() else ""
    over = greatest > 1 or bool(columns.alarm.any())
    capped = np.minimum(score, FARTHEST)
    return Panel(
        "alarm score, 1 is the threshold", (Series("score", np.where(np.isnan(capped), np.nan, 0.0), capped),),
        limits=(0.0, float(np.clip(1.1 * greatest, 1.5, 6.0))), levels=(1.0,),
        note=first + f"greatest {greatest:.3g}" if over else never,
    )  # fmt: skip


def scores(model: UncertainLTI, verdicts: Verdicts, columns: Columns) -> tuple[Array, Array]:
    """The greatest score of any rule over its threshold in each column (P,), and of each state (n,) in the alarm.

    The score of a statistic is what it is over its threshold; that of containment the violated verdicts over those
    that raise the alarm or, where one is enough, the utilisation over the margin.
    """
    where = columns.alarm if columns.alarm.any() else columns.judged
    states = _most(_size(*columns.extremes(verdicts.utilisation))[where])
    found, given = [], np.flatnonzero(verdicts.judged)
    for r, rule in enumerate(verdicts.alarms.rules):
        if not isinstance(rule, AlarmRule):
            continue
        row = (1, *model.steps).index(rule.horizon)
        table = verdicts.longer_utilisation[:, row - 1] if row else verdicts.utilisation
        if rule.violations == 1:
            value = _fmax(_size(*columns.extremes(table))) / rule.margin
        else:
            with np.errstate(invalid="ignore"):
                bad = (np.abs(table[given]) > rule.margin).any(axis=1)
            total, ends = np.concatenate([[0], np.cumsum(bad)]), np.arange(1, len(given) + 1)
            count = np.full((len(table), 1), np.nan)
            count[given, 0] = total[ends] - total[np.maximum(ends - rule.window, 0)]
            value = columns.reduced(count, np.fmax)[:, 0] / rule.violations
        raised = columns.some(verdicts.rule_alarms[:, r])  # a masked state, or --grace, raises nothing
        found.append(np.where(raised, np.fmax(value, 1.0), np.minimum(value, 0.999)))
    if verdicts.statistic_names:
        over = _size(*columns.extremes(verdicts.statistics))
        found.append(_fmax(over))
        of_each = dict(zip(verdicts.statistic_names, _most(over[where]).tolist(), strict=True))
        states = np.maximum(states, blamed(model.state_names, of_each))
    return _fmax(np.stack(found, axis=1)), states


def blamed(states: Sequence[str], statistics: Mapping[str, float]) -> Array:
    """The greatest statistic over its threshold of each state (n,); 0 of one that has none."""
    own = [(name.partition("/")[2], size) for name, size in statistics.items()]
    return np.array([max((size for name, size in own if name == state), default=0.0) for state in states])


def _size(low: Array, high: Array) -> Array:
    return np.fmax(np.abs(low), np.abs(high))


def _fmax(values: Array) -> Array:
    """Greatest of each row; NaN where there is none."""
    return np.asarray(np.fmax.reduce(values, axis=1, initial=np.nan))


def _most(values: Array) -> Array:
    return np.asarray(np.nan_to_num(np.fmax.reduce(values, axis=0, initial=0.0), posinf=1e9))


def envelope_chart(model: UncertainLTI, verdicts: Verdicts, columns: Columns, chosen: Sequence[int]) -> Chart:
    """Some states, each between its one-step bounds, in recorded units."""
    x = verdicts.transient.x
    low, high = columns.extremes(x)
    lower, upper = columns.reduced(verdicts.lower, np.fmin), columns.reduced(verdicts.upper, np.fmax)
    panels = []
    for i in chosen:
        bad, signal = verdicts.flags[:, i] == 1.0, model.signals.states[i]
        marks = columns.worst(bad, verdicts.utilisation[:, i], x[:, i])
        sides = np.concatenate([lower[:, i], low[:, i]]), np.concatenate([upper[:, i], high[:, i]])
        series = Series("bounds", lower[:, i], upper[:, i]), series_of("recorded", low[:, i], high[:, i], columns)
        panels.append(_panel(columns, signal.name, series, _limits(*sides), marks, bad, signal.unit))
    keys = (("bounds", "one-step bounds"), ("recorded", "recorded"), ("violated", "violated"), *ALARMED)
    return Chart(heading(verdicts), columns, tuple(panels), keys)


def utilisation_chart(
    model: UncertainLTI, verdicts: Verdicts, columns: Columns, chosen: Sequence[int], row: int = 0
) -> Chart:
    """Where between its bounds each state lay, -1 and 1 at the bounds; `row` 0 is one step, others the horizons."""
    values = verdicts.longer_utilisation[:, row - 1] if row else verdicts.utilisation
    with np.errstate(invalid="ignore"):
        bad = np.abs(values) > 1.0 if row else verdicts.flags == 1.0
    panels = utilisation_panels(columns, model.state_names, values, bad, chosen)
    keys = (("bounds", "inside the bounds"), ("utilisation", "utilisation"), ("violated", "violated"), *ALARMED)
    return Chart(heading(verdicts), columns, panels, keys)


def utilisation_panels(
    columns: Columns, names: Sequence[str], values: Array, bad: Mask, chosen: Sequence[int]
) -> tuple[Panel, ...]:
    """Utilisation (samples, n) of some states over time, those marked that are violated (samples, n)."""
    low, high = columns.extremes(values)
    panels = []
    for i in chosen:
        size = _size(low[:, i], high[:, i])
        limit = float(np.clip(1.1 * size[np.isfinite(size)].max(initial=0.0), 1.25, 4.0))
        marks = columns.worst(bad[:, i], values[:, i], values[:, i])
        a, b, marks = (np.clip(v, -FARTHEST, FARTHEST) for v in (low[:, i], high[:, i], marks))
        series = (series_of("utilisation", a, b, columns),)
        panels.append(_panel(columns, names[i], series, (-limit, limit), marks, bad[:, i], levels=(-1.0, 1.0)))
    return tuple(panels)


def utilisation_map(model: UncertainLTI, verdicts: Verdicts, columns: Columns, chosen: Sequence[int]) -> Chart:
    """Greatest |utilisation| of many states over time, a row each."""
    values = _size(*columns.extremes(verdicts.utilisation))[:, list(chosen)].T
    names = tuple(model.state_names[i] for i in chosen)
    drawn = Map("|utilisation|", names, values, count=int(verdicts.violated.sum()))
    return Chart(heading(verdicts), columns, (drawn,), MAPPED)


def horizon_chart(model: UncertainLTI, verdicts: Verdicts, columns: Columns, chosen: Sequence[int]) -> Chart:
    """Greatest |utilisation| over time, of each state a map with a row per number of steps."""
    table, step = verdicts.horizon_utilisation, model.sampling.dt_median
    rows = tuple(f"{h} ({h * step:.3g} s)" if step is not None else str(h) for h in (1, *model.steps))
    panels = []
    for i in chosen:
        values = _size(*columns.extremes(table[:, :, i])).T
        with np.errstate(invalid="ignore"):
            outside = (np.abs(table[:, :, i]) > 1.0).sum(axis=0).tolist()
        note = f"outside: {', '.join(map(str, outside))}"
        panels.append(Map(model.state_names[i], rows, values, note, sum(outside)))
    return Chart(heading(verdicts), columns, tuple(panels), MAPPED)


def heading(verdicts: Verdicts) -> str:
    """Name of a recording, its verdicts and how many were violated."""
    judged, bad = int(verdicts.judged.sum()), int(verdicts.violated.sum())
    what = f"{bad} violated ({100 * bad / judged:.3g} %)" if bad else "none violated" if judged else "nothing is known"
    return f"{base_name(verdicts.transient.name)}: {plural(judged, 'verdict')}, {what}"


def base_name(path: str | os.PathLike[str]) -> str:
    """The last part of a path."""
    return os.path.basename(path) or str(path)


def series_of(role: str, low: Array, high: Array, columns: Columns) -> Series:
    """One quantity (P,) from its least and greatest of each column."""
    return Series(role, low, high if columns.binned else None)


def _panel(
    columns: Columns, name: str, series: tuple[Series, ...], limits: tuple[float, float], marks: Array, bad: Mask,
    unit: str = "", levels: tuple[float, ...] = (),
) -> Panel:  # fmt: skip
    first = int(columns.starts[0]) if len(columns.starts) else 0
    count = int(bad[first : columns.stop].sum())
    note = f"violated {count:,}".replace(",", "\N{NARROW NO-BREAK SPACE}") if count else ""
    return Panel(name, series, unit, limits, marks, levels, count, note)


def _limits(lower: Array, upper: Array) -> tuple[float, float]:
    """Of an axis: everything, unless a few far values would flatten the rest; those are then marked at its edge."""
    lower, upper = lower[np.isfinite(lower)], upper[np.isfinite(upper)]
    if not len(lower) or not len(upper):
        return 0.0, 1.0
    bottom, top = float(lower.min()), float(upper.max())
    low, high = float(np.quantile(lower, 0.02)), float(np.quantile(upper, 0.98))
    if top - bottom > 8.0 * (high - low) > 0.0:
        bottom, top = max(bottom, low - (high - low)), min(top, high + (high - low))
    room = 0.08 * (top - bottom) or 0.05 * max(abs(top), 1e-12)
    return bottom - room, top + room
