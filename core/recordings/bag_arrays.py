# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Fields of a recording as arrays, in order of arrival: what `FieldPath.read` gives for every message, at once."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from operator import itemgetter
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array, Integers, Mask
from uncertain_lti.base.errors import BagError
from uncertain_lti.recordings.mcap_records import RECORD, Block, Contents, inflate, parse
from uncertain_lti.recordings.mcap_scan import CHUNK, crc32, most_records
from uncertain_lti.recordings.mcap_walk import walk_records
from uncertain_lti.recordings.message_reader import NO_STAMP, NOT_PLAIN, Plan, header_stamp_ns
from uncertain_lti.recordings.message_types import Definition, RecordedChannel
from uncertain_lti.recordings.recording import Columns, Progress
from uncertain_lti.signals.field_path import FieldPath

_BATCH = 1 << 22  # bytes; small blocks are put together until they reach this
_CHECKSUM_AT = RECORD.size + 24


class IndexMismatchError(Exception):
    """The file is not what its index states: it has to be walked."""


class FieldReader:
    """Reads some paths from the messages of one definition; `alone`: messages that were decoded one by one."""

    def __init__(self, definition: Definition, paths: Sequence[FieldPath]) -> None:
        self.definition, self.paths, self.alone = definition, paths, 0
        self.plan = Plan(definition.type_name, paths, definition.fields)

    def read(
        self, data: bytearray, begin: Integers, end: Integers, values: Array, stamps: Integers
    ) -> list[tuple[int, str]]:
        """Fill in a row of values and a stamp, ns, for each message data[begin:end].

        Returns rows of messages that cannot be decoded, each with the reason, and of another publisher's, without one.
        """
        states = self.plan.read_all(data, begin, end, values, stamps)
        if not self.plan.able:
            states[states == 0] = NOT_PLAIN
        failures = []
        for row in np.flatnonzero(states).tolist():
            if states[row] != NOT_PLAIN:
                failures.append((row, self.plan.in_words(int(states[row]))))
                continue
            self.alone += 1
            try:
                message = self.definition.decode(bytes(data[begin[row] : end[row]]))
            except BagError as error:
                failures.append((row, str(error)))
            else:
                values[row] = [path.read(message) for path in self.paths]
                stamps[row] = header_stamp_ns(message) or NO_STAMP
        return failures


class ColumnReader:
    """Reads some paths of each topic of a recording.

    `parts`: files of the recording, and the channels of each that count; `counts`: messages by topic;
    `paths`: of each topic; `undecoded`: topic -> how many messages are left out, and why one of them.
    """

    def __init__(
        self,
        parts: Sequence[tuple[Contents, dict[int, RecordedChannel]]],
        counts: Mapping[str, int],
        paths: Sequence[Sequence[FieldPath]],
    ) -> None:
        self.parts, self.topics, self.paths = parts, list(counts), paths
        self.total = sum(counts.values())
        self.readers: dict[tuple[int, Definition], FieldReader] = {}
        self.undecoded: dict[str, tuple[int, str]] = {}
        self.filled_of = [0] * len(counts)
        self.topic = np.empty(self.total, dtype=np.int64)
        self.arrival = np.empty(self.total, dtype=np.int64)
        self.stamp = np.empty(self.total, dtype=np.int64)
        self.values = [np.empty((n, len(p)), dtype=np.float64) for n, p in zip(counts.values(), paths, strict=True)]

    def run(self, progress: Progress | None) -> Columns:
        """Read all; raises `IndexMismatchError`."""
        steps: Iterable[object] = self._steps()
        if progress is not None:  # which counts messages
            steps = progress(itertools.chain.from_iterable(map(range, self._steps())), self.total)
        for _ in steps:
            pass
        return self._in_order()

    def _steps(self) -> Iterator[int]:
        """Read batch after batch; yields how many messages each has."""
        for contents, channels in self.parts:
            topic_of = np.zeros(1 << 16, dtype=np.int64)
            readers = {}
            for key, channel in channels.items():
                topic_of[key] = where = self.topics.index(channel.topic)
                reader = FieldReader(channel.definition, self.paths[where])
                readers[key] = self.readers.setdefault((where, channel.definition), reader)
            for batch in batches(contents, channels):
                self._take(batch, topic_of[batch.channel], readers)
                yield len(batch.channel)

    def _take(self, batch: Batch, topic: Integers, readers: Mapping[int, FieldReader]) -> None:
        kept, stamp = np.ones(len(topic), dtype=bool), np.empty(len(topic), dtype=np.int64)
        for where in np.unique(topic).tolist():
            rows = np.flatnonzero(topic == where)
            values = np.empty((len(rows), len(self.paths[where])))
            channel = batch.channel[rows]
            for key in np.unique(channel).tolist():
                mine = np.flatnonzero(channel == key)
                at = rows[mine]
                read, stamps = np.empty((len(at), values.shape[1])), np.empty(len(at), dtype=np.int64)
                for row, why in readers[key].read(batch.data, batch.begin[at], batch.end[at], read, stamps):
                    kept[at[row]] = False
                    if why:
                        number, least = self.undecoded.get(self.topics[where], (0, why))
                        self.undecoded[self.topics[where]] = number + 1, min(least, why)
                values[mine], stamp[at] = read, stamps
            begin = self.filled_of[where]
            if begin + len(rows) > len(self.values[where]):
                raise IndexMismatchError  # more than it states
            self.filled_of[where] = end = begin + int(kept[rows].sum())
            self.values[where][begin:end] = values[kept[rows]]
        filled = sum(self.filled_of)
        to = slice(filled - int(kept.sum()), filled)
        self.topic[to], self.arrival[to], self.stamp[to] = topic[kept], batch.log_time[kept], stamp[kept]

    def _in_order(self) -> Columns:
        """Stable sort by log time: messages are in file order so far."""
        topic, arrival, stamp = (column[: sum(self.filled_of)] for column in (self.topic, self.arrival, self.stamp))
        values = [v[:n] for v, n in zip(self.values, self.filled_of, strict=True)]
        alone = sum(reader.alone for reader in self.readers.values())
        if (arrival[1:] >= arrival[:-1]).all():
            return Columns(topic, arrival, stamp, values, alone)
        order = np.argsort(arrival, kind="stable")
        for where, read in enumerate(values):
            rows = np.argsort(arrival[topic == where], kind="stable")
            if (rows[1:] < rows[:-1]).any():
                values[where] = read[rows]
        return Columns(topic[order], arrival[order], stamp[order], values, alone)


@dataclass(frozen=True, slots=True)
class Batch:
    """Messages of wanted channels in file order.

    data[begin:end] is an encoded message.

    `data`: their records; `channel` (messages,): number of the channel in the file;
    `log_time` (messages,): log time, ns; `begin` (messages,): where each message begins; `end` (messages,): where it
    ends.
    """

    data: bytearray
    channel: NDArray[np.uint16]
    log_time: NDArray[np.uint64]
    begin: Integers
    end: Integers


def batches(contents: Contents, channels: Collection[int]) -> Iterator[Batch]:
    """Messages of these channels, some MiB at a time, in file order; only blocks that hold one are read."""
    wanted = np.zeros(1 << 16, dtype=bool)
    wanted[list(channels)] = True
    missing = {channel: contents.tally[channel].count for channel in channels if channel in contents.tally}
    groups = list(_groups([block for block in contents.blocks if not block.channels.isdisjoint(missing)]))
    for group in groups:
        data, ends = bytearray(), []
        for block in group:
            data += _records(contents, block) if contents.indexed else contents.records(block, channels)
            ends.append(len(data))
        batch = _messages(data, ends, wanted, contents)
        counts = np.bincount(batch.channel, minlength=1 << 16)
        for channel in missing:
            missing[channel] -= int(counts[channel])
        if contents.indexed and min(missing.values()) < 0:
            raise IndexMismatchError
        yield batch
    if contents.indexed and any(missing.values()):
        raise IndexMismatchError


def _groups(blocks: Sequence[Block]) -> Iterator[list[Block]]:
    """Blocks in file order, about `_BATCH` bytes of records together."""
    numbers = np.cumsum([block.length for block in blocks]) // _BATCH
    for _, group in itertools.groupby(zip(blocks, numbers.tolist(), strict=True), key=itemgetter(1)):
        yield [block for block, _ in group]


def _records(contents: Contents, block: Block) -> bytes | memoryview:
    """Records of a block that nobody has read before, compared with what the index states."""
    packed = contents.packed(block)
    records, trouble = inflate(block.compression, packed[block.unchecked :], block.length)
    whole = not trouble and len(records) == block.length
    if not whole or not _as_stated(contents, block, packed[: block.unchecked], records):
        raise IndexMismatchError
    return records


def _as_stated(contents: Contents, block: Block, head: memoryview, records: bytes | memoryview) -> bool:
    """Compare what precedes a block with it, and its records against their checksum."""
    checksum = int.from_bytes(head[_CHECKSUM_AT : _CHECKSUM_AT + 4], "little")
    name = block.compression.encode()
    length = block.unchecked - RECORD.size + block.size
    stated = RECORD.pack(Opcode.CHUNK, length) + CHUNK.pack(block.start, block.end, block.length, checksum, len(name))
    stated += name + block.size.to_bytes(8, "little")
    return head == stated and (crc32(records) == checksum if checksum else not contents.summed)


def _messages(data: bytearray, ends: Sequence[int], wanted: Mask, contents: Contents) -> Batch:
    """Messages of wanted channels among the records."""
    left = most_records(contents.size)
    found: list[tuple[NDArray[Any], ...]] = []
    for begin, end in pairwise([0, *ends]):
        records = walk_records(data, begin, end, left if contents.indexed else end - begin)
        if contents.indexed:
            left -= records.number
            if records.stop != end or records.short or records.late or records.nested:
                raise IndexMismatchError
            for definition in records.definitions:
                _hold_against(contents, data, *definition)
        keep = wanted[records.channel]
        columns = records.channel, records.log_time, records.begin, records.end
        found.append(columns if keep.all() else tuple(column[keep] for column in columns))
    return Batch(data, *(np.concatenate(columns) for columns in zip(*found, strict=True)))


def _hold_against(contents: Contents, data: bytearray, opcode: int, begin: int, end: int) -> None:
    """A definition in a chunk has to be the one that the summary gives."""
    known: Mapping[int, Any] = contents.schemas if opcode == Opcode.SCHEMA else contents.channels
    record = parse(Schema if opcode == Opcode.SCHEMA else Channel, bytes(memoryview(data)[begin:end]))
    if record is None or record != known.get(record.id):
        raise IndexMismatchError
