"""Messages of the node as the middleware takes them."""

from __future__ import annotations

from collections.abc import Sequence

from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from uncertain_lti.base.errors import ModelError
from uncertain_lti.monitor.verdict_messages import NamedVector


def sendable(names: Sequence[str], velocities: bool = False) -> NamedVector:
    """Messages with some names, checked against what the middleware reads from them.

    Parameters
    ----------
    names : sequence of str
        Of the states.
    velocities : bool, default False
        Whether `velocity` holds as many numbers as `position`, or none.

    Returns
    -------
    NamedVector
        To be filled in.

    Raises
    ------
    ModelError
        The middleware does not read the names as they are.
    """
    vector = NamedVector(names, velocities)
    numbers = [0.0] * len(names)
    same = JointState(name=list(names), position=numbers, velocity=numbers if velocities else [])
    if deserialize_message(vector.template, JointState) != same:
        raise ModelError(f"the names {', '.join(names)} cannot be sent as sensor_msgs/msg/JointState; rename them")
    return vector
