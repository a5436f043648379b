# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Figures of scheduled models: elements over the schedule, and what each regime rests on.

Each function returns a matplotlib Figure; `figures.save` writes it. Regimes that no recording visited are grey.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import ModelError
from uncertain_lti.model.schedule import Axis, Schedule
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.reports.drawing import (
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
from uncertain_lti.reports.regimes import block_facts

_PANELS = 72  # elements that get a panel each
_COLUMNS = 12  # of panels
_LINES = 6  # values of the second scheduling signal that get a line each
_ROWS = 48  # elements in a heat map
_LABELS = 26  # blocks whose names are written below a figure
_MAPS = 10  # states with a heat map each
_NUMBERS = 13  # blocks whose numbers are written into the cells of a heat map


def elements_figure(model: UncertainLTI) -> Any:
    """Elements of A and B, drift and noise over the schedule, with their half-widths as bands.

    A panel per element: over knots a line and its band, of modes a bar each, with two scheduling signals a line per
    value of the other one. Where this would be too many, heat maps with a row per element and a column per block, of
    the elements whose intervals reach farthest.

    Parameters
    ----------
    model : UncertainLTI
        With a schedule.

    Returns
    -------
    matplotlib.figure.Figure
        Not written yet; see `figures.save`.

    Raises
    ------
    ModelError
        The model has no schedule.
    """
    schedule = _schedule(model)
    nominal, half, columns = elements(model)
    across, other = _across(schedule)
    lines = 1 if other is None else len(schedule.axes[other])
    too_many = model.n * len(columns) > _PANELS or len(columns) > _COLUMNS or lines > _LINES
    if too_many or not (schedule.axes[across].knots or len(schedule.axes) == 1):
        return _elements_map(model, nominal, half, columns)
    return _elements_panels(model, nominal, half, columns, across, other)


def regimes_figure(model: UncertainLTI) -> Any:
    """What each regime rests on: transitions of the fit, mean one-step widths, and time constants.

    One scheduling signal has its blocks side by side; two have a heat map each, small multiples of one grid.

    Parameters
    ----------
    model : UncertainLTI
        With a schedule. Widths are drawn if its fit states them for each block.

    Returns
    -------
    matplotlib.figure.Figure
        Not written yet; see `figures.save`.

    Raises
    ------
    ModelError
        The model has no schedule.
    """
    schedule = _schedule(model)
    return _regimes_grid(model, schedule) if len(schedule.axes) == 2 else _regimes_row(model, schedule)


# --- elements ----------------------------------------------------------------------------------------------------


def _schedule(model: UncertainLTI) -> Schedule:
    if model.schedule is None:
        raise ModelError("the model has no schedule, so there are no regimes to draw; draw its matrices")
    return model.schedule


def _across(schedule: Schedule) -> tuple[int, int | None]:
    """The axis that panels are drawn over, knots before modes and the longer one, and the other one."""
    if len(schedule.axes) == 1:
        return 0, None
    order = sorted((0, 1), key=lambda k: (not schedule.axes[k].knots, -len(schedule.axes[k])))
    return order[0], order[1]


def _values(model: UncertainLTI, k: int) -> Array:
    """Knots or modes of one axis in recorded units."""
    return _schedule(model).recorded_values(model.signals.signals)[k]


def _axis_name(model: UncertainLTI, k: int) -> str:
    unit = model.signals.signals[model.scheduling_positions[k]].unit
    return short(_schedule(model).axes[k].signal) + (f" [{plain(unit)}]" if unit else "")


def _elements_panels(
    model: UncertainLTI, nominal: Array, half: Array, columns: Sequence[str], across: int, other: int | None
) -> Any:
    from matplotlib import colormaps

    schedule = _schedule(model)
    axis_of, places = schedule.axes[across], _values(model, across)
    rows, count = [short(name, 24) for name in model.state_names], len(columns)
    label, gap_x, gap_y, bottom = 0.35, 0.42, 0.14, 0.72
    width = max(0.62, min(1.7, (WIDTH - label - 0.1) / count - gap_x))
    titles = [_wrapped(column, width) for column in columns]
    top = 0.62 + 0.125 * max(title.count("\n") + 1 for title in titles)
    height = 0.95 if len(rows) > 2 else 1.3
    total_w = max(label + count * (width + gap_x) + 0.1, 5.0)
    total_h = top + bottom + len(rows) * (height + gap_y)
    figure = new_figure(total_w, total_h)
    of_other = [0] if other is None else range(len(schedule.axes[other]))
    colours = [ENVELOPE] if other is None else [colormaps["viridis"](v) for v in np.linspace(0.0, 0.85, len(of_other))]
    blocks = [[r for r, index in enumerate(schedule.indices) if other is None or index[other] == k] for k in of_other]
    for i, name in enumerate(rows):
        for j in range(count):
            x = label + gap_x + j * (width + gap_x)
            y = bottom + (len(rows) - 1 - i) * (height + gap_y)
            axis = figure.add_axes((x / total_w, y / total_h, width / total_w, height / total_h))
            for at, colour in zip(blocks, colours, strict=True):
                _draw(axis, axis_of, places, nominal[at, i, j], half[at, i, j], colour, other is not None)
                hollow = [k for k, r in enumerate(at) if not model.block_data[r].known]
                _mark_unknown(axis, axis_of, places, hollow, VIOLATED if other is None else colour)
            low, high = (nominal - half)[:, i, j].min(), (nominal + half)[:, i, j].max()
            low, high = min(float(low), 0.0), max(float(high), 0.0)
            room = 0.08 * (high - low) or 1.0
            axis.set_ylim(low - room, high + room)
            axis.axhline(0.0, color=NO_VERDICT, linewidth=0.5, zorder=0)
            axis.spines[["top", "right"]].set_visible(False)
            axis.tick_params(labelsize=6, length=2, pad=1)
            axis.yaxis.set_major_locator(_few_ticks())
            axis.yaxis.set_major_formatter(lambda value, _: brief(value) if value else "0")
            _ticks_of(axis, axis_of, places, width, i == len(rows) - 1)
            if i == 0:
                axis.set_title(titles[j], fontsize=7, pad=3)
            if j == 0:
                axis.set_ylabel(_wrapped(name, height), fontsize=7)
            if i == len(rows) - 1 and j == 0:
                axis.set_xlabel(_axis_name(model, across), fontsize=7, loc="left")
    figure.text(0.1 / total_w, 1 - 0.22 / total_h, f"normalised elements [1/s] {_heading(model)}", fontsize=9)
    if other is None:
        handles = [line(RECORDED, "nominal element"), patch(ENVELOPE, 0.55, "± half-width")]
    else:
        name = short(schedule.axes[other].signal, 24)
        handles = [
            line(colour, f"{name} = {_value(value)}")
            for colour, value in zip(colours, _values(model, other).tolist(), strict=True)
        ]
        handles.append(patch(NO_VERDICT, 0.4, "± half-width"))
    if not all(data.known for data in model.block_data):
        edge = VIOLATED if other is None else RECORDED
        handles.append(line("#FFFFFF", "no recording visited it", "o", edge=edge))
    abreast = min(len(handles), max(4, int(total_w / 1.3)))
    figure.legend(
        handles=handles, loc="upper left", ncols=abreast, fontsize=7, frameon=False,
        bbox_to_anchor=(0.0, 1 - 0.26 / total_h), borderaxespad=0.1,
    )  # fmt: skip
    return figure


def _draw(axis: Any, over: Axis, places: Array, nominal: Array, half: Array, colour: Any, several: bool) -> None:
    """One element over knots, or of each mode."""
    if over.knots:
        axis.fill_between(places, nominal - half, nominal + half, color=colour, alpha=0.25 if several else 0.5, lw=0)
        marker = "o" if len(places) <= 30 else None
        axis.plot(places, nominal, color=colour if several else RECORDED, linewidth=1.0, marker=marker, markersize=1.8)
        return
    k = np.arange(len(places))
    axis.bar(k, 2 * half, bottom=nominal - half, width=0.7, color=ENVELOPE, alpha=0.55)
    axis.hlines(nominal, k - 0.35, k + 0.35, color=RECORDED, linewidth=1.0)


def _mark_unknown(axis: Any, over: Axis, places: Array, which: Sequence[int], colour: Any) -> None:
    """At the foot of a panel: knots or modes that no recording visited, in the colour of their line."""
    if which:
        x = places[list(which)] if over.knots else np.array(which, dtype=np.float64)
        axis.plot(
            x, np.zeros(len(x)), "o", markersize=2.5, markerfacecolor="w", markeredgecolor=colour,
            markeredgewidth=0.7, transform=axis.get_xaxis_transform(), clip_on=False, zorder=4,
        )  # fmt: skip


def _ticks_of(axis: Any, over: Axis, places: Array, width: float, named: bool) -> None:
    """Ends and middle of the knots, or the modes, below the last row only."""
    if over.knots:
        room = 0.06 * float(places[-1] - places[0])
        axis.set_xlim(places[0] - room, places[-1] + room)
        ends = [float(places[0]), float(places[-1])]
        axis.set_xticks(ends, [_value(value) for value in ends] if named else ["", ""])
        axis.set_xticks(places if len(places) <= _LABELS else [], minor=True)
        axis.tick_params(axis="x", which="minor", length=1.5)
        if named:
            first, last = axis.get_xticklabels()
            first.set_ha("left")
            last.set_ha("right")
            if width < 0.9:
                for text in (first, last):
                    text.set_rotation(90)
                    text.set_ha("center")
        return
    step = max(1, math.ceil(len(places) * 0.13 / width))
    shown = range(0, len(places), step)
    axis.set_xlim(-0.6, len(places) - 0.4)
    axis.set_xticks(list(shown), [_value(places[k]) if named else "" for k in shown], rotation=90)


def _elements_map(model: UncertainLTI, nominal: Array, half: Array, columns: Sequence[str]) -> Any:
    """Heat maps of nominal elements and half-widths, a row per element and a column per block."""
    from matplotlib.colors import LogNorm, SymLogNorm

    count = len(nominal)
    flat = [a.reshape(count, -1).T for a in (nominal, half)]
    reach = (np.abs(flat[0]) + flat[1]).max(axis=1)
    kept = np.sort(np.argsort(-reach, kind="stable")[:_ROWS])
    kept = kept[reach[kept] > 0] if reach.any() else kept
    names = [f"{short(model.state_names[e // len(columns)], 20)} ← {columns[e % len(columns)][:20]}" for e in kept]
    labels = _block_labels(model)
    crowded = len(labels) > _LABELS
    label, below = 0.052 * max(map(len, names)) + 0.15, 0.85 if crowded else 0.055 * max(map(len, labels)) + 0.2
    cell = min(0.42, 4.2 / count)
    width, height = max(cell * count, 1.4), max(0.135 * len(kept), 1.0)
    total_w, total_h = label + 2 * width + 1.7, height + below + 0.75
    figure = new_figure(total_w, total_h)
    greatest = float(np.abs(flat[0][kept]).max(initial=0.0)) or 1.0
    widest = float(flat[1][kept].max(initial=0.0)) or 1.0
    maps = (
        ("nominal [1/s]", flat[0][kept], "PuOr", SymLogNorm(greatest * 1e-3, 0.5, -greatest, greatest)),
        (
            "half-widths [1/s]",
            np.where(flat[1][kept] == 0, np.nan, flat[1][kept]),
            "Blues",
            LogNorm(widest * 1e-4, widest),
        ),
    )
    for k, (title, values, colours, norm) in enumerate(maps):
        x = label + k * (width + 0.85)
        axis = figure.add_axes((x / total_w, below / total_h, width / total_w, height / total_h))
        image = axis.imshow(values, cmap=colours, norm=norm, aspect="auto", interpolation="nearest")
        bar = figure.add_axes(((x + width + 0.08) / total_w, below / total_h, 0.12 / total_w, height / total_h))
        figure.colorbar(image, cax=bar)
        bar.tick_params(labelsize=6)
        bar.yaxis.set_minor_locator(no_ticks())
        if not k:
            inner = greatest * 10**-1.5
            ticks = [-greatest, -inner, 0.0, inner, greatest]
            bar.set_yticks(ticks, [brief(tick) if tick else "0" for tick in ticks])
        axis.set_title(title, loc="left", fontsize=8)
        axis.set_yticks(range(len(names)), [] if k else names, fontsize=6)
        axis.tick_params(length=2)
        _name_blocks(axis, model, labels)
    of = f"{len(kept)} of {flat[0].shape[0]} elements, those that reach farthest. " if len(kept) < len(flat[0]) else ""
    figure.text(0.1 / total_w, 1 - 0.22 / total_h, f"{of}{_heading(model)}", fontsize=8)
    return figure


# --- regimes -----------------------------------------------------------------------------------------------------


def _block_labels(model: UncertainLTI) -> list[str]:
    """Values of the scheduling signals of each block."""
    values = _schedule(model).recorded_values(model.signals.signals)
    return [", ".join(_value(values[k][place]) for k, place in enumerate(index)) for index in _schedule(model).indices]


def _name_blocks(axis: Any, model: UncertainLTI, labels: Sequence[str]) -> None:
    """Names of the blocks below a figure with a column each, a part of them where there are many."""
    schedule = _schedule(model)
    step = max(1, math.ceil(len(labels) / _LABELS))
    if step > 1 and len(schedule.axes) == 2:
        step = len(schedule.axes[1]) * math.ceil(len(schedule.axes[0]) / _LABELS)
    shown = list(range(0, len(labels), step))
    names = [labels[r] for r in shown]
    if step > 1 and len(schedule.axes) == 2:
        names = [name.partition(",")[0] + ", …" for name in names]
    axis.set_xticks(shown, names, rotation=90, fontsize=6.5)
    axis.set_xlim(-0.5, len(labels) - 0.5)
    axis.set_xlabel(", ".join(_axis_name(model, k) for k in range(len(schedule.axes))), fontsize=7)
    if len(schedule.axes) == 2:
        for k in range(1, len(schedule.axes[0])):
            axis.axvline(k * len(schedule.axes[1]) - 0.5, color=RECORDED, linewidth=0.5)


def _widths(model: UncertainLTI) -> Array | None:
    """Mean widths when fitted, recorded units, (R, n); NaN where a block has none, None if the file says nothing."""
    rows = [block["mean_width"] for block in block_facts(model)]
    if not any(rows):
        return None
    return np.array([[math.nan] * model.n if row is None else row for row in rows])


def _regimes_row(model: UncertainLTI, schedule: Schedule) -> Any:
    """One scheduling signal: bars of data, a heat map of widths, dots of time constants, one above the other."""
    blocks, labels, widths = block_facts(model), _block_labels(model), _widths(model)
    names = [
        short(s.name, 26) + (f" [{plain(s.unit)}]" if s.unit else "") for s in model.signals.states
    ]  # the longest decides the margin
    left = 0.06 * max(map(len, names)) + 0.25 if widths is not None else 0.95
    width = min(WIDTH - left - 0.3, max(0.62 * len(labels), 4.6))
    below = 0.055 * max(map(len, labels)) + 0.45
    of_widths = 0.0 if widths is None else max(0.24 * model.n, 0.5)
    heights = [1.1, of_widths, 1.35]
    gaps = 0.42
    total_h = 0.45 + below + sum(heights) + gaps * sum(1 for h in heights if h)
    total_w = max(left + width + 0.3, 6.4)
    figure = new_figure(total_w, total_h)
    y = total_h - 0.45
    k = np.arange(len(blocks))
    axes: list[Any] = []
    for height in heights:
        if height:
            y -= height + gaps
            box = (left / total_w, (y + 0.12) / total_h, width / total_w, height / total_h)
            axes.append(figure.add_axes(box, sharex=axes[0] if axes else None))
    _bars(axes[0], model, k)
    if widths is not None:
        _width_map(axes[1], widths, names)
    _constants(axes[-1], blocks)
    for axis in axes[:-1]:
        axis.tick_params(labelbottom=False)
    _name_blocks(axes[-1], model, labels)
    figure.text(0.1 / total_w, 1 - 0.25 / total_h, _heading(model), fontsize=9)
    return figure


def _bars(axis: Any, model: UncertainLTI, k: Any) -> None:
    """Transitions of each block; of those without, and of those that share elements, a word."""
    data = model.block_data
    counts = np.array([d.transitions or 0 for d in data], dtype=np.float64)
    colours = [NO_VERDICT if d.tied_to is not None else ENVELOPE for d in data]
    axis.bar(k, counts, color=colours, width=0.8)
    top = max(float(counts.max()), 1.0)
    axis.set_ylim(0, 1.28 * top)
    if len(data) <= _LABELS:
        for r, d in enumerate(data):
            text = "?" if d.transitions is None else "none" if not d.known else f"{d.transitions}"
            axis.text(
                r, counts[r] + 0.03 * top, text, ha="center", va="bottom", fontsize=6.5,
                color=RECORDED if d.known else VIOLATED,
            )  # fmt: skip
    else:
        unknown = [r for r, d in enumerate(data) if not d.known]
        axis.plot(unknown, np.zeros(len(unknown)), "^", color=VIOLATED, markersize=3, clip_on=False)
    shared = any(d.tied_to is not None for d in data)
    note = "; grey: shares the elements of another" if shared else ""
    axis.set_title(f"transitions of the fit{note}", loc="left", fontsize=8)
    axis.spines[["top", "right"]].set_visible(False)
    axis.tick_params(labelsize=6.5, length=2)
    axis.yaxis.set_major_locator(_few_ticks())


def _compared(widths: Array) -> Array:
    """Widths (R, n) as multiples of the median over the regimes, base 2; 0 where a state has no width."""
    there = np.where(np.isfinite(widths) & (widths > 0), widths, np.nan)
    if np.isnan(there).all():
        return np.zeros_like(widths)
    with np.errstate(invalid="ignore"):
        middle = np.array([np.nanmedian(column) if np.isfinite(column).any() else 1.0 for column in there.T])
        return np.where(widths == 0, 0.0, np.log2(there / middle))


def _width_map(axis: Any, widths: Array, names: Sequence[str]) -> None:
    """Mean widths, a row per state; the colour compares the regimes of one state."""
    shown = _compared(widths).T
    most = max(float(np.nanmax(np.abs(shown), initial=0.0)), 1.0)
    axis.imshow(shown, cmap=_grey_where_none("PuOr_r"), vmin=-most, vmax=most, aspect="auto", interpolation="nearest")
    axis.set_yticks(range(len(names)), names, fontsize=6.5)
    axis.tick_params(length=2)
    title = "mean width when fitted; orange: above those of most regimes, violet: below"
    axis.set_title(title, loc="left", fontsize=8)
    if len(widths) <= _NUMBERS:
        for (i, r), share in np.ndenumerate(shown):
            text = "–" if math.isnan(share) else brief(float(widths[r, i]))
            axis.text(r, i, text, ha="center", va="center", fontsize=6, color="w" if abs(share) > 0.7 * most else "k")


def _constants(axis: Any, blocks: Sequence[dict[str, Any]]) -> None:
    """Time constants of the eigenvalues of each block on a logarithmic axis; what grows is marked at its edge."""
    decaying: list[tuple[int, float]] = []
    swinging: list[tuple[int, float]] = []
    growing: list[int] = []
    for r, block in enumerate(blocks):
        for constant, (_, imag) in zip(block["time_constants"], block["eigenvalues"], strict=True):
            if constant is None:
                growing.append(r)
            else:
                (swinging if imag else decaying).append((r, constant))
    for points, marker, text in ((decaying, "o", "real"), (swinging, "D", "of a pair (oscillates)")):
        if points:
            x, y = zip(*points, strict=True)
            axis.plot(x, y, marker, color=ENVELOPE if marker == "o" else RECORDED, markersize=3.5, label=text)
    if decaying or swinging:
        axis.set_yscale("log")
        low, high = axis.get_ylim()
        axis.set_ylim(low / 1.5, high * 1.5)
        axis.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axis.yaxis.set_minor_formatter(lambda value, _: f"{value:g}" if high < 9 * low else "")
    else:
        axis.set_yticks([])
    if growing:
        axis.plot(
            growing, np.ones(len(growing)), "^", color=VIOLATED, markersize=4, clip_on=False, label="does not decay",
            transform=axis.get_xaxis_transform(),
        )  # fmt: skip
    axis.set_title("time constants of A [s]", loc="left", fontsize=8)
    axis.legend(fontsize=6.5, frameon=False, loc="lower right", ncols=3, bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1)
    axis.grid(axis="y", alpha=0.3, linewidth=0.5)
    axis.tick_params(labelsize=6.5, length=2, which="both")
    axis.spines[["top", "right"]].set_visible(False)


def _regimes_grid(model: UncertainLTI, schedule: Schedule) -> Any:
    """Two scheduling signals: a heat map over both of each quantity."""
    blocks, widths = block_facts(model), _widths(model)
    shape = tuple(len(axis) for axis in schedule.axes)
    slowest = [math.nan if None in b["time_constants"] else max(b["time_constants"]) for b in blocks]
    counts = [math.nan if b["transitions"] is None else float(b["transitions"]) for b in blocks]
    maps = [
        ("transitions of the fit", np.array(counts), np.array(counts), "?"),
        ("slowest time constant [s]", np.array(slowest), np.array(slowest), "grows"),
    ]
    if widths is not None:
        compared = _compared(widths)
        for i, s in enumerate(model.signals.states[:_MAPS]):
            unit = f" [{plain(s.unit)}]" if s.unit else ""
            maps.append((f"width of {short(s.name, 30)}{unit}", compared[:, i], widths[:, i], "–"))
    columns = 2 if shape[0] > 8 else 3
    cell_w, cell_h = max(0.1, min(0.55, 2.7 / shape[0])), max(0.12, min(0.3, 2.4 / shape[1]))
    width, height = max(cell_w * shape[0], 3.6 if columns == 2 else 2.2), max(cell_h * shape[1], 0.75)
    ticks = [[_value(v) for v in _values(model, k)] for k in (0, 1)]
    lines = _wrapped(_axis_name(model, 1), height).count("\n") + 1
    left, below = 0.06 * max(map(len, ticks[1])) + 0.3 + 0.13 * lines, 0.06 * max(map(len, ticks[0])) + 0.4
    rows = math.ceil(len(maps) / columns)
    total_w, total_h = columns * (left + width + 0.25), rows * (below + height + 0.45) + 0.45
    figure = new_figure(total_w, total_h)
    for place, (title, colour, numbers, none) in enumerate(maps):
        row, column = divmod(place, columns)
        x = column * (left + width + 0.25) + left
        y = total_h - 0.45 - (row + 1) * (below + height + 0.45) + below + 0.1
        axis = figure.add_axes((x / total_w, y / total_h, width / total_w, height / total_h))
        grid, texts_of = colour.reshape(shape).T, numbers.reshape(shape).T
        top = max(float(np.nanmax(np.abs(grid), initial=0.0)), 1.0 if place > 1 else 1e-300)
        colours, least = ("PuOr_r", -top) if place > 1 else ("Blues", 0.0)
        axis.imshow(
            grid, cmap=_grey_where_none(colours), vmin=least, vmax=top, aspect="auto", origin="lower",
            interpolation="nearest",
        )  # fmt: skip
        axis.set_title(title, loc="left", fontsize=7.5)
        for k, (set_ticks, texts) in enumerate(((axis.set_xticks, ticks[0]), (axis.set_yticks, ticks[1]))):
            step = math.ceil(len(texts) / 16)
            set_ticks(range(0, len(texts), step), texts[::step], fontsize=6, rotation=0 if k else 90)
        axis.tick_params(length=2)
        axis.set_xlabel(_axis_name(model, 0), fontsize=6.5)
        axis.set_ylabel(_wrapped(_axis_name(model, 1), height), fontsize=6.5)
        if cell_w >= 0.32 and cell_h >= 0.14:
            for (j, i), value in np.ndenumerate(texts_of):
                dark = abs(float(grid[j, i])) > 0.7 * top
                text = none if math.isnan(value) else f"{value:.0f}" if not place else brief(float(value))
                axis.text(i, j, text, ha="center", va="center", fontsize=6, color="w" if dark else "k")
        for r, (i, j) in enumerate(schedule.indices):
            if not blocks[r]["known"]:
                axis.plot(i + 0.36, j + 0.3, ".", color=VIOLATED, markersize=3.5)
    note = "; dot: no recording visited it" if not all(b["known"] for b in blocks) else ""
    note += "; widths: orange above, violet below those of most regimes" if widths is not None else ""
    figure.text(0.1 / total_w, 1 - 0.25 / total_h, _heading(model) + note, fontsize=8)
    return figure


# --- pieces ------------------------------------------------------------------------------------------------------


def _value(value: float) -> str:
    """A knot or a mode below a figure."""
    text = f"{value:.5g}"
    return f"{value:.4g}" if "e" in text else text


def _heading(model: UncertainLTI) -> str:
    return plain(f"over {_schedule(model).words}")


def _wrapped(text: str, inches: float) -> str:
    """A long name in several lines, broken after underscores and blanks."""
    limit = max(8, int(inches / 0.055))
    lines = [""]
    for piece in text.replace("_", "_\x00").replace(" ", " \x00").split("\x00"):
        if lines[-1] and len(lines[-1]) + len(piece) > limit:
            lines.append("")
        lines[-1] += piece
    return "\n".join(lines)


def _few_ticks() -> Any:
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(3)


def _grey_where_none(colours: str) -> Any:
    from matplotlib import colormaps

    return colormaps[colours].with_extremes(bad="#DDDDDD")
