"""Start envelope_monitor with a model, a parameter file, in a namespace, on wall or simulated time."""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode

PARAMETERS = Path(__file__).resolve().parents[1] / "config" / "envelope_monitor.yaml"


def start(context):
    """Make the node; an empty `model` leaves the one of the parameter file in place."""
    file = LaunchConfiguration("params_file").perform(context)
    if not Path(file).is_file():
        raise FileNotFoundError(f"params_file:={file} is not a file; check the path")
    simulated = LaunchConfiguration("use_sim_time").perform(context)
    if simulated.lower() not in ("true", "false"):
        raise ValueError(f"use_sim_time:={simulated} is neither true nor false")
    parameters = [file, {"use_sim_time": simulated.lower() == "true"}]
    model = LaunchConfiguration("model").perform(context)
    if model:
        parameters.append({"model": model})
    node = LifecycleNode(
        package="uncertain_lti_ros",
        executable="envelope_monitor",
        name="envelope_monitor",
        namespace=LaunchConfiguration("namespace"),
        parameters=parameters,
        output="screen",
    )
    return [node]


def generate_launch_description():
    """Arguments: model, params_file, namespace, use_sim_time."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("model", default_value="", description="Path of the model file."),
            DeclareLaunchArgument("params_file", default_value=str(PARAMETERS), description="Parameter file."),
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node."),
            DeclareLaunchArgument("use_sim_time", default_value="false", description="Follow /clock."),
            OpaqueFunction(function=start),
        ]
    )
