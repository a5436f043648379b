# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The identification problem as arrays: regressors, weights, Gram matrices and column scales."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.english import plural
from uncertain_lti.base.errors import FitError, ModelError
from uncertain_lti.base.limits import LARGEST
from uncertain_lti.model.operating_point import OperatingPoint
from uncertain_lti.model.schedule import Schedule
from uncertain_lti.model.terms import ADDITIVE, Term
from uncertain_lti.sampling.transient import Transient, Transitions
from uncertain_lti.signals.additive import CHOICES, CHOICES_TEXT, Additive
from uncertain_lti.signals.signal_map import SignalMap

BLOCK = 16384
"""Transitions per pass block: their regressors stay in the cache."""


@dataclass(frozen=True)
class Regimes:
    """A schedule, and where its signals are among those of a transition.

    Parameters
    ----------
    schedule : Schedule
        Knots and modes, normalised.
    positions : tuple of int
        Of each of its axes the row of [x; u; s].
    """

    schedule: Schedule
    positions: tuple[int, ...]

    @classmethod
    def of(cls, schedule: Schedule, signals: SignalMap) -> Regimes:
        """Where the signals of a schedule are.

        Parameters
        ----------
        schedule : Schedule
            The schedule.
        signals : SignalMap
            With its signals.

        Returns
        -------
        Regimes
            The schedule with positions.

        Raises
        ------
        FitError
            A signal is not there; names it.
        """
        try:
            return cls(schedule, schedule.positions([s.name for s in signals.signals]))
        except ModelError as error:
            raise FitError(str(error)) from None

    def vectors(self, z: Array, s: Array | None) -> Array:
        """Scheduling vectors.

        Parameters
        ----------
        z : array (p, K)
            [x; u].
        s : array (q, K) or None
            Further scheduling signals; None if there are none.

        Returns
        -------
        array (axes, K)
            Normalised.
        """
        p = len(z)
        rows = [z[j] if j < p or s is None else s[j - p] for j in self.positions]
        return np.stack(rows)

    def weights(self, z: Array, s: Array | None) -> Array:
        """Weights of all blocks, w(s).

        Parameters
        ----------
        z : array (p, K)
            [x; u].
        s : array (q, K) or None
            Further scheduling signals; None if there are none.

        Returns
        -------
        array (R, K)
            Weights, which sum to 1.
        """
        return self.schedule.weights(self.vectors(z, s))

    def main_block(self, z: Array, s: Array | None) -> NDArray[np.intp]:
        """The block of the largest weight.

        Parameters
        ----------
        z : array (p, K)
            [x; u].
        s : array (q, K) or None
            Further scheduling signals; None if there are none.

        Returns
        -------
        array of int (K,)
            Numbers of blocks.
        """
        return self.schedule.main_block(self.vectors(z, s))


@dataclass(frozen=True)
class Columns:
    """Which arrays of the additive terms are unknown besides A, B, ΔA, ΔB, and how many blocks of them all there are.

    The unknowns of a row are those of the first block, then those of the second, and so on.

    Parameters
    ----------
    names : frozenset of str
        Of "c", "dc" and "v", those that are.
    regimes : Regimes, optional
        Of a scheduled model; None for one block.
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
    def drift(self) -> bool:
        """Whether c is unknown."""
        return "c" in self.names

    @property
    def disturbance(self) -> bool:
        """Whether dc is unknown."""
        return "dc" in self.names

    @property
    def noise(self) -> bool:
        """Whether v is unknown."""
        return "v" in self.names

    @property
    def count(self) -> int:
        """Number of blocks, R."""
        return 1 if self.regimes is None else self.regimes.schedule.blocks

    def phi(self, z: Array, s: Array | None) -> Array:
        """Regressors φ of the nominal row: z, and 1 for each additive term; of R blocks, each times its weight.

        Parameters
        ----------
        z : array (p, K)
            [x; u].
        s : array (q, K) or None
            Further scheduling signals; None if there are none.

        Returns
        -------
        array (r, K)
            φ / Δt.
        """
        return self._weighted(self.plain_phi(z), z, s)

    def plain_phi(self, z: Array) -> Array:
        """`phi` of one block, without its weight.

        Parameters
        ----------
        z : array (p, K)
            [x; u].

        Returns
        -------
        array (r / R, K)
            z, and 1 for each additive term.
        """
        return np.vstack([z, np.ones((len(self.nominal), z.shape[1]))]) if self.nominal else z

    def psi(self, z: Array, dt: Array, s: Array | None) -> Array:
        """Regressors ψ of the half-width: |z|, and for each additive term 1 or, if Δt does not multiply it, 1/Δt.

        Parameters
        ----------
        z : array (p, K)
            [x; u].
        dt : array (K,)
            Δt, s.
        s : array (q, K) or None
            Further scheduling signals; None if there are none.

        Returns
        -------
        array (q, K)
            ψ / Δt; of R blocks, each times its weight.
        """
        return self._weighted(self.plain_psi(z, dt), z, s)

    def plain_psi(self, z: Array, dt: Array) -> Array:
        """`psi` of one block, without its weight.

        Parameters
        ----------
        z : array (p, K)
            [x; u].
        dt : array (K,)
            Δt, s.

        Returns
        -------
        array (q / R, K)
            |z|, and 1 or 1 / Δt for each additive term.
        """
        p = len(z)
        psi = np.empty((p + len(self.half), z.shape[1]))
        np.abs(z, out=psi[:p])
        for row, term in zip(psi[p:], self.half, strict=True):
            row[:] = 1.0 if term.times_dt else 1.0 / dt
        return psi

    def _weighted(self, base: Array, z: Array, s: Array | None) -> Array:
        """w(s) ⊗ base."""
        if self.regimes is None:
            return base
        weights = self.regimes.weights(z, s)
        return (weights[:, None] * base).reshape(-1, z.shape[1])

    def unknowns(self, p: int) -> int:
        """Number of unknowns per row and block with p states and controls.

        Parameters
        ----------
        p : int
            Number of states and controls.

        Returns
        -------
        int
            Nominal elements and half-widths.
        """
        return 2 * p + len(self.names)

    @classmethod
    def of(cls, additive: Additive, constant_dt: bool, regimes: Regimes | None = None) -> Columns:
        """For an `additive` option.

        With a constant Δt, Δt·dc + v is one number: v takes it and dc is 0, because v is the one that still
        holds when another recording has another Δt. With a schedule c is unknown together with every
        additive term: it carries the steady state from knot to knot. Without such a term c is 0, as at rest its
        rounding would have no half-width to lie in.

        Parameters
        ----------
        additive : Additive
            The option of `fit`.
        constant_dt : bool
            Whether all steps are equal.
        regimes : Regimes, optional
            Of a scheduled model.

        Returns
        -------
        Columns
            Terms that are unknown.

        Raises
        ------
        FitError
            There is no such option.
        """
        if additive not in CHOICES:
            raise FitError(f"additive is {additive!r}; it must be {CHOICES_TEXT}")
        names = {"none": "", "disturbance": "c dc", "noise": "v", "both": "c v" if constant_dt else "c dc v"}
        drift = () if regimes is None or additive == "none" else ("c",)
        return cls(frozenset((*names[additive].split(), *drift)), regimes)


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


def is_constant(dt: Array) -> bool:
    """Whether all steps are equal to a part in 1e6 (an integer clock jitters by a nanosecond).

    Parameters
    ----------
    dt : array (N,)
        Steps, s.

    Returns
    -------
    bool
        True without a step.
    """
    if not dt.size or (dt == dt[0]).all():
        return True
    return bool(np.ptp(dt) <= 1e-6 * np.median(dt))


def median_step(dt: Array) -> float:
    """Median of Δt; without a sort where all steps are the same.

    Parameters
    ----------
    dt : array (N,)
        Steps, s; at least one.

    Returns
    -------
    float
        In s.
    """
    first = float(dt[0])
    return first if (dt == first).all() else float(np.median(dt))


def assemble(
    transients: Sequence[Transient],
    point: OperatingPoint,
    weights: ArrayLike | Sequence[ArrayLike] | None,
    additive: Additive,
    empty: bool = False,
    transient_weights: Sequence[float] | None = None,
    count: Literal["sample", "transient"] = "sample",
    regimes: Regimes | None = None,
) -> Problem:
    """Put the usable transitions of all recordings into one problem.

    Parameters
    ----------
    transients : sequence of Transient
        The recordings.
    point : OperatingPoint
        The normalisation.
    weights : array (n,), (N, n), (N, n, n), or one of the latter two per transient, or None
        W(t_{k+1}); N counts the steps of a transient (samples less one), usable or not. None for ones.
    additive : Additive
        Terms besides A and B.
    empty : bool
        No transition at all is no error.
    transient_weights : sequence of float, optional
        One factor per transient on all its weights.
    count : {"sample", "transient"}
        Every transition weighs the same, or every transient does, however long it is.
    regimes : Regimes, optional
        Of a scheduled model.

    Returns
    -------
    Problem
        Normalised.

    Raises
    ------
    FitError
        No transitions; values whose squares overflow; a mode that the schedule does not list; weights of a wrong shape,
        not positive, not symmetric or not positive definite.
    """
    n = len(point.x_s)
    steps = [t.transitions() for t in transients]
    k = _joined([s.k for s in steps])
    source = np.zeros(len(k), dtype=np.intp)
    for number, stop in enumerate(np.cumsum([len(s.k) for s in steps])[:-1], start=1):
        source[stop:] = number
    if not len(k) and not empty:
        names = ", ".join(t.name for t in transients)
        raise FitError(
            f"{names}: no usable transition among {plural(sum(len(t) for t in transients), 'sample')}; "
            f"{_without_values(transients)}"
        )
    dt = _joined([s.dt for s in steps])
    p = n + len(point.u_s)
    samples = np.empty((p, len(dt) + 1))
    z = samples[:, :-1]
    shared = len(steps) == 1 and steps[0].consecutive  # the next sample is the next column
    x_next = samples[:n, 1:] if shared else np.empty((n, len(dt)))
    start, square = 0, 0.0
    for s in steps:
        stop = start + len(s.dt)
        part = slice(start, stop)
        start = stop
        square += _normalise(s.x, point.x_s, point.X, z[:n, part])
        square += _normalise(s.u, point.u_s, point.U, z[n:, part])
        if s.consecutive:  # computed once
            if not shared:
                x_next[:, part][:, :-1] = z[:n, part][:, 1:]
            square += _normalise(s.x_next[-1:], point.x_s, point.X, x_next[:, stop - 1 : stop])
        else:
            square += _normalise(s.x_next, point.x_s, point.X, x_next[:, part])
    further, more = _scheduling(steps, point)
    if not square + more <= LARGEST**2:
        raise _too_large(transients)
    columns = Columns.of(additive, is_constant(dt), regimes)
    chosen = _weights(weights, transients, k, source, n)
    factors = _factors(transient_weights, count, source, len(transients))
    if factors is not None:
        factors = factors[source]
        chosen = factors[:, None] * chosen if chosen.ndim < 3 else factors[:, None, None] * chosen
    problem = Problem(z, x_next, dt, source, k, chosen, columns, further)
    if regimes is not None:
        refuse_unlisted(problem, regimes, transients)
    return problem


def refuse_unlisted(problem: Problem, regimes: Regimes, transients: Sequence[Transient]) -> None:
    """Refuse a mode that the schedule does not list.

    Parameters
    ----------
    problem : Problem
        The data.
    regimes : Regimes
        The schedule.
    transients : sequence of Transient
        The recordings, by their position in `problem.source`.

    Raises
    ------
    FitError
        There is one; names the mode, the recording and the remedy.
    """
    vectors = regimes.vectors(problem.z_columns, problem.s_columns)
    for axis, values, row in zip(regimes.schedule.axes, vectors, regimes.positions, strict=True):
        unlisted = np.flatnonzero(~np.isin(values, axis.modes))
        if axis.modes and len(unlisted):
            transient, k = transients[problem.source[unlisted[0]]], int(problem.k[unlisted[0]])
            recorded = np.hstack([transient.x[k], transient.u[k], transient.s[k]])[row]
            raise FitError(
                f"{transient.name}: '{axis.signal}' is {recorded:g} at t = {transient.t[k]:.6g} s (and in "
                f"{plural(len(unlisted), 'transition')} of all), a mode that the schedule does not list; list it, or "
                f"leave that part of the recording out"
            )


def _scheduling(steps: Sequence[Transitions], point: OperatingPoint) -> tuple[Array | None, float]:
    """Scheduling signals that are neither state nor control, normalised, (q, N), and the sum of their squares."""
    if not len(point.s_s):
        return None, 0.0
    s = np.empty((len(point.s_s), sum(len(step.dt) for step in steps)))
    start, square = 0, 0.0
    for step in steps:
        square += _normalise(step.s, point.s_s, point.S, s[:, start : start + len(step.dt)])
        start += len(step.dt)
    return s, square


def _joined(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """One after the other; a single one as it is."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _too_large(transients: Sequence[Transient]) -> FitError:
    """The error for values whose squares overflow, naming signal and recording."""
    largest, name, recording = 0.0, "", ""
    for t in transients:
        names = (*t.state_names, *t.control_names, *t.scheduling_names)
        for signal, values in zip(names, (*t.x.T, *t.u.T, *t.s.T), strict=True):
            here = float(np.abs(values[np.isfinite(values)]).max(initial=0.0))
            if here > largest:
                largest, name, recording = here, signal, t.name
    return FitError(
        f"{recording}: '{name}' reaches {largest:.3g}, over its scale more than the arithmetic can carry; leave out "
        f"the recording, or mend the sensor or the scale"
    )


def _without_values(transients: Sequence[Transient]) -> str:
    """Why there may be no usable transition, by signal."""
    first, total = transients[0], sum(len(t) for t in transients)
    known = sum(np.isfinite(np.concatenate([t.x, t.u, t.s], axis=1)).sum(axis=0) for t in transients)
    names = (*first.state_names, *first.control_names, *first.scheduling_names)
    counts = dict(zip(names, np.asarray(known).tolist(), strict=True))
    never = [name for name, count in counts.items() if not count]
    if never:
        many = len(never) > 1
        return (
            f"{', '.join(never)} {'have' if many else 'has'} no value in any of them (missing, not finite or too old, "
            f"see max_hold and max_skew), so check {'their fields' if many else 'its field'} in the signals file"
        )
    seldom = [f"{name} in {count}" for name, count in counts.items() if count < total]
    if seldom:
        return (
            f"no two in a row have every signal; there is a value of {', '.join(seldom)} of them (otherwise missing, "
            f"not finite or too old, see max_hold and max_skew), so check the signals file"
        )
    return "no two in a row are at most max_gap and at least min_step apart, so check these in the signals file"


def _factors(
    transient_weights: Sequence[float] | None, count: str, source: NDArray[np.intp], transients: int
) -> Array | None:
    """Factor on the weights of each transient; None where all are 1."""
    if count not in ("sample", "transient"):
        raise FitError(f"count is {count!r}; it must be sample or transient")
    factors = np.ones(transients)
    if transient_weights is not None:
        factors = np.asarray(transient_weights, dtype=np.float64)
        if factors.shape != (transients,) or not (np.isfinite(factors).all() and (factors > 0).all()):
            raise FitError(f"transient_weights must be {transients} positive numbers, one per transient")
    if count == "transient":
        lengths = np.bincount(source, minlength=transients)
        factors = factors * len(source) / (np.maximum(lengths, 1) * np.count_nonzero(lengths))
    return None if (factors == 1.0).all() else factors


def _normalise(recorded: Array, steady: Array, scale: Array, out: Array) -> float:
    """(recorded - steady) / scale as `OperatingPoint` does it, into columns; (K, n) to (n, K). The sum of squares."""
    square = 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        for start in range(0, len(recorded), BLOCK):  # a piece of the rows stays in the cache while they become columns
            part = slice(start, start + BLOCK)
            for row, values, a, b in zip(out[:, part], recorded[part].T, steady, scale, strict=True):
                np.subtract(values, a, out=row)
                if b != 1.0:
                    row /= b
                square += float(row @ row)
    return square


def scaled_eigenvalues(weights: Array) -> Array:
    """Eigenvalues of full weights whose diagonals are scaled to ones.

    The scales of the states are taken apart, as their squares may differ by more than arithmetic holds.

    Parameters
    ----------
    weights : array (K, n, n)
        Symmetric.

    Returns
    -------
    array (K, n)
        In rising order.
    """
    unit = 1.0 / np.sqrt(np.maximum(np.einsum("kii->ki", weights), 1e-300))
    return np.asarray(np.linalg.eigvalsh(weights * unit[:, :, None] * unit[:, None, :]))


def _weights(
    weights: ArrayLike | Sequence[ArrayLike] | None,
    transients: Sequence[Transient],
    k: NDArray[np.intp],
    source: NDArray[np.intp],
    n: int,
) -> Array:
    if weights is None:
        return np.ones(n)
    lengths = [max(len(t) - 1, 0) for t in transients]
    try:
        if isinstance(weights, (list, tuple)) and all(np.ndim(w) >= 2 for w in weights):
            if len(weights) != len(transients):
                raise FitError(
                    f"weights: {len(weights)} arrays for {len(transients)} transients; give one per transient"
                )
            for w, length, t in zip(weights, lengths, transients, strict=True):
                if np.shape(w) not in ((length, n), (length, n, n)):
                    raise FitError(
                        f"weights of {t.name} have shape {np.shape(w)}; they must be ({length}, {n}) or "
                        f"({length}, {n}, {n}), one per step"
                    )
            if len({np.ndim(w) for w in weights}) > 1:
                raise FitError("weights: some transients have diagonals and some full matrices; give one kind")
            stacked = np.concatenate([np.asarray(w, dtype=np.float64) for w in weights])
        else:
            stacked = np.asarray(weights, dtype=np.float64)
    except (TypeError, ValueError):
        raise FitError("weights are not arrays of numbers; give (n,), (N, n) or (N, n, n)") from None
    total = sum(lengths)
    if stacked.shape == (n,):
        chosen = stacked
    elif stacked.shape in ((total, n), (total, n, n)):
        offset = np.concatenate([[0], np.cumsum(lengths)])[:-1]
        chosen = stacked[offset[source] + k]
    else:
        raise FitError(
            f"weights have shape {stacked.shape}; they must be ({n},), ({total}, {n}) or ({total}, {n}, {n}), "
            f"one per step of the transients"
        )
    if not np.isfinite(chosen).all():
        raise FitError("weights hold a number that is not finite")
    if chosen.ndim == 3:
        largest = np.abs(chosen).max(axis=(1, 2))
        symmetric = np.abs(chosen - chosen.transpose(0, 2, 1)).max(axis=(1, 2)) <= 1e-12 * largest
        if not symmetric.all():
            raise FitError(f"weights: the matrix of step {int(np.argmin(symmetric))} is not symmetric")
        smallest = scaled_eigenvalues(chosen)[:, 0]
        if smallest.min() <= 0:
            raise FitError(f"weights: the matrix of step {int(np.argmin(smallest))} is not positive definite")
    elif (chosen <= 0).any():
        raise FitError("weights: every weight must be positive; leave samples out of the transient instead")
    return chosen
