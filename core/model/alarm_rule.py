# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Alarm rules: which verdicts, and which statistics of them over a window, raise the alarm."""

from __future__ import annotations

import reprlib
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar

import numpy as np

from uncertain_lti.base.arrays import LARGEST, LONGEST_S
from uncertain_lti.base.errors import ModelError, refuse_other
from uncertain_lti.base.text import plural
from uncertain_lti.model.horizon import MOST_STEPS
from uncertain_lti.model.terms import is_number, is_whole, object_of

LONGEST_WINDOW = 1_000_000
"""Verdicts that the alarm looks at, at most."""
MOST_RULES = 64
"""Rules of one model, at most."""
CONTAINMENT = "containment"
"""Kind of `AlarmRule`."""
_WORDS = {
    "energy": "mean square",
    "mean": "mean",
    "ewma": "moving average",
    "cusum": "cumulative sum",
    "chi2": "chi-square",
    "mewma": "joint moving average",
}
KINDS = tuple(_WORDS)
"""Kinds of `StatisticRule`."""
_ONE_OF = f"one of {', '.join((CONTAINMENT, *KINDS))}"
JOINT = ("chi2", "mewma")
"""Kinds that look at the utilisation of all states together; the others look at that of each state."""
FADING = ("ewma", "cusum", "mewma")
"""Kinds that forget little by little; the others forget what is older than the window."""


@dataclass(frozen=True)
class AlarmRule:
    """Containment: the alarm is raised while `violations` of the last `window` verdicts are violations.

    `violations`: m of the rule; `window`: n of the rule, in verdicts; `margin`: multiplies the half-widths of the
    bounds that are judged; `horizon`: steps of the bounds that are judged.
    """

    kind: ClassVar[str] = CONTAINMENT
    violations: int = 1
    window: int = 1
    margin: float = 1.0
    horizon: int = 1

    def __post_init__(self) -> None:
        _as_in_python(self)
        m, n = self.violations, self.window
        if not (is_whole(m) and is_whole(n) and 1 <= m <= n <= LONGEST_WINDOW):
            raise ModelError(
                f"alarm: violations is {reprlib.repr(m)} of window {reprlib.repr(n)}; it takes whole numbers, "
                f"1 <= violations <= window <= {LONGEST_WINDOW}"
            )
        if not (is_number(self.margin) and 1 / LARGEST <= self.margin <= LARGEST):
            raise _wrong("margin", self.margin, f"a positive number, {1 / LARGEST:g} to {LARGEST:g}")
        object.__setattr__(self, "margin", float(self.margin))
        _check_horizon(self.horizon)

    @property
    def span(self) -> str:
        """Its window in words."""
        return f"{self.violations} of {self.window} verdicts"

    @property
    def words(self) -> str:
        """The rule in words, without its margin."""
        over = "" if self.horizon == 1 else f" over {self.horizon} steps"
        return f"at least {self.span} violated{over}"

    def to_dict(self) -> dict[str, Any]:
        """The rule as the model file holds it."""
        return {"kind": self.kind, "horizon": self.horizon, **asdict(self)}


@dataclass(frozen=True)
class StatisticRule:
    r"""A statistic of the verdicts over a window: the alarm is raised while it exceeds its threshold.

    With the utilisation :math:`u_k` of one state (at the horizon), the step :math:`Δt_k` that ends at verdict k and
    the window T:

    - ``energy``: :math:`\sum u_k^2 Δt_k / T` over the last T seconds under verdict;
    - ``mean``: :math:`|\sum u_k Δt_k / T|` over the same;
    - ``ewma``: :math:`|e_k|` of the low-pass :math:`e_k = e_{k-1} + (u_k - e_{k-1}) Δt_k / (T + Δt_k)`;
    - ``cusum``: the larger of :math:`s_k^± = \max(0, s_{k-1}^± T / (T + Δt_k) + (± u_k - a) Δt_k / T)`, with a the
      allowance: a sum that forgets, so that what it reaches in a session does not grow with its length;
    - ``chi2``: :math:`\sum (u_k - \bar u)^T C^{-1} (u_k - \bar u) Δt_k / T` of the utilisation of all states together,
      or of their residuals, with the mean and the covariance of `UncertainLTI.residuals` or, at a horizon, of
      `Horizon.residuals`;
    - ``mewma``: :math:`e_k^T (s_k C)^{-1} e_k` of its low-pass
      :math:`e_k = e_{k-1} + (u_k - \bar u - e_{k-1}) λ_k`, :math:`λ_k = Δt_k / (T + Δt_k)`, whose covariance is
      :math:`s_k C` with :math:`s_k = (1 - λ_k)^2 s_{k-1} + λ_k^2`: at a constant step :math:`λ / (2 - λ)`, where it
      begins (Lowry et al., Technometrics 34, 1992).

    `kind`: the statistic; `window_s`: T, s; 0 for the last verdict alone, of every kind but ``cusum``; `threshold`:
    what raises the alarm if it is exceeded: of every state, or of each; `horizon`: steps of the bounds whose
    utilisation it takes; `allowance`: a of ``cusum``: the utilisation that adds nothing.
    """

    kind: str
    window_s: float
    threshold: float | tuple[float, ...]
    horizon: int = 1
    allowance: float = 0.0

    def __post_init__(self) -> None:
        _as_in_python(self)
        if self.kind not in KINDS:
            raise _wrong("kind", self.kind, _ONE_OF)
        sums = self.kind == "cusum"
        if not (is_number(self.window_s) and 0.0 <= self.window_s <= LONGEST_S and (self.window_s or not sums)):
            least = "a positive number of seconds" if sums else "a number of seconds, 0 for one verdict"
            raise _wrong(f"window_s of {self.kind}", self.window_s, f"{least}, at most {LONGEST_S:g}")
        each = self.threshold if isinstance(self.threshold, (list, tuple)) else (self.threshold,)
        if not each or not all(is_number(t) and 1 / LARGEST <= t <= LARGEST for t in each):
            must = f"a positive number, or one for each state, {1 / LARGEST:g} to {LARGEST:g}"
            raise _wrong(f"threshold of {self.kind}", self.threshold, must)
        if each is self.threshold:
            if self.kind in JOINT:
                raise ModelError(f"alarm: {self.kind} is one number for all states; give one threshold")
            object.__setattr__(self, "threshold", tuple(map(float, each)))
        _check_horizon(self.horizon)
        if not (is_number(self.allowance) and 0.0 <= self.allowance <= LARGEST):
            raise _wrong("allowance", self.allowance, f"a number, 0 to {LARGEST:g}")
        if self.allowance and not sums:
            raise ModelError(f"alarm: allowance goes with cusum; leave it out of {self.kind}")

    def thresholds(self, n: int) -> tuple[float, ...]:
        """The threshold of each state, or the one of a joint statistic."""
        if self.kind in JOINT:
            return (float(self.threshold),)  # type: ignore[arg-type]  # checked above
        if not isinstance(self.threshold, tuple):
            return (float(self.threshold),) * n
        if len(self.threshold) != n:
            raise ModelError(
                f"alarm: {self.kind} has {plural(len(self.threshold), 'threshold')} for {plural(n, 'state')}"
            )
        return self.threshold

    @property
    def span(self) -> str:
        """Its window in words."""
        return f"over {self.window_s:.3g} s" if self.window_s else "of one verdict"

    @property
    def words(self) -> str:
        """The rule in words."""
        over = "" if self.horizon == 1 else f" at {self.horizon} steps"
        what = f"{_WORDS[self.kind]} of the utilisation{over}"
        limits = self.threshold if isinstance(self.threshold, tuple) else (self.threshold,)
        low, high = f"{min(limits):.3g}", f"{max(limits):.3g}"
        return f"{what} {self.span} above {low if low == high else f'{low} to {high}'}"

    def to_dict(self) -> dict[str, Any]:
        """The rule as the model file holds it."""
        threshold = list(self.threshold) if isinstance(self.threshold, tuple) else self.threshold
        found = {"kind": self.kind, "horizon": self.horizon, "window_s": self.window_s, "threshold": threshold}
        return found | ({"allowance": self.allowance} if self.kind == "cusum" else {})


Rule = AlarmRule | StatisticRule
"""One rule of an alarm."""


def labels(rules: Sequence[Rule]) -> tuple[str, ...]:
    """What each rule is called: its kind, `@` its horizon if that is not 1, and `#2` if it is the second so named."""
    found: list[str] = []
    seen: dict[str, int] = {}
    for rule in rules:
        label = rule.kind if rule.horizon == 1 else f"{rule.kind}@{rule.horizon}"
        seen[label] = number = seen.get(label, 0) + 1
        found.append(label if number == 1 else f"{label}#{number}")
    return tuple(found)


def containment(rules: Iterable[Rule]) -> AlarmRule | None:
    """The rule that judges one-step bounds."""
    return next((rule for rule in rules if isinstance(rule, AlarmRule) and rule.horizon == 1), None)


def _as_in_python(rule: Rule) -> None:
    """Put numbers of Python, which a model file holds, in place of those of numpy."""
    for one in fields(rule):
        if isinstance(value := getattr(rule, one.name), np.generic):
            object.__setattr__(rule, one.name, value.item())


def with_containment(rules: Sequence[Rule], rule: AlarmRule) -> tuple[Rule, ...]:
    """The rules with another one for one-step bounds."""
    before = containment(rules)
    return tuple(rule if r is before else r for r in rules) if before is not None else (rule, *rules)


def checked_rules(rules: Sequence[Rule]) -> tuple[Rule, ...]:
    """The rules of one alarm."""
    refuse_other(rules, Iterable, "alarm", "give a list of AlarmRule or StatisticRule", ModelError)
    rules = tuple(rules)
    for rule in rules:
        refuse_other(rule, (AlarmRule, StatisticRule), "alarm: a rule", "give AlarmRule or StatisticRule", ModelError)
    if not 1 <= len(rules) <= MOST_RULES:
        raise ModelError(f"alarm: {plural(len(rules), 'rule')}; an alarm has 1 to {MOST_RULES}")
    if sum(isinstance(rule, AlarmRule) and rule.horizon == 1 for rule in rules) > 1:
        raise ModelError("alarm: two containment rules for one step; flags need one margin, so leave one out")
    return rules


def rule_from_dict(data: Any, name: str = "alarm.rules") -> Rule:
    """A rule as the model file holds it."""
    data = object_of(data, name)
    kind = data.get("kind")
    if kind not in (CONTAINMENT, *KINDS):
        raise ModelError(f"field '{name}.kind' is {reprlib.repr(kind)}; it must be {_ONE_OF}")
    needed = ("violations", "window", "margin") if kind == CONTAINMENT else ("window_s", "threshold")
    known = {"kind", "horizon", *needed} | ({"allowance"} if kind == "cusum" else set())
    object_of(data, name, known, needed, remedy=f"{kind} needs {' and '.join(needed)}")
    values = {key: value for key, value in data.items() if key != "kind"}
    try:
        return AlarmRule(**values) if kind == CONTAINMENT else StatisticRule(kind, **values)
    except ModelError as error:
        raise ModelError(f"field '{name}': {str(error).removeprefix('alarm: ')}") from None


def _check_horizon(horizon: Any) -> None:
    if not (is_whole(horizon) and 1 <= horizon <= MOST_STEPS):
        raise _wrong("horizon", horizon, f"a whole number of steps, 1 to {MOST_STEPS}")


def _wrong(name: str, value: Any, must: str) -> ModelError:
    return ModelError(f"alarm: {name} is {reprlib.repr(value)}; it must be {must}")
