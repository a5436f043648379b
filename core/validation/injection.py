# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Injected faults: recordings of a healthy machine as they were if a sensor, an actuator or its dynamics had failed.

A sensor fault changes readings alone. Of an actuator, or of the dynamics, the machine's response is needed: the states
are changed by what the nominal (scheduled) model makes of the difference,

    x'_{k+1} = x_{k+1} + f'(x'_k, u'_k) - f(x_k, u_k),   f(x, u) = x + Δt (A x + B u + c),

with u' what the actuator really did and f' the changed dynamics; the recorded u stays as commanded. It is exact for a
linear plant that the model describes. Otherwise it is an approximation: what the nominal model leaves unexplained
stays as recorded, and no controller reacts to the fault.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.signals.signal_map import Recalled


@dataclass(frozen=True)
class Kind:
    """A kind of fault.

    `of`: what fails: `sensor` (of a state), `actuator` (a control) or `dynamics` (of a state); `unit`: of its size:
    `recorded` (that of the signal), `rate` (that per s), `share`, or `s`; `words`: what happens; `both`: whether it may
    be of either sign.
    """

    of: str
    unit: str
    words: str
    both: bool = False


KINDS: Mapping[str, Kind] = {
    "bias": Kind("sensor", "recorded", "the reading is off by the size", True),
    "drift": Kind("sensor", "rate", "the reading moves off by the size in every second", True),
    "scale": Kind("sensor", "share", "the reading is too large or too small by this share of itself", True),
    "noise": Kind("sensor", "recorded", "normal noise of this standard deviation is added to the reading"),
    "freeze": Kind("sensor", "s", "the reading holds its last value for so long"),
    "dropout": Kind("sensor", "s", "the reading is 0 for so long"),
    "spike": Kind("sensor", "recorded", "one reading is off by the size", True),
    "sensor_delay": Kind("sensor", "s", "the reading is that of so long ago"),
    "stuck": Kind("actuator", "s", "the actuator holds its place for so long"),
    "loss": Kind("actuator", "share", "the actuator does this share less than commanded"),
    "offset": Kind("actuator", "recorded", "the actuator is off by the size", True),
    "actuator_delay": Kind("actuator", "s", "the actuator does what was commanded so long ago"),
    "time_constant": Kind("dynamics", "share", "the state follows slower, or faster, by this share", True),
    "gain": Kind("dynamics", "share", "all controls move the state more, or less, by this share", True),
}
"""Kinds of fault by name."""


@dataclass(frozen=True, eq=False)
class Windows:
    """Stretches of recordings of equal length, side by side, all with the onset of a fault at the same sample.

    `t` (W, L): instants, s; `x` (W, L, n): states, recorded units; NaN where there is none; `u` (W, L, m): controls,
    recorded units; `s` (W, L, q): further scheduling signals, recorded units; `onset`: the first sample of the fault.
    """

    t: Array
    x: Array
    u: Array
    s: Array
    onset: int


def faulty(windows: Windows, kind: str, i: int, size: Array, noise: Array, model: UncertainLTI) -> tuple[Array, Array]:
    """States and controls of many recordings at once, each with a fault of its own size.

    `size` (W,): size of the fault in each; `noise` (W, L): standard normal numbers; `model`: how the machine moves, for
    faults that change that, and what its controls recall of its states; Returns (W, L, n): states, recorded units;
    Returns (W, L, m): controls, recorded units: those of `windows`, but for the memories of states.
    """
    if KINDS[kind].of == "sensor":
        x = windows.x.copy()
        x[:, windows.onset :, i] = _reading(windows, kind, windows.x[:, :, i], size, noise)
    else:
        x = _response(windows, kind, i, size, model)
    if not (of_states := _of_states(model)):
        return x, windows.u
    n = model.n
    u, moved, dt = windows.u.copy(), np.nan_to_num(x - windows.x), np.diff(windows.t, axis=1)
    for r in of_states:
        for k in range(windows.onset, x.shape[1]):
            u[:, k, r.position - n] += _recall(r, moved[:, :, r.of], k, dt)
    return x, u


def _of_states(model: UncertainLTI) -> list[Recalled]:
    """Controls that are made of earlier values of states."""
    return [r for r in model.signals.recalled if r.of < model.n <= r.position < model.n + model.m]


def _recall(recalled: Recalled, moved: Array, k: int, dt: Array) -> Array:
    """What a memory (W,) makes at sample k of differences (W, L) of what it recalls."""
    memory = recalled.memory
    past = moved[:, k - memory.samples] if k >= memory.samples else np.zeros(len(moved))
    return np.asarray(memory.taken(moved[:, k], past, dt[:, k - 1] if k else 1.0))


_CHANGES: Mapping[str, Callable[[Array, Array, Array, Array], Array]] = {
    "bias": lambda true, size, since, noise: true + size,
    "offset": lambda true, size, since, noise: true + size,
    "drift": lambda true, size, since, noise: true + size * since,
    "scale": lambda true, size, since, noise: true * (1.0 + size),
    "loss": lambda true, size, since, noise: true * (1.0 - size),
    "noise": lambda true, size, since, noise: true + size * noise,
    "spike": lambda true, size, since, noise: true + size * (np.arange(true.shape[1]) == 0),
}
"""What becomes of true values from the onset on (W, L - onset), by kinds that need none from before."""


def _reading(windows: Windows, kind: str, true: Array, size: Array, noise: Array) -> Array:
    """Readings (W, L - onset) of a sensor from the onset on; of an actuator likewise what it does."""
    t, k = windows.t, windows.onset
    after, since, size = true[:, k:], t[:, k:] - t[:, k : k + 1], size[:, None]
    if kind in _CHANGES:
        return _CHANGES[kind](after, size, since, noise[:, k:])
    if kind in ("freeze", "stuck", "dropout"):
        held = np.zeros((len(t), 1)) if kind == "dropout" else true[:, [max(k - 1, 0)]]
        return np.where((since < size) & np.isfinite(after), held, after)
    late = np.empty_like(after)  # a delay
    for w, (row, wanted) in enumerate(zip(t, t[:, k:] - size, strict=True)):
        late[w] = true[w, np.maximum(np.searchsorted(row, wanted + 1e-9, side="right") - 1, 0)]
    return late


def _response(windows: Windows, kind: str, i: int, size: Array, model: UncertainLTI) -> Array:
    """States (W, L, n) of machines whose actuator or dynamics fail."""
    point = model.operating_point
    x, u, s = point.normalise_x(windows.x), point.normalise_u(windows.u), point.normalise_s(windows.s)
    done = windows.u.copy()
    n, m, dt, of_states = model.n, model.m, np.diff(windows.t, axis=1), _of_states(model)
    if KINDS[kind].of == "actuator":
        done[:, windows.onset :, i] = _reading(windows, kind, windows.u[:, :, i], size, np.empty((0, 0)))
        for r in model.signals.recalled:
            if r.of == n + i and n <= r.position < n + m:
                moved = done[:, :, i] - windows.u[:, :, i]
                for k in range(windows.onset, done.shape[1]):
                    done[:, k, r.position - n] += _recall(r, moved, k, dt)
    done = point.normalise_u(done)
    faster = np.where(size >= 0, 1.0 / (1.0 + np.abs(size)), 1.0 + np.abs(size))  # of the time constant: slower first
    moved_by = np.zeros_like(x)  # the difference that the fault makes
    first = windows.onset
    with np.errstate(over="ignore", invalid="ignore"):
        healthy, _ = model.centre_and_half(x[:, first:-1], u[:, first:-1], dt[:, first:], s[:, first:-1])
        for k in range(first, x.shape[1] - 1):
            before, step = x[:, k] + moved_by[:, k], dt[:, k]
            for r in of_states:
                at = r.position - n
                done[:, k, at] += _recall(r, moved_by[:, :, r.of] * point.X[r.of], k, dt) / point.U[at]
            faulty, _ = model.centre_and_half(before, done[:, k], step, s[:, k])
            faulty = faulty.copy()
            if kind == "time_constant":
                faulty[:, i] = before[:, i] + faster * (faulty[:, i] - before[:, i])
            elif kind == "gain":
                idle, _ = model.centre_and_half(before, np.zeros_like(u[:, k]), step, s[:, k])
                faulty[:, i] += size * (faulty[:, i] - idle[:, i])
            difference = faulty - healthy[:, k - first]
            # nothing is known of the machine where a sample is missing: the difference stays as it was
            known = np.isfinite(difference).all(axis=1, keepdims=True)
            moved_by[:, k + 1] = np.where(known, difference, moved_by[:, k])
        return np.asarray(windows.x + moved_by * point.X)
