# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Entries of a signals file, checked, as what a `SignalMap` is made of."""

from __future__ import annotations

import contextlib
import math
import re
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, Literal

from uncertain_lti.base.english import shortlist
from uncertain_lti.base.errors import SignalError
from uncertain_lti.signals.choices import CHOICES, CHOICES_TEXT, HorizonRule, TableLayout
from uncertain_lti.signals.file_values import checked_mapping, checked_number, kind_in_yaml
from uncertain_lti.signals.functions import parse_memory
from uncertain_lti.signals.signal import ScheduleRule, Signal

STEP_CHOICES = "recorded, constant, or the period in seconds"
"""What `step` may be."""
LISTS = ("states", "controls", "scheduling")
"""Keys of lists of signals."""
_NUMBERS = ("max_gap", "min_step", "max_skew")
_KEYS = {*LISTS, *_NUMBERS, "clock", "step", "additive", "schedule", "horizons", "structure", "table", "topics"}


def map_arguments(data: Any, source: str, need_topics: bool) -> dict[str, Any]:
    """Arguments of a `SignalMap` from the structure of a signals file; the sentence of an error names the key."""
    top = checked_mapping(data, source, _KEYS)
    time = {}
    for topic, options in checked_mapping(top.get("topics") or {}, f"{source}: topics", None).items():
        time[topic] = checked_mapping(options, f"{source}: topics: {topic}", {"time"}).get("time")
        if time[topic] not in ("header", "log"):
            raise SignalError(f"{source}: topics: {topic}: time is {reprlib.repr(time[topic])}; write header or log")
    top = expand(top, source)
    top = top | _with_memories(top)
    found: dict[str, Any] = {key: top.get(key) for key in ("additive", "clock", "structure")}
    if found["additive"] not in (None, *CHOICES):
        raise SignalError(f"{source}: additive is {reprlib.repr(found['additive'])}; write {CHOICES_TEXT}")
    if found["clock"] is not None and not isinstance(found["clock"], str):
        raise SignalError(f"{source}: clock is {reprlib.repr(found['clock'])}; write the name of a state topic")
    found |= {key: _signals(top.get(key), f"{source}: {key}", need_topics) for key in LISTS}
    found |= {key: checked_number(top.get(key), f"{source}: {key}") for key in _NUMBERS}
    horizons, table = top.get("horizons"), top.get("table")
    return {
        **found,
        "min_step": found["min_step"] or 0.0,
        "step": _step(top.get("step"), f"{source}: step"),
        "time": time,
        "schedule": _schedule(top.get("schedule"), f"{source}: schedule"),
        "horizons": None if horizons is None else HorizonRule.of(horizons, f"{source}: horizons"),
        "table": None if table is None else TableLayout.from_dict(table, f"{source}: table"),
        "source": source,
    }


def _with_memories(top: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Lists of signals in which a memory has the scale, unit and, of a lag, steady state of the listed field."""
    lists = {key: top[key] for key in ("states", "controls", "scheduling") if isinstance(top.get(key), list)}
    entries = [
        e for entries in lists.values() for e in entries if isinstance(e, dict) and isinstance(e.get("field"), str)
    ]
    listed = {(str(e.get("topic")), e["field"].strip()): e for e in reversed(entries)}
    found: dict[str, list[Any]] = {}
    for key, of_list in lists.items():
        found[key] = []
        for entry in of_list:
            memory = of = None
            if any(entry is e for e in entries):
                with contextlib.suppress(SignalError):  # refused later, by the name of the signal
                    memory, inner = parse_memory(entry["field"])
                    of = listed.get((str(entry.get("topic")), inner))
            if memory is not None and of is not None:
                unit = str(of.get("unit") or "")
                own = {"scale": of.get("scale", 1.0), "unit": f"{unit}/s" if unit and memory.kind == "rate" else unit}
                own |= {"steady": of["steady"]} if memory.kind == "lag" and "steady" in of else {}
                entry = own | entry
            found[key].append(entry)
    return found


def _step(value: Any, where: str) -> Literal["recorded", "constant"] | float:
    if value is None or value == "recorded":
        return "recorded"
    if value == "constant":
        return "constant"
    try:
        number = checked_number(value, where)
    except SignalError:
        raise SignalError(f"{where} is {reprlib.repr(value)}; write {STEP_CHOICES}") from None
    assert number is not None
    return number


def _limits(entry: dict[str, Any], where: str) -> None:
    """Numbers of `valid` and `ignore` in the place of what the file has; null is no limit."""
    for key in ("valid", "ignore"):
        if entry.get(key) is None:
            entry.pop(key, None)
            continue
        value = entry[key]
        if key == "ignore" and not isinstance(value, (list, dict)):
            value = [value]
        if not isinstance(value, list) or (key == "valid" and len(value) != 2):
            wanted = "[least, greatest]" if key == "valid" else "a list of numbers"
            raise SignalError(f"{where}: {key} is {reprlib.repr(value)}; write {wanted}")
        numbers = [checked_number(v, f"{where}: {key}[{i}]") for i, v in enumerate(value)]
        if key == "valid":
            low, high = numbers
            entry[key] = (-math.inf if low is None else low, math.inf if high is None else high)
        elif None in numbers:
            raise SignalError(f"{where}: ignore has an empty entry; write a number")
        else:
            entry[key] = tuple(numbers)


def _schedule(data: Any, where: str) -> tuple[ScheduleRule, ...]:
    if data is None:
        return ()
    if not isinstance(data, list):
        raise SignalError(f"{where}: a list is wanted here, not {kind_in_yaml(data)}; see config/signals/")
    rules = []
    for position, entry in enumerate(data):
        here = f"{where}[{position}]"
        entry = checked_mapping(entry, here, {"signal", "knots", "modes"})
        if not isinstance(entry.get("signal"), str):
            raise SignalError(f"{here}: 'signal' is {reprlib.repr(entry.get('signal'))}; write the name of a signal")
        knots, modes = entry.get("knots"), entry.get("modes")
        if (knots is None) == (modes is None):
            raise SignalError(f"{here}: write knots (auto, a number, or a list) or modes (a list), one of the two")
        if knots is not None and knots != "auto" and not isinstance(knots, list):
            if isinstance(knots, bool) or not isinstance(knots, int) or knots < 1:
                raise SignalError(f"{here}: knots is {reprlib.repr(knots)}; write auto, a number, or a list of knots")
            rules.append(ScheduleRule(entry["signal"], knots))
        elif knots == "auto":
            rules.append(ScheduleRule(entry["signal"], "auto"))
        else:
            which, values = ("knots", knots) if modes is None else ("modes", modes)
            if not isinstance(values, list) or not values:
                raise SignalError(f"{here}: {which} is {reprlib.repr(values)}; write a list of numbers")
            if modes is not None:  # those of a flag, as its field is read
                values = [int(v) if isinstance(v, bool) else v for v in values]
            numbers = [checked_number(v, f"{here}: {which}[{i}]") for i, v in enumerate(values)]
            if None in numbers:
                raise SignalError(f"{here}: {which} has an empty entry; write a number")
            listed = tuple(v for v in numbers if v is not None)
            rules.append(ScheduleRule(entry["signal"], *((listed,) if modes is None else (None, listed))))
    return tuple(rules)


def _signals(data: Any, where: str, need_topics: bool) -> tuple[Signal, ...]:
    if data is None:
        return ()
    if not isinstance(data, list):
        raise SignalError(f"{where}: a list is wanted here, not {kind_in_yaml(data)}; see config/signals/")
    known = {f.name for f in fields(Signal)}
    signals = []
    for position, entry in enumerate(data):
        here = f"{where}[{position}]"
        entry = dict(checked_mapping(entry, here, known))
        for key in ("name", "topic", "field"):
            if not isinstance(entry.get(key), str) or not (entry[key] or (key == "topic" and not need_topics)):
                if entry.get(key) is None:
                    raise SignalError(f"{here}: '{key}' is missing; every signal has a name, a topic and a field")
                raise SignalError(f"{here}: '{key}' is {reprlib.repr(entry.get(key))}; write a text, in quotes")
        for key in ("steady", "scale"):
            if key in entry and entry[key] != "auto":
                number = checked_number(entry[key], f"{here}: {key}")
                entry[key] = number if number is not None else {"steady": 0.0, "scale": 1.0}[key]
        _limits(entry, here)
        for key in ("at", "judged"):
            if entry.get(key) is None:
                entry.pop(key, None)
        if not isinstance(entry.get("judged", False), bool):
            raise SignalError(f"{here}: judged is {reprlib.repr(entry['judged'])}; write true or false")
        if "max_hold" in entry:
            entry["max_hold"] = checked_number(entry["max_hold"], f"{here}: max_hold")
        delay = entry.get("delay", 0)
        if isinstance(delay, bool) or not isinstance(delay, int):
            raise SignalError(f"{here}: delay is {reprlib.repr(delay)}; write a whole number of samples")
        for key in ("unit", "type"):
            text = entry.get(key)
            if isinstance(text, bool) or not isinstance(text, (str, int, float, type(None))):
                raise SignalError(f"{here}: {key} is {reprlib.repr(text)}; write a text, in quotes")
            entry[key] = "" if text is None else str(text)  # a unit of 1 is read as a number
        signals.append(Signal(**entry))
    return tuple(signals)


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
    for key in ("states", "controls", "scheduling", "structure"):
        if not isinstance(found.get(key), list):
            continue
        entries: list[Any] = []
        for position, entry in enumerate(found[key]):
            if not isinstance(entry, dict) or "for" not in entry:
                entries.append(entry)
                continue
            here = f"{source}: {key}[{position}]"
            members = members_of(entry["for"], f"{here}: for")
            plain = {name: value for name, value in entry.items() if name != "for"}
            unique = "state" if key == "structure" else "name"
            if len(members) > 1 and PLACE not in str(plain.get(unique, "")):
                raise SignalError(
                    f"{here}: {unique} is {reprlib.repr(plain.get(unique))}, the same for all of "
                    f"{shortlist(members, 3)}; write {PLACE} where the member goes, in quotes"
                )
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
        raise SignalError(f"{where} is {reprlib.repr(value)}; write a list, such as [j0, ..., j11]")
    if any(isinstance(v, bool) or not isinstance(v, (str, int)) or v == "" for v in value):
        raise SignalError(f"{where} is {reprlib.repr(value)}; write names or whole numbers")
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
    lists: Sequence[Any] = [e for key in ("states", "controls") for e in top.get(key) or [] if isinstance(e, dict)]
    names = [str(e.get("name")) for e in lists]
    judged = [e for e in top.get("controls") or [] if isinstance(e, dict) and e.get("judged") is True]
    rows = [e for e in [*(top.get("states") or []), *judged] if isinstance(e, dict) and not _remembers(e)]
    states = [str(e.get("name")) for e in rows]
    return [
        {"state": state, "from": other, "nominal": 0, "half_width": 0}
        for state in states
        for other in names
        if state in member and other in member and member[state] != member[other]
    ]


def _remembers(entry: Mapping[str, Any]) -> bool:
    """Whether it is a lag, diff or rate, which has no row; what is no field path is refused later."""
    try:
        return parse_memory(str(entry.get("field")))[0] is not None
    except SignalError:
        return False
