# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""tune(): what `fit` does not do by itself, delays, schedules, lags and horizons, tried by what their panels see."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from uncertain_lti.base.errors import FitError, UncertainLTIError
from uncertain_lti.base.progress import CountedStep
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.envelope_monitor import EnvelopeMonitor
from uncertain_lti.proposal import ways
from uncertain_lti.proposal.fitting import fit
from uncertain_lti.proposal.ways import Setting
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.validation.monitor_fit import CLEARLY, fit_monitored
from uncertain_lti.validation.panel import worth

WITHIN = 1.0
"""Time of the longest horizon tried, s."""


class _SpentError(Exception):
    """The budget is spent."""


@dataclass(frozen=True, eq=False)
class Tuned:
    """What `tune` chose, and all it tried.

    Parameters
    ----------
    model : UncertainLTI
        With its panel; `fit_summary["alarm"]` says what it promises and `fit_summary["tune"]` what was tried.
    reason : str
        Why this way.
    trials : tuple of dict
        Every way with the size of the jumps that it sees, over those of `fit` alone, or why it was refused.
    """

    model: UncertainLTI
    reason: str
    trials: tuple[dict[str, Any], ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain data for the model file and for `--json`.

        Returns
        -------
        dict
            The reason, and a row for each way.
        """
        return {"reason": self.reason, "trials": list(self.trials)}


def tune(
    transients: Sequence[Transient] | Transient,
    false_alarms: float | None = None,
    *,
    budget: float = math.inf,
    groups: Sequence[Any] | str | None = None,
    faulty: Mapping[str, Sequence[Transient]] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Tuned:
    """Try what `fit` does not do by itself, and take what sees clearly smaller jumps on left-out data.

    Controls taken earlier, schedules, lags and rates of states, and horizons are tried in turn, each beside the best so
    far, with the panel learnt anew. A way is taken if the jumps that its panel sees are smaller by CLEARLY than those
    of the best so far, and if it misses none of the recordings with a fault that `fit` alone sees.

    Parameters
    ----------
    transients : Transient or sequence of Transient
        Recordings of the healthy machine.
    false_alarms : float, optional
        As in `fit`.
    budget : float, optional
        Nothing new is begun after so many s, and what is under way then is broken off; the result then depends on how
        fast the machine is. Ctrl-C does the same.
    groups : sequence or str, optional
        As in `validate`.
    faulty : mapping of str to sequence of Transient, optional
        Recordings with a fault, by what it is.
    progress : callable, optional
        Called with one line of text per way.

    Returns
    -------
    Tuned
        The model with the best panel, and what was tried.

    Raises
    ------
    FitError
        The budget is not positive, or `fit` alone cannot learn a panel.
    """
    transients = [transients] if isinstance(transients, Transient) else list(transients)
    if not budget > 0:
        raise FitError(f"budget is {budget}; give a positive number of seconds")
    until = time.monotonic() + budget
    model = fit(transients, false_alarms=false_alarms, groups=groups)
    alarm = model.fit_summary["alarm"]
    if "biases" not in alarm:
        raise FitError(f"fit alone cannot learn an alarm, so nothing can be compared: {alarm['not_learnt']}")
    options = {"criterion": model.fit_summary["criterion"], "additive": model.fit_summary["additive"]}
    if alarm.get("centred"):
        options["centred"] = True
    best, least = Setting("as fit does", options), alarm["figure"]
    base, trials = least, [_row(best.words, least, least, model)]
    missed = _missed(model, best, faulty or {})
    reason = "no way sees clearly smaller jumps on left-out data than fit alone"

    def hurried(text: str) -> None:
        if time.monotonic() > until:
            raise _SpentError
        if progress is not None:
            progress(CountedStep(text, len(trials), max(len(trials) + 1, 12)))

    def attempt(setting: Setting) -> bool:
        nonlocal best, least, model, reason, missed
        hurried(setting.words)
        try:
            runs = setting.prepared(transients)
            asked = dict(setting.options)
            widths = asked.pop("widths", "constant")
            found = fit_monitored(
                runs,
                groups=groups,
                false_alarms=false_alarms,
                progress=hurried,
                **{"schedule": {}, **asked, "widths": {h: widths for h in asked.get("horizons", ())}},
            )
            if found.panel is None:
                raise FitError(found.why)
            kind, headline = worth(found.model, found.panel)
            if kind == "none":
                raise FitError(headline)
        except UncertainLTIError as error:
            trials.append({"way": setting.words, "refused": str(error)})
            return False
        made, size = found.finished(), found.panel.figure
        unseen = _missed(made, setting, faulty or {})
        trials.append(_row(setting.words, size, base, made))
        if size > CLEARLY * least or unseen - missed:
            return False
        best, least, model, missed = setting, size, made, unseen
        reason = f"{setting.words}: it sees jumps of {least / base:.2g} of the size that fit alone sees"
        return True

    try:
        for setting in ways.delays(transients, best):
            attempt(setting)
        for settings in ways.schedules(transients, best):
            for setting in settings:  # more and more knots, as long as they see more
                if not attempt(setting):
                    break
        for setting in ways.memories(transients, best):
            attempt(setting)
        for setting in ways.horizons(transients, best, WITHIN):
            attempt(setting)
    except (_SpentError, KeyboardInterrupt):
        reason += "; the time ran out before every way was tried"
    tuned = Tuned(model, reason, tuple(trials))
    return Tuned(model.replace(fit_summary={**model.fit_summary, "tune": tuned.to_dict()}), reason, tuned.trials)


def _missed(model: UncertainLTI, setting: Setting, faulty: Mapping[str, Sequence[Transient]]) -> set[tuple[str, int]]:
    """Recordings with a fault that raise no alarm."""
    monitor = EnvelopeMonitor(model)
    return {
        (label, k)
        for label, runs in faulty.items()
        for k, run in enumerate(setting.prepared(runs))
        if not monitor.check(run).alarm.any()
    }


def _row(words: str, size: float, base: float, model: UncertainLTI) -> dict[str, Any]:
    """One way in the table: sizes of jumps, widths over the ranges, false alarms."""
    span = (model.domain.x_max - model.domain.x_min) * model.operating_point.X
    width = np.asarray(model.fit_summary["mean_width_recorded"])
    share = np.divide(width, span, out=np.full(model.n, np.inf), where=span > 0)
    return {
        "way": words,
        "size": size / base,
        "width_over_range": float(share.max()) if np.isfinite(share).all() else None,
        "limit_per_hour": model.fit_summary["alarm"]["limit_per_hour"],
    }
