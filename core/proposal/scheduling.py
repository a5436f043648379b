# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Choice of a schedule: how many knots the recordings carry, by what is left out of the fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.english import plural
from uncertain_lti.base.errors import FitError
from uncertain_lti.identification import fit
from uncertain_lti.identification.regimes import Knots
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.validation.groups import resolve_groups
from uncertain_lti.validation.left_out import BLOCKS, block_spans, guard_interval, leave_out
from uncertain_lti.validation.part import by_unit
from uncertain_lti.validation.result import Validation

COUNTS = (1, 2, 3, 5)
"""Numbers of knots that are tried, ..."""
FURTHER = (7, 9)
"""... and those that follow while the last one tried is the best so far."""
FOLDS = 10
"""Times that something is left out, at most; of more recordings or groups, neighbours are left out together."""
SLACK = 0.25
"""Share of what one knot leaves outside of a left-out part by which more may be outside: the other recordings do not
represent such a part, and the narrower an envelope is, the more of it is outside."""
EXCESS = 0.00075
"""Share of all left-out transitions that may be outside beyond that, ..."""
MUCH, EXCESS_FOR_MUCH = 0.3, 0.005
"""... the mean width, relative to one knot, that is worth a greater one, and that one, ..."""
WORSE = 0.01
"""... and share that may be if it is within the standard error of the comparison."""
UNLIKE = 0.05
"""Share that one knot leaves outside of a left-out part, above which that part is unlike the other recordings: how much
more of it another number of knots leaves outside is chance, and must not hide what it does to the rest."""
TIMES = 2.5
"""Of recordings that are like others at most so many times what one knot leaves outside may be, ..."""
NEGLIGIBLE = 0.0002
"""... but this share of their transitions anyway."""
PAYS = 0.8
"""Mean width relative to one knot up to which more knots are worth having."""
FINEST = 1e-6
"""Width, relative to the range of its state, below which an envelope is no narrower than another."""


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


@dataclass(frozen=True, eq=False)
class Candidate:
    """One number of knots, judged on what was left out of its fits.

    `count`: knots of the signal; `model`: fitted to everything; None where there is no such fit; `refused`: why there
    is none, or why nothing could be left out of it; `judged` (units,): left-out transitions of each recording, group or
    block; `outside` (units,): those outside the bounds of some state; `log_width` (units,): logarithm of the mean width
    relative to one knot, the mean over the states.
    """

    count: int
    model: UncertainLTI | None = None
    refused: str = ""
    judged: Array = field(default_factory=lambda: np.zeros(0))
    outside: Array = field(default_factory=lambda: np.zeros(0))
    log_width: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def share(self) -> float:
        """Share of the left-out transitions outside."""
        return float(self.outside.sum() / self.judged.sum()) if self.judged.sum() else math.nan

    def more_outside(self, base: Candidate, of: NDArray[np.bool_] | None = None) -> tuple[float, float]:
        """Share outside beyond that of another candidate, with its standard error.

        `of` (units,): the left-out parts that count; default all.
        """
        of = np.ones(len(self.judged), dtype=bool) if of is None else of
        return jackknife((self.outside - base.outside)[of], self.judged[of])

    def excess(self, base: Candidate, of: NDArray[np.bool_] | None = None) -> float:
        """Share outside beyond what may be, summed over the left-out parts in which there is any.

        `of` (units,): the left-out parts that count; default those in which it is largest, all or the ones that are
        like others.
        """
        if of is None:
            return max(self.excess(base, parts) for parts in base.counted())
        beyond = np.maximum(self.outside - (1.0 + SLACK) * base.outside, 0.0)[of]
        return float(beyond.sum() / max(self.judged[of].sum(), 1.0))

    def counted(self) -> list[NDArray[np.bool_]]:
        """The sets of left-out parts on which coverage has to hold, of one knot.

        Returns (units,): all, and those of which it leaves at most UNLIKE outside if they are two at least, and half of
        all.
        """
        like = self.outside <= UNLIKE * self.judged
        every = np.ones(len(like), dtype=bool)
        return [every, like] if 1 < like.sum() < len(like) <= 2 * like.sum() else [every]

    @property
    def width(self) -> tuple[float, float]:
        """Logarithm of the mean width relative to one knot, with its standard error."""
        return jackknife(self.log_width * self.judged, self.judged)


@dataclass(frozen=True, eq=False)
class Choice:
    """The number of knots that the recordings carry on one signal.

    `signal`: name of the signal; `candidates`: all that were tried, one knot first; `chosen`: the one taken; `what`:
    what was left out at a time; `reason`: why, in words.
    """

    signal: str
    candidates: tuple[Candidate, ...]
    chosen: Candidate
    what: str
    reason: str

    def facts(self) -> dict[str, Any]:
        """As plain data for `fit_summary`."""
        base = self.candidates[0]
        rows = []
        for c in self.candidates:
            row: dict[str, Any] = {"knots": c.count}
            if c.model is not None:
                row["at"] = knots_of(c.model, self.signal)
            if c.refused:
                rows.append({**row, "refused": c.refused})
                continue
            more, more_error = c.more_outside(base)
            width, width_error = c.width
            rows.append(
                {
                    **row,
                    "outside": c.share,
                    "more_outside": more,
                    "more_outside_error": more_error,
                    "excess": c.excess(base),
                    "width": math.exp(width),
                    "width_error": math.exp(width) * width_error,
                }
            )
        return {
            "signal": self.signal,
            "left_out": self.what,
            "units": len(base.judged),
            "candidates": rows,
            "chosen": self.chosen.count,
            "reason": self.reason,
        }


class Trials:
    """Numbers of knots, judged one after the other on the same left-out parts.

    `transients`: the recordings; `others`: scheduling signals with their knots or modes, which every candidate has;
    `groups`: as in `validate`; `progress`: called with one line of text per candidate; `**options`: further ones of
    `fit`.
    """

    def __init__(
        self,
        transients: Sequence[Transient],
        others: Mapping[str, Knots] | None = None,
        *,
        groups: Sequence[Any] | str | None = None,
        progress: Callable[[str], None] | None = None,
        **options: Any,
    ) -> None:
        self.transients, self.others, self.options, self.progress = transients, dict(others or {}), options, progress
        model = fit(transients, schedule=self.others, describe_data=False, **options)
        self._baseline: Validation | None = None
        try:
            self.fold = fold_of(transients, groups, model)
        except FitError as error:
            self.fold = Fold(None, None, None, "recording")
            self.base = Candidate(1, model, str(error))
        else:
            self.base = self._left_out(1, model)

    def candidate(self, signal: str, count: int) -> Candidate:
        """One number of knots on one signal."""
        if self.progress is not None:
            self.progress(f"{plural(count, 'knot')} on {signal}")
        try:
            model = fit(self.transients, schedule={signal: count, **self.others}, describe_data=False, **self.options)
        except FitError as error:
            return Candidate(count, None, str(error))
        if tied := sum(data.tied_to is not None for data in model.block_data):
            return Candidate(
                count, model, f"{tied} of {plural(len(model.block_data), 'block')} would have too little data"
            )
        return self._left_out(count, model)

    def _left_out(self, count: int, model: UncertainLTI) -> Candidate:
        options = {k: v for k, v in self.options.items() if k != "operating_point"}  # that of the model is taken
        fold = self.fold
        try:
            left = leave_out(
                self.transients, full=model, groups=fold.groups, blocks=fold.blocks, gap=fold.gap, **options
            )
        except FitError as error:
            return Candidate(count, model, str(error))
        self._baseline = self._baseline or left
        return _judged(count, model, left, self._baseline)


def choose_knots(
    transients: Sequence[Transient],
    signal: str,
    others: Mapping[str, Knots] | None = None,
    *,
    groups: Sequence[Any] | str | None = None,
    progress: Callable[[str], None] | None = None,
    **options: Any,
) -> Choice:
    """How many knots the recordings carry on one signal: the simplest within the error of the best.

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
    trials = Trials(transients, others, groups=groups, progress=progress, **options)
    candidates = [trials.base]
    for count in (*COUNTS[1:], *FURTHER):
        if candidates[-1].refused or (count in FURTHER and candidates[-1] is not best_of(candidates)):
            break  # more knots would be refused likewise, or are worth nothing
        candidates.append(trials.candidate(signal, count))
    return decide(signal, candidates, trials.fold.what)


def knots_of(model: UncertainLTI, signal: str) -> list[float]:
    """Knots of one scheduling signal in recorded units."""
    if model.schedule is None:
        return []
    at = zip(model.schedule.axes, model.schedule.recorded_values(model.signals.signals), strict=True)
    return [value for axis, values in at if axis.signal == signal for value in values.tolist()]


def fold_of(
    transients: Sequence[Transient], groups: Sequence[Any] | str | None, base: UncertainLTI, folds: int = FOLDS
) -> Fold:
    """What is left out at a time, at most so many times."""
    names, _ = resolve_groups(transients, groups)
    if not names and len(transients) == 1:
        usable = int(transients[0].usable.sum())
        blocks = max(2, min(BLOCKS, folds, usable // 2))
        spans = [(transients[0], *span) for span in block_spans(transients[0], blocks)]
        return Fold(None, blocks, guard_interval(base, spans), "block")
    what = "group" if names else "recording"
    each = names or [str(i) for i in range(len(transients))]
    units = list(dict.fromkeys(each))
    if len(units) <= folds:
        return Fold(names or None, None, None, what)
    joined = {units[k]: str(i) for i, part in enumerate(np.array_split(np.arange(len(units)), folds)) for k in part}
    return Fold([joined[name] for name in each], None, None, f"{folds}th part of the {what}s")


def _judged(count: int, model: UncertainLTI, left: Validation, base: Validation) -> Candidate:
    parts = left.parts
    judged = np.array([part.judged for part in parts], dtype=np.float64)
    span = (model.domain.x_max - model.domain.x_min) * model.operating_point.X
    floor = np.maximum(FINEST * span, 1e-300)
    ratios = np.array(
        [
            np.mean(np.log(np.maximum(mine.mean_width, floor) / np.maximum(one.mean_width, floor)))
            if mine.judged
            else 0.0
            for mine, one in zip(parts, base.parts, strict=True)
        ]
    )
    units = by_unit(parts, judged)
    return Candidate(
        count,
        model,
        "",
        units,
        by_unit(parts, [part.violated for part in parts]),
        by_unit(parts, judged * ratios) / np.maximum(units, 1.0),
    )


def jackknife(sums: Array, counts: Array) -> tuple[float, float]:
    """Σ sums / Σ counts, with its standard error over the units.

    `sums` (units,): of what was left out at a time; `counts` (units,): likewise.
    """
    total = counts.sum()
    value = float(sums.sum() / total) if total else math.nan
    rest = total - counts
    there = (counts > 0) & (rest > 0)
    if there.sum() < 2:
        return value, math.inf
    without = (sums.sum() - sums[there]) / rest[there]
    number = len(without)
    return value, float(np.sqrt((number - 1) / number * np.sum((without - without.mean()) ** 2)))


def _admissible(candidate: Candidate, base: Candidate) -> bool:
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


def best_of(candidates: Sequence[Candidate]) -> Candidate:
    """The least width among those that cover as well as one knot and whose widths pay; else one knot."""
    base = candidates[0]
    good = [c for c in candidates[1:] if _admissible(c, base) and c.width[0] <= math.log(PAYS)]
    return min(good, key=lambda c: c.width[0], default=base)


def decide(signal: str, candidates: Sequence[Candidate], what: str) -> Choice:
    """The simplest candidate within the error of the best, with the reason."""
    base, best = candidates[0], best_of(candidates)
    chosen = best
    if best is not base:
        limit = min(sum(best.width), math.log(PAYS))
        chosen = next(c for c in candidates[1:] if _admissible(c, base) and c.width[0] <= limit)
    return Choice(signal, tuple(candidates), chosen, what, _reason(candidates, best, chosen))


def _reason(candidates: Sequence[Candidate], best: Candidate, chosen: Candidate) -> str:
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
    nearest = min(narrow, key=lambda c: c.excess(base))
    return (
        f"with {nearest.count} knots {nearest.share:.1%} of the left-out transitions are outside, where one knot has "
        f"{base.share:.1%}{_like_words(nearest, base, inside=False)}"
    )


def _like_words(candidate: Candidate, base: Candidate, inside: bool) -> str:
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
