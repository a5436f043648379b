# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The report as one HTML page that needs nothing else: no script, no other file; charts are drawn inside it.

Whatever comes from a file (names, units, notes, messages) is text and never HTML: the template escapes every value, and
the page forbids scripts and other resources besides.
"""

from __future__ import annotations

import base64
import math
import re
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from jinja2 import Environment
from markupsafe import Markup, escape

from uncertain_lti.base.arrays import Array, Mask
from uncertain_lti.base.english import plural, shortlist
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.verdict import Verdicts
from uncertain_lti.recordings.recording import Progress
from uncertain_lti.reports import charts
from uncertain_lti.reports.charts import Chart, Columns, Map, Panel
from uncertain_lti.reports.check_text import likeness_text, repeats_text
from uncertain_lti.reports.detectable_text import SHOWN, condition_text, detectable_tables, detectable_words
from uncertain_lti.reports.findings import APART
from uncertain_lti.reports.reliance import CARE, NO, UNKNOWN, WEIGHTS, YES
from uncertain_lti.reports.tables import beyond, number, shortened

MOST_DRAWN = 6
"""Recordings with charts of their own; those with most violations."""
_COLUMNS = 700  # of a chart
_MOST_STATES, _MOST_ROWS, _MOST_EPISODES = 8, 40, 20
_TONE = {YES: "good", CARE: "care", UNKNOWN: "care", NO: "bad"}
_STATE = {"quiet": "nothing", "violations": "violations", "alarm": "alarm", "unknown": "no verdict"}

Block = dict[str, Any]


@dataclass(frozen=True)
class Table:
    """Cells as text; columns but the first stand to the right unless they are `left`; `most` rows are shown."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    left: Sequence[int] = ()
    most: int = _MOST_ROWS


def html_report(
    model: UncertainLTI, checked: Sequence[Verdicts], facts: Mapping[str, Any], progress: Progress | None = None
) -> str:
    """The report as one page."""
    name = charts.base_name(facts["model"]["file"] or "model")
    makers = [
        lambda: list(_recordings(model, checked, facts)),
        lambda: list(_tightness(model, facts)),
        lambda: list(_regimes(facts)),
        lambda: list(_trust(facts)),
        lambda: list(_origin(facts)),
    ]
    going: Any = makers if progress is None else progress(makers, len(makers))
    return (
        environment()
        .from_string(asset("report.html"))
        .render(
            name=name, summary=_summary(facts), version=facts["version"], style=Markup(asset("report.css")),
            cards=list(_cards(facts)), first=_first(model, checked, facts),
            blocks=[block for make in going for block in make()],
        )
    )  # fmt: skip


@cache
def environment() -> Environment:
    """Templates: what they are given is escaped, and control characters are replaced."""
    made = Environment(autoescape=True, finalize=lambda value: value if isinstance(value, Markup) else printable(value))
    made.filters["name"] = _name
    return made


def asset(name: str) -> str:
    """A file of this room."""
    return files("uncertain_lti.reports").joinpath("assets", name).read_text(encoding="utf-8")


def printable(value: object) -> str:
    """A value of a file as text of the page."""
    return "".join(c if c.isprintable() or c == " " else "\N{REPLACEMENT CHARACTER}" for c in str(value))


def _name(value: object) -> Markup:
    """A name: where a line must end inside it, it ends after a low line, a slash or a dash."""
    return Markup("<wbr>").join(escape(printable(part)) for part in re.split(r"(?<=[_/-])(?=[^_/-])", str(value)))


# --- first screen ------------------------------------------------------------------------------------------------


def _cards(facts: Mapping[str, Any]) -> Iterator[Block]:
    rely, happened = facts["rely"], facts["happened"]
    reasons = sorted(rely["reasons"], key=lambda r: WEIGHTS.index(r["weight"]))
    listed: list[Block] = [
        {"lead": r["weight"], "tone": _TONE[r["weight"]], "text": _cut(r["text"])} for r in reasons[:6]
    ]
    if len(reasons) > 6:
        listed.append({"soft": True, "text": f"and {len(reasons) - 6} more", "to": "trust"})
    yield {"title": "May I rely on it?", "tone": _TONE[rely["answer"]], "answer": rely["answer"].capitalize()} | {
        "list": listed
    }
    what, look = _headline(facts)
    order = sorted(happened, key=lambda h: ["alarm", "unknown", "violations", "quiet"].index(h["state"]))
    items: list[Block] = [{"lead": charts.base_name(h["recording"]), "text": f"{h['text']}."} for h in order[:5]]
    if len(order) > 5:
        items.append({"soft": True, "text": f"and {len(order) - 5} more recordings", "to": "recordings"})
    if rely["answer"] == NO and look == "bad":
        text = "The model is not to be relied on: the machine may be well, and the model wrong."
        items.append({"soft": True, "text": text})
    yield {"title": "What happened?", "tone": look, "answer": what, "list": items}
    faults = facts["validation"] and facts["validation"]["detectable"]
    if not faults or faults["refused"]:
        why = faults["refused"] if faults else "run uncertain-lti validate MODEL --output MODEL"
        answer, seen = "Unknown", [{"text": why}]
    else:
        answer = f"Within {number(faults['within'])} s, from these sizes on"
        seen = [{"text": text} for text in detectable_words(faults)[:SHOWN]]
        seen.append({"soft": True, "text": "and more", "to": "trust"})
    yield {"title": "Which faults would it see?", "tone": "", "answer": answer, "list": seen, "wide": True}


def _headline(facts: Mapping[str, Any]) -> tuple[str, str]:
    states, rely = [h["state"] for h in facts["happened"]], facts["rely"]
    if "alarm" in states:
        return "Alarm", "bad"
    if "violations" in states:
        return "Violations, no alarm", "care"
    if "quiet" not in states:
        return "Unknown", "care"
    if "unknown" in states:
        return "Partly unknown", "care"
    if rely["answer"] == NO or any("proves nothing" in r["text"] for r in rely["reasons"]):
        return "Nothing left its bounds, which says little here", "care"
    return "Nothing left its bounds", "good"


def _summary(facts: Mapping[str, Any]) -> str:
    model, fit, rule = facts["model"], facts["model"]["fit"], facts["rule"]
    text = f"{plural(len(model['states']), 'state')}, {plural(len(model['controls']), 'control')}"
    if model["schedule"]:
        text += f"; {plural(len(model['regimes']), 'regime')} over {model['schedule']}"
    if "criterion" in fit:
        text += f"; fitted by criterion {'(11)' if fit['criterion'] == 'lp' else '(10)'}"
        if "transitions" in fit:
            runs = plural(fit.get("transients", "?"), "recording")
            text += f" to {plural(fit['transitions'], 'transition')} of {runs}"
    conditions = f", {rule['conditions']}" if rule["conditions"] else ""
    return f"{text}. Alarm: {rule['words']}{conditions}."


# --- sections ----------------------------------------------------------------------------------------------------


def _first(model: UncertainLTI, checked: Sequence[Verdicts], facts: Mapping[str, Any]) -> Block:
    """What happened and when in the recording with most violations, of those with an alarm if there are any."""
    recordings = facts["recordings"]
    worst = max(range(len(checked)), key=lambda i: (recordings[i]["alarm"], recordings[i]["violated"]))
    columns = charts.columns_of(checked[worst], _COLUMNS)
    return _chart(charts.alarm_chart(model, checked[worst], columns), charts.heading(checked[worst]))


def _recordings(model: UncertainLTI, checked: Sequence[Verdicts], facts: Mapping[str, Any]) -> Iterator[Block]:
    recordings = facts["recordings"]
    yield _heading("recordings", "What happened")
    drawn = sorted(range(len(recordings)), key=lambda i: -recordings[i]["violated"])[:MOST_DRAWN]
    for i in sorted(drawn):
        yield from _recording(model, checked[i], recordings[i], len(recordings) > 1)
    if len(recordings) == 1:
        return
    if len(recordings) > MOST_DRAWN:
        yield _soft(f"Drawn are the {MOST_DRAWN} recordings with most violations.")
    rows = [
        [charts.base_name(r["recording"]), str(r["verdicts"]), str(r["violated"]), _share(r["violated"], r["verdicts"]),
         str(r["episode_count"]), _STATE[h["state"]]]
        for r, h in zip(recordings, facts["happened"], strict=True)
    ]  # fmt: skip
    yield _heading("", "All recordings", "h3")
    yield _table(("recording", "verdicts", "violated", "share", "episodes", "what"), rows, most=200)


def _recording(model: UncertainLTI, verdicts: Verdicts, facts: Mapping[str, Any], several: bool) -> Iterator[Block]:
    yield _heading("", charts.base_name(facts["recording"]), "h3")
    columns = charts.columns_of(verdicts, _COLUMNS)
    if several:
        yield _chart(charts.alarm_chart(model, verdicts, columns))
    if model.n > _MOST_STATES:
        yield _chart(charts.utilisation_map(model, verdicts, columns))
    silent = f" Without a verdict, or not used: {', '.join(facts['no_verdict'])}." if facts["no_verdict"] else ""
    yield _text(
        f"{plural(facts['samples'], 'sample')} over {number(facts['seconds'])} s, "
        f"{plural(facts['verdicts'], 'verdict')}, {facts['violated']} of them violated.{silent} "
        f"Outside the fitted ranges: {facts['outside_domain']}."
    )
    for text in (*facts["unknown"], *repeats_text(facts), *likeness_text(facts)):
        yield _text(f"{text}.")
    for note in facts["notes"][:5]:
        yield _soft(note)
    if facts["episodes"]:
        yield from _episodes(facts)
    worst = sorted(model.state_names, key=lambda name: -facts["states"][name]["violations"])[:_MOST_STATES]
    shown = [name for name in model.state_names if name in worst]
    if (closer := _close_up(verdicts, facts)) is not None:
        episode, low, high = closer
        bad = [name for name in shown if name in episode["states"]]
        near = charts.columns_of(verdicts, _COLUMNS, (low, high))
        yield _chart(charts.envelope_chart(model, verdicts, near, bad), "Closer: recorded values and their bounds")
    whole = charts.envelope_chart(model, verdicts, columns, shown)
    yield _chart(whole) | {"kind": "details", "text": "Recorded values between their bounds, over all of the time"}
    if model.horizons:
        yield _chart(charts.horizon_chart(model, verdicts, columns, shown))


def _close_up(verdicts: Verdicts, facts: Mapping[str, Any]) -> tuple[Mapping[str, Any], float, float] | None:
    """The episode that is worth a closer look, and time around it in s, where that is little of the whole.

    It is the first that has at least a tenth of the violated verdicts of the largest, among those with an alarm if
    there are any: a single sample long before a fault is not what happened.
    """
    t = verdicts.transient.t
    episodes = [e for e in facts["episodes"] if e["alarm"]] or facts["episodes"]
    if not episodes or (t[1:] < t[:-1]).any():
        return None
    most = max(e["verdicts_violated"] for e in episodes)
    episode = next(e for e in episodes if 10 * e["verdicts_violated"] >= most)
    begin, end = episode["first"]["t"], min(episode["last"]["t"], episode["first"]["t"] + 0.1 * float(t[-1]))
    step = float(t[-1]) / max(len(t) - 1, 1)
    room = max(40 * step, 0.3 * (end - begin))
    low, high = max(begin - room, 0.0), min(end + room, float(t[-1]))
    return (episode, low, high) if high - low < 0.5 * float(t[-1]) else None


def _episodes(facts: Mapping[str, Any]) -> Iterator[Block]:
    rows = []
    for e in facts["episodes"][:_MOST_EPISODES]:
        where = sorted(e["states"].items(), key=lambda item: -item[1]["violations"])
        listed = [f"{shortened(name)} ({s['violations']}, worst {_utilisation(s)})" for name, s in where]
        alarm = "yes" if e["alarm"] else ""  # the states early, where a phone shows them without scrolling
        first, last = f"{e['first']['t']:.4f}", f"{e['last']['t']:.4f}"
        rows.append([first, shortlist(listed, 4), str(e["verdicts_violated"]), alarm, last])
    more = f"; the first {_MOST_EPISODES} of them" if facts["episode_count"] > _MOST_EPISODES else ""
    yield _text(f"Episodes (violations with fewer than {APART} verdicts between them): {facts['episode_count']}{more}.")
    header = ("first [s]", "states (violations, worst utilisation)", "violated", "alarm", "last [s]")
    yield _table(header, rows, left=(1,))


def _utilisation(state: Mapping[str, Any]) -> str:
    return "without width" if state["utilisation"] is None else beyond(state["utilisation"])


def _tightness(model: UncertainLTI, facts: Mapping[str, Any]) -> Iterator[Block]:
    yield _heading("tight", "How tight")
    yield _text(
        "Bounds that contain everything are worth something only where they are narrow. Widths of the one-step bounds, "
        "in recorded units, over all recordings checked:"
    )
    rows = []
    for state in facts["model"]["states"]:
        here = [r["states"][state["name"]] for r in facts["recordings"]]
        total = sum(s["verdicts"] for s in here)
        width = sum(s["mean_width"] * s["verdicts"] for s in here if s["verdicts"]) / total if total else None
        span = max((s["range"] for s in here if s["range"] is not None), default=None)
        bad = sum(s["violations"] for s in here)
        worst = [s["worst"]["utilisation"] for s in here if s["violations"]]
        largest = max((s["max_width"] for s in here if s["max_width"] is not None), default=None)
        rows.append(
            [
                state["name"] + (f" [{state['unit']}]" if state["unit"] else ""),
                *map(number, (state["mean_width"], width, largest, span)),
                f"{width / span:.1%}" if width is not None and span else "-",
                str(bad),
                _share(bad, total),
                "-" if not worst else "no width" if None in worst else beyond(max(worst, key=abs)),
            ]
        )
    yield _table(
        ("state", "mean width when fitted", "mean width here", "largest here", "range here", "width/range", "violated",
         "of the verdicts", "worst utilisation"), rows, most=200,
    )  # fmt: skip
    names = (*model.state_names, *model.control_names)
    if model.schedule is None and len(names) <= 16:
        yield _text("Elements of A and B with their half-widths, 1/s of normalised quantities:")
        nominal, half = np.hstack([model.A, model.B]), np.hstack([model.dA, model.dB])
        cells = [
            [name, *(f"{a:.3g} ± {b:.2g}" for a, b in zip(*pair, strict=True))]
            for name, *pair in zip(model.state_names, nominal.tolist(), half.tolist(), strict=True)
        ]
        yield _table(("rate of", *names), cells)


def _regimes(facts: Mapping[str, Any]) -> Iterator[Block]:
    """Data, widths and verdicts in each regime of a scheduled model."""
    blocks, names = facts["model"]["regimes"], [state["name"] for state in facts["model"]["states"]][:_MOST_STATES]
    if not blocks:
        return
    yield _heading("regimes", "Regimes")
    yield _text(
        f"The model is scheduled on {facts['model']['schedule']}: between two knots its elements are interpolated, and "
        "a mode has its own. A transition counts for the regime that has the largest weight."
    )
    for text in facts["model"]["regimes_in_words"]:
        yield _text(f"{text}.")
    rows = []
    for r, block in enumerate(blocks):
        here = [recording["regimes"][r] for recording in facts["recordings"]]
        judged, bad = sum(h["verdicts"] for h in here), sum(h["violated"] for h in here)
        known = "unknown" if block["transitions"] is None else str(block["transitions"])
        of = [[s for h in here if (s := h["states"][name])["verdicts"]] for name in names]
        widths = [(sum(s["mean_width"] * s["verdicts"] for s in o), sum(s["verdicts"] for s in o)) for o in of]
        rows.append(
            [
                block["regime"],
                known if block["known"] else "0, not visited",
                "" if block["tied_to"] is None else blocks[block["tied_to"]]["regime"],
                str(judged),
                f"{1 - bad / judged:.3%}" if judged else "-",
                str(sum(h["unknown_regime"] for h in here)),
                *(number(width / count if count else None) for width, count in widths),
            ]
        )
    header = ("regime", "fitted transitions", "shares elements of", "verdicts", "inside", "unknown regime")
    yield _table((*header, *(f"{shortened(name)}: mean width here" for name in names)), rows, left=(2,))


def _trust(facts: Mapping[str, Any]) -> Iterator[Block]:
    yield _heading("trust", "How far to trust it")
    if (v := facts["validation"]) is None:
        yield _text(
            "The model has not been validated. Where its recordings are, run `uncertain-lti validate MODEL --output "
            "MODEL`: it leaves out one recording after the other, and says how often the others' bounds hold on it, "
            "and how many false alarms an hour to expect."
        )
    else:
        yield from _validated(v)
    if facts["model"]["messages"]:
        yield _heading("", "What the fit had to say", "h3")
        for message in facts["model"]["messages"]:
            yield _text(_cut(message))
    yield _heading("", "Every reason for the answer above", "h3")
    yield _table(("weight", "reason"), [[r["weight"], r["text"]] for r in facts["rely"]["reasons"]], left=(1,))


def _validated(v: Mapping[str, Any]) -> Iterator[Block]:
    what = "recording" if v["kind"] == "transients" else "block"
    low, high = v["inside_interval"]
    under = f", {v['condition_short']}" if v["condition_short"] else ""
    inside = "" if v["inside"] is None else (
        f", {v['inside']:.3%} inside all bounds ({v['confidence']:.0%} interval {low:.3%} to {high:.3%}{under})"
    )  # fmt: skip
    yield _text(
        f"Left out one {v['what']} at a time ({v['parts']}): {v['verdicts']} verdicts in {number(v['hours'])} h{inside}"
        f"; whole {what}s inside: {v['parts_inside']}."
    )
    rows = [
        [name, "-" if s["inside"] is None else f"{s['inside']:.3%}", str(s["parts_inside"]),
         number(s["mean_width_left_out"]), number(s["mean_width_full"])]
        for name, s in v["states"].items()
    ]  # fmt: skip
    heads = ("left out", "inside", f"{what}s inside", "mean width", "mean width of the full fit")
    yield _table(heads, rows, most=200)
    rows = [
        [a["rule"], str(a["alarms"]), number(a["per_hour"]),
         f"{number(a['interval'][0])} to {'unknown' if a['interval'][1] is None else number(a['interval'][1])}"]
        for a in v["false_alarms"]
    ]  # fmt: skip
    yield _table(("alarm rule", "false alarms", "per hour", f"interval{under}"), rows)
    if (faults := v["detectable"]) and not faults["refused"]:
        yield _heading("", "Which faults it sees", "h3")
        yield _text(f"{condition_text(faults)}.")
        for header, rows in detectable_tables(faults):
            yield _table(header, rows, most=200)
    for line in (v["condition"], v["words"], *v["notes"]):
        if line:
            yield _text(f"{line}.")


def _origin(facts: Mapping[str, Any]) -> Iterator[Block]:
    model = facts["model"]
    yield _heading("origin", "Where it comes from")
    rows = [["model checked with", model["file"], model["sha256"] or "none"]]
    rows += [["fitted to", s["file"], s["sha256"]] for s in model["sources"]]
    rows += [["checked", f["file"], f["sha256"]] for r in facts["recordings"] for f in r["files"]]
    yield _table(("what", "file", "sha256"), rows, left=(1, 2), most=300)
    origin = {**model["fit"], "clock": model["clock"] or "-", "median step [s]": number(model["dt_median"])}
    about = [[key, str(number(v) if isinstance(v, float) else v)] for key, v in origin.items()]
    yield _table(("fit", ""), about, left=(1,))
    sets = [("", model["eigenvalues"]), *((block["regime"], block["eigenvalues"]) for block in model["regimes"])]
    for where, pairs in sets[:_MOST_ROWS]:
        values = ", ".join(f"{a:.4g}{b:+.4g}j" if b else f"{a:.4g}" for a, b in pairs)
        if pairs:
            yield _text(f"Eigenvalues of A{f' at {where}' if where else ''} [1/s]: {values}")
    signals = [
        [kind, s["name"], s["unit"] or "-", s["topic"] or "-", s["field"]]
        for kind, group in (("state", "states"), ("control", "controls"), ("scheduling", "scheduling"))
        for s in model[group]
    ]
    yield _table(("signal", "name", "unit", "topic", "field"), signals, left=(1, 2, 3, 4), most=300)


def _heading(id: str, text: str, kind: str = "h2") -> Block:
    return {"kind": kind, "id": id, "text": text}


def _text(text: str) -> Block:
    return {"kind": "p", "text": text}


def _soft(text: str) -> Block:
    return {"kind": "soft", "text": text}


def _table(header: Sequence[str], rows: Sequence[Sequence[str]], **more: Any) -> Block:
    return {"kind": "table", "table": Table(header, rows, **more)}


def _cut(text: object) -> str:
    """The beginning of a text of a file."""
    return str(text)[:400] + (" ..." if len(str(text)) > 400 else "")


def _share(part: int, total: int) -> str:
    return f"{100 * part / total:.3g} %" if total else "-"


# --- charts ------------------------------------------------------------------------------------------------------

_W, _H = 2000, 1000  # of the drawing's own coordinates, which the page stretches


def _chart(chart: Chart, name: str = "") -> Block:
    """A chart as the template draws it: paths in its own coordinates, which the page stretches, and texts beside."""
    c = chart.columns
    low, high = c.limits

    def span(begin: float, end: float) -> tuple[str, str]:
        return f"{(begin - low) / (high - low) * _W:.1f}", f"{max((end - begin) / (high - low) * _W, 3.0):.1f}"

    return {
        "kind": "chart",
        "chart": {
            "name": name or chart.name, "words": f"{name or chart.name}. {chart.words}", "legend": chart.keys,
            "label": c.label, "alarms": [span(*s) for s in c.alarms], "silent": [span(*s) for s in c.silent],
            "ticks": [(_percent(v, low, high), f"{v:.10g}") for v in _ticks(low, high, 6)],
            "panels": [_map(p) if isinstance(p, Map) else _panel(p, c) for p in chart.panels],
        },
    }  # fmt: skip


def _panel(panel: Panel, c: Columns) -> Block:
    low, high = panel.limits
    x = np.rint((c.t - c.limits[0]) / (c.limits[1] - c.limits[0]) * _W)

    def y(values: Array) -> Array:
        return np.clip(np.rint((high - values) / (high - low) * _H), 0, _H)

    paths = []
    if len(panel.levels) == 2:
        top, bottom = y(np.array(panel.levels[::-1]))
        paths.append(("bounds", f"M0 {top:.0f}H{_W}V{bottom:.0f}H0Z"))
    for series in panel.series:
        of = [series.low] if series.high is None else [series.low, series.high]
        known = np.logical_and.reduce(np.isfinite(of), axis=0)
        role = series.role if len(of) == 1 or series.role in ("bounds", "score") else f"{series.role} filled"
        paths.append((role, _path(x, [y(v) for v in of], known, c.apart)))
    if len(panel.levels) == 1:
        paths.append(("level", f"M0 {y(np.array(panel.levels))[0]:.0f}H{_W}"))
    if panel.marks is not None:
        at = np.flatnonzero(~np.isnan(panel.marks))
        if len(at):
            paths.append(("foot", "".join(f"M{a:.0f} 960V1000" for a in dict.fromkeys(x[at].tolist()))))
            dots = zip(x[at].tolist(), y(panel.marks[at]).tolist(), strict=True)
            paths.append(("violated", "".join(f"M{a:.0f} {b:.0f}h0" for a, b in dots)))
    values = list(panel.levels) + [v for v in _ticks(low, high, 3) if not panel.levels or v > 1.9]
    ticks = [(_percent(v, high, low), f"{v:.6g}".replace("e+0", "e")) for v in values]
    return {"title": panel.heading, "note": panel.note, "count": panel.count, "paths": paths, "ticks": ticks}


def _path(x: Array, sides: Sequence[Array], known: Mask, apart: Mask) -> str:
    """A line, or the area between two, in pieces where something lies between."""
    pieces = []
    for a, b in charts.runs(known):
        cuts = [a, *(int(k) + a for k in np.flatnonzero(apart[a:b]) if k), b]
        for i, j in zip(cuts[:-1], cuts[1:], strict=True):
            points = [f"{p:.0f} {q:.0f}" for p, q in zip(x[i:j].tolist(), sides[0][i:j].tolist(), strict=True)]
            if len(sides) > 1:
                back = zip(x[i:j][::-1].tolist(), sides[1][i:j][::-1].tolist(), strict=True)
                points += [f"{p:.0f} {q:.0f}" for p, q in back] + ["Z"]
            pieces.append("M" + " ".join(points) + "h0" * (len(points) == 1))
    return "".join(pieces)


def _map(drawn: Map) -> Block:
    """A map as an image of a pixel per cell: blue as far as the bound is used, orange beyond it."""
    values = drawn.values
    with np.errstate(invalid="ignore"):
        alpha = np.where(np.isnan(values), 70, 255 * np.clip(values, 0.0, 1.0))
    colour = np.where((values > 1.0)[..., None], (213, 94, 0), (0, 114, 178))
    colour = np.where(np.isnan(values)[..., None], (140, 140, 140), colour)
    pixels = np.dstack([colour, alpha]).astype(np.uint8)
    rows = [(100 * (k + 0.5) / len(drawn.rows), row) for k, row in enumerate(drawn.rows)]
    facts = {"title": drawn.title, "note": drawn.note, "count": drawn.count, "rows": rows}
    return facts | {"image": base64.b64encode(_png(pixels)).decode("ascii"), "height": max(15 * len(rows), 30)}


def _png(pixels: Any) -> bytes:
    """An image (height, width, 4) as PNG."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width, _ = pixels.shape
    lines = np.zeros((height, 1 + 4 * width), dtype=np.uint8)  # each begins with its filter, none
    lines[:, 1:] = pixels.reshape(height, -1)
    head = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(lines.tobytes())) + chunk(
        b"IEND", b""
    )  # fmt: skip


def _percent(value: float, low: float, high: float) -> str:
    return f"{100 * (value - low) / (high - low):.2f}"


def _ticks(low: float, high: float, most: int) -> list[float]:
    """Round numbers between two, at most about so many."""
    step = 10.0 ** math.floor(math.log10((high - low) / most))
    step *= next((k for k in (1, 2, 5) if (high - low) / (k * step) <= most), 10)
    return [k * step + 0.0 for k in range(math.ceil(low / step), math.floor(high / step) + 1)]
