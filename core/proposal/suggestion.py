# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Suggestion: whether a schedule would pay, from a part of the recordings."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.english import plural
from uncertain_lti.base.errors import FitError
from uncertain_lti.model.schedule import Axis, Schedule
from uncertain_lti.proposal.scheduling import Candidate, Choice, Trials, best_of, decide
from uncertain_lti.sampling.transient import Transient

TRANSITIONS = 4000
"""Transitions that a suggestion looks at, about; of larger recordings it takes pieces."""
PIECE = 200
"""Transitions of a piece."""
FOLDS = 5
"""Times that something is left out."""
ALLOWED = 0.02
"""In place of EXCESS: a part of the recordings carries less than all of them."""
SIGNALS = 2
"""Signals that are tried, at most."""
PROMISING = 0.8
"""Largest least-squares residual with three knots on a signal, relative to one, up to which it is tried."""


@dataclass(frozen=True)
class Suggestion:
    """What a schedule would do, as far as a part of the recordings tells.

    `facts`: plain data for `fit_summary`: how promising each signal is, the tables of those tried, and what is
    suggested; `message`: in words; empty if no signal is promising.
    """

    facts: dict[str, Any]
    message: str


def suggest_schedule(
    transients: Sequence[Transient],
    groups: Sequence[Any] | str | None = None,
    progress: Callable[[str], None] | None = None,
    **options: Any,
) -> Suggestion:
    """Whether one knot on each of the recordings' signals is too few, and whether the recordings carry more.

    At most TRANSITIONS transitions, SIGNALS signals (the second if the first is not worth it), three knots or two, and
    FOLDS times that something is left out, so at most 30 fits: the work does not grow with the recordings, and what is
    suggested depends on them alone.
    """
    some = thinned(transients, TRANSITIONS)
    found = promise(some)
    facts: dict[str, Any] = {"residuals": found, "tried": []}
    signals = [name for name in sorted(found, key=lambda name: found[name]) if found[name] <= PROMISING][:SIGNALS]
    if not signals:
        return Suggestion(facts, "")
    try:
        trials = Trials(some, groups=groups, folds=FOLDS, progress=progress, **options)
    except FitError as error:  # of a part of the recordings no model may exist
        return Suggestion({**facts, "not_done": str(error)}, "")
    if trials.base.refused:
        return Suggestion({**facts, "not_done": trials.base.refused}, "")
    choices: list[Choice] = []
    for name in signals:
        if any(choice.chosen.count > 1 for choice in choices):
            break
        candidates = [trials.base, trials.candidate(name, 3)]
        if best_of(candidates, ALLOWED) is trials.base:
            candidates.insert(1, trials.candidate(name, 2))
        choices.append(decide(name, candidates, trials, ALLOWED))
    facts["tried"] = [choice.facts() for choice in choices]
    if choices[-1].chosen.count > 1:
        return Suggestion({**facts, "suggested": choices[-1].signal}, _pays(choices[-1], trials.base))
    blocked = [choice for choice in choices if choice.record]
    return Suggestion(facts, _not_carried(blocked[0]) if blocked else "")


def _pays(choice: Choice, base: Candidate) -> str:
    chosen = choice.chosen
    return (
        f"a schedule would pay: scheduled on {choice.signal} with {plural(chosen.count, 'knot')}, mean width x "
        f"{math.exp(chosen.width[0]):.2g} and {1 - chosen.share:.1%} inside on left-out data (now "
        f"{1 - base.share:.1%}); fit with --schedule {choice.signal}=auto"
    )


def _not_carried(choice: Choice) -> str:
    return f"a schedule on {choice.signal} is not carried by these recordings: {choice.reason}; {choice.record}"


def thinned(transients: Sequence[Transient], most: int) -> list[Transient]:
    """Pieces of each recording, evenly spread, so that about this many transitions are left in total."""
    share = most / max(sum(len(t) for t in transients), 1)
    return list(transients) if share >= 1 else [_pieces(t, share) for t in transients]


def _pieces(transient: Transient, share: float) -> Transient:
    length = min(PIECE, max(20, int(share * len(transient))))
    count = max(1, round(share * len(transient) / length))
    if count * (length + 2) >= len(transient):
        return transient
    starts = np.linspace(0, len(transient) - length - 2, count).astype(int)
    keep = np.unique((starts[:, None] + np.arange(length + 2)).ravel())
    x = transient.x[keep]
    x[np.isin(keep, starts + length + 1)] = np.nan  # no transition from one piece to the next
    names: dict[str, Any] = {}
    if transient.signals is None:
        names = {
            "state_names": transient.state_names,
            "control_names": transient.control_names,
            "scheduling_names": transient.scheduling_names,
        }
    return Transient(
        transient.t_ns[keep],
        x,
        transient.u[keep],
        s=transient.s[keep],
        name=transient.name,
        signals=transient.signals,
        max_gap=transient.max_gap,
        min_step=transient.min_step,
        step=transient.step or "recorded",
        sources=transient.sources,
        **names,
    )


def promise(transients: Sequence[Transient]) -> dict[str, float]:
    """How far the largest residuals of least squares shrink with three knots on each signal.

    The knots are the ends of the signal and one of a few places between, the best.
    """
    steps = [t.transitions() for t in transients]
    first = transients[0]
    names = [*first.state_names, *first.control_names, *first.scheduling_names]
    x, u = np.concatenate([s.x for s in steps]), np.concatenate([s.u for s in steps])
    dt = np.concatenate([s.dt for s in steps])
    z = np.column_stack([x, u])
    phi = dt * np.vstack([(z / np.maximum(np.abs(z).max(axis=0, initial=0.0), 1e-300)).T, np.ones(len(z))])
    if len(z) < 9 * len(phi):
        return dict.fromkeys(names, 1.0)
    move = np.concatenate([s.x_next for s in steps]) - x
    floor = np.maximum(1e-9 * np.ptp(x, axis=0), 1e-300)
    whole = np.maximum(_largest(phi, move), floor)
    found = {}
    for name, values in zip(names, np.column_stack([z, np.concatenate([s.s for s in steps])]).T, strict=True):
        low, high = float(values.min()), float(values.max())
        places = {0.5 * (low + high), *np.quantile(values, [0.25, 0.5, 0.75]).tolist()}
        found[name] = 1.0
        for place in sorted(p for p in places if low < p < high):
            weights = Schedule((Axis(name, knots=(low, place, high)),)).weights(values[None])
            left = _largest((weights[:, None] * phi[None]).reshape(-1, len(z)), move)
            found[name] = min(found[name], float(np.exp(np.mean(np.log(np.maximum(left, floor) / whole)))))
    return found


def _largest(phi: Array, move: Array) -> Array:
    """Mean of the largest hundredth of the least-squares residuals of each state; phi (r, N), move (N, n)."""
    theta = np.linalg.lstsq(phi.T, move, rcond=None)[0]
    left = np.sort(np.abs(move - phi.T @ theta), axis=0)
    return np.asarray(left[-max(1, len(left) // 100) :].mean(axis=0))
