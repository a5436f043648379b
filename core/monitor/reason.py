# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Reasons: what holds the alarm, and why there is no verdict, in words that change only with the cause."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Mask
from uncertain_lti.model.alarm_rule import AlarmRule, Rule, labels
from uncertain_lti.model.domain import jumps, jumps_in_words
from uncertain_lti.model.repeats import Moved
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.alarm import Raised, row_of
from uncertain_lti.monitor.verdict import Verdict, Verdicts
from uncertain_lti.sampling.clock import Status

WHY = {
    Status.FIRST: "there is no sample before",
    Status.GAP: "the step is longer than max_gap",
    Status.RESET: "time stepped back",
    Status.MISSING: "a signal is missing, stale or not finite",
    Status.MODE: "the scheduling signal has a value that the model does not list",
    Status.STEP: "the step is under half or over twice those that the model was fitted to",
    Status.FROZEN: "every state needs one that is frozen",
    Status.UNASKED: "outside the time asked for",
}
"""Why a sample has no verdict, whatever the model."""
TOO_LARGE = "a value is so large that its bounds are not finite"
"""Why there is none where every signal is there."""
QUIET = "no alarm"
"""What is said of a verdict without an alarm."""
OFF = "alarms are off"
"""What is said of one that could raise none."""


def why_not(status: Status, model: UncertainLTI) -> str:
    """Why a sample has no verdict, with the steps that the model was fitted to."""
    sampling, text = model.sampling, WHY[status]
    if status is Status.STEP and sampling.dt_min is not None and sampling.dt_max is not None:
        text += f" ({sampling.dt_min:.3g} to {sampling.dt_max:.3g} s)"
    return text


class Reasons:
    """What is said of one sample after another.

    While the same rules hold the alarm, the states that any of its verdicts blamed stay named: which of them is outside
    its bounds may change with every sample.

    `model`: names the signals; `rules`: of the alarm; `words`: of each rule, by what it is called; `text`: on the last
    sample; `by`: what holds the alarm, or held it last: rules, horizons and states; empty before any;
    `rivals`: what is said of publishers that are taken for one; empty if there are none.
    """

    def __init__(self, model: UncertainLTI, rules: Sequence[Rule]) -> None:
        self._model = model
        self.rivals = ""
        self.words = {label: rule.words for label, rule in zip(labels(rules), rules, strict=True)}
        self.reset()

    def reset(self) -> None:
        """Forget every sample."""
        self.text = "no verdict yet"
        self._blamed: dict[str, list[str]] = {}
        self._jumps: list[str] = []
        self._held = self.by = ""

    def take(self, verdict: Verdict, alarm: bool) -> str:
        """Take one verdict of the monitor, and the alarm after it."""
        if verdict.status.dropped:
            return self.text
        judged, names = verdict.status is Status.OK, self._model.state_names
        raised = verdict.raised if alarm and judged else ()
        if not alarm:
            self._blamed, self._jumps, self._held = {}, [], ""
        elif verdict.frozen or raised:
            by = [f"frozen: {', '.join(names[moved.state] for moved in verdict.frozen)}"] if verdict.frozen else []
            by += [self._rules_that(raised, verdict)] if raised else []
            self._held = "; ".join(by)
        elif judged and not self._held.startswith("latched"):
            self._held = "latched until ~/reset" + (f", raised by {self._held}" if self._held else "")
        self.by = self._held or self.by
        said = [f"alarm: {self._held}" if self._held else "alarm"] if alarm else []
        if not judged:
            said.append(f"no verdict: {self.rivals or self._why(verdict)}")
        elif not alarm:
            said.append(QUIET if verdict.armed else OFF)
        if judged and verdict.withheld:
            said.append(f"no verdict on {', '.join(names[i] for i in verdict.withheld)}")
        if judged and verdict.unknown_regime:
            said.append("a regime that was not fitted")
        if judged and self.rivals:
            said.append(self.rivals)
        self.text = "; ".join(said)
        return self.text

    def _rules_that(self, raised: Sequence[Raised], verdict: Verdict) -> str:
        """The rules that hold the alarm, with the states blamed and the first jump since these do."""
        held = dict.fromkeys(reason.label for reason in raised)
        if held.keys() != self._blamed.keys():
            self._blamed, self._jumps = {label: [] for label in held}, []
        self._jumps = self._jumps or jumps_in_words(
            self._model, verdict.before, verdict.numbers("state"), verdict.numbers("flags")
        )
        for reason in raised:
            if reason.state and reason.state not in self._blamed[reason.label]:
                self._blamed[reason.label].append(reason.state)
        blamed = [(self.words[label], ", ".join(states)) for label, states in self._blamed.items()]
        return "; ".join([*(f"{rule}: {states}" if states else rule for rule, states in blamed), *self._jumps])

    def _why(self, verdict: Verdict) -> str:
        status = verdict.status
        if status is Status.MODE:
            return self._model.why_unlisted(verdict.before) or WHY[status]
        if status is Status.MISSING:
            of = [*(signal.name for signal in self._model.signals), *self._model.state_names]
            values = zip(of, [*verdict.before, *verdict.numbers("state")], strict=True)
            lacking = dict.fromkeys(name for name, value in values if not math.isfinite(value))
            return f"{', '.join(lacking)} missing, stale, not valid or not finite" if lacking else TOO_LARGE
        return why_not(status, self._model)


def over_recording(verdicts: Verdicts, model: UncertainLTI) -> Iterator[tuple[int, str]]:
    """What is said of the samples of a recording, as far as it changes."""
    reasons, said = Reasons(model, verdicts.alarms.rules), ""
    transient, statuses = verdicts.transient, verdicts.statuses()
    for k in np.flatnonzero(_may_change(verdicts, model, statuses)).tolist():
        verdict: Any = SimpleNamespace(
            status=statuses[k],
            armed=verdicts.armed[k],
            unknown_regime=verdicts.unknown_regime[k],
            raised=verdicts.raised(k) if verdicts.alarm[k] else (),
            frozen=[Moved(i, math.nan, math.nan) for i in np.flatnonzero(verdicts.frozen[k]).tolist()],
            withheld=np.flatnonzero(verdicts.withheld[k]).tolist(),
            before=np.concatenate([transient.x[k - 1], transient.u[k - 1], transient.s[k - 1]]).tolist(),
            numbers=lambda name, k=k: getattr(verdicts, name)[k].tolist(),
        )
        text = reasons.take(verdict, bool(verdicts.alarm[k]))
        if text != said:
            yield k, text
            said = text


def _may_change(verdicts: Verdicts, model: UncertainLTI, statuses: Sequence[Status]) -> Mask:
    """Samples of which something else may be said than of the one before."""
    rows: list[NDArray[Any]] = [verdicts.alarm, verdicts.armed, verdicts.unknown_regime, verdicts.rule_alarms]
    rows += [verdicts.frozen, verdicts.withheld]
    if verdicts.alarm.any():
        values, blamed = verdicts.over_thresholds()
        rows += [verdicts.flags == 1.0, np.abs(values) > 1.0, np.where(verdicts.rule_alarms, blamed, -1)]
        before = np.concatenate([np.full((1, model.n), np.nan), verdicts.transient.x[:-1]])
        rows.append((jumps(model, before, verdicts.transient.x)[0] != 0.0) & (verdicts.flags == 1.0))
        table = np.abs(verdicts.horizon_utilisation)
        over = (r for r in verdicts.alarms.rules if isinstance(r, AlarmRule))
        rows += [table[:, row_of(rule, model)] > rule.margin for rule in over]
    number = {status: i for i, status in enumerate(Status)}
    transient = verdicts.transient
    unknown = np.isnan(np.column_stack([transient.x, transient.u, transient.s]))
    rows += [np.array([number[status] for status in statuses], dtype=np.int64), unknown]
    if verdicts.unlisted_mode.any():
        after = np.column_stack([transient.x, transient.u, transient.s])[:, model.scheduling_positions]
        rows.append(np.where(verdicts.unlisted_mode[:, None], np.roll(after, 1, axis=0), 0.0))
    facts = np.column_stack(rows)
    changes = np.ones(len(facts), dtype=bool)
    changes[1:] = (facts[1:] != facts[:-1]).any(axis=1)
    changes[2:] |= changes[1:-1]  # of the transition that follows a change is the begin
    return changes
