# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What the summary of a whole MCAP file says of its chunks: where messages are, before any of them is read.

What is read by it afterwards is compared with it (`mcap_batches`): the head of every chunk, its checksum, the
number of messages of every channel. Where anything is not as stated, the file is walked instead
(`mcap_scan.scan`), so a damaged file reads the same either way. Damage to what is not read stays unseen.
"""

from __future__ import annotations

import struct
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Channel, Schema, Statistics

from uncertain_lti.base.files import MAGIC
from uncertain_lti.recordings.aside import most_inflated
from uncertain_lti.recordings.mcap_records import (
    CHUNK,
    FOOTER_SIZE,
    LARGEST_CHUNK,
    LATEST,
    MESSAGE,
    RECORD,
    Block,
    Contents,
    Tally,
    crc32,
    parse,
    walk,
)
from uncertain_lti.recordings.mcap_scan import most_records
from uncertain_lti.recordings.unreadable import os_error

_DATA_END_SIZE = RECORD.size + 4
_FOOTER = struct.Struct("<QQI")  # begin of the summary, begin of its offsets, checksum
_CHUNK_INDEX = struct.Struct("<QQQQI")  # first and last log time, place and length of the chunk, size of what follows
_INDEX_OFFSET = struct.Struct("<HQ")  # channel, place of its message index
_INDEX_REST = struct.Struct("<QI")  # length of the message indexes, of the compression's name
_SIZES = struct.Struct("<QQ")  # compressed, decompressed


class _NoIndexError(Exception):
    """The file has no index that can be gone by."""


def outline(path: Path) -> Contents | None:
    """Contents of a file by its summary; None where the file has to be walked (`scan`)."""
    try:
        with open(path, "rb", buffering=0) as stream:
            size = stream.seek(0, 2)
            foot = size - len(MAGIC) - FOOTER_SIZE
            if foot < len(MAGIC) + _DATA_END_SIZE:
                return None
            stream.seek(0)
            head = stream.read(len(MAGIC))
            stream.seek(foot)
            tail = stream.read(FOOTER_SIZE + len(MAGIC))
            if head != MAGIC or tail[FOOTER_SIZE:] != MAGIC or tail[:9] != RECORD.pack(Opcode.FOOTER, _FOOTER.size):
                return None
            begin, _, checksum = _FOOTER.unpack_from(tail, RECORD.size)
            if not len(MAGIC) + _DATA_END_SIZE <= begin < foot:
                return None
            stream.seek(begin - _DATA_END_SIZE)
            records = stream.read(foot - begin + _DATA_END_SIZE)
    except OSError as error:
        raise os_error(path, error) from None
    if len(records) != foot - begin + _DATA_END_SIZE or records[:9] != RECORD.pack(Opcode.DATA_END, 4):
        return None
    data_crc = records[9:_DATA_END_SIZE] != bytes(4)
    summary = records[_DATA_END_SIZE:]
    if checksum not in (0, crc32(tail[: FOOTER_SIZE - 4], crc32(summary))):
        return None
    try:
        return _contents(path, size, summary, begin - _DATA_END_SIZE, data_crc)
    except (_NoIndexError, struct.error, UnicodeDecodeError):
        return None


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
