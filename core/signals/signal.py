# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Signal: where one state or control is read, and the operating point it is measured from."""

from __future__ import annotations

import math
import reprlib
import struct
from dataclasses import dataclass
from typing import Literal

from uncertain_lti.base.arrays import LARGEST, LONGEST_S
from uncertain_lti.base.errors import SignalError
from uncertain_lti.signals.field_path import FieldPath
from uncertain_lti.signals.functions import LONGEST_DELAY, Memory, parse_memory

Number = float | Literal["auto"]
At = Literal["departure", "arrival", "both"]
AT: tuple[At, ...] = ("departure", "arrival", "both")
"""From which end of a step a control may be taken."""


@dataclass(frozen=True, slots=True)
class Signal:
    """One state or control.

    `name`: name of the signal; each in a map has its own; `topic`: topic that carries it; `field`: path of the number
    in the message, as `FieldPath` reads it; `steady`: steady state in recorded units; `auto` asks for the rule in
    `operating_point`; `scale`: positive scale in recorded units; `auto` likewise; `unit`: unit as it is shown; `type`:
    message type of the topic; empty while it is unknown; `max_hold`: greatest age, s, at which a held control still
    counts; None for no limit. For controls only; `delay`: samples by which a control is shifted: sample k takes u(t_{k
    - delay}). For controls only; `valid`: least and greatest value of the field; beyond them it counts as missing. None
    for no limit; `ignore`: values of the field that stand for none; each also as single precision rounds it; `at`: the
    end of a step whose recorded value acts during it; a map makes two controls of one that is at both. For controls
    only; `judged`: a control with a row of its own, which a map puts behind the states.
    """

    name: str
    topic: str
    field: str
    steady: Number = 0.0
    scale: Number = 1.0
    unit: str = ""
    type: str = ""
    max_hold: float | None = None
    delay: int = 0
    valid: tuple[float, float] | None = None
    ignore: tuple[float, ...] = ()
    at: At = "departure"
    judged: bool = False

    @property
    def memory(self) -> Memory | None:
        """What it takes from earlier samples of its field; None for the present value."""
        return parse_memory(self.field)[0]

    @property
    def inner(self) -> str:
        """Path of the field itself, without the memory."""
        return parse_memory(self.field)[1]

    @property
    def recalls(self) -> bool:
        """Whether the field is a memory; one that is no field path is refused by `check`."""
        try:
            return self.memory is not None
        except SignalError:
            return False

    def admits(self, value: float) -> bool:
        """Whether a value of the field counts."""
        low, high = self.valid or (-math.inf, math.inf)
        return not (value < low or value > high or value in self.ignored)

    @property
    def ignored(self) -> frozenset[float]:
        """`ignore`, and its values as single precision rounds them."""
        return frozenset(v for code in self.ignore for v in (code, _single(code)))

    def check(self, where: str) -> None:
        """Refuse a field that is none, and a number out of range; the sentence begins with where."""
        try:
            FieldPath(self.field)
        except SignalError as error:
            raise SignalError(f"{where}: {error}") from None
        if self.scale != "auto" and not 1 / LARGEST <= self.scale <= LARGEST:
            problem = f"scale is {self.scale}; it must be a positive number or auto, {1 / LARGEST:g} to {LARGEST:g}"
        elif self.steady != "auto" and not -LARGEST <= self.steady <= LARGEST:
            problem = f"steady is {self.steady}; it must be a finite number or auto, up to {LARGEST:g}"
        elif self.max_hold is not None and not 0 <= self.max_hold <= LONGEST_S:
            problem = (
                f"max_hold is {self.max_hold}; it must be 0 s or more, up to {LONGEST_S:g}, or left out for no limit"
            )
        elif not 0 <= self.delay <= LONGEST_DELAY:
            problem = f"delay is {reprlib.repr(self.delay)}; it must be 0 to {LONGEST_DELAY} samples"
        elif self.delay and self.memory:
            problem = f"{self.field} has a delay, too; leave it out, or write lag(field, k)"
        elif self.at not in AT:
            problem = f"at is {reprlib.repr(self.at)}; write departure, arrival or both"
        elif self.at != "departure" and (self.delay or self.memory):
            problem = (
                f"at is {self.at}, and it is taken from earlier samples (delay, lag, diff, rate); leave one of them out"
            )
        elif self.judged and (self.delay or self.memory or self.at != "departure"):
            problem = (
                "is judged, and delayed, a memory or not at the departure, which leaves nothing to judge; choose one"
            )
        elif self.valid is not None and not self.valid[0] < self.valid[1]:
            problem = f"valid is {list(self.valid)}; write [least, greatest]"
        elif any(math.isnan(code) for code in self.ignore):
            problem = "ignore lists NaN, which never counts; leave it out"
        else:
            return
        raise SignalError(f"{where}: {problem}")


def _single(value: float) -> float:
    """The nearest number of single precision; the value itself beyond its range."""
    try:
        rounded: float = struct.unpack("f", struct.pack("f", value))[0]
    except OverflowError:
        return value
    return rounded


@dataclass(frozen=True)
class Recalled:
    """A signal that follows from another one's samples.

    `position`: of the signal in [x; u; s]; `of`: of the state or control whose samples they are; `memory`: how it
    follows.
    """

    position: int
    of: int
    memory: Memory


@dataclass(frozen=True)
class ScheduleRule:
    """What a signals file says of one scheduling signal.

    `signal`: A state, a control or a further scheduling signal; `knots`: chosen by what is left out, a number of knots,
    or knots in recorded units; None for modes; `modes`: values of a discrete signal, in recorded units.
    """

    signal: str
    knots: Literal["auto"] | int | tuple[float, ...] | None = None
    modes: tuple[float, ...] = ()
