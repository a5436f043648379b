# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""A fit with the monitor that goes with it: fitted, left out, and armed with a panel, once for each way to fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from uncertain_lti.base.errors import FitError, ModelError
from uncertain_lti.identification import fit
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.validation.groups import resolve_groups
from uncertain_lti.validation.left_out import validate
from uncertain_lti.validation.panel import Panel, learn, promises, worth
from uncertain_lti.validation.part import judge
from uncertain_lti.validation.result import Validation

FOLDS = 5
"""Fits without a part of the recordings, groups or, of a single recording, blocks."""
LIMIT = 1e9
"""Elements of all left-out problems together up to which parts are left out: some minutes."""
_SHOWN = 1_000_000  # transitions that a panel is learnt from where nothing is left out


@dataclass(frozen=True)
class Monitored:
    """One way to fit: `model` with its alarm, `panel` with what it promises (None if none could be learnt: `why`),
    `validation` of what was left out (None if nothing was)."""

    model: UncertainLTI
    panel: Panel | None
    validation: Validation | None = None
    why: str = ""

    def finished(self) -> UncertainLTI:
        """The model with what the panel promises in its summary, and what was left out in its validation."""
        model, panel = self.model, self.panel
        if panel is None:
            alarm: dict[str, Any] = {"not_learnt": self.why}
        else:
            kind, headline = worth(model, panel)
            alarm = {**panel.to_dict(), "worth": kind, "headline": headline, "promises": promises(model, panel)}
            if self.why:
                alarm["note"] = self.why
        left = {"not_done": self.why} if self.validation is None else replace(self.validation, model=model).to_dict()
        return model.replace(fit_summary={**model.fit_summary, "alarm": alarm}, validation=left)


def fit_monitored(
    transients: Sequence[Transient],
    *,
    groups: Sequence[Any] | str | None = None,
    false_alarms: float | None = None,
    progress: Callable[[str], None] | None = None,
    describe_data: bool = True,
    seek_carriers: bool = False,
    **options: Any,
) -> Monitored:
    """Fit, leave out, and learn the panel; `options` as `identification.fit` takes them."""
    model = fit(
        transients, describe_data=describe_data, seek_carriers=seek_carriers, progress=progress, **options
    )  # fmt: skip
    names, _ = resolve_groups(transients, groups)
    units = len(set(names)) if names else len(transients)
    left = {k: v for k, v in options.items() if k not in ("schedule", "horizons", "widths", "operating_point")}
    size = float(model.fit_summary["transitions"]) * model.n * (model.n + model.m)
    if options.get("transient_weights") is not None:
        return Monitored(model, None, why="transient_weights are for all recordings, so none can be left out")
    left.pop("transient_weights", None)
    if min(units if units > 1 else FOLDS, FOLDS) * size > LIMIT:
        why = f"learnt on fitted data, as leaving out takes {FOLDS} fits of a problem of {size:.2g} elements"
        runs = _some(transients, model)
        seen = Validation(model, tuple(judge(model, model, run, run.name) for run in runs), "transients", 0.0, 0.9)
        return Monitored(*_armed(model, seen, runs, false_alarms), None, why)
    try:
        validation = validate(
            transients,
            full=model,
            operating_point=model.operating_point,
            groups=groups,
            blocks=None if units > 1 else FOLDS,
            folds=FOLDS,
            progress=progress,
            **left,
        )
        runs = [t.scheduled_on([s.name for s in model.signals.scheduling]) for t in transients]
        return Monitored(*_armed(model, validation, runs, false_alarms), validation)
    except (FitError, ModelError) as error:  # too little is left to fit to: the fit itself is valid
        if false_alarms is not None:
            raise FitError(f"no alarm can be learnt for a rate: {error}") from None
        return Monitored(model, None, why=str(error))


def _armed(
    model: UncertainLTI, validation: Validation, runs: Sequence[Transient], rate: float | None
) -> tuple[UncertainLTI, Panel]:
    panel = learn(validation, runs, rate)
    return model.replace(alarm=panel.rules), panel


def _some(transients: Sequence[Transient], model: UncertainLTI) -> list[Transient]:
    """A stretch of each recording, of as many transitions together as a panel is learnt from."""
    scheduled = [t.scheduled_on([s.name for s in model.signals.scheduling]) for t in transients]
    share = _SHOWN / max(sum(len(t) for t in scheduled), 1)
    if share >= 1:
        return scheduled
    return [t.replace(slice(0, max(2, int(share * len(t))))) for t in scheduled if len(t) > 1]
