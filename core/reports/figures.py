# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Figures of what was fitted and what was judged, as images.

Each function returns a matplotlib Figure; `save` writes it, Jupyter shows it. Colours are distinguished by colour-blind
people as well (Okabe and Ito 2008; Blues, PuOr).
"""

from __future__ import annotations

import io
import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from types import MethodType
from typing import IO, Any

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import ModelError, refuse_other
from uncertain_lti.base.files import written
from uncertain_lti.base.text import printable, shortened
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.verdict import Verdicts
from uncertain_lti.reports import charts
from uncertain_lti.reports.charts import FEW, Chart, Columns, Map, Panel

ENVELOPE, RECORDED, VIOLATED, ALARM, NO_VERDICT = "#56B4E9", "#000000", "#D55E00", "#F0E442", "#999999"
_WIDTH = 10.0  # of a figure, inches
_LOOKS = {
    "bounds": (ENVELOPE, 0.45), "recorded": (RECORDED, 1.0), "utilisation": (RECORDED, 1.0), "score": (RECORDED, 0.8),
    "violated": (VIOLATED, 1.0), "alarm": (ALARM, 0.45), "silent": (NO_VERDICT, 0.35), "full": ("#08306B", 1.0),
}  # fmt: skip
_MOST_ROWS = 48  # elements in a heat map
_NUMBERS = 250  # cells whose numbers are written
_ROUNDED = 1e-9  # share of the largest half-width that is rounding


def alarm_figure(
    model: UncertainLTI,
    verdicts: Verdicts,
    span: tuple[float, float] | None = None,
    event: tuple[float, str] | None = None,
    most: int = 6,
) -> Any:
    """What happened and when: the alarm's score over its threshold, then the states that did it as utilisation.

    Parameters
    ----------
    model : UncertainLTI
        The model checked with.
    verdicts : Verdicts
        Of `EnvelopeMonitor.check`.
    span : (float, float), optional
        Show only this time, s.
    event : (float, str), optional
        A time to mark, s, and what happened then.
    most : int, default 6
        States drawn at most.

    Returns
    -------
    matplotlib.figure.Figure
        Not written yet; see `save`.
    """
    columns, _ = _chosen(model, verdicts, None, span)
    return _drawn(charts.alarm_chart(model, verdicts, columns, most), event)


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
    return _drawn(charts.envelope_chart(model, verdicts, *_chosen(model, verdicts, states, span)), event)


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
    columns, chosen = _chosen(model, verdicts, states, span)
    make = charts.utilisation_map if len(chosen) > FEW else charts.utilisation_chart
    return _drawn(make(model, verdicts, columns, chosen))


def horizon_figure(
    model: UncertainLTI,
    verdicts: Verdicts,
    states: Sequence[str] | None = None,
    span: tuple[float, float] | None = None,
) -> Any:
    """The greatest |utilisation| in each stretch of time, one map per state with a row per number of steps.

    What is fast shows in the first row, what is slow in the last.

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
        Not written yet; see `save`.

    Raises
    ------
    ModelError
        A name is not a state of the model.
    """
    return _drawn(charts.horizon_chart(model, verdicts, *_chosen(model, verdicts, states, span)))


def matrices_figure(model: UncertainLTI) -> Any:
    """A and B with their half-widths ΔA and ΔB as heat maps with names, in 1/s of normalised quantities.

    A dot marks an element whose half-width is greater than itself: its sign is not known. Columns c (disturbance) and
    v (noise, not multiplied by Δt) appear where the model has them. A scheduled model has a row per element, of those
    whose intervals reach farthest, and a column per block.

    Parameters
    ----------
    model : UncertainLTI
        The model.

    Returns
    -------
    matplotlib.figure.Figure
        Not written yet; see `save`.
    """
    refuse_other(model, UncertainLTI, "model", "give a model", ModelError)
    nominal, half, columns = _elements(model)
    rows, note = [_short(name) for name in model.state_names], ""
    parted: Sequence[int] = (model.n, model.n + model.m)
    if model.schedule is not None:
        nominal, half = (a.reshape(len(a), -1).T for a in (nominal, half))
        reach = (np.abs(nominal) + half).max(axis=1)
        kept = np.sort(np.argsort(-reach, kind="stable")[:_MOST_ROWS])
        rows = [f"{_short(model.state_names[e // len(columns)], 20)} ← {columns[e % len(columns)]}" for e in kept]
        note = f"{len(kept)} of {len(nominal)} elements. " if len(kept) < len(nominal) else ""
        nominal, half, parted = nominal[kept], half[kept], ()
        columns = [_short(model.block_name(r)) for r in range(nominal.shape[1])]
    doubtful = half > np.abs(nominal)
    doubtful[:, parted[-1] if parted else len(columns) :] = False
    grids = [
        _Grid("A | B, nominal elements [1/s]", rows, columns, nominal, "signed", parted, doubtful),
        _Grid("ΔA | ΔB, half-widths [1/s]", rows, columns, half, "width", parted),
    ]
    return _heat_maps(grids, f"{note}dot: the half-width is greater than the element; blank: zero, or as good as")


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
    bad = np.array([[v.violated.sum(), *(v.flags == 1.0).sum(axis=0)] for v in checked], dtype=np.float64)
    own = np.array([[v.judged.sum(), *(~np.isnan(v.flags)).sum(axis=0)] for v in checked], dtype=np.float64)
    shares = np.divide(100.0 * bad, own, out=np.full(bad.shape, np.nan), where=own > 0)
    rows = [f"{_short(charts.base_name(v.transient.name), 40)}  ({int(v.judged.sum())})" for v in checked]
    columns = ["any state", *(_short(name) for name in model.state_names)]
    title = "recording (verdicts), and the share of them that was violated [%]"
    return _heat_maps([_Grid(title, rows, columns, shares, "share", (1,))], "grey: no verdict")


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
        No image is written with such an ending, or the file cannot be written.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # names may be in any script
        if not isinstance(path, (str, os.PathLike)):
            figure.savefig(path, dpi=dpi)
            return
        kind = os.path.splitext(path)[1][1:] or "png"
        if kind not in figure.canvas.get_supported_filetypes():
            raise ModelError(f"{path}: no image is written as '{kind}'; end the name in .png, .svg or .pdf")
        with written(path, ModelError) as stream:
            figure.savefig(stream, dpi=dpi, format=kind)


# --- charts over time ------------------------------------------------------------------------------------------------


def _chosen(
    model: UncertainLTI, verdicts: Verdicts, states: Sequence[str] | None, span: tuple[float, float] | None
) -> tuple[Columns, list[int]]:
    """Columns of a recording, and positions of the states to draw."""
    refuse_other(model, UncertainLTI, "model", "give the model that the recording was checked with", ModelError)
    made = "give what EnvelopeMonitor(model).check(transient) returned"
    refuse_other(verdicts, Verdicts, "verdicts", made, ModelError)
    names = list(model.state_names if states is None else states)
    for name in names:
        if name not in model.state_names:
            raise ModelError(f"there is no state '{name}' to draw; states are {', '.join(model.state_names)}")
    return charts.columns_of(verdicts, span=span), [model.state_names.index(name) for name in names]


def _new_figure(width: float, height: float) -> Any:
    """An empty figure that no window shows."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)

    def png(self: Any) -> bytes:  # a notebook that has no matplotlib backend asks the object itself
        stream = io.BytesIO()
        save(self, stream)
        return stream.getvalue()

    figure._repr_png_ = MethodType(png, figure)  # type: ignore[attr-defined]
    return figure


def _drawn(chart: Chart, event: tuple[float, str] | None = None) -> Any:
    """The figure of a chart: its panels below each other."""
    heights = [max(0.17 * len(p.rows), 0.4) if isinstance(p, Map) else 1.2 for p in chart.panels]
    figure = _new_figure(_WIDTH, sum(heights) + 0.32 * len(heights) + 1.0)
    axes = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    for axis, panel in zip(axes, chart.panels, strict=True):
        if isinstance(panel, Map):
            _map(axis, panel, chart.columns)
        else:
            _panel(axis, panel, chart.columns)
        axis.set_title(_short(panel.heading, 60), loc="left", fontsize=8, pad=3)
        axis.set_title(_short(panel.note, 100), loc="right", fontsize=8, pad=3, color=VIOLATED if panel.count else "k")
        axis.tick_params(labelsize=7)
        if event is not None:
            axis.axvline(event[0], color=RECORDED, linestyle="--", linewidth=1.0)
    axes[-1].set_xlabel(chart.columns.label, fontsize=8)
    if event is not None:
        side = "right" if event[0] > sum(chart.columns.limits) / 2 else "left"
        place = axes[0].get_xaxis_transform()
        axes[0].text(event[0], 0.95, f" {_plain(event[1])} ", transform=place, va="top", ha=side, fontsize=8)
    figure.suptitle(_short(chart.heading, 110), fontsize=9, x=0.01, ha="left")
    keys = [_key(*key) for key in chart.keys]
    figure.legend(handles=keys, loc="outside lower left", ncols=len(keys), fontsize=7, frameon=False)
    return figure


def _key(role: str, words: str) -> Any:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    colour, alpha = _LOOKS[role]
    if role == "violated":
        return Line2D([], [], color=colour, label=words, marker="o", markersize=4, linewidth=0)
    return Patch(facecolor=colour, alpha=alpha, label=words, edgecolor=NO_VERDICT, linewidth=0.3)


def _panel(axis: Any, panel: Panel, columns: Columns) -> None:
    low, high = columns.limits
    least = (high - low) / (2 * charts.PIXELS)  # wide enough to be seen
    for spans, role in ((columns.alarms, "alarm"), (columns.silent, "silent")):
        wide = [(begin, max(end - begin, least)) for begin, end in spans]
        colour, alpha = _LOOKS[role]
        axis.broken_barh(wide, (0, 1), transform=axis.get_xaxis_transform(), color=colour, alpha=alpha, lw=0)
    axis.set_xlim(low - 0.01 * (high - low), high + 0.01 * (high - low))
    at = np.flatnonzero(columns.apart)
    t = np.insert(columns.t, at, np.nan)
    if len(panel.levels) == 2:
        axis.axhspan(*panel.levels, color=ENVELOPE, alpha=0.25, linewidth=0)
        axis.set_yticks([panel.levels[0], 0, panel.levels[1]])
    elif panel.levels:
        axis.axhline(panel.levels[0], color=VIOLATED, linewidth=0.8, linestyle="--")
    for series in panel.series:
        colour, alpha = _LOOKS[series.role]
        lower = np.insert(series.low, at, np.nan)
        if series.high is not None:
            axis.fill_between(t, lower, np.insert(series.high, at, np.nan), color=colour, alpha=alpha, linewidth=0.6)
        else:
            few = "." if len(columns.t) <= 200 and series.role == "recorded" else None
            axis.plot(t, lower, color=colour, linewidth=0.8, marker=few, markersize=3)
    axis.set_ylim(*panel.limits)
    if panel.marks is not None:
        there = np.flatnonzero(~np.isnan(panel.marks))
        values, size = np.clip(panel.marks[there], *panel.limits), 3.5 if len(there) <= 150 else 2.0
        (dots,) = axis.plot(columns.t[there], values, "o", color=VIOLATED, ms=size, mew=0, clip_on=False, zorder=3)
        dots.set_in_layout(False)
    axis.yaxis.set_major_formatter("{x:.6g}")
    axis.grid(alpha=0.25, linewidth=0.5)
    axis.spines[["top", "right"]].set_visible(False)


def _map(axis: Any, drawn: Map, columns: Columns) -> None:
    from matplotlib import colormaps
    from matplotlib.colors import to_rgb

    colours = colormaps["Blues"].with_extremes(over=VIOLATED, bad=(*to_rgb(NO_VERDICT), 0.35))
    edge = np.append(columns.edges[:, 0], columns.limits[1]) if len(columns.t) else np.array([0.0, 1.0])
    values = drawn.values if len(columns.t) else np.full((len(drawn.rows), 1), np.nan)
    rows = np.arange(len(drawn.rows) + 1)
    axis.pcolormesh(edge, rows, np.ma.masked_invalid(values), cmap=colours, vmin=0.0, vmax=1.0, rasterized=True)
    for begin, end in columns.alarms:
        axis.axvspan(begin, end, ymin=0.0, ymax=min(0.06, 0.5 / len(drawn.rows)), color=ALARM, linewidth=0)
    axis.set_yticks(rows[:-1] + 0.5, [_short(row) for row in drawn.rows])
    axis.set_ylim(len(drawn.rows), 0)


# --- heat maps -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Grid:
    """Named rows and columns of numbers; `kind` signed, width or share; lines before `parted`, dots where `marked`."""

    title: str
    rows: Sequence[str]
    columns: Sequence[str]
    values: Array
    kind: str
    parted: Sequence[int] = ()
    marked: Any = None


def _heat_maps(grids: Sequence[_Grid], note: str) -> Any:
    """Heat maps of the same size, one below the other."""
    rows, columns = grids[0].rows, grids[0].columns
    numbers = grids[0].values.size <= _NUMBERS
    size = 7 if max(len(rows), len(columns)) <= 30 else 5.5
    label, below = (0.0086 * size * max(map(len, names), default=0) + 0.2 for names in (rows, columns))
    width = (0.6 if numbers else min(0.4, 9.0 / len(columns))) * len(columns)
    height = max((0.32 if numbers else 0.18) * len(rows), 0.4)
    figure = _new_figure(max(label + width + 0.9, 4.6), len(grids) * (height + 0.55) + below + 0.3)
    axes = figure.subplots(len(grids), 1, sharex=True, squeeze=False)[:, 0]
    for axis, grid in zip(axes, grids, strict=True):
        shown = grid.values
        if grid.kind == "width":
            shown = np.where(shown <= _ROUNDED * np.nanmax(shown, initial=0.0), np.nan, shown)
        image = axis.imshow(shown, **_scale(grid.values, grid.kind), aspect="auto", interpolation="nearest")
        bar = figure.colorbar(image, ax=axis, fraction=0.04, pad=0.01)
        bar.minorticks_off()
        bar.ax.tick_params(labelsize=7)
        if grid.kind == "signed":
            ticks = [float(image.norm.vmax) * k for k in (-1, -(10**-1.5), 0, 10**-1.5, 1)]
            bar.set_ticks(ticks, labels=[_brief(tick) for tick in ticks])
        axis.set_title(grid.title, loc="left", fontsize=9)
        axis.set_yticks(range(len(rows)), rows, fontsize=size)
        for place in grid.parted:
            axis.axvline(place - 0.5, color=RECORDED, linewidth=0.8)
        for i, j in np.argwhere(np.isfinite(shown)) if numbers else ():
            red, green, blue, _ = image.cmap(image.norm(grid.values[i, j]))
            ink = "w" if 0.3 * red + 0.6 * green + 0.1 * blue < 0.5 else "k"
            if (value := float(grid.values[i, j])) or grid.kind == "share":
                axis.text(j, i, _brief(value), ha="center", va="center", fontsize=6.5, color=ink)
        if grid.marked is not None:
            i, j = grid.marked.nonzero()
            axis.plot(j + 0.36, i - 0.3, "o", color=VIOLATED, mec="w", mew=0.5, markersize=3.5 if numbers else 2)
        axis.set_xlim(-0.5, len(columns) - 0.5)
    some = range(0, len(columns), math.ceil(len(columns) * size / (72 * max(width, 0.6))))
    axes[-1].set_xticks(some, [columns[j] for j in some], rotation=90, fontsize=size)
    figure.supxlabel(_plain(note), fontsize=7, x=0.01, ha="left")
    return figure


def _scale(values: Array, kind: str) -> dict[str, Any]:
    from matplotlib import colormaps
    from matplotlib.colors import LogNorm, Normalize, SymLogNorm

    greatest = float(np.nanmax(np.abs(values), initial=0.0)) or 1.0
    if kind == "signed":
        return {"cmap": "PuOr", "norm": SymLogNorm(greatest * 1e-3, 0.5, -greatest, greatest)}
    if kind == "width":
        return {"cmap": "Blues", "norm": LogNorm(greatest * 1e-4, greatest)}
    return {"cmap": colormaps["Oranges"].with_extremes(bad="#DDDDDD"), "norm": Normalize(0.0, greatest)}


def _elements(model: UncertainLTI) -> tuple[Array, Array, list[str]]:
    """Nominal elements and half-widths side by side, (..., n, columns), with its disturbance and noise."""
    nominal, half = [model.A, model.B], [model.dA, model.dB]
    columns = [_short(name) for name in (*model.state_names, *model.control_names)]
    for term, centre, width in model.additive():
        if centre.any() or width.any():
            nominal.append(centre[..., None])
            half.append(width[..., None])
            columns.append(f"{term.nominal or term.half} ({term.word})")
    return np.concatenate(nominal, axis=-1), np.concatenate(half, axis=-1), columns


def _brief(value: float) -> str:
    """A number in few letters."""
    if not value or 1e-3 <= abs(value) < 1e4:
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    return f"{value:.0e}".replace("e-0", "e-").replace("e+0", "e")


def _plain(text: str) -> str:
    """Text of a file, which is never a formula and never a line break."""
    return printable(" ".join(text.split())).replace("$", r"\$")


def _short(text: str, longest: int = 34) -> str:
    """A name of a file, with its middle left out where it is long."""
    return _plain(shortened(" ".join(text.split()), longest))
