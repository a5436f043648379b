# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Blocks of a recording, each left out with a guard interval on both sides."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from uncertain_lti.base.english import plural
from uncertain_lti.base.errors import FitError
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.sampling.transient import Transient

BLOCKS = 10
"""Parts that a single recording is cut into, by default."""


def cut(transient: Transient, start: int, stop: int) -> Transient:
    """Samples start..stop-1 as a transient of their own."""
    return transient.replace(slice(start, stop))


def block_spans(transient: Transient, blocks: int) -> list[tuple[int, int]]:
    """Contiguous blocks with equal numbers of usable transitions; neighbours share one sample."""
    usable = np.flatnonzero(transient.usable)
    if len(usable) < 2 * blocks:
        raise FitError(
            f"{transient.name}: {plural(len(usable), 'usable transition')} "
            f"{'is' if len(usable) == 1 else 'are'} too few for {plural(blocks, 'block')}; use fewer blocks, or "
            f"record longer"
        )
    edges = [int(part[0]) for part in np.array_split(usable, blocks)] + [int(usable[-1]) + 1]
    return [(a, b + 1) for a, b in zip(edges[:-1], edges[1:], strict=True)]


def guard_interval(model: UncertainLTI, cuts: Sequence[tuple[Transient, int, int]]) -> float:
    """Three of the slowest stable time constants of the model, at most half of the shortest block."""
    stable = [-v.real for v in model.eigenvalues().ravel() if v.real < 0]
    shortest = min(float(t.t[stop - 1] - t.t[start]) for t, start, stop in cuts)
    return min(3.0 / min(stable) if stable else math.inf, 0.5 * shortest)


def remaining_spans(transient: Transient, start: int, stop: int, gap: float) -> list[tuple[int, int]]:
    """What is left of a transient without a block and the guard intervals on both sides of it."""
    if (start, stop) == (0, len(transient)):
        return []
    t = transient.t
    before = int(np.count_nonzero(t[: start + 1] <= t[start] - gap))
    after = stop - 1 + int(np.count_nonzero(t[stop - 1 :] < t[stop - 1] + gap))
    return [(0, min(before, start + 1)), (min(after, len(t)), len(t))]
