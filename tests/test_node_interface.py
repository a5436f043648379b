# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What ROS 2 people expect of a node: parameters that describe themselves, QoS that is followed, executors, clocks."""

import os
import signal
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml
from conftest import ROOT
from perturbed import CONTROL, STATE, STEP_NS

from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.model.domain import Sampling
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.sampling.reading import read_as_fitted

pytest.importorskip("rclpy", reason="rclpy is not installed")

from lifecycle_msgs.msg import TransitionEvent
from rcl_interfaces.srv import DescribeParameters
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros_processes import ERROR, OK, STALE, World, until
from ros_processes import world as world
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from std_srvs.srv import Trigger
from test_live import Outputs, Plant, StartBench, by_hand, header_bag, offline, saved, stamp_of
from test_live import bench as bench

from uncertain_lti_ros.parameters import PARAMETERS
from uncertain_lti_ros.process import spare_the_middleware
from uncertain_lti_ros.topics import MatchedSubscription

NODE = "/envelope_monitor"


# --- middleware ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("own", ["", "FASTRTPS_DEFAULT_PROFILES_FILE", "DEFAULT_FASTRTPS_PROFILES.xml"])
def test_writers_wake_the_middleware_seldom_unless_the_user_says_otherwise(own, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", "")
    monkeypatch.delenv("FASTDDS_DEFAULT_PROFILES_FILE", raising=False)
    if own.endswith(".xml"):
        (tmp_path / own).write_text("<profiles/>")
    elif own:
        monkeypatch.setenv(own, "mine.xml")
    spare_the_middleware()
    chosen = os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"]
    assert chosen == ("mine.xml" if own.startswith("FAST") else "") if own else Path(chosen).is_file()


def test_the_middleware_reads_the_profile(world: World, tmp_path: Path) -> None:
    """It complains of a profile that it cannot read, on the standard error, and goes on without."""
    good = world.monitor(saved(by_hand(), tmp_path))
    broken = tmp_path / "broken.xml"
    broken.write_text((ROOT / "uncertain_lti_ros" / "fastdds_writers.xml").read_text().replace("Supression", "Other"))
    world.env["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(broken)
    bad = world.monitor(saved(by_hand(), tmp_path), "-r", "__node:=other", name="/other")
    assert "XMLPARSER" not in good.output and "XMLPARSER" in bad.output


# --- parameters ---------------------------------------------------------------------------------------------


def test_every_parameter_tells_its_meaning_range_and_whether_it_can_be_set(world: World, tmp_path: Path) -> None:
    """Of a node that is started from the parameter file."""
    file = str(ROOT / "config" / "envelope_monitor.yaml")
    world.run_node("envelope_monitor", {}, "--params-file", file, "-p", "autostart:=false")
    names = [p.name for p in PARAMETERS]
    request = DescribeParameters.Request(names=names)
    described = world.call(DescribeParameters, f"{NODE}/describe_parameters", request, again=2.0).descriptors
    assert [d.name for d in described] == names
    for parameter, descriptor in zip(PARAMETERS, described, strict=True):
        assert descriptor.description == parameter.text and len(parameter.text) > 20
        assert descriptor.read_only == parameter.fixed
        ranges = [*descriptor.integer_range, *descriptor.floating_point_range]
        if type(parameter.default) in (int, float):
            (limits,) = ranges
            assert limits.from_value <= parameter.default <= limits.to_value
        else:
            assert not ranges
        if parameter.fixed:
            accepted, reason = world.set(**{parameter.name: parameter.default})
            assert not accepted and "read-only" in reason
        elif ranges:
            for value in (limits.from_value - 1, 2 * limits.to_value):
                accepted, reason = world.set(**{parameter.name: value})
                assert not accepted and "out of range" in reason, (parameter.name, value)
        wrong = 3 if isinstance(parameter.default, str | bool) else "three"
        accepted, reason = world.set(**{parameter.name: wrong})
        assert not accepted and reason
    assert world.set(model=str(saved(by_hand(), tmp_path))) == (True, "")
    assert world.change("configure") and world.change("activate") and world.state() == "active"


def test_the_parameter_file_gives_every_parameter_with_its_default() -> None:
    text = (ROOT / "config" / "envelope_monitor.yaml").read_text()
    (given,) = (section["ros__parameters"] for section in yaml.safe_load(text).values())
    flat = {}
    for key, value in given.items():
        flat |= {f"{key}.{k}": v for k, v in value.items()} if isinstance(value, dict) else {key: value}
    assert flat == {p.name: p.default for p in PARAMETERS}
    assert {k: type(v) for k, v in flat.items()} == {p.name: type(p.default) for p in PARAMETERS}
    assert all(line.lstrip().startswith("#") or ":" in line for line in text.splitlines() if line.strip())


# --- lifecycle ----------------------------------------------------------------------------------------------


def test_an_error_in_a_transition_leaves_a_node_that_can_be_configured(world: World, tmp_path: Path) -> None:
    code = """
import sys
from uncertain_lti_ros import envelope_monitor
subscribe, count = envelope_monitor.EnvelopeMonitorNode.subscribe, [0]
def subscribing(node):
    count[0] += 1
    if count[0] == 1:
        raise OSError("the first time")
    return subscribe(node)
envelope_monitor.EnvelopeMonitorNode.subscribe = subscribing
sys.exit(envelope_monitor.main())
"""
    diagnostics = world.diagnostics()
    given = {"model": str(saved(by_hand(), tmp_path)), "diagnostics_period": 0.1, "autostart": False}
    process = world.run_node("envelope_monitor", given, code=code)
    assert world.change("configure")
    events = world.listen(TransitionEvent, f"{NODE}/transition_event").connected()
    assert not world.change("activate")
    diagnostics.reaches(ERROR, saying="a transition failed unexpectedly; see the log")
    process.says("OSError: the first time")
    assert world.state() == "unconfigured" and process.running
    until(lambda: "errorprocessing" in {m.goal_state.label for m in events.messages}, "the event")
    assert world.change("configure") and world.change("activate") and world.state() == "active"
    plant = Plant(world, by_hand()).subscribed()
    flags = world.listen(JointState, f"{NODE}/flags").connected()
    plant.send(3)
    assert flags.count(3)[2].position[0] == 0.0
    diagnostics.reaches(0)


def test_a_lifecycle_manager_of_nav2_brings_it_up_and_down(world: World, tmp_path: Path) -> None:
    model = by_hand()
    (tmp_path / "wrong.model.json").write_text("{}")
    process = world.run_node("envelope_monitor", {"model": str(tmp_path / "wrong.model.json"), "autostart": False})
    startup, pause, reset = ("configure", "activate"), ("deactivate",), ("deactivate", "cleanup")
    assert not world.manage(*startup) and world.state() == "unconfigured"
    process.says("not configured")
    assert world.set(model=str(saved(model, tmp_path))) == (True, "") and world.state() == "unconfigured"
    assert world.manage(*startup)
    flags, plant = world.listen(JointState, f"{NODE}/flags").connected(), Plant(world, model)
    plant.subscribed().send(3)
    assert flags.count(3)[2].position[0] == 0.0
    assert world.manage(*pause) and world.manage("activate"), "pause and resume"
    plant.subscribed().send(2)
    assert [np.isnan(m.position[0]) for m in flags.count(5)[3:]] == [True, False]
    assert world.manage(*reset) and world.manage(*startup) and world.manage(*reset, "shutdown when unconfigured")
    assert not world.manage("configure") and world.state() == "finalized"


# --- executors ----------------------------------------------------------------------------------------------


def test_without_the_events_executor_the_default_one_does_the_same(world: World, tmp_path: Path) -> None:
    model = by_hand(alarm_rule=AlarmRule(2, 5))
    path = saved(model, tmp_path)
    bag = header_bag(model, tmp_path / "run.mcap", 150)
    code = """
import sys
sys.modules["rclpy.experimental"] = None
from uncertain_lti_ros.envelope_monitor import main
sys.exit(main())
"""
    process = world.monitor(path, code=code, use_sim_time=True)
    process.says("runs on the default executor")
    outputs = Outputs.of(world)
    # this executor may swap messages that arrive together, so the next one waits for the one before
    world.command("play", bag, "--clock", "--lockstep", "envelope_monitor").succeed()
    outputs.hold_against(offline(path, bag), ("a", "b"))


# --- publishers that come and go ----------------------------------------------------------------------------


def test_what_may_be_destroyed_has_no_handlers_in_the_executor(world: World) -> None:
    """An event for a handler that the events executor is removing would end the process."""
    node = Node("listener", context=world.node.context)
    before = set(node.waitables)
    try:
        subscription = MatchedSubscription(node, STATE, "sensor_msgs/msg/JointState", lambda *_: None)
        assert set(node.waitables) == before
        publisher = world.publisher(JointState, STATE, 10)
        until(lambda: subscription.poll() or subscription.look_soon, "the poll to see the publisher come")
        subscription.look()
        subscription.poll()
        assert subscription.publishers == 1 and not subscription.look_soon
        world.node.destroy_publisher(publisher)
        until(lambda: subscription.poll() or subscription.look_soon, "the poll to see the publisher leave")
        subscription.destroy()
        subscription.poll()
        assert STATE not in [s.topic_name for s in node.subscriptions]
    finally:
        node.destroy_node()


def test_publishers_that_return_under_another_quality_of_service_are_followed(bench: StartBench) -> None:
    """Eight times over, with messages flowing: subscriptions with event callbacks are made and destroyed."""
    on = bench()
    world, process, flags, plant = on.world, on.process, on.flags, on.plant
    offers = [
        QoSProfile(depth=10, reliability=reliability, durability=durability)
        for reliability in (ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE)
        for durability in (DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL)
    ]
    for turn in range(8):
        world.node.destroy_publisher(plant.state)
        plant.state = world.publisher(JointState, STATE, offers[turn % 4])
        before, end = len(flags.messages), time.monotonic() + 20
        while len(flags.messages) < before + 3 and time.monotonic() < end:
            plant.send(1)
            time.sleep(0.02)
        assert len(flags.messages) >= before + 3, f"not heard on turn {turn}: {process.output}"
    assert process.running and world.status()["unexpected_errors"] == 0
    assert all(not m.position[0] == 1.0 for m in flags.messages), "a gap in what was heard was judged"


def test_a_publisher_of_another_type_beside_the_right_one_does_no_harm(bench: StartBench) -> None:
    on = bench(state_timeout=30.0)
    world, plant = on.world, on.plant
    plant.send(5)
    stranger = world.start(
        "stranger", "-c",
        f"""
import rclpy, time
from geometry_msgs.msg import TwistStamped
rclpy.init()
node = rclpy.create_node("stranger")
publisher = node.create_publisher(TwistStamped, "{STATE}", 10)
while rclpy.ok():
    publisher.publish(TwistStamped())
    time.sleep(0.01)
""",
    )  # fmt: skip
    on.diagnostics.reaches(1, saying=f"{STATE}: a publisher sends geometry_msgs/msg/TwistStamped, and sensor_msgs")
    plant.send(5)
    assert on.flagged(10, since=1) == [0.0] * 9
    assert world.status()["received"][STATE] == 10 and on.process.running
    stranger.signal(signal.SIGINT)  # one that is killed is missed after 20 s only
    until(lambda: not world.status()["problems"], "the stranger to be gone")
    plant.send(3)
    assert on.flagged(13)[12] == 0.0


# --- simulated time -----------------------------------------------------------------------------------------


def test_turns_are_told_from_a_publisher_that_is_started_again_and_from_losses(world: World) -> None:
    many = range(1000, 1400)
    cases = {
        "turns": ([n for k in range(5) for n in (1000 + k, 5 + k)], True),
        "turns at the same number": ([7, 7, 8, 8, 9, 9, 10, 10], True),
        "a few between many": ([n for k in range(4) for n in (*many[100 * k : 100 * k + 100], 3 * k, 3 * k + 1)], True),
        "starts again": ([n for _ in range(6) for n in range(1, 41)], False),
        "losses": ([n for n in range(1, 200) if n % 3], False),
    }
    for case, (numbers, turns) in cases.items():
        heard = MatchedSubscription(world.node, "/x", "std_msgs/msg/Float64", lambda *_: None)
        heard.publishers = 2
        for number in numbers:
            heard._take(b"", {"publication_sequence_number": number, "source_timestamp": 0, "received_timestamp": 0})
        assert heard.takes_turns() is turns, case
        heard.destroy()


def test_publishers_of_a_state_that_take_turns_are_named_but_not_those_of_other_names(bench: StartBench) -> None:
    on = bench(state_timeout=2.0)
    said = f"{STATE}: several publishers send by turns, and are taken for one; stop all but one"
    other = on.world.publisher(JointState, STATE)
    on.world.subscribed(other)

    def send(seconds: float, *names: str) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            on.plant.send(1)
            behind = JointState(name=names, position=[0.3] * len(names))  # by a minute
            behind.header.stamp.sec = on.plant.t_ns // 10**9 - 60
            other.publish(behind)

    send(2.5, "wheel")
    on.diagnostics.reaches(OK)
    assert not on.world.status()["problems"]
    on.world.change("deactivate")
    on.world.change("activate")
    count = on.diagnostics.count
    send(6.5, "a", "b")
    on.diagnostics.reaches(STALE, saying=said, since=count)
    status = on.world.status()
    assert status["problems"] == [said] and status["why"] == f"no verdict: {said}"
    on.process.says(said)
    on.world.node.destroy_publisher(other)
    until(lambda: not on.world.status()["problems"], "one publisher")
    on.plant.send(100)
    on.diagnostics.reaches(OK)
    assert on.world.status()["why"] == "no alarm"


def test_a_machine_sampled_more_slowly_than_the_timeout_is_not_silent_between_two_samples(bench: StartBench) -> None:
    model = by_hand()
    slow = model.replace(sampling=Sampling(0.4), signals=replace(model.signals, max_gap=1.0))
    on = bench(slow, state_timeout=0.1)
    on.plant.send(2)
    on.process.says("judging a, b")
    count = on.diagnostics.count
    for _ in range(4):
        on.plant.t_ns += 400_000_000 - STEP_NS
        time.sleep(0.4)
        on.plant.send(1)
    said = {s.level for array in on.diagnostics.topic.messages[count + 2 :] for s in array.status}
    assert said and bytes([STALE]) not in said
    assert "no verdict for" not in on.process.output and "no message on" not in on.process.output
    on.diagnostics.reaches(STALE, saying=f"no message on {STATE} for")


def test_deactivation_ends_a_latched_alarm(bench: StartBench) -> None:
    on = bench(latch=True)
    on.plant.send(5)
    on.plant.send(3, off=2.0)
    until(lambda: on.world.status()["latched"], "the alarm")
    assert on.world.change("deactivate")
    status = on.world.status()
    assert (status["alarm"], status["latched"], status["why"]) == (False, False, "inactive: no verdicts are given")
    on.process.says(" s, as the node is no longer active")
    assert on.world.change("activate") and on.world.change("deactivate")
    assert on.process.output.count("the alarm is over") == 1


def test_a_simulated_clock_that_jumps_starts_a_new_segment(world: World, tmp_path: Path) -> None:
    """By log time: a jump forward is a gap, one back a reset, neither is judged; a paused clock repeats itself."""
    model = by_hand("log")
    path = saved(model, tmp_path)
    world.monitor(path, use_sim_time=True, heartbeat=0.2, **{"snapshot.folder": str(tmp_path)})
    flags = world.listen(JointState, f"{NODE}/flags").connected()
    clock = world.publisher(Clock, "/clock")
    power, voltage = world.publisher(Float64, "/power"), world.publisher(Float64, "/voltage")
    world.subscribed(clock, power, voltage)
    point = model.operating_point
    now = 10**12
    got: list[float] = []
    steps = [*[1] * 5, 100, *[1] * 3, -1000, *[1] * 3, 0, 0, 1]
    for step in (STEP_NS * k for k in steps):
        now += step
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(now, 10**9)
        clock.publish(message)
        until(lambda t=now: world.status()["now_ns"] == t, "the clock")
        received = world.status()["received"]["/voltage"]
        voltage.publish(Float64(data=float(point.u_s[0])))
        until(lambda r=received: world.status()["received"]["/voltage"] == r + 1, "the control")
        power.publish(Float64(data=float(point.x_s[0])))
        got.append(flags.count(len(got) + 1)[-1].position[0])
    nan = float("nan")
    np.testing.assert_array_equal(got, [nan, 0, 0, 0, 0, nan, 0, 0, 0, nan, 0, 0, 0, nan, nan, 0])
    counters = world.status()["counters"]
    assert (counters["gaps"], counters["resets"], counters["equal stamp"]) == (1, 1, 2)
    world.call(Trigger, f"{NODE}/snapshot", Trigger.Request())
    (file,) = tmp_path.glob("*.mcap")
    since = read_as_fitted(file, UncertainLTI.load(path).signals)
    assert since.t_ns[-5:].tolist() == [now - k * STEP_NS for k in (4, 3, 2, 1, 0)], "a snapshot holds what came since"
    world.set(use_sim_time=False)
    until(lambda: abs(world.status()["now_ns"] - time.time_ns()) < 10**10, "wall time")


def test_two_simulated_clocks_at_once_are_told(bench: StartBench) -> None:
    on = bench(use_sim_time=True)
    clocks = [on.world.publisher(Clock, "/clock") for _ in range(2)]
    on.world.subscribed(*clocks)
    for clock in clocks:
        clock.publish(Clock())
    on.diagnostics.reaches(STALE, saying="2 publishers send /clock, and time jumps between them; stop all but one")


def test_what_comes_before_the_first_simulated_time_is_no_sample(world: World, tmp_path: Path) -> None:
    """It was a sample at 0 s, which the first one of a simulation that begins there was judged from."""
    model = by_hand("log")
    process = world.monitor(saved(model, tmp_path), use_sim_time=True, state_timeout=0.5)
    flags = world.listen(JointState, f"{NODE}/flags").connected()
    clock, power, voltage = (
        world.publisher(Clock, "/clock"),
        *(world.publisher(Float64, n) for n in model.signals.topics),
    )
    world.subscribed(clock, power, voltage)
    tick, dropped = (
        Clock(),
        "messages on /power are dropped (no stamp): no time has come on /clock; start what publishes it",
    )

    def publish(jump: float) -> None:
        voltage.publish(Float64(data=float(model.operating_point.u_s[0])))
        power.publish(Float64(data=float(model.operating_point.x_s[0]) + jump))

    def told() -> bool:
        if said := dropped in process.output:
            time.sleep(1.0)  # the last one is there
        else:
            publish(9.0)
        return said

    until(told, f"the node to say {dropped}")  # while they come
    assert "more seldom" not in process.output and not flags.messages
    for k in range(20):
        tick.clock.nanosec = (k + 1) * STEP_NS
        clock.publish(tick)
        publish(0.0)
        time.sleep(0.005)
    got = flags.count(20)
    assert [stamp_of(m) for m in got] == [(k + 1) * STEP_NS for k in range(20)]
    np.testing.assert_array_equal([m.position[0] for m in got], [float("nan"), *[0] * 19])


def test_before_the_first_simulated_time_no_stamp_lies_in_the_future(bench: StartBench) -> None:
    on = bench(use_sim_time=True)
    on.plant.send(5)
    on.flagged(5)
    assert on.world.status()["future"] == {}


def test_a_node_that_was_busy_takes_each_message_at_its_simulated_time(world: World, tmp_path: Path) -> None:
    """rclpy keeps the last tick alone: all that had come meanwhile was of one instant."""
    model = by_hand("log")
    process = world.monitor(saved(model, tmp_path), use_sim_time=True)
    flags = world.listen(JointState, f"{NODE}/flags").connected()
    clock = world.publisher(Clock, "/clock")
    power, voltage = world.publisher(Float64, "/power"), world.publisher(Float64, "/voltage")
    world.subscribed(clock, power, voltage)
    process.signal(signal.SIGSTOP)
    for k in range(20):
        tick = Clock()
        tick.clock.sec, tick.clock.nanosec = divmod(10**12 + k * STEP_NS, 10**9)
        clock.publish(tick)
        voltage.publish(Float64(data=float(model.operating_point.u_s[0])))
        power.publish(Float64(data=float(model.operating_point.x_s[0])))
        time.sleep(0.002)
    process.signal(signal.SIGCONT)
    got = flags.count(20)
    assert [stamp_of(m) for m in got] == [10**12 + k * STEP_NS for k in range(20)]
    np.testing.assert_array_equal([m.position[0] for m in got], [float("nan"), *[0] * 19])


# --- what is lost on the way --------------------------------------------------------------------------------


def test_messages_that_full_queues_push_out_are_counted_and_never_bridged(bench: StartBench) -> None:
    on = bench(**{"qos.depth": 5})
    process, flags, plant = on.process, on.flags, on.plant
    judged = lambda: bool(flags.messages) and stamp_of(flags.messages[-1]) == plant.t_ns - STEP_NS  # noqa: E731
    plant.send(20)
    until(judged, "a verdict before it stops")
    process.signal(signal.SIGSTOP)
    try:
        plant.send(100)
    finally:
        process.signal(signal.SIGCONT)
    plant.send(5)
    until(judged, "the last verdict")
    status, max_gap = on.world.status(), on.model.signals.max_gap
    for topic in (STATE, CONTROL):
        assert status["lost"][topic] > 50 and status["received"][topic] + status["lost"][topic] == 125
    steps = [(stamp_of(b) - stamp_of(a), b) for a, b in pairwise(flags.messages)]
    across = [flag for step, flag in steps if step * 1e-9 > max_gap]
    assert len(across) == status["counters"]["gaps"] >= 1, "what was lost is a gap"
    assert all(np.isnan(flag.position).all() for flag in across)


# --- what a user gives --------------------------------------------------------------------------------------


def test_paths_that_a_user_gives_are_those_of_the_user(world: World, tmp_path: Path) -> None:
    """`~` is the home folder, which no shell puts in behind `:=`."""
    saved(by_hand(), tmp_path)
    world.env["HOME"] = str(tmp_path)
    world.monitor("~/hand.model.json", **{"snapshot.folder": "~/snapshots"})
    assert (tmp_path / "snapshots").is_dir() and world.status()["model"] == "~/hand.model.json"
