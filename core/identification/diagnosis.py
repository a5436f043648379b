# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What the data and the fit mean for the user, in words."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.english import plural
from uncertain_lti.base.errors import FitError
from uncertain_lti.identification import excitation, predictability, regimes, sensors
from uncertain_lti.identification.discard import Carriers
from uncertain_lti.identification.excitation import quoted as _list
from uncertain_lti.identification.passes import Moments
from uncertain_lti.identification.predictability import Prediction
from uncertain_lti.identification.problem import Problem
from uncertain_lti.model.operating_point import recorded
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.sampling.transient import Transient

LOOKED_AT, STRETCHES = 20_000, 20
"""Transitions, and stretches, that are examined at most for what shows in any of them."""
FAST = 0.7
"""|eigenvalue| x dt above which a step of forward Euler is long for the mode."""
NEARLY = 0.5
"""Share of a mode's speed that must remain without measurement noise, or noise is what makes it fast."""
WIDE = 0.5
"""Mean width, as a share of the state's own range, above which few faults can show."""
SLOW, DISCARD = "sampling is slow", "--discard"
"""Words by which a message is known again."""
AFTER_STEP = 5
"""Samples after a step of a control that still belong to it."""


def too_few(transitions: int, unknowns: int) -> str:
    """The sentence for fewer transitions than unknowns."""
    return (
        f"{plural(transitions, 'usable transition')} for {unknowns} unknowns per row (nominal elements and "
        "half-widths); record "
        f"at least {unknowns}, better a hundred times as many, or use fewer signals"
    )


def check_solvable(problem: Problem, transients: Sequence[Transient], names: Sequence[str]) -> None:
    """Refuse data to which no envelope can be fitted."""
    columns = problem.columns
    unknowns = columns.unknowns(problem.p)
    if problem.N < unknowns:
        raise FitError(too_few(problem.N, unknowns))
    if columns.disturbance or columns.noise:
        return
    rest = np.ones(problem.N, dtype=bool)
    for column in problem.z_columns:
        rest &= column == 0.0
        if not rest.any():
            return
    moving = rest[:, None] & (problem.x_next != problem.z[:, : problem.n])
    where = np.argwhere(moving)
    if len(where):
        sample, state = where[0]
        transient = transients[problem.source[sample]]
        k = int(problem.k[sample])
        others = len(np.unique(where[:, 0])) - 1
        also = f" (so {'does' if others == 1 else 'do'} {plural(others, 'other sample')})" if others else ""
        raise FitError(
            f"{transient.name}: sample {k} (t = {transient.t[k]:.6g} s) is at rest, x = u = 0, and '{names[state]}' "
            f"moves by {problem.x_next[sample, state]:.3g} in the next step, which no interval matrices can contain"
            f"{also}; use an additive term: --additive noise for "
            f"measurement noise, --additive disturbance for unmodelled inputs"
        )


def _rank(problem: Problem, sums: Moments, names: Sequence[str]) -> tuple[int, list[str]]:
    """Rank of the nominal regressors and, in words, which columns make it deficient."""
    names = [*names, "the disturbance c"] if problem.columns.drift else list(names)
    messages = []
    dead = sums.phi_scale == 0
    for j in np.flatnonzero(dead):
        messages.append(
            f"rank deficient: '{names[j]}' is 0 in every transition, so its column is not identifiable and is set "
            f"to 0; record it moving, or leave it out"
        )
    free = np.flatnonzero(~dead)
    unit = 1.0 / sums.phi_scale[free]
    correlation = sums.centre[np.ix_(free, free)] * np.outer(unit, unit) / sums.count
    values, vectors = np.linalg.eigh(correlation)
    limit = 1e-12 * len(free)
    for value, vector in zip(values, vectors.T, strict=True):
        if value <= limit:
            part = [names[free[j]] for j in np.flatnonzero(np.abs(vector) > 0.05)]
            messages.append(
                f"rank deficient: {_list(part)} move together in every transition, so their columns cannot be told "
                f"apart and share the effect; record them moving independently, or leave one out"
            )
    moved = sums.high - sums.low
    for j in np.flatnonzero((moved == 0) & ~dead[: problem.p]):
        messages.append(
            f"'{names[j]}' is constant ({problem.z[0, j]:.4g}) in every transition, so its column cannot be told from "
            f"the disturbance c; record it moving, or leave it out"
        )
    return int(np.count_nonzero(values > limit)), messages


def describe(
    model: UncertainLTI,
    problem: Problem,
    sums: Moments,
    mean_width: Array,
    max_width: Array,
    transients: Sequence[Transient] = (),
    few: Carriers | None = None,
    discarded: int | None = None,
) -> tuple[int, list[str]]:
    """Rank, and messages to the user on a fitted model and the recordings it was fitted to.

    `mean_width` (n,): normalised, per step; `max_width` (n,): normalised, per step.
    """
    states = model.state_names
    names = [*states, *model.control_names]
    scheduled, problem = problem, replace(problem, columns=replace(problem.columns, regimes=None))
    all_sums, sums = sums, sums.one_block()
    found, messages = _rank(problem, sums, names)
    apart = not messages
    messages += _tied(model, scheduled, all_sums) + _beyond_knots(model, scheduled)
    part = _stretches(problem)
    signals = (*model.signals.states, *model.signals.controls)
    lagged = predictability.lagged_states(signals, model.n)
    alike = excitation.collinear(problem, sums, names, 1e-12 * problem.p, lagged)

    def place(some: Sequence[int]) -> str:
        return _where(problem, some, transients)

    broken = [*sensors.coded(problem, sums, signals), *sensors.flipped(problem, signals, place)]
    messages = [*broken, *messages]
    messages += [*([] if broken else _carried(few, discarded, problem, names, place)), *alike]
    known = predictability.prediction(part)
    told, follow = _recordings(model, problem, part, sums, names, transients, bool(broken))
    messages += told
    messages += _noise_like(known, part, states, follow)
    past = bool(lagged)  # A alone is then not the dynamics
    slow = [] if past else _slow(model, known, apart and not alike, bool(follow))
    messages += slow
    messages += _unstable(model, past)
    messages += _unsure(model, names)
    columns = problem.columns
    if not columns.noise and not columns.disturbance:
        messages += _near_rest(scheduled, _stretches(scheduled), all_sums, mean_width, states)
    messages += _wide(sums, mean_width, states, known, few, bool(slow) and SLOW in slow[0], follow)
    if columns.drift and columns.noise and not columns.disturbance:
        messages.append("Δt is constant, so dc and v cannot be told apart: v takes the width and dc is 0")
    return found, messages


def _tied(model: UncertainLTI, problem: Problem, sums: Moments) -> list[str]:
    """Blocks that share the elements of another."""
    columns = problem.columns
    if columns.regimes is None:
        return []
    tied = [r if data.tied_to is None else data.tied_to for r, data in enumerate(model.block_data)]
    messages = regimes.tied_words(columns.regimes.schedule, sums, columns, problem.p, tied, model.signals.signals)
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
        values = regimes.values_of(problem, row)
        beyond = (values < axis.knots[0]) | (values > axis.knots[-1]) if axis.knots else np.zeros(1, dtype=bool)
        if beyond.any():
            signal = model.signals.signals[row]
            low, high = (recorded(v, float(signal.steady), float(signal.scale)) for v in (values.min(), values.max()))
            messages.append(
                f"{axis.signal} goes from {low:.5g} to {high:.5g}{f' {signal.unit}' if signal.unit else ''} in the "
                f"recordings, and {beyond.mean():.2%} of the transitions are beyond its knots, {at[0]:.5g} to "
                f"{at[-1]:.5g}: every verdict there counts as one on an unknown regime; give end knots that enclose "
                f"what was recorded"
            )
    return messages


MOST_TIED = 5
"""Blocks that share the elements of another which are named one by one."""


def _at(model: UncertainLTI, block: int) -> str:
    """at the knot of a block; empty of a model with one."""
    return f" at {model.block_name(block)}" if model.schedule is not None else ""


def _few(words: Sequence[str]) -> str:
    """The first of them, and how many more there are."""
    return "; ".join(words[:3]) + (f"; and {len(words) - 3} more" if len(words) > 3 else "")


def _unstable(model: UncertainLTI, past: bool) -> list[str]:
    """Whether the nominal model, of every block, stays bounded in a free run; past: it remembers earlier samples."""
    growing, running = [], []
    for r, block in enumerate(model.blocks):
        unstable = [] if past else [v for v in block.eigenvalues() if v.real > 0]
        if unstable:
            values = ", ".join(f"{v.real:.3g}{v.imag:+.3g}j" if v.imag else f"{v.real:.3g}" for v in unstable)
            growing.append(f"eigenvalues {values} 1/s{_at(model, r)}")
        elif block.spectral_radius() > 1.0 + 1e-9:
            running.append(f"spectral radius {block.spectral_radius():.4g}{_at(model, r)}")
    stay = "one-step bounds restart from the measured state and stay valid, a free run does not"
    if growing:
        return [f"the nominal model is unstable ({_few(growing)}): {stay}"]
    if running:
        return [f"the nominal recursion runs away at the recorded step ({_few(running)}): {stay}"]
    return []


def _unsure(model: UncertainLTI, names: Sequence[str]) -> list[str]:
    """Half-widths above their nominal elements."""
    nominal, half = (
        np.stack([np.hstack([getattr(b, name) for name in both]) for b in model.blocks])
        for both in (("A", "B"), ("dA", "dB"))
    )
    wide = np.argwhere(half > np.abs(nominal))
    if not len(wide):
        return []
    r, i, j = max(wide.tolist(), key=lambda at: float(half[tuple(at)] - abs(nominal[tuple(at)])))
    return [
        f"{len(wide)} of {nominal.size} half-widths exceed their nominal elements (most: {names[i]} from "
        f"{names[j]}{_at(model, r)}, {nominal[r, i, j]:.3g} ± {half[r, i, j]:.3g} 1/s): the sign of these effects is "
        f"not known"
    ]


def _recordings(
    model: UncertainLTI,
    problem: Problem,
    part: Problem,
    sums: Moments,
    names: Sequence[str],
    transients: Sequence[Transient],
    broken: bool,
) -> tuple[list[str], set[int]]:
    """Messages on the recordings (excitation, sensors, topics), and the states that lack another state.

    broken: some numbers are no movement; what the jumps do to the residuals comes from them.
    """
    signals = (*model.signals.states, *model.signals.controls)
    past = predictability.lagged_states(signals, model.n)
    rare = excitation.rare(part, names)
    known = {*rare, *past}
    held, late = sensors.held(part, signals), sensors.delayed(part, signals, past)
    found = None if late or broken else predictability.autocorrelation(part)
    # what a slow topic or a late control explains needs no further state
    follow = {i for i in range(model.n) if found and found.follows(i) and not any(f"'{names[i]}'" in m for m in held)}
    speed = max((abs(v) for block in model.blocks for v in block.eigenvalues()), default=0.0) * (
        model.sampling.dt_median or np.inf
    )
    uneven = [] if broken else sensors.jittering(part, signals, float(speed), model.sampling.clock)
    messages = [*rare.values(), *uneven]
    if found:
        messages += predictability.missing(found, signals, follow)
    lost = {j: (i, certainty) for j, (i, certainty) in excitation.lost(problem, sums, known).items() if i not in follow}
    messages += [] if broken else predictability.weak(lost, names)
    messages += excitation.one_sided(part, names, known)
    messages += excitation.fed_back(part, names, past)
    messages += late
    messages += sensors.quantised(part, signals)
    messages += held
    messages += sensors.frozen(part, signals, transients)
    messages += sensors.stale(signals, model.n, part, transients)
    return messages, follow


def _stretches(problem: Problem) -> Problem:
    """A problem of bounded size: stretches of consecutive transitions, spread evenly over a larger one."""
    if problem.N <= LOOKED_AT:
        return problem
    starts = np.linspace(0, problem.N - LOOKED_AT // STRETCHES, STRETCHES).astype(np.intp)
    return replace(
        problem.subset(np.unique(starts[:, None] + np.arange(LOOKED_AT // STRETCHES))), weights=np.ones(problem.n)
    )


def _carried(
    few: Carriers | None,
    discarded: int | None,
    problem: Problem,
    names: Sequence[str],
    place: Callable[[Sequence[int]], str],
) -> list[str]:
    """States whose width a few samples carry."""
    if few is None:
        return []
    indices = sorted(few.transitions)
    where = place(indices)
    wide = sorted((i for i in range(problem.n) if few.carry(i)), key=lambda i: -few.factor[i])
    widths = [f"'{names[i]}' {few.factor[i]:.3g} times" for i in wide[:4]]
    widths += [f"{len(wide) - 4} other states"] if len(wide) > 4 else []
    listed = widths[0] if len(widths) == 1 else ", ".join(widths[:-1]) + " and of " + widths[-1]
    if steps := _at_steps(problem, indices):
        cure = (
            f"they are the few where {_list([names[j] for j in steps])} {'steps' if len(steps) == 1 else 'step'}: "
            f"record more such steps, or find the delay between them and the answer"
        )
    else:
        cure = "look at what happened there; if it is no part of healthy use, "
        cure += (
            "leave that stretch out of the recording"
            if discarded is None
            else f"{DISCARD} {discarded + len(indices)} leaves them out and lists them"
        )
    one = len(indices) == 1
    return [
        f"{plural(len(indices), 'transition')} of {problem.N} ({where}) {'makes' if one else 'make'} the envelope of "
        f"{listed} as wide as the rest needs: {cure}"
    ]


def _where(problem: Problem, indices: Sequence[int], transients: Sequence[Transient]) -> str:
    """When some transitions happened: the first few, and how many more."""
    places: dict[str, list[str]] = {}
    indices = sorted(indices)
    for index in indices[:4]:
        source, k = int(problem.source[index]), int(problem.k[index])
        if source < len(transients):
            places.setdefault(transients[source].name, []).append(f"{transients[source].t[k]:.6g} s")
        else:
            places.setdefault(f"recording {source + 1}", []).append(f"sample {k}")
    where = "; ".join(f"{name} at {', '.join(at)}" for name, at in places.items())
    return where + (f"; and {len(indices) - 4} more" if len(indices) > 4 else "")


def _at_steps(problem: Problem, indices: Sequence[int]) -> list[int]:
    """Columns of controls that rarely change, and do so at most of these transitions."""
    found = []
    for j in range(problem.n, problem.p):
        changes = np.flatnonzero(np.diff(problem.z[:, j]) != 0) + 1
        near = np.zeros(problem.N, dtype=bool)
        for shift in range(-2, AFTER_STEP + 1):
            near[np.clip(changes + shift, 0, problem.N - 1)] = True
        if len(changes) and near.mean() < 0.1 and near[list(indices)].mean() >= 0.5:
            found.append(j)
    return found


def _noise_like(known: Prediction, problem: Problem, states: Sequence[str], follow: Collection[int]) -> list[str]:
    """States whose next sample cannot be predicted from those before."""
    moving = np.ptp(problem.z[:, : problem.n], axis=0) > 0
    like = [i for i in range(problem.n) if moving[i] and known.like_noise(i) and i not in follow]
    if not like:
        return []
    worst = min(like, key=lambda i: float(known.predicted[i]))
    one = len(like) == 1
    return [
        f"{_list([states[i] for i in like])} {'moves' if one else 'move'} like noise from sample to sample: signals "
        f"and controls at one instant predict {max(0.0, known.predicted[worst]):.0%} of the variance of "
        f"'{states[worst]}' at the next; leave {'it' if one else 'them'} out, or record the machine at work"
    ]


def _slow(model: UncertainLTI, known: Prediction, apart: bool, hidden: bool) -> list[str]:
    """Modes that a step of forward Euler is too long for, if the recordings confirm them.

    apart: the columns can be separated, so that the eigenvalues mean something; hidden: a state is missing, so that
    what looks like noise may be a mode that one sample does not show.
    """
    dt = model.sampling.dt_median
    if dt is None:
        return []
    fastest = max((v for block in model.blocks for v in block.eigenvalues()), key=abs)
    turn = abs(fastest) * dt
    if turn <= FAST:
        return []
    mode = f"{fastest.real:.3g}{fastest.imag:+.3g}j" if fastest.imag else f"{fastest.real:.3g}"
    if apart and known.fastest <= FAST and (hidden or known.fastest > NEARLY * turn):
        return []  # nearly as fast without the noise, or not seen at all: neither is its doing
    if not apart or known.fastest <= FAST:
        cause = "noise" if apart else "columns that the recordings do not tell apart"
        return [
            f"the fastest mode of the nominal model ({mode} 1/s) comes from {cause}, not from the machine: the bounds "
            f"hold, but read no time constants from A"
        ]
    return [
        f"{SLOW} for the fastest mode ({mode} 1/s, {turn:.2g} in a step of "
        f"{dt:.3g} s): A is then the matrix of this step length rather than of the machine, and holds for no other; "
        f"sample {np.ceil(turn / 0.2):.0f} times as fast, or leave the fast state out"
    ]


def _wide(
    sums: Moments,
    mean_width: Array,
    states: Sequence[str],
    known: Prediction,
    few: Carriers | None,
    slow: bool,
    follow: Collection[int],
) -> list[str]:
    """States whose envelope is as wide as what they do, and why where something is known."""
    span = (sums.high - sums.low)[: len(mean_width)]
    wide = np.flatnonzero((span > 0) & (mean_width > WIDE * span)).tolist()
    groups: dict[str, list[int]] = {}
    for i in wide:
        if few is not None and few.carry(i):
            cause = "a few samples carry the width (see above)"
        elif i in follow:
            cause = "a state that moves it is not among the signals (see above)"
        elif known.like_noise(i):
            cause = "noise is most of what the recordings show of it"
        elif slow:
            cause = "one step is long for it, or what moves it is not among the controls"
        else:
            cause = "what moves it is not among the controls, or the noise is as large"
        groups.setdefault(cause, []).append(i)
    messages = []
    for cause, those in groups.items():
        listed = ", ".join(f"'{states[i]}' ({mean_width[i] / span[i]:.0%})" for i in those)
        messages.append(
            f"the bounds are over {WIDE:.0%} as wide as the state's own range for {listed}, so few faults can show "
            f"there: {cause}"
        )
    return messages


def remedies(messages: Sequence[str], additive: str, state: str) -> str:
    """What of a fit's messages would narrow the bounds of a state; "" where they name nothing."""
    named = [m for m in messages if f"'{state}'" in m]
    if any(words in m for m in named for words in (sensors.STANDS_FOR_NONE, sensors.CHANGES_SIGN, sensors.WRAPS)):
        return "it jumps without moving, as said above"
    found = []
    if any("as wide as the rest needs" in m for m in named):
        found.append("look at the few samples that carry the width, named above")
    if any("like noise from sample to sample" in m for m in named):
        return "it moves like noise: leave it out, or record the machine at work"
    if any("one sample earlier explains" in m for m in named):
        found.append("add its value one sample earlier, as said above")
    if additive == "none":
        found.append("try --additive noise")
    if any("`delay:" in m for m in messages):
        found.append("set the delay that the notes propose")
    if any(m.startswith(SLOW) for m in messages):
        found.append("sample faster")
    if any("moves too little" in m or "is not identifiable" in m for m in messages):
        found.append("record the controls moving more")
    return ", or ".join(found)


def _near_rest(problem: Problem, part: Problem, sums: Moments, mean_width: Array, states: Sequence[str]) -> list[str]:
    """Widths that come from samples near rest; part: `_stretches`."""
    floor = 1e-9 * np.abs(part.z_columns[: part.n]).max(axis=1)  # below it both are rounding
    box = _least_squares_box(part, sums)
    if part is not problem and (mean_width > box).any():  # the band of all samples is no narrower: a screen
        box = _least_squares_box(problem, sums, enough=mean_width)
    blown = [i for i in range(problem.n) if mean_width[i] > box[i] > floor[i]]
    if not blown:
        return []
    size = np.abs(part.z_columns).sum(axis=0)
    rest = float(np.mean(size <= 0.02 * np.quantile(size, 0.95)))
    worst = max(blown, key=lambda i: float(mean_width[i] / box[i]))
    return [
        f"the envelope of {_list([states[i] for i in blown])} is absurdly wide: the mean width of {states[worst]} is "
        f"{mean_width[worst] / box[worst]:.3g} times that of a constant band around least squares, because noise near "
        f"rest ({rest:.0%} of the samples) inflates the half-widths; use an additive term: --additive noise, or "
        f"--additive disturbance"
    ]


def _least_squares_box(problem: Problem, sums: Moments, enough: Array | None = None) -> Array:
    """Width of a constant band around least squares that contains every sample, (n,), per step.

    Where it is known to reach `enough` in every state, what it reaches beyond is not sought.
    """
    free = sums.phi_scale > 0
    theta = np.zeros(sums.target.shape)
    theta[free] = np.linalg.lstsq(sums.centre[np.ix_(free, free)], sums.target[free], rcond=None)[0]
    largest = np.zeros(problem.n)
    for block in problem.blocks():
        residual = np.abs(block.rate() - theta.T @ block.phi(problem.columns)) * block.dt
        largest = np.maximum(largest, residual.max(axis=1))
        if enough is not None and (2.0 * largest >= enough).all():
            break
    return 2.0 * largest
