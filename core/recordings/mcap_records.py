"""MCAP container: a file as blocks of raw messages, whatever is missing from it or damaged.

A file is walked once from its beginning (`scan`), without need of summary, index or footer, and then read
block by block (`read_block`, `messages`). A block is a chunk, or a stretch of records outside chunks.

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
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd, Footer, Schema, Statistics

from uncertain_lti.base.errors import BagError
from uncertain_lti.base.files import MAGIC
from uncertain_lti.recordings.unreadable import not_mcap, os_error

try:
    from isal.isal_zlib import crc32 as crc32
except ImportError:
    from zlib import crc32 as crc32

LARGEST_CHUNK = 1 << 28  # bytes, decompressed; recorders write chunks of 1 to 10 MB
_BARE_BLOCK = 1 << 22  # bytes; so much of a file without chunks is read at once
_PIECE = 1 << 24
RECORD = struct.Struct("<BQ")  # opcode, length of what follows
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
CHUNK = struct.Struct("<QQQII")  # first and last log time, size, checksum, length of the compression's name
FOOTER_SIZE = RECORD.size + 20
PRIVATE = 0x80  # opcodes from here on mean something to their maker alone
LATEST = 2**63 - 1  # ns; times are kept with a sign
_CHUNK_AT = struct.Struct("<16xQ")  # in a chunk's index
_FIRST_WARNINGS = 3  # of a kind that are reported one by one
_LEAST_RECORDS = 1 << 20
_LEAST_INFLATED = 1 << 30
_LARGEST_RATIO = 1000
_LARGEST_DEFINITION = 1 << 24  # bytes
_LARGEST_DEFINITIONS = 1 << 26  # bytes, all of a file


def most_records(size: int) -> int:
    """Records that compressed chunks may hold together; one of a recording takes several bytes.

    Parameters
    ----------
    size : int
        Bytes of the file.

    Returns
    -------
    int
        At most this many.
    """
    return max(_LEAST_RECORDS, size)


def most_inflated(size: int) -> int:
    """Bytes that compressed chunks may have together when they are decompressed.

    Parameters
    ----------
    size : int
        Bytes of the file.

    Returns
    -------
    int
        At most this many.
    """
    return max(_LEAST_INFLATED, _LARGEST_RATIO * size)


class Block(NamedTuple):
    """A stretch of a file that is read at once: bytes `offset` to `offset + size`.

    Parameters
    ----------
    offset : int
        First byte.
    size : int
        Bytes in the file.
    compression : str
        Empty where the bytes are records as they are.
    length : int
        Bytes of the records.
    start : int
        Smallest log time, ns.
    end : int
        Largest log time, ns.
    channels : frozenset of int
        Those that have a message here.
    unchecked : int, default 0
        Of a chunk that was found in an index (`mcap_index.outline`), bytes in front of its records, which are still to
        be compared with the block, and the records with their checksum; 0 otherwise.
    indexed : int, default 0
        Of such a chunk, bytes behind its records, which say where its messages are; 0 otherwise.
    cut : bool, default False
        The file ends within it.
    """

    offset: int
    size: int
    compression: str
    length: int
    start: int
    end: int
    channels: frozenset[int]
    unchecked: int = 0
    indexed: int = 0
    cut: bool = False


@dataclass(slots=True)
class Tally:
    """Messages of one channel.

    Parameters
    ----------
    count : int
        How many.
    first : int
        First log time, ns.
    last : int
        Last log time, ns.
    """

    count: int
    first: int
    last: int


@dataclass(slots=True)
class Contents:
    """What `scan` found in a file.

    Parameters
    ----------
    path : Path
        The file.
    size : int
        Its bytes.
    blocks : list of Block, optional
        In file order.
    channels : dict of int to Channel, optional
        By number.
    schemas : dict of int to Schema, optional
        By number.
    tally : dict of int to Tally, optional
        By number of the channel.
    warnings : list of str, optional
        Sentences that begin with the path.
    indexed : bool, default False
        The file was not walked, and this is only what its index states (`mcap_index.outline`): first and last of a
        tally are those of the chunks that hold the channel.
    summed : bool, default False
        The file has a checksum over everything, which was not checked.
    others : array of int, optional
        Where attachments, metadata and private records begin, in file order; empty when the file was not walked.
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

    @property
    def count(self) -> int:
        """Messages that can be read."""
        return sum(entry.count for entry in self.tally.values())


def scan(path: Path) -> Contents:
    """Walk a file once and note where its messages are.

    Parameters
    ----------
    path : Path
        An MCAP file, whole or cut.

    Returns
    -------
    Contents
        Where its messages are.

    Raises
    ------
    BagError
        The file is not MCAP, or the operating system does not let it be read.
    """
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


def read_block(path: Path, block: Block) -> bytes:
    """Records of a block that `scan` found.

    Parameters
    ----------
    path : Path
        The file.
    block : Block
        Of the file.

    Returns
    -------
    bytes
        The records, not compressed.

    Raises
    ------
    BagError
        The file changed, or cannot be read any more.
    """
    assert not block.unchecked
    try:
        with open(path, "rb", buffering=0) as stream:
            stream.seek(block.offset)
            data = stream.read(block.size)
    except OSError as error:
        raise os_error(path, error) from None
    records, _ = inflate(block.compression, memoryview(data), block.length)
    if len(records) < block.length:
        raise BagError(f"{path}: the file changed while it was read; read it again when it is written")
    return bytes(records[: block.length])


def messages(records: bytes) -> Iterator[tuple[int, int, int, int, int]]:
    """Messages among some records; the data of each is `records[begin:end]`.

    Parameters
    ----------
    records : bytes
        Of `read_block`.

    Yields
    ------
    (int, int, int, int, int)
        Channel, log time and publish time in ns, begin, end.
    """
    for opcode, begin, end in walk(records):
        if opcode == Opcode.MESSAGE and end - begin >= MESSAGE.size:
            channel, _, log_time, publish_time = MESSAGE.unpack_from(records, begin)
            yield channel, log_time, publish_time, begin + MESSAGE.size, end


def walk(records: bytes | memoryview) -> Iterator[tuple[int, int, int]]:
    """Whole records, until the first one that is cut.

    Parameters
    ----------
    records : bytes or memoryview
        As they are in a file or a chunk.

    Yields
    ------
    (int, int, int)
        Opcode, begin and end of the content.
    """
    position, size, header, unpack = 0, len(records), RECORD.size, RECORD.unpack_from
    while position + header <= size:
        opcode, length = unpack(records, position)
        begin = position + header
        position = begin + length
        if position > size or opcode == 0:
            return
        yield opcode, begin, position


def inflate(compression: str, data: memoryview, limit: int) -> tuple[bytes | memoryview, str]:
    """Decompress with a limit, whatever the data claims of itself.

    Parameters
    ----------
    compression : str
        `zstd`, `lz4`, or empty for none.
    data : memoryview
        What was compressed.
    limit : int
        Bytes to give at most, and one more.

    Returns
    -------
    bytes or memoryview
        As far as it went.
    str
        What went wrong; empty where nothing did.
    """
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
        while total <= limit and (piece := read(min(_PIECE, limit + 1 - total))):
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
    """Content of one record.

    Parameters
    ----------
    kind : type
        Record class of the mcap package.
    content : bytes or memoryview
        Its bytes.

    Returns
    -------
    object
        The record, or None where it contradicts itself.
    """
    try:
        return kind.read(_Exact(BytesIO(content)))
    except (EndOfFile, struct.error, UnicodeDecodeError, OverflowError):
        return None


class _Scanner:
    bare_begin: int
    bare_end: int
    bare: dict[int, Tally]  # of the block outside chunks that is being walked

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
        self._forget_bare()

    def run(self) -> Contents:
        found, path = self.found, self.found.path
        self.closed = self._at(found.size - len(MAGIC), len(MAGIC)) == MAGIC and found.size >= 2 * len(MAGIC)
        if self.closed:
            self._summary()
        ended = self._data_section()
        self._end_bare()
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
            self.sums = crc32(header, self.sums)
            if opcode == Opcode.MESSAGE or opcode == Opcode.SCHEMA or opcode == Opcode.CHANNEL:
                content = self.stream.read(length)
                self.sums = crc32(content, self.sums)
                self._bare(position, opcode, content)
            elif opcode == Opcode.CHUNK:
                content = self.stream.read(length)
                self.sums = crc32(content, self.sums)
                self._chunk(position, begin, content)
            else:  # attachments, metadata, indexes, private records: only their bytes and their place count
                if opcode in (Opcode.ATTACHMENT, Opcode.METADATA) or opcode >= PRIVATE:
                    self.found.others.append(position)
                left = length
                while left and (piece := self.stream.read(min(left, _PIECE))):
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

    def _bare(self, position: int, opcode: int, content: bytes) -> None:
        """A record outside chunks: continues the current block or begins one."""
        end = position + RECORD.size + len(content)
        if self.bare_end != position or end - self.bare_begin > _BARE_BLOCK:
            self._end_bare()
            self.bare_begin = position
        self.bare_end = end
        if opcode == Opcode.MESSAGE:
            self._message(content, 0, len(content), self.bare)
        else:
            self._definition(opcode, content)

    def _end_bare(self) -> None:
        if self.bare:
            size = self.bare_end - self.bare_begin
            self._block(self.bare_begin, size, "", size, self.bare)
        self._forget_bare()

    def _forget_bare(self) -> None:
        self.bare_begin, self.bare_end = -1, -1
        self.bare = {}

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
            self._leave_out(where, f"with it the file is over {_LARGEST_RATIO} times its size when decompressed", cut)
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
        tally: dict[int, Tally] = {}
        end = 0
        for opcode, start, stop in walk(records):
            if compression:
                if not self.records_left:
                    self._leave_out(where, "with it the file holds more records than bytes", cut)
                    return
                self.records_left -= 1
            end = stop
            if opcode == Opcode.MESSAGE:
                self._message(records, start, end, tally)
            elif opcode == Opcode.SCHEMA or opcode == Opcode.CHANNEL:
                self._definition(opcode, records[start:end])
        self.odd_records += end < len(records) and not cut
        if tally:
            self._block(begin + data_begin, len(data), compression, end, tally, cut)

    def _leave_out(self, where: object, why: str, cut: bool = False) -> None:
        if not cut:  # what little a cut leaves of a chunk's beginning is reported with the cut
            self.damaged = True
            if self._first("chunk"):
                path = self.found.path
                self.chunk_warnings.append(f"{path}: chunk at byte {where}: {why}; its messages are left out")

    def _message(self, records: bytes | memoryview, begin: int, end: int, tally: dict[int, Tally]) -> None:
        if end - begin < MESSAGE.size:
            self.odd_records += 1
            return
        channel, _, time, _ = MESSAGE.unpack_from(records, begin)
        if entry := tally.get(channel):
            entry.count += 1
            if time > entry.last:
                entry.last = time
            elif time < entry.first:
                entry.first = time
        else:
            tally[channel] = Tally(1, time, time)

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
            if total := self.found.tally.get(channel):
                total.count += entry.count
                total.first, total.last = min(total.first, entry.first), max(total.last, entry.last)
            else:
                self.found.tally[channel] = entry

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
        footer_at = self.found.size - len(MAGIC) - FOOTER_SIZE
        tail = self._at(footer_at, FOOTER_SIZE)
        if len(tail) < FOOTER_SIZE or tail[:9] != RECORD.pack(Opcode.FOOTER, 20):
            return
        footer = parse(Footer, tail[RECORD.size :])
        if not footer or not len(MAGIC) <= footer.summary_start < footer_at:
            return
        records = self._at(footer.summary_start, footer_at - footer.summary_start)
        if footer.summary_crc not in (0, crc32(tail[:-4], crc32(records))):
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
                if len(MAGIC) <= offset < footer_at and self._at(offset, 1) == bytes([Opcode.CHUNK]):
                    self.known.append(offset)
        self.known.sort()

    def _at(self, offset: int, size: int) -> bytes:
        if offset < 0 or offset >= self.found.size:
            return b""
        self.stream.seek(offset)
        return self.stream.read(min(size, self.found.size - offset))


def count(number: int, what: str) -> str:
    """A count for a sentence: `1 message`, `61 340 messages`.

    Parameters
    ----------
    number : int
        How many.
    what : str
        The noun in the singular.

    Returns
    -------
    str
        Thousands apart.
    """
    return f"{number:,}".replace(",", " ") + f" {what}{'' if number == 1 else 's'}"


def seconds(time_ns: int) -> str:
    """Nanoseconds written as seconds, exact to the millisecond.

    Parameters
    ----------
    time_ns : int
        A time of zero or more, ns.

    Returns
    -------
    str
        Cut after the millisecond.
    """
    return f"{time_ns // 10**9}.{time_ns % 10**9 // 10**6:03d}"
