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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from uncertain_lti import __version__
from uncertain_lti.base.english import plural
from uncertain_lti.base.errors import FitError, ModelError, UncertainLTIError
from uncertain_lti.base.files import whole_file
from uncertain_lti.base.progress import CountedStep
from uncertain_lti.identification import fit
from uncertain_lti.model.alarm_rule import KINDS
from uncertain_lti.model.terms import ARRAYS
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.envelope_monitor import EnvelopeMonitor
from uncertain_lti.proposal import ways
from uncertain_lti.proposal.suggestion import suggest_schedule
from uncertain_lti.proposal.trial import Trial, row_of, trial_data, trial_from_data
from uncertain_lti.proposal.ways import Setting
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.validation.armed import Family, families, steady
from uncertain_lti.validation.detectable import (
    COMPARED,
    COMPARED_CASES,
    SHARE,
    check_within,
    detectable,
    typical_within,
)
from uncertain_lti.validation.false_alarms import allowed_alarms
from uncertain_lti.validation.groups import resolve_groups
from uncertain_lti.validation.intervals import rate_interval
from uncertain_lti.validation.left_out import validate
from uncertain_lti.validation.part import Part, by_unit
from uncertain_lti.validation.result import Validation

STATISTICS = tuple((kind,) for kind in KINDS if kind != "ewma")
"""Statistics that are tried beside containment, one at a time; a moving average sees what the mean does."""
UNITS = 6
"""Recordings, groups or blocks below which a choice rests on little."""
HALVED = 4
"""Recordings or groups from which on thresholds are also asked of fits to half of them."""
_PACKAGE = Path(__file__).resolve().parents[1]
MARGIN = 0.02
"""A way must detect faults smaller by this share, on average, to be taken for better than the plain one."""


@dataclass(frozen=True, eq=False)
class Tuned:
    """What `tune` chose, and all it tried.

    `model`: fitted to everything, with its alarm and its validation; `chosen`: how; `trials`: every way, the plain one
    first; `reason`: why this one; `record`: what to record next, a sentence each; `not_tried`: what the budget left no
    time for; `curve`: false alarms per hour and mean detectable size of the plain and of the chosen way.
    """

    model: UncertainLTI
    chosen: Trial
    trials: tuple[Trial, ...]
    reason: str
    record: tuple[str, ...]
    not_tried: tuple[str, ...]
    curve: tuple[dict[str, Any], ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain data for the model file and for `--json`."""
        plain = self.trials[0]
        return {
            "trials": [row_of(t, plain) for t in self.trials],
            "chosen": self.trials.index(self.chosen),
            "hours": self.chosen.hours,
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
    block, its alarm is set to raise at most `false_alarms` per hour there (of HALVED or more recordings or groups also
    where half of them are left out, `validation.armed.steady`), and the smallest faults are sought that it detects
    (`validation.detectable`). Ways are compared by the mean logarithm of these sizes; the simplest within one
    standard error of the best (jackknife over what was left out) is chosen, and never one that detects less than the
    plain fit at as many false alarms. Labelled recordings with a fault come first: a way that misses more of them than
    the best by over a standard error is not taken.
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
    for setting in ways.fits(transients):
        search.add(setting)
    for setting in ways.delays(transients, search.best().setting):
        search.add(setting)
    for settings in ways.schedules(transients, search.best().setting):
        last = search.best()
        for setting in settings:  # more and more knots, as long as they detect more
            trial = search.add(setting)
            if trial.refused or search.score(trial) >= search.score(last):
                break
            last = trial
    for setting in ways.memories(transients, search.best().setting):
        search.add(setting)
    for setting in ways.horizons(transients, search.best().setting, search.within or 1.0):
        search.add(setting)
    best = search.best().setting
    for family in search.families[1:]:
        search.add(best, family)
    return search.finish()


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
        self._half: tuple[Setting | None, list[tuple[Part, ...]]] = (None, [])
        plain = ways.plain(transients)
        left = self._validated(plain)
        self.within = typical_within(left.parts) if within is None and left is not None else within
        step = float(np.median(np.concatenate([t.dt for t in transients])))
        self.families = [Family(dt=step)] if left is None else families(left.parts, step, STATISTICS)
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
        what = json.dumps(
            [__version__, self.key, repr(setting), repr(family), self.rate, self.within, COMPARED_CASES, COMPARED]
        )
        path = self.cache / f"{hashlib.sha256(what.encode()).hexdigest()[:32]}.json"
        if path.exists():
            try:
                return trial_from_data(json.loads(path.read_text(encoding="utf-8")), setting, family)
            except (ValueError, KeyError, TypeError, ModelError):
                pass  # a damaged entry is made again
        trial = self._try(setting, family)
        with whole_file(path) as stream:
            stream.write(json.dumps(trial_data(trial)).encode())
        return trial

    def _validated(self, setting: Setting) -> Validation | None:
        """What a setting leaves out; the last one is kept."""
        if self._left[0] == setting:
            return self._left[1]
        left, why = None, ""
        try:
            runs = setting.prepared(self.transients)
            options = setting.arguments(runs)
            model = fit(runs, describe_data=False, **options)
            options.pop("schedule", None)
            left = validate(runs, full=model, groups=self.groups, **options)
        except UncertainLTIError as error:
            why = str(error)
        self._left = setting, left, why
        return left

    def _halves(self, setting: Setting) -> list[tuple[Part, ...]]:
        """What a setting that was just validated leaves out with half of the recordings or groups; the last is kept."""
        if self._half[0] == setting:
            return self._half[1]
        left, found = self._validated(setting), list[tuple[Part, ...]]()
        if left is not None and left.kind == "transients" and left.units >= HALVED:
            runs = setting.prepared(self.transients)
            options = setting.arguments(runs)
            options.pop("schedule", None)
            names, _ = resolve_groups(self.transients, self.groups)
            names = names or [str(k) for k in range(len(runs))]
            numbers = {name: k for k, name in enumerate(dict.fromkeys(names))}
            k = np.arange(len(numbers))
            for half in (k % 2, k // ((len(k) + 1) // 2), (k + 1) // 2 % 2):
                groups = [int(half[numbers[name]]) for name in names]
                try:
                    found.append(validate(runs, full=left.model, groups=groups, **options).parts)
                except UncertainLTIError:
                    continue  # too little is left to fit to
        self._half = setting, found
        return found

    def _try(self, setting: Setting, family: Family) -> Trial:
        left = self._validated(setting)
        if left is None:
            return Trial(setting, family, refused=self._left[2])
        parts, hours = left.parts, sum(p.hours for p in left.parts)
        try:
            rules, counts = steady(family, left.model, parts, self._halves(setting), allowed_alarms(self.rate, hours))
            model = left.model.replace(alarm=rules)
            found = detectable(model, parts, self.within, kinds=COMPARED, cases=COMPARED_CASES)
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

    def choose(self) -> tuple[Trial, Trial]:
        """What is chosen, and what detects most; never one that is worse than the plain fit where that may be taken."""
        good = [t for t in self.trials if not t.refused]
        most = max(t.seen_share for t in good)
        labelled = sum(len(v) for v in self.faulty.values())
        slack = math.sqrt(most * (1.0 - most) / labelled) if labelled else 0.0
        able = [t for t in good if t.seen_share >= most - slack - 1e-12]
        best = min(able, key=self.score)
        near = [t for t in able if self.score(t, best) <= self.error(t, best)] if best is not self.plain else able
        near = [t for t in near if self.score(t) <= -MARGIN] or [best]
        order = {family: i for i, family in enumerate(self.families)}
        chosen = min(near, key=lambda t: (t.unknowns, order[t.family], self.score(t)))
        if self.score(chosen) > -MARGIN and self.plain in able:
            chosen = self.plain
        return chosen, best

    def finish(self) -> Tuned:
        """Choose, and fit the chosen way to everything."""
        chosen, best = self.choose()
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
            best = min(others, key=self.score)
            what = f"the best of {len(others)} others" if len(others) > 1 else "the only other"
            return (
                "no other way detects clearly smaller faults on left-out data at as many false alarms: "
                f"{what}, {best.words}, needs {math.exp(self.score(best)):.3g} times their size"
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
        for i, name in enumerate(model.state_names):
            if not float(domain.x_max[i]) > float(domain.x_min[i]):
                yield f"{name} does not move, so nothing says which faults of it are seen: record runs in which it does"
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
            for allowed in sorted({allowed_alarms(self.rate, hours), 0, 2, 5, 15, 50}):
                try:
                    halves = self._halves(trial.setting)
                    rules, counts = steady(trial.family, left.model, left.parts, halves, allowed)
                    model = left.model.replace(alarm=rules)
                    found = detectable(model, left.parts, self.within, kinds=COMPARED, cases=COMPARED_CASES)
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


def _names(transients: Sequence[Transient]) -> tuple[str, ...]:
    """Signals that every way has."""
    return (*transients[0].state_names, *transients[0].control_names)


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
    """Of everything that a trial depends on: this program, the recordings, and what the signals file says."""
    found = hashlib.sha256(repr(groups).encode())
    for source in sorted(_PACKAGE.rglob("*.py")):
        found.update(source.read_bytes())
    for run in [*transients, *(run for label in sorted(faulty) for run in faulty[label])]:
        signals = None if run.signals is None else replace(run.signals, source="")  # wherever the file lies
        found.update(repr((run.name, run.state_names, run.control_names, run.max_gap, signals)).encode())
        for array in (run.t_ns, run.x, run.u, run.s):
            found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


def _unknowns(model: UncertainLTI) -> int:
    """Elements that are not 0."""
    return sum(int(np.count_nonzero(getattr(m, name))) for m in (model, *model.horizons) for name in ARRAYS)
