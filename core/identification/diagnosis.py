"""What the data and the fit mean for the user, in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.errors import FitError
from uncertain_lti.identification.passes import Moments
from uncertain_lti.identification.problem import Problem
from uncertain_lti.model import UncertainLTI
from uncertain_lti.transient import Transient

Array = NDArray[np.float64]


def check_solvable(problem: Problem, transients: Sequence[Transient], names: Sequence[str]) -> None:
    """Refuse data to which no envelope can be fitted.

    Raises
    ------
    FitError
        Fewer transitions than unknowns per row, or a sample at rest (x = u = 0) with a moving successor and no
        additive term: the width there is 0 whatever the matrices; names the sample and the remedy.
    """
    columns = problem.columns
    unknowns = problem.p + columns.drift
    if problem.N < unknowns:
        raise FitError(
            f"{problem.N} usable transitions for {unknowns} unknown nominal elements per row; "
            f"record at least {unknowns}, better a hundred times as many, or use fewer signals"
        )
    if columns.disturbance or columns.noise:
        return
    rest: NDArray[np.bool_] = np.asarray(~problem.z.any(axis=1))
    moving = rest[:, None] & (problem.x_next != problem.z[:, : problem.n])
    where = np.argwhere(moving)
    if len(where):
        sample, state = where[0]
        transient = transients[problem.source[sample]]
        k = int(problem.k[sample])
        raise FitError(
            f"{transient.name}: sample {k} (t = {transient.t[k]:.6g} s) is at rest, x = u = 0, and '{names[state]}' "
            f"moves by {problem.x_next[sample, state]:.3g} in the next step, which no interval matrices can contain "
            f"(so do {len(np.unique(where[:, 0])) - 1} other samples); use an additive term: --additive noise for "
            f"measurement noise, --additive disturbance for unmodelled inputs"
        )


def _rank(problem: Problem, moments: Moments, names: Sequence[str]) -> tuple[int, list[str]]:
    """Rank of the nominal regressors and, in words, which columns make it deficient."""
    names = [*names, "the drift c"] if problem.columns.drift else list(names)
    messages = []
    dead = moments.phi_scale == 0
    for j in np.flatnonzero(dead):
        messages.append(
            f"rank deficient: '{names[j]}' is 0 in every transition, so its column is not identifiable and is set "
            f"to 0; record it moving, or leave it out"
        )
    free = np.flatnonzero(~dead)
    unit = 1.0 / moments.phi_scale[free]
    correlation = moments.centre[np.ix_(free, free)] * np.outer(unit, unit) / problem.N
    values, vectors = np.linalg.eigh(correlation)
    limit = 1e-12 * len(free)
    for value, vector in zip(values, vectors.T, strict=True):
        if value <= limit:
            part = [names[free[j]] for j in np.flatnonzero(np.abs(vector) > 0.05)]
            messages.append(
                f"rank deficient: {_list(part)} move together in every transition, so their columns cannot be told "
                f"apart and share the effect; record them moving independently, or leave one out"
            )
    moved = np.ptp(problem.z, axis=0)
    for j in np.flatnonzero((moved == 0) & ~dead[: problem.p]):
        messages.append(
            f"'{names[j]}' is constant ({problem.z[0, j]:.4g}) in every transition, so its column cannot be told from "
            f"a drift; record it moving, or leave it out"
        )
    return int(np.count_nonzero(values > limit)), messages


def describe(
    model: UncertainLTI, problem: Problem, moments: Moments, mean_width: Array, max_width: Array
) -> tuple[int, list[str]]:
    """Rank, and what the user must be told of a fitted model."""
    states = model.state_names
    found, messages = _rank(problem, moments, [*states, *model.control_names])
    unstable = [v for v in model.eigenvalues() if v.real > 0]
    if unstable:
        values = ", ".join(f"{v.real:.3g}{v.imag:+.3g}j" if v.imag else f"{v.real:.3g}" for v in unstable)
        messages.append(
            f"the nominal model is unstable (eigenvalues {values} 1/s): one-step bounds restart from the measured "
            f"state and stay valid, a free run does not"
        )
    elif model.spectral_radius() > 1.0:
        messages.append(
            f"the nominal recursion runs away at the recorded step (spectral radius {model.spectral_radius():.4g}): "
            f"the sampling is slow for the fastest mode"
        )
    z_names = [*states, *model.control_names]
    nominal, half = np.hstack([model.A, model.B]), np.hstack([model.dA, model.dB])
    wide = np.argwhere(half > np.abs(nominal))
    if len(wide):
        i, j = max(wide.tolist(), key=lambda ij: float(half[ij[0], ij[1]] - abs(nominal[ij[0], ij[1]])))
        messages.append(
            f"{len(wide)} of {nominal.size} half-widths exceed their nominal elements (most: {states[i]} from "
            f"{z_names[j]}, {nominal[i, j]:.3g} ± {half[i, j]:.3g} 1/s): the sign of these effects is not known"
        )
    columns = problem.columns
    if not columns.noise and not columns.disturbance:
        box, size = _least_squares_box(problem, moments), np.abs(problem.z).sum(axis=1)
        rest = float(np.mean(size <= 0.02 * np.quantile(size, 0.95)))
        blown = [i for i in range(problem.n) if mean_width[i] > box[i] > 0]
        if blown:
            worst = max(blown, key=lambda i: float(mean_width[i] / box[i]))
            messages.append(
                f"the envelope of {_list([states[i] for i in blown])} is absurdly wide: the mean width of "
                f"{states[worst]} is {mean_width[worst] / box[worst]:.3g} times that of a constant band around least "
                f"squares, because noise near rest ({rest:.0%} of the samples) inflates the half-widths; use an "
                f"additive term: --additive noise, or --additive disturbance"
            )
    span = np.ptp(problem.z[:, : problem.n], axis=0)
    for i in np.flatnonzero((span > 0) & (mean_width > 0.5 * span)).tolist():
        messages.append(
            f"the envelope of '{states[i]}' is {mean_width[i] / span[i]:.0%} as wide as the state's own range, so few "
            f"faults can show in it: one step is long for this state, or what moves it is not among the controls"
        )
    if columns.drift and columns.noise and not columns.disturbance:
        messages.append("Δt is constant, so dc and v cannot be told apart: v takes the width and dc is 0")
    return found, messages


def _least_squares_box(problem: Problem, moments: Moments) -> Array:
    """Width of a constant band around least squares that contains every sample, (n,), per step."""
    free = moments.phi_scale > 0
    theta = np.zeros(moments.target.shape)
    theta[free] = np.linalg.lstsq(moments.centre[np.ix_(free, free)], moments.target[free], rcond=None)[0]
    largest = np.zeros(problem.n)
    for block in problem.blocks():
        residual = np.abs(block.rate() - theta.T @ block.phi(problem.columns)) * block.dt
        largest = np.maximum(largest, residual.max(axis=1))
    return 2.0 * largest


def _list(names: Sequence[str]) -> str:
    quoted = [n if n.startswith("the ") else f"'{n}'" for n in names]
    return quoted[0] if len(quoted) == 1 else ", ".join(quoted[:-1]) + " and " + quoted[-1]
