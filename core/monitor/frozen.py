# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Frozen inputs: a state that repeats exactly while the nominal model moves it.

A parked machine repeats too, so a repeat alone is a warning. A state is frozen if the nominal model, run over the
repeat, moves it by more than its half-width, and farther than over any repeat of the fit; twice as far if the fit has
repeats as long. Where another state has left the place that it had when the repeat began, the machine is not
parked: there the sum of the model's one-step movements counts like its run. Nor is it parked while it is as active
as in the recordings, and twice as active as over any repeat of theirs: then three repeats are enough. So they are over
a quarter second, of a state that noise changes at every step, also when the machine is at rest; unless the value is 0,
as of what is switched off, or all states repeat, as of a machine that is parked. A short repeat is usual up to twice
the longest of the fit, as a coarse sensor repeats by chance.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from operator import eq
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.limits import LARGEST
from uncertain_lti.kernel.arithmetic import FLAGS, UTILISATION
from uncertain_lti.model.repeats import Moved, Repeating, Repeats
from uncertain_lti.model.uncertain_lti import UncertainLTI

FARTHER = 2.0
"""How much farther than over any repeat of the fit the model must move a state whose repeat is no longer than those,
and how much longer a short one must be."""

USUAL_S = 0.25
"""Seconds up to which a repeat is usual, s, if the fit has repeats half as long: those of a coarse sensor in motion.
So long must one of a state last that noise changes: a machine that stops does not stop in all states at once."""

LEAST = 3
"""Steps that a repeat must have while the machine is active, or of a state that noise changes."""

NOISY = 1000
"""Steps that must have shown the noise."""

SLOW_S, SLOW_NOISY = 0.5, 5000
"""Seconds that are enough in place of these steps if so many have shown the noise: of a slow sensor."""

Bounds = tuple[Sequence[float], Sequence[float], Sequence[float]]
"""Of one transition: lower and upper bound (n,) each, recorded units, and the elements a_ii of the nominal model."""


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

    __slots__ = (
        "_counted",
        "_follow",
        "_frozen",
        "_longest",
        "_margin",
        "_needed_by",
        "_on",
        "_run",
        "_run_within",
        "_sum",
        "_active",
        "_noisy",
        "_usual",
    )

    def __init__(self, repeats: Repeats, margin: float, counted: Sequence[bool], needs: NDArray[np.bool_]) -> None:
        self._longest: list[float] = repeats.longest_repeat_s.tolist()
        run, total = repeats.largest_run, repeats.largest_sum
        # how far the model must move a state, by its run in a repeat that is no longer than those of the fit, and in a
        # longer one, and by its sum there
        self._run_within: list[float] = np.maximum(1.0, FARTHER * run).tolist()
        self._run: list[float] = np.maximum(1.0, np.where(np.isfinite(run), run, 0.0)).tolist()
        self._sum: list[float] = np.maximum(1.0, np.where(np.isfinite(total), total, 0.0)).tolist()
        self._usual = [min(FARTHER * seconds, USUAL_S) for seconds in self._longest]
        self._active: list[float] = repeats.active_beyond.tolist()
        self._noisy: list[float] = np.where(repeats.longest_repeat_s == 0.0, repeats.noisy_steps, 0.0).tolist()
        self._counted, self._margin = list(counted), margin
        self._needed_by = [np.flatnonzero(column).tolist() for column in needs.T]
        self._follow = Repeating(len(self._longest), margin)
        self.forget()

    def forget(self) -> None:
        """No transition leads to the next sample: nothing is known to repeat."""
        self._follow.forget()
        self._frozen: frozenset[int] = frozenset()
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
        lower, upper, own = bounds()
        still = len(after) > 1 and all(map(eq, before, after))  # as a parked machine is
        frozen, repeating = [], []
        for moved in self._follow.push(t_ns, dt, before, after, lower, upper, own):
            i = moved.state
            if not self._counted[i]:
                continue
            if i in self._frozen or self._is_frozen(moved, after, lower, upper, still):
                frozen.append(moved)
            elif moved.seconds > self._longest[i]:
                repeating.append(moved)
        now = frozenset(moved.state for moved in frozen)
        withheld, self._frozen = self._rows(self._frozen | now), now
        return Looked(tuple(frozen), withheld, tuple(repeating))

    def _rows(self, states: frozenset[int]) -> tuple[int, ...]:
        return tuple(sorted({i for j in states for i in self._needed_by[j]}))

    def _is_frozen(
        self, moved: Moved, after: Sequence[float], lower: Sequence[float], upper: Sequence[float], still: bool
    ) -> bool:
        i = moved.state
        if moved.seconds <= self._usual[i]:
            return False
        if moved.steps >= LEAST and moved.activity > self._active[i]:
            return True
        if self._noisy[i] >= NOISY and after[i] != 0.0 and not still:
            slow = moved.seconds >= SLOW_S and self._noisy[i] >= SLOW_NOISY
            if slow or (moved.steps >= LEAST and moved.seconds >= USUAL_S):
                return True
        if moved.seconds <= self._longest[i]:
            return moved.run > self._run_within[i]
        if moved.run > self._run[i]:
            return True
        return moved.sum > self._sum[i] and any(
            abs(value - start) > 0.5 * (high - low) / self._margin
            for value, start, low, high in zip(after, moved.start, lower, upper, strict=True)
        )


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
    what = repeat_words(moved.seconds, repeats.longest_repeat_s[moved.state])
    size, noisy = max(moved.run, moved.sum), repeats.noisy_steps[moved.state]
    if size <= 1.0 and moved.activity > repeats.active_beyond[moved.state]:
        return (
            f"{name} {what}, while the machine is active: its rate by the model changes by {moved.activity:.3g} "
            f"half-widths, and beyond {repeats.active_beyond[moved.state]:.3g} it always changed"
        )
    if size <= 1.0 and noisy >= NOISY:
        return f"{name} {what}; at constant controls noise changed it {noisy:.0f} times in the fit"
    return f"{name} {what}, while the model moves it by {size:.3g} half-widths"


def why_frozen(state: int, repeats: Repeats) -> str:
    """Why a repeat of this state may be called frozen."""
    noisy = repeats.noisy_steps[state] >= NOISY and repeats.longest_repeat_s[state] == 0.0
    return "while the model moves it" + (", or noise always changed it" if noisy else "")


def repeat_words(seconds: float, longest: float) -> str:
    """What is said of a repeat."""
    most = f"at most {longest:.3g} s" if longest > 0.0 else "never"
    return f"repeats exactly for {seconds:.3g} s ({most} in the fit)"
