# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Products of narrow matrices with the columns of many transitions, on one thread."""

from __future__ import annotations

import numpy as np

from uncertain_lti.base.arrays import Array

_SINGLE_THREADED = 2**18
"""Multiplications up to which OpenBLAS keeps a product on one thread; waking the others costs more, for narrow ones."""


def _stacked(columns: Array, width: int) -> Array:
    """(r, K) as a stack (K / width, r, width), without a copy."""
    rows, count = columns.shape
    return columns.reshape(rows, count // width, width).transpose(1, 0, 2)


def gram_of(a: Array, b: Array) -> Array:
    """Sum of the products of two sets of columns, a bᵀ.

    `a` (r, K): columns; `b` (s, K): columns; Returns (r, s): the sum over the K.
    """
    count = a.shape[1]
    width = max(_SINGLE_THREADED // (len(a) * len(b)), 512)
    whole = count - count % width
    total: Array = a[:, whole:] @ b[:, whole:].T
    if whole:
        total = total + (_stacked(a[:, :whole], width) @ _stacked(b[:, :whole], width).transpose(0, 2, 1)).sum(axis=0)
    return total


def product(matrix: Array, columns: Array) -> Array:
    """Product of a matrix with every column.

    `matrix` (s, r): narrow; `columns` (r, K): many; Returns (s, K): matrix @ columns.
    """
    count = columns.shape[1]
    width = max(_SINGLE_THREADED // matrix.size, 512)
    whole = count - count % width
    total = np.empty((len(matrix), count))
    if whole:
        np.matmul(matrix, _stacked(columns[:, :whole], width), out=_stacked(total[:, :whole], width))
    if whole < count:
        np.matmul(matrix, columns[:, whole:], out=total[:, whole:])
    return total
