"""How every process here lives: rclpy started, one executor, an end by signal with everything put away."""

from __future__ import annotations

import os
import signal
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

from uncertain_lti_ros.arguments import ArgumentError, hold_overrides, in_words

_PATIENCE = 0.1  # s that a signal waits at most
_SPELL = 30.0  # s between two looks at whether rclpy has been shut down by somebody else
_RESPITE = 0.01  # s of rest after an error, which may come again at once


class Life:
    """One node on one executor; `alive` turns false on SIGINT and SIGTERM.

    The events executor keeps messages in order of arrival; without a time limit its calls keep a core busy and
    deliver nothing in some releases, so it is driven by timed calls. Where it is absent the default executor takes
    its place, which delivers messages that arrive together in order of subscription. The multi-threaded one
    loses messages and is not used.

    Parameters
    ----------
    node : Node
        The node.
    stop : list of int
        Signals that have come; the list is filled in elsewhere.
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
        """No signal has come and nobody has shut rclpy down."""
        return not self._stop and rclpy.ok()

    @property
    def signal(self) -> int | None:
        """The first signal that came; None while none has."""
        return self._stop[0] if self._stop else None

    def spin_once(self, seconds: float = _PATIENCE) -> None:
        """Wait for work, and do what is there.

        Parameters
        ----------
        seconds : float, optional
            How long at most, s; never longer than the default.
        """
        self.executor.spin_once(timeout_sec=min(seconds, _PATIENCE))

    def spin(self, note: Callable[[str, Exception], None]) -> None:
        """Work until the end; an error that a callback lets through is noted, and the work goes on.

        The node must have a timer: a signal is seen when Python comes to run.

        Parameters
        ----------
        note : callable
            Takes where an error came from, and the error.
        """
        while self.alive:
            self._end = Future(executor=self.executor)
            try:
                # As `spin_once`, for as many callbacks as there are: the way back here costs 8 µs for each. And
                # seldom: in some releases each of these calls costs 32 bytes that never come back.
                self.executor.spin_until_future_complete(self._end, timeout_sec=_SPELL)
            except InvalidHandle:
                pass  # an event came for a subscription that is being replaced; nobody wants it
            except Exception as error:
                if self.alive:
                    note("in the executor", error)
                    time.sleep(_RESPITE)

    def end(self) -> None:
        """Come back from `spin` as soon as may be: a signal has come."""
        if self._end is not None and not self._end.done():
            self._end.set_result(None)


def spare_the_middleware() -> None:
    """Have Fast DDS wake its threads seldom; before rclpy starts. A profile of the user's own goes before."""
    given = any(os.environ.get(name) for name in ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"))
    if given or Path("DEFAULT_FASTRTPS_PROFILES.xml").exists() or Path("DEFAULT_FASTDDS_PROFILES.xml").exists():
        return
    profile = files("uncertain_lti_ros") / "fastdds_writers.xml"
    if isinstance(profile, Path) and profile.is_file():
        os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(profile)


@contextmanager
def living(make_node: Any, args: list[str] | None = None) -> Iterator[Life]:
    """Start rclpy on these ROS arguments, make the node, and put all away at the end.

    Parameters
    ----------
    make_node : callable
        Makes the node.
    args : list of str, optional
        ROS arguments.

    Yields
    ------
    Life
        Of the node, until the block ends.

    Raises
    ------
    ArgumentError
        An argument, or a setting of the middleware, cannot be used; or a parameter is given that the node does not
        have, or a value that it cannot take.
    """
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
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        # Who was told to end is often told twice, by the terminal and by what started it.
        for name, handler in before.items():
            signal.signal(name, signal.SIG_IGN if stop else handler)


_SIGNALS = (signal.SIGINT, signal.SIGTERM)
