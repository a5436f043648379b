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
from dataclasses import dataclass, field
from typing import Any, get_args

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.english import plural
from uncertain_lti.base.errors import FitError
from uncertain_lti.identification import fit
from uncertain_lti.model.horizon import MOST_STEPS, Widths
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.proposal.scheduling import EXCESS, PAYS, SLACK, WORSE, fold_of, jackknife
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.choices import HorizonRule
from uncertain_lti.validation.left_out import leave_out
from uncertain_lti.validation.part import by_unit

MOST = 64
"""Steps of the longest horizon that is chosen; longer ones are listed one by one."""
SHARE = 0.1
"""Longest horizon that is tried where none is asked for, relative to the median recording."""
ALLOWED = 5 * EXCESS
"""Share of all left-out windows that may be outside beyond 1 + SLACK times the share of one step: a single transition
outside is in as many windows as they have steps."""


@dataclass(frozen=True, eq=False)
class HorizonCandidate:
    """One horizon with one kind of half-widths, judged on what was left out of its fits.

    `steps`: number of steps; `widths`: half-widths; `judged` (units,): left-out windows of each recording, group or
    block; `outside` (units,): those outside the envelope of some state; `log_width`: logarithm of the mean half-width
    relative to that of one step, the mean over states and left-out parts.
    """

    steps: int
    widths: Widths
    judged: Array = field(default_factory=lambda: np.zeros(0))
    outside: Array = field(default_factory=lambda: np.zeros(0))
    log_width: float = math.nan

    @property
    def share(self) -> float:
        """Share of the left-out windows outside."""
        return float(self.outside.sum() / self.judged.sum()) if self.judged.sum() else math.nan

    @property
    def per_step(self) -> float:
        """Mean half-width over the steps, relative to that of one step: how slow a change must be to pass unseen."""
        return math.exp(self.log_width) / self.steps

    def excess(self, base: HorizonCandidate) -> float:
        """Share outside beyond 1 + SLACK times that of another, over the parts in which there is any."""
        share = np.divide(base.outside, base.judged, out=np.zeros_like(base.judged), where=base.judged > 0)
        beyond = np.maximum(self.outside - (1.0 + SLACK) * share * self.judged, 0.0)
        return float(beyond.sum() / max(self.judged.sum(), 1.0))


@dataclass(frozen=True, eq=False)
class HorizonChoice:
    """The horizons that hold on left-out data.

    `chosen`: half-widths of each number of steps; empty if none is worth having; `rows`: the table: every candidate
    with its numbers, whether it was taken, and why; `what`: what was left out at a time; `units`: how many times;
    `reason`: in words.
    """

    chosen: dict[int, Widths]
    rows: tuple[dict[str, Any], ...]
    what: str
    units: int
    reason: str

    def facts(self) -> dict[str, Any]:
        """As plain data for `fit_summary`."""
        return {
            "left_out": self.what,
            "units": self.units,
            "candidates": list(self.rows),
            "chosen": {str(steps): widths for steps, widths in self.chosen.items()},
            "reason": self.reason,
        }


def _admissible(candidate: HorizonCandidate, base: HorizonCandidate) -> bool:
    """Whether its coverage does not speak against it."""
    share = base.outside.sum() / max(base.judged.sum(), 1.0)
    more, error = jackknife(candidate.outside - share * candidate.judged, candidate.judged)
    return candidate.excess(base) <= ALLOWED or more < min(error, WORSE)


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
) -> HorizonChoice:
    """Which horizons, and which half-widths, hold on what is left out of the fit.

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
    base: HorizonCandidate | None = None
    found: dict[int, dict[str, HorizonCandidate]] = {}
    what, units = "recording", 0

    def refuse_missing(there: Collection[int]) -> None:
        if missing := [h for h in lengths if h not in there]:
            if asked:
                raise FitError(f"no horizon of {missing[0]} steps: {dropped[missing[0]]}")

    for kind in kinds:
        if progress is not None:
            progress(f"{kind} half-widths over {', '.join(map(str, lengths))} steps")
        model = fit(transients, describe_data=False, horizons=lengths, widths=kind, drop_horizons=True, **options)
        dropped |= _dropped(model, lengths)
        try:
            fold = fold_of(transients, groups, model)
            left = leave_out(
                transients, full=model, groups=fold.groups, blocks=fold.blocks, gap=fold.gap,
                **{k: v for k, v in options.items() if k not in ("operating_point", "schedule")},
            )  # fmt: skip
        except FitError as error:
            text = f"nothing can be left out: {error}"
            refuse_missing(model.steps)
            chosen: dict[int, Widths] = {h.steps: "constant" for h in model.horizons} if asked else {}
            return HorizonChoice(chosen, (), what, 0, text)
        what = fold.what
        parts = left.parts
        judged = by_unit(parts, [part.judged for part in parts])
        units = len(judged)
        base = base or HorizonCandidate(1, "growing", judged, by_unit(parts, [part.violated for part in parts]), 0.0)
        for j, horizon in enumerate(model.horizons):
            windows = [np.abs(part.longer[:, j]) for part in parts]
            logs = [
                float(np.mean(np.log(np.maximum(part.longer_width[j], 1e-300) / np.maximum(part.mean_width, 1e-300))))
                for part in parts
                if np.isfinite(part.longer_width[j]).all()
            ]
            found.setdefault(horizon.steps, {})[kind] = HorizonCandidate(
                horizon.steps,
                kind,
                by_unit(parts, [float(np.isfinite(w).all(axis=1).sum()) for w in windows]),
                by_unit(parts, [float((w > 1.0).any(axis=1).sum()) for w in windows]),
                float(np.mean(logs)) if logs else math.nan,
            )
    assert base is not None
    refuse_missing(found)
    return _decided(found, base, asked, what, units, dropped)


def _dropped(model: UncertainLTI, lengths: Sequence[int]) -> dict[int, str]:
    """Of each horizon that was asked for and is not in the model what its fit says."""
    found = {}
    for steps in set(lengths) - set(model.steps):
        begin = f"no horizon of {steps} steps: "
        said = [text for text in model.fit_summary.get("messages", []) if text.startswith(begin)]
        found[steps] = said[0].removeprefix(begin) if said else ""
    return found


def _decided(
    found: dict[int, dict[str, HorizonCandidate]],
    base: HorizonCandidate,
    asked: bool,
    what: str,
    units: int,
    dropped: Mapping[int, str],
) -> HorizonChoice:
    """The table and what it says."""
    rows: list[dict[str, Any]] = []
    chosen: dict[int, Widths] = {}
    reached = 1.0
    for steps, kinds in sorted(found.items()):
        constant, growing = kinds.get("constant"), kinds.get("growing")
        best = constant or growing
        assert best is not None
        if constant is not None and growing is not None and _admissible(growing, constant):
            if growing.log_width <= constant.log_width + math.log(PAYS):
                best = growing
        why = "asked for" if asked else ""
        if not asked:
            if not best.judged.sum():
                why = "no left-out part is so long"
            elif not _admissible(best, base):
                why = f"{best.share:.1%} of the left-out windows are outside, {base.share:.1%} of the single steps"
            elif not best.per_step <= PAYS * reached:
                why = "sees no slower changes than the horizon before it"
        taken = asked or not why
        if taken:
            chosen[steps], reached = best.widths, best.per_step
        for one in (constant, growing):
            if one is None:
                continue
            other = "growing ones are narrower" if best is growing else "constant ones hold as well"
            rows.append(
                {
                    "steps": steps,
                    "widths": one.widths,
                    "outside": one.share,
                    "width": math.exp(one.log_width),
                    "per_step": one.per_step,
                    "taken": taken and one is best,
                    "why": (why or "holds, and sees slower changes") if one is best else other,
                }
            )
    if not found:
        reason = "none has an envelope that is worth having" if dropped else "no recording is long enough for a horizon"
    elif not chosen:
        reason = "none holds on left-out data as well as one step and sees slower changes"
    else:
        last = max(chosen)
        row = next(r for r in rows if r["steps"] == last and r["taken"])
        reason = (
            f"{plural(last, 'step')}, {row['widths']} half-widths: {1 - row['outside']:.2%} of the left-out windows "
            f"are inside, and the half-width is x {row['width']:.3g} of one step's"
        )
    reason += "".join(f"; no horizon of {steps} steps: {why}" for steps, why in sorted(dropped.items()) if why)
    return HorizonChoice(chosen, tuple(rows), what, units, reason)
