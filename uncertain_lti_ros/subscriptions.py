# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Subscription that takes the quality of service its publishers offer, and follows them when they change."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from uncertain_lti_ros.messages import full_name
from uncertain_lti_ros.polled_events import PolledEvents

DEPTH = 1000
"""Messages kept until they are taken: the graph does not show the depth of the publishers' queues."""
RELIABILITY = {"reliable": ReliabilityPolicy.RELIABLE, "best_effort": ReliabilityPolicy.BEST_EFFORT}
DURABILITY = {"volatile": DurabilityPolicy.VOLATILE, "transient_local": DurabilityPolicy.TRANSIENT_LOCAL}
_NEVER_NS = 2**62
"""A deadline of this or more means none."""


@dataclass(frozen=True)
class RequestedQos:
    """Quality of service that a user requests for subscriptions.

    `depth`: messages kept until they are taken; `reliability`: none for what the publishers offer; `durability`: none
    for what the publishers offer.
    """

    depth: int = DEPTH
    reliability: ReliabilityPolicy | None = None
    durability: DurabilityPolicy | None = None


def choose_qos(offers: Iterable[QoSProfile], requested: RequestedQos, history: bool = True) -> QoSProfile:
    """The quality of service that is compatible with the publishers.

    Reliable only if every publisher is, transient local only if every publisher is; without any, reliable and volatile.
    The deadline is the longest that publishers offer, and none where one of them offers none.
    """
    offers = list(offers)
    reliable = all(o.reliability == ReliabilityPolicy.RELIABLE for o in offers)
    lasting = bool(offers) and all(o.durability == DurabilityPolicy.TRANSIENT_LOCAL for o in offers)
    deadlines = [o.deadline.nanoseconds for o in offers]
    promised = bool(deadlines) and all(0 < d < _NEVER_NS for d in deadlines)
    return QoSProfile(
        deadline=Duration(nanoseconds=max(deadlines)) if promised else Duration(),
        history=HistoryPolicy.KEEP_LAST,
        depth=requested.depth,
        reliability=requested.reliability
        or (ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT),
        durability=requested.durability
        or (DurabilityPolicy.TRANSIENT_LOCAL if lasting and history else DurabilityPolicy.VOLATILE),
    )


def incompatible(asked: QoSProfile, offered: QoSProfile) -> list[str]:
    """What is requested and a publisher does not offer, in words."""
    found = []
    if asked.reliability == ReliabilityPolicy.RELIABLE != offered.reliability:
        found.append("reliability: best effort is offered, reliable asked")
    if asked.durability == DurabilityPolicy.TRANSIENT_LOCAL != offered.durability:
        found.append("durability: volatile is offered, transient local asked")
    return found


def _policies(qos: QoSProfile) -> tuple[Any, ...]:
    """What must be compatible between publishers and subscribers."""
    return qos.reliability, qos.durability, qos.deadline.nanoseconds % _NEVER_NS


class MatchedSubscription:
    """Subscription to one topic whose QoS `look` compares with the graph.

    `node`: the node; `topic`: as in the model or on the command line; expanded and remapped by the node; `type_name`:
    `pkg/msg/Type`; `message_class`: class of the type; `callback`: takes the message, or its bytes when raw;
    `requested`: what the user requests; `raw`: whether the callback takes bytes; `received, lost, late`: messages
    received, those lost on the way or in the queue, and deadlines missed by publishers; `last`: the last message;
    `publishers`: publishers of this type that the graph knows; `problems`: publishers that cannot be heard and why, one
    sentence each.

    The middleware reports what its writer gives up, and not what full queues of this reader push out; the numbers that
    a publisher gives its messages show both, as long as it is the only one.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        type_name: str,
        message_class: Any,
        callback: Callable[[Any], None],
        requested: RequestedQos = RequestedQos(),
        raw: bool = False,
    ) -> None:
        self._node, self._asked_topic, self.type_name = node, topic, full_name(type_name)
        self._class, self._callback, self._requested, self._raw = message_class, callback, requested, raw
        self.topic: str = node.resolve_topic_name(topic)
        self.received = self.late = self.publishers = 0
        self.last: Any = None
        self._reported_lost = self._skipped = 0  # as the middleware has it, and by the numbers of the messages
        self._number: int | None = None  # of the last message
        self._alone = False  # one publisher sends all messages since that one
        self.problems: list[str] = []
        self.look_soon = False
        self._published: float | None = None  # since when there are publishers, steady time in s
        self._subscription: Subscription | None = None
        self._events: PolledEvents | None = None
        self.look()

    def nothing_for(self) -> float:
        """How long there have been publishers and not a single message, s; 0 without publishers."""
        return 0.0 if self.received or self._published is None else time.monotonic() - self._published

    @property
    def lost(self) -> int:
        """Messages lost on the way or in the queue; those that both ways of counting show count once."""
        return max(self._reported_lost, self._skipped)

    @property
    def qos(self) -> QoSProfile:
        """What is asked of publishers now."""
        return self._qos

    def look(self) -> None:
        """Compare the subscription with what publishers offer now, and replace it if it must change."""
        self.look_soon = False
        infos = self._node.get_publishers_info_by_topic(self._asked_topic)
        offers = [i.qos_profile for i in infos if i.topic_type == self.type_name]
        self.publishers = len(offers)
        if not self._alone:
            self._number = None
        self._alone = len(offers) == 1
        if not offers:
            self._published = None
        elif self._published is None:
            self._published = time.monotonic()
        if self._subscription is None:
            self._subscribe(choose_qos(offers, self._requested))
        elif offers:  # when the last publisher leaves, the next one is likely to offer the same
            lasting = self._qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
            qos = choose_qos(offers, self._requested, history=lasting or not self.received)
            if _policies(qos) != _policies(self._qos):
                self.destroy()
                self._subscribe(qos)
        self.problems = sorted(
            {f"{self.topic}: a publisher cannot be heard, {p}" for o in offers for p in incompatible(self._qos, o)}
            | {
                f"{self.topic}: a publisher sends {i.topic_type}, and {self.type_name} is wanted"
                for i in infos
                if i.topic_type != self.type_name
            }
        )

    def destroy(self) -> None:
        """Stop receiving."""
        if self._subscription is not None and self._events is not None:
            self._events.destroy()
            self._node.destroy_subscription(self._subscription)
            self._subscription = self._events = None

    def poll(self) -> None:
        """Read the events of the middleware: publishers that came or left, messages lost, deadlines missed."""
        if self._events is not None:
            self._events.poll()

    def _subscribe(self, qos: QoSProfile) -> None:
        self._qos = qos
        events = SubscriptionEventCallbacks(
            incompatible_qos=self._changed,
            matched=self._changed,
            message_lost=self._lost,
            deadline=self._missed,
        )
        self._number = None
        self._subscription = self._node.create_subscription(
            self._class, self._asked_topic, self._take, qos, event_callbacks=events, raw=self._raw
        )
        # so that the message comes with its number; the events executor of Jazzy then gives both as one argument
        self._subscription._callback_type = Subscription.CallbackType.WithMessageInfo
        self._events = PolledEvents(self._node, self._subscription)

    def _take(self, *given: Any) -> None:
        message, info = given if len(given) == 2 else given[0]
        self.received, self.last = self.received + 1, message
        number, before = info["publication_sequence_number"], self._number
        if before is not None and number is not None and number != before + 1:
            self._count_skipped(number - before - 1)
        self._number = number
        self._callback(message)

    def _count_skipped(self, skipped: int) -> None:
        """Take a jump in the numbers of messages; it says nothing if they fall, or come from several publishers."""
        if skipped < 0:
            self._alone = False
        elif self._alone:
            self._skipped += skipped

    def _changed(self, _: Any) -> None:
        self.look_soon, self._alone = True, False

    def _missed(self, event: Any) -> None:
        self.late += event.total_count_change

    def _lost(self, event: Any) -> None:
        self._reported_lost += event.total_count_change
