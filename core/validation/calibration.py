# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Calibration: the alarm rule that keeps to a target rate of false alarms, by what was left out of the fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.errors import FitError, ModelError
from uncertain_lti.model.alarm_rule import AlarmRule, Rule, containment
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.validation.armed import FEWEST_STEPS, SUPPORT, Armed, Family, families, kinds_of
from uncertain_lti.validation.detectable import (
    COMPARED,
    COMPARED_CASES,
    LARGEST,
    Detectable,
    check_within,
    detectable,
    log_sizes,
    typical_within,
)
from uncertain_lti.validation.false_alarms import borrowed_margin, peaks
from uncertain_lti.validation.intervals import cluster_size, rate_interval
from uncertain_lti.validation.part import Part, by_unit
from uncertain_lti.validation.result import Validation, short_condition

FACTORS = tuple(round(float(m), 12) for m in np.geomspace(4.0, 0.5, 106))
"""Factors on margins and thresholds, from the largest down, about 2 % apart. No margin goes below 1, where samples like
those that were fitted would count as violations."""
BLIND = 0.5
"""A state of which not even a bias, or a drift within the time, of this share of its range is seen gets a warning."""
WORTH = 0.02
"""A rule must detect faults smaller by this share, on average, to be taken before a plainer one."""


@dataclass(frozen=True)
class Candidate:
    """One alarm rule, or several armed together, at the smallest factor that keeps to the target.

    `family`: what is armed, but for its thresholds; `margin`: of one-step bounds, the smallest; None if none keeps to
    the target; `alarms`: false alarms on the left-out parts; `upper`: one-sided upper confidence limit of the false
    alarms per hour; `rules`: all that are armed; empty if none keeps to the target; `faults`: the smallest faults that
    are detected; None if none keeps to the target.
    """

    family: Family
    margin: float | None
    alarms: int
    upper: float
    rules: tuple[Rule, ...] = ()
    faults: Detectable | None = field(default=None, repr=False)

    @property
    def violations(self) -> int:
        """m of the rule."""
        return self.family.violations

    @property
    def window(self) -> int:
        """n of the rule, in verdicts; of statistics in median steps."""
        return self.family.window

    @property
    def size(self) -> float:
        """Geometric mean of the smallest detectable sizes over the largest tried; 1 if nothing is known of them."""
        known = _relative(self.faults)
        return math.exp(float(known.mean())) if len(known) else 1.0


def _relative(faults: Detectable | None) -> NDArray[np.float64]:
    """Logarithms of the sizes that are known, over the largest tried."""
    if faults is None:
        return np.zeros(0)
    largest = np.array([f.largest for f in faults.faults])
    sizes = log_sizes([(f.thresholds, f.largest) for f in faults.faults])
    known = np.isfinite(sizes)
    return np.asarray(sizes[known] - np.log(largest[known]))


@dataclass(frozen=True)
class Calibration:
    """The alarm rule that `calibrate` chose, and all it tried.

    `alarm_rule`: for one-step containment; None if no rule can be shown to keep to the target; `target`: target rate:
    false alarms per hour at most; `confidence`: that the true rate is below the target; `hours`: time under verdict in
    the left-out parts, h; `needed_hours`: time without a false alarm that would show the target, h; `within`: time
    within which the faults are seen by which rules were compared, s; `candidates`: one per rule tried; `words`: the
    outcome as a sentence; `warning`: what the chosen rule does not detect; empty if it sees biases or drifts of BLIND
    of the range of every state; `rules`: all that were chosen to be armed together, for `UncertainLTI.alarm`; empty
    without a choice.
    """

    alarm_rule: AlarmRule | None
    target: float
    confidence: float
    hours: float
    needed_hours: float
    within: float
    candidates: tuple[Candidate, ...]
    words: str
    warning: str = ""
    rules: tuple[Rule, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Plain data for the model file."""
        return {
            "target_per_hour": self.target,
            "confidence": self.confidence,
            "hours": self.hours,
            "needed_hours": self.needed_hours,
            "reached": self.alarm_rule is not None,
            "words": self.words,
            "warning": self.warning,
            "within": self.within,
            "faults": list(COMPARED),
            "candidates": [
                {
                    "violations": c.violations,
                    "window": c.window,
                    "margin": c.margin,
                    "alarms": c.alarms,
                    "upper_per_hour": c.upper if math.isfinite(c.upper) else None,
                    "window_s": c.family.window_s,
                    "statistics": list(c.family.kinds),
                    "rules": [rule.to_dict() for rule in c.rules],
                    "size": c.size if c.rules else None,
                    "sizes": [
                        {"kind": f.kind, "signal": f.signal, "unit": f.unit, "size": f.size}
                        for f in (c.faults.faults if c.faults is not None else ())
                        if math.isfinite(f.size)
                    ],
                }
                for c in self.candidates
            ],
        }


def calibrate(
    validation: Validation,
    target: float,
    *,
    within: float | None = None,
    rules: Sequence[tuple[int, int]] | None = None,
    statistics: Sequence[str] | str = (),
    confidence: float | None = None,
) -> Calibration:
    """Find the rule and margin whose false alarms stay below a target, and which then detect the smallest faults.

    For each rule, factors on its margins and thresholds are tried from the largest down, as long as the upper
    confidence limit of the false alarms on the left-out parts stays at or below the target; going in a fixed order and
    stopping at the first failure, the confidence of one test holds for the whole search. No margin goes below 1. The
    error is shared equally among the candidates, so that choosing among them costs no confidence; where the recordings
    could not show the target for so many even without an alarm, the longest m of n are not tried. A candidate is m of n
    violations, or statistics over one window (each of those named, and all together) beside containment of every
    verdict; all of it also over every horizon of the model. The alarms of all together are counted, while one factor
    lowers all thresholds on the scale that the peaks on what was left out give (`armed`). Chosen is the candidate
    with the smallest detectable faults (`detectable`: biases, drifts and noise of every state, offsets of every
    control; geometric mean), and of those within WORTH of it the plainest.

    Parameters
    ----------
    validation : Validation
        Of `validate`; its parts are what the search counts on.
    target : float
        Target rate: false alarms per hour at most.
    within : float, optional
        Time within which faults shall be seen, s; default `typical_within`.
    rules : sequence of (int, int), optional
        (violations, window) of each rule of containment; default those of `armed.COUNTED` that the recordings support.
    statistics : sequence of str, or str, optional
        Kinds of statistics to try, with commas between them in one text; `all` for every kind.
    confidence : float, optional
        That the true rate is below the target; default that of the validation.

    Returns
    -------
    Calibration
        The rules, or the reason why there is none.

    Raises
    ------
    FitError
        The target or the time is not positive, a rule or a statistic is none, or the recordings are too short for a
        window.
    """
    if not (math.isfinite(target) and target > 0):
        raise FitError(f"the target is {target} false alarms per hour; give a positive number")
    check_within(within)
    model, parts = validation.model, validation.parts
    within = typical_within(parts) if within is None else within
    dt = model.sampling.dt_median or 0.0
    kinds = kinds_of(statistics) if statistics else ()
    sets = [(kind,) for kind in kinds] + ([kinds] if len(kinds) > 1 else [])
    tried = families(parts, dt, sets)
    if kinds and not any(family.kinds for family in tried):
        raise FitError(
            f"statistics need windows of at least {FEWEST_STEPS} steps, and the parts left out are shorter than "
            f"{SUPPORT} of them; record longer, or leave statistics out"
        )
    if rules is not None:
        for m, n in rules:
            if not 1 <= m <= n:
                raise FitError(f"alarm rule {m} of {n}: it takes 1 <= violations <= window")
        tried = [Family((), n, m, dt) for m, n in rules] + [family for family in tried if family.kinds]
    if not tried:
        raise FitError("no alarm rule to choose from; give at least one (violations, window)")
    confidence = validation.confidence if confidence is None else confidence
    hours = sum(p.hours for p in parts)

    def without_alarm(candidates: int) -> float:
        """Time without a false alarm that shows the target, h, where the error is shared among so many."""
        one = 1.0 - (1.0 - confidence) / candidates
        return float(rate_interval(np.zeros(validation.units), 1.0, one, one_sided=True)[1]) / target

    if rules is None:
        tried = _affordable(tried, lambda count: without_alarm(count) <= hours)
    each = 1.0 - (1.0 - confidence) / len(tried)
    candidates = tuple(_candidate(model, parts, family, target, each, hours, within) for family in tried)
    needed = without_alarm(len(tried))
    found = [c for c in candidates if c.margin is not None]
    if not found:
        words = _refusal(candidates, target, hours, needed)
        return Calibration(None, target, confidence, hours, needed, within, candidates, words)
    least = min(c.size for c in found)
    best = next(c for c in found if c.size <= least * (1.0 + WORTH))
    assert best.margin is not None and best.faults is not None
    words = (
        f"alarm at {_what(best)}: at "
        f"most {target:g} false alarms per hour with {confidence:.0%} confidence {short_condition(validation)} "
        f"({best.alarms} in {hours:.3g} h left "
        f"out, limit {best.upper:.3g} per hour); {_sees(best.faults, model.state_names)}"
    )
    one_step = containment(best.rules)
    warning = _insensitive(best.faults, model.state_names)
    return Calibration(one_step, target, confidence, hours, needed, within, candidates, words, warning, best.rules)


def _affordable(tried: list[Family], enough: Callable[[int], bool]) -> list[Family]:
    """As many m of n, the plainest first, as the recordings are enough for; all of them if they never are."""
    counted = [family for family in tried if not family.kinds]
    for dropped in range(len(counted)):
        if enough(len(tried) - dropped):
            late = counted[len(counted) - dropped :]
            return [family for family in tried if family not in late]
    return tried


def _candidate(
    model: UncertainLTI, parts: Sequence[Part], family: Family, target: float, confidence: float, hours: float,
    within: float,
) -> Candidate:  # fmt: skip
    """What a family is armed with at the smallest factor that keeps to the target, and what that detects."""
    armed = Armed(family.rules(model), parts)
    largest = peaks(parts, armed.levels)
    limits = [math.inf]

    def keeps(factor: float, counts: NDArray[np.intp]) -> bool:
        typical = cluster_size(by_unit(parts, armed.counts(borrowed_margin(largest, factor))))
        limits.append(rate_interval(by_unit(parts, counts), hours, confidence, typical, one_sided=True)[1])
        return limits[-1] <= target

    found = armed.lowest(FACTORS, keeps)
    if found is None:
        return Candidate(family, None, int(armed.counts(FACTORS[0]).sum()), limits[1])
    factor, counts = found
    rules = armed.at(factor)
    upper = limits[1 + FACTORS.index(factor)]
    one_step = containment(rules)
    assert one_step is not None
    try:
        faults = detectable(model.replace(alarm=rules), parts, within, kinds=COMPARED, cases=COMPARED_CASES)
    except ModelError as error:
        raise FitError(f"the alarm {family.words} cannot be tried: {error}") from None
    return Candidate(family, one_step.margin, int(counts.sum()), upper, rules, faults)


def _what(candidate: Candidate) -> str:
    """The rules of a candidate in words."""
    family = candidate.family
    if len(candidate.rules) == 1:
        window = f" ({family.window_s:.3g} s)" if family.window > 1 else ""
        return (
            f"{family.violations} of {family.window} verdicts{window} outside {candidate.margin:.3g} times the "
            f"half-widths"
        )
    found = []
    for rule in candidate.rules:
        if isinstance(rule, AlarmRule):
            over = "" if rule.horizon == 1 else f" over {rule.horizon} steps"
            count = "a verdict" if rule.window == 1 else f"{rule.violations} of {rule.window} verdicts"
            found.append(f"{count}{over} outside {rule.margin:.3g} times the half-widths")
        else:
            found.append(rule.words)
    return ", or ".join(found)


def _sees(faults: Detectable, names: Sequence[str]) -> str:
    """The largest of the smallest detectable biases, in words."""
    biases = [
        (f, f.size / f.largest) for name in names if (f := faults.find("bias", name)) is not None and not f.refused
    ]
    if not biases:
        return f"which faults it sees within {faults.within:.3g} s is unknown: {faults.refused}"
    worst, share = max(biases, key=lambda pair: pair[1])
    if not math.isfinite(share):
        return f"within {faults.within:.3g} s it does not see a bias of {worst.largest:.3g} {worst.unit}".rstrip() + (
            f" of {worst.signal} in 90% of the cases"
        )
    unit = f" {worst.unit}" if worst.unit else ""
    beside = ", and relatively smaller ones of the other states" if len(biases) > 1 else ""
    return (
        f"within {faults.within:.3g} s it sees in 90% of the cases a bias of {worst.size:.3g}{unit} of {worst.signal} "
        f"({LARGEST * share:.2g} times its range){beside}"
    )


def _insensitive(faults: Detectable, names: Sequence[str]) -> str:
    """Warning that a rule misses biases and drifts of BLIND of the range of some states."""
    missed = []
    for name in names:
        known = [f for kind in ("bias", "drift") if (f := faults.find(kind, name)) is not None and not f.refused]
        if known and min(LARGEST * f.size / f.largest for f in known) > BLIND:
            missed.append(name)
    if not missed:
        return ""
    return (
        f"this rule keeps quiet by seeing little: a bias of {BLIND:g} times the range of {', '.join(missed)} is not "
        f"seen within {faults.within:.3g} s in 90% of the cases; accept more false alarms per hour, or record more"
    )


def _refusal(candidates: Sequence[Candidate], target: float, hours: float, needed: float) -> str:
    if hours < needed:
        return (
            f"no alarm rule can be shown to stay below {target:g} false alarms per hour: the left-out recordings cover "
            f"{hours:.3g} h, and even without a single alarm {needed:.3g} h are needed; record more, or "
            f"choose a higher target"
        )
    best = min(candidates, key=lambda c: c.upper)
    return (
        f"no alarm rule can be shown to stay below {target:g} false alarms per hour: even at {FACTORS[0]:g} times the "
        f"half-widths, {best.family.words} raises {best.alarms} alarms in {hours:.3g} h left "
        f"out (limit {best.upper:.3g} per hour); look at what leaves the envelope so far, or choose a higher target"
    )
