# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Types of the kernel."""

from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array

JUDGED: int
VIOLATION: int
OUTSIDE: int
UNKNOWN: int
UNLISTED: int
LEFT: int
REPEATS: int
BEYOND: float
LONGER: int
BY_RUN: int
BY_SUM: int
BY_ACTIVITY: int
BY_NOISE: int
LOWER: int
UPPER: int
RESIDUAL: int
FLAGS: int
UTILISATION: int
ENERGY: int
MEAN: int
EWMA: int
CUSUM: int
CHI2: int
MEWMA: int
LIMIT: float

class Blocks:
    def __init__(self, axes: Sequence[Any] = (), known: Any = None) -> None: ...
    def at(self, s: Any) -> tuple[NDArray[np.intp], Array]: ...

class Judgement:
    contained: bool
    violation: bool
    outside_domain: bool
    unknown_regime: bool
    def numbers(self, which: int) -> array[float]: ...
    def reach(self, largest: Any) -> None: ...
    def packed(self) -> bytes: ...

class Judge:
    def __init__(
        self,
        theta: Any,
        delta: Any,
        v: Any,
        steady: Any,
        scale: Any,
        least: Any,
        greatest: Any,
        margin: float,
        counted: Any,
        occupied: Any = None,
        schedule: Any = None,
        positions: Sequence[int] = (),
        known: Any = None,
        law: Any = None,
    ) -> None: ...
    def judge(self, before: Sequence[float], after: Sequence[float], dt: float) -> Judgement | None: ...
    def judge_rows(
        self,
        x: Array,
        u: Array,
        s: Array,
        k: NDArray[np.intp],
        dt: Array,
        numbers: Sequence[Array | None],
        marks: NDArray[np.uint8] | None,
    ) -> None: ...
    def advance(self, runs: Array, z: Array, dt: Array, a: int, b: int, first: int, last: int) -> None: ...

class Runs:
    count: int
    residuals: array[float]
    def __init__(self, judge: Judge, horizons: Sequence[Any], runner: Judge | None = None) -> None: ...
    def reset(self) -> None: ...
    def push(self, before: Sequence[float], after: Sequence[float], dt: float) -> array[float]: ...
    def foresee(self, before: Sequence[float], dt: float) -> array[float] | None: ...

class Repeating:
    most: Array
    def __init__(self, thresholds: Array, least: int, rest: float, counted: Sequence[bool], margin: float) -> None: ...
    def forget(self) -> None: ...
    def take(
        self,
        t_ns: int,
        dt: float,
        before: Sequence[float],
        after: Sequence[float],
        lower: Sequence[float],
        upper: Sequence[float],
        own: Sequence[float],
        outside: bool,
    ) -> list[tuple[int, float, int, float]]: ...
    def take_all(
        self,
        follows: NDArray[np.bool_],
        t_ns: NDArray[np.int64],
        dt: Array,
        before: Array,
        after: Array,
        lower: Array,
        upper: Array,
        own: Array,
        outside: NDArray[np.bool_],
    ) -> tuple[NDArray[np.uint8], Array]: ...

class Statistic:
    alarm: bool
    blamed: int
    def __init__(
        self,
        kind: int,
        n: int,
        window_s: float,
        thresholds: Any,
        counted: Any,
        allowance: float = 0.0,
        mean: Any = None,
        whitening: Any = None,
        memory: Any = None,
    ) -> None: ...
    def reset(self) -> None: ...
    def values(self) -> array[float]: ...
    def push_all(
        self,
        dt: Any,
        rows: Any,
        judged: NDArray[np.bool_] | None = None,
        raised: NDArray[np.bool_] | None = None,
        found: Array | None = None,
        blamed: NDArray[np.int16] | None = None,
    ) -> tuple[NDArray[np.bool_], Array]: ...

class Statistics:
    def __init__(self, parts: Sequence[Statistic], begins: Sequence[int]) -> None: ...
    def push(self, dt: float, table: Any) -> bool: ...
    def values(self) -> array[float]: ...

def all_carried(values: Sequence[float]) -> bool: ...

class Window:
    alarm: bool
    def __init__(
        self, violations: int, window: int, margin: float = 0.0, states: Sequence[int] = (), begin: int = 0
    ) -> None: ...
    def reset(self) -> None: ...
    def push(self, violated: bool, table: Any) -> bool: ...
    def push_all(self, violated: Any, rows: Any, judged: Any, raised: NDArray[np.bool_]) -> None: ...

def blended(blocks: Any, places: Any, weights: Any) -> Array: ...
def centre_and_half(
    tables: tuple[Array, Array, Array],
    z: Array,
    dt: Array,
    centre: Array,
    half: Array,
    blocks: Blocks | None = None,
    s: Array | None = None,
    base: Array | None = None,
) -> None: ...
def edges(centre: Array, half: Array, margin: float) -> tuple[Array, Array]: ...
def utilisations(difference: Array, half: Array) -> Array: ...
def settled(utilisation: Array, inside: NDArray[np.bool_]) -> Array: ...
def arrivals(x: Array, centre: Array, half: Array) -> tuple[Array, Array]: ...
def pair_count(size: int) -> int: ...
def outside_domain(
    z: Array, least: Any, greatest: Any, occupied: Any = None, share: float = ...
) -> NDArray[np.bool_]: ...
def occupy(z: Array, least: Array, greatest: Array, occupied: NDArray[np.bool_]) -> None: ...
def sums_of(
    n: int,
    z: Array,
    dt: Array,
    after: Array,
    base: Array | None,
    blocks: Blocks | None,
    s: Array | None,
    ones: int,
    times_dt: Sequence[bool],
    weights: Array | None,
) -> tuple[Any, ...]: ...
def near_bounds(
    n: int,
    z: Array,
    dt: Array,
    after: Array,
    base: Array | None,
    blocks: Blocks | None,
    s: Array | None,
    ones: int,
    times_dt: Sequence[bool],
    theta: Array,
    d: Array,
    unit: Array,
    scale: Array,
    reach: Array,
    room: Array,
    limit: Array | None,
    rows: Any,
) -> tuple[NDArray[np.intp], Array]: ...
def verdicts(
    tables: tuple[Array, Array, Array],
    z: Array,
    dt: Array,
    after: Array,
    base: Array | None,
    blocks: Blocks | None,
    s: Array | None,
    roots: Array,
) -> tuple[Any, ...]: ...
def boxes_of(
    tables: tuple[Array, Array, Array],
    z: Array,
    dt: Array,
    after: Array,
    base: Array | None,
    widest: Array | None,
    numbers: NDArray[np.intp],
    count: int,
) -> tuple[Array, Array, Array]: ...
def normalised_columns(values: Array, k: NDArray[np.intp], steady: Any, scale: Any, out: Array) -> float: ...
def changes(values: Array, k: NDArray[np.intp]) -> tuple[NDArray[np.bool_], Array]: ...
def stretches(values: Array, limit: Array, least: int) -> list[tuple[int, int]]: ...
