# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Verdict: what the monitor says of one clock message."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable
from functools import cache
from typing import Any

import cython
import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.english import plural
from uncertain_lti.kernel.arithmetic import FLAGS, LOWER, UPPER, UTILISATION
from uncertain_lti.monitor.alarm import Alarm, Raised
from uncertain_lti.monitor.frozen import Looked
from uncertain_lti.sampling.sampler import Step
from uncertain_lti.sampling.status import Status

NUMBERS = ("flags", "lower", "upper", "state", "utilisation")
"""Numbers of a verdict, for each state."""
_OF_JUDGEMENT = {"lower": LOWER, "upper": UPPER, "flags": FLAGS, "utilisation": UTILISATION}
_KINDS = 2 + UTILISATION  # of the state and of a judgement
_EVERY = frozenset(range(1 + UTILISATION))


def kinds(names: Iterable[str]) -> frozenset[int]:
    """What `Verdict.packed` is asked for."""
    parts = ("utilisation" if name == "horizon_utilisation" else name for name in names)
    return frozenset(_OF_JUDGEMENT[part] for part in parts if part != "state")


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

    Attributes
    ----------
    frozen, repeating : tuple of Moved
        States that are frozen, and others that repeat for longer than ever in the fit.
    withheld : tuple of int
        States without a verdict, as their rows need one that is frozen.
    ordinary : bool
        There is a verdict, and it says that every state is contained, within the fitted domain, without an alarm and
        without a state that repeats for longer than ever.
    """

    t_ns = cython.declare(object, visibility="readonly")
    arrival_ns = cython.declare(object, visibility="readonly")
    status = cython.declare(object, visibility="readonly")
    outside_domain = cython.declare(cython.bint, visibility="readonly")
    unknown_regime = cython.declare(cython.bint, visibility="readonly")
    alarm = cython.declare(cython.bint, visibility="readonly")
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
    ) -> None:
        self.frozen, self.withheld, self.repeating = ((), (), ()) if looked is None else looked
        self.t_ns, self.arrival_ns, self.status = step.t_ns, step.arrival_ns, status or step.status
        self._after, self._before = step.after, step.before
        self.outside_domain = self.unknown_regime = self.ordinary = False
        if judgement is not None:
            self.outside_domain, self.unknown_regime = judgement.outside_domain, judgement.unknown_regime
            odd = self.outside_domain or alarm or self.withheld or self.repeating
            self.ordinary = judgement.contained and not odd
        self.alarm = alarm
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
        return f"Verdict({said}{', ' + self._where if self.outside_domain else ''}{', ALARM' * self.alarm})"

    @property
    def _where(self) -> str:
        return "in a regime that was not fitted" if self.unknown_regime else "outside the fitted domain"

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

    def packed(self, wanted: frozenset[int] = _EVERY) -> bytes:
        """Numbers as bytes, one kind after another; `place` says where each is.

        Parameters
        ----------
        wanted : frozenset of int, optional
            From `kinds`; default all. There may be anything in the places of others, which uncompiled take time.

        Returns
        -------
        bytes
            Little-endian doubles.
        """
        n = len(self._after)
        state = _packer(n)(*self._after)
        if self._judgement is None:
            numbers = _nothing(n)
        else:
            numbers = self._judgement.packed()
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
