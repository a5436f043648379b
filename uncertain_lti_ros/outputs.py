# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Messages of the node as the middleware takes them."""

from __future__ import annotations

from collections.abc import Sequence

from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from uncertain_lti.base.errors import ModelError
from uncertain_lti.monitor.verdict_messages import NamedVector


def sendable(names: Sequence[str], velocities: bool = False) -> NamedVector:
    """Messages with some names, checked against what the middleware reads from them."""
    vector = NamedVector(names, velocities)
    numbers = [0.0] * len(names)
    same = JointState(name=list(names), position=numbers, velocity=numbers if velocities else [])
    if deserialize_message(vector.template, JointState) != same:
        raise ModelError(f"the names {', '.join(names)} cannot be sent as sensor_msgs/msg/JointState; rename them")
    return vector
