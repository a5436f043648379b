# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Messages of MCAP blocks as columns: some MiB of blocks in one buffer, the records in it found all at once.

Records stand one behind the other, each with its length, so one follows them from the first to the last. Here
many walkers take a step together: one begins at each block, and within a large block also wherever something looks
like a message. Each has to arrive exactly where the next one began, which proves that the next one began well, so
what is found is what walking alone finds (`mcap_records.walk`); where one does not, the blocks are walked alone.
"""

from __future__ import annotations

import re
import struct
from array import array
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import BinaryIO, NamedTuple, NoReturn

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Integers
from uncertain_lti.base.errors import BagError
from uncertain_lti.recordings.cdr_arrays import SLACK, numbers_at
from uncertain_lti.recordings.mcap_records import MESSAGE, RECORD, Block, Contents, crc32, parse, walk
from uncertain_lti.recordings.mcap_scan import most_records
from uncertain_lti.recordings.unreadable import os_error

_BATCH = 1 << 22  # bytes; small blocks are put together until they reach this
_STRIDE = 1 << 15  # bytes between two walkers in a large block
_LOOK = 1 << 14  # bytes in which a walker looks for its first message
_LIKE_A_MESSAGE = re.compile(rb"\x05.{4}\0{4}", re.DOTALL)
_NEAR = 1 << 16  # bytes between blocks that are read along
_FEW = 100  # messages in a block that one walker passes soon enough
_EVERY = 16  # messages that a walker passes, where an index says where they are
_LONG_INDEX = 1 << 10  # bytes per channel from which on an index is faster than looking
_CHANNEL_AT = RECORD.size
_LOG_TIME_AT = RECORD.size + 6
_DATA_AT = RECORD.size + MESSAGE.size
_CHECKSUM_AT = RECORD.size + 24
_FEW_BLOCKS = 32
_MOST_STEPS = 1 << 14
_AHEAD = 1 << 24  # bytes; a larger batch is not read while another one is worked on


class IndexMismatchError(Exception):
    """The file is not what its index states: it has to be walked."""


@dataclass(frozen=True, slots=True)
class Batch:
    """Messages of wanted channels in file order.

    data[begin:end] is an encoded message. SLACK bytes before and after every message can be read as well.

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
            yield _messages(data, _starts(data, places, contents), wanted, contents)
        return
    try:
        with open(contents.path, "rb", buffering=0) as stream:
            for data, places in _loaded(contents, stream, groups):
                batch = _messages(data, _starts(data, places, contents), wanted, contents)
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
    """Blocks of a file that is no MCAP, in a buffer with SLACK bytes around."""
    data = bytearray(SLACK)
    places = []
    for block in blocks:
        begin = len(data)
        data += contents.records(block, channels)
        places.append(_Place(block, begin, len(data), None))
    data += bytes(SLACK)
    return data, places


def _begin(block: Block) -> int:
    """Where the block begins in the file, with what precedes its records."""
    return block.offset - block.unchecked


def _end(block: Block) -> int:
    return block.offset + block.size + block.indexed


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
    """Where the records of a block are in the buffer; offsets of its messages from begin, as its index has them."""

    block: Block
    begin: int
    end: int
    offsets: Integers | None


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
        at = SLACK
        every = list(_runs(blocks))
        as_is = [all(not block.compression for block in run) for run in every]
        sizes = [
            _end(run[-1]) - _begin(run[0]) if direct else sum(block.length for block in run)
            for run, direct in zip(every, as_is, strict=True)
        ]
        if len(self.data) < sum(sizes) + 2 * SLACK:
            self.data = bytearray(sum(sizes) + 2 * SLACK)
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
        """Put the records of what was read into the buffer, with SLACK bytes around; raises as `batches` does."""
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
                offsets = _offsets(block, packed[behind : behind + block.indexed])
                places.append(_Place(block, begin, end, offsets))
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


def _starts(data: bytearray, places: Sequence[_Place], contents: Contents) -> Integers:
    """Where the records in the buffer begin."""
    for by_index in (True, False):
        begins, limits = _walkers(data, places, by_index)
        starts = _together(data, begins, limits)
        if starts is not None:
            return starts
    alone = array("q")
    most = most_records(contents.size)
    for place in places:
        reached = place.begin
        for _, content, stop in walk(memoryview(data)[place.begin : place.end]):
            if contents.indexed and len(alone) >= most:
                raise IndexMismatchError
            alone.append(place.begin + content - RECORD.size)
            reached = place.begin + stop
        if contents.indexed and reached != place.end:
            raise IndexMismatchError
    return np.frombuffer(alone, dtype=np.int64)


def _walkers(data: bytearray, places: Sequence[_Place], by_index: bool) -> tuple[Integers, Integers]:
    """Where walkers begin, and where each has to arrive."""
    begins: list[int] = []
    limits: list[int] = []
    for place in places:
        if place.begin == place.end:
            continue
        if not by_index:
            here = _likely_messages(data, place)
        elif place.offsets is not None:
            here = (place.begin + place.offsets).tolist()
        elif 0 < place.block.indexed < _FEW * 16:
            here = []
        else:
            here = _likely_messages(data, place)
        begins.append(place.begin)
        begins += here
        limits += here
        limits.append(place.end)
    return np.array(begins, dtype=np.int64), np.array(limits, dtype=np.int64)


def _offsets(block: Block, after: memoryview) -> Integers | None:
    """Offsets of some messages as stated behind a large block, in order, none at its begin; None where odd."""
    if block.indexed < _LONG_INDEX * len(block.channels):
        return None
    offsets = []
    at = 0
    while at < block.indexed:
        opcode, length = RECORD.unpack_from(after, at)
        content = at + RECORD.size + 6
        at += RECORD.size + length
        if opcode != Opcode.MESSAGE_INDEX or at > block.indexed or length < 6 or (length - 6) % 16:
            return None
        offsets.append(np.frombuffer(after[content:at], "<i8")[1::2])
    every = np.sort(np.concatenate(offsets))
    if not len(every) or every[0] < 0 or every[-1] >= block.length:
        return None
    return every[1:][::_EVERY]


def _together(data: bytearray, begins: Integers, limits: Integers) -> Integers | None:
    """Where records begin, found by walkers that go side by side; None where one does not arrive."""
    length = numbers_at(data, "<u4")
    position, limit = begins, limits
    found: list[Integers] = []
    while position.size:
        if len(found) == _MOST_STEPS:
            return None  # one after the other they are passed sooner
        found.append(position)
        position = position + length[position + 1]
        position += RECORD.size
        going = position < limit
        if np.count_nonzero(going) < len(going):
            if not np.array_equal(position[~going], limit[~going]):
                return None
            position, limit = position[going], limit[going]
    starts = np.concatenate(found)
    starts.sort()
    if length[starts + 5].any() or not np.frombuffer(data, np.uint8)[starts].all():
        return None  # a record of 4 GiB and more, or a zero, where `walk` ends
    return starts


def _likely_messages(data: bytearray, place: _Place) -> list[int]:
    """Where messages seem to begin, far from each other in a large block."""
    found = []
    goal = place.begin + _STRIDE
    while goal + _STRIDE // 2 < place.end:
        at = _likely_message(data, goal, place.end, place.block)
        if at is not None:
            found.append(at)
        goal = (goal if at is None else at) + _STRIDE
    return found


def _likely_message(data: bytearray, begin: int, end: int, block: Block) -> int | None:
    """Where a message of the block seems to begin, soon after `begin`."""
    stop = min(begin + _LOOK, end - _DATA_AT)
    while match := _LIKE_A_MESSAGE.search(data, begin, stop):
        at = match.start()
        _, length = RECORD.unpack_from(data, at)
        channel, _, log_time, _ = MESSAGE.unpack_from(data, at + RECORD.size)
        fits = MESSAGE.size <= length <= end - at - RECORD.size
        if fits and channel in block.channels and block.start <= log_time <= block.end:
            return at
        begin = at + 1
    return None


def _messages(data: bytearray, starts: Integers, wanted: NDArray[np.bool_], contents: Contents) -> Batch:
    """Messages of wanted channels among the records."""
    is_message = np.frombuffer(data, np.uint8)[starts] == Opcode.MESSAGE
    if not is_message.all():
        if contents.indexed:
            for start in starts[~is_message].tolist():
                _hold_against(contents, data, start)
        starts = starts[is_message]
    length = numbers_at(data, "<u4")[starts + 1].astype(np.int64)
    whole = length >= MESSAGE.size
    if not whole.all():
        if contents.indexed:
            raise IndexMismatchError
        starts, length = starts[whole], length[whole]
    channel = numbers_at(data, "<u2")[starts + _CHANNEL_AT]
    keep = wanted[channel]
    if not keep.all():
        starts, length, channel = starts[keep], length[keep], channel[keep]
    log_time = numbers_at(data, "<u8")[starts + _LOG_TIME_AT]
    return Batch(data, channel, log_time, starts + _DATA_AT, starts + length + RECORD.size)


def _hold_against(contents: Contents, data: bytearray, start: int) -> None:
    """A definition in a chunk has to be the one that the summary gives."""
    opcode, length = RECORD.unpack_from(data, start)
    if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
        return
    content = bytes(memoryview(data)[start + RECORD.size : start + RECORD.size + length])
    record = parse(Schema if opcode == Opcode.SCHEMA else Channel, content)
    known: object = None
    if record is not None:
        known = (contents.schemas if opcode == Opcode.SCHEMA else contents.channels).get(record.id)
    if record is None or record != known:
        raise IndexMismatchError
