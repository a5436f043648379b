# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What `info` prints of a model."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from uncertain_lti.base.english import plural
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.reports.detectable_text import condition_text, detectable_data, detectable_words
from uncertain_lti.reports.regimes import MOST_REGIMES, block_facts, blocks_in_words
from uncertain_lti.reports.tables import number, table


def model_text(model: UncertainLTI) -> str:
    """Summary of a model file."""
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
        for kind, group in (
            ("state", model.signals.states),
            ("control", model.signals.controls),
            ("scheduling", model.signals.scheduling),
        )
        for signal in group
    ]
    lines.append(table(("signal", "topic", "field", "steady", "scale", "unit"), signals))
    lines += _scheduled_text(model) if model.schedule is not None else [_elements(model), *dynamics_text(model)]
    if facts.get("mean_width_recorded"):
        widths = [
            [name, number(a), number(b)]
            for name, a, b in zip(
                model.state_names, facts["mean_width_recorded"], facts["max_width_recorded"], strict=True
            )
        ]
        lines.append(table(("one-step envelope", "mean width", "largest"), widths))
    lines += horizon_widths_text(model)
    for rule in model.alarm:
        if isinstance(rule, AlarmRule):
            over = "" if rule.horizon == 1 else f" over {rule.horizon} steps"
            lines.append(
                f"alarm: {rule.violations} of the last {plural(rule.window, 'verdict')} violated{over}; margin "
                f"{number(rule.margin)}"
            )
        else:
            lines.append(f"alarm: {rule.words}")
    if model.signatures:
        lines.append(f"signatures of faults: {', '.join(signature.label for signature in model.signatures)}")
    if (faults := detectable_data(model.validation)) is not None:
        lines += [condition_text(faults), *(f"  {text}" for text in detectable_words(faults))]
    return "\n".join(lines + [f"note: {message}" for message in facts.get("messages", [])])


def horizon_widths_text(model: UncertainLTI) -> list[str]:
    """Widths of the envelopes over several steps."""
    if not (over := model.fit_summary.get("horizons")):
        return []
    rows = [[str(h["steps"]), number(h["seconds"]), h["widths"], *map(number, h["mean_width_recorded"])] for h in over]
    return [table(("mean width after steps", "s", "half-widths", *model.state_names), rows)]


MOST_PRINTED = 12
"""Blocks whose elements are printed."""


def _elements(model: UncertainLTI, title: str = "A, B [1/s]") -> str:
    """Elements of one block with their half-widths."""
    names = [*model.state_names, *model.control_names]
    nominal, half = np.hstack([model.A, model.B]), np.hstack([model.dA, model.dB])
    shown = [
        (term.nominal or f"{term.half} ({term.word})", np.column_stack(pair))
        for term, *pair in model.additive()
        if np.any(pair)
    ]
    rows = [
        [name]
        + [f"{nominal[i, j]:.4g} ± {half[i, j]:.3g}" for j in range(len(names))]
        + [f"{pair[i, 0]:.4g} ± {pair[i, 1]:.3g}" for _, pair in shown]
        for i, name in enumerate(model.state_names)
    ]
    return table((title, *names, *(name for name, _ in shown)), rows)


def _scheduled_text(model: UncertainLTI) -> list[str]:
    """Regimes, then the elements of each block that has some of its own."""
    lines = regimes_text(model)
    own = [r for r, data in enumerate(model.block_data) if data.tied_to is None]
    lines += [_elements(model.blocks[r], f"{r}: {model.block_name(r)}: A, B [1/s]") for r in own[:MOST_PRINTED]]
    if (more := len(own) - MOST_PRINTED) > 0:
        lines.append(f"  and the elements of {plural(more, 'more regime')}; --json has all")
    return lines


def regimes_text(model: UncertainLTI) -> list[str]:
    """The regimes of a scheduled model: data, mean widths when fitted, eigenvalues and time constants."""
    if model.schedule is None:
        return []
    blocks = block_facts(model)
    widths = any(block["mean_width"] for block in blocks)
    header = ["regime", "transitions", "elements of"]
    header += [f"{name}: mean width" for name in model.state_names] * widths
    rows = []
    names = [f"{r}: {block['regime']}" for r, block in enumerate(blocks)]
    for name, block in zip(names[:MOST_REGIMES], blocks, strict=False):
        transitions = "unknown" if block["transitions"] is None else str(block["transitions"])
        row = [name, transitions if block["known"] else "0, not visited"]
        row.append("its own" if block["tied_to"] is None else f"regime {block['tied_to']}")
        row += [number(w) for w in block["mean_width"] or [None] * model.n] * widths
        rows.append(row)
    lines = [
        f"scheduled on {model.schedule.words}, {plural(model.schedule.blocks, 'regime')}",
        table(header, rows),
        table(
            ("regime", "eigenvalues of A [1/s]", "time constants [s]"),
            [
                [name, _eigenvalues(b["eigenvalues"]), ", ".join(_constant(v) for v in b["time_constants"])]
                for name, b in zip(names[:MOST_REGIMES], blocks, strict=False)
            ],
        ),
    ]
    if (more := len(blocks) - MOST_REGIMES) > 0:
        lines.append(f"  and {plural(more, 'more regime')}; --json has all")
    return lines + [f"note: {text}" for text in blocks_in_words(model)]


def _constant(value: float | None) -> str:
    return "grows" if value is None else number(value)


def eigenvalues_text(model: UncertainLTI) -> str:
    """Eigenvalues of A of a model without a schedule in one line."""
    return _eigenvalues([[float(v.real), float(v.imag)] for v in model.eigenvalues()])


def _eigenvalues(pairs: Sequence[Sequence[float]]) -> str:
    return ", ".join(
        f"{real:.4g}{imag:+.4g}j" if abs(imag) > 1e-12 * math.hypot(real, imag) else f"{real:.4g}"
        for real, imag in pairs
    )


def dynamics_text(model: UncertainLTI) -> list[str]:
    """How fast a fitted model is: eigenvalues in one line, or the regimes of a scheduled model."""
    return regimes_text(model) or [f"eigenvalues of A [1/s]: {eigenvalues_text(model)}"]
