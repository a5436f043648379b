# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Result of a validation: the parts, with what follows from them as plain data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.text import finite_data, html_table, named, number, plural
from uncertain_lti.kernel.arithmetic import settled
from uncertain_lti.model.alarm_rule import AlarmRule, Rule, containment
from uncertain_lti.model.terms import ADDITIVE
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.alarm import Alarm
from uncertain_lti.validation.intervals import discarding_bound, rate_interval, scenario_interval, share_interval
from uncertain_lti.validation.part import Part, by_unit, rising, unit_numbers


def raised_on(rules: Sequence[Rule], part: Part) -> NDArray[np.bool_]:
    """(K,): whether the rules raise the alarm, after each verdict of a part that was left out."""
    model = part.judged_by
    one_step = containment(rules)
    margin = 1.0 if one_step is None else one_step.margin
    violated = ~(np.nan_to_num(np.abs(settled(part.utilisation, ~part.outside)).max(axis=1)) <= margin)
    return Alarm(rules, model, np.ones(model.n, dtype=bool)).over(part.spans, part.dt, violated, part.rows)


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


VOID = 0.9
"""A bound on the probability of leaving the envelope is reported only up to this."""


def scenario(model: UncertainLTI, parts: Sequence[Part], what: str, confidence: float) -> dict[str, Any]:
    """The scenario bound on leaving the envelope anywhere in a whole fresh transient or group, or why there is none."""
    if what == "block":
        return {"words": "no scenario bound: blocks of one recording are not independent of one another"}
    condition = (
        f"holds if the {what}s were drawn independently of one another from one and the same distribution, and the "
        f"machine will be run like that again; counted by whole {what}s, margin 1; a guide rather than a theorem, as "
        f"the theorem asks for an objective that does not depend on the recordings, and the sum of squared widths does"
    )
    G = int(unit_numbers(parts).max(initial=-1)) + 1
    if discarded := len(model.fit_summary.get("discarded", [])):  # at most so many lost a transition to the budget
        terms = [name for term in ADDITIVE for name in term.names if getattr(model, name).any()]
        variables = 2 * model.n * (model.n + model.m) + model.n * len(terms)
        low, high = 0.0, discarding_bound(variables, discarded, G, confidence)
        facts = {"discarded": discarded, "variables": variables} if high <= VOID else {}
        few = f"{G} with {variables} unknowns and at most {discarded} with discarded transitions"
        said = f"with a probability of at most {high:.1%} (confidence {confidence:.0%})"
        condition += f", and each {what} with a discarded transition counted as discarded"
    else:
        support = int(np.count_nonzero(by_unit(parts, [p.violated for p in parts])))
        low, high = scenario_interval(support, G, confidence)
        facts = {"support": support}
        few = f"{support} of {G} left the envelope of the others; record more of them"
        said = (
            f"somewhere with a probability between {low:.1%} and {high:.1%} (confidence {confidence:.0%}, {support} of "
            f"{G} {what}s left the envelope of the others)"
        )
    if high > VOID:
        counted = "transients" if what == "recording" else "groups"
        return {**facts, "words": f"not enough {counted} for a scenario bound: {few}"}
    return {**facts, "interval": [low, high], "words": f"a fresh {what} leaves the envelope {said}; {condition}"}


@dataclass(frozen=True, repr=False)
class Validation:
    """What `validate` found.

    Parameters
    ----------
    model : UncertainLTI
        The fit to all recordings.
    parts : tuple of Part
        What was left out, one after the other.
    kind : str
        `transients` or `blocks`.
    gap : float
        Time on both sides of a left-out block that was not fitted either, s; 0 for transients.
    confidence : float
        Of every interval.
    grouping : str
        In words, what the groups are that were left out as a whole; "" if every part was left out alone.
    hint : str
        A sentence if the recordings seem to come in groups and none were given, else "".
    """

    model: UncertainLTI
    parts: tuple[Part, ...]
    kind: str
    gap: float
    confidence: float
    grouping: str = ""
    hint: str = ""

    def judged_as(self, model: UncertainLTI) -> Validation:
        """The same of the model with its alarm.

        Parameters
        ----------
        model : UncertainLTI
            The fit to all recordings, with residuals of one form.

        Returns
        -------
        Validation
            Whose parts are judged as that model judges.
        """
        return replace(self, model=model, parts=tuple(part.judged_as(model) for part in self.parts))

    @property
    def what(self) -> str:
        """What was left out at a time, and what every interval treats as independent: recording, block or group."""
        return "group" if self.grouping else "recording" if self.kind == "transients" else "block"

    @property
    def units(self) -> int:
        """How many of them there are."""
        return int(unit_numbers(self.parts).max(initial=-1)) + 1

    def __repr__(self) -> str:
        judged, violated = sum(p.judged for p in self.parts), sum(p.violated for p in self.parts)
        inside = f"{1 - violated / judged:.3%} of {plural(judged, 'verdict')} inside" if judged else "no verdict"
        whole = int(np.count_nonzero(by_unit(self.parts, [p.violated for p in self.parts]) == 0))
        of = "groups" if self.grouping else self.kind
        return f"Validation(left out one of {self.units} {of}: {inside}, {whole} whole)"

    def _repr_html_(self) -> str:
        """Coverage and widths, from `Validation.to_dict()`."""
        data = self.to_dict()
        rows = [
            [
                named(name, s["unit"]),
                "-" if s["inside"] is None else f"{s['inside']:.3%}",
                f"{s['parts_inside']}/{data['parts']}",
                number(s["mean_width_left_out"]),
                number(s["mean_width_full"]),
            ]
            for name, s in data["states"].items()
        ]
        below = []
        if data["inside"] is not None:
            low, high = data["inside_interval"]
            below.append(
                f"inside all bounds: {data['inside']:.3%} of {plural(data['verdicts'], 'verdict')} "
                f"({data['confidence']:.0%} interval {low:.3%} to {high:.3%})"
            )
        for rule in data["false_alarms"][:1]:
            below.append(f"false alarms per hour at {rule['rule']}: {number(rule['per_hour'])}")
        below += [data["scenario"]["words"], *(f"note: {note}" for note in data["notes"])]
        return html_table(repr(self), ("left out", "inside", "whole parts", "mean width", "fitted"), rows, below)

    def to_dict(self) -> dict[str, Any]:
        """Plain data: coverage and widths, false alarms per hour with intervals, scenario bound in words.

        Returns
        -------
        dict
            The fields are described in docs/validation.md.
        """
        v, model, parts = self, self.model, self.parts
        judged = sum(p.judged for p in parts)
        hours = sum(p.hours for p in parts)
        violated = [p.violated for p in parts]
        inside = sum(p.violated == 0 for p in parts)
        held_width = _average(parts, [p.mean_width for p in parts])
        states = {}
        for i, name in enumerate(model.state_names):
            bad = sum(int(p.outside[:, i].sum()) for p in parts)
            states[name] = {
                "inside": 1.0 - bad / judged if judged else None,
                "parts_inside": sum(not p.outside[:, i].any() for p in parts),
                "mean_width_left_out": float(held_width[i]),
                "max_width_left_out": float(np.nanmax([p.max_width[i] for p in parts])),
                "mean_width_full": float(model.fit_summary["mean_width_recorded"][i]),
                "max_width_full": float(model.fit_summary["max_width_recorded"][i]),
                "left_out_to_full": float(_average(parts, [p.relative_width for p in parts])[i]),
                "unit": model.signals.states[i].unit,
            }
        units = by_unit(parts, violated)
        low, high = rate_interval(units, judged, v.confidence) if judged else (0.0, math.inf)
        whole = list(share_interval(inside, len(parts), v.confidence))
        if v.grouping:  # by clusters
            least, most = rate_interval(by_unit(parts, [n > 0 for n in violated]), len(parts), v.confidence)
            whole = [max(0.0, 1.0 - most), 1.0 - least]
        whole_groups = int(np.count_nonzero(units == 0))
        recordings = {p.group: [q.name for q in parts if q.group == p.group] for p in parts}
        groups = {"key": v.grouping, "count": v.units, "inside": whole_groups, "recordings": recordings}
        outside = (AlarmRule(margin=model.alarm_rule.margin),)
        alarms = [false_alarms(parts, rules, v.confidence) for rules in dict.fromkeys((model.alarm, outside))]
        return {
            "kind": v.kind,
            "parts": len(parts),
            "gap": v.gap,
            "confidence": v.confidence,
            "verdicts": judged,
            "hours": hours,
            "inside": 1.0 - sum(violated) / judged if judged else None,
            "inside_interval": [max(0.0, 1.0 - high), 1.0 - low],
            "parts_inside": inside,
            "parts_inside_share": inside / len(parts),
            "parts_inside_interval": whole,
            "groups": groups if v.grouping else None,
            "condition": condition(v),
            "condition_short": f"if the {v.what}s are independent and show all that happens",
            "hint": v.hint,
            "outside_domain": sum(p.outside_domain for p in parts),
            "violated_inside_domain": sum(p.unseen for p in parts),
            "states": states,
            "false_alarms": alarms,
            "scenario": scenario(model, parts, v.what, v.confidence),
            "part": [_part(p, model) for p in parts],
            "notes": _notes(v),
        }


def _part(part: Part, model: UncertainLTI) -> dict[str, Any]:
    """What was found on one part: counts, alarms of the model's rule, and the state that went farthest."""
    raised = raised_on(model.alarm, part)
    farthest, of = None, None
    if part.judged:
        sizes = np.nan_to_num(np.abs(part.utilisation), posinf=np.inf)
        k, i = np.unravel_index(int(np.argmax(sizes)), sizes.shape)
        farthest, of = finite_data(sizes[k, i]), model.state_names[int(i)]
    return {
        "name": part.name,
        "verdicts": part.judged,
        "violated": part.violated,
        "outside_domain": part.outside_domain,
        "alarms": rising(raised, part.starts),
        "alarm_share": float(part.dt[raised].sum() / part.dt.sum()) if part.judged else None,
        "farthest": farthest,
        "farthest_state": of,
    }


def condition(validation: Validation) -> str:
    """What must be true for the intervals to hold."""
    v = validation
    if v.kind == "blocks":
        return (
            f"every interval counts {plural(v.units, 'block')}, and holds for more of the same runs if the blocks are "
            f"independent of one another; it says nothing about another day, machine or operator"
        )
    alike = "" if v.grouping else ", machines or operators"
    unseen = 1.0 - (1.0 - v.confidence) ** (1.0 / max(v.units, 1))
    return (
        f"every interval counts {plural(v.units, v.what)}, and holds if they are independent of one another and the "
        f"machine is run like that again: no other days{alike} that differ by more than these do, no wear, no kind of "
        f"event that none of them shows; one that comes in less than {unseen:.0%} of the {v.what}s may be in none of "
        f"them"
    )


def _average(parts: Sequence[Part], values: Sequence[Array]) -> Array:
    """Mean over parts by their verdicts, (n,)."""
    weight, stacked = np.array([p.judged for p in parts], dtype=np.float64), np.array(values)
    used = weight > 0
    return np.asarray(weight[used] @ stacked[used] / (weight.sum() if used.any() else math.nan))


def _notes(validation: Validation) -> list[str]:
    v = validation
    G, what = v.units, f"{v.what}s"
    notes = [
        f"the numbers are those of models fitted to {G - 1} of the {G} {what}: the model of all {G} is a little "
        f"better, so they err on the safe side"
    ]
    if v.hint:
        notes.insert(0, v.hint)
    if G < 6:
        notes.append(f"{G} {what} say little: an interval from few {what} is wide, and assumes that they are typical")
    if count := len(v.model.fit_summary.get("discarded", [])):
        notes.append(
            f"every left-out fit may discard {count} transitions as well; in what is left out nothing is discarded, so "
            f"outliers there count as violations"
        )
    if v.kind == "blocks":
        notes.append(
            "blocks show how the model does on the same run at another time; another run, load or day can differ by "
            "more than blocks of one run do: record several"
        )
    left = sum(p.outside_domain for p in v.parts)
    judged = sum(p.judged for p in v.parts)
    if judged and left > 0.01 * judged:
        notes.append(
            f"{left / judged:.1%} of the left-out verdicts lie outside the domain fitted without them, so the "
            f"{what} do not repeat one another: the bounds there are not backed by any fitted sample"
        )
    return notes
