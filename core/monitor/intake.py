# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What a live monitor does with each message: it is accepted, judged, remembered, and what follows is published.

Messages are laid out for outputs with subscribers, then sent together.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import cython

from uncertain_lti.monitor.catch_up import Waiting, arrival_of
from uncertain_lti.monitor.outputs import FALSE, FLAGS, REASON, TRUE, VIOLATION, Encoder, VerdictMessages, text_message
from uncertain_lti.monitor.snapshot import Entry
from uncertain_lti.monitor.stream import Stream
from uncertain_lti.monitor.verdict import Verdict

_AT_ONCE, _PAUSE = 200, 0.01  # messages that had waited are taken so many at once, with so many s in between
_SLOW_FLAGS, _SLOW = 3e-4, 2e-4  # s of processor time for a message; 5 to 40 µs, beside others 0.26 ms, at a stand 0.36
_PATIENCE = 60  # messages of one topic that are sent so slowly, less those that are not
_REST_OF_FLAGS, _REST = 1.5, 6.0  # times its processor time pass after a slow message; of others, for each slow topic
_FORGET = 1.0  # s without a message of a topic, and how slow it was is found out again


class Publisher(Protocol):
    """What sends the bytes of messages on one topic, and how many listen to it."""

    listeners: int
    send: Any


@cython.cclass
class _Way:
    """The way to the readers of one topic, and how slow it is.

    `most`: s that a message may take; `tried`: steady time of the last one, s; `until`: none before this steady time.
    """

    name: str
    send: Any
    most: cython.double
    slow: cython.Py_ssize_t
    tried: cython.double
    until: cython.double

    def __init__(self, name: str, publisher: Publisher) -> None:
        self.name, self.send, self.most = name, publisher.send, _SLOW_FLAGS if name == FLAGS.name else _SLOW
        self.slow, self.tried, self.until = 0, -math.inf, -math.inf


@cython.cclass
class Sender:
    """Sends what is published of verdicts.

    `now`: steady time, s; `alarm_sent`: when ~/violation was last published, steady time in s; `held_back`: messages
    that were not published, as sending on their topic took so long that inputs would have been lost.
    """

    alarm_sent: float = cython.declare(cython.double, visibility="readonly")
    held_back: int = cython.declare(cython.Py_ssize_t, visibility="readonly")
    _ways: dict[str, Any]
    _publishers: Mapping[str, Publisher] = cython.declare(object)
    _messages: VerdictMessages = cython.declare(object)
    _reason_sent: str = cython.declare(object)
    _doubted: cython.double  # until when what messages take is measured by the processor's time
    _known: cython.bint  # who listens; otherwise it must be found out
    _given: (
        Any  # of a message without a verdict: ways of what somebody listens to, and its encoder; None if nobody does
    )
    _judged: Any
    _predicted: Any
    _foreseen: Any
    _violation: Any
    _reason: Any
    _alarm_heard: cython.bint
    _reason_heard: cython.bint

    def __init__(self, now: float) -> None:
        self.alarm_sent, self.held_back = now, 0
        self._ways, self._doubted = {}, -math.inf
        self._known = self._alarm_heard = self._reason_heard = False
        self._reason_sent = ""

    def open(self, publishers: Mapping[str, Publisher]) -> None:
        """Send through other publishers from now on."""
        self._publishers = publishers
        self._violation, self._reason = publishers[VIOLATION.name], publishers[REASON.name]
        self._reason_sent, self._known = "", False

    def prepare(self, messages: VerdictMessages) -> None:
        """Lay out other messages from now on."""
        self._messages, self._known = messages, False

    def changed(self) -> None:
        """There are more or fewer listeners, or nothing is sent for now; which ways are slow is found out again."""
        self._known, self._ways = False, {}

    def _heard(self, *when: str) -> tuple[list[Any], Encoder] | None:
        outputs = self._messages.outputs
        names = [name for name in outputs if outputs[name].when in when and self._publishers[name].listeners]
        return ([self._ways[name] for name in names], self._messages.encoder(names)) if names else None

    def _listen(self) -> None:
        """Choose the vectors that somebody listens to, and lay out their messages."""
        self._ways = {name: _Way(name, publisher) for name, publisher in self._publishers.items()}
        self._given, self._judged = self._heard("message"), self._heard("message", "judged")
        self._predicted, self._foreseen = self._heard("predicted"), self._heard("predicted over")
        self._alarm_heard, self._reason_heard = self._violation.listeners > 0, self._reason.listeners > 0
        self._known = True

    def publish(self, session: Stream, verdicts: Sequence[Verdict], opened: bool, now: float, turned: bool) -> None:
        """Publish on the topics that have subscribers.

        First all messages are laid out, then all are sent together: threads of the middleware that are woken by
        one message then find the others too, and need not be woken again.

        A subscriber that stands still can make sending on its topics a hundred times slower, so that inputs would be
        lost. Then messages of these topics are held back as far as they would take too much of the processor.
        """
        if not self._known:
            self._listen()
        ways: list[Any] = []
        messages: list[bytes] = []
        beats: cython.bint = False
        for verdict in verdicts:
            judged: cython.bint = verdict.judged
            heard = self._judged if judged else self._given
            if heard is not None:
                self._lay_out(heard, verdict, ways, messages)
            beats = beats or judged
        if beats and self._alarm_heard and not turned:
            self.alarm_sent = now
            ways.append(self._ways[VIOLATION.name])
            messages.append(TRUE if session.alarm else FALSE)
        if opened and self._predicted is not None and (expected := session.predict()) is not None:
            self._lay_out(self._predicted, expected, ways, messages)
        if opened and self._foreseen is not None and (foreseen := session.foresee()) is not None:
            self._lay_out(self._foreseen, foreseen, ways, messages)
        if messages:
            self._send(ways, messages)
        if turned:
            self.send_alarm(session.alarm, now)
        if self._reason_heard and (beats or turned or "no verdict:" in session.reasons.text):
            self.send_reason(session.reasons.text)  # else it is that of an earlier sample: `Session.reason` has more

    @cython.cfunc
    def _lay_out(self, heard: tuple[list[Any], Any], verdict: Any, ways: list[Any], messages: list[bytes]) -> None:
        """Add the messages of a verdict, or of what is predicted, and the way that each goes."""
        to, encode = heard
        ways += to
        messages += encode(verdict)

    @cython.cfunc
    def _send(self, ways: list[Any], messages: list[bytes]) -> None:
        i: cython.Py_ssize_t
        way: _Way
        # The time of the processor, which may be busy with others, costs a call of the system: it is asked for only
        # where a message took long lately.
        doubted: cython.bint = time.monotonic() < self._doubted
        clock: Any = time.thread_time if doubted else time.monotonic
        began: cython.double = clock()
        for i in range(len(messages)):
            way = ways[i]
            if way.slow >= _PATIENCE and self._rests(way):
                continue
            way.send(messages[i])
            ended: cython.double = clock()
            if ended - began > way.most and not doubted:
                self._doubted = ended + _FORGET
            elif ended - began > way.most:
                self._was_slow(way, ended - began)
            elif way.slow > 0:
                way.slow -= 1
            began = ended

    @cython.cfunc
    def _rests(self, way: _Way) -> cython.bint:
        """Whether a message is held back on a slow way."""
        now: cython.double = time.monotonic()
        if now - way.tried >= _FORGET:
            way.slow = 0
            return False
        if now >= way.until:
            return False
        self.held_back += 1
        return True

    @cython.cfunc
    def _was_slow(self, way: _Way, took: cython.double) -> None:
        now: cython.double = time.monotonic()
        if now - way.tried >= _FORGET:
            way.slow = 0
        way.slow, way.tried, self._doubted = min(way.slow + 1, 2 * _PATIENCE), now, now + _FORGET
        rest: cython.double = _REST_OF_FLAGS if way.name == FLAGS.name else _REST * len(self.slow_topics())
        way.until = now + rest * took

    def slow_topics(self) -> list[str]:
        """Outputs whose messages are held back in part, as sending them takes too long."""
        way: _Way
        now, found = time.monotonic(), []
        for way in self._ways.values():
            if way.slow >= _PATIENCE and now - way.tried < _FORGET:
                found.append(way.name)
        return found

    @property
    def problems(self) -> list[str]:
        """On which outputs messages are held back, one sentence; none if there are none."""
        if not (names := self.slow_topics()):
            return []
        topics = ", ".join(f"~/{name}" for name in names)
        return [f"a subscriber of {topics} stands still: sending to it takes so long that messages are held back there"]

    def send_alarm(self, alarm: bool, now: float) -> None:
        """Publish ~/violation."""
        self.alarm_sent = now
        self._violation.send(TRUE if alarm else FALSE)

    def send_reason(self, text: str) -> None:
        """Publish ~/reason if it has changed."""
        if text != self._reason_sent:
            self._reason_sent = text
            self._reason.send(text_message(text))


@cython.cclass
class Intake:
    """Takes the messages of a live monitor.

    `sender`: publishes; `memory`: remembers messages for snapshots: unless `recent` is None, `add` takes an `Entry` and
    whether it raised the alarm, and `alarm_over` the steady time in s; `turned`: told of a change of the alarm: the
    session, the verdicts and the steady time in s; `failed`: told of an unexpected error: where it was, and the error;
    `session`: judges; None while there is no model; `active`: whether messages are taken; `clock`: gives the time of
    arrival in ns; None for the time of the system.
    """

    session: Any = cython.declare(object, visibility="public")
    active: bool = cython.declare(cython.bint, visibility="public")
    clock: Callable[[], int] | None = cython.declare(object, visibility="public")
    _sender: Sender
    _memory: Any
    _turned: Any
    _failed: Any
    _arrived_ns: cython.longlong  # the last message

    def __init__(
        self,
        sender: Sender,
        memory: Any,
        turned: Callable[[Any, Sequence[Verdict], float], None],
        failed: Callable[[str, Exception], None],
    ) -> None:
        self._sender, self._memory, self._turned, self._failed = sender, memory, turned, failed
        self.session, self.active, self.clock, self._arrived_ns = None, False, None, 0

    def message(self, topic: str, data: bytes, sent_ns: int = 0, received_ns: int = 0) -> None:
        """Take a message; `sent_ns`, `received_ns`: when it was published, and received; 0 if that is not known."""
        session = self.session
        if session is None or not self.active:
            return
        now = time.monotonic()
        try:
            taken_ns = time.time_ns()
            self._arrived_ns = arrival_of(received_ns, taken_ns, self._arrived_ns)
            arrival_ns = self._arrived_ns if self.clock is None else self.clock()
            late = (taken_ns - sent_ns) * 1e-9 if sent_ns else 0.0
            messages = session.accept(topic, arrival_ns, data, now, sent_ns, late)
        except Exception as error:
            self._failed(f"on a message of {topic}", error)
            session.failed()
        else:
            self._take_all(session, messages, now)

    def waiting(self, all_of_them: bool = False) -> None:
        """Take messages that need not wait any longer."""
        if self.session is not None and self.active:
            now = time.monotonic()
            self._take_all(self.session, self.session.release(now, all_of_them), now)

    @cython.cfunc
    def _take_all(self, session: Any, messages: Sequence[Waiting], now: float) -> None:
        number: cython.Py_ssize_t = 0
        for message in messages:
            number += 1
            if number % _AT_ONCE == 0:  # readers would have to ask again for much of a longer burst of outputs
                time.sleep(_PAUSE)
            topic, arrival_ns, data = message
            try:
                self._take(session, topic, arrival_ns, data, now)
            except Exception as error:
                self._failed(f"on a message of {topic}", error)
                session.failed()

    @cython.cfunc
    def _take(self, session: Any, topic: str, arrival_ns: int, data: bytes, now: float) -> None:
        alarms, before = session.alarms, session.alarm
        verdicts, opened = session.take(topic, arrival_ns, data, now)
        alarm = session.alarm
        turned = alarm != before
        if turned:
            self._turned(session, verdicts, now)
        if self._memory.recent is not None:
            self._memory.add(Entry(now, arrival_ns, topic, data, verdicts, alarm), session.alarms > alarms)
        if turned and not alarm:
            self._memory.alarm_over(now)
        if opened or verdicts or turned:
            self._sender.publish(session, verdicts, opened, now, turned)
