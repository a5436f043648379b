# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Foreseen: bounds at an instant to come."""

from __future__ import annotations

from typing import Any

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.monitor.verdict import place


class Foreseen:
    """Bounds at an instant to come.

    `t_ns`: the instant, ns; `bounds`: the lower bounds and then the upper ones, recorded units.
    """

    __slots__ = ("_bounds", "_n", "t_ns")

    def __init__(self, t_ns: int, bounds: Any) -> None:
        self.t_ns, self._bounds, self._n = t_ns, bounds, len(bounds) // 2

    @property
    def lower(self) -> Array:
        """Lower bounds (n,)."""
        return np.array(self._bounds[: self._n], dtype=np.float64)

    @property
    def upper(self) -> Array:
        """Upper bounds (n,)."""
        return np.array(self._bounds[self._n :], dtype=np.float64)

    def packed(self, wanted: frozenset[int] = frozenset()) -> bytes:
        """The bounds, where `Verdict.packed` has them."""
        n = self._n
        numbers = bytearray(place("utilisation", n).stop)
        numbers[place("lower", n)] = self._bounds[:n].tobytes()
        numbers[place("upper", n)] = self._bounds[n:].tobytes()
        return bytes(numbers)
