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
from uncertain_lti.base.errors import FitError
from uncertain_lti.base.text import plural
from uncertain_lti.identification import fit
from uncertain_lti.identification.regimes import Knots
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.proposal.search import EXCESS, PAYS, WORSE, Fold, Score, jackknife
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.validation.part import by_unit
from uncertain_lti.validation.result import Validation

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
class Candidate(Score):
    """One number of knots, judged on what was left out of its fits.

    `count`: knots of the signal; `model`: fitted to everything; None where there is no such fit; `refused`: why there
    is none, or why nothing could be left out of it; `log_width` (units,): logarithm of the mean width relative to one
    knot, the mean over the states.
    """

    count: int = 1
    model: UncertainLTI | None = None
    refused: str = ""
    log_width: Array = field(default_factory=lambda: np.zeros(0))

    def more_outside(self, base: Candidate, of: NDArray[np.bool_] | slice = slice(None)) -> tuple[float, float]:
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

    def worst(self, base: Candidate) -> float:
        """The larger excess over one knot, of all parts or of those that are like others."""
        return max(self.excess(base, parts) for parts in base.counted())

    @property
    def width(self) -> tuple[float, float]:
        """Logarithm of the mean width relative to one knot, with its standard error."""
        return jackknife(self.log_width * self.judged, self.judged)

    def row(self, base: Candidate, signal: str) -> dict[str, Any]:
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
) -> tuple[Candidate, dict[str, Any]]:
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
        return decide(signal, [Candidate(model=model, refused=str(error))], what)
    candidates = [_judged(1, model, one, one)]
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
            candidates.append(_judged(count, model, fold.leave_out(transients, model, options), one))
        except FitError as error:
            candidates.append(Candidate(count=count, model=model, refused=str(error)))
    return decide(signal, candidates, what)


def knots_of(model: UncertainLTI, signal: str) -> list[float]:
    """Knots of one scheduling signal in recorded units."""
    if model.schedule is None:
        return []
    at = zip(model.schedule.axes, model.schedule.recorded_values(model.signals.signals), strict=True)
    return [value for axis, values in at if axis.signal == signal for value in values.tolist()]


def _judged(count: int, model: UncertainLTI, left: Validation, base: Validation) -> Candidate:
    score, parts = Score.of(left), left.parts
    span = (model.domain.x_max - model.domain.x_min) * model.operating_point.X
    floor = np.maximum(FINEST * span, 1e-300)
    logs = [
        part.judged * float(np.mean(np.log(np.maximum(part.mean_width, floor) / np.maximum(one.mean_width, floor))))
        if part.judged
        else 0.0
        for part, one in zip(parts, base.parts, strict=True)
    ]
    return Candidate(
        score.judged, score.outside, count, model, log_width=by_unit(parts, logs) / np.maximum(score.judged, 1.0)
    )


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


def decide(signal: str, candidates: Sequence[Candidate], what: str) -> tuple[Candidate, dict[str, Any]]:
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
        "reason": _reason(candidates, best, chosen),
    }


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
    nearest = min(narrow, key=lambda c: c.worst(base))
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
