# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""PyIPM and MAPIE on arrays from another process, so that they may live in a virtual environment of their own.

Usage: python peers.py NAME IN.npz OUT.npz. In: Z (K, p), Y (K, n), group (K,) of the training samples, fresh_Z (L, p).
Out: lower, upper of Y at Z and at fresh_Z, seconds of the fit, promised (n,): the coverage the peer states, or NaN.
"""

from __future__ import annotations

import contextlib
import io
import sys
import time
from collections.abc import Callable

import numpy as np

Array = np.ndarray
Predict = Callable[[Array], tuple[Array, Array]]

CONFORMAL = 0.99


def pyipm(Z: Array, Y: Array, group: Array) -> tuple[list[Predict], Array]:
    import cvxopt
    import PyIPM

    cvxopt.solvers.options["show_progress"] = False
    predict, promised = [], []
    for y in Y.T:
        model = PyIPM.IPM(polynomial_degree=1)
        model.fit(Z, y)
        promised.append(model.get_model_reliability())

        def bounds(z: Array, model: PyIPM.IPM = model) -> tuple[Array, Array]:
            upper, lower = model.predict(z)
            return lower.ravel(), upper.ravel()

        predict.append(bounds)
    return predict, np.array(promised)


def mapie(Z: Array, Y: Array, group: Array) -> tuple[list[Predict], Array]:
    """Least squares on every other transient (or stretch), conformalised on the others, per row."""
    from mapie.regression import SplitConformalRegressor
    from sklearn.linear_model import LinearRegression

    fitted = group % 2 == 0
    predict = []
    for y in Y.T:
        model = SplitConformalRegressor(LinearRegression(), confidence_level=CONFORMAL, prefit=False)
        model.fit(Z[fitted], y[fitted]).conformalize(Z[~fitted], y[~fitted])

        def bounds(z: Array, model: SplitConformalRegressor = model) -> tuple[Array, Array]:
            limits = model.predict_interval(z)[1]
            return limits[:, 0, 0], limits[:, 1, 0]

        predict.append(bounds)
    return predict, np.full(Y.shape[1], CONFORMAL)


def main(name: str, source: str, target: str) -> None:
    given = np.load(source)
    with contextlib.redirect_stdout(io.StringIO()):
        rng = np.random.default_rng(0)
        run = {"PyIPM": pyipm, "MAPIE": mapie}[name]
        run(rng.standard_normal((400, 2)), rng.standard_normal((400, 1)), np.arange(400))  # load before timing
        began = time.perf_counter()
        predict, promised = run(given["Z"], given["Y"], given["group"])
        seconds = time.perf_counter() - began
    found = {"seconds": np.float64(seconds), "promised": promised}
    for where in ("Z", "fresh_Z"):
        limits = [p(given[where]) for p in predict]
        found[f"{where}_lower"] = np.column_stack([low for low, _ in limits])
        found[f"{where}_upper"] = np.column_stack([high for _, high in limits])
    np.savez(target, **found)


if __name__ == "__main__":
    main(*sys.argv[1:])
