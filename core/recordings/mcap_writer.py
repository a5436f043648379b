# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""McapWriter: MCAP files with the standard library alone, for machines that only monitor.

Chunked, indexed and with a summary (https://mcap.dev/spec), so that the usual tools open them; compressed where
zstandard is installed.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import BinaryIO

from uncertain_lti.base.errors import BagError
from uncertain_lti.base.files import MAGIC

_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX, _CHUNK_INDEX = range(1, 9)
_ATTACHMENT, _ATTACHMENT_INDEX, _STATISTICS, _METADATA, _METADATA_INDEX, _SUMMARY_OFFSET, _DATA_END = range(9, 16)
_CHUNK_BYTES = 1 << 20
MESSAGE_HEAD = struct.Struct("<BQHIQQ")
"""Opcode and length of the record; channel, sequence, log time, publish time."""
INDEX_ENTRY = struct.Struct("<QQ")
"""Log time of a message, and where in the chunk its record begins."""


def _text(text: str) -> bytes:
    data = text.encode(errors="replace")
    return struct.pack("<I", len(data)) + data


def _map(pairs: Mapping[str, str]) -> bytes:
    body = b"".join(_text(key) + _text(value) for key, value in pairs.items())
    return struct.pack("<I", len(body)) + body


def _record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def message_head(channel: int, sequence: int, time: int, size: int) -> bytes:
    """What precedes the bytes of a message, of which there are `size`; it was published when it was logged, ns."""
    return MESSAGE_HEAD.pack(_MESSAGE, MESSAGE_HEAD.size - 9 + size, channel, sequence, time, time)


def _compressor(name: str | None) -> tuple[str, Callable[[bytes], bytes]]:
    if name == "lz4":
        import lz4.frame  # type: ignore[import-untyped]

        return name, lz4.frame.compress
    if name != "":
        with suppress(ImportError):
            import zstandard

            return "zstd", zstandard.ZstdCompressor(level=1).compress
    return "", bytes


class McapWriter:
    """Records to an open binary file, one after the other; `finish` ends it.

    `stream`: open for writing; it stays open; `library`: who writes; `compression`: of the chunks: zstd, lz4 or "" for
    none; default zstd where it is installed.
    """

    def __init__(self, stream: BinaryIO, library: str, compression: str | None = None) -> None:
        self._stream, self._at, self._sum = stream, 0, 0
        self._name, self._compress = _compressor(compression)
        self._numbers: dict[object, int] = {}  # of schemas and channels, by what they say
        groups = (_SCHEMA, _CHANNEL, _STATISTICS, _CHUNK_INDEX, _ATTACHMENT_INDEX, _METADATA_INDEX)
        self._summary: dict[int, list[bytes]] = {opcode: [] for opcode in groups}
        self._counts: Counter[int] = Counter()
        self._parts, self._length = list[bytes](), 0
        self._index: dict[int, bytearray] = {}
        self._first, self._last = 1 << 64, 0
        self._span = 0, 0  # first and last log time of the chunk
        self._write(MAGIC + _record(_HEADER, _text("ros2") + _text(library)))

    def schema(self, name: str, encoding: str, data: bytes) -> int:
        """Number of a schema in the file, which has it or gets it."""
        return self._declare(_SCHEMA, _text(name) + _text(encoding) + struct.pack("<I", len(data)) + data)

    def channel(self, schema: int, topic: str, encoding: str = "cdr", metadata: Mapping[str, str] | None = None) -> int:
        """Number of a channel in the file, which has it or gets it; schema 0 is none."""
        body = struct.pack("<H", schema) + _text(topic) + _text(encoding) + _map(metadata or {})
        return self._declare(_CHANNEL, body)

    def message(self, channel: int, log_time: int, data: bytes) -> None:
        """Add one message."""
        self._span = self._span[0] if self._parts else log_time, log_time
        entries = self._index.setdefault(channel, bytearray())
        sequence = self._counts[channel] + len(entries) // INDEX_ENTRY.size
        entries += INDEX_ENTRY.pack(log_time, self._length)
        head = message_head(channel, sequence, log_time, len(data))
        self._parts += (head, data)
        self._length += len(head) + len(data)
        if self._length >= _CHUNK_BYTES:
            self.end_chunk()

    def chunk(self, records: bytes, index: Mapping[int, bytes | bytearray], span: tuple[int, int]) -> None:
        """Add a chunk of messages: their records, `INDEX_ENTRY` of each by channel, and first and last log time."""
        self.end_chunk()
        self._write_chunk(records, index, span)

    def metadata(self, name: str, pairs: Mapping[str, str]) -> None:
        """Add named texts."""
        self._indexed(_METADATA, _text(name) + _map(pairs), _METADATA_INDEX, b"", _text(name))

    def attachment(self, body: bytes, about: bytes, name: str, media_type: str) -> None:
        """Add an attachment as another file has it; `about`: its log time, time of creation and size of data."""
        self._indexed(_ATTACHMENT, body, _ATTACHMENT_INDEX, about, _text(name) + _text(media_type))

    def record(self, opcode: int, body: bytes) -> None:
        """Add a record that no index knows, for example a private one."""
        self.end_chunk()
        self._write(_record(opcode, body))

    def finish(self) -> None:
        """Write the rest and the summary."""
        self.end_chunk()
        self._write(_record(_DATA_END, struct.pack("<I", self._sum)))
        counts = b"".join(struct.pack("<HQ", *pair) for pair in sorted(self._counts.items()))
        kinds = (_SCHEMA, _CHANNEL, _ATTACHMENT_INDEX, _METADATA_INDEX, _CHUNK_INDEX)
        statistics = struct.pack("<QHIIII", sum(self._counts.values()), *(len(self._summary[kind]) for kind in kinds))
        statistics += struct.pack("<QQI", self._first if counts else 0, self._last, len(counts)) + counts
        self._summary[_STATISTICS].append(_record(_STATISTICS, statistics))
        summary, offsets = self._at, b""
        self._sum = 0
        for opcode, records in self._summary.items():
            if records:
                group = b"".join(records)
                offsets += _record(_SUMMARY_OFFSET, struct.pack("<BQQ", opcode, self._at, len(group)))
                self._write(group)
        start = self._at
        self._write(offsets + struct.pack("<BQQQ", _FOOTER, 20, summary, start))
        self._write(struct.pack("<I", self._sum) + MAGIC)

    def _declare(self, opcode: int, body: bytes) -> int:
        number = self._numbers.get((opcode, body), 0)
        if not number:
            number = self._numbers[opcode, body] = len(self._summary[opcode]) + 1
            if number >= 1 << 16:
                raise BagError(f"an MCAP file has at most {number - 1} topics and as many types; write fewer of them")
            record = _record(opcode, struct.pack("<H", number) + body)
            self._summary[opcode].append(record)
            self._write(record)
        return number

    def _indexed(self, opcode: int, body: bytes, index: int, about: bytes, names: bytes) -> None:
        self.end_chunk()
        place = struct.pack("<QQ", self._at, len(body) + 9)
        self._write(_record(opcode, body))
        self._summary[index].append(_record(index, place + about + names))

    def end_chunk(self) -> None:
        """Write the messages that wait for more."""
        if self._parts:
            parts, index = self._parts, self._index
            self._parts, self._length, self._index = [], 0, {}
            self._write_chunk(b"".join(parts), index, self._span)

    def _write_chunk(self, records: bytes, index: Mapping[int, bytes | bytearray], span: tuple[int, int]) -> None:
        name, data = self._name, self._compress(records)
        times = struct.pack("<QQ", *span)
        self._first, self._last = min(self._first, span[0]), max(self._last, span[1])
        head = times + struct.pack("<QI", len(records), zlib.crc32(records)) + _text(name)
        head += struct.pack("<Q", len(data))
        start, length = self._at, len(head) + len(data)
        self._write(struct.pack("<BQ", _CHUNK, length) + head)
        self._write(data)
        places, indexes = b"", b""
        for channel, entries in index.items():
            self._counts[channel] += len(entries) // INDEX_ENTRY.size
            places += struct.pack("<HQ", channel, self._at + len(indexes))
            indexes += _record(_MESSAGE_INDEX, struct.pack("<HI", channel, len(entries)) + entries)
        self._write(indexes)
        body = times + struct.pack("<QQI", start, length + 9, len(places)) + places
        body += struct.pack("<Q", len(indexes)) + _text(name) + struct.pack("<QQ", len(data), len(records))
        self._summary[_CHUNK_INDEX].append(_record(_CHUNK_INDEX, body))

    def _write(self, data: bytes) -> None:
        self._stream.write(data)
        self._sum = zlib.crc32(data, self._sum)
        self._at += len(data)
