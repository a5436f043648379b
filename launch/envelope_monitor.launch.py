# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Start envelope_monitor: its model, name and namespace, the prefix of its inputs, and what its end means."""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode

PARAMETERS = Path(__file__).resolve().parents[1] / "config" / "envelope_monitor.yaml"
ARGUMENTS = {
    "model": ("", "Path of the model file; empty: that of the parameter file."),
    "params_file": (str(PARAMETERS), "Parameter file."),
    "name": ("envelope_monitor", "Name of the node."),
    "namespace": ("", "Namespace of the node and its outputs."),
    "topic_prefix": ("", "Prefix of the topics of the model; 'namespace' for the namespace of the node."),
    "use_sim_time": ("", "Follow /clock, true or false; empty: as the parameter file or SetParameter says."),
    "autostart": ("", "Configure and activate without being asked, true or false; empty: as the parameter file says."),
    "required": ("false", "The launch ends when the node does, and the node ends if its model is wrong."),
    "respawn": ("false", "Start the node again when it ends."),
    "respawn_delay": ("2.0", "s before that."),
    "log_level": ("info", "debug, info, warn, error or fatal."),
    "prefix": ("", "Command in front of the node's, for example 'taskset -c 2' or 'chrt -f 50'."),
}
"""Name -> default and description."""


def start(context):
    """Make the node; arguments that are empty leave the values of the parameter file in place."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    if not Path(given["params_file"]).is_file():
        raise FileNotFoundError(f"params_file:={given['params_file']} is not a file; check the path")
    required, respawn = truth("required", given["required"]), truth("respawn", given["respawn"])
    if required and respawn:
        raise ValueError("required:=true ends the launch with the node, and respawn:=true starts it again; choose one")
    try:
        delay = float(given["respawn_delay"])
    except ValueError:
        raise ValueError(f"respawn_delay:={given['respawn_delay']} is no number; give seconds") from None
    values = {name: truth(name, given[name]) for name in ("use_sim_time", "autostart") if given[name]}
    if given["model"]:
        values["model"] = given["model"]
    if required:
        values["required"] = True
    if given["topic_prefix"]:
        prefix, below = given["topic_prefix"], given["namespace"]
        if not below.startswith("/"):  # then it is below what PushRosNamespace of launch files around this one gives
            below = f"{context.launch_configurations.get('ros_namespace', '')}/{below}"
        values["topic_prefix"] = "/" + below.strip("/") if prefix == "namespace" else prefix
    node = LifecycleNode(
        package="uncertain_lti_ros",
        executable="envelope_monitor",
        name=given["name"],
        namespace=given["namespace"],
        parameters=[given["params_file"], values],
        arguments=["--ros-args", "--log-level", given["log_level"]],
        prefix=given["prefix"] or None,
        respawn=respawn,
        respawn_delay=delay,
        on_exit=ended if required else None,
        output="screen",
    )
    return [node]


def ended(event, context):
    """End the launch that the node is required for, with status 1 unless the node ended in order."""
    if context.is_shutdown:
        return None
    if event.returncode:
        raise RuntimeError(f"{event.process_name} is required, and ended with status {event.returncode}")
    return Shutdown(reason=f"{event.process_name} is required, and has ended")


def truth(name, text):
    """Read true or false."""
    if text.lower() not in ("true", "false"):
        raise ValueError(f"{name}:={text} is neither true nor false")
    return text.lower() == "true"


def generate_launch_description():
    """Arguments: those of `ARGUMENTS`; `ros2 launch --show-args` lists them."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])
