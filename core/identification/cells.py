# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Transitions of a scheduled fit sorted by the blocks that hold, so that the others cost nothing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array, Index
from uncertain_lti.identification.columns import Regimes
from uncertain_lti.identification.problem import Block
from uncertain_lti.identification.products import gram_of, product


class Whole:
    """Transitions of a model with one block, as they are; the sums of `Cells` for them."""

    def sort(self, block: Block) -> Block:
        """As of `Cells`."""
        return block

    def spread(self, columns: Array) -> list[Array]:
        """As of `Cells`.

        `columns` (r, K): regressors; Returns (r, K): all of them.
        """
        return [columns]

    def gram(self, a: list[Array], factor: Array | None = None) -> Array:
        """As of `Cells`.

        `factor` (K,): of each transition; default 1; Returns (r, r): sum.
        """
        return gram_of(a[0] if factor is None else a[0] * factor, a[0])

    def against(self, a: list[Array], columns: Array) -> Array:
        """As of `Cells`.

        `columns` (s, K): others; Returns (r, s): sum.
        """
        return gram_of(a[0], columns)

    def total(self, a: list[Array]) -> Array:
        """As of `Cells`.

        Returns (r,): sum.
        """
        total: Array = a[0].sum(axis=1)
        return total

    def visits(self, count: int) -> NDArray[np.intp]:
        """As of `Cells`.

        Returns (1,): the same.
        """
        return np.array([count])


@dataclass(frozen=True)
class Cells:
    """Which blocks hold at some transitions, those of the same blocks side by side.

    Between knots two blocks of each scheduling signal hold, in a mode one: of w(s) ⊗ z, with w the weights of all
    blocks, the rest is zero, and is neither built nor multiplied.

    `order` (K,): where each transition was before they were sorted; `parts` (C,): transitions side by side, and the
    blocks that hold at them; `weights` (C, K): of these blocks, sorted; `count`: number of all blocks, R.
    """

    order: Index
    parts: tuple[tuple[slice, Index], ...]
    weights: Array
    count: int

    @classmethod
    def of(cls, regimes: Regimes, block: Block) -> Cells:
        """Sort transitions."""
        places, weights = regimes.schedule.corners(regimes.vectors(block.z, block.s))
        first = places[0].astype(np.int16)  # the first block tells the others; short numbers are sorted by digits
        order = np.argsort(first, kind="stable")
        ends = np.cumsum(np.bincount(first, minlength=regimes.schedule.blocks))
        starts = np.concatenate([[0], ends[:-1]])
        parts = tuple(
            (slice(int(start), int(end)), places[:, order[start]])
            for start, end in zip(starts, ends, strict=True)
            if start < end
        )
        return cls(order, parts, weights[:, order], regimes.schedule.blocks)

    def __len__(self) -> int:
        return len(self.order)

    def sort(self, block: Block) -> Block:
        """The transitions in its order."""
        return block.take(self.order)

    def before(self, chosen: Index) -> tuple[Index, Index]:
        """Where some transitions of several rows were before they were sorted.

        `chosen` (k,): row x K + position, sorted; Returns (k,): row x K + position before, in increasing order; Returns
        (k,): which of `chosen` each of them is.
        """
        row, k = np.divmod(chosen, len(self))
        found = row * len(self) + self.order[k]
        sorting = np.argsort(found)
        return found[sorting], sorting

    def product(self, matrix: Array, columns: Array) -> Array:
        """matrix @ (w(s) ⊗ columns).

        `matrix` (s, R r): elements of all blocks, those of the first block first; `columns` (r, K): regressors of one
        block, sorted; Returns (s, K): sorted.
        """
        rows, (r, count) = len(matrix), columns.shape
        elements = matrix.reshape(rows, self.count, r).transpose(1, 0, 2)
        total = np.empty((rows, count))
        for part, blocks in self.parts:
            each = product(elements[blocks].reshape(-1, r), columns[:, part])
            each = each.reshape(len(blocks), rows, -1)
            each *= self.weights[:, None, part]
            for k in range(1, len(each)):
                each[0] += each[k]
            total[:, part] = each[0]
        return total

    def spread(self, columns: Array) -> list[Array]:
        """The part of w(s) ⊗ columns that is not zero.

        `columns` (r, K): regressors of one block, sorted; Returns (C r, k): of each part those of the blocks that hold.
        """
        return [
            (self.weights[:, None, part] * columns[:, part]).reshape(-1, part.stop - part.start)
            for part, _ in self.parts
        ]

    def gram(self, a: list[Array], factor: Array | None = None) -> Array:
        """Sum over the transitions of the products of weighted columns.

        `factor` (K,): of each transition, sorted; default 1; Returns (R r, R r): (w ⊗ columns)(w ⊗ columns)ᵀ, which is
        zero but for blocks that hold together.
        """
        r, held = len(a[0]) // len(self.weights), len(self.weights)
        total = np.zeros((self.count, r, self.count, r))
        for (part, blocks), columns in zip(self.parts, a, strict=True):
            found = gram_of(columns if factor is None else columns * factor[part], columns)
            total[blocks[:, None], :, blocks[None, :]] += found.reshape(held, r, held, r).transpose(0, 2, 1, 3)
        return total.reshape(self.count * r, self.count * r)

    def against(self, a: list[Array], columns: Array) -> Array:
        """Sum over the transitions of the products of weighted columns with others.

        `columns` (s, K): sorted; Returns (R r, s): (w ⊗ columns of a) columnsᵀ.
        """
        r = len(a[0]) // len(self.weights)
        total = np.zeros((self.count, r, len(columns)))
        for (part, blocks), weighted in zip(self.parts, a, strict=True):
            total[blocks] += gram_of(weighted, columns[:, part]).reshape(len(blocks), r, -1)
        return total.reshape(self.count * r, -1)

    def total(self, a: list[Array]) -> Array:
        """Sum of weighted columns over the transitions.

        Returns (R r,): Σ w ⊗ columns.
        """
        r = len(a[0]) // len(self.weights)
        total = np.zeros((self.count, r))
        for (_, blocks), weighted in zip(self.parts, a, strict=True):
            total[blocks] += weighted.sum(axis=1).reshape(len(blocks), r)
        return total.reshape(-1)

    def main_parts(self) -> Iterator[tuple[int, slice, NDArray[np.bool_]]]:
        """Where each block has the largest weight, of two alike the first.

        Yields (k,): whether its weight is the largest there.
        """
        for part, blocks in self.parts:
            largest = np.argmax(self.weights[:, part], axis=0)
            for corner, block in enumerate(blocks.tolist()):
                yield block, part, largest == corner

    def visits(self, count: int) -> NDArray[np.intp]:
        """Of how many transitions each block has the largest weight.

        Returns (R,): they add up to that number.
        """
        found = np.zeros(self.count, dtype=np.intp)
        for block, _, there in self.main_parts():
            found[block] += np.count_nonzero(there)
        return found
