# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The node at work on streams with every fault, without a wire: what it counts, sends and outlives."""

from __future__ import annotations

import gc
import json
import weakref
from collections.abc import Callable, Iterator, Sequence
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
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from uncertain_lti import SignalMap, UncertainLTI
from uncertain_lti.base.arrays import LONGEST_S
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.model.domain import Domain, Sampling
from uncertain_lti.model.schedule import BlockData, Schedule
from uncertain_lti.signals.signal_map import Signal
from uncertain_lti_ros import envelope_monitor as node_module

STATE, CONTROL, SETPOINT = "/state", "/control", "/setpoint"
VECTOR, ARRAY = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
START_NS, STEP_NS = 10**18, 10_000_000


class Input:
    """Stands in for a subscription: messages arrive when the test says so."""

    def __init__(self, node: Any, topic: str, type_name: str, kind: Any, callback: Any, wish: Any, raw: bool) -> None:
        self.topic, self.type_name, self.callback = topic, type_name, callback
        self.received = self.lost = self.late = 0
        self.publishers, self.problems, self.look_soon, self.qos = 1, list[str](), False, QoSProfile(depth=1)

    def arrive(self, data: bytes) -> None:
        self.received += 1
        self.callback(data)

    def look(self) -> None:
        pass

    def destroy(self) -> None:
        pass

    def poll(self) -> None:
        pass


class Clock:
    """The node's clock, as the test sets it."""

    ros_time_is_active = True
    nanoseconds = 0

    def now(self) -> Clock:
        return self

    def to_msg(self) -> Any:
        return JointState().header.stamp


class Node(node_module.EnvelopeMonitorNode):
    """The real one; its messages come from `arrive`, and what it sends is kept."""

    def __init__(self, path: Path, silent: tuple[str, ...] = ()) -> None:
        super().__init__()
        self.sent: list[tuple[str, bytes]] = []
        self.clock = Clock()
        self.set_parameters([Parameter("model", value=str(path))])
        self.start()
        assert self.active, self.reason
        for name, output in self.outputs.publishers.items():
            output.send = self._keeps(name)
            output.listeners = int(name not in silent)
            output.poll = lambda: False
        self.outputs.sender.changed()
        self.tick()

    def _keeps(self, name: str) -> Callable[[bytes], None]:
        return lambda data: self.sent.append((name, data))

    def arrive(self, at_ns: int, topic: str, data: bytes) -> None:
        self.clock.nanoseconds = at_ns
        self.inputs[topic].arrive(data)


@pytest.fixture
def ros(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """Nodes whose inputs are `Input`, that keep all messages, and do nothing by the time that the test takes."""
    monkeypatch.setattr(node_module, "MatchedSubscription", Input)
    given = {"heartbeat": 3600.0, "diagnostics_period": 3600.0, "snapshot.seconds": 3600.0, "snapshot.memory": 1024.0}
    given |= {"snapshot.folder": tmp_path / "snapshots", "catch_up": 0.0, "state_timeout": 3600.0}
    arguments = [word for name, value in given.items() for word in ("-p", f"{name}:={value}")]
    with own_domain() as domain:
        rclpy.init(args=["--ros-args", *arguments], domain_id=domain)
        try:
            yield
        finally:
            rclpy.try_shutdown()
            gc.collect()  # else the nodes would still be there for the next test in this domain


def end(nodes: list[Node]) -> None:
    for node in nodes:
        node.verdicts = node.session.verdicts
        node.finish()
        assert node.state_name == "finalized"
        node.destroy_node()


def saved(
    path: Path,
    n: int,
    rng: np.random.Generator,
    margin: float = 1.0,
    clock: str = "header",
    schedule: Schedule | None = None,
) -> UncertainLTI:
    """n states; two controls by stamps, one by arrival; bounds that the signals of `stream` seldom leave.

    Where the schedule names `w`, the one by arrival is no control but a further scheduling signal.
    """
    steady, scale = rng.normal(size=n + 3), rng.uniform(0.5, 2.0, n + 3)
    kinds = [(f"x{i}", STATE, VECTOR, f"position[x{i}]", None) for i in range(n)]
    kinds += [("u0", CONTROL, VECTOR, "position[u0]", 0.08), ("u1", CONTROL, VECTOR, "position[u1]", None)]
    kinds += [("w", SETPOINT, ARRAY, "data[1]", 0.3)]
    every = tuple(
        Signal(name, topic, path, float(steady[k]), float(scale[k]), type=kind, max_hold=hold)
        for k, (name, topic, kind, path, hold) in enumerate(kinds)
    )
    further = schedule is not None and "w" in [axis.signal for axis in schedule.axes]
    m = 2 if further else 3
    lead = () if schedule is None else (schedule.blocks,)
    signals = SignalMap(
        every[:n],
        every[n : n + m],
        every[n + m :],
        clock=STATE,
        max_gap=0.055,
        min_step=0.002,
        time={STATE: clock, CONTROL: "header", SETPOINT: "log"},
    )
    model = UncertainLTI(
        rng.normal(size=(*lead, n, n)),
        rng.normal(size=(*lead, n, m)),
        rng.uniform(0, 0.3, (*lead, n, n)),
        rng.uniform(0, 0.3, (*lead, n, m)),
        c=rng.normal(size=(*lead, n)),
        dc=rng.uniform(0, 0.1, (*lead, n)),
        v=rng.uniform(0.3, 0.5, (*lead, n)),
        schedule=schedule,
        block_data=schedule and [BlockData(int(r != 1)) for r in range(schedule.blocks)],
        domain=Domain(np.full(n, -0.2), np.full(n, 0.2), np.full(m, -0.2), np.full(m, np.inf)),
        signals=signals,
        sampling=Sampling(0.01),
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
            yield t - 500_000, SETPOINT, array(0.0, point.steady[n + 2] + rng.normal(0, 0.1), 1.0)
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


def played(path: Path, messages: Sequence[Any]) -> Node:
    """A node that has taken these messages; None among them is a tick."""
    node = Node(path)
    for message in messages:
        if message is None:
            node.tick()
        else:
            node.arrive(*message)
    end([node])
    return node


def test_an_output_that_fails_is_reported_and_the_node_goes_on(ros: None, tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    model = saved(tmp_path / "model.json", 3, rng)
    node = Node(tmp_path / "model.json")

    def fail(data: bytes) -> None:
        raise RuntimeError("the publisher is gone")

    kept = node.outputs.publishers["upper"].send
    for k, message in enumerate(stream(model, rng, 60, 0.0)):
        if k == 60:
            node.outputs.publishers["upper"].send = fail
            node.outputs.sender.changed()
        if k == 70:
            node.outputs.publishers["upper"].send = kept
            node.outputs.sender.changed()
        node.arrive(*message)
    assert node.failures.count == node.session.failures > 0
    assert node.session.verdicts > 45
    end([node])


def at_work(folder: Path) -> tuple[Node, tuple[int, str, bytes]]:
    """A node that has judged a stream, and the message that comes next."""
    rng = np.random.default_rng(6)
    model = saved(folder / "model.json", 3, rng)
    node = Node(folder / "model.json")
    *messages, last = stream(model, rng, 60, 0.0)
    for message in messages:
        node.arrive(*message)
    assert node.session.verdicts > 40
    return node, last


def test_an_interrupt_while_something_is_sent_ends_the_process(ros: None, tmp_path: Path) -> None:
    node, last = at_work(tmp_path)

    def interrupt(data: bytes) -> None:
        raise KeyboardInterrupt

    node.outputs.publishers["upper"].send = interrupt
    node.outputs.sender.changed()
    with pytest.raises(KeyboardInterrupt):
        node.arrive(*last)
    assert not node.failures.count
    end([node])


def test_a_node_that_is_put_away_leaves_nothing(ros: None, tmp_path: Path) -> None:
    node, _ = at_work(tmp_path)
    end([node])
    left = weakref.ref(node)
    del node
    gc.collect()
    assert left() is None


def test_the_shortest_messages_are_taken(ros: None, tmp_path: Path) -> None:
    """A UInt8 takes five bytes; rclpy sends eight of them, others need not."""
    level = Signal("u", SETPOINT, "data", type="std_msgs/msg/UInt8")
    signals = SignalMap(
        (Signal("x0", STATE, "position[x0]", type=VECTOR),), (level,), clock=STATE, max_gap=0.055,
        time={STATE: "header", SETPOINT: "log"},
    )  # fmt: skip
    sampling = Sampling(0.01)
    UncertainLTI([[0.0]], [[0.0]], [[0.0]], [[0.0]], v=[1.0], signals=signals, sampling=sampling).save(
        tmp_path / "model.json"
    )
    messages: list[Any] = []
    for k in range(60):
        at = START_NS + k * STEP_NS
        messages += [(at, SETPOINT, bytes([0, 1, 0, 0, k])), (at, STATE, vector(at, {"x0": 3.0 * (k % 7 == 0)})), None]
    node = played(tmp_path / "model.json", messages)
    assert node.verdicts == 59 and not node.failures.count and node.sent


@pytest.mark.parametrize("name", ["max_hold", "max_gap", "dt_median"])
def test_durations_without_end_are_as_good_as_others(ros: None, tmp_path: Path, name: str) -> None:
    rng = np.random.default_rng(10)
    model = saved(tmp_path / "model.json", 3, rng)
    content = json.loads((tmp_path / "model.json").read_text())
    if name == "max_hold":
        content["controls"][0][name] = LONGEST_S
    else:
        content["sampling"][name] = LONGEST_S
    (tmp_path / "model.json").write_text(json.dumps(content))
    node = played(tmp_path / "model.json", [*stream(model, rng, 60, 0.0), None])
    assert not node.failures.count and node.verdicts > 0


def test_a_clock_that_fails_is_reported_and_the_sampler_starts_over(ros: None, tmp_path: Path) -> None:
    rng = np.random.default_rng(11)
    model = saved(tmp_path / "model.json", 3, rng)
    node = Node(tmp_path / "model.json")
    for k, message in enumerate(stream(model, rng, 60, 0.0)):
        if k == 60:
            node.clock.now = lambda: 1 / 0
        node.arrive(*message)
        node.clock = Clock()
    assert node.session.failures == node.failures.count == 1 and node.session.verdicts > 50
    end([node])
