# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""HorizonRule: over which horizons a fit is to have envelopes, as it is asked for."""

from __future__ import annotations

import reprlib
from dataclasses import dataclass
from typing import Any, Literal, get_args

from uncertain_lti.base.errors import SignalError
from uncertain_lti.signals.file_values import checked_mapping, checked_number

WidthChoice = Literal["auto", "growing", "constant"]
"""Half-widths that grow with |x| and |u|, are the same everywhere, or what holds better on left-out data."""
_KEYS = ("longest", "steps", "seconds")


@dataclass(frozen=True)
class HorizonRule:
    """What a fit is asked for; without a length the longest horizon is chosen as well.

    `longest`: longest horizon, s: a geometric set of horizons up to it, of which those stay that hold on left-out data;
    `steps`: numbers of steps, each at least 2; all stay; `seconds`: the same in s; `widths`: half-widths.
    """

    longest: float | None = None
    steps: tuple[int, ...] = ()
    seconds: tuple[float, ...] = ()
    widths: WidthChoice = "auto"

    def __post_init__(self) -> None:
        given = [key for key in _KEYS if getattr(self, key) not in (None, ())]
        if len(given) > 1:
            raise SignalError(f"horizons: {' and '.join(given)} are given; give one of them")
        if self.widths not in get_args(WidthChoice):
            raise SignalError(f"horizons: widths is {self.widths!r}; write auto, growing or constant")
        for h in self.steps:
            if isinstance(h, bool) or not isinstance(h, int) or h < 2:
                raise SignalError(f"horizons: steps has {reprlib.repr(h)}; write whole numbers of at least 2")
        lengths = [("seconds", value) for value in self.seconds]
        lengths += [] if self.longest is None else [("longest", self.longest)]
        for key, value in lengths:
            if isinstance(value, bool) or not (isinstance(value, (int, float)) and 0.0 < value < float("inf")):
                raise SignalError(f"horizons: {key} has {reprlib.repr(value)}; write seconds above 0")

    @property
    def leaves_out(self) -> bool:
        """Whether something is to be chosen by what is left out of the fit."""
        return self.widths == "auto" or not (self.steps or self.seconds)

    @classmethod
    def of(cls, data: Any, where: str = "horizons") -> HorizonRule:
        """From what a signals file, or an argument of `fit`, has."""
        if isinstance(data, cls):
            return data
        if isinstance(data, str) and data == "auto":
            return cls()
        if isinstance(data, (list, tuple)):
            data = {"steps": list(data)}
        if not isinstance(data, dict):
            raise SignalError(f"{where} is {reprlib.repr(data)}; write auto, or longest, steps or seconds with widths")
        entry = checked_mapping(data, where, {*_KEYS, "widths"})
        lists: dict[str, tuple[Any, ...]] = {}
        for key in ("steps", "seconds"):
            values = entry.get(key)
            if values is None:
                continue
            if not isinstance(values, (list, tuple)) or not values:
                raise SignalError(f"{where}: {key} is {reprlib.repr(values)}; write a list of numbers")
            lists[key] = tuple(values)
        longest = entry.get("longest")
        longest = None if longest in (None, "auto") else checked_number(longest, f"{where}: longest")
        try:
            return cls(longest, **lists, widths=entry.get("widths", "auto"))
        except SignalError as error:
            raise SignalError(f"{where}: {str(error).removeprefix('horizons: ')}") from None
