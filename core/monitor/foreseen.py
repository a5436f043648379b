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

from dataclasses import dataclass

from uncertain_lti.base.arrays import Array
from uncertain_lti.monitor.verdict import place


@dataclass(frozen=True)
class Foreseen:
    """Bounds at an instant to come.

    Parameters
    ----------
    t_ns : int
        The instant, ns.
    lower, upper : array (n,)
        The bounds, recorded units.
    """

    t_ns: int
    lower: Array
    upper: Array

    def packed(self, wanted: frozenset[int] = frozenset()) -> bytes:
        """The bounds, where `Verdict.packed` has them.

        Parameters
        ----------
        wanted : frozenset of int, optional
            Not looked at.

        Returns
        -------
        bytes
            Little-endian doubles; zeros for all but lower and upper.
        """
        n = len(self.lower)
        numbers = bytearray(place("utilisation", n).stop)
        for name, bound in (("lower", self.lower), ("upper", self.upper)):
            numbers[place(name, n)] = bound.astype("<f8").tobytes()
        return bytes(numbers)
