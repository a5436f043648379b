# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""One-step bounds, Leibov (2006), eqs. (6)-(9).

With phi = [x; u; 1], psi = |phi| and the terms of the model side by side (`Elements.tables`), for each state

    centre = x + dt * (Theta phi)
    half   = dt * (Delta psi) + v
    lower  = centre - half * margin,   upper = centre + half * margin

and a sample is contained if lower <= x_next <= upper. Where the model is scheduled, Theta, Delta and v are first
blended from its blocks with the weights of the scheduling vector, element by element. Every sum goes from the first
column to the last (`add_columns`), whether one sample is judged or a million, so all of them give the same bits.
"""


cdef inline double normalised(double value, double steady, double scale) noexcept nogil:
    """Deviation from the steady state, without dimension."""
    return (value - steady) / scale


cdef inline double recorded(double value, double steady, double scale) noexcept nogil:
    """Deviation in recorded units: the inverse of `normalised`."""
    return steady + scale * value


cdef inline double centre_of(double x, double dt, double rate) noexcept nogil:
    """Centre of the bounds one step after x, where Theta phi = rate."""
    return rate * dt + x


cdef inline double half_of(double dt, double spread, double v) noexcept nogil:
    """Half-width of the bounds, where Delta psi = spread."""
    return spread * dt + v


cdef inline double lower_of(double centre, double half, double margin) noexcept nogil:
    """Eq. (6) with a margin."""
    return centre - half * margin


cdef inline double upper_of(double centre, double half, double margin) noexcept nogil:
    """Eq. (7) with a margin."""
    return centre + half * margin


cdef inline bint is_contained(double lower, double x_next, double upper) noexcept nogil:
    """Whether the sample lies within its bounds, Leibov (2006), eqs. (8)(9)."""
    return (lower <= x_next) & (x_next <= upper)


cdef inline bint is_outside(double z, double least, double greatest) noexcept nogil:
    """Whether a value lies outside the range that the fit saw."""
    return (z < least) | (z > greatest)


cdef inline bint is_carried(double value) noexcept nogil:
    """Whether a recorded number is one that the arithmetic carries."""
    return (-_LARGEST <= value) & (value <= _LARGEST)


cdef inline double utilisation_of(double difference, double half) noexcept nogil:
    """(x_next - centre) / half; where half is 0, 0 for no difference and otherwise infinite with its sign."""
    return 0.0 if difference == 0.0 else difference / half


cdef inline double settled_of(double utilisation, bint inside) noexcept nogil:
    """Utilisation whose size is at most 1 exactly where the sample is contained: on the edge rounding decides.

    Of a run that left all numbers it is infinite: NaN is no verdict.
    """
    cdef double above = 1.0000000000000002  # the next number after 1
    if inside:
        return 1.0 if utilisation > 1.0 else -1.0 if utilisation < -1.0 else utilisation
    if utilisation != utilisation:
        return INFINITY
    return above if 0.0 <= utilisation <= 1.0 else -above if -1.0 <= utilisation < 0.0 else utilisation


cdef inline int cell_of(double z, double least, double per_unit, int last) noexcept nogil:
    """Cell of its range that a value lies in; per_unit: cells per normalised unit, 0 where it does not move."""
    cdef double place = (z - least) * per_unit
    return 0 if not place > 0.0 else last if place > last else <int>place


cdef inline double weight_between(double s, double low, double high) noexcept nogil:
    """Weight of the upper of two knots by linear interpolation; that of the lower one is 1 less it."""
    cdef double weight = (s - low) / (high - low)
    return 0.0 if weight < 0.0 else 1.0 if weight > 1.0 else weight


cdef inline void add_columns(
    const double* table, const double* values, Py_ssize_t n, Py_ssize_t p, double* total
) noexcept nogil:
    """total (n,) = Σ_j table[j] values[j] from the first column to the last; table: (p, n), column after column."""
    cdef Py_ssize_t i, j
    for i in range(n):
        total[i] = table[i] * values[0]
    for j in range(1, p):
        for i in range(n):
            total[i] += table[j * n + i] * values[j]


cdef inline void blend(
    const double* table,
    Py_ssize_t size,
    Py_ssize_t count,
    const Py_ssize_t* places,
    const double* weights,
    Py_ssize_t corners,
    double* total,
) noexcept nogil:
    """Σ_r w_r θ_r over the blocks that hold, in their order: `count` elements of blocks of a size."""
    cdef Py_ssize_t i, r
    cdef const double* block = table + places[0] * size
    for i in range(count):
        total[i] = block[i] * weights[0]
    for r in range(1, corners):
        block = table + places[r] * size
        for i in range(count):
            total[i] += block[i] * weights[r]
