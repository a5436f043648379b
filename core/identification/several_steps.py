# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Runs near the recordings over several steps where the readings are noisy: least squares, and the output-error method.

One step ahead, least squares takes the noise of a reading for a movement that dies out within a step: the elements are
biased, and their run drifts off (errors in variables). The error several steps ahead has the noise of both ends once,
and the movement of all the steps. It is not linear in the elements; the Gauss-Newton method with Levenberg's and
Marquardt's damping goes from least squares of one step over windows of 2, 4, 8... steps.

That still starts each run from a reading, and uses the last sample of each window only. By the output-error method the
initial state of each segment is unknown as well and every sample counts, each state by the spread of its own error:
with noise on the readings alone, this is the maximum of the likelihood (multiple shooting). The initial states are
eliminated segment by segment.
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
_ROUNDS, _TRIES = 8, 8
_LONGER = 2  # times as long, from one length of window to the next
_DONE = 1e-3  # a smaller share of the squared error gained ends the rounds
LONGER = 2
"""A segment is so many times as long as the longest horizon."""
_SAMPLES = 32_000  # that are run, of all segments, about
_EVERY = 2  # of them counts: neighbours say much the same


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
            values, gained = _nearest(_Ends(windows, elements, scale), elements, values)
            if steps >= 4 and gained:
                yield elements.theta(values)
        if steps >= longest:
            return
        steps = min(_LONGER * steps, longest)


def nearest_to_all(
    problem: Problem, k: NDArray[np.intp], elements: Elements, begins: Sequence[Array], longest: int
) -> Array | None:
    """Elements of the least squared error over all samples of segments, from the nearest of those to begin with.

    `k` (N,): numbers of their samples; where one does not follow the one before, segments end; `begins` and what
    returns (blocks, q, n): elements of [x; u] or [x; u; 1], one block after another; None if there are no segments, or
    nothing is gained.
    """
    found = segments(problem, k, LONGER * longest, _SAMPLES)
    if found is None:
        return None
    steps, recorded = found
    with np.errstate(over="ignore", invalid="ignore"):
        errors = [recorded - steps.run(recorded[0], theta)[0] for theta in begins]
        scales = [np.sqrt(np.mean(error**2, axis=(0, 1))) for error in errors]
        nearest = int(np.argmin([s.prod() if np.isfinite(s).all() else np.inf for s in scales]))
    if not np.isfinite(scales[nearest]).all():
        return None
    sought = _Segments(steps, elements, recorded, scales[nearest])
    values, gained = _nearest(sought, elements, elements.values(begins[nearest]))
    return elements.theta(values) if gained else None


def _nearest(sought: _Ends | _Segments, elements: Elements, values: Array) -> tuple[Array, bool]:
    """From these values to the least squared error, and whether it became smaller: Gauss and Newton, damped."""
    damping, gained = 1e-4, False
    with np.errstate(over="ignore", invalid="ignore"):
        before = sought.error(values)
        for _ in range(_ROUNDS):
            normal = sought.normal(values) if 0.0 < before < np.inf else None
            if normal is None:
                break
            gram, pull = normal
            size = np.diagonal(gram)
            size = np.maximum(size, max(1e-12 * float(size.max()), 1e-300))
            for _ in range(_TRIES):
                change = np.linalg.lstsq(gram + damping * np.diag(size), pull, rcond=None)[0]
                tried = np.clip(values + change * elements.unit, elements.lower, elements.upper)
                after = sought.error(tried)
                if after < before:
                    break
                damping *= 10.0
            else:
                break
            values, gained, damping = tried, True, damping / 5.0
            done, before = after > before * (1.0 - _DONE), sought.accept(after)
            if done:
                break
    return values, gained


class _Ends:
    """The last states of windows, whose runs begin at the readings."""

    def __init__(self, windows: _Windows, elements: Elements, scale: Array) -> None:
        self._windows, self._elements, self._scale = windows, elements, scale

    def error(self, values: Array) -> float:
        """Squared error with these values of the unknowns."""
        x, self._used = self._windows.steps.run(self._windows.begin, self._elements.theta(values))
        self._left = ((self._windows.end - x[-1]) / self._scale).ravel()
        return float(self._left @ self._left)

    def accept(self, error: float) -> float:
        """Go on from the values last looked at: their squared error from here on."""
        return error

    def normal(self, values: Array) -> tuple[Array, Array]:
        """Gram matrix and right side of the changes of these values, scaled."""
        slope = _jacobian(self._windows, self._elements.theta(values), self._used) / self._scale[:, None, None]
        slope = self._elements.chosen(slope) * self._elements.unit
        return slope.T @ slope, slope.T @ self._left


class _Segments:
    """Every second state of segments, whose initial states (K, n) are unknown as well."""

    def __init__(self, steps: Steps, elements: Elements, recorded: Array, scale: Array) -> None:
        self._steps, self._elements, self._recorded = steps, elements, recorded
        self._counted = np.unique([*range(0, len(recorded), _EVERY), len(recorded) - 1])
        self._begin = recorded[0].copy()
        self._scale = np.where(scale > 0.0, scale, 1.0)
        self._follow: tuple[Array, Array, Array, Array] | None = None

    def error(self, values: Array) -> float:
        """As of `_Ends`, each state by the spread of its own error."""
        if self._follow is not None:  # the initial states change with the elements
            begin, own, by_elements, at = self._follow
            self._begin = begin + own - by_elements @ (values - at)
        x, self._used = self._steps.run(self._begin, self._elements.theta(values))
        self._left = (self._recorded - x)[self._counted]
        return float(np.sum((self._left / self._scale) ** 2))

    def accept(self, error: float) -> float:
        """As of `_Ends`, by the spread that the errors have now."""
        scale = np.sqrt(np.mean(self._left**2, axis=(0, 1)))
        self._scale = np.where(scale > 0.0, scale, 1.0)
        return float(np.sum((self._left / self._scale) ** 2))

    def normal(self, values: Array) -> tuple[Array, Array] | None:
        """Without the initial states: by the complement of Schur, segment by segment."""
        steps, elements, scale, theta = self._steps, self._elements, self._scale, self._elements.theta(values)
        (count, n), size = self._begin.shape, elements.size
        by_elements, by_first = np.zeros((count, n, size)), np.broadcast_to(np.eye(n), (count, n, n))
        gram, pull = np.zeros((size, size)), np.zeros(size)
        own, mixed, turned = np.zeros((count, n, n)), np.zeros((count, n, size)), np.zeros((count, n, 1))
        next_counted, left = 0, self._left / scale
        for t in range(len(self._used) + 1):
            if t:
                step = steps.transition(theta, t - 1)
                by_elements, by_first = step @ by_elements, step @ by_first
                elements.add(by_elements, self._used[t - 1].reshape(count, -1))
            if t != self._counted[next_counted]:
                continue
            scaled, of_first = by_elements / scale[:, None], (by_first / scale[:, None]).transpose(0, 2, 1)
            flat = scaled.reshape(-1, size)
            gram += flat.T @ flat
            pull += flat.T @ left[next_counted].ravel()
            own += of_first @ of_first.transpose(0, 2, 1)
            mixed += of_first @ scaled
            turned += of_first @ left[next_counted][:, :, None]
            next_counted += 1
        try:
            solved = np.linalg.solve(own, np.concatenate([mixed, turned], axis=2))
        except np.linalg.LinAlgError:
            return None
        gram -= np.tensordot(mixed, solved[:, :, :-1], axes=((0, 1), (0, 1)))
        pull -= np.tensordot(mixed, solved[:, :, -1], axes=((0, 1), (0, 1)))
        self._follow = self._begin, solved[:, :, -1], solved[:, :, :-1], values
        gram, pull = gram * np.outer(elements.unit, elements.unit), pull * elements.unit
        return (gram, pull) if np.isfinite(gram).all() and np.isfinite(pull).all() else None
