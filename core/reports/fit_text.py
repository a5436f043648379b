# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What `fit` prints: recordings, the model found, and what to look at next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from uncertain_lti.base.english import plural
from uncertain_lti.identification.diagnosis import remedies
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.reports.model_text import dynamics_text, horizon_widths_text
from uncertain_lti.reports.tables import number, table
from uncertain_lti.sampling.reading import unused
from uncertain_lti.sampling.transient import Transient


def recording_text(transient: Transient) -> str:
    """One recording: what was read, and what of it is not used."""
    usable = int(transient.usable.sum())
    span = float(np.ptp(transient.t_ns)) * 1e-9 if len(transient) else 0.0
    text = (
        f"{transient.name}: {plural(len(transient), 'sample')} over {span:.4g} s, {plural(usable, 'usable transition')}"
    )
    left = unused(transient)
    return f"{text} ({', '.join(left)})" if left else text


def fit_text(model: UncertainLTI, transients: Sequence[Transient]) -> str:
    """Summary of a fit: widths compared with what the states do, and what the user should know."""
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
        f"{facts['violations']} outside, {_optimality_gap(facts)}",
        table(("one-step envelope", "mean width", "largest", "rms step", "range", "width/range"), rows),
        *dynamics_text(model),
    ]
    lines += horizon_widths_text(model)
    if "discarded" in facts:
        gone, before = facts["discarded"], facts["with_discarded"]["mean_width_recorded"]
        lines.append(
            f"discarded {plural(len(gone), 'transition')} (mean width with them: {', '.join(map(number, before))}): "
            + ", ".join(f"{d['file']} t = {d['t']:.4f} s" for d in gone[:20])
            + (f" and {len(gone) - 20} more (in the model file)" if len(gone) > 20 else "")
        )
    return "\n".join(lines + [f"note: {message}" for message in facts["messages"]])


def schedule_text(choice: Mapping[str, Any]) -> str:
    """How the number of knots of one signal was chosen."""
    rows, refused = [], []
    for c in choice["candidates"]:
        if "refused" in c:
            refused.append(f"{plural(c['knots'], 'knot')}: {c['refused']}")
            continue
        rows.append(
            [
                f"{c['knots']}{' (chosen)' if c['knots'] == choice['chosen'] else ''}",
                f"{c['outside']:.2%}",
                f"{c['excess']:.3%}",
                f"x {c['width']:.3g} ± {c['width_error']:.2g}" if c["knots"] > 1 else "x 1",
                ", ".join(f"{k:.4g}" for k in c["at"]) or "-",
            ]
        )
    lines = [f"knots on {choice['signal']}, by leaving out one {choice['left_out']} of {choice['units']} at a time:"]
    if rows:
        lines.append(table(("knots", "outside", "excess", "mean width", "at"), rows))
    return "\n".join([*lines, *(f"  {text}" for text in refused)])


def horizons_text(choice: Mapping[str, Any]) -> str:
    """How the horizons and their half-widths were chosen."""
    rows = [
        [
            f"{c['steps']}{' (chosen)' if c['taken'] else ''}",
            c["widths"],
            f"{c['outside']:.2%}",
            f"x {c['width']:.3g}",
            f"x {c['per_step']:.3g}",
            c["why"],
        ]
        for c in choice["candidates"]
    ]
    if not rows:
        return f"horizons: {choice['reason']}"
    title = f"horizons, by leaving out one {choice['left_out']} of {choice['units']} at a time (one step: x 1):"
    return title + "\n" + table(("steps", "half-widths", "outside", "width", "per step", ""), rows)


def _optimality_gap(facts: Mapping[str, Any]) -> str:
    """How far the fit is from its optimum at most."""
    gap = facts.get("optimality_gap")
    return "optimality gap not known" if gap is None else f"optimality gap {gap:.1e}"


def archive_text(model: UncertainLTI) -> str:
    """Summary of a fit whose transitions were not all in memory."""
    facts = model.fit_summary
    rows = [
        [s.name + (f" [{s.unit}]" if s.unit else ""), number(a), number(b)]
        for s, a, b in zip(model.signals.states, facts["mean_width_recorded"], facts["max_width_recorded"], strict=True)
    ]
    return "\n".join(
        [
            f"criterion {facts['criterion']}; additive: {facts['additive']}; "
            f"{plural(facts['transients'], 'recording')}, "
            f"{plural(facts['transitions'], 'transition')}, {facts['violations']} outside, {_optimality_gap(facts)}, "
            f"{plural(facts['solver']['passes'], 'pass')}",
            table(("one-step envelope", "mean width", "largest"), rows),
            *dynamics_text(model),
            *(f"note: {message}" for message in facts.get("messages", [])),
        ]
    )


def headline_text(model: UncertainLTI) -> str:
    """Whether the model is worth having, in one line."""
    alarm = model.fit_summary.get("alarm", {})
    if headline := alarm.get("headline"):
        return str(headline)
    why = alarm.get("not_learnt") or "the alarm was given"
    return f"alarm not learnt on left-out data, so nothing says what it is worth: {why}"


def alarm_text(model: UncertainLTI) -> str:
    """What raises the alarm, and what it promises."""
    lines = ["alarm: " + "; or ".join(rule.words for rule in model.alarm)]
    alarm = model.fit_summary.get("alarm", {})
    lines += [f"  {text}" for text in alarm.get("promises", [])]
    return "\n".join([*lines, *(f"  {alarm[key]}" for key in ("note",) if key in alarm)])


def next_text(model: UncertainLTI, file: str) -> str:
    """What to look at after a fit: the first thing that a person can mend, and the commands that tell more."""
    facts = model.fit_summary
    minded = [text for text in facts.get("messages", []) if "schedules nothing" not in text]
    blind = facts.get("alarm", {}).get("worth") in ("none", "some")
    remedy = remedies(facts.get("messages", []), facts["additive"], model.state_names[0]) if blind else ""
    worry = remedy or (minded[0] if minded else "")
    if not worry and facts["transients"] == 1:
        worry = "one recording says nothing of another day; check the model on one that was not fitted"
    lines = [f"look first at: {worry}"] if worry else []
    rows = [
        (f"uncertain-lti check {file} BAG", "is there an alarm on a recording that was not fitted?"),
        (f"uncertain-lti report {file} BAG", "may I rely on it, and what happened? a page with figures"),
        (f"envelope_monitor --ros-args -p model:={file}", "the same live"),
    ]
    width = max(len(command) for command, _ in rows)
    return "\n".join([*lines, "next:", *(f"  {command.ljust(width)}  {text}" for command, text in rows)])
