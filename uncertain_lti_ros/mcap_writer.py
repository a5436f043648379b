"""McapWriter: MCAP files with the standard library alone, for machines that only monitor.

Chunked, indexed and with a summary (https://mcap.dev/spec), so that the usual tools open them; compressed where
zstandard is installed.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Callable, Mapping
from typing import BinaryIO

_MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX, _CHUNK_INDEX = range(1, 9)
_STATISTICS, _METADATA, _METADATA_INDEX, _SUMMARY_OFFSET, _DATA_END = 0x0B, 0x0C, 0x0D, 0x0E, 0x0F
_CHUNK_BYTES = 1 << 20
_MESSAGE_HEAD = struct.Struct("<BQHIQQ")


def _text(text: str) -> bytes:
    data = text.encode(errors="replace")
    return struct.pack("<I", len(data)) + data


def _map(pairs: Mapping[str, str]) -> bytes:
    body = b"".join(_text(key) + _text(value) for key, value in pairs.items())
    return struct.pack("<I", len(body)) + body


def _record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def _compression() -> tuple[str, Callable[[bytes], bytes]]:
    try:
        import zstandard
    except ImportError:
        return "", lambda data: data
    return "zstd", zstandard.ZstdCompressor(level=1).compress


class McapWriter:
    """Messages in rising log time to an open binary file of profile `ros2`; `finish` ends it."""

    def __init__(self, stream: BinaryIO, library: str) -> None:
        self._stream, self._at = stream, 0
        self._name, self._compress = _compression()
        self._schemas: list[bytes] = []
        self._channels: list[bytes] = []
        self._metadata: list[bytes] = []
        self._chunks: list[bytes] = []
        self._counts: Counter[int] = Counter()
        self._parts: list[bytes] = []
        self._length = 0
        self._index: dict[int, list[tuple[int, int]]] = {}
        self._first: int | None = None
        self._last = 0
        self._write(_MAGIC + _record(_HEADER, _text("ros2") + _text(library)))

    def metadata(self, name: str, pairs: Mapping[str, str]) -> None:
        """Add named texts."""
        record = _record(_METADATA, _text(name) + _map(pairs))
        self._metadata.append(_record(_METADATA_INDEX, struct.pack("<QQ", self._at, len(record)) + _text(name)))
        self._write(record)

    def channel(self, topic: str, type_name: str, definition: str) -> int:
        """Declare a topic with CDR messages of a type that is defined as in .msg files; returns its number."""
        text = definition.encode()
        schema, number = len(self._schemas) + 1, len(self._channels) + 1
        body = struct.pack("<H", schema) + _text(type_name) + _text("ros2msg") + struct.pack("<I", len(text)) + text
        self._schemas.append(_record(_SCHEMA, body))
        body = struct.pack("<HH", number, schema) + _text(topic) + _text("cdr") + _map({})
        self._channels.append(_record(_CHANNEL, body))
        self._write(self._schemas[-1] + self._channels[-1])
        return number

    def message(self, channel: int, log_time: int, data: bytes) -> None:
        """Add one message; log_time in ns, not less than the one before."""
        self._index.setdefault(channel, []).append((log_time, self._length))
        head = _MESSAGE_HEAD.pack(_MESSAGE, 22 + len(data), channel, self._counts[channel], log_time, log_time)
        self._parts += (head, data)
        self._length += len(head) + len(data)
        self._counts[channel] += 1
        self._first = log_time if self._first is None else self._first
        self._last = log_time
        if self._length >= _CHUNK_BYTES:
            self._end_chunk()

    def finish(self) -> None:
        """Write the rest and the summary."""
        self._end_chunk()
        self._write(_record(_DATA_END, struct.pack("<I", 0)))
        counts = b"".join(struct.pack("<HQ", *pair) for pair in sorted(self._counts.items()))
        sizes = (len(self._schemas), len(self._channels), 0, len(self._metadata), len(self._chunks))
        statistics = struct.pack("<QHIIII", sum(self._counts.values()), *sizes)
        statistics += struct.pack("<QQI", self._first or 0, self._last, len(counts)) + counts
        summary, offsets = self._at, b""
        groups = {
            _SCHEMA: self._schemas, _CHANNEL: self._channels, _STATISTICS: [_record(_STATISTICS, statistics)],
            _CHUNK_INDEX: self._chunks, _METADATA_INDEX: self._metadata,
        }  # fmt: skip
        for opcode, records in groups.items():
            if records:
                group = b"".join(records)
                offsets += _record(_SUMMARY_OFFSET, struct.pack("<BQQ", opcode, self._at, len(group)))
                self._write(group)
        start = self._at
        self._write(offsets + _record(_FOOTER, struct.pack("<QQI", summary, start, 0)) + _MAGIC)

    def _end_chunk(self) -> None:
        if not self._parts:
            return
        plain = b"".join(self._parts)
        packed = self._compress(plain)
        times = [time for entries in self._index.values() for time, _ in entries]
        span = struct.pack("<QQ", min(times), max(times))
        body = span + struct.pack("<QI", len(plain), zlib.crc32(plain)) + _text(self._name)
        chunk = _record(_CHUNK, body + struct.pack("<Q", len(packed)) + packed)
        start = self._at
        self._write(chunk)
        places, indexes = b"", b""
        for channel, entries in self._index.items():
            places += struct.pack("<HQ", channel, self._at + len(indexes))
            pairs = b"".join(struct.pack("<QQ", *entry) for entry in entries)
            indexes += _record(_MESSAGE_INDEX, struct.pack("<HI", channel, len(pairs)) + pairs)
        self._write(indexes)
        body = span + struct.pack("<QQI", start, len(chunk), len(places)) + places
        body += struct.pack("<Q", len(indexes)) + _text(self._name) + struct.pack("<QQ", len(packed), len(plain))
        self._chunks.append(_record(_CHUNK_INDEX, body))
        self._parts, self._length, self._index = [], 0, {}

    def _write(self, data: bytes) -> None:
        self._stream.write(data)
        self._at += len(data)
