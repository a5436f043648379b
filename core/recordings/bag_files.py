# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Files of a recording of ROS messages: what belongs together, in which order, and containers other than MCAP.

ROS 1 bags and rosbag2 databases (.db3) are read by `rosbags` for convenience, once, in a process of its own (`aside`),
which counts their messages and compares them with the file's own index. Afterwards blocks of them are read as MCAP
records with CDR messages. In a damaged file what is before the damage in time counts.
"""

from __future__ import annotations

import itertools
import os
import re
import shlex
import struct
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import lru_cache
from operator import attrgetter
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, ClassVar
from urllib.parse import quote

from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Schema

from uncertain_lti.base.errors import BagError
from uncertain_lti.base.files import MAGIC, natural
from uncertain_lti.recordings.mcap_records import LATEST, RECORD, Block, Contents, Tally, count, messages, parse
from uncertain_lti.recordings.mcap_scan import outline, scan
from uncertain_lti.recordings.mcap_writer import message_head
from uncertain_lti.recordings.message_types import define, distribution_text, ros2_text
from uncertain_lti.recordings.unreadable import (
    SUFFIXES,
    aside,
    changed,
    file_names,
    name_each,
    no_recording,
    one_line,
    os_error,
)
from uncertain_lti.signals.field_path import full_name
from uncertain_lti.signals.values import read_yaml

_DATABASE = b"SQLite format 3\0"
_BAG = b"#ROSBAG V2.0\n"
_BLOCK = 1 << 22  # bytes of messages that are read at once, at least
_LARGEST_BLOCK = 1 << 28
_MOST_TOPICS = (1 << 16) - 1
_LENGTH = struct.Struct("<I")
_CHUNK = b"op=\x05"
_REMEDIES = {
    _DATABASE: "copy it again, or mend it with `sqlite3 {} '.recover' | sqlite3 mended.db3`",
    _BAG: "copy it again, or mend it with `rosbag reindex {}` of ROS 1",
}


@dataclass(slots=True)
class Foreign(Contents):
    """What is known of such a file; a block is all from its first to its last log time.

    `numbers`: connection in the file -> number of its channel; `magic`: first bytes of the file.
    """

    numbers: dict[int, int] = field(default_factory=dict)
    magic: bytes = b""

    converted: ClassVar[bool] = True

    def damaged(self, how: str) -> str:
        """The sentence for a file that is not whole, with the remedy."""
        return f"{self.path}: {how}; {_REMEDIES[self.magic].format(shlex.quote(str(self.path)))}"

    def records(self, block: Block, channels: Collection[int] | None = None) -> bytes:
        """Messages of one block as MCAP has them."""
        convert: dict[int, Callable[[bytes], bytes]] = {}
        if self.magic == _BAG:
            schemas = {number: self.schemas[self.channels[number].schema_id] for number in block.channels}
            convert = {number: define(s.name, s.encoding, s.data).from_ros1 for number, s in schemas.items()}
        asked = block.channels if channels is None else channels
        pieces: list[bytes] = []
        try:
            with _reader(self.path, self.magic) if self.magic == _DATABASE else _among(self.path, block) as reader:
                wanted = [connection for connection in reader.connections if self.numbers[connection.id] in asked]
                for connection, time, data in reader.messages(wanted, block.start, block.end + 1) if wanted else ():
                    number = self.numbers[connection.id]
                    if _usable(time, data):
                        message = convert[number](bytes(data)) if convert else data
                        pieces += (message_head(number, len(pieces) // 2, time, len(message)), message)
        except Exception as error:  # a library raises whatever the bytes lead it to
            raise changed(self.path, f" ({one_line(error)})") from None
        if block is self.blocks[-1]:
            _indexed.cache_clear()  # of millions of messages it is a GB
        return b"".join(pieces)


def scan_foreign(path: Path) -> Foreign | None:
    """What is in a file that is a ROS 1 bag or a database; None for every other."""
    with open(path, "rb") as stream:
        head = stream.read(len(_DATABASE))
    if head.startswith(b"#ROSBAG V") and not head.startswith(_BAG):
        remedy = "convert it with `rosbag fix` of ROS 1, or record again"
        raise BagError(f"{path}: a ROS 1 bag of another version than 2.0; {remedy}")
    if not head.startswith((_DATABASE, _BAG)):
        return None
    found: Foreign = aside(_scan, path, "ROS 1 bag" if head.startswith(_BAG) else "database of ROS 2")
    log = path.with_name(f"{path.name}-wal")
    if found.magic == _DATABASE and log.exists() and log.stat().st_size:
        remedy = f"put them in with `sqlite3 {shlex.quote(str(path))} 'PRAGMA wal_checkpoint'`"
        unwritten = f"messages that were not yet written to it are in {log.name} and are not read"
        found.warnings.append(f"{path}: {unwritten}; {remedy}")
    return found


@contextmanager
def _reader(path: Path, magic: bytes) -> Iterator[Any]:
    from rosbags.rosbag1 import Reader
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    reader = Reader(path) if magic == _BAG else Sqlite3Reader(Path(quote(str(path.resolve()))))
    reader.open()
    try:
        yield reader
    finally:
        reader.close()


@contextmanager
def _among(path: Path, block: Block) -> Iterator[Any]:
    """A reader of a ROS 1 bag that has no others than the messages of a block to look through."""
    state = path.stat()
    reader, indexes = _indexed(path, state.st_mtime_ns, state.st_size)
    time = attrgetter("time")
    reader.indexes = {
        of: rows[bisect_left(rows, block.start, key=time) : bisect_right(rows, block.end, key=time)]
        for of, rows in indexes.items()
    }
    yield reader


@lru_cache(maxsize=1)
def _indexed(path: Path, *_state: int) -> tuple[Any, Any]:
    """A reader and its index, which takes longer to read than a block of messages."""
    from rosbags.rosbag1 import Reader

    reader = Reader(path)
    reader.open()
    return reader, reader.indexes


def _scan(path: Path) -> Foreign:
    with open(path, "rb") as stream:
        magic = next(known for known in _REMEDIES if stream.read(len(known)) == known or stream.seek(0))
        found = Foreign(path, path.stat().st_size, magic=magic)
        chunks = _chunks(stream, found.size) if magic == _BAG else 0
    try:
        with _reader(path, magic) as reader:
            stated = _declare(found, reader, chunks)
            if magic == _DATABASE:  # an index that lacks rows hides them from whoever reads in order of time
                wrong = str(reader.dbconn.execute("PRAGMA integrity_check(1)").fetchone()[0])
                if wrong != "ok":
                    found.warnings.append(found.damaged(f"is damaged ({one_line(wrong)})"))
            if trouble := _walk(found, reader):
                of = f"{found.count} of {count(stated, 'message')} before that count"
                found.warnings.append(found.damaged(f"is cut or damaged ({trouble}); {of}"))
            elif stated != found.count or any(
                info.msgcount != (tally.count if (tally := found.tally.get(found.numbers[info.id])) else 0)
                for info in reader.connections
            ):
                of = f"{found.count} could be read, each with its topic and a log time"
                found.warnings.append(found.damaged(f"its index counts {count(stated, 'message')}, and {of}"))
    except (BagError, MemoryError):
        raise
    except Exception as error:  # a library raises whatever the bytes lead it to
        what = "ROS 1 bag" if magic == _BAG else "recording of ROS 2"
        raise BagError(found.damaged(f"is cut or damaged or no {what} ({one_line(error)})")) from None
    return found


def _usable(time: object, data: object) -> bool:
    return isinstance(time, int) and 0 <= time <= LATEST and isinstance(data, bytes)


def _chunks(stream: BinaryIO, size: int) -> int:
    """Count the chunks of a ROS 1 bag from its beginning, to compare with its index."""
    number, at = 0, stream.seek(len(_BAG))
    while at < size:
        header = stream.read(_LENGTH.unpack(head)[0]) if len(head := stream.read(4)) == 4 else b""
        rest = stream.read(4)
        if len(rest) < 4:
            break
        number += _CHUNK in header
        at = stream.seek(_LENGTH.unpack(rest)[0], 1)
    return number


def _declare(found: Foreign, reader: Any, chunks: int) -> int:
    """Channels and schemas of the file; returns how many messages its index states."""
    if len(reader.connections) > _MOST_TOPICS:
        raise BagError(f"{found.path}: has more than {_MOST_TOPICS} topics; write those that are needed")
    encodings, qos, distribution = {}, {}, ""
    if found.magic == _DATABASE:
        stated = reader.metadata.message_count
        encodings = {c.id: c.ext.serialization_format for c in reader.connections}
        if reader.schema >= 2:
            qos = dict(reader.dbconn.execute("SELECT id, offered_qos_profiles FROM topics"))
        if reader.schema >= 3:
            distribution = next(iter(reader.dbconn.execute("SELECT ros_distro FROM schema")), ("",))[0]
    else:
        if chunks != len(reader.chunks):
            lists = f"its index lists {len(reader.chunks)}"
            found.warnings.append(found.damaged(f"holds {count(chunks, 'chunk')}, and {lists}"))
        stated = sum(sum(info.connection_counts.values()) for info in reader.chunk_infos)
    schemas, borrowed = dict[tuple[str, str], int](), set[str]()
    for number, connection in enumerate(reader.connections, start=1):
        kind, text = connection.msgtype, connection.msgdef.data
        if (schema := schemas.get((kind, text), 0)) == 0:
            schema = schemas[kind, text] = len(schemas) + 1
            encoding, data = "ros2idl" if connection.msgdef.format.name == "IDL" else "ros2msg", text.encode()
            if found.magic == _BAG:
                data = ros2_text(kind, data)
            elif not text:
                text, store = distribution_text(kind, distribution)
                data = text.encode()
                borrowed |= {store} if text else set()
            found.schemas[schema] = Schema(schema, data, encoding, kind)
        found.numbers[connection.id] = number
        metadata = {"offered_qos_profiles": qos[connection.id]} if qos.get(connection.id) else {}
        stored = encodings.get(connection.id) or "cdr"
        name = connection.topic  # of ROS 1 without a slash, where `rosbag record scan` wrote it
        topic = name if found.magic == _DATABASE else f"/{name.lstrip('/')}"
        found.channels[number] = Channel(number, topic, stored, metadata, schema)
    if borrowed:
        lacks = "the file does not hold the definitions of all its types"
        found.warnings.append(f"{found.path}: {lacks}; those of {' and '.join(sorted(borrowed))} are used")
    return int(stated)


def _walk(found: Foreign, reader: Any) -> str:
    """Blocks of messages in order of time; returns what ended it early."""
    most = min(max(_BLOCK, found.size >> 4), _LARGEST_BLOCK)
    rows: list[tuple[int, int]] = []  # channel and time
    size, trouble = 0, ""
    try:
        for connection, time, data in reader.messages(reader.connections) if reader.connections else ():
            if not _usable(time, data):
                continue
            if size > most and time > rows[-1][1]:
                _close(found, rows, size)
                rows, size = [], 0
            rows.append((found.numbers[connection.id], time))
            size += len(data)
    except Exception as error:  # a library raises whatever the bytes lead it to
        trouble = one_line(error)
        rows = [row for row in rows if row[1] != rows[-1][1]]  # the next one may be of that time
    if rows:
        _close(found, rows, size)
    return trouble


def _close(found: Foreign, rows: list[tuple[int, int]], size: int) -> None:
    for number, time in rows:
        tally = found.tally.setdefault(number, Tally(0, time, time))
        tally.count, tally.last = tally.count + 1, time
    channels = frozenset(number for number, _ in rows)
    found.blocks.append(Block(len(found.blocks), size, "", size, rows[0][1], rows[-1][1], channels))


_PART = re.compile(r"(?P<stem>.*)_(?P<index>\d+)\.(?:mcap|db3|bag)")


def stem_and_index(path: Path) -> tuple[str, int] | None:
    """(`name`, 3) of `name_3.mcap`; None for other names."""
    match = _PART.fullmatch(path.name)
    return (match["stem"], int(match["index"])) if match else None


def _about(folder: Path) -> dict[str, Any]:
    """What a folder's metadata.yaml says of the recording; nothing without a usable one."""
    import yaml

    try:
        text = (folder / "metadata.yaml").read_text(encoding="utf-8")
        about = read_yaml(text)["rosbag2_bagfile_information"]
    except (OSError, ValueError, yaml.YAMLError, KeyError, TypeError, RecursionError):
        return {}
    return about if isinstance(about, dict) else {}


def listed_parts(folder: Path) -> list[Path]:
    """Parts in the order of the folder's metadata.yaml, there or not; none without a usable one."""
    about = _about(folder)
    names = about.get("relative_file_paths")
    if not isinstance(names, list):
        return []
    # Old recorders wrote the path from the folder above.
    parts = [part if (part := folder / str(n)).exists() else folder / PurePosixPath(str(n)).name for n in names]
    storage = str(about.get("storage_identifier") or "")  # `ros2 bag reindex` may leave it empty
    if storage not in ("", "mcap", "sqlite3"):
        raise BagError(f"{folder}: a recording in '{storage}' storage; convert it to MCAP with ros2 bag convert")
    return parts


def parts_of(folder: Path) -> tuple[list[Path], bool, list[str]]:
    """Files of a folder that is one recording.

    Without metadata.yaml the parts are the folder's `<stem>_<i>.mcap`, `.db3` or `.bag` of one stem in natural order.
    """
    inside = sorted((p for p in folder.iterdir() if not p.name.startswith(".")), key=natural)
    found = [p for p in inside if p.suffix in SUFFIXES and not p.is_dir()]
    listed = listed_parts(folder)
    if listed:
        there = [part for part in listed if part.exists()]
        warnings = [f"{p}: metadata.yaml lists this part, and it is not there" for p in listed if p not in there]
        warnings += [f"{p}: metadata.yaml does not list this file; it is left out" for p in found if p not in there]
        if there:
            return there, True, warnings
        if len(listed) == len(found) == 1:  # renamed
            instead = f"{listed[0]}: metadata.yaml lists this file, and {found[0].name} is read, which is there instead"
            return found, False, [instead]
        others = f", or name one of those that are there: {file_names(found)}" if found else ""
        none = f"metadata.yaml lists {file_names(listed)}, and none of them is there"
        raise BagError(f"{folder}: {none}; copy them here{others}")
    if not found:
        raise no_recording(folder, inside)
    if len({pair[0] if (pair := stem_and_index(p)) else p.name for p in found}) > 1:
        several = "without a metadata.yaml its files cannot be one recording"
        raise BagError(f"{folder}: {several}; {name_each(folder, found)}")
    unusable = f"{folder}: its metadata.yaml cannot be used; the files were taken by their names"
    return found, False, [unusable] * (folder / "metadata.yaml").exists()


def survey(path: Path, indexed: bool = False) -> Contents:
    """What is in a file; if `indexed`, what its index states where it has one."""
    try:
        return scan_foreign(path) or (outline(path) if indexed else None) or scan(path)
    except OSError as error:
        raise os_error(path, error) from None


def not_one_recording(parts: Sequence[Contents]) -> str:
    """Say why files are not the consecutive parts of one recording."""
    pause: int | None = None
    for before, after in itertools.pairwise(parts):
        names = f"{before.path.name} and {after.path.name}"
        pair = stem_and_index(before.path), stem_and_index(after.path)
        if not pair[0] or not pair[1] or pair[1][1] != pair[0][1] + 1:
            return f"{names} are not numbered one after the other"
        if not before.tally or not after.tally:
            continue  # nothing in it that could contradict
        kinds = [_kinds(part) for part in (before, after)]
        if not (kinds[0] <= kinds[1] or kinds[1] <= kinds[0]):
            return f"{names} do not carry the same topics"
        (begin, end), (next_begin, next_end) = _span(before), _span(after)
        if next_begin - end > 10**9 and pause is None:
            pause = max(_longest_pause(part) for part in parts)
        if next_begin - end > max(10**9, pause or 0):
            return f"{(next_begin - end) / 1e9:.1f} s lie between {names}"
        if next_begin < begin or (end - next_begin) * 10 > min(end - begin, next_end - next_begin):
            return f"{names} overlap in time"
    return ""


def _kinds(contents: Contents) -> set[tuple[str, str]]:
    """(topic, type) of every channel of a file."""
    types = {number: full_name(schema.name) for number, schema in contents.schemas.items() if number}
    return {(c.topic, types.get(c.schema_id, "")) for c in contents.channels.values()}


def _span(contents: Contents) -> tuple[int, int]:
    return min(block.start for block in contents.blocks), max(block.end for block in contents.blocks)


def _longest_pause(contents: Contents) -> int:
    """Longest time without any message, ns."""
    if contents.indexed:
        contents = survey(contents.path)
    times = sorted(message[1] for block in contents.blocks for message in messages(contents.records(block)))
    return max((b - a for a, b in itertools.pairwise(times)), default=0)


_LARGEST = 1 << 20  # bytes of one metadata record that is read


def metadata_pairs(recording: str | os.PathLike[str]) -> dict[str, str]:
    """Pairs of a recording's metadata.yaml (`custom_data`) and of its first MCAP file's metadata records."""
    path = Path(recording)
    folder = path if path.is_dir() else path.parent
    custom = _about(folder).get("custom_data")
    pairs = {str(key): str(value) for key, value in (custom if isinstance(custom, dict) else {}).items()}
    files = sorted(folder.glob("*.mcap")) if path.is_dir() else [path]
    for name, record in _records(files[0]) if files else []:
        for key, value in record.items():
            pairs.setdefault(key, value)
            pairs.setdefault(f"{name}/{key}", value)
    return pairs


def _records(path: Path) -> list[tuple[str, dict[str, str]]]:
    """Name and pairs of each metadata record; every other record is skipped without reading it."""
    found: list[tuple[str, dict[str, str]]] = []
    with suppress(OSError), open(path, "rb") as stream:
        size = path.stat().st_size
        whole = stream.read(len(MAGIC)) == MAGIC
        while whole and len(header := stream.read(RECORD.size)) == RECORD.size:
            opcode, length = RECORD.unpack(header)
            if opcode in (0, Opcode.DATA_END, Opcode.FOOTER) or length > size - stream.tell():
                break
            if opcode != Opcode.METADATA or length > _LARGEST:
                stream.seek(length, 1)
            elif (record := parse(Metadata, stream.read(length))) is not None:
                found.append((record.name, dict(record.metadata)))
    return found
