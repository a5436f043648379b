# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Files made to hurt: none takes unbounded memory or time; each gives a correct reading or one clear sentence."""

import struct
import subprocess
import sys

import numpy as np
import pytest
from bag_writer import (
    Layout,
    Message,
    Topic,
    cdr,
    channel_record,
    chunk_index,
    chunk_record,
    float64,
    header,
    message_record,
    ramp,
    raw_file,
    record,
    schema_record,
    statistics_record,
    write,
)
from by_message import read_stream_by_message
from mcap.reader import NonSeekingReader, make_reader
from processes import bounded
from test_annotate import held

from uncertain_lti import SignalMap, UncertainLTI
from uncertain_lti.base.errors import BagError
from uncertain_lti.cli.main import main
from uncertain_lti.recordings import bag as bag_module
from uncertain_lti.recordings.bag import Bag
from uncertain_lti.recordings.mcap_scan import outline
from uncertain_lti.recordings.message_types import define
from uncertain_lti.sampling.reading import read_as_fitted, read_stream
from uncertain_lti.signals.field_path import FieldPath

TOPIC = Topic("/a")
DEFINED = schema_record(1, TOPIC) + channel_record(1, TOPIC, 1)
SIGNALS = SignalMap.from_dict({"states": [{"name": "x", "topic": "/a", "field": "data"}]})
STEP = 10**9


def said(count, begin=0):
    """Message records of a Float64 0.0, 1.0, ... a second apart."""
    return b"".join(message_record(1, k * STEP, float64(float(k))) for k in range(begin, begin + count))


@pytest.fixture
def model(tmp_path):
    """A model file of one state, /a, which is outside its bounds at no step."""
    state = {"name": "x", "topic": "/a", "field": "data", "type": "std_msgs/msg/Float64"}
    signals = SignalMap.from_dict({"states": [state], "clock": "/a", "max_gap": 5.0, "topics": {"/a": {"time": "log"}}})
    path = tmp_path / "m.model.json"
    UncertainLTI([[0.0]], np.zeros((1, 0)), [[1.0]], np.zeros((1, 0)), v=[2.0], signals=signals).save(path)
    return path


def limited(arguments, memory=1 << 30, seconds=30):
    """A command in a process that may take so much memory beyond its start, and so much processor time."""
    program = f"""
import os, resource, sys
from uncertain_lti.cli.main import main
import uncertain_lti.recordings.bag, uncertain_lti.reports.model_text, uncertain_lti.reports.annotate
size = int(open("/proc/self/statm").read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
resource.setrlimit(resource.RLIMIT_AS, (size + {memory}, resource.RLIM_INFINITY))
resource.setrlimit(resource.RLIMIT_CPU, ({seconds}, {seconds}))
sys.exit(main(sys.argv[1:]))
"""
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=1200)


@pytest.mark.parametrize("rest", [bytes(9), message_record(1, STEP, b"")])
def test_a_small_file_takes_little_memory_and_time(tmp_path, model, rest):
    """20 KB that decompress to 250 MiB of the smallest records; before, walking them took 4 GiB and minutes."""
    path = tmp_path / "small.mcap"
    path.write_bytes(raw_file(chunk_record(DEFINED + said(20) + rest * ((250 << 20) // len(rest))), summary=b""))
    assert path.stat().st_size < 50_000
    done = limited(["check", model, path])
    assert done.returncode in (0, 2), done.stderr[-2000:]
    assert "Traceback" not in done.stderr and "not enough memory" not in done.stderr
    if not any(rest):  # what follows a record that is none is left out, what stands before it counts
        assert "20 samples, 19 verdicts" in done.stdout and "left out" in done.stderr
    else:
        assert "more records than bytes" in done.stderr


def test_small_records_outside_chunks_are_walked_at_once(tmp_path):
    """Half a million in 0.05 s of processor time; before, each was read alone, in 1.5 s. Chunks in between count."""
    path = tmp_path / "bare.mcap"
    chunk = chunk_record(said(1, begin=20))
    bare = message_record(1, STEP, b"") * 500_000
    path.write_bytes(raw_file(DEFINED, said(20), chunk, bare, chunk, said(20, begin=30), summary=b""))
    with bounded(seconds=0.75):
        bag = Bag(path)
    assert bag.topics["/a"].count == 500_042 and not any("left out" in warning for warning in bag.warnings)


@pytest.mark.parametrize("number", [2**40, 2**63, 2**70])
def test_a_fixed_array_longer_than_any_message_is_a_message_that_is_cut(number):
    definition = define("p/msg/T", "ros2msg", f"float64 x\nuint8[{number}] many\n".encode())
    if not definition.reason:
        with pytest.raises(BagError, match="cut"):
            definition.decode(bytes([0, 1, 0, 0]) + bytes(64))


def test_many_chunks_do_not_decompress_to_more_than_a_multiple_of_the_file(tmp_path, model):
    """100 chunks of 250 MiB each in one file of 0.8 MB: 25 GiB, were they all decompressed."""
    bomb = chunk_record(record(0x80, bytes(250 << 20)))
    path = tmp_path / "bombs.mcap"
    path.write_bytes(raw_file(chunk_record(DEFINED + said(20)), *[bomb] * 100, summary=b""))
    done = limited(["check", model, path])
    assert done.returncode == 0 and "20 samples, 19 verdicts" in done.stdout, done.stderr[-2000:]
    assert "when decompressed" in done.stderr and len(done.stderr) < 5000


def test_a_chunk_that_reaches_over_its_neighbour_costs_the_copy_nothing(tmp_path, model):
    first, second = chunk_record(DEFINED + said(20)), chunk_record(DEFINED + said(20, begin=20))
    start = len(raw_file())
    longer = first[:1] + struct.pack("<Q", len(first) - 9 + 40) + first[9:]
    index = chunk_index(start, first) + chunk_index(start + len(first), second)
    path = save(tmp_path / "over.mcap", raw_file(longer, second, summary=index))
    read = [(m.log_time_ns, m.data) for m in Bag(path).raw_messages()]
    assert len(read) == 20
    assert [(m.log_time_ns, m.data) for m in Bag(copied(path, model)).raw_messages(["/a"])] == read


@pytest.mark.parametrize("opcode", [2, 15])
def test_what_looks_like_the_end_is_not_while_chunks_follow(tmp_path, opcode):
    """As the index has it, so a damaged opcode does not hide what stands behind it."""
    first, second = chunk_record(DEFINED + said(20)), chunk_record(DEFINED + said(20, begin=20))
    start = len(raw_file())
    index = chunk_index(start, first) + chunk_index(start + len(first) + 9, second)
    path = tmp_path / "ends.mcap"
    path.write_bytes(raw_file(first, record(opcode), second, summary=index))
    bag = Bag(path)
    assert bag.topics["/a"].count == 40 and any("damaged" in warning for warning in bag.warnings)


@pytest.mark.parametrize("indexed", [True, False])
def test_a_chunk_inside_a_chunk_is_told(tmp_path, indexed):
    """Its messages were lost without a word."""
    outer = chunk_record(DEFINED + said(3) + chunk_record(said(4, begin=3)) + said(2, begin=7), "zstd")
    index = DEFINED + statistics_record({1: 5}, 1) + chunk_index(len(raw_file()), outer, compression="zstd")
    bag = Bag(save(tmp_path / "nested.mcap", raw_file(outer, summary=index)), indexed=indexed)
    assert read_stream(bag, SIGNALS).values[0][:, 0].tolist() == [0.0, 1.0, 2.0, 7.0, 8.0]
    (warning,) = bag.warnings
    assert warning.startswith(f"{bag.path}: 1 chunk inside other chunks left out with all messages in it")


def test_chunks_that_lie_in_each_other_are_walked(tmp_path):
    """An index that has one chunk inside another: going by it and walking the file read different messages."""
    other = Topic("/b")
    inner = chunk_record(message_record(2, 5, float64(1.0)), "")
    outer = chunk_record(message_record(1, 5, float64(2.0)) + record(0x80, inner), "")
    start, top = len(raw_file()), DEFINED + channel_record(2, other, 1)
    within = start + outer.index(inner)
    for second in (within, start + len(outer)):
        listed = chunk_index(start, outer, channels=[1], compression="")
        listed += chunk_index(second, inner, channels=[2], compression="")
        summary = top + statistics_record({1: 1, 2: 1}, 2) + listed
        data = raw_file(outer, *([inner] if second != within else []), summary=summary)
        path = save(tmp_path / f"{second}.mcap", data)
        assert (outline(path) is None) == (second == within)
        signals = SignalMap.from_dict({"states": [{"name": "x", "topic": "/b", "field": "data"}]})
        assert read_stream(Bag(path, indexed=True), signals).values[0].tolist() == [[1.0]]


def values(path, indexed=False):
    """What a signal on /a reads of a file."""
    return read_stream(Bag(path, indexed=indexed), SIGNALS).values[0][:, 0].tolist()


def save(path, data):
    path.write_bytes(data)
    return path


def test_a_summary_without_schemas_reads_alike_everywhere(tmp_path, model):
    """Channels are repeated in the summary and schemas are not: `topics` read such a file, `fit` refused it."""
    chunk = chunk_record(DEFINED + said(20))
    index = chunk_index(len(raw_file()), chunk, channels=[1])
    summary = channel_record(1, TOPIC, 1) + statistics_record({1: 20}, 1) + index
    path = save(tmp_path / "bare.mcap", raw_file(chunk, summary=summary))
    assert Bag(path).topics["/a"].readable
    assert values(path, indexed=True) == list(range(20))
    assert main(["check", str(model), str(path)]) == 0


TEXTS = {
    "CRLF": b"float64 data\r\nint32 more # of it\r\n",
    "CR": b"float64 data\rint32 more\r",
    "byte order mark": b"\xef\xbb\xbffloat64 data\nint32 more\n",
    "Latin-1 comment": b"# gr\xf6\xdfe\nfloat64 data # \xb0C\nint32 more\n",
    "form feed in a comment": b"float64 data\n# a\x0cb\nint32 more\n",
    "CRLF in parts": b"Inner inner\r\n" + b"=" * 80 + b"\r\nMSG: p/Inner\r\nfloat64 data\r\nint32 more\r\n",
}


@pytest.mark.parametrize("what", TEXTS)
def test_schemas_of_other_editors_are_read(what):
    definition = define("p/msg/T", "ros2msg", TEXTS[what])
    assert not definition.reason
    read = definition.decode(b"\0\1\0\0" + struct.pack("<di", 1.5, 7))
    inner = read.inner if "parts" in what else read
    assert (inner.data, inner.more) == (1.5, 7)


def parts(*types):
    return ("\n" + "=" * 80 + "\n").join(types).encode()


def chain(fields, length):
    """Types of which each has the next one in these fields."""
    types = [f"MSG: p/T{i}\n" + fields.format(i + 1) for i in range(length)] + [f"MSG: p/T{length}\nint8 a"]
    return parts(types[0].partition("\n")[2], *types[1:])


SCHEMAS = {
    "fixed arrays of texts": b"".join(b"string[4096] a%d\n" % i for i in range(8)),
    "a tree": chain("T{0} a\nT{0} b", 30),
    "deep": chain("T{} a", 900),
    "blank lines": b"\n" * 1_000_000 + b"float64 x\n",
    "comments": b"# nothing\n" * 100_000 + b"float64 x\n",
    "many fields": b"".join(b"float64 x%d\n" % i for i in range(60_000)),
    "a long default": b"float64[] x [" + b"1," * 400_000 + b"1]\n",
    "a long name": b"float64 " + b"x" * 1_000_000,
}  # fmt: skip


@pytest.mark.parametrize("what", SCHEMAS)
def test_no_schema_takes_long(what):
    """Before, eight arrays in 120 bytes took 22 s, and a MB of blank lines 24 s."""
    with bounded(seconds=3):
        definition = define("p/msg/T", "ros2msg", SCHEMAS[what])
        if not definition.reason:
            with pytest.raises(BagError):
                definition.decode(b"\0\1\0\0")
    assert len(definition.reason) < 300 and "\n" not in definition.reason
    assert (definition.reason == "") == (what in ("blank lines", "comments"))


def test_a_file_of_nothing_but_schemas_ends(tmp_path, monkeypatch):
    """Definitions that nobody has read before are parsed up to a number of lines in all."""
    monkeypatch.setattr(bag_module, "_MOST_LINES", 5000)
    topics = [
        Topic(f"/t{k}", "p/msg/T", schema="".join(f"float64 x{i}\n" for i in range(1000)) + f"float64 y{k}\n")
        for k in range(500)
    ]
    records = b"".join(schema_record(k + 1, t) + channel_record(k + 1, t, k + 1) for k, t in enumerate(topics))
    data = raw_file(chunk_record(records + message_record(1, 5, bytes(8))), summary=b"")
    path = save(tmp_path / "schemas.mcap", data)
    with bounded(seconds=3):
        bag = Bag(path)
    assert not bag.topics["/t0"].reason and "too long together" in bag.topics["/t499"].reason


def test_a_nested_message_without_fields_is_one_byte():
    """As the middleware writes it; read as none, every field behind it was shifted, silently."""
    text = parts("float64 data\nNothing nothing\nNothing[2] two\nfloat32 more", "MSG: p/Nothing\nint32 CONSTANT=5")
    data = b"\0\1\0\0" + struct.pack("<dBBBxf", 1.5, 0, 0, 0, 2.5)
    definition = define("p/msg/T", "ros2msg", text)
    assert definition.decode(data).more == 2.5
    assert list(definition.fields("p/msg/T")) == ["data", "nothing", "two", "more"]
    last = define("p/msg/L", "ros2msg", parts("float64 data\nNothing nothing", "MSG: p/Nothing\n# not a thing"))
    assert last.decode(b"\0\1\0\0" + struct.pack("<dB", 1.5, 0)).data == 1.5
    with pytest.raises(BagError):
        last.decode(b"\0\1\0\0" + struct.pack("<d", 1.5))


CUT = {
    "an empty message last": (parts("float64 data\nN n", "MSG: p/N\n"), struct.pack("<dB", 1.5, 0), 8),
    "text last": (b"float64 data\nstring text", struct.pack("<dI6s", 1.5, 6, b"hello\0"), 17),
    "texts last": (b"float64 data\nstring[] text", struct.pack("<dII6s", 1.5, 1, 6, b"hello\0"), 21),
    "numbers last": (b"float64 data\nuint8[] more", struct.pack("<dI3B", 1.5, 3, 1, 2, 3), 14),
    "no numbers last": (b"float64 data\nfloat64[] more", struct.pack("<dI", 1.5, 0), 11),
    "a truth value last": (b"float64 data\nbool more", struct.pack("<d?", 1.5, True), 8),
}


@pytest.mark.parametrize("what", CUT)
def test_messages_cut_before_their_end_are_left_out(tmp_path, what):
    text, body, longest = CUT[what]
    topic = Topic("/a", "p/msg/T", schema=text.decode())
    bodies = [b"\0\1\0\0" + body[:size] for size in (len(body), len(body), *range(longest + 1))]
    path = write([topic], [Message("/a", k * STEP, b) for k, b in enumerate(bodies)]).save(tmp_path / "cut.mcap")
    for read in (read_stream, read_stream_by_message):
        assert read(Bag(path), SIGNALS).values[0].tolist() == [[1.5], [1.5]]


def copied(path, model):
    """The annotated copy that `check --write` makes of a file."""
    copy = path.with_name("copy.mcap")
    assert main(["check", str(model), str(path), "--write", str(copy)]) == 0
    return copy


def test_attachments_and_metadata_in_copies(tmp_path, model):
    """Bytes behind what the format knows are no damage; a metadata record with a broken map is."""
    body = struct.pack("<QQ", 1, 2) + struct.pack("<I", 1) + b"n" + struct.pack("<I", 1) + b"t" + struct.pack("<Q", 3)
    good = record(9, body + b"abc" + bytes(4) + b"more of it")
    broken = record(12, struct.pack("<I", 1) + b"m" + struct.pack("<I", 4000) + b"key")
    whole = record(12, struct.pack("<I", 1) + b"w" + struct.pack("<III", 10, 1, 0)[:4] + struct.pack("<I", 1) + b"k"
                   + struct.pack("<I", 1) + b"v" + b"padding")  # fmt: skip
    path = save(tmp_path / "a.mcap", raw_file(good, broken, whole, chunk_record(DEFINED + said(20)), summary=b""))
    copy = copied(path, model)
    found = held(copy, without=["/envelope_monitor/"])
    assert [(a.name, a.data) for a in found.attachments] == [("n", b"abc")]
    assert [(m.name, m.metadata) for m in found.metadata] == [("w", {"k": "v"})]
    with open(copy, "rb") as stream:
        reader = make_reader(stream)
        assert len(list(reader.iter_attachments())) == 1 and len(list(reader.iter_metadata())) == 2


def test_copies_of_padded_definitions_can_be_walked(tmp_path, model):
    """The format allows bytes behind a definition; inside chunks the mcap library does not pass over them."""
    padded = schema_record(1, TOPIC, b"padding") + channel_record(1, TOPIC, 1, b"padding")
    path = save(tmp_path / "padded.mcap", raw_file(chunk_record(padded + said(20)), summary=b""))
    read = [m.data for m in Bag(path).raw_messages()]
    assert len(read) == 20 and by_the_library(path) != read
    assert by_the_library(copied(path, model)) == read


def by_the_library(path):
    """Data on /a as the mcap library reads it from the first byte to the last; None where it cannot."""
    with open(path, "rb") as stream:
        try:
            found = list(NonSeekingReader(stream).iter_messages(log_time_order=False))
        except Exception:
            return None
    return [m.data for _, c, m in found if c.topic == "/a"]


def test_a_topic_that_only_the_index_names_is_a_sentence(tmp_path):
    """It was a KeyError, as the file itself was read after all."""
    data = write([TOPIC], ramp("/a", range(0, 20 * STEP, STEP)), Layout("zstd", checksums=False)).data
    at = data.rindex(b"\2\0\0\0/a")
    (tmp_path / "a.mcap").write_bytes(data[:at] + b"\2\0\0\0/z" + data[at + 6 :])
    bag = Bag(tmp_path / "a.mcap", indexed=True)
    with pytest.raises(BagError, match="there is no topic /z; topics there: /a"):
        bag.columns(["/z"], [[FieldPath("data")]])


def test_stamps_that_all_lie_before_the_first_are_a_sentence(tmp_path):
    """Every message but one was late, and that one waited: `check` ended as by a fault of the program."""
    kind, held = "sensor_msgs/msg/Temperature", []
    for topic, stamps in {"/t": [5, 1, 2, 3], "/u": range(1, 20)}.items():
        for k, stamp in enumerate(stamps):
            data = cdr(kind, header=header(stamp * STEP), temperature=1.0, variance=0.0)
            held.append(Message(topic, (k + 100 * (k > 0 or topic == "/u")) * STEP, data))
    path = write([Topic("/t", kind), Topic("/u", kind)], held).save(tmp_path / "a.mcap")
    states = [{"name": name, "topic": f"/{name}", "field": "temperature"} for name in "tu"]
    times = {topic: {"time": "header"} for topic in ("/t", "/u")}
    with pytest.raises(BagError, match="no message of /t makes a sample"):
        read_as_fitted(path, SignalMap.from_dict({"states": states, "clock": "/t", "max_gap": 5.0, "topics": times}))


@pytest.mark.parametrize("summary", [True, False])
def test_a_log_time_past_64_bits_costs_its_message(tmp_path, cli, summary):
    """Every other message of its topic was lost too."""
    late, other = Message("/a", 2**63, float64(0.0)), ramp("/a", range(0, 20 * STEP, STEP))
    path = write([TOPIC], [*other, late], Layout("zstd", summary=summary)).save(tmp_path / "late.mcap")
    for indexed in (False, True):
        bag = Bag(path, indexed=indexed)
        assert len(list(bag.raw_messages(["/a"]))) == 20 == bag.topics["/a"].count
        assert bag.columns(["/a"], [[FieldPath("data")]]).values[0].ravel().tolist() == list(range(20))
    assert "1 message past the year 2262 left out" in cli("topics", path).err


def test_messages_out_of_order_are_held_up_to_a_limit(tmp_path, monkeypatch):
    """Every chunk has one message from before all others; before, everything was held, and sorted chunk after chunk."""
    chunks = [DEFINED + message_record(1, 0, float64(-1.0)) + said(50, begin=1 + 50 * k) for k in range(200)]
    path = save(tmp_path / "back.mcap", raw_file(*map(chunk_record, chunks), summary=b""))
    times = [m.log_time_ns for m in Bag(path).raw_messages()]
    assert times == sorted(times) and len(times) == 200 * 51
    monkeypatch.setattr(bag_module, "_MOST_HELD", 100_000)
    with pytest.raises(BagError, match="mcap sort"):
        list(Bag(path).raw_messages())


def test_chunks_of_several_compressions_in_one_file(tmp_path, model):
    """Far from each other, so each is read alone; a compressed one behind one that is not raised an error."""
    apart = record(0x80, bytes(1 << 17))
    kinds = ("", "zstd", "lz4", "", "lz4", "zstd")
    parts = [chunk_record(DEFINED + said(5, begin=5 * k), kind) for k, kind in enumerate(kinds)]
    path = save(tmp_path / "mixed.mcap", raw_file(*(piece for part in parts for piece in (part, apart)), summary=b""))
    assert values(path) == list(range(30))


def test_a_damaged_definition_in_the_summary_alone_hurts_nothing(tmp_path, model):
    """Without checksums the index is gone by until something in it is wrong; the chunks have the definition whole."""
    file = write([TOPIC], ramp("/a", range(0, 20 * STEP, STEP)), Layout("none", checksums=False)).data
    last = file.rindex(b"float64 data")
    assert last > file.index(b"float64 data")
    for wrong in (b"float64 dat\x01", b"float64 dato"):
        path = save(tmp_path / "wrong.mcap", file[:last] + wrong + file[last + 12 :])
        assert Bag(path, indexed=True).indexed
        for indexed in (True, False):
            assert values(path, indexed) == list(range(20))
