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
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from uncertain_lti.base.arrays import LARGEST, Array, on_cores
from uncertain_lti.base.errors import FitError, UncertainLTIError
from uncertain_lti.base.text import plural
from uncertain_lti.identification import passes
from uncertain_lti.identification.passes import Candidate, Envelope, Judged, Moments, Samples
from uncertain_lti.identification.problem import Columns, Partition, Problem
from uncertain_lti.model.domain import Occupancy, cells_for
from uncertain_lti.model.horizon import Residuals, Run

T = TypeVar("T")

_LOOKED_AT = 50_000
"""Transitions that the domain is made from, about; of more, every second, third, ... counts."""
_PART = 100_000
"""Transitions per part, about: the sums of the parts are added in their order, however many threads there are."""
_LEAST = 500
"""Samples of a row that each of many parts brings in one pass, if it has so many near the bounds."""
_TAKEN = 50_000
"""Transitions that the law of the residuals is taken from, about."""
_SAME = 1e-12
"""Directions of regressors that vary by less than the root of this, over their size, count as constant."""
_EXACT = 1e-10
"""Share of the squared change of a state below which what a law leaves of it is rounding."""
_PER_UNKNOWN = 3
"""Transitions for each unknown of a row of that law at least."""


_Facts = tuple[int, int, int, Columns, Array | None]
"""Of a partition how many transitions, states, and states and controls; columns; weights that are constant in time."""


class Fleet:
    """Partitions visited in this process, on all cores; passes over all data as map and reduce.

    `partitions`: with the same columns, states and controls; `sums`: those of the last `moments`.
    """

    sums: Moments

    def __init__(self, partitions: Sequence[Partition]) -> None:
        self.partitions = list(partitions)
        self._describe([_facts(part) for part in self.partitions])

    @classmethod
    def of(cls, problem: Problem) -> Fleet:
        """A problem in memory, in parts for all cores if it is large; how many there are depends on its size alone."""
        count = max(problem.N // _PART, 1)
        edges = np.linspace(0, problem.N, count + 1).astype(int).tolist()
        return cls([problem.subset(slice(a, b)) for a, b in itertools.pairwise(edges)])

    def _describe(self, facts: Sequence[_Facts]) -> None:
        self.counts = [count for count, *_ in facts]
        self.offsets = [0, *np.cumsum(self.counts)[:-1].tolist()]
        self.N = sum(self.counts)
        _, self.n, self.p, self.columns, self.weights = facts[0]

    def map(self, function: Callable[..., T], arguments: Sequence[tuple[Any, ...]]) -> list[T]:
        """function(partition, *arguments of that partition) for every partition."""
        return on_cores(function, [(part, *args) for part, args in zip(self.partitions, arguments, strict=True)])

    def _same(self, *arguments: Any) -> list[tuple[Any, ...]]:
        return [arguments] * len(self.counts)

    def moments(self, stride: int) -> tuple[Moments, list[Samples]]:
        """One pass for sums over all transitions, and a sample of them."""
        results = self.map(passes.moments, [(offset, stride) for offset in self.offsets])
        self.sums = total = sum((sums for sums, _ in results[1:]), results[0][0])
        return total, passes.by_row([some for _, sampled in results for some in sampled], self.n)

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
        most = max(min(_LEAST, candidate.most), 2 * candidate.most // max(2, len(self.offsets)))
        each = replace(candidate, most=most)  # all parts together bring about twice as many as one that is alone
        results = self.map(passes.scan, [(each, offset) for offset in self.offsets])
        by_row = (zip(*of_row, strict=True) for of_row in zip(*results, strict=True))
        return [(Samples.join([*itertools.chain(*samples)], self.p), min(reach)) for samples, reach in by_row]

    def judge(self, model: Envelope) -> Judged:
        """What the bounds of a model are on all transitions, by the verdict's own arithmetic."""
        first, *others = self.map(passes.judge, self._same(model))
        return sum(others, first)

    def residuals(self, model: Envelope, judged: Judged, own_law: ArrayLike = True) -> Residuals:
        """Mean and covariance of the utilisation, `judged`: of all transitions by the same model.

        With them, but of a schedule, residuals of `law_of` on the signals of which `own_law` (p,) is true, if any:
        their spread is the same everywhere, where that of one utilisation changes as the half-widths do.
        """
        mean = judged.total / self.N
        found = Residuals(mean, _covariance(judged.products / self.N - np.outer(mean, mean)))
        if not np.any(own_law) or self.columns.regimes is not None:
            return found
        pairs = self.map(passes.in_a_row, self._same(min(1.0, _TAKEN / self.N)))
        kept = np.tile(np.append(np.broadcast_to(own_law, self.p), np.ones(1 + self.n, dtype=bool)), 2)
        products = np.sum([total for total, _ in pairs], axis=0) * np.outer(kept, kept)
        return found.beside(law_of(products, sum(n for _, n in pairs), self.n))

    def check_solvable(self, where: Callable[[int], str], names: Sequence[str]) -> None:
        """Refuse data to which no envelope can be fitted; `where`: what a transition is called."""
        unknowns = self.columns.unknowns(self.p)
        if self.N < unknowns:
            raise FitError(
                f"{plural(self.N, 'usable transition')} for {unknowns} unknowns per row (nominal elements and "
                f"half-widths); record at least {unknowns}, better a hundred times as many, or use fewer signals"
            )
        if self.columns.half:
            return
        results = self.map(passes.moving_from_rest, [(offset,) for offset in self.offsets])
        if count := sum(found[0] for found in results):
            _, first, state, step = next(found for found in results if found[0])
            also = f" (so {'does' if count == 2 else 'do'} {plural(count - 1, 'other sample')})" if count > 1 else ""
            raise FitError(
                f"{where(first)} begins at rest, x = u = 0, and '{names[state]}' moves by {step:.3g} in it, which no "
                f"interval matrices can contain{also}; use an additive term: --additive noise for measurement noise, "
                f"--additive disturbance for unmodelled inputs"
            )

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


def law_of(products: Array, count: int, n: int) -> Residuals | None:
    """The law by which residuals of steps in a row are least, y_k = θ φ_k + m (y_{k-1} - θ φ_{k-1}) + ε_k, by its sums.

    Of each row extended least squares: θ by least squares, and again from φ_k and the residual before. None of few
    transitions. [Ljung, System Identification, 1999, section 10.3]

    `products`, `count`: of `passes.in_a_row`.
    """
    r = len(products) // 2 - n
    if count < _PER_UNKNOWN * (r + 1) or not np.abs(products).max() < LARGEST:
        return None
    (phi, y), (phi_before, y_before) = (np.split(half, [r]) for half in np.split(np.eye(len(products)), 2))

    def on(rows: Array, others: Array) -> Array:
        """Of each row and another the sum of their products."""
        return np.asarray(np.einsum("ia,ab,ib->i", rows, products, others, optimize=True))

    gram = phi @ products @ phi.T
    scale = np.sqrt(np.maximum(np.diagonal(gram), 1e-300))
    inverse = np.linalg.pinv(gram / np.outer(scale, scale), rcond=_SAME, hermitian=True) / np.outer(scale, scale)
    theta = y @ products @ phi.T @ inverse
    last = y_before - theta @ phi_before
    told = last @ products @ phi.T @ inverse
    new = last - told @ phi  # what the residual before says that φ does not
    theta = theta - _share(on(new, y), on(new, new), on(last, last))[:, None] * told
    residual, last = y - theta @ phi, y_before - theta @ phi_before
    memory = _share(on(last, residual), on(last, last), on(y_before, y_before))
    left = residual - memory[:, None] * last
    variance, whole = on(left, left), on(y, y)
    if not ((variance > _EXACT * whole) | (whole == 0.0)).all() or not (np.abs(theta) <= LARGEST).all():
        return None
    A, B, c = np.split(theta, (n, r - 1), axis=1)
    return Residuals(np.zeros(n), _covariance(left @ products @ left.T / count), False, Run(A, B, c[:, 0]), memory)


def _share(of: Array, size: Array, whole: Array) -> Array:
    """of / size; 0 where the size is rounding of the whole."""
    return np.divide(of, size, out=np.zeros_like(of), where=size > _EXACT * whole)


def _covariance(products: Array) -> Array:
    """A covariance without the negative eigenvalues that rounding leaves."""
    values, vectors = np.linalg.eigh(0.5 * (products + products.T))
    covariance = (vectors * np.maximum(values, 0.0)) @ vectors.T if values[0] < 0.0 else products
    return np.asarray(0.5 * (covariance + covariance.T))
