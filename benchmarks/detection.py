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
    ./run python benchmarks/detection.py limit               # what the plant itself as a model would reach there
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
import json
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from detection_cases import (
    COIL_POINT,
    HORIZONS,
    TANKS_POINT,
    Case,
    Faulty,
    Recorded,
    coil_case,
    of_the_plant,
    tanks_case,
    turbofan_case,
)
from detection_figures import draw
from detection_procedure import (
    OURS,
    Kind,
    Outcome,
    armed_together,
    as_tuned,
    asked,
    evaluate,
    on_our_residuals,
    other_detectors,
    our_rules,
)
from detection_tables import Report, crazypad_report, false_violations, judged, reported, six_manoeuvres
from detectors import Score, Statistic, residual_detectors
from shared_recordings import airborne, crazypad_labels

from uncertain_lti import Transient, UncertainLTI, fit
from uncertain_lti.base.errors import UncertainLTIError
from uncertain_lti.model.operating_point import OperatingPoint
from uncertain_lti.plants.coil import STEP_NS
from uncertain_lti.validation.false_alarms import allowed_alarms

ROOT = Path(__file__).resolve().parents[1]


OF_UTILISATION = (
    Kind("containment"), Kind("containment", 0.5), Kind("energy", 0.5), Kind("energy", 2.0), Kind("mean", 2.0),
    Kind("ewma", 1.0), Kind("cusum", 1.0, 1, 0.05), Kind("chi2"), Kind("chi2", 2.0), Kind("mewma", 1.2),
    *(
        Kind(kind, window, h)
        for h in HORIZONS
        for kind, window in (
            ("containment", 0.0), ("energy", 2.0), ("mean", 2.0), ("chi2", 0.0), ("chi2", 2.0), ("mewma", 0.5),
            ("mewma", 1.2),
        )
    ),
)  # fmt: skip
TOGETHER = (Kind("containment"), Kind("chi2", 0.0, 40), Kind("mewma", 0.5, 40))
"""Rules that are armed together, the false alarms shared; chosen on other recordings than those of the tables."""
SCHEDULES: dict[str, Any] = {
    "1 knot": None, "3 knots": {"fan_speed": 3}, "3 knots of compressor_speed": {"compressor_speed": 3},
}  # fmt: skip
"""Of this project's models on the turbofan."""
ARMED = "3 knots of compressor_speed"
TUNED_ON, TRIED = 120, (("mewma",), ("chi2",), ("mean",))
"""Healthy runs that `tune` would choose from, and the statistics that it may."""


def turbofan(options: argparse.Namespace) -> list[Report]:
    """Both levels of noise."""
    reports = []
    for noise in options.noise:
        case = turbofan_case(noise, options)
        detectors = other_detectors(case.fitted, (0.5, 2.0)) | asked(case, options.peers, keep=options.keep)
        models = {}
        for name, schedule in SCHEDULES.items():
            model = with_horizons(case.transients, "qp", "both", schedule, HORIZONS)
            models[f"{OURS}, {name}"] = model
            ours = our_rules(model, case.fitted, OF_UTILISATION)
            detectors |= ours.scores(f"{OURS}, {name}")
            if schedule is not None:
                detectors |= on_our_residuals(name, ours, case.fitted)
        armed = [f"{OURS}, {ARMED}, {kind.name}" for kind in TOGETHER]
        together = armed_together([detectors[rule] for rule in armed], case)
        detectors |= {f"{OURS}, {ARMED}, armed {how}": together for how in ("together", "cautiously")}
        further = [false_violations(case, detectors, SCHEDULES)]
        if options.tuned:
            few = Recorded.of(list(case.learn[0].transients[:TUNED_ON]), model.operating_point)
            allowed = allowed_alarms(options.rate, sum(runs.hours for runs in few))
            name = f"{OURS}, {ARMED}"
            tuned = as_tuned({name: models[name]}, replace(case, learn=few, allowed=allowed), TRIED)
            detectors[f"{OURS}, as tuned"] = tuned.score
            alarmed = sum(int((tuned.score(runs).max(axis=1) > 1.0).sum()) for runs in case.healthy)
            found = f"its own thresholds, of {sum(len(r.x) for r in few)} runs, let {alarmed} alarms through"
            further.insert(0, f"{tuned.text}\nIn {case.exposure:.3g} h, {found}.\n")
        report = judged(case, detectors)
        further.append(six_manoeuvres(report.outcomes))
        reports.append(replace(report, text="\n".join([report.text, *further])))
    return reports


def limit(options: argparse.Namespace) -> list[Report]:
    """What the plant itself as a model would reach on the turbofan, beside statistics on least squares."""
    reports = []
    for noise in options.noise:
        case = turbofan_case(noise, options)
        law = {n: s for n, s in other_detectors(case.fitted, (0.5, 2.0)).items() if n.startswith("least squares")}
        peers = {name: evaluate(case, score) for name, score in law.items()}
        known, residuals = of_the_plant(case, noise, options.keep)
        statistics = [Statistic("chi2"), *(Statistic("chi2", w) for w in (0.5, 2.0))]
        statistics += [Statistic("MEWMA", weight) for weight in (0.02, 0.05, 0.1)]
        plant = residual_detectors(residuals, known.fitted, statistics)
        ours = {f"{OURS}, the plant as model, {name}": evaluate(known, score) for name, score in plant.items()}
        reports.append(reported(known, peers | ours))
    return reports


def with_horizons(
    transients: Sequence[Transient], criterion: str, additive: str, schedule: Any, steps: Sequence[int], **more: Any
) -> UncertainLTI:
    """The public fit, with these horizons."""
    further: dict[str, Any] = {"horizons": list(steps)} if steps else {}
    return fit(transients, criterion, additive=additive, schedule=schedule, **further, **more)  # type: ignore[arg-type]


def crazypad(options: argparse.Namespace) -> list[Report]:
    """Real flights: fitted to some healthy ones, threshold from those left out, 14 damaged ones judged."""
    labels = crazypad_labels()
    pieces_of = airborne(list(labels))
    healthy = [file for file in labels if not labels[file]["faulty"]]
    damaged = [file for file in labels if labels[file]["faulty"]]
    damaged = [file for file in labels if labels[file]["faulty"]]
    shares: dict[str, list[list[bool]]] = {}
    scaled: dict[str, tuple[list[float], list[float]]] = {}
    kinds = [Kind("containment"), *(Kind(k, w) for k in ("energy", "mean", "chi2") for w in (0.5, 4.0))]
    kinds += [Kind("energy", 2.0), Kind("cusum", 1.0, 1, 0.02)]
    draws = list(combinations(healthy, 3)) + ([] if options.quick else list(combinations(healthy, 2)))
    for fitted_files in draws:
        left = [f for f in healthy if f not in fitted_files]
        transients = [t for f in fitted_files for t in pieces_of[f]]
        models = {
            f"{name}, {additive}": fit(transients, criterion, additive=additive)  # type: ignore[arg-type]
            for criterion, name in (("qp", "(10)"), ("lp", "(11)"))
            for additive in ("noise", "both")
        }
        point = models["(10), noise"].operating_point

        def recorded(files: Iterable[str], point: OperatingPoint = point) -> dict[str, list[Recorded]]:
            return {f: Recorded.of(pieces_of[f], point) for f in files}

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


def coil(options: argparse.Namespace) -> list[Report]:
    """The circuit with a saturating coil: R and L change, the current's sensor is biased; noise of 1e-3."""
    step = STEP_NS * 1e-9
    case = coil_case(options)
    return [plain_case(case, COIL_POINT, "I_L_magnitude", (2, 8), (20 * step, 80 * step), (), options)]


def plain_case(
    case: Case, point: OperatingPoint, signal: str, knots: Sequence[int],
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
        model = with_horizons(case.transients, "qp", "both", schedule, horizons, operating_point=point)
        plural = "" if count == 1 else "s"
        detectors |= our_rules(model, case.fitted, kinds).scores(f"{OURS}, {count} knot{plural}")
    return judged(case, detectors)


def tanks(options: argparse.Namespace) -> list[Report]:
    """Three tanks: the second outlet passes less from half time on; noise of 1e-3."""
    return [plain_case(tanks_case(options), TANKS_POINT, "x2", (1, 3), (2.0, 5.0), (10, 40), options)]


PARTS: dict[str, Callable[[argparse.Namespace], list[Report]]] = {
    "turbofan": turbofan, "limit": limit, "crazypad": crazypad, "coil": coil, "tanks": tanks,
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
    parser.add_argument("--tuned", action="store_true", help="add what tune would arm on the turbofan")
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
