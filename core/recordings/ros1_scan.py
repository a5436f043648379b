# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Scan of a ROS 1 bag (version 2.0): its connections, and chunks that are read as MCAP records with CDR messages.

The records are walked from the beginning, so that a bag without an index, as one whose recorder was killed, or one
that is cut, gives what is there. What the index records behind a chunk state of its messages is believed; a chunk
without them is decompressed. Sizes stated in the file never decide how much memory is taken: they are compared with the
size of the file, and a chunk is decompressed up to the size it states, at most 256 MiB.

Messages are converted by `rosbags` (`Definition.from_ros1`) while they are read, those of wanted topics alone.
"""

from __future__ import annotations

import bz2
import struct
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, ClassVar

import numpy as np
from mcap.records import Channel, Schema

from uncertain_lti.base.errors import BagError
from uncertain_lti.recordings.mcap_records import (
    LARGEST_CHUNK,
    Block,
    Contents,
    Tally,
    count,
    inflate,
    message_record,
    stored_bytes,
)
from uncertain_lti.recordings.mcap_scan import most_inflated, most_records
from uncertain_lti.recordings.message_types import Definition, define, lines_of, normal_name, ros2_text
from uncertain_lti.recordings.unreadable import os_error

MAGIC = b"#ROSBAG V"
"""First bytes of a bag, of any version."""

_VERSION = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
_LENGTH = struct.Struct("<I")
_TIME = struct.Struct("<II")
_ENTRY = np.dtype([("sec", "<u4"), ("nsec", "<u4"), ("offset", "<u4")])
_LARGEST_HEADER = 1 << 20  # bytes
_LARGEST_DEFINITIONS = 1 << 26  # bytes, all of a file
_MOST_LINES = 100_000  # of definitions that are read in one file
_LEAST_LINES = 50  # that a definition counts for, however short it is
_MOST_CONNECTIONS = (1 << 16) - 1
_COMPRESSIONS = {"none": "", "": "", "bz2": "bz2", "lz4": "lz4"}

_Fields = Mapping[str, bytes]


class _DamagedError(Exception):
    """A record contradicts itself, or the file ends in it."""


@dataclass(slots=True)
class Ros1Bag(Contents):
    """What `scan_ros1` found in a file; offset and size of a block are those of a chunk's data.

    `numbers`: connection in the file -> number of its channel.
    """

    numbers: dict[int, int] = field(default_factory=dict)

    converted: ClassVar[bool] = True

    def records(self, block: Block, channels: Collection[int] | None = None) -> bytes:
        """Messages of one chunk as MCAP has them."""
        data = stored_bytes(self.path, block)
        records, _ = _inflate(block.compression, data, block.length)
        if len(data) < block.size or len(records) < block.length:
            raise BagError(f"{self.path}: the file changed while it was read; read it again when it is written")
        definitions: dict[int, Definition] = {}
        pieces: list[bytes] = []
        for op, fields, begin, end in _walk(memoryview(records)[: block.length]):
            if op != _MESSAGE:
                continue
            number = self.numbers.get(_number(fields, "conn"), 0)
            time = _time(fields)
            if not number or time is None or (channels is not None and number not in channels):
                continue
            if number not in definitions:
                schema = self.schemas[self.channels[number].schema_id]
                definitions[number] = define(schema.name, schema.encoding, schema.data)
            message = definitions[number].from_ros1(bytes(records[begin:end]))
            pieces.append(message_record(number, len(pieces), time, time, message))
        return b"".join(pieces)


def scan_ros1(path: Path) -> Ros1Bag:
    """Walk a bag once and note where its messages are."""
    try:
        with open(path, "rb", buffering=1 << 18) as stream:
            size = stream.seek(0, 2)
            stream.seek(0)
            head = stream.read(len(_VERSION))
            if head != _VERSION:
                raise BagError(
                    f"{path}: a ROS 1 bag of another version than 2.0; convert it with `rosbag fix` of ROS 1, or "
                    f"record again"
                )
            return _Scanner(Ros1Bag(path, size), stream).run()
    except OSError as error:
        raise os_error(path, error) from None


class _Scanner:
    def __init__(self, found: Ros1Bag, stream: BinaryIO) -> None:
        self.found, self.stream = found, stream
        self.records_left = most_records(found.size)
        self.bytes_left = most_inflated(found.size)
        self.definitions_left = _LARGEST_DEFINITIONS
        self.odd = 0
        self.refused: set[int] = set()
        self.schemas: dict[tuple[str, bytes], int] = {}
        self.lines_left = _MOST_LINES

    def run(self) -> Ros1Bag:
        found, indexed = self.found, True
        try:
            while self.stream.tell() < found.size:
                fields, begin, end = self._record()
                op = _op(fields)
                if op == _BAG:
                    if fields.get("encryptor"):
                        raise BagError(f"{found.path}: an encrypted ROS 1 bag; decrypt it with `rosbag decrypt`")
                    indexed = _number(fields, "index_pos", 8) != 0
                elif op == _CHUNK:
                    self._chunk(fields, begin, end)
                    continue
                elif op == _CONNECTION:
                    self._connection(fields, self.stream.read(min(end - begin, self.definitions_left)))
                self.stream.seek(end)
        except _DamagedError as error:
            found.warnings.append(f"{found.path}: {error}; {count(found.count, 'message')} before that count")
        if not indexed and not found.warnings:
            found.warnings.append(f"{found.path}: its recorder was ended before it was whole; what is there counts")
        if self.odd:
            found.warnings.append(f"{found.path}: {count(self.odd, 'message')} left out, of no known topic or damaged")
        return found

    def _record(self) -> tuple[_Fields, int, int]:
        """Fields of the next record, and where its data begins and ends."""
        at = self.stream.tell()
        length = self._length()
        if length > min(_LARGEST_HEADER, self.found.size - self.stream.tell()):
            raise _DamagedError(f"the file is cut or damaged at byte {at} of {self.found.size}")
        fields = _fields(self.stream.read(length))
        size = self._length()
        begin = self.stream.tell()
        if begin + size > self.found.size and _op(fields) != _CHUNK:
            raise _DamagedError(f"the file is cut or damaged at byte {at} of {self.found.size}")
        return fields, begin, begin + size

    def _length(self) -> int:
        data = self.stream.read(_LENGTH.size)
        if len(data) < _LENGTH.size:
            raise _DamagedError(f"the file is cut at byte {self.found.size}")
        return int(_LENGTH.unpack(data)[0])

    def _chunk(self, fields: _Fields, begin: int, end: int) -> None:
        """Take a chunk, by the index records behind it where they are there."""
        found = self.found
        name = fields.get("compression", b"").decode(errors="replace")
        length = _number(fields, "size")
        if name not in _COMPRESSIONS or not 0 <= length <= LARGEST_CHUNK:
            found.warnings.append(
                f"{found.path}: the chunk at byte {begin} is left out, its compression {name[:20]!r} or size is not "
                f"known (bz2, lz4 and none are)"
            )
            self.stream.seek(min(end, found.size))
            return
        compression = _COMPRESSIONS[name]
        cut = end > found.size
        tally = None if cut else self._indexed(end)
        if tally is not None and not any(conn not in found.numbers for conn in tally):
            self._take(Block(begin, end - begin, compression, length, *_span(tally), frozenset()), tally)
            return
        after = found.size if cut else self.stream.tell()
        self.stream.seek(begin)
        data = self.stream.read(min(end, found.size) - begin)
        records, trouble = _inflate(compression, data, min(length, self.bytes_left))
        self.bytes_left -= len(records)
        walked: dict[int, Tally] = {}
        reached = 0
        for op, inner, start, stop in _walk(memoryview(records)[:length]):
            reached = stop
            self.records_left -= 1
            if self.records_left < 0:
                trouble = "it has more records than a recording of its size"
                break
            if op == _CONNECTION:
                self._connection(inner, bytes(records[start : min(stop, start + self.definitions_left)]))
            elif op == _MESSAGE:
                conn, time = _number(inner, "conn"), _time(inner)
                if time is None:
                    self.odd += 1
                    continue
                entry = walked.setdefault(conn, Tally(0, time, time))
                entry.count, entry.first, entry.last = entry.count + 1, min(entry.first, time), max(entry.last, time)
        if walked:
            self._take(Block(begin, len(data), compression, reached, *_span(walked), frozenset()), walked)
        self.stream.seek(after)
        if cut:
            raise _DamagedError(f"the file is cut at byte {found.size}")
        if trouble or reached < length:
            found.warnings.append(
                f"{found.path}: the chunk at byte {begin} is damaged ({trouble or 'a record in it is cut'}); what is "
                f"before that counts"
            )

    def _indexed(self, at: int) -> dict[int, Tally] | None:
        """What the index records from here on state of each connection; None without any, or where one is odd."""
        self.stream.seek(at)
        found: dict[int, Tally] = {}
        while self.stream.tell() < self.found.size:
            here = self.stream.tell()
            try:
                fields, begin, end = self._record()
            except _DamagedError:
                self.stream.seek(here)
                break
            if _op(fields) != _INDEX:
                self.stream.seek(here)
                break
            number = _number(fields, "count")
            self.stream.seek(begin)
            data = self.stream.read(end - begin)
            if number < 1 or len(data) != number * _ENTRY.itemsize or _number(fields, "ver") != 1:
                self.stream.seek(end)
                return None
            entries = np.frombuffer(data, _ENTRY)
            times = entries["sec"].astype(np.int64) * 10**9 + entries["nsec"]
            self.records_left -= number
            if self.records_left < 0:
                return None
            conn = _number(fields, "conn")
            if conn in found:
                return None
            found[conn] = Tally(number, int(times.min()), int(times.max()))
        return found or None

    def _connection(self, fields: _Fields, data: bytes) -> None:
        """Declare a channel, once."""
        found = self.found
        conn = _number(fields, "conn")
        if conn < 0 or conn in found.numbers:
            return
        self.definitions_left -= len(data)
        if len(found.numbers) == _MOST_CONNECTIONS or self.definitions_left <= 0:
            if not self.refused:
                found.warnings.append(f"{found.path}: it has too many connections; those behind are left out")
            self.refused.add(conn)
            return
        try:
            inner = _fields(data)
        except _DamagedError:
            return
        kind = normal_name(inner.get("type", b"").decode(errors="replace"))
        topic = fields.get("topic", b"").decode(errors="replace")
        text = inner.get("message_definition", b"")
        schema = self.schemas.get((kind, text), 0)
        if not schema:
            schema = self.schemas[kind, text] = len(found.schemas) + 1
            self.lines_left -= _LEAST_LINES + lines_of(text)
            ours = ros2_text(kind, text) if self.lines_left > 0 else text
            found.schemas[schema] = Schema(schema, ours, "ros2msg", kind)
        number = found.numbers[conn] = len(found.numbers) + 1
        found.channels[number] = Channel(number, topic, "cdr", {}, schema)

    def _take(self, block: Block, tally: Mapping[int, Tally]) -> None:
        found = self.found
        channels = set()
        for conn, entry in tally.items():
            number = found.numbers.get(conn)
            if number is None:
                self.odd += entry.count
                continue
            channels.add(number)
            known = found.tally.setdefault(number, Tally(0, entry.first, entry.last))
            known.count += entry.count
            known.first, known.last = min(known.first, entry.first), max(known.last, entry.last)
        if channels:
            found.blocks.append(block._replace(channels=frozenset(channels)))


def _span(tally: Mapping[int, Tally]) -> tuple[int, int]:
    return min(entry.first for entry in tally.values()), max(entry.last for entry in tally.values())


def _inflate(compression: str, data: bytes, limit: int) -> tuple[bytes | memoryview, str]:
    """`inflate`, with the compression that MCAP does not have."""
    if compression != "bz2":
        return inflate(compression, memoryview(data), limit)
    reader = bz2.BZ2Decompressor()
    pieces, total = [], 0
    try:
        piece = reader.decompress(data, limit + 1)
        while piece:
            pieces.append(piece)
            total += len(piece)
            if reader.eof or total > limit:
                break
            piece = reader.decompress(b"", limit + 1 - total)
    except (OSError, ValueError, EOFError, MemoryError) as error:
        return b"".join(pieces), f"it cannot be decompressed ({error})"
    return b"".join(pieces), ""


def _walk(records: memoryview) -> Iterator[tuple[int, _Fields, int, int]]:
    """Whole records of a chunk, until the first one that is cut: kind, fields, begin and end of the data."""
    at, size = 0, len(records)
    while at + _LENGTH.size <= size:
        (length,) = _LENGTH.unpack_from(records, at)
        begin = at + _LENGTH.size + length + _LENGTH.size
        if length > _LARGEST_HEADER or begin > size:
            return
        try:
            fields = _fields(bytes(records[at + _LENGTH.size : begin - _LENGTH.size]))
        except _DamagedError:
            return
        end = begin + _LENGTH.unpack_from(records, begin - _LENGTH.size)[0]
        if end > size:
            return
        yield _op(fields), fields, begin, end
        at = end


def _fields(header: bytes) -> dict[str, bytes]:
    found: dict[str, bytes] = {}
    at = 0
    while at < len(header):
        if at + _LENGTH.size > len(header):
            raise _DamagedError("a header is damaged")
        (length,) = _LENGTH.unpack_from(header, at)
        at += _LENGTH.size
        name, equals, value = header[at : at + length].partition(b"=")
        if not equals or at + length > len(header):
            raise _DamagedError("a header is damaged")
        found[name.decode(errors="replace")] = value
        at += length
    return found


def _op(fields: _Fields) -> int:
    return _number(fields, "op", 1)


def _number(fields: _Fields, name: str, size: int = 4) -> int:
    value = fields.get(name, b"")
    return int.from_bytes(value, "little") if len(value) == size else -1


def _time(fields: _Fields) -> int | None:
    value = fields.get("time", b"")
    if len(value) != _TIME.size:
        return None
    seconds, nanoseconds = _TIME.unpack(value)
    return int(seconds) * 10**9 + int(nanoseconds)
