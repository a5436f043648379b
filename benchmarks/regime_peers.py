# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""PARC and jax-sysid on arrays from another process, so that they may live in a virtual environment of their own.

Usage: python regime_peers.py NAME REGIONS IN.npz OUT.npz. In: Z (K, p) regressors, Y (K, q) targets, fresh_Z (L, p),
all of about unit size. Out: predicted, fresh_predicted: targets; region, fresh_region: of each sample; seconds.
"""

from __future__ import annotations

import contextlib
import io
import sys
import time
import warnings
from collections.abc import Callable
from types import ModuleType

import numpy as np

Array = np.ndarray
Predict = Callable[[Array], tuple[Array, Array]]


def parc(Z: Array, Y: Array, regions: int) -> Predict:
    """Piecewise affine regression (Bemporad, 2023): a law per region; of some settings the least squared error.

    Regions are Voronoi cells: those by softmax, the default, end as one on the coil, whatever their number.
    """
    sys.modules.setdefault("pypoman", ModuleType("pypoman"))  # draws partitions; needs the C library cdd
    from pyparc.parc import PARC

    warnings.simplefilter("ignore")
    fits = []
    for sigma in (0.01, 0.1, 1.0):
        np.random.seed(0)
        model = PARC(K=regions, alpha=1e-8, sigma=sigma, separation="Voronoi", maxiter=50, verbose=0)
        model.fit(Z, Y)
        fits.append((float(np.mean((model.predict(Z)[0] - Y) ** 2)), model))
    model = min(fits, key=lambda fitted: fitted[0])[1]

    def predict(z: Array) -> tuple[Array, Array]:
        found, region = model.predict(z)
        return found, np.asarray(region).ravel()

    return predict


def jax_sysid(Z: Array, Y: Array, regions: int) -> Predict:
    """As many affine laws, blended by a softmax of affine functions: a static model, trained by Adam and L-BFGS."""
    import jax
    import jax.numpy as jnp
    from jax_sysid.models import StaticModel

    jax.config.update("jax_enable_x64", True)
    p, q = Z.shape[1], Y.shape[1]

    def weights(z: Array, gate: Array, offset: Array) -> Array:
        return jax.nn.softmax(z @ gate.T + offset, axis=1)

    def output(z: Array, params: list[Array]) -> Array:
        W, b, gate, offset = params
        laws = jnp.einsum("kp,rqp->krq", z, W) + b
        return jnp.einsum("kr,krq->kq", weights(z, gate, offset), laws)

    linear = np.linalg.lstsq(np.column_stack([Z, np.ones(len(Z))]), Y, rcond=None)[0]

    def start(seed: int) -> list[Array]:
        rng = np.random.default_rng(seed)
        W = np.tile(linear[:p].T, (regions, 1, 1)) + 0.1 * rng.standard_normal((regions, q, p))
        return [W, np.tile(linear[p], (regions, 1)), rng.standard_normal((regions, p)), rng.standard_normal(regions)]

    fits = []
    for seed in range(3):
        model = StaticModel(q, p, output)
        model.init(params=start(seed))
        model.loss(rho_th=1e-10)
        model.optimization(adam_eta=0.01, adam_epochs=1000, lbfgs_epochs=3000, iprint=-1)
        model.fit(Y, Z)
        fits.append((float(np.mean((np.asarray(output(Z, model.params)) - Y) ** 2)), model))
    model = min(fits, key=lambda fitted: fitted[0])[1]

    def predict(z: Array) -> tuple[Array, Array]:
        region = np.asarray(weights(z, *model.params[2:])).argmax(axis=1)
        return np.asarray(output(z, model.params)), region

    return predict


def main(name: str, regions: str, source: str, target: str) -> None:
    given = np.load(source)
    with contextlib.redirect_stdout(io.StringIO()):
        began = time.perf_counter()
        predict = {"PARC": parc, "jax-sysid": jax_sysid}[name](given["Z"], given["Y"], int(regions))
        seconds = time.perf_counter() - began
        predicted, region = predict(given["Z"])
        fresh_predicted, fresh_region = predict(given["fresh_Z"])
    np.savez(
        target, predicted=predicted, region=region, fresh_predicted=fresh_predicted, fresh_region=fresh_region,
        seconds=np.float64(seconds),
    )  # fmt: skip


if __name__ == "__main__":
    main(*sys.argv[1:])
