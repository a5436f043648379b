# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Confidence intervals for what was counted on whole transients, whose samples depend on one another."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from uncertain_lti.base.arrays import Array


def cluster_size(counts: ArrayLike) -> float:
    """Σc² / Σc of the events c_g counted on transient g: how many come at once, weighted by events; 1 without any.

    `counts` (G,): events on each transient.
    """
    c = np.asarray(counts, dtype=np.float64)
    return float(np.sum(c**2) / np.sum(c)) if c.any() else 1.0


def rate_interval(
    counts: ArrayLike, exposure: float, confidence: float, size: float | None = None, *, one_sided: bool = False
) -> tuple[float, float]:
    """Interval for the expected number of events per unit of exposure.

    Events of one transient come in clusters; clusters of different transients are independent (a compound Poisson
    count). The total then varies as `size` times a Poisson count of total / size, for which the exact (Garwood)
    limits hold. As `size` is estimated from G transients, the tails are those of Student's t with G - 1 degrees of
    freedom in place of the normal's.

    `counts` (G,): events on each transient.
    """
    from scipy.special import gammainccinv, gammaincinv, ndtr, stdtrit

    c = np.asarray(counts, dtype=np.float64)
    if len(c) < 2 or exposure <= 0:
        return 0.0, math.inf
    tail = 1.0 - confidence if one_sided else (1.0 - confidence) / 2.0
    tail = float(ndtr(stdtrit(len(c) - 1, tail)))
    size = max(cluster_size(c), size or 1.0)
    clusters = float(c.sum()) / size
    lower = float(gammaincinv(clusters, tail)) * size / exposure if clusters and not one_sided else 0.0
    return lower, float(gammainccinv(clusters + 1.0, tail)) * size / exposure


def share_interval(hits: int, trials: int, confidence: float) -> tuple[float, float]:
    """Exact binomial (Clopper-Pearson) interval for the share of whole transients."""
    return _binomial_limits(hits, trials - hits, (1.0 - confidence) / 2.0)


def _binomial_limits(yes: float, no: float, tail: float) -> tuple[float, float]:
    """Clopper and Pearson's limits of a share, with this probability beyond each; `yes` and `no` need not be whole."""
    from scipy.special import betainccinv, betaincinv  # scipy.stats takes a second to import

    low = float(betaincinv(yes, no + 1.0, tail)) if yes > 0 else 0.0
    high = float(betainccinv(yes + 1.0, no, tail)) if no > 0 else 1.0
    return low, high


def quantile_share_interval(
    units: ArrayLike, hits: ArrayLike, confidence: float, share: float | None = None
) -> tuple[float, tuple[float, float]]:
    """Interval for a share of cases that come in clusters: recordings or groups.

    The exact binomial (Clopper-Pearson) limits with as many independent cases as the clusters are worth: the cases over
    the design effect, the variance of the clusters' totals over that of independent cases (at least 1). As it is
    estimated from G clusters, the tails are those of Student's t with G - 1 degrees of freedom.

    `units` (N,): cluster of each case; `hits` (N,): whether it has the property.
    """
    from scipy.special import ndtr, stdtrit

    unit, hit = np.asarray(units), np.asarray(hits, dtype=np.float64)
    total, found = len(hit), float(hit.mean()) if len(hit) else math.nan
    middle = found if share is None else share
    G = len(np.unique(unit))
    if G < 2 or not 0.0 <= middle <= 1.0:
        return found, (0.0, 1.0)
    residuals = np.array([float((hit[unit == g] - found).sum()) for g in np.unique(unit)])
    variance = total * found * (1.0 - found)
    effect = max(1.0, float(np.sum(residuals**2)) * G / (G - 1) / variance) if variance > 0 else 1.0
    worth = total / effect
    tail = float(ndtr(stdtrit(G - 1, (1.0 - confidence) / 2.0)))
    return found, _binomial_limits(middle * worth, (1.0 - middle) * worth, tail)


def scenario_interval(support: int, transients: int, confidence: float) -> tuple[float, float]:
    """Interval for the probability that a fresh whole transient leaves the envelope of this very model.

    Garatti and Campi, "Risk and complexity in scenario optimization" (Mathematical Programming 191, 2022), theorem 2:
    with N transients drawn independently from one distribution and a convex problem whose objective does not depend on
    them and whose solution is unique and not degenerate, of which `support` transients would change the solution if
    left out, the probability lies in [1 - t_2, 1 - t_1] with at least this confidence, whatever the distribution.
    t_1 < t_2 are the roots of

        C(N,k) t^(N-k) - β/2N Σ_{i=k}^{N-1} C(i,k) t^(i-k) - β/6N Σ_{i=N+1}^{4N} C(i,k) t^(i-k) = 0,

    k = support, β = 1 - confidence.
    """
    from scipy.optimize import brentq
    from scipy.special import gammaln, logsumexp

    N, k, b = transients, support, 1.0 - confidence
    low, high = np.arange(k, N), np.arange(N + 1, 4 * N + 1)

    def choose(i: ArrayLike) -> Array:
        i = np.asarray(i, dtype=np.float64)
        return np.asarray(gammaln(i + 1) - gammaln(i - k + 1) - gammaln(k + 1))

    def excess(s: float) -> float:
        """log of the two sums less log of the first term, at t = e^s: 0 at the roots, negative between them."""
        sums = [math.log(b / (6 * N)) + float(logsumexp(choose(high) + (high - k) * s))]
        if len(low):
            sums.append(math.log(b / (2 * N)) + float(logsumexp(choose(low) + (low - k) * s)))
        return float(logsumexp(sums)) - float(choose(N)) - (N - k) * s

    if k == N:
        root = brentq(excess, -60.0, 10.0) if excess(-60.0) < 0 < excess(10.0) else 0.0
        return max(0.0, 1.0 - math.exp(root)), 1.0
    centre = math.log(1.0 - k / N)  # the stretch of log t where the excess is negative holds 1 - k/N
    below, above = centre - 1.0, centre + 1.0
    while excess(below) < 0:
        below -= 5.0
    while excess(above) < 0:
        above += 1.0
    t1, t2 = math.exp(brentq(excess, below, centre)), math.exp(brentq(excess, centre, above))
    return max(0.0, 1.0 - t2), 1.0 - t1


def discarding_bound(variables: int, discarded: int, transients: int, confidence: float) -> float:
    """Upper bound on the probability that a fresh transient leaves the envelope, after discarding some.

    Campi and Garatti, "A sampling-and-discarding approach to chance-constrained optimization" (JOTA 148, 2011):
    C(k+d-1, k) P[Binomial(N, ε) <= k+d-1] = 1 - confidence, with d decision variables and k discarded of N
    independent transients, whichever rule discards them. 1 where there are too few. discarded = 0 is the plain
    bound before looking at the solution.
    """
    from scipy.optimize import brentq
    from scipy.special import gammaln
    from scipy.stats import binom

    worst = discarded + variables - 1
    if worst >= transients:
        return 1.0
    ways = gammaln(worst + 1) - gammaln(discarded + 1) - gammaln(variables)
    aim = math.log(1.0 - confidence)
    low, high = 1e-12, 1.0 - 1e-12

    def excess(share: float) -> float:
        return float(ways + binom.logcdf(worst, transients, share) - aim)

    return 1.0 if excess(high) > 0 else float(brentq(excess, low, high))
