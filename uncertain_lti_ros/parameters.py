# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Parameters of envelope_monitor in one table, and what they make: the alarm rule, quality of service, the session."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Sequence
from concurrent.futures import Future
from functools import cache
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rclpy.serialization import deserialize_message

from uncertain_lti.base.errors import ModelError
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.alarm import Arming, Condition
from uncertain_lti.monitor.catch_up import WINDOW
from uncertain_lti.monitor.session import Rule, Session, topic_types
from uncertain_lti.recordings.message_reader import MessageReader
from uncertain_lti.signals.field_path import FieldPath
from uncertain_lti.signals.signal_map import below
from uncertain_lti_ros.process import Declared, resolved_name
from uncertain_lti_ros.topics import DEPTH, DURABILITY, RELIABILITY, RequestedQos, live_fields, message_class, sendable

_RESTARTS = "Changing it restarts the alarm, unless it is latched."
RULE = ("violations", "window", "margin", "masked", "enable", "enable_type", "grace", "latch")
"""Parameters that make up the alarm rule."""
PARAMETERS = (
    Declared("model", "", "Path of the model file. Setting it while running swaps the model, or is refused."),
    Declared("autostart", True, "Configure and activate without being asked.", fixed=True),
    Declared(
        "required", False,
        "End with status 2 if the node cannot start itself, as the model is wrong; otherwise it waits for a right one.",
        fixed=True,
    ),
    Declared(
        "topic_prefix", "",
        "Prefix of the topics of the model and of `enable`, for example /robot1: /engine/state is heard on "
        "/robot1/engine/state. Remapping comes after it.", fixed=True,
    ),
    Declared(
        "violations", 0,
        f"Alarm while this many of the last `window` verdicts are violations; 0: that of the model. {_RESTARTS}",
        low=0, high=10**6,
    ),
    Declared("window", 0, f"Verdicts that the alarm looks at; 0: that of the model. {_RESTARTS}", low=0, high=10**6),
    Declared(
        "margin", 0.0,
        f"Factor on the half-widths of the bounds that are judged; 0: that of the model. {_RESTARTS}",
        low=0.0, high=1e6,
    ),
    Declared(
        "masked", "",
        f"States, separated by commas, whose violations do not count for the alarm; they are judged and published "
        f"all the same. {_RESTARTS}",
    ),
    Declared(
        "enable", "",
        f"No alarm unless this holds: TOPIC FIELD OPERATOR NUMBER, for example '/engine/mode data == 3', with "
        f"== != < <= > >=. Empty: alarms always count. {_RESTARTS}",
    ),
    Declared(
        "enable_type", "",
        f"Message type of the topic in `enable`; empty: that of the model or of the graph. {_RESTARTS}",
    ),
    Declared(
        "grace", 0.0,
        f"No alarm this long, in s of the samples' own time, after the first sample, after time jumped back, and "
        f"after `enable` began to hold. {_RESTARTS}",
        low=0.0, high=86400.0,
    ),
    Declared("latch", False, "An alarm lasts until ~/reset is called, also one that is on when this is set."),
    Declared(
        "heartbeat", 1.0,
        "~/violation is published at least this often, s of wall time; also the deadline it offers.",
        fixed=True, low=0.05, high=3600.0,
    ),
    Declared(
        "state_timeout", 1.0,
        "Without a verdict for this long, s of wall time, and for two steps, states are reported STALE.",
        low=0.01, high=86400.0,
    ),
    Declared(
        "diagnostics_period", 1.0,
        "Time between two messages on /diagnostics, s of wall time.",
        fixed=True, low=0.05, high=3600.0,
    ),
    Declared(
        "catch_up", WINDOW,
        "At the start and after a stall, samples wait this long at most, s of wall time, for topics that the "
        "middleware delivers later than others; 0: not at all. It takes effect with the next model.",
        low=0.0, high=10.0,
    ),
    Declared("hardware_id", "", "hardware_id in /diagnostics; empty: the name of this node.", fixed=True),
    Declared("qos.depth", DEPTH, "Messages kept per subscription until they are taken.", fixed=True, low=1, high=10**6),
    Declared(
        "qos.reliability", "match",
        f"Of the subscriptions: match (what publishers offer), {' or '.join(RELIABILITY)}.", fixed=True,
    ),
    Declared(
        "qos.durability", "match",
        f"Of the subscriptions: match (what publishers offer), {' or '.join(DURABILITY)}.", fixed=True,
    ),
    Declared(
        "largest_message", 16.0,
        "Messages of more MiB are counted as unreadable. It takes effect with the next model.", low=0.001, high=1024.0,
    ),
    Declared(
        "snapshot.folder", "",
        "Folder that ~/snapshot writes to, and nowhere else; empty: there are no snapshots.", fixed=True,
    ),
    Declared("snapshot.seconds", 10.0, "What a snapshot holds, s of wall time.", fixed=True, low=0.1, high=3600.0),
    Declared(
        "snapshot.on_alarm", False,
        "Write a snapshot when the alarm is raised, if there was none for snapshot.seconds.",
    ),
    Declared(
        "snapshot.after", 1.0, "How long after the alarm that snapshot ends, s of wall time.", low=0.0, high=3600.0
    ),
    Declared(
        "snapshot.keep", 20, "Most snapshots of this node in the folder; the oldest go first.",
        fixed=True, low=1, high=10**6,
    ),
    Declared(
        "snapshot.megabytes", 200.0, "Most MiB of this node's snapshots in the folder.", fixed=True, low=0.1, high=1e6
    ),
    Declared(
        "snapshot.memory", 64.0, "Most MiB of memory for what a snapshot holds; the oldest go first.",
        fixed=True, low=0.1, high=1e5,
    ),
)  # fmt: skip
DEFAULTS = {parameter.name: parameter.default for parameter in PARAMETERS}
"""Name -> default, which gives the type."""
_type_fields = cache(live_fields)
_PATIENCE = 10.0  # s that a file may take to be read, as on a network that is down
MIB = 1 << 20
"""Bytes; parameters of size are in MiB."""


class Settings(dict[str, Any]):
    """What the parameters of a node are set to, by name: a call of rclpy takes 10 µs.

    `node`: its parameters are declared.
    """

    def __init__(self, node: Node) -> None:
        super().__init__()
        self._node = node
        self.read()

    def read(self) -> None:
        """Read the parameters: some were set."""
        self.update({name: self._node.get_parameter(name).value for name in DEFAULTS})

    def size(self, name: str) -> int:
        """A parameter that is a size in MiB, in bytes."""
        mebibytes: float = self[name]
        return round(mebibytes * MIB)

    def rule(self) -> Rule:
        """The alarm rule that the parameters define."""
        rule = Rule(**{name: self[name] for name in RULE})
        if condition := Condition.parse(rule.enable):
            self.there(condition.topic, "parameter enable: ")
        return rule

    def there(self, topic: str, of: str = "") -> str:
        """Where a topic of the model, or of the enable condition, is heard, before remapping; refuses what is none."""
        name = below(self.topic_prefix(), topic)
        resolved_name(self._node, name, of=of)
        return name

    def requested_qos(self) -> RequestedQos:
        """The quality of service that the parameters request."""
        chosen: dict[str, Any] = {}
        for name, known in (("reliability", RELIABILITY), ("durability", DURABILITY)):
            text = self[f"qos.{name}"]
            if text != "match" and text not in known:
                raise ModelError(f"parameter qos.{name} is {text!r}; choose match, {' or '.join(known)}")
            chosen[name] = known.get(text)
        return RequestedQos(self["qos.depth"], **chosen)

    def topic_prefix(self) -> str:
        """What is put before every topic of the model."""
        prefix: str = self["topic_prefix"].rstrip("/")
        if prefix:
            resolved_name(self._node, prefix, example="/robot1", of="parameter topic_prefix: ")
        return prefix

    def check_snapshots(self, on_alarm: bool) -> None:
        """Refuse snapshots on an alarm without a folder for them."""
        if on_alarm and not self["snapshot.folder"]:
            raise ModelError(
                "parameter snapshot.on_alarm is true, and snapshot.folder is empty; set the one to false, or start the "
                "node with the other"
            )


def _load(file: Path) -> UncertainLTI:
    """Read a model file in a thread of its own, so that a file that cannot be read does not hold up the node."""
    loaded: Future[UncertainLTI] = Future()

    def load() -> None:
        try:
            loaded.set_result(UncertainLTI.load(file))
        except Exception as error:
            loaded.set_exception(error)

    threading.Thread(target=load, name="model file", daemon=True).start()
    try:
        return loaded.result(_PATIENCE)
    except TimeoutError:
        raise ModelError(f"{file}: cannot be read within {_PATIENCE:g} s; copy it to a disk of this machine") from None


def make_session(settings: Settings, arming: Arming | None = None) -> Session:
    """Load the model file that the parameters name, and start a session with it."""
    rule = settings.rule()
    if not (path := settings["model"]):
        raise ModelError("parameter model is empty; give the path of a model file, -p model:=FILE")
    file = Path(os.path.expanduser(path))  # no shell does that behind :=
    if not (file.is_absolute() or os.path.exists(file)):
        raise ModelError(f"{path}: there is no such model file in {Path.cwd()}; give the whole path")
    model = _load(file)
    types = topic_types(model, path, _type_fields)
    for topic in types:
        settings.there(topic, f"{path}: ")
    for names in (model.state_names, model.control_names):
        sendable(names)

    def make_reader(type_name: str, paths: Sequence[FieldPath]) -> MessageReader:
        kind, largest = message_class(type_name), settings.size("largest_message")
        return MessageReader(type_name, paths, _type_fields, lambda data: deserialize_message(data, kind), largest)

    return Session(model, rule, types, _type_fields, make_reader, time.monotonic(), arming, settings["catch_up"])
