"""Where a model applies: the steps and the ranges that its fit saw."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import Array


@dataclass(frozen=True)
class Sampling:
    """How samples were cut when the model was fitted, and what the steps were.

    Parameters
    ----------
    clock : str, default ""
        Topic whose messages define the sample instants; empty for arrays.
    clock_type : str, default ""
        Its message type.
    time : mapping of str to {"header", "log"}, optional
        Per topic, what its instant is.
    dt_median : float or None, optional
        Median step, s; None where nothing was fitted.
    dt_min : float or None, optional
        Shortest step, s; likewise.
    dt_max : float or None, optional
        Longest step, s; likewise.
    max_gap : float or None, optional
        Longest step that is a transition, s; None for no limit.
    min_step : float, default 0.0
        Shortest step, s; a message sooner than that is dropped.
    max_skew : float or None, optional
        Greatest age of a state from another topic than the clock, s; None for `max_gap`.
    """

    clock: str = ""
    clock_type: str = ""
    time: Mapping[str, str] = field(default_factory=dict)
    dt_median: float | None = None
    dt_min: float | None = None
    dt_max: float | None = None
    max_gap: float | None = None
    min_step: float = 0.0
    max_skew: float | None = None

    @property
    def step_range(self) -> tuple[float, float]:
        """Shortest and longest step that is judged, s: half of and twice those that the model was fitted to."""
        least = 0.0 if self.dt_min is None else 0.5 * self.dt_min
        return least, np.inf if self.dt_max is None else 2.0 * self.dt_max


@dataclass(frozen=True)
class Domain:
    """Normalised ranges seen in the fit; without end where nothing was fitted.

    Parameters
    ----------
    x_min : array (n,)
        Least states.
    x_max : array (n,)
        Greatest states.
    u_min : array (m,)
        Least controls.
    u_max : array (m,)
        Greatest controls.
    """

    x_min: Array
    x_max: Array
    u_min: Array
    u_max: Array

    def outside(self, x: ArrayLike, u: ArrayLike) -> NDArray[np.bool_]:
        """Whether z = [x; u] leaves the box in some element.

        Parameters
        ----------
        x : array (..., n)
            Normalised states.
        u : array (..., m)
            Normalised controls.

        Returns
        -------
        array (...) of bool
            False where nothing was fitted.
        """
        x, u = np.asarray(x), np.asarray(u)
        left_x = ((x < self.x_min) | (x > self.x_max)).any(axis=-1)
        left_u = ((u < self.u_min) | (u > self.u_max)).any(axis=-1)
        return np.asarray(left_x | left_u)
