# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""One row of the model: its unknowns, the samples held for it, and its small programmes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array, Index
from uncertain_lti.base.errors import FitError
from uncertain_lti.identification.columns import Columns
from uncertain_lti.identification.passes import Moments, Samples
from uncertain_lti.identification.solvers import (
    FEASIBLE,
    Answer,
    Simplex,
    dual_bound,
    linear_bound,
    solve_near,
    solve_qp,
)

TOLERANCE = 1e-11
"""Violation, in scaled units, below which a sample counts as contained; the repair lifts the rest."""
TIE_BREAK = 1e-8
"""Weight of the squared distance of the centre relative to the squared half-widths.

|rate - centre| <= half-width for every sample, so the sum of squared distances is at most that of squared half-widths,
and the optimum of the sum is within TIE_BREAK (relative) of the optimum of (10) alone, with the centre that the stated
tie-break asks for.
"""
ROUGH = 1e-4
"""Violation, in scaled units, up to which a first answer is worth judging: how good it is, is measured at the end."""
LEAST = 1e-9
"""Widths below this share of the steps themselves are rounding, and so is their distance from the optimum."""
COLLINEAR = 1e-11
"""Relative singular value of the columns below which the effect of a direction is lost in rounding."""
_EPS = float(np.finfo(np.float64).eps)
GOOD = 1e-7
"""Relative distance from the optimum, what the repair will add included, above which a row is solved once more, in
coordinates of its residual."""
WIDTH_SLACK = 2e-8
"""Relative room above δ of (11) in which its ties are broken: closer to δ, what they are is rounding."""
BOUNDED_TIE_BREAK = 1e-5
"""The same as TIE_BREAK among the optima of (11), a set so thin that the active-set solver needs the larger weight."""
REGULARISATION = 1e-4
"""Weight of the squared widths relative to δ in (11), for a solver of strictly convex programmes.

With a weight that is small enough, and a small one is, the minimum of the sum is that of δ, and among its optima that
of the squared widths. Whether it was is seen from the optimum of δ alone, at the end. With the unknowns of many blocks
it seldom is small enough, so they are left to the simplex method at once.
"""
_ATTEMPTS = ((1.0, 1e-10), (10.0, 1e-8), (100.0, 1e-6))  # factor on the tie-break's weight, ridge of the centre
_HELD = 12
"""Rows per unknown that the simplex method keeps from one working set to the next; its steps take longer with more."""
_HOLD = (1e-2, 1e-4, 1e-6)
"""Shares of the largest weight with which the ties of (11) are held back to where they were, one after the other."""
_ROOM = (1e-10, 1e-9, 1e-8)
"""Violation, in scaled units, that they may leave, tried in turn: the set of optima can be as thin as that."""
JOIN = 48  # samples that join a working set per round, at least; more if there are many unknowns


class InfeasibleError(FitError):
    """A row cannot contain a transition, whatever its elements within the structure.

    `row`: the row of the model; `index`: position of the transition; `distance`: how far it stays outside at best,
    normalised; `together`: how many other transitions it contradicts, if it could be contained without them.
    """

    def __init__(self, row: int, index: int, distance: float, together: int = 0) -> None:
        super().__init__(f"row {row} cannot contain transition {index}")
        self.row, self.index, self.distance, self.together = row, index, distance, together


@dataclass(frozen=True)
class Chosen:
    """Columns that are unknowns; several columns may be one unknown.

    `first` (u,): the first column of each unknown; `members` (size,): of each column its unknown, -1 for none; None
    where every unknown is one column.
    """

    first: Index
    members: Index | None

    @classmethod
    def of(cls, wanted: NDArray[np.bool_], shared: Index | None) -> Chosen:
        """Unknowns for the columns that are wanted.

        `wanted` (size,): alike for all that share; `shared` (size,): of each column the first that it shares its
        element with; None where none shares.
        """
        if shared is None:
            return cls(np.flatnonzero(wanted), None)
        first = np.flatnonzero(wanted & (shared == np.arange(len(shared))))
        place = np.full(len(shared), -1, dtype=np.intp)
        place[first] = np.arange(len(first))
        return cls(first, place[shared])

    @cached_property
    def matrix(self) -> Array:
        """1 where a column belongs to an unknown, (size, u)."""
        assert self.members is not None
        matrix: Array = (self.members[:, None] == np.arange(len(self.first))).astype(np.float64)
        return matrix

    def take(self, rows: Array) -> Array:
        """Rows of each unknown, summed.

        `rows` (size, ...): one for each column; Returns (u, ...): one for each unknown.
        """
        return rows[self.first] if self.members is None else self.matrix.T @ rows

    def square(self, gram: Array) -> Array:
        """A Gram matrix of the unknowns.

        `gram` (size, size): of the columns; Returns (u, u): of the unknowns.
        """
        if self.members is None:
            return gram[np.ix_(self.first, self.first)]
        return self.matrix.T @ gram @ self.matrix

    def put(self, elements: Array, values: Array | float) -> None:
        """Write the unknowns to all their columns.

        `elements` (size,): takes the result; `values` (u,): of each unknown.
        """
        if self.members is None:
            elements[self.first] = values
        else:
            there = self.members >= 0
            elements[there] = np.broadcast_to(values, len(self.first))[self.members[there]]


@dataclass(frozen=True)
class _Held:
    """Regressors (K, r) and (K, q) of samples, each over its size (K,); rows that see the same samples share them."""

    z: Array
    dt: Array
    s: Array | None
    phi: Array
    psi: Array
    size: Array


class Row:
    """One row of the model in scaled unknowns ξ = [θ d], with the samples held for it and the working set among them.

    Elements that the structure fixes, and columns that are 0 in every sample, are no unknowns.

    `i`: which row of the model; `sums`: of all data; `bounds`: of `Structure.stacked`; `shared` (r,): of each nominal
    element and each half-width the first that it shares its value with; default none but itself.
    """

    def __init__(
        self,
        i: int,
        sums: Moments,
        bounds: tuple[Array, Array, Array, Array],
        shared: tuple[Index, Index] | None = None,
    ) -> None:
        self.i = i
        self.sums = sums
        self._bounds = bounds
        self._shared = shared
        self.refined = False
        self.rounds = 0  # programmes solved
        self._held: _Held | None = None
        self.width: Array = np.empty(0)
        self.kept: float | None = None  # violation, in units of the size, of an answer of before that was good
        self.width_unit = 1.0  # of δ and `width`, in addition to scale: of order one in refined coordinates
        self.tolerance = TOLERANCE
        self._coordinates(float(sums.rate_scale[i]))
        self.samples = Samples.join([], len(sums.low))
        self.pool: Index = np.empty(0, dtype=np.intp)  # positions in samples
        self.limit: float | None = None  # δ of (11) in units of scale x width_unit
        self._unit = 1.0  # of the δ that the nominal elements alone decide, in units of the limit
        self.allowed = 0.0  # δ that the ties may have, in the same units
        self.exact = sums.visits.size > 1  # (11) by the simplex method
        self.least = 0.0  # δ of (11) that it found, in the same units as the limit
        self._forget()

    def _forget(self) -> None:
        """What solvers start from."""
        self.attempt = _ATTEMPTS[0]
        self._last: dict[str, Answer] = {}  # to the last programme of a kind
        self._simplex: Simplex | None = None
        self._known: Index = np.empty(0, dtype=np.intp)

    def _coordinates(self, scale: float) -> None:
        """Scaled unknowns: columns of unit size, elements in units of `scale` per step."""
        i, sums, bounds = self.i, self.sums, self._bounds
        self.scale = scale
        theta_low, theta_high, d_low, d_high = (b[:, i] for b in bounds)
        phi_scale, psi_scale = sums.phi_scale, sums.psi_scale
        if self._shared is not None:
            phi_scale, psi_scale = self._scales(sums.centre, 0), self._scales(sums.plain_gram, 1)
        dead_phi, dead_psi = phi_scale == 0, psi_scale == 0
        fixed_phi, fixed_psi = theta_low == theta_high, d_low == d_high
        self.theta = np.where(fixed_phi, theta_low, np.clip(0.0, theta_low, theta_high))
        self.d = np.where(fixed_psi, d_low, np.where(dead_psi, d_low, 0.0))
        self.phi_columns = Chosen.of(~dead_phi & ~fixed_phi, self._shared and self._shared[0])
        self.psi_columns = Chosen.of(~dead_psi & ~fixed_psi, self._shared and self._shared[1])
        self.free_phi, self.free_psi = self.phi_columns.first, self.psi_columns.first
        with np.errstate(divide="ignore"):
            unit_phi, unit_psi = 1.0 / phi_scale, 1.0 / psi_scale
        self.unit_phi, self.unit_psi = unit_phi[self.free_phi], unit_psi[self.free_psi]
        self.size_unit = np.where(dead_psi, 0.0, unit_psi)
        self.r, self.q = len(self.free_phi), len(self.free_psi)
        self.fixed_theta, self.fixed_d = self.theta.copy(), self.d.copy()
        self.phi_columns.put(self.fixed_theta, 0.0)
        self.psi_columns.put(self.fixed_d, 0.0)
        to_phi, to_psi = self.scale * self.unit_phi, self.scale * self.unit_psi
        self.lower = np.concatenate([theta_low[self.free_phi] / to_phi, d_low[self.free_psi] / to_psi])
        self.upper = np.concatenate([theta_high[self.free_phi] / to_phi, d_high[self.free_psi] / to_psi])
        self.centre = self.phi_columns.square(sums.centre) * np.outer(self.unit_phi, self.unit_phi) / sums.count
        target = sums.target[:, i] - sums.centre @ self.fixed_theta
        self.target = self.phi_columns.take(target) * self.unit_phi / (sums.count * self.scale)
        plain = self._gram(sums.plain_gram, sums.count)
        self.plain, self.plain_linear, _ = plain
        self.gram, self.linear, self.known = plain if sums.gram is None else self._gram(sums.gram[i], sums.count)
        self.basis: Array | None = None  # scaled θ = basis η, in refined coordinates
        self.asked: Array = np.empty((0, self.r))  # asked η >= asked_limits: constraints of the structure on θ there
        self.asked_limits: Array = np.empty(0)

    def _scales(self, gram: Array, which: int) -> Array:
        """Root mean squares of columns, each of those that share an element taken with the others."""
        assert self._shared is not None
        joined = np.zeros((len(gram), len(gram)))
        joined[np.arange(len(gram)), self._shared[which]] = 1.0
        squares = np.diagonal(joined.T @ gram @ joined) / self.sums.count
        return np.sqrt(np.maximum(squares, 0.0))[self._shared[which]]

    def refine(self) -> None:
        """Go over to coordinates in which the envelope has order one, however narrow and collinear the data.

        The elements are sought as differences from the least squares over the samples held, in units of the residual
        instead of the step, along directions of equal effect instead of columns. A solver's tolerance is then one on
        the envelope. It costs a decomposition, so rows are refined only if it matters.
        """
        samples, pool, limit = self.samples, self.pool, self.limit
        theta, d, before = self.theta, self.d, self.limit_unit
        phi = self._phi(samples)
        step = samples.rate * samples.dt
        fixed = self.theta.copy()
        self.phi_columns.put(fixed, 0.0)
        columns = (self.phi_columns.take(phi) * samples.dt).T * self.unit_phi
        left, values, right = np.linalg.svd(columns, full_matrices=False)
        keep = values > COLLINEAR * values.max(initial=0.0)
        inverse = right[keep].T / values[keep]
        base, residual = np.zeros(self.r), step - fixed @ phi * samples.dt
        for _ in range(2):  # the first leaves the rounding of large numbers
            change = inverse @ (left[:, keep].T @ residual)
            base, residual = base + change, residual - columns @ change
        low, high = (b[:, self.i][self.free_phi] for b in self._bounds[:2])
        base = np.clip(base * self.unit_phi, low, high)
        self.phi_columns.put(fixed, base)
        residual = step - fixed @ phi * samples.dt
        largest = float(np.abs(samples.z[self.i]).max(initial=0.0)) + float(np.abs(step).max(initial=0.0))
        rounding = _EPS * largest
        scale = max(float(np.sqrt(np.mean(residual**2))) if len(step) else 0.0, 4.0 * rounding, 1e-14 * self.rms_step)
        self._coordinates(scale)
        self.refined = True
        self.tolerance = max(TOLERANCE, 0.25 * rounding / scale)
        self.phi_columns.put(self.fixed_theta, base)
        self.lower[: self.r] -= base / (self.unit_phi * scale)
        self.upper[: self.r] -= base / (self.unit_phi * scale)
        target = self.sums.target[:, self.i] - self.sums.centre @ self.fixed_theta
        self.target = self.phi_columns.take(target) * self.unit_phi / (self.sums.count * scale)
        if self.r:
            root = np.sqrt(len(step))
            self.basis = inverse * root
            if values[keep].min(initial=np.inf) > 1e-5 * values.max(initial=0.0):
                self.centre = self.basis.T @ self.centre @ self.basis
                self.target = self.basis.T @ self.target
            else:  # sums of squares do not hold so small a difference, the samples do
                self.centre = np.eye(self.basis.shape[1])
                self.target = left[:, keep].T @ residual / (root * scale)
            low, high = self.lower[: self.r], self.upper[: self.r]
            there = np.concatenate([np.flatnonzero(np.isfinite(low)), np.flatnonzero(np.isfinite(high))])
            signs = np.repeat([1.0, -1.0], [int(np.isfinite(low).sum()), int(np.isfinite(high).sum())])
            asked = signs[:, None] * self.basis[there]
            size = np.maximum(np.abs(asked).max(axis=1, initial=0.0), 1e-300)
            limits = np.concatenate([low[np.isfinite(low)], -high[np.isfinite(high)]])
            self.asked, self.asked_limits = asked / size[:, None], limits / size
            self.r = self.basis.shape[1]
            self.lower = np.concatenate([np.full(self.r, -np.inf), self.lower[-self.q :] if self.q else np.empty(0)])
            self.upper = np.concatenate([np.full(self.r, np.inf), self.upper[-self.q :] if self.q else np.empty(0)])
        self.theta, self.d = theta, d
        self._forget()
        self.width_unit = 1.0
        self.hold(samples, self._columns)
        self.width_unit = float(np.sqrt(np.mean(self.width**2))) if len(samples) else 1.0
        self.width = self.width / self.width_unit
        self.limit = None if limit is None else limit * before / self.limit_unit
        self.pool = pool

    @property
    def limit_unit(self) -> float:
        """Of `limit`, in normalised units."""
        return self.scale * self.width_unit

    def _sizes(self, positions: Index | int) -> Array:
        """Size of held samples: the unit of their slack, with `scale`."""
        return np.asarray(self.width[positions] * self.width_unit / (2.0 * self.samples.root_weight[positions]))

    def _phi(self, samples: Samples) -> Array:
        return self._columns.phi(samples.z, samples.s)

    def _psi(self, samples: Samples) -> Array:
        return self._columns.psi(samples.z, samples.dt, samples.s)

    def scaled(self) -> tuple[Array, Array]:
        """Return the row's elements as differences from its fixed part, in scaled units.

        Returns (r,): of the nominal elements, without the basis, and of the half-widths.
        """
        theta, d = self.theta[self.free_phi], self.d[self.free_psi]
        if self.refined:
            theta = theta - self.fixed_theta[self.free_phi]
        return theta / (self.unit_phi * self.scale), d / (self.unit_psi * self.scale)

    def _gram(self, gram: Array, count: int) -> tuple[Array, Array, float]:
        """Squared widths as ½ dᵀ G d + gᵀ d + k in scaled units; G has order one."""
        unit = self.unit_psi
        inside = self.psi_columns.square(gram) * np.outer(unit, unit) / count
        linear = self.psi_columns.take(gram @ self.fixed_d) * unit / (count * self.scale)
        largest = float(np.diagonal(inside).max(initial=0.0)) or 1.0
        known = 0.5 * float(self.fixed_d @ gram @ self.fixed_d) / (count * self.scale**2)
        self.largest = largest
        return inside / largest, linear / largest, known / largest

    @property
    def unknown(self) -> bool:
        """Something is left to solve for."""
        return self.r + self.q > 0

    def start(self) -> None:
        """Start from least squares, with no half-width."""
        answer = np.linalg.lstsq(self.centre + 1e-12 * np.eye(self.r), self.target, rcond=None)[0].astype(np.float64)
        self.store(np.concatenate([np.clip(answer, self.lower[: self.r], self.upper[: self.r]), np.zeros(self.q)]))

    def store(self, answer: Array) -> None:
        """Take scaled unknowns as the row's elements.

        `answer` (r + q,): scaled unknowns ξ.
        """
        self._store_theta(answer[: self.r])
        d = np.maximum(answer[self.r :], np.maximum(self.lower[self.r :], 0.0))
        self.psi_columns.put(self.d, d * self.unit_psi * self.scale)

    def _store_limited(self, answer: Array) -> None:
        """Take [ξ δ]: δ is no less than the widths it limits, to the last bit.

        Where noise alone makes the widths, all samples are about as wide as the widest, and a δ that is short of it
        by the tolerance of a solver lets every one of them join the working set.
        """
        self.store(answer[:-1])
        _, d = self.scaled()
        widest = self.width[self.pool] * (self.psi[self.pool] @ d + self.half[self.pool])
        self.limit = max(float(answer[-1]), float(widest.max(initial=0.0)))

    def _store_theta(self, answer: Array) -> None:
        change = answer if self.basis is None else self.basis @ answer
        theta = change * self.unit_phi * self.scale
        self.phi_columns.put(self.theta, theta + self.fixed_theta[self.free_phi] if self.refined else theta)

    def hold(self, samples: Samples, columns: Columns, like: Row | None = None) -> None:
        """Hold these samples, and the working set so far; `like`: a row that may hold the same transitions."""
        self._columns = columns
        kept = self.samples[self.pool]
        if not np.isin(kept.index, samples.index).all():
            samples = Samples.join([samples, kept], len(samples.z))
        self.samples = samples
        self.pool = np.searchsorted(samples.index, kept.index)
        held = next((row._held for row in (self, like) if row is not None and row._holds(self)), None)
        self._held = held = held or self._divided(samples)
        self.plain_phi, self.psi, size = held.phi, held.psi, held.size
        fixed_phi = self.fixed_theta @ self._phi(samples) if self.fixed_theta.any() else 0.0
        fixed_psi = self.fixed_d @ self._psi(samples) if self.fixed_d.any() else np.zeros(len(samples))
        self.y = (samples.rate - fixed_phi) / (size * self.scale)
        self.half = fixed_psi / (size * self.scale)
        self.width = 2.0 * samples.root_weight * samples.dt * size  # √w x width = width x (ψ d + half)
        if self.refined:
            self.width = self.width / self.width_unit

    def _holds(self, other: Row) -> bool:
        """Whether this row has divided the samples of another as that one would."""
        held, samples = self._held, other.samples
        return (
            held is not None
            and (held.z is samples.z and held.dt is samples.dt and held.s is samples.s)
            and self._shared is None
            and np.array_equal(self.size_unit, other.size_unit)
            and np.array_equal(self.free_phi, other.free_phi)
            and np.array_equal(self.free_psi, other.free_psi)
        )

    def _divided(self, samples: Samples) -> _Held:
        """Each sample divided by its own size, so that one near rest weighs as any other."""
        psi = self._psi(samples)
        size = self.size_unit @ psi
        size[size == 0.0] = 1.0
        phi = ((self.phi_columns.take(self._phi(samples)) * self.unit_phi[:, None]) / size).T
        psi = ((self.psi_columns.take(psi) * self.unit_psi[:, None]) / size).T
        return _Held(samples.z, samples.dt, samples.s, phi, psi, size)

    def release(self) -> None:
        """Hold the working set alone, and what is outside by rounding."""
        outside = self.slack() < 0.0
        outside[self.pool] = False
        self.pool = np.concatenate([self.pool, np.flatnonzero(outside)])
        self.hold(self.samples[np.sort(self.pool)], self._columns)

    def _along(self, pool: Index) -> Array:
        """Regressors of the nominal unknowns of some samples, in the row's coordinates, (K, r)."""
        return self.plain_phi[pool] if self.basis is None else self.plain_phi[pool] @ self.basis

    def slacks(self) -> tuple[Array, Array | None]:
        """Slack of every held sample.

        Returns (K,): from leaving the bounds; Returns (K,): from being wider than (11) allows; None without a limit.
        """
        theta, d = self.scaled()
        half = self.psi @ d + self.half
        inside = half - np.abs(self.y - self.plain_phi @ theta)
        return inside, None if self.limit is None else self.limit / self.width - half

    def slack(self) -> Array:
        """Slack of every held sample, the lesser of both; see `passes.scan`.

        Returns (K,): negative where the sample is violated.
        """
        inside, room = self.slacks()
        return inside if room is None else np.minimum(inside, room)

    def reach(self, share: float) -> tuple[float, float]:
        """Slack below which so large a share of all samples is expected: from leaving the bounds, from being too wide.

        Where the widths of many samples are the largest one, which is so where noise alone makes them, only those
        that are too wide matter.
        """
        inside, room = self.slacks()
        least = 10 * self.tolerance
        wanted = max(float(np.quantile(inside, share)), least)
        width = 0.0 if room is None else float(np.quantile(room, share))
        return wanted, min(width, wanted) if width > 1e-6 else 0.0

    def widen_pool(self, most: int | None = None) -> bool:
        """Let the most violated held samples join the working set."""
        slack = self.slack()
        slack[self.pool] = np.inf
        outside = np.flatnonzero(slack < -self.tolerance)
        most = most or max(JOIN, 2 * (self.r + self.q))
        if len(outside) > most:
            outside = outside[np.argpartition(slack[outside], most)[:most]]
        self.pool = np.concatenate([self.pool, outside])
        return len(outside) > 0

    def containment(self, pool: Index) -> tuple[Array, Array]:
        """Containment (8)(9) of some samples as G ξ >= h.

        Returns (2 K, r + q): G; Returns (2 K,): h.
        """
        phi, psi = self._along(pool), self.psi[pool]
        y, half = self.y[pool], self.half[pool]
        return np.vstack([np.hstack([phi, psi]), np.hstack([-phi, psi])]), np.concatenate([y - half, -y - half])

    def hessian(self, gram: Array, linear: Array, tie_break: float, ridge: float = 1e-10) -> tuple[Array, Array]:
        """Objective of squared widths, plus the tie-break on the centre.

        `gram` (q, q): quadratic term of the half-widths; `linear` (q,): their linear term; Returns (r + q, r + q): H;
        Returns (r + q,): f.
        """
        H = np.zeros((self.r + self.q, self.r + self.q))
        diagonal = np.diagonal(gram)
        weight = tie_break * float(diagonal.min(initial=1.0))
        H[: self.r, : self.r] = weight * (self.centre + ridge * np.eye(self.r))
        H[self.r :, self.r :] = gram + 1e-13 * np.diag(diagonal)
        return H, np.concatenate([-weight * self.target, linear])

    # --- programmes of this row on its working set ---

    def _solve(
        self,
        kind: str,
        objective: Callable[[float, float], tuple[Array, Array]],
        G: Array,
        h: Array,
        lower: Array,
        upper: Array,
        any_solver: bool = False,
    ) -> tuple[Array, str]:
        """Solve a programme whose rows are some for each sample of the pool, from where the last of its kind ended.

        objective(factor on the tie-break, ridge) -> H, f. Raises FitError where DAQP, or any solver, gives up.
        """
        feasible = FEASIBLE if self.refined else ROUGH
        last, per_sample = self._last.get(kind), len(h) // max(len(self.pool), 1)
        start = None
        if last is not None and last.active is not None and per_sample:
            known = last.active[len(lower) : len(last.active) - len(self.asked)].reshape(per_sample, -1)
            known = known[:, : len(self.pool)]  # the pool grows, but for discards
            start = np.zeros(len(lower) + len(h) + len(self.asked), dtype=np.int32)
            start[: len(lower)] = last.active[: len(lower)]
            there = start[len(lower) : len(lower) + len(h)].reshape(per_sample, -1)
            there[:, : known.shape[1]] = known
        begin = np.zeros(len(lower)) if last is None else last.xi
        if last is None and self.basis is None:
            begin[: self.r] = self.scaled()[0]
        G, h = self._asked(G, h)
        for self.attempt in _ATTEMPTS:
            try:
                answer = solve_near(*objective(*self.attempt), G, h, lower, upper, begin, start, feasible)
                break
            except FitError:
                continue
        else:
            if not any_solver:
                raise FitError("DAQP could not solve the quadratic programme")
            answer = solve_qp(*objective(*self.attempt), G, h, lower, upper, feasible=feasible)
        self._last[kind] = answer
        return answer.xi, answer.solver

    def _asked(self, G: Array, h: Array) -> tuple[Array, Array]:
        """Rows G ξ >= h, and what the structure asks of θ if that is no bound of an unknown."""
        if not len(self.asked):
            return G, h
        rows = np.hstack([self.asked, np.zeros((len(self.asked), G.shape[1] - self.r))])
        return np.vstack([G, rows]), np.concatenate([h, self.asked_limits])

    def solve_quadratic(self) -> str:
        """Solve (10) on the working set."""
        answer, solver = self._solve(
            "quadratic",
            lambda factor, ridge: self.hessian(self.gram, self.linear, factor * TIE_BREAK, ridge),
            *self.containment(self.pool),
            self.lower,
            self.upper,
            any_solver=True,
        )
        self.store(answer)
        return solver

    def solve_regularised(self) -> str:
        """Solve (11) with a little of the squared widths on the working set."""
        size = self.r + self.q

        def objective(factor: float, ridge: float) -> tuple[Array, Array]:
            H, f = self.hessian(self.plain, self.plain_linear, factor * BOUNDED_TIE_BREAK, ridge)
            whole = REGULARISATION * np.eye(size + 1)
            whole[:size, :size] = REGULARISATION * H
            return whole, np.append(REGULARISATION * f, 1.0)

        answer, solver = self._solve(
            "regularised",
            objective,
            *self._rows(self.pool),
            np.append(self.lower, 0.0),
            np.append(self.upper, np.inf),
        )
        self._store_limited(answer)
        return solver

    def solve_linear(self) -> str:
        """Solve (11) on the working set, by the simplex method."""
        box = self.box
        if box is not None and self._simplex is None:
            self._unit = float(np.median(self.width[self.pool] if len(self.pool) else self.width))
        G, h = self._rows(self.pool) if box is None else self._distances(self.pool)
        kinds = 3 if box is None else 2
        number = kinds * np.tile(self.samples.index[self.pool], kinds) + np.repeat(np.arange(kinds), len(self.pool))
        there = np.zeros((kinds, len(self.samples)), dtype=bool)  # rows that the simplex method has
        if self._simplex is None:  # of each sample the side that it is on, and its width
            self._simplex = self._minimax() if box is None else self._nearest()
            theta, d = self.scaled()
            away = self.plain_phi[self.pool] @ theta - self.y[self.pool]
            half = self.psi[self.pool] @ d + self.half[self.pool]
            outside = np.concatenate([away + half, half - away]) < 0.0
            width = outside.reshape(2, -1).any(axis=0)
            wanted = np.concatenate([outside, width]) if box is None else outside
        else:
            wanted = G @ self._simplex.solution() - h < -TOLERANCE
            idle = self._simplex.idle(_HELD * (G.shape[1] - 1))
            idle = idle[idle >= len(self.asked)]  # those come first, and stay
            if len(idle):
                self._simplex.drop(idle)
                self._known = np.delete(self._known, idle - len(self.asked))
        there[self._known % kinds, np.searchsorted(self.samples.index, self._known // kinds)] = True
        others = ~there[:, self.pool].ravel()
        while True:  # of a sample few have more than one row that matters
            wanted &= others
            if wanted.any():
                self._simplex.add(G[wanted], h[wanted])
                self._known = np.concatenate([self._known, number[wanted]])
                others &= ~wanted
            answer = self._simplex.solve()
            wanted = G @ answer - h < -TOLERANCE
            if not (wanted & others).any():
                break
        if box is not None:
            delta = answer[-1] * self._unit
            answer = np.concatenate([answer[:-1], box * delta, [delta]])
        self.least = float(answer[-1])
        self._store_limited(answer)
        return "HiGHS simplex"

    @property
    def box(self) -> Array | None:
        """Scaled half-widths with which every sample is as wide as any other, by 1 in units of the limit.

        With them the largest distance of a recorded next sample from the centre is all that (11) has to make small:
        where half-widths exceed it nowhere, those of one size do so nowhere either. So the nominal elements are the
        only unknowns of δ, and what other half-widths are among its optima is left to the ties. None where the
        structure or the recordings have no such half-widths.
        """
        sums, columns = self.sums, self._columns
        least_known = self.fixed_d.any() or (self.lower[self.r :] > 0.0).any()
        if least_known or sums.gram is not None or sums.coupled is not None or not len(self.samples):
            return None
        for k, term in enumerate(columns.half, start=len(sums.low)):
            wanted, found = np.zeros((columns.count, len(self.d) // columns.count)), np.zeros(len(self.d))
            wanted[:, k] = 1.0
            unknown = wanted.ravel()[self.free_psi]
            self.psi_columns.put(found, unknown)
            there = self.size_unit > 0.0  # the others are 0 in every sample
            constant = not term.times_dt or sums.dt_min == sums.dt_max
            all_of_it = np.array_equal(found[there], wanted.ravel()[there])
            if constant and all_of_it and np.isinf(self.upper[self.r :][unknown > 0.0]).all():
                box = unknown / (self.unit_psi * self.scale)
                return np.asarray(box / (self.width[0] * float(self.psi[0] @ box)))
        return None

    def _distances(self, pool: Index) -> tuple[Array, Array]:
        """G [θ δ] >= h: the centre of samples of the pool is no further from the next sample than δ allows.

        δ is in units of order one, whatever the weights are.
        """
        width = self.width[pool] / self._unit
        unit = np.minimum(1.0, 1.0 / width)
        phi, y = self._along(pool) * (width * unit)[:, None], self.y[pool] * width * unit
        sides = np.hstack([phi, unit[:, None]]), np.hstack([-phi, unit[:, None]])
        return np.vstack(sides), np.concatenate([y, -y])

    def _nearest(self) -> Simplex:
        """As `_minimax`, of the nominal elements alone."""
        cost = np.append(np.zeros(self.r), 1.0)
        simplex = Simplex(cost, np.append(self.lower[: self.r], 0.0), np.append(self.upper[: self.r], np.inf))
        simplex.add(*self._asked(np.empty((0, len(cost))), np.empty(0)))
        return simplex

    def least_width(self) -> float:
        """A lower bound of δ, in units of scale: by multipliers, or the optimum on the samples that decide it."""
        assert self.limit is not None
        xi = np.concatenate([*self.scaled(), [self.limit]])
        cost = np.append(np.zeros(len(xi) - 1), 1.0)
        low, high = np.append(self.lower, 0.0), np.append(self.upper, np.inf)
        bound = linear_bound(cost, *self._rows(self.pool), low, high, xi)
        if self.limit <= (1.0 + 2.0 * WIDTH_SLACK) * bound:
            return bound
        inside, room = self.slacks()
        assert room is not None
        few = 2 * (self.r + self.q)
        inside, room = inside[self.pool], room[self.pool]
        least = np.argpartition(room, few)[:few] if len(room) > few else np.arange(len(room))
        decisive = np.union1d(np.flatnonzero(inside < 1e-7), least)
        bound = max(bound, 0.0)
        for pool in (self.pool[decisive], self.pool):
            simplex = self._minimax()
            simplex.add(*self._rows(pool))
            bound = max(bound, float(simplex.solve()[-1]))
            if self.limit <= (1.0 + 2.0 * WIDTH_SLACK) * bound:
                break
        return bound

    def _minimax(self) -> Simplex:
        """Minimise δ, the last unknown."""
        cost = np.append(np.zeros(self.r + self.q), 1.0)
        simplex = Simplex(cost, np.append(self.lower, 0.0), np.append(self.upper, np.inf))
        simplex.add(*self._asked(np.empty((0, len(cost))), np.empty(0)))
        return simplex

    def duality_gap(self) -> float:
        """How far the squared widths of this row are above the optimum at most, relative to it, by the dual objective.

        The programme that is solved adds the tie-break and the ridge to the squared widths; both are bounded. inf
        where the columns are so collinear that the ridge is not.
        """
        if not self.unknown:
            return 0.0
        theta, d = self.scaled()
        factor, ridge = self.attempt
        if self.basis is not None:
            theta = np.linalg.lstsq(self.basis, theta, rcond=None)[0].astype(np.float64)
        H, f = self.hessian(self.gram, self.linear, factor * TIE_BREAK, ridge)
        xi = np.concatenate([theta, d])
        bound = dual_bound(H, f, *self._asked(*self.containment(self.pool)), self.lower, self.upper, xi)
        value = max(self.value(d), self.least_value())
        weight = factor * TIE_BREAK * float(np.diagonal(self.gram).min(initial=1.0))
        spread = max(float(d @ self.plain @ d), 0.0)
        smallest = self._least_effect()
        largest = (self.rms_step / self.scale + np.sqrt(spread) + float(np.abs(self.half).max(initial=0.0))) ** 2
        lifted = 0.5 * weight * ridge * 4.0 * largest / smallest if smallest > 1e-13 else np.inf
        ties = factor * TIE_BREAK * (1.0 if self.sums.gram is None else float(len(d)))
        return float(max(0.5 * xi @ H @ xi + f @ xi - bound, 0.0) + lifted) / value + ties

    def _least_effect(self) -> float:
        """Least mean square effect that unknowns of unit length have on the centre, but for those that have none.

        A state or control that schedules the model moves with the drift of all knots: some elements can change
        together without moving any sample, and of those no one needs to be large.
        """
        free = np.isinf(self.lower[: self.r]) & np.isinf(self.upper[: self.r])
        values, directions = np.linalg.eigh(self.centre)
        for value, direction in zip(values.tolist(), directions.T, strict=True):
            if value > 1e-13 or not free[np.abs(direction) > COLLINEAR].all():
                return float(value)
            if (
                np.abs(self.plain_phi @ (direction if self.basis is None else self.basis @ direction)).max(initial=0.0)
                > COLLINEAR
            ):
                return float(value)
        return 1.0

    def among(self, coupled: Array, widths: list[Array]) -> None:
        """Take the row's part of (10) with full weights, given the other rows, as its own.

        `coupled` (n q, n q): of `Moments`; `widths` (q,): half-widths of all rows.
        """
        q = len(self.d)
        mine = slice(self.i * q, (self.i + 1) * q)
        unit = self.unit_psi * self.scale
        fixed = np.concatenate(widths)
        fixed[mine] = self.fixed_d
        gram = self.psi_columns.square(coupled[mine, mine]) * np.outer(unit, unit)
        self.largest = float(np.diagonal(gram).max(initial=0.0)) or 1.0
        self.gram = gram / self.largest
        self.linear = self.psi_columns.take(coupled[mine] @ fixed) * unit / self.largest

    def solve_among(self) -> str:
        """(10) with full weights, of this row given the others.

        If another row is wider by many orders of magnitude, what it weighs here is as many times steeper than the
        row's own part. Either this row follows it, and is solved in its units, or the row is as narrow as can be.
        """
        try:
            return self.solve_quadratic()
        except FitError:
            steep = float(np.abs(self.linear).max(initial=0.0))
            if steep <= 1.0:
                raise
        G, h = self._asked(*self.containment(self.pool))
        if -self.linear.min() >= self.linear.max():
            H, f = self.hessian(self.gram, self.linear, TIE_BREAK)
            answer = solve_qp(H, f / steep, G, h / steep, self.lower / steep, self.upper / steep)
            self.store(answer.xi * steep)
            return answer.solver
        simplex = Simplex(np.concatenate([np.zeros(self.r), self.linear / steep]), self.lower, self.upper)
        simplex.add(G, h)
        self.store(simplex.solve())
        return "HiGHS simplex"

    def value(self, d: Array) -> float:
        """Return half the mean of the squared half-widths of all samples, in scaled units.

        `d` (q,): scaled half-widths.
        """
        return max(float(0.5 * d @ self.gram @ d + self.linear @ d) + self.known, 0.0)

    def least_value(self) -> float:
        """Return the `value` of an envelope so narrow that it is rounding."""
        return 0.125 * (LEAST * self.rms_step / self.scale) ** 2

    def collinear(self) -> bool:
        """Tell whether columns are so alike that the simplex method's tolerance is none on the envelope."""
        return self.r > 0 and not self.refined and self._least_effect() < 1e-8

    @property
    def rms_step(self) -> float:
        """Root mean square of x_next - x."""
        return float(self.sums.rate_scale[self.i])

    def outside(self) -> float:
        """Return the largest violation of the samples held."""
        return max(0.0, -float(self.slack().min(initial=0.0)))

    def answer(self) -> tuple[Array, Array, float]:
        """Return what the row is now.

        Returns (r,): nominal elements, half-widths, and their largest violation in units of the size of a sample.
        """
        return self.theta.copy(), self.d.copy(), self.outside() * self.scale

    def keep(self, answer: tuple[Array, Array, float]) -> None:
        """Return to an answer of before.

        `answer` (array, array, float): what `answer` returned.
        """
        self.theta, self.d, self.kept = answer

    def least_linear(self, cost: Array, most: Array | None = None) -> float:
        """Minimise costᵀ d over scaled half-widths that contain the working set.

        `cost` (q,): of the free half-widths; `most` (q,): they are no larger than this.
        """
        upper = self.upper.copy()
        if most is not None:
            upper[self.r :] = np.minimum(upper[self.r :], most)
        simplex = Simplex(np.concatenate([np.zeros(self.r), cost]), self.lower, upper)
        simplex.add(*self._asked(*self.containment(self.pool)))
        return float(cost @ simplex.solve()[self.r :])

    def linear_gap(self) -> float:
        """As `duality_gap`, by the simplex method.

        (10) is convex, so its optimum is no less than its linearisation here at any elements that contain
        the working set. It needs neither multipliers nor a Hessian that can be inverted.
        """
        _, d = self.scaled()
        slope = self.gram @ d + self.linear
        largest = float(np.abs(slope).max(initial=0.0))
        if largest == 0.0:
            return 0.0
        try:
            least = self.least_linear(slope / largest) * largest
        except FitError:
            return np.inf
        return max(float(slope @ d) - least, 0.0) / max(self.value(d), self.least_value())

    def lifted_loss(self) -> float:
        """Estimate what lifting the half-widths over the violation that is left adds to the optimum."""
        _, d = self.scaled()
        outside = self.outside()
        if outside <= 0.0:
            return 0.0
        if self.limit is None:
            slope = float((self.gram @ d + self.linear).sum())
            return outside * slope / max(self.value(d), self.least_value())
        least = LEAST * self.rms_step / self.limit_unit * float(self.samples.root_weight.max(initial=0.0))
        return outside * float(self.width.max(initial=0.0)) / max(self.limit, least, 1e-300)

    def _rows(self, pool: Index) -> tuple[Array, Array]:
        """G [ξ δ] >= h: (8), (9) and the limit on the width for samples of the pool."""
        G, h = self.containment(pool)
        width = self.width[pool]
        unit = np.minimum(1.0, 1.0 / width)[:, None]  # δ - width x (ψ d + half) >= 0, scaled to order one
        rows = np.hstack([np.zeros((len(pool), self.r)), -width[:, None] * self.psi[pool], np.ones((len(pool), 1))])
        return (
            np.vstack([np.hstack([G, np.zeros((len(G), 1))]), rows * unit]),
            np.concatenate([h, width * self.half[pool] * unit[:, 0]]),
        )

    def solve_bounded(self) -> str:
        """Least squared widths, then the centre, among what is as good by (11), sought from an optimum of it.

        The set is so thin that a solver finds its way only if the step is held back at first; and if it finds none,
        containment gets some room, which the repair covers.
        """
        assert self.limit is not None and self._simplex is not None
        (point, box), pool = (self._simplex.solution(), self.box), self.pool
        point = point[:-1] if box is None else np.concatenate([point[:-1], box * (point[-1] * self._unit)])
        G, h = self.containment(pool)
        width = self.width[pool]
        unit = np.minimum(1.0, 1.0 / width)
        rows = np.hstack([np.zeros((len(pool), self.r)), -(width * unit)[:, None] * self.psi[pool]])
        limits = (width * self.half[pool] - self.allowed) * unit
        G, h = self._asked(np.vstack([G, rows]), np.concatenate([h, limits]))
        h = np.minimum(h - G @ point, 0.0)  # the point satisfies them, but for rounding
        H, f = self.hessian(self.plain, self.plain_linear, BOUNDED_TIE_BREAK)
        f, largest = f + H @ point, float(np.diagonal(H).max())
        step, solver, contained = np.zeros(len(point)), "HiGHS simplex", 2 * len(pool)
        around, active = h[:contained].copy(), None
        for room in _ROOM:
            h[:contained] -= room
            for share in _HOLD:
                hold = share * largest
                try:
                    held = H + hold * np.eye(len(step)), f - hold * step
                    low, high = self.lower - point, self.upper - point
                    feasible = _ROOM[-1] if self.refined else FEASIBLE
                    answer = solve_near(*held, G, h, low, high, step, active, feasible, any_solver=True)
                except FitError:
                    break
                left = max(0.0, -float((G[:contained] @ answer.xi - around).min(initial=0.0)))  # the repair covers it
                d = (point + answer.xi)[self.r :]
                if (width * (self.psi[pool] @ d + self.half[pool] + left)).max(initial=0.0) > (
                    1.0 + GOOD
                ) * self.allowed:
                    break
                step, solver, active = answer.xi, answer.solver, answer.active
            if step.any():
                break
        self.attempt = _ATTEMPTS[0]
        self._store_limited(np.append(point + step, self.allowed))
        return solver

    def polish(self) -> None:
        """Solve for the centre again, with the half-widths as they are: the tie-break on its own.

        Beside the squared widths it weighs so little that their rounding shows in the elements.
        """
        if self.r == 0:
            return
        phi, psi = self._along(self.pool), self.psi[self.pool]
        half = psi @ (self.d[self.free_psi] / (self.unit_psi * self.scale)) + self.half[self.pool]
        y = self.y[self.pool]
        try:
            answer = solve_qp(
                self.centre + self.attempt[1] * np.eye(self.r),
                -self.target,
                *self._asked(np.vstack([phi, -phi]), np.concatenate([y - half, -y - half])),
                self.lower[: self.r],
                self.upper[: self.r],
                any_solver=False,
                feasible=FEASIBLE if self.refined else ROUGH,
            )
        except FitError:  # the half-widths leave no room at all
            return
        self._store_theta(answer.xi)

    def contradiction(self) -> tuple[int, float, int] | None:
        """A sample that no elements within the structure can contain, alone or with others."""

        def least(pool: Index) -> tuple[Array, Array, Array]:
            simplex = self._minimax()
            G, h = self.containment(pool)
            simplex.add(np.hstack([G, np.ones((len(G), 1))]), h)
            answer = simplex.solve()
            prices = np.abs(simplex.duals()[len(self.asked) :]).reshape(2, -1).sum(axis=0)
            return answer, (h - G @ answer[:-1]).reshape(2, -1).max(axis=0), prices

        answer, short, prices = least(self.pool)
        if answer[-1] <= 1e-9:
            return None
        against = np.flatnonzero(prices > 1e-9 * prices.max(initial=0.0))  # they prove that there is no answer
        worst = int(against[np.argmax(short[against])]) if len(against) else int(np.argmax(short))
        distance, together = float(answer[-1]), len(against) - 1
        for position in against[np.argsort(-short[against])]:
            alone = float(least(self.pool[[position]])[0][-1])
            if alone > 1e-9:
                worst, distance, together = int(position), alone, 0
                break
        sample = int(self.pool[worst])
        return int(self.samples.index[sample]), distance * float(self._sizes(sample)) * self.scale, max(together, 0)
