# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Publishers of the node's outputs, and who listens to them."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import DurabilityPolicy, QoSProfile

from uncertain_lti.monitor.catch_up import MOST
from uncertain_lti.monitor.outputs import OUTPUTS, REASON, VIOLATION
from uncertain_lti.monitor.sender import Sender
from uncertain_lti.monitor.session import Session
from uncertain_lti.monitor.verdict_messages import VerdictMessages
from uncertain_lti_ros.messages import message_class
from uncertain_lti_ros.outputs import sendable
from uncertain_lti_ros.polled_events import PolledEvents

_OUTPUT_DEPTH = MOST // 5  # samples that a start or a stall may send at once; what readers have is kept no longer
_LAST_WORDS = 1.0  # s that the end waits until readers have the last messages


class OutputPublisher:
    """One topic of the node, and how many listen to it; takes serialised messages.

    `node`: the node; `kind`: message class; `name`: of the topic, below the node's; `qos`: what is offered; `changed`:
    called when there are more or fewer listeners; `send`: publishes the bytes of a message; `poll`: reads the events of
    the middleware.
    """

    def __init__(self, node: LifecycleNode, kind: Any, name: str, qos: QoSProfile, changed: Callable[[], None]) -> None:
        events = PublisherEventCallbacks(matched=self._matched)
        self._node = node
        self._publisher = node.create_lifecycle_publisher(kind, f"~/{name}", qos, event_callbacks=events)
        self._events = PolledEvents(node, self._publisher)
        self.poll = self._events.poll
        self._changed = changed
        self.listeners = 0
        # Past the check of the lifecycle state: the node publishes only while it is active.
        self.send = self._publisher.handle.publish_raw

    @property
    def listeners(self) -> int:
        """Subscriptions at the last poll."""
        return self._listeners

    @listeners.setter
    def listeners(self, count: int) -> None:
        """Take another number."""
        self._listeners = count
        self._changed()

    def _matched(self, event: Any) -> None:
        self.listeners = event.current_count

    def destroy(self, patience: float) -> None:
        """Stop publishing, once every reliable reader has everything."""
        if self._listeners:
            self._publisher.wait_for_all_acked(Duration(seconds=patience))
        self._events.destroy()
        self._node.destroy_lifecycle_publisher(self._publisher)


class Outputs:
    """The publishers of all `OUTPUTS`.

    `node`: the node; `now`: steady time, s; `sender`: publishes on them; `publishers`: by name of the output; empty
    while the node is not configured.
    """

    def __init__(self, node: LifecycleNode, now: float) -> None:
        self._node = node
        self.sender = Sender(now)
        self.publishers: dict[str, OutputPublisher] = {}

    def open(self, heartbeat: float) -> None:
        """Make the publishers."""
        qos = QoSProfile(depth=_OUTPUT_DEPTH)
        beat = QoSProfile(depth=_OUTPUT_DEPTH, deadline=Duration(seconds=heartbeat))
        kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        offers = {VIOLATION: beat, REASON: kept}
        for output in OUTPUTS:
            offered = offers.get(output, qos)
            kind = message_class(output.type)
            self.publishers[output.name] = OutputPublisher(self._node, kind, output.name, offered, self.sender.changed)
        self.sender.open(self.publishers)

    def prepare(self, session: Session) -> None:
        """Lay out the messages of a model and its alarm."""
        model = session.model
        self.sender.prepare(VerdictMessages(model.state_names, sendable, model.steps, session.monitor.alarms.names))

    def poll(self) -> None:
        """Update the numbers of listeners."""
        for publisher in self.publishers.values():
            publisher.poll()

    def close(self) -> None:
        """Stop publishing, once readers have what was published last."""
        end = time.monotonic() + _LAST_WORDS
        for publisher in self.publishers.values():
            publisher.destroy(max(0.0, end - time.monotonic()))
        self.publishers.clear()
