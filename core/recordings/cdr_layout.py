# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Where everything stands in a serialised message (CDR): one walk by the type definition, for every reader.

CDR aligns a number to its size, counted from behind the encapsulation, and puts a length of four bytes before each
string and sequence. A string ends with a zero that its length counts.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, Literal, NamedTuple

from uncertain_lti.signals.field_path import FieldPath
from uncertain_lti.signals.field_types import FieldType, TypeFields

CODES = {
    "byte": "B", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I",
    "int64": "q", "uint64": "Q", "float32": "f", "float64": "d", "bool": "?",
}  # fmt: skip
"""Type -> its code in struct and in numpy."""
SIZES = {code: struct.calcsize(f"<{code}") for code in CODES.values()}
"""Code -> bytes."""
ENCAPSULATIONS = b"\0\0", b"\0\1", b"\0\3"
"""Plain CDR, and what the middleware reads as such; only the first is big-endian."""
ENCAPSULATION = 4
"""Bytes before the first field."""
STAMP = -1
"""Stands for a path where the header stamp is meant."""
PADDING = 3
"""Bytes that may stand behind any message: some senders fill up to a multiple of four."""
RESERVED = 4
"""Bytes that `rclpy.serialization` leaves behind a message for each empty sequence of 8-byte numbers in it."""
_MOST_PARTS = 20_000  # of a message that is walked


class UnfitError(Exception):
    """A message, or a type, that only the decoder can read."""


class CutError(UnfitError):
    """A message that ends before its definition does."""


# --- what is wanted of a message ----------------------------------------------------------------------------


@dataclass
class Wanted:
    """What paths want of one value of a message.

    `fields, elements, named`: of its fields by name, and of its elements by position or by name; `goals`: (path, part)
    that the value itself is for; `every`: paths that take all elements, part after part.
    """

    fields: dict[str, Wanted] = field(default_factory=dict)
    elements: dict[int, Wanted] = field(default_factory=dict)
    named: dict[str, Wanted] = field(default_factory=dict)
    goals: list[tuple[int, int]] = field(default_factory=list)
    every: list[int] = field(default_factory=list)


def wanted(type_name: str, paths: Sequence[FieldPath], fields: TypeFields) -> Wanted:
    """What these paths, and the header stamp, want of a message."""
    top = Wanted()
    for number, path in enumerate(paths):
        path.check("", type_name, fields)
        here, kind = top, FieldType("message", type_name)
        for step, key in path.steps:
            if step == "attribute":
                kind = fields(kind.type_name)[str(key)]
                here = here.fields.setdefault(str(key), Wanted())
            else:
                kind = replace(kind, array=None)
                table: dict[Any, Wanted] = here.elements if step == "index" else here.named
                here = table.setdefault(key, Wanted())
        if path.function is None:
            here.goals.append((number, 0))
        elif kind.array is not None:
            here.every.append(number)
        else:
            for part, name in enumerate(path.function.takes.parts(fields(kind.type_name))):
                here.fields.setdefault(name, Wanted()).goals.append((number, part))
    header = fields(type_name).get("header")
    if header is not None and header.kind == "message" and header.array is None:
        stamp = fields(header.type_name).get("stamp")
        if stamp is not None:
            here = top.fields.setdefault("header", Wanted()).fields.setdefault("stamp", Wanted())
            parts = fields(stamp.type_name) if stamp.kind == "message" and stamp.array is None else {}
            for part, name in enumerate(("sec", "nanosec")):
                one = parts.get(name)
                if one is None or one.array is not None or CODES.get(one.type_name, "d") not in "bBhHiI":
                    raise UnfitError
                here.fields.setdefault(name, Wanted()).goals.append((STAMP, part))
    return top


# --- where it stands in one message -------------------------------------------------------------------------


class Role(Enum):
    """What a stretch of a message holds."""

    NUMBERS = "numbers"
    TRUTHS = "truth values, each of which is 0 or 1"
    COUNT = "the length of a sequence, whose elements follow"
    SEQUENCE = "a sequence of numbers that no path looks into, with its length"
    TEXT = "a string with its length"
    NAME = "a string with its length, among which a path looks up a name"


class Piece(NamedTuple):
    """A stretch of a message; places count from its first byte.

    `role`: what it holds; `at`: where it begins, with its length if it has one; `start, end`: where its content begins,
    and where that ends; `size`: bytes of one element.
    """

    role: Role
    at: int
    start: int
    end: int
    size: int

    @property
    def has_length(self) -> bool:
        """Whether a length stands before the content."""
        return self.role not in (Role.NUMBERS, Role.TRUTHS)


class Number(NamedTuple):
    """A wanted number.

    `at`: where it stands; `code`: its type, of `CODES`; `goal`: path and part that it is for.
    """

    at: int
    code: str
    goal: tuple[int, int]


class Walk:
    """One pass over a message, which notes every piece of it, and where the wanted numbers stand.

    `data`: serialised message; `fields`: type name -> {field name: FieldType}; `at`: where to begin; `pieces`: in
    order; `numbers`: the wanted ones that are there; `whole`: path that takes a whole array -> its length; `reserved`:
    bytes that may stand behind the message, besides `PADDING`; `odd`: whether a string has not even a closing zero.
    """

    def __init__(self, data: bytes, fields: TypeFields, at: int = ENCAPSULATION) -> None:
        if data[:2] not in ENCAPSULATIONS:
            raise UnfitError
        self._data, self._fields, self._at = data, fields, at
        self._endian: Literal["big", "little"] = "little" if data[1] else "big"
        self.order = "<" if data[1] else ">"
        self.pieces: list[Piece] = []
        self.numbers: list[Number] = []
        self.whole: dict[int, int] = {}
        self.reserved = 0
        self.odd = False

    @property
    def excess(self) -> int:
        """Bytes behind what was walked if they are more than senders leave there, else 0."""
        left = len(self._data) - self._at
        return left if left > PADDING + self.reserved else 0

    @property
    def untrue(self) -> bool:
        """Whether a truth value is neither 0 nor 1: the middleware refuses such a message."""
        return any(max(self._data[p.start : p.end]) > 1 for p in self.pieces if p.role is Role.TRUTHS)

    def message(self, type_name: str, wanted: Wanted | None = None) -> None:
        """Walk a message, or one inside."""
        fields = self._fields(type_name)
        if not fields:
            self._numbers("B", 1, {})  # an empty message is one byte long
        looked_up = wanted is not None and any(entry.named for entry in wanted.fields.values())
        names = self._look_ahead(fields) if looked_up else []
        for name, kind in fields.items():
            here = wanted.fields.get(name) if wanted else None
            self._field(kind, here, names, Role.NAME if looked_up and name == "name" else Role.TEXT)

    def _look_ahead(self, fields: Any) -> list[str]:
        """Names in this message: the arrays whose elements they name may stand before them."""
        ahead = Walk(self._data, self._fields, self._at)
        for name, kind in fields.items():
            before = len(ahead.pieces)
            ahead._field(kind, None, [], Role.NAME)
            if name == "name":
                break
        texts = (self._data[p.start : p.end] for p in ahead.pieces[before:] if p.role is Role.NAME)
        return [text.split(b"\0")[0].decode(errors="replace") for text in texts]  # as the middleware reads them

    def _field(self, kind: FieldType, here: Wanted | None, names: Sequence[str], role: Role) -> None:
        plain = kind.kind not in ("string", "message")
        code = CODES.get(kind.type_name, "") if plain else ""
        if (plain and not code) or (kind.kind == "string" and kind.type_name.startswith("wstring")):
            raise UnfitError
        if kind.array is None:
            count, elements = 1, {0: here} if here else {}
        elif kind.array == 0 and plain and here is None and code != "?":
            self._sized(Role.SEQUENCE, SIZES[code])
            return
        else:
            count = kind.array or self._sized(Role.COUNT, SIZES.get(code, 1))
            elements = self._elements(here, names, count) if here else {}
        if plain:
            if count:
                self._numbers(code, count, elements)
            return
        for i in range(count):
            if kind.kind == "message":
                self.message(kind.type_name, elements.get(i))
            else:
                self.odd |= not self._sized(role, 1)

    def _elements(self, here: Wanted, names: Sequence[str], count: int) -> dict[int, Wanted]:
        """Wanted elements of an array by position, those by name among them; what is not there is left out."""
        found = {i: each for i, each in here.elements.items() if i < count}
        for name, each in here.named.items():
            if name in names[:count]:
                i = names.index(name)
                found[i] = _merged(found[i], each) if i in found else each
        for path in here.every:
            self.whole[path] = count
            for i in range(_bounded(count)):
                found[i] = _merged(found.get(i, Wanted()), Wanted(goals=[(path, i)]))
        return found

    def _numbers(self, code: str, count: int, elements: dict[int, Wanted]) -> None:
        size = SIZES[code]
        start = self._at + (ENCAPSULATION - self._at) % size
        role = Role.TRUTHS if code == "?" else Role.NUMBERS
        self._add(Piece(role, start, start, start + count * size, size))
        for i, each in elements.items():
            self.numbers += [Number(start + i * size, code, goal) for goal in each.goals]

    def _sized(self, role: Role, size: int) -> int:
        """A length, and what it is the length of except where that is walked on its own; returns the length."""
        at = self._at + -self._at % 4
        start = at + 4
        count = int.from_bytes(self._data[at:start], self._endian)
        if count > len(self._data):
            raise CutError
        self.reserved += RESERVED * (size == 8 and not count)
        if role is Role.COUNT:
            self._add(Piece(role, at, start, start, size))
            return count
        start += (ENCAPSULATION - start) % size if count else 0
        self._add(Piece(role, at, start, start + count * size, size))
        return count

    def _add(self, piece: Piece) -> None:
        if piece.end > len(self._data):
            raise CutError
        _bounded(len(self.pieces))
        self.pieces.append(piece)
        self._at = piece.end


def _bounded(count: int) -> int:
    if count > _MOST_PARTS:
        raise UnfitError
    return count


def _merged(one: Wanted, other: Wanted) -> Wanted:
    """What both want of one value."""

    def both(some: dict[Any, Wanted], more: dict[Any, Wanted]) -> dict[Any, Wanted]:
        return some | {key: _merged(some[key], more[key]) if key in some else more[key] for key in more}

    return Wanted(
        both(one.fields, other.fields), both(one.elements, other.elements), both(one.named, other.named),
        one.goals + other.goals, one.every + other.every,
    )  # fmt: skip
