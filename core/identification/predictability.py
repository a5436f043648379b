# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Predictability: what the signals of one instant say of the next sample, and whether the rest is noise or a state."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.identification.excitation import DETERMINED, least_squares, successive, triangle, unexplained
from uncertain_lti.identification.problem import Problem
from uncertain_lti.signals.functions import Memory
from uncertain_lti.signals.signal_map import Signal

NOISE = 0.5
"""A state of whose variance less than this share is predicted from one sample to the next moves like noise."""
_OWN = 0.3
"""Share of a mode's largest component from which on a state has part in the mode."""
FOLLOW, ALTERNATE = 0.5, -0.7
"""Autocorrelation from which on residuals follow one another. Sensor noise alone gives -0.5 to 0 at one sample, and
0 at two."""
GAIN = 1.5
"""By so much the state's own value one sample earlier must reduce what a step leaves unexplained."""
CURVED = 0.5
"""Share of that reduction which curves of the present signals may give: more is a nonlinear machine, not a missing
state."""
_CLIP = 5.0
"""Standard deviations at which a residual is cut before it is correlated: one event is no rule."""
_MOST_PRODUCTS = 12
"""Signals up to which all products of two are tried as curves; beyond, squares and magnitudes alone."""


@dataclass(frozen=True)
class Prediction:
    """How well a state's own past predicts its next sample.

    `predicted` (n,): share of variance that least squares on the sample before and its control predicts one sample
    ahead; `fastest`: |1 - eigenvalue| of the fastest mode of the step that does not come from measurement noise; inf
    where too few samples follow one another.
    """

    predicted: Array
    fastest: float

    def like_noise(self, state: int) -> bool:
        """Whether the state moves like noise."""
        return bool(self.predicted[state] < NOISE)


def predicted(X: Array, U: Array, after: Array) -> Array:
    """Share of the variance that least squares on [X, U, 1] predicts.

    `X` (N, n): regressors; `U` (N, m): further regressors; `after` (N, k): targets; Returns (k,): at most 1; without
    the share that any regressor explains by chance, so that it can be negative.
    """
    design = np.vstack([X.T, U.T, np.ones(len(X))])
    design /= np.maximum(np.abs(design).max(axis=1), 1e-300)[:, None]
    reduced = triangle(np.vstack([design, after.T]))
    regressors, targets = np.split(np.arange(reduced.shape[1]), [len(design)])
    answer, rank = least_squares(reduced, regressors, targets, len(X))
    rest = reduced[:, targets] - reduced[:, regressors] @ answer
    total = ((after - after.mean(axis=0)) ** 2).sum(axis=0)
    freedom = max(len(X) - rank, 1)
    left = (rest**2).sum(axis=0) * (len(X) - 1) / freedom  # without the share that any regressor explains by chance
    return np.asarray(1.0 - left / np.maximum(total, 1e-300))


def prediction(problem: Problem) -> Prediction:
    """Prediction of the states, estimated from a problem's own samples.

    Noise on a measured state makes least squares believe that it decays within a step. The sample before, as an
    instrument, carries the state and none of that noise; a mode is fast if both ways agree for a state that is
    predicted at all.
    """
    n, p = problem.n, problem.p
    share = predicted(problem.z[:, :n], problem.z[:, n:], problem.x_next)
    follows = successive(problem)
    if len(follows) < 20 * p:
        return Prediction(share, np.inf)
    count, z = len(follows), problem.z_columns
    reduced = triangle(
        np.vstack([z[:, follows], z[:, follows + 1], np.ones(count), problem.next_columns[:, follows + 1]])
    )
    before, now, after = np.arange(p), np.arange(p, 2 * p + 1), np.arange(2 * p + 1, 2 * p + 1 + n)
    instruments = np.concatenate([before, now[n:]])
    projected = reduced[:, instruments] @ least_squares(reduced, instruments, now, count)[0]
    speeds = []
    for design in (reduced[:, now], projected):
        both = np.hstack([design, reduced[:, after]])
        found, _ = least_squares(both, np.arange(p + 1), np.arange(p + 1, p + 1 + n), count)
        values, vectors = np.linalg.eig(found[:n].T)
        parts = np.abs(vectors)
        seen = [(share[parts[:, j] >= _OWN * parts[:, j].max()] >= NOISE).all() for j in range(n)]
        speeds.append(float(np.max(np.abs(1.0 - values[seen]), initial=0.0)))
    return Prediction(share, min(speeds))


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


def _correlated(one: float) -> bool:
    return one >= FOLLOW or one <= ALTERNATE


def _autocorrelated(one: float, two: float) -> bool:
    return _correlated(one) or abs(two) >= FOLLOW


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
    z = problem.z[now]
    step = problem.x_next[now] - z[:, :n]
    base = np.column_stack([z, np.ones(len(z))])
    lagged = problem.z[before, :n]
    basis = np.column_stack([base, lagged, _curves(z)]) * dt
    gram, cross, total = basis.T @ basis, basis.T @ step, np.einsum("kn,kn->n", step, step)
    total = np.maximum(total, 1e-300)
    own = np.arange(p + 1)

    def left(columns: NDArray[np.intp], states: slice) -> Array:
        return unexplained(gram[np.ix_(columns, columns)], cross[columns, states], total[states])

    plain = left(own, slice(None))
    past = np.array([left(np.append(own, p + 1 + i), slice(i, i + 1))[0] for i in range(n)])
    curved = left(np.append(own, np.arange(p + 1 + n, basis.shape[1])), slice(None))
    return Autocorrelation(correlation, np.sqrt(plain / past), np.sqrt(plain / curved))


def _curves(z: Array) -> Array:
    """Squares, magnitudes and (of few signals) products of two, (K, curves)."""
    z = z / np.maximum(np.abs(z).max(axis=0), 1e-300)
    p = z.shape[1]
    if p > _MOST_PRODUCTS:
        return np.hstack([z**2, np.abs(z)])
    i, j = np.triu_indices(p)
    return np.hstack([z[:, i] * z[:, j], np.abs(z)])


def _correlation(problem: Problem, now: NDArray[np.intp]) -> Array:
    """Autocorrelation at one and two samples, (n, 2); `now`: transitions that continue the one before."""
    basis = np.column_stack([problem.z, np.ones(problem.N)]) * problem.dt[:, None]
    basis = basis / np.maximum(np.abs(basis).max(axis=0), 1e-300)
    step = problem.x_next - problem.z[:, : problem.n]
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


def missing(known: Autocorrelation, signals: Sequence[Signal], states: Collection[int]) -> list[str]:
    """The sentence for each state whose next sample depends on more than the signals at one instant."""
    messages = []
    for i in sorted(states):
        signal = signals[i]
        one, two = (float(c) for c in known.correlation[i])
        first = _correlated(one)
        how = "alternates" if first and one < 0 else "follows"
        what = "a state that moves it, or a swing faster than the samples show," if one < 0 else "a state that moves it"
        entry = (
            f"{{name: {signal.name}_before, topic: {signal.topic}, field: '{Memory('lag').of(signal.field)}'}}"
            if signal.topic
            else "the same column, one row later"
        )
        messages.append(
            f"what one step leaves unexplained of '{signal.name}' {how} from sample to sample (autocorrelation "
            f"{one if first else two:.2f} at {'one sample' if first else 'two samples'}): {what} is not among the "
            f"signals. Its value one sample earlier explains {1 - 1 / known.gain[i]:.0%} of it (root "
            f"mean square); add that as a control ({entry}), or its rate, measured or as `rate(...)` of the field"
        )
    return messages


def weak(lost: Mapping[int, tuple[int, float]], names: Sequence[str]) -> list[str]:
    """The sentence for each control whose effect is lost."""
    return [
        f"control '{names[j]}' moves too little to be distinguished from the noise: its strongest effect, on "
        f"'{names[state]}', is {certainty:.2g} standard errors; record it with larger or more steps "
        f"({max(2.0, DETERMINED / max(certainty, 0.4)):.2g} times the amplitude), or leave it out"
        for j, (state, certainty) in lost.items()
    ]
