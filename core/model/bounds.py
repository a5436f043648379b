# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""One-step bounds, Leibov (2006), eqs. (6)-(9): the arithmetic of every verdict, offline and live.

With phi = [x; u; 1], psi = |phi| and the terms of the model side by side (`terms`), for each state

    centre = x + dt * (Theta phi)
    half   = dt * (Delta psi) + v
    lower  = centre - half * margin,   upper = centre + half * margin

and a sample is contained if lower <= x_next <= upper. Where the model is scheduled, Theta, Delta and v are first
blended from its blocks with the weights of the scheduling vector, element by element (`schedule`). Every sum
goes from the first column to the last, whether one sample is judged or a million, compiled or not, so all of them give
the same bits (`sums` of many samples at once, `_Elements` of one in compiled code).

The equations come first. `centre_and_half` is them for many samples, `Judge` for one transition after another, with
what it says in a `Judgement`, and `Runs` for the states several steps on. They stay in one file, as they are compiled
together: the equations are inlined into the loops.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import Any

try:
    import cython
except ImportError:  # Cython is not needed to run
    from uncertain_lti.base import uncompiled as cython

import numpy as np

from uncertain_lti.base.compiled import use_twin
from uncertain_lti.model.sums import blended, ordered_sum

# The functions below are the equations. Uncompiled they take arrays and numbers alike, compiled they take doubles.


@cython.cfunc
@cython.inline
@cython.exceptval(check=False)
def normalised(value: cython.double, steady: cython.double, scale: cython.double) -> cython.double:
    """Deviation from the steady state, without dimension."""
    return (value - steady) / scale


@cython.cfunc
@cython.inline
@cython.exceptval(check=False)
def recorded(value: cython.double, steady: cython.double, scale: cython.double) -> cython.double:
    """Deviation in recorded units: the inverse of `normalised`."""
    return steady + scale * value


@cython.cfunc
@cython.inline
@cython.exceptval(check=False)
def centre_of(x: cython.double, dt: cython.double, rate: cython.double) -> cython.double:
    """Centre of the bounds one step after x, where Theta phi = rate."""
    return rate * dt + x


@cython.cfunc
@cython.inline
@cython.exceptval(check=False)
def half_of(dt: cython.double, spread: cython.double, v: cython.double) -> cython.double:
    """Half-width of the bounds, where Delta psi = spread."""
    return spread * dt + v


@cython.cfunc
@cython.inline
@cython.exceptval(check=False)
def lower_of(centre: cython.double, half: cython.double, margin: cython.double) -> cython.double:
    """Eq. (6) with a margin."""
    return centre - half * margin


@cython.cfunc
@cython.inline
@cython.exceptval(check=False)
def upper_of(centre: cython.double, half: cython.double, margin: cython.double) -> cython.double:
    """Eq. (7) with a margin."""
    return centre + half * margin


@cython.cfunc
@cython.inline
@cython.exceptval(check=False)
def contained(lower: cython.double, x_next: cython.double, upper: cython.double) -> cython.bint:
    """Whether the sample lies within its bounds, Leibov (2006), eqs. (8)(9)."""
    return (lower <= x_next) & (x_next <= upper)


@cython.cfunc
@cython.inline
@cython.exceptval(check=False)
def outside(z: cython.double, least: cython.double, greatest: cython.double) -> cython.bint:
    """Whether a value lies outside the range that the fit saw."""
    return (z < least) | (z > greatest)


@cython.cfunc
@cython.exceptval(check=False)
@cython.cdivision(True)
def utilisation_of(difference: cython.double, half: cython.double) -> cython.double:
    """(x_next - centre) / half; where half is 0, 0 for no difference and otherwise infinite with its sign."""
    if cython.compiled:
        return 0.0 if difference == 0.0 else difference / half  # as C divides
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.where(difference == 0.0, 0.0, difference / half)


@cython.cfunc
@cython.inline
@cython.exceptval(check=False)
def settled(utilisation: cython.double, inside: cython.bint) -> cython.double:
    """Utilisation whose size is at most 1 exactly where the sample is contained: on the edge rounding decides.

    Of a run that left all numbers it is infinite: NaN is no verdict.
    """
    above = 1.0000000000000002  # the next number after 1
    if cython.compiled:
        if inside:
            return 1.0 if utilisation > 1.0 else -1.0 if utilisation < -1.0 else utilisation
        if utilisation != utilisation:
            return float("inf")
        return above if 0.0 <= utilisation <= 1.0 else -above if -1.0 <= utilisation < 0.0 else utilisation
    edge = np.where(utilisation < 0.0, -above, above)
    left = np.where(np.isnan(utilisation), np.inf, np.where(np.abs(utilisation) <= 1.0, edge, utilisation))
    return np.where(inside, np.clip(utilisation, -1.0, 1.0), left)


@cython.cfunc
@cython.inline
@cython.exceptval(check=False)
def cell_of(z: cython.double, least: cython.double, per_unit: cython.double, last: cython.int) -> cython.int:
    """Cell of its range that a value lies in."""
    place = (z - least) * per_unit
    if cython.compiled:
        return 0 if not place > 0.0 else last if place > last else cython.cast(cython.int, place)
    return np.clip(place, 0, last).astype(np.intp)


@cython.cfunc
@cython.inline
@cython.exceptval(check=False)
@cython.cdivision(True)
def weight_between(s: cython.double, low: cython.double, high: cython.double) -> cython.double:
    """Weight of the upper of two knots by linear interpolation; that of the lower one is 1 less it."""
    weight = (s - low) / (high - low)
    if cython.compiled:
        return 0.0 if weight < 0.0 else 1.0 if weight > 1.0 else weight
    return np.clip(weight, 0.0, 1.0)


def pairs_of(size: int) -> tuple[Any, Any]:
    """Pairs of signals whose combinations a domain knows; of one signal alone, itself.

    Returns (pairs,): their positions in [x; u].
    """
    return np.triu_indices(size, 1) if size > 1 else (np.zeros(1, dtype=np.intp), np.zeros(1, dtype=np.intp))


def cells_per_unit(least: Any, greatest: Any, cells: int) -> Any:
    """Cells per normalised unit of each signal; 0 where it does not move.

    `least` (n + m,): begin of the range of each signal; `greatest` (n + m,): end of it; Returns (n + m,): what
    `cell_of` takes.
    """
    span = np.subtract(greatest, least)
    return np.divide(cells, span, out=np.zeros_like(span), where=(span > 0) & np.isfinite(span))


def visited(z: Any, least: Any, greatest: Any, occupied: Any) -> Any:
    """Whether every pair of signals lies in an occupied cell.

    `least` (n + m,): begin of the range of each signal; `greatest` (n + m,): end of it; `occupied` (pairs, cells,
    cells): of each pair of `pairs_of`.
    """
    if cython.compiled:
        raise TypeError("compiled code takes one sample after another")
    cells = occupied.shape[1]
    place = cell_of(z, least, cells_per_unit(least, greatest, cells), cells - 1)
    first, second = pairs_of(z.shape[-1])
    return occupied[np.arange(len(first)), place[..., first], place[..., second]].all(axis=-1)


def centre_and_half(
    theta: Any, delta: Any, v: Any, phi: Any, dt: Any, places: Any = None, weights: Any = None, base: Any = None
) -> tuple[Any, Any]:
    """Centre and half-width of the bounds of K samples at once.

    `theta, delta` (n, p): nominal elements and half-widths of the rates, 1/s; `v` (n,): half-width that dt does not
    multiply; `phi` (p, K): regressors, the states first; `dt` (K,): s; `places` (C, K): blocks that hold at each
    sample, of a scheduled model; `weights` (C, K): their weights; `base` (n, K): what the rates are added to, over a
    horizon the run of the nominal model; default the states; Returns (n, K): centre, normalised; Returns (n, K): half-
    width, normalised.
    """
    columns = phi[:, None, :]
    theta, delta = theta.swapaxes(-1, -2), delta.swapaxes(-1, -2)  # (..., p, n)
    if places is None:
        theta, delta, v = np.ascontiguousarray(theta)[..., None], np.ascontiguousarray(delta)[..., None], v[:, None]
    else:
        theta, delta = blended(theta, places, weights), blended(delta, places, weights)
        v = blended(v, places, weights)
    rate = ordered_sum(theta, columns)
    spread = ordered_sum(delta, np.abs(columns))
    return centre_of(phi[: len(v)] if base is None else base, dt, rate), half_of(dt, spread, v)


LOWER, UPPER, RESIDUAL, FLAGS, UTILISATION = range(5)
"""What a `Judgement` holds of each state."""
_TOGETHER = 64  # runs that one compiled loop advances: they stay in the cache
_FEW = 8192  # runs that one numpy operation advances


@cython.cclass
class _Elements:
    """Elements of one model, or of one of its horizons, and the sums of one sample in compiled code.

    `theta, delta` (n, p): nominal elements and half-widths of the rates, 1/s; `v` (n,): half-width that dt does not
    multiply.
    """

    n: cython.Py_ssize_t
    p: cython.Py_ssize_t
    theta: cython.double[::1]  # block after block, column after column, as the sums walk
    delta: cython.double[::1]
    v: cython.double[::1]
    rate: cython.double[::1]  # of the last sample, as the three below
    spread: cython.double[::1]
    still: cython.double[::1]  # what dt does not multiply
    nominal: cython.double[::1]  # theta, where it was asked for
    _psi: cython.double[::1]
    _column: cython.double[::1]

    def __init__(self, theta: Any, delta: Any, v: Any) -> None:
        self.n, self.p = theta.shape[-2:]
        self.theta, self.delta = _doubles(np.swapaxes(theta, -1, -2)), _doubles(np.swapaxes(delta, -1, -2))
        self.v = _doubles(v)
        self.rate, self.spread = _doubles(np.zeros(self.n)), _doubles(np.zeros(self.n))
        self.still, self._column = _doubles(np.zeros(self.n)), _doubles(np.zeros(self.n))
        self.nominal, self._psi = _doubles(np.zeros(self.n * self.p)), _doubles(np.zeros(self.p))

    @cython.cfunc
    @cython.boundscheck(False)
    @cython.wraparound(False)
    @cython.exceptval(check=False)
    def sum(
        self, phi: cython.p_double, places: cython.p_longlong, weights: cython.p_double, corners: cython.Py_ssize_t
    ) -> cython.void:
        """`rate`, `spread` and `still` of regressors, with the blocks in their places by their weights."""
        j: cython.Py_ssize_t
        for j in range(self.p):
            self._psi[j] = abs(phi[j])
        self._blend(self.v, self.n, 0, self.n, places, weights, corners, cython.address(self.still[0]))
        self.sum_columns(self.theta, phi, places, weights, corners, cython.address(self.rate[0]))
        psi: cython.p_double = cython.address(self._psi[0])
        self.sum_columns(self.delta, psi, places, weights, corners, cython.address(self.spread[0]))

    @cython.cfunc
    @cython.boundscheck(False)
    @cython.wraparound(False)
    @cython.exceptval(check=False)
    def sum_columns(
        self,
        table: cython.double[::1],
        values: cython.p_double,
        places: cython.p_longlong,
        weights: cython.p_double,
        corners: cython.Py_ssize_t,
        total: cython.p_double,
    ) -> cython.void:
        """`ordered_sum` of a table and one value for each column: the rows of a column beside each other."""
        n: cython.Py_ssize_t = self.n
        i: cython.Py_ssize_t
        j: cython.Py_ssize_t
        value: cython.double
        column: cython.p_double = cython.address(self._column[0])
        for j in range(self.p):
            value = values[j]
            if corners == 0:
                column = cython.address(table[j * n])
            else:
                self._blend(table, n * self.p, j * n, n, places, weights, corners, column)
            if j == 0:
                for i in range(n):
                    total[i] = column[i] * value
            else:
                for i in range(n):
                    total[i] += column[i] * value

    @cython.cfunc
    @cython.boundscheck(False)
    @cython.wraparound(False)
    @cython.exceptval(check=False)
    def blend_nominal(
        self, places: cython.p_longlong, weights: cython.p_double, corners: cython.Py_ssize_t
    ) -> cython.void:
        """`nominal` with the blocks in their places by their weights."""
        size: cython.Py_ssize_t = self.n * self.p
        self._blend(self.theta, size, 0, size, places, weights, corners, cython.address(self.nominal[0]))

    @cython.cfunc
    @cython.inline
    @cython.boundscheck(False)
    @cython.wraparound(False)
    @cython.exceptval(check=False)
    def _blend(
        self,
        table: cython.double[::1],
        size: cython.Py_ssize_t,
        begin: cython.Py_ssize_t,
        count: cython.Py_ssize_t,
        places: cython.p_longlong,
        weights: cython.p_double,
        corners: cython.Py_ssize_t,
        total: cython.p_double,
    ) -> cython.void:
        """`blended` of some elements in blocks of a size; of no schedule, which has no corners, the elements."""
        i: cython.Py_ssize_t
        a: cython.p_double = cython.address(table[begin])
        if corners == 0:
            for i in range(count):
                total[i] = a[i]
            return
        first: cython.double = weights[0]
        a = cython.address(table[places[0] * size + begin])
        if corners == 1:
            for i in range(count):
                total[i] = a[i] * first
            return
        second: cython.double = weights[1]
        b: cython.p_double = cython.address(table[places[1] * size + begin])
        if corners == 2:
            for i in range(count):
                total[i] = a[i] * first + b[i] * second
            return
        third: cython.double = weights[2]
        fourth: cython.double = weights[3]
        c: cython.p_double = cython.address(table[places[2] * size + begin])
        d: cython.p_double = cython.address(table[places[3] * size + begin])
        for i in range(count):
            total[i] = a[i] * first + b[i] * second + c[i] * third + d[i] * fourth


@cython.cclass
class Judgement:
    """What the bounds say of one transition.

    `values`: what `numbers` is computed from; compiled and uncompiled code keep different things; `contained`: as the
    attribute; `violation`: as the attribute; `outside_domain`: as the attribute; `unknown_regime`: as the attribute.
    """

    contained = cython.declare(cython.bint, visibility="readonly")
    violation = cython.declare(cython.bint, visibility="readonly")
    outside_domain = cython.declare(cython.bint, visibility="readonly")
    unknown_regime = cython.declare(cython.bint, visibility="readonly")
    _values = cython.declare(object)

    def __init__(
        self, values: Any, contained: bool, violation: bool, outside_domain: bool, unknown_regime: bool
    ) -> None:
        self._values = values
        self.contained, self.violation = contained, violation
        self.outside_domain, self.unknown_regime = outside_domain, unknown_regime

    def numbers(self, which: int) -> Any:
        """Bound (recorded units), utilisation, residual (normalised) or flag (0 contained, 1 violated) of each state.
        """
        if cython.compiled:
            n = len(self._values) // 5
            return self._values[which * n : which * n + n]
        centre, half, lower, upper, x_next, inside, steady, scale = self._values
        if which == LOWER:
            return recorded(lower, steady, scale)
        if which == UPPER:
            return recorded(upper, steady, scale)
        if which == UTILISATION:
            return utilisation_of(x_next - centre, half)
        if which == RESIDUAL:
            return x_next - centre
        return np.subtract(1.0, inside, dtype=np.float64)

    def packed(self) -> bytes:
        """All of it, one kind after another."""
        if cython.compiled:
            return bytes(self._values.tobytes())
        return b"".join([self.numbers(which).tobytes() for which in range(UTILISATION + 1)])


@cython.cclass
class Judge:
    """Judges one transition after another by the bounds of one model.

    `theta` (n, p): nominal elements of the rates, for φ = [x; u; 1] (`terms.tables`), 1/s; `delta` (n, p): their half-
    widths, for ψ = |φ|, 1/s; `v` (n,): half-width that dt does not multiply; `steady` (n + m + q,): steady states of
    [x; u; s], with s the q further scheduling signals; `scale` (n + m + q,): scales of [x; u; s]; `least` (n + m,):
    least normalised [x; u] that the fit saw; `greatest` (n + m,): greatest normalised [x; u] that the fit saw;
    `margin`: multiplies the half-widths; `counted` (n,): states whose violations count; `occupied` (pairs, cells,
    cells): combinations of two signals that the fit saw (`domain.Occupancy`); `schedule`: weights of the blocks; None
    for one block; `positions`: where its scheduling signals are in [x; u; s]; `known` (R,): blocks that a recording
    visited; default all.
    """

    n: cython.Py_ssize_t
    size: cython.Py_ssize_t
    total: cython.Py_ssize_t
    p: cython.Py_ssize_t
    blocks: cython.Py_ssize_t
    margin: cython.double
    _elements = cython.declare(_Elements)
    _steady: cython.double[::1]
    _scale: cython.double[::1]
    _least: cython.double[::1]
    _greatest: cython.double[::1]
    _counted: cython.uchar[::1]
    _phi: cython.double[::1]
    _blank = cython.declare(object)
    _cells: cython.int
    _per_unit: cython.double[::1]
    _occupied: cython.uchar[::1]
    _place: cython.int[::1]
    _z: cython.double[::1]
    _axes: cython.Py_ssize_t
    _of_modes: cython.uchar[::1]
    _positions: cython.int[::1]
    _begin: cython.int[::1]  # of the knots or modes of each axis in the next
    _values: cython.double[::1]
    _known: cython.uchar[::1]
    _places: cython.longlong[::1]
    _weights: cython.double[::1]
    _corners: cython.Py_ssize_t  # blocks that hold at a time; 0 without a schedule
    _rates: cython.double[::1]
    _together: cython.Py_ssize_t

    def __init__(
        self,
        theta: Any,
        delta: Any,
        v: Any,
        steady: Any,
        scale: Any,
        least: Any,
        greatest: Any,
        margin: float,
        counted: Any,
        occupied: Any = None,
        schedule: Any = None,
        positions: Sequence[int] = (),
        known: Any = None,
    ) -> None:
        self.n, self.p = theta.shape[-2:]
        self.size, self.total = len(least), len(steady)
        self.blocks = 1 if schedule is None else schedule.blocks
        self.margin = margin
        lead = () if schedule is None else (self.blocks,)
        known = np.ones(self.blocks, dtype=bool) if known is None else np.asarray(known, dtype=bool)
        if not theta.shape == delta.shape == (*lead, self.n, self.p) or v.shape != (*lead, self.n):
            raise ValueError("the terms do not fit one another")
        if len(counted) != self.n or self.p < self.size or known.shape != (self.blocks,):
            raise ValueError("the terms do not fit one another")
        if not len(scale) == self.total >= self.size == len(greatest) >= self.n:
            raise ValueError("the operating point or the domain does not fit the terms")
        inside = [0 <= i < self.total for i in positions]
        if schedule is not None and not (len(inside) == len(schedule.axes) and all(inside)):
            raise ValueError("the schedule does not fit the signals")
        self._cells = 0 if occupied is None else occupied.shape[1]
        if occupied is not None and occupied.shape != (len(pairs_of(self.size)[0]), self._cells, self._cells):
            raise ValueError("the occupied cells do not fit the signals")
        one = np.ones(self.p)  # beyond z the regressors are 1
        if cython.compiled:
            self._elements = _Elements(theta, delta, v)
            axes = () if schedule is None else schedule.axes
            self._axes = len(axes)
            self._corners = 2 ** sum(not axis.modes for axis in axes) if axes else 0
            self._of_modes = bytearray([int(bool(axis.modes)) for axis in axes] or [0])
            self._positions = array("i", list(positions) or [0])
            begins = [0]
            for axis in axes:
                begins.append(begins[-1] + len(axis))
            self._begin = array("i", begins)
            self._values = array("d", [v for axis in axes for v in axis.values] or [0.0])
            self._known = bytearray(known.astype(np.uint8).tobytes())
            self._z = _doubles(np.zeros(self.total))
            self._places, self._weights = array("q", bytes(32)), array("d", bytes(32))
            self._steady, self._scale = _doubles(steady), _doubles(scale)
            self._least, self._greatest = _doubles(least), _doubles(greatest)
            self._counted = bytearray(np.asarray(counted, dtype=np.uint8).tobytes())
            self._phi = _doubles(one)
            self._blank = array("d", bytes(40 * self.n))
            self._per_unit = _doubles(cells_per_unit(least, greatest, self._cells))
            flat = np.zeros(1, bool) if occupied is None else occupied
            self._occupied = bytearray(np.ascontiguousarray(flat, dtype=np.uint8).tobytes())
            self._place = array("i", bytes(4 * self.size))
            self._together = _TOGETHER
            self._rates = _doubles(np.zeros(self.n * _TOGETHER))
        else:
            both = np.stack([np.swapaxes(theta, -1, -2), np.swapaxes(delta, -1, -2)], axis=-2)
            self._both = np.ascontiguousarray(both)  # (p, 2, n), or (R, p, 2, n)
            self._nominal = np.ascontiguousarray(np.swapaxes(theta, -1, -2))  # (p, n), or (R, p, n)
            self._schedule, self._known = schedule, known
            self._positions = list(positions)
            self._phi = np.stack([one, one])[:, :, None].transpose(1, 0, 2).copy()  # (p, 2, 1): phi and psi
            self._v, self._least, self._greatest, self._occupied = v, least, greatest, occupied
            # z_k and x_{k+1} side by side, as both are normalised alike
            self._steady = np.concatenate([steady, steady[: self.n]])
            self._scale = np.concatenate([scale, scale[: self.n]])
            self._uncounted = ~np.asarray(counted, dtype=bool)

    def judge(self, before: Sequence[float], after: Sequence[float], dt: cython.double) -> Judgement | None:
        """Judge one transition."""
        if len(before) != self.total or len(after) != self.n:
            raise ValueError(f"{len(before)} and {len(after)} values for {self.total} and {self.n} signals")
        if cython.compiled:
            return self._one(before, after, dt)
        with np.errstate(over="ignore", invalid="ignore"):  # values that the arithmetic cannot carry leave the bounds
            return self._of_arrays(before, after, dt)

    def _of_arrays(self, before: Sequence[float], after: Sequence[float], dt: float) -> Judgement | None:
        """`_one` by numpy."""
        if cython.compiled:
            return None  # not called there
        n = self.n
        z = normalised(np.array([*before, *after], dtype=np.float64), self._steady, self._scale)
        s, z, x_next = z[self._positions], z[: self.size], z[-n:]
        self._phi[: len(z), 0, 0] = z
        np.abs(z, out=self._phi[: len(z), 1, 0])
        both, v, unknown = self._both, self._v, False
        if self._schedule is not None:
            places, weights = self._schedule.corners(s[:, None])
            if places[0, 0] < 0:
                return None
            both, v = blended(both, places, weights)[..., 0], blended(v, places, weights)[..., 0]
            unknown = bool(self._schedule.unknown(s[:, None], places, weights, self._known)[0])
        rate, spread = ordered_sum(both, self._phi)
        centre, half = centre_of(z[:n], dt, rate), half_of(dt, spread, v)
        lower, upper = lower_of(centre, half, self.margin), upper_of(centre, half, self.margin)
        inside = contained(lower, x_next, upper)
        values = centre, half, lower, upper, x_next, inside, self._steady[:n], self._scale[:n]
        every = bool(inside.all())
        violation = not every and not bool((inside | self._uncounted).all())
        left = unknown or bool(outside(z, self._least, self._greatest).any())
        if self._cells and not left:
            left = not visited(z, self._least, self._greatest, self._occupied)
        return Judgement(values, every, violation, left, unknown)

    @cython.cfunc
    @cython.boundscheck(False)
    @cython.wraparound(False)
    def _one(self, before: Any, after: Any, dt: cython.double) -> Judgement | None:
        n: cython.Py_ssize_t = self.n
        i: cython.Py_ssize_t
        left: cython.bint = False
        every: cython.bint = True
        violation: cython.bint = False
        unknown: cython.bint = False
        regime: cython.int = 0
        regime = self._read(before)
        if regime < 0:
            return None
        left = unknown = regime > 0
        for i in range(self.size):
            left = left or outside(self._phi[i], self._least[i], self._greatest[i])
        if self._cells and not left:
            left = self._unvisited()
        elements: _Elements = self._elements
        elements.sum(
            cython.address(self._phi[0]),
            cython.address(self._places[0]),
            cython.address(self._weights[0]),
            self._corners,
        )
        blank = array("d", self._blank)
        values: cython.double[::1] = blank
        x_next: cython.double
        centre: cython.double
        half: cython.double
        lower: cython.double
        upper: cython.double
        inside: cython.bint
        for i in range(n):
            x_next = after[i]
            x_next = normalised(x_next, self._steady[i], self._scale[i])
            centre, half = (
                centre_of(self._phi[i], dt, elements.rate[i]),
                half_of(dt, elements.spread[i], elements.still[i]),
            )
            lower, upper = lower_of(centre, half, self.margin), upper_of(centre, half, self.margin)
            inside = contained(lower, x_next, upper)
            if not inside:
                every = False
                violation = violation or self._counted[i]
            values[i] = recorded(lower, self._steady[i], self._scale[i])
            values[n + i] = recorded(upper, self._steady[i], self._scale[i])
            values[2 * n + i] = x_next - centre
            values[3 * n + i] = not inside
            values[4 * n + i] = utilisation_of(x_next - centre, half)
        return Judgement(blank, every, violation, left, unknown)

    @cython.cfunc
    @cython.boundscheck(False)
    @cython.wraparound(False)
    def _read(self, before: Any) -> cython.int:
        """Normalise [x; u; s] and find the blocks that hold there: -1 for no mode that is listed, 1 if unknown."""
        i: cython.Py_ssize_t
        z: cython.double
        for i in range(self.size):
            z = before[i]
            self._phi[i] = normalised(z, self._steady[i], self._scale[i])
        if not self._axes:
            return 0
        for i in range(self.size, self.total):
            z = before[i]
            self._z[i] = normalised(z, self._steady[i], self._scale[i])
        return self._find_blocks()

    @cython.cfunc
    @cython.boundscheck(False)
    @cython.wraparound(False)
    @cython.exceptval(check=False)
    def _find_blocks(self) -> cython.int:
        """`Schedule.corners` of one sample, into `_places` and `_weights`, and what `_read` gives."""
        axis: cython.Py_ssize_t
        corner: cython.Py_ssize_t
        corners: cython.Py_ssize_t = 1
        j: cython.Py_ssize_t
        last: cython.Py_ssize_t
        size: cython.Py_ssize_t
        k: cython.Py_ssize_t
        s: cython.double
        high: cython.double
        unknown: cython.int = 0
        places: cython.longlong[::1] = self._places
        weights: cython.double[::1] = self._weights
        places[0] = 0
        weights[0] = 1.0
        for axis in range(self._axes):
            k = self._positions[axis]
            s = self._phi[k] if k < self.size else self._z[k]
            if s != s:
                return -1
            size = self._begin[axis + 1] - self._begin[axis]
            last = self._begin[axis]
            if self._of_modes[axis]:
                j = 0
                while j < size and self._values[last + j] != s:
                    j += 1
                if j == size:
                    return -1
                for corner in range(corners):
                    places[corner] = places[corner] * size + j
                continue
            if s < self._values[last] or s > self._values[last + size - 1]:
                unknown = 1
            j = 0
            while j < size - 2 and self._values[last + j + 1] <= s:
                j += 1
            high = weight_between(s, self._values[last + j], self._values[last + j + 1])
            for corner in range(corners - 1, -1, -1):  # from the back: two take the place of one
                places[2 * corner + 1] = places[corner] * size + j + 1
                weights[2 * corner + 1] = weights[corner] * high
                places[2 * corner] = places[corner] * size + j
                weights[2 * corner] = weights[corner] * (1.0 - high)
            corners *= 2
        for corner in range(corners):
            if weights[corner] > 0.0 and not self._known[places[corner]]:
                unknown = 1
        return unknown

    @cython.cfunc
    @cython.boundscheck(False)
    @cython.wraparound(False)
    @cython.exceptval(check=False)
    def _unvisited(self) -> cython.bint:
        """`visited`, the other way round, pair after pair."""
        i: cython.Py_ssize_t
        j: cython.Py_ssize_t
        pair: cython.Py_ssize_t = 0
        cells: cython.Py_ssize_t = self._cells
        for i in range(self.size):
            self._place[i] = cell_of(self._phi[i], self._least[i], self._per_unit[i], self._cells - 1)
        if self.size == 1:
            return not self._occupied[self._place[0] * cells + self._place[0]]
        for i in range(self.size):
            for j in range(i + 1, self.size):
                if not self._occupied[(pair * cells + self._place[i]) * cells + self._place[j]]:
                    return True
                pair += 1
        return False

    def advance(
        self, x: Any, time: Any, control: Any, z: Any, dt: Any, begin: Any, a: cython.Py_ssize_t, b: cython.Py_ssize_t
    ) -> None:
        """Take runs of the nominal model from a steps to b, the run k being the one that begins at transition k.

        Of a transition at which a run may not go on, what is computed for that run has no meaning.

        `x` (n, N): state of each run after a steps, normalised; takes the result; `time` (N,): Σ Δt of the steps so
        far, s; takes the result; `control` (m, N): Σ Δt u of the steps so far; takes the result; `z` (n + m + q, N):
        normalised [x; u; s] of the transitions, in order of time; `dt` (N,): s; `begin` (N,): of each transition the
        first of those that follow one another without a break up to it.
        """
        n, count = self.n, len(dt)
        fits = x.shape == (n, count) and z.shape == (self.total, count) and control.shape == (self.size - n, count)
        if not (fits and len(time) == len(begin) == count and 0 <= a <= b):
            raise ValueError("the runs do not fit the transitions")
        if cython.compiled:
            whole = x.flags.c_contiguous and control.flags.c_contiguous and time.flags.c_contiguous
            if not (whole and begin.dtype == np.int64):
                raise ValueError("the runs are not laid out row by row")
            rows = np.ascontiguousarray(z.T, dtype=np.float64).reshape(-1)
            controls = control.reshape(-1) if control.size else np.zeros(1)
            if count:
                self._advance_all(x.reshape(-1), time, controls, rows, np.array(dt, dtype=np.float64), begin, a, b)
        else:
            with np.errstate(over="ignore", invalid="ignore"):
                self._advance_arrays(x, time, control, z, dt, a, b)

    def _advance_arrays(self, x: Any, time: Any, control: Any, z: Any, dt: Any, a: int, b: int) -> None:
        """`_advance_all` by numpy, step after step."""
        if cython.compiled:
            return  # not called there
        count = len(dt)
        for j in range(a, b):
            for first in range(0, count - j, _FEW):
                runs = slice(first, min(first + _FEW, count - j))
                at = slice(runs.start + j, runs.stop + j)
                self._advance_columns(x[:, runs], time[runs], control[:, runs], z[:, at], dt[at])

    def _advance_columns(self, x: Any, time: Any, control: Any, z: Any, dt: Any) -> None:
        """One step of runs in columns (n, K), each by the transition beside it, z (n + m + q, K or 1)."""
        if cython.compiled:
            return  # not called there
        u = z[self.n : self.size]
        ones = np.ones((self.p - self.size, x.shape[1]))
        phi = np.concatenate([x, np.broadcast_to(u, (len(u), x.shape[1])), ones])
        theta = self._nominal[..., None]
        if self._schedule is not None:
            theta = blended(self._nominal, *self._schedule.corners(z[self._positions]))
        rate = ordered_sum(theta, phi[:, None, :])
        x[:] = centre_of(x, dt, rate)
        time += dt
        control += u * dt

    @cython.cfunc
    @cython.boundscheck(False)
    @cython.wraparound(False)
    def _advance_all(
        self,
        x: cython.double[::1],
        time: cython.double[::1],
        control: cython.double[::1],
        rows: cython.double[::1],
        dt: cython.double[::1],
        begin: cython.longlong[::1],
        a: cython.Py_ssize_t,
        b: cython.Py_ssize_t,
    ) -> cython.void:
        """`advance`, transition after transition, each blended once for all the runs that it takes further."""
        i: cython.Py_ssize_t
        j: cython.Py_ssize_t
        low: cython.Py_ssize_t
        count: cython.Py_ssize_t = dt.shape[0]
        for i in range(count):
            low = begin[i] if begin[i] > i - b + 1 else i - b + 1
            low = low if low > 0 else 0
            if low > i - a:
                continue
            for j in range(self.size):
                self._phi[j] = rows[i * self.total + j]
            for j in range(self.size, self.total):
                self._z[j] = rows[i * self.total + j]
            if self._axes:
                self._find_blocks()
            self._advance(x, time, control, count, low, i - a + 1, dt[i])

    @cython.cfunc
    @cython.boundscheck(False)
    @cython.wraparound(False)
    @cython.exceptval(check=False)
    def _advance(
        self,
        x: cython.double[::1],
        time: cython.double[::1],
        control: cython.double[::1],
        stride: cython.Py_ssize_t,
        low: cython.Py_ssize_t,
        high: cython.Py_ssize_t,
        dt: cython.double,
    ) -> cython.void:
        """One step of the runs low to high - 1 by the transition in `_phi`, with the blocks in `_places`."""
        n: cython.Py_ssize_t = self.n
        i: cython.Py_ssize_t
        j: cython.Py_ssize_t
        k: cython.Py_ssize_t
        width: cython.Py_ssize_t
        most: cython.Py_ssize_t = self._together
        value: cython.double
        rate: cython.p_double
        state: cython.p_double
        if high - low > 1 and self._corners:
            self._elements.blend_nominal(
                cython.address(self._places[0]), cython.address(self._weights[0]), self._corners
            )
        while low < high:
            width = high - low if high - low < most else most
            if width == 1:
                self._rates_of_one(x, stride, low)
            else:
                self._rates_of_many(x, stride, low, width)
            for i in range(n):
                rate = cython.address(self._rates[i * most])
                state = cython.address(x[i * stride + low])
                for k in range(width):
                    state[k] = centre_of(state[k], dt, rate[k])
            state = cython.address(time[low])
            for k in range(width):
                state[k] += dt
            for j in range(n, self.size):
                value = self._phi[j] * dt
                state = cython.address(control[(j - n) * stride + low])
                for k in range(width):
                    state[k] += value
            low += width

    @cython.cfunc
    @cython.boundscheck(False)
    @cython.wraparound(False)
    @cython.exceptval(check=False)
    def _rates_of_many(
        self, x: cython.double[::1], stride: cython.Py_ssize_t, low: cython.Py_ssize_t, width: cython.Py_ssize_t
    ) -> cython.void:
        """`ordered_sum` of the nominal elements and the states of runs beside each other, into `_rates`."""
        n: cython.Py_ssize_t = self.n
        i: cython.Py_ssize_t
        j: cython.Py_ssize_t
        k: cython.Py_ssize_t
        value: cython.double
        rate: cython.p_double
        state: cython.p_double
        theta: cython.double[::1] = self._elements.nominal if self._corners else self._elements.theta
        for i in range(n):
            rate = cython.address(self._rates[i * self._together])
            state = cython.address(x[low])
            value = theta[i]
            for k in range(width):
                rate[k] = value * state[k]
            for j in range(1, n):
                state = cython.address(x[j * stride + low])
                value = theta[j * n + i]
                for k in range(width):
                    rate[k] += value * state[k]
            for j in range(n, self.p):
                value = theta[j * n + i] * self._phi[j]
                for k in range(width):
                    rate[k] += value

    @cython.cfunc
    @cython.boundscheck(False)
    @cython.wraparound(False)
    @cython.exceptval(check=False)
    def _rates_of_one(self, x: cython.double[::1], stride: cython.Py_ssize_t, low: cython.Py_ssize_t) -> cython.void:
        """The same of one run, whose rows are beside each other; its state takes the place of that in `_phi`."""
        n: cython.Py_ssize_t = self.n
        i: cython.Py_ssize_t
        elements: _Elements = self._elements
        for i in range(n):
            self._phi[i] = x[i * stride + low]
        elements.sum_columns(
            elements.theta,
            cython.address(self._phi[0]),
            cython.address(self._places[0]),
            cython.address(self._weights[0]),
            self._corners,
            cython.address(elements.rate[0]),
        )
        for i in range(n):
            self._rates[i * self._together] = elements.rate[i]


@cython.cclass
class Runs:
    """Runs, one from each measured state, and what the horizons say of the states they lead to.

    `judge`: of the model; `horizons`: envelopes after a number of steps, the shortest first; at least one; `runner`: of
    the elements that are run, with the same signals and schedule; default the nominal ones of the model; `count`:
    number of horizons; `residuals`: x less the centre, normalised, where the last `push` gives the utilisation; the
    next one writes there.
    """

    count = cython.declare(cython.Py_ssize_t, visibility="readonly")
    residuals = cython.declare(object, visibility="readonly")
    _residual: cython.double[::1]
    _judge = cython.declare(Judge)
    _runner = cython.declare(Judge)
    _longest: cython.Py_ssize_t
    _under_way: cython.Py_ssize_t  # runs, in the first places
    _newest: cython.Py_ssize_t
    _steps: cython.longlong[::1]
    _x: cython.double[::1]  # state of each run, row by row
    _time: cython.double[::1]
    _control: cython.double[::1]
    _start: cython.double[::1]  # state at which each run began
    _places: cython.longlong[::1]  # blocks that held there, four of each run
    _weights: cython.double[::1]
    _modes: cython.double[::1]
    _elements = cython.declare(list)
    _phi: cython.double[::1]  # beyond the states and the mean controls 1
    _blank = cython.declare(object)
    _ahead: cython.double[::1]  # of the run that is foreseen, as of the others
    _ahead_time: cython.double[::1]
    _ahead_control: cython.double[::1]

    def __init__(self, judge: Judge, horizons: Sequence[Any], runner: Judge | None = None) -> None:
        n, m = judge.n, judge.size - judge.n
        self._judge, self.count = judge, len(horizons)
        self._runner = judge if runner is None else runner
        mine = self._runner.n, self._runner.size, self._runner.total, self._runner.p, self._runner.blocks
        if mine != (judge.n, judge.size, judge.total, judge.p, judge.blocks):
            raise ValueError("the runner does not fit the model")
        tables = [horizon.tables for horizon in horizons]
        lead = () if judge.blocks == 1 and tables[0][0].ndim == 2 else (judge.blocks,)
        steps = [horizon.steps for horizon in horizons]
        fits = [theta.shape == (*lead, n, judge.p) and v.shape == (*lead, n) for theta, _, v in tables]
        if not (all(fits) and steps == sorted(steps)):
            raise ValueError("the horizons do not fit the model")
        self._longest = longest = steps[-1]
        if cython.compiled:
            self._steps = array("q", steps)
            self._x, self._time = _doubles(np.zeros(n * longest)), _doubles(np.zeros(longest))
            self._control, self._start = _doubles(np.zeros(m * longest or 1)), _doubles(np.zeros(n * longest))
            most = longest + 1  # the last one is foreseen
            self._places, self._weights = array("q", bytes(32 * most)), _doubles(np.zeros(4 * most))
            self._ahead, self._ahead_time = _doubles(np.zeros(n)), _doubles(np.zeros(1))
            self._ahead_control = _doubles(np.zeros(m or 1))
            self._modes = _doubles(np.zeros(2))
            self._elements, self._phi = [_Elements(*table) for table in tables], _doubles(np.ones(judge.p))
            self._blank = array("d", np.full(self.count * n, np.nan).tobytes())
            self.residuals = array("d", self._blank)
            self._residual = self.residuals
        else:
            self._steps, self._tables = steps, tables
            self._x, self._time = np.zeros((n, longest)), np.zeros(longest)
            self._control, self._start = np.zeros((m, longest)), np.zeros((n, longest))
            self._vectors = np.zeros((len(judge._positions), longest))
        self.reset()

    def reset(self) -> None:
        """End every run: what comes next does not follow what was before."""
        self._under_way = 0
        self._newest = -1

    def push(self, before: Sequence[float], after: Sequence[float], dt: cython.double) -> Any:
        """Begin a run, take all a step further, and compare those that have gone far enough with the state there."""
        if cython.compiled:
            return self._one(after, dt)
        with np.errstate(over="ignore", invalid="ignore"):
            return self._of_arrays(before, after, dt)

    def _of_arrays(self, before: Sequence[float], after: Sequence[float], dt: float) -> Any:
        """`_one` by numpy."""
        if cython.compiled:
            return None  # not called there
        judge, n = self._judge, self._judge.n
        z = normalised(np.array([*before, *after], dtype=np.float64), judge._steady, judge._scale)
        z, x_next, s = z[:-n, None], z[-n:], z[judge._positions]
        schedule = judge._schedule
        if schedule is not None and self._under_way:
            modes = [bool(axis.modes) for axis in schedule.axes]
            if (s != self._vectors[:, self._newest])[modes].any():
                self.reset()
        self._newest = newest = (self._newest + 1) % self._longest
        self._under_way = min(self._under_way + 1, self._longest)
        self._x[:, newest] = self._start[:, newest] = z[:n, 0]
        self._time[newest], self._control[:, newest], self._vectors[:, newest] = 0.0, 0.0, s
        self._runner._advance_columns(self._x, self._time, self._control, z, dt)
        found, left = np.full((2, self.count, n), np.nan)
        for h, (values, residual, steps) in enumerate(zip(found, left, self._steps, strict=True)):
            if steps > self._under_way:
                break
            k = (newest - steps + 1) % self._longest
            run = slice(k, k + 1)
            of_run = [a[:, run] for a in (self._start, self._control, self._vectors, self._x)]
            centre, half = self._centre_and_half(h, self._time[run], *of_run)
            residual[:] = x_next - centre
            inside = contained(lower_of(centre, half, 1.0), x_next, upper_of(centre, half, 1.0))
            values[:] = settled(utilisation_of(residual, half), inside)
        self.residuals = array("d", left.tobytes())
        return array("d", found.tobytes())

    def _centre_and_half(self, h: int, time: Any, start: Any, control: Any, vectors: Any, x: Any) -> Any:
        """Centre and half-width (n,) of a horizon, from what is kept of a run, in columns."""
        if cython.compiled:
            return None  # not called there
        judge = self._judge
        phi = np.concatenate([start, control / time, np.ones((judge.p - judge.size, 1))])
        places, weights = (None, None) if judge._schedule is None else judge._schedule.corners(vectors)
        theta, delta, v = self._tables[h]
        centre, half = centre_and_half(theta, delta, v, phi, time, places, weights, x)
        return centre[:, 0], half[:, 0]

    def foresee(self, before: Sequence[float], dt: cython.double) -> Any:
        """Bounds at the end of the longest horizon, if controls and further scheduling signals stay as they are."""
        if len(before) != self._judge.total:
            raise ValueError(f"{len(before)} values for {self._judge.total} signals")
        if cython.compiled:
            return self._foreseen(before, dt)
        with np.errstate(over="ignore", invalid="ignore"):
            return self._foreseen_by_arrays(before, dt)

    def _foreseen_by_arrays(self, before: Sequence[float], dt: float) -> Any:
        """`_foreseen` by numpy."""
        if cython.compiled:
            return None  # not called there
        judge, n, total = self._judge, self._judge.n, self._judge.total
        steady, scale = judge._steady[:total], judge._scale[:total]
        z = normalised(np.array(before, dtype=np.float64), steady, scale)[:, None]
        vectors = z[judge._positions]
        if judge._schedule is not None and judge._schedule.corners(vectors)[0][0, 0] < 0:
            return None
        start, x, time, control = z[:n], z[:n].copy(), np.zeros(1), np.zeros((judge.size - n, 1))
        for _ in range(self._longest):
            self._runner._advance_columns(x, time, control, z, dt)
        centre, half = self._centre_and_half(self.count - 1, time, start, control, vectors, x)
        bounds = [of(centre, half, judge.margin) for of in (lower_of, upper_of)]
        return array("d", np.concatenate([recorded(bound, steady[:n], scale[:n]) for bound in bounds]).tobytes())

    @cython.cfunc
    @cython.boundscheck(False)
    @cython.wraparound(False)
    def _one(self, after: Any, dt: cython.double) -> Any:
        judge: Judge = self._judge
        runner: Judge = self._runner
        n: cython.Py_ssize_t = judge.n
        m: cython.Py_ssize_t = judge.size - n
        i: cython.Py_ssize_t
        j: cython.Py_ssize_t
        k: cython.Py_ssize_t
        h: cython.Py_ssize_t
        longest: cython.Py_ssize_t = self._longest
        s: cython.double
        time: cython.double
        value: cython.double
        size: cython.double
        x_next: cython.double
        inside: cython.bint
        elements: _Elements
        for i in range(judge._axes):
            if not judge._of_modes[i]:
                continue
            k = judge._positions[i]
            s = judge._phi[k] if k < judge.size else judge._z[k]
            if self._under_way and s != self._modes[i]:
                self._under_way = 0
                self._newest = -1
            self._modes[i] = s
        self._newest = k = self._newest + 1 if self._newest + 1 < longest else 0
        if self._under_way < longest:
            self._under_way += 1
        for i in range(n):
            self._x[i * longest + k] = self._start[i * longest + k] = judge._phi[i]
        self._time[k] = 0.0
        for j in range(m):
            self._control[j * longest + k] = 0.0
        self._keep_blocks(judge, k)
        if runner is not judge:
            for i in range(judge.size):
                runner._phi[i] = judge._phi[i]
            for i in range(judge._corners):
                runner._places[i] = judge._places[i]
                runner._weights[i] = judge._weights[i]
        runner._advance(self._x, self._time, self._control, longest, 0, self._under_way, dt)
        blank = array("d", self._blank)
        values: cython.double[::1] = blank
        for h in range(self.count):
            if self._steps[h] > self._under_way:
                for i in range(h * n, self.count * n):
                    self._residual[i] = values[i]
                break
            k = self._newest - self._steps[h] + 1
            if k < 0:
                k += longest
            time = self._time[k]
            for i in range(n):
                self._phi[i] = self._start[i * longest + k]
            for j in range(m):
                self._phi[n + j] = self._control[j * longest + k] / time
            elements = self._elements[h]
            self._sum(elements, k)
            for i in range(n):
                x_next = after[i]
                x_next = normalised(x_next, judge._steady[i], judge._scale[i])
                value = centre_of(self._x[i * longest + k], time, elements.rate[i])
                size = half_of(time, elements.spread[i], elements.still[i])
                inside = contained(lower_of(value, size, 1.0), x_next, upper_of(value, size, 1.0))
                self._residual[h * n + i] = x_next - value
                values[h * n + i] = settled(utilisation_of(x_next - value, size), inside)
        return blank

    @cython.cfunc
    @cython.boundscheck(False)
    @cython.wraparound(False)
    def _foreseen(self, before: Any, dt: cython.double) -> Any:
        judge: Judge = self._judge
        runner: Judge = self._runner
        n: cython.Py_ssize_t = judge.n
        m: cython.Py_ssize_t = judge.size - n
        i: cython.Py_ssize_t
        time: cython.double
        value: cython.double
        size: cython.double
        elements: _Elements = self._elements[self.count - 1]
        if runner._read(before) < 0:
            return None
        self._keep_blocks(runner, self._longest)
        for i in range(n):
            self._ahead[i] = self._phi[i] = runner._phi[i]
        self._ahead_time[0] = 0.0
        for i in range(m):
            self._ahead_control[i] = 0.0
        for _ in range(self._longest):
            runner._advance(self._ahead, self._ahead_time, self._ahead_control, 1, 0, 1, dt)
        time = self._ahead_time[0]
        for i in range(m):
            self._phi[n + i] = self._ahead_control[i] / time
        self._sum(elements, self._longest)
        found = array("d", bytes(16 * n))
        bounds: cython.double[::1] = found
        for i in range(n):
            value = centre_of(self._ahead[i], time, elements.rate[i])
            size = half_of(time, elements.spread[i], elements.still[i])
            bounds[i] = recorded(lower_of(value, size, judge.margin), judge._steady[i], judge._scale[i])
            bounds[n + i] = recorded(upper_of(value, size, judge.margin), judge._steady[i], judge._scale[i])
        return found

    @cython.cfunc
    @cython.boundscheck(False)
    @cython.wraparound(False)
    @cython.exceptval(check=False)
    def _keep_blocks(self, judge: Judge, k: cython.Py_ssize_t) -> cython.void:
        """Those that hold where run k begins."""
        i: cython.Py_ssize_t
        for i in range(judge._corners):
            self._places[4 * k + i] = judge._places[i]
            self._weights[4 * k + i] = judge._weights[i]

    @cython.cfunc
    @cython.boundscheck(False)
    @cython.wraparound(False)
    @cython.exceptval(check=False)
    def _sum(self, elements: _Elements, k: cython.Py_ssize_t) -> cython.void:
        """The sums of a horizon for `_phi`, with the blocks that held where run k began."""
        judge: Judge = self._judge
        elements.sum(
            cython.address(self._phi[0]),
            cython.address(self._places[4 * k]),
            cython.address(self._weights[4 * k]),
            judge._corners,
        )


def _doubles(values: Any) -> Any:
    return array("d", np.ascontiguousarray(values, dtype=np.float64).tobytes())


if not cython.compiled:
    use_twin(globals(), ("Judge", "Judgement", "Runs"))
