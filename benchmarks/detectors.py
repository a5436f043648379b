# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Detectors that the benchmark of detection compares: a score per sample of many recordings, larger means less healthy.

All take recordings as arrays: x (R, T, n), u (R, T, m) and dt (R, T-1), R recordings of one length; a score is (R, T),
-inf where there is none. What a detector learns, it learns from the fitted recordings alone; its threshold is learnt
elsewhere, for all in the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import solve_discrete_are
from scipy.signal import lfilter

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Runs:
    """Recordings of one length."""

    x: Array
    u: Array
    dt: Array

    @property
    def z(self) -> Array:
        """[x u], (R, T, n + m)."""
        return np.concatenate([self.x, self.u], axis=2)


Residuals = Callable[[Runs], Array]
"""(R, T-1, n): of the arrivals at samples 1..T-1."""
Score = Callable[[Runs], Array]


# --- models: residuals ---


@dataclass(frozen=True)
class LeastSquares:
    """x_next - x = Δt [x u 1] theta, one law for all regimes: what least squares gives."""

    theta: Array

    @classmethod
    def of(cls, fitted: Iterable[Runs]) -> LeastSquares:
        """Fit one law."""
        phi, target = [], []
        for runs in fitted:
            phi.append(cls._phi(runs.x[:, :-1], runs.u[:, :-1], runs.dt).reshape(-1, runs.z.shape[2] + 1))
            target.append(np.diff(runs.x, axis=1).reshape(-1, runs.x.shape[2]))
        return cls(np.linalg.lstsq(np.vstack(phi), np.vstack(target), rcond=None)[0])

    @staticmethod
    def _phi(x: Array, u: Array, dt: Array) -> Array:
        return np.concatenate([x, u, np.ones((*x.shape[:-1], 1))], axis=-1) * dt[..., None]

    def step(self, x: Array, u: Array, dt: Array) -> Array:
        """The next state from x (..., n), u (..., m) after dt (...)."""
        return x + self._phi(x, u, dt) @ self.theta

    def __call__(self, runs: Runs) -> Array:
        """One-step residuals."""
        return runs.x[:, 1:] - self.step(runs.x[:, :-1], runs.u[:, :-1], runs.dt)


@dataclass(frozen=True)
class Kalman:
    """Innovations of the stationary Kalman filter of a least-squares model."""

    law: LeastSquares
    gain: Array

    @classmethod
    def of(cls, fitted: Sequence[Runs], law: LeastSquares, process: float, sensors: float) -> Kalman:
        """Covariances of process and sensors are these shares of that of the residuals; of the sensors its diagonal."""
        n = fitted[0].x.shape[2]
        A = np.eye(n) + median_step(fitted) * law.theta[:n].T
        spread = np.cov(np.concatenate([law(r).reshape(-1, n) for r in fitted]).T)
        R = sensors * np.diag(np.diag(spread))
        P = solve_discrete_are(A.T, np.eye(n), process * spread, R)
        return cls(law, P @ np.linalg.inv(P + R))

    @classmethod
    def likeliest(cls, fitted: Sequence[Runs], law: LeastSquares) -> Kalman:
        """Of some shares, those that make the fitted recordings likeliest."""
        n = fitted[0].x.shape[2]

        def surprise(found: Kalman) -> float:
            innovations = np.concatenate([found(r).reshape(-1, n) for r in fitted])
            return float(np.linalg.slogdet(np.cov(innovations.T))[1])

        shares = [(p, s) for p in (1e-4, 1e-3, 1e-2, 0.1, 1.0) for s in (0.01, 0.1, 0.5)]
        return min((cls.of(fitted, law, *share) for share in shares), key=surprise)

    def __call__(self, runs: Runs) -> Array:
        """Innovations; the filter starts from the first reading."""
        x, found = runs.x[:, 0], np.empty_like(runs.x[:, 1:])
        for k in range(found.shape[1]):
            expected = self.law.step(x, runs.u[:, k], runs.dt[:, k])
            found[:, k] = runs.x[:, k + 1] - expected
            x = expected + found[:, k] @ self.gain.T
        return found


# --- statistics of residuals ---


def padded(scores: Array, samples: int) -> Array:
    """Scores (R, K) of the last K samples, as (R, samples)."""
    return np.concatenate([np.full((len(scores), samples - scores.shape[1]), -np.inf), scores], axis=1)


def window_mean(values: Array, window: int) -> Array:
    """Mean over the last `window` along axis 1; what lies before the start counts as 0."""
    total = np.concatenate([np.zeros_like(values[:, :1]), np.cumsum(values, axis=1)], axis=1)
    ends = np.arange(1, total.shape[1])
    return (total[:, ends] - total[:, np.maximum(ends - window, 0)]) / window


def of_window(values: Array, violations: int, window: int) -> Array:
    """The violations-th largest of the last `window` values (R, K)."""
    before = np.full((len(values), window - 1), -np.inf)
    recent = sliding_window_view(np.concatenate([before, values], axis=1), window, axis=1)
    where = window - violations
    return np.concatenate(
        [np.partition(recent[i : i + 50], where, axis=2)[:, :, where] for i in range(0, len(recent), 50)]
    )


def cusum(values: Array, slack: float) -> Array:
    """Two-sided cumulative sums of standardised values (R, K, n): the largest."""
    up, down, found = np.zeros(values[:, 0].shape), np.zeros(values[:, 0].shape), np.empty(values.shape[:2])
    for k in range(values.shape[1]):
        up = np.maximum(0.0, up + values[:, k] - slack)
        down = np.maximum(0.0, down - values[:, k] - slack)
        found[:, k] = np.maximum(up, down).max(axis=1)
    return found


def squared(values: Array, inverse: Array) -> Array:
    """v' C^-1 v of values (R, K, n)."""
    found: Array = np.einsum("rki,ij,rkj->rk", values, inverse, values, optimize=True)
    return found


@dataclass(frozen=True)
class Statistic:
    """What is made of residuals.

    Parameters
    ----------
    kind : {"3 sigma", "chi2", "CUSUM", "MEWMA"}
        The statistic.
    number : float
        Window of chi2, s, 0 for one sample; slack of CUSUM, in deviations; weight of the newest sample in MEWMA.
    """

    kind: str
    number: float = 0.0

    @property
    def name(self) -> str:
        """As tables call it."""
        if self.kind == "chi2" and self.number:
            return f"chi2 {self.number * 1e6:g} µs" if self.number < 1e-3 else f"chi2 {self.number:g} s"
        if self.kind == "chi2":
            return self.kind
        return self.kind if self.kind == "3 sigma" else f"{self.kind} {self.number:g}"


def residual_detectors(
    residuals: Residuals, fitted: Sequence[Runs], statistics: Sequence[Statistic]
) -> dict[str, Score]:
    """The usual statistics of residuals, with the mean and covariance of the fitted recordings.

    Parameters
    ----------
    residuals : callable
        Residuals of recordings; of one object they are computed once.
    fitted : sequence of Runs
        What mean and covariance are taken from.
    statistics : sequence of Statistic
        Which.

    Returns
    -------
    dict
        Score of each.
    """
    healthy = np.concatenate([(r := residuals(runs)).reshape(-1, r.shape[2]) for runs in fitted])
    mean, deviation = healthy.mean(axis=0), healthy.std(axis=0)
    inverse = np.linalg.inv(np.cov(healthy.T))
    step = median_step(fitted)
    kept: dict[int, tuple[Runs, Array]] = {}

    def centred(runs: Runs) -> Array:
        if id(runs) not in kept:
            kept[id(runs)] = (runs, residuals(runs) - mean)
        return kept[id(runs)][1]

    def score(statistic: Statistic) -> Score:
        def of(runs: Runs) -> Array:
            r, number = centred(runs), statistic.number
            if statistic.kind == "3 sigma":
                found = np.abs(r / deviation).max(axis=2)
            elif statistic.kind == "chi2":
                found = window_mean(squared(r, inverse), max(1, round(number / step)))
            elif statistic.kind == "CUSUM":
                found = cusum(r / deviation, number)
            else:
                found = squared(lfilter([number], [1.0, number - 1.0], r, axis=1), inverse)
            return padded(found, runs.x.shape[1])

        return of

    return {statistic.name: score(statistic) for statistic in statistics}


def median_step(fitted: Sequence[Runs]) -> float:
    """Median Δt, s."""
    return float(np.median(np.concatenate([runs.dt.ravel() for runs in fitted])))


# --- detectors on [x u] ---


def hotelling(fitted: Sequence[Runs]) -> Score:
    """Hotelling's T2 of [x u]."""
    z = np.concatenate([runs.z.reshape(-1, runs.z.shape[2]) for runs in fitted])
    mean, inverse = z.mean(axis=0), np.linalg.pinv(np.cov(z.T))
    return lambda runs: squared(runs.z - mean, inverse)


WINDOW = 10
"""Samples of the windows of [x u]."""


def principal_components(fitted: Sequence[Runs], share: float) -> Score:
    """Squared prediction error of windows of [x u] behind the principal components of that share of the variance."""
    z = np.concatenate([runs.z.reshape(-1, runs.z.shape[2]) for runs in fitted])
    mean, deviation = z.mean(axis=0), z.std(axis=0)

    def windows(values: Array) -> Array:
        seen = sliding_window_view((values - mean) / deviation, WINDOW, axis=1)
        return seen.reshape(*seen.shape[:2], -1)

    seen = np.concatenate([(w := windows(runs.z)).reshape(-1, w.shape[2]) for runs in fitted])
    variance, axes = np.linalg.eigh(np.cov(seen.T))
    kept = int(np.searchsorted(np.cumsum(variance[::-1]) / variance.sum(), share)) + 1
    axes = axes[:, ::-1][:, :kept]

    def score(runs: Runs) -> Array:
        z, found = runs.z, []
        for i in range(0, len(z), 50):
            w = windows(z[i : i + 50])
            found.append((w**2).sum(axis=2) - ((w @ axes) ** 2).sum(axis=2))
        return padded(np.concatenate(found), z.shape[1])

    return score
