# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Do the intervals of validation contain the truth as often as they promise? Studies on simulated plants, seeded.

    ./run python benchmarks/validity.py                     # all studies with all their plants, some minutes
    ./run python benchmarks/validity.py --plants 40         # fewer; tests/test_validation.py has eight or three
    ./run python benchmarks/validity.py --only recordings
    ./run python benchmarks/validity.py --only detectable --plants 100 --first 5000    # plants that nobody has seen

Each plant is three nonlinear tanks whose coefficients are drawn within 20 %, with recordings of its own; the truth is
what the very model that was validated does on fresh transients of the same plant. Half of the plants have sensor noise
and the additive term. Exit status 1 when an interval for 90 % contains the truth in less than 87 % of the cases.
"""

from __future__ import annotations

import argparse
import copy
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
if not any("uncertain_lti" in str(p) for p in sys.path):
    sys.path.insert(0, str(ROOT / "tests" / "checkout"))

from measure import table  # noqa: E402
from tanks import DT, Tanks  # noqa: E402

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI  # noqa: E402
from uncertain_lti.model.alarm_rule import AlarmRule, Rule  # noqa: E402
from uncertain_lti.validation.detectable import detectable  # noqa: E402
from uncertain_lti.validation.left_out import validate  # noqa: E402
from uncertain_lti.validation.panel import learn  # noqa: E402
from uncertain_lti.validation.part import fitted_parts  # noqa: E402
from uncertain_lti.validation.result import Validation  # noqa: E402

CONFIDENCE = 0.9
LEAST = 0.87
PLANTS = 200
IN_VAIN = "one recording at a time, in vain"
"""Beginning of what is shown not to hold."""
NEITHER = "one recording at a time, holding or not"
"""Beginning of what is told and neither promised nor shown not to hold."""
PART = "of these, "
"""Beginning of what is a part of the row above it."""

Held = dict[str, list[bool]]
"""By promise: whether its interval contains the truth, for each plant that was given one."""


def true_alarms(model: UncertainLTI, x: np.ndarray, u: np.ndarray, rule: AlarmRule) -> tuple[np.ndarray, np.ndarray]:
    """Alarms on each fresh transient, (count,), and whether each transition leaves its bounds, (count, steps)."""
    low, high = model.bounds(x[:, :-1], u[:, :-1], DT, margin=rule.margin)
    left = ~((low <= x[:, 1:]) & (x[:, 1:] <= high)).all(axis=-1)
    recent = np.cumsum(np.pad(left, ((0, 0), (rule.window, 0))), axis=1)
    raised = recent[:, rule.window :] - recent[:, : -rule.window] >= rule.violations
    return raised[:, 0] + (raised[:, 1:] & ~raised[:, :-1]).sum(axis=1), left


def true_alarms_of(model: UncertainLTI, x: np.ndarray, u: np.ndarray, rules: Sequence[Rule]) -> float:
    """Alarms of several rules on all fresh transients together, by the monitor; time jumps back between them."""
    count, samples = x.shape[:2]
    t = np.tile(np.arange(samples) * round(DT * 1e9), count)
    whole = Transient(t, x.reshape(count * samples, -1), np.asarray(u).reshape(count * samples, -1))
    alarm = EnvelopeMonitor(model, rules=rules).check(whole).alarm.reshape(count, samples)
    return float((alarm[:, 1:] & ~alarm[:, :-1]).sum() + alarm[:, 0].sum())


def panel_keeps(validation: Validation, runs: Sequence[Transient], x: np.ndarray, u: np.ndarray) -> bool:
    """Whether the panel's alarms on fresh transients stay below the limit that it states."""
    panel = learn(validation, fitted_parts(validation.model, runs))
    hours = x.shape[0] * (x.shape[1] - 1) * DT / 3600
    return true_alarms_of(validation.model, x, u, panel.rules) / hours <= panel.limit


def recordings(plants: Iterable[int]) -> Held:
    """Recordings left out one at a time, 8 to 24 of them, both criteria; the truth on 250 fresh transients."""
    held: Held = {}
    for seed in plants:
        rng = np.random.default_rng([seed, 1])
        plant, noise = Tanks(seed, spread=0.2), 1e-3 * (seed % 2)
        runs = plant.transients(int(rng.integers(8, 25)), seed, noise=noise)
        validation = validate(
            runs, criterion=("qp", "lp")[seed // 2 % 2], additive="noise" if noise else "none", confidence=CONFIDENCE
        )
        x, u = plant.arrays(250, 10_000 + seed, noise=noise)
        hours = x.shape[0] * 100 * DT / 3600
        data = validation.to_dict()
        for entry in data["false_alarms"]:
            rule = AlarmRule()
            alarms, left = true_alarms(validation.model, x, u, rule)
            low, high = entry["interval"]
            held.setdefault(f"alarms per hour, {rule.violations} of {rule.window}", []).append(
                low <= alarms.sum() / hours <= high
            )
        low, high = data["inside_interval"]
        held.setdefault("verdicts inside", []).append(low <= 1 - left.mean() <= high)
        risk = left.any(axis=1).mean()
        low, high = data["parts_inside_interval"]
        held.setdefault("recordings wholly inside", []).append(low <= 1 - risk <= high)
        if "interval" in data["scenario"]:
            low, high = data["scenario"]["interval"]
            held.setdefault("recordings that leave, by support", []).append(low <= risk <= high)
        held.setdefault("the panel keeps to its limit", []).append(panel_keeps(validation, runs, x, u))
    return held


def blocks(plants: Iterable[int]) -> Held:
    """Ten blocks of one recording of 1500 steps; the truth on more of the same, settled, 20 times 750 steps."""
    held: Held = {}
    for seed in plants:
        plant, noise = Tanks(seed, spread=0.2), 1e-3 * (seed % 2)
        (run,) = plant.transients(1, seed, steps=1500, noise=noise)
        validation = validate(run, additive="noise" if noise else "none", confidence=CONFIDENCE)
        x, u = plant.arrays(20, 10_000 + seed, steps=800, noise=noise)
        x, u = x[:, 50:], u[:, 50:]
        hours = 20 * 750 * DT / 3600
        for entry in validation.to_dict()["false_alarms"]:
            rule = AlarmRule()
            alarms, _ = true_alarms(validation.model, x, u, rule)
            low, high = entry["interval"]
            held.setdefault(f"alarms per hour, {rule.violations} of {rule.window}", []).append(
                low <= alarms.sum() / hours <= high
            )
    return held


FAULTS = ("bias", "drift", "spike", "offset", "loss", "time_constant")
"""Kinds of which the study of detectable faults simulates the truth."""
FRESH = 400
"""Fresh recordings with a fault, for each."""


def faulty(plant: Tanks, kind: str, i: int, size: float, seed: int, noise: float) -> tuple[np.ndarray, ...]:
    """x, u of fresh recordings with the true fault (half of either sign, where it has one), healthy x, and onsets."""
    rng = np.random.default_rng([seed, 9])
    onset = rng.integers(1, 78, FRESH)
    sign = np.where(np.arange(FRESH) % 2, 1.0, -1.0)
    after = np.arange(101) >= onset[:, None]
    healthy, u = plant.arrays(FRESH, seed, noise=noise)
    if kind == "offset":
        x, _ = plant.arrays(FRESH, seed, noise=noise, act=lambda u: u + after * (sign * size)[:, None])
    elif kind == "loss":  # of what is commanded, whose steady value is 0
        x, _ = plant.arrays(FRESH, seed, noise=noise, act=lambda u: u * (1 - after * size))
    elif kind == "time_constant":
        x = healthy.copy()
        for one, factor in ((1.0, 1.0 / (1.0 + size)), (-1.0, 1.0 + size)):
            there, _ = plant.arrays(FRESH, seed, noise=noise, slower=(i, factor, onset))
            x[sign == one] = there[sign == one]
    else:
        since = np.maximum(np.arange(101) - onset[:, None], 0) * DT
        shape = {"bias": after, "drift": since, "spike": np.arange(101) == onset[:, None]}[kind]
        x = healthy.copy()
        x[:, :, i] += (sign * size)[:, None] * shape
    return x, u, healthy, onset


def true_share(model: UncertainLTI, found: tuple[np.ndarray, ...], rule: AlarmRule, within: float) -> float:
    """Share of the faults that raise the alarm in time, of those without one."""
    x, u, healthy, onset = found
    k = np.arange(100) + 1  # the sample at which each transition arrives
    inside = (k >= onset[:, None]) & (k * DT <= onset[:, None] * DT + within + 1e-9)
    raised = []
    for states in (x, healthy):
        low, high = model.bounds(states[:, :-1], u[:, :-1], DT, margin=rule.margin)
        left = ~((low <= states[:, 1:]) & (states[:, 1:] <= high)).all(axis=-1)
        left &= k >= onset[:, None] - rule.window  # the alarm starts there
        recent = np.cumsum(np.pad(left, ((0, 0), (rule.window, 0))), axis=1)
        raised.append(((recent[:, rule.window :] - recent[:, : -rule.window] >= rule.violations) & inside).any(axis=1))
    return float(raised[0][~raised[1]].mean())


def detectable_faults(plants: Iterable[int]) -> Held:
    """12 to 24 recordings; faults of the smallest detectable size, simulated in 400 fresh recordings of the plant."""
    held: Held = {}
    for seed in plants:
        rng = np.random.default_rng([seed, 11])
        plant, noise = Tanks(seed, spread=0.2), 1e-3 * (seed % 2)
        runs = plant.transients(int(rng.integers(12, 25)), seed, noise=noise)
        rule = (AlarmRule(), AlarmRule(2, 3))[seed // 4 % 2]
        validation = validate(
            runs, criterion=("qp", "lp")[seed // 2 % 2], additive="noise" if noise else "none", alarm_rule=rule
        )
        found = detectable(validation.model, validation.parts, kinds=FAULTS, confidence=CONFIDENCE, seed=seed)
        for number, fault in enumerate(found.faults):
            if not np.isfinite(fault.size):
                continue
            i = 0 if fault.signal.startswith("u") else int(fault.signal[1]) - 1
            truth = faulty(plant, fault.kind, i, fault.size, 90_000 + 100 * seed + number, noise)
            low, high = fault.share_interval
            share = true_share(validation.model, truth, rule, found.within)
            held.setdefault(f"share of {fault.kind} seen", []).append(low <= share <= high)
    return held


def variant(plant: Tanks, rng: np.random.Generator, spread: float) -> Tanks:
    """The same machine on another day."""
    other = copy.copy(plant)
    other.c = plant.c * (1 + spread * rng.uniform(-1, 1, 3))
    return other


def groups(plants: Iterable[int]) -> Held:
    """12 recordings of 3 machine-days, left out by day and, in vain, one at a time; the truth on 50 fresh days."""
    held: Held = {}
    for seed in plants:
        rng = np.random.default_rng([seed, 5])
        base = Tanks(seed, spread=0.2)
        runs = [r for g in range(3) for r in variant(base, rng, 0.1).transients(4, 100 * seed + g, noise=1e-3)]
        days = [variant(base, rng, 0.1).arrays(5, 500_000 + 100 * seed + i, noise=1e-3) for i in range(50)]
        x, u = (np.concatenate(arrays) for arrays in zip(*days, strict=True))
        hours = len(x) * 100 * DT / 3600
        for name, by in (("by day", [g for g in range(3) for _ in range(4)]), (IN_VAIN, None)):
            validation = validate(runs, criterion=("qp", "lp")[seed % 2], additive="noise", groups=by)
            data = validation.to_dict()
            for entry in data["false_alarms"]:
                alarms, left = true_alarms(validation.model, x, u, AlarmRule())
                low, high = entry["interval"]
                held.setdefault(f"{name}: alarms per hour", []).append(low <= alarms.sum() / hours <= (high or np.inf))
            low, high = data["inside_interval"]
            held.setdefault(f"{name}: verdicts inside", []).append(low <= 1 - left.mean() <= high)
            low, high = data["parts_inside_interval"]
            either = NEITHER if name == IN_VAIN else name
            whole = low <= 1 - left.any(axis=1).mean() <= high
            held.setdefault(f"{either}: recordings wholly inside", []).append(whole)
            held.setdefault(f"{name}: the panel keeps to its limit", []).append(panel_keeps(validation, runs, x, u))
    return held


def rare(plants: Iterable[int]) -> Held:
    """20 recordings, 5 % of them rough (five times the noise); the truth on 200 fresh ones, 5 % of them rough."""
    held: Held = {}
    for seed in plants:
        rng = np.random.default_rng([seed, 5])
        base = Tanks(seed, spread=0.2)
        noises: list[float] = []

        def rough(seed: int, count: int) -> tuple[np.ndarray, ...]:
            noises.append(5e-3 if rng.random() < 0.05 else 1e-3)  # noqa: B023
            return base.arrays(count, seed, noise=noises[-1])  # noqa: B023

        runs = [_transient(*(a[0] for a in rough(100 * seed + i, 1))) for i in range(20)]
        recorded = max(noises) > 1e-3
        fresh = [rough(500_000 + 1000 * seed + i, 2) for i in range(200)]
        validation = validate(runs, criterion=("qp", "lp")[seed % 2], additive="noise")
        found: Held = {}
        _compare(found, validation, runs, fresh, NEITHER, IN_VAIN, "one recording at a time")
        for what, hits in found.items():
            held.setdefault(what, []).extend(hits)
            of = f"{PART}a rough run recorded" if recorded else f"{NEITHER}, no rough run recorded"
            held.setdefault(f"{of}: {what.rpartition(': ')[2]}", []).extend(hits)
    return held


def drift(plants: Iterable[int]) -> Held:
    """A coefficient drifts by 6 % over 20 recordings, and on over 200 fresh ones; left out in fours, and singly."""
    held: Held = {}
    for seed in plants:
        base = Tanks(seed, spread=0.2)

        def worn(age: float, seed: int, count: int, base: Tanks = base) -> tuple[np.ndarray, ...]:
            plant = copy.copy(base)
            plant.c = base.c * (1 - 0.06 * age * np.array([0, 1, 0]))
            return plant.arrays(count, seed, noise=1e-3)

        runs = [_transient(*(a[0] for a in worn(i / 20, 100 * seed + i, 1))) for i in range(20)]
        fresh = [worn(1 + i / 200, 500_000 + 1000 * seed + i, 2) for i in range(200)]
        for name, by in (("by four in a row", [i // 4 for i in range(20)]), (IN_VAIN, None)):
            validation = validate(runs, criterion=("qp", "lp")[seed % 2], additive="noise", groups=by)
            either = NEITHER if name == IN_VAIN else name
            _compare(held, validation, runs, fresh, either, name, either)
    return held


def _transient(x: np.ndarray, u: np.ndarray) -> Transient:
    return Transient(np.arange(len(x)) * round(DT * 1e9), x, u)


def _compare(
    held: Held,
    validation: Validation,
    runs: Sequence[Transient],
    fresh: list[tuple[np.ndarray, ...]],
    alarms_of: str,
    rest_of: str,
    whole_of: str,
) -> None:
    """Add what the intervals contain; beginnings of the names for alarms, for whole recordings and for all else."""
    x, u = (np.concatenate(arrays) for arrays in zip(*fresh, strict=True))
    hours, data = len(x) * 100 * DT / 3600, validation.to_dict()
    for entry in data["false_alarms"]:
        rule = AlarmRule()
        alarms, left = true_alarms(validation.model, x, u, rule)
        rate = alarms.sum() / hours
        low, high = entry["interval"]
        held.setdefault(f"{alarms_of}: alarms per hour, {rule.violations} of {rule.window}", []).append(
            low <= rate <= (high or np.inf)
        )
    low, high = data["inside_interval"]
    held.setdefault(f"{rest_of}: verdicts inside", []).append(low <= 1 - left.mean() <= high)
    low, high = data["parts_inside_interval"]
    held.setdefault(f"{whole_of}: recordings wholly inside", []).append(low <= 1 - left.any(axis=1).mean() <= high)
    held.setdefault(f"{rest_of}: the panel keeps to its limit", []).append(panel_keeps(validation, runs, x, u))


STUDIES: dict[str, Callable[[Iterable[int]], Held]] = {
    "recordings": recordings,
    "blocks": blocks,
    "groups": groups,
    "rare": rare,
    "drift": drift,
    "detectable": detectable_faults,
}
SLOW = ("rare", "drift", "detectable")
"""Studies that take about a second of processor time a plant."""


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--plants", type=int, default=PLANTS, help="plants of each study")
    parser.add_argument("--first", type=int, default=0, help="seed of the first plant")
    parser.add_argument("--only", choices=list(STUDIES), help="this study alone")
    options = parser.parse_args()
    failed = False
    for name in [options.only] if options.only else STUDIES:
        held = STUDIES[name](range(options.first, options.first + options.plants))
        rows = [[what, f"{np.mean(hits):.1%} of {len(hits)}"] for what, hits in held.items()]
        table(f"{name}: {STUDIES[name].__doc__}", [f"{CONFIDENCE:.0%} interval of", "contains the truth"], rows)
        failed |= any(np.mean(hits) < LEAST for what, hits in held.items() if not what.startswith((IN_VAIN, NEITHER)))
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main())
