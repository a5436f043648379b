# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Passes of a fit over transitions in columns: sums, the transitions near their bounds, and the verdict on all.

Each is of one piece of the data. A transition is given as z (p, K), dt (K,), after and base (n, K), the blocks of a
schedule and the scheduling vectors s (axes, K), as of `Tiles`. Of the regressors psi of the half-widths, those beyond
|z| are 1, or 1 / dt if dt does not multiply the term.
"""


cdef double _ALIKE = 1e-11  # slack by which equal widths differ: where noise alone makes them, all are the widest


cdef void add_products(
    const double* a, Py_ssize_t rows, const double* b, Py_ssize_t columns, const double* factor, Tiles tiles,
    double* room, double[:, ::1] total,
) noexcept nogil:
    """Add the products a bᵀ of the rows of a tile to `total` (R rows, columns), those of a to the blocks that hold.

    b: NULL for those of a with themselves, of which the upper triangle is filled in; factor: on each transition, or
    NULL; room: for as many rows as a has at all corners, and one.
    """
    cdef Py_ssize_t c, d, i, j, q, corners = tiles.corners or 1, whole = tiles.whole
    cdef double* weighted = room + corners * rows * _TOGETHER
    cdef const double* left
    if tiles.corners:
        for c in range(corners):
            for i in range(rows):
                for q in range(whole):
                    room[(c * rows + i) * _TOGETHER + q] = a[i * _TOGETHER + q] * tiles.weights[c * _TOGETHER + q]
        a = room
    for c in range(corners):
        for i in range(rows):
            left = a + (c * rows + i) * _TOGETHER
            if factor != NULL:
                for q in range(whole):
                    weighted[q] = left[q] * factor[q]
                left = weighted
            if b != NULL:
                for j in range(columns):
                    total[tiles.places[c] * rows + i, j] += dot(left, b + j * _TOGETHER, whole)
                continue
            for d in range(c, corners):
                for j in range(i if c == d else 0, rows):
                    total[tiles.places[c] * rows + i, tiles.places[d] * rows + j] += dot(
                        left, a + (d * rows + j) * _TOGETHER, whole
                    )


cdef inline Py_ssize_t main_corner(Tiles tiles, Py_ssize_t q) noexcept nogil:
    """Which of the blocks that hold at a transition has the largest weight, of two alike the first."""
    cdef Py_ssize_t c, found = 0
    for c in range(1, tiles.corners):
        if tiles.weights[c * _TOGETHER + q] > tiles.weights[found * _TOGETHER + q]:
            found = c
    return found


def mirrored(matrix):
    """A symmetric matrix from its upper triangle."""
    return matrix + np.triu(matrix, 1).T


def sums_of(Py_ssize_t n, z, dt, after, base, Blocks blocks, s, Py_ssize_t ones, times_dt, weights):
    """What `identification.passes.Moments` sums, of one piece.

    `ones`: additive terms with nominal elements; `times_dt`: of each with a half-width, whether dt multiplies it;
    `weights`: (f, K) factors. Returns Σ ψψᵀ, the same with each factor (f, q, q), Σ φφᵀ, Σ φ (x_next - x)ᵀ,
    Σ (x_next - x)² (n,), Σ ψ and of how many transitions each block is the main one; ψ and φ times Δt.
    """
    cdef Tiles tiles = Tiles(n, z.shape[0] + ones, z, dt, base, after, blocks, s)
    cdef Py_ssize_t p = tiles.p, r = tiles.p + ones, size = tiles.p + len(times_dt), count = tiles.blocks.count
    cdef Py_ssize_t f, i, j, k, q
    cdef const unsigned char[::1] by_dt = np.array([*times_dt, 0], dtype=np.uint8)
    cdef const double[:, :] by = z[:0] if weights is None else weights
    plain, centre = np.zeros((count * size, count * size)), np.zeros((count * r, count * r))
    target, square, total = np.zeros((count * r, n)), np.zeros(n), np.zeros((count * size, 1))
    grams, visits = np.zeros((by.shape[0], count * size, count * size)), np.zeros(count, dtype=np.intp)
    cdef double[:, ::1] of_psi = plain
    cdef double[:, ::1] of_phi = centre
    cdef double[:, ::1] to_moved = target
    cdef double[::1] moved_square = square
    cdef double[:, ::1] of_sizes = total
    cdef double[:, :, ::1] weighted = grams
    cdef Py_ssize_t[::1] visited = visits
    cdef double* phi = room_for(r + size + n + 1 + _CORNERS * (r + size) + 1)
    cdef double* psi = phi + r * _TOGETHER
    cdef double* moved = psi + size * _TOGETHER
    cdef double* factor = moved + n * _TOGETHER
    cdef double* room = factor + _TOGETHER
    with nogil:
        while tiles.take():
            for j in range(r):
                for q in range(tiles.whole):
                    phi[j * _TOGETHER + q] = tiles.phi[j * _TOGETHER + q] * tiles.step[q]
            for j in range(size):
                for q in range(tiles.whole):
                    k = j * _TOGETHER + q
                    psi[k] = fabs(phi[k]) if j < p else tiles.step[q] if by_dt[j - p] else q < tiles.many
            for i in range(n):
                for q in range(tiles.whole):
                    k = i * _TOGETHER + q
                    moved[k] = tiles.end[k] - tiles.start[k]
                moved_square[i] += dot(moved + i * _TOGETHER, moved + i * _TOGETHER, tiles.whole)
            add_products(psi, size, NULL, 0, NULL, tiles, room, of_psi)
            add_products(phi, r, NULL, 0, NULL, tiles, room, of_phi)
            add_products(phi, r, moved, n, NULL, tiles, room, to_moved)
            add_products(psi, size, tiles.ones, 1, NULL, tiles, room, of_sizes)
            for f in range(by.shape[0]):
                for q in range(tiles.whole):
                    factor[q] = by[f, tiles.index[q]] if q < tiles.many else 0.0
                add_products(psi, size, NULL, 0, factor, tiles, room, weighted[f])
            for q in range(tiles.many):
                visited[tiles.places[main_corner(tiles, q)]] += 1
    free(phi)
    return mirrored(plain), [mirrored(gram) for gram in grams], mirrored(centre), target, square, total[:, 0], visits


def near_bounds(
    Py_ssize_t n, z, dt, after, base, Blocks blocks, s, Py_ssize_t ones, times_dt, theta, d, unit, scale, reach, room,
    limit, rows
):
    """Transitions of less slack than the reach in a candidate's bounds, or than the room below its limit.

    `theta` (R r, k): nominal elements; `d` (R q, k): half-widths; `unit` (R q,) or (R q, k): the size of a transition is
    unit . psi; `scale` (k,): slack is counted in size x scale; `reach`, `room` (k,); `limit` (k,) or (k, K): what twice
    the width per step is held against, or None; `rows` (k,): rows of the model. Returns positions row x K + transition,
    in order, and the slack of each: half - |rate - centre|, or limit - half if that is less than the room, too.
    """
    cdef Tiles tiles = Tiles(n, z.shape[0] + ones, z, dt, base, after, blocks, s)
    cdef Py_ssize_t p = tiles.p, r = tiles.p + ones, size = tiles.p + len(times_dt), count = len(rows)
    cdef Py_ssize_t i, j, k, q, kept = 0, held = tiles.blocks.count, units = len(unit.T) if unit.ndim > 1 else 1
    cdef const unsigned char[::1] by_dt = np.array([*times_dt, 0], dtype=np.uint8)
    cdef const Py_ssize_t[::1] which = np.ascontiguousarray(rows, dtype=np.intp)
    cdef arrays.array nominal = doubles(theta), within = doubles(d), sized = doubles(unit), by = doubles(scale)
    cdef arrays.array near = doubles(reach), below = doubles(room)
    cdef bint limited = limit is not None
    cdef const double[:, :] most = np.zeros((1, 1)) if limit is None else np.reshape(limit, (count, -1))
    cdef bint each = limited and most.shape[1] > 1
    cdef double slack, of_size, narrower, free_of
    if not (len(nominal) >= held * r * count and len(within) >= held * size * count) or units not in (1, count) or (
        len(sized) != held * size * units or not len(by) == len(near) == len(below) == count
    ):
        raise ValueError("the candidate does not fit the terms")
    found, slacks = np.empty(count * tiles.count, dtype=np.intp), np.empty(count * tiles.count)
    cdef Py_ssize_t[::1] position = found
    cdef double[::1] least = slacks
    cdef double* psi = room_for(size + 4)
    cdef double* left = psi + size * _TOGETHER
    cdef double* half = left + _TOGETHER
    cdef double* large = half + _TOGETHER
    cdef double* beyond = large + _TOGETHER
    cdef const double* step = tiles.step
    cdef const double* start
    cdef const double* end
    with nogil:
        while tiles.take():
            tiles.sizes(p, psi)
            for j in range(p, size):
                for q in range(tiles.many):
                    psi[j * _TOGETHER + q] = 1.0 if by_dt[j - p] else 1.0 / step[q]
            for i in range(count):
                start, end = tiles.start + which[i] * _TOGETHER, tiles.end + which[i] * _TOGETHER
                tiles.sum(nominal.data.as_doubles, i, count, r, tiles.phi, left)
                tiles.sum(within.data.as_doubles, i, count, size, psi, half)
                if i == 0 or units > 1:
                    tiles.sum(sized.data.as_doubles, i, units, size, psi, large)
                narrower = near.data.as_doubles[i] * by.data.as_doubles[i]
                for q in range(tiles.whole):
                    left[q] = fabs(left[q] * step[q] - (end[q] - start[q]))
                for q in range(tiles.whole):  # of more arrays at once a compiler makes no vectors
                    beyond[q] = left[q] - (half[q] - narrower * large[q]) * step[q]
                if limited:
                    free_of = fmin(near.data.as_doubles[i], below.data.as_doubles[i]) * by.data.as_doubles[i]
                    for q in range(tiles.many):
                        if 2.0 * (half[q] + free_of * large[q]) * step[q] > most[i, tiles.index[q] if each else 0]:
                            beyond[q] = 1.0
                if greatest_of(beyond, tiles.many) > 0.0:
                    for q in range(tiles.many):
                        if beyond[q] > 0.0:
                            # at rest without an additive term nothing but rest is contained
                            of_size = (large[q] if large[q] != 0.0 else 1.0) * by.data.as_doubles[i]
                            slack = (half[q] - left[q] / step[q]) / of_size
                            if limited:
                                free_of = (most[i, tiles.index[q] if each else 0] / (2.0 * step[q]) - half[q]) / of_size
                                if free_of < below.data.as_doubles[i] - _ALIKE and free_of < slack:
                                    slack = free_of
                            position[kept] = i * tiles.count + tiles.index[q]
                            least[kept] = slack
                            kept += 1
    free(psi)
    order = np.argsort(found[:kept])
    return found[order], slacks[order]


def verdicts(tables, z, dt, after, base, Blocks blocks, s, roots):
    """The verdict on all transitions, by the arithmetic of every other verdict.

    `tables`: as of `centre_and_half`; `roots` (n, K) or (n, 1): √w. Returns of each state the transitions outside, the
    largest width and the largest √w x width; Σ of the utilisation (n,), its products (n, n); and of each block of a schedule the sum and the largest of the widths where it is the main one (R, n).
    """
    cdef Elements elements = Elements(*tables)
    cdef Tiles tiles = Tiles(elements.n, elements.p, z, dt, base, after, blocks, s)
    cdef Py_ssize_t i, j, k, q, c, n = elements.n
    cdef const double[:, :] root = roots
    cdef bint each = roots.shape[1] > 1
    outside, largest = np.zeros(n, dtype=np.intp), np.zeros((2, n))
    total, products = np.zeros(n), np.zeros((n, n))
    widths = np.zeros((2, tiles.blocks.count, n))
    cdef Py_ssize_t[::1] left_out = outside
    cdef double[:, ::1] most = largest
    cdef double[::1] sum_of = total
    cdef double[:, ::1] product_of = products
    cdef double[:, :, ::1] of_block = widths
    cdef double* psi = room_for(elements.p + 2 + n)
    cdef double* centre = psi + elements.p * _TOGETHER
    cdef double* half = centre + _TOGETHER
    cdef double* values = half + _TOGETHER  # utilisations
    cdef double* utilised
    cdef const double* end
    cdef double width, weighted
    if not (root.shape[0] == n and root.shape[1] in (1, tiles.count)):
        raise ValueError("the weights do not fit the transitions")
    with nogil:
        while tiles.take():
            tiles.sizes(elements.p, psi)
            for i in range(n):  # what a tile is filled up with is at its centre, of the least width
                tiles.bounds(elements, i, psi, centre, half)
                end, k = tiles.end + i * _TOGETHER, 0
                for q in range(tiles.many):
                    k += not is_contained(lower_of(centre[q], half[q], 1.0), end[q], upper_of(centre[q], half[q], 1.0))
                left_out[i] += k
                width, weighted = 2.0 * greatest_of(half, tiles.whole), 0.0
                most[0, i] = width if width > most[0, i] else most[0, i]
                if each:
                    for q in range(tiles.many):
                        width = 2.0 * (half[q] * root[i, tiles.index[q]])
                        weighted = width if width > weighted else weighted
                    most[1, i] = weighted if weighted > most[1, i] else most[1, i]
                utilised = values + i * _TOGETHER
                for q in range(tiles.whole):
                    utilised[q] = utilisation_of(end[q] - centre[q], half[q])
                sum_of[i] += dot(utilised, tiles.ones, tiles.whole)
                for q in range(tiles.many if tiles.corners else 0):
                    c = tiles.places[main_corner(tiles, q)]
                    width = 2.0 * half[q]
                    of_block[0, c, i] += width
                    of_block[1, c, i] = width if width > of_block[1, c, i] else of_block[1, c, i]
            for i in range(n):
                for j in range(i, n):
                    product_of[i, j] += dot(values + i * _TOGETHER, values + j * _TOGETHER, tiles.whole)
    free(psi)
    if not each:
        largest[1] = largest[0] * roots[:, 0]
    return outside, largest[0], largest[1], total, mirrored(products), *widths


cdef inline void lowered(const double* values, Py_ssize_t count, double* least) noexcept nogil:
    """The least of some numbers and of the one that is there."""
    cdef double found = least[0]
    for q in range(count):
        found = values[q] if values[q] < found else found
    least[0] = found


cdef inline void raised(const double* values, Py_ssize_t count, double* greatest) noexcept nogil:
    """The greatest of some numbers and of the one that is there."""
    cdef double found = greatest[0]
    for q in range(count):
        found = values[q] if values[q] > found else found
    greatest[0] = found


def boxes_of(tables, z, dt, after, base, widest, numbers, Py_ssize_t count):
    """Ranges of [dt z; dt] over transitions that are in a box together, and the least room that bounds leave them.

    `tables`: as of `centre_and_half`; `widest` (n,): largest half-widths, or None; `numbers` (K,): the box of each, of
    so many; -1 for none. Returns low, high (p + 1, count) and (2 n or 3 n, count) the least distance of the next state
    from the upper bound, from the lower one, and of the half-width from the largest.
    """
    cdef Elements elements = Elements(*tables)
    cdef Tiles tiles = Tiles(elements.n, elements.p, z, dt, base, after)
    cdef Py_ssize_t i, j, q, r, b, n = elements.n, p = tiles.p
    cdef const Py_ssize_t[:] box = np.ascontiguousarray(numbers, dtype=np.intp)
    cdef arrays.array most = doubles([] if widest is None else widest)
    cdef bint limited = widest is not None
    if len(numbers) != tiles.count or (limited and len(widest) != n) or (
        tiles.count and not -1 <= np.min(numbers) <= np.max(numbers) < count
    ):
        raise ValueError("the boxes do not fit the transitions")
    low, high = np.full((p + 1, count), np.inf), np.full((p + 1, count), -np.inf)
    left = np.full(((3 if limited else 2) * n, count), np.inf)
    cdef double[:, ::1] least = low
    cdef double[:, ::1] largest = high
    cdef double[:, ::1] room = left
    cdef double* psi = room_for(elements.p + 4)
    cdef double* centre = psi + elements.p * _TOGETHER
    cdef double* half = centre + _TOGETHER
    cdef double* below = half + _TOGETHER
    cdef double* above = below + _TOGETHER
    cdef Py_ssize_t first[_TOGETHER + 1]  # of the runs of transitions in one box; their end
    cdef Py_ssize_t runs
    with nogil:
        while tiles.take():
            tiles.sizes(elements.p, psi)
            runs = 0
            for q in range(tiles.many):
                if not q or box[tiles.index[q]] != box[tiles.index[q - 1]]:
                    first[runs] = q
                    runs += 1
            first[runs] = tiles.many
            for j in range(p + 1):
                for q in range(tiles.many):
                    below[q] = tiles.step[q] * (tiles.phi[j * _TOGETHER + q] if j < p else 1.0)
                for r in range(runs):
                    b = box[tiles.index[first[r]]]
                    if b >= 0:
                        lowered(below + first[r], first[r + 1] - first[r], &least[j, b])
                        raised(below + first[r], first[r + 1] - first[r], &largest[j, b])
            for i in range(n):
                tiles.bounds(elements, i, psi, centre, half)
                for q in range(tiles.many):
                    above[q] = half[q] - (tiles.end[i * _TOGETHER + q] - centre[q])
                    below[q] = half[q] + (tiles.end[i * _TOGETHER + q] - centre[q])
                    if limited:
                        half[q] = most.data.as_doubles[i] - half[q]
                for r in range(runs):
                    b = box[tiles.index[first[r]]]
                    if b >= 0:
                        lowered(above + first[r], first[r + 1] - first[r], &room[i, b])
                        lowered(below + first[r], first[r + 1] - first[r], &room[n + i, b])
                        if limited:
                            lowered(half + first[r], first[r + 1] - first[r], &room[2 * n + i, b])
    free(psi)
    return low, high, left


def normalised_columns(values, k, steady, scale, out):
    """Rows k (K,) of recorded values (N, n), normalised, into columns (n, K); the sum of their squares."""
    cdef const double[:, :] rows = values
    cdef const Py_ssize_t[:] chosen = k
    cdef double[:, :] columns = out
    cdef Py_ssize_t j, q, begin, end, n = rows.shape[1], count = chosen.shape[0]
    cdef arrays.array low = doubles(steady), unit = doubles(scale)
    cdef double value, total = 0.0
    if not (columns.shape[0] == n == len(steady) == len(scale) and columns.shape[1] == count):
        raise ValueError("the rows do not fit the columns")
    if count and not (0 <= chosen[0] and chosen[count - 1] < rows.shape[0]):
        raise ValueError("there are no such rows")
    with nogil:
        for begin from 0 <= begin < count by _TOGETHER:  # so many rows stay in the cache while they become columns
            end = begin + _TOGETHER if begin + _TOGETHER < count else count
            for j in range(n):
                for q in range(begin, end):
                    value = normalised(rows[chosen[q], j], low.data.as_doubles[j], unit.data.as_doubles[j])
                    columns[j, q] = value
                    total += value * value
    return total


def changes(values, k):
    """From rows k (K,) of values (N, n) to the next: where some number stays the same (K,), and the largest changes (n,).
    """
    cdef const double[:, :] rows = values
    cdef const Py_ssize_t[:] chosen = k
    cdef Py_ssize_t i, q, n = rows.shape[1], count = chosen.shape[0]
    cdef double change
    if count and not (0 <= chosen[0] and chosen[count - 1] + 1 < rows.shape[0]):
        raise ValueError("there are no such rows")
    same, largest = np.zeros(count, dtype=bool), np.zeros(n)
    cdef unsigned char[::1] still = same.view(np.uint8)
    cdef double[::1] most = largest
    with nogil:
        for q in range(count):
            for i in range(n):
                change = fabs(rows[chosen[q] + 1, i] - rows[chosen[q], i])
                still[q] |= rows[chosen[q] + 1, i] == rows[chosen[q], i]
                most[i] = change if change > most[i] else most[i]
    return same, largest


def stretches(const double[:, :] values, const double[:] limit, Py_ssize_t least):
    """Disjoint stretches [start, stop) of at least so many rows (N, k), from the left, none of whose columns varies by
    more than its limit.
    """
    cdef Py_ssize_t start = 0, stop, j, count = values.shape[0], k = values.shape[1]
    cdef double[::1] low = np.empty(k), high = np.empty(k)
    cdef double value
    if limit.shape[0] != k:
        raise ValueError("each column needs a limit")
    found = []
    while start < count:
        low[:], high[:], stop, j = values[start], values[start], start, k
        while j == k and stop < count:
            for j in range(k):
                value = values[stop, j]
                low[j] = value if value < low[j] else low[j]
                high[j] = value if value > high[j] else high[j]
                if not (high[j] - low[j] <= limit[j]) or value != value:  # no number ends it
                    break
            else:
                j, stop = k, stop + 1
        if stop - start >= least:
            found.append((start, stop))
        start = max(stop, start + 1)
    return found
