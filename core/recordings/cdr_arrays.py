# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Fields of many CDR messages at once: gathered by offset, where messages are laid out like one that is known.

Where a field stands in a CDR message depends on the lengths of the strings and sequences before it. So the first
message is decoded, and a `_Layout` notes where its wanted fields stand and which bytes put them there: lengths,
ends of strings, names that a path looks up. Every other message with the same bytes in these places has its
fields in the same places, and decodes if the first one does. A string or an unwanted sequence whose length is
seen to change is measured in each message from then on. Whatever fits no layout is decoded alone.

Values and stamps are, to the last bit, those that `FieldPath.read` and `header_stamp_ns` give for the decoded
message; a layout is used only after it gave these for the message it was made from.
"""

from __future__ import annotations

import functools
import math
from bisect import bisect
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.errors import BagError, SignalError
from uncertain_lti.recordings.cdr_layout import (
    ENCAPSULATION,
    ENCAPSULATIONS,
    PADDING,
    RESERVED,
    SIZES,
    STAMP,
    Number,
    Role,
    UnfitError,
    Walk,
    Wanted,
    wanted,
)
from uncertain_lti.recordings.message_types import Definition
from uncertain_lti.recordings.stamps import header_stamp_ns
from uncertain_lti.signals.field_path import FieldPath
from uncertain_lti.signals.functions import FieldFunction

Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]
Values = NDArray[np.float64]

NO_STAMP = -1
_TEXT = -1
SLACK = 64
_MOST_LAYOUTS = 64
_MOST_WORDS = 1024  # that are compared in each message
_PATIENCE = 300  # messages without a layout that are looked into before no more are
_GAP = 128  # bytes between two wanted places that are copied along rather than left out
_SHORT_TEXT = 64  # bytes; longer texts that change are looked at one by one
_MEANT = {*"xyzw", "header", "stamp", "sec", "nanosec"}  # what is read by a field's name


class Failure(NamedTuple):
    """A message that cannot be decoded.

    `row`: which one of those given; `why`: the reason.
    """

    row: int
    why: str


# --- where it stands in one message -------------------------------------------------------------------------


@dataclass
class _Segment:
    """A stretch of a message in which every place is known from its anchor.

    The anchor is where the segment before ends, brought to a multiple of align; begin is where it stands in the
    message the layout is made from (all places count from behind the encapsulation); bytes `at` to `at + len` have
    to agree with it in the bits of the mask. tail says what follows: a string (_TEXT) whose length stands in the
    last four bytes, or a sequence with this many bytes per element (its count is there), or nothing (0).
    """

    align: int
    begin: int
    size: int = 0
    fixed: list[tuple[int, bytes]] = field(default_factory=list)
    numbers: list[Number] = field(default_factory=list)  # their places count from the anchor
    tail: int = 0


class _Shape:
    """What a layout needs of a message that was walked.

    key tells messages apart whose wanted fields stand in other places, or under other names; lengths are those of
    strings and unwanted sequences in their order, of which those in `free` are left open; odd are the strings
    that are not ASCII.
    """

    def __init__(self, walk: Walk, data: bytes, free: frozenset[int] = frozenset()) -> None:
        self.walk, self.data, self.free = walk, data, free
        key = [data[:2]]
        self.lengths: list[int] = []
        self.odd: set[int] = set()
        self.reserved = walk.reserved
        self.modulus = 8  # the anchor is a multiple of it
        self.segments = [_Segment(8, 0)]
        self._fix(-ENCAPSULATION, b"\xff\xff")
        for role, at, start, end, size in walk.pieces:
            if role in (Role.NUMBERS, Role.TRUTHS):
                place = self._go_to(start, size)
                if role is Role.TRUTHS:
                    self._fix(place, b"\xfe" * (end - start))
                self._end_at(end)
                continue
            place = self._go_to(at, 4)
            self._end_at(at + 4)
            number = len(self.lengths)
            if role in (Role.TEXT, Role.SEQUENCE):
                self.lengths.append((end - start) // size)
                if number in free:
                    self.segments[-1].tail = _TEXT if role is Role.TEXT else size
                    self.reserved -= RESERVED * (size == 8 and start == end)
                    self._next(end, 1 if role is Role.TEXT else min(size, 4))
                    continue
            self._fix(place, b"\xff" * 4)
            content = data[start:end]
            if role is Role.COUNT:
                key.append(data[at : at + 4])
            elif role is Role.NAME:
                key.append(content)
                self._fix(place + 4, b"\xff" * len(content))
            elif role is Role.TEXT:
                if not content.isascii():
                    self.odd.add(number)
                letters = b"\x80" if content.isascii() else b"\xff"
                self._fix(place + 4, letters * (len(content) - 1) + b"\xff")
            elif start < end:
                self._go_to(start, size)
            self._end_at(end)
        self.key = tuple(key)
        begins = [segment.begin for segment in self.segments]
        for one in walk.numbers:
            segment = self.segments[bisect(begins, one.at - ENCAPSULATION) - 1]
            code = one.code if SIZES[one.code] == 1 else walk.order + one.code
            segment.numbers.append(Number(one.at - ENCAPSULATION - segment.begin, code, one.goal))

    def _go_to(self, at: int, align: int) -> int:
        """Place in the segment; in a new one where it is not known from the anchor."""
        if self.modulus % align:
            if not self.segments[-1].size:
                self.segments.pop()  # nothing stands in it
            self._next(at, align)
        return at - ENCAPSULATION - self.segments[-1].begin

    def _next(self, at: int, align: int) -> None:
        self.segments.append(_Segment(align, at - ENCAPSULATION))
        self.modulus = align

    def _end_at(self, end: int) -> None:
        self.segments[-1].size = end - ENCAPSULATION - self.segments[-1].begin

    def _fix(self, place: int, mask: bytes) -> None:
        self.segments[-1].fixed.append((place, mask))


# --- the same for many messages -----------------------------------------------------------------------------


class Messages(NamedTuple):
    """Encoded messages data[begin:end]; SLACK bytes around each can be read as well.

    `data`: A buffer with all of them; `begin` (messages,): where each begins; `end` (messages,): where each ends.
    """

    data: bytearray
    begin: Integers
    end: Integers

    def take(self, which: Mask | Integers | slice) -> Messages:
        """Some of the messages."""
        return Messages(self.data, self.begin[which], self.end[which])


class _Move(NamedTuple):
    """Numbers of one kind that stand side by side, and the columns side by side that they go to."""

    at: int
    kind: str
    number: int
    column: int


class _Span(NamedTuple):
    """Bytes of a segment that are copied out of each message as words of eight bytes; places count from its begin.

    compared are words, what they have to be, and which bits count (None: all); parts are numbers that values are
    worked out from.
    """

    at: int
    words: int
    compared: list[tuple[slice, NDArray[np.uint64], NDArray[np.uint64] | None]]
    moves: list[_Move]
    parts: list[Number]


class _Layout:
    """Where the wanted fields stand in messages of one shape, made from one of them."""

    def __init__(self, shape: _Shape, paths: Sequence[FieldPath]) -> None:
        self.free, self.lengths, self.odd = shape.free, shape.lengths, shape.odd
        self.order, self.reserved = shape.walk.order, shape.reserved
        self.hits = 0
        parts = dict(shape.walk.whole)
        for number in shape.walk.numbers:
            path, part = number.goal
            parts[path] = max(parts.get(path, 0), part + 1)
        self.stamped = STAMP in parts
        self.absent = [i for i in range(len(paths)) if i not in parts]
        self.computed = [(i, p.function, parts[i]) for i, p in enumerate(paths) if p.function and i in parts]
        plain = {i for i, path in enumerate(paths) if not path.function}
        around = bytes(8 - ENCAPSULATION) + shape.data + bytes(16)  # byte 8 is the first behind the encapsulation
        self.segments = [(segment, _spans(segment, around, plain)) for segment in shape.segments]
        if sum(len(what) for _, spans in self.segments for span in spans for _, what, _ in span.compared) > _MOST_WORDS:
            raise UnfitError

    def read(self, messages: Messages, values: Values, stamps: Integers, rows: Integers | None = None) -> Mask:
        """Fill in rows of values and stamps (all where rows is None); returns which messages have this layout.

        What is filled in for the others means nothing.
        """
        some = _Some(messages, rows)
        some.least = some.least - self.reserved
        for segment, spans in self.segments:
            if segment.align > 1:
                some.anchor = some.anchor + (some.base - some.anchor) % segment.align
            some.keep(some.anchor + segment.size <= some.end)
            if not len(some.end):
                return np.zeros(len(messages.begin), dtype=bool)
            for span in spans:
                self._copy(span, some, values)
            some.anchor = some.anchor + segment.size
            if segment.tail:
                length = numbers_at(messages.data, self.order + "u4")[some.anchor - 4].astype(np.int64)
                if segment.tail == _TEXT:
                    self._pass_text(some, length)
                else:
                    begin = some.anchor + (some.base - some.anchor) % segment.tail
                    some.anchor = np.where(length > 0, begin + length * segment.tail, some.anchor)
                    if segment.tail == 8:
                        some.least = some.least - RESERVED * (length == 0)
        some.keep((some.anchor <= some.end) & (some.anchor >= some.least))
        where = slice(None) if some.rows is None else some.rows
        for path in self.absent:
            values[where, path] = math.nan
        for path, function, count in self.computed:
            values[where, path] = _compute(function, [some.parts[path, part] for part in range(count)], len(some.end))
        stamps[where] = NO_STAMP
        if self.stamped:
            time = some.parts[STAMP, 0].astype(np.int64) * 1_000_000_000 + some.parts[STAMP, 1]
            stamps[where] = np.where(time == 0, NO_STAMP, time)
        fit = np.zeros(len(messages.begin), dtype=bool)
        fit[some.position] = True
        return fit

    def _copy(self, span: _Span, some: _Some, values: Values) -> None:
        copies = numbers_at(some.data, f"V{8 * span.words}")[some.anchor + span.at]
        words = copies.view("<u8").reshape(-1, span.words)
        for which, expected, bits in span.compared:
            if bits is None:
                wrong = words[:, which] != expected
            else:
                wrong = (words[:, which] ^ expected) & bits
            if wrong.any():
                fit: Mask = ~np.asarray(wrong.any(axis=1))
                some.keep(fit)
                words = words[fit]
        content = words.view(np.uint8)
        where = slice(None) if some.rows is None else some.rows
        for move in span.moves:
            values[where, move.column : move.column + move.number] = _taken(content, move.at, move.kind, move.number)
        for number in span.parts:
            some.parts[number.goal] = _taken(content, number.at, number.code, 1)[:, 0]

    def _pass_text(self, some: _Some, length: Integers) -> None:
        """Go behind a string of this length, its closing zero counted, where it is one."""
        (length,) = some.keep((length > 0) & (some.anchor + length <= some.end), length)
        (length,) = some.keep(np.frombuffer(some.data, np.uint8)[some.anchor + length - 1] == 0, length)
        odd = np.zeros(len(length), dtype=bool)
        letters = numbers_at(some.data, "<u8")
        for at in range(0, min(int(length.max(initial=0)), _SHORT_TEXT), 8):
            odd |= (letters[some.anchor + at] & _NOT_ASCII[np.clip(length - 1 - at, 0, 8)]) != 0
        odd |= length > _SHORT_TEXT
        for i in np.flatnonzero(odd).tolist():
            begin = int(some.anchor[i])
            try:
                some.data[begin : begin + int(length[i]) - 1].decode()
                odd[i] = False
            except UnicodeDecodeError:
                pass
        (length,) = some.keep(~odd, length)
        some.anchor = some.anchor + length


_NOT_ASCII = np.array([int.from_bytes(b"\x80" * n, "little") for n in range(9)], dtype=np.uint64)


class _Some:
    """The messages that still fit a layout: where each is in it, and the numbers taken from it so far."""

    def __init__(self, messages: Messages, rows: Integers | None) -> None:
        self.data, self.end = messages.data, messages.end
        self.least = messages.end - PADDING  # where a message has to end
        self.base = messages.begin + ENCAPSULATION
        self.anchor = self.base
        self.rows = rows
        self.position = np.arange(len(self.end))
        self.parts: dict[tuple[int, int], NDArray[Any]] = {}

    def keep(self, fit: Mask, *along: Integers) -> tuple[Integers, ...]:
        """Forget those that do not fit, in these arrays as well."""
        if np.count_nonzero(fit) == len(fit):
            return along
        if self.rows is None:
            self.rows = self.position
        self.rows, self.position = self.rows[fit], self.position[fit]
        self.base, self.anchor, self.end = self.base[fit], self.anchor[fit], self.end[fit]
        self.least = self.least[fit]
        self.parts = {goal: part[fit] for goal, part in self.parts.items()}
        return tuple(array[fit] for array in along)


def numbers_at(data: bytearray, kind: str) -> NDArray[Any]:
    """Numbers of this kind that begin at every byte of a buffer.

    Returns (bytes - size + 1,): A view.
    """
    size = np.dtype(kind).itemsize
    numbers: NDArray[Any] = np.ndarray((len(data) - size + 1,), kind, data, strides=(1,))
    return numbers


def _taken(content: NDArray[np.uint8], at: int, kind: str, count: int) -> NDArray[Any]:
    size = count * np.dtype(kind).itemsize
    if kind == "?":
        return np.asarray(content[:, at : at + size] != 0)
    return content[:, at : at + size].view(kind)


def _compute(function: FieldFunction, parts: Sequence[NDArray[Any]], count: int) -> Values:
    """The number that a function gives for each message, as `FieldFunction.of` does."""
    if not parts:  # the norm of an empty array
        return np.full(count, function.of_parts())
    if any(part.dtype.kind != "f" for part in parts):  # of whole numbers: without rounding
        rows = zip(*(part.tolist() for part in parts), strict=True)
        return np.array([function.of_parts(*row) for row in rows], dtype=np.float64)
    arguments, size = function.terms(*(part.astype(np.float64) for part in parts))
    there = np.broadcast_to(np.asarray(size > 0.0), count)
    result = np.full(count, math.nan)
    result[there] = list(map(function.number, *(argument[there].tolist() for argument in arguments)))
    return result


def _spans(segment: _Segment, around: bytes, plain: set[int]) -> list[_Span]:
    """Parts of a segment that are copied; around is the message behind eight bytes."""
    places = [(at, at + len(mask)) for at, mask in segment.fixed]
    places += [(n.at, n.at + np.dtype(n.code).itemsize) for n in segment.numbers]
    stretches: list[list[int]] = []
    for begin, end in sorted(places):
        begin, end = begin // 8 * 8, -(-end // 8) * 8
        if stretches and begin <= stretches[-1][1] + _GAP:
            stretches[-1][1] = max(end, stretches[-1][1])
        else:
            stretches.append([begin, end])
    spans = []
    for begin, end in stretches:
        origin = 8 + segment.begin + begin
        expected = np.frombuffer((around + bytes(end - begin))[origin : origin + end - begin], "<u8")
        mask = np.zeros(end - begin, np.uint8)
        for at, bits in segment.fixed:
            if begin <= at < end:
                mask[at - begin : at - begin + len(bits)] |= np.frombuffer(bits, np.uint8)
        bits64 = mask.view("<u8")
        compared: list[tuple[slice, NDArray[np.uint64], NDArray[np.uint64] | None]] = []
        for run in _runs(bits64 != 0):
            every = bool((bits64[run] == 2**64 - 1).all())
            compared.append((run, expected[run] & bits64[run], None if every else bits64[run]))
        numbers = [n._replace(at=n.at - begin) for n in segment.numbers if begin <= n.at < end]
        moves = _moves([n for n in numbers if n.goal[0] in plain])
        spans.append(_Span(begin, (end - begin) // 8, compared, moves, [n for n in numbers if n.goal[0] not in plain]))
    return spans


def _runs(used: Mask) -> list[slice]:
    """Stretches of a mask, taken together over holes of two."""
    runs: list[slice] = []
    for i in np.flatnonzero(used).tolist():
        if runs and i <= runs[-1].stop + 2:
            runs[-1] = slice(runs[-1].start, i + 1)
        else:
            runs.append(slice(i, i + 1))
    return runs


def _moves(numbers: Sequence[Number]) -> list[_Move]:
    moves: list[_Move] = []
    for number in sorted(numbers, key=lambda n: (n.goal, n.at)):
        column, size = number.goal[0], np.dtype(number.code).itemsize
        last = moves[-1] if moves else None
        if (
            last
            and number.code == last.kind
            and number.at == last.at + last.number * size
            and column == last.column + last.number
        ):
            moves[-1] = last._replace(number=last.number + 1)
        else:
            moves.append(_Move(number.at, number.code, 1, column))
    return moves


# --- one topic ----------------------------------------------------------------------------------------------


class FieldReader:
    """Reads the paths of one topic from its messages; learns their layouts as it meets them.

    `definition`: of the messages; `paths`: to read; checked against the type.
    """

    def __init__(self, definition: Definition, paths: Sequence[FieldPath]) -> None:
        self.definition, self.paths = definition, paths
        self.layouts: dict[tuple[object, ...], _Layout] = {}
        self.wanted: Wanted | None = None
        self.alone = 0  # messages that were decoded one by one
        self.patience = _PATIENCE
        self.fields = functools.cache(definition.fields)
        if any(name in _MEANT for constants, _ in definition.types.values() for name, *_ in constants):
            return  # the decoder takes these constants for fields
        try:
            self.wanted = wanted(definition.type_name, paths, self.fields)
        except (UnfitError, SignalError):
            pass

    def read(self, messages: Messages, values: Values, stamps: Integers) -> list[Failure]:
        """Fill in a row of values and a stamp for each message.

        `values` (messages, paths): takes the values; `stamps` (messages,): takes the header stamps, ns; NO_STAMP for
        none.
        """
        with np.errstate(all="ignore"):  # a signalling NaN is read like any other
            return self._read_all(messages, values, stamps)

    def _read_all(self, messages: Messages, values: Values, stamps: Integers) -> list[Failure]:
        failures: list[Failure] = []
        left = np.arange(len(messages.begin))
        for layout in sorted(self.layouts.values(), key=lambda layout: -layout.hits):
            if len(left):
                left = self._read(layout, messages, values, stamps, left)
        while len(left):
            row = int(left[0])
            data = bytes(memoryview(messages.data)[messages.begin[row] : messages.end[row]])
            layout_of_it = self._learn(data)
            if layout_of_it is not None:
                after = self._read(layout_of_it, messages, values, stamps, left)
                if len(after) < len(left):
                    left = after
                    continue
            try:
                values[row], stamps[row] = self._decode(data)
                self.alone += 1
            except BagError as error:
                failures.append(Failure(row, str(error)))
            left = left[1:]
        return failures

    def _read(self, layout: _Layout, messages: Messages, values: Values, stamps: Integers, left: Integers) -> Integers:
        """Read what has this layout; returns what has not."""
        if len(left) == len(messages.begin):
            fit = layout.read(messages, values, stamps)
        else:
            fit = layout.read(messages.take(left), values, stamps, left)
        layout.hits += int(np.count_nonzero(fit))
        return left[~fit]

    def _decode(self, data: bytes) -> tuple[list[float], int]:
        value = self.definition.decode(data)
        return [path.read(value) for path in self.paths], header_stamp_ns(value) or NO_STAMP

    def _learn(self, data: bytes) -> _Layout | None:
        """Layout that a message has and that is not known yet, or is known too narrowly."""
        if self.wanted is None or self.patience <= 0 or data[:2] not in ENCAPSULATIONS:
            return None
        self.patience -= 1
        try:
            self.definition.decode_strictly(data)
            walk = Walk(data, self.fields)
            walk.message(self.definition.type_name, self.wanted)
            shape = _Shape(walk, data)
            known = self.layouts.get(shape.key)
            if known is not None:
                free = self._free(known, shape)
                if free == known.free:
                    return None
                shape = _Shape(walk, data, free)
            elif len(self.layouts) >= _MOST_LAYOUTS:
                return None
            layout = _Layout(shape, self.paths)
        except BagError:
            return None
        except UnfitError:
            self.patience -= _PATIENCE // 10
            return None
        if not self._holds(layout, data):
            self.wanted, self.layouts = None, {}
            return None
        self.layouts[shape.key] = layout
        self.patience = _PATIENCE
        return layout

    def _free(self, known: _Layout, shape: _Shape) -> frozenset[int]:
        """What has to be left open so that a layout holds for a second message."""
        pairs = zip(known.lengths, shape.lengths, strict=True)
        free = known.free | {i for i, (one, other) in enumerate(pairs) if one != other}
        return frozenset(free if free != known.free else free | known.odd | shape.odd)

    def _holds(self, layout: _Layout, data: bytes) -> bool:
        """Whether a layout gives for its own message what decoding gives."""
        values, stamps = np.empty((1, len(self.paths))), np.empty(1, dtype=np.int64)
        buffer = bytearray(SLACK) + data + bytearray(SLACK)
        alone = Messages(buffer, np.array([SLACK]), np.array([SLACK + len(data)]))
        if not layout.read(alone, values, stamps).all():
            return False
        decoded, stamp = self._decode(data)
        return values.tobytes() == np.array(decoded, dtype=np.float64).tobytes() and int(stamps[0]) == stamp
