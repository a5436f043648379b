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
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import Array, runs
from uncertain_lti.base.text import plural
from uncertain_lti.kernel.arithmetic import BEYOND, outside_domain
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.alarm import back_and_restarts
from uncertain_lti.monitor.envelope_monitor import EnvelopeMonitor
from uncertain_lti.sampling.transient import Transient, Transitions

REACHES = (BEYOND, 2.0), (1.0, 10.0)
"""Share of the range of a signal beyond it, and multiple of the largest leverage of the fit, from which on a sample is
beyond what was fitted, or far beyond."""
_SAME = 1e-12
_MOST = 200_000  # transitions that the leverage is made from, about


class Reach:
    """What a fit saw of the normalised [x; u; s]: ranges, and leverages z' (Σ z z')^-1 z with z = [x; u; 1]."""

    def __init__(self, model: UncertainLTI, transients: Sequence[Transient]) -> None:
        self._model = model
        every = [self._columns(t.transitions()) for t in transients]
        self._low = np.min([z.min(axis=1, initial=np.inf) for z in every], axis=0)
        self._high = np.max([z.max(axis=1, initial=-np.inf) for z in every], axis=0)
        stride = max(1, sum(z.shape[1] for z in every) // _MOST)
        some = self._lever(np.hstack([z[:, ::stride] for z in every]))
        self._scale = np.maximum(np.abs(some).max(axis=1, keepdims=True), 1e-300)
        scaled = some / self._scale
        self._inverse = np.linalg.pinv(scaled @ scaled.T, rcond=_SAME, hermitian=True)
        self._largest = float(self._leverage(some).max())

    def _columns(self, steps: Transitions) -> Array:
        """Those of a model, with 0 for what has no range to leave."""
        z, anywhere = self._model.normalised_columns(steps), self._model.domain.anywhere
        if anywhere is not None:
            z[np.flatnonzero(anywhere)] = 0.0
        return z

    def _lever(self, z: Array) -> Array:
        return np.vstack([z[: self._model.n + self._model.m], np.ones(z.shape[1])])

    def _leverage(self, lever: Array) -> Array:
        scaled = lever / self._scale
        return np.asarray(np.einsum("ik,ik->k", self._inverse @ scaled, scaled))

    def level(self, steps: Transitions) -> NDArray[np.intp]:
        """(K,): 0 where a transition begins within what was fitted, 1 beyond it, 2 far beyond."""
        z = self._columns(steps)
        found = np.zeros(z.shape[1], dtype=np.intp)
        leverage = self._leverage(self._lever(z))
        for level, (share, times) in enumerate(REACHES, start=1):
            found[outside_domain(z, self._low, self._high, share=share) | (leverage > times * self._largest)] = level
        return found


USUAL = 0.9
"""Share of the verdicts whose width a state's usual width is not below."""


@dataclass(frozen=True, repr=False)
class Part:
    """A recording, or a block of one, judged by the model that was fitted without it.

    `name`: what was left out; `group`: what was left out together with it; "" if it was left out alone; `model`: fitted
    without it; `judged_by`: the full model with the residuals of that one: what a statistic on this part takes;
    `transient`: what was left out; `dt` (K,): step of each judged transition, s; `starts`: positions at which the alarm
    restarts: 0, and after every step back in time; `utilisation` (K, n): (x_next - centre) / half; `outside` (K, n):
    left its bounds at margin 1, which rounding decides where `utilisation` is about 1; `residual` (K, n): x_next -
    centre, or less what a law expects, normalised; `longer`, `longer_residual` (K, H, n): utilisation and residual by
    each horizon of the full model; NaN where a window is broken, or the left-out model has none; `longer_width` (H, n):
    mean width of the left-out model's envelopes over each horizon on this part, recorded units; NaN likewise;
    `extrapolated` (K,): `Reach.level`; `outside_domain`: verdicts from outside the domain fitted without this part;
    `unseen`: violated verdicts from inside that domain; `mean_width`, `max_width` (n,): of the left-out model's bounds
    on this part, recorded units; `relative_width` (n,): the mean over that of the full model on the same samples;
    `usual_width` (n,): width that USUAL of the full model's bounds, which judge from now on, have at most there,
    recorded units; `median_width` (n,): the same of half of the left-out model's.
    """

    name: str
    group: str
    model: UncertainLTI
    judged_by: UncertainLTI
    transient: Transient
    dt: Array
    starts: tuple[int, ...]
    utilisation: Array
    outside: NDArray[np.bool_]
    residual: Array
    longer: Array
    longer_residual: Array
    longer_width: Array
    extrapolated: NDArray[np.intp]
    outside_domain: int
    unseen: int
    mean_width: Array
    max_width: Array
    relative_width: Array
    usual_width: Array
    median_width: Array

    def __repr__(self) -> str:
        return f"Part({self.name!r}: {plural(self.judged, 'verdict')}, {self.violated} violated)"

    def judged_as(self, full: UncertainLTI) -> Part:
        """The same by a full model whose residuals are of another form."""
        return replace(self, judged_by=full.with_residuals_of(self.model, instead=True))

    def without(self, left: NDArray[np.bool_]) -> Part:
        """The part without some of its verdicts, (K,), as if there had been none."""
        if not left.any():
            return self
        kept = ~left
        starts = sorted({int(np.count_nonzero(kept[:s])) for s in self.starts} - {int(np.count_nonzero(kept))})
        names = ("dt", "utilisation", "outside", "longer", "residual", "longer_residual", "extrapolated")
        arrays: dict[str, Any] = {name: getattr(self, name)[kept] for name in names}
        return replace(self, starts=tuple(starts) or (0,), **arrays)

    @property
    def judged(self) -> int:
        """Number of verdicts."""
        return len(self.dt)

    @property
    def violated(self) -> int:
        """Verdicts violated on any state at margin 1."""
        return int(self.outside.any(axis=1).sum())

    @property
    def hours(self) -> float:
        """Time under verdict, h."""
        return float(self.dt.sum()) / 3600.0

    @property
    def spans(self) -> list[tuple[int, int]]:
        """[start, stop) of the verdicts over which the alarm goes on from a cleared one."""
        return list(zip(self.starts, [*self.starts[1:], self.judged], strict=True))

    @property
    def rows(self) -> list[Array]:
        """For `Alarm.over`: utilisation for one step and for each horizon, then the residuals."""
        longer, far = self.longer.transpose(1, 0, 2), self.longer_residual.transpose(1, 0, 2)
        return [self.utilisation, *longer, self.residual, *far]


def judge(
    model: UncertainLTI,
    full: UncertainLTI,
    transient: Transient,
    name: str,
    group: str = "",
    level: Callable[[Transitions], NDArray[np.intp]] | None = None,
) -> Part:
    """One left-out transient by the model fitted without it, through the monitor that judges live; margin 1.

    `level`: as of `Reach`; default within what was fitted.
    """
    judging = model
    if full.residuals is not None and model.residuals is not None:  # those of the law, where the full model may take it
        form = model.residuals.alike(full.residuals.forms[-1])
        judging = model if form is None else model.replace(residuals=form)
    verdicts = EnvelopeMonitor(judging, 1, 1, 1.0).check(transient)
    judged = verdicts.judged & ~verdicts.withheld.any(axis=1)
    steps = transient.transitions()
    steps = steps.take(judged[steps.k + 1])
    spans = runs(judged)
    kept = slice(*spans[0]) if len(spans) == 1 else judged  # of one run no copies: of many states most of the memory
    resets = np.flatnonzero(back_and_restarts(transient.t_ns)[1])
    places = [model.steps.index(horizon.steps) if horizon.steps in model.steps else -1 for horizon in full.horizons]
    longer, longer_residual = np.full((2, len(steps.dt), len(places), model.n), np.nan)
    for j, place in enumerate(places):
        if place >= 0:
            longer[:, j] = verdicts.longer_utilisation[kept, place]
            longer_residual[:, j] = verdicts.longer_residual[kept, place]
    outside, outside_domain = verdicts.flags[kept] == 1.0, verdicts.outside_domain
    utilisation, residual = verdicts.utilisation[kept], verdicts.residual[kept]
    width = verdicts.upper[kept]
    width -= verdicts.lower[kept]
    del verdicts  # with what is not kept
    whole, own = width, np.full((len(model.horizons) + 1, model.n), np.nan)  # the last for a horizon that it lacks
    if full is not model:
        _, half = full.columns_centre_and_half(full.normalised_columns(steps), steps.dt)
        whole = 2.0 * half.T * full.operating_point.X
    if not len(width):
        width = whole = np.full((1, model.n), np.nan)
    if model.horizons:
        for j, (*_, half) in enumerate(model.envelopes(steps.k, model.normalised_columns(steps), steps.dt)):
            if half.size:
                own[j] = 2.0 * half.mean(axis=1) * model.operating_point.X
    return Part(
        name,
        group,
        model,
        full.with_residuals_of(model, instead=True),
        transient,
        steps.dt,
        tuple(sorted({0, *(int(np.count_nonzero(judged[:r])) for r in resets)})),
        utilisation,
        outside,
        residual,
        longer,
        longer_residual,
        own[places],
        np.zeros(len(steps.dt), dtype=np.intp) if level is None else level(steps),
        outside_domain=int(outside_domain.sum()),
        unseen=int((outside.any(axis=1) & ~outside_domain[judged]).sum()),
        mean_width=width.mean(axis=0),
        max_width=width.max(axis=0),
        relative_width=width.mean(axis=0) / np.maximum(whole.mean(axis=0), 1e-300),
        usual_width=np.quantile(whole, USUAL, axis=0),
        median_width=np.median(width, axis=0),
    )


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
    names = (f"group {p.group}" if p.group else f"part {i}" for i, p in enumerate(parts))
    return np.array([numbers.setdefault(name, len(numbers)) for name in names], dtype=np.intp)


def by_unit(parts: Sequence[Part], values: ArrayLike) -> Array:
    """Sums over what was left out together."""
    return np.asarray(np.bincount(unit_numbers(parts), weights=np.asarray(values)), dtype=np.float64)


def rising(raised: NDArray[np.bool_], starts: Sequence[int]) -> int:
    """Rising edges of an alarm that restarts, cleared, at each of `starts`.

    `raised` (K,): whether the alarm is raised.
    """
    before = np.concatenate([[False], raised[:-1]])
    before[[s for s in starts if s < len(raised)]] = False
    return int(np.count_nonzero(raised & ~before))
