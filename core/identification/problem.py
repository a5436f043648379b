# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The identification problem as arrays: the transitions of a fit, in memory or in a file, whole and in blocks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import FitError
from uncertain_lti.identification.columns import Columns

BLOCK = 32768
"""Transitions that a pass takes at a time, and that are read from disk together."""


@dataclass(frozen=True)
class Block:
    """Some transitions in columns.

    `start`: position of the first among those of the partition; `z` (p, K): [x; u]; `x_next` (n, K): next states; `dt`
    (K,): Δt, s; `weights` (n,): W(t_{k+1}); `s` (q, K): scheduling signals that are neither state nor control; `base`
    (n, K): what a step is counted from, over a horizon the run of the nominal model; default the states.
    """

    start: int
    z: Array
    x_next: Array
    dt: Array
    weights: Array
    s: Array | None = None
    base: Array | None = None

    def __len__(self) -> int:
        return len(self.dt)

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.x_next)

    def every(self, first: int, stride: int) -> Block:
        """A copy of every stride-th transition from the first."""
        part = slice(first, None, stride)
        weights = self.weights if self.weights.ndim == 1 else self.weights[part].copy()
        s, base = (None if rows is None else rows[:, part].copy() for rows in (self.s, self.base))
        z, x_next, dt = self.z[:, part].copy(), self.x_next[:, part].copy(), self.dt[part].copy()
        return Block(self.start, z, x_next, dt, weights, s, base)

    @property
    def origin(self) -> Array:
        """What a step is counted from, (n, K)."""
        return self.z[: self.n] if self.base is None else self.base

    def root_weights(self) -> Array:
        """Roots of the diagonal weights.

        Returns (n, K): √w_ii(t_{k+1}).
        """
        if self.weights.ndim == 1:
            return np.sqrt(self.weights)[:, None]
        diagonal = np.diagonal(self.weights, axis1=1, axis2=2) if self.weights.ndim == 3 else self.weights
        return np.sqrt(diagonal).T


@dataclass(frozen=True)
class Problem:
    """Usable transitions, normalised, in memory; of all recordings, or a part of them.

    They are in the form

        |rate_i - (z·θ_i + c_i)| <= |z|·d_i + dc_i + v_i / Δt       for every transition and row i,

    where rate = (x_next - x) / Δt, which is (8)(9) of Leibov (2006) divided by Δt_k. θ_i is row i of [A B], d_i of
    [ΔA ΔB].

    `z_columns` (p, N): [x; u], samples in columns; `next_columns` (n, N): next states, samples in columns; `dt` (N,):
    Δt, s; `source` (N,): transient that a transition comes from; `k` (N,): its sample in that transient; `weights`
    (n,): W(t_{k+1}); `columns`: terms that are unknown; `s_columns` (q, N): scheduling signals that are neither state
    nor control, samples in columns; `base_columns` (n, N): what a step is counted from, over a horizon the run of the
    nominal model; default the states.
    """

    z_columns: Array
    next_columns: Array
    dt: Array
    source: NDArray[np.intp]
    k: NDArray[np.intp]
    weights: Array
    columns: Columns
    s_columns: Array | None = None
    base_columns: Array | None = None

    @property
    def N(self) -> int:
        """Number of transitions."""
        return len(self.dt)

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.next_columns)

    @property
    def p(self) -> int:
        """Number of states and controls."""
        return len(self.z_columns)

    @property
    def z(self) -> Array:
        """[x u] with samples in rows, (N, p)."""
        return self.z_columns.T

    @property
    def x_next(self) -> Array:
        """Next states with samples in rows, (N, n)."""
        return self.next_columns.T

    @property
    def order(self) -> NDArray[np.intp]:
        """Numbers of the samples (N,), with those of another recording never following."""
        return self.k + self.source * (int(self.k.max(initial=0)) + 2)

    def block(self, part: slice) -> Block:
        """Transitions of a slice, without a copy."""
        of = self.subset(part)
        start = part.start or 0
        return Block(start, of.z_columns, of.next_columns, of.dt, of.weights, of.s_columns, of.base_columns)

    def largest_moves(self) -> Array:
        """The largest change of each state in one transition, (n,)."""
        moves = [np.abs(block.x_next - block.z[: self.n]).max(axis=1) for block in self.blocks()]
        return np.asarray(np.max(moves, axis=0))

    def blocks(self) -> Iterator[Block]:
        """All transitions, in blocks."""
        for start in range(0, self.N, BLOCK):
            yield self.block(slice(start, min(start + BLOCK, self.N)))

    def rate(self) -> Array:
        """(x_next - x) / Δt with samples in rows.

        Returns (N, n): 1/s.
        """
        return ((self.next_columns - self.block(slice(None)).origin) / self.dt).T

    def phi(self) -> Array:
        """Regressors of the nominal row with samples in rows.

        Returns (N, r): as of `Columns.phi`.
        """
        return self.columns.phi(self.z_columns, self.s_columns).T

    def psi(self) -> Array:
        """Regressors of the half-width with samples in rows.

        Returns (N, q): as of `Columns.psi`.
        """
        return self.columns.psi(self.z_columns, self.dt, self.s_columns).T

    def row_weights(self) -> Array:
        """Diagonal weights with samples in rows.

        Returns (N, n): w_ii(t_{k+1}).
        """
        return np.broadcast_to(self.block(slice(None)).root_weights().T ** 2, (self.N, self.n))

    def subset(self, index: NDArray[np.intp] | NDArray[np.bool_] | slice) -> Problem:
        """The same problem on some transitions; a slice is no copy."""
        z, x_next = self.z_columns[:, index], self.next_columns[:, index]
        if not isinstance(index, slice):  # numpy would lay the copy out in rows
            z, x_next = np.ascontiguousarray(z), np.ascontiguousarray(x_next)
        weights = self.weights if self.weights.ndim == 1 else self.weights[index]
        s, base = (None if rows is None else rows[:, index] for rows in (self.s_columns, self.base_columns))
        return Problem(z, x_next, self.dt[index], self.source[index], self.k[index], weights, self.columns, s, base)

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
                yield Block(start, table[: self.p], table[first:-1], table[-1], self.weights, s)
                start += size


Partition = Problem | DiskPartition
"""What the passes over all data take."""
