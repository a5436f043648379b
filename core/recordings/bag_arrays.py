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
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array, Integers
from uncertain_lti.base.errors import BagError
from uncertain_lti.recordings.mcap_records import CHUNK, LATEST, RECORD, Block, Contents, crc32, inflate, parse
from uncertain_lti.recordings.mcap_scan import most_records
from uncertain_lti.recordings.mcap_walk import walk_records
from uncertain_lti.recordings.message_reader import NO_STAMP, NOT_PLAIN, Plan, header_stamp_ns
from uncertain_lti.recordings.message_types import Definition, RecordedChannel
from uncertain_lti.recordings.recording import Columns, Progress, Recording
from uncertain_lti.recordings.unreadable import os_error
from uncertain_lti.signals.field_path import FieldPath


@dataclass
class _Undecoded:
    """Messages of a topic that cannot be decoded: where the first and last are, and why the last one cannot."""

    number: int = 0
    first: tuple[int, int] = (2**64, 0)
    last: tuple[int, int] = (-1, 0)
    why: str = ""

    def add(self, place: tuple[int, int], why: str) -> None:
        self.number += 1
        self.first = min(self.first, place)
        if place >= self.last:
            self.last, self.why = place, why


class FieldReader:
    """Reads some paths from the messages of one definition; `alone`: messages that were decoded one by one."""

    def __init__(self, definition: Definition, paths: Sequence[FieldPath]) -> None:
        self.definition, self.paths, self.alone = definition, paths, 0
        self.plan = Plan(definition.type_name, paths, definition.fields)

    def read(
        self, data: bytearray, begin: Integers, end: Integers, values: Array, stamps: Integers
    ) -> list[tuple[int, str]]:
        """Fill in a row of values and a stamp, ns, for each message data[begin:end].

        Returns rows of messages that cannot be decoded, each with the reason.
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
                continue
            values[row] = [path.read(message) for path in self.paths]
            stamps[row] = header_stamp_ns(message) or NO_STAMP
        return failures


class Blocks(Recording, Protocol):
    """A recording whose files are read block by block: `Bag`."""

    def described(self, topics: Iterable[str]) -> list[tuple[Contents, dict[int, RecordedChannel]]]:
        """Each file, and its channels that count for some topics."""

    def left_out(self, topic: str, number: int, why: str) -> str:
        """Sentence about messages that cannot be decoded."""


def read_columns(
    bag: Blocks, topics: Sequence[str], paths: Sequence[Sequence[FieldPath]], progress: Progress | None = None
) -> Columns:
    """Read some paths of each topic; messages that cannot be decoded are left out, and the bag warns of them."""
    try:
        return _Reading(bag, topics, paths).run(progress)
    except IndexMismatchError:
        bag.walk()
    try:
        return _Reading(bag, topics, paths).run(progress)
    except IndexMismatchError:
        raise BagError(f"{bag.path}: the file changed while it was read; read it again when it is written") from None


def in_reach(path: Path, log_time: int) -> int:
    """Check that a log time can be kept as a 64-bit integer."""
    if log_time > LATEST:
        raise BagError(
            f"{path}: a message has a log time of {log_time} ns, which is past the year 2262; "
            f"the recorder's clock was wrong, so record again"
        )
    return log_time


class _Reading:
    def __init__(self, bag: Blocks, topics: Sequence[str], paths: Sequence[Sequence[FieldPath]]) -> None:
        self.bag, self.topics, self.paths = bag, topics, paths
        self.parts = bag.described(topics)
        counts = [bag.topics[name].count for name in topics]
        self.total = sum(counts)
        self.readers: list[FieldReader] = []
        self.undecoded = [_Undecoded() for _ in topics]
        self.met = 0  # messages so far, with those left out
        self.filled = 0
        self.filled_of = [0] * len(topics)
        self.topic = np.empty(self.total, dtype=np.int64)
        self.arrival = np.empty(self.total, dtype=np.int64)
        self.stamp = np.empty(self.total, dtype=np.int64)
        self.values = [np.empty((n, len(p)), dtype=np.float64) for n, p in zip(counts, paths, strict=True)]

    def run(self, progress: Progress | None) -> Columns:
        steps: Iterable[object] = self._steps()
        if progress is not None:  # which counts messages
            steps = progress(
                itertools.chain.from_iterable(itertools.repeat(None, n) for n in self._steps()), self.total
            )
        for _ in steps:
            pass
        self._note_left_out()
        return self._in_order()

    def _steps(self) -> Iterator[int]:
        """Read batch after batch; yields how many messages each has."""
        for contents, channels in self.parts:
            topic_of = np.zeros(1 << 16, dtype=np.int64)
            reader_of = np.zeros(1 << 16, dtype=np.int64)
            for key, channel in channels.items():
                topic_of[key] = where = self.topics.index(channel.topic)
                reader_of[key] = self._reader(where, channel.definition)
            for batch in batches(contents, channels):
                self._take(batch, topic_of[batch.channel], reader_of[batch.channel])
                yield len(batch.channel)

    def _reader(self, where: int, definition: Definition) -> int:
        """Number of the reader for messages of this definition on a topic."""
        for number, reader in enumerate(self.readers):
            if reader.definition is definition and reader.paths is self.paths[where]:
                return number
        self.readers.append(FieldReader(definition, self.paths[where]))
        return len(self.readers) - 1

    def _take(self, batch: Batch, topic: Integers, reader: Integers) -> None:
        number = len(topic)
        if self.filled + number > self.total:
            raise IndexMismatchError  # more than it states
        stamp = np.empty(number, dtype=np.int64)
        keep: NDArray[np.bool_] | None = None
        for where in range(len(self.topics)):
            rows = np.flatnonzero(topic == where)
            if not len(rows):
                continue
            failed = self._read_topic(where, batch, rows, reader[rows], stamp)
            if failed:
                keep = np.ones(number, dtype=bool) if keep is None else keep
                keep[rows[failed]] = False
        self.met += number
        kept: NDArray[np.bool_] | slice = slice(None) if keep is None else keep
        number = number if keep is None else int(np.count_nonzero(keep))
        where_to = slice(self.filled, self.filled + number)
        log_time = batch.log_time[kept]
        if number:
            in_reach(self.bag.path, int(log_time.max()))
        self.topic[where_to] = topic[kept]
        self.arrival[where_to] = log_time
        self.stamp[where_to] = stamp[kept]
        self.filled += number

    def _read_topic(self, where: int, batch: Batch, rows: Integers, reader: Integers, stamp: Integers) -> list[int]:
        """Read the messages of one topic; returns which of them cannot be decoded."""
        begin = self.filled_of[where]
        values = self.values[where][begin : begin + len(rows)]
        if len(values) < len(rows):
            raise IndexMismatchError
        failures: list[tuple[int, str]] = []
        for number in np.unique(reader).tolist():
            mine = np.flatnonzero(reader == number)
            begins, ends = batch.begin[rows[mine]], batch.end[rows[mine]]
            read, stamps = np.empty((len(mine), values.shape[1])), np.empty(len(mine), dtype=np.int64)
            whole = len(mine) == len(rows)
            failed = self.readers[number].read(batch.data, begins, ends, values if whole else read, stamps)
            failures += [(int(mine[row]), why) for row, why in failed]
            stamp[rows[mine]] = stamps
            if not whole:
                values[mine] = read
        for row, why in failures:
            self.undecoded[where].add((int(batch.log_time[rows[row]]), self.met + int(rows[row])), why)
        if failures:
            kept = np.ones(len(rows), dtype=bool)
            kept[[row for row, _ in failures]] = False
            good = values[kept]
            values[: len(good)] = good
        self.filled_of[where] += len(rows) - len(failures)
        return [row for row, _ in failures]

    def _note_left_out(self) -> None:
        warnings, undecoded = self.bag.reading_notes
        met = [(entry.first, name, entry) for name, entry in zip(self.topics, self.undecoded, strict=True)]
        for _, name, entry in sorted((m for m in met if m[2].number), key=lambda m: m[0]):
            undecoded[name] = self.bag.left_out(name, entry.number, entry.why)
        self.bag.restore_notes(warnings, undecoded)

    def _in_order(self) -> Columns:
        """Stable sort by log time: messages are in file order so far."""
        topic, arrival, stamp = self.topic[: self.filled], self.arrival[: self.filled], self.stamp[: self.filled]
        values = [v[:n] for v, n in zip(self.values, self.filled_of, strict=True)]
        alone = sum(reader.alone for reader in self.readers)
        if (arrival[1:] >= arrival[:-1]).all():
            return Columns(topic, arrival, stamp, values, alone)
        order = np.argsort(arrival, kind="stable")
        row = np.empty(len(order), dtype=np.int64)
        for where in range(len(values)):
            mine = topic == where
            row[mine] = np.arange(len(values[where]))
        topic = topic[order]
        row = row[order]
        for where, read in enumerate(values):
            mine = row[topic == where]
            if (mine[1:] < mine[:-1]).any():
                values[where] = read[mine]
        return Columns(topic, arrival[order], stamp[order], values, alone)


_BATCH = 1 << 22  # bytes; small blocks are put together until they reach this
_CHECKSUM_AT = RECORD.size + 24


class IndexMismatchError(Exception):
    """The file is not what its index states: it has to be walked."""


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
        data, ends = _load(contents, group, channels)
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
    group: list[Block] = []
    size = 0
    for block in blocks:
        if group and size + block.length > _BATCH:
            yield group
            group, size = [], 0
        group.append(block)
        size += block.length
    if group:
        yield group


def _load(contents: Contents, blocks: Sequence[Block], channels: Collection[int]) -> tuple[bytearray, list[int]]:
    """Read and decompress blocks, and check those that nobody has read before."""
    data, ends = bytearray(), []
    try:
        with open(contents.path, "rb", buffering=0) as stream:
            for block in blocks:
                if contents.converted:
                    data += contents.records(block, channels)
                else:
                    data += _records(contents, block, stream)
                ends.append(len(data))
    except OSError as error:
        raise os_error(contents.path, error) from None
    return data, ends


def _records(contents: Contents, block: Block, stream: BinaryIO) -> bytes | memoryview:
    stream.seek(block.offset - block.unchecked)
    packed = memoryview(stream.read(block.unchecked + block.size))
    records, trouble = inflate(block.compression, packed[block.unchecked :], block.length)
    if contents.indexed:
        whole = not trouble and len(records) == block.length
        if not whole or not _as_stated(contents, block, packed[: block.unchecked], records):
            raise IndexMismatchError
    elif len(records) < block.length:
        raise BagError(f"{contents.path}: the file changed while it was read; read it again when it is written")
    return records[: block.length]


def _as_stated(contents: Contents, block: Block, head: memoryview, records: bytes | memoryview) -> bool:
    """Compare what precedes a block with it, and its records against their checksum."""
    checksum = int.from_bytes(head[_CHECKSUM_AT : _CHECKSUM_AT + 4], "little")
    name = block.compression.encode()
    length = block.unchecked - RECORD.size + block.size
    stated = RECORD.pack(Opcode.CHUNK, length) + CHUNK.pack(block.start, block.end, block.length, checksum, len(name))
    stated += name + block.size.to_bytes(8, "little")
    return head == stated and (crc32(records) == checksum if checksum else not contents.summed)


def _messages(data: bytearray, ends: Sequence[int], wanted: NDArray[np.bool_], contents: Contents) -> Batch:
    """Messages of wanted channels among the records."""
    left = most_records(contents.size)
    found: list[tuple[NDArray[Any], ...]] = []
    for begin, end in pairwise([0, *ends]):
        records = walk_records(data, begin, end, left if contents.indexed else end - begin)
        if contents.indexed:
            left -= records.number
            if records.stop != end or records.short:
                raise IndexMismatchError
            for definition in records.definitions:
                _hold_against(contents, data, *definition)
        keep = wanted[records.channel]
        columns = records.channel, records.log_time, records.begin, records.end
        found.append(columns if keep.all() else tuple(column[keep] for column in columns))
    return Batch(data, *(np.concatenate(columns) for columns in zip(*found, strict=True)))


def _hold_against(contents: Contents, data: bytearray, opcode: int, begin: int, end: int) -> None:
    """A definition in a chunk has to be the one that the summary gives."""
    record = parse(Schema if opcode == Opcode.SCHEMA else Channel, bytes(memoryview(data)[begin:end]))
    known: object = None
    if record is not None:
        known = (contents.schemas if opcode == Opcode.SCHEMA else contents.channels).get(record.id)
    if record is None or record != known:
        raise IndexMismatchError
