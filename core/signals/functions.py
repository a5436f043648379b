# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Functions of a field: of one message's values, such as yaw(...), and of earlier samples, such as lag(...)."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, NamedTuple

from uncertain_lti.base.errors import SignalError


class ValueKind(NamedTuple):
    """What a function takes: a message with certain fields, or also an array of numbers.

    `words`: what it is, for errors; `required`: fields that a message must have, one letter each; `optional`: fields
    that count where the message has them; `array`: whether an array of numbers will do as well.
    """

    words: str
    required: str
    optional: str = ""
    array: bool = False

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
            return self.of_parts(*(as_number(v) for v in value))
        return self.of_parts(*(getattr(value, name) for name in names if hasattr(value, name)))

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


QUATERNION = ValueKind("a quaternion with x, y, z, w", "xyzw")
VECTOR = ValueKind("a vector with x, y, z or an array of numbers", "x", "yzw", array=True)

FUNCTIONS: Mapping[str, FieldFunction] = {
    "roll": FieldFunction(QUATERNION, _roll, math.atan2, unit="rad", wraps=True),
    "pitch": FieldFunction(QUATERNION, _pitch, _arc_sine, unit="rad"),
    "yaw": FieldFunction(QUATERNION, _yaw, math.atan2, unit="rad", wraps=True),
    "norm": FieldFunction(VECTOR, _unchanged, math.hypot),
}
"""Name in a signals file -> function. A function added here can be used in recordings, live and by `init`."""


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
