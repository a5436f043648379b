# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Choice of horizons: which envelopes over several steps hold on left-out data and see slower changes."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np

from uncertain_lti.base.errors import FitError
from uncertain_lti.base.text import plural
from uncertain_lti.identification import fit
from uncertain_lti.model.horizon import MOST_STEPS, Widths
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.proposal.search import EXCESS, PAYS, WORSE, Fold, Score, jackknife
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.values import HorizonRule
from uncertain_lti.validation.part import by_unit
from uncertain_lti.validation.result import Validation

MOST = 64
"""Steps of the longest horizon that is chosen; longer ones are listed one by one."""
SHARE = 0.1
"""Longest horizon that is tried where none is asked for, relative to the median recording."""
ALLOWED = 5 * EXCESS
"""Share of all left-out windows that may be outside beyond 1 + SLACK times the share of one step: a single transition
outside is in as many windows as they have steps."""


@dataclass(frozen=True, eq=False)
class HorizonCandidate(Score):
    """One horizon with one kind of half-widths, judged on what was left out of its fits.

    `steps`: number of steps; `widths`: half-widths; `log_width`: logarithm of the mean half-width relative to that of
    one step, the mean over states and left-out parts.
    """

    steps: int = 1
    widths: Widths = "growing"
    log_width: float = 0.0

    @property
    def per_step(self) -> float:
        """Mean half-width over the steps, relative to that of one step: how slow a change must be to pass unseen."""
        return math.exp(self.log_width) / self.steps

    def holds(self, base: Score) -> bool:
        """Whether its coverage does not speak against it."""
        share = base.outside.sum() / max(base.judged.sum(), 1.0)
        more, error = jackknife(self.outside - share * self.judged, self.judged)
        return self.excess(base) <= ALLOWED or more < min(error, WORSE)


def lengths_of(rule: HorizonRule, transients: Sequence[Transient]) -> list[int]:
    """Numbers of steps that a rule asks for, or that are to be tried."""
    steps = [t.dt[t.usable] for t in transients]
    every = np.concatenate(steps)
    if not len(every):
        return []
    step = float(np.median(every))
    if rule.steps:
        lengths = sorted(set(rule.steps))
    elif rule.seconds:
        lengths = sorted({round(value / step) for value in rule.seconds})
    else:
        longest = SHARE * float(np.median([s.sum() for s in steps])) if rule.longest is None else rule.longest
        last = min(round(longest / step), MOST)
        lengths = []
        while last >= 2:
            lengths.insert(0, last)
            last = round(last / 2)
    wanted = rule.steps or rule.seconds or rule.longest is not None
    if wanted and (not lengths or lengths[0] < 2):
        raise FitError(f"horizons: the median step is {step:.4g} s, and a horizon has at least two; give longer ones")
    if lengths and lengths[-1] > MOST_STEPS:
        raise FitError(f"horizons: {lengths[-1]} steps of {step:.4g} s; at most {MOST_STEPS} are possible")
    return lengths


def choose_horizons(
    transients: Sequence[Transient],
    rule: HorizonRule,
    lengths: Sequence[int],
    *,
    groups: Sequence[Any] | str | None = None,
    progress: Callable[[str], None] | None = None,
    **options: Any,
) -> tuple[dict[int, Widths], dict[str, Any]]:
    """Which horizons, and which half-widths, hold on what is left out of the fit, and the table.

    Each recording, group, or block of a single recording is left out in turn and judged. Of one horizon, half-widths
    that grow are taken if they are narrower by PAYS and no more of the left-out windows are outside than with constant
    ones: than 1 + SLACK times as many and ALLOWED, or than the standard error of the difference and WORSE; else
    constant ones. A horizon that was not asked for by its length stays if the same holds of its windows and the
    transitions of one step, and if its half-width per step is at most PAYS of that of the horizon before it: then it
    sees slower changes.
    """
    dropped: dict[int, str] = {}
    kinds: tuple[Widths, ...] = get_args(Widths) if rule.widths == "auto" else (rule.widths,)
    asked = bool(rule.steps or rule.seconds)
    found: dict[int, list[HorizonCandidate]] = {}
    facts: dict[str, Any] = {"left_out": "recording", "units": 0, "candidates": [], "chosen": {}}
    for kind in kinds:
        if progress is not None:
            progress(f"{kind} half-widths over {', '.join(map(str, lengths))} steps")
        model = fit(transients, describe_data=False, horizons=lengths, widths=kind, drop_horizons=True, **options)
        dropped |= {steps: _why_dropped(model, steps) for steps in lengths if steps not in model.steps}
        try:
            fold = Fold.of(transients, groups, model)
            left = fold.leave_out(transients, model, options)
        except FitError as error:
            _refuse_missing(model.steps, lengths if asked else (), dropped)
            chosen: dict[int, Widths] = {h.steps: "constant" for h in model.horizons} if asked else {}
            facts |= {"chosen": {str(h): w for h, w in chosen.items()}, "reason": f"nothing can be left out: {error}"}
            return chosen, facts
        one = Score.of(left)
        facts |= {"left_out": fold.what, "units": len(one.judged)}
        for j, horizon in enumerate(model.horizons):
            found.setdefault(horizon.steps, []).append(_judged(left, j, horizon.steps, kind))
    _refuse_missing(found, lengths if asked else (), dropped)
    chosen, facts["candidates"] = _decided(found, one, asked)
    facts |= {
        "chosen": {str(steps): widths for steps, widths in chosen.items()},
        "reason": _reason(chosen, found, dropped),
    }
    return chosen, facts


def _judged(left: Validation, j: int, steps: int, kind: Widths) -> HorizonCandidate:
    windows = [np.abs(part.longer[:, j]) for part in left.parts]
    logs = [
        float(np.mean(np.log(np.maximum(part.longer_width[j], 1e-300) / np.maximum(part.mean_width, 1e-300))))
        for part in left.parts
        if np.isfinite(part.longer_width[j]).all()
    ]
    return HorizonCandidate(
        by_unit(left.parts, [float(np.isfinite(w).all(axis=1).sum()) for w in windows]),
        by_unit(left.parts, [float((w > 1.0).any(axis=1).sum()) for w in windows]),
        steps,
        kind,
        float(np.mean(logs)) if logs else math.nan,
    )


def _refuse_missing(there: Collection[int], asked: Sequence[int], dropped: Mapping[int, str]) -> None:
    if missing := [h for h in asked if h not in there]:
        raise FitError(f"no horizon of {missing[0]} steps: {dropped[missing[0]]}")


def _why_dropped(model: UncertainLTI, steps: int) -> str:
    """What the fit says of a horizon that was asked for and is not in the model."""
    begin = f"no horizon of {steps} steps: "
    said = [text for text in model.fit_summary.get("messages", []) if text.startswith(begin)]
    return said[0].removeprefix(begin) if said else ""


def _decided(
    found: Mapping[int, Sequence[HorizonCandidate]], base: Score, asked: bool
) -> tuple[dict[int, Widths], list[dict[str, Any]]]:
    """Half-widths of each number of steps that is taken, and the table."""
    rows: list[dict[str, Any]] = []
    chosen: dict[int, Widths] = {}
    reached = 1.0
    for steps, candidates in sorted(found.items()):
        ordered = sorted(candidates, key=lambda one: one.widths)  # constant ones first
        best, other = ordered[0], ordered[-1]
        if other is not best and other.holds(best) and other.log_width <= best.log_width + math.log(PAYS):
            best = other
        why = "asked for" if asked else ""
        if not asked:
            if not best.judged.sum():
                why = "no left-out part is so long"
            elif not best.holds(base):
                why = f"{best.share:.1%} of the left-out windows are outside, {base.share:.1%} of the single steps"
            elif not best.per_step <= PAYS * reached:
                why = "sees no slower changes than the horizon before it"
        taken = asked or not why
        if taken:
            chosen[steps], reached = best.widths, best.per_step
        instead = "growing ones are narrower" if best.widths == "growing" else "constant ones hold as well"
        rows += [
            {
                "steps": steps,
                "widths": one.widths,
                "outside": one.share,
                "width": math.exp(one.log_width),
                "per_step": one.per_step,
                "taken": taken and one is best,
                "why": (why or "holds, and sees slower changes") if one is best else instead,
            }
            for one in ordered
        ]
    return chosen, rows


def _reason(
    chosen: Mapping[int, Widths], found: Mapping[int, Sequence[HorizonCandidate]], dropped: Mapping[int, str]
) -> str:
    """Why these, in words."""
    if not found:
        reason = "none has an envelope that is worth having" if dropped else "no recording is long enough for a horizon"
    elif not chosen:
        reason = "none holds on left-out data as well as one step and sees slower changes"
    else:
        last = max(chosen)
        best = next(one for one in found[last] if one.widths == chosen[last])
        reason = (
            f"{plural(last, 'step')}, {best.widths} half-widths: {1 - best.share:.2%} of the left-out windows "
            f"are inside, and the half-width is x {math.exp(best.log_width):.3g} of one step's"
        )
    return reason + "".join(f"; no horizon of {steps} steps: {why}" for steps, why in sorted(dropped.items()) if why)
