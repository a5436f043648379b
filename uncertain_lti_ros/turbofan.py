"""`turbofan`: the nonlinear engine as a node, in open or closed loop, healthy or with a fault."""

from __future__ import annotations

import sys

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

from uncertain_lti.errors import UncertainLTIError
from uncertain_lti.plants.leibov import CONTROL_TOPIC, STATE_TOPIC
from uncertain_lti.plants.turbofan_faults import KINDS
from uncertain_lti.plants.turbofan_runs import START_NS, make_run, simulate
from uncertain_lti_ros.plant import publish
from uncertain_lti_ros.process import Life, living


class Turbofan(Node):
    """Publishes readings and commands as JointState (`position` means value), both of sample k with the stamp t_k."""

    def __init__(self) -> None:
        super().__init__("turbofan")

        def text(name: str, default: str, says: str) -> str:
            descriptor = ParameterDescriptor(description=says, read_only=True)
            return str(self.declare_parameter(name, default, descriptor).value)

        def integer(name: str, default: int, low: int, says: str) -> int:
            bounds = [IntegerRange(from_value=low, to_value=10**9, step=0)]
            descriptor = ParameterDescriptor(description=says, read_only=True, integer_range=bounds)
            return int(self.declare_parameter(name, default, descriptor).value)

        def real(name: str, default: float, low: float, high: float, says: str) -> float:
            bounds = [FloatingPointRange(from_value=low, to_value=high, step=0.0)]
            descriptor = ParameterDescriptor(description=says, read_only=True, floating_point_range=bounds)
            return float(self.declare_parameter(name, default, descriptor).value)

        self.planned = make_run(
            text("manoeuvre", "levels", "pulses (open loop), check (lever 68 to 60 deg) or levels (lever in between)."),
            real("amplitude", 0.0, -1.0, 1.0, "Of the pulses, over the scale of each control; only for pulses."),
            real("noise", 0.0, 0.0, 1.0, "Standard deviation of each reading, over its scale."),
            integer("seed", 0, 0, "Seed of the noise."),
            text("fault", "", f"Empty, or one of {', '.join(KINDS)}."),
            real("fault_at", 24.0, 0.0, 1e6, "Onset of the fault, s after the first sample."),
            integer("samples", 0, 0, "Samples to publish; 0: the usual number of the manoeuvre."),
        )
        self.rate = real("rate", 1.0, 1e-3, 1e9, "Speed of publication; stamps are 0.025 s apart at any rate.")
        self.wait = real("wait", 30.0, 0.0, 1e9, "Time to wait for subscribers of both topics, s.")
        self.simulated = bool(
            self.declare_parameter(
                "simulated_time",
                True,
                ParameterDescriptor(
                    description="Stamps of a simulated clock, the same in every run; false: from now on.",
                    read_only=True,
                ),
            ).value
        )
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
    try:
        with living(Turbofan, args) as life:
            return run(life)
    except UncertainLTIError as error:
        print(f"turbofan: {error}", file=sys.stderr)
        return 2
