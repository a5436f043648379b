# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""A monitor as it is deployed: the rule that parameters give, and a recording judged as the node would judge it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.errors import ModelError
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.alarm import Armed, Arming, Condition
from uncertain_lti.monitor.envelope_monitor import EnvelopeMonitor
from uncertain_lti.monitor.verdict import Verdicts
from uncertain_lti.sampling.clock import to_ns
from uncertain_lti.sampling.transient import Transient

LONGEST_GRACE = 86400.0
"""s; that of the node's parameter."""


@dataclasses.dataclass(frozen=True)
class Rule:
    """Alarm rule as the parameters give it; 0 means that of the model.

    `violations`: m of the rule; `window`: n of the rule, in verdicts; `margin`: multiplies the half-widths; `masked`:
    states that do not count, separated by commas; `enable`: see `Condition`; empty for none; `enable_type`: message
    type of its topic; empty for that of the model or of the graph; `grace`: time of grace, s; `latch`: whether an alarm
    lasts until it is reset.
    """

    violations: int = 0
    window: int = 0
    margin: float = 0.0
    masked: str = ""
    enable: str = ""
    enable_type: str = ""
    grace: float = 0.0
    latch: bool = False

    def monitor(self, model: UncertainLTI) -> EnvelopeMonitor:
        """Monitor of a model under this rule."""
        return EnvelopeMonitor(
            model, self.violations or None, self.window or None, self.margin or None, listed_states(self.masked)
        )


def listed_states(text: str) -> list[str]:
    """Names of states, separated by commas."""
    return [name.strip() for name in text.split(",") if name.strip()]


@dataclasses.dataclass(frozen=True)
class DeployedMonitor:
    """A monitor with the conditions of its deployment.

    `monitor`: with rule and masked states; `condition`: no alarm unless it holds; `grace`: no alarm this long, s, after
    the first sample, after time jumped back, and after the condition began to hold; `latch`: an alarm lasts to the end;
    `start`: only samples from here on are judged, s after the first sample of the recording: as if the node were
    started then, with the condition known; `stop`: only samples up to here are judged, s after the first sample.
    """

    monitor: EnvelopeMonitor
    condition: Condition | None = None
    grace: float = 0.0
    latch: bool = False
    start: float | None = None
    stop: float | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.grace <= LONGEST_GRACE:
            raise ModelError(f"grace is {self.grace}; it must be 0 to {LONGEST_GRACE:g} s")
        for name, value in (("from", self.start), ("to", self.stop)):
            if value is not None and not math.isfinite(value):
                raise ModelError(f"{name} is {value}; give seconds after the first sample")
        if self.start is not None and self.stop is not None and not self.start < self.stop:
            raise ModelError(f"from {self.start:g} s to {self.stop:g} s leaves nothing to judge; give a later end")

    def check(
        self, transient: Transient, before: NDArray[np.intp] | Sequence[int] = (), values: ArrayLike = ()
    ) -> Verdicts:
        """Verdicts over a recording with the alarm that the node would have published.

        `before` (K,): samples decided before each value of the condition's field came, of `read_field`; `values` (K,):
        these values.
        """
        t, count = transient.t, len(transient)
        inside = np.ones(count, dtype=bool)
        if self.start is not None:
            inside &= t >= self.start
        if self.stop is not None:
            inside &= t <= self.stop
        a, b = 0, count
        if not inside.all():
            if not inside.any():
                raise ModelError(f"{transient.name}: no sample lies between the times asked for; it has {t[-1]:g} s")
            chosen = np.flatnonzero(inside)
            a, b = int(chosen[0]), int(chosen[-1]) + 1
        arming = Arming(self.condition, to_ns(self.grace))
        came, heard = np.asarray(before, dtype=np.intp) - a, np.asarray(values, dtype=np.float64)
        for value in heard[came < 0][-1:].tolist():
            arming.learn(value)
        later = came >= 0
        armed = arming.over(transient.t_ns[a:b], came[later], heard[later])
        if (a, b) != (0, count):
            around = a, count - b
            armed = Armed(np.pad(armed.counts, around), np.pad(armed.cleared, around), slice(a, b))
        verdicts = self.monitor.check(transient, armed)
        if self.latch:
            verdicts = dataclasses.replace(verdicts, alarm=np.logical_or.accumulate(verdicts.alarm))
        return verdicts

    def words(self) -> str:
        """What differs from a monitor without conditions."""
        return ", ".join(
            [
                *([f"masked: {', '.join(self.monitor.masked)}"] if self.monitor.masked else []),
                *condition_words(self.condition, self.grace, self.latch),
                *([] if self.start is None else [f"from {self.start:g} s"]),
                *([] if self.stop is None else [f"to {self.stop:g} s"]),
            ]
        )


def condition_words(condition: Condition | None, grace: float, latch: bool) -> list[str]:
    """When an alarm counts and how long it lasts, in words."""
    return [
        *([f"as long as {condition}"] if condition else []),
        *([f"grace {grace:g} s"] if grace else []),
        *(["latched"] if latch else []),
    ]
