# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""FieldPath: one number of a message, as a signals file has it, its functions, and the paths that a message has."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal, NamedTuple

from uncertain_lti.base.errors import SignalError
from uncertain_lti.base.text import meant, plural


class ValueKind(NamedTuple):
    """What a function takes: a message with certain fields, or also an array of numbers.

    `words`: what it is, for errors; `required`: fields that a message must have, one letter each; `optional`: fields
    that count where the message has them; `array`: entries of an array of numbers that will do as well, in its order,
    `*` for any; empty where none will.
    """

    words: str
    required: str
    optional: str = ""
    array: str = ""

    def parts(self, fields: Container[str]) -> tuple[str, ...]:
        """Fields of a message that the function takes, in its order."""
        if any(name not in fields for name in self.required):
            return ()
        return tuple(name for name in self.required + self.optional if name in fields)


class FieldFunction(NamedTuple):
    """A number computed from the parts of a value, in two steps so that many messages share the first.

    `takes`: what it is a function of; `terms`: takes the parts (x, y, z, w of a quaternion; floats, or arrays of them:
    the arithmetic is the same to the last bit) to the arguments of `number`, and to what has to be positive for there
    to be one; `number`: takes these arguments, floats alone, to the number: numpy's functions round otherwise than
    those of math; `unit`: unit of the number; "" if it is that of the parts; `wraps`: whether the number is an angle
    that jumps by a full turn.
    """

    takes: ValueKind
    terms: Callable[..., tuple[tuple[Any, ...], Any]]
    number: Callable[..., float]
    unit: str = ""
    wraps: bool = False

    def of(self, value: Any) -> float:
        """The number for one value of a message; NaN where there is none."""
        names = self.takes.required + self.takes.optional
        if self.takes.array and not hasattr(value, names[0]):
            return self.of_array(*(as_number(v) for v in value))
        return self.of_parts(*(getattr(value, name) for name in names if hasattr(value, name)))

    def of_array(self, *entries: float) -> float:
        """The same from the entries of an array."""
        if len(self.takes.array) == len(entries) and self.takes.array != "*":
            entries = tuple(entries[self.takes.array.index(name)] for name in self.takes.required)
        return self.of_parts(*entries)

    def of_parts(self, *parts: Any) -> float:
        """The same from the parts of the value."""
        arguments, size = self.terms(*parts)
        return self.number(*arguments) if size > 0.0 else math.nan


def as_number(value: Any) -> float:
    """A number of a decoded message."""
    return float(value[0] if isinstance(value, bytes) else value)


def _roll(x: Any, y: Any, z: Any, w: Any) -> tuple[tuple[Any, ...], Any]:
    norm2 = x * x + y * y + z * z + w * w
    return (2.0 * (w * x + y * z), norm2 - 2.0 * (x * x + y * y)), _finite(norm2)


def _pitch(x: Any, y: Any, z: Any, w: Any) -> tuple[tuple[Any, ...], Any]:
    norm2 = x * x + y * y + z * z + w * w
    return (2.0 * (w * y - z * x), norm2), _finite(norm2)


def _yaw(x: Any, y: Any, z: Any, w: Any) -> tuple[tuple[Any, ...], Any]:
    norm2 = x * x + y * y + z * z + w * w
    return (2.0 * (w * z + x * y), norm2 - 2.0 * (y * y + z * z)), _finite(norm2)


def _finite(norm2: Any) -> Any:
    """NaN in place of infinity: atan2 and asin would make an angle of that."""
    return norm2 * (norm2 < math.inf)


def _arc_sine(sine: float, norm2: float) -> float:
    return math.asin(max(-1.0, min(1.0, sine / norm2)))


def _unchanged(*parts: Any) -> tuple[tuple[Any, ...], Any]:
    return parts, 1.0


QUATERNION = ValueKind("a quaternion with x, y, z, w or an array of four from w on", "xyzw", array="wxyz")
VECTOR = ValueKind("a vector with x, y, z or an array of numbers", "x", "yzw", array="*")
QUATERNION_ARRAYS = ("q", "q_d", "quaternion")
"""Names of such arrays of four, as PX4 and Unitree write them."""

FUNCTIONS: Mapping[str, FieldFunction] = {
    "roll": FieldFunction(QUATERNION, _roll, math.atan2, unit="rad", wraps=True),
    "pitch": FieldFunction(QUATERNION, _pitch, _arc_sine, unit="rad"),
    "yaw": FieldFunction(QUATERNION, _yaw, math.atan2, unit="rad", wraps=True),
    "norm": FieldFunction(VECTOR, _unchanged, math.hypot),
}
"""Name in a signals file -> function. A function added here can be used in recordings, live and by `init`."""


def of_quaternion() -> list[str]:
    """Names of the functions of a quaternion."""
    return [name for name, function in FUNCTIONS.items() if function.takes is QUATERNION]


LONGEST_DELAY = 1_000_000
"""Samples by which a signal is taken earlier at most."""

KINDS: tuple[Literal["lag", "diff", "rate"], ...] = ("lag", "diff", "rate")
"""Functions of a field's earlier samples."""

_NUMBERED = re.compile(r"(.*?),\s*([+-]?\d+)\s*", re.DOTALL)


@dataclass(frozen=True, slots=True)
class Memory:
    """How a signal follows from the samples of its field, up to the present one.

    Sample k takes y_{k - samples} (lag), y_k - y_{k-1} (diff) or (y_k - y_{k-1}) / Δt_{k-1} (rate); there is none until
    the segment has the samples that it needs.

    `kind`: the function; `samples`: samples by which a lag is earlier.
    """

    kind: Literal["lag", "diff", "rate"]
    samples: int = 1

    def of(self, field: str) -> str:
        """The field path of this memory of a field."""
        return f"lag({field}, {self.samples})" if self.kind == "lag" else f"{self.kind}({field})"

    def taken(self, now: Any, past: Any, dt: Any) -> Any:
        """What it makes of the present value, the earlier one, and the step that leads to the former, s."""
        if self.kind == "lag":
            return past
        return now - past if self.kind == "diff" else (now - past) / dt

    def unit(self, of: str) -> str:
        """The unit of this memory of a quantity in some unit."""
        return f"{of}/s" if of and self.kind == "rate" else of


@lru_cache(maxsize=4096)
def parse_memory(text: str) -> tuple[Memory | None, str]:
    """Take the function of earlier samples off a field path."""
    match = re.fullmatch(rf"\s*({'|'.join(KINDS)})\s*\((.*)\)\s*", text, re.DOTALL)
    if not match:
        return None, text.strip()
    kind = next(k for k in KINDS if k == match[1])
    inner, samples = match[2].strip(), 1
    if numbered := _NUMBERED.fullmatch(inner):
        if kind != "lag":
            raise SignalError(f"field '{text}': {kind} takes a field alone; write {kind}({numbered[1].strip()})")
        inner, samples = numbered[1].strip(), int(numbered[2])
        if not 1 <= samples <= LONGEST_DELAY:
            raise SignalError(f"field '{text}': a lag is 1 to {LONGEST_DELAY} samples, not {samples}")
    if re.match(rf"({'|'.join(KINDS)})\s*\(", inner):
        raise SignalError(f"field '{text}': {', '.join(KINDS)} do not nest; write one of them")
    return Memory(kind, samples), inner


@dataclass(frozen=True, slots=True)
class FieldType:
    """Type of one message field.

    `kind`: what one element is; `type_name`: type of one element, as the message definition writes it; `array`: none
    for a single value, 0 for a sequence of any length, n for n elements.
    """

    kind: Literal["number", "bool", "string", "message", "other"]
    type_name: str
    array: int | None = None


TypeFields = Callable[[str], Mapping[str, FieldType]]
"""Type name -> {field name: FieldType}; raises SignalError for an unknown type."""


def full_name(type_name: str) -> str:
    """`pkg/msg/Type` also for `pkg/Type`."""
    parts = type_name.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else type_name


_STEP = re.compile(
    r"""\.?([A-Za-z_]\w*)|\[\s*(\d{1,18})\s*\]|\[\s*"([^"]+)"\s*\]|\[\s*([^\[\]"\s](?:[^\[\]"]*[^\[\]"\s])?)\s*\]"""
)


class FieldPath:
    """One scalar of a message: `a.b[3]`, `position[fan]`, `yaw(pose.orientation)`, `unwrap(...)`, `lag(..., 1)`.

    Dotted attributes; `[3]` is an index, `[fan]` the position of `fan` in the `name` or `joint_names` of the message
    that holds the array, or of one around it (JointState, JointTrajectory), `["3"]` a name like an index. Derived:
    roll, pitch, yaw of a quaternion (any norm but 0), norm of a vector, a quaternion or an array, unwrap of an angle
    in rad or of a stated turn (`unwrap(heading, 360)`), and, outermost, lag(field, k), diff(field) and rate(field) of
    earlier samples (the sampler does these two, as it knows where a stream restarts).

    `text`: the path as a signals file writes it; `unwrap`: the turn by which the sampler is to unwrap it, 0 for none;
    `memory`: what the sampler is to take from earlier samples; `inner`: the path without that: whose earlier samples
    they are; `angle`: that without `unwrap`.
    """

    __slots__ = ("text", "unwrap", "memory", "inner", "angle", "function", "steps")

    def __init__(self, text: str) -> None:
        self.text = text
        self.unwrap = 0.0
        self.function: FieldFunction | None = None
        self.memory, self.inner = parse_memory(text)
        inner = self.angle = self.inner
        functions: list[str] = []
        known = (*FUNCTIONS, "unwrap", *KINDS)
        while match := re.fullmatch(r"([A-Za-z_]\w*)\s*\((.*)\)", inner, re.DOTALL):
            if match[1] not in known:
                near, there = meant(match[1], known), ", ".join(known)
                raise SignalError(f"field '{text}': there is no function '{match[1]}'{near}; there are {there}")
            functions.append(match[1])
            inner = match[2].strip()
            if match[1] == "unwrap" and (stated := re.fullmatch(r"(.*),\s*([1-9][\d.]*)", inner, re.DOTALL)):
                inner, self.unwrap = stated[1].strip(), float(stated[2])
            self.angle = inner if functions == ["unwrap"] else self.angle
        if functions[:1] == ["unwrap"]:
            self.unwrap = self.unwrap or math.tau
            functions = functions[1:]
        if len(functions) > 1 or not set(functions) <= set(FUNCTIONS):
            only = "functions nest only as unwrap(roll|pitch|yaw(...)), and in lag, diff, rate"
            raise SignalError(f"field '{text}': {only}")
        if functions:
            self.function = FUNCTIONS[functions[0]]
        self.steps = self._parse(inner)

    def _parse(self, inner: str) -> tuple[tuple[str, str | int], ...]:
        steps: list[tuple[str, str | int]] = []
        position = 0
        while position < len(inner):
            match = _STEP.match(inner, position)
            dotted = inner[position] == "."
            if not match or (match[1] is not None and dotted != bool(steps)) or (match[1] is None and not steps):
                example = "twist.linear.x, data[0], position[fan] or yaw(pose.orientation)"
                raise SignalError(f"field '{self.text}' is not a field path; write for example {example}")
            kind = {1: "attribute", 2: "index"}.get(match.lastindex or 0, "name")
            key = match[match.lastindex or 0]
            steps.append((kind, int(key) if kind == "index" else key))
            position = match.end()
        if not steps:
            raise SignalError(f"field '{self.text}' is empty; name a field of the message")
        return tuple(steps)

    def __repr__(self) -> str:
        return f"FieldPath({self.text!r})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FieldPath) and other.text == self.text

    def __hash__(self) -> int:
        return hash(self.text)

    def read(self, message: Any) -> float:
        """Value in this message; NaN where an index or a name is not there, or a quaternion is all zero."""
        value, lacking = self._look_up(message)
        return math.nan if lacking else self.function.of(value) if self.function else as_number(value)

    def absent(self, message: Any) -> str:
        """What this path looks up and the message has not, in words, with what is there; empty where it has."""
        value, lacking = self._look_up(message)
        if not lacking:
            return ""
        name, key, names = lacking
        if isinstance(key, str) and key not in names:
            there = ", ".join(names) or "none"
            return f"there is no '{key}' in the message's names{meant(key, names)}; names there: {there}"
        if not len(value):
            return f"'{name}' has no element in the message; choose a field that is filled"
        there = f"elements there: 0 to {len(value) - 1}"
        return f"'{name}' has {plural(len(value), 'element')} in the message; {there}"

    def _look_up(self, message: Any) -> tuple[Any, tuple[str, str | int, list[str]] | None]:
        """The value; or the array that lacks an entry, with its name, the key and the names of the message."""
        value, around, name = message, list[Any](), ""
        for kind, key in self.steps:
            if kind == "attribute":
                around.append(value)
                value, name = getattr(value, str(key)), str(key)
                continue
            named = (getattr(one, of, "") for one in reversed(around) for of in _NAMES) if kind == "name" else ()
            names = [str(one) for one in next((some for some in named if not isinstance(some, str)), ())]
            index = int(key) if kind == "index" else names.index(str(key)) if key in names else len(value)
            if index >= len(value):
                return value, (name, key, names)
            value = value[index]
        return value, None

    def check(self, topic: str, type_name: str, type_fields: TypeFields) -> None:
        """Check the path against a message type."""
        here = f"field '{self.text}' of {topic} ({type_name})"
        current: FieldType = FieldType("message", type_name)
        named = False
        for kind, key in self.steps:
            if kind == "attribute":
                if current.array is not None:
                    raise SignalError(f"{here}: give an index before '.{key}', for example [0]")
                if current.kind != "message":
                    raise SignalError(f"{here}: a {current.type_name} has no fields, so no '{key}'")
                parent = type_fields(current.type_name)
                if key not in parent:
                    raise SignalError(
                        f"{here}: there is no '{key}' in {current.type_name}{meant(key, parent)}; fields there: "
                        f"{', '.join(parent) or 'none'}; {_instead(topic, type_name, type_fields)}"
                    )
                current, named = parent[str(key)], named or names_in(parent) != ""
                continue
            if current.array is None:
                raise SignalError(f"{here}: '[{key}]' follows something that is not an array; leave it out")
            if kind == "index" and current.array and int(key) >= current.array:
                raise SignalError(f"{here}: index {key} is past the end of an array of {current.array}")
            if kind == "name" and not named:
                needs = f"needs an array of strings called {' or '.join(map(repr, _NAMES))} in the same message"
                raise SignalError(f"{here}: '[{key}]' {needs}; give an index instead, for example [0]")
            current = replace(current, array=None)
        self._check_leaf(here, current, type_name, topic, type_fields)

    def _check_leaf(self, here: str, leaf: FieldType, type_name: str, topic: str, type_fields: TypeFields) -> None:
        if self.function is not None:
            takes = self.function.takes
            inner = type_fields(leaf.type_name) if leaf.kind == "message" and leaf.array is None else {}
            if leaf.array is not None:
                fits = leaf.kind == "number" and (takes.array == "*" or leaf.array == len(takes.array) > 0)
            else:
                parts = takes.parts(inner)
                fits = bool(parts) and all(inner[name].kind == "number" for name in parts)
            if not fits:
                raise SignalError(f"{here}: wants {takes.words}, and {leaf.type_name} is none")
        elif leaf.kind not in ("number", "bool") or leaf.array is not None:
            what = "an array; give an index, for example [0]" if leaf.array is not None else f"a {leaf.type_name}"
            raise SignalError(f"{here} is not one number but {what}; {_instead(topic, type_name, type_fields)}")


def _instead(topic: str, type_name: str, type_fields: TypeFields) -> str:
    found = list(numeric_paths(type_name, type_fields))
    more = f", and {len(found) - _MOST_PATHS} more" if len(found) > _MOST_PATHS else ""
    return f"numeric field paths of {topic}: {', '.join(found[:_MOST_PATHS]) or 'none'}{more}"


_NO_SIGNALS = ("std_msgs/msg/Header", "builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
_DEPTH = 8
_MOST_NAMES = 100
_MOST_PATHS = 24  # in an error


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
    type_fields: TypeFields,
    type_name: str,
    message: Any,
    before: str = "",
    depth: int = _DEPTH,
    around: Sequence[str] = (),
) -> Iterator[str]:
    """Paths in a decoded message that can be signals, as `FieldPath` reads them; header stamps are left out.

    The entries of an array stand as one path, `data[0..99]` for `data[0]` to `data[99]`, or as `position[fan]` each
    where the message, or the one `around` it, names them; a quaternion is also offered as roll(...) and the like.
    """
    fields = type_fields(type_name)
    names = _names(fields, message, around)
    for name, field in fields.items():
        if field.type_name in _NO_SIGNALS or depth == 0:
            continue
        value, path = getattr(message, name), before + name
        if field.array is not None:
            if not len(value):
                continue
            every = f"{path}[0..{len(value) - 1}]" if len(value) > 1 else f"{path}[0]"
            if field.kind == "message":
                yield from _inside(type_fields, field, value[0], every, depth, names)
            elif field.kind in ("number", "bool"):
                if name in QUATERNION_ARRAYS and field.kind == "number" and field.array == len(QUATERNION.array):
                    yield from (f"{function}({path})" for function in of_quaternion())
                by_name = field.kind == "number" and len(names) == len(value)
                yield from [f"{path}[{n}]" for n in names] if by_name else [every]
        elif field.kind == "message":
            yield from _inside(type_fields, field, value, path, depth, names)
        elif field.kind in ("number", "bool"):
            yield path


def _inside(
    type_fields: TypeFields, field: FieldType, value: Any, path: str, depth: int, around: Sequence[str]
) -> Iterator[str]:
    inner = type_fields(field.type_name)
    if set(inner) == set("xyzw") and all(part.kind == "number" for part in inner.values()):
        yield from (f"{name}({path})" for name in of_quaternion())
    yield from signal_paths(type_fields, field.type_name, value, f"{path}.", depth - 1, around)


_NAMES = "name", "joint_names"  # name the entries of the arrays beside them, and of those in the messages there


def names_in(fields: Mapping[str, FieldType]) -> str:
    """Which field of a message names the entries of its arrays; empty if none does."""
    return next((name for name in _NAMES if name in fields and _are_texts(fields[name])), "")


def _are_texts(field: FieldType) -> bool:
    return field.kind == "string" and field.array is not None


def _names(fields: Mapping[str, FieldType], message: Any, around: Sequence[str]) -> Sequence[str]:
    """Names of the entries of a message's arrays, quoted where they would read as an index; [] without usable ones."""
    if not (own := names_in(fields)):
        return [] if any(map(_are_texts, fields.values())) else around  # others are of something else
    names = [str(name) for name in getattr(message, own)]
    if len(set(names)) < len(names) or len(names) > _MOST_NAMES or any('"' in n or not n.strip() for n in names):
        return []
    return [f'"{n}"' if n.strip().isdigit() or n != n.strip() or "[" in n or "]" in n else n for n in names]
