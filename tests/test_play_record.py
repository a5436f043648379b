# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""`play` and `record` through real topics: what comes out is what went in."""

import json
import os
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bag_writer import JAZZY, Message, Topic, cdr, float64, header, joint_state, message, ramp, write
from conftest import ROOT
from rosbags.highlevel import AnyReader
from rosbags.typesys.store import Typestore

from uncertain_lti import Transient
from uncertain_lti.cli.main import main
from uncertain_lti.plants.leibov import CONTROL_TOPIC, STATE_TOPIC, leibov2006, transient
from uncertain_lti.plants.turbofan_runs import make_run, simulate
from uncertain_lti.recordings.bag import Bag
from uncertain_lti.recordings.message_types import define

pytest.importorskip("rclpy", reason="rclpy is not installed")

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist
from processes import on_a_terminal
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from ros_processes import COMMANDS, PATIENCE, World, own_domain, until
from ros_processes import world as world
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Empty, Float64, Float64MultiArray, Header, MultiArrayDimension, MultiArrayLayout, String
from std_srvs.srv import Trigger

from uncertain_lti.base.errors import BagError
from uncertain_lti_ros import player
from uncertain_lti_ros.topics import definition, live_fields, message_class

Command = Callable[..., tuple[int, str]]
START_NS = 1_700_000_000_000_000_000


@pytest.fixture
def command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Iterator[Command]:
    """A command in this process, in a domain where nobody else is: its status and what it said."""

    def call(*words: Any) -> tuple[int, str]:
        status = main([*map(str, words)])
        return status, "".join(capfd.readouterr())

    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "log"))
    with own_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        yield call


# --- definitions --------------------------------------------------------------------------------------------


def installed_types() -> list[str]:
    found = []
    for name in sorted(JAZZY.types):
        try:
            message_class(name)
        except Exception:
            continue
        found.append(name)
    return found


def test_definitions_written_from_classes_are_those_of_the_types() -> None:
    """Every installed type: field by field, down to array bounds, what the published definition of ROS 2 says."""
    types = installed_types()
    assert len(types) > 100

    def same(description: Any) -> str:
        return str(description).replace("'char'", "'uint8'")  # a class says uint8 for both

    for name in types:
        made = define(name, "ros2msg", definition(name).encode())
        assert not made.reason, f"{name}: {made.reason}"
        for used, (_, fields) in made.types.items():
            assert same(fields) == same(JAZZY.fielddefs[used][1]), f"{used} in {name}"


def test_live_types_are_described_as_those_of_a_recording() -> None:
    for name in installed_types():
        recorded = define(name, "ros2msg", JAZZY.generate_msgdef(name, ros_version=2)[0].encode()).fields(name)
        live = live_fields(name)
        assert recorded.keys() == live.keys()
        for field, there in recorded.items():
            here = live[field]
            assert (here.kind, here.array) == (there.kind, there.array), f"{name}.{field}"
            if here.kind not in ("string", "number"):
                assert here.type_name == there.type_name


# --- record -------------------------------------------------------------------------------------------------


def some_messages(number: int) -> dict[str, Any]:
    """One message of each of several shapes: nested, arrays of messages, bytes, strings, nothing at all."""
    stamp = Time(sec=1_700_000_000 + number, nanosec=number * 1000)
    pose = PoseWithCovarianceStamped(header=Header(stamp=stamp, frame_id="map"))
    pose.pose.pose.orientation.z = 0.1 * number
    pose.pose.covariance = np.arange(36) * 0.1 + number
    values = [KeyValue(key="k", value=str(number))]
    status = DiagnosticStatus(level=b"\x02", name="a", message="ü", hardware_id="", values=values)
    array = Float64MultiArray(data=[float(number), float("nan"), float("inf")])
    array.layout = MultiArrayLayout(dim=[MultiArrayDimension(label="x", size=3, stride=1)], data_offset=number)
    joints = JointState(header=Header(stamp=stamp), name=["a", "b"], position=[1.0 / (number + 1), -2.0])
    return {
        "/pose": pose,
        "/status": DiagnosticArray(header=Header(stamp=stamp), status=[status, status]),
        "/array": array,
        "/joints": joints,
        "/twist": Twist(),
        "/text": String(data="x" * number),
        "/nothing": Empty(),
    }


def padded(data: bytes) -> bytes:
    """As it travels: whole words of four bytes. What was recorded from topics has this form already."""
    return bytes(data) + bytes(-len(data) % 4)


def recorder(world: World, topics: Any, output: Path, *more: str) -> Any:
    process = world.command("record", *topics, "--output", output, *more)
    process.says("recording")
    return process


def test_what_was_published_is_what_the_file_holds(world: World, tmp_path: Path) -> None:
    first = some_messages(0)
    publishers = {topic: world.publisher(type(m), topic) for topic, m in first.items()}
    output = tmp_path / "out.mcap"
    process = recorder(world, publishers, output, "--note", "rig=number 7")
    world.subscribed(*publishers.values())
    sent = []
    for number in range(20):
        for topic, m in some_messages(number).items():
            publishers[topic].publish(m)
            sent.append((topic, m))
            time.sleep(0.001)
    time.sleep(0.5)
    process.signal(signal.SIGINT)
    assert f"{output}: {len(sent)} messages of 7 topics" in process.succeed()
    assert not (tmp_path / "out.mcap.part").exists()

    bag = Bag(output)
    assert not bag.warnings
    raw = list(bag.raw_messages())
    read = [(m.topic, repr(deserialize_message(m.data, type(first[m.topic])))) for m in raw]
    assert read == [(topic, repr(m)) for topic, m in sent]  # repr: a NaN differs from itself
    assert all(a.log_time_ns <= b.log_time_ns for a, b in zip(raw, raw[1:], strict=False))
    assert abs(raw[0].log_time_ns - time.time_ns()) < 60e9
    decoded = {t: list(m for topic, _, m in bag.messages([t])) for t in ("/pose", "/joints", "/array", "/status")}
    assert decoded["/pose"][3].pose.covariance.tolist() == some_messages(3)["/pose"].pose.covariance.tolist()
    assert decoded["/joints"][4].position.tolist() == [0.2, -2.0]
    assert decoded["/array"][2].layout.dim[0].label == "x" and np.isnan(decoded["/array"][2].data[1])
    assert decoded["/status"][7].status[1].values[0].value == "7"

    with AnyReader([output]) as reader:  # another reader, from the definitions in the file
        kinds = {t: f"{type(m).__module__.split('.')[0]}/msg/{type(m).__name__}" for t, m in first.items()}
        assert {c.topic: c.msgtype for c in reader.connections} == kinds
        store: Typestore = reader.typestore
        read = [(c.topic, store.deserialize_cdr(data, c.msgtype)) for c, _, data in reader.messages()]
    assert [m.data for topic, m in read if topic == "/text"] == ["x" * number for number in range(20)]
    contents = output.read_bytes()
    assert b"rig" in contents and b"number 7" in contents and contents.startswith(b"\x89MCAP0\r\n")


def test_recording_takes_the_quality_of_service_it_finds_and_writes_it_down(world: World, tmp_path: Path) -> None:
    loose = world.publisher(Float64, "/loose", QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT))
    lasting = world.publisher(String, "/lasting", QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    lasting.publish(String(data="said before anybody listened"))
    output = tmp_path / "out.mcap"
    process = recorder(world, ["/loose", "/lasting"], output)
    world.subscribed(loose)
    loose.publish(Float64(data=1.0))
    time.sleep(0.5)
    process.signal(signal.SIGTERM)
    process.succeed()
    by_topic = {m.topic: m for m in Bag(output).raw_messages()}
    assert by_topic.keys() == {"/loose", "/lasting"}
    said = {topic: m.channel.metadata["offered_qos_profiles"] for topic, m in by_topic.items()}
    assert "reliability: best_effort" in said["/loose"] and "durability: transient_local" in said["/lasting"]
    # and it is offered again, so that whoever comes late hears it as well
    world.node.destroy_publisher(lasting)
    player = world.command("play", output, "--topics", "/lasting", "--wait", 2)
    player.says("there is no subscriber")
    assert player.succeed()


def test_a_terminal_that_is_closed_ends_recording_in_order_unless_that_is_ignored(world: World, tmp_path: Path) -> None:
    ignoring = f"import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN); {COMMANDS}"
    publisher = world.publisher(Float64, "/power")
    outputs = [tmp_path / name for name in ("closed.mcap", "goes-on.mcap")]
    closed = recorder(world, ["/power"], outputs[0])
    goes_on = world.start("nohup", "-c", ignoring, "record", "/power", "--output", str(outputs[1]))
    goes_on.says("recording")
    until(lambda: publisher.get_subscription_count() == 2, "both recorders")
    parts = [output.with_name(f"{output.name}.part") for output in outputs]
    empty = [part.stat().st_size for part in parts]

    def written() -> bool:
        publisher.publish(Float64(data=1.0))
        return all(part.stat().st_size > size for part, size in zip(parts, empty, strict=True))

    until(written, "messages on the disk")
    for process in (closed, goes_on):
        process.signal(signal.SIGHUP)
    closed.succeed()
    assert goes_on.running
    goes_on.signal(signal.SIGINT)
    goes_on.succeed()
    assert all([*Bag(output).raw_messages()] for output in outputs)


def test_what_comes_after_the_recorder_stood_still_is_put_in_the_order_of_sending(world: World, tmp_path: Path) -> None:
    """More than Fast DDS holds for it, so that the rest is sent again, one topic after the other."""
    pair = [world.publisher(Float64, name) for name in ("/command", "/state")]
    process = recorder(world, ["/command", "/state"], tmp_path / "out.mcap")
    world.subscribed(*pair)

    def send(*numbers: int) -> None:
        for number in range(*numbers):
            for publisher in pair:
                publisher.publish(Float64(data=float(number)))
            time.sleep(0.004)

    send(100)
    process.signal(signal.SIGSTOP)
    send(100, 800)
    process.signal(signal.SIGCONT)
    send(800, 2000)
    process.signal(signal.SIGINT)
    told = "after others that were sent later" in process.succeed()  # as where the machine is too busy all the time
    numbers = np.array([m.data for _, _, m in Bag(tmp_path / "out.mcap").messages(["/command", "/state"])])
    assert len(numbers) > 3000 and (told or (np.maximum.accumulate(numbers) - numbers).max() < 30)


def test_what_publishers_kept_is_put_in_the_order_of_sending(world: World, tmp_path: Path) -> None:
    """A recorder that comes late gets it one topic after the other, and what is new among it."""
    kept = QoSProfile(depth=500, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    pair = [world.publisher(Float64, name, kept) for name in ("/command", "/state")]
    process: Any = None
    for number in range(2000):
        for publisher in pair:
            publisher.publish(Float64(data=float(number)))
        if number == 500:
            process = recorder(world, ["/command", "/state"], tmp_path / "out.mcap")
        time.sleep(0.003)
    process.signal(signal.SIGINT)
    process.succeed()
    numbers = np.array([m.data for _, _, m in Bag(tmp_path / "out.mcap").messages(["/command", "/state"])])
    assert len(numbers) > 3000 and (np.maximum.accumulate(numbers) - numbers).max() < 30


def test_log_times_are_those_of_a_simulated_clock_until_it_goes_back(world: World, tmp_path: Path) -> None:
    clock = world.publisher(Clock, "/clock")
    pair = [world.publisher(Float64, name) for name in ("/command", "/state")]
    process = recorder(world, ["/command", "/state"], tmp_path / "out.mcap", "--use-sim-time")
    wall = recorder(world, ["/state"], tmp_path / "wall.mcap")
    wall.says("note: log times are not those of /clock; --use-sim-time takes")
    world.subscribed(clock, *pair)
    process.says("nothing is recorded before a time comes on /clock; is the simulation paused?")
    for second in (None, 5, 6, 6, 4):  # before the first tick it is no time
        if second is not None:
            clock.publish(Clock(clock=Time(sec=second)))
        for publisher in pair:
            publisher.publish(Float64(data=float(second or 0)))
        time.sleep(0.1)
    assert "/clock went back from 6 to 4 s, so the recording ends there" in process.succeed()
    recorded = [m.log_time_ns for m in Bag(tmp_path / "out.mcap").raw_messages()]
    assert recorded == [5 * 10**9] * 2 + [6 * 10**9] * 4


def test_a_simulated_clock_that_goes_back_by_little_is_told(world: World, tmp_path: Path) -> None:
    clock, publisher = world.publisher(Clock, "/clock"), world.publisher(Float64, "/state")
    process = recorder(world, ["/state"], tmp_path / "out.mcap", "--use-sim-time")
    world.subscribed(clock, publisher)
    for ns in (0, 5 * 10**8, 25 * 10**7, 75 * 10**7):
        clock.publish(Clock(clock=Time(sec=5, nanosec=ns)))
        publisher.publish(Float64())
        time.sleep(0.1)
    process.signal(signal.SIGINT)
    assert "/clock went back by up to 0.25 s: log times stand still there" in process.succeed()
    recorded = [m.log_time_ns - 5 * 10**9 for m in Bag(tmp_path / "out.mcap").raw_messages()]
    assert recorded == [0, 5 * 10**8, 5 * 10**8, 75 * 10**7]


def test_a_system_clock_that_is_set_back_stops_nothing(world: World, tmp_path: Path) -> None:
    """Log times go on, one by one, and what comes is still written out: as after the first answer of an NTP server."""
    output, set_back = tmp_path / "out.mcap", tmp_path / "set_back"
    # the node's own clock stands still, as one does for an hour that is set back by an hour
    stands = "recorder.Node = partial(recorder.Node, parameter_overrides=[Parameter('use_sim_time', value=True)])"
    falls = f"time.time_ns = lambda now=time.time_ns: now() - os.path.exists({str(set_back)!r}) * 3600 * 10**9"
    modules = "import os, time; from functools import partial; from rclpy.parameter import Parameter"
    code = f"{modules}; from uncertain_lti_ros import recorder; {stands}; {falls}; {COMMANDS}"
    numbers = world.publisher(Float64, "/numbers")
    process = world.start("record", "-c", code, "record", "/numbers", "--output", str(output))
    process.says("recording")
    world.subscribed(numbers)

    def send(count: int) -> None:
        for number in range(count):
            numbers.publish(Float64(data=float(number)))
            time.sleep(0.01)

    send(100)
    set_back.touch()
    send(100)

    def written() -> int:
        with suppress(BagError):  # nothing yet
            return len([*Bag(tmp_path / "out.mcap.part").raw_messages()])
        return 0

    until(lambda: written() == 200, "what is written out by then")
    process.signal(signal.SIGINT)
    assert "this machine's clock went back by up to 3.6e+03 s: log times go on all the same" in process.succeed()
    times = np.array([message.log_time_ns for message in Bag(output).raw_messages()])
    assert len(times) == 200 and (np.diff(times) > 0).mean() > 0.98 and np.diff(times).max() < 10**9


def test_a_killed_recorder_leaves_what_it_had(world: World, tmp_path: Path) -> None:
    output = tmp_path / "out.mcap"
    numbers = world.publisher(Float64, "/numbers")
    process = recorder(world, ["/numbers"], output)
    world.subscribed(numbers)
    part, sizes = tmp_path / "out.mcap.part", set[int]()

    def grown() -> bool:
        """Whether it was written out twice while messages came."""
        numbers.publish(Float64(data=1.0))
        sizes.add(part.stat().st_size)
        return len(sizes) > 2

    until(grown, "what is written out every now and then")
    process.kill()
    assert not output.exists()
    bag = Bag(part)
    assert bag.warnings and len(list(bag.messages(["/numbers"]))) > 1


def test_a_publisher_of_another_type_that_joins_is_told_and_its_messages_are_left_out(world: World, tmp_path: Path):
    numbers = world.publisher(Float64, "/numbers")
    process = recorder(world, ["/numbers"], tmp_path / "out.mcap")
    world.subscribed(numbers)
    numbers.publish(Float64(data=1.0))
    joins = "import rclpy, time; from std_msgs.msg import Float32; rclpy.init(); node = rclpy.create_node('other')"
    world.start("other", "-c", f"{joins}; p = node.create_publisher(Float32, '/numbers', 1); time.sleep(300)")
    process.says("note: /numbers: a publisher sends std_msgs/msg/Float32, and std_msgs/msg/Float64 is wanted\n")
    process.signal(signal.SIGINT)
    assert "1 message of 1 topic" in process.succeed() and process.output.count("a publisher sends") == 1


def test_a_disk_that_is_full_ends_recording_in_a_sentence(world: World, tmp_path: Path) -> None:
    numbers, rng = world.publisher(JointState, "/numbers"), np.random.default_rng(0)
    limited = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (2**21, 2**21)); {COMMANDS}"
    process = world.start("record", "-c", limited, "record", "/numbers", "--output", str(tmp_path / "out.mcap"))
    world.subscribed(numbers)
    while process.running:
        numbers.publish(JointState(position=rng.normal(size=5000)))
        time.sleep(0.005)
    *_, sentence = process.output.splitlines()
    assert process.wait() == 2 and "out.mcap.part: cannot be finished: File too large; what is in" in sentence
    assert "callback" not in process.output and Bag(tmp_path / "out.mcap.part").topics["/numbers"].count


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["/a", "-o", "there.mcap"], "is there already"),
        (["/a", "-o", "no/x.mcap"], "no/x.mcap: the folder no is not there; make it first"),
        (["/a", "/b", "-o", "x.mcap", "--wait", "0.2"], "/a, /b: not there after 0.2 s"),
        (["/a b", "-o", "x.mcap", "--wait", "0.2"], "'/a b' is no topic name"),
        (["", "-o", "x.mcap", "--wait", "0.2"], "'' is no topic name"),
        (["/a", "-o", ""], "--output '' names no file; give one, as in run.mcap"),
        (["/a", "-o", "/"], "--output '/' names no file"),
    ],
)
def test_what_cannot_be_recorded_is_said_in_a_sentence(command, tmp_path, monkeypatch, arguments, sentence):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.mcap").write_bytes(b"old")
    status, said = command("record", *arguments)
    assert status == 2 and sentence in said and "Traceback" not in said
    assert (tmp_path / "there.mcap").read_bytes() == b"old" and not list(tmp_path.glob("x.mcap*"))


def test_a_file_that_is_moved_away_or_comes_while_recording_is_told_and_kept(world: World, tmp_path: Path) -> None:
    """Hours were recorded to a file that nothing led to any more; a file that had come was overwritten."""
    publisher = world.publisher(Float64, "/power")
    removed, replaced = (recorder(world, ["/power"], tmp_path / name) for name in ("removed.mcap", "replaced.mcap"))
    until(lambda: publisher.get_subscription_count() == 2, "both recorders")
    (tmp_path / "removed.mcap.part").rename(tmp_path / "elsewhere")
    (tmp_path / "replaced.mcap").write_text("precious")
    part = tmp_path / "replaced.mcap.part"
    empty = part.stat().st_size

    def written() -> bool:
        publisher.publish(Float64(data=1.0))
        return part.stat().st_size > empty and not removed.running

    until(written, "messages on the disk, and the end of the other")
    assert removed.wait() == 2
    assert "removed.mcap.part: was moved or removed while recording; look for it" in removed.output
    replaced.signal(signal.SIGINT)
    assert replaced.wait() == 2 and f"came while recording; what was recorded is in {part}" in replaced.output
    assert (tmp_path / "replaced.mcap").read_text() == "precious" and [*Bag(part).raw_messages()]


def test_a_recording_of_silence_is_said_and_leaves_no_file(world: World, tmp_path: Path) -> None:
    silent = world.publisher(Float64, "/silent")
    process = recorder(world, ["/silent"], tmp_path / "x.mcap")
    world.subscribed(silent)
    process.signal(signal.SIGINT)
    assert process.wait() == 2 and "no message came on /silent" in process.output
    assert not list(tmp_path.glob("*.mcap*"))


def test_a_topic_that_is_waited_for_in_vain_is_named_alone(world: World, tmp_path: Path) -> None:
    """Of `/there /missing` both were said to be silent."""
    world.publisher(Float64, "/there")
    process = world.command("record", "/there", "/missing", "--output", tmp_path / "x.mcap")
    process.says("waiting for /missing")
    process.signal(signal.SIGINT)
    assert process.wait() == 2 and "/missing: not there, and was waited for" in process.output
    assert "/there" not in process.output.rpartition("record: ")[2]


def test_a_domain_without_ports_is_refused_by_the_commands_too(command, tmp_path, monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "233")
    status, said = command("record", "/a", "--output", tmp_path / "x.mcap")
    assert status == 2 and "ROS_DOMAIN_ID is 233; choose one from 0 to 232" in said


# --- play ---------------------------------------------------------------------------------------------------


def mixed_bag(path: Path, number: int = 300, step_ns: int = 4_000_000) -> Path:
    rng = np.random.default_rng(3)
    messages = []
    for k in range(number):
        t = START_NS + k * step_ns
        joints = joint_state(t - 7, rng.normal(size=1), ["a"])
        messages.append(Message("/joints", t, joints))
        messages.append(Message("/number", t + int(rng.integers(0, step_ns)), float64(float(k))))
        if k % 10 == 0:
            text = cdr("std_msgs/msg/String", little_endian=k % 20 == 0, data=f"text {k}")
            messages.append(Message("/text", t, text))
    messages.sort(key=lambda m: m.log_time)
    topics = [Topic("/joints", "sensor_msgs/msg/JointState"), Topic("/number"), Topic("/text", "std_msgs/msg/String")]
    return write(topics, messages).save(path)


def test_played_and_recorded_again_every_message_has_the_same_bytes(world: World, tmp_path: Path) -> None:
    bag = mixed_bag(tmp_path / "in.mcap")
    output = tmp_path / "out.mcap"
    topics = ("/joints", "/number", "/text")
    before = list(Bag(bag).raw_messages())
    span = (before[-1].log_time_ns - before[0].log_time_ns) * 1e-9
    recording = world.command("record", *topics, "--output", output)
    said = world.command("play", bag, "--rate", "2").succeed()
    took = float(re.search(r"in ([\d.]+) s", said)[1])
    assert took > span / 2 - 0.1 and f"played {len(before)} messages of 3 topics" in said
    recording.signal(signal.SIGINT)
    recording.succeed()
    after = list(Bag(output).raw_messages())
    assert [(m.topic, m.data) for m in after] == [(m.topic, padded(m.data)) for m in before]
    assert all(Bag(output).topics[topic].type == Bag(bag).topics[topic].type for topic in topics)


@pytest.mark.parametrize("rate", [0.5, 1.0, 2.0])
def test_each_message_goes_out_at_its_time_and_after_a_delay_in_no_burst(tmp_path, monkeypatch, rate):
    """By a clock that only sleeping and a delay on the way move."""
    now = [1000.0]
    monkeypatch.setattr(player, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=lambda s: add(now, s)))
    messages = list(Bag(mixed_bag(tmp_path / "in.mcap")).raw_messages())
    crowd, delay_at, sent = 2000.0, 300, []
    for k, (_, late) in enumerate(player.when_due(messages, rate, crowd, lambda: True)):
        sent.append(now[0])
        due = 1000.0 + (messages[k].log_time_ns - messages[0].log_time_ns) * 1e-9 / rate
        assert late == pytest.approx(now[0] - due, abs=1e-6) and late > -1e-6
        if k < delay_at:
            assert late <= 3 / crowd + 1e-6  # of three that lie together, the last
        if k == delay_at:
            now[0] += 0.1
    assert len(sent) == len(messages) and late <= 3 / crowd + 1e-6, "the delay is caught up with"
    assert np.diff(sent).min() > 1 / crowd - 1e-6
    taken: list[Any] = []
    for due, _ in player.when_due(messages, rate, crowd, lambda: len(taken) < 5):
        taken.append(due)
    assert taken == messages[:5]


def add(now: list[float], seconds: float) -> None:
    now[0] += seconds


def test_messages_that_lie_close_together_arrive_all_the_same(world: World, tmp_path: Path) -> None:
    """3000 messages within 3 microseconds of log time."""
    bag = write([Topic("/burst")], ramp("/burst", range(START_NS, START_NS + 3000))).save(tmp_path / "in.mcap")
    heard = world.listen(Float64, "/burst", 1000)
    player = world.command("play", bag)
    player.succeed()
    assert [m.data for m in heard.count(3000)] == [float(k) for k in range(3000)]
    assert "fell behind" in player.output


def test_a_subscriber_that_comes_while_something_is_played_is_told(world: World, tmp_path: Path) -> None:
    bag = write([Topic("/x")], ramp("/x", range(START_NS, START_NS + 10**9, 10**7))).save(tmp_path / "in.mcap")
    heard = world.listen(Float64, "/x")
    player = world.command("play", bag, "--rate", 0.2)
    heard.count(1)
    world.listen(Float64, "/x")
    assert "/x: a subscriber came after playing began, and lacks what was before; play again" in player.succeed()


def test_the_clock_goes_before_each_message(world: World, tmp_path: Path) -> None:
    bag = write([Topic("/x")], ramp("/x", range(START_NS, START_NS + 10**9, 10**8))).save(tmp_path / "in.mcap")
    clock, heard = world.listen(Clock, "/clock"), world.listen(Float64, "/x")
    world.command("play", bag, "--clock").succeed()
    times = [m.clock.sec * 10**9 + m.clock.nanosec for m in clock.count(10)]
    assert times == [m.log_time_ns for m in Bag(bag).raw_messages()]
    heard.count(10)
    assert all(a < b for a, b in zip(clock.times, heard.times, strict=True))


def test_another_speed_without_stamps_is_warned_of(command: Command, tmp_path: Path) -> None:
    """At 100 times its speed, a machine without header stamps seems to take steps a hundred times as short."""
    stamped = Topic("/stamped", "geometry_msgs/msg/PointStamped")
    point = message("geometry_msgs/msg/Point", x=0.0, y=0.0, z=0.0)
    zero = Topic("/zero", stamped.type)
    messages = [Message("/x", START_NS, float64(1.0))]
    for topic, stamp in ((stamped, START_NS), (zero, 0)):
        messages.append(Message(topic.name, START_NS, cdr(topic.type, header=header(stamp), point=point), START_NS))
    bag = write([Topic("/x"), stamped, zero], messages).save(tmp_path / "in.mcap")
    quick = ["play", bag, "--wait", "0.1", "--rate", "100"]
    said = command(*quick)[1]
    assert "no header stamps: /x, /zero; a node that uses the time of receipt sees steps 100 times as fast" in said
    for arguments in ([*quick, "--clock"], quick[:4], [*quick, "--topics", "/stamped"]):
        status, said = command(*arguments)
        assert status == 0 and "no header stamps" not in said


def test_what_cannot_be_played_is_said(command: Command, tmp_path: Path) -> None:
    other = "float64 data\nfloat64 more\n"
    topics = [
        Topic("/good"),
        Topic("/foreign", "frost_interfaces/msg/UCommand", schema="float64 fin\n"),
        Topic("/other", "std_msgs/msg/Float64", schema=other),
        Topic("/json", encoding="json"),
    ]
    messages = [Message(t.name, START_NS + k, float64(1.0)) for k, t in enumerate(topics)]
    bag = write(topics, messages).save(tmp_path / "in.mcap")
    status, said = command("play", bag, "--wait", "0.2")
    assert status == 0
    assert "/foreign is not played: frost_interfaces/msg/UCommand: the Python package frost_interfaces" in said
    assert "/other is not played: std_msgs/msg/Float64 was recorded in another version" in said
    assert "/json is not played: its messages are in json" in said
    assert "there is no subscriber to /good after 0.2 s" in said and "played 1 message of 1 topic" in said
    for arguments, sentence in (
        ([bag, "--topics", "/foreign"], "no topic of it can be played"),
        ([bag, "--topics", "/a"], "there is no topic /a; topics there: /foreign, /good"),
        ([bag, "--topics", "good"], "there is no topic good (is /good meant?); topics there: /foreign, /good"),
        ([tmp_path / "none.mcap"], "none.mcap"),
        ([bag, "--lockstep", "nobody", "--wait", "0.2"], "/nobody/status: no such service after 0.2 s"),
        ([bag, "--lockstep", "no body", "--wait", "0.2"], "'no body' is no node name; write letters, digits"),
        ([bag, "--lockstep", "nobody", "--rate", "2"], "leave out --rate"),
    ):
        status, said = command("play", *arguments)
        assert status == 2 and sentence in said and "Traceback" not in said


def test_a_signal_ends_playing(world: World, tmp_path: Path) -> None:
    bag = write([Topic("/x")], ramp("/x", range(START_NS, START_NS + 60 * 10**9, 10**8))).save(tmp_path / "in.mcap")
    heard = world.listen(Float64, "/x")
    ended = r"uncertain-lti play: \S+in.mcap: played \d+ messages of 1 topic in \S+ s, then interrupted\n"
    for words in ([], ["--quiet"]):
        player = world.command("play", bag, *words)
        heard.count(3)
        player.signal(signal.SIGINT)
        assert player.wait() == 130 and re.fullmatch(ended, player.output)
        heard.messages.clear()


def test_a_signal_takes_the_bar_of_a_terminal_away(tmp_path: Path) -> None:
    bag = write([Topic("/x")], ramp("/x", range(START_NS, START_NS + 60 * 10**9, 10**8))).save(tmp_path / "in.mcap")
    with own_domain() as domain:
        command = [sys.executable, "-m", "uncertain_lti.cli.main", "play", str(bag), "--wait", "0"]
        env = os.environ | {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        status, shown = on_a_terminal(command, until=b"playing:", env=env, start_new_session=True)
    assert status == 130 and shown.rstrip().endswith("then interrupted"), shown


def test_a_signal_ends_waiting_at_once(world: World, tmp_path: Path) -> None:
    bag = write([Topic("/x")], ramp("/x", range(START_NS, START_NS + 10**9, 10**8))).save(tmp_path / "in.mcap")
    until = time.monotonic() + PATIENCE
    player = world.command("play", bag, "--wait", "600", "--lockstep", "nobody")
    while not any("player" in name for name in world.node.get_node_names()):
        assert time.monotonic() < until and player.running, player.output
        time.sleep(0.05)
    time.sleep(0.3)
    player.signal(signal.SIGTERM)
    began = time.monotonic()
    assert player.wait() == 143 and time.monotonic() - began < 300, "it would wait for 600 s"
    assert player.output == f"uncertain-lti play: {bag}: interrupted before a message was played\n"


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "fast", ""])
def test_speeds_and_times_that_are_none_are_refused_in_words(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, says in (
        (["play", "in.mcap", f"--rate={text}"], f"argument --rate: {text} is not a speed; give a number above 0"),
        (["demo", f"--rate={text}"], f"argument --rate: {text} is not a speed; give a number above 0"),
        (["play", "in.mcap", f"--wait={text}"], f"argument --wait: {text} is not a time; give seconds, 0 or more"),
        (["record", "/x", "-o", "b", f"--note={text}"], f"argument --note: {text!r} does not read NAME=TEXT"),
    ):
        if text == "0" and "--wait=0" in arguments:
            continue
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        assert ended.value.code == 2 and says in capsys.readouterr().err


def test_lockstep_with_a_node_that_takes_no_topic_is_refused(world: World, tmp_path: Path) -> None:
    """It went through the recording at once, with status 0."""

    def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.message = json.dumps({"received": {"/y": 0}, "use_sim_time": True})
        return response

    world.node.create_service(Trigger, "/listener/status", answer)
    bag = write([Topic("/x")], ramp("/x", range(START_NS, START_NS + 10**9, 2 * 10**8))).save(tmp_path / "in.mcap")
    player = world.command("play", bag, "--lockstep", "listener", "--wait", "2")
    assert player.wait() == 2 and "listener: takes no topic that is played; is it active" in player.output


def test_lockstep_with_a_node_that_takes_a_topic_no_more_ends(world: World, tmp_path: Path) -> None:
    """As one that is deactivated meanwhile: the rest of the recording went to nobody."""
    received = list[Float64]()
    world.node.create_subscription(Float64, "/x", received.append, 1000)

    def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.message = json.dumps({"received": {"/x": len(received)} if len(received) < 3 else {}})
        return response

    world.node.create_service(Trigger, "/listener/status", answer)
    bag = write([Topic("/x")], ramp("/x", range(START_NS, START_NS + 10**9, 2 * 10**8))).save(tmp_path / "in.mcap")
    player = world.command("play", bag, "--lockstep", "listener")
    assert player.wait() == 2 and "takes /x no more, since message 3; was it deactivated?" in player.output
    assert len(received) == 3


def test_lockstep_asks_again_where_an_answer_is_lost(world: World, tmp_path: Path) -> None:
    """Of each five answers of the status service the second leaves the node only after the next one."""
    received, answers, held = [0], [0], list[Any]()

    def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.message = json.dumps({"received": {"/x": received[0]}, "use_sim_time": True})
        return response

    def count(_: Float64) -> None:
        received[0] += 1

    service = world.node.create_service(Trigger, "/listener/status", answer)
    sends = service.send_response

    def send(response: Any, header: Any) -> None:
        answers[0] += 1
        if answers[0] % 5 == 2:
            held.append((response, header))
            return
        sends(response, header)
        while held:
            sends(*held.pop())

    service.send_response = send
    world.node.create_subscription(Float64, "/x", count, 100)
    bag = write([Topic("/x")], ramp("/x", range(START_NS, START_NS + 10**9, 2 * 10**8))).save(tmp_path / "in.mcap")
    player = world.command("play", bag, "--lockstep", "listener")
    assert "played 5 messages of 1 topic" in player.succeed()
    assert received[0] == 5 and answers[0] > 5 and not held


def test_json_is_all_that_is_printed_where_it_is_asked_for(world: World, tmp_path: Path) -> None:
    output = tmp_path / "out.mcap"
    bag = write([Topic("/x")], ramp("/x", range(START_NS, START_NS + 10**9, 5 * 10**7))).save(tmp_path / "in.mcap")
    process = world.command("record", "/x", "--output", output, "--duration", "0.5", "--quiet", "--json")
    player = world.command("play", bag, "--quiet", "--json")
    played, recorded = json.loads(player.succeed()), json.loads(process.succeed())
    assert (played["bag"], played["messages"], played["topics"]) == (str(bag), 20, {"/x": 20})
    assert played["interrupted"] is False and played["unconfirmed"] == [] and played["seconds"] > 0.7
    number = Bag(output).topics["/x"].count
    assert recorded["bag"] == str(output) and recorded["topics"] == {"/x": number} and recorded["lost"] == 0
    assert number == recorded["messages"] > 3 and 0.1 < recorded["span_s"] < 1.0


# --- the plant ----------------------------------------------------------------------------------------------


def arrays(bag: Bag) -> tuple[list[int], np.ndarray, list[int], np.ndarray]:
    found: list[Any] = []
    for topic in (STATE_TOPIC, CONTROL_TOPIC):
        read = [m for _, _, m in bag.messages([topic])]
        stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in read]
        found += [stamps, np.array([m.position for m in read])]
    return tuple(found)  # type: ignore[return-value]


def drawn_as(bag: Bag, make: Callable[[int], Transient]) -> Transient:
    """Hold a recording of a plant against the transient it was made from, bit by bit."""
    state_ns, x, control_ns, u = arrays(bag)
    expected = make(state_ns[0])
    assert state_ns == control_ns == expected.t_ns.tolist()
    assert x.tobytes() == expected.x.tobytes() and u.tobytes() == expected.u.tobytes()
    return expected


@pytest.mark.parametrize(
    ("node", "given", "make"),
    [
        ("plant", {"steps": 300, "seed": 5, "rate": 10.0}, lambda t: transient(300, 5, start_ns=t)),
        (
            "turbofan",
            {"manoeuvre": "check", "noise": 1e-4, "seed": 9, "samples": 41, "rate": 4.0},
            lambda t: simulate(make_run("check", noise=1e-4, seed=9, samples=41), t),
        ),
    ],
    ids=["plant", "turbofan"],
)
def test_the_plant_is_recorded_to_the_last_bit(world, tmp_path, node, given, make):
    output = tmp_path / "plant.mcap"
    recording = world.command("record", STATE_TOPIC, CONTROL_TOPIC, "--output", output)
    world.run_node(node, given).succeed()
    recording.signal(signal.SIGINT)
    recording.succeed()
    drawn_as(Bag(output), make)


def test_the_plant_without_a_listener_says_so(world: World) -> None:
    process = world.run_node("plant", {"steps": 10, "wait": 0.5})
    assert process.wait() == 2 and "no subscriber of both topics within 0.5 s" in process.output
    process = world.run_node("plant", {"steps": 10, "wait": 600.0}, "-r", "__node:=second")
    until(lambda: "second" in world.node.get_node_names(), "the plant")  # the graph may keep the name of the first
    process.signal(signal.SIGINT)
    assert process.wait() == 0, process.output


def test_the_shipped_recordings_are_what_their_description_says() -> None:
    model = leibov2006()
    healthy = drawn_as(Bag(ROOT / "bags" / "leibov_fit.mcap"), lambda t: transient(6000, 1, start_ns=t))
    check = drawn_as(Bag(ROOT / "bags" / "leibov_check.mcap"), lambda t: transient(2400, 2, 1200, start_ns=t))
    for run, faulty in ((healthy, 6000), (check, 1200)):
        x, u, dt = run.x[:-1], run.u[:-1], run.dt
        lower, upper = model.bounds(x, u, dt)
        outside = ((run.x[1:] < lower) | (run.x[1:] > upper)).any(axis=1)
        assert not outside[:faulty].any()
        assert len(outside) == faulty - 1 or outside[faulty:].mean() > 0.5
    for name in ("leibov_fit", "leibov_check"):
        assert (ROOT / "bags" / f"{name}.mcap").stat().st_size < 1_000_000


def test_two_demos_in_one_domain_say_so(world: World, tmp_path: Path) -> None:
    """Each would hear the other's recording, and none of the live verdicts would be those of the offline check."""
    other = world.node.create_publisher(JointState, "/envelope_monitor/flags", 10)
    demo = world.start("demo", "-m", "uncertain_lti.cli.main", "demo", "--output", str(tmp_path / "out"))
    assert demo.wait() == 2
    assert "another envelope_monitor publishes /envelope_monitor/flags in ROS domain" in demo.output
    assert "export ROS_DOMAIN_ID=" in demo.output
    world.node.destroy_publisher(other)
