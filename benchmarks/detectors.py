# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Detectors of process monitoring: each learns from healthy rows, and gives a score per row, larger is less healthy.

A recording is an array (T, p), a row per sample; a score is (T,), -inf while a window is not full. What a detector
learns, it learns from the healthy recordings alone; its threshold is learnt elsewhere, for all in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import lu_factor, lu_solve
from scipy.special import fdtri, ndtri  # scipy.stats and scipy.signal take a second to import

Array = np.ndarray
Score = Callable[[Array], Array]
Learn = Callable[[Sequence[Array]], Score]

COMPONENTS, ORDER = 9, 29
"""Principal components (of 33 signals, as by parallel analysis), and states of canonical variates, at most."""
WINDOWS = (10, 30)
"""Rows over which each score is averaged, too: those of the panel."""


def lagged(rows: Array, lags: int) -> Array:
    """Rows (T, p) as (T - lags, p (lags + 1)), the newest first."""
    return sliding_window_view(rows, lags + 1, axis=0)[..., ::-1].transpose(0, 2, 1).reshape(len(rows) - lags, -1)


def padded(score: Array, rows: int) -> Array:
    """A score of the last rows as one of all."""
    return np.concatenate([np.full(rows - len(score), -np.inf), score])


def averaged(score: Score, window: int) -> Score:
    """The mean over the last rows."""

    def of(rows: Array) -> Array:
        found = score(rows)
        start = int(np.isneginf(found).sum())
        if len(found) - start < window:
            return np.full(len(found), -np.inf)
        return padded(sliding_window_view(found[start:], window).mean(axis=1), len(rows))

    return of


def scaling(healthy: Sequence[Array]) -> tuple[Array, Array]:
    """Mean and deviation of each column; a column that never moves keeps its unit."""
    rows = np.concatenate(list(healthy))
    deviation = rows.std(axis=0)
    return rows.mean(axis=0), np.where(deviation > 1e-9 * np.abs(rows).max(axis=0), deviation, 1.0)


def root(covariance: Array, power: float) -> Array:
    """A power of a covariance; directions that hardly vary count as constant."""
    values, axes = np.linalg.eigh(covariance)
    kept = values > 1e-8 * values[-1]
    return np.asarray((axes[:, kept] * values[kept] ** power) @ axes[:, kept].T)


def principal(healthy: Sequence[Array], lags: int = 0, residual: bool = True) -> Score:
    """PCA (without lags) and DPCA: Hotelling's T2 in the components, or the squared prediction error beside them."""
    mean, deviation = scaling(healthy)
    z = np.concatenate([lagged((rows - mean) / deviation, lags) for rows in healthy])
    values, axes = np.linalg.eigh(np.cov(z.T))
    kept = min(COMPONENTS * (lags + 1), int((values > 1e-8 * values[-1]).sum()) * 3 // 4)
    values, axes = values[::-1][:kept], axes[:, ::-1][:, :kept]

    def of(rows: Array) -> Array:
        seen = lagged((rows - mean) / deviation, lags)
        parts = seen @ axes
        found = (seen**2).sum(axis=1) - (parts**2).sum(axis=1) if residual else (parts**2 / values).sum(axis=1)
        return padded(found, len(rows))

    return of


def canonical(healthy: Sequence[Array], lags: int = 2) -> Score:
    """CVA: the part of the whitened past that says nothing about the future (T2 of the residual space)."""
    mean, deviation = scaling(healthy)
    past, future = [], []
    for rows in healthy:
        seen = lagged((rows - mean) / deviation, lags - 1)
        past.append(seen[:-lags])
        future.append(seen[lags:])
    p, f = np.concatenate(past), np.concatenate(future)
    joint = np.cov(np.hstack([p, f]).T)
    size = p.shape[1]
    white = root(joint[:size, :size], -0.5)
    canonical_axes = np.linalg.svd(white @ joint[:size, size:] @ root(joint[size:, size:], -0.5))[0]
    J = canonical_axes[:, min(ORDER, size // 2) :].T @ white

    def of(rows: Array) -> Array:
        return padded(((lagged((rows - mean) / deviation, lags - 1) @ J.T) ** 2).sum(axis=1), len(rows))

    return of


def least_squares(healthy: Sequence[Array], n: int, fading: float = 1.0) -> Score:
    """Chi-square of the one-step residuals of x_next = [x u 1] theta, of one sample or faded (MEWMA)."""
    from scipy.signal import lfilter

    mean, deviation = scaling(healthy)

    def split(rows: Array) -> tuple[Array, Array]:
        z = (rows - mean) / deviation
        return np.column_stack([z[:-1], np.ones(len(z) - 1)]), z[1:, :n]

    parts = [split(rows) for rows in healthy]
    theta = np.linalg.lstsq(np.concatenate([a for a, _ in parts]), np.concatenate([b for _, b in parts]), rcond=None)[0]
    left = np.concatenate([b - a @ theta for a, b in parts])
    offset, inverse = left.mean(axis=0), np.linalg.pinv(np.atleast_2d(np.cov(left.T)))

    def of(rows: Array) -> Array:
        a, b = split(rows)
        r = lfilter([fading], [1.0, fading - 1.0], b - a @ theta - offset, axis=0)
        return padded(np.einsum("ki,ij,kj->k", r, inverse, r), len(rows))

    return of


DETECTORS: dict[str, Learn] = {
    "PCA T2": partial(principal, residual=False),
    "PCA SPE": principal,
    "DPCA SPE, 2 lags": partial(principal, lags=2),
    "CVA residual, 2 lags": canonical,
    "CVA residual, 5 lags": partial(canonical, lags=5),
}


# --- rules of SKAB's repository, with its own settings: healthy rows to the alarms of others ---


def rolling(values: Array, window: int) -> Array:
    """Median of the last values; NaN while there are fewer."""
    found = np.full(len(values), np.nan)
    found[window - 1 :] = np.median(sliding_window_view(values, window), axis=1)
    return found


def limit_of_t2(components: int, count: int, p: float = 0.999) -> float:
    """Upper control limit of Hotelling's T2."""
    factor = components * (count - 1) * (count + 1) / (count * (count - components))
    return float(factor * fdtri(components, count - components, p))


def t2(healthy: Array) -> Callable[[Array], Array]:
    """T2 of all signals: median of 5 over twice its limit."""
    mean, deviation = scaling([healthy])
    inverse = np.linalg.inv(np.cov(((healthy - mean) / deviation).T))
    limit = 2 * limit_of_t2(healthy.shape[1], len(healthy))

    def of(rows: Array) -> Array:
        z = (rows - mean) / deviation
        return np.asarray(rolling(np.einsum("ki,ij,kj->k", z, inverse, z), 5) > limit)

    return of


def t2_and_q(healthy: Array) -> Callable[[Array], Array]:
    """T2 in the components of 85 % of the variance, or Q beside them: medians of 5 over their limits."""
    mean, deviation = scaling([healthy])
    z = (healthy - mean) / deviation
    covariance = np.cov(z.T)
    values, axes = np.linalg.eigh(covariance)
    values, axes = values[::-1], axes[:, ::-1]
    kept = int(np.searchsorted(np.cumsum(values) / values.sum(), 0.85)) + 1
    left = float(np.linalg.eigvals(covariance)[kept:].sum())  # in the order of LAPACK, as there
    h = 1 - 2 * left * left**3 / (3 * left**4)
    terms = 1 + ndtri(0.999) * h * math.sqrt(2 * left**2) / left + left**2 * h * (h - 1) / left**2
    limits = limit_of_t2(kept, len(healthy)), left * terms ** (1 / h)

    def of(rows: Array) -> Array:
        z = (rows - mean) / deviation
        parts = z @ axes[:, :kept]
        q = (z**2).sum(axis=1) - (parts**2).sum(axis=1)
        return np.asarray(
            (rolling((parts**2 / values[:kept]).sum(axis=1), 5) > limits[0]) | (rolling(q, 5) > limits[1])
        )

    return of


def mset(healthy: Array) -> Callable[[Array], Array]:
    """Multivariate state estimation: relative error of the estimate, centred mean of 60, over 0.01."""
    mean, deviation = scaling([healthy])
    known = (healthy - mean) / deviation

    def likeness(a: Array, b: Array) -> Array:
        apart = np.linalg.norm(a[:, None] - b[None], axis=2)
        sizes = np.linalg.norm(a, axis=1)[:, None] + np.linalg.norm(b, axis=1)[None]
        return np.asarray(1 - apart / sizes)

    factors = lu_factor(likeness(known, known))

    def of(rows: Array) -> Array:
        weights = lu_solve(factors, likeness(known, (rows - mean) / deviation))
        estimate = (known.T @ weights).T * deviation + mean
        error = np.linalg.norm(rows - estimate, axis=1) / np.linalg.norm(estimate, axis=1)
        total = np.concatenate([[0.0], np.cumsum(error)])
        ends = np.arange(len(rows)) + 30
        last, start = np.minimum(ends, len(rows)), np.maximum(ends - 60, 0)
        return np.asarray((total[last] - total[start]) / (last - start) > 0.01)

    return of


SKAB_RULES: dict[str, Callable[[Array], Callable[[Array], Array]]] = {
    "T2, as its repository": t2,
    "T2+Q, as its repository": t2_and_q,
    "MSET, as its repository": mset,
}
