# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Output topics in one table, and their messages in serialised form: laid out once, then only numbers are filled in.

Publishers of the node, snapshots, annotated recordings, layouts of viewers and the reference take topics, types and
bytes from here.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cython
import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Integers, Mask
from uncertain_lti.base.errors import ModelError
from uncertain_lti.monitor.verdict import place
from uncertain_lti.recordings.mcap_writer import MESSAGE_HEAD, message_head

VECTOR_TYPE, FLAG_TYPE, TEXT_TYPE = "sensor_msgs/msg/JointState", "std_msgs/msg/Bool", "std_msgs/msg/String"
NODE = "/envelope_monitor"
"""Name of the node unless it is given another."""


@dataclass(frozen=True)
class Output:
    """One topic below the node's name.

    `name`: last part of the topic's name; `type`: message type: `VECTOR_TYPE` with one number per state, `FLAG_TYPE`
    with the alarm, or `TEXT_TYPE` in words; `when`: for every clock message, for those with a verdict, on a change, or
    for the prediction after an open sample: of one step, or over the longest horizon; `text`: its meaning, for the
    reference (Markdown); `position`: the number of a verdict that `position` holds, one of `verdict.NUMBERS`; empty
    without one; `velocity`: attribute of a verdict, true or false, that `velocity` repeats for each state; empty
    without one; `view`: how viewers draw it: a bound or the sample in the plot of each state, all states in one plot,
    changes in time, or the alarm. Empty: not at all; `title`: title of its plot, for the views "states" and "steps";
    `limits`: constant lines of its plot, for the view "states"; `of`: what its numbers are of: the states, the states
    at one step and at each horizon of the model, or the statistics of the alarm. A model without horizons, or an alarm
    without statistics, does not have the output.
    """

    name: str
    type: str
    when: Literal["message", "judged", "changed", "predicted", "predicted over"]
    text: str
    position: str = ""
    velocity: str = ""
    view: Literal["", "bound", "sample", "states", "steps", "alarm"] = ""
    title: str = ""
    limits: tuple[tuple[str, float], ...] = ()
    of: Literal["states", "horizons", "statistics"] = "states"


FLAGS = Output(
    "flags", VECTOR_TYPE, "message",
    "for every clock message: `position` 0 contained, 1 violated, NaN no verdict, per state; `velocity` 1: the sample "
    "before lies outside the fitted domain",
    position="flags", velocity="outside_domain", view="steps", title="0 contained, 1 violated",
)  # fmt: skip
VIOLATION = Output(
    "violation", FLAG_TYPE, "message",
    "the alarm: m of the last n verdicts violated; false also while nothing is known; every verdict, and at least "
    "every `heartbeat`, with a deadline offered",
    view="alarm",
)  # fmt: skip
REASON = Output(
    "reason", TEXT_TYPE, "changed",
    "in words, which rule, state and horizon hold the alarm, or why there is no verdict; when it changes, and once to "
    "whoever subscribes later (transient local)",
)  # fmt: skip
OUTPUTS = (
    FLAGS,
    VIOLATION,
    Output("lower", VECTOR_TYPE, "judged", "the lower bound that was judged", position="lower", view="bound"),
    Output("upper", VECTOR_TYPE, "judged", "the upper bound that was judged", position="upper", view="bound"),
    Output("state", VECTOR_TYPE, "judged", "the sample that was judged", position="state", view="sample"),
    Output(
        "utilisation", VECTOR_TYPE, "judged", "where between its bounds each state lies, -1 to 1 inside",
        position="utilisation", view="states", title="utilisation: -1 and 1 at the bounds",
        limits=(("upper bound", 1.0), ("lower bound", -1.0)),
    ),
    Output(
        "horizon_utilisation", VECTOR_TYPE, "judged",
        "of a model with horizons, the utilisation after one step and after each number of steps; `name` is "
        "`state@steps`, NaN where fewer transitions follow one another",
        position="horizon_utilisation", of="horizons",
    ),
    Output(
        "statistics", VECTOR_TYPE, "judged",
        "of an alarm with statistics, each over its threshold: beyond 1 and -1 it raises the alarm; `name` is "
        "`kind/state`, `kind@steps/state` at a horizon, and `chi2/joint` of all states together",
        position="statistics", of="statistics",
    ),
    REASON,
    Output(
        "predicted_lower", VECTOR_TYPE, "predicted",
        "on receipt of a sample, the lower bound one median step on, with the control known so far; only while "
        "somebody subscribes",
        position="lower",
    ),
    Output("predicted_upper", VECTOR_TYPE, "predicted", "the same for the upper bound", position="upper"),
    Output(
        "horizon_predicted_lower", VECTOR_TYPE, "predicted over",
        "of a model with horizons, on receipt of a sample, the lower bound as many median steps on as the longest "
        "horizon has, if the controls known so far stay; only while somebody subscribes",
        position="lower",
    ),
    Output("horizon_predicted_upper", VECTOR_TYPE, "predicted over", "the same for the upper bound", position="upper"),
)  # fmt: skip
"""Every output, those of every clock message first."""

RECORDED = tuple(output for output in OUTPUTS if not output.when.startswith("predicted"))
"""The outputs that files hold: all that depend on verdicts alone."""
JUDGED = tuple(output for output in OUTPUTS if output.when == "judged")
"""The outputs that only a verdict has."""


def names_of(
    states: Sequence[str], steps: Sequence[int] = (), statistics: Sequence[str] = ()
) -> dict[str, tuple[str, ...]]:
    """Names of the numbers that outputs carry, by what they are of."""
    over = [1, *steps] if steps else []
    horizons = tuple(f"{name}@{h}" for h in over for name in states)
    return {"states": tuple(states), "horizons": horizons, "statistics": tuple(statistics)}


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
            text = name.encode(errors="replace") + b"\x00"
            if text[:-1].decode() != name or "\x00" in name:
                raise ModelError(f"signal {name!r} cannot be sent as text; rename it")
            _counted(body, len(text))
            body += text
        self.position = _numbers(body, len(names))
        self.velocity = _numbers(body, len(names) if velocities else 0)
        _numbers(body, 0)
        self.template = _CDR + bytes(body)
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
        self.head, self.statistics, self.tail, self.tails = head, output.of == "statistics", vector.tail(), {}
        self.start = 0 if self.statistics else place(output.position, n).start
        self.stop = self.start + 8 * vector.count
        self.velocity = output.velocity
        for mark, number in ((False, 0.0), (True, 1.0), (None, math.nan)) if output.velocity else ():
            self.tails[mark] = vector.tail(struct.pack(f"<{vector.count}d", *[number] * vector.count))


@cython.cclass
class Encoder:
    """Messages of several outputs, all of one verdict at once: the stamp is laid out and numbers are packed only once.

    `outputs`: vectors only; `vectors`: the message of each; several may have the same; `n`: number of states.
    """

    _vectors: list[NamedVector]  # of different names
    _rows: list[_Row]

    def __init__(self, outputs: Sequence[Output], vectors: Sequence[NamedVector], n: int) -> None:
        self._vectors, self._rows = [], []
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
        t_ns, numbers = verdict.t_ns, verdict.packed()
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

    `names`: of the model and its alarm, by `names_of`; `make_vector`: makes the messages from names and `velocities`;
    raises ModelError. Default `NamedVector`; `outputs`: each vector of `OUTPUTS` that model and alarm have, by name, in
    their order.
    """

    def __init__(
        self,
        names: Mapping[str, Sequence[str]],
        make_vector: Callable[[Sequence[str], bool], NamedVector] = NamedVector,
    ) -> None:
        self._n, foresees = len(names["states"]), bool(names["horizons"])
        self.outputs = {
            output.name: output
            for output in OUTPUTS
            if output.position and names[output.of] and (foresees or output.when != "predicted over")
        }
        kinds = sorted({(output.of, bool(output.velocity)) for output in self.outputs.values()})
        self._vectors = {(of, marked): make_vector(names[of], marked) for of, marked in kinds}

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


class VerdictRecords:
    """MCAP message records of many verdicts at once, with the bytes that `VerdictMessages` gives one by one.

    `names`: of the model and its alarm, by `names_of`; `channels`: number of the channel of each of `RECORDED` that is
    to be there, by name.
    """

    def __init__(self, names: Mapping[str, Sequence[str]], channels: Mapping[str, int]) -> None:
        self._n = len(names["states"])
        chosen = [o for o in RECORDED if o.name in channels and o.when != "changed"]
        self._outputs = [o for o in chosen if not o.position or names[o.of]]
        self._channels = [channels[output.name] for output in self._outputs]
        self._count = [0] * len(self._outputs)
        self._vectors = {o.name: NamedVector(names[o.of], bool(o.velocity)) for o in self._outputs if o.position}
        row = bytearray()
        self._begins: list[int] = []
        self._unjudged = 0  # bytes of the records without a verdict, which come first
        for output, channel in zip(self._outputs, self._channels, strict=True):
            data = FALSE if output.type == FLAG_TYPE else self._vectors[output.name].template
            self._begins.append(len(row))
            row += message_head(channel, 0, 0, len(data)) + data
            if output.when == "message":
                assert self._unjudged == self._begins[-1], "OUTPUTS has those of every clock message first"
                self._unjudged = len(row)
        self._row = np.frombuffer(bytes(row), dtype=np.uint8)

    @property
    def size(self) -> int:
        """Bytes of the records of one verdict."""
        return len(self._row)

    def encode(
        self, log_time: Integers, t_ns: Integers, judged: Mask, alarm: Mask, numbers: Mapping[str, NDArray[np.generic]]
    ) -> tuple[bytes, dict[int, bytes]]:
        """Records of K verdicts in rising log time.

        `log_time` (K,): ns; `t_ns` (K,): instants of the samples, ns; `judged` (K,): whether there is a verdict; the
        numbers of the others are published as NaN; `alarm` (K,): as in `Verdicts`.
        """
        count = len(log_time)
        rows = np.tile(self._row, (count, 1))
        seconds, nanoseconds = np.divmod(t_ns, 1_000_000_000)
        seconds = np.clip(seconds, FIRST_S, LAST_S)
        lengths = np.where(judged, self.size, self._unjudged)
        starts = np.cumsum(lengths) - lengths
        index: dict[int, bytes] = {}
        for kind, (output, begin) in enumerate(zip(self._outputs, self._begins, strict=True)):
            published = judged if output.when == "judged" else np.ones(count, dtype=bool)
            _fill(rows, begin + 11, (self._count[kind] + np.cumsum(published) - 1).astype("<u4"))
            self._count[kind] += int(published.sum())
            for at in (begin + 15, begin + 23):
                _fill(rows, at, log_time.astype("<u8"))
            data = begin + MESSAGE_HEAD.size
            if output.type == FLAG_TYPE:
                rows[:, data + 4] = alarm
            else:
                vector = self._vectors[output.name]
                _fill(rows, data + 4, seconds.astype("<i4"))
                _fill(rows, data + 8, nanoseconds.astype("<u4"))
                position = np.where(judged[:, None], numbers[output.position].reshape(count, -1), math.nan)
                _fill(rows, data + vector.position, position.astype("<f8"))
                if output.velocity:
                    velocity = np.where(judged, numbers[output.velocity], math.nan)
                    _fill(rows, data + vector.velocity, np.repeat(velocity[:, None], self._n, axis=1).astype("<f8"))
            entries = np.column_stack([log_time[published], starts[published] + begin]).astype("<u8")
            if len(entries):
                index[self._channels[kind]] = entries.tobytes()
        if judged.all():
            return rows.tobytes(), index
        kept = np.arange(self.size) < lengths[:, None]
        return rows[kept].tobytes(), index


def _fill(rows: NDArray[np.uint8], place: int, values: NDArray[np.generic]) -> None:
    """Write one number, or one vector, into each row from this byte on."""
    data = np.ascontiguousarray(values).view(np.uint8).reshape(len(rows), -1)
    rows[:, place : place + data.shape[1]] = data
