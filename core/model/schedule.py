# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Schedule: which block of a piecewise-linear uncertain model holds where, and with what weight.

With a scheduling vector s known at each sample, weights w_r(s) >= 0 that sum to 1, and one block of elements per r,

    x_{k+1} = x_k + dt Σ_r w_r(s_k) [(A_r ± ΔA_r) x_k + (B_r ± ΔB_r) u_k + c_r ± Δc_r] ± Σ_r w_r(s_k) v_r

Between two knots the weights are those of linear interpolation; a mode has weight 1 where s is that mode. Of two
scheduling signals the weights are multiplied. One block is the uncertain linear model of Leibov (2006).
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import LARGEST, Array
from uncertain_lti.base.errors import ModelError
from uncertain_lti.base.text import plural
from uncertain_lti.kernel.arithmetic import Blocks
from uncertain_lti.model.operating_point import recorded
from uncertain_lti.model.terms import object_of
from uncertain_lti.signals.signal_map import Signal

MOST_AXES = 2
"""Scheduling signals at most."""
MOST_BLOCKS = 1024
"""Blocks at most."""


@dataclass(frozen=True)
class Axis:
    """One scheduling signal with its knots or its modes.

    Parameters
    ----------
    signal : str
        Name of a state, a control or a further scheduling signal.
    knots : tuple of float, optional
        Knots, normalised, increasing; at least two. Between two of them the blocks are interpolated.
    modes : tuple of float, optional
        Values of a discrete signal, normalised, each with a block of its own; at least one.

    Raises
    ------
    ModelError
        There are both or neither, or they are not such numbers.
    """

    signal: str
    knots: tuple[float, ...] = ()
    modes: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        name = f"schedule: '{self.signal}'"
        for which in ("knots", "modes"):
            try:
                values = tuple(float(v) for v in getattr(self, which))
            except (TypeError, ValueError, OverflowError):
                raise ModelError(f"{name}: {which} are not numbers; list them") from None
            if not all(math.isfinite(v) and abs(v) <= LARGEST for v in values):
                raise ModelError(f"{name}: {which} hold a number that is not finite, or above {LARGEST:g}")
            object.__setattr__(self, which, values)
        if bool(self.knots) == bool(self.modes):
            raise ModelError(f"{name}: give knots or modes, one of the two")
        if len(self.knots) == 1:
            raise ModelError(f"{name} has one knot; give at least two, or leave the schedule out")
        if any(b <= a for a, b in zip(self.knots, self.knots[1:], strict=False)):
            raise ModelError(f"{name}: knots must increase, and are {reprlib.repr(list(self.knots))}")
        if len(set(self.modes)) < len(self.modes):
            raise ModelError(f"{name}: a mode is listed twice in {reprlib.repr(list(self.modes))}")

    @property
    def values(self) -> tuple[float, ...]:
        """Its knots or modes, normalised."""
        return self.knots or self.modes

    def __len__(self) -> int:
        return len(self.values)


@dataclass(frozen=True)
class BlockData:
    """What the fit knows of one block.

    `transitions`: fitted transitions of which this block has the largest weight; None where it is not known; `tied_to`:
    block whose elements it shares, because it has too few of its own.
    """

    transitions: int | None = None
    tied_to: int | None = None

    @property
    def known(self) -> bool:
        """Whether a recording visited it."""
        return self.transitions is None or self.transitions > 0


@dataclass(frozen=True)
class Schedule:
    """The axes of a scheduled model; blocks are numbered with the first axis slowest.

    Parameters
    ----------
    axes : tuple of Axis
        One or two.

    Raises
    ------
    ModelError
        There are more, none, two for one signal, or too many blocks.
    """

    axes: tuple[Axis, ...]

    def __post_init__(self) -> None:
        if not 1 <= len(self.axes) <= MOST_AXES:
            raise ModelError(f"schedule: {plural(len(self.axes), 'scheduling signal')}; give one or two")
        names = [axis.signal for axis in self.axes]
        if len(set(names)) < len(names):
            raise ModelError(f"schedule: '{names[0]}' is there twice; give each scheduling signal once")
        if self.blocks > MOST_BLOCKS:
            raise ModelError(f"schedule: {self.blocks} blocks; at most {MOST_BLOCKS} are possible")

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return math.prod(len(axis) for axis in self.axes)

    @cached_property
    def table(self) -> Blocks:
        """For the kernel."""
        return Blocks(self.axes)

    @cached_property
    def indices(self) -> tuple[tuple[int, ...], ...]:
        """Of each block the position of its knot or mode on each axis."""
        return tuple(product(*(range(len(axis)) for axis in self.axes)))

    def positions(self, names: Sequence[str]) -> tuple[int, ...]:
        """Where the scheduling signals are among these names of [x; u; further scheduling signals], one per axis."""
        for axis in self.axes:
            if axis.signal not in names:
                raise ModelError(
                    f"schedule: '{axis.signal}' is no state, control or scheduling signal; there are {', '.join(names)}"
                )
        return tuple(list(names).index(axis.signal) for axis in self.axes)

    def corners(self, s: ArrayLike) -> tuple[NDArray[np.intp], Array]:
        """The blocks that hold at normalised s (axes, K), and their weights.

        Both (C, K), C = 1, 2 or 4, the first axis slowest: numbers of blocks, -1 where a mode is not listed or a value
        is NaN, and weights that sum to 1, NaN there.
        """
        return self.table.at(s)

    def weights(self, s: ArrayLike) -> Array:
        """Weights (blocks, K) of every block at normalised s (axes, K); NaN where a mode is not listed or s is NaN."""
        places, corner_weights = self.corners(s)
        dense = np.zeros((self.blocks, places.shape[1]))
        column = np.arange(places.shape[1])
        for place, weight in zip(places, corner_weights, strict=True):
            dense[np.maximum(place, 0), column] += weight
        dense[:, places[0] < 0] = np.nan
        return dense

    def main_block(self, s: ArrayLike) -> NDArray[np.intp]:
        """The block of the largest weight at s (axes, K), of two alike the first; -1 for an unlisted mode."""
        places, weights = self.corners(s)
        found: NDArray[np.intp] = np.take_along_axis(places, np.argmax(weights, axis=0)[None], axis=0)[0]
        return found

    def beyond(self, s: ArrayLike) -> NDArray[np.bool_]:
        """Whether normalised s (axes, K) lies beyond the end knots of some axis; False for modes and for NaN."""
        s = np.asarray(s, dtype=np.float64)
        left = np.zeros(s.shape[1], dtype=bool)
        for axis, values in zip(self.axes, s, strict=True):
            if axis.knots:
                left |= (values < axis.knots[0]) | (values > axis.knots[-1])
        return left

    def recorded_values(self, signals: Sequence[Signal]) -> list[Array]:
        """Knots or modes of each axis in recorded units."""
        named = {signal.name: signal for signal in signals}
        each = [(np.array(axis.values), named[axis.signal]) for axis in self.axes]
        return [np.asarray(recorded(values, float(of.steady), float(of.scale))) for values, of in each]

    def block_name(self, r: int, signals: Sequence[Signal]) -> str:
        """Where one block holds, in recorded units, such as `fan_speed = 0.92`."""
        units = {signal.name: signal.unit for signal in signals}
        at = zip(self.axes, self.recorded_values(signals), self.indices[r], strict=True)
        return ", ".join(f"{axis.signal} = {values[k]:.6g} {units[axis.signal]}".rstrip() for axis, values, k in at)

    @property
    def words(self) -> str:
        """Its signals with their numbers of knots or modes."""
        return " and ".join(
            f"{axis.signal} ({plural(len(axis), 'knot' if axis.knots else 'mode')})" for axis in self.axes
        )

    def to_list(self) -> list[dict[str, Any]]:
        """As it is in a model file."""
        return [{"signal": axis.signal, ("knots" if axis.knots else "modes"): list(axis.values)} for axis in self.axes]

    @classmethod
    def from_list(cls, data: Any) -> Schedule:
        """From what `to_list` wrote."""
        if not isinstance(data, list):
            raise ModelError("field 'schedule' is not a list of scheduling signals")
        axes = []
        for i, entry in enumerate(data):
            here = f"schedule[{i}]"
            if not isinstance(entry, dict) or not isinstance(entry.get("signal"), str):
                raise ModelError(f"field '{here}' must be an object with 'signal' and 'knots' or 'modes'")
            values = object_of(entry, here, known=("knots", "modes", "signal"))
            signal = values.pop("signal")
            for key, value in values.items():
                if not isinstance(value, list) or any(isinstance(v, (bool, str)) or v is None for v in value):
                    raise ModelError(f"field '{here}.{key}' must be a list of numbers")
            axes.append(Axis(signal, **values))
        return cls(tuple(axes))
