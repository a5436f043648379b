# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""`plant`: the published engine as a node, drawn at random inside its intervals at each step."""

from __future__ import annotations

import time
from collections.abc import Callable

import rclpy
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

from uncertain_lti.plants.leibov import CONTROL_TOPIC, STATE_TOPIC, transient
from uncertain_lti.sampling.transient import Transient
from uncertain_lti_ros.arguments import Declared, declare, run_node
from uncertain_lti_ros.process import Life, living

_SETTLE = 0.5  # s from the first subscriber on, for the others to come


SUMMARY = "Publishes {} on {} and {}, once both have subscribers; then it ends."
PARAMETERS = (
    Declared("steps", 1200, "Samples to publish.", True, 2, 10**9),
    Declared("seed", 1, "Seed of the pulses and of the draws.", True, 0, 10**9),
    Declared("fault_at", -1, "Sample from which on the matrices leave their intervals; -1: never.", True, -1, 10**9),
    Declared("rate", 1.0, "Speed of publication; stamps are 0.025 s apart at any rate.", True, 1e-3, 1e9),
    Declared("wait", 30.0, "Time to wait for subscribers of both topics, s.", True, 0.0, 1e9),
)


class Plant(Node):
    """Publishes state and control as JointState (`position` means value), both of sample k with the stamp t_k."""

    def __init__(self) -> None:
        super().__init__("plant")

        given = declare(self, PARAMETERS)
        self.steps, self.seed, self.fault_at = given["steps"], given["seed"], given["fault_at"]
        self.rate, self.wait = given["rate"], given["wait"]
        qos = QoSProfile(depth=1000)
        self.state = self.create_publisher(JointState, STATE_TOPIC, qos)
        self.control = self.create_publisher(JointState, CONTROL_TOPIC, qos)


def run(life: Life) -> int:
    """Wait for subscribers, publish one transient, wait until it has been received."""
    node = life.node
    assert isinstance(node, Plant)
    return publish(
        life,
        (node.state, node.control),
        lambda: transient(
            node.steps,
            node.seed,
            None if node.fault_at < 0 else node.fault_at,
            start_ns=node.get_clock().now().nanoseconds,
        ),
        node.rate,
        node.wait,
    )


def publish(
    life: Life, publishers: tuple[Publisher, Publisher], make: Callable[[], Transient], rate: float, wait: float
) -> int:
    """Publish states and controls of a transient once both topics have subscribers."""
    node = life.node
    if not _subscribed(life, publishers, wait):
        if life.alive:
            node.get_logger().error(f"no subscriber of both topics within {wait:g} s; start one first")
        return 2
    run = make()
    node.get_logger().info(f"publishing {run}")
    began = time.monotonic()
    for k, t_ns in enumerate(run.t_ns.tolist()):
        due = began + (t_ns - int(run.t_ns[0])) * 1e-9 / rate
        while life.alive and (rest := due - time.monotonic()) > 0:
            life.spin_once(rest)
        if not life.alive:
            return 0
        sides = zip(publishers, (run.state_names, run.control_names), (run.x, run.u), strict=True)
        for publisher, names, values in sides:
            message = JointState(name=names, position=values[k])
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(t_ns, 10**9)
            publisher.publish(message)
    for publisher in publishers:
        publisher.wait_for_all_acked(rclpy.duration.Duration(seconds=10.0))
    node.get_logger().info(f"published {len(run)} samples")
    return 0


def _subscribed(life: Life, publishers: tuple[Publisher, ...], limit: float) -> bool:
    began = time.monotonic()
    since: float | None = None
    while life.alive:
        now = time.monotonic()
        if all(publisher.get_subscription_count() for publisher in publishers):
            since = since or now
            if now - since >= _SETTLE:
                return True
        elif now - began > limit:
            return False
        life.spin_once(0.05)
    return False


def main(args: list[str] | None = None) -> int:
    """Run the node until its transient is over."""

    def started(args: list[str]) -> int:
        with living(Plant, args) as life:
            return run(life)

    summary = SUMMARY.format("the published engine, drawn at random inside its intervals,", STATE_TOPIC, CONTROL_TOPIC)
    return run_node("plant", summary, PARAMETERS, started, args)
