"""What each element of a model adds to the width of its bounds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import ModelError
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.sampling.transient import Transient


def width_budget(model: UncertainLTI, transients: Sequence[Transient]) -> tuple[Array, Array, list[str]]:
    """Which element contributes how much of the mean one-step width.

    Columns are states, controls, and what the model has of drift and noise.

    Parameters
    ----------
    model : UncertainLTI
        The model.
    transients : sequence of Transient
        In recorded units, with the model's signals.

    Returns
    -------
    array (n, columns)
        Share of each column; a row of zeros where the width is 0.
    array (n,)
        Mean width, recorded units.
    list of str
        Names of the columns.

    Raises
    ------
    ModelError
        No recording has a usable transition.
    """
    point = model.operating_point
    additive = [(term, half) for term, _, half in model.additive()]
    total, count = np.zeros(model.n + model.m + len(additive)), 0
    for transient in transients:
        steps = transient.transitions()
        if not len(steps.k):
            continue
        count += len(steps.k)
        z = np.abs(np.hstack([point.normalise_x(steps.x), point.normalise_u(steps.u)]))
        total += [*(steps.dt @ z), *(steps.dt.sum() if term.times_dt else len(steps.k) for term, _ in additive)]
    if not count:
        raise ModelError("no recording has a usable transition, so there is no width to share out")
    parts = 2.0 * np.hstack([model.dA, model.dB, *(half[:, None] for _, half in additive)]) * (total / count)
    columns = [*model.state_names, *model.control_names]
    kept = list(range(model.n + model.m))
    for place, (term, half) in enumerate(additive, start=len(kept)):
        if half.any():
            kept.append(place)
            columns.append(term.word)
    width = parts.sum(axis=1)
    shares = np.divide(parts, width[:, None], out=np.zeros_like(parts), where=width[:, None] > 0)
    return shares[:, kept], width * point.X, columns
