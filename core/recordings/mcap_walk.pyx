# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

# cython: boundscheck=False, wraparound=False, cdivision=True

"""Records of an MCAP block, one behind the other: where its messages are."""

from typing import NamedTuple

import numpy as np

from libc.stdint cimport uint8_t, uint16_t, uint64_t
from libc.string cimport memcpy

cdef enum:
    HEAD = 9  # opcode and length of a record
    MESSAGE_HEAD = 22  # channel, sequence, log time and publish time
    OPCODE_OF_SCHEMA = 3
    OPCODE_OF_CHANNEL = 4
    OPCODE_OF_MESSAGE = 5
    OPCODE_OF_CHUNK = 6


class Records(NamedTuple):
    channel: object
    log_time: object
    begin: object
    end: object
    definitions: list
    short: int
    late: int
    nested: int
    number: int
    stop: int


def walk_records(block, Py_ssize_t begin, Py_ssize_t end, Py_ssize_t most, bint bare=False):
    """Whole records of block[begin:end], at most so many, until one that is cut or of opcode 0; if bare, until another."""
    cdef const uint8_t[::1] data = block
    cdef Py_ssize_t at = begin, found = 0, number = 0, short = 0, late = 0, nested = 0
    cdef Py_ssize_t room = min(most, (end - begin) // (HEAD + MESSAGE_HEAD))
    places, times, channels = np.empty((2, room), np.int64), np.empty(room, np.uint64), np.empty(room, np.uint16)
    cdef long[:, ::1] place = places
    cdef uint64_t[::1] time = times
    cdef uint16_t[::1] channel = channels
    cdef uint64_t length
    definitions = []
    while number < most and at + HEAD <= end and data[at]:
        memcpy(&length, &data[at + 1], 8)
        if length > <uint64_t>(end - at - HEAD) or (bare and not OPCODE_OF_SCHEMA <= data[at] <= OPCODE_OF_MESSAGE):
            break
        number += 1
        if data[at] in (OPCODE_OF_SCHEMA, OPCODE_OF_CHANNEL):
            definitions.append((data[at], at + HEAD, at + HEAD + <Py_ssize_t>length))
        elif data[at] == OPCODE_OF_MESSAGE and length < MESSAGE_HEAD:
            short += 1
        elif data[at] == OPCODE_OF_MESSAGE:
            memcpy(&channel[found], &data[at + HEAD], 2)
            memcpy(&time[found], &data[at + HEAD + 6], 8)
            late += time[found] >> 63  # times are kept with a sign
            place[0, found] = at + HEAD + MESSAGE_HEAD
            place[1, found] = at + HEAD + <Py_ssize_t>length
            found += 1 - (time[found] >> 63)
        nested += data[at] == OPCODE_OF_CHUNK
        at += HEAD + <Py_ssize_t>length
    begins, ends = places[0, :found], places[1, :found]
    return Records(channels[:found], times[:found], begins, ends, definitions, short, late, nested, number, at)
