# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Arrays of numbers: their types, what becomes one of real numbers, and the largest numbers that a file may state."""

from __future__ import annotations

from typing import Any

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
    """A copy as real numbers; TypeError for complex ones, whose imaginary part numpy would drop."""
    if np.iscomplexobj(values):
        raise TypeError("complex numbers")
    return np.array(values, dtype=np.float64)


LONGEST_S = 9e9
"""s; 2^63 ns are 9.2e9 s."""
LARGEST = 1e50
"""Magnitude of a number in recorded units or in 1/s, and of a scale or its inverse: squares of ratios stay finite."""
