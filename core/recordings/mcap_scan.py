# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Scan of an MCAP file: its blocks of raw messages, whatever is missing from it or damaged.

A file is walked once from its beginning (`scan`), without need of summary, index or footer, and then read block by
block (`mcap_records`); or what its summary states is used until then (`outline`). A block is a chunk, or a stretch of
records outside chunks.

What counts when a file is not whole:

- Cut (no footer): everything before the cut counts, also what can be decompressed of a chunk that the cut
  goes through.
- A chunk whose checksum or sizes are wrong, or that cannot be decompressed, is left out altogether: a number
  with a flipped bit does more harm than a gap.
- A record whose length cannot be: reading goes on at the next chunk that the summary knows, if it does.
- Sizes stated in the file never decide how much memory or time is taken. A record is compared with the size of the
  file before it is read; a chunk is decompressed piece by piece up to the size it states, at most 256 MiB; all
  chunks together give at most 1000 times the size of the file (or 1 GiB), and at most one record per byte of it (or
  2^20). What goes beyond is left out.

Each of these is reported in `Contents.warnings`.
"""

from __future__ import annotations

import bisect
import struct
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd, Schema, Statistics

from uncertain_lti.base.files import MAGIC
from uncertain_lti.recordings.mcap_records import (
    CHUNK,
    FOOTER_SIZE,
    LARGEST_CHUNK,
    LATEST,
    MESSAGE,
    PIECE,
    PRIVATE,
    RECORD,
    Block,
    Contents,
    Tally,
    count,
    crc32,
    inflate,
    parse,
    seconds,
    walk,
)
from uncertain_lti.recordings.mcap_walk import Records, walk_records
from uncertain_lti.recordings.unreadable import LARGEST_RATIO, most_inflated, not_mcap, os_error

_DATA_END_SIZE = RECORD.size + 4
_FOOTER = struct.Struct("<QQI")  # begin of the summary, begin of its offsets, checksum
_CHUNK_INDEX = struct.Struct("<QQQQI")  # first and last log time, place and length of the chunk, size of what follows
_INDEX_OFFSET = struct.Struct("<HQ")  # channel, place of its message index
_INDEX_REST = struct.Struct("<QI")  # length of the message indexes, of the compression's name
_SIZES = struct.Struct("<QQ")  # compressed, decompressed
_LEAST_STRETCH = 1 << 14  # bytes
_BARE_BLOCK = 1 << 22  # bytes; so much of a file without chunks is read at once
_CHUNK_AT = struct.Struct("<16xQ")  # in a chunk's index
_FIRST_WARNINGS = 3  # of a kind that are reported one by one
_LEAST_RECORDS = 1 << 20
_LARGEST_DEFINITION = 1 << 24  # bytes
_LARGEST_DEFINITIONS = 1 << 26  # bytes, all of a file


def most_records(size: int) -> int:
    """Records that compressed chunks may hold together; one of a recording takes several bytes."""
    return max(_LEAST_RECORDS, size)


def scan(path: Path) -> Contents:
    """Walk a file once and note where its messages are."""
    try:
        with open(path, "rb", buffering=1 << 18) as stream:
            size = stream.seek(0, 2)
            stream.seek(0)
            head = stream.read(4096)
            if not head.startswith(MAGIC):
                raise not_mcap(path, head)
            return _Scanner(path, stream, size).run()
    except OSError as error:
        raise os_error(path, error) from None


class _Scanner:
    def __init__(self, path: Path, stream: BinaryIO, size: int) -> None:
        self.stream = stream
        self.found = Contents(path, size)
        self.sums = 0  # checksum of everything before the current record
        self.statistics: Statistics | None = None
        self.summary_schemas: dict[int, Schema] = {}
        self.summary_channels: dict[int, Channel] = {}
        self.known: list[int] = []  # where chunks begin that the summary knows
        self.warned = {"place": 0, "chunk": 0, "definition": 0}  # warnings of each kind
        self.chunk_warnings: list[str] = []
        self.damaged = False
        self.odd_records = 0
        self.records_left = most_records(size)  # in chunks
        self.bytes_left = most_inflated(size)
        self.definitions_left = _LARGEST_DEFINITIONS
        self.stretch = _LEAST_STRETCH  # bytes outside chunks that are read at once

    def run(self) -> Contents:
        found, path = self.found, self.found.path
        self.closed = self._at(found.size - len(MAGIC), len(MAGIC)) == MAGIC and found.size >= 2 * len(MAGIC)
        if self.closed:
            self._summary()
        ended = self._data_section()
        found.schemas = self.summary_schemas | found.schemas
        found.channels = self.summary_channels | found.channels
        lost = self._orphans()
        if ended and not self.closed:
            found.warnings.append(
                f"{path}: no footer at its end; all its {count(found.count, 'message')} could be read"
            )
        elif not self.closed:
            found.warnings.append(f"{path}: cut after {count(found.count, 'message')} (no footer); read up to the cut")
        found.warnings += self.chunk_warnings
        for kind, what in (
            ("place", "left out as damaged"),
            ("chunk", "left out for reasons like these"),
            ("definition", "that contradicts an earlier one"),
        ):
            if (more := self.warned[kind] - _FIRST_WARNINGS) > 0:
                found.warnings.append(f"{path}: {count(more, f'more {kind}')} {what}")
        if self.odd_records:
            found.warnings.append(
                f"{path}: {count(self.odd_records, 'record')} that cannot be read left out; "
                f"the recorder or the disk damaged the file"
            )
        if lost:
            found.warnings.append(f"{path}: {count(lost, 'message')} of channels that are nowhere described left out")
        stated = self.statistics.message_count if self.statistics else 0
        if stated > found.count:
            found.warnings.append(f"{path}: its summary counts {count(stated, 'message')}, {found.count} could be read")
        return found

    # --- the data section -----------------------------------------------------------------------------------

    def _data_section(self) -> bool:
        """Walk all records up to the end of the data section; False where the file ends before."""
        size, offsets = self.found.size, self.known
        position = len(MAGIC)
        self.sums = crc32(MAGIC)
        self.stream.seek(position)
        while True:
            header = self.stream.read(RECORD.size)
            if len(header) < RECORD.size:
                return False
            opcode, length = RECORD.unpack(header)
            begin, end = position + RECORD.size, position + RECORD.size + length
            later = bisect.bisect_right(offsets, position)
            following = offsets[later] if later < len(offsets) else size
            ends = opcode == Opcode.DATA_END or opcode == Opcode.FOOTER
            if opcode == 0 or end > following or (ends and following < size):
                if self.closed or opcode == 0:
                    self._damage(position, following)
                elif opcode == Opcode.CHUNK:
                    self._chunk(position, begin, self.stream.read(size - begin), cut=True)
                if following == size:
                    return False
                position = following
                self.stream.seek(position)
                continue
            if ends:
                self._data_end(parse(DataEnd, self.stream.read(length)) if opcode == Opcode.DATA_END else None)
                return True
            if opcode in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
                position = self._bare(position, end, following)
                self.stream.seek(position)
                continue
            self.sums = crc32(header, self.sums)
            if opcode == Opcode.CHUNK:
                content = self.stream.read(length)
                self.sums = crc32(content, self.sums)
                self._chunk(position, begin, content)
            else:  # attachments, metadata, indexes, private records: only their bytes and their place count
                if opcode in (Opcode.ATTACHMENT, Opcode.METADATA) or opcode >= PRIVATE:
                    self.found.others.append(position)
                left = length
                while left and (piece := self.stream.read(min(left, PIECE))):
                    self.sums = crc32(piece, self.sums)
                    left -= len(piece)
            position = end

    def _data_end(self, record: DataEnd | None) -> None:
        if record and record.data_section_crc not in (0, self.sums) and not self.damaged:
            self.found.warnings.append(
                f"{self.found.path}: the checksum of the file is wrong, so a number in it may be; "
                f"copy it again if you can"
            )

    def _damage(self, position: int, following: int) -> None:
        self.damaged = True
        if self._first("place"):
            rest = "the rest is" if following == self.found.size else f"{count(following - position, 'byte')} are"
            self.found.warnings.append(f"{self.found.path}: damaged at byte {position}; {rest} left out")

    def _first(self, kind: str) -> bool:
        """Whether a warning of this kind is one of the first, which are reported one by one."""
        self.warned[kind] += 1
        return self.warned[kind] <= _FIRST_WARNINGS

    def _bare(self, begin: int, end: int, following: int) -> int:
        """Records outside chunks, of which one ends at `end`, as far as there is nothing else; returns where that is.

        More is read at once the longer they go on: in between there may be chunks, which are then read twice.
        """
        records = self._at(begin, max(end - begin, min(self.stretch, following - begin)))
        found = walk_records(records, 0, len(records), len(records), bare=True)
        self.stretch = min(4 * self.stretch, _BARE_BLOCK) if 2 * found.stop > len(records) else _LEAST_STRETCH
        self.sums = crc32(memoryview(records)[: found.stop], self.sums)
        self._take(records, found)
        if len(found.channel):
            self._block(begin, found.stop, "", found.stop, _tally(found))
        return begin + found.stop

    def _take(self, records: bytes | memoryview, found: Records) -> None:
        for opcode, start, stop in found.definitions:
            self._definition(opcode, records[start:stop])
        self.odd_records += found.short

    def _chunk(self, position: int, begin: int, content: bytes, cut: bool = False) -> None:
        if len(content) < CHUNK.size:
            self._leave_out(position, "its record is too short", cut)
            return
        first, last, stated, checksum, name_length = CHUNK.unpack_from(content)
        where = f"{position} (log time {seconds(first)} to {seconds(last)} s)"
        data_begin = CHUNK.size + name_length + 8
        if len(content) < data_begin:
            self._leave_out(where, "its sizes contradict each other", cut)
            return
        compression = content[CHUNK.size : CHUNK.size + name_length].decode(errors="replace")
        (length,) = struct.unpack_from("<Q", content, data_begin - 8)
        data = memoryview(content)[data_begin : data_begin + length]
        if not cut and (data_begin + length != len(content) or (not compression and length != stated)):
            self._leave_out(where, "its sizes contradict each other")
            return
        if compression and stated > LARGEST_CHUNK and not cut:
            self._leave_out(
                where,
                f"it states {count(stated, 'byte')} decompressed, and at most {LARGEST_CHUNK >> 20} MiB are taken",
            )
            return
        stated = min(stated, max(LARGEST_CHUNK, len(data)))
        if compression and stated > self.bytes_left:
            self._leave_out(where, f"with it the file is over {LARGEST_RATIO} times its size when decompressed", cut)
            return
        records, trouble = inflate(compression, data, stated)
        self.bytes_left -= len(records) if compression else 0
        if cut:
            records = records[:stated]
        else:
            if not trouble and len(records) != stated:
                trouble = f"it holds {'more' if len(records) > stated else 'less'} than it states"
            if not trouble and checksum not in (0, crc32(records)):
                trouble = "its checksum is wrong"
            if trouble:
                self._leave_out(where, trouble)
                return
        found = walk_records(records, 0, len(records), self.records_left + 1 if compression else len(records))
        if compression:
            self.records_left -= found.number
            if self.records_left < 0:
                self.records_left = 0
                self._leave_out(where, "with it the file holds more records than bytes", cut)
                return
        self._take(records, found)
        self.odd_records += found.stop < len(records) and not cut
        if len(found.channel):
            self._block(begin + data_begin, len(data), compression, found.stop, _tally(found), cut)

    def _leave_out(self, where: object, why: str, cut: bool = False) -> None:
        if not cut:  # what little a cut leaves of a chunk's beginning is reported with the cut
            self.damaged = True
            if self._first("chunk"):
                path = self.found.path
                self.chunk_warnings.append(f"{path}: chunk at byte {where}: {why}; its messages are left out")

    def _block(
        self, offset: int, size: int, compression: str, length: int, tally: dict[int, Tally], cut: bool = False
    ) -> None:
        self.found.blocks.append(
            Block(
                offset,
                size,
                compression,
                length,
                start=min(entry.first for entry in tally.values()),
                end=max(entry.last for entry in tally.values()),
                channels=frozenset(tally),
                cut=cut,
            )
        )
        for channel, entry in tally.items():
            _add(self.found.tally, channel, entry)

    def _definition(self, opcode: int, content: bytes | memoryview) -> None:
        record = None
        if len(content) <= _LARGEST_DEFINITION:
            record = parse(Schema if opcode == Opcode.SCHEMA else Channel, content)
        if record is None:
            self.odd_records += 1
            return
        table: dict[int, Any] = self.found.schemas if isinstance(record, Schema) else self.found.channels
        if (known := table.get(record.id)) is None:
            self.definitions_left -= len(content)
            if self.definitions_left >= 0:
                table[record.id] = record
            else:
                self.odd_records += 1
        elif known != record and not self.damaged and self._first("definition"):
            what = "schema" if isinstance(record, Schema) else f"channel ({record.topic})"
            self.found.warnings.append(
                f"{self.found.path}: {what} {record.id} is defined twice, differently; the first one counts"
            )

    def _orphans(self) -> int:
        """Messages whose channel has no record, for example because its chunk is damaged, are no topic's."""
        lost = [channel for channel in self.found.tally if channel not in self.found.channels]
        return sum(self.found.tally.pop(channel).count for channel in lost)

    # --- the summary ----------------------------------------------------------------------------------------

    def _summary(self) -> None:
        """Definitions, statistics and places of chunks, where the file states them and their checksum holds."""
        stated = _summary_of(self.stream, self.found.size)
        if stated is None:
            return
        _, records, whole = stated
        if not whole:
            self.found.warnings.append(f"{self.found.path}: the checksum of its summary is wrong; read without it")
            return
        for opcode, begin, end in walk(records):
            if opcode == Opcode.SCHEMA and (schema := parse(Schema, records[begin:end])):
                self.summary_schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL and (channel := parse(Channel, records[begin:end])):
                self.summary_channels[channel.id] = channel
            elif opcode == Opcode.STATISTICS:
                self.statistics = parse(Statistics, records[begin:end])
            elif opcode == Opcode.CHUNK_INDEX:
                offset = _CHUNK_AT.unpack_from(records, begin)[0] if end - begin >= _CHUNK_AT.size else 0
                if len(MAGIC) <= offset and self._at(offset, 1) == bytes([Opcode.CHUNK]):
                    self.known.append(offset)
        self.known.sort()

    def _at(self, offset: int, size: int) -> bytes:
        if offset < 0 or offset >= self.found.size:
            return b""
        self.stream.seek(offset)
        return self.stream.read(min(size, self.found.size - offset))


def _add(tally: dict[int, Tally], channel: int, more: Tally) -> None:
    if total := tally.get(channel):
        total.count += more.count
        total.first, total.last = min(total.first, more.first), max(total.last, more.last)
    else:
        tally[channel] = more


def _tally(found: Records) -> dict[int, Tally]:
    order = np.argsort(found.channel, kind="stable")
    channels, starts, counts = np.unique(found.channel[order], return_index=True, return_counts=True)
    times = found.log_time[order]
    ends = np.minimum.reduceat(times, starts), np.maximum.reduceat(times, starts)
    rows = zip(channels.tolist(), counts.tolist(), ends[0].tolist(), ends[1].tolist(), strict=True)
    return {channel: Tally(number, first, last) for channel, number, first, last in rows}


class _NoIndexError(Exception):
    """The file has no index that can be gone by."""


def outline(path: Path) -> Contents | None:
    """What the summary of a whole file says of its chunks, before any is read; None where it has to be walked.

    What is read by it afterwards is compared with it (`bag_arrays`): the head of every chunk, its checksum, the number
    of messages of every channel. Where anything is not as stated, the file is walked instead, so a damaged file reads
    the same either way. Damage to what is not read stays unseen.
    """
    try:
        with open(path, "rb", buffering=0) as stream:
            size = stream.seek(0, 2)
            stream.seek(0)
            stated = _summary_of(stream, size) if stream.read(len(MAGIC)) == MAGIC else None
            if stated is None or not stated[2] or stated[0] < len(MAGIC) + _DATA_END_SIZE:
                return None
            begin, summary, _ = stated
            stream.seek(begin - _DATA_END_SIZE)
            data_end = stream.read(_DATA_END_SIZE)
    except OSError as error:
        raise os_error(path, error) from None
    if data_end[:9] != RECORD.pack(Opcode.DATA_END, 4):
        return None
    try:
        return _contents(path, size, summary, begin - _DATA_END_SIZE, data_end[9:] != bytes(4))
    except (_NoIndexError, struct.error, UnicodeDecodeError):
        return None


def _summary_of(stream: BinaryIO, size: int) -> tuple[int, bytes, bool] | None:
    """Where the summary begins, its records, and whether its checksum holds; None where the file states none."""
    foot = size - len(MAGIC) - FOOTER_SIZE
    if foot < len(MAGIC):
        return None
    stream.seek(foot)
    tail = stream.read(FOOTER_SIZE + len(MAGIC))
    if tail[:9] != RECORD.pack(Opcode.FOOTER, _FOOTER.size) or not tail.endswith(MAGIC):
        return None
    begin, _, checksum = _FOOTER.unpack_from(tail, RECORD.size)
    if not len(MAGIC) <= begin < foot:
        return None
    stream.seek(begin)
    records = stream.read(foot - begin)
    return begin, records, checksum in (0, crc32(tail[: FOOTER_SIZE - 4], crc32(records)))


def _contents(path: Path, size: int, summary: bytes, data_end: int, data_crc: bool) -> Contents:
    found = Contents(path, size, indexed=True, summed=data_crc)
    statistics: Statistics | None = None
    blocks: list[Block] = []
    for opcode, begin, end in walk(summary):
        if opcode == Opcode.CHUNK_INDEX:
            blocks.append(_block(summary[begin:end], data_end))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            record = parse(Schema if opcode == Opcode.SCHEMA else Channel, summary[begin:end])
            table: dict[int, object] = found.schemas if isinstance(record, Schema) else found.channels  # type: ignore[assignment]
            if record is None or table.setdefault(record.id, record) != record:
                raise _NoIndexError
        elif opcode == Opcode.STATISTICS:
            statistics = parse(Statistics, summary[begin:end])
    if statistics is None or statistics.chunk_count != len(blocks):
        raise _NoIndexError
    if any(channel.schema_id and channel.schema_id not in found.schemas for channel in found.channels.values()):
        raise _NoIndexError  # they are in the chunks
    blocks.sort(key=lambda block: block.offset)
    if any(before.offset + before.size > after.offset - after.unchecked for before, after in pairwise(blocks)):
        raise _NoIndexError
    if statistics.message_count > most_records(size) or sum(block.length for block in blocks) > most_inflated(size):
        raise _NoIndexError
    counts = {channel: number for channel, number in statistics.channel_message_counts.items() if number}
    found.blocks = [block for block in blocks if block.channels]
    room: dict[int, int] = {}  # messages that the blocks of a channel can hold
    for block in found.blocks:
        for channel in block.channels:
            room[channel] = room.get(channel, 0) + block.length // (RECORD.size + MESSAGE.size)
            there = found.tally.setdefault(channel, Tally(0, block.start, block.end))
            there.first, there.last = min(there.first, block.start), max(there.last, block.end)
    if not counts or room.keys() != counts.keys():
        raise _NoIndexError
    for channel, number in counts.items():
        if channel not in found.channels or number > room[channel]:
            raise _NoIndexError
        found.tally[channel].count = number
    if statistics.message_count != found.count:
        raise _NoIndexError
    return found


@lru_cache(maxsize=256)
def _channels(low: bytes, high: bytes) -> frozenset[int]:
    """Numbers from their low and high bytes; most chunks hold the same channels."""
    return frozenset(a + 256 * b for a, b in zip(low, high, strict=True))


def _block(index: bytes, data_end: int) -> Block:
    start, end, place, chunk_length, size_of_offsets = _CHUNK_INDEX.unpack_from(index)
    rest = _CHUNK_INDEX.size + size_of_offsets
    listed, pair = index[_CHUNK_INDEX.size : rest], _INDEX_OFFSET.size
    if len(listed) % pair:
        raise _NoIndexError
    channels = _channels(listed[::pair], listed[1::pair])
    index_length, name_length = _INDEX_REST.unpack_from(index, rest)
    name_at = rest + _INDEX_REST.size
    compression = index[name_at : name_at + name_length].decode()
    size, length = _SIZES.unpack_from(index, name_at + name_length)
    before = RECORD.size + CHUNK.size + name_length + 8
    if chunk_length != before + size or place < len(MAGIC) or place + chunk_length > data_end:
        raise _NoIndexError
    if compression not in ("", "lz4", "zstd") or length > LARGEST_CHUNK or (not compression and length != size):
        raise _NoIndexError
    if place + chunk_length + index_length > data_end or end > LATEST:
        raise _NoIndexError
    return Block(place + before, size, compression, length, start, end, channels, before)
