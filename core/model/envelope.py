# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Envelope: what judging asks of a model, its bounds in columns, regimes, and windows of several steps."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import WORTH_THREADS, Array, core_count, on_cores
from uncertain_lti.base.errors import ModelError, refuse_other
from uncertain_lti.base.text import plural
from uncertain_lti.kernel.arithmetic import Judge, Runs, arrivals, blended
from uncertain_lti.model.alarm_rule import AlarmRule, Rule, containment
from uncertain_lti.model.domain import Domain, outside_in_words
from uncertain_lti.model.horizon import Horizon, Residuals, Run, Windows, unbroken_over
from uncertain_lti.model.operating_point import OperatingPoint, normalise_columns, normalised
from uncertain_lti.model.schedule import Axis, BlockData, Schedule
from uncertain_lti.model.terms import ADDITIVE, Elements, Term
from uncertain_lti.sampling.transient import Transient, Transitions, controls_as
from uncertain_lti.signals.signal_map import SignalMap


class Envelope(Elements):
    """The elements of a model over one step and several, with what they hold for.

    `scheduling_positions`: where the scheduling signals are in [x; u; s], one per axis; empty without a schedule.
    """

    schedule: Schedule | None
    block_data: tuple[BlockData, ...]
    horizons: tuple[Horizon, ...]
    run: Run | None
    signals: SignalMap
    operating_point: OperatingPoint
    domain: Domain
    residuals: Residuals | None
    alarm: tuple[Rule, ...]
    scheduling_positions: list[int]

    @property
    def alarm_rule(self) -> AlarmRule:
        """Containment of one step; `AlarmRule()` where `alarm` has none, so that nothing but flags follows from it."""
        return containment(self.alarm) or AlarmRule()

    @property
    def q(self) -> int:
        """Number of further scheduling signals, which are neither state nor control."""
        return len(self.signals.scheduling)

    @property
    def steps(self) -> tuple[int, ...]:
        """Steps of each horizon, the shortest first."""
        return tuple(horizon.steps for horizon in self.horizons)

    def additive(self) -> list[tuple[Term, Array, Array]]:
        """Additive terms with their nominal elements, 0 where there are none, and half-widths, (n,) or (R, n) each."""
        zeros = np.zeros_like(self.v)
        return [(t, getattr(self, t.nominal) if t.nominal else zeros, getattr(self, t.half)) for t in ADDITIVE]

    def residuals_at(self, horizon: int = 1, kind: str = "a joint statistic") -> Residuals:
        """Mean and covariance of the healthy utilisation of one step, or of a horizon; `kind`: what needs them."""
        found = self.residuals if horizon == 1 else self.horizons[self.steps.index(horizon)].residuals
        if found is None:
            over = "" if horizon == 1 else f" over {horizon} steps"
            raise ModelError(f"alarm: {kind} needs the covariance of the utilisation{over}; fit the model again")
        return found

    def columns_centre_and_half(self, z: Array, dt: Array) -> tuple[Array, Array]:
        """Centre and half-width (n, K) of the bounds at normalised [x; u; s] = z (n + m + q, K); `dt` (K,): s."""
        z, rows = np.asarray(z, dtype=np.float64), self.n + self.m
        if self.schedule is None:
            return self.centre_and_half_at(z[:rows], dt)
        return self.centre_and_half_at(z[:rows], dt, None, self.schedule.table, z[self.scheduling_positions])

    def own_signals_of(self, transient: Transient) -> Transient:
        """A recording with the controls and scheduling signals as this model takes them, refused if it has others."""
        instead = "read a recording with read_transients first, and give one after the other"
        refuse_other(transient, Transient, "the recording", instead, ModelError)
        own = transient.scheduled_on([s.name for s in self.signals.scheduling])
        own = controls_as(own, self.signals.controls)
        states, controls, further = own.x.shape[1], own.u.shape[1], own.s.shape[1]
        if (states, controls, further) != (self.n, self.m, self.q):
            raise ModelError(
                f"{own.name}: {plural(states, 'state')} and {plural(controls, 'control')}, and the model has {self.n} "
                f"and {self.m}; of further scheduling signals it has {further}, and the model {self.q}; read it with "
                f"the signals of the model"
            )
        for theirs, of in ((own.state_names, self.signals.states), (own.control_names, self.signals.controls)):
            ours = tuple(signal.name for signal in of)
            if theirs != ours and sorted(theirs) == sorted(ours):
                has = f"{own.name} has {', '.join(theirs)}, the model {', '.join(ours)}"
                raise ModelError(f"{has}; give them in the order of the model")
        return own

    def normalised_columns(self, steps: Transitions) -> Array:
        """Normalised [x; u; s] (n + m + q, K) of K transitions in recorded units."""
        run, point = steps.transient, self.operating_point
        z = np.empty((self.n + self.m + self.q, len(steps.k)))
        of_x, of_u, of_s = np.split(z, (self.n, self.n + self.m))
        normalise_columns(run.x[:-1], steps.k, point.x_s, point.X, of_x)
        normalise_columns(run.u[:-1], steps.k, point.u_s, point.U, of_u)
        normalise_columns(run.s[:-1], steps.k, point.s_s, point.S, of_s)
        return z

    def unknown(self, z: Array) -> NDArray[np.bool_]:
        """Where the regime of samples z (n + m + q, K) is unknown: beyond end knots, or where no recording was."""
        if self.schedule is None:
            return np.zeros(z.shape[1], dtype=bool)
        s = z[self.scheduling_positions]
        places, weights = self.schedule.corners(s)
        known = np.array([data.known for data in self.block_data])
        return np.asarray(self.schedule.beyond(s) | ((weights > 0) & ~known[places]).any(axis=0))

    def main_block(self, z: Array) -> NDArray[np.intp]:
        """The block of the largest weight at z (n + m + q, K), of two alike the first; -1 for an unlisted mode."""
        if self.schedule is None:
            return np.zeros(z.shape[1], dtype=np.intp)
        return self.schedule.main_block(z[self.scheduling_positions])

    def why_unlisted(self, values: Sequence[float]) -> str:
        """Which mode of a sample [x; u; s] in recorded units the model does not list, in words; empty where none."""
        found = []
        for axis, at, value, s in self._places(values):
            if axis.modes and s not in axis.modes:
                listed = ", ".join(f"{mode:.6g}" for mode in at)
                found.append(f"{axis.signal} = {value:.6g} is not among the modes of the model, {listed}")
        return ", and ".join(found)

    def why_unknown(self, values: Sequence[float]) -> str:
        """Why the regime of a sample [x; u; s] in recorded units is unknown, in words; empty where it is known."""
        if self.schedule is None:
            return ""
        there = self._places(values)
        found = [
            f"{axis.signal} = {value:.6g} is beyond its knots {at[0]:.6g} to {at[-1]:.6g}"
            for axis, at, value, s in there
            if axis.knots and not axis.knots[0] <= s <= axis.knots[-1]
        ]
        places, weights = (a[:, 0] for a in self.schedule.corners([[s] for *_, s in there]))
        visited = places[(weights > 0) & (places >= 0)].tolist()
        found += [f"no recording visited {self.block_name(r)}" for r in visited if not self.block_data[r].known]
        return ", and ".join(found)

    def why_outside(self, values: Sequence[float]) -> str:
        """Which signals of a sample [x; u; s] in recorded units lie beyond what was fitted, in words."""
        point = self.operating_point
        z = normalised(np.asarray(values, dtype=np.float64), point.steady, point.scale)
        return outside_in_words(self, z[:, None])

    def _places(self, values: Sequence[float]) -> list[tuple[Axis, Array, float, float]]:
        """Each axis with its knots or modes, and its signal in a sample, in recorded units and normalised."""
        if self.schedule is None:
            return []
        point, some = self.operating_point, self.scheduling_positions
        s = normalised(np.asarray(values, dtype=np.float64), point.steady, point.scale)[some].tolist()
        at = self.schedule.recorded_values(self.signals.signals)
        return list(zip(self.schedule.axes, at, [values[i] for i in some], s, strict=True))

    def block_name(self, r: int) -> str:
        """Where one block holds, in recorded units, such as `fan_speed = 0.92`; empty without a schedule."""
        return "" if self.schedule is None else self.schedule.block_name(r, self.signals.signals)

    def own_rates(self, z: Array) -> Array:
        """Elements a_ii (n, K) of the nominal model at samples z (n + m + q, K), 1/s; NaN for an unlisted mode."""
        own = np.diagonal(self.A, axis1=-2, axis2=-1)
        if self.schedule is None:
            return np.repeat(own[:, None], z.shape[1], axis=1)
        return np.asarray(blended(own, *self.schedule.corners(z[self.scheduling_positions])))

    def judge_of(self, margin: float, counted: NDArray[np.bool_], run: bool = False) -> Judge:
        """What judges one transition after another, as `bounds` does; `counted` (n,): states whose violations count.

        `run`: by the elements that are run over the windows of the horizons.
        """
        elements = self.run if run and self.run is not None else self
        law = None if run or self.residuals is None else self.residuals.law
        point, domain = self.operating_point, self.domain
        return Judge(
            *elements.tables, point.steady, point.scale, domain.least, domain.greatest, margin, counted,
            None if domain.measure is None else domain.measure.occupied, self.schedule, self.scheduling_positions,
            [data.known for data in self.block_data], None if law is None else law.tables[0],
        )  # fmt: skip

    def runs_of(self, judge: Judge) -> Runs | None:
        """What judges the state several steps after a measured one, as `over_horizons` does, if there are any."""
        if not self.horizons:
            return None
        every = np.ones(self.n, dtype=bool)
        return Runs(judge, self.horizons, None if self.run is None else self.judge_of(1.0, every, run=True))

    def windows(self, k: NDArray[np.intp], z: Array, dt: Array, steps: Sequence[int]) -> Iterator[Windows]:
        """What is run, over so many transitions in a row, of each length; good until the next one is asked for.

        `k` (N,): sample that each transition begins with; where one does not follow the one before, windows end; `z`
        (n + m + q, N): normalised, in order of time; `dt` (N,): s; `steps`: lengths, increasing.
        """
        vectors, n, rows, count = z[self.scheduling_positions], self.n, self.n + self.m, len(dt)
        begin = unbroken_over(k, vectors, self.schedule)
        runs = np.concatenate([z[:n], np.zeros((self.m + 1, count))])
        runner = self.judge_of(1.0, np.ones(n, dtype=bool), run=True)
        edges = np.linspace(0, count, core_count() + 1).astype(int).tolist()
        kept: Array | None = None
        for done, length in itertools.pairwise([0, *steps]):
            tasks = [(runs, z, dt, done, length, *part) for part in itertools.pairwise(edges)]
            on_cores(runner.advance, tasks, count * (length - done) > WORTH_THREADS)
            start = np.arange(count - length + 1)
            whole = begin[start + (length - 1)] <= start
            run, control, time = runs[:n], runs[n:rows], runs[rows]
            if whole.all():
                many = len(start)
                if kept is None:  # of a window but its controls are the same for all lengths
                    kept = np.concatenate([z[:n], control, vectors])
                np.divide(control[:, :many], time[:many], out=kept[n:rows, :many])
                yield Windows(length, start, kept[:, :many], run[:, :many], time[:many])
            else:
                start = start[whole]
                of_each = np.concatenate([z[:n, start], control[:, start] / time[start], vectors[:, start]])
                yield Windows(length, start, of_each, run[:, start], time[start])

    def over_horizons(self, k: NDArray[np.intp], z: Array, dt: Array, x_next: Array) -> tuple[Array, Array]:
        """Where the arrivals x_next (N, n) lie in the envelopes over several steps, and how far from their centres.

        `k`, `z`, `dt`: as of `windows`. Both (N, horizons, n): (x - centre) / half, of a size of at most 1 exactly
        where contained, and x - centre, normalised; NaN where the window of the horizon is broken.
        """
        found = np.full((2, len(dt), len(self.horizons), self.n), np.nan)
        utilisation, residual = found
        envelopes = self.envelopes(k, z, dt) if self.horizons else ()
        for j, (windows, centre, half) in enumerate(envelopes):
            left, there = arrivals(x_next[windows.last].T, centre, half)
            residual[windows.last, j], utilisation[windows.last, j] = left.T, there.T
        return utilisation, residual

    def envelopes(self, k: NDArray[np.intp], z: Array, dt: Array) -> Iterator[tuple[Windows, Array, Array]]:
        """Windows of each horizon, with centre and half-width (n, K) of its envelope; arguments as of `windows`."""
        windows_of_each, rows = self.windows(k, z, dt, self.steps), self.n + self.m
        for horizon, windows in zip(self.horizons, windows_of_each, strict=True):
            blocks, s = (None, None) if self.schedule is None else (self.schedule.table, windows.z[rows:])
            yield windows, *horizon.centre_and_half_at(windows.z[:rows], windows.time, windows.run, blocks, s)
