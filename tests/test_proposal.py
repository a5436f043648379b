# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""`init`: what it proposes can be fitted as it is, holds the signals that matter, and odd recordings get a sentence."""

import math
import re
import shutil
import struct
from itertools import combinations, permutations, product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from bag_writer import Message, Topic, array, cdr, float64, header, joint_state, message, vector, write
from hypothesis import given, settings
from hypothesis import strategies as st
from processes import bounded
from refusals import refuses
from test_signals import quaternion

from uncertain_lti import EnvelopeMonitor, SignalMap, fit, read_transients
from uncertain_lti.base.errors import BagError, FitError
from uncertain_lti.identification.diagnosis import remedies
from uncertain_lti.identification.evidence import functions
from uncertain_lti.proposal.candidates import (
    Candidate,
    Source,
    Steps,
    bare,
    part_by_role,
    role_by_name,
    role_of_column,
    steps_of,
)
from uncertain_lti.proposal.choosing import (
    _may_move_with,
    _moves_with,
    assign_roles,
    choose,
    drop_functions,
    drop_idle_controls,
)
from uncertain_lti.proposal.init import LONGEST_ARRAY, propose
from uncertain_lti.proposal.members import all_of_them
from uncertain_lti.proposal.signals_file import _left_out, memory_lines, name_signals, set_operating_point, signals_file
from uncertain_lti.proposal.tune import Remembered
from uncertain_lti.recordings.formats import group_recordings
from uncertain_lti.sampling.reading import read_as_fitted
from uncertain_lti.signals.field_path import KINDS, FieldPath, Memory
from uncertain_lti.signals.values import TableLayout

FLOAT64, ARRAY, POSE = "std_msgs/msg/Float64", "std_msgs/msg/Float64MultiArray", "geometry_msgs/msg/PoseStamped"
JOINT, POSE_2D = "sensor_msgs/msg/JointState", "geometry_msgs/msg/Pose2D"
MS = 10**6


def at(k):
    """When the messages of sample k come, 50 Hz."""
    return 10**18 + k * 20 * MS


def f64(topic, t_ns, value):
    return Message(topic, t_ns, cdr(FLOAT64, data=float(value)), t_ns)


def beside(topic, value):
    """What `driven` sends as well: a number of the state and the command."""
    return lambda k, x, u: [f64(topic, at(k), value(x, u))]


def pose(topic, t_ns, yaw, place=(0.0, 1.0)):
    point = message("geometry_msgs/msg/Point", x=float(place[0]), y=float(place[1]), z=0.0)
    turned = message("geometry_msgs/msg/Quaternion", **vars(quaternion(0.0, 0.0, yaw)))
    body = message("geometry_msgs/msg/Pose", position=point, orientation=turned)
    return Message(topic, t_ns, cdr(POSE, header=header(t_ns), pose=body), t_ns)


def wrapped(topic, t_ns, yaw, turn=0.0):
    theta = yaw / math.tau * turn % turn if turn else math.remainder(yaw, math.tau)
    return Message(topic, t_ns, cdr(POSE_2D, x=0.0, y=0.0, theta=theta), t_ns)


def driven(names=("/plant/state", "/plant/cmd"), count=400, seed=0, extra=lambda k, x, u: [], late=0):
    """First-order lag with a stepping command that acts so many samples late, 50 Hz."""
    rng = np.random.default_rng(seed)
    x, u, messages = 0.0, [0.0] * 9, []
    for k in range(count):
        u.append(float(rng.normal()) if k % 37 == 0 else u[-1])
        t = at(k)
        messages += [f64(names[0], t, x + 1e-3 * rng.normal()), f64(names[1], t, u[-1]), *extra(k, x, u[-1])]
        x += 0.02 * (-2.0 * x + 3.0 * u[-1 - late])
    return messages


def save(path, messages, types):
    topics = [Topic(name, types.get(name, FLOAT64)) for name in dict.fromkeys(m.topic for m in messages)]
    topics += [Topic(name, kind) for name, kind in types.items() if name not in {m.topic for m in messages}]
    return write(topics, messages).save(path)


def proposed(folder, messages, types=None):
    """A recording of these messages, and what is proposed for it."""
    path = save(folder / "run.mcap", messages, types or {})
    return path, propose([path])


def fitted(paths, proposal):
    """The proposal, unedited, through its own file format and a fit."""
    signals = SignalMap.from_dict(yaml.safe_load(proposal.text), source="proposal")
    runs = read_transients(paths, signals)
    return fit(runs)


def signals_of(proposal):
    return [(c.topic, c.path) for c in proposal.states], [(c.topic, c.path) for c in proposal.controls]


def csv(path, names, rows):
    path.write_text("\n".join(",".join(map(str, row)) for row in [names, *rows]) + "\n", encoding="utf-8")
    return path


# --- real machines ----------------------------------------------------------------------------------------------

REAL = {
    "micro_gas_turbine/ex_1": ({"data"}, {"data"}),
    "micro_gas_turbine/ex_24": ({"data"}, {"data"}),
    "hunter_se/straight_odd_t_0_5_run_01": ({"twist.linear.x"}, {"vector.x"}),
    "neato/person_follower": ({"twist.twist.linear.x", "twist.twist.angular.z"}, {"linear.x", "angular.z"}),
    "neato/draw_square": ({"twist.twist.linear.x", "twist.twist.angular.z"}, {"linear.x", "angular.z"}),
    "crazyflie/rollbag_0": ({"unwrap(roll(pose.orientation))"}, {"position.x"}),
    "crazyflie/yx3bag_0": ({"unwrap(roll(pose.orientation))"}, {"position.x"}),
    "crazyflie/yx4bag_0": (set(), set()),
    "cougars_auv/SO_bag_0": (set(), {"fin[0]"}),
}


@pytest.mark.parametrize("name", REAL)
def test_real_recordings_fit_unedited(recordings, name):
    """What `config/signals` names is there, what stands still is not, and the fit takes it as it is."""
    path = recordings / f"{name}.mcap"
    proposal = propose([path])
    states, controls = ({c.path for c in group} for group in (proposal.states, proposal.controls))
    wanted_states, wanted_controls = REAL[name]
    assert wanted_states <= states and wanted_controls <= controls, proposal.text
    model = fitted([path], proposal)
    assert model.fit_summary["violations"] == 0
    assert "vector.y" not in controls and "twist.angular.z" not in states - wanted_states
    said = " ".join(model.fit_summary["messages"])
    assert "better when it is taken" not in said and "like noise" not in said, proposal.text
    if name in ("cougars_auv/SO_bag_0", "hunter_se/straight_odd_t_0_5_run_01"):  # depth is pressure; a rate is noise
        assert len(states) == 1


def test_a_memory_that_covers_the_other_recording_is_proposed_though_one_is_left_outside_more_often(recordings):
    """Without it all of the second is outside; of the rate, which pays too, and the value before the best is taken."""
    proposal = propose([recordings / f"micro_gas_turbine/ex_{number}.mcap" for number in (1, 20)])
    assert [state["field"] for state in yaml.safe_load(proposal.text)["states"]] == ["data", "lag(data, 1)"]


def test_names_keep_the_letters_of_any_alphabet(tmp_path):
    x, rows = 0.0, []
    for k in range(400):
        u = math.copysign(1.0, math.sin(k / 17))
        rows.append((f"{0.02 * k:.2f}", f"{x:.5f}", u))
        x += 0.02 * (-2.0 * x + 3.0 * u) + 0.002 * math.sin(7 * k)
    proposal = propose([csv(tmp_path / "a.csv", ["Zeit", "Größe [mm]", "油门"], rows)])
    assert [c.name for c in (*proposal.states, *proposal.controls)] == ["größe_mm", "c_油门"]
    assert [c.unit for c in (*proposal.states, *proposal.controls)] == ["mm", ""]


def test_a_topic_that_one_recording_lacks_is_left_out(tmp_path):
    """Else no fit could read both; the others keep their places."""
    more = beside("/plant/more_state", lambda x, u: 2 * x)
    paths = [
        save(tmp_path / "a.mcap", driven(), {}),
        save(tmp_path / "b.mcap", driven(seed=1, extra=more), {}),
        save(tmp_path / "c.mcap", driven(seed=2), {"/plant/more_state": FLOAT64}),
    ]
    for order in (paths, paths[::-1]):
        proposal = propose(order)
        assert signals_of(proposal) == ([("/plant/state", "data")], [("/plant/cmd", "data")])
        assert "/plant/more_state: not in every recording" in proposal.text
        assert fitted(order, proposal).fit_summary["transients"] == 3


def test_a_command_that_one_recording_lacks_is_told_by_name(tmp_path):
    paths = [save(tmp_path / "a.mcap", driven(), {})]
    states_alone = [m for m in driven(seed=1) if m.topic == "/plant/state"]
    paths.append(write([Topic("/plant/state")], states_alone).save(tmp_path / "b.mcap"))
    proposal = propose(paths)
    assert not proposal.controls
    (warning,) = (w for w in proposal.warnings if "/plant/cmd" in w)
    assert str(paths[1]) in warning and str(paths[0]) not in warning and "leave those recordings out" in warning


def test_no_more_is_looked_at_than_memory_holds_and_every_number_is(tmp_path, monkeypatch):
    """Of more, some of the recordings, or a part of the one: every number but the first ones was passed over."""
    import uncertain_lti.proposal.init as module

    path, whole = proposed(tmp_path, driven(extra=beside("/plant/z_state", lambda x, u: 2 * x)))
    paths = [path, *(shutil.copy(path, tmp_path / f"{k}.mcap") for k in range(3))]
    numbers = 3 * len(whole.states[0].values[0])
    for most, of, looked_at in (
        (0.5 * numbers, paths[:1], "the middle 50% of run.mcap"),
        (2.5 * numbers, paths, "2 of 4 recordings"),
        (9 * numbers, paths, ""),
    ):
        monkeypatch.setattr(module, "MOST_VALUES", most)
        proposal = propose(of)
        assert signals_of(proposal) == signals_of(whole) and len(proposal.states) == 2
        assert looked_at in " ".join(proposal.warnings) and ("were looked at" in str(proposal.warnings)) == bool(
            looked_at
        )
        taken = sum(map(len, proposal.states[0].values)) * 3
        assert min(most, len(of) * numbers) * 0.7 < taken <= most + 9


# --- made up ones -----------------------------------------------------------------------------------------------


def test_a_command_is_found_by_its_effect_where_names_say_nothing(tmp_path):
    path, proposal = proposed(tmp_path, driven(("/b/state", "/a")))
    assert signals_of(proposal) == ([("/b/state", "data")], [("/a", "data")])
    assert "by correlation alone" in proposal.text


@pytest.mark.parametrize("other", ["/imu_2", "/actuator_cmd"])
def test_what_is_measured_by_its_name_is_no_command_nor_is_any_where_one_cannot_be_read(tmp_path, other):
    """Joint states and an IMU that tells where they go; or beside a command whose type the file does not define."""
    measured = other == "/imu_2"
    messages = driven(("/b/state", other if measured else "/a"))
    topics = [Topic("/b/state", FLOAT64), Topic(messages[1].topic, FLOAT64)]
    if not measured:
        topics.append(Topic(other, "some_msgs/msg/Command", schema=""))
        messages += [Message(other, m.log_time, b"\0\1\0\0", m.log_time) for m in messages[::2]]
    path = write(topics, messages).save(tmp_path / "run.mcap")
    proposal = propose([path])
    assert not proposal.controls and "by correlation" not in proposal.text
    words = f"{other} is a command by its name, and cannot be read"
    assert sum(text.startswith(words) for text in proposal.warnings) == (not measured)


@pytest.mark.parametrize(
    ("topic", "role"),
    [
        ("/controller/forward_kinematics", ""), ("/arm_controller/state", "state"), ("/motor_controls", "control"),
        ("/thruster/cmd/left", "control"), ("/controller/cmd_out", "control"), ("/u_speed", "control"),
        ("/commands/motor/speed", "control"), ("/lbr/command/joint_position", "control"),
        ("/cmd_full_state", "control"), ("/commands/motor/state", "state"), ("/cmd_vel_feedback", "state"),
        ("/motor/duty", "control"), ("/set_rpm", "control"), ("/set_current", "control"), ("/set_state", "state"),
        ("/mavros/rc/out", "control"), ("/mavros/rc/in", "reference"), ("/mavros/setpoint_raw/attitude", "reference"),
        ("/engine/rpm", "state"), ("/wheel_vels", "state"), ("/tank/level", "state"), ("/elevator/position", "state"),
        ("/gps/speed_over_ground", "state"), ("/gps/status", "apart"),
    ],
)  # fmt: skip
def test_a_controller_publishes_all_kinds(topic, role):
    assert role_by_name(topic, "std_msgs/msg/Float64") == role


def test_what_a_message_says_of_a_controller_is_no_state(tmp_path):
    """Of the state of a controller all was: what it follows, its errors, and what it puts out."""
    paths, schema = [], "".join(f"float64 {name}\n" for name in ("reference", "feedback", "error", "p_term", "output"))
    for seed in range(2):
        rng = np.random.default_rng(seed)
        messages, x, goal, total = [], 0.0, 0.0, 0.0
        for k in range(800):
            goal = float(rng.normal()) if k % 60 == 0 else goal
            y = x + 1e-3 * rng.normal()
            total += 0.02 * (goal - y)
            u = 2.0 * (goal - y) + total
            numbers = struct.pack("<5d", goal, y, goal - y, 2.0 * (goal - y), u)
            messages += [Message("/loop/pid_state", at(k), b"\0\1\0\0" + numbers), f64("/position", at(k) + MS, y)]
            x += 0.02 * (-2.0 * x + 3.0 * u)
        topics = [Topic("/loop/pid_state", "x_msgs/msg/Loop", schema=schema), Topic("/position")]
        paths.append(write(topics, messages).save(tmp_path / f"{seed}.mcap"))
    proposal = propose(paths)
    assert signals_of(proposal) == ([("/loop/pid_state", "feedback")], [("/loop/pid_state", "output")]), proposal.text
    assert "/loop/pid_state error, p_term: a controller's error" in proposal.text
    assert "/position: says what /loop/pid_state feedback says already" in proposal.text.replace(" data", "")
    assert signals_of(propose(paths, states=["/loop/pid_state"])) == signals_of(proposal)
    fitted(paths, proposal)


def test_the_current_that_a_motor_driver_puts_out_is_measured(tmp_path):
    """It was a control, as what a controller puts out, and a motor with two thirds of its torque was not seen."""
    schema, rng = "float64 target_rpm\nfloat64 output_current\nfloat64 rpm\n", np.random.default_rng(0)
    messages, current, rpm, target = [], 0.0, 0.0, 0.0
    for k in range(2000):
        target = float(rng.uniform(0, 1000)) if k % 60 == 0 else target
        numbers = struct.pack("<3d", target, current + 0.2 * rng.normal(), rpm + 2.0 * rng.normal())
        messages.append(Message("/motor/status", at(k), b"\0\1\0\0" + numbers))
        current += 0.02 * 10.0 * (0.02 * (target - rpm) + 0.1 * target - current)
        rpm += 0.02 * 6.0 * (10.0 * current - rpm)
    topic = Topic("/motor/status", "x_msgs/msg/Motor", schema=schema)
    proposal = propose([write([topic], messages).save(tmp_path / "motor.mcap")])
    expected = ([("/motor/status", name) for name in ("output_current", "rpm")], [("/motor/status", "target_rpm")])
    assert signals_of(proposal) == expected, proposal.text


@pytest.mark.parametrize("topic", ["/vehicle/steering_report", "/vehicle/throttle_report", "/vehicle/status"])
def test_what_reports_is_measured(topic):
    assert role_by_name(topic, "car_msgs/msg/Report") == "state"


def test_a_gear_of_a_message_is_no_state(tmp_path):
    rng, messages = np.random.default_rng(0), []
    u = np.repeat(rng.normal(size=(100, 1)), 20, axis=0)
    for k, speed in enumerate((10 + answers(rng, u, pole=0.95)[:, 0]).tolist()):
        status = struct.pack("<4si4xd", bytes([0, 1, 0, 0]), int(speed > 10) + int(speed > 11), speed)
        messages += [f64("/cmd", at(k) - MS, float(u[k, 0])), Message("/vehicle/status", at(k), status)]
    status = Topic("/vehicle/status", "car/msg/Status", schema="int32 gear\nfloat64 speed")
    proposal = propose([write([Topic("/cmd"), status], messages).save(tmp_path / "car.mcap")])
    assert [c.path for c in proposal.states] == ["speed"], proposal.text
    assert "gear" in proposal.text and "a code by its name" in proposal.text


def test_a_magnetometer_and_a_frame_are_measured_though_their_type_says_little():
    for topic, kind in (("/ardrone/mag", "Vector3Stamped"), ("/b", "MagneticField"), ("tf", "TransformStamped")):
        assert role_by_name(topic, f"geometry_msgs/msg/{kind}") == "state"
    assert role_by_name("/body_mage", "std_msgs/msg/Float64") == ""


COLUMNS = [(name, "reference") for name in ("q_des1", "tau_des", "sp_pitch", "yaw_sp_move_rate", "level_sp", "ref_x")]
COLUMNS += [(name, "state") for name in ("description", "spread", "gasp", "refuel_time", "sp_measured")]
COLUMNS += [("action[0..5]", "control"), ("action_3", "control"), ("reaction", "state"), ("tau[0..6]", "control")]
COLUMNS += [("referencia", "reference"), ("T_soll", "reference"), ("consigne", "reference"), ("isolle", "state")]
COLUMNS += [("zone3_heater", "control"), ("bypass_valve_pct", "control"), ("valve_temp", "state")]
COLUMNS += [("preheater", "state"), ("damper_feedback", "state"), ("mixing_valve_2", "control")]
COLUMNS += [("valve_setpoint", "reference"), ("Zieletage", "reference"), ("U_dc_V", "state"), ("U_q", "control")]


@pytest.mark.parametrize(("column", "role"), COLUMNS)
def test_what_is_desired_is_a_reference(column, role):
    assert role_of_column(column) == role


@pytest.mark.parametrize(
    ("columns", "controls"),
    [
        ("x u v r delta n", "delta n"), ("U_m_s V_m_s Q_rad_s rudder", "rudder"), ("x v u", "u"), ("n delta u", "u"),
        ("T_brine_in T_brine_out", ""), ("T_brine_in T_out in", "T_brine_in in"), ("Brake_IN Speed", "Brake_IN"),
        ("ESC_signal_µs Servo_1_us loop_us pump_duty", "ESC_signal_µs Servo_1_us pump_duty"),
        ("ESC_signal_µs Thrust_gf", "ESC_signal_µs"), ("Thrust_N Speed", "Thrust_N"), ("pwm thrust", "pwm thrust"),
        ("Pos_AccPedal drive_axle_speed DE_drive_end drive_cmd", "Pos_AccPedal drive_cmd"),
        ("pitch_input pitch_setpoint fin_output", "fin_output"), ("Input Setpoint Output", "Output"),
        ("setpoint error temperature output", "output"), ("input output", "input"), ("setpoint output", ""),
        ("I_U I_V I_W U_dc U_U U_V U_W", "U_U U_V U_W"), ("I_U_A I_V_A I_W_A x_u", "x_u"),
        ("q1 tau1 tau_con2 tau_meas1 tail_meas_tau tail_clipped_tau", "tau1 tau_con2 tail_clipped_tau"),
    ],
)  # fmt: skip
def test_a_velocity_of_a_body_and_an_inlet_are_measured_and_its_rudder_is_set(columns, controls):
    beside = {bare(column) for column in columns.split()}
    assert [c for c in columns.split() if role_of_column(c, beside) == "control"] == controls.split()


@pytest.mark.parametrize(("beside", "role"), [("r y u e", "reference"), ("x y u v r", "state"), ("r y", "state")])
def test_r_beside_u_and_y_is_a_set_point_and_no_yaw_rate(beside, role):
    assert role_of_column("r", set(beside.split())) == role


def test_a_cascade_keeps_every_tank(tmp_path):
    """The command shows in the first tank only; the others follow."""
    rng = np.random.default_rng(3)
    x, u, messages = np.zeros(3), 0.0, []
    for k in range(600):
        u = float(rng.normal()) if k % 40 == 0 else u
        t = 10**18 + k * 100 * MS
        level = x + 1e-4 * rng.normal(size=3)
        messages += [Message("/tanks/level", t, array(level), t), f64("/tanks/pump_cmd", t, u)]
        x = x + 0.1 * np.array([u - x[0], x[0] - x[1], x[1] - 0.8 * x[2]])
    proposal = proposed(tmp_path, messages, {"/tanks/level": ARRAY})[1]
    assert [c.path for c in proposal.states] == ["data[0]", "data[1]", "data[2]"], proposal.text


@pytest.mark.parametrize(
    ("kind", "sent", "field"),
    [
        (POSE, lambda t, yaw: pose("/body/state", t, yaw=yaw), "unwrap(yaw(pose.orientation))"),
        (POSE_2D, lambda t, yaw: wrapped("/body/state", t, yaw), "unwrap(theta)"),
        (POSE_2D, lambda t, yaw: wrapped("/body/state", t, yaw, 360.0), "unwrap(theta, 360)"),
    ],
    ids=["a quaternion", "by its name", "in degrees"],
)
def test_angles_are_unwrapped(tmp_path, kind, sent, field):
    """A yaw that turns round and round follows its rate; x, y, z, w are not offered beside it."""
    rng = np.random.default_rng(1)
    yaw, rate, messages = 0.0, 1.0, []
    for k in range(800):
        rate = float(rng.uniform(0.2, 3.0)) if k % 50 == 0 else rate
        t = at(k)
        messages += [sent(t, yaw), f64("/body/rate_cmd", t, rate)]
        yaw += 0.02 * rate
    path, proposal = proposed(tmp_path, messages, {"/body/state": kind})
    assert [c.path for c in proposal.states] == [field] and "orientation.w" not in proposal.text
    model = fitted([path], proposal)
    assert model.fit_summary["mean_width_recorded"][0] < (6.0 if "360" in field else 0.1), (
        "no jump by a turn inside the envelope"
    )
    assert model.domain.anywhere == [True, False], "however many turns there were"


def test_a_topic_of_unknown_name_is_taken_where_no_state_answers_and_its_bursts_count(tmp_path):
    """A noisy sensor was the state, the clock in the command's message a control, and eight messages at once a rate."""
    rng, late = np.random.default_rng(3), []
    for k, m in enumerate(
        driven(("/motor/listen", "/motor/cmd"), 1600, extra=lambda k, x, u: [f64("/imu_sensor", at(k), 0)])
    ):
        data = m.data if m.topic != "/imu_sensor" else cdr(FLOAT64, data=rng.normal())
        data += struct.pack("<d", k) * (m.topic == "/motor/cmd")
        late.append(Message(m.topic, at(k // 24 * 8 + 8) + 1000 * (k % 24), data))
    topics = [Topic("/motor/listen"), Topic("/imu_sensor")]
    topics.append(Topic("/motor/cmd", "my_msgs/msg/Cmd", schema="float64 data\nfloat64 t\n"))
    proposal = propose([write(topics, late).save(tmp_path / "a.mcap")])
    assert signals_of(proposal) == ([("/motor/listen", "data")], [("/motor/cmd", "data")]), proposal.text
    assert "step: constant\nmax_gap: 0." in proposal.text


def test_the_set_points_of_a_test_stand_are_its_commands_and_what_its_actuators_reach_is_measured(tmp_path):
    """Of an engine's test stand the throttle was the control and the manifold's pressure the only state."""
    rng, messages = np.random.default_rng(0), []
    speed, throttle, torque, demands = 0.0, 0.0, 0.0, np.zeros(2)
    for k in range(3000):
        demands = rng.normal(size=2) if k % 40 == 0 else demands
        values = {"/dyno/speed_demand": demands[0], "/engine/pedal_demand": demands[1], "/engine/speed": speed}
        values |= {"/engine/throttle_position": throttle, "/dyno/torque": torque}
        noise = 1e-3 * rng.normal(size=len(values)) * ["demand" not in topic for topic in values]
        messages += [
            f64(topic, at(k), value + more) for (topic, value), more in zip(values.items(), noise, strict=True)
        ]
        throttle += 0.1 * (demands[1] - throttle)
        torque += 0.2 * (throttle + 3 * (speed - demands[0]) - torque)
        speed += 0.05 * (throttle - torque)
    path, proposal = proposed(tmp_path, messages)
    assert {c.topic for c in proposal.controls} == {"/dyno/speed_demand", "/engine/pedal_demand"}, proposal.text
    assert {c.name for c in proposal.states} == {"speed", "throttle_position", "torque"}, proposal.text
    fitted([path], proposal)
    asked = propose([path], states=["/engine/speed"])
    assert [c.topic for c in asked.states] == ["/engine/speed"], asked.text


def test_a_steering_angle_is_measured_where_a_command_moves_it_and_else_a_control(tmp_path):
    """Of a car with its CAN bus the wheel's angle was a control, so that no fault of the steering was seen."""
    rng, messages, sent, angle, turn = np.random.default_rng(0), [], 0.0, 0.0, 0.0
    for k in range(2000):
        sent = float(rng.normal()) if k % 40 == 0 else sent
        measured = np.array([angle, turn]) + 1e-3 * rng.normal(size=2)
        values = zip(("/steering_cmd", "/can/steering_angle", "/gyro/z"), (sent, *measured), strict=True)
        messages += [f64(topic, at(k), float(value)) for topic, value in values]
        angle, turn = angle + 0.2 * (sent - angle), turn + 0.1 * (angle - turn)
    _, proposal = proposed(tmp_path, messages)
    assert [c.name for c in proposal.states] == ["steering_angle", "gyro_z"], proposal.text
    assert [c.topic for c in proposal.controls] == ["/steering_cmd"], proposal.text
    _, proposal = proposed(tmp_path, [m for m in messages if m.topic != "/steering_cmd"])
    assert signals_of(proposal) == ([("/gyro/z", "data")], [("/can/steering_angle", "data")]), proposal.text


def test_a_throttle_in_a_table_is_measured_and_the_speed_that_is_asked_for_a_control(tmp_path):
    """Of a car's CAN log angle and throttle were controls, and the speed asked for was left out beside steering_cmd."""
    rng, rows, sent, x = np.random.default_rng(0), [], np.zeros(2), np.zeros(3)
    for k in range(2000):
        sent = rng.normal(size=2) if k % 40 == 0 else sent
        rows.append([f"{0.02 * k:.2f}", *sent, *(x + 1e-3 * rng.normal(size=3))])
        x = x + [0.2 * (sent[0] - x[0]), 0.2 * (2 * (sent[1] - x[2]) + sent[1] - x[1]), 0.05 * (x[1] - x[2])]
    names = ["time", "steering_cmd_rad", "target_speed_mps", "steering_angle_deg", "throttle_position_pct", "accel_x"]
    proposal = propose([csv(tmp_path / "can.csv", names, rows)])
    assert {c.name for c in proposal.states} == {*names[3:]}, proposal.text
    assert {c.name for c in proposal.controls} == {*names[1:3]}, proposal.text


def test_an_outer_set_point_is_none_where_the_command_that_follows_it_is_recorded(tmp_path):
    rng, messages, x, target, integral = np.random.default_rng(0), [], 0.0, 0.0, 0.0
    for k in range(2000):
        target = float(rng.normal()) if k % 60 == 0 else target
        u = 2.0 * (target - x) + integral
        messages += [f64("/base/target", at(k), target), f64("/base/cmd", at(k), u), f64("/base/state", at(k), x)]
        integral += 0.02 * (target - x)
        x += 0.05 * (u - x) + 1e-3 * float(rng.normal())
    _, proposal = proposed(tmp_path, messages)
    assert signals_of(proposal) == ([("/base/state", "data")], [("/base/cmd", "data")]), proposal.text


def test_what_a_message_has_beside_what_is_commanded_is_measured_and_an_angle_named_by_its_topic_goes_round(tmp_path):
    """Of an aeroplane's `/nav_info/roll` the attitude was nothing by its name, and its heading jumped by 360."""
    rng, pair, messages = np.random.default_rng(1), "nav_msgs/msg/Pair", []
    angle, demand, speed = np.zeros(2), np.zeros(2), 16.0
    for k in range(2000):
        demand = rng.uniform(-40, 40, 2) if k % 40 == 0 else demand
        speed += 0.02 * (16 - speed + 0.01 * demand[0]) + 0.01 * float(rng.normal())
        for topic, now, sent in zip(("/nav_info/roll", "/nav_info/yaw"), angle, demand, strict=True):
            data = cdr(POSE_2D, x=sent, y=float((now + 180) % 360 - 180), theta=0.0)
            messages.append(Message(topic, at(k), data[:-8]))
        messages.append(f64("/hud/airspeed_measured", at(k), speed))
        angle += [0.1 * (demand[0] - angle[0]), 0.1 * demand[1] + 1.0] + 0.05 * rng.normal(size=2)
    pairs = [
        Topic(f"/nav_info/{axis}", pair, schema="float64 commanded\nfloat64 measured\n") for axis in ("roll", "yaw")
    ]
    path = write([*pairs, Topic("/hud/airspeed_measured", FLOAT64)], messages).save(tmp_path / "a.mcap")
    proposal = propose([path])
    assert {"roll_measured", "yaw_measured"} <= {c.name for c in proposal.states}, proposal.text
    assert {c.name for c in proposal.controls} == {"roll_commanded", "yaw_commanded"}, proposal.text
    (yaw,) = (c for c in proposal.states if c.name == "yaw_measured")
    assert yaw.path == "unwrap(measured, 360)"


def test_signals_of_one_name_have_the_word_in_which_their_topics_differ(tmp_path):
    """The two thrusters of a vessel were `thrust` and `thrust_command`."""
    both = driven(("/hull/surge", "/thrusters/left/thrust"), 800)
    both += driven(("/hull/yaw_speed", "/thrusters/right/thrust"), 800, seed=1)
    kind, rng, heat = "sensor_msgs/msg/Temperature", np.random.default_rng(0), np.full(2, 20.0)
    types = {"/engine/oil_temperature": kind, "/engine/inlet_temperature": kind}
    for k in range(800):
        sent = [float(np.frombuffer(both[2 * k + 1 + 1600 * number].data[-8:])[0]) for number in range(2)]
        for topic, value in zip(types, heat, strict=True):
            data = cdr(kind, header=header(at(k)), temperature=float(value), variance=0.0)
            both.append(Message(topic, at(k) + 1, data, at(k)))
        heat += 0.03 * (20.0 + np.array(sent) - heat) + 1e-3 * rng.normal(size=2)
    _, proposal = proposed(tmp_path, sorted(both, key=lambda m: m.log_time), types)
    assert {c.name for c in proposal.controls} == {"left_thrust", "right_thrust"}, proposal.text
    assert {"oil_temperature", "inlet_temperature"} <= {c.name for c in proposal.states}, proposal.text


def test_bursts_are_those_of_the_times_that_count(tmp_path):
    """Header stamps that mostly stand still came evenly; by the times of arrival half of the samples were gaps."""
    rng, messages, yaw = np.random.default_rng(4), [], 0.0
    for k in range(1600):
        yaw += 0.05 * rng.normal() - 0.05 * yaw
        stamped = pose("/base/pose", at(k // 4 * 4), yaw)
        messages.append(Message(stamped.topic, at(k // 8 * 8) + 1000 * (k % 8), stamped.data))
    _, proposal = proposed(tmp_path, messages, {"/base/pose": POSE})
    assert "/base/pose: {time: log}" in proposal.text and "step: constant\nmax_gap: 0." in proposal.text


def test_a_reading_that_flickers_is_no_switch_and_a_demand_a_command(tmp_path):
    """Two sensors that flicker in their last digit were the controls, and the current that is asked for no signal."""
    rng, rows, speed = np.random.default_rng(5), [], 0.0
    asked = np.repeat(rng.normal(size=40), 30).tolist()
    for k, current in enumerate(asked):
        rows.append([0.05 * k, speed, current, 621 + k % 2, 0.30 * current + 0.7 * speed, f"{0.05 * k:.2e}"])
        speed += 0.1 * (current - speed) + 0.01 * rng.normal()
    path = csv(tmp_path / "a.csv", ["time", "speed", "I_req", "adc_7", "V_bat", "way"], rows)
    proposal = propose([path])
    assert signals_of(proposal)[1] == [("/table", "I_req")], proposal.text
    assert "way: grows as a clock or a counter does" in proposal.text  # of three digits


def test_hours_of_running_are_no_signal(tmp_path):
    """Tenths of an hour, of which a recording has few, were a state, or a control that is set every six minutes."""
    rng, x, rows = np.random.default_rng(2), 0.0, []
    for k in range(1200):
        on = k // 50 % 2
        rows.append([k, f"{x:.3f}", on, f"{12345.2 + k // 360 / 10:.1f}"])
        x += 0.1 * (on - x) + 0.01 * rng.normal()
    proposal = propose([csv(tmp_path / "a.csv", ["time", "pressure", "K1_on", "K1_running_hours"], rows)])
    assert signals_of(proposal) == ([("/table", "pressure")], [("/table", "K1_on")])
    assert "K1_running_hours: grows as a clock or a counter does" in proposal.text


def test_of_commands_of_which_one_is_made_of_the_other_the_nearer_one_is_the_control(tmp_path):
    """Both were, and what came before the smoother, with a delay of its own, raised false alarms."""
    rng, messages, asked, sent, speed = np.random.default_rng(2), [], 0.0, 0.0, 0.0
    twist = "geometry_msgs/msg/Twist"

    def command(topic, k, value):
        ahead, none = (message("geometry_msgs/msg/Vector3", x=v, y=0.0, z=0.0) for v in (value, 0.0))
        body = cdr(twist, linear=ahead, angular=none)
        return Message(topic, at(k), body, at(k))

    for k in range(1500):
        asked = float(rng.uniform(-1, 1)) if k % 60 == 0 else asked
        sent += float(np.clip(asked - sent, -0.02, 0.02))
        names = {"/cmd_vel_nav": asked, "/cmd_vel": sent}
        messages += [*(command(topic, k, u) for topic, u in names.items()), f64("/base/state", at(k), speed)]
        speed += 0.1 * (sent - speed) + 1e-3 * float(rng.normal())
    _, proposal = proposed(tmp_path, messages, dict.fromkeys(names, twist))
    assert signals_of(proposal)[1] == [("/cmd_vel", "linear.x")]
    assert "#   /cmd_vel_nav linear.x: /cmd_vel is made of it, and nearer to the machine" in proposal.text


def test_a_trajectory_is_no_control_where_its_controller_tells_what_it_puts_out():
    """Where it is to end was a control beside the output, so that each new goal was a combination never fitted."""
    rng, kind = np.random.default_rng(2), "control_msgs/msg/JointTrajectoryControllerState"
    u = np.repeat(rng.normal(size=40), 25)
    x = np.zeros(1001)
    for k in range(1000):
        x[k + 1] = x[k] + 0.1 * (u[k] - x[k]) + 1e-3 * rng.normal()

    def source(topic, kind, role, values):
        found = Source(topic, kind, role, False, None, [np.arange(1000) * 20 * MS], [np.full(1000, -1)])
        found.candidates = [Candidate(found, "data", [values])]
        return found

    state = source("/joint_states", JOINT, "state", x[:1000])
    goal = source(
        "/arm/joint_trajectory", GOAL["/arm_controller/joint_trajectory"], "control", np.repeat(u[24::50], 50)
    )
    output = source("/arm/controller_state", kind, "control", u)
    assert assign_roles([state, goal, output]) == ([output], [state])
    assert goal.reason == "/arm/controller_state is made of it, and nearer to the machine"
    goal.reason = ""
    assert assign_roles([state, goal]) == ([goal], [state])


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_a_slower_copy_of_the_states_is_not_said_to_be_unwatched(tmp_path, noise):
    """Of what ros2_control publishes besides, which says the same, `init` told to make a second model."""
    messages = driven(("/joint_states", "/plant/cmd"), 1500)
    rng, states = np.random.default_rng(1), [m for m in messages if m.topic == "/joint_states"][::2]
    values = [struct.unpack("<d", m.data[4:])[0] + noise * float(rng.normal()) for m in states]
    messages += [f64("/dynamic_states", m.log_time, value) for m, value in zip(states, values, strict=True)]
    _, proposal = proposed(tmp_path, messages)
    assert ("#   /dynamic_states: says what /joint_states says already" in proposal.text) == (noise == 0.0)
    assert bool(proposal.warnings) == (noise > 0.0)  # a second sensor


def test_whether_a_target_is_reached_is_no_reference():
    """`at_target` beside the height of a lift said so of the whole topic, of which nothing was a reference."""
    lift = Source("/lift/state", "lift_msgs/msg/State", "state", False, None)
    lift.candidates = [Candidate(lift, path) for path in ("height", "at_target", "target_height")]
    (target,) = part_by_role(lift)
    assert [c.path for c in target.candidates] == ["target_height"]
    target.reason = "a reference"
    (line,) = (line for line in _left_out([lift, target], {*lift.candidates}) if "reference" in line)
    assert line == "#   /lift/state target_height: a reference"


def test_the_number_of_a_picture_is_no_state_and_a_coarse_reading_no_switch(tmp_path):
    """A camera's frame was a state, and the humidity in whole percent a control, so that a fault of it was none."""
    rng, x, rows = np.random.default_rng(2), 0.0, []
    for k in range(600):
        rows.append([60 * k, k // 3, f"{x:.3f}", 50 + round(2 * math.sin(k / 40)), 20 + k // 50 % 3])
        x += 0.1 * (rows[-1][4] - 20 - x) + 0.01 * rng.normal()
    path = csv(tmp_path / "a.csv", ["time", "frame_id", "Temp", "Humidity", "fan_stage"], rows)
    proposal = propose([path])
    assert signals_of(proposal)[1] == [("/table", "fan_stage")], proposal.text
    assert [c.path for c in proposal.states] == ["Temp", "Humidity"]
    assert "frame_id: grows as a clock or a counter does" in proposal.text


def test_an_altitude_that_is_held_is_measured(tmp_path):
    """It was a copter's control by correlation, with which nothing could be wrong."""
    rng, yaw, rows = np.random.default_rng(4), 0.0, []
    for k, altitude in enumerate(np.repeat(rng.normal(size=60).round(2), 10).tolist()):
        rows.append([0.1 * k, f"{yaw:.4f}", altitude])
        yaw += 0.1 * (altitude - yaw) + 0.01 * rng.normal()
    for name, control in (("altitude_m", []), ("offset_m", [("/table", "offset_m")])):
        found = propose([csv(tmp_path / f"{name}.csv", ["time", "yaw", name], rows)])
        assert signals_of(found)[1] == control, found.text


@pytest.mark.parametrize("even", [True, False])
def test_columns_of_which_no_two_rows_in_a_row_have_a_number_are_of_their_rate_or_told_and_no_signals(tmp_path, even):
    """Of an engine's log at two rates no transition was left, and its gearbox was the command, which stood still."""
    rng, rows, speed = np.random.default_rng(6), [], 1000.0
    for k, throttle in enumerate(np.repeat(rng.uniform(0, 50, 40), 30).tolist()):
        slow = ["", ""] if k % 2 or not (even or k % 10) else [throttle, f"{throttle + rng.normal():.3f}"]
        rows.append([f"{0.02 * k:.2f}", speed, 3, *slow, f"{0.019 * k**1.01:.3f}"])
        speed += 0.1 * (1000 + 40 * throttle - speed) + rng.normal()
    path = csv(tmp_path / "a.csv", ["time", "rpm", "drivetrain_gear", "dbw_target", "tps", "Test (Sec)"], rows)
    proposal = propose([path])
    if even:
        states, controls = signals_of(proposal)
        assert ("/table", "rpm") in states and controls == [("/table/dbw_target", "dbw_target")], proposal.text
        assert fitted([path], proposal).fit_summary["violations"] == 0
        return
    assert signals_of(proposal) == ([("/table", "rpm")], []), proposal.text
    (warning,) = proposal.warnings
    assert re.search("a number of (dbw_target, tps|tps, dbw_target); where it holds.* fill the empty cells", warning)
    assert "Test_Sec: grows as a clock" in proposal.text
    assert fitted([path], proposal).fit_summary["violations"] == 0


def test_words_of_a_switch_are_controls_each_and_read_in_other_recordings(tmp_path):
    """A heater that Excel wrote as WAHR and FALSCH, a fan and a line with words of their own were lost."""
    rows, heat = [], 20.0
    for k in range(600):
        on, fan = k // 40 % 2, ("low", "high", "Off")[k // 70 % 3]
        pump, line = k // 55 % 2, ("RUN", "IDLE", "STOP")[k // 35 % 3]  # the latter with a word that is no truth
        words = ("FALSCH", "WAHR")[on], fan, "abc"[k // 50 % 3], ("STOP", "RUN")[pump], line
        rows.append([0.1 * k, f"{heat:.4f}", *words])
        heat += 0.05 * (20 + 30 * on - 20 * pump - (fan == "high") * 25 - heat)
    names = ["time", "heat", "heater", "fan", "fault_label", "pump", "line"]
    proposal = propose([csv(tmp_path / "a.csv", names, rows)])
    states, controls = signals_of(proposal)
    assert states == [("/table", "heat")] and ("/table", "fan_high") in controls, proposal.text
    assert "line_STOP" in proposal.text and "a, b, c" not in proposal.text  # which does nothing, and a label
    assert 'words: {fan: [low, high, "Off"], line: [RUN, IDLE, STOP]}' in proposal.text
    fitted([tmp_path / "a.csv"], proposal)
    layout = TableLayout(words={"line": ["IDLE", "RUN"], "fan": ["Off", "low"]})
    for k, words in enumerate((["RUN", "STOP", ""], ["STOP", "RUN", ""], ["IDLE", "jam", "jam"])):  # some are truths
        cells = [[row, 1.0, word] for row, word in zip(range(6), words * 2, strict=True)]
        (table,) = group_recordings([csv(tmp_path / f"{k}.csv", ["time", "x", "line"], cells)], layout=layout)
        runs = table.columns(["/table"], [[FieldPath("line_RUN")]]).values[0][:3, 0]
        np.testing.assert_array_equal(runs, [float(word == "RUN") if word else np.nan for word in words])
    own = [[row, word, 7 + row] for row, word in enumerate(("RUN", "IDLE", "RUN", "IDLE"))]
    (table,) = group_recordings([csv(tmp_path / "own.csv", ["time", "line", "line_RUN"], own)], layout=layout)
    assert table.columns(["/table"], [[FieldPath("line_RUN")]]).values[0][:, 0].tolist() == [7, 8, 9, 10]
    by_turns = [[0.1 * k, *((k % 9, "", "") if k % 2 else ("", math.sin(k), k % 7)), "AB"[k % 2]] for k in range(300)]
    names = ["time", "CMD.u", "ATT.r", "ATT.p", "kind"]
    assert "words" not in propose([csv(tmp_path / "turns.csv", names, by_turns)], states=["*"]).text


@pytest.mark.parametrize(
    "names", [("x(m)", "y(m)", "vx(m/s)", "vy(m/s)"), ("pos_x", "pos_y", "velocity_x", "velocity_y")]
)
@pytest.mark.parametrize("own", [True, False])
def test_the_place_of_a_body_goes_where_its_velocities_are_its_own(names, own, tmp_path):
    """Of a racing car the next stretch of a healthy drive was an alarm; by velocities of its frame a place is told."""
    rng, rows, x, y, heading, v, u = np.random.default_rng(8), [], 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3000):
        u = float(rng.normal()) if k % 40 == 0 else u
        turn = 0.4 + 0.1 * math.sin(k / 90)
        ahead, aside = (v, 0.05 * v * turn) if own else (v * math.cos(heading), v * math.sin(heading))
        rows.append([f"{0.02 * k:.2f}", *(f"{value + 1e-3 * rng.normal():.5f}" for value in (x, y, ahead, aside)), u])
        x, y, heading = x + 0.02 * v * math.cos(heading), y + 0.02 * v * math.sin(heading), heading + 0.02 * turn
        v += 0.02 * (5 + 2 * u - v)
    proposal = propose([csv(tmp_path / "car.csv", ["time", *names, "throttle_cmd"], rows)])
    assert ("a place in a fixed frame, where the velocities are the body's" in proposal.text) == own, proposal.text


@pytest.mark.parametrize(("turn", "left"), [(0.4, True), (0.01, False)])
def test_the_place_of_a_body_that_turns_goes_and_the_load_of_its_computer(turn, left, tmp_path):
    """Of a car on a track a drive elsewhere was outside all that was fitted."""
    rng, rows, x, y, heading, v, u = np.random.default_rng(8), [], 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(2000):
        u = float(rng.normal()) if k % 40 == 0 else u
        rows.append([f"{0.02 * k:.2f}", x, y, math.remainder(heading, math.tau), v + 1e-3 * rng.normal(), 30 + u, u])
        rows[-1] += [20_000 * (k % 50), k // 30 % 60, (math.sin(k / 300), math.cos(k / 200))[k % 2], math.sin(k / 99)]
        x, y, heading = (
            x + 0.02 * v * math.cos(heading),
            y + 0.02 * v * math.sin(heading),
            heading + 0.02 * turn * (1 + 2 * math.sin(k / 90)),
        )
        v += 0.02 * (5 + 2 * u - v)
    names = ["time", "vicon x", "vicon y", "vicon yaw", "speed", "CPU0", "throttle", "state_usec", "minute", "hdop"]
    names.append("Vertical Accuracy (m)")
    proposal = propose([csv(tmp_path / "car.csv", names, rows)])
    assert "/table CPU0, hdop, Vertical_Accuracy_m: of a computer or a receiver, by its name" in proposal.text
    assert "/table state_usec, minute: grows as a clock" in proposal.text, proposal.text
    assert proposal.text.count("a place of a body that turns") == 2 * left, proposal.text


def test_what_does_not_move_or_is_no_number_stands_in_comments(tmp_path):
    def extra(k, x, u):
        t = at(k)
        values = [x, 7.0, math.nan, float(k), math.inf if k < 390 else x, x]
        return [
            Message("/plant/all_state", t, array(values), t),
            Message("/plant/big_state", t, array(np.full(LONGEST_ARRAY + 1, x)), t),
            Message("/plant/talk", t, cdr("std_msgs/msg/String", data="x"), t),
        ]

    types = {"/plant/all_state": ARRAY, "/plant/big_state": ARRAY, "/plant/talk": "std_msgs/msg/String"}
    types |= {"/plant/silent_state": FLOAT64}
    path, proposal = proposed(tmp_path, driven(("/plant/x_state", "/plant/cmd"), extra=extra), types)
    comments = "\n".join(line for line in proposal.text.splitlines() if line.lstrip().startswith("#"))
    for words in (
        "data[1]: always 7", "data[2]: never a number", "data[3]: grows as a clock or a counter does",
        "data[4]: a number in 10 of 400 messages only", "data[5]: moves with data[0]",
        f"an array of {LONGEST_ARRAY + 1} numbers", "/plant/talk: no number in it",
        "/plant/silent_state: 0 messages only",
    ):  # fmt: skip
        assert words in comments
    assert fitted([path], proposal).fit_summary["violations"] == 0


def test_no_command_leaves_the_controls_empty(tmp_path):
    path, proposal = proposed(tmp_path, [m for m in driven() if m.topic == "/plant/state"])
    assert not proposal.controls and "controls: []" in proposal.text
    assert fitted([path], proposal).m == 0


def test_commands_that_come_now_and_then(tmp_path):
    """Five commands in the run: held until the next one."""
    every = driven(count=600)  # state, command, state, ...
    messages = [m for k, m in enumerate(every) if m.topic != "/plant/cmd" or k < 2 or m.data != every[k - 2].data]
    path, proposal = proposed(tmp_path, messages)
    assert [c.topic for c in proposal.controls] == ["/plant/cmd"]
    assert "max_hold" not in yaml.safe_load(proposal.text)["controls"][0]
    assert fitted([path], proposal).fit_summary["transitions"] > 500


def test_commands_at_a_rate_in_one_recording_and_now_and_then_in_the_next(tmp_path):
    """Those of the second, 0.74 s apart, hold until the next one; only the first has many."""
    now_and_then = [m for k, m in enumerate(driven(seed=1)) if m.topic == "/plant/state" or (k // 2) % 37 == 0]
    paths = [save(tmp_path / f"{k}.mcap", m, {}) for k, m in enumerate([driven(count=3000), now_and_then])]
    proposal = propose(paths)
    assert "max_hold" not in yaml.safe_load(proposal.text)["controls"][0]
    assert fitted(paths, proposal).fit_summary["transitions"] == 2999 + 399


def stamped(messages, stamp):
    """The state as a point with such stamps of log times."""
    for m in messages:
        if m.topic == "/plant/state":
            point = message("geometry_msgs/msg/Point", x=float(np.frombuffer(m.data[-8:])[0]), y=0.0, z=0.0)
            data = cdr("geometry_msgs/msg/PointStamped", header=header(stamp(m.log_time)), point=point)
            m = Message("/plant/state", m.log_time, data, m.log_time)
        yield m


@pytest.mark.parametrize(
    "stamps",
    [[lambda log: log - 86_400 * 10**9], [lambda log: 10**18], [lambda log: log, lambda log: 0]],
    ids=["a day behind the log, and a command without any", "the start of the driver", "not in the second recording"],
)
def test_stamps_that_cannot_be_used_give_way_to_times_of_arrival(tmp_path, stamps):
    types, paths = {"/plant/state": "geometry_msgs/msg/PointStamped"}, []
    for number, stamp in enumerate(stamps):
        paths.append(save(tmp_path / f"{number}.mcap", list(stamped(driven(seed=number), stamp)), types))
    proposal = propose(paths)
    assert yaml.safe_load(proposal.text)["topics"] == {"/plant/state": {"time": "log"}, "/plant/cmd": {"time": "log"}}
    assert fitted(paths, proposal).fit_summary["transitions"] > 300 * len(paths)


@pytest.mark.parametrize("noise", [0.1, 0.0])
def test_a_slower_sensor_is_a_state_where_the_faster_one_loses_little_at_its_instants(tmp_path, noise):
    """Of a vehicle what its gyro gives was watched alone, as it is the fastest, and at 100 Hz was mostly noise."""
    rng, messages, speed, turn, u = np.random.default_rng(0), [], 0.0, 0.0, 0.0
    for k in range(4000):  # 100 Hz, and the speed at 25 Hz
        u = float(rng.normal()) if k % 60 == 0 else u
        speed, turn = 0.98 * speed + 0.02 * u, 0.97 * turn + 0.03 * u + 0.01 * float(rng.normal())
        rate = f64("/imu/rate", at(k) // 2, turn + noise * float(rng.normal()))
        messages += [f64("/cmd", at(k) // 2 - MS, u)] * (k % 2 == 0) + [rate]
        messages += [f64("/wheels/speed", at(k) // 2 + 1000, speed + 0.01 * float(rng.normal()))] * (k % 4 == 0)
    _, proposal = proposed(tmp_path, messages)
    names, clock = (["rate", "speed"], "/wheels/speed") if noise else (["rate"], "/imu/rate")
    assert [c.name for c in proposal.states] == names and f"\nclock: {clock}\n" in proposal.text, proposal.text
    second = [w for w in proposal.warnings if "so nothing watches it; for a second model" in w]
    assert len(second) == (not noise) and all(w.endswith("--states /wheels/speed") for w in second)


def test_the_rate_that_is_told_is_that_of_the_times_that_count(tmp_path):
    """A simulation at a quarter of the real time was said to have 6.8 samples a second, and 29 were fitted."""
    states = [m for m in stamped(driven(), lambda log: 10**9 + (log - 10**9) // 4) if m.topic == "/plant/state"]
    text = propose([save(tmp_path / "a.mcap", states, {"/plant/state": "geometry_msgs/msg/PointStamped"})]).text
    (rate,) = re.findall(r"the sample instants: ([\d.]+) a second", text)
    steps = np.diff([m.log_time for m in states])
    assert float(rate) == pytest.approx(4e9 / float(np.median(steps)), rel=1e-3)


def test_recordings_are_told_apart_and_thousands_are_one_line(tmp_path):
    rows = [(0.1 * k, math.sin(0.1 * k), math.cos(0.3 * k)) for k in range(60)]
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        csv(tmp_path / folder / "run.csv", ["time", "x", "cmd"], rows)
    text = propose([tmp_path / "a" / "run.csv", tmp_path / "b" / "run.csv"]).text
    assert all(f"#   {tmp_path / folder / 'run.csv'}\n" in text for folder in ("a", "b"))
    runs = [(run, *row) for run in range(50) for row in rows]
    text = propose([csv(tmp_path / "all.csv", ["run", "time", "x", "cmd"], runs)]).text
    assert "#   all.csv[0] to all.csv[49]: 50\n" in text and "all.csv[7]" not in text


def test_topics_and_names_that_yaml_would_misread(tmp_path):
    names = ["yes", "12", "a b", "fan:speed"]
    rng = np.random.default_rng(0)
    x, messages = np.zeros(4), []
    for k in range(400):
        t = at(k)
        u = rng.normal()
        messages += [Message("/j/states", t, joint_state(t, x, names), t), f64("/j/cmd", t, u)]
        x = x + 0.02 * (-np.arange(1, 5) * x + u) + 1e-3 * rng.normal(size=4)
    path, proposal = proposed(tmp_path, messages, {"/j/states": "sensor_msgs/msg/JointState"})
    assert len(proposal.states) == 4
    assert fitted([path], proposal).n == 4


@pytest.mark.parametrize(("held", "words"), [(0.0, "the machine is at rest"), (0.3, "to the states cannot be told")])
def test_a_command_that_never_moves_is_told_and_rounding_is_no_state(tmp_path, held, words):
    """A vehicle that drove at one speed was called at rest, and a joint that moved by 4e-12 rad alarmed."""
    rng, x, messages = np.random.default_rng(0), np.zeros(2), []
    for k in range(400):
        x = 0.9 * x + [1.0, 1e-12] * rng.normal(size=2)
        messages += [Message("/j/states", at(k), joint_state(at(k), x, ["a", "b"]), at(k)), f64("/j/cmd", at(k), held)]
    _, proposal = proposed(tmp_path, messages, {"/j/states": JOINT})
    assert words in " ".join(proposal.warnings) and [c.path for c in proposal.states] == ["position[a]"]
    assert "which is rounding" in proposal.text


def test_nothing_to_propose_is_said(tmp_path):
    messages = [Message("/talk", k, cdr("std_msgs/msg/String", data="x"), k) for k in range(50)]
    path = save(tmp_path / "a.mcap", messages, {"/talk": "std_msgs/msg/String"})
    words = "looks like the state of a machine .*; record .* in `uncertain-lti init --states`"
    refuses(BagError, words, propose, [path])


def test_joints_that_come_in_messages_of_their_own_are_named(tmp_path, cli):
    """`init` proposed one of them without a word, and `fit` of all said to check the signals file."""
    messages, x = [], np.zeros(2)
    rng = np.random.default_rng(0)
    for k in range(300):
        u = float(np.sign(np.sin(k / 15)))
        for i, name in enumerate(("arm", "hand")):
            t = 20 * MS * k + i * MS
            messages.append(Message("/joint_states", t, joint_state(t, [x[i]], [name])))
        messages.append(f64("/cmd", 20 * MS * k + 2 * MS, u))
        x += 0.1 * (np.array([u, -u]) - x) + 0.01 * rng.normal(size=2)
    path = save(tmp_path / "a.mcap", messages, {"/joint_states": JOINT, "/cmd": FLOAT64})
    apart = (
        f"{path}: /joint_states: position[arm] come in other messages than position[hand], and the states of a model "
        "in one; fit a model for each, or publish all together, as joint_state_publisher with source_list does"
    )
    proposal = propose([path])
    assert [state.path for state in proposal.states] == ["position[hand]"] and proposal.warnings == (apart,)
    assert apart in cli("topics", path).err
    entries = [{"name": name, "topic": "/joint_states", "field": f"position[{name}]"} for name in ("arm", "hand")]
    with pytest.raises(FitError, match="no message of /joint_states has all of arm, hand; fit a model for those that"):
        fit(read_transients(path, SignalMap.from_dict({"states": entries})))


def test_a_command_of_a_plant_that_is_set_now_and_then_is_not_judged(tmp_path):
    """Nothing before tells of its changes: `fit` said to take away the `judged: true` that `init` wrote."""
    rng, x, rows = np.random.default_rng(0), 0.0, []
    feeds = np.repeat(rng.uniform(0.2, 1.0, 180), 5).round(4).tolist()
    for k, speed in enumerate(np.repeat(rng.uniform(0.2, 1.0, 15), 60).tolist()):
        valve = 0.5 + 0.1 * (1.0 - x)  # by a controller
        rows.append((k, f"{speed:.3f}", feeds[k] if k % 7 else "", f"{valve:.4f}", f"{x + 0.01 * rng.normal():.4f}"))
        x += 0.2 * (speed + feeds[k] + valve - x)
    proposal = propose([csv(tmp_path / "a.csv", ["time", "Pump_speed_cmd", "Feed_cmd", "Valve_cmd", "Flow"], rows)])
    judged = {c.path: c.judged for c in proposal.controls}
    assert judged == {"Pump_speed_cmd": False, "Feed_cmd": False, "Valve_cmd": True}
    assert "not judged, as it changes in 1.6% of the rows only" in proposal.text
    assert [c.path for c in proposal.states] == ["Flow"]
    (tmp_path / "s.yaml").write_text(proposal.text)
    model = fit(read_transients(tmp_path / "a.csv", tmp_path / "s.yaml"))
    assert "Pump_speed_cmd" not in model.state_names and "Valve_cmd" in model.state_names


def test_the_weather_is_an_input_and_a_flow_of_outdoor_air_is_measured(tmp_path):
    """As a state the outdoor temperature of an air handler was most of its false alarms."""
    rng, room, rows = np.random.default_rng(0), 20.0, []
    outdoor, flow = 10.0 + np.cumsum(rng.normal(size=(2, 600)), axis=1) * 0.2
    for k in range(600):
        heat = k // 50 % 2
        rows.append((k, heat, f"{outdoor[k]:.2f}", f"{flow[k]:.2f}", f"{room + 0.05 * rng.normal():.2f}"))
        room += 0.1 * (20.0 * heat + outdoor[k] - room) + 0.02 * flow[k]
    columns = ["time", "Heating", "AHU: Outdoor Air Temp", "AHU: Outdoor Air Flow", "Room"]
    modelica = ["time", "Heating", "weaSta_reaWeaTDryBul_y", "Flow", "Room"]
    assert [c.path for c in propose([csv(tmp_path / "b.csv", modelica, rows)]).controls] == modelica[1:3]
    proposal = propose([csv(tmp_path / "a.csv", columns, rows)])
    assert [c.path for c in proposal.controls] == ["Heating", "AHU_Outdoor_Air_Temp"]
    assert [c.path for c in proposal.states] == ["AHU_Outdoor_Air_Flow", "Room"]
    assert "the weather, by its name" in proposal.text and not any(c.judged for c in proposal.controls)


def test_millivolts_are_measured_and_entries_of_a_matrix_have_its_name(tmp_path):
    """`Load_Cell_mV` was set by a controller, as `mv` is a manipulated variable; `data[2]` was called 2."""
    rng = np.random.default_rng(0)
    valve = np.repeat(rng.integers(0, 2, 40), 10)
    columns = {
        "Load_Cell_mV": answers(rng, 1.0 * valve[:, None], 0.01)[:, 0],
        "Tank_mv": np.cumsum(rng.normal(size=400)),
    }
    path = table_of(tmp_path / "a.csv", columns | {"valve": valve}, 10.0 * np.arange(400))
    assert [c.path for c in propose([path]).states] == ["Load_Cell_mV"]
    u = np.repeat(rng.normal(size=40), 25)
    data = np.vstack([0.01 * np.arange(1000), u, answers(rng, u[:, None])[:, 0]])
    np.savez(tmp_path / "a.npz", data=data)
    proposal = propose([tmp_path / "a.npz"])
    assert [c.name for c in proposal.states] == ["data_1"] and [c.name for c in proposal.controls] == ["data_0"]


@pytest.mark.parametrize("names", ["B1_Temp,B1_Press,B1_Valve1,B1_Valve2", "Temp1,Temp2,Temp3,Temp4"])
def test_what_differs_in_its_numbers_alone_goes_together_and_some_state_is_left(tmp_path, names):
    """All of a unit, whose number the names begin with, went with its two valves: no state was left."""
    rng = np.random.default_rng(0)
    valves = np.repeat(rng.integers(0, 2, (40, 2)), 10, axis=0)
    columns = [*answers(rng, 1.0 * valves, 0.01).T, *valves.T]
    path = table_of(tmp_path / "a.csv", dict(zip(names.split(","), columns, strict=True)), 10.0 * np.arange(400))
    assert [c.path for c in propose([path]).states] == names.split(",")[:2]


def test_a_staircase_is_a_control_whatever_its_name_and_an_analyser_is_none(tmp_path):
    rng = np.random.default_rng(0)
    flow = np.repeat(rng.normal(size=(200, 1)), 10, axis=0)
    hot = answers(rng, flow, 0.01, 0.8)[:, 0]
    seen = hot[np.arange(2000) // 5 * 5]  # of the row in which it changes
    path = table_of(tmp_path / "a.csv", {"q": flow[:, 0], "hot": hot, "seen": seen}, 6.0 * np.arange(2000))
    proposal = propose([path])
    assert signals_of(proposal) == ([("/table", "hot")], [("/table", "q")])
    assert "set, for 10 rows each: the others follow it" in proposal.text
    assert re.search('"seen".*an analyser: holds each value for 5 rows', proposal.text)


def test_of_a_plant_a_twin_is_judged_and_what_says_the_same_to_the_last_digit_is_not(tmp_path):
    rng = np.random.default_rng(0)
    p = 50 + 20 * answers(rng, np.zeros((2000, 1)), 1.0, 0.9)[:, 0]
    columns = {"P1": p.round(3), "P2": (0.5 * p + 0.05 * rng.normal(size=2000)).round(3), "P1_bar": (1e-2 * p).round(4)}
    columns["P_set"] = np.repeat(rng.uniform(40, 60, 100), 20).round(1)
    columns["P_error"] = (columns["P_set"] - columns["P1"]).round(2)
    proposal = propose([table_of(tmp_path / "a.csv", columns, 60.0 * np.arange(2000))])
    assert [c.path for c in proposal.states] == ["P1", "P2"] and "P1_bar: moves with P1" in proposal.text
    assert re.search("P_error: follows from .*P_set", proposal.text)  # a step of the set point is no fault


def test_of_a_plant_a_position_that_keeps_close_to_its_set_point_is_judged(tmp_path):
    """Within the rounding of the set point it was taken for a copy, and a valve that sticks was not seen."""
    rng = np.random.default_rng(0)
    sent = np.repeat(rng.integers(10, 90, 150), 20)
    flow, keeps = answers(rng, sent[:, None] / 50)[:, 0], (sent + 0.05 * rng.normal(size=3000)).round(1)
    columns = {"Inlet_setpoint_pct": sent, "Inlet_opening_pct": keeps, "Flow": flow, "Sent_pct": 1.0 * sent}
    proposal = propose([table_of(tmp_path / "a.csv", columns, 5.0 * np.arange(3000))])
    assert [c.path for c in proposal.states] == ["Inlet_opening_pct", "Flow"], proposal.text
    assert [c.path for c in proposal.controls] == ["Inlet_setpoint_pct"]
    assert "Sent_pct: moves with Inlet_setpoint_pct" in proposal.text


def test_of_a_plant_a_set_point_that_only_rises_is_no_counter(tmp_path):
    """That of a furnace that heats up, in whole degrees: it was left out, and nothing was a control."""
    rng, paths = np.random.default_rng(0), []
    for batch, rate in enumerate((8, 10, 12)):
        asked = np.minimum(30 + np.arange(3000) * rate // 60, 500)
        columns = {"Setpoint_C": asked, "Zone_C": (20 + answers(rng, asked[:, None] - 20.0, 0.3)[:, 0] / 50).round(1)}
        paths.append(table_of(tmp_path / f"{batch}.csv", columns, np.arange(3000)))
    for some in (paths[:1], paths):
        assert signals_of(propose(some)) == ([("/table", "Zone_C")], [("/table", "Setpoint_C")])


def test_two_sensors_of_one_row_are_both_states_and_what_is_computed_from_one_is_not(tmp_path):
    """Of a robot's wheels and gyro, which tell the same, the wheels were left out, and no slip was seen."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.normal(size=(200, 1)), 20, axis=0)
    rate = answers(rng, u, pole=0.9)[:, 0]
    gyro, wheels = rate + 0.004 * rng.normal(size=4000), rate + 0.006 * rng.normal(size=4000)
    columns = {"gyro": gyro, "wheels": wheels, "rounded": (57.3 * gyro).round(1), "curved": np.exp(gyro)}
    columns["filtered"] = gyro.copy()
    for k in range(1, 4000):
        columns["filtered"][k] = columns["filtered"][k - 1] + 0.9 * (gyro[k] - columns["filtered"][k - 1])
    proposal = propose([table_of(tmp_path / "a.csv", columns | {"rate_cmd": u[:, 0]}, 0.05 * np.arange(4000))])
    assert [c.path for c in proposal.states] == ["gyro", "wheels"], proposal.text
    assert [c.path for c in proposal.controls] == ["rate_cmd"]


def test_wheels_of_one_axle_are_all_states(tmp_path):
    """They move together but for what each sensor adds, and a wheel whose sensor was wrong had no verdict."""
    rng, names = np.random.default_rng(0), ["front", "rear", "copy"]
    u = np.repeat(rng.normal(size=(200, 1)), 20, axis=0)
    speed, messages = 50 + 10 * answers(rng, u, pole=0.97)[:, 0], []
    for k, value in enumerate(speed.tolist()):
        front, rear = (value + 0.04 * rng.normal(size=2)).tolist()
        messages.append(f64("/cmd", at(k) - MS, float(u[k, 0])))
        messages.append(Message("/joint_states", at(k), joint_state(at(k), [front, rear, 2.0 * front], names), at(k)))
    _, proposal = proposed(tmp_path, messages, {"/joint_states": JOINT})
    assert [c.path for c in proposal.states] == ["position[front]", "position[rear]"], proposal.text
    assert "position[copy]: moves with position[front]" in proposal.text


def test_of_a_plant_every_thermometer_is_judged_though_they_agree_to_the_last_digit(tmp_path):
    """Of four in a battery the first was judged alone, and no drift of another one was seen."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.normal(size=(100, 1)), 20, axis=0)
    heat = 30 + 5 * answers(rng, u, 0.01, 0.98)[:, 0]
    columns = {f"temp_{i}": (heat + 0.02 * rng.normal(size=2000)).round(1) for i in (1, 2)}
    columns |= {"temp_3": columns["temp_1"], "current_cmd": u[:, 0]}
    proposal = propose([table_of(tmp_path / "a.csv", columns, 60.0 * np.arange(2000))])
    assert [c.path for c in proposal.states] == ["temp_1", "temp_2"] and "temp_3: moves with temp_1" in proposal.text


@pytest.mark.parametrize("step", [0.02, 60.0])
def test_a_computed_average_is_no_state(tmp_path, step):
    """It would see a fault of itself alone, to the last digit, where a real one moves what it is computed from, too."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.normal(size=(100, 1)), 20, axis=0)
    top, bottom, mean_wind = (answers(rng, u, 0.02, 0.9)[:, 0].round(3) for _ in range(3))
    columns = {"top_speed": top, "bottom_speed": bottom, "average_speed": ((top + bottom) / 2).round(3)}
    columns |= {"mean_wind_speed": mean_wind, "motor_cmd": u[:, 0]}
    path = table_of(tmp_path / "a.csv", columns, step * np.arange(2000))
    proposal = propose([path])
    assert [c.path for c in proposal.states] == ["top_speed", "bottom_speed", "mean_wind_speed"]
    asked = propose([path], states=["/table:average_speed"])
    assert [c.path for c in asked.states] == ["average_speed"]
    assert "average_speed: follows from top_speed, bottom_speed of the same row" in proposal.text


# --- many columns ------------------------------------------------------------------------------------------------


def test_a_table_of_many_columns_takes_seconds(tmp_path):
    rng = np.random.default_rng(3)
    rows, commands, measured = 1000, 30, 270
    u = np.repeat(rng.normal(size=(rows // 25, commands)), 25, axis=0)
    tau = rng.uniform(3, 40, measured)
    gain = rng.normal(size=(measured, commands)) * (rng.random((measured, commands)) < 0.1)
    x = np.zeros((rows, measured))
    for k in range(rows - 1):
        x[k + 1] = x[k] + (gain @ u[k] - x[k]) / tau
    x += 0.005 * rng.normal(size=x.shape)
    x[:, 3], x[:, 7] = 2 * x[:, 4] + 3, x[:, 8] ** 2
    names = [f"cmd_{j}" for j in range(commands)] + [f"temp_{j}" for j in range(measured)]
    names[commands + 7] = "head"
    columns = dict(zip(names, np.column_stack([u, x]).T, strict=True))
    table_of(tmp_path / "a.csv", columns, 0.1 * np.arange(rows), fmt="%.6g")
    with bounded(seconds=60):  # 400 columns took 442 s
        text = propose([tmp_path / "a.csv"]).text
    assert "temp_4: moves with temp_3" in text and "head: says what temp_8 says already" in text


def test_what_follows_what_of_many_long_columns_takes_seconds():
    X = np.cumsum(np.random.default_rng(3).normal(size=(20_000, 150)), axis=0)
    with bounded(seconds=20):  # least squares over all rows for each column took more
        functions(X)


def test_motors_that_follow_one_command_alike_are_all_states(tmp_path):
    """Of four wheels one was proposed, and nothing saw the other three fail."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.normal(size=40), 25)
    speed = answers(rng, u[:, None])[:, 0]
    columns = {f"m{i}": speed + 0.01 * rng.normal(size=len(u)) for i in (1, 2, 3)}
    columns |= {"m4": np.round(2 * columns["m1"] + 1, 6), "rpm": columns["m2"] * 9.55, "speed_cmd": u}
    columns |= {"imu_ts": 1.7e9 + 0.01 * np.arange(len(u)) - 0.05 * (np.arange(len(u)) % 97 == 5)}
    columns |= {"referencia": u + 0.1 * rng.normal(size=len(u)), "row": np.arange(len(u)) % 300}
    proposal = propose([table_of(tmp_path / "a.csv", columns, 0.01 * np.arange(len(u)))])
    assert [c.path for c in proposal.states] == ["m1", "m2", "m3"] and "m4: moves with m1" in proposal.text
    assert "/table referencia: a reference for some controller" in proposal.text
    assert "/table imu_ts, row: grows as a clock or a counter does" in proposal.text
    rows = np.column_stack([0.01 * np.arange(len(u)), *columns.values()])[:, [0, 1, 2, 6]]
    np.savetxt(tmp_path / "b.csv", rows, delimiter=",")
    assert len(propose([tmp_path / "b.csv"]).states) == 2, "each has noise of its own, whatever its name"


def follows(of, values):
    """Whether values are a smooth function of others at the same instants, or one sample off, but for white noise."""
    for a, b in ((of, values), (of[1:], values[:-1]), (of[:-1], values[1:])):
        if np.ptp(a) == 0 or np.ptp(b) == 0:
            return False
        fit = np.polynomial.Polynomial.fit(a, b, 3)
        rest = b - fit(a)
        share, moves = rest.std() / b.std(), np.diff(b).std() / b.std()
        memory = np.corrcoef(rest[1:], rest[:-1])[0, 1] if rest.std() > 0 else 0.0
        if share < 0.02 or (share < 0.15 and memory < 0.3 and moves < 0.7):
            return True
    return False


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6), missing=st.booleans())
def test_what_is_looked_for_at_once_leaves_out_nothing(seed, missing):
    rng = np.random.default_rng(seed)
    z = np.cumsum(rng.normal(size=(120, 3)), axis=0) * 10.0 ** rng.integers(-3, 4, 3) + rng.choice([0.0, 1e5])
    some = rng.choice([0.0, 1e-4, 0.1]) * z.std(axis=0) * rng.normal(size=z.shape)
    held = np.round(z[:, :1] / z[:, 0].std())
    X = np.column_stack([z, (z - z.mean(axis=0)) ** 2 + some, np.roll(z, 1, axis=0), 3 * z + some, held, held * 0])
    found, pairs = functions(X), list(permutations(range(X.shape[1]), 2))
    assert found.any() and [bool(found[i, j]) for i, j in pairs] == [follows(X[:, i], X[:, j]) for i, j in pairs]
    X[rng.random(X.shape) < 0.1 * missing] = rng.choice([np.nan, np.inf])
    table = Source("/table", "table", "state", False, None)
    pool = [Candidate(table, f"c{j}", [column[:50], column[50:]]) for j, column in enumerate(X.T)]
    pairs = [(a, b) for a, b in combinations(pool, 2) if _moves_with(b, a)]
    assert {(id(a), id(b)) for a, b in pairs} <= _may_move_with(pool)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_effects_that_are_found_at_once_are_those_one_by_one(seed):
    rng = np.random.default_rng(seed)
    X, U = (rng.normal(size=(80, 5)) + 3) * 10.0 ** rng.integers(-4, 5, 5), rng.normal(size=(80, 3))
    dX = X @ rng.normal(size=(5, 5)) * 0.1 + U @ rng.normal(size=(3, 5)) + rng.normal(size=(80, 5))
    steps, kept, rest = Steps(X, U, dX), [1, 3], [4, 0, 2]
    one, size = np.ones((80, 1)), np.abs(X).max(axis=0)

    def left(*known):
        Z = np.hstack([one, X / size, *known])
        return ((dX - Z @ np.linalg.lstsq(Z, dX, rcond=None)[0]) ** 2).sum(axis=0)

    every = [(left() - left(U)) / 3, *(left(np.delete(U, j, 1)) - left(U) for j in range(3))]
    unexplained = left(U) + 1e-12 * (dX**2).sum(axis=0)  # what rounding leaves
    np.testing.assert_allclose(steps.effects(), every / (unexplained / 71), rtol=1e-4, atol=1e-4)

    def effect(of, on):
        """Of these states in the next step of those, given those and the controls."""
        return Steps(np.hstack([X[:, on], U]), X[:, of], dX[:, on]).effects()[0]

    coupled = [max(*effect([j], kept), *effect(kept, [j])) for j in rest]
    np.testing.assert_allclose(steps.coupling(kept, rest), coupled, rtol=1e-6, atol=1e-6)


# --- the command ------------------------------------------------------------------------------------------------


def test_init_then_fit_then_what_is_next(tmp_path, cli):
    """The two lines it prints are the ones to type."""
    path = save(tmp_path / "run one.mcap", driven(), {})
    target = tmp_path / "signals.yaml"
    said = cli("init", path, "--output", target).out
    assert "states: state" in said and "--signals" in said
    assert "is there already" in cli("init", path, "--output", target, status=2).err, "it never writes over a file"
    model = tmp_path / "machine.model.json"
    assert "next" in cli("fit", path, "--signals", target, "--output", model).out
    assert cli("init", path).out == target.read_text()


# --- whatever comes ---------------------------------------------------------------------------------------------

WEIRD = [0.0, -0.0, 1.0, 1e-300, 1e300, -1e16, 3.0, 2.0**53, math.pi, math.inf, -math.inf, math.nan]
NAMES = ["/a", "/a/state", "/a/cmd", "/b/odom_vel", "/desired/x", "/x y/state", "/battery", "/ü", "no_slash", "/12"]


@settings(max_examples=20)
@given(st.data())
def test_whatever_is_recorded_gets_a_file_or_a_sentence(tmp_path_factory, data):
    """Any topics, rates, lengths of arrays and values, with the steps of a random walk or without any sense."""
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    messages = []
    for topic in data.draw(st.lists(st.sampled_from(NAMES), min_size=1, max_size=4, unique=True)):
        count, width = data.draw(st.integers(0, 120)), data.draw(st.integers(0, 30))
        kind = data.draw(st.sampled_from(["walk", "weird", "constant", "steps"]))
        steps = rng.normal(size=(count, width))
        values = {
            "walk": np.cumsum(steps, axis=0), "weird": rng.choice(np.array(WEIRD), size=steps.shape),
            "constant": np.ones_like(steps), "steps": np.round(steps),
        }[kind]  # fmt: skip
        step = data.draw(st.sampled_from([0, 1, 10**6, 10**8]))
        for k, row in enumerate(values):
            some = row[: rng.integers(0, width + 1)] if data.draw(st.booleans()) and kind == "weird" else row
            messages.append(Message(topic, k * step, array(some), k * step))
    messages.sort(key=lambda m: m.log_time)
    path = save(tmp_path_factory.mktemp("odd") / "a.mcap", messages, {m.topic: ARRAY for m in messages})
    try:
        proposal = propose([path])
    except BagError as error:
        assert "a.mcap" in str(error)
        return
    signals = SignalMap.from_dict(yaml.safe_load(proposal.text))
    try:
        (run,) = read_transients([path], signals)
        fit(run)
    except FitError as error:  # too few samples, or numbers that no arithmetic holds
        assert str(error)


# --- copies and noise ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("copy", [lambda x: -57.3 * x + 4.0, lambda x: np.exp(x / 3.0)], ids=["unit", "function"])
def test_a_function_of_a_state_in_another_topic_is_no_second_state(tmp_path, copy):
    messages, name = driven(), "/plant/pressure"
    sent = [(m.log_time, struct.unpack("<d", m.data[-8:])[0]) for m in messages if m.topic == "/plant/state"]
    proposal = proposed(tmp_path, messages + [f64(name, t, copy(x)) for t, x in sent])[1]
    assert len(proposal.states) == 1, proposal.text
    (left,) = {"/plant/state", name} - {proposal.states[0].topic}
    assert f"{left} data: says what {proposal.states[0].topic} data says already" in proposal.text


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_what_is_computed_from_several_signals_of_another_topic_is_no_state(tmp_path, noise):
    """Odometry of the wheels made the fit rank deficient, and its alarm named yaw at 4e9 times its threshold."""
    rng, messages, x, u = np.random.default_rng(0), [], np.zeros(2), np.zeros(2)
    for k in range(2000):
        t = at(k)
        u = rng.normal(size=2) if k % 37 == 0 else u
        read = x + 1e-3 * rng.normal(size=2)
        messages.append(Message("/joint_states", t, joint_state(t, read)))
        messages.append(f64("/speed", t, 0.04 * read.sum() + 0.04 * noise * rng.normal()))
        messages += [f64(f"/{side}_cmd", t, value) for side, value in zip(("left", "right"), u, strict=True)]
        x = x + 0.02 * (3.0 * u - 2.0 * x)
    proposal = proposed(tmp_path, messages, {"/joint_states": JOINT})[1]
    assert ({c.topic for c in proposal.states} == {"/joint_states"}) == (noise == 0.0), proposal.text
    told = "/speed data: says what /joint_states says already, several of its signals together"
    assert (told in proposal.text) == (noise == 0.0)


def test_of_a_state_and_its_square_the_state_stays_though_the_controls_show_more_in_the_square():
    rng = np.random.default_rng(0)
    u, x = rng.normal(size=400), np.cumsum(rng.normal(size=400))
    X = np.column_stack([(x - x.mean()) ** 2, x - x.mean()])
    topic = Source("/a", FLOAT64, "state", False, None)
    square, state = pool = [Candidate(topic, path, [column]) for path, column in zip("qx", X.T, strict=True)]
    steps = Steps(X, u[:, None], np.column_stack([u, 0.1 * u + rng.normal(size=400)]))
    assert drop_functions(steps, pool) == [state] and square.reason == "says what x says already"


def test_what_no_name_or_type_tells_is_offered_where_the_controls_show_in_it(tmp_path):
    """A torque cell of a message type of its own was in the list of reasons alone."""
    rng = np.random.default_rng(0)

    def cell(k, x, u):
        return [Message("/cell", at(k), array([2.0 * x + 1e-2 * rng.normal(), rng.normal()]), at(k))]

    messages = driven(("/joint_states/arm", "/plant/cmd"), count=2000, extra=cell)
    proposal = proposed(tmp_path, messages, {"/cell": ARRAY})[1]
    offered = [line for line in proposal.text.splitlines() if line.startswith("  # - ") and "/cell" in line]
    assert len(offered) == 2 and all("but the controls show in it" in line for line in offered), proposal.text
    assert {c.topic for c in proposal.states} == {"/joint_states/arm"}


def test_two_sensors_in_topics_of_their_own_are_both_states(tmp_path):
    rng = np.random.default_rng(1)
    pressure = beside("/aaa/sensor", lambda x, u: 101325.0 + 9810.0 * x + 10.0 * rng.normal())
    proposal = proposed(tmp_path, driven(count=2000, extra=pressure))[1]
    assert {c.topic for c in proposal.states} == {"/plant/state", "/aaa/sensor"}, proposal.text


@pytest.mark.parametrize(("second", "both"), [("/turn_cmd", True), ("/idle_cmd", False)])
def test_a_slower_topic_in_which_alone_a_command_shows_gives_states_and_the_clock(tmp_path, second, both):
    """Of a robot with an IMU of 100 Hz beside odometry of 50, only the yaw rate was judged, and no speed."""
    rng = np.random.default_rng(0)
    messages, speed, turn, u = [], 0.0, 0.0, np.zeros(2)
    for k in range(8000):
        t = 10**18 + 10 * k * MS
        if k % 40 == 0:
            u = rng.normal(size=2)
        messages += [f64("/imu", t, turn + 1e-3 * rng.normal())]
        if k % 2 == 0:
            messages += [f64("/odom", t, speed + 1e-3 * rng.normal())]
            messages += [f64("/drive_cmd", t, u[0]), f64(second, t, u[1])]
        speed += 0.01 * (3.0 * u[0] - 2.0 * speed)
        turn += 0.01 * (3.0 * u[1 if both else 0] - 2.0 * turn)
    path, proposal = proposed(tmp_path, messages)
    states = {"/imu", "/odom"} if both else {"/imu"}
    assert {c.topic for c in proposal.states} == states, proposal.text
    assert f"clock: {'/odom' if both else '/imu'}" in proposal.text
    assert ("/odom: comes at 50 Hz, and /imu at 100 Hz" in proposal.text) is not both
    fitted([path], proposal)


def test_a_heading_that_one_instant_tells_is_no_reason_to_leave_out_slower_topics(tmp_path):
    """It turned by many radians, so that what was unknown of it grew from next to nothing to twice as much."""
    rng = np.random.default_rng(0)
    messages, speed, turn, yaw, u = [], 0.0, 0.0, 0.0, np.zeros(2)
    for k in range(8000):
        t = 10**18 + 10 * k * MS
        if k % 40 == 0:
            u = rng.normal(size=2) + [0.0, 1.0]
        messages += [f64("/imu/yaw", t, yaw), f64("/imu/rate", t, turn + 1e-3 * rng.normal())]
        if k % 2 == 0:
            messages += [f64("/odom", t, speed + 1e-3 * rng.normal())]
            messages += [f64("/drive_cmd", t, u[0]), f64("/turn_cmd", t, u[1])]
        speed += 0.01 * (3.0 * u[0] - 2.0 * speed)
        turn += 0.01 * (3.0 * u[1] + 0.1 * u[0] - 2.0 * turn)
        yaw += 0.01 * turn
    _, proposal = proposed(tmp_path, messages)
    assert {c.topic for c in proposal.states} == {"/imu/yaw", "/imu/rate", "/odom"}, proposal.text


def test_a_slow_topic_with_a_command_of_its_own_does_not_slow_down_what_moves_in_between(tmp_path):
    """An arm of 100 Hz was judged at the 11 Hz of a heater, where only jumps 4 to 10 times as large are seen."""
    rng = np.random.default_rng(0)
    messages, speed, heat, u, power = [], 0.0, 20.0, 0.0, 0.0
    for k in range(6000):
        t = 10**18 + 10 * k * MS
        u, power = (float(rng.normal()) if k % 60 == 0 else u), (float(rng.random()) if k % 800 == 0 else power)
        messages += [f64("/arm_cmd", t, u)] * (k % 2 == 0) + [f64("/heater_cmd", t, power)] * (k % 20 == 0)
        messages += [f64("/arm/velocity", t, speed + 1e-2 * rng.normal())]
        messages += [f64("/heater/temperature", t, heat + 0.02 * rng.normal())] * (k % 9 == 0)
        speed += 0.01 * 12.0 * (u - speed)
        heat += 0.003 * (20.0 + 20.0 * power - heat)
    _, proposal = proposed(tmp_path, messages)
    assert [c.topic for c in proposal.states] == ["/arm/velocity"] and "\nclock: /arm/velocity\n" in proposal.text


def test_noise_is_no_state(tmp_path):
    rng = np.random.default_rng(2)
    noise = beside("/plant/temperature", lambda x, u: 20.0 + 0.1 * rng.normal() + 0.02 * u)
    proposal = proposed(tmp_path, driven(count=2000, extra=noise))[1]
    assert [c.topic for c in proposal.states] == ["/plant/state"], proposal.text
    (line,) = [line for line in proposal.text.splitlines() if "/plant/temperature" in line]
    assert "noise: one sample predicts" in line or "the controls do not show" in line


def test_a_recording_of_noise_alone_says_so(tmp_path, cli):
    rng = np.random.default_rng(3)
    messages = [f64("/plant/state", at(k), 1.0 + 0.1 * rng.normal()) for k in range(500)]
    path, proposal = proposed(tmp_path, messages)
    assert len(proposal.states) == 1 and "# Beware: nothing here is more than noise" in proposal.text
    assert "record the machine at work" in cli("init", path).err


@pytest.mark.parametrize("late", [0, 4])
def test_a_late_answer_becomes_the_delay_that_the_fit_would_name(tmp_path, late):
    path, proposal = proposed(tmp_path, driven(count=1500, seed=4, late=late))
    assert [c.delay for c in proposal.controls] == [late]
    assert not any("better when it is taken" in m for m in fitted([path], proposal).fit_summary["messages"])


# --- numbers that are none, memories, many alike, and what is asked for ---------------------------------------------


def test_numbers_that_stand_for_none_are_ignored_by_the_proposal(tmp_path):
    messages = driven()
    for k in range(0, len(messages), 100):
        messages[k] = f64("/plant/state", messages[k].log_time, 2146000000.0)
    path, proposal = proposed(tmp_path, messages)
    (entry,) = yaml.safe_load(proposal.text)["states"]
    assert entry["ignore"] == [2146000000.0] and entry["scale"] < 100
    (run,) = read_transients(path, SignalMap.from_dict(yaml.safe_load(proposal.text)))
    assert set(run.counters.of("invalid").values()) == {8}
    assert np.nanmax(run.x) < 100


def swinging(count=900):
    """A swing whose rate is not recorded, 50 Hz."""
    rng = np.random.default_rng(4)
    y, v, u, messages = 0.0, 0.0, 0.0, []
    for k in range(count):
        u = float(rng.normal()) if k % 40 == 0 else u
        t = at(k)
        messages += [f64("/plant/state", t, y + 1e-5 * rng.normal()), f64("/plant/cmd", t, u)]
        v += 0.02 * (-40.0 * y - v + u)
        y += 0.02 * v
    return messages


def test_a_rate_that_is_not_recorded_is_proposed_with_what_it_gains(tmp_path):
    path, proposal = proposed(tmp_path, swinging())
    data = yaml.safe_load(proposal.text)
    assert data["states"][1]["field"] in ("rate(data)", "lag(data, 1)") and "on left-out data" in proposal.text
    blind = SignalMap.from_dict(data | {"states": data["states"][:1]})
    width = [m.fit_summary["mean_width"][0] for m in (fitted([path], proposal), fit(read_transients(path, blind)))]
    assert width[0] < 0.3 * width[1]


MEMBERS = [("fan", "pump"), ('" a"', "b"), ("j 1", "j_1"), ("x:1", "y, 2"), ('"3"', '"4"'), ("{}", "no"), ("s", "data")]


@pytest.mark.parametrize("members", MEMBERS)
@pytest.mark.parametrize("kind", [None, *KINDS])
def test_every_signals_file_that_is_written_can_be_read(tmp_path, monkeypatch, members, kind):
    """Whatever members are called, with every memory of a state and of a command, delayed or not."""
    rng, t = np.random.default_rng(0), 10**18 + 20 * MS * np.arange(200)
    for path, delay, ignore, recalled in product(("a[{}]", "unwrap(a[{}])"), (0, 3), ((), (-1e-7, 1e9)), (0, 1)):

        def moving(topic, role, form, ignore=ignore, **more):
            source = Source(topic, FLOAT64, role, False, None, [t], [0 * t - 1])
            paths = [form.replace("{}", member) for member in members]
            noise = [[1e-9 * rng.normal(size=200)] for _ in paths]
            source.candidates = [Candidate(source, *of, ignore=ignore, **more) for of in zip(paths, noise, strict=True)]
            return source

        sources = [moving("/x", "state", path), moving("/u", "control", "a[{}]", delay=delay)]
        states, controls = (source.candidates for source in sources)
        one = [states[0]], [controls[0]]
        name_signals(*one)
        set_operating_point(*one)
        remembered = (Remembered(one[recalled][0].name, Memory(kind)),) if kind else ()
        monkeypatch.setattr(
            "uncertain_lti.proposal.signals_file.choose_memories", lambda *_, found=remembered: (found, 0.5)
        )
        alike = all_of_them(*one, {(c.topic, c.path): c for c in [*states, *controls]})
        text = signals_file([SimpleNamespace(path=tmp_path, topics={})], sources, *one, "", memory_lines(*one), alike)
        signals = SignalMap.from_dict(yaml.safe_load(text))
        assert len(signals.states) == max(1, len(alike)), text


def test_signals_of_two_robots_are_named_by_what_tells_their_topics_apart(tmp_path):
    robots = [
        driven((f"/fleet/{name}/speed", f"/fleet/{name}/cmd"), seed=seed) for seed, name in enumerate(("R1", "R2"))
    ]
    proposal = propose([save(tmp_path / "run.mcap", [*robots[0], *robots[1]], {})])
    signals = SignalMap.from_dict(yaml.safe_load(proposal.text))
    assert [s.name for s in signals.states] == ["r1_speed", "r2_speed"]
    assert [s.name for s in signals.controls] == ["r1_cmd", "r2_cmd"]


def test_what_is_asked_for_takes_the_place_of_what_looks_like_it(tmp_path):
    other = driven(("/other/state", "/other/cmd"), seed=3)
    path = save(tmp_path / "run.mcap", [*driven(), *other], {})
    proposal = propose([path], states=["/other/st*:data"], controls=["/other/cmd"])
    assert signals_of(proposal) == ([("/other/state", "data")], [("/other/cmd", "data")])
    assert "not asked for by --controls" in proposal.text
    rng = np.random.default_rng(0)
    b = np.repeat(rng.normal(size=(20, 1)), 20, axis=0)  # both in one topic
    table = table_of(tmp_path / "a.csv", {"A": answers(rng, b)[:, 0], "B": b[:, 0], "C": rng.normal(size=len(b))})
    for more in ("A", "*"):  # of which one is noise
        proposal = propose([table], states=[f"/table:{more}"], controls=["/table:B"])
        assert signals_of(proposal) == ([("/table", c) for c in more.replace("*", "AC")], [("/table", "B")])
    proposal = propose([table], controls=["/table:B"])  # one column of what is measured leaves the others there
    assert signals_of(proposal) == ([("/table", "A"), ("/table", "C")], [("/table", "B")])
    path = save(tmp_path / "car.mcap", driven(("/battery/state", "/battery/cmd")), {})  # called as of no machine
    refuses(BagError, "by its name or type; if it is one, name it in --states", propose, [path])
    proposal = propose([path], states=["/battery/state"], controls=["/battery/cmd"])
    assert signals_of(proposal) == ([("/battery/state", "data")], [("/battery/cmd", "data")])
    path = tmp_path / "run.mcap"
    for asked in ({"states": ["/none"]}, {"controls": ["/other/cmd:date"]}):
        refuses(BagError, "meets nothing that moves", propose, [path], **asked)


@pytest.mark.parametrize("asked", ["Belt speed [m/s]", "Belt_speed_m_s", "Belt*", "/table:Belt_speed_m_s"])
def test_a_column_is_asked_for_by_its_name_in_the_file_or_as_a_field(asked, tmp_path):
    """It had to be named with the topic that tables have."""
    rng = np.random.default_rng(0)
    speed = np.repeat(rng.normal(size=(20, 1)), 20, axis=0)
    path = table_of(tmp_path / "a.csv", {"A": answers(rng, speed)[:, 0], "Belt speed [m/s]": speed[:, 0]})
    assert signals_of(propose([path], controls=[asked]))[1] == [("/table", "Belt_speed_m_s")]
    refuses(BagError, "topics there: /table$", propose, [path], states=["none"])


def test_a_field_that_is_asked_for_without_its_topic_is_named_with_it(tmp_path):
    path = save(tmp_path / "run.mcap", driven(), {})
    refuses(BagError, "a field is asked for with its topic, /.*:data", propose, [path], states=["data"])


def table_of(path, columns, time=None, fmt="%.18e"):
    time = 0.01 * np.arange(len(next(iter(columns.values())))) if time is None else time
    rows = np.column_stack([time, *columns.values()])
    np.savetxt(path, rows, delimiter=",", header=",".join(["time", *columns]), comments="", fmt=fmt)
    return path


def test_how_well_something_is_received_is_no_control_where_it_hardly_moves(tmp_path):
    """Of two values, or always the same in a plant, it was one, and another number of satellites unlike the fit."""
    rng, heat = np.random.default_rng(4), np.repeat([0, 30, 60, 20, 50, 10] * 5, 20)
    columns = {"oven": answers(rng, heat[:, None] / 30)[:, 0], "heater": heat, "hdop": 0.7 + 0.1 * (heat > 40)}
    columns |= {"satellite_count": np.full(600, 10), "numsats": 27 - (heat > 20)}
    for step in (0.1, 60):  # a robot, a plant
        proposal = propose([table_of(tmp_path / "a.csv", columns, step * np.arange(600))])
        assert signals_of(proposal)[1] == [("/table", "heater")], proposal.text
        assert "/table hdop, satellite_count, numsats: of a computer or a receiver" in proposal.text


def test_the_way_travelled_is_no_signal_and_the_way_to_a_wall_is(tmp_path):
    """It stands while the vehicle does: it was a state of a diving robot, that each further dive left."""
    rng, rows, speed, way = np.random.default_rng(2), [], 0.0, 0.0
    for k, drive in enumerate(np.repeat(rng.integers(0, 3, 30), 20).tolist()):
        rows.append([k, speed, drive, way, 40 - 9 * math.sin(way / 20)])
        speed += 0.3 * (drive - speed) + 0.01 * rng.normal() * (drive > 0)
        way += max(speed - 0.5, 0.0)
    path = csv(tmp_path / "dive.csv", ["time", "speed", "thrust", "flightDistance", "distance_to_wall"], rows)
    proposal = propose([path])
    assert "/table flightDistance: grows as a clock or a counter does" in proposal.text, proposal.text
    assert "distance_to_wall: grows" not in proposal.text


def test_what_counts_the_hours_of_running_is_no_signal(tmp_path):
    """It was taken for a set point that the others follow; degrees that rise one by one are no such count."""
    rng = np.random.default_rng(0)
    u, rows = np.repeat(rng.normal(size=(30, 1)), 60, axis=0), np.arange(1800)
    warm = np.rint(80.0 - 60.0 * np.exp(-rows / 500.0))
    columns = {"speed": answers(rng, u)[:, 0], "speed_cmd": u[:, 0], "run_minutes": 1e4 + rows // 60, "warm": warm}
    text = propose([table_of(tmp_path / "run.csv", columns | {"crc": rng.integers(0, 1 << 32, 1800)}, rows)]).text
    assert "run_minutes: grows as a clock or a counter does" in text and "warm: grows" not in text
    assert "crc: of a computer or a receiver, by its name" in text


def answers(rng, commands, noise=1e-4, pole=0.95):
    """What follows commands (N, k) with a lag of the first order."""
    x = np.zeros_like(commands)
    for k in range(len(x) - 1):
        x[k + 1] = pole * x[k] + 0.05 * commands[k] + noise * rng.normal(size=x.shape[1])
    return x


def test_an_axis_that_is_mostly_noise_stays_with_its_body(tmp_path):
    """As on a small drone, where one of three rates is noisier than what it remembers."""
    rng = np.random.default_rng(4)
    commands = np.repeat(rng.normal(size=(200, 3)), 20, axis=0)
    rates = answers(rng, commands) + [0, 1, 0] * rng.normal(size=(4000, 3))
    columns = {f"w{axis}": rates[:, i] for i, axis in enumerate("xyz")}
    path = table_of(tmp_path / "a.csv", columns | {f"cmd_{i}": commands[:, i] for i in range(3)})
    assert [c.path for c in propose([path]).states] == ["wx", "wy", "wz"]


@pytest.mark.parametrize(("rows", "proposed"), [(8_000, 12), (13_500, 13)])
def test_a_thousand_transitions_of_each_carry_more_signals_than_twelve(tmp_path, rows, proposed):
    """As of a legged robot: with a third of its joints neither watched nor known, hardly a fault is seen."""
    rng = np.random.default_rng(6)
    commands = np.repeat(rng.normal(size=(rows // 20, 13)), 20, axis=0)
    joints = answers(rng, commands, pole=0.9)
    columns = {f"q{j}": joints[:, j] for j in range(13)} | {f"cmd_{j}": commands[:, j] for j in range(13)}
    found = propose([table_of(tmp_path / "a.csv", columns, fmt="%.6g")])
    assert len(found.controls) == proposed and len(found.states) == proposed


@pytest.mark.parametrize("below", ["", "s,%,rpm,\u00b0C,,open,V\n"])
def test_units_are_those_of_the_header_or_of_the_line_below_it(tmp_path, below):
    rng = np.random.default_rng(6)
    commands = np.repeat(rng.normal(size=(200, 1)), 20, axis=0)
    gains = rng.normal(size=(1, 5))
    heads = ["Time [s]", "Valve cmd (%)", "Shaft Speed [rpm]", "Oil {\u00b0C}", "Level [A]", "Level [B]", "Drop (1st)"]
    if below:
        heads = ["time", "valve_cmd", "shaft_speed", "oil", "level_1", "level_2", "drop"]
    rows = np.column_stack(
        [
            0.1 * np.arange(4000),
            commands,
            np.column_stack(
                [answers(rng, commands * g, pole=p) for g, p in zip(gains[0], (0.9, 0.8, 0.7, 0.95, 0.85), strict=True)]
            ),
        ]
    )
    path = tmp_path / "a.csv"
    path.write_text(f"{','.join(heads)}\n{below}" + "".join(",".join(f"{v:.6g}" for v in row) + "\n" for row in rows))
    found = propose([path])
    units = {c.name: c.unit for c in [*found.states, *found.controls]}
    named = [next(units.pop(name) for name in list(units) if name.startswith(of)) for of in ("shaft", "oil", "valve")]
    assert named == ["rpm", "\u00b0C", "%"]
    assert sum(map(bool, units.values())) == bool(below) and len(units) == 3  # brackets that tell two apart are no unit
    (tmp_path / "s.yaml").write_text(found.text)
    assert [s.unit for s in SignalMap.load(tmp_path / "s.yaml").controls] == ["%"]


def test_of_a_long_recording_stretches_from_everywhere_are_looked_at():
    t, values = np.arange(120_000), np.arange(120_000.0)
    x, u = (
        Candidate(Source(topic, "t", "", False, None, [t], [0 * t - 1]), "data", [values]) for topic in ("/x", "/u")
    )
    steps = steps_of([x], [u], [3])
    at = steps.X[:, 0]
    assert 35_000 < len(at) < 50_000 and at[0] < 1_000 and at[-1] > 118_000
    assert (steps.U[:, 0] == at - 3).all() and (steps.dX == 1).all() and np.median(np.diff(at)) == 1


def test_motors_are_taken_or_left_as_one_with_the_true_reason(tmp_path):
    rng = np.random.default_rng(5)
    commands = np.repeat(rng.normal(size=(300, 4)), 20, axis=0)
    motors, heat = answers(rng, commands, pole=0.9), answers(rng, commands, pole=0.98)
    others = np.column_stack([answers(rng, commands[:, :3]), answers(rng, commands[:, 1:], pole=0.97)])
    columns = dict(zip(["wx", "wy", "wz", "vx", "vy", "vz"], others.T, strict=True))
    columns |= {f"rpm_{i}": motors[:, i] for i in range(4)} | {f"cmd_{i}": commands[:, i] for i in range(4)}
    columns |= {f"temp_{i}": heat[:, i] for i in range(4)}
    proposal = propose([table_of(tmp_path / "a.csv", columns)])
    states = {c.path for c in proposal.states}
    families = [{"wx", "wy", "wz"}, {"vx", "vy", "vz"}, {f"rpm_{i}" for i in range(4)}, {f"temp_{i}" for i in range(4)}]
    assert all(family <= states or not family & states for family in families) and len(states) >= 10
    assert "at most 12 states are tried together" in proposal.text and "too short" not in proposal.text


@pytest.mark.parametrize(("rows", "cells", "most"), [(10_000, 14, 12), (50_000, 26, 26)])
def test_of_more_cells_alike_than_there_is_room_for_as_many_as_there_is_are_states(tmp_path, rows, cells, most):
    """One was, and of a recording that is looked at in stretches the room was that of the stretches."""
    rng = np.random.default_rng(6)
    commands = np.repeat(rng.normal(size=(rows // 50, 2)), 50, axis=0)
    heat = answers(rng, commands[:, np.arange(cells) % 2], pole=np.linspace(0.8, 0.97, cells))
    columns = {f"temp_{i}": heat[:, i] for i in range(cells)}
    columns |= {f"cmd_{i}": commands[:, i] for i in range(2)}
    assert len(propose([table_of(tmp_path / "a.csv", columns, fmt="%.6f")]).states) == most


def test_what_takes_longest_of_many_signals_says_how_far_it_is(tmp_path):
    """Of 72 columns `init` was silent for 13 s."""
    rng, asked = np.random.default_rng(6), []
    commands = np.repeat(rng.normal(size=(40, 1)), 50, axis=0)
    path = table_of(tmp_path / "a.csv", {"x": answers(rng, commands)[:, 0], "cmd": commands[:, 0]})
    found = propose([path], delays=lambda items, total: asked.append(total) or items)
    assert asked == [11] and found.text == propose([path]).text


def test_cells_alike_leave_room_for_what_is_unlike_them(tmp_path):
    """What one of many alike measures others show as well; a pressure, less driven than they, only itself."""
    rng = np.random.default_rng(6)
    commands = np.repeat(rng.normal(size=(200, 2)), 50, axis=0)
    heat = answers(rng, commands[:, np.arange(14) % 2], pole=np.linspace(0.8, 0.97, 14))
    columns = {f"temp_{i}": heat[:, i] for i in range(14)}
    columns["pressure"] = answers(rng, commands[:, :1], noise=0.02)[:, 0]
    columns |= {f"cmd_{i}": commands[:, i] for i in range(2)}
    proposed = [c.path for c in propose([table_of(tmp_path / "a.csv", columns, fmt="%.6f")]).states]
    assert len(proposed) == 12 and "pressure" in proposed


def test_every_axis_that_some_surface_turns_is_proposed(tmp_path):
    """As of an aeroplane, whose ailerons show far more than its elevator in everything together."""
    rng = np.random.default_rng(6)
    commands = np.repeat(rng.normal(size=(200, 2)), 20, axis=0)
    roll, pitch = answers(rng, commands).T * [[1.0], [0.5]] + rng.normal(size=(2, 4000)) * [[1e-4], [4e-3]]
    driven_by = {"aileron_cmd": commands[:, 0], "elevator_cmd": commands[:, 1]}
    at = np.arange(4000, dtype=np.int64) * 10**7
    body = Source("/pose", "geometry_msgs/msg/PoseStamped", "state", False, None, [at], [at])
    body.candidates = [Candidate(body, f"{n}(orientation)", [v]) for n, v in (("roll", roll), ("pitch", pitch))]
    surfaces = Source("/cmd", "std_msgs/msg/Float64MultiArray", "control", False, None, [at], [at])
    surfaces.candidates = [Candidate(surfaces, name, [v]) for name, v in driven_by.items()]
    states, _ = choose([body], [surfaces])
    assert [c.path for c in states] == ["roll(orientation)", "pitch(orientation)"]


def test_the_file_of_one_joint_is_that_of_all(recordings):
    path = recordings / "go2/test_3.mcap"
    proposal = propose([path], like="j5")
    data = yaml.safe_load(proposal.text)
    assert data["structure"] == "own" and len(data["states"]) == 2 and data["states"][0]["for"][-1] == "j11"
    assert [c.path for c in proposal.controls] == ["position[j5]"]
    signals = SignalMap.from_dict(data)
    assert (len(signals.states), len(signals.controls)) == (24, 12)
    (run,) = read_transients(path, signals)
    assert run.usable.sum() > 6000
    refuses(BagError, "no state and command of a member 'j55' \\(is j5 meant\\?\\)", propose, [path], like="j55")


# --- recordings that mislead ---------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["even", "fine", "lossy"])
def test_stamps_that_are_rounded_of_an_even_clock_make_the_step_constant(tmp_path, kind):
    """Three samples in ten milliseconds, stamped in whole ones or in microseconds, or one of them lost now and then."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.normal(size=60), 20)
    t = np.cumsum(1 + (rng.random(len(u)) < 0.3)) / 300 if kind == "lossy" else np.arange(len(u)) / 300
    t = np.round(t, 6 if kind == "fine" else 3)
    path = table_of(tmp_path / "run.csv", {"speed": answers(rng, u[:, None])[:, 0], "speed_cmd": u}, t)
    proposal = propose([path])
    assert ("step: constant" in proposal.text) == (kind == "even")
    if kind == "even":
        model = fitted([path], proposal)
        assert model.signals.step == pytest.approx(1 / 300, rel=2e-3)
        other = tmp_path / "recorded.yaml"
        other.write_text(proposal.text.replace("step: constant", "step: recorded"))
        recorded = fit(read_transients([path], other), describe_data=False)
        narrower = np.divide(model.fit_summary["mean_width"], recorded.fit_summary["mean_width"])
        assert narrower.max() < 0.5


def test_stamps_of_simulated_time_give_the_step_where_a_command_has_none(tmp_path):
    """Times of arrival jitter with the speed of the simulation, which differs from run to run."""
    vector3 = "geometry_msgs/msg/Vector3Stamped"
    paths = []
    for run, speed in enumerate((0.6, 0.9)):
        rng = np.random.default_rng(run)
        u = np.repeat(rng.normal(size=60), 20)
        x, wall, messages = answers(rng, u[:, None])[:, 0], 10**18, []
        for k in range(len(u)):
            messages.append(Message("/odom", wall, vector(20 * k * MS, x[k], 0.0), wall))
            messages += [f64("/cmd", wall, u[k])]
            wall += int(20 * MS / speed * rng.uniform(0.7, 1.3))
        paths.append(save(tmp_path / f"{run}.mcap", messages, {"/odom": vector3}))
    proposal = propose(paths)
    assert "\nstep: 0.02\n" in proposal.text and "/odom: {time: log}" in proposal.text, proposal.text
    assert fitted(paths, proposal).signals.step == 0.02


def test_recordings_of_two_rates_have_no_constant_step(tmp_path):
    rng = np.random.default_rng(3)
    paths = []
    for step in (0.08, 0.1):
        u = np.repeat(rng.normal(size=60), 20)
        columns = {"speed": answers(rng, u[:, None])[:, 0], "speed_cmd": u}
        paths.append(table_of(tmp_path / f"{step}.csv", columns, np.round(step * np.arange(len(u)), 2)))
    assert "step:" not in propose(paths).text


def test_a_delay_that_half_of_the_recording_denies_is_none():
    """The vanes follow the speed by a schedule, so that a late angle stands in for earlier speeds, by 4 %."""
    proposal = propose([Path(__file__).parents[1] / "bags" / "turbofan_levels_noise.mcap"])
    assert len(proposal.controls) == 4 and {c.delay for c in proposal.controls} == {0}


def joints(still=""):
    """Three joints, each driven by a command of its own; one of them may stand still."""
    rng = np.random.default_rng(3)
    names, x, u, messages = ["left", "right", "arm"], np.zeros(3), np.zeros(3), []
    moves = np.array([float(name != still) for name in names])
    for k in range(500):
        if k % 20 == 0:
            u = rng.uniform(-1.0, 1.0, 3) * moves
        t = at(k)
        for topic, values in (("/joint_states", x), ("/joint_commands", u)):
            messages.append(Message(topic, t, joint_state(t, values, names), t))
        x = x + (0.1 * (u - x) + 1e-3 * rng.standard_normal(3)) * moves
    return messages


def test_the_angle_of_a_wheel_is_no_state_beside_its_rate(tmp_path):
    """It grows with the way, beyond what any recording fitted; that of a steered wheel does not; efforts are ready."""
    messages, names, turned = [], ["wheel_left_joint", "steering_wheel"], np.zeros(2)
    for m in driven():
        if m.topic == "/plant/state":
            rate = float(np.frombuffer(m.data[-8:])[0]) * np.array([1.0, -0.5])
            turned = turned * [1.0, 0.9] + 0.02 * rate
            of = {"name": names, "position": turned, "velocity": rate, "effort": 3 * rate + 1}
            data = cdr(JOINT, header=header(m.log_time), **of)
            m = Message("/joint_states", m.log_time, data, m.log_time)
        messages.append(m)
    _, proposal = proposed(tmp_path, messages, {"/joint_states": JOINT})
    assert "position[wheel_left_joint]: grows with the way" in proposal.text
    assert "position[steering_wheel]: grows" not in proposal.text
    offered = re.findall(
        r'  # - .* field: "effort\[(\w+)\]".* # an effort answers within a step; taken in, it', proposal.text
    )
    assert sorted(offered) == sorted(names)


POINT = "trajectory_msgs/msg/JointTrajectoryPoint"


def commanded(order, of=("positions", "velocities"), coupled=0.0, together=False, named=True):
    """Joints of an arm that answer an array of commands in another order, and more than one of them may move as one."""
    rng = np.random.default_rng(3)
    names, still, empty = ["left", "right", "arm"], message("builtin_interfaces/msg/Duration", sec=0, nanosec=0), []
    x, v, u, messages, body = np.zeros(3), np.zeros(3), np.zeros(3), [], 0.0
    for k in range(1500):
        body += 0.05 * (u.sum() - body) + 1e-3 * float(rng.normal())
        if k % 20 == 0:
            u = rng.uniform(-1.0, 1.0, 3)
            u[2] = -0.5 * u[0] if together else u[2]
        pull = u + coupled * np.array([u[1], 0.0, 0.0])
        seen = (x, v) if "positions" in of else (v, pull - x)  # speed and current
        t, seen = at(k), [values + 1e-4 * rng.normal(size=3) for values in seen]
        if named:
            state = cdr(JOINT, header=header(t), name=names, position=seen[0], velocity=seen[1], effort=np.empty(0))
            messages += [f64("/gyro", t, body)]
        else:
            arrays = dict.fromkeys(("positions", "velocities", "accelerations", "effort"), np.array(empty))
            state = cdr(POINT, **arrays | dict(zip(of, seen, strict=True)), time_from_start=still)
        messages += [Message("/joint_states", t, state, t), Message("/arm_commands", t, array(u[list(order)]), t)]
        v = v + 0.02 * (40.0 * (pull - x) - 8.0 * v)
        x = x + 0.02 * v
    return messages


@pytest.mark.parametrize("together", [False, True])
def test_the_commands_of_an_array_without_names_are_of_the_joints_that_they_move(tmp_path, together):
    """As of the forward controllers of ros2_control: all joints were one model, with the strongest states of some."""
    order = (2, 0, 1)
    path, proposal = proposed(
        tmp_path, commanded(order, together=together), {"/joint_states": JOINT, "/arm_commands": ARRAY}
    )
    data = yaml.safe_load(proposal.text)
    assert data["structure"] == "own" and set(proposal.members) == {"left", "right", "arm"}
    (told,) = (w for w in proposal.warnings if "nothing watches" in w)
    assert told.startswith("/gyro is of none of the members, such as ") and told.endswith("--states /gyro")
    fields = {entry["for"][0]: entry["field"] for entry in data["controls"]}
    moved = {"arm": 0, "left": 1, "right": 2} if not together else {"left": 0, "arm": 1, "right": 2}  # in their order
    assert fields == {name: f"data[{k}]" for name, k in moved.items()}
    model = fitted([path], proposal)
    joint = [[name.partition("_")[0] for name in names] for names in (model.state_names, model.control_names)]
    assert len(joint[0]) == 6
    assert (np.any([model.B, model.dB], axis=0) <= np.equal.outer(*joint)).all()


@pytest.mark.parametrize(
    ("coupled", "of", "own"),
    [
        (0.0, ("positions", "velocities"), True),
        (3.0, ("positions", "velocities"), False),
        (0.0, ("velocities", "effort"), False),
    ],
)
def test_entries_of_arrays_without_names_are_of_one_joint_if_nothing_else_moves_it(tmp_path, coupled, of, own):
    """But not where another command moves it more, nor of what is no joint, as it has no angle with its rate."""
    messages = commanded((0, 1, 2), of, coupled, named=False)
    _, proposal = proposed(tmp_path, messages, {"/joint_states": POINT, "/arm_commands": ARRAY})
    data = yaml.safe_load(proposal.text)
    assert (data.get("structure") == "own") == own, proposal.text
    if own:
        assert [e["field"] for e in data["states"]][:2] == ["positions[{}]", "velocities[{}]"]
        assert [e["field"] for e in data["controls"]] == ["data[{}]"] and data["controls"][0]["for"] == ["0", "1", "2"]


def pointed(angles=("pan", "tilt"), wheels=(), amount=1.0):
    """Joints of which an angle alone is told, which come to where a trajectory or an array sends them; and wheels."""
    rng = np.random.default_rng(3)
    names, n, messages, x = [*angles, *wheels], len(angles), [], np.zeros(len(angles))
    u, v, speed = np.zeros(n), *np.zeros((2, len(wheels)))
    still = message("builtin_interfaces/msg/Duration", sec=0, nanosec=0)
    empty = dict.fromkeys(("velocities", "accelerations", "effort"), np.empty(0))
    for k in range(2000):
        t = at(k)
        if k % 40 == 0:
            u, speed = (rng.uniform(-1.0, 1.0, len(some)) for some in (u, v))
            to = message(POINT, positions=amount * u[::-1].copy(), **empty, time_from_start=still)
            goal = cdr("trajectory_msgs/msg/JointTrajectory", header=header(t), joint_names=angles[::-1], points=[to])
            messages += [
                Message("/arm_controller/joint_trajectory", t, goal, t),
                Message("/pan_tilt/commands", t, array(amount * u[::-1]), t),
            ]
        x = x + 0.15 * (u - x)
        v = v + 0.1 * (speed - v)
        seen = [values + 1e-3 * rng.normal(size=len(values)) for values in (x, v)]
        of = {"name": names, "position": [*seen[0], *np.zeros(len(wheels))], "velocity": np.empty(0)}
        of["velocity"] = [*np.zeros(n), *seen[1]] if wheels else np.empty(0)
        of = {key: np.array(value) if key != "name" else value for key, value in of.items()}
        messages += [Message("/joint_states", t, cdr(JOINT, header=header(t), **of, effort=np.empty(0)), t)]
        messages += [Message("/wheel/commands", t, array(speed), t)] if wheels else []
    return messages


GOAL = {"/joint_states": JOINT, "/arm_controller/joint_trajectory": "trajectory_msgs/msg/JointTrajectory"}


def test_the_commands_of_a_trajectory_are_of_the_joints_that_it_names(tmp_path):
    messages = [m for m in pointed() if m.topic in GOAL]
    _, proposal = proposed(tmp_path, messages, GOAL)
    data = yaml.safe_load(proposal.text)
    assert data["structure"] == "own" and set(proposal.members) == {"pan", "tilt"}
    assert [e["field"] for e in data["controls"]] == ["points[0].positions[{}]"]


@pytest.mark.parametrize(("amount", "own"), [(1.0, True), (3.0, False)])
def test_an_angle_alone_is_of_the_command_that_it_comes_to(tmp_path, amount, own):
    """Of two joints without a rate the commands of an array were those of both; in another unit they may be a pull."""
    topics = {"/joint_states": JOINT, "/pan_tilt/commands": ARRAY}
    _, proposal = proposed(tmp_path, [m for m in pointed(amount=amount) if m.topic in topics], topics)
    data = yaml.safe_load(proposal.text)
    assert (data.get("structure") == "own") == own, proposal.text
    if own:
        assert {e["for"][0]: e["field"] for e in data["controls"]} == {"pan": "data[1]", "tilt": "data[0]"}


@pytest.mark.parametrize(("wheels", "own"), [(0, True), (2, True), (3, False)])
def test_a_machine_of_which_commands_without_names_move_most_is_one(tmp_path, wheels, own):
    """Of a rover whose steering is a trajectory, and whose wheels are an array, the steering alone was watched."""
    names = [f"wheel_{i}" for i in range(wheels)]
    topics = GOAL | ({"/wheel/commands": ARRAY} if wheels else {})
    _, proposal = proposed(tmp_path, [m for m in pointed(wheels=names) if m.topic in topics], topics)
    data = yaml.safe_load(proposal.text)
    assert (data.get("structure") == "own") == own, proposal.text
    if not own:
        assert {f"velocity[{name}]" for name in names} < {entry["field"] for entry in data["states"]}


@pytest.mark.parametrize(("still", "members"), [("", ("left", "right", "arm")), ("right", ("left", "arm"))])
def test_the_file_is_for_all_that_move_alike(tmp_path, still, members):
    path, proposal = proposed(tmp_path, joints(still), {"/joint_states": JOINT, "/joint_commands": JOINT})
    assert proposal.members == members
    assert f"# {len(members)} that are alike: each depends on its own states and controls." in proposal.text
    assert ("position[right]: always 0" in proposal.text) == bool(still)
    model = fitted([path], proposal)
    assert model.state_names == members and model.fit_summary["violations"] == 0
    assert np.count_nonzero(model.dA - np.diag(np.diag(model.dA))) == 0


def test_one_that_is_asked_for_is_no_file_for_all(tmp_path):
    path = save(tmp_path / "joints.mcap", joints(), {"/joint_states": JOINT, "/joint_commands": JOINT})
    proposal = propose([path], states=["/joint_states:position[arm]"], controls=["/joint_commands:position[arm]"])
    assert proposal.members == () and "structure" not in yaml.safe_load(proposal.text)


def test_what_a_person_may_want_of_a_body_is_one_letter_away(recordings):
    """Depth alone holds on left-out data of 15 s; attitude, rates and speed are there to be taken in."""
    proposal = propose([recordings / "cougars_auv" / "SO_bag_0.mcap"])
    assert [c.path for c in proposal.states] == ["pose.pose.position.z"]
    for name in ("roll", "pitch", "yaw", "angular_velocity_y", "linear_x"):
        assert f"\n  # - {{name: {name}, " in proposal.text
    taken = re.sub(r"(?m)^  # - (\{name: (pitch|linear_x), )", r"  - \1", proposal.text)
    signals = SignalMap.from_dict(yaml.safe_load(taken))
    (run,) = read_transients(recordings / "cougars_auv" / "SO_bag_0.mcap", signals)
    assert run.x.shape[1] == 3 and run.usable.sum() > 120


def trials(path, column, ids, restart=True, per_run=60):
    """A table of runs; `column` says which a row is of."""
    rows, time, x = [], 0, 0.0
    for number in ids:
        for k in range(per_run):
            u = math.copysign(1.0 + 0.3 * (len(rows) + 1) % 7, math.sin((len(rows) + 1) / 9))
            rows.append((number, f"{(k if restart else time) * 0.1:.1f}", f"{x:.6f}", u))
            x += 0.1 * (u - x) + 0.003 * math.sin(11 * (len(rows) + 1))
            time += 1
    return csv(path, [column, "t", "speed", "command"], rows)


def test_a_servo_whose_command_comes_in_the_row_of_its_answer_is_a_state(tmp_path):
    rng = np.random.default_rng(0)
    commands = np.cumsum(rng.normal(size=(400, 2)), axis=0)
    place = answers(rng, commands)
    for k in range(399):
        place[k + 1, 1] = place[k, 1] + 0.9 * (commands[k + 1, 1] - place[k, 1]) + 1e-3 * rng.normal()
    path = table_of(
        tmp_path / "a.csv", {"x": place[:, 0], "y": place[:, 1], "cmd_x": commands[:, 0], "cmd_y": commands[:, 1]}
    )
    assert signals_of(propose([path])) == (
        [("/table", "x"), ("/table", "y")],
        [("/table", "cmd_x"), ("/table", "cmd_y")],
    )


@pytest.mark.parametrize(("name", "moves"), [("gate", True), ("gate", False), ("battery", True), ("ErrRP", True)])
def test_a_column_that_is_set_now_and_then_is_a_command_if_it_shows(tmp_path, name, moves):
    """A battery's level and a place, which change as seldom, were controls."""
    rng = np.random.default_rng(4)
    gate, level, rows = 0.0, 0.0, []
    for k in range(600):
        gate = float(rng.choice([0.0, 0.4, 1.0])) if k % 25 == 0 else gate
        rows.append((f"{0.1 * k:.1f}", gate, f"{level:.6f}"))
        level += 0.1 * ((gate if moves else 0.0) - 0.5 * level) + 1e-3 * rng.standard_normal()
    path = csv(tmp_path / "tank.csv", ["time", name, "level"], rows)
    proposal = propose([path])
    commands = [c.path for c in proposal.controls]
    moves = moves and name == "gate"
    assert commands == (["gate"] if moves else []), proposal.text
    assert ("by correlation alone: nothing is called a command here" in proposal.text) == moves
    if moves:
        assert [c.path for c in proposal.states] == ["level"]
        assert fitted([path], proposal).fit_summary["violations"] == 0


@pytest.mark.parametrize(
    ("column", "ids", "restart"),
    [("trial", [1, 2, 3], True), ("Run No", [7, 4, 9], False), ("label", ["a", "b", "c"], True)],
)
def test_a_column_that_says_which_run_a_row_is_of_is_named(tmp_path, column, ids, restart):
    path = trials(tmp_path / "trials.csv", column, ids, restart)
    proposal = propose([path])
    signals = SignalMap.from_dict(yaml.safe_load(proposal.text))
    assert signals.table is not None and signals.table.runs == column.replace(" ", "_")
    assert [s.name for s in signals.states] == ["speed"] and [c.name for c in signals.controls] == ["command"]
    assert [t.x.shape[0] for t in read_transients([path], signals)] == [60, 60, 60]


@pytest.mark.parametrize("ids", [[1, 2, 1], range(12)])
def test_a_mode_or_a_counter_tells_no_runs_apart(tmp_path, ids):
    path = trials(tmp_path / "modes.csv", "test", ids, restart=False, per_run=60 if len(ids) == 3 else 10)
    assert "table:" not in propose([path]).text


def test_what_switches_a_steady_power_is_a_control_and_no_copy_of_it(tmp_path):
    """A power known to 1 % was a state, with bounds as wide as itself, for want of the switch that left."""
    rng = np.random.default_rng(0)
    on = np.repeat(rng.integers(0, 2, 60), 20)
    power, level = np.round(on * (12.8 + 0.02 * rng.normal(size=1200)), 2), np.cumsum(0.1 * rng.normal(size=1200))
    rows = zip(60 * np.arange(1200), power, on, on * 24, np.round(level, 3), strict=True)
    path = csv(tmp_path / "plant.csv", ["time", "P1_POWER", "P1_RUN", "P1_VOLTS", "LEVEL"], rows)
    proposal = propose([path])
    assert {c.path for c in proposal.controls} == {"P1_POWER", "P1_RUN"}, proposal.text
    assert "P1_VOLTS: moves with P1_RUN" in proposal.text and [c.path for c in proposal.states] == ["LEVEL"]


def test_a_plant_has_every_measurement_judged_and_what_is_set_as_controls(tmp_path):
    """A pump that is switched and its flow, one that never ran, an analyser, a label, a valve of a controller."""
    rng = np.random.default_rng(0)
    rows, level, analyser = [], 1.0, 0.0
    on = np.repeat(rng.integers(0, 2, 60), 20)
    for k in range(1200):
        flow, valve = on[k] * (30 + rng.normal()), 50 + 5 * (level - 1) + rng.normal()
        analyser = rng.normal() if k % 5 == 0 else analyser
        pressure = 2 * flow + 3 * rng.normal()
        switch = 1 + on[k] if k else ""
        rows.append([60 * k, level, rng.normal(), pressure, switch, flow, 0, valve, analyser, level, int(k == 700)])
        quality = [64 if k in (i, i + 9) else 192 for i in (31, 42, 53)]
        rows[-1] += [622 + int(rng.integers(2)), rng.random(), *quality, 60.0 * k + 7]
        level += 0.01 * (flow - 15) - 0.05 * (level - 1) + 0.01 * rng.normal()
    names = ["time", "Level1", "Temp", "Press", "S_PU1", "F_PU1", "S_PU2", "XMV_1", "Ratio", "Level1_again", "ATT_FLAG"]
    names += ["Flicker", "elapsed", "Level1_Q", "Temp_Q", "Press_Q", "Elapsed [s]"]
    path = csv(tmp_path / "plant.csv", names, rows)
    proposal = propose([path])
    assert [c.name for c in proposal.states] == ["Level1", "Temp", "Flicker"], proposal.text
    why = {c.name: c.why for c in proposal.controls}
    assert why["S_PU1"] == "switched between 1, 2" and why["F_PU1"] == "0 whenever S_PU1 is off"
    assert why["S_PU2"].startswith("always 0 here, so its effect is unknown") and "judged as well" in why["XMV_1"]
    for words in ("Ratio.*an analyser: holds each value for 5 rows", "Press.*answers within a row", "ATT_FLAG: a label",
                  "Level1_again: moves with Level1", "elapsed: of a computer", "Elapsed_s: grows as a clock",
                  "Level1_Q, Temp_Q, Press_Q: a quality code"):  # fmt: skip
        assert re.search(words, proposal.text), words
    assert not any(c.steady for c in [*proposal.states, *proposal.controls]), "fit decides what to count from"
    model = fitted([path], proposal)
    assert model.state_names == ("Level1", "Temp", "Flicker", "XMV_1") and model.fit_summary["violations"] == 0
    noise = [message for message in model.fit_summary["messages"] if "'Temp'" in message and "like noise" in message]
    assert noise and "leave it out" not in noise[0] and "its level is judged" in noise[0]  # as the proposal has it
    assert "its level is judged, how it moves needs faster rows" in remedies(noise, "noise", "Temp")


@pytest.mark.parametrize("switched", [False, True])
def test_a_plant_whose_load_nobody_tells_is_said_to_lack_it(tmp_path, switched):
    """Of a genset's ambient temperature and count of starts were the controls, and 10 of 12 faults were early."""
    rng, rows, heat = np.random.default_rng(1), [], 0.0
    for k in range(600):
        load = 100 + 50 * (k // 60 % 3) + rng.normal()
        heat += 0.05 * (load - heat)
        rows.append([k, load, heat + rng.normal(), 20 + 0.01 * k + rng.normal(), 211, k // 40 % 2])
    names = ["time", "Power", "Exhaust", "Ambient temp", "Num starts", "Fan on"]
    path = csv(tmp_path / "genset.csv", names[: 5 + switched], [row[: 5 + switched] for row in rows])
    proposal = propose([path])
    assert {c.name for c in proposal.controls} >= {"Ambient_temp", "Num_starts"}
    said = [text for text in proposal.warnings if "nothing in it is set or switched; what loads the machine" in text]
    assert len(said) == (not switched), proposal.text


def test_what_a_fast_table_measures_is_judged_also_where_it_is_noise(tmp_path):
    """Of a motor on a stand at 10 rows a second the temperatures, which a fault shows in, were left out."""

    def recorded(name, seed, heated=0.0):
        rng, rows, speed = np.random.default_rng(seed), [], 0.0
        for k in range(1500):
            command = 10.0 + 5.0 * (k // 100 % 3)
            rows.append((k / 10, command, speed + 0.1 * rng.normal(), 60 + 0.3 * rng.normal() + heated * (k > 700)))
            speed += 0.2 * (command - speed)
        return csv(tmp_path / name, ["time", "motor_cmd", "speed", "Temp"], rows)

    run = recorded("healthy.csv", 1)
    proposal = propose([run])
    assert [c.name for c in proposal.states] == ["speed", "temp"] and "its level is judged" in proposal.text
    model = fitted([run], proposal)
    healthy, hot = (read_as_fitted(recorded(f"{h}.csv", 2, h), model.signals) for h in (0.0, 3.0))
    assert not EnvelopeMonitor(model).check(healthy).alarm.any()
    assert EnvelopeMonitor(model).check(hot).alarm[702:].any()


def test_noise_with_rare_bursts_is_no_state(tmp_path):
    """No level shows in it, and every burst that is larger than those recorded was an alarm."""
    rng = np.random.default_rng(4)
    command = np.repeat(rng.uniform(-1, 1, (60, 1)), 20, axis=0)
    bursts, even = rng.standard_t(2, 1200), rng.normal(size=1200)
    columns = {"v": answers(rng, command)[:, 0], "motor_cmd": command[:, 0], "Current": bursts, "Temp": even}
    proposal = propose([table_of(tmp_path / "a.csv", columns)])
    assert [c.path for c in proposal.states] == ["v", "Temp"]
    assert "# - {name: current" in proposal.text  # a person may have it


def test_what_is_noise_does_not_move_the_operating_point(tmp_path):
    """No stretch was still with it, and medians that are no equilibrium made the bounds three times as wide."""
    rng, x, rows, proposals = np.random.default_rng(2), 0.0, [], []
    for k in range(2000):
        command = 10.0 * (k % 100 >= 60)
        rows.append((k / 10, command, round(x, 4), round(60 + 0.3 * rng.normal(), 3)))
        x += 0.1 * (command - x) + 0.01 * rng.normal()
    for number in (3, 4):
        path = csv(tmp_path / f"{number}.csv", ["time", "motor_cmd", "v", "Temp"][:number], [r[:number] for r in rows])
        proposals.append(propose([path]))
    without, also = proposals
    assert [c.name for c in also.states] == ["v", "temp"]
    assert [c.steady for c in (*also.states[:1], *also.controls)] == [
        c.steady for c in (*without.states, *without.controls)
    ]


def test_a_measurement_that_begins_at_0_with_its_command_is_a_state(tmp_path):
    """Of a heater that was off in its first row alone nothing was left that is measured."""
    rows, heat = [(0, 0, 0.0)], 800.0
    for k in range(1, 900):
        u = 1829 + 300 * (k // 90 % 3)
        rows.append((k, u, f"{heat:.2f}"))
        heat += 0.05 * (0.4 * u - heat)
    path = csv(tmp_path / "heater.csv", ["T", "U", "Y"], rows)
    assert signals_of(propose([path])) == ([("/table", "Y")], [("/table", "U")])


def test_a_table_faster_than_a_plant_has_its_labels_set_aside_and_its_switches_and_set_points_as_controls(tmp_path):
    """A drive at 20 rows a second: a label beside it, an end switch, a brake, a set point that its speed follows."""
    rng = np.random.default_rng(3)
    speed, load, brake, rows = 0.0, 0.0, 0, []
    for k in range(1500):
        target = 3.0 * math.sin(k / 40) + math.sin(k / 13)
        brake = int(rng.integers(0, 2)) if k % 30 == 0 else brake
        label = "" if k in range(100, 140) else 1 + k % 2 if k in range(1400, 1420) else 0
        t = 0.05 * k - (0.9 if k in range(700, 720) else 0.0)  # a clock that is set back for a second
        rows.append([f"{t:.2f}", speed, target, load, brake, 1 - brake, rng.integers(0, 2) if k % 9 == 0 else 0, label])
        speed += 0.9 * (target - speed) * (1 - 0.5 * brake) + 0.01 * rng.normal()
        load += 0.1 * (target - load) + 0.05 * brake + 0.01 * rng.normal()
    names = ["time", "Axis_ActSpeed", "Axis_SetSpeed", "Angle_of_Attack", "Brake_IN", "Released", "Idle", "Label"]
    classes = {k: "leak" if k % 500 == 9 else "normal" if k > 5 else "" for k in range(1500)}
    names, rows = [*names, "class"], [[*row, classes[k]] for k, row in enumerate(rows)]
    path = csv(tmp_path / "drive.csv", names, rows)
    proposal = propose([path])
    assert [c.path for c in proposal.states] == ["Axis_ActSpeed", "Angle_of_Attack"], proposal.text
    assert [c.path for c in proposal.controls] == ["Axis_SetSpeed", "Brake_IN"], proposal.text
    for words in ("Label: a label by its name", "Idle.*shows in the next step of none", "Released: moves with"):
        assert re.search(words, proposal.text), words
    assert "max_hold" not in proposal.text  # what is in the row of the states is as old as they are
    assert any("Label looks like a label, and is not 0 in 20 rows" in w for w in proposal.warnings), proposal.warnings
    assert any("class looks like a label, and is not normal in 3 rows" in w for w in proposal.warnings)
    assert propose([path], states=["/table:Label"]).states[0].path == "Label"
    bag = save(tmp_path / "a.mcap", driven(), {})
    refuses(BagError, "/table: not in every recording.*; give recordings of one machine", propose, [path, bag])


@pytest.mark.parametrize("of_speed", [False, True])
def test_a_set_point_is_a_control_where_the_command_beside_it_is_of_something_else(tmp_path, of_speed):
    """Of a spindle and its coolant the set point of the speed was left out, as there was a command: of the pump."""
    rng, speed, flow, ref, target, rows = np.random.default_rng(5), 0.0, 0.0, 0.0, 0.0, []
    for k in range(3000):
        target = rng.uniform(0, 8000) if k % 100 == 0 else target
        ref += float(np.clip(target - ref, -60, 60))
        pump, drive = k // 170 % 2, 0.02 * (ref - speed)
        rows.append([0.02 * k, speed, round(ref), flow, pump, drive + 0.1 * rng.normal()][: 5 + of_speed])
        speed += drive + 3 * rng.normal()
        flow += 0.1 * (pump - flow) + 0.01 * rng.normal()
    names = ["time", "spindle_rpm", "spindle_setpoint_rpm", "flow", "coolant_cmd", "spindle_cmd"][: 5 + of_speed]
    proposal = propose([csv(tmp_path / "a.csv", names, rows)])
    assert [c.path for c in proposal.states] == ["spindle_rpm", "flow"], proposal.text
    of_spindle = "spindle_cmd" if of_speed else "spindle_setpoint_rpm"
    assert {c.path for c in proposal.controls} == {"coolant_cmd", of_spindle}, proposal.text


def test_columns_that_one_table_lacks_are_left_out_and_tables_of_two_topics_refused(tmp_path):
    rows = {name: [] for name in ("both", "first", "second", "command")}
    for k in range(200):
        for name, row in rows.items():
            row.append(f"{math.sin(k / 9 + len(name)):.6f}")
    names = ("a.csv", ["both", "first"]), ("b.csv", ["second", "both"]), ("c.csv", ["command"])
    for name, columns in names:
        cells = zip(*(rows[column] for column in columns), strict=True)
        lines = [f"{k / 50},{','.join(row)}" for k, row in enumerate(cells)]
        (tmp_path / name).write_text("\n".join([f"time,{','.join(columns)}", *lines]) + "\n")
    proposal = propose([tmp_path / "a.csv", tmp_path / "b.csv"])
    assert [c.path for c in proposal.states] == ["both"]
    assert "/table first, second: not in every recording" in proposal.text
    words = "not in every recording.*; give recordings of one machine, with the same topics and columns"
    refuses(BagError, words, propose, [tmp_path / "a.csv", tmp_path / "c.csv"])


@pytest.mark.parametrize(("name", "command", "depends"), [("heading_deg", "rudder", False), ("Hdg", "hdg_ref", True)])
def test_nothing_depends_on_where_a_vehicle_heads_for(tmp_path, name, command, depends):
    """A compass passes north in another drive, also where it did not in these; a course to be held is held to it."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.normal(size=60), 25)
    speed = answers(rng, np.column_stack([u, u]))[:, 0]
    columns = {name: 200 + 40 * np.sin(np.cumsum(0.01 * speed)), "turn": speed, command: u}
    proposal = propose([table_of(tmp_path / "a.csv", columns, 0.05 * np.arange(len(u)))])
    assert [c.path for c in proposal.states] == [f"unwrap({name}, 360)", "turn"], proposal.text
    assert ("structure:" in proposal.text) != depends, proposal.text


@pytest.mark.parametrize("turn", [0.3, 3.0])
def test_nothing_depends_on_where_a_vehicle_is(tmp_path, turn):
    """Another drive of it goes elsewhere, and was in alarm; what stays in line may be held at its place."""
    rng, place, messages = np.random.default_rng(3), np.array([369e3, 328e4]), []
    heads = turn * np.sin(0.02 * np.arange(900))
    for k, yaw in enumerate(heads.tolist()):
        place += 0.05 * np.array([math.cos(yaw), math.sin(yaw)]) + 1e-3 * rng.normal(size=2)
        messages.append(pose("/base/pose", at(k), yaw, place))
    _, proposal = proposed(tmp_path, messages, {"/base/pose": POSE})
    free = re.findall("from: ([a-z_]+)", proposal.text)
    assert free == (["position_x", "position_y", "yaw"] if turn > 1 else [])


@pytest.mark.parametrize(("apart", "depends"), [(2.1, False), (0.2, True)])
def test_nothing_depends_on_a_heading_that_each_recording_has_elsewhere(tmp_path, apart, depends):
    """A quadruped that turned less than half a turn in each was UNKNOWN in 3 of 8 runs, as it headed elsewhere."""
    rng, bags = np.random.default_rng(3), []
    for k in range(3):
        place, messages = np.zeros(2), []
        for j, yaw in enumerate((apart * k + 0.3 * np.sin(0.02 * np.arange(400))).tolist()):
            place += 0.05 * np.array([math.cos(yaw), math.sin(yaw)]) + 1e-3 * rng.normal(size=2)
            messages.append(pose("/base/pose", at(j), yaw, place))
        bags.append(save(tmp_path / f"{k}.mcap", messages, {"/base/pose": POSE}))
    assert ("from: yaw, nominal: 0" in propose(bags).text) != depends


def test_a_column_in_degrees_that_jumps_by_a_turn_is_unwrapped(tmp_path):
    """The fit asked for it; a power that is switched by as much is none."""
    rng = np.random.default_rng(3)
    on = np.repeat(rng.choice([0.0, 350.0], size=60), 25)
    for name in ("shaft_position_deg", "Orient_x", "Pitch"):  # of a sensor of a diving robot, from 0 to 360
        columns = {name: np.cumsum(0.02 * on) % 360, "heater_power": on + rng.normal(size=1500)}
        proposal = propose([table_of(tmp_path / "a.csv", columns)])
        assert {c.path for c in proposal.states} == {f"unwrap({name}, 360)", "heater_power"}, proposal.text


@pytest.mark.parametrize(("unit", "angle"), [("°", True), ("deg", True), ("°C", False), ("", False)])
def test_the_unit_says_that_a_column_is_an_angle(tmp_path, unit, angle):
    """A nacelle and a crane that pass north were fitted to jumps of 360, as their names say nothing of an angle."""
    rng = np.random.default_rng(3)
    on = np.repeat(rng.choice([0.0, 350.0], size=60), 25)
    rows = zip(np.cumsum(0.02 * on) % 360, on + rng.normal(size=1500), strict=True)
    lines = ["time;Slew;power", f"s;{unit};kW", *(f"{0.02 * k};{a};{b}" for k, (a, b) in enumerate(rows))]
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    proposal = propose([tmp_path / "a.csv"])
    assert ("unwrap(Slew, 360)" in {c.path for c in proposal.states}) == angle, proposal.text


def test_channels_of_an_aircraft_and_inputs_are_controls_and_what_is_in_a_cabinet_is_measured():
    plane = ["aileron", "elevator", "throttle", "roll"]
    assert [role_of_column(name, plane) for name in plane] == ["control", "control", "control", "state"]
    assert role_of_column("elevator", ["elevator", "elevator_b", "load"]) == "state"
    assert [role_of_column(name, ["uest", "yest"]) for name in ("uEst", "yEst")] == ["control", "state"]
    assert [role_of_column(f"tau_{what}_0") for what in ("cal", "est")] == ["control", "state"]
    assert [role_of_column(f"control_{what}") for what in ("module_voltage", "voltage")] == ["state", "control"]


def test_a_current_that_is_hardly_there_is_no_switch_and_a_variance_no_signal(tmp_path):
    rng = np.random.default_rng(3)
    u = np.repeat(rng.normal(size=60), 25)
    columns = {"speed": answers(rng, u[:, None])[:, 0], "duty": u, "spare_current": (u > 1.2) * 0.11, "valve": u > 1}
    columns |= {"heading_var": answers(rng, u[:, None])[:, 0], "process_var": answers(rng, u[:, None])[:, 0]}
    proposal = propose([table_of(tmp_path / "a.csv", columns)])
    assert "heading_var" not in proposal.text and "process_var" in proposal.text
    assert "spare_current: takes two values only" in proposal.text
    assert "spare_current" not in [c.path for c in proposal.controls]


@pytest.mark.parametrize(("command", "apart", "depends"), [("direction_cmd", 30, True), ("course_cmd", 140, False)])
def test_a_heading_depends_on_a_command_it_follows_but_on_none_that_jumps(tmp_path, command, apart, depends):
    """A vehicle goes the shorter way to its course, and no linear model knows how often it went round."""
    rng, way = np.random.default_rng(3), [180.0]
    course = np.repeat(180 + rng.uniform(-apart, apart, 60), 25)
    for target in course[1:]:
        way.append(way[-1] + 0.1 * ((target - way[-1] + 180) % 360 - 180) + 0.1 * rng.normal())
    columns = {"heading": np.array(way) % 360, command: course}
    proposal = propose([table_of(tmp_path / "a.csv", columns, 0.05 * np.arange(1500))])
    assert [c.path for c in proposal.states] == ["unwrap(heading, 360)"], proposal.text
    assert ("structure:" in proposal.text) != depends, proposal.text


def test_a_heading_that_a_course_turns_and_does_not_hold_is_where_nothing_depends_on(tmp_path):
    """Of an aeroplane the bearing of its waypoint went round, and 3 of 9 healthy flights alarmed."""
    rng = np.random.default_rng(3)
    bearing = 180 + 170 * np.sin(np.arange(1500) / 60)
    heading = np.cumsum(0.01 * (bearing - 150) + 0.05 * rng.normal(size=1500))
    columns = {"yaw": (heading + 180) % 360 - 180, "course_cmd": bearing % 360}
    proposal = propose([table_of(tmp_path / "a.csv", columns, 0.05 * np.arange(1500))])
    assert [c.path for c in proposal.states] == ["unwrap(yaw, 360)"], proposal.text
    assert "from: yaw, nominal: 0" in proposal.text, proposal.text


def test_wheels_are_judged_by_what_their_encoders_count(tmp_path):
    """A count that grows was a counter, and one that falls a place which another drive leaves: no slip was seen."""

    def drive(number, slip=0.0):
        rng, speed, way, rows = np.random.default_rng(number), np.zeros(2), np.array([900.0, 31000.0]), []
        pwm = np.repeat(rng.integers(0, 255, (40, 2)) * [1, 0] + rng.integers(-255, 255, (40, 2)) * [0, 1], 50, axis=0)
        for k, power in enumerate(pwm):
            speed += 0.2 * (power * (8.0, 8.0 - 8.0 * slip * (k > 1000)) - speed)
            way += 0.05 * speed
            rows.append([power[0], power[1], np.floor(way[0]), (np.floor(way[1]) + 32768) % 65536 - 32768])
        columns = dict(zip(("pwm_left", "pwm_right", "left_ticks", "encoder_right"), np.transpose(rows), strict=True))
        return table_of(tmp_path / f"{number}.csv", columns, 0.05 * np.arange(len(rows)))

    files = [drive(number) for number in range(3)]
    proposal = propose(files)
    assert [c.path for c in proposal.states] == ["left_ticks", "unwrap(encoder_right, 65536)"], proposal.text
    assert "rate(left_ticks)" in proposal.text and "from: left_ticks, nominal: 0" in proposal.text
    model = fitted(files, proposal)
    checks = ((7, 0.0), (6, 0.3))
    well, slips = (
        EnvelopeMonitor(model).check(*read_transients([drive(n, slip)], model.signals)) for n, slip in checks
    )
    assert not well.alarm.any() and slips.alarm[1100:].mean() > 0.1, (well.alarm.mean(), slips.alarm[1100:].mean())


@pytest.mark.parametrize("pulled", [True, False], ids=["servo", "pendulum"])
def test_a_count_that_something_pulls_back_matters(tmp_path, pulled):
    """To the place that is its command, or down; a wheel stands as well elsewhere."""
    rng, (x, v), count = np.random.default_rng(3), (0.0, 0.0), []
    target = np.repeat(rng.integers(-300, 300, 60), 25)
    for command in target:
        count.append(np.rint(x))
        v += 0.05 * (2.0 * command - (2.0 if pulled else 4.0) * x - 3.0 * v)
        x += 0.05 * v
    name = "goal" if pulled else "pwm"
    proposal = propose([table_of(tmp_path / "a.csv", {"encoder": count, name: target}, 0.05 * np.arange(1500))])
    assert [c.path for c in proposal.states] == ["encoder"] and "structure:" not in proposal.text, proposal.text
    assert "additive: noise" in proposal.text


@pytest.mark.parametrize("target", ["speed_setpoint", "pwm"])
@pytest.mark.parametrize(("bits", "gain"), [(40, 20.0), (12, 4000.0), (8, 200.0), (32, 3e4)])
def test_a_count_of_any_bits_goes_on_and_nothing_depends_on_it(tmp_path, bits, gain, target):
    """A set point of the speed holds no place, and an encoder of a turn has as many bits as its maker gave it."""
    rng, speed, way, counts = np.random.default_rng(3), 0.0, 2.0**32 - 1000.0 if bits == 32 else 0.0, []
    command = np.repeat(rng.uniform(-1.0, 1.0, 60), 25)
    for u in command:
        speed += 0.2 * (u * gain * 5 - speed) + 0.01 * gain * rng.normal()
        way += 0.05 * speed
        counts.append(np.floor(way) % 2**bits if bits != 40 else np.floor(way))
    proposal = propose([table_of(tmp_path / "a.csv", {"enc": counts, target: command}, 0.05 * np.arange(1500))])
    path = f"unwrap(enc, {2**bits})" if bits != 40 else "enc"
    assert [c.path for c in proposal.states] == [path], proposal.text
    assert f"rate({path})" in proposal.text and "from: enc, nominal: 0" in proposal.text, proposal.text


def test_a_count_that_is_set_to_0_is_not_unwrapped(tmp_path):
    rng = np.random.default_rng(3)
    u = np.repeat(rng.uniform(0.1, 1.0, 60), 25)
    count = np.floor(np.cumsum(answers(rng, np.column_stack([u, u]))[:, 0] + 1.0))
    count[900:] -= count[900]
    proposal = propose([table_of(tmp_path / "a.csv", {"ticks": count, "pwm": u}, 0.05 * np.arange(1500))])
    assert [c.path for c in proposal.states] == ["ticks"], proposal.text


@pytest.mark.parametrize("name", ["encoder_velocity", "enc_rpm", "ticks_per_sec", "delta_ticks"])
def test_what_an_encoder_says_of_the_speed_is_no_count(tmp_path, name):
    rng = np.random.default_rng(3)
    u = np.repeat(rng.normal(size=60), 25)
    speed = np.rint(100 * answers(rng, np.column_stack([u, u]))[:, 0])
    proposal = propose([table_of(tmp_path / "a.csv", {name: speed, "pwm": u}, 0.05 * np.arange(len(u)))])
    assert [c.path for c in proposal.states] == [name] and "structure:" not in proposal.text, proposal.text
    assert "additive: noise" in proposal.text and "how fast it turned" not in proposal.text, proposal.text


@pytest.mark.parametrize("code", ["c1_mode", "phase", "recipe_step"])
def test_a_place_a_way_and_a_mode_are_no_states(tmp_path, code):
    """Another drive is elsewhere, and the numbers of a mode are names: neither tells what comes next."""
    rng = np.random.default_rng(3)
    u, mode = np.repeat(rng.normal(size=60), 25), np.repeat(rng.choice([0.0, 9.0, 10.0], size=30), 50)
    speed, lat_g = answers(rng, np.column_stack([u + 0.1 * mode, u])).T
    way = np.round(np.cumsum(np.abs(speed)), 1)
    columns = {"Latitude_Y": 30 + 1e-5 * np.cumsum(speed), "PilotLon": -97 + 1e-5 * np.cumsum(u), "distance_miles": way}
    columns |= {"Heading": np.cumsum(5 * speed) % 360, "speed": speed, "lat_g": lat_g, code: mode, "throttle": u}
    proposal = propose([table_of(tmp_path / "a.csv", columns, 0.05 * np.arange(len(u)))])
    assert [c.path for c in proposal.states] == ["unwrap(Heading, 360)", "speed", "lat_g"], proposal.text
    assert [c.path for c in proposal.controls] == ["throttle"], proposal.text
    assert code in proposal.text and "a code by its name, and its numbers are no amounts" in proposal.text


@pytest.mark.parametrize(
    ("name", "step"),
    [("q{}", 0.05), ("pose.orientation.{}", 0.05), ("Q_{}", 2.0), ("q[{}]", 0.05), ("q{}", 0.06)],
)
def test_four_columns_of_a_quaternion_are_angles(tmp_path, name, step):
    """q and -q are one attitude: what jumps in each column is no movement, and in the next run an alarm."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.normal(size=60), 25)
    yaw = np.cumsum(answers(rng, u[:, None])[:, 0]) / 10
    sign = rng.choice([-1.0, 1.0], size=len(u))
    parts = {"x": 0 * u, "y": 0 * u, "z": sign * np.sin(yaw / 2), "w": sign * np.cos(yaw / 2)}
    letters = str.upper if "Q" in name else str
    numbered = "[" in name or step == 0.06
    numbers = dict(zip("xyzw", "1230" if numbered else map(letters, "xyzw"), strict=True))
    columns = {name.format(numbers[axis]): part for axis, part in parts.items()} | {"rudder_cmd": u}
    path = table_of(tmp_path / "a.csv", columns, step * np.arange(len(u)))
    proposal = propose([path])
    (field,) = [c.path for c in proposal.states]
    assert field in ("unwrap(yaw(q))", "unwrap(yaw(Q))", "unwrap(yaw(pose_orientation))")
    assert "rudder_cmd" in [c.path for c in proposal.controls]
    (tmp_path / "s.yaml").write_text(proposal.text)
    (run,) = read_transients(path, tmp_path / "s.yaml")
    assert np.abs(np.diff(run.x[:, 0]) - np.diff(yaw)).max() < 1e-9


def test_four_numbers_of_a_body_and_not_of_joints_are_a_quaternion(tmp_path):
    """PX4 writes an attitude as q[0] to q[3], from w on; four joints have the same name and another norm."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.normal(size=60), 25)
    roll, pitch, yaw = np.cumsum(answers(rng, u[:, None] * [1, 2, 3]), axis=0).T / 30
    q = [quaternion(*angles) for angles in zip(roll, np.sin(pitch), yaw, strict=True)]
    schema = "float32[4] q\n"
    attitude = [struct.pack("<4B4f", 0, 1, 0, 0, one.w, one.x, one.y, one.z) for one in q]
    joints = [struct.pack("<4B4f", 0, 1, 0, 0, *some) for some in zip(roll, pitch, yaw, roll + yaw, strict=True)]
    for data, paths in ((attitude, ["yaw(q)", "roll(q)", "pitch(q)"]), (joints, ["q[0]", "q[1]", "q[2]", "q[3]"])):
        topics = [Topic("/attitude", "p/msg/Attitude", schema=schema), Topic("/rudder_cmd")]
        messages = [Message("/attitude", k * 20_000_000, bytes(one)) for k, one in enumerate(data)]
        messages += [Message("/rudder_cmd", k * 20_000_000 - 1, float64(value)) for k, value in enumerate(u)][1:]
        path = write(topics, sorted(messages, key=lambda one: one.log_time)).save(tmp_path / "a.mcap")
        proposal = propose([path])
        assert all(f"{wanted}" in proposal.text for wanted in paths), proposal.text
        assert ("q[0]" in proposal.text) != ("roll(q)" in proposal.text)
        if data is attitude:
            field = "{{name: {0}, topic: /attitude, field: {0}(q), steady: 0, scale: 1}}".format
            (tmp_path / "s.yaml").write_text(f"clock: /attitude\nstates: [{field('roll')}, {field('yaw')}]\n")
            (run,) = read_transients(path, tmp_path / "s.yaml")
            assert np.abs(np.sin((run.x[:, :2] - np.column_stack([roll, yaw])) / 2)).max() < 1e-6
    live = SimpleNamespace(q=[q[9].w, q[9].x, q[9].y, q[9].z])
    assert FieldPath("yaw(q)").read(live) == pytest.approx(yaw[9], abs=1e-9)


@pytest.mark.parametrize("names", [("att_quat_{}", "1234"), ("ATT.Q{}", "1234"), ("est[{}]", "0123")])
def test_four_numbers_of_an_attitude_that_name_no_axis_are_no_states(tmp_path, names):
    """As spacecraft write them, whose fourth is w: each was a state, and q and -q are one attitude."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.normal(size=60), 25)
    rate = answers(rng, u[:, None])[:, 0]
    yaw = np.cumsum(rate) / 10
    parts = [0.6 * np.sin(yaw / 2), 0.8 * np.sin(yaw / 2), 0.6 * np.cos(yaw / 2), 0.8 * np.cos(yaw / 2)]
    name, numbers = names
    columns = {name.format(i): part for i, part in zip(numbers, parts, strict=True)} | {"rate": rate, "torque_cmd": u}
    proposal = propose([table_of(tmp_path / "a.csv", columns, 2.0 * np.arange(len(u)))])
    assert [c.path for c in proposal.states] == ["rate"], proposal.text
    assert "of an attitude, as the squares of the four add up to 1" in proposal.text
    reset = dict(zip((name.format(i) for i in numbers), (np.full(len(u), i == 0) * 1.0 for i in range(4)), strict=True))
    proposal = propose([table_of(tmp_path / "b.csv", columns | reset, 2.0 * np.arange(len(u)))])
    assert "always 1" in proposal.text and "of an attitude" not in proposal.text, proposal.text  # it never turned


def test_entries_of_one_array_are_all_named_by_their_topic_where_another_array_has_its_name():
    """Of `control` of motors and servos one entry of each had its topic in its name, and `control_1` was of either."""
    motors, servos = (
        Source(f"/out/{name}", "px4_msgs/msg/Of", "control", False, None) for name in ("motors", "servos")
    )
    entries = [Candidate(motors, "control[0]", [])] + [Candidate(servos, f"control[{i}]", []) for i in (0, 2)]
    name_signals([], entries)
    assert [c.name for c in entries] == ["motors_control_0", "servos_control_0", "servos_control_2"]


def test_the_phase_of_a_flight_is_no_state_where_there_is_no_command(tmp_path):
    """It took the place of a voltage that moved with it, and the next phase, never seen, was an alarm."""
    rng = np.random.default_rng(3)
    phase = np.repeat(rng.permutation(np.arange(30) % 5 + 3.0), 50)
    speed, voltage = answers(rng, np.column_stack([rng.normal(size=len(phase)), phase])).T
    columns = {"state": phase, "speed": speed, "drogue_voltage": voltage}
    proposal = propose([table_of(tmp_path / "a.csv", columns, 0.05 * np.arange(len(phase)))])
    assert "state" not in [c.path for c in proposal.states], proposal.text
    assert "drogue_voltage" in [c.path for c in proposal.states], proposal.text


def test_a_number_of_the_first_row_alone_is_neither_a_time_nor_a_control(tmp_path):
    """Tables of a benchmark write their step, `Ts`, once: as a control it left one transition of all."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.normal(size=30), 20)
    columns = {"y": answers(rng, u[:, None])[:, 0], "u": u, "Ts": np.where(np.arange(len(u)) == 0, 4.0, np.nan)}
    path = table_of(tmp_path / "a.csv", columns, 4.0 * np.arange(len(u)))
    proposal = propose([path])
    assert "Ts" not in [c.path for c in [*proposal.states, *proposal.controls]]
    assert "/table Ts: a number in 1 of 600 rows only" in proposal.text
    rows = "\n".join(f"{y},{u},{4 * (k == 0) or ''}" for k, (y, u) in enumerate(zip(columns["y"], u, strict=True)))
    (tmp_path / "b.csv").write_text(f"y,u,Ts\n{rows}\n")
    words = "column 'Ts' is the same in all rows, and no other is called time.*--table step"
    refuses(BagError, words, propose, [tmp_path / "b.csv"])


def test_a_counter_and_a_setting_of_each_run_are_no_states(tmp_path):
    """A row number begins again in the next file, cycles on the next day, a gain has another value; energy adds up."""
    files = []
    for run, gain in enumerate((0.1, 0.4, 0.2)):
        level = np.cumsum(np.random.default_rng(run).normal(size=300))
        columns = {
            "sno": np.arange(1, 301),
            "ki": np.full(300, gain),
            "Cycle": np.arange(300) % 170 // 4,
            "drawn": 300.0 * run + np.cumsum(np.abs(level)) / np.abs(level).max(),  # goes on in the next file
            "used_kWh": np.cumsum(np.abs(level)),  # from 0 again
            "Robot_ProtectiveStop": (np.arange(300) > 296) * 1.0,
            "grip_lost": (np.arange(300) % 50 == 40) * 1.0,
            "level": level,
            "flow": np.diff(level, prepend=0),
        }
        files.append(table_of(tmp_path / f"{run}.csv", columns))
    found = propose(files)
    assert {c.path for c in (*found.states, *found.controls)} <= {"level", "flow"}
    assert any(w.startswith("Robot_ProtectiveStop looks like a label, and is not 0 in 9 rows") for w in found.warnings)
    assert "grows as a clock or a counter does" in found.text and "a setting, and no measurement" in found.text


@pytest.mark.parametrize("step", [0.02, 60.0])
def test_the_clock_of_another_device_is_no_state(tmp_path, step):
    """It comes every fifth row, in whatever unit, and starts again after a day or a week; a duration is measured."""
    rng, late = np.random.default_rng(0), step * (5 * (np.arange(2000) // 5))
    u = np.repeat(rng.normal(size=100), 20)[:, None]
    times = {"gnss_posTime": 86_400_000 - 20_000 * step + 1e3 * late, "time_of_day": late % (1500 * step)}
    columns = times | {"x": answers(rng, u)[:, 0], "cmd": u[:, 0], "rise_time": answers(rng, u, pole=0.8)[:, 0]}
    proposal = propose([table_of(tmp_path / "a.csv", columns, step * np.arange(2000))])
    assert [c.path for c in proposal.states] == ["x", "rise_time"]
    assert "gnss_posTime, time_of_day: grows as a clock" in proposal.text


@pytest.mark.parametrize(
    ("code", "shared"), [(-200.0, True), (9999.0, True), (-50.0, False), (-200.5, False), (1000.0, False)]
)
def test_a_number_far_from_all_others_of_several_columns_stands_for_no_value(code, shared, tmp_path):
    """-200 of thirteen sensors made each of them go from -200 to its values."""
    rng = np.random.default_rng(3)
    walks = np.cumsum(rng.normal(size=(400, 4)), axis=0) * (0.2, 0.5, 20.0, 9.0) + (20.0, 50.0, 700.0, 400.0)
    if code > 0:  # a limit at which they all stand now and then, not far from the rest of any
        walks = 900.0 * (walks - walks.min(axis=0)) / np.ptp(walks, axis=0) - 100.0
    walks[rng.random((400, 4)) < 0.05] = code
    found = propose([table_of(tmp_path / "a.csv", dict(zip("abcd", walks.T, strict=True)))])
    assert [state.ignore for state in found.states] == [(code,) if shared else ()] * 4


def test_the_outputs_of_an_autopilot_are_controls_and_what_it_is_to_follow_is_none(tmp_path):
    """Set points of its log were states, and its outputs to the motors measurements."""
    rng, rows, rate = np.random.default_rng(8), [], 0.0
    for k, desired in enumerate(np.repeat(rng.uniform(-30, 30, 40), 15).tolist()):
        output = 1500 + 4 * (desired - rate) + 3 * rng.normal()
        rows.append([f"{0.1 * k:.3f}", f"{desired:.3f}", f"{rate:.4f}", "", ""])
        rows.append([f"{0.1 * k + 0.02:.3f}", "", "", f"{output:.1f}", f"{3000 - output + 9 * rng.normal():.1f}"])
        rate += 0.1 * (0.3 * (output - 1500) - rate) + 0.05 * rng.normal()
    path = csv(tmp_path / "a.csv", ["timestamp", "RATE.RDes", "RATE.R", "RCOU.C1", "RCOU.C2"], rows)
    states, controls = signals_of(propose([path]))
    assert states == [("/table/RATE", "RATE_R")]
    assert ("/table/RCOU", "RCOU_C1") in controls and {topic for topic, _ in controls} == {"/table/RCOU"}
    assert [role_of_column(f"SERVO_OUTPUT_RAW_servo{n}_raw") for n in (1, 12)] == ["control"] * 2
    assert role_of_column("ATT_DesRoll") == role_of_column("RATE_YDes") == "reference"
    assert role_of_column("Design_flow") == role_of_column("Desk") == "state"


def test_a_night_between_two_runs_in_one_file_does_not_make_the_rows_rare(tmp_path):
    """Ten rows a second with a pause were taken for process data of a row in a quarter of an hour."""
    rng, x, rows = np.random.default_rng(3), 0.0, []
    for k, u in enumerate(np.repeat(rng.choice([0.0, 1.0, 2.0], 60), 20).tolist()):
        rows.append([f"{0.1 * k + 43_200 * (k >= 600):.1f}", f"{x:.5f}", u])
        x += 0.1 * (u - x) + 0.002 * rng.normal()
    proposal = propose([csv(tmp_path / "a.csv", ["time", "speed", "throttle_cmd"], rows)])
    assert "instants: 10 a second" in proposal.text and "Process data" not in proposal.text


def test_motors_at_rest_are_no_missing_numbers(tmp_path):
    """Of an aircraft a sixth of the verdicts was lost: its throttle was closed, at the 1000 that other servos had."""
    rng, x, rows = np.random.default_rng(5), 0.0, []
    for k, u in enumerate(np.repeat(rng.uniform(1500, 1560, 60), 15).tolist()):
        pwm = [1000] * 4 if k < 200 else [round(u + rng.normal() + n) for n in range(4)]
        rows.append([f"{0.02 * k:.2f}", f"{x:.5f}", *pwm])
        x += 0.05 * ((pwm[0] - 1000) / 100 - x) + 0.002 * rng.normal()
    columns = ["time", "height_m", *(f"servo_output_raw.servo{n}_raw" for n in range(1, 5))]
    proposal = propose([csv(tmp_path / "a.csv", columns, rows)])
    assert proposal.controls and "ignore" not in proposal.text


@pytest.mark.parametrize(("changes", "kept"), [(20, False), (1000, True)])
def test_a_command_that_hardly_moves_and_shows_faintly_is_no_control(changes, kept):
    """A lift's beside the drive's, which showed by chance: each of its levels was a combination never fitted."""
    rng = np.random.default_rng(6)
    U = np.column_stack([rng.normal(size=4000), np.repeat(rng.uniform(size=changes), 4000 // changes)])
    source = Source("/commands", ARRAY, "control", False, None)
    used = [Candidate(source, "data[0]"), Candidate(source, "data[1]")]
    drop_idle_controls(Steps(U[:, :1], U, U[:, :1]), used, np.array([9000.0, 12.0]))
    assert [not c.reason for c in used] == [True, kept]
