# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""When alarms count: a condition on a field of some topic, and a time of grace after the start."""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.errors import ModelError, SignalError
from uncertain_lti.signals.field_path import FieldPath

_OPERATORS: Mapping[str, Callable[[float, float], bool]] = {
    "==": operator.eq, "!=": operator.ne, "<=": operator.le, ">=": operator.ge, "<": operator.lt, ">": operator.gt,
}  # fmt: skip
_TEXT = re.compile(r"\s*(?P<topic>[~/\w]+)\s+(?P<field>.+?)\s*(?P<operator>==|!=|<=|>=|<|>)\s*(?P<value>\S+)\s*")
_WORDS = {"true": 1.0, "false": 0.0}


@dataclass(frozen=True)
class Condition:
    """`TOPIC FIELD OPERATOR NUMBER`, for example `/engine/mode data == 3` or `/engine/state position[fan] > 0.2`.

    `topic`: topic of the field; `field`: the field; `operator`: one of == != < <= > >=; `value`: what the field is
    compared with.
    """

    topic: str
    field: FieldPath
    operator: str
    value: float

    @classmethod
    def parse(cls, text: str) -> Condition | None:
        """Read a condition."""
        if not text.strip():
            return None
        match = _TEXT.fullmatch(text)
        try:
            if match is None:
                raise ValueError
            word = match["value"].lower()
            value = _WORDS[word] if word in _WORDS else float(word)
            path = FieldPath(match["field"])
        except (ValueError, SignalError):
            raise ModelError(
                f"parameter enable is {text!r}; write TOPIC FIELD OPERATOR NUMBER, for example "
                f"'/engine/mode data == 3', with one of {' '.join(_OPERATORS)}"
            ) from None
        if path.unwrap or path.memory:
            what = "unwrapping" if path.unwrap else path.text.partition("(")[0].strip()
            raise ModelError(f"parameter enable: {path.text} cannot be compared, as {what} needs a history")
        return cls(match["topic"], path, match["operator"], value)

    def holds(self, value: float) -> bool | None:
        """Whether it holds; None if the value is not a number."""
        return _OPERATORS[self.operator](value, self.value) if value == value else None

    def __str__(self) -> str:
        return f"{self.topic} {self.field.text} {self.operator} {self.value:g}"


def steps_back(instant: int, last: int, before: int) -> bool:
    """Whether an instant lies before the last one and not after the one before it.

    A step back to later than that returns from one stamp that lay ahead. Time has stepped back once the next instant
    is not after the last one either; otherwise this was one stamp that lay behind. Neither outlier ends anything.
    """
    return instant < last and instant <= before


def back_and_restarts(t_ns: NDArray[np.int64]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """`steps_back` at each sample (N+1,), and whether time has stepped back to the one before and stays there."""
    back = np.diff(t_ns, prepend=t_ns[:1]) < 0
    back[2:] &= t_ns[2:] <= t_ns[:-2]
    restarts = np.zeros(len(t_ns), dtype=bool)
    restarts[2:] = back[1:-1] & (t_ns[2:] <= t_ns[:-2])
    return back, restarts


class Armed(NamedTuple):
    """Which samples of a recording may raise the alarm.

    `counts` (N+1,): whether the verdict on the sample counts; otherwise there is no alarm after it; `cleared` (N+1,):
    whether the alarm starts over before the verdict on the sample.
    """

    counts: NDArray[np.bool_]
    cleared: NDArray[np.bool_]


class Arming:
    """Whether a verdict may raise the alarm.

    `condition`: none for alarms that always count; `grace_ns`: no alarm this long, ns, in the samples' own time, after
    the first sample, after time jumped back, and after the condition began to hold; `value`: the last value of the
    condition, if it is known already; `value`: the last value of the condition; None while none was received; `on`:
    whether the condition holds; None while nothing, or nothing that is a number, is known. Without a condition True.
    """

    def __init__(self, condition: Condition | None, grace_ns: int, value: float | None = None) -> None:
        self.condition, self.value = condition, value
        self.on: bool | None = None
        if condition is None:
            self.on = True
        elif value is not None:
            self.on = condition.holds(value)
        self._grace = grace_ns
        self._from: int | None = None  # the first instant that counts
        self._counted = False  # whether the last instant did

    def learn(self, value: float) -> None:
        """Take a value of the condition's field."""
        assert self.condition is not None
        self.value = value
        before, self.on = self.on, self.condition.holds(value)
        if self.on and not before:
            self._from = None

    def said_on(self, condition: Condition | None) -> float | None:
        """What is known of the field that another condition asks for."""
        same = condition and self.condition and (condition.topic, condition.field) == (
            self.condition.topic, self.condition.field
        )  # fmt: skip
        return self.value if same else None

    def restart(self, t_ns: int | None = None) -> None:
        """The sample at this instant was the first; None for the next."""
        if t_ns is None:
            self._from = None
        elif self._from is not None:
            self._from = t_ns + self._grace

    def at(self, t_ns: int, steps_back: bool = False) -> bool:
        """Whether a verdict at this instant counts; as the last one if it steps back, perhaps alone."""
        if not self.on:
            self._counted = False
        elif not steps_back:
            if self._from is None:
                self._from = t_ns + self._grace
            self._counted = not self._grace or t_ns >= self._from
        return self._counted

    def over(
        self,
        t_ns: NDArray[np.int64],
        before: NDArray[np.intp] | Sequence[int] = (),
        values: ArrayLike = (),
    ) -> Armed:
        """`learn` and `at` over the samples of a recording, as the live session calls them one after the other.

        `t_ns` (N+1,): instants of the samples, ns; a step back starts the grace time over; `before` (K,): samples
        decided before each value of the condition's field came, in order; `values` (K,): these values.
        """
        count = len(t_ns)
        if self.condition is None and not self._grace:
            return Armed(np.ones(count, dtype=bool), np.zeros(count, dtype=bool))
        counts, cleared = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
        arrived = zip(np.asarray(before).tolist(), np.asarray(values, dtype=np.float64).tolist(), strict=True)
        due, value = next(arrived, (count, 0.0))
        back, restarts = (marks.tolist() for marks in back_and_restarts(t_ns))
        for k, instant in enumerate(t_ns.tolist()):
            while due <= k:
                self.learn(value)
                cleared[k] |= not self.on
                due, value = next(arrived, (count, 0.0))
            if restarts[k]:
                self.restart(int(t_ns[k - 1]))
            counts[k] = self.at(instant, back[k])
        return Armed(counts, cleared | ~counts)

    def why_off(self) -> str:
        """Why alarms do not count, in words; empty if they do."""
        if self.on is None and self.value is not None and self.condition is not None:
            return f"alarms are off: {self.condition.topic} comes without a number in {self.condition.field.text}"
        if self.on is None:
            return f"alarms are off: it is not known whether {self.condition}"
        if not self.on:
            return f"alarms are off until {self.condition}"
        return ""
