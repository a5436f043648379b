# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Scheduled (piecewise-linear) models: exact, contained, and honest about what the recordings hold."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refuses

from uncertain_lti import OperatingPoint, Transient
from uncertain_lti.base.errors import FitError
from uncertain_lti.identification import fit, working_set
from uncertain_lti.identification.assembly import assemble
from uncertain_lti.identification.problem import Regimes, solve_as_written
from uncertain_lti.identification.regimes import Modes
from uncertain_lti.identification.structure import Structure
from uncertain_lti.model.schedule import Axis, Schedule
from uncertain_lti.signals.signal_map import Signal, SignalMap

CLARABEL = dict(tol_gap_abs=1e-12, tol_gap_rel=1e-12, tol_feas=1e-12)
NAMES = ["x1", "x2", "u1", "u2"]
THREE = Schedule((Axis("u1", knots=(-1.0, 0.0, 1.0)),))
SCHEDULES = {
    "control": THREE,
    "state": Schedule((Axis("x1", knots=(0.0, 0.1)),)),
    "two axes": Schedule((Axis("u1", knots=(-1.0, 0.2, 1.0)), Axis("x2", knots=(-0.3, 0.3)))),
    "modes": Schedule((Axis("u2", modes=(-1.0, 1.0, 2.0)),)),
    "modes and knots": Schedule((Axis("u2", modes=(-1.0, 1.0, 2.0)), Axis("u1", knots=(-1.0, 1.0)))),
    "further": Schedule((Axis("s1", knots=(0.0, 0.4, 1.0)),)),
}


def drawn(schedule, N, seed, noise=0.0, jitter=0.3, spread=0.1, hold=7):
    """A transient of a plant that is piecewise linear over the schedule, with elements drawn anew at every step."""
    rng = np.random.default_rng(seed)
    R = schedule.blocks
    A = -np.diag(rng.uniform(1, 8, 2)) + rng.uniform(-1, 1, (R, 2, 2))
    B, c = rng.uniform(-3, 3, (R, 2, 2)), rng.uniform(-0.3, 0.3, (R, 2))
    t_ns = np.concatenate([[0], np.cumsum(np.rint(25e6 * (1 + jitter * rng.uniform(-1, 1, N))).astype(np.int64))])
    u = np.repeat(rng.uniform(-1, 1, (N // hold + 1, 2)), hold, axis=0)[: N + 1]
    if any(axis.modes for axis in schedule.axes):
        u[:, 1] = np.repeat(rng.choice([-1.0, 1.0, 2.0], N // hold + 1), hold)[: N + 1]
    s = np.repeat(rng.uniform(0, 1, N // hold + 1), hold)[: N + 1, None]
    x = np.full((N + 1, 2), 0.1)
    positions = schedule.positions([*NAMES, "s1"])
    for k in range(N):
        z = np.concatenate([x[k], u[k], s[k]])
        w = schedule.weights(z[list(positions), None])[:, 0]
        elements = np.tensordot(w, A, 1) * (1 + spread * rng.uniform(-1, 1, (2, 2)))
        rate = elements @ x[k] + np.tensordot(w, B, 1) @ u[k] + w @ c
        x[k + 1] = x[k] + (t_ns[k + 1] - t_ns[k]) * 1e-9 * rate
    further = s if "s1" in [axis.signal for axis in schedule.axes] else None
    return Transient(t_ns, x + noise * rng.standard_normal(x.shape), u, s=further, name=f"drawn {seed}")


def written(transient, schedule, additive, weights=None):
    """The problem as a fit assembles it."""
    q = transient.s.shape[1]
    point = OperatingPoint(np.zeros(2), np.zeros(2), np.ones(2), np.ones(2), np.zeros(q), np.ones(q))
    regimes = Regimes(schedule, schedule.positions([*NAMES, "s1"][: 4 + q]))
    return assemble([transient], point, weights, additive, regimes=regimes)


def optimum(transient, schedule, additive, criterion, weights=None):
    """Of the problem as written, by whichever of several solvers manages it."""
    import cvxpy as cp

    problem = written(transient, schedule, additive, weights)
    tight = {"eps_abs": 1e-12, "eps_rel": 1e-12}
    solvers = [("HIGHS", {})] if criterion == "lp" else [(cp.PIQP, tight), ("CLARABEL", {})]
    for solver, options in solvers:
        try:
            return solve_as_written(problem, criterion, solver, **options)[2]
        except FitError:
            continue
    raise AssertionError("no solver has an optimum of the problem as written")


def outside(model, transient):
    """Transitions outside, by the bounds of the model."""
    steps = transient.transitions()
    centre, half = model.columns_centre_and_half(model.normalised_columns(steps), steps.dt)
    x_next = model.operating_point.normalise_x(steps.x_next).T
    return int((~((centre - half <= x_next) & (x_next <= centre + half))).any(axis=0).sum())


@pytest.mark.parametrize("criterion", ["qp", "lp"])
@pytest.mark.parametrize("which", SCHEDULES)
def test_objective_is_that_of_the_problem_as_written(which, criterion):
    schedule = SCHEDULES[which]
    rng = np.random.default_rng(0)
    root = rng.standard_normal((500, 2, 2))
    weights = {
        "control": rng.uniform(0.1, 10, (500, 2)),
        "state": np.array([1.0, 30.0]),
        "further": root @ root.transpose(0, 2, 1) + 0.1 * np.eye(2),
    }
    for additive, W in (("none", None), ("both", None), ("disturbance", weights.get(which))):
        if additive == "disturbance" and W is None:
            continue
        transient = drawn(schedule, 500, 1, noise=0.0 if additive == "none" else 1e-3)
        model = fit(transient, criterion, W, additive, schedule=schedule)
        expected = optimum(transient, schedule, additive, criterion, W)
        assert [data.tied_to for data in model.block_data] == [None] * schedule.blocks
        assert sum(data.transitions for data in model.block_data) == 500
        assert np.atleast_1d(model.fit_summary["objective"]) == pytest.approx(expected, rel=1e-6)
        assert model.fit_summary["optimality_gap"] < 1e-7
        assert outside(model, transient) == 0


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    which=st.sampled_from(sorted(SCHEDULES)),
    criterion=st.sampled_from(["qp", "lp"]),
    additive=st.sampled_from(["none", "disturbance", "noise", "both"]),
    noise=st.sampled_from([0.0, 1e-6, 1e-2]),
    N=st.sampled_from([60, 300]),
)
def test_nothing_is_left_outside_whatever_the_data(seed, which, criterion, additive, noise, N):
    schedule = SCHEDULES[which]
    transient = drawn(schedule, N, seed, noise)
    model = fit(transient, criterion, additive=additive, schedule=schedule)
    assert outside(model, transient) == 0
    for r, data in enumerate(model.block_data):  # what is tied has the other's elements, to the bit
        if data.tied_to is not None:
            for name in ("A", "B", "c", "dA", "dB", "dc", "v"):
                assert (getattr(model, name)[r] == getattr(model, name)[data.tied_to]).all()


def everything_shared(n=2, m=2):
    shapes = {"A": (n, n), "B": (n, m), "c": n, "dA": (n, n), "dB": (n, m), "dc": n, "v": n}
    return Structure(n, m, shared={name: np.ones(shape, dtype=bool) for name, shape in shapes.items()})


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), which=st.sampled_from(list(SCHEDULES)), criterion=st.sampled_from(["qp", "lp"]))
def test_all_blocks_shared_is_one_block_of_any_plant(seed, which, criterion):
    transient = drawn(SCHEDULES[which], 300, seed, noise=1e-3)
    one = fit(transient, criterion, additive="both", schedule={})
    model = fit(transient, criterion, additive="both", schedule=SCHEDULES[which], structure=everything_shared())
    assert model.fit_summary["objective"] == pytest.approx(one.fit_summary["objective"], rel=1e-7)


@pytest.mark.parametrize("criterion", ["qp", "lp"])
def test_large_problem_reaches_the_same_optimum(criterion, monkeypatch):
    monkeypatch.setattr(working_set, "SUBSAMPLE", 1000)
    transient = drawn(THREE, 2005, 4, noise=1e-4)
    model = fit(transient, criterion, additive="both", schedule=THREE)
    assert model.fit_summary["solver"]["passes"] > 1
    assert model.fit_summary["optimality_gap"] < 1e-7
    expected = optimum(transient, THREE, "both", criterion)
    assert np.atleast_1d(model.fit_summary["objective"]) == pytest.approx(expected, rel=1e-6)
    assert outside(model, transient) == 0


def test_five_knots_reach_the_least_largest_width_and_its_ties():
    """With fifty unknowns per row: the least largest width, and among its optima the least squared widths."""
    import cvxpy as cp

    schedule = Schedule((Axis("u1", knots=(-1, -0.5, 0, 0.5, 1)),))
    transient = drawn(THREE, 1000, 6, noise=1e-4)
    model = fit(transient, "lp", additive="both", schedule=schedule)
    assert model.fit_summary["optimality_gap"] < 1e-6
    assert outside(model, transient) == 0
    steps = transient.transitions()
    lower, upper = model.bounds(steps.x, steps.u, steps.dt, s=steps.s)
    problem = written(transient, schedule, "both")
    phi, psi = (columns * problem.dt[:, None] for columns in (problem.phi(), problem.psi()))
    phi, psi = (columns / np.abs(columns).max(axis=0) for columns in (phi, psi))
    for half, step in zip(0.5 * (upper - lower).T, (problem.rate() * problem.dt[:, None]).T, strict=True):
        unit = np.sqrt(np.mean(step**2))
        theta, d = cp.Variable(phi.shape[1]), cp.Variable(psi.shape[1], nonneg=True)
        room = [cp.abs(step / unit - phi @ theta) <= psi @ d, psi @ d <= half.max() / unit * (1 + 1e-8)]
        squares = cp.Problem(cp.Minimize(cp.sum_squares(psi @ d) / len(step)), room)
        squares.solve("CLARABEL")
        assert np.mean(half**2) / unit**2 < (1.0 + 1e-4) * squares.value


@pytest.mark.parametrize("weight", [1e-18, 1e18])
def test_the_least_largest_width_whatever_the_weights(weight):
    transient = drawn(THREE, 1000, 8, noise=1e-4)
    plain = fit(transient, "lp", additive="noise", schedule=THREE)
    weighted = fit(transient, "lp", additive="noise", schedule=THREE, weights=np.full(2, weight))
    objective = np.asarray(weighted.fit_summary["objective"]) / np.sqrt(weight)
    assert objective == pytest.approx(plain.fit_summary["objective"], rel=1e-7)


def test_a_piecewise_linear_plant_is_recovered():
    transient = drawn(SCHEDULES["further"], 2000, 5, spread=0.0)
    rng = np.random.default_rng(5)
    A = -np.diag(rng.uniform(1, 8, 2)) + rng.uniform(-1, 1, (3, 2, 2))
    B, c = rng.uniform(-3, 3, (3, 2, 2)), rng.uniform(-0.3, 0.3, (3, 2))
    for criterion in ("qp", "lp"):
        model = fit(transient, criterion, additive="disturbance", schedule={"s1": (0, 0.4, 1)})
        for found, true in ((model.A, A), (model.B, B), (model.c, c)):
            assert found == pytest.approx(true, abs=1e-6)
        assert max(model.fit_summary["max_width"]) < 1e-8


def test_recorded_knots_are_those_of_the_units():
    transient = drawn(THREE, 500, 6, noise=1e-3)
    point = OperatingPoint(np.zeros(2), np.array([0.5, 0.0]), np.ones(2), np.array([2.0, 1.0]))
    model = fit(transient, additive="noise", operating_point=point, schedule={"u1": (-1, 0, 1)})
    assert model.schedule == Schedule((Axis("u1", knots=(-0.75, -0.25, 0.25)),))
    assert outside(model, transient) == 0


def test_a_number_of_knots_is_placed_where_the_residual_is_largest():
    """Most of the data is where the plant is linear; its kink is in the part that is seldom visited."""
    rng = np.random.default_rng(0)
    N = 4000
    often = rng.random(N // 5 + 1) < 0.9
    u = np.repeat(np.where(often, rng.uniform(0, 1, N // 5 + 1), rng.uniform(1, 3, N // 5 + 1)), 5)
    u = u[: N + 1, None]
    x = np.zeros((N + 1, 1))
    for k in range(N):
        x[k + 1] = x[k] + 0.01 * (-3 * x[k] + u[k] - 2 * np.maximum(u[k] - 2.0, 0.0) + 0.01 * rng.uniform(-1, 1))
    model = fit(Transient(np.arange(N + 1) * 10_000_000, x, u), additive="both", schedule={"u1": 3})
    knots = model.schedule.axes[0].knots
    assert knots[0] == u[:-1].min() and knots[-1] == u[:-1].max()
    assert knots[1] == pytest.approx(2.0, abs=0.2)
    one = fit(Transient(np.arange(N + 1) * 10_000_000, x, u), additive="both")
    assert model.fit_summary["mean_width"] < 0.3 * one.fit_summary["mean_width"]


def test_blocks_without_data_share_those_of_their_neighbour_and_it_is_said():
    transient = drawn(THREE, 500, 7, noise=1e-3)
    model = fit(transient, additive="both", schedule={"u1": (-1, 0, 1, 2, 3)})
    tied = [data.tied_to for data in model.block_data]
    assert tied == [None, None, None, 2, 2]
    assert model.block_data[4].transitions == 0 and not model.block_data[4].known
    said = [m for m in model.fit_summary["messages"] if "shares those" in m]
    assert len(said) == 2 and "u1 = 2" in said[0] and "u1 = 1" in said[0] and "record" in said[0]
    many = fit(transient, additive="both", schedule={"u1": np.arange(-1, 12)}).fit_summary["messages"]
    assert sum("shares those" in m for m in many) == 5 and any(m.startswith("5 more blocks have too") for m in many)
    # it costs nothing: what no transition visits has no part in any
    fewer = fit(transient, additive="both", schedule={"u1": (-1, 0, 1)})
    assert model.fit_summary["objective"] == pytest.approx(fewer.fit_summary["objective"], rel=1e-9)


def test_recordings_beyond_the_end_knots_are_noted_with_their_range():
    transient = drawn(THREE, 500, 7, noise=1e-3)
    inside = transient.u[:-1, 0]
    given = fit(transient, additive="both", schedule={"u1": (-0.5, 0.5)})
    (said,) = [m for m in given.fit_summary["messages"] if "beyond its knots" in m]
    share = np.mean(np.abs(inside) > 0.5)
    reached = f"u1 goes from {inside.min():.5g} to {inside.max():.5g} in the recordings"
    assert said.startswith(f"{reached}, and {share:.2%} of")
    for knots in (3, (-1, 0, 1)):
        said = fit(transient, additive="both", schedule={"u1": knots}).fit_summary["messages"]
        assert not any("beyond its knots" in m for m in said)


def test_a_mode_with_few_transitions_is_tied_and_contained():
    schedule = SCHEDULES["modes"]
    transient = drawn(schedule, 500, 8, noise=1e-3)
    u = transient.u.copy()
    u[100:105, 1] = 3.0
    rare = Transient(transient.t_ns, transient.x, u)
    model = fit(rare, additive="both", schedule={"u2": Modes([-1, 1, 2, 3])})
    assert model.block_data[3].transitions == 5 and model.block_data[3].tied_to == 2
    assert outside(model, rare) == 0


def test_facts_of_each_block():
    transient = drawn(THREE, 500, 9, noise=1e-3, jitter=0.0)
    model = fit(transient, additive="both", schedule=THREE)
    problem = written(transient, THREE, "both")
    centre, half = model.columns_centre_and_half(problem.z, problem.dt)
    largest = THREE.weights(problem.z[[2]]).argmax(axis=0)
    for r, facts in enumerate(model.fit_summary["blocks"]):
        assert facts["transitions"] == np.count_nonzero(largest == r) == model.block_data[r].transitions
        assert facts["mean_width"] == pytest.approx(2 * half[:, largest == r].mean(axis=1))
        assert facts["max_width"] == pytest.approx(2 * half[:, largest == r].max(axis=1))
        assert facts["spectral_radius"] == model.blocks[r].spectral_radius()
    assert model.fit_summary["mean_width"] == pytest.approx(2 * half.mean(axis=1))


def test_structure_at_one_knot_and_shared_by_all():
    transient = drawn(THREE, 600, 11, noise=1e-3)
    rules = [
        {"state": "x1", "from": "x2", "nominal": 0.25, "knot": 2},
        {"state": "x2", "from": "x1", "nominal": {"min": 0}, "half_width": 0},
        {"state": "x2", "from": "u2", "shared": True},
    ]
    structure = Structure.from_rules(rules, ["x1", "x2"], ["u1", "u2"], schedule=THREE)
    again = Structure.from_dict(structure.to_dict(), 2, 2)
    for criterion in ("qp", "lp"):
        model = fit(transient, criterion, additive="both", schedule=THREE, structure=structure)
        assert model.A[1, 0, 1] == 0.25 and (model.A[[0, 2], 0, 1] != 0.25).all()
        assert (model.A[:, 1, 0] >= 0).all() and (model.dA[:, 1, 0] == 0).all()
        assert np.ptp(model.B[:, 1, 1]) == 0 and np.ptp(model.dB[:, 1, 1]) == 0 and np.ptp(model.B[:, 0, 1]) > 0
        assert outside(model, transient) == 0
        free = fit(transient, criterion, additive="both", schedule=THREE)
        assert (np.atleast_1d(model.fit_summary["objective"]) >= free.fit_summary["objective"] * (1 - 1e-9)).all()
        same = fit(transient, criterion, additive="both", schedule=THREE, structure=again)
        assert (same.A == model.A).all() and (same.dB == model.dB).all()


def test_structure_reaches_the_optimum_of_the_bounded_problem():
    """Elements that are shared, by the problem as written with that equality."""
    import cvxpy as cp

    transient = drawn(THREE, 300, 12, noise=1e-3)
    shared = {"B": np.array([[True, False], [False, False]]), "dA": np.array([[False, True], [False, False]])}
    structure = Structure(2, 2, shared=shared)
    problem = written(transient, THREE, "noise")
    phi, psi = problem.phi() * problem.dt[:, None], problem.psi() * problem.dt[:, None]
    step = problem.rate()[:, 0] * problem.dt * 1e3
    unit_phi, unit_psi = np.sqrt(np.mean(phi**2, axis=0)), np.sqrt(np.mean(psi**2, axis=0))
    for criterion in ("qp", "lp"):
        scaled_theta, scaled_d, delta = cp.Variable(15), cp.Variable(15, nonneg=True), cp.Variable()
        theta, d = cp.multiply(scaled_theta, 1 / unit_phi), cp.multiply(scaled_d, 1 / unit_psi)
        centre, half = (phi / unit_phi) @ scaled_theta, (psi / unit_psi) @ scaled_d
        limits = [step - centre <= half, step - centre >= -half]
        limits += [theta[2 + 5 * r] == theta[2] for r in (1, 2)] + [d[1 + 5 * r] == d[1] for r in (1, 2)]
        if criterion == "lp":
            limits.append(2 * half <= delta)
        programme = cp.Problem(cp.Minimize(delta if criterion == "lp" else cp.sum_squares(half)), limits)
        programme.solve(solver="CLARABEL", **CLARABEL)
        model = fit(transient, criterion, additive="noise", schedule=THREE, structure=structure)
        d = np.concatenate([np.r_[model.dA[r, 0], model.dB[r, 0], model.v[r, 0]] for r in range(3)])
        half = 1e3 * psi @ d
        found = 2 * half.max() if criterion == "lp" else np.sum(half**2)
        assert found == pytest.approx(programme.value, rel=1e-7)


@pytest.mark.parametrize(
    "rule, words",
    [
        ({"knot": 4}, "counted from 1"),
        ({"knot": 0}, "counted from 1"),
        ({"knot": "first"}, "write a number"),
        ({"knot": 2, "shared": True}, "at all knots"),
        ({"shared": "yes"}, "true or false"),
    ],
)
def test_rules_of_a_structure_that_make_no_sense_are_refused(rule, words):
    with pytest.raises(FitError, match=words):
        Structure.from_rules([{"state": "x1", "from": "x2", "nominal": 0, **rule}], ["x1", "x2"], [], schedule=THREE)


def test_a_knot_without_a_schedule_is_refused():
    with pytest.raises(FitError, match="no schedule"):
        Structure.from_rules([{"state": "x1", "from": "x1", "nominal": 0, "knot": 2}], ["x1"], [])
    transient = drawn(THREE, 300, 1)
    refuses(FitError, "3 blocks", fit, transient, schedule={"u1": (-1, 1)}, structure=Structure(2, 2, blocks=3))


@pytest.mark.parametrize(
    "schedule, words",
    [
        ({"u7": 3}, "no signal 'u7'; there are"),
        ({"u1": "three"}, "'three'"),
        ({"u1": 0}, "at least 1"),
        ({"u1": True}, "at least 1"),
        ({"u1": (0.5,)}, "one knot"),
        ({"u1": ["a"]}, "no numbers"),
        ({"u1": 40}, "give fewer"),
        ({"u1": (0, 1), "u2": (0, 1), "x1": (0, 1)}, "3 scheduling signals"),
        (7, "schedule is int"),
        (Schedule((Axis("speed", knots=(0.0, 1.0)),)), "speed"),
        ({"u1": (1, -1)}, r"knots of 'u1' must increase, and are \[1.0, -1.0\]"),
        ({"u3": 3}, "'u3' is constant"),
        ({"u2": Modes([-1, 1])}, "drawn 2: 'u2' is 2 at t = .* a mode that the schedule does not list"),
    ],
)
def test_schedules_that_make_no_sense_are_refused(schedule, words):
    """Of a control in units of its own, and a second one whose modes are -1, 1, 2; a third stands still."""
    run = drawn(SCHEDULES["modes"], 300, 2)
    run = Transient(run.t_ns, run.x, np.column_stack([run.u, np.ones(301)]), name=run.name)
    point = OperatingPoint(np.zeros(2), np.array([0.5, 0.0, 0.0]), np.ones(2), np.array([2.0, 1.0, 1.0]))
    refuses(FitError, words, fit, run, schedule=schedule, operating_point=point)


def test_one_knot_is_one_block_and_no_schedule():
    transient = drawn(THREE, 300, 1)
    further = Transient(transient.t_ns, transient.x, transient.u, s=np.linspace(0, 1, len(transient))[:, None])
    one = fit(transient)
    for model in (fit(transient, schedule={"u1": 1}), fit(further, schedule={"s1": 1})):
        assert model.schedule is None and not model.signals.scheduling
        assert (model.A == one.A).all() and (model.dA == one.dA).all()


def test_the_signals_file_schedules_a_fit():
    from dataclasses import replace

    from uncertain_lti.signals.signal_map import ScheduleRule

    transient = drawn(THREE, 400, 14, noise=1e-3)
    signals = SignalMap(*(tuple(Signal(name, "", name) for name in names) for names in (NAMES[:2], NAMES[2:])))
    rules = (ScheduleRule("u1", (-1.0, 0.0, 1.0)),)
    told = Transient(transient.t_ns, transient.x, transient.u, signals=replace(signals, schedule=rules))
    model, expected = fit(told, additive="both"), fit(transient, additive="both", schedule=THREE)
    assert model.schedule == THREE and (model.A == expected.A).all()
    assert fit(told, additive="both", schedule={"u1": 1}).schedule is None


def test_without_additive_term_a_recording_at_rest_is_contained():
    """At rest nothing but the noise would contain the rounding of a drift."""
    t = np.arange(600) * 0.01
    u = np.where((t > 2.0) & (t < 4.0), 1.0, 0.0)[:, None]
    x = np.zeros((600, 1))
    for k in range(599):
        x[k + 1] = x[k] + 0.01 * (-(2.0 + x[k] ** 2) * x[k] + u[k])
    model = fit(Transient(t, x, u), "qp", additive="none", schedule={"x1": [-0.1, 0.1, 0.3, 0.5]})
    assert (model.c == 0.0).all() and model.fit_summary["violations"] == 0
    assert model.fit_summary["mean_width"][0] < 0.3 * fit(Transient(t, x, u)).fit_summary["mean_width"][0]


def test_knots_that_the_fit_places_keep_their_distance():
    """A signal that mostly rests, with noise, has most of its quantiles within that noise."""
    rng = np.random.default_rng(4)
    t = np.arange(3000) * 0.01
    u = np.where(np.abs(t - 20.0) < 5.0, np.sin(3.0 * t), 0.0)[:, None]
    x = np.zeros((3000, 1))
    for k in range(2999):
        x[k + 1] = x[k] + 0.01 * (-(2.0 + 8.0 * np.tanh(4.0 * x[k]) ** 2) * x[k] + 2.0 * u[k])
    recorded = x + rng.normal(0, 1e-4, x.shape)
    model = fit(Transient(t, recorded, u), additive="noise", schedule={"x1": 5})
    knots = np.array(model.schedule.axes[0].knots)
    assert np.diff(knots).min() >= 0.24 * np.ptp(knots) / 4
