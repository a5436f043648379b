# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Counters of a sampler: what became of messages and samples, by kind and by the topic or signal concerned."""

from __future__ import annotations

from collections import Counter

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
