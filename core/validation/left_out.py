# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Leaving out: each recording or block judged by the model that was fitted to the others."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import FitError
from uncertain_lti.base.files import sha256
from uncertain_lti.base.progress import CountedStep
from uncertain_lti.base.text import moment, plural, shortlist
from uncertain_lti.identification import fit
from uncertain_lti.identification.assembly import split_weights
from uncertain_lti.identification.structure import Structure
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.model.model_file import sources_of
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.sampling.clock import passed
from uncertain_lti.sampling.transient import Transient, controls_as, listed_transients
from uncertain_lti.validation.groups import likely_groups, resolve_groups
from uncertain_lti.validation.part import Part, Reach, judge
from uncertain_lti.validation.result import Validation

BLOCKS = 10
"""Parts that a single recording is cut into, by default."""


def cut(transient: Transient, start: int, stop: int) -> Transient:
    """Samples start..stop-1 as a transient of their own; all of them are the transient itself."""
    return transient if (start, stop) == (0, len(transient)) else transient.replace(slice(start, stop))


def block_spans(transient: Transient, blocks: int) -> list[tuple[int, int]]:
    """Contiguous blocks with equal numbers of usable transitions; neighbours share one sample."""
    usable = np.flatnonzero(transient.usable)
    if len(usable) < 2 * blocks:
        raise FitError(
            f"{transient.name}: {plural(len(usable), 'usable transition')} "
            f"{'is' if len(usable) == 1 else 'are'} too few for {plural(blocks, 'block')}; use fewer blocks, or "
            f"record longer"
        )
    edges = [int(part[0]) for part in np.array_split(usable, blocks)] + [int(usable[-1]) + 1]
    return [(a, b + 1) for a, b in zip(edges[:-1], edges[1:], strict=True)]


def guard_interval(model: UncertainLTI, cuts: Sequence[tuple[Transient, int, int]]) -> float:
    """Three of the slowest stable time constants of the model, at most half of the shortest block."""
    stable = [-v.real for v in model.eigenvalues().ravel() if v.real < 0]
    shortest = min(passed(t.t_ns[start:stop]) for t, start, stop in cuts)
    return min(3.0 / min(stable) if stable else math.inf, 0.5 * shortest)


def remaining_spans(transient: Transient, start: int, stop: int, gap: float) -> list[tuple[int, int]]:
    """What is left of a transient without a block and the guard intervals on both sides of it."""
    if (start, stop) == (0, len(transient)):
        return []
    t = transient.t
    before = start + 1 - _within(-t[start::-1], gap)
    return [(0, before), (stop - 1 + _within(t[stop - 1 :], gap), len(t))]


def _within(t: Array, gap: float) -> int:
    """How many samples are less than the gap after the first and of its run: a clock that steps back begins another."""
    return int(np.argmax(np.append((t >= t[0] + gap) | (np.diff(t, prepend=t[0]) < 0.0), True)))


def leave_out(
    transients: Sequence[Transient] | Transient,
    *,
    weights: ArrayLike | Sequence[ArrayLike] | None = None,
    alarm_rule: AlarmRule | None = None,
    blocks: int | None = None,
    gap: float | None = None,
    groups: Sequence[Any] | str | None = None,
    folds: int | None = None,
    confidence: float = 0.9,
    full: UncertainLTI | None = None,
    progress: Callable[[str], None] | None = None,
    **options: Any,
) -> Validation:
    """Leave out one recording or group at a time, fit to the others, and judge what was left out.

    `folds`: how often at most; several are then left out at a time, and a single recording has so many blocks; `full`:
    the fit to all, whose schedule, horizons and operating point every fit is given.
    """
    transients = listed_transients(transients)
    if not 0.5 <= confidence < 1.0:
        raise FitError(f"confidence is {confidence:g}; it must be at least 0.5 and below 1")
    if blocks is not None and blocks < 2:
        raise FitError(f"blocks is {blocks}; at least 2 are needed to leave one out")
    if groups is not None and blocks is not None:
        raise FitError("groups leave out whole recordings, and blocks cut them; choose one")
    if gap is not None and not (math.isfinite(gap) and gap >= 0):
        raise FitError(f"gap is {gap}; it must be 0 s or more")
    if full is not None and options.get("schedule") is not None:
        raise FitError("full has its own schedule, which every fit is given; leave schedule out")
    if full is None:
        full = fit(transients, weights=weights, **options)
    if alarm_rule is not None:
        full = full.replace(alarm_rule=alarm_rule)
    options |= {
        "operating_point": full.operating_point,
        "schedule": full.schedule or {},  # none, even where the signals file asks for one
        "drop_horizons": True,  # where a part is too short for one, the others are judged
        **_horizons(full),
    }
    further = [s.name for s in full.signals.scheduling]
    transients = [controls_as(t.scheduled_on(further), full.signals.controls) for t in transients]
    names, grouping = resolve_groups(transients, groups)
    if blocks is None and len(transients) == 1:
        blocks = folds or BLOCKS
    if blocks is None and gap is not None:
        raise FitError("gap is given and whole recordings are left out; it goes with blocks")
    cuts = [(t, *span) for t in transients for span in (block_spans(t, blocks) if blocks else [(0, len(t))])]
    if gap is None:
        gap = guard_interval(full, cuts) if blocks else 0.0
    shown = [f"{t.name} from {moment(t.t[a])} to {moment(t.t[b - 1])} s" if blocks else t.name for t, a, b in cuts]
    unit_of = names or list(map(str, range(len(cuts))))
    together = [[i for i, unit in enumerate(unit_of) if unit == one] for one in dict.fromkeys(unit_of)]
    if folds is not None and (blocks or folds < len(together)):
        count = blocks or folds
        together = [[i for unit in together[k::count] for i in unit] for k in range(count)]
    parts: dict[int, Part] = {}
    own = split_weights(weights, transients, full.n)
    for number, out in enumerate(together):
        name = shown[out[0]] + (f" and {len(out) - 1} more" if len(out) > 1 else "")
        name = f"group {names[out[0]]}" if grouping else name
        if progress is not None:
            progress(CountedStep(f"fit {number + 1} of {len(together)}: without {name}", number + 1, len(together)))
        kept = _kept(transients, [cuts[i] for i in out], gap)
        pieces = [cut(transients[i], a, b) for i, a, b in kept]
        factors = [own[i][a : b - 1] for i, a, b in kept] if isinstance(own, list) else weights
        try:
            model = fit(pieces, weights=factors, describe_data=False, near=full, **options)
        except FitError as error:
            raise FitError(f"without {name} no model can be fitted: {error}") from None
        model, level = model.with_residuals_of(full), Reach(model, pieces).level
        for i in out:
            parts[i] = judge(model, full, cut(*cuts[i]), shown[i], names[i] if grouping else "", level)
    kind = "blocks" if blocks else "transients"
    hint = "" if grouping or blocks else likely_groups(transients)
    return Validation(full, tuple(parts[i] for i in sorted(parts)), kind, float(gap), confidence, grouping, hint)


def _kept(
    transients: Sequence[Transient], out: Sequence[tuple[Transient, int, int]], gap: float
) -> list[tuple[int, int, int]]:
    """What is fitted to where some are left out: number of the transient, first sample, and the one behind the last."""
    absent = {id(transient): (a, b) for transient, a, b in out}
    kept = []
    for i, transient in enumerate(transients):
        gone = absent.get(id(transient))
        spans = [(0, len(transient))] if gone is None else remaining_spans(transient, *gone, gap)
        kept += [(i, a, b) for a, b in spans if b - a >= 2]
    return kept


def validate(
    subject: UncertainLTI | Sequence[Transient] | Transient,
    transients: Sequence[Transient] | Transient | None = None,
    **options: Any,
) -> Validation:
    """Leave out one recording or group at a time, fit to the others, and judge what was left out.

    `validate(model, runs)` fits with the model's own settings: criterion, additive terms, structure, discards, schedule
    and the groups of its fit. `validate(runs)` fits as `fit(runs)` does.

    Parameters
    ----------
    subject : UncertainLTI, Transient or sequence of Transient
        A fitted model; or the recordings.
    transients : Transient or sequence of Transient, optional
        With a model, the recordings that it was fitted to.
    **options : object
        With a model blocks, gap, groups, confidence and progress; the key by which its file says that the recordings
        are grouped, `fit --group`, applies unless groups ("none" for no groups) or blocks are given. Else those of
        `leave_out`, which takes those of `fit` as well (criterion, additive, ...).

    Returns
    -------
    Validation
        The parts, each judged by the model that was fitted without it.

    Raises
    ------
    FitError
        As of `leave_out`; the recordings do not give the model again, or its file does not say how it was fitted; or a
        model is given without recordings, or recordings twice.
    """
    if not isinstance(subject, UncertainLTI):
        if transients is not None:
            raise FitError("recordings are given twice; write validate(model, runs) or validate(runs)")
        return leave_out(subject, **options)
    if transients is None:
        raise FitError("a model alone says nothing; give the recordings it was fitted to: validate(model, runs)")
    if further := sorted(set(options) - {"blocks", "gap", "groups", "confidence", "progress"}):
        raise FitError(
            f"{', '.join(further)}: a model is validated with its own settings; leave this out, or give the "
            f"recordings alone: validate(runs, {further[0]}=...)"
        )
    own, groups = _options(subject), options.pop("groups", None)
    if groups is None and options.get("blocks") is None:
        groups = subject.fit_summary.get("group")
    if (progress := options.get("progress")) is not None:
        progress("the fit to all recordings")
    runs = listed_transients(transients)
    again = fit(
        runs, operating_point=subject.operating_point, schedule=subject.schedule or {}, **own, **_horizons(subject)
    )
    if not _same(again, subject):
        known = {source["sha256"] for source in sources_of(subject)} - {""}
        other = [file for run in runs for file in run.sources if known and sha256(file) not in known]
        raise FitError(
            f"these recordings do not give this model again{f' (not as fitted: {shortlist(other, 3)})' * bool(other)}, "
            f"so what was left out of them would say nothing about it; name the recordings it was fitted to, or fit it "
            f"again"
        )
    kept = subject.residuals
    if kept is not None and again.residuals is not None and again.residuals.alike(kept) is None:  # of an older file
        again = again.replace(residuals=kept)
    groups = None if isinstance(groups, str) and groups == "none" else groups
    return leave_out(runs, alarm_rule=subject.alarm_rule, groups=groups, full=again, **options, **own)


def _horizons(model: UncertainLTI) -> dict[str, Any]:
    return {"horizons": model.steps, "widths": {horizon.steps: horizon.widths for horizon in model.horizons}}


def _options(model: UncertainLTI) -> Mapping[str, Any]:
    """Options of `fit` with which a model was fitted."""
    facts = model.fit_summary
    for key in ("criterion", "additive"):
        if key not in facts:
            raise FitError(f"the model does not say by which {key} it was fitted; fit it again")
    if facts.get("weights", "ones") != "ones":
        raise FitError("the model was fitted with weights, which its file does not hold; use validate() from Python")
    options: dict[str, Any] = {key: facts[key] for key in ("criterion", "additive", "discard", "count") if key in facts}
    if "structure" in facts:
        options["structure"] = Structure.from_dict(facts["structure"], model.n, model.m)
    return options


def _same(one: UncertainLTI, other: UncertainLTI) -> bool:
    """The same widths from as many transitions; another numpy may round otherwise, so not to the bit."""
    if one.fit_summary["transitions"] != other.fit_summary.get("transitions"):
        return False
    return np.allclose(one.fit_summary["mean_width"], np.asarray(other.fit_summary["mean_width"]), rtol=1e-6, atol=0.0)
