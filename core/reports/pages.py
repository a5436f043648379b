# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Pages: one HTML file each, with panels to zoom into; of a report also its answers and tables.

Whatever comes from a file (names, units, notes, messages) is text and never HTML: the template escapes every value. The
drawing in the browser is done by uPlot (`assets/README.md`); the page lets no other script run and loads nothing.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment
from markupsafe import Markup, escape

from uncertain_lti.base.arrays import Array, Mask
from uncertain_lti.base.errors import BagError
from uncertain_lti.base.files import target, written
from uncertain_lti.base.text import Block, Table, beyond, number, plural, printable, shortened, shortlist
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.verdict import Verdicts
from uncertain_lti.recordings.recording import Progress, Recording
from uncertain_lti.reports import charts
from uncertain_lti.reports.charts import Columns, Panel, Spans
from uncertain_lti.reports.check import APART, check_blocks
from uncertain_lti.reports.findings import CARE, NO, UNKNOWN, YES, by_outcome, overview
from uncertain_lti.reports.model_text import model_blocks, validation_blocks
from uncertain_lti.sampling.transient import Transient

MOST_NUMBERS = 330_000
"""Numbers in a page, 1.8 MB of them; recordings and signals share them."""
_FEWEST = 500  # columns of a recording
MOST_DRAWN = 6
"""Recordings that a report draws and describes; those with most violations."""
HOLDS = {".html": b"<html", ".png": b"\x89PNG", ".svg": b"<svg", ".pdf": b"%PDF"}
"""Endings of pages and images, and what their files hold near the beginning."""
_SPEAKING = """\
try { Intl.NumberFormat(navigator.language) } catch { Object.defineProperty(navigator, "language", { value: "en" }) }
"""  # uPlot asks for numbers in the language of Chromium without one (LANG=C), which is none
_TONE = {YES: "good", CARE: "care", UNKNOWN: "care", NO: "bad"}

Placed = tuple[Columns, Panel]


def page_target(output: str | os.PathLike[str], model_file: str, bags: Sequence[Recording]) -> Path:
    """Where a page or an image goes; an older one of the same format is replaced, a recording or the model never."""
    path = Path(output)
    image = path.suffix in HOLDS and path.suffix != ".html"
    for other in (*([Path(model_file)] if model_file else []), *(part for bag in bags for part in bag.parts)):
        if path.exists() and other.exists() and path.samefile(other):
            raise BagError(f"{path}: is what the {'plot' if image else 'report'} is about; choose another name")
    kind, example = ("image", "plot.png") if image else ("page", "report.html")
    return target(path, holds=HOLDS.get(path.suffix, b"<html"), kind=kind, example=example)


def write_page(path: str | os.PathLike[str], page: str) -> None:
    """Write a page, whole or not at all."""
    with written(path, BagError) as stream:
        stream.write(page.encode("utf-8", "replace"))


def interactive_page(title: str, recordings: Sequence[Plotted], every: int = 0, **more: Any) -> str:
    """The page of some recordings; `every`: ms between two looks of a live one; `more`: of a report."""
    packed = packed_data(recordings, every).replace("<", "\\u003c")
    scripts = [_SPEAKING + asset("uPlot.iife.min.js").rstrip("\n"), asset("plot.js").rstrip("\n")]
    allowed = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    views = list(dict.fromkeys(view for recording in recordings for view, _ in recording.views))
    style = Markup(f"{asset('uPlot.min.css')}\n{asset('page.css')}")
    marked = {"style": style, "data": Markup(packed), "scripts": [Markup(script) for script in scripts]}
    page = environment().from_string(asset("page.html"))
    return page.render(marked, title=title, every=every, views=views, allowed=allowed, **more)


def packed_data(recordings: Sequence[Plotted], every: int = 0) -> str:
    """What a page draws; a live one asks for it again after so many ms."""
    data = {"recordings": [_packed(recording) for recording in recordings]} | ({"every": every} if every else {})
    return json.dumps(data, allow_nan=False, separators=(",", ":"))


@cache
def environment() -> Environment:
    """Templates: what they are given is escaped, and control characters are replaced."""
    made = Environment(autoescape=True, finalize=lambda v: v if isinstance(v, Markup) else visible(v))
    made.filters["name"] = _name
    return made


def asset(name: str) -> str:
    """Text of a file that pages or layouts are made of."""
    return files("uncertain_lti.reports").joinpath("assets", name).read_text(encoding="utf-8")


def visible(value: object) -> str:
    """A value of a file as text of a page or a layout, which have no control characters."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in str(value))


def _name(value: object) -> Markup:
    """A name: where a line must end inside it, it ends after a low line, a slash or a dash."""
    return Markup("<wbr>").join(escape(visible(part)) for part in re.split(r"(?<=[_/-])(?=[^_/-])", str(value)))


# --- report ------------------------------------------------------------------------------------------------------


def html_report(
    model: UncertainLTI, checked: Sequence[Verdicts], facts: Mapping[str, Any], progress: Progress | None = None
) -> str:
    """The report as one page."""
    recordings = facts["recordings"]
    order = sorted(range(len(checked)), key=lambda i: (not recordings[i]["alarm"], -recordings[i]["violated"]))
    drawn = order[:MOST_DRAWN]
    going: Any = drawn if progress is None else progress(drawn, len(drawn))
    plotted = [plotted_check(model, checked[i], len(drawn)) for i in going]
    conditions = f", {facts['rule']['conditions']}" if facts["rule"]["conditions"] else ""
    trust: list[Block] = ["The model has not been validated."]
    if facts["validation"] is not None:
        trust = validation_blocks(facts["validation"])
    reasons = [[r["weight"], r["text"]] for r in facts["rely"]["reasons"]]
    sections = [  # anchor, title, and blocks; a tuple of one among them is a heading
        ("recordings", "What happened", _what_happened(recordings, drawn)),
        ("model", "The model", model_blocks(model)),
        ("trust", "How far to trust it", [*trust, Table(("weight", "reason"), reasons, left=(1,))]),
        ("origin", "Where it comes from", _where_from(facts)),
    ]
    more: dict[str, Any] = {"about": f"Alarm: {facts['rule']['words']}{conditions}.", "cards": list(_cards(facts))}
    title = charts.base_name(facts["model"]["file"] or "model")
    return interactive_page(title, plotted, sections=sections, version=facts["version"], **more)


def _cards(facts: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    rely, reasons = facts["rely"], facts["rely"]["reasons"]
    items = [{"lead": r["weight"], "tone": _TONE[r["weight"]], "text": printable(r["text"])} for r in reasons]
    answer = rely["answer"]
    yield _card("May I rely on it?", _TONE[answer], answer, items, 6, "trust")
    what, look = _headline(facts)
    items = [{"lead": charts.base_name(h["recording"]), "text": f"{h['text']}."} for h in by_outcome(facts["happened"])]
    card = _card("What happened?", look, what, items, 5, "recordings")
    if answer == NO and look == "bad":
        card["list"].append({"text": "The model is not to be relied on: the machine may be well, and the model wrong."})
    yield card
    items = [{"text": printable(text)} for text in facts["sees"]["texts"]]
    yield _card("Which faults would it see?", "wide", facts["sees"]["answer"], items, 6, "trust")


def _card(title: str, tone: str, answer: str, items: list[dict[str, Any]], most: int, to: str) -> dict[str, Any]:
    """One answer, with the first of its reasons and a link to the others."""
    more = [{"text": f"and {len(items) - most} more", "to": to}] if len(items) > most else []
    return {"title": title, "tone": tone, "answer": answer[:1].upper() + answer[1:], "list": items[:most] + more}


def _headline(facts: Mapping[str, Any]) -> tuple[str, str]:
    states, rely = [h["state"] for h in facts["happened"]], facts["rely"]
    if "alarm" in states:
        return "Alarm", "bad"
    if "violations" in states:
        return "Violations, no alarm", "care"
    if "unknown" in states:
        return "Partly unknown" if "quiet" in states else "Unknown", "care"
    if rely["answer"] == NO or any("proves nothing" in r["text"] for r in rely["reasons"]):
        return "Nothing left its bounds, which says little here", "care"
    return "Nothing left its bounds", "good"


def _episodes(data: Mapping[str, Any]) -> Table:
    """When which states left their bounds; the states early, where a phone shows them without scrolling."""
    rows = []
    for e in data["episodes"]:
        where = sorted(e["states"].items(), key=lambda item: -item[1]["violations"])
        listed = [f"{shortened(name)} ({s['violations']}, worst {beyond(s['utilisation'])})" for name, s in where]
        first, last = f"{e['first']['t']:.4f}", f"{e['last']['t']:.4f}"
        rows.append([first, shortlist(listed, 4), str(e["verdicts_violated"]), "yes" * e["alarm"], last])
    header = ("first [s]", "states (violations, worst utilisation)", "violated", "alarm", "last [s]")
    return Table(header, rows, left=(1,), most=20)


def _what_happened(recordings: Sequence[Mapping[str, Any]], drawn: Sequence[int]) -> list[Any]:
    named = [{**r, "recording": charts.base_name(r["recording"])} for r in recordings]
    blocks: list[Any] = [("All recordings",), overview(named)] if len(named) > 1 else []
    for r in (recordings[i] for i in drawn):
        blocks += [(charts.base_name(r["recording"]),), *check_blocks(r), *r["notes"][:5]]
        if r["episodes"]:
            apart = f"violations with fewer than {APART} verdicts between them"
            blocks += [f"{plural(r['episode_count'], 'episode')} ({apart}):", _episodes(r)]
    return blocks


def _where_from(facts: Mapping[str, Any]) -> list[Block]:
    model = facts["model"]
    rows = [["model checked with", model["file"], model["sha256"] or "none"]]
    rows += [["fitted to", source["file"], source["sha256"]] for source in model["sources"]]
    rows += [["checked", f["file"], f["sha256"]] for r in facts["recordings"] for f in r["files"]]
    fit = [[key, number(v) if isinstance(v, float) else str(v)] for key, v in model["fit"].items()]
    return [Table(("what", "file", "sha256"), rows, left=(1, 2), most=300), Table(("fit", ""), fit, left=(1,))]


# --- panels ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Plotted:
    """One recording as it is plotted.

    `note`: a sentence below the heading; `views`: what can be chosen to be drawn, its name and its panels; `top`: a
    panel above those of every view; `alarms, silent`: stretches of alarm, and without a verdict, s; `title`: of the
    window, where it is not the name.
    """

    name: str
    note: str
    views: list[tuple[str, list[Placed]]]
    top: list[Placed] = field(default_factory=list)
    alarms: Spans = field(default_factory=list)
    silent: Spans = field(default_factory=list)
    title: str = ""


def plotted_check(model: UncertainLTI, verdicts: Verdicts, recordings: int = 1) -> Plotted:
    """A recording that was checked: the alarm's score, utilisation, states between their bounds, controls."""
    numbers = (6 + 2 * len(model.steps)) * model.n + 2 * model.m + 3
    columns = charts.columns_of(verdicts, _stretches(recordings, numbers), fine=True)
    of, states = (model, verdicts, columns), range(model.n)
    top, _ = charts.alarm_panel(*of)
    made = {"utilisation" + ", 1 step" * bool(model.steps): charts.utilisation_chart(*of, states)}
    made["values"] = charts.envelope_chart(*of, states)
    for row, steps in enumerate(model.steps, 1):
        made[f"utilisation, {plural(steps, 'step')}"] = charts.utilisation_chart(*of, states, row)
    views: dict[str, list[Placed]] = {}
    for name, chart in made.items():
        panels = [panel for panel in chart.panels if isinstance(panel, Panel)]
        views[name] = [(columns, panel) for panel in sorted(panels, key=lambda panel: -panel.count)]
    run, controls = verdicts.transient, [(s.name, s.unit) for s in model.signals.controls]
    views["values"] += _panels(columns, run.u, controls, "control")
    note = f"{charts.heading(verdicts)}{_how(columns)}."
    name = charts.base_name(run.name)
    return Plotted(name, note, list(views.items()), [(columns, top)], columns.alarms, columns.silent)


def plotted_transient(transient: Transient, recordings: int = 1) -> Plotted:
    """A recording that was read with a signals file, and not checked."""
    names = (*transient.state_names, *transient.control_names)
    columns = Columns.of(transient.t, transient.segment, most=_stretches(recordings, 2 * len(names) + 2))
    units = {s.name: s.unit for s in transient.signals.signals} if transient.signals else {}
    named, n = [(name, units.get(name, "")) for name in names], len(transient.state_names)
    panels = _panels(columns, transient.x, named[:n], "recorded")
    panels += _panels(columns, transient.u, named[n:], "control")
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


def plotted_live(
    name: str,
    states: Sequence[str],
    t: Array,
    flags: Array,
    alarm: Mask,
    utilisation: Array,
    statistics: Mapping[str, Array],
    note: str,
) -> Plotted:
    """What a running monitor has said: times (N,) in s, flags (N, n), alarm (N,), each statistic over its threshold.

    The states that raised the alarm come first.
    """
    judged, bad = np.asarray(np.isfinite(flags).all(axis=1)), np.asarray(flags == 1.0)
    most = _stretches(1, 2 * len(states) + 2)
    columns = Columns.of(t, None, judged, alarm, np.asarray(bad.any(axis=1) | alarm), most)
    score = np.abs(np.column_stack(list(statistics.values())) if statistics else utilisation)
    top = charts.score_panel(columns, np.fmax.reduce(columns.reduced(score, np.fmax), axis=1, initial=np.nan))
    largest = {name: float(np.nanmax(np.abs(values[alarm]), initial=0.0)) for name, values in statistics.items()}
    order = np.argsort(-charts.blamed(states, largest), kind="stable").tolist()
    panels = [(columns, panel) for panel in charts.utilisation_panels(columns, states, utilisation, bad, order)]
    return Plotted(name, note, [("utilisation", panels)], [(columns, top)], columns.alarms, columns.silent)


def _stretches(recordings: int, numbers: int) -> int:
    """Columns of one recording that has this many numbers in each."""
    return max(MOST_NUMBERS // (max(recordings, 1) * max(numbers, 1)), _FEWEST)


def _panels(columns: Columns, values: Array, names: Sequence[tuple[str, str]], role: str) -> list[Placed]:
    low, high = columns.extremes(np.where(np.isfinite(values), values, np.nan))
    series = ((charts.series_of(role, a, b, columns),) for a, b in zip(low.T, high.T, strict=True))
    return [(columns, Panel(name, one, unit)) for (name, unit), one in zip(names, series, strict=True)]


def _how(columns: Columns) -> str:
    if not columns.binned:
        return ""
    return (
        f". {columns.stop - int(columns.starts[0])} samples are drawn as {len(columns.starts)} columns with their "
        "least and greatest value; where bounds are violated, sample by sample"
    )


def _packed(recording: Plotted) -> dict[str, Any]:
    axes: dict[int, int] = {}
    times: list[str] = []

    def panel(placed: Placed) -> dict[str, Any]:
        columns, drawn = placed
        if id(columns) not in axes:
            axes[id(columns)] = len(times)
            at = np.flatnonzero(columns.apart)  # what parts two lines is drawn with the second
            times.append(_text(np.insert(columns.t, at, columns.t[at]).astype("<f8")))
        return {
            "title": visible(drawn.title), "unit": visible(drawn.unit), "time": axes[id(columns)],
            "note": visible(drawn.note), "rank": drawn.count, "levels": drawn.levels,
            "word": next(s.role for s in drawn.series if s.role != "bounds"), "values": _series(columns, drawn),
        }  # fmt: skip

    return {
        "name": visible(recording.name), "note": visible(recording.note),
        "title": visible(recording.title or recording.name),
        "top": [panel(p) for p in recording.top],
        "views": {view: [panel(p) for p in panels] for view, panels in recording.views}, "times": times,
        "alarms": recording.alarms, "silent": recording.silent,
    }  # fmt: skip


def _series(columns: Columns, panel: Panel) -> dict[str, dict[str, Any]]:
    """Each array less the middle of all, so that four bytes a number tell neighbours apart; marks are few."""
    at = np.flatnonzero(columns.apart)
    present: dict[str, Array] = {}
    for series in panel.series:
        names = ("lower", "upper") if series.role == "bounds" else ("least", "greatest")
        sides = (series.high, None) if series.role == "score" else (series.low, series.high)
        present |= {n: np.insert(a, at, np.nan) for n, a in zip(names, sides, strict=True) if a is not None}
    there = np.array([], dtype=np.intp)
    if panel.marks is not None:
        marked = np.insert(panel.marks, at, np.nan)
        there = np.flatnonzero(~np.isnan(marked))
        present["marked"] = marked[there]
    every = np.concatenate([value[np.isfinite(value)] for value in present.values()])
    offset = float((every.min() + every.max()) / 2) if len(every) else 0.0
    with np.errstate(over="ignore"):
        packed = {key: {"offset": offset, "data": _text((a - offset).astype("<f4"))} for key, a in present.items()}
    if "marked" in packed:
        packed["marked"]["at"] = _text(there.astype("<u4"))
    return packed


def _text(array: Any) -> str:
    return base64.b64encode(array.tobytes()).decode("ascii")
