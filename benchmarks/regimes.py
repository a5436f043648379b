# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What a schedule is worth, and where it must not be chosen: one knot and more, on the same recordings in one run.

    ./run python benchmarks/regimes.py turbofan       # envelopes and faults on manoeuvres that were not fitted
    ./run python benchmarks/regimes.py profiles       # how many recordings three knots need, and what auto takes
    ./run python benchmarks/regimes.py draws          # what auto takes of other recordings, judged on other manoeuvres
    ./run python benchmarks/regimes.py paper          # the paper's check, from pulses at three power levels
    ./run python benchmarks/regimes.py coil           # a saturating coil, against PARC, jax-sysid and quantile regions
    ./run python benchmarks/regimes.py bags           # the three shipped noisy recordings: one knot is right
    ./run python benchmarks/regimes.py gas-turbine    # the real micro gas turbine, each recording left out in turn
    ./run python benchmarks/regimes.py linear minute  # a linear plant; a minute of data
    ./run python benchmarks/regimes.py live           # CPU time of a verdict, with one knot and more
    ./run python benchmarks/regimes.py all

The time of a fit with five knots: `fit.py scheduled`.

PARC and jax-sysid are asked from the interpreter --peers (default: .venv-regimes/bin/python); make one with

    python3 -m venv .venv-regimes
    .venv-regimes/bin/pip install jax-sysid "scikit-learn<1.7" faiss-cpu mip matplotlib
    .venv-regimes/bin/pip install --no-deps pyparc

(pyparc calls scikit-learn as it was before 1.7, and wants pypoman only to draw, which needs the C library cdd.) Without
them they are left out, which is said. With --keep FOLDER simulated runs are kept there and read again the next time.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from measure import table
from scipy.optimize import linprog
from shared_recordings import crazypad_labels, read_shared

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI, fit, read_transients
from uncertain_lti.base.errors import UncertainLTIError
from uncertain_lti.model.schedule import Axis, Schedule
from uncertain_lti.model.terms import ARRAYS, SHAPES
from uncertain_lti.plants.coil import coil_runs
from uncertain_lti.plants.turbofan_faults import Fault
from uncertain_lti.plants.turbofan_runs import DT, LARGE, Run, lever_moves, make_run, simulate, turbofan_signals
from uncertain_lti.proposal.scheduling import Trials, decide
from uncertain_lti.sampling.sampler import Status, Step

ROOT = Path(__file__).resolve().parents[1]
Array = np.ndarray
NOISE = 1e-4
SHORT = ("N1", "N2", "P3", "P5", "T5")
KNOTS: tuple[Any, ...] = (1, 2, 3, 5, "auto")
CRITERIA = {"qp": "(10)", "lp": "(11)"}


# --- what is fitted and what comes out ---


def scheduled(transients: Sequence[Transient], criterion: str, signal: str, knots: Any, additive: str) -> UncertainLTI:
    """The public fit with that many knots; one knot is the model without a schedule."""
    schedule = None if knots == 1 else {signal: knots}
    return fit(transients, criterion, additive=additive, schedule=schedule)  # type: ignore[arg-type]


def knots_text(model: UncertainLTI) -> str:
    """The knots that were taken, in recorded units."""
    if model.schedule is None:
        return "1"
    (axis,) = model.schedule.axes
    signal = next(s for s in model.signals.signals if s.name == axis.signal)
    recorded = [f"{float(signal.steady) + float(signal.scale) * v:.4g}" for v in axis.values]
    return f"{len(recorded)}: {' '.join(recorded)}"


def taken(model: UncertainLTI, knots: Any) -> Any:
    """How many knots a part of the recordings is fitted with: for auto, as many as all of them took."""
    return (1 if model.schedule is None else model.schedule.blocks) if knots == "auto" else knots


def why(model: UncertainLTI) -> str:
    """What the fit says about its schedule: the table of what was left out, and the reason."""
    from uncertain_lti.reports.fit_text import schedule_text

    tables = [schedule_text(choice) for choice in model.fit_summary.get("schedule", [])]
    words = [f"  {m}" for m in model.fit_summary["messages"] if m.startswith("schedule")]
    return "\n".join([*tables, *words])


@dataclass(frozen=True)
class Judged:
    """Verdicts on one run by its samples k = 1..N: outside (N, n), half-widths (N, n) normalised, judged (N,).

    used: largest distance from the centre of the bounds, of all states, over the half-width (N,).
    """

    outside: Array
    half: Array
    judged: Array
    used: Array

    @property
    def inside_all(self) -> float:
        """Share of the judged transitions inside all bounds."""
        return 1.0 - float(self.outside.any(axis=1)[self.judged].mean())


def judge(model: UncertainLTI, transient: Transient) -> Judged:
    """Every transition by the monitor's own verdict, whatever the model's alarm rule."""
    verdicts = EnvelopeMonitor(model, 1, 1, 1.0).check(transient)
    half = 0.5 * (verdicts.upper - verdicts.lower)
    away = np.abs(transient.x - 0.5 * (verdicts.upper + verdicts.lower))
    away = np.divide(away, half, out=np.full_like(away, np.nan), where=half != 0.0)  # none at rest without noise
    half = half / model.operating_point.X
    return Judged((verdicts.flags == 1.0)[1:], half[1:], verdicts.judged[1:], away[1:].max(axis=1))


def left_outside(model: UncertainLTI, transients: Sequence[Transient]) -> int:
    """Fitted transitions outside; none is."""
    return sum(int(judge(model, t).outside.any(axis=1).sum()) for t in transients)


# --- the turbofan ---


def waves(seconds: float, amplitude: float, slow: float, fast: float) -> tuple[tuple[float, float], ...]:
    """The lever swings around the middle, ever faster: from `slow` to `fast` Hz."""
    t = np.arange(0.0, seconds, DT)
    phase = 2.0 * math.pi * (slow * t + 0.5 * (fast - slow) * t * t / seconds)
    return tuple(zip(t.tolist(), (64.0 + amplitude * np.sin(phase)).tolist(), strict=True))


def slams(seconds: float) -> tuple[tuple[float, float], ...]:
    """From one end to the other and back, with rests that shrink from 5 s to 1 s."""
    corners, t, rest, pla = [(0.0, 68.0)], 2.0, 5.0, 60.0
    while t < seconds:
        corners += [(t, corners[-1][1]), (t, pla)]
        t, rest, pla = t + rest, max(1.0, 0.8 * rest), 128.0 - pla
    return tuple(corners)


WANTED = 0.997
LONG, SHORT_RUN, ONSET = 2401, 1401, 24.0
FITTED_MOVES = tuple(lever_moves(58.0, seed) for seed in range(1, 13))
TESTED_MOVES = {
    "jumps": lever_moves(33.0, 101, jumps=1.0, hold=(0.8, 3.0)),
    "slow ramps": lever_moves(33.0, 102, jumps=0.0, rate=(0.3, 0.8), hold=(0.5, 2.0)),
    "fast ramps": lever_moves(33.0, 103, jumps=0.0, rate=(5.0, 15.0), hold=(0.8, 4.0)),
    "mixed": lever_moves(33.0, 104, jumps=0.5, rate=(0.5, 8.0), hold=(0.3, 6.0)),
    "slams": slams(33.0),
    "waves": waves(36.0, 4.0, 0.1, 0.6),
}
FAULTY_MOVES = (
    lever_moves(33.0, 201, jumps=1.0, hold=(0.8, 4.0)),
    lever_moves(33.0, 202, jumps=0.0, rate=(0.5, 8.0), hold=(0.5, 3.0)),
    lever_moves(33.0, 203, jumps=0.3, rate=(0.5, 8.0), hold=(0.5, 5.0)),
)
FAULTS = ("fan_damage", "compressor_wear", "nozzle_stuck", "fuel_stuck", "sensor_drift")


def _simulate(run: Run) -> tuple[Array, Array, Array]:
    made = simulate(run)
    return made.t_ns, made.x, made.u


def simulated(runs: Sequence[Run], keep: Path | None) -> list[Transient]:
    """The runs as transients, simulated in two processes, or read from where they were kept."""
    found: dict[int, tuple[Array, Array, Array]] = {}
    paths = [keep / f"{hashlib.sha256(repr(run).encode()).hexdigest()[:20]}.npz" if keep else None for run in runs]
    for i, path in enumerate(paths):
        if path is not None and path.is_file():
            with np.load(path) as data:
                found[i] = (data["t"], data["x"], data["u"])
    wanted = [i for i in range(len(runs)) if i not in found]
    with ProcessPoolExecutor(2) as pool:
        for i, made in zip(wanted, pool.map(_simulate, [runs[i] for i in wanted]), strict=True):
            found[i] = made
            if (path := paths[i]) is not None:
                path.parent.mkdir(parents=True, exist_ok=True)
                np.savez(path, t=made[0], x=made[1], u=made[2])
    signals = turbofan_signals()
    return [
        Transient(*found[i], name=f"turbofan {i}", signals=signals, max_gap=signals.max_gap) for i in range(len(runs))
    ]


def moved(moves: Sequence[tuple[float, float]], samples: int, seed: int, fault: str = "") -> Run:
    """A noisy closed-loop run along these corners."""
    return Run(
        samples, lever=tuple(moves), ramps=True, noise=NOISE, seed=seed, fault=Fault(fault, ONSET) if fault else None
    )


def pulses(noise: float) -> list[Run]:
    """The two large pulse runs."""
    return [make_run("pulses", a, noise, seed) for a, seed in ((LARGE, 1), (-LARGE, 2))]


def turbofan(keep: Path | None) -> None:
    """Fitted to two pulse runs and eight lever profiles; judged on six other manoeuvres and on faults."""
    fitted_runs = [*pulses(NOISE), *(moved(m, LONG, 300 + i) for i, m in enumerate(FITTED_MOVES))]
    tested_runs = [moved(m, SHORT_RUN, 400 + i) for i, m in enumerate(TESTED_MOVES.values())]
    faulty_runs = [moved(m, SHORT_RUN, 500 + i, fault) for fault in FAULTS for i, m in enumerate(FAULTY_MOVES)]
    every = simulated([*fitted_runs, *tested_runs, *faulty_runs], keep)
    fitted, tested = every[: len(fitted_runs)], every[len(fitted_runs) : len(fitted_runs) + len(tested_runs)]
    faulty = {
        fault: every[len(fitted_runs) + len(tested_runs) + i * len(FAULTY_MOVES) :][: len(FAULTY_MOVES)]
        for i, fault in enumerate(FAULTS)
    }
    envelopes, faults, notes = [], [], []
    single: dict[str, Array] = {}
    around = around_least_squares(fitted, tested)
    for criterion, name in CRITERIA.items():
        for knots in KNOTS:
            began = time.process_time()
            model = scheduled(fitted, criterion, "fan_speed", knots, "both")
            seconds = time.process_time() - began
            seen = [judge(model, t) for t in tested]
            half = np.vstack([j.half[j.judged] for j in seen]).mean(axis=0)
            single.setdefault(criterion, half)
            first = [name, str(knots), knots_text(model)]
            envelopes.append(
                [
                    *first,
                    str(left_outside(model, fitted)),
                    halves_text(half),
                    *(" ".join(f"{r:.2f}" for r in (half / one)[2:]) for one in (single[criterion], around)),
                    *(f"{j.inside_all:.2%}" for j in seen),
                    f"{max(np.quantile(j.used[j.judged], WANTED, method='higher') for j in seen):.2f}",
                    f"{seconds:.1f} s",
                ]
            )
            cells, before, usual = [], 0, 0
            for fault, runs in faulty.items():
                onset = Fault(fault, ONSET).first_sample(DT)
                delays, shares = [], []
                for run in runs:
                    out = judge(model, run).outside.any(axis=1)  # row k-1 judges the arrival of sample k
                    before, usual = before + int(out[: onset - 1].sum()), usual + onset - 1
                    after = out[onset - 1 :]
                    delays.append(f"{(int(np.argmax(after)) + 1) * DT:.2g}" if after.any() else "never")
                    shares.append(after.mean())
                cells.append(f"{', '.join(delays)}; {spread(shares)}")
            faults.append([*first[:2], f"{before / usual:.2%}", *cells])
            if knots == "auto":
                ratio = (half / single[criterion])[2:]
                least = min(j.inside_all for j in seen)
                notes.append(
                    f"{name}, auto ({knots_text(model)}): pressures and temperature {ratio.max():.2f} of one knot's at "
                    f"most (aim 0.3), {least:.2%} inside at least (aim 99.7 %)"
                )
                notes.append(why(model))
            print(f"{name}, {knots} done", file=sys.stderr, flush=True)
    table(
        f"Fitted to two pulse runs and {len(FITTED_MOVES)} lever profiles, noise {NOISE:g}; judged on six other "
        "manoeuvres: mean half-widths of N1 N2 P3 P5 T5 in 1e-4 of the scale, those of P3 P5 T5 over those of one knot "
        "and over those of one knot around least squares, share inside all bounds",
        [
            "criterion",
            "asked",
            "knots",
            "outside fit",
            "half-widths",
            "over one knot's",
            "over least squares'",
            *TESTED_MOVES,
            f"half-widths times, for {WANTED:.1%} inside of each",
            "CPU of the fit",
        ],
        envelopes,
    )
    table(
        f"Faults on three other manoeuvres, from {ONSET:g} s on: first violation after, s; share violated from then on",
        ["criterion", "knots", "violated before", *(f.replace("_", " ") for f in FAULTS)],
        faults,
    )
    print(f"Noise alone, as many samples, asks for half-widths of {halves_text(noise_alone(fitted))}")
    print("\n".join(notes))


def profiles(keep: Path | None) -> None:
    """How the envelopes and what is inside of them change with the number of fitted lever profiles."""
    most = max(AMOUNTS)
    fitted_runs = [*pulses(NOISE), *(moved(lever_moves(58.0, 1 + i), LONG, 300 + i) for i in range(most))]
    tested_runs = [moved(m, SHORT_RUN, 400 + i) for i, m in enumerate(TESTED_MOVES.values())]
    every = simulated([*fitted_runs, *tested_runs], keep)
    tested, rows, notes = every[len(fitted_runs) :], [], []
    for count in AMOUNTS:
        fitted = every[: 2 + count]
        size = f"{sum(len(t) - 1 for t in fitted)}"
        around = around_least_squares(fitted, tested)
        noise = noise_alone(fitted)
        rows.append([str(count), size, "least squares", "1", "", halves_text(around), "", "", *[""] * len(tested)])
        rows.append([str(count), size, "noise alone", "", "", halves_text(noise), "", "", *[""] * len(tested)])
        for criterion, name in CRITERIA.items():
            single = None
            for knots in KNOTS if count == most else [k for k in KNOTS if k in (1, 2, 3)]:
                model = scheduled(fitted, criterion, "fan_speed", knots, "both")
                seen = [judge(model, t) for t in tested]
                half = np.vstack([j.half[j.judged] for j in seen]).mean(axis=0)
                single = half if single is None else single
                ratios = (" ".join(f"{r:.2f}" for r in (half / base)[2:]) for base in (single, around))
                inside = (f"{j.inside_all:.2%}" for j in seen)
                rows.append(
                    [str(count), size, name, str(knots), knots_text(model), halves_text(half), *ratios, *inside]
                )
                if knots == "auto":
                    notes += [f"{name}, {count} profiles, auto took {knots_text(model)}", why(model)]
    header = [
        "profiles",
        "transitions",
        "centre",
        "asked",
        "knots",
        "half-widths",
        "over one knot's",
        "over least squares'",
    ]
    table("Two pulse runs and so many lever profiles; judged on six other manoeuvres", [*header, *TESTED_MOVES], rows)
    print("\n".join(notes))


AMOUNTS = (6, 12, 24, 36)


def draws(keep: Path | None) -> None:
    """What auto takes of many draws of lever profiles, and how each number of knots holds on other manoeuvres."""
    rows = []
    for criterion, name in CRITERIA.items():
        for count, starts in DRAWS[criterion].items():
            worst: dict[Any, list[float]] = {knots: [] for knots in (1, 2, 3, 5, "auto")}
            took = []
            for start in starts:
                fitted_runs = [
                    *pulses(NOISE),
                    *(moved(lever_moves(58.0, start + i), LONG, start + 5000 + i) for i in range(count)),
                ]
                tested_runs = [
                    moved(moves, SHORT_RUN, start + 9000 + 100 * k + i)
                    for k in range(SETS)
                    for i, moves in enumerate(other_moves(start + k))
                ]
                every = simulated([*fitted_runs, *tested_runs], keep)
                trials = Trials(every[: len(fitted_runs)], criterion=criterion, additive="both")
                candidates = [trials.base, *(trials.candidate("fan_speed", knots) for knots in (2, 3, 5))]
                chosen = decide("fan_speed", candidates, trials).chosen.count
                took.append(str(chosen))
                for candidate in candidates:
                    if candidate.model is None:
                        continue
                    seen = [judge(candidate.model, t).inside_all for t in every[len(fitted_runs) :]]
                    least = np.array(seen).reshape(SETS, -1).min(axis=1).tolist()
                    for knots in (candidate.count, *(["auto"] if candidate.count == chosen else [])):
                        worst[knots] += least
                print(f"{name}, {count} profiles from {start}: auto took {chosen}", file=sys.stderr, flush=True)
            rows += [
                [
                    str(count), name, str(knots), " ".join(took) if knots == "auto" else "",
                    f"{np.mean(least):.2%}", f"{min(least):.2%}",
                    f"{sum(v >= WANTED for v in least)} of {len(least)}",
                ]
                for knots, least in worst.items()
            ]  # fmt: skip
    table(
        f"Draws of lever profiles with {SETS} sets of six manoeuvres each: share inside all bounds on the worst of six",
        ["profiles", "criterion", "knots", "taken", "mean", "least", f"sets with {WANTED:.1%} on all six"],
        rows,
    )


def other_moves(number: int) -> list[tuple[tuple[float, float], ...]]:
    """Six manoeuvres of the kinds of TESTED_MOVES, of another draw."""
    rng, seed = np.random.default_rng(number), 7000 + 10 * number
    return [
        lever_moves(33.0, seed, jumps=1.0, hold=(0.8, 3.0)),
        lever_moves(33.0, seed + 1, jumps=0.0, rate=(0.3, 0.8), hold=(0.5, 2.0)),
        lever_moves(33.0, seed + 2, jumps=0.0, rate=(5.0, 15.0), hold=(0.8, 4.0)),
        lever_moves(33.0, seed + 3, jumps=0.5, rate=(0.5, 8.0), hold=(0.3, 6.0)),
        slams(33.0),
        waves(36.0, 4.0, 0.05 + 0.1 * rng.random(), 0.4 + 0.4 * rng.random()),
    ]


SETS = 3
DRAWS = {
    "qp": {8: (1000, 2000, 3000, 4000, 6000, 7000, 8000), 12: tuple(range(1000, 9000, 1000)), 36: (1000, 2000)},
    "lp": {8: (1000, 2000, 3000), 12: (1000, 2000, 3000, 4000, 5000)},
}
"""Seeds of the profiles, by criterion and number of profiles."""


def halves_text(half: Array) -> str:
    """Half-widths in 1e-4 of the scale."""
    return " ".join(f"{1e4 * h:.1f}" for h in half)


def around_least_squares(fitted: Sequence[Transient], tested: Sequence[Transient]) -> Array:
    """Mean half-widths on tested runs: all of fitted inside, of least mean width, around least squares."""
    point = fit(fitted, additive="both").operating_point

    def regressors(transients: Sequence[Transient]) -> tuple[Array, Array, Array]:
        steps = [t.transitions() for t in transients]
        x, u, x_next = (np.concatenate([getattr(s, name) for s in steps]) for name in ("x", "u", "x_next"))
        z, dt = np.hstack([point.normalise_x(x), point.normalise_u(u)]), np.concatenate([s.dt for s in steps])[:, None]
        psi = np.column_stack([dt * np.abs(z), dt, np.ones(len(z))])
        return dt * np.column_stack([z, np.ones(len(z))]), psi, (x_next - x) / point.X

    phi, psi, step = regressors(fitted)
    left = np.abs(step - phi @ np.linalg.lstsq(phi, step, rcond=None)[0])
    mean, there = psi.mean(axis=0), regressors(tested)[1].mean(axis=0)
    return np.array([there @ linprog(mean, -psi, -r, method="highs").x for r in left.T])


def noise_alone(transients: Sequence[Transient]) -> Array:
    """Half-widths that sensor noise alone asks for: the largest of e_{k+1} - (I + Δt A) e_k over as many samples."""
    plain = fit(transients, additive="both")
    rng, count = np.random.default_rng(0), sum(len(t) for t in transients)
    e = NOISE * rng.standard_normal((2, count, plain.n))
    largest: Array = np.abs(e[1] - e[0] @ (np.eye(plain.n) + DT * plain.A).T).max(axis=0)
    return largest


def spread(shares: Sequence[float]) -> str:
    """Least and largest share."""
    low, high = f"{min(shares):.0%}", f"{max(shares):.0%}"
    return low if low == high else f"{low[:-1]}-{high}"


def bags(keep: Path | None) -> None:
    """The three shipped recordings with noise, fitted alone."""
    names = ("pulses_up_large_noise", "pulses_down_large_noise", "levels_noise")
    files = [ROOT / "bags" / f"turbofan_{name}.mcap" for name in names]
    transients = read_transients(files, ROOT / "config/signals/turbofan.yaml")
    rows, notes = [], []
    for criterion, name in CRITERIA.items():
        for knots in KNOTS:
            model, outside = scheduled(transients, criterion, "fan_speed", knots, "both"), []
            for left in range(len(transients)):
                rest = [t for i, t in enumerate(transients) if i != left]
                part = scheduled(rest, criterion, "fan_speed", taken(model, knots), "both")
                outside.append(f"{1.0 - judge(part, transients[left]).inside_all:.1%}")
            rows.append([name, str(knots), knots_text(model), *outside])
            if knots == "auto":
                notes += [f"{name}, auto took {knots_text(model)}", why(model)]
    table("Share outside on each recording when it is left out", ["criterion", "asked", "knots", *names], rows)
    print("\n".join(notes))


def paper(keep: Path | None) -> None:
    """Closed loop from 68 to 60 deg, as the paper checks; pulses at three power levels for the schedule."""
    levels = (68.0, 64.0, 60.0)
    for noise, additive in ((0.0, "disturbance"), (NOISE, "both")):
        runs = [
            Run(1201, a, ((0.0, level),), noise=noise, seed=600 + 10 * i + j)
            for i, level in enumerate(levels)
            for j, a in enumerate((LARGE, -LARGE))
        ]
        made = simulated([*runs, make_run("check", noise=noise, seed=4)], keep)
        fitted, check = made[:-1], made[-1]
        rows = []
        for words, transients, knots in (
            ("68", fitted[:2], 1), *((" ".join(f"{v:g}" for v in levels), fitted, k) for k in KNOTS)
        ):  # fmt: skip
            for criterion, name in CRITERIA.items():
                model = scheduled(transients, criterion, "fan_speed", knots, additive)
                j = judge(model, check)
                rows.append(
                    [
                        words, name, str(knots), knots_text(model), str(left_outside(model, transients)),
                        f"{j.inside_all:.0%}", *(f"{1 - v:.0%}" for v in j.outside[j.judged].mean(axis=0)),
                        " ".join(f"{1e4 * h:.1f}" for h in j.half[j.judged].mean(axis=0)),
                    ]
                )  # fmt: skip
        table(
            f"The paper's check, lever from 68 to 60 deg, noise {noise:g}, additive {additive}: share inside, mean "
            "half-widths in 1e-4 of the scale",
            ["pulses at, deg", "criterion", "asked", "knots", "outside fit", "all", *SHORT, "half-widths"],
            rows,
        )


# --- a circuit with a saturating coil ---


@dataclass(frozen=True)
class Steps:
    """Transitions of the circuit in deviations: z = [x u], the step of x, both of unit deviation."""

    z: Array
    step: Array

    @classmethod
    def of(cls, transients: Sequence[Transient], like: Sequence[Transient]) -> Steps:
        def stacked(which: Sequence[Transient]) -> tuple[Array, Array]:
            steps = [t.transitions() for t in which]
            z = np.vstack([np.hstack([s.x, s.u]) for s in steps])
            return z, np.vstack([s.x_next - s.x for s in steps])

        scales = [values.std(axis=0) for values in stacked(like)]
        z, step = stacked(transients)
        return cls(z / scales[0], step / scales[1])


def regional(z: Array, step: Array, region: Array, fresh_z: Array, fresh_region: Array) -> tuple[Array, Array]:
    """Least squares per region: steps predicted on what was fitted and on what was not."""
    found, fresh = np.zeros_like(step), np.zeros((len(fresh_z), step.shape[1]))
    for r in np.unique(region):
        law = np.linalg.lstsq(_affine(z[region == r]), step[region == r], rcond=None)[0]
        found[region == r] = _affine(z[region == r]) @ law
        fresh[fresh_region == r] = _affine(fresh_z[fresh_region == r]) @ law
    return found, fresh


def _affine(z: Array) -> Array:
    return np.column_stack([z, np.ones(len(z))])


def boxes(step: Array, found: Array, region: Array, fresh_region: Array) -> Array:
    """Half-widths of the fresh samples: the largest residual of their region in the fit; 0 in a region never seen."""
    half = np.zeros((len(fresh_region), step.shape[1]))
    for r in np.unique(region):
        half[fresh_region == r] = np.abs(step - found)[region == r].max(axis=0)
    return half


def coil(keep: Path | None, peers: str) -> None:
    """Widths and largest residuals at equal numbers of regions, on recordings that were not fitted."""
    fitted, fresh = coil_runs(range(20)), coil_runs(range(100, 110))
    train, test = Steps.of(fitted, fitted), Steps.of(fresh, fitted)
    rows = []

    def add(name: str, regions: int, fresh_step: Array, half: Array, seconds: float) -> None:
        residual = np.abs(test.step - fresh_step)
        rows.append(
            [
                str(regions), name,
                *(" ".join(f"{v:.3g}" for v in values) for values in (2.0 * half.mean(axis=0), residual.max(axis=0))),
                f"{(residual <= half).all(axis=1).mean():.2%}", f"{seconds:.1f} s",
            ]
        )  # fmt: skip

    missing = ""
    scale = np.vstack([np.diff(t.x, axis=0) for t in fitted]).std(axis=0)
    ours = {
        "I_L": (fitted, fresh),
        "I_L_magnitude": (coil_runs(range(20), magnitude=True), coil_runs(range(100, 110), magnitude=True)),
    }
    for regions in (1, 2, 4, 8):
        for signal, (known, unknown) in ours.items():
            if regions == 1 and signal != "I_L":
                continue
            for criterion, name in CRITERIA.items():
                began = time.perf_counter()
                model = scheduled(known, criterion, signal, regions, "disturbance")
                seconds = time.perf_counter() - began
                halves, centres = [], []
                for t in unknown:
                    verdicts = EnvelopeMonitor(model, 1, 1, 1.0).check(t)
                    lower, upper = verdicts.lower[1:], verdicts.upper[1:]
                    halves.append(0.5 * (upper - lower) / scale)
                    centres.append((0.5 * (upper + lower) - t.x[:-1]) / scale)
                words = (
                    f"ours {name}, knots of {'I_L' if signal == 'I_L' else 'abs(I_L)'}"
                    if regions > 1
                    else f"ours {name}"
                )
                add(words, regions, np.vstack(centres), np.vstack(halves), seconds)
        current, fresh_current = np.abs(train.z[:, 1]), np.abs(test.z[:, 1])
        edges = np.quantile(current, np.linspace(0.0, 1.0, regions + 1)[1:-1])
        region, fresh_region = np.searchsorted(edges, current), np.searchsorted(edges, fresh_current)
        began = time.perf_counter()
        found, found_fresh = regional(train.z, train.step, region, test.z, fresh_region)
        seconds = time.perf_counter() - began
        add(
            "least squares, quantiles of abs(I_L)",
            regions,
            found_fresh,
            boxes(train.step, found, region, fresh_region),
            seconds,
        )
        for peer in ("PARC", "jax-sysid"):
            for given in (False, True):
                if regions == 1 or missing:
                    continue
                z = [np.column_stack([s.z, np.abs(s.z[:, 1])]) if given else s.z for s in (train, test)]
                try:
                    answer = asked(peers, peer, regions, z[0], train.step, z[1])
                except UncertainLTIError as error:
                    missing = str(error)
                    continue
                half = boxes(train.step, answer["predicted"], answer["region"], answer["fresh_region"])
                words = f"{peer}, abs(I_L) a regressor too" if given else peer
                add(words, regions, answer["fresh_predicted"], half, float(answer["seconds"]))
    table(
        f"A saturating coil: {len(fitted)} recordings of 500 steps fitted, {len(fresh)} others judged; mean width and "
        "largest residual of V_C and I_L in standard deviations of their steps",
        ["regions", "method", "mean width", "largest residual", "inside", "fit"],
        rows,
    )
    if missing:
        print(missing)


def asked(python: str, name: str, regions: int, z: Array, step: Array, fresh_z: Array) -> Mapping[str, Array]:
    """What a peer answers from its own interpreter."""
    if not Path(python).is_file():
        raise UncertainLTIError(
            f"PARC and jax-sysid are left out: {python} is not there; the head of this file says how to make it"
        )
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "in.npz", Path(folder) / "out.npz"
        np.savez(source, Z=z, Y=step, fresh_Z=fresh_z)
        command = [
            python,
            str(Path(__file__).with_name("regime_peers.py")),
            name,
            str(regions),
            str(source),
            str(target),
        ]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            last = (done.stderr.strip().splitlines() or ["it ended without a word"])[-1]
            raise UncertainLTIError(f"{name} is left out: {python} could not run it: {last}")
        with np.load(target) as data:
            return dict(data)


# --- where it must not be chosen ---


def left_out(title: str, transients: Sequence[Transient], signal: str, additive: str, knots: Sequence[Any]) -> None:
    """Share outside on each recording left out in turn, its mean half-widths, and what auto takes from all of them."""
    rows, notes = [], []
    for criterion, name in CRITERIA.items():
        for count in [k for k in knots if k != "auto" or "auto" in KNOTS]:
            model = scheduled(transients, criterion, signal, count, additive)
            outside, halves = [], []
            for left in range(len(transients)):
                rest = [t for i, t in enumerate(transients) if i != left]
                j = judge(scheduled(rest, criterion, signal, taken(model, count), additive), transients[left])
                outside.append(1.0 - j.inside_all)
                halves.append(j.half[j.judged].mean(axis=0))
            half = np.mean(halves, axis=0) * model.operating_point.X
            rows.append(
                [
                    name, str(count), knots_text(model), " ".join(f"{100 * v:.2f}" for v in outside),
                    f"{np.mean(outside):.2%}", " ".join(f"{h:.3g}" for h in half),
                ]
            )  # fmt: skip
            if count == "auto":
                notes += [f"{name}, auto took {knots_text(model)}", why(model)]
    header = ["criterion", "asked", "knots from all", "outside when left out, %", "mean", "mean half-widths there"]
    table(title, header, rows)
    print("\n".join(notes))


def gas_turbine(keep: Path | None) -> None:
    """The real micro gas turbine."""
    transients = read_shared("micro_gas_turbine", *(f"micro_gas_turbine/ex_{k}.mcap" for k in (1, 20, 24)))
    left_out(
        "Micro gas turbine: ex_1, ex_20, ex_24, each left out in turn", transients, "power", "both", (1, 3, 6, "auto")
    )


def linear(keep: Path | None) -> None:
    """The published uncertain matrices, constant over the range: there is nothing to schedule."""
    from uncertain_lti.plants.leibov import transient

    for noise, additive in ((NOISE, "both"), (0.0, "none")):
        runs = []
        for seed in range(8):
            run = transient(1200, seed)
            x = run.x + noise * np.random.default_rng(seed).standard_normal(run.x.shape)
            runs.append(Transient(run.t_ns, x, run.u, name=run.name, signals=run.signals, max_gap=run.max_gap))
        title = f"Linear plant: eight runs of 30 s of the published intervals, noise {noise:g}"
        left_out(title, runs, "fan_speed", additive, (1, 3, "auto"))


def minute(keep: Path | None) -> None:
    """A minute of data: one run of the turbofan along levels, and four healthy flights of a real quadcopter."""
    (levels,) = simulated([make_run("levels", noise=NOISE, seed=3)], keep)
    for criterion, name in CRITERIA.items():
        if "auto" not in KNOTS:
            break
        model = scheduled([levels], criterion, "fan_speed", "auto", "both")
        print(f"{name}, one minute of the turbofan along levels: auto took {knots_text(model)}")
        print(why(model))
    transients = read_shared("crazypad", *(file for file, label in crazypad_labels().items() if not label["faulty"]))
    left_out("CrazyPAD: four healthy flights", transients, "thrust", "both", (1, 3, "auto"))


def live(keep: Path | None) -> None:
    """CPU time of the monitor's verdict on one sample after the other, models of one knot and of more in turn."""
    rng, rows, count = np.random.default_rng(0), [], 2000
    for n, m in ((5, 4), (50, 10)):
        monitors = []
        for knots in LIVE_KNOTS:
            shapes = {name: SHAPES[name].shape(n, m) for name in ARRAYS}
            arrays = {
                name: 0.01 * np.abs(rng.normal(size=shape if knots == 1 else (knots, *shape)))
                for name, shape in shapes.items()
            }
            schedule = None if knots == 1 else Schedule((Axis("x1", knots=tuple(np.linspace(-2, 2, knots).tolist())),))
            monitors.append(EnvelopeMonitor(UncertainLTI(**arrays, schedule=schedule), 1, 1, 1.0))
        steps = [
            Step(Status.OK, k * 10**6, k * 10**6, 0.002, rng.normal(size=n + m).tolist(), rng.normal(size=n).tolist())
            for k in range(count)
        ]
        best = [math.inf] * len(monitors)
        for _ in range(15):
            for i, monitor in enumerate(monitors):
                began = time.process_time()
                for step in steps:
                    monitor.judge(step)
                best[i] = min(best[i], time.process_time() - began)
        for knots, seconds in zip(LIVE_KNOTS, best, strict=True):
            rows.append([str(n), str(m), str(knots), f"{1e6 * seconds / count:.2f} µs", f"{seconds / best[0]:.2f}"])
    table("CPU time of a verdict (aim: at most 1.3 times one knot's)", ["n", "m", "knots", "CPU", "ratio"], rows)


LIVE_KNOTS = (1, 2, 3, 5, 12)
PARTS: dict[str, Callable[[Path | None], None]] = {
    "turbofan": turbofan, "profiles": profiles, "draws": draws, "paper": paper, "bags": bags,
    "gas-turbine": gas_turbine, "linear": linear, "minute": minute, "live": live,
}  # fmt: skip


def main() -> None:
    """Run the parts that are named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="+", choices=[*PARTS, "coil", "all"])
    parser.add_argument("--keep", type=Path, help="folder for simulated runs")
    parser.add_argument(
        "--without-auto", action="store_true", help="leave out the automatic choice, which takes longest"
    )
    parser.add_argument("--criterion", choices=CRITERIA, help="this one alone")
    parser.add_argument("--peers", default=str(ROOT / ".venv-regimes/bin/python"), help="interpreter of the peers")
    options = parser.parse_args()
    if options.without_auto:
        global KNOTS
        KNOTS = tuple(k for k in KNOTS if k != "auto")
    if options.criterion:
        for other in [c for c in CRITERIA if c != options.criterion]:
            del CRITERIA[other]
    every = {
        **PARTS,
        "coil": lambda keep: coil(keep, options.peers),
    }
    for part in every if "all" in options.parts else options.parts:
        began = time.perf_counter()
        try:
            every[part](options.keep)
        except UncertainLTIError as error:
            print(f"{part}: {error}")
        print(f"({part}: {time.perf_counter() - began:.0f} s)\n", flush=True)


if __name__ == "__main__":
    main()
