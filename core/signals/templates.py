# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Templates: entries of a signals file that stand for many alike, as for the joints of a robot."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Mapping, Sequence
from typing import Any

from uncertain_lti.base.english import shortlist
from uncertain_lti.base.errors import SignalError
from uncertain_lti.signals.memory import parse_memory

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
