# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What `tune` chooses on a few recordings of a simulated plant, on fresh ones of it: false alarms, and a leak seen.

    ./run python benchmarks/fresh_plants.py                # eight plants, two minutes of processor time
    ./run python benchmarks/fresh_plants.py --plants 3 --first 100

Each plant is three nonlinear tanks whose coefficients are drawn within 20 %, every other one with sensor noise; 4, 6 or
10 recordings of 10 s are given. Beside the choice stands the plain fit, whose alarm was set in the same way. Fresh
recordings are 60 healthy ones, and 60 with a leak of 3 % of the second tank.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from unittest.mock import patch

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
if not any("uncertain_lti" in str(p) for p in sys.path):
    sys.path.insert(0, str(ROOT / "tests" / "checkout"))

from measure import table  # noqa: E402
from tanks import Tanks  # noqa: E402

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI, fit, tune  # noqa: E402
from uncertain_lti.proposal.trial import Trial  # noqa: E402

RECORDINGS, RATES = (4, 6, 10), (20.0, 100.0)
FRESH, LEAK = 60, 0.03
CASES = 20
"""Onsets of each fault in the search; a third of what `tune` takes, for the time."""


def share(model: UncertainLTI, trial: Trial, runs: Sequence[Transient]) -> float:
    """Share of the recordings in which the alarm is raised."""
    monitor = EnvelopeMonitor(model)
    return float(np.mean([monitor.check(run).alarm.any() for run in trial.setting.prepared(runs)]))


def row_of(seed: int) -> tuple[list[str], list[float]]:
    """One plant: the row, and its shares (healthy plain, healthy chosen, leak plain, leak chosen)."""
    plant, noise = Tanks(seed, spread=0.2), 1e-3 * (seed % 2)
    count, rate = RECORDINGS[seed % 3], RATES[seed % 2]
    runs = plant.transients(count, seed, noise=noise)
    with patch("uncertain_lti.proposal.tune.COMPARED_CASES", CASES):
        tuned = tune(runs, rate)
    plain = tuned.trials[0]
    prepared = plain.setting.prepared(runs)
    model = fit(prepared, **plain.setting.arguments(prepared)).replace(alarm=plain.rules)
    healthy = plant.transients(FRESH, 50_000 + seed, noise=noise)
    leaking = plant.transients(FRESH, 60_000 + seed, noise=noise, fault=LEAK)
    shares = [
        share(m, trial, fresh)
        for fresh in (healthy, leaking)
        for m, trial in ((model, plain), (tuned.model, tuned.chosen))
    ]
    size = f"{math.exp(float(np.nanmean(tuned.chosen.sizes() - plain.sizes()))):.2g}"
    return [str(seed), str(count), f"{rate:g}", tuned.chosen.words, size, *map("{:.2f}".format, shares)], shares


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--plants", type=int, default=8, help="how many")
    parser.add_argument("--first", type=int, default=0, help="seed of the first plant")
    options = parser.parse_args()
    rows, shares = zip(*(row_of(seed) for seed in range(options.first, options.first + options.plants)), strict=True)
    mean = [f"{value:.2f}" for value in np.mean(shares, axis=0)]
    header = (
        "plant", "recordings", "false alarms per hour", "chosen", "size",
        "healthy that alarm: plain", "chosen", "leak seen: plain", "chosen",
    )  # fmt: skip
    table("What tune chooses, on fresh recordings", header, [*rows, ["mean", "", "", "", "", *mean]])
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
