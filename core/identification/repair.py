# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Containment repair: half-widths lifted until the verdict's own arithmetic finds no training sample outside."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from uncertain_lti.base.arrays import Array, Index
from uncertain_lti.base.english import plural
from uncertain_lti.base.errors import FitError
from uncertain_lti.identification.fleet import Fleet
from uncertain_lti.identification.passes import Envelope, Judged, Moments

E = TypeVar("E", bound=Envelope)

_EPS = float(np.finfo(np.float64).eps)
_ROUNDS = 40


def repair(
    build: Callable[[Array, Array], E],
    fleet: Fleet,
    sums: Moments,
    theta: Array,
    d: Array,
    violation: Array,
    limits: tuple[Array, Array],
    units: Array,
    shared: Index | None = None,
    gentle: bool = False,
    names: Sequence[str] = (),
    sizes: Array | None = None,
) -> tuple[E, Array, Judged]:
    """Lift d until `Fleet.judge` finds nothing outside in any row.

    A solver leaves a violation of at most `violation` x (scaled size of the sample), and the size is linear in |z|,
    so lifting each element by violation x its unit covers it in every sample. What is left is rounding: a few ulps
    of |θ| + d for the products and sums and, for the state's own element, of 1 / Δt for the addition of x. What the
    structure fixes stays, to the bit; the other elements of the row cover its rounding.

    `theta` (r, n): nominal elements, 1/s; `d` (q, n): half-widths of the solver; `violation` (n,): times the size of a
    sample, which is the sum of |ψ| over their root mean squares; `limits` (q, n): least and largest half-widths that
    the structure allows; `units` (q, n): the size of a sample is units·ψ, of each row; 0 where a column is all zero;
    `shared` (q, n): of each half-width the first that it shares its value with; default none but itself; `sizes` (n,):
    largest |x| that the rates are added to; default that of the states. What the step does not multiply covers it;
    Returns (q, n): lifted.
    """
    n, p, columns = fleet.n, fleet.p, fleet.columns
    free = units > 0
    low, high = limits
    fixed = low == high
    movable = free & ~fixed
    lifted = np.where(fixed, d, d + units * np.maximum(violation, 0.0))
    blocks = (columns.count, -1, n)
    nominal, own = np.zeros(d.shape).reshape(blocks), np.zeros(d.shape).reshape(blocks)
    elements = np.abs(theta).reshape(blocks)
    nominal[:, :p] = elements[:, :p]
    for k, term in enumerate(columns.half, start=p):
        if term in columns.nominal:
            nominal[:, k] = elements[:, p + columns.nominal.index(term)]
    own[:, np.arange(n), np.arange(n)] = 1.0 / sums.dt_min
    if sizes is not None:
        for k, term in enumerate(columns.half, start=p):
            if not term.times_dt:
                own[:, k] = sizes
    base = np.clip(lifted, low, high)
    rounding = nominal.reshape(d.shape) + base + own.reshape(d.shape)
    for i in np.flatnonzero((fixed & (rounding > 0)).any(axis=0)):  # the others carry what these cannot
        share = float(sums.psi_scale @ (rounding[:, i] * fixed[:, i]))
        rounding[:, i] += units[:, i] * share
    if shared is not None:  # they stay equal to the bit
        most = np.zeros(d.shape)
        np.maximum.at(most, (shared, np.arange(n)), rounding)
        rounding = most[shared, np.arange(n)]
    todo = np.ones(n, dtype=bool)
    lifted = base
    for attempt in range(-6 if gentle else 0, _ROUNDS):
        ulps = 2.0 ** (attempt + 2) * _EPS * rounding * movable
        lifted = np.where(todo, np.minimum(base + ulps, high), lifted)
        model = build(theta, lifted)
        judged = fleet.judge(model)
        todo = judged.outside > 0
        if not todo.any():
            return model, lifted, judged
        if not movable[:, todo].any(axis=0).all():
            break
    row = int(np.argmax(todo))
    if fixed[free[:, row], row].any():
        raise FitError(
            f"structure: with half-widths that are fixed, '{names[row]}' leaves "
            f"{plural(int(judged.outside[row]), 'transition')} outside, by rounding at least; let a half-width of "
            f"this row be free, or use an additive term"
        )
    raise FitError(
        f"containment could not be repaired in row {int(np.argmax(todo))}: the signals differ too much in scale; "
        f"give steady and scale that bring them to order one"
    )
