"""Containment repair: half-widths lifted until the verdict's own arithmetic finds no training sample outside."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import FitError
from uncertain_lti.identification.fleet import Fleet
from uncertain_lti.identification.passes import Judged, Moments
from uncertain_lti.model.uncertain_lti import UncertainLTI

_EPS = float(np.finfo(np.float64).eps)
_ROUNDS = 40


def repair(
    build: Callable[[Array, Array], UncertainLTI],
    fleet: Fleet,
    sums: Moments,
    theta: Array,
    d: Array,
    violation: Array,
) -> tuple[UncertainLTI, Array, Judged]:
    """Lift d until `Fleet.judge` finds nothing outside in any row.

    A solver leaves a violation of at most `violation` x (scaled size of the sample), and the size is linear in |z|,
    so lifting each element by violation x its unit covers it in every sample. What is left is rounding: a few ulps
    of |θ| + d for the products and sums and, for the state's own element, of 1 / Δt for the addition of x.

    Parameters
    ----------
    build : callable
        (theta (r, n), d (q, n)) -> UncertainLTI.
    fleet : Fleet
        The data of the fit.
    sums : Moments
        Of the fit.
    theta : array (r, n)
        Nominal elements, 1/s.
    d : array (q, n)
        Half-widths of the solver.
    violation : array (n,)
        Largest violation that the solver left, in scaled units.

    Returns
    -------
    model : UncertainLTI
        With the lifted half-widths.
    d : array (q, n)
        Lifted.
    judged : Judged
        Widths, with none outside.

    Raises
    ------
    FitError
        Samples stay outside however far the half-widths are lifted.
    """
    n, p = fleet.n, fleet.p
    free = sums.psi_scale > 0
    unit = np.zeros(len(sums.psi_scale))
    unit[free] = 1.0 / sums.psi_scale[free]
    lifted = d + np.outer(unit, np.maximum(violation, 0.0) * sums.rate_scale)
    nominal = np.zeros(d.shape)
    nominal[:p] = np.abs(theta[:p])
    if fleet.columns.disturbance:
        nominal[p] = np.abs(theta[p])
    own = np.zeros(d.shape)
    own[np.arange(n), np.arange(n)] = 1.0 / sums.dt_min
    base = lifted
    todo = np.ones(n, dtype=bool)
    for attempt in range(_ROUNDS):
        ulps = 2.0 ** (attempt + 2) * _EPS * (nominal + base + own) * free[:, None]
        lifted = np.where(todo, base + ulps, lifted)
        model = build(theta, lifted)
        judged = fleet.judge(model)
        todo = judged.outside > 0
        if not todo.any():
            return model, lifted, judged
    raise FitError(
        f"containment could not be repaired in row {int(np.argmax(todo))}: the signals differ too much in scale; "
        f"give steady and scale that bring them to order one"
    )
