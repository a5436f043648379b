# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Candidates: the topics of recordings, and their numbers that could be signals."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.recordings.recording import usual_step
from uncertain_lti.signals.functions import FUNCTIONS, QUATERNION

FEWEST = 20
"""Messages that a topic needs, and samples that a signal must leave its usual value in a fortieth of."""

OF_QUATERNION = "|".join(name for name, function in FUNCTIONS.items() if function.takes is QUATERNION)
"""Functions of a quaternion, as part of a regular expression."""
WRAPPING = "|".join(name for name, function in FUNCTIONS.items() if function.wraps)
"""Functions that give an angle which jumps by a turn, likewise."""


@dataclass
class Candidate:
    """One number of a topic that could be a signal.

    `topic`: its topic; `path`: of the number in the message, as `FieldPath` reads it; `values` (messages,): one array
    per recording; NaN where there is none; `name`: of the signal, once it is chosen; `unit`: of the signal; empty where
    it is unknown; `reason`: why it is not proposed; empty if it is, or if there is no reason against it; `ready`:
    `state` or `control` for one that a person may well want back; empty for others; `steady`: steady state, recorded
    units; `scale`: scale, recorded units; `delay`: samples by which the states follow a control later; `ignore`: values
    that stand for none; `why`: why it is proposed; empty where its place in the file says it; `judged`: it is a control
    that is judged as well.
    """

    topic: str
    path: str
    values: list[Array] = field(default_factory=list, repr=False)
    name: str = ""
    unit: str = ""
    reason: str = ""
    ready: str = ""
    steady: float = 0.0
    scale: float = 1.0
    delay: int = 0
    ignore: tuple[float, ...] = ()
    why: str = ""
    judged: bool = False

    @property
    def element(self) -> str:
        """Name of the entry it is (`j0` of `position[j0]`), or ""."""
        match = re.search(r'\["?([^\[\]"]+)"?\]$', self.path)
        return match[1] if match and not match[1].isdigit() else ""

    @property
    def family(self) -> tuple[str, str]:
        """Topic and path without the axis or the number: what the axes of one body and its motors have in common."""
        alike = re.sub(r"(?<=[\w.])[xyz]$", "*", self.path)
        if alike == self.path and re.match(r"(?!data\b)[^\W\d]{2}", self.path.rpartition(".")[2]):
            alike = re.sub(r"\d+", "*", self.path)
        return self.topic, alike

    @property
    def kind(self) -> str:
        """Path without the entry: `position` of `position[j0]`."""
        return self.path.partition("[")[0]


@dataclass
class Source:
    """One topic: its times per recording, what it seems to be, and its numbers.

    `topic`: its name; `type`: message type, `pkg/msg/Type`; `role`: `control`, `reference` (of some controller),
    `state`, empty (unknown), `apart` (neither) or `guess` (a control by its effect); `stamped`: whether header stamps
    can be used; `offset`: median of log time less header stamp, s; None without a stamp; `arrival` (messages,): log
    times per recording, ns; `stamp` (messages,): header stamps per recording, ns; negative for none; `candidates`: its
    numbers; `reason`: why none of them is proposed; empty otherwise; `halting`: its header stamps mostly repeat the one
    before.
    """

    topic: str
    type: str
    role: str
    stamped: bool
    offset: float | None
    arrival: list[NDArray[np.int64]] = field(default_factory=list, repr=False)
    stamp: list[NDArray[np.int64]] = field(default_factory=list, repr=False)
    candidates: list[Candidate] = field(default_factory=list)
    reason: str = ""
    halting: bool = False

    @property
    def count(self) -> int:
        """Messages of all recordings."""
        return sum(len(a) for a in self.arrival)

    @cached_property
    def rate(self) -> float:
        """Messages per second, by the usual step (`usual_step`), 1/s."""
        runs = [a for a in self.arrival if len(a) > 1]
        steps = np.concatenate([np.diff(a) for a in runs]) if runs else np.empty(0)
        span = sum(float(a[-1] - a[0]) for a in runs)
        step, _ = usual_step(float(np.median(steps)), span, len(steps)) if span > 0 else (0.0, False)
        return 1e9 / step if step > 0 else 0.0

    def instants(self, clock: Source, number: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Times of this topic's messages and another one's by one clock: stamps where both have them, else arrival.

        Returns (messages,): of this topic, ns; Returns (messages,): of the other one, ns.
        """
        if self.stamped and clock.stamped and abs((self.offset or 0.0) - (clock.offset or 0.0)) <= 1.0:
            mine, theirs = self.stamp[number], clock.stamp[number]
            if all(len(s) and s[0] >= 0 and (np.diff(s) >= 0).all() for s in (mine, theirs)):
                return mine, theirs
        return self.arrival[number], clock.arrival[number]

    @property
    def free(self) -> list[Candidate]:
        """Candidates without a reason against them."""
        return [c for c in self.candidates if not c.reason]
