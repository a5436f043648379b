# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Fleet on Dask: partitions in the memory of workers, passes as map and reduce."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import FitError, UncertainLTIError
from uncertain_lti.identification.fleet import Fleet
from uncertain_lti.identification.problem import Problem

T = TypeVar("T")


class DaskFleet(Fleet):
    """Partitions that workers make and keep; a pass sends the candidate and brings back the few samples that matter.

    A partition is the result of a pure task, so a worker that is lost costs the time to make its partitions again.

    `client`: the cluster; `tasks`: function and arguments; each makes one `Problem`; `done`: called with the number of
    those made so far.
    """

    def __init__(
        self,
        client: Any,
        tasks: Sequence[tuple[Callable[..., Problem], tuple[Any, ...]]],
        done: Callable[[int], None] | None = None,
    ) -> None:
        self._client = client
        made = [client.submit(function, *arguments, pure=False, retries=3) for function, arguments in tasks]
        facts = _gather(client, [client.submit(_facts, part, pure=False, retries=3) for part in made], done)
        kept = [(part, fact[0]) for part, fact in zip(made, facts, strict=True) if fact[0][0]]
        if not kept:
            raise FitError("no usable transition in any recording; check the signals file")
        self._parts = [part for part, _ in kept]
        self._constant_weights = next(fact[1] for fact in facts if fact[0][0])
        self._describe([fact for _, fact in kept])

    @property
    def weights(self) -> Array | None:
        """Weights (n,) that are constant in time; None where they are not."""
        return self._constant_weights  # type: ignore[no-any-return]

    @staticmethod
    def run(
        client: Any,
        tasks: Sequence[tuple[Callable[..., T], tuple[Any, ...]]],
        done: Callable[[int], None] | None = None,
    ) -> list[T]:
        """Run tasks on the workers."""
        return _gather(client, [client.submit(f, *arguments, pure=False, retries=3) for f, arguments in tasks], done)

    def map(self, function: Callable[..., T], arguments: Sequence[tuple[Any, ...]]) -> list[T]:
        """function(partition, *arguments) on the workers."""
        futures = [
            self._client.submit(function, part, *args, pure=False, retries=3)
            for part, args in zip(self._parts, arguments, strict=True)
        ]
        return _gather(self._client, futures)


def _gather(client: Any, futures: list[Any], done: Callable[[int], None] | None = None) -> list[Any]:
    from distributed import as_completed
    from distributed.client import FutureCancelledError
    from distributed.comm.core import CommClosedError
    from distributed.scheduler import KilledWorker

    try:
        if done is not None:
            for number, _ in enumerate(as_completed(futures), start=1):  # type: ignore[no-untyped-call]
                done(number)
        results: list[Any] = client.gather(futures)
    except UncertainLTIError:
        raise
    except (KilledWorker, CommClosedError, FutureCancelledError, TimeoutError, OSError) as error:
        raise FitError(f"the Dask cluster gave up ({type(error).__name__}); look at its workers' logs") from None
    return results


def _facts(part: Problem) -> tuple[tuple[Any, ...], Array | None]:
    return (part.N, part.n, part.p, part.columns), part.weights if part.weights.ndim == 1 else None
