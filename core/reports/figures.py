# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Figures of what was fitted and what was judged.

Each function returns a matplotlib Figure; `save` writes it, Jupyter shows it. Colours are distinguished by colour-blind
people as well (Okabe and Ito 2008; Blues, PuOr). Long recordings are drawn by pixel: in each stretch of time the
least and the greatest value, and a mark wherever a single sample of it was violated.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Sequence
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array, Integers
from uncertain_lti.base.errors import ModelError, refuse_other
from uncertain_lti.base.files import whole_file
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.verdicts import Verdicts
from uncertain_lti.reports.drawing import (
    ALARM,
    ENVELOPE,
    NO_VERDICT,
    RECORDED,
    VIOLATED,
    WIDTH,
    brief,
    elements,
    line,
    new_figure,
    no_ticks,
    patch,
    plain,
    short,
)
from uncertain_lti.reports.figure_columns import PIXELS, DrawnColumns, TimeAxis
from uncertain_lti.reports.schedule_figures import elements_figure
from uncertain_lti.reports.width_budget import width_budget
from uncertain_lti.sampling.transient import Transient, listed_transients

_FEW = 8  # states that get a panel of full size each, and columns whose numbers fit into a heat map


_MANY = 30  # names next to each other are written smaller from here on


def envelope_figure(
    model: UncertainLTI,
    verdicts: Verdicts,
    states: Sequence[str] | None = None,
    event: tuple[float, str] | None = None,
    span: tuple[float, float] | None = None,
) -> Any:
    """Each state between its one-step bounds over time, in recorded units, violations marked, gaps shown.

    Parameters
    ----------
    model : UncertainLTI
        The model checked with.
    verdicts : Verdicts
        Of `EnvelopeMonitor.check`.
    states : sequence of str, optional
        Names of the states to show; default all.
    event : (float, str), optional
        Time in s and label of an instant to mark.
    span : (float, float), optional
        Show only this time, s.

    Returns
    -------
    matplotlib.figure.Figure
        Not written yet; see `save`.

    Raises
    ------
    ModelError
        A name is not a state of the model.
    """
    chosen = _chosen(model, verdicts, states)
    axis_time = TimeAxis(verdicts.transient)
    drawn = DrawnColumns.of(verdicts, axis_time.t, span)
    figure, axes = _panels(len(chosen))
    for axis, i in zip(axes, chosen, strict=True):
        lower, upper = drawn.least(verdicts.lower[:, i]), drawn.greatest(verdicts.upper[:, i])
        low, high = drawn.least(verdicts.transient.x[:, i]), drawn.greatest(verdicts.transient.x[:, i])
        _shade(axis, drawn)
        axis.fill_between(*drawn.broken(lower, upper), color=ENVELOPE, alpha=0.55, linewidth=0.5)
        if drawn.binned:
            axis.fill_between(*drawn.broken(low, high), color=RECORDED, linewidth=0.7)
        else:
            dot = "." if len(drawn.t) <= 200 else None
            axis.plot(*drawn.broken(low), color=RECORDED, linewidth=0.9, marker=dot, markersize=3)
        bottom, top = _limits(np.concatenate([lower, low]), np.concatenate([upper, high]))
        axis.set_ylim(bottom, top)
        _mark(axis, *drawn.worst(verdicts, i, verdicts.transient.x[:, i]), bottom, top, len(drawn.t))
        _title(axis, model, i, verdicts, drawn)
        _ticks(axis)
    _finish_time(figure, axes, axis_time, drawn, event)
    handles = [
        patch(ENVELOPE, 0.55, "one-step bounds"),
        line(RECORDED, "recorded"),
        line(VIOLATED, "violated", "o"),
        patch(ALARM, 0.45, "alarm"),
        patch(NO_VERDICT, 0.35, "no verdict"),
    ]
    return _head(figure, verdicts, handles)


def utilisation_figure(
    model: UncertainLTI,
    verdicts: Verdicts,
    states: Sequence[str] | None = None,
    span: tuple[float, float] | None = None,
) -> Any:
    """Where between its bounds each state lay over time: -1 at the lower bound, 1 at the upper one.

    Up to eight states have a panel each; more become the rows of a map of the greatest |utilisation| in each stretch of
    time.

    Parameters
    ----------
    model : UncertainLTI
        The model checked with.
    verdicts : Verdicts
        Of `EnvelopeMonitor.check`.
    states : sequence of str, optional
        Names of the states to show; default all.
    span : (float, float), optional
        Show only this time, s.

    Returns
    -------
    matplotlib.figure.Figure
        Not written yet; see `save`.

    Raises
    ------
    ModelError
        A name is not a state of the model.
    """
    chosen = _chosen(model, verdicts, states)
    axis_time = TimeAxis(verdicts.transient)
    drawn = DrawnColumns.of(verdicts, axis_time.t, span, always=len(chosen) > _FEW)
    if len(chosen) > _FEW:
        return _utilisation_map(model, verdicts, chosen, axis_time, drawn)
    figure, axes = _panels(len(chosen), height=1.0)
    for axis, i in zip(axes, chosen, strict=True):
        low, high = drawn.least(verdicts.utilisation[:, i]), drawn.greatest(verdicts.utilisation[:, i])
        greatest = np.abs(np.concatenate([low, high]))
        greatest = greatest[np.isfinite(greatest)]
        limit = min(max(1.25, 1.1 * float(greatest.max(initial=0.0))), 4.0)
        _shade(axis, drawn)
        axis.axhspan(-1.0, 1.0, color=ENVELOPE, alpha=0.25, linewidth=0)
        low, high = np.clip(low, -limit, limit), np.clip(high, -limit, limit)
        if drawn.binned:
            axis.fill_between(*drawn.broken(low, high), color=RECORDED, linewidth=0.6)
        else:
            axis.plot(*drawn.broken(low), color=RECORDED, linewidth=0.6)
        axis.set_ylim(-limit, limit)
        _mark(axis, *drawn.worst(verdicts, i, verdicts.utilisation[:, i]), -limit, limit, len(drawn.t))
        axis.set_yticks([-1, 0, 1])
        _title(axis, model, i, verdicts, drawn, unit=False)
        _ticks(axis)
    _finish_time(figure, axes, axis_time, drawn, None)
    handles = [
        patch(ENVELOPE, 0.25, "inside the bounds"),
        line(RECORDED, "utilisation"),
        line(VIOLATED, "violated", "o"),
        patch(ALARM, 0.45, "alarm"),
        patch(NO_VERDICT, 0.35, "no verdict"),
    ]
    return _head(figure, verdicts, handles)


def matrices_figure(model: UncertainLTI) -> Any:
    """A and B with their half-widths ΔA and ΔB as heat maps with names, in 1/s of normalised quantities.

    A dot marks an element whose half-width is greater than itself: its sign is not known. Columns c (drift) and
    v (noise, not multiplied by Δt) appear where the model has them. A scheduled model is drawn by
    `schedule_figures.elements_figure`; one block of it is `model.blocks[r]`.

    Parameters
    ----------
    model : UncertainLTI
        The model.

    Returns
    -------
    matplotlib.figure.Figure
        Not written yet; see `save`.
    """
    from matplotlib.colors import LogNorm, SymLogNorm

    refuse_other(model, UncertainLTI, "model", "give a model", ModelError)
    if model.schedule is not None:
        return elements_figure(model)
    nominal, half, columns = elements(model)
    rows = [short(name) for name in model.state_names]
    numbers = nominal.size <= 110
    cell = 0.62 if numbers else max(0.16, min(0.4, 9.0 / len(columns)))
    width, height = cell * 1.1 * len(columns), max(cell * 0.7 * len(rows), 1.0)
    crowd = max(len(rows), len(columns))
    label, below = _length(rows, crowd), _length(columns, crowd)
    figure = new_figure(max(label + width + 1.0, 3.6), 2 * (height + below + 0.45) + 0.3)
    total_w, total_h = figure.get_size_inches()
    greatest = float(np.abs(nominal).max(initial=0.0)) or 1.0
    least = float(half[half > 0].min(initial=math.inf))
    widest = float(half.max(initial=0.0)) or 1.0
    least = min(max(least, widest * 1e-4), widest * 0.5)
    maps = (
        ("A | B, nominal elements [1/s]", nominal, "PuOr", SymLogNorm(greatest * 1e-3, 0.5, -greatest, greatest)),
        ("ΔA | ΔB, half-widths [1/s]", half, "Blues", LogNorm(least, widest)),
    )
    doubtful = (half[:, : model.n + model.m] > np.abs(nominal[:, : model.n + model.m])).nonzero()
    for k, (title, values, colours, norm) in enumerate(maps):
        bottom = (2 - k - 1) * (height + below + 0.45) + below + 0.25
        axis = figure.add_axes((label / total_w, bottom / total_h, width / total_w, height / total_h))
        shown = np.where(values == 0.0, np.nan, values) if k else values
        image = axis.imshow(shown, cmap=colours, norm=norm, aspect="auto", interpolation="nearest")
        bar = figure.add_axes(((label + width + 0.15) / total_w, bottom / total_h, 0.15 / total_w, height / total_h))
        figure.colorbar(image, cax=bar)
        bar.tick_params(labelsize=7)
        bar.yaxis.set_minor_locator(no_ticks())
        if not k:
            inner = greatest * 10**-1.5
            ticks = [-greatest, 0.0, greatest] if height < 1.3 else [-greatest, -inner, 0.0, inner, greatest]
            bar.set_yticks(ticks, [brief(tick) if tick else "0" for tick in ticks])
        axis.set_title(title, loc="left", fontsize=9)
        _name_cells(axis, rows, columns)
        axis.axvline(model.n - 0.5, color=RECORDED, linewidth=0.8)
        if len(columns) > model.n + model.m:
            axis.axvline(model.n + model.m - 0.5, color=RECORDED, linewidth=0.8)
        if numbers:
            _number_cells(axis, values, image)
        if not k:
            axis.plot(doubtful[1] + 0.36, doubtful[0] - 0.3, ".", color=VIOLATED, markersize=5 if numbers else 3)
    figure.text(
        0.1 / total_w, 0.08 / total_h, "dot: the half-width is greater than the element; white: zero", fontsize=7
    )
    return figure


def budget_figure(model: UncertainLTI, transients: Transient | Sequence[Transient]) -> Any:
    """Which element contributes how much of the mean one-step width, per state, over the transitions of recordings.

    The width of state i is 2 (Δt (ΔA |x| + ΔB |u| + Δc) + v) X_i, eqs. (6)(7) with additive terms: each column is one
    summand as a share of its mean; the width itself is next to the names in recorded units.

    Parameters
    ----------
    model : UncertainLTI
        The model.
    transients : Transient or sequence of Transient
        In recorded units, with the model's signals.

    Returns
    -------
    matplotlib.figure.Figure
        Not written yet; see `save`.

    Raises
    ------
    ModelError
        No recording has a usable transition.
    """
    shares, width, names = width_budget(model, listed_transients(transients))
    columns = [short(name) for name in names]
    rows = []
    for i, name in enumerate(model.state_names):
        unit = model.signals.states[i].unit
        rows.append(f"{short(name)}\n{width[i]:.4g}{' ' + plain(unit) if unit else ''}")
    numbers = shares.size <= 250
    few = len(rows) <= 12
    if not few:
        rows = [row.replace("\n", ": ") for row in rows]
    crowd = max(len(rows), len(columns))
    cell = 0.55 if numbers else max(0.16, min(0.4, 9.0 / len(columns)))
    width_in, height = cell * len(columns), (0.42 if few else 0.2) * len(rows)
    label = _length([part for row in rows for part in row.split("\n")], crowd)
    below = _length(columns, crowd)
    figure = new_figure(max(label + width_in + 0.8, 3.8), height + below + 0.35)
    total_w, total_h = figure.get_size_inches()
    axis = figure.add_axes((label / total_w, below / total_h, width_in / total_w, height / total_h))
    top = 100 * float(shares.max(initial=0.0)) or 100.0
    image = axis.imshow(100 * shares, cmap="Blues", vmin=0, vmax=top, aspect="auto", interpolation="nearest")
    bar = figure.add_axes(((label + width_in + 0.12) / total_w, below / total_h, 0.15 / total_w, height / total_h))
    figure.colorbar(image, cax=bar)
    bar.tick_params(labelsize=7)
    axis.set_title("share of the mean one-step width [%]", loc="left", fontsize=9)
    _name_cells(axis, rows, columns)
    for place in (model.n, model.n + model.m):
        if place < len(columns):
            axis.axvline(place - 0.5, color=RECORDED, linewidth=0.8)
    if numbers:
        for i, j in np.argwhere(shares >= 0.005):
            dark = 100 * shares[i, j] > 0.6 * top
            axis.text(
                j, i, f"{100 * shares[i, j]:.0f}", ha="center", va="center", fontsize=7, color="w" if dark else "k"
            )
    return figure


def coverage_figure(model: UncertainLTI, checked: Verdicts | Sequence[Verdicts]) -> Any:
    """Share of the verdicts outside the bounds, per recording: of any state, and state by state.

    Parameters
    ----------
    model : UncertainLTI
        The model checked with.
    checked : Verdicts or sequence of Verdicts
        One per recording, of `EnvelopeMonitor.check`.

    Returns
    -------
    matplotlib.figure.Figure
        Not written yet; see `save`.
    """
    checked = [checked] if isinstance(checked, Verdicts) else list(checked)
    names = [short(os.path.basename(v.transient.name) or v.transient.name, 40) for v in checked]
    outside, of_any, judged = _outside(checked, model.n)
    rows = [f"{name}  ({_count(n)})" for name, n in zip(names, judged, strict=True)]
    columns = [short(name) for name in model.state_names]
    below, bars = max(_length(columns, len(columns)), 0.55), 2.6
    label = _length(rows, len(rows))
    cell = max(0.16, min(0.6, 9.0 / len(columns)))
    width = max(cell * len(columns), 0.6)
    height = (0.3 if len(rows) <= 15 else 0.2) * len(rows) + 0.1
    figure = new_figure(label + bars + 0.35 + width + 0.9, height + below + 0.75)
    total_w, total_h = figure.get_size_inches()
    axis = figure.add_axes((label / total_w, below / total_h, bars / total_w, height / total_h))
    places = np.arange(len(rows))
    axis.barh(places, 100 * np.nan_to_num(of_any), color=VIOLATED, height=0.7)
    widest = 100 * float(np.nanmax(of_any)) if judged.any() else 0.0
    axis.set_xlim(0, max(1.45 * widest, 0.01) if widest < 70 else 140)
    if widest >= 70:
        axis.set_xticks([0, 50, 100])
    for place, share, n in zip(places, of_any, judged, strict=True):
        text = "no verdict" if not n else "none" if share == 0 else f"{100 * share:.3g} %"
        axis.text(100 * (0.0 if math.isnan(share) else share), place, f" {text}", va="center", fontsize=7)
    axis.set_yticks(places, rows, fontsize=7 if len(rows) <= _MANY else 5.5)
    axis.set_ylim(len(rows) - 0.5, -0.5)
    axis.tick_params(axis="x", labelsize=7)
    axis.set_xlabel("outside any bound [%]", fontsize=8)
    axis.spines[["top", "right"]].set_visible(False)
    left = label + bars + 0.35
    axis = figure.add_axes((left / total_w, below / total_h, width / total_w, height / total_h))
    top = max(float(np.nanmax(100 * outside)) if judged.any() else 0.0, 1e-9)
    colours = _over("Blues")
    image = axis.imshow(100 * outside, cmap=colours, vmin=0, vmax=top, aspect="auto", interpolation="nearest")
    _name_cells(axis, [], columns)
    axis.set_yticks([])
    axis.set_title("state by state [%]", loc="left", fontsize=8)
    if outside.size <= 150:
        for i, j in np.argwhere(np.isfinite(outside)):
            share = 100 * float(outside[i, j])
            dark = share > 0.6 * top
            text = "0" if share == 0 else f"{share:.2g}" if share < 99.5 else "100"
            axis.text(j, i, text, ha="center", va="center", fontsize=6.5, color="w" if dark and share else "k")
    if top > 1e-9:
        bar = figure.add_axes(((left + width + 0.12) / total_w, below / total_h, 0.15 / total_w, height / total_h))
        figure.colorbar(image, cax=bar)
        bar.tick_params(labelsize=7)
    figure.text(
        0.1 / total_w, 1 - 0.28 / total_h, "recording (verdicts), and the share of them that was violated", fontsize=9
    )
    return figure


def save(figure: Any, path: str | os.PathLike[str] | IO[bytes], dpi: int = 110) -> None:
    """Write a figure to an image file, or as PNG to a stream.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
        Of this module.
    path : path or binary stream
        Where to; the ending of a path chooses the format, PNG where it has none.
    dpi : int, default 110
        Dots per inch; a figure's size is in inches.

    Raises
    ------
    ModelError
        No image is written with such an ending.
    OSError
        The file cannot be written.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # names may be in any script
        if not isinstance(path, (str, os.PathLike)):
            figure.savefig(path, dpi=dpi)
            return
        kind = os.path.splitext(path)[1][1:] or "png"
        if kind not in figure.canvas.get_supported_filetypes():
            raise ModelError(f"{path}: no image is written as '{kind}'; end the name in .png, .svg or .pdf")
        with whole_file(path) as stream:
            figure.savefig(stream, dpi=dpi, format=kind)


def pixels(figure: Any, dpi: int = 110) -> NDArray[np.uint8]:
    """Draw a figure.

    Returns (height, width, 3): red, green and blue.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # names may be in any script
        figure.set_dpi(dpi)
        figure.canvas.draw()
    drawn: NDArray[np.uint8] = np.asarray(figure.canvas.buffer_rgba())[..., :3]
    return drawn


# --- pieces ----------------------------------------------------------------------------------------------------------


def _outside(checked: Sequence[Verdicts], n: int) -> tuple[Array, Array, Integers]:
    """Shares of the verdicts violated (recordings, n), of any state (recordings,), and the verdicts."""
    judged = np.array([int(v.judged.sum()) for v in checked], dtype=np.int64)
    outside, of_any = np.full((len(checked), n), np.nan), np.full(len(checked), np.nan)
    for row, (v, count) in enumerate(zip(checked, judged, strict=True)):
        if count:
            own = (~np.isnan(v.flags)).sum(axis=0)
            outside[row] = (v.flags == 1.0).sum(axis=0) / np.where(own, own, np.nan)
            of_any[row] = v.violated.sum() / count
    return outside, of_any, judged


def _chosen(model: UncertainLTI, verdicts: Verdicts, states: Sequence[str] | None) -> list[int]:
    refuse_other(model, UncertainLTI, "model", "give the model that the recording was checked with", ModelError)
    refuse_other(
        verdicts, Verdicts, "verdicts", "give what EnvelopeMonitor(model).check(transient) returned", ModelError
    )
    names = list(model.state_names if states is None else states)
    for name in names:
        if name not in model.state_names:
            raise ModelError(f"there is no state '{name}' to draw; states are {', '.join(model.state_names)}")
    return [model.state_names.index(name) for name in names]


def _panels(count: int, height: float = 1.45) -> tuple[Any, list[Any]]:
    """One panel per state; many in two columns."""
    columns = 1 if count <= _FEW else 2
    rows = math.ceil(count / columns)
    if columns == 2:
        height = min(height, 0.8)
    left, gap, top, bottom, title = 0.75, 0.75, 0.5, 0.5, 0.3
    width = (WIDTH - left - 0.15 - (columns - 1) * gap) / columns
    figure = new_figure(WIDTH, top + bottom + rows * (height + title))
    total = figure.get_size_inches()[1]
    axes: list[Any] = []
    for i in range(count):
        column, row = divmod(i, rows)
        x, y = left + column * (width + gap), bottom + (rows - 1 - row) * (height + title)
        axes.append(
            figure.add_axes((x / WIDTH, y / total, width / WIDTH, height / total), sharex=axes[0] if axes else None)
        )
        last = row == rows - 1 or i == count - 1
        axes[-1].tick_params(labelbottom=last, labelsize=7)
        if last:
            axes[-1].set_xlabel("time [s]", fontsize=8)
    return figure, axes


def _utilisation_map(
    model: UncertainLTI, verdicts: Verdicts, chosen: Sequence[int], axis_time: TimeAxis, drawn: DrawnColumns
) -> Any:
    names = [short(model.state_names[i]) for i in chosen]
    label = _length(names, 0)
    height = 0.19 * len(names)
    figure = new_figure(WIDTH, height + 1.35)
    total = figure.get_size_inches()[1]
    axis = figure.add_axes((label / WIDTH, 0.5 / total, (WIDTH - label - 0.9) / WIDTH, height / total))
    edge = np.unique(drawn.edges)
    column = np.searchsorted(edge, drawn.edges[:, 0])
    values = np.full((len(chosen), max(len(edge) - 1, 1)), np.nan)
    for row, i in enumerate(chosen):
        u = verdicts.utilisation[:, i]
        worst = np.fmax(np.abs(drawn.least(u)), np.abs(drawn.greatest(u)))
        bad = drawn.greatest(verdicts.flags[:, i]) == 1.0
        values[row, column] = np.where(bad, 2.0, np.minimum(worst, 1.0))
    mesh = axis.pcolormesh(
        edge if len(edge) > 1 else [0.0, 1.0], np.arange(len(chosen) + 1), np.ma.masked_invalid(values),
        cmap=_over("Blues"), vmin=0.0, vmax=1.0, rasterized=True,
    )  # fmt: skip
    axis.set_yticks(np.arange(len(chosen)) + 0.5, names, fontsize=7)
    axis.set_ylim(len(chosen), 0)
    axis.tick_params(axis="x", labelsize=7)
    axis.set_xlabel(axis_time.label, fontsize=8)
    bar = figure.add_axes(((WIDTH - 0.75) / WIDTH, 0.5 / total, 0.15 / WIDTH, height / total))
    figure.colorbar(mesh, cax=bar, extend="max")
    bar.tick_params(labelsize=7)
    bar.set_title("|utilisation|", fontsize=7)
    return _head(figure, verdicts, [patch(VIOLATED, 1.0, "violated"), patch("#FFFFFF", 1.0, "no verdict")])


def _name_cells(axis: Any, rows: Sequence[str], columns: Sequence[str]) -> None:
    size = 7 if max(len(rows), len(columns)) <= _MANY else 5.5
    axis.set_xticks(range(len(columns)), columns, rotation=90, fontsize=size)
    axis.set_yticks(range(len(rows)), rows, fontsize=size)
    axis.tick_params(length=2)


def _number_cells(axis: Any, values: Array, image: Any) -> None:
    for i, j in np.argwhere(values != 0.0):
        red, green, blue, _ = image.cmap(image.norm(values[i, j]))
        dark = 0.3 * red + 0.6 * green + 0.1 * blue < 0.5
        axis.text(j, i, brief(values[i, j]), ha="center", va="center", fontsize=6.5, color="w" if dark else "k")


def _limits(lower: Array, upper: Array) -> tuple[float, float]:
    """Of an axis: everything, unless a few far values would flatten the rest; those are then marked at its edge."""
    lower, upper = lower[np.isfinite(lower)], upper[np.isfinite(upper)]
    if not len(lower) or not len(upper):
        return 0.0, 1.0
    bottom, top = float(lower.min()), float(upper.max())
    low, high = float(np.quantile(lower, 0.02)), float(np.quantile(upper, 0.98))
    if top - bottom > 8.0 * (high - low) > 0.0:
        bottom, top = max(bottom, low - (high - low)), min(top, high + (high - low))
    room = 0.08 * (top - bottom) or 0.05 * max(abs(top), 1e-12)
    return bottom - room, top + room


def _mark(axis: Any, t: Array, values: Array, utilisation: Array, bottom: float, top: float, points: int) -> None:
    """A mark on each, and one at the edge of the panel for what lies beyond it; a line of them below all."""
    if not len(t):
        return
    size = 3.5 if len(t) <= 150 else 2.0 if len(t) <= 600 else 1.2
    values = np.where(np.isfinite(values), values, np.where(utilisation > 0, top, bottom))
    for which, marker in ((values > top, "^"), (values < bottom, "v"), ((values <= top) & (values >= bottom), "o")):
        if which.any():
            shown = np.clip(values[which], bottom, top)
            axis.plot(
                t[which], shown, linestyle="none", marker=marker, markersize=size if marker == "o" else 5,
                color=VIOLATED, markeredgewidth=0, clip_on=marker == "o", zorder=3,
            )  # fmt: skip
    axis.plot(
        t, np.full(len(t), 0.025), "|", color=VIOLATED, markersize=5, markeredgewidth=1.0 if len(t) > 300 else 1.4,
        transform=axis.get_xaxis_transform(), zorder=3,
    )  # fmt: skip


def _shade(axis: Any, drawn: DrawnColumns) -> None:
    silent = ~drawn.judged | drawn.after
    silent[:1] = False
    low, length = (drawn.edges[0, 0], drawn.edges[-1, 1] - drawn.edges[0, 0]) if len(drawn.t) else (0.0, 1.0)
    holes = [
        (float(a), float(b - a))
        for a, b in zip(drawn.edges[:-1, 1], drawn.edges[1:, 0], strict=True)
        if b - a > 1e-9 * length
    ]
    for spans, colour, alpha in (
        (drawn.alarms(), ALARM, 0.45),
        ((drawn.spans(silent) if not drawn.binned else drawn.spans(~drawn.judged)) + holes, NO_VERDICT, 0.35),
    ):
        if spans:
            least = length / (2 * PIXELS)  # wide enough to be seen
            wide = [(begin, max(extent, least)) for begin, extent in spans]
            axis.broken_barh(
                wide, (0, 1), transform=axis.get_xaxis_transform(), color=colour, alpha=alpha, linewidth=0, zorder=0
            )
    length = length or 1.0
    axis.set_xlim(low - 0.01 * length, low + 1.01 * length)


def _title(axis: Any, model: UncertainLTI, i: int, verdicts: Verdicts, drawn: DrawnColumns, unit: bool = True) -> None:
    signal = model.signals.states[i]
    first = int(drawn.starts[0]) if len(drawn.starts) else 0
    bad = int((verdicts.flags[first : drawn.stop, i] == 1.0).sum())
    wide = axis.get_position().width > 0.6
    text, size = short(signal.name, 70 if wide else 30), 8 if wide else 7
    if unit and signal.unit:
        text += f" [{plain(signal.unit)}]"
    axis.set_title(text, loc="left", fontsize=size, pad=3)
    if bad:
        axis.set_title(f"violated {_count(bad)}", loc="right", fontsize=size, pad=3, color=VIOLATED)


def _ticks(axis: Any) -> None:
    from matplotlib.ticker import FuncFormatter, ScalarFormatter

    greatest = max(map(abs, axis.get_ylim()))
    if 1e-3 <= greatest < 1e8:
        plain = ScalarFormatter(useOffset=False)
        plain.set_scientific(False)
        axis.yaxis.set_major_formatter(plain)
    else:
        axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.4g}"))
    axis.grid(alpha=0.25, linewidth=0.5)
    axis.spines[["top", "right"]].set_visible(False)
    axis.tick_params(axis="y", labelsize=7)


def _finish_time(
    figure: Any, axes: Sequence[Any], axis_time: TimeAxis, drawn: DrawnColumns, event: tuple[float, str] | None
) -> None:
    for axis in axes:
        if axis.get_xlabel():
            axis.set_xlabel(axis_time.label, fontsize=8)
        if event is not None:
            axis.axvline(event[0], color=RECORDED, linestyle="--", linewidth=1.0)
    if event is not None and axes:
        axes[0].annotate(
            plain(event[1]), (event[0], 1.0), xycoords=("data", "axes fraction"), xytext=(4, -10),
            textcoords="offset points", fontsize=8,
        )  # fmt: skip


def _head(figure: Any, verdicts: Verdicts, handles: list[Any]) -> Any:
    judged = int(verdicts.judged.sum())
    total = figure.get_size_inches()[1]
    bad = int(verdicts.violated.sum())
    outside_text = (
        f"{_count(bad)} violated ({100 * bad / judged:.3g} %)"
        if bad
        else "none violated"
        if judged
        else "nothing is known"
    )
    name = short(os.path.basename(verdicts.transient.name) or verdicts.transient.name, 60)
    figure.text(
        0.1 / WIDTH,
        1 - 0.22 / total,
        f"{name}: {_count(judged)} verdict{'s' * (judged != 1)}, {outside_text}",
        fontsize=9,
    )
    figure.legend(
        handles=handles, loc="upper right", ncols=len(handles), fontsize=7, frameon=False, borderaxespad=0.1,
        bbox_to_anchor=(0.99, 1 - 0.24 / total),
    )  # fmt: skip
    return figure


def _over(name: str) -> Any:
    from matplotlib import colormaps

    return colormaps[name].with_extremes(over=VIOLATED, bad="#FFFFFF")


def _count(number: int) -> str:
    """12 345."""
    return f"{number:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def _length(names: Sequence[str], crowd: int) -> float:
    """Room for the longest of these, inches; less where there are many and they are written smaller."""
    return (0.06 if crowd <= _MANY else 0.048) * max(map(len, names), default=0) + 0.15
