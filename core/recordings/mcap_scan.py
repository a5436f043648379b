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
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, DataEnd, Schema, Statistics

from uncertain_lti.base.files import MAGIC
from uncertain_lti.recordings.mcap_records import LATEST, PIECE, RECORD, Block, Contents, Tally, count, inflate, parse
from uncertain_lti.recordings.mcap_walk import Records, walk_records
from uncertain_lti.recordings.mcap_writer import MESSAGE_HEAD
from uncertain_lti.recordings.unreadable import LARGEST_RATIO, most_inflated, not_mcap

try:
    from isal.isal_zlib import crc32 as crc32
except ImportError:
    from zlib import crc32 as crc32


CHUNK = struct.Struct("<QQQII")  # first and last log time, size, checksum, length of the compression's name
_LARGEST_CHUNK = 1 << 28  # bytes, decompressed; recorders write chunks of 1 to 10 MB
_PRIVATE = 0x80  # opcodes from here on mean something to their maker alone
_DATA_END_SIZE = RECORD.size + 4
_FOOTER = struct.Struct("<QQI")  # begin of the summary, begin of its offsets, checksum
_FOOTER_SIZE = RECORD.size + _FOOTER.size
_IN_SUMMARY: dict[int, Any] = {
    Opcode.SCHEMA: Schema, Opcode.CHANNEL: Channel, Opcode.STATISTICS: Statistics, Opcode.CHUNK_INDEX: ChunkIndex,
}  # fmt: skip
_LEAST_STRETCH = 1 << 14  # bytes
_BARE_BLOCK = 1 << 22  # bytes; so much of a file without chunks is read at once
_FIRST_WARNINGS = 3  # of a kind that are reported one by one
_LIKE_THESE = {"place": "left out as damaged", "chunk": "left out for reasons like these",
               "definition": "that contradicts an earlier one"}  # fmt: skip
_LEAST_RECORDS = 1 << 20
_LARGEST_DEFINITION = 1 << 24  # bytes
_LARGEST_DEFINITIONS = 1 << 26  # bytes, all of a file


def most_records(size: int) -> int:
    """Records that compressed chunks may hold together; one of a recording takes several bytes."""
    return max(_LEAST_RECORDS, size)


def scan(path: Path) -> Contents:
    """Walk a file once and note where its messages are."""
    with open(path, "rb", buffering=1 << 18) as stream:
        size = stream.seek(0, 2)
        stream.seek(0)
        head = stream.read(4096)
        if not head.startswith(MAGIC):
            raise not_mcap(path, head)
        return _Scanner(path, stream, size).run()


class _Scanner:
    def __init__(self, path: Path, stream: BinaryIO, size: int) -> None:
        self.stream = stream
        self.found = Contents(path, size)
        self.sums = 0  # checksum of everything before the current record
        self.summary = _Summary(0, True)
        self.known: list[int] = []  # where chunks begin that the summary knows
        self.warned = Counter[str]()  # warnings of each kind
        self.chunk_warnings: list[str] = []
        self.damaged = False
        self.odd_records = self.late = self.nested = 0
        self.records_left = most_records(size)  # in chunks
        self.bytes_left = most_inflated(size)
        self.definitions_left = _LARGEST_DEFINITIONS
        self.stretch = _LEAST_STRETCH  # bytes outside chunks that are read at once

    def run(self) -> Contents:
        found = self.found
        self.closed = self._at(found.size - len(MAGIC), len(MAGIC)) == MAGIC and found.size >= 2 * len(MAGIC)
        self._summary()
        ended = self._data_section()
        found.schemas = self.summary.schemas | found.schemas
        found.channels = self.summary.channels | found.channels
        # messages whose channel has no record, for example because its chunk is damaged, are no topic's
        orphans = [channel for channel in found.tally if channel not in found.channels]
        lost = sum(found.tally.pop(channel).count for channel in orphans)
        if ended and not self.closed:
            self._warn(f"no footer at its end; all its {count(found.count, 'message')} could be read")
        elif not self.closed:
            self._warn(f"cut after {count(found.count, 'message')} (no footer); read up to the cut")
        found.warnings += self.chunk_warnings
        for kind, what in _LIKE_THESE.items():
            if (more := self.warned[kind] - _FIRST_WARNINGS) > 0:
                self._warn(f"{count(more, f'more {kind}')} {what}")
        if self.odd_records:
            odd = count(self.odd_records, "record")
            self._warn(f"{odd} that cannot be read left out; the recorder or the disk damaged the file")
        if self.nested:
            within = "inside other chunks left out with all messages in it, as MCAP allows none there"
            self._warn(f"{count(self.nested, 'chunk')} {within}; mend what wrote the file")
        if self.late:
            self._warn(f"{count(self.late, 'message')} past the year 2262 left out; the recorder's clock was wrong")
        if lost:
            self._warn(f"{count(lost, 'message')} of channels that are nowhere described left out")
        stated = self.summary.statistics.message_count if self.summary.statistics else 0
        if stated > found.count + self.late:
            self._warn(f"its summary counts {count(stated, 'message')}, {found.count} could be read")
        return found

    # --- the data section -----------------------------------------------------------------------------------

    def _data_section(self) -> bool:
        """Walk all records up to the end of the data section; False where the file ends before."""
        size, offsets = self.found.size, self.known
        position = len(MAGIC)
        self.sums = crc32(MAGIC)
        self.stream.seek(position)
        while True:
            header = self.stream.read(min(RECORD.size, size - position))  # a recorder may write more meanwhile
            if len(header) < RECORD.size:
                return False
            opcode, length = RECORD.unpack(header)
            begin, end = position + RECORD.size, position + RECORD.size + length
            later = bisect.bisect_right(offsets, position)
            following = offsets[later] if later < len(offsets) else size
            ends = opcode == Opcode.DATA_END or opcode == Opcode.FOOTER
            if opcode == 0 or end > following or (ends and following < size):
                if self.closed or opcode == 0:
                    self.damaged = True
                    if self._first("place"):
                        rest = "the rest is" if following == size else f"{count(following - position, 'byte')} are"
                        self._warn(f"damaged at byte {position}; {rest} left out")
                elif opcode == Opcode.CHUNK:
                    self._chunk(position, begin, self.stream.read(size - begin), cut=True)
                if following == size:
                    return False
                position = following
                self.stream.seek(position)
                continue
            if ends:
                record = parse(DataEnd, self.stream.read(length)) if opcode == Opcode.DATA_END else None
                if record and record.data_section_crc not in (0, self.sums) and not self.damaged:
                    self._warn("the checksum of the file is wrong, so a number in it may be; copy it again if you can")
                if self.closed and (behind := size - self._end(position)) > 0:
                    joined = "as of a second file that was joined to it: name files one by one"
                    self._warn(f"{count(behind, 'byte')} behind its end left out, {joined}")
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
                if opcode in (Opcode.ATTACHMENT, Opcode.METADATA) or opcode >= _PRIVATE:
                    self.found.others.append(position)
                left = length
                while left and (piece := self.stream.read(min(left, PIECE))):
                    self.sums = crc32(piece, self.sums)
                    left -= len(piece)
            position = end

    def _end(self, position: int) -> int:
        """Where the first footer from a record on ends, with its magic."""
        while len(header := self._at(position, RECORD.size)) == RECORD.size:
            opcode, length = RECORD.unpack(header)
            position += RECORD.size + length
            if opcode == Opcode.FOOTER:
                return position + len(MAGIC)
        return self.found.size

    def _warn(self, text: str) -> None:
        self.found.warnings.append(f"{self.found.path}: {text}")

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
        self.late += found.late
        self.nested += found.nested

    def _chunk(self, position: int, begin: int, content: bytes, cut: bool = False) -> None:
        """Take a chunk, or leave it out; what little a cut leaves of a chunk's beginning is reported with the cut."""
        why = self._why_not(begin, content, cut)
        if why and not cut:
            self.damaged = True
            if self._first("chunk"):
                where = str(position)
                if len(content) >= CHUNK.size:
                    first, last, *_ = CHUNK.unpack_from(content)
                    where += f" (log time {_seconds(first)} to {_seconds(last)} s)"
                path = self.found.path
                self.chunk_warnings.append(f"{path}: chunk at byte {where}: {why}; its messages are left out")

    def _why_not(self, begin: int, content: bytes, cut: bool) -> str:
        """Take a chunk, unless there is a reason against it."""
        if len(content) < CHUNK.size:
            return "its record is too short"
        _, _, stated, checksum, name_length = CHUNK.unpack_from(content)
        data_begin = CHUNK.size + name_length + 8
        if len(content) < data_begin:
            return "its sizes contradict each other"
        compression = content[CHUNK.size : CHUNK.size + name_length].decode(errors="replace")
        (length,) = struct.unpack_from("<Q", content, data_begin - 8)
        data = memoryview(content)[data_begin : data_begin + length]
        if not cut and (data_begin + length != len(content) or (not compression and length != stated)):
            return "its sizes contradict each other"
        if compression and stated > _LARGEST_CHUNK and not cut:
            return (
                f"it states {count(stated, 'byte')} decompressed, and at most {_LARGEST_CHUNK >> 20} MiB are taken: "
                f"write smaller ones with `mcap compress {self.found.path.name} -o smaller.mcap`"
            )
        stated = min(stated, max(_LARGEST_CHUNK, len(data)))
        if compression and stated > self.bytes_left:
            return f"with it the file is over {LARGEST_RATIO} times its size when decompressed"
        records, trouble = inflate(compression, data, stated)
        self.bytes_left -= len(records) if compression else 0
        if cut:
            records = records[:stated]
        elif trouble:
            return trouble
        elif len(records) != stated:
            return f"it holds {'more' if len(records) > stated else 'less'} than it states"
        elif checksum not in (0, crc32(records)):
            return "its checksum is wrong"
        found = walk_records(records, 0, len(records), self.records_left + 1 if compression else len(records))
        if compression:
            if found.number > self.records_left:
                self.records_left = 0
                return "with it the file holds more records than bytes"
            self.records_left -= found.number
        self._take(records, found)
        self.odd_records += found.stop < len(records) and not cut
        if len(found.channel):
            self._block(begin + data_begin, len(data), compression, found.stop, _tally(found))
        return ""

    def _block(self, offset: int, size: int, compression: str, length: int, tally: dict[int, Tally]) -> None:
        start, end = min(entry.first for entry in tally.values()), max(entry.last for entry in tally.values())
        self.found.blocks.append(Block(offset, size, compression, length, start, end, frozenset(tally)))
        for channel, more in tally.items():
            if total := self.found.tally.get(channel):
                total.count += more.count
                total.first, total.last = min(total.first, more.first), max(total.last, more.last)
            else:
                self.found.tally[channel] = more

    def _definition(self, opcode: int, content: bytes | memoryview) -> None:
        is_schema = opcode == Opcode.SCHEMA
        table: dict[int, Any] = self.found.schemas if is_schema else self.found.channels
        fits = len(content) <= _LARGEST_DEFINITION
        record = parse(Schema if is_schema else Channel, content) if fits else None
        known = record and table.get(record.id)
        if record and not known:
            self.definitions_left -= len(content)
        if record is None or (not known and self.definitions_left < 0):
            self.odd_records += 1
        elif not known:
            table[record.id] = record
        elif known != record and not self.damaged and self._first("definition"):
            what = "schema" if is_schema else f"channel ({record.topic})"
            self._warn(f"{what} {record.id} is defined twice, differently; the first one counts")

    def _summary(self) -> None:
        """What the summary of a closed file states, and where chunks begin that it knows, if its checksum holds."""
        stated = _summary_of(self.stream, self.found.size) if self.closed else None
        if stated is None:
            return
        if not stated.whole:
            self._warn("the checksum of its summary is wrong; read without it")
            return
        self.summary = stated
        places = (chunk.chunk_start_offset for chunk in stated.chunks)
        self.known = sorted(at for at in places if at >= len(MAGIC) and self._at(at, 1) == bytes([Opcode.CHUNK]))

    def _at(self, offset: int, size: int) -> bytes:
        if offset < 0 or offset >= self.found.size:
            return b""
        self.stream.seek(offset)
        return self.stream.read(min(size, self.found.size - offset))


def _tally(found: Records) -> dict[int, Tally]:
    order = np.argsort(found.channel, kind="stable")
    channels, starts, counts = np.unique(found.channel[order], return_index=True, return_counts=True)
    times = found.log_time[order]
    ends = np.minimum.reduceat(times, starts), np.maximum.reduceat(times, starts)
    rows = zip(channels.tolist(), counts.tolist(), ends[0].tolist(), ends[1].tolist(), strict=True)
    return {channel: Tally(number, first, last) for channel, number, first, last in rows}


def _seconds(time_ns: int) -> str:
    """Nanoseconds written as seconds, exact to the millisecond."""
    return f"{time_ns // 10**9}.{time_ns % 10**9 // 10**6:03d}"


@dataclass
class _Summary:
    """What the summary of a file states.

    `begin`: where it begins; `whole`: whether its checksum holds; `sound`: whether every record of it can be read, and
    none contradicts another; `schemas`, `channels`, `statistics`, `chunks`: its records.
    """

    begin: int
    whole: bool
    sound: bool = True
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    statistics: Statistics | None = None
    chunks: list[ChunkIndex] = field(default_factory=list)


def _summary_of(stream: BinaryIO, size: int) -> _Summary | None:
    """The summary of a file; None where it has none."""
    foot = size - len(MAGIC) - _FOOTER_SIZE
    if foot < len(MAGIC):
        return None
    stream.seek(foot)
    tail = stream.read(_FOOTER_SIZE + len(MAGIC))
    if tail[:9] != RECORD.pack(Opcode.FOOTER, _FOOTER.size) or not tail.endswith(MAGIC):
        return None
    begin, _, checksum = _FOOTER.unpack_from(tail, RECORD.size)
    if not len(MAGIC) <= begin < foot:
        return None
    stream.seek(begin)
    records = stream.read(foot - begin)
    found = _Summary(begin, checksum in (0, crc32(tail[: _FOOTER_SIZE - 4], crc32(records))))
    for opcode, start, stop in _whole_records(records if found.whole else b""):
        if (kind := _IN_SUMMARY.get(opcode)) is None:
            continue
        record = parse(kind, records[start:stop])
        if isinstance(record, Statistics):
            found.statistics = record
        elif isinstance(record, ChunkIndex):
            found.chunks.append(record)
        elif record is None:
            found.sound = False
        else:
            table = found.schemas if kind is Schema else found.channels
            found.sound &= table.setdefault(record.id, record) == record
    return found


def _whole_records(records: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, begin and end of the content of each record, until the first one that is cut."""
    end = 0
    while end + RECORD.size <= len(records):
        opcode, length = RECORD.unpack_from(records, end)
        begin = end + RECORD.size
        end = begin + length
        if end > len(records) or opcode == 0:
            return
        yield opcode, begin, end


def outline(path: Path) -> Contents | None:
    """What the summary of a whole file says of its chunks, before any is read; None where it has to be walked.

    What is read by it afterwards is compared with it (`bag_arrays`): the head of every chunk, its checksum, the number
    of messages of every channel. Where anything is not as stated, the file is walked instead, so a damaged file reads
    the same either way. Damage to what is not read stays unseen.
    """
    with open(path, "rb", buffering=0) as stream:
        size = stream.seek(0, 2)
        stream.seek(0)
        stated = _summary_of(stream, size) if stream.read(len(MAGIC)) == MAGIC else None
        if stated is None or not stated.whole or stated.begin < len(MAGIC) + _DATA_END_SIZE:
            return None
        stream.seek(stated.begin - _DATA_END_SIZE)
        data_end = stream.read(_DATA_END_SIZE)
    if data_end[:9] != RECORD.pack(Opcode.DATA_END, 4) or stated.statistics is None:
        return None
    return _contents(path, size, stated, stated.statistics, data_end[9:] != bytes(4))


def _contents(path: Path, size: int, stated: _Summary, statistics: Statistics, summed: bool) -> Contents | None:
    """What a summary states, if it can be as it states."""
    blocks = sorted(map(_block, stated.chunks), key=lambda block: block.offset)
    shared: dict[frozenset[int], frozenset[int]] = {}  # most chunks hold the same channels
    counts = {channel: number for channel, number in statistics.channel_message_counts.items() if number}
    found = Contents(path, size, channels=stated.channels, schemas=stated.schemas, indexed=True, summed=summed)
    room: dict[int, int] = {}  # messages that the blocks of a channel can hold
    for block in blocks:
        if block.channels:
            found.blocks.append(block._replace(channels=shared.setdefault(block.channels, block.channels)))
        for channel in block.channels:
            room[channel] = room.get(channel, 0) + block.length // MESSAGE_HEAD.size
            there = found.tally.setdefault(channel, Tally(counts.get(channel, 0), block.start, block.end))
            there.first, there.last = min(there.first, block.start), max(there.last, block.end)
    can_be = (
        stated.sound
        and statistics.chunk_count == len(blocks)
        and all(_can_be(chunk, stated.begin - _DATA_END_SIZE) for chunk in stated.chunks)
        and all(one.offset + one.size <= other.offset - other.unchecked for one, other in pairwise(blocks))
        and sum(block.length for block in blocks) <= most_inflated(size)
        and all(channel.schema_id in (0, *found.schemas) for channel in found.channels.values())  # else in the chunks
        and 0 < statistics.message_count == found.count <= most_records(size)
        and room.keys() == counts.keys() <= found.channels.keys()
        and all(number <= room[channel] for channel, number in counts.items())
    )
    return found if can_be else None


def _block(chunk: ChunkIndex) -> Block:
    before = RECORD.size + CHUNK.size + len(chunk.compression.encode()) + 8
    return Block(
        chunk.chunk_start_offset + before,
        chunk.compressed_size,
        chunk.compression,
        chunk.uncompressed_size,
        start=chunk.message_start_time,
        end=chunk.message_end_time,
        channels=frozenset(chunk.message_index_offsets),
        unchecked=before,
    )


def _can_be(chunk: ChunkIndex, data_end: int) -> bool:
    block, begin = _block(chunk), chunk.chunk_start_offset
    return (
        chunk.chunk_length == block.unchecked + block.size
        and len(MAGIC) <= begin <= begin + chunk.chunk_length + chunk.message_index_length <= data_end
        and block.compression in ("", "lz4", "zstd")
        and block.length <= _LARGEST_CHUNK
        and (bool(block.compression) or block.length == block.size)
        and block.end <= LATEST
    )
