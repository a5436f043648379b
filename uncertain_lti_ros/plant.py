# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""`plant` and `turbofan`: nodes that publish one run of the published engine, and of the nonlinear one."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

from uncertain_lti.plants.leibov import CONTROL_TOPIC, STATE_TOPIC, transient
from uncertain_lti.plants.turbofan_runs import KINDS
from uncertain_lti.sampling.transient import Transient
from uncertain_lti_ros.process import Declared, Life, declare, living, run_node

_SETTLE = 0.5  # s from the first subscriber on, for the others to come

_PACE = (
    Declared("rate", 1.0, "Speed of publication; stamps are 0.025 s apart at any rate.", True, 1e-3, 1e9),
    Declared("wait", 30.0, "Time to wait for subscribers of both topics, s.", True, 0.0, 1e9),
)
PARAMETERS = {
    "plant": (
        Declared("steps", 1200, "Samples to publish.", True, 2, 10**9),
        Declared("seed", 1, "Seed of the pulses and of the draws.", True, 0, 10**9),
        Declared("fault_at", -1, "First sample whose matrices leave their intervals; -1: none.", True, -1, 10**9),
        *_PACE,
    ),
    "turbofan": (
        Declared("manoeuvre", "levels", "pulses (open loop), check (lever 68 to 60 deg) or levels (between).", True),
        Declared("amplitude", 0.0, "Of the pulses, over the scale of each control; only for pulses.", True, -1.0, 1.0),
        Declared("noise", 0.0, "Standard deviation of each reading, over its scale.", True, 0.0, 1.0),
        Declared("seed", 0, "Seed of the noise.", True, 0, 10**9),
        Declared("fault", "", f"Empty, or one of {', '.join(KINDS)}.", True),
        Declared("fault_at", 24.0, "Onset of the fault, s after the first sample.", True, 0.0, 1e6),
        Declared("samples", 0, "Samples to publish; 0: the usual number of the manoeuvre.", True, 0, 10**9),
        *_PACE,
        Declared("simulated_time", True, "Simulated stamps, the same in every run; false: from now on.", True),
    ),
}


def plant(args: Sequence[str] | None = None) -> int:
    """The published engine."""

    def make(given: dict[str, Any], now: Callable[[], int]) -> Callable[[], Transient]:
        fault_at = None if given["fault_at"] < 0 else given["fault_at"]
        return lambda: transient(given["steps"], given["seed"], fault_at, start_ns=now())

    return _run("plant", "the published engine, drawn at random inside its intervals,", make, args)


def turbofan(args: Sequence[str] | None = None) -> int:
    """The nonlinear engine, in open or closed loop, healthy or with a fault."""

    def make(given: dict[str, Any], now: Callable[[], int]) -> Callable[[], Transient]:
        from uncertain_lti.plants.turbofan_runs import START_NS, make_run, simulate

        names = ("manoeuvre", "amplitude", "noise", "seed", "fault", "fault_at", "samples")
        planned = make_run(*(given[name] for name in names))
        made = simulate(planned, START_NS if given["simulated_time"] else now())  # some seconds: before anybody waits
        return lambda: made

    return _run("turbofan", "the nonlinear turbofan, in open or closed loop,", make, args)


def _run(name: str, what: str, make: Callable[..., Callable[[], Transient]], args: Sequence[str] | None) -> int:
    def started(args: list[str]) -> int:
        with living(lambda: Plant(name), args) as life:
            node = life.node
            assert isinstance(node, Plant)
            return publish(life, node, make(node.given, lambda: node.get_clock().now().nanoseconds))

    summary = f"Publishes {what} on {STATE_TOPIC} and {CONTROL_TOPIC}, once both have subscribers; then it ends."
    return run_node(name, summary, PARAMETERS[name], started, args)


class Plant(Node):
    """Publishes state and control as JointState (`position` means value), both of sample k with the stamp t_k."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.given = declare(self, PARAMETERS[name])
        qos = QoSProfile(depth=1000)
        self.outputs = tuple(self.create_publisher(JointState, topic, qos) for topic in (STATE_TOPIC, CONTROL_TOPIC))


def publish(life: Life, node: Plant, make: Callable[[], Transient]) -> int:
    """Publish a transient once both topics have subscribers, and wait until it has been received."""
    wait = node.given["wait"]
    if not life.until(lambda: all(publisher.get_subscription_count() for publisher in node.outputs), wait):
        if not life.alive:
            return 0
        node.get_logger().error(f"no subscriber of both topics within {wait:g} s; start one first")
        return 2
    life.until(lambda: False, _SETTLE)
    run = make()
    node.get_logger().info(f"publishing {run}")
    began = time.monotonic()
    for k, t_ns in enumerate(run.t_ns.tolist()):
        due = began + (t_ns - int(run.t_ns[0])) * 1e-9 / node.given["rate"]
        while life.alive and (rest := due - time.monotonic()) > 0:
            life.spin_once(rest)
        if not life.alive:
            return 0
        sides = zip(node.outputs, (run.state_names, run.control_names), (run.x, run.u), strict=True)
        for publisher, names, values in sides:
            message = JointState(name=names, position=values[k])
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(t_ns, 10**9)
            publisher.publish(message)
    for publisher in node.outputs:
        publisher.wait_for_all_acked(rclpy.duration.Duration(seconds=10.0))
    node.get_logger().info(f"published {len(run)} samples")
    return 0
