# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Annotated recordings: a copy of what was recorded, with the monitor's verdicts on topics of their own.

The topics, types and bytes are those that the live node would have published had it listened; the log time of a
verdict is that of the message which decided it. Everything recorded is in the copy unchanged: the bytes of messages,
their log and publish times and sequence numbers, definitions, channel metadata, attachments and metadata records.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, repeat
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti import __version__
from uncertain_lti.base.arrays import Integers
from uncertain_lti.base.errors import BagError
from uncertain_lti.base.files import whole_file
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.outputs import NODE, REASON, RECORDED, VerdictRecords, names_of, text_message
from uncertain_lti.monitor.reason import over_recording
from uncertain_lti.monitor.verdict import Verdicts
from uncertain_lti.recordings.bag import Bag
from uncertain_lti.recordings.bag_files import survey
from uncertain_lti.recordings.mcap_copy import copy, declare
from uncertain_lti.recordings.mcap_records import LATEST, Contents, count
from uncertain_lti.recordings.mcap_writer import McapWriter
from uncertain_lti.recordings.message_types import define, jazzy_text
from uncertain_lti.recordings.recording import Progress, Recording
from uncertain_lti.recordings.unreadable import SUFFIXES
from uncertain_lti.sampling.reading import Decisions

METADATA = "uncertain_lti_check"
"""Name of the metadata record that says what was checked with what."""
_CHUNK = 1 << 20  # bytes of verdicts
_SMALL = 1 << 18  # bytes of verdicts that wait for more


@dataclass(frozen=True)
class Annotated:
    """What `annotate` wrote.

    `path`: the file; `messages`: messages of the recording that were copied; `verdicts`: clock messages with a verdict,
    or with the reason why there is none; `topics`: what the names of the monitor's topics begin with; `notes`: what the
    reader should know, a sentence each.
    """

    path: Path
    messages: int
    verdicts: int
    topics: str
    notes: tuple[str, ...]


def targets(output: str | os.PathLike[str], bags: Sequence[Recording]) -> list[Path]:
    """Where annotated copies of these recordings go: a file `*.mcap` for one, any other path is a folder.

    In a folder, which is made, the copy of `run.mcap` is `run_annotated.mcap`.
    """
    path = Path(output)
    for bag in bags:
        if not isinstance(bag, Bag):
            raise BagError(f"{bag.path}: a table, and only ROS recordings are copied; leave out --write, or use --json")
    if path.suffix == ".mcap" and not path.is_dir():
        if len(bags) > 1:
            raise BagError(
                f"{path}: one file for {len(bags)} recordings; name a folder for them, or check them one by one"
            )
        if not path.parent.is_dir():
            raise BagError(f"{path}: the folder {path.parent} is not there; make it first")
        chosen = [path]
    else:
        if path.exists() and not path.is_dir():
            raise BagError(f"{path}: is neither a folder nor called *.mcap; choose another name")
        chosen = []
        for bag in bags:
            stem = bag.path.resolve().stem if bag.path.suffix in SUFFIXES else bag.path.resolve().name
            name, number = f"{stem}_annotated.mcap", 1
            while path / name in chosen:
                number += 1
                name = f"{stem}_{number}_annotated.mcap"
            chosen.append(path / name)
    for target in chosen:
        for bag in bags:
            if bag.path.is_dir() and target.parent.resolve() == bag.path.resolve():
                raise BagError(f"{target}: lies in the folder of the recording {bag.path}; choose another place")
            if target.exists() and any(target.samefile(part) for part in bag.parts):
                raise BagError(f"{target}: is the recording itself, which is never written to; choose another name")
        if target.exists() or target.is_symlink():
            raise BagError(f"{target}: is there already; choose another name or move it away")
    return chosen


def annotate(
    parts: Iterable[str | os.PathLike[str]],
    verdicts: Verdicts,
    decisions: Decisions,
    output: str | os.PathLike[str],
    model: UncertainLTI,
    model_file: str | os.PathLike[str] = "",
    rule: AlarmRule | None = None,
    progress: Progress | None = None,
) -> Annotated:
    """Write a copy of a recording with the verdicts added; block by block, whatever its size."""
    output = Path(output)
    contents = [survey(Path(part)) for part in parts]
    try:
        output.parent.mkdir(exist_ok=True)
    except OSError as error:
        raise BagError(f"{output.parent}: cannot be made: {error.strerror}; choose another folder") from None
    try:
        with whole_file(output) as stream:
            writer = McapWriter(stream, f"uncertain-lti {__version__}", _compression(contents))
            numbers = [declare(writer, part) for part in contents]
            base = _base({c.topic for part in contents for c in part.channels.values()})
            there = names_of(model.state_names, model.steps, verdicts.statistic_names)
            channels = {
                output.name: writer.channel(_schema(writer, contents, output.type), f"{base}/{output.name}")
                for output in RECORDED
                if there[output.of]
            }
            writer.metadata(METADATA, _about(contents, base, model, model_file, rule))
            records = VerdictRecords(model.state_names, channels, model.steps, verdicts.statistic_names)
            reasons = over_recording(verdicts, model)
            verdict_stream = _VerdictStream(writer, records, verdicts, decisions, reasons, channels[REASON.name])
            total = sum(part.count for part in contents)
            left_out, notes = Counter[Path](), list[str]()

            def weave() -> Iterator[int]:
                """Copy block after block, verdicts in between; yields the messages of each block."""
                horizon = 0
                for part, renumbered in zip(contents, numbers, strict=True):
                    for there, copied, last in copy(writer, part, renumbered, notes):
                        left_out[part.path] += there - copied
                        horizon = min(max(horizon, last), LATEST)  # of other topics it may be anything
                        verdict_stream.until(horizon)
                        yield there
                verdict_stream.finish()

            steps: Iterable[object] = weave()
            if progress is not None:
                steps = progress(chain.from_iterable(repeat(None, number) for number in weave()), total)
            for _ in steps:
                pass
            writer.finish()
    except OSError as error:
        why = error.strerror or error
        raise BagError(f"{output}: cannot be written: {why}; make room or choose another place") from None
    for path, number in left_out.items():
        if number:
            notes.append(f"{path}: {count(number, 'message')} that cannot be converted to CDR not copied")
    total -= left_out.total()
    if base != NODE:
        notes.append(f"{output}: the recording has topics below {NODE}, so the verdicts are below {base}")
    return Annotated(output, total, len(verdict_stream), base, tuple(notes))


class _VerdictStream:
    """The verdicts on the clock messages, in the order of their decisions, written as the copy goes on."""

    def __init__(
        self,
        writer: McapWriter,
        records: VerdictRecords,
        verdicts: Verdicts,
        decisions: Decisions,
        reasons: Iterator[tuple[int, str]],
        reason_channel: int,
    ) -> None:
        self._writer, self._records, self._verdicts = writer, records, verdicts
        self._log_time = np.maximum.accumulate(decisions.arrival)
        self._t_ns = decisions.t_ns
        self._row = np.cumsum(~decisions.dropped) - 1  # in the verdicts; of a dropped message the one before
        self._kept = ~decisions.dropped
        assert int(self._kept.sum()) == len(verdicts.judged), "decisions of another reading"
        self._next = 0
        self._step = max(1, _CHUNK // records.size)
        self._least = max(1, _SMALL // records.size)
        self._decided = np.flatnonzero(self._kept)  # of each row of the verdicts
        self._reasons, self._reason_channel, self._reason = reasons, reason_channel, next(reasons, None)

    def __len__(self) -> int:
        return len(self._t_ns)

    def until(self, horizon: int) -> None:
        """Write what was decided up to this log time, unless it is little."""
        stop = int(np.searchsorted(self._log_time, horizon, side="right"))
        if stop - self._next >= self._least:
            self._write(stop)

    def finish(self) -> None:
        """Write the rest."""
        self._write(len(self))

    def _write(self, stop: int) -> None:
        for begin in range(self._next, stop, self._step):
            chosen = slice(begin, min(begin + self._step, stop))
            self._chunk(chosen)
        self._next = max(self._next, stop)

    def _chunk(self, chosen: slice) -> None:
        v, row, kept = self._verdicts, self._row[chosen], self._kept[chosen]
        known = row >= 0  # before the first sample nothing is, and no alarm
        at = np.maximum(row, 0)
        times = self._log_time[chosen]
        judged = kept & _rows(v.judged, at)
        names = {name for output in RECORDED for name in (output.position, output.velocity) if name}
        records, index = self._records.encode(
            times,
            self._t_ns[chosen],
            judged,
            known & _rows(v.alarm, at),
            {name: _rows(getattr(v, name), at) for name in names},
        )
        self._writer.chunk(records, index, (int(times[0]), int(times[-1])))
        while self._reason is not None and (at_row := int(self._decided[self._reason[0]])) < chosen.stop:
            self._writer.message(self._reason_channel, int(self._log_time[at_row]), text_message(self._reason[1]))
            self._reason = next(self._reasons, None)


def _rows(values: NDArray[Any], at: Integers) -> NDArray[Any]:
    """Rows of an array; zeros where it has none, as every clock message was dropped."""
    return values[at] if len(values) else np.zeros((len(at), *values.shape[1:]), values.dtype)


def _compression(contents: Sequence[Contents]) -> str:
    """That of the recording: the one that most of its bytes have."""
    sizes: dict[str, int] = {}
    for block in (block for part in contents if not part.converted for block in part.blocks):
        sizes[block.compression] = sizes.get(block.compression, 0) + block.length
    return max(sizes, key=lambda name: sizes[name], default="zstd")


def _base(topics: set[str]) -> str:
    """Beginning of the topics, under which none of the recording is."""
    base, number = NODE, 1
    while any(f"{base}/{output.name}" in topics for output in RECORDED):
        base = f"{NODE}_check" if number == 1 else f"{NODE}_check_{number}"
        number += 1
    return base


def _schema(writer: McapWriter, contents: Sequence[Contents], type_name: str) -> int:
    """The recording's own schema of a type where it is that of ROS 2 Jazzy; two texts of one type confuse readers."""
    ours = define(type_name, "ros2msg", jazzy_text(type_name).encode())
    for schema in (schema for part in contents for schema in part.schemas.values()):
        if schema.name == type_name and schema.data.strip():
            theirs = define(schema.name, schema.encoding, schema.data)
            if not theirs.reason and _fields(theirs.types) == _fields(ours.types):
                return writer.schema(schema.name, schema.encoding, schema.data)
    return writer.schema(type_name, "ros2msg", jazzy_text(type_name).encode())


def _fields(types: object) -> str:
    assert isinstance(types, dict)
    return repr(sorted((name, fields) for name, (_, fields) in types.items()))


def _about(
    contents: Sequence[Contents],
    base: str,
    model: UncertainLTI,
    model_file: str | os.PathLike[str],
    rule: AlarmRule | None,
) -> dict[str, str]:
    rule = rule or model.alarm_rule
    about = {
        "recording": json.dumps([part.path.name for part in contents]),
        "alarm": f"{rule.violations} of {rule.window}, margin {rule.margin!r}",
        "topics": base,
        "states": json.dumps([{"name": s.name, "unit": s.unit} for s in model.signals.states]),
    }
    if model_file:
        about["model"] = os.path.basename(model_file)
        if os.path.isfile(model_file):
            about["model_sha256"] = hashlib.sha256(Path(model_file).read_bytes()).hexdigest()
    return about
