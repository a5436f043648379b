# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The panel: a small fixed set of alarm rules, whose thresholds are learnt on what was left out of the fit.

The size of a rule is |utilisation| of one verdict, the root of the mean square over a window or of a moving average,
the size of the mean over a window, or the root of the joint chi-square. Its threshold for a state is the largest size
on healthy data, whether left out or fitted, with an allowance for the largest of so few: of N independent windows,
sizes of n states reach beyond those of one as the quantiles of a normal distribution do,

    threshold = median + a (largest - median),   a = sqrt(log(N n) / log N).

Where windows are few, the largest of one state is chance, and the states share what is relative to their typical peak.
Elsewhere, and of recordings, which differ by more than their blocks, a threshold is also the limit below which the
largest size of one more of them lies with CONFIDENCE (of a block with ALIKE), where the logarithms of the largest sizes
p of each of G (three at least) are normal,

    exp(mean log p + t (1 + 1/G)^(1/2) s),   s^2 the mean of their variances over the states, t Student's, G - 1;

at most MOST times the former, and MOST times it of one or two recordings. If more than NEARLY_ALL of the recordings
pass what the others give, an alarm would say little: all thresholds rise until none does, MOST times at most.

[Hahn, G. J. and Meeker, W. Q., Statistical Intervals, 1991, section 4.8]
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from uncertain_lti.base.arrays import LARGEST, WORTH_THREADS, Array, on_cores
from uncertain_lti.base.errors import FitError
from uncertain_lti.base.text import lasting, plural, shortlist
from uncertain_lti.identification.memory import DAMAGED, as_text, of_text
from uncertain_lti.model.alarm_rule import JOINT, Rule, StatisticRule
from uncertain_lti.model.horizon import Residuals
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.alarm import Alarm
from uncertain_lti.validation.intervals import cluster_size, rate_interval
from uncertain_lti.validation.part import Part, by_unit, rising, unit_numbers
from uncertain_lti.validation.result import Validation

PANEL = (("energy", 1, 1), ("energy", 10, 10))
"""Kind and window of each rule, in verdicts, and how many such windows a typical left-out stretch must hold."""
SLOW = (("ewma", 100, 2),)
"""The same of slow rules, where TELLING recordings or groups say how far they differ."""
SLOW_OF_FEW = (("mean", 30, 3), ("chi2", 30, 3))
"""The same of fewer, or of one, whose blocks share what drifts slowly; chi2 of several states."""
SLOW_OF_LAW = (("mewma", 10, 3), ("chi2", 30, 3))
"""The same where their residuals are of least squares."""
FEW = 30
"""Windows of the left-out data below which the states share how far peaks go."""
CONFIDENCE = 0.9
"""Of the limit of the false-alarm rate, one-sided, and of the largest size in one more recording or group."""
_LOW = 1.0
"""False alarms per hour that anyone takes for few."""
OFTEN = 60
"""Of that limit, per hour, above which it says nothing: alarms chatter, and few recordings leave all open."""
ALIKE = 0.95
"""As CONFIDENCE, of the largest size in one more block of a single recording."""
TELLING = 4
"""Recordings or groups from which on slow rules know how far they differ."""
MOST = 1.5
"""That limit over the threshold without it at most, as parts at rest and parts that move are not alike."""
NEARLY_ALL = 2 / 3
"""Share of recordings or groups that would alarm at thresholds of the others beyond which thresholds rise."""
UNLIKE = 1 / 3
"""Share of a left-out stretch outside the range of the others from which on it does not repeat them."""
ALONE = 1 / 3
"""Share of recordings, groups or blocks not covered by the others beyond which only the simplest way is tried."""
NEARBY = 0.75
"""Down to this share of the thresholds, alarms are assumed to cluster as they do at the thresholds."""
BLIND = 1.0
"""What jumps by more than this share of the range of a state shows in any plot, without an alarm."""
COARSE = 0.5
"""Likewise, of jumps that are worth little to see."""
_LEAST, _FINE = 0.25, 1.02
"""Thresholds are lowered for a rate to this share of their largest at most, in this ratio."""
_DOUBTED = 2.0  # times the thresholds of the others, as hardly a healthy recording goes
_FAR = 10.0
"""A jump of so many times the range of a state is none that anybody need be told the size of."""
_NAMED = 6
"""States that a sentence names at most."""
_ABOVE = 1.0 + 1e-10
"""A threshold is this times the size that it is learnt from, which must not pass it by rounding."""
_NOTHING = 1e-9
"""Size from which on a peak is one."""


@dataclass(frozen=True)
class Evidence:
    """What a panel is learnt from, so that an update can add to it; S sizes in all, of each rule one per state or one.

    `peaks` (G, S): the largest sizes on each recording, group or block that was left out; `top`, `median` (S,): on all
    healthy data, left out or fitted; `verdicts`: of those; `widths` (2, n): usual and median width where left out,
    recorded units; `judged`: verdicts there; `hours`: those of them within what the others cover; `dt`: typical step,
    s; `factor`: on the thresholds; `counts`, `near` (units,): alarms left out at the thresholds, and somewhat below.
    """

    peaks: Array
    top: Array
    median: Array
    verdicts: float
    widths: Array
    judged: float
    hours: float
    dt: float
    factor: float = 1.0
    counts: Array = field(default_factory=lambda: np.empty(0))
    near: Array = field(default_factory=lambda: np.empty(0))

    def __add__(self, other: Evidence) -> Evidence:
        """With what further recordings are evidence of; the median is the mean of both, which few have as another."""
        share = other.verdicts / (self.verdicts + other.verdicts)
        judged = self.judged + other.judged
        return Evidence(
            np.vstack([self.peaks, other.peaks]), np.maximum(self.top, other.top),
            (1.0 - share) * self.median + share * other.median, self.verdicts + other.verdicts,
            (self.judged * self.widths + other.judged * other.widths) / judged, judged,
            self.hours + other.hours, self.dt, self.factor,
            np.append(self.counts, other.counts), np.append(self.near, other.near),
        )  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        """Plain data for the memory of a model."""
        return {each.name: as_text(getattr(self, each.name)) for each in fields(self)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Evidence:
        """Of `to_dict`."""
        try:
            found: dict[str, Any] = {each.name: of_text(data[each.name]) for each in fields(cls)}
            numbers = {each.name: found[each.name].item() for each in fields(cls) if each.type == "float"}
        except (TypeError, ValueError, KeyError):
            raise FitError(DAMAGED) from None
        return cls(**found | numbers)

    def thresholds(self, rules: Sequence[StatisticRule], n: int, what: str) -> list[Array]:
        """Of each rule (n,) or (1,), but for the factor."""
        ends = np.cumsum([len(rule.thresholds(n)) for rule in rules])[:-1]
        each = (np.split(values, ends, axis=-1) for values in (self.peaks, self.top, self.median))
        found = []
        for rule, *of in zip(rules, *each, strict=True):
            windows = max(3.0, self.verdicts / 2.0 / max(1, round(rule.window_s / self.dt)))
            found.append(_threshold(windows, n, what == "block", *of))
        return found

    def apart(self, rules: Sequence[StatisticRule], what: str) -> Array:
        """(G,): the largest size on each over the thresholds that all the others give, 0 where theirs is larger."""
        found = np.zeros(len(self.peaks))
        for unit in np.unique(self.peaks.argmax(axis=0)):
            others = np.delete(self.peaks, unit, axis=0)
            top = np.where(self.top > self.peaks.max(axis=0), self.top, others.max(axis=0, initial=0.0))
            given = replace(self, peaks=others, top=top).thresholds(rules, self.widths.shape[1], what)
            found[unit] = (self.peaks[unit] / np.concatenate(given)).max()
        return found

    def learnt(self, rules: Sequence[StatisticRule], what: str) -> tuple[StatisticRule, ...]:
        """These rules with their thresholds."""
        found = []
        for rule, sizes in zip(rules, self.thresholds(rules, self.widths.shape[1], what), strict=True):
            sizes = self.factor * sizes
            values = tuple(np.minimum(sizes if rule.kind == "mean" else sizes**2, LARGEST).tolist())
            found.append(replace(rule, threshold=values[0] if rule.kind in JOINT else values))
        return tuple(found)

    def with_alarms(self, rules: Sequence[StatisticRule], what: str, shown: Sequence[tuple[Part, Array]]) -> Evidence:
        """With the alarms on these parts, of the sizes (K, S) given."""
        if not shown:
            return self
        thresholds = np.concatenate(self.thresholds(rules, self.widths.shape[1], what))
        reached = self.peaks[(self.peaks > _NOTHING).any(axis=1)] / thresholds
        third = float(min(np.sort(reached.max(axis=1))[::-1][:3], default=0.0))
        parts = [part for part, _ in shown]
        pieces = [np.array_split(sizes, len(sizes) // WORTH_THREADS + 1) for _, sizes in shown]
        levels = [np.concatenate([(some / thresholds).max(axis=1) for some in each]) for each in pieces]

        def counted(factor: float) -> Array:
            return by_unit(parts, [rising(v > factor, p.starts) for v, p in zip(levels, parts, strict=True)])

        counts, near = map(counted, (self.factor, min(self.factor, max(0.95 * third, NEARBY * self.factor))))
        return replace(self, counts=np.append(self.counts, counts), near=np.append(self.near, near))


@dataclass(frozen=True)
class Panel:
    """Alarm rules with what they promise.

    `rules`: the panel; `limit`: false alarms per hour at most, with CONFIDENCE; `what`: what was left out, recordings,
    groups or blocks; `biases` (n,): jump of the reading of each state that the energy of one verdict shows some nine of
    ten times, the threshold above twice the median size, or that alone brings chi2 to its threshold, recorded units;
    `figure`: what ways to fit are compared by, the geometric mean over the states of the lasting offset that the energy
    over a window shows; `evidence`: what all of it follows from; `unlike`: names of left-out stretches that the others
    do not cover; `asked`: rate asked for; `residuals`: as the joint rules take them; `names`: of what was left out.
    """

    rules: tuple[Rule, ...]
    limit: float
    what: str
    biases: Array
    figure: float
    evidence: Evidence
    unlike: tuple[str, ...] = ()
    asked: float | None = None
    residuals: Residuals | None = None
    names: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        model: UncertainLTI,
        evidence: Evidence,
        rules: Sequence[StatisticRule],
        what: str,
        unlike: Sequence[str],
        asked: float | None,
    ) -> Panel:
        """That of these rules on a model whose residuals are of one form; `what`: of `Validation.what`."""
        n, residuals = model.n, model.residuals
        thresholds = evidence.thresholds(rules, n, what)
        energies = [i for i, rule in enumerate(rules) if (rule.kind, rule.horizon) == ("energy", 1)]
        usual, median = evidence.widths / 2.0
        sample, window = (thresholds[i] for i in (energies[0], energies[-1]))
        biases = usual * (evidence.factor * sample + 2.0 * evidence.median[:n])
        for rule, size in zip(rules, thresholds, strict=True):
            if (rule.kind, rule.horizon) == ("chi2", 1) and residuals is not None:
                room = evidence.factor * size * math.sqrt(max(round(rule.window_s / evidence.dt), 1))
                unit = usual if residuals.relative else model.operating_point.X
                certain = np.linalg.norm(residuals.whitening(np.ones(n, dtype=bool)), axis=0)
                with np.errstate(all="ignore"):  # no limit for a state that it says nothing of
                    biases = np.fmin(biases, unit * room / certain)
        window = window if asked is None else evidence.factor * window
        figure = float(np.exp(np.log(np.maximum(median * window, 1e-300)).mean()))
        learnt, limit = evidence.learnt(rules, what), _limit(evidence, len(rules))
        return cls(learnt, limit, what, biases, figure, evidence, tuple(unlike), asked, residuals)

    @property
    def units(self) -> int:
        """Independent recordings, groups or blocks."""
        return len(self.evidence.peaks)

    @cached_property
    def reached(self) -> Array:
        """(G,): the largest size on each recording, group or block over thresholds of all the others, raised alike."""
        rules = [rule for rule in self.rules if isinstance(rule, StatisticRule)]
        return self.evidence.apart(rules, self.what) / self.evidence.factor

    @property
    def alarming(self) -> int:
        """How many of them would alarm there."""
        return int((self.reached > 1.0).sum())

    @property
    def vouched(self) -> bool:
        """Whether what was left out shows that one way to fit holds better than another."""
        return len(self.unlike) <= ALONE * self.units

    def summary(self, model: UncertainLTI, shown: str = "left out") -> dict[str, Any]:
        """What `fit_summary["alarm"]` of its model says; `shown`: what the data was that it is learnt from."""
        kind, headline = worth(model, self)
        return {**self.to_dict(), "worth": kind, "headline": headline, "promises": promises(model, self, shown)}

    @property
    def needed_hours(self) -> float:
        """Hours without an alarm that show the rate that was asked for; 0 if none was, or nothing says."""
        if self.asked is None or not math.isfinite(self.limit):
            return 0.0
        return self.limit * self.evidence.hours / self.asked  # the limit falls with the hours

    def to_dict(self) -> dict[str, Any]:
        """Plain data for the model file."""
        return {
            "limit_per_hour": self.limit if math.isfinite(self.limit) else None,
            "confidence": CONFIDENCE,
            "alarms": int(self.evidence.counts.sum()),
            "hours": self.evidence.hours,
            "units": self.units,
            "units_alarming": self.alarming,
            "what": self.what,
            "biases": self.biases.tolist(),
            "within": self.evidence.dt,
            "figure": self.figure,
            "unlike": list(self.unlike),
            **({} if self.asked is None else {"asked": self.asked, "needed_hours": self.needed_hours}),
        }


def rules_for(model: UncertainLTI, steps: int, dt: float, apart: bool = False) -> list[StatisticRule]:
    """The rules of a panel with thresholds of 1, for left-out stretches of so many steps of dt, s.

    The same rules look at the longest horizon of the model. `apart`: TELLING recordings or groups are left out.
    """
    found = []
    longest = {horizon.steps: horizon.residuals for horizon in model.horizons[-1:]}
    for h, residuals in ({1: model.residuals} | longest).items():
        law = None if residuals is None or model.n == 1 else residuals.law
        slow = SLOW if apart else SLOW_OF_FEW if law is None else SLOW_OF_LAW
        for kind, window, least in (*PANEL, *slow):
            window = min(window, steps // least)
            if window < 1 or (kind in JOINT and (model.n < 2 or residuals is None)):
                continue
            rule = StatisticRule(kind, (window + 0.5) * dt if window > 1 else 0.0, 1.0, h)
            if rule not in found:
                found.append(rule)
    return found


def sizes_of(rules: Sequence[StatisticRule], part: Part) -> Array:
    """Sizes (K, S) of the rules over their thresholds on one part, by the alarm's own arithmetic."""
    model = part.judged_by
    alarm = Alarm(rules, model, np.ones(model.n, dtype=bool))
    values = np.zeros((part.judged, len(alarm.names)))
    alarm.over(part.spans, part.dt, np.zeros(part.judged, dtype=bool), part.rows, values=values)
    sizes = np.minimum(np.abs(values, out=values), LARGEST, out=values)
    sizes[np.isnan(sizes)] = 0.0
    squared = np.repeat([rule.kind != "mean" for rule in rules], [len(rule.thresholds(model.n)) for rule in rules])
    return np.asarray(np.sqrt(sizes, out=sizes, where=squared))


def check_rate(rate: Any) -> None:
    """Refuse what no rate of false alarms is."""
    if rate is not None and not (isinstance(rate, (int, float, np.number)) and math.isfinite(rate) and rate > 0):
        raise FitError(f"false_alarms is {rate!r}; give a positive number per hour")


def learn(validation: Validation, fitted: Sequence[Part], rate: float | None = None) -> Panel:
    """The panel of a model, from what was left out of the fit and from the fit itself.

    `fitted`: what was fitted, judged by the model; `rate`: false alarms per hour, the upper limit with CONFIDENCE; the
    thresholds are as near to it as the data can show, or, where they cannot, at most MOST times as large, such that no
    part alarms at those of the others. Raises FitError if there is nothing to learn from.
    """
    check_rate(rate)
    parts = [part for part in validation.parts if part.judged]
    if not parts:
        usual = [float(np.median(np.diff(p.transient.t))) for p in validation.parts if len(p.transient) > 1]
        least, most = min(usual, default=0.0), max(usual, default=0.0)
        rates = f"fit recordings of one rate: the steps of these are of {least:.3g} to {most:.3g} s"
        remedy = rates if most > 2 * least else "record longer"
        raise FitError(f"no step of what was left out has a verdict, so no alarm can be learnt; {remedy}")
    dt = float(np.median(np.concatenate([part.dt for part in parts])))
    lengths = sorted(part.judged for part in parts)
    apart = validation.what != "block" and int(unit_numbers(parts).max()) + 1 >= TELLING
    stretch = lengths[len(lengths) // 10]
    rules = rules_for(validation.model, stretch, dt, apart)
    model, left, fitted = _narrowest(validation, rules, parts, fitted, dt)
    rules = rules_for(model, stretch, dt, apart)
    evidence, shown, unlike = _gathered(rules, left, fitted, dt)
    if rate is None:
        evidence = _unasked(evidence, rules, validation.what)
    found = evidence.with_alarms(rules, validation.what, shown)
    beyond = rate is not None and _limit(found, len(rules)) > rate
    if beyond:
        found = _raised(evidence, evidence.apart(rules, validation.what)).with_alarms(rules, validation.what, shown)
    while rate is not None and not beyond and found.factor > _LEAST:
        lower = replace(evidence, factor=found.factor / _FINE).with_alarms(rules, validation.what, shown)
        if _limit(lower, len(rules)) > rate:
            break
        found = lower
    names = {unit: part.group or part.name for unit, part in zip(unit_numbers(parts), parts, strict=True)}
    return replace(Panel.of(model, found, rules, validation.what, unlike, rate), names=tuple(names.values()))


def _unasked(evidence: Evidence, rules: Sequence[StatisticRule], what: str) -> Evidence:
    """With the factor on thresholds where no rate is asked for."""
    far = np.zeros(1) if what == "block" else evidence.apart(rules, what)
    return _raised(evidence, far if (far > 1.0).mean() > NEARLY_ALL else np.ones(1))


def _raised(evidence: Evidence, far: Array) -> Evidence:
    """With thresholds that none of those passes which go so far beyond them, MOST times as large at most."""
    return replace(evidence, factor=float(np.clip(far.max(), 1.0, MOST)))


def _narrowest(
    validation: Validation, rules: Sequence[StatisticRule], parts: Sequence[Part], fitted: Sequence[Part], dt: float
) -> tuple[UncertainLTI, Sequence[Part], Sequence[Part]]:
    """The model with the form of its residuals in which the joint statistics of one step leave the least room.

    Room is the volume that a joint statistic allows to a residual: the root of the determinant of its covariance, in
    utilisation times half-widths, and of its threshold. Returns what is left out and fitted in that form, too.
    """
    model, joint = validation.model, [rule for rule in rules if rule.kind == "chi2" and rule.horizon == 1]
    forms = () if model.residuals is None else model.residuals.forms
    best, least = (model, parts, fitted), math.inf
    for form in forms if joint else forms[:1]:
        own, room = model.replace(residuals=form.beside(None)), 0.0
        left, seen = ([part.judged_as(own) for part in each] for each in (parts, fitted))
        if joint and len(forms) > 1:
            evidence, *_ = _gathered(joint, left, seen, dt)
            roots = np.diagonal(form.whitening(np.ones(model.n, dtype=bool)))
            half = evidence.widths[1] / 2.0 / model.operating_point.X if form.relative else np.ones(model.n)
            sizes = np.log(half[roots > 0.0] / roots[roots > 0.0])
            levels = np.log(evidence.thresholds(joint, model.n, validation.what))
            room = float(sizes.sum() / max(len(sizes), 1) + levels.mean())
        if room < least:
            best, least = (own, left, seen), room
    return best


def extended(
    evidence: Evidence, model: UncertainLTI, alarm: Mapping[str, Any], parts: Sequence[Part], fitted: Sequence[Part]
) -> Panel | None:
    """The panel of a model with what further recordings are evidence of; None if its alarm is no longer that panel.

    `alarm`: what `Panel.to_dict` gave; `parts`: the recordings, judged by the model; `fitted`: by the one with them.
    """
    rules = [replace(rule, threshold=1.0) for rule in model.alarm if isinstance(rule, StatisticRule)]
    what, asked = alarm["what"], alarm.get("asked")
    sizes = sum(len(rule.thresholds(model.n)) for rule in rules)
    if sizes != len(evidence.top) or evidence.learnt(rules, what) != model.alarm:
        return None
    new, shown, unlike = _gathered(rules, parts, fitted, evidence.dt)
    both = evidence + new if asked is not None else _unasked(evidence + new, rules, what)
    before, now = (np.asarray(m.fit_summary["mean_width"]) for m in (model, fitted[0].model))  # with them
    wider = np.fmax(1.0, np.divide(now, before, out=np.ones(model.n), where=before > 0.0))
    both = replace(both.with_alarms(rules, what, shown), widths=wider * both.widths)
    return Panel.of(model, both, rules, what, [*alarm["unlike"], *unlike], asked)


def _gathered(
    rules: Sequence[StatisticRule], parts: Sequence[Part], fitted: Sequence[Part], dt: float
) -> tuple[Evidence, list[tuple[Part, Array]], list[str]]:
    """Evidence but for alarms; of what was left out the parts within what the others cover with their sizes (K, S);
    names of those that are not."""
    left, unlike, judged = [], [], [part.judged for part in parts]
    for part in parts:
        far = part.extrapolated == 2
        if (part.extrapolated > 0).mean() > UNLIKE:
            far = part.extrapolated > 0
            unlike.append(part.name)
        left.append(part.without(far))
    n = parts[0].judged_by.n
    sizes, units = [sizes_of(rules, part) for part in left], unit_numbers(parts)
    numbers = [len(rule.thresholds(n)) for rule in rules]
    ends = np.cumsum(numbers).tolist()

    same = {id(part.utilisation) for part in left}
    others = [part for part in fitted if id(part.utilisation) not in same]  # twice the same has the same median

    def top_and_median(rule: StatisticRule, columns: slice) -> tuple[Array, Array]:  # of one: of many states, much
        every = [*(of[:, columns] for of in sizes), *(sizes_of([rule], part) for part in others)]
        states = zip(*(of.T for of in every), strict=True)
        medians = [np.median(np.concatenate(of), overwrite_input=True) for of in states]
        return np.max([of.max(axis=0, initial=0.0) for of in every], axis=0), np.array(medians)

    given = [(rule, slice(end - count, end)) for rule, count, end in zip(rules, numbers, ends, strict=True)]
    count = sum(part.judged for part in (*left, *fitted))
    found = on_cores(top_and_median, given, count >= WORTH_THREADS)
    top, median = (np.concatenate(each) for each in zip(*found, strict=True))
    shown = [(part, of) for part, of in zip(left, sizes, strict=True) if part.judged]
    peaks = np.full((int(units.max()) + 1, len(top)), _NOTHING)
    for unit, each in zip(units.tolist(), sizes, strict=True):
        peaks[unit] = np.maximum(peaks[unit], each.max(axis=0, initial=0.0))
    widths = np.average([(p.usual_width, p.median_width) for p in parts], axis=0, weights=judged)
    hours = sum(part.hours for part, _ in shown)
    return Evidence(peaks, top, median, count, widths, sum(judged), hours, dt), shown, unlike


def _threshold(windows: float, n: int, blocks: bool, peaks: Array, top: Array, median: Array) -> Array:
    """Threshold (n,) or (1,) of one rule, of so many windows; as `Evidence` has them, of its sizes alone."""
    found = median + math.sqrt(math.log(windows * n) / math.log(windows)) * (top - median)
    peaks = peaks[(peaks > _NOTHING).any(axis=1)]  # one that lies far outside what the others show says nothing
    logs, count = np.ma.log(np.ma.masked_less_equal(peaks, _NOTHING)), len(peaks)  # nor does a state at rest
    if count and windows < FEW:
        typical = np.ma.exp(logs.mean(axis=0))
        found = np.maximum(found, (typical * (top / typical).max()).filled(0.0))
    if count > 2 and not (blocks and windows < FEW):
        from scipy.special import stdtrit

        far = stdtrit(count - 1, ALIKE if blocks else CONFIDENCE) * math.sqrt(1.0 + 1.0 / count)
        spread = math.sqrt(float(np.ma.filled(logs.var(axis=0, ddof=1).mean(), 0.0)))
        limit = np.ma.exp(logs.mean(axis=0) + far * spread).filled(0.0)
        found = np.maximum(found, np.minimum(limit, MOST * found))
    elif count <= 2 and not blocks:
        found *= MOST
    return np.asarray(np.clip(found * _ABOVE, 1e-6, LARGEST**0.5))


def _limit(evidence: Evidence, rules: int) -> float:
    """Limit of the rate of false alarms.

    A threshold that is the largest size of so many hours is passed about once in as many: every rule but one counts as
    a cluster of alarms, and those come in clusters as they do somewhat below the thresholds.
    """
    if not evidence.hours:  # all that was left out lies far outside what was fitted
        return math.inf
    size = cluster_size(evidence.near)
    counted = evidence.counts + (rules - 1) * size / len(evidence.counts)
    return float(rate_interval(counted, evidence.hours, CONFIDENCE, size, one_sided=True)[1])


def worth(model: UncertainLTI, panel: Panel) -> tuple[str, str]:
    """What the model is worth: `good`, `some`, `unproven` or `none`, and one line that says so."""
    span = model.domain.span(model.operating_point.X)
    names = model.state_names
    still = [name for name, s in zip(names, span.tolist(), strict=True) if not s > 0]
    share = np.divide(panel.biases, span, out=np.full(model.n, np.inf), where=span > 0)
    blind = [name for name, s in zip(names, share.tolist(), strict=True) if s > BLIND and name not in still]
    if len(still) == model.n:
        return "none", "not worth having: nothing that is judged moves in the recordings; record the machine in use"
    if len(still) + len(blind) == model.n:
        least = float(share[share < np.inf].min(initial=np.inf))
        of_range = f"{least:.0%} of" if least < _FAR else "over ten times"
        return "none", (
            f"not worth having: the smallest jump that it sees is {of_range} the recorded range of a state; "
            f"what moves the states may be missing among the controls, or record more"
        )
    count = len(panel.unlike)
    verb = "does" if count == 1 else "do"
    unlike = f"{plural(count, panel.what)} of {panel.units} {verb} not repeat what the others show"
    if 2 * count > panel.units:
        return "unproven", (
            f"unproven: {unlike}, so nothing shows how it does on what comes next, and an alarm may be operation that "
            f"was not recorded; record the same work again"
        )
    alone = panel.what == "block" or panel.units == 1
    further = f"fit {TELLING} or more, or expect alarms in healthy ones"
    if still or blind:
        seen = [name for name in names if name not in (*still, *blind)]
        why = [f"{shortlist(still, _NAMED)} never moved"] if still else []
        why += [f"of {shortlist(blind, _NAMED)} not even a jump of the whole recorded range"] if blind else []
        why += [f"one recording says nothing of another day: {further}"] * alone
        return "some", f"sees only {shortlist(seen, _NAMED)}: {'; '.join(why)}"
    low, high = (np.format_float_positional(float(f"{100 * s:.2g}"), trim="-") for s in (share.min(), share.max()))
    ranges = f"{low} % of the recorded range" if low == high else f"{low} to {high} % of the recorded ranges"
    coarse = [name for name, s in zip(names, share.tolist(), strict=True) if s > COARSE]
    if len(coarse) == model.n:
        missing = "what moves the states may be missing among the controls"
        return "some", f"worth little: it sees jumps of {ranges} only, which a plot shows as well; {missing}"
    if count:
        return "some", (
            f"worth having within what was recorded: {unlike} ({shortlist(panel.unlike, 3)}), so nothing vouches for "
            "operation that none of them shows" + f"; one recording says nothing of another day: {further}" * alone
        )
    sees = f"it sees jumps of {ranges}" + f", large ones alone of {shortlist(coarse, 4)}" * bool(coarse)
    if alone:
        once = "worth having while the machine runs as in the one recording, which says nothing of another day"
        return "some", f"{once}: {further}; {sees}"
    if 3 * panel.alarming >= panel.units:
        often = f"{panel.alarming} of {panel.units}" if 2 * panel.alarming <= panel.units else "most"
        return "some", f"worth having, but expect an alarm in {often} healthy recordings: {sees}"
    return "good", f"worth having: {sees}"


def promises(model: UncertainLTI, panel: Panel, shown: str = "left out") -> list[str]:
    """What the panel promises, a sentence each: false alarms, jumps seen, and what rate was asked for."""
    span = model.domain.span(model.operating_point.X)
    evidence = panel.evidence
    of = list(zip(model.signals.states, panel.biases.tolist(), (panel.biases <= BLIND * span).tolist(), strict=True))
    each = [f"{s.name} {b:.3g}" + (f" {s.unit}" if s.unit else "") for s, b, near in of if near]
    blind = [s.name for s, _, near in of if not near]
    sees = [f"a jump of {shortlist(each, 2 * _NAMED)}"] if each else []
    sees += [f"of {shortlist(blind, 4)} not even a jump of the whole recorded range"] if blind else []
    if math.isfinite(panel.limit):
        count, most = int(evidence.counts.sum()), float(f"{panel.limit:.2g}")
        units = f"{lasting(evidence.hours)} {shown} ({plural(panel.units, panel.what)})"
        shows = f"which shows at most {most:.7g} per hour with {CONFIDENCE:.0%} confidence"
        shows += ", while the machine is run as in the recordings"
        if most > OFTEN and panel.asked is None:
            shows = "too little to say how rare they are"
        found = [f"false alarms: {count or 'none'} in {units}, {shows}"]
        if panel.what != "block":
            alarming = f"{panel.alarming or 'none'} of {plural(panel.units, panel.what)}"
            further = "about as many" if panel.alarming else f"at most about one in {panel.units + 1}"
            far = int(panel.reached.argmax())
            one = f", {panel.names[far]} farthest at {panel.reached[far]:.3g} times" if panel.names else ""
            if panel.reached[far] > _DOUBTED:
                one += " (was the machine healthy in it, and are its units those of the others?)" * bool(panel.names)
            further = f"expect {further} of further ones" + " that stay there" * bool(panel.unlike)
            higher = panel.asked is None and evidence.factor > 1.0
            if panel.alarming and panel.asked is None and not higher:
                low = float(f"{min(0.1 * most, _LOW):.1g}")  # one above the limit lowers the thresholds
                further += f"; to have fewer, ask for a low rate (--false-alarms {low:g})"
            how = f", {evidence.factor - 1.0:.0%} higher as most pass them," if higher else " alone"
            how += f"{',' * (not higher)} within what they cover," * bool(panel.unlike)
            would = f"{alarming} would alarm{one * (panel.alarming > 0)}"
            found.append(f"at thresholds of the others{how} {would}: {further}")
    else:
        found = ["false alarms: one stretch says nothing of their rate; record more"]
    found.append(f"sees within {evidence.dt:.3g} s {'; '.join(sees)}")
    if panel.asked is not None and not panel.limit <= panel.asked:
        more = panel.needed_hours - evidence.hours
        remedy = f"{lasting(more)} more without an alarm would" if more > 0 else "record more"
        share = evidence.factor - 1.0
        differ = f"the thresholds are {share:.0%} higher, as the parts differ; " * (share > 0.0)
        found.append(f"asked for at most {panel.asked:g} per hour: the recordings cannot show that; {differ}{remedy}")
    return found
