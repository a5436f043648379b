# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Many transitions at once: tiles of them side by side, and the sums over a tile."""

cdef enum:
    _LANES = 8  # transitions that one sum goes over at a time: as many as registers hold
    _SORTED = 2048  # transitions of a schedule that are sorted by the blocks that hold


cdef extern from *:
    """
    /* Where the processor has registers of four numbers they are taken: the same operations, so the same bits. */
    #if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
    #define FOR_EACH_PROCESSOR __attribute__((target_clones("avx2", "default")))
    #else
    #define FOR_EACH_PROCESSOR
    #endif
    typedef double four __attribute__((vector_size(32), aligned(8), may_alias));

    /* total_q = sum_j table[j n] values[j apart + q], from the first column to the last, of 16 transitions at a time */
    FOR_EACH_PROCESSOR static void add_up(const double *table, Py_ssize_t n, Py_ssize_t columns, const double *values,
                                          Py_ssize_t apart, Py_ssize_t count, double *total) {
        for (Py_ssize_t q = 0; q < count; q += 16) {
            const four *value = (const four *)(values + q);
            four a = table[0] * value[0], b = table[0] * value[1], c = table[0] * value[2], d = table[0] * value[3];
            for (Py_ssize_t j = 1; j < columns; j++) {
                const double element = table[j * n];
                value = (const four *)(values + j * apart + q);
                a += element * value[0];
                b += element * value[1];
                c += element * value[2];
                d += element * value[3];
            }
            four *into = (four *)(total + q);
            into[0] = a, into[1] = b, into[2] = c, into[3] = d;
        }
    }

    /* the same of tables that are blended, sum_c tables[places_c][j n] weights[c apart + q], of 8 at a time */
    FOR_EACH_PROCESSOR static void add_up_blended(
        const double *tables, Py_ssize_t size, const Py_ssize_t *places, Py_ssize_t corners, const double *weights,
        Py_ssize_t n, Py_ssize_t columns, const double *values, Py_ssize_t apart, Py_ssize_t count, double *total
    ) {
        for (Py_ssize_t q = 0; q < count; q += 8) {
            four a = {0.0, 0.0, 0.0, 0.0}, b = a;
            for (Py_ssize_t j = 0; j < columns; j++) {
                const double *element = tables + j * n;
                const four *weight = (const four *)(weights + q), *value = (const four *)(values + j * apart + q);
                four low = element[places[0] * size] * weight[0], high = element[places[0] * size] * weight[1];
                for (Py_ssize_t c = 1; c < corners; c++) {
                    weight = (const four *)(weights + c * apart + q);
                    low += element[places[c] * size] * weight[0];
                    high += element[places[c] * size] * weight[1];
                }
                a = j ? a + low * value[0] : low * value[0];
                b = j ? b + high * value[1] : high * value[1];
            }
            four *into = (four *)(total + q);
            into[0] = a, into[1] = b;
        }
    }

    /* sum_q a_q b_q in eight lanes, and then these from the first to the last */
    FOR_EACH_PROCESSOR static double dot(const double *a, const double *b, Py_ssize_t count) {
        four low = {0.0, 0.0, 0.0, 0.0}, high = low;
        for (Py_ssize_t q = 0; q < count; q += 8) {
            const four *left = (const four *)(a + q), *right = (const four *)(b + q);
            low += left[0] * right[0];
            high += left[1] * right[1];
        }
        double total = 0.0;
        for (int l = 0; l < 4; l++) total += low[l];
        for (int l = 0; l < 4; l++) total += high[l];
        return total;
    }
    """
    void add_up(
        const double* table, Py_ssize_t n, Py_ssize_t columns, const double* values, Py_ssize_t apart, Py_ssize_t count,
        double* total
    ) noexcept nogil
    void add_up_blended(
        const double* tables, Py_ssize_t size, const Py_ssize_t* places, Py_ssize_t corners, const double* weights,
        Py_ssize_t n, Py_ssize_t columns, const double* values, Py_ssize_t apart, Py_ssize_t count, double* total
    ) noexcept nogil
    double dot(const double* a, const double* b, Py_ssize_t count) noexcept nogil


@cython.final
cdef class Tiles:
    """Transitions in columns, walked in tiles: at most _TOGETHER side by side, at which the same blocks hold.

    `z` (p, K): [x; u]; `dt` (K,): s; `base` (n, K): what the rates are added to, default the states; `after` (n, K):
    next states, default none; `blocks`, `s` (axes, K): schedule and scheduling vectors. Past the last transition a tile
    is filled with zeros, and with ones the regressors beyond z.
    """

    cdef const double[:, :] z, base, after, s
    cdef const double[:] dt
    cdef Blocks blocks
    cdef Py_ssize_t n, p, count, corners
    cdef Py_ssize_t at, sorted, gone  # next transition to look at; of those sorted: how many, and how many were taken
    cdef Py_ssize_t ahead  # z, dt and s are of the transition so many later
    cdef list _keep
    cdef Py_ssize_t* order  # (_SORTED,): transitions, those of the same blocks side by side
    cdef Py_ssize_t* first  # (_SORTED,): the first block that holds, of each transition
    cdef Py_ssize_t* held  # (_SORTED, _CORNERS): all of them
    cdef Py_ssize_t* found  # (_SORTED,): what `Blocks.find` says
    cdef Py_ssize_t* ends  # (blocks + 2,)
    cdef double* shares  # (_SORTED, _CORNERS): their weights
    # of this tile:
    cdef Py_ssize_t many, whole  # transitions, and with what it is filled up
    cdef Py_ssize_t* index  # (_TOGETHER,): positions of its transitions
    cdef Py_ssize_t* regimes  # (_TOGETHER,): what `Blocks.find` says of them
    cdef Py_ssize_t places[_CORNERS]
    cdef double* weights  # (_CORNERS, _TOGETHER)
    cdef double* phi  # (columns, _TOGETHER): z, then 1
    cdef double* step  # (_TOGETHER,)
    cdef double* start  # (n, _TOGETHER)
    cdef double* end  # (n, _TOGETHER)
    cdef double* ones  # (_TOGETHER,)
    cdef double* still  # (_TOGETHER,): what dt does not multiply

    def __init__(self, Py_ssize_t n, Py_ssize_t columns, z, dt, base=None, after=None, Blocks blocks=None, s=None):
        self.z, self.dt, self.base = z, dt, z[:n] if base is None else base
        self.after, self.s = z[:0] if after is None else after, z[:0] if s is None else s
        self.blocks = Blocks() if blocks is None else blocks
        self.n, self.p, self.count = n, self.z.shape[0], self.dt.shape[0]
        self.corners = self.blocks.corners
        fits = self.p <= columns and self.z.shape[1] == self.base.shape[1] == self.count and self.base.shape[0] == n
        if not fits or (after is not None and not (self.after.shape[0] == n and self.after.shape[1] == self.count)):
            raise ValueError("the samples do not fit the terms")
        if self.corners and not (self.s.shape[0] == self.blocks.axes and self.s.shape[1] == self.count):
            raise ValueError("the scheduling vectors do not fit the samples")
        cdef arrays.array numbers = doubles(
            np.ones((columns + 2 * n + _CORNERS + 3) * _TOGETHER + (_SORTED * _CORNERS if self.corners else 0))
        )
        cdef Py_ssize_t places = (_SORTED * (3 + _CORNERS) if self.corners else 0) + self.blocks.count + 2
        cdef arrays.array positions = array("q", bytes(8 * (2 * _TOGETHER + places)))
        self._keep = [numbers, positions]
        self.phi = numbers.data.as_doubles
        self.step = self.phi + columns * _TOGETHER
        self.start = self.step + _TOGETHER
        self.end = self.start + n * _TOGETHER
        self.weights = self.end + n * _TOGETHER
        self.ones = self.weights + _CORNERS * _TOGETHER
        self.still, self.shares = self.ones + _TOGETHER, self.ones + 2 * _TOGETHER
        self.index = <Py_ssize_t*>positions.data.as_longlongs
        self.regimes, self.ends = self.index + _TOGETHER, self.index + 2 * _TOGETHER
        self.order = self.ends + self.blocks.count + 2
        self.first, self.found, self.held = self.order + _SORTED, self.order + 2 * _SORTED, self.order + 3 * _SORTED

    cdef void begin(self, Py_ssize_t first, Py_ssize_t end, Py_ssize_t ahead) noexcept nogil:
        """Walk the transitions first to end - 1, with z, dt and s of those so many later."""
        self.count, self.at, self.sorted, self.gone, self.ahead = end, first, 0, 0, ahead

    cdef bint take(self) noexcept nogil:
        """Fill in the next tile; False at the end."""
        cdef Py_ssize_t i, k, q, a
        if not self.corners:
            self.many = self.count - self.at if self.count - self.at < _TOGETHER else _TOGETHER
            for q in range(self.many):
                self.index[q] = self.at + q
            self.at += self.many
        else:
            if self.gone == self.sorted:
                self.sort()
            a, self.many = self.gone, 0
            while self.many < _TOGETHER and self.gone < self.sorted and (
                self.first[self.order[self.gone]] == self.first[self.order[a]]
            ):
                self.gone += 1
                self.many += 1
            for q in range(self.many):
                k = self.order[a + q]
                self.index[q], self.regimes[q] = self.at - self.sorted + k, self.found[k]
                for i in range(self.corners):
                    self.places[i] = self.held[k * _CORNERS + i]
                    self.weights[i * _TOGETHER + q] = self.shares[k * _CORNERS + i]
        if not self.many:
            return False
        self.whole = (self.many + _LANES - 1) // _LANES * _LANES
        self.gather(self.z, self.p, self.ahead, self.phi)
        self.gather(self.base, self.n, 0, self.start)
        self.gather(self.after, self.after.shape[0], 0, self.end)
        for q in range(self.many):
            self.step[q] = self.dt[self.index[q] + self.ahead]
        for q in range(self.many, self.whole):
            self.step[q] = 0.0
            for i in range(self.corners):
                self.weights[i * _TOGETHER + q] = 0.0
        return True

    cdef void sort(self) noexcept nogil:
        """Find the blocks that hold at the next transitions, and sort them by the first: it tells the others."""
        cdef Py_ssize_t k, axis, r, count = self.blocks.count
        cdef double here[2]
        self.sorted = self.count - self.at if self.count - self.at < _SORTED else _SORTED
        self.gone = 0
        for r in range(count + 2):
            self.ends[r] = 0
        for k in range(self.sorted):
            for axis in range(self.blocks.axes):
                here[axis] = self.s[axis, self.at + self.ahead + k]
            self.found[k] = self.blocks.find(here, self.held + k * _CORNERS, self.shares + k * _CORNERS)
            if self.found[k] < 0:
                for r in range(self.corners):  # a mode that is not listed: nothing is known
                    self.held[k * _CORNERS + r], self.shares[k * _CORNERS + r] = 0, NAN
                self.first[k] = count
            else:
                self.first[k] = self.held[k * _CORNERS]
            self.ends[self.first[k] + 1] += 1
        for r in range(count + 1):
            self.ends[r + 1] += self.ends[r]
        for k in range(self.sorted):
            self.order[self.ends[self.first[k]]] = k
            self.ends[self.first[k]] += 1
        self.at += self.sorted

    cdef void gather(self, const double[:, :] rows, Py_ssize_t count, Py_ssize_t ahead, double* to) noexcept nogil:
        """Some rows of the transitions of this tile, or of those so many later."""
        cdef Py_ssize_t i, q, first = self.index[0] + ahead
        cdef double* into
        for i in range(count):
            into = to + i * _TOGETHER
            if not self.corners and rows.strides[1] == sizeof(double):
                memcpy(into, &rows[i, first], self.many * sizeof(double))
            else:
                for q in range(self.many):
                    into[q] = rows[i, self.index[q] + ahead]
            for q in range(self.many, self.whole):
                into[q] = 0.0

    cdef void put(self, const double* values, double[:, ::1] rows) noexcept nogil:
        """Put rows of this tile where its transitions are."""
        cdef Py_ssize_t i, q
        for i in range(rows.shape[0]):
            if not self.corners:
                memcpy(&rows[i, self.index[0]], values + i * _TOGETHER, self.many * sizeof(double))
                continue
            for q in range(self.many):
                rows[i, self.index[q]] = values[i * _TOGETHER + q]

    cdef void sum(
        self, const double* table, Py_ssize_t i, Py_ssize_t n, Py_ssize_t columns, const double* values, double* total
    ) noexcept nogil:
        """total (_TOGETHER,) = row i of `add_columns` of each transition; table: (blocks, columns, n), blended."""
        if self.corners:
            add_up_blended(
                table + i, n * columns, self.places, self.corners, self.weights, n, columns, values, _TOGETHER,
                self.many, total,
            )
        else:
            add_up(table + i, n, columns, values, _TOGETHER, self.many, total)

    cdef void bounds(
        self, Elements elements, Py_ssize_t i, const double* psi, double* centre, double* half
    ) noexcept nogil:
        """Centre and half-width (_TOGETHER,) of a state at each transition; psi: |phi|."""
        cdef Py_ssize_t q, n = self.n
        cdef double still = elements.v[i]
        cdef const double* step = self.step
        self.centres(elements, i, centre)
        self.sum(elements.delta, i, n, elements.p, psi, half)
        if not self.corners:
            for q in range(self.whole):
                half[q] = half_of(step[q], half[q], still)
            return
        self.sum(elements.v, i, n, 1, self.ones, self.still)
        for q in range(self.whole):
            half[q] = half_of(step[q], half[q], self.still[q])

    cdef void centres(self, Elements elements, Py_ssize_t i, double* centre) noexcept nogil:
        """Centre (_TOGETHER,) of the bounds of a state at each transition."""
        cdef Py_ssize_t q
        cdef const double* start = self.start + i * _TOGETHER
        self.sum(elements.theta, i, self.n, elements.p, self.phi, centre)
        for q in range(self.whole):
            centre[q] = centre_of(start[q], self.step[q], centre[q])

    cdef void sizes(self, Py_ssize_t columns, double* psi) noexcept nogil:
        """psi (columns, _TOGETHER) = |phi|."""
        cdef Py_ssize_t j, q
        for j in range(columns):
            for q in range(self.many):
                psi[j * _TOGETHER + q] = fabs(self.phi[j * _TOGETHER + q])


cdef double greatest_of(const double* a, Py_ssize_t count) noexcept nogil:
    """The greatest number of a tile, 0 at least."""
    cdef double lane[_LANES]
    cdef double most = 0.0
    cdef Py_ssize_t l, q
    for l in range(_LANES):
        lane[l] = 0.0
    for q from 0 <= q < count by _LANES:
        for l in range(_LANES):
            lane[l] = a[q + l] if a[q + l] > lane[l] else lane[l]
    for l in range(_LANES):
        most = lane[l] if lane[l] > most else most
    return most


cdef double* room_for(Py_ssize_t rows) except NULL:
    """So many rows of a tile, all 0."""
    cdef double* room = <double*>calloc(rows * _TOGETHER or 1, sizeof(double))
    if room == NULL:
        raise MemoryError
    return room
