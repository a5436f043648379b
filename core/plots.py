"""Figures of what was fitted and what was judged."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.errors import ModelError
from uncertain_lti.model import UncertainLTI
from uncertain_lti.monitor import Verdicts

# colour-blind safe (Okabe and Ito 2008)
ENVELOPE, RECORDED, VIOLATED, ALARM = "#56B4E9", "#000000", "#D55E00", "#E69F00"


def envelope_figure(
    model: UncertainLTI,
    verdicts: Verdicts,
    path: str | os.PathLike[str],
    states: Sequence[str] | None = None,
    event: tuple[float, str] | None = None,
    span: tuple[float, float] | None = None,
) -> None:
    """Each state between its one-step bounds over time, in recorded units, violations marked, gaps left open.

    Parameters
    ----------
    model : UncertainLTI
    verdicts : Verdicts
        Of `EnvelopeMonitor.check`.
    path : path
        Image file to write; its ending says the format.
    states : sequence of str, optional
        Names of the states to show; default all.
    event : (float, str), optional
        Time in s and label of an instant to mark.
    span : (float, float), optional
        Show only this time, s.

    Raises
    ------
    ModelError
        A name is not a state of the model.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    names = list(model.state_names if states is None else states)
    for name in names:
        if name not in model.state_names:
            raise ModelError(f"there is no state '{name}' to draw; states are {', '.join(model.state_names)}")
    t = verdicts.transient.t
    figure = Figure(figsize=(11, 1.2 + 2.6 * len(names)), layout="constrained")
    FigureCanvasAgg(figure)
    axes: Any = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    broken = np.flatnonzero(np.diff(verdicts.transient.segment) > 0) + 1
    for axis, name in zip(axes, names, strict=True):
        i = model.state_names.index(name)
        lower, upper = verdicts.lower[:, i], verdicts.upper[:, i]
        axis.fill_between(t, lower, upper, color=ENVELOPE, alpha=0.55, linewidth=0.4, label="one-step bounds")
        axis.plot(*_broken(t, verdicts.transient.x[:, i], broken), color=RECORDED, linewidth=0.9, label="recorded")
        bad = verdicts.flags[:, i] == 1.0
        if bad.any():
            axis.plot(
                t[bad],
                verdicts.transient.x[bad, i],
                linestyle="none",
                marker="o",
                markersize=3.5,
                color=VIOLATED,
                label=f"violated ({int(bad.sum())})",
            )
        _shade(axis, t, verdicts.alarm)
        if event is not None:
            axis.axvline(event[0], color=RECORDED, linestyle="--", linewidth=1.0)
        unit = model.signals.states[i].unit
        axis.set_ylabel(name.replace("_", " ") + (f" [{unit}]" if unit else ""))
        axis.margins(x=0.01)
        if span is not None:
            shown = (t >= span[0]) & (t <= span[1])
            values = np.concatenate([lower[shown], upper[shown], verdicts.transient.x[shown, i]])
            low, high = np.nanmin(values), np.nanmax(values)
            axis.set_xlim(*span)
            axis.set_ylim(low - 0.08 * (high - low), high + 0.25 * (high - low))
        axis.grid(alpha=0.25)
        axis.legend(loc="upper left", fontsize="small", ncols=4)
    if event is not None:
        axes[0].annotate(
            event[1], (event[0], 1.0), xycoords=("data", "axes fraction"), xytext=(4, 4), textcoords="offset points"
        )
    axes[-1].set_xlabel("time [s]")
    judged = int(verdicts.judged.sum())
    inside = 1.0 - verdicts.violated.sum() / judged if judged else float("nan")
    figure.suptitle(f"{os.path.basename(verdicts.transient.name)}: {judged} verdicts, {inside:.2%} inside all bounds")
    figure.savefig(path, dpi=120)


def _broken(t: NDArray[Any], values: NDArray[Any], at: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """The same line with a hole before each of the positions `at`."""
    return np.insert(t, at, np.nan), np.insert(values, at, np.nan)


def _shade(axis: Any, t: NDArray[Any], alarm: NDArray[np.bool_]) -> None:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], alarm, [False]]).astype(np.int8))).reshape(-1, 2)
    for number, (start, stop) in enumerate(edges):
        axis.axvspan(
            t[start],
            t[min(stop, len(t) - 1)],
            color=ALARM,
            alpha=0.25,
            linewidth=0,
            label="alarm" if not number else None,
        )
