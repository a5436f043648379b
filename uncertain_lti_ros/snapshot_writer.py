# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Snapshots of the node: what it keeps in memory for them, and when it writes one."""

from __future__ import annotations

import math
from collections.abc import Iterable

from rclpy.node import Node

from uncertain_lti.base.errors import ModelError, UncertainLTIError
from uncertain_lti.monitor.outputs import RECORDED, names_of
from uncertain_lti.monitor.reason import Reasons
from uncertain_lti.monitor.session import Session
from uncertain_lti.monitor.snapshot import Album, Entry, Recent, Scene
from uncertain_lti_ros.parameters import Settings
from uncertain_lti_ros.topics import definition

_SERVICE_WAIT = 0.2  # s that ~/snapshot waits for its file


class Snapshots:
    """The last seconds of a node, written to a file when a service asks for it or after an alarm.

    `node`: gives its name and its topics; `settings`: the parameters `snapshot.*` of the node; `recent`: the messages
    in memory; None while there is no folder to write to, or no session.
    """

    def __init__(self, node: Node, settings: Settings) -> None:
        self._node, self._settings = node, settings
        self.recent: Recent | None = None
        self._album: Album | None = None
        self._due: float | None = None
        self._alarmed = -math.inf  # when an alarm was last over

    def open(self) -> None:
        """Keep messages from now on, if there is a folder to write to."""
        folder = self._settings["snapshot.folder"]
        self._settings.check_snapshots(self._settings["snapshot.on_alarm"])
        if folder:
            limit = self._settings.size("snapshot.megabytes")
            name = self._node.get_fully_qualified_name()
            self._album = Album(folder, name, self._settings["snapshot.keep"], limit)
            self.recent = Recent(self._settings["snapshot.seconds"], self._settings.size("snapshot.memory"))

    def close(self, session: Session | None) -> None:
        """Write what is due, and forget all messages."""
        self.write_due(session, math.inf)
        if self._album is not None:
            self._album.close()
        self._album = self.recent = self._due = None

    def clear(self, session: Session | None, but: Iterable[str]) -> None:
        """Write what is due, and forget all but the last messages of some topics: another model reads the next ones."""
        self.write_due(session, math.inf)
        if self.recent is not None:
            self.recent.clear(but)

    def add(self, entry: Entry, raised: bool) -> None:
        """Keep one more message; call it while `recent` is not None."""
        assert self.recent is not None
        self.recent.add(entry)
        # no alarm for as long as a snapshot goes back: one that flaps must not replace the first file
        if raised and self._due is None and entry.now - self._alarmed >= self._settings["snapshot.seconds"]:
            self._due = entry.now + self._settings["snapshot.after"]

    def alarm_over(self, now: float) -> None:
        """The alarm is over."""
        self._alarmed = now

    def write_due(self, session: Session | None, now: float) -> None:
        """Begin to write the snapshot of an alarm, if it is due; `now`: steady time, s."""
        if session is None or self._album is None or self._due is None or now < self._due:
            return
        if not self._settings["snapshot.on_alarm"]:
            self._due = None
        elif not self._album.busy:
            self._due = None
            try:
                self._node.get_logger().info(f"alarm: {self._album.take(self._scene(session, 'alarm'), 0.0)}")
            except UncertainLTIError as error:
                self._node.get_logger().error(str(error))

    def write(self, session: Session | None) -> str:
        """Write the last seconds to a file."""
        if self._album is None or session is None:
            if self._settings["snapshot.folder"]:
                raise ModelError("the node is not configured, so there is nothing to write")
            raise ModelError("parameter snapshot.folder is empty; start the node with a folder for snapshots")
        return self._album.take(self._scene(session, "asked for"), _SERVICE_WAIT)

    def _scene(self, session: Session, why: str) -> Scene:
        assert self.recent is not None
        node, model, monitor = self._node, session.model, session.monitor
        alarm = f"{monitor.rule.violations} of {monitor.rule.window}, margin {monitor.rule.margin!r}"
        name, path = node.get_fully_qualified_name(), self._settings["model"]
        about = {"node": name, "why": why, "model": path, "alarm": alarm}
        topics = {output.name: node.resolve_topic_name(f"~/{output.name}") for output in RECORDED}
        names = names_of(model.state_names, model.steps, monitor.alarms.names)
        reasons = Reasons(model, monitor.alarms.rules)
        return Scene(self.recent.entries(), names, session.types, topics, about, definition, reasons)

    @property
    def values(self) -> dict[str, str]:
        """Values about the files for diagnostics; none while there is no folder."""
        return {} if self._album is None else {"snapshots": str(self._album.written), "last snapshot": self._album.last}

    @property
    def problems(self) -> list[str]:
        """Why the last file was not written, if it was not."""
        return [self._album.problem] if self._album is not None and self._album.problem else []
