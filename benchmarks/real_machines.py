# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Envelopes of real machines: widths of the one-step bounds, and what is inside on recordings that were not fitted.

    ./run python benchmarks/real_machines.py                    # the table of docs/real_machines.md (Markdown)
    ./run python benchmarks/real_machines.py --data FOLDER
    ./run python benchmarks/real_machines.py --tune             # what `tune` chooses on them: minutes
    ./run python benchmarks/real_machines.py --tune hunter      # on one, by the beginning of its name

The recordings are public and not part of this repository; docs/real_machines.md names the machines. Without them the
exit status is 2.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from measure import table
from shared_recordings import DATA, airborne, crazypad_labels, read_shared

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI, fit, tune
from uncertain_lti.sampling.reading import read_as_fitted
from uncertain_lti.validation.blocks import cut


@dataclass(frozen=True)
class Case:
    """A machine, its signals file in config/signals, what is fitted and what is checked."""

    machine: str
    signals: str
    fitted: Sequence[str]
    checked: Sequence[str]


CASES = (
    Case(
        "micro gas turbine, 1 Hz", "micro_gas_turbine", ["micro_gas_turbine/ex_1.mcap", "micro_gas_turbine/ex_20.mcap"],
        ["micro_gas_turbine/ex_24.mcap"],
    ),
    Case(
        "Hunter SE (simulated), 27 Hz", "hunter_se", ["hunter_se/straight_odd_t_0_5_run_01.mcap"],
        ["hunter_se/straight_odd_t_0_5_run_02.mcap", "hunter_se/straight_even_t_0_2_run_01.mcap"],
    ),
    Case(
        "Crazyflie, Vicon, 100 Hz", "crazyflie_vicon", ["crazyflie/rollbag_0.mcap"],
        ["crazyflie/yx3bag_0.mcap", "crazyflie/yx4bag_0.mcap"],
    ),
    Case(
        "Crazyflie, estimate, 10 Hz", "crazyflie_estimate", ["crazyflie/rollbag_0.mcap"],
        ["crazyflie/yx3bag_0.mcap", "crazyflie/yx4bag_0.mcap"],
    ),
    Case("Neato, 5 Hz", "neato", ["neato/person_follower.mcap"], ["neato/draw_square.mcap"]),
)  # fmt: skip


def rows_of(
    machine: str, model: UncertainLTI, fitted: Sequence[Transient], checked: Sequence[Transient]
) -> list[list[str]]:
    """One row per state: mean width, rms step and range where it was fitted, share inside where it was not."""
    steps = [t.transitions() for t in fitted]
    states = np.vstack([s.x for s in steps])
    rms = np.sqrt(np.mean(np.vstack([s.x_next - s.x for s in steps]) ** 2, axis=0))
    verdicts = [EnvelopeMonitor(model, 1, 1, 1.0).check(t) for t in checked]
    rows = []
    for i, signal in enumerate(model.signals.states):
        inside = [f"{1 - (v.flags[v.judged, i] == 1.0).mean():.2%} of {v.judged.sum()}" for v in verdicts]
        rows.append(
            [
                f"{machine}: {signal.name} [{signal.unit or '-'}]",
                f"{model.fit_summary['mean_width_recorded'][i]:.3g}",
                f"{rms[i]:.2g}",
                f"{np.ptp(states[:, i]):.3g}",
                "; ".join(inside),
            ]
        )
    return rows


def go2(data: Path) -> list[list[str]]:
    """Joint 0 fitted on every other second, checked on the others taken together."""
    (whole,) = read_shared("go2_joint", "go2/test_3.mcap", data=data)
    seconds = [cut(whole, start, start + 500) for start in range(0, 6500, 500)]
    model = fit(seconds[::2])
    verdicts = [EnvelopeMonitor(model, 1, 1, 1.0).check(part) for part in seconds[1::2]]
    judged = sum(int(v.judged.sum()) for v in verdicts)
    inside = 1 - sum(int(v.violated.sum()) for v in verdicts) / judged
    rows = rows_of("Unitree Go2, joint 0, 500 Hz", model, seconds[::2], [])
    for entry in rows:
        entry[-1] = f"{inside:.2%} of {judged} (both)"
    return rows


# --- what tune chooses ---


@dataclass(frozen=True)
class Tuning:
    """A machine, its signals file, recordings of it healthy (relative to the data, or of this repository), and rate."""

    machine: str
    signals: str
    recordings: Sequence[str]
    rate: float
    within: float | None = None


TUNINGS = (
    Tuning(
        "turbofan, 3 noisy bags", "turbofan",
        [f"bags/turbofan_{name}_noise.mcap" for name in ("pulses_up_large", "pulses_down_large", "levels")], 10.0, 0.5,
    ),
    Tuning(
        "micro gas turbine, ex_1, ex_20, ex_24", "micro_gas_turbine",
        [f"micro_gas_turbine/ex_{k}.mcap" for k in (1, 20, 24)], 1.0,
    ),
    Tuning(
        "Hunter SE, 4 runs", "hunter_se",
        [f"hunter_se/straight_{name}_run_0{k}.mcap" for name in ("even_t_0_2", "odd_t_0_5") for k in (1, 2)], 20.0,
    ),
    Tuning("Neato, 2 recordings", "neato", ["neato/person_follower.mcap", "neato/draw_square.mcap"], 20.0),
    Tuning("Go2 joint, test_3, ten blocks", "go2_joint", ["go2/test_3.mcap"], 60.0),
    Tuning("CrazyPAD, 4 healthy flights, airborne", "crazypad", ["crazypad/labels.json"], 60.0),
)  # fmt: skip


def tuned_row(case: Tuning, data: Path, cache: Path | None) -> list[str]:
    """What tune came to: rate, choice, size, biases seen beside those of the plain fit, processor time."""
    groups: list[str] | None = None
    if case.signals == "crazypad":
        flights = airborne([file for file, label in crazypad_labels(data).items() if not label["faulty"]], data)
        transients = [piece for pieces in flights.values() for piece in pieces]
        groups = [file for file, pieces in flights.items() for _ in pieces]
    else:
        transients = read_shared(case.signals, *case.recordings, data=data)
    began = time.process_time()
    tuned = tune(transients, case.rate, within=case.within, groups=groups, cache=cache)
    taken = time.process_time() - began
    found = tuned.to_dict()
    plain, chosen = found["trials"][0], found["trials"][found["chosen"]]

    def biases(row: dict[str, Any]) -> str:
        sizes = [s for s in row["sizes"] if s["kind"] == "bias"]
        return ", ".join("-" if s["size"] is None else f"{s['size']:.2g}" for s in sizes)

    units = "/".join(dict.fromkeys(s["unit"] for s in plain["sizes"] if s["kind"] == "bias" and s["unit"]))
    print(f"{case.machine}: {found['reason']}")
    for text in found["record"]:
        print(f"  record next: {text}")
    return [
        case.machine, f"{case.rate:g}", f"{chosen['fit']}; {chosen['alarm']}", f"{chosen['size']:.2g}",
        f"{biases(plain)} → {biases(chosen)} {units}".strip(),
        f"{len(found['trials'])}", f"{math.ceil(taken)} s",
    ]  # fmt: skip


def tunings(data: Path, only: str, cache: Path | None) -> None:
    """Print the table of what tune chose."""
    header = (
        "machine, left out", "false alarms per hour", "chosen", "size",
        "biases seen: plain fit → chosen", "ways", "processor time",
    )  # fmt: skip
    cases = [case for case in TUNINGS if case.machine.lower().startswith(only.lower())]
    table("What tune chooses", header, [tuned_row(case, data, cache) for case in cases])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the recordings")
    parser.add_argument("--tune", metavar="MACHINE", nargs="?", const="", help="what tune chooses, on all or one")
    parser.add_argument("--cache", type=Path, help="folder that keeps what tune tried")
    options = parser.parse_args()
    data = options.data
    if not data.is_dir():
        print(f"{data}: the recordings are not there; name their folder with --data", file=sys.stderr)
        return 2
    if options.tune is not None:
        tunings(data, options.tune, options.cache)
        return 0
    rows = go2(data)
    for case in CASES:
        fitted = read_shared(case.signals, *case.fitted, data=data)
        model = fit(fitted)
        rows += rows_of(
            case.machine, model, fitted, [read_as_fitted(data / name, model.signals) for name in case.checked]
        )
    table(
        "Envelopes of real machines", ("machine: state", "mean width", "rms step", "range", "inside, not fitted"), rows
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
