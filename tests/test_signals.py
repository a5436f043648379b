# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Field paths on real messages of both decoders, and signals files whatever stands in them."""

import importlib
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from bag_writer import JAZZY
from hypothesis import example, given
from hypothesis import strategies as st
from refusals import refuses

from uncertain_lti.base.errors import SignalError
from uncertain_lti.base.files import target
from uncertain_lti.base.text import printable
from uncertain_lti.recordings.message_types import define
from uncertain_lti.signals.field_path import FieldPath, FieldType, TypeFields, numeric_paths
from uncertain_lti.signals.signal_map import Signal, SignalMap

NAN, INF = math.nan, math.inf


def bag_fields(type_name: str) -> dict[str, FieldType]:
    """As a recording of this type describes it."""
    definition = define(type_name, "ros2msg", JAZZY.generate_msgdef(type_name, ros_version=2)[0].encode())
    return dict(definition.fields(type_name))


def live_fields(type_name: str) -> dict[str, FieldType]:
    """As the installed message class describes it."""
    pytest.importorskip("rclpy", reason="rclpy is not installed")
    return dict(importlib.import_module("uncertain_lti_ros.topics").live_fields(type_name))


FIELDS: dict[str, TypeFields] = {"bag": bag_fields, "live": live_fields}


def made(type_name: str, content: dict[str, Any]) -> Any:
    """Message of rclpy with these fields, given as nested plain data."""
    pytest.importorskip("rclpy", reason="rclpy is not installed")
    package, *_, name = type_name.split("/")
    message = getattr(importlib.import_module(f"{package}.msg"), name)()
    for field, value in content.items():
        inner = message.get_fields_and_field_types()[field]
        if isinstance(value, dict):
            value = made(inner, value)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            value = [made(inner.removeprefix("sequence<").removesuffix(">"), each) for each in value]
        setattr(message, field, value)
    return message


def live_message(type_name: str, content: dict[str, Any]) -> Any:
    """As it comes out of a subscription."""
    message = made(type_name, content)
    serialization = importlib.import_module("rclpy.serialization")
    return serialization.deserialize_message(serialization.serialize_message(message), type(message))


def bag_message(type_name: str, content: dict[str, Any]) -> Any:
    """As it comes out of a recording."""
    message = made(type_name, content)
    schema = JAZZY.generate_msgdef(type_name, ros_version=2)[0].encode()
    serialization = importlib.import_module("rclpy.serialization")
    return define(type_name, "ros2msg", schema).decode(serialization.serialize_message(message))


MESSAGES = {"bag": bag_message, "live": live_message}
both = pytest.mark.parametrize("side", ["bag", "live"])

QUARTER = {"x": 0.0, "y": 0.0, "z": math.sin(math.pi / 8), "w": math.cos(math.pi / 8)}
JOINTS = {
    "name": ["fan", "core", "3", "left wheel", "a.b[c]"],
    "position": [1.5, -2.0, 3.25, 4.0, 5.0],
    "velocity": [0.1, 0.2],
}
ODOMETRY = {
    "pose": {"pose": {"position": {"x": 1.0, "y": 2.0, "z": 3.0}, "orientation": QUARTER}},
    "twist": {"twist": {"linear": {"x": 3.0, "y": 4.0, "z": 12.0}}, "covariance": [float(i) for i in range(36)]},
}
POSES = {"poses": [{"position": {"x": 7.0}}, {"position": {"x": 8.0}, "orientation": QUARTER}]}
LAYOUT = {"layout": {"dim": [{"label": "x", "size": 3, "stride": 3}], "data_offset": 2}, "data": [3.0, -4.0, 12.0]}

TRAJECTORY = {"joint_names": ["tilt", "pan"], "points": [{"positions": [0.5, -1.5]}, {"positions": [1.0, 2.0]}]}

READ = [
    ("trajectory_msgs/msg/JointTrajectory", TRAJECTORY, "points[0].positions[pan]", -1.5),
    ("trajectory_msgs/msg/JointTrajectory", TRAJECTORY, "points[1].positions[tilt]", 1.0),
    ("trajectory_msgs/msg/JointTrajectory", TRAJECTORY, "points[1].positions[roll]", NAN),
    ("trajectory_msgs/msg/JointTrajectory", TRAJECTORY, "points[1].velocities[pan]", NAN),
    ("sensor_msgs/msg/JointState", JOINTS, "position[fan]", 1.5),
    ("sensor_msgs/msg/JointState", JOINTS, " position[ core ] ", -2.0),
    ("sensor_msgs/msg/JointState", JOINTS, "position[3]", 4.0),
    ("sensor_msgs/msg/JointState", JOINTS, 'position["3"]', 3.25),
    ("sensor_msgs/msg/JointState", JOINTS, "position[left wheel]", 4.0),
    ("sensor_msgs/msg/JointState", JOINTS, 'position["a.b[c]"]', 5.0),
    ("sensor_msgs/msg/JointState", JOINTS, "velocity[core]", 0.2),
    ("sensor_msgs/msg/JointState", JOINTS, "norm(velocity)", math.hypot(0.1, 0.2)),
    ("sensor_msgs/msg/JointState", JOINTS, "position[5]", NAN),
    ("sensor_msgs/msg/JointState", JOINTS, 'velocity["3"]', NAN),
    ("sensor_msgs/msg/JointState", JOINTS, "effort[fan]", NAN),
    ("sensor_msgs/msg/JointState", {}, "position[fan]", NAN),
    ("nav_msgs/msg/Odometry", ODOMETRY, "twist.twist.linear.x", 3.0),
    ("nav_msgs/msg/Odometry", ODOMETRY, "norm(twist.twist.linear)", 13.0),
    ("nav_msgs/msg/Odometry", ODOMETRY, "twist.covariance[35]", 35.0),
    ("nav_msgs/msg/Odometry", ODOMETRY, "unwrap(yaw(pose.pose.orientation))", math.pi / 4),
    ("nav_msgs/msg/Odometry", ODOMETRY, "unwrap( yaw ( pose.pose.orientation ) )", math.pi / 4),
    ("std_msgs/msg/Float64MultiArray", LAYOUT, "data[1]", -4.0),
    ("std_msgs/msg/Float64MultiArray", LAYOUT, "norm(data)", 13.0),
    ("std_msgs/msg/Float64MultiArray", LAYOUT, "layout.dim[0].size", 3.0),
    ("std_msgs/msg/Float64MultiArray", LAYOUT, "layout.dim[1].size", NAN),
    ("std_msgs/msg/Float64MultiArray", {}, "norm(data)", 0.0),
    ("sensor_msgs/msg/Imu", {"orientation": dict.fromkeys("xyzw", 0.0)}, "yaw(orientation)", NAN),
    ("sensor_msgs/msg/Imu", {"angular_velocity": {"x": 0.0, "y": 0.0, "z": NAN}}, "angular_velocity.z", NAN),
    ("geometry_msgs/msg/PoseArray", POSES, "poses[1].position.x", 8.0),
    ("geometry_msgs/msg/PoseArray", POSES, "poses[2].position.x", NAN),
    ("geometry_msgs/msg/PoseArray", POSES, "yaw(poses[2].orientation)", NAN),
    ("std_msgs/msg/Bool", {"data": True}, "data", 1.0),
    ("std_msgs/msg/Int64", {"data": -(2**53)}, "data", -(2.0**53)),
    ("std_msgs/msg/Float32", {"data": 0.1}, "data", float(np.float32(0.1))),
    ("sensor_msgs/msg/BatteryState", {"present": True, "cell_voltage": [3.5, 4.0]}, "cell_voltage[1]", 4.0),
    ("std_msgs/msg/UInt8MultiArray", {"data": bytes([7, 200])}, "data[1]", 200.0),
]


@both
@pytest.mark.parametrize(("type_name", "content", "field", "value"), READ)
def test_documented_paths_read_alike_from_recordings_and_live(type_name, content, field, value, side):
    path = FieldPath(field)
    path.check("/topic", type_name, FIELDS[side])
    got = path.read(MESSAGES[side](type_name, content))
    assert type(got) is float
    assert got == pytest.approx(value, rel=1e-15, abs=1e-15, nan_ok=True)
    assert (path.unwrap == math.tau) == field.strip().startswith("unwrap")


@both
@pytest.mark.parametrize("type_name", sorted({case[0] for case in READ}))
def test_every_path_that_is_offered_can_be_read(type_name: str, side: str) -> None:
    fields = FIELDS[side]
    offered = list(numeric_paths(type_name, fields))
    assert offered
    message = MESSAGES[side](type_name, {})
    for text in offered:
        path = FieldPath(text.replace("[]", "[0]"))
        if any(f"[{n}]" in text for n in (9, 36)):
            path = FieldPath(text.replace("[9]", "[8]").replace("[36]", "[35]"))
        path.check("/topic", type_name, fields)
        assert isinstance(path.read(message), float)


# --- angles -------------------------------------------------------------------------------------------------

angle = st.floats(-3.1, 3.1)


def quaternion(roll: float, pitch: float, yaw: float) -> SimpleNamespace:
    """Rotation about z, then y, then x (REP 103)."""
    cr, sr, cp, sp, cy, sy = (f(a / 2) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    return SimpleNamespace(
        x=sr * cp * cy - cr * sp * sy,
        y=cr * sp * cy + sr * cp * sy,
        z=cr * cp * sy - sr * sp * cy,
        w=cr * cp * cy + sr * sp * sy,
    )


@given(angle, st.floats(-1.5, 1.5), angle, st.floats(-100, 100).filter(lambda s: abs(s) > 1e-3))
def test_angles_come_back_from_a_quaternion_of_any_norm_and_sign(r: float, p: float, y: float, scale: float) -> None:
    q = quaternion(r, p, y)
    message = SimpleNamespace(q=SimpleNamespace(**{c: scale * getattr(q, c) for c in "xyzw"}))
    assert FieldPath("roll(q)").read(message) == pytest.approx(r, abs=1e-9)
    assert FieldPath("pitch(q)").read(message) == pytest.approx(p, abs=1e-9)
    assert FieldPath("yaw(q)").read(message) == pytest.approx(y, abs=1e-9)
    assert FieldPath("norm(q)").read(message) == pytest.approx(abs(scale), rel=1e-9)


@given(st.lists(st.sampled_from([0.0, 1.0, -1.0, NAN, INF, -INF, 1e200, -1e-200]), min_size=4, max_size=4))
def test_no_angle_comes_from_a_quaternion_that_is_zero_or_not_finite(parts: list[float]) -> None:
    message = SimpleNamespace(q=SimpleNamespace(**dict(zip("xyzw", parts, strict=True))))
    for function in ("roll", "pitch", "yaw"):
        value = FieldPath(f"{function}(q)").read(message)
        if not any(parts) or not all(map(math.isfinite, parts)):
            assert not math.isfinite(value)
        else:
            assert math.isnan(value) or abs(value) <= math.pi
    if not all(map(math.isfinite, parts)):
        assert not math.isfinite(FieldPath("norm(q)").read(message))


# --- the text of a path -------------------------------------------------------------------------------------

word = st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,6}", fullmatch=True)
bare_name = st.text(st.characters(exclude_characters='[]"', codec="utf-8"), min_size=1, max_size=8).filter(
    lambda t: t == t.strip() and not t.isdigit()
)
quoted_name = st.text(st.characters(exclude_characters='"', codec="utf-8"), min_size=1, max_size=8)


@st.composite
def path_and_message(draw: st.DrawFn) -> tuple[str, Any, float]:
    """A path by the grammar, and an object in which it leads to a number: built from the inside out."""
    value = draw(st.floats(allow_nan=False))
    inner: Any = value
    text = ""
    for number in range(draw(st.integers(1, 4))):
        kind = draw(st.sampled_from(["plain", "index", "name", "quoted"]))
        attribute = draw(word.filter(lambda w: w != "name"))
        node = SimpleNamespace()
        suffix = ""
        if kind == "index":
            index = draw(st.integers(0, 3))
            inner = [None] * index + [inner]
            suffix = f"[{index}]"
        elif kind != "plain":
            name = draw(bare_name if kind == "name" else quoted_name)
            node.name = ["\0other", name]
            inner = [None, inner]
            suffix = f"[{name}]" if kind == "name" else f'["{name}"]'
        setattr(node, attribute, inner)
        text = f"{attribute}{suffix}" + (f".{text}" if number else "")
        inner = node
    return text, inner, value


@given(path_and_message())
def test_paths_by_the_grammar_lead_where_they_say(case: tuple[str, Any, float]) -> None:
    text, message, value = case
    assert FieldPath(text).read(message) == value
    assert FieldPath(f"  {text} ").read(message) == value
    assert FieldPath(f"unwrap({text})").read(message) == value
    assert FieldPath(f"lag(unwrap({text}, 6.5), 2)").angle == FieldPath(f"unwrap( {text} )").angle == text
    assert FieldPath(text) == FieldPath(text) and hash(FieldPath(text)) == hash(FieldPath(text))
    assert FieldPath(text).absent(message) == ""


@pytest.mark.parametrize(
    "text",
    [
        "", " ", ".", "a.", ".a", "a..b", "a b", "[0]", "a[0]b", "a[]", "a[ ]", 'a[""]', "a[0", "a0]", "a[[0]]",
        "a.[0]",
        "1a", "a-b", "a,b", "a/b", "roll()", "unwrap()", "unwrap(unwrap(a))", "roll(unwrap(a))", "norm(norm(a))",
        "abs(a)", "roll(a", "roll a)", "roll(a))", "(a)", "a(b", "a[0](b)", "roll(a).x", 'a["x]', "data[0]\n.",
    ],
)  # fmt: skip
def test_a_text_that_is_no_path_is_refused_in_one_sentence(text: str) -> None:
    assert printable(text.strip()) in refuses(SignalError, "^field ", FieldPath, text)


@given(st.text(max_size=30) | st.text('ab.[]()"0 unwrap_roll', max_size=30))
@example("data[" + "9" * 5000 + "]")
@example("unwrap(" * 300 + ")" * 300)
@example("a" + ".a" * 5000)
def test_any_text_is_a_path_or_a_signal_error(text: str) -> None:
    try:
        path = FieldPath(text)
    except SignalError:
        return
    assert path.text == text


@both
@pytest.mark.parametrize(
    ("type_name", "field", "words"),
    [
        ("sensor_msgs/msg/JointState", "positio[0]", "fields there: header, name, position, velocity, effort"),
        ("sensor_msgs/msg/JointState", "positio", "numeric field paths of /t: header.stamp.sec, "),
        ("sensor_msgs/msg/JointState", "position", "an array; give an index, for example \\[0\\]"),
        ("sensor_msgs/msg/JointState", "position.x", "give an index before '.x'"),
        ("sensor_msgs/msg/JointState", "position[0].x", "a float64 has no fields|a double has no fields"),
        ("sensor_msgs/msg/JointState", "position[0][1]", "follows something that is not an array"),
        ("sensor_msgs/msg/JointState", "name[0]", "not one number but a string; numeric field paths"),
        ("sensor_msgs/msg/JointState", "header.stamp", "not one number but a builtin_interfaces/msg/Time"),
        (
            "sensor_msgs/msg/JointState",
            "header.stam",
            "no 'stam' in std_msgs/msg/Header .is stamp meant..; fields there: stamp, frame_id",
        ),
        ("sensor_msgs/msg/JointState", "roll(position[0])", "wants a quaternion with x, y, z, w"),
        ("sensor_msgs/msg/JointState", "norm(position[0])", "wants a vector with x, y, z or an array of numbers"),
        ("geometry_msgs/msg/Polygon", "norm(points)", "wants a vector"),
        (
            "std_msgs/msg/Float64MultiArray",
            "data[fan]",
            "needs an array of strings called 'name' or 'joint_names' in the same message",
        ),
        ("std_msgs/msg/Float64MultiArray", "data[1:3]", "give an index instead, for example \\[0\\]"),
        ("geometry_msgs/msg/Twist", "twist.linear.x", "no 'twist' in geometry_msgs/msg/Twist; .*: linear.x, linear.y"),
        ("sensor_msgs/msg/Imu", "orientation_covariance[9]", "index 9 is past the end of an array of 9"),
        ("std_msgs/msg/String", "data", "numeric field paths of /t: none"),
        ("std_msgs/msg/Byte", "data", "not one number but a byte|not one number but a octet"),
        ("std_msgs/msg/Empty", "data", "fields there: none|fields there: structure"),
    ],
)
def test_a_path_that_does_not_fit_names_what_is_there(type_name: str, field: str, words: str, side: str) -> None:
    sentence = refuses(SignalError, words, FieldPath(field).check, "/t", type_name, FIELDS[side])
    assert sentence.startswith(f"field '{field}' of /t ({type_name})")


# --- signals files ------------------------------------------------------------------------------------------

WHOLE = """
clock: /engine/state
max_gap: 0.05
min_step: 0
topics:
  /engine/state: {time: header}
states:
  - {name: fan_speed, topic: /engine/state, field: "position[fan]", steady: 1.0, scale: 1.0, unit: rpm}
controls:
  - {name: fuel_flow, topic: /engine/control, field: "data[0]", max_hold: 0.2, delay: 0}
"""


def saved(folder: Path, text: str | bytes) -> Path:
    path = folder / "signals.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_the_file_of_the_design_says_what_it_says(tmp_path: Path) -> None:
    signals = SignalMap.load(saved(tmp_path, WHOLE))
    state = Signal("fan_speed", "/engine/state", "position[fan]", 1.0, 1.0, "rpm")
    control = Signal("fuel_flow", "/engine/control", "data[0]", max_hold=0.2, delay=0)
    said = {"clock": "/engine/state", "max_gap": 0.05, "min_step": 0.0, "time": {"/engine/state": "header"}}
    assert signals == SignalMap((state,), (control,), source=str(tmp_path / "signals.yaml"), **said)


def test_what_is_not_said_has_the_stated_defaults(tmp_path: Path) -> None:
    signals = SignalMap.load(saved(tmp_path, "states: [{name: x, topic: /a, field: data}]"))
    assert (signals.clock, signals.max_gap, signals.max_skew, signals.min_step) == (None, None, None, 0.0)
    assert (signals.controls, signals.time) == ((), {})
    assert signals.states == (Signal("x", "/a", "data", 0.0, 1.0, "", "", None, 0),)


def test_every_shipped_signals_file_loads(signals_folder: Path) -> None:
    files = sorted(signals_folder.glob("*.yaml"))
    assert len(files) >= 6
    for path in files:
        signals = SignalMap.load(path)
        assert signals.source == str(path)
        positions = sorted(i for topic in signals.topics for i in signals.on(topic))
        assert positions == list(range(len(signals.signals)))


X = "states:\n  - {name: x, topic: /a, field: data}\n"
JOINTS = 'states:\n  - {for: [j0, j1], name: "{}", topic: /s, field: "position[{}]"}\n'


def state(entry: str) -> str:
    return f"states:\n  - {{name: x, topic: /a, field: data, {entry}}}\n"


def control(entry: str) -> str:
    return X + f"controls:\n  - {{name: u, topic: /b, field: data, {entry}}}\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "nothing is in it; list the states and controls, or let `uncertain-lti init`"),
        ("- a", "a mapping is wanted here, not a list"),
        ("a: b: c", "is not YAML at line 1"),
        ("a: 2001-99-99", "is not YAML: month must be in 1..12"),
        ("a: !!python/object:os.system {}", "is not YAML at line 1"),
        ("[" * 5000, "is not YAML"),
        ("a: \x07", "is not YAML"),
        (b"\xff\xfe\x00", "is not UTF-8 at byte 1; save it as UTF-8"),
        (
            "clocks: /a\n" + X,
            "unknown key 'clocks' \\(is clock meant\\?\\); known are .*clock, controls, horizons, max_gap",
        ),
        ("states: []", "'states' is empty; list at least one state"),
        ("states: {name: x}", "states: a list is wanted here, not a mapping"),
        ("states: [7]", "states\\[0\\]: a mapping is wanted here, not a number"),
        ("states: [{topic: /a, field: data}]", "states\\[0\\]: 'name' is missing"),
        ("states: [{name: on, topic: /a, field: data}]", "'name' is True; write a text, in quotes"),
        ("states: [{name: x, topic: 5, field: data}]", "'topic' is 5; write a text"),
        ("states: [{name: x, topic: /a, field: 'data['}]", "signal 'x': field 'data\\[' is not a field path"),
        (X + "  - {name: x, topic: /b, field: data}", "signal 'x' is listed twice"),
        (control("name: x"), "key 'name' is twice in one mapping, again at line 4; keep one"),
        (
            state("scales: 2"),
            "states\\[0\\]: unknown key 'scales' \\(is scale meant\\?\\); known are at, delay, field, ignore",
        ),
        (state("scale: 0"), "signal 'x': scale is 0.0; it must be a positive number or auto"),
        (state("scale: .nan"), "scale is nan; write a number"),
        (state("steady: .inf"), "signal 'x': steady is inf; it must be a finite number or auto"),
        (state("steady: 1" + "0" * 400), "steady is 1000.*; write a number"),
        (X + "max_gap: 1e10", "max_gap is 10000000000.0; it must be .*, at most 9e\\+09"),
        (X + "min_step: 1e308", "min_step is 1e\\+308; it must be 0 s or more, up to 9e\\+09"),
        (state("steady: -1e200"), "signal 'x': steady is -1e\\+200; it must be .*, up to 1e\\+50"),
        (state("scale: 1e-320"), "signal 'x': scale is 1e-320; it must be .*, 1e-50 to 1e\\+50"),
        (control("max_hold: 1e308"), "signal 'u': max_hold is 1e\\+308; it must be 0 s or more, up to 9e\\+09"),
        (state("unit: {a: 1}"), "unit is {'a': 1}; write a text, in quotes"),
        (state("max_hold: 1"), "state 'x' has max_hold or delay; both are for controls"),
        (control("max_hold: -1"), "signal 'u': max_hold is -1.0; it must be 0 s or more"),
        (control("delay: 1.5"), "controls\\[0\\]: delay is 1.5; write a whole number of samples"),
        (control("delay: 1000000000000000000000"), "signal 'u': delay is 1000000000000000000000; it must be 0 to"),
        (control("at: end"), "signal 'u': at is 'end'; write departure, arrival or both"),
        (control("at: both, delay: 1"), "signal 'u at arrival': at is arrival, and it is taken from earlier"),
        (control("judged: 1"), "controls\\[0\\]: judged is 1; write true or false"),
        (control("judged: true, delay: 1"), "signal 'u': is judged, and delayed, a memory or not at the departure"),
        (state("at: arrival"), "'x' is at arrival; that is for controls"),
        (X + "controls: [{name: u, topic: /a, field: data, at: both}]", "'u at arrival' is a state, which is judged"),
        (X + "clock: /b", "clock is /b, which carries no state; choose one of /a"),
        (X + "clock: [1]", "clock is \\[1\\]; write the name of a state topic"),
        (X + "topics: {/b: {time: log}}", "'topics' names /b, which carries no signal; signals come from /a"),
        (X + "topics: {/a: {time: wall}}", "topics: /a: time is 'wall'; write header or log"),
        (X + "topics: {/a: log}", "topics: /a: a mapping is wanted here, not a text"),
        (X + "topics: {/a: {time: log, queue: 1}}", "topics: /a: unknown key 'queue'; known are time"),
        (X.replace("}", ", steady: 1,5}", 1), "states\\[0\\]: unknown key 5; write decimals with a point"),
        (X + "max_gap: 0", "max_gap is 0.0; it must be a positive number of seconds"),
        (X + "max_skew: -1", "max_skew is -1.0; it must be a positive number of seconds"),
        (X + "min_step: -1", "min_step is -1.0; it must be 0 s or more"),
        (X + "step: even", "step is 'even'; write recorded, constant, or the period in seconds"),
        (X + "step: 0", "step is 0.0; it must be 1e-9 to 9e"),
        (state("valid: 3"), "valid is 3; write \\[least, greatest\\]"),
        (state("valid: [1, 1]"), "signal 'x': valid is \\[1.0, 1.0\\]; write \\[least, greatest\\]"),
        (state("valid: [a, 1]"), "valid\\[0\\] is 'a'; write a number"),
        (state("ignore: [1, null]"), "ignore\\[1\\] is None; write a number"),
        (state("ignore: {a: 1}"), "ignore is {'a': 1}; write a list of numbers"),
        (control("field: 'lag(data, 0)'").replace("field: data, ", ""), "a lag is 1 to 1000000 samples, not 0"),
        (control("field: 'lag(data, 1)', delay: 2").replace("field: data, ", ""), "'u': lag\\(data, 1\\) has a delay"),
        ("states: [{name: x, topic: /a, field: diff(data)}]", "every state is a lag, diff or rate, .* list the field"),
        (X + "schedule: [{signal: torque, knots: 3}]", "torque"),
        (X + "schedule: [{signal: x, knots: 0}]", "knots"),
        (X + "schedule: [{signal: x}]", "knots"),
        (X + "schedule: [{signal: 3, knots: 2}]", "'signal' is 3; write the name of a signal"),
        (X + "table: {words: {fan: low}}", "words of fan is 'low'; write a list of words in quotes"),
        (X + "schedule: [{signal: x, knots: [1, a]}]", r"knots\[1\]"),
        (X + "schedule: [{signal: x, knots: [false, true]}]", r"knots\[0\]"),
        (X + "schedule: {signal: x}", "list"),
        (X + "scheduling: [{name: gear, topic: /g, field: data, delay: 2}]", "delay"),
        ("states: [{for: [a, b], name: x, topic: /s, field: d}]", "name is 'x', the same for all of a"),
        (X + "structure: own", "there are none"),
        (JOINTS + "structure: [{for: [j0, j1], state: j0, from: j1, nominal: 0}]", "state is 'j0', the same"),
    ],
)
def test_a_wrong_signals_file_is_refused_in_one_sentence(text: str | bytes, words: str, tmp_path: Path) -> None:
    path = saved(tmp_path, text)
    sentence = refuses(SignalError, words, SignalMap.load, path)
    assert sentence.startswith(str(path)) and len(sentence) < 400


def test_a_signals_file_that_is_not_there(tmp_path: Path) -> None:
    refuses(SignalError, "there is no such signals file; check the path", SignalMap.load, tmp_path / "none.yaml")
    refuses(SignalError, "this is a folder, and a signals file is wanted here", SignalMap.load, tmp_path)


@pytest.mark.parametrize("text", ["1e-3", "'0.001'", "0.001", "1.0e-3"])
def test_numbers_that_yaml_reads_as_text_are_numbers(text: str, tmp_path: Path) -> None:
    assert SignalMap.load(saved(tmp_path, X + f"max_gap: {text}")).max_gap == 0.001


words = st.sampled_from(["auto", "header", "/a", "x", "", "data"])
scalars = st.none() | st.booleans() | st.integers() | st.floats() | words


@st.composite
def damaged(draw: st.DrawFn, whole: Callable[[], Any], keys: st.SearchStrategy[Any], more: Sequence[Any] = ()) -> Any:
    """The structure of a whole file with one to three things replaced, taken away, or added under a key of `more`."""
    anything = st.recursive(
        scalars, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(keys, inner, max_size=3)
    )
    data = whole()
    for _ in range(draw(st.integers(1, 3))):
        place: Any = data
        while inner := list(place) if isinstance(place, dict) else list(range(len(place))):
            key = draw(st.sampled_from(inner))
            if isinstance(place[key], (dict, list)) and draw(st.integers(0, 2)):
                place = place[key]
                continue
            if draw(st.integers(0, 3)):
                place[key] = draw(anything)
            elif more and isinstance(place, dict) and draw(st.booleans()):
                place[draw(st.sampled_from(more))] = draw(anything)
            else:
                del place[key]
            break
    return data


def whole() -> Any:
    topics = {"/engine/state": {"time": "header"}, "/engine/control": {"time": "log"}}
    return yaml.safe_load(WHOLE) | {"max_skew": 0.1, "topics": topics}


@given(damaged(whole, scalars, ["extra", "delay", "max_hold", "unit", 5]))
def test_a_damaged_structure_is_a_map_or_a_signal_error(data: Any) -> None:
    try:
        signals = SignalMap.from_dict(data, source="file")
    except SignalError as error:
        assert str(error).startswith("file")
        return
    assert signals.states
    for signal in signals.signals:
        assert signal.scale == "auto" or 0 < signal.scale < INF
        assert signal.steady == "auto" or math.isfinite(signal.steady)


@given(st.binary(max_size=60) | st.text("{}[]:,-&*!|>?'\"ab1 \n\t#%@", max_size=60).map(str.encode))
def test_any_bytes_are_a_signal_error(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    path.write_bytes(data)
    sentence = refuses(SignalError, "", SignalMap.load, path)
    assert sentence.startswith(str(path)) and len(sentence.splitlines()) == 1


def test_aliases_and_old_numbers_of_yaml(tmp_path):
    """Nine lists of nine aliases each were 1.6 GB in 30 s; `010` was 8 and `1:30` was 90."""
    path = tmp_path / "s.yaml"
    bomb = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n"
    bomb += "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 10))
    path.write_text(bomb)
    refuses(SignalError, r"at line 2: an alias \(\*name\); write out what it stands for", SignalMap.load, path)
    from uncertain_lti.signals.values import read_yaml

    read = read_yaml("{a: 010, b: 1:30, c: 1_000, d: 10, f: -0.5, g: 0x10, h: 0}")
    assert read == {"a": "010", "b": "1:30", "c": "1_000", "d": 10, "f": -0.5, "g": 16, "h": 0}


def test_what_is_in_a_pipe_is_neither_waited_for_nor_taken_out(tmp_path):
    """`--signals <(...)` was said to be empty, and `--output /dev/stdout` waited for ever."""
    os.mkfifo(tmp_path / "pipe")
    both = os.open(tmp_path / "pipe", os.O_RDWR)
    os.write(both, b"#\n" * 4000)
    refuses(SignalError, "this is a pipe or a device", SignalMap.load, tmp_path / "pipe")
    target(tmp_path / "pipe", holds=b"{", kind="model file", example="m.model.json")
    assert len(os.read(both, 9000)) == 8000
    os.close(both)
