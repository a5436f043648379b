"""Repeats: how long each state repeats exactly in healthy recordings, and how far the nominal model moves it meanwhile.

A repeat of state i is a run of transitions over which its recorded value stays the same, to the bit. With the step
:math:`Δt_j`, the centre of the bounds :math:`\\hat x_j` and the repeated value r, the nominal model moves the state by

    run_{j+1} = run_j + Δt_j a_ii run_j + (\\hat x_j - r),    sum_{j+1} = sum_j + (\\hat x_j - r)

both from 0 at the last fresh sample: the run is the state's own equation followed freely, with every other state as it
was recorded, and the sum holds the state where it was read. Both are given in half-widths, the largest of the repeat.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from uncertain_lti.base.errors import ModelError
from uncertain_lti.base.limits import LARGEST
from uncertain_lti.model.bounds import lower_of, upper_of
from uncertain_lti.model.terms import checked

_KEYS = ("longest_repeat_s", "largest_run", "largest_sum")


class Repeats:
    """What recordings of a healthy machine have of exact repeats, of each state.

    Parameters
    ----------
    longest_repeat_s : array (n,)
        The longest repeat, s; 0 for a state that never repeated.
    largest_run : array (n,), optional
        The farthest that the nominal model ran over any of them, in half-widths; default unknown, infinite.
    largest_sum : array (n,), optional
        The largest sum of its one-step movements, likewise.

    Raises
    ------
    ModelError
        The shapes do not fit one another, or a number is negative or not finite.
    """

    def __init__(
        self, longest_repeat_s: ArrayLike, largest_run: ArrayLike | None = None, largest_sum: ArrayLike | None = None
    ) -> None:
        self.longest_repeat_s = checked(longest_repeat_s, "frozen.longest_repeat_s", None)
        if self.longest_repeat_s.ndim != 1:
            raise ModelError("field 'frozen.longest_repeat_s' must be a list with one number per state")
        shape = self.longest_repeat_s.shape
        unknown = np.full(shape, np.inf)
        self.largest_run = unknown if largest_run is None else checked(largest_run, "frozen.largest_run", shape)
        self.largest_sum = unknown if largest_sum is None else checked(largest_sum, "frozen.largest_sum", shape)
        for name in _KEYS:
            array = getattr(self, name)
            array.flags.writeable = False
            if (array < 0).any():
                raise ModelError(f"field 'frozen.{name}' holds a negative number")

    def __repr__(self) -> str:
        return f"Repeats(longest {', '.join(f'{s:.3g} s' for s in self.longest_repeat_s)})"

    def to_dict(self) -> dict[str, list[float]]:
        """The form of the model file.

        Returns
        -------
        dict
            Plain data.
        """
        found = {name: getattr(self, name).tolist() for name in _KEYS}
        return {name: values for name, values in found.items() if np.isfinite(values).all()}

    @classmethod
    def from_dict(cls, data: Any) -> Repeats:
        """From the form of the model file.

        Parameters
        ----------
        data : object
            As JSON gives it.

        Returns
        -------
        Repeats
            What it holds.

        Raises
        ------
        ModelError
            It is not of that form; names the field.
        """
        if not isinstance(data, Mapping) or _KEYS[0] not in data:
            raise ModelError("field 'frozen' must be an object with longest_repeat_s; fit the model again")
        for key in data:
            if key not in _KEYS:
                raise ModelError(f"unknown field {reprlib.repr(f'frozen.{key}')}; known are {', '.join(_KEYS)}")
        return cls(**data)


class Moved(NamedTuple):
    """One repeat so far.

    Parameters
    ----------
    state : int
        Number of the state.
    seconds : float
        Since the last fresh sample, s.
    run : float
        How far the nominal model ran, in half-widths.
    sum : float
        Sum of its one-step movements, in half-widths, likewise without a sign.
    start : sequence of float (n,)
        The states at the last fresh sample, recorded units.
    """

    state: int
    seconds: float
    run: float
    sum: float
    start: Sequence[float]


class Repeating:
    """Follows the repeats of every state, one transition after another.

    Parameters
    ----------
    n : int
        Number of states.
    margin : float, default 1.0
        Of the bounds that it will be given.
    """

    __slots__ = ("_margin", "_of")

    def __init__(self, n: int, margin: float = 1.0) -> None:
        self._margin = margin
        # of each state: None, or [begin in ns, run, sum, largest half-width, the states then]
        self._of: list[list[Any] | None] = [None] * n

    def forget(self) -> None:
        """No transition leads to the next sample: every repeat ends."""
        self._of = [None] * len(self._of)

    def push(
        self,
        t_ns: int,
        dt: float,
        before: Sequence[float],
        after: Sequence[float],
        lower: Sequence[float],
        upper: Sequence[float],
        own: Sequence[float],
    ) -> list[Moved]:
        """Take one transition in which some state repeats; after one in which none does, `forget`.

        Parameters
        ----------
        t_ns : int
            Instant of its arrival, ns.
        dt : float
            Δt, s.
        before, after : sequence of float (n,), of which `before` may be longer
            States at its ends, recorded units.
        lower, upper : sequence of float (n,)
            Its bounds, recorded units.
        own : sequence of float (n,)
            The elements a_ii of the nominal model there, 1/s.

        Returns
        -------
        list of Moved
            One for each state that repeats.
        """
        found = []
        for i, value in enumerate(after):
            if value != before[i]:
                self._of[i] = None
                continue
            repeat = self._of[i]
            if repeat is None:
                repeat = self._of[i] = [t_ns - round(dt * 1e9), 0.0, 0.0, 0.0, before[: len(after)]]
            low, high = lower[i], upper[i]
            movement, half = 0.5 * (low + high) - value, 0.5 * (high - low) / self._margin
            repeat[1] += dt * own[i] * repeat[1] + movement
            repeat[2] += movement
            repeat[3] = half = max(repeat[3], half)
            seconds = (t_ns - repeat[0]) * 1e-9
            found.append(Moved(i, seconds, _over(abs(repeat[1]), half), _over(abs(repeat[2]), half), repeat[4]))
        return found


def _over(size: float, half: float) -> float:
    """A size in half-widths; any is beyond all where the half-width is 0."""
    return size / half if half > 0.0 else math.inf if size > 0.0 else 0.0


def repeats_of(model: Any, transients: Sequence[Any]) -> Repeats:
    """What recordings of a healthy machine have of exact repeats.

    Parameters
    ----------
    model : UncertainLTI
        Fitted to them; its nominal part is what runs over the repeats.
    transients : sequence of Transient
        The recordings.

    Returns
    -------
    Repeats
        Over all of them.
    """
    longest, run, total = (np.zeros(model.n) for _ in range(3))
    point = model.operating_point
    for transient in transients:
        steps = transient.transitions()
        rows = np.flatnonzero((steps.x == steps.x_next).any(axis=1))
        if not len(rows):
            continue
        chosen = np.zeros(len(steps.k), dtype=bool)
        chosen[rows] = True
        some = steps.take(chosen)
        with np.errstate(over="ignore", invalid="ignore"):
            z = model.normalised_columns(some)
            centre, half = np.empty((model.n, len(rows))), np.empty((model.n, len(rows)))
            model.columns_centre_and_half(z, some.dt, centre, half)
            lower, upper = (point.recorded_x(np.asarray(of(centre, half, 1.0)).T) for of in (lower_of, upper_of))
        values = (some.dt, some.x, some.x_next, lower, upper, model.own_rates(z).T)
        follow, last = Repeating(model.n), -2
        for k, t_ns, *each in zip(
            some.k.tolist(), transient.t_ns[some.k + 1].tolist(), *(a.tolist() for a in values), strict=True
        ):
            if k != last + 1:
                follow.forget()
            last = k
            for moved in follow.push(t_ns, *each):
                i = moved.state
                longest[i] = max(longest[i], moved.seconds)
                run[i], total[i] = max(run[i], moved.run), max(total[i], moved.sum)
    return Repeats(longest, np.minimum(run, LARGEST), np.minimum(total, LARGEST))
