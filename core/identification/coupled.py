# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""(10) with full weights, which couple the rows: one programme of them all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import FitError
from uncertain_lti.identification.fleet import Fleet
from uncertain_lti.identification.passes import Moments
from uncertain_lti.identification.programmes import ROUGH, TIE_BREAK, Programmes
from uncertain_lti.identification.row import Chosen, InfeasibleError, Row
from uncertain_lti.identification.solvers import dual_bound, solve_qp


class Coupled:
    """The programme of all rows on their working sets, and how far its answer is from the optimum.

    `fleet`: the data; `sums`: of it; `programmes`: of all rows; `shared`: whether elements share their value.
    """

    def __init__(self, fleet: Fleet, sums: Moments, programmes: Sequence[Programmes], shared: bool) -> None:
        assert sums.coupled is not None
        self.fleet, self.sums, self.programmes, self.shared = fleet, sums, programmes, shared
        self.rows = [own.row for own in programmes]
        self.coupled: Array = sums.coupled
        self.gap = np.inf  # how far the answer is above the optimum at most, relative
        self._least_eigenvalue: float | None = None  # of the full weights, once it is needed

    def solve(self) -> str:
        """Solve it, and give the rows their parts."""
        rows, q_all = self.rows, len(self.sums.psi_scale)
        kept = self._kept(q_all)
        unit = np.concatenate([row.unit_psi * row.scale for row in rows])
        fixed = np.concatenate([row.fixed_d for row in rows])
        gram = kept.square(self.coupled) * np.outer(unit, unit)
        linear = kept.take(self.coupled @ fixed) * unit
        largest = float(np.diagonal(gram).max(initial=1e-300))
        starts = np.concatenate([[0], np.cumsum([row.r + row.q for row in rows])])
        where_d = np.concatenate([np.arange(starts[k] + row.r, starts[k + 1]) for k, row in enumerate(rows)])
        H, f = np.zeros((starts[-1], starts[-1])), np.zeros(starts[-1])
        parts = [row.containment(row.pool) for row in rows]
        G = np.zeros((sum(len(h) for _, h in parts), starts[-1]))
        line = 0
        for k, (row, (block, _)) in enumerate(zip(rows, parts, strict=True)):
            mine = slice(starts[k], starts[k + 1])
            mine_psi = slice(row.i * q_all, (row.i + 1) * q_all)
            diagonal = np.diagonal(row.psi_columns.square(self.coupled[mine_psi, mine_psi]))
            own = diagonal * (row.unit_psi * row.scale) ** 2 / largest
            H[mine, mine], f[mine] = row.hessian(np.diag(own), np.zeros(row.q), TIE_BREAK)
            G[line : line + len(block), mine] = block
            line += len(block)
        H[np.ix_(where_d, where_d)] = gram / largest + 1e-13 * np.diag(np.diagonal(gram) / largest)
        f[where_d] = linear / largest
        lower, upper = (np.concatenate([getattr(row, side) for row in rows]) for side in ("lower", "upper"))
        h = np.concatenate([h for _, h in parts])
        try:
            answer = solve_qp(H, f, G, h, lower, upper, feasible=ROUGH)
        except FitError:
            for row in rows:
                if found := self.programmes[row.i].contradiction():
                    raise InfeasibleError(row.i, *found) from None
            raise
        for k, row in enumerate(rows):
            row.store(answer.xi[starts[k] : starts[k + 1]])
        xi, d = answer.xi, answer.xi[where_d]
        above = float(0.5 * xi @ H @ xi + f @ xi) - dual_bound(H, f, G, h, lower, upper, xi)
        known = 0.5 * float(fixed @ self.coupled @ fixed) / largest
        value = 0.5 * float(d @ gram @ d) / largest + float(linear @ d) / largest + known
        least = sum(row.least_value() * row.scale**2 * self._weight(row) for row in rows) / largest
        lifted = 0.0
        for row, mine in zip(rows, starts[:-1], strict=True):
            smallest = float(np.linalg.eigvalsh(row.centre)[0]) if row.r else 1.0
            weight = float(np.diagonal(H)[mine : mine + row.r].max(initial=0.0))
            size = (row.rms_step / row.scale + float(np.abs(row.half).max(initial=0.0))) ** 2
            lifted += 0.5 * weight * 1e-10 * 16.0 * size / smallest if smallest > 1e-13 else np.inf
        # a tie-break per row, of full weights: no part of the squared widths, so measured against them
        ties = TIE_BREAK * float(len(d))
        self.gap = (max(above, 0.0) + lifted) / max(value, least, 1e-300) + ties
        self._slope: Array = (gram @ d + linear) / largest
        self._value = max(value, least, 1e-300)
        return answer.solver

    def _kept(self, q: int) -> Chosen:
        """The unknown half-widths of all rows among those of all, q per row."""
        first = np.concatenate([row.i * q + row.free_psi for row in self.rows])
        if not self.shared:
            return Chosen(first, None)
        members, before = [], 0
        for row in self.rows:
            own = row.psi_columns.members
            assert own is not None
            members.append(np.where(own >= 0, own + before, -1))
            before += row.q
        return Chosen(first, np.concatenate(members))

    def _at_most(self, row: Row) -> Array:
        """Largest scaled half-widths that the optimum of (10) with full weights can have, (q,) of the free ones.

        Σ w' W w over the samples is at least λ Σ w_ii w_i², with λ the least eigenvalue of any W whose diagonal is
        scaled to ones; and no product of two half-widths of a row is negative, so that each alone is bounded. What
        the row is now, lifted over what it violates, is no less than the optimum on the samples held.
        """
        if self._least_eigenvalue is None:
            self._least_eigenvalue = self.fleet.least_eigenvalue()
        flat = np.concatenate([other.d + other.outside() * other.size_unit * other.scale for other in self.rows])
        square = 4.0 * float(flat @ self.coupled @ flat)  # some room for what the structure does not let be lifted
        mine = slice(row.i * len(row.d), (row.i + 1) * len(row.d))
        own = row.psi_columns.take(np.diagonal(self.coupled)[mine]) * (row.unit_psi * row.scale) ** 2
        return np.asarray(np.sqrt(square / (max(self._least_eigenvalue, 1e-300) * np.maximum(own, 1e-300))))

    def _weight(self, row: Row) -> float:
        """Sum of w_ii over the transitions, about."""
        q, scale = len(self.sums.psi_scale), self.sums.psi_scale
        own = np.diagonal(self.coupled)[row.i * q : (row.i + 1) * q]
        there = scale > 0
        return float(np.max(own[there] / scale[there] ** 2, initial=0.0))

    def loss(self) -> float:
        """What lifting the half-widths over what is violated adds to the optimum, relative, about."""
        lifts = np.concatenate([np.full(row.q, row.outside()) for row in self.rows])
        return float(np.abs(self._slope) @ lifts) / self._value

    def linear_gap(self) -> float:
        """As `Row.linear_gap`; the rows meet in the objective alone.

        Unlike without full weights, the objective may fall as a half-width grows, by rounding at least: there the
        linearisation has no minimum but for what the squared widths themselves allow (`_at_most`).
        """
        flat = np.concatenate([row.d for row in self.rows])
        slopes = (self.coupled @ flat).reshape(len(self.rows), -1)
        least = sum(row.least_value() * row.scale**2 * self._weight(row) for row in self.rows)
        value = max(0.5 * float(flat @ slopes.ravel()), least, 1e-300)
        above = 0.0
        for row, own in zip(self.rows, slopes, strict=True):
            if not row.unknown:
                continue
            slope = row.psi_columns.take(own) * row.unit_psi * row.scale
            largest = float(np.abs(slope).max(initial=0.0))
            _, d = row.scaled()
            falls = bool((slope < 0.0).any())
            if not falls and largest * (float(d.sum()) + 1.0) <= 1e-12 * value:  # nothing to gain
                continue
            try:
                most = self._at_most(row) if falls else np.full(row.q, np.inf)
                above += float(slope @ d) - self.programmes[row.i].least_linear(slope / largest, most) * largest
            except FitError:
                return np.inf
        return max(above, 0.0) / value
