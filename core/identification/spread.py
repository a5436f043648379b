# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Whether residuals have one covariance in all regimes, as noise of readings has, or one relative to the half-width.

Compared is the likelihood of a distribution of Student's with few degrees of freedom: recordings far from the usual,
such as pulses, leave residuals many times as large, and by a normal distribution those few would decide.
"""

from __future__ import annotations

import numpy as np

from uncertain_lti.base.arrays import Array

_FREEDOM = 3.0
_ROUNDS = 15
_LIKELIER = 0.01
"""By so much the log-likelihood of a transition must be larger for the residual in place of the utilisation."""


def likelier_alone(residual: Array, half: Array) -> bool:
    """Whether one covariance of the residual describes it better than one of the utilisation.

    `residual` (K, n): of some transitions; `half` (K, n): their half-widths.
    """
    if not (half > 0.0).all() or len(residual) <= 2 * residual.shape[1]:
        return False
    alone, relative = _log_likelihood(residual), _log_likelihood(residual / half)
    return bool(alone > relative - np.log(half).sum(axis=1).mean() + _LIKELIER)


def _log_likelihood(values: Array) -> float:
    """Of a row, with the likeliest mean and scatter, but for a constant; -inf if the scatter is singular."""
    n = values.shape[1]
    weights = np.ones(len(values))
    for _ in range(_ROUNDS):
        centred = values - weights @ values / weights.sum()
        scatter = (centred * weights[:, None]).T @ centred / len(values)
        sign, logarithm = np.linalg.slogdet(scatter)
        if sign <= 0.0 or not np.isfinite(logarithm):
            return -np.inf
        distance = ((centred @ np.linalg.inv(scatter)) * centred).sum(axis=1)
        weights = (_FREEDOM + n) / (_FREEDOM + distance)
    return float(-0.5 * logarithm - 0.5 * (_FREEDOM + n) * np.log1p(distance / _FREEDOM).mean())
