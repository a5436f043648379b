# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Pieces that figures share: colours, names, numbers, legends, and the elements of a model as columns."""

from __future__ import annotations

import io
import itertools
import math
import warnings
from types import MethodType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.reports.tables import shortened

ENVELOPE, RECORDED, VIOLATED, ALARM, NO_VERDICT = "#56B4E9", "#000000", "#D55E00", "#F0E442", "#999999"
"""Distinguished by colour-blind people (Okabe and Ito 2008)."""

WIDTH = 10.0
"""Of a figure, inches."""

LONGEST_NAME = 34
"""Letters of a name that are drawn."""


def new_figure(width: float, height: float) -> Any:
    """An empty figure that no window shows."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    # A notebook that has no matplotlib backend asks the object itself.
    figure._repr_png_ = MethodType(_png, figure)  # type: ignore[attr-defined]
    return figure


def _png(figure: Any) -> bytes:
    """The figure as a notebook shows it."""
    stream = io.BytesIO()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # names may be in any script
        figure.savefig(stream, format="png", dpi=110)
    return stream.getvalue()


def between_rows(figure: Any, image: NDArray[np.uint8]) -> list[int]:
    """Where an image of a figure can be cut between two rows of its panels.

    `image` (height, width, 3): its pixels.
    """
    spans = sorted((axis.get_position().y0, axis.get_position().y1) for axis in figure.axes)
    joined: list[tuple[float, float]] = []
    for low, high in spans:
        if joined and low <= joined[-1][1]:
            joined[-1] = joined[-1][0], max(joined[-1][1], high)
        else:
            joined.append((low, high))
    blank = (image == 255).all(axis=(1, 2))
    cuts = []
    for (_, below), (above, _) in reversed(list(itertools.pairwise(joined))):
        begin, end = (math.ceil(len(image) * (1 - y)) for y in (above, below))
        edges = np.flatnonzero(np.diff(np.concatenate([[False], blank[begin:end], [False]]).astype(np.int8)))
        stripes = edges.reshape(-1, 2)
        if len(stripes):
            first, stop = stripes[np.diff(stripes, axis=1)[:, 0].argmax()]
            cuts.append(begin + int(first + stop) // 2)
    return cuts


def elements(model: UncertainLTI) -> tuple[Array, Array, list[str]]:
    """Elements of A and B side by side, with what the model has of drift and noise.

    Returns (n, columns): nominal elements and half-widths.
    """
    nominal, half = [model.A, model.B], [model.dA, model.dB]
    columns = [short(name) for name in (*model.state_names, *model.control_names)]
    for term, centre, width in model.additive():
        if centre.any() or width.any():
            nominal.append(centre[..., None])
            half.append(width[..., None])
            columns.append(f"{term.nominal or term.half} ({term.word})")
    return np.concatenate(nominal, axis=-1), np.concatenate(half, axis=-1), columns


def brief(value: float) -> str:
    """A number in few letters."""
    if 1e-3 <= abs(value) < 1e4:
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    return f"{value:.0e}".replace("e-0", "e-").replace("e+0", "e")


def patch(colour: str, alpha: float, label: str) -> Any:
    """Entry of a legend for an area."""
    from matplotlib.patches import Patch

    return Patch(facecolor=colour, alpha=alpha, label=label, edgecolor="#999999", linewidth=0.3)


def line(colour: Any, label: str, marker: str = "", edge: str | None = None) -> Any:
    """Entry of a legend for a line, or for a mark."""
    from matplotlib.lines import Line2D

    width = 0 if marker else 1
    return Line2D([], [], color=colour, label=label, marker=marker, markersize=4, linewidth=width, mec=edge or colour)


def no_ticks() -> Any:
    """No ticks on an axis."""
    from matplotlib.ticker import NullLocator

    return NullLocator()


def plain(text: str) -> str:
    """Text of a file, which is never a formula and never a line break."""
    return " ".join(text.split()).replace("$", r"\$")


def short(text: str, longest: int = LONGEST_NAME) -> str:
    """A name of a file, with its middle left out where it is long."""
    return plain(shortened(" ".join(text.split()), longest))
