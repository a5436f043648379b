# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Recordings for benchmarks: topics of a robot with believable numbers, written as a recorder writes them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

JAZZY = get_typestore(Stores.ROS2_JAZZY)
COMPRESSIONS = {"none": CompressionType.NONE, "lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}
FRAMES = [
    "odom", "base_link", "base_footprint", "imu_link", "front_left_wheel", "map", "robot_1/base_link",
    "robot_12/odom", "front_right_steering_joint", "sensor_mast_top_level", "camera_color_optical_frame", "gps",
]  # fmt: skip
JOINTS = [f"{leg}_{joint}_joint" for leg in ("FL", "FR", "RL", "RR") for joint in ("hip", "thigh", "calf")]


@dataclass(frozen=True)
class Topic:
    """A topic to write; for `payloads`, `make(frame)` gives a message whose floats are then replaced by a signal."""

    name: str
    type: str
    make: Callable[[str], Any] | None = None


def message(kind: str, **fields: Any) -> Any:
    return JAZZY.types[kind](**fields)


def _header(frame: str) -> Any:
    stamp = message("builtin_interfaces/msg/Time", sec=0, nanosec=0)
    return message("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def _sentinels(count: int) -> NDArray[np.float64]:
    """Numbers whose bytes stand nowhere else in a message."""
    return np.array([math.pi * 10.0**k for k in range(50, 50 + count)])


def joint_state(frame: str) -> Any:
    values = _sentinels(36)
    return message(
        "sensor_msgs/msg/JointState",
        header=_header(frame),
        name=JOINTS,
        position=values[:12],
        velocity=values[12:24],
        effort=values[24:],
    )


def _vector(values: Sequence[float]) -> Any:
    return message("geometry_msgs/msg/Vector3", x=values[0], y=values[1], z=values[2])


def _quaternion(values: Sequence[float]) -> Any:
    return message("geometry_msgs/msg/Quaternion", x=values[0], y=values[1], z=values[2], w=values[3])


def odometry(frame: str) -> Any:
    values = _sentinels(13).tolist()
    point = message("geometry_msgs/msg/Point", x=values[0], y=values[1], z=values[2])
    pose = message("geometry_msgs/msg/Pose", position=point, orientation=_quaternion(values[3:7]))
    twist = message("geometry_msgs/msg/Twist", linear=_vector(values[7:10]), angular=_vector(values[10:13]))
    covariance = np.diag([1e-3, 1e-3, 1e6, 1e6, 1e6, 1e-2]).ravel()
    return message(
        "nav_msgs/msg/Odometry",
        header=_header(frame),
        child_frame_id="base_footprint",
        pose=message("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance),
        twist=message("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=covariance),
    )


def imu(frame: str) -> Any:
    values = _sentinels(10).tolist()
    covariance = np.diag([2e-4, 2e-4, 2e-4]).ravel()
    return message(
        "sensor_msgs/msg/Imu",
        header=_header(frame),
        orientation=_quaternion(values[:4]),
        orientation_covariance=covariance,
        angular_velocity=_vector(values[4:7]),
        angular_velocity_covariance=covariance,
        linear_acceleration=_vector(values[7:]),
        linear_acceleration_covariance=covariance,
    )


def commands(frame: str) -> Any:
    layout = message("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    return message("std_msgs/msg/Float64MultiArray", layout=layout, data=_sentinels(12))


START_NS = 1_700_000_000_000_000_000
ROBOT = (
    Topic("/joint_states", "sensor_msgs/msg/JointState", joint_state),
    Topic("/odom", "nav_msgs/msg/Odometry", odometry),
    Topic("/imu", "sensor_msgs/msg/Imu", imu),
    Topic("/commands", "std_msgs/msg/Float64MultiArray", commands),
)


def payloads(topic: Topic, count: int, frames: Sequence[str], seed: int) -> list[bytes]:
    """Encoded messages: slow waves with sensor noise, at the resolution of an encoder; stamps 1 ms apart."""
    noise = np.random.default_rng(seed)
    result: list[bytes] = [b""] * count
    which = noise.integers(len(frames), size=count)
    for number, frame in enumerate(frames):
        rows = np.flatnonzero(which == number)
        assert topic.make is not None
        data = bytes(JAZZY.serialize_cdr(topic.make(frame), topic.type))
        table = np.tile(np.frombuffer(data, np.uint8), (len(rows), 1))
        places = [data.find(v.tobytes()) for v in _sentinels(36)]
        for column, at in enumerate(places):
            if at >= 0:
                wave = np.sin(rows * (1e-3 + 1e-4 * column) + column)
                values = np.round(wave + 1e-3 * noise.standard_normal(len(rows)), 6)
                table[:, at : at + 8] = values[:, None].view(np.uint8)
        if "header" in dir(topic.make(frame)):
            stamps = np.stack([1_700_000_000 + rows // 1000, rows % 1000 * 1_000_000], axis=1).astype("<u4")
            table[:, 4:12] = stamps.view(np.uint8)
        for row, content in zip(rows.tolist(), table, strict=True):
            result[row] = content.tobytes()
    return result


def write(
    path: Path,
    topics: Sequence[Topic],
    streams: Sequence[Sequence[bytes]],
    compression: str = "zstd",
    chunk_size: int = 768 << 10,
    step_ns: int = 1_000_000,
) -> Path:
    """One message of each topic in turn as long as it has some, and a step of time until the next turn."""
    with open(path, "wb") as file:
        writer = Writer(file, chunk_size=chunk_size, compression=COMPRESSIONS[compression])
        writer.start(profile="ros2", library="benchmark")
        channels = []
        for topic in topics:
            text = JAZZY.generate_msgdef(topic.type, ros_version=2)[0]
            schema = writer.register_schema(topic.type, "ros2msg", text.encode())
            channels.append(writer.register_channel(topic.name, "cdr", schema))
        for i in range(max(map(len, streams))):
            for number, stream in enumerate(streams):
                if i < len(stream):
                    time = START_NS + i * step_ns + number * 1000
                    writer.add_message(channels[number], time, stream[i], time)
        writer.finish()
    return path
