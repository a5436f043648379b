# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The smallest fault that an alarm rule detects: injected into what was left out of the fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import FitError
from uncertain_lti.base.progress import CountedStep
from uncertain_lti.model.alarm_rule import FADING, AlarmRule
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.envelope_monitor import EnvelopeMonitor
from uncertain_lti.sampling.instants import to_ns
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.validation.injection import KINDS, Windows, faulty
from uncertain_lti.validation.intervals import quantile_share_interval
from uncertain_lti.validation.part import Part, unit_numbers

SHARE = 0.9
"""Share of the cases in which a fault of the smallest detectable size is seen."""
CASES = 60
"""Onsets of each fault, about, over all that was left out."""
FEWEST = 10
"""Cases below which nothing is stated."""
WITHIN, WITHIN_STEPS, OF_PART = 1.0, 20, 0.25
"""Time within which a fault shall be seen, by default: 1 s or 20 steps, at most a quarter of a typical part."""
ROUNDS, FINEST = 9, 2.0**-20
"""Bisections of the logarithm of the size, from the largest down to FINEST of it: to 3 %."""
LARGEST = 4.0
"""Largest offset tried, in ranges of the signal; ..."""
LARGEST_SHARE = 10.0
"""... and largest share (of `loss` it is 1)."""
LIMIT = 2.0e8
"""Samples judged for all faults together, above which fewer cases are taken."""
LONGEST_MEMORY = 2000
"""Samples before the onset that are judged, at most."""
DECAYED = 3
"""Windows after which a moving average or a cumulative sum has forgotten what was before, for the most part."""
OFF = 1.1
"""Factor by which the nominal model's response to actuators and dynamics may be off, for the interval of a share."""
MOST_TOGETHER = 2_000_000
"""Numbers that are judged at a time, about."""
GROWS = 10.0
"""Growth of a deviation within the time, by the nominal model, from which on its response to faults says nothing."""


@dataclass(frozen=True, eq=False)
class Seen:
    """The smallest detectable fault of one kind on one signal.

    `kind`: one of `KINDS`; `signal`: name of the state or control; `unit`: of the size; `thresholds` (cases,): smallest
    size that was seen in each case; inf where even the largest was not; `largest`: the largest size tried; `size`: seen
    in SHARE of the cases; inf if the largest is not; `size_interval`: its confidence interval; `share`: share of the
    cases in which that size was seen; of the largest size if `size` is inf; `share_interval`: confidence interval of
    the share of all such cases, of which these are some; `delay`: median time from the onset to the alarm at that size,
    s; NaN if none was seen; `refused`: why nothing is known; "" otherwise.
    """

    kind: str
    signal: str
    unit: str
    thresholds: Array
    largest: float
    size: float
    size_interval: tuple[float, float]
    share: float
    share_interval: tuple[float, float]
    delay: float
    refused: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Plain data for the model file."""
        return {
            "kind": self.kind,
            "of": KINDS[self.kind].of,
            "signal": self.signal,
            "unit": self.unit,
            "size": _finite(self.size),
            "size_interval": [_finite(v) for v in self.size_interval],
            "largest": self.largest,
            "share": _finite(self.share),
            "share_interval": list(self.share_interval),
            "delay": _finite(self.delay),
            "cases": len(self.thresholds),
            **({"refused": self.refused} if self.refused else {}),
        }


@dataclass(frozen=True, eq=False)
class Detectable:
    """The smallest detectable faults of a model with its alarm rule.

    `within`: time within which a fault is seen, s; `confidence`: of the intervals; `cases`: onsets of each fault;
    `left_out`: cases that were left out because the alarm was raised without a fault; `faults`: by kind and signal;
    `refused`: why there is none; "" otherwise; `units` (cases,): number of what each case was left out with.
    """

    within: float
    confidence: float
    cases: int
    left_out: int
    faults: tuple[Seen, ...]
    refused: str = ""
    units: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))

    def to_dict(self) -> dict[str, Any]:
        """Plain data for the model file."""
        return {
            "within": self.within,
            "share": SHARE,
            "confidence": self.confidence,
            "cases": self.cases,
            "left_out": self.left_out,
            "faults": [fault.to_dict() for fault in self.faults],
            **({"refused": self.refused} if self.refused else {}),
        }

    def find(self, kind: str, signal: str) -> Seen | None:
        """One of the faults."""
        return next((f for f in self.faults if (f.kind, f.signal) == (kind, signal)), None)


@dataclass(frozen=True, eq=False)
class _Cases:
    """Onsets of faults in what was left out, side by side, and the monitors that judge them."""

    windows: Windows
    t_ns: NDArray[np.int64]
    valid: NDArray[np.bool_]
    noise: Array
    unit: NDArray[np.intp]
    owner: NDArray[np.intp]
    monitors: tuple[EnvelopeMonitor, ...]
    template: dict[str, Any]
    step: float

    def __len__(self) -> int:
        return len(self.t_ns)

    def take(self, which: NDArray[np.bool_]) -> _Cases:
        """Some of them."""
        return replace(
            self,
            windows=self.windows.take(which),
            t_ns=self.t_ns[which],
            valid=self.valid[which],
            noise=self.noise[which],
            unit=self.unit[which],
            owner=self.owner[which],
        )

    def delays(self, states: Sequence[tuple[Array, Array]]) -> Array:
        """Time (P, W) from the onset to the first alarm, s, with each of these x, u (W, L, n or m); inf without one."""
        found = np.full((len(states), len(self)), np.inf)
        w, onset = self.windows, self.windows.onset
        since = w.t[:, onset:] - w.t[:, onset][:, None]
        L, n = w.t.shape[1], w.x.shape[2]
        for number, monitor in enumerate(self.monitors):
            rows = np.flatnonzero(self.owner == number)
            if not len(rows):
                continue
            together = max(1, MOST_TOGETHER // (len(rows) * L * n))
            for first in range(0, len(states), together):
                some = states[first : first + together]
                x, u = (np.concatenate([pair[part][rows] for pair in some]) for part in (0, 1))
                alarm = self._alarm(monitor, rows, x, u)[:, onset:] & np.tile(
                    self.valid[rows][:, onset:], (len(some), 1)
                )
                delay = np.where(
                    alarm.any(axis=1),
                    np.tile(since[rows], (len(some), 1))[np.arange(len(alarm)), alarm.argmax(axis=1)],
                    np.inf,
                )
                found[first : first + len(some), rows] = delay.reshape(len(some), len(rows))
        return found

    def _alarm(self, monitor: EnvelopeMonitor, rows: NDArray[np.intp], x: Array, u: Array) -> NDArray[np.bool_]:
        """The alarm of one monitor over windows (P W, L), each from a cleared one."""
        w, copies = self.windows, len(x) // len(rows)
        L = x.shape[1]
        t_ns = np.tile(self.t_ns[rows], (copies, 1))
        apart = int(t_ns.max() - t_ns.min()) + 4 * to_ns(self.template["max_gap"])
        t_ns += apart * np.arange(len(t_ns), 0, -1)[:, None]  # each begins before the one before it: a new alarm
        run = Transient(
            t_ns.ravel(),
            x.reshape(len(t_ns) * L, -1),
            u.reshape(len(t_ns) * L, -1),
            s=np.tile(w.s[rows], (copies, 1, 1)).reshape(len(t_ns) * L, -1),
            **self.template,
        )
        return np.asarray(monitor.check(run).alarm.reshape(len(t_ns), L))


def check_within(within: float | None) -> None:
    """Refuse a time in which nothing can be seen."""
    if within is not None and not (math.isfinite(within) and within > 0):
        raise FitError(f"within is {within}; give a positive number of seconds")


def typical_within(parts: Sequence[Part]) -> float:
    """Time within which a fault shall be seen, where nobody says."""
    steps = np.concatenate([p.dt for p in parts])
    spans = [float(p.dt.sum()) for p in parts if p.judged]
    if not spans:
        return WITHIN
    return min(max(WITHIN, WITHIN_STEPS * float(np.median(steps))), OF_PART * float(np.median(spans)))


def detectable(
    model: UncertainLTI,
    parts: Sequence[Part],
    within: float | None = None,
    *,
    kinds: Sequence[str] = tuple(KINDS),
    cases: int = CASES,
    confidence: float = 0.9,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Detectable:
    """The smallest fault of each kind on each signal that the model's alarm rule detects in SHARE of the cases.

    Each fault is put into every left-out part at some instants (`injection`), and judged by the model that was fitted
    without that part, with the alarm rule of the full model, from a cleared alarm. A case counts as seen if the alarm
    is raised within the time; cases in which it is raised without the fault are left out. In each case the smallest
    size that is seen is found by bisection, and the one that SHARE of the cases see is reported, with the interval that
    `quantile_share_interval` gives for cases that come in recordings or groups.
    """
    for kind in kinds:
        if kind not in KINDS:
            raise FitError(f"there is no fault '{kind}'; there are {', '.join(KINDS)}")
    check_within(within)
    if within is None:
        within = typical_within(parts)
    names = {"actuator": model.control_names, "sensor": model.state_names, "dynamics": model.state_names}
    pairs = [(kind, i, name) for kind in kinds for i, name in enumerate(names[KINDS[kind].of])]
    steps = within / max(_median_step(parts), 1e-12) + _memory(model, _median_step(parts))
    cases = max(min(cases, int(LIMIT / (max(len(pairs), 1) * (ROUNDS + 1) * steps))), 2 * FEWEST)
    every = _cases(model, parts, within, cases, seed)
    left_out = 0
    if every is not None:
        alone = np.isinf(every.delays([(every.windows.x, every.windows.u)])[0])
        left_out = int(np.count_nonzero(~alone))
        every = every.take(alone)
    count = 0 if every is None else len(every)
    if every is None or count < FEWEST:
        why = (
            f"{count} cases of {within:g} s without an alarm are too few to say which faults are seen"
            if count or left_out
            else f"nothing that was left out lasts {within:g} s without a gap; record longer runs, or ask for less time"
        )
        return Detectable(within, confidence, count, left_out, (), why)
    growth = _growth(model, within)
    runs_away = f"the nominal model runs away ({growth:.3g} times within {within:g} s), so its response says nothing"
    searches: list[_Search] = []
    refused: dict[tuple[str, str], str] = {}
    for kind, i, name in pairs:
        if KINDS[kind].of != "sensor" and not growth <= GROWS:
            refused[kind, name] = runs_away
        elif not (largest := _largest(model, every, kind, i, within)) > 0:
            refused[kind, name] = f"{name} does not move in the recordings"
        else:
            searches.append(_Search(kind, i, name, largest, every, seed))
    for number in range(ROUNDS + 2):
        if progress is not None:
            progress(CountedStep("faults of each kind", number + 1, ROUNDS + 2))
        going = [s for s in searches if number < ROUNDS + 2 and not s.never]
        delays = every.delays([s.states(model, every, number) for s in going])
        for search, delay in zip(going, delays, strict=True):
            search.learn(delay, number)
    done = {(s.kind, s.name): s.seen(model, every.unit, confidence) for s in searches}
    found = [
        done[kind, name] if (kind, name) in done else _unknown(kind, name, refused[kind, name])
        for kind, _, name in pairs
    ]
    return Detectable(within, confidence, count, left_out, tuple(found), "", every.unit)


class _Search:
    """Bisection of the size of one fault, in every case at once."""

    def __init__(self, kind: str, i: int, name: str, largest: float, cases: _Cases, seed: int) -> None:
        self.kind, self.i, self.name, self.largest = kind, i, name, largest
        total = len(cases)
        self.signs = np.ones(total)
        if KINDS[kind].both:
            self.signs[np.random.default_rng([seed, 1]).permutation(total)[: total // 2]] = -1.0
        least = min(0.5 * cases.step, 0.5 * largest) if KINDS[kind].unit == "s" else largest * FINEST
        self._low, self._high = np.full(total, math.log(least)), np.full(total, math.log(largest))
        self._reached = np.zeros(total, dtype=bool)
        self._delay = np.full(total, np.inf)
        self.never = False

    def _sizes(self, number: int) -> Array:
        if number == 0:
            return np.full(len(self.signs), self.largest)
        if number <= ROUNDS:
            return np.asarray(np.exp(0.5 * (self._low + self._high)))
        return np.full(len(self.signs), min(self._size(), self.largest))

    def _size(self) -> float:
        """Seen in SHARE of the cases."""
        thresholds = np.sort(np.where(self._reached, np.exp(self._high), np.inf))
        return float(thresholds[math.ceil(SHARE * len(thresholds) - 1e-9) - 1])

    def states(self, model: UncertainLTI, cases: _Cases, number: int) -> tuple[Array, Array]:
        """What is tried in round `number`."""
        size, recalled = self.signs * self._sizes(number), model.signals.recalled
        return faulty(cases.windows, self.kind, self.i, size, cases.noise, recalled, model)

    def learn(self, delay: Array, number: int) -> None:
        """Take what was seen of it."""
        there = np.isfinite(delay)
        if number == 0:
            self._reached, self._delay, self.never = there, delay, not there.any()
        elif number <= ROUNDS:
            middle = 0.5 * (self._low + self._high)
            self._high, self._low = np.where(there, middle, self._high), np.where(there, self._low, middle)
        else:
            self._delay = delay

    def seen(self, model: UncertainLTI, units: NDArray[np.intp], confidence: float) -> Seen:
        """The result."""
        thresholds = np.where(self._reached, np.exp(self._high), np.inf)
        order, size, total = np.sort(thresholds), self._size(), len(thresholds)
        inside = thresholds <= min(size, self.largest)
        share, interval = quantile_share_interval(units, inside, confidence)
        if KINDS[self.kind].of != "sensor":  # the nominal model's response may be off
            interval = (
                quantile_share_interval(units, thresholds <= size / OFF, confidence)[1][0],
                quantile_share_interval(units, thresholds <= min(size * OFF, self.largest), confidence)[1][1],
            )
        _, levels = quantile_share_interval(units, inside, confidence, share=SHARE)
        low, high = (float(order[min(max(math.ceil(v * total - 1e-9), 1), total) - 1]) for v in levels)
        delay = self._delay[np.isfinite(self._delay)]
        return Seen(
            self.kind,
            self.name,
            _unit(model, self.kind, self.i),
            thresholds,
            self.largest,
            size,
            (low, high if levels[1] < 1.0 else math.inf),
            share,
            interval,
            float(np.median(delay)) if len(delay) else math.nan,
        )


def _unknown(kind: str, name: str, why: str) -> Seen:
    unknown = (0.0, math.inf)
    return Seen(kind, name, "", np.empty(0), 0.0, math.inf, unknown, math.nan, (0.0, 1.0), math.nan, why)


def _unit(model: UncertainLTI, kind: str, i: int) -> str:
    signals = model.signals.controls if KINDS[kind].of == "actuator" else model.signals.states
    unit = signals[i].unit
    return {
        "recorded": unit,
        "rate": f"{unit}/s" if unit else "1/s",
        "share": "",
        "s": "s",
    }[KINDS[kind].unit]


def _largest(model: UncertainLTI, every: _Cases, kind: str, i: int, within: float) -> float:
    """The largest size that is tried."""
    what = KINDS[kind]
    if what.unit == "share":
        return 1.0 if kind == "loss" else LARGEST_SHARE
    if what.unit == "s":
        return within
    values = (every.windows.u if what.of == "actuator" else every.windows.x)[:, :, i]
    domain = model.domain
    low, high = (domain.u_min, domain.u_max) if what.of == "actuator" else (domain.x_min, domain.x_max)
    scale = model.operating_point.U if what.of == "actuator" else model.operating_point.X
    span = max(float(high[i] - low[i]) * float(scale[i]), float(np.nanmax(values) - np.nanmin(values)))
    span = span if math.isfinite(span) else float(np.nanmax(values) - np.nanmin(values))
    return LARGEST * span / (within if what.unit == "rate" else 1.0)


def _median_step(parts: Sequence[Part]) -> float:
    return float(np.median(np.concatenate([p.dt for p in parts]))) if any(p.judged for p in parts) else 1.0


def _memory(model: UncertainLTI, step: float) -> int:
    """Samples before the onset that the alarm depends on, for the most part."""
    found = 1
    for rule in model.alarm:
        if isinstance(rule, AlarmRule):
            own = rule.window
        else:
            own = math.ceil(rule.window_s / step * (DECAYED if rule.kind in FADING else 1))
        found = max(found, own + rule.horizon)
    return min(found, LONGEST_MEMORY)


def _growth(model: UncertainLTI, within: float) -> float:
    """By how much the nominal model multiplies a deviation within the time."""
    if model.sampling.dt_median is None:
        return 1.0
    with np.errstate(over="ignore"):
        return float(np.exp(min(within / model.sampling.dt_median * math.log(max(model.spectral_radius(), 1e-9)), 700)))


def _cases(model: UncertainLTI, parts: Sequence[Part], within: float, cases: int, seed: int) -> _Cases | None:
    """Onsets, spread over what was left out by its length; None if nothing is long enough."""
    eligible = [_onsets(p.transient, within) if p.transient is not None else None for p in parts]
    if any(p.model is None or e is None for p, e in zip(parts, eligible, strict=True)):
        raise FitError("the parts do not hold what they were judged by; validate again")
    total = sum(len(e) for e in eligible if e is not None)
    step = _median_step(parts)
    chosen: list[tuple[Part, int, NDArray[np.intp], np.random.Generator]] = []
    for number, (part, unit, places) in enumerate(zip(parts, unit_numbers(parts).tolist(), eligible, strict=True)):
        assert places is not None
        if len(places):
            rng = np.random.default_rng([seed, number])
            count = min(max(1, round(cases * len(places) / total)), len(places))
            edges = np.linspace(0, len(places), count + 1).astype(int)
            picks = [int(rng.integers(a, max(b, a + 1))) for a, b in zip(edges, edges[1:], strict=False)]
            chosen.append((part, unit, places[np.unique(picks)], rng))
    if not chosen:
        return None
    lasts = [_lasts(part.transient, onsets, within) for part, _, onsets, _ in chosen]
    after = max(int((last - onsets).max()) for last, (_, _, onsets, _) in zip(lasts, chosen, strict=True))
    before = max(_memory(model, step), 1)
    rows = [
        _rows(part.transient, onsets, last, before, after, to_ns(step))
        for last, (part, _, onsets, _) in zip(lasts, chosen, strict=True)
    ]
    times, x, u, s, valid = (np.concatenate(arrays) for arrays in zip(*rows, strict=True))
    models = {id(part.model): part.model for part, *_ in chosen}
    numbers = {key: i for i, key in enumerate(models)}
    counts = [len(onsets) for _, _, onsets, _ in chosen]
    first = chosen[0][0].transient
    assert first is not None
    names: dict[str, Any] = {"signals": first.signals}
    if first.signals is None:
        names = {
            "state_names": first.state_names,
            "control_names": first.control_names,
            "scheduling_names": first.scheduling_names,
        }
    return _Cases(
        Windows(times * 1e-9, x, u, s, before),
        times,
        valid,
        np.concatenate([rng.standard_normal((len(onsets), times.shape[1])) for _, _, onsets, rng in chosen]),
        np.repeat([unit for _, unit, _, _ in chosen], counts),
        np.repeat([numbers[id(part.model)] for part, *_ in chosen], counts),
        tuple(EnvelopeMonitor(m.replace(alarm=model.alarm)) for m in models.values() if m is not None),
        {
            "name": "cases",
            "max_gap": (int(np.diff(times, axis=1).max()) + 1) * 1e-9,
            "step": first.step or "recorded",
            **names,
        },
        step,
    )


def _onsets(transient: Transient, within: float) -> NDArray[np.intp]:
    """Samples at which a fault may begin: one before and the whole time after them in one piece."""
    t, usable = transient.t, transient.usable
    if len(t) < 3:
        return np.zeros(0, dtype=np.intp)
    start = np.arange(1, len(t) - 1)
    stop = np.searchsorted(t, t[start] + within - 1e-9) if (np.diff(t) > 0).all() else _stops(t, start, within)
    good = stop < len(t)
    start, stop = start[good], stop[good]
    bad = np.concatenate([[0], np.cumsum(~usable)])
    return np.asarray(start[bad[stop] - bad[start - 1] == 0])


def _stops(t: Array, start: NDArray[np.intp], within: float) -> NDArray[np.intp]:
    """As searchsorted, where time steps back."""
    stops = np.full(len(start), len(t), dtype=np.intp)
    for n, k in enumerate(start.tolist()):
        later = np.flatnonzero((t[k:] >= t[k] + within - 1e-9) | (np.diff(t[k:], prepend=t[k]) < 0))
        stops[n] = k + later[0] if len(later) else len(t)
    return stops


def _lasts(transient: Transient | None, onsets: NDArray[np.intp], within: float) -> NDArray[np.intp]:
    """The last sample within the time after each onset."""
    assert transient is not None
    t = transient.t
    most = len(t) if (np.diff(t) > 0).all() else 0
    if most:
        return np.asarray(np.searchsorted(t, t[onsets] + within + 1e-9, side="right") - 1)
    return np.asarray(_stops(t, onsets, within))


def _rows(
    transient: Transient | None,
    onsets: NDArray[np.intp],
    last: NDArray[np.intp],
    before: int,
    after: int,
    step: int,
) -> tuple[NDArray[np.int64], Array, Array, Array, NDArray[np.bool_]]:
    """The recording around each onset: times after it (ns), x, u, s, and where there is a sample."""
    assert transient is not None
    rows = onsets[:, None] + np.arange(-before, after + 1)
    inside = (rows >= 0) & (rows <= last[:, None])
    rows = np.clip(rows, 0, len(transient) - 1)
    inside &= transient.segment[rows] == transient.segment[onsets][:, None]
    x, u, s = transient.x[rows], transient.u[rows], transient.s[rows]
    for values in (x, u, s):
        values[~inside] = np.nan
    times = transient.t_ns[rows] - transient.t_ns[onsets][:, None]
    for w in np.flatnonzero(~inside.all(axis=1)).tolist():  # where there is no sample, time goes on evenly
        there = np.flatnonzero(inside[w])
        a, b = int(there[0]), int(there[-1])
        times[w, :a] = times[w, a] - step * np.arange(a, 0, -1)
        times[w, b + 1 :] = times[w, b] + step * np.arange(1, times.shape[1] - b)
    return times, x, u, s, inside


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
