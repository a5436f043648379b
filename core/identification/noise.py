# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What the recordings themselves know of a state's next sample: a memory and its controls, or noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.identification.excitation import least_squares, successive, triangle
from uncertain_lti.identification.problem import Problem

NOISE = 0.5
"""A state of whose variance less than this share is predicted from one sample to the next moves like noise."""
_OWN = 0.3
"""Share of a mode's largest component from which on a state has part in the mode."""


@dataclass(frozen=True)
class Memory:
    """How well a state's own past predicts its next sample.

    `predicted` (n,): share of variance that least squares on the sample before and its control predicts one sample
    ahead; `fastest`: |1 - eigenvalue| of the fastest mode of the step that does not come from measurement noise; inf
    where too few samples follow one another.
    """

    predicted: Array
    fastest: float

    def like_noise(self, state: int) -> bool:
        """Whether the state moves like noise."""
        return bool(self.predicted[state] < NOISE)


def predicted(X: Array, U: Array, after: Array) -> Array:
    """Share of the variance that least squares on [X, U, 1] predicts.

    `X` (N, n): regressors; `U` (N, m): further regressors; `after` (N, k): targets; Returns (k,): at most 1; without
    the share that any regressor explains by chance, so that it can be negative.
    """
    design = np.vstack([X.T, U.T, np.ones(len(X))])
    design /= np.maximum(np.abs(design).max(axis=1), 1e-300)[:, None]
    reduced = triangle(np.vstack([design, after.T]))
    regressors, targets = np.split(np.arange(reduced.shape[1]), [len(design)])
    answer, rank = least_squares(reduced, regressors, targets, len(X))
    rest = reduced[:, targets] - reduced[:, regressors] @ answer
    total = ((after - after.mean(axis=0)) ** 2).sum(axis=0)
    freedom = max(len(X) - rank, 1)
    left = (rest**2).sum(axis=0) * (len(X) - 1) / freedom  # without the share that any regressor explains by chance
    return np.asarray(1.0 - left / np.maximum(total, 1e-300))


def memory(problem: Problem) -> Memory:
    """Memory of the states, estimated from a problem's own samples.

    Noise on a measured state makes least squares believe that it decays within a step. The sample before, as an
    instrument, carries the state and none of that noise; a mode is fast if both ways agree for a state that is
    predicted at all.
    """
    n, p = problem.n, problem.p
    share = predicted(problem.z[:, :n], problem.z[:, n:], problem.x_next)
    follows = successive(problem)
    if len(follows) < 20 * p:
        return Memory(share, np.inf)
    count, z = len(follows), problem.z_columns
    reduced = triangle(
        np.vstack([z[:, follows], z[:, follows + 1], np.ones(count), problem.next_columns[:, follows + 1]])
    )
    before, now, after = np.arange(p), np.arange(p, 2 * p + 1), np.arange(2 * p + 1, 2 * p + 1 + n)
    instruments = np.concatenate([before, now[n:]])
    projected = reduced[:, instruments] @ least_squares(reduced, instruments, now, count)[0]
    speeds = []
    for design in (reduced[:, now], projected):
        both = np.hstack([design, reduced[:, after]])
        found, _ = least_squares(both, np.arange(p + 1), np.arange(p + 1, p + 1 + n), count)
        values, vectors = np.linalg.eig(found[:n].T)
        parts = np.abs(vectors)
        seen = [(share[parts[:, j] >= _OWN * parts[:, j].max()] >= NOISE).all() for j in range(n)]
        speeds.append(float(np.max(np.abs(1.0 - values[seen]), initial=0.0)))
    return Memory(share, min(speeds))
