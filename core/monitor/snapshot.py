# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Snapshots: the last seconds of messages and their verdicts, kept in memory and written to MCAP files."""

from __future__ import annotations

import os
import re
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

from uncertain_lti.base.errors import ModelError, UncertainLTIError
from uncertain_lti.base.files import whole_file
from uncertain_lti.monitor.outputs import FALSE, FLAG_TYPE, REASON, RECORDED, TRUE, VerdictMessages, text_message
from uncertain_lti.monitor.reason import Reasons
from uncertain_lti.monitor.verdict import Verdict
from uncertain_lti.recordings.mcap_writer import McapWriter

_OVERHEAD = 800  # bytes that one kept message takes besides its data, a verdict on it included
_PER_STATE = 200  # and for each state of a verdict
BACK_NS = 10**9  # a clock that goes back by more begins anew, as where a recording is played again


@dataclass(frozen=True, slots=True)
class Entry:
    """One message as received, with the verdicts and the alarm after it.

    `now`: steady time, s; `arrival_ns`: arrival, ns; `topic`: its topic; `data`: serialised message; `verdicts`: on the
    clock messages that it decided; `alarm`: the alarm after it.
    """

    now: float
    arrival_ns: int
    topic: str
    data: bytes
    verdicts: Sequence[Verdict]
    alarm: bool


class Recent:
    """The messages of the last seconds, bounded in bytes; the oldest are dropped first.

    Of each topic the last message before these is kept as well: its values hold when they begin.

    `seconds`: how long a message is kept, s; `limit`: bytes at most.
    """

    def __init__(self, seconds: float, limit: int) -> None:
        self._seconds, self._limit = seconds, limit
        self._entries: deque[Entry] = deque()
        self._before: dict[str, Entry] = {}
        self._bytes = 0

    def add(self, entry: Entry) -> None:
        """Keep one more; of what came before its clock went back the last values alone."""
        entries = self._entries
        if entries and entry.arrival_ns < entries[-1].arrival_ns - BACK_NS:  # log times of a file never do
            at_ns = max(0, entry.arrival_ns - BACK_NS)
            self.clear({old.topic for old in self.entries()})
            self._before = {topic: replace(old, arrival_ns=at_ns) for topic, old in self._before.items()}
        entries.append(entry)
        self._bytes += len(entry.data) + _OVERHEAD + sum(_PER_STATE * v.n for v in entry.verdicts)
        while entries and (entries[0].now < entry.now - self._seconds or self._bytes > self._limit):
            gone = entries.popleft()
            self._before[gone.topic] = gone
            self._bytes -= len(gone.data) + _OVERHEAD + sum(_PER_STATE * v.n for v in gone.verdicts)

    def entries(self) -> list[Entry]:
        """All, in order of arrival."""
        return [*sorted(self._before.values(), key=lambda entry: entry.now), *self._entries]

    def clear(self, but: Iterable[str] = ()) -> None:
        """Forget all but the last messages of some topics."""
        self._before = {old.topic: replace(old, verdicts=()) for old in self.entries() if old.topic in but}
        self._entries.clear()
        self._bytes = 0


@dataclass(frozen=True)
class Scene:
    """What a snapshot file holds.

    `entries`: messages in order of arrival; `names`: of the model and its alarm, by `names_of`; `inputs`: topic -> type
    of what came in; `outputs`: name of an output (flags, violation, lower, ...) -> its topic; `notes`: pairs for a
    metadata record; `definition`: type name -> text of its definition; `reasons`: without any sample; default none are
    written.
    """

    entries: Sequence[Entry]
    names: Mapping[str, Sequence[str]]
    inputs: Mapping[str, str]
    outputs: Mapping[str, str]
    notes: Mapping[str, str]
    definition: Callable[[str], str]
    reasons: Reasons | None = None

    def write(self, stream: BinaryIO) -> None:
        """Write an MCAP file."""
        messages = VerdictMessages(self.names)
        encode = {name: messages.encoder([name]) for name in messages.outputs}
        has = len(self.names["states"]), len(self.names["horizons"]), tuple(self.names["statistics"])
        writer = McapWriter(stream, "uncertain-lti")
        writer.metadata("uncertain_lti", self.notes)

        def declare(topic: str, kind: str) -> int:
            return writer.channel(writer.schema(kind, "ros2msg", self.definition(kind).encode()), topic)

        inputs = {topic: declare(topic, kind) for topic, kind in self.inputs.items()}
        offered = [o for o in RECORDED if o.name in self.outputs and (not o.position or o.name in encode)]
        outputs = {output: declare(self.outputs[output.name], output.type) for output in offered}
        reason = outputs.pop(REASON, None)
        log_time, said = 0, ""
        for entry in self.entries:
            log_time = max(log_time, entry.arrival_ns)  # a clock that is set back must not reorder messages
            if entry.topic not in inputs:
                continue  # of the previous model
            writer.message(inputs[entry.topic], log_time, entry.data)
            for verdict in entry.verdicts:
                horizons = verdict.n * (1 + verdict.horizons) if verdict.horizons else 0
                if (verdict.n, horizons, verdict.statistic_names) != has:
                    continue
                for output, channel in outputs.items():
                    if verdict.judged or output.when != "judged":
                        alarm = TRUE if entry.alarm else FALSE
                        data = alarm if output.type == FLAG_TYPE else encode[output.name](verdict)[0]
                        writer.message(channel, log_time, data)
                if reason is None or self.reasons is None:
                    continue
                text = self.reasons.take(verdict, entry.alarm)
                if text != said:
                    writer.message(reason, log_time, text_message(text))
                    said = text
        writer.finish()


class Album:
    """Snapshot files in one folder, bounded in number and in bytes; written one at a time, in a thread of their own.

    `folder`: made where it is not there. Only files in it that bear this node's name and a time are ever removed;
    `node_name`: begins the name of every file; `keep`: most files of this node; the oldest go first; `limit`: most
    bytes of the files of this node; `written`: files written so far; `last, problem`: path of the last file, and why
    the last attempt failed; empty if there was none, or it did not.
    """

    def __init__(self, folder: str, node_name: str, keep: int, limit: int) -> None:
        stem = re.sub(r"\W+", "_", node_name.strip("/"), flags=re.ASCII)
        self._stem, self._keep, self._limit = stem, keep, limit
        self._pattern = re.compile(rf"{re.escape(stem)}-\d{{8}}T\d{{6}}\.\d{{6}}Z\.mcap", re.ASCII)
        self._thread: threading.Thread | None = None
        self.written = 0
        self.last = self.problem = ""
        try:
            self._folder = Path(folder).expanduser()
            self._folder.mkdir(parents=True, exist_ok=True)
            if not os.access(self._folder, os.W_OK | os.X_OK):
                raise PermissionError(13, "Permission denied")
            for path in self._folder.glob(f".{stem}-*.mcap-*.tmp"):
                path.unlink()  # of a process that was killed
        except (OSError, RuntimeError) as error:  # RuntimeError: of whom ~ is the home, nobody knows
            why = getattr(error, "strerror", "it is in the home of nobody here")
            raise ModelError(f"snapshot.folder {folder}: cannot be written to: {why}; choose another folder") from None

    @property
    def busy(self) -> bool:
        """A file is being written."""
        return self._thread is not None and self._thread.is_alive()

    def take(self, scene: Scene, patience: float) -> str:
        """Begin to write a file."""
        if self.busy:
            raise ModelError("a snapshot is being written; ask again in a moment")
        if not scene.entries:
            raise ModelError("there is nothing to write: no message has come")
        name = f"{self._stem}-{datetime.now(UTC):%Y%m%dT%H%M%S.%f}Z.mcap"
        path = self._folder / name
        self.problem = ""
        self._thread = threading.Thread(target=self._write, args=(scene, path), name="snapshot", daemon=True)
        self._thread.start()
        self._thread.join(patience)
        if self._thread.is_alive():
            return f"writing {path}; ~/status says when it is there"
        if self.problem:
            raise ModelError(self.problem)
        return f"wrote {path}"

    def close(self) -> None:
        """Wait for what is being written."""
        if self._thread is not None:
            self._thread.join(10.0)

    def _write(self, scene: Scene, path: Path) -> None:
        try:
            if not os.path.lexists(self._folder):  # it was cleared away, as folders of /tmp are
                self._folder.mkdir(parents=True)
            with whole_file(path) as stream:
                scene.write(stream)
                size = stream.tell()
                if size > self._limit:
                    raise ModelError(f"{path.name}: {size} bytes are more than snapshot.megabytes allows; raise it")
                self._make_room(size)
            self.last = str(path)
            self.written += 1
        except (OSError, UncertainLTIError) as error:
            remedy = "make room or choose another snapshot.folder"
            why = f"{error.strerror}; {remedy}" if isinstance(error, OSError) else str(error)
            self.problem = f"snapshot {path}: not written: {why}"
        except Exception as error:  # the node goes on, and reports it
            self.problem = f"snapshot {path}: not written: {error!r}"

    def _make_room(self, size: int) -> None:
        """Remove files of this node, the oldest first."""
        files = sorted(p for p in self._folder.iterdir() if self._pattern.fullmatch(p.name))
        files = [path for path in files if path.is_file() and not path.is_symlink()]
        sizes = [path.stat().st_size for path in files]
        while files and (len(files) >= self._keep or sum(sizes) + size > self._limit):
            files.pop(0).unlink(missing_ok=True)
            sizes.pop(0)
