# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Verdicts: what the monitor says of a whole transient."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.english import plural, times
from uncertain_lti.base.html_table import html_table, name_with_unit, number_text
from uncertain_lti.monitor.alarm import Alarm, Raised
from uncertain_lti.sampling.status import Status
from uncertain_lti.sampling.transient import Transient


@dataclass(frozen=True, repr=False)
class Verdicts:
    """Verdicts over one transient, one row per sample k = 0..N; row k judges the arrival at t_k.

    Parameters
    ----------
    transient : Transient
        What was judged.
    flags : array (N+1, n)
        0 contained, 1 violated, NaN no verdict.
    lower : array (N+1, n)
        Lower bounds, recorded units; NaN without a verdict.
    upper : array (N+1, n)
        Upper bounds, recorded units; NaN without a verdict.
    utilisation : array (N+1, n)
        (x_next - centre) / half, with half before the margin.
    judged : array (N+1,) of bool
        Whether there is a verdict on some state that counts.
    outside_domain : array (N+1,) of bool
        z(t_{k-1}) lies outside the ranges seen in the fit.
    alarm : array (N+1,) of bool
        The alarm after each sample.
    unfitted_step : array (N+1,) of bool
        The step is out of the fitted range, so there is no verdict.
    unlisted_mode : array (N+1,) of bool
        The model lists no such mode of its scheduling signal, so there is no verdict.
    unknown_regime : array (N+1,) of bool
        A scheduling signal lies beyond the end knots, or no recording visited the regime; then the sample counts as
        outside the domain, too.
    frozen : array (N+1, n) of bool
        The state repeats exactly although the model moves it.
    withheld : array (N+1, n) of bool
        There is no verdict on the state, as its row needs one that is frozen here or was one sample before.
    repeating : array (N+1, n) of bool
        The state repeats exactly for longer than ever in the fit, and is not frozen.
    statistics : array (N+1, S)
        Each statistic of the alarm over its threshold: beyond 1 and -1 it raises the alarm; NaN without a verdict.
    rule_alarms : array (N+1, rules) of bool
        Which rules raise the alarm after each sample.
    alarms : Alarm
        The rules, with their `labels` and the `names` of the statistics.
    longer_utilisation : array (N+1, horizons, n)
        Utilisation by each of the model's horizons; NaN where its window is broken.
    why_frozen : dict, optional
        Of each sample and number of a state that is frozen there, in words why it is.
    asked : array (N+1,) of bool, optional
        Whether a verdict was asked for; default all.
    """

    transient: Transient
    flags: Array
    lower: Array
    upper: Array
    utilisation: Array
    judged: NDArray[np.bool_]
    outside_domain: NDArray[np.bool_]
    alarm: NDArray[np.bool_]
    unfitted_step: NDArray[np.bool_]
    unlisted_mode: NDArray[np.bool_]
    unknown_regime: NDArray[np.bool_]
    frozen: NDArray[np.bool_]
    withheld: NDArray[np.bool_]
    repeating: NDArray[np.bool_]
    statistics: Array
    rule_alarms: NDArray[np.bool_]
    alarms: Alarm
    longer_utilisation: Array
    why_frozen: dict[tuple[int, int], str] = field(default_factory=dict)
    asked: NDArray[np.bool_] | None = None

    def __repr__(self) -> str:
        judged, left = int(self.judged.sum()), int(self.violated.sum())
        raised = int(np.count_nonzero(np.diff(np.concatenate([[False], self.alarm]).astype(np.int8)) == 1))
        said = f"{1 - left / judged:.3%} inside all bounds" if judged else "none possible"
        alarm = f"alarm raised {times(raised)}" if raised else "no alarm"
        return f"Verdicts({self.transient.name!r}: {plural(judged, 'verdict')}, {said}, {alarm})"

    def _repr_html_(self) -> str:
        """Violations and widths of each state."""
        transient, judged = self.transient, self.judged
        rows = []
        units = [s.unit for s in transient.signals.states] if transient.signals else [""] * self.flags.shape[1]
        for i, (name, unit) in enumerate(zip(transient.state_names, units, strict=True)):
            bad = np.flatnonzero(self.flags[:, i] == 1.0)
            given = judged & ~np.isnan(self.flags[:, i])
            count, width = int(given.sum()), (self.upper - self.lower)[given, i]
            rows.append(
                [
                    name_with_unit(name, unit),
                    str(len(bad)),
                    f"{1 - len(bad) / count:.3%}" if count else "–",
                    number_text(float(width.mean())) if count else "–",
                    number_text(float(width.max())) if count else "–",
                    f"{transient.t[bad[0]]:.4f} s" if len(bad) else "–",
                ]
            )
        return html_table(repr(self), ("state", "violations", "inside", "mean width", "largest", "first"), rows)

    def statuses(self) -> list[Status]:
        """Status of each sample.

        Returns
        -------
        list of Status
            N+1, as of `Transient.statuses`, with STEP where a step is out of the range of the fit, MODE where the
            model lists no such mode, FROZEN where every state that counts needs a frozen one, and UNASKED where no
            verdict was asked for.
        """
        kinds = self.transient.statuses()
        for k in np.flatnonzero(~self.judged):
            if kinds[k] is Status.OK:  # but for the two below, a value is beyond what the arithmetic carries
                kinds[k] = Status.MISSING
        frozen = self.withheld.any(axis=1) & ~self.judged
        for which, kind in (
            (self.unfitted_step, Status.STEP),
            (self.unlisted_mode, Status.MODE),
            (frozen, Status.FROZEN),
        ):
            for k in np.flatnonzero(which):
                kinds[k] = kind
        if self.asked is not None:
            for k in np.flatnonzero(~self.asked):
                kinds[k] = Status.UNASKED
        return kinds

    @property
    def horizon_utilisation(self) -> Array:
        """Utilisation for one step and for each of the model's horizons (N+1, H, n); NaN where a window is broken."""
        return np.concatenate([self.utilisation[:, None], self.longer_utilisation], axis=1)

    @property
    def statistic_names(self) -> tuple[str, ...]:
        """Names of `statistics`, `energy/fan_speed` for example; none where the alarm has containment rules alone."""
        return self.alarms.names

    def raised(self, k: int) -> tuple[Raised, ...]:
        """Which rules raise the alarm after one sample.

        Parameters
        ----------
        k : int
            The sample.

        Returns
        -------
        tuple of Raised
            With state, horizon and the statistic over its threshold; none without an alarm or a verdict.
        """
        if not self.judged[k]:
            return ()
        rules = np.flatnonzero(self.rule_alarms[k]).tolist()
        return self.alarms.reasons(rules, self.statistics[k].tolist(), self.horizon_utilisation[k], self.flags[k])

    @property
    def state(self) -> Array:
        """The samples, in recorded units (N+1, n)."""
        return self.transient.x

    @property
    def violated(self) -> NDArray[np.bool_]:
        """Whether some state left its bounds, (N+1,)."""
        left: NDArray[np.bool_] = (self.flags == 1.0).any(axis=1)
        return left
