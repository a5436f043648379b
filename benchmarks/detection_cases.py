# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Recordings that detectors are compared on: machines, what is fitted, what thresholds are learnt from, faults."""

from __future__ import annotations

import argparse
import hashlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from detectors import Residuals, Runs
from regimes import FITTED_MOVES, LONG, waves
from turbofan_fleet import simulate_fleet

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from tanks import Tanks  # noqa: E402

from uncertain_lti import Transient  # noqa: E402
from uncertain_lti.model.operating_point import OperatingPoint  # noqa: E402
from uncertain_lti.plants.coil import coil_runs  # noqa: E402
from uncertain_lti.plants.turbofan_control import operating_point  # noqa: E402
from uncertain_lti.plants.turbofan_faults import Fault  # noqa: E402
from uncertain_lti.plants.turbofan_runs import (  # noqa: E402
    DT,
    DT_NS,
    LARGE,
    START_NS,
    Run,
    lever_moves,
    make_run,
    turbofan_signals,
)
from uncertain_lti.validation.false_alarms import allowed_alarms  # noqa: E402


@dataclass(frozen=True, eq=False)
class Recorded(Runs):
    """Recordings of one length as arrays, normalised, and as the transients that the monitor takes."""

    transients: tuple[Transient, ...] = ()

    @classmethod
    def of(cls, transients: Sequence[Transient], point: OperatingPoint) -> list[Recorded]:
        """By length, in the order of the first of each."""
        found: dict[int, list[Transient]] = {}
        for t in transients:
            found.setdefault(len(t), []).append(t)
        return [
            cls(
                np.stack([point.normalise_x(t.x) for t in same]),
                np.stack([point.normalise_u(t.u) for t in same]),
                np.stack([t.dt for t in same]),
                tuple(same),
            )
            for same in found.values()
        ]

    @property
    def hours(self) -> float:
        """Duration of all."""
        return float(self.dt.sum()) / 3600.0


@dataclass(frozen=True)
class Faulty:
    """Recordings with one fault, and the first sample that can show it."""

    runs: Recorded
    first: int


@dataclass(frozen=True)
class Case:
    """What detectors learn from, where thresholds come from, and what is judged."""

    title: str
    fitted: list[Recorded]
    learn: list[Recorded]
    healthy: list[Recorded]
    faulty: dict[str, Faulty]
    allowed: int
    """Recordings of `learn` that may exceed a threshold."""
    unit: str = "per hour"
    """What false alarms are counted by: this, or "per 100 recordings"."""
    second: float = 1.0
    """What delays are given in: 1 for s, 1e-6 for µs."""
    within: float = 3.0
    """Of the ROC: detected within this time, s."""

    @property
    def transients(self) -> list[Transient]:
        """Those that are fitted."""
        return [t for runs in self.fitted for t in runs.transients]

    @property
    def exposure(self) -> float:
        """Of `healthy`, in that unit."""
        if self.unit == "per hour":
            return sum(runs.hours for runs in self.healthy)
        return sum(len(runs.x) for runs in self.healthy) / 100.0


# --- the turbofan ---

SECONDS, ONSET = 30.0, 10.0
HORIZONS = (10, 20, 40)
"""Steps, of this project's rules on the turbofan."""
BATCH = 120
"""Runs that are simulated together."""
SIZED = ("fan_damage", "compressor_wear", "sensor_drift", "sensor_bias")
FAULTS = (*((kind, size) for kind in SIZED for size in (0.5, 1.0, 2.0)), ("nozzle_stuck", 1.0), ("fuel_stuck", 1.0))


def profile(seed: int) -> tuple[tuple[float, float], ...]:
    """Lever of a run that is not fitted: of six kinds in turn, none like those fitted."""
    options: tuple[dict[str, Any], ...] = (
        {"jumps": 1.0, "hold": (0.8, 3.0)},
        {"jumps": 0.0, "rate": (0.3, 0.8), "hold": (0.5, 2.0)},
        {"jumps": 0.0, "rate": (5.0, 15.0), "hold": (0.8, 4.0)},
        {"jumps": 0.5, "rate": (0.5, 8.0), "hold": (0.3, 6.0)},
        {"jumps": 0.3, "rate": (0.5, 8.0), "hold": (2.0, 8.0)},
    )
    if seed % 6 == 5:
        r = np.random.default_rng(seed)
        return waves(SECONDS, float(r.uniform(1, 4)), float(r.uniform(0.03, 0.1)), float(r.uniform(0.2, 0.6)))
    return from_whole_degrees(lever_moves(SECONDS, seed, **options[seed % 6]))


def from_whole_degrees(moves: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    """The same from a whole angle on, so that few steady states have to be found."""
    start = float(round(moves[0][1]))
    return ((0.0, start), (moves[1][0], start), *moves[2:])


def simulated(runs: list[Run], keep: Path | None, controls: np.ndarray | None = None) -> list[Transient]:
    """Runs of one length, simulated together or read from where they were kept; as `simulate_fleet`."""
    asked_for = hashlib.sha256(repr(runs).encode() + (b"" if controls is None else controls.tobytes()))
    path = keep / f"{asked_for.hexdigest()[:20]}.npz" if keep else None
    if path is not None and path.is_file():
        with np.load(path) as data:
            x, u = data["x"], data["u"]
        signals = turbofan_signals()
        t_ns = START_NS + DT_NS * np.arange(x.shape[1], dtype=np.int64)
        return [
            Transient(t_ns, x[i], u[i], name=f"turbofan {i}", signals=signals, max_gap=signals.max_gap)
            for i in range(len(x))
        ]
    made = simulate_fleet(runs, controls)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, x=np.array([t.x for t in made]), u=np.array([t.u for t in made]))
    return made


def turbofan_run(seed: int, noise: float, fault: Fault | None = None) -> Run:
    """A run of 30 s that is not fitted."""
    return Run(round(SECONDS / DT) + 1, lever=profile(seed), ramps=True, noise=noise, seed=seed, fault=fault)


def of_the_plant(case: Case, noise: float, keep: Path | None) -> tuple[Case, Residuals]:
    """The case for a detector that has the plant itself, and its residuals: readings less the plant's run beside them.

    The plant is run without the fault, with the recorded controls; of a healthy run that leaves the noise alone, which
    is drawn anew.
    """
    point, rng = operating_point(), np.random.default_rng(1)
    kept: dict[int, np.ndarray] = {}
    for faulty in case.faulty.values():
        runs = faulty.runs
        same = [replace(turbofan_run(30000 + i, 0.0), seed=0) for i in range(len(runs.x))]
        controls = np.stack([t.u for t in runs.transients])
        (plant,) = Recorded.of(simulated(same, keep, controls), point)
        kept[id(runs)] = runs.x - plant.x

    def quiet(parts: list[Recorded]) -> list[Recorded]:
        return [replace(runs, x=noise * rng.standard_normal(runs.x.shape)) for runs in parts]

    learn, healthy = quiet(case.learn), quiet(case.healthy)
    kept |= {id(runs): runs.x for runs in (*learn, *healthy)}
    found = replace(
        case, title=case.title.replace("Turbofan", "The plant as model"), fitted=learn[:1], learn=learn, healthy=healthy
    )
    return found, lambda runs: kept[id(runs)][:, 1:]


def turbofan_case(noise: float, options: argparse.Namespace) -> Case:
    """Fitted to two pulse runs and twelve lever profiles; everything else has other levers."""
    point, keep = operating_point(), options.keep
    moves = [from_whole_degrees(m) for m in FITTED_MOVES]
    long = [Run(LONG, lever=m, ramps=True, noise=noise, seed=300 + i) for i, m in enumerate(moves)]
    pulses = [make_run("pulses", a, noise, seed) for a, seed in ((LARGE, 1), (-LARGE, 2))]
    seeds = 4 if options.quick else options.seeds
    healthy = 48 if options.quick else round(options.hours * 3600.0 / SECONDS)
    learn = healthy // 2

    def healthy_runs(first: int, count: int) -> list[Recorded]:
        together = [turbofan_run(seed, noise) for seed in range(first, first + count)]
        found = [simulated(together[i : i + BATCH], keep) for i in range(0, count, BATCH)]
        return [r for made in found for r in Recorded.of(made, point)]

    faulty_runs = [turbofan_run(30000 + i, noise, Fault(k, ONSET, s)) for i in range(seeds) for k, s in FAULTS]
    step = 10 * len(FAULTS)
    made = [t for i in range(0, len(faulty_runs), step) for t in simulated(faulty_runs[i : i + step], keep)]
    faulty = {}
    for j, (kind, size) in enumerate(FAULTS):
        (runs,) = Recorded.of(made[j :: len(FAULTS)], point)
        label = kind.replace("_", " ") + ("" if kind.endswith("stuck") else f" × {size:g}")
        faulty[label] = Faulty(runs, Fault(kind, ONSET).first_sample(DT))
    fitted = Recorded.of(simulated(pulses, keep) + simulated(long, keep), point)
    learnt = healthy_runs(10000, learn)
    allowed = min(allowed_alarms(options.rate, sum(runs.hours for runs in learnt)), learn - 1)
    return Case(f"Turbofan, noise {noise:g}", fitted, learnt, healthy_runs(20000, healthy), faulty, allowed)


# --- a saturating coil, three tanks ---

COIL_POINT = OperatingPoint(
    np.zeros(2), np.zeros(1), np.array([40.0, 8.0]), np.array([40.0]), np.zeros(1), np.array([8.0])
)  # V, A
TANKS_POINT = OperatingPoint(np.zeros(3), np.zeros(1), np.ones(3), np.ones(1))


def coil_case(options: argparse.Namespace) -> Case:
    """The circuit with a saturating coil: R and L change, the current's sensor is biased; noise of 1e-3."""
    samples, onset = 401, 150
    count = (20, 40, 40, 4) if options.quick else (20, 600, 1200, options.seeds)
    scale = COIL_POINT.X

    def noisy(transients: list[Transient], first: int, bias: float = 0.0) -> list[Transient]:
        found = []
        for i, t in enumerate(transients):
            x = t.x + 1e-3 * scale * np.random.default_rng([first, i]).standard_normal(t.x.shape)
            x[onset:, 1] += bias * scale[1]
            names: dict[str, Any] = {"state_names": ["V_C", "I_L"], "control_names": ["V_IN"]}
            names |= {"s": np.abs(x[:, 1:]), "scheduling_names": ["I_L_magnitude"]}
            found.append(Transient(t.t_ns, x, t.u, name=t.name, **names))
        return found

    def seeds(first: int, number: int) -> range:
        return range(first, first + number)

    fitted = noisy(coil_runs(seeds(0, count[0]), samples), 0)
    point = COIL_POINT

    def recorded(transients: list[Transient]) -> list[Recorded]:
        return Recorded.of(transients, point)

    faulty = {}
    for what, shares in (("more_resistance", (0.1, 0.2, 0.5)), ("more_inductance", (0.05, 0.1, 0.2))):
        for share in shares:
            factors: dict[str, Any] = {what: 1.0 + share}
            made = noisy(coil_runs(seeds(3000, count[3]), samples, onset=onset, **factors), 3000)
            name = what.removeprefix("more_")
            faulty[f"{name} × {1 + share:g}"] = Faulty(recorded(made)[0], onset + 1)
    for bias in (0.01, 0.02, 0.05):
        made = noisy(coil_runs(seeds(3000, count[3]), samples), 3000, bias)
        faulty[f"bias of the current × {100 * bias:g} %"] = Faulty(recorded(made)[0], onset)
    learn, healthy = (noisy(coil_runs(seeds(f, c), samples), f) for f, c in ((1000, count[1]), (5000, count[2])))
    return Case(
        "Saturating coil, noise 0.001", recorded(fitted), recorded(learn), recorded(healthy), faulty,
        len(learn) // 100, "per 100 recordings", 1e-6, 2e-5,
    )  # fmt: skip


def tanks_case(options: argparse.Namespace) -> Case:
    """Three tanks: the second outlet passes less from half time on; noise of 1e-3."""
    count = (20, 40, 40, 4) if options.quick else (20, 600, 1200, options.seeds)
    plant, steps = Tanks(), 300
    settings: dict[str, Any] = {"steps": steps, "noise": 1e-3}
    point = TANKS_POINT
    fitted, learn, healthy = (plant.transients(c, f, **settings) for f, c in enumerate(count[:3]))
    faulty = {
        f"outlet passes less × {share:.0%}": Faulty(
            Recorded.of(plant.transients(count[3], 3, fault=share, **settings), point)[0], steps // 2 + 1
        )
        for share in (0.01, 0.02, 0.05)
    }
    return Case(
        "Three tanks, noise 0.001", Recorded.of(fitted, point), Recorded.of(learn, point),
        Recorded.of(healthy, point), faulty, len(learn) // 100, "per 100 recordings",
    )  # fmt: skip
