# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""False alarms per hour of a model's alarm on what was left out, with their interval."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.model.alarm_rule import Rule, containment
from uncertain_lti.monitor.alarm import Alarm
from uncertain_lti.validation.intervals import rate_interval
from uncertain_lti.validation.part import Part, by_unit, rising


def raised_on(rules: Sequence[Rule], part: Part) -> NDArray[np.bool_]:
    """(K,): whether the rules raise the alarm, after each verdict of a part that was left out."""
    model = part.judged_by
    assert model is not None
    one_step = containment(rules)
    margin = 1.0 if one_step is None else one_step.margin
    violated = ~(np.nan_to_num(part.severity) <= margin)
    found, table = np.zeros(part.judged, dtype=bool), part.table
    for start, stop in part.spans:
        span = slice(start, stop)
        alarm = Alarm(rules, model, np.ones(model.n, dtype=bool))
        found[span] = alarm.over(part.dt[span], violated[span], table[span])[0]
    return found


def false_alarms(parts: Sequence[Part], rules: Sequence[Rule], confidence: float) -> dict[str, Any]:
    """Alarms per hour on what was left out, with the interval for the rate of a model fitted to as many parts."""
    raised = [raised_on(rules, part) for part in parts]
    counts = [rising(each, part.starts) for each, part in zip(raised, parts, strict=True)]
    hours = sum(part.hours for part in parts)
    time = sum(float(part.dt[each].sum()) for each, part in zip(raised, parts, strict=True)) / 3600.0
    low, high = rate_interval(by_unit(parts, counts), hours, confidence)
    return {
        "rule": "; or ".join(rule.words for rule in rules),
        "alarms": sum(counts),
        "parts_with_alarm": sum(count > 0 for count in counts),
        "raised_share": time / hours if hours else None,
        "per_hour": sum(counts) / hours if hours else None,
        "interval": [low, high if math.isfinite(high) else None],
    }
