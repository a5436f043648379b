# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Naming: names and units of the chosen signals."""

from __future__ import annotations

import re
from collections.abc import Sequence

from uncertain_lti.proposal.candidates import OF_QUATERNION, Candidate
from uncertain_lti.recordings.table import TOPIC
from uncertain_lti.signals.functions import FUNCTIONS

_PARTS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")


_DULL = {"pose", "twist", "vector", "data", "point", "transform", "msg", "value", "quaternion", "accel", "wrench"}


_UNITS = (
    *((re.compile(rf"{name}\("), function.unit) for name, function in FUNCTIONS.items() if function.unit),
    (re.compile(r"angular_velocity\.|twist\.angular\.|(^|\.)angular\.[xyz]$"), "rad/s"),
    (re.compile(r"linear_acceleration\."), "m/s^2"),
    (re.compile(r"(^|\.)linear\.[xyz]$"), "m/s"),
    (re.compile(r"pose\.position\.|translation\."), "m"),
    (re.compile(r"fluid_pressure$"), "Pa"),
)


def name_signals(states: Sequence[Candidate], controls: Sequence[Candidate]) -> None:
    """Give every signal a name of its own and a unit."""
    taken: set[str] = set()
    elements = {c.element for c in states} - {""}
    for group, suffix in ((states, "state"), (controls, "command")):
        kinds = {c.kind for c in group}
        for candidate in group:
            words = _words(candidate, len(kinds) > 1)
            name = "_".join(words)
            if name in taken or (suffix == "command" and candidate.element in elements):
                name = f"{name}_{suffix}"
            number = 2
            unique = name
            while unique in taken:
                unique, number = f"{name}_{number}", number + 1
            candidate.name = unique
            taken.add(unique)
            inner = candidate.path
            candidate.unit = next((unit for pattern, unit in _UNITS if pattern.search(inner)), "")


def _words(candidate: Candidate, several_kinds: bool) -> list[str]:
    """Words of a name: those of the path that say something, else the topic's last."""
    if candidate.element:
        words = [re.sub(r"\W+", "_", candidate.element).strip("_") or "entry"]
        return [*words, *_split(candidate.kind)] if several_kinds else words
    inner = re.sub(rf"^(unwrap\()?({OF_QUATERNION})\(.*", r"\2", candidate.path)
    inner = re.sub(rf"^(unwrap|{'|'.join(FUNCTIONS)})\(|\)+$", "", inner)
    words = [w for w in _split(inner) if w not in _DULL]
    if not words or all(len(w) == 1 or w.isdigit() for w in words):
        if candidate.topic != TOPIC:  # that of every table says nothing
            words = [*_split(candidate.topic.rstrip("/").rpartition("/")[2]), *words]
    return words or ["signal"]


def _split(text: str) -> list[str]:
    return [w.lower() for w in _PARTS.findall(text)]
