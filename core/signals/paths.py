# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Paths of the numbers in a message or its type, as they are written in a signals file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from uncertain_lti.signals.field_types import FieldType, TypeFields
from uncertain_lti.signals.functions import FUNCTIONS, QUATERNION

_NO_SIGNALS = ("std_msgs/msg/Header", "builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
_DEPTH = 8
_MOST_NAMES = 100


def numeric_paths(type_name: str, type_fields: TypeFields, depth: int = 6) -> Iterator[str]:
    """Field paths of a type that can be signals; arrays end in `[]` (sequence) or `[n]` (fixed length)."""
    for name, kind in type_fields(type_name).items():
        suffix = "" if kind.array is None else "[]" if kind.array == 0 else f"[{kind.array}]"
        if kind.kind in ("number", "bool"):
            yield name + suffix
        elif kind.kind == "message" and depth > 1:
            for inner in numeric_paths(kind.type_name, type_fields, depth - 1):
                yield f"{name}{suffix}.{inner}"


def signal_paths(
    type_fields: TypeFields, type_name: str, message: Any, before: str = "", depth: int = _DEPTH
) -> Iterator[str]:
    """Paths in a decoded message that can be signals, as `FieldPath` reads them; header stamps are left out.

    The entries of an array stand as one path, `data[0..99]` for `data[0]` to `data[99]`, or as
    `position[fan]` each where the message names them; a quaternion is also offered as roll(...) and the like.
    """
    fields = type_fields(type_name)
    for name, field in fields.items():
        if field.type_name in _NO_SIGNALS or depth == 0:
            continue
        value, path = getattr(message, name), before + name
        if field.array is not None:
            if not len(value):
                continue
            every = f"{path}[0..{len(value) - 1}]" if len(value) > 1 else f"{path}[0]"
            if field.kind == "message":
                yield from _inside(type_fields, field, value[0], every, depth)
            elif field.kind in ("number", "bool"):
                names = _names(fields, message) if field.kind == "number" else []
                yield from [f"{path}[{n}]" for n in names] if len(names) == len(value) else [every]
        elif field.kind == "message":
            yield from _inside(type_fields, field, value, path, depth)
        elif field.kind in ("number", "bool"):
            yield path


def _inside(type_fields: TypeFields, field: FieldType, value: Any, path: str, depth: int) -> Iterator[str]:
    inner = type_fields(field.type_name)
    if set(inner) == set("xyzw") and all(part.kind == "number" for part in inner.values()):
        yield from (f"{name}({path})" for name, function in FUNCTIONS.items() if function.takes is QUATERNION)
    yield from signal_paths(type_fields, field.type_name, value, f"{path}.", depth - 1)


def _names(fields: Mapping[str, FieldType], message: Any) -> list[str]:
    """Entries of a message's own `name` array, quoted where they would read as an index; [] without a usable one."""
    field = fields.get("name")
    if field is None or field.kind != "string" or field.array is None:
        return []
    names = [str(name) for name in message.name]
    if len(set(names)) < len(names) or len(names) > _MOST_NAMES or any('"' in n or not n.strip() for n in names):
        return []
    return [f'"{n}"' if n.strip().isdigit() or n != n.strip() or "[" in n or "]" in n else n for n in names]
