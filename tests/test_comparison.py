# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Beside simpler models: with additive terms the objective is never above theirs."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from uncertain_lti import Transient
from uncertain_lti.identification import fit


def drawn(seed, n, m, noise, jitter, count=150):
    """A random stable plant whose elements are drawn anew at every step, never at rest."""
    rng = np.random.default_rng(seed)
    A, B = -np.diag(rng.uniform(1, 8, n)) + rng.uniform(-1, 1, (n, n)), rng.uniform(-3, 3, (n, m))
    u = np.repeat(rng.uniform(-1, 1, (count // 15 + 1, m)), 15, axis=0)[: count + 1]
    dt = np.rint(0.025e9 * (1 + jitter * rng.uniform(-1, 1, count))).astype(np.int64)
    x = np.empty((count + 1, n))
    x[0] = rng.uniform(-1, 1, n)
    for k in range(count):
        spread = 1 + 0.1 * rng.uniform(-1, 1, (n, n + m))
        x[k + 1] = x[k] + dt[k] * 1e-9 * ((np.hstack([A, B]) * spread) @ np.concatenate([x[k], u[k]]))
    return Transient(np.concatenate([[0], np.cumsum(dt)]), x + noise * rng.standard_normal(x.shape), u)


def best_box(transient):
    """Least half-width of a constant band around any A, B, c, per row (n,)."""
    s = transient.transitions()
    phi = np.column_stack([np.hstack([s.x, s.u]), np.ones(len(s.dt))]) * s.dt[:, None]
    scale = np.abs(phi).max(axis=0)
    unit, ones = phi / scale, -np.ones((len(phi), 1))
    found = []
    for y in (s.x_next - s.x).T:
        size = np.abs(y).max()
        limits = np.concatenate([y, -y]) / size
        rows = np.vstack([np.hstack([unit, ones]), np.hstack([-unit, ones])])
        cost = np.append(np.zeros(phi.shape[1]), 1.0)
        found.append(linprog(cost, rows, limits, bounds=(None, None), method="highs").fun * size)
    return np.array(found)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(1, 3),
    m=st.integers(1, 2),
    noise=st.sampled_from([0.0, 1e-4, 1e-2]),
    jitter=st.sampled_from([0.0, 0.3]),
)
def test_with_additive_terms_the_objective_is_never_above_that_of_simpler_models(seed, n, m, noise, jitter):
    """(10) in the sum of squared widths, (11) in the largest width; beside pure intervals and the best constant box."""
    transient = drawn(seed, n, m, noise, jitter)
    width = 2.0 * best_box(transient)
    for additive in ("noise", "both"):
        qp, lp = (fit(transient, c, additive=additive).fit_summary["objective"] for c in ("qp", "lp"))
        assert qp <= fit(transient, "qp", additive="none").fit_summary["objective"] * (1 + 1e-7)
        assert (
            np.asarray(lp) <= np.asarray(fit(transient, "lp", additive="none").fit_summary["objective"]) * (1 + 1e-7)
        ).all()
    assert qp <= 150 * np.sum(width**2) * (1 + 1e-6) + 1e-15
    assert (np.asarray(lp) <= width * (1 + 1e-6) + 1e-9).all()
