# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""False alarms per hour of an alarm rule on what was left out, with their interval."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from uncertain_lti.base.arrays import Array
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.validation.intervals import cluster_size, rate_interval
from uncertain_lti.validation.part import Part, by_unit, rising, unit_numbers

NEARBY = 0.75
"""Down to this share of the margin, alarms are assumed to cluster as they do at the margin."""
_ROUNDING = 1e-9


def false_alarms(parts: Sequence[Part], rule: AlarmRule, confidence: float) -> dict[str, Any]:
    """Alarms per hour on what was left out, with the interval for the rate of a model fitted to as many parts."""
    counts = [p.alarms(rule) for p in parts]
    hours = sum(p.hours for p in parts)
    raised = sum(float(p.dt[p.level(rule.violations, rule.window) > rule.margin].sum()) for p in parts) / 3600.0
    low, high = rate_interval(by_unit(parts, counts), hours, confidence, typical_cluster(parts, rule))
    return {
        "violations": rule.violations,
        "window": rule.window,
        "margin": rule.margin,
        "alarms": sum(counts),
        "parts_with_alarm": sum(c > 0 for c in counts),
        "raised_share": raised / hours if hours else None,
        "per_hour": sum(counts) / hours if hours else None,
        "interval": [low, high if math.isfinite(high) else None],
    }


def allowed_alarms(rate: float, hours: float) -> int:
    """False alarms that a rate allows in so many hours."""
    return math.floor(rate * hours * (1.0 + _ROUNDING))


def typical_cluster(parts: Sequence[Part], rule: AlarmRule) -> float:
    """Typical cluster of alarms, if few or none are counted: that of the same rule at a smaller margin.

    The margin is that at which three parts or groups alarm, but not below NEARBY times the rule's: far below, alarms
    are of another kind.
    """
    levels = [p.level(rule.violations, rule.window) for p in parts]
    margin = borrowed_margin(peaks(parts, levels), rule.margin)
    counts = [rising(level > margin, p.starts) for p, level in zip(parts, levels, strict=True)]
    return cluster_size(by_unit(parts, counts))


def peaks(parts: Sequence[Part], levels: Sequence[Array]) -> list[float]:
    """Largest level of each part that was left out alone, and of each group.

    `levels` (K,): `Part.level` of each.
    """
    found: dict[int, float] = {}
    for unit, level in zip(unit_numbers(parts).tolist(), levels, strict=True):
        found[unit] = max(found.get(unit, 0.0), float(level.max(initial=0.0)))
    return list(found.values())


def borrowed_margin(largest: Sequence[float], margin: float) -> float:
    """The margin at which clusters of alarms are counted."""
    third = sorted(largest, reverse=True)[min(2, len(largest) - 1)]
    # a little below the third peak: an alarm that only just starts is always alone
    return min(margin, max(0.95 * third, NEARBY * margin))
