# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What a live monitor does with each message: it is accepted, judged, remembered, and what follows is published."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import cython

from uncertain_lti.monitor.catch_up import Waiting
from uncertain_lti.monitor.sender import Sender
from uncertain_lti.monitor.snapshot import Entry
from uncertain_lti.monitor.verdict import Verdict

_AT_ONCE, _PAUSE = 200, 0.01  # messages that had waited are taken so many at once, with so many s in between


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

    def __init__(
        self,
        sender: Sender,
        memory: Any,
        turned: Callable[[Any, Sequence[Verdict], float], None],
        failed: Callable[[str, Exception], None],
    ) -> None:
        self._sender, self._memory, self._turned, self._failed = sender, memory, turned, failed
        self.session, self.active, self.clock = None, False, None

    def message(self, topic: str, data: bytes) -> None:
        """Take a message as it arrives."""
        session = self.session
        if session is None or not self.active:
            return
        now = time.monotonic()
        try:
            arrival_ns = time.time_ns() if self.clock is None else self.clock()
            messages = session.accept(topic, arrival_ns, data, now)
        except Exception as error:
            self._note(session, topic, error)
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
                self._note(session, topic, error)

    @cython.cfunc
    def _note(self, session: Any, topic: str, error: Exception) -> None:
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
