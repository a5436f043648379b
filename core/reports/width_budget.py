# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What each element of a model adds to the width of its bounds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import ModelError
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.sampling.transient import Transient, Transitions

_AT_ONCE = 65536  # transitions


def width_budget(model: UncertainLTI, transients: Sequence[Transient]) -> tuple[Array, Array, list[str]]:
    """Which element contributes how much of the mean one-step width.

    Columns are states, controls, and what the model has of drift and noise. The elements of a scheduled model are those
    of its blocks, blended as in the bounds; a sample of a mode that is not listed has no width.

    Returns (n, columns): share of each column; a row of zeros where the width is 0; Returns (n,): mean width, recorded
    units.
    """
    additive = [(term, np.atleast_2d(half)) for term, _, half in model.additive()]
    blocks = len(model.blocks)
    total, count = np.zeros((blocks, model.n + model.m + len(additive))), 0
    for transient in transients:
        steps = transient.transitions()
        for start in range(0, len(steps.k), _AT_ONCE):
            weights, part = _weights(model, steps.take(_slice(len(steps.k), start)))
            count += len(part.dt)
            z = np.abs(model.normalised_columns(part)[: model.n + model.m])
            sums = [weights @ part.dt if term.times_dt else weights.sum(axis=1) for term, _ in additive]
            total += np.column_stack([(weights * part.dt) @ z.T, *sums])
    if not count:
        raise ModelError("no recording has a usable transition, so there is no width to share out")
    halves = [array.reshape(blocks, model.n, -1) for array in (model.dA, model.dB, *(half for _, half in additive))]
    parts = 2.0 * (np.concatenate(halves, axis=2) * (total / count)[:, None, :]).sum(axis=0)
    columns = [*model.state_names, *model.control_names]
    kept = list(range(model.n + model.m))
    for place, (term, half) in enumerate(additive, start=len(kept)):
        if half.any():
            kept.append(place)
            columns.append(term.word)
    width = parts.sum(axis=1)
    shares = np.divide(parts, width[:, None], out=np.zeros_like(parts), where=width[:, None] > 0)
    return shares[:, kept], width * model.operating_point.X, columns


def _slice(count: int, start: int) -> NDArray[np.bool_]:
    """Which of some transitions are among `_AT_ONCE` from one on."""
    place = np.arange(count)
    return (start <= place) & (place < start + _AT_ONCE)


def _weights(model: UncertainLTI, steps: Transitions) -> tuple[Array, Transitions]:
    """Weights (blocks, K) of those transitions that have a block, and these."""
    if model.schedule is None:
        return np.ones((1, len(steps.dt))), steps
    weights = model.schedule.weights(model.normalised_columns(steps)[list(model.scheduling_positions)])
    listed = ~np.isnan(weights[0])
    return weights[:, listed], steps.take(listed)
