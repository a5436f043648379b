# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Statistics of the verdicts over a window, verdict after verdict.

`model.alarm_rule.StatisticRule` has the formulas. Sums over a window are kept in two halves. The older half holds, for
each of its verdicts, the sum from there to its end; the newer half is one sum. The window moves by taking the next sum
of the older half, and when that is used up the newer half becomes it. So nothing is ever subtracted, no error of
rounding remains, and a verdict costs the same on average however long the window is.
"""

ENERGY, MEAN, EWMA, CUSUM, CHI2, MEWMA = range(6)
"""Kinds, in the order of `model.alarm_rule.KINDS`."""
LIMIT = 10.0
"""Where ewma and cusum cut the utilisation, and mewma its uncorrelated components, in standard deviations:
a jump is seen anyway, and must not hold them for long."""
cdef enum Kind:
    _ENERGY, _MEAN, _EWMA, _CUSUM, _CHI2, _MEWMA
cdef double _LIMIT = LIMIT
cdef double _MOST = 1e50  # at which the others cut: squares stay finite
cdef Py_ssize_t _LONGEST = 1_000_000  # verdicts of a window at most


@cython.final
cdef class Statistic:
    """One statistic of one verdict after another, and whether it is over its threshold.

    `kind`: one of the kinds above; `n`: number of states; `window_s`: T, s; `thresholds`: what raises the alarm if it
    is exceeded; `counted`: states that raise it; `allowance`: of cusum; `mean` (n,) and `whitening` (n, n): of what
    chi2 and mewma take, see `model.residuals`; `alarm`: the statistic of some state that counts is over its threshold.
    Each state has its own window, so a verdict that leaves one state out changes nothing of that state.
    """

    cdef readonly bint alarm
    cdef int kind
    cdef Py_ssize_t n, size
    cdef double window, allowance
    cdef long long window_ns
    cdef list _keep
    cdef const double* thresholds
    cdef const unsigned char* counted
    cdef const double* mean
    cdef const double* whitening
    cdef double* terms  # what this verdict adds; of mewma the uncorrelated components
    cdef double* now  # the statistic over its threshold
    cdef double* up  # sum of the newer half; moving average; sum upwards
    cdef double* down  # the same downwards; of chi2 and mewma this verdict less the mean
    cdef long long* given  # whether this verdict has a number of it
    cdef long long* begin  # of the window of each state in its part of the queue
    cdef long long* middle  # of its newer half
    cdef long long* end
    cdef long long* total  # ns
    cdef double spread  # variance of the moving average of mewma, that of a verdict being 1; 0 before the first
    cdef arrays.array _queue, _steps
    cdef double* queue  # of one state after another: terms of the newer half, sums of the older one
    cdef long long* steps  # likewise, ns
    cdef Py_ssize_t capacity

    def __init__(
        self, int kind, Py_ssize_t n, double window_s, thresholds, counted, double allowance=0.0, mean=None,
        whitening=None,
    ):
        joint = kind == CHI2 or kind == MEWMA
        size = 1 if joint else n
        if len(thresholds) != size or len(counted) != n:
            raise ValueError("the thresholds or the states that count do not fit the states")
        if joint and (np.shape(mean) != (n,) or np.shape(whitening) != (n, n)):
            raise ValueError("the mean or the covariance does not fit the states")
        self.kind, self.n, self.size = kind, n, size
        self.window, self.window_ns, self.allowance = window_s, round(window_s * 1e9), allowance
        cdef arrays.array given = doubles([float(threshold) for threshold in thresholds])
        cdef arrays.array law = doubles(np.concatenate([mean, np.reshape(whitening, -1)]) if joint else [])
        cdef arrays.array room = doubles(np.zeros(4 * n)), places = array("q", bytes(8 * 5 * n))
        cdef bytes flags = bytes([1]) if joint else bytes(map(bool, counted))
        self._keep = [given, law, room, places, flags]
        self.thresholds, self.counted, self.mean = given.data.as_doubles, flags, law.data.as_doubles
        self.whitening, self.terms = self.mean + n, room.data.as_doubles
        self.now, self.up, self.down = self.terms + n, self.terms + 2 * n, self.terms + 3 * n
        self.given = places.data.as_longlongs
        self.begin, self.middle = self.given + n, self.given + 2 * n
        self.end, self.total = self.given + 3 * n, self.given + 4 * n
        self.capacity = 64
        self.hold(array("d", bytes(8 * size * 64)), array("q", bytes(8 * size * 64)))
        self.reset()

    cdef void hold(self, arrays.array queue, arrays.array steps):
        self._queue, self._steps = queue, steps
        self.queue, self.steps = queue.data.as_doubles, steps.data.as_longlongs

    def reset(self):
        """Forget every verdict."""
        cdef Py_ssize_t i
        for i in range(self.n):
            self.up[i] = self.down[i] = 0.0
            self.now[i] = NAN
            self.begin[i] = self.middle[i] = self.end[i] = self.total[i] = 0
        self.spread = 0.0
        self.alarm = False

    def values(self):
        """The statistic over its threshold: 1 and -1 are the threshold; NaN before the first verdict on a state.

        Of mean, ewma and cusum with the sign of the utilisation.
        """
        cdef Py_ssize_t i
        cdef arrays.array found = arrays.clone(array_of_doubles, self.size, False)
        for i in range(self.size):
            found.data.as_doubles[i] = self.now[i]
        return found

    def push_all(self, dt, rows, raised=None, found=None):
        """Take many verdicts.

        `dt` (K,): steps, s; `rows` (K, n): the utilisation of each state, or the residual, a row for each verdict. NaN
        is no verdict on that state, and changes nothing of it, nor of any state if all are seen together; Returns (K,):
        the alarm after each; Returns (K, n): `values` after each; both in `raised` and `found` where these are given.
        """
        cdef Py_ssize_t i, k, count = len(dt)
        rows = np.asarray(rows, dtype=np.float64)
        if rows.shape != (count, self.n):
            raise ValueError("the numbers of the verdicts do not fit the states")
        if rows.strides[1] != 8:
            rows = np.ascontiguousarray(rows)
        cdef const double[:, :] table = rows  # a row of numbers, however far from the next
        cdef const double[::1] times = np.ascontiguousarray(dt, dtype=np.float64)
        raised = np.empty(count, dtype=bool) if raised is None else raised
        found = np.empty((count, self.size)) if found is None else found
        cdef double[:, :] values = found
        cdef unsigned char[:] alarm = raised.view(np.uint8)
        if not (alarm.shape[0] == values.shape[0] == times.shape[0] == count and values.shape[1] == self.size):
            raise ValueError("the numbers of the verdicts do not fit the states")
        with nogil:
            for k in range(count):
                self.push(times[k], &table[k, 0])
                alarm[k] = self.alarm
                for i in range(self.size):
                    values[k, i] = self.now[i]
        return raised, found

    cdef int push(self, double dt, const double* row) except -1 nogil:
        """Take one verdict."""
        cdef Py_ssize_t i
        cdef double value, weight, kept, down
        if not self.take(row):
            return 0
        if self.kind == _EWMA:
            weight = dt / (self.window + dt)
            for i in range(self.size):
                if not self.given[i]:
                    continue
                self.up[i] += (self.terms[i] - self.up[i]) * weight
                self.now[i] = self.up[i] / self.thresholds[i]
        elif self.kind == _CUSUM:
            weight = dt / self.window
            kept = self.window / (self.window + dt)
            for i in range(self.size):
                if not self.given[i]:
                    continue
                value = self.up[i] * kept + (self.terms[i] - self.allowance) * weight
                down = self.down[i] * kept + (-self.terms[i] - self.allowance) * weight
                self.up[i] = value = value if value > 0.0 else 0.0
                self.down[i] = down = down if down > 0.0 else 0.0
                self.now[i] = (value if value >= down else -down) / self.thresholds[i]
        elif self.kind == _MEWMA:
            weight = dt / (self.window + dt)
            kept = 1.0 - weight
            if self.spread == 0.0:
                self.spread = weight / (2.0 - weight)
            else:
                self.spread = kept * kept * self.spread + weight * weight
            value = 0.0
            for i in range(self.n):
                self.up[i] += (self.terms[i] - self.up[i]) * weight
                value += self.up[i] * self.up[i]
            self.now[0] = value / self.spread / self.thresholds[0]
        else:
            for i in range(self.size):
                if not self.given[i]:
                    continue
                self.move(i, dt)
                weight = self.window if self.total[i] <= self.window_ns else dt
                value = self.up[i]
                if self.begin[i] < self.middle[i]:
                    value = self.queue[i * self.capacity + self.begin[i]] + value
                self.now[i] = value / weight / self.thresholds[i]
        self.alarm = False
        for i in range(self.size):
            if self.counted[i] and (self.now[i] > 1.0 or self.now[i] < -1.0):
                self.alarm = True
        return 0

    cdef bint take(self, const double* row) noexcept nogil:
        """What the verdict adds, to `terms`, for the states that are `given`; false if there is none."""
        cdef Py_ssize_t i, j, n = self.n
        cdef double value, total, limit, square = 0.0
        cdef bint there = False
        if self.kind == _CHI2 or self.kind == _MEWMA:
            for i in range(n):
                value = row[i]
                if value != value:
                    return False
                value = _MOST if value > _MOST else -_MOST if value < -_MOST else value  # infinite where half is 0
                self.down[i] = value - self.mean[i]
                total = 0.0
                for j in range(i + 1):
                    total += self.whitening[i * n + j] * self.down[j]
                if self.kind == _MEWMA:
                    self.terms[i] = -_LIMIT if total < -_LIMIT else total if total <= _LIMIT else _LIMIT
                square += total * total
            if self.kind == _CHI2:
                self.terms[0] = square if square <= _MOST else _MOST
            self.given[0] = True
            return True
        limit = _LIMIT if self.kind == _EWMA or self.kind == _CUSUM else _MOST
        for i in range(n):
            value = row[i]
            self.given[i] = value == value
            there |= value == value
            value = limit if value > limit else -limit if value < -limit else value
            self.terms[i] = value * value if self.kind == _ENERGY else value
        return there

    cdef int move(self, Py_ssize_t i, double dt) except -1 nogil:
        """Add the term of a state to its window, and drop what is older than it."""
        cdef Py_ssize_t k
        if self.end[i] == self.capacity:
            with gil:
                self.make_room(i)
        cdef double* queue = self.queue + i * self.capacity
        cdef long long* steps = self.steps + i * self.capacity
        cdef Py_ssize_t end = self.end[i]
        queue[end] = self.terms[i] * dt
        steps[end] = <long long>(dt * 1e9 + 0.5)
        self.up[i] += queue[end]
        self.total[i] += steps[end]
        self.end[i] = end = end + 1
        while end - self.begin[i] > 1 and (self.total[i] > self.window_ns or end - self.begin[i] > _LONGEST):
            if self.begin[i] == self.middle[i]:  # the newer half becomes the older one
                for k in range(end - 2, self.begin[i] - 1, -1):
                    queue[k] += queue[k + 1]
                self.middle[i] = end
                self.up[i] = 0.0
            self.total[i] -= steps[self.begin[i]]
            self.begin[i] += 1
        return 0

    cdef make_room(self, Py_ssize_t i):
        """Move the window of a state to the front of its part of the queue; if it fills half, double all first."""
        cdef Py_ssize_t j, k, begin = self.begin[i], count = self.end[i] - self.begin[i], before = self.capacity
        cdef arrays.array queue = self._queue, steps = self._steps
        if 2 * count > before:
            self.capacity *= 2
            self.hold(
                arrays.clone(queue, self.size * self.capacity, True),
                arrays.clone(steps, self.size * self.capacity, True),
            )
            for j in range(self.size):
                for k in range(before):
                    self.queue[j * self.capacity + k] = queue.data.as_doubles[j * before + k]
                    self.steps[j * self.capacity + k] = steps.data.as_longlongs[j * before + k]
        for k in range(i * self.capacity, i * self.capacity + count):
            self.queue[k] = self.queue[k + begin]
            self.steps[k] = self.steps[k + begin]
        self.middle[i] -= begin
        self.begin[i], self.end[i] = 0, count


@cython.final
cdef class Statistics:
    """Several statistics, each of its own part of the numbers of one verdict after another.

    `parts`: the statistics; `begins`: where the numbers of each begin.
    """

    cdef list parts, begins

    def __init__(self, parts, begins):
        self.parts, self.begins = list(parts), list(begins)

    def push(self, double dt, table):
        """Take one verdict; whether it raises the alarm."""
        cdef const double[::1] row = table
        cdef Statistic part
        cdef Py_ssize_t begin
        cdef bint raised = False
        for part, begin in zip(self.parts, self.begins):
            if begin < 0 or begin + part.n > row.shape[0]:
                raise ValueError("the numbers of the verdict do not fit the states")
            part.push(dt, &row[begin])
            raised |= part.alarm
        return raised

    def values(self):
        """`Statistic.values` of each, one after the other."""
        found = array("d")
        for part in self.parts:
            found += part.values()
        return found


def some_beyond(table, places, double limit):
    """1 if the size of one of some numbers is over a limit, 0 if not; -1 if all are NaN, and one alone is no verdict."""
    cdef const double[::1] row = table
    cdef Py_ssize_t at
    cdef double value
    cdef bint nothing = True, beyond = False
    for at in places:
        if not 0 <= at < row.shape[0]:
            raise ValueError("the numbers of the verdict do not fit the states")
        value = row[at]
        nothing &= value != value
        beyond |= value > limit or value < -limit
    return -1 if nothing else int(beyond)
