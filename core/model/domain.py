"""Where a model applies: the steps and the ranges that its fit saw."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import Array


@dataclass(frozen=True)
class Sampling:
    """How samples were cut when the model was fitted, and what the steps were; times in s."""

    clock: str = ""
    clock_type: str = ""
    time: Mapping[str, str] = field(default_factory=dict)
    dt_median: float | None = None
    dt_min: float | None = None
    dt_max: float | None = None
    max_gap: float | None = None
    min_step: float = 0.0
    max_skew: float | None = None


@dataclass(frozen=True)
class Domain:
    """Normalised ranges of x (n,) and u (m,) seen in the fit; None where nothing was fitted."""

    x_min: Array
    x_max: Array
    u_min: Array
    u_max: Array

    def outside(self, x: ArrayLike, u: ArrayLike) -> NDArray[np.bool_]:
        """(...,): z = [x; u] leaves the box in some element."""
        x, u = np.asarray(x), np.asarray(u)
        left_x = ((x < self.x_min) | (x > self.x_max)).any(axis=-1)
        left_u = ((u < self.u_min) | (u > self.u_max)).any(axis=-1)
        return np.asarray(left_x | left_u)
