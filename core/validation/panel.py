# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The panel: a small fixed set of alarm rules, whose thresholds are learnt on what was left out of the fit.

The size of a rule is |utilisation| of one verdict, the root of the mean square over a window, the size of the mean over
a window, or the root of the joint chi-square. Its threshold for a state is the largest size on healthy data, whether
left out or fitted, with an allowance for the largest of so few: of N independent windows, sizes of n states reach
beyond those of one as the quantiles of a normal distribution do,

    threshold = median + a (largest - median),   a = sqrt(log(N n) / log N).

Where windows are few, the largest of one state is chance, and the states share what is relative to their typical peak.
Elsewhere, and of recordings, which differ by more than their blocks, a threshold is also the limit below which the
largest size of one more of them lies with CONFIDENCE (of a block with ALIKE), where the logarithms of the largest sizes
p of each of G (TELLING at least) are normal,

    exp(mean log p + t (1 + 1/G)^(1/2) s),   s^2 the mean of their variances over the states, t Student's, G - 1.

[Hahn, G. J. and Meeker, W. Q., Statistical Intervals, 1991, section 4.8]
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import LARGEST, Array
from uncertain_lti.base.errors import FitError
from uncertain_lti.base.text import plural
from uncertain_lti.model.alarm_rule import JOINT, Rule, StatisticRule
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.alarm import Alarm
from uncertain_lti.validation.intervals import cluster_size, rate_interval
from uncertain_lti.validation.part import Part, by_unit, rising, unit_numbers
from uncertain_lti.validation.result import Validation

PANEL = (("energy", 1, 1), ("energy", 10, 10), ("mean", 30, 3), ("chi2", 30, 3))
"""Kind and window of each rule, in verdicts, and how many such windows a typical left-out stretch must hold."""
FEW = 30
"""Windows of the left-out data below which the states share how far peaks go."""
CONFIDENCE = 0.9
"""Of the limit of the false-alarm rate, one-sided, and of the largest size in one more recording or group."""
ALIKE = 0.95
"""As CONFIDENCE, of the largest size in one more block of a single recording."""
TELLING = 4
"""Recordings, groups or blocks from which on the spread of their largest sizes is known well enough to reckon with."""
UNLIKE = 1 / 3
"""Share of a left-out stretch outside the range of the others from which on it does not repeat them."""
NEARBY = 0.75
"""Down to this share of the thresholds, alarms are assumed to cluster as they do at the thresholds."""
BLIND = 0.5
"""A bias of more than this share of the range of a state is no fault worth an alarm."""
_LEAST, _FINE = 0.25, 1.02
"""Thresholds are lowered for a rate to this share of their largest at most, in this ratio."""


@dataclass(frozen=True)
class Panel:
    """Alarm rules with what they promise.

    `rules`: the panel; `limit`: false alarms per hour at most, with CONFIDENCE; `alarms`: those on what was left out;
    `hours`: under verdict there; `units`: independent recordings, groups or blocks; `what`: which of them;
    `biases` (n,): smallest jump of each state that the energy over a window sees at nine of ten times, recorded units;
    `within`: in this time, s; `figure`: geometric mean over the states of the jumps seen half of the time, which ways
    to fit are compared by; `unlike`: names of left-out stretches that the others do not cover; `asked`: rate that was
    asked for.
    """

    rules: tuple[Rule, ...]
    limit: float
    alarms: int
    hours: float
    units: int
    what: str
    biases: Array
    within: float
    figure: float
    unlike: tuple[str, ...] = ()
    asked: float | None = None

    @property
    def needed_hours(self) -> float:
        """Hours without an alarm that show the rate that was asked for; 0 if none was, or nothing says."""
        if self.asked is None or not math.isfinite(self.limit):
            return 0.0
        return self.limit * self.hours / self.asked  # the limit falls with the hours

    def to_dict(self) -> dict[str, Any]:
        """Plain data for the model file."""
        return {
            "limit_per_hour": self.limit if math.isfinite(self.limit) else None,
            "confidence": CONFIDENCE,
            "alarms": self.alarms,
            "hours": self.hours,
            "units": self.units,
            "what": self.what,
            "biases": self.biases.tolist(),
            "within": self.within,
            "figure": self.figure,
            "unlike": list(self.unlike),
            **({} if self.asked is None else {"asked": self.asked, "needed_hours": self.needed_hours}),
        }


def rules_for(model: UncertainLTI, steps: int, dt: float) -> list[StatisticRule]:
    """The rules of a panel with thresholds of 1, for left-out stretches of so many steps of dt, s.

    The same rules look at the longest horizon of the model.
    """
    found = []
    longest = {horizon.steps: horizon.residuals for horizon in model.horizons[-1:]}
    for h, residuals in ({1: model.residuals} | longest).items():
        for kind, window, least in PANEL:
            window = min(window, steps // least)
            if window < 1 or (kind in JOINT and (model.n < 2 or residuals is None)):
                continue
            rule = StatisticRule(kind, (window + 0.5) * dt if window > 1 else 0.0, 1.0, h)
            if rule not in found:
                found.append(rule)
    return found


def sizes_of(rules: Sequence[StatisticRule], part: Part) -> list[Array]:
    """Size of each rule over its threshold, (K, n) or (K, 1), on one part by the alarm's own arithmetic."""
    model = part.judged_by
    alarm = Alarm(rules, model, np.ones(model.n, dtype=bool))
    values = np.zeros((part.judged, len(alarm.names)))
    for start, stop in part.spans:
        span = slice(start, stop)
        nothing = np.zeros(stop - start, dtype=bool)
        alarm.over(part.dt[span], nothing, part.rows(span), values=values[span])
    sizes = np.abs(values, out=values)
    sizes[np.isnan(sizes)] = 0.0
    np.minimum(sizes, LARGEST, out=sizes)
    ends = np.cumsum([len(rule.thresholds(model.n)) for rule in rules])[:-1]
    each = zip(rules, np.split(sizes, ends, axis=1), strict=True)
    return [size if rule.kind == "mean" else np.sqrt(size) for rule, size in each]


def learn(validation: Validation, fitted: Sequence[Part], rate: float | None = None) -> Panel:
    """The panel of a model, from what was left out of the fit and from the fit itself.

    `fitted`: what was fitted, judged by the model; `rate`: false alarms per hour, the upper limit with CONFIDENCE; the
    thresholds are as near to it as the data can show. Raises FitError if there is nothing to learn from.
    """
    if rate is not None and not (math.isfinite(rate) and rate > 0):
        raise FitError(f"false_alarms is {rate}; give a positive number per hour")
    parts, rules, dt = _judged(validation)
    left, unlike = [], []
    for part in parts:
        far = part.extrapolated == 2
        if (part.extrapolated > 0).mean() > UNLIKE:
            far = part.extrapolated > 0
            unlike.append(part.name)
        left.append(part.without(far))
    sizes = [sizes_of(rules, part) for part in left]
    every = [*sizes, *(sizes_of(rules, part) for part in fitted)]
    units = unit_numbers(parts)
    thresholds = [
        _threshold(rule, validation, dt, units, [of[r] for of in sizes], [of[r] for of in every])
        for r, rule in enumerate(rules)
    ]
    levels = [
        (part, np.max([(s / t).max(axis=1) for s, t in zip(of, thresholds, strict=True)], axis=0))
        for part, of in zip(left, sizes, strict=True)
        if part.judged
    ]
    hours = sum(part.hours for part, _ in levels)
    factor, limit, alarms = _factor(levels, hours, len(rules), rate)
    thresholds = [factor * t for t in thresholds]
    at = _of_jumps(rules)
    return Panel(
        tuple(_with_threshold(rule, t) for rule, t in zip(rules, thresholds, strict=True)),
        limit, alarms, hours, int(units.max()) + 1, validation.what, _jumps(parts, "usual_width", thresholds[at]),
        max(rules[at].window_s, dt), _mean(_jumps(parts, "median_width", thresholds[at])), tuple(unlike), rate,
    )  # fmt: skip


def figure(seen: Validation) -> float:
    """`Panel.figure` of `learn(seen, seen.parts)`, where nothing was left out. Raises FitError as that does."""
    parts, rules, dt = _judged(seen)
    rule = rules[_of_jumps(rules)]
    sizes = [sizes_of([rule], part)[0] for part in parts]
    return _mean(
        _jumps(parts, "median_width", _threshold(rule, seen, dt, unit_numbers(parts), sizes, [*sizes, *sizes]))
    )


def _judged(validation: Validation) -> tuple[list[Part], list[StatisticRule], float]:
    """Parts with a verdict, the rules for such parts, and their typical step, s."""
    parts = [part for part in validation.parts if part.judged]
    if not parts:
        raise FitError("no step of what was left out has a verdict, so no alarm can be learnt; record longer")
    dt = float(np.median(np.concatenate([part.dt for part in parts])))
    lengths = sorted(part.judged for part in parts)
    return parts, rules_for(validation.model, lengths[len(lengths) // 10], dt), dt


def _of_jumps(rules: Sequence[StatisticRule]) -> int:
    """The rule by whose threshold jumps are promised: the energy over the longest window, of one step."""
    return max(i for i, rule in enumerate(rules) if rule.kind == "energy" and rule.horizon == 1)


def _jumps(parts: Sequence[Part], width: str, threshold: Array) -> Array:
    """Jumps (n,) that a state's energy sees where its bounds have the usual, or the median, width."""
    widths = np.average([getattr(part, width) for part in parts], axis=0, weights=[part.judged for part in parts])
    return np.asarray(widths / 2.0 * threshold)


def _mean(jumps: Array) -> float:
    return float(np.exp(np.log(np.maximum(jumps, 1e-300)).mean()))


def _threshold(
    rule: StatisticRule,
    validation: Validation,
    dt: float,
    units: NDArray[np.intp],
    left: Sequence[Array],
    every: Sequence[Array],
) -> Array:
    """Threshold (n,) or (1,) of one rule, of its sizes on the parts `left` out, and on `every` healthy data."""
    peaks = _peaks(units, left)
    sizes = np.concatenate(every)
    top, median = sizes.max(axis=0), np.median(sizes, axis=0)
    windows = max(3.0, len(sizes) / 2.0 / max(1, round(rule.window_s / dt)))
    n, blocks = validation.model.n, validation.what == "block"
    found = median + math.sqrt(math.log(windows * n) / math.log(windows)) * (top - median)
    if windows < FEW:
        typical = np.exp(np.log(peaks).mean(axis=0))
        found = np.maximum(found, typical * (top / typical).max())
    if len(peaks) >= TELLING and not (blocks and windows < FEW):
        found = np.maximum(found, _of_next(peaks, ALIKE if blocks else CONFIDENCE))
    return np.asarray(np.clip(found, 1e-6, LARGEST**0.5))


def _of_next(peaks: Array, confidence: float) -> Array:
    """Limit of the largest size in one more recording, group or block, (n,) or (1,)."""
    from scipy.special import stdtrit

    logs, count = np.log(peaks), len(peaks)
    spread = math.sqrt(logs.var(axis=0, ddof=1).mean())
    return np.asarray(
        np.exp(logs.mean(axis=0) + stdtrit(count - 1, confidence) * math.sqrt(1.0 + 1.0 / count) * spread)
    )


def _peaks(units: NDArray[np.intp], values: Sequence[Array]) -> Array:
    """The largest of the values (K,) or (K, n) of the parts of each unit, at least 1e-9."""
    found = np.full((int(units.max()) + 1, *values[0].shape[1:]), 1e-9)
    for unit, each in zip(units.tolist(), values, strict=True):
        found[unit] = np.maximum(found[unit], each.max(axis=0, initial=0.0))
    return found


def _factor(
    shown: Sequence[tuple[Part, Array]], hours: float, rules: int, rate: float | None
) -> tuple[float, float, int]:
    """The lowest factor on the thresholds that keeps to a rate, the limit of the rate there, and alarms left out.

    A threshold that is the largest size of so many hours is passed about once in as many: every rule but one counts as
    a cluster of alarms, and those come in clusters as they do somewhat below the thresholds.
    """
    if not shown:  # all that was left out lies far outside what was fitted
        return 1.0, math.inf, 0
    parts, levels = [part for part, _ in shown], [level for _, level in shown]
    largest = np.sort(_peaks(unit_numbers(parts), levels))[::-1]
    third = float(largest[:3][-1])

    def raised(factor: float) -> Array:
        return by_unit(parts, [rising(v > factor, p.starts) for v, p in zip(levels, parts, strict=True)])

    def limit_at(factor: float) -> tuple[float, int]:
        counts = raised(factor)
        size = cluster_size(raised(min(factor, max(0.95 * third, NEARBY * factor))))
        counted = counts + (rules - 1) * size / len(counts)
        upper = rate_interval(counted, hours, CONFIDENCE, size, one_sided=True)[1] if hours else math.inf
        return float(upper), int(counts.sum())

    chosen = (1.0, *limit_at(1.0))
    factor = 1.0
    while rate is not None and chosen[1] <= rate and factor > _LEAST:
        factor /= _FINE
        upper, alarms = limit_at(factor)
        if upper > rate:
            break
        chosen = factor, upper, alarms
    return chosen


def _with_threshold(rule: StatisticRule, sizes: Array) -> StatisticRule:
    """The rule with the thresholds of these sizes."""
    values = tuple((sizes if rule.kind == "mean" else sizes**2).tolist())
    return replace(rule, threshold=values[0] if rule.kind in JOINT else values)


def worth(model: UncertainLTI, panel: Panel) -> tuple[str, str]:
    """What the model is worth, in a word (`good`, `some` or `none`), and in one line that begins with it."""
    span = (model.domain.x_max - model.domain.x_min) * model.operating_point.X
    names = model.state_names
    still = [name for name, s in zip(names, span.tolist(), strict=True) if not s > 0]
    share = np.divide(panel.biases, span, out=np.full(model.n, np.inf), where=span > 0)
    blind = [name for name, s in zip(names, share.tolist(), strict=True) if s > BLIND and name not in still]
    if len(still) == model.n:
        return "none", "not worth having: nothing that is judged moves in the recordings; record the machine in use"
    if len(still) + len(blind) == model.n:
        least = float(share[share < np.inf].min(initial=np.inf))
        return "none", (
            f"not worth having: the smallest jump that it sees is {least:.0%} of the recorded range of a state; what "
            f"moves the states may be missing among the controls, or record more"
        )
    if still or blind:
        seen = [name for name in names if name not in (*still, *blind)]
        why = [
            *([f"{', '.join(still)} never moved"] if still else []),
            *([f"of {', '.join(blind)} not even a jump of half the recorded range"] if blind else []),
        ]
        return "some", f"sees only {', '.join(seen)}: {'; '.join(why)}"
    if panel.unlike:
        count = len(panel.unlike)
        verb = "does" if count == 1 else "do"
        return "some", (
            f"worth having within what was recorded: {plural(count, panel.what)} of {panel.units} {verb} not repeat "
            f"what the others show, so nothing vouches for operation that none of them shows"
        )
    sees = f"it sees jumps of {share.min():.2g} to {share.max():.2g} of the recorded ranges"
    if panel.what == "block":
        return "some", (
            f"worth having while the machine runs as in the one recording, which says nothing of another day: check it "
            f"on one that was not fitted; {sees}"
        )
    return "good", f"worth having: {sees}"


def promises(model: UncertainLTI, panel: Panel) -> list[str]:
    """What the panel promises, a sentence each: false alarms, jumps seen, and what rate was asked for."""
    signals = model.signals.states
    each = [
        f"{s.name} {b:.3g}" + (f" {s.unit}" if s.unit else "")
        for s, b in zip(signals, panel.biases.tolist(), strict=True)
    ]
    if math.isfinite(panel.limit):
        first = (
            f"false alarms: at most {panel.limit:.2g} per hour with {CONFIDENCE:.0%} confidence, while the machine is "
            f"run as in the recordings ({panel.alarms} in {panel.hours:.3g} h left out, "
            f"{plural(panel.units, panel.what)})"
        )
    else:
        first = "false alarms: one stretch says nothing of their rate; record more"
    found = [first, f"sees within {panel.within:.3g} s a jump of {', '.join(each)}"]
    if panel.asked is not None and not panel.limit <= panel.asked:
        more = panel.needed_hours - panel.hours
        remedy = f"{more:.3g} h more without an alarm would" if more > 0 else "record more"
        found.append(f"asked for at most {panel.asked:g} per hour: the recordings cannot show that; {remedy}")
    return found
