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

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.typesys.base import normalize_fieldname

from uncertain_lti.base.errors import BagError
from uncertain_lti.recordings.message_types import CODES, Definition
from uncertain_lti.recordings.stamps import header_stamp_ns
from uncertain_lti.signals.field_path import FieldPath
from uncertain_lti.signals.functions import FieldFunction

Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]
Values = NDArray[np.float64]

_Key = TypeVar("_Key", str, int)

NO_STAMP = -1
_TEXT = -1
_STAMP = -1  # stands for a path where the header stamp is meant
SLACK = 64
_MOST_LAYOUTS = 64
_MOST_PARTS = 20_000  # of a message that a layout is made from
_MOST_WORDS = 1024  # that are compared in each message
_PATIENCE = 300  # messages without a layout that are looked into before no more are
_GAP = 128  # bytes between two wanted places that are copied along rather than left out
_SHORT_TEXT = 64  # bytes; longer texts that change are looked at one by one
_ENCAPSULATION = 4


class RepeatedNamesError(Exception):
    """A name that a path looks up stands twice: which one counts depends on the messages before."""


class _UnfitError(Exception):
    """These messages have to be decoded one by one."""


class Failure(NamedTuple):
    """A message that cannot be decoded.

    Parameters
    ----------
    row : int
        Which one of those given.
    why : str
        The reason.
    """

    row: int
    why: str


# --- what is wanted of a message ----------------------------------------------------------------------------


@dataclass
class _Wanted:
    """What paths want of one value of a message.

    goals are (path, part): the value itself; every: the same for all elements of an array, part after part.
    """

    fields: dict[str, _Wanted] = field(default_factory=dict)
    elements: dict[int, _Wanted] = field(default_factory=dict)
    named: dict[str, _Wanted] = field(default_factory=dict)
    goals: list[tuple[int, int]] = field(default_factory=list)
    every: list[int] = field(default_factory=list)


def _wanted(definition: Definition, paths: Sequence[FieldPath]) -> _Wanted:
    """Raises _UnfitError where the paths are not those of plain numbers."""
    top = _Wanted()
    for number, path in enumerate(paths):
        here, type_name, is_array, is_message = top, definition.type_name, False, True
        parent: Mapping[str, tuple[Any, Any]] = {}
        for kind, key in path.steps:
            if kind == "attribute":
                if not is_message or is_array:
                    raise _UnfitError
                parent = _fields(definition, type_name)
                node, what = parent.get(str(key), (None, None))
                is_array = node in (Nodetype.ARRAY, Nodetype.SEQUENCE)
                if is_array:
                    node, what = what[0]
                if node not in (Nodetype.BASE, Nodetype.NAME):
                    raise _UnfitError
                is_message = node == Nodetype.NAME
                type_name = what if is_message else what[0]
                here = here.fields.setdefault(str(key), _Wanted())
            else:
                if not is_array or (kind == "name" and not _holds_names(parent)):
                    raise _UnfitError
                is_array = False
                table: dict[Any, _Wanted] = here.elements if kind == "index" else here.named
                here = table.setdefault(key, _Wanted())
        if path.function is None:
            if is_array or is_message:
                raise _UnfitError
            here.goals.append((number, 0))
        elif is_message and not is_array:
            parts = _parts(definition, type_name, path.function)
            for part, name in enumerate(parts):
                here.fields.setdefault(name, _Wanted()).goals.append((number, part))
        elif is_array and not is_message and path.function.takes.array:
            here.every.append(number)
        else:
            raise _UnfitError
    _want_stamp(definition, top)
    return top


def _parts(definition: Definition, type_name: str, function: FieldFunction) -> tuple[str, ...]:
    """Fields of a message that a function takes."""
    fields = _fields(definition, type_name)
    if any(hasattr(definition.store.types[type_name], c) for c in "xyzw"):
        raise _UnfitError  # a constant of that name
    parts = function.takes.parts(fields)
    if not parts or any(fields[c][0] != Nodetype.BASE or fields[c][1][0] == "string" for c in parts):
        raise _UnfitError
    return parts


def _want_stamp(definition: Definition, top: _Wanted) -> None:
    node, header = _fields(definition, definition.type_name).get("header", (None, ""))
    if node != Nodetype.NAME:
        return
    fields = _fields(definition, header)
    if "stamp" not in fields:
        if hasattr(definition.store.types[header], "stamp"):
            raise _UnfitError
        return
    node, stamp = fields["stamp"]
    if node != Nodetype.NAME:
        raise _UnfitError
    parts = _fields(definition, stamp)
    here = top.fields.setdefault("header", _Wanted()).fields.setdefault("stamp", _Wanted())
    for part, name in enumerate(("sec", "nanosec")):
        node, what = parts.get(name, (None, None))
        if node != Nodetype.BASE or CODES.get(what[0], "f8") not in ("i1", "u1", "i2", "u2", "i4", "u4"):
            raise _UnfitError
        here.fields.setdefault(name, _Wanted()).goals.append((_STAMP, part))


def _holds_names(fields: Mapping[str, tuple[Any, Any]]) -> bool:
    node, what = fields.get("name", (None, None))
    if node not in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return False
    (inner, inner_what), _ = what
    return bool(inner == Nodetype.BASE and inner_what[0] == "string")


def _fields(definition: Definition, type_name: str) -> dict[str, tuple[Any, Any]]:
    return {normalize_fieldname(name): description for name, description in definition.store.fielddefs[type_name][1]}


# --- where it stands in one message -------------------------------------------------------------------------


class _Number(NamedTuple):
    """A wanted number: its place from the segment's anchor, and for which path and part it is."""

    at: int
    kind: str
    goal: tuple[int, int]


@dataclass
class _Segment:
    """A stretch of a message in which every place is known from its anchor.

    The anchor is where the segment before ends, brought to a multiple of align; begin is where it stands in the
    message the layout is made from (all places count from behind the encapsulation); bytes `at` to `at + len` have
    to agree with it in the bits of the mask. tail says what follows: a string (_TEXT) whose length stands in the
    last four bytes, or a sequence of so many bytes an element (its count stands there), or nothing (0).
    """

    align: int
    begin: int
    size: int = 0
    fixed: list[tuple[int, bytes]] = field(default_factory=list)
    numbers: list[_Number] = field(default_factory=list)
    tail: int = 0


class _Walk:
    """Walks one message by its definition and notes what a layout needs.

    shape tells messages apart whose wanted fields stand in other places, or under other names; lengths are those of
    strings and unwanted sequences in their order, of which those in `free` are left open; odd are the strings
    that are not ASCII.
    """

    def __init__(self, definition: Definition, little: bool, free: frozenset[int]) -> None:
        self.definition, self.free = definition, free
        self.order = "<" if little else ">"
        self.shape: list[object] = [little]
        self.lengths: list[int] = []
        self.odd: set[int] = set()
        self.whole: dict[int, int] = {}  # path that takes a whole array -> its length
        self.parts = 0
        self.modulus = 8  # the anchor is a multiple of it
        self.segment = _Segment(8, 0)
        self.segments = [self.segment]
        self._fix(-_ENCAPSULATION, b"\xff\xff")
        self.fields_of: dict[str, dict[str, tuple[Any, Any]]] = {}

    def message(self, type_name: str, value: Any, wanted: _Wanted | None) -> None:
        """Walk a message, or one inside."""
        fields = self.fields_of.get(type_name)
        if fields is None:
            fields = self.fields_of[type_name] = _fields(self.definition, type_name)
        named = wanted is not None and any(entry.named for entry in wanted.fields.values())
        if named:
            self.shape.append(tuple(value.name))
        for name, (node, what) in fields.items():
            self.parts += 1
            if self.parts > _MOST_PARTS:
                raise _UnfitError
            here = wanted.fields.get(name) if wanted else None
            content = getattr(value, name)
            if node == Nodetype.BASE:
                if what[0] == "string":
                    self._string(content, exact=False)
                else:
                    self._numbers(what[0], 1, {0: here} if here else {})
            elif node == Nodetype.NAME:
                self.message(what, content, here)
            else:
                self._array(node, what, content, here, value, exact=named and name == "name")

    def _array(self, node: Any, what: Any, content: Any, here: _Wanted | None, parent: Any, exact: bool) -> None:
        (inner, inner_what), length = what
        count = len(content)
        plain = inner == Nodetype.BASE and inner_what[0] != "string"
        elements = _elements(here, parent, count) if here else {}
        if node == Nodetype.ARRAY:
            if not length:
                raise _UnfitError
        elif plain and here is None:
            self._unwanted(np.dtype(CODES[inner_what[0]]).itemsize, count)
            return
        else:
            self._align(4)
            self._fix(self.segment.size, b"\xff" * 4)
            self.segment.size += 4
            self.shape.append(count)
        if plain:
            if here is not None:
                for path in here.every:
                    self.whole[path] = count
                    for i in range(count):
                        elements.setdefault(i, _Wanted()).goals.append((path, i))
            if count:
                self._numbers(inner_what[0], count, elements)
            return
        for i, item in enumerate(content):
            if inner == Nodetype.NAME:
                self.message(inner_what, item, elements.get(i))
            else:
                self._string(item, exact)

    def _align(self, size: int) -> None:
        if self.modulus % size == 0:
            self.segment.size += -self.segment.size % size
            return
        begin = self.segment.begin + self.segment.size
        if not self.segment.size:
            self.segments.pop()  # nothing stands in it
        self._next(begin + -begin % size, size)

    def _next(self, begin: int, align: int) -> None:
        self.segment = _Segment(align, begin)
        self.segments.append(self.segment)
        self.modulus = align

    def _fix(self, at: int, mask: bytes) -> None:
        self.segment.fixed.append((at, mask))

    def _numbers(self, kind: str, count: int, elements: Mapping[int, _Wanted]) -> None:
        code = CODES[kind]
        size = np.dtype(code).itemsize
        self._align(size)
        for i, wanted in elements.items():
            for goal in wanted.goals:
                place = self.segment.size + i * size
                self.segment.numbers.append(_Number(place, code if size == 1 else self.order + code, goal))
        self.segment.size += count * size

    def _string(self, text: str, exact: bool) -> None:
        data = text.encode()
        number = len(self.lengths)
        self.lengths.append(len(data))
        self._align(4)
        self.parts += 1
        if self.parts > _MOST_PARTS:
            raise _UnfitError
        if number in self.free and not exact:
            self._leave_open(_TEXT, len(data) + 1, 1)
            return
        self._fix(self.segment.size, b"\xff" * 4)
        if not text.isascii() and not exact:
            self.odd.add(number)
        letters = b"\xff" if exact or not text.isascii() else b"\x80"
        self._fix(self.segment.size + 4, letters * len(data) + b"\xff")
        self.segment.size += 5 + len(data)

    def _unwanted(self, size: int, count: int) -> None:
        """A sequence of numbers that no path looks into."""
        number = len(self.lengths)
        self.lengths.append(count)
        self._align(4)
        if number in self.free:
            at = self.segment.begin + self.segment.size + 4
            self._leave_open(size, (-at % size) + count * size if count else 0, min(size, 4))
            return
        self._fix(self.segment.size, b"\xff" * 4)
        self.segment.size += 4
        if count:
            self._align(size)
            self.segment.size += count * size

    def _leave_open(self, tail: int, length: int, align: int) -> None:
        self.segment.size += 4
        self.segment.tail = tail
        self._next(self.segment.begin + self.segment.size + length, align)


def _elements(here: _Wanted, parent: Any, count: int) -> dict[int, _Wanted]:
    """Wanted elements of an array by position, those by name among them; what is not there is left out."""
    places: dict[int, list[_Wanted]] = {i: [wanted] for i, wanted in here.elements.items() if i < count}
    for name, wanted in here.named.items():
        found = [i for i, other in enumerate(parent.name) if other == name]
        if len(found) > 1:
            raise RepeatedNamesError
        if found and found[0] < count:
            places.setdefault(found[0], []).append(wanted)
    return {i: _merged(several) for i, several in places.items()}


def _merged(several: Sequence[_Wanted]) -> _Wanted:
    """What all of these want of one value."""
    result = _Wanted()
    for wanted in several:
        result.goals += wanted.goals
        result.every += wanted.every
        _merge_into(result.fields, wanted.fields)
        _merge_into(result.elements, wanted.elements)
        _merge_into(result.named, wanted.named)
    return result


def _merge_into(table: dict[_Key, _Wanted], other: Mapping[_Key, _Wanted]) -> None:
    for key, entry in other.items():
        table[key] = _merged([table[key], entry]) if key in table else entry


# --- the same for many messages -----------------------------------------------------------------------------


class Messages(NamedTuple):
    """Encoded messages data[begin:end]; SLACK bytes around each can be read as well.

    Parameters
    ----------
    data : bytearray
        A buffer with all of them.
    begin : array (messages,) of int
        Where each begins.
    end : array (messages,) of int
        Where each ends.
    """

    data: bytearray
    begin: Integers
    end: Integers

    def take(self, which: Mask | Integers | slice) -> Messages:
        """Some of the messages.

        Parameters
        ----------
        which : array of bool or int, or slice
            Which.

        Returns
        -------
        Messages
            On the same buffer.
        """
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
    parts: list[_Number]


class _Layout:
    """Where the wanted fields stand in messages of one shape, made from one of them."""

    def __init__(self, walk: _Walk, data: bytes, paths: Sequence[FieldPath]) -> None:
        self.free, self.lengths, self.odd = walk.free, walk.lengths, walk.odd
        self.order = walk.order
        self.hits = 0
        parts = dict(walk.whole)
        for number in itertools.chain.from_iterable(segment.numbers for segment in walk.segments):
            path, part = number.goal
            parts[path] = max(parts.get(path, 0), part + 1)
        self.stamped = _STAMP in parts
        self.absent = [i for i in range(len(paths)) if i not in parts]
        self.computed = [(i, p.function, parts[i]) for i, p in enumerate(paths) if p.function and i in parts]
        plain = {i for i, path in enumerate(paths) if not path.function}
        around = bytes(8 - _ENCAPSULATION) + data + bytes(16)  # byte 8 is the first behind the encapsulation
        self.segments = [(segment, _spans(segment, around, plain)) for segment in walk.segments]
        if sum(len(what) for _, spans in self.segments for span in spans for _, what, _ in span.compared) > _MOST_WORDS:
            raise _UnfitError

    def read(self, messages: Messages, values: Values, stamps: Integers, rows: Integers | None = None) -> Mask:
        """Fill in rows of values and stamps (all where rows is None); returns which messages have this layout.

        What is filled in for the others means nothing.
        """
        some = _Some(messages, rows)
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
        some.keep((some.anchor <= some.end) & (some.anchor + 3 >= some.end))  # as the decoder has it
        where = slice(None) if some.rows is None else some.rows
        for path in self.absent:
            values[where, path] = math.nan
        for path, function, count in self.computed:
            values[where, path] = _compute(function, [some.parts[path, part] for part in range(count)], len(some.end))
        stamps[where] = NO_STAMP
        if self.stamped:
            time = some.parts[_STAMP, 0].astype(np.int64) * 1_000_000_000 + some.parts[_STAMP, 1]
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
            some.parts[number.goal] = _taken(content, number.at, number.kind, 1)[:, 0]

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
        self.base = messages.begin + _ENCAPSULATION
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
        self.parts = {goal: part[fit] for goal, part in self.parts.items()}
        return tuple(array[fit] for array in along)


def numbers_at(data: bytearray, kind: str) -> NDArray[Any]:
    """Numbers of this kind that begin at every byte of a buffer.

    Parameters
    ----------
    data : bytearray
        The buffer.
    kind : str
        Type code of numpy with its byte order, `<f8` for example.

    Returns
    -------
    array (bytes - size + 1,)
        A view.
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
    places += [(n.at, n.at + np.dtype(n.kind).itemsize) for n in segment.numbers]
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


def _moves(numbers: Sequence[_Number]) -> list[_Move]:
    moves: list[_Move] = []
    for number in sorted(numbers, key=lambda n: (n.goal, n.at)):
        column, size = number.goal[0], np.dtype(number.kind).itemsize
        last = moves[-1] if moves else None
        if (
            last
            and number.kind == last.kind
            and number.at == last.at + last.number * size
            and column == last.column + last.number
        ):
            moves[-1] = last._replace(number=last.number + 1)
        else:
            moves.append(_Move(number.at, number.kind, 1, column))
    return moves


# --- one topic ----------------------------------------------------------------------------------------------


class FieldReader:
    """Reads the paths of one topic from its messages; learns their layouts as it meets them.

    Parameters
    ----------
    definition : Definition
        Of the messages.
    paths : sequence of FieldPath
        To read; checked against the type.
    """

    def __init__(self, definition: Definition, paths: Sequence[FieldPath]) -> None:
        self.definition, self.paths = definition, paths
        self.layouts: dict[tuple[object, ...], _Layout] = {}
        self.wanted: _Wanted | None = None
        self.alone = 0  # messages that were decoded one by one
        self.patience = _PATIENCE
        try:
            self.wanted = _wanted(definition, paths)
        except _UnfitError:
            pass

    def read(self, messages: Messages, values: Values, stamps: Integers) -> list[Failure]:
        """Fill in a row of values and a stamp for each message.

        Parameters
        ----------
        messages : Messages
            To read.
        values : array (messages, paths)
            Takes the values.
        stamps : array (messages,) of int
            Takes the header stamps, ns; NO_STAMP for none.

        Returns
        -------
        list of Failure
            The messages that cannot be decoded.

        Raises
        ------
        RepeatedNamesError
            What a path gives depends on the order of the messages.
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
        for path in self.paths:
            _look_for_repeated_names(path, value)
        return [path.read(value) for path in self.paths], header_stamp_ns(value) or NO_STAMP

    def _learn(self, data: bytes) -> _Layout | None:
        """Layout that a message has and that is not known yet, or is known too narrowly."""
        if self.wanted is None or self.patience <= 0 or data[:1] != b"\0":
            return None
        self.patience -= 1
        try:
            value = self.definition.decode_strictly(data)
            walk = self._walk(data, value, frozenset())
            shape = tuple(walk.shape)
            known = self.layouts.get(shape)
            if known is not None:
                free = self._free(known, walk)
                if free == known.free:
                    return None
                walk = self._walk(data, value, free)
            elif len(self.layouts) >= _MOST_LAYOUTS:
                return None
            layout = _Layout(walk, data, self.paths)
        except BagError:
            return None
        except _UnfitError:
            self.patience -= _PATIENCE // 10
            return None
        if not self._holds(layout, data):
            self.wanted, self.layouts = None, {}
            return None
        self.layouts[shape] = layout
        self.patience = _PATIENCE
        return layout

    def _walk(self, data: bytes, value: Any, free: frozenset[int]) -> _Walk:
        walk = _Walk(self.definition, data[1] == 1, free)
        walk.message(self.definition.type_name, value, self.wanted)
        return walk

    def _free(self, known: _Layout, walk: _Walk) -> frozenset[int]:
        """What has to be left open so that a layout holds for a second message."""
        pairs = zip(known.lengths, walk.lengths, strict=True)
        free = known.free | {i for i, (one, other) in enumerate(pairs) if one != other}
        return frozenset(free if free != known.free else free | known.odd | walk.odd)

    def _holds(self, layout: _Layout, data: bytes) -> bool:
        """Whether a layout gives for its own message what decoding gives."""
        values, stamps = np.empty((1, len(self.paths))), np.empty(1, dtype=np.int64)
        buffer = bytearray(SLACK) + data + bytearray(SLACK)
        alone = Messages(buffer, np.array([SLACK]), np.array([SLACK + len(data)]))
        if not layout.read(alone, values, stamps).all():
            return False
        decoded, stamp = self._decode(data)
        return values.tobytes() == np.array(decoded, dtype=np.float64).tobytes() and int(stamps[0]) == stamp


def _look_for_repeated_names(path: FieldPath, message: Any) -> None:
    value, parent = message, message
    for kind, key in path.steps:
        if kind == "attribute":
            parent, value = value, getattr(value, str(key))
        elif kind == "index":
            if int(key) >= len(value):
                return
            value = value[int(key)]
        else:
            names = list(parent.name)
            if names.count(str(key)) > 1:
                raise RepeatedNamesError
            if str(key) not in names or names.index(str(key)) >= len(value):
                return
            value = value[names.index(str(key))]
