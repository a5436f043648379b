# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""MCAP files for tests, written with the `mcap` library and damaged on purpose afterwards."""

import io
import os
import struct
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import zstandard
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.typesys import Stores, get_typestore

JAZZY = get_typestore(Stores.ROS2_JAZZY)
COMPRESSIONS = {"none": CompressionType.NONE, "lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}


@dataclass(frozen=True)
class Topic:
    """A channel to write; `schema` is the text of the definition, by default that of ROS 2 Jazzy."""

    name: str
    type: str = "std_msgs/msg/Float64"
    encoding: str = "cdr"
    schema: str | None = None
    schema_encoding: str = "ros2msg"
    schema_name: str | None = None

    def schema_text(self) -> str:
        if self.schema is not None:
            return self.schema
        return JAZZY.generate_msgdef(self.type, ros_version=2)[0]


@dataclass(frozen=True)
class Layout:
    """How a file is laid out."""

    compression: str = "none"
    chunked: bool = True
    chunk_size: int = 1024
    summary: bool = True
    indexes: bool = True
    checksums: bool = True


@dataclass(frozen=True)
class Message:
    topic: str
    log_time: int
    data: bytes
    publish_time: int = 0
    channel: int = 0  # which of the topic's channels


@dataclass
class File:
    """Bytes of an MCAP file, and its messages in file order."""

    data: bytes
    messages: list[Message] = field(default_factory=list)

    def save(self, path: str | os.PathLike[str], cut: int | None = None) -> Path:
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(self.data[:cut])
        return path


def float64(value: float) -> bytes:
    """CDR of a std_msgs/msg/Float64."""
    return b"\x00\x01\x00\x00" + struct.pack("<d", value)


def cdr(type_name: str, little_endian: bool = True, **fields: Any) -> bytes:
    """CDR of a message of ROS 2 Jazzy, from all its fields; see `message`."""
    return bytes(JAZZY.serialize_cdr(message(type_name, **fields), type_name, little_endian=little_endian))


def message(type_name: str, **fields: Any) -> Any:
    return JAZZY.types[type_name](**fields)


def array(values: Any, type_name: str = "std_msgs/msg/Float64MultiArray") -> bytes:
    """CDR of an array message without a layout."""
    layout = message("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    return cdr(type_name, layout=layout, data=np.asarray(values))


def header(stamp_ns: int, frame: str = "") -> Any:
    stamp = message("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return message("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def write(topics: Iterable[Topic], messages: Iterable[Message], layout: Layout = Layout()) -> File:
    """An MCAP file of these messages in this order; several topics of one name become several channels.

    A topic of schema encoding "" has no schema at all.
    """
    stream = io.BytesIO()
    written = list(messages)
    of_summary = "repeat_channels", "repeat_schemas", "use_statistics", "use_summary_offsets"
    flags = dict.fromkeys(of_summary, layout.summary) | {"use_chunking": layout.chunked}
    # Of channels without any message outside chunks the library writes a wrong one.
    flags |= {"enable_data_crcs": layout.checksums and (layout.chunked or bool(written))}
    kinds = {"compression": COMPRESSIONS[layout.compression], "chunk_size": layout.chunk_size}
    kinds |= {"index_types": IndexType.ALL if layout.indexes else IndexType.NONE}
    writer = Writer(stream, enable_crcs=layout.checksums, **kinds, **flags)
    writer.start(profile="ros2", library="uncertain-lti tests")
    channels: dict[str, list[int]] = {}
    for topic in topics:
        name = topic.type if topic.schema_name is None else topic.schema_name
        schema = 0
        if topic.schema_encoding:
            schema = writer.register_schema(name, topic.schema_encoding, topic.schema_text().encode())
        channels.setdefault(topic.name, []).append(writer.register_channel(topic.name, topic.encoding, schema))
    for sequence, entry in enumerate(written):
        channel = channels[entry.topic][entry.channel]
        writer.add_message(channel, entry.log_time, entry.data, entry.publish_time, sequence)
    writer.finish()
    return File(stream.getvalue(), written)


def ramp(topic: str, times: Iterable[int]) -> list[Message]:
    """Float64 messages 0.0, 1.0, ... at these log times (ns)."""
    return [Message(topic, time, float64(i), time) for i, time in enumerate(times)]


def write_folder(folder: Path, parts: Mapping[str, File], metadata: str | None = None) -> Path:
    """A folder of MCAP files, with this text as metadata.yaml if there is one."""
    for name, part in parts.items():
        part.save(folder / name)
    if metadata is not None:
        (folder / "metadata.yaml").write_text(metadata)
    return folder


def metadata_yaml(names: Iterable[str], storage: str = "mcap") -> str:
    """What of a rosbag2 metadata.yaml says which files a recording has."""
    listed = "".join(f"    - {name}\n" for name in names)
    about = f"rosbag2_bagfile_information:\n  version: 9\n  storage_identifier: {storage}\n  relative_file_paths:\n"
    return about + listed


@dataclass(frozen=True)
class Place:
    """Where a record stands in a file: from `begin` (its opcode) to `end`."""

    opcode: int
    begin: int
    end: int


def places(data: bytes) -> list[Place]:
    """All top-level records of a whole file."""
    found, position = [], 8
    while position < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, position)
        found.append(Place(opcode, position, position + 9 + length))
        position = found[-1].end
    return found


# --- files record by record, for what no writer would write ----------------------------------------------------

MAGIC = b"\x89MCAP0\r\n"


def record(opcode: int, body: bytes = b"") -> bytes:
    """One record as it stands in a file."""
    return struct.pack("<BQ", opcode, len(body)) + body


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text.encode())) + text.encode()


def schema_record(number: int, topic: Topic, more: bytes = b"") -> bytes:
    """A schema; more: bytes behind what the format knows."""
    text = topic.schema_text().encode()
    name = topic.type if topic.schema_name is None else topic.schema_name
    body = struct.pack("<H", number) + _text(name) + _text(topic.schema_encoding) + struct.pack("<I", len(text)) + text
    return record(3, body + more)


def channel_record(number: int, topic: Topic, schema: int, more: bytes = b"") -> bytes:
    return record(4, struct.pack("<HH", number, schema) + _text(topic.name) + _text(topic.encoding) + bytes(4) + more)


def message_record(channel: int, log_time: int, data: bytes) -> bytes:
    return record(5, struct.pack("<HIQQ", channel, 0, log_time, log_time) + data)


def chunk_record(
    records: bytes, compression: str = "zstd", span: tuple[int, int] = (0, 2**62), stated: int | None = None
) -> bytes:
    """A chunk of these records; stated: the size that it says it has decompressed."""
    packed = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "": bytes}[compression](records)
    head = struct.pack("<QQQI", *span, len(records) if stated is None else stated, zlib.crc32(records))
    return record(6, head + _text(compression) + struct.pack("<Q", len(packed)) + packed)


def chunk_index(
    offset: int,
    chunk: bytes,
    span: tuple[int, int] = (0, 2**62),
    channels: Iterable[int] = (),
    compression: str = "zstd",
) -> bytes:
    """The index of a chunk without message indexes behind it."""
    listed = b"".join(struct.pack("<HQ", channel, 0) for channel in channels)
    body = struct.pack("<QQQQI", *span, offset, len(chunk), len(listed)) + listed + struct.pack("<Q", 0)
    stated, length = struct.unpack_from("<16xQ", chunk, 9)[0], len(chunk) - 9 - 32 - len(compression) - 8
    return record(8, body + _text(compression) + struct.pack("<QQ", length, stated))


def statistics_record(counts: Mapping[int, int], chunks: int) -> bytes:
    listed = b"".join(struct.pack("<HQ", *pair) for pair in counts.items())
    body = struct.pack("<QHIIII", sum(counts.values()), 1, len(counts), 0, 0, chunks)
    return record(11, body + struct.pack("<QQI", 0, 2**62, len(listed)) + listed)


def raw_file(*records: bytes, summary: bytes | None = None) -> bytes:
    """A file of these records behind its header; without a summary (None) it ends as one that was cut."""
    data = MAGIC + record(1, _text("ros2") + _text("hand")) + b"".join(records)
    if summary is None:
        return data
    data += record(15, bytes(4))
    return data + summary + record(2, struct.pack("<QQI", len(data) if summary else 0, 0, 0)) + MAGIC


def joint_state(t_ns: int, values: Sequence[float], names: Sequence[str] = ("a", "b")) -> bytes:
    """A JointState with a stamp, and values as positions."""
    empty = np.empty(0)
    return cdr(
        "sensor_msgs/msg/JointState", header=header(t_ns), name=list(names),
        position=np.array(values, dtype=np.float64), velocity=empty, effort=empty,
    )  # fmt: skip


def vector(t_ns: int, x: float, y: float, z: float = 0.0) -> bytes:
    """A Vector3Stamped."""
    inner = message("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
    return cdr("geometry_msgs/msg/Vector3Stamped", header=header(t_ns), vector=inner)
