# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Roles: which topics are controls and which the state, by name and type, else by effect."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from fnmatch import fnmatchcase

import numpy as np

from uncertain_lti.base.errors import BagError
from uncertain_lti.base.text import shortlist
from uncertain_lti.proposal.candidates import Source
from uncertain_lti.proposal.effects import SHOWS, explained
from uncertain_lti.recordings.table import TYPE

# Words in the name of a topic or of its type; the last word of a name counts most.
_COMMAND = re.compile(r"(cmd|command|contr|input|actuat|throttle|steer|thrust|pwm|joy|ackermann|drive|trajectory)")


_COLUMN = re.compile(r"^u_?\d*$|^u_|_u$|(^|_)in$|^in_|_in_")  # of a control in a table


_REFERENCE = re.compile(r"(setpoint|desired|target|goal|reference|demand|ref$)")


_STATE = re.compile(
    r"(state|odom|pose|twist|imu|vicon|mocap|optitrack|feedback|measur|sensor|encoder|velocity|position|speed|"
    r"depth|pressure|temperature|power|attitude|estimat|log|response|data$)"
)


_ANSWER = re.compile(r"(state|states|feedback|response|actual|odom|odometry)$|measur|estimat")


_APART = re.compile(r"(battery|leak|diagnos|health|rosout|event|tf$|tf_static|camera|image|map$|marker|gps|fix$)")


FEWEST_SET, MOST_SET = 3, 0.2
"""A column without a name of a command may be one if it changes so often, and in at most this share of the rows."""


_PHYSICAL = re.compile(
    r"^(imu|jointstate|odometry|twist|pose|wrench|accel|vector3|quaternion|transformstamped|ackermann)"
)


_APART_TYPES = {
    "rcl_interfaces/msg/Log", "rcl_interfaces/msg/ParameterEvent", "tf2_msgs/msg/TFMessage", "rosgraph_msgs/msg/Clock",
    "diagnostic_msgs/msg/DiagnosticArray", "diagnostic_msgs/msg/DiagnosticStatus", "sensor_msgs/msg/BatteryState",
    "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/Image", "sensor_msgs/msg/LaserScan",
    "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/OccupancyGrid", "nav_msgs/msg/Path",
    "visualization_msgs/msg/Marker", "visualization_msgs/msg/MarkerArray",
}  # fmt: skip


def is_physical(type_name: str) -> bool:
    """Whether messages of a type hold how a body or a joint is and moves."""
    return bool(_PHYSICAL.search(type_name.rpartition("/")[2].lower()))


def role_by_name(topic: str, type_name: str) -> str:
    """What a topic seems to be by its name, the last word first, else by its type."""
    if type_name in _APART_TYPES:
        return "apart"
    name = topic.strip("/").lower()
    last = name.rpartition("/")[2]
    kind = type_name.rpartition("/")[2].lower()
    if not is_physical(type_name) and any(_APART.search(text) for text in (last, name)):
        return "apart"
    for text in (last, name, kind):
        if _ANSWER.search(text):
            return "state"
        if _REFERENCE.search(text):
            return "reference"
        if _COMMAND.search(text):
            return "control"
        if text == last and kind == "twist" and text.endswith("vel"):
            return "control"  # a bare Twist is what drives a base
        if _STATE.search(text):
            return "state"
    return ""


def role_of_column(name: str) -> str:
    """What a column of a table seems to be by its name."""
    low = name.lower()
    if _ANSWER.search(low):
        return "state"
    if _REFERENCE.search(low):
        return "reference"
    return "control" if _COMMAND.search(low) or _COLUMN.search(low) else "state"


def at_rest(sources: Sequence[Source]) -> str:
    """What to say of recordings in which there are commands and none of them moves."""
    commands = [s for s in sources if s.role == "control" and s.count and s.candidates]
    if not commands or any(s.free for s in commands):
        return ""
    still = shortlist([f"{s.topic} {c.path} {c.reason}" for s in commands for c in s.candidates[:1]], 3)
    return (
        f"no command moves ({still}): the machine is at rest, and what is proposed drifts or is disturbed; record the "
        "machine at work before you fit a model"
    )


def ask_for(sources: Sequence[Source], states: Sequence[str], controls: Sequence[str], where: str) -> None:
    """Give the roles that a person asks for in place of those by name."""
    asked = [("state", p) for p in states] + [("control", p) for p in controls]
    met: dict[str, set[int]] = {"state": set(), "control": set()}
    for role, pattern in asked:
        topic, _, field = pattern.partition(":")
        found = [
            c
            for s in sources
            for c in s.candidates
            if fnmatchcase(s.topic, topic) and (not field or fnmatchcase(_plain(c.path), _plain(field)))
        ]
        if not any(not c.reason for c in found):
            fields = [f"{s.topic}:{c.path}" for s in sources for c in s.candidates if pattern == c.path]
            why = f"; topics there: {_topics(sources)}"
            if found:
                why = f"; {found[0].path} is {found[0].reason}"
            elif fields:
                why = f"; a field is asked for with its topic, {' or '.join(fields[:3])}"
            raise BagError(f"{where}: --{role}s {pattern} meets nothing that moves{why}")
        met[role] |= {id(c) for c in found}
    for source in sources:
        for role, patterns in (("state", states), ("control", controls)):
            mine, why = {id(c) for c in source.candidates} & met[role], f"not asked for by --{role}s"
            if mine:
                source.role, source.reason = role, ""
            elif patterns and source.role == role:
                source.role, source.reason = "apart", source.reason or why
            else:
                continue
            for candidate in source.free:
                if id(candidate) not in mine:
                    candidate.reason = source.reason or why


def _plain(path: str) -> str:
    """A field path without what a pattern would take for a choice of letters."""
    return path.replace("[", "(").replace("]", ")")


def _topics(sources: Sequence[Source]) -> str:
    return shortlist(list(dict.fromkeys(s.topic for s in sources)), 20)


def _held_columns(table: Source) -> Source | None:
    """Columns of a table that are held, and set now and then, if they show in the next step of the others.

    They leave the table for a topic of their own, whose role is a guess.
    """
    if table.type != TYPE:
        return None
    changed = {id(c): np.concatenate([np.diff(v) != 0 for v in c.values]) for c in table.free}
    held = [c for c in table.free if FEWEST_SET <= changed[id(c)].sum() <= MOST_SET * len(changed[id(c)])]
    rest = replace(table, candidates=[c for c in table.candidates if not any(c is other for other in held)])
    found = replace(table, candidates=held, role="guess")
    if not held or not rest.free or explained(rest, [found]) <= SHOWS:
        return None
    table.candidates = rest.candidates
    return found


def assign_roles(sources: Sequence[Source]) -> tuple[list[Source], list[Source]]:
    """Which topics are controls, and which may be the state."""
    moving = [s for s in sources if s.free]
    controls = [s for s in moving if s.role == "control"]
    references = [s for s in moving if s.role == "reference"]
    if not controls:
        controls, references = references, []
    for source in references:
        source.reason = "a reference for some controller, and there is a command"
    states = [s for s in moving if s.role == "state"]
    unknown = [s for s in moving if s.role == ""]
    if not states:
        states, unknown = unknown, []
    if not states and len(controls) > 1:  # commands everywhere by their names: the one that the others explain best
        best = max(controls, key=lambda s: explained(s, [c for c in controls if c is not s]))
        controls, states = [c for c in controls if c is not best], [best]
    if not controls and len(states) + len(unknown) > 1:
        by_effect = max(
            (s for s in [*unknown, *states] if len(states) > 1 or s not in states),
            key=lambda s: max((explained(o, [s]) for o in states if o is not s), default=0.0),
            default=None,
        )
        if by_effect is not None and max(explained(o, [by_effect]) for o in states if o is not by_effect) > SHOWS:
            by_effect.role = "guess"
            controls, states = [by_effect], [s for s in states if s is not by_effect]
            unknown = [s for s in unknown if s is not by_effect]
    if not controls:
        controls = [held for source in states if (held := _held_columns(source)) is not None]
    for source in unknown:
        source.reason = "neither state nor control by its name or type"
    return controls, states
