# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Real ROS 2 processes for tests: started with a domain of their own, watched from here, ended whatever happens."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from processes import LASTING, adopt_orphans, own_domain
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.context import Context
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

PATIENCE = 300.0  # s; costs nothing where all is well
MONITOR = "/envelope_monitor"
OK, WARN, ERROR, STALE = 0, 1, 2, 3  # of diagnostic_msgs
_NODES = "import sys; from uncertain_lti_ros.nodes import {0}; sys.exit({0}())"
COMMANDS = "import sys; from uncertain_lti.cli.main import main; sys.exit(main())"
_SERVER = """
import json, os, signal, sys
import geometry_msgs.msg, sensor_msgs.msg, std_msgs.msg
import uncertain_lti_ros.envelope_monitor, uncertain_lti_ros.plant, uncertain_lti_ros.player, uncertain_lti_ros.recorder
for line in sys.stdin:
    code, arguments, env, folder, log = json.loads(line)
    ours, theirs = os.pipe()
    if not (between := os.fork()):
        if not (pid := os.fork()):
            break
        os.write(theirs, b"%d" % pid)
        os._exit(0)
    os.waitpid(between, 0)  # so that whoever asked is the parent
    os.close(theirs)
    print(os.read(ours, 20).decode(), flush=True)
    os.close(ours)
else:
    sys.exit()
os.setsid()
os.chdir(folder)
os.environ.clear()
os.environ.update(env)
signal.signal(signal.SIGINT, signal.default_int_handler)
for number, (path, how) in enumerate([(os.devnull, os.O_RDONLY), *[(log, os.O_WRONLY | os.O_APPEND)] * 2]):
    os.dup2(os.open(path, how), number)
os.closerange(3, 256)
sys.argv = ["program", *arguments]
exec(code, {"__name__": "__main__"})
"""


def until(condition: Callable[[], Any], what: str, patience: float = PATIENCE) -> Any:
    """Wait for something that comes from another process; returns what the condition gave."""
    end = time.monotonic() + patience
    while not (found := condition()):
        assert time.monotonic() < end, f"waited {patience:g} s for {what}"
        time.sleep(0.01)
    return found


@cache
def _server() -> subprocess.Popen[str]:
    """A process that has imported what nodes and commands need, which takes a second, and forks each of them."""
    adopt_orphans()
    command = [sys.executable, "-u", "-c", _SERVER]
    server = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    LASTING.add(server.pid)
    return server


class _Forked:
    """What `Process` asks of a process, of one that `_server` has forked: a child of ours, as we adopt orphans."""

    def __init__(self, code: str, arguments: list[str], env: dict[str, str], log: Path) -> None:
        server = _server()
        assert server.stdin and server.stdout
        server.stdin.write(json.dumps([code, arguments, env, os.getcwd(), str(log)]) + "\n")
        server.stdin.flush()
        self.pid, self._status = int(server.stdout.readline()), None

    def poll(self) -> int | None:
        if self._status is None and (done := os.waitpid(self.pid, os.WNOHANG))[0]:
            self._status = os.waitstatus_to_exitcode(done[1])
        return self._status

    def wait(self, patience: float = PATIENCE) -> int:
        end = time.monotonic() + patience
        while (status := self.poll()) is None:
            if time.monotonic() > end:
                raise subprocess.TimeoutExpired("program", patience)
            time.sleep(0.005)
        return status

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)


class Process:
    """A process in a group of its own; what it prints goes to a file."""

    def __init__(self, name: str, command: list[str], env: dict[str, str], log: Path, forked: bool = False) -> None:
        self.name, self._log = name, log
        log.touch()
        if forked:
            code, *arguments = command
            self._process: Any = _Forked(code, arguments, env, log)
            return
        with open(log, "wb") as stream:
            streams = {"stdout": stream, "stderr": stream, "stdin": subprocess.DEVNULL}
            self._process = subprocess.Popen(command, env=env, start_new_session=True, **streams)

    @property
    def output(self) -> str:
        return self._log.read_text(errors="replace")

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def signal(self, number: int) -> None:
        self._process.send_signal(number)

    def wait(self, patience: float = PATIENCE) -> int:
        try:
            return self._process.wait(patience)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"{self.name} still runs after {patience:g} s:\n{self.output}") from None

    def succeed(self, patience: float = PATIENCE) -> str:
        assert self.wait(patience) == 0, self.output
        return self.output

    def says(self, text: str, patience: float = PATIENCE) -> None:
        until(lambda: text in self.output, f"{self.name} to say {text!r}; it said:\n{self.output}", patience)

    def kill(self) -> None:
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()


class Topic:
    """Messages of one topic as they arrived."""

    def __init__(self, node: Node, kind: Any, name: str, qos: QoSProfile | int, **options: Any) -> None:
        self.messages: list[Any] = []
        self.times: list[float] = []
        quiet = {"event_callbacks": SubscriptionEventCallbacks(use_default_callbacks=False)}
        self.subscription = node.create_subscription(kind, name, self._take, qos, **(quiet | options))

    def _take(self, message: Any) -> None:
        self.times.append(time.monotonic())
        self.messages.append(message)

    def connected(self) -> Topic:
        until(self.subscription.get_publisher_count, f"a publisher of {self.subscription.topic_name}")
        time.sleep(0.2)  # the publisher may know of us a moment later
        return self

    def count(self, number: int, patience: float = PATIENCE) -> list[Any]:
        """The first `number` messages, as soon as they are here."""
        name = self.subscription.topic_name
        try:
            until(lambda: len(self.messages) >= number, name, patience)
        except AssertionError:
            raise AssertionError(f"{name}: {len(self.messages)} of {number} messages") from None
        return self.messages[:number]


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    with open_world(tmp_path) as world:
        yield world


@contextmanager
def open_world(folder: Path) -> Iterator[World]:
    with own_domain() as domain:
        world = World(domain, folder)
        try:
            yield world
        finally:
            world.close()


class World:
    """One ROS domain: processes in it, and a node here that listens, publishes and calls."""

    def __init__(self, domain: int, folder: Path) -> None:
        self.folder = folder
        self.env = os.environ | {
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(folder / "log"),
            "PYTHONUNBUFFERED": "1",
        }
        self._processes: list[Process] = []
        self._hosted: list[Any] = []
        self._clients: dict[tuple[Any, str], Any] = {}
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain)
        self.node = Node("test", context=self._context)
        self._executor = EventsExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._ends = False
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        while not self._ends:
            self._executor.spin_once(timeout_sec=0.02)

    def host(self, node: Any) -> None:
        """Have a node of this process run beside the one that listens, and end with it."""
        self._hosted.append(node)
        self._executor.add_node(node)

    def close(self) -> None:
        """End what runs here, and only then the processes.

        A process that is killed while it sends to us leaves a lock in our shared memory, and Fast DDS 2.14 then unmaps
        that memory on one thread while the end waits for the lock on another: one end in a hundred crashed.
        """
        self._ends = True
        self._thread.join()
        self._executor.shutdown()  # first: the middleware calls it as long as it knows of the node's entities
        for node in self._hosted:
            node.finish()
        for node in (*self._hosted, self.node):
            node.destroy_node()
        self._context.try_shutdown()
        for process in self._processes:
            process.kill()
            print(f"--- {process.name}\n{process.output}")  # seen where the test fails

    # --- processes ---

    def start(self, name: str, *command: str, forked: bool = False) -> Process:
        """A new Python with these arguments; forked: code and its arguments, in one that has imported the programs."""
        log = self.folder / f"{len(self._processes)}-{name}.log"
        process = Process(name, [*command] if forked else [sys.executable, *command], self.env, log, forked)
        self._processes.append(process)
        return process

    def run_node(self, module: str, parameters: dict[str, Any], *more: str, code: str = "") -> Process:
        """A node, by its console script or by this code, in a Python of its own."""
        given = [part for key, value in parameters.items() for part in ("-p", f"{key}:={json.dumps(value)}")]
        command = ["-c", code] if code else [_NODES.format(module)]
        return self.start(module, *command, "--ros-args", *given, *more, forked=not code)

    def command(self, name: str, *arguments: Any) -> Process:
        """`play`, `record`, `watch` or `demo`."""
        return self.start(name, COMMANDS, name, *(str(a) for a in arguments), forked=True)

    def monitor(self, model: Path | str, *more: str, name: str = MONITOR, code: str = "", **parameters: Any) -> Process:
        """An envelope_monitor that is active."""
        process = self.run_node("envelope_monitor", {"model": str(model)} | parameters, *more, code=code)
        until(lambda: self.status(name).get("state") == "active" or not process.running, "an active monitor")
        assert process.running, process.output
        return process

    # --- talking to them ---

    def listen(self, kind: Any, name: str, qos: QoSProfile | int = 5000, **options: Any) -> Topic:
        return Topic(self.node, kind, name, qos, **options)

    def publisher(self, kind: Any, name: str, qos: QoSProfile | int = 1000) -> Any:
        """A publisher; the subscribers it waits for are those of `subscribed`.

        It has no handlers of events: one of a publisher that is destroyed here ends the executor on its other thread.
        """
        quiet = PublisherEventCallbacks(use_default_callbacks=False)
        return self.node.create_publisher(kind, name, qos, event_callbacks=quiet)

    @staticmethod
    def subscribed(*publishers: Any) -> None:
        for publisher in publishers:
            until(publisher.get_subscription_count, f"a subscriber of {publisher.topic_name}")
        time.sleep(0.2)

    def call(self, kind: Any, name: str, request: Any, patience: float = PATIENCE, again: float = math.inf) -> Any:
        """Ask a service; again: s after which to ask once more.

        An answer is lost where the server has not found the client's reader yet, which a busy machine delays.
        """
        known = (kind, name) in self._clients
        if not known:  # and kept: a client that is destroyed while the executor spins may take the process with it
            self._clients[kind, name] = self.node.create_client(kind, name)
        client = self._clients[kind, name]
        until(client.service_is_ready, f"service {name}", patience)
        if again > 1.0 and not known:
            time.sleep(0.2)  # this request may go out once only
        futures, asked, end = [client.call_async(request)], time.monotonic(), time.monotonic() + patience
        while not (answered := [future for future in futures if future.done()]):
            now = time.monotonic()
            assert now < end, f"waited {patience:g} s for an answer of {name}"
            if now - asked > again:
                futures.append(client.call_async(request))
                asked = now
            time.sleep(0.002)
        return answered[0].result()

    def status(self, name: str = MONITOR) -> dict[str, Any]:
        """What ~/status says."""
        said: dict[str, Any] = json.loads(self.call(Trigger, f"{name}/status", Trigger.Request(), again=1.0).message)
        return said

    def set(self, name: str = MONITOR, **values: Any) -> tuple[bool, str]:
        """Set parameters together; whether they were accepted, and the reason."""
        wanted = [Parameter(key, value=value).to_parameter_msg() for key, value in values.items()]
        request = SetParametersAtomically.Request(parameters=wanted)
        result = self.call(SetParametersAtomically, f"{name}/set_parameters_atomically", request, again=20.0).result
        return result.successful, result.reason

    def change(self, label: str, name: str = MONITOR) -> bool:
        """Ask for a lifecycle transition, and once more where the answer was lost and it has not taken place."""
        number, goal = _TRANSITIONS[label]
        request = ChangeState.Request(transition=Transition(id=number))
        try:
            return bool(self.call(ChangeState, f"{name}/change_state", request, patience=20.0).success)
        except AssertionError:
            if self.state(name) == goal:
                return True
        return bool(self.call(ChangeState, f"{name}/change_state", request).success)

    def manage(self, *labels: str, name: str = MONITOR) -> bool:
        """Ask for transitions as `nav2_lifecycle_manager` of Jazzy does, by its source, where `bond_timeout` is 0.0.

        It believes the state, not the answer, and gives up at the first that failed.
        """
        for label in labels:
            self.change(label, name)
            if self.state(name) != _TRANSITIONS[label][1]:
                return False
        return True

    def state(self, name: str = MONITOR) -> str:
        return str(self.call(GetState, f"{name}/get_state", GetState.Request(), again=1.0).current_state.label)

    def diagnostics(self) -> Diagnostics:
        return Diagnostics(self)


_TRANSITIONS = {  # and where they lead
    "configure": (Transition.TRANSITION_CONFIGURE, "inactive"),
    "activate": (Transition.TRANSITION_ACTIVATE, "active"),
    "deactivate": (Transition.TRANSITION_DEACTIVATE, "inactive"),
    "cleanup": (Transition.TRANSITION_CLEANUP, "unconfigured"),
    "shutdown": (Transition.TRANSITION_ACTIVE_SHUTDOWN, "finalized"),
    "shutdown when unconfigured": (Transition.TRANSITION_UNCONFIGURED_SHUTDOWN, "finalized"),
}


class Diagnostics:
    """The latest status of each name on /diagnostics."""

    def __init__(self, world: World) -> None:
        self.topic = world.listen(DiagnosticArray, "/diagnostics", 100)

    def latest(self, name: str) -> Any:
        for array in reversed(self.topic.messages):
            for status in array.status:
                if status.name == name:
                    return status
        return None

    @property
    def count(self) -> int:
        """Messages so far: what is caused after this, and is over again soon, may come before it is asked for."""
        return len(self.topic.messages)

    def reaches(
        self,
        level: int,
        name: str = "envelope_monitor: monitor",
        saying: str = "",
        patience: float = 60,
        since: int | None = None,
    ) -> Any:
        """A status of this level and message that comes from now on, or since so many messages had come (`count`)."""
        before = self.count if since is None else since

        def found() -> Any:
            for array in self.topic.messages[before:]:
                for status in array.status:
                    if status.name == name and status.level == bytes([level]) and saying in status.message:
                        return status
            return None

        try:
            return until(found, name, patience)
        except AssertionError:
            last = self.latest(name)
            said = f"{last.level!r} {last.message}" if last else "nothing"
            raise AssertionError(f"{name}: wanted level {level} {saying!r}, last was {said}") from None

    @staticmethod
    def values(status: Any) -> dict[str, str]:
        return {value.key: value.value for value in status.values}
