"""Angles of a stream on the branch nearest to the one before."""

from __future__ import annotations

import math

TURN = 2.0 * math.pi


def nearest_branch(angle: float, previous: float) -> float:
    """An angle plus the whole turns that bring it nearest to the one before.

    Parameters
    ----------
    angle : float
        rad, finite.
    previous : float
        rad, finite.

    Returns
    -------
    float
        At most half a turn from previous, but for rounding.

    Raises
    ------
    OverflowError
        The turns between them are more than a float can count.
    """
    return angle + TURN * round((previous - angle) / TURN)
