# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Verdicts lost while inputs catch up: a monitor that starts into a running stream, or that was stopped for a while.

    ./run python benchmarks/start.py                       # the table: 20 starts and 5 stops of each kind
    ./run python benchmarks/start.py --starts 3 --stops 1 --executors events --publishers rclpy

Processes publish a state and a control message per sample (sensor_msgs/JointState, stamped with the same instant, both
topics from one process or each from its own) long before the monitor starts, and go on. The monitor notes what it
received, in order of receipt. A sample that was received with its control has to have a verdict on the next sample, if
that was received: those that have none are lost. States and controls that the middleware itself did not deliver, of
those sent between the first and the last that were received, are listed as `undelivered`. A stop is SIGSTOP to the
monitor for 4 s, then SIGCONT.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from live_monitor import CONTROL, CONTROLS, STATE, save_model
from measure import table

STATES = 5
RATE_AT_START, RATE_AT_STOP = 160.0, 200.0
STOP = 4.0  # s
RUNNING = 1.5  # s of the stream before the monitor starts
AFTER = 3.5  # s of the stream after the first verdict, or after the stop
PATIENCE = 30.0  # s for a monitor to start
VENDORS = ("rclpy", "cyclonedds")
EXECUTORS = ("events", "default")
RELIABILITIES = ("reliable", "best_effort")

_CYCLONE = """<CycloneDDS><Domain><General>
<Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces><AllowMulticast>false</AllowMulticast>
</General><Discovery><Peers><Peer address="127.0.0.1"/></Peers><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>60</MaxAutoParticipantIndex></Discovery></Domain></CycloneDDS>"""


# --- the processes ------------------------------------------------------------------------------------------


def pace(rate: float, publish: list[Any]) -> None:
    """Publish a sample on each topic, at instants that all processes agree on, until a signal ends it."""
    step = round(1e9 / rate)
    following = time.time_ns() // step + 1
    while True:
        wait = following * step - time.time_ns()
        if wait > 0:
            time.sleep(wait * 1e-9)
        for send in publish:
            send(following * step)
        following += 1


def publish_rclpy(rate: float, reliability: str, topics: list[str]) -> None:
    import rclpy
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import JointState

    from uncertain_lti.monitor.outputs import NamedVector

    rclpy.init()
    node = rclpy.create_node("publisher")
    reliable = ReliabilityPolicy.RELIABLE if reliability == "reliable" else ReliabilityPolicy.BEST_EFFORT
    sends = []
    for topic in topics:
        names = [f"x{i}" for i in range(STATES)] if topic == STATE else [f"u{j}" for j in range(CONTROLS[STATES])]
        lay_out, values = NamedVector(names), bytes(8 * len(names))
        publisher = node.create_publisher(JointState, topic, QoSProfile(depth=1000, reliability=reliable))
        sends.append(lambda t, lay_out=lay_out, values=values, p=publisher: p.publish(lay_out(t, values)))
    print("begins", flush=True)
    pace(rate, sends)


def publish_cyclonedds(rate: float, reliability: str, topics: list[str]) -> None:
    from dataclasses import dataclass

    from cyclonedds.core import Policy, Qos
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.idl import IdlStruct
    from cyclonedds.idl.types import float64, int32, sequence, uint32
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration

    @dataclass
    class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
        sec: int32
        nanosec: uint32

    @dataclass
    class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
        stamp: Time
        frame_id: str

    @dataclass
    class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
        header: Header
        name: sequence[str]
        position: sequence[float64]
        velocity: sequence[float64]
        effort: sequence[float64]

    for kind in (Header, JointState):  # names of these are looked up where a module is, not in a function
        kind.__annotations__ = {
            name: {"Time": Time, "Header": Header, "int32": int32, "uint32": uint32, "str": str,
                   "sequence[str]": sequence[str], "sequence[float64]": sequence[float64]}[str(text)]
            for name, text in kind.__annotations__.items()
        }  # fmt: skip
    Time.__annotations__ = {"sec": int32, "nanosec": uint32}
    participant = DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]))
    reliable = Policy.Reliability.Reliable(duration(seconds=1))
    quality = reliable if reliability == "reliable" else Policy.Reliability.BestEffort
    sends = []
    for topic in topics:
        names = [f"x{i}" for i in range(STATES)] if topic == STATE else [f"u{j}" for j in range(CONTROLS[STATES])]
        writer = DataWriter(
            participant, Topic(participant, f"rt{topic}", JointState), Qos(quality, Policy.History.KeepLast(1000))
        )

        def send(t: int, writer: Any = writer, names: list[str] = names) -> None:
            header = Header(Time(t // 10**9, t % 10**9), "")
            writer.write(JointState(header, names, [0.0] * len(names), [], []))

        sends.append(send)
    print("begins", flush=True)
    pace(rate, sends)


def watch(model: str, executor: str) -> None:
    """The monitor; prints what it received and judged when it ends."""
    if executor == "default":
        sys.modules["rclpy.experimental"] = None  # type: ignore[assignment]
    from uncertain_lti.monitor.session import Session
    from uncertain_lti_ros.envelope_monitor import main
    from uncertain_lti_ros.topics import MatchedSubscription

    received, judged = [], []
    take, judge = MatchedSubscription._take, Session.take

    def noting(subscription: Any, *given: Any) -> None:
        data, _ = given if len(given) == 2 else given[0]
        seconds, nanoseconds = (int.from_bytes(data[at : at + 4], "little") for at in (4, 8))
        received.append((time.monotonic(), subscription.topic, seconds * 10**9 + nanoseconds))
        take(subscription, *given)

    def judging(session: Any, *message: Any) -> Any:
        verdicts, opened = judge(session, *message)
        for verdict in verdicts:
            if verdict.judged:
                if not judged:
                    print("judges", file=sys.stderr, flush=True)
                judged.append((time.monotonic(), verdict.t_ns))
        return verdicts, opened

    MatchedSubscription._take, Session.take = noting, judging  # type: ignore[method-assign]
    status = main(["--ros-args", "-p", f"model:={model}", "--log-level", "error"])
    print(json.dumps({"received": received, "judged": judged}), flush=True)
    raise SystemExit(status)


# --- one run ------------------------------------------------------------------------------------------------


class Run:
    """One start, or one stop, of a monitor in a running stream; `tell` gives what came of it."""

    def __init__(self, folder: Path, vendor: str, reliability: str, executor: str, processes: int) -> None:
        self.env = os.environ | {
            "ROS_DOMAIN_ID": str(100 + random.randrange(100)),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(folder),
            "CYCLONEDDS_URI": _CYCLONE,
        }
        self.folder, self.executor = folder, executor
        self.vendor, self.reliability, self.processes = vendor, reliability, processes

    def _start(self, *words: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, __file__, *words], env=self.env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def tell(self, stop: bool) -> dict[str, float]:
        rate = RATE_AT_STOP if stop else RATE_AT_START
        model = self.folder / f"{rate:g}.model.json"
        if not model.exists():
            save_model(model, STATES, rate)
        groups = [[CONTROL, STATE]] if self.processes == 1 else [[CONTROL], [STATE]]
        started = []
        try:
            for topics in groups:
                publisher = self._start("publish", self.vendor, str(rate), self.reliability, *topics)
                started.append(publisher)
                assert publisher.stdout is not None and publisher.stdout.readline(), publisher.stderr.read()
            time.sleep(RUNNING)
            monitor = self._start("watch", str(model), self.executor)
            started.append(monitor)
            assert monitor.stderr is not None and "judges" in monitor.stderr.readline()
            time.sleep(AFTER)
            if stop:
                monitor.send_signal(signal.SIGSTOP)
                time.sleep(STOP)
                monitor.send_signal(signal.SIGCONT)
                time.sleep(AFTER)
            monitor.send_signal(signal.SIGINT)
            text, _ = monitor.communicate(timeout=PATIENCE)
            return losses(json.loads(text.splitlines()[-1]), rate)
        finally:
            for process in started:
                process.kill()
                process.communicate()


def losses(found: dict[str, Any], rate: float) -> dict[str, float]:
    """What one run received, judged and lost."""
    stamps = {topic: sorted({t for _, at, t in found["received"] if at == topic}) for topic in (STATE, CONTROL)}
    first, controls, step = max(stamps[STATE][0], stamps[CONTROL][0]), {*stamps[CONTROL]}, round(1e9 / rate)
    due = [
        t
        for before, t in itertools.pairwise(stamps[STATE])
        if before >= first and before in controls and t - before == step
    ]
    judged = {t for _, t in found["judged"]}
    arrival = {t: now for now, topic, t in found["received"] if topic == STATE}
    delays = [now - arrival[t] for now, t in found["judged"]]
    last = min(stamps[STATE][-1], stamps[CONTROL][-1])
    sent = (last - first) // step + 1
    came = [sum(first <= t <= last for t in stamps[topic]) for topic in stamps]
    return {
        "samples": len(due),
        "lost": sum(t not in judged for t in due),
        "undelivered": 2 * sent - sum(came),
        "longest_wait": max(delays),
    }


def compare(args: argparse.Namespace, folder: Path) -> None:
    kinds = [(False, args.starts), (True, args.stops)]
    header = ["", "publishers", "reliability", "executor", "runs that lost", "verdicts lost", "undelivered",
              "longest wait, s"]  # fmt: skip
    rows = []
    for stop, runs in kinds:
        for vendor in args.publishers:
            for reliability in args.reliabilities:
                for executor in args.executors:
                    results = [
                        Run(folder, vendor, reliability, executor, 1 + number % 2).tell(stop) for number in range(runs)
                    ]
                    if not results:
                        continue
                    lost = [int(r["lost"]) for r in results]
                    rows.append([
                        "stop of 4 s" if stop else "start", vendor, reliability, executor,
                        f"{sum(map(bool, lost))} of {runs}",
                        f"{sum(lost)} of {sum(int(r['samples']) for r in results)} (at most {max(lost)} in a run)",
                        str(sum(int(r["undelivered"]) for r in results)),
                        f"{statistics.median(r['longest_wait'] for r in results):.2f}",
                    ])  # fmt: skip
                    print(*rows[-1], file=sys.stderr, flush=True)
    table("Verdicts lost while inputs catch up", header, rows)


def main() -> None:
    if sys.argv[1:2] == ["publish"]:
        vendor, rate, reliability, *topics = sys.argv[2:]
        {"rclpy": publish_rclpy, "cyclonedds": publish_cyclonedds}[vendor](float(rate), reliability, topics)
        return
    if sys.argv[1:2] == ["watch"]:
        watch(*sys.argv[2:])
        return
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--starts", type=int, default=20, metavar="N", help="starts of each kind (default 20)")
    parser.add_argument("--stops", type=int, default=5, metavar="N", help="stops of each kind (default 5)")
    parser.add_argument("--publishers", nargs="+", choices=VENDORS, default=VENDORS)
    parser.add_argument("--reliabilities", nargs="+", choices=RELIABILITIES, default=RELIABILITIES)
    parser.add_argument("--executors", nargs="+", choices=EXECUTORS, default=EXECUTORS)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        compare(args, Path(folder))


if __name__ == "__main__":
    main()
