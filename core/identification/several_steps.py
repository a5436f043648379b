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
class Steps:
    """Transitions in a row, of K windows of one length at once: controls, weights of blocks, and Δt of each step.

    `u` (steps, K, m): normalised; `weights` (steps, K, blocks): of the schedule; 1 without one; `dt` (steps, K): s.
    """

    u: Array
    weights: Array
    dt: Array

    @classmethod
    def of(cls, problem: Problem, at: NDArray[np.intp]) -> Steps:
        """Of the transitions `at` (steps, K).

        `at` (steps, K): their positions.
        """
        regimes, z, s = problem.columns.regimes, problem.z_columns, problem.s_columns
        weights = np.ones((*at.shape, 1))
        if regimes is not None:
            flat = at.ravel()
            found = regimes.weights(z[:, flat], None if s is None else s[:, flat])
            weights = np.moveaxis(found.reshape(-1, *at.shape), 0, -1)
        return cls(np.moveaxis(z[problem.n :, at], 0, -1), weights, problem.dt[at])

    def run(self, begin: Array, theta: Array) -> tuple[Array, list[Array]]:
        """States x̂ from `begin` on, and the regressors of each step, weighted.

        `begin` (K, n): states before the first step; `theta` (blocks, q, n): elements; Returns (steps + 1, K, n): the
        states; Returns (K, blocks, q): regressors.
        """
        x, used = [begin], []
        for u, w, dt in zip(self.u, self.weights, self.dt, strict=True):
            phi = w[:, :, None] * (_regressors(x[-1], u, theta.shape[1]) * dt[:, None])[:, None, :]
            used.append(phi)
            x.append(x[-1] + phi.reshape(len(phi), -1) @ theta.reshape(-1, theta.shape[2]))
        return np.stack(x), used

    def transition(self, theta: Array, step: int) -> Array:
        """Derivative of the state after one step by that before it.

        `theta` (blocks, q, n): elements; Returns (K, n, n): I + Δt A, blended.
        """
        n = theta.shape[2]
        blended = np.tensordot(self.weights[step], theta[:, :n].transpose(0, 2, 1), axes=1)
        return np.asarray(np.eye(n) + self.dt[step][:, None, None] * blended)


@dataclass(frozen=True)
class _Windows:
    """Windows of one length: states at both ends (K, n), and the steps between."""

    begin: Array
    end: Array
    steps: Steps


def _starts(problem: Problem, k: NDArray[np.intp], steps: int) -> NDArray[np.intp]:
    """Positions at which so many transitions in a row begin."""
    regimes, z, s = problem.columns.regimes, problem.z_columns, problem.s_columns
    vectors = np.empty((0, len(k))) if regimes is None else regimes.vectors(z, s)
    first = unbroken_over(k, vectors, None if regimes is None else regimes.schedule)
    last = np.arange(steps - 1, len(k))
    start = last - (steps - 1)
    return start[first[last] <= start]


def _some(start: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    """So many of them at most, evenly."""
    return start if len(start) <= most else start[np.linspace(0, len(start) - 1, most).astype(np.intp)]


def segments(problem: Problem, k: NDArray[np.intp], steps: int, samples: int) -> tuple[Steps, Array] | None:
    """Stretches of so many transitions in a row that do not overlap.

    `k` (N,): numbers of their samples; where one does not follow the one before, a segment ends; Returns (steps + 1, K,
    n): the recorded states, normalised; None for both if there is no segment.
    """
    start: list[int] = []
    for position in _starts(problem, k, steps).tolist():
        if not start or position >= start[-1] + steps:
            start.append(position)
    if not start:
        return None
    begin = _some(np.array(start, dtype=np.intp), max(samples // steps, 1))
    at = begin + np.arange(steps)[:, None]
    after = np.moveaxis(problem.next_columns[:, at], 0, -1)
    return Steps.of(problem, at), np.concatenate([problem.z_columns[: problem.n, begin].T[None], after])


def _windows(problem: Problem, k: NDArray[np.intp], steps: int) -> _Windows | None:
    start = _some(_starts(problem, k, steps), min(max(_STEPS_LOOKED_AT // steps, _FEWEST), _MOST))
    if not len(start):
        return None
    at = start + np.arange(steps)[:, None]
    begin, end = problem.z_columns[: problem.n, start].T, problem.next_columns[:, at[-1]].T
    return _Windows(begin, end, Steps.of(problem, at))


class Elements:
    """The unknown nominal elements of all rows as one vector, and what it means.

    `rows`: with the elements by least squares of one step, and what is known of them; `blocks`: of the schedule.
    """

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
        """Elements of values of the unknowns.

        `values` (size,): the unknowns; Returns (blocks, q, n): with those that are fixed.
        """
        parts = [values[a:b] for a, b in zip(self._at, self._at[1:], strict=False)]
        full = self._fixed + np.stack([v @ m for v, m in zip(parts, self._maps, strict=True)])
        return np.ascontiguousarray(full.T).reshape(self.blocks, -1, len(full))

    def values(self, theta: Array) -> Array:
        """The unknowns of elements; what several blocks share is taken as their mean.

        `theta` (blocks, q, n): elements; Returns (size,): the inverse of `theta`.
        """
        full = theta.reshape(-1, theta.shape[2]).T - self._fixed
        return np.concatenate([m @ row / m.sum(axis=1) for row, m in zip(full, self._maps, strict=True)])

    def add(self, by_unknowns: Array, regressors: Array) -> None:
        """Add to derivatives of states by the unknowns those of one step.

        `by_unknowns` (K, n, size): changed in place; `regressors` (K, blocks q): of the step, weighted.
        """
        for i, (a, b, m) in enumerate(zip(self._at, self._at[1:], self._maps, strict=False)):
            by_unknowns[:, i, a:b] += regressors @ m.T

    def chosen(self, jacobian: Array) -> Array:
        """Derivatives by the unknowns, of those by the elements.

        `jacobian` (K, n, blocks q, n): by the elements; Returns (K n, size): by the unknowns.
        """
        columns = [jacobian[..., i] @ m.T for i, m in enumerate(self._maps)]
        return np.concatenate(columns, axis=2).reshape(-1, self.size)


def _regressors(x: Array, u: Array, q: int) -> Array:
    """[x u] or [x u 1], (K, q)."""
    z = np.concatenate([x, u], axis=1)
    return z if z.shape[1] == q else np.concatenate([z, np.ones((len(z), 1))], axis=1)


def _jacobian(windows: _Windows, theta: Array, used: Sequence[Array]) -> Array:
    """Derivative of x̂ at the ends by the elements, (K, n, blocks q, n): backwards over the steps."""
    n = theta.shape[2]
    count = len(windows.begin)
    found = np.zeros((count, n, theta.shape[0] * theta.shape[1], n))
    onward = np.broadcast_to(np.eye(n), (count, n, n))  # of the end by the state after the step
    for step in reversed(range(len(used))):
        found += used[step].reshape(count, 1, -1, 1) * onward[:, :, None, :]
        onward = onward @ windows.steps.transition(theta, step)
    return found


def runs_over_steps(problem: Problem, k: NDArray[np.intp], rows: Sequence[Row], longest: int) -> Iterator[Array]:
    """Elements by least squares 4, 8, 16... steps ahead, each from the one before, and as many as the longest window.

    `k` (N,): numbers of their samples; where one does not follow the one before, windows end; Yields (blocks, q, n):
    elements θ of [x; u] or [x; u; 1], one block after another. Nothing where there are too many unknowns or no windows,
    or no step makes the error smaller.
    """
    elements = Elements(rows, problem.columns.count)
    if not 0 < elements.size <= MOST_UNKNOWNS:
        return
    values, scale, steps = elements.first, None, 1
    while True:
        windows = _windows(problem, k, steps)
        if windows is None:
            return
        if scale is None:  # of the error one step ahead: the states count alike
            error = windows.end - windows.steps.run(windows.begin, elements.theta(values))[0][-1]
            scale = np.sqrt(np.mean(error**2, axis=0))
            scale = np.where(scale > 0.0, scale, 1.0)
        else:
            values, gained = _nearest(windows, elements, values, scale)
            if steps >= 4 and gained:
                yield elements.theta(values)
        if steps >= longest:
            return
        steps = min(_LONGER * steps, longest)


def _nearest(windows: _Windows, elements: Elements, values: Array, scale: Array) -> tuple[Array, bool]:
    """From these values to the least squared error over the windows, and whether it became smaller."""
    damping, gained = 1e-4, False

    def error_of(which: Array) -> tuple[Array, list[Array], float]:
        with np.errstate(over="ignore", invalid="ignore"):
            x, used = windows.steps.run(windows.begin, elements.theta(which))
            left = ((windows.end - x[-1]) / scale).ravel()
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
