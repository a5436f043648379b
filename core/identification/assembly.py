# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""From recordings to the identification problem: normalised columns, weights and what they refuse."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import LARGEST, Array, numbers, real
from uncertain_lti.base.errors import FitError
from uncertain_lti.base.text import moment, plural
from uncertain_lti.identification.problem import Columns, Problem, Regimes
from uncertain_lti.model.operating_point import OperatingPoint, normalise_columns
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.values import Additive


def is_constant(dt: Array) -> bool:
    """Whether all steps are equal to a part in 1e6 (an integer clock jitters by a nanosecond).

    `dt` (N,): steps, s.
    """
    return not dt.size or bool(np.ptp(dt) <= 1e-6 * median_step(dt))


def median_step(dt: Array) -> float:
    """Median of Δt; without a sort where all steps are the same.

    `dt` (N,): steps, s; at least one.
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

    `weights` (n,): W(t_{k+1}); N counts the steps of a transient (samples less one), usable or not. None for ones.
    """
    n = len(point.x_s)
    steps = [t.transitions() for t in transients]
    k = _joined([s.k for s in steps])
    source = np.repeat(np.arange(len(steps)), [len(s.k) for s in steps])
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
    further, start, square = np.empty((len(point.s_s), len(dt))), 0, 0.0
    for s in steps:
        stop = start + len(s.dt)
        part = slice(start, stop)
        start = stop
        square += normalise_columns(s.transient.x[:-1], s.k, point.x_s, point.X, z[:n, part])
        square += normalise_columns(s.transient.u[:-1], s.k, point.u_s, point.U, z[n:, part])
        square += normalise_columns(s.transient.s[:-1], s.k, point.s_s, point.S, further[:, part])
        if shared:
            s = s.take(slice(-1, None))
        square += normalise_columns(s.transient.x[1:], s.k, point.x_s, point.X, x_next[:, stop - len(s.k) : stop])
    if not square <= LARGEST**2:
        raise _too_large(transients)
    columns = Columns.of(additive, is_constant(dt), regimes)
    chosen = split_weights(weights, transients, n)
    if isinstance(chosen, list):
        chosen = np.concatenate([w[s.k] for w, s in zip(chosen, steps, strict=True)])
    _refuse_no_metric(chosen)
    factors = _factors(transient_weights, count, source, len(transients))
    if factors is not None:
        factors = factors[source]
        chosen = factors[:, None] * chosen if chosen.ndim < 3 else factors[:, None, None] * chosen
    problem = Problem(z, x_next, dt, chosen, further if len(further) else None, source=source, k=k, columns=columns)
    if regimes is not None:
        refuse_unlisted(problem, regimes, transients)
    return problem


def refuse_unlisted(problem: Problem, regimes: Regimes, transients: Sequence[Transient]) -> None:
    """Refuse a mode that the schedule does not list."""
    vectors = regimes.vectors(problem.z, problem.s)
    for axis, values, row in zip(regimes.schedule.axes, vectors, regimes.positions, strict=True):
        unlisted = np.flatnonzero(~np.isin(values, axis.modes))
        if axis.modes and len(unlisted):
            transient, k = transients[problem.source[unlisted[0]]], int(problem.k[unlisted[0]])
            recorded = np.hstack([transient.x[k], transient.u[k], transient.s[k]])[row]
            raise FitError(
                f"{transient.name}: '{axis.signal}' is {recorded:g} at t = {moment(transient.t[k])} s (and in "
                f"{plural(len(unlisted), 'transition')} of all), a mode that the schedule does not list; list it, or "
                f"leave that part of the recording out"
            )


def _joined(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """One after the other; a single one as it is."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _too_large(transients: Sequence[Transient]) -> FitError:
    """The error for values whose squares overflow, naming signal and recording."""
    largest, name, recording = 0.0, "", ""
    for t in transients:
        for signal, values in zip(t.signal_names, (*t.x.T, *t.u.T, *t.s.T), strict=True):
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
    finite = [np.isfinite(np.concatenate([t.x, t.u, t.s], axis=1)) for t in transients]
    known = sum(f.sum(axis=0) for f in finite)
    counts = dict(zip(first.signal_names, np.asarray(known).tolist(), strict=True))
    never = [name for name, count in counts.items() if not count]
    if never:
        many = len(never) > 1
        return (
            f"{', '.join(never)} {'have' if many else 'has'} no value in any of them (missing, not finite or too old, "
            f"see max_hold and max_skew), so check {'their fields' if many else 'its field'} in the signals file"
        )
    signals = first.signals
    of_one = [i for i, s in enumerate(signals.states) if s.topic == signals.clock] if signals is not None else []
    if len(of_one) > 1 and not any(f[:, of_one].all(axis=1).any() for f in finite):
        together = ", ".join(first.state_names[i] for i in of_one)
        return (
            f"no message of {signals.clock if signals else ''} has all of {together}; fit a "
            f"model for those that come together, or publish all in one message, as joint_state_publisher with "
            f"source_list does"
        )
    seldom = [f"{name} in {count}" for name, count in counts.items() if count < total]
    if seldom and not any((whole[1:] & whole[:-1]).any() for whole in (f.all(axis=1) for f in finite)):
        return (
            f"no two in a row have every signal; there is a value of {', '.join(seldom)} of them (otherwise missing, "
            f"not finite or too old, see max_hold and max_skew), so check the signals file"
        )
    if (late := sum(t.counters["late"] for t in transients)) > total:
        return f"time steps back before {late} more, which are left out; put them in the order of their times"
    return "no two in a row are at most max_gap and at least min_step apart, so check these in the signals file"


def _factors(
    transient_weights: Sequence[float] | None, count: str, source: NDArray[np.intp], transients: int
) -> Array | None:
    """Factor on the weights of each transient; None where all are 1."""
    if count not in ("sample", "transient"):
        raise FitError(f"count is {count!r}; it must be sample or transient")
    factors = np.ones(transients)
    if transient_weights is not None:
        factors = numbers(transient_weights, "transient_weights", (...,), FitError)
        if factors.shape != (transients,) or not (np.isfinite(factors).all() and (factors > 0).all()):
            raise FitError(f"transient_weights must be {transients} positive numbers, one per transient")
    if count == "transient":
        lengths = np.bincount(source, minlength=transients)
        factors = factors * len(source) / (np.maximum(lengths, 1) * np.count_nonzero(lengths))
    return None if (factors == 1.0).all() else factors


def scaled_eigenvalues(weights: Array) -> Array:
    """Eigenvalues of full weights whose diagonals are scaled to ones.

    The scales of the states are taken apart, as their squares may differ by more than arithmetic holds.

    `weights` (K, n, n): symmetric; Returns (K, n): in rising order.
    """
    unit = 1.0 / np.sqrt(np.maximum(np.einsum("kii->ki", weights), 1e-300))
    return np.asarray(np.linalg.eigvalsh(weights * unit[:, :, None] * unit[:, None, :]))


def split_weights(
    weights: ArrayLike | Sequence[ArrayLike] | None, transients: Sequence[Transient], n: int
) -> Array | list[Array]:
    """Weights of the steps of each transient; one array (n,) where they are the same in every step."""
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
            return [real(w) for w in weights]
        stacked = real(weights)
    except (TypeError, ValueError):
        raise FitError("weights are not arrays of real numbers; give (n,), (N, n) or (N, n, n)") from None
    total = sum(lengths)
    if stacked.shape == (n,):
        return stacked
    if stacked.shape not in ((total, n), (total, n, n)):
        raise FitError(
            f"weights have shape {stacked.shape}; they must be ({n},), ({total}, {n}) or ({total}, {n}, {n}), "
            f"one per step of the transients"
        )
    return np.split(stacked, np.cumsum(lengths)[:-1])


def _refuse_no_metric(chosen: Array) -> None:
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
