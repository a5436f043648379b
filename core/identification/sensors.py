# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Faults of sensors and topics that show in the recorded values: quantised, frozen, held, stale, late."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.english import plural
from uncertain_lti.identification.excitation import quoted, successive, unexplained
from uncertain_lti.identification.passes import Moments
from uncertain_lti.identification.problem import Problem
from uncertain_lti.sampling.codes import codes, too_small
from uncertain_lti.sampling.status import TOO_OLD
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.signal_map import Signal

LONGEST_DELAY = 10
"""Delays of a control that are tried, samples."""
FROZEN = 25
"""Samples for which a value does not change while the others move, from which on it may be frozen."""
UNEVEN, JITTER, SLOW_STEP = 0.22, 1.15, 0.5
"""|log(step / median)| of an uneven step, and by how much a constant one must explain them better; see `jittering`."""
STANDS_FOR_NONE, CHANGES_SIGN, WRAPS, JITTERS = (
    "a number that stands for no value",
    "change sign together",
    "wraps around",
    "the stamps jitter",
)
"""Words by which a message is known again."""
_STRETCHES = 10  # of the samples, dealt out to the halves in turn
_QUATERNION = re.compile(r"((?:.*\.)?(?:orientation|rotation|quaternion|quat|q)(?:\.|_?))[xyzw]")
SURE_DELAY = 0.1
"""Share by which a delay leaves less unexplained, below which it must show in either half of the samples."""
STALE = 0.01
"""Share of the samples from which on stale controls are worth a word."""


def coded(problem: Problem, sums: Moments, signals: Sequence[Signal]) -> list[str]:
    """Signals in which a number means "no value"."""
    messages = []
    for j, signal in enumerate(signals):
        if too_small(float(sums.low[j]), float(sums.high[j])):
            continue
        z = problem.z[:, j]
        found = codes(z)
        for code, count in found.items():
            steady, scale = float(signal.steady), float(signal.scale)
            others = z[~np.isin(z, list(found))] * scale + steady
            messages.append(
                f"'{signal.name}' is exactly {code * scale + steady:.9g} in {count} of {problem.N} transitions and "
                f"{others.min():.4g} to {others.max():.4g} in the others: {STANDS_FOR_NONE}, or a sensor at its limit, "
                f"and the envelope is fitted to the jumps there and back; if it stands for none, write "
                f"`ignore: [{code * scale + steady:.12g}]` in the entry of '{signal.name}'"
            )
    return messages


def flipped(problem: Problem, signals: Sequence[Signal], place: Callable[[Sequence[int]], str]) -> list[str]:
    """Components of a quaternion that change sign together, and angles that wrap around."""
    n = problem.n
    states = signals[:n]
    scale, steady = np.array([float(s.scale) for s in states]), np.array([float(s.steady) for s in states])

    def recorded(those: list[int]) -> tuple[Array, Array]:
        before, after = problem.z[:, those], problem.x_next[:, those]
        return before * scale[those] + steady[those], after * scale[those] + steady[those]

    messages = []
    groups: dict[tuple[str, str], list[int]] = {}
    for i, signal in enumerate(states):
        if match := _QUATERNION.fullmatch(signal.field) or (not signal.topic and _QUATERNION.fullmatch(signal.name)):
            groups.setdefault((signal.topic, match[1]), []).append(i)
    for (topic, attitude), those in groups.items():
        one, other = recorded(those)
        if max(np.abs(one).max(), np.abs(other).max()) > 1.01:
            continue  # no unit quaternion
        sum_, difference = np.square(one + other).sum(axis=1), np.square(one - other).sum(axis=1)
        flips = np.flatnonzero((np.square(one).sum(axis=1) > 0.1) & (sum_ < 0.02 * difference))
        if len(flips):
            messages.append(
                f"{quoted([states[i].name for i in those])} {CHANGES_SIGN} in {plural(len(flips), 'step')} "
                f"({place(flips.tolist())}): q and -q are one attitude, so that jump is no movement, and the envelope "
                f"is fitted to it; use roll, pitch or yaw"
                + (f", such as 'unwrap(yaw({attitude.rstrip('.')}))' of {topic}," if topic else "")
                + " instead of components"
            )
    longest = np.zeros(n)
    for block in problem.blocks():
        longest = np.maximum(longest, np.abs(block.x_next - block.z[:n]).max(axis=1) * scale)
    for i, signal in enumerate(states):
        if longest[i] < 0.8 * 2 * np.pi:  # no step is near a turn
            continue
        before, after = (columns[:, 0] for columns in recorded([i]))
        for turn in (2 * np.pi, 360.0):
            step = np.abs(after - before)
            wraps = np.flatnonzero(np.abs(step - turn) < 0.1 * turn)
            inside = np.abs(before).max() < 0.51 * turn or (before.min() >= 0 and before.max() < turn)
            rest = np.delete(step, wraps)
            if 0 < len(wraps) < 0.05 * problem.N and inside and len(rest) and rest.max() < 0.3 * turn:
                messages.append(
                    f"'{signal.name}' {WRAPS} in {plural(len(wraps), 'step')} ({place(wraps.tolist())}), by "
                    f"{turn:.4g}: that jump is no movement, and the envelope is fitted to it; use "
                    f"'unwrap({signal.field or signal.name})'"
                )
    return messages


def jittering(problem: Problem, signals: Sequence[Signal], speed: float, clock: str | None) -> list[str]:
    """Stamps that are unevenly spaced where the samples are not.

    Over the uneven steps, what a constant step explains is compared with what the stated one does. Of samples that are
    really uneven the stated one explains more.
    """
    dt = problem.dt
    usual = float(np.median(dt))
    uneven = np.abs(np.log(dt / usual)) > UNEVEN
    if uneven.sum() < max(20, 0.01 * problem.N) or not speed < SLOW_STEP:
        return []
    step = problem.x_next - problem.z[:, : problem.n]
    moving = np.ptp(problem.z[:, : problem.n], axis=0) > 0
    left = []
    for length in (dt, np.full(len(dt), usual)):
        basis = np.column_stack([problem.z, np.ones(problem.N)]) * length[:, None]
        gram, cross = basis.T @ basis, basis.T @ step
        rest = step - basis @ (np.linalg.pinv(gram, hermitian=True) @ cross)
        left.append(np.sqrt(np.mean(rest[uneven] ** 2, axis=0)))
    ratio = (left[0] / np.maximum(left[1], 1e-300))[moving]
    if not len(ratio) or ratio.max() < JITTER or ratio.min() < 1 / 1.05:
        return []
    most = int(np.flatnonzero(moving)[np.argmax(ratio)])
    return [
        f"{JITTERS}: steps range from {dt.min() * 1e3:.3g} to {dt.max() * 1e3:.3g} ms around {usual * 1e3:.3g} ms, and "
        f"a constant step leaves {1 - 1 / ratio.max():.0%} less of '{signals[most].name}' unexplained over the "
        f"{int(uneven.sum())} uneven ones (root mean square), so the samples are more even than their stamps: "
        f"write `step: constant` in the signals file, or have them stamped at the sensor"
        + (f", or try the other time of {clock} (header or log) under `topics`" if clock else "")
    ]


def quantised(problem: Problem, signals: Sequence[Signal]) -> list[str]:
    """States recorded in steps that are not small against what they move by from sample to sample."""
    messages = []
    for i, signal in enumerate(signals[: problem.n]):
        x = problem.z[:, i]
        span = float(np.ptp(x))
        if span == 0:
            continue
        levels = np.unique(np.round(x / span, 9))
        if len(levels) < 3 or len(levels) > max(problem.N // 5, 3):
            continue
        gaps = np.diff(levels)
        step = float(gaps.min())
        # levels lie on a grid: as of a rounding sensor, and of nothing else with this many samples
        if step < 1e-6 or np.abs(gaps / step - np.rint(gaps / step)).max() > 0.02:
            continue
        move = float(np.sqrt(np.mean((problem.x_next[:, i] - x) ** 2))) / span
        if step > 0.5 * move:
            size = step * span * float(signal.scale)
            messages.append(
                f"'{signal.name}' is recorded in steps of {size:.3g}{' ' + signal.unit if signal.unit else ''}, "
                f"{step / move:.2g} times what it moves by from sample to sample (root mean square): no envelope is "
                f"narrower than such a step; use {'' if problem.columns.noise else 'the noise term, '}a finer field, "
                f"or fewer samples per second"
            )
    return messages


def held(problem: Problem, signals: Sequence[Signal]) -> list[str]:
    """States that repeat their last value between samples of a slower topic."""
    messages = []
    follows = successive(problem)
    for i, signal in enumerate(signals[: problem.n]):
        changed = problem.x_next[:, i] != problem.z[:, i]
        instants = np.flatnonzero(changed)
        if len(instants) < 10 or len(instants) > 0.7 * problem.N or len(follows) < 0.5 * problem.N:
            continue
        fresh = np.unique(problem.x_next[instants, i])
        period = float(np.median(np.diff(instants)))
        # a rounding sensor repeats few values; a machine at rest is constant in few, long stretches
        if period >= 2 and len(fresh) > 0.5 * len(instants):
            messages.append(
                f"'{signal.name}' repeats its last value in {1 - len(instants) / problem.N:.0%} of the steps and is "
                f"new about every {period:.0f} samples: its topic or its sensor is slower than the clock, and its row "
                f"is fitted to jumps; make its topic the clock, or leave it out"
            )
    return messages


def frozen(problem: Problem, signals: Sequence[Signal], transients: Sequence[Transient]) -> list[str]:
    """States that keep exactly one value for long while the other signals move."""
    messages = []
    spread = np.ptp(problem.z_columns, axis=1)
    for i, signal in enumerate(signals[: problem.n]):
        still = problem.x_next[:, i] == problem.z[:, i]
        if still.all() or still.mean() > 0.5:  # held, quantised, or at rest most of the time: reported elsewhere
            continue
        joined = np.concatenate([[False], still, [False]])
        joined[1:-1][1:] &= np.concatenate([[True], (problem.source[1:] == problem.source[:-1])])[1:]
        edges = np.flatnonzero(np.diff(joined.astype(np.int8)))
        runs = edges.reshape(-1, 2)
        runs = runs[runs[:, 1] - runs[:, 0] >= FROZEN]
        others = [j for j in range(problem.p) if j != i]
        for start, stop in runs:
            moving = np.ptp(problem.z[start:stop], axis=0) > 0.2 * spread
            if not any(moving[j] and spread[j] > 0 for j in others):
                continue
            mover = signals[next(j for j in others if moving[j])].name
            where, k = int(problem.source[start]), int(problem.k[start])
            place = (
                f"{transients[where].name} from {transients[where].t[k]:.6g} s"
                if where < len(transients)
                else f"recording {where + 1} from sample {k}"
            )
            messages.append(
                f"'{signal.name}' stands at exactly one value for {stop - start} samples in {place} while '{mover}' "
                f"moves: a frozen sensor? Leave that stretch out, or the envelope will take it for healthy"
            )
            break
    return messages


def stale(signals: Sequence[Signal], n: int, problem: Problem, transients: Sequence[Transient]) -> list[str]:
    """Controls that were too old for many samples, or that ended long before the recording did."""
    messages = []
    samples = sum(len(t) for t in transients)
    old: dict[tuple[int, float | None], list[str]] = {}
    for signal in signals[n:]:
        count = sum(t.counters.of(TOO_OLD).get(signal.name, 0) for t in transients)
        if samples and count > STALE * samples:
            old.setdefault((count, signal.max_hold), []).append(signal.name)
    for (count, hold), names in old.items():
        messages.append(
            f"{quoted(names)} {'were' if len(names) > 1 else 'was'} older than max_hold ({hold} s) in {count} of "
            f"{samples} samples, which are not used: record commands for as long as the states, or raise max_hold if "
            f"the machine holds the last command"
        )
    for topic in dict.fromkeys(s.topic for s in signals[n:] if s.max_hold is None):
        columns = [j for j, s in enumerate(signals) if j >= n and s.topic == topic]
        for source in range(int(problem.source[-1]) + 1):
            u = problem.z[problem.source == source][:, columns]
            changes = np.flatnonzero(np.diff(u, axis=0).any(axis=1)) + 1
            if len(changes) < 20:
                continue
            tail = len(u) - int(changes[-1])
            if tail > 0.2 * len(u) and tail > 5 * float(np.diff(changes).max()):
                name = transients[source].name if source < len(transients) else f"recording {source + 1}"
                messages.append(
                    f"{quoted([signals[j].name for j in columns])} {'change' if len(columns) > 1 else 'changes'} all "
                    f"the time and then not at all for the last {tail} samples of {name}: commands that have ended are "
                    f"no constant input; give a max_hold, or cut the recording"
                )
                break
    return messages


def delayed(problem: Problem, signals: Sequence[Signal], past: Collection[int] = ()) -> list[str]:
    """Controls that explain the states better when taken some samples earlier."""
    messages = []
    for j, (best, share) in late_controls(problem, past).items():
        said = signals[problem.n + j].delay + best
        messages.append(
            f"the states follow control '{signals[problem.n + j].name}' better when it is taken "
            f"{plural(best, 'sample')} earlier "
            f"(the unexplained part of a step falls by {share:.0%}): try `delay: {said}` for it in the signals file"
        )
    return messages


def late_controls(problem: Problem, past: Collection[int] = ()) -> dict[int, tuple[int, float]]:
    """Controls that explain the states clearly better when taken some samples earlier."""
    n, p = problem.n, problem.p
    follows = successive(problem)
    joined = np.zeros(problem.N, dtype=bool)
    joined[follows + 1] = True
    breaks = np.flatnonzero(~joined)
    # samples before this one in the same unbroken stretch
    run = np.arange(problem.N) - breaks[np.searchsorted(breaks, np.arange(problem.N), side="right") - 1]
    usable = np.flatnonzero(run >= LONGEST_DELAY)
    if len(usable) < 20 * p:
        return {}
    lagged = np.stack([problem.z_columns[n:, usable - lag] for lag in range(LONGEST_DELAY + 1)])
    now = problem.z_columns[:n, usable]
    found = lags(now, lagged, problem.next_columns[:, usable] - now, problem.dt[usable])
    return {j: late for j, late in found.items() if n + j not in past}


def lags(x: Array, u: Array, increment: Array, dt: Array) -> dict[int, tuple[int, float]]:
    """Controls that explain the states clearly better some samples earlier.

    `x` (n, N): states; `u` (lags + 1, m, N): controls this many samples before; `increment` (n, N): what the states
    change by in a step; `dt` (N,): step, s.
    """
    found = _lags(x, u, increment, dt)
    if any(share < SURE_DELAY for _, share in found.values()):
        half = np.arange(x.shape[1]) * _STRETCHES // x.shape[1] % 2 == 0
        halves = [_lags(x[:, part], u[:, :, part], increment[:, part], dt[part]) for part in (half, ~half)]
        for j, (lag, share) in [*found.items()]:
            if share < SURE_DELAY and not all(j in other and abs(other[j][0] - lag) <= 1 for other in halves):
                del found[j]
    return found


def _lags(x: Array, u: Array, increment: Array, dt: Array) -> dict[int, tuple[int, float]]:
    n, N = x.shape
    longest, m = len(u) - 1, u.shape[1]
    movers = [j for j in range(m) if np.ptp(u[0, j]) > 0]
    late = [u[lag, j] for j in movers for lag in range(1, longest + 1)]
    regressors = np.empty((n + m + 1 + len(late), N))  # all at once: one product of all with all
    for row, values in zip(regressors, [*x, *u[0], np.ones(N), *late], strict=True):
        np.multiply(values, dt, out=row)
    gram, cross = regressors @ regressors.T, regressors @ increment.T
    total = np.einsum("nk,nk->n", increment, increment)

    def score(chosen: list[list[int]]) -> Array:
        which = np.array(chosen)
        left = unexplained(gram[which[:, :, None], which[:, None, :]], cross[which], total)
        return np.asarray(np.log(np.maximum(left, 1e-300)).sum(axis=-1))

    found = {}
    undelayed = [*range(n + m), n + m]
    for position, j in enumerate(movers):
        first = n + m + 1 + position * longest
        later = [[first + lag if c == n + j else c for c in undelayed] for lag in range(longest)]
        scores = score([undelayed, *later])
        best = int(np.argmin(scores))
        gain = float(scores[0] - scores[best])
        # 5 % less unexplained, and far more than chance: N log-likelihood units per row
        if not (0 < best < longest and gain > 0.05 and gain * N > 50):  # at the end of what is tried it is no optimum
            continue
        # next to a late control the present one adds nothing; if it does, the late one represents past states
        if scores[best] - score([[*undelayed, first + best - 1]])[0] < 0.3 * gain:
            found[j] = (best, float(1 - np.exp(-gain / n / 2)))
    return found
