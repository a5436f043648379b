# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Sums of many samples at once in the order of one sample: from the first element to the last, so to the same bits."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np


def ordered_sum(weights: Any, values: Any) -> Any:
    """Sum of weights * values over the first axis, from the first element to the last.

    No BLAS, whose order depends on shapes. Compiled code has the same sum in `bounds`.

    `weights, values` (p, ...): that can be multiplied with each other.
    """
    products = np.multiply(weights, values, order="C")  # the layout decides the order of the sum
    return _sum_of_rows(products.shape)(products)


@cache
def _sum_of_rows(shape: tuple[int, ...]) -> Callable[[Any], Any]:
    """Sum over the first axis, row after row.

    `add.reduce` does it in this order and is several times faster than `add.accumulate`, which is defined to; as its
    order is nowhere stated, it is tried on this shape first.
    """
    rng = np.random.default_rng(0)
    for _ in range(20):  # where the sums are few, another order may give the same bits by chance
        rows = rng.normal(size=shape)
        in_order = rows[0].copy()
        for row in rows[1:]:
            in_order += row
        if np.add.reduce(rows, axis=0).tobytes() != in_order.tobytes():
            return _accumulated
    return _reduced


def _reduced(rows: Any) -> Any:
    return np.add.reduce(rows, axis=0)


def _accumulated(rows: Any) -> Any:
    return np.add.accumulate(rows, axis=0)[-1]


def blended(blocks: Any, places: Any, weights: Any) -> Any:
    """Elements of a scheduled model at K samples: Σ_r w_r θ_r over the blocks that hold, in their order.

    Compiled code has the same sum in `bounds`.

    `blocks` (R, ...): elements of each block; `places` (C, K): blocks that hold at each sample (`Schedule.corners`);
    `weights` (C, K): their weights.
    """
    last = np.ascontiguousarray(np.moveaxis(blocks, 0, -1))
    total = np.take(last, places[0], axis=-1)
    total *= weights[0]
    for place, weight in zip(places[1:], weights[1:], strict=True):
        part = np.take(last, place, axis=-1)
        part *= weight
        total += part
    return total
