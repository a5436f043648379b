# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""`uncertain-lti demo`: fit shipped recordings of a turbofan, watch another live, and show where a fault sets in."""

from __future__ import annotations

import argparse
import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

from uncertain_lti import EnvelopeMonitor, fit, read_transients
from uncertain_lti.base.errors import BagError, UncertainLTIError
from uncertain_lti.base.text import plural
from uncertain_lti.cli.command import BAD_INPUT, DONE, Result
from uncertain_lti.plants.turbofan_runs import turbofan_signals
from uncertain_lti.recordings.bag_files import metadata_pairs
from uncertain_lti.reports.check import check_data, check_text
from uncertain_lti.reports.figures import alarm_figure, envelope_figure, matrices_figure, save
from uncertain_lti.reports.model_text import fit_text
from uncertain_lti.sampling.reading import read_as_fitted
from uncertain_lti_ros.process import Life, living, speed
from uncertain_lti_ros.topics import stamp_ns

RUNS = ("pulses_up_large", "pulses_down_large", "pulses_up_again", "pulses_down_again", "levels")
FIT = tuple(f"turbofan_{run}_noise.mcap" for run in RUNS)
CHECK = "turbofan_fan_damage.mcap"
SHOWN = ["fan_speed", "compressor_exit_total_pressure", "turbine_exit_total_pressure"]
_FLAGS = "/envelope_monitor/flags"
_PATIENCE = 20.0  # s for another process to do its next step
_DISCOVERY = 1.5  # s in which the programs of a domain find each other


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `uncertain-lti demo`."""
    parser.add_argument("-o", "--output", metavar="FOLDER", default="demo-output", help="where model and figure go")
    parser.add_argument("--rate", type=speed, default=4.0, metavar="R", help="speed of the player (default 4)")
    parser.add_argument("--json", action="store_true", help="print what came out as JSON")


def run(args: argparse.Namespace) -> Result:
    """Run the demo."""
    say, bags = args.say, _bags()
    (output := Path(args.output)).mkdir(parents=True, exist_ok=True)
    model_file = output / "turbofan.model.json"

    say("1. Fitting a healthy turbofan (a nonlinear model with noisy sensors): pulses of every control both ways,")
    say(f"   and a run under control: {', '.join(FIT)}")
    transients = read_transients([bags / name for name in FIT], turbofan_signals())
    model = fit(transients, additive="noise")
    model.save(model_file)
    say(fit_text(model))
    say(f"   model: {model_file}")

    say(f"\n2. Playing {CHECK} at {args.rate:g} times real time to a live envelope_monitor node")
    offline = EnvelopeMonitor(model).check(read_as_fitted(bags / CHECK, model.signals))
    with living(lambda: Node("uncertain_lti_demo")) as life:
        live = _watch(life, args, model_file, bags / CHECK, offline.transient.t_ns)
        if not life.alive:
            raise KeyboardInterrupt

    say("\n3. The same recording checked offline")
    say(check_text(check_data(model, offline, samples=False)))
    expected = offline.flags[offline.judged]
    each = zip(offline.transient.t_ns[offline.judged].tolist(), expected, strict=True)
    same = sum(np.array_equal(flags, live.get(t_ns, ())) for t_ns, flags in each)
    say(f"live and offline verdicts: {same} of {len(expected)} equal")
    about = metadata_pairs(bags / CHECK)
    event = t, what = float(about["fault_at"].split()[0]), about["what happens"]
    left = offline.transient.t_ns[0] + t * 1e9
    after = offline.judged & (offline.transient.t_ns > left)
    early, late = (int((offline.violated & part).sum()) for part in (~after, after))
    of_early, of_late = (int((offline.judged & part).sum()) for part in (~after, after))
    say(f"at {t:.2f} s {what}: violated in {early} of {of_early} verdicts before and {late} of {of_late} after")
    raised = offline.transient.t[offline.alarm]
    in_time = len(raised) > 0 and raised[0] >= t
    say(f"the alarm is raised {f'{raised[0] - t:.3f} s after that' if in_time else 'too early or not at all'}")
    figures = {
        "alarm.png": alarm_figure(model, offline, event=event, most=3),
        "envelope.png": envelope_figure(model, offline, states=SHOWN, event=event),
        "envelope_close.png": envelope_figure(model, offline, states=SHOWN, event=event, span=(t - 1.5, t + 1.5)),
        "matrices.png": matrices_figure(model),
    }
    for name, figure in figures.items():
        save(figure, output / name)
        say(f"figure: {output / name}")
    data = {
        "model": str(model_file), "verdicts": len(expected), "equal_live_and_offline": same,
        "fault": {"t": t, "what": what}, "violated_before": early, "violated_after": late,
        "first_alarm_t": float(raised[0]) if len(raised) else None,
        "figures": [str(output / name) for name in figures],
    }  # fmt: skip
    return Result(DONE if same == len(expected) and in_time else BAD_INPUT, data)


def _bags() -> Path:
    """Folder of the shipped recordings: in a checkout, or in the share folder of an installation."""
    prefixes = [*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]
    for root in (Path(__file__).resolve().parents[1], *(Path(p) / "share/uncertain_lti_ros" for p in prefixes)):
        if (root / "bags" / CHECK).is_file():
            return root / "bags"
    raise BagError(f"bags/{CHECK} is neither beside the package nor in its share folder; run it from a checkout")


def _watch(life: Life, args: argparse.Namespace, model: Path, bag: Path, expected: Any) -> dict[int, Any]:
    """Start monitor and player as processes, show the flags as they come; {t_ns: flags}."""
    flags: dict[int, Any] = {}
    names: list[str] = []
    shown, heard = 0, time.monotonic()

    def take(message: JointState) -> None:
        nonlocal heard
        names[:] = message.name
        flags[stamp_ns(message)] = np.array(message.position)
        heard = time.monotonic()

    def over() -> bool:
        nonlocal shown
        _refuse_others(life, 1)
        if len(flags) - shown >= 100 or len(flags) == len(expected) > shown:
            args.say(_shown(flags, shown, names, int(expected[0])))
            shown = len(flags)
        patience = _PATIENCE if playing.poll() is None else 2.0
        return len(flags) >= len(expected) or time.monotonic() - heard > patience

    subscription = life.node.create_subscription(JointState, _FLAGS, take, QoSProfile(depth=1000))
    monitor = [sys.executable, "-m", "uncertain_lti_ros.envelope_monitor", "--ros-args", "-p", f"model:={model}"]
    player = [sys.executable, "-m", "uncertain_lti.cli.main", "play", str(bag), "--rate", str(args.rate)]
    life.until(lambda: _refuse_others(life, 0), _DISCOVERY)
    with _process([*monitor, "--log-level", "warn"]):
        if not life.until(lambda: life.node.count_publishers(_FLAGS), _PATIENCE):
            if not life.alive:
                raise KeyboardInterrupt
            raise UncertainLTIError(f"envelope_monitor did not start within {_PATIENCE:g} s; see its messages above")
        with _process(player) as playing:
            heard = time.monotonic()
            life.until(over)
            if life.alive and len(flags) < len(expected):
                args.progress.note(f"no more flags after {len(flags)} of {len(expected)}")
            life.until(lambda: playing.poll() is not None, _PATIENCE)  # it ends once its messages are confirmed
    life.node.destroy_subscription(subscription)
    return flags


def _refuse_others(life: Life, own: int) -> None:
    """Refuse to go on where another monitor publishes too: each would hear the other's recording."""
    if life.node.count_publishers(_FLAGS) > own:
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        raise UncertainLTIError(
            f"another envelope_monitor publishes {_FLAGS} in ROS domain {domain}, perhaps of another demo, and "
            f"each would hear the other's recording; end it, or choose another domain: export ROS_DOMAIN_ID="
            f"{int(domain) % 100 + 1 if domain.isdigit() else 1}"
        )


def _shown(flags: dict[int, Any], since: int, names: list[str], start_ns: int) -> str:
    """One line for the flags that came since the last one."""
    stamps = list(flags)[since:]
    recent = np.array([flags[t] for t in stamps])
    judged, violated = np.isfinite(recent).all(axis=1), recent == 1.0
    counts = zip(names, violated.sum(axis=0).tolist(), strict=True)
    where = ", ".join(f"{name} {count}" for name, count in counts if count)
    word = f"VIOLATED {int(violated.any(axis=1).sum())}: {where}" if where else "contained"
    begin, end = ((t_ns - start_ns) * 1e-9 for t_ns in (stamps[0], stamps[-1]))
    return f"   t = {begin:6.2f} to {end:6.2f} s: {plural(int(judged.sum()), 'verdict')}, {word}"


@contextlib.contextmanager
def _process(command: list[str]) -> Iterator[subprocess.Popen[bytes]]:
    """A process that ends with the block, also when that fails."""
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        try:
            yield process
        finally:
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(10)
            process.kill()  # nothing where it has ended
