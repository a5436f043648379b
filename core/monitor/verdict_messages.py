# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Messages of verdicts in serialised form: laid out once, then only stamps and numbers are filled in.

The live node, its snapshots and annotated recordings carry the same topics, types and bytes.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from typing import Any

import cython

from uncertain_lti.base.errors import ModelError
from uncertain_lti.monitor.outputs import OUTPUTS, Output, names_of
from uncertain_lti.monitor.verdict import kinds, place

_ENCAPSULATION = 4
TRUE, FALSE = b"\x00\x01\x00\x00\x01", b"\x00\x01\x00\x00\x00"
"""std_msgs/Bool."""
_STAMP = struct.Struct("<iI")
_CDR = b"\x00\x01\x00\x00"
FIRST_S, LAST_S = -(2**31), 2**31 - 1
"""Seconds that a stamp holds."""


@cython.cclass
class NamedVector:
    """sensor_msgs/JointState with these names, in serialised form.

    `names`: of the states; `velocities`: whether `velocity` holds as many numbers as `position`, or none; `template`:
    the message with zeros for stamp and numbers; `count`: number of names; `position, velocity`: byte at which their
    numbers begin.
    """

    template = cython.declare(bytes, visibility="readonly")
    count = cython.declare(cython.Py_ssize_t, visibility="readonly")
    position = cython.declare(cython.Py_ssize_t, visibility="readonly")
    velocity = cython.declare(cython.Py_ssize_t, visibility="readonly")
    _start: bytes  # before the stamp, and between what is filled in
    _names: bytes
    _between: bytes
    _end: bytes

    def __init__(self, names: Sequence[str], velocities: bool = False) -> None:
        self.count = len(names)
        body = bytearray(struct.pack("<iII", 0, 0, 1) + b"\x00")  # stamp, an empty frame_id
        _counted(body, len(names))
        for name in names:
            try:
                text = name.encode() + b"\x00"
            except UnicodeEncodeError:
                raise ModelError(f"signal {name!r} cannot be sent as text; rename it") from None
            if b"\x00" in text[:-1]:
                raise ModelError(f"signal {name!r} cannot be sent as text; rename it")
            _counted(body, len(text))
            body += text
        self.position = _numbers(body, len(names))
        self.velocity = _numbers(body, len(names) if velocities else 0)
        _numbers(body, 0)
        self.template = bytes((0, 1, 0, 0)) + bytes(body)
        width = 8 * len(names)
        self._start = self.template[:_ENCAPSULATION]
        self._names = self.template[_ENCAPSULATION + _STAMP.size : self.position]
        self._between = self.template[self.position + width : self.velocity]
        self._end = self.template[self.velocity + width * velocities :]

    def __call__(self, t_ns: int, position: bytes, velocity: bytes = b"") -> bytes:
        """The message; position, and velocity if there is one, as little-endian doubles, all of them."""
        return b"".join((self.head(t_ns), position, self.tail(velocity)))

    @cython.ccall
    def head(self, t_ns: int) -> bytes:
        """Everything before the positions, which does not depend on whether there are velocities."""
        seconds, nanoseconds = divmod(t_ns, 1_000_000_000)
        return self._start + _STAMP.pack(max(FIRST_S, min(seconds, LAST_S)), nanoseconds) + self._names

    def tail(self, velocity: bytes = b"") -> bytes:
        """Everything after the positions."""
        return self._between + velocity + self._end


def text_message(text: str) -> bytes:
    """std_msgs/String in serialised form."""
    data = text.encode(errors="replace") + b"\x00"
    return _CDR + struct.pack("<I", len(data)) + data


@cython.cclass
class _Row:
    """One output of an encoder."""

    head: cython.Py_ssize_t  # number of the vector that begins the message
    start: cython.Py_ssize_t  # of its numbers in those of the verdict
    stop: cython.Py_ssize_t
    tail: bytes
    statistics: cython.bint  # its numbers are those of the alarm
    velocity: str
    tails: dict[Any, bytes]  # by what it repeats for each state; None for no verdict

    def __init__(self, output: Output, vector: NamedVector, head: int, n: int) -> None:
        self.head, self.statistics = head, output.of == "statistics"
        self.start = 0 if self.statistics else place(output.position, n).start
        self.stop = self.start + 8 * vector.count
        self.tail, self.velocity, self.tails = b"", output.velocity, {}
        if not output.velocity:
            self.tail = vector.tail()
            return
        for mark, number in ((False, 0.0), (True, 1.0), (None, math.nan)):
            self.tails[mark] = vector.tail(struct.pack(f"<{vector.count}d", *[number] * vector.count))


@cython.cclass
class Encoder:
    """Messages of several outputs, all of one verdict at once: the stamp is laid out and numbers are packed only once.

    `outputs`: vectors only; `vectors`: the message of each; several may have the same; `n`: number of states.
    """

    _vectors: list[NamedVector]  # of different names
    _rows: list[_Row]
    _kinds: frozenset[int]

    def __init__(self, outputs: Sequence[Output], vectors: Sequence[NamedVector], n: int) -> None:
        self._vectors, self._rows = [], []
        self._kinds = kinds(output.position for output in outputs if output.of != "statistics")
        for output, vector in zip(outputs, vectors, strict=True):
            alike = [k for k, other in enumerate(self._vectors) if other.head(0) == vector.head(0)]
            if not alike:
                self._vectors.append(vector)
            head = alike[0] if alike else len(self._vectors) - 1
            self._rows.append(_Row(output, vector, head, n))

    def __call__(self, verdict: Any) -> list[bytes]:
        """The messages, in the order of the outputs."""
        row: _Row
        vector: NamedVector
        t_ns, numbers = verdict.t_ns, verdict.packed(self._kinds)
        heads = []
        for vector in self._vectors:
            heads.append(vector.head(t_ns))
        messages = []
        for row in self._rows:
            tail = row.tails[getattr(verdict, row.velocity) if verdict.judged else None] if row.velocity else row.tail
            part = verdict.packed_statistics() if row.statistics else numbers[row.start : row.stop]
            messages.append(b"".join((heads[row.head], part, tail)))
        return messages


class VerdictMessages:
    """Messages of the verdicts of one model, for the vectors of `OUTPUTS`.

    `names`: of the states; `make_vector`: makes the messages from names and `velocities`; raises ModelError. Default
    `NamedVector`; `steps`: of the model's horizons; `statistics`: names of the statistics of the alarm; `outputs`: each
    vector of `OUTPUTS` that model and alarm have, by name, in their order.
    """

    def __init__(
        self,
        names: Sequence[str],
        make_vector: Callable[[Sequence[str], bool], NamedVector] | None = None,
        steps: Sequence[int] = (),
        statistics: Sequence[str] = (),
    ) -> None:
        every, self._n = names_of(names, steps, statistics), len(names)
        foresees = bool(steps)
        self.outputs = {
            output.name: output
            for output in OUTPUTS
            if output.position and every[output.of] and (foresees or output.when != "predicted over")
        }
        kinds = {(output.of, bool(output.velocity)) for output in self.outputs.values()}
        self._vectors = {(of, marked): (make_vector or NamedVector)(every[of], marked) for of, marked in sorted(kinds)}

    def encoder(self, names: Sequence[str]) -> Encoder:
        """What makes the messages of some outputs."""
        outputs = [self.outputs[name] for name in names]
        return Encoder(outputs, [self._vectors[output.of, bool(output.velocity)] for output in outputs], self._n)


def _counted(body: bytearray, count: int) -> None:
    body += b"\x00" * (-len(body) % 4) + struct.pack("<I", count)


def _numbers(body: bytearray, count: int) -> int:
    """Add a sequence of doubles; returns the byte of the message at which its numbers begin."""
    _counted(body, count)
    if count:
        body += b"\x00" * (-len(body) % 8)
    start = len(body) + _ENCAPSULATION
    body += b"\x00" * (8 * count)
    return start
