# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Annotated recordings: what was recorded is unchanged, and the verdicts are the check's, for every reader."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from bag_writer import COMPRESSIONS, Message, Topic, write
from conftest import ROOT
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema
from mcap.records import Message as Recorded
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from processes import bounded
from rosbags.highlevel import AnyReader

from uncertain_lti import EnvelopeMonitor, UncertainLTI
from uncertain_lti.base.errors import BagError
from uncertain_lti.model.alarm_rule import AlarmRule, StatisticRule
from uncertain_lti.monitor import outputs
from uncertain_lti.monitor.outputs import NODE, RECORDED
from uncertain_lti.monitor.reason import over_recording
from uncertain_lti.plants.leibov import leibov2006
from uncertain_lti.recordings.bag import Bag
from uncertain_lti.recordings.formats import group_recordings
from uncertain_lti.reports.annotate import METADATA, annotate, targets
from uncertain_lti.sampling.reading import read_as_fitted, read_as_fitted_with_decisions

BAGS = ROOT / "bags"
JUDGED = [output for output in outputs.JUDGED if output.of == "states"]
TOPICS = {output.name: output.type for output in RECORDED if output.of == "states"}
VERDICTS = [output.name for output in RECORDED if output.of == "states" and output.when != "changed"]


@dataclass
class Held:
    """Everything in a file, as another library reads it, in file order."""

    messages: list
    attachments: list
    metadata: list
    channels: set
    compressions: set


def held(path, without=()):
    """A file, without the topics that begin with these texts."""
    found = Held([], [], [], set(), set())
    schemas, channels = {}, {}
    with open(path, "rb") as stream:
        for record in StreamReader(stream, emit_chunks=True, validate_crcs=True).records:
            if isinstance(record, Chunk):
                found.compressions.add(record.compression)
    with open(path, "rb") as stream:
        for record in StreamReader(stream, validate_crcs=True).records:
            if isinstance(record, Schema):
                schemas[record.id] = (record.name, record.encoding, record.data)
            elif isinstance(record, Channel):
                about = (record.topic, record.message_encoding, tuple(record.metadata.items()))
                channels[record.id] = (*about, schemas.get(record.schema_id))
                if not record.topic.startswith(tuple(without)):
                    found.channels.add(channels[record.id])
            elif isinstance(record, Recorded):
                channel = channels[record.channel_id]
                if not channel[0].startswith(tuple(without)):
                    m = record
                    found.messages.append((channel, m.sequence, m.log_time, m.publish_time, m.data))
            elif isinstance(record, Attachment):
                found.attachments.append(record)
            elif isinstance(record, Metadata) and record.name != METADATA:
                found.metadata.append(record)
    return found


def check(model, path, output, **options):
    """Annotate the one recording at a path; verdicts and what was written."""
    (bag,) = group_recordings(path if isinstance(path, list) else [path])
    transient, decisions = read_as_fitted_with_decisions(bag, model.signals)
    verdicts = EnvelopeMonitor(model).check(transient)
    return verdicts, annotate(bag.parts, verdicts, decisions, output, model, **options)


def same_recording(source, copy, topics=NODE):
    one, other = held(source), held(copy, without=[f"{topics}/"])
    assert other.messages == one.messages
    assert other.attachments == one.attachments and other.metadata == one.metadata
    assert other.channels == one.channels
    assert other.compressions == one.compressions or (one.compressions == set() and other.compressions == {""})


def by_rosbags(path, base=NODE):
    """{topic: [(log time, message)]} of the annotations, by rosbags."""
    found = {name: [] for name in TOPICS}
    with AnyReader([Path(path)], default_typestore=None) as reader:
        wanted = [c for c in reader.connections if c.topic.startswith(f"{base}/")]
        assert {c.topic: c.msgtype for c in wanted} == {f"{base}/{name}": kind for name, kind in TOPICS.items()}
        for connection, time, data in reader.messages(wanted):
            message = reader.deserialize(data, connection.msgtype)
            found[connection.topic.removeprefix(f"{base}/")].append((time, message))
    return found


def stamp(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def same_verdicts(model, verdicts, path, base=NODE):
    """The bits of the check, in what rosbags reads."""
    found, transient = by_rosbags(path, base), verdicts.transient
    judged = verdicts.judged
    rows = {name: np.array([m.position for _, m in found[name]]) for name in VERDICTS if name != "violation"}
    stamps = {name: np.array([stamp(m) for _, m in found[name]]) for name in rows}
    for name in rows:
        assert all(list(m.name) == list(model.state_names) for _, m in found[name])
    kept = np.isin(stamps["flags"], transient.t_ns)
    for output in JUDGED:
        name, array = output.name, getattr(verdicts, output.position)
        assert stamps[name].tolist() == transient.t_ns[judged].tolist()
        assert rows[name].tobytes() == array[judged].tobytes()
    flags = rows["flags"]
    assert np.array_equal(flags[np.isfinite(flags).all(axis=1)], verdicts.flags[judged])
    marks = np.array([m.velocity for _, m in found["flags"]])
    told = np.isfinite(flags).all(axis=1)
    assert np.array_equal(marks[told], np.repeat(verdicts.outside_domain[judged, None], model.n, axis=1))
    assert np.isnan(marks[~told]).all()
    said, alarms = [(time, m.data) for time, m in found["reason"]], [(time, m.data) for time, m in found["violation"]]
    assert all(a != b for (_, a), (_, b) in zip(said, said[1:], strict=False)) and len(said) >= 1
    for time, text in said:
        assert ("alarm: " in text) in {alarm for at, alarm in alarms if at == time}
    alarm = np.array([m.data for _, m in found["violation"]])
    assert len(alarm) == len(flags)
    if kept.all() and len(alarm) == len(transient):
        assert np.array_equal(alarm, verdicts.alarm)
    return found


def test_a_shipped_recording(tmp_path):
    source, copy, model = BAGS / "leibov_check.mcap", tmp_path / "out.mcap", leibov2006()
    verdicts, made = check(model, source, copy)
    assert verdicts.violated.any() and made.messages == len(held(source).messages) and not made.notes
    same_recording(source, copy)
    found = same_verdicts(model, verdicts, copy)
    # decided by the state message itself, at whose log time it is told
    with AnyReader([source]) as reader:
        states = [c for c in reader.connections if c.topic == model.signals.clock]
        arrivals = [time for _, time, _ in reader.messages(states)]
    assert [time for time, _ in found["flags"]] == arrivals


# --- layouts of files -----------------------------------------------------------------------------------------


@pytest.fixture
def engine(engine_folder):
    """A folder with a recording that has a jump, and its model of two states."""
    return engine_folder, UncertainLTI.load(engine_folder / "m.model.json")


def rewritten(source, target, *, extra=True, first=1, part=slice(None), **options):
    """The same messages, or a part of them, with another layout, an attachment, metadata and a topic besides."""
    with open(source, "rb") as stream, open(target, "wb") as out:
        reader, writer = make_reader(stream), Writer(out, **options)
        writer.start(profile="ros2", library="tests")
        for unused in range(first - 1):  # so that numbers are other ones
            writer.register_schema(f"unused{unused}", "", b"")
        numbers, about = {}, {"maker": "- depth: 3\n", "a": ""}
        for schema, channel, m in list(reader.iter_messages(log_time_order=False))[part]:
            if channel.id not in numbers:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                numbers[channel.id] = writer.register_channel(channel.topic, "cdr", number, about)
            writer.add_message(numbers[channel.id], m.log_time, m.data, m.publish_time, m.sequence)
        if extra:
            big = writer.register_channel("/camera", "jpeg", 0, {})
            writer.add_message(big, m.log_time, os.urandom(100_000), 7, 4_000_000_000)
            writer.register_channel("/never/used", "cdr", numbers and 1, {"a": "b"})
            writer.add_attachment(5, 6, "map.pgm", "image/x", b"\x00\x01" * 700_000)
            writer.add_metadata("rosbag2", {"serialized_metadata": "x: ü\n"})
            writer.add_metadata("uncertain_lti", {})
        writer.finish()
    return target


@pytest.mark.parametrize(("compression", "chunked"), [*((kind, True) for kind in COMPRESSIONS), ("none", False)])
def test_everything_recorded_is_in_the_copy(engine, tmp_path, compression, chunked):
    folder, model = engine
    options = {"compression": COMPRESSIONS[compression], "use_chunking": chunked, "chunk_size": 3000}
    source = rewritten(folder / "bad.mcap", tmp_path / "in.mcap", **options)
    verdicts, made = check(model, source, tmp_path / "out.mcap")
    same_recording(source, tmp_path / "out.mcap")
    same_verdicts(model, verdicts, tmp_path / "out.mcap")
    with open(tmp_path / "out.mcap", "rb") as stream:  # by the index as well, in order of log time
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        judged, reasons = int(verdicts.judged.sum()), len(list(over_recording(verdicts, model)))
        expected = made.messages + 2 * made.verdicts + len(JUDGED) * judged + reasons
        assert summary.statistics.message_count == expected
        assert len(summary.attachment_indexes) == 1 and len(summary.metadata_indexes) == 3
        assert [a.data for a in reader.iter_attachments()] == [b"\x00\x01" * 700_000]
        times = [m.log_time for _, _, m in reader.iter_messages(log_time_order=True)]
        assert times == sorted(m[2] for m in held(tmp_path / "out.mcap").messages)
        assert times == sorted(times) and len(times) == summary.statistics.message_count
    with open(tmp_path / "out.mcap", "rb") as stream:
        assert len(list(NonSeekingReader(stream, validate_crcs=True).iter_messages())) == len(times)
    assert not Bag(tmp_path / "out.mcap").warnings
    (again,) = [read_as_fitted(tmp_path / "out.mcap", model.signals)]
    assert np.array_equal(again.x, verdicts.transient.x) and np.array_equal(again.t_ns, verdicts.transient.t_ns)


def test_parts_of_one_recording_become_one_file(engine, tmp_path):
    """Also where their numbers of channels contradict each other."""
    folder, model = engine
    parts = [tmp_path / "bag_0.mcap", tmp_path / "bag_1.mcap"]
    rewritten(folder / "bad.mcap", parts[0], extra=False, part=slice(250))
    rewritten(folder / "bad.mcap", parts[1], extra=False, part=slice(250, None), first=4)
    verdicts, _ = check(model, parts, tmp_path / "out.mcap")
    copied, whole = held(tmp_path / "out.mcap", without=[f"{NODE}/"]), held(folder / "bad.mcap")
    assert [m[1:] for m in copied.messages] == [m[1:] for m in whole.messages]
    same_verdicts(model, verdicts, tmp_path / "out.mcap")
    with open(tmp_path / "out.mcap", "rb") as stream:
        topics = [c.topic for c in make_reader(stream).get_summary().channels.values()]
    assert len(topics) == len(set(topics)) == 2 + len(TOPICS)


def test_a_damaged_recording_is_copied_as_far_as_it_can_be_read(engine, tmp_path):
    folder, model = engine
    source = rewritten(folder / "bad.mcap", tmp_path / "whole.mcap", extra=False, chunk_size=3000)
    data = bytearray(source.read_bytes())
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    data[len(data) // 3] ^= 0xFF
    (tmp_path / "flipped.mcap").write_bytes(data)
    for name in ("cut", "flipped"):
        bag = Bag(tmp_path / f"{name}.mcap")
        expected = [(m.topic, m.log_time_ns, m.data) for m in bag.raw_messages()]
        assert bag.warnings and 0 < len(expected) < 600
        verdicts, _ = check(model, bag.path, tmp_path / f"{name}_out.mcap")
        copy = held(tmp_path / f"{name}_out.mcap", without=[f"{NODE}/"])
        assert [(c[0], log, data) for c, _, log, _, data in copy.messages] == expected
        same_verdicts(model, verdicts, tmp_path / f"{name}_out.mcap")


def test_topics_of_a_live_monitor_are_left_alone(engine, tmp_path):
    folder, model = engine
    source = folder / "bad.mcap"
    for number, expected in enumerate([NODE, f"{NODE}_check", f"{NODE}_check_2"]):
        copy = tmp_path / f"{number}.mcap"
        verdicts, made = check(model, source, copy)
        assert made.topics == expected and bool(made.notes) == (expected != NODE)
        same_verdicts(model, verdicts, copy, expected)
        assert held(copy, without=[f"{expected}/"]).messages == held(source).messages
        source = copy


def test_dropped_messages_get_flags_without_a_verdict(engine, tmp_path):
    """As live: something is said of every clock message."""
    folder, model = engine
    original = held(folder / "run.mcap").messages
    topics = [Topic(name, "sensor_msgs/msg/JointState") for name in ("/engine/state", "/engine/control")]
    messages = []
    for k, (channel, _, log, _, data) in enumerate(original):
        messages.append(Message(channel[0], log, data, log))
        if k in (0, 40, 41):
            messages.append(Message(channel[0], log, data, log))  # an equal stamp
    write(topics, messages).save(tmp_path / "in.mcap")
    verdicts, made = check(model, tmp_path / "in.mcap", tmp_path / "out.mcap")
    dropped = verdicts.transient.counters["equal stamp"]
    assert dropped == 2 and made.verdicts == len(verdicts.transient) + dropped
    found = same_verdicts(model, verdicts, tmp_path / "out.mcap")
    assert np.isnan(found["flags"][1][1].position).all() and stamp(found["flags"][1][1]) == verdicts.transient.t_ns[0]
    assert len(found["violation"]) == made.verdicts and len(found["lower"]) == int(verdicts.judged.sum())


def test_statistics_of_the_alarm_are_in_the_copy(engine, tmp_path):
    folder, model = engine
    model = model.replace(alarm=[AlarmRule(2, 3), StatisticRule("energy", 0.5, 0.5)])
    verdicts, _ = check(model, folder / "bad.mcap", tmp_path / "out.mcap")
    with AnyReader([tmp_path / "out.mcap"], default_typestore=None) as reader:
        (topic,) = (c for c in reader.connections if c.topic == f"{NODE}/statistics")
        found = [reader.deserialize(data, topic.msgtype) for _, _, data in reader.messages([topic])]
    assert [tuple(m.name) for m in found] == [tuple(f"energy/{name}" for name in model.state_names)] * len(found)
    rows = np.array([m.position for m in found])
    assert rows.tobytes() == verdicts.statistics[verdicts.judged].tobytes() and (np.abs(rows) > 1).any()


# --- the command ------------------------------------------------------------------------------------------------


def test_the_command_writes_and_says_so(engine, tmp_path, cli):
    folder, model = engine
    model_file, bad = str(folder / "m.model.json"), str(folder / "bad.mcap")
    said = cli("check", model_file, bad, "--write", tmp_path / "out.mcap", status=1).out
    assert f"{NODE} written to {tmp_path / 'out.mcap'}" in said
    same_recording(bad, tmp_path / "out.mcap")
    # a folder for several; the alarm rule of the command line is what is told
    rule = ["--violations", 250, "--window", 250]
    both = [bad, str(folder / "run.mcap")]
    said = cli.json("check", model_file, *both, "--write", tmp_path / "all", *rule)["recordings"]
    assert [Path(r["written"]["file"]).name for r in said] == ["bad_annotated.mcap", "run_annotated.mcap"]
    (bag,) = group_recordings([bad])
    (second,) = group_recordings([shutil.copy(bad, tmp_path / "bad_2.mcap")])
    names = [path.name for path in targets(tmp_path / "new", [bag, second, bag])]  # the last as of another folder
    assert names == ["bad_annotated.mcap", "bad_2_annotated.mcap", "bad_3_annotated.mcap"]
    found = by_rosbags(tmp_path / "all" / "bad_annotated.mcap")
    assert not any(m.data for _, m in found["violation"]) and len(found["violation"]) == 300
    with open(tmp_path / "all" / "bad_annotated.mcap", "rb") as stream:
        (about,) = [m.metadata for m in make_reader(stream).iter_metadata() if m.name == METADATA]
    assert about["alarm"] == "250 of 250, margin 1.0" and about["model"] == "m.model.json"
    assert len(about["model_sha256"]) == 64 and json.loads(about["states"])[0]["name"] == "fan"


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError, BagError("x: gone")])
def test_nothing_is_left_of_a_copy_that_did_not_get_whole(engine, tmp_path, error):
    folder, model = engine

    def interrupted(steps, total):
        for number, step in enumerate(steps):
            if number == 0:
                raise error
            yield step

    with pytest.raises(error if isinstance(error, type) else type(error)):
        check(model, folder / "bad.mcap", tmp_path / "out.mcap", progress=interrupted)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_one_sentence(engine, tmp_path):
    folder, model = engine
    limit = (
        "import resource, signal, sys; signal.signal(signal.SIGXFSZ, signal.SIG_IGN); "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000)); "
        "from uncertain_lti.cli.main import main; sys.exit(main(sys.argv[1:]))"
    )
    source = rewritten(folder / "bad.mcap", tmp_path / "in.mcap")
    arguments = ["check", str(folder / "m.model.json"), str(source), "--write", str(tmp_path / "out" / "")]
    done = subprocess.run([sys.executable, "-c", limit, *arguments], capture_output=True, text=True)
    assert done.returncode == 2 and "cannot be written" in done.stderr and "Traceback" not in done.stderr
    assert not list((tmp_path / "out").iterdir())


def test_memory_does_not_grow_with_the_recording(engine, tmp_path):
    """A camera beside the states: 75 MB of messages."""
    folder, model = engine
    with open(folder / "bad.mcap", "rb") as small, open(tmp_path / "big.mcap", "wb") as out:
        writer = Writer(out, compression=COMPRESSIONS["none"])
        writer.start(profile="ros2")
        numbers, picture = {"/camera": writer.register_channel("/camera", "raw", 0)}, os.urandom(1 << 20)
        for k, (schema, channel, m) in enumerate(make_reader(small).iter_messages()):
            if channel.topic not in numbers:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                numbers[channel.topic] = writer.register_channel(channel.topic, "cdr", number)
            writer.add_message(numbers[channel.topic], m.log_time, m.data, m.publish_time)
            if k % 8 == 0:
                writer.add_message(numbers["/camera"], m.log_time, picture, m.publish_time)
        writer.finish()
    with bounded(seconds=300, memory=30_000_000):
        check(model, tmp_path / "big.mcap", tmp_path / "out.mcap")
    assert (tmp_path / "out.mcap").stat().st_size > (tmp_path / "big.mcap").stat().st_size > 75_000_000
