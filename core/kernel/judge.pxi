# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Transitions, judged one after another as they come, or many of a recording at once."""

LOWER, UPPER, RESIDUAL, FLAGS, UTILISATION = range(5)
"""What a `Judgement` holds of each state."""
JUDGED, LEFT, VIOLATION, OUTSIDE, UNKNOWN, UNLISTED, REPEATS = 1, 2, 4, 8, 16, 32, 64
"""Bits of what is said of a transition: there is a verdict; some state left its bounds; one that counts did; it leaves
the fitted domain; its regime is unknown; its mode is not listed, so that there is no verdict; some state did not
change at all."""
cdef enum:
    _JUDGED = 1
    _LEFT = 2
    _VIOLATION = 4
    _OUTSIDE = 8
    _UNKNOWN = 16
    _UNLISTED = 32
    _REPEATS = 64
    _BEYOND = 128  # what the arithmetic does not carry: no verdict either


@cython.final
cdef class Judgement:
    """What the bounds say of one transition."""

    cdef readonly bint contained, violation, outside_domain, unknown_regime
    cdef arrays.array _values

    def numbers(self, Py_ssize_t which):
        """Bound (recorded units), utilisation, residual (normalised) or flag (0 contained, 1 violated) of each state.
        """
        cdef Py_ssize_t n = len(self._values) // 5
        return self._values[which * n : which * n + n]

    def reach(self, double[::1] largest):
        """Raise the largest |utilisation| of each state so far to that of this transition."""
        cdef Py_ssize_t i, n = largest.shape[0]
        cdef const double* utilisation = self._values.data.as_doubles + 4 * n  # the last of them
        for i in range(n):
            if fabs(utilisation[i]) > largest[i]:
                largest[i] = fabs(utilisation[i])

    def packed(self):
        """All of it, one kind after another, as bytes."""
        return self._values.tobytes()


@cython.final
cdef class Judge:
    """Judges one transition after another by the bounds of one model.

    `theta, delta, v`: as of `Elements`; `law`: as theta, what residuals are counted from in place of the centre;
    `steady, scale` (n + m + q,): of [x; u; s], with s the q further scheduling signals; `least, greatest` (n + m,):
    normalised [x; u] that the fit saw; `margin`: multiplies the half-widths; `counted` (n,): states whose violations
    count; `occupied` (pairs, cells, cells): combinations of two signals that
    the fit saw; `schedule`: `model.schedule.Schedule`, None for one block; `positions`: where its signals are in
    [x; u; s]; `known` (R,): blocks that a recording visited.
    """

    cdef Py_ssize_t n, size, total
    cdef double margin
    cdef Elements elements, law
    cdef bint apart  # the law is another one than the elements
    cdef Blocks blocks
    cdef list _keep
    cdef const double* steady
    cdef const double* scale
    cdef const double* least
    cdef const double* greatest
    cdef const double* per_unit
    cdef double* phi  # [x; u; 1] of the last transition, and
    cdef double* z  # [x; u; s] of it
    cdef double* end  # arrival, normalised
    cdef double* rates  # (n, _TOGETHER)
    cdef const unsigned char* counted
    cdef const unsigned char* occupied
    cdef Py_ssize_t cells
    cdef int* cell
    cdef int positions[2]
    cdef double s[2]
    cdef Py_ssize_t places[_CORNERS]
    cdef double weights[_CORNERS]

    def __init__(
        self, theta, delta, v, steady, scale, least, greatest, double margin, counted, occupied=None, schedule=None,
        positions=(), known=None, law=None,
    ):
        cdef Py_ssize_t n, p, size = len(least)
        *_, n, p = theta.shape
        self.n, self.size, self.total = n, size, len(steady)
        self.margin, self.blocks = margin, Blocks(() if schedule is None else schedule.axes, known)
        lead = () if schedule is None else (self.blocks.count,)
        self.apart, law = law is not None, theta if law is None else law
        if not law.shape == theta.shape == delta.shape == (*lead, n, p) or v.shape != (*lead, n) or p < size:
            raise ValueError("the terms do not fit one another")
        if len(counted) != n:
            raise ValueError("the states that count do not fit the terms")
        if not len(scale) == self.total >= size == len(greatest) >= n:
            raise ValueError("the operating point or the domain does not fit the terms")
        if schedule is not None and not (
            len(positions) == len(schedule.axes) and all(0 <= i < self.total for i in positions)
        ):
            raise ValueError("the schedule does not fit the signals")
        self.cells = 0 if occupied is None else occupied.shape[1]
        if occupied is not None and occupied.shape != (pair_count(size), self.cells, self.cells):
            raise ValueError("the occupied cells do not fit the signals")
        self.elements = Elements(theta, delta, v)
        self.law = Elements(law, delta, v) if self.apart else self.elements
        cdef arrays.array numbers = doubles(
            np.concatenate([steady, scale, least, greatest, cells_per_unit(least, greatest, self.cells)])
        )
        cdef arrays.array room = doubles(np.ones(p + self.total + n + n * _TOGETHER))  # beyond z the regressors are 1
        cdef arrays.array cell = array("i", bytes(4 * (size or 1) * _TOGETHER))
        cdef bytes flags = np.asarray(counted, dtype=np.uint8).tobytes()
        seen = np.ascontiguousarray([False] if occupied is None else occupied, dtype=bool).reshape(-1)
        cdef const unsigned char[::1] cells = seen.view(np.uint8)  # no copy: of many signals it is large
        self._keep = [numbers, room, cell, flags, seen]
        self.steady = numbers.data.as_doubles
        self.scale, self.least = self.steady + self.total, self.steady + 2 * self.total
        self.greatest, self.per_unit = self.least + size, self.least + 2 * size
        self.phi = room.data.as_doubles
        self.z, self.end = self.phi + p, self.phi + p + self.total
        self.rates = self.end + n
        self.cell, self.counted, self.occupied = cell.data.as_ints, flags, &cells[0]
        for i, position in enumerate(positions):
            self.positions[i] = position

    def judge(self, before, after, double dt):
        """Judge one transition; None for a mode that is not listed."""
        cdef Py_ssize_t i, n = self.n
        if len(before) != self.total or len(after) != n:
            raise ValueError(f"{len(before)} and {len(after)} values for {self.total} and {n} signals")
        cdef int regime = self.read(before)
        if regime < 0:
            return None
        cdef Judgement found = Judgement.__new__(Judgement)
        found._values = arrays.clone(array_of_doubles, 5 * n, False)
        for i in range(n):
            self.end[i] = normalised(after[i], self.steady[i], self.scale[i])
        cdef int marks = self.compare(dt, regime, found._values.data.as_doubles)
        found.contained, found.violation = not marks & _LEFT, (marks & _VIOLATION) != 0
        found.outside_domain, found.unknown_regime = (marks & _OUTSIDE) != 0, (marks & _UNKNOWN) != 0
        return found

    def judge_rows(self, x, u, s, k, dt, numbers, marks):
        """Judge some transitions of a recording; what is found goes to the rows at which they arrive.

        `x, u, s`: states, controls and further scheduling signals of its samples, recorded units; `k` (K,): samples
        that the transitions begin with, increasing; `dt` (K,): s; `numbers`: of each kind that a `Judgement` holds an
        array (samples, n), or None if nobody reads it; what it holds without a verdict has no meaning; `marks`
        (samples,): take the bits above; None if nobody reads them, of which the domain takes the time.
        """
        cdef bint marked = marks is not None
        cdef const double[:, :] states = x
        cdef const double[:, :] controls = u
        cdef const double[:, :] others = s
        cdef const Py_ssize_t[::1] begins = np.ascontiguousarray(k, dtype=np.intp)
        cdef const double[::1] steps = np.ascontiguousarray(dt, dtype=np.float64)
        cdef unsigned char[::1] flags = marks if marked else np.empty(len(x), np.uint8)
        cdef double[:, ::1] values
        cdef double* to[5]
        cdef Py_ssize_t i, j, q, at, low, n = self.n, p = self.elements.p, count = begins.shape[0]
        cdef Py_ssize_t samples = states.shape[0], lead = self.total
        fits = states.shape[1] == n and controls.shape[1] == self.size - n and others.shape[1] == lead - self.size
        fits = fits and controls.shape[0] == others.shape[0] == flags.shape[0] == samples and steps.shape[0] == count
        if not (fits and len(numbers) == 5):
            raise ValueError("the transitions do not fit the model")
        if count and not 0 <= begins[0] <= begins[count - 1] < samples - 1:
            raise ValueError("the transitions do not fit the recording")
        for j, given in enumerate(numbers):
            to[j] = NULL
            if given is not None:
                values = given
                if not (values.shape[0] == samples and values.shape[1] == n):
                    raise ValueError("the numbers do not fit the recording")
                to[j] = &values[0, 0] if samples else NULL
        z, after, times = np.empty((lead, _SORTED)), np.empty((n, _SORTED)), np.empty(_SORTED)
        at_schedule = z[[self.positions[i] for i in range(self.blocks.axes)]]
        cdef double[:, ::1] normal = z
        cdef double[:, ::1] ends = after
        cdef double[:, ::1] scheduling = at_schedule
        cdef double[::1] lasts = times
        cdef Tiles tiles = Tiles(n, p, z[: self.size], times, None, after, self.blocks, at_schedule)
        cdef unsigned char beyond[_SORTED]  # bits of what makes the numbers of a transition none, and of repeats
        cdef unsigned char out[_TOGETHER]
        cdef double* psi = room_for(p + 3)
        cdef double* centre = psi + p * _TOGETHER
        cdef double* half = centre + _TOGETHER
        cdef double* expected = half + _TOGETHER if self.apart and to[2] != NULL else centre
        with nogil:
            for low from 0 <= low < count by _SORTED:
                tiles.begin(0, count - low if count - low < _SORTED else _SORTED, 0)
                for q in range(tiles.count):
                    beyond[q], lasts[q] = 0, steps[low + q]
                for i in range(n):
                    self.column(states, begins, low, tiles.count, i, i, beyond, &normal[i, 0])
                for i in range(n, self.size):
                    self.column(controls, begins, low, tiles.count, i - n, i, beyond, &normal[i, 0])
                for i in range(self.size, lead):
                    self.column(others, begins, low, tiles.count, i - self.size, i, beyond, &normal[i, 0])
                for i in range(n):
                    for q in range(tiles.count):
                        at = begins[low + q]
                        ends[i, q] = normalised(states[at + 1, i], self.steady[i], self.scale[i])
                        beyond[q] |= _REPEATS if states[at, i] == states[at + 1, i] else 0
                for i in range(self.blocks.axes):
                    memcpy(&scheduling[i, 0], &normal[self.positions[i], 0], tiles.count * sizeof(double))
                while tiles.take():
                    tiles.sizes(p, psi)
                    if marked:
                        self.leave_domain(tiles.phi, _TOGETHER, tiles.many, out)
                    for q in range(tiles.many):
                        flags[begins[low + tiles.index[q]] + 1] = self.marks_of(tiles.regimes[q], marked and out[q])
                    for i in range(n):
                        tiles.bounds(self.elements, i, psi, centre, half)
                        if expected != centre:
                            tiles.centres(self.law, i, expected)
                        for q in range(tiles.many):
                            at = begins[low + tiles.index[q]] + 1
                            flags[at] |= self.place(
                                i, centre[q], half[q], expected[q], tiles.end[i * _TOGETHER + q], to, at * n + i
                            )
                for q in range(tiles.count):
                    at = begins[low + q] + 1
                    if beyond[q] & _BEYOND:
                        flags[at] = 0
                    if not flags[at] & _JUDGED:  # without a verdict nothing left its bounds
                        flags[at] &= _UNLISTED
                    flags[at] |= beyond[q] & _REPEATS
        free(psi)

    cdef void column(
        self, const double[:, :] rows, const Py_ssize_t[::1] begins, Py_ssize_t low, Py_ssize_t count, Py_ssize_t j,
        Py_ssize_t i, unsigned char* beyond, double* to
    ) noexcept nogil:
        """Column j of some rows of a recording, which are signal i, normalised."""
        cdef Py_ssize_t q
        cdef double value, steady = self.steady[i], scale = self.scale[i]
        for q in range(count):
            value = rows[begins[low + q], j]
            beyond[q] |= _BEYOND if not is_carried(value) else 0
            to[q] = normalised(value, steady, scale)

    cdef inline int marks_of(self, int regime, bint outside) noexcept nogil:
        """The bits of a transition before its states are looked at; regime: of `Blocks.find`."""
        if regime < 0:
            return _UNLISTED
        return _JUDGED | (_UNKNOWN | _OUTSIDE if regime > 0 else 0) | (_OUTSIDE if outside else 0)

    cdef inline int place(
        self, Py_ssize_t i, double centre, double half, double expected, double end, double** to, Py_ssize_t at
    ) noexcept nogil:
        """What the bounds say of the end of a state, into numbers that are not NULL, and in bits."""
        cdef double lower = lower_of(centre, half, self.margin), upper = upper_of(centre, half, self.margin)
        cdef bint inside = is_contained(lower, end, upper)
        if to[0] != NULL:
            to[0][at] = recorded(lower, self.steady[i], self.scale[i])
        if to[1] != NULL:
            to[1][at] = recorded(upper, self.steady[i], self.scale[i])
        if to[2] != NULL:
            to[2][at] = end - expected
        if to[3] != NULL:
            to[3][at] = 0.0 if inside else 1.0
        if to[4] != NULL:
            to[4][at] = utilisation_of(end - centre, half)
        return 0 if inside else _LEFT | (_VIOLATION if self.counted[i] else 0)

    cdef int compare(self, double dt, int regime, double* values) noexcept nogil:
        """Compare the arrival `end` with the bounds of the transition that was taken; one kind of number after another.
        """
        cdef Py_ssize_t i, j, n = self.n
        cdef unsigned char out
        cdef double* to[5]
        self.leave_domain(self.phi, 1, 1, &out)
        cdef int marks = self.marks_of(regime, out)
        self.elements.sum(self.phi, self.places, self.weights, self.blocks.corners)
        if self.apart:
            self.law.sum(self.phi, self.places, self.weights, self.blocks.corners)
        for j in range(5):
            to[j] = values + j * n
        for i in range(n):
            marks |= self.place(
                i, centre_of(self.phi[i], dt, self.elements.rate[i]),
                half_of(dt, self.elements.spread[i], self.elements.still[i]),
                centre_of(self.phi[i], dt, self.law.rate[i]), self.end[i], to, i,
            )
        return marks

    cdef void leave_domain(
        self, const double* z, Py_ssize_t stride, Py_ssize_t count, unsigned char* out
    ) noexcept nogil:
        """`left_domain` of [x; u] in columns a stride wide."""
        left_domain(
            z, stride, count, self.least, self.greatest, self.per_unit, self.occupied, self.size, self.cells,
            self.cell, _SLACK, out,
        )

    cdef int read(self, before) except -2:
        """Normalise [x; u; s] and find the blocks that hold there: -1 for no mode that is listed, 1 if unknown."""
        cdef Py_ssize_t i
        for i in range(self.total):
            self.z[i] = normalised(before[i], self.steady[i], self.scale[i])
        return self.take(self.z, 1)

    cdef int take(self, const double* z, Py_ssize_t stride) noexcept nogil:
        """Take normalised [x; u; s], and what `read` gives."""
        cdef Py_ssize_t i
        for i in range(self.size):
            self.phi[i] = z[i * stride]
        for i in range(self.blocks.axes):
            self.s[i] = z[self.positions[i] * stride]
        return self.blocks.find(self.s, self.places, self.weights)

    def advance(self, double[:, ::1] runs, z, dt, Py_ssize_t a, Py_ssize_t b, Py_ssize_t first, Py_ssize_t last):
        """Take runs first to last - 1 of the nominal model from a steps to b, run k being that from transition k on.

        Where transitions do not follow one another, what is computed for a run across has no meaning.

        `runs` (n + m + 1, N): state of each run after a steps, normalised, Σ Δt u and Σ Δt of them; takes the result;
        `z` (n + m + q, N): normalised [x; u; s] of the transitions, in order of time; `dt` (N,): s.
        """
        cdef Py_ssize_t i, j, q, low, high, n = self.n, p = self.elements.p, size = self.size, count = runs.shape[1]
        if not (z.shape[0] == self.total and z.shape[1] == len(dt) == count and runs.shape[0] == size + 1):
            raise ValueError("the runs do not fit the transitions")
        if not (0 <= a <= b and 0 <= first <= last <= count):
            raise ValueError("the runs do not fit the transitions")
        at_schedule = z[[self.positions[i] for i in range(self.blocks.axes)]]
        cdef Tiles tiles = Tiles(size + 1, p, z[:size], dt, runs, None, self.blocks, at_schedule)
        cdef double* rates = room_for(n)
        cdef double* start = tiles.start
        with nogil:
            for low from first <= low < last by _SORTED:
                for i in range(a, b):
                    high = min(low + _SORTED, last, count - i)
                    if high <= low:
                        break
                    tiles.begin(low, high, i)
                    while tiles.take():
                        memcpy(tiles.phi, start, n * _TOGETHER * sizeof(double))
                        for j in range(n):
                            tiles.sum(self.elements.theta, j, n, p, tiles.phi, rates + j * _TOGETHER)
                        for j in range(n):
                            for q in range(tiles.many):
                                start[j * _TOGETHER + q] = centre_of(
                                    start[j * _TOGETHER + q], tiles.step[q], rates[j * _TOGETHER + q]
                                )
                        for j in range(n, size):
                            for q in range(tiles.many):
                                start[j * _TOGETHER + q] += tiles.phi[j * _TOGETHER + q] * tiles.step[q]
                        for q in range(tiles.many):
                            start[size * _TOGETHER + q] += tiles.step[q]
                        tiles.put(start, runs)
        free(rates)

    cdef void step(
        self, double* x, double* time, double* control, Py_ssize_t stride, Py_ssize_t low, Py_ssize_t high, double dt
    ) noexcept nogil:
        """One step of the runs low to high - 1, in columns a stride wide, by the transition that was taken."""
        cdef Py_ssize_t i, j, k, width, n = self.n, p = self.elements.p
        cdef double value
        cdef double* rate
        cdef double* state
        cdef const double* theta = self.elements.nominal_at(self.places, self.weights, self.blocks.corners)
        while low < high:
            width = high - low if high - low < _TOGETHER else _TOGETHER
            for i in range(n):  # `add_columns` of the states of the runs, and of regressors that they share
                rate = self.rates + i * _TOGETHER
                for j in range(p):
                    value = theta[j * n + i]
                    if j >= n:
                        value *= self.phi[j]
                        for k in range(width):
                            rate[k] += value
                        continue
                    state = x + j * stride + low
                    if j == 0:
                        for k in range(width):
                            rate[k] = value * state[k]
                    else:
                        for k in range(width):
                            rate[k] += value * state[k]
            for i in range(n):
                rate = self.rates + i * _TOGETHER
                state = x + i * stride + low
                for k in range(width):
                    state[k] = centre_of(state[k], dt, rate[k])
            for k in range(low, low + width):
                time[k] += dt
            for j in range(n, self.size):
                value = self.phi[j] * dt
                state = control + (j - n) * stride + low
                for k in range(width):
                    state[k] += value
            low += width
