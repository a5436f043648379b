# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What is published of each verdict: messages are laid out for outputs with subscribers, then sent together."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

try:
    import cython
except ImportError:  # Cython is not needed to run
    from uncertain_lti.base import uncompiled as cython

from uncertain_lti.base.compiled import use_twin
from uncertain_lti.monitor.outputs import REASON, VIOLATION
from uncertain_lti.monitor.stream import Stream
from uncertain_lti.monitor.verdict import Verdict
from uncertain_lti.monitor.verdict_messages import FALSE, TRUE, Encoder, VerdictMessages, text_message

_SLOW = 0.0001  # s to send one message; it takes 3 to 10 µs, unless Fast DDS makes the way to a reader anew each time
_PATIENCE = 60  # samples that are sent so slowly, less those that are not; a busy machine delays one of many
_REST = 4.0  # times what the last try took pass until the next


class Publisher(Protocol):
    """What sends the bytes of messages on one topic, and how many listen to it."""

    listeners: int
    send: Any


@cython.cclass
class _Heard:
    """Publishers of vectors that somebody listens to, and what makes their messages of a verdict."""

    publishers: list[Any]
    encoder: Encoder

    def __init__(self, publishers: Sequence[Publisher], encoder: Encoder) -> None:
        self.publishers, self.encoder = list(publishers), encoder

    @cython.cfunc
    def lay_out(self, verdict: Any, publishers: list[Any], messages: list[bytes]) -> None:
        """Add the messages of a verdict, or of what is predicted, and who sends each."""
        publishers += self.publishers
        messages += self.encoder(verdict)


@cython.cclass
class Sender:
    """Sends what is published of verdicts.

    `now`: steady time, s; `alarm_sent`: when ~/violation was last published, steady time in s; `held_back`: verdicts
    that were not published, as sending took so long that inputs would have been lost.
    """

    alarm_sent: float = cython.declare(cython.double, visibility="readonly")
    held_back: int = cython.declare(cython.Py_ssize_t, visibility="readonly")
    _slow: cython.Py_ssize_t
    _until: cython.double
    _publishers: Mapping[str, Publisher] = cython.declare(object)
    _messages: VerdictMessages = cython.declare(object)
    _reason_sent: str = cython.declare(object)
    _known: cython.bint  # who listens; otherwise it must be found out
    _given: Any  # None where nobody listens, for a message without a verdict, one with, and what is predicted
    _judged: Any
    _predicted: Any
    _foreseen: Any
    _violation: Any
    _reason: Any
    _alarm_heard: cython.bint
    _reason_heard: cython.bint

    def __init__(self, now: float) -> None:
        self.alarm_sent, self.held_back = now, 0
        self._slow, self._until = 0, -math.inf
        self._known = self._alarm_heard = self._reason_heard = False
        self._reason_sent = ""
        self._given = self._judged = self._predicted = self._foreseen = None

    def open(self, publishers: Mapping[str, Publisher]) -> None:
        """Send through other publishers from now on."""
        self._publishers = publishers
        self._violation, self._reason = publishers[VIOLATION.name], publishers[REASON.name]
        self._reason_sent, self._known = "", False

    def prepare(self, messages: VerdictMessages) -> None:
        """Lay out other messages from now on."""
        self._messages, self._known = messages, False

    def changed(self) -> None:
        """There are more or fewer listeners of some publisher; whether sending to them is slow is seen anew."""
        self._known, self._slow = False, 0

    def _heard(self, *when: str) -> Any:
        outputs = self._messages.outputs
        names = [name for name in outputs if outputs[name].when in when and self._publishers[name].listeners]
        return _Heard([self._publishers[name] for name in names], self._messages.encoder(names)) if names else None

    def _listen(self) -> None:
        """Choose the vectors that somebody listens to, and lay out their messages."""
        self._given, self._judged = self._heard("message"), self._heard("message", "judged")
        self._predicted, self._foreseen = self._heard("predicted"), self._heard("predicted over")
        self._alarm_heard, self._reason_heard = self._violation.listeners > 0, self._reason.listeners > 0
        self._known = True

    def publish(self, session: Stream, verdicts: Sequence[Verdict], opened: bool, now: float, turned: bool) -> None:
        """Publish on the topics that have subscribers.

        First all messages are laid out, then all are sent together: threads of the middleware that are woken by
        one message then find the others too, and need not be woken again.

        A subscriber that stands still can make sending a hundred times slower, so that inputs would be lost. Then
        verdicts are held back, but for a try now and then; the alarm is published when it changes.
        """
        heard: _Heard
        if not self._known:
            self._listen()
        publishers: list[Any] = []
        messages: list[bytes] = []
        if self._slow >= _PATIENCE and time.monotonic() < self._until:
            self.held_back += len(verdicts)
            verdicts, opened = (), False
        for verdict in verdicts:
            judged: cython.bint = verdict.judged
            heard = self._judged if judged else self._given
            if heard is not None:
                heard.lay_out(verdict, publishers, messages)
            if judged and self._alarm_heard:
                turned = True
        if opened and self._predicted is not None and (expected := session.predict()) is not None:
            heard = self._predicted
            heard.lay_out(expected, publishers, messages)
        if opened and self._foreseen is not None and (foreseen := session.foresee()) is not None:
            heard = self._foreseen
            heard.lay_out(foreseen, publishers, messages)
        if turned:
            self.alarm_sent = now
            publishers.append(self._violation)
            messages.append(TRUE if session.alarm else FALSE)
        if messages:
            self._send(publishers, messages)
        if self._reason_heard:
            self.send_reason(session.reasons.text)

    @cython.cfunc
    def _send(self, publishers: list[Any], messages: list[bytes]) -> None:
        i: cython.Py_ssize_t
        began: cython.double = time.monotonic()
        for i in range(len(messages)):
            publishers[i].send(messages[i])
        ended: cython.double = time.monotonic()
        slow: cython.bint = ended - began > _SLOW * len(messages)
        if slow or self._slow > 0:
            self._slow = min(self._slow + 1, 2 * _PATIENCE) if slow else self._slow - 1
            self._until = ended + _REST * (ended - began)

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
        """Publish ~/violation."""
        self.alarm_sent = now
        self._violation.send(TRUE if alarm else FALSE)

    def send_reason(self, text: str) -> None:
        """Publish ~/reason if it has changed."""
        if text != self._reason_sent:
            self._reason_sent = text
            self._reason.send(text_message(text))


if not cython.compiled:
    use_twin(globals(), ("Sender",))
