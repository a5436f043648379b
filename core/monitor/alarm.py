"""The alarm: m of the last n verdicts are violations."""

from __future__ import annotations

from collections import deque
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.model.alarm_rule import AlarmRule


class AlarmStatistic(Protocol):
    """What raises the alarm from one verdict after another; `AlarmWindow` is one."""

    @property
    def alarm(self) -> bool:
        """The alarm after the last verdict."""
        ...

    def reset(self) -> None:
        """Forget every verdict and the alarm."""

    def push(self, violated: bool) -> bool:
        """Take one verdict.

        Parameters
        ----------
        violated : bool
            Whether it is a violation that counts.

        Returns
        -------
        bool
            The alarm after it.
        """
        ...


class AlarmWindow:
    """The last verdicts and the alarm that they raise, one verdict after another.

    Parameters
    ----------
    rule : AlarmRule
        m, n; its margin plays no part here.

    Attributes
    ----------
    alarm : bool
        `violations` of the last `window` verdicts are violations.
    """

    __slots__ = ("_needed", "_recent", "_violations", "alarm")

    def __init__(self, rule: AlarmRule) -> None:
        self._needed = rule.violations
        self._recent: deque[bool] = deque(maxlen=rule.window)
        self.reset()

    def reset(self) -> None:
        """Forget every verdict and the alarm."""
        self._recent.clear()
        self._violations = 0
        self.alarm = False

    @property
    def recent(self) -> tuple[bool, ...]:
        """The verdicts in the window, oldest first: whether each is a violation that counts."""
        return tuple(self._recent)

    def push(self, violated: bool) -> bool:
        """Take one verdict.

        Parameters
        ----------
        violated : bool
            Whether it is a violation that counts.

        Returns
        -------
        bool
            The alarm after it.
        """
        recent = self._recent
        if len(recent) == recent.maxlen:
            self._violations -= recent[0]
        recent.append(violated)
        self._violations += violated
        self.alarm = self._violations >= self._needed
        return self.alarm


def raised(violated: NDArray[np.bool_], rule: AlarmRule) -> NDArray[np.bool_]:
    """The alarm of `AlarmWindow` after each of many verdicts, from a cleared alarm.

    Parameters
    ----------
    violated : array of bool (K,)
        Whether each verdict is a violation that counts.
    rule : AlarmRule
        m and n.

    Returns
    -------
    array of bool (K,)
        The alarm after each.
    """
    total = np.concatenate([[0], np.cumsum(violated)])
    ends = np.arange(1, len(total))
    recent: NDArray[np.bool_] = total[ends] - total[np.maximum(ends - rule.window, 0)] >= rule.violations
    return recent
