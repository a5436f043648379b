# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Search: fits compared on the same parts left out of each, which decide on knots and horizons."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import FitError
from uncertain_lti.base.text import plural
from uncertain_lti.identification import fit
from uncertain_lti.identification.regimes import Knots
from uncertain_lti.model.horizon import MOST_STEPS, Widths
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.values import HorizonRule
from uncertain_lti.validation.groups import resolve_groups
from uncertain_lti.validation.left_out import BLOCKS, block_spans, guard_interval, leave_out
from uncertain_lti.validation.part import by_unit
from uncertain_lti.validation.result import Validation

FOLDS = 10
"""Times that something is left out, at most; of more recordings or groups, neighbours are left out together."""
PAYS = 0.8
"""Mean width relative to the simpler candidate up to which another one is worth having."""
SLACK = 0.25
"""Share of what the simplest candidate leaves outside of a left-out part by which more may be outside: the other
recordings do not represent such a part, and the narrower an envelope is, the more of it is outside."""
EXCESS = 0.00075
"""Share of all left-out transitions that may be outside beyond that, ..."""
WORSE = 0.01
"""... and share that may be if it is within the standard error of the comparison."""


@dataclass(frozen=True)
class Fold:
    """How recordings are left out, the same way for every candidate.

    `groups`: one name per recording, where whole groups are left out; `blocks`: blocks of a single recording; `gap`:
    guard interval of the blocks, s; `what`: what is left out at a time: recording, group or block.
    """

    groups: list[str] | None
    blocks: int | None
    gap: float | None
    what: str

    @classmethod
    def of(
        cls, transients: Sequence[Transient], groups: Sequence[Any] | str | None, base: UncertainLTI, most: int = FOLDS
    ) -> Fold:
        """What is left out at a time, at most so many times."""
        names, _ = resolve_groups(transients, groups)
        if not names and len(transients) == 1:
            usable = int(transients[0].usable.sum())
            blocks = max(2, min(BLOCKS, most, usable // 2))
            spans = [(transients[0], *span) for span in block_spans(transients[0], blocks)]
            return cls(None, blocks, guard_interval(base, spans), "block")
        what = "group" if names else "recording"
        each = names or [str(i) for i in range(len(transients))]
        units = list(dict.fromkeys(each))
        if len(units) <= most:
            return cls(names or None, None, None, what)
        joined = {units[k]: str(i) for i, part in enumerate(np.array_split(np.arange(len(units)), most)) for k in part}
        return cls([joined[name] for name in each], None, None, f"{most}th part of the {what}s")

    def leave_out(self, transients: Sequence[Transient], model: UncertainLTI, options: Mapping[str, Any]) -> Validation:
        """Each part judged by the fit without it, on the schedule of the model."""
        own = {k: v for k, v in options.items() if k != "schedule"}
        return leave_out(transients, full=model, groups=self.groups, blocks=self.blocks, gap=self.gap, **own)


@dataclass(frozen=True, eq=False)
class Score:
    """What the left-out parts say of a candidate.

    `judged` (units,): left-out transitions, or windows, of each recording, group or block; `outside` (units,): those
    outside the bounds of some state.
    """

    judged: Array = field(default_factory=lambda: np.zeros(0))
    outside: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(cls, validation: Validation) -> Score:
        """Of one step."""
        parts = validation.parts
        return cls(by_unit(parts, [p.judged for p in parts]), by_unit(parts, [p.violated for p in parts]))

    @property
    def share(self) -> float:
        """Share of what was left out that is outside."""
        return float(self.outside.sum() / self.judged.sum()) if self.judged.sum() else math.nan

    def excess(self, base: Score, of: NDArray[np.bool_] | slice = slice(None)) -> float:
        """Share outside beyond 1 + SLACK times that of another in the same part, summed over the parts with any."""
        times = np.divide(self.judged, base.judged, out=np.zeros_like(self.judged), where=base.judged > 0)
        beyond = np.maximum(self.outside - (1.0 + SLACK) * base.outside * times, 0.0)[of]
        return float(beyond.sum() / max(self.judged[of].sum(), 1.0))


def jackknife(sums: Array, counts: Array) -> tuple[float, float]:
    """Σ sums / Σ counts over what was left out at a time (units,), with its standard error."""
    total = counts.sum()
    value = float(sums.sum() / total) if total else math.nan
    rest = total - counts
    there = (counts > 0) & (rest > 0)
    if there.sum() < 2:
        return value, math.inf
    without = (sums.sum() - sums[there]) / rest[there]
    number = len(without)
    return value, float(np.sqrt((number - 1) / number * np.sum((without - without.mean()) ** 2)))


COUNTS = (2, 3, 5)
"""Numbers of knots that are tried beside one, ..."""
FURTHER = (7, 9)
"""... and those that follow while the last one tried is the best so far."""
MUCH, EXCESS_FOR_MUCH = 0.3, 0.005
"""The mean width, relative to one knot, that is worth more than EXCESS outside, and how much."""
UNLIKE = 0.05
"""Share that one knot leaves outside of a left-out part, above which that part is unlike the other recordings: how much
more of it another number of knots leaves outside is chance, and must not hide what it does to the rest."""
TIMES = 2.5
"""Of recordings that are like others at most so many times what one knot leaves outside may be, ..."""
NEGLIGIBLE = 0.0002
"""... but this share of their transitions anyway."""
FINEST = 1e-6
"""Width, relative to the range of its state, below which an envelope is no narrower than another."""


@dataclass(frozen=True, eq=False)
class KnotCandidate(Score):
    """One number of knots, judged on what was left out of its fits.

    `count`: knots of the signal; `model`: fitted to everything; None where there is no such fit; `refused`: why there
    is none, or why nothing could be left out of it; `log_width` (units,): logarithm of the mean width relative to one
    knot, the mean over the states.
    """

    count: int = 1
    model: UncertainLTI | None = None
    refused: str = ""
    log_width: Array = field(default_factory=lambda: np.zeros(0))

    def more_outside(self, base: KnotCandidate, of: NDArray[np.bool_] | slice = slice(None)) -> tuple[float, float]:
        """Share outside beyond that of another candidate, with its standard error; `of` (units,): what counts."""
        return jackknife((self.outside - base.outside)[of], self.judged[of])

    def counted(self) -> list[NDArray[np.bool_]]:
        """The sets of left-out parts on which coverage has to hold, of one knot.

        Returns (units,): all, and those of which it leaves at most UNLIKE outside if they are two at least, and half of
        all.
        """
        like = self.outside <= UNLIKE * self.judged
        every = np.ones(len(like), dtype=bool)
        return [every, like] if 1 < like.sum() < len(like) <= 2 * like.sum() else [every]

    def worst(self, base: KnotCandidate) -> float:
        """The larger excess over one knot, of all parts or of those that are like others."""
        return max(self.excess(base, parts) for parts in base.counted())

    @property
    def width(self) -> tuple[float, float]:
        """Logarithm of the mean width relative to one knot, with its standard error."""
        return jackknife(self.log_width * self.judged, self.judged)

    def row(self, base: KnotCandidate, signal: str) -> dict[str, Any]:
        """Its line in the table."""
        row: dict[str, Any] = {"knots": self.count}
        if self.model is not None:
            row["at"] = knots_of(self.model, signal)
        if self.refused:
            return {**row, "refused": self.refused}
        more, more_error = self.more_outside(base)
        width, width_error = self.width
        return {
            **row,
            "outside": self.share,
            "more_outside": more,
            "more_outside_error": more_error,
            "excess": self.worst(base),
            "width": math.exp(width),
            "width_error": math.exp(width) * width_error,
        }


def choose_knots(
    transients: Sequence[Transient],
    signal: str,
    others: Mapping[str, Knots] | None = None,
    *,
    groups: Sequence[Any] | str | None = None,
    progress: Callable[[str], None] | None = None,
    **options: Any,
) -> tuple[KnotCandidate, dict[str, Any]]:
    """How many knots the recordings carry on one signal: the simplest within the error of the best, and the table.

    Each number of COUNTS, and those of FURTHER while the last one is the best, is fitted to all recordings, which
    places the knots, and then without each recording, group, or block of a single recording, which is judged.
    Coverage comes first: a number is refused if more than EXCESS of the left-out transitions are outside beyond
    1 + SLACK times those of one knot in the same part (EXCESS_FOR_MUCH, where the widths are at most MUCH of one
    knot's), unless the share outside exceeds that of one knot by less than
    its standard error, and by less than WORSE. That must hold of all parts, and of those alone that are like others
    (one knot leaves at most UNLIKE of them outside), if they are half of all: a recording that no other resembles
    has so large an error that it would excuse anything. Of the latter, more than TIMES what one knot leaves outside
    refuses a number as well (not if the widths are at most MUCH, nor a share up to NEGLIGIBLE). Of those whose mean
    width (geometric over states and left-out parts) is at most PAYS of one knot's, the one with the least width is the
    best, and the fewest knots within one standard error of it are chosen. Standard errors are those of the jackknife
    over what was left out.
    """
    beside, what = dict(others or {}), "recording"
    model: UncertainLTI | None = fit(transients, schedule=beside, describe_data=False, **options)
    assert model is not None
    try:
        fold = Fold.of(transients, groups, model)
        what = fold.what
        one = fold.leave_out(transients, model, options)
    except FitError as error:
        return decide(signal, [KnotCandidate(model=model, refused=str(error))], what)
    candidates = [_judged_knots(1, model, one, one)]
    for count in (*COUNTS, *FURTHER):
        if candidates[-1].refused or (count in FURTHER and candidates[-1] is not best_of(candidates)):
            break  # more knots would be refused likewise, or are worth nothing
        if progress is not None:
            progress(f"{plural(count, 'knot')} on {signal}")
        model = None
        try:
            model = fit(transients, schedule={signal: count, **beside}, describe_data=False, **options)
            if tied := sum(data.tied_to is not None for data in model.block_data):
                raise FitError(f"{tied} of {plural(len(model.block_data), 'block')} would have too little data")
            candidates.append(_judged_knots(count, model, fold.leave_out(transients, model, options), one))
        except FitError as error:
            candidates.append(KnotCandidate(count=count, model=model, refused=str(error)))
    return decide(signal, candidates, what)


def knots_of(model: UncertainLTI, signal: str) -> list[float]:
    """Knots of one scheduling signal in recorded units."""
    if model.schedule is None:
        return []
    at = zip(model.schedule.axes, model.schedule.recorded_values(model.signals.signals), strict=True)
    return [value for axis, values in at if axis.signal == signal for value in values.tolist()]


def _judged_knots(count: int, model: UncertainLTI, left: Validation, base: Validation) -> KnotCandidate:
    score, parts = Score.of(left), left.parts
    span = (model.domain.x_max - model.domain.x_min) * model.operating_point.X
    floor = np.maximum(FINEST * span, 1e-300)
    logs = [
        part.judged * float(np.mean(np.log(np.maximum(part.mean_width, floor) / np.maximum(one.mean_width, floor))))
        if part.judged
        else 0.0
        for part, one in zip(parts, base.parts, strict=True)
    ]
    return KnotCandidate(
        score.judged, score.outside, count, model, log_width=by_unit(parts, logs) / np.maximum(score.judged, 1.0)
    )


def _admissible(candidate: KnotCandidate, base: KnotCandidate) -> bool:
    """Whether its coverage does not speak against it."""
    if candidate.refused:
        return False
    much = candidate.width[0] <= math.log(MUCH)
    allowed = EXCESS_FOR_MUCH if much else EXCESS
    for parts in base.counted():
        more, error = candidate.more_outside(base, parts)
        if candidate.excess(base, parts) > allowed and more >= min(error, WORSE):
            return False
    like = base.counted()[-1]
    outside, one, judged = (float(a[like].sum()) for a in (candidate.outside, base.outside, base.judged))
    return much or outside <= max(TIMES * one, NEGLIGIBLE * judged)


def best_of(candidates: Sequence[KnotCandidate]) -> KnotCandidate:
    """The least width among those that cover as well as one knot and whose widths pay; else one knot."""
    base = candidates[0]
    good = [c for c in candidates[1:] if _admissible(c, base) and c.width[0] <= math.log(PAYS)]
    return min(good, key=lambda c: c.width[0], default=base)


def decide(signal: str, candidates: Sequence[KnotCandidate], what: str) -> tuple[KnotCandidate, dict[str, Any]]:
    """The simplest candidate within the error of the best, and the table with the reason."""
    base, best = candidates[0], best_of(candidates)
    chosen = best
    if best is not base:
        limit = min(sum(best.width), math.log(PAYS))
        chosen = next(c for c in candidates[1:] if _admissible(c, base) and c.width[0] <= limit)
    return chosen, {
        "signal": signal,
        "left_out": what,
        "units": len(base.judged),
        "candidates": [c.row(base, signal) for c in candidates],
        "chosen": chosen.count,
        "reason": _reason_for_knots(candidates, best, chosen),
    }


def _reason_for_knots(candidates: Sequence[KnotCandidate], best: KnotCandidate, chosen: KnotCandidate) -> str:
    """Why this one, in words."""
    base = candidates[0]
    if base.refused:
        return f"nothing can be left out: {base.refused}"
    if chosen is not base:
        inside, one = f"{1 - chosen.share:.4g}", f"{1 - base.share:.4g}"
        text = (
            f"on left-out data the mean width is x {math.exp(chosen.width[0]):.2g} of one knot's, with "
            f"{float(inside):.2%} inside, where one knot has {float(one):.2%}{_like_words(chosen, base, inside=True)}"
        )
        if chosen is not best:
            text += f"; {best.count} knots, x {math.exp(best.width[0]):.2g}, are within its error"
        return text
    judged = [c for c in candidates[1:] if not c.refused]
    if not judged:
        return candidates[1].refused if len(candidates) > 1 else "no other was tried"
    narrow = [c for c in judged if c.width[0] <= math.log(PAYS)]
    if not narrow:
        least = min(judged, key=lambda c: c.width[0])
        return (
            f"on left-out data the mean width with {least.count} knots is x {math.exp(least.width[0]):.2g} of one "
            f"knot's, with {least.share:.2%} outside (one knot {base.share:.2%}), which does not pay"
        )
    nearest = min(narrow, key=lambda c: c.worst(base))
    return (
        f"with {nearest.count} knots {nearest.share:.1%} of the left-out transitions are outside, where one knot has "
        f"{base.share:.1%}{_like_words(nearest, base, inside=False)}"
    )


def _like_words(candidate: KnotCandidate, base: KnotCandidate, inside: bool) -> str:
    """The same two shares where only some left-out parts are like others."""
    every, *likes = base.counted()
    if not likes:
        return ""
    shares = [float(c.outside[likes[0]].sum() / c.judged[likes[0]].sum()) for c in (candidate, base)]
    first, second = (f"{1 - share if inside else share:.2%}" for share in shares)
    return (
        f" ({first} and {second} without the {len(every) - int(likes[0].sum())} of {len(every)} parts that are unlike "
        f"the others, of which one knot leaves over {UNLIKE:.0%} outside)"
    )


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
            found.setdefault(horizon.steps, []).append(_judged_horizon(left, j, horizon.steps, kind))
    _refuse_missing(found, lengths if asked else (), dropped)
    chosen, facts["candidates"] = _decided(found, one, asked)
    facts |= {
        "chosen": {str(steps): widths for steps, widths in chosen.items()},
        "reason": _reason_for_horizons(chosen, found, dropped),
    }
    return chosen, facts


def _judged_horizon(left: Validation, j: int, steps: int, kind: Widths) -> HorizonCandidate:
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


def _reason_for_horizons(
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
