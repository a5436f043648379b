# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Three tanks in a row: a small nonlinear plant for tests and benchmarks, simulated for many transients at once."""

from collections.abc import Callable

import numpy as np

from uncertain_lti import Transient

OUTFLOW = np.array([1.0, 1.2, 1.4])
DT = 0.1
SUBSTEPS = 4


class Tanks:
    """dh_i/dt = q_{i-1} - c_i sqrt(h_i), q_0 = 1 + u, q_i = c_i sqrt(h_i); levels over their steady state, less 1.

    Parameters
    ----------
    spread : float
        The outflow coefficients are drawn within this share of 1, 1.2, 1.4.
    seed : int
    """

    def __init__(self, seed: int = 0, spread: float = 0.0) -> None:
        self.c = OUTFLOW * (1 + spread * np.random.default_rng(seed).uniform(-1, 1, 3))

    def arrays(
        self,
        count: int,
        seed: int,
        steps: int = 100,
        noise: float = 0.0,
        held: int = 20,
        fault: float = 0.0,
        act: Callable[[np.ndarray], np.ndarray] | None = None,
        slower: tuple[int, float, np.ndarray] | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """x (count, steps+1, 3), u (count, steps+1, 1); starts within 20 %, input steps within 30 %.

        fault: from half time on, the second outlet passes this share less.
        act: what the pump does (count, steps+1) with what is commanded, of which u tells.
        slower: a tank, a factor on the rate of its level, and the sample of each transient from which on it holds.
        """
        rng = np.random.default_rng([seed, 77])
        steady = 1.0 / self.c**2
        h = steady * (1 + rng.uniform(-0.2, 0.2, (count, 3)))
        u = np.repeat(rng.uniform(-0.3, 0.3, (count, steps // held + 1)), held, axis=1)[:, : steps + 1]
        done = u if act is None else act(u)
        rate = np.ones((count, 3))
        x = np.empty((count, steps + 1, 3))
        x[:, 0] = h
        for k in range(steps):
            c = self.c * np.array([1.0, 1.0 - fault * (k >= steps // 2), 1.0])
            if slower is not None:
                rate[:, slower[0]] = np.where(k >= slower[2], slower[1], 1.0)
            for _ in range(SUBSTEPS):
                flow = c * np.sqrt(np.maximum(h, 0.0))
                h = h + rate * (DT / SUBSTEPS * (np.column_stack([1 + done[:, k], flow[:, :2]]) - flow))
            x[:, k + 1] = h
        x = x / steady - 1
        return x + noise * rng.standard_normal(x.shape), u[:, :, None]

    def transients(self, count: int, seed: int, **options: float) -> list[Transient]:
        """`arrays` as transients."""
        x, u = self.arrays(count, seed, **options)  # type: ignore[arg-type]
        t_ns = np.arange(x.shape[1]) * round(DT * 1e9)
        return [Transient(t_ns, a, b, name=f"tanks {seed}.{i}") for i, (a, b) in enumerate(zip(x, u, strict=True))]
