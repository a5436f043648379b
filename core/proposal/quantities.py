# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Quantities: steady states, scales and greatest ages of the proposed signals."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from uncertain_lti.base.limits import LARGEST
from uncertain_lti.proposal.candidates import Candidate, Source
from uncertain_lti.proposal.effects import held
from uncertain_lti.sampling.steady_state import resolve_auto
from uncertain_lti.signals.signal_map import Signal


def set_operating_point(states: Sequence[Candidate], controls: Sequence[Candidate], sources: Sequence[Source]) -> None:
    """Steady states and scales by the rule for `auto`; the range where the magnitude is small compared with it."""
    every = {s.topic: s for s in sources}
    clock = min((every[c.topic] for c in states), key=lambda s: s.rate)
    group = [*states, *controls]
    limits = [longest_hold(every[c.topic], clock)[0] if c in controls else None for c in group]
    recordings = [
        np.column_stack([held(c, every[c.topic], number, clock, limit) for c, limit in zip(group, limits, strict=True)])
        for number in range(len(clock.arrival))
    ]
    recordings = [r for r in recordings if len(r)]
    signals = [Signal(c.name, c.topic, c.path, "auto", "auto") for c in group]
    steady, scale, _ = resolve_auto(signals, recordings)
    pooled = np.concatenate(recordings)
    for j, candidate in enumerate(group):
        finite = pooled[np.isfinite(pooled[:, j]), j]
        span = float(np.ptp(finite)) if len(finite) else 0.0
        candidate.steady = steady[j] if abs(steady[j]) > 1e-3 * span else 0.0
        candidate.scale = _listed(scale[j] if scale[j] > 0.1 * span else span)


def set_own_scale(candidate: Candidate) -> None:
    """Median and range, for one in a comment."""
    finite = np.concatenate(candidate.values)
    finite = finite[np.isfinite(finite)]
    candidate.steady, candidate.scale = float(np.median(finite)), _listed(float(np.ptp(finite)))


def _listed(scale: float) -> float:
    """The nearest scale that a signals file may have; 0 stays."""
    return min(max(scale, 1.0 / LARGEST), LARGEST) if scale else 0.0


def longest_hold(source: Source, clock: Source) -> tuple[float | None, str]:
    """Greatest age of a command that comes at a steady rate and ends, or pauses, before the states do."""
    steps = np.concatenate([np.diff(a) for a in source.arrival if len(a) > 1] or [np.empty(0)]) * 1e-9
    steps = steps[steps > 0]
    if not len(steps):
        return None, ""
    usual, long = float(np.median(steps)), float(np.percentile(steps, 99))
    if long > 4 * usual:
        return None, "comes now and then, and holds until the next one"
    pauses = float(steps.max()) > 10 * usual
    for mine, theirs in zip(source.arrival, clock.arrival, strict=False):
        pauses |= len(mine) > 0 and len(theirs) > 0 and (theirs[-1] - mine[-1]) * 1e-9 > 10 * usual
    if not pauses:
        return None, ""
    limit = max(5 * usual, 2 * long)
    power = 10.0 ** math.floor(math.log10(limit))
    return next(f * power for f in (1, 2, 5, 10) if f * power >= limit), "s; older ones have ended"
