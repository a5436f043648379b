"""How every process here lives: rclpy started, one executor, an end by signal with everything put away."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import rclpy
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

_PATIENCE = 0.1  # s that a signal waits at most
_RESPITE = 0.01  # s of rest after an error, which may come again at once


class Life:
    """One node on one executor; `alive` turns false on SIGINT and SIGTERM.

    The events executor keeps messages in order of arrival; without a time limit its calls keep a core busy and
    deliver nothing in some releases, so it is driven by timed calls. Where it is absent the default executor takes
    its place, which delivers messages that arrive together in order of subscription. The multi-threaded one
    loses messages and is not used.
    """

    def __init__(self, node: Node, stop: list[int]) -> None:
        self.node = node
        self._stop = stop
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

    def spin_once(self, seconds: float = _PATIENCE) -> None:
        """Wait for work at most this long, and do what is there."""
        self.executor.spin_once(timeout_sec=min(seconds, _PATIENCE))

    def spin(self, note: Callable[[str, Exception], None]) -> None:
        """Work until the end; an error that a callback lets through is noted, and the work goes on."""
        never: Future = Future(executor=self.executor)
        while self.alive:
            try:
                # As `spin_once`, for as many callbacks as there are: the way back here costs 8 µs for each.
                self.executor.spin_until_future_complete(never, timeout_sec=_PATIENCE)
            except Exception as error:
                if self.alive:
                    note("in the executor", error)
                    time.sleep(_RESPITE)


@contextmanager
def living(make_node: Any, args: list[str] | None = None) -> Iterator[Life]:
    """Start rclpy (on these arguments, or those of the process), make the node, and put all away at the end."""
    stop: list[int] = []
    before = {name: signal.signal(name, lambda number, _: stop.append(number)) for name in _SIGNALS}
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    node = None
    try:
        node = make_node()
        yield Life(node, stop)
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        for name, handler in before.items():
            signal.signal(name, handler)


_SIGNALS = (signal.SIGINT, signal.SIGTERM)
