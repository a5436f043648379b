# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Numbers in a recording that stand for no value, such as 2.146e9 as a position."""

from __future__ import annotations

import numpy as np

from uncertain_lti.base.arrays import Array

CODE_APART, CODE_OTHERS, CODE_LEAST, CODE_SIZE, MOST_CODES = 300.0, 10, 900.0, 1e9, 4
"""What makes a number one that stands for no value: distance over the range of the others, of which there are so many,
and its least size; or its size alone. At most so many are told apart."""


def too_small(low: float, high: float) -> bool:
    """Whether no number of a range can stand for no value."""
    return -CODE_LEAST < low and high < CODE_LEAST


def codes(values: Array) -> dict[float, int]:
    """Numbers that stand for no value, such as 2.146e9 as a position.

    A number is one if it is the least or the greatest of all, at least CODE_LEAST, stands there exactly several times,
    and lies CODE_APART times as far from the others as these spread; or if it is beyond CODE_SIZE where the others stay
    below a thousandth.

    `values` (samples,): in recorded units.
    """
    if len(values) and too_small(float(values.min()), float(values.max())):
        return {}  # the usual case, in a fraction of the time
    rest = values[np.isfinite(values)]
    found: dict[float, int] = {}
    while len(rest) and len(found) < MOST_CODES:
        for extreme in (float(rest.max()), float(rest.min())):
            others = rest[rest != extreme]
            count = len(rest) - len(others)
            if not len(others):
                return found
            low, high = float(others.min()), float(others.max())
            apart = max(extreme - high, low - extreme)
            several = (
                count > 1
                and abs(extreme) >= CODE_LEAST
                and len(np.unique(others[:1000])) >= CODE_OTHERS
                and apart > CODE_APART * (high - low)
            )
            if several or (abs(extreme) >= CODE_SIZE and max(abs(low), abs(high)) < 1e-3 * CODE_SIZE):
                found[extreme], rest = count, others
                break
        else:
            return found
    return found
