# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Fleet: the partitions of the data, in this process or on Dask, and how a pass visits them all."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np

from uncertain_lti.base.arrays import Array, core_count
from uncertain_lti.base.errors import FitError, UncertainLTIError
from uncertain_lti.identification import passes
from uncertain_lti.identification.passes import Candidate, Envelope, Judged, Moments, Samples
from uncertain_lti.identification.problem import Columns, Partition, Problem
from uncertain_lti.model.domain import Occupancy, cells_for
from uncertain_lti.model.horizon import Residuals

T = TypeVar("T")

_LOOKED_AT = 50_000
"""Transitions that the domain is made from, about; of more, every second, third, ... counts."""
_PART = 100_000
"""Transitions per part, about: the sums of the parts are added in their order, however many threads there are."""
_COMPARED = 20_000
"""Residuals that the two forms of `model.residuals` are compared on, about."""


_Facts = tuple[int, int, int, Columns, Array | None]
"""Of a partition how many transitions, states, and states and controls; columns; weights that are constant in time."""


class Fleet:
    """Partitions visited in this process, in turn or by threads; passes over all data as map and reduce.

    `partitions`: with the same columns, states and controls; `threads`: how many partitions a pass visits at a time,
    which the kernel does without the interpreter's lock; `sums`: those of the last `moments`.
    """

    sums: Moments

    def __init__(self, partitions: Sequence[Partition], threads: int = 1) -> None:
        self.partitions = list(partitions)
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None
        self._describe([_facts(part) for part in self.partitions])

    @classmethod
    def of(cls, problem: Problem) -> Fleet:
        """A problem in memory, in parts for all cores if it is large; how many there are depends on its size alone."""
        count = max(problem.N // _PART, 1)
        edges = np.linspace(0, problem.N, count + 1).astype(int).tolist()
        return cls([problem.subset(slice(a, b)) for a, b in itertools.pairwise(edges)], min(count, core_count()))

    def _describe(self, facts: Sequence[_Facts]) -> None:
        self.counts = [count for count, *_ in facts]
        self.offsets = [0, *np.cumsum(self.counts)[:-1].tolist()]
        self.N = sum(self.counts)
        _, self.n, self.p, self.columns, self.weights = facts[0]

    def map(self, function: Callable[..., T], arguments: Sequence[tuple[Any, ...]]) -> list[T]:
        """function(partition, *arguments of that partition) for every partition."""
        if self._pool is None:
            return [function(part, *args) for part, args in zip(self.partitions, arguments, strict=True)]
        futures = [self._pool.submit(function, p, *args) for p, args in zip(self.partitions, arguments, strict=True)]
        return [future.result() for future in futures]

    def _same(self, *arguments: Any) -> list[tuple[Any, ...]]:
        return [arguments] * len(self.counts)

    def moments(self, stride: int) -> tuple[Moments, list[Samples]]:
        """One pass for sums over all transitions, and a sample of them."""
        results = self.map(passes.moments, [(offset, stride) for offset in self.offsets])
        self.sums = total = sum((sums for sums, _ in results[1:]), results[0][0])
        return total, passes.by_row([some for _, sampled in results for some in sampled], self.n, self.p)

    def occupancy(self, low: Array, high: Array) -> Occupancy | None:
        """Combinations of two signals that the data hold; see `passes.occupied`.

        `low` (p,): least z; `high` (p,): greatest z.
        """
        cells, stride = cells_for(self.N), -(-self.N // _LOOKED_AT)
        if not cells:
            return None
        return Occupancy.of(np.logical_or.reduce(self.map(passes.occupied, self._same(low, high, cells, stride))))

    def scan(self, candidate: Candidate) -> list[tuple[Samples, float]]:
        """One pass for the samples of least slack; see `passes.scan`."""
        results = self.map(passes.scan, [(candidate, offset) for offset in self.offsets])
        rows = []
        for i in range(len(candidate.rows)):
            rows.append((Samples.join([r[i][0] for r in results], self.p), min(r[i][1] for r in results)))
        return rows

    def judge(self, model: Envelope) -> Judged:
        """What the bounds of a model are on all transitions, by the verdict's own arithmetic."""
        first, *others = self.map(passes.judge, self._same(model))
        return sum(others, first)

    def residuals(self, model: Envelope, judged: Judged) -> Residuals:
        """Mean and covariance of the utilisation, or of the residual; `judged`: of all transitions by the same model.

        With one covariance of the residual its spread is the same in all regimes, with one of the utilisation it is as
        the half-width; the form by which the transitions are likelier is taken.
        """
        some = self.map(passes.some_residuals, self._same(model, max(1, self.N // _COMPARED)))
        relative = not likelier_alone(*(np.concatenate(each) for each in zip(*some, strict=True)))
        form = 0 if relative else 1
        mean, products = judged.total[form] / self.N, judged.products[form] / self.N
        covariance = products - np.outer(mean, mean)
        values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
        if values[0] < 0.0:  # by rounding
            covariance = (vectors * np.maximum(values, 0.0)) @ vectors.T
        return Residuals(mean, 0.5 * (covariance + covariance.T), relative)

    def moving_from_rest(self) -> tuple[int, int, int, float]:
        """Samples with x = u = 0 and a successor that is not 0; see `passes.moving_from_rest`."""
        results = self.map(passes.moving_from_rest, [(offset,) for offset in self.offsets])
        return sum(r[0] for r in results), *next((r for r in results if r[0]), results[0])[1:]

    def least_eigenvalue(self) -> float:
        """Least eigenvalue of any full weight; see `passes.least_eigenvalue`."""
        return min(self.map(passes.least_eigenvalue, self._same()))

    def median_dt(self) -> float:
        """Median step."""
        return float(np.median(np.concatenate(self.map(passes.steps, self._same()))))


class DaskFleet(Fleet):
    """Partitions that workers make and keep; a pass sends the candidate and brings back the few samples that matter.

    A partition is the result of a pure task, so a worker that is lost costs the time to make its partitions again.

    `client`: the cluster; `tasks`: function and arguments; each makes one `Problem`; `done`: called with the number of
    those made so far. `kept`: numbers of the tasks whose problems have transitions.
    """

    def __init__(
        self,
        client: Any,
        tasks: Sequence[tuple[Callable[..., Problem], tuple[Any, ...]]],
        done: Callable[[int], None] | None = None,
    ) -> None:
        self._client = client
        made = _submitted(client, tasks)
        facts = self.run(client, [(_facts, (part,)) for part in made], done)
        self.kept = [number for number, (count, *_) in enumerate(facts) if count]
        if not self.kept:
            raise FitError("no usable transition in any recording; check the signals file")
        self._parts = [made[number] for number in self.kept]
        self._describe([facts[number] for number in self.kept])

    @staticmethod
    def run(
        client: Any,
        tasks: Sequence[tuple[Callable[..., T], tuple[Any, ...]]],
        done: Callable[[int], None] | None = None,
    ) -> list[T]:
        """Run tasks on the workers."""
        from distributed import as_completed
        from distributed.client import FutureCancelledError
        from distributed.comm.core import CommClosedError
        from distributed.scheduler import KilledWorker

        futures = _submitted(client, tasks)
        try:
            if done is not None:
                for number, _ in enumerate(as_completed(futures), start=1):  # type: ignore[no-untyped-call]
                    done(number)
            results: list[T] = client.gather(futures)
        except UncertainLTIError:
            raise
        except (KilledWorker, CommClosedError, FutureCancelledError, TimeoutError, OSError) as error:
            text = f"the Dask cluster gave up ({type(error).__name__}); look at its workers' logs"
            raise FitError(text) from None
        return results

    def map(self, function: Callable[..., T], arguments: Sequence[tuple[Any, ...]]) -> list[T]:
        """function(partition, *arguments) on the workers."""
        tasks = [(function, (part, *args)) for part, args in zip(self._parts, arguments, strict=True)]
        return self.run(self._client, tasks)


def _submitted(client: Any, tasks: Sequence[tuple[Callable[..., Any], tuple[Any, ...]]]) -> list[Any]:
    return [client.submit(function, *arguments, pure=False, retries=3) for function, arguments in tasks]


def _facts(part: Partition) -> _Facts:
    return part.N, part.n, part.p, part.columns, part.weights if part.weights.ndim == 1 else None


_FREEDOM = 3.0
_ROUNDS = 15
_LIKELIER = 0.01
"""By so much the log-likelihood of a transition must be larger for the residual in place of the utilisation."""


def likelier_alone(residual: Array, half: Array) -> bool:
    """Whether one covariance of the residual describes it better, as of noise of readings, than one of the utilisation.

    Compared is the likelihood of a distribution of Student's with few degrees of freedom: recordings far from the
    usual, such as pulses, leave residuals many times as large, and by a normal distribution those few would decide.

    `residual` (K, n): of some transitions; `half` (K, n): their half-widths.
    """
    if not (half > 0.0).all() or len(residual) <= 2 * residual.shape[1]:
        return False
    alone, relative = _log_likelihood(residual), _log_likelihood(residual / half)
    return bool(alone > relative - np.log(half).sum(axis=1).mean() + _LIKELIER)


def _log_likelihood(values: Array) -> float:
    """Of a row, with the likeliest mean and scatter, but for a constant; -inf if the scatter is singular."""
    columns = np.ascontiguousarray(values.T)
    n, count = columns.shape
    weights = np.ones(count)
    for _ in range(_ROUNDS):
        centred = columns - (columns @ weights / weights.sum())[:, None]
        scatter = (centred * weights) @ centred.T / count
        sign, logarithm = np.linalg.slogdet(scatter)
        if sign <= 0.0 or not np.isfinite(logarithm):
            return -np.inf
        distance = np.einsum("ik,ik->k", np.linalg.inv(scatter) @ centred, centred)
        weights = (_FREEDOM + n) / (_FREEDOM + distance)
    return float(-0.5 * logarithm - 0.5 * (_FREEDOM + n) * np.log1p(distance / _FREEDOM).mean())
