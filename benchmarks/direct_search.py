# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The paper's own solver for (10) beside the exact one: objective and time.

./run python benchmarks/direct_search.py

Direct search whose line searches are golden-section searches. It ends on a ridge of the piecewise smooth objective,
above the optimum. Only what the paper states: constant weights of one, no additive terms.

A row's constraints are removed exactly. For a nominal row a and half-widths d the smallest factor that makes them
contain every sample is s(a, d) = max_k |r_k - z_k a| / (|z_k| d), so the row of (10) is the unconstrained minimum over
(a, d) of

    F(a, d) = 4 s(a, d)^2 d^T G d,     G = sum_k (Δt_k |z_k|)(Δt_k |z_k|)^T.

F is searched along each coordinate in turn, then along the way the whole round went (Hooke and Jeeves 1961). The
maximum in s makes ridges that no coordinate descends, so it is approached by power means of rising exponent; the
values reported are those of F itself.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import golden

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import FitError
from uncertain_lti.base.text import Table
from uncertain_lti.identification import fit
from uncertain_lti.model.operating_point import OperatingPoint
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.plants import leibov
from uncertain_lti.plants.turbofan_runs import make_run, simulate
from uncertain_lti.sampling.transient import Transient

EXPONENTS = (8.0, 32.0, 128.0, 512.0, np.inf)
"""Of the power mean in place of the maximum, one stage of the search each."""
WIDER = 1.0 + 1e-9
"""Factor on the half-widths found, so that rounding leaves no sample outside."""


@dataclass(frozen=True)
class Found:
    """Result of a direct search.

    `model`: its one-step bounds contain every sample; `objective`: value of (10); `rows` (n,): its part in each row;
    `rounds`: of all rows together; `evaluations`: of the objective of a row; `seconds`: wall-clock time, s.
    """

    model: UncertainLTI
    objective: float
    rows: Array
    rounds: int
    evaluations: int
    seconds: float


def direct_search(
    transients: Sequence[Transient], rounds: int = 200, improvement: float = 1e-4, tolerance: float = 1e-3
) -> Found:
    """Minimise (10) by direct search from a least-squares start."""
    signals = transients[0].signals
    if signals is None:
        raise FitError(f"{transients[0].name}: no signals, which give the operating point; read it with a signals file")
    began = time.perf_counter()
    point = OperatingPoint.of(signals.states, signals.controls)
    steps = [t.transitions() for t in transients]
    x = np.vstack([point.normalise_x(s.x) for s in steps])
    z = np.hstack([x, np.vstack([point.normalise_u(s.u) for s in steps])])
    dt = np.concatenate([s.dt for s in steps])
    x_next = np.vstack([point.normalise_x(s.x_next) for s in steps])
    rate = (x_next - x) / dt[:, None]
    resting = ~z.any(axis=1)
    if rate[resting].any():
        raise FitError(
            "a sample at rest (x = u = 0) has a moving successor, which no interval matrices can contain; the direct "
            "search has no additive terms"
        )
    moving = ~resting
    z, rate, dt = z[moving], rate[moving], dt[moving]
    results = [_Row(z, rate[:, i], dt).minimise(rounds, improvement, tolerance) for i in range(x.shape[1])]
    n = x.shape[1]
    theta, d = np.array([r.a for r in results]), np.array([r.d for r in results]) * WIDER
    rows = np.array([r.value for r in results])
    model = UncertainLTI(theta[:, :n], theta[:, n:], d[:, :n], d[:, n:], signals=signals)
    return Found(
        model,
        float(rows.sum()),
        rows,
        sum(r.rounds for r in results),
        sum(r.evaluations for r in results),
        time.perf_counter() - began,
    )


class _Row:
    """One row: columns are scaled to a mean square of one, the rate too."""

    def __init__(self, z: Array, rate: Array, dt: Array) -> None:
        scale = np.sqrt(np.mean(z**2, axis=0))
        self._scale = np.where(scale > 0, scale, 1.0)
        self._unit = float(np.sqrt(np.mean(rate**2))) or 1.0
        self._z = np.asfortranarray(z / self._scale)
        self._size = np.asfortranarray(np.abs(self._z))
        self._rate = rate / self._unit
        weighted = self._size * dt[:, None]
        self._gram = weighted.T @ weighted
        self._exponent = np.inf
        self.rounds = self.evaluations = 0
        self.a = self.d = np.empty(0)
        self.value = np.inf

    def minimise(self, rounds: int, improvement: float, tolerance: float) -> _Row:
        p = self._z.shape[1]
        start = np.linalg.lstsq(self._z, self._rate, rcond=None)[0]
        q = np.concatenate([start, np.ones(p)])
        q[p:] *= self._factor(q)
        for self._exponent in EXPONENTS:
            value = self._value(q)
            for _ in range(rounds):
                before, origin = value, q.copy()
                for j in range(2 * p):
                    direction = np.zeros(2 * p)
                    direction[j] = max(abs(q[j]), 1e-3 * float(np.abs(q[:p] if j < p else q[p:]).max()), 1e-12)
                    q, value = self._line(q, value, direction, tolerance)
                q, value = self._line(q, value, q - origin, tolerance)
                q[p:] = np.abs(q[p:]) * self._factor(q)
                self.rounds += 1
                if before - value <= improvement * before:
                    break
        self.a = q[:p] * self._unit / self._scale
        self.d = np.abs(q[p:]) * self._factor(q) * self._unit / self._scale
        self.value = value * self._unit**2
        return self

    def _line(self, q: Array, value: float, direction: Array, tolerance: float) -> tuple[Array, float]:
        """Golden-section search along a direction; the better of its result and the start."""
        if not direction.any():
            return q, value
        try:
            step = float(golden(lambda s: self._value(q + s * direction), brack=(0.0, 0.01), tol=tolerance, maxiter=60))
        except RuntimeError:  # flat: no bracket
            return q, value
        trial = q + step * direction
        found = self._value(trial)
        return (trial, found) if found < value else (q, value)

    def _factor(self, q: Array) -> float:
        p = len(q) // 2
        width = self._size @ np.abs(q[p:])
        ratio = np.abs(self._rate - self._z @ q[:p]) / np.maximum(width, 1e-300)
        largest = float(ratio.max())
        if np.isinf(self._exponent) or not 0.0 < largest < np.inf:
            return largest
        total = float(np.sum((ratio / largest) ** self._exponent))
        return largest * float(total ** (1.0 / self._exponent))

    def _value(self, q: Array) -> float:
        self.evaluations += 1
        p = len(q) // 2
        d = np.abs(q[p:])
        return float(4.0 * self._factor(q) ** 2 * (d @ self._gram @ d))


def main() -> None:
    pulses = {a: simulate(make_run("pulses", a)) for a in (0.05, -0.05, 0.3, -0.3)}
    problems = {
        "turbofan, +5 %": [pulses[0.05]],
        "turbofan, ±5 %": [pulses[0.05], pulses[-0.05]],
        "turbofan, ±30 %": [pulses[0.3], pulses[-0.3]],
        "published intervals, 30 s": [leibov.transient(1201, 1)],
        "published intervals, 150 s": [leibov.transient(6001, 1)],
    }
    fit(problems["turbofan, +5 %"])  # imports the solvers
    rows = []
    for name, transients in problems.items():
        began = time.perf_counter()
        model = fit(transients)
        exact = time.perf_counter() - began
        found = direct_search(transients)
        rows.append(
            [
                name,
                str(model.fit_summary["transitions"]),
                f"{model.fit_summary['objective']:.5g}",
                f"{found.objective:.5g}",
                f"{found.objective / model.fit_summary['objective'] - 1:+.2%}",
                f"{exact:.2f}",
                f"{found.seconds:.1f}",
                f"{found.seconds / exact:.0f}",
                str(found.evaluations),
            ]
        )
    header = ("", "N", "exact (10)", "direct search", "above", "exact [s]", "direct [s]", "ratio", "evaluations")
    print(Table(header, rows))


if __name__ == "__main__":
    main()
