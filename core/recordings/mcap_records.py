# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Records of an MCAP file: how they are laid out, how blocks of them are read, and how a recording is copied.

What `mcap_scan.scan` could not read of a damaged file is not in the copy.
"""

from __future__ import annotations

import heapq
import struct
from array import array
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from operator import itemgetter
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema
from numpy.typing import NDArray

from uncertain_lti.recordings.mcap_walk import walk_records
from uncertain_lti.recordings.mcap_writer import MESSAGE_HEAD, McapWriter
from uncertain_lti.recordings.unreadable import changed, os_error

PIECE = 1 << 24  # bytes that are read or decompressed at once
RECORD = struct.Struct("<BQ")  # opcode, length of what follows
LATEST = 2**63 - 1  # ns; times are kept with a sign


class Block(NamedTuple):
    """A stretch of a file that is read at once: bytes `offset` to `offset + size`.

    `offset`: first byte; `size`: bytes in the file; `compression`: empty where the bytes are records as they are;
    `length`: bytes of the records; `start`: smallest log time, ns; `end`: largest log time, ns; `channels`: those that
    have a message here; `unchecked`: of a chunk that was found in an index (`mcap_scan.outline`), bytes in front of
    its records, which are still to be compared with the block, and the records with their checksum; 0 otherwise.
    """

    offset: int
    size: int
    compression: str
    length: int
    start: int
    end: int
    channels: frozenset[int]
    unchecked: int = 0


@dataclass(slots=True)
class Tally:
    """Messages of one channel.

    `count`: how many; `first`: first log time, ns; `last`: last log time, ns.
    """

    count: int
    first: int
    last: int


@dataclass(slots=True)
class Contents:
    """What `scan` found in a file.

    `path`: the file; `size`: its bytes; `blocks`: in file order; `channels`: by number; `schemas`: by number; `tally`:
    by number of the channel; `warnings`: sentences that begin with the path; `indexed`: the file was not walked, and
    this is only what its index states (`mcap_scan.outline`): first and last of a tally are those of the chunks that
    hold the channel; `summed`: the file has a checksum over everything, which was not checked; `others`: where
    attachments, metadata and private records begin, in file order; empty when the file was not walked.
    """

    path: Path
    size: int
    blocks: list[Block] = field(default_factory=list)
    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    tally: dict[int, Tally] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    indexed: bool = False
    summed: bool = False
    others: array[int] = field(default_factory=lambda: array("Q"))

    converted: ClassVar[bool] = False
    """Whether the file is no MCAP, so that the records of its blocks are made while they are read."""

    @property
    def count(self) -> int:
        """Messages that can be read."""
        return sum(entry.count for entry in self.tally.values())

    def packed(self, block: Block) -> memoryview:
        """One block as it stands in the file, with what precedes it and is unchecked."""
        try:
            with open(self.path, "rb", buffering=0) as stream:
                stream.seek(block.offset - block.unchecked)
                return memoryview(stream.read(block.unchecked + block.size))
        except OSError as error:
            raise os_error(self.path, error) from None

    def records(self, block: Block, channels: Collection[int] | None = None) -> bytes:
        """Records of one block that `scan` found, not compressed."""
        records, _ = inflate(block.compression, self.packed(block), block.length)
        if len(records) < block.length:
            raise changed(self.path)
        return bytes(records[: block.length])


def messages(records: bytes) -> Iterator[tuple[int, int, int, int]]:
    """Channel and log time of messages among some records; the data of each is `records[begin:end]`."""
    found = walk_records(records, 0, len(records), len(records))
    return zip(*(column.tolist() for column in found[:4]), strict=True)


def inflate(compression: str, data: memoryview, limit: int) -> tuple[bytes | memoryview, str]:
    """Decompress with a limit, whatever the data claims of itself."""
    if not compression:
        return data[: limit + 1], ""
    if compression == "zstd":
        read: Callable[[int], bytes] = zstandard.ZstdDecompressor().stream_reader(data).read
    elif compression == "lz4":
        frame = lz4.frame.LZ4FrameDecompressor()
        feed = iter((data,))

        def read(size: int) -> bytes:
            if frame.eof or (frame.needs_input and (part := next(feed, None)) is None):
                return b""
            piece: bytes = frame.decompress(part if frame.needs_input else b"", max_length=size)
            return piece
    else:
        return b"", f"its compression {compression[:20]!r} is not known (zstd, lz4 and none are)"
    pieces, total = [], 0
    try:
        while total <= limit and (piece := read(min(PIECE, limit + 1 - total))):
            pieces.append(piece)
            total += len(piece)
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
        return b"".join(pieces), f"it cannot be decompressed ({error})"
    return b"".join(pieces), ""


class _Exact(ReadDataStream):
    """Stream over one record that never hands out fewer bytes than asked for."""

    def read(self, length: int) -> bytes:
        data: bytes = super().read(length)
        if len(data) < length:
            raise EndOfFile
        return data


def parse(kind: type[Any], content: bytes | memoryview) -> Any:
    """Content of one record."""
    try:
        return kind.read(_Exact(BytesIO(content)))
    except (EndOfFile, struct.error, UnicodeDecodeError, OverflowError):
        return None


def count(number: int, what: str) -> str:
    """A count for a sentence: `1 message`, `61 340 messages`."""
    return f"{number:,}".replace(",", " ") + f" {what}{'' if number == 1 else 's'}"


_LARGEST = 1 << 30  # bytes of a record outside blocks


def declare(writer: McapWriter, contents: Contents) -> NDArray[np.uint16]:
    """Declare what a file declares; returns the numbers in the copy by those in the file, 0 for none."""
    schemas = {n: writer.schema(s.name, s.encoding, s.data) for n, s in sorted(contents.schemas.items())}
    numbers = np.zeros(1 << 16, dtype=np.uint16)
    for number, c in sorted(contents.channels.items()):
        numbers[number] = writer.channel(schemas.get(c.schema_id, 0), c.topic, c.message_encoding, c.metadata)
    return numbers


def copy(writer: McapWriter, contents: Contents, numbers: NDArray[np.uint16], notes: list[str]) -> Iterator[int]:
    """Copy a file block by block.

    Yields of each how many messages in it could not be copied; what else could not be is noted, each in one sentence
    that begins with the file.
    """
    blocks = ((block.offset, block) for block in contents.blocks)
    others = ((place, None) for place in contents.others)
    for place, block in heapq.merge(blocks, others, key=itemgetter(0)):
        if block is not None:
            yield _block(writer, contents, block, numbers)
        elif problem := _record(writer, contents, place):
            notes.append(f"{contents.path}: {problem}; it is left out")


def _block(writer: McapWriter, contents: Contents, block: Block, numbers: NDArray[np.uint16]) -> int:
    records = bytearray(contents.records(block))
    found = walk_records(records, 0, len(records), len(records))
    channel = numbers[found.channel]
    known = channel > 0
    kept = known & (found.end > found.begin) if contents.converted else known
    channel, times, end = channel[kept], found.log_time[kept], found.end[kept]
    begin = found.begin[kept] - MESSAGE_HEAD.size
    if len(channel):
        data = np.frombuffer(records, dtype=np.uint8)
        data[begin + RECORD.size], data[begin + RECORD.size + 1] = channel & 255, channel >> 8
        starts = (np.cumsum(end - begin) - (end - begin)).astype(np.uint64)
        entries = np.column_stack([times, starts])
        index = {number: entries[channel == number].tobytes() for number in np.unique(channel).tolist()}
        view = memoryview(records)
        whole = b"".join(view[a:b] for a, b in zip(begin.tolist(), end.tolist(), strict=True))
        writer.chunk(whole, index, (int(times.min()), int(times.max())))
    return int(known.sum()) - len(channel)


def _record(writer: McapWriter, contents: Contents, place: int) -> str:
    """Copy a record outside blocks: an attachment, metadata, or one that only its maker knows; why not."""
    try:
        with open(contents.path, "rb", buffering=0) as stream:
            stream.seek(place)
            opcode, size = RECORD.unpack(stream.read(RECORD.size))
            if size > _LARGEST:
                return f"the record at byte {place} has {count(size, 'byte')}, which is too large"
            body = stream.read(size)
    except OSError as error:
        raise os_error(contents.path, error) from None
    if len(body) < size:
        raise changed(contents.path)
    if opcode == Opcode.ATTACHMENT:
        if (a := parse(Attachment, body)) is None:
            return f"an attachment at byte {place} is damaged"
        writer.attachment(body, struct.pack("<QQQ", a.log_time, a.create_time, len(a.data)), a.name, a.media_type)
    elif opcode == Opcode.METADATA:
        if (m := parse(Metadata, body)) is None:
            return f"a metadata record at byte {place} is damaged"
        writer.metadata(m.name, m.metadata)
    else:
        writer.record(opcode, body)
    return ""
