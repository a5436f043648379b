# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Copies of recordings: messages, definitions, attachments and metadata as they stand, in chunks of the copy's own.

What `mcap_scan.scan` could not read of a damaged file is not in the copy.
"""

from __future__ import annotations

import heapq
import struct
from collections.abc import Iterator
from operator import itemgetter

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Metadata
from numpy.typing import NDArray

from uncertain_lti.base.errors import BagError
from uncertain_lti.recordings.mcap_records import MESSAGE, RECORD, Block, Contents, count, parse
from uncertain_lti.recordings.mcap_walk import walk_records
from uncertain_lti.recordings.mcap_writer import McapWriter
from uncertain_lti.recordings.unreadable import os_error

_LARGEST = 1 << 30  # bytes of a record outside blocks
_HEAD = RECORD.size + MESSAGE.size


def declare(writer: McapWriter, contents: Contents) -> NDArray[np.uint16]:
    """Declare what a file declares; returns the numbers in the copy by those in the file, 0 for none."""
    schemas = {n: writer.schema(s.name, s.encoding, s.data) for n, s in sorted(contents.schemas.items())}
    numbers = np.zeros(1 << 16, dtype=np.uint16)
    for number, c in sorted(contents.channels.items()):
        numbers[number] = writer.channel(schemas.get(c.schema_id, 0), c.topic, c.message_encoding, c.metadata)
    return numbers


def copy(
    writer: McapWriter, contents: Contents, numbers: NDArray[np.uint16], notes: list[str]
) -> Iterator[tuple[int, int, int]]:
    """Copy a file block by block.

    Yields of each the messages in it, those that were copied, and the last log time; what could not be copied besides
    is noted, each in one sentence that begins with the file.
    """
    blocks = ((block.offset, block) for block in contents.blocks)
    others = ((place, None) for place in contents.others)
    for place, block in heapq.merge(blocks, others, key=itemgetter(0)):
        if block is not None:
            yield *_block(writer, contents, block, numbers), block.end
        elif problem := _record(writer, contents, place):
            notes.append(f"{contents.path}: {problem}; it is left out")


def _block(writer: McapWriter, contents: Contents, block: Block, numbers: NDArray[np.uint16]) -> tuple[int, int]:
    records = bytearray(contents.records(block))
    found = walk_records(records, 0, len(records), len(records))
    channel = numbers[found.channel]
    known = channel > 0
    kept = known & (found.end > found.begin) if contents.converted else known
    channel, times, begin, end = channel[kept], found.log_time[kept], found.begin[kept] - _HEAD, found.end[kept]
    if len(channel):
        data = np.frombuffer(records, dtype=np.uint8)
        data[begin + RECORD.size], data[begin + RECORD.size + 1] = channel & 255, channel >> 8
        starts = (np.cumsum(end - begin) - (end - begin)).astype(np.uint64)
        entries = np.column_stack([times, starts])
        index = {number: entries[channel == number].tobytes() for number in np.unique(channel).tolist()}
        view = memoryview(records)
        whole = b"".join(view[a:b] for a, b in zip(begin.tolist(), end.tolist(), strict=True))
        writer.chunk(whole, index, (int(times.min()), int(times.max())))
    return int(known.sum()), len(channel)


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
        raise BagError(f"{contents.path}: the file changed while it was read; read it again when it is written")
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
