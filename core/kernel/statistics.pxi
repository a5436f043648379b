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
    is exceeded; `counted`: states that raise it; `allowance`: of cusum; `mean` (n,), `whitening` (n, n), `memory` (n,):
    of what chi2 and mewma take, see `model.residuals`: each number less its mean, less so much of the one before;
    `alarm`: the statistic of some state that counts is over its threshold; `blamed`: the state that chi2 or mewma
    point to, of the largest low-pass over T of (C^-1 r)_i^2 / (C^-1)_ii, by which r^T C^-1 r falls if state i is left
    free; -1 if there is none. [Alcala and Qin, Automatica 45, 2009]
    Each state has its own window, so a verdict that leaves one state out changes nothing of that state.
    """

    cdef readonly bint alarm
    cdef readonly Py_ssize_t blamed
    cdef int kind
    cdef Py_ssize_t n, size
    cdef double window, allowance
    cdef long long window_ns
    cdef list _keep
    cdef const double* thresholds
    cdef const unsigned char* counted
    cdef const double* mean
    cdef const double* whitening
    cdef const double* memory  # NULL if it is 0
    cdef double* before  # (n,): the last row less its mean; 0 before the first
    cdef double* share  # (n,): low-pass of what each state has of chi2 or mewma
    cdef const double* unit  # (n,): (C^-1)_ii; 0 of a state that has none
    cdef double* shares  # (n, _TOGETHER): (C^-1 r)_i of each of some verdicts
    cdef double* now  # (size,): the statistic over its threshold
    cdef double* up  # sum of the newer half; moving average; sum upwards
    cdef double* down  # the same downwards
    cdef double* terms  # (n, _TOGETHER): what each of some verdicts adds, NaN for nothing
    cdef double* after  # (size, _TOGETHER): the statistic after each of them, over its threshold
    cdef long long* step_ns  # (_TOGETHER,): step of each of them
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
        whitening=None, memory=None,
    ):
        joint = kind == CHI2 or kind == MEWMA
        size = 1 if joint else n
        if len(thresholds) != size or len(counted) != n:
            raise ValueError("the thresholds or the states that count do not fit the states")
        memory = np.zeros(n) if joint and memory is None else memory
        if joint and not (np.shape(mean) == np.shape(memory) == (n,) and np.shape(whitening) == (n, n)):
            raise ValueError("the mean or the covariance does not fit the states")
        self.kind, self.n, self.size = kind, n, size
        self.window, self.window_ns, self.allowance = window_s, round(window_s * 1e9), allowance
        cdef arrays.array given = doubles([float(threshold) for threshold in thresholds])
        law_of = [mean, memory, np.square(whitening).sum(axis=0), np.ravel(whitening)] if joint else [()]
        cdef arrays.array law = doubles(np.concatenate(law_of))
        cdef arrays.array room = doubles(np.zeros(5 * n + 3 * n * _TOGETHER))
        cdef arrays.array places = array("q", bytes(8 * (4 * n + _TOGETHER)))
        cdef bytes flags = bytes([1]) if joint else bytes(map(bool, counted))
        self._keep = [given, law, room, places, flags]
        self.thresholds, self.counted, self.mean = given.data.as_doubles, flags, law.data.as_doubles
        self.unit, self.whitening, self.now = self.mean + 2 * n, self.mean + 3 * n, room.data.as_doubles
        self.memory = self.mean + n if joint and np.any(memory) else NULL
        self.up, self.down, self.terms = self.now + n, self.now + 2 * n, self.now + 3 * n
        self.after = self.terms + n * _TOGETHER
        self.shares = self.after + n * _TOGETHER
        self.before = self.shares + n * _TOGETHER
        self.share = self.before + n
        self.begin = places.data.as_longlongs
        self.middle, self.end, self.total = self.begin + n, self.begin + 2 * n, self.begin + 3 * n
        self.step_ns = self.begin + 4 * n
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
            self.up[i] = self.down[i] = self.before[i] = self.share[i] = 0.0
            self.now[i] = NAN
            self.begin[i] = self.middle[i] = self.end[i] = self.total[i] = 0
        self.spread = 0.0
        self.alarm, self.blamed = False, -1

    def values(self):
        """The statistic over its threshold: 1 and -1 are the threshold; NaN before the first verdict on a state.

        Of mean, ewma and cusum with the sign of the utilisation.
        """
        cdef Py_ssize_t i
        cdef arrays.array found = arrays.clone(array_of_doubles, self.size, False)
        for i in range(self.size):
            found.data.as_doubles[i] = self.now[i]
        return found

    def push_all(self, dt, rows, judged=None, raised=None, found=None, blamed=None):
        """Take many verdicts.

        `dt` (K,): steps, s; `rows` (K, n): the utilisation of each state, or the residual, a row for each verdict. NaN
        is no verdict on that state, and changes nothing of it, nor of any state if all are seen together; `judged`
        (K,): where there is a verdict, default everywhere. Returns (K,): the alarm after each; Returns (K, size):
        `values` after each, NaN without a verdict; both in `raised` and `found` where these are given. A `found` of
        no columns takes none. `blamed` (K,): takes the state that each points to.
        """
        cdef Py_ssize_t k, count = len(dt)
        rows = np.asarray(rows, dtype=np.float64)
        if rows.shape != (count, self.n):
            raise ValueError("the numbers of the verdicts do not fit the states")
        if rows.strides[1] != 8 or rows.strides[0] % 8:
            rows = np.ascontiguousarray(rows)
        cdef const double[:, :] table = rows  # a row of numbers, however far from the next
        cdef const double[::1] times = np.ascontiguousarray(dt, dtype=np.float64)
        cdef const unsigned char[::1] given = np.ascontiguousarray(
            np.ones(count, dtype=bool) if judged is None else judged
        ).view(np.uint8)
        raised = np.empty(count, dtype=bool) if raised is None else raised
        found = np.empty((count, self.size)) if found is None else found
        cdef double[:, :] values = found
        cdef unsigned char[:] alarm = raised.view(np.uint8)
        fits = alarm.shape[0] == values.shape[0] == times.shape[0] == given.shape[0] == count
        if not fits or values.shape[1] not in (0, self.size):
            raise ValueError("the numbers of the verdicts do not fit the states")
        cdef bint points = blamed is not None and (self.kind == _CHI2 or self.kind == _MEWMA)
        cdef short[:] pointed = blamed if points else np.empty(count, dtype=np.int16)
        if pointed.shape[0] != count:
            raise ValueError("the states that are blamed do not fit the verdicts")
        cdef short at[_TOGETHER]
        cdef Py_ssize_t i, q, many, apart = table.strides[0] // 8, kept = values.shape[1]
        cdef unsigned char over[_TOGETHER]
        with nogil:
            for k from 0 <= k < count by _TOGETHER:
                many = count - k if count - k < _TOGETHER else _TOGETHER
                self.push(&times[k], &table[k, 0], apart, &given[k], many, at if points else NULL)
                self.raises(many, over)
                for q in range(many):
                    for i in range(kept):
                        values[k + q, i] = self.after[i * _TOGETHER + q] if given[k + q] else NAN
                    alarm[k + q] = over[q]
                    if points:
                        pointed[k + q] = at[q]
        return raised, found

    cdef int push(
        self, const double* dt, const double* rows, Py_ssize_t apart, const unsigned char* given, Py_ssize_t count,
        short* blamed,
    ) except -1 nogil:
        """Take some verdicts, of which `after` holds the statistic; `raises` takes them then."""
        cdef Py_ssize_t i, q
        cdef bint points = blamed != NULL and (self.kind == _CHI2 or self.kind == _MEWMA)
        for q in range(count):
            self.step_ns[q] = <long long>(dt[q] * 1e9 + 0.5)
        self.take(rows, apart, given, count, points)
        if points:
            self.blame(dt, count, blamed)
        if self.kind == _MEWMA:
            self.average_together(dt, count)
        for i in range(self.size):
            if self.kind == _EWMA or self.kind == _CUSUM:
                self.average(i, dt, count)
            elif self.kind != _MEWMA:
                self.slide(i, dt, count)
        return 0

    cdef void raises(self, Py_ssize_t count, unsigned char* raised) noexcept nogil:
        """The alarm after each of some verdicts; without a number it stays as it was."""
        cdef Py_ssize_t i, q
        cdef double value
        cdef unsigned char there[_TOGETHER]
        for q in range(count):
            there[q] = raised[q] = 0
        for i in range(self.size):
            for q in range(count):
                there[q] |= self.terms[i * _TOGETHER + q] == self.terms[i * _TOGETHER + q]
            for q in range(count if self.counted[i] else 0):
                value = self.after[i * _TOGETHER + q]
                raised[q] |= (value > 1.0) | (value < -1.0)
        for q in range(count):
            if not there[q]:
                raised[q] = self.alarm
            self.alarm = raised[q]

    cdef void take(
        self, const double* rows, Py_ssize_t apart, const unsigned char* given, Py_ssize_t count, bint points
    ) noexcept nogil:
        """What each of some verdicts adds of each state; NaN where it adds nothing; `points`: `shares` as well."""
        cdef Py_ssize_t i, j, q, n = self.n
        cdef bint joint = self.kind == _CHI2 or self.kind == _MEWMA
        cdef double value, weight, limit = _LIMIT if self.kind == _EWMA or self.kind == _CUSUM else _MOST
        cdef double* values
        cdef double* term = self.terms
        cdef double total[_TOGETHER]
        cdef double square[_TOGETHER]
        cdef unsigned char missing[_TOGETHER]
        for i in range(n):
            values = (self.after if joint else self.terms) + i * _TOGETHER
            for q in range(count):
                value = rows[q * apart + i]  # infinite where half is 0
                value = limit if value > limit else -limit if value < -limit else value
                values[q] = value if given[q] else NAN
            if self.kind == _ENERGY:
                for q in range(count):
                    values[q] *= values[q]
        if not joint:
            return
        for q in range(count):
            square[q], missing[q] = 0.0, 0
        for i in range(n):
            values = self.after + i * _TOGETHER
            for q in range(count):
                values[q] -= self.mean[i]
                missing[q] |= values[q] != values[q]
        for i in range(n if self.memory != NULL else 0):
            values = self.after + i * _TOGETHER
            for q in range(count):
                if not missing[q]:
                    value = self.before[i]
                    self.before[i] = values[q]
                    values[q] -= self.memory[i] * value
        for i in range(n if points else 0):
            for q in range(count):
                self.shares[i * _TOGETHER + q] = 0.0
        for i in range(n):
            term = self.terms + i * _TOGETHER
            for q in range(count):
                total[q] = 0.0
            for j in range(i + 1):
                values, weight = self.after + j * _TOGETHER, self.whitening[i * n + j]
                for q in range(count):
                    total[q] += weight * values[q]
            for j in range(i + 1 if points else 0):
                values, weight = self.shares + j * _TOGETHER, self.whitening[i * n + j]
                for q in range(count):
                    values[q] += weight * total[q]
            for q in range(count):
                square[q] += total[q] * total[q]
                term[q] = -_LIMIT if total[q] < -_LIMIT else total[q] if total[q] <= _LIMIT else _LIMIT
        for q in range(count):
            if self.kind == _CHI2:
                self.terms[q] = square[q] if square[q] <= _MOST else _MOST
            if missing[q]:
                self.terms[q] = NAN

    cdef void blame(self, const double* dt, Py_ssize_t count, short* blamed) noexcept nogil:
        """The state that the numbers of all together point to after each of some verdicts."""
        cdef Py_ssize_t i, q
        cdef double value, weight, most
        for q in range(count):
            if self.terms[q] == self.terms[q]:
                weight = dt[q] / (self.window + dt[q])
                self.blamed, most = -1, 0.0
                for i in range(self.n):
                    value = self.shares[i * _TOGETHER + q]
                    value = value * value / self.unit[i] if self.unit[i] > 0.0 else 0.0
                    value = value if value <= _MOST else _MOST
                    self.share[i] += (value - self.share[i]) * weight
                    if self.share[i] > most:
                        self.blamed, most = i, self.share[i]
            blamed[q] = <short>self.blamed

    cdef void average(self, Py_ssize_t i, const double* dt, Py_ssize_t count) noexcept nogil:
        """Moving average of a state, or its sums upwards and downwards, after each of some verdicts."""
        cdef Py_ssize_t q
        cdef double weight, kept, value, down
        for q in range(count):
            value = self.terms[i * _TOGETHER + q]
            if value != value:
                pass
            elif self.kind == _EWMA:
                self.up[i] += (value - self.up[i]) * (dt[q] / (self.window + dt[q]))
                self.now[i] = self.up[i] / self.thresholds[i]
            else:
                weight = dt[q] / self.window
                kept = self.window / (self.window + dt[q])
                down = self.down[i] * kept + (-value - self.allowance) * weight
                value = self.up[i] * kept + (value - self.allowance) * weight
                self.up[i] = value = value if value > 0.0 else 0.0
                self.down[i] = down = down if down > 0.0 else 0.0
                self.now[i] = (value if value >= down else -down) / self.thresholds[i]
            self.after[i * _TOGETHER + q] = self.now[i]

    cdef void average_together(self, const double* dt, Py_ssize_t count) noexcept nogil:
        """Size of the moving average of all states after each of some verdicts."""
        cdef Py_ssize_t i, q
        cdef double weight, kept, value
        for q in range(count):
            if self.terms[q] == self.terms[q]:
                weight = dt[q] / (self.window + dt[q])
                kept = 1.0 - weight
                if self.spread == 0.0:
                    self.spread = weight / (2.0 - weight)
                else:
                    self.spread = kept * kept * self.spread + weight * weight
                value = 0.0
                for i in range(self.n):
                    self.up[i] += (self.terms[i * _TOGETHER + q] - self.up[i]) * weight
                    value += self.up[i] * self.up[i]
                self.now[0] = value / self.spread / self.thresholds[0]
            self.after[q] = self.now[0]

    cdef int slide(self, Py_ssize_t i, const double* dt, Py_ssize_t count) except -1 nogil:
        """Sum over the window of a state after each of some verdicts: add its term, and drop what is older."""
        if self.end[i] + count > self.capacity:
            with gil:
                self.make_room(i, count)
        cdef Py_ssize_t k, q, begin = self.begin[i], middle = self.middle[i], end = self.end[i]
        cdef long long total = self.total[i], most = self.window_ns
        cdef double up = self.up[i], now = self.now[i], threshold = self.thresholds[i], value
        cdef double* queue = self.queue + i * self.capacity
        cdef long long* steps = self.steps + i * self.capacity
        for q in range(count):
            value = self.terms[i * _TOGETHER + q]
            if value == value:
                value *= dt[q]
                queue[end], steps[end] = value, self.step_ns[q]
                up += value
                total += self.step_ns[q]
                end += 1
                while end - begin > 1 and (total > most or end - begin > _LONGEST):
                    if begin == middle:  # the newer half becomes the older one
                        for k in range(end - 2, begin - 1, -1):
                            queue[k] += queue[k + 1]
                        middle = end
                        up = 0.0
                    total -= steps[begin]
                    begin += 1
                value = queue[begin] + up if begin < middle else up
                now = value / (self.window if total <= most else dt[q]) / threshold
            self.after[i * _TOGETHER + q] = now
        self.begin[i], self.middle[i], self.end[i], self.total[i] = begin, middle, end, total
        self.up[i], self.now[i] = up, now
        return 0

    cdef make_room(self, Py_ssize_t i, Py_ssize_t more):
        """Move the window of a state to the front of its part of the queue; if half is not enough, double all first."""
        cdef Py_ssize_t j, k, begin = self.begin[i], count = self.end[i] - self.begin[i], before = self.capacity
        cdef arrays.array queue = self._queue, steps = self._steps
        while 2 * (count + more) > self.capacity:
            self.capacity *= 2
        if self.capacity > before:
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
        cdef unsigned char over, given = True
        cdef short blamed
        for part, begin in zip(self.parts, self.begins):
            if begin < 0 or begin + part.n > row.shape[0]:
                raise ValueError("the numbers of the verdict do not fit the states")
            part.push(&dt, &row[begin], part.n, &given, 1, &blamed)
            part.raises(1, &over)
            raised |= over
        return raised

    def values(self):
        """`Statistic.values` of each, one after the other."""
        found = array("d")
        for part in self.parts:
            found += part.values()
        return found


@cython.final
cdef class Window:
    """Containment: the last verdicts, whether each is a violation, and the alarm while they have enough of them.

    `violations`, `window`: of the rule; `states`: of a verdict that is a violation if the size of one of their numbers
    is over the margin, and none if all are NaN; without states whether it is one is said; `begin`: where the numbers
    begin in the table of `push`.
    """

    cdef readonly bint alarm
    cdef Py_ssize_t needed, size, at, held, bad, begin, least, count
    cdef double margin
    cdef arrays.array _states
    cdef bytearray _last
    cdef unsigned char* last  # (size,): the next takes the place `at`
    cdef const long long* states

    def __init__(self, Py_ssize_t violations, Py_ssize_t window, double margin=0.0, states=(), Py_ssize_t begin=0):
        self.needed, self.size, self.margin, self.begin = violations, window, margin, begin
        self._states, self._last = array("q", states), bytearray(window)
        if window < 1 or begin < 0 or (len(states) and min(states) < 0):
            raise ValueError("the window or the states are none")
        self.states, self.last, self.count = self._states.data.as_longlongs, self._last, len(states)
        self.least = begin + max(states) + 1 if self.count else 0
        self.reset()

    def reset(self):
        """Forget every verdict and the alarm."""
        self.at = self.held = self.bad = 0
        self.alarm = False

    def push(self, bint violated, table):
        """Take one verdict; whether the alarm is raised after it."""
        cdef const double[::1] row
        if self.count == 0:
            return self.take(violated)
        row = table
        if row.shape[0] < self.least:
            raise ValueError("the numbers of the verdict do not fit the states")
        return self.take(self.beyond(&row[self.begin], 1))

    def push_all(self, violated, rows, judged, raised):
        """Take many verdicts: `violated` (K,), or with states their numbers `rows` (K, n), where there is one `judged`
        (K,); `raised` (K,) takes the alarm after each.
        """
        cdef const unsigned char[:] bad = np.asarray(violated).view(np.uint8)
        cdef const unsigned char[:] given = np.asarray(judged).view(np.uint8)
        cdef unsigned char[:] alarm = raised.view(np.uint8)
        cdef const double[:, :] table = rows if self.count else np.empty((alarm.shape[0], 1))
        cdef Py_ssize_t k, count = alarm.shape[0], apart = table.strides[1] // 8
        if not bad.shape[0] == given.shape[0] == table.shape[0] == count or table.shape[1] < self.least - self.begin:
            raise ValueError("the numbers of the verdicts do not fit the states")
        with nogil:
            for k in range(count):
                alarm[k] = self.take((self.beyond(&table[k, 0], apart) if self.count else bad[k]) if given[k] else -1)

    cdef bint take(self, int violated) noexcept nogil:
        """Take one verdict, -1 for none; the alarm after it."""
        if violated < 0:
            return self.alarm
        if self.held == self.size:
            self.bad -= self.last[self.at]
        else:
            self.held += 1
        self.last[self.at] = violated
        self.bad += violated
        self.at = self.at + 1 if self.at + 1 < self.size else 0
        self.alarm = self.bad >= self.needed
        return self.alarm

    cdef int beyond(self, const double* row, Py_ssize_t apart) noexcept nogil:
        """1 if the size of some state is over the margin, 0 if not; -1 if all are NaN, and one alone is no verdict."""
        cdef Py_ssize_t i
        cdef double value
        cdef bint nothing = True, over = False
        for i in range(self.count):
            value = row[self.states[i] * apart]
            nothing &= value != value
            over |= (value > self.margin) | (value < -self.margin)
        return -1 if nothing else over
