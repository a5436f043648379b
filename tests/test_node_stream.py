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
import perturbed
import pytest
from bag_writer import joint_state
from perturbed import Disorder

pytest.importorskip("rclpy", reason="rclpy is not installed")

import rclpy
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from ros_processes import own_domain
from sensor_msgs.msg import JointState
from test_live import EPOCH_NS, JOINT_STATE, STATE, STEP_NS, by_hand, saved

from uncertain_lti import SignalMap, UncertainLTI
from uncertain_lti.base.arrays import LONGEST_S
from uncertain_lti.model.domain import Sampling
from uncertain_lti.signals.signal_map import Signal
from uncertain_lti_ros import envelope_monitor as node_module


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

    def takes_turns(self) -> bool:
        return False

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


def stream(model: UncertainLTI, samples: int) -> list[tuple[int, str, bytes]]:
    """Arrival, topic and message, in order and whole; states leave their bounds now and then."""
    sent = perturbed.stream(model, np.random.default_rng(11), samples, Disorder(order=False, time=False))
    return [(m.log_time, m.topic, m.data) for m in sent if m.topic in model.signals.topics]


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
    model = by_hand()
    node = Node(saved(model, tmp_path))

    def fail(data: bytes) -> None:
        raise RuntimeError("the publisher is gone")

    kept = node.outputs.publishers["upper"].send
    for k, message in enumerate(stream(model, 60)):
        if k == 60:
            node.outputs.publishers["upper"].send = fail
            node.outputs.sender.changed()
        if k == 70:
            node.outputs.publishers["upper"].send = kept
            node.outputs.sender.changed()
        node.arrive(*message)
    assert node.failures.count > 0
    assert node.session.verdicts > 45
    end([node])


def at_work(folder: Path) -> tuple[Node, tuple[int, str, bytes]]:
    """A node that has judged a stream, and the message that comes next."""
    model = by_hand()
    node = Node(saved(model, folder))
    *messages, last = stream(model, 62)
    for message in messages:
        node.arrive(*message)
    assert node.session.verdicts > 40 and last[1] == STATE
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
    level = Signal("u", "/level", "data", type="std_msgs/msg/UInt8")
    signals = SignalMap(
        (Signal("a", STATE, "position[a]", type=JOINT_STATE),), (level,), clock=STATE, max_gap=0.055,
        time={STATE: "header", "/level": "log"},
    )  # fmt: skip
    model = UncertainLTI([[0.0]], [[0.0]], [[0.0]], [[0.0]], v=[1.0], signals=signals, sampling=Sampling(0.01))
    messages: list[Any] = []
    for k in range(60):
        at, value = EPOCH_NS + k * STEP_NS, 3.0 * (k % 7 == 0)
        messages += [(at, "/level", bytes([0, 1, 0, 0, k])), (at, STATE, joint_state(at, [value], ["a"])), None]
    node = played(saved(model, tmp_path), messages)
    assert node.verdicts == 59 and not node.failures.count and node.sent


@pytest.mark.parametrize("name", ["max_hold", "max_gap", "dt_median"])
def test_durations_without_end_are_as_good_as_others(ros: None, tmp_path: Path, name: str) -> None:
    model = by_hand()
    path = saved(model, tmp_path)
    content = json.loads(path.read_text())
    if name == "max_hold":
        content["controls"][0][name] = LONGEST_S
    else:
        content["sampling"][name] = LONGEST_S
    path.write_text(json.dumps(content))
    node = played(path, [*stream(model, 60), None])
    assert not node.failures.count and node.verdicts > 0
