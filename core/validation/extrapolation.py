# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Extrapolation: how far a sample lies from those that a model was fitted to.

A model that was fitted without a rare event says nothing of how the model of all recordings bounds it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.sampling.transient import Transient, Transitions

BEYOND, FAR = (0.1, 2.0), (1.0, 10.0)
"""Share of the range of a signal beyond it, and multiple of the largest leverage of the fit, from which on a sample is
beyond what was fitted, or far beyond."""
_SAME = 1e-12
_MOST = 200_000  # transitions that the leverage is made from, about


class Reach:
    """What a fit saw of the normalised [x; u; s]: ranges, and leverages z' (Σ z z')^-1 z with z = [x; u; 1]."""

    def __init__(self, model: UncertainLTI, transients: Sequence[Transient]) -> None:
        self._model = model
        every = np.concatenate([self._rows(t.transitions()) for t in transients])
        self._low, self._high = every.min(axis=0), every.max(axis=0)
        some = self._lever(every[:: max(1, len(every) // _MOST)])
        self._scale = np.maximum(np.abs(some).max(axis=0), 1e-300)
        scaled = some / self._scale
        self._inverse = np.linalg.pinv(scaled.T @ scaled, rcond=_SAME, hermitian=True)
        self._largest = float(self._leverage(some).max())

    def _rows(self, steps: Transitions) -> Array:
        return np.ascontiguousarray(self._model.normalised_columns(steps).T)

    def _lever(self, rows: Array) -> Array:
        return np.hstack([rows[:, : self._model.n + self._model.m], np.ones((len(rows), 1))])

    def _leverage(self, lever: Array) -> Array:
        scaled = lever / self._scale
        return np.asarray(np.einsum("ki,ki->k", scaled @ self._inverse, scaled))

    def level(self, steps: Transitions) -> NDArray[np.intp]:
        """(K,): 0 where a transition begins within what was fitted, 1 beyond it, 2 far beyond."""
        rows = self._rows(steps)
        found = np.zeros(len(rows), dtype=np.intp)
        if not len(rows):
            return found
        span, leverage = self._high - self._low, self._leverage(self._lever(rows))
        for level, (share, times) in enumerate((BEYOND, FAR), start=1):
            edge = share * span + _SAME * np.maximum(np.abs(self._low), np.abs(self._high))
            beyond = ((rows < self._low - edge) | (rows > self._high + edge)).any(axis=1)
            found[beyond | (leverage > times * self._largest)] = level
        return found
