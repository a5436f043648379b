# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Many runs of the turbofan at once: the plant's own source on arrays, one column per run, about 20 times as fast.

The equations are those of `uncertain_lti.plants`: the module of the gas path is loaded a second time, with
NumPy's functions in place of Python's, so that a float may be an array of floats. Faults, lever, controller and noise
are the objects of `turbofan_runs.simulate`, one per run. What differs is numerical: Newton's method stops at a relative
mismatch of 1e-10 in every run, and two steps of Runge-Kutta's fourth order take the place of DOP853.

    ./run python benchmarks/turbofan_fleet.py    # the largest difference from `simulate`, the time per sample
"""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from types import ModuleType

import numpy as np

from uncertain_lti import Transient
from uncertain_lti.base.errors import UncertainLTIError
from uncertain_lti.plants import turbofan as one_engine
from uncertain_lti.plants.turbofan_runs import (
    DT,
    DT_NS,
    MAXIMUM,
    START_NS,
    Controller,
    Fault,
    Run,
    _rounded,
    operating_point,
    pulses,
    simulate,
    trim,
    turbofan_signals,
)

Array = np.ndarray
SUBSTEPS = 2
TOLERANCE = 1e-10


@cache
def _on_arrays() -> one_engine.Engine:
    """The engine whose `_path` and `derivative` take arrays in place of floats."""
    turbofan = _again("uncertain_lti.plants.turbofan")
    engine: one_engine.Engine = turbofan.Engine()  # its sizes, before functions are replaced
    vars(turbofan).update(sqrt=np.sqrt, exp=np.exp, log=np.log, max=np.maximum, min=np.minimum)

    def mass_flow(area: Array, P: Array, T: Array, w: Array, p: Array) -> Array:
        """As `turbofan.mass_flow`, whose one branch arrays cannot take."""
        g = turbofan.gamma(T, w)
        ratio = p / P
        back = ratio >= 1.0
        open_ = np.maximum(np.where(back, 0.5, ratio), (2.0 / (g + 1.0)) ** (g / (g - 1.0)))
        x = open_ ** (1.0 / g)
        forward = x * np.sqrt(2.0 * g / (g - 1.0) * (1.0 - open_ / x))
        size = area * P / np.sqrt(turbofan.R * T)
        return size * np.where(back, -np.sqrt(2.0 * np.maximum(ratio - 1.0, 0.0)), forward)

    turbofan.mass_flow = mass_flow
    return engine


def _again(name: str) -> ModuleType:
    """The module, loaded a second time under another name."""
    found = importlib.util.find_spec(name)
    assert found is not None and found.origin is not None
    spec = importlib.util.spec_from_file_location(name.replace(".", "_") + "_on_arrays", found.origin)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


class Ramped(Run):
    """A run whose lever moves evenly from corner to corner of `lever`; two corners at one instant are a jump."""

    def angle(self, t: float) -> float:
        last = max(i for i, (since, _) in enumerate(self.lever) if since <= t + 1e-9)
        since, pla = self.lever[last]
        if last + 1 == len(self.lever):
            return pla
        until, target = self.lever[last + 1]
        low, high = sorted((pla, target))
        return min(max(pla + (target - pla) * (t - since) / (until - since), low), high)


def first_sample(fault: Fault) -> int:
    """The first sample that can show a fault: a sensor's at the onset, anything else one step later."""
    onset = int(np.ceil(fault.at / DT - 1e-9))
    return onset if fault.kind.startswith("sensor") else onset + 1


def lever_moves(
    seconds: float,
    seed: int,
    jumps: float = 0.5,
    rate: tuple[float, float] = (1.0, 4.0),
    hold: tuple[float, float] = (0.5, 5.0),
    low: float = 60.0,
) -> tuple[tuple[float, float], ...]:
    """Moves of the lever at random, as corners for a `Ramped` run: each move jumps or ramps, and then it rests.

    Angles are uniform, but about one in five is the smallest and one in five the largest: what a machine does from end
    to end has to be in recordings that shall represent it.
    """
    rng = np.random.default_rng(seed)
    beyond = (MAXIMUM - low) / 3.0

    def angle() -> float:
        return min(max(float(rng.uniform(low - beyond, MAXIMUM + beyond)), low), MAXIMUM)

    corners = [(0.0, angle())]
    t = float(rng.uniform(*hold))
    while t < seconds:
        start, end = corners[-1][1], angle()
        corners.append((t, start))
        if rng.uniform() >= jumps:
            t += abs(end - start) / float(rng.uniform(*rate))
        corners.append((t, end))
        t += float(rng.uniform(*hold))
    return tuple(corners)


class FleetSolver:
    """Newton's method for the gas paths of all runs, with a Jacobian that is kept as long as it serves."""

    def __init__(self, engine: one_engine.Engine, runs: int) -> None:
        self._engine, self._q = engine, np.ones((5, runs))
        self._inverse: Array | None = None

    def solve(self, x: Array, u: Array, health: one_engine.Health) -> one_engine.GasPath:
        """As `GasPathSolver.solve`; called by `Engine.derivative`."""
        q = self._q
        mismatch, path = self._engine._path(q, x, u, health)
        before = np.inf
        for _ in range(40):
            if path.residual <= TOLERANCE:
                self._q = q
                return path
            if self._inverse is None or path.residual > 0.1 * before:
                jacobian = np.empty((q.shape[1], 5, 5))
                for j in range(5):
                    moved = q.copy()
                    moved[j] += 1e-7
                    jacobian[:, :, j] = ((self._engine._path(moved, x, u, health)[0] - mismatch) / 1e-7).T
                self._inverse = np.linalg.inv(jacobian)
            step = np.einsum("rij,jr->ir", self._inverse, mismatch)
            step *= np.minimum(1.0, 0.3 / np.maximum(np.abs(step).max(axis=0), 1e-300))
            before, q = path.residual, q - step
            mismatch, path = self._engine._path(q, x, u, health)
        raise UncertainLTIError("turbofan: some gas path of many was not matched; keep closer to the working line")


def simulate_fleet(runs: Sequence[Run], controls: Array | None = None) -> list[Transient]:
    """`turbofan_runs.simulate` of runs of one length.

    Parameters
    ----------
    runs : sequence of Run
        Of as many samples each.
    controls : array (runs, samples, 4), optional
        Recorded controls, in place of those of the controllers.

    Returns
    -------
    list of Transient
        One per run.

    Raises
    ------
    UncertainLTIError
        The runs differ in length, or some run leaves what the engine can do.
    """
    samples = runs[0].samples
    if any(run.samples != samples for run in runs):
        raise UncertainLTIError("runs that are simulated together have one length")
    engine, point = _on_arrays(), operating_point()
    starts = {pla: trim(pla) for pla in sorted({run.lever[0][1] for run in runs})}
    begin = [starts[run.lever[0][1]] for run in runs]
    controllers = [Controller(replace(b, x=_rounded(b.x, point.X))) for b in begin]
    generators = [np.random.default_rng(run.seed) for run in runs]
    faults = [run.fault or Fault("fan_damage", np.inf) for run in runs]
    solver = FleetSolver(engine, len(runs))
    x = np.array([b.x for b in begin])
    actual = np.array([b.u for b in begin])
    x_read, u_sent = np.empty((len(runs), samples, 5)), np.empty((len(runs), samples, 4))

    def rate(z: Array, u: Array, health: one_engine.Health) -> Array:
        return engine.derivative(z, u, health, solver)  # type: ignore[arg-type]

    for k in range(samples):
        t = k * DT
        for r, run in enumerate(runs):
            reading = faults[r].reading(t, x[r], point.X)
            if run.noise:
                reading = reading + run.noise * point.X * generators[r].standard_normal(5)
            x_read[r, k] = _rounded(reading, point.X)
            if controls is not None:
                u_sent[r, k] = controls[r, k]
            elif run.amplitude is None:
                u_sent[r, k] = controllers[r].step(run.angle(t), x_read[r, k])
            else:
                u_sent[r, k] = begin[r].u + point.U * pulses(t, run.amplitude)
        if k + 1 == samples:
            break
        held, actual = actual, u_sent[:, k].copy()
        for r, fault in enumerate(faults):
            stuck = fault.stuck(t)
            if stuck is not None:
                actual[r, stuck] = held[r, stuck]
        states = [fault.health(t) for fault in faults]
        health = one_engine.Health(
            np.array([s.fan for s in states]),
            np.array([s.compressor for s in states]),  # type: ignore[arg-type]
        )
        z, u, h = x.T, actual.T, DT / SUBSTEPS
        for _ in range(SUBSTEPS):
            a = rate(z, u, health)
            b = rate(z + 0.5 * h * a, u, health)
            c = rate(z + 0.5 * h * b, u, health)
            z = z + h / 6.0 * (a + 2.0 * b + 2.0 * c + rate(z + h * c, u, health))
        x = z.T.copy()
    t_ns, signals = START_NS + DT_NS * np.arange(samples, dtype=np.int64), turbofan_signals()
    return [
        Transient(t_ns, x_read[r], u_sent[r], name=f"turbofan {r}", signals=signals, max_gap=signals.max_gap)
        for r in range(len(runs))
    ]


def main() -> None:
    """Compare with `simulate`."""
    kinds = ("", "fan_damage", "compressor_wear", "nozzle_stuck", "fuel_stuck", "sensor_drift", "sensor_bias")
    moves = [lever_moves(10.0, seed) for seed in range(len(kinds))]
    moves = [((0.0, 64.0), (m[1][0], 64.0), *m[2:]) for m in moves]
    for noise in (0.0, 1e-4):
        runs = [
            Ramped(401, lever=m, noise=noise, seed=i, fault=Fault(kind, 4.0) if kind else None)
            for i, (m, kind) in enumerate(zip(moves, kinds, strict=True))
        ]
        X = operating_point().X
        found = simulate_fleet(runs)
        worst = max(float(np.abs((simulate(run).x - f.x) / X).max()) for run, f in zip(runs, found, strict=True))
        print(f"noise {noise:g}: largest difference of a reading from simulate: {worst:.1e} of the scale")
    many = [replace(runs[i % len(runs)], seed=i) for i in range(280)]
    began = time.process_time()
    simulate_fleet(many)
    print(f"{(time.process_time() - began) / (len(many) * 401) * 1e6:.0f} µs per sample, {len(many)} runs at once")


if __name__ == "__main__":
    main()
