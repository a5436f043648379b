# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.sampling.clock import Counters, Status
from uncertain_lti.signals.signal_map import SignalMap

Integers = NDArray[np.int64]
Values = NDArray[np.float64]

BUFFERED_MESSAGES: int
REMEMBERED_SAMPLES: int
KEPT_OVER_A_JUMP: int

class Step:
    status: Status
    t_ns: int
    arrival_ns: int
    dt: float
    before: Sequence[float]
    after: Sequence[float]
    def __init__(
        self, status: Status, t_ns: Any, arrival_ns: Any, dt: float, before: Sequence[float], after: Sequence[float]
    ) -> None: ...
    @property
    def x(self) -> Values: ...
    @property
    def u(self) -> Values: ...
    @property
    def x_next(self) -> Values: ...

class Sampler:
    signals: SignalMap
    clock: str
    max_gap_ns: int
    min_step_ns: int
    counters: Counters
    number: int
    def __init__(self, signals: SignalMap) -> None: ...
    def push(self, topic: str, arrival_ns: int, stamp_ns: int | None, values: Sequence[float]) -> list[Step]: ...
    def push_all(
        self, topic: Integers, arrival: Integers, stamp: Integers, values: Sequence[Values]
    ) -> tuple[tuple[Integers, Values, Values], tuple[Integers, Integers, NDArray[np.bool_], Integers]]: ...
    def kept(self, topic: str) -> list[tuple[int, int, list[float]]]: ...
    def latest(self) -> tuple[int, list[float]] | None: ...

def all_finite(values: Sequence[float]) -> bool: ...
