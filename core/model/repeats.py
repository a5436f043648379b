# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

r"""Repeats: how long states repeat exactly in healthy recordings, how far the model moves them, and which are frozen.

A repeat of state i is a run of transitions over which its recorded value stays the same, to the bit. With the step
:math:`Δt_j`, the centre of the bounds :math:`\hat x_j` and the repeated value r, the nominal model moves the state by

    run_{j+1} = run_j - clip(-Δt_j a_ii, 0, 1) run_j + (\hat x_j - r),    sum_{j+1} = sum_j + (\hat x_j - r)

both from 0 at the last fresh sample: the run is the state's own equation followed freely, in a step to its rest at
most, with every other state as it was recorded, and the sum holds the state where it was read. Both are given in
half-widths, the largest of the repeat.

The activity of the machine, as it concerns state i, is the range of (\\hat x_j - r) / Δt_j over the repeat, in
half-widths: as r stays, it changes with the controls and the other states alone. The fit learns how active the machine
is in the seconds in which the state changes, and while it repeated.

Noise is told by the steps in which the controls kept their values and the state changed by more than the model moves
it, if hardly a value of the state came twice in a recording.

A parked machine repeats too, so a repeat alone is a warning. A state is frozen if one of four measures of a repeat is
beyond its half-width and beyond twice what healthy recordings reached (`Repeats`), of the first two in so long a time:
how far its own equation runs from the repeated value; the sum of the movements, where another state has moved; how
active the machine is meanwhile; or, of a state that noise always changed, the time. Where the value is 0, as of what
rests or is switched off, or all states repeat, as of a machine that is parked, only activity counts: brakes and
friction hold against what the model expects. Nothing counts outside the fitted domain, nor what a coarse sensor does
by chance.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from operator import eq
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import LARGEST, Array
from uncertain_lti.base.errors import ModelError
from uncertain_lti.base.text import lasting
from uncertain_lti.kernel import arithmetic as kernel
from uncertain_lti.model.terms import checked, object_of

_KEYS = ("longest_repeat_s", "largest_run", "largest_sum", "active_beyond", "noisy_steps")
WINDOW_S = 1.0
"""Length of the windows of which the activity is taken, s."""
WINDOWS = 20
"""Windows that a share of them needs."""
ACTIVE = 0.5
"""Share of the windows that may be less active than a machine that is called active; half of it where it was parked."""
_BLOCK, _MOST = 1 << 16, 1 << 16  # transitions that are looked at together, and of one recording for its activity
_SPREAD = 1 << 13  # transitions of each part that is looked at where a recording has more than that
_DISTINCT = 4096  # values of a block that are compared with one another
_OFTEN, _FEW = 0.3, 10  # share of repeats, and values, from which on a state may be held between its values
_TWICE = 1e-3  # share of them that may come twice: more do so by chance in a coarse sensor
MORE_ACTIVE = 2.0
"""How much more active than during any repeat of the fit the machine must be."""


class Repeats:
    """What recordings of a healthy machine have of exact repeats, of each state.

    Parameters
    ----------
    longest_repeat_s : array (n,)
        The longest repeat, s; 0 for a state that never repeated.
    largest_run : array (n,), optional
        The farthest that the nominal model ran over any of them, in half-widths; beyond all numbers of a state that
        mostly is held between its values; default unknown, infinite.
    largest_sum : array (n,), optional
        The largest sum of its one-step movements, likewise.
    active_beyond : array (n,), optional
        Activity beyond which the state always changed, in half-widths; default unknown, infinite.
    noisy_steps : array (n,), optional
        Steps that show noise; default 0, as for a state of which values came twice.

    Raises
    ------
    ModelError
        The shapes do not fit one another, or a number is negative or not finite.
    """

    longest_repeat_s: Array
    largest_run: Array
    largest_sum: Array
    active_beyond: Array
    noisy_steps: Array

    def __init__(
        self,
        longest_repeat_s: ArrayLike,
        largest_run: ArrayLike | None = None,
        largest_sum: ArrayLike | None = None,
        active_beyond: ArrayLike | None = None,
        noisy_steps: ArrayLike | None = None,
    ) -> None:
        longest = checked(longest_repeat_s, "frozen.longest_repeat_s", None)
        if longest.ndim != 1:
            raise ModelError("field 'frozen.longest_repeat_s' must be a list with one number per state")
        given = longest, largest_run, largest_sum, active_beyond, noisy_steps
        for name, values in zip(_KEYS, given, strict=True):
            unknown = np.full(longest.shape, 0.0 if name == "noisy_steps" else np.inf)
            array = unknown if values is None else checked(values, f"frozen.{name}", longest.shape)
            if (array < 0).any():
                raise ModelError(f"field 'frozen.{name}' holds a negative number")
            array.flags.writeable = False
            setattr(self, name, array)

    def __repr__(self) -> str:
        return f"Repeats(longest {', '.join(f'{s:.3g} s' for s in self.longest_repeat_s)})"

    def and_of(self, other: Repeats) -> Repeats:
        """Those of both: where a share of all windows would decide, the more active of the two.

        Parameters
        ----------
        other : Repeats
            Of other recordings.

        Returns
        -------
        Repeats
            No state is called frozen that one of the two does not call so.
        """
        longest, run, total, beyond = (np.maximum(getattr(self, name), getattr(other, name)) for name in _KEYS[:-1])
        noisy = np.where((self.noisy_steps > 0) & (other.noisy_steps > 0), self.noisy_steps + other.noisy_steps, 0.0)
        run, total, beyond = (values if np.isfinite(values).all() else None for values in (run, total, beyond))
        return Repeats(longest, run, total, beyond, noisy)

    def reaching(self, most: Array) -> Repeats:
        """The same where a repeat that was left out went farther by the model fitted without it.

        Parameters
        ----------
        most : array (4, n)
            As of `Found`.

        Returns
        -------
        Repeats
            What was fitted, the model knows: where that is far from what it knows of others, no other is frozen.
        """
        known = self.largest_run, self.largest_sum, self.active_beyond
        reached = np.minimum(most[1:] * [[1.0], [1.0], [MORE_ACTIVE]], LARGEST)
        run, total, beyond = map(np.maximum, known, reached)
        return Repeats(self.longest_repeat_s, run, total, beyond, self.noisy_steps)

    def to_dict(self) -> dict[str, list[float]]:
        """As it is in a model file."""
        found = {name: getattr(self, name).tolist() for name in _KEYS}
        if not self.noisy_steps.any():
            del found["noisy_steps"]
        return {name: values for name, values in found.items() if np.isfinite(values).all()}

    @classmethod
    def from_dict(cls, data: Any) -> Repeats:
        """From a model file."""
        if not isinstance(data, Mapping) or _KEYS[0] not in data:
            raise ModelError("field 'frozen' must be an object with longest_repeat_s; fit the model again")
        return cls(**object_of(data, "frozen", known=_KEYS))


class Moved(NamedTuple):
    """One repeat so far.

    `state`: number of the state; `seconds`: since the last fresh sample, s; `longest`: the longest of the fit, s;
    `why`: why it is frozen, in words; empty for a state that is not.
    """

    state: int
    seconds: float
    longest: float
    why: str = ""

    @property
    def words(self) -> str:
        """What is said of it, after the name of the state."""
        return repeat_words(self.seconds, self.longest) + f", {self.why}" * bool(self.why)


Followed = tuple[NDArray[np.bool_], NDArray[np.int64], Array, Array, Array, Array, Array, Array, NDArray[np.bool_]]
"""What `Repeating.take_all` takes."""


def followed(
    model: Any, t_ns: NDArray[np.int64], steps: Any, repeats: NDArray[np.bool_], margin: float
) -> tuple[NDArray[np.intp], Followed]:
    """Transitions in which some state repeats, and those right after: where each begins, and what they are.

    `t_ns` (N+1,): of the samples, ns; `steps`: K transitions; `repeats` (K,): whether some state repeats; `margin`: of
    the bounds.
    """
    follows = np.append(False, np.diff(steps.k) == 1)[: len(steps.k)]
    steps = steps.take(np.flatnonzero(repeats | (follows & np.roll(repeats, 1))))
    z, at = model.normalised_columns(steps), steps.k
    on = np.append(False, np.diff(at) == 1)[: len(at)]
    with np.errstate(over="ignore", invalid="ignore"):
        centre, half = model.columns_centre_and_half(z, steps.dt)
        lower, upper = (model.operating_point.recorded_x(bound.T) for bound in kernel.edges(centre, half, margin))
    outside = model.domain.beyond(z) | model.unknown(z)
    return at, (on, t_ns[at + 1], steps.dt, steps.x, steps.x_next, lower, upper, model.own_rates(z).T, outside)


class Found(NamedTuple):
    """What one recording has of exact repeats.

    `most` (4, n): of each state the longest repeat, the farthest run, the largest sum and the greatest activity of a
    repeat; `windows` (windows, n): activity in each window of WINDOW_S; NaN for a state that repeats in half of it or
    more; `noisy` (n,): steps that show noise; -1 for a state of which values came twice; `largest` (n,): the largest
    change in one transition, recorded units.
    """

    most: Array
    windows: Array
    noisy: Array
    largest: Array


def repeats_in(model: Any, transient: Any) -> Found:
    """What one recording has of them."""
    steps = transient.transitions()
    windows, noisy = _activity(model, transient, steps)
    some, largest = kernel.changes(transient.x, steps.k)
    follow = kernel.Repeating(np.full((model.n, 7), np.inf), LEAST, REST_S, [False] * model.n, 1.0)
    if some.any():
        follow.take_all(*followed(model, transient.t_ns, steps, some, 1.0)[1])
    most = follow.most
    if some.any() and some.mean() >= _OFTEN:
        most[1, _held(transient.x, steps.k)] = LARGEST  # it runs on between two values, the farther the faster
    return Found(most, windows, noisy, largest)


def _held(x: Array, k: NDArray[np.intp]) -> NDArray[np.bool_]:
    """States (n,) that mostly repeat their last value between two that are new, as of a slower or a coarse sensor."""
    fresh = [np.flatnonzero(column[k + 1] != column[k]) for column in x.T]
    return np.array([len(at) > _FEW and np.median(np.diff(at)) >= 2 for at in fresh], dtype=bool)


def together(n: int, found: Sequence[Found]) -> Repeats:
    """What recordings have of exact repeats, from what each of them has."""
    longest, run, total, active = np.max([np.zeros((4, n)), *(one.most for one in found)], axis=0)
    windows = np.concatenate([np.zeros((0, n)), *(one.windows for one in found)])
    known = [column[~np.isnan(column)] for column in windows.T]
    each = zip(known, np.where(longest < WINDOW_S, ACTIVE, ACTIVE / 2), strict=True)
    # a half-width where there are few
    usual = np.array([np.quantile(some, share) if len(some) >= WINDOWS else 1.0 for some, share in each])
    noisy = np.array([np.zeros(n), *(one.noisy for one in found)])
    beyond = np.maximum(usual, MORE_ACTIVE * active)
    run, total, beyond = (np.minimum(values, LARGEST) for values in (run, total, beyond))  # JSON has no infinity
    return Repeats(longest, run, total, beyond, np.where((noisy >= 0).all(axis=0), noisy.sum(axis=0), 0.0))


def _activity(model: Any, transient: Any, steps: Any) -> tuple[Array, Array]:
    """Activity in each unbroken window, and the steps that show noise: `windows` and `noisy` of `Found`.

    Parts spread over a long recording do: a share of its windows is asked for, and whether many steps show noise.
    """
    found, noisy = list[Array](), np.zeros(model.n)
    t = transient.t_ns[steps.k]
    begin, length = range(0, len(t), _BLOCK), _BLOCK
    if len(t) > _MOST:
        begin, length = range(0, len(t) - _SPREAD + 1, (len(t) - _SPREAD) // (_MOST // _SPREAD - 1)), _SPREAD
    for a in begin:
        part, at = steps.take(slice(a, a + length)), t[a : a + length]
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            z = model.normalised_columns(part)
            centre, half = model.columns_centre_and_half(z, part.dt)
            own = model.own_rates(z).T * part.x  # does not change in a repeat, and must not count here
            movement = model.operating_point.recorded_x(centre.T) - part.x
            rate = movement / part.dt[:, None] - own
            width = half.T * model.operating_point.X / part.dt[:, None]
            number = (at - at[0]) // round(WINDOW_S * 1e9)
            begins = np.flatnonzero(np.diff(number, prepend=-1))
            ends = np.append(begins[1:], len(at))
            spread = np.maximum.reduceat(rate, begins) - np.minimum.reduceat(rate, begins)
            activity = spread / np.maximum.reduceat(width, begins)
        change = part.x_next - part.x
        held = np.all(part.u[1:] == part.u[:-1], axis=1) & (np.diff(part.k) == 1)
        noisy += (np.abs(change - movement) > np.abs(movement))[1:][held].sum(axis=0)
        some = part.x[:_DISTINCT]
        noisy[[len(np.unique(column)) < (1 - _TWICE) * len(column) for column in some.T]] = -np.inf
        repeats = np.add.reduceat((part.x == part.x_next).astype(np.float64), begins)
        counts = ends - begins
        whole = (counts >= 3) & (part.k[ends - 1] - part.k[begins] == counts - 1)
        activity[(2 * repeats >= counts[:, None]) | ~np.isfinite(activity)] = np.nan
        found.append(activity[whole])
    return np.concatenate([np.zeros((0, model.n)), *found]), np.maximum(noisy, -1.0)


FARTHER = 2.0
"""How many times what the recordings reached a measure must be, and a short repeat the longest of them."""

USUAL_S, USUAL = 0.25, 10
"""Seconds, and usual steps, up to which a repeat is usual if the fit has some half as long: a coarse sensor in motion.
The seconds must one of a state last that noise changes: a machine that stops does not stop in all states at once."""

_FAR_LONGER, _BY_CHANCE = 1.5, 2.1  # of repeats of up to `USUAL_S`, whose stamps may jitter

LEAST = 3
"""Steps that a repeat must have, but of a slow sensor that noise changes: two equal samples may be chance."""

REST_S, REST = 1.0, 2.5
"""Seconds and usual steps from which on a repeat of the fit was a machine at rest, and may be longer the next time."""

NOISY = 1000
"""Steps that must have shown the noise."""

SLOW_S, SLOW_NOISY = 0.5, 5000
"""Seconds that are enough in place of these steps if so many have shown the noise: of a slow sensor."""

Bounds = tuple[Sequence[float], Sequence[float], Sequence[float], bool]
"""Lower and upper bounds (n,), elements a_ii (n,), and whether a transition begins outside the fitted ranges."""


class Looked(NamedTuple):
    """What one transition says of repeats.

    `frozen`: states that are frozen at its end; empty for none; `withheld`: rows without a verdict, as they need one
    that is frozen at either end; `repeating`: other states that repeat for longer than ever in the fit.
    """

    frozen: tuple[Moved, ...] = ()
    withheld: tuple[int, ...] = ()
    repeating: tuple[Moved, ...] = ()


_NOTHING = Looked()


class FrozenWatch:
    """Tells frozen states, one transition after another.

    `repeats`: those of the fit; `margin`: of the bounds that it will be given; `counted`: states to look at: one that
    is masked is never frozen; `needs` (n, n): which rows need which states; `dt`: a usual step, s.
    """

    __slots__ = ("_follow", "_frozen", "_needed_by", "_needs", "_on", "repeats")

    def __init__(
        self, repeats: Repeats, margin: float, counted: Sequence[bool], needs: NDArray[np.bool_], dt: float
    ) -> None:
        self.repeats, self._needs = repeats, needs
        self._needed_by = [np.flatnonzero(column).tolist() for column in needs.T]
        longest, reached = repeats.longest_repeat_s, np.array([repeats.largest_run, repeats.largest_sum])
        known = np.isfinite(reached)  # of a model that was changed after its fit they are not
        beyond = np.vstack([np.maximum(1.0, FARTHER * np.where(known, reached, 0.0)), repeats.active_beyond])
        coarse = np.minimum(FARTHER * longest, max(USUAL_S, USUAL * dt))
        usual = np.where(known[0], np.maximum(coarse, (LEAST - 0.5) * dt), longest)
        noisy = np.where(longest == 0.0, repeats.noisy_steps, 0.0)
        by_noise = np.where(noisy >= NOISY, USUAL_S, np.inf), np.where(noisy >= SLOW_NOISY, SLOW_S, np.inf)
        thresholds = np.vstack([usual, longest, np.where(beyond < LARGEST, beyond, np.inf), *by_noise]).T
        self._follow = kernel.Repeating(thresholds, LEAST, max(REST_S, REST * dt), counted, margin)
        self.forget()

    def forget(self) -> None:
        """No transition leads to the next sample: nothing is known to repeat."""
        self._follow.forget()
        self._frozen: set[int] = set()
        self._on = False  # something repeats

    def look(
        self, t_ns: int, dt: float, before: Sequence[float], after: Sequence[float], bounds: Callable[[], Bounds]
    ) -> Looked:
        """Take one transition."""
        if not any(map(eq, before, after)):
            if not self._on:
                return _NOTHING
            withheld = self._rows(self._frozen)
            self.forget()
            return Looked(withheld=withheld)
        self._on = True
        longest, taken = self.repeats.longest_repeat_s, self._follow.take(t_ns, dt, before, after, *bounds())
        moved = [Moved(i, s, longest[i], self._why(i, code, size)) for i, s, code, size in taken]
        frozen = tuple(one for one in moved if one.why)
        now = {one.state for one in frozen}
        withheld, self._frozen = self._rows(self._frozen | now), now
        return Looked(frozen, withheld, tuple(one for one in moved if not one.why))

    def look_all(self, given: Followed) -> tuple[NDArray[np.uint8], NDArray[np.bool_], Callable[[int, int], str]]:
        """As `look`, many transitions: codes and rows withheld (K, n), and why a state is frozen after one of them."""
        codes, sizes = self._follow.take_all(*given)
        frozen = codes > kernel.LONGER
        stale = frozen | (np.roll(frozen, 1, axis=0) & given[0][:, None])
        withheld = np.zeros(frozen.shape, dtype=bool)
        for j in np.flatnonzero(stale.any(axis=0)):
            withheld[stale[:, j]] |= self._needs[:, j]
        return codes, withheld, lambda k, i: self._why(i, int(codes[k, i]), float(sizes[k, i]))

    def _rows(self, states: Iterable[int]) -> tuple[int, ...]:
        return tuple(sorted({i for j in states for i in self._needed_by[j]}))

    def _why(self, i: int, code: int, size: float) -> str:
        """Why a state is frozen, in words; empty if it is not."""
        repeats = self.repeats
        if code == kernel.BY_RUN:
            return _moved("the model moves it", size, repeats.largest_run[i])
        if code == kernel.BY_SUM:
            return _moved("the model's steps add up", size, repeats.largest_sum[i])
        if code == kernel.BY_ACTIVITY:
            active = f"{size:.3g} half-widths, and beyond {repeats.active_beyond[i]:.3g} it always moved"
            return f"while the machine is active: its rate by the model changes by {active}"
        if code == kernel.BY_NOISE:
            return f"while at constant controls noise changed it {repeats.noisy_steps[i]:.0f} times in the fit"
        return ""


def _moved(what: str, size: float, most: float) -> str:
    known = f" (at most {most:.3g} in the fit)" if most < LARGEST else ""
    return f"while {what} by {size:.3g} half-widths{known}"


def needs(model: Any) -> NDArray[np.bool_]:
    """Which rows need which states [i, j]: the own one, and any that over its fitted range moves them by a half-width.

    The half-width is that of a median step at the mean size of the fitted values.
    """
    domain, n = model.domain, model.n
    dt = model.sampling.dt_median or np.inf
    span, size = domain.greatest - domain.least, 0.5 * (abs(domain.least) + abs(domain.greatest))
    found = np.eye(n, dtype=bool)
    with np.errstate(invalid="ignore", over="ignore"):
        for block in model.blocks:
            half = dt * (block.dA @ size[:n] + block.dB @ size[n:] + block.dc) + block.v
            element = np.abs(block.A) + block.dA
            found |= (element > 0.0) & ~(dt * element * span[:n] <= np.minimum(half, LARGEST)[:, None])
    return found


class Partly:
    """A judgement without the verdicts on some rows, whose numbers are NaN.

    `judgement`: of all rows; `withheld`: those without a verdict; `counted` (n,): states whose violations count.
    """

    __slots__ = ("_values", "contained", "outside_domain", "unknown_regime", "violation")

    def __init__(self, judgement: Any, withheld: Sequence[int], counted: NDArray[np.bool_]) -> None:
        self._values = np.array([judgement.numbers(kind) for kind in range(kernel.UTILISATION + 1)], dtype=np.float64)
        self._values[:, list(withheld)] = np.nan
        left = self._values[kernel.FLAGS] == 1.0
        self.contained, self.violation = not left.any(), bool((left & counted).any())
        self.outside_domain, self.unknown_regime = judgement.outside_domain, judgement.unknown_regime

    def numbers(self, which: int) -> Any:
        """As of `Judgement`."""
        return array("d", self._values[which].tobytes())

    def packed(self) -> bytes:
        """As of `Judgement`."""
        return self._values.tobytes()


def far_longer(seconds: float, longest: float) -> bool:
    """Whether a repeat is worth a warning: one in three healthy recordings passes the longest of the fit a little."""
    return seconds > (_BY_CHANCE if seconds <= USUAL_S else _FAR_LONGER) * longest


def repeat_words(seconds: float, longest: float) -> str:
    """What is said of a repeat: what is longer than any of the fit, and how long those were."""
    now, most = (lasting(time / 3600.0) for time in (seconds, longest))
    said = f"repeats exactly for {now}"
    if now == most or seconds <= longest:
        return said
    return f"{said} ({f'at most {most}' if longest > 0.0 else 'never'} in the fit)"
