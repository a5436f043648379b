# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""An update with the monitor that goes with it: thresholds of the panel take in what new recordings reach."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.identification import update
from uncertain_lti.model.alarm_rule import JOINT, Rule, StatisticRule
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.sampling.transient import Transient, Transitions
from uncertain_lti.validation.panel import sizes_of
from uncertain_lti.validation.part import Part, Reach, judge

NOTE = (
    "brought up to date: thresholds are those of the first fit, or the largest that the new recordings reached by the "
    "model fitted without them; what is promised is of the first fit, and a fit of all recordings learns it anew"
)


def updated(
    model: UncertainLTI, transients: Iterable[Transient] | Transient, progress: Callable[[str], None] | None = None
) -> UncertainLTI:
    """`UncertainLTI.update`."""
    found, runs = update.updated(model, transients, progress)
    alarm = model.fit_summary.get("alarm", {})
    if "limit_per_hour" not in alarm:  # given by hand, or not learnt
        return found
    rules, ranges = model.alarm, _Ranges(model)
    for run in runs:
        part = judge(model, model, run, run.name, reach=ranges)
        rules = _raised(rules, part.without(part.extrapolated > 0))
    return found.replace(alarm=rules, fit_summary={**found.fit_summary, "alarm": {**alarm, "note": NOTE}})


class _Ranges(Reach):
    """Beyond what a model was fitted to is what leaves its ranges: all that it keeps of them."""

    def __init__(self, model: UncertainLTI) -> None:
        self._model = model

    def level(self, steps: Transitions) -> NDArray[np.intp]:
        """(K,): 0 where a transition begins within the ranges, 1 beyond them."""
        return self._model.domain.beyond(self._model.normalised_columns(steps)).astype(np.intp)


def _raised(rules: tuple[Rule, ...], part: Part) -> tuple[Rule, ...]:
    """Rules whose thresholds are no less than the largest statistic on a part."""
    statistics = [rule for rule in rules if isinstance(rule, StatisticRule)]
    if not part.judged or not statistics:
        return rules
    raised: dict[StatisticRule, Rule] = {}
    for rule, sizes in zip(statistics, sizes_of(statistics, part), strict=True):
        factor: Array = np.maximum(sizes.max(axis=0), 1.0) ** (1 if rule.kind == "mean" else 2)
        values = (np.asarray(rule.thresholds(part.model.n)) * factor).tolist()
        raised[rule] = replace(rule, threshold=values[0] if rule.kind in JOINT else tuple(values))
    return tuple(raised.get(rule, rule) if isinstance(rule, StatisticRule) else rule for rule in rules)
