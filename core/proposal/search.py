# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Search: candidates for a fit, compared on the same parts left out of each."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.validation.groups import resolve_groups
from uncertain_lti.validation.left_out import BLOCKS, block_spans, guard_interval, leave_out
from uncertain_lti.validation.part import by_unit
from uncertain_lti.validation.result import Validation

FOLDS = 10
"""Times that something is left out, at most; of more recordings or groups, neighbours are left out together."""
PAYS = 0.8
"""Mean width relative to the simpler candidate up to which another one is worth having."""
SLACK = 0.25
"""Share of what the simplest candidate leaves outside of a left-out part by which more may be outside: the other
recordings do not represent such a part, and the narrower an envelope is, the more of it is outside."""
EXCESS = 0.00075
"""Share of all left-out transitions that may be outside beyond that, ..."""
WORSE = 0.01
"""... and share that may be if it is within the standard error of the comparison."""


@dataclass(frozen=True)
class Fold:
    """How recordings are left out, the same way for every candidate.

    `groups`: one name per recording, where whole groups are left out; `blocks`: blocks of a single recording; `gap`:
    guard interval of the blocks, s; `what`: what is left out at a time: recording, group or block.
    """

    groups: list[str] | None
    blocks: int | None
    gap: float | None
    what: str

    @classmethod
    def of(
        cls, transients: Sequence[Transient], groups: Sequence[Any] | str | None, base: UncertainLTI, most: int = FOLDS
    ) -> Fold:
        """What is left out at a time, at most so many times."""
        names, _ = resolve_groups(transients, groups)
        if not names and len(transients) == 1:
            usable = int(transients[0].usable.sum())
            blocks = max(2, min(BLOCKS, most, usable // 2))
            spans = [(transients[0], *span) for span in block_spans(transients[0], blocks)]
            return cls(None, blocks, guard_interval(base, spans), "block")
        what = "group" if names else "recording"
        each = names or [str(i) for i in range(len(transients))]
        units = list(dict.fromkeys(each))
        if len(units) <= most:
            return cls(names or None, None, None, what)
        joined = {units[k]: str(i) for i, part in enumerate(np.array_split(np.arange(len(units)), most)) for k in part}
        return cls([joined[name] for name in each], None, None, f"{most}th part of the {what}s")

    def leave_out(self, transients: Sequence[Transient], model: UncertainLTI, options: Mapping[str, Any]) -> Validation:
        """Each part judged by the fit without it, on the schedule of the model."""
        own = {k: v for k, v in options.items() if k != "schedule"}
        return leave_out(transients, full=model, groups=self.groups, blocks=self.blocks, gap=self.gap, **own)


@dataclass(frozen=True, eq=False)
class Score:
    """What the left-out parts say of a candidate.

    `judged` (units,): left-out transitions, or windows, of each recording, group or block; `outside` (units,): those
    outside the bounds of some state.
    """

    judged: Array = field(default_factory=lambda: np.zeros(0))
    outside: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(cls, validation: Validation) -> Score:
        """Of one step."""
        parts = validation.parts
        return cls(by_unit(parts, [p.judged for p in parts]), by_unit(parts, [p.violated for p in parts]))

    @property
    def share(self) -> float:
        """Share of what was left out that is outside."""
        return float(self.outside.sum() / self.judged.sum()) if self.judged.sum() else math.nan

    def excess(self, base: Score, of: NDArray[np.bool_] | slice = slice(None)) -> float:
        """Share outside beyond 1 + SLACK times that of another in the same part, summed over the parts with any."""
        times = np.divide(self.judged, base.judged, out=np.zeros_like(self.judged), where=base.judged > 0)
        beyond = np.maximum(self.outside - (1.0 + SLACK) * base.outside * times, 0.0)[of]
        return float(beyond.sum() / max(self.judged[of].sum(), 1.0))


def jackknife(sums: Array, counts: Array) -> tuple[float, float]:
    """Σ sums / Σ counts over what was left out at a time (units,), with its standard error."""
    total = counts.sum()
    value = float(sums.sum() / total) if total else math.nan
    rest = total - counts
    there = (counts > 0) & (rest > 0)
    if there.sum() < 2:
        return value, math.inf
    without = (sums.sum() - sums[there]) / rest[there]
    number = len(without)
    return value, float(np.sqrt((number - 1) / number * np.sum((without - without.mean()) ** 2)))
