# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""A fit, or an update, with the monitor that goes with it: fitted, left out, and armed with a panel."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.errors import FitError, ModelError
from uncertain_lti.identification import fit, update
from uncertain_lti.identification.assembly import is_constant
from uncertain_lti.model.operating_point import OperatingPoint
from uncertain_lti.model.repeats import repeats_in
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.sampling.transient import Transient, Transitions
from uncertain_lti.validation.groups import resolve_groups
from uncertain_lti.validation.left_out import leave_out
from uncertain_lti.validation.panel import Evidence, Panel, extended, learn
from uncertain_lti.validation.part import Part, fitted_parts, judge
from uncertain_lti.validation.result import Validation

CLEARLY = 0.9
"""Largest size of the jumps that a better way to fit sees, over those that a simpler one sees."""
FOLDS = 5
"""Fits without a part of the recordings, groups or, of a single recording, blocks, for an alarm or any other choice."""
LIMIT, _MOST = 4e9, 2e7
"""Elements of all left-out problems together up to which parts are left out: some minutes; utilisations kept."""
NEW = 0.5
"""Share of a typical left-out stretch at combinations of signals that the rest lacks, from which on these are no news:
of many signals hardly any two recordings share them, and the thresholds are learnt there."""
STATES = 20
"""States of a machine too large to be left out, about, on which ways to fit are compared, if it has twice as many."""
_SHOWN, _COMPARED = 1_000_000, 200_000  # transitions that a panel is learnt from, and ways to fit are compared on


@dataclass(frozen=True)
class Monitored:
    """One way to fit: `model` with its alarm, `panel` with what it promises (None if none could be learnt: `why`),
    `validation` of what was left out (None if nothing was); `centred`: deviations are from the medians."""

    model: UncertainLTI
    panel: Panel | None
    validation: Validation | None = None
    why: str = ""
    centred: bool = False

    def finished(self) -> UncertainLTI:
        """The model with what the panel promises in its summary, and what was left out in its validation."""
        model, panel = self.model, self.panel
        if panel is None:
            alarm: dict[str, Any] = {"not_learnt": self.why}
        else:
            alarm = panel.summary(model, "fitted" if self.validation is None else "left out")
            if model.memory:
                model = model.replace(memory={**model.memory, "evidence": panel.evidence.to_dict()})
            if self.why:
                alarm["note"] = self.why
            if self.validation is not None:
                model = _told(model, self.validation.parts, panel.unlike)
        alarm |= {"centred": True} if self.centred else {}
        left = {"not_done": self.why} if self.validation is None else self.validation.judged_as(model).to_dict()
        return model.replace(fit_summary={**model.fit_summary, "alarm": alarm}, validation=left)


def fit_monitored(
    transients: Sequence[Transient],
    *,
    groups: Sequence[Any] | str | None = None,
    false_alarms: float | None = None,
    progress: Callable[[str], None] | None = None,
    centred: bool = False,
    **options: Any,
) -> Monitored:
    """Fit, leave out, and learn the panel; `options` as `identification.fit` takes them.

    `centred`: deviations are measured from the medians of the recordings.
    """
    if centred:
        options["operating_point"] = _medians(transients)
    model = fit(transients, progress=progress, **options)
    of_the_fit_alone = ("schedule", "transient_weights", "describe_data", "seek_carriers", "near")
    left = {name: value for name, value in options.items() if name not in of_the_fit_alone}
    if options.get("transient_weights") is not None:
        why = "transient_weights are for all recordings, so none can be left out"
        return Monitored(model, None, None, why, centred)
    if why := _too_large(transients, groups):
        seen = _seen(model, transients, _SHOWN)
        return Monitored(*_armed(seen, seen.parts, false_alarms), None, why, centred)
    try:
        validation = leave_out(transients, full=model, groups=groups, folds=FOLDS, progress=progress, **left)
        fitted = fitted_parts(model, transients)
        return Monitored(*_armed(validation, fitted, false_alarms), validation, "", centred)
    except (FitError, ModelError) as error:  # too little is left to fit to: the fit itself is valid
        if false_alarms is not None:
            raise FitError(f"no alarm can be learnt for a rate: {error}") from None
        return Monitored(model, None, None, str(error), centred)


def _too_large(transients: Sequence[Transient], groups: Sequence[Any] | str | None) -> str:
    """Why no part of the recordings is left out, as that would take too long; "" if some are."""
    names, _ = resolve_groups(transients, groups)
    units = len(set(names)) if names else len(transients)
    kept = float(sum(np.count_nonzero(t.usable) for t in transients)) * transients[0].x.shape[1]
    size = kept * (transients[0].x.shape[1] + transients[0].u.shape[1])
    if min(units if units > 1 else FOLDS, FOLDS) * size <= LIMIT and kept <= _MOST:
        return ""
    return f"learnt on fitted data, as leaving out takes {FOLDS} fits of a problem of {size:.2g} elements"


def monitored_like(
    taken: Monitored, model: UncertainLTI, transients: Sequence[Transient], rate: float | None, note: str
) -> Monitored:
    """The model of all recordings with the panel that some of them left out, as `taken` was; `note`: on which."""
    if taken.panel is None:
        return replace(taken, model=model)
    seen, left = _seen(model, transients, _SHOWN), taken.validation and taken.validation.judged_as(model)
    fitted = fitted_parts(model, transients) if left else seen.parts
    return Monitored(*_armed(left or seen, fitted, rate), left, "; ".join(filter(None, (taken.why, note))))


def _seen(model: UncertainLTI, transients: Sequence[Transient], most: float) -> Validation:
    """Some of what was fitted, so many transitions, judged by the fit as if it had been left out."""
    return Validation(model, fitted_parts(model, transients, most), "transients", 0.0, 0.9)


def _armed(validation: Validation, fitted: Sequence[Part], rate: float | None) -> tuple[UncertainLTI, Panel]:
    panel = learn(validation, fitted, rate)
    return validation.model.replace(alarm=panel.rules, residuals=panel.residuals), panel


def _told(model: UncertainLTI, parts: Sequence[Part], unlike: Collection[str]) -> UncertainLTI:
    """The model with what parts left out tell of it besides thresholds; `unlike`: those that others do not cover.

    Ranges alone are its domain where new combinations are the rule, and healthy repeats went as far as in any of them.
    """
    alike = [part.outside_domain / part.judged for part in parts if part.judged and part.name not in unlike]
    measure = None if alike and np.median(alike) > NEW else model.domain.measure
    most = [repeats_in(part.model, part.transient).most for part in parts]
    repeats = model.repeats and model.repeats.reaching(np.max([np.zeros((4, model.n)), *most], axis=0))
    return model.replace(domain=replace(model.domain, measure=measure), repeats=repeats)


def choose_monitored(transients: Sequence[Transient], ways: Sequence[Mapping[str, Any]], **options: Any) -> Monitored:
    """The first of some ways to fit, or the one whose panel sees clearly smaller jumps.

    `ways`: options of `fit_monitored`, from the simplest on; `options`: further ones, for all. Where the recordings do
    not repeat one another the simplest is kept: nothing shows there that another holds. The others are compared on what
    was fitted, and the best of them with the first on what was left out, all by their envelopes of one step: horizons
    are fitted to the way that is taken. Of a machine too large to be left out some of the states are compared.
    """
    alone = {name: value for name, value in options.items() if name not in ("horizons", "widths", "drop_horizons")}
    judged = _on_some_states(transients, ways, alone)
    way = judged or ways[0]
    taken = fit_monitored(transients, **{**alone, **way})
    if len(ways) > 1 and not judged and taken.panel is not None and taken.panel.vouched:
        best, model = _promising(transients, ways, alone, taken.model)
        other = fit_monitored(transients, near=model, **{**alone, **best}) if best is not way else taken
        if other.panel is not None and other.panel.figure < CLEARLY * taken.panel.figure:
            way, taken = best, other
    return fit_monitored(transients, near=taken.model, **{**options, **way}) if options.get("horizons") else taken


def _on_some_states(
    transients: Sequence[Transient], ways: Sequence[Mapping[str, Any]], options: Mapping[str, Any]
) -> Mapping[str, Any] | None:
    """The promising way by about STATES of the states, each fitted with the others, as which they are now controls.

    None where all are compared: of few states, where parts are left out, or something is given for each of them.
    """
    first, n = transients[0], transients[0].x.shape[1]
    given = ("weights", "transient_weights", "structure", "operating_point")
    known = options.get("schedule") or (first.signals is not None and first.signals.structure)
    if len(ways) < 2 or n < 2 * STATES or known or any(options.get(name) is not None for name in given):
        return None
    if not _too_large(transients, options.get("groups")):
        return None
    kept, of = np.arange(0, n, n // STATES), point_of(first)
    rest = np.setdiff1d(np.arange(n), kept)
    u_s, U = np.append(of.u_s, of.x_s[rest]), np.append(of.U, of.X[rest])
    point = replace(of, x_s=of.x_s[kept], X=of.X[kept], u_s=u_s, U=U)
    names, others = ([first.state_names[i] for i in some] for some in (kept, rest))
    some = [
        t.replace(
            x=t.x[:, kept],
            u=np.hstack([t.u, t.x[:, rest]]),
            signals=None,
            state_names=names,
            control_names=[*t.control_names, *others],
        )
        for t in transients
    ]
    return _promising(some, ways, {**options, "operating_point": point})[0]


def _promising(
    transients: Sequence[Transient],
    ways: Sequence[Mapping[str, Any]],
    options: Mapping[str, Any],
    first: UncertainLTI | None = None,
) -> tuple[Mapping[str, Any], UncertainLTI | None]:
    """The way whose panel sees clearly smaller jumps on what was fitted, and that fit; `first`: in the first way."""
    named = ("describe_data", "seek_carriers", "groups", "false_alarms")
    shared = {name: value for name, value in options.items() if name not in named}
    one_length = is_constant(np.concatenate([t.transitions().dt for t in transients]))
    best, least = (ways[0], first), np.inf
    for way in ways:
        asked = {**shared, **way}
        if one_length and asked["additive"] == "both" and {**way, "additive": "noise"} in ways:  # the same problem
            continue
        if asked.pop("centred", False):
            asked["operating_point"] = _medians(transients)
        try:
            model = first if first and way is ways[0] else fit(transients, describe_data=False, **asked)
            seen = _seen(model, transients, _COMPARED)
            size = learn(seen, seen.parts).figure
        except (FitError, ModelError):
            continue
        if size < CLEARLY * least:
            best, least = (way, model), size
    return best


def point_of(transient: Transient) -> OperatingPoint:
    """That of the signals of a recording; of arrays values as they are."""
    if (signals := transient.signals) is not None:
        return OperatingPoint.of(signals.states, signals.controls, signals.scheduling)
    n, m, q = (values.shape[1] for values in (transient.x, transient.u, transient.s))
    return OperatingPoint(np.zeros(n), np.zeros(m), np.ones(n), np.ones(m), np.zeros(q), np.ones(q))


def _medians(transients: Sequence[Transient]) -> OperatingPoint:
    """The medians of all samples, with the scales of the signals."""
    every = (np.concatenate([getattr(t, name) for t in transients]) for name in "xus")
    x, u, s = (np.nan_to_num(np.nanmedian(values, axis=0)) for values in every)
    return replace(point_of(transients[0]), x_s=x, u_s=u, s_s=s)


NOTE = (
    "brought up to date: of each recording counts how far it was from the fit that was made without it at the time; a "
    "fit of all recordings leaves each out of all the others, which moves thresholds"
)
GROWN = 1.5
"""Size of what the alarm sees after updates, over that before them, from which on it is said."""
KEPT = "the alarm is that of before the update, as it is not the panel that the first fit learnt; fit all recordings"


def updated(
    model: UncertainLTI, transients: Iterable[Transient] | Transient, progress: Callable[[str], None] | None = None
) -> UncertainLTI:
    """`UncertainLTI.update`."""
    found, runs = update.updated(model, transients, progress)
    alarm, kept = model.fit_summary.get("alarm", {}), (model.memory or {}).get("evidence")
    if "limit_per_hour" not in alarm:  # given by hand, or not learnt
        return found

    def beyond(steps: Transitions) -> NDArray[np.intp]:
        """1 where a transition begins outside the ranges of the model: all that it keeps of what it was fitted to."""
        return model.domain.beyond(model.normalised_columns(steps)).astype(np.intp)

    parts = [part for run in runs if (part := judge(model, model, run, run.name, level=beyond)).judged]
    panel = None
    if kept and parts:
        panel = extended(Evidence.from_dict(kept), model, alarm, parts, fitted_parts(found, runs))
    if panel is None:
        alarm = {**alarm, "note": KEPT} if parts else alarm
    else:
        found = found.replace(alarm=panel.rules)
        before, note = alarm.get("fitted_figure", alarm["figure"]), NOTE
        if panel.figure > GROWN * before:
            note = (
                f"brought up to date with recordings unlike the earlier ones, so that the alarm sees only changes "
                f"{panel.figure / before:.1f} times as large as the fit before them saw: fit all recordings together, "
                "but for those of another machine, or in other units"
            )
        kept = panel.evidence.to_dict()
        alarm = {**alarm, **panel.summary(found), "fitted_figure": before, "note": note}
    memory = found.memory and {**found.memory, "evidence": kept}
    return found.replace(memory=memory, fit_summary={**found.fit_summary, "alarm": alarm})
