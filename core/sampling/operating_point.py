"""OperatingPoint: the steady state and scales that make recorded quantities dimensionless deviations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import TransientError
from uncertain_lti.signals.signal_map import Signal

STILL_SAMPLES = 10
"""A still stretch has at least this many samples."""
STILL_BAND = 0.05
"""In a still stretch every signal stays within this share of its own range; doubled until there is one."""


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

    Raises
    ------
    TransientError
        Shapes differ, a number is not finite, or a scale is not positive.
    """

    x_s: Array
    u_s: Array
    X: Array
    U: Array

    def __post_init__(self) -> None:
        for name in ("x_s", "u_s", "X", "U"):
            value = np.array(getattr(self, name), dtype=np.float64, ndmin=1)
            value.flags.writeable = False
            object.__setattr__(self, name, value)
            if value.ndim != 1 or not np.isfinite(value).all():
                raise TransientError(f"operating point: {name} must be a vector of finite numbers")
        for steady, scale in (("x_s", "X"), ("u_s", "U")):
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
    def of(cls, states: Sequence[Signal], controls: Sequence[Signal]) -> OperatingPoint:
        """From signals whose steady and scale are numbers.

        Parameters
        ----------
        states : sequence of Signal
            In the order of x.
        controls : sequence of Signal
            In the order of u.

        Returns
        -------
        OperatingPoint
            Their steady states and scales.

        Raises
        ------
        TransientError
            A steady state or a scale is still `auto`, or not what `OperatingPoint` takes.
        """

        def numbers(signals: Sequence[Signal], which: str) -> Array:
            values = [getattr(s, which) for s in signals]
            if "auto" in values:
                name = signals[values.index("auto")].name
                raise TransientError(f"signal '{name}': {which} is auto and not resolved; give a number")
            return np.array(values, dtype=np.float64)

        return cls(
            numbers(states, "steady"),
            numbers(controls, "steady"),
            numbers(states, "scale"),
            numbers(controls, "scale"),
        )

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
        return (np.asarray(x, dtype=np.float64) - self.x_s) / self.X

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
        return (np.asarray(u, dtype=np.float64) - self.u_s) / self.U

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
        return self.x_s + self.X * np.asarray(x, dtype=np.float64)


def still_stretches(values: Array, span: Array, band: float = STILL_BAND) -> list[tuple[int, int]]:
    """Disjoint stretches [start, stop) in which every column stays within band x span.

    Greedy from the left: a stretch grows while the difference between its greatest and least value is at most
    band x span in every column, and counts from STILL_SAMPLES samples on. A value that is not finite ends it.

    Parameters
    ----------
    values : array (samples, signals)
        Recorded units.
    span : array (signals,)
        Range of each signal over all recordings.
    band : float, optional
        Share of the range; default STILL_BAND.

    Returns
    -------
    list of (int, int)
        First sample, and first sample after the stretch.
    """
    stretches = []
    start, stop, count = 0, 0, len(values)
    limit = band * span
    while start < count:
        low, high, stop = values[start].copy(), values[start].copy(), start
        while stop < count:
            block = values[stop : stop + 256]
            lows = np.minimum.accumulate(np.vstack([low, block]))[1:]
            highs = np.maximum.accumulate(np.vstack([high, block]))[1:]
            still = ((highs - lows) <= limit).all(axis=1)  # NaN compares false
            good = len(block) if still.all() else int(np.argmin(still))
            if good:
                low, high = lows[good - 1], highs[good - 1]
            stop += good
            if good < len(block):
                break
        if stop - start >= STILL_SAMPLES:
            stretches.append((start, stop))
        start = max(stop, start + 1)
    return stretches


def resolve_auto(signals: Sequence[Signal], recordings: Sequence[Array]) -> tuple[list[float], list[float], str]:
    """Numbers for steady and scale where a signal says auto, and the rule applied, in words.

    steady: median over the longest still stretch (see `still_stretches`; the band is doubled until a stretch
    is found). scale: the largest magnitude of the medians over all still stretches of all recordings, measured
    in recorded units, or the range (largest less least value) where that is 0, or 1 where the range is 0 too.

    Parameters
    ----------
    signals : sequence of Signal
        States, then controls.
    recordings : sequence of array (samples, signals)
        In recorded units.

    Returns
    -------
    list of float
        Steady state of each signal.
    list of float
        Scale of each signal.
    str
        The rule applied, in words.
    """
    finite = [np.where(np.isfinite(r), r, np.nan) for r in recordings]
    pooled = np.concatenate(finite)
    seen = np.isfinite(pooled).any(axis=0)
    span = np.zeros(len(signals))
    span[seen] = np.nanmax(pooled[:, seen], axis=0) - np.nanmin(pooled[:, seen], axis=0)
    band = STILL_BAND
    while True:
        found = [(r[a:b], b - a) for r in finite for a, b in still_stretches(r, span, band)]
        if found or band > 2.0:
            break
        band *= 2.0
    if found:
        medians = np.array([np.median(part, axis=0) for part, _ in found])
        longest = int(np.argmax([length for _, length in found]))
        still = medians[longest]
        words = f"{found[longest][1]} still samples (every signal within {band:.0%} of its range)"
    else:  # fewer than STILL_SAMPLES finite samples in a row
        still = np.zeros(len(signals))
        still[seen] = np.nanmedian(pooled[:, seen], axis=0)
        medians = still[None, :]
        words = "all samples (no still stretch)"
    magnitude = np.abs(medians).max(axis=0)
    scales = np.where(magnitude > 1e-9 * span, magnitude, span)
    scales = np.where(scales > 0, scales, 1.0)
    steady = [float(still[i]) if s.steady == "auto" else float(s.steady) for i, s in enumerate(signals)]
    scale = [float(scales[i]) if s.scale == "auto" else float(s.scale) for i, s in enumerate(signals)]
    return steady, scale, words
