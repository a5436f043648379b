# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Part: a recording, or a block of one, judged by the model that was fitted without it, and how far from it it lies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.english import plural
from uncertain_lti.kernel.arithmetic import settled
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.alarm import back_and_restarts
from uncertain_lti.monitor.envelope_monitor import EnvelopeMonitor
from uncertain_lti.sampling.transient import Transient, Transitions

BEYOND, FAR = (0.1, 2.0), (1.0, 10.0)
"""Share of the range of a signal beyond it, and multiple of the largest leverage of the fit, from which on a sample is
beyond what was fitted, or far beyond."""
_SAME = 1e-12
_MOST = 200_000  # transitions that the leverage is made from, about


class Reach:
    """What a fit saw of the normalised [x; u; s]: ranges, and leverages z' (Σ z z')^-1 z with z = [x; u; 1]."""

    def __init__(self, model: UncertainLTI, transients: Sequence[Transient]) -> None:
        self._model = model
        every = [model.normalised_columns(t.transitions()) for t in transients]
        self._low = np.min([z.min(axis=1, initial=np.inf) for z in every], axis=0)[:, None]
        self._high = np.max([z.max(axis=1, initial=-np.inf) for z in every], axis=0)[:, None]
        stride = max(1, sum(z.shape[1] for z in every) // _MOST)
        some = self._lever(np.hstack([z[:, ::stride] for z in every]))
        self._scale = np.maximum(np.abs(some).max(axis=1, keepdims=True), 1e-300)
        scaled = some / self._scale
        self._inverse = np.linalg.pinv(scaled @ scaled.T, rcond=_SAME, hermitian=True)
        self._largest = float(self._leverage(some).max())

    def _lever(self, z: Array) -> Array:
        return np.vstack([z[: self._model.n + self._model.m], np.ones(z.shape[1])])

    def _leverage(self, lever: Array) -> Array:
        scaled = lever / self._scale
        return np.asarray(np.einsum("ik,ik->k", self._inverse @ scaled, scaled))

    def level(self, steps: Transitions) -> NDArray[np.intp]:
        """(K,): 0 where a transition begins within what was fitted, 1 beyond it, 2 far beyond."""
        z = self._model.normalised_columns(steps)
        found = np.zeros(z.shape[1], dtype=np.intp)
        span, leverage = self._high - self._low, self._leverage(self._lever(z))
        for level, (share, times) in enumerate((BEYOND, FAR), start=1):
            edge = share * span + _SAME * np.maximum(np.abs(self._low), np.abs(self._high))
            beyond = ((z < self._low - edge) | (z > self._high + edge)).any(axis=0)
            found[beyond | (leverage > times * self._largest)] = level
        return found


USUAL = 0.9
"""Share of the verdicts whose width a state's usual width is not below."""


@dataclass(frozen=True, repr=False)
class Part:
    """A recording, or a block of one, judged by the model that was fitted without it.

    `name`: what was left out; `dt` (K,): step of each judged transition, s; `utilisation` (K, n): (x_next - centre) /
    half of every judged transition; `starts`: positions at which the alarm restarts: 0, and after every step back in
    time; `violations` (n,): violated verdicts of each state at margin 1; `violated`: verdicts violated on any state at
    margin 1; `outside_domain`: verdicts from outside the domain fitted without this part; `unseen`: violated verdicts
    from inside that domain; `mean_width` (n,): of the left-out model's bounds on this part, recorded units; `max_width`
    (n,): the largest such width; `relative_width` (n,): the mean over that of the full model on the same samples;
    `group`: what was left out together with it; "" if it was left out alone; `model`: fitted without it; `transient`:
    what was left out; `longer` (K, H, n): utilisation by each horizon of the full model; NaN where a window is broken,
    or the left-out model has none; `longer_width` (H, n): mean width of the left-out model's envelopes over each
    horizon on this part, recorded units; NaN likewise; `residual` (K, n): x_next - centre of every judged transition,
    normalised; `longer_residual` (K, H, n): the same of each horizon; NaN as in `longer`; `judged_by`: the full model
    with the residuals of the left-out one: what a statistic on this part takes; `extrapolated` (K,): `Reach.level` of
    each judged transition; `usual_width`, `median_width` (n,): width that USUAL of them, and half of them, have at
    most, recorded units; `outside` (K, n): left its bounds at margin 1, which rounding decides where `utilisation` is
    about 1.
    """

    name: str
    dt: Array
    utilisation: Array
    starts: tuple[int, ...]
    violations: NDArray[np.intp]
    violated: int
    outside_domain: int
    unseen: int
    mean_width: Array
    max_width: Array
    relative_width: Array
    group: str = ""
    model: UncertainLTI | None = None
    transient: Transient | None = None
    longer: Array = field(default_factory=lambda: np.zeros((0, 0, 0)))
    longer_width: Array = field(default_factory=lambda: np.zeros((0, 0)))
    residual: Array = field(default_factory=lambda: np.zeros((0, 0)))
    longer_residual: Array = field(default_factory=lambda: np.zeros((0, 0, 0)))
    judged_by: UncertainLTI | None = None
    extrapolated: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    usual_width: Array = field(default_factory=lambda: np.zeros(0))
    median_width: Array = field(default_factory=lambda: np.zeros(0))
    outside: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))

    def __repr__(self) -> str:
        return f"Part({self.name!r}: {plural(self.judged, 'verdict')}, {self.violated} violated)"

    def without(self, left: NDArray[np.bool_]) -> Part:
        """The part without some of its verdicts, (K,), as if there had been none."""
        if not left.any():
            return self
        kept = ~left
        starts = sorted({int(np.count_nonzero(kept[:s])) for s in self.starts})
        count = int(np.count_nonzero(kept))
        names = ("dt", "utilisation", "outside", "longer", "residual", "longer_residual", "extrapolated")
        arrays: dict[str, Any] = {name: getattr(self, name) for name in names}
        changes = {name: a[kept] if len(a) == len(kept) else a for name, a in arrays.items()}
        return replace(self, starts=tuple(s for s in starts if s < count) or (0,), **changes)

    @property
    def judged(self) -> int:
        """Number of verdicts."""
        return len(self.dt)

    @property
    def hours(self) -> float:
        """Time under verdict, h."""
        return float(self.dt.sum()) / 3600.0

    @property
    def severity(self) -> Array:
        """(K,): the largest |utilisation| of the states; a verdict is violated where it exceeds the margin."""
        return np.asarray(np.abs(settled(self.utilisation, ~self.outside)).max(axis=1))

    @property
    def spans(self) -> list[tuple[int, int]]:
        """[start, stop) of the verdicts over which the alarm goes on from a cleared one."""
        return list(zip(self.starts, [*self.starts[1:], self.judged], strict=True))

    def rows(self, span: slice) -> list[Array]:
        """For `Alarm.over`: utilisation for one step and for each horizon, then the residuals."""
        longer, far = self.longer.transpose(1, 0, 2), self.longer_residual.transpose(1, 0, 2)
        return [row[span] for row in (self.utilisation, *longer, self.residual, *far)]


def judge(
    model: UncertainLTI,
    full: UncertainLTI,
    transient: Transient,
    name: str,
    group: str = "",
    reach: Reach | None = None,
) -> Part:
    """One left-out transient by the model fitted without it, through the monitor that judges live; margin 1."""
    verdicts = EnvelopeMonitor(model, 1, 1, 1.0).check(transient)
    judged = verdicts.judged & ~verdicts.withheld.any(axis=1)
    steps = transient.transitions()
    steps = steps.take(judged[steps.k + 1])
    found = verdicts.longer_utilisation[judged], verdicts.longer_residual[judged]
    longer, longer_residual, longer_width = _longer(model, full, steps, *found)
    width = (verdicts.upper - verdicts.lower)[judged]
    if full is model:
        whole = width
    else:
        _, half = full.columns_centre_and_half(full.normalised_columns(steps), steps.dt)
        whole = 2.0 * half.T * full.operating_point.X
    flags = verdicts.flags[judged] == 1.0
    resets = np.flatnonzero(back_and_restarts(transient.t_ns)[1])
    starts = sorted({0, *(int(np.count_nonzero(judged[:r])) for r in resets)})
    n = model.n
    empty = not len(width)
    utilisation = verdicts.utilisation[judged]
    return Part(
        name,
        steps.dt,
        utilisation,
        tuple(starts),
        flags.sum(axis=0),
        int(flags.any(axis=1).sum()),
        int(verdicts.outside_domain.sum()),
        int((flags.any(axis=1) & ~verdicts.outside_domain[judged]).sum()),
        np.full(n, np.nan) if empty else width.mean(axis=0),
        np.full(n, np.nan) if empty else width.max(axis=0),
        np.full(n, np.nan) if empty else width.mean(axis=0) / np.maximum(whole.mean(axis=0), 1e-300),
        group,
        model,
        transient,
        longer,
        longer_width,
        residual=verdicts.residual[judged],
        longer_residual=longer_residual,
        judged_by=full.with_residuals_of(model, instead=True),
        extrapolated=np.zeros(len(steps.dt), dtype=np.intp) if reach is None else reach.level(steps),
        outside=flags,
        usual_width=np.full(n, np.nan) if empty else np.quantile(width, USUAL, axis=0),
        median_width=np.full(n, np.nan) if empty else np.median(width, axis=0),
    )


def _longer(
    model: UncertainLTI, full: UncertainLTI, steps: Transitions, utilisation: Array, residual: Array
) -> tuple[Array, Array, Array]:
    """Utilisation, residuals and mean widths over the horizons of the full model, NaN where this one lacks one."""
    places = [model.steps.index(horizon.steps) if horizon.steps in model.steps else -1 for horizon in full.horizons]
    width = np.full((len(model.horizons) + 1, model.n), np.nan)
    if model.horizons:
        envelopes = model.envelopes(steps.k, model.normalised_columns(steps), steps.dt)
        for j, half in enumerate(half for _, _, half in envelopes):
            if half.size:
                width[j] = 2.0 * half.mean(axis=1) * model.operating_point.X
    with_none = ((0, 0), (0, 1), (0, 0))
    sizes, left = (np.pad(values, with_none, constant_values=np.nan)[:, places] for values in (utilisation, residual))
    return sizes, left, width[places]


def fitted_parts(model: UncertainLTI, transients: Sequence[Transient], most: float = math.inf) -> tuple[Part, ...]:
    """What was fitted, judged by the fit: all of it, or a stretch of each recording, so many transitions together."""
    runs = [t.scheduled_on([s.name for s in model.signals.scheduling]) for t in transients]
    share = most / max(sum(len(t) for t in runs), 1)
    if share < 1:
        runs = [t.replace(slice(0, max(2, int(share * len(t))))) for t in runs if len(t) > 1]
    return tuple(judge(model, model, run, run.name) for run in runs)


def unit_numbers(parts: Sequence[Part]) -> NDArray[np.intp]:
    """Number of what each part was left out with: its group, or a number of its own.

    Returns (parts,): from 0, in order of first appearance.
    """
    numbers: dict[str, int] = {}
    found = [
        numbers.setdefault(f"group {p.group}" if p.group else f"part {i}", len(numbers)) for i, p in enumerate(parts)
    ]
    return np.array(found, dtype=np.intp)


def by_unit(parts: Sequence[Part], values: ArrayLike) -> Array:
    """Sums over what was left out together."""
    values = np.asarray(values, dtype=np.float64)
    numbers = unit_numbers(parts)
    member = numbers[:, None] == np.arange(int(numbers.max(initial=-1)) + 1)
    return np.asarray(values @ member)


def rising(raised: NDArray[np.bool_], starts: Sequence[int]) -> int:
    """Rising edges of an alarm that restarts, cleared, at each of `starts`.

    `raised` (K,): whether the alarm is raised.
    """
    before = np.concatenate([[False], raised[:-1]])
    before[[s for s in starts if s < len(raised)]] = False
    return int(np.count_nonzero(raised & ~before))
