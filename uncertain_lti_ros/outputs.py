"""Messages of the node in serialised form: laid out once, then only their stamp and numbers are filled in."""

from __future__ import annotations

import struct
from collections.abc import Sequence

from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState

from uncertain_lti.errors import ModelError

_ENCAPSULATION = 4
TRUE, FALSE = b"\x00\x01\x00\x00\x01", b"\x00\x01\x00\x00\x00"
"""std_msgs/Bool."""
_STAMP = struct.Struct("<iI")
_LAST_S = 2**31 - 1  # greatest second that a stamp holds


class NamedVector:
    """sensor_msgs/JointState with these names, in serialised form.

    Parameters
    ----------
    names : sequence of str
    velocities : bool
        Whether `velocity` holds as many numbers as `position`, or none.

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
            _counted(body, len(text))
            body += text
        self._position = _numbers(body, len(names))
        self._velocity = _numbers(body, len(names) if velocities else 0)
        _numbers(body, 0)
        self._template = bytes((0, 1, 0, 0)) + bytes(body)
        self._width = 8 * len(names)
        same = JointState(name=list(names), position=[0.0] * len(names), velocity=[0.0] * len(names) * velocities)
        if deserialize_message(self._template, JointState) != same:
            raise ModelError(f"the names {', '.join(names)} cannot be sent as sensor_msgs/msg/JointState; rename them")

    def __call__(self, t_ns: int, position: bytes, velocity: bytes = b"") -> bytes:
        """The message; position and velocity as little-endian doubles."""
        buffer = bytearray(self._template)
        seconds, nanoseconds = divmod(t_ns, 1_000_000_000)
        _STAMP.pack_into(buffer, _ENCAPSULATION, min(seconds, _LAST_S), nanoseconds)
        buffer[self._position : self._position + self._width] = position
        if velocity:
            buffer[self._velocity : self._velocity + self._width] = velocity
        return bytes(buffer)


def serialised(message: object) -> bytes:
    """Any message, as the middleware writes it."""
    return bytes(serialize_message(message))


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
