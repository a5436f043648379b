# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Regressors of a transition: which unknowns a row has, and what each of them is multiplied with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import FitError, ModelError
from uncertain_lti.model.schedule import Schedule
from uncertain_lti.model.terms import ADDITIVE, TERMS, Term
from uncertain_lti.signals.signal_map import SignalMap
from uncertain_lti.signals.values import CHOICES, CHOICES_TEXT, Additive


@dataclass(frozen=True)
class Regimes:
    """A schedule, and where its signals are among those of a transition.

    `schedule`: knots and modes, normalised; `positions`: of each of its axes the row of [x; u; s].
    """

    schedule: Schedule
    positions: tuple[int, ...]

    @classmethod
    def of(cls, schedule: Schedule, signals: SignalMap) -> Regimes:
        """Where the signals of a schedule are."""
        try:
            return cls(schedule, schedule.positions([s.name for s in signals.signals]))
        except ModelError as error:
            raise FitError(str(error)) from None

    def vectors(self, z: Array, s: Array | None) -> Array:
        """Scheduling vectors.

        `z` (p, K): [x; u]; `s` (q, K): further scheduling signals; None if there are none; Returns (axes, K):
        normalised.
        """
        p = len(z)
        rows = [z[j] if j < p or s is None else s[j - p] for j in self.positions]
        return np.stack(rows)


@dataclass(frozen=True)
class Columns:
    """Which arrays of the additive terms are unknown besides A, B, ΔA, ΔB, and how many blocks of them all there are.

    The unknowns of a row are those of the first block, then those of the second, and so on.

    `names`: of "c", "dc" and "v", those that are; `regimes`: of a scheduled model; None for one block.
    """

    names: frozenset[str] = frozenset()
    regimes: Regimes | None = None

    @property
    def nominal(self) -> tuple[Term, ...]:
        """Terms whose nominal elements are unknown, in the order of the rows after those of A and B."""
        return tuple(term for term in ADDITIVE if term.nominal in self.names)

    @property
    def half(self) -> tuple[Term, ...]:
        """Terms whose half-widths are unknown, in the order of the rows after those of ΔA and ΔB."""
        return tuple(term for term in ADDITIVE if term.half in self.names)

    @property
    def extra(self) -> tuple[int, tuple[bool, ...]]:
        """How many additive terms have unknown nominal elements, and of each half-width whether Δt multiplies it."""
        return len(self.nominal), tuple(term.times_dt for term in self.half)

    @property
    def drift(self) -> bool:
        """Whether c is unknown."""
        return "c" in self.names

    @property
    def count(self) -> int:
        """Number of blocks, R."""
        return 1 if self.regimes is None else self.regimes.schedule.blocks

    def phi(self, z: Array, s: Array | None) -> Array:
        """Regressors φ of the nominal row: z, and 1 for each additive term; of R blocks, each times its weight.

        `z` (p, K): [x; u]; `s` (q, K): further scheduling signals; None if there are none; Returns (r, K): φ / Δt.
        """
        plain = np.vstack([z, np.ones((len(self.nominal), z.shape[1]))]) if self.nominal else z
        return self._weighted(plain, z, s)

    def psi(self, z: Array, dt: Array, s: Array | None) -> Array:
        """Regressors ψ of the half-width: |z|, and for each additive term 1 or, if Δt does not multiply it, 1/Δt.

        `z` (p, K): [x; u]; `dt` (K,): Δt, s; `s` (q, K): further scheduling signals; None if there are none; Returns
        (q, K): ψ / Δt; of R blocks, each times its weight.
        """
        p = len(z)
        psi = np.empty((p + len(self.half), z.shape[1]))
        np.abs(z, out=psi[:p])
        for row, term in zip(psi[p:], self.half, strict=True):
            row[:] = 1.0 if term.times_dt else 1.0 / dt
        return self._weighted(psi, z, s)

    def _weighted(self, base: Array, z: Array, s: Array | None) -> Array:
        """w(s) ⊗ base."""
        if self.regimes is None:
            return base
        weights = self.regimes.schedule.weights(self.regimes.vectors(z, s))
        return (weights[:, None] * base).reshape(-1, z.shape[1])

    def arrays(self, theta: Array, d: Array) -> dict[str, Any]:
        """The unknowns as arrays by the names of the terms; with a schedule, a first axis of blocks.

        `theta` (r, n): nominal elements, one column per row of the model; `d` (q, n): half-widths of the same shape.
        """
        n, found = theta.shape[1], dict[str, Any]()
        for which, elements, additive in (("nominal", theta, self.nominal), ("half", d, self.half)):
            rows, start = elements.reshape(self.count, -1, n), 0
            p = rows.shape[1] - len(additive)
            for term in (*(term for term in TERMS if term.required), *additive):
                size = {"x": n, "u": p - n, "1": 1}[term.regressor]
                values = rows[:, start : start + size].transpose(0, 2, 1)
                found[getattr(term, which)] = values[:, :, 0] if term.regressor == "1" else values
                start += size
        return found if self.regimes is not None else {name: values[0] for name, values in found.items()}

    def unknowns(self, p: int) -> int:
        """Number of unknowns per row and block with p states and controls."""
        return 2 * p + len(self.names)

    @classmethod
    def of(cls, additive: Additive, constant_dt: bool, regimes: Regimes | None = None) -> Columns:
        """For an `additive` option.

        With a constant Δt, Δt·dc + v is one number: v takes it and dc is 0, because v is the one that still
        holds when another recording has another Δt. With a schedule c is unknown together with every
        additive term: it carries the steady state from knot to knot. Without such a term c is 0, as at rest its
        rounding would have no half-width to lie in.
        """
        if additive not in CHOICES:
            raise FitError(f"additive is {additive!r}; it must be {CHOICES_TEXT}")
        names = {"none": "", "disturbance": "c dc", "noise": "v", "both": "c v" if constant_dt else "c dc v"}
        drift = () if regimes is None or additive == "none" else ("c",)
        return cls(frozenset((*names[additive].split(), *drift)), regimes)
