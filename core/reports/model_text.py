# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Texts of a model, and of what was left out of its fit: what all commands print that make or show a model."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from uncertain_lti.base.text import (
    Block,
    Table,
    lasting,
    list_of,
    named,
    number,
    numbers_of,
    plural,
    share,
    shortlist,
    text_of,
)
from uncertain_lti.identification.diagnosis import HARMLESS, remedies
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.model.interchange import blocks_table, elements_table
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.likeness import Learnt
from uncertain_lti.sampling.clock import passed
from uncertain_lti.sampling.reading import unused
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.values import CRITERIA, of_table

MOST_SHOWN = 20
"""Signals whose elements, discarded transitions, and recordings of a fit that are printed."""


def recording_text(transient: Transient) -> str:
    """One recording: what was read, and what of it is not used."""
    usable, left = int(transient.usable.sum()), ", ".join(unused(transient))
    span = passed(transient.t_ns)
    text = f"{plural(len(transient), 'sample')} over {f'{span:.4g} s' if span < 1e4 else lasting(span / 3600)}"
    return f"{transient.name}: {text}, {plural(usable, 'usable transition')}{f' ({left})' * bool(left)}"


def fit_text(model: UncertainLTI) -> str:
    """What was fitted: what it is worth, how it was chosen, its widths, its alarm, and what the user should know."""
    facts = model.fit_summary
    blocks: list[Block] = [headline_text(model)]
    for choice in facts.get("schedule", []):
        blocks += schedule_blocks(choice)
    if choice := facts.get("horizon_choice"):
        blocks += horizon_blocks(choice)
    gap = "not known" if (gap := facts.get("optimality_gap")) is None else f"{gap:.1e}"
    of = f"{plural(facts['transitions'], 'transition')}, {facts['violations']} outside, optimality gap {gap}"
    blocks.append(f"criterion {CRITERIA[facts['criterion']]}; additive: {facts['additive']}; {of}")
    blocks += [*_widths(model), *_dynamics(model)]
    if "discarded" in facts:
        before = ", ".join(map(number, facts["with_discarded"]["mean_width_recorded"]))
        gone = [f"{d['file']} t = {d['t']:.4f} s" for d in facts["discarded"]]
        width = f"{plural(len(gone), 'transition')} (mean width with them: {before})"
        blocks.append(f"discarded {width}: {shortlist(gone, MOST_SHOWN)}")
    blocks += [f"note: {message}" for message in facts.get("messages", [])]
    blocks.append(alarm_text(model))
    if model.validation:
        blocks.append(left_out_text(model.validation))
    return text_of(blocks)


def model_blocks(model: UncertainLTI) -> list[Block]:
    """What is in a model: its signals, elements, widths, alarm, and the faults that it sees."""
    s, steps, facts = model.signals, model.sampling, model.fit_summary
    blocks: list[Block] = [repr(model)]
    if s.clock:
        step = f"step {number(steps.dt_median)} s ({number(steps.dt_min)} to {number(steps.dt_max)})"
        blocks.append(f"clock {s.clock} ({s.time.get(s.clock, '?')} time), {step}, max_gap {number(s.max_gap)} s")
    rows = [
        [f"{kind} {x.name}", x.topic or "-", x.field, number(float(x.steady)), number(float(x.scale)), x.unit or "-"]
        for kind, group in (("state", s.states), ("control", s.controls), ("scheduling", s.scheduling))
        for x in group
    ]
    blocks.append(Table(("signal", "topic", "field", "steady", "scale", "unit"), rows, left=(1, 2), most=300))
    if model.schedule is None and model.n + model.m <= MOST_SHOWN:
        blocks.append(elements_table(model))
    blocks += [*_dynamics(model), *_widths(model)]
    for rule in model.alarm:
        words = rule.words
        if isinstance(rule, AlarmRule):
            over = "" if rule.horizon == 1 else f" over {rule.horizon} steps"
            last = f"of the last {plural(rule.window, 'verdict')} violated{over}"
            words = f"{rule.violations} {last}; margin {number(rule.margin)}"
        blocks.append(f"alarm: {words}")
    if model.signatures:
        blocks.append(f"signatures of faults: {', '.join(signature.label for signature in model.signatures)}")
    if (faults := detectable_data(model.validation)) is not None:
        blocks += [condition_text(faults), *(f"  {text}" for text in detectable_words(faults))]
    return blocks + [f"note: {message}" for message in list_of(facts.get("messages"))]


def model_text(model: UncertainLTI) -> str:
    """Summary of a model file."""
    return text_of(model_blocks(model))


def headline_text(model: UncertainLTI) -> str:
    """Whether the model is worth having, in one line."""
    alarm = model.fit_summary.get("alarm", {})
    why = alarm.get("not_learnt") or "the alarm was given"
    return str(alarm.get("headline") or f"alarm not learnt on left-out data, so nothing says what it is worth: {why}")


def alarm_text(model: UncertainLTI) -> str:
    """What raises the alarm, and what it promises."""
    alarm = model.fit_summary.get("alarm", {})
    said = [*alarm.get("promises", []), *([alarm["note"]] if "note" in alarm else [])]
    return "\n".join(["alarm: " + "; or ".join(rule.words for rule in model.alarm), *(f"  {text}" for text in said)])


def next_text(model: UncertainLTI, file: str) -> str:
    """What to look at after a fit: the first thing that a person can mend, and the commands that tell more."""
    facts = model.fit_summary
    harmless = [*HARMLESS, "schedules nothing", "the bounds hold as they are", "the bounds hold, but", "stay valid"]
    minded = [text for text in facts.get("messages", []) if not any(words in text for words in harmless)]
    blind = facts.get("alarm", {}).get("worth") in ("none", "some")
    remedy = remedies(facts.get("messages", []), facts["additive"], model.state_names[0]) if blind else ""
    worry = remedy or (minded[0] if minded else "")
    rows = [
        (f"uncertain-lti check {file} BAG", "is there an alarm on a recording that was not fitted?"),
        (f"uncertain-lti report {file} BAG", "may I rely on it, and what happened? a page with figures"),
    ]
    if not any(map(of_table, model.signals.topics)):  # which no publisher sends
        rows.append((f"envelope_monitor --ros-args -p model:={file}", "the same live"))
    width = max(len(command) for command, _ in rows)
    first = [f"look first at: {worry}"] if worry else []
    return "\n".join([*first, "next:", *(f"  {command.ljust(width)}  {text}" for command, text in rows)])


def schedule_blocks(choice: Mapping[str, Any]) -> list[Block]:
    """How the number of knots of one signal was chosen."""
    rows, refused = [], []
    for c in choice["candidates"]:
        if "refused" in c:
            refused.append(f"  {plural(c['knots'], 'knot')}: {c['refused']}")
            continue
        sizes = [share(c["outside"], 2), share(c["excess"]), f"x {c['width']:.3g}", f"x {c['jumps']:.3g}"]
        at = ", ".join(f"{k:.4g}" for k in c["at"]) or "-"
        chosen = " (chosen)" * (c["knots"] == choice["chosen"])
        rows.append([f"{c['knots']}{chosen}", *sizes, at])
    blocks: list[Block] = [f"knots on {choice['signal']}, {_left_out(choice)}:"]
    if rows:
        blocks.append(Table(("knots", "outside", "excess", "mean width", "jumps seen", "at"), rows))
    return [*blocks, *refused]


def horizon_blocks(choice: Mapping[str, Any]) -> list[Block]:
    """How the horizons and their half-widths were chosen."""
    rows = []
    for c in choice["candidates"]:
        widths = [share(c["outside"], 2), f"x {c['width']:.3g}", f"x {c['per_step']:.3g}"]
        rows.append([f"{c['steps']}{' (chosen)' * c['taken']}", c["widths"], *widths, c["why"]])
    if not rows:
        return [f"horizons: {choice['reason']}"]
    header = ("steps", "half-widths", "outside", "width", "per step", "")
    return [f"horizons, {_left_out(choice)} (one step: x 1):", Table(header, rows)]


def _left_out(choice: Mapping[str, Any]) -> str:
    return f"by leaving out one {choice['left_out']} of {choice['units']} at a time"


def _widths(model: UncertainLTI) -> list[Block]:
    """Widths of one step beside what the states did in the fit, and over several steps."""
    facts, blocks = model.fit_summary, list[Block]()
    mean, largest = (numbers_of(facts.get(f"{which}_width_recorded"), model.n) for which in ("mean", "max"))
    if mean and largest:
        spans = model.domain.span(model.operating_point.X).tolist()
        rows = []
        for signal, width, most, span in zip(model.signals.states, mean, largest, spans, strict=True):
            of = [number(span), share(width / span, 2)] if 0 < span < math.inf else ["-", "-"]
            rows.append([named(signal.name, signal.unit), number(width), number(most), *of])
        header = ("one-step envelope", "mean width", "largest", "range", "width/range")
        blocks.append(Table(header, rows, most=200))
    if over := facts.get("horizons"):
        each = (([str(h["steps"]), number(h["seconds"]), h["widths"]], h["mean_width_recorded"]) for h in over)
        rows = [[*cells, *map(number, widths)] for cells, widths in each]
        blocks.append(Table(("mean width after steps", "s", "half-widths", *model.state_names), rows))
    return blocks


def _dynamics(model: UncertainLTI) -> list[Block]:
    """How fast a model is: eigenvalues, or what each regime rests on with its time constants."""
    if model.schedule is None:
        values = [v.real if v.imag == 0 else v for v in model.eigenvalues()]
        return [f"eigenvalues of A [1/s]: {shortlist([f'{v:.4g}' for v in values], MOST_SHOWN // 2)}"]
    title = f"scheduled on {model.schedule.words}, {plural(model.schedule.blocks, 'regime')}"
    return [title, blocks_table(model), *(f"note: {text}" for text in blocks_in_words(model))]


def blocks_in_words(model: UncertainLTI) -> list[str]:
    """What a reader should know of the blocks of a scheduled model."""
    if model.schedule is None:
        return []
    found, of, name = [], model.schedule.blocks, model.block_name
    unknown = [name(r) for r, d in enumerate(model.block_data) if not d.known]
    if unknown:
        none = f"no recording visited {plural(len(unknown), 'regime')} of {of}, and no bound there can be trusted"
        found.append(f"{none}: {shortlist(unknown, 6)}; record the machine there, or leave the knots out")
    known = [(name(r), d.tied_to) for r, d in enumerate(model.block_data) if d.known]
    if tied := [f"{block} (as {name(to)})" for block, to in known if to is not None]:
        whose = "its" if len(tied) == 1 else "their"
        few = f"{plural(len(tied), 'regime')} of {of} had too little data for elements of {whose} own"
        found.append(f"{few}: {shortlist(tied, 6)}")
    if any(d.transitions is None for d in model.block_data):
        found.append("the model file does not say how much data each regime had")
    return found


MOST_PARTS = 20
"""Recordings or blocks that the table of each names, those with most alarms first."""
COLUMNS: Mapping[str, tuple[tuple[str, str], ...]] = {
    "sensor": (("bias", "off by"), ("drift", "drifts, per s"), ("scale", "scaled by"), ("noise", "noise")),
    "sensor ": (("spike", "one sample off by"), ("freeze", "frozen, s"), ("dropout", "reads 0, s"),
                ("sensor_delay", "late, s")),
    "actuator": (("offset", "off by"), ("loss", "loses"), ("stuck", "stuck, s"), ("actuator_delay", "late, s")),
    "dynamics": (("time_constant", "time constant"), ("gain", "gain")),
}  # fmt: skip
"""Kinds of faults that share a table, and heads of their columns."""
_SHARES = ("scale", "loss", "time_constant", "gain")


def validation_text(data: Mapping[str, Any]) -> str:
    """Summary of `Validation.to_dict()` for a person."""
    return text_of(validation_blocks(data))


def readable_validation(data: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """A model's section on validation where it says what `validate` writes."""
    return _readable(data, validation_blocks)


def _readable(data: Any, *showing: Callable[[Any], object]) -> Mapping[str, Any] | None:
    """A part of a model file if all of these can show it; anything may be written in a file."""
    try:
        for show in showing:
            show(data)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
        return None
    return data  # type: ignore[no-any-return]


def validation_blocks(data: Mapping[str, Any]) -> list[Block]:
    """How the model does on what was left out, its false alarms, and the faults that it sees."""
    what = _part(data)
    gap = f", {number(data['gap'])} s on both sides not fitted either" if data["kind"] == "blocks" else ""
    under = f", {data['condition_short']}"
    percent = f"{data['confidence']:.0%}"
    rows = []
    for name, s in data["states"].items():
        widths = [number(s["mean_width_left_out"]), number(s["mean_width_full"])]
        whole = f"{s['parts_inside']:d}/{data['parts']:d}"
        rows.append([named(name, s["unit"]), share(s["inside"]), whole, *widths])
    blocks: list[Block] = [
        f"left out one {_unit(data)} at a time ({_how_many(data)}{gap}): {plural(data['verdicts'], 'verdict')}, "
        f"{number(data['hours'])} h",
        Table(("left out", "inside", f"{what}s inside", "mean width", "mean width fitted"), rows, most=200),
    ]
    if data["inside"] is not None:
        low, high = data["inside_interval"]
        of = f"{percent} interval {low:.3%} to {high:.3%}{under}"
        blocks.append(f"inside all bounds: {data['inside']:.3%} of the verdicts ({of})")
        low, high = data["parts_inside_interval"]
        of = f"{percent} interval {low:.1%} to {high:.1%}{under}"
        blocks.append(f"whole {what}s inside all bounds: {data['parts_inside']:d} of {data['parts']:d} ({of})")
        if groups := data["groups"]:
            blocks.append(f"whole groups inside all bounds: {groups['inside']} of {groups['count']}")
        rows = [_alarm_row(alarm) for alarm in data["false_alarms"]]
        blocks.append(Table(("alarm rule", "alarms", "per hour", f"{percent} interval{under}", "time in alarm"), rows))
    worst = sorted(data["part"], key=lambda p: (-p["alarms"], -p["violated"] / max(p["verdicts"], 1)))
    header = (what, "verdicts", "inside", "outside domain", "alarms", "time in alarm", "farthest, in half-widths")
    blocks.append(Table(header, [_part_row(p) for p in worst], most=MOST_PARTS))
    blocks += [data["condition"], data["scenario"]["words"]]
    if (faults := detectable_data(data)) is not None:
        blocks += detectable_blocks(faults)
    return [*blocks, *data.get("promises", []), *(f"note: {note}" for note in data["notes"])]


def _alarm_row(alarm: Mapping[str, Any]) -> list[str]:
    rule = "the model's" if "; or " in alarm["rule"] else str(alarm["rule"])
    low, high = alarm["interval"]
    least = "unknown" if high is None else f"{number(low if low > 1e-4 * high else 0.0)} to {number(high)}"
    return [rule, f"{alarm['alarms']:d}", number(alarm["per_hour"]), least, share(alarm.get("raised_share"))]


def _part_row(part: Mapping[str, Any]) -> list[str]:
    judged = part["verdicts"]
    inside = share(1 - part["violated"] / judged if judged else None)
    outside_domain = share(part["outside_domain"] / judged if judged else None, 2)
    farthest = "-" if part["farthest"] is None else f"{part['farthest_state']}, {part['farthest']:.3g} x"
    alarms = [str(part["alarms"]), share(part["alarm_share"])]
    return [part["name"], str(judged), inside, outside_domain, *alarms, farthest]


def left_out_text(data: Mapping[str, Any]) -> str:
    """One line for a fit, and the hint that recordings may come in groups."""
    if "not_done" in data:
        return f"not validated, so how it does on other recordings is unknown: {data['not_done']}"
    ratio = max((s["left_out_to_full"] for s in data["states"].values()), default=math.nan)
    inside = "no verdict" if data["inside"] is None else f"{data['inside']:.3%} of the verdicts inside"
    whole = f"{plural(data['parts_inside'], f'whole {_part(data)}')}, widths at most {ratio:.3g} times those above"
    line = f"left out one {_unit(data)} at a time ({_how_many(data)}): {inside}, {whole}; more: uncertain-lti validate"
    return f"{line}\nnote: {data['hint']}" if data["hint"] else line


def _part(data: Mapping[str, Any]) -> str:
    return "recording" if data["kind"] == "transients" else "block"


def _unit(data: Mapping[str, Any]) -> str:
    """What was left out at a time."""
    return "group" if data["groups"] else _part(data)


def _how_many(data: Mapping[str, Any]) -> str:
    parts, groups = plural(data["parts"], _part(data)), data["groups"]
    return f"{parts} in {plural(groups['count'], 'group')}, by {groups['key']}" if groups else parts


# --- smallest detectable faults ----------------------------------------------------------------------------------


def detectable_data(validation: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The section on detectable faults of a model's validation, if it is one."""
    return _readable(validation.get("detectable"), detectable_blocks, detectable_words)


def condition_text(data: Mapping[str, Any]) -> str:
    """What the sizes hold for."""
    out = data["left_out"]
    without = f"; {plural(out, 'case')} with an alarm without a fault left out" if out else ""
    seen = f"smallest fault seen in {data['share']:.0%} of the cases within {number(data['within'])} s"
    put = f"put into what was left out at {plural(data['cases'], 'instant')}{without}"
    return f"{seen} ({data['confidence']:.0%} interval; {put})"


def detectable_blocks(data: Mapping[str, Any]) -> list[Block]:
    """The smallest detectable faults, a table for kinds that are alike."""
    if data.get("refused"):
        return [f"which faults are seen is not known: {data['refused']}"]
    blocks: list[Block] = [condition_text(data)]
    for of, columns in COLUMNS.items():
        faults = {(f["signal"], f["kind"]): f for f in data["faults"] if f["kind"] in dict(columns)}
        there = [(kind, head) for kind, head in columns if any(kind == k for _, k in faults)]
        rows = []
        for signal in dict.fromkeys(signal for signal, _ in faults):
            mine = [faults.get((signal, kind)) for kind, _ in there]
            unit = next((f["unit"] for f in mine if f and f["kind"] in ("bias", "offset")), "")
            rows.append([named(signal, unit), *("-" if f is None else _size_text(f) for f in mine)])
        if rows:
            blocks.append(Table((of.strip(), *(head for _, head in there)), rows, most=200))
    return blocks + list(dict.fromkeys(f"unknown: {f['refused']}" for f in data["faults"] if f.get("refused")))


def detectable_words(data: Mapping[str, Any]) -> list[str]:
    """A short clause for each state and control, those of a first screen."""
    words: dict[str, list[str]] = {}
    for fault in data["faults"]:
        verb = {"bias": "off by", "drift": "drifts by", "offset": "off by", "loss": "loses"}.get(fault["kind"])
        if verb is not None and not fault.get("refused"):
            no, size = ("", fault["size"]) if fault["size"] is not None else ("not even if it ", fault["largest"])
            words.setdefault(fault["signal"], []).append(f"{no}{verb} {_size(fault, size)} {fault['unit']}".rstrip())
    return [f"{signal}: {', '.join(parts)}" for signal, parts in words.items()]


def _size_text(fault: Mapping[str, Any]) -> str:
    """The smallest detectable size of one fault."""
    if fault.get("refused"):
        return "unknown"
    if fault["size"] is None:
        return f"not seen ({fault['share']:.0%} at {_size(fault, fault['largest'])})"
    low, high = fault["size_interval"]
    return f"{_size(fault, fault['size'])} ({_size(fault, low)} to {_size(fault, high)})"


def _size(fault: Mapping[str, Any], value: float | None) -> str:
    if value is None:
        return "more than tried"
    return f"{100 * value:.3g}%" if fault["kind"] in _SHARES else f"{value:.3g}"


# --- tune and signature ------------------------------------------------------------------------------------------


def tune_text(data: Mapping[str, Any]) -> str:
    """What `tune` prints: every way that was tried, and what was chosen."""
    header = ("way", "jumps seen, over those of fit", "width/range", "false alarms per hour at most")
    tried = [t for t in data["trials"] if "refused" not in t]
    rows = [[t["way"], number(t["size"]), share(t["width_over_range"], 2), number(t["limit_per_hour"])] for t in tried]
    refused = [f"  {t['way']}: {t['refused']}" for t in data["trials"] if "refused" in t]
    return text_of([Table(header, rows), *refused, f"chosen: {data['reason']}"])


def signature_text(learnt: Learnt) -> str:
    """What `signature` prints."""
    rows = [[s.label, str(s.recordings), str(s.verdicts), ", ".join(map(str, s.steps))] for s in learnt.signatures]
    blocks: list[Block] = [Table(("signature", "recordings", "verdicts", "steps"), rows)]
    labels = [label for _, label, _ in learnt.named]
    tried = [(label, found) for _, label, found in learnt.named if labels.count(label) > 1]
    if tried:
        right, unknown = sum(label == found for label, found in tried), sum(not found for _, found in tried)
        others = f"{len(tried) - right - unknown} as another fault, {unknown} unknown"
        named_right = f"{right} of {plural(len(tried), 'recording')} named as labelled"
        blocks.append(f"left out in turn, {named_right}, {others}")
    blocks += [f"'{a}' and '{b}' look alike (match {match:.2f}), so neither is named" for a, b, match in learnt.alike]
    return text_of(blocks)
