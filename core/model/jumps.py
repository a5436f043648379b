# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Jumps: the largest change of each state in one step of the recordings, and what is said of a larger one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.limits import LARGEST


def largest_steps(model: Any, found: Iterable[Any]) -> Array:
    """The largest change of each state in one transition (n,), normalised; `found`: of recordings, `repeats.Found`."""
    largest = np.max([np.zeros(model.n), *(one.largest for one in found)], axis=0)
    return np.asarray(np.minimum(largest / model.operating_point.X, LARGEST))


def jumps(model: Any, before: ArrayLike, after: ArrayLike) -> tuple[Array, Array]:
    """How far states moved in one step, where that is farther than ever in the fit.

    Returns (n,): the largest of the fit, recorded units; infinite where that is not known.
    """
    known = model.domain.step_max
    limit = np.full(model.n, np.inf) if known is None else known * model.operating_point.X
    with np.errstate(over="ignore", invalid="ignore"):
        change = np.asarray(after, dtype=np.float64) - np.asarray(before, dtype=np.float64)
    # the product with the scale rounds: what is as large as the largest of the fit is not larger
    return np.where(np.abs(change) > limit * (1.0 + 1e-9), change, 0.0), limit


def jump_words(name: str, change: float, largest: float) -> str:
    """What is said of a jump."""
    return f"{name} jumped by {change:.3g} in one step (at most {largest:.3g} in the fit)"


def jumps_in_words(model: Any, before: Sequence[float], after: Sequence[float], flags: Sequence[float]) -> list[str]:
    """What is said of the states that jumped out of their bounds."""
    if model.domain.step_max is None:
        return []
    change, limit = jumps(model, before[: model.n], after)
    rows = zip(model.state_names, change.tolist(), limit.tolist(), flags, strict=True)
    return [jump_words(name, by, most) for name, by, most, flag in rows if by and flag == 1.0]
