# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""How every process here runs: rclpy started, one executor, an orderly end by signal, and what a terminal shows."""

from __future__ import annotations

import argparse
import math
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path
from typing import Any

import rclpy
from rclpy.exceptions import InvalidHandle, InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from uncertain_lti_ros.arguments import ArgumentError, hold_domain, hold_overrides, in_words

_LATENCY = 0.1  # s that a signal waits at most
_SPIN = 30.0  # s between two checks whether rclpy has been shut down from elsewhere
_PAUSE = 0.01  # s after an error, which may occur again at once
_LAST = 20  # s that taking the middleware down may take after a signal


class Life:
    """One node on one executor; `alive` turns false on SIGINT and SIGTERM.

    The events executor keeps messages in order of arrival; without a time limit its calls keep a core busy and
    deliver nothing in some releases, so it is driven by timed calls. If it is absent the default executor
    is used, which delivers messages that arrive together in order of subscription. The multi-threaded one
    loses messages and is not used.

    `node`: the node; `stop`: signals received; the list is filled in elsewhere.
    """

    def __init__(self, node: Node, stop: list[int]) -> None:
        self.node = node
        self._stop = stop
        self._end: Future | None = None
        try:
            from rclpy.experimental import EventsExecutor

            self.executor: Executor = EventsExecutor()
            self.executor_name = "events executor"
        except ImportError:
            self.executor = SingleThreadedExecutor()
            self.executor_name = "default executor (messages that arrive together may swap)"
        self.executor.add_node(node)

    @property
    def alive(self) -> bool:
        """No signal was received and rclpy is not shut down."""
        return not self._stop and rclpy.ok()

    @property
    def signal(self) -> int | None:
        """The first signal received; None before."""
        return self._stop[0] if self._stop else None

    def spin_once(self, seconds: float = _LATENCY) -> None:
        """Wait for work, and do it."""
        self.executor.spin_once(timeout_sec=min(seconds, _LATENCY))

    def spin(self, note: Callable[[str, Exception], None]) -> None:
        """Work until the end; an error that a callback lets through is noted, and the work goes on.

        The node must have a timer: a signal is handled only when Python runs.
        """
        while self.alive:
            self._end = Future(executor=self.executor)
            try:
                # As `spin_once`, for as many callbacks as there are: each return to here costs 8 µs. And
                # rarely: in some releases each of these calls leaks 32 bytes.
                self.executor.spin_until_future_complete(self._end, timeout_sec=_SPIN)
            except InvalidHandle:
                pass  # an event of a subscription that is being replaced; it is not needed
            except Exception as error:
                if self.alive:
                    note("in the executor", error)
                    time.sleep(_PAUSE)

    def end(self) -> None:
        """Return from `spin` as soon as possible: a signal was received."""
        if self._end is not None and not self._end.done():
            self._end.set_result(None)


def spare_the_middleware() -> None:
    """Have Fast DDS wake its threads rarely; call it before rclpy starts. A profile of the user takes precedence."""
    given = any(os.environ.get(name) for name in ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"))
    if given or Path("DEFAULT_FASTRTPS_PROFILES.xml").exists() or Path("DEFAULT_FASTDDS_PROFILES.xml").exists():
        return
    profile = files("uncertain_lti_ros") / "fastdds_writers.xml"
    if isinstance(profile, Path) and profile.is_file():
        os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(profile)


@contextmanager
def living(make_node: Any, args: list[str] | None = None) -> Iterator[Life]:
    """Start rclpy with these ROS arguments, make the node, and destroy both at the end.

    Fast DDS 2.14 waits for ever for its own listeners when a participant is destroyed while it comes to know another.
    After a signal SIGALRM then ends the process, as no Python runs meanwhile.
    """
    hold_domain(os.environ.get("ROS_DOMAIN_ID", ""))
    args = list(args or [])
    stop: list[int] = []
    lives: list[Life] = []

    def end(number: int, _: Any) -> None:
        stop.append(number)
        for life in lives:
            life.end()

    before = {name: signal.signal(name, end) for name in _SIGNALS}
    node = None
    try:
        try:
            rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
            node = make_node()
        except (RuntimeError, InvalidParameterTypeException, InvalidParameterValueException) as error:
            # RuntimeError: what rcl raises, under names that rclpy does not export
            raise ArgumentError(in_words(error)) from None
        hold_overrides(node, args)
        lives.append(Life(node, stop))
        yield lives[0]
    finally:
        if stop:
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(_LAST)
        for life in lives:
            life.executor.shutdown()  # before its node: the middleware calls into it as long as it knows the entities
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        signal.alarm(0)
        # A process often gets the signal twice, from the terminal and from its parent.
        for name, handler in before.items():
            signal.signal(name, signal.SIG_IGN if stop else handler)


_SIGNALS = (signal.SIGINT, signal.SIGTERM)


_hushed = False


def hush(wanted: bool) -> None:
    """Suppress messages to the terminal from here on, or allow them again."""
    global _hushed
    _hushed = wanted


def say(text: str) -> None:
    """Remark to the person who waits, apart from the result."""
    if not _hushed:
        print(text, file=sys.stderr, flush=True)


def tell(text: str) -> None:
    """Part of the result."""
    if not _hushed:
        print(text, flush=True)


def seconds(text: str) -> float:
    """Parse an argument that is a time: a finite number, 0 or more."""
    value = _number(text)
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is not a time; give seconds, 0 or more")
    return value


def speed(text: str) -> float:
    """Parse an argument that is a speed, times real time: a finite number above 0."""
    value = _number(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is not a speed; give a number above 0, such as 1 or 0.5")
    return value


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


class Progress:
    """One line on standard error that is written over, where that is a terminal."""

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty() and not _hushed
        self._shown = 0.0

    def show(self, text: str) -> None:
        """Show the text, at most five times a second."""
        if self._terminal and time.monotonic() - self._shown > 0.2:
            self._shown = time.monotonic()
            print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)

    def clear(self) -> None:
        """Take the line away."""
        if self._terminal and self._shown:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
