# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Statistics of the verdicts over a window: their arithmetic, verdict after verdict, live and offline.

`model.alarm_rule.StatisticRule` has the formulas. Sums over a window are kept in two halves. The older half holds, for
each of its verdicts, the sum from there to its end; the newer half is one sum. The window moves by taking the next sum
of the older half, and when that is used up the newer half becomes it. So nothing is ever subtracted, no error of
rounding remains, and a verdict costs the same on average however long the window is. Compiled or not, the same
operations in the same order give the same bits.
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

ENERGY, MEAN, EWMA, CUSUM, CHI2, MEWMA = range(6)
"""Kinds, in the order of `model.alarm_rule.KINDS`."""
LIMIT = 10.0
"""Where ewma and cusum cut the utilisation, and mewma its uncorrelated components, in standard deviations:
a jump is seen anyway, and must not hold them for long."""
_MOST = 1e50  # at which the others cut: squares stay finite
_LONGEST = 1_000_000  # verdicts of a window at most


@cython.cclass
class Statistic:
    """One statistic of one verdict after another, and whether it is over its threshold.

    `kind`: one of the kinds above; `n`: number of states; `window_s`: T, s; `thresholds`: what raises the alarm if it
    is exceeded; `counted`: states that raise it; `allowance`: of cusum; `mean` (n,): of what chi2 and mewma take; see
    `model.residuals`; `whitening` (n, n): of the same; `alarm`: the statistic of some state that counts is over its
    threshold. Each state has its own window, so a verdict that leaves one state out changes nothing of that state.
    """

    alarm = cython.declare(cython.bint, visibility="readonly")
    _kind: cython.int
    _n: cython.Py_ssize_t
    _size: cython.Py_ssize_t
    _window: cython.double
    _window_ns: cython.longlong
    _allowance: cython.double
    _thresholds: cython.double[::1]
    _counted: cython.uchar[::1]
    _mean: cython.double[::1]
    _whitening: cython.double[::1]
    _terms: cython.double[::1]  # what this verdict adds; of mewma the uncorrelated components
    _values: cython.double[::1]  # the statistic over its threshold
    _up: cython.double[::1]  # sum of the newer half; moving average; sum upwards
    _down: cython.double[::1]  # the same downwards; of chi2 and mewma this verdict less the mean
    _given: cython.uchar[::1]  # whether this verdict has a number of it
    _spread: cython.double  # variance of the moving average of mewma, that of a verdict being 1; 0 before the first
    _queue: cython.double[::1]  # of one state after another: terms of the newer half, sums of the older one
    _steps: cython.longlong[::1]  # likewise, ns
    _begin: cython.longlong[::1]  # of the window of each state in its part of the queue
    _middle: cython.longlong[::1]  # of its newer half
    _end: cython.longlong[::1]
    _total: cython.longlong[::1]  # ns
    _capacity: cython.Py_ssize_t

    def __init__(
        self,
        kind: int,
        n: int,
        window_s: float,
        thresholds: Any,
        counted: Any,
        allowance: float = 0.0,
        mean: Any = None,
        whitening: Any = None,
    ) -> None:
        joint = kind == CHI2 or kind == MEWMA
        size = 1 if joint else n
        if len(thresholds) != size or len(counted) != n:
            raise ValueError("the thresholds or the states that count do not fit the states")
        if joint and (np.shape(mean) != (n,) or np.shape(whitening) != (n, n)):
            raise ValueError("the mean or the covariance does not fit the states")
        self._kind, self._n, self._size = kind, n, size
        self._window, self._window_ns = window_s, round(window_s * 1e9)
        self._allowance = allowance
        self._thresholds = array("d", map(float, thresholds))
        self._counted = bytearray([1]) if joint else bytearray(map(bool, counted))
        self._mean = _doubles(np.zeros(n) if mean is None else mean)
        self._whitening = _doubles(np.zeros(1) if whitening is None else np.reshape(whitening, -1))
        self._terms, self._values = array("d", bytes(8 * n)), array("d", bytes(8 * size))
        self._up, self._down = array("d", bytes(8 * n)), array("d", bytes(8 * n))
        self._given = bytearray(size)
        self._begin, self._middle = array("q", bytes(8 * size)), array("q", bytes(8 * size))
        self._end, self._total = array("q", bytes(8 * size)), array("q", bytes(8 * size))
        self._capacity = 64
        self._queue, self._steps = array("d", bytes(8 * size * 64)), array("q", bytes(8 * size * 64))
        self.reset()

    def reset(self) -> None:
        """Forget every verdict."""
        i: cython.Py_ssize_t
        for i in range(self._n):
            self._up[i] = self._down[i] = 0.0
        for i in range(self._size):
            self._values[i] = float("nan")
            self._begin[i] = self._middle[i] = self._end[i] = self._total[i] = 0
        self._spread = 0.0
        self.alarm = False

    def values(self) -> Any:
        """The statistic over its threshold: 1 and -1 are the threshold; NaN before the first verdict on a state.

        Returns (n,): A copy; of mean, ewma and cusum with the sign of the utilisation.
        """
        return array("d", self._values)

    def push_all(self, dt: Any, rows: Any) -> tuple[Any, Any]:
        """Take many verdicts.

        `dt` (K,): steps, s; `rows` (K, n): the utilisation of each state, or the residual, a row for each verdict. NaN
        is no verdict on that state, and changes nothing of it, nor of any state if all are seen together; Returns (K,):
        the alarm after each; Returns (K, n): `values` after each.
        """
        count: cython.Py_ssize_t = len(dt)
        i: cython.Py_ssize_t
        k: cython.Py_ssize_t
        if np.shape(rows) != (count, self._n):
            raise ValueError("the numbers of the verdicts do not fit the states")
        flat = array("d", np.ascontiguousarray(rows, dtype=np.float64).tobytes())
        steps = array("d", np.ascontiguousarray(dt, dtype=np.float64).tobytes())
        found, raised = array("d", bytes(8 * count * self._size)), bytearray(count)
        if not count:
            return np.zeros(0, dtype=bool), np.zeros((0, self._size))
        table: cython.double[::1] = flat
        times: cython.double[::1] = steps
        values: cython.double[::1] = found
        alarm: cython.uchar[::1] = raised
        for k in range(count):
            self._push(times[k], table, k * self._n)
            alarm[k] = self.alarm
            for i in range(self._size):
                values[k * self._size + i] = self._values[i]
        return np.frombuffer(raised, dtype=np.bool_), np.frombuffer(found).reshape(count, self._size)

    @cython.cfunc
    @cython.boundscheck(False)
    @cython.wraparound(False)
    @cython.cdivision(True)
    def _push(self, dt: cython.double, row: cython.double[::1], begin: cython.Py_ssize_t) -> cython.void:
        i: cython.Py_ssize_t
        value: cython.double
        weight: cython.double
        kept: cython.double
        down: cython.double
        over: cython.bint = False
        if not self._take(row, begin):
            return
        if self._kind == EWMA:
            weight = dt / (self._window + dt)
            for i in range(self._size):
                if not self._given[i]:
                    continue
                self._up[i] += (self._terms[i] - self._up[i]) * weight
                self._values[i] = self._up[i] / self._thresholds[i]
        elif self._kind == CUSUM:
            weight = dt / self._window
            kept = self._window / (self._window + dt)
            for i in range(self._size):
                if not self._given[i]:
                    continue
                value = self._up[i] * kept + (self._terms[i] - self._allowance) * weight
                down = self._down[i] * kept + (-self._terms[i] - self._allowance) * weight
                self._up[i] = value = value if value > 0.0 else 0.0
                self._down[i] = down = down if down > 0.0 else 0.0
                self._values[i] = (value if value >= down else -down) / self._thresholds[i]
        elif self._kind == MEWMA:
            weight = dt / (self._window + dt)
            kept = 1.0 - weight
            if self._spread == 0.0:
                self._spread = weight / (2.0 - weight)
            else:
                self._spread = kept * kept * self._spread + weight * weight
            value = 0.0
            for i in range(self._n):
                self._up[i] += (self._terms[i] - self._up[i]) * weight
                value += self._up[i] * self._up[i]
            self._values[0] = value / self._spread / self._thresholds[0]
        else:
            for i in range(self._size):
                if not self._given[i]:
                    continue
                self._move(i, dt)
                weight = self._window if self._total[i] <= self._window_ns else dt
                value = self._up[i]
                if self._begin[i] < self._middle[i]:
                    value = self._queue[i * self._capacity + self._begin[i]] + value
                self._values[i] = value / weight / self._thresholds[i]
        for i in range(self._size):
            value = self._values[i]
            over = over or (self._counted[i] and (value > 1.0 or value < -1.0))
        self.alarm = over

    @cython.cfunc
    @cython.boundscheck(False)
    @cython.wraparound(False)
    def _take(self, row: cython.double[::1], begin: cython.Py_ssize_t) -> cython.bint:
        """What the verdict adds, to `_terms`, for the states `_given`; false if there is none."""
        n: cython.Py_ssize_t = self._n
        i: cython.Py_ssize_t
        j: cython.Py_ssize_t
        value: cython.double
        total: cython.double
        square: cython.double = 0.0
        limit: cython.double
        some: cython.bint = False
        if self._kind == CHI2 or self._kind == MEWMA:
            for i in range(n):
                value = row[begin + i]
                if value != value:
                    return False
                value = _MOST if value > _MOST else -_MOST if value < -_MOST else value  # infinite where half is 0
                self._down[i] = value - self._mean[i]
                total = 0.0
                for j in range(i + 1):
                    total += self._whitening[i * n + j] * self._down[j]
                if self._kind == MEWMA:
                    self._terms[i] = -LIMIT if total < -LIMIT else total if total <= LIMIT else LIMIT
                square += total * total
            if self._kind == CHI2:
                self._terms[0] = square if square <= _MOST else _MOST
            self._given[0] = True
            return True
        limit = LIMIT if self._kind == EWMA or self._kind == CUSUM else _MOST
        for i in range(n):
            value = row[begin + i]
            self._given[i] = value == value
            some = some or self._given[i]
            value = limit if value > limit else -limit if value < -limit else value
            self._terms[i] = value * value if self._kind == ENERGY else value
        return some

    @cython.cfunc
    @cython.boundscheck(False)
    @cython.wraparound(False)
    def _move(self, i: cython.Py_ssize_t, dt: cython.double) -> cython.void:
        """Add the term of a state to its window, and drop what is older than it."""
        k: cython.Py_ssize_t
        at: cython.Py_ssize_t
        step: cython.longlong
        value: cython.double
        if self._end[i] == self._capacity:
            self._make_room(i)
        at = i * self._capacity
        step = int(dt * 1e9 + 0.5)
        value = self._terms[i] * dt
        self._steps[at + self._end[i]] = step
        self._queue[at + self._end[i]] = value
        self._total[i] += step
        self._up[i] += value
        self._end[i] += 1
        while self._end[i] - self._begin[i] > 1 and (
            self._total[i] > self._window_ns or self._end[i] - self._begin[i] > _LONGEST
        ):
            if self._begin[i] == self._middle[i]:  # the newer half becomes the older one
                for k in range(at + self._end[i] - 2, at + self._begin[i] - 1, -1):
                    self._queue[k] += self._queue[k + 1]
                self._middle[i] = self._end[i]
                self._up[i] = 0.0
            self._total[i] -= self._steps[at + self._begin[i]]
            self._begin[i] += 1

    @cython.cfunc
    def _make_room(self, i: cython.Py_ssize_t) -> cython.void:
        """Move the window of a state to the front of its part of the queue; if it fills half, double all first."""
        j: cython.Py_ssize_t
        k: cython.Py_ssize_t
        begin: cython.Py_ssize_t = self._begin[i]
        count: cython.Py_ssize_t = self._end[i] - begin
        before: cython.Py_ssize_t = self._capacity
        queue: cython.double[::1] = self._queue
        steps: cython.longlong[::1] = self._steps
        if 2 * count > before:
            self._capacity *= 2
            self._queue = array("d", bytes(8 * self._size * self._capacity))
            self._steps = array("q", bytes(8 * self._size * self._capacity))
            for j in range(self._size):
                for k in range(before):
                    self._queue[j * self._capacity + k] = queue[j * before + k]
                    self._steps[j * self._capacity + k] = steps[j * before + k]
        for k in range(i * self._capacity, i * self._capacity + count):
            self._queue[k] = self._queue[k + begin]
            self._steps[k] = self._steps[k + begin]
        self._middle[i] -= begin
        self._begin[i], self._end[i] = 0, count


@cython.cclass
class Statistics:
    """Several statistics, each of its own part of the numbers of one verdict after another.

    `parts`: the statistics; `begins`: where the numbers of each begin.
    """

    _parts = cython.declare(list)
    _begins: cython.longlong[::1]

    def __init__(self, parts: Sequence[Statistic], begins: Sequence[int]) -> None:
        self._parts, self._begins = list(parts), array("q", begins or [0])

    def push(self, dt: cython.double, table: Any) -> bool:
        """Take one verdict."""
        part: Statistic
        k: cython.Py_ssize_t = 0
        begin: cython.Py_ssize_t
        raised: cython.bint = False
        row: cython.double[::1] = table
        for part in self._parts:
            begin = self._begins[k]
            if begin < 0 or begin + part._n > len(row):
                raise ValueError("the numbers of the verdict do not fit the states")
            part._push(dt, row, begin)
            raised = raised or part.alarm
            k += 1
        return raised

    def values(self) -> Any:
        """`Statistic.values` of each, one after the other."""
        part: Statistic
        found = array("d")
        for part in self._parts:
            found += part.values()
        return found


def some_beyond(table: Any, places: Any, limit: cython.double) -> int:
    """Whether the size of one of some numbers is over a limit; -1 if all are NaN, and one alone is no verdict."""
    row: cython.double[::1] = table
    at: cython.longlong[::1] = places
    i: cython.Py_ssize_t
    value: cython.double
    nothing: cython.bint = True
    beyond: cython.bint = False
    for i in range(len(at)):
        if not 0 <= at[i] < len(row):
            raise ValueError("the numbers of the verdict do not fit the states")
        value = row[at[i]]
        nothing = nothing and value != value
        beyond = beyond or value > limit or value < -limit
    return -1 if nothing else int(beyond)


def _doubles(values: Any) -> Any:
    return array("d", np.ascontiguousarray(values, dtype=np.float64).tobytes())


if not cython.compiled:
    use_twin(globals(), ("Statistic", "Statistics", "some_beyond"))
