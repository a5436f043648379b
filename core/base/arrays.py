# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Arrays of numbers: their types, the largest numbers that a file may state, and work on them on all cores."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Numbers: values, matrices, bounds."""
Integers = NDArray[np.int64]
"""Times in ns, counts, byte offsets."""
Index = NDArray[np.intp]
"""Positions in another array."""
Mask = NDArray[np.bool_]
"""True or false for each entry of another array."""


def real(values: Any) -> Array:
    """A copy as real numbers, NaN where masked; TypeError for complex ones, whose imaginary part numpy would drop."""
    if np.iscomplexobj(values):
        raise TypeError("complex numbers")
    if isinstance(values, np.ma.MaskedArray):
        values = np.ma.filled(values.astype(np.float64), np.nan)
    return np.array(values, dtype=np.float64)


def numbers(values: Any, what: str, wanted: tuple[Any, ...], error: type[Exception]) -> Array:
    """An argument as real numbers of a shape, in which ... is any number of axes in front and None any length."""
    last = wanted[1:] if wanted[:1] == (...,) else wanted
    try:
        given = values if isinstance(values, np.ndarray) else np.asarray(values)
        if values is None or given.dtype.kind in "US":
            raise TypeError
        array = given if type(given) is np.ndarray and given.dtype == np.float64 else real(given)
        own = array.shape[max(array.ndim - len(last), 0) :] if last is not wanted else array.shape
        if len(own) == len(last) and all(size in (None, has) for has, size in zip(own, last, strict=True)):
            return array
        found = f"has shape {array.shape}"
    except (TypeError, ValueError, OverflowError):
        found = "is not numeric"
    sizes = str(wanted).replace("Ellipsis", "...").replace("None", "N")
    raise error(f"{what} {found}; {f'give real numbers of shape {sizes}' if wanted else 'give a real number'}")


LONGEST_S = 9e9  # s; 2^63 ns are 9.2e9 s
LARGEST = 1e50
"""Magnitude of a number in recorded units or in 1/s, and of a scale or its inverse: squares of ratios stay finite."""

T = TypeVar("T")
WORTH_THREADS = 20_000
"""Transitions, or verdicts, from about which on what is done with all of them takes longer than to begin a thread."""


def in_stretches(place: NDArray[np.intp], share: int, length: int) -> NDArray[np.bool_]:
    """Which places (K,) are in one of so many stretches of a length: some of all, spread evenly, with neighbours."""
    return np.asarray(place // length % share == 0)


def spread(count: int) -> list[int]:
    """Places in such an order that the first ones, however many, are spread over all."""
    return sorted(range(count), key=lambda i: int(f"{i:064b}"[::-1], 2))


def runs(flags: Mask) -> list[tuple[int, int]]:
    """[start, stop) of every run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def core_count() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def on_cores(function: Callable[..., T], arguments: Sequence[tuple[Any, ...]], worth_threads: bool = True) -> list[T]:
    """function(*arguments) for each, in their order, by threads where what each does takes longer than to begin one."""
    if not worth_threads:
        return [function(*some) for some in arguments]
    return list(one_by_one(function, arguments))


@contextmanager
def one_thread_each() -> Iterator[None]:
    """BLAS keeps to the thread that calls it: on small arrays, from several threads, its own only wait for another."""
    with _libraries().limit(limits=1, user_api="blas"):
        yield


def return_memory() -> None:
    """Give back what is freed, of which the C library keeps hundreds of MB after the threads of a large fit."""
    if "pyarrow" in sys.modules:  # keeps as much of the tables that it read
        sys.modules["pyarrow"].default_memory_pool().release_unused()
    with suppress(OSError, AttributeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)


@cache
def _libraries() -> Any:
    import scipy.linalg  # noqa: F401  # brings a BLAS of its own
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def one_by_one(function: Callable[..., T], arguments: Sequence[tuple[Any, ...]]) -> Iterator[T]:
    """As `on_cores`, each as soon as it and those before it are done; an error ends what has not begun."""
    if len(arguments) < 2 or core_count() < 2:
        yield from (function(*some) for some in arguments)
        return
    with ThreadPoolExecutor(min(core_count(), len(arguments))) as pool:
        yield from pool.map(lambda some: function(*some), arguments)
