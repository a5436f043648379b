# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The domain: which combinations of signals a fit saw, the same offline and sample by sample, and in the file."""

import json
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI
from uncertain_lti import fit as fit_public
from uncertain_lti.base.errors import ModelError
from uncertain_lti.identification import fit
from uncertain_lti.identification.structure import Structure
from uncertain_lti.kernel.arithmetic import Judge, occupy, outside_domain
from uncertain_lti.model.domain import MOST_CELLS, Domain, Occupancy, cells_for, jumps, outside_in_words
from uncertain_lti.signals.signal_map import Signal, SignalMap


def levels(values: list[float], rng: np.random.Generator, count: int = 1000) -> Transient:
    """A first-order lag that rests at each level for a while, with a little noise."""
    u = np.repeat(values, count)
    x = np.zeros(len(u) + 1)
    for k in range(len(u)):
        x[k + 1] = x[k] + 0.5 * (u[k] - x[k])
    t = np.arange(len(x)) * 10_000_000
    return Transient(t, x[:, None] + 1e-3 * rng.normal(size=(len(x), 1)), np.append(u, u[-1])[:, None])


def outside(model: UncertainLTI, transient: Transient) -> float:
    verdicts = EnvelopeMonitor(model).check(transient)
    return float(verdicts.outside_domain[verdicts.judged].mean())


def test_what_is_outside_is_named_by_signal_or_by_pair() -> None:
    """With as many digits as tell a value from the ends; pairs only where no signal leaves its own range."""
    held = np.zeros((1, 4, 4), dtype=bool)
    held[0, :, :2] = True
    signals = SignalMap((Signal("x0", "", "x0", 3.28e6),), (Signal("u0", "", "u0", 2.0, 10.0),))
    sides = np.array([0.0]), np.array([1.0])
    domain = Domain(*sides, *sides, Occupancy(4, held))
    model = UncertainLTI([[0.0]], [[0.0]], [[0.0]], [[0.0]], signals=signals, domain=domain)
    assert outside_in_words(model, np.array([[1.5], [0.2]])) == "x0 at 3280002 (fitted: 3280000 to 3280001)"
    assert outside_in_words(model, np.array([[0.5], [1.5]])) == "u0 at 17 (fitted: 2 to 12)"
    assert outside_in_words(model, np.array([[0.5], [0.9]])) == "combinations of x0 with u0 that were not fitted"
    assert not outside_in_words(model, np.array([[0.5], [0.2]]))


def test_of_pairs_that_which_is_new_most_often_is_named_first() -> None:
    rng = np.random.default_rng(0)
    s, noise = rng.uniform(-1, 1, (4000, 1)), 0.02 * rng.uniform(-1, 1, (4000, 2))
    model = fit(Transient(np.arange(4000) * 0.1, np.hstack([s, s + noise[:, :1]]), noise[:, 1:] - s), additive="noise")
    z = np.array([[0.8, 0.8, 0.8]] * 20 + [[0.8, -0.8, -0.8]] * 2).T
    assert outside_in_words(model, z) == "combinations of x2 with u1, x1 with u1, x1 with x2 that were not fitted"


def test_the_span_of_a_state_is_in_recorded_units() -> None:
    domain = Domain(*map(np.array, ([-0.5, 0.0], [1.5, 0.25], [0.0], [1.0])))
    assert domain.span(np.array([3.0, 8.0])).tolist() == [6.0, 2.0]


def test_rounding_of_what_never_moved_is_not_outside() -> None:
    still = Domain(*(np.array([0.7]) for _ in range(4)))
    for share, outside in ((1e-13, False), (1e-11, True)):
        assert still.outside([0.7 * (1 + share)], [0.7]) == still.outside([0.7], [0.7 * (1 - share)]) == outside


def test_levels_between_those_fitted_and_larger_jumps_are_outside() -> None:
    """Both lie inside the box of what was fitted."""
    rng = np.random.default_rng(1)
    model = fit([levels([0.0, 1.0, 2.0, 3.0, 4.0, 3.0, 2.0, 1.0, 0.0, 1.0], rng)], additive="noise")
    assert model.domain.measure is not None and model.domain.measure.cells == MOST_CELLS
    assert outside(model, levels([0.0, 1.0, 2.0, 1.0], rng)) < 0.01
    assert outside(model, levels([0.5, 1.5, 2.5], rng)) > 0.9
    jump = levels([0.0, 4.0, 0.0, 4.0] * 20, rng, 20)
    box = Domain(*(getattr(model.domain, name) for name in ("x_min", "x_max", "u_min", "u_max")))
    steps = jump.transitions()
    assert box.outside(model.operating_point.normalise_x(steps.x), steps.u).mean() < 0.4
    far = np.abs(steps.x - steps.u)[:, 0] > 1.3
    seen = model.domain.outside(model.operating_point.normalise_x(steps.x), steps.u)
    assert seen[far].all() and far.sum() > 50


def test_nothing_that_was_fitted_is_outside() -> None:
    rng = np.random.default_rng(2)
    x, u = rng.normal(size=(3001, 3)), rng.normal(size=(3001, 2))
    runs = [Transient(np.arange(3001) * 1_000_000, x, u)]
    model = fit(runs, additive="noise")
    assert model.domain.measure is not None
    assert outside(model, runs[0]) == 0.0
    assert fit([Transient(np.arange(101) * 1_000_000, x[:101], u[:101])], additive="noise").domain.measure is None


def arms(seed: int, poses: list[tuple[float, float]]) -> Transient:
    """Two joints, each driven by its own command."""
    rng, u = np.random.default_rng(seed), np.repeat(poses, 40, axis=0)
    x = np.zeros_like(u)
    for k in range(len(u) - 1):
        x[k + 1] = x[k] + 0.2 * (u[k] - x[k])
    return Transient(np.arange(len(u)) * 10_000_000, x + 1e-3 * rng.normal(size=x.shape), u)


def test_levels_of_two_that_no_row_has_both_are_no_combination() -> None:
    """An arm of six joints was outside in every pose that it had not been in with all of them."""
    ways = [-1.0, 0.0, 1.0, 0.0] * 10
    together, apart = arms(1, [(a, a) for a in ways]), arms(2, [(a, -a) for a in ways])
    own = np.where(np.eye(2, dtype=bool), np.nan, 0.0)
    structure = Structure(2, 2, fixed={name: own for name in ("A", "B", "dA", "dB")})
    assert outside(fit([together], additive="noise"), apart) > 0.4
    model = fit([together], additive="noise", structure=structure)
    assert outside(model, together) == 0.0 and outside(model, apart) < 0.05
    slow = apart.replace(u=apart.u * [1.0, 0.5], x=apart.x * [1.0, 0.5])  # levels of the second that were not fitted
    assert outside(model, slow) > 0.4
    again = model.update([arms(3, [(a, a) for a in ways])])
    assert outside(again, apart) < 0.05


def test_where_no_recording_repeats_the_combinations_of_another_ranges_alone_count() -> None:
    """A healthy arm that goes to other poses each time was outside in all it did, and its quiet said nothing."""

    def joints(seed: int, poses: int, of: int | None = None) -> Transient:
        drawn = np.random.default_rng(seed if of is None else of).uniform(-1.0, 1.0, (3, poses, 2))
        ends = np.tile([[1.0, 1.0], [-1.0, -1.0]], (3, 1, 1))  # all go as far
        poses_of = [np.repeat([*ends[j], *drawn[j]], 5, axis=0) for j in range(3)]  # rests in each
        parts = [arms(seed + 50 * j, [*map(tuple, each)]) for j, each in enumerate(poses_of)]
        return parts[0].replace(x=np.hstack([p.x for p in parts]), u=np.hstack([p.u for p in parts]), signals=None,
            state_names=[*"abcdef"], control_names=[*"ghijkl"])  # fmt: skip

    runs = [joints(seed, 10) for seed in range(4)]
    plain, model = fit(runs, additive="noise"), fit_public(runs, "lp", additive="noise")
    assert plain.domain.measure is not None and model.domain.measure is None
    assert outside(plain, joints(9, 10)) > 0.5 and outside(model, joints(9, 10)) == 0.0
    far = runs[0].replace(x=1.5 * runs[0].x, u=1.5 * runs[0].u)
    assert outside(model, far) > 0.1
    assert UncertainLTI.from_dict(json.loads(json.dumps(model.to_dict()))).domain.measure is None
    alike = fit_public([*(joints(seed, 10, of=0) for seed in range(4)), joints(9, 10)], "lp", additive="noise")
    assert alike.domain.measure is not None  # but for one that is not typical
    many = fit_public([joints(seed, 150) for seed in range(4)], "lp", additive="noise")
    assert many.domain.measure is not None  # enough of them to tell


def test_a_place_on_which_nothing_depends_has_no_range_to_leave(tmp_path) -> None:
    """Heading and position of a robot that drives on."""
    rng, count = np.random.default_rng(2), 600
    u = rng.choice([-1.0, 1.0], (count, 1)).repeat(2, axis=0)[:count]
    speed = np.convolve(u[:, 0], np.full(5, 0.2))[:count] + 0.01 * rng.normal(size=count)
    run = Transient(0.01 * np.arange(count), np.column_stack([speed, 0.01 * np.cumsum(speed)]), u)
    run = run.replace(x=run.x + 1e-4 * rng.normal(size=run.x.shape))
    away = run.replace(x=run.x + [0.0, 40.0])
    assert outside(fit([run], additive="noise"), away) == 1.0
    known = np.array([[np.nan, 0.0], [np.nan, 0.0]])
    structure = Structure(2, 1, fixed={"A": known, "dA": known})
    assert not structure.together[1].any()
    model = fit([run], additive="noise", structure=structure)
    assert model.residuals is not None and len(model.residuals.forms) == 1, "a law would have the place in it"
    assert model.domain.measure is not None and model.domain.measure.occupied[0].all()
    model.save(tmp_path / "m.json")
    for each in (
        model,
        UncertainLTI.load(tmp_path / "m.json"),
        model.update([run.replace(x=run.x[::-1], name="back")]),
    ):
        assert outside(each, away) == 0.0 and outside(each, run.replace(x=run.x + [9.0, 0.0])) == 1.0
    text = (tmp_path / "m.json").read_text().replace('"anywhere": [', '"anywhere": [3, ')
    with pytest.raises(ModelError, match="'domain.anywhere' must be a list of 3"):
        UncertainLTI.from_dict(json.loads(text))


@settings(max_examples=30, deadline=None)
@given(size=st.integers(1, 6), cells=st.integers(2, 15), seed=st.integers(0, 10**6))
def test_one_sample_and_many_agree(size: int, cells: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, size + 1))
    least, greatest = -rng.uniform(0, 2, size), rng.uniform(0, 2, size)
    if seed % 3 == 0:
        greatest[0] = least[0]  # a signal that does not move
    pairs = max(size * (size - 1) // 2, 1)
    measure = Occupancy(cells, rng.random((pairs, cells, cells)) < 0.9)
    domain = Domain(least[:n], greatest[:n], least[n:], greatest[n:], measure)
    z = rng.uniform(-2.2, 2.2, (50, size))
    z[:20] = least + (greatest - least) * rng.random((20, size))
    z[:4] = rng.choice([0.0, 1.0], (4, size)) * (greatest - least) + least  # corners
    z[4, 0] = 1e300
    expected = domain.outside(z[:, :n], z[:, n:])
    terms = np.zeros((n, size + 1)), np.zeros((n, size + 1)), np.zeros(n)
    judge = Judge(*terms, np.zeros(size), np.ones(size), least, greatest, 1.0, np.ones(n, bool), measure.occupied)
    assert [judge.judge(row.tolist(), row[:n].tolist(), 0.1).outside_domain for row in z] == expected.tolist()
    with np.errstate(divide="ignore", invalid="ignore"):
        span = greatest - least
        place = np.clip((z - least) * np.where(span > 0, cells / span, 0.0), 0, cells - 1).astype(int)
    chosen = list(combinations(range(size), 2)) or [(0, 0)]
    slack = 0.1 * span + 1e-12 * np.maximum(-least, abs(greatest))
    naive = [
        bool(((row < least - slack) | (row > greatest + slack)).any())
        or not all(measure.occupied[pair, at[i], at[j]] for pair, (i, j) in enumerate(chosen))
        for row, at in zip(z, place, strict=True)
    ]
    assert naive == expected.tolist()


@pytest.mark.parametrize("cells", [5, 10, 15])
def test_what_was_seen_is_seen_on_a_grid_over_larger_ranges(cells: int) -> None:
    """Also what lies at the end of the smaller range, as of a fan that has a third speed in summer."""
    rng = np.random.default_rng(cells)
    winter = np.array([rng.choice([20.0, 60.0], 40), np.round(rng.normal(size=40), 1), np.full(40, 3.0)])
    for further in ([100.0, 9.0, 4.0], [0.0, -9.0, 2.0], [20.0, 0.0, 3.0]):
        ends = winter, np.column_stack([winter, further])
        boxes = [(z.min(axis=1), z.max(axis=1)) for z in ends]
        visited = np.zeros((3, cells, cells), dtype=bool)
        occupy(winter, *boxes[0], visited)
        before = Domain(boxes[0][0][:2], boxes[0][1][:2], boxes[0][0][2:], boxes[0][1][2:], Occupancy.of(visited))
        held = before.measure.within(before, *boxes[1])
        assert not outside_domain(winter, *boxes[1], held).any()
        assert further[1] == 0.0 or not held[0].all(), "and not everything is"


def a_file(folder: Path) -> tuple[UncertainLTI, dict[str, Any]]:
    rng = np.random.default_rng(3)
    model = fit([levels([0.0, 1.0, 0.0], rng)], additive="noise")
    model.save(folder / "m.model.json")
    return model, json.loads((folder / "m.model.json").read_text())


def test_the_oldest_format_that_holds_a_model_is_written(tmp_path: Path) -> None:
    model, data = a_file(tmp_path)
    assert data["format"] == "uncertain-lti/2"
    loaded = UncertainLTI.load(tmp_path / "m.model.json").domain.measure
    assert np.array_equal(loaded.occupied, model.domain.measure.occupied)
    del data["domain"]["measure"]
    assert data["domain"].pop("step_max") and data.pop("residuals")
    assert data.pop("frozen") and data.pop("memory")
    older = UncertainLTI.from_dict({**data, "format": "uncertain-lti/1"})
    assert older.domain.measure is None and older.to_dict()["format"] == "uncertain-lti/1"
    assert UncertainLTI.from_dict(data).domain.measure is None, "every new key is optional"


def test_far_beyond_is_more_than_a_tenth_of_the_range() -> None:
    one = np.ones(1)
    domain = Domain(-1 * one, 4 * one, 0 * one, 10 * one)
    inside, far = [[-1.5, 4.5], [-1.0, 11.0]], [[-1.6, 0.0, 4.6, 0.0], [0.0, -1.1, 0.0, 11.1]]
    assert not domain.beyond(np.array(inside)).any() and domain.beyond(np.array(far)).all()


@pytest.mark.parametrize(("count", "cells"), [(16 * 16 - 1, 0), (16 * 16, 4), (16 * 100, 10), (10**6, MOST_CELLS)])
def test_a_range_has_as_many_cells_as_samples_can_fill(count: int, cells: int) -> None:
    assert cells_for(count) == cells


def test_a_jump_is_a_change_beyond_the_largest_of_the_fit() -> None:
    rng = np.random.default_rng(4)
    run = levels([0.0, 1.0, 2.0], rng)
    model = fit([run], "qp", additive="noise")
    assert model.domain.step_max is not None
    most = np.abs(np.diff(run.x, axis=0)).max(axis=0)
    before = run.x[10]
    for change, said in ((most, 0.0), (-most, 0.0), (1.01 * most, 1.01 * most), (-2 * most, -2 * most)):
        found, limit = jumps(model, before, before + change)
        np.testing.assert_allclose(found, said, rtol=1e-9)
        np.testing.assert_allclose(limit, most)
