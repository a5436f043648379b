# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Least squares several steps ahead: elements whose run stays near the recordings where the readings are noisy.

One step ahead, least squares takes the noise of a reading for a movement that dies out within a step: the elements are
biased, and their run drifts off (errors in variables). The error several steps ahead has the noise of both ends once,
and the movement of all the steps. It is not linear in the elements; the Gauss-Newton method with Levenberg's and
Marquardt's damping goes from least squares of one step over windows of 2, 4, 8... steps.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.identification.problem import Problem
from uncertain_lti.identification.row import Row
from uncertain_lti.model.horizon import unbroken_over

MOST_UNKNOWNS = 600
"""Of models with more elements the least squares of one step is all that is tried."""
_STEPS_LOOKED_AT = 16_000  # of all windows of one length together, about
_FEWEST, _MOST = 500, 1500  # windows
_ROUNDS = 8
_LONGER = 2  # times as long, from one length of window to the next
_DONE = 1e-3  # a smaller share of the squared error gained ends the rounds


@dataclass(frozen=True)
class _Windows:
    """Windows of one length: states at both ends (K, n), and of each step controls, weights of blocks, and Δt."""

    begin: Array
    end: Array
    u: Array
    weights: Array
    dt: Array


def _windows(problem: Problem, k: NDArray[np.intp], steps: int) -> _Windows | None:
    regimes, z, s, n = problem.columns.regimes, problem.z_columns, problem.s_columns, problem.n
    vectors = np.empty((0, len(k))) if regimes is None else regimes.vectors(z, s)
    first = unbroken_over(k, vectors, None if regimes is None else regimes.schedule)
    last = np.arange(steps - 1, len(k))
    start = last - (steps - 1)
    start = start[first[last] <= start]
    most = min(max(_STEPS_LOOKED_AT // steps, _FEWEST), _MOST)
    if len(start) > most:
        start = start[np.linspace(0, len(start) - 1, most).astype(np.intp)]
    if not len(start):
        return None
    at = start + np.arange(steps)[:, None]
    weights = np.ones((*at.shape, 1))
    if regimes is not None:
        flat = at.ravel()
        found = regimes.weights(z[:, flat], None if s is None else s[:, flat])
        weights = np.moveaxis(found.reshape(-1, *at.shape), 0, -1)
    u = np.moveaxis(z[n:, at], 0, -1)
    return _Windows(z[:n, start].T, problem.next_columns[:, at[-1]].T, u, weights, problem.dt[at])


class _Elements:
    """The unknown nominal elements of all rows as one vector, and what it means."""

    def __init__(self, rows: Sequence[Row], blocks: int) -> None:
        self._fixed = np.stack([row.fixed_theta for row in rows])  # (n, blocks q)
        self._maps = []
        for row in rows:
            unit = np.zeros((row.r, self._fixed.shape[1]))
            for j in range(row.r):
                row.phi_columns.put(unit[j], np.eye(row.r)[j])
            self._maps.append(unit)
        self.blocks, self.size = blocks, sum(row.r for row in rows)
        self._at = np.cumsum([0, *(row.r for row in rows)])
        units = [row.unit_phi * row.scale for row in rows]
        lower, upper = ([getattr(row, side)[: row.r] for row in rows] for side in ("lower", "upper"))
        self.unit = np.concatenate(units)
        self.lower, self.upper = np.concatenate(lower) * self.unit, np.concatenate(upper) * self.unit
        self.first = np.concatenate([row.theta[row.phi_columns.first] for row in rows])

    def theta(self, values: Array) -> Array:
        """Elements (blocks, q, n)."""
        parts = [values[a:b] for a, b in zip(self._at, self._at[1:], strict=False)]
        full = self._fixed + np.stack([v @ m for v, m in zip(parts, self._maps, strict=True)])
        return np.ascontiguousarray(full.T).reshape(self.blocks, -1, len(full))

    def chosen(self, jacobian: Array) -> Array:
        """(K, n, blocks q, n) by the elements, as (K n, size) by the unknowns."""
        columns = [jacobian[..., i] @ m.T for i, m in enumerate(self._maps)]
        return np.concatenate(columns, axis=2).reshape(-1, self.size)


def _regressors(x: Array, u: Array, q: int) -> Array:
    """[x u] or [x u 1], (K, q)."""
    z = np.concatenate([x, u], axis=1)
    return z if z.shape[1] == q else np.concatenate([z, np.ones((len(z), 1))], axis=1)


def _run(windows: _Windows, theta: Array) -> tuple[Array, list[Array]]:
    """x̂ at the ends, and the regressors of each step (K, blocks, q), weighted."""
    x, used = windows.begin, []
    for u, w, dt in zip(windows.u, windows.weights, windows.dt, strict=True):
        phi = w[:, :, None] * (_regressors(x, u, theta.shape[1]) * dt[:, None])[:, None, :]
        used.append(phi)
        x = x + phi.reshape(len(x), -1) @ theta.reshape(-1, theta.shape[2])
    return x, used


def _jacobian(windows: _Windows, theta: Array, used: Sequence[Array]) -> Array:
    """Derivative of x̂ at the ends by the elements, (K, n, blocks q, n): backwards over the steps."""
    n = theta.shape[2]
    count, back = len(windows.begin), np.eye(n)
    found = np.zeros((count, n, theta.shape[0] * theta.shape[1], n))
    onward = np.broadcast_to(back, (count, n, n))  # of the end by the state after the step
    for phi, w, dt in zip(reversed(used), windows.weights[::-1], windows.dt[::-1], strict=True):
        found += phi.reshape(count, 1, -1, 1) * onward[:, :, None, :]
        step = back + dt[:, None, None] * np.tensordot(w, theta[:, :n].transpose(0, 2, 1), axes=1)
        onward = onward @ step
    return found


def runs_over_steps(problem: Problem, k: NDArray[np.intp], rows: Sequence[Row], longest: int) -> Iterator[Array]:
    """Elements by least squares 4, 8, 16... steps ahead, each from the one before, and as many as the longest window.

    Parameters
    ----------
    problem : Problem
        The transitions.
    k : array of int (N,)
        Numbers of their samples; where one does not follow the one before, windows end.
    rows : sequence of Row
        With the elements by least squares of one step, and what is known of them.
    longest : int
        Steps of the longest windows.

    Yields
    ------
    array (blocks, q, n)
        Elements θ of [x; u] or [x; u; 1], one block after another. Nothing where there are too many unknowns or no
        windows, or no step makes the error smaller.
    """
    elements = _Elements(rows, problem.columns.count)
    if not 0 < elements.size <= MOST_UNKNOWNS:
        return
    values, scale, steps = elements.first, None, 1
    while True:
        windows = _windows(problem, k, steps)
        if windows is None:
            return
        if scale is None:  # of the error one step ahead: the states count alike
            error = windows.end - _run(windows, elements.theta(values))[0]
            scale = np.sqrt(np.mean(error**2, axis=0))
            scale = np.where(scale > 0.0, scale, 1.0)
        else:
            values, gained = _nearest(windows, elements, values, scale)
            if steps >= 4 and gained:
                yield elements.theta(values)
        if steps >= longest:
            return
        steps = min(_LONGER * steps, longest)


def _nearest(windows: _Windows, elements: _Elements, values: Array, scale: Array) -> tuple[Array, bool]:
    """From these values to the least squared error over the windows, and whether it became smaller."""
    damping, gained = 1e-4, False

    def error_of(which: Array) -> tuple[Array, list[Array], float]:
        with np.errstate(over="ignore", invalid="ignore"):
            x, used = _run(windows, elements.theta(which))
            left = ((windows.end - x) / scale).ravel()
            return left, used, float(left @ left)

    left, used, before = error_of(values)
    for _ in range(_ROUNDS):
        if not 0.0 < before < np.inf:
            break
        slope = elements.chosen(_jacobian(windows, elements.theta(values), used) / scale[:, None, None])
        slope *= elements.unit
        gram, pull = slope.T @ slope, slope.T @ left
        size = np.diagonal(gram).copy()
        size[size <= 1e-12 * size.max()] = max(1e-12 * float(size.max()), 1e-300)
        for _ in range(_ROUNDS):
            change = np.linalg.lstsq(gram + damping * np.diag(size), pull, rcond=None)[0]
            tried = np.clip(values + change * elements.unit, elements.lower, elements.upper)
            found = error_of(tried)
            if found[2] < before:
                break
            damping *= 10.0
        else:
            break
        done = found[2] > before * (1.0 - _DONE)
        values, gained, damping = tried, True, damping / 5.0
        left, used, before = found
        if done:
            break
    return values, gained
