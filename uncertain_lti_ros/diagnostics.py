# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Diagnostics: reports of the node on /diagnostics, with counts of its subscriptions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.duration import Duration
from rclpy.node import Node

from uncertain_lti.base.text import plural
from uncertain_lti.monitor.session import Report
from uncertain_lti_ros.topics import MatchedSubscription

_UNHEARD = 2.0  # s without a first message although there are publishers


class Diagnostics:
    """Publisher of the node's reports.

    `node`: gives its name; `hardware_id`: of every status; empty for the node's name.
    """

    def __init__(self, node: Node, hardware_id: str) -> None:
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._name = node.get_fully_qualified_name().lstrip("/")
        self._hardware_id = hardware_id or node.get_name()
        self._reported: dict[str, tuple[int, int]] = {}  # topic: lost and late messages up to the last report

    @property
    def listeners(self) -> int:
        """Number of subscriptions to the topic."""
        return int(self._publisher.get_subscription_count())

    def publish(self, reports: Sequence[Report], stamp: Any, model: str) -> None:
        """Publish one message."""
        message = DiagnosticArray()
        message.header.stamp = stamp
        for report in reports:
            values = {"model": model, **report.values} if report is reports[0] else report.values
            message.status.append(
                DiagnosticStatus(
                    level=bytes([report.level]),
                    name=f"{self._name}: {report.name}",
                    message=report.message,
                    hardware_id=self._hardware_id,
                    values=[KeyValue(key=key, value=value) for key, value in values.items()],
                )
            )
        self._publisher.publish(message)

    def wait(self, seconds: float) -> None:
        """Wait until every reader has every report."""
        self._publisher.wait_for_all_acked(Duration(seconds=seconds))

    def problems(self, inputs: Mapping[str, MatchedSubscription]) -> list[str]:
        """What keeps messages from coming, and what was lost since the last report."""
        problems = []
        for topic, subscription in inputs.items():
            problems += subscription.problems
            if (waited := subscription.nothing_for()) > _UNHEARD:
                heard = plural(subscription.publishers, "publisher")
                problems.append(f"{subscription.topic}: nothing received in {waited:.0f} s, and there is {heard}")
            lost, late = self._reported.get(topic, (0, 0))
            if subscription.lost > lost:
                problems.append(f"{subscription.topic}: {subscription.lost - lost} messages lost on the way")
            if subscription.late > late:
                problems.append(f"{subscription.topic}: {subscription.late - late} deadlines missed by its publishers")
        return problems

    def reported(self, inputs: Mapping[str, MatchedSubscription]) -> None:
        """The counts so far have been reported."""
        self._reported = {topic: (subscription.lost, subscription.late) for topic, subscription in inputs.items()}


def input_values(inputs: Mapping[str, MatchedSubscription]) -> dict[str, str]:
    """Counts and quality of service of subscriptions, for a report."""
    found: dict[str, str] = {}
    for topic, subscription in inputs.items():
        found |= {
            f"publishers {topic}": str(subscription.publishers),
            f"lost {topic}": str(subscription.lost),
            f"deadlines missed {topic}": str(subscription.late),
            f"qos {topic}": f"{subscription.qos.reliability.name} {subscription.qos.durability.name}".lower(),
        }
    return found
