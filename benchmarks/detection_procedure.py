# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""One procedure for all detectors: their scores, thresholds from healthy recordings left out, delays of faults."""

from __future__ import annotations

import hashlib
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from detection_cases import Case, Recorded
from detectors import (
    Array,
    Kalman,
    LeastSquares,
    Runs,
    Score,
    Statistic,
    hotelling,
    median_step,
    of_window,
    principal_components,
    residual_detectors,
)
from scipy.stats import chi2

from uncertain_lti import EnvelopeMonitor, UncertainLTI
from uncertain_lti.model.alarm_rule import AlarmRule, Rule, StatisticRule, labels
from uncertain_lti.proposal.tune import STATISTICS
from uncertain_lti.validation.armed import families, quiet
from uncertain_lti.validation.detectable import COMPARED, detectable, log_sizes
from uncertain_lti.validation.part import judge

CONFIDENCE = 0.9
OURS = "ours"
"""Names of this project's rules begin with it."""
SEVERAL = ("armed together", "armed cautiously", "as tuned")
"""How the names of several rules at once end."""

# --- thresholds, delays ---


@dataclass(frozen=True)
class Outcome:
    """One detector on one case."""

    threshold: float
    alarmed: int
    exposure: float
    largest: Array
    peaks: dict[str, Array] = field(default_factory=dict)
    delays: dict[str, Array] = field(default_factory=dict)
    early: dict[str, Array] = field(default_factory=dict)

    @property
    def rate(self) -> tuple[float, float, float]:
        """False alarms by the case's unit with an interval, by Poisson's law."""
        low = chi2.ppf((1 - CONFIDENCE) / 2, 2 * self.alarmed) / 2 if self.alarmed else 0.0
        high = chi2.ppf((1 + CONFIDENCE) / 2, 2 * self.alarmed + 2) / 2
        return self.alarmed / self.exposure, low / self.exposure, high / self.exposure

    def seen(self, label: str) -> Array:
        """Whether each recording with that fault raised the alarm."""
        return np.isfinite(self.delays[label])

    def share(self) -> float:
        """Share of the recordings detected, every fault counting alike."""
        return float(np.mean([self.seen(label).mean() for label in self.delays]))


def threshold_of(case: Case, score: Score, allowed: int) -> float:
    """The smallest value that as many recordings of `learn` exceed, and no more."""
    return float(np.sort(np.concatenate([score(runs).max(axis=1) for runs in case.learn]))[::-1][allowed])


def cautious(allowed: int) -> int:
    """The most alarms on `learn` after which so many are, with that confidence, not exceeded on the same again."""
    return max([k for k in range(allowed + 1) if chi2.ppf(CONFIDENCE, 2 * (k + 1)) / 2 <= allowed], default=0)


def evaluate(case: Case, score: Score, allowed: int | None = None) -> Outcome:
    """Learn the threshold, count false alarms, find the delays."""
    threshold = threshold_of(case, score, case.allowed if allowed is None else allowed)
    largest = np.concatenate([score(runs).max(axis=1) for runs in case.healthy])
    peaks, delays, early = {}, {}, {}
    for label, faulty in case.faulty.items():
        after = score(faulty.runs)[:, faulty.first :]
        elapsed = np.cumsum(faulty.runs.dt[:, faulty.first - 1 :], axis=1)
        above = after > threshold
        first = above.argmax(axis=1)
        delays[label] = np.where(above.any(axis=1), elapsed[np.arange(len(first)), first], np.inf)
        peaks[label] = after.max(axis=1)
        early[label] = np.where(elapsed <= case.within, after, -np.inf).max(axis=1)
    return Outcome(threshold, int((largest > threshold).sum()), case.exposure, largest, peaks, delays, early)


# --- this project's rules ---


@dataclass(frozen=True)
class Kind:
    """A rule of the alarm but for its threshold.

    Parameters
    ----------
    kind : {"containment", "energy", "mean", "ewma", "cusum", "chi2", "mewma"}
        As `AlarmRule` and `StatisticRule` have it. Containment is 1 of 1, or half of the verdicts of the window.
    window : float
        Of it, s; 0 for one sample.
    horizon : int, default 1
        Steps.
    allowance : float, default 0.0
        Of cusum.
    """

    kind: str
    window: float = 0.0
    horizon: int = 1
    allowance: float = 0.0

    @property
    def name(self) -> str:
        """As tables call it."""
        over = "" if self.horizon == 1 else f" over {self.horizon} steps"
        long = f"{self.window * 1e6:g} µs" if self.window < 1e-3 else f"{self.window:g} s"
        return self.kind + (f" {long}" if self.window else "") + over

    def rule(self, threshold: float, step: float) -> Rule:
        """With its threshold: a margin, or that of the statistic."""
        if self.kind == "containment":
            count = max(1, round(self.window / step))
            return AlarmRule((count + 1) // 2, count, threshold, self.horizon)
        return StatisticRule(self.kind, max(self.window, step), threshold, self.horizon, self.allowance)


@dataclass(frozen=True)
class OurRules:
    """Scores of rules by the monitor itself: a statistic by its own arithmetic, containment by the utilisation."""

    model: UncertainLTI
    kinds: tuple[Kind, ...]
    step: float
    kept: dict[int, tuple[Recorded, dict[Kind, Array], Array]] = field(default_factory=dict)

    def scores(self, name: str) -> dict[str, Score]:
        """One for each rule; the alarm is raised where it exceeds the threshold."""
        return {f"{name}, {kind.name}": lambda runs, kind=kind: self._of(runs)[0][kind] for kind in self.kinds}  # type: ignore[misc]

    def residuals(self, horizon: int) -> Callable[[Runs], Array]:
        """Residuals over half-widths, the utilisation; 0 where there is no verdict."""
        row = self.steps.index(horizon)
        return lambda runs: np.nan_to_num(self._of(runs)[1][:, 1:, row])

    @property
    def steps(self) -> list[int]:
        """1, and the steps of the horizons."""
        return [1, *(h.steps for h in self.model.horizons)]

    def _of(self, runs: Runs) -> tuple[dict[Kind, Array], Array]:
        if id(runs) not in self.kept:
            assert isinstance(runs, Recorded)
            self.kept[id(runs)] = (runs, *self._computed(runs))
        return self.kept[id(runs)][1:]

    def _computed(self, runs: Recorded) -> tuple[dict[Kind, Array], Array]:
        statistics = [kind for kind in self.kinds if kind.kind != "containment"]
        rules = [kind.rule(1.0, self.step) for kind in statistics]
        monitor = EnvelopeMonitor(self.model, rules=[AlarmRule(), *rules])
        values: dict[Kind, list[Array]] = {kind: [] for kind in statistics}
        used = []
        for t in runs.transients:
            verdicts = monitor.check(t)
            used.append(verdicts.horizon_utilisation)
            of = [name.split("/")[0] for name in verdicts.statistic_names]
            for kind, label in zip(statistics, labels(rules), strict=True):
                columns = [j for j, name in enumerate(of) if name == label]
                values[kind].append(np.abs(verdicts.statistics[:, columns]).max(axis=1))
        table = np.stack(used)
        found = {kind: np.nan_to_num(np.stack(rows), nan=-np.inf, posinf=np.inf) for kind, rows in values.items()}
        for kind in self.kinds:
            rule = kind.rule(1.0, self.step)
            if isinstance(rule, AlarmRule):
                level = np.abs(table[:, :, self.steps.index(kind.horizon)]).max(axis=2)
                found[kind] = of_window(np.where(np.isnan(level), -np.inf, level), rule.violations, rule.window)
        return found, table


def our_rules(model: UncertainLTI, fitted: Sequence[Recorded], kinds: Sequence[Kind]) -> OurRules:
    """Those of these rules that the model has the horizon for."""
    steps = (1, *(h.steps for h in model.horizons))
    return OurRules(model, tuple(kind for kind in kinds if kind.horizon in steps), median_step(fitted))


def armed_together(scores: Sequence[Score], case: Case) -> Score:
    """Several rules, each with its share of the false alarms: the largest of the values over their thresholds."""
    limits = [threshold_of(case, score, case.allowed // len(scores)) for score in scores]
    return lambda runs: np.maximum.reduce([score(runs) / limit for score, limit in zip(scores, limits, strict=True)])


# --- what the product chooses ---

CASES = 15
"""Onsets of each fault, about."""
WORTH = 0.02
"""A family must detect faults smaller by this share to be taken before a plainer one."""


@dataclass(frozen=True)
class AsTuned:
    """What this project's own procedure chooses from healthy recordings and injected faults.

    Parameters
    ----------
    score : callable
        The largest of what each of its rules compares with its threshold, over that.
    text : str
        What was chosen, and of what.
    rules : tuple of Rule
        What was chosen, with thresholds.
    """

    score: Score
    text: str
    rules: tuple[Rule, ...]


def as_tuned(
    models: Mapping[str, UncertainLTI], case: Case, statistics: Sequence[tuple[str, ...]] = STATISTICS
) -> AsTuned:
    """The model and the family of rules with the smallest detectable faults, as `tune` looks for them.

    Thresholds are the smallest at which `case.learn` raises as many alarms as may be; faults are injected into
    some of `case.learn` (biases, drifts and noise of states, offsets of controls, seen within `case.within`). The
    faults of the case are not looked at. m of n is left out: it takes long, and never pays beside a statistic.
    """
    found = []
    for name, model in models.items():
        parts = [judge(model, model, t, t.name) for runs in case.learn for t in runs.transients]
        some = parts[:: max(1, len(parts) // CASES)]
        for family in families(parts, median_step(case.fitted), statistics):
            if family.window > 1 and not family.kinds:
                continue
            rules, _ = quiet(family, model, parts, case.allowed)
            seen = detectable(model.replace(alarm=rules), some, case.within, kinds=COMPARED, cases=CASES)
            largest = np.log([fault.largest for fault in seen.faults])
            size = log_sizes([(fault.thresholds, fault.largest) for fault in seen.faults]) - largest
            found.append((float(np.exp(np.nanmean(size))), name, family, rules))
            print(f"{case.title}: {name}, {family.words}: {found[-1][0]:.4g} of the largest", file=sys.stderr)
    least = min(found, key=lambda row: row[0])[0]
    size, name, family, rules = next(row for row in found if row[0] <= least * (1.0 + WORTH))
    model, monitor = models[name], EnvelopeMonitor(models[name], rules=rules)

    def score(runs: Runs) -> Array:
        assert isinstance(runs, Recorded)
        verdicts = [monitor.check(t) for t in runs.transients]
        levels = [np.nanmax(np.abs(v.statistics), axis=1, initial=-np.inf) for v in verdicts]
        every = [np.stack(levels)]
        for rule in rules:
            if isinstance(rule, AlarmRule):
                row = 0 if rule.horizon == 1 else 1 + model.steps.index(rule.horizon)
                used = np.stack([np.abs(v.horizon_utilisation[:, row]).max(axis=1) for v in verdicts]) / rule.margin
                every.append(of_window(np.where(np.isnan(used), -np.inf, used), rule.violations, rule.window))
        return np.asarray(np.maximum.reduce(every))

    kept: dict[int, tuple[Runs, Array]] = {}

    def once(runs: Runs) -> Array:
        if id(runs) not in kept:
            kept[id(runs)] = (runs, score(runs))
        return kept[id(runs)][1]

    words = f"{name.removeprefix(OURS + ', ')}; {family.words}; beside it containment of one step and of every horizon"
    text = (
        f"As tuned: of {len(found)} ways, {words}, which sees {', '.join(COMPARED)} of {size:.3g} of the largest tried "
        f"within {case.within:g} s on the recordings that thresholds are learnt from.\n"
    )
    return AsTuned(once, text, rules)


# --- other detectors ---


def other_detectors(
    fitted: Sequence[Recorded],
    windows: Sequence[float],
    slacks: Sequence[float] = (0.25, 0.5),
    weights: Sequence[float] = (0.02, 0.1),
) -> dict[str, Score]:
    """What a user would set up: residuals of least squares, Kalman's innovations, [x u] itself."""
    law = LeastSquares.of(fitted)
    windowed = [Statistic("chi2", window) for window in (0.0, *windows)]
    slow = [*(Statistic("CUSUM", slack) for slack in slacks), *(Statistic("MEWMA", weight) for weight in weights)]
    found: dict[str, Score] = {}
    for residuals, name, statistics in (
        (law, "least squares", [Statistic("3 sigma"), *windowed, *slow]),
        (Kalman.likeliest(fitted, law), "Kalman, likeliest", [*windowed, *slow]),
        (Kalman.of(fitted, law, 0.1, 0.1), "Kalman, slow", [*windowed, *slow]),
    ):
        for statistic, score in residual_detectors(residuals, fitted, statistics).items():
            found[f"{name}, {statistic}"] = score
    found["Hotelling on [x u]"] = hotelling(fitted)
    for share in (0.99, 0.9999):
        found[f"PCA-SPE on [x u], {100 * share:g} %"] = principal_components(fitted, share)
    return found


def asked(case: Case, peers: str, keep: Path | None = None) -> dict[str, Score]:
    """Scores of detection_peers.py, from its own interpreter; empty, and said, if it is not there."""
    sets: dict[str, Recorded] = {f"fitted{i}": runs for i, runs in enumerate(case.fitted)}
    sets |= {f"learn{i}": runs for i, runs in enumerate(case.learn)}
    sets |= {f"healthy{i}": runs for i, runs in enumerate(case.healthy)}
    sets |= {f"faulty{i}": faulty.runs for i, faulty in enumerate(case.faulty.values())}
    script = Path(__file__).with_name("detection_peers.py")
    with tempfile.TemporaryDirectory() as folder:
        given, answer = Path(folder) / "in.npz", Path(folder) / "out.npz"
        np.savez(given, **{f"{k}_{name}": getattr(runs, k) for name, runs in sets.items() for k in ("x", "u", "dt")})
        if keep is not None:  # scores of the same script on the same recordings
            asked_for = hashlib.sha256(script.read_bytes())
            for name, runs in sets.items():  # with names: what is fitted in one draw is judged in another
                asked_for.update(name.encode() + runs.x.tobytes() + runs.u.tobytes())
            answer = keep / f"peers-{asked_for.hexdigest()[:20]}.npz"
        if not answer.is_file():
            try:
                subprocess.run(
                    [peers, str(script), str(given), str(answer)], check=True, capture_output=True, text=True
                )
            except (OSError, subprocess.CalledProcessError) as error:
                reason = (getattr(error, "stderr", "") or str(error)).strip().splitlines()[-1]
                print(f"scikit-learn, MAPIE and SENTIL are left out: {reason}", file=sys.stderr)
                return {}
        with np.load(answer) as data:
            scores = {key: data[key] for key in data}
    found: dict[str, Score] = {}
    for detector in sorted({key.split("|")[0] for key in scores}):
        by_runs = {id(runs): scores[f"{detector}|{name}"] for name, runs in sets.items()}
        found[detector] = lambda runs, by_runs=by_runs: by_runs[id(runs)]  # type: ignore[misc]
    return found


def on_our_residuals(name: str, ours: OurRules, fitted: Sequence[Recorded]) -> dict[str, Score]:
    """The usual statistics on our residuals, of one step and of the shortest horizon."""
    statistics = [Statistic("3 sigma"), Statistic("chi2"), Statistic("CUSUM", 0.5), Statistic("MEWMA", 0.02)]
    found = {}
    for horizon in ours.steps[:2]:
        over = "" if horizon == 1 else f" over {horizon} steps"
        for statistic, score in residual_detectors(ours.residuals(horizon), fitted, statistics).items():
            found[f"our residuals, {name}{over}, {statistic}"] = score
    return found
