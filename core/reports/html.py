# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The report as one HTML page that needs nothing else: no script, no other file; figures are inside it.

Whatever comes from a file (names, units, notes, messages) is text and never HTML: every value passes `html.escape`, and
the page forbids scripts and other resources besides.
"""

from __future__ import annotations

import base64
import io
import itertools
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from html import escape
from typing import Any

from PIL import Image  # which matplotlib brings

from uncertain_lti.base.english import plural, shortlist
from uncertain_lti.base.errors import ModelError
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.verdicts import Verdicts
from uncertain_lti.recordings.recording import Progress
from uncertain_lti.reports import alt_texts, schedule_figures
from uncertain_lti.reports import figures as plots
from uncertain_lti.reports.check_text import likeness_text, repeats_text
from uncertain_lti.reports.detectable_text import SHOWN, condition_text, detectable_tables, detectable_words
from uncertain_lti.reports.drawing import between_rows
from uncertain_lti.reports.findings import APART
from uncertain_lti.reports.horizon_figure import horizon_figure
from uncertain_lti.reports.reliance import CARE, NO, UNKNOWN, WEIGHTS, YES
from uncertain_lti.reports.tables import beyond, number, shortened
from uncertain_lti.reports.width_budget import width_budget

MOST_DRAWN = 8
"""Recordings with figures of their own; those with most violations."""
_MOST_STATES = 8
_MOST_ROWS = 40
_MOST_EPISODES = 20
_DPI = 105
_DENSITY = 2
"""Dots of an image to each one of the page, for screens that have as many."""

_ANSWER = {YES: "Yes", CARE: "With care", UNKNOWN: "Unknown", NO: "No"}
_STATE = {"quiet": "nothing", "violations": "violations", "alarm": "alarm", "unknown": "no verdict"}

_STYLE = """
:root { color-scheme: light dark; --line: #d5d9de; --ink: #1b1f24; --soft: #57606a; --good: #00684a; --care: #8a5a00;
  --bad: #a83b00; --link: #0550ae; --page: #fff; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1060px; padding: 1.2rem; color: var(--ink); background: var(--page);
  font: 15px/1.5 system-ui, "Segoe UI", "Liberation Sans", sans-serif; overflow-wrap: break-word; }
h1 { font-size: 1.35rem; margin: 0 0 .2rem; } h2 { font-size: 1.1rem; margin: 2rem 0 .5rem; padding-top: .6rem;
  border-top: 1px solid var(--line); } h3 { font-size: 1rem; margin: 1.4rem 0 .4rem; }
p { margin: .4rem 0; } .soft { color: var(--soft); } code { font-family: ui-monospace, monospace; font-size: .85em; }
.cards { display: grid; grid-template-columns: repeat(2, minmax(0, 1fr)); gap: 1rem; margin-top: .8rem; }
.card { border: 1px solid var(--line); border-top: 5px solid var(--soft); border-radius: 4px; padding: .7rem 1rem; }
.card.wide { grid-column: 1 / -1; }
.card h2 { border: 0; margin: 0; padding: 0; font-size: .95rem; color: var(--soft); font-weight: 600; }
.answer { font-size: 1.7rem; font-weight: 700; line-height: 1.25; margin: 0 0 .3rem; }
.good { border-top-color: var(--good); } .care { border-top-color: var(--care); } .bad { border-top-color: var(--bad); }
.good > .answer, b.good { color: var(--good); } .care > .answer, b.care { color: var(--care); }
.bad > .answer, b.bad { color: var(--bad); }
ul { margin: .3rem 0; padding-left: 0; list-style: none; } li { margin: .35rem 0; }
.table { overflow-x: auto; } table { border-collapse: collapse; font-size: .87rem; margin: .4rem 0; }
th, td { padding: .22rem .6rem; border-bottom: 1px solid var(--line); text-align: right; vertical-align: top;
  font-variant-numeric: tabular-nums; }
th { font-weight: 600; color: var(--soft); } th:first-child, td:first-child, .left { text-align: left; }
td:first-child { min-width: 6.5rem; max-width: 24rem; } td code { overflow-wrap: anywhere; }
.left > code { display: block; min-width: 9rem; }
figure { margin: .8rem 0; } figcaption { font-size: .85rem; color: var(--soft); }
figure label { display: block; overflow-x: auto; position: relative; }
figure img { display: block; max-width: 100%; height: auto; }
figure input { position: absolute; opacity: 0; } label:focus-within { outline: 1px dotted var(--soft); }
figure label:has(input:checked) img { max-width: none; }
nav a { margin-right: 1rem; } a { color: var(--link); }
.tap { display: none; }
@media (max-width: 720px) { .cards { grid-template-columns: minmax(0, 1fr); } body { padding: .7rem; }
  .tap { display: inline; } figure label { cursor: zoom-in; } figure label:has(input:checked) { cursor: zoom-out; } }
@media screen and (prefers-color-scheme: dark) {
  :root { --line: #3a3f45; --ink: #e6e6e6; --soft: #a2a9b1; --good: #3fce9d; --care: #e0ab4a; --bad: #ff9159;
    --link: #79b8ff; --page: #1a1a1a; }
  figure img { filter: invert(.8980392) hue-rotate(180deg); } }
@media print { body { max-width: none; padding: 0; font-size: 10.5pt; } nav, .tap { display: none; }
  figure label:has(input:checked) img { max-width: 100%; } figure img, tr, .card { break-inside: avoid; }
  h2, h3 { break-after: avoid; } figcaption { break-before: avoid; } .table { overflow: visible; }
  table { font-size: .72rem; } th, td { padding: .15rem .35rem; } td:first-child { min-width: 0; } }
"""


def html_report(
    model: UncertainLTI, checked: Sequence[Verdicts], facts: Mapping[str, Any], progress: Progress | None = None
) -> str:
    """The report as one page."""
    name = os.path.basename(facts["model"]["file"]) or "model"
    title = f"{name}: may I rely on it, and what happened?"
    makers = [
        partial(_first_screen, name, facts),
        *_recordings(model, checked, facts),
        partial(_tightness, model, checked, facts),
        *([] if model.schedule is None else [partial(_regimes, model, facts)]),
        partial(_trust, facts),
        partial(_origin, facts),
    ]
    going: Iterable[Any] = makers if progress is None else progress(makers, len(makers))
    parts = [maker() for maker in going]
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
        "style-src 'unsafe-inline'\">\n"
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{_text(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
        + "\n".join(parts)
        + f'\n<p class="soft">Written by uncertain-lti {_text(facts["version"])}.</p>\n</body>\n</html>\n'
    )


# --- sections ---------------------------------------------------------------------------------------------------


def _first_screen(name: str, facts: Mapping[str, Any]) -> str:
    rely, happened = facts["rely"], facts["happened"]
    tone = {YES: "good", CARE: "care", UNKNOWN: "care", NO: "bad"}
    reasons = sorted(rely["reasons"], key=lambda r: WEIGHTS.index(r["weight"]))
    words = {YES: "in its favour", CARE: "mind", UNKNOWN: "unknown", NO: "against it"}
    listed = "".join(
        f'<li><b class="{tone[r["weight"]]}">{words[r["weight"]]}:</b> {_text(_without_address(r["text"]))}</li>'
        for r in reasons[:6]
    )
    if len(reasons) > 6:
        listed += f'<li class="soft">and {len(reasons) - 6} more <a href="#trust">below</a></li>'
    states = [h["state"] for h in happened]
    if "alarm" in states:
        what, look = "Alarm", "bad"
    elif "violations" in states:
        what, look = "Violations, no alarm", "care"
    elif "quiet" in states:
        what, look = ("Nothing left its bounds", "good") if "unknown" not in states else ("Partly unknown", "care")
        if look == "good" and (rely["answer"] == NO or any("proves nothing" in r["text"] for r in reasons)):
            what, look = "Nothing left its bounds, which says little here", "care"
    else:
        what, look = "Unknown", "care"
    order = sorted(happened, key=lambda h: ["alarm", "unknown", "violations", "quiet"].index(h["state"]))
    items = "".join(
        f"<li><b>{_name(os.path.basename(h['recording']) or h['recording'])}</b>: {_text(h['text'])}.</li>"
        for h in order[:5]
    )
    if len(order) > 5:
        items += f'<li class="soft">and {len(order) - 5} more recordings <a href="#recordings">below</a></li>'
    if rely["answer"] == NO and look == "bad":
        items += '<li class="soft">The model is not to be relied on: the machine may be well, and the model wrong.</li>'
    rule = facts["rule"]
    conditions = f", {rule['conditions']}" if rule["conditions"] else ""
    return (
        f"<header><h1>{_text(name)}</h1>"
        f'<p class="soft">{_text(_summary(facts))}. Alarm rule: {_rule(rule)}, margin '
        f"{number(rule['margin'])}{_text(conditions)}.</p>"
        '<nav><a href="#recordings">What happened</a><a href="#tight">How tight</a>'
        + '<a href="#regimes">Regimes</a>'
        * bool(facts["model"]["regimes"])
        + '<a href="#trust">How far to trust it</a><a href="#origin">Where it comes from</a></nav></header>\n'
        f'<div class="cards"><section class="card {tone[rely["answer"]]}"><h2>May I rely on it?</h2>'
        f'<p class="answer">{_ANSWER[rely["answer"]]}</p><ul>{listed}</ul></section>\n'
        f'<section class="card {look}"><h2>What happened?</h2><p class="answer">{what}</p><ul>{items}</ul></section>\n'
        f"{_sees(facts)}</div>"
    )


def _sees(facts: Mapping[str, Any]) -> str:
    """Which faults the model sees, on the first screen."""
    faults = facts["validation"] and facts["validation"]["detectable"]
    if not faults or faults["refused"]:
        why = faults["refused"] if faults else "run uncertain-lti validate MODEL --output MODEL"
        answer, items = "Unknown", f"<li>{_text(why)}</li>"
    else:
        answer, words = f"Within {number(faults['within'])} s, from these sizes on", detectable_words(faults)
        items = "".join(f"<li>{_text(text)}</li>" for text in words[:SHOWN])
        items += '<li class="soft">and more <a href="#trust">below</a></li>'
    return (
        f'<section class="card wide"><h2>Which faults would it see?</h2><p class="answer">{_text(answer)}</p>'
        f"<ul>{items}</ul></section>"
    )


def _rule(rule: Mapping[str, Any]) -> str:
    if rule["window"] == 1:
        return "at every violation"
    return f"{rule['violations']} of the last {rule['window']} verdicts violated"


def _summary(facts: Mapping[str, Any]) -> str:
    model = facts["model"]
    text = f"{plural(len(model['states']), 'state')}, {plural(len(model['controls']), 'control')}"
    if model["schedule"]:
        text += f"; {plural(len(model['regimes']), 'regime')} over {model['schedule']}"
    fit = model["fit"]
    if "criterion" in fit:
        text += f"; fitted by criterion {'(11)' if fit['criterion'] == 'lp' else '(10)'}"
        if "transitions" in fit:
            text += (
                f" to {plural(fit['transitions'], 'transition')} of {plural(fit.get('transients', '?'), 'recording')}"
            )
    return text


def _recordings(model: UncertainLTI, checked: Sequence[Verdicts], facts: Mapping[str, Any]) -> list[partial[str]]:
    recordings = facts["recordings"]
    drawn = sorted(range(len(recordings)), key=lambda i: -recordings[i]["violated"])[:MOST_DRAWN]
    return [
        partial(_all_recordings, model, checked, facts),
        *(partial(_recording, model, checked[i], recordings[i]) for i in sorted(drawn)),
    ]


def _all_recordings(model: UncertainLTI, checked: Sequence[Verdicts], facts: Mapping[str, Any]) -> str:
    recordings = facts["recordings"]
    parts = ['<h2 id="recordings">What happened</h2>']
    if len(recordings) > 1:
        rows = [
            [
                _name(os.path.basename(r["recording"])),
                str(r["verdicts"]),
                str(r["violated"]),
                str(r["episode_count"]),
                _text(_STATE[h["state"]]),
            ]
            for r, h in zip(recordings, facts["happened"], strict=True)
        ]
        parts.append(_table(("recording", "verdicts", "violated", "episodes", "what"), rows, most=200))
        figure = plots.coverage_figure(model, checked)
        parts.append(_figure(figure, "Violated shares, recording by recording", alt_texts.coverage_text(recordings)))
    if len(recordings) > MOST_DRAWN:
        parts.append(f'<p class="soft">Drawn are the {MOST_DRAWN} recordings with most violations.</p>')
    return "\n".join(parts)


def _recording(model: UncertainLTI, verdicts: Verdicts, facts: Mapping[str, Any]) -> str:
    states = facts["states"]
    parts = [f"<h3>{_name(os.path.basename(facts['recording']) or facts['recording'])}</h3>"]
    silent = f" Without a verdict, or not used: {', '.join(facts['no_verdict'])}." if facts["no_verdict"] else ""
    parts.append(
        f"<p>{plural(facts['samples'], 'sample')} over {number(facts['seconds'])} s, "
        f"{plural(facts['verdicts'], 'verdict')}, "
        f"{facts['violated']} of them violated.{_text(silent)} "
        f"Outside the fitted ranges: {facts['outside_domain']}.</p>"
    )
    parts += [f"<p>{_text(text)}.</p>" for text in (*facts["unknown"], *repeats_text(facts), *likeness_text(facts))]
    parts += [f'<p class="soft">{_text(note)}</p>' for note in facts["notes"][:5]]
    worst = sorted(model.state_names, key=lambda name: -states[name]["violations"])[:_MOST_STATES]
    shown = [name for name in model.state_names if name in worst]
    some = f"{len(shown)} of {plural(model.n, 'state')}, those with most violations. " if len(shown) < model.n else ""
    parts.append(
        _figure(
            plots.envelope_figure(model, verdicts, shown),
            f"{some}Recorded values between their one-step bounds; marks: violated, at the foot of a panel as well",
            alt_texts.envelope_text(facts, shown),
        )
    )
    if facts["episodes"]:
        parts.append(_episodes(facts))
    closer = _close_up(verdicts, facts)
    if closer is not None:
        episode, *span = closer
        bad = [name for name in shown if name in episode["states"]]
        parts.append(
            _figure(
                plots.envelope_figure(model, verdicts, bad, span=(span[0], span[1])),
                f"Closer: {alt_texts.episode_text(episode)}",
                alt_texts.beginning_text(episode),
            )
        )
    parts.append(
        _figure(
            plots.utilisation_figure(model, verdicts),
            "Utilisation: where between its bounds each sample lay, -1 and 1 at the bounds",
            alt_texts.utilisation_text(facts, model.state_names),
        )
    )
    if model.horizons:
        parts.append(
            _figure(
                horizon_figure(model, verdicts),
                "Utilisation over horizons: after how many steps a state lies outside its envelope",
                "A map of the utilisation of each state over time, with one row for each number of steps.",
            )
        )
    return "\n".join(parts)


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


def _episodes(facts: Mapping[str, Any]) -> str:
    rows = []
    for e in facts["episodes"][:_MOST_EPISODES]:
        where = sorted(e["states"].items(), key=lambda item: -item[1]["violations"])
        listed = [f"{shortened(name)} ({s['violations']}, worst {_utilisation(s)})" for name, s in where]
        rows.append(
            [
                f"{e['first']['t']:.4f}",
                _text(shortlist(listed, 4)),  # early, where a phone shows it without scrolling
                str(e["verdicts_violated"]),
                "yes" if e["alarm"] else "",
                f"{e['last']['t']:.4f}",
            ]
        )
    header = ("first [s]", "states (violations, worst utilisation)", "violated", "alarm", "last [s]")
    text = f"<p>Episodes (violations with fewer than {APART} verdicts between them): {facts['episode_count']}.</p>"
    if facts["episode_count"] > _MOST_EPISODES:
        text += f'<p class="soft">The first {_MOST_EPISODES}; <code>--json</code> has more.</p>'
    return text + _table(header, rows, left=(1,))


def _utilisation(state: Mapping[str, Any]) -> str:
    return "without width" if state["utilisation"] is None else beyond(state["utilisation"])


def _tightness(model: UncertainLTI, checked: Sequence[Verdicts], facts: Mapping[str, Any]) -> str:
    rows = []
    for state in facts["model"]["states"]:
        here = [r["states"][state["name"]] for r in facts["recordings"]]
        judged = [s["verdicts"] for s in here]
        total = sum(judged)
        width = sum(s["mean_width"] * n for s, n in zip(here, judged, strict=True) if n) / total if total else None
        spans = [s["range"] for s in here if s["range"] is not None]
        span = max(spans, default=None)
        bad = sum(s["violations"] for s in here)
        worst = [s["worst"]["utilisation"] for s in here if s["violations"]]
        rows.append(
            [
                _name(state["name"]) + (f" [{_text(state['unit'])}]" if state["unit"] else ""),
                number(state["mean_width"]),
                number(width),
                number(max((s["max_width"] for s in here if s["max_width"] is not None), default=None)),
                number(span),
                f"{width / span:.1%}" if width is not None and span else "-",
                str(bad),
                f"{100 * bad / total:.3g} %" if total else "-",
                "-" if not worst else "no width" if None in worst else beyond(max(worst, key=abs)),
            ]
        )
    header = (
        "state", "mean width when fitted", "mean width here", "largest here", "range here", "width/range", "violated",
        "of the verdicts", "worst utilisation",
    )  # fmt: skip
    parts = [
        '<h2 id="tight">How tight</h2>',
        "<p>Bounds that contain everything are worth something only where they are narrow. Widths of the one-step "
        "bounds, in recorded units, over all recordings checked:</p>",
        _table(header, rows, most=200),
    ]
    try:
        figure = plots.budget_figure(model, [v.transient for v in checked])
        shows = alt_texts.budget_text(model, *width_budget(model, [v.transient for v in checked])[::2])
        parts.append(_figure(figure, "Which element contributes how much of the mean width of each state", shows))
    except ModelError:
        pass  # no transition: the reasons above say so
    if model.schedule is None:
        figure = plots.matrices_figure(model)
        caption = "The matrices and their half-widths, for normalised quantities"
        parts.append(_figure(figure, caption, alt_texts.matrices_text(model)))
    return "\n".join(parts)


def _regimes(model: UncertainLTI, facts: Mapping[str, Any]) -> str:
    """Data, widths and verdicts in each regime of a scheduled model, and its elements over the schedule."""
    blocks, names = facts["model"]["regimes"], [state["name"] for state in facts["model"]["states"]]
    parts = [
        '<h2 id="regimes">Regimes</h2>',
        f"<p>The model is scheduled on {_text(facts['model']['schedule'])}: between two knots its elements are "
        "interpolated, and a mode has its own. A transition counts for the regime that has the largest weight.</p>",
        *(f"<p>{_text(text)}.</p>" for text in facts["model"]["regimes_in_words"]),
    ]
    rows = []
    for r, block in enumerate(blocks):
        here = [recording["regimes"][r] for recording in facts["recordings"]]
        judged, bad = sum(h["verdicts"] for h in here), sum(h["violated"] for h in here)
        transitions = "unknown" if block["transitions"] is None else str(block["transitions"])
        rows.append(
            [
                _text(block["regime"]),
                transitions if block["known"] else '<b class="care">0, not visited</b>',
                "" if block["tied_to"] is None else _text(blocks[block["tied_to"]]["regime"]),
                str(judged),
                f"{1 - bad / judged:.3%}" if judged else "-",
                str(sum(h["unknown_regime"] for h in here)),
                *(
                    number(sum(w * n for w, n in _widths(here, name)) / judged if judged else None)
                    for name in names[:_MOST_STATES]
                ),
            ]
        )
    widths = [f"{shortened(name)}: mean width here" for name in names[:_MOST_STATES]]
    header = ("regime", "fitted transitions", "shares elements of", "verdicts", "inside", "unknown regime", *widths)
    parts.append(_table(header, rows, left=(2,)))
    figure = schedule_figures.regimes_figure(model)
    parts.append(_figure(figure, "Regime by regime: data of the fit, mean one-step widths, time constants"))
    figure = schedule_figures.elements_figure(model)
    parts.append(_figure(figure, "Elements over the schedule with their half-widths, for normalised quantities"))
    return "\n".join(parts)


def _widths(regimes: Sequence[Mapping[str, Any]], name: str) -> list[tuple[float, int]]:
    """Mean width of a state and verdicts, of each recording with some in a regime."""
    return [(s["mean_width"], s["verdicts"]) for s in (r["states"][name] for r in regimes) if s["verdicts"]]


def _trust(facts: Mapping[str, Any]) -> str:
    parts = ['<h2 id="trust">How far to trust it</h2>']
    v = facts["validation"]
    if v is None:
        parts.append(
            "<p>The model has not been validated. Where its recordings are, run "
            "<code>uncertain-lti validate MODEL --output MODEL</code>: it leaves out one recording after the other, "
            "and says how often the others' bounds hold on it, and how many false alarms an hour to expect.</p>"
        )
    else:
        what = "recording" if v["kind"] == "transients" else "block"
        low, high = v["inside_interval"]
        under = f", {_text(v['condition_short'])}" if v["condition_short"] else ""
        parts.append(
            f"<p>Left out one {v['what']} at a time ({_text(v['parts'])}): {_text(v['verdicts'])} verdicts in "
            f"{number(v['hours'])} h"
            + (
                ""
                if v["inside"] is None
                else f", {v['inside']:.3%} inside all bounds "
                f"({v['confidence']:.0%} interval {low:.3%} to {high:.3%}{under})"
            )
            + f"; whole {what}s inside: {_text(v['parts_inside'])}.</p>"
        )
        rows = [
            [
                _name(name),
                "-" if s["inside"] is None else f"{s['inside']:.3%}",
                str(s["parts_inside"]),
                number(s["mean_width_left_out"]),
                number(s["mean_width_full"]),
            ]
            for name, s in v["states"].items()
        ]
        header = ("left out", "inside", f"{what}s inside", "mean width", "mean width of the full fit")
        parts.append(_table(header, rows, most=200))
        rows = [
            [
                f"{a['violations']} of {a['window']}, margin {number(a['margin'])}",
                str(a["alarms"]),
                number(a["per_hour"]),
                f"{number(a['interval'][0])} to {'unknown' if a['interval'][1] is None else number(a['interval'][1])}",
            ]
            for a in v["false_alarms"]
        ]
        parts.append(_table(("alarm rule", "false alarms", "per hour", f"interval{under}"), rows))
        if (faults := v["detectable"]) and not faults["refused"]:
            parts.append(f"<h3>Which faults it sees</h3><p>{_text(condition_text(faults))}.</p>")
            parts += [
                _table(header, [[_text(cell) for cell in row] for row in rows], most=200)
                for header, rows in detectable_tables(faults)
            ]
        parts += [f"<p>{_text(line)}.</p>" for line in [v["condition"], v["words"], *v["notes"]] if line]
    if facts["model"]["messages"]:
        listed = "".join(f"<li>{_text(_without_address(m))}</li>" for m in facts["model"]["messages"])
        parts.append(f"<h3>What the fit had to say</h3><ul>{listed}</ul>")
    reasons = "".join(f"<li><b>{_text(r['weight'])}</b>: {_text(r['text'])}</li>" for r in facts["rely"]["reasons"])
    parts.append(f"<h3>Every reason for the answer above</h3><ul>{reasons}</ul>")
    return "\n".join(parts)


def _origin(facts: Mapping[str, Any]) -> str:
    model = facts["model"]
    rows = [["model checked with", _name(model["file"]), _code(model["sha256"] or "none")]]
    rows += [["fitted to", _name(s["file"]), _code(s["sha256"])] for s in model["sources"]]
    rows += [["checked", _name(f["file"]), _code(f["sha256"])] for r in facts["recordings"] for f in r["files"]]
    signals = [
        [kind, _name(s["name"]), _text(s["unit"] or "-"), _name(s["topic"] or "-"), _code(s["field"])]
        for kind, group in (
            ("state", model["states"]),
            ("control", model["controls"]),
            ("scheduling", model["scheduling"]),
        )
        for s in group
    ]
    origin = {**model["fit"], "clock": model["clock"] or "-", "median step [s]": number(model["dt_median"])}
    about = [[_text(key), _text(number(v) if isinstance(v, float) else v)] for key, v in origin.items()]
    sets = [("", model["eigenvalues"]), *((block["regime"], block["eigenvalues"]) for block in model["regimes"])]
    eigenvalues = [
        f"<p>Eigenvalues of A{_text(f' at {where}' if where else '')} [1/s]: "
        + ", ".join(f"{a:.4g}{b:+.4g}j" if b else f"{a:.4g}" for a, b in pairs)
        + "</p>"
        for where, pairs in sets[:_MOST_ROWS]
        if pairs
    ]
    return "\n".join(
        [
            '<h2 id="origin">Where it comes from</h2>',
            _table(("what", "file", "sha256"), rows, left=(1, 2), most=300),
            _table(("fit", ""), about, left=(1,)),
            *eigenvalues,
            _table(("signal", "name", "unit", "topic", "field"), signals, left=(1, 2, 3, 4), most=300),
        ]
    )


# --- pieces -----------------------------------------------------------------------------------------------------


def _text(value: object) -> str:
    """A value of a file as text of the page."""
    return escape("".join(c if c.isprintable() or c == " " else "\N{REPLACEMENT CHARACTER}" for c in str(value)))


def _name(value: object) -> str:
    """A name as text of the page: where a line must end inside it, it ends after a low line, a slash or a dash."""
    return "<wbr>".join(map(_text, re.split(r"(?<=[_/-])(?=[^_/-])", str(value))))


def _code(value: object) -> str:
    return f"<code>{_text(value)}</code>"


def _without_address(text: str) -> str:
    return text[:400] + (" ..." if len(text) > 400 else "")


def _table(
    header: Sequence[str], rows: Iterable[Sequence[str]], left: Sequence[int] = (), most: int = _MOST_ROWS
) -> str:
    """Cells are HTML already; columns but the first stand to the right unless named."""
    listed = list(rows)
    classes = ['class="left"' if i in left else "" for i in range(len(header))]
    head = "".join(f"<th {c}>{_text(cell)}</th>" for cell, c in zip(header, classes, strict=True))
    body = "".join(
        "<tr>" + "".join(f"<td {c}>{cell}</td>" for cell, c in zip(row, classes, strict=True)) + "</tr>\n"
        for row in listed[:most]
    )
    more = (
        f'<p class="soft">and {len(listed) - most} more rows, in <code>--json</code></p>' if len(listed) > most else ""
    )
    return f'<div class="table"><table><thead><tr>{head}</tr></thead><tbody>\n{body}</tbody></table></div>{more}'


def _figure(figure: Any, caption: str, shows: str = "") -> str:
    """An image of a figure, which a tap enlarges; `shows` says what is seen in it to those who do not see it.

    The image is in strips, one per row of panels, so that a page that is printed can end between two of them.
    """
    image = plots.pixels(figure, _DPI * _DENSITY)
    height, width, _ = image.shape
    # 256 colours, none far from one drawn, at half the bytes. Median cut turns colour scales grey in a white image.
    coloured = Image.fromarray(image).quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    edges = [0, *between_rows(figure, image), height]
    strips = []
    for k, (top, bottom) in enumerate(itertools.pairwise(edges)):
        piece = io.BytesIO()
        coloured.crop((0, top, width, bottom)).save(piece, "PNG")
        alt = _text(f"{caption}. {shows}" if shows else caption) if not k else ""
        strips.append(
            f'<img src="data:image/png;base64,{base64.b64encode(piece.getvalue()).decode("ascii")}" alt="{alt}" '
            f'width="{width / _DENSITY:g}" height="{(bottom - top) / _DENSITY:g}">'
        )
    return (
        f'<figure><label><input type="checkbox" aria-label="enlarge the figure">{"".join(strips)}</label>'
        f'<figcaption>{_text(caption)} <span class="tap">(tap to enlarge)</span></figcaption></figure>'
    )
