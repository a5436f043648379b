# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Elements of a model in the layout that the sums walk, and the blocks of a schedule that hold at a sample."""

cdef enum:
    _TOGETHER = 112  # samples whose sums are taken side by side: they stay in the cache, as columns a power of two apart do not
    _CORNERS = 4  # blocks that hold at a time, at most

cdef array_of_doubles = array("d")


cdef arrays.array doubles(values):
    """A copy of some numbers, with the address for C."""
    return array("d", np.ascontiguousarray(values, dtype=np.float64).tobytes())


@cython.final
cdef class Blocks:
    """The blocks of a schedule: which of them hold at a scheduling vector, with what weights.

    `axes`: of `model.schedule.Schedule`; `count`: blocks; `corners`: of them hold at a time, 0 without a schedule; `known` (R,): blocks that a recording
    visited, default all.
    """

    cdef readonly Py_ssize_t count, corners
    cdef Py_ssize_t axes
    cdef list _keep
    cdef const double* values
    cdef Py_ssize_t begin[3]
    cdef bint of_modes[2]
    cdef bytearray _known
    cdef unsigned char* known

    def __init__(self, axes=(), known=None):
        cdef arrays.array values = doubles([value for axis in axes for value in axis.values])
        cdef Py_ssize_t i
        if len(axes) > 2:
            raise ValueError("a schedule has two signals at most")
        self._keep, self.values, self.axes = [values, tuple(axes)], values.data.as_doubles, len(axes)
        self.count, self.corners = 1, 1 if axes else 0
        self.begin[0] = 0
        for i, axis in enumerate(axes):
            self.begin[i + 1] = self.begin[i] + len(axis)
            self.of_modes[i] = bool(axis.modes)
            self.count *= len(axis)
            self.corners *= 1 if axis.modes else 2
        known = np.ones(self.count, dtype=bool) if known is None else np.asarray(known, dtype=bool)
        if known.shape != (self.count,):
            raise ValueError("the terms do not fit one another")
        self._known = bytearray(known.tobytes())
        self.known = self._known

    def __reduce__(self):
        return Blocks, (self._keep[1], np.frombuffer(self._known, dtype=bool))

    cdef int find(self, const double* s, Py_ssize_t* places, double* weights) noexcept nogil:
        """Fill in the blocks that hold: -1 for no mode that is listed or NaN, 1 for an unknown regime, else 0."""
        cdef Py_ssize_t axis, corner, j, size, first, corners = 1
        cdef double high
        cdef int unknown = 0
        places[0] = 0
        weights[0] = 1.0
        for axis in range(self.axes):
            if s[axis] != s[axis]:
                return -1
            first = self.begin[axis]
            size = self.begin[axis + 1] - first
            j = 0
            if self.of_modes[axis]:
                while j < size and self.values[first + j] != s[axis]:
                    j += 1
                if j == size:
                    return -1
                for corner in range(corners):
                    places[corner] = places[corner] * size + j
                continue
            if is_outside(s[axis], self.values[first], self.values[first + size - 1]):
                unknown = 1
            while j < size - 2 and self.values[first + j + 1] <= s[axis]:
                j += 1
            high = weight_between(s[axis], self.values[first + j], self.values[first + j + 1])
            for corner in range(corners - 1, -1, -1):  # from the back: two take the place of one
                places[2 * corner + 1] = places[corner] * size + j + 1
                weights[2 * corner + 1] = weights[corner] * high
                places[2 * corner] = places[corner] * size + j
                weights[2 * corner] = weights[corner] * (1.0 - high)
            corners *= 2
        for corner in range(corners):
            if weights[corner] > 0.0 and not self.known[places[corner]]:
                unknown = 1
        return unknown

    def at(self, s):
        """Blocks that hold at scheduling vectors s (axes, K): places (C, K), -1 for none; weights (C, K), NaN there."""
        cdef const double[:, :] vectors = np.asarray(s, dtype=np.float64)
        cdef Py_ssize_t k, r, axis, count = vectors.shape[1]
        if vectors.shape[0] != self.axes:
            raise ValueError("the schedule does not fit the signals")
        found = np.empty((self.corners, count), dtype=np.intp), np.empty((self.corners, count))
        cdef Py_ssize_t[:, ::1] places = found[0]
        cdef double[:, ::1] weights = found[1]
        cdef double here[2]
        cdef Py_ssize_t place[_CORNERS]
        cdef double weight[_CORNERS]
        cdef int regime
        with nogil:
            for k in range(count):
                for axis in range(self.axes):
                    here[axis] = vectors[axis, k]
                regime = self.find(here, place, weight)
                for r in range(self.corners):
                    places[r, k] = place[r] if regime >= 0 else -1
                    weights[r, k] = weight[r] if regime >= 0 else NAN
        return found


def blended(blocks, places, weights):
    """Elements of a scheduled model at K samples, Σ_r w_r θ_r: blocks (R, ...), places and weights (C, K) of `at`."""
    lead = np.shape(blocks)[1:]
    cdef arrays.array table = doubles(blocks)
    cdef const Py_ssize_t[:, :] of_blocks = places
    cdef const double[:, :] by = weights
    cdef Py_ssize_t i, k, r, size = np.prod(lead, dtype=np.intp), count = by.shape[1], corners = by.shape[0]
    found = np.full((size, count), np.nan)
    cdef double[:, ::1] total = found
    cdef const double* elements = table.data.as_doubles
    cdef double value
    with nogil:
        for k in range(count):
            if of_blocks[0, k] < 0:
                continue
            for i in range(size):
                value = elements[of_blocks[0, k] * size + i] * by[0, k]
                for r in range(1, corners):
                    value += elements[of_blocks[r, k] * size + i] * by[r, k]
                total[i, k] = value
    return found.reshape(*lead, count)


@cython.final
cdef class Elements:
    """Elements of one model, or of one of its horizons, and the sums of one sample.

    `theta, delta` (n, p) or (R, n, p): nominal elements and half-widths of the rates, 1/s; `v` (n,) or (R, n):
    half-width that dt does not multiply.
    """

    cdef readonly Py_ssize_t n, p
    cdef list _keep
    cdef const double* theta  # block after block, column after column
    cdef const double* delta
    cdef const double* v
    cdef double* rate  # of the last sample, as the two below
    cdef double* spread
    cdef double* still  # what dt does not multiply
    cdef double* nominal  # theta where it was asked for
    cdef double* psi

    def __init__(self, theta, delta, v):
        *_, self.n, self.p = theta.shape
        cdef Py_ssize_t n = self.n, p = self.p
        cdef arrays.array one = doubles(np.swapaxes(theta, -1, -2)), other = doubles(np.swapaxes(delta, -1, -2))
        cdef arrays.array third = doubles(v), room = doubles(np.zeros(3 * n + p + n * p))
        self._keep = [one, other, third, room]
        self.theta, self.delta, self.v = one.data.as_doubles, other.data.as_doubles, third.data.as_doubles
        self.rate = room.data.as_doubles
        self.spread, self.still, self.psi = self.rate + n, self.rate + 2 * n, self.rate + 3 * n
        self.nominal = self.psi + p

    cdef void sum(
        self, const double* phi, const Py_ssize_t* places, const double* weights, Py_ssize_t corners
    ) noexcept nogil:
        """`rate`, `spread` and `still` of regressors, with the blocks in their places by their weights."""
        cdef Py_ssize_t j, n = self.n, p = self.p
        for j in range(p):
            self.psi[j] = fabs(phi[j])
        if corners == 0:
            add_columns(self.theta, phi, n, p, self.rate)
            add_columns(self.delta, self.psi, n, p, self.spread)
            for j in range(n):
                self.still[j] = self.v[j]
            return
        blend(self.theta, n * p, n * p, places, weights, corners, self.nominal)
        add_columns(self.nominal, phi, n, p, self.rate)
        blend(self.delta, n * p, n * p, places, weights, corners, self.nominal)
        add_columns(self.nominal, self.psi, n, p, self.spread)
        blend(self.v, n, n, places, weights, corners, self.still)

    cdef const double* nominal_at(
        self, const Py_ssize_t* places, const double* weights, Py_ssize_t corners
    ) noexcept nogil:
        """Nominal elements (p, n) with the blocks in their places by their weights."""
        if corners == 0:
            return self.theta
        blend(self.theta, self.n * self.p, self.n * self.p, places, weights, corners, self.nominal)
        return self.nominal
