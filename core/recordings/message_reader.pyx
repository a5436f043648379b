# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

# cython: boundscheck=False, wraparound=False, cdivision=True

"""Plan, MessageReader: the stamp and the wanted numbers of serialised messages, without making message objects.

CDR aligns a number to its size, counted from behind the encapsulation, and puts a length of four bytes before each
string and sequence. So where a number stands depends on what is before it, and a message is walked from its beginning
as its type says: live one by one, of a recording many in one call.
"""

import math
import struct
import sys
from dataclasses import replace

import numpy as np

from libc.math cimport NAN
from libc.stdint cimport int8_t, int16_t, int32_t, int64_t, uint8_t, uint16_t, uint32_t, uint64_t
from libc.string cimport memchr, memcmp, memcpy

from uncertain_lti.base.errors import SignalError
from uncertain_lti.signals.field_path import FieldType, names_in

CODES = {
    "byte": "B", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I",
    "int64": "q", "uint64": "Q", "float32": "f", "float64": "d", "bool": "?",
}
ENCAPSULATIONS = b"\0\0", b"\0\1", b"\0\3"
cdef enum:
    ENCAPSULATION = 4  # bytes before the first field
    MOST = 1 << 30  # elements; no message has as many
    PADDING = 3  # bytes that may stand behind any message: some senders fill up to a multiple of four
    RESERVED = 4  # bytes that rclpy leaves behind a message for an empty sequence of 8-byte numbers, and others behind it
cdef enum:  # what a node is
    NUMBER, TRUTH, TEXT, MESSAGE
cdef enum:  # what a message is; from LONGER on by how many bytes
    WHOLE, CUT, UNTRUE, OTHER, STRANGE, LONGER
NOT_PLAIN = OTHER
NO_STAMP = -1
_SHAPED_ODDLY = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)


def is_timestamped(type_name, fields):
    """Whether messages of a type, with these fields, have a stamp in us of their own, as all of PX4."""
    kind = fields.get("timestamp") if type_name.startswith("px4_msgs") else None
    return kind is not None and kind.type_name == "uint64" and kind.array is None


def header_stamp_ns(message):
    """Header stamp, or PX4's own, of a message (rosbags or rclpy) in ns; None where there is none, or it is zero."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    if stamp is not None:
        return stamp.sec * 1_000_000_000 + stamp.nanosec or None
    if getattr(message, "__msgtype__", type(message).__module__).startswith("px4_msgs"):
        return 1000 * int(getattr(message, "timestamp", 0)) or None
    return None


cdef union _Number:
    double d
    float f
    int16_t h
    uint16_t H
    int32_t i
    uint32_t I
    int64_t q
    uint64_t Q


class UnfitError(Exception):
    """A type that only the decoder can read."""


class UnreadableError(Exception):
    """The middleware cannot decode a message, or a field is filled so that it is no number."""


cdef class _Node:
    """A field of a type: what it is, and what is wanted of it.

    `array`: -1 for one value, 0 for a sequence, n for n; `put`: fields it holds; `fields`: of a message; `element`: of
    an array of messages that nobody wants; `slot`: where a single number goes; `indexed, named`: wanted elements by
    position or by name, each with its slot or node; `every`: where the place of a whole array goes; `name_at`: which
    field of a message holds the names; `ahead`: it is behind what it names; `asks`: for such outside.
    """

    cdef int kind, code
    cdef Py_ssize_t size, array, put, slot, every, name_at
    cdef bint ahead, asks
    cdef list fields, indexed, named
    cdef _Node element

    def __cinit__(self):
        self.array = self.slot = self.every = self.name_at = -1
        self.put = 1
        self.fields, self.indexed, self.named = [], [], []


def _together(_Node one, _Node other):
    """Two stretches of numbers of one size that nobody wants, one behind the other, as one; None if they are not."""
    cdef _Node both = _Node()
    both.kind, both.array, both.put = NUMBER, 0, 0
    for node in (one, other):
        found = _numbers_alone(node)
        if found is None or both.size not in (0, found[0]) or both.array + found[1] > MOST:
            return None
        both.size, both.array, both.put = found[0], both.array + found[1], both.put + found[2]
    return both


def _numbers_alone(_Node node):
    """Size, number and fields of what is nothing but numbers that nobody wants; else None."""
    if not node.array or node.slot >= 0 or node.indexed or node.named or node.every >= 0:
        return None
    count = node.array if node.array > 0 else 1
    if node.kind == NUMBER:
        return node.size, count, node.put
    if node.kind != MESSAGE:
        return None
    inside = (node.element if node.array > 0 else node).fields
    found = _numbers_alone(inside[0]) if len(inside) == 1 else None
    return found and (found[0], found[1] * count, found[2] * count)


cdef class Plan:
    """How the wanted numbers of one type are read.

    `type_name`: as package/msg/Name; `paths`: checked against the type; `type_fields`: type name -> {field name:
    FieldType}. Raises UnfitError if messages of the type cannot be walked. `able`: whether it can give all numbers;
    `named`: all are looked up by name, so that a message in which no such name stands is of another publisher.
    """

    cdef _Node top
    cdef object fields_of
    cdef dict unwanted
    cdef list codes, parts, every, functions
    cdef readonly bint able
    cdef bint named, met
    cdef readonly Py_ssize_t seconds, nanoseconds  # slots of a stamp, and ns of what is in the first
    cdef int64_t unit
    cdef const uint8_t* data
    cdef Py_ssize_t at, size, reserved
    cdef bint big, untrue
    cdef double* slots
    cdef int64_t* places
    cdef double[::1] row  # slots and places of a message alone
    cdef int64_t[::1] place
    cdef Py_ssize_t[::1] slot_of  # of each path; -1 where a function takes several

    def __init__(self, type_name, paths, type_fields):
        self.fields_of, self.unwanted, self.able = type_fields, {}, True
        self.codes, self.every = [], []
        self.parts = [{} for _ in range(len(paths) + 1)]  # of each path, and of the stamp: part -> slot
        self.functions = [path.function for path in paths]
        wants = []
        for number, path in enumerate(paths):
            wants.append((path.steps, number, 0))
        self.top = self.node(FieldType("message", type_name), wants + self.stamp(type_name, len(paths)))
        stamp = self.parts[len(paths)]
        self.seconds, self.nanoseconds = stamp.get(0, -1), stamp.get(1, -1)
        self.unit = 1_000_000_000 if self.nanoseconds >= 0 else 1000
        for parts, function in zip(self.parts, self.functions):
            if function is not None and any(self.codes[slot] in "qQ" for slot in parts.values()):
                self.able = False  # a function of whole numbers takes them without rounding
        found = [parts[0] if path.function is None else -1 for path, parts in zip(paths, self.parts)]
        self.slot_of = np.array(found, dtype=np.intp)
        self.row, self.place = np.empty(len(self.codes)), np.empty(2 * len(self.every), np.int64)
        by_name = [any(kind == "name" for kind, _ in path.steps) for path in paths]
        self.named = self.able and bool(by_name) and all(by_name)

    def stamp(self, type_name, number):
        """What is wanted for the header stamp."""
        if is_timestamped(type_name, self.fields_of(type_name)):
            return [((("attribute", "timestamp"),), number, 0)]
        steps, kind = [], FieldType("message", type_name)
        for name in ("header", "stamp"):
            kind = self.fields_of(kind.type_name).get(name)
            if kind is None or kind.kind != "message" or kind.array is not None:
                self.able = self.able and (kind is None or name == "header")
                return []
            steps.append(("attribute", name))
        inner = self.fields_of(kind.type_name)
        for name in ("sec", "nanosec"):
            if name not in inner or inner[name].array is not None or CODES.get(inner[name].type_name, "d") not in "bBhHiI":
                self.able = False
                return []
        return [((*steps, ("attribute", name)), number, part) for part, name in enumerate(("sec", "nanosec"))]

    def node(self, kind, wants):
        """The node of a field; `wants`: steps from here on, path, and part of it."""
        cdef _Node node
        key = kind.type_name, kind.array
        if not wants and key in self.unwanted:
            return self.unwanted[key]
        node = _Node()
        node.array = -1 if kind.array is None else min(kind.array, MOST)
        code = CODES.get(kind.type_name, "") if kind.kind not in ("string", "message") else ""
        if kind.kind == "message":
            node.kind = MESSAGE
        elif kind.kind == "string" and not kind.type_name.startswith("wstring"):
            node.kind = TEXT
        elif code:
            node.kind, node.code, node.size = TRUTH if code == "?" else NUMBER, ord(code), struct.calcsize(code)
        else:
            raise UnfitError
        if kind.array is not None:
            self.elements(node, replace(kind, array=None), wants)
        elif kind.kind == "message":
            self.inside(node, self.fields_of(kind.type_name), wants)
        elif wants:
            node.slot = self.slot(code, wants)
        if not wants:
            self.unwanted[key] = node
        return node

    def slot(self, code, wants):
        self.codes.append(code)
        for _, number, part in wants:
            self.parts[number][part] = len(self.codes) - 1
        return len(self.codes) - 1

    def elements(self, _Node node, kind, wants):
        """What is wanted of the elements of an array."""
        if node.kind == MESSAGE:
            node.element = self.node(kind, [])
        groups = {}
        for steps, number, part in wants:
            if steps:
                groups.setdefault(steps[0], []).append((steps[1:], number, part))
            else:
                if node.every < 0:
                    node.every = len(self.every)
                    self.every.append((chr(node.code), []))
                self.every[node.every][1].append(number)
        for (how, key), group in groups.items():
            what = self.node(kind, group) if node.kind == MESSAGE else self.slot(chr(node.code), group)
            if how == "index":
                node.indexed.append((key, what))
            else:
                if "\ufffd" in key:  # in its place there may be anything that is no text
                    self.able = False
                node.named.append((key.encode(errors="surrogatepass"), what))
            node.asks |= how == "name" or (node.kind == MESSAGE and (<_Node>what).asks)

    def inside(self, _Node node, fields, wants):
        """What is wanted of the fields of a message."""
        cdef _Node child
        groups = {}
        for steps, number, part in wants:
            if steps:
                groups.setdefault(steps[0][1], []).append((steps[1:], number, part))
            else:
                for position, name in enumerate(self.functions[number].takes.parts(fields)):
                    groups.setdefault(name, []).append(((), number, position))
        named, own = -1, names_in(fields)  # the first field in which something is looked up by name
        for name, kind in fields.items():
            child = self.node(kind, groups.get(name, []))
            if name == own:
                node.name_at = len(node.fields)
            elif child.asks and named < 0:
                named = len(node.fields)
            together = _together(node.fields[len(node.fields) - 1], child) if node.fields else None
            if together is not None:
                node.fields.pop()
            node.fields.append(child if together is None else together)
        if named < 0:
            node.name_at = -1
        node.ahead = node.name_at > named
        node.asks = named >= 0 and node.name_at < 0

    # --- one message ----------------------------------------------------------------------------------------

    cdef Py_ssize_t walk(self, const uint8_t* data, Py_ssize_t size) except -1:
        """Fill slots and places; returns what the message is."""
        if size < ENCAPSULATION or data[0] or data[1] not in (0, 1, 3):
            return OTHER
        self.big = data[1] == 0
        self.data, self.size, self.at = data + ENCAPSULATION, size - ENCAPSULATION, 0
        self.reserved, self.untrue, self.met = 0, False, not self.named
        if not self.message(self.top, -1, 0):
            return CUT
        if self.size - self.at > PADDING + self.reserved:
            return LONGER + self.size - self.at
        return UNTRUE if self.untrue else WHOLE if self.met else STRANGE

    cdef bint message(self, _Node node, Py_ssize_t names, Py_ssize_t number) except? False:
        # names, number: where the names of the message around it begin, and how many
        cdef Py_ssize_t at = self.at, reserved = self.reserved, position
        if not node.fields:
            self.at += 1  # an empty message is one byte long
            return self.at <= self.size
        if node.ahead:
            for position in range(node.name_at):
                if not self.field(<_Node>node.fields[position], -1, 0):
                    return False
            number = self.count(<_Node>node.fields[node.name_at])
            names, self.at, self.reserved = self.at, at, reserved
        for position in range(len(node.fields)):
            if position == node.name_at and not node.ahead:
                at = self.at
                number = self.count(<_Node>node.fields[position])
                names, self.at = self.at, at
            if not self.field(<_Node>node.fields[position], names, number):
                return False
        return True

    cdef Py_ssize_t count(self, _Node node) noexcept:
        """Elements of a field; -1 if the message ends before."""
        if node.array == -1:
            return 1
        return node.array if node.array else self.length()

    cdef Py_ssize_t length(self) noexcept:
        cdef Py_ssize_t begin = (self.at + 3) & ~3
        cdef uint32_t found
        if begin + 4 > self.size:
            return -1
        memcpy(&found, self.data + begin, 4)
        if self.big:
            found = found >> 24 | (found >> 8 & 0xFF00) | (found & 0xFF00) << 8 | found << 24
        self.at = begin + 4
        return -1 if found > self.size else found

    cdef bint field(self, _Node node, Py_ssize_t names, Py_ssize_t number) except? False:
        cdef Py_ssize_t count = self.count(node), i, length
        if count < 0:
            return False
        if node.kind == MESSAGE:
            return self.message(node, names, number) if node.array < 0 else self.messages(node, count, names, number)
        if node.kind == TEXT:
            for i in range(count):
                length = self.length()
                if length < 0 or self.at + length > self.size:
                    return False
                self.at += length
            return True
        return self.numbers(node, count, names, number)

    cdef bint numbers(self, _Node node, Py_ssize_t count, Py_ssize_t names, Py_ssize_t number) except? False:
        cdef Py_ssize_t start = self.at, i
        if count > self.size:
            return False
        if count:
            start = (start + node.size - 1) & ~(node.size - 1)
            self.at = start + count * node.size
            if self.at > self.size:
                return False
        if node.size == 8 and (not count or self.reserved):
            self.reserved += RESERVED * node.put
        if node.kind == TRUTH:
            for i in range(start, self.at if count else start):
                self.untrue |= self.data[i] > 1
        if node.slot >= 0:
            self.slots[node.slot] = self.number(node.code, start)
        elif node.indexed or node.named or node.every >= 0:
            for index, slot in node.indexed:
                if index < count:
                    self.slots[<Py_ssize_t>slot] = self.number(node.code, start + <Py_ssize_t>index * node.size)
            for name, slot in node.named:
                i = self.find(name, names, number)
                if 0 <= i < count:
                    self.slots[<Py_ssize_t>slot] = self.number(node.code, start + i * node.size)
            if node.every >= 0:
                self.places[2 * node.every], self.places[2 * node.every + 1] = start, count
        return True

    cdef bint messages(self, _Node node, Py_ssize_t count, Py_ssize_t names, Py_ssize_t number) except? False:
        cdef Py_ssize_t i, at, reserved
        cdef bint met
        wanted = node.indexed + [(self.find(name, names, number), what) for name, what in node.named]
        for i in range(count):
            at, reserved, met = self.at, self.reserved, False
            for index, what in wanted:
                if index == i:
                    self.at, self.reserved, met = at, reserved, True
                    if not self.message(<_Node>what, names, number):
                        return False
            if not met and not self.message(node.element, -1, 0):
                return False
        return True

    cdef Py_ssize_t find(self, bytes name, Py_ssize_t at, Py_ssize_t number) noexcept:
        """Position of a name among those that stand here, each up to its first zero, as the middleware reads them."""
        cdef Py_ssize_t back = self.at, i, length, found = -1
        cdef const void* zero
        self.at = at
        for i in range(number if at >= 0 else 0):
            length = self.length()
            if length < 0 or self.at + length > self.size:
                break
            zero = memchr(self.data + self.at, 0, length)
            if (zero - <const void*>(self.data + self.at) if zero != NULL else length) == len(name):
                if not memcmp(self.data + self.at, <const char*>name, len(name)):
                    found, self.met = i, True
                    break
            self.at += length
        self.at = back
        return found

    cdef double number(self, int code, Py_ssize_t at) noexcept:
        cdef uint8_t turned[8]
        cdef const uint8_t* data = self.data + at
        cdef _Number value
        cdef int i, size
        if self.big:
            size = 8 if code in (c"d", c"q", c"Q") else 4 if code in (c"f", c"i", c"I") else 2
            for i in range(size if code not in (c"b", c"B", c"?") else 0):
                turned[i] = data[size - 1 - i]
            data = data if code in (c"b", c"B", c"?") else turned
        if code == c"d":
            memcpy(&value, data, 8)
            return value.d
        if code == c"f":
            memcpy(&value, data, 4)
            return value.f
        if code == c"i":
            memcpy(&value, data, 4)
            return value.i
        if code == c"I":
            memcpy(&value, data, 4)
            return value.I
        if code == c"q":
            memcpy(&value, data, 8)
            return <double>value.q
        if code == c"Q":
            memcpy(&value, data, 8)
            return <double>value.Q
        if code == c"h":
            memcpy(&value, data, 2)
            return value.h
        if code == c"H":
            memcpy(&value, data, 2)
            return value.H
        if code == c"b":
            return <int8_t>data[0]
        return data[0] != 0 if code == c"?" else data[0]

    # --- what is made of the slots --------------------------------------------------------------------------

    def wrong(self, bytes data):
        """Why a message cannot be decoded, in words; empty if it can."""
        return self.in_words(self.alone(data))

    def in_words(self, what):
        """What a message is."""
        if what > LONGER:
            return f"it is {what - LONGER} bytes longer than its definition"
        return ("", "it is cut", "it holds a truth value that is neither 0 nor 1", "it is no plain CDR", "")[what]

    cdef Py_ssize_t alone(self, bytes data) except -1:
        self.row[:] = NAN
        self.place[:] = -1
        self.slots = &self.row[0] if self.row.shape[0] else NULL
        self.places = &self.place[0] if self.place.shape[0] else NULL
        return self.walk(<const uint8_t*><const char*>data, len(data))

    cpdef tuple read(self, bytes data):
        """What a message is, and if it is whole, its stamp (ns or None) and values."""
        cdef Py_ssize_t what = self.alone(data)
        cdef Py_ssize_t slot, number
        if what not in (WHOLE, STRANGE) or not self.able:
            return what, None
        values = []
        for number in range(self.slot_of.shape[0]):
            slot = self.slot_of[number]
            if slot >= 0:
                values.append(self.slots[slot])
            else:
                values.append(self.computed(number, self.functions[number], self.row, np.asarray(self.place), data))
        stamp = None
        if self.seconds >= 0:
            stamp = self.stamp_of(self.slots) or None
        return what, (stamp, values)

    cdef int64_t stamp_of(self, const double* slots) noexcept:
        cdef int64_t rest = <int64_t>slots[self.nanoseconds] if self.nanoseconds >= 0 else 0
        return <int64_t>slots[self.seconds] * self.unit + rest

    def read_all(self, buffer, int64_t[::1] begin, int64_t[::1] end, double[:, :] values, int64_t[::1] stamps):
        """Messages buffer[begin:end]; fills in a row of values and a stamp (`NO_STAMP` if none) of each.

        Returns (messages,): what each message is; the rows of those that are not whole mean nothing.
        """
        cdef const uint8_t[::1] data = buffer
        cdef Py_ssize_t number = len(begin), i, width = len(self.codes), spans = 2 * len(self.every)
        rows, places = np.full((number, width), math.nan), np.full((number, spans), -1, np.int64)
        state = np.zeros(number, np.int64)
        cdef double[:, ::1] row = rows
        cdef int64_t[:, ::1] place = places
        cdef int64_t[::1] states = state
        for i in range(number):
            if width:
                self.slots = &row[i, 0]
            if spans:
                self.places = &place[i, 0]
            states[i] = self.walk(&data[begin[i]], end[i] - begin[i]) if end[i] > begin[i] else OTHER
            if self.seconds >= 0:
                stamps[i] = self.stamp_of(&row[i, 0]) or -1
            else:
                stamps[i] = -1
        target = np.asarray(values)
        for path, function in enumerate(self.functions):
            if function is None:
                target[:, path] = rows[:, self.parts[path][0]]
            else:
                good = np.flatnonzero(state == 0) if state.any() else slice(None)
                target[good, path] = self.all_computed(path, function, good, rows, places, buffer, begin)
        return state

    def computed(self, number, function, const double[::1] row, place, data):
        """What a function gives for one message."""
        parts = self.parts[number]
        for index, (code, numbers) in enumerate(self.every):
            if number in numbers:
                start, count = place[2 * index : 2 * index + 2].tolist()
                order = "<" if data[1] else ">"
                found = () if start < 0 else struct.unpack_from(f"{order}{count}{code}", data, ENCAPSULATION + start)
                return math.nan if start < 0 else function.of_array(*map(float, found))
        values = [row[<Py_ssize_t>parts[part]] for part in range(len(parts))]
        if all(map(math.isnan, values)):
            return math.nan
        codes = [self.codes[parts[part]] for part in range(len(parts))]
        return function.of_parts(*[v if code in "fd" else int(v) for v, code in zip(values, codes)])

    def all_computed(self, number, function, good, rows, places, buffer, begin):
        """The same for many messages: where it is a function of floats, its terms of all at once."""
        slots = [self.parts[number][part] for part in range(len(self.parts[number]))]
        if slots and all(self.codes[slot] in "fd" for slot in slots):
            with np.errstate(all="ignore"):
                arguments, size = function.terms(*(rows[good, slot] for slot in slots))
            there = np.broadcast_to(np.asarray(size > 0.0), len(arguments[0])).copy()
            result = np.full(len(there), math.nan)
            result[there] = list(map(function.number, *(argument[there].tolist() for argument in arguments)))
            return result
        data = memoryview(buffer)
        good = np.arange(len(rows))[good]
        return [self.computed(number, function, rows[i], places[i], data[begin[i] :]) for i in good.tolist()]


cdef class MessageReader:
    """Stamp and values of the messages of one topic.

    `type_name`: as package/msg/Name; `paths`: checked against the type; `type_fields`: type name -> {field name:
    FieldType}; `decode`: serialised message -> message; may raise anything where that is not one; `decoded`: messages
    that it was needed for; `largest`: bytes of a message that is read; `strange`: the last one read names nothing of what
    is wanted, so another publisher sent it, and it counts no more than one of another topic.
    """

    cdef readonly object type_name, decode, decoded
    cdef readonly bint strange
    cdef object paths
    cdef Plan plan
    cdef Py_ssize_t largest

    def __init__(self, type_name, paths, type_fields, decode, largest=sys.maxsize):
        self.type_name, self.paths, self.decode, self.decoded = type_name, tuple(paths), decode, 0
        self.largest = largest
        self.plan = None
        try:
            self.plan = Plan(type_name, self.paths, type_fields)
        except (UnfitError, SignalError):
            pass

    def read(self, data):
        """Header stamp and one value per path."""
        if len(data) > self.largest:
            raise UnreadableError(f"is of {len(data)} bytes, more than parameter largest_message allows")
        if self.plan is not None:
            what, found = self.plan.read(data)
            if what == CUT:  # some of which the middleware fills up with zeros
                raise UnreadableError(f"is cut: it ends before a {self.type_name} does")
            if what > LONGER:
                raise UnreadableError(
                    f"is {what - LONGER} bytes longer than a {self.type_name}; "
                    f"its publisher may have another version of that type"
                )
            if what == UNTRUE or what == OTHER:  # the middleware takes some of these as well
                raise UnreadableError("holds a truth value that is neither 0 nor 1" if what == UNTRUE else "is no plain CDR")
            self.strange = what == STRANGE
            if found is not None:
                return found
        self.decoded += 1
        try:
            message = self.decode(data)
        except Exception as error:  # what the middleware raises is not stated anywhere
            raise UnreadableError(f"cannot be decoded: {error}") from None
        try:
            return header_stamp_ns(message), [path.read(message) for path in self.paths]
        except _SHAPED_ODDLY as error:
            raise UnreadableError(f"a field cannot be read: {error}") from None

