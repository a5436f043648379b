# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The alarm: what each of its rules makes of one verdict after another, and when it counts.

It counts while a condition on a field of some topic holds, and after a time of grace.
"""

from __future__ import annotations

import operator
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import WORTH_THREADS, Array, Index, Integers, Mask, on_cores
from uncertain_lti.base.errors import ModelError, SignalError
from uncertain_lti.kernel.arithmetic import Statistic, Statistics, Window
from uncertain_lti.model.alarm_rule import JOINT, KINDS, AlarmRule, Rule, labels
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.signals.field_path import FieldPath

EVERY_STATE = "joint"
"""What stands for the state in the name of a statistic of all of them."""


@dataclass(frozen=True)
class Raised:
    """One reason for the alarm.

    `label`: of the rule, as of `alarm_rule.labels`; `kind`: of the rule; `horizon`: of the rule, in steps; `state`: the
    state; of a joint statistic the one that it points to, see `Statistic`, if there is one; empty where no state of
    this verdict is to blame; `value`: the statistic over its threshold, with its sign; 1 of containment; `span`: the
    window of the rule in words, if another rule of its kind and horizon has to be told from it.
    """

    label: str
    kind: str
    horizon: int
    state: str
    value: float
    span: str = ""

    @property
    def what(self) -> str:
        """`energy of fan_speed over 40 steps`, for example."""
        state = f" of {self.state}" if self.state else ""
        if self.kind in JOINT:
            state = " of all states" + f" (points to {self.state})" * bool(self.state)
        over = f" over {self.horizon} steps" if self.horizon > 1 else ""
        return f"{self.kind}{state}{over}" + f" ({self.span})" * bool(self.span)

    @property
    def words(self) -> str:
        """What it is, and at how many times its threshold."""
        return self.what + ("" if self.kind == "containment" else f" at {times_text(self.value)} times its threshold")


def times_text(value: float) -> str:
    """A statistic over its threshold; none is rounded to the threshold."""
    size = abs(value)
    return f"{size:.{3 if abs(size - 1.0) >= 0.005 else 6}g}"


class Nearest(NamedTuple):
    """The statistic of a rule that is nearest to its threshold.

    `state`: of which it is; `EVERY_STATE` for all together; `value`: the statistic; `threshold`: what raises the alarm
    if it is exceeded.
    """

    state: str
    value: float
    threshold: float

    @property
    def share(self) -> float:
        """Its size over its threshold."""
        return abs(self.value) / self.threshold


def row_of(rule: Rule, model: UncertainLTI) -> int:
    """Row of the table that a rule looks at."""
    place = 0 if rule.horizon == 1 else 1 + model.steps.index(rule.horizon)
    own = rule.kind in JOINT and not model.residuals_at(rule.horizon).relative
    return residual_row(model) + place if own else place


def residual_row(model: UncertainLTI) -> int:
    """Row of the table at which the residuals begin: those of one step, then those of each horizon."""
    return 1 + len(model.horizons)


class Alarm:
    """All rules of one alarm.

    `rules`: at least one; `model`: what they judge by; `counted` (n,): states that count; `labels`: what each rule is
    called; `names`: of the statistics, `energy/fan_speed` for example; empty if every rule is containment;
    `needs_table`: whether some rule looks at more than the one-step violation; `needs_residual`: whether some rule
    looks at residuals, which follow the utilisation in the table; `alarm`: whether some rule raises the alarm.
    """

    def __init__(self, rules: Sequence[Rule], model: UncertainLTI, counted: Mask) -> None:
        self.rules, self.labels, self.alarm = tuple(rules), labels(rules), False
        self._model, self._counted = model, counted
        self._rows = [row_of(rule, model) for rule in self.rules]
        alike = Counter((rule.kind, rule.horizon) for rule in self.rules)
        self._spans = [rule.span if alike[rule.kind, rule.horizon] > 1 else "" for rule in self.rules]
        self._places: list[tuple[int, str, float]] = []  # of each of `values`: number of its rule, state and threshold
        self._begins: list[int] = []  # of each rule, where its numbers begin in `values`
        for i, rule in enumerate(self.rules):
            self._begins.append(len(self._places))
            if not isinstance(rule, AlarmRule):
                states = (EVERY_STATE,) if rule.kind in JOINT else model.state_names
                self._places += zip([i] * len(states), states, rule.thresholds(model.n), strict=True)
        self.names = tuple(f"{self.labels[i]}/{state}" for i, state, _ in self._places)
        self._parts = [self._part(rule, row) for rule, row in zip(self.rules, self._rows, strict=True)]
        self.needs_table = any(rule.horizon > 1 or rule.kind != "containment" for rule in self.rules)
        self.needs_residual = any(row >= residual_row(model) for row in self._rows)
        self._windows = [part for part in self._parts if isinstance(part, Window)]
        over = [(part, row) for part, row in zip(self._parts, self._rows, strict=True) if isinstance(part, Statistic)]
        self._statistics = Statistics([part for part, _ in over], [row * model.n for _, row in over])

    def __reduce__(self) -> tuple[Any, ...]:
        return Alarm, (self.rules, self._model, self._counted)

    def _part(self, rule: Rule, row: int) -> Window | Statistic:
        """What a rule makes of verdicts; a row of the table begins at its number times n."""
        n = self._model.n
        if isinstance(rule, AlarmRule):
            states = np.flatnonzero(self._counted).tolist() if row else ()
            return Window(rule.violations, rule.window, rule.margin, states, row * n)
        law: tuple[Any, ...] = ()
        if rule.kind in JOINT:
            residuals = self._model.residuals_at(rule.horizon)
            law = residuals.mean, residuals.whitening(self._counted), residuals.memory
        counted, limits = self._counted.tolist(), rule.thresholds(n)
        return Statistic(KINDS.index(rule.kind), n, rule.window_s, limits, counted, rule.allowance, *law)

    def reset(self) -> None:
        """Forget every verdict and the alarm."""
        for part in self._parts:
            part.reset()
        self.alarm = False

    def push(self, dt: float, violated: bool, table: Any = None) -> bool:
        """Take one verdict."""
        alarm = bool(self.names) and bool(self._statistics.push(dt, table))
        for window in self._windows:
            alarm = window.push(violated, table) or alarm
        self.alarm = alarm
        return alarm

    def values(self) -> Any:
        """Each statistic over its threshold, 1 and -1 being the threshold, in the order of `names`."""
        return self._statistics.values()

    def nearest(self, values: Sequence[float]) -> dict[str, Nearest]:
        """Of each rule with a statistic the one that is nearest to its threshold."""
        found = dict[str, Nearest]()
        for (i, state, limit), value in zip(self._places, values, strict=True):
            one, before = Nearest(state, value * limit, limit), found.get(self.labels[i])
            if value == value and (before is None or one.share > before.share):
                found[self.labels[i]] = one
        return found

    def farthest(self, values: Array) -> tuple[int, Raised] | None:
        """Of many verdicts (K, statistics) the one after which some statistic that counts is largest, and that one."""
        counted = dict(zip(self._model.state_names, self._counted, strict=True))
        counts = [self.rules[i].kind in JOINT or counted[state] for i, state, _ in self._places]
        sizes = np.fmax(np.fmax.reduce(values, initial=np.nan), -np.fmin.reduce(values, initial=np.nan))
        if not (sizes := np.where(counts, sizes, np.nan))[~np.isnan(sizes)].any():
            return None
        column = int(np.nanargmax(sizes))
        k, (i, state, _) = int(np.nanargmax(np.abs(values[:, column]))), self._places[column]
        rule, size = self.rules[i], float(values[k, column])
        state = "" if rule.kind in JOINT else state
        return k, Raised(self.labels[i], rule.kind, rule.horizon, state, size, self._spans[i])

    def raised(self) -> tuple[tuple[int, int], ...]:
        """Rules that raise the alarm, and the state that each points to if it looks at all together, else -1."""
        return tuple((i, getattr(part, "blamed", -1)) for i, part in enumerate(self._parts) if part.alarm)

    def reasons(
        self, rules: Iterable[tuple[int, int]], values: Sequence[float], sizes: Array, flags: Array
    ) -> tuple[Raised, ...]:
        """Why the alarm is raised at a verdict.

        `rules`: as `raised` gives them; `sizes` (H, n): utilisation there, for one step and for each horizon; `flags`
        (n,): 1 for a state that violates its one-step bounds there.
        """
        found, names = list[Raised](), self._model.state_names
        for i, pointed in rules:
            rule, begin = self.rules[i], self._begins[i]
            if isinstance(rule, AlarmRule):
                left = flags == 1.0 if rule.horizon == 1 else np.abs(sizes[row_of(rule, self._model)]) > rule.margin
                blamed = {names[j]: 1.0 for j in np.flatnonzero(left & self._counted)} or {"": 1.0}
            elif rule.kind in JOINT:
                blamed = {names[pointed] if pointed >= 0 else "": float(values[begin])}
            else:
                own = {j: float(values[begin + j]) for j in np.flatnonzero(self._counted).tolist()}
                blamed = {names[j]: value for j, value in own.items() if abs(value) > 1.0}
            label, span = self.labels[i], self._spans[i]
            found += [Raised(label, rule.kind, rule.horizon, state, value, span) for state, value in blamed.items()]
        return tuple(found)

    def over(
        self,
        spans: Sequence[tuple[int, int]],
        dt: Array,
        violated: Mask,
        rows: Sequence[Any],
        judged: Mask | None = None,
        each: Mask | None = None,
        values: Array | None = None,
        blamed: NDArray[np.int16] | None = None,
    ) -> Mask:
        """Many verdicts, those of each span [start, stop) from a cleared alarm; after each what `push` gives.

        `dt` (K,): steps, s; `violated` (K,): as for `push`; `rows`: of the table of `push`, (K, n) each, None for one
        that no rule looks at; `judged` (K,): where there is a verdict, default everywhere; without one the alarm stays
        as it was; `each` (K, rules): takes which rules raise the alarm after each; `values` (K, statistics): takes
        `values` after each, NaN without a verdict; `blamed` (K, rules): takes the state of each that `raised` gives.
        Returns (K,): the alarm after each; none outside the spans.
        """
        count = len(dt)
        judged = np.ones(count, dtype=bool) if judged is None else judged
        each = np.zeros((count, len(self.rules)), dtype=bool) if each is None else each
        values = np.empty((count, 0)) if values is None else values

        def push_all(
            part: Window | Statistic, row: int, after: Mask, own: Array, pointed: NDArray[np.int16] | None
        ) -> None:
            for start, stop in spans:
                on, table = slice(start, stop), rows[row]
                table = None if table is None else table[on]
                part.reset()
                if isinstance(part, Window):
                    part.push_all(violated[on], table, judged[on], after[on])
                else:
                    part.push_all(
                        dt[on], table, judged[on], after[on], own[on], None if pointed is None else pointed[on]
                    )
            part.reset()

        owns = np.split(values, self._begins[1:], axis=1)
        long = count >= WORTH_THREADS * len(spans)
        states = [None] * len(self.rules) if blamed is None else blamed.T
        on_cores(push_all, list(zip(self._parts, self._rows, each.T, owns, states, strict=True)), long)
        self.alarm = False
        return np.asarray(each.any(axis=1))


_OPERATORS: Mapping[str, Callable[[float, float], bool]] = {
    "==": operator.eq, "!=": operator.ne, "<=": operator.le, ">=": operator.ge, "<": operator.lt, ">": operator.gt,
}  # fmt: skip
_TEXT = re.compile(r"\s*(?P<topic>[~/\w]+)\s+(?P<field>.+?)\s*(?P<operator>==|!=|<=|>=|<|>)\s*(?P<value>\S+)\s*")
_WORDS = {"true": 1.0, "false": 0.0}


@dataclass(frozen=True)
class Condition:
    """`TOPIC FIELD OPERATOR NUMBER`, for example `/engine/mode data == 3` or `/engine/state position[fan] > 0.2`.

    `topic`: topic of the field; `field`: the field; `operator`: one of == != < <= > >=; `value`: what the field is
    compared with.
    """

    topic: str
    field: FieldPath
    operator: str
    value: float

    @classmethod
    def parse(cls, text: str) -> Condition | None:
        """Read a condition."""
        if not text.strip():
            return None
        match = _TEXT.fullmatch(text)
        try:
            if match is None:
                raise ValueError
            word = match["value"].lower()
            value = _WORDS[word] if word in _WORDS else float(word)
            path = FieldPath(match["field"])
            if value != value:  # NaN compares with nothing
                raise ValueError
        except (ValueError, SignalError):
            raise ModelError(
                f"parameter enable is {text!r}; write TOPIC FIELD OPERATOR NUMBER, for example "
                f"'/engine/mode data == 3', with one of {' '.join(_OPERATORS)}"
            ) from None
        if path.unwrap or path.memory:
            what = "unwrapping" if path.unwrap else path.text.partition("(")[0].strip()
            raise ModelError(f"parameter enable: {path.text} cannot be compared, as {what} needs a history")
        return cls(match["topic"], path, match["operator"], value)

    def holds(self, value: float) -> bool | None:
        """Whether it holds; None if the value is not a number."""
        return _OPERATORS[self.operator](value, self.value) if value == value else None

    def __str__(self) -> str:
        return f"{self.topic} {self.field.text} {self.operator} {self.value:g}"


def steps_back(instant: int, last: int, before: int) -> bool:
    """Whether an instant lies before the last one and not after the one before it.

    A step back to later than that returns from one stamp that lay ahead. Time has stepped back once the next instant
    is not after the last one either; otherwise this was one stamp that lay behind. Neither outlier ends anything.
    """
    return instant < last and instant <= before


def back_and_restarts(t_ns: Integers) -> tuple[Mask, Mask]:
    """`steps_back` at each sample (N+1,), and whether time has stepped back to the one before and stays there."""
    back, restarts = np.zeros((2, len(t_ns)), dtype=bool)
    np.less(t_ns[1:], t_ns[:-1], out=back[1:])
    if not back.any():
        return back, restarts
    back[2:] &= t_ns[2:] <= t_ns[:-2]
    restarts[2:] = back[1:-1] & (t_ns[2:] <= t_ns[:-2])
    return back, restarts


class Armed(NamedTuple):
    """Which samples of a recording may raise the alarm.

    `counts` (N+1,): whether the verdict on the sample counts; otherwise there is no alarm after it; `cleared` (N+1,):
    whether the alarm starts over before the verdict on the sample; `asked` (N+1,): whether the sample is judged.
    """

    counts: Mask
    cleared: Mask
    asked: Mask


class Arming:
    """Whether a verdict may raise the alarm.

    `condition`: none for alarms that always count; `grace_ns`: no alarm this long, ns, in the samples' own time, after
    the first sample, after time jumped back, and after the condition began to hold; `value`: the last value of the
    condition; None while none was received; `on`: whether the condition holds; None while nothing, or nothing that is a
    number, is known. Without a condition True.
    """

    def __init__(self, condition: Condition | None, grace_ns: int, value: float | None = None) -> None:
        self.condition, self.value = condition, value
        self.on = condition is None or (None if value is None else condition.holds(value))
        self._grace = grace_ns
        self._from: int | None = None  # the first instant that counts
        self._counted = False  # whether the last instant did

    def learn(self, value: float) -> None:
        """Take a value of the condition's field."""
        assert self.condition is not None
        self.value = value
        before, self.on = self.on, self.condition.holds(value)
        if self.on and not before:
            self._from = None

    def said_on(self, condition: Condition | None) -> float | None:
        """What is known of the field that another condition asks for."""
        same = condition and self.condition and (condition.topic, condition.field) == (
            self.condition.topic, self.condition.field
        )  # fmt: skip
        return self.value if same else None

    def restart(self, t_ns: int | None = None) -> None:
        """The sample at this instant was the first; None for the next."""
        if t_ns is None:
            self._from = None
        elif self._from is not None:
            self._from = t_ns + self._grace

    def at(self, t_ns: int, steps_back: bool = False) -> bool:
        """Whether a verdict at this instant counts; as the last one if it steps back, perhaps alone."""
        if not self.on:
            self._counted = False
        elif not steps_back:
            if self._from is None:
                self._from = t_ns + self._grace
            self._counted = not self._grace or t_ns >= self._from
        return self._counted

    def over(self, t_ns: Integers, before: Index | Sequence[int] = (), values: ArrayLike = ()) -> Armed:
        """`learn` and `at` over the samples of a recording, as the live session calls them one after the other.

        `t_ns` (N+1,): instants of the samples, ns; a step back starts the grace time over; `before` (K,): samples
        decided before each value of the condition's field came, in order; `values` (K,): these values.
        """
        count = len(t_ns)
        (counts, asked), cleared = np.ones((2, count), dtype=bool), np.zeros(count, dtype=bool)
        if self.condition is None and not self._grace:
            return Armed(counts, cleared, asked)
        arrived = zip(np.asarray(before).tolist(), np.asarray(values, dtype=np.float64).tolist(), strict=True)
        due, value = next(arrived, (count, 0.0))
        back, restarts = (marks.tolist() for marks in back_and_restarts(t_ns))
        for k, instant in enumerate(t_ns.tolist()):
            while due <= k:
                self.learn(value)
                cleared[k] |= not self.on
                due, value = next(arrived, (count, 0.0))
            if restarts[k]:
                self.restart(int(t_ns[k - 1]))
            counts[k] = self.at(instant, back[k])
        return Armed(counts, cleared | ~counts, asked)

    def why_off(self) -> str:
        """Why alarms do not count, in words; empty if they do."""
        if self.on or self.condition is None:
            return ""
        if self.on is not None:
            return f"alarms are off until {self.condition}"
        if self.value is None:
            return f"alarms are off: it is not known whether {self.condition}"
        return f"alarms are off: {self.condition.topic} comes without a number in {self.condition.field.text}"
