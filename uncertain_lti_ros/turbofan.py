# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""`turbofan`: the nonlinear engine as a node, in open or closed loop, healthy or with a fault."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

from uncertain_lti.plants.leibov import CONTROL_TOPIC, STATE_TOPIC
from uncertain_lti.plants.turbofan_faults import KINDS
from uncertain_lti.plants.turbofan_runs import START_NS, make_run, simulate
from uncertain_lti_ros.arguments import Declared, declare, run_node
from uncertain_lti_ros.plant import SUMMARY, publish
from uncertain_lti_ros.process import Life, living

PARAMETERS = (
    Declared(
        "manoeuvre", "levels", "pulses (open loop), check (lever 68 to 60 deg) or levels (lever in between).", True
    ),
    Declared("amplitude", 0.0, "Of the pulses, over the scale of each control; only for pulses.", True, -1.0, 1.0),
    Declared("noise", 0.0, "Standard deviation of each reading, over its scale.", True, 0.0, 1.0),
    Declared("seed", 0, "Seed of the noise.", True, 0, 10**9),
    Declared("fault", "", f"Empty, or one of {', '.join(KINDS)}.", True),
    Declared("fault_at", 24.0, "Onset of the fault, s after the first sample.", True, 0.0, 1e6),
    Declared("samples", 0, "Samples to publish; 0: the usual number of the manoeuvre.", True, 0, 10**9),
    Declared("rate", 1.0, "Speed of publication; stamps are 0.025 s apart at any rate.", True, 1e-3, 1e9),
    Declared("wait", 30.0, "Time to wait for subscribers of both topics, s.", True, 0.0, 1e9),
    Declared("simulated_time", True, "Stamps of a simulated clock, the same in every run; false: from now on.", True),
)


class Turbofan(Node):
    """Publishes readings and commands as JointState (`position` means value), both of sample k with the stamp t_k."""

    def __init__(self) -> None:
        super().__init__("turbofan")

        given = declare(self, PARAMETERS)
        self.planned = make_run(
            *(given[name] for name in ("manoeuvre", "amplitude", "noise", "seed", "fault", "fault_at", "samples"))
        )
        self.rate, self.wait, self.simulated = given["rate"], given["wait"], given["simulated_time"]
        qos = QoSProfile(depth=1000)
        self.state = self.create_publisher(JointState, STATE_TOPIC, qos)
        self.control = self.create_publisher(JointState, CONTROL_TOPIC, qos)


def run(life: Life) -> int:
    """Simulate, wait for subscribers, publish, wait until all has been received."""
    node = life.node
    assert isinstance(node, Turbofan)
    start_ns = START_NS if node.simulated else node.get_clock().now().nanoseconds
    made = simulate(node.planned, start_ns)  # before anybody waits: a run of 30 s takes some seconds
    return publish(life, (node.state, node.control), lambda: made, node.rate, node.wait)


def main(args: list[str] | None = None) -> int:
    """Run the node until its transient is over."""

    def started(args: list[str]) -> int:
        with living(Turbofan, args) as life:
            return run(life)

    summary = SUMMARY.format("the nonlinear turbofan, in open or closed loop,", STATE_TOPIC, CONTROL_TOPIC)
    return run_node("turbofan", summary, PARAMETERS, started, args)
