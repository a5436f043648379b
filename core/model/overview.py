# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What a notebook shows of a model: its elements with their half-widths, or the blocks of its schedule."""

from __future__ import annotations

from typing import Any

import numpy as np

from uncertain_lti.base.html_table import MOST, html_table, name_with_unit, number_text
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.model.schedule import Schedule


def overview(model: Any) -> str:
    """Nominal elements with their half-widths, or the blocks of a schedule, and the widths that the fit reached."""
    header, rows = _elements(model) if model.schedule is None else _blocks(model, model.schedule)
    facts, below = model.fit_summary, []
    if facts.get("mean_width_recorded") is not None:
        widths = [
            f"{name_with_unit(s.name, s.unit)} {number_text(float(w))}"
            for s, w in zip(model.signals.states[:MOST], np.ravel(facts["mean_width_recorded"]), strict=False)
        ]
        below.append(f"mean one-step width: {', '.join(widths)}" + ", …" * (model.n > MOST))
    for rule in model.alarm:
        margin = f", margin {number_text(rule.margin)}" if isinstance(rule, AlarmRule) else ""
        below.append(f"alarm: {rule.words}{margin}")
    below += [f"note: {message}" for message in facts.get("messages", [])]
    return html_table(repr(model), header, rows, below)


def _elements(model: Any) -> tuple[list[str], list[list[str]]]:
    """Of one block: a row per state, a column per signal and additive term."""
    names = [*model.state_names, *model.control_names]
    nominal, half = np.hstack([model.A, model.B]), np.hstack([model.dA, model.dB])
    shown = range(min(len(names), MOST))
    extra = [(t.nominal or t.half, a, b) for t, a, b in model.additive() if a.any() or b.any()]
    header = ["A, B [1/s]", *(names[j] for j in shown)]
    header += ["…"] * (len(names) > MOST) + [name for name, _, _ in extra]
    rows = []
    for i in range(min(model.n, MOST)):
        row = [model.state_names[i], *(f"{nominal[i, j]:.4g} ± {half[i, j]:.3g}" for j in shown)]
        row += ["…"] * (len(names) > MOST) + [f"{a[i]:.4g} ± {b[i]:.3g}" for _, a, b in extra]
        rows.append(row)
    if model.n > MOST:
        rows.append(["…"] * len(header))
    return header, rows


def _blocks(model: Any, schedule: Schedule) -> tuple[list[str], list[list[str]]]:
    """A row per block: its data, and the element of A on the diagonal of each state."""
    shown = range(min(model.n, MOST))
    header = ["regime", "transitions", "elements of", *(f"{model.state_names[i]}: A [1/s]" for i in shown)]
    header += ["…"] * (model.n > MOST)
    rows = []
    for r, data in enumerate(model.block_data[:MOST]):
        row = [model.block_name(r), "–" if data.transitions is None else str(data.transitions)]
        row.append("its own" if data.tied_to is None else model.block_name(data.tied_to))
        row += [f"{model.A[r, i, i]:.4g} ± {model.dA[r, i, i]:.3g}" for i in shown] + ["…"] * (model.n > MOST)
        rows.append(row)
    if schedule.blocks > MOST:
        rows.append(["…"] * len(header))
    return header, rows
