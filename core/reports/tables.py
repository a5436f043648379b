"""Tables that a notebook shows in place of an object's text."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from uncertain_lti.base.english import plural

if TYPE_CHECKING:
    from uncertain_lti.model.uncertain_lti import UncertainLTI
    from uncertain_lti.monitor.envelope_monitor import Verdicts
    from uncertain_lti.sampling.transient import Transient

MOST = 12
"""Rows and columns of a matrix that are shown."""


def html_table(caption: str, header: Sequence[str], rows: Iterable[Sequence[str]], below: Sequence[str] = ()) -> str:
    """A plain table; every text is escaped. The first column stands to the left, the others to the right."""
    head = "".join(f"<th style='text-align:{_side(i)}'>{escape(cell)}</th>" for i, cell in enumerate(header))
    body = "".join(
        "<tr>" + "".join(f"<td style='text-align:{_side(i)}'>{escape(c)}</td>" for i, c in enumerate(row)) + "</tr>"
        for row in rows
    )
    notes = "".join(f"<div>{escape(text)}</div>" for text in below)
    return (
        f"<div><table><caption style='text-align:left'><b>{escape(caption)}</b></caption>"
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{notes}</div>"
    )


def _side(column: int) -> str:
    return "right" if column else "left"


def _number(value: float | None) -> str:
    return "–" if value is None or not math.isfinite(value) else f"{value:.4g}"


def _unit(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name


def model_html(model: UncertainLTI) -> str:
    """Nominal elements with their half-widths, and the widths that the fit reached."""
    names = [*model.state_names, *model.control_names]
    nominal, half = np.hstack([model.A, model.B]), np.hstack([model.dA, model.dB])
    shown = range(min(len(names), MOST))
    extra = [(n, a, b) for n, a, b in (("c", model.c, model.dc), ("v", np.zeros(model.n), model.v)) if (a + b).any()]
    header = ["A, B [1/s]", *(names[j] for j in shown)]
    header += ["…"] * (len(names) > MOST) + [name for name, _, _ in extra]
    rows = []
    for i in range(min(model.n, MOST)):
        row = [model.state_names[i], *(f"{nominal[i, j]:.4g} ± {half[i, j]:.3g}" for j in shown)]
        row += ["…"] * (len(names) > MOST) + [f"{a[i]:.4g} ± {b[i]:.3g}" for _, a, b in extra]
        rows.append(row)
    if model.n > MOST:
        rows.append(["…"] * len(header))
    facts, below = model.fit, []
    if facts.get("mean_width_recorded") is not None:
        widths = [
            f"{_unit(s.name, s.unit)} {_number(float(w))}"
            for s, w in zip(model.signals.states[:MOST], np.ravel(facts["mean_width_recorded"]), strict=False)
        ]
        below.append(f"mean one-step width: {', '.join(widths)}" + ", …" * (model.n > MOST))
    rule = model.alarm
    below.append(f"alarm: {rule.violations} of {plural(rule.window, 'verdict')}, margin {_number(rule.margin)}")
    below += [f"note: {message}" for message in facts.get("messages", [])]
    return html_table(repr(model), header, rows, below)


def transient_html(transient: Transient) -> str:
    """Range, largest step and missing samples of each signal."""
    rows = []
    units = [s.unit for s in transient.signals.signals] if transient.signals else [""] * 10**4
    names = [*transient.state_names, *transient.control_names]
    kinds = ["state"] * len(transient.state_names) + ["control"] * len(transient.control_names)
    columns = [*transient.x.T, *transient.u[:-1].T]
    for name, kind, unit, values in zip(names, kinds, units, columns, strict=False):
        finite = values[np.isfinite(values)]
        low, high = (float(finite.min()), float(finite.max())) if len(finite) else (math.nan, math.nan)
        rms = float(np.sqrt(np.nanmean(np.diff(values) ** 2))) if len(finite) > 1 else math.nan
        cells = [_unit(name, unit), kind, _number(low), _number(high), _number(rms)]
        rows.append([*cells, str(len(values) - len(finite))])
    counts = [f"{count} {reason}" for reason, count in sorted(transient.counters.items()) if count]
    header = ("signal", "", "least", "greatest", "rms step", "missing")
    return html_table(repr(transient), header, rows, [f"left out: {', '.join(counts)}"] if counts else [])


def verdicts_html(verdicts: Verdicts) -> str:
    """Violations and widths of each state."""
    transient, judged = verdicts.transient, verdicts.judged
    count, rows = int(judged.sum()), []
    units = [s.unit for s in transient.signals.states] if transient.signals else [""] * verdicts.flags.shape[1]
    for i, (name, unit) in enumerate(zip(transient.state_names, units, strict=True)):
        bad = np.flatnonzero(verdicts.flags[:, i] == 1.0)
        width = (verdicts.upper - verdicts.lower)[judged, i]
        rows.append(
            [
                _unit(name, unit),
                str(len(bad)),
                f"{1 - len(bad) / count:.3%}" if count else "–",
                _number(float(width.mean())) if count else "–",
                _number(float(width.max())) if count else "–",
                f"{transient.t[bad[0]]:.4f} s" if len(bad) else "–",
            ]
        )
    return html_table(repr(verdicts), ("state", "violations", "inside", "mean width", "largest", "first"), rows)


def validation_html(data: dict[str, Any], title: str) -> str:
    """Coverage beside widths, from `Validation.to_dict()`."""
    rows = [
        [
            _unit(name, s["unit"]),
            "–" if s["inside"] is None else f"{s['inside']:.3%}",
            f"{s['parts_inside']}/{data['parts']}",
            _number(s["mean_width_left_out"]),
            _number(s["mean_width_full"]),
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
        below.append(f"false alarms per hour at {rule['violations']} of {rule['window']}: {_number(rule['per_hour'])}")
    below += [data["scenario"]["words"], *(f"note: {note}" for note in data["notes"])]
    return html_table(title, ("left out", "inside", "whole parts", "mean width", "fitted"), rows, below)
