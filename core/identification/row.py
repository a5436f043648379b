# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""One row of the model: its scaled unknowns, and the samples held for it."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array, Index
from uncertain_lti.base.errors import UncertainLTIError
from uncertain_lti.identification.passes import Moments, Samples
from uncertain_lti.identification.problem import Columns

LEAST = 1e-9
"""Widths below this share of the steps themselves are rounding, and so is their distance from the optimum."""
_EPS = float(np.finfo(np.float64).eps)
COLLINEAR = 1e-11
"""Relative singular value of the columns below which the effect of a direction is lost in rounding."""
TOLERANCE = 1e-11
"""Violation, in scaled units, below which a sample counts as contained; the repair lifts the rest."""
JOIN = 48  # samples that join a working set per round, at least; more if there are many unknowns


class InfeasibleError(UncertainLTIError):
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

    `i`: which row of the model; `sums`: of all data; `columns`: terms that are unknown; `bounds`: of
    `Structure.unknowns`; `shared` (r,): of each nominal element and each half-width the first that it shares its value
    with; default none but itself.
    """

    def __init__(
        self,
        i: int,
        sums: Moments,
        columns: Columns,
        bounds: Sequence[Array],
        shared: Sequence[Index] | None = None,
    ) -> None:
        self.i = i
        self.sums, self.columns = sums, columns
        self._bounds = bounds
        self._shared = shared
        self.refined = False
        self._held: _Held | None = None
        self.width: Array = np.empty(0)
        self.kept: float | None = None  # violation, in units of the size, of an answer of before that was good
        self.width_unit = 1.0  # of δ and `width`, in addition to scale: of order one in refined coordinates
        self.tolerance = TOLERANCE
        self._coordinates(float(sums.rate_scale[i]))
        self.samples = Samples.join([], len(sums.low))
        self.pool: Index = np.empty(0, dtype=np.intp)  # positions in samples
        self.limit: float | None = None  # δ of (11) in units of scale x width_unit

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
        shared_phi, shared_psi = (None, None) if self._shared is None else self._shared
        self.phi_columns = Chosen.of(~dead_phi & ~fixed_phi, shared_phi)
        self.psi_columns = Chosen.of(~dead_psi & ~fixed_psi, shared_psi)
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
        plain = self._gram(sums.plain_gram)
        self.plain, self.plain_gradient, _ = plain
        self.gram, self.gradient, self.known = plain if sums.gram is None else self._gram(sums.gram[i])
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
        phi = self.columns.phi(samples.z, samples.s)
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
            asked = np.vstack([self.basis[np.isfinite(low)], -self.basis[np.isfinite(high)]])
            limits = np.concatenate([low[np.isfinite(low)], -high[np.isfinite(high)]])
            size = np.maximum(np.abs(asked).max(axis=1, initial=0.0), 1e-300)
            self.asked, self.asked_limits = asked / size[:, None], limits / size
            free = np.full(self.basis.shape[1], np.inf)
            self.lower, self.upper = np.append(-free, self.lower[self.r :]), np.append(free, self.upper[self.r :])
            self.r = len(free)
        self.theta, self.d = theta, d
        self.width_unit = 1.0
        self.hold(samples)
        self.width_unit = float(np.sqrt(np.mean(self.width**2))) if len(samples) else 1.0
        self.width = self.width / self.width_unit
        self.limit = None if limit is None else limit * before / self.limit_unit
        self.pool = pool

    @property
    def limit_unit(self) -> float:
        """Of `limit`, in normalised units."""
        return self.scale * self.width_unit

    def sizes(self, positions: Index | int) -> Array:
        """Size of held samples: the unit of their slack, with `scale`."""
        return np.asarray(self.width[positions] * self.width_unit / (2.0 * self.samples.root_weight[positions]))

    def scaled(self) -> tuple[Array, Array]:
        """Return the row's elements as differences from its fixed part, in scaled units.

        Returns (r,): of the nominal elements, without the basis, and of the half-widths.
        """
        theta, d = self.theta[self.free_phi], self.d[self.free_psi]
        if self.refined:
            theta = theta - self.fixed_theta[self.free_phi]
        return theta / (self.unit_phi * self.scale), d / (self.unit_psi * self.scale)

    def _gram(self, gram: Array) -> tuple[Array, Array, float]:
        """Squared widths as ½ dᵀ G d + gᵀ d + k in scaled units; G has order one."""
        unit, count = self.unit_psi, self.sums.count
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

    def start(self, near: tuple[Array, Array] | None = None) -> None:
        """Start from least squares, with no half-width, or from elements of the row that are near the optimum."""
        if near is not None:
            self.phi_columns.put(self.theta, near[0][self.free_phi])
            self.psi_columns.put(self.d, near[1][self.free_psi])
            return
        answer = np.linalg.lstsq(self.centre + 1e-12 * np.eye(self.r), self.target, rcond=None)[0].astype(np.float64)
        self.store(np.concatenate([np.clip(answer, self.lower[: self.r], self.upper[: self.r]), np.zeros(self.q)]))

    def store(self, answer: Array) -> None:
        """Take scaled unknowns as the row's elements.

        `answer` (r + q,): scaled unknowns ξ.
        """
        self.store_theta(answer[: self.r])
        d = np.maximum(answer[self.r :], np.maximum(self.lower[self.r :], 0.0))
        self.psi_columns.put(self.d, d * self.unit_psi * self.scale)

    def store_limited(self, answer: Array) -> None:
        """Take [ξ δ]: δ is no less than the widths it limits, to the last bit.

        Where noise alone makes the widths, all samples are about as wide as the widest, and a δ that is short of it
        by the tolerance of a solver lets every one of them join the working set.
        """
        self.store(answer[:-1])
        _, d = self.scaled()
        widest = self.width[self.pool] * (self.psi[self.pool] @ d + self.half[self.pool])
        self.limit = max(float(answer[-1]), float(widest.max(initial=0.0)))

    def store_theta(self, answer: Array) -> None:
        """Take scaled nominal unknowns, in the row's coordinates."""
        change = answer if self.basis is None else self.basis @ answer
        theta = change * self.unit_phi * self.scale
        self.phi_columns.put(self.theta, theta + self.fixed_theta[self.free_phi] if self.refined else theta)

    def hold(self, samples: Samples, like: Row | None = None) -> None:
        """Hold these samples, and the working set so far; `like`: a row that may hold the same transitions."""
        kept = self.samples[self.pool]
        if not kept.among(samples):
            samples = Samples.join([samples, kept], len(samples.z))
        self.samples = samples
        self.pool = np.searchsorted(samples.index, kept.index)
        held = next((row._held for row in (self, like) if row is not None and row._holds(self)), None)
        self._held = held = held or self._divided(samples)
        self.plain_phi, self.psi, size = held.phi, held.psi, held.size
        fixed_phi = self.fixed_theta @ self.columns.phi(samples.z, samples.s) if self.fixed_theta.any() else 0.0
        fixed_psi = np.zeros(len(samples))
        if self.fixed_d.any():
            fixed_psi = self.fixed_d @ self.columns.psi(samples.z, samples.dt, samples.s)
        self.y = (samples.rate - fixed_phi) / (size * self.scale)
        self.half = fixed_psi / (size * self.scale)
        self.width = 2.0 * samples.root_weight * samples.dt * size / self.width_unit  # x (ψ d + half) is √w x width

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
        psi = self.columns.psi(samples.z, samples.dt, samples.s)
        size = self.size_unit @ psi
        size[size == 0.0] = 1.0
        phi, psi = self.phi_columns.take(self.columns.phi(samples.z, samples.s)), self.psi_columns.take(psi)
        for rows, unit in ((phi, self.unit_phi), (psi, self.unit_psi)):  # copies, of many unknowns large ones
            rows *= unit[:, None]
            rows /= size
        return _Held(samples.z, samples.dt, samples.s, phi.T, psi.T, size)

    def along(self, pool: Index) -> Array:
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

    def nearest(self, count: int) -> Index:
        """Positions among all transitions of so many held samples, those of least slack of either kind first."""
        each = [np.argsort(slack)[:count] for slack in self.slacks() if slack is not None]
        return np.asarray(self.samples.index[np.column_stack(each).ravel()])

    def trial(self) -> Self:
        """A row that can be solved on its own, sharing what is only read."""
        trial = copy.copy(self)
        trial.theta, trial.d = self.theta.copy(), self.d.copy()
        return trial

    def drop(self, index: int) -> None:
        """Take a transition out of what the row holds."""
        keep = self.samples.index != index
        position = np.cumsum(keep) - 1
        self.pool = position[self.pool[keep[self.pool]]]
        self.samples = self.samples[keep]
        self.plain_phi, self.psi = self.plain_phi[keep], self.psi[keep]
        self.y, self.half, self.width = self.y[keep], self.half[keep], self.width[keep]

    def reach(self, share: float, evenly: NDArray[np.bool_]) -> tuple[float, float]:
        """Slack below which so large a share of all samples is expected: from leaving the bounds, from being too wide.

        `evenly` (K,): samples held that stand for all; where none is left, all do.

        Where the widths of many samples are the largest one, which is so where noise alone makes them, only those
        that are too wide matter.
        """
        inside, room = self.slacks()
        least, those = 10 * self.tolerance, evenly if evenly.any() else slice(None)
        wanted = max(float(np.quantile(inside[those], share)), least)
        width = 0.0 if room is None else float(np.quantile(room[those], share))
        return wanted, min(width, wanted) if width > 1e-6 else 0.0

    def widen_pool(self, most: int | None = None, below: float | None = None) -> bool:
        """Let the most violated held samples join the working set, or those nearest to that, of slack below this."""
        slack = self.slack()
        slack[self.pool] = np.inf
        outside = np.flatnonzero(slack < (-self.tolerance if below is None else below))
        most = most or max(JOIN, 2 * (self.r + self.q))
        if len(outside) > most:
            outside = outside[np.argpartition(slack[outside], most)[:most]]
        self.pool = np.concatenate([self.pool, outside])
        return len(outside) > 0

    def containment(self, pool: Index) -> tuple[Array, Array]:
        """Containment (8)(9) of some samples as G ξ >= h.

        Returns (2 K, r + q): G; Returns (2 K,): h.
        """
        phi, psi = self.along(pool), self.psi[pool]
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

    def join_others(self, coupled: Array, widths: list[Array]) -> None:
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
        self.gradient = self.psi_columns.take(coupled[mine] @ fixed) * unit / self.largest

    def value(self, d: Array) -> float:
        """Return half the mean of the squared half-widths of all samples, in scaled units.

        `d` (q,): scaled half-widths.
        """
        return max(float(0.5 * d @ self.gram @ d + self.gradient @ d) + self.known, 0.0)

    def least_value(self) -> float:
        """Return the `value` of an envelope so narrow that it is rounding."""
        return 0.125 * (LEAST * self.rms_step / self.scale) ** 2

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

    def take(self, theta: Array, d: Array, limit: float | None = None) -> None:
        """Take elements, and what (11) allows, as they are."""
        self.theta, self.d, self.limit = theta, d, limit

    def lifted_loss(self) -> float:
        """Estimate what lifting the half-widths over the violation that is left adds to the optimum of (10)."""
        _, d = self.scaled()
        outside = self.outside()
        slope = float((self.gram @ d + self.gradient).sum())
        return outside * slope / max(self.value(d), self.least_value()) if outside > 0.0 else 0.0
