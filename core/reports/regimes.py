# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Regimes of a scheduled model as plain data: what each block rests on, and what became of the verdicts in each."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.english import plural, shortlist
from uncertain_lti.model.operating_point import recorded
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.verdict import Verdicts
from uncertain_lti.reports.tables import list_of, numbers_of

MOST_REGIMES = 24
"""Regimes of one table that are printed."""
_MOST_NAMED = 6


def block_facts(model: UncertainLTI) -> list[dict[str, Any]]:
    """What each block of a scheduled model rests on, and how fast it is."""
    if model.schedule is None:
        return []
    point = model.operating_point
    fitted = list_of(model.fit_summary.get("blocks"))
    knots = model.schedule.recorded_values(model.signals.signals)
    facts = []
    for r, (data, values) in enumerate(zip(model.block_data, model.eigenvalues(), strict=True)):
        said = fitted[r] if r < len(fitted) and isinstance(fitted[r], Mapping) else {}
        widths = [numbers_of(said.get(key), model.n) for key in ("mean_width", "max_width")]
        axes = zip(model.schedule.axes, knots, model.schedule.indices[r], strict=True)
        facts.append(
            {
                "regime": model.block_name(r),
                "at": {axis.signal: float(values_of[k]) for axis, values_of, k in axes},
                "transitions": data.transitions,
                "tied_to": data.tied_to,
                "known": data.known,
                "mean_width": None if widths[0] is None else (np.array(widths[0]) * point.X).tolist(),
                "max_width": None if widths[1] is None else (np.array(widths[1]) * point.X).tolist(),
                "eigenvalues": [[float(v.real), float(v.imag)] for v in values],
                "time_constants": [-1.0 / float(v.real) if v.real < 0 else None for v in values],
            }
        )
    return facts


def blocks_in_words(model: UncertainLTI) -> list[str]:
    """What a reader should know of the blocks of a scheduled model."""
    if model.schedule is None:
        return []
    found = []
    unknown = [r for r, data in enumerate(model.block_data) if not data.known]
    tied = [r for r, data in enumerate(model.block_data) if data.tied_to is not None and data.known]
    if unknown:
        names = shortlist([model.block_name(r) for r in unknown], _MOST_NAMED)
        found.append(
            f"no recording visited {plural(len(unknown), 'regime')} of {model.schedule.blocks}, and no bound there can "
            f"be trusted: {names}; record the machine there, or leave the knots out"
        )
    if tied:
        names = shortlist(
            [f"{model.block_name(r)} (as {model.block_name(_tied(model, r))})" for r in tied], _MOST_NAMED
        )
        found.append(
            f"{plural(len(tied), 'regime')} of {model.schedule.blocks} had too little data for elements of "
            f"{'its' if len(tied) == 1 else 'their'} own: {names}"
        )
    if any(data.transitions is None for data in model.block_data):
        found.append("the model file does not say how much data each regime had")
    return found


def _tied(model: UncertainLTI, r: int) -> int:
    other = model.block_data[r].tied_to
    return r if other is None else other


def check_regimes(model: UncertainLTI, verdicts: Verdicts) -> list[dict[str, Any]]:
    """What became of the verdicts in each regime; a verdict belongs to the block of the largest weight."""
    if model.schedule is None:
        return []
    block, judged = _blocks(model, verdicts), verdicts.judged
    width, violated = verdicts.upper - verdicts.lower, verdicts.violated
    found = []
    for r in range(model.schedule.blocks):
        rows = np.flatnonzero(judged & (block == r))
        bad = (verdicts.flags[rows] == 1.0).sum(axis=0)
        own = (~np.isnan(verdicts.flags[rows])).sum(axis=0)  # without those withheld as a state is frozen
        total = np.nansum(width[rows], axis=0)
        found.append(
            {
                "regime": model.block_name(r),
                "verdicts": len(rows),
                "violated": int(violated[rows].sum()),
                "inside": _inside(int(violated[rows].sum()), len(rows)),
                "unknown_regime": int(verdicts.unknown_regime[rows].sum()),
                "states": {
                    name: {
                        "verdicts": int(own[i]),
                        "violations": int(bad[i]),
                        "inside": _inside(int(bad[i]), int(own[i])),
                        "mean_width": float(total[i] / own[i]) if own[i] else None,
                    }
                    for i, name in enumerate(model.state_names)
                },
            }
        )
    return found


def sample_blocks(model: UncertainLTI, verdicts: Verdicts) -> NDArray[np.intp]:
    """The block of the largest weight for the verdict on each sample.

    Returns (N+1,): its number; -1 where there is no verdict.
    """
    return np.where(verdicts.judged, _blocks(model, verdicts), -1)


def unknown_in_words(model: UncertainLTI, verdicts: Verdicts) -> list[str]:
    """Why regimes are unknown, and modes not in the model, each reason once with its count."""
    if model.schedule is None or not (verdicts.unknown_regime.any() or verdicts.unlisted_mode.any()):
        return []
    z, point, found = _before(model, verdicts), model.operating_point, []
    s = z[list(model.scheduling_positions)]
    judged = verdicts.judged
    for axis, i, values in zip(model.schedule.axes, model.scheduling_positions, s, strict=True):
        signal = model.signals.signals[i]
        unit = f" {signal.unit}" if signal.unit else ""
        steady, scale = float(point.steady[i]), float(point.scale[i])

        def numbers(those: Array, steady: float = steady, scale: float = scale) -> list[str]:
            return [f"{float(recorded(v, steady, scale)):.6g}" for v in those]

        if axis.knots:
            beyond = values[judged & ((values < axis.knots[0]) | (values > axis.knots[-1]))]
            if len(beyond):
                reached = " to ".join(dict.fromkeys(numbers(np.array([beyond.min(), beyond.max()]))))
                ends = " to ".join(numbers(np.array([axis.knots[0], axis.knots[-1]])))
                found.append(
                    f"{axis.signal} is beyond its knots, {ends}{unit}, in {plural(len(beyond), 'verdict')} ({reached})"
                )
        else:
            there = values[verdicts.unlisted_mode]
            odd = np.unique(there[~np.isin(there, axis.modes)])
            if len(odd):
                count = int(np.isin(values, odd)[verdicts.unlisted_mode].sum())
                strange = shortlist(numbers(odd), _MOST_NAMED)
                listed = shortlist(numbers(np.array(axis.modes)), _MOST_NAMED)
                found.append(
                    f"the model lists {axis.signal} = {listed}{unit}, and {plural(count, 'sample')} with {strange} "
                    f"{'has' if count == 1 else 'have'} no verdict"
                )
    if unknown := [r for r, data in enumerate(model.block_data) if not data.known]:
        rows = np.flatnonzero(verdicts.unknown_regime)
        places, weights = model.schedule.corners(s[:, rows])
        resting = {r: int(((places == r) & (weights > 0)).any(axis=0).sum()) for r in unknown}
        met = [f"{model.block_name(r)} ({plural(count, 'verdict')})" for r, count in resting.items() if count]
        if met:
            found.append(f"no recording visited {shortlist(met, _MOST_NAMED)}")
    return found


def _inside(bad: int, count: int) -> float | None:
    return 1.0 - bad / count if count else None


def _before(model: UncertainLTI, verdicts: Verdicts) -> Array:
    """Normalised [x; u; s] at the sample before each, (n + m + q, N+1); NaN where a verdict has none."""
    steps = verdicts.transient.transitions()
    z = np.full((model.n + model.m + model.q, len(verdicts.transient)), math.nan)
    z[:, steps.k + 1] = model.normalised_columns(steps)
    return z


def _blocks(model: UncertainLTI, verdicts: Verdicts) -> NDArray[np.intp]:
    return model.main_block(_before(model, verdicts))
