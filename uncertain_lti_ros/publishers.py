# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Publishers of the node's outputs: messages are laid out for topics with subscribers, then sent together."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import DurabilityPolicy, QoSProfile

from uncertain_lti.monitor.catch_up import MOST
from uncertain_lti.monitor.outputs import OUTPUTS, REASON, VIOLATION
from uncertain_lti.monitor.session import Session
from uncertain_lti.monitor.verdict import Verdict
from uncertain_lti.monitor.verdict_messages import FALSE, TRUE, Encoder, VerdictMessages, text_message
from uncertain_lti_ros.messages import message_class
from uncertain_lti_ros.outputs import sendable
from uncertain_lti_ros.polled_events import PolledEvents

_OUTPUT_DEPTH = MOST // 5  # samples that a start or a stall may send at once; what readers have is kept no longer
_SLOW = 0.0001  # s to send one message; it takes 3 to 10 µs, unless Fast DDS makes the way to a reader anew each time
_PATIENCE = 60  # samples that are sent so slowly, less those that are not; a busy machine delays one of many
_REST = 4.0  # times what the last try took pass until the next
_LAST_WORDS = 1.0  # s that the end waits until readers have the last messages
_WHEN = {
    "message": ("message",),
    "judged": ("message", "judged"),
    "predicted": ("predicted",),
    "predicted over": ("predicted over",),
}
"""Of a message without a verdict, one with a verdict and predictions: which outputs are published."""


class OutputPublisher:
    """One topic of the node, and how many listen to it; takes serialised messages.

    Parameters
    ----------
    node : LifecycleNode
        The node.
    kind : type
        Message class.
    name : str
        Of the topic, below the node's.
    qos : QoSProfile
        What is offered.
    changed : callable
        Called when there are more or fewer listeners.

    Attributes
    ----------
    send : callable
        Publishes the bytes of a message.
    poll : callable
        Reads the events of the middleware.
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
        """Take another number.

        Parameters
        ----------
        count : int
            Subscriptions.
        """
        self._listeners = count
        self._changed()

    def _matched(self, event: Any) -> None:
        self.listeners = event.current_count

    def destroy(self, patience: float) -> None:
        """Stop publishing, once every reliable reader has everything.

        Parameters
        ----------
        patience : float
            How long that is waited for at most, s.
        """
        if self._listeners:
            self._publisher.wait_for_all_acked(Duration(seconds=patience))
        self._events.destroy()
        self._node.destroy_lifecycle_publisher(self._publisher)


_Heard = tuple[list[OutputPublisher], Encoder]
"""Publishers of vectors that somebody listens to, and what makes their messages of a verdict."""


class Outputs:
    """The publishers of all `OUTPUTS`.

    Parameters
    ----------
    node : LifecycleNode
        The node.
    now : float
        Steady time, s.

    Attributes
    ----------
    publishers : dict of str to OutputPublisher
        By name of the output; empty while the node is not configured.
    alarm_sent : float
        When ~/violation was last published, steady time in s.
    held_back : int
        Verdicts that were not published, as sending took so long that inputs would have been lost.
    """

    def __init__(self, node: LifecycleNode, now: float) -> None:
        self._node = node
        self.publishers: dict[str, OutputPublisher] = {}
        self.alarm_sent = now
        self._reason_sent = ""
        # By what they are published for, None where nobody listens; empty when it must be made again.
        self._heard: dict[str, _Heard | None] = {}
        self._alarm_heard = self._reason_heard = False
        self.held_back, self._slow, self._until = 0, 0, -math.inf

    def open(self, heartbeat: float) -> None:
        """Make the publishers.

        Parameters
        ----------
        heartbeat : float
            Deadline that ~/violation offers, s.
        """
        qos = QoSProfile(depth=_OUTPUT_DEPTH)
        beat = QoSProfile(depth=_OUTPUT_DEPTH, deadline=Duration(seconds=heartbeat))
        kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        offers = {VIOLATION: beat, REASON: kept}
        for output in OUTPUTS:
            offered = offers.get(output, qos)
            kind = message_class(output.type)
            self.publishers[output.name] = OutputPublisher(self._node, kind, output.name, offered, self._heard.clear)
        self._violation, self._reason = self.publishers[VIOLATION.name], self.publishers[REASON.name]
        self._reason_sent = ""

    def prepare(self, session: Session) -> None:
        """Lay out the messages of a model and its alarm.

        Parameters
        ----------
        session : Session
            Has both.
        """
        model = session.model
        self._messages = VerdictMessages(model.state_names, sendable, model.steps, session.monitor.alarms.names)
        self._heard.clear()

    def _listen(self) -> None:
        """Choose the vectors that somebody listens to, and lay out their messages."""
        vectors = self._messages.outputs
        for made_for, when in _WHEN.items():
            names = [name for name in vectors if vectors[name].when in when and self.publishers[name].listeners]
            heard = [self.publishers[name] for name in names], self._messages.encoder(names)
            self._heard[made_for] = heard if names else None
        self._alarm_heard, self._reason_heard = self._violation.listeners > 0, self._reason.listeners > 0

    def poll(self) -> None:
        """Update the numbers of listeners."""
        for publisher in self.publishers.values():
            publisher.poll()

    def publish(self, session: Session, verdicts: Sequence[Verdict], opened: bool, now: float, turned: bool) -> None:
        """Publish on the topics that have subscribers.

        First all messages are laid out, then all are sent together: threads of the middleware that are woken by
        one message then find the others too, and need not be woken again.

        A subscriber that stands still can make sending a hundred times slower, so that inputs would be lost. Then
        verdicts are held back, but for a try now and then; the alarm is published when it changes.

        Parameters
        ----------
        session : Session
            Gives the alarm and the prediction.
        verdicts : sequence of Verdict
            On the clock messages that were decided.
        opened : bool
            A sample was opened, from which bounds can be predicted.
        now : float
            Steady time, s.
        turned : bool
            The alarm changed; it is published in any case.
        """
        if not self._heard:
            self._listen()
        heard = self._heard
        messages: list[tuple[OutputPublisher, bytes]] = []
        if self._slow >= _PATIENCE and time.monotonic() < self._until:
            self.held_back += len(verdicts)
            verdicts, opened = (), False
        for verdict in verdicts:
            judged = verdict.judged
            if made := heard.get("judged" if judged else "message"):
                publishers, encode = made
                messages += zip(publishers, encode(verdict), strict=True)
            turned = turned or (judged and self._alarm_heard)
        if opened and (made := heard.get("predicted")) and (expected := session.predict()) is not None:
            publishers, encode = made
            messages += zip(publishers, encode(expected), strict=True)
        if opened and (made := heard.get("predicted over")) and (foreseen := session.foresee()) is not None:
            publishers, encode = made
            messages += zip(publishers, encode(foreseen), strict=True)
        if turned:
            self.alarm_sent = now
            messages.append((self._violation, TRUE if session.alarm else FALSE))
        if messages:
            self._send(messages)
        if self._reason_heard:
            self.send_reason(session.reasons.text)

    def _send(self, messages: Sequence[tuple[OutputPublisher, bytes]]) -> None:
        began = time.monotonic()
        for publisher, message in messages:
            publisher.send(message)
        took = (ended := time.monotonic()) - began
        slow = self._slow + (1 if took > _SLOW * len(messages) else -1)
        self._slow = max(0, min(slow, 2 * _PATIENCE))
        self._until = ended + _REST * took

    @property
    def problems(self) -> list[str]:
        """Why verdicts are held back, one sentence; empty if they are not."""
        if self._slow < _PATIENCE:
            return []
        return [
            "a subscriber of the outputs stands still: sending to it takes so long that most verdicts are not "
            "published, the alarm is"
        ]

    def send_alarm(self, alarm: bool, now: float) -> None:
        """Publish ~/violation.

        Parameters
        ----------
        alarm : bool
            Whether the alarm is raised.
        now : float
            Steady time, s.
        """
        self.alarm_sent = now
        self._violation.send(TRUE if alarm else FALSE)

    def send_reason(self, text: str) -> None:
        """Publish ~/reason if it has changed.

        Parameters
        ----------
        text : str
            What is said now.
        """
        if text != self._reason_sent:
            self._reason_sent = text
            self._reason.send(text_message(text))

    def close(self) -> None:
        """Stop publishing, once readers have what was published last."""
        end = time.monotonic() + _LAST_WORDS
        for publisher in self.publishers.values():
            publisher.destroy(max(0.0, end - time.monotonic()))
        self.publishers.clear()
