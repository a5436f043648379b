# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Message classes of the live side: found by type name, described for field paths, written as definitions."""

from __future__ import annotations

import importlib
import re
from collections.abc import Mapping
from functools import cache
from typing import Any, Literal

from uncertain_lti.base.errors import SignalError
from uncertain_lti.signals.field_path import FieldType

_ARRAY = re.compile(r"(?P<element>[^\[\]]+)\[(?P<count>\d+)\]")
_SEQUENCE = re.compile(r"sequence<(?P<element>[^,]+?)(?:,\s*(?P<bound>\d+))?>")
_NUMBERS = {
    "float": "float32", "double": "float64", "char": "char",
    **{f"{sign}int{bits}": f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)},
}  # fmt: skip


@cache
def message_class(type_name: str) -> Any:
    """Class of a message type such as `sensor_msgs/msg/JointState`."""
    parts = type_name.split("/")
    package, name = parts[0], parts[-1]
    if not (len(parts) == 2 or (len(parts) == 3 and parts[1] == "msg")) or not (package and name.isidentifier()):
        raise SignalError(f"{type_name!r} is not a message type; one reads like sensor_msgs/msg/JointState")
    try:
        module = importlib.import_module(f"{package}.msg")
    except ImportError as error:
        missing = (getattr(error, "name", None) or package).split(".")[0]
        raise SignalError(
            f"{type_name}: the Python package {missing} is not installed; install it "
            f"(ros-$ROS_DISTRO-{missing.replace('_', '-')}), or build and source the workspace that defines it"
        ) from None
    found = getattr(module, name, None)
    if not hasattr(found, "get_fields_and_field_types"):
        raise SignalError(f"{type_name}: the installed Python package {package} has no message {name}; update it")
    return found


def live_fields(type_name: str) -> Mapping[str, FieldType]:
    """Fields of an installed message type."""
    described = message_class(type_name).get_fields_and_field_types()
    return {name: _field_type(text) for name, text in described.items()}


def _split(text: str) -> tuple[str, int | None, str]:
    """Element type, array length as in FieldType, and the array as a .msg file writes it."""
    if match := _ARRAY.fullmatch(text):
        return match["element"], int(match["count"]), f"[{match['count']}]"
    if match := _SEQUENCE.fullmatch(text):
        return match["element"], 0, f"[<={match['bound']}]" if match["bound"] else "[]"
    return text, None, ""


def _field_type(text: str) -> FieldType:
    element, array, _ = _split(text)
    kind: Literal["number", "bool", "string", "message", "other"] = "other"
    if element in _NUMBERS:
        kind, element = "number", _NUMBERS[element]
    elif element == "boolean":
        kind, element = "bool", "bool"
    elif element.startswith(("string", "wstring")):
        kind = "string"
    elif element == "octet":
        element = "byte"
    elif "/" in element:
        kind, element = "message", full_name(element)
    return FieldType(kind, element, array)


def stamp_ns(message: Any) -> int:
    """The header stamp of a message, ns."""
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def full_name(type_name: str) -> str:
    """A type's name in full."""
    parts = type_name.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else type_name


def definition(type_name: str) -> str:
    """Definition of an installed type and of all it uses, as MCAP's schema encoding `ros2msg` wants it.

    Constants and default values are not in it: a class does not hold them, and no reader of messages needs them.
    """
    bodies: dict[str, str] = {}
    waiting = [full_name(type_name)]
    while waiting:
        name = waiting.pop(0)
        if name in bodies:
            continue
        lines = []
        for field, text in message_class(name).get_fields_and_field_types().items():
            element, _, array = _split(text)
            if "/" in element:
                waiting.append(full_name(element))
            written = {"boolean": "bool", "octet": "byte"}.get(element, _NUMBERS.get(element, element))
            written = re.sub(r"<(\d+)>", r"<=\1", written)  # a bounded string
            lines.append(f"{written}{array} {field}\n")
        bodies[name] = "".join(lines) or "uint8 structure_needs_at_least_one_member\n"
    first, *others = bodies.items()
    parts = [first[1]]
    for name, body in others:
        package, _, short = name.split("/")
        parts.append(f"{'=' * 80}\nMSG: {package}/{short}\n{body}")
    return "".join(parts)
