# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Exact repeats as they come: how long, how far the model moves the state meanwhile, and whether it is frozen."""

LONGER, BY_RUN, BY_SUM, BY_ACTIVITY, BY_NOISE = range(2, 7)
"""What a code of `Repeating` says: longer than in any repeat of the fit, or frozen, by its run, its sum, the activity
or for want of noise."""
cdef enum:
    _MEASURES = 4  # seconds, run, sum, activity
    _THRESHOLDS = 7  # usual s, longest s, run, sum, activity, s of noise, s of a slow sensor
    _FRESH = 0
    _USUAL = 1
    _LONGER = 2  # than in any repeat of the fit
    _RUN = 3  # frozen from here on
    _SUM = 4
    _ACTIVE = 5
    _NOISE = 6


cdef struct Repeat:
    int code  # _FRESH where there is none
    long long begin  # ns
    Py_ssize_t steps  # but for those outside the fitted ranges, of which nothing counts
    double run, total, half  # the last: the largest half-width
    double low, high, per_second  # rates, and the largest half-width per second
    double size  # of the measure by which it is frozen


cdef inline double over(double size, double half) noexcept nogil:
    """A size in half-widths; any is beyond all where the half-width is 0."""
    return size / half if half > 0.0 else INFINITY if size > 0.0 else 0.0


@cython.final
cdef class Repeating:
    """Follows the repeats of every state, one transition after another, and tells which are frozen.

    `thresholds` (n, 7): of each state, as of `model.repeats.FrozenWatch`; `least`: steps that activity and noise need;
    `rest`: of a state that repeated so long the fit has seen a rest, s; `counted` (n,): states that may be frozen;
    `margin`: of the bounds that it will be given; `most` (4, n): the longest repeat so far, s, the farthest run, the
    largest sum and the greatest activity, in half-widths.
    """

    cdef readonly object most
    cdef Py_ssize_t n, least
    cdef double rest, margin
    cdef list _keep
    cdef double* thresholds
    cdef double* start  # (n, n): the states where each repeat began
    cdef double* given  # (5, n): before, after, lower, upper, own
    cdef double* measures  # (4, n): of this transition
    cdef double[:, ::1] largest
    cdef bytes counted
    cdef bytearray _of
    cdef Repeat* of

    def __init__(self, thresholds, Py_ssize_t least, double rest, counted, double margin):
        cdef Py_ssize_t n = len(thresholds)
        if np.shape(thresholds) != (n, _THRESHOLDS) or len(counted) != n or not margin > 0.0:
            raise ValueError("the thresholds do not fit the states")
        cdef arrays.array numbers = doubles(thresholds), room = doubles(np.zeros((5 + _MEASURES + n) * n))
        self.n, self.least, self.rest, self.margin = n, least, rest, margin
        self.most, self._keep = np.zeros((_MEASURES, n)), [numbers, room]
        self.largest, self.thresholds, self.given = self.most, numbers.data.as_doubles, room.data.as_doubles
        self.measures = self.given + 5 * n
        self.start = self.measures + _MEASURES * n
        self.counted = np.asarray(counted, dtype=np.uint8).tobytes()
        self._of = bytearray(sizeof(Repeat) * (n or 1))
        self.of = <Repeat*><char*>self._of

    def forget(self):
        """No transition leads to the next sample: every repeat ends."""
        for i in range(self.n):
            self.of[i].code = _FRESH

    def take(self, long long t_ns, double dt, before, after, lower, upper, own, bint outside):
        """Take one transition to `t_ns`: number, seconds, code and size of each state that is frozen or repeats longer.

        `before`, `after` (n,): states, recorded units; `lower`, `upper` (n,): bounds; `own` (n,): elements a_ii of the
        nominal model, 1/s; `outside`: it begins outside the fitted ranges.
        """
        cdef Py_ssize_t i, j, n = self.n
        for j, values in enumerate((before, after, lower, upper, own)):
            for i in range(n):
                self.given[j * n + i] = values[i]
        given = self.given
        self.push(t_ns, dt, given, given + n, given + 2 * n, given + 3 * n, given + 4 * n, outside)
        return [
            (i, self.measures[i], self.of[i].code, self.of[i].size) for i in range(n) if self.of[i].code >= _LONGER
        ]

    def take_all(self, follows, t_ns, dt, before, after, lower, upper, own, outside):
        """As `take`, K transitions; `follows` (K,): each follows the one before. Returns codes and sizes (K, n)."""
        cdef const unsigned char[::1] on = np.ascontiguousarray(follows, dtype=np.uint8)
        cdef const unsigned char[::1] beyond = np.ascontiguousarray(outside, dtype=np.uint8)
        cdef const long long[::1] ends = np.ascontiguousarray(t_ns, dtype=np.int64)
        cdef const double[::1] steps = np.ascontiguousarray(dt, dtype=np.float64)
        given = np.ascontiguousarray([before, after, lower, upper, own], dtype=np.float64)
        cdef const double[:, :, ::1] of_each = given
        cdef Py_ssize_t i, k, n = self.n, count = ends.shape[0]
        if not (given.shape == (5, count, n) and on.shape[0] == beyond.shape[0] == steps.shape[0] == count):
            raise ValueError("the transitions do not fit the states")
        codes, sizes = np.zeros((count, n), dtype=np.uint8), np.zeros((count, n))
        cdef unsigned char[:, ::1] code = codes
        cdef double[:, ::1] size = sizes
        if not count or not n:
            return codes, sizes
        with nogil:
            for k in range(count):
                if not on[k]:
                    for i in range(n):
                        self.of[i].code = _FRESH
                self.push(
                    ends[k], steps[k], &of_each[0, k, 0], &of_each[1, k, 0], &of_each[2, k, 0], &of_each[3, k, 0],
                    &of_each[4, k, 0], beyond[k],
                )
                for i in range(n):
                    code[k, i], size[k, i] = self.of[i].code, self.of[i].size
        return codes, sizes

    cdef void push(
        self, long long t_ns, double dt, const double* before, const double* after, const double* lower,
        const double* upper, const double* own, bint outside,
    ) noexcept nogil:
        """Take one transition."""
        cdef Py_ssize_t i, j, n = self.n, same = 0
        cdef double movement, half
        cdef double* found = self.measures
        cdef Repeat* repeat
        for i in range(n):
            repeat = &self.of[i]
            if after[i] != before[i]:
                repeat.code, repeat.size = _FRESH, 0.0
                continue
            same += 1
            if repeat.code == _FRESH:
                repeat.code, repeat.begin, repeat.steps = _USUAL, t_ns - llrint(dt * 1e9), 0
                repeat.run = repeat.total = repeat.half = repeat.per_second = 0.0
                repeat.low, repeat.high, repeat.size = INFINITY, -INFINITY, 0.0
                memcpy(self.start + i * n, before, n * sizeof(double))
            if not outside:
                movement = 0.5 * (lower[i] + upper[i]) - after[i]
                half = 0.5 * (upper[i] - lower[i]) / self.margin
                repeat.run += fmax(dt * fmin(own[i], 0.0), -1.0) * repeat.run + movement
                repeat.total += movement
                repeat.half = half if half > repeat.half else repeat.half
                repeat.steps += 1
                repeat.low = movement / dt if movement / dt < repeat.low else repeat.low
                repeat.high = movement / dt if movement / dt > repeat.high else repeat.high
                repeat.per_second = half / dt if half / dt > repeat.per_second else repeat.per_second
            found[i] = <double>(t_ns - repeat.begin) * 1e-9
            found[n + i], found[2 * n + i] = over(fabs(repeat.run), repeat.half), over(fabs(repeat.total), repeat.half)
            found[3 * n + i] = over(repeat.high - repeat.low, repeat.per_second) if repeat.steps else 0.0
            for j in range(_MEASURES):  # NaN, of a run beyond all numbers, is not the most
                self.largest[j, i] = fmax(self.largest[j, i], found[j * n + i])
        for i in range(n):
            if self.of[i].code != _FRESH and self.counted[i] and self.of[i].code < _RUN:
                j = _FRESH if outside else self.why(i, after, lower, upper, n > 1 and same == n)
                self.of[i].code = j if j else _LONGER if found[i] > self.limit(i, 1) + dt / 2 else _USUAL

    cdef inline double limit(self, Py_ssize_t i, Py_ssize_t which) noexcept nogil:
        return self.thresholds[i * _THRESHOLDS + which]

    cdef int why(
        self, Py_ssize_t i, const double* after, const double* lower, const double* upper, bint parked
    ) noexcept nogil:
        """Why a state is frozen; 0 where it is not. `parked`: all of several states repeat."""
        cdef Py_ssize_t n = self.n, j, steps = self.of[i].steps
        cdef const double* found = self.measures + i
        cdef double longest = self.limit(i, 1)
        cdef double times = fmax(found[0] / longest, 1.0) if longest >= self.rest else 1.0  # a rest may be longer
        cdef bint rests = after[i] == 0.0
        cdef bint unusual = found[0] > self.limit(i, 0)
        if unusual and found[n] > times * self.limit(i, 2) and not (rests or parked):
            self.of[i].size = found[n]
            return _RUN
        if unusual and found[2 * n] > times * self.limit(i, 3) and found[0] > longest and not rests:
            for j in range(n):  # some state has left the place that it had when the repeat began
                if fabs(after[j] - self.start[i * n + j]) > 0.5 * (upper[j] - lower[j]) / self.margin:
                    self.of[i].size = found[2 * n]
                    return _SUM
        if unusual and steps >= self.least and found[3 * n] > fmax(self.limit(i, 4), 1.0 if rests else 1.0 / steps):
            self.of[i].size = found[3 * n]
            return _ACTIVE
        if rests or parked:
            return 0
        if found[0] >= self.limit(i, 6):
            return _NOISE
        return _NOISE if unusual and steps >= self.least and found[0] >= self.limit(i, 5) else 0
