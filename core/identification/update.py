# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Update: a fit and further recordings to the optimum of all, without the recordings of the fit."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from uncertain_lti.base.arrays import Array, Index
from uncertain_lti.base.errors import FitError, UnprovenError
from uncertain_lti.base.text import shortlist
from uncertain_lti.identification import passes
from uncertain_lti.identification.assembly import assemble, is_constant, median_step
from uncertain_lti.identification.diagnosis import of_sums
from uncertain_lti.identification.fitting import common_signals, distance_in_words, fit_fleet
from uncertain_lti.identification.fleet import Fleet
from uncertain_lti.identification.memory import Boxes, Memory, Recording, remembered
from uncertain_lti.identification.passes import Envelope, Judged, Moments, Samples, moments
from uncertain_lti.identification.problem import Problem
from uncertain_lti.identification.structure import Structure
from uncertain_lti.model.domain import Domain, Occupancy
from uncertain_lti.model.horizon import Residuals
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.sampling.transient import Transient, controls_as, listed_transients


class _Updated(Fleet):
    """Transitions of earlier recordings that are there, and new ones; the others are sums, and proven to be inside.

    `model`: to be updated; `memory`: what it keeps of recordings that are not given again; `known`: transitions that it
    keeps or that are given again; `fresh`: those of new recordings.
    """

    def __init__(self, model: UncertainLTI, memory: Memory, known: Problem, fresh: Problem) -> None:
        self._new = Fleet.of(fresh)
        super().__init__([known] * (known.N > 0) + self._new.partitions)
        self._model, self._memory = model, memory

    def moments(self, stride: int) -> tuple[Moments, list[Samples]]:
        """Sums over all transitions, and a sample of those that are there."""
        sums, some = super().moments(stride)
        return (sums if self._memory.rest is None else sums + self._memory.rest), some

    def judge(self, model: Envelope) -> Judged:
        """What the bounds are on the transitions that are there; refused if another may be outside."""
        judged = super().judge(model)
        if names := self._memory.unproven(self.boxes_after(model, judged.largest)):
            raise UnprovenError(
                f"what the model keeps does not prove the optimum of all recordings; give {', '.join(names)} again, "
                f"together with the new ones"
            )
        boxes = self._memory.boxes
        if boxes is None or self._model.fit_summary["criterion"] == "lp":  # whose largest widths the room has proven
            return judged
        return replace(judged, largest=np.maximum(judged.largest, boxes.widest(self.columns, model)))

    def boxes_after(self, model: Any, widths: Array) -> Boxes | None:
        """What is known of the others, with the room that a model of these largest widths (n,) leaves."""
        boxes = self._memory.boxes
        return boxes and boxes.after(self.columns, self._model, model, widths)

    def occupancy(self, low: Array, high: Array) -> Occupancy | None:
        """Combinations of two signals that the model has seen, or that are new."""
        seen = self._model.domain.measure
        if seen is None or self._memory.rest is None:  # then all are there
            return None if seen is None else super().occupancy(low, high)
        new = [passes.occupied(part, low, high, seen.cells, 1) for part in self._new.partitions]
        both = Occupancy.of(np.logical_or.reduce(new)).occupied | seen.within(self._model.domain, low, high)
        return Occupancy(seen.cells, both)

    def residuals(self, model: Envelope, judged: Judged, own_law: ArrayLike = True) -> Residuals:
        """Those of the earlier recordings by the model of then, those of the new ones by this one."""
        before, count = self._model.residuals, self._model.fit_summary["transitions"]
        if before is None:
            return super().residuals(model, judged)
        if not before.relative:  # a law of its own stays, and so do its residuals
            return before
        new = self._new.judge(model)
        total = count + self._new.N
        mean = (count * before.mean + new.total) / total
        squares = count * (before.covariance + np.outer(before.mean, before.mean)) + new.products
        covariance = squares / total - np.outer(mean, mean)
        return Residuals(mean, 0.5 * (covariance + covariance.T), before.relative)


def updated(
    model: UncertainLTI, transients: Iterable[Transient] | Transient, progress: Callable[[str], None] | None = None
) -> tuple[UncertainLTI, list[Transient]]:
    """`UncertainLTI.update` but for the alarm, which stays, and the recordings that are new."""
    memory, facts = Memory.of(model), model.fit_summary
    columns, point = memory.kept.columns, model.operating_point
    sums = moments(memory.kept)[0] if memory.rest is None else moments(memory.kept)[0] + memory.rest
    of_them = of_sums(model, memory.kept, sums, np.asarray(facts["mean_width"]))[1]
    marks = {recording.mark: number for number, recording in enumerate(memory.recordings)}
    known, fresh = dict[int, Problem](), list[Problem]()
    every, runs = list(memory.recordings), list[Transient]()
    for t in _as_fitted(model, listed_transients(transients)):
        problem = replace(assemble([t], point, None, "none", empty=True), columns=columns, weights=memory.kept.weights)
        recording = Recording.of(t.name, problem)
        number = marks.setdefault(recording.mark, len(every))
        problem = replace(problem, source=np.full(problem.N, number))
        if number < len(memory.recordings):
            known[number], every[number] = problem, recording  # it may be in another place now
        elif problem.N and number == len(every):
            every.append(recording)
            fresh.append(problem)
            runs.append(t)
    if not fresh:
        raise FitError("every recording is in the model already, or has no usable transition; give a new one")
    new, memory = _joined(fresh), _without(memory, known)
    here = _joined([memory.kept, *known.values()])
    here = here.subset(np.argsort(here.source, kind="stable"))
    sampling = model.sampling
    steps = np.append(new.dt, [sampling.dt_min or new.dt[0], sampling.dt_max or new.dt[0]])
    if facts["additive"] == "both" and "dc" not in columns.names and not is_constant(steps):
        raise FitError(
            "the steps of the model have one length, so that disturbance and noise are one term, and those of the new "
            "recordings differ; fit again with all recordings"
        )
    structure = Structure.from_dict(facts["structure"], model.n, model.m) if "structure" in facts else None
    fleet = _Updated(model, memory, here, new)

    def remember(of: UncertainLTI, nearest: Sequence[Index]) -> dict[str, Any] | None:
        boxes = fleet.boxes_after(of, np.asarray(of.fit_summary["max_width"]))
        return remembered(of, _joined([here, new]), every, fleet.sums, nearest, memory.rest, boxes)

    def where(index: int) -> str:
        return f"a step of {every[int(np.append(here.source, new.source)[index])].name}"

    found = fit_fleet(
        fleet,
        model.signals,
        facts["criterion"],
        structure=structure,
        progress=progress,
        dt_median=sampling.dt_median if facts["transitions"] >= new.N else median_step(new.dt),
        transients=runs,
        remember=remember,
        where=where,
    )
    same = ("additive", "weights", "count", "structure", "group", "alarm")
    gap = facts["optimality_gap"]
    of_them += distance_in_words(np.inf if gap is None else gap)
    others = [text for text in facts.get("messages", []) if text not in of_them]
    summary = {name: facts[name] for name in same if name in facts} | {
        "messages": others + found.fit_summary["messages"],
        "transients": facts["transients"] + len(runs),
        "segments": facts["segments"] + sum(t.segments for t in runs),
        "sources": [*facts["sources"], *({"file": t.name} for t in runs)],
        "updates": facts.get("updates", 0) + 1,
    }
    found = found.replace(
        fit_summary=found.fit_summary | summary,
        domain=_farthest(found.domain, model.domain),
        repeats=found.repeats and (found.repeats.and_of(model.repeats) if model.repeats else found.repeats),
        alarm=model.alarm,
    )
    if again := [t.name for t in runs if t.sources and t.name in (recording.name for recording in memory.recordings)]:
        words = "fitted before with other samples, and both count; if a file has grown, fit all recordings"
        found.fit_summary["messages"].append(f"{shortlist(again, 3)}: {words}")
    if not found.memory:
        words = "the room for what an update needs is used up; fit all recordings the next time"
        found.fit_summary["messages"].append(words)
    return found, runs


def _as_fitted(model: UncertainLTI, transients: Iterable[Transient]) -> list[Transient]:
    """Recordings with the signals, the ends of the controls and the step of a model."""
    found = [controls_as(t.scheduled_on(()), model.signals.controls) for t in transients]
    common_signals(found)
    for t in found:
        if (t.state_names, t.control_names) != (model.state_names, model.control_names):
            raise FitError(
                f"{t.name} has states {', '.join(t.state_names)} and controls {', '.join(t.control_names) or 'none'}, "
                f"the model {', '.join(model.state_names)} and {', '.join(model.control_names) or 'none'}; read it "
                f"with the signals of the model"
            )
    step = None if isinstance(model.signals.step, str) else model.signals.step
    return [t if t.step == step else t.replace(step=step or "recorded") for t in found]


def _joined(problems: Sequence[Problem]) -> Problem:
    """Transitions one after the other."""
    names = ("z", "x_next", "dt", "source", "k")
    each: dict[str, Any] = {name: np.concatenate([getattr(p, name) for p in problems], axis=-1) for name in names}
    return replace(problems[0], **each)


def _without(memory: Memory, known: dict[int, Problem]) -> Memory:
    """What is kept of the recordings that are not given again."""
    again = np.isin(memory.kept.source, list(known))
    gone, rest = memory.kept.subset(again), memory.rest
    if rest is not None:
        for problem in known.values():
            rest = rest - moments(problem)[0]
        if gone.N:
            rest = rest + moments(gone)[0]
    boxes = memory.boxes and memory.boxes[~np.isin(memory.boxes.source, list(known))]
    kept = memory.kept.subset(~again)
    if rest is None or not rest.count:
        rest = boxes = None
    return replace(memory, kept=kept, rest=rest, boxes=boxes)


def _farthest(domain: Domain, before: Domain) -> Domain:
    """With the larger of the largest steps."""
    if domain.step_max is None or before.step_max is None:
        return domain
    return replace(domain, step_max=np.maximum(domain.step_max, before.step_max))
