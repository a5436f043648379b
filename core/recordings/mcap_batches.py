# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Messages of MCAP blocks as columns: some MiB of blocks in one buffer, and where the messages in it are."""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import Any, BinaryIO, NamedTuple, NoReturn

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Integers
from uncertain_lti.base.errors import BagError
from uncertain_lti.recordings.mcap_records import RECORD, Block, Contents, crc32, parse
from uncertain_lti.recordings.mcap_scan import most_records
from uncertain_lti.recordings.mcap_walk import walk_records
from uncertain_lti.recordings.unreadable import os_error

_BATCH = 1 << 22  # bytes; small blocks are put together until they reach this
_NEAR = 1 << 16  # bytes between blocks that are read along
_CHECKSUM_AT = RECORD.size + 24
_FEW_BLOCKS = 32
_AHEAD = 1 << 24  # bytes; a larger batch is not read while another one is worked on


class IndexMismatchError(Exception):
    """The file is not what its index states: it has to be walked."""


@dataclass(frozen=True, slots=True)
class Batch:
    """Messages of wanted channels in file order.

    data[begin:end] is an encoded message.

    `data`: A buffer that is used again for the next batch; `channel` (messages,): number of the channel in the file;
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
    if contents.converted:
        for group in groups:
            data, places = _converted(contents, group, channels)
            yield _messages(data, places, wanted, contents)
        return
    try:
        with open(contents.path, "rb", buffering=0) as stream:
            for data, places in _loaded(contents, stream, groups):
                batch = _messages(data, places, wanted, contents)
                counts = np.bincount(batch.channel, minlength=1 << 16)
                for channel in missing:
                    missing[channel] -= int(counts[channel])
                if contents.indexed and min(missing.values()) < 0:
                    raise IndexMismatchError
                yield batch
    except OSError as error:
        raise os_error(contents.path, error) from None
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


def _loaded(
    contents: Contents, stream: BinaryIO, groups: Sequence[Sequence[Block]]
) -> Iterator[tuple[bytearray, list[_Place]]]:
    """Blocks in buffers, group after group; a thread reads the next while one is worked on, into another buffer.

    Of many small blocks the thread leaves what goes block by block to its caller: two threads that take turns every
    few microseconds only wait for each other.
    """
    loaders = [_Loader(contents, stream) for _ in groups[:2]]
    if len(groups) < 2 or max(sum(block.length for block in group) for group in groups) > _AHEAD:
        for group in groups:
            places = loaders[0].place(loaders[0].fetch(group))
            yield loaders[0].data, places
        return

    def begin(number: int) -> Future[tuple[list[_Run], list[_Place] | None]]:
        return thread.submit(loaders[number % 2].work_ahead, groups[number])

    with ThreadPoolExecutor(1) as thread:
        loading = begin(0)
        for number in range(len(groups)):
            runs, places_there = loading.result()
            if number + 1 < len(groups):
                loading = begin(number + 1)
            loader = loaders[number % 2]
            places = loader.place(runs) if places_there is None else places_there
            yield loader.data, places


def _converted(
    contents: Contents, blocks: Sequence[Block], channels: Collection[int]
) -> tuple[bytearray, list[_Place]]:
    """Blocks of a file that is no MCAP, in a buffer."""
    data = bytearray()
    places = []
    for block in blocks:
        begin = len(data)
        data += contents.records(block, channels)
        places.append(_Place(block, begin, len(data)))
    return data, places


def _begin(block: Block) -> int:
    """Where the block begins in the file, with what precedes its records."""
    return block.offset - block.unchecked


def _end(block: Block) -> int:
    return block.offset + block.size


def _runs(blocks: Sequence[Block]) -> Iterator[list[Block]]:
    """Blocks that are near enough to each other to be read at once."""
    run: list[Block] = []
    for block in blocks:
        if run and not 0 <= _begin(block) - _end(run[-1]) <= _NEAR:
            yield run
            run = []
        run.append(block)
    if run:
        yield run


# --- from the file into the buffer --------------------------------------------------------------------------


class _Place(NamedTuple):
    """Where the records of a block are in the buffer."""

    block: Block
    begin: int
    end: int


class _Run(NamedTuple):
    """Blocks that were read at once: the bytes of the file from the first to the last, and where their records begin.

    ready says that the records are there already; direct, that they are as they stand in the file.
    """

    blocks: Sequence[Block]
    packed: memoryview
    at: int
    direct: bool
    ready: bool


class _Loader:
    """Reads and decompresses blocks, and checks those that nobody has read before."""

    def __init__(self, contents: Contents, stream: BinaryIO) -> None:
        self.contents, self.stream = contents, stream
        self.zstd = zstandard.ZstdDecompressor()
        self.lz4 = lz4.frame.create_decompression_context()
        self.data = bytearray()
        self.packed: list[bytearray] = []

    def work_ahead(self, blocks: Sequence[Block]) -> tuple[list[_Run], list[_Place] | None]:
        """`fetch`, and `place` as well where the blocks are few; raises as `batches` does."""
        runs = self.fetch(blocks)
        return runs, self.place(runs) if len(blocks) <= _FEW_BLOCKS else None

    def fetch(self, blocks: Sequence[Block]) -> list[_Run]:
        """Read blocks, and decompress what can be decompressed together."""
        runs = []
        at = 0
        every = list(_runs(blocks))
        as_is = [all(not block.compression for block in run) for run in every]
        sizes = [
            _end(run[-1]) - _begin(run[0]) if direct else sum(block.length for block in run)
            for run, direct in zip(every, as_is, strict=True)
        ]
        if len(self.data) < sum(sizes):
            self.data = bytearray(sum(sizes))
        for number, (run, direct, size) in enumerate(zip(every, as_is, sizes, strict=True)):
            begin = _begin(run[0])
            packed = memoryview(self.data)[at : at + size] if direct else self._room(number, _end(run[-1]) - begin)
            self.stream.seek(begin)
            if self.stream.readinto(packed) != len(packed):  # type: ignore[attr-defined]
                self._refuse()
            together = len(run) > 1 and all(block.compression == "zstd" for block in run)
            ready = direct or (together and self._inflate_together(run, packed, memoryview(self.data)[at : at + size]))
            runs.append(_Run(run, packed, at, direct, ready))
            at += size
        return runs

    def place(self, runs: Sequence[_Run]) -> list[_Place]:
        """Put the records of what was read into the buffer; raises as `batches` does."""
        view = memoryview(self.data)
        places: list[_Place] = []
        for blocks, packed, at, direct, ready in runs:
            origin = _begin(blocks[0])
            for block in blocks:
                offset = block.offset - origin
                behind = offset + block.size
                begin = at + offset if direct else at
                end = begin + block.length
                records = view[begin:end]
                if not ready and not self._inflate(block, packed[offset:behind], records):
                    self._refuse()
                if block.unchecked and not self._as_stated(block, packed, offset, records):
                    self._refuse()
                places.append(_Place(block, begin, end))
                at = at if direct else end
        return places

    def _room(self, number: int, length: int) -> memoryview:
        """Room for a run as it is in the file; it is wanted until its blocks are placed."""
        while number >= len(self.packed):  # runs that are read as they stand have none
            self.packed.append(bytearray())
        if len(self.packed[number]) < length:
            self.packed[number] = bytearray(length)
        return memoryview(self.packed[number])[:length]

    def _refuse(self) -> NoReturn:
        if self.contents.indexed:
            raise IndexMismatchError
        raise BagError(f"{self.contents.path}: the file changed while it was read; read it again when it is written")

    def _inflate_together(self, run: Sequence[Block], packed: memoryview, target: memoryview) -> bool:
        """Decompress blocks in one call; False where that does not work, whatever the reason."""
        origin = _begin(run[0])
        frames = [packed[block.offset - origin : block.offset - origin + block.size] for block in run]
        try:
            if [zstandard.frame_content_size(frame) for frame in frames] != [block.length for block in run]:
                return False  # else each frame gives as much as it says, or an error
            reader = self.zstd.stream_reader(b"".join(frames), read_across_frames=True)
            filled = 0
            while filled < len(target) and (more := reader.readinto(target[filled:])):
                filled += more
        except (zstandard.ZstdError, MemoryError):
            return False
        return filled == len(target)

    def _inflate(self, block: Block, data: memoryview, target: memoryview) -> bool:
        """Decompress; False where that does not give as many bytes as the block has."""
        try:
            if not block.compression:
                target[:] = data[: block.length]
                return True
            if block.compression == "zstd":
                reader = self.zstd.stream_reader(data)
                filled = 0
                while filled < block.length and (more := reader.readinto(target[filled:])):
                    filled += more
                return filled == block.length and (not block.unchecked or not reader.read(1))
            more = 1 if block.unchecked else 0  # `scan` may have left out what follows the last record
            records, _, ended = lz4.frame.decompress_chunk(self.lz4, data, max_length=block.length + more)
            if not ended:  # the next block is not its continuation
                lz4.frame.reset_decompression_context(self.lz4)
            target[: len(records)] = records  # ValueError where there is more than room
            return len(records) == block.length
        except (zstandard.ZstdError, RuntimeError, EOFError, ValueError, MemoryError):
            lz4.frame.reset_decompression_context(self.lz4)
            return False

    def _as_stated(self, block: Block, packed: memoryview, offset: int, records: memoryview) -> bool:
        """Compare what precedes a block with it, and its records against their checksum."""
        head = packed[offset - block.unchecked : offset]
        checksum = int.from_bytes(head[_CHECKSUM_AT : _CHECKSUM_AT + 4], "little")
        name = block.compression.encode()
        stated = _chunk_head(len(name))(
            Opcode.CHUNK,
            block.unchecked - RECORD.size + block.size,
            block.start,
            block.end,
            block.length,
            checksum,
            len(name),
            name,
            block.size,
        )
        return head == stated and (crc32(records) == checksum if checksum else not self.contents.summed)


@cache
def _chunk_head(name_length: int) -> Callable[..., bytes]:
    return struct.Struct(f"<BQQQQII{name_length}sQ").pack


# --- records in the buffer ----------------------------------------------------------------------------------


def _messages(data: bytearray, places: Sequence[_Place], wanted: NDArray[np.bool_], contents: Contents) -> Batch:
    """Messages of wanted channels among the records."""
    left = most_records(contents.size)
    found: list[tuple[NDArray[Any], ...]] = []
    for _, begin, end in places:
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
