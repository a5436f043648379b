"""Messages that tell verdicts, in serialised form: laid out once, then only stamps and numbers are filled in.

The live node, its snapshots and annotated recordings carry the same topics, types and bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import ModelError
from uncertain_lti.recordings.mcap_writer import INDEX_ENTRY, MESSAGE_HEAD

VECTOR_TYPE, FLAG_TYPE = "sensor_msgs/msg/JointState", "std_msgs/msg/Bool"
JUDGED = ("lower", "upper", "state", "utilisation")
"""Topics that say something only where there is a verdict."""
TOPICS: Mapping[str, str] = {"flags": VECTOR_TYPE, "violation": FLAG_TYPE} | dict.fromkeys(JUDGED, VECTOR_TYPE)
"""What is told of every clock message, below the node's name: topic and type."""
NODE = "/envelope_monitor"
"""Name of the node unless it is given another."""

_ENCAPSULATION = 4
TRUE, FALSE = b"\x00\x01\x00\x00\x01", b"\x00\x01\x00\x00\x00"
"""std_msgs/Bool."""
_STAMP = struct.Struct("<iI")
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
        Where in it their numbers stand.

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
        # What stands before, between and after stamp, position and velocity.
        self._start = self.template[:_ENCAPSULATION]
        self._names = self.template[_ENCAPSULATION + _STAMP.size : self.position]
        self._between = self.template[self.position + width : self.velocity]
        self._end = self.template[self.velocity + width * velocities :]
        # Several vectors bear the same stamp one after another.
        self._t_ns, self._head = 0, self._headed(0)

    def __call__(self, t_ns: int, position: bytes, velocity: bytes = b"") -> bytes:
        """The message; position, and velocity where there is one, as little-endian doubles, all of them."""
        if t_ns != self._t_ns:
            self._t_ns, self._head = t_ns, self._headed(t_ns)
        return b"".join((self._head, position, self._between, velocity, self._end))

    def _headed(self, t_ns: int) -> bytes:
        """Everything before the numbers."""
        seconds, nanoseconds = divmod(t_ns, 1_000_000_000)
        return self._start + _STAMP.pack(max(_FIRST_S, min(seconds, _LAST_S)), nanoseconds) + self._names


class VerdictRecords:
    """MCAP message records of many verdicts at once, with the bytes that `NamedVector` gives one by one.

    Parameters
    ----------
    names : sequence of str
        Of the states.
    channels : mapping of str to int
        Number of the channel of each of `TOPICS`.
    """

    def __init__(self, names: Sequence[str], channels: Mapping[str, int]) -> None:
        self._n = len(names)
        self._channels = [channels[name] for name in TOPICS]
        self._count = [0] * len(TOPICS)
        plain, marked = NamedVector(names), NamedVector(names, velocities=True)
        self._vectors = {name: plain for name in JUDGED} | {"flags": marked}
        row = bytearray()
        self._begins: list[int] = []
        for name, channel in zip(TOPICS, self._channels, strict=True):
            data = FALSE if name == "violation" else self._vectors[name].template
            self._begins.append(len(row))
            row += MESSAGE_HEAD.pack(_MESSAGE, MESSAGE_HEAD.size - 9 + len(data), channel, 0, 0, 0) + data
        self._row = np.frombuffer(bytes(row), dtype=np.uint8)
        self._unjudged = self._begins[len(TOPICS) - len(JUDGED)]  # bytes of what is said without a verdict

    @property
    def size(self) -> int:
        """Bytes of the records of one verdict."""
        return len(self._row)

    def encode(
        self,
        log_time: NDArray[np.int64],
        t_ns: NDArray[np.int64],
        judged: NDArray[np.bool_],
        outside_domain: NDArray[np.bool_],
        alarm: NDArray[np.bool_],
        flags: Array,
        vectors: Mapping[str, Array],
    ) -> tuple[bytes, dict[int, bytes]]:
        """Records of K verdicts in rising log time.

        Parameters
        ----------
        log_time : array (K,) of int
            ns.
        t_ns : array (K,) of int
            Instants of the samples, ns.
        judged : array (K,) of bool
            Whether there is a verdict.
        outside_domain : array (K,) of bool
            As in `Verdicts`.
        alarm : array (K,) of bool
            As in `Verdicts`.
        flags : array (K, n)
            As in `Verdicts`.
        vectors : mapping of str to array (K, n)
            The numbers of each of `JUDGED`.

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
        outside = np.where(judged, outside_domain, _NAN)
        lengths = np.where(judged, self.size, self._unjudged)
        starts = np.cumsum(lengths) - lengths
        index: dict[int, bytes] = {}
        for kind, (name, begin) in enumerate(zip(TOPICS, self._begins, strict=True)):
            said = judged if name in JUDGED else np.ones(count, dtype=bool)
            _fill(rows, begin + 11, (self._count[kind] + np.cumsum(said) - 1).astype("<u4"))
            self._count[kind] += int(said.sum())
            for place in (begin + 15, begin + 23):
                _fill(rows, place, log_time.astype("<u8"))
            data = begin + MESSAGE_HEAD.size
            if name == "violation":
                rows[:, data + 4] = alarm
            else:
                vector = self._vectors[name]
                _fill(rows, data + 4, seconds.astype("<i4"))
                _fill(rows, data + 8, nanoseconds.astype("<u4"))
                _fill(rows, data + vector.position, (flags if name == "flags" else vectors[name]).astype("<f8"))
                if name == "flags":
                    velocity = np.repeat(outside[:, None], self._n, axis=1)
                    _fill(rows, data + vector.velocity, velocity.astype("<f8"))
            entries = np.column_stack([log_time[said], starts[said] + begin]).astype("<u8")
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
    """Add a sequence of doubles; returns where in the message its numbers stand."""
    _counted(body, count)
    if count:
        body += b"\x00" * (-len(body) % 8)
    start = len(body) + _ENCAPSULATION
    body += b"\x00" * (8 * count)
    return start
