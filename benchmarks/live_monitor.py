# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The live monitor and a bare rclpy node on the same topics: CPU per sample, time to the flag, losses, memory.

    ./run python benchmarks/live_monitor.py                        # the table: rates 500 Hz and 1 kHz, n = 5 and 50
    ./run python benchmarks/live_monitor.py --left 0.003           # the same, three in a thousand samples out of bounds
    ./run python benchmarks/live_monitor.py --soak 600             # ten minutes at 1 kHz: memory and counters
    ./run python benchmarks/live_monitor.py --soak 600 --armed     # the same with everything armed, and live = offline

What the ratios are held against: with every output heard at most 0.6 times the CPU of the bare node on the default
executor and 1.5 times that on the events executor, with only ~/violation heard 1.1 times; the flags at most 1 ms
later than the bare node's callback in 99 of 100 cases; nothing lost. The rows "publishing only" are a node that takes
the same messages as bytes and publishes as much as the monitor does, but samples and judges nothing: what is in
that row is the price of rclpy and DDS, and of laying out messages in Python.

One process publishes a state and a control message per sample (sensor_msgs/JointState, reliable, stamped with the
time of publishing). Another one takes them: a bare node that subscribes and does nothing, on either executor, or the
monitor. A third subscribes to what the monitor publishes. CPU is the processor time of the whole process, the
middleware's threads included, over the samples published meanwhile. Subjects take turns, and each is set against the
bare node of the same turn, as machines change their speed; medians over the turns count. The delay is from the stamp
to the callback of the bare node, and to the flag's arrival in the third process.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import select
import signal
import subprocess
import sys
import tempfile
import time
import zlib
from array import array
from pathlib import Path
from typing import Any

import numpy as np

from uncertain_lti.monitor.outputs import OUTPUTS, RECORDED, VIOLATION, VerdictMessages, names_of

STATE, CONTROL = "/bench/state", "/bench/control"
TYPE = "sensor_msgs/msg/JointState"
CONTROLS = {5: 2, 50: 10}
WARM_UP = 2.0  # s
QUEUE, QUEUE_ARMED = 1000, 5000
STEPS = (2, 3, 5, 8, 12, 16, 20, 25, 32, 40)
MODEL = "bench.model.json"
LEFT = 0.001  # of the samples of an armed model


def save_model(path: Path, n: int, rate: float, armed: bool = False) -> None:
    from uncertain_lti import SignalMap, UncertainLTI
    from uncertain_lti.model.domain import Sampling
    from uncertain_lti.signals.signal_map import Signal

    m, dt = CONTROLS[n], 1.0 / rate
    signals = SignalMap(
        tuple(Signal(f"x{i}", STATE, f"position[x{i}]", type=TYPE) for i in range(n)),
        tuple(Signal(f"u{j}", CONTROL, f"position[u{j}]", type=TYPE, max_hold=0.5) for j in range(m)),
        clock=STATE,
        max_gap=100 * dt,
        time={STATE: "header", CONTROL: "header"},
    )
    rng = np.random.default_rng(1)
    matrices = rng.normal(size=(n, n)), rng.normal(size=(n, m)), np.full((n, n), 0.1), np.full((n, m), 0.1)
    if armed:
        parts = arms(rng, matrices, dt)
    else:
        parts = dict(zip(("A", "B", "dA", "dB"), matrices, strict=True)) | {"v": np.full(n, 0.1)}
    UncertainLTI(**parts, signals=signals, sampling=Sampling(dt)).save(path)


def arms(rng: np.random.Generator, matrices: tuple[Any, ...], dt: float) -> dict[str, Any]:
    """Everything that a model may have; statistics over 50 to 400 steps."""
    from uncertain_lti.model.alarm_rule import JOINT, KINDS, AlarmRule, StatisticRule
    from uncertain_lti.model.horizon import Horizon, Residuals
    from uncertain_lti.model.repeats import Repeats
    from uncertain_lti.model.schedule import Axis, BlockData, Schedule

    knots = (-0.02, 0.0, 0.02)
    blocks, n = len(knots), len(matrices[0])

    def scheduled(*arrays: Any) -> list[Any]:
        return [np.stack([a * factor for factor in rng.uniform(0.5, 1.0, blocks)]) for a in arrays]

    v = np.full((blocks, n), 0.1)
    residuals = Residuals(np.zeros(n), np.eye(n) * 2 * 0.05**2 / 3 / 0.1**2)  # of what is published, over v
    horizons = [
        Horizon(
            h, *scheduled(*(np.zeros_like(a) for a in matrices[:2]), *matrices[2:]), v=v * rng.uniform(1.0, 1.2, n),
            residuals=residuals,
        )
        for h in STEPS
    ]  # fmt: skip
    rules: list[Any] = [AlarmRule(2, 5), AlarmRule(2, 5, horizon=STEPS[3])]
    for i, kind in enumerate(KINDS):
        threshold, allowance = 6.0 * n if kind in JOINT else 1.0, 0.1 if kind == "cusum" else 0.0
        rules.append(StatisticRule(kind, 50 * 2.0 ** (i % 4) * dt, threshold, 1, allowance))
        rules.append(StatisticRule(kind, 100 * dt, threshold, STEPS[-1], allowance))
    return dict(zip(("A", "B", "dA", "dB"), scheduled(*matrices), strict=True)) | {
        "v": v,
        "schedule": Schedule((Axis("x0", knots=knots),)),
        "block_data": [BlockData(1000)] * blocks,
        "horizons": horizons,
        "alarm": rules,
        "residuals": residuals,
        "repeats": Repeats(np.full(n, 3 * dt)),
    }


def rows_of(n: int, left: float) -> Any:
    """What is published, over and over: states and controls (1000, n + m)."""
    rng = np.random.default_rng(2)
    values = rng.uniform(-0.05, 0.05, (1000, n + CONTROLS[n]))
    values[rng.random(1000) < left, 0] = 10.0
    return values


# --- the processes ------------------------------------------------------------------------------------------


def publish(n: int, rate: float, seconds: float, left: float, stamps: str, awaited: list[str]) -> None:
    """Prints how many samples it sent, once both topics have a subscriber; left: share of them out of bounds.

    stamps: file that gets those of the samples; empty for none. awaited: nodes that it waits for besides. Fast DDS may
    hold up a stream for 0.33 s when another participant comes to be known in the middle of it.
    """
    import rclpy
    from rclpy.qos import QoSProfile
    from sensor_msgs.msg import JointState

    from uncertain_lti.monitor.outputs import NamedVector

    rclpy.init()
    node = rclpy.create_node("publisher")
    depth = QUEUE_ARMED if stamps else QUEUE
    state = node.create_publisher(JointState, STATE, QoSProfile(depth=depth))
    control = node.create_publisher(JointState, CONTROL, QoSProfile(depth=depth))
    while not (
        state.get_subscription_count() and control.get_subscription_count() and {*awaited} <= {*node.get_node_names()}
    ):
        time.sleep(0.05)
    time.sleep(0.5)
    x, u = NamedVector([f"x{i}" for i in range(n)]), NamedVector([f"u{j}" for j in range(CONTROLS[n])])
    rows = [(row[:n].tobytes(), row[n:].tobytes()) for row in rows_of(n, left)]
    began, sent, instants = time.perf_counter(), 0, array("q")
    print("begins", flush=True)
    while (wait := began + sent / rate - time.perf_counter()) < seconds and sent < rate * seconds:
        if wait > 0:
            time.sleep(wait)
        elif wait < -0.05:
            began -= wait  # never a burst
        now = time.time_ns()
        position, command = rows[sent % 1000]
        control.publish(u(now, command))
        state.publish(x(now, position))
        sent += 1
        if stamps:
            instants.append(now)
    if stamps:
        np.save(stamps, np.array(instants))
    print(sent, flush=True)
    time.sleep(1.0)
    rclpy.shutdown()


def bare(executor: str, timed: bool = False) -> None:
    """The bare node: says how many messages came when a line comes in, or with a look at the clock their delays."""
    import rclpy
    from rclpy.qos import QoSProfile
    from sensor_msgs.msg import JointState

    rclpy.init()
    node, count, delays = rclpy.create_node("bare"), [0], list[int]()

    def nothing(_: JointState) -> None:
        count[0] += 1

    def note(message: JointState) -> None:  # its cost is not part of what costs are compared with
        stamp = message.header.stamp
        delays.append(time.time_ns() - stamp.sec * 10**9 - stamp.nanosec)

    node.create_subscription(JointState, STATE, note if timed else nothing, QoSProfile(depth=QUEUE))
    node.create_subscription(JointState, CONTROL, nothing, QoSProfile(depth=QUEUE))
    listen_for_end(lambda: {"delays": delays} if timed else {"received": count[0]}, node, executor)


def relay(n: int, names: list[str]) -> None:
    """Publishes what the monitor would, on each state message, without looking at it."""
    import rclpy
    from rclpy.duration import Duration
    from rclpy.qos import QoSProfile
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Bool

    from uncertain_lti.monitor.outputs import FALSE, NamedVector
    from uncertain_lti_ros.process import spare_the_middleware

    spare_the_middleware()  # as the monitor does
    rclpy.init()
    node = rclpy.create_node("envelope_monitor")
    vector, numbers, count = NamedVector([f"x{i}" for i in range(n)]), bytes(8 * n), [0]
    beat = QoSProfile(depth=QUEUE, deadline=Duration(seconds=1.0))
    kinds = {name: (Bool, beat) if name == "violation" else (JointState, QoSProfile(depth=QUEUE)) for name in names}
    publishers = {name: node.create_publisher(kind, f"~/{name}", qos) for name, (kind, qos) in kinds.items()}
    raw = {name: publisher.handle.publish_raw for name, publisher in publishers.items()}

    def pass_on(data: bytes) -> None:
        count[0] += 1
        stamp = int.from_bytes(data[4:8], "little") * 10**9 + int.from_bytes(data[8:12], "little")
        for name, publish in raw.items():
            publish(FALSE if name == "violation" else vector(stamp, numbers))

    def nothing(_: bytes) -> None:
        count[0] += 1

    node.create_subscription(JointState, STATE, pass_on, QoSProfile(depth=QUEUE), raw=True)
    node.create_subscription(JointState, CONTROL, nothing, QoSProfile(depth=QUEUE), raw=True)
    listen_for_end(lambda: {"received": count[0]}, node)


def hear(names: list[str]) -> None:
    """Subscribes to outputs of the monitor; those but the flags are received and dropped by the middleware."""
    import rclpy
    from rclpy.qos import QoSProfile
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Bool

    rclpy.init()
    node, idle = rclpy.create_node("hearer"), rclpy.create_node("idle_hearer")
    delays: list[int] = []

    def note(data: bytes) -> None:
        stamp = int.from_bytes(data[4:8], "little") * 10**9 + int.from_bytes(data[8:12], "little")
        delays.append(time.time_ns() - stamp)

    for name in names:
        topic = f"/envelope_monitor/{name}"
        if name == "flags":
            node.create_subscription(JointState, topic, note, QoSProfile(depth=5000), raw=True)
        else:
            kind = Bool if name == "violation" else JointState
            idle.create_subscription(kind, topic, lambda _: None, QoSProfile(depth=1))
    listen_for_end(lambda: {"delays": delays}, node)


def digest(file: str) -> None:
    """Subscribes to all outputs of the monitor, and keeps a checksum of each message that depends on verdicts alone."""
    import rclpy
    from rclpy.qos import QoSProfile
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Bool

    rclpy.init()
    node, idle = rclpy.create_node("hearer"), rclpy.create_node("idle_hearer")
    sums: dict[str, array[int]] = {}
    recorded = {output.name for output in RECORDED}
    for output in OUTPUTS:
        kind = Bool if output.name == "violation" else JointState
        topic = f"/envelope_monitor/{output.name}"
        if output.name in recorded and kind is JointState:
            found = sums[output.name] = array("L")

            def note(data: bytes, append: Any = found.append) -> None:
                append(zlib.crc32(data))

            node.create_subscription(kind, topic, note, QoSProfile(depth=QUEUE_ARMED), raw=True)
        else:
            idle.create_subscription(kind, topic, lambda _: None, QoSProfile(depth=1))

    def say() -> dict[str, Any]:
        np.savez(file, **{name: np.array(found, dtype=np.uint32) for name, found in sums.items()})
        return {"delays": sums["flags"].tolist()}

    listen_for_end(say, node)


def checked(model_path: Path, n: int, left: float, stamps: Any) -> dict[str, Any]:
    """The same checksums of a check of every sample sent, and how often the alarm was raised."""
    from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI
    from uncertain_lti.monitor.outputs import VerdictRecords
    from uncertain_lti.recordings.mcap_writer import MESSAGE_HEAD

    model = UncertainLTI.load(model_path)
    values = np.resize(rows_of(n, left), (len(stamps), n + CONTROLS[n]))
    transient = Transient(
        stamps, values[:, :n], values[:, n:], signals=model.signals, max_gap=model.signals.max_gap or math.inf
    )
    verdicts = EnvelopeMonitor(model).check(transient)
    vectors = [output for output in RECORDED if output.position]
    channels = {output.name: i for i, output in enumerate(vectors)}
    records = VerdictRecords(names_of(model.state_names, model.steps, verdicts.statistic_names), channels)
    sums: list[array[int]] = [array("L") for _ in vectors]
    names = {name for output in vectors for name in (output.position, output.velocity) if name}
    for begin in range(0, len(stamps), 5000):
        rows = slice(begin, begin + 5000)
        numbers = {name: getattr(verdicts, name)[rows] for name in names}
        t_ns = transient.t_ns[rows]
        data, _ = records.encode(t_ns, t_ns, verdicts.judged[rows], verdicts.alarm[rows], numbers)
        at, head = 0, MESSAGE_HEAD.size
        while at < len(data):
            length = int.from_bytes(data[at + 1 : at + 9], "little")
            channel = int.from_bytes(data[at + 9 : at + 11], "little")
            sums[channel].append(zlib.crc32(data[at + head : at + 9 + length]))
            at += 9 + length
    found = {output.name: np.array(each, dtype=np.uint32) for output, each in zip(vectors, sums, strict=True)}
    rises = np.count_nonzero(np.diff(verdicts.alarm.astype(np.int8), prepend=0) == 1)
    return {"sums": found, "alarms": int(rises), "verdicts": int(verdicts.judged.sum())}


def listen_for_end(say: Any, node: Any, executor: str = "events") -> None:
    """Spin a node until a line comes in, and print what there is to say."""
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.experimental import EventsExecutor
    from rclpy.task import Future

    spinner = EventsExecutor() if executor == "events" else SingleThreadedExecutor()
    spinner.add_node(node)
    never: Future = Future(executor=spinner)
    print("ready", flush=True)
    while not select.select([sys.stdin], [], [], 0)[0]:
        spinner.spin_until_future_complete(never, timeout_sec=0.1)  # as the monitor does
    print(json.dumps(say()), flush=True)


# --- the measurement ----------------------------------------------------------------------------------------


class Child:
    patient = False  # a publisher says nothing for as long as it publishes

    def __init__(self, env: dict[str, str], *command: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, *command], env=env, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL, text=True, start_new_session=True,
        )  # fmt: skip

    @property
    def cpu(self) -> float:
        """Processor time, s, of all its threads: its clock of clock_getcpuclockid(3), as Linux numbers it."""
        return time.clock_gettime(~self.process.pid << 3 | 2)

    @property
    def memory(self) -> float:
        """Resident memory of its own, MiB."""
        for line in Path(f"/proc/{self.process.pid}/smaps_rollup").read_text().splitlines():
            if line.startswith("Private_Dirty:"):
                return int(line.split()[1]) / 1024
        raise RuntimeError("no Private_Dirty")

    def line(self) -> str:
        """What it says next; raises where it has nothing to say for long, as when another part has died."""
        assert self.process.stdout is not None
        if not select.select([self.process.stdout], [], [], 900.0 if self.patient else 60.0)[0]:
            raise RuntimeError(f"{' '.join(map(str, self.process.args))} says nothing")  # type: ignore[arg-type]
        return self.process.stdout.readline().strip()

    def ask(self) -> dict[str, Any]:
        assert self.process.stdin is not None
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        said: dict[str, Any] = json.loads(self.line())
        return said

    def end(self) -> None:
        self.process.kill()
        self.process.wait()


TOPICS = [output.name for output in OUTPUTS]
PUBLISHED = [VIOLATION.name, *VerdictMessages(names_of(["x0"])).outputs]  # for each sample, of a model without horizons
SUBJECTS = {
    "bare, default executor": ("take", "default", []),
    "bare, events executor": ("take", "events", []),
    "publishing only, all outputs": ("relay", "", PUBLISHED),
    "publishing only, ~/violation": ("relay", "", ["violation"]),
    "monitor, all outputs heard": ("monitor", "", TOPICS),
    "monitor, ~/violation heard": ("monitor", "", ["violation"]),
}


def status(domain: int) -> dict[str, Any]:
    """What the monitor's ~/status says."""
    import rclpy
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor
    from std_srvs.srv import Trigger

    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = rclpy.create_node("asker", context=context)
    client = node.create_client(Trigger, "/envelope_monitor/status")
    spinner = SingleThreadedExecutor(context=context)
    assert client.wait_for_service(20.0), "the monitor does not answer"
    spinner.add_node(node)
    for _ in range(20):  # an answer is lost where the monitor does not know this client yet
        future = client.call_async(Trigger.Request())
        spinner.spin_until_future_complete(future, 1.0)
        if future.done():
            break
    said: dict[str, Any] = json.loads(future.result().message)
    node.destroy_node()
    context.try_shutdown()
    return said


class Run:
    """One subject, one rate, one size: the processes, and what was measured of them."""

    def __init__(self, n: int, rate: float, seconds: float, left: float = 0.0, domain: int = 0) -> None:
        self.n, self.rate, self.seconds, self.left = n, rate, seconds, left
        self.domain = domain or random.randint(1, 100)
        self.env = os.environ | {
            "ROS_DOMAIN_ID": str(self.domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        }  # fmt: skip
        self.children: list[Child] = []

    def child(self, *command: str) -> Child:
        self.children.append(Child(self.env, *command))
        return self.children[-1]

    def part(self, *arguments: str) -> Child:
        return self.child(__file__, "--part", *arguments)

    def monitor(self, folder: str, armed: bool = False) -> Child:
        path = Path(folder) / MODEL
        save_model(path, self.n, self.rate, armed)
        code = "import sys; from uncertain_lti_ros.envelope_monitor import main; sys.exit(main())"
        more = f"qos.depth:={QUEUE_ARMED}" if armed else "violations:=1"
        return self.child("-P", "-c", code, "--ros-args", "-p", f"model:={path}", "-p", more)

    def measure(self, kind: str, executor: str, outputs: list[str], delays: bool = False) -> dict[str, Any]:
        try:
            with tempfile.TemporaryDirectory() as folder:
                hearer = None
                if kind in ("monitor", "relay"):
                    relayed = kind == "relay"
                    subject = self.part(kind, str(self.n), *outputs) if relayed else self.monitor(folder)
                    hearer = self.part("hear", *outputs)
                    hearer.line()
                    if relayed:
                        subject.line()
                        time.sleep(2.0)  # until the hearer is known
                    else:
                        status(self.domain)
                else:
                    subject = self.part("delay" if delays else "take", executor)
                    subject.line()
                length = str(self.seconds + WARM_UP)
                awaited = ["hearer"] if hearer else []
                publisher = self.part("publish", str(self.n), str(self.rate), length, str(self.left), "", *awaited)
                publisher.line()
                time.sleep(WARM_UP)
                cpu, began = subject.cpu, time.perf_counter()
                time.sleep(self.seconds - 0.5)
                used, elapsed = subject.cpu - cpu, time.perf_counter() - began
                sent = int(publisher.line())
                time.sleep(0.5)
                per_sample = used / (sent / (self.seconds + WARM_UP) * elapsed) * 1e6
                found: dict[str, Any] = {"cpu": per_sample, "sent": sent}
                if kind == "monitor":
                    said = status(self.domain)
                    found |= {"verdicts": said["verdicts"], "lost": sum(said["lost"].values())}
                    found["missed"] = sent - 1 - said["verdicts"]
                    if hearer is not None and "flags" in outputs:
                        found["delays"] = hearer.ask()["delays"]
                        found["unheard"] = sent - len(found["delays"])
                elif delays:
                    found["delays"] = subject.ask()["delays"]
                else:
                    found["missed"] = 2 * sent - subject.ask()["received"]
                return found
        finally:
            for child in self.children:
                child.end()


BARE = "bare, default executor", "bare, events executor"
LIMITS = (
    ("monitor, all outputs heard", "bare, default executor", 0.6),
    ("monitor, all outputs heard", "bare, events executor", 1.5),
    ("monitor, ~/violation heard", "bare, events executor", 1.1),
)


def compare(rates: list[float], sizes: list[int], seconds: float, repeats: int, left: float) -> None:
    from uncertain_lti.base.text import Table

    rows, held = [], []
    for n in sizes:
        for rate in rates:
            runs: dict[str, list[dict[str, Any]]] = {name: [] for name in SUBJECTS}
            late: dict[str, list[float]] = {"bare, events executor": [], "monitor, all outputs heard": []}  # p99, ms
            for _ in range(repeats):
                for name, subject in SUBJECTS.items():
                    runs[name].append(Run(n, rate, seconds, left).measure(*subject))
                bare = Run(n, rate, seconds, left).measure("take", "events", [], delays=True)
                for name, found in zip(late, (bare, runs["monitor, all outputs heard"][-1]), strict=True):
                    settled = found["delays"][round(WARM_UP * rate) :]  # the first wait until both topics are heard
                    late[name].append(float(np.percentile(settled, 99)) / 1e6)
            cpu = {name: np.array([found["cpu"] for found in some]) for name, some in runs.items()}
            beside = {(name, peer): cpu[name] / cpu[peer] for name in cpu for peer in BARE}  # turn by turn
            for name, some in runs.items():
                rows.append(
                    [
                        f"{n}", f"{rate:g}", name, f"{np.median(cpu[name]):.0f}",
                        *(f"{np.median(beside[name, peer]):.2f}" for peer in BARE),
                        f"{np.median(late[name]):.2f}" if name in late else "",
                        str(max(found["missed"] for found in some)),
                        str(max(found["unheard"] for found in some)) if "unheard" in some[0] else "",
                    ]
                )  # fmt: skip
                print("  ".join(rows[-1]), file=sys.stderr, flush=True)
            for name, peer, limit in LIMITS:
                each = beside[name, peer]
                ratio = np.median(each)
                without = name.replace("monitor,", "publishing only,").removesuffix(" heard")
                held.append(
                    [
                        f"{n}", f"{rate:g}", f"{name} / {peer}", f"{limit:g}", f"{ratio:.2f}",
                        f"{each.min():.2f} to {each.max():.2f}", "yes" if ratio <= limit else "no",
                        f"{np.median(beside[without, peer]):.2f}",
                    ]
                )  # fmt: skip
            bare_late, monitor_late = (np.array(some) for some in late.values())
            beyond = monitor_late - bare_late
            held.append(
                [
                    f"{n}", f"{rate:g}", "p99 beyond the bare node, ms", "1", f"{np.median(beyond):.2f}",
                    f"{beyond.min():.2f} to {beyond.max():.2f}", "yes" if np.median(beyond) < 1 else "no", "",
                ]
            )  # fmt: skip
    head = "n|Hz||CPU, µs/sample|/ default|/ events|p99 delay, ms|not received|flags not heard".split("|")
    print(Table(head, rows, most=len(rows)))
    print()
    print(Table(["n", "Hz", "", "at most", "measured", "turns", "held", "publishing only"], held, most=len(held)))


def soak(seconds: float, rate: float, n: int, domain: int, armed: bool) -> dict[str, Any]:
    """Growth of memory after warm-up, MiB, and whether every counter accounts for every sample; prints both.

    armed: also whether what was published of each sample is what a check gives.
    """
    run = Run(n, rate, seconds, domain=domain)
    left = LEFT if armed else 0.0
    try:
        with tempfile.TemporaryDirectory() as folder:
            subject = run.monitor(folder, armed=armed)
            digests, stamps = Path(folder) / "digests.npz", Path(folder) / "stamps.npy"
            hearer = run.part("digest", str(digests)) if armed else run.part("hear", *TOPICS)
            hearer.line()
            deadline = time.monotonic() + 60.0  # a topic that is matched late is heard from its middle on
            heard = [output.name for output in OUTPUTS if output.position or output.name == "violation"]
            while not all(status(run.domain)["listeners"][name] for name in heard):
                assert time.monotonic() < deadline, "the monitor does not know who listens"
                time.sleep(0.2)
            keeps = str(stamps) if armed else ""
            publisher = run.part("publish", str(n), str(rate), str(seconds), str(left), keeps, "hearer")
            publisher.line()
            began, memory, cpu = time.perf_counter(), [], subject.cpu
            warm = min(60.0, seconds / 3)
            time.sleep(warm / 3)
            # Queues take their memory when something stands still for the first time, and never again: that is part
            # of the warm-up, whether or not this machine stalls a process by itself later.
            for child in (hearer, subject):
                child.process.send_signal(signal.SIGSTOP)
                time.sleep(0.6)
                child.process.send_signal(signal.SIGCONT)
                time.sleep(1.0)
            while (now := time.perf_counter() - began) < seconds - 1.0:
                time.sleep(min(10.0, seconds / 12))
                if now > warm:
                    memory.append(subject.memory)
                    print(f"{now:6.0f} s  {memory[-1]:.2f} MiB", file=sys.stderr, flush=True)
            publisher.patient = True
            sent = int(publisher.line())
            cpu = (subject.cpu - cpu) / sent * 1e6
            time.sleep(0.7)
            said = status(run.domain)
            counters = said["counters"]
            growth = memory[-1] - memory[0]
            accounted = {
                "state messages": said["received"][STATE],
                "control messages": said["received"][CONTROL],
                "samples": counters.get("samples", 0),
                "flags heard": len(hearer.ask()["delays"]),
                # the first sample has no verdict; a pause of the publisher over max_gap is a gap
                "verdicts + gaps + missing + first": said["verdicts"]
                + counters.get("gaps", 0)
                + counters.get("missing", 0)
                + 1,
            }
            exact = set(accounted.values()) == {sent} and not any(said["lost"].values())
            print(
                f"{sent} samples sent, {said['verdicts']} verdicts, {growth:+.2f} MiB from {memory[0]:.1f} MiB, "
                f"{cpu:.0f} µs of CPU per sample"
            )
            print(", ".join(f"{value} {name}" for name, value in accounted.items()))
            print(f"counters {'exact' if exact else 'not exact'}: {counters}, lost {said['lost']}")
            if armed:
                expected = checked(Path(folder) / MODEL, n, left, np.load(stamps))
                with np.load(digests) as heard:
                    same = {name: np.array_equal(heard[name], sums) for name, sums in expected["sums"].items()}
                    told = ", ".join(f"{len(heard[name])} ~/{name}" for name in same)
                unlike = [name for name in same if not same[name]]
                print(
                    f"{expected['verdicts']} verdicts of a check, {expected['alarms']} alarms; messages heard: {told}"
                )
                print(f"live is {'not ' if unlike else ''}offline{f' in {unlike}' if unlike else ''}")
                exact &= not unlike and expected["verdicts"] == said["verdicts"]
            return {"exact": exact, "growth": growth, "verdicts": said["verdicts"], "sent": sent}
    finally:
        for child in run.children:
            child.end()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=6.0, help="length of one run")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--rates", type=float, nargs="+", default=[500.0, 1000.0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[5, 50], choices=list(CONTROLS))
    parser.add_argument("--left", type=float, default=0.0, metavar="SHARE", help="of samples out of bounds")
    parser.add_argument("--soak", type=float, metavar="S", help="instead, run the monitor for S seconds at 1 kHz")
    parser.add_argument(
        "--armed", action="store_true", help="with --soak: schedule, horizons, statistics; live = offline"
    )
    parser.add_argument("--domain", type=int, default=0, metavar="N", help="ROS domain of --soak; 0: any")
    parser.add_argument("--soak-rate", type=float, default=1000.0, metavar="HZ")
    parser.add_argument("--part", nargs="+", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.part:
        kind, *rest = args.part
        if kind == "publish":
            publish(int(rest[0]), *map(float, rest[1:4]), rest[4], rest[5:])
        elif kind == "hear":
            hear(rest)
        elif kind == "digest":
            digest(rest[0])
        elif kind == "relay":
            relay(int(rest[0]), rest[1:])
        else:
            bare(rest[0], timed=kind == "delay")
    elif args.soak:
        found = soak(args.soak, args.soak_rate, args.sizes[0], args.domain, args.armed)
        if not (found["exact"] and found["growth"] < 1.0):
            raise SystemExit(1)
    else:
        compare(args.rates, args.sizes, args.seconds, args.repeats, args.left)


if __name__ == "__main__":
    main()
