# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Status of one clock message, and counters of what became of messages and samples."""

from __future__ import annotations

from collections import Counter
from enum import StrEnum


class Status(StrEnum):
    """What became of one clock message."""

    OK = "ok"  # the transition that ends in this sample can be judged
    FIRST = "first"  # first sample of a recording
    RESET = "reset"  # time stepped back by more than max_gap: first sample of a new segment
    GAP = "gap"  # the step is longer than max_gap: first sample of a new segment
    MISSING = "missing"  # a signal at either end is missing, stale, not finite, or too large for the bounds
    STEP = "step out of range"  # the step is shorter or longer than those that the model was fitted to
    MODE = "mode not in the model"  # the scheduling signal has a value that the model does not list
    FROZEN = "frozen"  # a state repeats exactly although the nominal model moves it: no value of this instant
    UNASKED = "outside the time asked for"  # a check from one instant to another leaves the rest alone
    EQUAL = "equal stamp"  # dropped: the instant of the sample before
    SHORT = "short step"  # dropped: less than min_step after the sample before
    LATE = "late"  # dropped: at most max_gap before the sample before
    UNSTAMPED = "no stamp"  # dropped: header time is wanted and the stamp is zero

    @property
    def dropped(self) -> bool:
        """The message made no sample."""
        return self in (Status.EQUAL, Status.SHORT, Status.LATE, Status.UNSTAMPED)

    @property
    def opens_segment(self) -> bool:
        """The sample has no predecessor."""
        return self in (Status.FIRST, Status.RESET, Status.GAP)


LATE, TOO_OLD, MISSING, INVALID = "late", "stale", "missing", "invalid"
"""Kinds that are counted per topic (late) or per signal."""


class Counters(Counter[str]):
    """Counts by flat name, as diagnostics and `--json` show them: `samples`, `gaps`, `late /topic`, `stale signal`.

    `of` gives the counts of one kind by topic or signal, so that nobody takes the names apart.
    """

    def add(self, kind: str, name: str, count: int = 1) -> None:
        """Count something of a topic or signal."""
        self[f"{kind} {name}"] += count

    def of(self, kind: str) -> dict[str, int]:
        """Counts of one kind."""
        start = f"{kind} "
        return {key[len(start) :]: count for key, count in self.items() if key.startswith(start) and count}
