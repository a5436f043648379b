# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Search: fits compared on the same parts left out of each, which decide on knots, horizons, memories and ends."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import FitError, UncertainLTIError
from uncertain_lti.base.text import plural
from uncertain_lti.identification import fit
from uncertain_lti.identification.evidence import from_both_ends, left, size_of
from uncertain_lti.identification.regimes import Knots
from uncertain_lti.model.horizon import MOST_STEPS, Widths
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.signal import At
from uncertain_lti.signals.values import HorizonRule
from uncertain_lti.validation.left_out import leave_out
from uncertain_lti.validation.monitor_fit import CLEARLY, FOLDS, fit_monitored
from uncertain_lti.validation.panel import learn
from uncertain_lti.validation.part import by_unit, fitted_parts
from uncertain_lti.validation.result import Validation

SLACK, EXCESS = 0.25, 0.005
"""Share of what the simplest candidate leaves outside of a left-out part by which another one may leave more, and share
of all that is left out that may be outside beyond that, times as many as the jumps seen are smaller: what resembles no
other recording is outside of any envelope, the more the narrower it is."""
PAYS = 0.8
"""Width of a horizon, or size of the jumps seen with a memory or with controls at the arrival, over those without, from
which on it is worth having."""
_OF_HORIZONS = 20_000  # transitions that horizons are chosen on, at most
PIECE = 200
"""Transitions of a piece of a larger recording."""


@dataclass(frozen=True, eq=False)
class Score:
    """What the left-out parts say of a candidate.

    `judged` (units,): left-out transitions, or windows, of each recording, group or block; `outside` (units,): those
    outside the bounds of some state; `width`: geometric mean over the states of the mean width there, recorded units;
    `figure`: as of `Panel`.
    """

    judged: Array
    outside: Array
    width: float = math.nan
    figure: float = math.inf

    @classmethod
    def of(cls, left: Validation, figure: float) -> Score:
        """Of one step."""
        parts = [part for part in left.parts if part.judged]
        widths = np.average([p.mean_width for p in parts], axis=0, weights=[p.judged for p in parts])
        judged = by_unit(left.parts, [p.judged for p in left.parts])
        outside = by_unit(left.parts, [p.violated for p in left.parts])
        return cls(judged, outside, _geometric(widths), figure)

    @property
    def share(self) -> float:
        """Share of what was left out that is outside."""
        return float(self.outside.sum() / self.judged.sum()) if self.judged.sum() else math.nan

    def excess(self, base: Score) -> float:
        """Share outside beyond 1 + SLACK times that of another candidate in the same part, summed over the parts."""
        times = np.divide(self.judged, base.judged, out=np.zeros_like(self.judged), where=base.judged > 0)
        beyond = np.maximum(self.outside - (1.0 + SLACK) * base.outside * times, 0.0)
        return float(beyond.sum() / max(self.judged.sum(), 1.0))

    def holds(self, base: Score) -> bool:
        """Whether its coverage does not speak against it."""
        return self.excess(base) * min(1.0, self.figure / base.figure) <= EXCESS


def _geometric(values: ArrayLike) -> float:
    return math.exp(float(np.mean(np.log(np.maximum(values, 1e-300))))) if np.size(values) else math.nan


def score_of(
    transients: Sequence[Transient], model: UncertainLTI, groups: Sequence[Any] | str | None, options: Mapping[str, Any]
) -> tuple[Score, Validation]:
    """What was left out of the fit with these options, on the schedule of the model. Raises FitError if nothing was."""
    own = {name: value for name, value in options.items() if name != "schedule"}
    left = leave_out(transients, full=model, groups=groups, folds=FOLDS, **own)
    return Score.of(left, learn(left, fitted_parts(model, transients)).figure), left


def _what(left: Validation) -> dict[str, Any]:
    """What was left out at a time, and how often."""
    what = f"{FOLDS}th part of the {left.what}s" if left.units > FOLDS else left.what
    return {"left_out": what, "units": min(left.units, FOLDS)}


ENOUGH, COMPARED = 20, 20_000
"""Transitions per signal from which on ends of steps are compared, and transitions on which they are."""
UNITS, FAR_BETTER = 3, 0.2
"""Recordings, groups or blocks from which on that decides, and share of the jumps that does so of two: of two runs at
one speed the arrival had jumps of a third, and ten times the false alarms at another speed."""


def choose_ends(transients: Sequence[Transient], **options: Any) -> tuple[At, str]:
    """At which end of a step the controls act, as far as nobody has said so, and why, in words, if not the departure.

    The arrival is taken, or both ends, if the jumps seen on what was left out are smaller by PAYS, of two recordings by
    FAR_BETTER (both only if clearly smaller still). It is not tried where that may be a controller's answer: a command
    that follows from the state at the arrival tells that state, and a fault that it follows hides. `options`: of
    `fit_monitored`.
    """
    if any(t.ends_given for t in transients):
        return "departure", ""
    few = thinned(transients, COMPARED)
    try:
        tried = {at: [t.controls_at(at) for t in few] for at in ("arrival", "both")}
        options |= {"schedule": {}, "describe_data": False}
        figures, units = dict[At, float](), 0
        for at in _promising_ends(few, tried["arrival"]):
            panel = fit_monitored(tried.get(at, few), **options).panel
            if panel is None or not panel.vouched:
                return "departure", ""
            figures[at], units = panel.figure, panel.units
    except UncertainLTIError:  # a control is a state, or too little is left
        return "departure", ""
    base, least = figures.get("departure", 0.0), min(figures.values(), default=0.0)
    if least >= (PAYS if units >= UNITS else FAR_BETTER) * base:
        return "departure", ""
    chosen = next(at for at, figure in figures.items() if CLEARLY * figure <= least)
    where = "the arrival" if chosen == "arrival" else "both ends"
    return chosen, (
        f"controls are taken at {where} of each step: on left-out data the alarm sees jumps x "
        f"{figures[chosen] / base:.2g} of those with controls at the departure; `at: departure` in the signals file "
        f"keeps them there"
    )


@np.errstate(all="ignore")  # what overflows is refused by the fit
def _promising_ends(transients: Sequence[Transient], arrival: Sequence[Transient]) -> list[At]:
    """Ends with which least squares leaves clearly less, unless the controls may answer to the state at the arrival.

    A command in force during the step moves the states as it does from the departure on, while a controller opposes
    them: the effects of what is new in the command are compared.
    """
    at = [np.flatnonzero(now.usable & end.usable) for now, end in zip(transients, arrival, strict=True)]

    def joined(runs: Sequence[Transient], name: str, later: int = 0) -> Array:
        return np.concatenate([getattr(t, name)[k + later] for t, k in zip(runs, at, strict=True)])

    X, U, after, V = *(joined(transients, name) for name in "xu"), joined(transients, "x", 1), joined(arrival, "u")
    free = np.array([a != b for a, b in zip(transients[0].ends, arrival[0].ends, strict=True)], dtype=bool)
    if not free.any() or len(X) < ENOUGH * (X.shape[1] + 2 * U.shape[1]):
        return []
    size = size_of(U)
    U, V, dX = U / size, (V / size)[:, free], after - X
    aligned, move, late = from_both_ends(X, U, V, dX, free)
    rest = {"arrival": left(np.hstack([X, U[:, ~free], V]), dX)[0], "both": move - late}
    floor = 1e-9 * np.ptp(after, axis=0) + 1e-300
    ratio = {at: (_rms(values) + floor) / (_rms(move) + floor) for at, values in rest.items()}
    gains = ratio["both"] < CLEARLY
    if not aligned[gains].all():
        return []
    better = [at for at in get_args(At) if at in ratio and _geometric(ratio[at]) < CLEARLY]
    return ["departure", *better] if better else []


def _rms(values: Array) -> Array:
    return np.asarray(np.sqrt((values**2).mean(axis=0)))


def thinned(transients: Sequence[Transient], most: int, piece: int = PIECE) -> list[Transient]:
    """Pieces of each recording, evenly spread, so that about this many transitions are left in total."""
    share = most / max(sum(len(t) for t in transients), 1)
    return list(transients) if share >= 1 else [_pieces(t, share, piece) for t in transients]


def _pieces(transient: Transient, share: float, piece: int) -> Transient:
    length = min(piece, max(20, int(share * len(transient))))
    count = max(1, round(share * len(transient) / length))
    if count * (length + 2) >= len(transient):
        return transient
    starts = np.linspace(0, len(transient) - length - 2, count).astype(int)
    keep = np.unique((starts[:, None] + np.arange(length + 2)).ravel())
    x = transient.x[keep]
    x[np.isin(keep, starts + length + 1)] = np.nan  # no transition from one piece to the next
    return transient.replace(keep, x=x)


COUNTS = (2, 3, 5)
"""Numbers of knots that are tried beside one, ..."""
FURTHER = (7, 9)
"""... and those that follow while the last one tried is chosen so far."""


@dataclass(frozen=True, eq=False)
class KnotCandidate:
    """One number of knots, judged on what was left out of its fits.

    `count`: knots of the signal; `model`: fitted to everything; None where there is no such fit; `score`: None where
    nothing could be left out; `refused`: why there is no fit or no score.
    """

    count: int
    model: UncertainLTI | None = None
    score: Score | None = None
    refused: str = ""

    def row(self, base: Score | None, signal: str) -> dict[str, Any]:
        """Its line in the table."""
        row: dict[str, Any] = {"knots": self.count}
        row |= {} if self.model is None else {"at": knots_of(self.model, signal)}
        if self.score is None or base is None:
            return row | {"refused": self.refused}
        row |= {"outside": self.score.share, "excess": self.score.excess(base)}
        return row | {"width": self.score.width / base.width, "jumps": self.score.figure / base.figure}


def choose_knots(
    transients: Sequence[Transient],
    signal: str,
    others: Mapping[str, Knots] | None = None,
    *,
    groups: Sequence[Any] | str | None = None,
    progress: Callable[[str], None] | None = None,
    **options: Any,
) -> tuple[KnotCandidate, dict[str, Any]]:
    """How many knots the recordings carry on one signal, as `choose_monitored` compares ways to fit, and the table.

    Each number of COUNTS, and those of FURTHER while the last one is chosen, is fitted to all recordings, which places
    the knots, and then without each recording, group, or block of a single recording, which is judged. A number is
    refused if more than EXCESS of the left-out transitions are outside beyond 1 + SLACK times those of one knot in the
    same part, or as many times more as the jumps seen are smaller. Of the others that with the smallest jumps seen is
    the best, and the fewest knots are chosen of which the best does not see clearly (CLEARLY) smaller ones.
    """
    beside, candidates, facts = dict(others or {}), list[KnotCandidate](), {"left_out": "recording", "units": 0}
    for count in (1, *COUNTS, *FURTHER):
        if count in FURTHER and candidates[-1] is not chosen_of(candidates):
            break
        if progress is not None and candidates:
            progress(f"{plural(count, 'knot')} on {signal}")
        model, asked = None, {signal: count, **beside} if candidates else beside
        try:
            model = fit(transients, schedule=asked, describe_data=False, **options)
            if candidates and (tied := sum(data.tied_to is not None for data in model.block_data)):
                raise FitError(f"{tied} of {plural(len(model.block_data), 'block')} would have too little data")
            score, left = score_of(transients, model, groups, options)
            candidates.append(KnotCandidate(count, model, score))
        except FitError as error:
            if not candidates and model is None:
                raise
            candidates.append(KnotCandidate(count, model, refused=str(error)))
            break  # more knots would be refused likewise
        facts = _what(left)
    chosen, rows = chosen_of(candidates), [c.row(candidates[0].score, signal) for c in candidates]
    table = {"signal": signal, **facts, "candidates": rows, "chosen": chosen.count}
    return chosen, table | {"reason": _reason_for_knots(candidates, chosen)}


def knots_of(model: UncertainLTI, signal: str) -> list[float]:
    """Knots of one scheduling signal in recorded units."""
    if model.schedule is None:
        return []
    at = zip(model.schedule.axes, model.schedule.recorded_values(model.signals.signals), strict=True)
    return [value for axis, values in at if axis.signal == signal for value in values.tolist()]


def chosen_of(candidates: Sequence[KnotCandidate]) -> KnotCandidate:
    """The fewest knots of which no other number that holds sees clearly smaller jumps."""
    base = candidates[0].score
    good = [(c, c.score.figure) for c in candidates if base and c.score and c.score.holds(base)]
    least = min((figure for _, figure in good), default=0.0)
    return next((c for c, figure in good if CLEARLY * figure <= least), candidates[0])


def _reason_for_knots(candidates: Sequence[KnotCandidate], chosen: KnotCandidate) -> str:
    base, *others = candidates
    if base.score is None:
        return f"nothing can be left out: {base.refused}"
    judged = [(c.count, c.score) for c in others if c.score is not None and chosen in (base, c)]
    if not judged:
        return others[0].refused
    count, score = min(judged, key=lambda one: one[1].figure)
    outside = f"{score.share:.2%} outside, where one knot has {base.score.share:.2%}"
    if not score.holds(base.score) and score.figure < CLEARLY * base.score.figure:
        return f"{plural(count, 'knot')} leave {outside}"
    sees = f"jumps x {score.figure / base.score.figure:.2g} of those that one knot sees"
    width = f"mean width x {score.width / base.score.width:.2g}"
    if chosen is base:
        return f"{plural(count, 'knot')} see {sees} on left-out data, {width}, {outside}, which does not pay"
    return f"on left-out data the alarm sees {sees}, {width}, {outside}"


MOST = 64
"""Steps of the longest horizon that is chosen; longer ones are listed one by one."""
SHARE = 0.1
"""Longest horizon that is tried where none is asked for, relative to the median recording."""


@dataclass(frozen=True, eq=False)
class HorizonCandidate(Score):
    """One horizon with one kind of half-widths, judged on what was left out of its fits.

    `steps`: number of steps; `widths`: half-widths. `width` is relative to that of one step.
    """

    steps: int = 1
    widths: Widths = "growing"

    @property
    def per_step(self) -> float:
        """Mean half-width over the steps, relative to that of one step: how slow a change must be to pass unseen."""
        return self.width / self.steps


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
    ones: than 1 + SLACK times as many of each part and EXCESS of all; else constant ones. A horizon that was not asked
    for by its length stays if the same holds of its windows and the transitions of one step, and if its half-width per
    step is at most PAYS of that of the horizon before it: then it sees slower changes. Of very long recordings pieces
    are looked at.
    """
    if options.get("weights") is None:  # else of every step
        transients = thinned(transients, _OF_HORIZONS, 20 * max(lengths, default=1))
    dropped: dict[int, str] = {}
    kinds: tuple[Widths, ...] = get_args(Widths) if rule.widths == "auto" else (rule.widths,)
    asked, nothing = bool(rule.steps or rule.seconds), ""
    found: dict[int, list[HorizonCandidate]] = {}
    facts: dict[str, Any] = {"left_out": "recording", "units": 0, "candidates": [], "chosen": {}}
    for kind in kinds:
        if progress is not None:
            progress(f"{kind} half-widths over {', '.join(map(str, lengths))} steps")
        model = fit(transients, describe_data=False, horizons=lengths, widths=kind, drop_horizons=True, **options)
        said = model.fit_summary.get("messages", [])
        for steps in (steps for steps in lengths if steps not in model.steps):
            begin = f"no horizon of {steps} steps: "
            dropped[steps] = next((text.removeprefix(begin) for text in said if text.startswith(begin)), "")
        try:
            one, left = score_of(transients, model, groups, options)
        except FitError as error:
            nothing = f"nothing can be left out: {error}"
            break
        facts |= _what(left)
        for j, horizon in enumerate(model.horizons):
            found.setdefault(horizon.steps, []).append(_judged_horizon(left, j, horizon.steps, kind))
    there = model.steps if nothing else found
    if missing := [steps for steps in lengths if asked and steps not in there]:
        raise FitError(f"no horizon of {missing[0]} steps: {dropped[missing[0]]}")
    if nothing:
        chosen: dict[int, Widths] = {steps: "constant" for steps in model.steps if asked}
    else:
        chosen, facts["candidates"] = _decided(found, one, asked)
    facts["chosen"] = {str(steps): widths for steps, widths in chosen.items()}
    return chosen, facts | {"reason": nothing or _reason_for_horizons(chosen, found, dropped)}


def _judged_horizon(left: Validation, j: int, steps: int, kind: Widths) -> HorizonCandidate:
    windows = [np.abs(part.longer[:, j]) for part in left.parts]
    ratios = [part.longer_width[j] / np.maximum(part.mean_width, 1e-300) for part in left.parts]
    return HorizonCandidate(
        by_unit(left.parts, [float(np.isfinite(w).all(axis=1).sum()) for w in windows]),
        by_unit(left.parts, [float((w > 1.0).any(axis=1).sum()) for w in windows]),
        _geometric([ratio for ratio in ratios if np.isfinite(ratio).all()]),
        steps=steps,
        widths=kind,
    )


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
        if other is not best and other.holds(best) and other.width <= PAYS * best.width:
            best = other
        taken = asked
        if asked:
            why = "asked for"
        elif not best.judged.sum():
            why = "no left-out part is so long"
        elif not best.holds(base):
            why = f"{best.share:.1%} of the left-out windows are outside, {base.share:.1%} of the single steps"
        elif not best.per_step <= PAYS * reached:
            why = "sees no slower changes than the horizon before it"
        else:
            why, taken = "holds, and sees slower changes", True
        if taken:
            chosen[steps], reached = best.widths, best.per_step
        instead = "growing ones are narrower" if best.widths == "growing" else "constant ones hold as well"
        for one in ordered:
            row: dict[str, Any] = {"steps": steps, "widths": one.widths, "outside": one.share, "width": one.width}
            row |= {"per_step": one.per_step, "taken": taken and one is best, "why": why if one is best else instead}
            rows.append(row)
    return chosen, rows


def _reason_for_horizons(
    chosen: Mapping[int, Widths], found: Mapping[int, Sequence[HorizonCandidate]], dropped: Mapping[int, str]
) -> str:
    if not found:
        reason = "none has an envelope that is worth having" if dropped else "no recording is long enough for a horizon"
    elif not chosen:
        reason = "none holds on left-out data as well as one step and sees slower changes"
    else:
        last = max(chosen)
        best = next(one for one in found[last] if one.widths == chosen[last])
        reason = (
            f"{plural(last, 'step')}, {best.widths} half-widths: {1 - best.share:.2%} of the left-out windows "
            f"are inside, and the half-width is x {best.width:.3g} of one step's"
        )
    return reason + "".join(f"; no horizon of {steps} steps: {why}" for steps, why in sorted(dropped.items()) if why)
