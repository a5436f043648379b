# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""UncertainLTI: the uncertain linear model, its one-step bounds, discrepancies and file."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.english import plural
from uncertain_lti.base.errors import ModelError, SignalError
from uncertain_lti.kernel.arithmetic import Judge, Runs, arrivals, blended, centre_and_half, edges
from uncertain_lti.model.alarm_rule import (
    JOINT,
    AlarmRule,
    Rule,
    StatisticRule,
    checked_rules,
    containment,
    with_containment,
)
from uncertain_lti.model.domain import Domain, Sampling
from uncertain_lti.model.file import arguments, read, structure, write
from uncertain_lti.model.horizon import Horizon, Run, Windows, checked_horizons, unbroken_over, windows_of
from uncertain_lti.model.operating_point import OperatingPoint, normalised
from uncertain_lti.model.repeats import Repeats
from uncertain_lti.model.residuals import Residuals
from uncertain_lti.model.schedule import BlockData, Schedule
from uncertain_lti.model.signature import Signature, checked_signatures
from uncertain_lti.model.terms import ADDITIVE, ARRAYS, HALF_WIDTHS, REQUIRED, SHAPES, Term, checked, tables
from uncertain_lti.sampling.transient import Transient, Transitions
from uncertain_lti.signals.signal_map import Signal, SignalMap


class UncertainLTI:
    r"""dx/dt = (A ± ΔA) x + (B ± ΔB) u + (c ± Δc), measured with noise of at most v.

    The bounds of one step from a recorded sample, Leibov (2006), eqs. (6)(7) with additive terms:

    .. math::
        h &= Δt (ΔA |x| + ΔB |u| + Δc) + v \\
        x_{min}, x_{max} &= x + Δt (A x + B u + c) ∓ h

    With a schedule of R blocks every array has a leading axis of R, and the elements are blended with the weights of
    the scheduling vector before the bounds are computed (`schedule`).

    Parameters
    ----------
    A : array (n, n), or (R, n, n) with a schedule, and so for those that follow
        Nominal elements, 1/s.
    B : array (n, m)
        The same for the controls, 1/s.
    dA : array (n, n)
        Half-widths of A, all >= 0, 1/s.
    dB : array (n, m)
        Half-widths of B, all >= 0, 1/s.
    c : array (n,), optional
        Drift, 1/s; 0 by default.
    dc : array (n,), optional
        Half-width of the disturbance, 1/s; 0 by default.
    v : array (n,), optional
        Half-width of measurement noise, normalised; not multiplied by Δt; 0 by default.
    schedule : Schedule, optional
        Weights of the blocks; None for one block.
    block_data : sequence of BlockData, optional
        What the fit knows of each block; default nothing.
    horizons : sequence of Horizon, optional
        Envelopes over several steps; default none. The model has them sorted, the shortest first.
    run : Run, optional
        What is run over the windows of the horizons; default the nominal model.
    signals : SignalMap, optional
        Names, topics, operating point; default names x1, x2, ..., u1, u2, ... and values used as they are.
    sampling : Sampling, optional
        How samples were cut in the fit; default unknown.
    domain : Domain, optional
        Ranges seen in the fit; default none.
    alarm_rule : AlarmRule, optional
        Containment of one step: in place of that of `alarm`; default `AlarmRule()` where neither is given.
    alarm : sequence of AlarmRule or StatisticRule, optional
        Every rule that raises the alarm; default the containment of one step alone.
    residuals : Residuals, optional
        Of the recordings of the fit; default unknown.
    repeats : Repeats, optional
        Exact repeats of healthy recordings; without them no state is called frozen.
    signatures : sequence of Signature, optional
        Patterns of known faults; default none.
    fit_summary : mapping, optional
        How the model was fitted; plain data that goes to the file as it is.
    validation : mapping, optional
        How it was validated, likewise.

    Raises
    ------
    ModelError
        Shapes do not fit, a number is not finite, or a half-width is negative; names the field.
    """

    def __init__(
        self,
        A: ArrayLike,
        B: ArrayLike,
        dA: ArrayLike,
        dB: ArrayLike,
        c: ArrayLike | None = None,
        dc: ArrayLike | None = None,
        v: ArrayLike | None = None,
        *,
        schedule: Schedule | None = None,
        block_data: Sequence[BlockData] | None = None,
        horizons: Sequence[Horizon] = (),
        run: Run | None = None,
        signals: SignalMap | None = None,
        sampling: Sampling | None = None,
        domain: Domain | None = None,
        alarm_rule: AlarmRule | None = None,
        alarm: Sequence[Rule] | None = None,
        residuals: Residuals | None = None,
        repeats: Repeats | None = None,
        signatures: Sequence[Signature] = (),
        fit_summary: Mapping[str, Any] | None = None,
        validation: Mapping[str, Any] | None = None,
    ) -> None:
        self.dA: Array
        self.dB: Array
        self.c: Array
        self.dc: Array
        self.v: Array
        self.schedule = schedule
        lead = () if schedule is None else (schedule.blocks,)
        self.A = checked(A, "A", None)
        n = self.A.shape[-1] if self.A.ndim else 0
        if self.A.shape != (*lead, n, n) or n == 0:
            each = f", once for each of {plural(lead[0], 'block')}" if lead else ""
            raise ModelError(f"A has shape {self.A.shape}; it must be square, one row per state{each}")
        self.B = checked(B, "B", None)
        if self.B.size == 0:
            self.B = np.zeros((*lead, n, 0))
        if self.B.ndim != self.A.ndim or self.B.shape[:-1] != (*lead, n):
            each = f" of {plural(lead[0], 'block')}" if lead else ""
            raise ModelError(f"B has shape {self.B.shape}; it must have {plural(n, 'row')}, one per state{each}")
        m = self.B.shape[-1]
        given: dict[str, Any] = {"dA": dA, "dB": dB, "c": c, "dc": dc, "v": v}
        for name, value in given.items():
            shape = (*lead, *SHAPES[name].shape(n, m))
            half_width = name in HALF_WIDTHS
            value = np.zeros(shape) if value is None and name not in REQUIRED else value
            setattr(self, name, checked(value, name, shape, half_width))
        for name in ARRAYS:
            getattr(self, name).flags.writeable = False
        self.horizons = checked_horizons(horizons, self.A.shape, m)
        self.run = run
        if run is not None and (run.A.shape, run.B.shape) != (self.A.shape, self.B.shape):
            raise ModelError(
                f"run: A {run.A.shape} and B {run.B.shape} do not fit the model, whose A is {self.A.shape} and B "
                f"{self.B.shape}"
            )
        if signals is None:
            signals = SignalMap(
                tuple(Signal(f"x{i + 1}", "", f"x{i + 1}") for i in range(n)),
                tuple(Signal(f"u{j + 1}", "", f"u{j + 1}") for j in range(m)),
                source="model",
            )
        if (len(signals.states), len(signals.controls)) != (n, m):
            raise ModelError(
                f"{plural(len(signals.states), 'state')} and {plural(len(signals.controls), 'control')} are named for "
                f"A {self.A.shape} and B {self.B.shape}"
            )
        self.signals = signals
        self.operating_point = OperatingPoint.of(signals.states, signals.controls, signals.scheduling)
        names = [s.name for s in signals.signals]
        self._positions = list(schedule.positions(names)) if schedule is not None else []
        for name in names[n + m :]:
            if schedule is None or name not in [axis.signal for axis in schedule.axes]:
                raise ModelError(f"scheduling signal '{name}' schedules nothing; leave it out")
        self.block_data = tuple(block_data or (BlockData() for _ in range(lead[0] if lead else 1)))
        if len(self.block_data) != (lead[0] if lead else 1):
            raise ModelError(f"{plural(len(self.block_data), 'block')} of data for {plural(*lead or (1,), 'block')}")
        self.sampling = sampling or _sampling(signals)
        unbounded = Domain(np.full(n, -np.inf), np.full(n, np.inf), np.full(m, -np.inf), np.full(m, np.inf))
        self.domain = domain or unbounded
        self.residuals = residuals
        self.alarm = self._alarm(alarm, alarm_rule)
        self.repeats = repeats
        self.signatures = checked_signatures(signatures, n)
        if repeats is not None and len(repeats.longest_repeat_s) != n:
            raise ModelError(f"field 'frozen' has {len(repeats.longest_repeat_s)} numbers for {plural(n, 'state')}")
        self.fit_summary = dict(fit_summary or {})
        self.validation = dict(validation or {})
        self.tables = tables({name: getattr(self, name) for name in ARRAYS})

    def _alarm(self, alarm: Sequence[Rule] | None, alarm_rule: AlarmRule | None) -> tuple[Rule, ...]:
        rules = (alarm_rule or AlarmRule(),) if alarm is None else checked_rules(alarm)
        if alarm is not None and alarm_rule is not None:
            rules = with_containment(rules, alarm_rule)
        if self.residuals is not None and len(self.residuals.mean) != self.n:
            raise ModelError(f"residuals of {plural(len(self.residuals.mean), 'state')} for {plural(self.n, 'state')}")
        horizons = {1, *(h.steps for h in self.horizons)}
        for rule in rules:
            if rule.horizon not in horizons:
                raise ModelError(
                    f"alarm: {rule.kind} is at {plural(rule.horizon, 'step')}, and the model has bounds over "
                    f"{', '.join(map(str, sorted(horizons)))}; choose one of them"
                )
            if isinstance(rule, StatisticRule):
                rule.thresholds(self.n)
            if rule.kind in JOINT:
                self.residuals_at(rule.horizon, rule.kind)
        return rules

    def residuals_at(self, horizon: int = 1, kind: str = "a joint statistic") -> Residuals:
        """Mean and covariance of the healthy utilisation of one step, or of a horizon; see `Residuals`.

        Parameters
        ----------
        horizon : int
            Steps; 1 or those of a horizon.
        kind : str
            What needs them, for errors.

        Returns
        -------
        Residuals
            Of the recordings of the fit.

        Raises
        ------
        ModelError
            They are not known.
        """
        found = self.residuals if horizon == 1 else self.horizons[self.steps.index(horizon)].residuals
        if found is None:
            over = "" if horizon == 1 else f" over {horizon} steps"
            raise ModelError(f"alarm: {kind} needs the covariance of the utilisation{over}; fit the model again")
        return found

    def with_residuals_of(self, other: UncertainLTI, instead: bool = False) -> UncertainLTI:
        """The same model with the `residuals` of another fit, as far as it has the same horizons.

        Where one is of the utilisation and one of the residual itself, this model keeps its own `instead`, and takes
        those of the other otherwise: thresholds are for one form.

        Parameters
        ----------
        other : UncertainLTI
            Where the residuals are taken from.
        instead : bool
            Also in place of those that are known.

        Returns
        -------
        UncertainLTI
            With the same bounds.
        """

        def chosen(own: Residuals | None, given: Residuals | None) -> Residuals | None:
            if own is None or given is None:
                return own or given
            if given.relative != own.relative:
                return own if instead else given
            return given if instead else own

        of = {horizon.steps: horizon.residuals for horizon in other.horizons}
        return self.replace(
            residuals=chosen(self.residuals, other.residuals),
            horizons=[h.with_residuals(chosen(h.residuals, of.get(h.steps))) for h in self.horizons],
            signatures=self.signatures,
        )

    @property
    def alarm_rule(self) -> AlarmRule:
        """Containment of one step; `AlarmRule()` where `alarm` has none, so that nothing but flags follows from it."""
        return containment(self.alarm) or AlarmRule()

    @property
    def n(self) -> int:
        """Number of states."""
        return int(self.A.shape[-1])

    @property
    def m(self) -> int:
        """Number of controls."""
        return int(self.B.shape[-1])

    @property
    def q(self) -> int:
        """Number of further scheduling signals, which are neither state nor control."""
        return len(self.signals.scheduling)

    @property
    def steps(self) -> tuple[int, ...]:
        """Steps of each horizon, the shortest first."""
        return tuple(horizon.steps for horizon in self.horizons)

    @cached_property
    def blocks(self) -> tuple[UncertainLTI, ...]:
        """Each block as a model of its own, without a schedule; of a model without one, itself."""
        if self.schedule is None:
            return (self,)
        return tuple(
            self._unscheduled({name: getattr(self, name)[r] for name in ARRAYS}) for r in range(self.schedule.blocks)
        )

    def at(self, **values: float) -> UncertainLTI:
        """The uncertain linear model that holds at one point of the schedule.

        Parameters
        ----------
        **values : float
            Of each scheduling signal by its name, in recorded units.

        Returns
        -------
        UncertainLTI
            Without a schedule: the blocks there, blended.

        Raises
        ------
        ModelError
            The names are not those of the scheduling signals, or a mode is not listed.
        """
        if self.schedule is None:
            if values:
                raise ModelError(f"the model has no schedule, and {', '.join(values)} is given; leave it out")
            return self
        names = [axis.signal for axis in self.schedule.axes]
        if set(values) != set(names):
            raise ModelError(f"give a value of {' and of '.join(names)}, and nothing else")
        if odd := [name for name in names if not math.isfinite(values[name])]:
            raise ModelError(f"{odd[0]} is {values[odd[0]]}; give a finite number")
        point = self.operating_point
        recorded_values = np.zeros(len(point.steady))
        recorded_values[self._positions] = [values[name] for name in names]
        if unlisted := self.why_unlisted(recorded_values.tolist()):
            raise ModelError(f"{unlisted}; give one of them")
        s = normalised(recorded_values, point.steady, point.scale)[self._positions]
        places, weights = self.schedule.corners(s[:, None])
        return self._unscheduled({name: blended(getattr(self, name), places, weights)[..., 0] for name in ARRAYS})

    def _unscheduled(self, arrays: dict[str, Any]) -> UncertainLTI:
        """One block with the signals of this model that are states and controls."""
        read = {s.topic for s in (*self.signals.states, *self.signals.controls)}
        return UncertainLTI(
            **arrays,
            signals=replace(self.signals.scheduled_on(()), schedule=()),
            sampling=replace(self.sampling, time={t: k for t, k in self.sampling.time.items() if t in read}),
            domain=self.domain,
            alarm_rule=self.alarm_rule,
        )

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states."""
        return tuple(s.name for s in self.signals.states)

    @property
    def control_names(self) -> tuple[str, ...]:
        """Names of the controls."""
        return tuple(s.name for s in self.signals.controls)

    def additive(self) -> list[tuple[Term, Array, Array]]:
        """Additive terms of the model.

        Returns
        -------
        list of (Term, array (n,), array (n,)), or arrays (R, n) with a schedule
            Each with its nominal elements, 0 where it has none, and its half-widths.
        """
        zeros = np.zeros_like(self.v)
        return [(t, getattr(self, t.nominal) if t.nominal else zeros, getattr(self, t.half)) for t in ADDITIVE]

    def __repr__(self) -> str:
        text = f"UncertainLTI({plural(self.n, 'state')}: {', '.join(self.state_names)}; "
        text += f"{plural(self.m, 'control')}"
        if self.m:
            text += f": {', '.join(self.control_names)}"
        if self.schedule is not None:
            text += f"; {plural(self.schedule.blocks, 'block')} over {self.schedule.words}"
        if self.horizons:
            text += f"; horizons of {', '.join(str(horizon.steps) for horizon in self.horizons)} steps"
        if "criterion" in self.fit_summary:
            count = plural(self.fit_summary.get("transitions"), "transition")
            text += f"; fitted by {self.fit_summary['criterion']} to {count}"
        return text + ")"

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        from uncertain_lti.model.overview import overview

        return overview(self)

    # --- one-step bounds ---

    def centre_and_half(
        self, x: ArrayLike, u: ArrayLike, dt: ArrayLike, s: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """Centre and half-width of the bounds; see `bounds`.

        Parameters
        ----------
        x : array (..., n)
            Normalised state at t_k.
        u : array (..., m)
            Normalised control at t_k.
        dt : float or array (...)
            Δt_k, s.
        s : array (..., q), optional
            Normalised further scheduling signals at t_k; for models that have some.

        Returns
        -------
        array (..., n)
            Centre, normalised; NaN for a mode that is not listed.
        array (..., n)
            Half-width, normalised.

        Raises
        ------
        ModelError
            Shapes do not fit.
        """
        x = np.asarray(x, dtype=np.float64)
        u = np.asarray(u, dtype=np.float64)
        dt = np.asarray(dt, dtype=np.float64)
        s = np.zeros(0) if s is None else np.asarray(s, dtype=np.float64)
        if x.shape[-1:] != (self.n,) or u.shape[-1:] != (self.m,):
            raise ModelError(f"x has shape {x.shape} and u {u.shape}; they must end in {self.n} and {self.m}")
        if s.shape[-1:] != (self.q,):
            names = ", ".join(signal.name for signal in self.signals.scheduling)
            raise ModelError(f"s has shape {s.shape}; it must end in {self.q}" + f", with {names}" * bool(names))
        lead = np.broadcast_shapes(x.shape[:-1], u.shape[:-1], s.shape[:-1], dt.shape)
        count = math.prod(lead)  # not -1: that says nothing where there are no controls
        flat = [np.broadcast_to(a, (*lead, a.shape[-1])).reshape(count, a.shape[-1]).T for a in (x, u, s)]
        centre, half = np.empty((self.n, count)), np.empty((self.n, count))
        self.columns_centre_and_half(np.vstack(flat), np.broadcast_to(dt, lead).reshape(count), centre, half)
        return centre.T.reshape(*lead, self.n), half.T.reshape(*lead, self.n)

    def columns_centre_and_half(
        self, z: Array, dt: Array, centre: Array, half: Array, base: Array | None = None
    ) -> None:
        """`centre_and_half` of samples in columns, into given arrays.

        Parameters
        ----------
        z : array (n + m + q, K)
            Normalised [x; u; s].
        dt : array (K,)
            s.
        centre, half : array (n, K)
            Take the result.
        base : array (n, K), optional
            What the rates are added to; default the states.
        """
        z, rows = np.asarray(z, dtype=np.float64), self.n + self.m
        if self.schedule is None:
            centre_and_half(self.tables, z[:rows], dt, centre, half, base=base)
        else:
            blocks, s = self.schedule.table, z[self._positions]
            centre_and_half(self.tables, z[:rows], dt, centre, half, blocks, s, base)

    def normalised_columns(self, steps: Transitions) -> Array:
        """[x; u; s] of transitions.

        Parameters
        ----------
        steps : Transitions
            K of them, recorded units.

        Returns
        -------
        array (n + m + q, K)
            Normalised.
        """
        point = self.operating_point
        parts = point.normalise_x(steps.x), point.normalise_u(steps.u), point.normalise_s(steps.s)
        return np.vstack([part.T for part in parts])

    def regime(self, z: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Whether the blocks that hold at some samples can be trusted.

        Parameters
        ----------
        z : array (n + m + q, K)
            Normalised [x; u; s].

        Returns
        -------
        listed : array of bool (K,)
            There is a block: every mode is listed in the model. All, without a schedule.
        unknown : array of bool (K,)
            A scheduling signal lies beyond its end knots, or no recording visited a block that holds. None, without a
            schedule.
        """
        count = z.shape[1]
        if self.schedule is None:
            return np.ones(count, dtype=bool), np.zeros(count, dtype=bool)
        s = z[self._positions]
        places, weights = self.schedule.corners(s)
        known = np.array([data.known for data in self.block_data])
        return places[0] >= 0, self.schedule.unknown(s, places, weights, known)

    @property
    def scheduling_positions(self) -> tuple[int, ...]:
        """Where the scheduling signals are in [x; u; s], one per axis; empty without a schedule."""
        return tuple(self._positions)

    def main_block(self, z: Array) -> NDArray[np.intp]:
        """The block that has the largest weight, of two alike the first.

        Parameters
        ----------
        z : array (n + m + q, K)
            Normalised [x; u; s].

        Returns
        -------
        array of int (K,)
            Numbers of blocks; -1 for a mode that is not listed, and 0 without a schedule.
        """
        if self.schedule is None:
            return np.zeros(z.shape[1], dtype=np.intp)
        return self.schedule.main_block(z[self._positions])

    def why_unknown(self, values: Sequence[float]) -> str:
        """In words, why the regime of a sample is unknown.

        Parameters
        ----------
        values : sequence of float (n + m + q,)
            [x; u; s], recorded units.

        Returns
        -------
        str
            Names the scheduling signals, their values and the knots; empty where the regime is known.
        """
        if self.schedule is None:
            return ""
        found = []
        point = self.operating_point
        z = normalised(np.asarray(values, dtype=np.float64), point.steady, point.scale)[self._positions]
        knots = self.schedule.recorded_values(self.signals.signals)
        for axis, at, i, s in zip(self.schedule.axes, knots, self._positions, z.tolist(), strict=True):
            if axis.knots and not axis.knots[0] <= s <= axis.knots[-1]:
                found.append(f"{axis.signal} = {values[i]:.6g} is beyond its knots {at[0]:.6g} to {at[-1]:.6g}")
        places, weights = (a[:, 0] for a in self.schedule.corners(z[:, None]))
        for r in places[(weights > 0) & (places >= 0)].tolist():
            if not self.block_data[r].known:
                found.append(f"no recording visited {self.block_name(r)}")
        return ", and ".join(found)

    def why_unlisted(self, values: Sequence[float]) -> str:
        """In words, which mode of a sample the model does not list.

        Parameters
        ----------
        values : sequence of float (n + m + q,)
            [x; u; s], recorded units.

        Returns
        -------
        str
            Names the scheduling signals, their values and the modes; empty where every mode is listed.
        """
        if self.schedule is None:
            return ""
        found = []
        point = self.operating_point
        z = normalised(np.asarray(values, dtype=np.float64), point.steady, point.scale)[self._positions]
        modes = self.schedule.recorded_values(self.signals.signals)
        for axis, at, i, s in zip(self.schedule.axes, modes, self._positions, z.tolist(), strict=True):
            if axis.modes and s not in axis.modes:
                listed = ", ".join(f"{mode:.6g}" for mode in at)
                found.append(f"{axis.signal} = {values[i]:.6g} is not among the modes of the model, {listed}")
        return ", and ".join(found)

    def block_name(self, r: int) -> str:
        """Where one block holds, in words.

        Parameters
        ----------
        r : int
            Number of the block.

        Returns
        -------
        str
            `fan_speed = 0.92`, for example, in recorded units; empty without a schedule.
        """
        return "" if self.schedule is None else self.schedule.block_name(r, self.signals.signals)

    def own_rates(self, z: Array) -> Array:
        """The elements a_ii of the nominal model, blended where there is a schedule.

        Parameters
        ----------
        z : array (n + m + q, K)
            Normalised [x; u; s].

        Returns
        -------
        array (n, K)
            1/s; NaN for a mode that is not listed.
        """
        own = np.diagonal(self.A, axis1=-2, axis2=-1)
        if self.schedule is None:
            return np.repeat(own[:, None], z.shape[1], axis=1)
        return np.asarray(blended(own, *self.schedule.corners(z[self._positions])))

    def judge_of(self, margin: float, counted: NDArray[np.bool_]) -> Judge:
        """What judges one transition after another by the bounds of this model.

        Parameters
        ----------
        margin : float
            Multiplies the half-widths.
        counted : array of bool (n,)
            States whose violations count.

        Returns
        -------
        Judge
            With the same bits as `bounds`.
        """
        return self._judge(self.tables, margin, counted)

    def _judge(self, elements: tuple[Array, Array, Array], margin: float, counted: NDArray[np.bool_]) -> Judge:
        point, domain = self.operating_point, self.domain
        return Judge(
            *elements,
            point.steady,
            point.scale,
            domain.least,
            domain.greatest,
            margin,
            counted,
            None if domain.measure is None else domain.measure.occupied,
            self.schedule,
            self._positions,
            [data.known for data in self.block_data],
        )

    def _runner(self) -> Judge:
        """Of the elements that are run over the windows of the horizons."""
        return self._judge(self.tables if self.run is None else self.run.tables, 1.0, np.ones(self.n, dtype=bool))

    def runs_of(self, judge: Judge) -> Runs | None:
        """What judges the state several steps after each measured one.

        Parameters
        ----------
        judge : Judge
            Of `judge_of`.

        Returns
        -------
        Runs or None
            With the same bits as `over_horizons`; None without horizons.
        """
        if not self.horizons:
            return None
        return Runs(judge, self.horizons, None if self.run is None else self._runner())

    def windows(self, k: NDArray[np.intp], z: Array, dt: Array, steps: Sequence[int]) -> Iterator[Windows]:
        """`run`, or the nominal model, taken over so many transitions in a row.

        Parameters
        ----------
        k : array of int (N,)
            Sample that each transition begins with; where one does not follow the one before, windows end.
        z : array (n + m + q, N)
            Normalised [x; u; s] of the transitions, in order of time.
        dt : array (N,)
            s.
        steps : sequence of int
            Lengths, increasing.

        Returns
        -------
        iterator of Windows
            Of each length; good until the next one is asked for.
        """
        judge, vectors = self._runner(), z[self._positions]
        begin = unbroken_over(k, vectors, self.schedule)
        return windows_of(judge, z, vectors, dt, begin, steps, self.n, self.m)

    def over_horizons(self, k: NDArray[np.intp], z: Array, dt: Array, x_next: Array) -> tuple[Array, Array]:
        """Where in the envelopes over several steps the arrivals lie, and how far from their centres.

        Parameters
        ----------
        k : array of int (N,)
            Sample that each transition begins with.
        z : array (n + m + q, N)
            Normalised [x; u; s] of the transitions, in order of time.
        dt : array (N,)
            s.
        x_next : array (N, n)
            Normalised states at their ends.

        Returns
        -------
        array (N, horizons, n)
            (x - centre) / half, of a size of at most 1 exactly where contained; NaN where the window of the horizon is
            broken.
        array (N, horizons, n)
            x - centre, normalised; NaN likewise.
        """
        found = np.full((2, len(dt), len(self.horizons), self.n), np.nan)
        utilisation, residual = found
        for j, (windows, centre, half) in enumerate(self.envelopes(k, z, dt)):
            left, there = arrivals(x_next[windows.last].T, centre, half)
            residual[windows.last, j], utilisation[windows.last, j] = left.T, there.T
        return utilisation, residual

    def envelopes(self, k: NDArray[np.intp], z: Array, dt: Array) -> Iterator[tuple[Windows, Array, Array]]:
        """Envelopes over several steps.

        Parameters
        ----------
        k : array of int (N,)
            As of `windows`.
        z : array (n + m + q, N)
            As of `windows`.
        dt : array (N,)
            s.

        Yields
        ------
        Windows
            Of each horizon; good until the next one is asked for.
        array (n, K)
            Centre at their ends, normalised.
        array (n, K)
            Half-width there, normalised.
        """
        windows_of_each = self.windows(k, z, dt, self.steps)
        for horizon, windows in zip(self.horizons, windows_of_each, strict=True):
            centre, half = np.empty(windows.run.shape), np.empty(windows.run.shape)
            horizon.columns_centre_and_half(windows.z, windows.time, centre, half, windows.run, self.schedule)
            yield windows, centre, half

    def bounds(
        self, x: ArrayLike, u: ArrayLike, dt: ArrayLike, margin: float = 1.0, s: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """One-step bounds, Leibov (2006), eqs. (6)(7) with the additive terms.

        Parameters
        ----------
        x : array (..., n)
            Normalised state at t_k.
        u : array (..., m)
            Normalised control at t_k.
        dt : float or array (...)
            Δt_k, s.
        margin : float
            Multiplies the half-widths.
        s : array (..., q), optional
            Normalised further scheduling signals at t_k; for models that have some.

        Returns
        -------
        lower, upper : array (..., n)
            Normalised x_min and x_max at t_{k+1}; NaN for a mode that is not listed.

        Raises
        ------
        ModelError
            Shapes do not fit.
        """
        return edges(*self.centre_and_half(x, u, dt, s), margin)

    # --- the nominal model on its own ---

    def simulate(self, x0: ArrayLike, u: ArrayLike, dt: ArrayLike, s: ArrayLike | None = None) -> Array:
        """Free run of the nominal model, x_{k+1} = x_k + Δt_k (A x_k + B u_k + c), as in eq. (3) with ΔA = ΔB = 0.

        What a signal takes from earlier samples of a state (lag, diff, rate) follows the run, as soon as the run has
        these samples.

        Parameters
        ----------
        x0 : array (n,)
            Normalised state at t_0.
        u : array (N, m)
            Normalised controls.
        dt : float or array (N,)
            Δt_k, s.
        s : array (N, q), optional
            Normalised further scheduling signals; for models that have some. A schedule on a state follows the run.

        Returns
        -------
        array (N+1, n)
            Normalised states; infinite or NaN where an unstable model runs away.
        """
        from uncertain_lti.model.free_run import simulated

        return simulated(self, x0, u, dt, s)

    def free_run(self, transient: Transient) -> Transient:
        """Free run of the nominal model over a recording: its controls, and nothing of its states but the first.

        The run begins again from the recorded sample at the start of every segment, and after every sample that is not
        finite. `simulate` does the same for arrays of normalised quantities.

        Parameters
        ----------
        transient : Transient
            In recorded units.

        Returns
        -------
        Transient
            With the states of the run, in recorded units; NaN where there is no run.

        Raises
        ------
        ModelError
            The transient has other numbers of signals than the model.
        """
        from uncertain_lti.model.free_run import free_run

        x = self.operating_point.recorded_x(free_run(self, transient))
        return transient.replace(x=x, name=f"{transient.name}, free run of the model")

    def discrepancy(self, transient: Transient, W: ArrayLike | None = None) -> tuple[float, Array]:
        """Discrepancies (4) and (5) between the free-running nominal model and a recorded transient.

        The run starts again from the recorded sample at the start of every segment, and after every sample that
        is not finite.

        Parameters
        ----------
        transient : Transient
            In recorded units.
        W : array (n,), (N, n) or (N, n, n), optional
            Weights of the arrival samples; default ones.

        Returns
        -------
        sum_of_squares : float
            Eq. (4), over k = 1..N.
        largest : array (n,)
            Eq. (5) for each state.

        Raises
        ------
        ModelError
            W has another shape.
        """
        from uncertain_lti.model.free_run import discrepancy

        return discrepancy(self, transient, W)

    def eigenvalues(self) -> NDArray[np.complex128]:
        """Eigenvalues of A.

        Returns
        -------
        array (n,) of complex, or (R, n) with a schedule
            1/s, sorted by real part, greatest first.
        """
        values = np.linalg.eigvals(self.A).astype(np.complex128)
        return np.take_along_axis(values, np.lexsort((values.imag, -values.real)), axis=-1)

    def spectral_radius(self, dt: float | None = None) -> float:
        """Largest |eigenvalue| of I + Δt A, of any block; above 1 the nominal recursion (3) runs away there.

        What the model takes from earlier samples of its states belongs to the recursion.

        Parameters
        ----------
        dt : float, optional
            Δt, s; default the median step of the fit.

        Returns
        -------
        float
            The radius.

        Raises
        ------
        ModelError
            dt is left out and the model has no median step.
        """
        from uncertain_lti.model.free_run import recursion

        dt = self.sampling.dt_median if dt is None else dt
        if dt is None:
            raise ModelError("spectral radius: the model has no dt_median; give dt")
        return float(np.abs(np.linalg.eigvals(recursion(self, dt))).max())

    def replace(self, **changes: Any) -> UncertainLTI:
        """The same model with some constructor arguments replaced.

        Parameters
        ----------
        **changes : object
            Constructor arguments by name.

        Returns
        -------
        UncertainLTI
            A new model.
        """
        arguments = {
            name: getattr(self, name)
            for name in (
                *ARRAYS, "schedule", "block_data", "horizons", "run", "signals", "sampling", "domain", "alarm",
                "residuals", "repeats", "signatures", "fit_summary", "validation",
            )
        }  # fmt: skip
        if self.repeats is not None and not {*ARRAYS, "schedule"}.isdisjoint(changes):
            arguments["repeats"] = Repeats(self.repeats.longest_repeat_s)  # how far another model moves is not known
        if not {*ARRAYS, "schedule", "horizons"}.isdisjoint(changes):
            arguments["signatures"] = ()  # they are of the utilisation by these bounds
        return UncertainLTI(**{**arguments, **changes})

    # --- other tools ---

    def to_control(self, dt: float | None = None, recorded: bool = False, knot: int | None = None) -> Any:
        """The nominal model as a `control.StateSpace`; see `interchange.to_control`.

        Parameters
        ----------
        dt : float, optional
            As in `interchange.to_control`.
        recorded : bool, default False
            As in `interchange.to_control`.
        knot : int, optional
            As in `interchange.to_control`.

        Returns
        -------
        control.StateSpace, or list of it
            The nominal model; with a schedule and without `knot` one system per block. That between the knots is
            `model.at(...).to_control()`.
        """
        from uncertain_lti.model.interchange import to_control

        return to_control(self, dt, recorded, knot)

    @staticmethod
    def from_control(system: Any, **options: Any) -> UncertainLTI:
        """From a `control.StateSpace` and half-widths; see `interchange.from_control`.

        Parameters
        ----------
        system : control.StateSpace
            As in `interchange.from_control`.
        **options : object
            Further arguments of `interchange.from_control`.

        Returns
        -------
        UncertainLTI
            The model.
        """
        from uncertain_lti.model.interchange import from_control

        model: UncertainLTI = from_control(UncertainLTI, system, **options)
        return model

    def save_mat(self, path: str | os.PathLike[str]) -> None:
        """Write a MATLAB file; see `interchange.save_mat`.

        Parameters
        ----------
        path : path
            The file.
        """
        from uncertain_lti.model.interchange import save_mat

        save_mat(self, path)

    @staticmethod
    def load_mat(path: str | os.PathLike[str]) -> UncertainLTI:
        """Read a MATLAB file; see `interchange.load_mat`.

        Parameters
        ----------
        path : path
            The file.

        Returns
        -------
        UncertainLTI
            The model.
        """
        from uncertain_lti.model.interchange import load_mat

        model: UncertainLTI = load_mat(UncertainLTI, path)
        return model

    # --- the file ---

    def to_dict(self) -> dict[str, Any]:
        """The structure of the model file, in the oldest format that holds the model.

        Returns
        -------
        dict
            Plain data for JSON; null for infinite ranges.
        """
        return structure(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the model file; an existing file is replaced as a whole or not at all.

        Parameters
        ----------
        path : path
            The file.

        Raises
        ------
        ModelError
            The file cannot be written.
        """
        write(path, self.to_dict())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> UncertainLTI:
        """Read a model file.

        Parameters
        ----------
        path : path
            The file.

        Returns
        -------
        UncertainLTI
            The model.

        Raises
        ------
        ModelError
            The file is missing, is not JSON, has an unknown format, wrong shapes, numbers that are not finite,
            negative half-widths or scales that are not positive; names file and field.
        """
        return cls.from_dict(read(path), source=os.fspath(path))

    @classmethod
    def from_dict(cls, data: Any, source: str = "model") -> UncertainLTI:
        """From the structure of a model file.

        Parameters
        ----------
        data : object
            As JSON gives it.
        source : str, default "model"
            What errors call it.

        Returns
        -------
        UncertainLTI
            The model.

        Raises
        ------
        ModelError
            It is not of that form; names source and field.
        """
        try:
            return cls(**arguments(data, source))
        except RecursionError:
            raise ModelError(f"{source}: is nested too deeply; is this a model file?") from None
        except (ModelError, SignalError) as error:
            text = str(error).removeprefix(source).removeprefix(": ")
            raise ModelError(f"{source}: {' '.join(text.split())}") from None  # names may hold line breaks


def _sampling(signals: SignalMap) -> Sampling:
    """What a signal map says of sampling."""
    types = [s.type for s in signals.states if s.topic == signals.clock]
    return Sampling(
        clock=signals.clock or "",
        clock_type=types[0] if types else "",
        time=dict(signals.time),
        max_gap=signals.max_gap,
        min_step=signals.min_step,
        max_skew=signals.max_skew,
        step=None if isinstance(signals.step, str) else signals.step,
    )
