# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Evidence: what recordings say of their signals, in numbers; choices and sentences rest on it."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array, in_stretches
from uncertain_lti.identification.passes import Moments
from uncertain_lti.identification.problem import Problem
from uncertain_lti.identification.structure import EVERY, Rows, own_of
from uncertain_lti.model.horizon import unbroken_over
from uncertain_lti.model.operating_point import recorded
from uncertain_lti.signals.signal_map import Signal

Effects = dict[int, tuple[int, float]]
"""Controls, each with a state or a number of samples, and how sure that is."""
FASTEST = 1.05
"""Rows per second up to which a recording is of a plant: most sensors answer within a row, and levels are judged."""
NOISE = 0.5
"""A state of whose variance less than this share is predicted from one sample to the next moves like noise."""
FOLLOW, ALTERNATE = 0.5, -0.7
"""Autocorrelation from which on residuals follow one another. Sensor noise alone gives -0.5 to 0 at one sample, and
0 at two."""
GAIN = 1.5
"""By so much the state's own value one sample earlier must reduce what a step leaves unexplained."""
CURVED = 0.5
"""Share of that reduction which curves of the present signals may give: more is a nonlinear machine, not a missing
state."""
DETERMINED = 4.0
"""Standard errors that a control's effect on some state must have to be distinguished from the noise."""
LONGEST_DELAY = 10
"""Delays of a control that are tried, samples."""
SURE_DELAY = 0.1
"""Share by which a delay leaves less unexplained, below which it must show in either half of the samples."""
ALIGNED = 0.5
"""Least cosine between what a control does to a state from either end of a step, where it is no controller's answer."""
FOLLOWS = 0.15
"""Standard deviation around a smooth function, as a share, from which on it is none."""
WHITE, OWN = 0.3, 0.5
"""Correlation from sample to sample up to which a difference of two signals is noise, and the share of it that each of
two sensors has of its own."""
ROUNDED = 1e-6
"""Standard deviation of the difference of two signals, as a share, up to which it is rounding."""
DRIFTS = 2.0
"""What a drift makes of the residuals, from which on a model without one has a wrong steady state."""
_EXACT = 0.01  # what a fit on others leaves of a signal's steps, as a share, up to which it is computed from them
_ENOUGH, _STRETCH = 5_000_000, 128  # elements of the regressors from which on stretches of samples do
_STRETCHES = 10  # of the samples, dealt out to the halves in turn
_CLIP = 5.0
"""Standard deviations at which a residual is cut before it is correlated: one event is no rule."""
_MOST_PRODUCTS = 12
"""Signals up to which all products of two are tried as curves; beyond, squares and magnitudes alone."""


def successive(problem: Problem) -> NDArray[np.intp]:
    """Transitions that the next one in the problem continues: same recording, next sample."""
    return np.flatnonzero(np.diff(problem.order) == 1)


def unexplained(gram: Array, cross: Array, total: Array) -> tuple[Array, NDArray[np.intp]]:
    """Sum of squares of each target that its least-squares fit on some regressors leaves, and the rank of these.

    Shares below 1e-11 are not distinguished, which no decision here needs.

    `gram` (..., b, b): products of the regressors with one another; leading axes are other choices of regressors;
    `cross` (..., b, t): products of the regressors with the targets; `total` (t,): sums of squares of the targets.
    """
    size = np.sqrt(np.diagonal(gram, axis1=-2, axis2=-1))
    unit = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0)
    values, vectors = np.linalg.eigh(gram * unit[..., :, None] * unit[..., None, :])
    keep = values > 1e-11 * values[..., -1:]
    root = np.divide(1.0, np.sqrt(values, where=keep, out=np.ones_like(values)), where=keep, out=np.zeros_like(values))
    turned = np.swapaxes(vectors * root[..., None, :], -1, -2) @ (cross * unit[..., :, None])
    left = np.maximum(total - np.einsum("...bt,...bt->...t", turned, turned), 1e-11 * total)
    return np.asarray(left), np.asarray(keep.sum(axis=-1))


def size_of(values: Array) -> Array:
    """Largest magnitude of each column (k,), to divide by."""
    return np.asarray(np.maximum(np.abs(values).max(axis=0, initial=0.0), 1e-300))


def left(Z: Array, *of: Array) -> tuple[Array, ...]:
    """What a least-squares fit on [1, Z] leaves of some columns, (N, k) each.

    `Z` (N, j): regressors; Returns (N, k): one array for each that is given.
    """
    Q, _ = np.linalg.qr(np.hstack([np.ones((len(Z), 1)), Z / size_of(Z)]))
    return tuple(Y - Q @ (Q.T @ Y) for Y in of)


def from_both_ends(X: Array, U: Array, V: Array, dX: Array, new: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
    """Whether what is new in the controls at the arrival moves each state as from the departure on.

    `X` (N, n), `U` (N, m): states and controls at the departure; `V` (N, k): controls at the arrival, those that are
    `new` of the m; `dX` (N, n): changes of the states. Returns (n,), and (N, n) twice: what of the changes nothing
    before the arrival tells, and the part of it that the controls at the arrival do.
    """
    move, fresh = left(np.hstack([X, U]), dX, V)
    own, change = left(X, U, dX)
    early = fresh @ np.linalg.lstsq(own, change, rcond=None)[0][new]
    late = fresh @ np.linalg.lstsq(fresh, move, rcond=None)[0]
    sizes = ((early**2).mean(axis=0) * (late**2).mean(axis=0)) ** 0.5
    return np.asarray((early * late).mean(axis=0) >= ALIGNED * sizes), move, late


def held_for(before: Array, after: Array) -> int:
    """Samples for which a slower sensor, or who sets it, holds each value of a signal; 0 where it is not held (N,)."""
    instants = np.flatnonzero(after != before)
    if not 10 <= len(instants) <= 0.7 * len(after):
        return 0
    period = float(np.median(np.diff(instants)))
    # a rounding sensor repeats few values; a machine at rest is constant in few, long stretches
    even = period * len(instants) > 0.5 * len(after)  # a coarse sensor is new often for a while, and then not at all
    return round(period) if period >= 2 and even and len(np.unique(after[instants])) > 0.5 * len(instants) else 0


def functions(X: Array, Y: Array | None = None) -> NDArray[np.bool_]:
    """Whether [i, j] j of Y is a smooth function of i of X, at the same instants or one sample off, but for noise.

    `X` (N, n); `Y` (N, k): default X; Returns (n, k).
    """
    Y = X if Y is None else Y
    found = np.zeros((X.shape[1], Y.shape[1]), dtype=bool)
    known, moving = (np.flatnonzero(np.ptp(Z[1:-1], axis=0) > 0) for Z in (X, Y))
    for now, after in ((0, 0), (1, 0), (0, 1)):
        b = Y[:, moving][after : len(X) - now]
        b = b - b.mean(axis=0)
        size, step = (b**2).sum(axis=0), np.diff(b, axis=0).std(axis=0)
        for i in known.tolist():
            a = X[now : len(X) - after, i]
            Q, R = np.linalg.qr(np.vander((a - a.mean()) / a.std(), 4))
            told = R @ np.linalg.lstsq(R, Q.T @ b, rcond=None)[0]
            share = np.sqrt(np.maximum(1.0 - (told**2).sum(axis=0) / size, 0.0))
            for k in np.flatnonzero(share < FOLLOWS).tolist():
                rest, still = b[:, k] - Q @ told[:, k], step[k] < 0.7 * b[:, k].std()
                white = rest.std() == 0 or np.corrcoef(rest[1:], rest[:-1])[0, 1] < WHITE
                found[i, moving[k]] |= share[k] < 0.02 or (still and white)  # white around what it follows
    return found


def computed(dX: Array, topics: Sequence[str], function: NDArray[np.bool_]) -> dict[int, str]:
    """Signals whose steps (N, n) are a sum of those of another topic, of no one alone (n, n), and that topic."""
    found: dict[int, str] = {}
    for topic in dict.fromkeys(topics):
        whole = [i for i, t in enumerate(topics) if t == topic and i not in found]
        others = [i for i, t in enumerate(topics) if t != topic and i not in found and not function[whole, i].any()]
        if len(whole) > 1 and others and len(dX) > 2 * len(whole):
            (rest,) = left(dX[:, whole], dX[:, others])
            exact = rest.std(axis=0) < _EXACT * dX[:, others].std(axis=0)
            found |= {i: topic for i, so in zip(others, exact.tolist(), strict=True) if so}
    return found


def two_sensors(a: Array, b: Array) -> bool:
    """Whether two signals that follow each other (N,) are read by two sensors, each with noise of its own.

    Their difference is white then, and neither follows from the other and the rows before: a filtered copy would.
    """
    a, b = ((z - z.mean()) / z.std() for z in (a, b))
    (rest,) = left(a[:, None], b)
    past = [z[lag : len(z) - 2 + lag] for z in (a, b) for lag in (0, 1)]
    own = min(left(np.column_stack([other[2:], *past]), one[2:])[0].std() for one, other in ((a, b), (b, a)))
    if not own > max(OWN * rest.std(), ROUNDED):
        return False
    return bool(abs(np.corrcoef(rest[1:], rest[:-1])[0, 1]) < WHITE)


def predicted(X: Array, U: Array, after: Array) -> Array:
    """Share of the variance that least squares on [X, U, 1] predicts.

    `X` (N, n): regressors; `U` (N, m): further regressors; `after` (N, k): targets; Returns (k,): at most 1; without
    the share that any regressor explains by chance, so that it can be negative.
    """
    columns = np.hstack([X, U, after])
    columns = columns - columns.mean(axis=0)
    columns /= size_of(columns)
    known, targets = columns[:, : X.shape[1] + U.shape[1]], columns[:, X.shape[1] + U.shape[1] :]
    total = np.einsum("ki,ki->i", targets, targets)
    left, rank = unexplained(known.T @ known, known.T @ targets, total)
    left = left * (len(X) - 1) / max(len(X) - 1 - int(rank), 1)
    return np.asarray(np.where(total > 0.0, 1.0 - left / np.maximum(total, 1e-300), 0.0))


@dataclass(frozen=True)
class Autocorrelation:
    """What least squares on one sample leaves unexplained of each state's step.

    `correlation` (n, 2): autocorrelation at one and at two samples; `gain` (n,): root mean square over that with the
    state's own value one sample earlier as well; ones if none is correlated; `curved` (n,): root mean square over that
    with squares, products and magnitudes of the same sample as well; as above.
    """

    correlation: Array
    gain: Array
    curved: Array

    def follows(self, state: int) -> bool:
        """Whether the next sample depends on more than these signals at one instant."""
        correlated = _autocorrelated(*self.correlation[state].tolist())
        gain = float(self.gain[state])
        return bool(correlated and gain >= GAIN and self.curved[state] - 1.0 < CURVED * (gain - 1.0))


def _autocorrelated(one: float, two: float) -> bool:
    return one >= FOLLOW or one <= ALTERNATE or abs(two) >= FOLLOW


def autocorrelation(problem: Problem) -> Autocorrelation | None:
    """Autocorrelation of least squares, and what would explain them."""
    n, p = problem.n, problem.p
    before = successive(problem)
    if len(before) < 40 * p:
        return None
    now = before + 1
    correlation = _correlation(problem, now)
    if not any(_autocorrelated(*of) for of in correlation.tolist()):  # nothing follows: what would explain it is idle
        return Autocorrelation(correlation, np.ones(n), np.ones(n))
    dt = problem.dt[now, None]
    z = problem.z.T[now]
    step = problem.x_next.T[now] - z[:, :n]
    base = np.column_stack([z, np.ones(len(z))])
    lagged = problem.z.T[before, :n]
    basis = np.column_stack([base, lagged, _curves(z)]) * dt
    gram, cross, total = basis.T @ basis, basis.T @ step, np.einsum("kn,kn->n", step, step)
    total = np.maximum(total, 1e-300)
    own = np.arange(p + 1)

    def left(columns: NDArray[np.intp], states: slice) -> Array:
        return unexplained(gram[np.ix_(columns, columns)], cross[columns, states], total[states])[0]

    plain = left(own, slice(None))
    past = np.array([left(np.append(own, p + 1 + i), slice(i, i + 1))[0] for i in range(n)])
    curved = left(np.append(own, np.arange(p + 1 + n, basis.shape[1])), slice(None))
    return Autocorrelation(correlation, np.sqrt(plain / past), np.sqrt(plain / curved))


def _curves(z: Array) -> Array:
    """Squares, magnitudes and (of few signals) products of two, (K, curves)."""
    z = z / size_of(z)
    p = z.shape[1]
    if p > _MOST_PRODUCTS:
        return np.hstack([z**2, np.abs(z)])
    i, j = np.triu_indices(p)
    return np.hstack([z[:, i] * z[:, j], np.abs(z)])


def _correlation(problem: Problem, now: NDArray[np.intp]) -> Array:
    """Autocorrelation at one and two samples, (n, 2); `now`: transitions that continue the one before."""
    basis = np.column_stack([problem.z.T, np.ones(problem.N)]) * problem.dt[:, None]
    basis = basis / size_of(basis)
    step = problem.x_next.T - problem.z.T[:, : problem.n]
    residual = step - basis @ np.linalg.lstsq(basis, step, rcond=None)[0]
    spread = np.median(np.abs(residual), axis=0) / 0.6745
    limit = np.where(spread > 0, _CLIP * spread, np.inf)
    residual = np.clip(residual, -limit, limit)
    residual = residual - residual.mean(axis=0)
    size = np.maximum(np.mean(residual**2, axis=0), 1e-300)
    twice = now[np.isin(now - 1, now)]
    one = np.mean(residual[now] * residual[now - 1], axis=0) / size
    two = np.mean(residual[twice] * residual[twice - 2], axis=0) / size if len(twice) else np.zeros(problem.n)
    return np.column_stack([one, two])


def lagged_states(signals: Sequence[Signal], n: int) -> set[int]:
    """Controls that are a state some samples earlier, or follow from its earlier samples."""
    states = {(s.topic, s.inner) for s in signals[:n]}
    return {j for j, s in enumerate(signals) if j >= n and (s.delay > 0 or s.memory) and (s.topic, s.inner) in states}


def lost(problem: Problem, moments: Moments, known: Collection[int] = (), rows: Rows = EVERY) -> Effects:
    """Controls whose effect on every state is lost in the noise: the state on which most, and standard errors."""
    most = Effects()
    for row, of_row in rows:
        free, states = own_of(np.flatnonzero(moments.phi_scale > 0), row), np.arange(problem.n)[of_row]
        if not len(free) or moments.count <= len(free):
            continue
        target, square = moments.target[np.ix_(free, states)], moments.rate_square[states]
        inverse = np.linalg.pinv(moments.centre[np.ix_(free, free)], hermitian=True)
        theta = inverse @ target
        residual = np.maximum(square - np.einsum("ji,ji->i", theta, target), 1e-14 * square)
        error = np.outer(np.diagonal(inverse), residual / (moments.count - len(free)))
        certainty = np.abs(theta) / np.maximum(np.sqrt(np.maximum(error, 0.0)), 1e-300)
        for j, of in zip(free.tolist(), certainty, strict=True):
            if problem.n <= j < problem.p and j not in known and moments.low[j] != moments.high[j]:
                most[j] = max(most.get(j, (0, 0.0)), (int(states[np.argmax(of)]), float(of.max())), key=itemgetter(1))
    return {j: effect for j, effect in most.items() if effect[1] < DETERMINED}


def late_controls(problem: Problem, past: Collection[int] = (), rows: Rows = EVERY) -> Effects:
    """Controls that explain the states clearly better when taken some samples earlier."""
    n, p = problem.n, problem.p
    run = np.arange(problem.N) - unbroken_over(problem.order, [], None)  # samples before this one in its stretch
    usable = np.flatnonzero(run >= LONGEST_DELAY)
    if len(usable) < 20 * p:
        return {}
    share = 1 + usable.size * (p + LONGEST_DELAY * (p - n)) // _ENOUGH
    usable = usable[in_stretches(np.arange(usable.size), share, _STRETCH)]
    lagged = np.stack([problem.z[n:, usable - lag] for lag in range(LONGEST_DELAY + 1)])
    now, dt, found = problem.z[:n, usable], problem.dt[usable], Effects()
    step = problem.x_next[:, usable] - now
    for row, states in rows:
        x, u = own_of(np.arange(n), row), own_of(np.arange(n, p), row) - n
        found |= {int(u[j]): late for j, late in lags(now[x], lagged[:, u], step[states], dt).items()}
    return {j: late for j, late in found.items() if n + j not in past}


def lags(x: Array, u: Array, increment: Array, dt: Array) -> Effects:
    """Controls that explain the states clearly better some samples earlier.

    `x` (n, N): states; `u` (lags + 1, m, N): controls this many samples before; `increment` (n, N): what the states
    change by in a step; `dt` (N,): step, s.
    """
    found = _lags(x, u, increment, dt)
    if any(share < SURE_DELAY for _, share in found.values()):
        half = np.arange(x.shape[1]) * _STRETCHES // x.shape[1] % 2 == 0
        halves = [_lags(x[:, part], u[:, :, part], increment[:, part], dt[part]) for part in (half, ~half)]
        for j, (lag, share) in [*found.items()]:
            if share < SURE_DELAY and not all(j in other and abs(other[j][0] - lag) <= 1 for other in halves):
                del found[j]
    return found


def _lags(x: Array, u: Array, increment: Array, dt: Array) -> Effects:
    n, N = x.shape
    longest, m = len(u) - 1, u.shape[1]
    movers = [j for j in range(m) if np.ptp(u[0, j]) > 0]
    late = [u[lag, j] for j in movers for lag in range(1, longest + 1)]
    regressors = np.empty((n + m + 1 + len(late), N))  # all at once: one product of all with all
    for row, values in zip(regressors, [*x, *u[0], np.ones(N), *late], strict=True):
        np.multiply(values, dt, out=row)
    gram, cross = regressors @ regressors.T, regressors @ increment.T
    total = np.einsum("nk,nk->n", increment, increment)

    def score(chosen: list[list[int]]) -> Array:
        which = np.array(chosen)
        left, _ = unexplained(gram[which[:, :, None], which[:, None, :]], cross[which], total)
        return np.asarray(np.log(np.maximum(left, 1e-300)).sum(axis=-1))

    found = {}
    undelayed = list(range(n + m + 1))
    for position, j in enumerate(movers):
        first = n + m + 1 + position * longest
        later = [[first + lag if c == n + j else c for c in undelayed] for lag in range(longest)]
        scores = score([undelayed, *later])
        best = int(np.argmin(scores))
        gain = float(scores[0] - scores[best])
        # 5 % less unexplained, and far more than chance: N log-likelihood units per row
        if not (0 < best < longest and gain > 0.05 and gain * N > 50):  # at the end of what is tried it is no optimum
            continue
        # next to a late control the present one adds nothing; if it does, the late one represents past states
        if scores[best] - score([[*undelayed, first + best - 1]])[0] < 0.3 * gain:
            found[j] = (best, float(1 - np.exp(-gain / len(increment) / 2)))
    return found


def far_from_steady(problem: Problem, signals: Sequence[Signal]) -> list[str]:
    """The signal farthest from its steady state, where a drift, which no term allows for, explains much of a state."""
    z, rate = problem.z.T, problem.rate()
    if "c" in problem.columns.names or len(z) < 4 * problem.p:
        return []
    level, moves = z.mean(axis=0), np.ptp(z, axis=0)
    without = rate - z @ np.linalg.lstsq(z, rate, rcond=None)[0]
    alone, drifting = (np.square(rest).sum(axis=0) ** 0.5 for rest in (without, *left(z, rate)))
    worse = alone / np.maximum(drifting, 1e-3 * rate.std(axis=0) * len(z) ** 0.5 + 1e-300)
    away = np.where(moves > 0, np.abs(level) / np.maximum(moves, 1e-300), 0.0)
    i, j = int(np.argmax(worse)), int(np.argmax(away))
    if worse[i] < DRIFTS or away[j] < 1:
        return []
    steady, scale = float(signals[j].steady), float(signals[j].scale)
    low, high = (recorded(v, steady, scale) for v in (z[:, j].min(), z[:, j].max()))
    return [
        f"'{signals[j].name}' is {low:.4g} to {high:.4g} in the recordings, and its steady state {steady:.4g}, so "
        f"'{signals[i].name}' is {worse[i]:.2g} times as far from the model as it need be: write "
        f"`steady: auto`, or the value at rest"
    ]
