# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Several rules armed at once: their levels on what was left out, and one factor on all of their thresholds.

Each rule is brought to a common scale first: its level over what its peaks on the other recordings or groups that were
left out make likely (their mean logarithm and its deviation). So one factor raises all thresholds together, states that
are noisier have higher ones, as has a statistic that differs more from recording to recording, and the search for the
factor is one search however many rules are armed. As the scale at one recording or group comes from the others, the
scaled levels are those of a new one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import FitError
from uncertain_lti.model.alarm_rule import JOINT, KINDS, AlarmRule, Rule, StatisticRule
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.alarm import Alarm, row_of
from uncertain_lti.validation.part import Part, unit_numbers

ALLOWANCES = (0.02, 0.1)
"""Allowances of cusum: utilisation of so much adds nothing. What is small and lasts is what it is for."""
WINDOWS = (5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
"""Windows tried, in median steps, as far as the recordings support them."""
SUPPORT = 10
"""A window is tried if the median part holds as many of them one after the other."""
DEVIATIONS = 1.5
"""Standard deviations above the mean logarithm of the peaks at which the scale of a rule is."""
_TINY = 1e-12


def kinds_of(statistics: Sequence[str] | str) -> tuple[str, ...]:
    """Names of statistics.

    Parameters
    ----------
    statistics : sequence of str, or str
        Names, or one text with commas between them; `all` for every kind.

    Returns
    -------
    tuple of str
        In the order of `KINDS`, each once.

    Raises
    ------
    FitError
        One is no statistic, or there is none.
    """
    names = statistics.split(",") if isinstance(statistics, str) else list(statistics)
    names = [name.strip() for name in names if name.strip()]
    for name in names:
        if name not in (*KINDS, "all"):
            raise FitError(f"statistics: {name!r} is none; choose from {', '.join(KINDS)}, or all")
    if not names:
        raise FitError(f"statistics: none is named; choose from {', '.join(KINDS)}, or all")
    return tuple(kind for kind in KINDS if kind in names or "all" in names)


def supported_windows(parts: Sequence[Part], dt: float) -> list[int]:
    """Windows that the recordings support.

    Parameters
    ----------
    parts : sequence of Part
        Left-out parts.
    dt : float
        Median step, s.

    Returns
    -------
    list of int
        In median steps, of `WINDOWS`.
    """
    longest = float(np.median([float(p.dt.sum()) for p in parts])) / SUPPORT
    return [n for n in WINDOWS if n * dt <= longest * (1.0 + 1e-9)]


def sets_of(kinds: Sequence[str], model: UncertainLTI, windows: Sequence[int]) -> list[tuple[Rule, ...]]:
    """Rules that may be armed together, with thresholds and margins of 1, one set per window.

    Parameters
    ----------
    kinds : sequence of str
        Of `kinds_of`.
    model : UncertainLTI
        Its horizons are watched, too.
    windows : sequence of int
        In median steps.

    Returns
    -------
    list of tuple of Rule
        Containment of one step and of each horizon, and every kind at one step and at the longest horizon; there chi2
        of one verdict, too.
    """
    steps = [horizon.steps for horizon in model.horizons]
    dt = model.sampling.dt_median
    found: list[tuple[Rule, ...]] = []
    for count in windows:
        assert dt is not None
        rules: list[Rule] = [AlarmRule(1, 1, 1.0, h) for h in (1, *steps)]
        for kind in kinds:
            for h in (1, *steps[-1:]):
                for allowance in ALLOWANCES if kind == "cusum" else (0.0,):
                    rules.append(StatisticRule(kind, count * dt, 1.0, h, allowance))
        if "chi2" in kinds and steps:
            rules.append(StatisticRule("chi2", 0.0, 1.0, steps[-1]))
        found.append(tuple(rules))
    return found


def values_of(rules: Sequence[Rule], part: Part, table: Array | None = None) -> list[Array]:
    """What each rule compares with its threshold or margin, on one part.

    Parameters
    ----------
    rules : sequence of Rule
        Of `sets_of`.
    part : Part
        The part.
    table : array (K, rows, n), optional
        Default that of the part.

    Returns
    -------
    list of array (K, c)
        Of each rule, of each state or of all together (c = 1).
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
            found.append(severity[:, None])
            continue
        values = np.zeros((part.judged, 1 if rule.kind in JOINT else model.n))
        for start, stop in part.spans:
            span = slice(start, stop)
            violated = np.zeros(stop - start, dtype=bool)
            values[span] = Alarm([rule], model, counted).over(part.dt[span], violated, table[span])[2]
        found.append(np.nan_to_num(np.abs(values)))
    return found


def _scale(peaks: Array) -> Array:
    """Where the peak of another recording or group may be, (c,), from those of some, (units, c)."""
    logarithm = np.log(peaks)
    return np.asarray(np.exp(logarithm.mean(axis=0) + DEVIATIONS * logarithm.std(axis=0)))


class Armed:
    """One set of rules on a common scale.

    Parameters
    ----------
    rules : sequence of Rule
        Of `sets_of`.
    parts : sequence of Part
        Left-out parts, of two recordings or groups at least.

    Attributes
    ----------
    rules : tuple of Rule
        As given.
    levels : list of array (K,)
        Of each part the factor below which some rule raises the alarm.
    """

    def __init__(self, rules: Sequence[Rule], parts: Sequence[Part]) -> None:
        self.rules = tuple(rules)
        values = [values_of(self.rules, part) for part in parts]
        units = unit_numbers(parts)
        peaks = []  # of each rule: (units, c)
        for j in range(len(self.rules)):
            each = np.zeros((int(units.max(initial=0)) + 1, values[0][j].shape[1]))
            for unit, of_part in zip(units.tolist(), values, strict=True):
                each[unit] = np.maximum(each[unit], of_part[j].max(axis=0, initial=0.0))
            peaks.append(np.maximum(each, _TINY))
        self._scales = [_scale(each) for each in peaks]
        self.levels = []
        for unit, of_part in zip(units.tolist(), values, strict=True):
            level = np.zeros(len(of_part[0]))
            for rule, value, each in zip(self.rules, of_part, peaks, strict=True):
                others = np.delete(each, unit, axis=0) if len(each) > 1 else each
                scaled = value / _scale(others)
                if isinstance(rule, AlarmRule):  # its margin is never below 1
                    scaled = np.where(value > 1.0, scaled, 0.0)
                level = np.maximum(level, scaled.max(axis=1))
            self.levels.append(level)

    def at(self, factor: float) -> tuple[Rule, ...]:
        """The rules with the thresholds and margins of one factor.

        Parameters
        ----------
        factor : float
            On the scales.

        Returns
        -------
        tuple of Rule
            Margins are at least 1.
        """
        found: list[Rule] = []
        for rule, scale in zip(self.rules, self._scales, strict=True):
            if isinstance(rule, AlarmRule):
                found.append(replace(rule, margin=max(1.0, factor * float(scale[0]))))
            else:
                each = tuple(factor * float(s) for s in scale)
                found.append(replace(rule, threshold=each[0] if len(each) == 1 else each))
        return tuple(found)
