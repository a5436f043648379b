"""The identification problem as arrays: regressors, weights, Gram matrices and column scales."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.english import plural
from uncertain_lti.base.errors import FitError
from uncertain_lti.sampling.operating_point import OperatingPoint
from uncertain_lti.sampling.transient import Transient

Additive = Literal["none", "disturbance", "noise", "both"]

BLOCK = 16384
"""Transitions per pass block: their regressors stay in the cache."""


@dataclass(frozen=True)
class Columns:
    """Which terms are unknown besides A, B, ΔA, ΔB."""

    drift: bool  # c
    disturbance: bool  # dc
    noise: bool  # v

    def unknowns(self, p: int) -> int:
        """Number of unknowns per row with p states and controls."""
        return 2 * p + self.drift + self.disturbance + self.noise

    @classmethod
    def of(cls, additive: Additive, constant_dt: bool) -> Columns:
        """For an `additive` option.

        With a constant Δt, Δt·dc + v is one number: v takes it and dc is 0, because v is the one that still
        holds when another recording has another Δt.
        """
        if additive not in ("none", "disturbance", "noise", "both"):
            raise FitError(f"additive is {additive!r}; it must be none, disturbance, noise or both")
        disturbance = additive in ("disturbance", "both")
        return cls(disturbance, disturbance and not (additive == "both" and constant_dt), additive in ("noise", "both"))


@dataclass(frozen=True)
class Block:
    """Some transitions in columns: z (p, K) = [x; u], x_next (n, K), dt (K,); weights (n,), (K, n) or (K, n, n)."""

    start: int
    z: Array
    x_next: Array
    dt: Array
    weights: Array

    def __len__(self) -> int:
        return len(self.dt)

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.x_next)

    def piece(self, start: int, stop: int) -> Block:
        """Some consecutive transitions, without a copy."""
        weights = self.weights if self.weights.ndim == 1 else self.weights[start:stop]
        part = slice(start, stop)
        return Block(self.start + start, self.z[:, part], self.x_next[:, part], self.dt[part], weights)

    def every(self, first: int, stride: int) -> Block:
        """A copy of every stride-th transition from the first."""
        weights = self.weights if self.weights.ndim == 1 else self.weights[first::stride].copy()
        part = slice(first, None, stride)
        return Block(self.start, self.z[:, part].copy(), self.x_next[:, part].copy(), self.dt[part].copy(), weights)

    def rate(self) -> Array:
        """(x_next - x) / Δt, 1/s, (n, K)."""
        rate = self.x_next - self.z[: self.n]
        rate /= self.dt
        return rate

    def phi(self, columns: Columns) -> Array:
        """Regressors of the nominal row, (p [+1], K): z, and 1 for the drift."""
        return np.vstack([self.z, np.ones(len(self))]) if columns.drift else self.z

    def psi(self, columns: Columns) -> Array:
        """Regressors of the half-width, (p [+1] [+1], K): |z|, 1 for dc, 1/Δt for v."""
        p = len(self.z)
        psi = np.empty((p + columns.disturbance + columns.noise, len(self)))
        np.abs(self.z, out=psi[:p])
        if columns.disturbance:
            psi[p] = 1.0
        if columns.noise:
            np.divide(1.0, self.dt, out=psi[-1])
        return psi

    def root_weights(self) -> Array:
        """√w_ii(t_{k+1}), (n, K) or (n, 1)."""
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
        """All transitions, in blocks that stay in the cache."""
        ...


@dataclass(frozen=True)
class Problem:
    """A `Partition` in memory, of all recordings.

    z_columns (p, N), next_columns (n, N): samples in columns; dt (N,); weights (n,), (N, n) or (N, n, n). source (N,)
    and k (N,) say which transient and sample a transition comes from.
    """

    z_columns: Array
    next_columns: Array
    dt: Array
    source: NDArray[np.intp]
    k: NDArray[np.intp]
    weights: Array
    columns: Columns

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
        """Transitions of a slice, without a copy."""
        weights = self.weights if self.weights.ndim == 1 else self.weights[part]
        return Block(part.start or 0, self.z_columns[:, part], self.next_columns[:, part], self.dt[part], weights)

    def blocks(self) -> Iterator[Block]:
        """All transitions, in blocks that stay in the cache."""
        for start in range(0, self.N, BLOCK):
            yield self.block(slice(start, min(start + BLOCK, self.N)))

    def rate(self, part: slice = slice(None)) -> Array:
        """(x_next - x) / Δt with samples in rows, 1/s, (K, n)."""
        return ((self.next_columns[:, part] - self.z_columns[: self.n, part]) / self.dt[part]).T

    def phi(self, part: slice = slice(None)) -> Array:
        """Regressors of the nominal row with samples in rows, (K, r)."""
        return self._rows(part).phi(self.columns).T

    def psi(self, part: slice = slice(None)) -> Array:
        """Regressors of the half-width with samples in rows, (K, q)."""
        return self._rows(part).psi(self.columns).T

    def row_weights(self, part: slice = slice(None)) -> Array:
        """w_ii(t_{k+1}) with samples in rows, (K, n)."""
        return np.broadcast_to(self._rows(part).root_weights().T ** 2, (len(self.dt[part]), self.n))

    def _rows(self, part: slice) -> Block:
        weights = self.weights if self.weights.ndim == 1 else self.weights[part]
        return Block(0, self.z_columns[:, part], self.next_columns[:, part], self.dt[part], weights)

    def subset(self, index: NDArray[np.intp] | NDArray[np.bool_] | slice) -> Problem:
        """The same problem on some transitions; a slice is no copy."""
        weights = self.weights if self.weights.ndim == 1 else self.weights[index]
        return Problem(
            self.z_columns[:, index],
            self.next_columns[:, index],
            self.dt[index],
            self.source[index],
            self.k[index],
            weights,
            self.columns,
        )

    def without(self, index: NDArray[np.intp]) -> Problem:
        """The same problem without some transitions."""
        keep = np.ones(self.N, dtype=bool)
        keep[index] = False
        return self.subset(keep)


def is_constant(dt: Array) -> bool:
    """All steps are equal to a part in 1e6 (an integer clock jitters by a nanosecond)."""
    return bool(np.ptp(dt) <= 1e-6 * np.median(dt)) if dt.size else True


def assemble(
    transients: Sequence[Transient],
    point: OperatingPoint,
    weights: ArrayLike | Sequence[ArrayLike] | None,
    additive: Additive,
    empty: bool = False,
    transient_weights: Sequence[float] | None = None,
    count: Literal["sample", "transient"] = "sample",
) -> Problem:
    """Put the usable transitions of all recordings into one problem.

    Parameters
    ----------
    transients : sequence of Transient
    point : OperatingPoint
    weights : None, (n,), (N, n), (N, n, n), or one such array per transient
        N counts the steps of a transient (samples less one), usable or not.
    additive : {"none", "disturbance", "noise", "both"}
    empty : bool
        No transition at all is no error.
    transient_weights : sequence of float, optional
        One factor per transient on all its weights.
    count : {"sample", "transient"}
        Every transition weighs the same, or every transient does, however long it is.

    Raises
    ------
    FitError
        No transitions; weights of a wrong shape, not positive, not symmetric or not positive definite.
    """
    n = len(point.x_s)
    steps = [t.transitions() for t in transients]
    k = np.concatenate([s.k for s in steps])
    source = np.repeat(np.arange(len(steps)), [len(s.k) for s in steps])
    if not len(k) and not empty:
        names = ", ".join(t.name for t in transients)
        raise FitError(
            f"{names}: no usable transition among {plural(sum(len(t) for t in transients), 'sample')}; "
            f"{_without_values(transients)}"
        )
    dt = np.concatenate([s.dt for s in steps])
    p = n + len(point.u_s)
    z = np.empty((p, len(dt)))
    x_next = np.empty((n, len(dt)))
    start = 0
    for s in steps:
        part = slice(start, start + len(s.dt))
        start = part.stop
        _normalise(s.x, point.x_s, point.X, z[:n, part])
        _normalise(s.u, point.u_s, point.U, z[n:, part])
        _normalise(s.x_next, point.x_s, point.X, x_next[:, part])
    columns = Columns.of(additive, is_constant(dt))
    chosen = _weights(weights, transients, k, source, n)
    factors = _factors(transient_weights, count, source, len(transients))
    if factors is not None:
        factors = factors[source]
        chosen = factors[:, None] * chosen if chosen.ndim < 3 else factors[:, None, None] * chosen
    return Problem(z, x_next, dt, source, k, chosen, columns)


def _without_values(transients: Sequence[Transient]) -> str:
    """Why there may be no usable transition, by signal."""
    first, total = transients[0], sum(len(t) for t in transients)
    known = sum(np.isfinite(np.concatenate([t.x, t.u], axis=1)).sum(axis=0) for t in transients)
    counts = dict(zip((*first.state_names, *first.control_names), np.asarray(known).tolist(), strict=True))
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


def _normalise(recorded: Array, steady: Array, scale: Array, out: Array) -> None:
    """(recorded - steady) / scale as `OperatingPoint` does it, into columns; (K, n) to (n, K)."""
    for row, values, a, b in zip(out, recorded.T, steady, scale, strict=True):
        np.subtract(values, a, out=row)
        if b != 1.0:
            row /= b


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
        smallest = np.linalg.eigvalsh(chosen)[:, 0]
        if smallest.min() <= 0:
            raise FitError(f"weights: the matrix of step {int(np.argmin(smallest))} is not positive definite")
    elif (chosen <= 0).any():
        raise FitError("weights: every weight must be positive; leave samples out of the transient instead")
    return chosen
