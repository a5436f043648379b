# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Regimes of a scheduled fit: its knots, and the blocks that have data enough for elements of their own."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import FitError, ModelError
from uncertain_lti.base.text import meant, plural
from uncertain_lti.identification.passes import Moments
from uncertain_lti.identification.problem import Columns, Problem, Regimes, row_of
from uncertain_lti.model.schedule import MOST_AXES, Axis, Schedule
from uncertain_lti.signals.signal_map import Signal, SignalMap

LOOKED_AT = 20_000
"""Transitions that inner knots are chosen on, at most."""
CANDIDATES = 16
"""Places that are tried for an inner knot, as many quantiles of the signal and as many at equal distances."""
CLOSEST = 0.25
"""Least distance of two knots that the fit places, as a share of that of evenly spaced ones."""
RANK = 1e-12
"""Relative eigenvalue of a block's regressors, per column, below which a direction counts as never moved."""


@dataclass(frozen=True)
class Modes:
    """Modes of a discrete scheduling signal, each with a block of its own.

    `values`: in recorded units.
    """

    values: Sequence[float]


Knots = Sequence[float] | Modes | int | str
"""Of one scheduling signal its knots in recorded units, its modes, or how many knots; a text is refused."""


def tied_blocks(sums: Moments, columns: Columns, p: int) -> list[int]:
    """Which block's elements each block has: its own, if it has data enough.

    A block needs as many transitions of which it has the largest weight as it has unknowns per row, and its regressors
    must move in as many independent ways as those of all blocks together. A block that lacks either is tied to the
    nearest that does not: the least number of knots away, of two the one with more transitions; to another mode only
    if no knot of its own mode will do. If every block lacks them, all are tied to the one with most transitions.
    """
    if columns.regimes is None:
        return [0]
    schedule = columns.regimes.schedule
    reasons = lacking(sums.centre, sums.visits, columns, p)
    rich = [r for r, reason in enumerate(reasons) if not reason] or [int(np.argmax(sums.visits))]
    far = [1 if axis.knots else MOST for axis in schedule.axes]

    def distance(r: int, other: int) -> tuple[int, int, int]:
        steps = zip(schedule.indices[r], schedule.indices[other], far, strict=True)
        return sum(abs(a - b) * each for a, b, each in steps), -int(sums.visits[other]), other

    return [r if r in rich else min(distance(r, other) for other in rich)[2] for r in range(schedule.blocks)]


MOST = 10_000
"""Knots that another mode is away."""


def lacking(gram: Array, visits: NDArray[np.intp], columns: Columns, p: int) -> list[str]:
    """What each block lacks for elements of its own.

    `gram` (R r, R r): of the regressors of the nominal row; `visits` (R,): transitions of which each block has the
    largest weight.
    """
    assert columns.regimes is not None
    schedule, positions = columns.regimes.schedule, columns.regimes.positions
    count, unknowns = len(visits), columns.unknowns(p)
    parts = gram.reshape(count, len(gram) // count, count, -1)
    whole = _rank(parts.sum(axis=(0, 2)))
    # within a mode its signal is constant, and cannot be separated from a drift or from another such signal
    modes = [k for k, axis in enumerate(schedule.axes) if axis.modes and positions[k] < p]
    reasons = []
    for r, index in enumerate(schedule.indices):
        there = columns.drift or any(schedule.axes[k].values[index[k]] != 0.0 for k in modes)
        wanted = whole - (len(modes) + columns.drift) + there
        if visits[r] < unknowns:
            reasons.append(f"{plural(int(visits[r]), 'transition')} for {unknowns} unknowns per row")
        elif (rank := _rank(parts[r, :, r])) < wanted:
            reasons.append(f"its signals move in {rank} independent ways, where {wanted} are needed")
        else:
            reasons.append("")
    return reasons


def _rank(gram: Array) -> int:
    """Independent columns, of their Gram matrix."""
    scale = np.sqrt(np.diagonal(gram))
    there = np.flatnonzero(scale > 0)
    unit = 1.0 / scale[there]
    values = np.linalg.eigvalsh(gram[np.ix_(there, there)] * np.outer(unit, unit))
    return int(np.count_nonzero(values > RANK * len(there)))


def asked_by(signals: SignalMap) -> dict[str, Knots]:
    """The schedule that a signals file asks for."""
    return {rule.signal: Modes(rule.modes) if rule.knots is None else rule.knots for rule in signals.schedule}


def signals_of(schedule: Schedule | Mapping[str, Knots], names: Sequence[str]) -> list[str]:
    """The signals that a fit is scheduled on; refuses what is no schedule of these signals."""
    if isinstance(schedule, Schedule):
        return [axis.signal for axis in schedule.axes]
    if not isinstance(schedule, Mapping):
        raise FitError(
            f"schedule is {type(schedule).__name__}; give a Schedule, or a mapping from signals to knots in recorded "
            f"units, Modes, or how many knots"
        )
    check_names(schedule, names)
    return [name for name, knots in schedule.items() if isinstance(knots, (bool, np.ndarray)) or knots != 1]


def unused(further: Sequence[str], on: Sequence[str]) -> list[str]:
    """What is noted of further scheduling signals that schedule nothing."""
    idle = "schedules nothing, and the model leaves it out; use it with --schedule"
    return [f"scheduling signal '{name}' {idle} {name}=auto" for name in further if name not in on]


def check_names(schedule: Iterable[str], names: Sequence[str]) -> None:
    """Check that there are one or two scheduling signals at most, and that they exist."""
    asked = list(schedule)
    if len(asked) > MOST_AXES:
        raise FitError(f"schedule: {plural(len(asked), 'scheduling signal')}; give one or two")
    for name in asked:
        if name not in names:
            raise FitError(
                f"schedule: there is no signal '{name}'{meant(name, names, 1)}; there are {', '.join(names)}"
            )


def scheduled_by(
    schedule: Schedule | Mapping[str, Knots], signals: SignalMap, data: Callable[[], Problem] | None = None
) -> Schedule | None:
    """What a fit is scheduled by, where `signals_of` has found its signals."""
    if isinstance(schedule, Schedule):
        return schedule
    asked: dict[str, Knots] = {}
    for name, knots in schedule.items():
        if isinstance(knots, str):
            if knots == "auto":
                raise FitError(
                    f"schedule: the knots of '{name}' are auto, and this fit chooses none: it is left-out recordings "
                    f"that decide how many they carry; use uncertain_lti.fit or the command, or give knots or how many"
                )
            raise FitError(f"schedule: the knots of '{name}' are {knots!r}; give numbers, Modes, or how many")
        if isinstance(knots, (int, np.integer)):
            if isinstance(knots, bool) or knots < 1:
                raise FitError(f"schedule: '{name}' has {knots!r} knots; give at least 1")
            if knots == 1:
                continue
            if data is None:
                raise FitError(
                    f"schedule: '{name}' has {knots} knots, and where they are is unknown before all recordings are "
                    f"read; list them (a fit to a few of the recordings prints them)"
                )
        asked[name] = knots
    if not asked:
        return None
    problem = data() if data and any(isinstance(k, (int, np.integer)) for k in asked.values()) else None
    rows = {signal.name: row for row, signal in enumerate(signals.signals)}
    try:
        return Schedule(tuple(_axis(signals.signals[rows[k]], rows[k], knots, problem) for k, knots in asked.items()))
    except ModelError as error:
        raise FitError(str(error)) from None


def _axis(signal: Signal, row: int, knots: Knots, problem: Problem | None) -> Axis:
    """Knots or modes of one signal, normalised; row: its position in [x; u; s]."""
    if isinstance(knots, (int, np.integer)):
        assert problem is not None
        return Axis(signal.name, knots=_split(problem, row, int(knots), signal.name))
    given = knots.values if isinstance(knots, Modes) else knots
    try:
        values = np.asarray(list(given), dtype=np.float64)
    except (TypeError, ValueError):
        raise FitError(
            f"schedule: the knots of '{signal.name}' are no numbers; give numbers, Modes, or how many"
        ) from None
    if not isinstance(knots, Modes) and (np.diff(values) <= 0.0).any():
        raise FitError(f"schedule: the knots of '{signal.name}' must increase, and are {values.tolist()}")
    # as the samples are normalised, to the bit: a mode is met exactly
    normalised = tuple(((values - float(signal.steady)) / float(signal.scale)).tolist())
    return Axis(signal.name, **{"modes" if isinstance(knots, Modes) else "knots": normalised})


def _split(problem: Problem, row: int, count: int, name: str) -> tuple[float, ...]:
    """Knots from the least to the greatest value, the inner ones where they shrink the largest residual most.

    One after the other: each is tried at places over the range, and stays where the least-squares fit with it leaves
    the least product of the largest residuals of all states. Squares would go where most of the data is; it is the
    largest residual that the widths come from.
    """
    stride = max(1, -(-problem.N // LOOKED_AT))
    some = problem.subset(slice(None, None, stride)) if stride > 1 else problem
    values = row_of(some.z, some.s, row)
    least, most = (float(f(row_of(problem.z, problem.s, row))) for f in (np.min, np.max))
    if not least < most:
        raise FitError(
            f"schedule: '{name}' is constant in every transition, so it can have no {count} knots; record it moving, "
            f"or schedule on another signal"
        )
    knots = [least, most]
    even = np.linspace(0, 1, CANDIDATES + 2)[1:-1]
    seen = np.unique([*np.quantile(values, even, method="nearest"), *(least + (most - least) * even)]).tolist()
    room = CLOSEST * (most - least) / (count - 1)  # two knots within noise of one another have nothing between them
    while len(knots) < count:
        apart = [s for s in seen if min(abs(s - k) for k in knots) >= room]
        trials = [(*_left(some, row, sorted([*knots, s]), stride), s) for s in apart]
        # an end that is rarely reached need not keep the others from knots of their own
        trials = [trial for trial in trials if trial[0] <= 2]
        if not trials:
            raise FitError(
                f"schedule: '{name}' takes too few values for {count} knots, or the recordings hold too little near "
                f"each of them; give fewer, or list its values as modes"
            )
        knots = sorted([*knots, min(trials)[2]])
    return tuple(knots)


def _left(problem: Problem, row: int, knots: Sequence[float], each: int) -> tuple[int, float]:
    """How many blocks would lack data, and the sum over the states of the logarithm of the largest residual.

    each: transitions that one of the problem represents. A block between the ends that lacks data counts as many.
    """
    regimes = Regimes(Schedule((Axis("s", knots=tuple(knots)),)), (row,))
    columns = replace(problem.columns, regimes=regimes)
    phi = columns.phi(problem.z, problem.s) * problem.dt
    step = problem.x_next - problem.z[: problem.n]
    gram = phi @ phi.T
    main = regimes.schedule.main_block(row_of(problem.z, problem.s, row)[None])
    visits = each * np.bincount(main, minlength=len(knots))
    lacks = [bool(reason) for reason in lacking(gram, visits, columns, problem.p)]
    unit = 1.0 / np.sqrt(np.maximum(np.diagonal(gram), 1e-300))
    ridge = 1e-12 * np.eye(len(gram))
    theta = np.linalg.solve(gram * np.outer(unit, unit) + ridge, (phi @ step.T) * unit[:, None]) * unit[:, None]
    largest = np.abs(step - theta.T @ phi).max(axis=1)
    scale = np.maximum(np.abs(step).max(axis=1), 1e-300)
    left = float(sum(math.log(max(r, 1e-12)) for r in largest / scale))
    return lacks[0] + lacks[-1] + len(knots) * sum(lacks[1:-1]), left
