# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""OperatingPoint: the steady state and scales that make recorded quantities dimensionless deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import Array, numbers, on_cores, real
from uncertain_lti.base.errors import TransientError
from uncertain_lti.kernel.arithmetic import normalised_columns
from uncertain_lti.signals.signal_map import Signal

_PIECE = 100_000  # rows that one thread takes at a time


def normalised(value: Any, steady: Any, scale: Any) -> Any:
    """Deviation from the steady state, without dimension."""
    return (value - steady) / scale


def recorded(value: Any, steady: Any, scale: Any) -> Any:
    """Deviation in recorded units: the inverse of `normalised`."""
    return steady + scale * value


def normalise_columns(values: Array, k: NDArray[np.intp], steady: Array, scale: Array, out: Array) -> float:
    """Rows k (K,) of values (N, n), `normalised`, into columns (n, K), on all cores; the sum of their squares."""
    pieces = [slice(a, a + _PIECE) for a in range(0, len(k), _PIECE)]
    return sum(on_cores(normalised_columns, [(values, k[p], steady, scale, out[:, p]) for p in pieces]))


@dataclass(frozen=True)
class OperatingPoint:
    """Steady state and scales, in recorded units.

    x_i = (x_i^a - x_i^s) / X_i and u_j = (u_j^a - u_j^s) / U_j, with ^a what is recorded and ^s the steady state
    (Leibov 2006; docs/theory.md).

    Parameters
    ----------
    x_s : array (n,)
        Steady state of the states.
    u_s : array (m,)
        Steady state of the controls.
    X : array (n,)
        Positive scales of the states.
    U : array (m,)
        Positive scales of the controls.
    s_s : array (q,), optional
        Steady state of the further scheduling signals; default none.
    S : array (q,), optional
        Their positive scales; default none.

    Raises
    ------
    TransientError
        Shapes differ, a number is not finite, or a scale is not positive.
    """

    x_s: Array
    u_s: Array
    X: Array
    U: Array
    s_s: Array = field(default_factory=lambda: np.empty(0))
    S: Array = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        for name in ("x_s", "u_s", "X", "U", "s_s", "S"):
            try:
                value = np.atleast_1d(real(getattr(self, name)))
            except (TypeError, ValueError):
                raise TransientError(f"operating point: {name} must be a vector of real numbers") from None
            value.flags.writeable = False
            object.__setattr__(self, name, value)
            if value.ndim != 1 or not np.isfinite(value).all():
                raise TransientError(f"operating point: {name} must be a vector of finite numbers")
        for steady, scale in (("x_s", "X"), ("u_s", "U"), ("s_s", "S")):
            if getattr(self, steady).shape != getattr(self, scale).shape:
                raise TransientError(f"operating point: {steady} and {scale} differ in length")
            if not (getattr(self, scale) > 0).all():
                raise TransientError(f"operating point: every scale in {scale} must be positive")

    @classmethod
    def identity(cls, n: int, m: int) -> OperatingPoint:
        """Values used as they are.

        Parameters
        ----------
        n : int
            Number of states.
        m : int
            Number of controls.

        Returns
        -------
        OperatingPoint
            Steady states 0, scales 1.
        """
        return cls(np.zeros(n), np.zeros(m), np.ones(n), np.ones(m))

    @classmethod
    def of(
        cls, states: Sequence[Signal], controls: Sequence[Signal], scheduling: Sequence[Signal] = ()
    ) -> OperatingPoint:
        """From signals whose steady and scale are numbers.

        Parameters
        ----------
        states : sequence of Signal
            In the order of x.
        controls : sequence of Signal
            In the order of u.
        scheduling : sequence of Signal, optional
            Further scheduling signals.

        Returns
        -------
        OperatingPoint
            Their steady states and scales.

        Raises
        ------
        TransientError
            A steady state or a scale is still `auto`, or not what `OperatingPoint` takes.
        """

        for signal in (*states, *controls, *scheduling):
            for which in ("steady", "scale"):
                if getattr(signal, which) == "auto":
                    raise TransientError(f"signal '{signal.name}': {which} is auto and not resolved; give a number")
        groups = states, controls, scheduling
        x_s, u_s, s_s = (np.array([float(s.steady) for s in group]) for group in groups)
        X, U, S = (np.array([float(s.scale) for s in group]) for group in groups)
        return cls(x_s, u_s, X, U, s_s, S)

    @property
    def steady(self) -> Array:
        """Steady state of [x; u; s] (n + m + q,)."""
        return np.concatenate((self.x_s, self.u_s, self.s_s))

    @property
    def scale(self) -> Array:
        """Scales of [x; u; s] (n + m + q,)."""
        return np.concatenate((self.X, self.U, self.S))

    def normalise_x(self, x: ArrayLike) -> Array:
        """States as deviations.

        Parameters
        ----------
        x : array (..., n)
            Recorded units.

        Returns
        -------
        array (..., n)
            Dimensionless.
        """
        return np.asarray(normalised(numbers(x, "x", (..., len(self.x_s)), TransientError), self.x_s, self.X))

    def normalise_u(self, u: ArrayLike) -> Array:
        """Controls as deviations.

        Parameters
        ----------
        u : array (..., m)
            Recorded units.

        Returns
        -------
        array (..., m)
            Dimensionless.
        """
        return np.asarray(normalised(numbers(u, "u", (..., len(self.u_s)), TransientError), self.u_s, self.U))

    def scheduled_on(self, stays: Sequence[bool]) -> OperatingPoint:
        """The same point without some of the further scheduling signals.

        Parameters
        ----------
        stays : sequence of bool
            One per further scheduling signal.

        Returns
        -------
        OperatingPoint
            This one if all of them stay, or if it is not for as many.
        """
        if all(stays) or len(stays) != len(self.s_s):
            return self
        return OperatingPoint(self.x_s, self.u_s, self.X, self.U, self.s_s[list(stays)], self.S[list(stays)])

    def normalise_s(self, s: ArrayLike) -> Array:
        """Further scheduling signals as deviations.

        Parameters
        ----------
        s : array (..., q)
            Recorded units.

        Returns
        -------
        array (..., q)
            Dimensionless.
        """
        return np.asarray(normalised(numbers(s, "s", (..., len(self.s_s)), TransientError), self.s_s, self.S))

    def recorded_x(self, x: ArrayLike) -> Array:
        """State deviations in recorded units.

        Parameters
        ----------
        x : array (..., n)
            Dimensionless.

        Returns
        -------
        array (..., n)
            Recorded units.
        """
        return np.asarray(recorded(numbers(x, "x", (..., len(self.x_s)), TransientError), self.x_s, self.X))
