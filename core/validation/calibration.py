"""Calibration: the alarm rule that keeps to a target rate of false alarms, by what was left out of the fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import FitError
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.validation.false_alarms import borrowed_margin, peaks
from uncertain_lti.validation.intervals import cluster_size, rate_interval
from uncertain_lti.validation.part import Part, by_unit, rising
from uncertain_lti.validation.result import Validation, short_condition

RULES = ((1, 1), (3, 5), (5, 10))
"""(violations, window) tried by default."""
MARGINS = tuple(float(m) for m in np.geomspace(4.0, 0.5, 106))
"""Margins tried, from the largest: about 2 % apart."""
FAULT_SIZE = 1.0
"""Size of the reference fault: one state moves by this many mean widths more in every step."""
BLIND = 0.5
"""A rule that detects a smaller share of the reference faults on some state gets a warning: it is insensitive."""
STARTS = 8
"""Instants per left-out part at which the reference fault is added, with either sign."""


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
    """

    violations: int
    window: int
    margin: float | None
    alarms: int
    upper: float
    detected: Array
    delay: Array


@dataclass(frozen=True)
class Calibration:
    """The alarm rule that `calibrate` chose, and all it tried.

    Parameters
    ----------
    alarm_rule : AlarmRule or None
        The choice; None if no rule can be shown to keep to the target.
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
    """

    alarm_rule: AlarmRule | None
    target: float
    confidence: float
    hours: float
    needed_hours: float
    candidates: tuple[Candidate, ...]
    words: str
    warning: str = ""

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
                }
                for c in self.candidates
            ],
        }


def calibrate(
    validation: Validation,
    target: float,
    *,
    rules: Sequence[tuple[int, int]] = RULES,
    confidence: float | None = None,
) -> Calibration:
    """Find the rule and margin whose false alarms stay below a target, and which then detect a reference fault first.

    For each rule, margins are tried from the largest down, as long as the upper confidence limit of the false alarms
    on the left-out parts stays at or below the target; going in a fixed order and stopping at the first failure, the
    confidence of one test holds for the whole search. The error is shared equally among the rules, so that choosing
    among them costs no confidence. Chosen is the rule that detects the largest share of the reference faults, then the
    one that does so first, then the one with the smallest margin.

    Parameters
    ----------
    validation : Validation
        Of `validate`; its parts are what the search counts on.
    target : float
        Target rate: false alarms per hour at most.
    rules : sequence of (int, int), optional
        (violations, window) of each rule; default RULES.
    confidence : float, optional
        That the true rate is below the target; default that of the validation.

    Returns
    -------
    Calibration
        The rule, or the reason why there is none.

    Raises
    ------
    FitError
        The target is not positive, or a rule is none.
    """
    if not (math.isfinite(target) and target > 0):
        raise FitError(f"the target is {target} false alarms per hour; give a positive number")
    if not rules:
        raise FitError("no alarm rule to choose from; give at least one (violations, window)")
    for m, n in rules:
        if not 1 <= m <= n:
            raise FitError(f"alarm rule {m} of {n}: it takes 1 <= violations <= window")
    confidence = validation.confidence if confidence is None else confidence
    each = 1.0 - (1.0 - confidence) / len(rules)
    parts = validation.parts
    hours = sum(p.hours for p in parts)
    candidates = tuple(_candidate(parts, m, n, target, each, hours) for m, n in rules)
    needed = rate_interval(np.zeros(validation.units), 1.0, each, one_sided=True)[1] / target
    found = [c for c in candidates if c.margin is not None]
    if not found:
        return Calibration(
            None, target, confidence, hours, needed, candidates, _refusal(candidates, target, hours, needed)
        )
    best = max(found, key=lambda c: (float(c.detected.min()), -float(c.delay.max()), -(c.margin or 0.0)))
    assert best.margin is not None
    names = validation.model.state_names
    slow = int(np.lexsort((-best.detected, best.delay))[-1])  # of those never seen by half, the least seen
    missed = 1.0 - float(best.detected[slow])
    words = (
        f"alarm at {best.violations} of {best.window} verdicts outside {best.margin:.3g} times the half-widths: at "
        f"most {target:g} false alarms per hour with {confidence:.0%} confidence {short_condition(validation)} "
        f"({best.alarms} in {hours:.3g} h left "
        f"out, limit {best.upper:.3g} per hour); a fault that moves one state by {FAULT_SIZE:g} mean width more in "
        f"every step is seen "
        + (
            f"after {best.delay[slow]:.3g} s (median; slowest state: {names[slow]}; {missed:.0%} missed)"
            if math.isfinite(best.delay[slow])
            else f"in {best.detected[slow]:.0%} of the cases only (worst state: {names[slow]})"
        )
    )
    rule = AlarmRule(best.violations, best.window, best.margin)
    return Calibration(rule, target, confidence, hours, needed, candidates, words, _insensitive(best.detected, names))


def _insensitive(detected: Array, names: Sequence[str]) -> str:
    """Warning that a rule, which detects the shares `detected` (n,) of the reference faults, misses most on some."""
    missed = [f"{name} in {share:.0%}" for name, share in zip(names, detected, strict=True) if not share >= BLIND]
    if not missed:
        return ""
    return (
        f"this rule keeps quiet by seeing little: a fault that moves one state by {FAULT_SIZE:g} mean width more in "
        f"every step is seen on {', '.join(missed)} of the cases; accept more false alarms per hour, or record more"
    )


def _candidate(parts: Sequence[Part], m: int, n: int, target: float, confidence: float, hours: float) -> Candidate:
    levels = [p.level(m, n) for p in parts]
    counts = by_unit(
        parts,
        [[rising(level > margin, p.starts) for p, level in zip(parts, levels, strict=True)] for margin in MARGINS],
    )
    largest = peaks(parts, levels)
    chosen, count, limit = None, 0, math.inf
    for margin, row in zip(MARGINS, counts, strict=True):
        nearby = int(np.argmax(np.array([*MARGINS, 0.0]) <= borrowed_margin(largest, margin)))
        typical = cluster_size(counts[min(nearby, len(counts) - 1)])
        upper = rate_interval(row, hours, confidence, typical, one_sided=True)[1]
        if upper > target:
            if chosen is None:
                count, limit = int(row.sum()), upper
            break
        chosen, count, limit = margin, int(row.sum()), upper
    if chosen is None:
        nothing = np.full(parts[0].utilisation.shape[1], np.nan)
        return Candidate(m, n, None, count, limit, nothing, nothing)
    detected, delay = detection(parts, AlarmRule(m, n, chosen))
    return Candidate(m, n, chosen, count, limit, detected, delay)


def detection(parts: Sequence[Part], rule: AlarmRule, size: float = FAULT_SIZE) -> tuple[Array, Array]:
    """Share of reference faults that raise the alarm, and the time to it.

    The fault: from one verdict on, one state moves by `size` mean widths of its bounds more in every step than
    recorded, in either direction, the step still starting from the measured state. It is added to the left-out parts at
    STARTS instants each; one that is not detected before the part ends counts as missed (infinite time).

    Parameters
    ----------
    parts : sequence of Part
        Left-out parts.
    rule : AlarmRule
        The alarm rule.
    size : float, optional
        Of the fault, in mean widths; default FAULT_SIZE.

    Returns
    -------
    array (n,)
        Share detected, of the faults on each state; NaN without a verdict.
    array (n,)
        Median time to the alarm, s.
    """
    n = parts[0].utilisation.shape[1]
    times: list[list[float]] = [[] for _ in range(n)]
    for part in parts:
        K = part.judged
        if K == 0:
            continue
        clock = np.cumsum(part.dt)
        anyway = part.level(rule.violations, rule.window) > rule.margin  # alarms that are not the fault's
        for start in sorted({int(s) for s in np.linspace(0, max(K - 1, 0), STARTS + 1)[:-1]}):
            for i in range(n):
                for sign in (1.0, -1.0):
                    moved = part.utilisation.copy()
                    # size mean widths are 2 size mean half-widths; half_k follows from the sample's own width
                    moved[start:, i] += sign * 2.0 * size * part.narrowness[start:, i]
                    level = part.level(rule.violations, rule.window, np.abs(moved).max(axis=1))
                    seen = np.flatnonzero((level > rule.margin)[start:] & ~anyway[start:])
                    before = clock[start] - part.dt[start]
                    times[i].append(float(clock[start + seen[0]] - before) if len(seen) else math.inf)
    detected = np.array([np.mean(np.isfinite(t)) if t else np.nan for t in times])
    delay = np.array([np.median(t) if t else np.nan for t in times])
    return detected, delay


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
