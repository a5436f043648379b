# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Message definitions of a recording: from the schema in the file to decoded messages.

Each schema gets a type store of its own, so that one which cannot be parsed, or which contradicts another,
disturbs no other topic.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import zstandard
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.base import normalize_fieldname
from rosbags.typesys.store import Typestore

from uncertain_lti.base.errors import BagError, SignalError
from uncertain_lti.recordings.message_reader import CODES, ENCAPSULATIONS, Plan
from uncertain_lti.recordings.unreadable import one_line
from uncertain_lti.signals.field_path import FieldType, full_name

_LARGEST_SCHEMA = 1 << 20  # bytes
_LARGEST_PARSED = 1 << 18  # bytes without comments
_MOST_LINES = 8192  # without comments
_DEEPEST = 32  # messages in messages
_MOST_NUMBERS = 50_000  # fields of a message with those of the messages in it
_LARGEST_MESSAGE = 1 << 26  # bytes, decompressed
_LARGEST_RATIO = 10_000
_LEAST_INFLATED = 1 << 20
_NOTHING = "structure_needs_at_least_one_member"  # what the middleware puts into a message without fields: one byte
_ZSTD = b"\x28\xb5\x2f\xfd"
_LINE = re.compile(rb"^[ \t\r]*[^#\s]", re.MULTILINE)
_MOST_UNROLLED = 1024  # rosbags writes a line of code per element of a fixed array of strings or messages
_KINDS: Mapping[str, Any] = dict.fromkeys(CODES, "number") | {"bool": "bool", "string": "string", "byte": "other"}
# rclpy hands out a byte as bytes, so it is no number live either


@dataclass(frozen=True, eq=False)
class Definition:
    """How messages of one schema are decoded.

    `type_name`: as package/msg/Name; `types`: parsed definitions of the type and of all it uses; `store`: where they
    are registered; `reason`: why messages cannot be decoded; empty where they can; `note`: what the reader had to add.
    """

    type_name: str
    types: Mapping[str, Any]
    store: Typestore
    reason: str = ""
    note: str = ""

    def decode(self, data: bytes) -> Any:
        """Decode one CDR message.

        Text that is no UTF-8, has no closing zero or one before its end, or has not even the length of one, is read as
        the middleware does.
        """
        try:
            data = _plain(data)
        except Exception as error:  # a library raises whatever the bytes lead it to
            raise BagError(_one_line(error)) from None
        if why := self._plan.wrong(data):
            raise BagError(why)
        return _Decoder(self, data).message(self.type_name)

    @functools.cached_property
    def _plan(self) -> Plan:
        return Plan(self.type_name, (), self.fields)

    def from_ros1(self, data: bytes) -> bytes:
        """One message of a ROS 1 bag as ROS 2 has it (`rosbags`); of a definition that `ros2_text` made."""
        if self._endless:
            return b""
        self.store.max_sequence_length = max(1, len(data))
        try:
            return bytes(self.store.ros1_to_cdr(data, self.type_name))
        except Exception:  # the generated converters raise whatever the bytes lead them to
            return b""

    @functools.cached_property
    def _endless(self) -> bool:
        """Whether a few bytes can state any number of elements: sequences of messages that have no field."""

        def bytes_of(type_name: str) -> bool:
            for name, (node, what) in self.types[type_name][1]:
                if node == Nodetype.ARRAY:
                    node, what = what[0]
                if name != _NOTHING and (node != Nodetype.NAME or bytes_of(what)):
                    return True
            return False

        return any(
            node == Nodetype.SEQUENCE and what[0][0] == Nodetype.NAME and not bytes_of(what[0][1])
            for _, fields in self.types.values()
            for _, (node, what) in fields
        )

    @property
    def has_header(self) -> bool:
        """Whether messages have a stamp that is read, of a header or their own."""
        return self._plan.seconds >= 0

    def stamp_ns(self, data: bytes) -> int | None:
        """`header_stamp_ns` of an encoded message; None of one that cannot be decoded."""
        try:
            _, found = self._plan.read(_plain(data))
        except (zstandard.ZstdError, TypesysError):
            return None
        return found[0] if found is not None else None

    def fields(self, type_name: str) -> Mapping[str, FieldType]:
        """Fields of a type in this schema."""
        if type_name not in self.types:
            raise SignalError(f"{type_name}: not defined with {self.type_name}; check the type")
        return {
            normalize_fieldname(name): _field_type(description)
            for name, description in self.types[type_name][1]
            if name != _NOTHING or len(self.types[type_name][1]) > 1
        }


class _Decoder:
    """Reads a message that is whole, number by number."""

    def __init__(self, definition: Definition, data: bytes) -> None:
        self._definition, self._data, self._at = definition, data[4:], 0
        self._order: Literal["<", ">"] = "<" if data[1] else ">"

    def message(self, type_name: str) -> Any:
        values = [self._value(node, what) for _, (node, what) in self._definition.types[type_name][1]]
        return self._definition.store.get_msgdef(type_name).cls(*values)

    def _value(self, node: Any, what: Any) -> Any:
        if node == Nodetype.NAME:
            return self.message(what)
        if node == Nodetype.BASE:
            return self._text() if what[0] == "string" else self._numbers(what[0], 1)[0].item()
        (inner, inner_what), count = what
        if node == Nodetype.SEQUENCE:
            count = int(self._numbers("uint32", 1)[0])
        if inner == Nodetype.BASE and inner_what[0] != "string":
            return self._numbers(inner_what[0], count)
        return [self._value(inner, inner_what) for _ in range(count)]

    def _numbers(self, kind: str, count: int) -> Any:
        code = np.dtype(CODES[kind]).newbyteorder(self._order)
        if not count:
            return np.empty(0, code)
        self._at += -self._at % code.itemsize
        numbers = np.frombuffer(self._data, code, count, self._at)
        self._at += count * code.itemsize
        return numbers

    def _text(self) -> str:
        length = int(self._numbers("uint32", 1)[0])
        self._at += length
        return self._data[self._at - length : self._at].split(b"\0")[0].decode(errors="replace")


def _plain(data: bytes) -> bytes:
    """Bytes of a message that the recorder may have compressed on its own (rosbag2's compression mode MESSAGE)."""
    if data[:4] == _ZSTD:  # no CDR begins like this
        most = min(_LARGEST_MESSAGE, max(_LEAST_INFLATED, _LARGEST_RATIO * len(data)))
        data = zstandard.ZstdDecompressor().stream_reader(data).read(most)
    if data[:2] not in ENCAPSULATIONS:  # the decoder takes whatever it is for plain
        raise TypesysError(f"it is no plain CDR; it begins with {data[:2].hex() or 'nothing'}")
    return data


@functools.lru_cache(maxsize=1024)
def define(name: str, encoding: str, text: bytes) -> Definition:
    """Definition from a schema; its reason says what failed.

    Where the file holds no text, the definition of ROS 2 Jazzy is taken for a type that is part of it, and that of a
    sourced workspace for others; likewise Jazzy's for types that a text uses and does not define.
    """
    type_name = full_name(name)
    types: dict[str, Any] = {}
    store = get_typestore(Stores.EMPTY)
    reason = note = ""
    if not text.strip() and (found := _installed_text(type_name)):
        encoding, text = "ros2msg", found.encode()
        note = f"the file holds no definition of {type_name}; that of a sourced workspace is used"
    try:
        if len(text) > _LARGEST_SCHEMA:
            raise TypesysError(f"its definition is {len(text)} bytes long")
        if text.strip():
            types = _parse(type_name, encoding, _readable(encoding, text))
        elif type_name in _store().fielddefs:
            note = f"the file holds no definition of {type_name}; that of ROS 2 Jazzy is used"
        else:
            remedy = "source the workspace that has its package, or convert it to MCAP there (`ros2 bag convert`)"
            raise TypesysError(f"the file holds no definition of {type_name}, nor does ROS 2; {remedy}")
        used: dict[str, int] = {}
        _complete(type_name, types, (), used)
        _hold_bounds({name: types[name] for name in used})
        types = {name: types[name] for name in sorted(used)}
        store.register(types)
    except Exception as error:  # a schema may hold anything, and parsers raise whatever it leads them to
        types, note = {}, ""
        reason = _one_line(error)
        if text.strip():
            reason = f"its definition of {type_name} cannot be used: {reason}"
    return Definition(type_name, types, store, reason, note)


def jazzy_text(type_name: str) -> str:
    """Definition of a type of ROS 2 Jazzy and of all it uses, as in .msg files."""
    return distribution_text(type_name, "jazzy")[0]


def distribution_text(type_name: str, distribution: str) -> tuple[str, str]:
    """Definition of a type as a distribution of ROS 2 has it, for a recording that holds none."""
    name = distribution.upper() if f"ROS2_{distribution.upper()}" in Stores.__members__ else "JAZZY"
    store = _store(name)
    if type_name not in store.fielddefs:
        return _installed_text(type_name), "the workspaces that are sourced here"
    return str(store.generate_msgdef(type_name, ros_version=2)[0]), f"ROS 2 {name.capitalize()}"


def _installed_text(type_name: str) -> str:
    """Definition of a type, and of those it uses, as packages of sourced workspaces have them; else nothing."""
    roots = list(filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)))
    texts, wanted = dict[str, str](), [type_name]
    for name in wanted if roots else ():
        named = re.fullmatch(r"(\w{1,99})/msg/(\w{1,99})", name)
        if not named or name in texts or name in _store().fielddefs:
            continue
        paths = (Path(root, "share", named[1], "msg", f"{named[2]}.msg") for root in roots)
        with contextlib.suppress(OSError, TypesysError):
            if path := next(filter(Path.is_file, paths), None):
                texts[name] = _readable("ros2msg", path.read_bytes())
                used = re.findall(r"^(?:(\w+)/(?:msg/)?)?([A-Z]\w*)[\s[<]", texts[name], re.MULTILINE)
                wanted += [f"{where or named[1]}/msg/{what}" for where, what in used]
    parts = [texts.pop(type_name, ""), *(f"MSG: {name.replace('/msg/', '/')}\n{text}" for name, text in texts.items())]
    return f"{'=' * 80}\n".join(parts).strip()


def ros2_text(type_name: str, text: bytes) -> bytes:
    """A definition in a ROS 1 bag as ROS 2 has it: without constants, and without the number in a header."""
    try:
        if len(text) > _LARGEST_SCHEMA:
            return text
        types = _parse(type_name, "ros2msg", _readable("ros2msg", text))
        types.pop("std_msgs/msg/Header", None)
        used: dict[str, int] = {}
        _complete(type_name, types, (), used)
        store = get_typestore(Stores.EMPTY)
        store.register({name: ([], types[name][1]) for name in used})
        return str(store.generate_msgdef(type_name, ros_version=2)[0]).encode()
    except Exception:  # parsers raise whatever a text leads them to; `define` says what is wrong with it
        return text


def undefined(type_name: str, reason: str) -> Definition:
    """Definition of something that is not decoded, for the reason given."""
    return Definition(type_name, {}, get_typestore(Stores.EMPTY), reason)


@functools.cache
def _store(distribution: str = "JAZZY") -> Typestore:
    return get_typestore(Stores[f"ROS2_{distribution}"])


def _readable(encoding: str, text: bytes) -> str:
    """The text of a schema as the parser takes it.

    Editors leave a byte order mark and line ends of other systems, and comments in encodings of their own.
    """
    lines = re.split(r"\r\n|\r|\n", text.decode(errors="replace").replace("\ufeff", ""))
    if encoding == "ros2msg":
        lines = [line for line in lines if not line.lstrip().startswith("#")]
    lines = [line for line in lines if line.strip()]
    if len(lines) > _MOST_LINES or sum(map(len, lines)) > _LARGEST_PARSED:
        size = sum(map(len, lines))
        raise TypesysError(f"it has {len(lines)} lines and {size} letters without its comments, which is too long")
    return "\n".join(lines) + "\n"


def lines_of(text: bytes) -> int:
    """Count the lines of a schema that are neither empty nor a comment alone; they are what takes time to read."""
    return len(_LINE.findall(text))


def _parse(type_name: str, encoding: str, text: str) -> dict[str, Any]:
    if encoding == "ros2msg":
        return dict(get_types_from_msg(text, type_name))
    if encoding != "ros2idl":
        raise TypesysError(f"its schema is written in '{encoding}' (ros2msg and ros2idl are read)")
    text = re.sub(r"(?m)^[ \t]*#.*$", "", text)  # the parser does not know #include, and the parts follow anyway
    separator = "=" * 80 + "\n"
    if not text.startswith(f"{separator}IDL: "):
        return dict(get_types_from_idl(text))
    parts = (part.partition("\n")[2] for part in text.split(separator)[1:])
    return {name: of for part in parts for name, of in get_types_from_idl(part).items()}


def _complete(type_name: str, types: dict[str, Any], above: tuple[str, ...], done: dict[str, int]) -> int:
    """Add what is missing and is part of Jazzy, and refuse what the decoder cannot take; returns how many fields."""
    if type_name in above:
        raise TypesysError(f"{type_name} contains itself")
    if type_name in done:
        return done[type_name]
    if len(above) == _DEEPEST:
        raise TypesysError(f"it nests messages more than {_DEEPEST} deep")
    if type_name not in types:
        if type_name not in _store().fielddefs:
            raise TypesysError(f"{type_name} is used and not defined")
        types[type_name] = _store().fielddefs[type_name]
    constants, fields = types[type_name][:2]
    if not fields:
        fields = [(_NOTHING, (Nodetype.BASE, ("uint8", 0)))]
        types[type_name] = constants, fields
    number = 0
    for name, (node, what) in fields:
        if node == Nodetype.ARRAY and not what[1]:
            raise TypesysError(f"{type_name}.{name} is a fixed array of 0, which no message has")
        if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            node, what = what[0]
        if node == Nodetype.NAME:
            number += _complete(what, types, (*above, type_name), done)
        elif what[0] not in _KINDS:
            raise TypesysError(f"{type_name}.{name} is a {what[0]}, which the decoder does not know")
        number += 1
    if number > _MOST_NUMBERS:
        raise TypesysError(f"{type_name} has {number} fields with those of the messages in it, too many to decode")
    done[type_name] = number
    return number


def _hold_bounds(types: Mapping[str, Any]) -> None:
    """Refuse what would take the decoder very long to write down."""
    unrolled = 0
    for name, (_, fields) in types.items():
        for field, (node, what) in fields:
            if node == Nodetype.ARRAY and (what[0][0] == Nodetype.NAME or what[0][1][0] == "string"):
                unrolled += what[1]
                if unrolled > _MOST_UNROLLED:
                    raise TypesysError(f"{name}.{field} is a fixed array of {what[1]}, too long to decode")


def _field_type(description: Any) -> FieldType:
    node, what = description
    array = None
    if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        array = what[1] if node == Nodetype.ARRAY else 0
        node, what = what[0]
    return FieldType("message", what, array) if node == Nodetype.NAME else FieldType(_KINDS[what[0]], what[0], array)


def _one_line(error: Exception) -> str:
    lines = str(error).splitlines()
    if len(lines) > 3 and lines[0].startswith("Could not parse"):  # the text, the position, what is there
        return f"it cannot be parsed from '{lines[3].strip()[:40]}' on" if lines[3].strip() else "it cannot be parsed"
    return one_line(error)


@dataclass(frozen=True, eq=False)
class RecordedChannel:
    """A channel as the file describes it.

    `topic`: name of its topic; `encoding`: of its messages; `metadata`: what the recorder stored of it, such as QoS;
    `definition`: how its messages are decoded; `counted`: whether its messages are those of its topic (see
    `Bag` on topics with several types).
    """

    topic: str
    encoding: str
    metadata: Mapping[str, str]
    definition: Definition
    counted: bool = False


class RawMessage(NamedTuple):
    """One message as recorded: its log time, ns, its bytes, and what it was recorded on."""

    log_time_ns: int
    data: bytes
    channel: RecordedChannel

    @property
    def topic(self) -> str:
        """Topic it was published on."""
        return self.channel.topic
