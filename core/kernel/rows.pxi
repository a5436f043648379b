# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Many samples at once: loops of the equations over arrays, without the interpreter's lock."""


def centre_and_half(tables, z, dt, centre, half, Blocks blocks=None, s=None, base=None):
    """Centre and half-width of the bounds of K samples in columns, into given arrays.

    `tables`: theta, delta (n, p) and v (n,), with a leading axis of the blocks of a schedule; `z` (n + m, K):
    regressors, the states first, 1 beyond them; `dt` (K,): s; `centre, half` (n, K): take the result, NaN for a mode
    that is not listed; `s` (axes, K): scheduling vectors; `base` (n, K): what the rates are added to, default the
    states.
    """
    cdef Elements elements = Elements(*tables)
    cdef Tiles tiles = Tiles(elements.n, elements.p, z, dt, base, None, blocks, s)
    cdef double[:, :] middle = centre
    cdef double[:, :] width = half
    cdef Py_ssize_t i, q
    if not centre.shape == half.shape == (elements.n, tiles.count):
        raise ValueError("the samples do not fit the terms")
    cdef double* psi = room_for(elements.p + 2)
    cdef double* one = psi + elements.p * _TOGETHER
    with nogil:
        while tiles.take():
            tiles.sizes(elements.p, psi)
            for i in range(elements.n):
                tiles.bounds(elements, i, psi, one, one + _TOGETHER)
                for q in range(tiles.many):
                    middle[i, tiles.index[q]], width[i, tiles.index[q]] = one[q], one[_TOGETHER + q]
    free(psi)


def edges(centre, half, double margin):
    """Lower and upper bounds, eqs. (6)(7) with a margin, of arrays of one shape."""
    cdef const double[::1] middle = np.ascontiguousarray(centre).reshape(-1)
    cdef const double[::1] width = np.ascontiguousarray(half).reshape(-1)
    found = np.empty((2, *np.shape(centre)))
    cdef double[:, ::1] both = found.reshape(2, -1)
    cdef Py_ssize_t k
    with nogil:
        for k in range(width.shape[0]):
            both[0, k], both[1, k] = lower_of(middle[k], width[k], margin), upper_of(middle[k], width[k], margin)
    return found[0], found[1]


def utilisations(difference, half):
    """`utilisation_of` of arrays of one shape."""
    cdef const double[::1] one = np.ascontiguousarray(difference).reshape(-1)
    cdef const double[::1] other = np.ascontiguousarray(half).reshape(-1)
    found = np.empty(np.shape(difference))
    cdef double[::1] values = found.reshape(-1)
    cdef Py_ssize_t k
    with nogil:
        for k in range(other.shape[0]):
            values[k] = utilisation_of(one[k], other[k])
    return found


def settled(utilisation, inside):
    """`settled_of` of arrays of one shape."""
    cdef const double[::1] one = np.ascontiguousarray(utilisation, dtype=np.float64).reshape(-1)
    cdef const unsigned char[::1] within = np.ascontiguousarray(inside).view(np.uint8).reshape(-1)
    found = np.empty(np.shape(utilisation))
    cdef double[::1] values = found.reshape(-1)
    cdef Py_ssize_t k
    with nogil:
        for k in range(within.shape[0]):
            values[k] = settled_of(one[k], within[k])
    return found


def arrivals(x, centre, half):
    """x - centre and where in the bounds that is, of a size of at most 1 exactly where contained; one shape (n, K)."""
    cdef const double[:, :] there = x
    cdef const double[:, :] middle = centre
    cdef const double[:, :] width = half
    found = np.empty((2, *x.shape))
    cdef double[:, :, ::1] both = found
    cdef Py_ssize_t i, k
    cdef double left
    cdef bint inside
    if not x.shape == centre.shape == half.shape:
        raise ValueError("the samples do not fit the bounds")
    with nogil:
        for i in range(there.shape[0]):
            for k in range(there.shape[1]):
                left = there[i, k] - middle[i, k]
                inside = is_contained(
                    lower_of(middle[i, k], width[i, k], 1.0), there[i, k], upper_of(middle[i, k], width[i, k], 1.0)
                )
                both[0, i, k], both[1, i, k] = left, settled_of(utilisation_of(left, width[i, k]), inside)
    return found[0], found[1]


def all_carried(values):
    """Whether the arithmetic carries all of some recorded numbers."""
    cdef double value
    for value in values:
        if not is_carried(value):
            return False
    return True


def pair_count(Py_ssize_t size):
    """Pairs of signals whose combinations a domain knows, in the order 01, 02, 12, ...; of one signal alone, itself."""
    return size * (size - 1) // 2 if size > 1 else 1


BEYOND = 0.1
"""Share of the fitted range of a signal beyond it from which on a sample is outside of what was fitted."""
cdef double _SLACK = BEYOND
cdef double _SAME = 1e-12  # of two numbers that rounding tells apart


def cells_per_unit(least, greatest, Py_ssize_t cells):
    """Cells per normalised unit of each signal, what `cell_of` takes; 0 where it does not move."""
    span = np.subtract(greatest, least)
    return np.divide(cells, span, out=np.zeros_like(span), where=(span > 0) & np.isfinite(span))


cdef void left_domain(
    const double* z,
    Py_ssize_t stride,
    Py_ssize_t count,
    const double* least,
    const double* greatest,
    const double* per_unit,
    const unsigned char* occupied,
    Py_ssize_t size,
    Py_ssize_t cells,
    int* cell,
    double share,
    unsigned char* out,
) noexcept nogil:
    """Whether each [x; u], in columns a stride wide, is beyond a range by a share of it, or a combination not fitted.

    `occupied`: of `domain.Occupancy`, with so many cells, 0 for none; `cell` (size, _TOGETHER): room.
    """
    cdef Py_ssize_t i, j, q, low, many
    cdef double slack
    cdef int* first
    cdef int* second
    cdef const unsigned char* pair
    for q in range(count):
        out[q] = 0
    for i in range(size):
        slack = share * (greatest[i] - least[i]) + _SAME * fmax(fabs(least[i]), fabs(greatest[i]))
        for q in range(count):
            out[q] |= is_outside(z[i * stride + q], least[i] - slack, greatest[i] + slack)
    for low from 0 <= low < (count if cells else 0) by _TOGETHER:
        many = count - low if count - low < _TOGETHER else _TOGETHER
        for i in range(size):
            for q in range(many):
                cell[i * _TOGETHER + q] = cell_of(z[i * stride + low + q], least[i], per_unit[i], <int>cells - 1)
        pair = occupied
        for i in range(size):
            first = cell + i * _TOGETHER
            for j in range(i + 1 if size > 1 else i, size):
                second = cell + j * _TOGETHER
                for q in range(many):
                    out[low + q] |= not pair[first[q] * cells + second[q]]
                pair += cells * cells


def outside_domain(z, least, greatest, occupied=None, double share=BEYOND):
    """Whether each of z (n + m, K) is beyond a range by more than a share of it, or is a combination not fitted."""
    cdef const double[:, ::1] columns = np.ascontiguousarray(z)
    cdef arrays.array low = doubles(least), high = doubles(greatest)
    cdef Py_ssize_t size = columns.shape[0], count = columns.shape[1]
    cdef Py_ssize_t cells = 0 if occupied is None else occupied.shape[1]
    cdef arrays.array per_unit = doubles(cells_per_unit(np.asarray(least), np.asarray(greatest), cells))
    cdef const unsigned char[::1] flags = np.ascontiguousarray(
        np.zeros(1, np.uint8) if occupied is None else occupied
    ).view(np.uint8).reshape(-1)
    cdef arrays.array cell = array("i", bytes(4 * (size or 1) * _TOGETHER))
    found = np.zeros(count, dtype=bool)
    cdef unsigned char[::1] left = found.view(np.uint8)
    if len(least) != size or len(greatest) != size:
        raise ValueError("the domain does not fit the samples")
    if count and size:
        with nogil:
            left_domain(
                &columns[0, 0], count, count, low.data.as_doubles, high.data.as_doubles, per_unit.data.as_doubles,
                &flags[0], size, cells, cell.data.as_ints, share, &left[0],
            )
    return found


def occupy(z, least, greatest, occupied):
    """Mark in `occupied` (pairs, cells, cells) the cells of every pair of signals that z (n + m, K) lies in."""
    cdef const double[:, :] columns = z
    cdef unsigned char[:, :, ::1] flags = occupied.view(np.uint8)
    cdef Py_ssize_t i, j, k, pair, size = columns.shape[0]
    cdef int last = occupied.shape[1] - 1
    cdef arrays.array low = doubles(least), per_unit = doubles(cells_per_unit(least, greatest, occupied.shape[1]))
    cdef arrays.array place = array("i", bytes(4 * size))
    cdef int* at = place.data.as_ints
    with nogil:
        for k in range(columns.shape[1]):
            for i in range(size):
                at[i] = cell_of(columns[i, k], low.data.as_doubles[i], per_unit.data.as_doubles[i], last)
            if size == 1:
                flags[0, at[0], at[0]] = 1
            pair = 0
            for i in range(size):
                for j in range(i + 1, size):
                    flags[pair, at[i], at[j]] = 1
                    pair += 1

