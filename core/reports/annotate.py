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
their log and publish times and sequence numbers, definitions, channel metadata, attachments and metadata records. The
verdicts lie behind it in the file; readers bring both together by log time, with the index.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti import __version__
from uncertain_lti.base.arrays import Integers
from uncertain_lti.base.errors import BagError
from uncertain_lti.base.files import TABLES, sha256, try_to_write, written
from uncertain_lti.base.text import once
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.outputs import NODE, REASON, RECORDED, VerdictRecords, names_of, text_message
from uncertain_lti.monitor.reason import over_recording
from uncertain_lti.monitor.verdict import Verdicts
from uncertain_lti.recordings.bag import Bag
from uncertain_lti.recordings.bag_files import survey
from uncertain_lti.recordings.mcap_records import Contents, copy, count, declare
from uncertain_lti.recordings.mcap_writer import McapWriter
from uncertain_lti.recordings.message_types import define, jazzy_text
from uncertain_lti.recordings.recording import Progress, Recording
from uncertain_lti.recordings.unreadable import SUFFIXES
from uncertain_lti.sampling.reading import Decisions

METADATA = "uncertain_lti_check"
"""Name of the metadata record that says what was checked with what."""
_CHUNK = 1 << 20  # bytes of verdicts


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
            several = f"one file for {len(bags)} recordings"
            raise BagError(f"{path}: {several}; name a folder for them, or check them one by one")
        if not path.parent.is_dir():
            raise BagError(f"{path}: the folder {path.parent} is not there; make it first")
        try_to_write(path)
        chosen = [path]
    elif not path.is_dir() and (path.exists() or path.suffix.lower() in (*SUFFIXES, *TABLES)):
        raise BagError(f"{path}: is neither a folder nor called *.mcap; choose another name")
    else:
        whole = [bag.path.resolve() for bag in bags]
        stems = [p.stem if bag.path.suffix in SUFFIXES else p.name for p, bag in zip(whole, bags, strict=True)]
        chosen = [path / f"{stem}_annotated.mcap" for stem in once(stems, "_")]
    parts = [part for bag in bags for part in bag.parts]
    folders = [bag.path.resolve() for bag in bags if bag.path.is_dir()]
    for target in chosen:
        if target.parent.resolve() in folders:
            raise BagError(f"{target}: lies in the folder of the recording {target.parent}; choose another place")
        if target.exists() and any(target.samefile(part) for part in parts):
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
    """Write a copy of a recording, block by block whatever its size, and after it the verdicts."""
    output = Path(output)
    contents = [survey(Path(part)) for part in parts]
    try:
        output.parent.mkdir(exist_ok=True)
    except OSError as error:
        raise BagError(f"{output.parent}: cannot be made: {error.strerror}; choose another folder") from None
    compression = next((b.compression for part in contents if not part.converted for b in part.blocks), "zstd")
    base = _base({c.topic for part in contents for c in part.channels.values()})
    left_out, notes = Counter[Path](), list[str]()
    rule = rule or model.alarm_rule
    about = {
        "recording": json.dumps([part.path.name for part in contents]),
        "alarm": f"{rule.violations} of {rule.window}, margin {rule.margin!r}",
        "topics": base,
        "states": json.dumps([{"name": s.name, "unit": s.unit} for s in model.signals.states]),
        **({"model": os.path.basename(model_file)} if model_file else {}),
        **({"model_sha256": sha256(model_file)} if os.path.isfile(model_file) else {}),
    }
    with written(output, BagError) as stream:
        writer = McapWriter(stream, f"uncertain-lti {__version__}", compression)
        numbers = [declare(writer, part) for part in contents]
        there = names_of(model.state_names, model.steps, verdicts.statistic_names)
        given = (output for output in RECORDED if there[output.of])
        channels = {o.name: writer.channel(_schema(writer, contents, o.type), f"{base}/{o.name}") for o in given}
        writer.metadata(METADATA, about)
        blocks: Iterable[Any] = (
            (part.path, lost)
            for part, renumbered in zip(contents, numbers, strict=True)
            for lost in copy(writer, part, renumbered, notes)
        )
        if progress is not None:
            blocks = progress(blocks, sum(len(part.blocks) for part in contents))
        for path, lost in blocks:
            left_out[path] += lost
        _write_verdicts(writer, channels, model, verdicts, decisions)
        writer.finish()
    for path, number in left_out.items():
        if number:
            notes.append(f"{path}: {count(number, 'message')} that cannot be converted to CDR not copied")
    if base != NODE:
        notes.append(f"{output}: the recording has topics below {NODE}, so the verdicts are below {base}")
    messages = sum(part.count for part in contents) - left_out.total()
    return Annotated(output, messages, len(decisions.t_ns), base, tuple(notes))


def _write_verdicts(
    writer: McapWriter, channels: dict[str, int], model: UncertainLTI, verdicts: Verdicts, decisions: Decisions
) -> None:
    """The verdicts on the clock messages, in the order of their decisions, and the reasons where they change."""
    records = VerdictRecords(names_of(model.state_names, model.steps, verdicts.statistic_names), channels)
    names = {name for output in RECORDED for name in (output.position, output.velocity) if name}
    kept, log_time = ~decisions.dropped, np.maximum.accumulate(decisions.arrival)
    row = np.cumsum(kept) - 1  # in the verdicts; of a dropped message the one before
    assert int(kept.sum()) == len(verdicts.judged), "decisions of another reading"
    step = max(1, _CHUNK // records.size)
    for begin in range(0, len(row), step):
        chosen = slice(begin, begin + step)
        times, known, at = log_time[chosen], row[chosen] >= 0, np.maximum(row[chosen], 0)
        data, index = records.encode(
            times,
            decisions.t_ns[chosen],
            kept[chosen] & _rows(verdicts.judged, at),
            known & _rows(verdicts.alarm, at),  # before the first sample there is none
            {name: _rows(getattr(verdicts, name), at) for name in names},
        )
        writer.chunk(data, index, (int(times[0]), int(times[-1])))
    decided = log_time[kept]
    for k, text in over_recording(verdicts, model):
        writer.message(channels[REASON.name], int(decided[k]), text_message(text))


def _rows(values: NDArray[Any], at: Integers) -> NDArray[Any]:
    """Rows of an array; zeros where it has none, as every clock message was dropped."""
    return values[at] if len(values) else np.zeros((len(at), *values.shape[1:]), values.dtype)


def _base(topics: set[str]) -> str:
    """Beginning of the topics, under which none of the recording is."""
    names = [NODE, f"{NODE}_check", *(f"{NODE}_check_{number}" for number in range(2, len(topics) + 2))]
    return next(name for name in names if not any(f"{name}/{output.name}" in topics for output in RECORDED))


def _schema(writer: McapWriter, contents: Sequence[Contents], type_name: str) -> int:
    """The recording's own schema of a type where it is that of ROS 2 Jazzy; two texts of one type confuse readers."""
    ours = define(type_name, "ros2msg", jazzy_text(type_name).encode())
    for schema in (schema for part in contents for schema in part.schemas.values()):
        if schema.name == type_name and schema.data.strip():
            theirs = define(schema.name, schema.encoding, schema.data)
            if not theirs.reason and _fields(theirs.types) == _fields(ours.types):
                return writer.schema(schema.name, schema.encoding, schema.data)
    return writer.schema(type_name, "ros2msg", jazzy_text(type_name).encode())


def _fields(types: Mapping[str, Any]) -> str:
    return repr(sorted((name, fields) for name, (_, fields) in types.items()))
