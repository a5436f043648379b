# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Values of the node's parameters, in the types of what uses them."""

from __future__ import annotations

from typing import Any

from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.validate_topic_name import validate_topic_name

from uncertain_lti.base.errors import ModelError
from uncertain_lti.monitor.session import Rule
from uncertain_lti_ros.parameters import RULE
from uncertain_lti_ros.subscriptions import DURABILITY, RELIABILITY, RequestedQos

MIB = 1 << 20
"""Bytes; parameters of size are in MiB."""


class Settings:
    """What the parameters of a node are set to.

    `node`: its parameters are declared; `largest_message`: bytes of the largest message that is read.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._reals: dict[str, float] = {}
        self.largest_message = self.size("largest_message")

    def value(self, name: str) -> Any:
        """A parameter as it is set."""
        return self._node.get_parameter(name).value

    def real(self, name: str) -> float:
        """A parameter that is a number."""
        if name not in self._reals:  # a call of rclpy takes 10 µs
            self._reals[name] = float(self._node.get_parameter(name).value)
        return self._reals[name]

    def size(self, name: str) -> int:
        """A parameter that is a size in MiB."""
        return round(self.real(name) * MIB)

    def changed(self) -> None:
        """Read the parameters again: some were set."""
        self._reals.clear()
        self.largest_message = self.size("largest_message")

    def rule(self, changes: dict[str, Any]) -> Rule:
        """The alarm rule that the parameters define."""
        return Rule(**{name: changes.get(name, self.value(name)) for name in RULE})

    def requested_qos(self) -> RequestedQos:
        """The quality of service that the parameters request."""
        chosen: dict[str, Any] = {}
        for name, known in (("reliability", RELIABILITY), ("durability", DURABILITY)):
            text = self.value(f"qos.{name}")
            if text != "match" and text not in known:
                raise ModelError(f"parameter qos.{name} is {text!r}; choose match, {' or '.join(known)}")
            chosen[name] = known.get(text)
        return RequestedQos(self.value("qos.depth"), **chosen)

    def topic_prefix(self) -> str:
        """What is put before every topic of the model."""
        prefix = str(self.value("topic_prefix")).rstrip("/")
        try:
            if prefix:
                validate_topic_name(prefix)
        except InvalidTopicNameException:
            raise ModelError(
                f"parameter topic_prefix is {prefix!r}; names consist of letters, digits, _ and /, as in /robot1"
            ) from None
        return prefix

    def check_snapshots(self, on_alarm: bool) -> None:
        """Refuse snapshots on an alarm without a folder for them."""
        if on_alarm and not self.value("snapshot.folder"):
            raise ModelError(
                "parameter snapshot.on_alarm is true, and snapshot.folder is empty; set the one to false, or start the "
                "node with the other"
            )
