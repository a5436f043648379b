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
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import FitError
from uncertain_lti.model.alarm_rule import AlarmRule, Rule, StatisticRule, containment
from uncertain_lti.monitor.alarm import Alarm, raised, residual_row
from uncertain_lti.validation.armed import SUPPORT, WINDOWS, Armed, kinds_of, sets_of, supported_windows
from uncertain_lti.validation.false_alarms import borrowed_margin, peaks
from uncertain_lti.validation.intervals import cluster_size, rate_interval
from uncertain_lti.validation.part import Part, by_unit, rising
from uncertain_lti.validation.result import Validation, short_condition

RULES = ((1, 1), (3, 5), (5, 10), (8, 20), (20, 50), (40, 100), (80, 200), (200, 500), (400, 1000))
"""(violations, window) tried by default, up to the longest window that the recordings support."""
MARGINS = tuple(round(float(m), 12) for m in np.geomspace(4.0, 0.5, 106))
"""Margins tried, from the largest, about 2 % apart: down to 1, below which samples like those that were fitted would
count as violations. Factors on the thresholds of statistics go on to the end."""
FAULT_SIZE = 1.0
"""Size of the reference fault: one state moves by this many mean widths more in every step."""
FAINT = (0.25, 0.5, 1.0)
"""Sizes of the faults by which a rule is chosen: small ones that last count as much as large ones."""
BLIND = 0.5
"""A rule that detects a smaller share of the reference faults on some state gets a warning: it is insensitive."""
STARTS = 8
"""Instants per left-out part at which the reference fault is added, with either sign; fewer if there are many parts."""
_TRIALS, _VERDICTS = 64, 3e7
# instants over all parts, and verdicts times states that statistics are tried on with a fault, about, for one set


@dataclass(frozen=True)
class Candidate:
    """One alarm rule at the smallest margin that keeps to the target.

    Parameters
    ----------
    violations : int
        m of the rule.
    window : int
        n of the rule, in verdicts.
    margin : float or None
        The smallest margin; None if none keeps to the target.
    alarms : int
        False alarms on the left-out parts at that margin.
    upper : float
        One-sided upper confidence limit of the false alarms per hour.
    detected : array (n,)
        Share of the reference faults on each state that raise the alarm before the part ends.
    delay : array (n,)
        Median time to the alarm, s; inf if most are missed.
    faint : array (n,)
        Share of the faults of every size of FAINT, of either sign and of a sign that changes, that raise the alarm.
    rules : tuple of AlarmRule or StatisticRule
        All that are armed, at the smallest factor on their thresholds; empty if none keeps to the target.
    window_s : float
        The longest window, s.
    """

    violations: int
    window: int
    margin: float | None
    alarms: int
    upper: float
    detected: Array
    delay: Array
    faint: Array
    rules: tuple[Rule, ...]
    window_s: float


@dataclass(frozen=True)
class Calibration:
    """The alarm rule that `calibrate` chose, and all it tried.

    Parameters
    ----------
    alarm_rule : AlarmRule or None
        For one-step containment; None if no rule can be shown to keep to the target.
    target : float
        Target rate: false alarms per hour at most.
    confidence : float
        That the true rate is below the target.
    hours : float
        Time under verdict in the left-out parts, h.
    needed_hours : float
        Time without a false alarm that would show the target, h.
    candidates : tuple of Candidate
        One per rule tried.
    words : str
        The outcome as a sentence.
    warning : str, default ""
        What the chosen rule does not detect; empty if it detects at least BLIND of the reference faults on every state.
    rules : tuple of AlarmRule or StatisticRule
        All that were chosen to be armed together, for `UncertainLTI.alarm`; empty without a choice.
    """

    alarm_rule: AlarmRule | None
    target: float
    confidence: float
    hours: float
    needed_hours: float
    candidates: tuple[Candidate, ...]
    words: str
    warning: str = ""
    rules: tuple[Rule, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Plain data for the model file.

        Returns
        -------
        dict
            Plain data for JSON; null for what is infinite.
        """
        return {
            "target_per_hour": self.target,
            "confidence": self.confidence,
            "hours": self.hours,
            "needed_hours": self.needed_hours,
            "reached": self.alarm_rule is not None,
            "words": self.words,
            "warning": self.warning,
            "fault": f"one state moved by {FAULT_SIZE:g} mean width more in every step",
            "candidates": [
                {
                    "violations": c.violations,
                    "window": c.window,
                    "margin": c.margin,
                    "alarms": c.alarms,
                    "upper_per_hour": c.upper if math.isfinite(c.upper) else None,
                    "detected": c.detected.tolist(),
                    "delay": [d if math.isfinite(d) else None for d in c.delay.tolist()],
                    "faint": c.faint.tolist(),
                    "window_s": c.window_s,
                    "rules": [rule.to_dict() for rule in c.rules],
                }
                for c in self.candidates
            ],
        }


def calibrate(
    validation: Validation,
    target: float,
    *,
    rules: Sequence[tuple[int, int]] | None = None,
    statistics: Sequence[str] | str = (),
    confidence: float | None = None,
) -> Calibration:
    """Find the rule and margin whose false alarms stay below a target, and which then detect small faults best.

    For each rule, margins are tried from the largest down to 1, as long as the upper confidence limit of the false
    alarms on the left-out parts stays at or below the target; going in a fixed order and stopping at the first failure,
    the confidence of one test holds for the whole search. The error is shared equally among the candidates, so that
    choosing among them costs no confidence. With statistics, a candidate arms all of them over one window, and the
    containment of one step and of every horizon: the alarms of all together are counted, while one factor lowers all
    thresholds on the scale that the peaks on the other recordings give (`armed`). Chosen is the candidate that detects
    the largest share of the faults of the sizes FAINT on the state where it detects least, then over all states, then
    the one that detects the reference fault first.

    Parameters
    ----------
    validation : Validation
        Of `validate`; its parts are what the search counts on.
    target : float
        Target rate: false alarms per hour at most.
    rules : sequence of (int, int), optional
        (violations, window) of each rule of containment; default those of RULES that the recordings support, or none
        with statistics.
    statistics : sequence of str, or str, optional
        Kinds of statistics to arm together, with commas between them in one text; `all` for every kind.
    confidence : float, optional
        That the true rate is below the target; default that of the validation.

    Returns
    -------
    Calibration
        The rules, or the reason why there is none.

    Raises
    ------
    FitError
        The target is not positive, a rule or a statistic is none, or the recordings are too short for a window.
    """
    if not (math.isfinite(target) and target > 0):
        raise FitError(f"the target is {target} false alarms per hour; give a positive number")
    model, parts = validation.model, validation.parts
    dt = model.sampling.dt_median or 0.0
    supported = supported_windows(parts, dt) if dt else []
    if rules is None:
        rules = [] if statistics else [(m, n) for m, n in RULES if n <= max(10, *supported, 10)]
    sets = sets_of(kinds_of(statistics), model, supported) if statistics else []
    if not (rules or sets):
        if statistics:
            raise FitError(
                f"statistics need windows of at least {WINDOWS[0]} steps, and the parts left out are shorter than "
                f"{SUPPORT} of them; record longer, or leave statistics out"
            )
        raise FitError("no alarm rule to choose from; give at least one (violations, window)")
    for m, n in rules:
        if not 1 <= m <= n:
            raise FitError(f"alarm rule {m} of {n}: it takes 1 <= violations <= window")
    confidence = validation.confidence if confidence is None else confidence
    each = 1.0 - (1.0 - confidence) / (len(rules) + len(sets))
    hours = sum(p.hours for p in parts)
    candidates = tuple(_containment(parts, m, n, target, each, hours, dt) for m, n in rules)
    candidates += tuple(_together(parts, chosen, target, each, hours) for chosen in sets)
    needed = rate_interval(np.zeros(validation.units), 1.0, each, one_sided=True)[1] / target
    found = [c for c in candidates if c.margin is not None]
    if not found:
        return Calibration(
            None, target, confidence, hours, needed, candidates, _refusal(candidates, target, hours, needed)
        )
    best = max(found, key=_worth)
    assert best.margin is not None
    names = model.state_names
    slow = int(np.lexsort((-best.detected, best.delay))[-1])  # of those never seen by half, the least seen
    missed = 1.0 - float(best.detected[slow])
    words = (
        f"alarm at {_what(best)}: at "
        f"most {target:g} false alarms per hour with {confidence:.0%} confidence {short_condition(validation)} "
        f"({best.alarms} in {hours:.3g} h left "
        f"out, limit {best.upper:.3g} per hour); a fault that moves one state by {FAULT_SIZE:g} mean width more in "
        f"every step is seen "
        + (
            f"after {best.delay[slow]:.3g} s (median; slowest state: {names[slow]}; {missed:.0%} missed)"
            if math.isfinite(best.delay[slow])
            else f"in {best.detected[slow]:.0%} of the cases only (worst state: {names[slow]})"
        )
        + f"; of faults of {', '.join(f'{size:g}' for size in FAINT[:-1])} and {FAINT[-1]:g} mean widths "
        f"{float(best.faint.mean()):.0%}"
    )
    rule = AlarmRule(best.violations, best.window, best.margin)
    return Calibration(
        rule, target, confidence, hours, needed, candidates, words, _insensitive(best.detected, names), best.rules
    )


def _worth(candidate: Candidate) -> tuple[float, float, float, float]:
    """By what a candidate is chosen: the largest is best."""
    faint = np.round(candidate.faint, 3)
    return float(faint.min()), float(faint.mean()), -float(candidate.delay.max()), -(candidate.margin or 0.0)


def _what(candidate: Candidate) -> str:
    """The rules of a candidate in words."""
    if len(candidate.rules) == 1:
        window = f" ({candidate.window_s:.3g} s)" if candidate.window > 1 else ""
        return (
            f"{candidate.violations} of {candidate.window} verdicts{window} outside {candidate.margin:.3g} times the "
            f"half-widths"
        )
    found = []
    for rule in candidate.rules:
        if isinstance(rule, AlarmRule):
            over = "" if rule.horizon == 1 else f" over {rule.horizon} steps"
            found.append(f"a verdict{over} outside {rule.margin:.3g} times the half-widths")
        else:
            found.append(rule.words)
    return ", or ".join(found)


def _insensitive(detected: Array, names: Sequence[str]) -> str:
    """Warning that a rule, which detects the shares `detected` (n,) of the reference faults, misses most on some."""
    missed = [f"{name} in {share:.0%}" for name, share in zip(names, detected, strict=True) if not share >= BLIND]
    if not missed:
        return ""
    return (
        f"this rule keeps quiet by seeing little: a fault that moves one state by {FAULT_SIZE:g} mean width more in "
        f"every step is seen on {', '.join(missed)} of the cases; accept more false alarms per hour, or record more"
    )


def _containment(
    parts: Sequence[Part], m: int, n: int, target: float, confidence: float, hours: float, dt: float
) -> Candidate:
    """m of n one-step violations at the smallest margin that keeps to the target."""
    levels = [p.level(m, n) for p in parts]
    margin, count, limit = _search(parts, levels, target, confidence, hours, least=1.0)
    rules = () if margin is None else (AlarmRule(m, n, margin),)
    return _candidate(parts, m, n, margin, count, limit, rules, n * dt)


def _together(
    parts: Sequence[Part], rules: Sequence[Rule], target: float, confidence: float, hours: float
) -> Candidate:
    """Rules armed together, at the smallest factor on their thresholds that keeps to the target."""
    armed = Armed(rules, parts)
    factor, count, limit = _search(parts, armed.levels, target, confidence, hours)
    chosen = () if factor is None else armed.at(factor)
    longest = max(rule.window_s for rule in rules if isinstance(rule, StatisticRule))
    one_step = containment(chosen)
    return _candidate(parts, 1, 1, one_step.margin if one_step else None, count, limit, chosen, longest)


def _search(
    parts: Sequence[Part],
    levels: Sequence[Array],
    target: float,
    confidence: float,
    hours: float,
    least: float = 0.0,
) -> tuple[float | None, int, float]:
    """The smallest of MARGINS whose alarms keep to the target, their number, and the upper limit of their rate."""
    counts = by_unit(
        parts,
        [[rising(level > margin, p.starts) for p, level in zip(parts, levels, strict=True)] for margin in MARGINS],
    )
    largest = peaks(parts, levels)
    chosen, count, limit = None, 0, math.inf
    for margin, row in zip(MARGINS, counts, strict=True):
        if margin < least:
            break
        nearby = int(np.argmax(np.array([*MARGINS, 0.0]) <= borrowed_margin(largest, margin)))
        typical = cluster_size(counts[min(nearby, len(counts) - 1)])
        upper = rate_interval(row, hours, confidence, typical, one_sided=True)[1]
        if upper > target:
            if chosen is None:
                count, limit = int(row.sum()), upper
            break
        chosen, count, limit = margin, int(row.sum()), upper
    return chosen, count, limit


def _candidate(
    parts: Sequence[Part],
    m: int,
    n: int,
    margin: float | None,
    count: int,
    limit: float,
    rules: tuple[Rule, ...],
    window_s: float,
) -> Candidate:
    if margin is None:
        nothing = np.full(parts[0].utilisation.shape[1], np.nan)
        return Candidate(m, n, None, count, limit, nothing, nothing, nothing, rules, window_s)
    detected, delay = detection(parts, rules)
    faint = [_shares(_times(parts, rules, size, (1.0, -1.0, 0.0))) for size in FAINT]
    return Candidate(m, n, margin, count, limit, detected, delay, np.mean(faint, axis=0), rules, window_s)


def detection(
    parts: Sequence[Part], rules: AlarmRule | Sequence[Rule], size: float = FAULT_SIZE
) -> tuple[Array, Array]:
    """Share of reference faults that raise the alarm, and the time to it.

    The fault: from one verdict on, one state moves by `size` mean widths of its bounds more in every step than
    recorded, in either direction, the step still starting from the measured state; over a horizon the steps add up, as
    far as the nominal model keeps what is added to the state. It is added to the left-out parts at STARTS instants
    each, to fewer if there are many; one that is not detected before the part ends counts as missed (infinite time).

    Parameters
    ----------
    parts : sequence of Part
        Left-out parts.
    rules : AlarmRule, or sequence of AlarmRule and StatisticRule
        What is armed.
    size : float, optional
        Of the fault, in mean widths; default FAULT_SIZE.

    Returns
    -------
    array (n,)
        Share detected, of the faults on each state; NaN without a verdict.
    array (n,)
        Median time to the alarm, s.
    """
    times = _times(parts, (rules,) if isinstance(rules, AlarmRule) else rules, size, (1.0, -1.0))
    return _shares(times), np.array([np.median(t) if t else np.nan for t in times])


def _shares(times: Sequence[Sequence[float]]) -> Array:
    return np.array([np.mean(np.isfinite(t)) if t else np.nan for t in times])


def _times(parts: Sequence[Part], rules: Sequence[Rule], size: float, signs: Sequence[float]) -> list[list[float]]:
    """Time from each fault on each state to the alarm, s; a sign of 0 stands for one that changes at random."""
    n = parts[0].utilisation.shape[1]
    times: list[list[float]] = [[] for _ in range(n)]
    starts = max(1, min(STARTS, _TRIALS // len(parts)))
    looks = any(rule.kind != "containment" or rule.horizon > 1 for rule in rules)
    most = int(max(200, _VERDICTS / (starts * len(parts) * n * n * len(signs)))) if looks else None
    for part in parts:
        K = part.judged
        if K == 0:
            continue
        clock = np.cumsum(part.dt)
        table = part.table if looks else part.utilisation[:, None]
        anyway = _alarm(part, rules, table, 0)  # alarms that are not the fault's
        rng = np.random.default_rng(0)
        for start in sorted({int(s) for s in np.linspace(0, max(K - 1, 0), starts + 1)[:-1]}):
            first, stop = 0, K
            if most is not None:
                first, stop = max(0, start - _memory(part, rules)), min(K, start + most)
            for i in range(n):
                for sign in signs:
                    moved = table[first:stop].copy()
                    shift = rng.choice([-1.0, 1.0], stop - start) if sign == 0.0 else np.full(stop - start, sign)
                    _add_fault(part, moved[start - first :], start, i, size * shift, looks)
                    alarm = _alarm(part, rules, moved, first)
                    seen = np.flatnonzero(alarm[start - first :] & ~anyway[start:stop])
                    before = clock[start] - part.dt[start]
                    times[i].append(float(clock[start + seen[0]] - before) if len(seen) else math.inf)
    return times


def _add_fault(part: Part, table: Array, start: int, i: int, shift: Array, longer: bool) -> None:
    """Move state i by `shift` mean widths in each step from the verdict `start` on, in the rows of the table."""
    # one mean width is 2 mean half-widths; half_k follows from the sample's own width
    table[:, 0, i] += 2.0 * shift * part.narrowness[start : start + len(table), i]
    model = part.judged_by
    if not longer or model is None:
        return
    width = float(part.mean_width[i] / model.operating_point.X[i])
    first = residual_row(model)
    table[:, first, i] += shift * width
    dt = float(np.median(part.dt))
    kept = float(np.clip(1.0 + dt * np.mean(model.A[..., i, i]), 0.0, 1.0))  # of what was added, after one step
    for j, horizon in enumerate(model.horizons):
        weights = kept ** np.arange(horizon.steps)
        added = np.convolve(shift, weights)[: len(shift)] * width
        half = 0.5 * part.longer_width[j, i] / model.operating_point.X[i]
        table[:, 1 + j, i] += added / max(half, 1e-300) if half == half else 0.0
        table[:, first + 1 + j, i] += added


def _memory(part: Part, rules: Sequence[Rule]) -> int:
    """Verdicts before a fault that the rules still remember when it begins."""
    dt = max(float(np.median(part.dt)), 1e-12)
    windows = [rule.window if isinstance(rule, AlarmRule) else 3.0 * rule.window_s / dt for rule in rules]
    return int(max(windows)) + 1


def _alarm(part: Part, rules: Sequence[Rule], table: Array, first: int) -> NDArray[np.bool_]:
    """The alarm of some rules over the verdicts of a part from `first` on, with the numbers of this table."""
    stop = first + len(table)
    found = np.zeros(len(table), dtype=bool)
    one_step = containment(rules)
    violated = np.abs(table[:, 0]).max(axis=1) > (one_step.margin if one_step else math.inf)
    for a, b in part.spans:
        a, b = max(a, first) - first, min(b, stop) - first
        if a >= b:
            continue
        if len(rules) == 1 and one_step is not None:
            found[a:b] = raised(violated[a:b], one_step)
        else:
            assert part.judged_by is not None
            alarm = Alarm(rules, part.judged_by, np.ones(table.shape[2], dtype=bool))
            found[a:b] = alarm.over(part.dt[first + a : first + b], violated[a:b], table[a:b])[0]
    return found


def _refusal(candidates: Sequence[Candidate], target: float, hours: float, needed: float) -> str:
    if hours < needed:
        return (
            f"no alarm rule can be shown to stay below {target:g} false alarms per hour: the left-out recordings cover "
            f"{hours:.3g} h, and even without a single alarm {needed:.3g} h are needed; record more, or "
            f"choose a higher target"
        )
    best = min(candidates, key=lambda c: c.upper)
    return (
        f"no alarm rule can be shown to stay below {target:g} false alarms per hour: even at {MARGINS[0]:g} times the "
        f"half-widths, {best.violations} of {best.window} verdicts raise {best.alarms} alarms in {hours:.3g} h left "
        f"out (limit {best.upper:.3g} per hour); look at what leaves the envelope so far, or choose a higher target"
    )
