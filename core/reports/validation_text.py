# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What `validate`, `tune` and `signature` print, and `fit` of what it left out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from uncertain_lti.base.english import plural
from uncertain_lti.reports.detectable_text import detectable_data, detectable_text
from uncertain_lti.reports.tables import number, table
from uncertain_lti.validation.signatures import Learnt

MOST_PARTS = 20
"""Recordings or blocks that the table of each names, those with most alarms first."""


def validation_text(data: dict[str, Any]) -> str:
    """Summary of `Validation.to_dict()`, with the calibration if there is one, for a person."""
    what = "recording" if data["kind"] == "transients" else "block"
    gap = f", {number(data['gap'])} s on both sides not fitted either" if data["kind"] == "blocks" else ""
    condition = data.get("condition_short")  # files written before it was stored have none
    under = f", {condition}" if condition else ""
    lines = [
        f"left out one {_unit(data)} at a time ({_how_many(data)}{gap}): {plural(data['verdicts'], 'verdict')}, "
        f"{number(data['hours'])} h",
        table(
            ("left out", "inside", f"{what}s inside", "mean width", "largest", "fitted: mean width", "largest"),
            [
                [
                    name + (f" [{s['unit']}]" if s["unit"] else ""),
                    "-" if s["inside"] is None else f"{s['inside']:.3%}",
                    f"{s['parts_inside']}/{data['parts']}",
                    number(s["mean_width_left_out"]),
                    number(s["max_width_left_out"]),
                    number(s["mean_width_full"]),
                    number(s["max_width_full"]),
                ]
                for name, s in data["states"].items()
            ],
        ),
    ]
    if data["inside"] is not None:
        percent = f"{data['confidence']:.0%}"
        low, high = data["inside_interval"]
        lines.append(
            f"inside all bounds: {data['inside']:.3%} of the verdicts "
            f"({percent} interval {low:.3%} to {high:.3%}{under})"
        )
        low, high = data["parts_inside_interval"]
        lines.append(
            f"whole {what}s inside all bounds: {data['parts_inside']} of {data['parts']} "
            f"({percent} interval {low:.1%} to {high:.1%}{under})"
        )
        if groups := data.get("groups"):
            lines.append(f"whole groups inside all bounds: {groups['inside']} of {groups['count']}")
        lines.append(
            table(
                ("alarm rule", "alarms", "per hour", f"{percent} interval{under}", "time in alarm"),
                [
                    [
                        rule_text(a),
                        str(a["alarms"]),
                        number(a["per_hour"]),
                        _interval(*a["interval"]),
                        f"{a['raised_share']:.3%}",
                    ]
                    for a in data["false_alarms"]
                ],
            )
        )
    lines += _each(data, what)
    if "condition" in data:
        lines.append(data["condition"])
    lines.append(data["scenario"]["words"])
    if (faults := detectable_data(data)) is not None:
        lines += detectable_text(faults)
    lines += data.get("promises", [])
    return "\n".join(lines + [f"note: {note}" for note in data["notes"]])


def rule_text(alarm: Mapping[str, Any]) -> str:
    """An alarm in a table, of files of before this version as well."""
    if "rule" not in alarm:
        return f"{alarm['violations']} of {alarm['window']}, margin {number(alarm['margin'])}"
    return "the model's" if "; or " in alarm["rule"] else str(alarm["rule"])


def _each(data: dict[str, Any], what: str) -> list[str]:
    """What was found on each part, those with most alarms and violations first."""
    parts = [p for p in data.get("part", []) if "alarms" in p]  # files written before they were counted have none
    if not parts:
        return []
    worst = sorted(parts, key=lambda p: (-p["alarms"], -p["violated"] / max(p["verdicts"], 1)))
    rows = [
        [
            p["name"],
            str(p["verdicts"]),
            f"{1 - p['violated'] / p['verdicts']:.3%}" if p["verdicts"] else "-",
            f"{p['outside_domain'] / p['verdicts']:.2%}" if p["verdicts"] else "-",
            str(p["alarms"]),
            "-" if p["alarm_share"] is None else f"{p['alarm_share']:.3%}",
            "-" if p["farthest"] is None else f"{p['farthest_state']}, {p['farthest']:.3g} x",
        ]
        for p in worst[:MOST_PARTS]
    ]
    header = (what, "verdicts", "inside", "outside domain", "alarms", "time in alarm", "farthest, in half-widths")
    more = len(parts) - MOST_PARTS
    return [table(header, rows), *([f"  and {plural(more, f'more {what}')}; --json has all"] if more > 0 else [])]


def left_out_text(data: dict[str, Any]) -> str:
    """Short form of `validation_text`, one line, for a fit, with the hint that recordings may come in groups."""
    if "not_done" in data:
        return f"not validated, so how it does on other recordings is unknown: {data['not_done']}"
    what = "recording" if data["kind"] == "transients" else "block"
    ratio = max((s["left_out_to_full"] for s in data["states"].values()), default=math.nan)
    inside = "no verdict" if data["inside"] is None else f"{data['inside']:.3%} of the verdicts inside"
    groups = data["groups"]
    of = f"{groups['count']} at a time ({_how_many(data)})" if groups else f"{data['parts']} at a time"
    line = (
        f"left out one {_unit(data)} of {of}: {inside}, "
        f"{plural(data['parts_inside'], f'whole {what}')}, widths at most {ratio:.3g} times those above; more: "
        f"uncertain-lti validate"
    )
    return f"{line}\nnote: {data['hint']}" if data["hint"] else line


def _unit(data: dict[str, Any]) -> str:
    """What was left out at a time."""
    return "group" if data.get("groups") else "recording" if data["kind"] == "transients" else "block"


def _how_many(data: dict[str, Any]) -> str:
    """How many there are of it."""
    parts = plural(data["parts"], "recording" if data["kind"] == "transients" else "block")
    groups = data.get("groups")
    return f"{parts} in {plural(groups['count'], 'group')}, by {groups['key']}" if groups else parts


def _interval(low: float, high: float | None) -> str:
    """A lower limit that is next to nothing is nothing; no upper limit is stated as such."""
    if high is None:
        return "unknown"
    return f"{number(low if low > 1e-4 * high else 0.0)} to {number(high)}"


def tune_text(data: dict[str, Any]) -> str:
    """What `tune` prints: every way that was tried, and what was chosen."""
    rows = [
        [
            trial["way"],
            number(trial["size"]),
            "-" if trial["width_over_range"] is None else f"{trial['width_over_range']:.2%}",
            "-" if trial["limit_per_hour"] is None else number(trial["limit_per_hour"]),
        ]
        for trial in data["trials"]
        if "refused" not in trial
    ]
    header = ("way", "jumps seen, over those of fit", "width/range", "false alarms per hour at most")
    refused = [f"  {t['way']}: {t['refused']}" for t in data["trials"] if "refused" in t]
    return "\n".join([table(header, rows), *refused, f"chosen: {data['reason']}"])


def signature_text(learnt: Learnt) -> str:
    """What `signature` prints."""
    rows = [[s.label, str(s.recordings), str(s.verdicts), ", ".join(map(str, s.steps))] for s in learnt.signatures]
    lines = [table(("signature", "recordings", "verdicts", "steps"), rows)]
    labels = [label for _, label, _ in learnt.named]
    tried = [(label, found) for _, label, found in learnt.named if labels.count(label) > 1]
    if tried:
        right = sum(label == found for label, found in tried)
        unknown = sum(not found for _, found in tried)
        lines.append(
            f"left out in turn, {right} of {plural(len(tried), 'recording')} named as labelled, "
            f"{len(tried) - right - unknown} as another fault, {unknown} unknown"
        )
    lines += [f"'{a}' and '{b}' look alike (match {match:.2f}), so neither is named" for a, b, match in learnt.alike]
    return "\n".join(lines)
