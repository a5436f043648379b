# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""CrazyPAD's damaged flights: what `tune` on the healthy ones sees of them, beside others by the same procedure.

    ./run python benchmarks/damaged_flights.py                   # each healthy flight left out in turn, and none
    ./run python benchmarks/damaged_flights.py --cache FOLDER    # goes on where it was interrupted

A threshold comes from leaving out each fitted flight in turn: of `tune` as it does, of the others the largest value on
the flights so left out. The flight that is left out of all of it says how quiet they then are. Without the recordings,
which are public and not part of this repository, the exit status is 2.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from detection_cases import Recorded
from detection_procedure import other_detectors
from measure import table
from real_machines import TUNINGS
from shared_recordings import DATA, airborne, crazypad_labels

from uncertain_lti import Transient, fit, tune
from uncertain_lti.base.errors import UncertainLTIError
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.proposal.tune import Tuned
from uncertain_lti.validation.armed import values_of
from uncertain_lti.validation.part import judge

Flights = dict[str, list[Transient]]
"""By file, its pieces in the air."""


@dataclass(frozen=True)
class Seen:
    """What one detector makes of one draw: peaks over its threshold, of the flight left out and of the damaged ones."""

    left_out: float
    damaged: np.ndarray

    @property
    def cells(self) -> list[str]:
        """Damaged flights seen, whether the flight left out raises the alarm, and what is seen at that one's level."""
        if math.isnan(self.left_out):
            return [f"{self.seen:.2f}", "-", "-"]
        return [f"{self.seen:.2f}", "yes" if self.left_out > 1 else "no", f"{self.at_its_level:.2f}"]

    @property
    def seen(self) -> float:
        """Share of the damaged flights."""
        return float((self.damaged > 1).mean())

    @property
    def at_its_level(self) -> float:
        """The same with all thresholds where the flight left out only just raises no alarm."""
        return float((self.damaged > self.left_out).mean())


def pieces_of(flights: Flights) -> tuple[list[Transient], list[str]]:
    """All pieces, and the flight of each."""
    return [t for pieces in flights.values() for t in pieces], [f for f, pieces in flights.items() for _ in pieces]


def over_threshold(tuned: Tuned, pieces: Sequence[Transient]) -> float:
    """The largest value of a flight over its threshold or margin, of all rules that are armed."""
    model, found = tuned.model, 0.0
    for piece in tuned.chosen.setting.prepared(pieces):
        levels = values_of(model.alarm, judge(model, model, piece, ""))
        for rule, level in zip(model.alarm, levels, strict=True):
            found = max(found, float(level.max()) / (rule.margin if isinstance(rule, AlarmRule) else 1.0))
    return found


def largest_of(fitted: Flights, judged: Flights) -> dict[str, dict[str, float]]:
    """Of each other detector, learnt from some flights, the largest value on each flight."""
    transients, _ = pieces_of(fitted)
    point = fit(transients).operating_point
    detectors = other_detectors(Recorded.of(transients, point), (0.2, 0.5), (0.1, 0.25, 0.5), (0.005, 0.01, 0.02, 0.1))
    flights = {file: Recorded.of(pieces, point) for file, pieces in judged.items()}
    return {
        name: {file: max(float(score(runs).max()) for runs in found) for file, found in flights.items()}
        for name, score in detectors.items()
    }


def peers_of(fitted: Flights, left: Flights, damaged: Flights) -> dict[str, Seen]:
    """Other detectors, each with the largest value on the fitted flights left out in turn as its threshold."""
    limits: dict[str, float] = {}
    for file, pieces in fitted.items():
        others = {f: kept for f, kept in fitted.items() if f != file}
        for name, values in largest_of(others, {file: pieces}).items():
            limits[name] = max(limits.get(name, 0.0), values[file])
    return {
        name: Seen(
            max((values[f] for f in left), default=math.nan) / limits[name],
            np.array([values[f] for f in damaged]) / limits[name],
        )
        for name, values in largest_of(fitted, {**left, **damaged}).items()
    }


def summary(name: str, found: Sequence[Seen]) -> list[str]:
    """A row over the draws; the last is fitted to every flight."""
    *draws, every = found
    return [
        name, f"{np.mean([s.seen for s in draws]):.2f}", f"{sum(s.left_out > 1 for s in draws)} of {len(draws)}",
        f"{np.mean([s.at_its_level for s in draws]):.2f}", f"{every.seen:.2f}",
    ]  # fmt: skip


def report(data: Path, cache: Path | None, budget: float) -> None:
    """Print what `tune` chooses and sees in each draw, and all detectors over the draws."""
    labels = crazypad_labels(data)
    healthy, damaged = (
        airborne([file for file, label in labels.items() if bool(label["faulty"]) is faulty], data)
        for faulty in (False, True)
    )
    rate = next(case.rate for case in TUNINGS if case.signals == "crazypad")
    rows, ours, peers = [], list[Seen](), dict[str, list[Seen]]()
    for out in (*healthy, ""):
        fitted = {f: pieces for f, pieces in healthy.items() if f != out}
        left = {f: pieces for f, pieces in healthy.items() if f == out}
        transients, groups = pieces_of(fitted)
        tuned = tune(transients, rate, groups=groups, cache=cache, budget=budget)
        level = [over_threshold(tuned, pieces) for pieces in left.values()]
        seen = Seen(max(level, default=math.nan), np.array([over_threshold(tuned, p) for p in damaged.values()]))
        rows.append([Path(out).stem or "none", tuned.chosen.words, str(len(tuned.trials)), *seen.cells])
        print(" | ".join(rows[-1]), file=sys.stderr, flush=True)
        ours.append(seen)
        for name, found in peers_of(fitted, left, damaged).items():
            peers.setdefault(name, []).append(found)
    header = (
        "left out",
        "chosen on the others",
        "ways",
        "damaged flights seen",
        "left out one alarms",
        "seen at its level",
    )
    table("What tune chooses on the other healthy flights", header, rows)
    order = sorted(peers, key=lambda name: -float(np.mean([s.seen for s in peers[name][:-1]])))
    header = (
        "detector",
        "damaged flights seen",
        "alarms on those left out",
        "seen at their level",
        "fitted to all four",
    )
    table("Mean over the draws", header, [summary("tune", ours), *(summary(name, peers[name]) for name in order)])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the recordings")
    parser.add_argument("--cache", type=Path, help="folder that keeps what tune tried")
    parser.add_argument("--budget", type=float, default=math.inf, help="of each search, s")
    options = parser.parse_args()
    try:
        report(options.data, options.cache, options.budget)
    except UncertainLTIError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
