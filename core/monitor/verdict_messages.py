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

import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.errors import ModelError
from uncertain_lti.monitor.outputs import FLAG_TYPE, OUTPUTS, RECORDED, Output, names_of
from uncertain_lti.recordings.mcap_writer import INDEX_ENTRY, MESSAGE_HEAD

_ENCAPSULATION = 4
TRUE, FALSE = b"\x00\x01\x00\x00\x01", b"\x00\x01\x00\x00\x00"
"""std_msgs/Bool."""
_STAMP = struct.Struct("<iI")
_CDR = b"\x00\x01\x00\x00"
_FIRST_S, _LAST_S = -(2**31), 2**31 - 1  # seconds that a stamp holds
_MESSAGE = 5  # opcode
_NAN = float("nan")


class NamedVector:
    """sensor_msgs/JointState with these names, in serialised form.

    Parameters
    ----------
    names : sequence of str
        Of the states.
    velocities : bool
        Whether `velocity` holds as many numbers as `position`, or none.

    Attributes
    ----------
    template : bytes
        The message with zeros for stamp and numbers.
    position, velocity : int
        Byte at which their numbers begin.

    Raises
    ------
    ModelError
        The names cannot be sent.
    """

    def __init__(self, names: Sequence[str], velocities: bool = False) -> None:
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
        # The bytes before, between and after stamp, position and velocity.
        self._start = self.template[:_ENCAPSULATION]
        self._names = self.template[_ENCAPSULATION + _STAMP.size : self.position]
        self._between = self.template[self.position + width : self.velocity]
        self._end = self.template[self.velocity + width * velocities :]
        # Several vectors have the same stamp one after another.
        self._t_ns, self._head = 0, self._headed(0)

    def __call__(self, t_ns: int, position: bytes, velocity: bytes = b"") -> bytes:
        """The message; position, and velocity if there is one, as little-endian doubles, all of them."""
        if t_ns != self._t_ns:
            self._t_ns, self._head = t_ns, self._headed(t_ns)
        return b"".join((self._head, position, self._between, velocity, self._end))

    def _headed(self, t_ns: int) -> bytes:
        """Everything before the numbers."""
        seconds, nanoseconds = divmod(t_ns, 1_000_000_000)
        return self._start + _STAMP.pack(max(_FIRST_S, min(seconds, _LAST_S)), nanoseconds) + self._names


def text_message(text: str) -> bytes:
    """std_msgs/String in serialised form.

    Parameters
    ----------
    text : str
        Its data.

    Returns
    -------
    bytes
        The message.
    """
    data = text.encode(errors="replace") + b"\x00"
    return _CDR + struct.pack("<I", len(data)) + data


class AnyVerdict(Protocol):
    """What messages need of a verdict; `Verdict` is one."""

    @property
    def t_ns(self) -> int:
        """The sample's instant."""

    @property
    def n(self) -> int:
        """Number of states."""

    @property
    def horizons(self) -> int:
        """Number of horizons of the model."""

    @property
    def statistic_names(self) -> tuple[str, ...]:
        """Names of the statistics of the alarm."""

    @property
    def judged(self) -> bool:
        """Whether there is a verdict."""

    @property
    def outside_domain(self) -> bool:
        """The sample before lies outside the ranges seen in the fit."""

    def packed(self, name: str) -> bytes:
        """Numbers of one kind.

        Parameters
        ----------
        name : str
            One of `NUMBERS`, horizon_utilisation or statistics.

        Returns
        -------
        bytes
            Little-endian doubles.
        """


class VerdictMessages:
    """Messages of one verdict after another, for each vector of `OUTPUTS`.

    Parameters
    ----------
    names : sequence of str
        Of the states.
    make_vector : callable, default NamedVector
        Makes the messages from names and `velocities`; raises ModelError.
    steps : sequence of int
        Of the model's horizons.
    statistics : sequence of str
        Names of the statistics of the alarm.

    Attributes
    ----------
    encode : dict
        By name the function that makes the message of a verdict, of each vector of `OUTPUTS` that model and alarm have.
    """

    def __init__(
        self,
        names: Sequence[str],
        make_vector: Callable[[Sequence[str], bool], NamedVector] = NamedVector,
        steps: Sequence[int] = (),
        statistics: Sequence[str] = (),
    ) -> None:
        every = names_of(names, steps, statistics)
        self._other = {of: make_vector(every[of], False) for of in ("horizons", "statistics") if every[of]}
        self._plain, self._marked = make_vector(names, False), make_vector(names, True)  # shared: their stamps repeat
        n = len(names)
        self._marks = {mark: struct.pack(f"<{n}d", *[mark] * n) for mark in (False, True)}
        self._no_mark = struct.pack(f"<{n}d", *[_NAN] * n)
        self.encode = {output.name: self._encoder(output) for output in OUTPUTS if output.position and every[output.of]}

    def _encoder(self, output: Output) -> Callable[[AnyVerdict], bytes]:
        plain, marked, marks, no_mark = self._plain, self._marked, self._marks, self._no_mark
        position, velocity = output.position, output.velocity
        if output.of != "states":
            assert not velocity
            plain = self._other[output.of]

        def encode(verdict: AnyVerdict) -> bytes:
            return plain(verdict.t_ns, verdict.packed(position))

        def encode_marked(verdict: AnyVerdict) -> bytes:
            mark = marks[getattr(verdict, velocity)] if verdict.judged else no_mark
            return marked(verdict.t_ns, verdict.packed(position), mark)

        return encode_marked if velocity else encode


class VerdictRecords:
    """MCAP message records of many verdicts at once, with the bytes that `VerdictMessages` gives one by one.

    Parameters
    ----------
    names : sequence of str
        Of the states.
    channels : mapping of str to int
        Number of the channel of each of `RECORDED` that is to be there, by name.
    steps : sequence of int
        Of the model's horizons.
    statistics : sequence of str
        Names of the statistics of the alarm.
    """

    def __init__(
        self,
        names: Sequence[str],
        channels: Mapping[str, int],
        steps: Sequence[int] = (),
        statistics: Sequence[str] = (),
    ) -> None:
        self._n, every = len(names), names_of(names, steps, statistics)
        chosen = [o for o in RECORDED if o.name in channels and o.when != "changed"]
        self._outputs = [o for o in chosen if not o.position or every[o.of]]
        self._channels = [channels[output.name] for output in self._outputs]
        self._count = [0] * len(self._outputs)
        self._vectors = {o.name: NamedVector(every[o.of], bool(o.velocity)) for o in self._outputs if o.position}
        row = bytearray()
        self._begins: list[int] = []
        self._unjudged = 0  # bytes of the records without a verdict, which come first
        for output, channel in zip(self._outputs, self._channels, strict=True):
            data = FALSE if output.type == FLAG_TYPE else self._vectors[output.name].template
            self._begins.append(len(row))
            row += MESSAGE_HEAD.pack(_MESSAGE, MESSAGE_HEAD.size - 9 + len(data), channel, 0, 0, 0) + data
            if output.when == "message":
                assert self._unjudged == self._begins[-1], "OUTPUTS has those of every clock message first"
                self._unjudged = len(row)
        self._row = np.frombuffer(bytes(row), dtype=np.uint8)

    @property
    def size(self) -> int:
        """Bytes of the records of one verdict."""
        return len(self._row)

    def encode(
        self,
        log_time: NDArray[np.int64],
        t_ns: NDArray[np.int64],
        judged: NDArray[np.bool_],
        alarm: NDArray[np.bool_],
        numbers: Mapping[str, NDArray[np.generic]],
    ) -> tuple[bytes, dict[int, bytes]]:
        """Records of K verdicts in rising log time.

        Parameters
        ----------
        log_time : array (K,) of int
            ns.
        t_ns : array (K,) of int
            Instants of the samples, ns.
        judged : array (K,) of bool
            Whether there is a verdict; the numbers of the others are published as NaN.
        alarm : array (K,) of bool
            As in `Verdicts`.
        numbers : mapping of str to array
            Of each `position` in `RECORDED` the numbers (K, ...), of each `velocity` the truth values (K,).

        Returns
        -------
        bytes
            The records.
        dict of int to bytes
            The index that `McapWriter.chunk` takes.
        """
        count = len(log_time)
        rows = np.tile(self._row, (count, 1))
        seconds, nanoseconds = np.divmod(t_ns, 1_000_000_000)
        seconds = np.clip(seconds, _FIRST_S, _LAST_S)
        lengths = np.where(judged, self.size, self._unjudged)
        starts = np.cumsum(lengths) - lengths
        index: dict[int, bytes] = {}
        for kind, (output, begin) in enumerate(zip(self._outputs, self._begins, strict=True)):
            published = judged if output.when == "judged" else np.ones(count, dtype=bool)
            _fill(rows, begin + 11, (self._count[kind] + np.cumsum(published) - 1).astype("<u4"))
            self._count[kind] += int(published.sum())
            for place in (begin + 15, begin + 23):
                _fill(rows, place, log_time.astype("<u8"))
            data = begin + MESSAGE_HEAD.size
            if output.type == FLAG_TYPE:
                rows[:, data + 4] = alarm
            else:
                vector = self._vectors[output.name]
                _fill(rows, data + 4, seconds.astype("<i4"))
                _fill(rows, data + 8, nanoseconds.astype("<u4"))
                position = np.where(judged[:, None], numbers[output.position].reshape(count, -1), _NAN)
                _fill(rows, data + vector.position, position.astype("<f8"))
                if output.velocity:
                    velocity = np.where(judged, numbers[output.velocity], _NAN)
                    _fill(rows, data + vector.velocity, np.repeat(velocity[:, None], self._n, axis=1).astype("<f8"))
            entries = np.column_stack([log_time[published], starts[published] + begin]).astype("<u8")
            if len(entries):
                index[self._channels[kind]] = entries.tobytes()
            assert INDEX_ENTRY.size == 8 * entries.shape[1]
        if judged.all():
            return rows.tobytes(), index
        kept = np.arange(self.size) < lengths[:, None]
        return rows[kept].tobytes(), index


def _fill(rows: NDArray[np.uint8], place: int, values: NDArray[np.generic]) -> None:
    """Write one number, or one vector, into each row from this byte on."""
    data = np.ascontiguousarray(values).view(np.uint8).reshape(len(rows), -1)
    rows[:, place : place + data.shape[1]] = data


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
