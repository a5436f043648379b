# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""How every process here runs: its command line, rclpy started, one executor, an orderly end."""

from __future__ import annotations

import argparse
import math
import os
import re
import signal
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from difflib import get_close_matches
from importlib.resources import files
from pathlib import Path
from typing import Any

import rclpy
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidHandle, InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from uncertain_lti.base.errors import UncertainLTIError
from uncertain_lti_ros import endings

BAD_USAGE = 2
_LAST_DOMAIN = 232
_PARAMETER, _REMAP, _FILE = "-p NAME:=VALUE", "-r FROM:=TO", "--params-file FILE"
_LEVEL, _ENCLAVE, _LOG = "--log-level LEVEL", "--enclave ENCLAVE", "--log-config-file FILE"
_FORMS = {
    "-p": _PARAMETER, "--param": _PARAMETER, "-r": _REMAP, "--remap": _REMAP, "--params-file": _FILE,
    "--log-level": _LEVEL, "-e": _ENCLAVE, "--enclave": _ENCLAVE, "--log-config-file": _LOG,
}  # fmt: skip
"""How each ROS argument that takes a value reads."""
_LOGGING = [f"--{how}able-{what}-logs" for how in ("en", "dis") for what in ("rosout", "stdout", "external-lib")]
_TYPES = {str: "text", bool: "true or false", int: "a whole number", float: "a number"}
_WIDTH = 100


class ArgumentError(UncertainLTIError):
    """A node was started with arguments or parameters that it cannot use."""


@dataclass(frozen=True)
class Declared:
    """One parameter of a node.

    `name`: its name; `default`: its default, which gives the type; `text`: what it means, for `--help` and `ros2 param
    describe`; `fixed`: it can be given at the start only; `low`: least value; None without a range; `high`: greatest
    value; None without a range.
    """

    name: str
    default: str | bool | int | float
    text: str
    fixed: bool = False
    low: float | None = None
    high: float | None = None

    def descriptor(self) -> ParameterDescriptor:
        """What `ros2 param describe` shows."""
        descriptor = ParameterDescriptor(description=self.text, read_only=self.fixed)
        if self.low is not None and self.high is not None:
            if isinstance(self.default, int):
                descriptor.integer_range = [IntegerRange(from_value=int(self.low), to_value=int(self.high), step=0)]
            else:
                descriptor.floating_point_range = [FloatingPointRange(from_value=self.low, to_value=self.high)]
        return descriptor

    @property
    def wanted(self) -> str:
        """The type in words, with the range if there is one."""
        limits = "" if self.low is None else f" from {self.low:.12g} to {self.high:.12g}"
        return f"{_TYPES[type(self.default)]}{limits}"


def declare(node: Node, parameters: Iterable[Declared]) -> dict[str, Any]:
    """Declare the parameters of a node."""
    values = {}
    for parameter in parameters:
        given = node._parameter_overrides.get(parameter.name)
        if given is not None:
            node._parameter_overrides[parameter.name] = whole_to_real(given, parameter.default)
        try:
            declared = node.declare_parameter(parameter.name, parameter.default, parameter.descriptor())
            if declared.value is None:  # an empty list
                raise InvalidParameterValueException(parameter.name, None, "")
            values[parameter.name] = declared.value
        except (InvalidParameterTypeException, InvalidParameterValueException):
            given = node._parameter_overrides[parameter.name].value
            given = [] if given is None else given
            shown = repr(given) if isinstance(given, str) else _shown(given)
            remedy = f"for example -p {parameter.name}:={_shown(parameter.default)}"
            if isinstance(parameter.default, str):
                listed = isinstance(given, list)
                why = "write no brackets" if listed else "if it looks like something else, quote it twice"
                remedy = f"{why}: -p \"{parameter.name}:='{','.join(map(str, given)) if listed else shown}'\""
            raise ArgumentError(
                f"parameter {parameter.name} is {shown}, and {parameter.wanted} is wanted; {remedy}"
            ) from None
    return values


def whole_to_real(given: Parameter, default: object) -> Parameter:
    """A parameter with its whole number as a real one, if a real one is meant; rclpy takes 2.0 there, and refuses 2."""
    if isinstance(default, float) and type(given.value) is int:
        return Parameter(given.name, value=float(given.value))
    return given


def resolved_name(node: Node, name: str, kind: str = "topic", example: str = "/joint_states", of: str = "") -> str:
    """The name in full; raises ArgumentError where it is none."""
    try:
        return node.resolve_topic_name(name)
    except (RuntimeError, ValueError):  # RuntimeError: what rcl raises, under names that rclpy does not export
        why = f"{of}{name!r} is no {kind} name; write letters, digits, _ and /, as in {example}"
        raise ArgumentError(why) from None


def run_node(
    name: str, summary: str, parameters: Sequence[Declared], run: Callable[[list[str]], int], args: Sequence[str] | None
) -> int:
    """Run a node on some arguments; `--help` prints what the node is and its parameters."""
    given = list(sys.argv[1:] if args is None else args)
    if "--help" in given or "-h" in given:
        print(_help(name, summary, parameters))
        return 0
    try:
        _check(given, name)
        return run(given)
    except UncertainLTIError as error:
        print(f"{name}: {error}", file=sys.stderr)
    # Fast DDS 2.14 waits for ever for its own listeners when a participant is destroyed while it comes to know another.
    for stream in (sys.stdout, sys.stderr) if args is None else ():
        with suppress(OSError, ValueError, AttributeError):  # AttributeError: it was closed before the start
            stream.flush()
    if args is None:
        os._exit(BAD_USAGE)
    return BAD_USAGE


def _help(name: str, summary: str, parameters: Sequence[Declared]) -> str:
    lines = [
        f"usage: {name} [--ros-args [{_PARAMETER}]... [{_FILE}]... [{_REMAP}]... [{_LEVEL}]]",
        "",
        *textwrap.wrap(summary, _WIDTH),
        "",
        "Parameters (* cannot be set while the node runs):",
    ]
    for parameter in parameters:
        star = "*" if parameter.fixed else " "
        lines.append(f" {star}{parameter.name} = {_shown(parameter.default)}   {parameter.wanted}")
        lines += textwrap.wrap(parameter.text, _WIDTH, initial_indent=" " * 6, subsequent_indent=" " * 6)
    first = parameters[0]
    value = "machine.model.json" if first.name == "model" else _shown(first.default)
    lines += [
        "",
        f"Example: {name} --ros-args -p {first.name}:={value} -r __node:=my_{name}",
        f"Exit status: 0 ended by a signal or done, {BAD_USAGE} bad usage.",
    ]
    return "\n".join(lines)


def _shown(default: object) -> str:
    return "''" if default == "" else str(default).lower() if isinstance(default, bool) else str(default)


def _check(given: Sequence[str], name: str) -> None:
    """Raise ArgumentError for what is no ROS argument, or half of one."""
    inside, words = False, iter(given)
    for word in words:
        if word in ("--ros-args", "--"):
            inside = word == "--ros-args"
        elif inside and word in _FORMS:
            _hold_value(word, next(words, ""))
        elif inside and word not in _LOGGING:
            raise ArgumentError(f"{word} is no ROS argument; {_remedy(word, 'write', '-p', name)}")
        elif not inside:
            remedy = _remedy(word, "write --ros-args", "-r" if word.startswith("_") else "-p", name)
            if word in _FORMS:
                after = next(words, None)
                remedy = f"write --ros-args {_FORMS[word] if after is None else f'{word} {after}'}"
            elif word.startswith("-") and ":=" not in word:
                remedy = "a parameter is given as --ros-args -p NAME:=VALUE, and --help lists them"
            raise ArgumentError(f"argument {word} has no meaning here; {remedy}")


def _remedy(word: str, write: str, flag: str, name: str) -> str:
    if ":=" in word:
        return f"{write} {flag} {word}"
    if name == "envelope_monitor" and not word.startswith("-"):
        return f"if it is the model file, {write} -p model:={word}"
    return "--help lists what there is"


def _hold_value(flag: str, value: str) -> None:
    form = _FORMS[flag]
    if not value or value in _FORMS or value in ("--ros-args", "--"):
        raise ArgumentError(f"{flag} has nothing after it; write {form}")
    if ":=" in form:
        left, found, right = value.partition(":=")
        if not (left and found):
            raise ArgumentError(f"{flag} {value} cannot be read; write {form}")
        if not right:
            empty = f"; an empty text is -p \"{left}:=''\"" if form == _PARAMETER else ""
            raise ArgumentError(f"{flag} {value} has nothing after :=; write {form}{empty}")
    if form == _FILE and not Path(value).is_file():
        raise ArgumentError(f"{flag} {value} is not a file; check the path")


def in_words(error: Exception) -> str:
    """One sentence from an error of rcl, which names lines of its own source."""
    text = re.sub(r",? at /\S+:\d+", "", " ".join(str(error).split()))
    text = re.sub(r"Error: error not set\W*", "", text).removeprefix("failed to initialize rcl: ").rstrip(". ")
    if typed := re.search(r"parameter '(\S+)' to '(.*)' of type '\w+', expecting type '(\w+)'", text):
        return f"parameter {typed[1]} is {typed[2]!r}, and {typed[3].lower()} is wanted"
    text = text.replace("error not set", "rcl gives no reason")
    quoted = re.search(r"'(-\S+) ([^']*)'\W*(?:Error: )?(.*)", text)
    if quoted is None or quoted[1] not in _FORMS:
        logs = "failed to initialize logging" in text
        remedy = "set ROS_LOG_DIR to a folder that can be written" if logs else "check the ROS arguments and variables"
        return f"rclpy cannot start: {text}; {remedy}"
    flag, value, why = quoted.groups()
    form = _FORMS[flag]
    if form == _FILE:
        return f"parameter file {value} cannot be read: {why}; it reads NODE: ros__parameters: NAME: VALUE"
    if form == _LEVEL:
        return f"{flag} {value} is no log level; choose debug, info, warn, error or fatal"
    text = f"{flag} {value} cannot be read; write {form}"
    if form == _PARAMETER:
        return f"{text}, with a name of letters, digits, _ and . and a value as in YAML"
    return f"{text}, with names of letters, digits, _ and /" + ", and a namespace from / on" * value.startswith("__ns")


def hold_overrides(node: Node, args: Sequence[str]) -> None:
    """Refuse parameters that were given and that the node does not have; log what may be meant for others.

    A name in a file that resembles none of this node's may belong to another node that shares the file.
    """
    overrides = node._parameter_overrides
    known = sorted(node._parameters)
    words = [args[i + 1] for i, word in enumerate(args[:-1]) if word in ("-p", "--param")]
    at_command_line = {word.partition(":=")[0].rpartition(":")[2] for word in words}
    for name in (name for name in overrides if name not in known):
        near = get_close_matches(name, known, 1, 0.75)
        if near or name in at_command_line:
            remedy = f"did you mean {near[0]}?" if near else "--help lists those there are"
            raise ArgumentError(f"there is no parameter {name}; {remedy}")
        node.get_logger().warning(f"parameter {name} is ignored: this node has none of that name; --help lists them")
    files = [args[i + 1] for i, word in enumerate(args[:-1]) if word == "--params-file"]
    if files and not overrides:
        node.get_logger().warning(
            f"{', '.join(files)}: nothing in it is for this node; name the section {node.get_name()} or /**"
        )


_LATENCY = 0.1  # s that a signal waits at most
_SPIN = 30.0  # s between two checks whether rclpy has been shut down from elsewhere
_LOOK = 0.5  # s between two looks at the system's clock
_PAUSE = 0.01  # s after an error, which may occur again at once
_LAST = 20  # s that taking the middleware down may take after a signal


class Life:
    """One node on one executor; `alive` turns false on a signal of `endings`.

    The events executor keeps messages in order of arrival; without a time limit its calls keep a core busy and
    deliver nothing in some releases, so it is driven by timed calls. If it is absent the default executor
    is used, which delivers messages that arrive together in order of subscription. The multi-threaded one
    loses messages and is not used.

    `node`: the node; `stop`: signals received; the list is filled in elsewhere.
    """

    def __init__(self, node: Node, stop: list[int]) -> None:
        self.node = node
        self._stop = stop
        self._end: Future | None = None
        try:
            from rclpy.experimental import EventsExecutor

            self.executor: Executor = EventsExecutor()
            self.executor_name = "events executor"
        except ImportError:
            self.executor = SingleThreadedExecutor()
            self.executor_name = "default executor (messages that arrive together may swap)"
        self.executor.add_node(node)
        threading.Thread(target=self._watch_clock, name="clock", daemon=True).start()

    def _watch_clock(self) -> None:
        """Set the timers again after the system's clock was set back: rclpy's wheels wait for an instant of it."""
        while self.alive:
            before = time.time() - time.monotonic()
            time.sleep(_LOOK)
            if time.time() - time.monotonic() < before - _LATENCY:
                with suppress(InvalidHandle):  # one that was just destroyed
                    for timer in [*self.node.timers]:
                        timer.reset()
                    self.executor.create_task(bool)  # what a call waits for, to wake it too

    @property
    def alive(self) -> bool:
        """No signal was received and rclpy is not shut down."""
        return not self._stop and rclpy.ok()

    @property
    def signal(self) -> int | None:
        """The first signal received; None before."""
        return self._stop[0] if self._stop else None

    def spin_once(self, seconds: float = _LATENCY) -> None:
        """Wait for work, and do it."""
        self.executor.spin_once(timeout_sec=min(seconds, _LATENCY))

    def until(self, done: Callable[[], object], seconds: float = math.inf) -> bool:
        """Work until something is done; whether it was, before a signal came and within this time."""
        began = time.monotonic()
        while self.alive:
            if done():
                return True
            if time.monotonic() - began > seconds:
                return False
            self.spin_once(0.05)
        return False

    def spin(self, note: Callable[[str, Exception], None]) -> None:
        """Work until the end; an error that a callback lets through is noted, and the work goes on.

        The node must have a timer: a signal is handled only when Python runs.
        """
        while self.alive:
            self._end = Future(executor=self.executor)
            try:
                # As `spin_once`, for as many callbacks as there are: each return to here costs 8 µs. And
                # rarely: in some releases each of these calls leaks 32 bytes.
                self.executor.spin_until_future_complete(self._end, timeout_sec=_SPIN)
            except InvalidHandle:
                pass  # an event of a subscription that is being replaced; it is not needed
            except Exception as error:
                if self.alive:
                    note("in the executor", error)
                    time.sleep(_PAUSE)

    def end(self) -> None:
        """Return from `spin` as soon as possible: a signal was received."""
        if self._end is not None and not self._end.done():
            self._end.set_result(None)


def spare_the_middleware() -> None:
    """Have Fast DDS wake its threads rarely; call it before rclpy starts. A profile of the user takes precedence."""
    given = any(os.environ.get(name) for name in ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"))
    if given or Path("DEFAULT_FASTRTPS_PROFILES.xml").exists() or Path("DEFAULT_FASTDDS_PROFILES.xml").exists():
        return
    profile = files("uncertain_lti_ros") / "fastdds_writers.xml"
    if isinstance(profile, Path) and profile.is_file():
        os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(profile)


@contextmanager
def living(make_node: Any, args: list[str] | None = None) -> Iterator[Life]:
    """Start rclpy with these ROS arguments, make the node, and destroy both at the end.

    Fast DDS 2.14 waits for ever for its own listeners when a participant is destroyed while it comes to know another.
    After a signal SIGALRM then ends the process, as no Python runs meanwhile.
    """
    domain = os.environ.get("ROS_DOMAIN_ID", "")
    if domain.isdecimal() and int(domain) > _LAST_DOMAIN:  # Fast DDS would end the process with status 1
        raise ArgumentError(f"ROS_DOMAIN_ID is {domain}; choose one from 0 to {_LAST_DOMAIN}, whose ports exist")
    while (lent := os.open(os.devnull, os.O_RDWR)) <= 2:  # closed streams, whose place no file of rclpy may take
        pass
    os.close(lent)
    sys.stderr = sys.stderr or open(2, "w", closefd=False)  # the events executor asks for it
    args = list(args or [])
    stop: list[int] = []
    node: Node | None = None
    life: Life | None = None

    def end(number: int, _: Any) -> None:
        stop.append(number)
        if life is not None:
            life.end()

    before = {name: signal.signal(name, end) for name in endings()}
    try:
        try:
            rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
            node = make_node()
        except (RuntimeError, InvalidParameterTypeException, InvalidParameterValueException) as error:
            # RuntimeError: what rcl raises, under names that rclpy does not export
            raise ArgumentError(in_words(error)) from None
        hold_overrides(node, args)
        life = Life(node, stop)
        yield life
    finally:
        if stop:
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(_LAST)
        if life is not None:
            life.executor.shutdown()  # before its node: the middleware calls into it as long as it knows the entities
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        signal.alarm(0)
        for name, handler in before.items():
            signal.signal(name, signal.SIG_IGN if stop else handler)  # a process often gets it twice


def seconds(text: str) -> float:
    """Parse an argument that is a time: a finite number, 0 or more."""
    return _number(text, 0.0, "is not a time; give seconds, 0 or more")


def speed(text: str) -> float:
    """Parse an argument that is a speed, times real time: a finite number above 0."""
    return _number(text, math.ulp(0.0), "is not a speed; give a number above 0, such as 1 or 0.5")


def _number(text: str, least: float, otherwise: str) -> float:
    with suppress(ValueError):
        if least <= (value := float(text)) < math.inf:
            return value
    raise argparse.ArgumentTypeError(f"{text} {otherwise}")
