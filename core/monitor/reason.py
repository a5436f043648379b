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

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.model.alarm_rule import AlarmRule, Rule, labels
from uncertain_lti.model.domain import jumps, jumps_in_words
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
    Status.STEP: "the step is shorter or longer than those that the model was fitted to",
    Status.FROZEN: "every state needs one that is frozen",
    Status.UNASKED: "outside the time asked for",
}
"""Why a sample has no verdict."""
QUIET = "no alarm"
"""What is said of a verdict without an alarm."""


class Facts(NamedTuple):
    """What the words on one sample are made of.

    `alarm`: the alarm after it; `status`: OK with a verdict; `unknown_regime`: the verdict is on a regime that was not
    fitted; `raised`: which rules raise the alarm; empty without a verdict; `frozen`: states that are frozen;
    `withheld`: states without a verdict, as their rows need a frozen one, where others have one; `lacking`: signals
    without a value at either end of the transition; looked at if the status is MISSING; `unlisted`: which mode the
    model does not list, in words; looked at if the status is MODE; `jumps`: states that left their bounds by a jump
    larger than any of the fit, in words.
    """

    alarm: bool
    status: Status
    unknown_regime: bool
    raised: Sequence[Raised] = ()
    frozen: Sequence[str] = ()
    withheld: Sequence[str] = ()
    lacking: Sequence[str] = ()
    unlisted: str = ""
    jumps: Sequence[str] = ()


class Reasons:
    """What is said of one sample after another.

    While the same rules hold the alarm, the states that any of its verdicts blamed stay named: which of them is outside
    its bounds may change with every sample.

    `model`: names the signals; `rules`: of the alarm; `text`: on the last sample; `by`: what holds the alarm, or held
    it last: rules, horizons and states; empty before any.
    """

    def __init__(self, model: UncertainLTI, rules: Sequence[Rule]) -> None:
        self._model, self._rules = model, rules
        self._words = {label: rule.words for label, rule in zip(labels(rules), rules, strict=True)}
        self.reset()

    def reset(self) -> None:
        """Forget every sample."""
        self.text = "no verdict yet"
        self._blamed: dict[str, list[str]] = {}
        self._jumps: list[str] = []
        self._held = self.by = ""

    def fresh(self) -> Reasons:
        """The same without any sample."""
        return Reasons(self._model, self._rules)

    def take(self, verdict: Verdict, alarm: bool) -> str:
        """`push` of a verdict of the monitor."""
        if verdict.status.dropped:
            return self.text
        if verdict.judged and not (alarm or verdict.withheld):
            return self.push(Facts(False, Status.OK, verdict.unknown_regime))
        names = self._model.state_names
        lacking: Sequence[str] = ()
        if verdict.status is Status.MISSING:
            lacking = self._lacking([*verdict.before, *verdict.numbers("state")])
        unlisted = self._model.why_unlisted(verdict.before) if verdict.status is Status.MODE else ""
        frozen = [names[moved.state] for moved in verdict.frozen]
        withheld = [names[i] for i in verdict.withheld]
        jumps: Sequence[str] = ()
        if verdict.violated:
            jumps = jumps_in_words(self._model, verdict.before, verdict.numbers("state"), verdict.numbers("flags"))
        facts = alarm, verdict.status, verdict.unknown_regime, verdict.raised
        return self.push(Facts(*facts, frozen, withheld, lacking, unlisted, jumps))

    def _lacking(self, values: Sequence[float]) -> list[str]:
        """Names of signals of which some value, of [x; u; s] before and x after, is no number."""
        every = [signal.name for signal in self._model.signals]
        of = [*every, *self._model.state_names]
        return list(dict.fromkeys(name for name, value in zip(of, values, strict=True) if value != value))

    def push(self, facts: Facts) -> str:
        """Take one sample that was not dropped."""
        judged = facts.status is Status.OK
        if not facts.alarm:
            self._blamed, self._jumps, self._held = {}, [], ""
        elif facts.frozen or (judged and facts.raised):
            by = [f"frozen: {', '.join(facts.frozen)}"] if facts.frozen else []
            by += [self._rules_that(facts.raised, facts.jumps)] if judged and facts.raised else []
            self._held = "; ".join(by)
        elif judged and not self._held.startswith("latched"):
            self._held = "latched until ~/reset" + (f", raised by {self._held}" if self._held else "")
        self.by = self._held or self.by
        said = [f"alarm: {self._held}" if self._held else "alarm"] if facts.alarm else []
        if not judged:
            said.append(f"no verdict: {self._why(facts)}")
        elif not facts.alarm:
            said.append(QUIET)
        if judged and facts.withheld:
            said.append(f"no verdict on {', '.join(facts.withheld)}")
        if judged and facts.unknown_regime:
            said.append("a regime that was not fitted")
        self.text = "; ".join(said)
        return self.text

    def _rules_that(self, raised: Sequence[Raised], jumps: Sequence[str]) -> str:
        """The rules that hold the alarm, with the states blamed and the first jump since these do."""
        held = dict.fromkeys(reason.label for reason in raised)
        if held.keys() != self._blamed.keys():
            self._blamed, self._jumps = {label: [] for label in held}, []
        if jumps and not self._jumps:
            self._jumps = list(jumps)
        for reason in raised:
            if reason.state and reason.state not in self._blamed[reason.label]:
                self._blamed[reason.label].append(reason.state)
        by = [
            self._words[label] + (f": {', '.join(states)}" if states else "") for label, states in self._blamed.items()
        ]
        return "; ".join([*by, *self._jumps])

    def _why(self, facts: Facts) -> str:
        if facts.status is Status.MISSING and facts.lacking:
            return f"{', '.join(facts.lacking)} missing, stale, not valid or not finite"
        if facts.status is Status.MODE and facts.unlisted:
            return facts.unlisted
        return WHY[facts.status]


def over_recording(verdicts: Verdicts, model: UncertainLTI) -> Iterator[tuple[int, str]]:
    """What is said of the samples of a recording, as far as it changes."""
    reasons, said = Reasons(model, verdicts.alarms.rules), ""
    transient, statuses = verdicts.transient, verdicts.statuses()
    names = model.state_names
    for k in np.flatnonzero(_may_change(verdicts, model, statuses)).tolist():
        status, alarm = statuses[k], bool(verdicts.alarm[k])
        raised = verdicts.raised(k) if alarm else ()
        frozen = [names[i] for i in np.flatnonzero(verdicts.frozen[k])]
        withheld = [names[i] for i in np.flatnonzero(verdicts.withheld[k])]
        lacking: Sequence[str] = ()
        unlisted = ""
        if status in (Status.MISSING, Status.MODE):
            before = np.concatenate([transient.x[k - 1], transient.u[k - 1], transient.s[k - 1]]).tolist()
            if status is Status.MODE:
                unlisted = model.why_unlisted(before)
            else:
                lacking = reasons._lacking([*before, *transient.x[k].tolist()])
        jumps: Sequence[str] = ()
        if alarm and status is Status.OK:
            flags = verdicts.flags[k].tolist()
            jumps = jumps_in_words(model, transient.x[k - 1].tolist(), transient.x[k].tolist(), flags)
        unknown = bool(verdicts.unknown_regime[k])
        text = reasons.push(Facts(alarm, status, unknown, raised, frozen, withheld, lacking, unlisted, jumps))
        if text != said:
            yield k, text
            said = text


def _may_change(verdicts: Verdicts, model: UncertainLTI, statuses: Sequence[Status]) -> NDArray[np.bool_]:
    """Samples of which something else may be said than of the one before."""
    rows: list[NDArray[Any]] = [verdicts.alarm, verdicts.unknown_regime, verdicts.rule_alarms]
    rows += [verdicts.frozen, verdicts.withheld]
    if verdicts.alarm.any():
        rows += [verdicts.flags == 1.0, np.abs(verdicts.statistics) > 1.0]
        before = np.concatenate([np.full((1, model.n), np.nan), verdicts.transient.x[:-1]])
        rows.append((jumps(model, before, verdicts.transient.x)[0] != 0.0) & (verdicts.flags == 1.0))
        table = np.abs(verdicts.horizon_utilisation)
        rows += [
            table[:, row_of(rule, model)] > rule.margin
            for rule in verdicts.alarms.rules
            if isinstance(rule, AlarmRule) and rule.horizon > 1
        ]
    number = {status: i for i, status in enumerate(Status)}
    transient = verdicts.transient
    unknown = np.isnan(np.column_stack([transient.x, transient.u, transient.s]))
    rows += [np.array([number[status] for status in statuses], dtype=np.int64), unknown]
    if verdicts.unlisted_mode.any():
        after = np.column_stack([transient.x, transient.u, transient.s])[:, list(model.scheduling_positions)]
        rows.append(np.where(verdicts.unlisted_mode[:, None], np.roll(after, 1, axis=0), 0.0))
    facts = np.column_stack(rows)
    changes = np.ones(len(facts), dtype=bool)
    changes[1:] = (facts[1:] != facts[:-1]).any(axis=1)
    changes[2:] |= changes[1:-1]  # of the transition that follows a change is the begin
    return changes
