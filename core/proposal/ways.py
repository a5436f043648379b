# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Ways to fit that `tune` tries beside the one of `fit`: delays, schedules, lags and rates, horizons."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from uncertain_lti.base.english import plural
from uncertain_lti.base.errors import FitError
from uncertain_lti.identification.assembly import assemble
from uncertain_lti.identification.sensors import late_controls
from uncertain_lti.proposal.memories import Remembered, memory_candidates, operating_point, remember
from uncertain_lti.proposal.suggestion import TRANSITIONS, promise, thinned
from uncertain_lti.sampling.recall import with_delays
from uncertain_lti.sampling.transient import Transient

KNOTS = (2, 3, 5)
"""Numbers of knots tried on a promising signal."""
PROMISING, SIGNALS = 0.9, 2
"""Largest least-squares residual with three knots, relative to one, up to which a signal is tried; and how many are."""
LONGEST = 64
"""Steps of the longest horizon tried."""


@dataclass(frozen=True)
class Setting:
    """One way to fit.

    `words`: what it is, in words; `options`: arguments of `fit`; knots of a schedule are stated by their number;
    `memories`: lags and rates that are added to the controls; `delays`: controls that are taken so many samples
    earlier; `constant`: half-widths do not grow with x and u.
    """

    words: str
    options: Mapping[str, Any]
    memories: tuple[Remembered, ...] = ()
    delays: tuple[tuple[str, int], ...] = ()

    def prepared(self, transients: Sequence[Transient]) -> list[Transient]:
        """The recordings with the delays and memories of this setting."""
        if self.delays:
            transients = [with_delays(t, dict(self.delays)) for t in transients]
        return remember(transients, self.memories) if self.memories else list(transients)

    def beside(self, what: str, **changes: Any) -> Setting:
        """This one with something more."""
        return replace(self, words=f"{self.words}, {what}", **changes)


def delays(transients: Sequence[Transient], best: Setting) -> Iterator[Setting]:
    """Controls that are taken earlier: those that then explain more, and all of them by one sample."""
    first = transients[0]
    signals = () if first.signals is None else first.signals.controls
    remembered = {s.name for s in signals if s.memory is not None}
    names = list(first.control_names)
    low = np.min([np.nanmin(t.u, axis=0) for t in transients], axis=0)
    high = np.max([np.nanmax(t.u, axis=0) for t in transients], axis=0)
    moving = {name: 1 for j, name in enumerate(names) if name not in remembered and high[j] > low[j]}
    if not moving:
        return
    sets = [moving]
    try:
        few = thinned(transients, 5 * TRANSITIONS)
        problem = assemble(few, operating_point(first), None, best.options.get("additive", "noise"))
        late = {names[j]: samples for j, (samples, _) in late_controls(problem).items() if names[j] in moving}
        sets = [late, *(s for s in sets if s != late)] if late else sets
    except FitError:
        pass  # too few of them follow one another
    for chosen in sets:
        said = ", ".join(f"{name} {plural(count, 'sample')} earlier" for name, count in chosen.items())
        words = "all controls 1 sample earlier" if len(chosen) > 1 and chosen is moving else said
        yield best.beside(words, delays=tuple(chosen.items()))


def schedules(transients: Sequence[Transient], best: Setting) -> Iterator[list[Setting]]:
    """Schedules on each promising signal."""
    found = promise(thinned(transients, TRANSITIONS))
    signals = [name for name in sorted(found, key=lambda name: found[name]) if found[name] <= PROMISING][:SIGNALS]
    for name in signals:
        yield [
            best.beside(f"{count} knots on {name}", options={**best.options, "schedule": {name: count}})
            for count in KNOTS
        ]


def memories(transients: Sequence[Transient], best: Setting) -> Iterator[Setting]:
    """Lags and rates of states whose residuals follow from sample to sample, and of controls that seldom change."""
    delayed = replace(best, memories=()).prepared(transients)
    for some in memory_candidates(delayed, str(best.options.get("additive", "noise"))):
        yield best.beside(f"with {', '.join(one.name for one in some)}", memories=some)


def horizons(transients: Sequence[Transient], best: Setting, within: float) -> Iterator[Setting]:
    """Envelopes over several steps beside that of one."""
    step = float(np.median(np.concatenate([t.dt for t in transients])))
    longest = min(LONGEST, round(within / step))
    for steps in sorted({max(2, longest // 4), longest}):
        if longest >= 2:
            options = {**best.options, "horizons": [steps], "widths": "constant"}
            yield best.beside(f"and over {steps} steps", options=options)
