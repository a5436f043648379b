# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""An update with the monitor that goes with it: new recordings are left out, as they were not fitted yet."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.identification import update
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.sampling.transient import Transient, Transitions
from uncertain_lti.validation.panel import Evidence, extended
from uncertain_lti.validation.part import Reach, fitted_parts, judge

NOTE = (
    "brought up to date: of each recording counts how far it was from the fit that was made without it at the time; a "
    "fit of all recordings leaves each out of all the others, which moves thresholds a little"
)
KEPT = "the alarm is that of before the update, as it is not the panel that the first fit learnt; fit all recordings"


def updated(
    model: UncertainLTI, transients: Iterable[Transient] | Transient, progress: Callable[[str], None] | None = None
) -> UncertainLTI:
    """`UncertainLTI.update`."""
    found, runs = update.updated(model, transients, progress)
    alarm, kept = model.fit_summary.get("alarm", {}), (model.memory or {}).get("evidence")
    if "limit_per_hour" not in alarm:  # given by hand, or not learnt
        return found
    every = (judge(model, model, run, run.name, reach=_Ranges(model)) for run in runs)
    parts = [part for part in every if part.judged]
    panel = None
    if kept and parts:
        panel = extended(Evidence.from_dict(kept), model, alarm, parts, fitted_parts(found, runs))
    if panel is None:
        alarm = {**alarm, "note": KEPT} if parts else alarm
    else:
        found = found.replace(alarm=panel.rules)
        kept, alarm = panel.evidence.to_dict(), {**alarm, **panel.summary(found), "note": NOTE}
    memory = found.memory and {**found.memory, "evidence": kept}
    return found.replace(memory=memory, fit_summary={**found.fit_summary, "alarm": alarm})


class _Ranges(Reach):
    """Beyond what a model was fitted to is what leaves its ranges: all that it keeps of them."""

    def __init__(self, model: UncertainLTI) -> None:
        self._model = model

    def level(self, steps: Transitions) -> NDArray[np.intp]:
        """(K,): 0 where a transition begins within the ranges, 1 beyond them."""
        return self._model.domain.beyond(self._model.normalised_columns(steps)).astype(np.intp)
