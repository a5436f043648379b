# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""A model at a glance: tables of its elements, or of the blocks of its schedule, for texts, pages and notebooks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from uncertain_lti.base.text import MOST, Table, html_table, list_of, named, number, numbers_of
from uncertain_lti.model.alarm_rule import AlarmRule


def overview(model: Any) -> str:
    """Nominal elements with their half-widths, or the blocks of a schedule, and the widths that the fit reached."""
    facts, below = model.fit_summary, []
    if facts.get("mean_width_recorded") is not None:
        each = zip(model.signals.states[:MOST], np.ravel(facts["mean_width_recorded"]), strict=False)
        widths = [f"{named(s.name, s.unit)} {number(float(w))}" for s, w in each]
        below.append(f"mean one-step width: {', '.join(widths)}" + ", …" * (model.n > MOST))
    for rule in model.alarm:
        margin = f", margin {number(rule.margin)}" if isinstance(rule, AlarmRule) else ""
        below.append(f"alarm: {rule.words}{margin}")
    below += [f"note: {message}" for message in facts.get("messages", [])]
    table = elements_table(model) if model.schedule is None else blocks_table(model)
    header, *rows = [[*row[: MOST + 1], *["…"] * (len(row) > MOST + 1)] for row in (table.header, *table.rows[:MOST])]
    return html_table(repr(model), header, rows + [["…"] * len(header)] * (len(table.rows) > MOST), below)


def elements_table(model: Any) -> Table:
    """Elements with their half-widths: a row per state, a column per signal and additive term."""
    columns = [(name, model.A[:, j], model.dA[:, j]) for j, name in enumerate(model.state_names)]
    columns += [(name, model.B[:, j], model.dB[:, j]) for j, name in enumerate(model.control_names)]
    for term, nominal, half in model.additive():
        if nominal.any() or half.any():
            columns.append((term.nominal or f"{term.half} ({term.word})", nominal, half))
    rows = [
        [name, *(f"{nominal[i]:.4g} ± {half[i]:.3g}" for _, nominal, half in columns)]
        for i, name in enumerate(model.state_names)
    ]
    return Table(("A, B [1/s]", *(name for name, *_ in columns)), rows)


def blocks_table(model: Any) -> Table:
    """A row per block of a scheduled model: what it rests on, and how fast it is."""
    facts = block_facts(model)
    widths = any(block["mean_width"] for block in facts)
    header = ["regime", "transitions", "elements of", "time constants [s]"]
    header += [f"{name}: mean width" for name in model.state_names] * widths
    rows = []
    for block in facts:
        transitions = "unknown" if block["transitions"] is None else str(block["transitions"])
        row = [block["regime"], transitions if block["known"] else "0, not visited"]
        row.append("its own" if block["tied_to"] is None else facts[block["tied_to"]]["regime"])
        row.append(", ".join("grows" if v is None else number(v) for v in block["time_constants"]))
        rows.append(row + [number(w) for w in block["mean_width"] or [None] * model.n] * widths)
    return Table(header, rows)


def block_facts(model: Any) -> list[dict[str, Any]]:
    """What each block of a scheduled model rests on, and how fast it is."""
    if model.schedule is None:
        return []
    fitted = list_of(model.fit_summary.get("blocks"))
    knots = model.schedule.recorded_values(model.signals.signals)
    facts = []
    for r, (data, values) in enumerate(zip(model.block_data, model.eigenvalues(), strict=True)):
        said = fitted[r] if r < len(fitted) and isinstance(fitted[r], Mapping) else {}
        widths = numbers_of(said.get("mean_width"), model.n)
        axes = zip(model.schedule.axes, knots, model.schedule.indices[r], strict=True)
        facts.append(
            {
                "regime": model.block_name(r),
                "at": {axis.signal: float(values_of[k]) for axis, values_of, k in axes},
                "transitions": data.transitions,
                "tied_to": data.tied_to,
                "known": data.known,
                "mean_width": None if widths is None else (np.array(widths) * model.operating_point.X).tolist(),
                "eigenvalues": [[float(v.real), float(v.imag)] for v in values],
                "time_constants": [-1.0 / float(v.real) if v.real < 0 else None for v in values],
            }
        )
    return facts
