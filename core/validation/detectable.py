# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The smallest fault that an alarm rule detects: injected into what was left out of the fit.

Recordings of a healthy machine become what they were if a sensor, an actuator or its dynamics had failed.
A sensor fault changes readings alone. Of an actuator, or of the dynamics, the machine's response is needed: the states
are changed by what the nominal (scheduled) model makes of the difference,

    x'_{k+1} = x_{k+1} + f'(x'_k, u'_k) - f(x_k, u_k),   f(x, u) = x + Δt (A x + B u + c),

with u' what the actuator really did and f' the changed dynamics; the recorded u stays as commanded. It is exact for a
linear plant that the model describes. Otherwise it is an approximation: what the nominal model leaves unexplained
stays as recorded, and no controller reacts to the fault.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import FitError
from uncertain_lti.base.progress import CountedStep
from uncertain_lti.base.text import finite_data
from uncertain_lti.model.alarm_rule import FADING, AlarmRule
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.envelope_monitor import EnvelopeMonitor
from uncertain_lti.sampling.clock import to_ns
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.signal_map import Recalled
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
TOLD = 32
"""Faults from one line of progress to the next: a round of those of eighty states takes minutes."""
GROWS = 10.0
"""Growth of a deviation within the time, by the nominal model, from which on its response to faults says nothing."""


@dataclass(frozen=True)
class Kind:
    """A kind of fault.

    `of`: what fails: `sensor` (of a state), `actuator` (a control) or `dynamics` (of a state); `unit`: of its size:
    `recorded` (that of the signal), `rate` (that per s), `share`, or `s`; `words`: what happens; `both`: whether it may
    be of either sign.
    """

    of: str
    unit: str
    words: str
    both: bool = False


KINDS: Mapping[str, Kind] = {
    "bias": Kind("sensor", "recorded", "the reading is off by the size", True),
    "drift": Kind("sensor", "rate", "the reading moves off by the size in every second", True),
    "scale": Kind("sensor", "share", "the reading is too large or too small by this share of itself", True),
    "noise": Kind("sensor", "recorded", "normal noise of this standard deviation is added to the reading"),
    "freeze": Kind("sensor", "s", "the reading holds its last value for so long"),
    "dropout": Kind("sensor", "s", "the reading is 0 for so long"),
    "spike": Kind("sensor", "recorded", "one reading is off by the size", True),
    "sensor_delay": Kind("sensor", "s", "the reading is that of so long ago"),
    "stuck": Kind("actuator", "s", "the actuator holds its place for so long"),
    "loss": Kind("actuator", "share", "the actuator does this share less than commanded"),
    "offset": Kind("actuator", "recorded", "the actuator is off by the size", True),
    "actuator_delay": Kind("actuator", "s", "the actuator does what was commanded so long ago"),
    "time_constant": Kind("dynamics", "share", "the state follows slower, or faster, by this share", True),
    "gain": Kind("dynamics", "share", "all controls move the state more, or less, by this share", True),
}
"""Kinds of fault by name."""


@dataclass(frozen=True, eq=False)
class Windows:
    """Stretches of recordings of equal length, side by side, all with the onset of a fault at the same sample.

    `t` (W, L): instants, s; `x` (W, L, n): states, recorded units; NaN where there is none; `u` (W, L, m): controls,
    recorded units; `s` (W, L, q): further scheduling signals, recorded units; `onset`: the first sample of the fault.
    """

    t: Array
    x: Array
    u: Array
    s: Array
    onset: int


def faulty(windows: Windows, kind: str, i: int, size: Array, noise: Array, model: UncertainLTI) -> tuple[Array, Array]:
    """States and controls of many recordings at once, each with a fault of its own size.

    `size` (W,): size of the fault in each; `noise` (W, L): standard normal numbers; `model`: how the machine moves, for
    faults that change that, and what its controls recall of its states; Returns (W, L, n): states, recorded units;
    Returns (W, L, m): controls, recorded units: those of `windows`, but for the memories of states.
    """
    if KINDS[kind].of == "sensor":
        x = windows.x.copy()
        x[:, windows.onset :, i] = _reading(windows, kind, windows.x[:, :, i], size, noise)
    else:
        x = _response(windows, kind, i, size, model)
    if not (of_states := _of_states(model)):
        return x, windows.u
    n = model.n
    u, moved, dt = windows.u.copy(), np.nan_to_num(x - windows.x), np.diff(windows.t, axis=1)
    for r in of_states:
        for k in range(windows.onset, x.shape[1]):
            u[:, k, r.position - n] += _recall(r, moved[:, :, r.of], k, dt)
    return x, u


def _of_states(model: UncertainLTI) -> list[Recalled]:
    """Controls that are made of earlier values of states."""
    return [r for r in model.signals.recalled if r.of < model.n <= r.position < model.n + model.m]


def _recall(recalled: Recalled, moved: Array, k: int, dt: Array) -> Array:
    """What a memory (W,) makes at sample k of differences (W, L) of what it recalls."""
    memory = recalled.memory
    past = moved[:, k - memory.samples] if k >= memory.samples else np.zeros(len(moved))
    return np.asarray(memory.taken(moved[:, k], past, dt[:, k - 1] if k else 1.0))


_CHANGES: Mapping[str, Callable[[Array, Array, Array, Array], Array]] = {
    "bias": lambda true, size, since, noise: true + size,
    "offset": lambda true, size, since, noise: true + size,
    "drift": lambda true, size, since, noise: true + size * since,
    "scale": lambda true, size, since, noise: true * (1.0 + size),
    "loss": lambda true, size, since, noise: true * (1.0 - size),
    "noise": lambda true, size, since, noise: true + size * noise,
    "spike": lambda true, size, since, noise: true + size * (np.arange(true.shape[1]) == 0),
}
"""What becomes of true values from the onset on (W, L - onset), by kinds that need none from before."""


def _reading(windows: Windows, kind: str, true: Array, size: Array, noise: Array) -> Array:
    """Readings (W, L - onset) of a sensor from the onset on; of an actuator likewise what it does."""
    t, k = windows.t, windows.onset
    after, since, size = true[:, k:], t[:, k:] - t[:, k : k + 1], size[:, None]
    if kind in _CHANGES:
        return _CHANGES[kind](after, size, since, noise[:, k:])
    if kind in ("freeze", "stuck", "dropout"):
        held = np.zeros((len(t), 1)) if kind == "dropout" else true[:, [max(k - 1, 0)]]
        return np.where((since < size) & np.isfinite(after), held, after)
    late = np.empty_like(after)  # a delay
    for w, (row, wanted) in enumerate(zip(t, t[:, k:] - size, strict=True)):
        late[w] = true[w, np.maximum(np.searchsorted(row, wanted + 1e-9, side="right") - 1, 0)]
    return late


def _response(windows: Windows, kind: str, i: int, size: Array, model: UncertainLTI) -> Array:
    """States (W, L, n) of machines whose actuator or dynamics fail."""
    point = model.operating_point
    x, u, s = point.normalise_x(windows.x), point.normalise_u(windows.u), point.normalise_s(windows.s)
    done = windows.u.copy()
    n, m, dt, of_states = model.n, model.m, np.diff(windows.t, axis=1), _of_states(model)
    if KINDS[kind].of == "actuator":
        done[:, windows.onset :, i] = _reading(windows, kind, windows.u[:, :, i], size, np.empty((0, 0)))
        for r in model.signals.recalled:
            if r.of == n + i and n <= r.position < n + m:
                moved = done[:, :, i] - windows.u[:, :, i]
                for k in range(windows.onset, done.shape[1]):
                    done[:, k, r.position - n] += _recall(r, moved, k, dt)
    done = point.normalise_u(done)
    faster = np.where(size >= 0, 1.0 / (1.0 + np.abs(size)), 1.0 + np.abs(size))  # of the time constant: slower first
    moved_by = np.zeros_like(x)  # the difference that the fault makes
    first = windows.onset
    with np.errstate(over="ignore", invalid="ignore"):
        healthy, _ = model.centre_and_half(x[:, first:-1], u[:, first:-1], dt[:, first:], s[:, first:-1])
        for k in range(first, x.shape[1] - 1):
            before, step = x[:, k] + moved_by[:, k], dt[:, k]
            for r in of_states:
                at = r.position - n
                done[:, k, at] += _recall(r, moved_by[:, :, r.of] * point.X[r.of], k, dt) / point.U[at]
            faulty, _ = model.centre_and_half(before, done[:, k], step, s[:, k])
            faulty = faulty.copy()
            if kind == "time_constant":
                faulty[:, i] = before[:, i] + faster * (faulty[:, i] - before[:, i])
            elif kind == "gain":
                idle, _ = model.centre_and_half(before, np.zeros_like(u[:, k]), step, s[:, k])
                faulty[:, i] += size * (faulty[:, i] - idle[:, i])
            difference = faulty - healthy[:, k - first]
            # nothing is known of the machine where a sample is missing: the difference stays as it was
            known = np.isfinite(difference).all(axis=1, keepdims=True)
            moved_by[:, k + 1] = np.where(known, difference, moved_by[:, k])
        return np.asarray(windows.x + moved_by * point.X)


@dataclass(frozen=True, eq=False)
class Seen:
    """The smallest detectable fault of one kind on one signal.

    `kind`: one of `KINDS`; `signal`: name of the state or control; `unit`: of the size; `size`: seen in SHARE of the
    cases; inf if the largest is not; `size_interval`: its confidence interval; `largest`: the largest size tried;
    `share`: share of the cases in which that size was seen; of the largest size if `size` is inf; `share_interval`:
    confidence interval of the share of all such cases, of which these are some; `delay`: median time from the onset to
    the alarm at that size, s; NaN if none was seen; `cases`: how many there were; `refused`: why nothing is known.
    """

    kind: str
    signal: str
    unit: str = ""
    size: float = math.inf
    size_interval: tuple[float, float] = (0.0, math.inf)
    largest: float = 0.0
    share: float = math.nan
    share_interval: tuple[float, float] = (0.0, 1.0)
    delay: float = math.nan
    cases: int = 0
    refused: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Plain data for the model file."""
        return _plain({"kind": self.kind, "of": KINDS[self.kind].of, **vars(self)})


@dataclass(frozen=True, eq=False)
class Detectable:
    """The smallest detectable faults of a model with its alarm rule.

    `within`: time within which a fault is seen, s; `confidence`: of the intervals; `cases`: onsets of each fault;
    `left_out`: cases that were left out because the alarm was raised without a fault; `faults`: by kind and signal;
    `refused`: why there is none; "" otherwise.
    """

    within: float
    confidence: float
    cases: int
    left_out: int
    faults: tuple[Seen, ...] = ()
    refused: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Plain data for the model file."""
        faults = [fault.to_dict() for fault in self.faults]
        return _plain({"within": self.within, "share": SHARE, **vars(self), "faults": faults})


@dataclass(frozen=True, eq=False)
class _Cases(Windows):
    """Onsets of faults in what was left out, side by side, and the monitors that judge them.

    `unit` (W,): what each was left out with; `owner` (W,): its monitor; `template`: what all have as a `Transient`.
    """

    t_ns: NDArray[np.int64]
    valid: NDArray[np.bool_]
    noise: Array
    unit: NDArray[np.intp]
    owner: NDArray[np.intp]
    monitors: tuple[EnvelopeMonitor, ...]
    template: dict[str, Any]
    step: float

    def take(self, which: NDArray[np.bool_]) -> _Cases:
        """Some of them."""
        of_each = ("t", "x", "u", "s", "t_ns", "valid", "noise", "unit", "owner")
        return replace(self, **{name: getattr(self, name)[which] for name in of_each})

    def delays(self, states: Sequence[tuple[Array, Array]]) -> Array:
        """Time (P, W) from the onset to the first alarm, s, with each of these x, u (W, L, n or m); inf without one."""
        found = np.full((len(states), len(self.t_ns)), np.inf)
        onset = self.onset
        since = self.t[:, onset:] - self.t[:, onset][:, None]
        for number, monitor in enumerate(self.monitors):
            rows = np.flatnonzero(self.owner == number)
            if not len(rows):
                continue
            together = max(1, MOST_TOGETHER // self.x[rows].size)
            for first in range(0, len(states), together):
                some = states[first : first + together]
                x, u = (np.concatenate([pair[part][rows] for pair in some]) for part in (0, 1))
                alarm = self._alarm(monitor, rows, x, u).reshape(len(some), len(rows), -1)[:, :, onset:]
                alarm &= self.valid[rows][:, onset:]
                delay = since[rows][np.arange(len(rows)), alarm.argmax(axis=2)]
                found[first : first + len(some), rows] = np.where(alarm.any(axis=2), delay, np.inf)
        return found

    def _alarm(self, monitor: EnvelopeMonitor, rows: NDArray[np.intp], x: Array, u: Array) -> NDArray[np.bool_]:
        """The alarm (P W L,) of one monitor over windows (P W, L), each from a cleared one."""
        copies = len(x) // len(rows)
        t_ns = np.tile(self.t_ns[rows], (copies, 1))
        apart = int(t_ns.max() - t_ns.min()) + 4 * to_ns(self.template["max_gap"])
        t_ns += apart * np.arange(len(t_ns), 0, -1)[:, None]  # each begins before the one before it: a new alarm
        s = np.tile(self.s[rows], (copies, 1, 1))
        x, u, s = (values.reshape(t_ns.size, -1) for values in (x, u, s))
        return monitor.check(Transient(t_ns.ravel(), x, u, s=s, **self.template)).alarm


def check_within(within: float | None) -> None:
    """Refuse a time in which nothing can be seen."""
    if within is not None and not (math.isfinite(within) and within > 0):
        raise FitError(f"within is {within}; give a positive number of seconds")


def typical_within(parts: Sequence[Part]) -> float:
    """Time within which a fault shall be seen, where nobody says."""
    spans = [float(p.dt.sum()) for p in parts if p.judged]
    if not spans:
        return WITHIN
    return min(max(WITHIN, WITHIN_STEPS * _median_step(parts)), OF_PART * float(np.median(spans)))


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
    remembered = {("actuator", r.position - model.n) for r in model.signals.recalled}  # earlier values are no actuators
    every_pair = ((kind, i, name) for kind in kinds for i, name in enumerate(names[KINDS[kind].of]))
    pairs = [(kind, i, name) for kind, i, name in every_pair if (KINDS[kind].of, i) not in remembered]
    steps = within / max(_median_step(parts), 1e-12) + _memory(model, _median_step(parts))
    cases = max(min(cases, int(LIMIT / (max(len(pairs), 1) * (ROUNDS + 1) * steps))), 2 * FEWEST)
    every = _cases(model, parts, within, cases, seed)
    if every is None:
        why = f"nothing that was left out lasts {within:g} s without a gap; record longer runs, or ask for less time"
        return Detectable(within, confidence, 0, 0, refused=why)
    alone = np.isinf(every.delays([(every.x, every.u)])[0])
    every, left_out = every.take(alone), int(np.count_nonzero(~alone))
    count = len(every.t_ns)
    if count < FEWEST:
        why = f"{count} cases of {within:g} s without an alarm are too few to say which faults are seen"
        return Detectable(within, confidence, count, left_out, refused=why)
    growth = 1.0
    if model.sampling.dt_median is not None:  # by how much the nominal model multiplies a deviation within the time
        steps = within / model.sampling.dt_median
        growth = math.exp(min(steps * math.log(max(model.spectral_radius(), 1e-9)), 700.0))
    runs_away = f"the nominal model runs away ({growth:.3g} times within {within:g} s), so its response says nothing"
    searches: list[_Search] = []
    found: dict[tuple[str, str], Seen] = {}
    for kind, i, name in pairs:
        if KINDS[kind].of != "sensor" and not growth <= GROWS:
            found[kind, name] = Seen(kind, name, refused=runs_away)
        elif not (largest := _largest(model, every, kind, i, within)) > 0:
            found[kind, name] = Seen(kind, name, refused=f"{name} does not move in the recordings")
        else:
            searches.append(_Search(kind, i, name, largest, every, seed))
    for number in range(ROUNDS + 2):
        going = [s for s in searches if number == 0 or s.reached.any()]
        for first in range(0, len(going), TOLD):
            if progress is not None:
                done = number * len(searches) + first
                progress(CountedStep("faults of each kind", done + 1, (ROUNDS + 2) * len(searches)))
            some = going[first : first + TOLD]
            faults = [faulty(every, s.kind, s.i, s.signs * s.sizes(number), every.noise, model) for s in some]
            for search, delay in zip(some, every.delays(faults), strict=True):
                search.learn(delay, number)
    found |= {(s.kind, s.name): s.seen(model, every.unit, confidence) for s in searches}
    return Detectable(within, confidence, count, left_out, tuple(found[kind, name] for kind, _, name in pairs))


class _Search:
    """Bisection of the size of one fault, in every case at once."""

    def __init__(self, kind: str, i: int, name: str, largest: float, cases: _Cases, seed: int) -> None:
        self.kind, self.i, self.name, self.largest = kind, i, name, largest
        total = len(cases.t_ns)
        self.signs = np.ones(total)
        if KINDS[kind].both:
            self.signs[np.random.default_rng([seed, 1]).permutation(total)[: total // 2]] = -1.0
        least = min(0.5 * cases.step, 0.5 * largest) if KINDS[kind].unit == "s" else largest * FINEST
        self._low, self._high = np.full(total, math.log(least)), np.full(total, math.log(largest))
        self._delay = np.full(total, np.inf)
        self.reached = np.zeros(total, dtype=bool)

    def _smallest(self) -> tuple[Array, float]:
        """Smallest size that was seen in each case, in order (inf where the largest was not), and in SHARE of them."""
        order = np.sort(np.where(self.reached, np.exp(self._high), np.inf))
        return order, float(order[math.ceil(SHARE * len(order) - 1e-9) - 1])

    def sizes(self, number: int) -> Array:
        """What is tried in round `number`: the largest size, bisections, and at last the size that is reported."""
        if 0 < number <= ROUNDS:
            return np.asarray(np.exp(0.5 * (self._low + self._high)))
        return np.asarray(min(self._smallest()[1], self.largest))

    def learn(self, delay: Array, number: int) -> None:
        """Take what was seen of it."""
        there = np.isfinite(delay)
        if 0 < number <= ROUNDS:
            middle = 0.5 * (self._low + self._high)
            self._high, self._low = np.where(there, middle, self._high), np.where(there, self._low, middle)
        else:
            self.reached, self._delay = there if number == 0 else self.reached, delay

    def seen(self, model: UncertainLTI, units: NDArray[np.intp], confidence: float) -> Seen:
        """The result."""
        thresholds, what = np.where(self.reached, np.exp(self._high), np.inf), KINDS[self.kind]
        (order, size), total = self._smallest(), len(thresholds)

        def interval(largest: float, share: float | None = None) -> tuple[float, tuple[float, float]]:
            return quantile_share_interval(units, thresholds <= min(largest, self.largest), confidence, share)

        reported = min(size, self.largest)
        share, (least, most) = interval(reported)
        if what.of != "sensor":  # the nominal model's response may be off
            least, most = interval(reported / OFF)[1][0], interval(reported * OFF)[1][1]
        _, levels = interval(reported, SHARE)
        low, high = (float(order[min(max(math.ceil(v * total - 1e-9), 1), total) - 1]) for v in levels)
        delay = self._delay[np.isfinite(self._delay)]
        signals = model.signals.controls if what.of == "actuator" else model.signals.states
        unit = signals[self.i].unit
        return Seen(
            self.kind, self.name,
            {"recorded": unit, "rate": f"{unit}/s" if unit else "1/s", "share": "", "s": "s"}[what.unit],
            size, (low, high if levels[1] < 1.0 else math.inf), self.largest, share, (least, most),
            float(np.median(delay)) if len(delay) else math.nan, total,
        )  # fmt: skip


def _largest(model: UncertainLTI, every: _Cases, kind: str, i: int, within: float) -> float:
    """The largest size that is tried."""
    what, domain, point = KINDS[kind], model.domain, model.operating_point
    if what.unit == "share":
        return 1.0 if kind == "loss" else LARGEST_SHARE
    if what.unit == "s":
        return within
    if what.of == "actuator":
        values, fitted = every.u[:, :, i], (domain.u_max[i] - domain.u_min[i]) * point.U[i]
    else:
        values, fitted = every.x[:, :, i], (domain.x_max[i] - domain.x_min[i]) * point.X[i]
    span = float(np.nanmax(values) - np.nanmin(values))
    span = max(float(fitted), span) if math.isfinite(fitted) else span
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


def _cases(model: UncertainLTI, parts: Sequence[Part], within: float, cases: int, seed: int) -> _Cases | None:
    """Onsets, spread over what was left out by its length; None if nothing is long enough."""
    eligible = [_onsets(p.transient, within) for p in parts]
    total, step = sum(len(places) for places, _ in eligible), _median_step(parts)
    if not total:
        return None
    chosen: list[tuple[Part, int, NDArray[np.intp], NDArray[np.intp], np.random.Generator]] = []
    for number, (part, unit, (places, lasts)) in enumerate(zip(parts, unit_numbers(parts), eligible, strict=True)):
        if len(places):
            rng = np.random.default_rng([seed, number])
            count = min(max(1, round(cases * len(places) / total)), len(places))
            edges = np.linspace(0, len(places), count + 1).astype(int)
            picks = np.unique([int(rng.integers(a, max(b, a + 1))) for a, b in zip(edges, edges[1:], strict=False)])
            chosen.append((part, int(unit), places[picks], lasts[picks], rng))
    before = _memory(model, step)
    after = max(int((lasts - onsets).max()) for _, _, onsets, lasts, _ in chosen)
    around = np.arange(-before, after + 1)
    rows = [_rows(part.transient, onsets, lasts, around, to_ns(step)) for part, _, onsets, lasts, _ in chosen]
    times, x, u, s, valid = (np.concatenate(arrays) for arrays in zip(*rows, strict=True))
    models = {id(part.model): part.model for part, *_ in chosen}
    counts, first = [len(onsets) for _, _, onsets, *_ in chosen], chosen[0][0].transient
    names = ("signals", "state_names", "control_names", "scheduling_names")
    template: dict[str, Any] = {name: getattr(first, name) for name in names}
    template |= {"name": "cases", "step": first.step or "recorded"}
    template["max_gap"] = (int(np.diff(times, axis=1).max()) + 1) * 1e-9
    return _Cases(
        times * 1e-9, x, u, s, before, times, valid,
        np.concatenate([rng.standard_normal((len(onsets), times.shape[1])) for _, _, onsets, _, rng in chosen]),
        np.repeat([unit for _, unit, *_ in chosen], counts),
        np.repeat([list(models).index(id(part.model)) for part, *_ in chosen], counts),
        tuple(EnvelopeMonitor(_alarming(m, model)) for m in models.values()), template, step,
    )  # fmt: skip


def _alarming(own: UncertainLTI, model: UncertainLTI) -> UncertainLTI:
    """A model with the alarm of another; which combinations it has seen takes long to tell, and no alarm asks."""
    residuals = model.with_residuals_of(own, instead=True).residuals
    return own.replace(alarm=model.alarm, residuals=residuals, domain=replace(own.domain, measure=None))


def _onsets(transient: Transient, within: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Samples at which a fault may begin, one before and the whole time after them in one piece, and the last then."""
    t_ns, start = transient.t_ns, np.arange(1, len(transient) - 1)
    if not len(start):
        return start, start
    steps = np.where(np.diff(transient.segment) == 0, np.diff(t_ns), 2 * to_ns(within))  # it may step back in between
    at = np.concatenate([[0], np.cumsum(steps)])
    stop = np.searchsorted(at, at[start] + to_ns(within) - 1)
    start, stop = start[stop < len(at)], stop[stop < len(at)]
    bad = np.concatenate([[0], np.cumsum(~transient.usable)])
    start = start[bad[stop] == bad[start - 1]]
    return start, np.searchsorted(at, at[start] + to_ns(within) + 1, side="right") - 1


def _rows(
    transient: Transient, onsets: NDArray[np.intp], lasts: NDArray[np.intp], around: NDArray[np.intp], step: int
) -> tuple[NDArray[np.int64], Array, Array, Array, NDArray[np.bool_]]:
    """The recording around each onset: times after it (ns), x, u, s, and where there is a sample."""
    rows = onsets[:, None] + around
    inside = (rows >= 0) & (rows <= lasts[:, None])
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


def _plain(data: Mapping[str, Any]) -> dict[str, Any]:
    """As JSON has it: null for what is not finite, and `refused` only where something is."""
    return {name: value for name, value in finite_data(data).items() if value or name != "refused"}
