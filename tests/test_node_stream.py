# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The node at work without a wire: what it sends and outlives."""

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
from uncertain_lti.model.domain import Sampling
from uncertain_lti.signals.signal_map import Signal
from uncertain_lti_ros import envelope_monitor as node_module

STATE, CONTROL, SETPOINT = "/state", "/control", "/setpoint"
VECTOR, ARRAY = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
START_NS, STEP_NS = 10**18, 10_000_000


class Input:
    """Stands in for a subscription: messages arrive when the test says so."""

    def __init__(self, node: Any, topic: str, type_name: str, callback: Any, wish: Any) -> None:
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

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.sent: list[tuple[str, bytes]] = []
        self.clock = Clock()
        self.set_parameters([Parameter("model", value=str(path))])
        self.start()
        assert self.active, self.reason
        for name, output in self.outputs.publishers.items():
            output.send = self._keeps(name)
            output.listeners = 1
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


def saved(path: Path, n: int, rng: np.random.Generator) -> UncertainLTI:
    """n states; two controls by stamps, one by arrival; bounds that the signals of `stream` seldom leave."""
    m, steady, scale = 3, rng.normal(size=n + 3), rng.uniform(0.5, 2.0, n + 3)
    kinds = [(f"x{i}", STATE, VECTOR, f"position[x{i}]", None) for i in range(n)]
    kinds += [("u0", CONTROL, VECTOR, "position[u0]", 0.08), ("u1", CONTROL, VECTOR, "position[u1]", None)]
    kinds += [("w", SETPOINT, ARRAY, "data[1]", 0.3)]
    every = tuple(
        Signal(name, topic, path, float(steady[k]), float(scale[k]), type=kind, max_hold=hold)
        for k, (name, topic, kind, path, hold) in enumerate(kinds)
    )
    time = {STATE: "header", CONTROL: "header", SETPOINT: "log"}
    model = UncertainLTI(
        rng.normal(size=(n, n)), rng.normal(size=(n, m)), rng.uniform(0, 0.3, (n, n)), rng.uniform(0, 0.3, (n, m)),
        c=rng.normal(size=n), dc=rng.uniform(0, 0.1, n), v=rng.uniform(0.3, 0.5, n),
        signals=SignalMap(every[:n], every[n:], clock=STATE, max_gap=0.055, min_step=0.002, time=time),
        sampling=Sampling(0.01), alarm_rule=AlarmRule(3, 20),
    )  # fmt: skip
    model.save(path)
    return model


def vector(t_ns: int, values: dict[str, float]) -> bytes:
    message = JointState(name=list(values), position=list(values.values()))
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(t_ns, 10**9)
    return serialize_message(message)


def stream(
    model: UncertainLTI, rng: np.random.Generator, count: int, outside: float = 0.0
) -> Iterator[tuple[int, str, bytes]]:
    """Arrival, topic and message; `outside`: how often a state leaves its bounds."""
    n, point = model.n, model.operating_point
    for k in range(count):
        t = START_NS + k * STEP_NS
        x = point.x_s + point.X * rng.normal(0, 0.05, n)
        u = point.u_s[:2] + point.U[:2] * rng.normal(0, 0.05, 2)
        if rng.random() < outside:
            x[rng.integers(n)] += 5.0
        if k % 5 == 0:
            setpoint = Float64MultiArray(data=(0.0, point.steady[n + 2] + rng.normal(0, 0.1), 1.0))
            yield t - 500_000, SETPOINT, serialize_message(setpoint)
        yield t - 200_000, CONTROL, vector(t, {"u0": u[0], "u1": u[1]})
        yield t, STATE, vector(t, {f"x{i}": x[i] for i in range(n)})


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
    for k, message in enumerate(stream(model, rng, 60)):
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
    *messages, last = stream(model, rng, 60)
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
    node = played(tmp_path / "model.json", [*stream(model, rng, 60), None])
    assert not node.failures.count and node.verdicts > 0
