# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Streams in disorder whose control stamps lag by 0 to 5 steps, through the node with everything armed, against check.

    ./run python benchmarks/lags.py                    # 50 streams, eight or nine of each lag
    ./run python benchmarks/lags.py --busy 8           # beside eight processes that only count

Models and streams are those of `tests/perturbed.py`, by seed; every topic has header stamps, as of arrivals the node
and a recording know different ones. A stream is published message by message as it would have been recorded, a pause
of more than 0.4 s in 0.4 s. Compared are all outputs of each sample that `check` judges, to the last bit, and the
changes of ~/violation where no condition ends an alarm between samples.
"""

from __future__ import annotations

import argparse
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

import perturbed  # noqa: E402
from bag_writer import Message  # noqa: E402
from geometry_msgs.msg import Vector3Stamped  # noqa: E402
from perturbed import CONTROL, GEAR, KIND, STATE, STEP_NS, VECTOR  # noqa: E402
from rclpy.qos import QoSProfile  # noqa: E402
from ros_processes import World, open_world, until  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_msgs.msg import Bool  # noqa: E402

from uncertain_lti import UncertainLTI  # noqa: E402

KIND[GEAR] = VECTOR
CLASSES = {VECTOR: Vector3Stamped, perturbed.JOINT_STATE: JointState}
LONGEST_PAUSE = 0.4  # s; a stall of the stream, which messages wait after
APART = 3e-4  # s between two messages at least
NODE = "/envelope_monitor"
_STAMP = struct.Struct("<iI")


def stamped(model: UncertainLTI) -> UncertainLTI:
    """The model with header stamps on every topic, and controls that may be as old as the greatest lag."""
    signals = model.signals
    time_of = {topic: "header" for topic in signals.topics}
    controls = tuple(replace(s, max_hold=0.5) if s.topic == CONTROL else s for s in signals.controls)
    gear = tuple(replace(s, field="vector.x", type=VECTOR, max_hold=5.0) for s in signals.scheduling)
    return model.replace(signals=replace(signals, controls=controls, scheduling=gear, time=time_of))


def stamp_of(data: bytes) -> int:
    seconds, nanoseconds = _STAMP.unpack_from(data, 4)
    return int(seconds * 10**9 + nanoseconds)


def lagging(messages: Sequence[Message], lag_ns: int) -> list[Message]:
    """The messages with stamps of the controls behind, and a stamp on those of the gear."""
    found, newest = [], perturbed.EPOCH_NS
    for one in messages:
        data = one.data
        if len(data) < 4:
            continue  # Fast DDS gives a reader nothing more of a topic on which a message of no bytes came
        if one.topic != GEAR and len(data) > 12 and not stamp_of(data):
            continue  # of those without one the time of receipt stands in, which a recording knows as another
        if one.topic == STATE and len(data) > 12:
            newest = stamp_of(data)
        elif one.topic == GEAR:
            (gear,) = struct.unpack_from("<d", data, 4)
            data = perturbed.vector(newest, gear, 0.0, 0.0)
        elif one.topic == CONTROL:
            stamp = stamp_of(data)
            data = data[:4] + _STAMP.pack(*divmod(stamp - lag_ns, 10**9)) + data[12:]
        found.append(replace(one, data=data))
    return found


def paced(messages: Sequence[Message]) -> list[Message]:
    """The messages at the times at which they are sent."""
    at, before, found = messages[0].log_time, messages[0].log_time, []
    for one in messages:
        pause = min(max((one.log_time - before) * 1e-9, APART), LONGEST_PAUSE)
        at, before = at + round(pause * 1e9), one.log_time
        found.append(replace(one, log_time=at))
    return found


def told(world: World, topic: Any, count: int, patience: float) -> None:
    """Wait for as many messages, and for those that should not come."""
    end = time.monotonic() + patience
    while len(topic.messages) < count and time.monotonic() < end:
        time.sleep(0.05)
    time.sleep(0.5)


def changes(alarms: Sequence[bool]) -> list[bool]:
    return [b for a, b in zip([False, *alarms], alarms, strict=False) if a != b]


def one_stream(world: World, folder: Path, seed: int, lag: int, steps: int) -> Counter[str]:
    """Play one stream; counts of verdicts, those that differ and those that never came."""
    rng = np.random.default_rng(seed)
    model = stamped(perturbed.armed_model(rng, everything=True))
    rule = perturbed.deployment(model, rng)
    rule = replace(rule, enable=rule.enable.replace(f"{GEAR} data", f"{GEAR} vector.x"))
    messages = paced(lagging(perturbed.stream(model, rng, steps), lag * STEP_NS))
    expected = perturbed.offline(model, rule, messages, folder / f"{seed}.mcap")
    judged = [row for row in expected if row["status"].value == "ok"]
    model.save(folder / "armed.model.json")
    names = [n for n in ("masked", "enable", "grace", "latch", "violations", "window", "margin") if getattr(rule, n)]
    process = world.monitor(
        folder / "armed.model.json", **{name: getattr(rule, name) for name in names}, state_timeout=60.0
    )
    parts = ("flags", "lower", "upper", "state", "utilisation", "horizon_utilisation", "statistics")
    heard = {name: world.listen(JointState, f"{NODE}/{name}").connected() for name in parts}
    alarm = world.listen(Bool, f"{NODE}/violation").connected()
    publishers = {
        topic: world.publisher(CLASSES[KIND[topic]], topic, QoSProfile(depth=5000))
        for topic in {m.topic for m in messages} & {*model.signals.topics, rule.enable.partition(" ")[0]}
    }
    world.subscribed(*publishers.values())
    until(lambda: all(world.status()["listeners"][name] for name in (*parts, "violation")), "listeners")
    time.sleep(0.5)
    began, last, sent = time.monotonic(), 0.0, Counter[str]()
    for one in messages:
        if one.topic not in publishers:
            continue
        due = began + (one.log_time - messages[0].log_time) * 1e-9
        while (rest := max(due, last + APART) - time.monotonic()) > 0:
            time.sleep(rest)
        last = time.monotonic()
        publishers[one.topic].publish(one.data)
        sent[one.topic] += 1
    told(world, heard["statistics"], len(judged), 30.0)
    status = world.status()
    found = Counter(
        streams=1, samples=len(expected), judged=len(judged), held_back=status["held_back"],
        lost=sum(status["lost"].values()), alarms=sum(changes([row["alarm"] for row in expected])),
        errors=status["unexpected_errors"],
    )  # fmt: skip
    differs, parts_unlike = set[int](), list[str]()
    for name in parts:
        got = [(stamp_of_message(m), np.array(m.position).tobytes()) for m in heard[name].messages]
        if name == "flags":  # also of samples without a verdict
            got = [(t_ns, data) for t_ns, data in got if not np.isnan(np.frombuffer(data)).all()]
        wanted = [(row["t_ns"], row[name]) for row in judged]
        found[f"compared {name}"] = len(wanted)
        missing, more = Counter(t for t, _ in wanted), Counter(t for t, _ in got)
        found["withheld"] += (missing - more).total()
        found["unexpected"] += (more - missing).total()
        if (unlike := {t for t, _ in Counter(wanted) - Counter(got) if more[t]}) - differs:
            differs |= unlike
            parts_unlike.append(f"{len(unlike)} {name} from {min(unlike)} on")
        if got != wanted and not (missing - more or more - missing or differs):
            found["out of order"] += 1
    found["differing"] = len(differs)
    # by a condition the alarm may be off for a moment between two samples, of which a check knows nothing
    if not rule.enable and changes([m.data for m in alarm.messages]) != changes([row["alarm"] for row in expected]):
        found["other alarms"] += 1
    if found["withheld"] or found["differing"] or found["unexpected"] or found["other alarms"]:
        print(f"seed {seed}, lag {lag}: {dict(found)}; {'; '.join(parts_unlike)}", flush=True)
        print(f"  received {status['received']} of {dict(sent)}", flush=True)
    process.kill()
    for topic in (*heard.values(), alarm):
        world.node.destroy_subscription(topic.subscription)
    for publisher in publishers.values():
        world.node.destroy_publisher(publisher)
    return found


def stamp_of_message(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec * 10**9 + stamp.nanosec)


@contextmanager
def busy(count: int) -> Iterator[None]:
    """So many processes that only count, meanwhile; they end with this one whatever happens."""
    code = "import ctypes; ctypes.CDLL(None).prctl(1, 9)\nwhile True: pass"
    processes = [subprocess.Popen([sys.executable, "-c", code]) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--streams", type=int, default=50)
    parser.add_argument("--steps", type=int, default=500, help="samples of a stream, 0.01 s each")
    parser.add_argument("--lags", type=int, nargs="+", default=[0, 1, 2, 3, 4, 5], help="in steps")
    parser.add_argument("--seeds", type=int, nargs="+", help="instead of so many from the first on")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--busy", type=int, default=0, metavar="N", help="processes that keep the machine busy")
    args = parser.parse_args()
    total = Counter[str]()
    with busy(args.busy):
        seeds = args.seeds or range(args.first, args.first + args.streams)
        for i, seed in enumerate(seeds):
            with tempfile.TemporaryDirectory() as folder, open_world(Path(folder)) as world:
                total += one_stream(world, Path(folder), seed, args.lags[seed % len(args.lags)], args.steps)
                print(f"{i + 1} of {len(seeds)}: {dict(total)}", flush=True)
    print(", ".join(f"{count} {name}" for name, count in total.items()))


if __name__ == "__main__":
    main()
