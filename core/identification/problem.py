# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The identification problem: its regressors, its transitions as arrays, whole and in blocks, and it as written."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array, Index
from uncertain_lti.base.errors import FitError, ModelError
from uncertain_lti.model.schedule import Schedule
from uncertain_lti.model.terms import ADDITIVE, TERMS, Term
from uncertain_lti.signals.signal_map import SignalMap
from uncertain_lti.signals.values import CHOICES, CHOICES_TEXT, CRITERIA, Additive

BLOCK = 32768
"""Transitions that a pass takes at a time, and that are read from disk together."""


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
        return np.stack([row_of(z, s, j) for j in self.positions])


def row_of(z: Array, s: Array | None, j: int) -> Array:
    """A row of [z; s]."""
    row: Array = z[j] if j < len(z) or s is None else s[j - len(z)]
    return row


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
        if not isinstance(additive, str) or additive not in CHOICES:
            raise FitError(f"additive is {additive!r}; it must be {CHOICES_TEXT}")
        names = set(CHOICES[additive].split())
        if constant_dt and "v" in names:
            names.discard("dc")
        if regimes is not None and names:
            names.add("c")
        return cls(frozenset(names), regimes)


@dataclass(frozen=True)
class Block:
    """Some transitions, normalised, in columns.

    `z` (p, K): [x; u]; `x_next` (n, K): next states; `dt` (K,): Δt, s; `weights` (n,): W(t_{k+1}); `s` (q, K):
    scheduling signals that are neither state nor control; `base` (n, K): what a step is counted from, over a horizon
    the run of the nominal model; default the states; `start`: position of the first among those of the partition.
    """

    z: Array
    x_next: Array
    dt: Array
    weights: Array
    s: Array | None = None
    base: Array | None = None
    start: int = 0

    def __len__(self) -> int:
        return len(self.dt)

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.x_next)

    @property
    def origin(self) -> Array:
        """What a step is counted from, (n, K)."""
        return self.z[: self.n] if self.base is None else self.base

    def root_weights(self) -> Array:
        """Roots of the diagonal weights, √w_ii(t_{k+1}), (n, K)."""
        if self.weights.ndim == 1:
            return np.sqrt(self.weights)[:, None]
        diagonal = np.diagonal(self.weights, axis1=1, axis2=2) if self.weights.ndim == 3 else self.weights
        return np.sqrt(diagonal).T

    def subset(self, index: Index | NDArray[np.bool_] | slice) -> Self:
        """Some of them; a slice is no copy."""
        z, x_next = self.z[:, index], self.x_next[:, index]
        if not isinstance(index, slice):  # numpy would lay the copy out in rows
            z, x_next = np.ascontiguousarray(z), np.ascontiguousarray(x_next)
        weights = self.weights if self.weights.ndim == 1 else self.weights[index]
        s, base = (None if rows is None else rows[:, index] for rows in (self.s, self.base))
        return replace(self, z=z, x_next=x_next, dt=self.dt[index], weights=weights, s=s, base=base)


@dataclass(frozen=True)
class Problem(Block):
    """Usable transitions in memory, of all recordings, or a part of them.

    They are in the form

        |rate_i - (z·θ_i + c_i)| <= |z|·d_i + dc_i + v_i / Δt       for every transition and row i,

    where rate = (x_next - x) / Δt, which is (8)(9) of Leibov (2006) divided by Δt_k. θ_i is row i of [A B], d_i of
    [ΔA ΔB].

    `source` (N,): transient that a transition comes from; `k` (N,): its sample in that transient; `columns`: terms that
    are unknown.
    """

    source: Index = field(kw_only=True)
    k: Index = field(kw_only=True)
    columns: Columns = field(kw_only=True)

    @property
    def N(self) -> int:
        """Number of transitions."""
        return len(self.dt)

    @property
    def p(self) -> int:
        """Number of states and controls."""
        return len(self.z)

    @property
    def order(self) -> Index:
        """Numbers of the samples (N,), with those of another recording never following."""
        return self.k + self.source * (int(self.k.max(initial=0)) + 2)

    def largest_moves(self) -> Array:
        """The largest change of each state in one transition, (n,)."""
        moves = [np.abs(block.x_next - block.z[: self.n]).max(axis=1) for block in self.blocks()]
        return np.asarray(np.max(moves, axis=0))

    def blocks(self) -> Iterator[Block]:
        """All transitions, in blocks."""
        for start in range(0, self.N, BLOCK):
            yield replace(self.subset(slice(start, start + BLOCK)), start=start)

    def rate(self) -> Array:
        """(x_next - x) / Δt with samples in rows, (N, n), 1/s."""
        return ((self.x_next - self.origin) / self.dt).T

    def phi(self) -> Array:
        """Regressors of the nominal row with samples in rows, (N, r), as of `Columns.phi`."""
        return self.columns.phi(self.z, self.s).T

    def psi(self) -> Array:
        """Regressors of the half-width with samples in rows, (N, q), as of `Columns.psi`."""
        return self.columns.psi(self.z, self.dt, self.s).T

    def row_weights(self) -> Array:
        """Diagonal weights w_ii(t_{k+1}) with samples in rows, (N, n)."""
        return np.broadcast_to(self.root_weights().T ** 2, (self.N, self.n))

    def subset(self, index: Index | NDArray[np.bool_] | slice) -> Self:
        """The same problem on some transitions; a slice is no copy."""
        return replace(super().subset(index), source=self.source[index], k=self.k[index])

    def without(self, index: NDArray[np.intp]) -> Problem:
        """The same problem without some transitions."""
        keep = np.ones(self.N, dtype=bool)
        keep[index] = False
        return self.subset(keep)


@dataclass(frozen=True)
class DiskPartition:
    """Usable transitions, normalised, in a file: blocks of [z; s; x_next; Δt] as float64, read again by every pass.

    Only one block is in memory at a time.

    `path`: written by `archive.write_cache`; `sizes`: transitions of each block; `n`: number of states; `p`: number of
    states and controls; `q`: number of further scheduling signals; `weights` (n,): constant in time; `columns`: terms
    that are unknown.
    """

    path: Path
    sizes: Sequence[int]
    n: int
    p: int
    q: int
    weights: Array
    columns: Columns

    @property
    def N(self) -> int:
        """Number of transitions."""
        return sum(self.sizes)

    def blocks(self) -> Iterator[Block]:
        """All transitions, in the blocks they were written in."""
        first, start = self.p + self.q, 0
        lines = first + self.n + 1
        with open(self.path, "rb", buffering=0) as stream:
            for size in self.sizes:
                data = np.fromfile(stream, dtype="<f8", count=lines * size)
                if len(data) < lines * size:
                    raise FitError(f"{self.path.parent}: the cache is cut short; delete the folder and fit again")
                table = data.reshape(lines, size)
                s = table[self.p : first] if self.q else None
                yield Block(table[: self.p], table[first:-1], table[-1], self.weights, s, start=start)
                start += size


def check_criterion(criterion: str) -> None:
    """Refuse a criterion that there is not."""
    if not isinstance(criterion, str) or criterion not in CRITERIA:
        raise FitError(f"criterion is {criterion!r}; it must be {' or '.join(CRITERIA)}")


Partition = Problem | DiskPartition
"""What the passes over all data take."""


def solve_as_written(
    problem: Problem, criterion: str, solver: str | None = None, **options: Any
) -> tuple[Array, Array, Array]:
    """Solve (10), or (11) row by row, over all samples at once, as written (docs/theory.md): an independent answer.

    Returns (r, n): nominal elements, one column per row of the model, 1/s; Returns (q, n): half-widths likewise.
    """
    import cvxpy as cp

    dt = problem.dt[:, None]
    phi, psi, increment = problem.phi() * dt, problem.psi() * dt, problem.rate() * dt
    # columns of order one: the same problem, and the difference between an answer and none for first-order solvers
    unit_phi, unit_psi, unit_y = (_unit(a) for a in (phi, psi, increment))
    phi, psi, increment = phi / unit_phi, psi / unit_psi, increment / unit_y
    n = problem.n
    theta, d = cp.Variable((phi.shape[1], n)), cp.Variable((psi.shape[1], n), nonneg=True)
    centre, half = phi @ theta, psi @ d
    contained = [centre - half <= increment, centre + half >= increment]
    width = 2.0 * half
    if criterion == "qp":
        weights = problem.weights
        if weights.ndim == 3:
            chol = np.linalg.cholesky(weights * np.outer(unit_y, unit_y))  # W = L Lᵀ, so wᵀW w = |Lᵀ w|²
            terms = [cp.sum([cp.multiply(chol[:, j, i], width[:, j]) for j in range(i, n)]) for i in range(n)]
            objective = cp.sum([cp.sum_squares(t) for t in terms])
        else:
            root = np.sqrt(problem.row_weights()) * unit_y
            objective = cp.sum_squares(cp.multiply(root, width))
        scale = float(np.mean(unit_y) ** 2)
        programme = cp.Problem(cp.Minimize(objective / scale), contained)
        if solver is None:
            solver = cp.OSQP
            options = {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 200_000, "polishing": True} | options
        _run(programme, solver, options)
        values = np.array([programme.value * scale])
    else:
        root = np.sqrt(problem.row_weights())
        delta = cp.Variable(n, nonneg=True)
        limited = [cp.multiply(root[:, i], width[:, i]) <= delta[i] for i in range(n)]
        programme = cp.Problem(cp.Minimize(cp.sum(delta)), contained + limited)  # rows do not meet
        _run(programme, solver or cp.HIGHS, options)
        values = np.asarray(delta.value) * unit_y
    nominal = np.asarray(theta.value) / unit_phi[:, None] * unit_y
    return nominal, np.maximum(np.asarray(d.value), 0.0) / unit_psi[:, None] * unit_y, values


def _unit(columns: Array) -> Array:
    size = np.sqrt(np.mean(columns**2, axis=0))
    return np.where(size > 0, size, 1.0)


def _run(programme: Any, solver: str, options: dict[str, Any]) -> None:
    import cvxpy as cp

    try:
        programme.solve(solver=solver, **options)
    except cp.error.SolverError as error:
        raise FitError(f"cvxpy with {solver} found no optimum ({error}); use the working-set method") from None
    if programme.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        raise FitError(f"cvxpy with {solver} ended as '{programme.status}'; use the working-set method")
