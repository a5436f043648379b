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
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import Array, numbers
from uncertain_lti.base.errors import ModelError, UncertainLTIError
from uncertain_lti.base.text import plural, shortlist
from uncertain_lti.kernel.arithmetic import blended, edges
from uncertain_lti.model import horizon as nominal
from uncertain_lti.model import interchange
from uncertain_lti.model.alarm_rule import JOINT, AlarmRule, Rule, StatisticRule, checked_rules, with_containment
from uncertain_lti.model.domain import Domain, Sampling
from uncertain_lti.model.envelope import Envelope
from uncertain_lti.model.horizon import Horizon, Residuals, Run, checked_horizons
from uncertain_lti.model.model_file import arguments, read, structure, write
from uncertain_lti.model.operating_point import OperatingPoint, normalised
from uncertain_lti.model.repeats import Repeats
from uncertain_lti.model.schedule import BlockData, Schedule
from uncertain_lti.model.signature import Signature, checked_signatures
from uncertain_lti.model.terms import ARRAYS
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.signal_map import Signal, SignalMap

_PARTS = ("schedule", "block_data", "horizons", "run", "signals", "sampling", "domain", "alarm", "residuals", "repeats",
          "signatures", "fit_summary", "validation", "memory")  # fmt: skip
"""What a model is made of beside its arrays, by the arguments of the constructor."""


class UncertainLTI(Envelope):
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
        Median, shortest and longest step of the fit; default unknown. How samples are cut is in `signals`.
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
    memory : mapping, optional
        What the fit keeps of its recordings for `update`, likewise.

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
        memory: Mapping[str, Any] | None = None,
    ) -> None:
        lead = () if schedule is None else (schedule.blocks,)
        super().__init__({"A": A, "B": B, "dA": dA, "dB": dB, "c": c, "dc": dc, "v": v}, lead=lead)
        n, m = self.n, self.m
        self.schedule, self.horizons, self.run = schedule, checked_horizons(horizons, self), run
        if run is not None:
            self.fits(run, "run")
        if signals is None:
            states = tuple(Signal(f"x{i + 1}", "", f"x{i + 1}") for i in range(n))
            controls = tuple(Signal(f"u{j + 1}", "", f"u{j + 1}") for j in range(m))
            signals = SignalMap(states, controls, source="model")
        if (len(signals.states), len(signals.controls)) != (n, m):
            raise ModelError(
                f"{plural(len(signals.states), 'state')} and {plural(len(signals.controls), 'control')} are named for "
                f"A {self.A.shape} and B {self.B.shape}"
            )
        self.signals = signals
        self.operating_point = OperatingPoint.of(signals.states, signals.controls, signals.scheduling)
        names = [s.name for s in signals.signals]
        self.scheduling_positions = list(schedule.positions(names)) if schedule is not None else []
        if idle := sorted({*range(n + m, len(names))} - {*self.scheduling_positions}):
            raise ModelError(f"scheduling signal '{names[idle[0]]}' schedules nothing; leave it out")
        blocks = 1 if schedule is None else schedule.blocks
        self.block_data = tuple(block_data or [BlockData()] * blocks)
        if len(self.block_data) != blocks:
            raise ModelError(f"{plural(len(self.block_data), 'block')} of data for {plural(blocks, 'block')}")
        self.sampling = sampling or Sampling()
        everywhere = np.full(n, np.inf), np.full(m, np.inf)
        self.domain = domain or Domain(-everywhere[0], everywhere[0], -everywhere[1], everywhere[1])
        self.residuals, self.repeats = residuals, repeats
        self.alarm = self._alarm(alarm, alarm_rule)
        self.signatures = checked_signatures(signatures, n)
        if repeats is not None and len(repeats.longest_repeat_s) != n:
            raise ModelError(f"field 'frozen' has {len(repeats.longest_repeat_s)} numbers for {plural(n, 'state')}")
        self.fit_summary = dict(fit_summary or {})
        self.validation = dict(validation or {})
        self.memory = dict(memory or {})

    def _alarm(self, alarm: Sequence[Rule] | None, alarm_rule: AlarmRule | None) -> tuple[Rule, ...]:
        rules = (alarm_rule or AlarmRule(),) if alarm is None else checked_rules(alarm)
        if alarm is not None and alarm_rule is not None:
            rules = with_containment(rules, alarm_rule)
        for residuals in () if self.residuals is None else self.residuals.forms:
            if residuals.law is not None:
                self.fits(residuals.law, "residuals")
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

    def with_residuals_of(self, other: UncertainLTI, instead: bool = False) -> UncertainLTI:
        """The same model with the `residuals` of another fit, as far as it has the same horizons.

        Those are taken that are of the form of its own: thresholds are for one form. Where the other has none of it,
        this model keeps its own `instead`, and takes those of the other otherwise.

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
            alike = given.alike(own)
            return (own if alike is None else alike) if instead else (given if alike is None else own)

        of = {horizon.steps: horizon.residuals for horizon in other.horizons}
        residuals = chosen(self.residuals, other.residuals)
        horizons = [h.with_residuals(chosen(h.residuals, of.get(h.steps))) for h in self.horizons]
        return self.replace(residuals=residuals, horizons=horizons, signatures=self.signatures)

    @cached_property
    def blocks(self) -> tuple[UncertainLTI, ...]:
        """Each block as a model of its own, without a schedule; of a model without one, itself."""
        if self.schedule is None:
            return (self,)
        each = [{name: array[r] for name, array in self.arrays.items()} for r in range(self.schedule.blocks)]
        return tuple(map(self._unscheduled, each))

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
        point, of_each = self.operating_point, self.signals.signals
        sample = np.array([values.get(signal.name, 0.0) for signal in of_each])
        if unlisted := self.why_unlisted(sample.tolist()):
            raise ModelError(f"{unlisted}; give one of them")
        s = normalised(sample, point.steady, point.scale)[self.scheduling_positions]
        corners = self.schedule.corners(s[:, None])
        return self._unscheduled({name: blended(a, *corners)[..., 0] for name, a in self.arrays.items()})

    def _unscheduled(self, arrays: dict[str, Any]) -> UncertainLTI:
        """One block with the signals of this model that are states and controls."""
        signals = replace(self.signals.scheduled_on(()), schedule=())
        return UncertainLTI(
            **arrays, signals=signals, sampling=self.sampling, domain=self.domain, alarm_rule=self.alarm_rule
        )

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states."""
        return tuple(s.name for s in self.signals.states)

    @property
    def control_names(self) -> tuple[str, ...]:
        """Names of the controls."""
        return tuple(s.name for s in self.signals.controls)

    def __repr__(self) -> str:
        text = f"UncertainLTI({plural(self.n, 'state')}: {shortlist(self.state_names, 12)}; {plural(self.m, 'control')}"
        text += f": {shortlist(self.control_names, 12)}" * bool(self.m)
        if self.schedule is not None:
            text += f"; {plural(self.schedule.blocks, 'block')} over {self.schedule.words}"
        if self.horizons:
            text += f"; horizons of {', '.join(map(str, self.steps))} steps"
        if "criterion" in self.fit_summary:
            count = plural(self.fit_summary.get("transitions"), "transition")
            text += f"; fitted by {self.fit_summary['criterion']} to {count}"
        return text + ")"

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
        x, u = numbers(x, "x", (..., self.n), ModelError), numbers(u, "u", (..., self.m), ModelError)
        dt, s = numbers(dt, "dt", (...,), ModelError), numbers([] if s is None else s, "s", (...,), ModelError)
        if s.shape[-1:] != (self.q,):
            names = ", ".join(signal.name for signal in self.signals.scheduling)
            raise ModelError(f"s has shape {s.shape}; it must end in {self.q}" + f", with {names}" * bool(names))
        try:
            lead = np.broadcast_shapes(x.shape[:-1], u.shape[:-1], s.shape[:-1], dt.shape)
        except ValueError:
            shapes = f"x has shape {x.shape}, u {u.shape}, s {s.shape} and dt {dt.shape}"
            raise ModelError(f"{shapes}; give as many of each, or one for all") from None
        count = math.prod(lead)  # not -1: that says nothing where there are no controls
        flat = [np.broadcast_to(a, (*lead, a.shape[-1])).reshape(count, a.shape[-1]).T for a in (x, u, s)]
        centre, half = self.columns_centre_and_half(np.vstack(flat), np.broadcast_to(dt, lead).reshape(count))
        return centre.T.reshape(*lead, self.n), half.T.reshape(*lead, self.n)

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
        return edges(*self.centre_and_half(x, u, dt, s), float(numbers(margin, "margin", (), ModelError)))

    # --- the nominal model on its own ---

    simulate = nominal.simulate
    free_run = nominal.free_run
    discrepancy = nominal.discrepancy

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
        dt = self.sampling.dt_median if dt is None else dt
        if dt is None:
            raise ModelError("spectral radius: the model has no dt_median; give dt")
        step = float(numbers(dt, "dt", (), ModelError))
        return float(np.abs(np.linalg.eigvals(nominal.recursion(self, step))).max())

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
        arguments = {name: getattr(self, name) for name in (*ARRAYS, *_PARTS)}
        if self.repeats is not None and not {*ARRAYS, "schedule"}.isdisjoint(changes):
            arguments["repeats"] = Repeats(self.repeats.longest_repeat_s)  # how far another model moves is not known
        if not {*ARRAYS, "schedule", "horizons"}.isdisjoint(changes):
            arguments["signatures"] = ()  # they are of the utilisation by these bounds
        return UncertainLTI(**{**arguments, **changes})

    def update(
        self, transients: Iterable[Transient] | Transient, progress: Callable[[str], None] | None = None
    ) -> UncertainLTI:
        """The fit to the recordings of this model and further ones, without the former.

        The model keeps what that takes: sums, the transitions that decide, and of all others how far they are from
        mattering. For plain models: one block, one step, every sample of the same weight, nothing discarded.

        Parameters
        ----------
        transients : Transient or iterable of Transient
            New recordings; earlier ones that are given again are recognised, and not counted twice.
        progress : callable, optional
            Called with one line of text per pass over the data.

        Returns
        -------
        UncertainLTI
            Elements, objective and ranges as of one fit of all recordings at this operating point, by the same
            criterion and terms. Rules of the alarm stay, but that thresholds of a learnt panel are raised to the
            largest values that the new recordings reach by this model, which was fitted without them, within the
            ranges of its fit; a fit of all may learn others. Residuals of `chi2` and exact repeats are those of the
            earlier recordings by the model of then, with those of the new ones by the model of now. Signatures, which
            are of the bounds of before, are left out.

        Raises
        ------
        FitError
            What the model keeps does not prove the optimum of all recordings: names those to give again. Or the model
            is not plain, keeps nothing, or has other signals.
        """
        above = import_module("uncertain_lti.validation.monitor_fit")  # a model alone needs no solver
        updated: UncertainLTI = above.updated(self, transients, progress)
        return updated

    # --- other tools ---

    to_control = interchange.to_control
    from_control = classmethod(interchange.from_control)
    save_mat = interchange.save_mat
    load_mat = classmethod(interchange.load_mat)
    _repr_html_ = interchange.overview

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
        except UncertainLTIError as error:
            text = str(error).removeprefix(source).removeprefix(": ")
            raise ModelError(f"{source}: {' '.join(text.split())}") from None  # names may hold line breaks
