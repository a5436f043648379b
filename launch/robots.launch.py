# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Start one envelope_monitor per robot: each in the namespace of its robot, with its inputs from there."""

import re
from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

ONE = Path(__file__).resolve().parent / "envelope_monitor.launch.py"


def start(context):
    """Include the launch file of one monitor for each robot."""
    robots = [name.strip("/ ") for name in LaunchConfiguration("robots").perform(context).split(",")]
    # A name that launch_ros refuses would end the launch, but none of the monitors that it has begun to start.
    if not all(re.fullmatch(r"\w+(/\w+)*", name, re.ASCII) for name in robots) or len({*robots}) < len(robots):
        raise ValueError(
            f"robots:={','.join(robots)} must name each robot once, in letters, digits, _ and /, as in robot1,robot2"
        )
    shared = {name: LaunchConfiguration(name).perform(context) for name in ("model", "required")}
    return [
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(str(ONE)),
            launch_arguments={**shared, "namespace": robot, "topic_prefix": "namespace"}.items(),
        )
        for robot in robots
    ]


def generate_launch_description():
    """Arguments: model, robots, required."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("model", description="Path of the model file that all robots share."),
            DeclareLaunchArgument("robots", default_value="robot1,robot2", description="Namespaces of the robots."),
            DeclareLaunchArgument("required", default_value="false", description="As of envelope_monitor.launch.py."),
            OpaqueFunction(function=start),
        ]
    )
