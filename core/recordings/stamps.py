"""Header stamps of decoded messages."""

from typing import Any


def header_stamp_ns(message: Any) -> int | None:
    """Header stamp of a message (rosbags or rclpy) in ns; None where it has no header or the stamp is zero.

    Parameters
    ----------
    message : object
        Decoded message (rosbags or rclpy).

    Returns
    -------
    int or None
        Stamp, or None.
    """
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    if stamp is None:
        return None
    time: int = stamp.sec * 1_000_000_000 + stamp.nanosec
    return time or None
