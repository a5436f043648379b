# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Frozen inputs: a state that repeats exactly while the nominal model moves it.

A parked machine repeats too, so a repeat alone is a warning. A state is frozen if one of four measures of a repeat is
beyond its half-width and beyond twice what healthy recordings reached (`Repeats`): how far its own equation runs from
the repeated value; the sum of the movements, where another state has moved; how active the machine is meanwhile; or,
of a state that noise always changed, the time, unless the value is 0, as of what is switched off, or all states
repeat, as of a machine that is parked. Nothing counts outside the fitted domain, nor what a coarse sensor does by
chance.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Sequence
from operator import eq
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import LARGEST
from uncertain_lti.kernel.arithmetic import FLAGS, UTILISATION
from uncertain_lti.model.repeats import Moved, Repeating, Repeats, Transition
from uncertain_lti.model.uncertain_lti import UncertainLTI

FARTHER = 2.0
"""How many times what the recordings reached a measure must be, and a short repeat the longest of them."""

USUAL_S = 0.25
"""Seconds up to which a repeat is usual, s, if the fit has repeats half as long: those of a coarse sensor in motion.
So long must one of a state last that noise changes: a machine that stops does not stop in all states at once."""

LEAST = 3
"""Steps that a repeat must have while the machine is active, or of a state that noise changes."""

NOISY = 1000
"""Steps that must have shown the noise."""

SLOW_S, SLOW_NOISY = 0.5, 5000
"""Seconds that are enough in place of these steps if so many have shown the noise: of a slow sensor."""

Bounds = tuple[Sequence[float], Sequence[float], Sequence[float], bool]
"""What `Transition` has of bounds, nominal model and domain."""


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
    is masked is never frozen; `needs` (n, n): which rows need which states.
    """

    __slots__ = ("_beyond", "_counted", "_follow", "_frozen", "_margin", "_needed_by", "_on", "_usual", "repeats")

    def __init__(self, repeats: Repeats, margin: float, counted: Sequence[bool], needs: NDArray[np.bool_]) -> None:
        self.repeats, self._counted, self._margin = repeats, list(counted), margin
        self._needed_by = [np.flatnonzero(column).tolist() for column in needs.T]
        longest, reached = repeats.longest_repeat_s, np.array([repeats.largest_run, repeats.largest_sum])
        known = np.isfinite(reached)  # of a model that was changed after its fit they are not
        beyond = np.vstack([np.maximum(1.0, FARTHER * np.where(known, reached, 0.0)), repeats.active_beyond])
        self._beyond = np.where(beyond < LARGEST, beyond, np.inf).T.tolist()
        self._usual = np.where(known[0], np.minimum(FARTHER * longest, USUAL_S), longest).tolist()
        self._follow = Repeating(len(self._counted), margin)
        self.forget()

    def forget(self) -> None:
        """No transition leads to the next sample: nothing is known to repeat."""
        self._follow.forget()
        self._frozen: dict[int, str] = {}  # and why
        self._on = False  # something repeats

    def look(
        self,
        t_ns: int,
        dt: float,
        before: Sequence[float],
        after: Sequence[float],
        bounds: Callable[[], Bounds],
    ) -> Looked:
        """Take one transition."""
        if not any(map(eq, before, after)):
            if not self._on:
                return _NOTHING
            withheld = self._rows(self._frozen)
            self.forget()
            return Looked(withheld=withheld)
        return self.take(Transition(t_ns, dt, before, after, *bounds()))

    def take(self, step: Transition) -> Looked:
        """Take one in which some state repeats."""
        self._on = True
        frozen, repeating = [], []
        for moved in self._follow.push(step):
            i = moved.state
            if not self._counted[i]:
                continue
            if why := self._frozen.get(i) or ("" if step.outside else self._why(moved, step)):
                frozen.append(moved._replace(why=why))
            elif moved.seconds > self.repeats.longest_repeat_s[i] + step.dt / 2:  # not by jitter of its steps
                repeating.append(moved)
        now = {moved.state: moved.why for moved in frozen}
        withheld, self._frozen = self._rows(self._frozen | now), now
        return Looked(tuple(frozen), withheld, tuple(repeating))

    def _rows(self, states: Iterable[int]) -> tuple[int, ...]:
        return tuple(sorted({i for j in states for i in self._needed_by[j]}))

    def _why(self, moved: Moved, step: Transition) -> str:
        """Why a state is frozen, in words; empty if it is not."""
        i, repeats = moved.state, self.repeats
        run, total, active = self._beyond[i]
        if moved.seconds <= self._usual[i]:
            return ""
        if moved.run > run:
            return _moved("the model moves it", moved.run, repeats.largest_run[i])
        if moved.sum > total and moved.seconds > repeats.longest_repeat_s[i] and self._moves(moved, step):
            return _moved("the model's steps add up", moved.sum, repeats.largest_sum[i])
        if moved.steps >= LEAST and moved.activity > active:
            size = f"changes by {moved.activity:.3g} half-widths, and beyond {active:.3g} it always moved"
            return f"while the machine is active: its rate by the model {size}"
        noisy = repeats.noisy_steps[i] if repeats.longest_repeat_s[i] == 0.0 else 0
        slow = noisy >= SLOW_NOISY and moved.steps > 0 and moved.seconds >= SLOW_S
        if slow or (noisy >= NOISY and moved.steps >= LEAST and moved.seconds >= USUAL_S):
            parked = len(step.after) > 1 and all(map(eq, step.before, step.after))
            if step.after[i] != 0.0 and not parked:
                return f"while at constant controls noise changed it {noisy:.0f} times in the fit"
        return ""

    def _moves(self, moved: Moved, step: Transition) -> bool:
        """Some state has left the place that it had when the repeat began, so that the machine is not at rest."""
        return any(
            abs(value - start) > 0.5 * (high - low) / self._margin
            for value, start, low, high in zip(step.after, moved.start, step.lower, step.upper, strict=True)
        )


def _moved(what: str, size: float, most: float) -> str:
    known = f" (at most {most:.3g} in the fit)" if most < LARGEST else ""
    return f"while {what} by {size:.3g} half-widths{known}"


def needs(model: UncertainLTI) -> NDArray[np.bool_]:
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
        self._values = np.array([judgement.numbers(kind) for kind in range(UTILISATION + 1)], dtype=np.float64)
        self._values[:, list(withheld)] = np.nan
        left = self._values[FLAGS] == 1.0
        self.contained, self.violation = not left.any(), bool((left & counted).any())
        self.outside_domain, self.unknown_regime = judgement.outside_domain, judgement.unknown_regime

    def numbers(self, which: int) -> Any:
        """As of `Judgement`."""
        return array("d", self._values[which].tobytes())

    def packed(self) -> bytes:
        """As of `Judgement`."""
        return self._values.tobytes()


def frozen_words(name: str, moved: Moved, repeats: Repeats) -> str:
    """What is said of a frozen state."""
    return f"{name} {repeat_words(moved.seconds, repeats.longest_repeat_s[moved.state])}, {moved.why}"


def repeat_words(seconds: float, longest: float) -> str:
    """What is said of a repeat: what is longer than any of the fit, and how long those were."""
    said = f"repeats exactly for {seconds:.3g} s"
    if f"{seconds:.3g}" == f"{longest:.3g}" or seconds <= longest:
        return said
    return f"{said} ({f'at most {longest:.3g} s' if longest > 0.0 else 'never'} in the fit)"
