# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The live node against real publishers in other processes: the promise of equal verdicts, and how it behaves."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_writer import Layout, Message, Topic, float64, joint_state, vector, write
from perturbed import CONTROL, EPOCH_NS, JOINT_STATE, STATE, STEP_NS, VECTOR
from rosbags.highlevel import AnyReader

from uncertain_lti import EnvelopeMonitor, SignalMap, UncertainLTI
from uncertain_lti.model.alarm_rule import KINDS, AlarmRule, StatisticRule
from uncertain_lti.model.domain import Domain, Sampling
from uncertain_lti.model.horizon import Horizon, Residuals
from uncertain_lti.model.repeats import Repeats
from uncertain_lti.model.schedule import Axis, BlockData, Schedule
from uncertain_lti.model.terms import ARRAYS
from uncertain_lti.monitor import outputs
from uncertain_lti.monitor.reason import over_recording
from uncertain_lti.monitor.verdict import Verdict
from uncertain_lti.recordings.bag import Bag
from uncertain_lti.recordings.message_reader import header_stamp_ns
from uncertain_lti.sampling.clock import Status
from uncertain_lti.sampling.reading import read_as_fitted
from uncertain_lti.sampling.sampler import Sampler
from uncertain_lti.signals.field_path import FieldPath
from uncertain_lti.signals.signal_map import Signal

pytest.importorskip("rclpy", reason="rclpy is not installed")

from geometry_msgs.msg import Vector3Stamped
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros_processes import ERROR, OK, STALE, WARN, Diagnostics, World, until
from ros_processes import world as world
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64, String
from std_srvs.srv import Trigger

# --- a model and recordings made by hand --------------------------------------------------------------------


def by_hand(time: str = "header", max_hold: float | None = 0.5, **options: Any) -> UncertainLTI:
    """Two states on a JointState, controls on a Vector3Stamped (header time) or a Float64 (log time)."""
    if time == "header":
        state = [(JOINT_STATE, STATE, "position[a]"), (JOINT_STATE, STATE, "position[b]")]
        control = [(VECTOR, CONTROL, "vector.x"), (VECTOR, CONTROL, "vector.y")]
    else:
        state = [("std_msgs/msg/Float64", "/power", "data")]
        control = [("std_msgs/msg/Float64", "/voltage", "data")]
    units, held = {"steady": 0.3, "scale": 1.7}, {"steady": 0.1, "scale": 0.9, "max_hold": max_hold}
    states = (Signal(name, *of, type=kind, **units) for name, (kind, *of) in zip("ab", state, strict=False))
    controls = (Signal(name, *of, type=kind, **held) for name, (kind, *of) in zip("pq", control, strict=False))
    signals = SignalMap(tuple(states), tuple(controls))
    signals = options.pop("signals", signals)
    n, m = len(signals.states), len(signals.controls)
    rng = np.random.default_rng(7)
    clock = signals.states[0].topic
    nominal = rng.normal(size=(n, n)) - 2.0 * np.eye(n), rng.normal(size=(n, m))
    widths = rng.uniform(0.1, 0.6, (n, n)), rng.uniform(0.1, 0.6, (n, m))
    limits = {"clock": clock, "max_gap": 2.5 * STEP_NS * 1e-9, "time": dict.fromkeys(signals.topics, time)}
    known = {"signals": replace(signals, **limits), "sampling": Sampling(STEP_NS * 1e-9)}
    return UncertainLTI(*nominal, *widths, v=np.full(n, 1e-4), **known, **options)


def everything_armed() -> UncertainLTI:
    """The model by hand with a schedule, horizons, every kind of statistic at one of them, and repeats."""
    plain, rng, n = by_hand(), np.random.default_rng(4), 2

    def scheduled(scale: float = 1.0) -> dict[str, Any]:
        share = rng.uniform(0.5, 1.0, 3)
        arrays = {name: getattr(plain, name) for name in ARRAYS} | {"v": np.full(n, 0.005)}
        return {name: np.stack([scale * s * value for s in share]) for name, value in arrays.items()}

    residuals = Residuals(np.zeros(n), np.eye(n))
    lengths = (2, 5, 12)
    rules: list[Any] = [AlarmRule(2, 5), AlarmRule(2, 4, 1.2, horizon=5)]
    for i, kind in enumerate(KINDS):
        allowance = 0.1 if kind == "cusum" else 0.0
        rules.append(StatisticRule(kind, 20 * STEP_NS * 1e-9, 2.0, lengths[i % 3] if i % 2 else 1, allowance))
    return UncertainLTI(
        **scheduled(),
        schedule=Schedule((Axis("a", knots=(-0.1, 0.0, 0.1)),)),
        block_data=[BlockData(100)] * 3,
        horizons=[Horizon(h, **scheduled(0.4), residuals=residuals) for h in lengths],
        signals=plain.signals,
        sampling=plain.sampling,
        alarm=rules,
        residuals=residuals,
        repeats=Repeats(np.full(n, 0.1)),
    )


def saved(model: UncertainLTI, folder: Path, name: str = "hand") -> Path:
    path = folder / f"{name}.model.json"
    model.save(path)
    return path


def run_of(model: UncertainLTI, steps: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """States and controls in recorded units: drawn inside the bounds, a few of them pushed outside."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1.0, 1.0, (steps, model.m))
    x = np.zeros((steps, model.n))
    for k in range(steps - 1):
        centre, half = model.centre_and_half(x[k], u[k], STEP_NS * 1e-9)
        x[k + 1] = centre + half * rng.uniform(-1.0, 1.0, model.n) * (1.5 if rng.random() < 0.1 else 1.0)
    point = model.operating_point
    return point.recorded_x(x), point.u_s + point.U * u


def header_bag(model: UncertainLTI, path: Path, steps: int, seed: int = 1) -> Path:
    """Control and state share their stamps and come in either order, with every disorder that sampling knows."""
    rng = np.random.default_rng(seed)
    x, u = run_of(model, steps, seed)
    messages: list[Message] = []
    t = EPOCH_NS
    for k in range(steps):
        log = t + 100_000_000 + int(rng.integers(0, 2_000_000))
        state = Message(STATE, log, joint_state(t, x[k]))
        control = Message(CONTROL, log + 300_000, vector(t, *u[k]))
        if rng.random() < 0.5:
            control = replace(control, log_time=log - 300_000)
        kind = rng.random()
        if kind < 0.02:  # names moved, a name missing, not a number
            state = replace(state, data=joint_state(t, x[k][::-1], ("b", "a")))
        elif kind < 0.03:
            state = replace(state, data=joint_state(t, x[k], ("a", "c")))
        elif kind < 0.04:
            state = replace(state, data=joint_state(t, [np.nan, x[k][1]]))
        elif kind < 0.05:
            messages.append(replace(state, log_time=log + 500_000))  # an equal stamp
        elif kind < 0.06:
            messages.append(Message(STATE, log + 500_000, joint_state(t - STEP_NS // 2, x[k])))  # out of order
        elif kind < 0.07:
            messages.append(Message(STATE, log + 500_000, joint_state(0, x[k])))  # no stamp
        elif kind < 0.09:
            control = replace(control, log_time=log + 3 * STEP_NS)  # late
        messages += [state, control]
        t += STEP_NS + int(rng.integers(-1_000_000, 1_000_000)) + (5 * STEP_NS if rng.random() < 0.01 else 0)
    messages.sort(key=lambda m: m.log_time)
    topics = [Topic(STATE, JOINT_STATE), Topic(CONTROL, VECTOR)]
    return write(topics, messages, Layout("zstd", chunk_size=1 << 16)).save(path)


def log_bag(model: UncertainLTI, path: Path, steps: int, seed: int = 2) -> Path:
    """No stamps at all: the order and the log time are the only clock; some controls share a state's log time."""
    rng = np.random.default_rng(seed)
    x, u = run_of(model, steps, seed)
    messages = []
    t = EPOCH_NS
    for k in range(steps):
        shift = int(rng.choice([-2_000_000, 0, 3_000_000]))
        pair = [Message("/power", t, float64(x[k][0])), Message("/voltage", t + shift, float64(u[k][0]))]
        messages += pair if rng.random() < 0.5 else pair[::-1]
        t += STEP_NS + int(rng.integers(-2_000_000, 2_000_000)) + (5 * STEP_NS if rng.random() < 0.02 else 0)
    messages.sort(key=lambda m: m.log_time)
    return write([Topic("/power"), Topic("/voltage")], messages).save(path)


# --- the promise --------------------------------------------------------------------------------------------


def offline(model_path: Path, bag_path: Path) -> list[Verdict]:
    """The verdict on every clock message of a recording, in order."""
    model = UncertainLTI.load(model_path)
    sampler, monitor = Sampler(model.signals), EnvelopeMonitor(model)
    signals = model.signals
    paths = {t: [FieldPath(signals.signals[i].field) for i in signals.on(t)] for t in signals.topics}
    verdicts = []
    for topic, log_time, message in Bag(bag_path).messages(signals.topics):
        values = [path.read(message) for path in paths[topic]]
        verdicts += [monitor.judge(s) for s in sampler.push(topic, log_time, header_stamp_ns(message), values)]
    return verdicts


def stamp_of(message: Any) -> int:
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


def bits(values: Any) -> bytes:
    return np.asarray(values, dtype=np.float64).tobytes()


OF_STATES = [output for output in outputs.JUDGED if output.of == "states"]
"""Those of the models here, which have no horizons."""


@dataclass
class Outputs:
    """What the node publishes, gathered in this process."""

    topics: dict[str, Any]

    @classmethod
    def of(cls, world: World, *more: str) -> Outputs:
        names = ("flags", *(output.name for output in OF_STATES), *more)
        topics = {name: world.listen(JointState, f"/envelope_monitor/{name}") for name in names}
        topics["violation"] = world.listen(Bool, "/envelope_monitor/violation")
        for topic in topics.values():
            topic.connected()
        return cls(topics)

    def hold_against(self, verdicts: list[Verdict], names: tuple[str, ...], stamps: bool = True) -> None:
        """Every flag of every clock message, and every bit of what was judged."""
        flags = self.topics["flags"].count(len(verdicts))
        judged = [v for v in verdicts if v.judged]
        assert len(judged) > 0.5 * len(verdicts) and any((v.flags == 1.0).any() for v in judged)
        for verdict, message in zip(verdicts, flags, strict=True):
            np.testing.assert_array_equal(message.position, verdict.flags)
            expected = float(verdict.outside_domain) if verdict.judged else np.nan
            np.testing.assert_array_equal(message.velocity, np.full(len(names), expected))
            assert tuple(message.name) == names
            if verdict.status is not Status.UNSTAMPED:  # without a stamp, the time of receipt stands in
                assert stamp_of(message) == verdict.t_ns
        for output in OF_STATES:
            got = self.topics[output.name].count(len(judged))
            assert [stamp_of(m) for m in got] == [v.t_ns for v in judged]
            assert [bits(m.position) for m in got] == [bits(getattr(v, output.position)) for v in judged]
        time.sleep(0.3)
        assert len(self.topics["flags"].messages) == len(verdicts), "more flags than clock messages"
        assert self.topics["violation"].messages[-1].data == verdicts[-1].alarm


def test_everything_armed_gives_live_what_it_gives_offline(world: World, tmp_path: Path) -> None:
    """Late, repeated, swapped, damaged and absent messages; stamps that jump, go back or are missing."""
    path = saved(everything_armed(), tmp_path)
    bag = header_bag(by_hand(), tmp_path / "run.mcap", 600)
    verdicts = offline(path, bag)
    judged = [v for v in verdicts if v.judged]
    assert {v.status for v in verdicts} >= {Status.OK, Status.MISSING, Status.GAP, Status.UNSTAMPED}
    assert {v.alarm for v in judged} == {True, False}
    process = world.monitor(path)
    names = ("horizon_utilisation", "statistics")
    outputs = Outputs.of(world, *names)
    world.command("play", bag, "--rate", 3.0).succeed()
    outputs.hold_against(verdicts, ("a", "b"))
    for name in names:
        told = outputs.topics[name].count(len(judged))
        assert [bits(m.position) for m in told] == [bits(np.ravel(getattr(v, name))) for v in judged]
        assert sum(not np.isnan(m.position).any() for m in told) > 50
    status = world.status()
    assert status["verdicts"] == len(judged) and status["unexpected_errors"] == 0 and "Traceback" not in process.output
    assert sum(status["lost"].values()) == 0 and status["received"].keys() == {STATE, CONTROL}


def test_statistics_and_the_reason_are_those_of_the_recording_and_of_a_snapshot(world: World, tmp_path: Path) -> None:
    """A reader that joins after the last message still gets the last reason."""
    model = by_hand(alarm=[AlarmRule(2, 5), StatisticRule("energy", 0.05, 0.5)])
    path = saved(model, tmp_path)
    bag = header_bag(model, tmp_path / "run.mcap", 200)
    verdicts = [v for v in offline(path, bag) if v.judged]
    loaded = UncertainLTI.load(path)
    checked = EnvelopeMonitor(loaded).check(read_as_fitted(bag, loaded.signals))
    said = [text for _, text in over_recording(checked, loaded)]
    assert any("mean square of the utilisation over 0.05 s above 0.5: a" in text for text in said)
    world.monitor(path, **{"snapshot.folder": str(tmp_path / "snapshots"), "state_timeout": 60.0})
    outputs = Outputs.of(world, "statistics")
    reason = world.listen(String, "/envelope_monitor/reason", KEPT).connected()
    reason.count(1)
    world.command("play", bag, "--rate", 2.0).succeed()
    got = outputs.topics["statistics"].count(len(verdicts))
    assert {tuple(m.name) for m in got} == {("energy/a", "energy/b")}
    assert [bits(m.position) for m in got] == [bits(v.statistics) for v in verdicts]
    until(lambda: reason.messages[-1].data == said[-1], "the last reason")
    expected = iter(["no verdict yet", *said])  # the publisher keeps one: of several at once a reader may miss some
    assert all(any(text == m.data for text in expected) for m in reason.messages) and len(reason.messages) > 3
    assert world.listen(String, "/envelope_monitor/reason", KEPT).count(1)[0].data == said[-1]
    assert world.call(Trigger, "/envelope_monitor/snapshot", Trigger.Request()).success
    until(lambda: list((tmp_path / "snapshots").glob("*.mcap")), "the snapshot")
    (snapshot,) = (tmp_path / "snapshots").glob("*.mcap")
    with AnyReader([snapshot], default_typestore=None) as reader:
        found: dict[str, list[Any]] = {}
        for connection, _, data in reader.messages():
            found.setdefault(connection.topic, []).append(reader.deserialize(data, connection.msgtype))
    assert [m.data for m in found["/envelope_monitor/reason"]] == said
    assert [bits(m.position) for m in found["/envelope_monitor/statistics"]] == [bits(m.position) for m in got]


@pytest.mark.parametrize("at", ["departure", "arrival", "both"])
def test_a_command_at_an_arrival_or_judged_gives_one_by_one_what_check_gives(tmp_path: Path, at: str) -> None:
    plain = by_hand().signals
    p, q = plain.controls
    signals = replace(plain, controls=(replace(p, at=at), replace(q, judged=True)))
    model = by_hand(alarm_rule=AlarmRule(2, 5), signals=signals)
    names = ("a", "b", "q")
    assert model.state_names == names and model.m == (2 if at == "both" else 1)
    path, bag = saved(model, tmp_path), header_bag(by_hand(), tmp_path / "run.mcap", 300)
    verdicts = offline(path, bag)
    checked = EnvelopeMonitor(model).check(read_as_fitted(bag, UncertainLTI.load(path).signals))
    judged = [v for v in verdicts if v.judged]
    assert len(judged) > 100 and bits(checked.lower[checked.judged]) == bits([v.lower for v in judged])
    assert checked.alarm.tolist() == [v.alarm for v in verdicts if not v.status.dropped]


def test_log_time_gives_live_what_it_gives_offline_in_lockstep(world: World, tmp_path: Path) -> None:
    model = by_hand("log")
    path = saved(model, tmp_path)
    bag = log_bag(model, tmp_path / "run.mcap", 200)
    verdicts = offline(path, bag)
    assert {v.status for v in verdicts} >= {Status.OK, Status.GAP}
    world.monitor(path, use_sim_time=True)
    outputs, again = Outputs.of(world), tmp_path / "again.mcap"
    recorder = world.command("record", *model.signals.topics, "--output", again, "--use-sim-time")
    world.command("play", bag, "--clock", "--lockstep", "envelope_monitor").succeed()
    outputs.hold_against(verdicts, ("a",))
    recorder.signal(signal.SIGINT)
    assert "not those of /clock" not in recorder.succeed()
    recorded, played = ([(m.topic, m.log_time_ns) for m in Bag(b).raw_messages()] for b in (again, bag))
    assert recorded == played, "a check of what was recorded beside it judges what the node judged"


# --- behaviour ----------------------------------------------------------------------------------------------


KEPT = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Of a reader that gets the last message of before."""


class Plant:
    """Publishes samples of the model by hand, one at a time, from this process."""

    def __init__(self, world: World, model: UncertainLTI, state: str = STATE, control: str = CONTROL) -> None:
        self.model = model
        self.state = world.publisher(JointState, state)
        self.control = world.publisher(Vector3Stamped, control)
        self.world = world
        self.t_ns = EPOCH_NS
        self.x = np.zeros(model.n)
        self.u = np.full(model.m, 0.2)
        self.padding: list[float] = []  # makes messages on the state topic large

    def subscribed(self) -> Plant:
        self.world.subscribed(self.state, self.control)
        return self

    def send(self, samples: int, off: float = 0.0) -> None:
        """Samples on the centre of their bounds, or `off` half-widths beside it."""
        point = self.model.operating_point
        for _ in range(samples):
            position = point.recorded_x(self.x).tolist()
            message = JointState(name=["a", "b"], position=position, effort=self.padding)
            control = Vector3Stamped()
            recorded = point.u_s + point.U * self.u
            control.vector.x, control.vector.y = float(recorded[0]), float(recorded[1])
            for m in (message, control):
                m.header.stamp.sec, m.header.stamp.nanosec = divmod(self.t_ns, 10**9)
            self.control.publish(control)
            self.state.publish(message)
            centre, half = self.model.centre_and_half(self.x, self.u, STEP_NS * 1e-9)
            self.x = centre + off * half
            self.t_ns += STEP_NS
            time.sleep(0.005)


@dataclass
class Bench:
    """A monitor at work on a model by hand, what it says, and a plant that it hears."""

    world: World
    model: UncertainLTI
    path: Path
    process: Any
    diagnostics: Diagnostics
    flags: Any
    plant: Plant

    def flagged(self, number: int, since: int = 0) -> list[float]:
        """The flag of the first state at so many samples, as soon as they are here, but for the first ones."""
        return [message.position[0] for message in self.flags.count(number)[since:]]


StartBench = Callable[..., Bench]


@pytest.fixture
def bench(world: World, tmp_path: Path) -> StartBench:
    def start(model: UncertainLTI | None = None, **parameters: Any) -> Bench:
        model = model or by_hand()
        path = saved(model, tmp_path)
        process = world.monitor(path, **({"diagnostics_period": 0.1} | parameters))
        diagnostics = world.diagnostics()
        flags = world.listen(JointState, "/envelope_monitor/flags").connected()
        return Bench(world, model, path, process, diagnostics, flags, Plant(world, model).subscribed())

    return start


def trigger(world: World, name: str) -> tuple[bool, str]:
    answer = world.call(Trigger, f"/envelope_monitor/{name}", Trigger.Request())
    return answer.success, answer.message


def wider(model: UncertainLTI) -> UncertainLTI:
    return model.replace(dA=3 * model.dA, dB=3 * model.dB, v=3 * model.v)


def test_every_verdict_and_every_heartbeat_is_published(world: World, tmp_path: Path) -> None:
    model = by_hand(alarm_rule=AlarmRule(2, 3))
    path = saved(model, tmp_path)
    world.monitor(path, heartbeat=4.0)  # sent every 2 s, which leaves as much for a busy machine
    late: list[Any] = []
    promised = QoSProfile(depth=5000, deadline=Duration(seconds=4.0))
    events = SubscriptionEventCallbacks(deadline=late.append)
    violation = world.listen(Bool, "/envelope_monitor/violation", promised, event_callbacks=events).connected()
    violation.count(3)  # nothing has been judged, and the node is heard all the same
    assert not any(m.data for m in violation.messages)
    assert np.diff(violation.times).max() < 4.0 and not late

    plant = Plant(world, model).subscribed()
    outputs = Outputs.of(world)
    plant.send(5)
    outputs.topics["flags"].count(5)
    before = len(violation.messages)
    plant.send(1, off=2.0)  # the transition judged at the next sample leaves its bounds
    plant.send(1, off=2.0)
    outputs.topics["flags"].count(7)
    plant.send(1)
    flags = outputs.topics["flags"].count(8)
    assert [m.position[0] for m in flags[1:]] == [0.0] * 5 + [1.0] * 2  # the first sample has no verdict
    assert np.isnan(flags[0].position).all() and np.isnan(flags[0].velocity).all()
    assert len(flags[3].effort) == 0
    until(lambda: violation.messages[-1].data is True, "the alarm")  # two of the last three; sent after the flags
    assert violation.messages[before].data is False
    plant.send(2)
    until(lambda: violation.messages[-1].data is False, "the alarm to end")
    status = world.status()
    assert status["violations"] == {"a": 2, "b": 2} and status["alarm"] is False


def test_diagnostics_tell_well_outside_alarm_and_silence_apart(world: World, tmp_path: Path) -> None:
    domain = Domain(np.full(2, -1.0), np.full(2, 1.0), np.full(2, -0.5), np.full(2, 0.5))
    model = by_hand(domain=domain, alarm_rule=AlarmRule(3, 5))
    world.monitor(saved(model, tmp_path), diagnostics_period=0.1, state_timeout=3.0, hardware_id="rig 1")
    diagnostics = world.diagnostics()
    status = diagnostics.reaches(STALE, saying="nothing received on")
    assert STATE in status.message and CONTROL in status.message and status.hardware_id == "rig 1"
    plant = Plant(world, model).subscribed()

    plant.send(30)
    status = diagnostics.reaches(OK)
    state = diagnostics.latest("envelope_monitor: b")
    assert state.level == bytes([OK])
    values = Diagnostics.values(state)
    assert float(values["lower"]) <= float(values["state"]) <= float(values["upper"])
    monitor = lambda: Diagnostics.values(diagnostics.latest("envelope_monitor: monitor"))  # noqa: E731
    until(lambda: monitor()["verdicts"] == "29", "a report on all verdicts")
    values = monitor()
    assert values[f"received {STATE}"] == "30"
    assert float(values[f"age {CONTROL}"]) < 5 and values[f"publishers {STATE}"] == "1"

    plant.u = np.full(2, 0.7)
    count = diagnostics.count
    plant.send(20)
    diagnostics.reaches(WARN, saying=" verdicts: p at 0.73 (fitted: -0.35 to 0.55), q at ", since=count)
    plant.u = np.full(2, 0.2)
    count = diagnostics.count
    plant.send(20, off=2.0)
    diagnostics.reaches(ERROR, saying="alarm: at least 3 of 5", since=count)
    assert diagnostics.latest("envelope_monitor: a").level == bytes([ERROR])
    plant.t_ns += 10 * STEP_NS
    plant.send(5)
    plant.t_ns -= STEP_NS
    count = diagnostics.count
    plant.send(1)
    diagnostics.reaches(STALE, saying=f"no message on {STATE} for", since=count)
    assert diagnostics.latest("envelope_monitor: a").level == bytes([STALE])
    values = Diagnostics.values(diagnostics.latest("envelope_monitor: monitor"))
    assert (values["gaps"], values["dropped"], values["alarms"]) == ("1", "1", "1")


def test_a_model_that_cannot_be_is_refused_by_name_and_the_one_at_work_goes_on(bench, tmp_path):
    """Set or read again; and the process ends in time, whatever it was given to read."""
    on = bench()
    on.plant.send(1)
    on.plant.send(3, off=2.0)
    os.mkfifo(tmp_path / "pipe")
    text = on.path.read_text()
    (tmp_path / "newer.json").write_text(text.replace("uncertain-lti/1", "uncertain-lti/9"))
    timeless = json.loads(text)
    del timeless["sampling"]["time"][CONTROL]
    (tmp_path / "timeless.json").write_text(json.dumps(timeless))
    (tmp_path / "nameless.json").write_text(text.replace(CONTROL, "/engine//control"))
    nowhere = f"there is no such model file in {Path.cwd()}; give the whole path"
    for wrong, why in (
        (tmp_path / "newer.json", "uncertain-lti/9"),
        (tmp_path / "timeless.json", f"sampling.time says nothing of {CONTROL}; write header or log"),
        (tmp_path / "nameless.json", "'/engine//control' is no topic name; write letters, digits, _ and /"),
        (tmp_path / "nowhere.json", "there is no such model file"),
        ("~no-such-user/hand.model.json", nowhere),
        ("hand.model.json", nowhere),
        ("x" * 5000, nowhere),
        (tmp_path / "pipe", "this is a pipe or a device"),
        ("/dev/zero", "this is a pipe or a device"),
    ):
        accepted, reason = on.world.set(model=str(wrong))
        assert not accepted and reason.startswith(str(wrong)[:100]) and why in reason and len(reason) < 6000
        on.plant.send(1, off=2.0)
    for broken in (text[: len(text) // 2], "[" * 100_000, ""):
        on.path.write_text(broken)
        success, reason = trigger(on.world, "reload")
        assert not success and str(on.path) in reason, reason
        on.plant.send(1, off=2.0)
    assert on.flagged(16, since=1) == [0, *[1.0] * 14]
    status = on.world.status()
    assert status["unexpected_errors"] == 0
    assert (status["model"], status["state"]) == (str(on.path), "active")
    on.process.signal(signal.SIGTERM)
    assert on.process.wait(20.0) == 0


def test_a_model_is_swapped_as_a_whole(bench: StartBench, tmp_path: Path) -> None:
    """By its name or its file; the first sample has no verdict, subscriptions are kept, and topics may be others."""
    on = bench()
    second = saved(wider(on.model), tmp_path, "second")
    on.plant.send(1)
    on.plant.send(2, off=2.0)
    assert on.world.set(model=str(second)) == (True, "")
    on.plant.send(3, off=2.0)
    on.model.save(second)
    success, said = trigger(on.world, "reload")
    assert success and "2 states: a, b" in said
    on.plant.send(3, off=2.0)
    nan = np.nan
    np.testing.assert_array_equal(on.flagged(9), [nan, 0, 1, nan, 0, 0, nan, 1, 1])
    assert on.world.status()["received"] == {STATE: 9, CONTROL: 9}
    assert on.world.set(model=str(saved(by_hand("log"), tmp_path, "third"))) == (True, "")
    assert on.world.status()["received"].keys() == {"/power", "/voltage"}
    power = on.world.publisher(Float64, "/power")
    on.world.subscribed(power)
    power.publish(Float64(data=1.0))
    assert list(on.flags.count(10)[9].name) == ["a"]


def test_what_takes_effect_with_the_next_model_may_be_set_with_it(bench: StartBench) -> None:
    on = bench()
    on.plant.padding = [0.0] * 200
    on.plant.send(1)
    on.flags.count(1)
    assert not on.world.set(model="absent", largest_message=0.1)[0]
    assert on.world.set(model=str(on.path), largest_message=0.001) == (True, "")
    on.plant.send(1)
    until(lambda: on.world.status()["unreadable"] == {STATE: 1}, "a message over largest_message")


def test_the_alarm_rule_can_be_set_and_is_checked(bench: StartBench) -> None:
    on = bench()
    violation = on.world.listen(Bool, "/envelope_monitor/violation").connected()
    accepted, reason = on.world.set(violations=4, window=3)
    assert not accepted and "violations is 4 of window 3" in reason
    assert not on.world.set(margin=-1.0)[0]
    accepted, reason = on.world.set(enable="/machine//mode data == 3")
    assert not accepted and "parameter enable: '/machine//mode' is no topic name" in reason
    accepted, reason = on.world.set(heartbeat=2.0)
    assert not accepted and "read-only" in reason
    assert on.world.set(violations=2, window=3, margin=2.0) == (True, "")
    on.plant.send(1)
    on.plant.send(4, off=1.5)
    assert on.flagged(5, since=1) == [0, 0, 0, 0]  # within twice the width
    assert on.world.set(margin=1.0) == (True, "")
    on.plant.send(2, off=1.5)
    assert on.flagged(7, since=5) == [1, 1]
    until(lambda: violation.messages[-1].data, "the alarm")


def test_the_reason_stays_while_every_message_is_dropped(world: World, tmp_path: Path) -> None:
    """Equal stamps, ten a second and more: the last word is not that of the last verdict."""
    model = by_hand()
    world.monitor(saved(model, tmp_path), state_timeout=0.3)
    plant = Plant(world, model).subscribed()
    reason = world.listen(String, "/envelope_monitor/reason", KEPT).connected()
    plant.send(5)
    until(lambda: [m.data for m in reason.messages][-1:] == ["no alarm"], "a verdict")
    said = f"no verdict for more than 0.3 s: messages on {model.signals.clock} are dropped (equal stamp)"

    def stands() -> bool:
        plant.t_ns -= STEP_NS  # as the last one
        plant.send(1)
        return reason.messages[-1].data == said

    until(stands, "the reason")
    told = len(reason.messages)
    for _ in range(100):
        stands()
    assert len(reason.messages) == told


def test_without_autostart_the_node_obeys_transitions(world: World, tmp_path: Path) -> None:
    model = by_hand()
    parameters = {"model": str(saved(model, tmp_path)), "autostart": False, "diagnostics_period": 0.1}
    process = world.run_node("envelope_monitor", parameters)
    diagnostics = world.diagnostics()
    assert world.state() == "unconfigured"
    diagnostics.reaches(STALE, saying="unconfigured: no verdicts")
    assert world.set(margin=1.0)[0] and "write TOPIC FIELD OPERATOR NUMBER" in world.set(enable="data == 3")[1]
    assert not world.change("activate")
    process.says("no transition activate from unconfigured; there are configure")
    assert world.change("configure") and world.state() == "inactive"
    violation = world.listen(Bool, "/envelope_monitor/violation").connected()
    flags = world.listen(JointState, "/envelope_monitor/flags").connected()
    diagnostics.reaches(STALE, name="envelope_monitor: a", saying="inactive: no verdicts")
    time.sleep(1.2)
    assert not violation.messages  # silent while inactive: the missed deadline tells
    plant = Plant(world, model)
    plant.send(5)
    assert world.change("activate") and world.state() == "active"
    plant.subscribed().send(5)
    assert np.isnan(flags.count(5)[0].position).all() and violation.messages
    reason = world.listen(String, "/envelope_monitor/reason", KEPT).connected()
    assert world.change("deactivate") and world.state() == "inactive"
    until(lambda: reason.messages[-1].data == "inactive: no verdicts are given", "the reason")
    heard = len(violation.messages)
    plant.send(5)
    assert world.change("activate")
    plant.subscribed().send(2)
    assert np.isnan(flags.count(7)[5].position).all(), "a sample from before was joined to one after"
    assert len(violation.messages) > heard
    assert world.change("deactivate") and world.change("cleanup") and world.state() == "unconfigured"
    assert world.change("configure") and world.change("activate") and world.change("shutdown")
    assert world.state() == "finalized"
    process.signal(signal.SIGINT)
    process.succeed()


def test_a_rule_that_kept_the_node_from_starting_can_be_mended(world: World, tmp_path: Path) -> None:
    wrong = {"model": str(saved(by_hand(), tmp_path)), "violations": 3, "window": 1}
    process = world.run_node("envelope_monitor", wrong)
    process.says("the node starts as soon as its parameters are set right")
    assert world.state() == "unconfigured"
    assert world.set(window=5) == (True, "") and world.state() == "active"
    assert not world.manage("configure") and world.state() == "active", "a manager gives up on a node that started"


@pytest.mark.parametrize(("name", "value"), [("topic_prefix", "a b"), ("snapshot.folder", "/dev/null/x")])
def test_what_only_another_start_can_mend_is_said_so(world: World, tmp_path: Path, name: str, value: str) -> None:
    process = world.run_node("envelope_monitor", {"model": str(saved(by_hand(), tmp_path)), name: value})
    process.says("; start the node again with another")
    assert name in process.output and "as soon as" not in process.output


def test_what_cannot_be_configured_says_why_and_can_be_mended(world: World, tmp_path: Path) -> None:
    model, signals = by_hand(), by_hand().signals
    unknown = tuple(replace(c, type="frost_interfaces/msg/UCommand") for c in signals.controls)
    foreign = replace(signals, controls=unknown)
    wrong = replace(signals, states=tuple(replace(s, field="positions[0]") for s in signals.states))
    named = {"missing": foreign, "field": wrong}
    missing, unknown_field = (saved(model.replace(signals=s), tmp_path, name) for name, s in named.items())
    arrays = saved(UncertainLTI([[-1.0]], [[1.0]], [[0.1]], [[0.1]]), tmp_path, "arrays")
    process = world.run_node("envelope_monitor", {"model": str(missing), "diagnostics_period": 0.1})
    diagnostics = world.diagnostics()
    diagnostics.reaches(ERROR, saying="the Python package frost_interfaces is not installed; install it")
    assert world.state() == "unconfigured"
    assert "Traceback" not in process.output and "not configured" in process.output
    accepted, reason = world.set(model=str(arrays))
    assert not accepted and "fitted to arrays" in reason and "'x1'" in reason
    accepted, reason = world.set(model=str(unknown_field))
    assert not accepted and "positions" in reason and "position[]" in reason
    assert world.state() == "unconfigured"
    assert world.set(model=str(saved(model, tmp_path, "right"))) == (True, "") and world.state() == "active"
    diagnostics.reaches(STALE, saying="no verdict yet")


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_node_with_status_0(world: World, tmp_path: Path, end: int) -> None:
    diagnostics = world.diagnostics()
    process = world.monitor(saved(by_hand(), tmp_path))
    assert "runs on the events executor" in process.output
    until(lambda: diagnostics.latest("envelope_monitor: monitor"), "its first words")
    process.signal(end)
    while process.running:  # a terminal and `ros2 launch` both send it, one after the other
        process.signal(end)
        time.sleep(0.01)
    assert "Traceback" not in process.succeed()
    until(lambda: diagnostics.latest("envelope_monitor: monitor").message.startswith("finalized"), "its last words")


def test_what_was_published_before_is_heard_and_quality_of_service_that_cannot_be_had_is_told(world, tmp_path):
    lasting = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    control = world.publisher(Vector3Stamped, CONTROL, lasting)
    command = Vector3Stamped()
    command.vector.x = 0.25  # without a stamp: compared by time of receipt, and held
    control.publish(command)
    world.monitor(saved(by_hand(), tmp_path), **{"diagnostics_period": 0.1, "qos.reliability": "reliable"})
    until(lambda: world.status()["received"][CONTROL] == 1, "the command from before")
    diagnostics = world.diagnostics()
    world.publisher(JointState, STATE, QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT))
    status = diagnostics.reaches(STALE, saying=f"{STATE}: a publisher cannot be heard")
    assert "best effort is offered, reliable asked" in status.message
    assert not world.set(**{"qos.reliability": "match"})[0]


def test_bounds_are_predicted_for_a_step_and_the_longest_horizon_while_somebody_listens(bench: StartBench) -> None:
    arrays = {name: getattr(by_hand(), name) for name in ARRAYS}
    on = bench(by_hand(horizons=[Horizon(3, **arrays), Horizon(4, **arrays)]))
    on.plant.send(3)
    on.flags.count(3)
    names = ("predicted_lower", "predicted_upper", "horizon_predicted_lower", "horizon_predicted_upper", "lower")
    topics = [on.world.listen(JointState, f"/envelope_monitor/{name}").connected() for name in names]
    on.plant.send(10)
    low, high, far_low, far_high, judged = (topic.count(10) for topic in topics)
    for lower, upper in ((low, high), (far_low, far_high)):
        for a, b in zip(lower, upper, strict=True):
            assert stamp_of(a) == stamp_of(b) and (np.array(a.position) < np.array(b.position)).all()
            assert tuple(a.name) == ("a", "b")
    # the step is the median step and the control was known, so the prediction is what is judged one sample later
    later = {stamp_of(m): bits(m.position) for m in judged}
    assert all(bits(m.position) == later[stamp_of(m)] for m in low[:-1])
    assert [stamp_of(m) - 4 * STEP_NS for m in far_low] == [stamp_of(m) for m in judged]


def test_topics_and_diagnostics_follow_remapping_and_namespaces(world: World, tmp_path: Path) -> None:
    """Statuses are `node: part`, as the aggregator's analyzers split them."""
    model, name = by_hand(), "/rig/watcher"
    world.monitor(
        saved(model, tmp_path), "-r", "__ns:=/rig", "-r", "__node:=watcher", "-r", f"{STATE}:=/other/state", name=name,
        diagnostics_period=0.1, hardware_id="rig 7",
    )  # fmt: skip
    diagnostics = world.diagnostics()
    flags = world.listen(JointState, f"{name}/flags").connected()
    Plant(world, model, state="/other/state").subscribed().send(5)
    flags.count(5)
    assert world.status(name)["received"] == {"/other/state": 5, CONTROL: 5}
    until(lambda: len(diagnostics.topic.messages) > 12, "reports")
    for array in diagnostics.topic.messages:
        assert array.header.stamp.sec > 0
        assert [s.name for s in array.status] == [f"rig/watcher: {part}" for part in ("monitor", "a", "b")]
        for status in array.status:
            keys = [v.key for v in status.values]
            assert len(set(keys)) == len(keys) and status.message and status.hardware_id == "rig 7"
    monitor = "rig/watcher: monitor"
    until(lambda: Diagnostics.values(diagnostics.latest(monitor))["verdicts"] == "4", "a report on all verdicts")
