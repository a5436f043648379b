# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The identification problem as arrays: the transitions of a fit, whole and in blocks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.identification.columns import Columns

BLOCK = 16384
"""Transitions per pass block: their regressors stay in the cache."""


@dataclass(frozen=True)
class Block:
    """Some transitions in columns.

    Parameters
    ----------
    start : int
        Position of the first among those of the partition.
    z : array (p, K)
        [x; u].
    x_next : array (n, K)
        Next states.
    dt : array (K,)
        Δt, s.
    weights : array (n,), (K, n) or (K, n, n)
        W(t_{k+1}).
    s : array (q, K), optional
        Scheduling signals that are neither state nor control.
    base : array (n, K), optional
        What a step is counted from, over a horizon the run of the nominal model; default the states.
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

    def piece(self, start: int, stop: int) -> Block:
        """Some consecutive transitions, without a copy.

        Parameters
        ----------
        start : int
            First transition.
        stop : int
            First transition after it.

        Returns
        -------
        Block
            Views.
        """
        weights = self.weights if self.weights.ndim == 1 else self.weights[start:stop]
        part = slice(start, stop)
        s = None if self.s is None else self.s[:, part]
        base = None if self.base is None else self.base[:, part]
        return Block(self.start + start, self.z[:, part], self.x_next[:, part], self.dt[part], weights, s, base)

    def every(self, first: int, stride: int) -> Block:
        """A copy of every stride-th transition from the first.

        Parameters
        ----------
        first : int
            First transition.
        stride : int
            Distance of those taken.

        Returns
        -------
        Block
            A copy; its start is that of the block.
        """
        weights = self.weights if self.weights.ndim == 1 else self.weights[first::stride].copy()
        part = slice(first, None, stride)
        s = None if self.s is None else self.s[:, part].copy()
        base = None if self.base is None else self.base[:, part].copy()
        return Block(
            self.start, self.z[:, part].copy(), self.x_next[:, part].copy(), self.dt[part].copy(), weights, s, base
        )

    def take(self, index: NDArray[np.intp]) -> Block:
        """A copy of some transitions.

        Parameters
        ----------
        index : array of int (K,)
            Positions in the block.

        Returns
        -------
        Block
            Its start is that of the block.
        """
        weights = self.weights if self.weights.ndim == 1 else self.weights[index]
        s = None if self.s is None else self.s[:, index]
        base = None if self.base is None else self.base[:, index]
        return Block(self.start, self.z[:, index], self.x_next[:, index], self.dt[index], weights, s, base)

    @property
    def origin(self) -> Array:
        """What a step is counted from, (n, K)."""
        return self.z[: self.n] if self.base is None else self.base

    def rate(self) -> Array:
        """(x_next - x) / Δt.

        Returns
        -------
        array (n, K)
            1/s.
        """
        rate = self.x_next - self.origin
        rate /= self.dt
        return rate

    @property
    def signals(self) -> Array:
        """[x; u; s], (p + q, K)."""
        return self.z if self.s is None else np.vstack([self.z, self.s])

    def phi(self, columns: Columns) -> Array:
        """Regressors of the nominal row.

        Parameters
        ----------
        columns : Columns
            Terms that are unknown.

        Returns
        -------
        array (r, K)
            As of `Columns.phi`.
        """
        return columns.phi(self.z, self.s)

    def psi(self, columns: Columns) -> Array:
        """Regressors of the half-width.

        Parameters
        ----------
        columns : Columns
            Terms that are unknown.

        Returns
        -------
        array (q, K)
            As of `Columns.psi`.
        """
        return columns.psi(self.z, self.dt, self.s)

    def root_weights(self) -> Array:
        """Roots of the diagonal weights.

        Returns
        -------
        array (n, K) or (n, 1)
            √w_ii(t_{k+1}).
        """
        if self.weights.ndim == 1:
            return np.sqrt(self.weights)[:, None]
        diagonal = np.diagonal(self.weights, axis1=1, axis2=2) if self.weights.ndim == 3 else self.weights
        return np.sqrt(diagonal).T


class Partition(Protocol):
    """Usable transitions, normalised, wherever they lie; what the passes over all data need.

    They are in the form

        |rate_i - (z·θ_i + c_i)| <= |z|·d_i + dc_i + v_i / Δt       for every transition and row i,

    where rate = (x_next - x) / Δt, which is (8)(9) of Leibov (2006) divided by Δt_k. θ_i is row i of [A B], d_i of
    [ΔA ΔB].
    """

    @property
    def columns(self) -> Columns:
        """Terms that are unknown."""
        ...

    @property
    def n(self) -> int:
        """Number of states."""
        ...

    @property
    def p(self) -> int:
        """Number of states and controls."""
        ...

    @property
    def weights(self) -> Array:
        """(n,), or per transition."""
        ...

    @property
    def N(self) -> int:
        """Number of transitions."""
        ...

    def blocks(self) -> Iterator[Block]:
        """All transitions, in blocks that stay in the cache.

        Returns
        -------
        iterator of Block
            In order.
        """
        ...


@dataclass(frozen=True)
class Problem:
    """A `Partition` in memory, of all recordings.

    Parameters
    ----------
    z_columns : array (p, N)
        [x; u], samples in columns.
    next_columns : array (n, N)
        Next states, samples in columns.
    dt : array (N,)
        Δt, s.
    source : array (N,) of int
        Transient that a transition comes from.
    k : array (N,) of int
        Its sample in that transient.
    weights : array (n,), (N, n) or (N, n, n)
        W(t_{k+1}).
    columns : Columns
        Terms that are unknown.
    s_columns : array (q, N), optional
        Scheduling signals that are neither state nor control, samples in columns.
    base_columns : array (n, N), optional
        What a step is counted from, over a horizon the run of the nominal model; default the states.
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
    sorted_pieces: list[Any] = field(default_factory=list, init=False, repr=False, compare=False)  # of the passes

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

    def block(self, part: slice) -> Block:
        """Transitions of a slice, without a copy.

        Parameters
        ----------
        part : slice
            With a step of 1.

        Returns
        -------
        Block
            Views.
        """
        weights = self.weights if self.weights.ndim == 1 else self.weights[part]
        s = None if self.s_columns is None else self.s_columns[:, part]
        base = None if self.base_columns is None else self.base_columns[:, part]
        return Block(
            part.start or 0, self.z_columns[:, part], self.next_columns[:, part], self.dt[part], weights, s, base
        )

    def blocks(self) -> Iterator[Block]:
        """All transitions, in blocks that stay in the cache.

        Yields
        ------
        Block
            Up to BLOCK transitions.
        """
        for start in range(0, self.N, BLOCK):
            yield self.block(slice(start, min(start + BLOCK, self.N)))

    def rate(self, part: slice = slice(None)) -> Array:
        """(x_next - x) / Δt with samples in rows.

        Parameters
        ----------
        part : slice, optional
            Transitions; default all.

        Returns
        -------
        array (K, n)
            1/s.
        """
        return self.block(part).rate().T

    def phi(self, part: slice = slice(None)) -> Array:
        """Regressors of the nominal row with samples in rows.

        Parameters
        ----------
        part : slice, optional
            Transitions; default all.

        Returns
        -------
        array (K, r)
            As of `Block.phi`.
        """
        return self.block(part).phi(self.columns).T

    def psi(self, part: slice = slice(None)) -> Array:
        """Regressors of the half-width with samples in rows.

        Parameters
        ----------
        part : slice, optional
            Transitions; default all.

        Returns
        -------
        array (K, q)
            As of `Block.psi`.
        """
        return self.block(part).psi(self.columns).T

    def row_weights(self, part: slice = slice(None)) -> Array:
        """Diagonal weights with samples in rows.

        Parameters
        ----------
        part : slice, optional
            Transitions; default all.

        Returns
        -------
        array (K, n)
            w_ii(t_{k+1}).
        """
        return np.broadcast_to(self.block(part).root_weights().T ** 2, (len(self.dt[part]), self.n))

    def subset(self, index: NDArray[np.intp] | NDArray[np.bool_] | slice) -> Problem:
        """The same problem on some transitions; a slice is no copy.

        Parameters
        ----------
        index : array of int or bool, or slice
            Transitions.

        Returns
        -------
        Problem
            With the same columns.
        """
        weights = self.weights if self.weights.ndim == 1 else self.weights[index]
        z, x_next = self.z_columns[:, index], self.next_columns[:, index]
        if not isinstance(index, slice):  # numpy would lay the copy out in rows
            z, x_next = np.ascontiguousarray(z), np.ascontiguousarray(x_next)
        return Problem(
            z,
            x_next,
            self.dt[index],
            self.source[index],
            self.k[index],
            weights,
            self.columns,
            None if self.s_columns is None else self.s_columns[:, index],
            None if self.base_columns is None else self.base_columns[:, index],
        )

    def without(self, index: NDArray[np.intp]) -> Problem:
        """The same problem without some transitions.

        Parameters
        ----------
        index : array of int
            Transitions.

        Returns
        -------
        Problem
            A copy of the others.
        """
        keep = np.ones(self.N, dtype=bool)
        keep[index] = False
        return self.subset(keep)
