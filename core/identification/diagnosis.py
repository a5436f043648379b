# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What the data and the fit mean for the user, in words: a finding, its numbers and the remedy."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from itertools import repeat
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array, runs
from uncertain_lti.base.text import moment, plural, quoted, shortlist
from uncertain_lti.identification import evidence, regimes
from uncertain_lti.identification.discard import MUCH, Carriers
from uncertain_lti.identification.evidence import Effects
from uncertain_lti.identification.fleet import Fleet
from uncertain_lti.identification.passes import Moments
from uncertain_lti.identification.problem import Problem, row_of
from uncertain_lti.identification.structure import EVERY, Rows, own_of, rows_of
from uncertain_lti.model.operating_point import recorded
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.sampling.clock import longest_pause
from uncertain_lti.sampling.steady_state import codes, too_small
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.field_path import Memory
from uncertain_lti.signals.signal_map import ARRIVAL, Signal

LOOKED_AT, STRETCHES = 20_000, 20
"""Transitions, and stretches, that are examined at most for what shows in any of them."""
FAST = 0.7  # |eigenvalue| x dt above which a step of forward Euler is long for the mode
WIDE = 0.5  # mean width, as a share of the state's own range, above which few faults can show
COLLINEAR = 1e-3  # smallest eigenvalue of the regressors' correlation below which signals move nearly together
MOST_GROUPS, MOST_TIED = 3, 5
"""Combinations of signals, and blocks with elements of another, that are named."""
FED_BACK = 0.9  # share of a control's changes explained by the states, from which on that is reported
FROZEN = 25  # samples for which a value does not change while the others move, from which on it may be frozen
UNEVEN, JITTER, SLOW_STEP = 0.22, 1.15, 0.5
"""|log(step / median)| of an uneven step, and by how much a constant one must explain them better; see `jittering`."""

CONSTANT = "never moved in what was fitted"  # nothing is to be mended for the operation that was recorded
HARMLESS = (CONSTANT, "dc is 0", "keeps the steady state", "keeps them there")  # the others on what was chosen
_CODE, _NOISE = "a number that stands for no value", "like noise from sample to sample"
_BEFORE, _FEW = "one sample earlier explains", "as wide as the rest needs"
_QUATERNION = re.compile(r"((?:.*\.)?(?:orientation|rotation|quaternion|quat|q)(?:\.|_?))[xyzw]")
_REMEDIES = (  # words of a message on the state, or on any signal; what narrows the bounds
    (_FEW, True, "look at the few samples that carry the width, named above"),
    (_BEFORE, True, "add the value of '{}' one sample earlier, as said above"),
    ("`delay:", False, "set the delay that the notes propose"),
    ("come in bursts", False, "write `step: constant` and `max_gap`, as said above"),
    ("sampling is slow", False, "sample faster"),
    ("moves too little", False, "record the controls moving more"),
    ("not identifiable", False, "record the controls moving more"),
)


def _rank(problem: Fleet | Problem, sums: Moments, names: Sequence[str], rows: Rows) -> tuple[int, list[str]]:
    """Rank of the nominal regressors and, in words, which columns make it deficient."""
    names = [*names, "the disturbance c"] if problem.columns.drift else list(names)
    dead = sums.phi_scale == 0
    still = np.pad(sums.high == sums.low, (0, len(dead) - problem.p))
    messages = []
    if constant := [names[j] for j in np.flatnonzero(still[: problem.n])]:
        messages.append(
            f"rank deficient: {quoted(constant)} never moved, so what follows from it is not identifiable; record the "
            f"machine moving it, or leave it out"
        )
    free = np.flatnonzero(~dead)
    limit = 1e-12 * len(free)
    for columns, value, vector, _ in _axes(sums, np.flatnonzero(~dead & ~still), rows):
        if value <= limit:
            part = [names[columns[j]] for j in np.flatnonzero(np.abs(vector) > 0.05)]
            messages.append(
                f"rank deficient: {quoted(part)} move together in every transition, so their columns cannot be told "
                f"apart and share the effect; record them moving independently, or leave one out"
            )
    return sum(value > limit for _, value, *_ in _axes(sums, free)), list(dict.fromkeys(messages))


def _axes(sums: Moments, of: NDArray[np.intp], rows: Rows = EVERY) -> Iterator[tuple[list[int], float, Array, Array]]:
    """Eigenvalues, eigenvectors and correlation of some regressors, of those that come together in a row each."""
    for row, _ in rows:
        own = own_of(of, row)
        unit = 1.0 / sums.phi_scale[own]
        values, vectors = np.linalg.eigh(C := sums.centre[np.ix_(own, own)] * np.outer(unit, unit) / sums.count)
        yield from zip(repeat(own.tolist()), values.tolist(), vectors.T, repeat(C), strict=False)


def describe(
    model: UncertainLTI,
    problem: Problem,
    sums: Moments,
    mean_width: Array,
    transients: Sequence[Transient],
    few: Carriers | None,
    discarded: int | None,
) -> tuple[int, list[str]]:
    """Rank, and messages to the user on a fitted model and the recordings it was fitted to.

    `mean_width` (n,): normalised, per step.
    """
    signals = (*model.signals.states, *model.signals.controls)
    names = [s.name for s in signals]
    scheduled, problem = problem, replace(problem, columns=replace(problem.columns, regimes=None))
    regimes_said = _tied(model, scheduled, sums) + _beyond_knots(model, scheduled)
    sums = sums.one_block()
    rank, messages = _rank(problem, sums, names, rows := rows_of(model))
    part, past = _stretches(problem), evidence.lagged_states(signals, model.n)
    if far := evidence.far_from_steady(part, signals):  # every level moves with every other then
        messages = [text for text in messages if "move together" not in text]
    apart = not (messages or far)
    coded = [*_coded(problem, sums, signals), *_wrapped(problem, signals, transients)]
    messages = [*coded, *_bursting(model, transients), *messages, *regimes_said]
    if not coded:  # the envelope is fitted to the jumps, and what follows would be about them
        messages += _carried(few, discarded, problem, names, transients)
        alike = _collinear(problem, sums, names, past, rows)
        noisy, late, held = _noise_like(part), _delayed(part, signals, past, rows), _held(part, signals)
        messages += [*alike, *late, *held, *jittering(model, part, names), *_frozen(part, names, transients)]
        lacking = {} if late else _missing(part, signals)
        lacking = {i: m for i, m in lacking.items() if not any(i in of for of in held.values())}
        messages += lacking.values()
        messages += far or _weak(evidence.lost(problem, sums, past, rows), model.n, signals, lacking)
        messages += _fed_back(part, names, past, rows)
        messages += _noisy({i: share for i, share in noisy.items() if i not in lacking}, names, part.dt)
        if apart and not alike and not noisy and not past:  # of the others the eigenvalues mean nothing
            messages += _slow(model) + _unstable(model)
    messages += _wide(sums, mean_width, names, not problem.columns.names)
    if problem.columns.names == {"c", "v"}:
        messages.append("Δt is constant, so dc and v cannot be told apart: v takes the width and dc is 0")
    return rank, messages


def of_sums(model: UncertainLTI, fleet: Fleet | Problem, sums: Moments, mean_width: Array) -> tuple[int, list[str]]:
    """`describe` of what sums alone show, where the transitions are not at hand together."""
    signals = (*model.signals.states, *model.signals.controls)
    names, tied, sums = [s.name for s in signals], _tied(model, fleet, sums), sums.one_block()
    rank, messages = _rank(fleet, sums, names, rows := rows_of(model))
    messages += [*tied, *_collinear(fleet, sums, names, evidence.lagged_states(signals, model.n), rows)]
    return rank, messages + _wide(sums, mean_width, names, not fleet.columns.names)


def _tied(model: UncertainLTI, problem: Fleet | Problem, sums: Moments) -> list[str]:
    """Blocks that share the elements of another."""
    columns = problem.columns
    if columns.regimes is None:
        return []
    messages = []
    reasons = regimes.lacking(sums.centre, sums.visits, columns, problem.p)
    for r, (reason, data) in enumerate(zip(reasons, model.block_data, strict=True)):
        if data.tied_to is not None:
            if not sums.visits[r]:
                reason = "no transition is nearest to it, so there is no bound to trust there"
            messages.append(
                f"the block at {model.block_name(r)} has too little data for elements of its own ({reason}) and shares "
                f"those at {model.block_name(data.tied_to)}: record the machine there, or give fewer knots"
            )
    if (more := len(messages) - MOST_TIED) > 1:
        messages[MOST_TIED:] = [
            f"{more} more blocks have too little data and share the elements of others; the table of regimes, of "
            f"`uncertain-lti info` as well, says which"
        ]
    return messages


def _beyond_knots(model: UncertainLTI, problem: Problem) -> list[str]:
    """Scheduling signals that go farther in the recordings than their end knots."""
    if model.schedule is None:
        return []
    messages = []
    knots = model.schedule.recorded_values(model.signals.signals)
    for axis, at, row in zip(model.schedule.axes, knots, model.scheduling_positions, strict=True):
        values = row_of(problem.z, problem.s, row)
        beyond = (values < axis.knots[0]) | (values > axis.knots[-1]) if axis.knots else np.zeros(1, dtype=bool)
        if beyond.any():
            signal = model.signals.signals[row]
            low, high = (recorded(v, float(signal.steady), float(signal.scale)) for v in (values.min(), values.max()))
            messages.append(
                f"{axis.signal} goes from {low:.5g} to {high:.5g}{f' {signal.unit}' if signal.unit else ''} in the "
                f"recordings, and {beyond.mean():.2%} of the transitions are beyond its knots, {at[0]:.5g} to "
                f"{at[-1]:.5g}: every verdict there is on an unknown regime; give end knots that enclose them all"
            )
    return messages


def _collinear(
    problem: Fleet | Problem, sums: Moments, names: Sequence[str], past: Collection[int], rows: Rows
) -> list[str]:
    """Signals that nearly move together, and the recording that would separate them."""
    away = np.maximum(sums.low, -sums.high) > sums.high - sums.low  # a level, which says nothing on how it moves
    free = np.flatnonzero((sums.phi_scale[: problem.p] > 0) & ~away & ~np.isin(range(problem.p), list(past)))
    found: dict[str, str] = {}  # several combinations may be of the same signals
    for columns, value, vector, C in sorted(_axes(sums, free, rows), key=itemgetter(1)):
        most, count = np.argsort(-np.abs(vector)), np.count_nonzero(np.abs(vector) > 0.3 * np.abs(vector).max())
        if not 1e-12 * problem.p < value < COLLINEAR or count < 2:
            continue
        for size in range(count, len(most) + 1):  # of two combinations mixed, fewer columns do not move together
            part = sorted(columns[j] for j in most[:size])
            least = max(value, np.linalg.eigvalsh(C[np.ix_(most[:size], most[:size])])[0])
            if least < COLLINEAR or len(found) > MOST_GROUPS:
                break
        states, controls = [names[j] for j in part if j < problem.n], [names[j] for j in part if j >= problem.n]
        if not states:
            still = "rests" if len(controls) == 2 else "rest"
            cure = f"record {quoted(controls[:1])} moving while {quoted(controls[1:])} {still}"
        elif controls:
            cure = f"record steps of {quoted(controls)} that are sharper than {quoted(states)} can follow"
        else:
            cure = "excite them by other controls or initial states, unless the machine ties them; the bounds hold"
        those = quoted([names[j] for j in part])
        why = f"(all but {least**0.5:.2%} of their size), so their columns are poorly told apart and their elements may"
        found.setdefault(those, f"{those} nearly move together {why} trade places: {cure}")
    messages = [*found.values()]
    if (groups := len(messages)) > MOST_GROUPS:
        messages[1:] = [
            f"{groups} combinations of signals nearly move together, of which the nearest is named above: few of "
            f"{len(free)} signals can be told apart; use fewer, or more controls of their own"
        ]
    return messages


def _weak(every: Effects, n: int, signals: Sequence[Signal], lacking: Collection[int]) -> list[str]:
    """Controls whose effect is lost in the noise, unless another sample of the same field has it."""
    names, of = [s.name for s in signals], [(s.topic, s.inner) for s in signals]
    seen = {of[j] for j in range(n, len(of)) if j not in every}
    found = {j: effect for j, effect in every.items() if effect[0] not in lacking and of[j] not in seen}
    state, certainty = max(found.values(), key=itemgetter(1), default=(0, 0.0))
    larger = max(2.0, evidence.DETERMINED / max(0.4, min((least for _, least in found.values()), default=1.0)))
    return [
        f"{_controls(found, names)} moves too little to be distinguished from the noise: the strongest effect, on "
        f"'{names[state]}', is {certainty:.2g} times its standard error; record it with larger or more steps "
        f"({larger:.2g} times the amplitude), or leave it out"
    ] * bool(found)


def _controls(found: Collection[int], names: Sequence[str]) -> str:
    """One control, or each of several."""
    named = shortlist([f"'{names[j]}'" for j in sorted(found)], 12)
    return ("each of the controls " if len(found) > 1 else "control ") + named


def _fed_back(problem: Problem, names: Sequence[str], past: Collection[int], rows: Rows) -> list[str]:
    """Controls whose changes follow from the states: closed-loop recordings, or inputs too regular to separate.

    u_k - u_{k-1} is explained by x_k, x_{k-1} and u_{k-1} if a feedback sets u_k; an input that a person steps
    at will is not. What a column of the arrival has of u_k, at the end of the step before, is no explanation.
    """
    follows = evidence.successive(problem)
    if len(follows) <= 4 * problem.p:
        return []
    before, now = problem.z.T[follows], problem.z.T[follows + 1]
    n, found, later = problem.n, dict[int, float](), [j for j, name in enumerate(names) if name.endswith(ARRIVAL)]
    for own in (own_of(np.arange(problem.p), row) for row, _ in rows):
        basis = np.column_stack([now[:, own[own < n]], before[:, np.setdiff1d(own, later)], np.ones(len(before))])
        mine = [j for j in own[own >= n].tolist() if j not in past and j not in later]
        change = now[:, mine] - before[:, mine]
        change -= change.mean(axis=0)
        often = np.count_nonzero(np.diff(change, axis=0), axis=0) >= 0.05 * len(change)
        size = (change**2).sum(axis=0)
        explained = 1.0 - evidence.unexplained(basis.T @ basis, basis.T @ change, size)[0] / np.maximum(size, 1e-300)
        follow = (explained > FED_BACK) & often & (size > 1e-18 * (now[:, mine] ** 2).sum(axis=0))
        found |= {j: share for j, share, so in zip(mine, explained.tolist(), follow, strict=True) if so}
    least = min(found.values(), default=0.0)
    return [
        f"the changes of {_controls(found, names)} follow from the states to {least:.0%}: a feedback sets it, so the "
        f"nominal matrices may mix it with the plant (the bounds hold for it alone); record it with steps of its own"
    ] * bool(found)


def _coded(problem: Problem, sums: Moments, signals: Sequence[Signal]) -> list[str]:
    """Signals in which a number means "no value"."""
    messages = []
    for j, signal in enumerate(signals):
        z, steady, scale = problem.z[j], float(signal.steady), float(signal.scale)
        if too_small(float(sums.low[j]), float(sums.high[j])) or not (found := codes(z)):
            continue
        others = z[~np.isin(z, list(found))] * scale + steady
        messages += [
            f"'{signal.name}' is exactly {code * scale + steady:.9g} in {count} of {problem.N} transitions and "
            f"{others.min():.4g} to {others.max():.4g} in the others: {_CODE}, or a limit of the sensor, and bounds "
            f"are fitted to the jumps; if it stands for none, add `ignore: [{code * scale + steady:.12g}]` to its entry"
            for code, count in found.items()
        ]
    return messages


def _wrapped(problem: Problem, signals: Sequence[Signal], transients: Sequence[Transient]) -> list[str]:
    """Components of a quaternion that change sign together, and angles that wrap around."""
    states, messages, groups = signals[: problem.n], list[str](), dict[str, list[int]]()
    scale, steady = (np.array([float(getattr(s, name)) for s in states]) for name in ("scale", "steady"))
    near_a_turn = problem.largest_moves() * scale > 0.8 * 2 * np.pi

    def ends(those: list[int]) -> tuple[Array, Array]:
        columns = problem.z.T[:, those], problem.x_next.T[:, those]
        return columns[0] * scale[those] + steady[those], columns[1] * scale[those] + steady[those]

    for i, signal in enumerate(states):
        if match := _QUATERNION.fullmatch(signal.field) or (not signal.topic and _QUATERNION.fullmatch(signal.name)):
            groups.setdefault(signal.topic + match[1], []).append(i)
        if not near_a_turn[i]:
            continue
        before, after = (values[:, 0] for values in ends([i]))
        step = np.abs(after - before)
        for turn, unit in ((2 * np.pi, ""), (360.0, ", 360")):
            jumps = np.abs(step - turn) < 0.1 * turn
            inside = np.abs(before).max() < 0.51 * turn or (before.min() >= 0 and before.max() < turn)
            if inside and 0 < jumps.sum() < 0.05 * problem.N and step[~jumps].max() < 0.3 * turn:
                messages.append(
                    f"'{signal.name}' wraps around in {plural(int(jumps.sum()), 'step')} "
                    f"({_where(problem, np.flatnonzero(jumps).tolist(), transients)}), by {turn:.4g}: that jump is no "
                    f"movement, and the envelope is fitted to it; use 'unwrap({signal.field or signal.name}{unit})'"
                )
    for those in groups.values():
        one, other = ends(those)
        total, apart = np.square(one + other).sum(axis=1), np.square(one - other).sum(axis=1)
        flips = np.flatnonzero((np.square(one).sum(axis=1) > 0.1) & (total < 0.02 * apart))
        if len(flips) and max(np.abs(one).max(), np.abs(other).max()) < 1.01:  # of a unit quaternion
            messages.append(
                f"{quoted([states[i].name for i in those])} change sign together in {plural(len(flips), 'step')} "
                f"({_where(problem, flips.tolist(), transients)}): q and -q are one attitude, so that jump is no "
                f"movement, and the envelope is fitted to it; use roll, pitch or yaw instead, unwrap(yaw(...))"
            )
    return messages


def _bursting(model: UncertainLTI, transients: Sequence[Transient]) -> list[str]:
    """Messages that come in bursts, whose arrival says nothing of when they were sampled."""
    if model.signals.step != "recorded" or not (pause := longest_pause([t.t_ns for t in transients])):
        return []
    return [
        f"the messages of {model.signals.clock} come in bursts, though their samples are even, so most steps are too "
        f"short and the rest are gaps: write `step: constant` and `max_gap: {pause:g}` in the signals file"
    ]


def uneven_steps(dt: Array) -> NDArray[np.bool_]:
    """Which steps (K,), s, are far from the usual one; none of them where only a few are."""
    uneven = np.abs(np.log(dt / np.median(dt))) > UNEVEN
    return np.asarray(uneven & (uneven.sum() >= max(20, 0.01 * len(dt))))


def jittering(model: UncertainLTI, problem: Problem, names: Sequence[str]) -> list[str]:
    """Stamps that are unevenly spaced where the samples are not.

    Over the uneven steps, what a constant step explains is compared with what the stated one does. Of samples that are
    really uneven the stated one explains more.
    """
    dt, x = problem.dt, problem.z.T[:, : problem.n]
    usual = float(np.median(dt))
    uneven = uneven_steps(dt)
    speed = max((abs(v) for block in model.blocks for v in block.eigenvalues()), default=0.0) * usual
    moving = np.flatnonzero(np.ptp(x, axis=0) > 0)
    if not uneven.any() or not speed < SLOW_STEP or not len(moving):
        return []
    left = []
    for length in (dt, np.full(len(dt), usual)):
        basis = np.column_stack([problem.z.T, np.ones(problem.N)]) * length[:, None]
        rest = problem.x_next.T - x
        rest = rest - basis @ (np.linalg.pinv(basis.T @ basis, hermitian=True) @ (basis.T @ rest))
        left.append(np.sqrt(np.mean(rest[uneven] ** 2, axis=0)))
    ratio = (left[0] / np.maximum(left[1], 1e-300))[moving]
    if ratio.max() < JITTER or ratio.min() < 1 / 1.05:
        return []
    clock = model.signals.clock or ""
    return [
        f"the stamps jitter: steps range from {dt.min() * 1e3:.3g} to {dt.max() * 1e3:.3g} ms around "
        f"{usual * 1e3:.3g} ms, and a constant step leaves {1 - 1 / ratio.max():.0%} less of "
        f"'{names[moving[np.argmax(ratio)]]}' unexplained over the {int(uneven.sum())} uneven ones: "
        f"write `step: constant` in the signals file, or have them stamped at the sensor"
        + (f", or try the other time of {clock} (header or log) under `topics`" if clock else "")
    ]


def _held(problem: Problem, signals: Sequence[Signal]) -> dict[str, list[int]]:
    """States that repeat their last value between samples of a slower topic, those of one remedy together."""
    found, alone = dict[str, list[int]](), len({signal.topic for signal in signals}) == 1
    slow = f"{'' if alone else 'make its topic the clock, '}list it as a control, or leave it out"
    every = range(problem.n if len(evidence.successive(problem)) >= 0.5 * problem.N else 0)
    rows = {i: held for i in every if (held := evidence.held_for(problem.z[i], problem.x_next[i]))}
    for judged, remedy in ((False, slow), (True, "take `judged: true` away")):
        if of := [i for i in rows if signals[i].judged == judged]:
            about = " to ".join(map(str, sorted({min(rows[i] for i in of), max(rows[i] for i in of)})))
            share = min(np.mean(problem.z[i] == problem.x_next[i]) for i in of)
            found[
                f"{'each of ' * (len(of) > 1)}{quoted([signals[i].name for i in of])} repeats its last value in "
                f"{'at least ' * (len(of) > 1)}{share:.0%} of the steps and is new about every {about} samples: its "
                f"topic or its sensor is slower than the clock, and its row is fitted to jumps; {remedy}"
            ] = of
    return found


def _frozen(problem: Problem, names: Sequence[str], transients: Sequence[Transient]) -> list[str]:
    """States that keep exactly one value for long while the other signals move; at an end of its range one may rest."""
    found = list[tuple[int, str, str]]()
    low, high = problem.z.min(axis=1), problem.z.max(axis=1)
    spread = high - low
    noise = np.array([np.square(np.diff(z, prepend=z[0])).mean() > z.var() for z in problem.z])  # moves at any time
    for i in range(problem.n):
        still = problem.x_next[i] == problem.z[i]
        if still.mean() > 0.5:  # held, quantised, or at rest most of the time
            continue
        still[1:] &= (problem.source[1:] == problem.source[:-1]) & (problem.z[i, 1:] == problem.x_next[i, :-1])
        for start, stop in (run for run in runs(still) if run[1] - run[0] >= FROZEN):
            others = (spread > 0) & ~noise & (np.arange(problem.p) != i)
            moving = others & (np.ptp(problem.z.T[start:stop], axis=0) > 0.2 * spread)
            if moving.any() and low[i] < problem.z[i, start] < high[i]:
                where, other = _where(problem, [start], transients), names[int(np.argmax(moving))]
                found.append((stop - start, names[i], f"({where}) while '{other}' moves"))
                break
    most, name, when = max(found, default=(0, "", ""))
    others = [f"'{other}' for {count}" for count, other, _ in found if other != name]
    also = f", and so does {shortlist(others, 4)}" * bool(others)
    advice = "a frozen sensor? Leave that stretch out, or the envelope will take it for healthy"
    return [f"'{name}' stands at exactly one value for {most} samples {when}{also}: {advice}"] * bool(found)


def _delayed(problem: Problem, signals: Sequence[Signal], past: Collection[int], rows: Rows) -> list[str]:
    """Controls that explain the states better when taken some samples earlier."""
    found: dict[tuple[int, int], dict[int, float]] = {}
    for j, (best, share) in evidence.late_controls(problem, past, rows).items():
        if share >= 0.005:  # of many states, of which few follow it, less may be sure
            found.setdefault((best, signals[problem.n + j].delay + best), {})[problem.n + j] = share
    return [
        f"the states follow {_controls(of, [s.name for s in signals])} better when it is taken "
        f"{plural(best, 'sample')} earlier (the unexplained part of a step falls by {max(of.values()):.0%}): try "
        f"`delay: {delay}` for it in the signals file"
        for (best, delay), of in found.items()
    ]


def _missing(problem: Problem, signals: Sequence[Signal]) -> dict[int, str]:
    """States whose next sample depends on more than the signals at one instant."""
    known, messages = evidence.autocorrelation(problem), dict[int, str]()
    for i, signal in enumerate(signals[: problem.n]):
        if known is None or not known.follows(i):
            continue
        one, two = known.correlation[i].tolist()
        entry = f"{{name: {signal.name}_before, topic: {signal.topic}, field: '{Memory('lag').of(signal.field)}'}}"
        entry = entry if signal.topic else "the same column, one row later"
        messages[i] = (
            f"what one step leaves unexplained of '{signal.name}' is correlated from sample to sample "
            f"(autocorrelation {one:.2f} at one sample, {two:.2f} at two): a state that moves it is not among the "
            f"signals. Its value {_BEFORE} {1 - 1 / known.gain[i]:.0%} of it (root mean square); add that as a "
            f"control ({entry}), or its rate, measured or as `rate(...)` of the field"
        )
    return messages


def _stretches(problem: Problem) -> Problem:
    """A problem of bounded size: stretches of consecutive transitions, spread evenly over a larger one."""
    if problem.N <= LOOKED_AT:
        return problem
    starts = np.linspace(0, problem.N - LOOKED_AT // STRETCHES, STRETCHES).astype(np.intp)
    part = np.unique(starts[:, None] + np.arange(LOOKED_AT // STRETCHES))
    return replace(problem.subset(part), weights=np.ones(problem.n))


def _carried(
    few: Carriers | None, discarded: int | None, problem: Problem, names: Sequence[str], transients: Sequence[Transient]
) -> list[str]:
    """States whose width a few samples carry."""
    if few is None:
        return []
    indices = sorted(few.transitions)
    wide = sorted(np.flatnonzero(few.factor >= MUCH).tolist(), key=lambda i: -few.factor[i])
    listed = ", ".join(f"'{names[i]}' {few.factor[i]:.3g} times" for i in wide[:4])
    listed += f" and of {plural(len(wide) - 4, 'other state')}" if len(wide) > 4 else ""
    cure = "leave that stretch out of the recording"
    if discarded is not None:
        cure = f"--discard {discarded + len(indices)} leaves them out and lists them"
    return [
        f"{plural(len(indices), 'transition')} of {problem.N} ({_where(problem, indices, transients)}) "
        f"{'makes' if len(indices) == 1 else 'make'} the envelope of {listed} {_FEW}: look at what happened there; if "
        f"it is a rare step of a control, record more of them; if it is no part of healthy use, {cure}"
    ]


def _where(problem: Problem, indices: Sequence[int], transients: Sequence[Transient]) -> str:
    """When some transitions happened: the first few, and how many more."""
    places: dict[str, list[str]] = {}
    indices = sorted(indices)
    for index in indices[:4]:
        of = transients[problem.source[index]]
        places.setdefault(of.name, []).append(f"{moment(of.t[problem.k[index]])} s")
    where = "; ".join(f"{name} at {', '.join(at)}" for name, at in places.items())
    return where + (f"; and {len(indices) - 4} more" if len(indices) > 4 else "")


def _noise_like(problem: Problem) -> dict[int, float]:
    """States whose next sample cannot be predicted from those before, and the share of its variance that can."""
    x, u = np.split(problem.z.T, [problem.n], axis=1)
    share = evidence.predicted(x, u, problem.x_next.T)
    noisy = (np.ptp(x, axis=0) > 0) & (share < evidence.NOISE)
    return {i: max(0.0, float(share[i])) for i in np.flatnonzero(noisy).tolist()}


def _noisy(noise: dict[int, float], names: Sequence[str], dt: Array) -> list[str]:
    """States that are mostly noise, in one message."""
    slow = float(np.median(dt)) * evidence.FASTEST >= 1.0
    more = "how it moves needs faster rows" if slow else "leave it out where that says nothing, or record it at work"
    listed, most = shortlist([f"'{names[i]}'" for i in noise], 12), max(noise.values(), default=0.0)
    return [
        f"{listed} {'moves' if len(noise) == 1 else 'move'} {_NOISE}: signals and controls at one instant predict "
        f"{'at most ' * (len(noise) > 1)}{most:.0%} of the variance at the next; its level is judged, {more}"
    ] * bool(noise)


def _slow(model: UncertainLTI) -> list[str]:
    """The fastest mode, if a step of forward Euler is too long for it."""
    dt = model.sampling.dt_median or 0.0
    fastest = max((v for block in model.blocks for v in block.eigenvalues()), key=abs)
    turn = abs(fastest) * dt
    if turn <= FAST:
        return []
    return [
        f"sampling is slow for the fastest mode ({_complex(fastest)} 1/s, {turn:.2g} in a step of {dt:.3g} s), unless "
        f"noise of the readings makes it look fast: the bounds hold, but A is the matrix of this step length, so read "
        f"no time constants from it; if the machine is that fast, sample {np.ceil(turn / 0.2):.0f} times as fast"
    ]


def _unstable(model: UncertainLTI) -> list[str]:
    """Whether the nominal model, of every block, stays bounded in a free run."""
    found = []
    for r, block in enumerate(model.blocks):
        at = f" at {model.block_name(r)}" if model.schedule is not None else ""
        if unstable := [_complex(v) for v in block.eigenvalues() if v.real > 0]:
            found.append(f"eigenvalues {shortlist(unstable, 4)} 1/s{at}")
        elif block.spectral_radius() > 1.0 + 1e-9:
            found.append(f"spectral radius {block.spectral_radius():.4g} at the recorded step{at}")
    listed = "; ".join(found[:3]) + (f"; and {len(found) - 3} more" if len(found) > 3 else "")
    return [
        f"the nominal model is unstable ({listed}): one-step bounds restart from the measured state, so the alarm is "
        f"as good as ever; simulate nothing with it"
    ] * bool(found)


def _complex(value: complex) -> str:
    return f"{value.real:.3g}{value.imag:+.3g}j" if value.imag else f"{value.real:.3g}"


def _wide(sums: Moments, mean_width: Array, names: Sequence[str], pure: bool) -> list[str]:
    """States whose envelope is as wide as what they do, and controls that never moved; `pure`: no additive term."""
    span, n = sums.high - sums.low, len(mean_width)
    wide = np.flatnonzero((span[:n] > 0) & (mean_width > WIDE * span[:n])).tolist()
    listed = shortlist([f"'{names[i]}' ({mean_width[i] / span[i]:.0%})" for i in wide], 8)
    near_rest = "; without an additive term noise near rest alone does it (--additive noise)" * pure
    messages = [
        f"the bounds are over {WIDE:.0%} as wide as the state's own range for {listed}, so few faults can show there: "
        f"its cause is no control, or acts within a step (`at: arrival`), a step is long, or noise as large{near_rest}"
    ] * bool(wide)
    if still := [name for name, moved in zip(names[n:], span[n:].tolist(), strict=True) if not moved]:
        messages.append(f"{quoted(still)} {CONSTANT}, so what a move would do is unknown")
    return messages


def remedies(messages: Sequence[str], additive: str, state: str) -> str:
    """What of a fit's messages would narrow the bounds of a state; "" where they name nothing."""
    named = [m for m in messages if f"'{state}'" in m]
    if any(words in m for words in (_CODE, "wraps around", "change sign together") for m in named):
        return f"'{state}' jumps without moving, as said above"
    if noise := [m for m in named if _NOISE in m]:
        return f"'{state}' moves like noise: {noise[0].rpartition('; ')[2]}"
    about = [(remedy.format(state), words, named if own else messages) for words, own, remedy in _REMEDIES]
    found = [remedy for remedy, words, told in about if any(words in m for m in told)]
    return ", or ".join(dict.fromkeys([*found, *(["try --additive noise"] if additive == "none" else [])]))
