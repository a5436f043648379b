# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The nominal model on its own: the free run, its discrepancies from a recording, and its recursion."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from uncertain_lti.base.arrays import Array, runs
from uncertain_lti.base.errors import ModelError
from uncertain_lti.kernel.arithmetic import blended
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.signal_map import Recalled

LONGEST_RECURSION = 400
"""Rows of the matrix of the recursion up to which it remembers earlier samples; longer memories are left out of it."""


def simulate(model: Any, x0: ArrayLike, u: ArrayLike, dt: ArrayLike, s: ArrayLike | None = None) -> Array:
    """Free run of the nominal model, x_{k+1} = x_k + Δt_k (A x_k + B u_k + c), as in eq. (3) with ΔA = ΔB = 0.

    What a signal takes from earlier samples of a state (lag, diff, rate) follows the run, as soon as the run has
    these samples.

    Parameters
    ----------
    model : UncertainLTI
        The model.
    x0 : array (n,)
        Normalised state at t_0.
    u : array (N, m)
        Normalised controls.
    dt : float or array (N,)
        Δt_k, s.
    s : array (N, q), optional
        Normalised further scheduling signals; for models that have some. A schedule on a state follows the run.

    Returns
    -------
    array (N+1, n)
        Normalised states; infinite or NaN where an unstable model runs away.
    """
    u = np.asarray(u, dtype=np.float64)
    dt = np.broadcast_to(np.asarray(dt, dtype=np.float64), (len(u),))
    s = np.zeros((len(u), 0)) if s is None else np.asarray(s, dtype=np.float64)
    x = np.empty((len(u) + 1, model.n))
    x[0] = x0
    A, B, c = model.A, model.B, model.c
    n, m = model.n, model.m
    z = np.hstack((x[:-1], u, s))
    recalled = [r for r in model.signals.recalled if r.of < n]
    with np.errstate(over="ignore", invalid="ignore"):  # an unstable model runs away, and may
        for k in range(len(u)):
            z[k, :n] = x[k]
            for of_state in recalled:
                _recall(model, of_state, z, k, dt)
            if model.schedule is not None:
                corners = model.schedule.corners(z[k, model.scheduling_positions, None])
                A, B, c = (blended(blocks, *corners)[..., 0] for blocks in (model.A, model.B, model.c))
            x[k + 1] = x[k] + dt[k] * (A @ x[k] + B @ z[k, n : n + m] + c)
    return x


def _recall(model: Any, recalled: Recalled, z: Array, k: int, dt: Array) -> None:
    """Fill in what sample k takes from earlier ones, if the run z (N, n + m + q) has them."""
    memory, before = recalled.memory, k - recalled.memory.samples
    if before < 0:
        return
    steady, scale = model.operating_point.steady, model.operating_point.scale
    now, past = z[[k, before], recalled.of] * scale[recalled.of] + steady[recalled.of]
    value = memory.taken(now, past, dt[before])
    z[k, recalled.position] = (value - steady[recalled.position]) / scale[recalled.position]


def run_over(model: Any, transient: Transient) -> Array:
    """States of the run over each usable stretch of a recording.

    Returns (N+1, n): normalised; NaN where there is no run.
    """
    transient = model.own_signals_of(transient)
    x = model.operating_point.normalise_x(transient.x)
    u = model.operating_point.normalise_u(transient.u)
    s = model.operating_point.normalise_s(transient.s)
    usable, dt = transient.usable, transient.dt
    run = np.full(x.shape, np.nan)
    for start, stop in runs(usable):
        run[start : stop + 1] = simulate(model, x[start], u[start:stop], dt[start:stop], s[start:stop])
    return run


def free_run(model: Any, transient: Transient) -> Transient:
    """Free run of the nominal model over a recording: its controls, and nothing of its states but the first.

    The run begins again from the recorded sample at the start of every segment and after one that is not finite.

    Parameters
    ----------
    model : UncertainLTI
        The model.
    transient : Transient
        In recorded units.

    Returns
    -------
    Transient
        With the states of the run, in recorded units; NaN where there is no run.

    Raises
    ------
    ModelError
        The transient has other numbers of signals than the model.
    """
    x = model.operating_point.recorded_x(run_over(model, transient))
    return transient.replace(x=x, name=f"{transient.name}, free run of the model")


def discrepancy(model: Any, transient: Transient, W: ArrayLike | None = None) -> tuple[float, Array]:
    """Discrepancies (4) and (5) between the free-running nominal model (`free_run`) and a recorded transient.

    Parameters
    ----------
    model : UncertainLTI
        The model.
    transient : Transient
        In recorded units.
    W : array (n,), (N, n) or (N, n, n), optional
        Weights of the arrival samples; default ones.

    Returns
    -------
    sum_of_squares : float
        Eq. (4), over k = 1..N.
    largest : array (n,)
        Eq. (5) for each state.

    Raises
    ------
    ModelError
        W has another shape.
    """
    error = (run_over(model, transient) - model.operating_point.normalise_x(transient.x))[1:]
    usable = transient.usable
    weights = np.ones(model.n) if W is None else np.asarray(W, dtype=np.float64)
    if weights.shape not in ((model.n,), (len(usable), model.n), (len(usable), model.n, model.n)):
        raise ModelError(
            f"W has shape {weights.shape}; it must be ({model.n},), ({len(usable)}, {model.n}) "
            f"or ({len(usable)}, {model.n}, {model.n})"
        )
    full = weights.ndim == 3
    diagonal = np.broadcast_to(np.diagonal(weights, axis1=1, axis2=2) if full else weights, error.shape)[usable]
    error = error[usable]
    squares = np.einsum("ki,kij,kj->", error, weights[usable], error) if full else np.sum(diagonal * error**2)
    return float(squares), np.max(np.sqrt(diagonal) * np.abs(error), axis=0, initial=0.0)


def recursion(model: Any, dt: float) -> Array:
    """Matrix that takes [x_k; x_{k-1}; ...] to the next, as far back as the model remembers its states.

    Returns (N, N): I + Δt A without a memory.
    """
    n, scale = model.n, model.operating_point.scale
    step: Array = np.eye(n) + dt * model.A
    recalled = [r for r in model.signals.recalled if r.of < n and r.position < n + model.m]
    longest = max((r.memory.samples for r in recalled), default=0)
    if not longest or longest > LONGEST_RECURSION // n:
        return step
    whole = np.zeros((*step.shape[:-2], n * (longest + 1), n * (longest + 1)))
    whole[..., :n, :n] = step
    whole[..., n:, :-n] = np.eye(n * longest)
    for r in recalled:
        column = dt * model.B[..., r.position - n] * (scale[r.of] / scale[r.position])
        column = column / dt if r.memory.kind == "rate" else column
        past = n * r.memory.samples + r.of
        if r.memory.kind == "lag":
            whole[..., :n, past] += column
        else:
            whole[..., :n, r.of] += column
            whole[..., :n, past] -= column
    return whole
