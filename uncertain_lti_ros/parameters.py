# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Parameters of envelope_monitor: what each means, its default, its range, and whether it can be set while running."""

from __future__ import annotations

from uncertain_lti.monitor.catch_up import WINDOW
from uncertain_lti_ros.arguments import Declared
from uncertain_lti_ros.subscriptions import DEPTH, DURABILITY, RELIABILITY

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
        "Without a verdict for this long, s of wall time, states are reported STALE.",
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
        "Messages of more than this, MiB, are counted as unreadable and not looked into.", low=0.001, high=1024.0,
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
