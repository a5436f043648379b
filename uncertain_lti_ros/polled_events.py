# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Events of the middleware on a publisher or subscription, polled instead of handed to the executor.

An event that arrives while the executor removes its handler makes the events executor of Jazzy run Python without
Python's lock, and the process dies (ros2/rclpy, issue 1644). So what is destroyed while the process lives has its
handlers taken out of the node, and a timer polls them.
"""

from __future__ import annotations

from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription

POLL = 0.1
"""s between two polls: who listens, and publishers that changed, are known that late at most."""


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
            changes = (getattr(status, name, 0) for name in ("total_count_change", "current_count_change"))
            if status is not None and any(changes):
                handler.callback(status)

    def destroy(self) -> None:
        """Destroy the handlers; before their entity."""
        for handler in self._handlers:
            handler.destroy()
        self._handlers.clear()


class _WaitSet:
    """A wait set in which everything is ready; a status without changes costs nothing."""

    def add_event(self, _: Any) -> int:
        return 0

    def is_ready(self, _kind: str, _index: int) -> bool:
        return True


_EVERY = _WaitSet()
