# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What can go wrong with the turbofan: an actuator, a sensor or a component, from an instant on."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import UncertainLTIError
from uncertain_lti.plants.turbofan import CONTROLS, STATES, Health

KINDS = {
    "fuel_stuck": "the fuel flow stays where it is, whatever is commanded",
    "nozzle_stuck": "the nozzle area stays where it is, whatever is commanded",
    "sensor_bias": "the reading of the compressor exit pressure jumps by 2 % of its scale",
    "sensor_drift": "the reading of the turbine exit temperature drifts by 0.2 % of its scale per second",
    "compressor_wear": "the compressor loses efficiency at 0.1 % per second, down to 3 % less",
    "fan_damage": "the fan loses 2 % of its efficiency at once",
}
"""Kinds of fault, each with what happens; the sizes are the ones below."""

BIAS, DRIFT = 0.02, 0.002  # of the scale; of the scale per s
WEAR, WORST_WEAR = 0.001, 0.03  # of the efficiency per s; at most
DAMAGE = 0.02  # of the efficiency


@dataclass(frozen=True)
class Fault:
    """A kind of fault and the instant of its onset.

    `kind`: one of KINDS; `at`: onset, s after the first sample; `size`: of the fault, over the size that KINDS states:
    2 is a bias, a drift, a rate of wear or a loss twice as large.
    """

    kind: str
    at: float
    size: float = 1.0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise UncertainLTIError(f"turbofan: there is no fault '{self.kind}'; there are {', '.join(KINDS)}")
        if not 0.0 < self.size < math.inf:
            raise UncertainLTIError(f"turbofan: a fault of size {self.size:g}; it must be a positive number")
        if self.size != 1.0 and self.kind.endswith("stuck"):
            raise UncertainLTIError(
                f"turbofan: {self.kind} of size {self.size:g}; what is stuck has no size, leave it 1"
            )

    def first_sample(self, dt: float) -> int:
        """The first sample that can show it: a sensor's at the onset, anything else one step later."""
        onset = int(np.ceil(self.at / dt - 1e-9))
        return onset if self.kind.startswith("sensor") else onset + 1

    def health(self, t: float) -> Health:
        """Efficiency factors at one instant."""
        if self.kind == "compressor_wear" and t > self.at:
            return Health(compressor=1.0 - self.size * min(WEAR * (t - self.at), WORST_WEAR))
        if self.kind == "fan_damage" and t >= self.at:
            return Health(fan=1.0 - self.size * DAMAGE)
        return Health()

    def reading(self, t: float, x: Array, X: Array) -> Array:
        """What the sensors read.

        `x` (5,): states, recorded units; `X` (5,): scales of the states; Returns (5,): readings; `x` itself where no
        sensor is at fault.
        """
        if t < self.at or not self.kind.startswith("sensor"):
            return x
        x = x.copy()
        if self.kind == "sensor_bias":
            i = STATES.index("compressor_exit_total_pressure")
            x[i] += self.size * BIAS * X[i]
        else:
            i = STATES.index("turbine_exit_total_temperature")
            x[i] += self.size * DRIFT * (t - self.at) * X[i]
        return x

    def stuck(self, t: float) -> int | None:
        """Position of the control that no longer follows its command, if any."""
        if t < self.at:
            return None
        return {
            "fuel_stuck": CONTROLS.index("main_fuel_flow"),
            "nozzle_stuck": CONTROLS.index("nozzle_throat_area"),
        }.get(self.kind)
