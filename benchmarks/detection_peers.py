# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Detectors of scikit-learn, MAPIE and SENTIL, asked by arrays in files: they may live in an environment of their own.

Usage: python detection_peers.py IN.npz OUT.npz. In: for each set NAME of recordings x_NAME (R, T, n), u_NAME (R, T, m),
dt_NAME (R, T-1); sets whose names begin with `fitted` are learnt from. Out: for each detector D and set D|NAME: (R, T)
scores, -inf where there is none.
"""

from __future__ import annotations

import sys
import warnings

import numpy as np
import sentil
from mapie.regression import SplitConformalRegressor
from numpy.lib.stride_tricks import sliding_window_view
from sklearn.ensemble import IsolationForest
from sklearn.linear_model import LinearRegression
from sklearn.neural_network import MLPRegressor

Array = np.ndarray
WINDOW, LEARNT = 10, 20_000
CONFIDENCE = 0.99
Set = tuple[Array, Array, Array]


def windows(z: Array) -> Array:
    """(R, T, p) as windows (R, T - WINDOW + 1, p * WINDOW)."""
    seen = sliding_window_view(z, WINDOW, axis=1)
    return seen.reshape(*seen.shape[:2], -1)


def conformal(fitted: list[Set], sets: dict[str, Set]) -> dict[str, Array]:
    """Residuals of split-conformal regressors, one per state, over the half-width of each at CONFIDENCE."""
    Z, Y, recording = [], [], []
    for i, (x, u, dt) in enumerate(fitted):
        z = np.concatenate([x, u, np.ones((*x.shape[:2], 1))], axis=2)[:, :-1] * dt[..., None]
        Z.append(z.reshape(-1, z.shape[2]))
        Y.append(np.diff(x, axis=1).reshape(-1, x.shape[2]))
        recording.append(np.repeat(np.arange(len(x)) + 1000 * i, x.shape[1] - 1))
    z, y, which = np.vstack(Z), np.vstack(Y), np.concatenate(recording)
    names = np.unique(which)
    held = np.isin(which, names[1::2]) if len(names) > 1 else np.arange(len(which)) % 2 == 1
    models = []
    for i in range(y.shape[1]):
        model = SplitConformalRegressor(
            LinearRegression(fit_intercept=False), confidence_level=CONFIDENCE, prefit=False
        )
        model.fit(z[~held], y[~held, i]).conformalize(z[held], y[held, i])
        models.append(model)
    found = {}
    for name, (x, u, dt) in sets.items():
        z = (np.concatenate([x, u, np.ones((*x.shape[:2], 1))], axis=2)[:, :-1] * dt[..., None]).reshape(-1, z.shape[1])
        worst = np.zeros(len(z))
        for i, model in enumerate(models):
            middle, bounds = model.predict_interval(z)
            half = 0.5 * (bounds[:, 1, 0] - bounds[:, 0, 0])
            worst = np.maximum(worst, np.abs(np.diff(x, axis=1)[..., i].ravel() - middle) / half)
        found[name] = np.concatenate([np.full((len(x), 1), -np.inf), worst.reshape(len(x), -1)], axis=1)
    return found


def ranges(fitted: list[Set], sets: dict[str, Set]) -> dict[str, Array]:
    """1 - robustness of the formula that one writes by hand: every state and control in its recorded range."""
    z = np.concatenate([np.concatenate([x, u], axis=2).reshape(-1, x.shape[2] + u.shape[2]) for x, u, _ in fitted])
    middle, half = 0.5 * (z.max(axis=0) + z.min(axis=0)), 0.5 * np.ptp(z, axis=0)
    names = [f"z{i}" for i in range(len(half)) if half[i] > 0]
    formula = sentil.Formula.parse(
        " & ".join(f"abs(({name} - ({middle[int(name[1:])]:.17g})) / {half[int(name[1:])]:.17g}) < 1" for name in names)
    )
    found = {}
    for name, (x, u, dt) in sets.items():
        t = np.concatenate([np.zeros((len(dt), 1)), np.cumsum(dt, axis=1)], axis=1)
        z = np.concatenate([x, u], axis=2)
        traces = ({n: np.ascontiguousarray(z[i, :, int(n[1:])]) for n in names} for i in range(len(z)))
        found[name] = np.stack([1.0 - formula.robustness_signal(sentil.Trace(t[i], s)) for i, s in enumerate(traces)])
    return found


def main() -> None:
    """Read, learn, score, write."""
    warnings.simplefilter("ignore")
    with np.load(sys.argv[1]) as data:
        names = [key[2:] for key in data if key.startswith("x_")]
        sets: dict[str, Set] = {n: (data[f"x_{n}"], data[f"u_{n}"], data[f"dt_{n}"]) for n in names}
    fitted = [sets[n] for n in names if n.startswith("fitted")]
    out = {f"split conformal|{n}": s for n, s in conformal(fitted, sets).items()}
    out |= {f"SENTIL, recorded ranges|{n}": s for n, s in ranges(fitted, sets).items()}
    z = np.concatenate([np.concatenate([x, u], axis=2).reshape(-1, x.shape[2] + u.shape[2]) for x, u, _ in fitted])
    mean, deviation = z.mean(axis=0), z.std(axis=0)

    def scaled(x: Array, u: Array) -> Array:
        return windows((np.concatenate([x, u], axis=2) - mean) / deviation)

    seen = np.concatenate([(w := scaled(x, u)).reshape(-1, w.shape[2]) for x, u, _ in fitted])
    rng = np.random.default_rng(0)
    learnt = seen[rng.choice(len(seen), min(LEARNT, len(seen)), replace=False)]
    forest = IsolationForest(n_estimators=100, max_samples=1024, random_state=0).fit(learnt)
    network = MLPRegressor(
        hidden_layer_sizes=(48, 12, 48), activation="tanh", max_iter=200, early_stopping=True, random_state=0
    )
    network.fit(learnt, learnt)
    for name, (x, u, _) in sets.items():
        for kind in ("isolation forest", "auto-encoder"):
            scores = np.full(x.shape[:2], -np.inf)
            for i in range(0, len(x), 50):
                w = scaled(x[i : i + 50], u[i : i + 50])
                flat = w.reshape(-1, w.shape[2])
                if kind == "auto-encoder":
                    value = ((flat - network.predict(flat)) ** 2).sum(axis=1)
                else:
                    value = -forest.score_samples(flat)
                scores[i : i + 50, WINDOW - 1 :] = value.reshape(w.shape[:2])
            out[f"{kind}|{name}"] = scores
    np.savez(sys.argv[2], **out)


if __name__ == "__main__":
    main()
