"""The steady state and the scales of recordings whose signals file leaves them open."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.sampling.codes import codes
from uncertain_lti.signals.signal_map import Signal

STILL_SAMPLES = 10
"""A still stretch has at least this many samples."""
STILL_BAND = 0.05
"""In a still stretch every signal stays within this share of its own range; doubled until there is one."""


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
    is found), without `codes`. scale: the largest magnitude of the medians over all still stretches of all
    recordings, measured in recorded units, or the range (largest less least value) where that is 0, or 1 where the
    range is 0 too.

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
    left = []
    for j, signal in enumerate(signals):  # of a number that stands for none there is no steady state
        for code, count in codes(pooled[:, j]).items():
            left.append(f"{signal.name} {code:.9g} in {count}")
            for r in (pooled, *finite):
                r[r[:, j] == code, j] = np.nan
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
    if left:
        words += f", without samples that seem to stand for no value ({', '.join(left)})"
    magnitude = np.abs(medians).max(axis=0)
    scales = np.where(magnitude > 1e-9 * span, magnitude, span)
    scales = np.where(scales > 0, scales, 1.0)
    steady = [float(still[i]) if s.steady == "auto" else float(s.steady) for i, s in enumerate(signals)]
    scale = [float(scales[i]) if s.scale == "auto" else float(s.scale) for i, s in enumerate(signals)]
    return steady, scale, words
