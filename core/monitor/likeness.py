# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Likeness: which fault an alarm looks like, by the pattern of the utilisation, and patterns learnt of known faults.

While the alarm is on, the products u uᵀ of the utilisations of all states are averaged, horizon by horizon: a pattern
that keeps its direction while the manoeuvre changes its sign and size. It is compared with the signatures of
labelled recordings, and, for one step, with what a single part of the machine would leave: a column of B times
anything (an actuator that does not follow), a column of A (a bias of a sensor, which the other equations take for the
state), or one row (a jump of one sensor, or changed dynamics of one state).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import ModelError
from uncertain_lti.base.text import plural
from uncertain_lti.model.signature import Signature, closeness
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.verdict import Verdicts

MATCH, AHEAD = 0.8, 0.05
"""A signature is named from this match on, if it is so far ahead of every other."""
EXPLAINS, CLOSE = 0.85, 0.05
"""A part is named if it alone explains this share of the pattern, with those that explain nearly as much."""
OWN = 0.05
"""Share of the pattern that a bias of a sensor must leave in its own equation: elsewhere others leave the same."""
LEAST, MOST, APART = 5, 2000, 100
"""Verdicts with an alarm that a name needs; of which a pattern is made; without one, after which it starts over."""
_LIMIT = 10.0  # of a utilisation: one sample must not be all of a pattern


class Part(NamedTuple):
    """A part of the machine that would leave such a pattern.

    `kind`: `actuator`, `sensor` or `equation`; `name`: of the control or state; `share`: share of the pattern that it
    explains, 0 to 1.
    """

    kind: str
    name: str
    share: float


class Likeness(NamedTuple):
    """What a pattern looks like.

    Parameters
    ----------
    label : str
        Of the signature; empty if unknown.
    matches : tuple of (str, float)
        Every signature with its match, the best first.
    parts : tuple of Part
        Parts that explain it alone, the best first; empty for none.
    first : tuple of str
        States outside their bounds when the alarm began.
    verdicts : int
        Verdicts of the pattern.
    """

    label: str
    matches: tuple[tuple[str, float], ...]
    parts: tuple[Part, ...]
    first: tuple[str, ...]
    verdicts: int

    @property
    def words(self) -> str:
        """In words, without a full stop; empty where there are too few verdicts, or nothing to say.

        Parts are named if those that explain nearly as much are of one signal; without any, the states that were
        outside when the alarm began, if there are signatures.
        """
        if self.verdicts < LEAST:
            return ""
        found = []
        if self.matches:
            near = ", ".join(f"{label} {match:.2f}" for label, match in self.matches[bool(self.label) :][:2])
            if self.label:
                return f"looks like {self.label} (match {self.matches[0][1]:.2f}{f', next {near}' * bool(near)})"
            alike = [name for name, match in self.matches if match >= max(MATCH, self.matches[0][1] - AHEAD)]
            what = f"{' or '.join(alike)}, too alike to tell" if alike else "no known fault"
            found.append(f"looks like {what} (nearest {near})")
        if len({part.name for part in self.parts}) == 1:
            found.append("points to " + " or ".join(f"{p.kind} {p.name} ({p.share:.0%})" for p in self.parts))
        elif self.first and self.matches:
            found.append(f"began at {', '.join(self.first)}")
        return "; ".join(found)


class Pattern:
    """Mean of u uᵀ of each horizon over verdicts.

    `steps`: horizons; `n`: number of states.
    """

    def __init__(self, steps: Sequence[int], n: int) -> None:
        self.steps = tuple(steps)
        self.verdicts = self._inside = 0
        self._sum, self._own, self._half = np.zeros((len(self.steps), n, n)), np.zeros((n, n)), np.zeros(n)

    def add(self, table: Array, half: Array, outside: bool = False) -> None:
        """Take one verdict.

        `table` (H, n): utilisation; a row with NaN is left out, and the verdict if it is that of one step; `half` (n,):
        half-widths of one step, normalised; a common factor does not matter; `outside`: it is outside the fitted
        domain, where the model does not say what a part would leave.
        """
        if np.isnan(table[0]).any():
            return
        self.verdicts += 1
        table = np.clip(table, -_LIMIT, _LIMIT)
        for total, row in zip(self._sum, table, strict=True):
            if not np.isnan(row).any():
                total += row[:, None] * row
        if not outside:
            self._inside += 1
            self._half += half
            self._own += table[0][:, None] * table[0]

    def signature(self, label: str) -> Signature:
        """The pattern as a signature of one recording."""
        return Signature(label, self.steps, scaled(self._sum), verdicts=self.verdicts)

    def parts(self, model: UncertainLTI) -> tuple[Part, ...]:
        """What single part of the machine explains the one-step pattern within the fitted domain.

        What a control remembers of a state is no actuator.
        """
        moment, half = self._own, self._half
        whole = float(np.trace(moment))
        remembered = {r.position - model.n for r in model.signals.recalled if r.of < model.n}
        if not (self._inside >= LEAST and whole > 0.0 and (half > 0.0).all() and np.isfinite(half).all()):
            return ()
        block = max(range(len(model.blocks)), key=lambda r: model.block_data[r].transitions or 0)
        A, B = model.blocks[block].A, model.blocks[block].B

        def share(direction: Array) -> float:
            d = direction / half
            size = float(d @ d)
            return float(d @ moment @ d) / (size * whole) if size > 0.0 else 0.0

        named = [(j, name) for j, name in enumerate(model.control_names) if j not in remembered]
        found = [Part("actuator", name, share(B[:, j])) for j, name in named]
        for i, name in enumerate(model.state_names):
            own = float((A[i, i] / half[i]) ** 2)
            if own >= OWN * float(np.square(A[:, i] / half).sum()):
                found.append(Part("sensor", name, share(A[:, i])))
            found.append(Part("equation", name, share(np.eye(model.n)[i])))
        best = max(part.share for part in found)
        return tuple(sorted((p for p in found if p.share >= max(EXPLAINS, best - CLOSE)), key=lambda p: -p.share))


def scaled(moments: Array) -> Array:
    """Matrices of Frobenius norm 1.

    `moments` (H, n, n): any size; Returns (H, n, n): 0 where it was 0.
    """
    size = np.sqrt(np.sum(moments**2, axis=(1, 2), keepdims=True))
    return np.asarray(np.divide(moments, size, out=np.zeros_like(moments), where=size > 0))


def likeness(model: UncertainLTI, pattern: Pattern, first: Sequence[str] = ()) -> Likeness:
    """What a pattern looks like."""
    label, matches = _matched(pattern.signature("-"), model.signatures)
    label = label if pattern.verdicts >= LEAST else ""
    return Likeness(label, matches, pattern.parts(model), tuple(first), pattern.verdicts)


def _matched(own: Signature, signatures: Iterable[Signature]) -> tuple[str, tuple[tuple[str, float], ...]]:
    """The label of the signature that is clearly ahead, "" for none, and every one with its match, the best first."""
    every = sorted(((closeness(own, s), s.label) for s in signatures), reverse=True)
    clear = bool(every) and every[0][0] >= MATCH and (len(every) == 1 or every[0][0] - every[1][0] >= AHEAD)
    return every[0][1] if clear else "", tuple((label, match) for match, label in every)


class Explainer:
    """The pattern of the alarm that is on, or was on last, one verdict after another.

    `model`: what judges; `pattern`: none before any alarm.
    """

    def __init__(self, model: UncertainLTI) -> None:
        self._model = model
        self._steps = (1, *model.steps)
        self._per_width = 0.5 / model.operating_point.X
        self.pattern: Pattern | None = None
        self._first: tuple[str, ...] = ()

    def push(self, table: Array, lower: Array, upper: Array, quiet: int, outside: bool = False) -> None:
        """Take a verdict with an alarm.

        `table` (H, n): utilisation for one step and for each horizon; `lower, upper` (n,): bounds of one step, recorded
        units.
        """
        if self.pattern is None or quiet > APART:
            self.pattern = Pattern(self._steps, self._model.n)
            left = np.any(np.abs(table) > 1.0, axis=0).tolist()
            self._first = tuple(n for n, out in zip(self._model.state_names, left, strict=True) if out)
        if self.pattern.verdicts < MOST:
            with np.errstate(over="ignore", invalid="ignore"):
                self.pattern.add(table, (upper - lower) * self._per_width, outside)

    def likeness(self) -> Likeness | None:
        """What the alarm looks like."""
        return None if self.pattern is None else likeness(self._model, self.pattern, self._first)


def over_recording(model: UncertainLTI, verdicts: Verdicts) -> Iterable[tuple[int, int, Explainer]]:
    """`Explainer` over the verdicts of a recording: of each alarm the first and last sample, and what it looks like."""
    explainer, begin, last, before = Explainer(model), -1, -1, 0
    count, table = np.cumsum(verdicts.judged), verdicts.horizon_utilisation
    for k in np.flatnonzero(verdicts.judged & verdicts.alarm).tolist():
        quiet = int(count[k]) - before - 1
        if begin >= 0 and quiet > APART:
            yield begin, last, explainer
            explainer, begin = Explainer(model), -1
        explainer.push(table[k], verdicts.lower[k], verdicts.upper[k], quiet, bool(verdicts.outside_domain[k]))
        begin, last, before = (k if begin < 0 else begin), k, int(count[k])
    if begin >= 0:
        yield begin, last, explainer


@dataclass(frozen=True)
class Learnt:
    """What labelled recordings gave.

    `signatures`: those of the model, with the new ones; `named`: of each recording its name, its label, and the label
    that the signatures of the other recordings give it; empty for unknown, or where there is no other recording of its
    label; `alike`: pairs of labels that cannot be told apart, with their match.
    """

    signatures: tuple[Signature, ...]
    named: tuple[tuple[str, str, str], ...]
    alike: tuple[tuple[str, str, float], ...]


def learn_signatures(model: UncertainLTI, labelled: Sequence[tuple[str, Verdicts]], replace: bool = False) -> Learnt:
    """Signatures from recordings of known faults.

    Parameters
    ----------
    model : UncertainLTI
        What the recordings were checked with.
    labelled : sequence of (str, Verdicts)
        Each recording with its label.
    replace : bool, default False
        Whether a label that the model has already is learnt again.

    Returns
    -------
    Learnt
        One signature per label, the mean over its recordings, however long they are.

    Raises
    ------
    ModelError
        The alarm was on for fewer than `LEAST` verdicts on every state of a recording, or the model has the label.
    """
    known = {signature.label for signature in model.signatures}
    alone: list[Signature] = []
    for label, verdicts in labelled:
        if label in known and not replace:
            raise ModelError(f"the model has a signature '{label}'; give another label, or replace it with --force")
        alone.append(_of_recording(model, label, verdicts))
    new = _means(alone)
    kept = tuple(s for s in model.signatures if s.label not in new)
    signatures = (*kept, *new.values())
    named = []
    for i, (label, verdicts) in enumerate(labelled):
        others = _means(alone[:i] + alone[i + 1 :])
        found, _ = _matched(alone[i], [*kept, *others.values()])
        named.append((verdicts.transient.name, label, found if label in others else ""))
    pairs = ((a, b, closeness(a, b)) for i, a in enumerate(signatures) for b in signatures[:i])
    return Learnt(signatures, tuple(named), tuple((b.label, a.label, c) for a, b, c in pairs if c >= MATCH))


def _of_recording(model: UncertainLTI, label: str, verdicts: Verdicts) -> Signature:
    rows = np.flatnonzero(verdicts.judged & verdicts.alarm)
    if len(rows) < LEAST:
        on = f"the alarm was on for {plural(len(rows), 'verdict')} only" if len(rows) else "no alarm was raised"
        raise ModelError(
            f"{verdicts.transient.name}: {on}, so it has no signature; give a recording of '{label}' that the rule "
            f"sees, or a rule that sees it (--violations, --window, --margin)"
        )
    pattern = Pattern((1, *model.steps), model.n)
    table, zeros = verdicts.horizon_utilisation[rows], np.zeros(model.n)
    for row in table:
        pattern.add(row, zeros)
    if pattern.verdicts < LEAST:
        raise ModelError(
            f"{verdicts.transient.name}: of the verdicts of its alarm {pattern.verdicts} have every state, as a "
            f"frozen one has none, so it has no signature; leave it out: a check names what is frozen by itself"
        )
    return pattern.signature(label)


def _means(signatures: Sequence[Signature]) -> dict[str, Signature]:
    """The mean of the signatures of each label, however long their recordings are."""
    means = {}
    for label in dict.fromkeys(s.label for s in signatures):
        alike = [s for s in signatures if s.label == label]
        moments = scaled(np.mean([s.moments for s in alike], axis=0))
        means[label] = Signature(label, alike[0].steps, moments, len(alike), sum(s.verdicts for s in alike))
    return means
