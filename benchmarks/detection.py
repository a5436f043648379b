# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Which faults are seen, how fast, at how many false alarms: this project's rules beside other detectors.

    ./run python benchmarks/detection.py turbofan            # two levels of noise; 40 min the first time, then 15
    ./run python benchmarks/detection.py crazypad coil tanks # a real quadcopter, a saturating circuit, three tanks
    ./run python benchmarks/detection.py all --quick         # the same with few runs, to see that it works

Every detector learns from the same fitted recordings, and every threshold is learnt in the same way, from healthy
recordings that were not fitted: the smallest value that at most RATE times their hours of these recordings exceed, with
--rate alarmed recordings per hour; on CrazyPAD, the largest value on the flights left out. Then the false alarms are
counted on further healthy recordings, and the faults on others again. Simulated recordings are of 30 s or less, so that
"alarms per hour" are recordings with an alarm per hour of recording.

scikit-learn, MAPIE and SENTIL are asked from the interpreter --peers (default: .venv-detection/bin/python). Make it:

    python3 -m venv .venv-detection && .venv-detection/bin/pip install scikit-learn mapie sentil

Without it they are left out, which is said. --keep FOLDER keeps simulated runs and the scores of those peers, and
reads them again the next time; --write docs/detection.md replaces the tables of that page, --figures docs its figures,
--json FILE keeps all numbers.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from detectors import (
    Kalman,
    LeastSquares,
    Runs,
    Score,
    Statistic,
    hotelling,
    median_step,
    of_window,
    principal_components,
    residual_detectors,
)
from regimes import CRAZYPAD, FITTED_MOVES, LONG, shared, waves
from scipy.stats import beta, chi2
from turbofan_fleet import simulate_fleet

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from tanks import Tanks  # noqa: E402

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI, fit, read_transients  # noqa: E402
from uncertain_lti.base.errors import UncertainLTIError  # noqa: E402
from uncertain_lti.model.alarm_rule import AlarmRule, Rule, StatisticRule, labels  # noqa: E402
from uncertain_lti.model.operating_point import OperatingPoint  # noqa: E402
from uncertain_lti.plants.coil import STEP_NS, coil_runs  # noqa: E402
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
from uncertain_lti.validation.blocks import cut  # noqa: E402
from uncertain_lti.validation.false_alarms import allowed_alarms  # noqa: E402

Array = np.ndarray
CONFIDENCE = 0.9
OURS = "ours"
"""Names of this project's rules begin with it."""


# --- recordings ---


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
    def exposure(self) -> float:
        """Of `healthy`, in that unit."""
        if self.unit == "per hour":
            return sum(runs.hours for runs in self.healthy)
        return sum(len(runs.x) for runs in self.healthy) / 100.0


# --- what is reported ---


@dataclass(frozen=True)
class Outcome:
    """One detector on one case."""

    threshold: float
    alarmed: int
    exposure: float
    largest: Array
    peaks: dict[str, Array] = field(default_factory=dict)
    delays: dict[str, Array] = field(default_factory=dict)
    early: dict[str, Array] = field(default_factory=dict)

    @property
    def rate(self) -> tuple[float, float, float]:
        """False alarms by the case's unit with an interval, by Poisson's law."""
        low = chi2.ppf((1 - CONFIDENCE) / 2, 2 * self.alarmed) / 2 if self.alarmed else 0.0
        high = chi2.ppf((1 + CONFIDENCE) / 2, 2 * self.alarmed + 2) / 2
        return self.alarmed / self.exposure, low / self.exposure, high / self.exposure

    def seen(self, label: str) -> Array:
        """Whether each recording with that fault raised the alarm."""
        return np.isfinite(self.delays[label])

    def share(self) -> float:
        """Share of the recordings detected, every fault counting alike."""
        return float(np.mean([self.seen(label).mean() for label in self.delays]))


def threshold_of(case: Case, score: Score, allowed: int) -> float:
    """The smallest value that as many recordings of `learn` exceed, and no more."""
    return float(np.sort(np.concatenate([score(runs).max(axis=1) for runs in case.learn]))[::-1][allowed])


def evaluate(case: Case, score: Score) -> Outcome:
    """Learn the threshold, count false alarms, find the delays."""
    threshold = threshold_of(case, score, case.allowed)
    largest = np.concatenate([score(runs).max(axis=1) for runs in case.healthy])
    peaks, delays, early = {}, {}, {}
    for label, faulty in case.faulty.items():
        after = score(faulty.runs)[:, faulty.first :]
        elapsed = np.cumsum(faulty.runs.dt[:, faulty.first - 1 :], axis=1)
        above = after > threshold
        first = above.argmax(axis=1)
        delays[label] = np.where(above.any(axis=1), elapsed[np.arange(len(first)), first], np.inf)
        peaks[label] = after.max(axis=1)
        early[label] = np.where(elapsed <= case.within, after, -np.inf).max(axis=1)
    return Outcome(threshold, int((largest > threshold).sum()), case.exposure, largest, peaks, delays, early)


def share_interval(hits: int, count: int) -> tuple[float, float]:
    """Clopper and Pearson's."""
    tail = (1 - CONFIDENCE) / 2
    low = float(beta.ppf(tail, hits, count - hits + 1)) if hits else 0.0
    high = float(beta.ppf(1 - tail, hits + 1, count - hits)) if hits < count else 1.0
    return low, high


def delay_text(delays: Array, second: float = 1.0) -> str:
    """Median and 90 % delay; the share detected where it is not all."""
    middle, late = (quantile_text(delays, q, second) for q in (0.5, 0.9))
    seen = np.isfinite(delays).mean()
    return f"{middle} / {late}" + ("" if seen == 1.0 else f" ({seen:.0%})")


def quantile_text(delays: Array, q: float, second: float) -> str:
    """One quantile of delays, in that part of a second; – where so many were not detected."""
    found = float(np.quantile(delays, q, method="higher"))
    return "–" if math.isinf(found) else f"{found / second:.2g}"


def rows_of(case: Case, outcomes: Mapping[str, Outcome]) -> tuple[list[str], list[list[str]]]:
    """One row per detector: false alarms, share detected, median delay; sizes of a kind in turn."""
    labels, rows = list(case.faulty), []
    kinds: dict[str, list[str]] = {}
    for label in labels:
        kinds.setdefault(label.split(" × ")[0], []).append(label)
    for name, o in outcomes.items():
        mean, low, high = o.rate
        hits = sum(int(o.seen(label).sum()) for label in labels)
        least, most = share_interval(hits, sum(len(o.delays[label]) for label in labels))
        cells = [
            " ".join(quantile_text(o.delays[label], 0.5, case.second) for label in same) for same in kinds.values()
        ]
        rows.append(
            [
                name, f"{mean:.2g} ({low:.2g} to {high:.2g})",
                f"{o.share():.1%} ({least:.1%} to {most:.1%})", *cells,
            ]
        )  # fmt: skip
    sized = [
        kind + (" × " + " ".join(label.split(" × ")[1] for label in same) if len(same) > 1 else "")
        for kind, same in kinds.items()
    ]
    return ["detector", f"false alarms {case.unit}", "detected", *sized], rows


def table_text(title: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return f"**{title}**\n\n" + "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def later(one: Array, other: Array, rng: np.random.Generator) -> tuple[float, float, float]:
    """Median of the paired ratio of delays, bootstrap interval over the recordings; a miss is twice the longest."""
    worst = 2.0 * max([*one[np.isfinite(one)], *other[np.isfinite(other)], DT])
    ratio = np.where(np.isfinite(one), one, worst) / np.where(np.isfinite(other), other, worst)
    draws = np.median(ratio[rng.integers(0, len(ratio), (1000, len(ratio)))], axis=1)
    low, high = np.quantile(draws, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(np.median(ratio)), float(low), float(high)


# --- this project's rules ---


@dataclass(frozen=True)
class Kind:
    """A rule of the alarm but for its threshold.

    Parameters
    ----------
    kind : {"containment", "energy", "mean", "ewma", "cusum", "chi2", "mewma"}
        As `AlarmRule` and `StatisticRule` have it. Containment is 1 of 1, or half of the verdicts of the window.
    window : float
        Of it, s; 0 for one sample.
    horizon : int, default 1
        Steps.
    allowance : float, default 0.0
        Of cusum.
    """

    kind: str
    window: float = 0.0
    horizon: int = 1
    allowance: float = 0.0

    @property
    def name(self) -> str:
        """As tables call it."""
        over = "" if self.horizon == 1 else f" over {self.horizon} steps"
        long = f"{self.window * 1e6:g} µs" if self.window < 1e-3 else f"{self.window:g} s"
        return self.kind + (f" {long}" if self.window else "") + over

    def rule(self, threshold: float, step: float) -> Rule:
        """With its threshold: a margin, or that of the statistic."""
        if self.kind == "containment":
            count = max(1, round(self.window / step))
            return AlarmRule((count + 1) // 2, count, threshold, self.horizon)
        return StatisticRule(self.kind, max(self.window, step), threshold, self.horizon, self.allowance)


@dataclass(frozen=True)
class OurRules:
    """Scores of rules by the monitor itself: a statistic by its own arithmetic, containment by the utilisation."""

    model: UncertainLTI
    kinds: tuple[Kind, ...]
    step: float
    kept: dict[int, tuple[Recorded, dict[Kind, Array], Array]] = field(default_factory=dict)

    def scores(self, name: str) -> dict[str, Score]:
        """One for each rule; the alarm is raised where it exceeds the threshold."""
        return {f"{name}, {kind.name}": lambda runs, kind=kind: self._of(runs)[0][kind] for kind in self.kinds}  # type: ignore[misc]

    def residuals(self, horizon: int) -> Callable[[Runs], Array]:
        """Residuals over half-widths, the utilisation; 0 where there is no verdict."""
        row = self.steps.index(horizon)
        return lambda runs: np.nan_to_num(self._of(runs)[1][:, 1:, row])

    @property
    def steps(self) -> list[int]:
        """1, and the steps of the horizons."""
        return [1, *(h.steps for h in self.model.horizons)]

    def _of(self, runs: Runs) -> tuple[dict[Kind, Array], Array]:
        if id(runs) not in self.kept:
            assert isinstance(runs, Recorded)
            self.kept[id(runs)] = (runs, *self._computed(runs))
        return self.kept[id(runs)][1:]

    def _computed(self, runs: Recorded) -> tuple[dict[Kind, Array], Array]:
        statistics = [kind for kind in self.kinds if kind.kind != "containment"]
        rules = [kind.rule(1.0, self.step) for kind in statistics]
        monitor = EnvelopeMonitor(self.model, rules=[AlarmRule(), *rules])
        values: dict[Kind, list[Array]] = {kind: [] for kind in statistics}
        used = []
        for t in runs.transients:
            verdicts = monitor.check(t)
            used.append(verdicts.horizon_utilisation)
            of = [name.split("/")[0] for name in verdicts.statistic_names]
            for kind, label in zip(statistics, labels(rules), strict=True):
                columns = [j for j, name in enumerate(of) if name == label]
                values[kind].append(np.abs(verdicts.statistics[:, columns]).max(axis=1))
        table = np.stack(used)
        found = {kind: np.nan_to_num(np.stack(rows), nan=-np.inf, posinf=np.inf) for kind, rows in values.items()}
        for kind in self.kinds:
            rule = kind.rule(1.0, self.step)
            if isinstance(rule, AlarmRule):
                level = np.abs(table[:, :, self.steps.index(kind.horizon)]).max(axis=2)
                found[kind] = of_window(np.where(np.isnan(level), -np.inf, level), rule.violations, rule.window)
        return found, table


def our_rules(model: UncertainLTI, fitted: Sequence[Recorded], kinds: Sequence[Kind]) -> OurRules:
    """Those of these rules that the model has the horizon for."""
    steps = (1, *(h.steps for h in model.horizons))
    return OurRules(model, tuple(kind for kind in kinds if kind.horizon in steps), median_step(fitted))


def armed_together(scores: Sequence[Score], case: Case) -> Score:
    """Several rules, each with its share of the false alarms: the largest of the values over their thresholds."""
    limits = [threshold_of(case, score, case.allowed // len(scores)) for score in scores]
    return lambda runs: np.maximum.reduce([score(runs) / limit for score, limit in zip(scores, limits, strict=True)])


# --- other detectors ---


def other_detectors(
    fitted: Sequence[Recorded],
    windows: Sequence[float],
    slacks: Sequence[float] = (0.25, 0.5),
    weights: Sequence[float] = (0.02, 0.1),
) -> dict[str, Score]:
    """What a user would set up: residuals of least squares, Kalman's innovations, [x u] itself."""
    law = LeastSquares.of(fitted)
    windowed = [Statistic("chi2", window) for window in (0.0, *windows)]
    slow = [*(Statistic("CUSUM", slack) for slack in slacks), *(Statistic("MEWMA", weight) for weight in weights)]
    found: dict[str, Score] = {}
    for residuals, name, statistics in (
        (law, "least squares", [Statistic("3 sigma"), *windowed, *slow]),
        (Kalman.likeliest(fitted, law), "Kalman, likeliest", [*windowed, *slow]),
        (Kalman.of(fitted, law, 0.1, 0.1), "Kalman, slow", [*windowed, *slow]),
    ):
        for statistic, score in residual_detectors(residuals, fitted, statistics).items():
            found[f"{name}, {statistic}"] = score
    found["Hotelling on [x u]"] = hotelling(fitted)
    for share in (0.99, 0.9999):
        found[f"PCA-SPE on [x u], {100 * share:g} %"] = principal_components(fitted, share)
    return found


def asked(case: Case, peers: str, keep: Path | None = None) -> dict[str, Score]:
    """Scores of detection_peers.py, from its own interpreter; empty, and said, if it is not there."""
    sets: dict[str, Recorded] = {f"fitted{i}": runs for i, runs in enumerate(case.fitted)}
    sets |= {f"learn{i}": runs for i, runs in enumerate(case.learn)}
    sets |= {f"healthy{i}": runs for i, runs in enumerate(case.healthy)}
    sets |= {f"faulty{i}": faulty.runs for i, faulty in enumerate(case.faulty.values())}
    script = Path(__file__).with_name("detection_peers.py")
    with tempfile.TemporaryDirectory() as folder:
        given, answer = Path(folder) / "in.npz", Path(folder) / "out.npz"
        np.savez(given, **{f"{k}_{name}": getattr(runs, k) for name, runs in sets.items() for k in ("x", "u", "dt")})
        if keep is not None:  # scores of the same script on the same recordings
            asked_for = hashlib.sha256(script.read_bytes())
            for runs in sets.values():
                asked_for.update(runs.x.tobytes() + runs.u.tobytes())
            answer = keep / f"peers-{asked_for.hexdigest()[:20]}.npz"
        if not answer.is_file():
            try:
                subprocess.run(
                    [peers, str(script), str(given), str(answer)], check=True, capture_output=True, text=True
                )
            except (OSError, subprocess.CalledProcessError) as error:
                reason = (getattr(error, "stderr", "") or str(error)).strip().splitlines()[-1]
                print(f"scikit-learn, MAPIE and SENTIL are left out: {reason}", file=sys.stderr)
                return {}
        with np.load(answer) as data:
            scores = {key: data[key] for key in data}
    found: dict[str, Score] = {}
    for detector in sorted({key.split("|")[0] for key in scores}):
        by_runs = {id(runs): scores[f"{detector}|{name}"] for name, runs in sets.items()}
        found[detector] = lambda runs, by_runs=by_runs: by_runs[id(runs)]  # type: ignore[misc]
    return found


# --- the turbofan ---

SECONDS, ONSET = 30.0, 10.0
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


def simulated(runs: list[Run], keep: Path | None) -> list[Transient]:
    """Runs of one length, simulated together or read from where they were kept."""
    path = keep / f"{hashlib.sha256(repr(runs).encode()).hexdigest()[:20]}.npz" if keep else None
    if path is not None and path.is_file():
        with np.load(path) as data:
            x, u = data["x"], data["u"]
        signals = turbofan_signals()
        t_ns = START_NS + DT_NS * np.arange(x.shape[1], dtype=np.int64)
        return [
            Transient(t_ns, x[i], u[i], name=f"turbofan {i}", signals=signals, max_gap=signals.max_gap)
            for i in range(len(x))
        ]
    made = simulate_fleet(runs)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, x=np.array([t.x for t in made]), u=np.array([t.u for t in made]))
    return made


def turbofan_run(seed: int, noise: float, fault: Fault | None = None) -> Run:
    """A run of 30 s that is not fitted."""
    return Run(round(SECONDS / DT) + 1, lever=profile(seed), ramps=True, noise=noise, seed=seed, fault=fault)


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


HORIZONS = (10, 20, 40)
"""Steps, of the turbofan."""
OF_UTILISATION = (
    Kind("containment"), Kind("containment", 0.5), Kind("energy", 0.5), Kind("energy", 2.0), Kind("mean", 2.0),
    Kind("ewma", 1.0), Kind("cusum", 1.0, 1, 0.05), Kind("chi2"), Kind("chi2", 2.0), Kind("mewma", 1.2),
    *(
        Kind(kind, window, h)
        for h in HORIZONS
        for kind, window in (
            ("containment", 0.0), ("energy", 2.0), ("mean", 2.0), ("chi2", 0.0), ("chi2", 2.0), ("mewma", 1.2),
        )
    ),
)  # fmt: skip
TOGETHER = (Kind("containment"), Kind("containment", 0.0, 10), Kind("energy", 2.0, 10))
"""Rules that are armed together, the false alarms shared."""


def turbofan(options: argparse.Namespace) -> list[Report]:
    """Both levels of noise."""
    reports = []
    for noise in options.noise:
        case = turbofan_case(noise, options)
        detectors = other_detectors(case.fitted, (0.5, 2.0)) | asked(case, options.peers, keep=options.keep)
        transients = [t for runs in case.fitted for t in runs.transients]
        for knots in (1, 3):
            schedule = None if knots == 1 else {"fan_speed": knots}
            model = with_horizons(transients, "qp", "both", schedule, HORIZONS)
            name = f"{OURS}, {knots} knot" + "s" * (knots > 1)
            ours = our_rules(model, case.fitted, OF_UTILISATION)
            detectors |= ours.scores(name)
            if knots == 3:
                detectors |= on_our_residuals(f"{knots} knots", ours, case.fitted)
        armed = [f"{OURS}, 3 knots, {kind.name}" for kind in TOGETHER]
        detectors[f"{OURS}, 3 knots, armed together"] = armed_together([detectors[rule] for rule in armed], case)
        report = judged(case, detectors, options)
        further = false_violations(case, detectors) + "\n" + six_manoeuvres(report.outcomes)
        reports.append(replace(report, text=f"{report.text}\n{further}"))
    return reports


def false_violations(case: Case, detectors: Mapping[str, Score]) -> str:
    """Verdicts of healthy runs outside the envelope as it was fitted, at margin 1, for every horizon."""
    rows = []
    for knots in ("1 knot", "3 knots"):
        for horizon in (1, *HORIZONS):
            score = detectors[f"{OURS}, {knots}, {Kind('containment', 0.0, horizon).name}"]
            peaks, outside, verdicts = [], 0, 0
            for runs in case.healthy:
                values = score(runs)
                outside += int((values > 1.0).sum())
                verdicts += int(np.isfinite(values).sum())
                peaks.append(values.max(axis=1))
            largest = np.concatenate(peaks)
            rows.append(
                [
                    knots, str(horizon), f"{outside / verdicts:.2g}", f"{(largest > 1.0).mean():.1%}",
                    f"{np.median(largest):.2f}", f"{largest.max():.2f}",
                ]
            )  # fmt: skip
    header = ["knots", "steps", "violated verdicts", "runs with one", "largest utilisation of a run, median", "of all"]
    title = f"{case.title}: healthy runs outside the envelopes as fitted, {case.exposure:.3g} h"
    return table_text(title, header, rows)


def six_manoeuvres(outcomes: Mapping[str, Outcome]) -> str:
    """Which rules of ours raise the alarm on the first six healthy runs, one of each kind of lever."""
    ours = {name: int((o.largest[:6] > o.threshold).sum()) for name, o in outcomes.items() if name.startswith(OURS)}
    alarmed = [name for name, count in ours.items() if count]
    return (
        f"Six healthy runs, one of each kind of lever: of {len(ours)} rules of ours, "
        + (f"{len(alarmed)} raised an alarm ({', '.join(alarmed)})." if alarmed else "none raised an alarm.")
        + "\n"
    )


def on_our_residuals(name: str, ours: OurRules, fitted: Sequence[Recorded]) -> dict[str, Score]:
    """The usual statistics on our residuals, of one step and of the shortest horizon."""
    statistics = [Statistic("3 sigma"), Statistic("chi2"), Statistic("CUSUM", 0.5), Statistic("MEWMA", 0.02)]
    found = {}
    for horizon in ours.steps[:2]:
        over = "" if horizon == 1 else f" over {horizon} steps"
        for statistic, score in residual_detectors(ours.residuals(horizon), fitted, statistics).items():
            found[f"our residuals, {name}{over}, {statistic}"] = score
    return found


def with_horizons(
    transients: Sequence[Transient], criterion: str, additive: str, schedule: Any, steps: Sequence[int], **more: Any
) -> UncertainLTI:
    """The public fit, with these horizons."""
    further: dict[str, Any] = {"horizons": list(steps)} if steps else {}
    return fit(transients, criterion, additive=additive, schedule=schedule, **further, **more)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Report:
    """Tables of one part in Markdown, and all numbers."""

    name: str
    text: str
    numbers: dict[str, Any]
    outcomes: dict[str, Outcome] = field(default_factory=dict)
    unit: str = "per hour"
    detected: str = ""
    """What the ROC shows."""
    linear: float = 0.5
    """Up to there its axis is linear, and this is where it ends."""
    most: float = 120.0


def judged(case: Case, detectors: Mapping[str, Score], options: argparse.Namespace) -> Report:
    """Every detector on the case."""
    outcomes = {}
    for name, score in detectors.items():
        outcomes[name] = evaluate(case, score)
        print(f"{case.title}: {name}: {outcomes[name].share():.3f}", file=sys.stderr, flush=True)
    learnt = sum(len(runs.x) for runs in case.learn)
    exposure = f"{case.exposure:.3g} h" if case.unit == "per hour" else f"{100 * case.exposure:.0f} recordings"
    unit = "s" if case.second == 1.0 else "µs"
    title = (
        f"{case.title}: median delay, {unit}; thresholds that {case.allowed} of {learnt} healthy recordings exceed, "
        f"false alarms counted on {exposure}"
    )
    text = table_text(title, *rows_of(case, outcomes)) + "\n"
    text += beside_the_best(case, outcomes)
    shown = f"detected within {case.within / case.second:g} {unit}, mean over faults"
    linear, most = (0.5, 120.0) if case.unit == "per hour" else (1.0, 100.0)
    numbers = {name: numbers_of(o) for name, o in outcomes.items()}
    return Report(case.title, text, numbers, outcomes, case.unit, shown, linear, most)


def numbers_of(o: Outcome) -> dict[str, Any]:
    """Plain data."""
    return {
        "threshold": o.threshold,
        "false_alarms_per_hour": o.rate,
        "alarmed": o.alarmed,
        "exposure": o.exposure,
        "share": o.share(),
        "delays": {label: [d if math.isfinite(d) else None for d in ds.tolist()] for label, ds in o.delays.items()},
    }


def beside_the_best(case: Case, outcomes: Mapping[str, Outcome]) -> str:
    """Delay of our best rule over that of the best other detector, for every fault, over the same recordings."""
    rng, rows = np.random.default_rng(0), []
    together = next((name for name in outcomes if name.endswith("armed together")), "")
    for label in case.faulty:

        def order(name: str, label: str = label) -> tuple[float, float]:
            delays = outcomes[name].delays[label]
            return -float(np.isfinite(delays).mean()), float(np.median(delays))

        mine = min((n for n in outcomes if n.startswith(OURS + ",")), key=order)
        cells = [label, mine, delay_text(outcomes[mine].delays[label], case.second)]
        for begins in ("least squares", ""):
            peer = min((n for n in outcomes if n.startswith(begins) and not n.startswith("our")), key=order)
            cells += [peer, delay_text(outcomes[peer].delays[label], case.second)]
            for name in filter(None, (mine, together)):
                ratio, low, high = later(outcomes[name].delays[label], outcomes[peer].delays[label], rng)
                cells.append(f"{ratio:.2f} ({low:.2f} to {high:.2f})")
        rows.append(cells)
    ratios = ["ratio", "ratio, armed together"] if together else ["ratio"]
    header = [
        "fault", "our best rule", "delay", "best on least squares", "delay", *ratios,
        "best of all others", "delay", *ratios,
    ]  # fmt: skip
    title = f"{case.title}: our best rule for each fault beside the best of the others; median of the paired ratios"
    return table_text(title, header, rows)


# --- CrazyPAD ---


def crazypad(options: argparse.Namespace) -> list[Report]:
    """Real flights: fitted to some healthy ones, threshold from those left out, 14 damaged ones judged."""
    folder = shared() / "crazypad"
    labels = json.loads((folder / "labels.json").read_text())
    with tempfile.TemporaryDirectory() as name:
        signals = Path(name) / "signals.yaml"
        signals.write_text(CRAZYPAD)
        flights = dict(zip(labels, read_transients([folder / file for file in labels], signals), strict=True))
    airborne = {}
    for file, t in flights.items():
        inside = [np.flatnonzero((t.t >= low) & (t.t <= high)) for low, high in labels[file]["airborne_s"]]
        airborne[file] = [cut(t, int(k[0]), int(k[-1]) + 1) for k in inside]
    healthy = [file for file in labels if not labels[file]["faulty"]]
    damaged = [file for file in labels if labels[file]["faulty"]]
    shares: dict[str, list[list[bool]]] = {}
    scaled: dict[str, tuple[list[float], list[float]]] = {}
    kinds = [Kind("containment"), *(Kind(k, w) for k in ("energy", "mean", "chi2") for w in (0.5, 4.0))]
    kinds += [Kind("energy", 2.0), Kind("cusum", 1.0, 1, 0.02)]
    draws = list(combinations(healthy, 3)) + ([] if options.quick else list(combinations(healthy, 2)))
    for fitted_files in draws:
        left = [f for f in healthy if f not in fitted_files]
        transients = [t for f in fitted_files for t in airborne[f]]
        models = {
            f"{name}, {additive}": fit(transients, criterion, additive=additive)  # type: ignore[arg-type]
            for criterion, name in (("qp", "(10)"), ("lp", "(11)"))
            for additive in ("noise", "both")
        }
        point = models["(10), noise"].operating_point

        def recorded(files: Iterable[str], point: OperatingPoint = point) -> dict[str, list[Recorded]]:
            return {f: Recorded.of(airborne[f], point) for f in files}

        fitted = [r for runs in recorded(fitted_files).values() for r in runs]
        judged_left, judged_damaged = recorded(left), recorded(damaged)
        detectors = other_detectors(fitted, (0.2, 0.5), (0.1, 0.25, 0.5), (0.005, 0.01, 0.02, 0.1))
        pieces = [r for runs in (*judged_left.values(), *judged_damaged.values()) for r in runs]
        case = Case("", fitted, [], [], {str(i): Faulty(r, 1) for i, r in enumerate(pieces)}, 0)
        detectors |= asked(case, options.peers, options.keep)
        for name, model in models.items():
            detectors |= our_rules(model, fitted, kinds).scores(f"{OURS}, {name}")
        for name, score in detectors.items():

            def largest(runs: list[Recorded], score: Score = score) -> float:
                return max(float(score(r).max()) for r in runs)

            quiet = [largest(runs) for runs in judged_left.values()]
            peaks = [largest(runs) for runs in judged_damaged.values()]
            shares.setdefault(name, []).append([peak > max(quiet) for peak in peaks])
            scale = largest(fitted)  # of this draw: for the ROC, draws are laid together
            for pooled, found in zip(scaled.setdefault(name, ([], [])), (quiet, peaks), strict=True):
                pooled += [peak / scale for peak in found]
    outcomes = {}
    for name, pooled in scaled.items():
        quiet, peaks = (np.array(values) for values in pooled)
        outcomes[name] = Outcome(float(quiet.max()), 0, len(quiet) / 100.0, quiet, early={"damaged": peaks})
    return [replace(crazypad_report(shares, draws, damaged), outcomes=outcomes)]


def crazypad_report(shares: Mapping[str, list[list[bool]]], draws: Sequence[Any], damaged: Sequence[str]) -> Report:
    """Share of damaged flights seen, over draws; differences from the best other detector, paired."""
    seen = {name: np.array(rows, dtype=float) for name, rows in shares.items()}
    three = np.array([len(d) == 3 for d in draws])
    peer = max((n for n in seen if not n.startswith(OURS)), key=lambda n: seen[n].mean())
    rng, rows = np.random.default_rng(0), []
    pick = rng.integers(0, len(damaged), (2000, len(damaged)))
    for name, values in sorted(seen.items(), key=lambda item: -item[1].mean()):
        difference = (values - seen[peer]).mean(axis=0)
        low, high = np.quantile(difference[pick].mean(axis=1), [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
        rows.append(
            [
                name, f"{values[three].mean():.2f}", f"{values[~three].mean():.2f}" if (~three).any() else "–",
                f"{difference.mean():+.2f} ({low:+.2f} to {high:+.2f})",
            ]
        )  # fmt: skip
    title = (
        f"CrazyPAD: share of {len(damaged)} damaged flights above the largest value on the healthy flights left out; "
        f"difference from {peer}, paired, interval over the damaged flights"
    )
    header = ["detector", "fitted to 3 of 4 healthy", "fitted to 2 of 4", "difference, all draws"]
    numbers = {name: values.mean(axis=1).tolist() for name, values in seen.items()}
    shown = "damaged flights detected, all draws"
    text = table_text(title, header, rows)
    return Report("CrazyPAD", text, numbers, {}, "per 100 recordings", shown, 10.0, 100.0)


# --- a saturating coil, three tanks ---


def coil(options: argparse.Namespace) -> list[Report]:
    """The circuit with a saturating coil: R and L change, the current's sensor is biased; noise of 1e-3."""
    samples, onset = 401, 150
    count = (20, 40, 40, 4) if options.quick else (20, 600, 1200, options.seeds)
    scale = np.array([40.0, 8.0])  # V, A

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
    point = OperatingPoint(np.zeros(2), np.zeros(1), scale, np.array([40.0]), np.zeros(1), scale[1:])

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
    case = Case(
        "Saturating coil, noise 0.001", recorded(fitted), recorded(learn), recorded(healthy), faulty,
        len(learn) // 100, "per 100 recordings", 1e-6, 2e-5,
    )  # fmt: skip
    step = STEP_NS * 1e-9
    return [plain_case(case, fitted, point, "I_L_magnitude", (2, 8), (20 * step, 80 * step), (), options)]


def plain_case(
    case: Case, fitted: list[Transient], point: OperatingPoint, signal: str, knots: Sequence[int],
    windows: Sequence[float], horizons: Sequence[int], options: argparse.Namespace,
) -> Report:  # fmt: skip
    """The other detectors, and this project's rules with these numbers of knots."""
    detectors = other_detectors(case.fitted, windows) | asked(case, options.peers, options.keep)
    steps = (1, *horizons)
    kinds = [Kind("containment", 0.0, h) for h in steps]
    kinds += [Kind(kind, w, h) for h in dict.fromkeys((1, steps[-1])) for w in windows for kind in ("energy", "mean")]
    kinds += [Kind("chi2", w) for w in windows]
    for count in knots:
        schedule = None if count == 1 else {signal: count}
        model = with_horizons(fitted, "qp", "both", schedule, horizons, operating_point=point)
        plural = "" if count == 1 else "s"
        detectors |= our_rules(model, case.fitted, kinds).scores(f"{OURS}, {count} knot{plural}")
    return judged(case, detectors, options)


def tanks(options: argparse.Namespace) -> list[Report]:
    """Three tanks: the second outlet passes less from half time on; noise of 1e-3."""
    count = (20, 40, 40, 4) if options.quick else (20, 600, 1200, options.seeds)
    plant, steps = Tanks(), 300
    settings: dict[str, Any] = {"steps": steps, "noise": 1e-3}
    point = OperatingPoint(np.zeros(3), np.zeros(1), np.ones(3), np.ones(1))
    fitted, learn, healthy = (plant.transients(c, f, **settings) for f, c in enumerate(count[:3]))
    faulty = {
        f"outlet passes less × {share:.0%}": Faulty(
            Recorded.of(plant.transients(count[3], 3, fault=share, **settings), point)[0], steps // 2 + 1
        )
        for share in (0.01, 0.02, 0.05)
    }
    case = Case(
        "Three tanks, noise 0.001", Recorded.of(fitted, point), Recorded.of(learn, point),
        Recorded.of(healthy, point), faulty, len(learn) // 100, "per 100 recordings",
    )  # fmt: skip
    return [plain_case(case, fitted, point, "x2", (1, 3), (2.0, 5.0), (10, 40), options)]


# --- figure, page, command ---


@dataclass(frozen=True)
class Drawn:
    """A family of detectors in the figures: of those whose names begin so, the one that detects most."""

    label: str
    begins: tuple[str, ...]
    colour: str
    contains: str = ""


FAMILIES = (
    Drawn("3 sigma, least squares", ("least squares, 3 sigma",), "#9a9a9a"),
    Drawn("CUSUM, least squares", ("least squares, CUSUM",), "#8c6d31"),
    Drawn("MEWMA, least squares", ("least squares, MEWMA",), "#e6550d"),
    Drawn("Kalman filter, best statistic", ("Kalman",), "#d62728"),
    Drawn("PCA-SPE", ("PCA-SPE",), "#31a354"),
    Drawn("split conformal (MAPIE)", ("split conformal",), "#b07aa1"),
    Drawn("auto-encoder (scikit-learn)", ("auto-encoder",), "#756bb1"),
    Drawn("isolation forest (scikit-learn)", ("isolation forest",), "#c994c7"),
    Drawn("recorded ranges (SENTIL)", ("SENTIL",), "#17becf"),
)
MINE = (
    Drawn("ours, containment, one step", (OURS + ",",), "#6baed6", "containment"),
    Drawn("ours, best single rule", (OURS + ",",), "#08519c"),
    Drawn("ours, three rules armed together", (OURS + ",",), "#000000", "armed together"),
)


def early_share(o: Outcome, limit: float) -> float:
    """Detected within the time of the case, every fault counting alike."""
    return float(np.mean([(peaks > limit).mean() for peaks in o.early.values()]))


def chosen(outcomes: Mapping[str, Outcome], family: Drawn) -> str | None:
    """Of a family, the detector that detects most in time at its threshold; plain containment is that of one step."""
    names = [n for n in outcomes if n.startswith(family.begins) and family.contains in n]
    if family.contains == "containment":
        names = [n for n in names if n.endswith("containment")]
    if not family.contains:
        names = [n for n in names if not n.endswith("armed together")]
    return max(names, key=lambda n: early_share(outcomes[n], outcomes[n].threshold), default=None)


def draw(reports: Sequence[Report], folder: Path) -> None:
    """ROC of every case, the best of each family; delays of the turbofan for the first page."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    groups: dict[str, list[Report]] = {}
    for report in reports:
        groups.setdefault(report.name.split(",")[0], []).append(report)
    for group, shown in groups.items():
        figure, axes = plt.subplots(1, len(shown), figsize=(5.6 * len(shown) + 2.9, 4.6), sharey=True, squeeze=False)
        for ax, report in zip(axes[0], shown, strict=True):
            for family in (*FAMILIES, *MINE):
                name = chosen(report.outcomes, family)
                if name is None:
                    continue
                o = report.outcomes[name]
                limits = np.sort(o.largest)[::-1]
                ours = family in MINE
                ax.step(
                    np.arange(len(limits)) / o.exposure, [early_share(o, limit) for limit in limits], where="post",
                    color=family.colour, label=family.label, linewidth=2.2 if ours else 1.4,
                    linestyle="-" if ours else "--",
                )  # fmt: skip
            ax.set_xscale("symlog", linthresh=report.linear)
            ax.set_xlim(0.0, report.most)
            ax.set_ylim(0.0, 1.02)
            ax.set_xlabel(f"alarmed healthy recordings {report.unit}")
            ax.set_title(report.name)
            ax.grid(alpha=0.3)
            if len(shown) == 1 or report is shown[-1]:
                ax.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.01, 1.0))
        axes[0][0].set_ylabel(shown[0].detected)
        figure.tight_layout()
        figure.savefig(folder / f"detection_roc_{group.lower().split()[-1]}.png", dpi=110)
        plt.close(figure)
    for report in reports[:1] if reports[0].name.startswith("Turbofan") else ():
        draw_delays(report, folder / "detection_delays.png")


SHOWN = (
    "fan damage × 0.5", "compressor wear × 0.5", "compressor wear × 1", "compressor wear × 2",
    "sensor drift × 0.5", "sensor drift × 1", "sensor drift × 2", "nozzle stuck", "fuel stuck",
)  # fmt: skip
"""Faults in the figure of the first page."""


def draw_delays(report: Report, path: Path) -> None:
    """Median delay of three rules armed together beside the best detector of each family."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    missed, outcomes = 40.0, report.outcomes
    figure, ax = plt.subplots(figsize=(12, 5.6))
    families = [(f, chosen(outcomes, f)) for f in (*FAMILIES, MINE[-1])]
    for rank in range(1, len(SHOWN), 2):
        ax.axhspan(rank - 0.5, rank + 0.5, color="#f3f3f3", zorder=0)
    for i, (family, name) in enumerate((f, n) for f, n in families if n is not None):
        mine = family in MINE
        delays = [float(np.median(outcomes[name].delays[label])) for label in SHOWN]
        at = np.minimum(delays, missed)
        height = np.arange(len(SHOWN)) + (0.0 if mine else 0.066 * (i - 4))
        style: dict[str, Any] = (
            {"marker": "D", "s": 110, "zorder": 4} if mine else {"marker": "o", "s": 42, "zorder": 3}
        )
        ax.scatter(at, height, color="#08519c" if mine else family.colour, label=family.label, **style)
    ax.set_xscale("log")
    ticks = [0.025, 0.1, 0.5, 1, 2, 5, 10, 20, missed]
    ax.set_xticks(ticks, [*(f"{tick:g}" for tick in ticks[:-1]), "not\nseen"])
    ax.minorticks_off()
    ax.axvline(28, color="#999999", linewidth=0.8)
    ax.set_yticks(range(len(SHOWN)), SHOWN)
    ax.set_ylim(len(SHOWN) - 0.5, -0.5)
    ax.set_xlabel("median time from the fault to the alarm, s; thresholds at one false alarm per hour")
    ax.set_title(
        f"{report.name.replace('Turbofan', 'Simulated turbofan')}: faults on manoeuvres that were not recorded"
    )
    ax.grid(axis="x", alpha=0.3)
    ax.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=100)
    plt.close(figure)


PARTS: dict[str, Callable[[argparse.Namespace], list[Report]]] = {
    "turbofan": turbofan, "crazypad": crazypad, "coil": coil, "tanks": tanks,
}  # fmt: skip


def main() -> None:
    """Run the parts that are named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="+", choices=[*PARTS, "all"])
    parser.add_argument("--quick", action="store_true", help="few runs, to see that it works")
    parser.add_argument("--rate", type=float, default=1.0, help="alarmed recordings per hour that thresholds are for")
    parser.add_argument(
        "--hours", type=float, default=10.0, help="of healthy runs of the turbofan, and half for thresholds"
    )
    parser.add_argument("--noise", type=float, nargs="+", default=[1e-4, 1e-3], help="of the turbofan's readings")
    parser.add_argument("--seeds", type=int, default=30, help="recordings per fault")
    parser.add_argument("--keep", type=Path, help="folder for simulated runs")
    parser.add_argument("--peers", default=str(ROOT / ".venv-detection/bin/python"), help="interpreter of the peers")
    parser.add_argument(
        "--write", type=Path, help="page whose tables are replaced, between lines <!-- detection NAME -->"
    )
    parser.add_argument("--figures", type=Path, help="folder for the figure")
    parser.add_argument("--json", type=Path, help="file for all numbers")
    options = parser.parse_args()
    reports = []
    for part in PARTS if "all" in options.parts else options.parts:
        began = time.perf_counter()
        try:
            found = PARTS[part](options)
        except UncertainLTIError as error:
            print(f"{part}: {error}")
            continue
        reports += found
        for report in found:
            print(report.text)
        print(f"({part}: {time.perf_counter() - began:.0f} s)\n", flush=True)
    if options.json:
        options.json.write_text(json.dumps({r.name: r.numbers for r in reports}, indent=1))
    if options.write:
        page = options.write.read_text()
        for report in reports:
            mark = f"<!-- detection {report.name} -->"
            before, _, rest = page.partition(mark)
            _, _, after = rest.partition(mark)
            page = f"{before}{mark}\n\n{report.text}\n{mark}{after}"
        options.write.write_text(page)
    if options.figures:
        draw(reports, options.figures)


if __name__ == "__main__":
    main()
