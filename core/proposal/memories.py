# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Memories: which lag, rate or diff of a state or control would narrow the envelope on left-out data."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from uncertain_lti.base.english import printable
from uncertain_lti.base.errors import FitError
from uncertain_lti.identification import fit
from uncertain_lti.identification.assembly import assemble
from uncertain_lti.identification.residuals import residuals
from uncertain_lti.model.operating_point import OperatingPoint
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.proposal.scheduling import Fold, fold_of
from uncertain_lti.proposal.suggestion import ALLOWED, FOLDS, TRANSITIONS, Suggestion, thinned
from uncertain_lti.sampling.recall import with_memories
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.memory import Memory
from uncertain_lti.validation.left_out import validate

PAYS = 0.8
"""Mean width on left-out data, relative to that without memory, up to which a memory is suggested."""
FEWEST_STEPS, MOST_STEPS = 3, 0.05
"""A control whose steps are events changes in at least so many transitions, and in at most this share of them."""


@dataclass(frozen=True)
class Remembered:
    """A memory that may be added to the signals.

    `of`: the state or control whose samples it takes; `memory`: how.
    """

    of: str
    memory: Memory

    @property
    def name(self) -> str:
        """Name of the new signal."""
        lag = f"_{self.memory.samples}" if self.memory.samples > 1 else ""
        return f"{self.of}_{ {'lag': 'before', 'diff': 'change', 'rate': 'rate'}[self.memory.kind] }{lag}".replace(
            " ", ""
        )

    def words(self, transients: Sequence[Transient]) -> str:
        """The entry that adds it to a signals file, or the columns of arrays."""
        signals = transients[0].signals
        signal = None if signals is None else next(s for s in signals if s.name == self.of)
        if signal is None or not signal.topic:
            return f"{self.name}: {self.memory.of(self.of)}"
        field = self.memory.of(signal.field)
        return printable(f"{{name: {self.name}, topic: {signal.topic}, field: '{field}'}}", 400)


def remember(transients: Sequence[Transient], memories: Sequence[Remembered]) -> list[Transient]:
    """Recordings with further controls that follow from their own earlier samples."""
    return [with_memories(t, {one.name: (one.of, one.memory) for one in memories}) for t in transients]


def memory_candidates(transients: Sequence[Transient], additive: str = "noise") -> list[tuple[Remembered, ...]]:
    """Sets of memories that may narrow the envelope, by what least squares leaves unexplained.

    Of the states whose residual follows from sample to sample (`residuals.Residuals.follows`) the rates (the
    differences, if the step is constant) and the values one sample earlier; of the controls that seldom change the
    values one sample earlier, and their changes.
    """
    first = transients[0]
    point = operating_point(first)
    try:
        problem = assemble(transients, point, None, additive)  # type: ignore[arg-type]
    except FitError:
        return []
    taken = {*first.state_names, *first.control_names, *first.scheduling_names}
    remembered = {r.of for r in first.signals.recalled} if first.signals is not None else set()
    found = residuals(problem)
    follow = [i for i in range(problem.n) if found is not None and found.follows(i) and i not in remembered]
    rate = "rate" if first.step is None else "diff"
    events = []
    for j in range(problem.n, problem.p):
        changes = int(np.count_nonzero(np.diff(problem.z[:, j])))
        if FEWEST_STEPS <= changes <= MOST_STEPS * problem.N and j not in remembered:
            events.append(j)
    names = [*first.state_names, *first.control_names]
    sets = [
        tuple(Remembered(names[i], Memory(kind)) for i in group)  # type: ignore[arg-type]
        for group, kinds in ((follow, (rate, "lag")), (events, ("lag", "diff")))
        for kind in kinds
        if group
    ]
    return [chosen for chosen in sets if not taken & {one.name for one in chosen}]


def suggest_memories(
    transients: Sequence[Transient],
    groups: Sequence[Any] | str | None = None,
    progress: Callable[[str], None] | None = None,
    **options: Any,
) -> Suggestion:
    """Whether a lag, rate or difference would narrow the envelope, and what that gains on left-out data.

    Of the sets of `memory_candidates` those for the states are tried on about TRANSITIONS transitions, leaving out
    FOLDS times, then, beside the best of them, those for the controls.
    """
    if options.get("structure") is not None or options.get("operating_point") is not None:
        return Suggestion({"not_done": "structure or operating point are for the signals as they are"}, "")
    found = choose_memories(transients, groups, progress, **options)
    if not found.chosen:
        return Suggestion(found.facts, "")
    entries = ", ".join(one.words(transients) for one in found.chosen)
    return Suggestion(
        found.facts,
        f"a memory would pay: with {entries} among the controls, mean width x {found.facts['width']:.2g} and "
        f"{found.facts['inside_with']:.1%} inside on left-out data (now {found.facts['inside']:.1%})",
    )


@dataclass(frozen=True)
class Choice:
    """Memories that pay, and what was tried.

    `chosen`: empty where none pays; `facts`: plain data: `memories` that were tried, the share `inside` without, the
    names `suggested`, and with them `width` and the share `inside_with`.
    """

    chosen: tuple[Remembered, ...]
    facts: dict[str, Any]


def choose_memories(
    transients: Sequence[Transient],
    groups: Sequence[Any] | str | None = None,
    progress: Callable[[str], None] | None = None,
    **options: Any,
) -> Choice:
    """What `suggest_memories` suggests."""
    sets = memory_candidates(thinned(transients, 5 * TRANSITIONS), options.get("additive") or "noise")
    if not sets:
        return Choice((), {"memories": []})
    base = thinned(transients, TRANSITIONS)
    try:
        model = fit(base, schedule={}, describe_data=False, **options)
        fold = fold_of(base, groups, model, FOLDS)
        before = _judged(base, model, fold, options)
    except FitError as error:
        return Choice((), {"not_done": str(error)})
    tried: list[dict[str, Any]] = []
    states = {*transients[0].state_names}
    chosen: tuple[Remembered, ...] = ()
    best = before
    for kind in (True, False):
        beside, widths = chosen, best
        for some in (s for s in sets if (s[0].of in states) is kind):
            if progress is not None:
                progress(f"with {', '.join(one.name for one in some)}")
            more = thinned(remember(transients, (*beside, *some)), TRANSITIONS)
            try:
                after = _judged(more, fit(more, schedule={}, describe_data=False, **options), fold, options)
            except FitError as error:
                tried.append({"added": [one.name for one in some], "refused": str(error)})
                continue
            ratio = math.exp(float(np.mean(np.log(after[0] / widths[0]))))
            pays = ratio <= PAYS and after[1] >= before[1] - ALLOWED
            tried.append({"added": [one.name for one in some], "width": ratio, "inside": after[1], "pays": pays})
            if pays and np.mean(np.log(after[0] / best[0])) < 0:
                best, chosen = after, (*beside, *some)
    facts: dict[str, Any] = {"memories": tried, "inside": before[1], "suggested": [one.name for one in chosen]}
    if chosen:
        facts |= {"width": math.exp(float(np.mean(np.log(best[0] / before[0])))), "inside_with": best[1]}
    return Choice(chosen, facts)


def _judged(
    transients: Sequence[Transient], model: UncertainLTI, fold: Fold, options: dict[str, Any]
) -> tuple[Any, float]:
    """Mean width of each state on left-out data, in recorded units, and the share inside."""
    left = validate(transients, full=model, groups=fold.groups, blocks=fold.blocks, gap=fold.gap, **options)
    judged = np.array([part.judged for part in left.parts], dtype=np.float64)
    if not judged.sum():
        raise FitError("nothing that was left out can be judged")
    width = sum(part.judged * part.mean_width for part in left.parts if part.judged) / judged.sum()
    outside = sum(part.violated for part in left.parts) / judged.sum()
    return np.maximum(width, 1e-300), float(1.0 - outside)


def operating_point(transient: Transient) -> OperatingPoint:
    """That of the signals of a recording; of arrays 0, with scales of 1."""
    signals = transient.signals
    if signals is not None:
        return OperatingPoint.of(signals.states, signals.controls, signals.scheduling)
    sizes = transient.x.shape[1], transient.u.shape[1], transient.s.shape[1]
    steady, scale = [np.zeros(k) for k in sizes], [np.ones(k) for k in sizes]
    return OperatingPoint(steady[0], steady[1], scale[0], scale[1], steady[2], scale[2])
