# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The output-error method: elements whose run is near every sample of a segment, from an initial state fitted with it.

Least squares several steps ahead start each run from a reading, whose noise is in the regressors, and use the last
sample of each window only. Here the initial state of each segment is unknown as well and every sample counts, each
state by the spread of its own error: with noise on the readings alone, this is the maximum of the likelihood (multiple
shooting). The Gauss-Newton method eliminates the initial states segment by segment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.identification.problem import Problem
from uncertain_lti.identification.several_steps import Elements, Steps, segments

LONGER = 2
"""A segment is so many times as long as the longest horizon."""
_SAMPLES = 32_000  # that are run, about
_EVERY = 2  # of them counts: neighbours say much the same
_ROUNDS, _TRIES = 8, 8
_DONE = 1e-3  # a smaller share of the squared error gained ends the rounds


def nearest_to_all(
    problem: Problem, k: NDArray[np.intp], elements: Elements, begins: Sequence[Array], longest: int
) -> Array | None:
    """Elements of the least squared error over all samples of segments.

    `k` (N,): numbers of their samples; where one does not follow the one before, segments end; `begins` (blocks, q, n):
    elements to begin with: those whose run from the first sample of each segment is nearest; Returns (blocks, q, n):
    elements of [x; u] or [x; u; 1], one block after another; None if there are no segments, or nothing is gained.
    """
    found = segments(problem, k, LONGER * longest, _SAMPLES)
    if found is None:
        return None
    steps, recorded = found
    first, gained, damping = recorded[0].copy(), False, 1e-4
    counted = np.unique([*range(0, len(recorded), _EVERY), len(recorded) - 1])
    with np.errstate(over="ignore", invalid="ignore"):
        scales = [np.sqrt(np.mean((recorded - steps.run(first, theta)[0]) ** 2, axis=(0, 1))) for theta in begins]
        nearest = int(np.argmin([s.prod() if np.isfinite(s).all() else np.inf for s in scales]))
        values, scale = elements.values(begins[nearest]), scales[nearest]
        for _ in range(_ROUNDS):
            if not np.isfinite(scale).all():
                return None
            scale = np.where(scale > 0.0, scale, 1.0)
            x, used = steps.run(first, elements.theta(values))
            left = (recorded - x)[counted] / scale
            before = float(np.sum(left**2))
            if before == 0.0:
                break
            normal = _normal(steps, elements, elements.theta(values), used, counted, left, scale)
            if normal is None:
                break
            for _ in range(_TRIES):
                change = np.linalg.lstsq(normal.gram + damping * np.diag(normal.size), normal.pull, rcond=None)[0]
                tried = np.clip(values + change * elements.unit, elements.lower, elements.upper)
                begin = first + normal.own - normal.by_elements @ (tried - values)
                error = recorded - steps.run(begin, elements.theta(tried))[0]
                after = float(np.sum((error[counted] / scale) ** 2))
                if after < before:
                    break
                damping *= 10.0
            else:
                break
            values, first, gained, damping = tried, begin, True, damping / 5.0
            scale = np.sqrt(np.mean(error[counted] ** 2, axis=(0, 1)))
            if after > before * (1.0 - _DONE):
                break
    return elements.theta(values) if gained else None


@dataclass(frozen=True)
class _Normal:
    """Normal equations of the elements, scaled, and what the initial states (K, n) do with them."""

    gram: Array
    pull: Array
    size: Array
    own: Array
    by_elements: Array


def _normal(
    steps: Steps, elements: Elements, theta: Array, used: list[Array], counted: Array, left: Array, scale: Array
) -> _Normal | None:
    """Without the initial states: by the complement of Schur, segment by segment."""
    n, size = theta.shape[2], elements.size
    count = left.shape[1]
    by_elements, by_first = np.zeros((count, n, size)), np.broadcast_to(np.eye(n), (count, n, n))
    gram, pull = np.zeros((size, size)), np.zeros(size)
    own, mixed, turned = np.zeros((count, n, n)), np.zeros((count, n, size)), np.zeros((count, n, 1))
    next_counted = 0
    for t in range(len(used) + 1):
        if t:
            step = steps.transition(theta, t - 1)
            by_elements, by_first = step @ by_elements, step @ by_first
            elements.add(by_elements, used[t - 1].reshape(count, -1))
        if t != counted[next_counted]:
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
    gram, pull = gram * np.outer(elements.unit, elements.unit), pull * elements.unit
    if not (np.isfinite(gram).all() and np.isfinite(pull).all()):
        return None
    diagonal = np.diagonal(gram).copy()
    return _Normal(
        gram,
        pull,
        np.maximum(diagonal, max(1e-12 * float(diagonal.max()), 1e-300)),
        solved[:, :, -1],
        solved[:, :, :-1],
    )
