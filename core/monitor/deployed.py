# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""A monitor as it is deployed: its rule as parameters give it, a recording judged as live, and its drift over weeks."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from uncertain_lti.base.arrays import Index
from uncertain_lti.base.errors import ModelError
from uncertain_lti.base.text import list_of, plural, shortened
from uncertain_lti.model.alarm_rule import StatisticRule
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.alarm import Armed, Arming, Condition
from uncertain_lti.monitor.envelope_monitor import EnvelopeMonitor
from uncertain_lti.monitor.verdict import Verdicts
from uncertain_lti.sampling.clock import to_ns
from uncertain_lti.sampling.transient import Transient

LONGEST_GRACE = 86400.0
"""s; that of the node's parameter."""
CHANCE, RECORDINGS = 0.01, 5
"""Share of checks in which a state at most seems to move that does not, and recordings from which on one shows it."""
_WEEK, _YEAR_2001, _FAR = 7 * 86_400e9, 978_307_200e9, 520
"""ns; ns since 1970; weeks or recordings from which on nobody wants to know."""
_DAY, _KEPT = 86_400 * 10**9, 60  # ns; days


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
    names = [name.strip() for name in text.split(",") if name.strip()]
    if text and not names:
        raise ModelError(f"masked is {text!r}, which names no state; write their names, separated by commas")
    return names


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

    def check(self, transient: Transient, before: Index | Sequence[int] = (), values: ArrayLike = ()) -> Verdicts:
        """Verdicts over a recording with the alarm that the node would have published.

        `before` (K,): samples decided before each value of the condition's field came, of `read_field`; `values` (K,):
        these values.
        """
        t, count = transient.t, len(transient)
        first, last = (-math.inf if self.start is None else self.start), (math.inf if self.stop is None else self.stop)
        inside = np.flatnonzero((first <= t) & (t <= last))
        if count and not len(inside):
            raise ModelError(f"{transient.name}: no sample lies between the times asked for; it has {t[-1]:g} s")
        a, b = (int(inside[0]), int(inside[-1]) + 1) if count else (0, 0)
        came = np.maximum(np.asarray(before, dtype=np.intp) - a, 0)
        armed = Arming(self.condition, to_ns(self.grace)).over(transient.t_ns[a:b], came, values)
        if (a, b) != (0, count):
            around = a, count - b
            armed = Armed(*(np.pad(marks, around) for marks in armed))
        verdicts = self.monitor.check(transient, armed)
        if self.latch:
            verdicts = dataclasses.replace(verdicts, alarm=np.logical_or.accumulate(verdicts.alarm))
        return verdicts

    def words(self) -> str:
        """What differs from a monitor without conditions."""
        said = conditions_in_words(self.monitor, self.condition, self.grace, self.latch)
        said += [f"{name} {t:g} s" for name, t in (("from", self.start), ("to", self.stop)) if t is not None]
        return ", ".join(said)


def conditions_in_words(monitor: EnvelopeMonitor, condition: Condition | None, grace: float, latch: bool) -> list[str]:
    """Which violations count for the alarm, and how long it lasts, in words."""
    masked = ", ".join(monitor.masked)
    said = {f"masked: {masked}": masked, f"as long as {condition}": condition, f"grace {grace:g} s": grace}
    return [words for words, holds in (said | {"latched": latch}).items() if holds]


class Days:
    """Largest utilisation of each state on each day without an alarm, of a monitor that runs for weeks."""

    def __init__(self, model: UncertainLTI) -> None:
        self._model = model
        self._days: list[dict[str, Any]] = []
        self.words: list[str] = []

    def take(self, t_ns: int, largest: Sequence[float]) -> None:
        """What the verdicts up to an instant reached; with a new day the words are those of the days before it."""
        if not self._days or t_ns // _DAY != self._days[-1]["t_ns"] // _DAY:
            if len(self._days) > RECORDINGS:
                self.words = drift_in_words(self._model, self._days, "day")
            states = {name: {"largest": 0.0} for name in self._model.state_names}
            self._days = [*self._days[-_KEPT:], {"t_ns": t_ns, "verdicts": 1, "states": states}]
        for state, value in zip(self._days[-1]["states"].values(), largest, strict=True):
            state["largest"] = max(state["largest"], value)


def drift_in_words(model: UncertainLTI, recordings: Sequence[Mapping[str, Any]], what: str = "recording") -> list[str]:
    """A sentence on each state whose largest utilisation moves, and when it reaches its threshold.

    Its logarithm is a line over the weeks, or over the recordings where their stamps are no dates; `recordings`: as of
    `check_data`, without those that the model was fitted to, which its bounds hold by construction; `what`: they are.
    """
    fitted = [list_of(each)[:1] for each in list_of((model.memory or {}).get("recordings"))]
    new = (r for r in recordings if r["verdicts"] and [r.get("recording")] not in fitted)
    some = sorted(new, key=lambda r: int(r["t_ns"]))
    if len(some) < RECORDINGS:
        return []
    stamps = np.array([r["t_ns"] for r in some], dtype=np.float64)
    dated = stamps[0] > _YEAR_2001 and stamps[-1] - stamps[0] > _WEEK
    unit, at = ("week", (stamps - stamps[0]) / _WEEK) if dated else (what, np.arange(len(some)) * 1.0)
    x, sure, found = at - at.mean(), _student(len(at) - 2, CHANCE / model.n), []
    for name, limit in zip(model.state_names, _limits(model), strict=True):
        peaks = np.array([r["states"][name]["largest"] or math.nan for r in some])
        y = np.log(peaks) - np.log(peaks).mean()
        slope = float(x @ y / (x @ x))
        if not abs(slope) > sure * float(np.linalg.norm(y - slope * x)) / math.sqrt((len(x) - 2) * float(x @ x)):
            continue  # nor of what was not judged
        text = f"the largest utilisation of {shortened(name)} {'rises' if slope > 0.0 else 'falls'} by "
        text += f"{100 * abs(math.expm1(slope)):.2g} % a {unit} over {plural(len(x), what)}"
        left = (math.log(limit) - float(np.log(peaks).mean())) / slope - float(x[-1])
        if slope > 0.0 and left < _FAR:
            where = f"it is past its threshold of {limit:.3g}"
            if left > 0.0:
                when = f"in {plural(math.ceil(left), what)}"
                if dated:
                    when = f"on {datetime.fromtimestamp(stamps[-1] / 1e9, UTC) + timedelta(weeks=left):%Y-%m-%d}"
                where = f"at that rate it reaches its threshold of {limit:.3g} {when}"
            text += f"; {where}, and the promised rate of false alarms no longer holds: if the machine is healthy, "
            text += "update the model"
        found.append(text)
    return found


def _student(freedom: int, chance: float) -> float:
    """What |t| of Student's distribution exceeds with a chance: scipy is no need of a robot that checks.

    With t = tan(a) √freedom the density of a is as cos(a)^(freedom - 1).
    """
    angle = np.linspace(0.0, 0.5 * math.pi, 200_001)
    density = np.cos(angle) ** (freedom - 1)
    below = np.cumsum(np.append(0.0, 0.5 * (density[1:] + density[:-1])))
    return math.sqrt(freedom) * math.tan(float(np.interp((1.0 - chance) * below[-1], below, angle)))


def _limits(model: UncertainLTI) -> list[float]:
    """|utilisation| of each state in one verdict that raises the alarm."""
    for rule in model.alarm:
        if isinstance(rule, StatisticRule) and (rule.kind, rule.window_s, rule.horizon) == ("energy", 0.0, 1):
            return [math.sqrt(threshold) for threshold in rule.thresholds(model.n)]
    return [model.alarm_rule.margin] * model.n
