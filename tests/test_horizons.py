# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Envelopes over several steps: the model's elements, its file, and the utilisation per horizon."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from steps import steps_of

from uncertain_lti import EnvelopeMonitor, SignalMap, Transient, UncertainLTI
from uncertain_lti.base.errors import ModelError
from uncertain_lti.model.domain import Sampling
from uncertain_lti.model.horizon import Horizon, Run
from uncertain_lti.model.schedule import Axis, Schedule
from uncertain_lti.model.terms import ARRAYS, SHAPES
from uncertain_lti.monitor.verdict import place as place_of
from uncertain_lti.sampling.clock import Status
from uncertain_lti.signals.signal_map import Signal

SPEED = Schedule((Axis("x1", knots=(-0.5, 0.0, 1.0)),))


def horizon(rng: np.random.Generator, steps: int, blocks: int | None = None, n: int = 2, m: int = 1) -> Horizon:
    lead = () if blocks is None else (blocks,)
    return Horizon(steps, **{name: np.abs(rng.normal(size=(*lead, *SHAPES[name].shape(n, m)))) for name in ARRAYS})


def with_horizons(rng: np.random.Generator, steps: tuple[int, ...], schedule: Schedule | None = None) -> UncertainLTI:
    blocks = None if schedule is None else schedule.blocks
    one = horizon(rng, 2, blocks)
    horizons = [horizon(rng, h, blocks) for h in steps]
    run = Run(*(getattr(horizon(rng, 2, blocks), name) for name in "ABc")) if steps else None
    return UncertainLTI(**{name: getattr(one, name) for name in ARRAYS}, schedule=schedule, horizons=horizons, run=run)


def test_horizons_and_their_run_come_back_from_the_file_in_order() -> None:
    model = with_horizons(np.random.default_rng(1), (9, 2, 4), SPEED)
    again = UncertainLTI.from_dict(model.to_dict())
    assert [h.steps for h in again.horizons] == [2, 4, 9] and "2, 4, 9 steps" in repr(again)
    assert all(getattr(model.run, name).tobytes() == getattr(again.run, name).tobytes() for name in "ABc")


def test_a_model_of_one_step_has_none_and_stays_in_its_format() -> None:
    model = with_horizons(np.random.default_rng(2), ())
    assert model.horizons == () and "horizons" not in model.to_dict()
    assert model.to_dict()["format"] == "uncertain-lti/1"
    transient = Transient(np.arange(5) * 0.1, np.ones((5, 2)), np.ones((5, 1)))
    verdicts = EnvelopeMonitor(model).check(transient)
    assert verdicts.horizon_utilisation.shape == (5, 1, 2)
    np.testing.assert_array_equal(verdicts.horizon_utilisation[:, 0], verdicts.utilisation)


def test_a_horizon_of_another_number_of_states_or_blocks_is_refused() -> None:
    rng = np.random.default_rng(4)
    model = with_horizons(rng, ())
    for other in ({"n": 3}, {"blocks": 2}):
        with pytest.raises(ModelError, match="do not fit the model"):
            model.replace(horizons=[horizon(rng, 3, **other)])


@pytest.mark.parametrize("schedule", [None, SPEED, Schedule((SPEED.axes[0], Axis("x2", knots=(-1.0, 1.0))))])
def test_a_window_is_the_same_alone_and_among_many(schedule: Schedule | None) -> None:
    rng, count, steps = np.random.default_rng(5), 6000, (3, 40)
    model = with_horizons(rng, steps, schedule)
    z, dt, k = rng.normal(size=(3, count)), rng.uniform(0.005, 0.015, count), np.arange(count)
    k[4000:] += 1  # a break
    for windows in model.windows(k, z, dt, steps):
        length = windows.steps
        assert len(windows.start) == count - 2 * (length - 1) and 4000 - length in windows.start
        assert not np.isin(np.arange(4001 - length, 4000), windows.start).any()
        for start in (0, 2047, 2048, 2980, 2999, 3000, 4000 - length, 4000, count - length):
            part = slice(start, start + length)
            (alone,) = model.windows(k[part], z[:, part], dt[part], [length])
            (at,) = np.flatnonzero(windows.start == start)
            for name in ("run", "z", "time"):
                among, own = getattr(windows, name)[..., at], getattr(alone, name)[..., 0]
                assert among.tobytes() == own.tobytes()


# --- the same bits live and offline -------------------------------------------------------------------------------

TICK = 10_000_000  # ns
GEAR = Axis("gear", modes=(1.0, 2.0))
SCHEDULES = [None, SPEED, Schedule((GEAR,)), Schedule((SPEED.axes[0], GEAR))]


@st.composite
def streams(draw: st.DrawFn) -> tuple[UncertainLTI, Transient]:
    """A run with gaps, resets, dropped messages, NaN, long steps, other modes."""
    n, m = draw(st.integers(1, 3)), draw(st.integers(0, 2))
    schedule = draw(st.sampled_from(SCHEDULES))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    steps = rng.choice([1, 2, 0, 4, 9, -1, -30], size=draw(st.integers(0, 120)), p=[0.9, *[0.1 / 6] * 6])
    t = 1000 * TICK + TICK * np.cumsum(np.array([0, *steps], dtype=np.int64))
    gear = schedule is not None and GEAR in schedule.axes
    z = rng.normal(size=(len(t), n + m + gear))
    if gear:
        z[:, -1] = rng.choice([1.0, 2.0, 3.0], size=len(t) // 20 + 1, p=[0.45, 0.45, 0.1]).repeat(20)[: len(t)]
    z[rng.uniform(size=z.shape) < draw(st.sampled_from([0.0, 0.01]))] = np.nan

    def named(letter: str, count: int) -> tuple[Signal, ...]:
        units = [(float(rng.normal()), float(rng.uniform(0.5, 2))) for _ in range(count)]
        return tuple(Signal(f"{letter}{i + 1}", "/c", f"{letter}{i}", *unit) for i, unit in enumerate(units))

    groups = named("x", n), named("u", m), (Signal("gear", "/c", "gear"),) * gear
    signals = SignalMap(*groups, clock="/c", max_gap=0.05, time={"/c": "header"})
    blocks = None if schedule is None else schedule.blocks
    one = horizon(rng, 2, blocks, n, m)
    lengths = draw(st.lists(st.sampled_from([2, 3, 5, 12, 70]), min_size=1, max_size=3, unique=True))
    horizons = [horizon(rng, h, blocks, n, m) for h in lengths]
    run = draw(st.sampled_from([None, Run(*(getattr(horizon(rng, 2, blocks, n, m), name) for name in "ABc"))]))
    known = {"schedule": schedule, "signals": signals, "sampling": Sampling(dt_min=0.01, dt_max=0.015)}
    model = UncertainLTI(**{name: getattr(one, name) for name in ARRAYS}, **known, horizons=horizons, run=run)
    return model, Transient(t, z[:, :n], z[:, n : n + m], s=z[:, n + m :], signals=signals, max_gap=0.05)


@settings(max_examples=25, deadline=None)
@given(streams())
def test_windows_are_those_of_the_rules_worked_out_naively(case: tuple[UncertainLTI, Transient]) -> None:
    """Which windows count, and the run and its envelope, one number after another."""
    model, transient = case
    verdicts = EnvelopeMonitor(model).check(transient)
    table, point, n, m = verdicts.horizon_utilisation, model.operating_point, model.n, model.m
    kinds = verdicts.statuses()
    z = (np.hstack([transient.x, transient.u, transient.s]) - point.steady) / point.scale
    axes = () if model.schedule is None else model.schedule.axes
    modes = [z[:, i] for axis, i in zip(axes, model.scheduling_positions, strict=True) if axis.modes]
    dt = np.diff(transient.t_ns) * 1e-9

    def blended(arrays: Any, name: str, k: int) -> Any:
        values = getattr(arrays, name)
        if model.schedule is None:
            return values
        places, weights = (a[:, 0] for a in model.schedule.corners(z[k][list(model.scheduling_positions)][:, None]))
        total = values[places[0]] * weights[0]
        for place, weight in zip(places[1:], weights[1:], strict=True):
            total = total + values[place] * weight
        return total

    def summed(rows: Any, numbers: Any, absolute: bool = False) -> list[float]:
        found = []
        for row in rows.tolist():
            total = row[0] * (abs(numbers[0]) if absolute else numbers[0])
            for a, b in zip(row[1:], numbers[1:], strict=True):
                total += a * (abs(b) if absolute else b)
            found.append(total)
        return found

    for end in range(len(transient)):
        for j, one in enumerate(model.horizons, 1):
            begin = end - one.steps
            inner = range(begin + 1, end + 1)
            whole = begin >= 0 and all(kinds[k] is Status.OK for k in inner)
            whole = whole and all(len(set(mode[begin:end])) == 1 for mode in modes)
            assert np.isnan(table[end, j]).all() != whole
            if not whole or one.steps > 5:
                continue
            x, total, mean = z[begin, :n].tolist(), 0.0, [0.0] * m
            for k in range(begin, end):
                step = float(dt[k])
                run = model.run or model
                rows = np.hstack([blended(run, "A", k), blended(run, "B", k), blended(run, "c", k)[:, None]])
                rate = summed(rows, [*x, *z[k, n : n + m].tolist(), 1.0])
                x = [r * step + a for r, a in zip(rate, x, strict=True)]
                total += step
                mean = [a + float(u) * step for a, u in zip(mean, z[k, n : n + m], strict=True)]
            phi = [*z[begin, :n].tolist(), *(a / total for a in mean), 1.0]
            part = {name: blended(one, name, begin) for name in ARRAYS}
            rate = summed(np.hstack([part["A"], part["B"], part["c"][:, None]]), phi)
            spread = summed(np.hstack([part["dA"], part["dB"], part["dc"][:, None]]), phi, absolute=True)
            centre = [r * total + a for r, a in zip(rate, x, strict=True)]
            half = [r * total + float(a) for r, a in zip(spread, part["v"], strict=True)]
            expected = [float((z[end, i] - centre[i]) / half[i]) for i in range(n)]
            assert table[end, j].tolist() == expected


def test_what_is_foreseen_is_judged_when_the_longest_horizon_ends() -> None:
    rng = np.random.default_rng(4)
    model = with_horizons(rng, (2, 5))
    monitor, dt = EnvelopeMonitor(model, margin=1.5), 0.05
    x, u = 0.1 * np.cumsum(rng.normal(size=(9, model.n)), axis=0), np.full((9, model.m), 0.3)
    transient = Transient(np.arange(9) * round(dt * 1e9), x, u)
    judged = EnvelopeMonitor(model).check(transient).horizon_utilisation[:, -1]
    for k in range(4):
        found = monitor.foresee(int(transient.t_ns[k]), [*x[k], *u[k]], dt)
        assert found is not None and found.t_ns == transient.t_ns[k + 5]
        centre, half = (found.upper + found.lower) / 2, (found.upper - found.lower) / 2 / 1.5
        np.testing.assert_allclose((x[k + 5] - centre) / half, judged[k + 5], rtol=1e-9)
        packed = found.packed()
        assert packed[place_of("lower", model.n)] == found.lower.tobytes()
        assert packed[place_of("upper", model.n)] == found.upper.tobytes()
    assert EnvelopeMonitor(model.replace(horizons=())).foresee(0, [*x[0], *u[0]], dt) is None
    of_modes = EnvelopeMonitor(with_horizons(rng, (2, 5), Schedule((Axis("x1", modes=(1.0, 2.0)),))))
    assert [of_modes.foresee(0, [mode, 0.1, 0.3], dt) is None for mode in (1.0, 3.0)] == [False, True]


@pytest.mark.parametrize("schedule", [None, SPEED])
def test_on_the_edge_of_an_envelope_the_comparison_decides_not_the_quotient(schedule: Schedule | None) -> None:
    """|utilisation| is at most 1 exactly where lower <= x <= upper; the quotient alone is off by a rounding there."""
    rng = np.random.default_rng(11)
    model = with_horizons(rng, (2,), schedule)
    x, t = rng.normal(size=(600, 2)), np.repeat(np.arange(200) * 1.0, 3) + np.tile([0.0, 0.01, 0.02], 200)
    run = Transient(t, x, rng.normal(size=(600, 1)), max_gap=0.1)
    steps = run.transitions()
    ((windows, centre, half),) = model.envelopes(steps.k, model.normalised_columns(steps), steps.dt)
    assert len(windows.start) == 200
    last = steps.k[windows.last] + 1
    edges = [(centre - half).T, (centre + half).T]
    beyond = [np.nextafter(edges[0], -np.inf), np.nextafter(edges[1], np.inf)]
    off = 0
    for edge, inside in [*zip(edges, (True, True), strict=True), *zip(beyond, (False, False), strict=True)]:
        moved = x.copy()
        moved[last] = edge
        there = Transient(t, moved, run.u, max_gap=0.1)
        found = EnvelopeMonitor(model).check(there).longer_utilisation[last, 0]
        assert np.array_equal(np.abs(found) <= 1.0, np.full((200, 2), inside))
        off += int((np.abs((edge - centre.T) / half.T) <= 1.0).sum() != 400 * inside)
        live = np.array([verdict.horizon_utilisation for verdict in map(EnvelopeMonitor(model).judge, steps_of(there))])
        assert live[last, 1].tobytes() == found.tobytes()
    assert off, "no quotient is off here, so this shows nothing"
