# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Choices of whoever fits: the additive term, horizons, and which columns of a table are its time and runs."""

from __future__ import annotations

import reprlib
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

from uncertain_lti.base.errors import SignalError
from uncertain_lti.base.text import meant
from uncertain_lti.signals.file_values import checked_mapping, checked_number, wrong

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
            raise wrong(where, data, "auto, or longest, steps or seconds with widths")
        entry = {k: v for k, v in checked_mapping(data, where, {*_KEYS, "widths"}).items() if v is not None}
        for key in ("steps", "seconds"):
            if key in entry:
                if not isinstance(entry[key], (list, tuple)) or not entry[key]:
                    raise wrong(f"{where}: {key}", entry[key], "a list of numbers")
                entry[key] = tuple(entry[key])
        if entry.get("longest") == "auto":
            del entry["longest"]
        elif "longest" in entry:
            entry["longest"] = checked_number(entry["longest"], f"{where}: longest")
        try:
            return cls(**entry)
        except SignalError as error:
            raise SignalError(f"{where}: {str(error).removeprefix('horizons: ')}") from None


Additive = Literal["none", "disturbance", "noise", "both"]
CHOICES: tuple[Additive, ...] = get_args(Additive)
CHOICES_TEXT = f"{', '.join(CHOICES[:-1])} or {CHOICES[-1]}"
"""The choices as a part of a sentence."""


UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
"""Units of time that a column of numbers can have, with their nanoseconds."""

TimeUnit = Literal["s", "ms", "us", "ns"]


@dataclass(frozen=True, slots=True)
class TableLayout:
    """Which columns of a table (CSV, Parquet, .mat, .npz) say when and in which run a row was recorded.

    `time`: column of the time; None to look for one; `unit`: unit of a time column of numbers; None to take it from the
    column's name and size; `runs`: column whose values tell the recordings in one file apart; None where a file is one
    recording.
    """

    time: str | None = None
    unit: TimeUnit | None = None
    runs: str | None = None

    @classmethod
    def from_dict(cls, data: Any, where: str) -> TableLayout:
        """Build from the structure of a signals file or a model file."""
        given = {k: v for k, v in checked_mapping(data, where, {"time", "unit", "runs"}).items() if v is not None}
        for key in {"time", "runs"} & given.keys():
            if isinstance(given[key], bool) or not isinstance(given[key], (str, int, float)) or not given[key]:
                raise wrong(f"{where}: {key}", given[key], "the name of a column, in quotes")
            given[key] = str(given[key])
        if (unit := given.get("unit", "s")) not in tuple(UNITS):  # which may be no text
            near = meant(str(unit), UNITS)
            raise SignalError(f"{where}: unit is {reprlib.repr(unit)}{near}; write one of {', '.join(UNITS)}")
        return cls(**given)

    def to_dict(self) -> dict[str, str]:
        """Return what `from_dict` takes, without what is left open."""
        return {key: value for key, value in asdict(self).items() if value is not None}
