# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Trial: one way to fit with one family of alarm rules, judged on what was left out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.model.alarm_rule import Rule, rule_from_dict
from uncertain_lti.proposal.ways import Setting
from uncertain_lti.validation.armed import Family
from uncertain_lti.validation.detectable import log_sizes


@dataclass(frozen=True, eq=False)
class Trial:
    """One way to fit with one family of alarm rules, judged on what was left out.

    `setting`: how it was fitted; `family`: what raises the alarm; `rules`: the quiet alarm; `alarms`: false alarms left
    out; `upper`: one-sided upper confidence limit of the false alarms per hour, of 90 %; `hours`: time under verdict in
    the left-out parts, h; `inside`: share of the left-out verdicts inside the one-step bounds; `unknowns`: elements of
    the model that are not 0; `faults`: `kind`, `signal`, `largest` and `thresholds` of each; `units` (cases,): what
    each case was left out with; `seen`: by label, whether the alarm was raised in each labelled recording; `refused`:
    why there is none of this; "" otherwise.
    """

    setting: Setting
    family: Family
    rules: tuple[Rule, ...] = ()
    alarms: int = 0
    upper: float = math.inf
    hours: float = 0.0
    inside: float = math.nan
    unknowns: int = 0
    faults: tuple[dict[str, Any], ...] = ()
    units: Array = field(default_factory=lambda: np.zeros(0))
    seen: Mapping[str, list[bool]] = field(default_factory=dict)
    refused: str = ""

    @property
    def words(self) -> str:
        """Setting and rule."""
        return f"{self.setting.words}; alarm {self.family.words}"

    def sizes(self, without: float | None = None) -> Array:
        """Logarithm of the smallest detectable size of each fault; NaN where it is not known.

        Returns (faults,): as of `log_sizes`.
        """
        kept = np.ones(len(self.units), dtype=bool) if without is None else self.units != without
        return log_sizes([(fault["thresholds"], fault["largest"]) for fault in self.faults], kept)

    @property
    def seen_share(self) -> float:
        """Share of the labelled recordings in which the alarm was raised; 0 without any."""
        every = [s for labelled in self.seen.values() for s in labelled]
        return float(np.mean(every)) if every else 0.0


def row_of(trial: Trial, plain: Trial) -> dict[str, Any]:
    """One way as plain data, for the table."""
    row: dict[str, Any] = {"fit": trial.setting.words, "alarm": trial.family.words}
    if trial.refused:
        return {**row, "refused": trial.refused}
    ratio = trial.sizes() - plain.sizes()
    known = ratio[np.isfinite(ratio)]
    return {
        **row,
        "rules": [rule.to_dict() for rule in trial.rules],
        "unknowns": trial.unknowns,
        "inside": trial.inside,
        "alarms": trial.alarms,
        "per_hour": trial.alarms / trial.hours if trial.hours else None,
        "upper_per_hour": trial.upper if math.isfinite(trial.upper) else None,
        "size": math.exp(float(known.mean())) if len(known) else None,
        "sizes": [
            {
                "kind": f["kind"],
                "signal": f["signal"],
                "unit": f.get("unit", ""),
                "size": math.exp(v) if math.isfinite(v) and math.exp(v) <= f["largest"] else None,
            }
            for f, v in zip(trial.faults, trial.sizes().tolist(), strict=True)
        ],
        "seen": {label: [int(sum(v)), len(v)] for label, v in trial.seen.items()},
    }


def trial_data(trial: Trial) -> dict[str, Any]:
    """A trial for the cache."""
    return {
        "rules": [rule.to_dict() for rule in trial.rules],
        "alarms": trial.alarms,
        "upper": trial.upper,
        "hours": trial.hours,
        "inside": trial.inside,
        "unknowns": trial.unknowns,
        "faults": list(trial.faults),
        "units": trial.units.tolist(),
        "seen": dict(trial.seen),
        "refused": trial.refused,
    }


def trial_from_data(data: Mapping[str, Any], setting: Setting, family: Family) -> Trial:
    """A trial from the cache."""
    return Trial(
        setting,
        family,
        tuple(rule_from_dict(rule) for rule in data["rules"]),
        int(data["alarms"]),
        float(data["upper"]),
        float(data["hours"]),
        float(data["inside"]),
        int(data["unknowns"]),
        tuple(data["faults"]),
        np.array(data["units"], dtype=np.float64),
        data["seen"],
        str(data["refused"]),
    )
