# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""MessageReader: the stamp and the wanted numbers of serialised messages, without making message objects.

Where a number stands in a CDR message depends on the lengths of the strings and sequences before it. So the first
message is decoded by the middleware, and a `_Layout` notes where its wanted numbers stand and which bytes put them
there: lengths, and names that a path looks up. A later message of the same length with the same bytes in these
places has its numbers in the same places. What fits no layout is decoded. A layout is used only after it gave, to the
last bit, what decoding gave for the message that it was made from.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from typing import Any

import cython

from uncertain_lti.base.errors import SignalError
from uncertain_lti.recordings.cdr_layout import SIZES, STAMP, CutError, Role, UnfitError, Walk, Wanted, wanted
from uncertain_lti.recordings.stamps import header_stamp_ns
from uncertain_lti.signals.field_path import FieldPath
from uncertain_lti.signals.field_types import TypeFields

_MOST_LAYOUTS = 8
_NEAR = 128  # bytes between two places that are compared in one go
_LAYOUT = 100  # what making one costs; each message that fits one pays 1
_BUDGET = 50 * _LAYOUT

_SHAPED_ODDLY = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)


class UnreadableError(Exception):
    """The middleware cannot decode a message, or a field is filled so that it is no number."""


@cython.cclass
class MessageReader:
    """Stamp and values of the messages of one topic.

    `type_name`: as package/msg/Name; `paths`: checked against the type; `type_fields`: type name -> {field name:
    FieldType}; `decode`: serialised message -> message; may raise anything where that is not one; `decoded`: messages
    that fitted no layout.
    """

    type_name: str = cython.declare(object, visibility="readonly")
    decoded: int = cython.declare(object, visibility="readonly")
    _paths: tuple[FieldPath, ...]
    _fields: Any
    _decode: Any
    _wanted: Any
    _layouts: list[_Layout]
    _budget: cython.Py_ssize_t

    def __init__(
        self, type_name: str, paths: Sequence[FieldPath], type_fields: TypeFields, decode: Callable[[bytes], Any]
    ) -> None:
        self.type_name = type_name
        self.decoded = 0
        self._paths = tuple(paths)
        self._fields, self._decode = type_fields, decode
        self._wanted = None
        try:
            self._wanted = wanted(type_name, self._paths, type_fields)
        except (UnfitError, SignalError):
            pass
        self._layouts = []
        self._budget = _BUDGET

    def read(self, data: bytes) -> tuple[int | None, Sequence[float]]:
        """Header stamp and one value per path."""
        layout: _Layout
        for position, layout in enumerate(self._layouts):
            if (found := layout.read(data)) is not None:
                if position:
                    self._layouts.insert(0, self._layouts.pop(position))
                if self._budget < _BUDGET:
                    self._budget += 1
                return found
        self.decoded += 1
        try:
            message = self._decode(data)
        except Exception as error:  # what the middleware raises is not stated anywhere
            raise UnreadableError(f"cannot be decoded: {error}") from None
        learn = self._wanted is not None and self._budget >= _LAYOUT
        try:
            walk = self._walk(data, self._wanted if learn else None)
        except CutError:  # some of which the middleware fills up with zeros
            raise UnreadableError(f"is cut: it ends before a {self.type_name} does") from None
        if walk is not None and walk.excess:
            raise UnreadableError(
                f"is {walk.excess} bytes longer than a {self.type_name}; "
                f"its publisher may have another version of that type"
            )
        if walk is not None and walk.untrue:
            raise UnreadableError("holds a truth value that is neither 0 nor 1")
        try:
            stamp, values = header_stamp_ns(message), [path.read(message) for path in self._paths]
        except _SHAPED_ODDLY as error:
            raise UnreadableError(f"a field cannot be read: {error}") from None
        if walk and learn:
            self._budget -= _LAYOUT
            self._learn(walk, data, stamp, values)
        return stamp, values

    def _walk(self, data: bytes, wanted: Wanted | None) -> Walk | None:
        """The message walked; None where it cannot be. Raises CutError if it is cut."""
        try:
            walk = Walk(data, self._fields)
            walk.message(self.type_name, wanted)
        except CutError:
            raise
        except (UnfitError, SignalError):
            return None
        return walk

    def _learn(self, walk: Walk, data: bytes, stamp: int | None, values: list[float]) -> None:
        if walk.odd:
            return
        layout = _Layout(walk, data, self._paths)
        found = layout.read(data)
        if found is not None and found[0] == stamp and _same(found[1], values):
            self._layouts.insert(0, layout)
            del self._layouts[_MOST_LAYOUTS:]


def _same(some: Sequence[float], others: Sequence[float]) -> bool:
    pack = struct.Struct(f"<{len(others)}d").pack
    return len(some) == len(others) and pack(*some) == pack(*others)


@cython.cclass
class _Layout:
    """Places of the wanted numbers in messages that look like the one that was walked."""

    _size: cython.Py_ssize_t
    _first: cython.Py_ssize_t
    _plain: cython.bint
    _shape: list[tuple[int, int, int, int]]
    _picks: list[int]
    _computed: list[tuple[Any, int, bool]]
    _unpack: Any

    def __init__(self, walk: Walk, data: bytes, paths: Sequence[FieldPath]) -> None:
        self._size = len(data)
        lengths = [(p.at, p.end if p.role is Role.NAME else p.at + 4, 0xFF) for p in walk.pieces if p.has_length]
        truths = [(p.start, p.end, 0xFE) for p in walk.pieces if p.role is Role.TRUTHS]
        self._shape = _shape(data, [(0, 2, 0xFF), *lengths, *truths])
        numbers = sorted(walk.numbers, key=lambda number: number.goal)  # the stamp is the first
        places = [(number.at, number.code) for number in numbers]
        order = sorted(set(places))
        self._unpack = _struct(walk.order, order).unpack_from
        where = {place: i for i, place in enumerate(order)}
        self._picks = [where[place] for place in places]
        counts = [0] * len(paths)
        for number in numbers:
            if number.goal[0] != STAMP:
                counts[number.goal[0]] += 1
        self._first = len(numbers) - sum(counts)
        functions = [path.function for path in paths]
        self._plain = self._picks == list(range(self._first + len(paths))) and not any(functions)
        self._plain = self._plain and all(code in "fd" for _, code in places[self._first :])
        self._computed = [
            (function.of_parts if function else float, count, not count and i not in walk.whole)
            for i, (function, count) in enumerate(zip(functions, counts, strict=True))
        ]

    def read(self, data: bytes) -> tuple[int | None, Sequence[float]] | None:
        """Stamp and values; None where the message looks otherwise."""
        if len(data) != self._size:
            return None
        for start, stop, mask, expected in self._shape:
            if int.from_bytes(data[start:stop], "little") & mask != expected:
                return None
        numbers = self._unpack(data)
        stamp = None
        first: cython.Py_ssize_t = self._first
        if self._plain:
            if first:
                stamp = numbers[0] * 1_000_000_000 + numbers[1] or None
            return stamp, numbers[first:]
        picked = [numbers[i] for i in self._picks]
        if first:
            stamp = picked[0] * 1_000_000_000 + picked[1] or None
        values = []
        for number, count, absent in self._computed:
            values.append(math.nan if absent else number(*picked[first : first + count]))
            first += count
        return stamp, values


def _struct(order: str, places: Sequence[tuple[int, str]]) -> struct.Struct:
    """Unpacks numbers at these places, in rising order, from the start of a message."""
    text, at = order, 0
    for start, code in places:
        text += f"{start - at}x" if start > at else ""
        text += code
        at = start + SIZES[code]
    return struct.Struct(text)


def _shape(data: bytes, places: list[tuple[int, int, int]]) -> list[tuple[int, int, int, int]]:
    """(start, stop, mask, value) of the stretches that hold these places (start, stop, bits of each byte that count).

    Padding between them is not compared.
    """
    stretches: list[tuple[int, int, list[tuple[int, int, int]]]] = []
    for start, stop, bits in sorted(places):
        if stretches and start - stretches[-1][1] < _NEAR:
            begin, _, parts = stretches[-1]
            parts.append((start, stop, bits))
            stretches[-1] = begin, stop, parts
        else:
            stretches.append((start, stop, [(start, stop, bits)]))
    found = []
    for begin, end, parts in stretches:
        mask = bytearray(end - begin)
        for start, stop, bits in parts:
            mask[start - begin : stop - begin] = bytes([bits]) * (stop - start)
        number = int.from_bytes(mask, "little")
        found.append((begin, end, number, int.from_bytes(data[begin:end], "little") & number))
    return found
