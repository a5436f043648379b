# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Rules armed together, and the one search for their thresholds: on what was left out, each brought to a common scale.

A rule is scaled by what its peaks on the recordings or groups that were left out make likely (their mean logarithm and
its deviation). So one factor raises all thresholds together, states that are noisier have higher ones, as has a
statistic that differs more from recording to recording, and the search for the factor is one search however many rules
are armed. The scale is that of all of them, for their levels and for the thresholds alike: where they are few, a scale
from the others alone would make the most restless of them stand out twice, and the thresholds far higher than it needs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import FitError
from uncertain_lti.base.limits import LARGEST
from uncertain_lti.model.alarm_rule import KINDS, AlarmRule, Rule, StatisticRule
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.alarm import Alarm, row_of
from uncertain_lti.validation.part import Part, by_unit, rising, unit_numbers

ALLOWANCES = (0.02, 0.1)
"""Allowances of cusum: utilisation of so much adds nothing. What is small and lasts is what it is for."""
SUPPORT = 4
"""A window is tried if the median recording or group is as long as so many of them."""
SHORTER, MOST_WINDOWS, FEWEST_STEPS = 4, 4, 5
"""Windows of statistics are tried from the longest down, each a quarter of the last; how many, and the shortest."""
COUNTED = ((3, 5), (5, 10), (20, 50), (80, 200), (400, 1000))
"""(violations, window) tried beside 1 of 1, up to the longest window that the recordings support, and 10."""
DEVIATIONS, FROM = 1.5, 8
"""Standard deviations above the mean logarithm of the peaks at which the scale of a rule is, of many recordings or
groups; half as many where there are FROM, as what few of them scatter by is hardly known."""
FINE, LEAST = 1.02, 0.25
"""`quiet` lowers the factor in this ratio, from above the largest level down to so much of it."""
_TINY, _HUGE = 1e-12, LARGEST


def kinds_of(statistics: Sequence[str] | str) -> tuple[str, ...]:
    """Names of statistics."""
    names = statistics.split(",") if isinstance(statistics, str) else list(statistics)
    names = [name.strip() for name in names if name.strip()]
    for name in names:
        if name not in (*KINDS, "all"):
            raise FitError(f"statistics: {name!r} is none; choose from {', '.join(KINDS)}, or all")
    if not names:
        raise FitError(f"statistics: none is named; choose from {', '.join(KINDS)}, or all")
    return tuple(kind for kind in KINDS if kind in names or "all" in names)


@dataclass(frozen=True)
class Family:
    """Alarm rules that differ in one factor on their thresholds and margins alone.

    `kinds`: statistics; none for containment alone; `window`: in verdicts of containment, in median steps of
    statistics; `violations`: m of m of n; 1 beside statistics; `dt`: median step, s; 0 if there is none.
    """

    kinds: tuple[str, ...] = ()
    window: int = 1
    violations: int = 1
    dt: float = 0.0

    @property
    def window_s(self) -> float:
        """The window, s."""
        return self.window * self.dt

    @property
    def words(self) -> str:
        """In words."""
        if not self.kinds:
            return f"{self.violations} of {self.window}"
        return f"{', '.join(self.kinds)} over {self.window_s:.3g} s"

    def rules(self, model: UncertainLTI) -> tuple[Rule, ...]:
        """The rules for one model, with thresholds and margins of 1."""
        steps = [horizon.steps for horizon in model.horizons]
        if not self.kinds:
            return tuple(AlarmRule(self.violations, self.window, 1.0, h) for h in (1, *steps))
        found: list[Rule] = [AlarmRule(1, 1, 1.0, h) for h in (1, *steps)]
        for kind in self.kinds:
            for h in (1, *steps[-1:]):
                for allowance in ALLOWANCES if kind == "cusum" else (0.0,):
                    found.append(StatisticRule(kind, self.window_s, 1.0, h, allowance))
        if "chi2" in self.kinds and steps:
            found.append(StatisticRule("chi2", 0.0, 1.0, steps[-1]))
        return tuple(found)


def longest_window(parts: Sequence[Part], dt: float) -> int:
    """The longest window that the recordings support, in median steps."""
    lengths = np.array([float(p.dt.sum()) for p in parts])
    typical = min(float(np.median(by_unit(parts, lengths))) / SUPPORT, float(np.median(lengths)) / 2.0)
    return int(typical / dt * (1.0 + 1e-9)) if dt else 0


def families(parts: Sequence[Part], dt: float, kinds: Sequence[Sequence[str]] = ()) -> list[Family]:
    """What may be armed, as far as the recordings support its window; the plainest first."""
    longest = longest_window(parts, dt)
    found = [Family(dt=dt)]
    found += [Family((), n, m, dt) for m, n in COUNTED if n <= max(10, longest)]
    windows = [longest // SHORTER**k for k in range(MOST_WINDOWS)]
    windows = sorted(n for n in set(windows) if n >= FEWEST_STEPS)
    return found + [Family(tuple(together), n, 1, dt) for together in kinds for n in windows]


def values_of(rules: Sequence[Rule], part: Part, table: Array | None = None) -> list[Array]:
    """What each rule compares with its threshold or margin, on one part.

    `table` (K, rows, n): default that of the part; Returns (K, c): of each rule, of each state or of all together (c =
    1).
    """
    model = part.judged_by
    assert model is not None
    table = part.table if table is None else table
    counted = np.ones(model.n, dtype=bool)
    found = []
    for rule in rules:
        if isinstance(rule, AlarmRule):
            sizes = np.abs(table[:, row_of(rule, model)])
            severity = np.where(np.isnan(sizes).all(axis=1), 0.0, np.nan_to_num(sizes, nan=np.inf).max(axis=1))
            level = part.level(rule.violations, rule.window, severity)
            found.append(np.clip(level, 0.0, _HUGE)[:, None])
            continue
        values = np.zeros((part.judged, len(rule.thresholds(model.n))))
        for start, stop in part.spans:
            span = slice(start, stop)
            violated = np.zeros(stop - start, dtype=bool)
            values[span] = Alarm([rule], model, counted).over(part.dt[span], violated, table[span])[2]
        found.append(np.minimum(np.nan_to_num(np.abs(values)), _HUGE))
    return found


def _scale(peaks: Array) -> Array:
    """Where the peak of another recording or group may be, (c,), from those of some, (units, c)."""
    logarithm = np.log(peaks)
    share = DEVIATIONS * len(peaks) / (len(peaks) + FROM)
    return np.asarray(np.exp(logarithm.mean(axis=0) + share * logarithm.std(axis=0)))


class Armed:
    """One set of rules on a common scale; a single rule of containment on its own, that of margins.

    `rules`: of `Family.rules`; `parts`: left-out parts; `rules`: as given; `levels` (K,): of each part the factor below
    which some rule raises the alarm; 0 where a margin of 1 does not.
    """

    def __init__(self, rules: Sequence[Rule], parts: Sequence[Part]) -> None:
        self.rules, self._parts = tuple(rules), parts
        values = [values_of(self.rules, part) for part in parts]
        units = unit_numbers(parts)
        alone = len(self.rules) == 1 and isinstance(self.rules[0], AlarmRule)
        peaks = []  # of each rule: (units, c)
        for j in range(len(self.rules)):
            each = np.zeros((int(units.max(initial=0)) + 1, values[0][j].shape[1]))
            for unit, of_part in zip(units.tolist(), values, strict=True):
                each[unit] = np.maximum(each[unit], of_part[j].max(axis=0, initial=0.0))
            peaks.append(np.ones_like(each) if alone else np.maximum(each, _TINY))
        self._scales = [_scale(each) for each in peaks]
        self.levels = []
        for of_part in values:
            level = np.zeros(len(of_part[0]))
            for rule, value, scale in zip(self.rules, of_part, self._scales, strict=True):
                scaled = value / scale
                if isinstance(rule, AlarmRule):  # its margin is never below 1
                    scaled = np.where(value > 1.0, scaled, 0.0)
                level = np.maximum(level, scaled.max(axis=1))
            self.levels.append(level)

    @property
    def top(self) -> float:
        """The largest level."""
        return max(float(level.max(initial=0.0)) for level in self.levels)

    def counts(self, factor: float) -> NDArray[np.intp]:
        """Alarms that are raised on each part.

        Returns (parts,): rising edges.
        """
        each = zip(self.levels, self._parts, strict=True)
        return np.array([rising(level > factor, part.starts) for level, part in each], dtype=np.intp)

    def lowest(
        self, factors: Iterable[float], keeps: Callable[[float, NDArray[np.intp]], bool]
    ) -> tuple[float, NDArray[np.intp]] | None:
        """The last factor before one does not keep to what is asked for.

        Returns (parts,): the factor and its alarms; None if the first does not keep to it.
        """
        chosen = None
        for factor in factors:
            counts = self.counts(factor)
            if not keeps(factor, counts):
                break
            chosen = factor, counts
        return chosen

    def at(self, factor: float) -> tuple[Rule, ...]:
        """The rules with the thresholds and margins of one factor."""
        found: list[Rule] = []
        for rule, scale in zip(self.rules, self._scales, strict=True):
            if isinstance(rule, AlarmRule):
                found.append(replace(rule, margin=max(1.0, factor * float(scale[0]))))
            else:
                each = tuple(factor * float(s) for s in scale)
                found.append(replace(rule, threshold=each[0] if len(each) == 1 else each))
        return tuple(found)


def quiet(
    family: Family, model: UncertainLTI, parts: Sequence[Part], allowed: int
) -> tuple[tuple[Rule, ...], NDArray[np.intp]]:
    """The rules of a family with the smallest factor that raises at most so many alarms on what was left out.

    Returns (parts,): alarms of each part.
    """
    armed = Armed(family.rules(model), parts)
    top = armed.top
    if top >= _HUGE:
        raise FitError("no threshold is quiet: bounds without width are left on what was left out")
    steps = int(np.log(1.0 / LEAST) / np.log(FINE))
    factors = max(top, _TINY) * FINE / FINE ** np.arange(steps)
    found = armed.lowest(factors.tolist(), lambda _, counts: counts.sum() <= allowed)
    assert found is not None  # above the largest level there is no alarm
    return armed.at(found[0]), found[1]


def steady(
    family: Family, model: UncertainLTI, parts: Sequence[Part], halves: Sequence[Sequence[Part]], allowed: int
) -> tuple[tuple[Rule, ...], NDArray[np.intp]]:
    """The rules of `quiet`, no lower than on recordings of which half was left out.

    Of few recordings left out one at a time and of many ways, the one with the lowest thresholds owes them to chance:
    fresh recordings then raise its alarm several times as often. What half of the recordings bound badly shows it.

    Returns (parts,): alarms of each of `parts`.
    """
    rules, counts = quiet(family, model, parts, allowed)
    others = []
    for half in halves:
        try:
            others.append(_thresholds(quiet(family, model, half, allowed)[0], model.n))
        except FitError:
            continue  # that half says nothing of how high is high enough
    if not others:
        return rules, counts
    own = _thresholds(rules, model.n)
    raised = [
        np.maximum(one, np.median(every, axis=0)) for one, every in zip(own, zip(*others, strict=True), strict=True)
    ]
    rules = tuple(_with_thresholds(rule, limits) for rule, limits in zip(rules, raised, strict=True))
    return rules, np.array([_alarms(rules, part) for part in parts], dtype=np.intp)


def _thresholds(rules: Sequence[Rule], n: int) -> list[Array]:
    """Margin or thresholds of each rule, (c,)."""
    return [
        np.array([rule.margin] if isinstance(rule, AlarmRule) else rule.thresholds(n), dtype=np.float64)
        for rule in rules
    ]


def _with_thresholds(rule: Rule, limits: Array) -> Rule:
    each = tuple(limits.tolist())
    if isinstance(rule, AlarmRule):
        return replace(rule, margin=each[0])
    return replace(rule, threshold=each[0] if len(each) == 1 else each)


def _alarms(rules: Sequence[Rule], part: Part) -> int:
    """How often rules raise the alarm on one part."""
    raised = np.zeros(part.judged, dtype=bool)
    for rule, values in zip(rules, values_of(rules, part), strict=True):
        raised |= (values > (rule.margin if isinstance(rule, AlarmRule) else 1.0)).any(axis=1)
    return rising(raised, part.starts)
