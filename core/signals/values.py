# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Values that a person gives: those of a YAML file, checked, and the choices of whoever fits."""

from __future__ import annotations

import math
import os
import re
import reprlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, TextIO, TypeVar, get_args

from uncertain_lti.base.errors import SignalError
from uncertain_lti.base.files import kind_of
from uncertain_lti.base.text import meant

T = TypeVar("T")
_ODD = re.compile(r"[-+]?0[0-7_]+|.*[:_].*")  # octal, sexagesimal, with underscores


class RepeatedKeyError(ValueError):
    """A key is twice in one mapping, of which YAML readers keep the last."""


def read_yaml(text: str | TextIO) -> Any:
    """What a text stands for, without aliases; `010` and `1:30`, 8 and 90 by YAML 1.1, stay the words they are."""
    import yaml  # the live node reads signals from the model file and needs no YAML

    class Loader(yaml.SafeLoader):
        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
                raise yaml.composer.ComposerError(None, None, "an alias (*name); write out what it stands for", mark)
            node: Any = super().compose_node(parent, index)
            if str(node.tag).endswith((":int", ":float")) and _ODD.fullmatch(node.value):
                node.tag = "tag:yaml.org,2002:str"
            return node

        def compose_mapping_node(self, anchor: Any) -> Any:
            node: Any = super().compose_mapping_node(anchor)
            seen: set[str] = set()
            for key, _ in node.value:
                if str(key.value) in seen:
                    again = f"again at line {key.start_mark.line + 1}"
                    raise RepeatedKeyError(f"key '{key.value}' is twice in one mapping, {again}; keep one")
                seen.add(str(key.value))
            return node

    return yaml.load(text, Loader=Loader)


def load_yaml(path: str | os.PathLike[str]) -> Any:
    """Read the structure of a signals file."""
    import yaml  # the live node reads signals from the model file and needs no YAML

    if (kind := kind_of(path)) and kind != "a signals file":
        cures = {"a folder": "name a file in it", "a pipe or a device": "write it to a file first"}
        remedy = cures.get(kind, "are the arguments swapped?")
        raise SignalError(f"{path}: this is {kind}, and a signals file is wanted here; {remedy}")
    try:
        with open(path, encoding="utf-8") as stream:
            data = read_yaml(stream)
    except RepeatedKeyError as error:
        raise SignalError(f"{path}: {error}") from None
    except FileNotFoundError:
        raise SignalError(f"{path}: there is no such signals file; check the path") from None
    except OSError as error:
        raise SignalError(f"{path}: cannot be read: {error.strerror}; check the path") from None
    except UnicodeDecodeError as error:
        raise SignalError(f"{path}: is not UTF-8 at byte {error.start + 1}; save it as UTF-8 text") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # ValueError: a date 2001-99-99
        mark = getattr(error, "problem_mark", None)
        line = f" at line {mark.line + 1}" if mark else ""
        problem = str(getattr(error, "problem", None) or error).splitlines()[0]
        raise SignalError(f"{path}: is not YAML{line}: {problem}; mend it") from None
    if data is None:
        remedy = "list the states and controls, or let `uncertain-lti init` propose them"
        raise SignalError(f"{path}: nothing is in it; {remedy}")
    return data


def checked_mapping(data: Any, where: str, known: set[str] | None) -> dict[str, Any]:
    """Check that a value is a mapping with known keys."""
    if not isinstance(data, dict):
        raise SignalError(f"{where}: a mapping is wanted here, not {kind_in_yaml(data)}; see config/signals/")
    for key in data:
        if known is not None and key not in known:
            comma = isinstance(key, int) and data[key] is None  # {steady: 1,5}
            remedy = "write decimals with a point" if comma else f"known are {', '.join(sorted(known))}"
            raise SignalError(f"{where}: unknown key {reprlib.repr(key)}{meant(key, known)}; {remedy}")
    return data


def kind_in_yaml(data: object) -> str:
    """Name what a value is in the words of YAML."""
    names = {dict: "a mapping", list: "a list", str: "a text", bool: "a truth value", type(None): "nothing"}
    return names.get(type(data), "a number" if isinstance(data, (int, float)) else type(data).__name__)


def wrong(where: str, value: object, write: str) -> SignalError:
    """The error for a value that cannot stand where it does."""
    return SignalError(f"{where} is {reprlib.repr(value)}; write {write}")


def checked_number(value: Any, where: str) -> float:
    """Check that a value is a number."""
    try:
        number = math.nan if isinstance(value, bool) or not isinstance(value, (str, int, float)) else float(value)
    except (ValueError, OverflowError):
        number = math.nan
    if math.isnan(number):
        raise wrong(where, value, "a number")
    return number


def checked_numbers(values: Any, where: str) -> tuple[float, ...]:
    """Check that a value is a list of numbers."""
    if not isinstance(values, (list, tuple)) or not values:
        raise wrong(where, values, "a list of numbers")
    return tuple(checked_number(value, f"{where}[{i}]") for i, value in enumerate(values))


def checked_list(data: Any, where: str, entry: Callable[[Any, str], T]) -> tuple[T, ...]:
    """Check that a value is a list, of entries that `entry` takes with their places."""
    if not isinstance(data, list):
        raise SignalError(f"{where}: a list is wanted here, not {kind_in_yaml(data)}; see config/signals/")
    return tuple(entry(one, f"{where}[{i}]") for i, one in enumerate(data))


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


Criterion = Literal["qp", "lp"]
CRITERIA: dict[Criterion, str] = {"qp": "(10), least squared widths", "lp": "(11), least largest width"}
"""What a fit minimises, in words."""
Additive = Literal["none", "disturbance", "noise", "both"]
CHOICES: dict[Additive, str] = {"none": "", "disturbance": "c dc", "noise": "v", "both": "c dc v"}
"""Arrays of the additive terms that are unknown with each choice."""
CHOICES_TEXT = " or ".join(", ".join(CHOICES).rsplit(", ", 1))
"""The choices as a part of a sentence."""


UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1, "min": 60 * 10**9, "h": 3600 * 10**9, "d": 86400 * 10**9}
"""Units of time that a column of numbers can have, with their nanoseconds."""

TABLE_TOPIC, TABLE = "/table", "table"
"""The topic of a table, below which those of the messages of a log are, and its message type."""

TimeUnit = Literal["s", "ms", "us", "ns", "min", "h", "d"]


def of_table(topic: str) -> bool:
    """Whether a topic is that of a table, or of a message in one."""
    return f"{topic}/".startswith(f"{TABLE_TOPIC}/")


@dataclass(frozen=True, slots=True)
class TableLayout:
    """Which columns of a table (CSV, Parquet, .mat, .npz) say when and in which run a row was recorded.

    `time`: column of the time; None to look for one; `unit`: unit of a time column of numbers; None to take it from the
    column's name and size; `runs`: column whose values tell the recordings in one file apart; None where a file is one
    recording; `step`: s from row to row, where no column is a time; `words`: of columns of words, such as a status, by
    their names the words, the usual one first: NAME_WORD of each of the others is 1 where it stands, else 0, and no
    number where no word stands.
    """

    time: str | None = None
    unit: TimeUnit | None = None
    runs: str | None = None
    step: float | None = None
    words: Mapping[str, Sequence[str]] | None = None

    @classmethod
    def from_dict(cls, data: Any, where: str) -> TableLayout:
        """Build from the structure of a signals file or a model file."""
        keys = {"time", "unit", "step", "runs", "words"}
        given = {k: v for k, v in checked_mapping(data, where, keys).items() if v is not None}
        for key in {"time", "runs"} & given.keys():
            if isinstance(given[key], bool) or not isinstance(given[key], (str, int, float)) or not given[key]:
                raise wrong(f"{where}: {key}", given[key], "the name of a column, in quotes")
            given[key] = str(given[key])
        if (unit := given.get("unit", "s")) not in tuple(UNITS):  # which may be no text
            near = meant(str(unit), UNITS)
            raise SignalError(f"{where}: unit is {reprlib.repr(unit)}{near}; write one of {', '.join(UNITS)}")
        if "step" in given:
            given["step"] = checked_number(given["step"], f"{where}: step")
            if not 1e-9 <= given["step"] < 1e9:
                raise wrong(f"{where}: step", given["step"], "the s from row to row, such as 0.01")
            if beside := sorted({"time", "unit"} & given.keys()):
                raise SignalError(f"{where}: step is of rows without a time, and {beside[0]} of a time; take one away")
        for column, words in checked_mapping(given.get("words", {}), f"{where}: words", None).items():
            if not (isinstance(words, list) and words and all(isinstance(word, str) for word in words)):
                raise wrong(f"{where}: words of {column}", words, 'a list of words in quotes, such as ["Run", "Stop"]')
        return cls(**given)

    def to_dict(self) -> dict[str, Any]:
        """Return what `from_dict` takes, without what is left open."""
        return {key: value for key, value in asdict(self).items() if value is not None}
