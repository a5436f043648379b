# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""One transition after another, judged as it comes."""

LOWER, UPPER, RESIDUAL, FLAGS, UTILISATION = range(5)
"""What a `Judgement` holds of each state."""


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

    def packed(self):
        """All of it, one kind after another, as bytes."""
        return self._values.tobytes()


@cython.final
cdef class Judge:
    """Judges one transition after another by the bounds of one model.

    `theta, delta, v`: as of `Elements`; `steady, scale` (n + m + q,): of [x; u; s], with s the q further scheduling
    signals; `least, greatest` (n + m,): normalised [x; u] that the fit saw; `margin`: multiplies the half-widths;
    `counted` (n,): states whose violations count; `occupied` (pairs, cells, cells): combinations of two signals that
    the fit saw; `schedule`: `model.schedule.Schedule`, None for one block; `positions`: where its signals are in
    [x; u; s]; `known` (R,): blocks that a recording visited.
    """

    cdef Py_ssize_t n, size, total
    cdef double margin
    cdef Elements elements
    cdef Blocks blocks
    cdef list _keep
    cdef const double* steady
    cdef const double* scale
    cdef const double* least
    cdef const double* greatest
    cdef const double* per_unit
    cdef double* phi  # [x; u; 1] of the last transition, and
    cdef double* z  # [x; u; s] of it
    cdef double* rates  # (n, _TOGETHER)
    cdef const unsigned char* counted
    cdef const unsigned char* occupied
    cdef Py_ssize_t cells
    cdef int* place
    cdef int positions[2]
    cdef double s[2]
    cdef Py_ssize_t places[_CORNERS]
    cdef double weights[_CORNERS]

    def __init__(
        self, theta, delta, v, steady, scale, least, greatest, double margin, counted, occupied=None, schedule=None,
        positions=(), known=None,
    ):
        cdef Py_ssize_t n, p, size = len(least)
        *_, n, p = theta.shape
        self.n, self.size, self.total = n, size, len(steady)
        self.margin, self.blocks = margin, Blocks(() if schedule is None else schedule.axes, known)
        lead = () if schedule is None else (self.blocks.count,)
        if not theta.shape == delta.shape == (*lead, n, p) or v.shape != (*lead, n) or len(counted) != n or p < size:
            raise ValueError("the terms do not fit one another")
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
        cdef arrays.array numbers = doubles(
            np.concatenate([steady, scale, least, greatest, cells_per_unit(least, greatest, self.cells)])
        )
        cdef arrays.array room = doubles(np.ones(p + self.total + n * _TOGETHER))  # beyond z the regressors are 1
        cdef arrays.array place = array("i", bytes(4 * (size or 1)))
        cdef bytes flags = np.asarray(counted, dtype=np.uint8).tobytes()
        cdef bytes cells = b"" if occupied is None else np.ascontiguousarray(occupied, dtype=np.uint8).tobytes()
        self._keep = [numbers, room, place, flags, cells]
        self.steady = numbers.data.as_doubles
        self.scale, self.least = self.steady + self.total, self.steady + 2 * self.total
        self.greatest, self.per_unit = self.least + size, self.least + 2 * size
        self.phi = room.data.as_doubles
        self.z, self.rates = self.phi + p, self.phi + p + self.total
        self.place, self.counted, self.occupied = place.data.as_ints, flags, cells
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
        cdef arrays.array kept = arrays.clone(array_of_doubles, 5 * n, False)
        cdef double* values = kept.data.as_doubles
        cdef Elements elements = self.elements
        cdef double x_next, centre, half, lower, upper
        cdef bint inside
        found._values, found.contained, found.unknown_regime = kept, True, regime > 0
        found.outside_domain = regime > 0 or self.left_domain()
        elements.sum(self.phi, self.places, self.weights, self.blocks.corners)
        for i in range(n):
            x_next = normalised(after[i], self.steady[i], self.scale[i])
            centre = centre_of(self.phi[i], dt, elements.rate[i])
            half = half_of(dt, elements.spread[i], elements.still[i])
            lower, upper = lower_of(centre, half, self.margin), upper_of(centre, half, self.margin)
            inside = is_contained(lower, x_next, upper)
            found.contained &= inside
            found.violation |= not inside and self.counted[i] != 0
            values[i] = recorded(lower, self.steady[i], self.scale[i])
            values[n + i] = recorded(upper, self.steady[i], self.scale[i])
            values[2 * n + i] = x_next - centre
            values[3 * n + i] = not inside
            values[4 * n + i] = utilisation_of(x_next - centre, half)
        return found

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

    cdef bint left_domain(self) noexcept nogil:
        """Whether [x; u] leaves the box in some element, or is a combination that was not fitted."""
        cdef Py_ssize_t i
        for i in range(self.size):
            if is_outside(self.phi[i], self.least[i], self.greatest[i]):
                return True
        return self.cells > 0 and not pairs_visited(
            self.phi, self.least, self.per_unit, self.occupied, self.size, self.cells, self.place
        )

    def advance(
        self, double[:, ::1] x, double[::1] time, double[:, ::1] control, z, dt, const long long[::1] begin,
        Py_ssize_t a, Py_ssize_t b,
    ):
        """Take runs of the nominal model from a steps to b, the run k being the one that begins at transition k.

        Of a transition at which a run may not go on, what is computed for that run has no meaning.

        `x` (n, N): state of each run after a steps, normalised; takes the result; `time` (N,): Σ Δt of the steps so
        far, s; takes the result; `control` (m, N): Σ Δt u of the steps so far; takes the result; `z` (n + m + q, N):
        normalised [x; u; s] of the transitions, in order of time; `dt` (N,): s; `begin` (N,): of each transition the
        first of those that follow one another without a break up to it.
        """
        cdef const double[:, ::1] rows = np.ascontiguousarray(z.T, dtype=np.float64)
        cdef const double[::1] step = np.ascontiguousarray(dt, dtype=np.float64)
        cdef Py_ssize_t i, low, count = step.shape[0]
        fits = x.shape[0] == self.n and control.shape[0] == self.size - self.n and rows.shape[1] == self.total
        if not (fits and x.shape[1] == control.shape[1] == time.shape[0] == rows.shape[0] == begin.shape[0] == count):
            raise ValueError("the runs do not fit the transitions")
        if not 0 <= a <= b:
            raise ValueError("the runs do not fit the transitions")
        cdef double* controls = &control[0, 0] if count and self.size > self.n else NULL
        with nogil:
            for i in range(count):  # transition after transition: blended once for all the runs that it takes further
                low = begin[i] if begin[i] > i - b + 1 else i - b + 1
                low = low if low > 0 else 0
                if low <= i - a:
                    self.take(&rows[i, 0], 1)
                    self.step(&x[0, 0], &time[0], controls, count, low, i - a + 1, step[i])

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
