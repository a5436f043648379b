# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""rosbag2 databases and ROS 1 bags: what they give is what the same data in MCAP gives, and damage is a sentence."""

import os
import random
import re
import shutil
import sqlite3
from contextlib import closing

import pytest
from engine_bag import SIGNALS, engine_bag
from processes import bounded
from refusals import refuses
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from uncertain_lti import read_transients
from uncertain_lti.base.errors import BagError
from uncertain_lti.cli.main import main
from uncertain_lti.recordings.bag import Bag
from uncertain_lti.recordings.formats import group_recordings
from uncertain_lti.recordings.message_types import define
from uncertain_lti.sampling.reading import check_paths
from uncertain_lti.signals.signal_map import SignalMap

JAZZY = get_typestore(Stores.ROS2_JAZZY)
NOETIC = get_typestore(Stores.ROS1_NOETIC)


def copied(source, writer, store, converted=lambda data, definition: data):
    """The messages of a recording through another writer."""
    with writer:
        connections = {}
        for raw in Bag(source).raw_messages():
            kind = raw.channel.definition.type_name
            if raw.topic not in connections:
                connections[raw.topic] = writer.add_connection(raw.topic, kind, typestore=store)
            writer.write(connections[raw.topic], raw.log_time_ns, converted(raw.data, raw.channel.definition))


def to_database(source, folder):
    copied(source, Rosbag2Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3), JAZZY)
    return next(folder.glob("*.db3"))


def to_ros1(source, path, compression=None, chunk=1 << 18):
    writer = Ros1Writer(path)
    if compression:
        writer.set_compression(Ros1Writer.CompressionFormat[compression])
    writer.chunk_threshold = chunk

    def converted(data, definition):
        whole = bytes(JAZZY.serialize_cdr(definition.decode(data), definition.type_name))
        return JAZZY.cdr_to_ros1(whole, definition.type_name)

    copied(source, writer, NOETIC, converted)
    return path


@pytest.fixture(scope="module")
def converted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("converted")
    (folder / "signals.yaml").write_text(SIGNALS)
    made = {"signals": folder / "signals.yaml", "mcap": engine_bag(folder / "run.mcap", 400)}
    made["db3"] = to_database(made["mcap"], folder / "run")
    made["folder"] = folder / "run"
    made["old db3"] = folder / "old.db3"  # as recorders before Iron wrote it
    shutil.copy(made["db3"], made["old db3"])
    with closing(sqlite3.connect(made["old db3"])) as database:
        database.execute("DROP TABLE message_definitions")
        database.execute("UPDATE schema SET ros_distro = 'humble', schema_version = 3")
        database.commit()
    made["ROS 1"] = to_ros1(made["mcap"], folder / "plain.bag")
    made["ROS 1 bz2"] = to_ros1(made["mcap"], folder / "bz2.bag", "BZ2", 1 << 16)
    made["ROS 1 lz4"] = to_ros1(made["mcap"], folder / "lz4.bag", "LZ4", 1 << 14)
    return made


EVERY = ("db3", "folder", "old db3", "ROS 1", "ROS 1 bz2", "ROS 1 lz4")


@pytest.mark.parametrize("kind", EVERY)
def test_the_same_bits_as_in_mcap(converted, kind):
    (expected,) = read_transients(converted["mcap"], converted["signals"])
    (read,) = read_transients(converted[kind], converted["signals"])
    assert len(read) == 400 and read.t_ns.tobytes() == expected.t_ns.tobytes()
    assert read.x.tobytes() == expected.x.tobytes() and read.u.tobytes() == expected.u.tobytes()
    note = "the file does not hold the definitions of all its types; those of ROS 2 Humble are used"
    assert [n.partition(": ")[2] for n in read.notes] == [note] * (kind == "old db3")
    bag, signals = Bag(converted[kind]), SignalMap.load(converted["signals"])
    columns = bag.columns(signals.topics, check_paths(bag, signals))
    assert columns.alone <= 4 < len(columns.topic)  # the rest was read in blocks, by its plan


def test_a_sourced_workspace_has_the_definitions_that_an_old_database_lacks(converted, tmp_path, monkeypatch):
    """A command of a package that is no part of ROS 2, such as ackermann_msgs, was lost, and with it the controls."""
    path, share = tmp_path / "run.db3", tmp_path / "install" / "share" / "car_msgs" / "msg"
    shutil.copy(converted["old db3"], path)
    with closing(sqlite3.connect(path)) as database:
        database.execute("UPDATE topics SET type = 'car_msgs/msg/Wheels' WHERE name = '/engine/state'")
        database.commit()
    assert "source the workspace that has its package" in Bag(path).topics["/engine/state"].reason
    share.mkdir(parents=True)
    (share / "Wheels.msg").write_text("# of a car\nstd_msgs/Header header\nstring[] name\nRest rest  # as JointState\n")
    (share / "Rest.msg").write_text("float64[] position\nfloat64[] velocity\nfloat64[] effort\n")
    monkeypatch.setenv("AMENT_PREFIX_PATH", os.pathsep.join([str(tmp_path), str(tmp_path / "install")]))
    bag = Bag(path)
    assert any("and the workspaces that are sourced here are used" in note for note in bag.warnings), bag.warnings
    every = zip(bag.messages(["/engine/state"]), Bag(converted["mcap"]).messages(["/engine/state"]), strict=True)
    for (_, time, mine), (_, expected, theirs) in every:
        assert time == expected and mine.rest.position.tobytes() == theirs.position.tobytes()
    define.cache_clear()
    assert define("car_msgs/msg/Wheels", "ros2msg", b"").note.endswith("that of a sourced workspace is used")
    assert "nor does ROS 2" in define("car_msgs/msg/Motors", "ros2msg", b"").reason
    (share / "Motors.msg").write_text("Wheels front\nLost rear\n")
    define.cache_clear()
    assert "car_msgs/msg/Lost is used and not defined" in define("car_msgs/msg/Motors", "ros2msg", b"").reason


def test_an_annotated_copy_is_that_of_the_mcap(converted, tmp_path, capsys):
    """Without a message that is none, which is counted."""
    model = str(tmp_path / "m.model.json")
    command = ["fit", str(converted["mcap"]), "--signals", str(converted["signals"]), "--output", model, "-q"]
    assert main([*command, "--additive", "noise", "--alarm", "containment"]) == 0
    copies = {}
    for kind in ("mcap", "db3", "ROS 1 lz4"):
        assert main(["check", model, str(converted[kind]), "--write", str(tmp_path / f"{kind}.mcap"), "-q"]) == 0
        copies[kind] = Bag(tmp_path / f"{kind}.mcap")
    expected = copies.pop("mcap")
    below = [t for t in expected.topics if t.startswith("/envelope_monitor")]
    assert {"flags", "lower", "upper", "violation", "reason"} < {t.rsplit("/", 1)[1] for t in below}
    for copy in copies.values():
        assert {t: i.count for t, i in copy.topics.items()} == {t: i.count for t, i in expected.topics.items()}
        for mine, theirs in zip(copy.raw_messages(below), expected.raw_messages(below), strict=True):
            assert (mine.log_time_ns, mine.data) == (theirs.log_time_ns, theirs.data)
        for mine, theirs in zip(copy.messages(["/engine/state"]), expected.messages(["/engine/state"]), strict=True):
            assert mine[1] == theirs[1] and mine[2].position.tobytes() == theirs[2].position.tobytes()
    empty = shutil.copy(converted["db3"], tmp_path / "empty.db3")
    with closing(sqlite3.connect(empty)) as database:
        database.execute("UPDATE messages SET data = x'' WHERE id = (SELECT MAX(id) FROM messages)")
        database.commit()
    assert main(["check", model, str(empty), "--write", str(tmp_path / "empty.mcap")]) == 0
    assert "1 message that cannot be converted to CDR not copied" in capsys.readouterr().err


def test_parts_of_a_split_database_are_one_recording(converted, tmp_path):
    parts = [tmp_path / "run_0.db3", tmp_path / "run_1.db3"]
    for number, part in enumerate(parts):
        shutil.copy(converted["db3"], part)
        with closing(sqlite3.connect(part)) as database:
            (middle,) = database.execute("SELECT timestamp FROM messages ORDER BY id LIMIT 1 OFFSET 300").fetchone()
            database.execute(f"DELETE FROM messages WHERE timestamp {'>=' if number == 0 else '<'} ?", (middle,))
            database.commit()
    (bag,) = group_recordings(parts)
    assert [p.name for p in bag.parts] == ["run_0.db3", "run_1.db3"]
    assert [len(t) for t in read_transients(parts, converted["signals"])] == [400]
    assert Bag(tmp_path).parts == tuple(parts)


def test_the_definitions_in_the_file_come_first(tmp_path):
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg("float64 thrust\nuint8 mode", "own_msgs/msg/Command"))
    own = store.types["own_msgs/msg/Command"]
    with Rosbag2Writer(tmp_path / "a", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/c", "own_msgs/msg/Command", typestore=store)
        writer.write(connection, 5, store.serialize_cdr(own(2.5, 3), "own_msgs/msg/Command"))
    with Ros1Writer(tmp_path / "a.bag") as writer:
        connection = writer.add_connection("/c", "own_msgs/msg/Command", typestore=store)
        writer.write(connection, 5, store.serialize_ros1(own(2.5, 3), "own_msgs/msg/Command"))
    for path in (tmp_path / "a", tmp_path / "a.bag"):
        assert [(t, m.thrust, m.mode) for _, t, m in Bag(path).messages(["/c"])] == [(5, 2.5, 3)]
        assert Bag(path).topics["/c"].type == "own_msgs/msg/Command"


def test_a_topic_of_ros_1_without_its_slash_is_the_same_topic(tmp_path):
    """`rosbag record scan` writes `scan`, `rosbag record -a` writes `/scan`."""
    store = get_typestore(Stores.ROS1_NOETIC)
    with Ros1Writer(tmp_path / "a.bag") as writer:
        for topic in ("scan", "/cmd"):
            connection = writer.add_connection(topic, "std_msgs/msg/Float64", typestore=store)
            writer.write(
                connection, 5, store.serialize_ros1(store.types["std_msgs/msg/Float64"](2.5), connection.msgtype)
            )
    assert set(Bag(tmp_path / "a.bag").topics) == {"/scan", "/cmd"}
    assert [m.data for _, _, m in Bag(tmp_path / "a.bag").messages(["/scan"])] == [2.5]


# --- damaged and hostile --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["db3", "ROS 1"])
def test_a_file_without_its_end_is_refused_with_the_remedy(converted, kind, tmp_path):
    data = converted[kind].read_bytes()
    path = tmp_path / f"cut{converted[kind].suffix}"
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(BagError, match=r"cut or damaged .*; copy it again, or mend it with `(sqlite3|rosbag)") as error:
        Bag(path)
    assert str(error.value).count("\n") == 0


def test_what_a_file_says_of_itself_is_not_believed_in_silence(converted, tmp_path):
    data = bytearray(converted["ROS 1 lz4"].read_bytes())
    data[data.index(b"chunk_count=") + len(b"chunk_count=")] -= 1
    (tmp_path / "fewer.bag").write_bytes(data)
    assert any(re.search(r"holds \d+ chunks, and its index lists \d+", w) for w in Bag(tmp_path / "fewer.bag").warnings)
    path = tmp_path / "a.db3"
    shutil.copy(converted["db3"], path)
    path.with_name("a.db3-wal").write_bytes(b"x")  # not yet written to the database
    assert "a.db3-wal and are not read" in Bag(path).warnings[0]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.db3", "a.db3-wal", "fewer.bag"], "nothing is left behind"


def test_messages_before_damage_count_and_the_rest_is_said(converted, tmp_path):
    data = bytearray(converted["ROS 1 bz2"].read_bytes())
    at = data.rindex(b"BZh9")  # the last chunk
    data[at + 500 : at + 510] = bytes(10)
    path = tmp_path / "hurt.bag"
    path.write_bytes(data)
    (warning,) = Bag(path).warnings
    assert re.search(r"is cut or damaged .*; \d+ of [\d ]+ messages before that count", warning)
    (cut,) = read_transients(path, converted["signals"])
    (whole,) = read_transients(converted["mcap"], converted["signals"])
    assert 100 < len(cut) < len(whole) and cut.x[:-1].tobytes() == whole.x[: len(cut) - 1].tobytes()


def test_a_ros_1_bag_whose_recorder_was_killed(converted, tmp_path):
    """The header says that there is no index, and nothing is behind the last chunk."""
    data = bytearray(converted["ROS 1"].read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    begin = int.from_bytes(data[at : at + 8], "little")
    data[at : at + 8] = bytes(8)
    path = tmp_path / "active.bag"
    path.write_bytes(data[:begin])
    refuses(BagError, rf"not indexed.*mend it with `rosbag reindex {re.escape(str(path))}`", Bag, path)


def database_of(path, *statements):
    with closing(sqlite3.connect(path)) as database:
        for statement in statements:
            database.execute(statement)
        database.commit()
    return path


TOPICS = "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)"
MESSAGES = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"


def test_databases_that_are_no_recording(tmp_path):
    endless = "CREATE VIEW messages AS WITH RECURSIVE r(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM r) SELECT id, 1 AS topic_id, 1 AS timestamp, x'00' AS data FROM r"  # noqa: E501
    broken = ["CREATE TABLE cookies(id)"], [TOPICS, endless], [TOPICS, "CREATE TABLE messages(id, payload)"]
    for number, statements in enumerate(broken):
        path = database_of(tmp_path / f"{number}.db3", *statements)
        refuses(BagError, r"\d\.db3: is cut or damaged or no recording of ROS 2", Bag, path)


def test_rows_that_are_no_messages_are_left_out(tmp_path):
    one = "x'00010000000000000000f03f'"
    odd = [f"1, -5, {one}", f"7, 5, {one}", f"1, 'soon', {one}", "1, 6, NULL", "1, 7, 'text'"]
    odd += ["1, 8, x'0001000000000000000000000000f03f'", "1, 9, x'000100000000'"]
    made = [TOPICS, MESSAGES, "INSERT INTO topics VALUES (1, '/a', 'std_msgs/msg/Float64', 'cdr')"]
    made += [f"INSERT INTO messages VALUES ({number}, {row})" for number, row in enumerate(odd, 1)]
    path = database_of(tmp_path / "odd.db3", *made)
    bag = Bag(path)
    assert bag.topics["/a"].count == 2
    assert [t for _, t, _ in bag.messages(["/a"])] == []  # cut, and longer than its type
    assert any("its index counts 7 messages, and 2 could be read" in w for w in bag.warnings)
    assert any("2 messages left out that cannot be decoded" in w for w in bag.warnings)


def test_an_index_of_a_database_that_lacks_rows_is_not_believed_in_silence(converted, tmp_path):
    """Two bits of one entry: the row is there, and whoever reads in order of time may miss it."""
    path = tmp_path / "hidden.db3"
    shutil.copy(converted["db3"], path)
    with closing(sqlite3.connect(path)) as database:
        (page,) = database.execute("SELECT rootpage FROM sqlite_schema WHERE name = 'timestamp_idx'").fetchone()
        (size,) = database.execute("PRAGMA page_size").fetchone()
    data = bytearray(path.read_bytes())
    data[page * size - 9] ^= 0x10  # of a time in the last bytes of that page, which hold its first entry
    path.write_bytes(data)
    bag = Bag(path)
    assert any(re.search(r"hidden\.db3: is damaged \(.*timestamp_idx", w) for w in bag.warnings)


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a.bag", b"#ROSBAG V1.2\n" + bytes(100), "of another version than 2.0"),
        ("a.bag", b"#ROSBAG V2.0\n", "is cut or damaged or no ROS 1 bag"),
        ("a.bag", b"#ROSBAG V2.0\n" + bytes(1 << 20), "is cut or damaged or no ROS 1 bag"),
        ("a.db3", b"SQLite format 3\0" + bytes(5000), "is cut or damaged or no recording"),
    ],
)
def test_other_versions_and_no_space_for_nothing(name, data, words, tmp_path):
    (tmp_path / name).write_bytes(data)
    refuses(BagError, words, Bag, tmp_path / name)


def test_elements_without_bytes_do_not_take_for_ever(tmp_path):
    """A few bytes state 2^31 elements of a type that has no field."""
    store = get_typestore(Stores.EMPTY)
    text = f"std_msgs/Empty[] nothing\n{'=' * 80}\nMSG: std_msgs/Empty\n"
    store.register(get_types_from_msg(text, "own/msg/Many"))
    with Ros1Writer(tmp_path / "a.bag") as writer:
        connection = writer.add_connection("/c", "own/msg/Many", msgdef=text, md5sum="0")
        writer.write(connection, 5, (2**31).to_bytes(4, "little"))
    with bounded(seconds=5):
        bag = Bag(tmp_path / "a.bag")
        assert list(bag.messages(["/c"])) == [] and "cannot be decoded" in bag.warnings[-1]


@pytest.mark.parametrize("kind", ["db3", "ROS 1 lz4"])
def test_a_flipped_bit_loses_no_message_in_silence(converted, kind, tmp_path):
    data = converted[kind].read_bytes()
    whole = {topic: info.count for topic, info in Bag(converted[kind]).topics.items()}
    path = tmp_path / converted[kind].name
    rng = random.Random(5)
    for _ in range(2):
        hurt = bytearray(data)
        where = rng.randrange(len(hurt)) if rng.random() < 0.5 else len(hurt) - 1 - rng.randrange(6000)
        hurt[where] ^= 1 << rng.randrange(8)
        path.write_bytes(hurt)
        try:
            bag = Bag(path)
            number = sum(1 for _ in bag.raw_messages())
        except BagError as error:
            assert str(path) in str(error) and "\n" not in str(error)
        else:
            assert bag.warnings or number == sum(whole.values())
