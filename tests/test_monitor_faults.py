# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What befalls a monitor on a robot, with real publishers in other processes: it survives, tells, and never lies."""

import random
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bag_writer import Message, Topic, joint_state, vector, write
from conftest import ROOT
from perturbed import CONTROL, EPOCH_NS, JOINT_STATE, STATE, STEP_NS, VECTOR

from uncertain_lti import UncertainLTI
from uncertain_lti.base.errors import ModelError
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.monitor.intake import Sender
from uncertain_lti.monitor.outputs import TRUE, names_of
from uncertain_lti.monitor.verdict import Verdict

pytest.importorskip("rclpy", reason="rclpy is not installed")

import test_node_stream as stream_cases
from geometry_msgs.msg import TwistStamped
from processes import own_domain
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from ros_processes import OK, STALE, WARN, Diagnostics, World, until
from ros_processes import world as world
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, UInt8
from test_live import Outputs, Plant, StartBench, by_hand, offline, run_of, saved, stamp_of, trigger
from test_live import bench as bench
from test_node_stream import ros as ros

NODE = "/envelope_monitor"


def stamped(message: Any, t_ns: int) -> Any:
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(t_ns, 10**9)
    return message


def ever(diagnostics: Diagnostics, level: int, saying: str) -> bool:
    """Whether the monitor's status was ever of this level and message."""
    statuses = [array.status[0] for array in diagnostics.topic.messages if array.status]
    return any(s.level == bytes([level]) and saying in s.message for s in statuses)


# --- clocks, disorder and bad messages ----------------------------------------------------------------------


def orderly_bag(model: UncertainLTI, path: Path, steps: int) -> Path:
    """Every control just before the state of the same stamp, so that a monitor may begin anywhere."""
    x, u = run_of(model, steps, 9)
    messages = []
    for k in range(steps):
        t = EPOCH_NS + k * STEP_NS
        messages += [Message(CONTROL, t, vector(t, *u[k])), Message(STATE, t + 3_000_000, joint_state(t, x[k]))]
    return write([Topic(STATE, JOINT_STATE), Topic(CONTROL, VECTOR)], messages).save(path)


def test_stamps_from_the_future_are_counted_and_told(bench: StartBench) -> None:
    on = bench()
    on.plant.send(5)
    assert on.world.status()["future"] == {}
    on.plant.t_ns = time.time_ns() + 3600 * 10**9
    on.plant.send(3)
    until(lambda: ever(on.diagnostics, WARN, "lie over 1 s in the future"), "a warning")
    assert on.world.status()["future"] == {STATE: 3, CONTROL: 3}
    on.plant.t_ns = EPOCH_NS
    on.plant.send(3)
    wanted = [True, *[False] * 4, True, False, False, True, False, False]
    np.testing.assert_array_equal(np.isnan(on.flagged(11)), wanted)


def test_mutated_messages_do_no_harm(bench: StartBench) -> None:
    """Seeded damage to serialised messages, sent as they are; between them sound ones are judged as ever."""
    on = bench(largest_message=0.25, catch_up=0.0)  # nothing waits for a control, which comes last here
    world, plant = on.world, on.plant
    rng = random.Random(11)
    sound = [
        serialize_message(stamped(JointState(name=["a", "b"], position=[0.3, 0.3]), EPOCH_NS)),
        serialize_message(stamped(JointState(name=["b", "a"], position=[0.3, 0.3], effort=[1.0] * 9), EPOCH_NS)),
    ]
    for _ in range(400):
        plant.state.publish(mutated(rng, rng.choice(sound)))
        time.sleep(0.002)
    until(lambda: world.status()["received"].get(STATE) == 400, "all of them")
    assert sum(world.status()["unreadable"].values()) > 50
    until(lambda: ever(on.diagnostics, STALE, f"{STATE}: a message is cut"), "a word on them")
    plant.state.publish(JointState(name=["a", "b"], position=[0.0] * 100_000))
    until(lambda: world.status()["received"].get(STATE) == 401, "the huge one")
    until(lambda: ever(on.diagnostics, STALE, "more than parameter largest_message allows"), "a word on it")
    plant.t_ns = EPOCH_NS + 10**12  # later than whatever stamp got through, or a step back: a new segment either way
    heard = len(on.flags.messages)
    plant.send(6)
    plant.send(1, off=2.0)
    plant.send(1)
    assert on.flagged(heard + 8)[-7:] == [0, 0, 0, 0, 0, 0, 1]
    assert on.process.running and world.status()["unexpected_errors"] == 0 and "Traceback" not in on.process.output


def mutated(rng: random.Random, data: bytes) -> bytes:
    """A few bytes changed, lengths made to lie, or the end cut off or repeated."""
    body = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        kind = rng.random()
        if kind < 0.4:
            body[rng.randrange(len(body))] = rng.randrange(256)
        elif kind < 0.7:
            at = rng.randrange(4, max(5, len(body) - 4)) & ~3
            body[at : at + 4] = rng.choice([b"\xff" * 4, bytes(4), b"\xff\xff\xff\x7f", b"\x03\0\0\0"])
        elif kind < 0.9:
            del body[rng.randrange(4, len(body)) :]
        else:
            body += body[rng.randrange(len(body)) :]
        if len(body) < 5:
            break
    return bytes(body)


def test_missed_deadlines_are_told(world: World, tmp_path: Path) -> None:
    model = by_hand()
    plant = Plant(world, model)
    world.node.destroy_publisher(plant.state)
    plant.state = world.publisher(JointState, STATE, QoSProfile(depth=100, deadline=Duration(seconds=0.2)))
    world.monitor(saved(model, tmp_path), diagnostics_period=0.1)
    diagnostics = world.diagnostics()
    plant.subscribed().send(5)
    status = diagnostics.reaches(WARN, saying=f"{STATE}: ")
    assert "deadlines missed by its publishers" in status.message


# --- processes that are killed ------------------------------------------------------------------------------


def test_a_monitor_that_is_killed_is_missed_and_resumes_without_a_wrong_verdict(world: World, tmp_path: Path) -> None:
    model = by_hand()
    path = saved(model, tmp_path)
    bag = orderly_bag(model, tmp_path / "run.mcap", 3000)  # two minutes, of which some seconds are played
    expected: dict[int, Verdict] = {v.t_ns: v for v in offline(path, bag) if v.judged}
    missed: list[Any] = []
    promised = QoSProfile(depth=5000, deadline=Duration(seconds=0.4))
    process = world.monitor(path, heartbeat=0.4)
    events = SubscriptionEventCallbacks(deadline=missed.append)
    violation = world.listen(Bool, f"{NODE}/violation", promised, event_callbacks=events).connected()
    flags = world.listen(JointState, f"{NODE}/flags").connected()
    player = world.command("play", bag, "--rate", "0.25")
    flags.count(100)
    process.kill()
    before = len(missed)
    until(lambda: len(missed) > before, "the missed deadline")
    heard = len(flags.messages)
    world.run_node("envelope_monitor", {"model": str(path), "heartbeat": 0.4})
    until(lambda: len(flags.messages) > heard + 25 or not player.running, "the second monitor")
    assert player.running, "the recording ended too soon for this test"
    player.kill()
    status = world.status()
    assert status["verdicts"] < status["received"][STATE], "the first sample after a start has nothing to be judged by"
    for message in flags.messages:
        if not np.isnan(message.position[0]):
            np.testing.assert_array_equal(message.position, expected[stamp_of(message)].flags)
    unjudged = np.isnan([message.position[0] for message in flags.messages])
    starts = np.flatnonzero(np.diff(unjudged, prepend=False) & unjudged)
    assert starts[0] == 0 and len(starts) <= 2, "only what comes first after a start"
    assert violation.messages


def test_errors_that_nobody_foresaw_are_counted_told_and_outlived(world: World, tmp_path: Path) -> None:
    """The judging and the reporting are made to fail now and then, and a timer fails past every guard."""
    model = by_hand()
    code = """
import sys
from uncertain_lti.monitor import deployed
from uncertain_lti_ros import envelope_monitor
report, count = envelope_monitor.EnvelopeMonitorNode.report, [0, 0]
class Judging(deployed.EnvelopeMonitor):
    def judge(self, *args, **named):
        count[0] += 1
        if count[0] % 10 == 0:
            raise ZeroDivisionError("every tenth")
        return super().judge(*args, **named)
def reporting(node):
    count[1] += 1
    if count[1] == 5:
        node.create_timer(0.3, lambda: 1 / 0)
    if count[1] % 7 == 0:
        raise KeyError("every seventh")
    return report(node)
deployed.EnvelopeMonitor = Judging
envelope_monitor.EnvelopeMonitorNode.report = reporting
sys.exit(envelope_monitor.main())
"""
    process = world.monitor(saved(model, tmp_path), code=code, diagnostics_period=0.1)
    diagnostics = world.diagnostics()
    flags = world.listen(JointState, f"{NODE}/flags").connected()
    plant = Plant(world, model).subscribed()
    plant.send(40)
    got = [m.position[0] for m in flags.count(36)]
    assert np.isnan(got).sum() == 4  # the first, and the first after each that was lost; nothing was called contained
    assert not any(value == 1.0 for value in got)
    status = diagnostics.reaches(STALE, saying="unexpected errors, the last")
    until(lambda: world.status()["unexpected_errors"] > 10, "errors of the timer")
    assert int(Diagnostics.values(status)["unexpected errors"]) >= 4
    assert "ZeroDivisionError: every tenth" in process.output
    assert process.output.count("Traceback") < 6, "a log must not be flooded"
    assert process.running


@pytest.mark.slow
def test_memory_stays_flat_and_every_sample_is_accounted_for() -> None:
    """`benchmarks/live_monitor.py --soak 600 --armed` in short, slowly enough for a machine that is busy."""
    soak = ("--soak", "10", "--soak-rate", "150", "--armed")
    command = [sys.executable, str(ROOT / "benchmarks" / "live_monitor.py"), *soak]
    with own_domain() as domain:
        command += ["--domain", str(domain)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0 and "counters exact" in done.stdout, done.stdout + done.stderr
    assert "live is offline" in done.stdout and ", 0 alarms" not in done.stdout


@pytest.mark.slow
def test_streams_whose_control_stamps_lag_are_judged_as_offline() -> None:
    """`benchmarks/lags.py` in short."""
    command = [sys.executable, str(ROOT / "benchmarks" / "lags.py"), "--streams", "1", "--steps", "100", "--lags", "2"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1200)
    said = done.stdout.splitlines()
    assert done.returncode == 0 and "compared statistics" in said[-1], done.stdout + done.stderr
    assert not any(line.startswith("seed ") for line in said), "verdicts differ, or are withheld"


# --- the alarm ----------------------------------------------------------------------------------------------


def test_an_enable_condition_on_a_field_of_any_topic(bench: StartBench) -> None:
    on = bench(enable="/machine/mode data == 3", state_timeout=60.0)
    world, diagnostics, plant = on.world, on.diagnostics, on.plant
    violation = world.listen(Bool, f"{NODE}/violation").connected()
    plant.send(5, off=2.0)
    assert on.flagged(5, since=2) == [1, 1, 1]
    diagnostics.reaches(WARN, saying="alarms are off: it is not known whether /machine/mode data == 3")
    assert world.status()["armed"] is None
    lasting = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    mode = world.publisher(UInt8, "/machine/mode", lasting)  # its type is found in the graph
    mode.publish(UInt8(data=1))
    until(lambda: world.status()["armed"] is False, "the mode")
    plant.send(5, off=2.0)
    on.flags.count(10)
    diagnostics.reaches(WARN, name="envelope_monitor: a", saying="outside its bounds")
    assert not any(m.data for m in violation.messages)
    mode.publish(UInt8(data=3))
    until(lambda: world.status()["armed"], "the mode")
    plant.send(3, off=2.0)
    until(lambda: violation.messages[-1].data, "the alarm")
    said = world.status()
    assert said["why"].startswith("alarm: at least 1 of 1 verdicts violated: a") and said["looks_like"] == ""
    mode.publish(UInt8(data=0))
    until(lambda: not world.status()["alarm"], "the alarm to end with the machine off")
    plant.send(3, off=2.0)
    assert world.status()["armed"] is False
    for wrong in ("/machine/mode", "data == 3", "/m data = 3", "/m data == three", "/m __import__('os') == 3"):
        accepted, reason = world.set(enable=wrong)
        assert not accepted and "write TOPIC FIELD OPERATOR NUMBER" in reason
    accepted, reason = world.set(enable=f"{STATE} positions[0] > 1")
    assert not accepted and "there is no 'positions'" in reason
    assert world.set(enable=f"{STATE} position[a] > -1e9") == (True, "")  # a topic that the model reads itself
    plant.send(3, off=2.0)
    until(lambda: violation.messages[-1].data, "the alarm")
    assert world.set(enable="") == (True, "") and world.status()["armed"] is True


class Sends:
    """A node whose publishers take processor time, and time besides, as a clock made by hand has it."""

    def __init__(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now, self.used = 100.0, 0.0
        self.sending = dict.fromkeys(("flags", "lower", "violation"), (5e-6, 5e-6))  # processor time and time, s
        its_module = sys.modules[Sender.__module__]
        moved = {"monotonic": lambda: self.now, "thread_time": lambda: self.used}
        clock = SimpleNamespace(**moved, time_ns=time.time_ns, sleep=time.sleep)
        monkeypatch.setattr(its_module, "time", clock)
        self.model = by_hand(alarm_rule=AlarmRule(3, 20))
        self.node = stream_cases.Node(saved(self.model, tmp_path))
        self.sender = self.node.outputs.sender
        self.sent: Counter[str] = Counter()
        self.alarms = [False]
        for name, output in self.node.outputs.publishers.items():
            output.send = self._sends(name)
        self.sender.changed()

    def _sends(self, name: str) -> Any:
        def send(data: bytes) -> None:
            used, took = self.sending.get(name, (5e-6, 5e-6))
            self.used, self.now = self.used + used, self.now + took
            self.sent[name] += 1
            if name == "violation":
                self.alarms.append(data == TRUE)

        return send

    def run(self, samples: int, step: float = 5e-4) -> int:
        """Verdicts on so many samples; each change of the alarm is published at once."""
        for message in stream_cases.stream(self.model, samples):
            self.now += step
            self.node.arrive(*message)
            assert self.alarms[-1] == self.node.session.alarm
        return int(self.node.session.verdicts)


@pytest.fixture
def sends(ros: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Sends]:
    sends = Sends(tmp_path, monkeypatch)
    yield sends
    stream_cases.end([sends.node])


def test_a_subscriber_that_stands_still_costs_outputs_and_no_verdict(sends: Sends) -> None:
    """Each message takes 1 ms of the processor, as with a stopped process; later it takes 5 µs again."""
    names = list(sends.node.outputs.publishers)
    sends.sending, began = dict.fromkeys(names, (1e-3, 1e-3)), sends.now
    verdicts = sends.run(4000)
    assert sends.sent["lower"] < 0.1 * verdicts, "most messages are held back"
    assert sends.used < 0.6 * (sends.now - began), "what is left of the time is for the inputs"
    assert len(sends.sender.problems) == 1 and "~/lower" in sends.sender.problems[0]
    sends.now += 1.1
    assert not sends.sender.problems, "nothing is sent any more"
    sends.sending, before, held = {}, sends.sent.copy(), sends.sender.held_back
    again = sends.run(4000) - verdicts
    assert sends.sent["lower"] - before["lower"] >= again > 1000 and sends.sender.held_back == held, "all of them again"
    sends.sending = dict.fromkeys(names, (1e-3, 1e-3))
    sends.run(1000)
    assert sends.sender.problems
    for output in sends.node.outputs.publishers.values():
        output.listeners = 0
    sends.sender.changed()
    assert not sends.sender.problems, "nobody listens that could stand still"


def test_a_stopped_reader_of_one_output_costs_the_readers_of_others_nothing(sends: Sends) -> None:
    sends.sending["lower"] = (1e-3, 1e-3)
    verdicts = sends.run(4000)
    assert sends.sent["upper"] == verdicts > 1000 > sends.sent["lower"]
    assert sends.sent["flags"] >= verdicts and "~/lower stands still" in sends.sender.problems[0]


def test_a_busy_processor_is_no_reader_that_stands_still(sends: Sends) -> None:
    """Sending takes 2 ms as others have the processor, and 20 µs of it, or of flags, whose way is cold, 0.28 ms."""
    sends.sending = dict.fromkeys(sends.node.outputs.publishers, (2e-5, 2e-3)) | {"flags": (2.8e-4, 2e-3)}
    verdicts = sends.run(2000)
    assert sends.sent["violation"] >= sends.sent["lower"] == verdicts > 500 and sends.sent["flags"] >= verdicts
    assert sends.sender.held_back == 0 and not sends.sender.problems


_LISTENS = """
import rclpy
from sensor_msgs.msg import JointState
rclpy.init()
node = rclpy.create_node("stalls")
for name in ("lower", "upper", "state", "utilisation"):
    node.create_subscription(JointState, f"/envelope_monitor/{name}", lambda message: None, 100)
print("listens", flush=True)
rclpy.spin(node)
"""


def test_every_flag_arrives_beside_a_process_that_is_stopped(bench: StartBench) -> None:
    on = bench(diagnostics_period=1.0)
    world, flags, plant = on.world, on.flags, on.plant
    stalls = world.start("stalls", "-c", _LISTENS)
    stalls.says("listens")
    until(lambda: world.status()["listeners"]["lower"] == 1, "the reader")
    plant.send(60)
    flags.count(60)
    stalls.signal(signal.SIGSTOP)
    plant.send(400)
    flags.count(460)
    stalls.kill()
    assert "held_back" in world.status(), "how many, if any, depends on the middleware"


def test_a_control_that_is_sent_once_and_a_latched_alarm_outlive_a_reload(bench: StartBench) -> None:
    mode_type = {"enable": "/machine/mode data == 3", "enable_type": "std_msgs/msg/UInt8"}
    on = bench(by_hand(max_hold=None, alarm_rule=AlarmRule(2, 3)), latch=True, **mode_type)
    world, plant = on.world, on.plant
    violation = world.listen(Bool, f"{NODE}/violation").connected()
    mode = world.publisher(UInt8, "/machine/mode", QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    mode.publish(UInt8(data=3))
    until(lambda: world.status()["armed"], "the mode")
    plant.send(30)
    plant.control.publish = lambda _: None  # type: ignore[method-assign]
    plant.send(3, off=2.0)
    plant.send(5)
    on.flags.count(38)
    until(lambda: violation.messages[-1].data, "the alarm")
    assert trigger(world, "reload")[0]
    plant.send(5)
    assert on.flagged(43, since=39) == [0, 0, 0, 0]
    assert world.set(margin=1.5) == (True, "") and world.status()["alarm"]
    assert world.set(enable="/machine/mode data >= 3") == (True, "") and world.status()["armed"] is True
    assert world.set(enable="/machine/mode data > 3") == (True, "") and world.status()["armed"] is False
    plant.send(5)
    assert on.flagged(48, since=44) == [0, 0, 0, 0]
    assert violation.messages[-1].data and world.status()["latched"]
    assert trigger(world, "reset") == (True, "the alarm is reset") and not world.status()["alarm"]
    on.process.says("the alarm is over after")
    assert re.search(r"\[WARN\].*: alarm", on.process.output)
    assert re.search(r"\[INFO\].*the alarm is over after .*, by ~/reset", on.process.output)
    assert trigger(world, "reset") == (True, "there was no alarm; its window is empty now")


# --- snapshots ----------------------------------------------------------------------------------------------


def test_snapshots_hold_what_came_and_what_was_said(world: World, tmp_path: Path) -> None:
    from mcap.reader import make_reader

    folder = tmp_path / "snapshots"
    folder.mkdir()
    keep = folder / "of someone else.mcap"
    keep.write_bytes(b"mine")
    model = by_hand(alarm_rule=AlarmRule(2, 3))
    path = saved(model, tmp_path)
    options: dict[str, Any] = {"snapshot.folder": str(folder), "snapshot.keep": 2, "snapshot.seconds": 30.0}
    world.monitor(path, **options)
    outputs = Outputs.of(world)
    assert trigger(world, "snapshot") == (False, "there is nothing to write: no message has come")
    plant = Plant(world, model).subscribed()
    plant.send(30)
    plant.send(3, off=2.0)
    plant.send(7)
    flags = outputs.topics["flags"].count(40)
    success, said = trigger(world, "snapshot")
    assert success, said
    (found,) = until(lambda: [p for p in folder.glob("*.mcap") if p != keep], "the file")
    assert found.name.startswith("envelope_monitor-") and str(found) in said

    with open(found, "rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        by_topic: dict[str, list[bytes]] = {}
        times = []
        for _, channel, message in reader.iter_messages():
            by_topic.setdefault(channel.topic, []).append(message.data)
            times.append(message.log_time)
        assert times == sorted(times) and summary.statistics.message_count == len(times)
        (notes,) = list(reader.iter_metadata())
        assert notes.metadata["model"] == str(path)
    assert [len(by_topic[t]) for t in (STATE, CONTROL, f"{NODE}/flags", f"{NODE}/lower")] == [40, 40, 40, 39]
    for name in ("flags", "lower", "upper", "state", "utilisation"):
        there = [deserialize_message(data, JointState) for data in by_topic[f"{NODE}/{name}"]]
        for a, b in zip(there, outputs.topics[name].count(len(there)), strict=True):
            np.testing.assert_array_equal(a.position, b.position)
            np.testing.assert_array_equal(a.velocity, b.velocity)
            assert stamp_of(a) == stamp_of(b) and list(a.name) == list(b.name)
    assert by_topic[f"{NODE}/violation"].count(TRUE) == 3
    # what came in is there as it came, so the offline check can be repeated on it
    np.testing.assert_array_equal([v.flags for v in offline(path, found)], [m.position for m in flags])

    for _ in range(3):
        until(lambda: trigger(world, "snapshot")[0], "another")
    until(lambda: len([p for p in folder.iterdir() if p != keep and p.suffix == ".mcap"]) == 2, "two files")
    assert keep.read_bytes() == b"mine" and not found.exists() and len(list(tmp_path.glob("*.mcap"))) == 0


def snapping(folder: Path) -> dict[str, Any]:
    """Parameters of a node that takes a snapshot soon after an alarm."""
    return {"snapshot.on_alarm": True, "snapshot.after": 0.1, "snapshot.folder": str(folder)}


def test_what_still_waits_at_the_end_is_judged(bench: StartBench) -> None:
    """A topic that was never heard has messages wait: here for ten seconds, had the monitor not been told to end."""
    on = bench(catch_up=10.0)
    on.plant.control.publish = lambda _: None  # type: ignore[method-assign]
    on.plant.send(20)
    until(lambda: on.world.status()["received"][STATE] == 20, "20 samples")
    assert not on.flags.messages
    on.process.signal(signal.SIGINT)
    on.process.succeed()
    assert len(on.flags.count(20)) == 20


def test_a_snapshot_holds_what_was_in_force_and_a_flapping_alarm_takes_one(bench: StartBench, tmp_path: Path) -> None:
    folder = tmp_path / "snapshots"
    on = bench(by_hand(max_hold=None), **snapping(folder), **{"snapshot.seconds": 1.0})
    plant = on.plant
    plant.send(20)
    plant.control.publish = lambda _: None  # type: ignore[method-assign]
    plant.send(300)
    for _ in range(8):
        plant.send(1, off=2.0)
        plant.send(3)
    on.flags.count(320 + 8 * 4)
    (found,) = until(lambda: list(folder.glob("*.mcap")), "the file")
    verdicts = offline(on.path, found)
    assert len(verdicts) < 300 and sum(not v.judged for v in verdicts) == 1 and any(v.violated for v in verdicts)
    assert on.world.status()["snapshot"] == str(found), "one file as long as the alarm keeps coming back"
    time.sleep(1.2)
    plant.send(3, off=2.0)
    until(lambda: len(list(folder.glob("*.mcap"))) == 2, "another after a while without")
    assert trigger(on.world, "reload")[0]
    plant.send(5)
    on.flags.count(320 + 8 * 4 + 8)
    assert trigger(on.world, "snapshot")[0]
    *_, found = until(lambda: len(files := sorted(folder.glob("*.mcap"))) == 3 and files, "one of the model read again")
    assert [v.judged for v in offline(on.path, found)] == [False, *[True] * 4], "the control of before counts on"


def test_a_model_that_is_swapped_costs_no_snapshot_of_an_alarm(bench: StartBench, tmp_path: Path) -> None:
    """It was written later, without the messages around the alarm."""
    folder = tmp_path / "snapshots"
    on = bench(**snapping(folder) | {"snapshot.after": 3600.0})
    on.plant.send(20)
    on.plant.send(3, off=2.0)
    on.flags.count(23)
    assert on.world.set(model=str(on.path)) == (True, "")
    (found,) = until(lambda: list(folder.glob("*.mcap")), "the file")
    verdicts = offline(on.path, found)
    assert len(verdicts) == 23 and any(v.violated for v in verdicts)


def test_a_folder_of_snapshots_that_was_cleared_away_is_made_again(bench: StartBench, tmp_path: Path) -> None:
    folder = tmp_path / "of" / "snapshots"
    on = bench(**{"snapshot.folder": str(folder)})
    on.plant.send(20)
    on.flags.count(20)
    folder.rmdir()
    folder.parent.rmdir()
    success, said = trigger(on.world, "snapshot")
    assert success, said
    until(lambda: len(list(folder.glob("*.mcap"))) == 1, "the snapshot")


def test_a_snapshot_of_an_alarm_that_cannot_be_written_is_logged(bench: StartBench, tmp_path: Path) -> None:
    """The log said that it is written, and nothing else."""
    folder = tmp_path / "snapshots"
    on = bench(**snapping(folder))
    on.plant.send(20)
    on.flags.count(20)
    folder.rmdir()
    folder.write_text("no folder any more")
    on.plant.send(3, off=2.0)
    on.process.says(f"snapshot {folder}/envelope_monitor-")
    on.process.says(".mcap: not written: Not a directory; make room or choose another snapshot.folder")


def test_without_a_folder_there_are_no_snapshots(bench: StartBench, tmp_path: Path) -> None:
    said = (
        "parameter snapshot.on_alarm is true, and snapshot.folder is empty; set the one to false, or start the node "
        "with the other"
    )
    on = bench()
    success, reason = trigger(on.world, "snapshot")
    assert not success and "snapshot.folder is empty" in reason
    assert not on.world.set(**{"snapshot.folder": str(tmp_path)})[0]
    assert on.world.set(**{"snapshot.on_alarm": True}) == (False, said)
    (tmp_path / "file").write_text("")
    for name, options, why in (
        ("second", {"snapshot.folder": str(tmp_path / "file")}, "cannot be written to"),
        ("homeless", {"snapshot.folder": "~no-such-user/a"}, "cannot be written to: it is in the home of nobody here"),
        ("third", {"snapshot.on_alarm": True}, f"not configured: {said}"),
    ):
        process = on.world.run_node("envelope_monitor", {"model": str(on.path), **options}, "-r", f"__node:={name}")
        process.says(why)
        assert on.world.state(f"/{name}") == "unconfigured"


def test_snapshots_stay_within_their_folder_and_their_megabytes(tmp_path: Path) -> None:
    from uncertain_lti.monitor.snapshot import Album, Entry, Scene
    from uncertain_lti_ros.topics import definition

    folder = tmp_path / "album"
    rng = np.random.default_rng(3)

    def scene(size: int) -> Scene:
        entries = [Entry(0.0, k, "/t", rng.bytes(size // 10), (), False) for k in range(10)]
        return Scene(
            entries, names_of(["a"]), {"/t": "std_msgs/msg/UInt8"},
            {"flags": "/n/flags", "violation": "/n/violation"}, {}, definition,
        )  # fmt: skip

    limit = 100_000
    album = Album(str(folder), "/rig/../../../etc/monitor", keep=100, limit=limit)
    (folder / "foreign-20240101T000000.000000Z.mcap").write_bytes(bytes(2 * limit))
    outside = tmp_path / "outside.mcap"
    outside.write_bytes(b"of someone else")
    written = []
    for _ in range(8):
        said = album.take(scene(30_000), patience=300.0)
        written.append(Path(said.removeprefix("wrote ")))
        assert written[-1].parent == folder and written[-1].is_file()
        mine = [p for p in folder.iterdir() if not p.name.startswith("foreign")]
        assert sum(p.stat().st_size for p in mine) <= limit
        assert sorted(p.name for p in mine) == [p.name for p in written[-len(mine) :]], "the oldest go first"
    assert len(mine) == 3 and len(list(folder.iterdir())) == 4
    for size in (70_000, 5_000, 5_000, 30_000):  # as much goes as there must be room
        written.append(Path(album.take(scene(size), patience=300.0).removeprefix("wrote ")))
    assert [path.is_file() for path in written[-4:]] == [False, True, True, True]
    # a link that bears the name of a snapshot leads elsewhere, and is left alone
    (folder / written[0].name).symlink_to(outside)
    with pytest.raises(ModelError, match=r"more than snapshot.megabytes allows"):
        album.take(scene(150_000), patience=300.0)
    album.take(scene(30_000), patience=300.0)
    assert outside.read_bytes() == b"of someone else" and (folder / written[0].name).is_symlink()
    assert not list(tmp_path.rglob("*.tmp"))


_LEAVES = """
import time, rclpy
from std_msgs.msg import Int32
rclpy.init()
node = rclpy.create_node("leaves")
publisher = node.create_publisher(Int32, "/machine/mode", 1)
print("publishes", flush=True)
while not publisher.get_subscription_count():
    time.sleep(0.05)
node.destroy_node()
rclpy.shutdown()
"""


def test_the_type_of_the_enable_topic_follows_its_publishers_and_their_absence_is_told(world, tmp_path):
    model = by_hand()
    process = world.monitor(saved(model, tmp_path), diagnostics_period=0.1)
    diagnostics = world.diagnostics()
    first = world.start("first", "-c", _LEAVES)
    first.says("publishes")
    assert world.set(enable="/machine/mode data == 3")[0]
    first.succeed()
    mode = world.publisher(UInt8, "/machine/mode", QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    mode.publish(UInt8(data=3))
    until(lambda: world.status()["armed"], "the mode of another type", patience=30.0)
    before = diagnostics.count
    nobody = "nobody publishes /machine/mod, which parameter enable names"
    assert world.set(enable="/machine/mod data == 3") == (True, nobody)
    diagnostics.reaches(STALE, saying=nobody, since=before)
    process.says("nobody publishes /machine/mod,")
    assert world.set(enable="/machine/mod data == 3", enable_type="std_msgs/msg/UInt8") == (True, nobody)
    Plant(world, model).subscribed().send(3)
    until(lambda: world.status()["received"][STATE] == 3, "the samples")
    accepted = world.set(enable=f"{STATE} position[c] > 0", enable_type="")
    there = "there is no 'c' in the message's names; names there: a, b"
    assert accepted == (True, f"parameter enable: {STATE} comes without a number in position[c]: {there}")
    assert world.set(enable=f"{STATE} position[b] > -9") == (True, "")
    path = str(saved(model, tmp_path))
    assert world.set(model=path, enable="/machine/mod data == 3") == (True, nobody)
    assert world.set(model=path, enable="") == (True, "")


def test_the_type_of_a_topic_may_change_while_the_node_runs(world: World, tmp_path: Path) -> None:
    """Of the enable condition as the user corrects it, and of a control with the next model."""
    model = by_hand()
    world.monitor(saved(model, tmp_path))
    mode = world.publisher(UInt8, "/machine/mode", QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    mode.publish(UInt8(data=3))

    def types_heard() -> list[str]:
        return [info.topic_type for info in world.node.get_subscriptions_info_by_topic("/machine/mode")]

    for name in ("Int32", "UInt8"):
        assert world.set(enable="/machine/mode data == 3", enable_type=f"std_msgs/msg/{name}") == (True, "")
        until(lambda name=name: types_heard() == [f"std_msgs/msg/{name}"], "its type")
    until(lambda: world.status()["armed"], "the mode")
    fields = zip(model.signals.controls, ("twist.linear.x", "twist.linear.y"), strict=True)
    controls = tuple(replace(signal, type="geometry_msgs/msg/TwistStamped", field=field) for signal, field in fields)
    other = saved(model.replace(signals=replace(model.signals, controls=controls)), tmp_path, "other")
    assert world.set(model=str(other))[0]
    control = world.publisher(TwistStamped, CONTROL)
    world.subscribed(control)
    control.publish(TwistStamped())
    until(lambda: world.status()["received"].get(CONTROL) == 1, "a control of the other type")
    assert world.status()["unexpected_errors"] == 0


def test_a_second_node_of_the_same_name_is_told(world: World, tmp_path: Path) -> None:
    model = saved(by_hand(), tmp_path)
    for process in (world.monitor(model), world.run_node("envelope_monitor", {"model": str(model)})):
        process.says("another node publishes /envelope_monitor/violation too; give one of them another name")


def test_publishers_that_nothing_comes_from_are_told(bench: StartBench) -> None:
    on = bench()
    on.diagnostics.reaches(STALE, saying=f"{STATE}: nothing received in 2 s, and there is 1 publisher")
    before = on.diagnostics.count
    on.plant.send(20)
    on.diagnostics.reaches(OK, since=before)
