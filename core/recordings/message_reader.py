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
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from uncertain_lti.recordings.stamps import header_stamp_ns
from uncertain_lti.signals.field_path import FieldPath
from uncertain_lti.signals.field_types import FieldType, TypeFields
from uncertain_lti.signals.functions import FieldFunction

_CODES = {
    "byte": "B", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I",
    "int64": "q", "uint64": "Q", "float32": "f", "float64": "d", "bool": "?",
}  # fmt: skip
_CDR = b"\x00\x01"  # plain, little-endian; whatever else comes is left to the middleware
_ENCAPSULATION = 4
_MOST_LAYOUTS = 8
_MOST_PARTS = 20_000  # of a message that a layout is made from
_PADDING = 3  # bytes: some senders fill up to a multiple of four
_NEAR = 128  # bytes between two places that are compared in one go
_LAYOUT = 100  # what making one costs; each message that fits one pays 1
_BUDGET = 50 * _LAYOUT

_SHAPED_ODDLY = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)


class UnreadableError(Exception):
    """The middleware cannot decode a message, or a field is filled so that it is no number."""


class _UnfitError(Exception):
    """This message, or this type, has to be decoded."""


class MessageReader:
    """Stamp and values of the messages of one topic.

    Parameters
    ----------
    type_name : str
        As package/msg/Name.
    paths : sequence of FieldPath
        Checked against the type.
    type_fields : callable
        Type name -> {field name: FieldType}.
    decode : callable
        Serialised message -> message; may raise anything where that is not one.

    Attributes
    ----------
    decoded : int
        Messages that fitted no layout.
    """

    def __init__(
        self, type_name: str, paths: Sequence[FieldPath], type_fields: TypeFields, decode: Callable[[bytes], Any]
    ) -> None:
        self.type_name = type_name
        self.decoded = 0
        self._paths = tuple(paths)
        self._fields, self._decode = type_fields, decode
        self._layouts: list[_Layout] = []
        self._budget = _BUDGET

    def read(self, data: bytes) -> tuple[int | None, Sequence[float]]:
        """Header stamp and one value per path.

        Parameters
        ----------
        data : bytes
            Serialised message.

        Returns
        -------
        int or None
            Stamp, ns; None without a header, or where it is zero.
        sequence of float
            Values.

        Raises
        ------
        UnreadableError
            The bytes are no message of the type, or a wanted field cannot be read; says why.
        """
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
        if left := self._left(data):
            raise UnreadableError(
                f"is {left} bytes longer than a {self.type_name}; its publisher may have another version of that type"
            )
        try:
            stamp, values = header_stamp_ns(message), [path.read(message) for path in self._paths]
        except _SHAPED_ODDLY as error:
            raise UnreadableError(f"a field cannot be read: {error}") from None
        if self._budget >= _LAYOUT:
            self._budget -= _LAYOUT
            self._learn(data, stamp, values)
        return stamp, values

    def _left(self, data: bytes) -> int:
        """Bytes behind a message beyond those that senders leave there; 0 where that is not known.

        The middleware passes over them; a reader of recordings does not.
        """
        if data[:2] != _CDR:
            return 0
        walk = _Walk(data, self._fields)
        try:
            walk.message(self.type_name, [])
        except (_UnfitError, *_SHAPED_ODDLY, struct.error):
            return 0
        left = len(data) - walk.at
        return left if left > _PADDING + walk.reserved else 0

    def _learn(self, data: bytes, stamp: int | None, values: list[float]) -> None:
        try:
            layout = _Layout(data, self.type_name, self._paths, self._fields)
            found = layout.read(data)
        except (_UnfitError, *_SHAPED_ODDLY, struct.error):
            return
        if found is not None and found[0] == stamp and _same(found[1], values):
            self._layouts.insert(0, layout)
            del self._layouts[_MOST_LAYOUTS:]


def _same(some: Sequence[float], others: Sequence[float]) -> bool:
    pack = struct.Struct(f"<{len(others)}d").pack
    return len(some) == len(others) and pack(*some) == pack(*others)


class _Parts:
    """x, y, z, w of a quaternion, or x, y, z of a vector."""

    def __init__(self, names: Sequence[str], values: Sequence[float]) -> None:
        self.__dict__.update(zip(names, values, strict=True))


def _compute(function: FieldFunction, names: Sequence[str] | None, parts: Sequence[float]) -> float:
    return float(function.of(parts if names is None else _Parts(names, parts)))


class _Want:
    """One path on its way down into the message, and the places it ends in."""

    def __init__(self, path: FieldPath) -> None:
        self.path = path
        self.places: list[tuple[int, str]] = []  # (offset, code of struct)
        self.names: list[str] | None = None  # of the parts of a computed number


class _Layout:
    """Places of the wanted numbers in messages that look like this one; raises _UnfitError where there are none."""

    def __init__(self, data: bytes, type_name: str, paths: Sequence[FieldPath], fields: TypeFields) -> None:
        if data[:2] != _CDR:
            raise _UnfitError
        self._size = len(data)
        wants = [_Want(path) for path in paths]
        stamp = [_Want(FieldPath(f"header.stamp.{part}")) for part in ("sec", "nanosec")]
        self._stamped = _has_stamp(type_name, fields)
        every = [*(stamp if self._stamped else ()), *wants]
        walk = _Walk(data, fields)
        walk.message(type_name, [(want, want.path.steps) for want in every])
        if walk.odd:
            raise _UnfitError
        self._shape = _shape(data, [(0, 2), *walk.shape])
        places = [place for want in every for place in want.places]
        order = sorted(set(places))
        self._unpack = _struct(order).unpack_from
        where = {place: i for i, place in enumerate(order)}
        self._picks = [where[place] for place in places]
        self._plain = self._picks == list(range(len(every))) and all(w.path.function is None for w in every)
        self._plain = self._plain and all(code in "fd" for want in wants for _, code in want.places)
        self._first = 2 if self._stamped else 0
        self._computed: list[tuple[FieldFunction | None, list[str] | None, int]] = [
            (want.path.function, want.names, len(want.places)) for want in wants
        ]

    def read(self, data: bytes) -> tuple[int | None, Sequence[float]] | None:
        """Stamp and values; None where the message looks otherwise."""
        if len(data) != self._size:
            return None
        for start, stop, mask, wanted in self._shape:
            if int.from_bytes(data[start:stop], "little") & mask != wanted:
                return None
        numbers = self._unpack(data)
        stamp = None
        first = self._first
        if self._plain:
            if first:
                stamp = numbers[0] * 1_000_000_000 + numbers[1] or None
            return stamp, numbers[first:]
        picked = [numbers[i] for i in self._picks]
        if first:
            stamp = picked[0] * 1_000_000_000 + picked[1] or None
        values = []
        for function, names, count in self._computed:
            if function is None:
                values.append(float(picked[first]) if count else math.nan)
            else:
                values.append(_compute(function, names, picked[first : first + count]))
            first += count
        return stamp, values


class _Walk:
    """One pass over a message: notes places of what is wanted, and the bytes that say where everything stands."""

    def __init__(self, data: bytes, fields: TypeFields) -> None:
        self._data, self._fields = data, fields
        self.at = _ENCAPSULATION
        self.odd = False  # a text has not even a closing zero
        self.reserved = 0  # bytes that `rclpy.serialization` leaves behind a message: 4 for each empty array of these
        self._parts = 0
        self.shape: list[tuple[int, int]] = []

    def message(self, type_name: str, wants: list[tuple[_Want, Sequence[tuple[str, str | int]]]]) -> None:
        fields = self._fields(type_name)
        if not fields:
            self.at += 1  # an empty message is one byte long
        names: list[tuple[bytes, int]] | None = None
        looked_up: list[tuple[_Want, str, int, int, str]] = []  # want, name, count, start of the array, code
        for name, kind in fields.items():
            here = [(want, steps[1:]) for want, steps in wants if steps[0] == ("attribute", name)]
            if kind.array is None:
                self._value(kind, here)
                continue
            count = kind.array or self._length()
            if kind.kind == "string":
                if kind.type_name.startswith("wstring") or here:
                    raise _UnfitError
                names_here = [self._text() for _ in range(self._counted(count))]
                names = names_here if name == "name" else names
            elif kind.kind == "message":
                if any(steps[0][0] != "index" for _, steps in here):
                    raise _UnfitError
                for i in range(self._counted(count)):
                    self._value(kind, [(want, steps[1:]) for want, steps in here if steps[0][1] == i])
            else:
                code = _CODES.get(kind.type_name)
                if code is None:
                    raise _UnfitError
                size = struct.calcsize(f"<{code}")
                start = self._align(size) if count else self.at
                self.reserved += 4 * (size == 8 and not count)
                self.at = start + count * size
                if self.at > len(self._data):
                    raise _UnfitError
                for want, steps in here:
                    if not steps:  # norm of an array
                        want.places = [(start + i * size, code) for i in range(self._counted(count))]
                    elif steps[0][0] == "name":
                        looked_up.append((want, str(steps[0][1]), count, start, code))
                    elif int(steps[0][1]) < count:
                        want.places = [(start + int(steps[0][1]) * size, code)]
        if looked_up:
            self._look_up(names, looked_up)

    def _look_up(
        self, names: list[tuple[bytes, int]] | None, looked_up: list[tuple[_Want, str, int, int, str]]
    ) -> None:
        texts = [text for text, _ in names or ()]
        if names is None or len(set(texts)) < len(texts):
            raise _UnfitError  # which of two equal names counts depends on the messages before
        self.shape += [(start, len(text) + 1) for text, start in names]
        for want, name, count, start, code in looked_up:
            index = texts.index(name.encode()) if name.encode() in texts else count
            if index < count:
                want.places = [(start + index * struct.calcsize(f"<{code}"), code)]

    def _value(self, kind: FieldType, here: list[tuple[_Want, Sequence[tuple[str, str | int]]]]) -> None:
        if kind.kind == "string":
            if here or kind.type_name.startswith("wstring"):
                raise _UnfitError
            self._text()
        elif kind.kind == "message":
            inner = self._fields(kind.type_name)
            deeper = []
            for want, steps in here:
                if steps:
                    deeper.append((want, steps))
                    continue
                if want.path.function is None:
                    raise _UnfitError
                want.names = list(want.path.function.takes.parts(inner))
                if not want.names:
                    raise _UnfitError
                deeper += [(_Part(want, i), (("attribute", c),)) for i, c in enumerate(want.names)]
                want.places = [(-1, "")] * len(want.names)
            self.message(kind.type_name, deeper)
        else:
            code = _CODES.get(kind.type_name)
            if code is None or (code == "?" and here):  # the middleware refuses a truth value of 2
                raise _UnfitError
            size = struct.calcsize(f"<{code}")
            start = self._align(size)
            self.at = start + size
            for want, _ in here:
                want.places = [(start, code)]

    def _counted(self, count: int) -> int:
        self._parts += count
        if self._parts > _MOST_PARTS:
            raise _UnfitError
        return count

    def _align(self, size: int) -> int:
        self.at = -(-(self.at - _ENCAPSULATION) // size) * size + _ENCAPSULATION
        return self.at

    def _length(self) -> int:
        start = self._align(4)
        self.shape.append((start, 4))
        self.at = start + 4
        (length,) = struct.unpack_from("<I", self._data, start)
        if length > len(self._data):
            raise _UnfitError
        return int(length)

    def _text(self) -> tuple[bytes, int]:
        """Text without its end, and where it stands."""
        length = self._length()
        start = self.at
        self.at += length
        if self.at > len(self._data):
            raise _UnfitError
        self.odd |= not length
        return self._data[start : max(start, self.at - 1)], start


class _Part(_Want):
    """One part of a computed number."""

    def __init__(self, whole: _Want, index: int) -> None:
        self._whole, self._index = whole, index

    @property
    def places(self) -> list[tuple[int, str]]:
        return [self._whole.places[self._index]]

    @places.setter
    def places(self, found: list[tuple[int, str]]) -> None:
        (self._whole.places[self._index],) = found


def _has_stamp(type_name: str, fields: Callable[[str], Mapping[str, FieldType]]) -> bool:
    header = fields(type_name).get("header")
    if header is None or header.kind != "message" or header.array is not None:
        return False
    stamp = fields(header.type_name).get("stamp")
    return stamp is not None and stamp.kind == "message" and {"sec", "nanosec"} <= set(fields(stamp.type_name))


def _struct(places: Sequence[tuple[int, str]]) -> struct.Struct:
    """Unpacks numbers at these places, in rising order, from the start of a message."""
    text, at = "<", 0
    for start, code in places:
        text += f"{start - at}x" if start > at else ""
        text += code
        at = start + struct.calcsize(f"<{code}")
    return struct.Struct(text)


def _shape(data: bytes, places: list[tuple[int, int]]) -> list[tuple[int, int, int, int]]:
    """(start, stop, mask, value) of the stretches that hold these places; padding between them is not compared."""
    stretches: list[tuple[int, int, list[tuple[int, int]]]] = []
    for start, size in sorted(places):
        stop = start + size
        if stretches and start - stretches[-1][1] < _NEAR:
            begin, _, parts = stretches[-1]
            parts.append((start, stop))
            stretches[-1] = begin, stop, parts
        else:
            stretches.append((start, stop, [(start, stop)]))
    found = []
    for begin, end, parts in stretches:
        mask = bytearray(end - begin)
        for start, stop in parts:
            mask[start - begin : stop - begin] = b"\xff" * (stop - start)
        number = int.from_bytes(mask, "little")
        found.append((begin, end, number, int.from_bytes(data[begin:end], "little") & number))
    return found
