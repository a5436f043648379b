"""Instants: whole nanoseconds, and the steps between them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

LONGEST_NS = 2**62
"""Longer than any recording; what is longer still counts as this."""


def to_ns(seconds: float) -> int:
    """Seconds to whole nanoseconds.

    Parameters
    ----------
    seconds : float
        Any, not finite included.

    Returns
    -------
    int
        `LONGEST_NS` at most.
    """
    return min(round(seconds * 1e9), LONGEST_NS) if math.isfinite(seconds) else LONGEST_NS


def median_step_ns(instants: Sequence[NDArray[np.int64]], min_step_ns: int = 0) -> int | None:
    """Median of the forward steps of clock instants over all recordings.

    Equal stamps and steps back do not count; an instant less than min_step_ns after the one before is passed over,
    as the sampler does.

    Parameters
    ----------
    instants : sequence of int array (messages,)
        Of each recording, ns.
    min_step_ns : int
        ns.

    Returns
    -------
    int or None
        ns; None if there is no step.
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
