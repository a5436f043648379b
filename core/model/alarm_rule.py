"""AlarmRule: which verdicts raise the alarm."""

from __future__ import annotations

import reprlib
from dataclasses import dataclass

from uncertain_lti.base.errors import ModelError
from uncertain_lti.base.limits import LARGEST

LONGEST_WINDOW = 1_000_000
"""Verdicts that the alarm looks at, at most."""


@dataclass(frozen=True)
class AlarmRule:
    """The alarm is raised while `violations` of the last `window` verdicts are violations.

    Parameters
    ----------
    violations : int, default 1
        m of the rule.
    window : int, default 1
        n of the rule, in verdicts.
    margin : float, default 1.0
        Multiplies the half-widths of the bounds that are judged.

    Raises
    ------
    ModelError
        Not 1 <= violations <= window <= LONGEST_WINDOW, or the margin is not positive.
    """

    violations: int = 1
    window: int = 1
    margin: float = 1.0

    def __post_init__(self) -> None:
        whole = isinstance(self.violations, int) and isinstance(self.window, int)
        if not (whole and 1 <= self.violations <= self.window <= LONGEST_WINDOW):
            raise ModelError(
                f"alarm: violations is {reprlib.repr(self.violations)} of window {reprlib.repr(self.window)}; it takes "
                f"whole numbers, 1 <= violations <= window <= {LONGEST_WINDOW}"
            )
        if not 1 / LARGEST <= self.margin <= LARGEST:
            raise ModelError(
                f"alarm: margin is {self.margin}; it must be a positive number, {1 / LARGEST:g} to {LARGEST:g}"
            )
