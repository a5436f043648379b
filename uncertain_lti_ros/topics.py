# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Topics: their message classes, subscriptions that take the quality of service offered, outputs, diagnostics.

Events of the middleware are polled instead of handed to the executor: one that arrives while the executor removes its
handler makes the events executor of Jazzy run Python without Python's lock, and the process dies (ros2/rclpy, issue
1644). So what is destroyed while the process lives has its handlers taken out of the node, and a timer polls them.
"""

from __future__ import annotations

import importlib
import math
import re
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rclpy.type_hash import TypeHash
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from uncertain_lti.base.errors import ModelError, SignalError
from uncertain_lti.base.text import plural
from uncertain_lti.monitor.catch_up import MOST
from uncertain_lti.monitor.intake import Sender
from uncertain_lti.monitor.outputs import OUTPUTS, REASON, VIOLATION, NamedVector, VerdictMessages, names_of
from uncertain_lti.monitor.session import Report, Session
from uncertain_lti.signals.field_path import FieldType, full_name
from uncertain_lti.signals.values import TABLE

_ARRAY = re.compile(r"(?P<element>[^\[\]]+)\[(?P<count>\d+)\]")
_SEQUENCE = re.compile(r"sequence<(?P<element>[^,]+?)(?:,\s*(?P<bound>\d+))?>")
_NUMBERS = {
    "float": "float32", "double": "float64", "char": "char",
    **{f"{sign}int{bits}": f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)},
}  # fmt: skip


@cache
def message_class(type_name: str) -> Any:
    """Class of a message type such as `sensor_msgs/msg/JointState`."""
    parts = type_name.split("/")
    package, name = parts[0], parts[-1]
    if type_name == TABLE:
        raise SignalError("the model is of a table, which no publisher sends; fit one to recordings of topics")
    if not (len(parts) == 2 or (len(parts) == 3 and parts[1] == "msg")) or not (package and name.isidentifier()):
        raise SignalError(f"{type_name!r} is not a message type; one reads like sensor_msgs/msg/JointState")
    try:
        module = importlib.import_module(f"{package}.msg")
    except ImportError as error:
        missing = (getattr(error, "name", None) or package).split(".")[0]
        raise SignalError(
            f"{type_name}: the Python package {missing} is not installed; install it "
            f"(ros-$ROS_DISTRO-{missing.replace('_', '-')}), or build and source the workspace that defines it"
        ) from None
    found = getattr(module, name, None)
    if not hasattr(found, "get_fields_and_field_types"):
        raise SignalError(f"{type_name}: the installed Python package {package} has no message {name}; update it")
    return found


def live_fields(type_name: str) -> Mapping[str, FieldType]:
    """Fields of an installed message type."""
    described = message_class(type_name).get_fields_and_field_types()
    return {name: _field_type(text) for name, text in described.items()}


def _split(text: str) -> tuple[str, int | None, str]:
    """Element type, array length as in FieldType, and the array as a .msg file writes it."""
    if match := _ARRAY.fullmatch(text):
        return match["element"], int(match["count"]), f"[{match['count']}]"
    if match := _SEQUENCE.fullmatch(text):
        return match["element"], 0, f"[<={match['bound']}]" if match["bound"] else "[]"
    return text, None, ""


def _field_type(text: str) -> FieldType:
    element, array, _ = _split(text)
    if element in _NUMBERS:
        return FieldType("number", _NUMBERS[element], array)
    if element.startswith(("string", "wstring")):
        return FieldType("string", element, array)
    if "/" in element:
        return FieldType("message", full_name(element), array)
    if element == "boolean":
        return FieldType("bool", "bool", array)
    return FieldType("other", "byte" if element == "octet" else element, array)


def stamp_ns(message: Any) -> int:
    """The header stamp of a message, ns."""
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def definition(type_name: str) -> str:
    """Definition of an installed type and of all it uses, as MCAP's schema encoding `ros2msg` wants it.

    Constants and default values are not in it: a class does not hold them, and no reader of messages needs them.
    """
    names, parts = [full_name(type_name)], list[str]()
    for name in names:  # and those that are found in it
        if parts:
            package, _, short = name.split("/")
            parts.append(f"{'=' * 80}\nMSG: {package}/{short}\n")
        lines = []
        for field, text in message_class(name).get_fields_and_field_types().items():
            element, _, array = _split(text)
            if "/" in element and full_name(element) not in names:
                names.append(full_name(element))
            written = {"boolean": "bool", "octet": "byte"}.get(element, _NUMBERS.get(element, element))
            written = re.sub(r"<(\d+)>", r"<=\1", written)  # a bounded string
            lines.append(f"{written}{array} {field}\n")
        parts += lines or ["uint8 structure_needs_at_least_one_member\n"]
    return "".join(parts)


POLL = 0.1
"""s between two polls: who listens, and publishers that changed, are known that late at most."""
CLOCK = "/clock"
DEPTH = 1000
"""Messages kept until they are taken: the graph does not show the depth of the publishers' queues."""
RELIABILITY = {"reliable": ReliabilityPolicy.RELIABLE, "best_effort": ReliabilityPolicy.BEST_EFFORT}
DURABILITY = {"volatile": DurabilityPolicy.VOLATILE, "transient_local": DurabilityPolicy.TRANSIENT_LOCAL}
_NEVER_NS = 2**62
"""A deadline of this or more means none."""
_MESSAGE_ONLY, _WITH_INFO = (SimpleNamespace(value=kind.value) for kind in Subscription.CallbackType)
_OUTPUT_DEPTH = MOST // 5  # samples that a start or a stall may send at once; what readers have is kept no longer
_LAST_WORDS = 1.0  # s that the end waits until readers have the last messages


class PolledEvents:
    """Event handlers of one publisher or subscription, outside the executor.

    `node`: owner of the entity; `entity`: just created: the executor has not seen it yet.
    """

    def __init__(self, node: Node, entity: Publisher | Subscription) -> None:
        handlers: Any = entity.event_handlers  # a list
        self._handlers: list[Any] = list(handlers)
        handlers.clear()  # the node no longer destroys them with the entity
        for handler in self._handlers:
            node.remove_waitable(handler)
            handler.add_to_wait_set(_EVERY)

    def poll(self) -> None:
        """Call the callbacks of what has changed since the last poll."""
        for handler in self._handlers:
            handler.is_ready(_EVERY)
            status = handler.take_data()
            if any(getattr(status, name, 0) for name in ("total_count_change", "current_count_change")):
                handler.callback(status)

    def destroy(self) -> None:
        """Destroy the handlers; before their entity."""
        for handler in self._handlers:
            handler.destroy()
        self._handlers.clear()


_EVERY = SimpleNamespace(add_event=lambda _: 0, is_ready=lambda kind, index: True)
"""A wait set in which everything is ready; a status without changes costs nothing."""


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
    reliability = RELIABILITY["reliable" if reliable else "best_effort"]
    durability = DURABILITY["transient_local" if lasting and history else "volatile"]
    return QoSProfile(
        deadline=Duration(nanoseconds=max(deadlines)) if promised else Duration(),
        depth=requested.depth,
        reliability=requested.reliability or reliability,
        durability=requested.durability or durability,
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


class _Plain(Subscription):
    """A subscription without properties and enumerations.

    The executor looks four of them up for every message, which takes as long as to take the message.
    """

    handle: Any = None  # of each one, as is the next
    callback: Any = None
    CallbackType: Any = SimpleNamespace(MessageOnly=_MESSAGE_ONLY)


class MatchedSubscription:
    """Subscription to one topic whose QoS `look` compares with the graph.

    `node`: the node; `topic`: as in the model or on the command line; expanded and remapped by the node; `type_name`:
    `pkg/msg/Type`; `callback`: takes the bytes of a message, when it was published, by its publisher, and received, ns;
    `requested`: what the user requests; `received, lost, late`: messages received, those lost on the way or in the
    queue, and deadlines missed by publishers; `publishers`: publishers of this type that the graph knows; `published`:
    since when there are some, steady time in s; infinite without any; `qos`: what is asked of them now; `problems`:
    publishers that cannot be heard and why, one sentence each.

    The middleware reports what its writer gives up, and not what full queues of this reader push out; the numbers that
    a publisher gives its messages show both, as long as it is the only one.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        type_name: str,
        callback: Callable[[Any, int, int], None],
        requested: RequestedQos = RequestedQos(),
    ) -> None:
        self._node, self._asked_topic, self.type_name = node, topic, full_name(type_name)
        self._class, self._callback, self._requested = message_class(type_name), callback, requested
        self.topic: str = node.resolve_topic_name(topic)
        self.received = self.late = self.publishers = 0
        self._reported_lost = self._skipped = 0  # as the middleware has it, and by the numbers of the messages
        self._number: int | None = None  # of the last message
        self._alone = False  # one publisher sends all messages since that one
        self._left = math.inf  # number of the last message of the publisher before the one that sends now
        self._turns = deque[float](maxlen=3)  # when that publisher went on
        self.problems: list[str] = []
        self.look_soon = False
        self.published = math.inf  # since when there are publishers, steady time in s
        self._subscription: Subscription | None = None
        self.look()

    @property
    def lost(self) -> int:
        """Messages lost on the way or in the queue; those that both ways of counting show count once."""
        return max(self._reported_lost, self._skipped)

    def look(self) -> None:
        """Compare the subscription with what publishers offer now, and replace it if it must change."""
        self.look_soon = False
        infos = self._node.get_publishers_info_by_topic(self._asked_topic)
        offers = [i.qos_profile for i in infos if i.topic_type == self.type_name]
        self.publishers = len(offers)
        if len(offers) == 1 and not self._alone:
            self._number = None
        self._alone = len(offers) == 1
        self.published = min(self.published, time.monotonic()) if offers else math.inf
        if self._subscription is None:
            self._subscribe(choose_qos(offers, self._requested))
        elif offers:  # when the last publisher leaves, the next one is likely to offer the same
            lasting = self.qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
            qos = choose_qos(offers, self._requested, history=lasting or not self.received)
            if _policies(qos) != _policies(self.qos):
                self.destroy()
                self._subscribe(qos)
        why = {f"cannot be heard, {problem}" for offer in offers for problem in incompatible(self.qos, offer)}
        if self._has_another_version(infos):
            why.add(f"sends another version of {self.type_name}, which may be misread; build both from the same one")
        others = {info.topic_type for info in infos} - {self.type_name}
        why |= {f"sends {other}, and {self.type_name} is wanted" for other in others}
        self.problems = [f"{self.topic}: a publisher {what}" for what in sorted(why)]

    def _has_another_version(self, publishers: Iterable[TopicEndpointInfo]) -> bool:
        """Whether one of them has a type of this name with other fields, which the middleware takes for the same."""
        readers = self._node.get_subscriptions_info_by_topic(self._asked_topic)
        me = self._node.get_name(), self._node.get_namespace()
        ours = {str(i.topic_type_hash) for i in readers if (i.node_name, i.node_namespace) == me}
        theirs = {str(i.topic_type_hash) for i in publishers if i.topic_type == self.type_name}
        return bool(ours and theirs - ours - {str(TypeHash())})  # that of no ROS node

    def takes_turns(self) -> bool:
        """Whether messages of several publishers come by turns, at the usual pace of these turns."""
        if self.publishers < 2 or len(self._turns) < 3:
            return False
        first, *_, last = self._turns
        return time.monotonic() - last <= last - first + 1.0

    def destroy(self) -> None:
        """Stop receiving."""
        if self._subscription is not None:
            self._events.destroy()
            self._node.destroy_subscription(self._subscription)
            self._subscription = None

    def poll(self) -> None:
        """Read the events of the middleware: publishers that came or left, messages lost, deadlines missed."""
        if self._subscription is not None:
            self._events.poll()

    def _subscribe(self, qos: QoSProfile) -> None:
        self.qos = qos
        events = SubscriptionEventCallbacks(
            incompatible_qos=self._changed, matched=self._changed, message_lost=self._lost, deadline=self._missed
        )
        self._number = None
        self._subscription = subscription = self._node.create_subscription(
            self._class, self._asked_topic, self._take, qos, event_callbacks=events, raw=True
        )
        handle, subscription.__class__ = subscription.handle, _Plain
        vars(subscription).update(handle=handle, callback=self._take, _callback_type=_WITH_INFO)
        self._events = PolledEvents(self._node, subscription)

    def _take(self, *given: Any) -> None:
        """A message with its number; the events executor of Jazzy gives both as one argument."""
        message, info = given if len(given) == 2 else given[0]
        self.received += 1
        number, before = info["publication_sequence_number"], self._number
        if before is not None:  # a middleware numbers all messages, or none
            if number <= before:  # they come from several publishers
                self._alone = False
            elif self._alone:
                self._skipped += number - before - 1
            if number != before + 1:
                goes_on = self._left < number and (number <= before or self._left > before)
                if goes_on:
                    self._turns.append(time.monotonic())
                if goes_on or number <= before:
                    self._left = before
        self._number = number
        self._callback(message, info["source_timestamp"], info["received_timestamp"])

    def _changed(self, _: Any) -> None:
        self.look_soon, self._alone = True, False

    def _missed(self, event: Any) -> None:
        self.late += event.total_count_change

    def _lost(self, event: Any) -> None:
        self._reported_lost += event.total_count_change


class SimulatedTime:
    """The time of /clock, ns, as a message comes; rclpy forgets all but the last tick while the node is busy."""

    def __init__(self, node: Node) -> None:
        self._ns, qos = 0, QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        node.create_subscription(Clock, CLOCK, self._take, qos)

    def __call__(self) -> int:
        """Give it; 0 before the first tick."""
        return self._ns

    def _take(self, tick: Clock) -> None:
        self._ns = tick.clock.sec * 10**9 + tick.clock.nanosec


def sendable(names: Sequence[str], velocities: bool = False) -> NamedVector:
    """Messages with some names, checked against what the middleware reads from them."""
    vector = NamedVector(names, velocities)
    numbers = [0.0] * len(names)
    same = JointState(name=list(names), position=numbers, velocity=numbers if velocities else [])
    if deserialize_message(vector.template, JointState) != same:
        raise ModelError(f"the names {', '.join(names)} cannot be sent as sensor_msgs/msg/JointState; rename them")
    return vector


class OutputPublisher:
    """One topic of the node, and how many listen to it; takes serialised messages.

    `node`: the node; `kind`: message class; `name`: of the topic, below the node's; `qos`: what is offered;
    `listeners`: subscriptions at the last poll; `send`: publishes the bytes of a message; `look`: logs who cannot
    listen, by the events of the middleware.
    """

    def __init__(self, node: LifecycleNode, kind: Any, name: str, qos: QoSProfile) -> None:
        self._node, self.listeners = node, 0
        self._publisher = node.create_lifecycle_publisher(kind, f"~/{name}", qos)
        self._events = PolledEvents(node, self._publisher)
        self.look = self._events.poll
        # Past the check of the lifecycle state: the node publishes only while it is active.
        self.send = self._publisher.handle.publish_raw

    def poll(self) -> bool:
        """Count the listeners, and whether there are more or fewer; events would cost ten times as much."""
        before, self.listeners = self.listeners, self._publisher.handle.get_subscription_count()
        return self.listeners != before

    def destroy(self, patience: float) -> None:
        """Stop publishing, once every reliable reader has everything."""
        if self.listeners:
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
            kind, offered = message_class(output.type), offers.get(output, qos)
            self.publishers[output.name] = OutputPublisher(self._node, kind, output.name, offered)
        self.sender.open(self.publishers)

    def prepare(self, session: Session) -> None:
        """Lay out the messages of a model and its alarm."""
        model = session.model
        names = names_of(model.state_names, model.steps, session.monitor.alarms.names)
        self.sender.prepare(VerdictMessages(names, sendable))

    def poll(self) -> None:
        """Update the numbers of listeners."""
        if any([publisher.poll() for publisher in self.publishers.values()]):
            self.sender.changed()

    def look(self) -> None:
        """Log who asks for what is not offered."""
        for publisher in self.publishers.values():
            publisher.look()

    def close(self) -> None:
        """Stop publishing, once readers have what was published last."""
        end = time.monotonic() + _LAST_WORDS
        for publisher in self.publishers.values():
            publisher.destroy(max(0.0, end - time.monotonic()))
        self.publishers.clear()


_UNHEARD = 2.0  # s without a first message although there are publishers


class Diagnostics:
    """Publisher of the node's reports.

    `node`: gives its name; `hardware_id`: of every status; empty for the node's name; `publisher`: of the topic.
    """

    def __init__(self, node: Node, hardware_id: str) -> None:
        self.publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._name = node.get_fully_qualified_name().lstrip("/")
        self._hardware_id = hardware_id or node.get_name()
        self._reported: dict[str, tuple[int, int]] = {}  # topic: lost and late messages up to the last report

    def publish(self, reports: Sequence[Report], stamp: Any, model: str) -> None:
        """Publish one message."""
        message = DiagnosticArray()
        message.header.stamp = stamp
        for report in reports:
            values = {"model": model, **report.values} if report is reports[0] else report.values
            status = DiagnosticStatus(level=bytes([report.level]), name=f"{self._name}: {report.name}")
            status.message, status.hardware_id = report.message, self._hardware_id
            status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
            message.status.append(status)
        self.publisher.publish(message)

    def problems(self, inputs: Mapping[str, MatchedSubscription]) -> list[str]:
        """What keeps messages from coming, and what was lost since the last report."""
        problems, now = list[str](), time.monotonic()
        for topic, subscription in inputs.items():
            problems += subscription.problems
            if not subscription.received and (waited := now - subscription.published) > _UNHEARD:
                heard = plural(subscription.publishers, "publisher")
                problems.append(f"{subscription.topic}: nothing received in {waited:.0f} s, and there is {heard}")
            lost, late = self._reported.get(topic, (0, 0))
            if subscription.lost > lost:
                of = f"{plural(subscription.lost - lost, 'message')} lost"
                problems.append(f"{subscription.topic}: {of} on the way, or as the queue was full (qos.depth)")
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
