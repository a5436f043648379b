# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""tune(): of many ways to fit and to raise an alarm, the simplest within the error of the one that detects most."""

from __future__ import annotations

import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti import __version__
from uncertain_lti.base.arrays import Array
from uncertain_lti.base.english import plural
from uncertain_lti.base.errors import FitError, ModelError, UncertainLTIError
from uncertain_lti.base.files import whole_file
from uncertain_lti.base.progress import CountedStep
from uncertain_lti.identification import fit
from uncertain_lti.identification.structure import Structure
from uncertain_lti.model.alarm_rule import AlarmRule, Rule, StatisticRule, rule_from_dict
from uncertain_lti.model.terms import ARRAYS
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.envelope_monitor import EnvelopeMonitor
from uncertain_lti.proposal.memories import Remembered, memory_candidates, remember
from uncertain_lti.proposal.suggestion import TRANSITIONS, promise, suggest_schedule, thinned
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.validation.detectable import SHARE, check_within, detectable, typical_within
from uncertain_lti.validation.intervals import rate_interval
from uncertain_lti.validation.left_out import validate
from uncertain_lti.validation.part import Part, by_unit, rising
from uncertain_lti.validation.result import Validation

PLAIN = "plain fit: "
"""What the words of the plain fit begin with."""
KINDS = ("bias", "drift", "noise", "offset")
"""Kinds of injected faults by which ways are compared."""
CASES = 40
"""Onsets of each fault while ways are compared."""
KNOTS = (2, 3, 5)
"""Numbers of knots tried on a promising signal."""
PROMISING, SIGNALS = 0.9, 2
"""Largest least-squares residual with three knots, relative to one, up to which a signal is tried; and how many are."""
STEPS = (5.0, 25.0)
"""Windows of rules tried, in 25ths of the time within which a fault shall be seen."""
LONGEST = 64
"""Steps of the longest horizon tried."""
FEWEST_VERDICTS = 5
"""Shortest window of such rules, verdicts."""
FINE = 1.02
"""Ratio of neighbouring thresholds."""
LEAST_FACTOR = 0.25
"""Smallest threshold tried, relative to the largest left-out value."""
UNITS = 6
"""Recordings, groups or blocks below which a choice rests on little."""
MOST_SEEN = 2.0
"""A size that is never seen counts as this many times the largest tried."""
MARGIN = 0.02
"""A way must detect faults smaller by this share, on average, to be taken for better than the plain one."""


@dataclass(frozen=True)
class Setting:
    """One way to fit.

    Parameters
    ----------
    words : str
        What it is, in words.
    options : mapping
        Arguments of `fit`; knots of a schedule are stated by their number.
    memories : tuple of Remembered
        Lags and rates that are added to the controls.
    constant : bool, default False
        Half-widths do not grow with x and u.
    """

    words: str
    options: Mapping[str, Any]
    memories: tuple[Remembered, ...] = ()
    constant: bool = False

    def prepared(self, transients: Sequence[Transient]) -> list[Transient]:
        """The recordings with the memories of this setting.

        Parameters
        ----------
        transients : sequence of Transient
            As recorded.

        Returns
        -------
        list of Transient
            One per recording.
        """
        return remember(transients, self.memories) if self.memories else list(transients)

    def arguments(self, transients: Sequence[Transient]) -> dict[str, Any]:
        """Arguments of `fit` for recordings that were prepared.

        Parameters
        ----------
        transients : sequence of Transient
            Of `prepared`.

        Returns
        -------
        dict
            By name.
        """
        options: dict[str, Any] = {"schedule": {}, **self.options}  # not that of the signals file, which may be auto
        if self.constant:
            n, m = transients[0].x.shape[1], transients[0].u.shape[1]
            options["structure"] = Structure(n, m, fixed={"dA": np.zeros((n, n)), "dB": np.zeros((n, m))})
        return options


@dataclass(frozen=True)
class Family:
    """Alarm rules that differ in their threshold alone.

    Parameters
    ----------
    kind : str
        `containment`, `horizons` (containment over one step and over every horizon of the model), or a kind of
        `StatisticRule`.
    window : float
        Verdicts of containment; s of a statistic.
    violations : int, default 1
        m of containment.
    """

    kind: str
    window: float
    violations: int = 1

    @property
    def words(self) -> str:
        """In words."""
        if self.kind == "horizons":
            return "1 of 1 at every horizon"
        if self.kind == "containment":
            return f"{self.violations} of {self.window:.0f}"
        return f"{self.kind} over {self.window:.3g} s"

    def quiet(
        self, model: UncertainLTI, parts: Sequence[Part], allowed: int
    ) -> tuple[tuple[Rule, ...], NDArray[np.intp]]:
        """The rule with the smallest threshold that raises at most so many alarms on what was left out.

        Parameters
        ----------
        model : UncertainLTI
            The full model.
        parts : sequence of Part
            What was left out.
        allowed : int
            Alarms.

        Returns
        -------
        tuple of Rule
            The alarm.
        array (parts,) of int
            Alarms of each part.

        Raises
        ------
        FitError
            No threshold is quiet.
        ModelError
            The model has nothing that such a rule looks at.
        """
        if self.kind == "containment":
            levels = [part.level(self.violations, int(self.window)) for part in parts]
            factor, counts = _factor(levels, parts, allowed)
            return (AlarmRule(self.violations, int(self.window), factor),), counts
        if self.kind == "horizons":
            tables = [_largest(part) for part in parts]
            peak = np.max([t.max(axis=0, initial=0.0) for t in tables], axis=0)
            peak = np.where(peak > 0, peak, 1.0)
            factor, counts = _factor([(t / peak).max(axis=1, initial=0.0) for t in tables], parts, allowed)
            steps = (1, *(horizon.steps for horizon in model.horizons))
            return tuple(AlarmRule(1, 1, float(factor * p), h) for p, h in zip(peak, steps, strict=True)), counts
        series = [_statistics(model, part, self) for part in parts]
        peak = np.max([s.max(axis=0, initial=0.0) for s in series], axis=0)
        if not (np.isfinite(peak).all() and (peak > 0).all()):
            raise FitError("no threshold is quiet: bounds without width are left on what was left out")
        factor, counts = _factor([(s / peak).max(axis=1, initial=0.0) for s in series], parts, allowed)
        each = tuple(float(v) for v in factor * peak)
        threshold: float | tuple[float, ...] = each[0] if self.kind == "chi2" else each
        return (AlarmRule(1, 1, NEVER), StatisticRule(self.kind, self.window, threshold)), counts


HORIZONS = Family("horizons", 1)
"""One step and every horizon of the model."""
NEVER = 1e3
"""Margin of one-step bounds beside a statistic: violations alone do not raise the alarm."""


@dataclass(frozen=True, eq=False)
class Trial:
    """One way to fit with one family of alarm rules, judged on what was left out.

    Parameters
    ----------
    setting : Setting
        How it was fitted.
    family : Family
        What raises the alarm.
    rules : tuple of Rule
        The quiet alarm.
    alarms : int
        False alarms left out.
    upper : float
        One-sided upper confidence limit of the false alarms per hour, of 90 %.
    hours : float
        Time under verdict in the left-out parts, h.
    inside : float
        Share of the left-out verdicts inside the one-step bounds.
    unknowns : int
        Elements of the model that are not 0.
    faults : tuple of dict
        `kind`, `signal`, `largest` and `thresholds` of each.
    units : array (cases,)
        What each case was left out with.
    seen : mapping of str to list of bool
        By label, whether the alarm was raised in each labelled recording.
    refused : str
        Why there is none of this; "" otherwise.
    """

    setting: Setting
    family: Family
    rules: tuple[Rule, ...] = ()
    alarms: int = 0
    upper: float = math.inf
    hours: float = 0.0
    inside: float = math.nan
    unknowns: int = 0
    faults: tuple[dict[str, Any], ...] = ()
    units: Array = field(default_factory=lambda: np.zeros(0))
    seen: Mapping[str, list[bool]] = field(default_factory=dict)
    refused: str = ""

    @property
    def words(self) -> str:
        """Setting and rule."""
        return f"{self.setting.words}; alarm {self.family.words}"

    def sizes(self, without: float | None = None) -> Array:
        """Logarithm of the smallest detectable size of each fault; NaN where it is not known.

        Parameters
        ----------
        without : float, optional
            A unit whose cases are not counted.

        Returns
        -------
        array (faults,)
            What is never seen counts as MOST_SEEN times the largest tried.
        """
        kept = np.ones(len(self.units), dtype=bool) if without is None else self.units != without
        found = []
        for fault in self.faults:
            if not fault["thresholds"] or not kept.any():
                found.append(math.nan)
                continue
            thresholds = np.sort(np.asarray(fault["thresholds"], dtype=np.float64)[kept])
            size = float(thresholds[math.ceil(SHARE * len(thresholds) - 1e-9) - 1])
            found.append(math.log(min(size, MOST_SEEN * fault["largest"])))
        return np.array(found)

    @property
    def seen_share(self) -> float:
        """Share of the labelled recordings in which the alarm was raised; 0 without any."""
        every = [s for labelled in self.seen.values() for s in labelled]
        return float(np.mean(every)) if every else 0.0


@dataclass(frozen=True, eq=False)
class Tuned:
    """What `tune` chose, and all it tried.

    Parameters
    ----------
    model : UncertainLTI
        Fitted to everything, with its alarm and its validation.
    chosen : Trial
        How.
    trials : tuple of Trial
        Every way, the plain one first.
    reason : str
        Why this one.
    record : tuple of str
        What to record next, a sentence each.
    not_tried : tuple of str
        What the budget left no time for.
    curve : tuple of dict
        False alarms per hour and mean detectable size of the plain and of the chosen way.
    """

    model: UncertainLTI
    chosen: Trial
    trials: tuple[Trial, ...]
    reason: str
    record: tuple[str, ...]
    not_tried: tuple[str, ...]
    curve: tuple[dict[str, Any], ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain data for the model file and for `--json`.

        Returns
        -------
        dict
            A row for each way, the choice with its reason, and what to record.
        """
        plain = self.trials[0]
        return {
            "trials": [_row(t, plain) for t in self.trials],
            "chosen": self.trials.index(self.chosen),
            "reason": self.reason,
            "record": list(self.record),
            "not_tried": list(self.not_tried),
            "curve": list(self.curve),
        }


def tune(
    transients: Sequence[Transient] | Transient,
    false_alarms: float,
    *,
    within: float | None = None,
    budget: float = math.inf,
    groups: Sequence[Any] | str | None = None,
    faulty: Mapping[str, Sequence[Transient]] | None = None,
    cache: str | os.PathLike[str] | None = None,
    confidence: float = 0.9,
    progress: Callable[[str], None] | None = None,
) -> Tuned:
    """Choose how to fit and what raises the alarm by the faults that it detects on left-out data.

    Additive terms, criteria, constant and growing half-widths, then schedules, then lags and rates of the states, then
    alarm rules are tried, each beside the best of the step before. Every way is fitted without each recording, group or
    block, its alarm is set to raise at most `false_alarms` per hour there, and the smallest faults are sought that it
    detects (`validation.detectable`). Ways are compared by the mean logarithm of these sizes; the simplest within one
    standard error of the best (jackknife over what was left out) is chosen, and never one that detects less than the
    plain fit at as many false alarms. Labelled recordings with a fault come first: a way that misses more of them than
    the best by over a standard error is not taken.

    Parameters
    ----------
    transients : Transient or sequence of Transient
        Recordings of the healthy machine.
    false_alarms : float
        False alarms per hour at most.
    within : float, optional
        Time within which a fault shall be seen, s; default `typical_within`.
    budget : float, optional
        No further way is begun after so many s; the result then depends on how fast the machine is.
    groups : sequence or str, optional
        As in `validate`.
    faulty : mapping of str to sequence of Transient, optional
        Recordings with a fault, by what it is.
    cache : path, optional
        Folder that keeps what every way came to, so that an interrupted search goes on from there.
    confidence : float, default 0.9
        Of the limits of false alarms.
    progress : callable, optional
        Called with one line of text per way.

    Returns
    -------
    Tuned
        The model with the reason in `fit_summary["tune"]`.

    Raises
    ------
    FitError
        The rate or the time is not positive, there is too little to leave out, or no way can be fitted.
    """
    transients = [transients] if isinstance(transients, Transient) else list(transients)
    if not (math.isfinite(false_alarms) and false_alarms > 0):
        raise FitError(f"false_alarms is {false_alarms}; give a positive number per hour")
    if not budget > 0:
        raise FitError(f"budget is {budget}; give a positive number of seconds")
    check_within(within)
    search = _Search(transients, false_alarms, within, budget, groups, faulty or {}, cache, confidence, progress)
    plain = search.plain
    if plain.refused:
        raise FitError(f"the plain fit cannot be judged: {plain.refused}")
    for setting in _fits(transients):
        search.add(setting)
    for settings in _schedules(transients, search.best().setting):
        last = search.best()
        for setting in settings:  # more and more knots, as long as they detect more
            trial = search.add(setting)
            if trial.refused or search.score(trial) >= search.score(last):
                break
            last = trial
    for setting in _memories(transients, search.best().setting):
        search.add(setting)
    best = search.best().setting
    for setting in _horizons(transients, best, search.within or 1.0):
        search.add(setting, HORIZONS)
    for family in search.families[1:]:
        search.add(best, family)
    return search.finish()


def _fits(transients: Sequence[Transient]) -> Iterator[Setting]:
    """Additive terms, criteria and half-widths."""
    for additive in ("none", "noise", "disturbance", "both"):
        for criterion, name in (("qp", "(10)"), ("lp", "(11)")):
            yield Setting(f"{name}, {_ADDITIVE[additive]}", {"criterion": criterion, "additive": additive})
        if additive != "none" and transients[0].u.shape[1] + transients[0].x.shape[1]:
            words = f"(11), {_ADDITIVE[additive]}, constant widths"
            yield Setting(words, {"criterion": "lp", "additive": additive}, constant=True)


_ADDITIVE = {
    "none": "no additive term",
    "noise": "noise",
    "disturbance": "drift",
    "both": "drift and noise",
}


def _schedules(transients: Sequence[Transient], best: Setting) -> Iterator[list[Setting]]:
    """Schedules on each promising signal."""
    found = promise(thinned(transients, TRANSITIONS))
    signals = [name for name in sorted(found, key=lambda name: found[name]) if found[name] <= PROMISING][:SIGNALS]
    for name in signals:
        yield [
            replace(
                best,
                words=f"{best.words.removeprefix(PLAIN)}, {count} knots on {name}",
                options={**best.options, "schedule": {name: count}},
            )
            for count in KNOTS
        ]


def _memories(transients: Sequence[Transient], best: Setting) -> Iterator[Setting]:
    """Lags and rates of states whose residuals follow from sample to sample."""
    additive = str(best.options.get("additive", "noise"))
    for memories in memory_candidates(transients, additive):
        names = ", ".join(one.name for one in memories)
        yield replace(best, words=f"{best.words.removeprefix(PLAIN)}, with {names}", memories=memories)


def _horizons(transients: Sequence[Transient], best: Setting, within: float) -> Iterator[Setting]:
    """Envelopes over several steps beside that of one."""
    step = float(np.median(np.concatenate([t.dt for t in transients])))
    longest = min(LONGEST, round(within / step))
    for steps in sorted({max(2, longest // 4), longest}):
        if longest >= 2:
            options = {**best.options, "horizons": [steps], "widths": "constant"}
            yield replace(best, words=f"{best.words.removeprefix(PLAIN)}, and over {steps} steps", options=options)


class _Search:
    """Every way that was tried so far, and what they share."""

    def __init__(
        self,
        transients: Sequence[Transient],
        rate: float,
        within: float | None,
        budget: float,
        groups: Sequence[Any] | str | None,
        faulty: Mapping[str, Sequence[Transient]],
        cache: str | os.PathLike[str] | None,
        confidence: float,
        progress: Callable[[str], None] | None,
    ) -> None:
        self.transients, self.rate, self.groups, self.faulty = transients, rate, groups, faulty
        self.confidence, self.progress = confidence, progress
        self.until = time.monotonic() + budget
        self.cache = None if cache is None else _folder(cache)
        self.key = _fingerprint(transients, faulty, groups) if cache is not None else ""
        self.trials: list[Trial] = []
        self.not_tried: list[str] = []
        self._left: tuple[Setting | None, Validation | None, str] = (None, None, "")
        asked = transients[0].signals.additive if transients[0].signals is not None else None
        additive = asked or "none"
        plain = Setting(f"{PLAIN}(10), {_ADDITIVE[additive]}", {"criterion": "qp", "additive": additive})
        left = self._validated(plain)
        self.within = typical_within(left.parts) if within is None and left is not None else within
        step = float(np.median(np.concatenate([t.dt for t in transients])))
        lengths = sorted({max(FEWEST_VERDICTS, round(k / 25.0 * (self.within or 1.0) / step)) for k in STEPS})
        self.families = [
            Family("containment", 1),
            *(Family("containment", n, max(1, round(0.4 * n))) for n in lengths),
            *(Family(kind, n * step) for kind in ("energy", "mean", "chi2") for n in lengths),
        ]
        self.plain = self.add(plain)

    def best(self) -> Trial:
        """The way that detects most so far, of those with the first family."""
        first = [t for t in self.trials if not t.refused and t.family == self.families[0]]
        return min(first, key=lambda t: (-t.seen_share, self.score(t)))

    def score(self, trial: Trial, base: Trial | None = None, without: float | None = None) -> float:
        """Mean logarithm of the detectable sizes relative to another way, the plain one."""
        ratio = trial.sizes(without) - (base or self.plain).sizes(without)
        known = ratio[np.isfinite(ratio)]
        return float(known.mean()) if len(known) else 0.0

    def error(self, trial: Trial, base: Trial) -> float:
        """Standard error of `score`, of the jackknife over what was left out."""
        units = np.unique(np.concatenate([trial.units, base.units]))
        if len(units) < 2:
            return math.inf
        scores = np.array([self.score(trial, base, float(u)) for u in units])
        return float(np.sqrt((len(units) - 1) / len(units) * np.sum((scores - scores.mean()) ** 2)))

    def add(self, setting: Setting, family: Family | None = None) -> Trial:
        """Try one way, unless it was tried, or the budget is spent."""
        family = family or self.families[0]
        for trial in self.trials:
            if replace(setting, words=trial.setting.words) == trial.setting and trial.family == family:
                return trial
        if self.trials and time.monotonic() > self.until:
            self.not_tried.append(f"{setting.words}; alarm {family.words}")
            return self.trials[0]
        if self.progress is not None:
            number = len(self.trials) + 1
            self.progress(CountedStep(f"{setting.words}; alarm {family.words}", number, max(number + 1, 32)))
        trial = self._kept(setting, family)
        self.trials.append(trial)
        return trial

    def _kept(self, setting: Setting, family: Family) -> Trial:
        """From the cache, or made and kept."""
        if self.cache is None:
            return self._try(setting, family)
        what = json.dumps([__version__, self.key, repr(setting), repr(family), self.rate, self.within, CASES, KINDS])
        path = self.cache / f"{hashlib.sha256(what.encode()).hexdigest()[:32]}.json"
        if path.exists():
            try:
                return _from_data(json.loads(path.read_text(encoding="utf-8")), setting, family)
            except (ValueError, KeyError, TypeError, ModelError):
                pass  # a damaged entry is made again
        trial = self._try(setting, family)
        with whole_file(path) as stream:
            stream.write(json.dumps(_to_data(trial)).encode())
        return trial

    def _validated(self, setting: Setting) -> Validation | None:
        """What a setting leaves out; the last one is kept."""
        if self._left[0] == setting:
            return self._left[1]
        runs = setting.prepared(self.transients)
        options = setting.arguments(runs)
        left, why = None, ""
        try:
            model = fit(runs, describe_data=False, **options)
            options.pop("schedule", None)
            left = validate(runs, full=model, groups=self.groups, **options)
        except UncertainLTIError as error:
            why = str(error)
        self._left = setting, left, why
        return left

    def _try(self, setting: Setting, family: Family) -> Trial:
        left = self._validated(setting)
        if left is None:
            return Trial(setting, family, refused=self._left[2])
        parts, hours = left.parts, sum(p.hours for p in left.parts)
        try:
            rules, counts = family.quiet(left.model, parts, math.floor(self.rate * hours))
            model = left.model.replace(alarm=rules)
            found = detectable(model, parts, self.within, kinds=KINDS, cases=CASES)
        except (FitError, ModelError) as error:
            return Trial(setting, family, refused=str(error))
        if found.refused:
            return Trial(setting, family, refused=found.refused)
        judged = sum(p.judged for p in parts)
        monitor = EnvelopeMonitor(model)
        return Trial(
            setting,
            family,
            rules,
            int(counts.sum()),
            rate_interval(by_unit(parts, counts), hours, self.confidence, one_sided=True)[1],
            hours,
            1.0 - sum(p.violated for p in parts) / judged,
            _unknowns(model),
            tuple(
                {
                    "kind": f.kind,
                    "signal": f.signal,
                    "unit": f.unit,
                    "largest": f.largest,
                    "thresholds": f.thresholds.tolist(),
                }
                for f in found.faults
                if f.signal in _names(self.transients)
            ),
            found.units.astype(np.float64),
            {
                label: [bool(monitor.check(run).alarm.any()) for run in setting.prepared(runs)]
                for label, runs in self.faulty.items()
            },
        )

    def finish(self) -> Tuned:
        """Choose, and fit the chosen way to everything."""
        good = [t for t in self.trials if not t.refused]
        most = max(t.seen_share for t in good)
        labelled = sum(len(v) for v in self.faulty.values())
        slack = math.sqrt(most * (1.0 - most) / labelled) if labelled else 0.0
        able = [t for t in good if t.seen_share >= most - slack - 1e-12]
        best = min(able, key=self.score)
        near = [t for t in able if self.score(t, best) <= self.error(t, best)] if best is not self.plain else able
        near = [t for t in near if self.score(t) <= -MARGIN] or [best]
        order = {family: i for i, family in enumerate((*self.families, HORIZONS))}
        chosen = min(near, key=lambda t: (t.unknowns, order[t.family], self.score(t)))
        if self.score(chosen) > -MARGIN and self.plain in able:
            chosen = self.plain
        left = self._validated(chosen.setting)
        assert left is not None
        model = left.model.replace(alarm=chosen.rules)
        reason = self._reason(chosen, best)
        record = tuple(self._record(chosen, left))
        curve = tuple(self._curve(chosen)) if time.monotonic() <= self.until else ()
        tuned = Tuned(model, chosen, tuple(self.trials), reason, record, tuple(self.not_tried), curve)
        left = self._validated(chosen.setting)
        assert left is not None
        faults = detectable(model, left.parts, self.within, confidence=self.confidence)
        summary = {**replace(left, model=model).to_dict(), "detectable": faults.to_dict()}
        facts = {**model.fit_summary, "tune": tuned.to_dict()}
        return replace(tuned, model=model.replace(fit_summary=facts, validation=summary))

    def _reason(self, chosen: Trial, best: Trial) -> str:
        if chosen is self.plain:
            others = [t for t in self.trials if not t.refused and t is not self.plain]
            if not others:
                return "no other way could be judged on left-out data"
            return (
                "no other way detects smaller faults on left-out data at as many false alarms: the best of "
                f"{len(others)} others, {best.words}, needs {math.exp(self.score(best)):.3g} times their size"
            )
        text = (
            f"at {plural(chosen.alarms, 'false alarm')} in {chosen.hours:.3g} h left out it detects faults of "
            f"{math.exp(self.score(chosen)):.3g} times the size that the plain fit needs"
        )
        if chosen is not best:
            text += f"; the best, {best.words}, needs {math.exp(self.score(best)):.3g} times, within its error"
        if self.faulty:
            text += f"; of the recordings with a fault {chosen.seen_share:.0%} raise its alarm"
            text += f" ({self.plain.seen_share:.0%} of the plain fit)"
        return text

    def _record(self, chosen: Trial, left: Validation) -> Iterator[str]:
        """What the recordings cannot support, and what would."""
        units, hours = left.units, chosen.hours
        if left.kind == "blocks":
            yield "one recording says nothing of another run, day or load: record at least five more runs"
        elif units < UNITS:
            what = plural(UNITS - units, f"more {left.what}")
            yield f"{plural(units, left.what)} can hardly carry a choice: record {what} of the same kind of operation"
        needed = rate_interval(np.zeros(max(units, 2)), 1.0, self.confidence, one_sided=True)[1] / self.rate
        if chosen.upper > self.rate:
            counted = plural(chosen.alarms, "false alarm")
            yield (
                f"{counted} in {hours:.3g} h left out: at most {chosen.upper:.3g} per hour with {self.confidence:.0%} "
                f"confidence, not {self.rate:g}; {needed:.3g} h without an alarm would show that"
            )
        model, domain = left.model, left.model.domain
        for j, name in enumerate(model.control_names[: self.transients[0].u.shape[1]]):
            unseen = [f for f in chosen.faults if f["kind"] == "offset" and f["signal"] == name]
            low, high = float(domain.u_min[j]), float(domain.u_max[j])
            if not high > low:
                yield f"{name} does not move: record steps of it in both directions, each held for {self.within:.3g} s"
            elif unseen and unseen[0]["thresholds"] and np.isfinite(unseen[0]["thresholds"]).mean() < SHARE:
                yield (
                    f"not even {name} off by {unseen[0]['largest']:.3g} {unseen[0]['unit']} is seen: record more and "
                    f"larger moves of {name} alone, for at least {10 * (self.within or 1.0):.3g} s"
                )
        refused = [t for t in self.trials if "schedule" in t.setting.options and (t.refused or self.score(t) > 0)]
        if refused and "schedule" not in chosen.setting.options:
            try:
                message = suggest_schedule(self.transients, self.groups, additive="noise").message
            except UncertainLTIError:
                message = ""
            if "; to carry" in message:
                yield message[message.index("to carry") :]

    def _curve(self, chosen: Trial) -> Iterator[dict[str, Any]]:
        """Detectable size against false alarms, of the plain and of the chosen way."""
        hours = chosen.hours
        for name, trial in (("plain", self.plain), ("chosen", chosen)):
            left = self._validated(trial.setting)
            if left is None:
                continue
            for allowed in sorted({math.floor(self.rate * hours), 0, 2, 5, 15, 50}):
                try:
                    rules, counts = trial.family.quiet(left.model, left.parts, allowed)
                    model = left.model.replace(alarm=rules)
                    found = detectable(model, left.parts, self.within, kinds=KINDS, cases=CASES)
                except (FitError, ModelError):
                    continue
                if found.refused:
                    continue
                faults = tuple(
                    {"largest": f.largest, "thresholds": f.thresholds.tolist()}
                    for f in found.faults
                    if f.signal in _names(self.transients)
                )
                point = replace(trial, faults=faults, units=found.units.astype(np.float64))
                yield {
                    "way": name,
                    "alarms": int(counts.sum()),
                    "per_hour": float(counts.sum()) / hours,
                    "size": math.exp(self.score(point)),
                }


def _unknowns(model: UncertainLTI) -> int:
    """Elements that are not 0."""
    return sum(int(np.count_nonzero(getattr(m, name))) for m in (model, *model.horizons) for name in ARRAYS)


def _names(transients: Sequence[Transient]) -> tuple[str, ...]:
    """Signals that every way has."""
    return (*transients[0].state_names, *transients[0].control_names)


def _statistics(model: UncertainLTI, part: Part, family: Family) -> Array:
    """The statistic (K, S) of each verdict of a part, as a share of a threshold of 1."""
    assert part.model is not None and part.transient is not None
    rule = StatisticRule(family.kind, family.window, 1.0)
    verdicts = EnvelopeMonitor(part.model.replace(alarm=(AlarmRule(1, 1, NEVER), rule))).check(part.transient)
    return np.nan_to_num(np.abs(verdicts.statistics[verdicts.judged]), nan=0.0, posinf=math.inf)


def _largest(part: Part) -> Array:
    """The largest utilisation (K, 1 + H) of each verdict, over one step and each horizon."""
    longer = np.nan_to_num(np.abs(part.longer), nan=0.0, posinf=math.inf).max(axis=2, initial=0.0)
    return np.column_stack([part.severity, longer])


def _factor(levels: Sequence[Array], parts: Sequence[Part], allowed: int) -> tuple[float, NDArray[np.intp]]:
    """The smallest threshold at which so many alarms are raised at most, and the alarms of each part."""
    top = max(float(level.max(initial=0.0)) for level in levels)
    if not math.isfinite(top):
        raise FitError("no threshold is quiet: bounds without width are left on what was left out")
    threshold = max(top, 1e-9) * FINE
    chosen = threshold, np.zeros(len(parts), dtype=np.intp)
    least = LEAST_FACTOR * threshold
    while threshold > least:
        counts = np.array([rising(v > threshold, p.starts) for v, p in zip(levels, parts, strict=True)], dtype=np.intp)
        if counts.sum() > allowed:
            break
        chosen = threshold, counts
        threshold /= FINE
    return chosen


def _row(trial: Trial, plain: Trial) -> dict[str, Any]:
    """One way as plain data."""
    row: dict[str, Any] = {"fit": trial.setting.words, "alarm": trial.family.words}
    if trial.refused:
        return {**row, "refused": trial.refused}
    ratio = trial.sizes() - plain.sizes()
    known = ratio[np.isfinite(ratio)]
    return {
        **row,
        "rules": [rule.to_dict() for rule in trial.rules],
        "unknowns": trial.unknowns,
        "inside": trial.inside,
        "alarms": trial.alarms,
        "per_hour": trial.alarms / trial.hours if trial.hours else None,
        "upper_per_hour": trial.upper if math.isfinite(trial.upper) else None,
        "size": math.exp(float(known.mean())) if len(known) else None,
        "sizes": [
            {
                "kind": f["kind"],
                "signal": f["signal"],
                "unit": f.get("unit", ""),
                "size": math.exp(v) if math.isfinite(v) and math.exp(v) <= f["largest"] else None,
            }
            for f, v in zip(trial.faults, trial.sizes().tolist(), strict=True)
        ],
        "seen": {label: [int(sum(v)), len(v)] for label, v in trial.seen.items()},
    }


def _to_data(trial: Trial) -> dict[str, Any]:
    """A trial for the cache."""
    return {
        "rules": [rule.to_dict() for rule in trial.rules],
        "alarms": trial.alarms,
        "upper": trial.upper,
        "hours": trial.hours,
        "inside": trial.inside,
        "unknowns": trial.unknowns,
        "faults": list(trial.faults),
        "units": trial.units.tolist(),
        "seen": dict(trial.seen),
        "refused": trial.refused,
    }


def _from_data(data: Mapping[str, Any], setting: Setting, family: Family) -> Trial:
    return Trial(
        setting,
        family,
        tuple(rule_from_dict(rule) for rule in data["rules"]),
        int(data["alarms"]),
        float(data["upper"]),
        float(data["hours"]),
        float(data["inside"]),
        int(data["unknowns"]),
        tuple(data["faults"]),
        np.array(data["units"], dtype=np.float64),
        data["seen"],
        str(data["refused"]),
    )


def _folder(path: str | os.PathLike[str]) -> Path:
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FitError(f"{folder}: cannot be made: {error.strerror}; choose another folder for the cache") from None
    return folder


def _fingerprint(
    transients: Sequence[Transient], faulty: Mapping[str, Sequence[Transient]], groups: Sequence[Any] | str | None
) -> str:
    """Of everything that a trial depends on."""
    found = hashlib.sha256(repr(groups).encode())
    for run in [*transients, *(run for label in sorted(faulty) for run in faulty[label])]:
        found.update(repr((run.name, run.state_names, run.control_names, run.max_gap, run.signals)).encode())
        for array in (run.t_ns, run.x, run.u, run.s):
            found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()
