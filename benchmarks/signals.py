#!/usr/bin/env python3
# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What a signals file can say beyond fields: lags and rates, a constant step, many alike; on real recordings.

    python benchmarks/signals.py [--data FOLDER] [--found FOLDER] [MACHINE...]

Each row is one state, before and after: entries in the signals file, mean width per step over the root mean square of
the state's steps, the share inside its bounds, and the smallest step of its sensor that is seen in 90 % of the cases
(an alarm at one violation), over the same root mean square; all on what was left out of the fit (ten blocks per
recording, with guard intervals).

`--found` is a folder of further public recordings, which are not shipped; a machine whose file is absent is left out:

    SNLS80mV.csv       the Silverbox, an electronic oscillator with one measured voltage;
                       github.com/biaslab/nsi-silverbox, data/Silverbox
    dataBenchmark.csv  two cascaded tanks, one measured level (Schoukens and others); github.com/MiladBnit/
                       Uncertainty-quantification-in-neural-state-space-models-applications
    before1.bag, after1.bag, col2.bag
                       a wheeled robot, ROS 1 (MIT); github.com/zaki0929/bagfiles, 2018/may9/editted and 2018/feb13
    my_bag.db3         a filter of odometry as a node, beside a simulated TurtleBot3, rosbag2 (MIT);
                       github.com/fadil-nurmaulid/robot_kf, my_bag
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml
from measure import table
from shared_recordings import DATA

from uncertain_lti import SignalMap, Transient, fit, read_transients, validate
from uncertain_lti.base.arrays import Array
from uncertain_lti.validation.detectable import detectable

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Case:
    """A machine with two signals files: names, recordings, and what the second one adds to the first."""

    machine: str
    recordings: tuple[str, ...]
    before: SignalMap
    after: SignalMap
    entries: tuple[int, int]


def entries(data: dict[str, object]) -> int:
    """Signals and rules that a person writes."""
    lists = [data.get(key) for key in ("states", "controls", "structure")]
    return sum(len(part) if isinstance(part, list) else part is not None for part in lists)


def case(
    machine: str, recordings: Sequence[str], file: Path | dict[str, object], *memories: str, **more: object
) -> Case:
    """The shipped file (or its content), and the same with memories of its states and controls."""
    data = yaml.safe_load(file.read_text()) if isinstance(file, Path) else file
    signals = {s["name"]: s for key in ("states", "controls") for s in data[key]}
    added = []
    for memory in memories:
        kind, name, *samples = memory.replace("(", " ").replace(",", " ").replace(")", "").split()
        field = f"{kind}({', '.join([signals[name]['field'], *samples])})"
        hold = {"max_hold": signals[name]["max_hold"]} if "max_hold" in signals[name] else {}
        added.append({"name": memory, "topic": signals[name]["topic"], "field": field, **hold})
    after = {**data, "controls": [*data["controls"], *added], **more}
    maps = [SignalMap.from_dict(d, source=machine) for d in (data, after)]
    return Case(machine, tuple(recordings), maps[0], maps[1], (entries(data), entries(after)))


def left_out(transients: Sequence[Transient]) -> tuple[Array, Array, Array]:
    """Mean width over the root mean square step, share inside, and smallest bias over the same step, (n,) each."""
    model = fit(transients)
    parts = validate(transients, full=model, blocks=10).parts
    judged = sum(part.judged for part in parts)
    steps = [t.transitions() for t in transients]
    rms = np.sqrt(np.mean(np.concatenate([s.x_next - s.x for s in steps]) ** 2, axis=0))
    width = sum(part.judged * part.mean_width for part in parts) / judged
    outside = sum((np.abs(part.utilisation) > 1.0).sum(axis=0) for part in parts) / judged
    seen = detectable(model, parts, kinds=["bias"]).faults
    return width / rms, 1.0 - outside, np.array([fault.size for fault in seen] or [np.nan] * len(rms)) / rms


def compared(data: Path, of: Case) -> list[list[str]]:
    found = []
    for signals in (of.before, of.after):
        found.append(left_out(read_transients([data / name for name in of.recordings], signals)))
    return [
        [
            f"{of.machine}: {signal.name}",
            " → ".join(str(count) for count in of.entries),
            " → ".join(f"{width[i]:.3g}" for width, _, _ in found),
            " → ".join(f"{inside[i]:.2%}" for _, inside, _ in found),
            " → ".join(f"{bias[i]:.3g}" for _, _, bias in found),
        ]
        for i, signal in enumerate(of.before.states)
    ]


def go2(data: Path, folder: Path) -> list[list[str]]:
    """Twelve files with a joint each, and one with all; entries of the twelve, and what one took without templates."""
    recording = data / "go2" / "test_3.mcap"
    text = (folder / "go2_joint.yaml").read_text()
    alone = []
    for joint in range(12):
        signals = SignalMap.from_dict(yaml.safe_load(text.replace("[j0]", f"[j{joint}]")), source="go2")
        alone.append(left_out(read_transients(recording, signals)))
    whole = SignalMap.load(folder / "go2.yaml")
    recorded = left_out(read_transients(recording, replace(whole, step="recorded")))
    constant = left_out(read_transients(recording, whole))
    rows = []
    for i, name in enumerate(("angle", "rate")):
        widths = [np.array([width[i] for width, _, _ in alone])]
        shares = [np.array([inside[i] for _, inside, _ in alone])]
        biases = [np.array([bias[i] for _, _, bias in alone])]
        for width, inside, bias in (recorded, constant):
            biases.append(bias[12 * i : 12 * i + 12])
            widths.append(width[12 * i : 12 * i + 12])
            shares.append(inside[12 * i : 12 * i + 12])
        rows.append(
            [
                f"Go2, twelve joints: {name} (median; recorded step, then constant)",
                f"{12 * 3} in 12 files, or {36 + len(whole.structure)} → 4",
                " → ".join(f"{np.median(width):.3g}" for width in widths),
                " → ".join(f"{share.mean():.2%}" for share in shares),
                " → ".join(f"{np.median(bias):.3g}" for bias in biases),
            ]
        )
        print(name, "width with a constant step over that with the recorded one:", np.round(widths[2] / widths[1], 2))
    return rows


def found_cases(folder: Path, scratch: Path) -> list[Case]:
    """Of the recordings in a folder that are there; tables get a column of time."""

    def runs(name: str, step: float, pairs: Sequence[tuple[str, str]], rows: slice = slice(None)) -> str:
        columns = np.genfromtxt(folder / name, delimiter=",", names=True)
        path = scratch / f"{Path(name).stem}_runs.csv"
        lines = ["run,time,input,output"]
        for run, (u, y) in enumerate(pairs):
            for k, (a, b) in enumerate(zip(columns[u][rows], columns[y][rows], strict=True)):
                lines.append(f"{run},{k * step:.9g},{a:.9g},{b:.9g}")
        path.write_text("\n".join(lines) + "\n")
        return str(path)

    one = {
        "additive": "noise",
        "table": {"runs": "run"},
        "states": [{"name": "output", "topic": "/table", "field": "output"}],
        "controls": [{"name": "input", "topic": "/table", "field": "input"}],
    }
    base = {
        "additive": "noise",
        "topics": {"/odom": {"time": "log"}, "/cmd_vel": {"time": "log"}},
        "states": [
            {"name": "linear", "topic": "/odom", "field": "twist.twist.linear.x"},
            {"name": "angular", "topic": "/odom", "field": "twist.twist.angular.z"},
        ],
        "controls": [
            {"name": "linear_command", "topic": "/cmd_vel", "field": "linear.x", "max_hold": 1.0},
            {"name": "angular_command", "topic": "/cmd_vel", "field": "angular.z", "max_hold": 1.0},
        ],
    }
    odometry = {
        "additive": "noise",
        "states": [{"name": a, "topic": "/odom_kf", "field": f"pose.pose.position.{a}"} for a in "xy"],
        "controls": [{"name": f"{a}_in", "topic": "/odom_noisy", "field": f"pose.pose.position.{a}"} for a in "xy"],
    }
    cases = []
    if (folder / "SNLS80mV.csv").is_file():
        path = runs("SNLS80mV.csv", 2**14 / 1e7, [("V1", "V2")], slice(40_650, 50_650))  # the first multisine
        cases.append(case("Silverbox", [path], one, "lag(output, 1)"))
    if (folder / "dataBenchmark.csv").is_file():
        path = runs("dataBenchmark.csv", 4.0, [("uEst", "yEst"), ("uVal", "yVal")])
        cases += [case("Tanks", [path], one, *m) for m in (["lag(output, 1)"], ["rate(output)", "lag(input, 1)"])]
    bags = [folder / f"{name}.bag" for name in ("before1", "after1", "col2")]
    if all(bag.is_file() for bag in bags):
        memories = ["lag(linear_command, 1)", "lag(angular_command, 1)"]
        cases.append(case("Wheeled robot", [str(bag) for bag in bags], base, *memories))
    if (filtered := folder / "my_bag.db3").is_file():
        cases.append(case("Filter node", [str(filtered)], odometry, "rate(x)", "rate(y)"))
    return cases


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the recordings")
    parser.add_argument("--found", type=Path, metavar="FOLDER", help="folder of further recordings, see above")
    parser.add_argument("machines", nargs="*", metavar="MACHINE", help="words of the machines to compare; default all")
    options = parser.parse_args()
    data = options.data
    if not data.is_dir():
        print(f"{data}: the recordings are not there; name their folder with --data", file=sys.stderr)
        return 2
    folder = ROOT / "config" / "signals"
    vicon = yaml.safe_load((folder / "crazyflie_vicon.yaml").read_text())
    pitch = vicon | {
        "states": [{**vicon["states"][0], "name": "pitch", "field": "pitch(pose.orientation)"}],
        "controls": [{**vicon["controls"][0], "name": "pitch_control", "field": "position.y"}],
    }
    depth = {
        "additive": "noise",
        "states": [{"name": "depth", "topic": "/coug2/depth_data", "field": "pose.pose.position.z"}],
        "controls": [
            {"name": f"fin_{k}", "topic": "/coug2/controls/command", "field": f"fin[{k}]", "scale": 10.0}
            for k in (0, 1)
        ],
    }
    hunter = [f"hunter_se/straight_{name}_run_0{k}.mcap" for name in ("even_t_0_2", "odd_t_0_5") for k in (1, 2)]
    turbine = [f"micro_gas_turbine/ex_{k}.mcap" for k in (1, 20, 24)]
    neato = ["neato/person_follower.mcap", "neato/draw_square.mcap"]
    cases = [
        case("Crazyflie", ["crazyflie/rollbag_0.mcap"], folder / "crazyflie_vicon.yaml", "lag(roll, 1)"),
        case("Crazyflie", ["crazyflie/rollbag_0.mcap"], folder / "crazyflie_vicon.yaml", "rate(roll)"),
        case("Crazyflie", ["crazyflie/yx3bag_0.mcap"], pitch, "rate(pitch)"),
        case("Micro gas turbine", turbine, folder / "micro_gas_turbine.yaml", "lag(power, 1)"),
        case("Hunter SE", hunter, folder / "hunter_se.yaml", "diff(throttle)", "lag(throttle, 1)", "rate(speed)"),
        case("Neato", neato, folder / "neato.yaml", "rate(linear)", "rate(angular)"),
        case("AUV", ["cougars_auv/SO_bag_0.mcap"], depth, "rate(depth)"),
    ]
    wanted = [word.lower() for word in options.machines]

    def chosen(machine: str) -> bool:
        return not wanted or any(word in machine.lower() for word in wanted)

    rows = go2(data, folder) if chosen("Go2") else []
    with tempfile.TemporaryDirectory() as scratch:
        cases += found_cases(options.found, Path(scratch)) if options.found else []
        for one in (c for c in cases if chosen(c.machine)):
            try:
                rows += compared(data, one)
            except ValueError as error:
                print(f"{one.machine}: {error}", file=sys.stderr)
    heads = ("machine: state", "entries", "width / rms step", "inside, left out", "bias seen / rms step")
    table("What signals files can say", heads, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
