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

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, BinaryIO

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Integers
from uncertain_lti.base.errors import BagError
from uncertain_lti.recordings.mcap_records import CHUNK, RECORD, Block, Contents, crc32, inflate, parse
from uncertain_lti.recordings.mcap_scan import most_records
from uncertain_lti.recordings.mcap_walk import walk_records
from uncertain_lti.recordings.unreadable import os_error

_BATCH = 1 << 22  # bytes; small blocks are put together until they reach this
_CHECKSUM_AT = RECORD.size + 24


class IndexMismatchError(Exception):
    """The file is not what its index states: it has to be walked."""


@dataclass(frozen=True, slots=True)
class Batch:
    """Messages of wanted channels in file order.

    data[begin:end] is an encoded message.

    `data`: their records; `channel` (messages,): number of the channel in the file;
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
    for group in groups:
        data, ends = _load(contents, group, channels)
        batch = _messages(data, ends, wanted, contents)
        counts = np.bincount(batch.channel, minlength=1 << 16)
        for channel in missing:
            missing[channel] -= int(counts[channel])
        if contents.indexed and min(missing.values()) < 0:
            raise IndexMismatchError
        yield batch
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


def _load(contents: Contents, blocks: Sequence[Block], channels: Collection[int]) -> tuple[bytearray, list[int]]:
    """Read and decompress blocks, and check those that nobody has read before."""
    data, ends = bytearray(), []
    try:
        with open(contents.path, "rb", buffering=0) as stream:
            for block in blocks:
                if contents.converted:
                    data += contents.records(block, channels)
                else:
                    data += _records(contents, block, stream)
                ends.append(len(data))
    except OSError as error:
        raise os_error(contents.path, error) from None
    return data, ends


def _records(contents: Contents, block: Block, stream: BinaryIO) -> bytes | memoryview:
    stream.seek(block.offset - block.unchecked)
    packed = memoryview(stream.read(block.unchecked + block.size))
    records, trouble = inflate(block.compression, packed[block.unchecked :], block.length)
    if contents.indexed:
        whole = not trouble and len(records) == block.length
        if not whole or not _as_stated(contents, block, packed[: block.unchecked], records):
            raise IndexMismatchError
    elif len(records) < block.length:
        raise BagError(f"{contents.path}: the file changed while it was read; read it again when it is written")
    return records[: block.length]


def _as_stated(contents: Contents, block: Block, head: memoryview, records: bytes | memoryview) -> bool:
    """Compare what precedes a block with it, and its records against their checksum."""
    checksum = int.from_bytes(head[_CHECKSUM_AT : _CHECKSUM_AT + 4], "little")
    name = block.compression.encode()
    length = block.unchecked - RECORD.size + block.size
    stated = RECORD.pack(Opcode.CHUNK, length) + CHUNK.pack(block.start, block.end, block.length, checksum, len(name))
    stated += name + block.size.to_bytes(8, "little")
    return head == stated and (crc32(records) == checksum if checksum else not contents.summed)


def _messages(data: bytearray, ends: Sequence[int], wanted: NDArray[np.bool_], contents: Contents) -> Batch:
    """Messages of wanted channels among the records."""
    left = most_records(contents.size)
    found: list[tuple[NDArray[Any], ...]] = []
    for begin, end in pairwise([0, *ends]):
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
