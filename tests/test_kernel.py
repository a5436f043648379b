# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The kernel against the equations written naively: one number after another, for one sample, many, and runs."""

import math
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from refusals import refuses

from uncertain_lti import EnvelopeMonitor, SignalMap, Transient, UncertainLTI
from uncertain_lti.base.arrays import LARGEST
from uncertain_lti.identification.passes import Candidate, Samples, scan
from uncertain_lti.identification.problem import Block
from uncertain_lti.kernel import arithmetic
from uncertain_lti.kernel.arithmetic import FLAGS, LOWER, RESIDUAL, UPPER, UTILISATION, Repeating
from uncertain_lti.model.alarm_rule import StatisticRule
from uncertain_lti.model.domain import Domain
from uncertain_lti.model.horizon import Residuals, Run
from uncertain_lti.model.schedule import Axis, BlockData, Schedule
from uncertain_lti.signals.signal_map import Signal

KNOTS, OF_FURTHER = Axis("x0", knots=(-1.0, -0.1, 0.0, 0.2, 1.0)), Axis("w", knots=(-0.1, 0.1))
MODES = Axis("gear", modes=(1.0, 2.0, 5.0))
SCHEDULES = {
    "one block": None,
    "knots": Schedule((KNOTS,)),
    "modes": Schedule((MODES,)),
    "two": Schedule((KNOTS, OF_FURTHER)),
    "knots and modes": Schedule((MODES, OF_FURTHER)),
}
UNVISITED = (1, 3)  # blocks
ODD = [0.0, -0.0, math.nan, math.inf, -math.inf, 1e308, 5e-324]


def some_model(n: int, m: int, schedule: Schedule | None, rng: np.random.Generator) -> UncertainLTI:
    """Elements of which many are 0, and a domain and blocks that samples leave."""
    further = [axis.signal for axis in schedule.axes if axis.signal != "x0"] if schedule else []
    lead, total = ((schedule.blocks,) if schedule else ()), n + m + len(further)
    theta, delta = (rng.normal(size=(*lead, n, n + m + 1)) for _ in range(2))
    delta[rng.random(delta.shape) < 0.3] = 0.0
    steady, scale = rng.normal(size=total), rng.uniform(0.1, 2.0, total)
    if "gear" in further:
        steady[n + m + further.index("gear")], scale[n + m + further.index("gear")] = 0.0, 1.0
    names = [f"x{i}" for i in range(n)], [f"u{j}" for j in range(m)], further
    units = zip(sum(names, []), steady.tolist(), scale.tolist(), strict=True)
    every = [Signal(name, "", "a", steady=at, scale=unit) for name, at, unit in units]
    return UncertainLTI(
        theta[..., :n], theta[..., n : n + m], np.abs(delta[..., :n]), np.abs(delta[..., n : n + m]),
        theta[..., n + m], np.abs(delta[..., n + m]), rng.uniform(0, 6, (*lead, n)),
        schedule=schedule, block_data=schedule and [BlockData(int(r not in UNVISITED)) for r in range(schedule.blocks)],
        signals=SignalMap(tuple(every[:n]), tuple(every[n : n + m]), tuple(every[n + m :])),
        domain=Domain(np.full(n, -9.0), np.full(n, 9.0), np.full(m, -9.0), np.full(m, 9.0)),
    )  # fmt: skip


def naive_blocks(schedule: Schedule | None, s: list[float]) -> tuple[list[tuple[int, float]], bool]:
    """Blocks with their weights, and whether s lies beyond a knot; no block where a mode is not listed."""
    if schedule is None:
        return [(0, 1.0)], False
    found, beyond = [(0, 1.0)], False
    for axis, value in zip(schedule.axes, s, strict=True):
        if math.isnan(value) or (axis.modes and value not in axis.modes):
            return [], False
        if axis.modes:
            own = [(axis.modes.index(value), 1.0)]
        else:
            knots = axis.knots
            beyond |= not knots[0] <= value <= knots[-1]
            low = max((j for j in range(len(knots) - 1) if knots[j] <= value), default=0)
            high = min(max((value - knots[low]) / (knots[low + 1] - knots[low]), 0.0), 1.0)
            own = [(low, 1.0 - high), (low + 1, high)]
        found = [(r * len(axis) + j, w * weight) for r, w in found for j, weight in own]
    return found, beyond


def naive(model: UncertainLTI, before: list[float], after: list[float], dt: float, margin: float) -> Any:
    """Eqs. (6)(7) in floats: what a `Judgement` holds, and whether the regime is unknown; None without a block."""
    point, n = model.operating_point, model.n
    steady, scale = point.steady.tolist(), point.scale.tolist()
    z = [(v - a) / b for v, a, b in zip(before, steady, scale, strict=True)]
    phi = [*z[: n + model.m], 1.0]
    blocks, unknown = naive_blocks(model.schedule, [z[i] for i in model.scheduling_positions])
    if not blocks:
        return None
    unknown |= model.schedule is not None and any(w > 0 and r in UNVISITED for r, w in blocks)
    theta, delta, v = (a if model.schedule else a[None] for a in model.tables)

    def of(table: Any, *at: int) -> float:
        if model.schedule is None:
            return float(table[(0, *at)])
        return sum_of(float(table[(r, *at)]) * w for r, w in blocks)

    rows = []
    for i in range(n):
        rate = sum_of(of(theta, i, j) * phi[j] for j in range(len(phi)))
        spread = sum_of(of(delta, i, j) * abs(phi[j]) for j in range(len(phi)))
        centre, half = rate * dt + z[i], spread * dt + of(v, i)
        lower, upper = centre - half * margin, centre + half * margin
        x = (after[i] - steady[i]) / scale[i]
        left = x - centre
        with np.errstate(all="ignore"):
            share = 0.0 if left == 0.0 else float(np.float64(left) / np.float64(half))
        inside = lower <= x <= upper
        rows.append((steady[i] + scale[i] * lower, steady[i] + scale[i] * upper, left, float(not inside), share))
    return np.array(rows).T, unknown


def sum_of(terms: Any) -> float:
    """From the first to the last, beginning with the first."""
    first, *others = terms
    for term in others:
        first += term
    return first


def same(one: Any, other: Any) -> bool:
    one, other = np.asarray(one, dtype=np.float64), np.asarray(other, dtype=np.float64)
    there = ~np.isnan(one)
    return bool((there == ~np.isnan(other)).all()) and one[there].tobytes() == other[there].tobytes()


@pytest.mark.parametrize("n, m, margin", [(1, 0, 1.0), (1, 9, 0.3), (5, 4, 0.3), (20, 6, 1.0)])
@pytest.mark.parametrize("schedule", SCHEDULES.values(), ids=SCHEDULES)
def test_a_transition_and_many_are_judged_as_the_equations_say_to_the_last_bit(n, m, margin, schedule):
    rng = np.random.default_rng([n, m])
    model = some_model(n, m, schedule, rng)
    counted = rng.random(n) < 0.7
    judge, point, total = model.judge_of(margin, counted), model.operating_point, len(model.operating_point.steady)
    gear = [i for i, name in enumerate(axis.signal for axis in (schedule.axes if schedule else ())) if name == "gear"]
    flags, unlisted, unknown = set[float](), 0, 0
    for k in range(200):
        before, after = rng.normal(size=total) * 2, rng.normal(size=n) * 2
        if gear:
            before[model.scheduling_positions[gear[0]]] = rng.integers(1, 7)
        if k % 4 == 0:
            before[rng.integers(total)] = rng.choice(ODD)
        if k % 7 == 0:
            before[0] = point.steady[0]  # on a knot, where the next block has no weight
        if k % 5 == 0:
            after[rng.integers(n)] = rng.choice(ODD)
        dt = float(rng.choice([1e-3, 0.1, 0.0]))
        found = judge.judge(before.tolist(), tuple(after.tolist()), dt)
        expected = naive(model, before.tolist(), after.tolist(), dt, margin)
        with np.errstate(all="ignore"):
            z = (before - point.steady) / point.scale
            lower, upper = (point.recorded_x(a) for a in model.bounds(z[:n], z[n : n + m], dt, margin, z[n + m :]))
        if expected is None:
            assert found is None and np.isnan(lower).all()
            unlisted += 1
            continue
        numbers, strange = expected
        assert found is not None
        for which in (LOWER, UPPER, RESIDUAL, FLAGS, UTILISATION):
            assert same(found.numbers(which), numbers[which]), which
        assert same(lower, numbers[LOWER]) and same(upper, numbers[UPPER])
        assert found.contained == (not numbers[FLAGS].any())
        assert found.unknown_regime == strange == model.unknown(z[:, None])[0]
        assert found.outside_domain or not strange
        found.reach(largest := np.zeros(n))
        assert same(largest, np.fmax(np.abs(numbers[UTILISATION]), 0.0))
        assert found.violation == bool((numbers[FLAGS] * counted).any())
        flags |= set(numbers[FLAGS])
        unknown += strange
    assert flags == {0.0, 1.0}
    assert (unlisted > 0 or not gear) and (unknown > 0) == (schedule is not None)


def test_a_law_of_the_residuals_changes_no_bound_and_no_utilisation() -> None:
    rng = np.random.default_rng(0)
    model, law = some_model(3, 2, None, rng), [rng.normal(size=shape) for shape in ((3, 3), (3, 2), 3)]
    other = model.replace(
        residuals=Residuals(np.zeros(3), np.eye(3), False, Run(*law)), alarm=[StatisticRule("chi2", 0.0, 1.0)]
    )
    run = Transient(0.1 * np.arange(200), rng.normal(size=(200, 3)), rng.normal(size=(200, 2)))
    one, two = EnvelopeMonitor(model).check(run), EnvelopeMonitor(other).check(run)
    for name in ("flags", "lower", "upper", "utilisation"):
        assert same(getattr(one, name), getattr(two, name)), name
    z = (np.column_stack([run.x, run.u]) - model.operating_point.steady) / model.operating_point.scale
    x, u = z[:, :3], z[:, 3:]
    expected = x[1:] - x[:-1] - 0.1 * (x[:-1] @ law[0].T + u[:-1] @ law[1].T + law[2])
    np.testing.assert_allclose(two.residual[1:], expected, atol=1e-9)


def test_on_the_edge_of_a_horizon_the_comparison_decides_and_a_run_beyond_all_numbers_is_outside() -> None:
    quotient = np.array([1.0, -1.0, 0.0, -1.5, np.nan, np.nan])
    inside = np.array([False, False, False, True, False, True])
    beyond = np.nextafter(1.0, 2.0)
    found = arithmetic.settled(quotient, inside)
    np.testing.assert_array_equal(found, [beyond, -beyond, beyond, -1.0, np.inf, np.nan])


def test_what_is_beyond_all_numbers_is_looked_up_in_no_cell_that_is_none() -> None:
    """Of a signal that never moved, whose cells have no width, its place would be no number."""
    z, least, greatest = np.array([[np.inf, 0.7], [0.5, 0.5]]), np.array([0.7, 0.0]), np.array([0.7, 1.0])
    found = arithmetic.outside_domain(z, least, greatest, np.ones((1, 4, 4), dtype=bool))
    assert found.tolist() == [True, False]


def test_what_does_not_fit_together_is_refused_before_it_is_read() -> None:
    one, two = np.ones((2, 4)), np.ones(2)
    point = np.zeros(3), np.ones(3), np.zeros(3), np.ones(3)
    for bad in ((one[:1], one, two), (one, one[:, :2], two), (one, one, two[:1])):
        refuses(ValueError, "fit", arithmetic.Judge, *bad, *point, 1.0, np.array([True, True]))
    refuses(ValueError, "fit", arithmetic.Judge, one, one, two, point[0][:1], *point[1:], 1.0, np.array([True, True]))
    judge = arithmetic.Judge(one, one, two, *point, 1.0, np.array([True, True]))
    samples = np.zeros((4, 2)), np.zeros((4, 1)), np.zeros((4, 0))
    for before, after in (([0.0], [0.0, 0.0]), ([0.0] * 3, [0.0]), ([], [])):
        refuses(ValueError, "values for", judge.judge, before, after, 0.1)
    with pytest.raises((TypeError, ValueError)):
        judge.judge(["a", "b", "c"], [0.0, 0.0], 0.1)  # type: ignore[list-item]
    with pytest.raises(ValueError, match="fit"):
        arithmetic.centre_and_half((one, one, two), np.zeros((3, 5)), np.zeros(4), np.zeros((2, 5)), np.zeros((2, 5)))
    marks, two = np.empty(4, np.uint8), [None, np.empty((4, 2)), None, None, None]
    for numbers, some in (([np.empty((4, 3)), *two[1:]], marks), (two[:4], marks), (two, marks[:3])):
        refuses(ValueError, "fit", judge.judge_rows, *samples, [0], [0.1], numbers, some)
    for k in ([-1], [3], [4]):
        refuses(ValueError, "fit the recording", judge.judge_rows, *samples, k, [0.1], two, marks)
    for thresholds, counted, margin in ((6, 2, 1.0), (7, 1, 1.0), (7, 2, 0.0), (7, 2, math.nan)):
        watch = np.ones((2, thresholds)), 3, 1.0, [True] * counted, margin
        refuses(ValueError, "the thresholds do not fit the states", Repeating, *watch)


def test_rows_become_columns_with_the_sum_of_their_squares() -> None:
    values, steady, scale = np.arange(12.0).reshape(6, 2), np.array([1.0, 2.0]), np.array([2.0, 4.0])
    columns = np.empty((2, 3))
    total = arithmetic.normalised_columns(values, np.array([0, 2, 5]), steady, scale, columns)
    assert columns.tolist() == [[-0.5, 1.5, 4.5], [-0.25, 0.75, 2.25]] and total == 28.4375


def test_numbers_up_to_the_largest_are_carried_and_one_beyond_is_enough() -> None:
    assert arithmetic.all_carried([0.0, LARGEST, -LARGEST]) and arithmetic.all_carried([])
    for value in (math.nan, math.inf, np.nextafter(LARGEST, math.inf), -2.0 * LARGEST):
        assert not arithmetic.all_carried([value, 0.0])


def test_judges_share_the_pairs_that_were_seen_and_numbers_alone_need_none() -> None:
    rng, count = np.random.default_rng(0), 50
    one, point, seen = rng.random((2, 4)), (np.zeros(3), np.ones(3), -np.ones(3), np.ones(3)), np.ones((3, 4, 4), bool)
    judge = arithmetic.Judge(one, one, np.ones(2), *point, 1.0, np.array([True, True]), seen)
    samples = rng.random((count, 2)), rng.random((count, 1)), np.zeros((count, 0))
    given, alone = ([np.zeros((count, 2)) for _ in range(5)] for _ in range(2))
    marks = np.zeros((2, count), np.uint8)
    k, dt = np.arange(count - 1), np.full(count - 1, 0.1)
    judge.judge_rows(*samples, k, dt, given, marks[0])
    judge.judge_rows(*samples, k, dt, alone, None)
    np.testing.assert_array_equal(given, alone)
    seen[:] = False
    judge.judge_rows(*samples, k, dt, given, marks[1])
    assert (marks[0] & arithmetic.OUTSIDE == 0).all() and (marks[1][1:] & arithmetic.OUTSIDE > 0).all()


# --- repeats ------------------------------------------------------------------------------------------------------


def by_the_words(
    thresholds: Any, least: int, rest: float, counted: Any, margin: float, steps: list[tuple[Any, ...]]
) -> Any:
    """Codes, sizes and the most of each measure, as the head of `model/repeats.py` says, one state after another."""
    n = len(counted)
    codes, sizes, most = np.zeros((len(steps), n), dtype=np.uint8), np.zeros((len(steps), n)), np.zeros((4, n))
    for i in range(n):
        usual, longest, run_most, sum_most, active, noise_s, slow_s = thresholds[i]
        start: Any = None
        for k, (follows, t_ns, dt, before, after, lower, upper, own, outside) in enumerate(steps):
            if not follows or after[i] != before[i]:
                start = None
            if after[i] != before[i]:
                continue
            if start is None:
                start, begin, run, total, code, size = before, t_ns - dt, 0.0, 0.0, 1, 0.0
                rates, halves, per_s = list[float](), list[float](), list[float]()
            if not outside:
                movement, half = (lower[i] + upper[i]) / 2 - after[i], (upper[i] - lower[i]) / 2 / margin
                run, total = run + dt * 1e-9 * min(own[i], 0.0) * run + movement, total + movement
                rates.append(movement / (dt * 1e-9))
                halves.append(half)
                per_s.append(half / (dt * 1e-9))
            seconds, widest = (t_ns - begin) * 1e-9, max(halves, default=0.0)
            far, away = (abs(v) / widest if widest > 0 else math.inf if v else 0.0 for v in (run, total))
            spread = max(rates) - min(rates) if rates else 0.0
            activity = spread / max(per_s) if rates and max(per_s) > 0 else math.inf if spread > 0 else 0.0
            most[:, i] = np.fmax(most[:, i], (seconds, far, away, activity))
            if counted[i] and code < 3:
                left = (abs(after - start) > (upper - lower) / 2 / margin).any()
                still = n > 1 and (before == after).all()
                rests, times = after[i] == 0.0, max(1.0, seconds / longest) if longest >= rest else 1.0
                enough, shown = len(rates) >= least, len(rates) > 0 and seconds >= slow_s
                code = 2 if seconds > longest + dt * 1e-9 / 2 else 1
                unusual = seconds > usual
                if not outside:
                    if unusual and far > times * run_most and not rests and not still:
                        code, size = 3, far
                    elif unusual and away > times * sum_most and seconds > longest and left and not rests:
                        code, size = 4, away
                    elif unusual and enough and activity > max(active, 1.0 if rests else 1.0 / len(rates)):
                        code, size = 5, activity
                    elif (shown or (unusual and enough and seconds >= noise_s)) and not rests and not still:
                        code = 6
            codes[k, i], sizes[k, i] = code, size
    return codes, sizes, most


def test_repeats_are_told_as_the_words_say() -> None:
    seen: set[int] = set()
    for seed in range(60):
        rng = np.random.default_rng(seed)
        n, count, margin = int(rng.integers(1, 4)), 80, float(rng.choice([1.0, 1.5]))
        held = rng.uniform(size=(count, n)) < rng.choice([0.7, 0.9, 1.0], size=n)
        x = rng.normal(size=(count + 1, n)) * (rng.uniform(size=(count + 1, n)) < 0.8)  # some are 0
        for k in range(count):
            x[k + 1] = np.where(held[k], x[k], x[k + 1])
        dt = rng.integers(8_000_000, 12_000_000, count)
        t_ns = 1_700_000_000_000_000_000 + np.cumsum(dt)
        centre = x[1:] + rng.normal(size=(count, n)) * rng.choice([0.01, 0.2], size=n)
        half = rng.uniform(0.1, 0.5, (count, n)) * (rng.uniform(size=n) < 0.95)
        follows, outside = rng.uniform(size=count) < 0.97, rng.uniform(size=count) < 0.1
        own = rng.normal(size=(count, n)) * 5.0
        often = np.array([0.05, 0.1, 3.0, 6.0, 0.2, 0.1, 0.2]) * rng.choice([0.3, 1.0, np.inf], size=(n, 7))
        counted = rng.uniform(size=n) < 0.9
        rest = float(rng.choice([1.0, 0.05]))
        follow = Repeating(often, 3, rest, counted.tolist(), margin)
        given = (follows, t_ns, dt * 1e-9, x[:-1], x[1:], centre - half, centre + half, own, outside)
        codes, sizes = follow.take_all(*given)
        steps = list(zip(follows, t_ns, dt, x[:-1], x[1:], centre - half, centre + half, own, outside, strict=True))
        wanted, measured, most = by_the_words(often, 3, rest, counted, margin, steps)
        assert np.array_equal(codes, wanted)
        np.testing.assert_allclose(sizes, measured, rtol=1e-9)
        np.testing.assert_allclose(follow.most, most, rtol=1e-9)
        seen |= set(codes.ravel().tolist())
        alone = Repeating(often, 3, rest, counted.tolist(), margin)
        for k, (on, *step) in enumerate(steps):
            if not on:
                alone.forget()
            step[1] *= 1e-9
            told = alone.take(*step)
            more = np.flatnonzero(codes[k] > 1).tolist()
            assert [(i, c, s) for i, _, c, s in told] == [(i, codes[k, i], sizes[k, i]) for i in more]
    assert seen == set(range(7))


@pytest.mark.parametrize("limited", [False, True])
@pytest.mark.parametrize("each", [1, 3, 40, 700])
def test_boxes_hold_what_their_transitions_have(each: int, limited: bool) -> None:
    """Ranges and least room of transitions that follow one another, some of which are in none."""
    rng = np.random.default_rng(each)
    n, p, count = 2, 3, 1500
    elements = (draw(size=(n, k)) for draw in (rng.normal, rng.uniform) for k in (n, p - n))
    model = UncertainLTI(*elements, v=[0.1, 0.2])
    z, dt, after = rng.normal(size=(p, count)), rng.uniform(0.1, 0.2, count), rng.normal(size=(n, count))
    numbers = np.where(rng.uniform(size=count) < 0.9, np.arange(count) // each, -1)
    numbers[numbers >= 0] = np.unique(numbers[numbers >= 0], return_inverse=True)[1]
    boxes, widest = int(numbers.max()) + 1, np.array([3.0, 4.0]) if limited else None
    low, high, room = arithmetic.boxes_of(model.tables, z, dt, after, None, widest, numbers, boxes)
    centre, half = model.columns_centre_and_half(z, dt)
    moved = np.vstack([dt * z, dt])
    left = [half - (after - centre), half + (after - centre), *([widest[:, None] - half] if widest is not None else [])]
    for b in range(boxes):
        inside = numbers == b
        assert np.array_equal(low[:, b], moved[:, inside].min(axis=1))
        assert np.array_equal(high[:, b], moved[:, inside].max(axis=1))
        assert np.array_equal(room[:, b], np.vstack(left)[:, inside].min(axis=1))
    given = (model.tables, z, dt, after, None, widest, numbers, boxes - 1)
    refuses(ValueError, "the boxes do not fit the transitions", arithmetic.boxes_of, *given)


def test_sums_over_several_tiles_are_those_of_numpy() -> None:
    rng = np.random.default_rng(5)
    n, p, count = 2, 3, 300
    elements = [draw(size=(n, k)) for draw in (rng.normal, rng.uniform) for k in (n, p - n)]
    model = UncertainLTI(*elements, v=[0.1, 0.2])
    z, dt, after = rng.normal(size=(p, count)), rng.uniform(0.1, 0.2, count), rng.normal(size=(n, count))
    phi, moved = dt * np.vstack([z, np.ones(count)]), after - z[:n]
    psi, given = np.abs(phi), (z, dt, after, None)
    squares, _, regressors, targets, distance, sizes, visits = arithmetic.sums_of(n, *given, None, None, 1, [1], None)
    for found, sums in (
        (squares, psi @ psi.T), (regressors, phi @ phi.T), (targets, phi @ moved.T),
        (distance, np.square(moved).sum(axis=1)), (sizes, psi.sum(axis=1)), (visits, [count]),
    ):  # fmt: skip
        np.testing.assert_allclose(found, sums, rtol=1e-12, atol=1e-12)
    s, blocks = rng.uniform(size=(1, count)), arithmetic.Blocks((Axis("s", knots=(0.0, 1.0)),))
    squares, _, regressors, *_, visits = arithmetic.sums_of(n, *given, blocks, s, 1, [1], None)
    for found, columns in ((squares, psi), (regressors, phi)):
        of_blocks = np.vstack([(1.0 - s) * columns, s * columns])
        np.testing.assert_allclose(found, of_blocks @ of_blocks.T, rtol=1e-12, atol=1e-12)
    assert visits.tolist() == [np.sum(s <= 0.5), np.sum(s > 0.5)]
    centre, half = model.columns_centre_and_half(z, dt)
    u = (after - centre) / half
    outside, width, _, total, products, *_ = arithmetic.verdicts(model.tables, *given, None, None, np.ones((n, 1)))
    assert outside.tolist() == (np.abs(u) > 1.0).sum(axis=1).tolist()
    np.testing.assert_allclose(width, 2.0 * half.max(axis=1), rtol=1e-15)
    np.testing.assert_allclose(total, u.sum(axis=1), rtol=1e-12)
    np.testing.assert_allclose(products, u @ u.T, rtol=1e-12)
    for short in (after[:1], after[:, :9]):
        fit = z, dt, short, None, None, None, 1, [1], None
        refuses(ValueError, "the samples do not fit the terms", arithmetic.sums_of, n, *fit)


@pytest.mark.parametrize("limited", ["", "alike", "each"])
@pytest.mark.parametrize(("of_rows", "most"), [(False, 10_000), (False, 7), (True, 10_000), (True, 700), (True, 7)])
def test_a_scan_finds_every_transition_within_the_reach(limited: str, of_rows: bool, most: int) -> None:
    """By the formula, of transitions in pieces, one at rest, rows in another order, and no more than are asked for."""
    rng = np.random.default_rng(len(limited) + 10 * of_rows)
    n, p, count, offset, edges, rows = 3, 4, 700, 50, [0, 150, 151, 700], np.array([2, 0])
    z, dt, theta = rng.normal(size=(p, count)), rng.uniform(0.1, 0.4, count), rng.normal(size=(p + 1, 2))
    z[:, 5] = 0.0
    d, scale, reach = rng.uniform(0.1, 0.4, (p + 2, 2)), np.array([2.0, 0.8]), np.array([0.05, 0.2])
    if most == 700:
        reach[:] = np.inf  # all
    if not of_rows:
        edges = [0, count]
    unit = rng.uniform(0.5, 2.0, (p + 2, 2) if of_rows else p + 2)
    unit[p:] *= of_rows  # or what is at rest has no size
    phi, psi = np.vstack([z, np.ones(count)]), np.vstack([np.abs(z), np.ones(count), 1.0 / dt])
    half, after = d.T @ psi, z[:n] + rng.normal(size=(n, count))
    after[rows] = z[rows] + dt * (theta.T @ phi + half * rng.uniform(-1.1, 1.1, (2, count)))
    after[rows, 5] = dt[5] * (theta.T @ phi + 1.5 * half)[:, 5]
    weights = rng.uniform(0.5, 2.0, (count, n)) if limited == "each" else rng.uniform(0.5, 2.0, n)
    room = np.array([0.3, 0.1])
    root = np.broadcast_to(np.sqrt(weights).T if limited == "each" else np.sqrt(weights)[:, None], (n, count))
    limit = np.quantile(2.0 * half * dt * root[rows], 0.9, axis=1) if limited else None
    part: Any = SimpleNamespace(n=n, columns=SimpleNamespace(regimes=None, extra=(1, (True, False))))
    part.blocks = lambda: (
        Block(
            z[:, a:b], after[:, a:b], dt[a:b], weights[a:b] if limited == "each" else weights, start=a
        ) for a, b in pairwise(edges)
    )  # fmt: skip
    found = scan(part, Candidate(theta, d, unit, scale, limit, reach.copy(), room, most, rows), offset)
    size = (unit.T @ psi if of_rows else np.tile(unit @ psi, (2, 1))) * scale[:, None]
    size[:, 5] = size[:, 5] if of_rows else scale
    rate = (after[rows] - z[rows]) / dt
    slack = (half - np.abs(rate - theta.T @ phi)) / size
    within = reach if limit is None else np.minimum(reach, room)
    if limit is not None:
        left = (limit[:, None] / (2.0 * dt * root[rows]) - half) / size
        slack = np.where(left < room[:, None], np.minimum(slack, left), slack)
    for i, (parts, end) in enumerate(found):
        some = Samples.join(parts, p)
        k = some.index - offset
        wanted = np.flatnonzero(slack[i] < end - 1e-9)
        assert len(wanted) > 3 and np.isin(wanted, k).all(), "none that is nearer is left out"
        assert len(k) <= most and (
            end == min(within[i], 1e100) or (len(k) == most and np.isclose(end, np.sort(slack[i])[most]))
        )
        assert most == 7 or set(k) <= set(np.flatnonzero(slack[i] < reach[i])), "and none that is farther is taken"
        for values, truth in ((some.z, z), (some.rate, rate[i]), (some.dt, dt), (some.root_weight, root[rows[i]])):
            np.testing.assert_allclose(values, truth[..., k])


def test_samples_that_are_joined_are_in_order_each_once() -> None:
    every = Samples(np.arange(6), np.arange(12.0).reshape(2, 6), *np.arange(18.0).reshape(3, 6))
    for parts in ([[4, 5], [0, 2]], [[0, 1], [1, 3]], [[0, 1], [], [2, 5]], [[3], []], [[], []]):
        some = Samples.join([every[np.array(k, dtype=int)] for k in parts], 2)
        assert some.index.tolist() == sorted({k for part in parts for k in part})
        assert some.z[1].tolist() == [6.0 + k for k in some.index]


def test_what_a_tile_is_filled_up_with_counts_nowhere_and_on_a_bound_is_not_outside() -> None:
    """Three transitions at the first of two blocks, the other one with wider bounds; noise of half-width 0.5."""
    blocks = arithmetic.Blocks((Axis("s", knots=(0.0, 1.0)),))
    z, dt, after = np.zeros((2, 3)), np.ones(3), np.array([[0.2, 0.5, 2.0]])
    tables = np.zeros((2, 1, 2)), np.zeros((2, 1, 2)), np.array([[0.5], [5.0]])
    outside, width, *_ = arithmetic.verdicts(tables, z, dt, after, z[:1], blocks, np.zeros((1, 3)), np.ones((1, 1)))
    assert (outside.tolist(), width.tolist()) == ([1], [1.0])
    given = z, dt, after, z[:1], None, None, 0, (False,), np.zeros((2, 1)), np.array([[0.0], [0.0], [0.5]])
    of = np.array([0.0, 0.0, 1.0]), [2.0], [0.0], [0.0]  # sizes, by twice of which slack is told
    at, slack = arithmetic.near_bounds(1, *given, *of, None, [0])
    assert (at.tolist(), slack.tolist()) == ([2], [-0.75])
    at, slack = arithmetic.near_bounds(1, *given, *of[:2], [0.1], [0.0], None, [0])
    assert (at.tolist(), slack.tolist()) == ([1, 2], [0.0, -0.75]), "and those within the reach"
    given = z, np.array([0.5, 1.0, 2.0]), z[:1], z[:1], None, None, 0, (True,), np.zeros((2, 1)), given[-1]
    at, slack = arithmetic.near_bounds(1, *given, *of, np.array([1.5]), [0])
    assert (at.tolist(), slack.tolist()) == ([2], [-0.0625]), "by its width at its step, which alone is over the limit"
