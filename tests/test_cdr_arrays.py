# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Bags into arrays: to the last bit what decoding message by message gives, whatever the messages and the file."""

from __future__ import annotations

import math
import random
import struct
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_writer import COMPRESSIONS, Layout, Message, Topic, cdr, message, metadata_yaml, write, write_folder
from by_message import read_stream_by_message
from fuzz import damaged
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from uncertain_lti.base.errors import SignalError, UncertainLTIError
from uncertain_lti.recordings.bag import Bag
from uncertain_lti.recordings.message_types import Definition, define
from uncertain_lti.sampling.reading import Stream, read_stream
from uncertain_lti.signals import field_path
from uncertain_lti.signals.field_path import FUNCTIONS, FieldFunction, FieldPath, numeric_paths
from uncertain_lti.signals.signal_map import Signal, SignalMap

SECOND = 10**9
STEPS = "=" * 80
NUMBERS = {
    "bool": "?", "byte": "B", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i",
    "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
QUATERNION = [("x", "", None), ("y", "", None), ("z", "", None), ("w", "", None)]
NAMES = ["fan", "rotor", "läufer", "", "wheel\0s", "rotor\0"]
KINDS, SIZES = st.sampled_from(sorted(COMPRESSIONS)), st.sampled_from([1, 300, 3000, 1_000_000])
MOSTLY = dict.fromkeys(("chunked", "summary", "indexes"), st.sampled_from([True, True, True, False]))
LAYOUTS = st.builds(Layout, compression=KINDS, chunk_size=SIZES, checksums=st.booleans(), **MOSTLY)


# --- message types ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Field:
    """A field: array is None for one value, 0 for a sequence, n for n elements."""

    name: str
    kind: str
    array: int | None = None

    def text(self) -> str:
        suffix = "" if self.array is None else "[]" if self.array == 0 else f"[{self.array}]"
        return f"{self.kind}{suffix} {self.name}\n"


@dataclass(frozen=True)
class Type:
    """A message type with those it uses."""

    name: str
    fields: tuple[Field, ...]
    inner: tuple[Type, ...] = ()

    def every(self) -> list[Type]:
        found = {self.name: self}
        for part in self.inner:
            found |= {t.name: t for t in part.every()}
        return list(found.values())

    def schema(self) -> str:
        first, *rest = self.every()
        text = "".join(f.text() for f in first.fields)
        bodies = ((t.name.replace("/msg/", "/"), "".join(f.text() for f in t.fields)) for t in rest)
        return text + "".join(f"{STEPS}\nMSG: {name}\n{body}" for name, body in bodies)


TIME = Type("builtin_interfaces/msg/Time", (Field("sec", "int32"), Field("nanosec", "uint32")))
HEADER = Type("std_msgs/msg/Header", (Field("stamp", "builtin_interfaces/Time"), Field("frame_id", "string")), (TIME,))


@st.composite
def types(draw: st.DrawFn, depth: int = 2, name: str = "t/msg/T") -> Type:
    inner: list[Type] = []
    fields: list[Field] = []
    kinds = st.sampled_from([*NUMBERS, "string", "string", "float64", "float32"])
    arrays = st.sampled_from([None, None, None, 0, 0, 1, 2, 3])
    for i in range(draw(st.integers(0 if depth < 2 else 1, 6))):
        what = draw(st.integers(0, 9))
        if what == 0 and depth:
            part = draw(types(depth - 1, f"{name}{i}"))
            inner.append(part)
            fields.append(Field(f"f{i}", part.name.replace("/msg/", "/"), draw(arrays)))
        elif what == 1 and depth:
            kind = draw(st.sampled_from(["float64", "float64", "float32", "int64", "uint8"]))
            part = Type(f"{name}Q{i}", tuple(Field(c, kind) for c in draw(st.permutations("xyzw"))))
            inner.append(part)
            fields.append(Field(f"f{i}", part.name.replace("/msg/", "/"), draw(arrays)))
        elif what == 2 and "name" not in [f.name for f in fields]:
            fields.append(Field("name", "string", draw(st.sampled_from([0, 0, 0, 2]))))
            fields.append(Field(f"f{i}", draw(st.sampled_from(["float64", "float32", "int16"])), 0))
        else:
            fields.append(Field(f"f{i}", draw(kinds), draw(arrays)))
    if depth == 2 and draw(st.integers(0, 2)):
        at = draw(st.sampled_from([0, 0, len(fields)]))
        fields.insert(at, Field("header", "std_msgs/Header"))
        inner.append(HEADER)
    if not fields and depth == 2:
        fields.append(Field("f", "float64"))
    return Type(name, tuple(fields), tuple(inner))


class Maker:
    """Random messages of a type; `variety` is how many lengths strings and sequences have."""

    def __init__(self, top: Type, dice: random.Random, variety: int) -> None:
        self.top, self.dice = top, dice
        self.store = get_typestore(Stores.EMPTY)
        self.store.register(get_types_from_msg(top.schema(), top.name))
        self.types = {t.name.replace("/msg/", "/"): t for t in top.every()}
        self.lengths = [0, 1, 2, 3, 5, 8, 13, 70][:variety] if dice.random() < 0.5 else [dice.randrange(6)]
        self.letters = dice.choice(["a", "abc", "äöü€", "a\0ü"])
        self.names = dice.sample(NAMES, dice.randrange(1, len(NAMES)))
        if dice.random() < 0.15:
            self.names = [dice.choice(NAMES[:2]) for _ in range(3)]  # one of them twice

    def one(self, little: bool) -> bytes:
        value = self._message(self.top)
        return bytes(self.store.serialize_cdr(value, self.top.name, little_endian=little))

    def _message(self, kind: Type) -> Any:
        made = self.store.types[kind.name]
        if not kind.fields:
            return made()
        return made(*(self._field(f) for f in kind.fields))

    def _field(self, f: Field) -> Any:
        if f.array is None:
            return self._value(f.kind)
        count = f.array or self.dice.choice(self.lengths)
        if f.name == "name" and f.kind == "string":
            if self.dice.random() < 0.1:
                self.dice.shuffle(self.names)
            return (self.names * 3)[:count] if f.array else list(self.names)
        values = [self._value(f.kind) for _ in range(count)]
        if f.kind in NUMBERS:
            kind = {"?": "bool", "f": "f4", "d": "f8"}.get(NUMBERS[f.kind], NUMBERS[f.kind])
            if f.kind == "byte":
                kind = "u1"
            return np.array(values, dtype=kind)
        return values

    def _value(self, kind: str) -> Any:
        if kind == "string":
            return "".join(self.dice.choice(self.letters) for _ in range(self.dice.choice(self.lengths)))
        if kind in self.types:
            return self._message(self.types[kind])
        code = NUMBERS[kind]
        if kind == "byte":
            return self.dice.randrange(0, 100)
        if code == "?":
            return self.dice.random() < 0.5
        if code in "fd" and self.dice.random() < 0.8:
            value = self.dice.choice([0.0, -0.0, 1.0, self.dice.gauss(0, 1), self.dice.gauss(0, 1e3)])
            return struct.unpack(code, struct.pack(code, value))[0]
        return struct.unpack(code, self.dice.randbytes(struct.calcsize(code)))[0]


def paths(top: Type, definition: Definition, dice: random.Random) -> list[str]:
    """Some paths of a type that signals may have."""
    found: list[str] = []
    for path in numeric_paths(top.name, definition.fields):
        while "[" in path and (at := path.find("[")) >= 0:
            close = path.index("]")
            inside = str(dice.randrange(4)) if close == at + 1 else str(dice.randrange(int(path[at + 1 : close])))
            path = f"{path[:at]}({inside}){path[close + 1 :]}"
        found.append(path.replace("(", "[").replace(")", "]"))
    for path in list(found):
        stem, _, last = path.rpartition(".")
        if last in "xyzw" and stem:
            found += [f"{dice.choice(list(FUNCTIONS))}({stem})"]
        if path.endswith("]"):
            found += [f"norm({path[: path.rindex('[')]})", f'{path[: path.rindex("[")]}["{dice.choice(NAMES[:3])}"]']
    good = []
    for path in found:
        try:
            FieldPath(path).check("/t", top.name, definition.fields)
            good.append(path)
        except UncertainLTIError:
            pass
    return dice.sample(good, dice.randrange(1, min(len(good), 12) + 1)) if good else []


def signal_map(wanted: dict[str, Sequence[str]]) -> SignalMap:
    signals = [Signal(f"{topic}{i}", topic, path) for topic, some in wanted.items() for i, path in enumerate(some)]
    return SignalMap(tuple(signals))


# --- the property -------------------------------------------------------------------------------------------


def outcome(read: Any, bag: Bag, signals: SignalMap) -> tuple[Any, ...]:
    """Everything that a reading gives, comparable."""
    try:
        stream: Stream = read(bag, signals)
    except Exception as error:  # whatever one way raises, the other has to
        return type(error), str(error)
    arrays = [stream.topic, stream.arrival, stream.stamp, *stream.values]
    return [(a.dtype, a.shape, a.tobytes()) for a in arrays], bag.warnings


def assert_same(path: Path, signals: SignalMap) -> tuple[Any, ...]:
    by_message = outcome(read_stream_by_message, Bag(path), signals)
    for indexed in (True, False):
        assert outcome(read_stream, Bag(path, indexed=indexed), signals) == by_message
    return by_message


@settings(max_examples=60)
@given(
    tops=st.lists(types(), min_size=1, max_size=3),
    seed=st.integers(0, 2**32),
    count=st.sampled_from([1, 5, 40, 120]),
    layout=LAYOUTS,
    variety=st.integers(1, 8),
    little=st.sampled_from([True, True, False, None]),
    odd=st.sampled_from([0.0, 0.0, 0.05, 0.5]),
    parts=st.integers(1, 3),
    stretch=st.sampled_from([0, 3, 10**6]),
)
def test_the_same_as_message_by_message(tops, seed, count, layout, variety, little, odd, parts, stretch, tmp_path):
    dice = random.Random(seed)
    topics: list[Topic] = []
    wanted: dict[str, Sequence[str]] = {}
    makers: list[Maker] = []
    for i, top in enumerate(tops):
        definition = define(top.name, "ros2msg", top.schema().encode())
        assert not definition.reason
        topics.append(Topic(f"/t{i}", top.name, schema=top.schema()))
        makers.append(Maker(top, dice, variety))
        if some := paths(top, definition, dice):
            wanted[f"/t{i}"] = some
    if not wanted:
        return
    written = []
    for k in range(count):
        which = dice.randrange(len(tops))
        data = makers[which].one(dice.random() < 0.5 if little is None else little)
        if dice.random() < odd:
            data = damaged(dice, data)
        written.append(Message(f"/t{which}", k * stretch + dice.randrange(10), data))
    edges = sorted({0, len(written), *(dice.randrange(len(written) + 1) for _ in range(parts - 1))})
    names = [f"p_{i}.mcap" for i in range(len(edges) - 1)]
    files = {n: write(topics, written[a:b], layout) for n, a, b in zip(names, edges, edges[1:], strict=False)}
    folder = write_folder(Path(tempfile.mkdtemp(dir=tmp_path)), files, metadata_yaml(names))
    assert_same(folder, signal_map(wanted))


def test_bytes_behind_a_message_count_alike_whatever_is_wanted_of_it(tmp_path):
    """Room that rclpy leaves behind an empty sequence was counted once for fields that nobody wants, and together."""
    top = Type(
        "t/msg/T", (Field("a", "float64", 0), Field("b", "float64", 2), Field("c", "float64"), Field("d", "int64"))
    )
    sent = [Message("/t", k, b"\0\1\0\0" + bytes(40 + k)) for k in range(30)]
    path = write([Topic("/t", top.name, schema=top.schema())], sent, Layout()).save(tmp_path / "a.mcap")
    read = [assert_same(path, signal_map({"/t": wanted})) for wanted in (["b[0]"], ["c"], ["b[1]", "c", "d"])]
    assert len({str((*found[0][:3], found[1])) for found in read}) == 1


def test_a_function_added_to_the_table_is_read_and_offered(tmp_path, monkeypatch):
    """One entry in the table is all that a further function of a quaternion takes."""

    def terms(x, y, z, w):
        norm2 = x * x + y * y + z * z + w * w
        return (norm2 - 2.0 * (x * x + y * y), norm2), norm2

    tilt = FieldFunction(field_path.QUATERNION, terms, lambda up, norm2: math.acos(up / norm2), unit="rad")
    monkeypatch.setitem(FUNCTIONS, "tilt", tilt)
    turns = [0.0, 0.5, 1.0, -2.0]
    quaternions = [(math.sin(a / 2), 0.0, 0.0, math.cos(a / 2)) for a in turns] + [(0.0,) * 4]
    quaternions = [message("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", q, strict=True))) for q in quaternions]
    kind, place = "geometry_msgs/msg/Pose", message("geometry_msgs/msg/Point", x=1.0, y=2.0, z=3.0)
    data = (cdr(kind, position=place, orientation=q) for q in quaternions)
    sent = [Message("/pose", i * SECOND, one) for i, one in enumerate(data, 1)]
    path = write([Topic("/pose", kind)], sent).save(tmp_path / "a.mcap")

    signals = SignalMap((Signal("tilt", "/pose", "tilt(orientation)"), Signal("x", "/pose", "position.x")))
    assert_same(path, signals)
    np.testing.assert_allclose(read_stream(Bag(path), signals).values[0][:, 0], [*map(abs, turns), math.nan])
    (facts,) = Bag(path).facts()
    assert "tilt(orientation)" in facts.fields
    with pytest.raises(SignalError, match=r"wants a quaternion"):
        read_stream(Bag(path), SignalMap((Signal("tilt", "/pose", "tilt(position)"),)))
