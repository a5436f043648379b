"""Compiled code takes messages that come in order and complete, and publishes and counts what Python would."""

from __future__ import annotations

import gc
import json
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

import rclpy
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from ros_processes import own_domain
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Float64MultiArray, Int32

from uncertain_lti import SignalMap, UncertainLTI
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.model.domain import Domain, Sampling
from uncertain_lti.monitor.envelope_monitor import NUMBERS
from uncertain_lti.monitor.snapshot import Recent, Told
from uncertain_lti.signals.signal_map import Signal
from uncertain_lti_ros import course, envelope_monitor

STATE, CONTROL, SETPOINT = "/state", "/control", "/setpoint"
VECTOR, ARRAY = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
START_NS, STEP_NS = 10**18, 10_000_000

needs_compiled = pytest.mark.skipif(bool(course.why_not()), reason=f"in Python throughout: {course.why_not()}")


class Input:
    """Stands in for a subscription: messages arrive when the test says so."""

    def __init__(self, node: Any, topic: str, type_name: str, kind: Any, callback: Any, wish: Any, raw: bool) -> None:
        self.topic, self.type_name, self.callback = topic, type_name, callback
        self.received = self.lost = self.late = 0
        self.publishers, self.problems, self.look_soon, self.qos = 1, list[str](), False, QoSProfile(depth=1)
        self.shortcut: Callable[[bytes], bool] | None = None

    def arrive(self, data: bytes) -> None:
        self.received += 1
        if self.shortcut is None or not self.shortcut(data):
            self.callback(data)

    def look(self) -> None:
        pass

    def destroy(self) -> None:
        pass


class Clock:
    """The node's clock, as the test sets it."""

    ros_time_is_active = True
    nanoseconds = 0

    def now(self) -> Clock:
        return self

    def to_msg(self) -> Any:
        return JointState().header.stamp


class Node(envelope_monitor.EnvelopeMonitorNode):
    """The real one; its messages come from `arrive`, and what it sends is kept."""

    def __init__(self, path: Path, compiled: bool, silent: tuple[str, ...] = ()) -> None:
        super().__init__()
        self.sent: list[tuple[str, bytes]] = []
        self.compiled, self.taken = compiled, 0
        self._clock = Clock()
        self.set_parameters([Parameter("model", value=str(path))])
        self.start()
        assert self.active, self._reason
        for name, output in self._outputs.items():
            output.send = self._keeps(name)
            output.listeners = int(name not in silent)
            output.look = lambda: None
        self._recent = Recent(1e9, 1 << 30)
        self._on_tick()

    def _keeps(self, name: str) -> Callable[[bytes], None]:
        return lambda data: self.sent.append((name, data))

    def _keep_beating(self) -> None:
        """Never: it goes by the time that the test takes."""

    def _keep_reporting(self) -> None:
        """Never, likewise."""

    def _take_due_snapshot(self) -> None:
        """Never: what is remembered is only looked at."""

    def _go_on(self) -> None:
        if self.compiled:
            super()._go_on()

    def _count(self) -> None:
        before = self.watch.verdicts if self.watch else 0
        super()._count()
        self.taken += self.watch.verdicts - before if self.watch else 0

    def arrive(self, at_ns: int, topic: str, data: bytes) -> None:
        self._clock.nanoseconds = at_ns
        self._inputs[topic].arrive(data)

    def standing(self) -> dict[str, Any]:
        """Everything that counts for what comes next, and every count."""
        self._settle()
        watch = self.watch
        assert watch is not None
        last = watch.last
        return {
            "counters": watch.sampler.counters,
            "received": watch.received,
            "received by": {topic: one.received for topic, one in self._inputs.items()},
            "unreadable": watch.unreadable,
            "future": watch.future,
            "judged": (watch.verdicts, watch.violations, watch.alarms, watch.alarm, watch.failures),
            "window": (list(watch.monitor._recent), watch.monitor._violations),
            "latest": repr(watch.sampler.latest()),
            "enable": (watch.arming.on, watch.arming.value),
            "last": last and (last.t_ns, last.outside_domain, last.alarm),
            "last numbers": last and [last.packed(name) for name in NUMBERS],
            "remembered": [
                (e.arrival_ns, e.topic, e.data, e.alarm, [told(v) for v in e.verdicts]) for e in self._recent.entries()
            ],
            "period": (watch._period.verdicts, watch._period.outside, watch._period.alarm),
        }


def told(verdict: Told) -> tuple[Any, ...]:
    said = [verdict.packed(name) for name in NUMBERS] if verdict.judged else []
    return verdict.t_ns, verdict.n, verdict.judged, verdict.outside_domain, said


@pytest.fixture
def ros(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(envelope_monitor, "MatchedSubscription", Input)
    with own_domain() as domain:
        rclpy.init(domain_id=domain)
        try:
            yield
        finally:
            rclpy.try_shutdown()
            gc.collect()  # else the nodes would still be there for the next test in this domain


def end(nodes: list[Node]) -> None:
    for node in nodes:
        node.finish()
        assert node._state_machine.current_state[1] == "finalized"
        node.destroy_node()


def saved(path: Path, n: int, rng: np.random.Generator, margin: float = 1.0, clock: str = "header") -> UncertainLTI:
    """n states; two controls by stamps, one by arrival; bounds that the signals of `stream` seldom leave."""
    steady, scale = rng.normal(size=n + 3), rng.uniform(0.5, 2.0, n + 3)
    kinds = [(f"x{i}", STATE, VECTOR, f"position[x{i}]", None) for i in range(n)]
    kinds += [("u0", CONTROL, VECTOR, "position[u0]", 0.08), ("u1", CONTROL, VECTOR, "position[u1]", None)]
    kinds += [("w", SETPOINT, ARRAY, "data[1]", 0.3)]
    every = tuple(
        Signal(name, topic, path, float(steady[k]), float(scale[k]), type=kind, max_hold=hold)
        for k, (name, topic, kind, path, hold) in enumerate(kinds)
    )
    signals = SignalMap(
        every[:n],
        every[n:],
        clock=STATE,
        max_gap=0.055,
        min_step=0.002,
        time={STATE: clock, CONTROL: "header", SETPOINT: "log"},
    )
    model = UncertainLTI(
        rng.normal(size=(n, n)),
        rng.normal(size=(n, 3)),
        rng.uniform(0, 0.3, (n, n)),
        rng.uniform(0, 0.3, (n, 3)),
        c=rng.normal(size=n),
        dc=rng.uniform(0, 0.1, n),
        v=rng.uniform(0.3, 0.5, n),
        domain=Domain(np.full(n, -0.2), np.full(n, 0.2), np.full(3, -0.2), np.full(3, np.inf)),
        signals=signals,
        sampling=Sampling(STATE, VECTOR, dict(signals.time), dt_median=0.01, max_gap=0.055),
        alarm_rule=AlarmRule(3, 20, margin),
    )
    model.save(path)
    return model


def vector(t_ns: int, values: dict[str, float], frame: str = "") -> bytes:
    message = JointState(name=list(values), position=list(values.values()))
    message.header.frame_id = frame
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(t_ns, 10**9)
    return serialize_message(message)


def array(*values: float) -> bytes:
    return serialize_message(Float64MultiArray(data=values))


FAULTS = (
    "outside", "nan state", "nan control", "no stamp", "equal", "late", "short", "gap", "reset", "future", "frame",
    "order", "cut", "flipped", "no control", "late control", "ahead control", "stale", "unstamped control", "many",
    "back control", "huge",
)  # fmt: skip


def stream(model: UncertainLTI, rng: np.random.Generator, count: int, rate: float) -> Iterator[tuple[int, str, bytes]]:
    """Arrival, topic and message; `rate`: how often something befalls them."""
    n, point = model.n, model.operating_point
    t = START_NS
    for _ in range(count):
        fault = str(rng.choice(FAULTS)) if rng.random() < rate else ""
        t += STEP_NS + int(rng.integers(-(10**6), 10**6))
        t += {"gap": 10**8, "reset": -(10**9), "stale": 4 * STEP_NS}.get(fault, 0)
        x = point.x_s + point.X * rng.normal(0, 0.05, n)
        u = point.u_s[:2] + point.U[:2] * rng.normal(0, 0.05, 2)
        if fault == "outside":
            x[rng.integers(n)] += 5.0
        if fault == "huge":
            x[rng.integers(n)] = 1e308
        if fault == "nan state":
            x[rng.integers(n)] = np.nan
        if fault == "nan control":
            u[rng.integers(2)] = rng.choice([np.nan, np.inf])
        control_t = t - int(rng.integers(10**6))
        control_t += {"late control": -3 * STEP_NS, "ahead control": 2 * 10**6, "back control": -(10**9)}.get(fault, 0)
        control_t = 0 if fault == "unstamped control" else control_t
        if rng.random() < 0.2:
            yield t - 500_000, SETPOINT, array(0.0, point.u_s[2] + rng.normal(0, 0.1), 1.0)
        if fault not in ("no control", "stale"):
            for k in range(int(rng.integers(2, 400)) if fault == "many" else 1):
                yield t - 200_000 + k, CONTROL, vector(control_t + k, {"u0": u[0], "u1": u[1]})
        state_t = t + {"equal": -STEP_NS, "late": -2 * STEP_NS, "short": -STEP_NS + 10**6, "future": 5 * 10**9}.get(
            fault, 0
        )
        state_t = 0 if fault == "no stamp" else state_t
        named = {f"x{i}": x[i] for i in range(n)}
        if fault == "order":
            named = dict(reversed(named.items()))
        data = vector(state_t, named, "base" if fault == "frame" else "")
        if fault == "cut":
            data = data[: int(rng.integers(len(data)))]
        if fault == "flipped":
            place = int(rng.integers(len(data)))
            data = data[:place] + bytes([data[place] ^ (1 << int(rng.integers(8)))]) + data[place + 1 :]
        yield t, STATE, data


@needs_compiled
@pytest.mark.parametrize("clock", ["header", "log"])
@pytest.mark.parametrize("n, rate, margin", [(1, 0.01, 1.0), (3, 0.03, 1.3), (3, 0.3, 1.0), (40, 0.02, 1.0)])
def test_it_publishes_and_counts_what_python_does(
    ros: None, tmp_path: Path, n: int, rate: float, margin: float, clock: str
) -> None:
    taken = 0
    for seed in range(4):
        rng = np.random.default_rng([seed, n])
        model = saved(tmp_path / "model.json", n, rng, margin, clock)
        silent = (("flags", "state"), (), ("violation",), ("predicted_lower", "lower"))[seed]
        nodes = [Node(tmp_path / "model.json", compiled, silent) for compiled in (True, False)]
        for k, message in enumerate(stream(model, rng, 500, rate)):
            for node in nodes:
                node.arrive(*message)
            if rng.random() < 0.2:
                for node in nodes:
                    node._on_tick()
            if k % 100 == 0:
                assert nodes[0].standing() == nodes[1].standing()
        assert nodes[0].standing() == nodes[1].standing()
        assert nodes[0].sent == nodes[1].sent
        taken += nodes[0].taken
        assert nodes[1].taken == 0 < nodes[1].watch.verdicts
        end(nodes)
    assert taken > (5 if rate > 0.1 else 100)


@needs_compiled
def test_an_alarm_is_raised_latched_and_reset_as_by_python(ros: None, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    model = saved(tmp_path / "model.json", 3, rng)
    nodes = [Node(tmp_path / "model.json", compiled) for compiled in (True, False)]
    calm, broken = list(stream(model, rng, 200, 0.0)), []
    for at, topic, data in stream(model, rng, 200, 0.0):
        shift = 200 * STEP_NS
        broken.append((at + shift, topic, data))
    for node in nodes:
        node.set_parameters([Parameter("latch", value=True)])
    for k, (at, topic, data) in enumerate(calm):
        for node in nodes:
            if topic == STATE and 100 <= k // 2 < 110:
                stamp = at
                data = vector(stamp, {"x0": 50.0, "x1": 0.0, "x2": 0.0})
            node.arrive(at, topic, data)
            if k % 10 == 0:
                node._on_tick()
            if k == 350:
                node._settle()
                node.watch.reset()
    assert nodes[0].standing() == nodes[1].standing()
    assert nodes[0].sent == nodes[1].sent
    assert nodes[0].watch.alarms == 1 and nodes[0].taken > 100
    end(nodes)


@needs_compiled
def test_an_output_that_fails_is_told_and_the_node_goes_on(ros: None, tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    model = saved(tmp_path / "model.json", 3, rng)
    node = Node(tmp_path / "model.json", True)
    messages = list(stream(model, rng, 60, 0.0))

    def fail(data: bytes) -> None:
        raise RuntimeError("the publisher is gone")

    kept = node._outputs["upper"].send
    for k, message in enumerate(messages):
        if k == 60:
            node._settle()
            node._outputs["upper"].send = fail
        if k == 70:
            node._outputs["upper"].send = kept
        node._on_tick()
        node.arrive(*message)
    assert node._failures == node.watch.failures > 0
    assert node.watch.verdicts > 45 and node.taken > 30
    end([node])


def at_work(folder: Path) -> tuple[Node, tuple[int, str, bytes]]:
    """A node that has taken a stream with compiled code, and the message that comes next."""
    rng = np.random.default_rng(6)
    model = saved(folder / "model.json", 3, rng)
    node = Node(folder / "model.json", True)
    *messages, last = stream(model, rng, 60, 0.0)
    for message in messages:
        node._on_tick()
        node.arrive(*message)
    assert node.taken
    return node, last


@needs_compiled
def test_an_interrupt_while_something_is_sent_ends_the_process(ros: None, tmp_path: Path) -> None:
    node, last = at_work(tmp_path)

    def interrupt(data: bytes) -> None:
        raise KeyboardInterrupt

    node._settle()
    node._outputs["upper"].send = interrupt
    node._go_on()
    with pytest.raises(KeyboardInterrupt):
        node.arrive(*last)
    assert not node._failures
    end([node])


@needs_compiled
def test_a_node_that_is_put_away_leaves_nothing(ros: None, tmp_path: Path) -> None:
    node, _ = at_work(tmp_path)
    end([node])
    left = weakref.ref(node)
    del node
    gc.collect()
    assert left() is None


@needs_compiled
def test_the_shortest_messages_are_taken(ros: None, tmp_path: Path) -> None:
    """A UInt8 takes five bytes; rclpy sends eight of them, others need not."""
    level = Signal("u", SETPOINT, "data", type="std_msgs/msg/UInt8")
    signals = SignalMap(
        (Signal("x0", STATE, "position[x0]", type=VECTOR),), (level,), clock=STATE, max_gap=0.055,
        time={STATE: "header", SETPOINT: "log"},
    )  # fmt: skip
    sampling = Sampling(STATE, VECTOR, dict(signals.time), dt_median=0.01, max_gap=0.055)
    UncertainLTI([[0.0]], [[0.0]], [[0.0]], [[0.0]], v=[1.0], signals=signals, sampling=sampling).save(
        tmp_path / "model.json"
    )
    nodes = [Node(tmp_path / "model.json", compiled) for compiled in (True, False)]
    for k in range(60):
        at = START_NS + k * STEP_NS
        state = vector(at, {"x0": 3.0 * (k % 7 == 0)})
        for node in nodes:
            node.arrive(at, SETPOINT, bytes([0, 1, 0, 0, k]))
            node.arrive(at, STATE, state)
            node._on_tick()
    assert nodes[0].standing() == nodes[1].standing() and nodes[0].sent == nodes[1].sent
    assert nodes[0].taken > 20 and not any(node._failures for node in nodes)
    end(nodes)


@needs_compiled
def test_what_does_not_fit_together_is_refused_and_nothing_is_read_beyond_a_message(ros: None, tmp_path: Path) -> None:
    model = saved(tmp_path / "model.json", 3, np.random.default_rng(7))
    node = Node(tmp_path / "model.json", True)
    for message in stream(model, np.random.default_rng(8), 10, 0.0):
        node.arrive(*message)
        node._on_tick()
    compiled = node._course._course
    once = np.ones(3, np.int64).tobytes()
    for stamp, place, condition in (
        (0, 10**6, None),
        (10**6, 0, None),
        (-1, -8, None),
        (-1, 4, (98, "d", 0, 0.0, True)),
    ):
        plan = (bytes(100), bytes(100), stamp, once, np.array([place] * 3).tobytes(), b"ddd", (None,) * 3, condition)
        topics = ((plan, None, None, [], b""),) * 3
        with pytest.raises(ValueError, match="outside of its message"):
            compiled.resume((1, 1, bytes(24), 0.01, bytes(48)), topics, (), (b"", False, False, 0), None, None)
        assert compiled.sample(b"") is False
    with pytest.raises(ValueError, match="numbers"):
        compiled.resume((1, 1, bytes(8), 0.01, bytes(48)), (), (), (b"", False, False, 0), None, None)
    with pytest.raises(TypeError):
        compiled.sample("text")
    end([node])


@needs_compiled
def test_formats_that_come_and_go_are_learnt_as_by_python(ros: None, tmp_path: Path) -> None:
    """A message taken by compiled code pays for a layout as one taken by Python does."""
    rng = np.random.default_rng(9)
    model = saved(tmp_path / "model.json", 3, rng)
    nodes = [Node(tmp_path / "model.json", compiled) for compiled in (True, False)]
    for k, (at, topic, data) in enumerate(stream(model, rng, 6000, 0.0)):
        if topic == STATE:
            x = np.frombuffer(data[-40:-16])
            data = vector(at, {f"x{i}": x[i] for i in range(3)}, "f" * (k // 100 % 20))
        for node in nodes:
            node.arrive(at, topic, data)
            if k % 10 == 0:
                node._on_tick()
    assert nodes[0].standing() == nodes[1].standing()
    assert nodes[0].watch.decoded == nodes[1].watch.decoded
    assert nodes[0].taken > 0.6 * nodes[1].watch.verdicts
    end(nodes)


@needs_compiled
@pytest.mark.parametrize("name", ["max_hold", "max_gap", "dt_median"])
def test_durations_without_end_are_as_good_as_others(ros: None, tmp_path: Path, name: str) -> None:
    rng = np.random.default_rng(10)
    model = saved(tmp_path / "model.json", 3, rng)
    said = json.loads((tmp_path / "model.json").read_text())
    if name == "max_hold":
        said["controls"][0][name] = 1e10
    else:
        said["sampling"][name] = 1e10
    (tmp_path / "model.json").write_text(json.dumps(said))
    nodes = [Node(tmp_path / "model.json", compiled) for compiled in (True, False)]
    for k, message in enumerate(stream(model, rng, 60, 0.0)):
        for node in nodes:
            node.arrive(*message)
            if k % 10 == 0:
                node._on_tick()
    assert nodes[0].standing() == nodes[1].standing()
    assert nodes[0].sent == nodes[1].sent
    assert not nodes[0]._failures and (nodes[0].taken > 20 or name == "dt_median")
    end(nodes)


@needs_compiled
def test_a_clock_that_fails_is_told_and_the_sampler_starts_anew(ros: None, tmp_path: Path) -> None:
    rng = np.random.default_rng(11)
    model = saved(tmp_path / "model.json", 3, rng)
    nodes = [Node(tmp_path / "model.json", compiled) for compiled in (True, False)]
    for k, message in enumerate(stream(model, rng, 60, 0.0)):
        for node in nodes:
            if k == 60:
                node._clock.now = lambda: 1 / 0
            node.arrive(*message)
            node._clock = Clock()
            node._on_tick()
    assert nodes[0].standing() == nodes[1].standing()
    assert nodes[0].sent == nodes[1].sent
    assert nodes[0].watch.failures == nodes[0]._failures == 1 and nodes[0].taken > 20
    end(nodes)


IMU, MODE = "/imu", "/mode"
OPTIONS = (
    set[str](),
    {"delays"},
    {"angles"},
    {"several"},
    {"delays", "angles", "several"},
    {"enable on the clock", "delays"},
    {"enable on a control", "several"},
    {"enable elsewhere"},
)


def saved_with(path: Path, options: set[str], rng: np.random.Generator, alarm: AlarmRule) -> UncertainLTI:
    """Joints, and of an inertial unit an angle and a norm; a control of whole numbers; left bounds are no rarity."""
    hold = 0.015 if "delays" in options else 0.1
    states = [
        Signal("x0", STATE, "position[x0]", type=VECTOR),
        Signal("x1", STATE, "unwrap(position[x1])" if "angles" in options else "velocity[x1]", type=VECTOR),
    ]
    where = IMU if "several" in options else STATE
    if where == IMU:
        states += [
            Signal("yaw", IMU, "unwrap(yaw(orientation))", type="sensor_msgs/msg/Imu"),
            Signal("rate", IMU, "norm(angular_velocity)", type="sensor_msgs/msg/Imu"),
        ]
    controls = [
        Signal("u0", CONTROL, "position[u0]", type=VECTOR, max_hold=hold, delay=3 if "delays" in options else 0),
        Signal("level", "/level", "data", type="std_msgs/msg/Int32", delay=1 if "delays" in options else 0),
    ]
    if "several" not in options:
        controls.append(Signal("tilt", IMU, "pitch(orientation)", type="sensor_msgs/msg/Imu", max_hold=hold))
    n, m = len(states), len(controls)
    time = {STATE: "header", CONTROL: "header", IMU: "header", "/level": "log"}
    signals = SignalMap(tuple(states), tuple(controls), clock=STATE, max_gap=0.055, min_step=0.002, time=time)
    model = UncertainLTI(
        rng.normal(size=(n, n)), rng.normal(size=(n, m)), rng.uniform(0, 0.3, (n, n)), rng.uniform(0, 0.3, (n, m)),
        v=np.array([0.18, 0.5, 0.6, 0.22][:n]),
        domain=Domain(np.full(n, -3.0), np.full(n, 3.0), np.full(m, -3.0), np.full(m, 3.0)),
        signals=signals,
        sampling=Sampling(STATE, VECTOR, time, dt_median=0.01, max_gap=0.055),
        alarm_rule=alarm,
    )  # fmt: skip
    model.save(path)
    return model


def imu(t_ns: int, yaw: float, pitch: float, rate: np.ndarray) -> bytes:
    message = Imu()
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(t_ns, 10**9)
    half = np.array([pitch, yaw]) / 2
    (sp, sy), (cp, cy) = np.sin(half), np.cos(half)
    message.orientation.x, message.orientation.y = -sp * sy, sp * cy
    message.orientation.z, message.orientation.w = cp * sy, cp * cy
    message.angular_velocity.x, message.angular_velocity.y, message.angular_velocity.z = rate
    return serialize_message(message)


def stream_with(rng: np.random.Generator, count: int, rate: float) -> Iterator[tuple[int, str, bytes]]:
    t, on, frame = START_NS, True, ""
    faults = ("gap", "reset", "nan", "equal", "no imu", "no control", "back imu", "frame", "wild", "off", "mode")
    for k in range(count):
        fault = str(rng.choice(faults)) if rng.random() < rate else ""
        t += STEP_NS + int(rng.integers(-(10**6), 10**6)) + {"gap": 10**8, "reset": -(10**9)}.get(fault, 0)
        on ^= fault == "off"
        frame = "base" if fault == "frame" else frame
        turned = 0.05 * k + rng.normal(0, 0.1)
        if rng.random() < 0.1 or k == 0:
            yield t - 900_000, "/level", serialize_message(Int32(data=int(rng.integers(-2, 3))))
        if rng.random() < 0.2 or k == 0:
            yield t - 800_000, MODE, serialize_message(Int32(data=int(on) if fault != "mode" else 7))
        if fault != "no control":
            yield t - 700_000, CONTROL, vector(t - 750_000, {"u0": rng.normal(0, 0.1) + (0 if on else -5.0)})
        if fault != "no imu":
            at = t - 10**9 if fault == "back imu" and k > 0.8 * count else t - int(rng.integers(-1, 2)) * 300_000
            yield t - 600_000, IMU, imu(at, turned, rng.normal(0, 0.1), rng.normal(0, 0.1, 3))
        x = rng.normal(0, 0.05, 2)
        x[0] += {"nan": np.nan, "wild": 1e300}.get(fault, 0.0)
        message = JointState(name=["x0", "x1"], position=[x[0], np.remainder(turned + np.pi, 2 * np.pi) - np.pi])
        message.velocity, message.effort, message.header.frame_id = x.tolist(), [float(on)], frame
        stamp = t - STEP_NS if fault == "equal" else t
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
        yield t, STATE, serialize_message(message)


@needs_compiled
@pytest.mark.parametrize("options", OPTIONS, ids=lambda options: ", ".join(sorted(options)) or "plain")
@pytest.mark.parametrize("rate", [0.0, 0.03])
def test_alarms_delays_angles_and_states_on_several_topics_are_as_in_python(
    ros: None, tmp_path: Path, options: set[str], rate: float
) -> None:
    alarms = taken = judged = 0
    for seed, rule in enumerate((AlarmRule(1, 1), AlarmRule(3, 8), AlarmRule(6, 40, 0.9), AlarmRule(2, 2, 1.2))):
        rng = np.random.default_rng([seed, len(options)])
        saved_with(tmp_path / "model.json", options, rng, rule)
        nodes = [Node(tmp_path / "model.json", compiled) for compiled in (True, False)]
        enable = {
            "enable on the clock": f"{STATE} effort[0] > 0.5",
            "enable on a control": f"{CONTROL} position[u0] >= -2.5",
            "enable elsewhere": f"{MODE} data == 1",
        }
        said = [Parameter("enable", value=enable[option]) for option in options if option in enable]
        said += [Parameter("enable_type", value="std_msgs/msg/Int32")] if "enable elsewhere" in options else []
        said += [Parameter("latch", value=seed == 1), Parameter("grace", value=0.15 * (seed == 2))]
        said += [Parameter("masked", value="x0" if seed == 3 else "")]
        for node in nodes:
            assert all(result.successful for result in node.set_parameters(said))
        for k, (at, topic, data) in enumerate(stream_with(rng, 400, rate)):
            for node in nodes:
                if topic in node._inputs:
                    node.arrive(at, topic, data)
            if rng.random() < 0.1:
                for node in nodes:
                    node._on_tick()
            if k % 100 == 0:
                assert nodes[0].standing() == nodes[1].standing()
            if k % 600 == 599:
                for node in nodes:
                    node._settle()
                    node.watch.reset()
        assert nodes[0].standing() == nodes[1].standing()
        assert nodes[0].sent == nodes[1].sent
        assert not nodes[0]._failures
        alarms += nodes[0].watch.alarms
        taken, judged = taken + nodes[0].taken, judged + nodes[0].watch.verdicts
        end(nodes)
    assert alarms > 1 and taken > 0.6 * judged > 800
