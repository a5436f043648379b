# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Verdict: what the monitor says of one clock message, of a whole transient, and of an instant to come."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cache, partial
from typing import Any

import cython
import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array, Mask, runs
from uncertain_lti.base.text import html_table, named, number, plural, times
from uncertain_lti.kernel.arithmetic import FLAGS, LOWER, RESIDUAL, UPPER, UTILISATION
from uncertain_lti.model.repeats import Looked
from uncertain_lti.monitor.alarm import Alarm, Raised
from uncertain_lti.sampling.clock import Status
from uncertain_lti.sampling.sampler import Step
from uncertain_lti.sampling.transient import Transient

NUMBERS = ("flags", "lower", "upper", "state", "utilisation")
"""Numbers of a verdict, for each state."""
_OF_JUDGEMENT = {"lower": LOWER, "upper": UPPER, "flags": FLAGS, "utilisation": UTILISATION}
_KINDS = 2 + UTILISATION  # of the state and of a judgement


def place(name: str, n: int) -> slice:
    """Where the numbers of one kind are in `Verdict.packed`."""
    if name == "horizon_utilisation":  # one step, then the horizons
        return slice(8 * n * (_KINDS - 1), None)
    start = 8 * n * (0 if name == "state" else 1 + _OF_JUDGEMENT[name])
    return slice(start, start + 8 * n)


@cython.cclass
class Verdict:
    """Verdict on one clock message.

    Numbers of each state, n each, are computed when they are asked for, by `numbers`, by `packed`, or as a new array by
    the attribute of that name: a live monitor makes one verdict per message, and often only the alarm is
    needed. They are `flags` (0 contained, 1 violated, NaN no verdict), `lower`, `upper` and `state` (the bounds that
    were judged and the sample, recorded units) and `utilisation` ((x_next - centre) / half, with half before the
    margin); NaN where there is no verdict.

    Parameters
    ----------
    step : Step
        The clock message.
    alarm : bool
        The alarm after this verdict.
    judgement : Judgement or None
        None if there is no verdict.
    status : Status, optional
        In place of that of the step, where the monitor gives no verdict on it.
    alarms : Alarm, optional
        The rules after it, whose statistics and reasons it keeps.
    longer : buffer of doubles, optional
        Utilisation by the model's horizons, horizon after horizon; for models that have some.
    looked : Looked, optional
        What the step says of repeats.
    armed : bool, default True
        Whether the alarm could be raised.

    Attributes
    ----------
    frozen, repeating : tuple of Moved
        States that are frozen, and others that repeat for longer than ever in the fit.
    withheld : tuple of int
        States without a verdict, as their rows need one that is frozen.
    ordinary : bool
        There is a verdict, and it says that every state is contained, within the fitted domain, without an alarm that
        could be raised and without a state that repeats for longer than ever.
    """

    t_ns = cython.declare(object, visibility="readonly")
    arrival_ns = cython.declare(object, visibility="readonly")
    status = cython.declare(object, visibility="readonly")
    outside_domain = cython.declare(cython.bint, visibility="readonly")
    unknown_regime = cython.declare(cython.bint, visibility="readonly")
    alarm = cython.declare(cython.bint, visibility="readonly")
    armed = cython.declare(cython.bint, visibility="readonly")
    ordinary = cython.declare(cython.bint, visibility="readonly")
    frozen = cython.declare(object, visibility="readonly")
    repeating = cython.declare(object, visibility="readonly")
    withheld = cython.declare(object, visibility="readonly")
    _after = cython.declare(object)
    _before = cython.declare(object)
    _judgement = cython.declare(object)
    _alarms = cython.declare(object)
    _rules = cython.declare(object)
    _statistics = cython.declare(object)
    _longer = cython.declare(object)

    def __init__(
        self,
        step: Step,
        alarm: bool,
        judgement: Any,
        status: Status | None = None,
        alarms: Alarm | None = None,
        longer: Any = None,
        looked: Looked | None = None,
        armed: bool = True,
    ) -> None:
        self.frozen, self.withheld, self.repeating = ((), (), ()) if looked is None else looked
        self.t_ns, self.arrival_ns, self.status = step.t_ns, step.arrival_ns, status or step.status
        self._after, self._before = step.after, step.before
        self.outside_domain = self.unknown_regime = self.ordinary = False
        if judgement is not None:
            self.outside_domain, self.unknown_regime = judgement.outside_domain, judgement.unknown_regime
            odd = self.outside_domain or alarm or not armed or self.withheld or self.repeating
            self.ordinary = judgement.contained and not odd
        self.alarm, self.armed = alarm, armed
        self._judgement, self._longer = judgement, longer
        self._alarms = alarms
        self._statistics, self._rules = None, ()
        if alarms is not None:
            if alarms.alarm:
                self._rules = alarms.raised()
            if alarms.names and judgement is not None:
                self._statistics = alarms.values()

    def __repr__(self) -> str:
        if not self.judged:
            return f"Verdict({self.status.value}: no verdict)"
        left = int((self.flags == 1.0).sum())
        said = f"{left} of {plural(len(self.flags), 'state')} violated" if left else "contained"
        where = ", in a regime that was not fitted" if self.unknown_regime else ", outside the fitted domain"
        return f"Verdict({said}{where if self.outside_domain else ''}{', ALARM' * self.alarm})"

    @property
    def judged(self) -> bool:
        """Whether there is a verdict, the message being neither dropped nor without a complete transition."""
        return self._judgement is not None

    @property
    def violated(self) -> bool:
        """Some state left its bounds."""
        return self._judgement is not None and not self._judgement.contained

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self._after)

    @property
    def statistic_names(self) -> tuple[str, ...]:
        """Names of `statistics`, `energy/fan_speed` for example; none where the alarm has containment rules alone."""
        return () if self._alarms is None else self._alarms.names

    @property
    def statistics(self) -> Array:
        """Each statistic over its threshold (S,): beyond 1 and -1 it raises the alarm; NaN without a verdict."""
        if self._statistics is None:
            return np.full(len(self.statistic_names), np.nan)
        return np.array(self._statistics, dtype=np.float64)

    @property
    def raised(self) -> tuple[Raised, ...]:
        """Which rules raise the alarm, with state, horizon and the statistic over its threshold.

        None without an alarm, and none without a verdict, where the alarm stays as it was.
        """
        if self._alarms is None or not self._rules or self._judgement is None:
            return ()
        over = self.horizon_utilisation
        found: tuple[Raised, ...] = self._alarms.reasons(self._rules, self.statistics.tolist(), over, self.flags)
        return found

    @property
    def horizons(self) -> int:
        """Number of horizons of the model."""
        return 0 if self._longer is None else len(self._longer) // self.n

    def numbers(self, name: str) -> list[float]:
        """Numbers of one kind.

        Parameters
        ----------
        name : str
            One of `NUMBERS`, horizon_utilisation, row by row, or statistics.

        Returns
        -------
        list of float (n,)
            As the attribute of that name.
        """
        if name == "state":
            return list(self._after)
        if name == "horizon_utilisation":
            return [*self.numbers("utilisation"), *(() if self._longer is None else self._longer)]
        if name == "statistics":
            return list[float](self.statistics.tolist())
        if self._judgement is None:
            return [math.nan] * len(self._after)
        return list[float](self._judgement.numbers(_OF_JUDGEMENT[name]).tolist())

    def reach(self, largest: Any) -> None:
        """Raise the largest |utilisation| of each state so far to that of a verdict that is judged.

        Parameters
        ----------
        largest : array of doubles (n,)
            Takes the result.
        """
        self._judgement.reach(largest)

    def packed(self) -> bytes:
        """All numbers, one kind after another; `place` says where each is.

        Returns
        -------
        bytes
            Little-endian doubles.
        """
        n = len(self._after)
        state = _packer(n)(*self._after)
        numbers = _nothing(n) if self._judgement is None else self._judgement.packed()
        return state + numbers if self._longer is None else state + numbers + bytes(self._longer.tobytes())

    def packed_statistics(self) -> bytes:
        """`statistics` as bytes.

        Returns
        -------
        bytes
            Little-endian doubles.
        """
        found = self.statistics if self._statistics is None else self._statistics
        return bytes(found.tobytes())

    @property
    def before(self) -> list[float]:
        """[x; u; s] of the sample before, in recorded units (n + m + q,)."""
        return list(self._before)

    @property
    def flags(self) -> Array:
        """0 contained, 1 violated, NaN no verdict (n,)."""
        return np.array(self.numbers("flags"), dtype=np.float64)

    @property
    def state(self) -> Array:
        """The sample judged, in recorded units (n,)."""
        return np.array(self._after, dtype=np.float64)

    @property
    def lower(self) -> Array:
        """Lower bound that was judged, in recorded units (n,)."""
        return np.array(self.numbers("lower"), dtype=np.float64)

    @property
    def upper(self) -> Array:
        """Upper bound that was judged, in recorded units (n,)."""
        return np.array(self.numbers("upper"), dtype=np.float64)

    @property
    def utilisation(self) -> Array:
        """Where between its bounds the sample lies (n,)."""
        return np.array(self.numbers("utilisation"), dtype=np.float64)

    @property
    def horizon_utilisation(self) -> Array:
        """The same for one step and for each of the model's horizons (H, n); NaN where a window is broken."""
        longer = () if self._longer is None else self._longer
        return np.concatenate([self.utilisation, longer]).reshape(-1, self.n)


@cache
def _packer(n: int) -> Callable[..., bytes]:
    return struct.Struct(f"<{n}d").pack


@cache
def _nothing(n: int) -> bytes:
    return struct.pack("<d", math.nan) * (n * (_KINDS - 1))


class Foreseen:
    """Bounds at an instant to come.

    `t_ns`: the instant, ns; `bounds`: the lower bounds and then the upper ones, recorded units.
    """

    __slots__ = ("_bounds", "_n", "t_ns")

    def __init__(self, t_ns: int, bounds: Any) -> None:
        self.t_ns, self._bounds, self._n = t_ns, bounds, len(bounds) // 2

    @property
    def lower(self) -> Array:
        """Lower bounds (n,)."""
        return np.array(self._bounds[: self._n], dtype=np.float64)

    @property
    def upper(self) -> Array:
        """Upper bounds (n,)."""
        return np.array(self._bounds[self._n :], dtype=np.float64)

    def packed(self) -> bytes:
        """The bounds, where `Verdict.packed` has them."""
        n = self._n
        numbers = bytearray(place("utilisation", n).stop)
        numbers[place("lower", n)] = self._bounds[:n].tobytes()
        numbers[place("upper", n)] = self._bounds[n:].tobytes()
        return bytes(numbers)


def _kept(value: Any) -> Any:
    return value


@dataclass(frozen=True, repr=False)
class Verdicts:
    """Verdicts over one transient, one row per sample k = 0..N; row k judges the arrival at t_k.

    Parameters
    ----------
    transient : Transient
        What was judged.
    numbers : callable
        Computes what a `Judgement` holds of each state, five arrays (N+1, n), when one of them is first asked for.
    utilisation : array (N+1, n)
        (x_next - centre) / half, with half before the margin.
    judged : array (N+1,) of bool
        Whether there is a verdict on some state that counts.
    violated : array (N+1,) of bool
        Whether some state left its bounds.
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
    over_thresholds : callable
        Computes `statistics`, and the states that those of all together point to, when they are first asked for.
    rule_alarms : array (N+1, rules) of bool
        Which rules raise the alarm after each sample.
    alarms : Alarm
        The rules, with their `labels` and the `names` of the statistics.
    longer_utilisation : array (N+1, horizons, n)
        Utilisation by each of the model's horizons; NaN where its window is broken.
    longer_residual : array (N+1, horizons, n)
        x_next - centre, normalised, by each of them.
    why_frozen : dict
        Of each sample and number of a state that is frozen there, in words why it is.
    asked : array (N+1,) of bool
        Whether a verdict was asked for.
    armed : array (N+1,) of bool
        Whether the alarm could be raised.
    """

    transient: Transient
    numbers: Callable[[], list[Array]]
    utilisation: Array
    judged: Mask
    violated: Mask
    outside_domain: Mask
    alarm: Mask
    unfitted_step: Mask
    unlisted_mode: Mask
    unknown_regime: Mask
    frozen: Mask
    withheld: Mask
    repeating: Mask
    over_thresholds: Callable[[], tuple[Array, NDArray[np.int16]]]
    rule_alarms: Mask
    alarms: Alarm
    longer_utilisation: Array
    longer_residual: Array
    why_frozen: dict[tuple[int, int], str]
    asked: Mask
    armed: Mask

    def __reduce__(self) -> tuple[Any, ...]:  # with the numbers, not what computes them
        given = {one.name: getattr(self, one.name) for one in fields(self)}
        later = {name: partial(_kept, given[name]()) for name in ("numbers", "over_thresholds")}
        return partial(Verdicts, **given | later), ()

    def __repr__(self) -> str:
        judged, left = int(self.judged.sum()), int(self.violated.sum())
        raised = len(runs(self.alarm))
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
            first = f"{transient.t[bad[0]]:.4f} s" if len(bad) else "-"
            mean, largest = (float(width.mean()), float(width.max())) if count else (None, None)
            inside = f"{1 - len(bad) / count:.3%}" if count else "-"
            rows.append([named(name, unit), str(len(bad)), inside, number(mean), number(largest), first])
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
        which = {Status.STEP: self.unfitted_step, Status.MODE: self.unlisted_mode, Status.FROZEN: frozen}
        for kind, marks in (which | {Status.UNASKED: ~self.asked}).items():
            for k in np.flatnonzero(marks):
                kinds[k] = kind
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
        values, blamed = self.over_thresholds()
        rules = ((i, int(blamed[k, i])) for i in np.flatnonzero(self.rule_alarms[k]).tolist())
        sizes = np.concatenate([self.utilisation[k, None], self.longer_utilisation[k]])
        return self.alarms.reasons(rules, values[k].tolist(), sizes, self.flags[k])

    @property
    def state(self) -> Array:
        """The samples, in recorded units (N+1, n)."""
        return self.transient.x

    @property
    def flags(self) -> Array:
        """0 contained, 1 violated, NaN no verdict (N+1, n)."""
        return self.numbers()[FLAGS]

    @property
    def lower(self) -> Array:
        """Lower bounds, recorded units; NaN without a verdict (N+1, n)."""
        return self.numbers()[LOWER]

    @property
    def upper(self) -> Array:
        """Upper bounds, recorded units; NaN without a verdict (N+1, n)."""
        return self.numbers()[UPPER]

    @property
    def residual(self) -> Array:
        """x_next - centre, or less what the law of the model's residuals expects, normalised; NaN without a verdict.

        (N+1, n).
        """
        return self.numbers()[RESIDUAL]

    @property
    def statistics(self) -> Array:
        """Each statistic over its threshold (N+1, S): beyond 1 and -1 it raises the alarm; NaN without a verdict."""
        return self.over_thresholds()[0]
