# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Arguments that a node cannot use: one sentence with the remedy and status 2, never a traceback; and `--help`."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

from ros_processes import World, open_world, own_domain

from uncertain_lti_ros import envelope_monitor, parameters, plant

NODES = {"envelope_monitor": parameters.PARAMETERS, **plant.PARAMETERS}
MAINS = {"envelope_monitor": envelope_monitor.main, "plant": plant.plant, "turbofan": plant.turbofan}
Start = Callable[..., subprocess.CompletedProcess]


@pytest.fixture
def start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Iterator[Start]:
    """Run the function of a console script with these arguments, until it comes back."""

    def call(*arguments: str, node: str = "envelope_monitor", **environment: str) -> subprocess.CompletedProcess:
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        status = MAINS[node](list(arguments))
        return subprocess.CompletedProcess(arguments, status, *capfd.readouterr())

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "log"))
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", "")  # the node sets it, and an empty one is complained of
    monkeypatch.delenv("FASTRTPS_DEFAULT_PROFILES_FILE")
    with own_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        yield call


def process(tmp_path: Path, code: str, *arguments: str) -> subprocess.CompletedProcess:
    with own_domain() as domain:
        own = {"ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(tmp_path / "log")}
        command = [sys.executable, "-c", code, *arguments]
        return subprocess.run(command, env=os.environ | own, cwd=tmp_path, capture_output=True, text=True, timeout=300)


def refusal(result: subprocess.CompletedProcess, node: str = "envelope_monitor") -> str:
    """The one sentence; what rcl logs itself may stand before it."""
    assert result.returncode == 2, result
    assert "Traceback" not in result.stderr and not result.stdout, result
    *before, sentence = result.stderr.strip().splitlines()
    assert all("[rcl]: " in line for line in before), result.stderr
    assert sentence.startswith(f"{node}: "), sentence
    assert "/project/" not in sentence, "a line of rcl's own source"
    return sentence


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["-p", "violations:=two"], ["parameter violations is 'two'", "a whole number from 0 to 1000000"]),
        (["-p", "violations:=-2"], ["parameter violations is -2", "from 0"]),
        (["-p", "violations:=2.5"], ["parameter violations is 2.5", "a whole number"]),
        (["-p", "margin:=-2.0"], ["parameter margin is -2.0", "from 0"]),
        (["-p", "latch:=1"], ["parameter latch is 1", "true or false", "for example -p latch:=false"]),
        (["-p", "model:=123"], ["parameter model is 123", "model:='123'"]),
        (["-p", "enable:=true"], ["parameter enable is true", "enable:='true'"]),
        (["-p", "masked:=[a, b]"], ["parameter masked is ['a', 'b']", "write no brackets: -p \"masked:='a,b'\""]),
        (["-p", "masked:=[]"], ["parameter masked is []", "text is wanted", "masked:=''"]),
        (["-p", "use_sim_time:=maybe"], ["parameter use_sim_time is 'maybe'", "bool"]),
        (["-p", "modle:=x"], ["no parameter modle", "did you mean model?"]),
        (["-p", "snapshot_folder:=x"], ["no parameter snapshot_folder", "did you mean snapshot.folder?"]),
        (["-p", "envelope_monitor:windows:=3"], ["no parameter windows", "did you mean window?"]),
        (["-p", "banana:=x"], ["no parameter banana", "--help"]),
        (["-p", "model:="], ["-p model:= has nothing after :=", "model:=''"]),
        (["-p", "model"], ["-p model cannot be read", "-p NAME:=VALUE"]),
        (["-p"], ["-p has nothing after it", "-p NAME:=VALUE"]),
        (["-r"], ["-r has nothing after it", "-r FROM:=TO"]),
        (["-r", "-p", "model:=x"], ["-r has nothing after it"]),
        (["-r", "one"], ["-r one cannot be read", "-r FROM:=TO"]),
        (["-r", "__ns:=bad"], ["-r __ns:=bad cannot be read", "a namespace from / on"]),
        (["-p", 'model:=[1,"a"]'], ["cannot be read", "a value as in YAML"]),
        (["-p", "latch:=true", "a.model.json"], ["a.model.json is no ROS argument", "-p model:=a.model.json"]),
        (["-r", "__node:=a-b"], ["-r __node:=a-b cannot be read", "letters, digits"]),
        (["--log-level", "loud"], ["--log-level loud", "debug, info, warn"]),
        (["--nonsense"], ["--nonsense is no ROS argument", "--help"]),
        (["model:=x"], ["model:=x is no ROS argument", "write -p model:=x"]),
        (["--params-file"], ["--params-file has nothing after it"]),
        (["--params-file", "nowhere.yaml"], ["--params-file nowhere.yaml is not a file"]),
    ],
)  # fmt: skip
def test_a_ros_argument_that_cannot_be_used(start: Start, arguments: list[str], says: list[str]) -> None:
    sentence = refusal(start("--ros-args", *arguments))
    assert all(text in sentence for text in says), sentence


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["a.model.json"], ["argument a.model.json", "--ros-args -p model:=a.model.json"]),
        (["--model", "x"], ["argument --model", "-p NAME:=VALUE"]),
        (["model:=x"], ["argument model:=x", "--ros-args -p model:=x"]),
        (["-p", "model:=x"], ["argument -p", "--ros-args -p model:=x"]),
        (["-r"], ["argument -r", "--ros-args -r FROM:=TO"]),
        (["--ros-args", "-p", "model:=x", "--", "rest"], ["argument rest"]),
    ],
)
def test_an_argument_outside_the_ros_arguments(start: Start, arguments: list[str], says: list[str]) -> None:
    sentence = refusal(start(*arguments))
    assert all(text in sentence for text in says), sentence


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("envelope_monitor:\n  ros__parameters:\n    model: [1, a]\n", "line_num 3"),
        ("envelope_monitor:\n  model: x\n", "ros__parameters"),
        ("a: [b\n", "cannot be read"),
        ("envelope_monitor:\n  ros__parameters:\n    modle: x\n", "did you mean model?"),
        ("/**:\n  ros__parameters:\n    snapshot:\n      folders: x\n", "did you mean snapshot.folder?"),
        ("/**:\n  ros__parameters:\n    margin: -2\n", "parameter margin is -2.0"),
    ],
)
def test_a_wrong_parameter_file(start: Start, tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "given.yaml").write_text(text)
    sentence = refusal(start("--ros-args", "--params-file", "given.yaml"))
    assert says in sentence, sentence
    assert "given.yaml" in sentence or "parameter" in sentence


def test_a_setting_of_the_environment_that_rcl_refuses(start: Start) -> None:
    assert "ROS_DOMAIN_ID is not an integral number" in refusal(start(ROS_DOMAIN_ID="abc"))
    assert "from 0 to 232" in refusal(start(ROS_DOMAIN_ID="999"))


@pytest.mark.parametrize("node", NODES)
def test_help_describes_every_parameter(start: Start, node: str) -> None:
    for arguments in (["--help"], ["-h"], ["--ros-args", "--help"]):
        result = start(*arguments, node=node)
        assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout.startswith(f"usage: {node} ") and max(map(len, result.stdout.splitlines())) <= 120
    words = " ".join(result.stdout.split())
    for parameter in NODES[node]:
        assert f"{parameter.name} = " in words and parameter.text in words


@pytest.mark.parametrize("node", ["plant", "turbofan"])
def test_the_other_nodes_refuse_in_the_same_way(start: Start, node: str) -> None:
    assert "parameter rate is 'two'" in refusal(start("--ros-args", "-p", "rate:=two", node=node), node)
    assert "did you mean seed?" in refusal(start("--ros-args", "-p", "sed:=2", node=node), node)
    assert "argument now" in refusal(start("now", node=node), node)


@pytest.mark.parametrize("node", NODES)
def test_a_process_ends_with_the_sentence_too(tmp_path: Path, node: str) -> None:
    code = f"import sys; from uncertain_lti_ros.nodes import {node}; sys.exit({node}())"
    name = NODES[node][1].name
    assert f"parameter {name} is " in refusal(process(tmp_path, code, "--ros-args", "-p", f"{name}:=[a]"), node)


def test_a_node_whose_streams_are_closed_starts_and_ends_as_others_do(tmp_path: Path) -> None:
    """As where a daemon has closed them: the executor asks for stderr. Without a model there is status 2."""
    inner = "import sys; from uncertain_lti_ros.nodes import envelope_monitor; sys.exit(envelope_monitor())"
    ros = ["--ros-args", "-p", "required:=true"]
    code = f"import os, sys; os.closerange(1, 3); os.execv(sys.executable, [sys.executable, '-c', {inner!r}, *{ros}])"
    assert process(tmp_path, code).returncode == 2


def test_where_no_log_can_be_written_another_folder_is_asked_for(start: Start) -> None:
    """As in a container that is read only, or where HOME is not set."""
    assert refusal(start(ROS_LOG_DIR="/dev/null/log")).endswith("; set ROS_LOG_DIR to a folder that can be written")


def test_the_turbofan_refuses_a_manoeuvre_that_there_is_not(start: Start) -> None:
    assert "loop" in refusal(start("--ros-args", "-p", "manoeuvre:=loop", node="turbofan"), "turbofan")


def test_what_a_shared_file_says_to_other_nodes_is_no_reason_to_refuse(tmp_path: Path) -> None:
    """It is logged: a file is shared by many nodes, and the section may be for all of them."""
    shared, others, empty = (tmp_path / f"{name}.yaml" for name in ("shared", "others", "empty"))
    shared.write_text("/**:\n  ros__parameters:\n    robot_description: x\n    latch: true\n")
    empty.write_text("")
    others.write_text("camera:\n  ros__parameters:\n    latch: true\n")

    def starts(world: World, file: Path, says: str) -> None:
        process = world.run_node("envelope_monitor", {}, "--params-file", str(file))
        process.says("not configured: parameter model is empty")
        assert process.running and says in process.output
        assert process.output.count("nothing in it") == says.count("nothing in it")
        process.kill()

    with open_world(tmp_path) as world:
        starts(world, shared, "parameter robot_description is ignored")
        for file in (others, empty):
            nothing = f"{file.name}: nothing in it is for this node; name the section envelope_monitor or /**"
            starts(world, file, nothing)


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_while_a_program_is_imported_ends_it_with_status_0(tmp_path: Path, end: int) -> None:
    first = (
        "import builtins, os, sys; from uncertain_lti_ros.nodes import envelope_monitor; real = builtins.__import__\n"
        "def interrupted(name, *rest):\n"
        f"    if name == 'rclpy.lifecycle': os.kill(os.getpid(), {int(end)})\n"
        "    return real(name, *rest)\n"
        "builtins.__import__ = interrupted; sys.exit(envelope_monitor())"
    )
    done = process(tmp_path, first)
    assert (done.stdout, done.stderr, done.returncode) == ("", "", 0)


_STUCK = """
import ctypes, os, signal
from rclpy.node import Node
from uncertain_lti_ros import process

class Stuck(Node):
    def destroy_node(self):
        print("it ends", flush=True)
        ctypes.PyDLL(None).sleep(600)  # and no other Python runs meanwhile

process._LAST = 1
with process.living(lambda: Stuck("stuck")) as life:
    life.node.create_timer(0.1, lambda: os.kill(os.getpid(), signal.SIGINT))
    life.spin(print)
"""


def test_a_middleware_that_does_not_come_down_does_not_keep_the_process(tmp_path: Path) -> None:
    done = process(tmp_path, _STUCK)
    assert (done.stdout, done.returncode) == ("it ends\n", -signal.SIGALRM), done


_SET_BACK = """
import time
from rclpy.node import Node
from uncertain_lti_ros import process

real, began = time.time, time.monotonic()
time.time = lambda: real() - 3600.0 * (time.monotonic() > began + 1.0)
with process.living(lambda: Node("set_back")) as life:
    life.node.create_timer(600.0, print).reset = lambda: print("set again")
    life.executor.spin_once(timeout_sec=60.0)
    print("woken" if time.monotonic() < began + 30.0 else "late")
"""


def test_a_system_clock_that_is_set_back_lets_no_timer_and_no_call_wait(tmp_path: Path) -> None:
    """The wheels of rclpy wait for an instant of that clock, so heartbeat and signals waited for as long as it went."""
    assert process(tmp_path, _SET_BACK).stdout == "set again\nwoken\n"


@pytest.mark.parametrize(
    ("module", "fake", "says"),
    [
        ("rclpy", "None", "the Python package rclpy is not installed"),
        ("sensor_msgs.msg", "type(sys)('empty')", "cannot import name 'JointState'"),
    ],
)
def test_without_rclpy_a_program_says_what_to_install(tmp_path: Path, module: str, fake: str, says: str) -> None:
    code = f"import sys; sys.modules[{module!r}] = {fake}; from uncertain_lti_ros import nodes"
    done = process(tmp_path, f"{code}; print([getattr(nodes, node)() for node in {[*NODES]}])")
    assert done.stdout == "[2, 2, 2]\n"
    for node, line in zip(NODES, done.stderr.splitlines(), strict=True):
        assert line.startswith(f"{node}: {says}")
        assert line.endswith("; source a ROS 2 Jazzy installation, or in the checkout: pip install '.[ros]'")


@pytest.mark.parametrize("program", ["envelope_monitor", "uncertain-lti"])
def test_a_middleware_that_is_not_installed_is_a_sentence(tmp_path: Path, program: str) -> None:
    """The wheels have one; another is often in the environment of a shell."""
    code = "from uncertain_lti_ros.nodes import envelope_monitor; raise SystemExit(envelope_monitor())"
    if program == "uncertain-lti":
        code = "from uncertain_lti.cli.main import main; raise SystemExit(main(['play', 'a.mcap']))"
    code = f"import os; os.environ['RMW_IMPLEMENTATION'] = 'rmw_none_cpp'; {code}"
    said = refusal(process(tmp_path, code), {"uncertain-lti": "uncertain-lti play"}.get(program, program))
    assert "RMW_IMPLEMENTATION is rmw_none_cpp, which is not installed here; unset it" in said
