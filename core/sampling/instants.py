# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Instants: whole nanoseconds, and the steps between them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

LONGEST_NS = 2**62
"""Longer than any recording; what is longer still counts as this."""


def to_ns(seconds: float) -> int:
    """Seconds to whole nanoseconds."""
    if abs(seconds) < LONGEST_NS * 1e-9:
        return round(seconds * 1e9)
    return -LONGEST_NS if math.isfinite(seconds) and seconds < 0 else LONGEST_NS


def median_step_ns(instants: Sequence[NDArray[np.int64]], min_step_ns: int = 0) -> int | None:
    """Median of the forward steps of clock instants over all recordings.

    Equal stamps and steps back do not count; an instant less than min_step_ns after the one before is passed over,
    as the sampler does.

    `instants` (messages,): of each recording, ns.
    """
    pooled = np.concatenate([np.empty(0, np.int64), *(_forward_steps(i, min_step_ns) for i in instants)])
    return int(np.median(pooled)) if pooled.size else None


def _forward_steps(instants: NDArray[np.int64], min_step_ns: int) -> NDArray[np.int64]:
    steps = np.diff(instants)
    forward = steps[steps > 0]
    if (forward >= min_step_ns).all():
        return forward
    longer = []
    last = int(instants[0])
    for instant in instants.tolist()[1:]:
        if instant - last >= min_step_ns:
            longer.append(instant - last)
        elif instant >= last:
            continue
        last = instant
    return np.array(longer, dtype=np.int64)


def period_ns(instants: Sequence[NDArray[np.int64]], min_step_ns: int = 0) -> int | None:
    """Period of a clock that samples evenly, whatever its stamps do, over all recordings.

    The median of the time that 100 samples take (fewer of short recordings), divided by their number: a stamp that is
    late, or a sample that is lost, changes few of these.

    `instants` (messages,): of each recording, ns.
    """
    steps = [_forward_steps(i, min_step_ns) for i in instants]
    longest = max((len(s) for s in steps), default=0)
    if not longest:
        return None
    over = max(1, min(100, longest // 4))
    times = [np.concatenate([np.zeros(1, np.int64), np.cumsum(s)]) for s in steps]
    return max(1, round(float(np.median(np.concatenate([t[over:] - t[:-over] for t in times]))) / over))
