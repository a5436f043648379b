# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Transient: one recorded run as arrays, cut into segments at gaps."""

from __future__ import annotations

import math
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from numbers import Real
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import LONGEST_S, Array
from uncertain_lti.base.errors import TransientError, each_of, refuse_other
from uncertain_lti.base.text import html_table, meant, named, number, plural
from uncertain_lti.sampling import samples
from uncertain_lti.sampling.clock import Counters, Status, longest_step, passed, to_ns
from uncertain_lti.signals.signal import AT, At
from uncertain_lti.signals.signal_map import ARRIVAL, Signal, SignalMap


@dataclass(frozen=True)
class Transitions:
    """The usable transitions k -> k+1 of one transient, in recorded units; all numbers are finite.

    `transient`: whose arrays they take, without a copy where none is missing between the first and the last; `k` (N,):
    position of sample k in it.
    """

    transient: Transient
    k: NDArray[np.intp]

    def take(self, which: NDArray[np.bool_] | slice) -> Transitions:
        """Some of them, `which` (N,)."""
        return Transitions(self.transient, self.k[which])

    @property
    def consecutive(self) -> bool:
        """None is missing between the first and the last, so x_next of one is x of the next."""
        return len(self.k) > 0 and int(self.k[-1] - self.k[0]) + 1 == len(self.k)

    def rows(self, values: NDArray[Any], after: int = 0) -> NDArray[Any]:
        """What an array of the transient, samples first, holds so many samples after each t_k."""
        if self.consecutive:
            return values[int(self.k[0]) + after : int(self.k[-1]) + 1 + after]
        return values[self.k + after]

    @cached_property
    def dt(self) -> Array:
        """Δt_k, (N,), s."""
        if self.transient.step is not None:
            return np.full(len(self.k), self.transient.step)
        return np.asarray((self.rows(self.transient.t_ns, 1) - self.rows(self.transient.t_ns)) * 1e-9)

    @cached_property
    def x(self) -> Array:
        """States at t_k, (N, n)."""
        return self.rows(self.transient.x)

    @cached_property
    def u(self) -> Array:
        """Controls at t_k, (N, m)."""
        return self.rows(self.transient.u)

    @cached_property
    def x_next(self) -> Array:
        """States at t_{k+1}, (N, n)."""
        return self.rows(self.transient.x, 1)

    @cached_property
    def s(self) -> Array:
        """Further scheduling signals at t_k, (N, q)."""
        return self.rows(self.transient.s)


class Transient:
    """One recorded run: samples (t, x, u), the steps between them, and where they may not be joined.

    Parameters
    ----------
    t : array (N+1,)
        Instants: s where the numbers are floating point, ns where they are integers; or datetime64. Kept as integer ns.
    x : array (N+1, n)
        States in recorded units; NaN where a sample has none.
    u : array (N+1, m)
        Controls in recorded units, u[k] recorded at t[k]. At the departure, u[k] acts from t[k] to t[k+1], and the last
        row is never used.
    s : array (N+1, q), optional
        Further scheduling signals in recorded units, which are neither state nor control; s[k] is known at t[k], and
        the last row is never used. Default none.
    at : {"departure", "arrival", "both"} or mapping, optional
        Which recorded value of a control acts during the step from t[k] to t[k+1]: u[k], u[k+1], or each of them by a
        column of its own, the second named "NAME at arrival"; for all controls, or by name. Default that of `signals`,
        whose recordings are read so, else departure.
    name : str, default "transient"
        What messages call this run (the bag or file).
    signals : SignalMap, optional
        Where the arrays came from; gives names, units and the operating point to a fit.
    state_names : sequence of str, optional
        Names where there is no SignalMap; default x1, x2, ...
    control_names : sequence of str, optional
        Names where there is no SignalMap; default u1, u2, ...
    scheduling_names : sequence of str, optional
        Names where there is no SignalMap; default s1, s2, ...
    max_gap : float, optional
        A step longer than this, s, starts a new segment. Default 2.5 x the median step; math.inf for no limit.
    min_step : float, default 0.0
        A sample less than this, s, after the one before is dropped, one with an equal stamp always.
    step : float or "recorded", optional
        Δt of every transition, s, for samples that are even and whose stamps are not; "recorded" for the difference of
        the instants. Default that of `signals`, else "recorded".
    counters : mapping, optional
        Counts of a `Sampler` to start from.
    sources : sequence of paths, optional
        Files that the run was read from.
    notes : sequence of str, optional
        What the reader of the files had to say.

    Raises
    ------
    TransientError
        Shapes do not fit, times are not finite, steps are about a nanosecond, or max_gap, min_step or step is out of
        range.
    """

    t_ns: NDArray[np.int64]
    x: Array
    u: Array
    s: Array
    segment: NDArray[np.int32]
    step: float | None
    counters: Counters

    def __init__(
        self,
        t: ArrayLike,
        x: ArrayLike,
        u: ArrayLike,
        *,
        s: ArrayLike | None = None,
        at: At | Mapping[str, At] | None = None,
        name: str = "transient",
        signals: SignalMap | None = None,
        state_names: Sequence[str] | None = None,
        control_names: Sequence[str] | None = None,
        scheduling_names: Sequence[str] | None = None,
        max_gap: float | None = None,
        min_step: float = 0.0,
        step: float | Literal["recorded"] | None = None,
        counters: Mapping[str, int] | None = None,
        sources: Sequence[str | os.PathLike[str]] = (),
        notes: Sequence[str] = (),
    ) -> None:
        self.name = name
        refuse_other(signals, (SignalMap, type(None)), f"{name}: signals", "load_signals reads a file", TransientError)
        self.signals = signals
        t_ns = samples.nanoseconds(t, name, recorded=signals is not None)
        self.x = samples.matrix(x, len(t_ns), "x", name)
        self.u = samples.matrix(u, len(t_ns), "u", name)
        self.s = np.empty((len(t_ns), 0)) if s is None else samples.matrix(s, len(t_ns), "s", name)
        if self.x.shape[1] == 0:
            raise TransientError(f"{name}: x has no column; give at least one state")
        self.state_names = samples.names_of(state_names, signals.states if signals else None, "x", self.x, name)
        self.control_names = samples.names_of(control_names, signals.controls if signals else None, "u", self.u, name)
        self.scheduling_names = samples.names_of(
            scheduling_names, signals.scheduling if signals else None, "s", self.s, name
        )
        self.ends: tuple[At, ...] = ("departure",) * self.u.shape[1]
        if signals:
            self.ends = tuple(c.at for c in signals.controls)
        refuse_other(counters, (Mapping, type(None)), f"{name}: counters", "give counts by name", TransientError)
        self.counters = Counters(counters or {})
        paths = each_of(sources, (str, os.PathLike), f"{name}: sources", "give a list of paths", TransientError)
        self.sources = tuple(os.fspath(path) for path in paths)
        self.notes = tuple(each_of(notes, str, f"{name}: notes", "give a list of texts", TransientError))
        for what, value in (("max_gap", 1.0 if max_gap is None else max_gap), ("min_step", min_step)):
            refuse_other(value, Real, f"{name}: {what}", "give a number of seconds", TransientError)
        if max_gap is not None and not (0 < max_gap <= LONGEST_S or max_gap == math.inf):
            must = f"it must be a positive number of seconds up to {LONGEST_S:g}, or inf"
            raise TransientError(f"{name}: max_gap is {max_gap}; {must}")
        if not 0 <= min_step <= LONGEST_S:
            raise TransientError(f"{name}: min_step is {min_step}; it must be 0 s or more, up to {LONGEST_S:g}")
        if step is None:
            step = "recorded" if signals is None or signals.step == "constant" else signals.step
        if step != "recorded" and not (isinstance(step, (int, float, np.number)) and 1e-9 <= step <= LONGEST_S):
            raise TransientError(f"{name}: step is {step}; it must be 1e-9 to {LONGEST_S:g} s, or recorded")
        self.step = None if isinstance(step, str) else float(step)
        min_step_ns = to_ns(min_step)
        if max_gap is None:
            max_gap = longest_step([t_ns], min_step_ns)
        self.max_gap, self.min_step = float(max_gap), float(min_step)
        kept, self.segment = samples.segments_of(t_ns, to_ns(self.max_gap), min_step_ns, self.counters)
        self.t_ns = t_ns
        if len(kept) < len(t_ns):
            self.t_ns, self.x, self.u, self.s = t_ns[kept], self.x[kept], self.u[kept], self.s[kept]
        given = at is not None or (signals is not None and signals.ends_given)
        self.ends_given = given or "arrival" in self.ends
        self._take_controls(_ends_of(at or "departure", self))
        for array in (self.t_ns, self.x, self.u, self.s, self.segment):
            array.flags.writeable = False

    def _take_controls(self, wanted: Sequence[At]) -> None:
        """Form u, its names and ends from controls at the departure, one end of each."""
        if tuple(wanted) == self.ends:
            return
        columns, names, ends = list[Array](), list[str](), list[At]()
        for column, name, end, asked in zip(self.u.T, self.control_names, self.ends, wanted, strict=True):
            for one in ("departure", "arrival") if asked == "both" else (asked,):
                later = one == "arrival" != end
                columns.append(np.append(column, math.nan)[1:] if later else column)
                names.append(name + ARRIVAL if asked == "both" and later else name)
                ends.append(one)
        self.u, self.control_names, self.ends = np.column_stack(columns), tuple(names), tuple(ends)

    def controls_at(self, at: At | Mapping[str, At]) -> Transient:
        """The same run with controls at the departure of each step taken at its arrival, or at both ends.

        Parameters
        ----------
        at : {"departure", "arrival", "both"} or mapping
            For all controls for which that can be, which are neither delayed nor memories nor at the arrival already;
            or by name.

        Returns
        -------
        Transient
            Its `signals`, if it has some, say the same.

        Raises
        ------
        TransientError
            There is no such control, or it cannot be taken there.
        """
        wanted = _ends_of(at, self)
        changed = self.replace()
        if self.signals is not None:
            controls = [replace(c, at=end) for c, end in zip(self.signals.controls, wanted, strict=True)]
            changed.signals = replace(self.signals, controls=tuple(controls))
        changed._take_controls(wanted)
        changed.ends_given = True
        changed.u.flags.writeable = False
        return changed

    def replace(self, part: slice | NDArray[np.intp] = slice(None), **changes: Any) -> Transient:
        """The same run, or a part of it, with some constructor arguments replaced.

        Parameters
        ----------
        part : slice or array of int, optional
            Samples, in order; a part has neither counters nor notes of its own. Default all.
        **changes : object
            Constructor arguments by name; x and u with as many rows as the part.

        Returns
        -------
        Transient
            A new transient.
        """
        x, u = (changes.pop(name, getattr(self, name)[part]) for name in ("x", "u"))
        names = ("state_names", "control_names", "scheduling_names")
        kept = ("name", "signals", "max_gap", "min_step", "sources", *names)
        arguments: dict[str, Any] = {"s": self.s[part], "step": self.step or "recorded"}
        arguments |= {name: getattr(self, name) for name in kept}
        if isinstance(part, slice) and part == slice(None):
            arguments |= {"counters": self.counters, "notes": self.notes}
        arguments |= changes
        if changes.get("signals") is not None:  # it has the names
            arguments |= {which: changes.get(which) for which in names}
        changed = Transient(self.t_ns[part], x, u, **arguments)
        changed.ends_given = self.ends_given
        if changed.signals is None:
            ends = dict(zip(self.control_names, self.ends, strict=True))
            changed.ends = tuple(ends.get(name, "departure") for name in changed.control_names)
        return changed

    def scheduled_on(self, names: Collection[str]) -> Transient:
        """The same run without the further scheduling signals that are not named.

        Parameters
        ----------
        names : collection of str
            Scheduling signals that stay.

        Returns
        -------
        Transient
            This one if all of them stay.
        """
        keep = [j for j, name in enumerate(self.scheduling_names) if name in names]
        if len(keep) == len(self.scheduling_names):
            return self
        if self.signals is not None:
            return self.replace(s=self.s[:, keep], signals=self.signals.scheduled_on(names))
        return self.replace(s=self.s[:, keep], scheduling_names=[self.scheduling_names[j] for j in keep])

    @property
    def signal_names(self) -> tuple[str, ...]:
        """Names of the states, the controls and the further scheduling signals, in this order."""
        return *self.state_names, *self.control_names, *self.scheduling_names

    @property
    def t(self) -> Array:
        """Instants in s since the first sample, (N+1,)."""
        return (self.t_ns - self.t_ns[0]) * 1e-9 if len(self.t_ns) else np.empty(0)

    @property
    def dt(self) -> Array:
        """Δt_k = (t_{k+1} - t_k) * 1e-9 s, (N,); also across segments. Within one it is `step` where that is given."""
        recorded = np.diff(self.t_ns) * 1e-9
        return recorded if self.step is None else np.where(np.diff(self.segment) == 0, self.step, recorded)

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Whether the transition k -> k+1 lies in one segment and is finite at both ends, (N,)."""
        if len(self.t_ns) < 2:
            return np.zeros(0, dtype=bool)
        same = self.segment[1:] == self.segment[:-1]
        with np.errstate(over="ignore", invalid="ignore"):
            if math.isfinite(sum(float(a.sum()) for a in (self.x, self.u, self.s))):  # the usual case, in less time
                return np.asarray(same)
        finite_x, finite_u, finite_s = (np.asarray(np.isfinite(z).all(axis=1)) for z in (self.x, self.u, self.s))
        return np.asarray(same & finite_x[:-1] & finite_u[:-1] & finite_s[:-1] & finite_x[1:])

    def transitions(self) -> Transitions:
        """The usable transitions, as arrays in recorded units.

        Returns
        -------
        Transitions
            N of them.
        """
        return Transitions(self, np.flatnonzero(self.usable))

    def statuses(self) -> list[Status]:
        """What the `Sampler` says of each sample, (N+1,).

        Returns
        -------
        list of Status
            One of each sample, N+1.
        """
        if not len(self):
            return []
        kinds, masks = zip(*unusable(self).items(), strict=True)
        every = (*kinds, Status.OK)
        return [Status.FIRST, *map(every.__getitem__, np.select(masks, range(len(kinds)), len(kinds)).tolist())]

    @property
    def segments(self) -> int:
        """Number of segments."""
        return int(self.segment[-1]) + 1 if len(self) else 0

    def __len__(self) -> int:
        return len(self.t_ns)

    def __repr__(self) -> str:
        span, usable = passed(self.t_ns), plural(int(self.usable.sum()), "usable transition")
        signals = f"{plural(self.x.shape[1], 'state')}, {plural(self.u.shape[1], 'control')}"
        recorded = f"{plural(len(self), 'sample')} over {span:g} s"
        return f"Transient({self.name!r}: {recorded}, {signals}, {usable} in {plural(self.segments, 'segment')})"

    def _repr_html_(self) -> str:
        """Range, largest step and missing samples of each signal."""
        rows = []
        kinds = ["state"] * self.x.shape[1] + ["control"] * self.u.shape[1] + ["scheduling"] * self.s.shape[1]
        units = [s.unit for s in self.signals.signals] if self.signals else [""] * len(kinds)
        columns = [*self.x.T, *self.u[:-1].T, *self.s[:-1].T]
        for name, kind, unit, values in zip(self.signal_names, kinds, units, columns, strict=False):
            finite = values[np.isfinite(values)]
            low, high = (float(finite.min()), float(finite.max())) if len(finite) else (math.nan, math.nan)
            rms = float(np.sqrt(np.nanmean(np.diff(values) ** 2))) if len(finite) > 1 else math.nan
            cells = [named(name, unit), kind, number(low), number(high), number(rms)]
            rows.append([*cells, str(len(values) - len(finite))])
        counted = sorted((reason, n) for reason, n in self.counters.items() if n and reason != "samples")
        below = [f"not used, or without a verdict: {', '.join(f'{n} {reason}' for reason, n in counted)}"]
        header = ("signal", "", "least", "greatest", "rms step", "missing")
        return html_table(repr(self), header, rows, below if counted else [])

    def to_dataframe(self, absolute: bool = False) -> Any:
        """As a pandas DataFrame, of which `from_dataframe` makes the run again.

        Parameters
        ----------
        absolute : bool, default False
            Index with instants (UTC, to the nanosecond) in place of seconds since the first sample.

        Returns
        -------
        pandas.DataFrame
            One row per sample; a column per state, control and further scheduling signal, in recorded units.
        """
        import pandas

        index = pandas.Index(self.t, name="time [s]")
        if absolute:
            index = pandas.DatetimeIndex(self.t_ns.view("M8[ns]"), tz="UTC", name="time")
        columns = list(self.signal_names)
        return pandas.DataFrame(np.hstack([self.x, self.u, self.s]), index=index, columns=columns)

    @classmethod
    def from_dataframe(
        cls, frame: Any, *, time: str | None = None, states: Sequence[str], controls: Sequence[str], **options: Any
    ) -> Transient:
        """From a pandas DataFrame.

        Parameters
        ----------
        frame : pandas.DataFrame
            One row per sample.
        time : str, optional
            Column with the instants: numbers in s, or time stamps. Default: the index.
        states : sequence of str
            Columns. A name that is there twice is taken once if both columns are equal.
        controls : sequence of str
            Columns, likewise.
        **options : object
            As in Transient.

        Returns
        -------
        Transient
            The run.

        Raises
        ------
        TransientError
            A column is missing or not numeric.
        """
        name = options.setdefault("name", "data frame")
        states, controls = samples.listed(states, "states", name), samples.listed(controls, "controls", name)
        t, z = samples.frame_columns(frame, time, [*states, *controls], name)
        x, u = z[:, : len(states)], z[:, len(states) :]
        return cls(t, x, u, state_names=states, control_names=controls, **options)

    @classmethod
    def from_csv(
        cls,
        path: str | os.PathLike[str],
        *,
        time: str,
        states: Sequence[str],
        controls: Sequence[str],
        delimiter: str = ",",
        **options: Any,
    ) -> Transient:
        """From a CSV file with one header line; empty cells are NaN.

        A name that is there twice is taken once if both columns are equal.

        Parameters
        ----------
        path : path
            The file.
        time : str
            Column with the instants, s.
        states : sequence of str
            Columns.
        controls : sequence of str
            Columns.
        delimiter : str, default ","
            Between the cells of a line.
        **options : object
            As in Transient.

        Returns
        -------
        Transient
            The run.

        Raises
        ------
        TransientError
            The file is missing, a column is missing, or a cell is not a number; names the line.
        """
        name = options.setdefault("name", os.fspath(path))
        states, controls = samples.listed(states, "states", name), samples.listed(controls, "controls", name)
        z = samples.csv_columns(path, [time, *states, *controls], delimiter, name)
        t, x, u = z[:, 0], z[:, 1 : 1 + len(states)], z[:, 1 + len(states) :]
        return cls(t, x, u, state_names=states, control_names=controls, **options)


def unusable(transient: Transient) -> dict[Status, NDArray[np.bool_]]:
    """Which transitions are not used (N,), each by the reason that goes before the others."""
    back, cut = np.diff(transient.t_ns) < 0, np.diff(transient.segment) > 0
    return {Status.RESET: back, Status.GAP: cut & ~back, Status.MISSING: ~(transient.usable | cut | back)}


def _ends_of(at: At | Mapping[str, At], transient: Transient) -> tuple[At, ...]:
    """For each control of a run at which end it is to be taken; one that is at the arrival stays there."""
    names, listed = transient.control_names, transient.signals.controls if transient.signals else ()
    chosen = at if isinstance(at, Mapping) else {}
    for name, end in chosen.items() if isinstance(at, Mapping) else [("", at)]:
        if end not in AT:
            raise TransientError(f"{transient.name}: at is {end!r}; it must be departure, arrival or both")
        if name and name not in names:
            there = ", ".join(names) or "none"
            near = meant(name, names)
            raise TransientError(f"{transient.name}: there is no control '{name}'{near}; there are {there}")
    found = list(transient.ends)
    for j, name in enumerate(names):
        bound = listed[j].delay or listed[j].memory if listed else None
        if name in chosen and chosen[name] != found[j] and (bound or found[j] == "arrival"):
            why = "is delayed, or taken from earlier samples" if bound else "is at the arrival"
            raise TransientError(f"{transient.name}: control '{name}' {why}; read it at the departure")
        if name in chosen or not (isinstance(at, Mapping) or bound or found[j] == "arrival" or name + ARRIVAL in names):
            found[j] = chosen[name] if isinstance(at, Mapping) else at
    return tuple(found)


def controls_as(transient: Transient, controls: Sequence[Signal]) -> Transient:
    """A run with its controls at the ends at which a model takes them, if it has each of them at the departure."""
    wanted = list[At]()
    for control in controls:
        if wanted and control.at == "arrival" and control.name.endswith(ARRIVAL) and wanted[-1] == "departure":
            wanted[-1] = "both"
        else:
            wanted.append(control.at)
    if transient.ends == tuple(c.at for c in controls) or len(wanted) != len(transient.ends):
        return transient
    return transient.controls_at(dict(zip(transient.control_names, wanted, strict=True)))


def listed_transients(given: Transient | Iterable[Transient]) -> list[Transient]:
    """One run or several as a list."""
    instead = "read recordings with read_transients first, or make one with Transient(t, x, u)"
    if isinstance(given, Transient):
        return [given]
    refuse_other(given, Iterable, "the recording", instead, TransientError)
    transients = list(given)
    for k, transient in enumerate(transients):
        refuse_other(transient, Transient, f"transient {k}", instead, TransientError)
    return transients
