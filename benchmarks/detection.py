# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Which faults are seen, how fast, at how many false alarms: `fit` as it is, beside the best of other detectors.

    ./run python benchmarks/detection.py turbofan            # ten faults at two levels of noise, other levers
    ./run python benchmarks/detection.py crazypad            # a real quadcopter, each healthy flight left out in turn
    ./run python benchmarks/detection.py coil tanks plants   # a saturating circuit, three tanks, eight plants drawn
    ./run python benchmarks/detection.py all --quick --raw FOLDER

Every detector learns from the same healthy recordings. Ours is `fit(recordings)` and
`EnvelopeMonitor(model).check(...)`, without an option. Others take the largest value on fitted recordings left out in
turn as threshold and, in the lines "at ours", the one at which as many of the healthy recordings that are judged alarm
as with ours: a favour. The table shows those that see most; --raw FOLDER writes all of them to files.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from coil import coil_runs
from detectors import DETECTORS, WINDOWS, Array, Learn, averaged, least_squares
from measure import markdown
from shared_recordings import airborne, crazypad_labels
from turbofan_fleet import Ramped, first_sample, lever_moves, simulate_fleet

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from tanks import Tanks

from uncertain_lti import EnvelopeMonitor, Transient, fit
from uncertain_lti.base.errors import UncertainLTIError
from uncertain_lti.plants.turbofan_runs import DT, LARGE, Fault, Run, make_run

Recording = Sequence[Transient]
"""One recording, in one piece or several."""
SHOWN = 3
"""Of the others, as many lines for each kind of threshold."""


@dataclass(frozen=True)
class Case:
    """What is fitted, healthy ones that are judged, those with faults and the first sample that can show it."""

    title: str
    fitted: Sequence[Recording]
    healthy: Sequence[Recording]
    faulty: dict[str, tuple[Sequence[Recording], int]]
    unit: tuple[str, float] = ("s", 1.0)


@dataclass(frozen=True)
class Line:
    """What one detector makes of a case: share of healthy recordings alarmed; by fault, share seen and the delays."""

    name: str
    healthy: float
    seen: dict[str, float]
    delays: dict[str, float]

    @property
    def rank(self) -> tuple[float, float]:
        """Most is seen first, then soonest."""
        delays = [min(delay, 1e9) for delay in self.delays.values()]
        return (-float(np.mean(list(self.seen.values()))), float(np.mean(delays)))

    def cells(self, case: Case) -> list[str]:
        """As the table has it."""
        unit, size = case.unit
        faults = [
            f"{self.seen[f]:.2f}" + (f", {self.delays[f] / size:.3g} {unit}" if np.isfinite(self.delays[f]) else "")
            for f in case.faulty
        ]
        return [self.name, f"{self.healthy:.3f}", *faults]


def judged(name: str, case: Case, alarm: Callable[[Transient], Array]) -> Line:
    """One detector on a case."""
    healthy = [any(alarm(piece).any() for piece in recording) for recording in case.healthy]
    seen, delays = {}, {}
    for fault, (recordings, first) in case.faulty.items():
        found = []
        for pieces in recordings:
            raised = [(piece, np.flatnonzero(alarm(piece)[first:])) for piece in pieces]
            times = [float(p.t[first + k[0]] - p.t[max(first - 1, 0)]) for p, k in raised if len(k)]
            found.append(times[0] if times else np.inf)
        seen[fault], delays[fault] = float(np.isfinite(found).mean()), float(np.median(found))
    return Line(name, float(np.mean(healthy)), seen, delays)


def rows_of(transient: Transient) -> Array:
    """[x u], as the others take it."""
    return np.hstack([transient.x, transient.u])


def others(case: Case, alarmed: float) -> Iterator[tuple[Line, Line]]:
    """Each other detector with its own threshold, and with that at which as many healthy recordings alarm as ours."""
    n = case.fitted[0][0].x.shape[1]
    learns: dict[str, Learn] = {
        "least squares chi2": partial(least_squares, n=n),
        "least squares MEWMA 0.1": partial(least_squares, n=n, fading=0.1),
        "least squares MEWMA 0.02": partial(least_squares, n=n, fading=0.02),
        **DETECTORS,
    }
    folds = [case.fitted[i :: min(5, len(case.fitted))] for i in range(min(5, len(case.fitted)))]
    for name, learn in learns.items():
        windows = (1,) if "MEWMA" in name else (1, *WINDOWS)
        limits = dict.fromkeys(windows, -np.inf)
        for fold in folds:
            kept = [rows_of(p) for recording in case.fitted if recording not in fold for p in recording]
            score = learn(kept)
            for window in windows:
                peaks = [averaged(score, window)(rows_of(p)).max() for recording in fold for p in recording]
                limits[window] = max(limits[window], *peaks)
        learnt = learn([rows_of(p) for recording in case.fitted for p in recording])
        for window, limit in limits.items():
            score = averaged(learnt, window)
            kept_scores: dict[int, Array] = {}

            def value(piece: Transient, score: Any = score, kept_scores: dict[int, Array] = kept_scores) -> Array:
                if id(piece) not in kept_scores:
                    kept_scores[id(piece)] = score(rows_of(piece))
                return kept_scores[id(piece)]

            peaks = np.sort([max(value(p).max() for p in recording) for recording in case.healthy])
            below = len(peaks) - 1 - round(alarmed * len(peaks))
            equal = float(peaks[below]) if below >= 0 else -np.inf
            full = name if window == 1 else f"{name}, mean of {window}"
            yield (
                judged(full, case, lambda piece, limit=limit: value(piece) > limit),
                judged(f"{full}, at ours", case, lambda piece, equal=equal: value(piece) > equal),
            )


def lines_of(case: Case) -> tuple[Line, list[Line], list[Line]]:
    """Ours; the others with their own thresholds; the others at our share of false alarms."""
    monitor = EnvelopeMonitor(fit([piece for recording in case.fitted for piece in recording]))
    ours = judged("**ours**", case, lambda piece: monitor.check(piece).alarm)
    own, equal = zip(*others(case, ours.healthy), strict=True)
    return ours, sorted(own, key=lambda line: line.rank), sorted(equal, key=lambda line: line.rank)


def report(cases: Sequence[Case], raw: Path | None) -> None:
    """Print one table per title, and write all lines; several draws of one title are averaged."""
    for title in dict.fromkeys(case.title for case in cases):
        draws = [case for case in cases if case.title == title]
        found = [lines_of(case) for case in draws]

        def mean(name: str, lines: list[Line]) -> Line:
            same = [line for line in lines if line.name == name]
            faults = same[0].seen
            return Line(
                name, float(np.mean([s.healthy for s in same])),
                {f: float(np.mean([s.seen[f] for s in same])) for f in faults},
                {f: float(np.median([s.delays[f] for s in same])) for f in faults},
            )  # fmt: skip

        ours = mean("**ours**", [f[0] for f in found])
        own, equal = (
            sorted((mean(line.name, [x for f in found for x in f[k]]) for line in found[0][k]), key=lambda x: x.rank)
            for k in (1, 2)
        )
        header = (title, "healthy that alarm", *draws[0].faulty)
        print(markdown(header, [line.cells(draws[0]) for line in (ours, *equal[:SHOWN], *own[:SHOWN])]), flush=True)
        if raw is not None:
            raw.mkdir(parents=True, exist_ok=True)
            text = markdown(header, [line.cells(draws[0]) for line in (ours, *equal, *own)])
            (raw / f"{''.join(c if c.isalnum() else '-' for c in title.lower())}.md").write_text(text)


# --- the machines ---

SECONDS, ONSET, BATCH = 30.0, 10.0, 240
FAULTS = (
    *((kind, size) for kind in ("fan_damage", "compressor_wear", "sensor_drift", "sensor_bias") for size in (0.5, 1.0)),
    ("nozzle_stuck", 1.0), ("fuel_stuck", 1.0),
)  # fmt: skip


def lever(seed: int) -> tuple[tuple[float, float], ...]:
    """Of a run that is not fitted: jumps, slow and fast ramps, a mixture and long holds in turn, from a whole angle."""
    kinds: tuple[dict[str, Any], ...] = (
        {"jumps": 1.0, "hold": (0.8, 3.0)}, {"jumps": 0.0, "rate": (0.3, 0.8), "hold": (0.5, 2.0)},
        {"jumps": 0.0, "rate": (5.0, 15.0), "hold": (0.8, 4.0)}, {"jumps": 0.5, "rate": (0.5, 8.0), "hold": (0.3, 6.0)},
        {"jumps": 0.3, "rate": (0.5, 8.0), "hold": (2.0, 8.0)},
    )  # fmt: skip
    return from_whole_angle(lever_moves(SECONDS, seed, **kinds[seed % 5]))


def from_whole_angle(moves: Sequence[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    """The same from a whole angle on, so that few steady states have to be found."""
    start = float(round(moves[0][1]))
    return ((0.0, start), (moves[1][0], start), *moves[2:])


def turbofan(quick: bool) -> Iterator[Case]:
    """Fitted to two pulse runs and twelve lever profiles of 40 s; ten faults on other levers."""
    count, seeds = (20, 4) if quick else (120, 10)

    def simulated(runs: list[Run]) -> list[Recording]:
        return [[t] for i in range(0, len(runs), BATCH) for t in simulate_fleet(runs[i : i + BATCH])]

    for noise in (1e-4, 1e-3):

        def run(seed: int, fault: Fault | None = None, noise: float = noise) -> Run:
            samples = round(SECONDS / DT) + 1
            return Ramped(samples, lever=lever(seed), noise=noise, seed=seed, fault=fault)

        pulses = simulated([make_run("pulses", a, noise, seed) for a, seed in ((LARGE, 1), (-LARGE, 2))])
        moves = [from_whole_angle(lever_moves(40, 100 + i)) for i in range(12)]
        long = [Ramped(1601, lever=m, noise=noise, seed=300 + i) for i, m in enumerate(moves)]
        faults = [run(30000 + i, Fault(kind, ONSET, size)) for kind, size in FAULTS for i in range(seeds)]
        made = simulated([*faults, *(run(seed) for seed in range(20000, 20000 + count))])
        faulty = {
            kind.replace("_", " ") + ("" if kind.endswith("stuck") else f" × {size:g}"): (
                made[seeds * i : seeds * (i + 1)], first_sample(Fault(kind, ONSET)),
            )
            for i, (kind, size) in enumerate(FAULTS)
        }  # fmt: skip
        healthy = made[seeds * len(FAULTS) :]
        yield Case(f"Turbofan, noise {noise:g}", [*pulses, *simulated(long)], healthy, faulty)


def crazypad(quick: bool) -> Iterator[Case]:
    """Three of four healthy flights are fitted, the fourth and fourteen damaged ones judged; each in turn."""
    labels = crazypad_labels()
    flights = airborne(list(labels))
    healthy = [file for file in labels if not labels[file]["faulty"]]
    damaged = [flights[file] for file in labels if labels[file]["faulty"]]
    for left in healthy[: 1 if quick else None]:
        fitted = [flights[file] for file in healthy if file != left]
        yield Case("CrazyPAD, mean of four draws", fitted, [flights[left]], {"damaged propeller": (damaged, 0)})


def coil(quick: bool) -> Iterator[Case]:
    """A circuit with a saturating coil: R and L change, the current's sensor is biased; noise of 1e-3."""
    samples, onset, (count, seeds) = 401, 150, (40, 4) if quick else (400, 30)
    scale = np.array([40.0, 8.0])

    def noisy(first: int, number: int, bias: float = 0.0, **factors: float) -> list[Recording]:
        found: list[Recording] = []
        options: dict[str, Any] = {"onset": onset, **factors} if factors else {}
        for i, t in enumerate(coil_runs(range(first, first + number), samples, **options)):
            x = t.x + 1e-3 * scale * np.random.default_rng([first, i]).standard_normal(t.x.shape)
            x[onset:, 1] += bias * scale[1]
            found.append([Transient(t.t_ns, x, t.u, name=t.name)])
        return found

    faulty = {
        "resistance × 1.2": (noisy(3000, seeds, more_resistance=1.2), onset + 1),
        "inductance × 1.1": (noisy(3000, seeds, more_inductance=1.1), onset + 1),
        "bias of the current 2 %": (noisy(3000, seeds, 0.02), onset),
    }
    yield Case("Saturating coil", noisy(0, 20), noisy(5000, count), faulty, ("µs", 1e-6))


def tanks(quick: bool) -> Iterator[Case]:
    """Three tanks: the second outlet passes less from half time on; noise of 1e-3."""
    plant, steps, (count, seeds) = Tanks(), 300, (40, 4) if quick else (400, 30)

    def runs(number: int, seed: int, fault: float = 0.0) -> list[Recording]:
        return [[t] for t in plant.transients(number, seed, steps=steps, noise=1e-3, fault=fault)]

    faulty = {
        f"outlet passes {share:.0%} less": (runs(seeds, 3, share), steps // 2 + 1) for share in (0.01, 0.02, 0.05)
    }
    yield Case("Three tanks", runs(20, 0), runs(count, 2), faulty)


def plants(quick: bool) -> Iterator[Case]:
    """Eight plants of tanks drawn within 20 %, every other one with noise: 4, 6 or 10 recordings are fitted."""
    for seed in range(2 if quick else 8):
        plant, noise = Tanks(seed, spread=0.2), 1e-3 * (seed % 2)

        def runs(count: int, first: int, fault: float = 0.0, plant: Tanks = plant, noise: float = noise) -> list[Any]:
            return [[t] for t in plant.transients(count, first, noise=noise, fault=fault)]

        count = (4, 6, 10)[seed % 3]
        faulty = {"leak of 3 %": (runs(60, 60_000 + seed, 0.03), 51)}
        yield Case("Fresh plants, mean of eight", runs(count, seed), runs(60, 50_000 + seed), faulty)


PARTS: dict[str, Callable[[bool], Iterator[Case]]] = {
    "turbofan": turbofan, "crazypad": crazypad, "coil": coil, "tanks": tanks, "plants": plants,
}  # fmt: skip


def main() -> int:
    """Run the parts that are named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="+", choices=[*PARTS, "all"])
    parser.add_argument("--quick", action="store_true", help="few runs, to see that it works")
    parser.add_argument("--raw", type=Path, help="folder for the tables of every detector")
    options = parser.parse_args()
    status = 0
    for part in PARTS if "all" in options.parts else options.parts:
        try:
            report(list(PARTS[part](options.quick)), options.raw)
        except UncertainLTIError as error:
            print(f"{part}: {error}", file=sys.stderr)
            status = 2
    return status


if __name__ == "__main__":
    sys.exit(main())
