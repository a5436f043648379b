# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Signal: where one state or control is read, its operating point, and its entry in a signals file."""

from __future__ import annotations

import math
import re
import reprlib
from collections.abc import Callable, Mapping
from ctypes import c_float
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, Literal

from uncertain_lti.base.arrays import LARGEST, LONGEST_S
from uncertain_lti.base.errors import SignalError
from uncertain_lti.base.text import shortlist
from uncertain_lti.signals.field_path import LONGEST_DELAY, FieldPath, Memory, parse_memory
from uncertain_lti.signals.values import (
    CHOICES,
    CHOICES_TEXT,
    HorizonRule,
    TableLayout,
    checked_list,
    checked_mapping,
    checked_number,
    checked_numbers,
    wrong,
)

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
        return memory_of(self.field)[0] is not None

    @property
    def ignored(self) -> frozenset[float]:
        """`ignore`, and its values as single precision rounds them."""
        return frozenset(v for code in self.ignore for v in (code, c_float(code).value))

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
            least = f"it must be 0 s or more, up to {LONGEST_S:g}, or left out for no limit"
            problem = f"max_hold is {self.max_hold}; {least}"
        elif not 0 <= self.delay <= LONGEST_DELAY:
            problem = f"delay is {reprlib.repr(self.delay)}; it must be 0 to {LONGEST_DELAY} samples"
        elif self.delay and self.memory:
            problem = f"{self.field} has a delay, too; leave it out, or write lag(field, k)"
        elif self.at not in AT:
            problem = f"at is {reprlib.repr(self.at)}; write departure, arrival or both"
        elif self.at != "departure" and (self.delay or self.memory):
            earlier = "it is taken from earlier samples (delay, lag, diff, rate)"
            problem = f"at is {self.at}, and {earlier}; leave one of them out"
        elif self.judged and (self.delay or self.memory or self.at != "departure"):
            nothing = "which leaves nothing to judge"
            problem = f"is judged, and delayed, a memory or not at the departure, {nothing}; choose one"
        elif self.valid is not None and not self.valid[0] < self.valid[1]:
            problem = f"valid is {list(self.valid)}; write [least, greatest]"
        elif any(math.isnan(code) for code in self.ignore):
            problem = "ignore lists NaN, which never counts; leave it out"
        else:
            return
        raise SignalError(f"{where}: {problem}")


def memory_of(field: object) -> tuple[Memory | None, str]:
    """The memory that a field is, and of what; what is no field path is refused later, by the signal's name."""
    try:
        return parse_memory(str(field))
    except SignalError:
        return None, ""


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


STEP_CHOICES = "recorded, constant, or the period in seconds"
"""What `step` may be."""
LISTS = ("states", "controls", "scheduling")
"""Keys of lists of signals."""
Reader = Callable[[Any, str], Any]
"""Takes a value and where it stands, and returns what the map or the signal has of it."""


def map_arguments(data: Any, source: str, need_topics: bool) -> dict[str, Any]:
    """Arguments of a `SignalMap` from the structure of a signals file; the sentence of an error names the key.

    What is null is as if it were left out.
    """
    entry = partial(_signal, need_topics)
    readers = _OF_THE_MAP | dict.fromkeys(LISTS, lambda listed, where: checked_list(listed, where, entry))
    top = expand(checked_mapping(data, source, {*readers}), source)
    top |= _with_memories(top)
    found = {key: readers[key](value, f"{source}: {key}") for key, value in top.items() if value is not None}
    listed = (entry for entry in top.get("controls") or () if isinstance(entry, dict))
    given = {"source": source, "ends_given": any(entry.get("at") is not None for entry in listed)}
    return {"states": (), "time": found.pop("topics", {}), **given, **found}


def _signal(need_topics: bool, data: Any, where: str) -> Signal:
    known = {f.name for f in fields(Signal)}
    entry = {key: value for key, value in checked_mapping(data, where, known).items() if value is not None}
    for key in ("name", "topic", "field"):
        if key not in entry:
            raise SignalError(f"{where}: '{key}' is missing; every signal has a name, a topic and a field")
        if not isinstance(entry[key], str) or not (entry[key] or (key == "topic" and not need_topics)):
            raise wrong(f"{where}: '{key}'", entry[key], "a text, in quotes")
    for key, reader in _OF_A_SIGNAL.items():
        if key in entry:
            entry[key] = reader(entry[key], f"{where}: {key}")
    return Signal(**entry)


def _that(fits: Callable[[Any], bool], write: str) -> Reader:
    def reader(value: Any, where: str) -> Any:
        if not fits(value):
            raise wrong(where, value, write)
        return value

    return reader


def _one_of(write: str, *values: str) -> Reader:
    return _that(lambda value: value in values, write)


def _of_type(write: str, *kinds: type) -> Reader:
    return _that(lambda v: isinstance(v, kinds) and (bool in kinds or not isinstance(v, bool)), write)


def _number_or_auto(value: Any, where: str) -> Any:
    return "auto" if value == "auto" else checked_number(value, where)


def _text(value: Any, where: str) -> str:
    return str(_of_type("a text, in quotes", str, int, float)(value, where))  # a unit of 1 is read as a number


def _range(value: Any, where: str) -> tuple[float, ...]:
    """Least and greatest value; null is no limit."""
    if not isinstance(value, list) or len(value) != 2:
        raise wrong(where, value, "[least, greatest]")
    ends = enumerate(zip(value, (-math.inf, math.inf), strict=True))
    return tuple(none if end is None else checked_number(end, f"{where}[{i}]") for i, (end, none) in ends)


def _ignored(value: Any, where: str) -> tuple[float, ...]:
    return () if value == [] else checked_numbers(value if isinstance(value, (list, dict)) else [value], where)


def _step(value: Any, where: str) -> Any:
    try:
        return value if value in ("recorded", "constant") else checked_number(value, where)
    except SignalError:
        raise wrong(where, value, STEP_CHOICES) from None


def _times(data: Any, where: str) -> dict[str, Any]:
    time = _one_of("header or log", "header", "log")
    topics = checked_mapping(data, where, None)
    options = {topic: checked_mapping(of, f"{where}: {topic}", {"time"}) for topic, of in topics.items()}
    return {topic: time(of.get("time"), f"{where}: {topic}: time") for topic, of in options.items()}


def _rule(data: Any, where: str) -> ScheduleRule:
    entry = checked_mapping(data, where, {"signal", "knots", "modes"})
    signal, knots, modes = entry.get("signal"), entry.get("knots"), entry.get("modes")
    if not isinstance(signal, str):
        raise wrong(f"{where}: 'signal'", signal, "the name of a signal")
    if (knots is None) == (modes is None):
        raise SignalError(f"{where}: write knots (auto, a number, or a list) or modes (a list), one of the two")
    if modes is not None:  # those of a flag, as its field is read
        values = [int(v) if isinstance(v, bool) else v for v in modes] if isinstance(modes, list) else modes
        return ScheduleRule(signal, None, checked_numbers(values, f"{where}: modes"))
    if isinstance(knots, list):
        return ScheduleRule(signal, checked_numbers(knots, f"{where}: knots"))
    if knots != "auto" and (isinstance(knots, bool) or not isinstance(knots, int) or knots < 1):
        raise wrong(f"{where}: knots", knots, "auto, a number, or a list of knots")
    return ScheduleRule(signal, knots)


_OF_A_SIGNAL: Mapping[str, Reader] = {
    "steady": _number_or_auto, "scale": _number_or_auto, "unit": _text, "type": _text, "max_hold": checked_number,
    "delay": _of_type("a whole number of samples", int), "valid": _range, "ignore": _ignored,
    "judged": _of_type("true or false", bool),
}  # fmt: skip
_OF_THE_MAP: dict[str, Reader] = {
    "topics": _times,
    "additive": _one_of(CHOICES_TEXT, *CHOICES),
    "clock": _of_type("the name of a state topic", str),
    "max_gap": checked_number,
    "min_step": checked_number,
    "max_skew": checked_number,
    "step": _step,
    "schedule": lambda data, where: checked_list(data, where, _rule),
    "horizons": lambda data, where: HorizonRule.of(data, where),
    "table": TableLayout.from_dict,
    "structure": lambda data, where: data,  # which `identification.structure` reads
}


def _with_memories(top: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Lists of signals in which a memory has the scale, unit and, of a lag, steady state of the listed field."""
    lists = {key: top[key] for key in LISTS if isinstance(top.get(key), list)}
    entries = [e for of_list in lists.values() for e in of_list if isinstance(e, dict)]
    listed = {(str(e.get("topic")), str(e.get("field")).strip()): e for e in reversed(entries)}

    def filled(entry: Any) -> Any:
        memory, inner = memory_of(entry.get("field")) if isinstance(entry, dict) else (None, "")
        if memory is None or (of := listed.get((str(entry.get("topic")), inner))) is None:
            return entry
        own = {"scale": of.get("scale", 1.0), "unit": memory.unit(str(of.get("unit") or ""))}
        own |= {"steady": of["steady"]} if memory.kind == "lag" and "steady" in of else {}
        return own | entry

    return {key: [filled(entry) for entry in of_list] for key, of_list in lists.items()}


PLACE = "{}"
"""What an entry has in the place of the member that it is for."""
MOST_MEMBERS = 1000
"""Members of a `for` list."""
OWN = "own"
"""The structure in which each state depends on the signals of its own member, and on those of none."""
_COUNTED = re.compile(r"(.*?)(\d+)")


def expand(top: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Write out what stands for many alike.

    An entry of `states`, `controls`, `scheduling` or `structure` with the key `for` stands for one entry per member,
    which has the member in the place of each `{}`. `structure: own`, alone or as the first of the rules, fixes to 0
    what a state of one member takes from the signals of another.
    """
    found = dict(top)
    member: dict[str, str] = {}
    for key in (*LISTS, "structure"):
        if not isinstance(found.get(key), list):
            continue
        entries: list[Any] = []
        unique = "state" if key == "structure" else "name"
        for position, entry in enumerate(found[key]):
            if not isinstance(entry, dict) or "for" not in entry:
                entries.append(entry)
                continue
            here = f"{source}: {key}[{position}]"
            members = members_of(entry["for"], f"{here}: for")
            plain = {name: value for name, value in entry.items() if name != "for"}
            if len(members) > 1 and PLACE not in str(plain.get(unique, "")):
                same = f"{unique} is {reprlib.repr(plain.get(unique))}, the same for all of {shortlist(members, 3)}"
                raise SignalError(f"{here}: {same}; write {PLACE} where the member goes, in quotes")
            for one in members:
                written = {k: v.replace(PLACE, one) if isinstance(v, str) else v for k, v in plain.items()}
                entries.append(written)
                if key != "structure":
                    member[str(written.get("name"))] = one
        found[key] = entries
    structure = found.get("structure")
    rules = [structure] if structure == OWN else structure
    if isinstance(rules, list) and rules[:1] == [OWN]:
        if not member:
            raise SignalError(f"{source}: structure: own tells the members of `for` entries apart, and there are none")
        found["structure"] = [*_own(found, member), *rules[1:]]
    return found


def members_of(value: Any, where: str) -> list[str]:
    """Members of a `for` list; `...` between two that are counted stands for those between."""
    if not isinstance(value, list) or not value:
        raise wrong(where, value, "a list, such as [j0, ..., j11]")
    if any(isinstance(v, bool) or not isinstance(v, (str, int)) or v == "" for v in value):
        raise wrong(where, value, "names or whole numbers")
    members: list[str] = []
    texts = [str(v) for v in value]
    for i, text in enumerate(texts):
        if text != "...":
            members.append(text)
            continue
        first, last = (_COUNTED.fullmatch(texts[k]) if 0 <= k < len(texts) else None for k in (i - 1, i + 1))
        if first is None or last is None or first[1] != last[1] or not int(first[2]) < int(last[2]):
            raise SignalError(f"{where}: '...' stands between two that are counted, such as [j0, ..., j11]")
        if int(last[2]) - int(first[2]) > MOST_MEMBERS:
            raise SignalError(f"{where}: over {MOST_MEMBERS} members; write fewer")
        digits = len(first[2]) if first[2].startswith("0") else 1
        members += [f"{first[1]}{number:0{digits}}" for number in range(int(first[2]) + 1, int(last[2]))]
    if len(set(members)) < len(members):
        raise SignalError(f"{where}: a member is listed twice; keep one")
    return members


def _own(top: Mapping[str, Any], member: Mapping[str, str]) -> list[dict[str, Any]]:
    """Rules that leave each state the signals of its own member, and those of none."""
    states, controls = ([e for e in top.get(key) or [] if isinstance(e, dict)] for key in ("states", "controls"))
    names = [str(e.get("name")) for e in (*states, *controls)]
    judged = [e for e in controls if e.get("judged") is True]
    rows = [str(e.get("name")) for e in (*states, *judged) if memory_of(e.get("field"))[0] is None]
    pairs = ((state, other) for state in rows for other in names if state in member and other in member)
    apart = ((state, other) for state, other in pairs if member[state] != member[other])
    return [{"state": state, "from": other, "nominal": 0, "half_width": 0} for state, other in apart]
