# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What `check` prints of these facts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from uncertain_lti.base.english import plural, times
from uncertain_lti.reports.regimes import MOST_REGIMES
from uncertain_lti.reports.tables import number, table

MOST_REPEATS = 5
"""Frozen repeats that the text lists."""
MOST_LIKENESSES = 3
"""Alarms whose likeness the text has."""


def check_text(data: dict[str, Any]) -> str:
    """Summary of `check_data` for a person."""
    rows = []
    for name, s in data["states"].items():
        longest = s["longest_violation"]
        rows.append(
            [
                name + (f" [{s['unit']}]" if s["unit"] else ""),
                str(s["violations"]),
                "-" if s["inside"] is None else f"{s['inside']:.3%}",
                number(s["mean_width"]),
                number(s["max_width"]),
                "-" if s["first_violation"] is None else f"{s['first_violation']['t']:.4f} s",
                "-" if longest is None else f"{longest['samples']} from {longest['t']:.4f} s",
            ]
        )
    inside = "no verdict" if data["inside"] is None else f"{data['inside']:.3%} inside all bounds"
    head = f"{data['recording']}: {plural(data['samples'], 'sample')}, {plural(data['verdicts'], 'verdict')}, {inside}"
    first = []
    if data["outcome"] == "unknown":
        first = [f"UNKNOWN: {data['reason']}"]
    elif data["alarm"] and data["reason"]:
        first = [f"ALARM, and beware: {data['reason']}"]
    lines = [
        *first,
        head + (f"; no verdict or not used: {', '.join(data['no_verdict'])}" if data["no_verdict"] else ""),
        table(("state", "violations", "inside", "mean width", "largest", "first", "longest"), rows),
    ]
    if over := data.get("horizons"):
        lines.append(table(("steps", "windows", "inside", "first outside", "state"), [_horizon(h) for h in over]))
    visited = [r for r in data["regimes"] if r["verdicts"]]
    if len(visited) > 1 or len(data["regimes"]) > len(visited) > 0:
        header = ("regime", "verdicts", "inside", "unknown", *(f"{name}: mean width" for name in data["states"]))
        lines.append(table(header, [_regime(r) for r in visited[:MOST_REGIMES]]))
        if (more := len(visited) - MOST_REGIMES) > 0:
            lines.append(f"  and {plural(more, 'more regime')}; --json has all")
    if data["verdicts"]:
        lines.append(f"outside the fitted domain: {data['outside_domain'] / data['verdicts']:.2%} of the verdicts")
        if data["unknown_regime"]:
            share = data["unknown_regime"] / data["verdicts"]
            lines.append(f"unknown regime: {share:.2%} of the verdicts, which nothing vouches for")
    lines += [f"  {text}" for text in data["unknown"]]
    lines += [f"{j['text']} at {j['t']:.4f} s" for s in data["states"].values() if (j := s["jump"]) is not None]
    lines += [*repeats_text(data), *likeness_text(data)]
    if data["alarm"]:
        first = data["alarms"][0]
        lines.append(
            f"ALARM: raised {times(len(data['alarms']))}, first at {first['t']:.4f} s for {number(first['seconds'])} s"
        )
        by = [r["words"] for r in first.get("raised", ()) if r["rule"] != "containment"]
        if by:
            lines.append(f"  raised by {', '.join(by[:MOST_REPEATS])}")
    elif data["verdicts"]:
        lines.append("no alarm" + ", which says nothing: see the first line" * (data["outcome"] == "unknown"))
    return "\n".join(lines)


def repeats_text(data: Mapping[str, Any]) -> list[str]:
    """What `check_data` has of frozen states, and of other long repeats."""
    told = data["frozen"][:MOST_REPEATS]
    lines = ["FROZEN: {text}, told after {told_after:.3g} s, {why}".format_map(repeat) for repeat in told]
    if (more := len(data["frozen"]) - MOST_REPEATS) > 0:
        lines.append(f"  and {plural(more, 'more frozen repeat')}; --json has all")
    longest: dict[str, dict[str, Any]] = {}
    for repeat in data["repeats"]:
        if repeat["seconds"] > longest.get(repeat["state"], {"seconds": 0.0})["seconds"]:
            longest[repeat["state"]] = repeat
    lines += [f"warning: {r['text']}, as of a machine at rest: the model does not move it" for r in longest.values()]
    return lines


def likeness_text(data: Mapping[str, Any]) -> list[str]:
    """What `check_data` says of alarms: what they look like, and where they point to."""
    told = [like for like in data["explained"] if like["text"]]
    lines = [f"the alarm from {like['t']:.4f} s {like['text']}" for like in told[:MOST_LIKENESSES]]
    return lines + [f"  and {plural(len(told) - len(lines), 'more alarm')}; --json has all"] * (len(told) > len(lines))


def _horizon(horizon: dict[str, Any]) -> list[str]:
    """Cells of one horizon."""
    left = [(state["first"]["t"], name) for name, state in horizon["states"].items() if state["first"] is not None]
    when, name = min(left, default=(None, "-"))
    return [
        str(horizon["steps"]),
        str(horizon["windows"]),
        "-" if horizon["inside"] is None else f"{horizon['inside']:.3%}",
        "-" if when is None else f"{when:.4f} s",
        name,
    ]


def _regime(regime: dict[str, Any]) -> list[str]:
    """Cells of one regime with verdicts."""
    return [
        regime["regime"],
        str(regime["verdicts"]),
        f"{regime['inside']:.3%}",
        str(regime["unknown_regime"]),
        *(number(state["mean_width"]) for state in regime["states"].values()),
    ]
