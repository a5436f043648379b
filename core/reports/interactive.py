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
Long recordings are drawn by stretches with their least and greatest value, and sample by sample around violations.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from typing import Any

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.english import plural
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.verdicts import Verdicts
from uncertain_lti.reports.figure_columns import DrawnColumns, TimeAxis, forward
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.signal_map import Signal

MOST_NUMBERS = 1_500_000
"""Numbers in a page, 6 MB of them; recordings and signals share them."""

_FEWEST = 500
_FARTHEST = 1000.0  # utilisation that is written


@dataclass(frozen=True)
class Series:
    """Values of one quantity over the times of a recording, as drawn; NaN parts two lines.

    `least` (P,): least value of each stretch, or each sample; `greatest` (P,): greatest values; None if every stretch
    is one sample; `lower` (P,): least lower bounds; `upper` (P,): greatest upper bounds; `marked` (P,): the worst
    violated value of each stretch; NaN where none is.
    """

    least: Array
    greatest: Array | None = None
    lower: Array | None = None
    upper: Array | None = None
    marked: Array | None = None


@dataclass(frozen=True)
class Panel:
    """One signal.

    `title`: its name; `unit`: its unit, or empty; `time`: which of the recording's times it is drawn over; `values`: in
    recorded units; `word`: what a single value is called; `rank`: panels with more are shown first; `utilisation`:
    where between the bounds it lay; `horizons`: the same by each of the recording's horizons.
    """

    title: str
    unit: str
    time: int
    values: Series
    word: str = "recorded"
    rank: float = 0.0
    utilisation: Series | None = None
    horizons: tuple[Series, ...] = ()


@dataclass(frozen=True)
class PlottedRecording:
    """One recording as it is plotted.

    `name`: its name; `note`: A sentence below the heading; `times`: s since the start; panels name one of them by its
    place; `panels`: its signals; `alarms, silent`: begin and end of each stretch of alarm, and of each without a
    verdict, s; `horizons`: what each of the model's horizons is called.
    """

    name: str
    note: str
    times: list[Array]
    panels: list[Panel]
    alarms: list[tuple[float, float]] = field(default_factory=list)
    silent: list[tuple[float, float]] = field(default_factory=list)
    horizons: tuple[str, ...] = ()


def plotted_check(model: UncertainLTI, verdicts: Verdicts, recordings: int = 1) -> PlottedRecording:
    """A recording that was checked: states between their bounds, controls, alarms."""
    transient = verdicts.transient
    axis = TimeAxis(transient)
    violated = verdicts.violated
    drawn = DrawnColumns.detailed(
        axis.t, transient.segment, verdicts.judged, verdicts.alarm, violated | verdicts.alarm,
        _stretches(recordings, (8 + 3 * len(model.steps)) * model.n + 2 * model.m),
    )  # fmt: skip
    panels = []

    def utilisation_series(utilisation: Array, flags: Any) -> Series:
        clipped = np.clip(utilisation, -_FARTHEST, _FARTHEST)
        return _series(drawn, clipped, marked=_worst(drawn, flags, clipped, clipped))

    for i, signal in enumerate(model.signals.states):
        x, utilisation = transient.x[:, i], np.clip(verdicts.utilisation[:, i], -_FARTHEST, _FARTHEST)
        flags = verdicts.flags[:, i] == 1.0
        values = _series(drawn, x, verdicts.lower[:, i], verdicts.upper[:, i], _worst(drawn, flags, utilisation, x))
        shares = utilisation_series(utilisation, flags)
        longer = verdicts.longer_utilisation[:, :, i].T
        horizons = tuple(utilisation_series(u, np.abs(u) > 1.0) for u in longer)
        panels.append(Panel(signal.name, signal.unit, 0, values, "recorded", float(flags.sum()), shares, horizons))
    panels += _controls(drawn, transient, model.signals.controls)
    judged, bad = int(verdicts.judged.sum()), int(violated.sum())
    note = f"{plural(judged, 'verdict')}, {bad} of them violated" + _loops(axis) + _how(drawn, len(axis.t)) + "."
    return PlottedRecording(
        _name(transient.name), note, [_times(drawn)], panels,
        _runs(drawn, drawn.alarm), _runs(drawn, ~drawn.judged, skip_first=True), horizon_words(model),
    )  # fmt: skip


def horizon_words(model: UncertainLTI) -> tuple[str, ...]:
    """Each horizon of a model by its steps and, where the model knows its step, its time."""
    step = model.sampling.dt_median
    return tuple(f"{h} steps" + ("" if step is None else f" ({h * step:.3g} s)") for h in model.steps)


def plotted_transient(transient: Transient, recordings: int = 1) -> PlottedRecording:
    """The signals of a recording, without a model."""
    axis = TimeAxis(transient)
    none = np.zeros(len(axis.t), dtype=bool)
    count = transient.x.shape[1] + transient.u.shape[1]
    drawn = DrawnColumns.detailed(axis.t, transient.segment, none, none, none, _stretches(recordings, 2 * count))
    units = (
        {s.name: s.unit for s in (*transient.signals.states, *transient.signals.controls)} if transient.signals else {}
    )
    panels = [
        Panel(name, units.get(name, ""), 0, _series(drawn, column))
        for names, columns in ((transient.state_names, transient.x), (transient.control_names, transient.u))
        for name, column in zip(names, columns.T, strict=True)
    ]
    note = plural(len(axis.t), "sample") + _loops(axis) + _how(drawn, len(axis.t)) + "."
    return PlottedRecording(_name(transient.name), note, [_times(drawn)], panels)


def plotted_fields(
    name: str, fields: Sequence[tuple[str, str, Array, Array]], note: str, recordings: int = 1
) -> PlottedRecording:
    """Numbers of messages over their time of arrival, without a signals file.

    `fields` (messages,): topic, path, time in s and value of each.
    """
    times: list[Array] = []
    panels = []
    for topic, path, recorded, values in fields:
        t, _ = forward(recorded)
        none = np.zeros(len(t), dtype=bool)
        zero = np.zeros(len(t), dtype=np.int32)
        drawn = DrawnColumns.detailed(t, zero, none, none, none, _stretches(recordings, 3 * len(fields)))
        times.append(_times(drawn))
        panels.append(Panel(f"{topic} {path}", "", len(times) - 1, _series(drawn, values), "value"))
    return PlottedRecording(_name(name), note, times, panels)


def interactive_page(title: str, recordings: Sequence[PlottedRecording]) -> str:
    """The page."""
    horizons = max((recording.horizons for recording in recordings), key=len, default=())
    data = {"recordings": [_packed(recording) for recording in recordings]}
    further = "".join(f'<option value="{k}">utilisation, {words}</option>' for k, words in enumerate(horizons))
    packed = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    uplot, own = _asset("uPlot.iife.min.js").rstrip("\n"), _asset("plot.js").rstrip("\n")
    allowed = " ".join(
        f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'" for script in (uplot, own)
    )
    keys = "".join(
        f'<span class="key" style="background:{colour}"></span>{word}'
        for colour, word in (
            ("#56B4E9", "bounds"), ("var(--ink)", "recorded"), ("#D55E00", "violated"), ("#F0E442", "alarm"),
            ("#999999", "no verdict"),
        )
    )  # fmt: skip
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; script-src {allowed}; '
        "style-src 'unsafe-inline'\">\n"
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_asset('uPlot.min.css')}\n{_asset('plot.css')}</style>\n</head>\n<body>\n"
        f"<h1>{escape(title)}</h1>\n"
        '<div id="bar"><select id="recording" aria-label="recording"></select>'
        '<select id="view" aria-label="what is drawn"><option value="values">values</option>'
        f'<option value="utilisation">utilisation{", 1 step" if horizons else ""}</option>{further}</select>'
        '<button id="whole">whole</button><button id="in" aria-label="zoom in">+</button>'
        '<button id="out" aria-label="zoom out">&minus;</button>'
        '<button id="before">&#9664; alarm</button><button id="after">alarm &#9654;</button>'
        '<span id="range" aria-live="polite"></span></div>\n'
        f'<p id="note"></p>\n<p id="keys">{keys}</p>\n'
        "<p>Drag: zoom; double click: whole; Shift and drag: move; Ctrl and wheel: zoom; on a phone two fingers.</p>\n"
        '<details id="signals"></details>\n<main id="panels"></main>\n'
        "<noscript><p>This page draws with JavaScript, which is switched off.</p></noscript>\n"
        f'<script type="application/json" id="data">{packed}</script>\n'
        f"<script>{uplot}</script>\n<script>{own}</script>\n</body>\n</html>\n"
    )


def _asset(name: str) -> str:
    return files("uncertain_lti.reports").joinpath("assets", name).read_text(encoding="utf-8")


def _stretches(recordings: int, numbers: int) -> int:
    """Stretches of one recording that has this many numbers in each."""
    return max(MOST_NUMBERS // (max(recordings, 1) * max(numbers, 1)), _FEWEST)


def _controls(drawn: DrawnColumns, transient: Transient, signals: Sequence[Signal]) -> list[Panel]:
    return [
        Panel(signal.name, signal.unit, 0, _series(drawn, column), "control", -1.0)
        for signal, column in zip(signals, transient.u.T, strict=True)
    ]


def _series(
    drawn: DrawnColumns, values: Array, lower: Array | None = None, upper: Array | None = None,
    marked: Array | None = None,
) -> Series:  # fmt: skip
    finite = np.where(np.isfinite(values), values, np.nan)
    of = drawn.broken
    return Series(
        of(drawn.least(finite))[1],
        of(drawn.greatest(finite))[1] if drawn.binned else None,
        None if lower is None else of(drawn.least(lower))[1],
        None if upper is None else of(drawn.greatest(upper))[1],
        None if marked is None else of(marked)[1],
    )


def _times(drawn: DrawnColumns) -> Array:
    """Where each is drawn, s; what parts two lines is drawn with the second."""
    at = np.flatnonzero(drawn.after)
    return np.insert(drawn.t, at, drawn.t[at])


def _worst(drawn: DrawnColumns, flags: Any, utilisation: Array, values: Array) -> Array:
    """Of each stretch the value at its violated sample that lies farthest out; NaN where none is."""
    found = np.full(len(drawn.starts), np.nan)
    rows = np.flatnonzero(flags)
    if len(rows):
        place = np.searchsorted(drawn.starts, rows, side="right") - 1
        order = np.argsort(np.abs(utilisation[rows]), kind="stable")
        found[place[order]] = values[rows[order]]
    return found


def _runs(drawn: DrawnColumns, which: Any, skip_first: bool = False) -> list[tuple[float, float]]:
    which = which.copy()
    if skip_first:
        which[:1] = False
    return [(begin, begin + length) for begin, length in drawn.spans(which)]


def _packed(recording: PlottedRecording) -> dict[str, Any]:
    return {
        "name": recording.name,
        "note": recording.note,
        "times": [_text(np.asarray(t, dtype="<f8")) for t in recording.times],
        "panels": [
            {
                "title": panel.title,
                "unit": panel.unit,
                "time": panel.time,
                "word": panel.word,
                "rank": panel.rank,
                "values": _packed_series(panel.values),
                "utilisation": None if panel.utilisation is None else _packed_series(panel.utilisation),
                "horizons": [_packed_series(series) for series in panel.horizons],
            }
            for panel in recording.panels
        ],
        "alarms": recording.alarms,
        "silent": recording.silent,
    }


def _packed_series(series: Series) -> Mapping[str, Any]:
    """Each array less the middle of all, so that four bytes a number tell neighbours apart."""
    present = {key: value for key, value in vars(series).items() if value is not None}
    every = np.concatenate([value[np.isfinite(value)] for value in present.values()])
    offset = float((every.min() + every.max()) / 2) if len(every) else 0.0
    with np.errstate(over="ignore"):
        return {
            key: {"offset": offset, "data": _text(np.asarray(value - offset, dtype="<f4"))}
            for key, value in present.items()
        }


def _text(array: Any) -> str:
    return base64.b64encode(array.tobytes()).decode("ascii")


def _name(path: str) -> str:
    return os.path.basename(path) or path


def _loops(axis: TimeAxis) -> str:
    return f", {axis.loops + 1} passes one behind the other" if axis.loops else ""


def _how(drawn: DrawnColumns, samples: int) -> str:
    if not drawn.binned:
        return ""
    return (
        f". {samples} samples are drawn as {len(drawn.starts)} stretches with their least and greatest value; where "
        "bounds are violated, sample by sample"
    )
