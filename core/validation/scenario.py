# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Scenario bound: how likely a whole fresh recording leaves the envelope somewhere."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from uncertain_lti.model.terms import ADDITIVE
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.validation.intervals import discarding_bound, scenario_interval
from uncertain_lti.validation.part import Part, by_unit, unit_numbers

VOID = 0.9
"""A bound on the probability of leaving the envelope is reported only up to this."""


def scenario(model: UncertainLTI, parts: Sequence[Part], what: str, confidence: float) -> dict[str, Any]:
    """The scenario bound on leaving the envelope anywhere in a whole fresh transient or group, or why there is none."""
    G = int(unit_numbers(parts).max(initial=-1)) + 1
    discarded = _discarded(model)
    condition = (
        f"holds if the {what}s were drawn independently of one another from one and the same distribution, and the "
        f"machine will be run like that again; counted by whole {what}s, margin 1; a guide rather than a theorem, as "
        f"the theorem asks for an objective that does not depend on the recordings, and the sum of squared widths does"
    )
    if what == "block":
        return {"words": "no scenario bound: blocks of one recording are not independent of one another"}
    counted = "transients" if what == "recording" else "groups"
    if discarded:
        variables = _variables(model)
        upper = discarding_bound(variables, discarded, G, confidence)
        if upper > VOID:
            return {
                "words": f"not enough {counted} for a scenario bound: {G} with {variables} unknowns and at most "
                f"{discarded} with discarded transitions"
            }
        return {
            "interval": [0.0, upper],
            "discarded": discarded,
            "variables": variables,
            "words": f"a fresh {what} leaves the envelope with a probability of at most {upper:.1%} "
            f"(confidence {confidence:.0%}); {condition}, and each {what} with a discarded transition counted as "
            f"discarded",
        }
    support = int(np.count_nonzero(by_unit(parts, [p.violated for p in parts])))
    low, high = scenario_interval(support, G, confidence)
    if high > VOID:
        return {
            "support": support,
            "words": f"not enough {counted} for a scenario bound: {support} of {G} left the envelope of the others; "
            f"record more of them",
        }
    return {
        "support": support,
        "interval": [low, high],
        "words": f"a fresh {what} leaves the envelope somewhere with a probability between {low:.1%} and "
        f"{high:.1%} (confidence {confidence:.0%}, {support} of {G} {what}s left the envelope of the others); "
        f"{condition}",
    }


def _variables(model: UncertainLTI) -> int:
    nominal = model.n * (model.n + model.m)
    return 2 * nominal + sum(int(getattr(model, name).any()) * model.n for term in ADDITIVE for name in term.names)


def _discarded(model: UncertainLTI) -> int:
    """Recordings at most that lost a transition to the budget of outliers."""
    listed = model.fit_summary.get("discarded", [])
    return len(listed) if isinstance(listed, (list, tuple)) else 0
