# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""How monitors are put together: several in a process, inputs under a prefix, numbers as people write them, an end."""

import re
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from conftest import ROOT

pytest.importorskip("rclpy", reason="rclpy is not installed")

from geometry_msgs.msg import Vector3Stamped
from rclpy.executors import MultiThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message
from ros_processes import PATIENCE, Diagnostics, World, until
from ros_processes import world as world
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from test_live import CONTROL, EPOCH_NS, STATE, by_hand, joint_state, saved, stamp_of, vector

from uncertain_lti_ros.envelope_monitor import NAME, EnvelopeMonitorNode
from uncertain_lti_ros.parameters import DEFAULTS
from uncertain_lti_ros.process import BAD_USAGE


def pair(k: int) -> tuple[Vector3Stamped, JointState]:
    """Control and state of sample k, at the operating point."""
    point = by_hand().operating_point
    t_ns = EPOCH_NS + 10_000_000 * k
    control = deserialize_message(vector(t_ns, *point.u_s), Vector3Stamped)
    return control, deserialize_message(joint_state(t_ns, point.x_s), JointState)


class Robots:
    """Publishers of some robots, each under a prefix of its own."""

    def __init__(self, world: World, prefixes: list[str]) -> None:
        self.publishers = {
            p: (world.publisher(Vector3Stamped, p + CONTROL), world.publisher(JointState, p + STATE)) for p in prefixes
        }
        self.sent = dict.fromkeys(prefixes, 0)

    def send(self, prefix: str, samples: int) -> None:
        World.subscribed(*self.publishers[prefix])
        for _ in range(samples):
            for publisher, message in zip(self.publishers[prefix], pair(self.sent[prefix]), strict=True):
                publisher.publish(message)
            self.sent[prefix] += 1
            time.sleep(0.005)


def test_an_executor_that_takes_topics_out_of_turn_is_told(world: World, tmp_path: Path, capfd: Any) -> None:
    executor = MultiThreadedExecutor(2, context=world.node.context)
    node = EnvelopeMonitorNode(
        parameter_overrides=[Parameter("model", value=str(saved(by_hand(), tmp_path)))],
        context=world.node.context, use_global_arguments=False,
    )  # fmt: skip
    executor.add_node(node)
    node.start()
    executor.shutdown()
    node.destroy_node()
    assert "a MultiThreadedExecutor takes topics out of turn" in "".join(capfd.readouterr())


def test_two_monitors_in_one_process(world: World, tmp_path: Path) -> None:
    path = str(saved(by_hand(), tmp_path))
    options = {"context": world.node.context, "use_global_arguments": False}

    def made(name: str, prefix: str) -> EnvelopeMonitorNode:
        given = {"model": path, "topic_prefix": prefix, "margin": 2}
        overrides = [Parameter(key, value=value) for key, value in given.items()]
        return EnvelopeMonitorNode(name, namespace="/fleet", parameter_overrides=overrides, **options)

    nodes = [made("left", "/robot1"), made("right", "/robot2/")]
    for node in nodes:
        world.host(node)
        node.start()
        assert node.active, node.reason
    diagnostics = world.diagnostics()
    flags = {name: world.listen(JointState, f"/fleet/{name}/flags").connected() for name in ("left", "right")}
    robots = Robots(world, ["/robot1", "/robot2"])
    robots.send("/robot1", 12)
    robots.send("/robot2", 7)
    assert len(flags["left"].count(12)) == 12 and len(flags["right"].count(7)) == 7
    assert [stamp_of(m) for m in flags["left"].messages] == [EPOCH_NS + 10_000_000 * k for k in range(12)]
    for name, verdicts in (("left", "11"), ("right", "6")):

        def reported(monitor: str = f"fleet/{name}: monitor", verdicts: str = verdicts) -> bool:
            status = diagnostics.latest(monitor)
            return status is not None and Diagnostics.values(status)["verdicts"] == verdicts

        until(reported, f"a report of {name}")
    assert [node.session.monitor.rule.margin for node in nodes if node.session] == [2.0, 2.0]


def test_a_monitor_that_was_busy_takes_each_message_at_the_time_at_which_it_came(world: World, tmp_path: Path) -> None:
    """All that had come meanwhile was of the instant at which it was taken."""
    given = [Parameter("model", value=str(saved(by_hand("log"), tmp_path)))]
    node = EnvelopeMonitorNode("busy", parameter_overrides=given, context=world.node.context)
    world.host(node)
    node.start()
    flags = world.listen(JointState, "/busy/flags").connected()
    power, voltage = world.publisher(Float64, "/power"), world.publisher(Float64, "/voltage")
    World.subscribed(power, voltage)
    busy = threading.Event()

    def hold() -> None:
        once.cancel()
        busy.set()
        time.sleep(0.5)

    once = node.create_timer(0.001, hold)
    assert busy.wait(PATIENCE)
    for _ in range(10):
        voltage.publish(Float64(data=0.1))
        power.publish(Float64(data=0.3))
        time.sleep(0.02)
    stamps = [stamp_of(m) for m in flags.count(10)]
    assert min(np.diff(stamps)) > 10_000_000


def test_inputs_under_a_prefix_and_their_enable_condition(world: World, tmp_path: Path) -> None:
    path = saved(by_hand(), tmp_path)
    process = world.monitor(
        path, "-r", "__ns:=/robot1", name="/robot1/envelope_monitor", topic_prefix="/robot1",
        enable=f"{STATE} position[a] > -1e9", margin=2,
    )  # fmt: skip
    process.says(f"{STATE} (as /robot1{STATE})")
    flags = world.listen(JointState, "/robot1/envelope_monitor/flags").connected()
    robots = Robots(world, ["/robot1"])
    robots.send("/robot1", 8)
    flags.count(8)
    assert world.set("/robot1/envelope_monitor", margin=3, grace=1) == (True, ""), "whole numbers are real ones"
    accepted, reason = world.set("/robot1/envelope_monitor", violations=2.0)
    assert not accepted, "a whole number stays one"
    status = world.status("/robot1/envelope_monitor")
    assert status["verdicts"] == 7 and status["armed"] is True
    assert status["received"] == {f"/robot1{CONTROL}": 8, f"/robot1{STATE}": 8}
    nobody = "nobody publishes /robot1/mode, which parameter enable names"
    assert world.set("/robot1/envelope_monitor", enable="/mode data == 3") == (True, nobody), "where it is listened for"


def test_a_required_monitor_ends_if_its_model_is_wrong_and_a_prefix_is_a_name(world: World, tmp_path: Path) -> None:
    (tmp_path / "wrong.model.json").write_text("{}")
    process = world.run_node("envelope_monitor", {"model": str(tmp_path / "wrong.model.json"), "required": True})
    rule = {"model": str(saved(by_hand(), tmp_path)), "violations": 3, "window": 1, "required": True}
    ruled = world.run_node("envelope_monitor", rule, "-r", "__node:=ruled")
    odd = world.run_node("envelope_monitor", {"model": str(saved(by_hand(), tmp_path)), "topic_prefix": "/robot 1"})
    for ended in (process, ruled):
        assert ended.wait() == 2
        assert "not configured" in ended.output and "Traceback" not in ended.output
        assert "as soon as" not in ended.output, "which it will not be there for"
    odd.says("parameter topic_prefix: '/robot 1' is no topic name; write letters, digits, _ and /, as in /robot1")


def test_the_files_for_operation_name_what_there_is() -> None:
    """The unit gives parameters that the node has; the analyzers match the names of its statuses."""
    unit = (ROOT / "config/envelope_monitor.service").read_text()
    given = re.findall(r"-p (\w+):=", unit)
    assert given and set(given) <= set(DEFAULTS) and f"uncertain_lti_ros {NAME} " in unit
    assert f"RestartPreventExitStatus={BAD_USAGE}" in unit
    file = yaml.safe_load((ROOT / "config/diagnostic_aggregator.yaml").read_text())
    analyzers = file["/**"]["ros__parameters"]["analyzers"]["envelope"]["analyzers"]
    assert analyzers["monitor"]["expected"] == [f"{NAME}: monitor"]
    assert analyzers["monitor"]["timeout"] > DEFAULTS["diagnostics_period"]
    branches = {"monitor": "monitor", "a": "states", "monitor_speed": "states"}
    for name, branch in branches.items():  # `expected` alone matches nothing in Jazzy; a regex has to match as a whole
        said = f"{NAME}: {name}"
        matches = [key for key, an in analyzers.items() for regex in an["regex"] if re.fullmatch(regex, said)]
        assert matches == [branch]
        assert [f"{NAME}: {name}".removeprefix(prefix) for prefix in analyzers[branch]["remove_prefix"]] == [name]
