# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Figure of the utilisation over horizons and time: what is fast shows in the first row, what is slow in the last."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from uncertain_lti.base.errors import ModelError
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.verdicts import Verdicts
from uncertain_lti.reports.drawing import ALARM, NO_VERDICT, VIOLATED, WIDTH, new_figure, patch, short
from uncertain_lti.reports.figure_columns import DrawnColumns, TimeAxis


def horizon_figure(
    model: UncertainLTI,
    verdicts: Verdicts,
    states: Sequence[str] | None = None,
    span: tuple[float, float] | None = None,
) -> Any:
    """The greatest |utilisation| in each stretch of time, one map per state with a row per number of steps.

    Parameters
    ----------
    model : UncertainLTI
        The model checked with; without horizons there is one row.
    verdicts : Verdicts
        Of `EnvelopeMonitor.check`.
    states : sequence of str, optional
        Names of the states to show; default all.
    span : (float, float), optional
        Show only this time, s.

    Returns
    -------
    matplotlib.figure.Figure
        Not written yet; see `figures.save`.

    Raises
    ------
    ModelError
        A name is not a state of the model.
    """
    from matplotlib import colormaps
    from matplotlib.colors import to_rgb

    names = list(model.state_names if states is None else states)
    for name in names:
        if name not in model.state_names:
            raise ModelError(f"there is no state '{name}'; there are {', '.join(model.state_names)}")
    axis_time = TimeAxis(verdicts.transient)
    drawn = DrawnColumns.of(verdicts, axis_time.t, span, always=True)
    table = verdicts.horizon_utilisation
    rows = [str(h) for h in (1, *model.steps)]
    step = model.sampling.dt_median
    if step is not None:
        rows = [f"{row} ({int(row) * step:.3g} s)" for row in rows]
    row_height, gap, top, bottom = 0.16, 0.27, 0.55, 0.5
    height = max(row_height * len(rows), 0.3)
    figure = new_figure(WIDTH, top + bottom + len(names) * (height + gap))
    total = figure.get_size_inches()[1]
    left = 0.35 + 0.055 * max(len(row) for row in rows)
    colours = colormaps["Blues"].with_extremes(over=VIOLATED, bad=(*to_rgb(NO_VERDICT), 0.35))
    edge = np.unique(drawn.edges)
    column = np.searchsorted(edge, drawn.edges[:, 0])
    mesh, axis = None, None
    for place, name in enumerate(names):
        y = bottom + (len(names) - 1 - place) * (height + gap)
        box = (left / WIDTH, y / total, (WIDTH - left - 0.9) / WIDTH, height / total)
        axis = figure.add_axes(box, sharex=axis)
        values = np.full((len(rows), max(len(edge) - 1, 1)), np.nan)
        for j in range(len(rows)):
            u = table[:, j, model.state_names.index(name)]
            if len(u):
                values[j, column] = np.fmax(np.abs(drawn.least(u)), np.abs(drawn.greatest(u)))
        mesh = axis.pcolormesh(
            edge if len(edge) > 1 else [0.0, 1.0], np.arange(len(rows) + 1), np.ma.masked_invalid(values),
            cmap=colours, vmin=0.0, vmax=1.0, rasterized=True,
        )  # fmt: skip
        for begin, length in drawn.alarms():
            axis.axvspan(begin, begin + length, ymin=0.0, ymax=0.06, color=ALARM, linewidth=0)
        axis.set_yticks(np.arange(len(rows)) + 0.5, rows, fontsize=6.5)
        axis.tick_params(axis="x", labelsize=7, labelbottom=place == len(names) - 1)
        with np.errstate(invalid="ignore"):
            outside = ", ".join(str(int(n)) for n in (np.abs(table[:, :, model.state_names.index(name)]) > 1.0).sum(0))
        axis.set_title(short(name), loc="left", fontsize=8, pad=2)
        axis.set_title(f"outside: {outside}", loc="right", fontsize=7, pad=2)
    if mesh is not None and axis is not None:
        axis.set_xlabel(axis_time.label, fontsize=8)
        bar = figure.add_axes(((WIDTH - 0.75) / WIDTH, bottom / total, 0.15 / WIDTH, height / total))
        figure.colorbar(mesh, cax=bar, extend="max")
        bar.tick_params(labelsize=7)
        bar.set_ylabel("|utilisation|", fontsize=7)
    figure.text(0.1 / WIDTH, 1 - 0.2 / total, "steps from the measured state, and time", fontsize=9)
    handles = [
        patch(VIOLATED, 1.0, "outside"), patch(ALARM, 1.0, "alarm"), patch(NO_VERDICT, 0.35, "no unbroken window"),
    ]  # fmt: skip
    figure.legend(
        handles=handles, loc="upper right", bbox_to_anchor=(0.995, 1 - 0.02 / total), ncol=3, fontsize=7, frameon=False
    )
    return figure
