# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""An interactive plot as one HTML file that needs nothing else: zoom and hover, in any browser, without a network.

The drawing in the browser is done by uPlot (`assets/README.md`). The page lets no other script run and loads nothing.
Long recordings are drawn in columns with their least and greatest value, and sample by sample around violations.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from markupsafe import Markup

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.english import plural
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.verdict import Verdicts
from uncertain_lti.reports import charts
from uncertain_lti.reports.charts import Columns, Panel, Series, Spans
from uncertain_lti.reports.html import asset, environment
from uncertain_lti.sampling.transient import Transient

MOST_NUMBERS = 330_000
"""Numbers in a page, 1.8 MB of them; recordings and signals share them."""
_FEWEST = 500

Placed = tuple[Columns, Panel]


@dataclass(frozen=True)
class Plotted:
    """One recording as it is plotted.

    `note`: a sentence below the heading; `views`: what can be chosen to be drawn, its name and its panels; `top`: a
    panel above those of every view; `alarms, silent`: stretches of alarm, and without a verdict, s.
    """

    name: str
    note: str
    views: list[tuple[str, list[Placed]]]
    top: list[Placed] = field(default_factory=list)
    alarms: Spans = field(default_factory=list)
    silent: Spans = field(default_factory=list)


def plotted_check(model: UncertainLTI, verdicts: Verdicts, recordings: int = 1) -> Plotted:
    """A recording that was checked: the alarm's score, utilisation, states between their bounds, controls."""
    numbers = (6 + 2 * len(model.steps)) * model.n + 2 * model.m + 3
    columns = charts.columns_of(verdicts, _stretches(recordings, numbers), fine=True)
    views = [charts.utilisation_chart(model, verdicts, columns), charts.envelope_chart(model, verdicts, columns)]
    views += [charts.utilisation_chart(model, verdicts, columns, row=1 + h) for h in range(len(model.steps))]
    words = ["utilisation" + ", 1 step" * bool(model.steps), "values", *_horizons(model)]
    placed = [
        sorted(((columns, p) for p in chart.panels if isinstance(p, Panel)), key=lambda placed: -placed[1].rank)
        for chart in views
    ]
    run = verdicts.transient
    placed[1] += _panels(columns, run.u, [(s.name, s.unit) for s in model.signals.controls], "control")
    top, _ = charts.score_panel(model, verdicts, columns)
    note = f"{charts.heading(verdicts)}. {top.title}: {top.note}{_how(columns)}."
    return Plotted(
        charts.base_name(run.name), note, list(zip(words, placed, strict=True)), [(columns, top)], columns.alarms,
        columns.silent,
    )  # fmt: skip


def _horizons(model: UncertainLTI) -> list[str]:
    return [f"utilisation, {plural(steps, 'step')}" for steps in model.steps]


def plotted_transient(transient: Transient, recordings: int = 1) -> Plotted:
    """A recording that was read with a signals file, and not checked."""
    numbers = 2 * (len(transient.state_names) + len(transient.control_names)) + 2
    columns = Columns.of(transient.t, transient.segment, most=_stretches(recordings, numbers))
    units = {s.name: s.unit for s in transient.signals.signals} if transient.signals else {}
    panels = []
    for names, values, role in (
        (transient.state_names, transient.x, "recorded"), (transient.control_names, transient.u, "control"),
    ):  # fmt: skip
        panels += _panels(columns, values, [(name, units.get(name, "")) for name in names], role)
    note = f"{plural(len(transient.t), 'sample')}{_how(columns)}."
    return Plotted(charts.base_name(transient.name), note, [("values", panels)])


def plotted_fields(
    name: str, fields: Sequence[tuple[str, str, Array, Array]], note: str, recordings: int = 1
) -> Plotted:
    """Numbers of messages over their time of arrival: topic, path, time in s and value of each."""
    panels = []
    for topic, path, recorded, values in fields:
        columns = Columns.of(recorded, most=_stretches(recordings, 4 * len(fields)))
        panels += _panels(columns, values[:, None], [(f"{topic} {path}", "")], "recorded")
    return Plotted(charts.base_name(name), note, [("values", panels)])


def interactive_page(title: str, recordings: Sequence[Plotted]) -> str:
    """The page."""
    data = {"recordings": [_packed(recording) for recording in recordings]}
    packed = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    scripts = [asset(name).rstrip("\n") for name in ("uPlot.iife.min.js", "plot.js")]
    allowed = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    views = list(dict.fromkeys(view for recording in recordings for view, _ in recording.views))
    style = f"{asset('uPlot.min.css')}\n{asset('plot.css')}"
    return (
        environment()
        .from_string(asset("plot.html"))
        .render(
            title=title, views=views, allowed=allowed, style=Markup(style), data=Markup(packed),
            scripts=[Markup(script) for script in scripts],
        )
    )  # fmt: skip


def _stretches(recordings: int, numbers: int) -> int:
    """Columns of one recording that has this many numbers in each."""
    return max(MOST_NUMBERS // (max(recordings, 1) * max(numbers, 1)), _FEWEST)


def _panels(columns: Columns, values: Array, names: Sequence[tuple[str, str]], role: str) -> list[Placed]:
    low, high = columns.extremes(np.where(np.isfinite(values), values, np.nan) if len(values) < 1e6 else values)
    return [
        (columns, Panel(name, (Series(role, low[:, i], high[:, i] if columns.binned else None),), unit))
        for i, (name, unit) in enumerate(names)
    ]


def _packed(recording: Plotted) -> dict[str, Any]:
    axes: dict[int, int] = {}
    placed = [*recording.top, *(p for _, panels in recording.views for p in panels)]
    times: list[str] = []
    for columns, _ in placed:
        if id(columns) not in axes:
            axes[id(columns)] = len(times)
            at = np.flatnonzero(columns.apart)  # what parts two lines is drawn with the second
            times.append(_text(np.insert(columns.t, at, columns.t[at]).astype("<f8")))

    def panel(placed: Placed) -> dict[str, Any]:
        columns, drawn = placed
        return {
            "title": drawn.title, "unit": drawn.unit, "time": axes[id(columns)], "note": drawn.note,
            "rank": drawn.rank if drawn.rank < 1e300 else None, "levels": drawn.levels,
            "word": next(s.role for s in drawn.series if s.role != "bounds"), "values": _series(columns, drawn),
        }  # fmt: skip

    return {
        "name": recording.name, "note": recording.note, "times": times, "top": [panel(p) for p in recording.top],
        "views": {view: [panel(p) for p in panels] for view, panels in recording.views}, "alarms": recording.alarms,
        "silent": recording.silent,
    }  # fmt: skip


def _series(columns: Columns, panel: Panel) -> Mapping[str, Any]:
    """Each array less the middle of all, so that four bytes a number tell neighbours apart; marks are few."""
    at = np.flatnonzero(columns.apart)
    present: dict[str, Array] = {}
    for series in panel.series:
        names = ("lower", "upper") if series.role == "bounds" else ("least", "greatest")
        sides = (series.high, None) if series.role == "score" else (series.low, series.high)
        present |= {n: np.insert(a, at, np.nan) for n, a in zip(names, sides, strict=True) if a is not None}
    marks = {}
    if panel.marks is not None:
        marked = np.insert(panel.marks, at, np.nan)
        there = np.flatnonzero(~np.isnan(marked))
        present["marked"], marks = marked[there], {"at": _text(there.astype("<u4"))}
    every = np.concatenate([value[np.isfinite(value)] for value in present.values()])
    offset = float((every.min() + every.max()) / 2) if len(every) else 0.0
    with np.errstate(over="ignore"):
        return {
            key: {"offset": offset, "data": _text((value - offset).astype("<f4"))} | (marks if key == "marked" else {})
            for key, value in present.items()
        }


def _text(array: Any) -> str:
    return base64.b64encode(array.tobytes()).decode("ascii")


def _how(columns: Columns) -> str:
    if not columns.binned:
        return ""
    return (
        f". {columns.stop - int(columns.starts[0])} samples are drawn as {len(columns.starts)} columns with their "
        "least and greatest value; where bounds are violated, sample by sample"
    )
