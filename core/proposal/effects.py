# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Effects: how clearly controls and states show in the next step of states, by F statistics of least squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.proposal.candidates import FEWEST, Candidate, Source

SHOWS = 20.0
"""F statistic from which on something counts as visible in the next step."""


FAINT = 5.0
"""F statistic below which a control counts as visible nowhere."""


@dataclass(frozen=True)
class Steps:
    """Transitions of some states, with the controls in force.

    `X` (N, n): states, recorded units; `U` (N, m): controls, recorded units; `dX` (N, n): what the states change by.
    """

    X: Array
    U: Array
    dX: Array

    def effect(self, on: Sequence[int], of: Sequence[int] | None = None, given: Sequence[int] | None = None) -> Array:
        """F statistic in the next step of some states: of the controls, or of other states.

        Given the states `given` (default all), and the controls unless these are what is asked for.
        """
        n, m = self.X.shape[1], self.U.shape[1]
        tested = list(range(n, n + m)) if of is None else list(of)
        known = [j for j in (range(n) if given is None else given) if j not in tested]
        if of is not None:
            known += range(n, n + m)
        Z, Y = np.hstack([self.X, self.U]), self.dX[:, list(on)]
        freedom = len(Z) - len(known) - len(tested) - 1
        if freedom < 5 or not tested:
            return np.zeros(len(on))
        without, full = residual(Z[:, known], Y), residual(Z[:, [*known, *tested]], Y)
        floor = 1e-12 * (Y**2).sum(axis=0) + 1e-300
        gain = np.maximum(without - full, 0.0) / len(tested)
        return np.asarray(gain / ((full + floor) / freedom))

    def effect_of_each(self) -> Array:
        """F statistic of each control, given the others, in the next step of each state (m, n)."""
        n, m = self.X.shape[1], self.U.shape[1]
        each = [replace(self, X=np.hstack([self.X, np.delete(self.U, j, 1)]), U=self.U[:, [j]]) for j in range(m)]
        return np.array([alone.effect(range(n)) for alone in each]).reshape(m, n)


def residual(Z: Array, Y: Array) -> Array:
    """Sum of squares that a least-squares fit on [1, Z] leaves.

    `Z` (N, j): regressors; `Y` (N, k): targets; Returns (k,): units of Y squared.
    """
    size = np.maximum(np.abs(Z).max(axis=0, initial=0.0), 1e-300)
    design = np.hstack([np.ones((len(Z), 1)), Z / size])
    Q, _ = np.linalg.qr(design)
    rest = Y - Q @ (Q.T @ Y)
    return np.asarray((rest**2).sum(axis=0))


def steps_of(
    state: Sequence[Candidate], of: dict[str, Source], controls: Sequence[Candidate], lags: Sequence[int] = ()
) -> Steps:
    """Samples on the messages of the slowest of the states' topics; of the others, the latest message before."""
    lags = lags or [0] * len(controls)
    longest = max(lags, default=0)
    topics = list(dict.fromkeys(c.topic for c in state))
    clock = min(topics, key=lambda t: of[t].rate)
    X, U, dX = [], [], []
    for number, arrival in enumerate(of[clock].arrival):
        columns = [held(c, of[c.topic], number, of[clock]) for c in [*state, *controls]]
        x, u = np.hsplit(np.column_stack(columns), [len(state)])
        step = np.diff(arrival)
        if len(step) < 2 + longest:
            continue
        positive = step[step > 0]
        limit = 2.5 * float(np.median(positive)) if len(positive) else 0.0
        for j, lag in enumerate(lags):
            u[:, j] = earlier(u[:, j], lag)
        good = (step > 0) & (step <= limit)
        good &= np.isfinite(x[:-1]).all(axis=1) & np.isfinite(x[1:]).all(axis=1) & np.isfinite(u[:-1]).all(axis=1)
        good[200_000:] = False  # enough to tell
        X.append(x[:-1][good])
        U.append(u[:-1][good])
        dX.append(np.diff(x, axis=0)[good])
    n, m = np.empty((0, len(state))), np.empty((0, len(controls)))
    return Steps(np.concatenate([n, *X]), np.concatenate([m, *U]), np.concatenate([n, *dX]))


def earlier(values: Array, samples: int) -> Array:
    """Each value some samples before.

    `values` (N,): one per sample; Returns (N,): naN where there is none.
    """
    return np.concatenate([np.full(min(samples, len(values)), np.nan), values[: max(len(values) - samples, 0)]])


def held(candidate: Candidate, source: Source, number: int, clock: Source, oldest: float | None = None) -> Array:
    """Latest value at each message of the clock.

    Returns (messages of the clock,): naN before the first value, and where it is too old.
    """
    if number >= len(source.arrival) or not len(source.arrival[number]) or number >= len(candidate.values):
        return np.full(len(clock.arrival[number]), np.nan)
    mine, at = source.instants(clock, number)
    position = np.searchsorted(mine, at, side="right") - 1
    values = candidate.values[number][np.maximum(position, 0)]
    age = (at - mine[np.maximum(position, 0)]) * 1e-9
    gone = position < 0 if oldest is None else (position < 0) | (age > oldest)
    return np.where(gone, np.nan, values)


def explained(state: Source, controls: Sequence[Source]) -> float:
    """How clearly some topics show in the next step of the best of a topic's numbers."""
    every = {s.topic: s for s in [state, *controls]}
    steps = steps_of(state.free, every, [c for s in controls for c in s.free])
    if len(steps.X) < FEWEST:
        return 0.0
    return float(np.max(steps.effect(range(len(state.free))), initial=0.0))
