# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Recordings into transients: synthetic ones against the rules worked out naively, real ones against a plain reader."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_writer import (
    JAZZY,
    Layout,
    Message,
    Topic,
    cdr,
    float64,
    joint_state,
    message,
    metadata_yaml,
    ramp,
    write,
    write_folder,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from refusals import refuses
from steps import holds
from test_sampler import Reference, cases

from uncertain_lti.base.errors import BagError, SignalError
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.proposal.init import propose
from uncertain_lti.sampling.reading import load_signals, loses_much, read_as_fitted, read_transients, unused
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.signal_map import Signal, SignalMap

NAN = math.nan
MS = 1_000_000  # ns
JOINT_STATE, FLOAT64 = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64"


def save(
    folder: Path,
    topics: Mapping[str, str],
    messages: Sequence[tuple[str, int, bytes]],
    name: str = "run.mcap",
    layout: Layout | None = None,
) -> Path:
    """A recording of (topic, log time, data)."""
    channels = [Topic(topic, type_name) for topic, type_name in topics.items()]
    sent = [Message(t, at, data, at) for t, at, data in messages]
    return write(channels, sent, layout or Layout()).save(folder / name)


# --- synthetic recordings against the naive reference ---------------------------------------------------------


def by_position(signals: SignalMap) -> SignalMap:
    """The same map reading `position[column]` of a JointState per topic."""
    found = []
    for signal in signals.signals:
        mine = [s.name for s in signals.signals if s.topic == signal.topic]
        path = f"position[{mine.index(signal.name)}]"
        found.append(replace(signal, field=signal.field.replace("data", path), type=JOINT_STATE))
    n = len(signals.states)
    return replace(signals, states=tuple(found[:n]), controls=tuple(found[n:]))


def same(transient: Transient, reference: Reference) -> None:
    """The transient holds what the reference says of every clock message, to the last bit."""
    holds(transient, [step for decided in reference.steps() for step in decided])
    assert +transient.counters == +reference.counters


@settings(max_examples=50)
@given(cases() | cases(tame=True), st.sampled_from(["none", "lz4", "zstd"]))
def test_recordings_become_what_the_rules_say(tmp_path_factory, case, compression):
    signals, messages = case
    signals = by_position(signals)
    if len({s.topic for s in signals.states}) == 1:
        signals = replace(signals, max_skew=None)  # else an error: it would limit nothing
    sent = [(m.topic, m.arrival, joint_state(max(m.stamp or 0, 0), m.values)) for m in messages]
    types, layout = dict.fromkeys(signals.topics, JOINT_STATE), Layout(compression, chunk_size=300)
    path = save(tmp_path_factory.getbasetemp(), types, sent, "any.mcap", layout)
    arrived = sorted(messages, key=lambda m: m.arrival)  # log time, then file order
    reference = Reference(signals, arrived, forgets=True)
    silent = [t for t in signals.topics if not any(m.topic == t for m in messages)]
    stamped = {m.topic for m in messages if m.stamp and m.stamp > 0}
    unstamped = [t for t in signals.topics if signals.time[t] == "header" and t not in stamped]
    instants = [s.instant for s in reference.samples] + [i for _, i in reference.dropped.values()]
    if silent:
        refuses(BagError, f"{path}: {silent[0]} has no message", read_transients, path, signals)
    elif unstamped:
        with pytest.raises(SignalError, match=f"topics: {unstamped[0]}: time is header, and no message of a rec"):
            read_transients(path, signals)
    elif len(set(instants)) < 2 or not any(s.dt > 0 for s in reference.samples):
        try:
            (transient,) = read_transients(path, signals)
        except SignalError as error:
            assert "/c: " in str(error) and "without a forward step in time" in str(error)
        else:
            same(transient, reference)
    else:
        (transient,) = read_transients([path], signals)
        same(transient, reference)
        assert transient.signals == signals
        assert transient.sources == (str(path),) and transient.name == str(path)


def test_stamps_that_one_recording_lacks_are_used_of_none(tmp_path):
    """All samples of the second were dropped, and its controls at the arrival raised ValueError."""
    signals = SignalMap(states=(Signal("x", "/x", "position[0]"),), controls=(Signal("u", "/u", "position[0]"),))
    for name, stamped in ("a", 1), ("b", 0):
        sent = [
            (t, 10**7 * k + 1, joint_state(10**7 * k * stamped, [k + stamped]))
            for k in range(1, 9)
            for t in ("/x", "/u")
        ]
        save(tmp_path, dict.fromkeys(("/x", "/u"), JOINT_STATE), sent, f"{name}.mcap")
    runs = read_transients(paths := sorted(tmp_path.iterdir()), signals)
    assert [len(run) for run in runs] == [8, 8] and runs[0].signals.time == {"/x": "log", "/u": "log"}
    by_stamp = replace(signals, time={"/x": "header"})
    refuses(SignalError, "time is header, and no message of a recording has", read_transients, paths, by_stamp)


# --- real recordings against a plain reader -------------------------------------------------------------------

VICON = "/vicon/Group466CF/Group466CF/pose"


def roll(q: Any) -> float:
    w, x, y, z = q.w, q.x, q.y, q.z
    return math.atan2(2.0 * (w * x + y * z), x * x + y * y + z * z + w * w - 2.0 * (x * x + y * y))


READ: dict[str, tuple[str, str, Any, str, Any, float | None]] = {
    # signals file: clock, state values, control topic, control values, max_hold
    "go2_joint": (
        "/go2/joint_states", lambda m: [m.position[m.name.index("j0")], m.velocity[m.name.index("j0")]],
        "/go2/joint_command", lambda m: [m.position[m.name.index("j0")]], 0.05,
    ),
    "micro_gas_turbine": ("/mgt/el_power", lambda m: [m.data], "/mgt/input_voltage", lambda m: [m.data], 5.0),
    "hunter_se": ("/hunter/twist", lambda m: [m.twist.linear.x], "/hunter/cmd", lambda m: [m.vector.x], None),
    "neato": (
        "/odom", lambda m: [m.twist.twist.linear.x, m.twist.twist.angular.z],
        "/cmd_vel", lambda m: [m.linear.x, m.angular.z], None,
    ),
    "crazyflie_vicon": (VICON, lambda m: [roll(m.pose.orientation)], "/cf_controll", lambda m: [m.position.x], 0.3),
    "crazyflie_estimate": (
        "/cf_logpos", lambda m: [roll(m.orientation)],
        "/cf_controll", lambda m: [m.position.x], 0.3,
    ),
}  # fmt: skip

# Samples, segments and usable transitions of each recording; the last without a delay that a signals file may set.
RECORDINGS = [
    ("go2/test_3.mcap", "go2_joint", 10449, 6, 6541),
    ("micro_gas_turbine/ex_24.mcap", "micro_gas_turbine", 9023, 3, 9020),
    ("hunter_se/straight_even_t_0_2_run_01.mcap", "hunter_se", 2515, 1, 2514),
    ("neato/person_follower.mcap", "neato", 149, 1, 131),
    ("crazyflie/yx3bag_0.mcap", "crazyflie_vicon", 363, 5, 355),
    ("crazyflie/rollbag_0.mcap", "crazyflie_estimate", 315, 5, 310),
]


def plain_read(path: Path, topic: str, values: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Log times, stamps (-1 without) and values of a topic, by the mcap library and Jazzy's definitions."""
    rows = []
    with open(path, "rb") as stream:
        for schema, _, record in make_reader(stream).iter_messages([topic], log_time_order=False):
            decoded = JAZZY.deserialize_cdr(record.data, schema.name)
            stamp = decoded.header.stamp if hasattr(decoded, "header") else None
            rows.append((record.log_time, stamp.sec * 10**9 + stamp.nanosec if stamp else -1, *values(decoded)))
    rows.sort(key=lambda row: row[0])
    times = np.array([row[:2] for row in rows], dtype=np.int64)
    return times[:, 0], times[:, 1], np.array([row[2:] for row in rows], dtype=float)


def without_delay(path: Path) -> SignalMap:
    signals = SignalMap.load(path)
    return replace(signals, controls=tuple(replace(c, delay=0) for c in signals.controls))


@pytest.mark.parametrize(("file", "map_name", "samples", "segments", "usable"), RECORDINGS)
def test_real_recordings_read_as_a_plain_reader_reads_them(
    recordings: Path, signals_folder: Path, file: str, map_name: str, samples: int, segments: int, usable: int
) -> None:
    path = recordings / file
    (transient,) = read_transients(path, without_delay(signals_folder / f"{map_name}.yaml"))
    assert (len(transient), transient.segments, int(transient.usable.sum())) == (samples, segments, usable)

    clock, state, control, command, max_hold = READ[map_name]
    arrival, stamp, x = plain_read(path, clock, state)
    by_stamp = bool((stamp > 0).all())
    t = stamp if by_stamp else arrival
    assert (np.diff(t) > 0).all()  # nothing is dropped in these recordings
    assert transient.t_ns.tolist() == t.tolist()
    if map_name.startswith("crazyflie"):  # within a segment, on the branch nearest to the sample before
        turns = np.round((transient.x[:, 0] - x[:, 0]) / (2 * math.pi))
        np.testing.assert_array_equal(transient.x[:, 0], x[:, 0] + 2 * math.pi * turns)
        inside = np.diff(transient.segment) == 0
        assert (np.abs(np.diff(transient.x[:, 0])[inside]) <= math.pi).all()
    else:
        np.testing.assert_array_equal(transient.x, x)

    max_gap = 2.5 * np.median(np.diff(t))
    assert transient.max_gap == pytest.approx(max_gap * 1e-9, abs=2e-9)
    assert np.flatnonzero(np.diff(transient.segment)).tolist() == np.flatnonzero(np.diff(t) > max_gap).tolist()

    came, sent, u = plain_read(path, control, command)
    commands_by_stamp = by_stamp and bool((sent > 0).all())
    instants, wanted = (sent, t) if commands_by_stamp else (came, arrival)
    for k in range(len(t) - 1):
        there = (came <= arrival[k + 1]) & (instants <= wanted[k])
        if commands_by_stamp and (came == arrival[k + 1]).any():
            continue  # which of the two came first, the file's order tells
        expected = np.full(u.shape[1], NAN)
        if there.any():
            latest = np.flatnonzero(there & (instants == instants[there].max()))[-1]
            if max_hold is None or wanted[k] - instants[latest] <= round(max_hold * 1e9):
                expected = u[latest]
        np.testing.assert_array_equal(transient.u[k], expected, err_msg=f"u of sample {k}")


# --- what a signals file leaves open --------------------------------------------------------------------------


def float_bag(folder: Path, name: str, state: Sequence[int], control: Sequence[int]) -> Path:
    messages = sorted([*ramp("/x", state), *ramp("/u", control)], key=lambda m: m.log_time)
    return write([Topic("/x"), Topic("/u")], messages).save(folder / name)


XU = SignalMap((Signal("x", "/x", "data"),), (Signal("u", "/u", "data"),))


def test_recordings_are_resolved_together(tmp_path: Path) -> None:
    """One clock and one max_gap for all, from all steps pooled; each recording starts on its own."""
    short = float_bag(tmp_path, "a.mcap", range(0, 400 * MS, 100 * MS), range(0, 400 * MS, 50 * MS))
    long = float_bag(tmp_path, "b.mcap", range(0, 10_000 * MS, 40 * MS), range(0, 10_000 * MS, 50 * MS))
    transients = read_transients([short, long], XU)
    assert [t.name for t in transients] == [str(short), str(long)]
    assert [t.max_gap for t in transients] == [pytest.approx(0.1), pytest.approx(0.1)]
    assert transients[0].signals == transients[1].signals
    alone = read_transients(short, XU)[0]
    assert alone.max_gap == pytest.approx(0.25)
    np.testing.assert_array_equal(alone.x, transients[0].x)


@pytest.mark.parametrize(("zero", "source"), [(0, "header"), (4, "header"), (5, "log"), (10, "log")])
def test_stamps_count_where_most_messages_have_one(tmp_path: Path, zero: int, source: str) -> None:
    data = [joint_state(0 if k < zero else (k + 1) * MS, [k]) for k in range(10)]
    path = save(tmp_path, {"/x": JOINT_STATE}, [("/x", (k + 1) * 3 * MS, d) for k, d in enumerate(data)])
    (transient,) = read_transients(path, SignalMap((Signal("x", "/x", "position[0]"),)))
    assert transient.signals is not None and transient.signals.time == {"/x": source}
    assert transient.dt.tolist() == [MS * 1e-9 if source == "header" else 3 * MS * 1e-9] * (len(transient) - 1)
    assert transient.counters["no stamp"] == (zero if source == "header" else 0)
    said = SignalMap((Signal("x", "/x", "position[0]"),), time={"/x": "log"})
    assert read_transients(path, said)[0].dt.tolist() == [3 * MS * 1e-9] * 9


def test_auto_is_resolved_once_over_all_recordings_and_told(tmp_path: Path) -> None:
    def bag(name: str, levels: Sequence[float]) -> Path:
        data = [("/x", k * 10 * MS, float64(v)) for k, v in enumerate(levels)]
        return save(tmp_path, {"/x": FLOAT64}, data, name)

    one = bag("a.mcap", [2.0] * 20 + list(np.linspace(2, 9, 9)) + [9.0] * 40)
    two = bag("b.mcap", [-11.0] * 15 + [0.0] * 5)
    signals = SignalMap((Signal("x", "/x", "data", steady="auto", scale="auto"),))
    transients = read_transients([one, two], signals)
    for transient in transients:
        assert transient.signals is not None
        assert (transient.signals.states[0].steady, transient.signals.states[0].scale) == (9.0, 11.0)
    assert [len(t.notes) for t in transients] == [1, 0]
    assert "still samples" in transients[0].notes[0] and "x 9 (scale 11)" in transients[0].notes[0]


def test_an_angle_starts_on_the_branch_nearest_to_a_steady_value_that_was_resolved(tmp_path: Path) -> None:
    """Still at 3 rad, of which one recording starts just beyond the seam: both end up on one branch."""
    angles = [3.0] * 30 + list(np.linspace(3.0, 3.6, 13))
    wrapped = [math.remainder(a, 2 * math.pi) for a in angles]
    data = [("/x", k * 10 * MS, float64(v)) for k, v in enumerate(wrapped)]
    one = save(tmp_path, {"/x": FLOAT64}, data, "a.mcap")
    two = save(tmp_path, {"/x": FLOAT64}, [(t, at, d) for t, at, d in data[-5:]], "b.mcap")
    signals = SignalMap((Signal("x", "/x", "unwrap(data)", steady="auto"),))
    first, second = read_transients([one, two], signals)
    np.testing.assert_allclose(first.x[:, 0], angles, atol=1e-12)
    np.testing.assert_allclose(second.x[:, 0], angles[-5:], atol=1e-12)


# --- files ---------------------------------------------------------------------------------------------------


def test_parts_of_a_split_bag_are_one_run(tmp_path: Path) -> None:
    whole = ramp("/x", range(0, 3000 * MS, 10 * MS))
    parts = {f"run_{i}.mcap": write([Topic("/x")], whole[100 * i : 100 * (i + 1)]) for i in range(3)}
    folder = write_folder(tmp_path / "run", parts, metadata_yaml(parts))
    signals = SignalMap((Signal("x", "/x", "data"),))
    (transient,) = read_transients(folder, signals)
    assert len(transient) == 300 and transient.segments == 1
    assert transient.sources == tuple(str(folder / name) for name in parts)
    (again,) = read_transients(sorted(folder.glob("*.mcap"), reverse=True), signals)
    assert again.t_ns.tolist() == transient.t_ns.tolist()


def test_what_the_reader_has_to_say_goes_with_the_run(tmp_path: Path) -> None:
    file = write([Topic("/x")], ramp("/x", range(0, 3000 * MS, 10 * MS)))
    path = file.save(tmp_path / "cut.mcap", cut=len(file.data) // 2)
    (transient,) = read_transients(path, SignalMap((Signal("x", "/x", "data"),)))
    assert 50 < len(transient) < 300
    assert any(str(path) in note for note in transient.notes)


def test_messages_as_rclpy_serialises_them(tmp_path: Path) -> None:
    """It leaves bytes after empty sequences of doubles; a bag written through rosbag2_py is full of them."""
    serialization = pytest.importorskip("rclpy.serialization", reason="rclpy is not installed")
    from sensor_msgs.msg import JointState

    def encoded(k: int) -> bytes:
        state = JointState(name=["fan"], position=[float(k)])
        state.header.stamp.sec = k + 1
        return bytes(serialization.serialize_message(state))

    path = save(tmp_path, {"/x": JOINT_STATE}, [("/x", k * MS, encoded(k)) for k in range(20)])
    (transient,) = read_transients(path, SignalMap((Signal("x", "/x", "position[fan]"),)))
    assert transient.x[:, 0].tolist() == list(range(20)) and set(transient.dt.tolist()) == {1.0}
    assert not transient.notes


# --- bad input: one sentence that names what is there ---------------------------------------------------------


def joints(folder: Path, values: Sequence[float] = (1.0, 2.0), names: Sequence[str] = ("fan", "core")) -> Path:
    data = [("/x", k * 10 * MS, joint_state((k + 1) * 10 * MS, values, names)) for k in range(20)]
    data += [("/s", k * 10 * MS, cdr("std_msgs/msg/String", data="on")) for k in range(20)]
    types = {"/x": JOINT_STATE, "/s": "std_msgs/msg/String", "/silent": FLOAT64}
    return save(folder, types, data)


@pytest.mark.parametrize(
    ("signal", "words"),
    [
        (("x", "/nope", "data"), "there is no topic /nope; topics there: /s, /silent, /x"),
        (("x", "/silent", "data"), "/silent has no message; record it, or choose another topic or recording"),
        (
            ("x", "/x", "data[0]"),
            r"of /x \(sensor_msgs/msg/JointState\): there is no 'data' .* fields there: header, name",
        ),
        (("x", "/x", "position[hub]"), "there is no 'hub' in the message's names; names there: fan, core"),
        (("x", "/x", "position[9]"), "'position' has 2 elements in the message; elements there: 0 to 1"),
        (("x", "/x", "velocity[fan]"), "'velocity' has no element in the message; choose a field that is filled"),
        (("x", "/s", "data"), "not one number but a string; numeric field paths of /s: none"),
    ],
)
def test_a_signal_that_the_recording_lacks_is_named(signal: tuple[str, str, str], words: str, tmp_path: Path) -> None:
    path = joints(tmp_path)
    sentence = refuses((BagError, SignalError), words, read_transients, path, SignalMap((Signal(*signal),)))
    assert str(path) in sentence or signal[1] in sentence


def test_where_a_signals_file_contradicts_itself_a_misspelt_topic_is_the_cause(tmp_path: Path) -> None:
    path, file = float_bag(tmp_path, "a.mcap", range(0, 100 * MS, 10 * MS), [0]), tmp_path / "signals.yaml"
    for topic, error, words in (
        ("/xx", BagError, "a.mcap: there is no topic /xx .is /x meant"),
        ("/u", SignalError, "clock is /x, which carries no state"),
    ):
        file.write_text(f"clock: /x\nstates: [{{name: x, topic: {topic}, field: data}}]\n")
        assert "--remap" not in refuses(error, words, load_signals, file, [path])


def test_a_name_or_an_index_that_comes_later_is_no_error(tmp_path: Path) -> None:
    late = [("/x", k * 10 * MS, joint_state((k + 1) * 10 * MS, [1.0], ["fan"])) for k in range(3)]
    late += [("/x", k * 10 * MS, joint_state((k + 1) * 10 * MS, [1.0, 7.0], ["fan", "core"])) for k in range(3, 9)]
    path = save(tmp_path, {"/x": JOINT_STATE}, late)
    for field in ("position[core]", "position[1]"):
        (transient,) = read_transients(path, SignalMap((Signal("x", "/x", field),)))
        before = [NAN] * 3 * (field == "position[1]")  # where no wanted name stands, another publisher sent it
        np.testing.assert_array_equal(transient.x[:, 0], before + [7.0] * 6)
        assert transient.counters["missing"] == len(before) and transient.usable.sum() == 5
        assert unused(transient) == ["3 missing x"] * bool(before)


def test_values_that_are_nan_or_infinite_cost_the_transitions_that_need_them(tmp_path: Path) -> None:
    values = [0.0, 1.0, NAN, 3.0, math.inf, 5.0, 6.0, 7.0]
    path = save(tmp_path, {"/x": FLOAT64}, [("/x", k * 10 * MS, float64(v)) for k, v in enumerate(values)])
    (transient,) = read_transients(path, SignalMap((Signal("x", "/x", "data"),)))
    assert transient.usable.tolist() == [True, False, False, False, False, True, True]
    all_nan = save(tmp_path, {"/x": FLOAT64}, [("/x", k * 10 * MS, float64(NAN)) for k in range(5)], "nan.mcap")
    (transient,) = read_transients(all_nan, SignalMap((Signal("x", "/x", "data", "auto", "auto"),)))
    assert not transient.usable.any()


def test_missing_values_of_others_are_not_told_as_those_of_the_signal_that_lacks_most(tmp_path: Path) -> None:
    """Of 50 transitions of a turbine that lacked a value 20 lacked another one than was named."""
    rows = [(NAN if k in (2, 3, 4) else k, NAN if k == 8 else k) for k in range(12)]
    messages = [("/x", k * 10 * MS, joint_state((k + 1) * 10 * MS, row, ["fan", "core"])) for k, row in enumerate(rows)]
    path = save(tmp_path, {"/x": JOINT_STATE}, messages)
    signals = Signal("fan", "/x", "position[fan]"), Signal("core", "/x", "position[core]")
    (transient,) = read_transients(path, SignalMap(signals))
    assert unused(transient) == ["6 missing fan or others"]


def test_a_dropped_message_and_more_than_one_sample_in_a_hundred_without_a_transition_are_worth_a_line() -> None:
    t, x, u = np.arange(1000.0), np.zeros((1000, 1)), np.zeros((1000, 1))
    ten, eleven, twice = x.copy(), x.copy(), t.copy()
    ten[:10], eleven[:11], twice[500] = math.nan, math.nan, 499.0
    assert not loses_much(Transient(t, x, u)) and not loses_much(Transient(t, ten, u))
    assert loses_much(Transient(t, eleven, u)) and loses_much(Transient(twice, x, u))


def test_recordings_of_other_types_are_neither_fitted_together_nor_judged(tmp_path: Path) -> None:
    one = float_bag(tmp_path, "a.mcap", range(0, 1000 * MS, 100 * MS), range(0, 1000 * MS, 30 * MS))
    single = [("/x", k * MS, cdr("std_msgs/msg/Float32", data=1.0)) for k in range(9)]
    types = {"/x": "std_msgs/msg/Float32", "/u": FLOAT64}
    two = save(tmp_path, types, [*single, ("/u", 0, float64(1.0))], "b.mcap")
    with pytest.raises(BagError, match=f"{two}: /x is std_msgs/msg/Float32, and std_msgs/msg/Float64 in {one}"):
        read_transients([one, two], XU)
    (fitted,) = read_transients(one, XU)
    with pytest.raises(BagError, match=f"{two}: /x is std_msgs/msg/Float32, and the model was fitted to {FLOAT64}"):
        read_as_fitted(two, fitted.signals)
    three = save(tmp_path, {"/y": FLOAT64}, [("/y", 1, float64(1.0))], "c.mcap")
    refuses(BagError, "there is no topic /x; topics there: /y", read_as_fitted, three, fitted.signals)
    sent = [Message(topic, 1, float64(1.0)) for topic in ("/x", "/u")]
    bare = write([Topic("/x", schema_encoding=""), Topic("/u")], sent).save(tmp_path / "d.mcap")
    refuses(BagError, "/x is of no stated type, and the model was fitted to", read_as_fitted, bare, fitted.signals)


def test_no_recording_is_an_error() -> None:
    refuses(BagError, "no recording is named; give at least one", read_transients, [], XU)


# --- for a model ---------------------------------------------------------------------------------------------


def model_of(signals: SignalMap) -> UncertainLTI:
    n, m = len(signals.states), len(signals.controls)
    return UncertainLTI(np.eye(n), np.zeros((n, m)), np.zeros((n, n)), np.zeros((n, m)), signals=signals)


def test_a_model_reads_as_the_fit_did(tmp_path: Path) -> None:
    one = float_bag(tmp_path, "a.mcap", range(0, 1000 * MS, 100 * MS), range(0, 1000 * MS, 30 * MS))
    (fitted,) = read_transients(one, XU)
    assert fitted.signals is not None
    model = model_of(fitted.signals)
    model.save(tmp_path / "m.model.json")
    transient = read_as_fitted(one, UncertainLTI.load(tmp_path / "m.model.json").signals)
    for name in ("t_ns", "x", "u", "segment"):
        assert getattr(transient, name).tobytes() == getattr(fitted, name).tobytes()
    slower = float_bag(tmp_path, "b.mcap", range(0, 9000 * MS, 300 * MS), range(0, 9000 * MS, 30 * MS))
    assert read_as_fitted(slower, model.signals).segments == 30, "the limits are those of the fit, not of the recording"


@pytest.mark.parametrize("seam", [5000, -5000])
def test_a_still_stretch_ends_where_nobody_recorded(tmp_path: Path, seam: int) -> None:
    """12 samples at 3, a gap or a step back, 12 more at 3; and 15 in a row at 1, which is the longest then."""
    values = [3.0] * 12 + [3.0] * 12 + list(np.linspace(2.8, 1.2, 5)) + [1.0] * 15
    stamps = [10_000 + 10 * k + (seam if k >= 12 else 0) for k in range(len(values))]
    messages = [
        ("/x", k * 10 * MS, joint_state(stamp * MS, [value]))
        for k, (stamp, value) in enumerate(zip(stamps, values, strict=True))
    ]
    path = save(tmp_path, {"/x": JOINT_STATE}, messages)
    (transient,) = read_transients(path, SignalMap((Signal("x", "/x", "position[0]", "auto", "auto"),)))
    assert transient.signals is not None
    assert (transient.signals.states[0].steady, transient.signals.states[0].scale) == (1.0, 3.0)


def test_a_judged_control_is_read_as_the_control_that_it_is(tmp_path: Path) -> None:
    """At each sample the value that a control would have, held as long; a file of a model keeps it."""
    path = float_bag(tmp_path, "a.mcap", range(0, 3000 * MS, 100 * MS), range(0, 2000 * MS, 70 * MS))
    control = replace(XU.controls[0], max_hold=0.3)
    (plain,) = read_transients(path, replace(XU, controls=(control,)))
    (read,) = read_transients(path, replace(XU, controls=(replace(control, judged=True),)))
    assert read.state_names == ("x", "u") and read.x[:, 1].tobytes() == plain.u[: len(read), 0].tobytes()
    assert np.isnan(read.x[:, 1]).any() and read.signals is not None
    model_of(read.signals).save(tmp_path / "judged.model.json")
    again = read_as_fitted(path, UncertainLTI.load(tmp_path / "judged.model.json").signals)
    assert again.x.tobytes() == read.x.tobytes() and again.signals.states[1].judged


@pytest.mark.parametrize(("topics", "known"), [(1, 29), (2, 28), (3, 28)])
def test_controls_at_the_arrival_are_read_as_they_are_taken_of_a_recording(
    topics: int, known: int, tmp_path: Path
) -> None:
    """What `Transient.controls_at` makes of a recording is what a signals file says, live and offline."""
    if topics == 1:
        path = tmp_path / "run.csv"
        path.write_text("t,x,u\n" + "".join(f"{0.1 * k:.1f},{k * k % 7},{k % 5}\n" for k in range(30)))
        signals = SignalMap((Signal("x", "/table", "x"),), (Signal("u", "/table", "u"),))
    else:
        path = float_bag(tmp_path, "a.mcap", range(0, 3000 * MS, 100 * MS), range(0, 3000 * MS, 70 * MS))
        signals = XU
    if topics == 3:
        every = [(topic, k * 10 * MS, float64(k % 7)) for k in range(30) for topic in ("/x", "/y", "/u")]
        path = save(tmp_path, dict.fromkeys(("/x", "/y", "/u"), FLOAT64), every)
        signals = replace(XU, states=(*XU.states, Signal("y", "/y", "data")))
    (plain,) = read_transients(path, signals)
    at_both = replace(signals, controls=tuple(replace(c, at="both") for c in signals.controls))
    (read,) = read_transients(path, at_both)
    taken = plain.controls_at("both")
    assert taken.signals == read.signals and taken.control_names == read.control_names == ("u", "u at arrival")
    for name in ("k", "dt", "x", "u", "x_next"):
        assert getattr(taken.transitions(), name).tobytes() == getattr(read.transitions(), name).tobytes()
    assert len(read.transitions().k) == known, "one more sample decides the last, unless it is all of one topic"


def test_a_model_of_arrays_names_no_topics(tmp_path: Path) -> None:
    model = UncertainLTI(np.eye(1), np.zeros((1, 0)), np.eye(1), np.zeros((1, 0)))
    path = float_bag(tmp_path, "a.mcap", range(0, 100 * MS, 10 * MS), [0])
    refuses(SignalError, "the model was fitted to arrays and names no topics", read_as_fitted, path, model.signals)


@pytest.mark.parametrize(("length", "quiet", "told"), [(10, 1, False), (10, 2, True), (60, 3, False), (60, 4, True)])
def test_a_clock_topic_that_stops_before_the_recording_does_is_said(
    length: int, quiet: int, told: bool, tmp_path: Path
) -> None:
    """By over a second, and over 5 % of the recording."""
    sent = [("/x", k * 1000 * MS, float64(k)) for k in range(length - quiet + 1)]
    sent += [("/u", k * 1000 * MS, float64(k)) for k in range(length // 2, length + 1)]  # it begins later
    path = save(tmp_path, {"/x": FLOAT64, "/u": FLOAT64}, sent)
    (run,) = read_transients(path, SignalMap((Signal("x", "/x", "data"),), (Signal("u", "/u", "data"),)))
    said = [note for note in run.notes if f"the last message of /x comes {quiet} s before the recording ends" in note]
    assert len(said) == told


@pytest.mark.parametrize("behind", [None, 0, 1700000000])
def test_log_times_that_are_not_those_of_the_simulated_clock_beside_them_are_said(behind: int | None, tmp_path: Path):
    """As `ros2 bag record` writes them without --use-sim-time; by fit or check, and in the file of init."""
    start = 1700000000 * 10**9
    sent = [
        Message(t, start + k * 10 * MS, float64(math.sin(k * a)))
        for k in range(99)
        for t, a in (("/x", 1), ("/cmd", 0.3))
    ]
    tick = message("builtin_interfaces/msg/Time", sec=1700000000 - (behind or 0), nanosec=0)
    clock = [Message("/clock", sent[0].log_time, cdr("rosgraph_msgs/msg/Clock", clock=tick))] * (behind is not None)
    topics = [Topic("/x"), Topic("/cmd"), Topic("/clock", "rosgraph_msgs/msg/Clock")]
    path = write(topics, [*clock, *sent]).save(tmp_path / "a.mcap")
    (run,) = read_transients(path, SignalMap((Signal("x", "/x", "data"),)))
    said = "/x goes by log times, which are not those of /clock: a monitor with use_sim_time judges other steps"
    assert (said in "".join(run.notes)) == (said in propose([path], states=["/x"]).text) == bool(behind)


def test_a_recording_that_cannot_be_sampled_is_an_error_and_not_silence(tmp_path: Path) -> None:
    """A model that goes by stamps, and a recording without; or whose clock never speaks."""
    stamped = [("/x", k * MS, joint_state((k + 1) * MS, [k])) for k in range(9)]
    good = save(tmp_path, {"/x": JOINT_STATE}, stamped)
    (fitted,) = read_transients(good, SignalMap((Signal("x", "/x", "position[0]"),)))
    assert fitted.signals is not None
    model = model_of(fitted.signals)
    zero = save(tmp_path, {"/x": JOINT_STATE}, [("/x", k * MS, joint_state(0, [k])) for k in range(9)], "zero.mcap")
    with pytest.raises(SignalError, match="zero.mcap: no message of /x has a stamp, and the model uses them"):
        read_as_fitted(zero, model.signals)
    silent = save(tmp_path, {"/x": JOINT_STATE, "/y": FLOAT64}, [("/y", 1, float64(1.0))], "silent.mcap")
    refuses(BagError, "silent.mcap: /x has no message; record it", read_as_fitted, silent, model.signals)
    junk = save(tmp_path, {"/x": JOINT_STATE}, [("/x", k * MS, b"\0\7\0\0") for k in range(9)], "junk.mcap")
    said = r"junk.mcap: /x: 9 messages left out that cannot be decoded \(.* begins with 0007\); record it"
    refuses(BagError, said, read_as_fitted, junk, model.signals)
    driven = replace(fitted.signals, controls=(Signal("y", "/y", "data"),), time={**fitted.signals.time, "/y": "log"})
    quiet = save(tmp_path, {"/x": JOINT_STATE, "/y": FLOAT64}, stamped, "quiet.mcap")
    refuses(BagError, "quiet.mcap: /y has no message; record it", read_as_fitted, quiet, model_of(driven).signals)
    vague = model_of(SignalMap((Signal("x", "/x", "position[0]"),)))
    refuses(SignalError, "does not say clock, max_gap and time of every topic", read_as_fitted, good, vague.signals)
