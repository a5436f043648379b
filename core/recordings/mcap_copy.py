# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Copies of MCAP files, record by record: messages, definitions, attachments and metadata as they stand.

Chunks go over as they are, compressed bytes included, as long as their numbers of schemas and channels are free in
the copy. What `mcap_scan.scan` could not read of a damaged file is not in the copy; messages outside chunks are put
into chunks, because readers that use the index see no others.
"""

from __future__ import annotations

import heapq
import struct
from collections.abc import Iterable, Iterator, Mapping
from operator import itemgetter
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, Schema

from uncertain_lti.base.errors import BagError
from uncertain_lti.base.files import MAGIC
from uncertain_lti.recordings.mcap_records import MESSAGE, RECORD, Block, Contents, inflate, parse, walk
from uncertain_lti.recordings.mcap_writer import INDEX_ENTRY, McapWriter, channel_record, schema_record
from uncertain_lti.recordings.unreadable import os_error

_PIECE = 1 << 20  # bytes of an attachment that are held at once
_LARGEST_METADATA = 1 << 26  # bytes
_ATTACHMENT = struct.Struct("<QQ")  # log time, time of creation
_LARGEST_PRIVATE = 1 << 28  # bytes
_NUMBER = struct.Struct("<H")
_MESSAGE, _SCHEMA, _CHANNEL = int(Opcode.MESSAGE), int(Opcode.SCHEMA), int(Opcode.CHANNEL)


_Schema = tuple[str, str, bytes]  # name, encoding, text
_Channel = tuple[int, str, str, dict[str, str]]  # schema, topic, encoding, metadata


class _Source:
    """A file that is read at places; raises BagError where it cannot be, so that other errors are the copy's."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._stream = open(path, "rb", buffering=0)
        except OSError as error:
            raise os_error(path, error) from None

    def __enter__(self) -> _Source:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def at(self, place: int, size: int) -> bytes:
        """This many bytes, or fewer at the end of the file."""
        pieces = []
        try:
            self._stream.seek(place)
            while size and (piece := self._stream.read(size)):
                pieces.append(piece)
                size -= len(piece)
        except OSError as error:
            raise os_error(self.path, error) from None
        return pieces[0] if len(pieces) == 1 else b"".join(pieces)

    def all_at(self, place: int, size: int) -> bytes:
        """This many bytes."""
        data = self.at(place, size)
        if len(data) < size:
            raise self.changed()
        return data

    def changed(self) -> BagError:
        """The error for a file that is not what it was."""
        return BagError(f"{self.path}: the file changed while it was read; read it again when it is written")


def profile_of(path: Path) -> str:
    """The profile that a file states in its first record; "" where it states none."""
    with _Source(path) as source:
        head = source.at(len(MAGIC), RECORD.size)
        if len(head) < RECORD.size:
            return ""
        opcode, length = RECORD.unpack(head)
        body = source.at(len(MAGIC) + RECORD.size, min(length, _PIECE))
    record = parse(Header, body) if opcode == Opcode.HEADER else None
    return str(record.profile) if record else ""


class Copier:
    """Copies whole files, one after the other, to one writer.

    `writer`: gets the copies; `notes`: what could not be copied, each one sentence that begins with the file;
    `unconverted`: messages of files that are no MCAP which could not be converted, and so not be copied.
    """

    def __init__(self, writer: McapWriter) -> None:
        self.unconverted: dict[Path, int] = {}
        self._writer = writer
        self._schemas: dict[int, _Schema] = {}
        self._channels: dict[int, _Channel] = {}
        self.notes: list[str] = []

    def schema(self, name: str, encoding: str, data: bytes) -> int:
        """Number of a schema in the copy, which has it or gets it."""
        for number, there in self._schemas.items():
            if there == (name, encoding, data):
                return number
        return self._new_schema(name, encoding, data, 1)

    def _new_schema(self, name: str, encoding: str, data: bytes, preferred: int) -> int:
        number = _free(self._schemas, preferred)
        self._schemas[number] = (name, encoding, data)
        self._writer.declare_schema(number, name, encoding, data)
        return number

    def channel(self, schema: int, topic: str, encoding: str, metadata: Mapping[str, str], preferred: int = 1) -> int:
        """Declare a new channel in the copy."""
        number = _free(self._channels, preferred)
        self._channels[number] = (schema, topic, encoding, dict(metadata))
        self._writer.declare_channel(number, *self._channels[number])
        return number

    def declare(self, contents: Contents) -> dict[int, int]:
        """Declare what a file declares.

        A channel that the copy has already, of another part of the recording, is the same one.
        """
        known: dict[_Schema, list[int]] = {}
        for number, schema in self._schemas.items():
            known.setdefault(schema, []).append(number)
        schemas = {0: 0}
        for number, s in sorted(contents.schemas.items()):
            there = known.get((s.name, s.encoding, s.data))
            schemas[number] = there.pop(0) if there else self._new_schema(s.name, s.encoding, s.data, number)
        before: dict[object, list[int]] = {}
        for number, entry in self._channels.items():
            before.setdefault(self._key(entry), []).append(number)
        channels = {}
        for number, c in sorted(contents.channels.items()):
            entry = (schemas.get(c.schema_id, 0), c.topic, c.message_encoding, dict(c.metadata))
            same = before.get(self._key(entry))
            channels[number] = same.pop(0) if same else self.channel(*entry, preferred=number)
        return channels

    def copy(self, contents: Contents, channels: Mapping[int, int]) -> Iterator[tuple[int, int]]:
        """Copy a file."""
        same = {number: self._is_same(contents, number, channels) for number in contents.channels}
        with _Source(contents.path) as source:
            blocks = ((block.offset, block) for block in contents.blocks)
            others = ((place, None) for place in contents.others)
            for place, block in heapq.merge(blocks, others, key=itemgetter(0)):
                if block is not None:
                    yield self._block(source, contents, block, channels, same), block.end
                else:
                    self._record(source, place)

    def _key(self, entry: _Channel) -> object:
        """What makes two channels one, whatever their numbers."""
        return self._schemas.get(entry[0]), *entry[1:3], tuple(entry[3].items())

    def _is_same(self, contents: Contents, number: int, channels: Mapping[int, int]) -> bool:
        """A channel, and its schema, bear the same numbers in the copy."""
        schema = contents.channels[number].schema_id
        if channels[number] != number or self._channels[number][0] != schema:
            return False
        described = contents.schemas.get(schema)
        return described is None or self._schemas[schema] == (described.name, described.encoding, described.data)

    def _block(
        self,
        source: _Source,
        contents: Contents,
        block: Block,
        channels: Mapping[int, int],
        same: Mapping[int, bool],
    ) -> int:
        records: bytes | memoryview
        if contents.converted:
            records, whole, data = contents.records(block), False, b""
        else:
            data = source.all_at(block.offset, block.size)
            records, trouble = inflate(block.compression, memoryview(data), block.length)
            if len(records) < block.length:
                raise source.changed()
            whole = not block.cut and not trouble and len(records) == block.length
            records = bytes(records[: block.length])
        found: list[tuple[int, int, int, int]] = []  # channel, log time, begin and end of the record
        as_it_stands, end = whole, 0
        for opcode, begin, end in walk(records):
            if opcode == _MESSAGE:
                if end - begin < MESSAGE.size:
                    as_it_stands = False
                    continue
                channel, _, log_time, _ = MESSAGE.unpack_from(records, begin)
                if channel not in channels:
                    as_it_stands = False
                    continue
                as_it_stands = as_it_stands and same[channel]
                if contents.converted and end - begin == MESSAGE.size:
                    self.unconverted[contents.path] = self.unconverted.get(contents.path, 0) + 1
                    continue
                found.append((channel, log_time, begin - RECORD.size, end))
            elif opcode == _SCHEMA or opcode == _CHANNEL:
                as_it_stands = as_it_stands and self._declared(contents, opcode, records[begin:end], same)
        if not found:
            return 0
        as_it_stands = as_it_stands and end == len(records)
        if not as_it_stands:
            records, found = _renumbered(records, found, channels)
        index: dict[int, bytearray] = {}
        pack = INDEX_ENTRY.pack
        for channel, log_time, begin, _ in found:
            index.setdefault(channel, bytearray()).extend(pack(log_time, begin))
        times = [entry[1] for entry in found]
        packed = (block.compression, data) if as_it_stands and block.compression else None
        if not block.compression and not contents.converted:
            packed = ("", records)
        self._writer.chunk(records, index, (min(times), max(times)), packed)
        return len(found)

    def _declared(self, contents: Contents, opcode: int, content: bytes, same: Mapping[int, bool]) -> bool:
        """A definition inside a block says what the copy says of its number, and nothing behind that.

        Behind it the format allows more, which not every reader passes over.
        """
        if opcode == _CHANNEL:
            channel = parse(Channel, content)
            known = channel and same.get(channel.id) and contents.channels[channel.id] == channel
            return bool(known and content == channel_record(*_entry(channel))[RECORD.size :])
        schema = parse(Schema, content)
        known = schema and self._schemas.get(schema.id) == (schema.name, schema.encoding, schema.data)
        return bool(
            known and content == schema_record(schema.id, schema.name, schema.encoding, schema.data)[RECORD.size :]
        )

    def _record(self, source: _Source, place: int) -> None:
        """A record outside blocks: an attachment, metadata, or one that only its maker knows."""
        opcode, size = RECORD.unpack(source.all_at(place, RECORD.size))
        place += RECORD.size
        if opcode == Opcode.ATTACHMENT:
            head = _attachment_head(source.at(place, min(size, _PIECE)), size)
            if head is None:
                self.notes.append(f"{source.path}: an attachment at byte {place} is damaged; it is left out")
                return
            pieces = (source.all_at(at, min(_PIECE, place + size - at)) for at in range(place, place + size, _PIECE))
            self._writer.copied_attachment(pieces, size, head)
            return
        if size > (_LARGEST_METADATA if opcode == Opcode.METADATA else _LARGEST_PRIVATE):
            self.notes.append(f"{source.path}: a record of {size} bytes at byte {place} is left out as too large")
            return
        body = source.all_at(place, size)
        if opcode != Opcode.METADATA:
            self._writer.copied_record(opcode, body)
        elif (record := parse(Metadata, body)) is None:
            self.notes.append(f"{source.path}: a metadata record at byte {place} is damaged; it is left out")
        else:
            self._writer.copied_metadata(body, record.name)


def _renumbered(
    records: bytes, found: Iterable[tuple[int, int, int, int]], channels: Mapping[int, int]
) -> tuple[bytes, list[tuple[int, int, int, int]]]:
    """The messages alone, with their channels' numbers in the copy."""
    pieces: list[bytes] = []
    moved: list[tuple[int, int, int, int]] = []
    at = 0
    for channel, log_time, begin, end in found:
        number = channels[channel]
        pieces += (
            records[begin : begin + RECORD.size],
            _NUMBER.pack(number),
            records[begin + RECORD.size + _NUMBER.size : end],
        )
        moved.append((number, log_time, at, at + end - begin))
        at += end - begin
    return b"".join(pieces), moved


def _attachment_head(begin: bytes, size: int) -> tuple[int, int, int, str, str] | None:
    """Log time, time of creation, size of the data, name and media type; None where they contradict the size."""
    try:
        log_time, create_time = _ATTACHMENT.unpack_from(begin)
        name, at = _text_at(begin, _ATTACHMENT.size)
        media_type, at = _text_at(begin, at)
        (data_size,) = struct.unpack_from("<Q", begin, at)
    except (struct.error, UnicodeDecodeError, IndexError):
        return None
    return (log_time, create_time, data_size, name, media_type) if at + 8 + data_size + 4 <= size else None


def _text_at(data: bytes, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", data, at)
    if at + 4 + length > len(data):
        raise IndexError
    return data[at + 4 : at + 4 + length].decode(), at + 4 + length


def _entry(channel: Channel) -> tuple[int, int, str, str, dict[str, str]]:
    return channel.id, channel.schema_id, channel.topic, channel.message_encoding, channel.metadata


def _free(taken: Mapping[int, object], preferred: int) -> int:
    """The number asked for, or the next one that is free."""
    if preferred not in taken:
        return preferred
    number = max(taken) + 1
    if number >= 1 << 16:
        number = next(i for i in range(1, 1 << 16) if i not in taken)
    return number
