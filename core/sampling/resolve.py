# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What a signals file leaves open of the sampling, resolved over all recordings: clock, max_gap, time sources."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import LONGEST_S
from uncertain_lti.base.errors import SignalError
from uncertain_lti.base.text import plural
from uncertain_lti.sampling.instants import median_step_ns, period_ns, to_ns
from uncertain_lti.signals.signal_map import SignalMap


def resolve(
    signals: SignalMap,
    instants: Mapping[str, Sequence[NDArray[np.int64]]],
    time: Mapping[str, str],
) -> SignalMap:
    """Fill in clock, max_gap, a constant step and time sources by the stated rules."""
    if signals.max_skew is not None and len({s.topic for s in signals.states}) == 1:
        raise SignalError(
            f"{signals.source}: max_skew limits the age of states from another topic than the clock, and all states "
            f"are on {signals.states[0].topic}; leave it out (the age of a control is limited by max_hold)"
        )
    min_step_ns = to_ns(signals.min_step)
    medians = {t: median_step_ns(instants[t], min_step_ns) for t in dict.fromkeys(s.topic for s in signals.states)}
    clock = signals.clock or max(medians, key=lambda t: medians[t] or 0)
    step = medians[clock]
    if step is None:
        count = sum(len(i) for i in instants[clock])
        raise SignalError(
            f"{clock}: {plural(count, 'message')} without a forward step in time, so no transition; "
            f"record longer, or set `topics: {{{clock}: {{time: log}}}}` if its stamps stand still"
        )
    max_gap = signals.max_gap if signals.max_gap is not None else min(2.5 * step * 1e-9, LONGEST_S)
    constant = signals.step
    if constant == "constant":
        constant = (period_ns(instants[clock], min_step_ns) or step) * 1e-9
    return replace(
        signals,
        clock=clock,
        max_gap=max_gap,
        step=constant,
        time={t: "header" if time[t] == "header" else "log" for t in signals.topics},
    )
