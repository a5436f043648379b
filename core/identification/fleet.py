"""Fleet: the partitions of the data, and how a pass visits them all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.identification import passes
from uncertain_lti.identification.passes import Candidate, Judged, Moments, Samples
from uncertain_lti.identification.problem import Columns, Partition
from uncertain_lti.model import UncertainLTI

Array = NDArray[np.float64]
T = TypeVar("T")


class Fleet:
    """Partitions visited one after the other in this process; the passes over all data as map and reduce.

    Parameters
    ----------
    partitions : sequence of Partition
        With the same columns, states and controls.
    """

    def __init__(self, partitions: Sequence[Partition]) -> None:
        self.partitions = list(partitions)
        self._describe([(part.N, part.n, part.p, part.columns) for part in self.partitions])

    def _describe(self, facts: Sequence[tuple[int, int, int, Columns]]) -> None:
        self.counts = [count for count, *_ in facts]
        self.offsets = [0, *np.cumsum(self.counts)[:-1].tolist()]
        self.N = sum(self.counts)
        _, self.n, self.p, self.columns = facts[0]

    @property
    def weights(self) -> Array | None:
        """Weights (n,) that are constant in time; None where they are not."""
        first = self.partitions[0].weights
        return first if first.ndim == 1 else None

    def map(self, function: Callable[..., T], arguments: Sequence[tuple[Any, ...]]) -> list[T]:
        """function(partition, *arguments of that partition) for every partition, in order."""
        return [function(part, *args) for part, args in zip(self.partitions, arguments, strict=True)]

    def _same(self, *arguments: Any) -> list[tuple[Any, ...]]:
        return [arguments] * len(self.counts)

    def moments(self, stride: int) -> tuple[Moments, list[Samples]]:
        """Sums over all transitions, and every stride-th transition per row."""
        results = self.map(passes.moments, [(offset, stride) for offset in self.offsets])
        total = results[0][0]
        for sums, _ in results[1:]:
            total = total + sums
        return total, [Samples.join([r[1][i] for r in results], self.p) for i in range(self.n)]

    def scan(self, candidate: Candidate) -> list[tuple[Samples, float]]:
        """Per row the samples of least slack, and the reach below which none is missing."""
        results = self.map(passes.scan, [(candidate, offset) for offset in self.offsets])
        rows = []
        for i in range(self.n):
            rows.append((Samples.join([r[i][0] for r in results], self.p), min(r[i][1] for r in results)))
        return rows

    def judge(self, model: UncertainLTI) -> Judged:
        """What the bounds of a model are on all transitions, by the verdict's own arithmetic."""
        first, *others = self.map(passes.judge, self._same(model))
        return sum(others, first)

    def moving_from_rest(self) -> tuple[int, int, float]:
        """Samples with x = u = 0 and a successor that is not: how many, and the state that moves most and how far."""
        results = self.map(passes.moving_from_rest, self._same())
        _, state, step = max(results, key=lambda r: r[2])
        return sum(r[0] for r in results), state, step

    def median_dt(self) -> float:
        """Median of Δt, s."""
        return float(np.median(np.concatenate(self.map(passes.steps, self._same()))))
