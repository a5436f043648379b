# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Bag: every way a recording is written, split, cut or damaged gives a reading or one clear sentence."""

import contextlib
import os
import random
import shlex
import shutil
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from io import BufferedReader, BytesIO, FileIO
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from bag_writer import (
    COMPRESSIONS,
    JAZZY,
    File,
    Layout,
    Message,
    Topic,
    array,
    cdr,
    channel_record,
    chunk_record,
    float64,
    header,
    message,
    metadata_yaml,
    places,
    ramp,
    raw_file,
    schema_record,
    write,
    write_folder,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from processes import bounded
from refusals import refuses
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer

from uncertain_lti.base.errors import BagError
from uncertain_lti.recordings import mcap_scan
from uncertain_lti.recordings.bag import Bag
from uncertain_lti.recordings.formats import group_recordings
from uncertain_lti.recordings.message_reader import header_stamp_ns
from uncertain_lti.recordings.message_types import RawMessage
from uncertain_lti.signals.field_path import FieldPath, FieldType

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the real recordings (../shared/data) are not here")
SECOND = 10**9
TWO = (Topic("/a"), Topic("/b"))
KINDS, SIZES = st.sampled_from(sorted(COMPRESSIONS)), st.sampled_from([1, 200, 1000, 100_000])
FLAGS = dict.fromkeys(("chunked", "summary", "indexes", "checksums"), st.booleans())
LAYOUTS = st.builds(Layout, compression=KINDS, chunk_size=SIZES, **FLAGS)
# Few log times, so that ties and disorder are the rule; now and then one of today's or the largest.
TIMES = st.integers(0, 20) | st.sampled_from([1_700_000_000 * SECOND, 2**63 - 1])
MESSAGES = st.lists(st.tuples(st.sampled_from(["/a", "/b"]), TIMES), max_size=60).map(
    lambda entries: [Message(topic, t, float64(i), t) for i, (topic, t) in enumerate(entries)]
)


def facts(raw: RawMessage) -> tuple[str, int, bytes]:
    return raw.topic, raw.log_time_ns, raw.data


def in_order(messages: list[Message]) -> list[tuple[str, int, bytes]]:
    """What a reader has to give: by log time, ties in file order."""
    return [(m.topic, m.log_time, m.data) for m in sorted(messages, key=lambda m: m.log_time)]


def read_all(bag: Bag) -> list[tuple[str, int, bytes]]:
    return [facts(raw) for raw in bag.raw_messages()]


def read(file: File, folder: Path, name: str = "x.mcap") -> Bag:
    return Bag(file.save(folder / name))


def error_of(path: Path) -> str:
    """The one sentence that this path gives."""
    with pytest.raises(BagError) as caught:
        bag = Bag(path)
        list(bag.messages(bag.topics))
    text = str(caught.value)
    assert "\n" not in text and str(path)[:1000] in text
    return text


# --- whole files --------------------------------------------------------------------------------------------


@settings(max_examples=80)
@given(messages=MESSAGES, layout=LAYOUTS)
def test_any_file_reads_as_the_stable_sort_of_what_was_written(messages, layout, tmp_path):
    bag = read(write(TWO, messages, layout), tmp_path)
    assert read_all(bag) == in_order(messages)
    decoded = [(topic, t, float64(m.data)) for topic, t, m in bag.messages(bag.topics)]
    assert decoded == in_order(messages)
    only_a = [m for m in messages if m.topic == "/a"]
    if "/a" in bag.topics:
        assert [t for _, t, _ in bag.messages(["/a"])] == sorted(m.log_time for m in only_a)
        assert bag.topics["/a"].count == len(only_a)
        assert bag.topics["/a"].first == min((m.log_time for m in only_a), default=None)
        assert bag.topics["/a"].last == max((m.log_time for m in only_a), default=None)
    assert bag.warnings == []


@settings(max_examples=30)
@given(messages=MESSAGES, cuts=st.lists(st.integers(0, 60), max_size=3), layout=LAYOUTS)
def test_parts_read_as_one_in_the_order_of_metadata_yaml(messages, cuts, layout, tmp_path):
    edges = [0, *sorted(min(cut, len(messages)) for cut in cuts), len(messages)]
    names = [f"p_{i}.mcap" for i in range(len(edges) - 1)][::-1]
    folder = Path(tempfile.mkdtemp(dir=tmp_path))
    parts = {name: write(TWO, messages[a:b], layout) for name, a, b in zip(names, edges, edges[1:], strict=False)}
    bag = Bag(write_folder(folder, parts, metadata_yaml(names)))
    assert read_all(bag) == in_order(messages)
    assert [part.name for part in bag.parts] == names


def test_a_bag_is_read_lazily(tmp_path: Path) -> None:
    text = Topic("/a", "std_msgs/msg/UInt8MultiArray")
    data = array(np.frombuffer(random.Random(0).randbytes(1000), np.uint8), text.type)
    late_by_one = [i + 1 if i % 50 == 0 else i - 1 if i % 50 == 1 else i for i in range(4_000)]
    file = write([text], [Message("/a", t, data) for t in late_by_one], Layout(chunk_size=100_000))
    path = file.save(tmp_path / "x.mcap")
    del file
    bag, size = Bag(path), path.stat().st_size
    with bounded(seconds=60, memory=3_000_000):
        times = [t for _, t, _ in bag.messages(["/a"])]
    assert times == sorted(late_by_one) and size > 4_000_000


# --- cut files ----------------------------------------------------------------------------------------------


def count_by_mcap(data: bytes) -> int:
    """Messages that the mcap library reads of a cut file, record by record."""
    number = 0
    with contextlib.suppress(McapError, struct.error, zstandard.ZstdError, RuntimeError, UnicodeDecodeError):
        for record in StreamReader(BytesIO(data)).records:
            number += isinstance(record, McapMessage)
    return number


@settings(max_examples=100)
@given(messages=MESSAGES, layout=LAYOUTS, where=st.floats(0, 1, exclude_max=True))
def test_a_cut_file_reads_as_a_prefix(messages: list[Message], layout: Layout, where: float, tmp_path: Path) -> None:
    file = write(TWO, messages, layout)
    cut = int(where * len(file.data))
    path = file.save(tmp_path / "x.mcap", cut)
    try:
        bag = Bag(path)
    except BagError as error:
        assert count_by_mcap(file.data[:cut]) == 0 and "\n" not in str(error)
        return
    got = read_all(bag)
    assert got == in_order(messages[: len(got)])
    assert count_by_mcap(file.data[:cut]) <= len(got)
    number = f"{len(got)} message" + "s" * (len(got) != 1)
    assert any("no footer" in warning and number in warning for warning in bag.warnings)


def test_a_file_that_grows_while_it_is_read_is_read_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As of a recorder at work, whose file ends with a chunk each time."""
    file = write(TWO, ramp("/a", range(100)), Layout(chunk_size=500, indexes=False))
    whole, cut = file.save(tmp_path / "whole.mcap"), tmp_path / "cut.mcap"

    class Grows(BufferedReader):
        def seek(self, offset: int, whence: int = 0) -> int:
            return super().seek(offset - (len(file.data) - size if whence else 0), whence)

    def opened(path: Path, *_: object, **__: object) -> BufferedReader:
        return (Grows if path == whole else BufferedReader)(FileIO(path))

    monkeypatch.setattr(mcap_scan, "open", opened, raising=False)
    ends = [place.end for place in places(file.data) if place.opcode == Opcode.CHUNK]
    for size in [end + more for end in ends for more in (0, 1, 8, 9, 10)]:
        expected = mcap_scan.scan(file.save(cut, size))
        assert (found := mcap_scan.scan(whole)).count == expected.count
        assert found.warnings == [warning.replace("cut.mcap", "whole.mcap") for warning in expected.warnings]


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_the_chunk_that_a_cut_goes_through_is_read_as_far_as_it_goes(compression: str, tmp_path: Path) -> None:
    file = chunked(compression, 15_000, 10**9)
    ((begin, end),) = chunks(file.data)
    cut = (begin + end) // 2
    assert count_by_mcap(file.data[:cut]) <= 1
    bag = Bag(file.save(tmp_path / "x.mcap", cut))
    got = read_all(bag)
    assert 5_000 < len(got) < 10_000 and got == in_order(file.messages[: len(got)])
    number = f"{len(got):,}".replace(",", " ")
    assert bag.warnings == [f"{tmp_path / 'x.mcap'}: cut after {number} messages (no footer); read up to the cut"]


def test_a_file_cut_after_its_data_is_complete(tmp_path: Path) -> None:
    file = write(TWO, ramp("/a", range(100)))
    end = next(place for place in places(file.data) if place.opcode == Opcode.DATA_END).end
    bag = Bag(file.save(tmp_path / "x.mcap", end + 3))
    assert read_all(bag) == in_order(file.messages)
    assert bag.warnings == [f"{tmp_path / 'x.mcap'}: no footer at its end; all its 100 messages could be read"]


def test_zeros_after_a_power_cut_end_the_reading(tmp_path: Path) -> None:
    file = write(TWO, ramp("/a", range(1000)), Layout(chunk_size=500, indexes=False))
    cut = len(file.data) // 2
    path = tmp_path / "x.mcap"
    path.write_bytes(file.data[:cut] + bytes(1_000_000))
    bag = Bag(path)
    got = read_all(bag)
    assert 300 < len(got) < 700
    assert bag.warnings and any("left out" in warning for warning in bag.warnings)


# --- damaged files ------------------------------------------------------------------------------------------


def chunked(compression: str = "zstd", number: int = 1000, size: int = 3000, **options: bool) -> File:
    noise = random.Random(2)
    messages = [Message("/a", i * SECOND, float64(noise.random())) for i in range(number)]
    return write([Topic("/a")], messages, Layout(compression, chunk_size=size, **options))


def chunks(data: bytes) -> list[tuple[int, int]]:
    return [(place.begin, place.end) for place in places(data) if place.opcode == Opcode.CHUNK]


def patched(file: File, at: int, patch: bytes) -> File:
    return File(file.data[:at] + patch + file.data[at + len(patch) :], file.messages)


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_a_flipped_bit_in_a_chunk_costs_that_chunk_alone(compression: str, tmp_path: Path) -> None:
    file = chunked(compression)
    begin, end = chunks(file.data)[3]
    first, last = struct.unpack_from("<QQ", file.data, begin + 9)
    for at in random.Random(3).sample(range(begin + 60, end), 20):
        bag = read(patched(file, at, bytes([file.data[at] ^ 4])), tmp_path)
        assert read_all(bag) == in_order([m for m in file.messages if not first <= m.log_time <= last])
        warning = bag.warnings[0]
        assert f"chunk at byte {begin} (log time {first // SECOND}.000 to {last // SECOND}.000 s)" in warning
        assert "left out" in warning


def test_a_flipped_bit_outside_chunks_is_told(tmp_path: Path) -> None:
    file = write([Topic("/a")], ramp("/a", range(100)), Layout(chunked=False))
    last = [place for place in places(file.data) if place.opcode == Opcode.MESSAGE][-1]
    bag = read(patched(file, last.end - 1, b"\x41"), tmp_path)
    assert len(read_all(bag)) == 100
    assert any("checksum of the file is wrong" in warning for warning in bag.warnings)


@pytest.mark.parametrize("length", [2**64 - 1, 1 << 33, 5, 0, 4000])
def test_a_record_that_lies_about_its_length_costs_one_chunk(length: int, tmp_path: Path) -> None:
    file = chunked()
    begin, end = chunks(file.data)[3]
    assert length != end - begin - 9
    first, last = struct.unpack_from("<QQ", file.data, begin + 9)
    with bounded(seconds=5, memory=8_000_000):
        bag = read(patched(file, begin + 1, struct.pack("<Q", length)), tmp_path)
        got = read_all(bag)
    assert got == in_order([m for m in file.messages if not first <= m.log_time <= last])
    assert bag.warnings


@pytest.mark.parametrize("size", [2**64 - 1, 1 << 29, 10_000_000, 100, 0])
@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_a_chunk_that_lies_about_its_decompressed_size_is_left_out(compression: str, size: int, tmp_path: Path) -> None:
    file = chunked(compression)
    begin, _ = chunks(file.data)[0]
    with bounded(seconds=5, memory=40_000_000):
        bag = read(patched(file, begin + 9 + 16, struct.pack("<Q", size)), tmp_path)
        got = read_all(bag)
    assert 0 < len(got) < len(file.messages) and set(got) < set(in_order(file.messages))
    assert f"chunk at byte {begin}" in bag.warnings[0]


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
@pytest.mark.parametrize("stated", [1000, 1 << 60])
@pytest.mark.parametrize("whole", [True, False])
def test_a_bomb_is_not_blown_up(compression: str, stated: int, whole: bool, tmp_path: Path) -> None:
    zeros = bytes(1 << 26)
    packed = lz4.frame.compress(zeros) if compression == "lz4" else zstandard.compress(zeros)
    packed = packed * (4 if compression == "zstd" else 1)
    name = compression.encode()
    chunk = struct.pack("<QQQII", 0, 1, stated, 0, len(name)) + name + struct.pack("<Q", len(packed)) + packed
    file = chunked()
    at = chunks(file.data)[1][0]
    data = file.data[:at] + struct.pack("<BQ", Opcode.CHUNK, len(chunk)) + chunk
    if whole:
        data += file.data[at:]
    path = tmp_path / "x.mcap"
    path.write_bytes(data)
    # Where a cut goes through a chunk, its checksum tells nothing, and it is read up to the limit.
    limit = 12_000_000 if whole or stated == 1000 else 3 * len(zeros)
    with bounded(seconds=20, memory=limit):
        bag = Bag(path)
        got = read_all(bag)
    assert got and bag.warnings
    assert got == in_order(file.messages[: len(got)]) if not whole else set(got) <= set(in_order(file.messages))


def test_strings_and_arrays_that_lie_about_their_length(tmp_path: Path) -> None:
    number = struct.pack("<I", 2**32 - 1)
    text = b"\x00\x01\x00\x00" + number + b"abc\x00"
    array = b"\x00\x01\x00\x00" + bytes(8) + number + bytes(16)
    topics = [Topic("/text", "std_msgs/msg/String"), Topic("/array", "std_msgs/msg/Float64MultiArray")]
    file = write(topics, [Message("/text", 1, text), Message("/array", 2, array)])
    with bounded(seconds=5, memory=8_000_000):
        bag = read(file, tmp_path)
        assert list(bag.messages(bag.topics)) == []
    assert len([warning for warning in bag.warnings if "1 message left out that cannot be decoded" in warning]) == 2


def test_an_unknown_compression_is_named(tmp_path: Path) -> None:
    file = write([Topic("/a")], ramp("/a", range(3)), Layout("zstd"))
    at = file.data.index(b"zstd", chunks(file.data)[0][0])
    assert "compression 'brot'" in error_of(patched(file, at, b"brot").save(tmp_path / "x.mcap"))


def test_a_damaged_summary_is_read_without(tmp_path: Path) -> None:
    file = chunked()
    summary = next(place for place in places(file.data) if place.opcode == Opcode.DATA_END).end
    bag = read(patched(file, summary + 20, bytes([file.data[summary + 20] ^ 1])), tmp_path)
    assert read_all(bag) == in_order(file.messages)
    assert bag.warnings == [f"{tmp_path / 'x.mcap'}: the checksum of its summary is wrong; read without it"]


@pytest.mark.parametrize("summary", [True, False])
def test_a_second_file_that_was_joined_to_the_first_is_told(summary: bool, tmp_path: Path) -> None:
    """It was left out without a word: a fault in it gave `no alarm`."""
    first, second = (
        write([Topic("/a")], ramp("/a", times), Layout(summary=summary)) for times in (range(9), range(9, 20))
    )
    bag = Bag(File(first.data + second.data).save(tmp_path / "x.mcap"))
    assert len(list(bag.raw_messages())) == 9
    assert f"{len(second.data):,} bytes behind its end".replace(",", " ") in bag.warnings[-1]


def test_channels_of_a_damaged_chunk_are_found_in_the_summary(tmp_path: Path) -> None:
    """The channel stands in the first chunk only; without a summary the others belong to no topic."""
    file = chunked()
    begin, end = chunks(file.data)[0]
    bag = read(patched(file, end - 100, bytes(50)), tmp_path)
    assert 0 < bag.topics["/a"].count < 1000
    file = chunked("none", summary=False, indexes=False)
    begin, end = chunks(file.data)[0]
    assert "its checksum is wrong" in error_of(patched(file, end - 100, bytes(50)).save(tmp_path / "y.mcap"))


# --- types --------------------------------------------------------------------------------------------------

GOOD = Topic("/good")


def with_good(topics: list[Topic], messages: list[Message], folder: Path) -> Bag:
    """A bag that also has one good topic; checks that the others do not disturb it."""
    bag = read(write([GOOD, *topics], [*ramp("/good", range(5)), *messages]), folder)
    assert [m.data for _, _, m in bag.messages(["/good"])] == [0, 1, 2, 3, 4]
    return bag


BAD_SCHEMAS = {
    "service": (Topic("/bad", "x/srv/Y_Event", schema="int64 a\n---\nint64 b\n"), "from '---' on"),
    "no IDL": (Topic("/bad", "x/msg/Y", schema="float64 y\n", schema_encoding="ros2idl"), "used: it cannot be parsed"),
    "garbage": (Topic("/bad", "x/msg/Y", schema="\x01 what is this?"), "cannot be used"),
    "not utf-8": (Topic("/bad", "x/msg/Y", schema="float64 \udcff"), "cannot be used"),
    "missing inside": (Topic("/bad", "x/msg/Y", schema="x/Z z\n"), "x/msg/Z is used and not defined"),
    "empty, not in Jazzy": (Topic("/bad", "x/msg/Y", schema=""), "source the workspace that has its package"),
    "itself": (Topic("/bad", "x/msg/Y", schema="x/Y y\n"), "contains itself"),
    "wide string": (Topic("/bad", "x/msg/Y", schema="wstring y\n"), "cannot be used"),
    "huge array": (Topic("/bad", "x/msg/Y", schema="string[100000000] y\n"), "too long to decode"),
    "no name": (Topic("/bad", "x/msg/Y", schema_name="", schema="float64 y\n"), "does not say what type"),
    "protobuf": (Topic("/bad", "x/msg/Y", schema="float64 y\n", schema_encoding="protobuf"), "written in 'protobuf'"),
    "no schema": (Topic("/bad", "x/msg/Y", schema_encoding=""), "does not say what type"),
    "json": (Topic("/bad", encoding="json"), "in json, and cdr is what can be decoded: write its numbers into"),
    "ros1": (Topic("/bad", encoding="ros1"), "in ros1, and cdr is what can be decoded: take the .bag"),
}


@pytest.mark.parametrize("case", BAD_SCHEMAS)
def test_a_topic_that_cannot_be_decoded_disturbs_no_other(case: str, tmp_path: Path) -> None:
    topic, reason = BAD_SCHEMAS[case]
    schema = topic.schema
    if schema and "\udcff" in schema:  # bytes that are no text
        topics = [GOOD, Topic("/bad", "x/msg/Y", schema="float64 ????")]
        file = write(topics, ramp("/good", range(5)), Layout(chunked=False))
        bag = read(File(file.data.replace(b"????", b"\xff\xfe\xfd\xfc")), tmp_path)
    else:
        bag = with_good([topic], [Message("/bad", 7, float64(7))], tmp_path)
        assert bag.topics["/bad"].count == 1
        assert [raw.data for raw in bag.raw_messages(["/bad"])] == [float64(7)]
    info = bag.topics["/bad"]
    assert not info.readable and reason in info.reason and "''" not in info.reason and bag.topics["/good"].readable
    assert reason in refuses(BagError, "topic /bad cannot be decoded", bag.messages, ["/good", "/bad"])
    assert {item.info.topic for item in bag.facts()} == {"/good", "/bad"}


def test_a_chunk_that_is_too_large_is_told_how_to_make_smaller(tmp_path: Path) -> None:
    chunk = chunk_record(channel_record(1, GOOD, 0), stated=300 << 20)
    (tmp_path / "a.mcap").write_bytes(raw_file(schema_record(1, GOOD), chunk, summary=b""))
    text = error_of(tmp_path / "a.mcap")
    assert "at most 256 MiB are taken: write smaller ones with `mcap compress a.mcap -o" in text
    assert "record or copy it again" not in text


def test_a_topic_that_is_not_there(tmp_path: Path) -> None:
    bag = with_good([Topic("/other")], [], tmp_path)
    for read in (bag.messages, bag.raw_messages):
        refuses(BagError, r"there is no topic /nix; topics there: /good, /other", read, ["/nix"])


def test_schema_names_with_and_without_msg(tmp_path: Path) -> None:
    schema = f"float64 y\nZ z\n{'=' * 80}\nMSG: x/Z\nint32 i\n"
    topic = Topic("/short", "x/msg/Y", schema_name="x/Y", schema=schema)
    bag = with_good([topic], [Message("/short", 1, float64(2.5) + struct.pack("<i", 4))], tmp_path)
    assert bag.topics["/short"].type == "x/msg/Y"
    ((_, _, decoded),) = bag.messages(["/short"])
    assert (decoded.y, decoded.z.i) == (2.5, 4)
    fields = bag.type_fields("/short")
    assert fields("x/msg/Y") == {"y": FieldType("number", "float64"), "z": FieldType("message", "x/msg/Z")}


IDL = """\
================================================================================
IDL: x/msg/Y
// generated from rosidl_adapter/resource/msg.idl.em
// generated code does not contain a copyright notice

#include "x/msg/Z.idl"

module x {
  module msg {
    typedef double double__3[3];
    @verbatim (language="comment", text=
      "Two lines" "\\n"
      "of comment")
    struct Y {
      @verbatim (language="comment", text= "# A field")
      @default (value=1.5)
      @unit (value="m")
      double y;
      double__3 v;
      sequence<float> w;
      x::msg::Z z;
    };
  };
};
================================================================================
IDL: x/msg/Z
module x { module msg { struct Z { int32 i; boolean b; string s; octet o; }; }; };
"""


def test_idl_definitions(tmp_path: Path) -> None:
    topic = Topic("/idl", "x/msg/Y", schema=IDL, schema_encoding="ros2idl")
    bag = with_good([topic], [], tmp_path)
    assert bag.topics["/idl"].readable, bag.topics["/idl"].reason
    fields = bag.type_fields("/idl")
    assert fields("x/msg/Y") == {
        "y": FieldType("number", "float64"),
        "v": FieldType("number", "float64", 3),
        "w": FieldType("number", "float32", 0),
        "z": FieldType("message", "x/msg/Z"),
    }
    kinds = {name: field.kind for name, field in fields("x/msg/Z").items()}
    assert kinds == {"i": "number", "b": "bool", "s": "string", "o": "other"}
    payload = b"\x00\x01\x00\x00" + struct.pack("<4dIff", 1, 2, 3, 4, 2, 5, 6) + struct.pack("<i?", 7, True)
    payload += b"\0\0\0" + struct.pack("<I", 2) + b"s\0" + b"\x09"
    bag = with_good([topic], [Message("/idl", 1, payload)], tmp_path)
    ((_, _, decoded),) = bag.messages(["/idl"])
    assert (decoded.y, list(decoded.v), list(decoded.w), decoded.z.i, decoded.z.s) == (1, [2, 3, 4], [5, 6], 7, "s")


def test_a_definition_that_is_not_in_the_file_is_taken_from_jazzy(tmp_path: Path) -> None:
    twist = cdr("geometry_msgs/msg/Vector3", x=1.0, y=2.0, z=3.0)
    bag = with_good([Topic("/v", "geometry_msgs/msg/Vector3", schema="")], [Message("/v", 1, twist)], tmp_path)
    assert [m.z for _, _, m in bag.messages(["/v"])] == [3.0]
    assert any("/v: the file holds no definition of geometry_msgs/msg/Vector3" in warning for warning in bag.warnings)


def test_types_of_one_name_and_two_meanings_do_not_mix(tmp_path: Path) -> None:
    topics = [Topic("/f", "x/msg/Y", schema="float64 y\n"), Topic("/i", "x/msg/Y", schema="int64 y\nint64 more\n")]
    messages = [Message("/f", 1, float64(2.5)), Message("/i", 2, b"\0\1\0\0" + struct.pack("<qq", 3, 4))]
    bag = with_good(topics, messages, tmp_path)
    assert [m.y for _, _, m in bag.messages(["/f", "/i"])] == [2.5, 3]
    assert set(bag.type_fields("/f")("x/msg/Y")) == {"y"}
    assert set(bag.type_fields("/i")("x/msg/Y")) == {"y", "more"}


def test_two_channels_of_one_type_are_one_topic(tmp_path: Path) -> None:
    messages = [Message("/a", i, float64(i), channel=i % 2) for i in range(10)]
    bag = read(write([Topic("/a"), Topic("/a")], messages), tmp_path)
    assert [m.data for _, _, m in bag.messages(["/a"])] == list(range(10))
    assert bag.topics["/a"].count == 10 and bag.warnings == []


def test_of_two_types_on_a_topic_the_frequent_one_counts(tmp_path: Path) -> None:
    messages = [Message("/a", i, float64(i)) for i in range(6)]
    messages += [Message("/a", 10 + i, b"\0\1\0\0" + struct.pack("<i", i), channel=1) for i in range(4)]
    bag = read(write([Topic("/a"), Topic("/a", "std_msgs/msg/Int32")], messages), tmp_path)
    info = bag.topics["/a"]
    assert (info.type, info.count, info.readable, info.last) == ("std_msgs/msg/Float64", 6, True, 5)
    assert "4 messages of std_msgs/msg/Int32" in info.reason and any(info.reason in text for text in bag.warnings)
    assert [m.data for _, _, m in bag.messages(["/a"])] == list(range(6))
    assert len(list(bag.raw_messages(["/a"]))) == 10


def test_messages_that_do_not_fit_their_definition_are_left_out_and_counted(tmp_path: Path) -> None:
    broken = [b"", b"\0\1\0\0", b"\0\1\0\0\1\2\3", b"\0\7\0\0" + bytes(8), float64(1) + bytes(20)]
    messages = [*ramp("/a", range(5)), *(Message("/a", 10 + i, data) for i, data in enumerate(broken))]
    bag = read(write([Topic("/a")], [*messages, Message("/a", 20, float64(9))]), tmp_path)
    for _ in range(2):  # and told once, however often the bag is read
        assert [m.data for _, _, m in bag.messages(["/a"])] == [0, 1, 2, 3, 4, 9]
        (warning,) = bag.warnings
        assert warning.startswith(f"{tmp_path / 'x.mcap'}: /a: 5 messages left out that cannot be decoded (")


def test_messages_that_rosbag2_compressed_one_by_one(tmp_path: Path) -> None:
    writer = Rosbag2Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    point = message("geometry_msgs/msg/Point", x=1.0, y=2.0, z=3.0)
    stamped = message("geometry_msgs/msg/PointStamped", header=header(5), point=point)
    with writer:
        connection = writer.add_connection("/p", "geometry_msgs/msg/PointStamped", typestore=JAZZY)
        for i in range(10):
            writer.write(connection, i, JAZZY.serialize_cdr(stamped, "geometry_msgs/msg/PointStamped"))
    bag = Bag(tmp_path / "bag")
    assert [m.point.y for _, _, m in bag.messages(["/p"])] == [2.0] * 10
    assert bag.facts()[0].stamps == "usable"


# --- what is no recording -----------------------------------------------------------------------------------


def test_what_a_file_is_instead(tmp_path: Path) -> None:
    def saved(name: str, data: bytes) -> Path:
        (tmp_path / name).write_bytes(data)
        return tmp_path / name

    pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"
    assert "git lfs pull" in error_of(saved("lfs.mcap", pointer))
    assert "is empty" in error_of(saved("empty.mcap", b""))
    assert "cut after 5 bytes" in error_of(saved("short.mcap", b"\x89MCAP"))
    assert "a text file" in error_of(saved("notes.md", b"hello\nworld\n"))
    assert "zeros only" in error_of(saved("zeros.mcap", bytes(5000)))
    assert "no kind of file that is known" in error_of(saved("noise.mcap", random.Random(5).randbytes(5000)))
    assert "another version" in error_of(saved("new.mcap", b"\x89MCAP1\r\n" + bytes(100)))
    assert "unpack it" in error_of(saved("bag.tar.gz", b"\x1f\x8b" + bytes(100)))


def test_a_file_that_is_missing_names_those_beside_it(tmp_path: Path) -> None:
    assert "there is no such file or folder; check the path" in error_of(tmp_path / "nix.mcap")
    write(TWO, []).save(tmp_path / "there.mcap")
    assert "there are there.mcap" in error_of(tmp_path / "nix.mcap")
    (tmp_path / "run_1").mkdir()
    (tmp_path / "run_1/metadata.yaml").touch()  # of rosbag2 a recording is a folder
    assert "there are run_1, there.mcap" in error_of(tmp_path / "nix.mcap")
    (tmp_path / "live.mcap.part").touch()
    assert f"or was killed: read {tmp_path / 'live.mcap.part'}" in error_of(tmp_path / "live.mcap")
    for quoted in (tmp_path / "*.mcap", Path("~/nix.mcap")):
        assert "a shell replaces ~ and * only where they are not in quotes" in error_of(quoted)
    assert "neither a file nor a folder" in error_of(Path("/dev/zero"))
    os.symlink(tmp_path / "nowhere", tmp_path / "link.mcap")
    assert "there is no such file or folder; it is a link to" in error_of(tmp_path / "link.mcap")
    assert "File name too long" in error_of(tmp_path / ("x" * 300))


@contextlib.contextmanager
def as_somebody() -> Iterator[None]:
    """Without the rights of root, whom no permission stops."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


def test_a_file_or_folder_without_permission() -> None:
    folder = Path(tempfile.mkdtemp(dir="/tmp"))
    try:
        folder.chmod(0o755)
        locked = write(TWO, ramp("/a", range(3))).save(folder / "locked" / "x.mcap")
        alone = write(TWO, ramp("/a", range(3))).save(folder / "alone.mcap")
        alone.chmod(0)
        locked.parent.chmod(0)
        with as_somebody():
            for path in (alone, locked, locked.parent):
                assert "no permission" in error_of(path)
    finally:
        (folder / "locked").chmod(0o755)
        shutil.rmtree(folder)


def advised(text: str) -> list[str]:
    """The command that a sentence gives in backquotes, run by this interpreter's environment."""
    command = shlex.split(text.split("`")[1])
    beside = Path(sys.executable).parent / command[0]
    return [str(beside) if beside.exists() else command[0], *command[1:]]


@pytest.mark.skipif(shutil.which("zstd") is None, reason="the zstd command is not installed")
@pytest.mark.parametrize("name", ["x.mcap.zstd", "x.mcap.zst", "x.mcap"])
def test_the_advice_for_a_file_compressed_as_a_whole(name: str, tmp_path: Path) -> None:
    file = write([Topic("/a")], ramp("/a", range(3)))
    (tmp_path / "in").mkdir()
    path = tmp_path / "in" / name
    path.write_bytes(zstandard.compress(file.data))
    command = advised(error_of(path))
    assert subprocess.run(command, cwd=tmp_path, capture_output=True, check=False).returncode == 0
    assert read_all(Bag(tmp_path / command[-1])) == in_order(file.messages)
    if name != "x.mcap":
        assert "zstd -d" in error_of(path.parent)
        (path.parent / "metadata.yaml").write_text(metadata_yaml([name]))
        assert "zstd -d" in error_of(path.parent)


# --- folders and groups -------------------------------------------------------------------------------------


def part(begin: float, end: float, step: float = 0.1, topic: str = "/a", kind: str = "std_msgs/msg/Float64") -> File:
    times = [round((begin + i * step) * SECOND) for i in range(round((end - begin) / step) + 1)]
    return write([Topic(topic, kind)], ramp(topic, times))


def test_a_folder_without_metadata_is_one_split_bag_or_an_error(tmp_path: Path) -> None:
    parts = {f"s_{i}.mcap": part(10 * i, 10 * i + 9.9) for i in (8, 9, 10, 11)}
    bag = Bag(write_folder(tmp_path / "split", parts))
    assert [p.name for p in bag.parts] == ["s_8.mcap", "s_9.mcap", "s_10.mcap", "s_11.mcap"]
    assert bag.topics["/a"].count == 400 and bag.warnings == []
    runs = {f"r_{i}.mcap": part(100 * i, 100 * i + 9.9) for i in (0, 1)}
    assert "r_0.mcap, r_1.mcap" in error_of(write_folder(tmp_path / "runs", runs))
    mixed = {"a_0.mcap": part(0, 1), "b_0.mcap": part(0, 1)}
    folder = write_folder(tmp_path / "my bags", mixed)
    assert f"name them, '{folder}'/*.mcap: a_0.mcap, b_0.mcap" in error_of(folder)
    (tmp_path / "bare").mkdir()
    assert "there is no .mcap, .db3 or .bag file in it" in error_of(tmp_path / "bare")
    assert "name the folders in it: my bags, runs, split" in error_of(tmp_path)


def test_metadata_yaml_decides(tmp_path: Path) -> None:
    parts = {"late.mcap": part(10, 19), "early.mcap": part(0, 9), "other.mcap": part(50, 51)}
    folder = write_folder(tmp_path / "bag", parts, metadata_yaml(["early.mcap", "bag/late.mcap", "gone.mcap"]))
    bag = Bag(folder)
    assert [p.name for p in bag.parts] == ["early.mcap", "late.mcap"]
    assert sorted(bag.warnings) == [
        f"{folder / 'gone.mcap'}: metadata.yaml lists this part, and it is not there",
        f"{folder / 'other.mcap'}: metadata.yaml does not list this file; it is left out",
    ]
    (folder / "metadata.yaml").write_text(metadata_yaml(["gone.mcap"]))
    assert "lists gone.mcap, and none of them is there" in error_of(folder)
    assert error_of(folder).endswith("or name one of those that are there: early.mcap, late.mcap, other.mcap")
    renamed = write_folder(tmp_path / "renamed", {"mine.mcap": part(0, 9)}, metadata_yaml(["rosbag2_2026_0.mcap"]))
    assert len(read_all(Bag(renamed))) == 91 and "mine.mcap is read, which is there instead" in Bag(renamed).warnings[0]
    for text in ("", "]", "x: [", "rosbag2_bagfile_information: 3", "\0", metadata_yaml([])):
        alone = write_folder(tmp_path / "alone", {"x.mcap": part(0, 9)}, text)
        assert len(read_all(Bag(alone))) == 91 and "metadata.yaml cannot be used" in Bag(alone).warnings[0]
    (alone / "metadata.yaml").write_text(metadata_yaml(["x.mcap"], storage="''"))
    assert len(read_all(Bag(alone))) == 91
    (alone / "metadata.yaml").write_text(metadata_yaml(["x.mcap"], storage="my_plugin"))
    assert "'my_plugin'" in error_of(alone)


def test_the_part_that_was_open_when_the_power_went(tmp_path: Path) -> None:
    parts = {"s_0.mcap": part(0, 9), "s_1.mcap": part(9.1, 19), "s_2.mcap": File(b"")}
    folder = write_folder(tmp_path / "bag", parts)
    bag = Bag(folder)
    assert bag.topics["/a"].count == 91 + 100
    assert bag.warnings == [f"{folder / 's_2.mcap'}: the file is empty; it is left out"]
    nothing = write_folder(tmp_path / "nothing", {"s_0.mcap": File(b""), "s_1.mcap": File(b"")})
    assert "no message can be read" in error_of(nothing)


def names(bags: list[Bag]) -> list[list[str]]:
    return [[p.name for p in bag.parts] for bag in bags]


def test_parts_of_one_split_bag_are_one_recording(tmp_path: Path) -> None:
    for i in range(12):
        part(10 * i, 10 * i + 9.9).save(tmp_path / f"s_{i}.mcap")
    shell_order = sorted(tmp_path.glob("s_*.mcap"))
    (bag,) = group_recordings(shell_order)
    assert [p.name for p in bag.parts] == [f"s_{i}.mcap" for i in range(12)]
    assert [t for _, t, _ in bag.messages(["/a"])] == [i * SECOND // 10 for i in range(1200)]


APART = {
    "a pause between them": {"r_0.mcap": part(0, 9), "r_1.mcap": part(15, 20)},
    "both begin at zero, as in simulated time": {"r_0.mcap": part(0, 9), "r_1.mcap": part(0, 9)},
    "the second is earlier": {"r_0.mcap": part(10, 19), "r_1.mcap": part(0, 9.9)},
    "other topics": {"r_0.mcap": part(0, 9), "r_1.mcap": part(9.1, 19, topic="/b")},
    "other types": {"r_0.mcap": part(0, 9), "r_1.mcap": part(9.1, 19, kind="std_msgs/msg/Float32")},
    "a hole in the numbers": {"r_0.mcap": part(0, 9), "r_2.mcap": part(9.1, 19)},
    "not from zero": {"r_1.mcap": part(0, 9), "r_2.mcap": part(9.1, 19)},
    "other stems": {"a_0.mcap": part(0, 9), "b_1.mcap": part(9.1, 19)},
    "no numbers": {"a.mcap": part(0, 9), "b.mcap": part(9.1, 19)},
}


@pytest.mark.parametrize("case", APART)
def test_files_that_may_be_separate_runs_stay_apart(case: str, tmp_path: Path) -> None:
    files = [file.save(tmp_path / name) for name, file in APART[case].items()]
    assert names(group_recordings(files)) == [[file.name] for file in files]


def test_slow_recordings_are_joined_over_their_own_pauses(tmp_path: Path) -> None:
    files = [part(0, 90, 10).save(tmp_path / "s_0.mcap"), part(99, 190, 10).save(tmp_path / "s_1.mcap")]
    assert names(group_recordings(files)) == [["s_0.mcap", "s_1.mcap"]]


def test_metadata_beside_files_joins_them(tmp_path: Path) -> None:
    parts = {"r_0.mcap": part(0, 9), "r_1.mcap": part(100, 109), "r_2.mcap": part(200, 209)}
    write_folder(tmp_path, parts, metadata_yaml(parts))
    files = [tmp_path / "r_2.mcap", tmp_path / "r_0.mcap"]
    assert names(group_recordings(files)) == [["r_0.mcap", "r_2.mcap"]]
    assert names(group_recordings(files[:1])) == [["r_2.mcap"]]
    (tmp_path / "metadata.yaml").write_text(metadata_yaml(["old_0.db3"], storage="sqlite3"))
    assert names(group_recordings(files)) == [["r_2.mcap"], ["r_0.mcap"]]


def test_folders_and_files_in_the_order_given(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "f", {"f_0.mcap": part(0, 9)})
    other = part(0, 9).save(tmp_path / "x_5.mcap")
    third = part(0, 9).save(tmp_path / "x_6.mcap")
    assert names(group_recordings([other, folder, third])) == [["x_5.mcap"], ["x_6.mcap"], ["f_0.mcap"]]
    for twice in ([other, other], [folder, folder], [folder, folder / "f_0.mcap"]):
        refuses(BagError, "named twice", group_recordings, twice)
    refuses(BagError, "there is no such file", group_recordings, [other, tmp_path / "x_9.mcap"])


# --- what could be a signal ---------------------------------------------------------------------------------


POINT, TRAJECTORY = "trajectory_msgs/msg/JointTrajectoryPoint", "trajectory_msgs/msg/JointTrajectory"


def test_describe_offers_paths_that_can_be_read(tmp_path: Path) -> None:
    odd_names, joint_state, more = ["fan", "3", " spaced ", "a[b]"], "sensor_msgs/msg/JointState", np.arange(3.0)
    joints = cdr(joint_state, header=header(5), name=odd_names, position=np.arange(4.0), velocity=more, effort=more[:0])
    many, single = (array(np.arange(n)) for n in (100.0, 1.0))
    point = message("geometry_msgs/msg/Point", x=1.0, y=2.0, z=3.0)
    turned = message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.6, w=0.8)
    pose = message("geometry_msgs/msg/Pose", position=point, orientation=turned)
    poses = cdr("geometry_msgs/msg/PoseArray", header=header(0), poses=[pose] * 2)
    empty = dict.fromkeys(("accelerations", "effort"), np.empty(0))
    still = message("builtin_interfaces/msg/Duration", sec=1, nanosec=0)
    to = message(POINT, positions=np.arange(2.0), velocities=np.arange(3.0), **empty, time_from_start=still)
    goal = cdr(TRAJECTORY, header=header(0), joint_names=["pan", "tilt"], points=[to])
    kinds = {
        "/joints": (joint_state, joints),
        "/goal": (TRAJECTORY, goal),
        "/array": ("std_msgs/msg/Float64MultiArray", many),
        "/single": ("std_msgs/msg/Float64MultiArray", single),
        "/poses": ("geometry_msgs/msg/PoseArray", poses),
        "/text": ("std_msgs/msg/String", cdr("std_msgs/msg/String", data="3")),
    }
    topics = [Topic(name, kind) for name, (kind, _) in kinds.items()]
    bag = read(write(topics, [Message(name, 1, data) for name, (_, data) in kinds.items()]), tmp_path)
    found = {item.info.topic: item for item in bag.facts()}
    names = "position[fan]", 'position["3"]', 'position[" spaced "]', 'position["a[b]"]'
    assert found["/joints"].fields == (*names, "velocity[0..2]")
    of_goal = "points[0].positions[pan]", "points[0].positions[tilt]", "points[0].velocities[0..2]"
    assert found["/goal"].fields == of_goal
    assert found["/array"].fields == ("layout.data_offset", "data[0..99]")
    assert found["/single"].fields == ("layout.data_offset", "data[0]")
    assert found["/text"].fields == ()
    assert found["/poses"].fields[3:6] == tuple(f"{f}(poses[0..1].orientation)" for f in ("roll", "pitch", "yaw"))
    for topic, _, decoded in bag.messages(bag.topics):
        for text in found[topic].fields:
            path = FieldPath(text.replace("[0..", "["))  # the last of each range
            path.check(topic, bag.topics[topic].type, bag.type_fields(topic))
            assert path.read(decoded) == path.read(decoded)  # a number, not NaN


def test_describe_counts_rates_gaps_and_stamps(tmp_path: Path) -> None:
    def stamped(stamp: int, little_endian: bool = True) -> bytes:
        point = message("geometry_msgs/msg/Point", x=1.0, y=2.0, z=3.0)
        return cdr("geometry_msgs/msg/PointStamped", little_endian, header=header(stamp), point=point)

    kind = "geometry_msgs/msg/PointStamped"
    late = "float64 y\nstd_msgs/Header header\n"
    topics = [Topic("/usable", kind), Topic("/zero", kind), Topic("/mixed", kind), Topic("/none"), Topic("/once")]
    topics += [Topic("/big", kind), Topic("/late", "x/msg/Late", schema=late), Topic("/never", kind)]
    own = {"Head": "x/Moment stamp", "Moment": "int32 sec\nuint32 nanosec"}  # types of their own, read alike
    parts = ("x/Head header\nfloat64 y", *(f"MSG: x/{name}\n{fields}" for name, fields in own.items()))
    topics.append(Topic("/own", "x/msg/Own", schema=f"\n{'=' * 80}\n".join(parts) + "\n"))
    timestamped = "uint64 timestamp\nfloat32 x\n"
    topics += [Topic(name, "px4_msgs/msg/Odd", schema=timestamped) for name in ("/px4", "/booting")]
    messages = []
    for i in range(11):
        t = (100 + i) * SECOND // 10 + (2 * SECOND if i == 10 else 0)
        messages += [Message("/usable", t, stamped(t - 7 * SECOND)), Message("/zero", t, stamped(0))]
        messages += [Message("/mixed", t, stamped(t if i % 2 else 0)), Message("/none", t, float64(i))]
        messages += [Message("/big", t, stamped(t, little_endian=False))]
        behind = b"\0\1\0\0" + struct.pack("<diII", 1.0, 5, 7, 1) + b"\0"
        messages += [Message("/late", t, behind), Message("/own", t, b"\0\1\0\0" + struct.pack("<iId", 5, 7, 1.0))]
        for topic, offset in (("/px4", 3 * SECOND), ("/booting", t)):  # us; 0 before the clock is known
            messages.append(Message(topic, t, b"\0\1\0\0" + struct.pack("<Qf", (t - offset) // 1000, 1.0)))
    messages.append(Message("/once", 0, float64(0)))
    bag = read(write(topics, messages), tmp_path)
    found = {item.info.topic: item for item in bag.facts()}
    for raw in bag.raw_messages(["/usable", "/px4", "/late"]):  # as where a message must be decoded
        definition = raw.channel.definition
        assert header_stamp_ns(definition.decode(raw.data)) == definition.stamp_ns(raw.data) is not None
    stamps = {topic: item.stamps for topic, item in found.items()}
    assert stamps == {
        "/usable": "usable", "/zero": "zero", "/mixed": "mixed", "/none": "none", "/once": "none", "/big": "usable",
        "/late": "usable", "/own": "usable", "/never": "none", "/px4": "usable", "/booting": "zero",
    }  # fmt: skip
    assert found["/usable"].stamp_offset == pytest.approx(7) and found["/big"].stamp_offset == 0
    assert found["/px4"].stamp_offset == pytest.approx(3, abs=1e-6) and "timestamp" in found["/px4"].fields
    assert found["/none"].rate == pytest.approx(10) and found["/none"].largest_gap == pytest.approx(2.1)
    assert found["/once"].rate is None and found["/once"].largest_gap is None
    assert found["/never"].info.count == 0 and found["/never"].fields == ()


# --- real recordings ----------------------------------------------------------------------------------------

NO_RECORDINGS = ("odd/rollbag_truncated.mcap", "odd/empty.mcap", "odd/lfs_pointer.mcap")
EVERY = sorted(DATA.rglob("*.mcap"), reverse=True)
FIRST = {path.parent: path for path in EVERY}  # of a machine's recordings, which are alike
KEPT = [path for path in EVERY if path.parent.name == "odd" or path == FIRST[path.parent]]
REAL = [name for path in KEPT if (name := str(path.relative_to(DATA))) not in NO_RECORDINGS]


@needs_data
@pytest.mark.parametrize("name", REAL)
def test_real_recordings_read_as_the_mcap_library_reads_them(name: str) -> None:
    """Every message of theirs; of each topic all are decoded, or it is said why none is."""
    topics: dict[int, str] = {}
    expected = []
    with open(DATA / name, "rb") as stream:
        for record in StreamReader(stream, validate_crcs=True).records:
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, McapMessage):
                expected.append((topics[record.channel_id], record.log_time, record.data))
    bag = Bag(DATA / name)
    found = read_all(bag)
    assert [t for _, t, _ in found] == sorted(t for _, t, _ in found) and found
    assert found == sorted(expected, key=lambda m: m[1])
    for topic, info in bag.topics.items():
        if info.readable:
            assert sum(1 for _ in bag.messages([topic])) == info.count
        else:
            assert info.reason
    assert bag.warnings == []
