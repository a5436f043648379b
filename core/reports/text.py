"""What a fit or a check found, as text for people and as plain data for programs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.english import plural, times
from uncertain_lti.identification.diagnosis import remedies
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.envelope_monitor import Verdicts
from uncertain_lti.sampling.reading import unused
from uncertain_lti.sampling.transient import Transient


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Columns aligned with spaces; the first to the left, the others to the right.

    Parameters
    ----------
    header : sequence of str
        Names of the columns.
    rows : iterable of sequence of str
        Cells of each row, as many as `header` has.

    Returns
    -------
    str
        Lines, each indented by two spaces.
    """
    lines = [list(header), *(list(row) for row in rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    return "\n".join(
        "  "
        + "  ".join(
            cell.ljust(width) if i == 0 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def number(value: float | None) -> str:
    """Four digits, or a dash for nothing.

    Parameters
    ----------
    value : float or None
        The number; None or NaN for nothing.

    Returns
    -------
    str
        Four significant digits, or a dash.
    """
    return "-" if value is None or math.isnan(value) else f"{value:.4g}"


def beyond(utilisation: float) -> str:
    """A violated utilisation with as many digits as show that it is beyond -1 or 1.

    Parameters
    ----------
    utilisation : float
        Utilisation of a violated verdict, over 1 in magnitude.

    Returns
    -------
    str
        Three to nine digits, or `just beyond 1`.
    """
    for digits in range(3, 10):
        text = f"{utilisation:.{digits}g}"
        if abs(float(text)) > 1.0:
            return text
    return f"just beyond {math.copysign(1.0, utilisation):.0f}"


def recording_text(transient: Transient) -> str:
    """One recording: what was read, and what of it is not used.

    Parameters
    ----------
    transient : Transient
        The recording.

    Returns
    -------
    str
        One line.
    """
    usable = int(transient.usable.sum())
    span = float(np.ptp(transient.t_ns)) * 1e-9 if len(transient) else 0.0
    text = (
        f"{transient.name}: {plural(len(transient), 'sample')} over {span:.4g} s, {plural(usable, 'usable transition')}"
    )
    left = unused(transient)
    return f"{text} ({', '.join(left)})" if left else text


def fit_text(model: UncertainLTI, transients: Sequence[Transient]) -> str:
    """Summary of a fit: widths beside what the states do, and what the user should know.

    Parameters
    ----------
    model : UncertainLTI
        Of `fit`.
    transients : sequence of Transient
        What it was fitted to.

    Returns
    -------
    str
        A table in recorded units, and the notes of the fit.
    """
    facts = model.fit_summary
    criterion = {"qp": "(10), least squared widths", "lp": "(11), least largest width"}[facts["criterion"]]
    steps = [t.transitions() for t in transients]
    moves = np.vstack([s.x_next - s.x for s in steps])
    states = np.vstack([s.x for s in steps])
    rms, span = np.sqrt(np.mean(moves**2, axis=0)), np.ptp(states, axis=0)
    rows = []
    for i, signal in enumerate(model.signals.states):
        rows.append(
            [
                signal.name + (f" [{signal.unit}]" if signal.unit else ""),
                number(facts["mean_width_recorded"][i]),
                number(facts["max_width_recorded"][i]),
                number(rms[i]),
                number(span[i]),
                f"{facts['mean_width_recorded'][i] / span[i]:.2%}" if span[i] > 0 else "-",
            ]
        )
    lines = [
        f"criterion {criterion}; additive: {facts['additive']}; {plural(facts['transitions'], 'transition')}, "
        f"{facts['violations']} outside, gap to the optimum {facts['gap']:.1e}",
        table(("one-step envelope", "mean width", "largest", "rms step", "range", "width/range"), rows),
        f"eigenvalues of A [1/s]: {_eigenvalues(model)}",
    ]
    if "discarded" in facts:
        gone, before = facts["discarded"], facts["with_discarded"]["mean_width_recorded"]
        lines.append(
            f"discarded {plural(len(gone), 'transition')} (mean width with them: {', '.join(map(number, before))}): "
            + ", ".join(f"{d['file']} t = {d['t']:.4f} s" for d in gone[:20])
            + (f" and {len(gone) - 20} more (in the model file)" if len(gone) > 20 else "")
        )
    return "\n".join(lines + [f"note: {message}" for message in facts["messages"]])


def archive_text(model: UncertainLTI) -> str:
    """Summary of a fit whose transitions were not all in memory.

    Parameters
    ----------
    model : UncertainLTI
        Of `fit_archive`.

    Returns
    -------
    str
        A table in recorded units.
    """
    facts = model.fit_summary
    rows = [
        [s.name + (f" [{s.unit}]" if s.unit else ""), number(a), number(b)]
        for s, a, b in zip(model.signals.states, facts["mean_width_recorded"], facts["max_width_recorded"], strict=True)
    ]
    return "\n".join(
        [
            f"criterion {facts['criterion']}; additive: {facts['additive']}; "
            f"{plural(facts['transients'], 'recording')}, "
            f"{plural(facts['transitions'], 'transition')}, {facts['violations']} outside, gap {facts['gap']:.1e}, "
            f"{plural(facts['solver']['passes'], 'pass')}",
            table(("one-step envelope", "mean width", "largest"), rows),
            f"eigenvalues of A [1/s]: {_eigenvalues(model)}",
        ]
    )


def _eigenvalues(model: UncertainLTI) -> str:
    return ", ".join(
        f"{v.real:.4g}{v.imag:+.4g}j" if abs(v.imag) > 1e-12 * abs(v) else f"{v.real:.4g}" for v in model.eigenvalues()
    )


WIDE = 0.3
"""Mean width, as a share of the state's range, from which on an envelope says little."""


def next_text(model: UncertainLTI, file: str, left_out: dict[str, Any] | None) -> str:
    """What to look at after a fit: the worry that weighs most, and the commands that tell more.

    Parameters
    ----------
    model : UncertainLTI
        Of `fit`.
    file : str
        Its file, as it would be typed.
    left_out : dict or None
        What `leave_out_with_fit` returned.

    Returns
    -------
    str
        Lines.
    """
    facts = model.fit_summary
    span = model.domain.x_max - model.domain.x_min
    share = np.asarray(facts["mean_width"]) / np.where(span > 0, span, np.inf)
    widest = int(np.argmax(share))
    inside = None if left_out is None else left_out.get("inside")
    if share[widest] > WIDE:
        worry = (
            f"the bounds of '{model.state_names[widest]}' are {share[widest]:.0%} as wide as its range, so only gross "
            f"faults would be seen: "
        )
        worry += (
            remedies(facts.get("messages", []), facts["additive"], model.state_names[widest])
            or "what moves it may be missing among the controls"
        )
    elif inside is not None and inside < 0.99:
        worry = (
            f"{1 - inside:.1%} of what was left out falls outside, so expect false alarms; record more of what the "
            f"machine will do, or let validate --false-alarms find an alarm rule that stays quiet"
        )
    elif facts.get("messages"):
        worry = facts["messages"][0]
    elif facts["transients"] == 1:
        worry = "one recording says nothing of another day; check the model on one that was not fitted"
    else:
        worry = ""
    lines = [f"look first at: {worry}"] if worry else []
    rows = [
        (f"uncertain-lti check {file} BAG", "is a recording that was not fitted inside?"),
        (f"uncertain-lti validate {file}", "how far to trust it; an alarm rule for a rate of false alarms"),
        (f"uncertain-lti report {file} BAG", "may I rely on it, and what happened? a page with figures"),
    ]
    width = max(len(command) for command, _ in rows)
    return "\n".join([*lines, "next:", *(f"  {command.ljust(width)}  {text}" for command, text in rows)])


def model_text(model: UncertainLTI) -> str:
    """Summary of a model file.

    Parameters
    ----------
    model : UncertainLTI
        The model.

    Returns
    -------
    str
        Signals, matrices in 1/s of normalised quantities, domain, alarm rule and notes.
    """
    s, facts = model.sampling, model.fit_summary
    lines = [repr(model)]
    if s.clock:
        lines.append(
            f"clock {s.clock} ({s.time.get(s.clock, '?')} time), step {number(s.dt_median)} s "
            f"({number(s.dt_min)} to {number(s.dt_max)}), max_gap {number(s.max_gap)} s"
        )
    signals = [
        [
            f"{kind} {signal.name}",
            signal.topic or "-",
            signal.field,
            number(float(signal.steady)),
            number(float(signal.scale)),
            signal.unit or "-",
        ]
        for kind, group in (("state", model.signals.states), ("control", model.signals.controls))
        for signal in group
    ]
    lines.append(table(("signal", "topic", "field", "steady", "scale", "unit"), signals))
    names = [*model.state_names, *model.control_names]
    nominal, half = np.hstack([model.A, model.B]), np.hstack([model.dA, model.dB])
    extra = [
        ("c", np.column_stack([model.c, model.dc])),
        ("v (noise)", np.column_stack([np.zeros(model.n), model.v])),
    ]
    shown = [(name, pair) for name, pair in extra if pair.any()]
    rows = [
        [name]
        + [f"{nominal[i, j]:.4g} ± {half[i, j]:.3g}" for j in range(len(names))]
        + [f"{pair[i, 0]:.4g} ± {pair[i, 1]:.3g}" for _, pair in shown]
        for i, name in enumerate(model.state_names)
    ]
    lines.append(table(("A, B [1/s]", *names, *(name for name, _ in shown)), rows))
    lines.append(f"eigenvalues of A [1/s]: {_eigenvalues(model)}")
    if facts.get("mean_width_recorded"):
        widths = [
            [name, number(a), number(b)]
            for name, a, b in zip(
                model.state_names, facts["mean_width_recorded"], facts["max_width_recorded"], strict=True
            )
        ]
        lines.append(table(("one-step envelope", "mean width", "largest"), widths))
    alarm = model.alarm_rule
    lines.append(
        f"alarm: {alarm.violations} of the last {plural(alarm.window, 'verdict')} violated; margin "
        f"{number(alarm.margin)}"
    )
    return "\n".join(lines + [f"note: {message}" for message in facts.get("messages", [])])


def check_data(model: UncertainLTI, verdicts: Verdicts, samples: bool = True) -> dict[str, Any]:
    """Result of a check as plain data.

    Counts, the first and the longest violation of each state, the spans in which the alarm was raised, widths beside
    coverage; with samples, a verdict per sample in recorded units (`flags`: 0 contained, 1 violated, null no
    verdict).

    Parameters
    ----------
    model : UncertainLTI
        The model checked with.
    verdicts : Verdicts
        Of `EnvelopeMonitor.check`.
    samples : bool, default True
        Whether a verdict per sample is among it.

    Returns
    -------
    dict
        Plain data for JSON.
    """
    transient = verdicts.transient
    t = transient.t_ns
    judged = int(verdicts.judged.sum())
    width = np.where(verdicts.judged[:, None], verdicts.upper - verdicts.lower, np.nan)
    states = {}
    for i, name in enumerate(model.state_names):
        flags = verdicts.flags[:, i]
        bad = flags == 1.0
        runs = _runs(bad)
        longest = max(runs, key=lambda run: (run[1] - run[0], -run[0]), default=None)
        states[name] = {
            "violations": int(bad.sum()),
            "inside": None if not judged else 1.0 - int(bad.sum()) / judged,
            "first_violation": _instant(transient, runs[0][0]) if runs else None,
            "longest_violation": None
            if longest is None
            else {**_instant(transient, longest[0]), "samples": longest[1] - longest[0], **_length(t, longest)},
            "mean_width": float(np.nanmean(width[:, i])) if judged else None,
            "max_width": float(np.nanmax(width[:, i])) if judged else None,
            "unit": model.signals.states[i].unit,
        }
    alarms = _runs(verdicts.alarm)
    data: dict[str, Any] = {
        "recording": transient.name,
        "samples": len(transient),
        "verdicts": judged,
        "no_verdict": unused(transient),
        "violated": int(verdicts.violated.sum()),
        "inside": None if not judged else 1.0 - int(verdicts.violated.sum()) / judged,
        "outside_domain": int(verdicts.outside_domain.sum()),
        "states": states,
        "alarm": bool(alarms),
        "alarms": [{**_instant(transient, start), **_length(t, (start, stop))} for start, stop in alarms],
    }
    if samples:
        data["verdict_per_sample"] = [
            {
                "t_ns": int(t[k]),
                "status": status.value,
                "flags": _list(verdicts.flags[k]),
                "lower": _list(verdicts.lower[k]),
                "upper": _list(verdicts.upper[k]),
                "state": _list(transient.x[k]),
                "utilisation": _list(verdicts.utilisation[k]),
                "outside_domain": bool(verdicts.outside_domain[k]),
                "alarm": bool(verdicts.alarm[k]),
            }
            for k, status in enumerate(transient.statuses())
        ]
    return data


def check_text(data: dict[str, Any]) -> str:
    """Summary of `check_data` for a person.

    Parameters
    ----------
    data : dict
        Of `check_data`.

    Returns
    -------
    str
        A table in recorded units, and when the alarm was raised.
    """
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
    lines = [
        head + (f"; no verdict or not used: {', '.join(data['no_verdict'])}" if data["no_verdict"] else ""),
        table(("state", "violations", "inside", "mean width", "largest", "first", "longest"), rows),
    ]
    if data["verdicts"]:
        lines.append(f"outside the fitted domain: {data['outside_domain'] / data['verdicts']:.2%} of the verdicts")
    if data["alarm"]:
        first = data["alarms"][0]
        lines.append(
            f"ALARM: raised {times(len(data['alarms']))}, first at {first['t']:.4f} s for {number(first['seconds'])} s"
        )
    else:
        lines.append("no alarm" if data["verdicts"] else "no verdict was possible, so nothing is known")
    return "\n".join(lines)


def _runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """[start, stop) of every run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _instant(transient: Transient, k: int) -> dict[str, Any]:
    """Sample k: its time since the first sample, s, and its stamp, ns."""
    return {"k": k, "t": float(transient.t[k]), "t_ns": int(transient.t_ns[k])}


def _length(t_ns: NDArray[np.int64], run: tuple[int, int]) -> dict[str, float]:
    """From the first to the last sample of a run, s."""
    return {"seconds": float(t_ns[run[1] - 1] - t_ns[run[0]]) * 1e-9}


def _list(row: Array) -> list[float | None]:
    return [v if math.isfinite(v) else None for v in row.tolist()]


def validation_text(data: dict[str, Any]) -> str:
    """Summary of `Validation.to_dict()`, with the calibration if there is one, for a person.

    Parameters
    ----------
    data : dict
        Of `Validation.to_dict`; with the key `calibration` if there is one.

    Returns
    -------
    str
        Tables, intervals and notes.
    """
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
                        f"{a['violations']} of {a['window']}, margin {number(a['margin'])}",
                        str(a["alarms"]),
                        number(a["per_hour"]),
                        _interval(*a["interval"]),
                        f"{a['raised_share']:.3%}",
                    ]
                    for a in data["false_alarms"]
                ],
            )
        )
    if "condition" in data:
        lines.append(data["condition"])
    lines.append(data["scenario"]["words"])
    if "calibration" in data:
        lines.append(data["calibration"]["words"])
        if warning := data["calibration"].get("warning"):  # files written before it was stored have none
            lines.append(f"warning: {warning}")
    return "\n".join(lines + [f"note: {note}" for note in data["notes"]])


def left_out_text(data: dict[str, Any]) -> str:
    """Short form of `validation_text`, one line, for a fit, with the hint that recordings may come in groups.

    Parameters
    ----------
    data : dict
        Of `leave_out_with_fit`.

    Returns
    -------
    str
        One or two lines.
    """
    if "not_done" in data:
        return f"not validated, so how it does on other recordings is unknown: {data['not_done']}"
    what = "recording" if data["kind"] == "transients" else "block"
    ratio = max((s["left_out_to_full"] for s in data["states"].values()), default=math.nan)
    alarm = data["false_alarms"][0]
    inside = "no verdict" if data["inside"] is None else f"{data['inside']:.3%} of the verdicts inside"
    groups = data["groups"]
    of = f"{groups['count']} at a time ({_how_many(data)})" if groups else f"{data['parts']} at a time"
    line = (
        f"left out one {_unit(data)} of {of}: {inside}, "
        f"{plural(data['parts_inside'], f'whole {what}')}, widths at most {ratio:.3g} times those above; "
        f"{number(alarm['per_hour'])} false alarms per hour ({_interval(*alarm['interval'])} "
        f"{data['condition_short']}) at {alarm['violations']} of {alarm['window']}; more: uncertain-lti validate"
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
    """A lower limit that is next to nothing is nothing; no upper limit is said so."""
    if high is None:
        return "unknown"
    return f"{number(low if low > 1e-4 * high else 0.0)} to {number(high)}"


def findings_text(facts: dict[str, Any]) -> str:
    """The answers of `findings.findings`, with the reasons, for a person.

    Parameters
    ----------
    facts : dict
        Of `findings.findings`.

    Returns
    -------
    str
        Both answers, a reason per line.
    """
    lines = [f"may I rely on it? {facts['rely']['answer']}"]
    lines += [f"  {r['weight']}: {r['text']}" for r in facts["rely"]["reasons"]]
    lines.append("what happened?")
    lines += [f"  {h['recording']}: {h['text']}" for h in facts["happened"]]
    return "\n".join(lines)
