# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Tables of detection in Markdown: every detector on a case, and this project's rules beside the best of the others."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from detection_cases import HORIZONS, Case
from detection_procedure import CONFIDENCE, OURS, SEVERAL, Kind, Outcome, cautious, evaluate
from detectors import Array, Score
from scipy.stats import beta

from uncertain_lti.plants.turbofan_runs import DT


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


def false_violations(case: Case, detectors: Mapping[str, Score], models: Iterable[str]) -> str:
    """Verdicts of healthy runs outside the envelope as it was fitted, at margin 1, for every horizon."""
    rows = []
    for knots in models:
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


def judged(case: Case, detectors: Mapping[str, Score]) -> Report:
    """Every detector on the case."""
    outcomes = {}
    for name, score in detectors.items():
        outcomes[name] = evaluate(case, score, cautious(case.allowed) if name.endswith("cautiously") else None)
        print(f"{case.title}: {name}: {outcomes[name].share():.3f}", file=sys.stderr, flush=True)
    return reported(case, outcomes)


def reported(case: Case, outcomes: dict[str, Outcome]) -> Report:
    """The tables of what every detector came to."""
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
    further = [name for name in outcomes if name.endswith(SEVERAL)]
    for label in case.faulty:

        def order(name: str, label: str = label) -> tuple[float, float]:
            delays = outcomes[name].delays[label]
            return -float(np.isfinite(delays).mean()), float(np.median(delays))

        mine = min((n for n in outcomes if n.startswith(OURS + ",") and n not in further), key=order)
        cells = [label, mine, delay_text(outcomes[mine].delays[label], case.second)]
        for begins in ("least squares", ""):
            peer = min((n for n in outcomes if n.startswith(begins) and not n.startswith("our")), key=order)
            cells += [peer, delay_text(outcomes[peer].delays[label], case.second)]
            for name in (mine, *further):
                ratio, low, high = later(outcomes[name].delays[label], outcomes[peer].delays[label], rng)
                cells.append(f"{ratio:.2f} ({low:.2f} to {high:.2f})")
        rows.append(cells)
    ratios = ["ratio", *(f"ratio, {name.split(', ')[-1]}" for name in further)]
    header = [
        "fault", "our best rule", "delay", "best on least squares", "delay", *ratios,
        "best of all others", "delay", *ratios,
    ]  # fmt: skip
    title = f"{case.title}: our best rule for each fault beside the best of the others; median of the paired ratios"
    return table_text(title, header, rows)


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
