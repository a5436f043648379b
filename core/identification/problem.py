"""The identification problem as arrays: regressors, weights, Gram matrices and column scales."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.errors import FitError
from uncertain_lti.operating_point import OperatingPoint
from uncertain_lti.transient import Transient

Array = NDArray[np.float64]
Additive = Literal["none", "disturbance", "noise", "both"]

BLOCK = 16384
"""Transitions per pass block: their regressors stay in the cache."""


@dataclass(frozen=True)
class Columns:
    """Which terms are unknown besides A, B, ΔA, ΔB."""

    drift: bool  # c
    disturbance: bool  # dc
    noise: bool  # v

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
class Problem:
    """All usable transitions of all recordings, normalised, in the form

        |rate_i - (z·θ_i + c_i)| <= |z|·d_i + dc_i + v_i / Δt       for every transition and row i,

    which is (8)(9) of Leibov (2006) divided by Δt_k. θ_i is row i of [A B], d_i of [ΔA ΔB].

    where rate = (x_next - x) / Δt. z (N, p) = [x u]; x_next (N, n); dt (N,); source (N,) and k (N,) say which
    transient and sample a transition comes from. weights: (n,), (N, n) or (N, n, n).
    """

    z: Array
    x_next: Array
    dt: Array
    source: NDArray[np.intp]
    k: NDArray[np.intp]
    weights: Array
    columns: Columns
    n: int

    @property
    def N(self) -> int:
        """Number of transitions."""
        return len(self.dt)

    @property
    def p(self) -> int:
        """Number of states and controls."""
        return int(self.z.shape[1])

    @property
    def constant_dt(self) -> bool:
        """All steps are equal to a part in 1e6."""
        return is_constant(self.dt)

    def rate(self, part: slice | NDArray[np.intp]) -> Array:
        """(x_next - x) / Δt, 1/s, (K, n)."""
        return np.asarray((self.x_next[part] - self.z[part, : self.n]) / self.dt[part, None])

    def phi(self, part: slice | NDArray[np.intp]) -> Array:
        """Regressors of the nominal row, (K, p [+1]): z, and 1 for the drift."""
        z = self.z[part]
        return np.column_stack([z, np.ones(len(z))]) if self.columns.drift else z

    def psi(self, part: slice | NDArray[np.intp]) -> Array:
        """Regressors of the half-width, (K, p [+1] [+1]): |z|, 1 for dc, 1/Δt for v."""
        size = np.abs(self.z[part])
        extra = []
        if self.columns.disturbance:
            extra.append(np.ones(len(size)))
        if self.columns.noise:
            extra.append(1.0 / self.dt[part])
        return np.column_stack([size, *extra]) if extra else size

    def blocks(self) -> Iterator[slice]:
        """Slices that cover all transitions."""
        for start in range(0, self.N, BLOCK):
            yield slice(start, min(start + BLOCK, self.N))

    def row_weights(self, part: slice | NDArray[np.intp]) -> Array:
        """w_ii(t_{k+1}), (K, n)."""
        if self.weights.ndim == 1:
            return np.broadcast_to(self.weights, (len(self.dt[part]), self.n))
        chosen = self.weights[part]
        return np.asarray(np.diagonal(chosen, axis1=1, axis2=2) if chosen.ndim == 3 else chosen)

    def subset(self, index: NDArray[np.intp]) -> Problem:
        """The same problem on some transitions."""
        return Problem(
            self.z[index],
            self.x_next[index],
            self.dt[index],
            self.source[index],
            self.k[index],
            self.weights if self.weights.ndim == 1 else self.weights[index],
            self.columns,
            self.n,
        )


def is_constant(dt: Array) -> bool:
    """All steps are equal to a part in 1e6 (an integer clock jitters by a nanosecond)."""
    return bool(np.ptp(dt) <= 1e-6 * np.median(dt)) if dt.size else True


def assemble(
    transients: Sequence[Transient],
    point: OperatingPoint,
    weights: ArrayLike | Sequence[ArrayLike] | None,
    additive: Additive,
) -> Problem:
    """Put the usable transitions of all recordings into one problem.

    Parameters
    ----------
    transients : sequence of Transient
    point : OperatingPoint
    weights : None, (n,), (N, n), (N, n, n), or one such array per transient
        N counts the steps of a transient (samples less one), usable or not.
    additive : {"none", "disturbance", "noise", "both"}

    Raises
    ------
    FitError
        No transitions; weights of a wrong shape, not positive, not symmetric or not positive definite.
    """
    n = len(point.x_s)
    steps = [t.transitions() for t in transients]
    k = np.concatenate([s.k for s in steps])
    source = np.repeat(np.arange(len(steps)), [len(s.k) for s in steps])
    if not len(k):
        names = ", ".join(t.name for t in transients)
        raise FitError(
            f"{names}: no usable transition among {sum(len(t) for t in transients)} samples; signals are missing, "
            f"not finite or too old (see max_gap, max_hold, max_skew), so check the signals file"
        )
    dt = np.concatenate([s.dt for s in steps])
    p = n + len(point.u_s)
    z = np.empty((len(dt), p))
    x_next = np.empty((len(dt), n))
    start = 0
    for s in steps:
        part = slice(start, start + len(s.dt))
        start = part.stop
        z[part, :n] = point.normalise_x(s.x)
        z[part, n:] = point.normalise_u(s.u)
        x_next[part] = point.normalise_x(s.x_next)
    columns = Columns.of(additive, is_constant(dt))
    return Problem(z, x_next, dt, source, k, _weights(weights, transients, k, source, n), columns, n)


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


@dataclass(frozen=True)
class Moments:
    """Sums over all transitions that the objectives need, whatever N is.

    gram: (n, q, q), Σ w_ii (Δt ψ)(Δt ψ)ᵀ per row, or (1, q, q) where all rows share it (constant weights left out);
    coupled: (n q, n q) for full weights, else None. centre: (r, r) and target (r, n), the normal equations of the
    unweighted squared distance of the bounds' centre. phi_scale (r,), psi_scale (q,), rate_scale (n,): scales that
    make columns and rows of order one; 0 where a column is all zero.
    """

    gram: Array
    plain_gram: Array
    coupled: Array | None
    centre: Array
    target: Array
    phi_scale: Array
    psi_scale: Array
    rate_scale: Array


def moments(problem: Problem) -> Moments:
    """One pass over the data for everything in `Moments`."""
    columns, n = problem.columns, problem.n
    r = problem.p + columns.drift
    q = problem.p + columns.disturbance + columns.noise
    weighted = problem.weights.ndim == 2
    plain = np.zeros((q, q))
    gram = np.zeros((n, q, q)) if weighted else plain[None]
    coupled = np.zeros((n, n, q, q)) if problem.weights.ndim == 3 else None
    centre, target = np.zeros((r, r)), np.zeros((r, n))
    rate_square = np.zeros(n)
    for part in problem.blocks():
        dt = problem.dt[part, None]
        psi = problem.psi(part) * dt
        phi = problem.phi(part) * dt
        rate = problem.rate(part) * dt
        plain += psi.T @ psi
        if weighted:
            for i in range(n):
                gram[i] += (psi * problem.weights[part, i, None]).T @ psi
        if coupled is not None:
            for i in range(n):
                for j in range(i, n):
                    coupled[i, j] += (psi * problem.weights[part, i, j, None]).T @ psi
        centre += phi.T @ phi
        target += phi.T @ rate
        rate_square += np.einsum("ki,ki->i", rate, rate)
    flat = None
    if coupled is not None:
        for i in range(n):
            for j in range(i):
                coupled[i, j] = coupled[j, i]
        flat = coupled.transpose(0, 2, 1, 3).reshape(n * q, n * q)
        flat = 0.5 * (flat + flat.T)
    scale = np.sqrt(np.maximum(rate_square, 0.0) / problem.N)
    return Moments(
        gram,
        plain,
        flat,
        centre,
        target,
        np.sqrt(np.diagonal(centre) / problem.N),
        np.sqrt(np.diagonal(plain) / problem.N),
        np.where(scale > 0, scale, 1.0),
    )
