# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Identification: exact, contained, and honest about the data."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refuses

import uncertain_lti
from uncertain_lti import OperatingPoint, Transient, UncertainLTI
from uncertain_lti.base import arrays
from uncertain_lti.base.errors import FitError, ModelError, TransientError
from uncertain_lti.identification import fit, passes, programmes, solvers, working_set
from uncertain_lti.identification.assembly import assemble
from uncertain_lti.identification.problem import Columns, Problem, Regimes, solve_as_written
from uncertain_lti.identification.structure import Structure
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.model.schedule import Axis, Schedule
from uncertain_lti.plants.leibov import leibov2006

ADDITIVE = ("none", "disturbance", "noise", "both")
CLARABEL = dict(tol_gap_abs=1e-12, tol_gap_rel=1e-12, tol_feas=1e-12)


def drawn(model, N, seed, noise=0.0, dt=0.025, jitter=0.0, rest=20):
    """A transient of a plant whose elements are drawn anew inside their intervals at every step."""
    rng = np.random.default_rng(seed)
    n, m = model.n, model.m
    u = np.repeat(rng.uniform(-1, 1, (N // 15 + 1, m)), 15, axis=0)[: N + 1]
    u[N // 2 : N // 2 + rest] = 0.0
    t_ns = np.concatenate([[0], np.cumsum(np.rint(dt * 1e9 * (1 + jitter * rng.uniform(-1, 1, N))).astype(np.int64))])
    x = np.zeros((N + 1, n))
    for k in range(N):
        A = model.A + model.dA * rng.uniform(-1, 1, (n, n))
        B = model.B + model.dB * rng.uniform(-1, 1, (n, m))
        x[k + 1] = x[k] + (t_ns[k + 1] - t_ns[k]) * 1e-9 * (A @ x[k] + B @ u[k])
    return Transient(t_ns, x + noise * rng.standard_normal(x.shape), u, name=f"drawn {seed}")


def small_plant(seed, n=2, m=1):
    rng = np.random.default_rng(seed)
    A = -np.diag(rng.uniform(1, 8, n)) + rng.uniform(-1, 1, (n, n))
    B, dA = rng.uniform(-3, 3, (n, m)), rng.uniform(0, 1, (n, n)) * (rng.random((n, n)) < 0.7)
    return UncertainLTI(A, B, dA, rng.uniform(0, 1, (n, m)))


def objective(model):
    return np.asarray(model.fit_summary["objective"])


def count_outside(model, transients):
    """Transition by transition with `bounds`, independent of the vectorised path of the fit."""
    outside = 0
    for transient in transients:
        x = model.operating_point.normalise_x(transient.x)
        u = model.operating_point.normalise_u(transient.u)
        for k in np.flatnonzero(transient.usable):
            lower, upper = model.bounds(x[k], u[k], transient.dt[k])
            outside += int((~((lower <= x[k + 1]) & (x[k + 1] <= upper))).sum())
    return outside


def widths(model, transient):
    s = transient.transitions()
    lower, upper = model.bounds(model.operating_point.normalise_x(s.x), model.operating_point.normalise_u(s.u), s.dt)
    return upper - lower


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(1, 4),
    m=st.integers(0, 3),
    criterion=st.sampled_from(["qp", "lp"]),
    additive=st.sampled_from(ADDITIVE),
    noise=st.sampled_from([0.0, 1e-6, 1e-2]),
    scale=st.sampled_from([1e-6, 1.0, 1e6]),
    offset=st.sampled_from([0.0, 1e3]),
)
def test_nothing_is_left_outside_whatever_the_data(seed, n, m, criterion, additive, noise, scale, offset):
    raw = drawn(small_plant(seed, n, max(m, 1)), 120, seed, noise, jitter=0.5, rest=0)
    transient = Transient(raw.t_ns, raw.x * scale + offset, raw.u[:, :m])
    point = OperatingPoint(np.full(n, offset), np.zeros(m), np.full(n, scale), np.ones(m))
    try:
        model = fit(transient, criterion, additive=additive, operating_point=point)
    except FitError as error:  # a first sample at rest has no envelope without an additive term
        assert additive == "none" and "at rest" in str(error)
        return
    assert count_outside(model, [transient]) == 0 == model.fit_summary["violations"]


CASES = [("none", "full"), ("disturbance", "ones"), ("noise", "per sample"), ("both", "per state")]


@pytest.mark.parametrize("criterion", ["qp", "lp"])
@pytest.mark.parametrize(("additive", "kind"), CASES)
def test_objective_is_that_of_the_problem_as_written(criterion, additive, kind):
    n = 3
    transient = drawn(small_plant(5, n, 2), 300, 5, noise=0.0 if additive == "none" else 1e-3, jitter=0.4)
    rng = np.random.default_rng(0)
    root = rng.standard_normal((300, n, n))
    weights = {
        "ones": None,
        "per state": np.array([1.0, 0.01, 30.0]),
        "per sample": rng.uniform(0.1, 10, (300, n)),
        "full": root @ root.transpose(0, 2, 1) + 0.1 * np.eye(n),
    }[kind]
    model = fit(transient, criterion, weights, additive)
    problem = assemble([transient], OperatingPoint.identity(n, 2), weights, additive)
    _, _, expected = solve_as_written(problem, criterion, "CLARABEL", **CLARABEL)
    assert np.atleast_1d(objective(model)) == pytest.approx(expected, rel=1e-6)
    assert model.fit_summary["optimality_gap"] < 1e-7
    # and the number stored is that of the bounds themselves
    width = widths(model, transient)
    W = np.ones(n) if weights is None else weights
    if criterion == "qp":
        stored = np.einsum("ki,kij,kj->", width, W, width) if kind == "full" else np.sum(W * width**2)
    else:
        diagonal = np.diagonal(W, axis1=1, axis2=2) if kind == "full" else W
        stored = np.max(np.sqrt(diagonal) * width, axis=0)
    assert objective(model) == pytest.approx(stored, rel=1e-9)


@pytest.mark.parametrize("criterion", ["qp", "lp"])
@pytest.mark.parametrize(("held", "many"), [(working_set._HELD_BYTES, solvers.MANY), (1, 1)])
def test_large_problem_reaches_the_same_optimum(criterion, held, many, monkeypatch):
    """Beyond the first subsample, where full passes have to correct it; rows proven together, or in groups of two.

    With many unknowns an interior point begins, and a pass finds the transitions that are far from least squares.
    """
    monkeypatch.setattr(working_set, "SUBSAMPLE", 1000)
    monkeypatch.setattr(working_set, "_FURTHEST", 400)
    monkeypatch.setattr(working_set, "_MANY", many)
    monkeypatch.setattr(solvers, "MANY", many)
    monkeypatch.setattr(solvers, "VERY_MANY", many)
    monkeypatch.setattr(working_set, "_HELD_BYTES", held)
    transient = drawn(small_plant(8, n=3), 3000, 8, noise=1e-3)
    model = fit(transient, criterion, additive="noise")
    problem = assemble([transient], OperatingPoint.identity(3, 1), None, "noise")
    _, _, expected = solve_as_written(problem, criterion, "CLARABEL" if criterion == "qp" else "HIGHS")
    assert np.atleast_1d(objective(model)) == pytest.approx(expected, rel=1e-6)
    assert model.fit_summary["optimality_gap"] < 1e-6 and count_outside(model, [transient]) == 0


def test_a_row_without_a_proof_by_multipliers_is_proven_by_the_simplex_method(monkeypatch):
    """And by that alone: it is not solved a third time, in refined coordinates."""
    refined = []
    monkeypatch.setattr(working_set, "SUBSAMPLE", 1000)
    monkeypatch.setattr(solvers, "linear_bound", lambda *_: (-np.inf, np.empty(0)))
    monkeypatch.setattr(programmes.Programmes, "refine", refined.append)
    model = fit(drawn(small_plant(8), 3000, 8, noise=1e-3), "lp", additive="noise")
    assert not refined and 0.0 <= model.fit_summary["optimality_gap"] < 1e-7


@pytest.mark.parametrize("criterion", ["qp", "lp"])
def test_both_methods_agree_and_contain(criterion):
    transient = drawn(small_plant(11), 200, 11)
    model = fit(transient, criterion, method="cvxpy")
    assert count_outside(model, [transient]) == 0
    other = fit(transient, criterion)
    # OSQP stops at its tolerance, and the repair pays for what it left outside
    assert objective(model) == pytest.approx(objective(other), rel=1e-4)


def test_ties_of_the_linear_programme_are_broken_as_stated():
    """Least sum of squared widths among the optima, then least squared distance of the centre."""
    import cvxpy as cp

    transient = drawn(small_plant(21), 150, 21)
    s = transient.transitions()
    z = np.hstack([s.x, s.u])
    model = fit(transient, "lp")
    rows, half = np.hstack([model.A, model.B]), np.hstack([model.dA, model.dB])
    for i in range(2):
        theta, d = cp.Variable(3), cp.Variable(3, nonneg=True)
        increment = (s.x_next - s.x)[:, i]
        centre, h = 0.025 * z @ theta, 0.025 * np.abs(z) @ d
        contained = [centre - h <= increment, increment <= centre + h]
        first = cp.Problem(cp.Minimize(cp.max(2 * h)), contained)
        first.solve("CLARABEL", **CLARABEL)
        bounded = [*contained, 2 * h <= first.value * (1 + 1e-9)]
        second = cp.Problem(cp.Minimize(cp.sum_squares(2 * h)), bounded)
        second.solve("CLARABEL", **CLARABEL)
        assert np.sum((2 * 0.025 * np.abs(z) @ half[i]) ** 2) == pytest.approx(second.value, rel=1e-4)
        room = [*bounded, cp.sum_squares(2 * h) <= second.value * (1 + 1e-7)]
        third = cp.Problem(cp.Minimize(cp.sum_squares(increment - centre)), room)
        third.solve("CLARABEL")
        ours = np.sum((increment - 0.025 * z @ rows[i]) ** 2)
        assert ours == pytest.approx(third.value, rel=2e-3)


def test_centre_of_the_quadratic_programme_is_the_closest_one():
    """Where many centres are optimal (few samples bind), the one of least squared distance is taken."""
    import cvxpy as cp

    rng = np.random.default_rng(2)
    x = np.zeros((41, 1))
    u = rng.uniform(-1, 1, (41, 1)) * 1e-3  # u hardly matters against one dominating disturbed sample
    for k in range(40):
        x[k + 1] = 0.9 * x[k] + u[k] + (1.0 if k == 5 else 0.0)
    transient = Transient(np.arange(41) * 0.1, x, u)
    model = fit(transient, "qp", additive="noise")
    s = transient.transitions()
    z, v, increment = np.hstack([s.x, s.u]), float(model.v[0]), (s.x_next - s.x)[:, 0]
    h = 0.1 * np.abs(z) @ np.concatenate([model.dA[0], model.dB[0]]) + v
    theta = cp.Variable(2)
    left = increment - 0.1 * z @ theta
    best = cp.Problem(cp.Minimize(cp.sum_squares(left)), [cp.abs(left) <= h * (1 + 1e-9)])
    best.solve("CLARABEL", **CLARABEL)
    ours = np.sum((increment - 0.1 * z @ np.concatenate([model.A[0], model.B[0]])) ** 2)
    assert ours == pytest.approx(best.value, rel=1e-4)


def test_recordings_are_not_joined():
    """The step from the end of one recording to the start of the next is no transition."""
    plant = small_plant(31)
    parts = [drawn(plant, 150, seed) for seed in (1, 2, 3)]
    parts[1] = Transient(parts[1].t_ns + 10**12, parts[1].x, parts[1].u)
    model = fit(parts)
    assert model.fit_summary["transitions"] == sum(int(p.usable.sum()) for p in parts) == 450
    shifted = [Transient(p.t_ns + 7 * i, p.x, p.u) for i, p in enumerate(parts)]
    assert fit(shifted).A == pytest.approx(model.A)


def test_operating_point_only_changes_units():
    """Scaling a signal scales its row and column, nothing else."""
    transient = drawn(small_plant(41), 300, 41, noise=1e-3)
    X, U = np.array([200.0, 0.01]), np.array([5.0])
    scaled = Transient(transient.t_ns, transient.x * X + 3.0, transient.u * U - 1.0)
    point = OperatingPoint(np.full(2, 3.0), np.full(1, -1.0), X, U)
    for criterion in ("qp", "lp"):
        plain = fit(transient, criterion, additive="noise")
        same = fit(scaled, criterion, additive="noise", operating_point=point)
        assert same.A == pytest.approx(plain.A, rel=1e-4, abs=1e-4)
        assert objective(same) == pytest.approx(objective(plain), rel=1e-6)
        assert same.fit_summary["mean_width_recorded"] == pytest.approx(plain.fit_summary["mean_width"] * X, rel=1e-4)


def test_exact_linear_data_gives_the_matrices_and_next_to_no_width():
    plant = UncertainLTI([[-1.0, 0.5], [0.2, -3.0]], [[1.0], [2.0]], np.zeros((2, 2)), np.zeros((2, 1)))
    transient = drawn(plant, 200, 0)
    for criterion in ("qp", "lp"):
        model = fit(transient, criterion)
        assert count_outside(model, [transient]) == 0
        assert model.A == pytest.approx(plant.A, abs=1e-8)
        assert model.B == pytest.approx(plant.B, abs=1e-8)
        assert (model.fit_summary["max_width"] < 1e-9).all()


def test_domain_and_steps_are_those_of_the_data():
    transient = drawn(small_plant(51), 100, 51, jitter=0.5)
    model = fit(transient)
    s = transient.transitions()
    assert np.array_equal(model.domain.x_min, s.x.min(axis=0)) and np.array_equal(model.domain.u_max, s.u.max(axis=0))
    sampling = model.sampling
    assert (sampling.dt_min, sampling.dt_max, sampling.dt_median) == (s.dt.min(), s.dt.max(), np.median(s.dt))
    assert not model.domain.outside(s.x, s.u).any()


# --- what the user is told ---


def test_too_few_transitions():
    t = drawn(small_plant(1, 3, 2), 9, 1)
    refuses(FitError, "9 usable transitions for 10 unknowns per row", fit, t)
    refuses(FitError, "9 usable transitions for 12 unknowns per row", fit, t, additive="disturbance")
    words = "which leaves 6 transitions for 7 unknowns per row; discard 1 at most"
    refuses(FitError, words, fit, drawn(small_plant(1), 8, 1), additive="noise", discard=2)


def test_rest_with_a_moving_successor_names_sample_and_remedy():
    transient = drawn(small_plant(1), 100, 1, rest=0)
    x, u = transient.x.copy(), transient.u.copy()
    x[40], u[40], x[60], u[60] = 0.0, 0.0, 0.0, 0.0
    transient = Transient(transient.t_ns, x, u, name="run.mcap", state_names=["speed", "flow"])
    assert "1 other" in refuses(FitError, r"sample 40 of run\.mcap .*'speed'.*--additive noise", fit, transient)
    for additive in ADDITIVE[1:]:
        assert count_outside(fit(transient, additive=additive), [transient]) == 0


@pytest.mark.parametrize(
    ("factors", "more", "rank", "words"),
    [
        ([1.0, 0.0], 0.0, 3, "'steering' never moved in what was fitted, so what a move"),
        ([1.0, 0.0], 0.7, 4, "'steering' never moved in what was fitted"),
        ([1.0, 0.0, 0.0], 0.0, 3, "'steering' and 'brake' never moved in what was fitted"),
        (None, 0.0, 3, "'throttle' and 'steering' move together in every transition"),
    ],
)
def test_inputs_that_say_nothing_or_the_same_are_named_in_one_message(factors, more, rank, words):
    raw = drawn(small_plant(1, 2, len(factors or [1, 1])), 200, 1, rest=0)
    u = raw.u[:, [0, 0]] * [1.0, -2.0] if factors is None else raw.u * factors + [0.0, more, 0.0][: len(factors)]
    moved = Transient(raw.t_ns, raw.x, u, control_names=["throttle", "steering", "brake"][: u.shape[1]])
    model = fit(moved, additive="disturbance" if more else "noise")
    told = [m for m in model.fit_summary["messages"] if "in every transition" in m or "never moved" in m]
    assert words in told[-1] and len(told) == 1 and count_outside(model, [moved]) == 0
    assert model.fit_summary["rank"] == rank
    still = ~u.any(axis=0)
    assert not model.B[:, still].any() and not model.dB[:, still].any()


def test_a_fit_does_not_end_for_what_is_said_of_it(monkeypatch):
    """Of exact data of a simulator no solver finds which samples carry the width; the fit itself is done by then."""

    def gives_up(*_):
        raise FitError("no solver could solve the quadratic programme")

    raw = drawn(small_plant(1, 2, 2), 400, 1, rest=0)
    monkeypatch.setattr("uncertain_lti.identification.discard._solve", gives_up)
    assert count_outside(fit(raw, additive="noise", seek_carriers=True), [raw]) == 0


def test_unstable_nominal_model_is_said():
    plant = UncertainLTI([[2.0]], [[1.0]], [[0.3]], [[0.1]])
    model = fit(drawn(plant, 60, 0, rest=0))
    assert any("unstable" in message for message in model.fit_summary["messages"])


def test_constant_step_gives_the_width_to_noise_and_says_so():
    transient = drawn(small_plant(3), 200, 3, noise=1e-3)
    model = fit(transient, additive="both")
    assert (model.dc == 0).all() and (model.v > 0).any() and (model.c != 0).any()
    assert any("v takes the width" in message for message in model.fit_summary["messages"])
    jittered = fit(drawn(small_plant(3), 200, 3, noise=1e-3, jitter=0.5), additive="both")
    assert not any("v takes the width" in message for message in jittered.fit_summary["messages"])


def test_wrong_options_are_refused():
    transient = drawn(small_plant(1), 50, 1)
    cases = [
        (dict(criterion="lq"), "criterion is 'lq'"),
        (dict(criterion=["qp"]), r"criterion is \['qp'\]; it must be qp or lp"),
        (dict(additive=["none"]), r"additive is \['none'\]; it must be"),
        (dict(additive="white"), "additive is 'white'"),
        (dict(method="magic"), "method is 'magic'"),
        (dict(weights=np.ones(3)), r"weights have shape \(3,\)"),
        (dict(weights=np.array([1.0, 0.0])), "must be positive"),
        (dict(weights=np.array([1.0, np.nan])), "not finite"),
        (dict(weights=np.tile([[1.0, 2.0], [2.0, 1.0]], (50, 1, 1))), "not positive definite"),
        (dict(weights=np.tile([[1.0, 0.5], [0.0, 1.0]], (50, 1, 1))), "not symmetric"),
        (dict(weights=[np.ones((49, 2))]), r"must be \(50, 2\)"),
        (dict(weights=np.array([1.0, 1j])), "not arrays of real numbers"),
        (dict(operating_point=OperatingPoint.identity(3, 1)), "3 states"),
        (dict(operating_point=(0.0, 0.0, 1.0, 1.0)), "OperatingPoint is of type tuple; give one"),
        (dict(structure={"a": 0.0}), "Structure is of type dict; give one"),
        *((dict(additive="noise", discard=budget), "discard is") for budget in (-1, 1.5, np.nan, True, "1", None)),
    ]
    for options, words in cases:
        refuses(FitError, words, fit, transient, **options)
    refuses(FitError, "no transients", fit, [])
    refuses(FitError, "false_alarms is '1'; give a positive number", uncertain_lti.fit, transient, false_alarms="1")
    refuses(ModelError, "alarm is of type AlarmRule; give a list", uncertain_lti.fit, transient, alarm=AlarmRule())
    other = Transient(transient.t_ns, transient.x, transient.u, state_names=["a", "b"])
    refuses(FitError, "read all recordings with one signals file", fit, [transient, other])
    fewer = Transient(transient.t_ns, transient.x[:, :1], transient.u)
    refuses(FitError, "read all recordings with one signals file", uncertain_lti.fit, [transient, fewer])


@pytest.mark.parametrize("size", [1e-60, 1e-158, 1e-200])
@pytest.mark.parametrize("criterion", ["qp", "lp"])
def test_what_is_too_small_for_the_arithmetic_is_named(size, criterion):
    whole = drawn(small_plant(2), 50, 2)
    tiny = Transient(whole.t_ns, whole.x * [size, 1.0], whole.u)
    for options in ({}, {"discard": 2}):
        with pytest.raises(FitError, match="'x1' never exceeds .* over its scale, .* give it a smaller scale"):
            fit(tiny, criterion, additive="noise", **options)
    fit(Transient(whole.t_ns, whole.x * [1e-40, 1.0], whole.u), criterion, additive="noise")


def test_infinite_and_complex_numbers_are_refused():
    for wrong in ({"fixed": {"A": np.full((2, 2), np.inf)}}, {"upper": {"A": np.full((2, 2), -np.inf)}}):
        refuses(FitError, "A is to be infinite; give finite numbers, NaN for a free element", Structure, 2, 1, **wrong)
    refuses(FitError, "A is not numeric; give real", Structure, 2, 1, fixed={"A": np.full((2, 2), 1j)})
    with pytest.raises(TransientError, match="x is not numeric; give real numbers"):
        Transient(np.arange(3.0), np.full((3, 2), 1j), np.zeros((3, 1)))
    with pytest.raises(ModelError, match="field 'A' is not an array of numbers"):
        UncertainLTI(np.eye(2) * 1j, np.eye(2, 1), np.eye(2), np.eye(2, 1))


def test_nothing_usable_is_said():
    t, some, none = np.arange(20) * 0.1, np.zeros((20, 1)), np.full((20, 1), np.nan)
    every_other = np.where(np.arange(20)[:, None] % 2, np.nan, 0.0)
    for x, u, max_gap, words in (
        (none, some, 1.0, "among 20 samples; x1 has no value in any of them .* check its field"),
        (none, none, 1.0, "x1, u1 have no value in any of them"),
        (every_other, some, 1.0, "no two in a row have every signal; there is a value of x1 in 10 of them"),
        (np.where(np.arange(20)[:, None], some, np.nan), some, 0.01, "no two in a row are at most max_gap"),
        (some, some, 0.01, "no two in a row are at most max_gap and at least min_step apart"),
    ):
        refuses(FitError, words, fit, Transient(t, x, u, max_gap=max_gap, name="silent.mcap"))
    refuses(FitError, "time steps back before 19 more, .* in the order of", fit, Transient(t[::-1], some, some))


def on_the_bounds(model, z, dt, rng, weights, columns):
    """Transitions inside, on and one ulp beyond the bounds of a model."""
    centre, half = model.columns_centre_and_half(z, dt)
    x_next = centre + half * rng.uniform(-1, 1, centre.shape)
    edge = rng.integers(0, len(dt), 20)
    x_next[:, edge] = centre[:, edge] + half[:, edge] * rng.choice([-1, 1], size=20)
    x_next[:, edge[:10]] = np.nextafter(x_next[:, edge[:10]], rng.choice([-np.inf, np.inf]))
    nothing = np.zeros(len(dt), dtype=np.intp)
    return Problem(z, x_next, dt, weights, source=nothing, k=nothing, columns=columns)


def judged_sample(seed):
    """A model and transitions about its bounds, in sizes from 1e-6 to 1e6."""
    rng = np.random.default_rng(seed)
    n, m, N = rng.integers(1, 6), rng.integers(0, 5), int(rng.integers(300, 6000))
    A = rng.normal(size=(n, n + m)) * 10.0 ** rng.integers(-3, 3)
    D = np.abs(rng.normal(size=(n, n + m))) * rng.choice([0, 1e-17, 1e-3, 1.0], size=(n, 1))
    c, dc, v = rng.normal(size=(3, n)) * rng.choice([0, 1], size=(3, 1))
    model = UncertainLTI(A[:, :n], A[:, n:], D[:, :n], D[:, n:], c=c, dc=np.abs(dc), v=np.abs(v))
    z = rng.normal(size=(n + m, N)) * rng.choice([1e-6, 1.0, 1e6], size=(n + m, 1))
    dt = np.full(N, 0.01) if seed % 2 else rng.uniform(0.005, 0.02, N)
    return model, on_the_bounds(model, z, dt, rng, rng.uniform(0.5, 2, n), Columns())


def scheduled_sample(seed):
    """As `judged_sample`, of a scheduled model: knots of one or two signals, or modes."""
    rng = np.random.default_rng(seed)
    n, m, N = int(rng.integers(2, 5)), int(rng.integers(1, 4)), int(rng.integers(300, 4000))
    axes = [Axis("x1", knots=(-1.0, 0.1, 0.5, 1.0)), Axis("u1", knots=(-0.5, 0.5)), Axis("u1", modes=(0.0, 2.0))]
    schedule = Schedule(((axes[0],), (axes[0], axes[1]), (axes[2],), (axes[0], axes[2]))[seed % 4])
    R = schedule.blocks
    arrays = [rng.normal(size=(R, n, n)), rng.normal(size=(R, n, m))]
    arrays += [np.abs(a) * rng.choice([0, 1e-3, 1.0]) for a in arrays]
    c, dc, v = rng.normal(size=(3, R, n)) * rng.choice([0, 1], size=(3, 1, 1))
    model = UncertainLTI(*arrays, c=c, dc=np.abs(dc), v=np.abs(v), schedule=schedule)
    z = rng.normal(size=(n + m, N))
    if seed % 4 > 1:
        z[n] = rng.choice([0.0, 2.0], size=N)
    dt = np.full(N, 0.01) if seed % 3 else rng.uniform(0.005, 0.02, N)
    names = [*(f"x{i + 1}" for i in range(n)), *(f"u{j + 1}" for j in range(m))]
    regimes = Regimes(schedule, schedule.positions(names))
    columns = Columns.of("both", bool(seed % 3), regimes)
    weights = rng.uniform(0.5, 2, n) if seed % 5 else rng.uniform(0.5, 2, (N, n))
    return model, on_the_bounds(model, z, dt, rng, weights, columns)


def by_bounds(model, problem):
    """Transitions outside, the largest width and the largest √w x width of each state, by the model's own bounds."""
    centre, half = model.columns_centre_and_half(problem.z, problem.dt)
    inside = (centre - half <= problem.x_next) & (problem.x_next <= centre + half)
    weighted = 2 * half * np.sqrt(problem.row_weights().T)
    return (~inside).sum(axis=1), 2 * half.max(axis=1), weighted.max(axis=1)


@pytest.mark.parametrize("sample", [judged_sample, scheduled_sample])
def test_a_fit_judges_every_transition_as_the_bounds_do(sample):
    """To the bit: on the bounds it is inside, an ulp beyond outside."""
    outside = 0
    for seed in range(30):
        model, problem = sample(seed)
        total, expected = passes.judge(problem, model), by_bounds(model, problem)
        assert total.outside.tolist() == expected[0].tolist()
        assert total.largest.tobytes() == expected[1].tobytes()
        assert total.weighted == pytest.approx(expected[2], rel=1e-15)
        outside += int(total.outside.sum())
    assert outside > 250


def test_a_fit_does_not_depend_on_the_number_of_threads(monkeypatch):
    transient = drawn(leibov2006(), 40_001, 3, noise=1e-3)
    several = fit(transient, "qp", additive="noise", describe_data=False)
    monkeypatch.setattr(arrays, "core_count", lambda: 1)
    assert fit(transient, "qp", additive="noise", describe_data=False).to_dict() == several.to_dict()


@pytest.mark.parametrize("seed", range(8))
def test_an_interior_point_and_equations_end_where_the_active_set_method_does(seed):
    rng = np.random.default_rng(seed)
    size = 20
    M, G = rng.standard_normal((size, size)), rng.standard_normal((60, size))
    h = G @ rng.uniform(0.1, 0.5, size) - rng.exponential(2.0, 60)
    lower, upper = np.where(rng.random(size) < 0.6, 0.0, -np.inf), np.where(rng.random(size) < 0.6, 0.6, np.inf)
    of = solvers.Programme(M @ M.T / size + 1e-6 * np.eye(size), 3.0 * rng.standard_normal(size), G, h, lower, upper)
    expected = solvers.solve_qp(of)
    assert {1, 3} <= set(expected.active[:size].tolist()) and expected.active[size:].any()
    known = solvers.solve_qp(of, expected.active, equations=True)
    assert known.solver == "PIQP" and known.xi == pytest.approx(expected.xi, abs=1e-9)
    for wrong in np.flatnonzero(expected.active):  # too few, or too many
        without, more = expected.active.copy(), expected.active.copy()
        without[wrong], more[size + rng.choice(np.flatnonzero(more[size:] == 0))] = 0, 3
        for start in (without, more):
            assert solvers.solve_qp(of, start, equations=True).xi == pytest.approx(expected.xi, abs=1e-9)
    far = of._replace(h=h - 100.0)  # bounds alone are active
    at_bounds = solvers.solve_qp(far)
    for wrong in np.flatnonzero(at_bounds.active):
        start = np.where(np.arange(size + len(h)) == wrong, np.int32(0), at_bounds.active)
        assert solvers.solve_qp(far, start, equations=True).xi == pytest.approx(at_bounds.xi, abs=1e-9)
    begin = rng.standard_normal(size)
    assert solvers.solve_near(of, begin, like=of[:2], accurate=True).xi == pytest.approx(expected.xi, abs=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_the_dual_bound_is_below_every_feasible_value_and_meets_the_optimum(seed):
    rng = np.random.default_rng(seed)
    M, G = rng.standard_normal((6, 6)), rng.standard_normal((40, 6))
    H, f, h = M @ M.T + 1e-3 * np.eye(6), rng.standard_normal(6), G @ rng.uniform(0, 1, 6) - rng.uniform(0, 1, 40)
    programme = solvers.Programme(H, f, G, h, np.full(6, -5.0), np.full(6, 5.0))
    answer = solvers.solve_qp(programme)
    best = 0.5 * answer.xi @ H @ answer.xi + f @ answer.xi
    assert solvers.dual_bound(programme, answer.xi) == pytest.approx(best, rel=1e-9, abs=1e-9)
    for _ in range(20):  # a bound wherever it is taken
        anywhere = answer.xi + 0.1 * rng.standard_normal(6)
        assert solvers.dual_bound(programme, anywhere) <= best + 1e-9


def test_transients_weigh_as_the_user_says():
    """Counting a transient twice, or weighing it twice, is the same; short ones may count as much as long ones."""
    plant = small_plant(65)
    one, two = drawn(plant, 100, 1, noise=1e-3), drawn(plant, 300, 2, noise=1e-3)
    twice = fit([one, two, Transient(two.t_ns, two.x, two.u)], additive="noise")
    weighed = fit([one, two], additive="noise", transient_weights=[1.0, 2.0])
    assert weighed.fit_summary["objective"] == pytest.approx(twice.fit_summary["objective"], rel=1e-8)
    assert weighed.dA == pytest.approx(twice.dA, rel=1e-4, abs=1e-6)
    as_said = fit([one, two], additive="noise", weights=[np.full((100, 2), 2.0), np.full((300, 2), 2 / 3)])
    fair = fit([one, two], additive="noise", count="transient")
    assert fair.fit_summary["objective"] == pytest.approx(as_said.fit_summary["objective"], rel=1e-8)
    assert count_outside(fair, [one, two]) == 0
    for options in (dict(count="run"), dict(transient_weights=[1.0]), dict(transient_weights=[1.0, -1.0])):
        refuses(FitError, r"count is|2 positive numbers", fit, [one, two], **options)


# --- structure ---


def with_structure(transient, additive="none", criterion="qp", **given):
    n, m = transient.x.shape[1], transient.u.shape[1]
    return fit(transient, criterion, additive=additive, structure=Structure(n, m, **given))


def test_known_kinematics_leave_only_the_noise():
    """position' = velocity exactly: the row is given, the rest is fitted; measured with noise it needs v."""
    rng = np.random.default_rng(0)
    dt, count = 0.01, 400
    u = np.repeat(rng.uniform(-1, 1, (count // 20 + 1, 1)), 20, axis=0)[: count + 1]
    x = np.zeros((count + 1, 2))
    for k in range(count):
        x[k + 1] = x[k] + dt * np.array([x[k, 1], -2 * x[k, 1] + (3 + 0.5 * rng.uniform(-1, 1)) * u[k, 0]])
    rows = {"A": [[0.0, 1.0], [np.nan, np.nan]], "B": [[0.0], [np.nan]], "dA": [[0.0, 0.0], [np.nan, np.nan]]}
    rows["dB"] = [[0.0], [np.nan]]
    exact = Transient(np.arange(count + 1) * dt, x, u, state_names=["position", "velocity"])
    model = with_structure(exact, fixed=rows)
    assert count_outside(model, [exact]) == 0
    assert model.A[0].tolist() == [0.0, 1.0] and model.fit_summary["max_width"][0] < 1e-12
    noisy = Transient(exact.t_ns, x + 1e-4 * rng.standard_normal(x.shape), u, state_names=["position", "velocity"])
    for criterion in ("qp", "lp"):
        with pytest.raises(FitError, match="'position' cannot contain the step from sample .* additive"):
            with_structure(noisy, criterion=criterion, fixed=rows)
        with pytest.raises(FitError, match="'position' cannot contain the step from sample"):
            fit(noisy, criterion, structure=Structure(2, 1, fixed=rows), discard=3)
        model = with_structure(noisy, "noise", criterion, fixed=rows)
        assert count_outside(model, [noisy]) == 0 and 1e-4 < model.v[0] < 1e-3


def test_half_widths_that_the_largest_width_leaves_open_are_the_least():
    """One sample alone is as wide as the largest width where A is known: the others are no wider than they need be."""
    x = np.ones((201, 1))
    for k in range(200):  # disturbed in proportion to x
        x[k + 1] = x[k] * (1.1 if x[k] < 0.5 else 0.9)
    model = with_structure(Transient(np.arange(201) * 0.1, x, np.empty((201, 0))), "noise", "lp", fixed={"A": [[0.0]]})
    assert model.dA == pytest.approx(1.0, rel=1e-4) and model.v < 1e-5


def test_contradictions_of_a_structure_are_named():
    transient = drawn(small_plant(1), 50, 1)
    nan = np.nan
    cases = [
        (dict(fixed={"dA": [[-1.0, nan], [nan, nan]]}), r"dA\[0, 0\] is a half-width"),
        (dict(lower={"A": [[2.0, nan], [nan, nan]]}, upper={"A": [[1.0, nan], [nan, nan]]}), r"A\[0, 0\] is to be"),
        (dict(fixed={"E": [[0.0]]}), "there is no 'E'"),
        (dict(fixed={"A": [[0.0]]}), r"A has shape \(1, 1\)"),
        (dict(fixed={"c": [1.0, nan]}), "c is not 0, and the fit has no such term"),
        (dict(upper={"dA": np.zeros((2, 2)), "dB": np.zeros((2, 1))}), "cannot contain the step from sample"),
    ]
    for elements, words in cases:
        refuses(FitError, words, with_structure, transient, **elements)


def test_structure_rules_of_a_signals_file():
    names = (["p", "v"], ["f"])
    structure = Structure.from_rules(
        [
            {"state": "p", "from": "*", "nominal": 0, "half_width": 0},
            {"state": "p", "from": "v", "nominal": 1},
            {"state": "v", "from": "f", "nominal": {"min": "0.0e0"}, "half_width": {"max": 2.5}},  # YAML 1.1: text
            {"state": "*", "from": "noise", "half_width": 0.1},
            {"state": "p", "from": "disturbance", "nominal": 0.5},
            {"state": "v", "from": "drift", "nominal": 0.25},  # the older word
        ],
        *names,
    )
    assert structure.lower["c"].tolist() == structure.upper["c"].tolist() == [0.5, 0.25]
    assert structure.lower["A"].tolist() == [[0, 1], [-np.inf, -np.inf]]
    assert structure.upper["dB"].tolist() == [[0], [2.5]] and structure.lower["B"].tolist() == [[0], [0]]
    assert structure.lower["v"].tolist() == structure.upper["v"].tolist() == [0.1, 0.1]
    for rules, words in (
        ({"state": "p"}, "a list of rules"),
        ([{"state": "p"}], "keys state, from"),
        ([{"state": "p", "from": "g", "nominal": 1}], "there is no 'g'; there are p, v, f"),
        ([{"state": "p", "from": "v", "nominal": "one"}], "write a number"),
        ([{"state": "p", "from": "noise", "nominal": 1}], "noise has no nominal"),
    ):
        refuses(FitError, words, Structure.from_rules, rules, *names)


@pytest.mark.parametrize("noise", [1e-3, 1e-8])
@pytest.mark.parametrize(("side", "sign"), [("lower", 1), ("upper", -1)])
def test_a_nominal_element_ends_at_the_bound_that_the_data_would_pass(side, sign, noise):
    rng = np.random.default_rng(0)
    u, w = np.repeat(rng.uniform(-1, 1, (151, 1)), 20, axis=0), noise * rng.uniform(-1, 1, (3020, 2))
    x = np.zeros((3020, 2))
    for k in range(3019):
        x[k + 1] = x[k] + 0.01 * (np.array([[-1.0, 0.5], [0.2, -2.0]]) @ x[k] + np.array([1.0, 2.0]) * u[k] + w[k])
    transient = Transient(np.arange(3020) * 0.01, x, u)
    bound = np.full((2, 2), np.nan)
    bound[0, 1] = fit(transient, "qp", additive="disturbance").A[0, 1] + 0.3 * sign * noise
    model = with_structure(transient, "disturbance", "qp", **{side: {"A": bound}})
    assert model.A[0, 1] == pytest.approx(bound[0, 1], rel=1e-13, abs=1e-4 * noise)


def test_structure_goes_to_the_model_file_and_back(tmp_path):
    transient = drawn(small_plant(72), 150, 72, noise=1e-3)
    given = Structure(2, 1, fixed={"A": [[np.nan, 0.3], [0.0, np.nan]]}, upper={"B": [[1.0], [np.nan]]})
    model = fit(transient, additive="noise", structure=given)
    assert (model.A[0, 1], model.A[1, 0]) == (0.3, 0.0) and model.B[0, 0] <= 1.0
    assert count_outside(model, [transient]) == 0
    model.save(tmp_path / "m.json")
    stored = UncertainLTI.load(tmp_path / "m.json").fit_summary["structure"]
    again = Structure.from_dict(stored, 2, 1)
    for side in ("lower", "upper"):
        for name, values in getattr(given, side).items():
            assert np.array_equal(getattr(again, side)[name], values), name
    refuses(FitError, "fit again", Structure.from_dict, {"lower": 3}, 2, 1)


# --- discards ---


@pytest.mark.parametrize(("criterion", "budget"), [("qp", 3), ("lp", 0.012)])
def test_discards_find_the_outliers(criterion, budget):
    clean = drawn(small_plant(81), 260, 81, noise=1e-3)
    x = clean.x.copy()
    x[90, 0] += 0.5  # spoils the steps into and out of sample 90
    x[200:, 1] += 0.7  # spoils one step
    spoiled = Transient(clean.t_ns, x, clean.u, name="run.mcap")
    model = fit(spoiled, criterion, additive="noise", discard=budget)
    assert [(d["file"], d["k"]) for d in sorted(model.fit_summary["discarded"], key=lambda d: d["k"])] == [
        ("run.mcap", 89),
        ("run.mcap", 90),
        ("run.mcap", 199),
    ]
    assert model.fit_summary["transitions"] == 257 and all(d["effect"] > 0 for d in model.fit_summary["discarded"])
    everything = fit(spoiled, criterion, additive="noise")
    assert (model.fit_summary["mean_width"] < 0.5 * everything.fit_summary["mean_width"]).all()
    with_discarded = model.fit_summary["with_discarded"]["mean_width"]
    assert with_discarded == pytest.approx(everything.fit_summary["mean_width"], rel=1e-6)
    kept = Transient(clean.t_ns, x, clean.u)
    assert count_outside(model, [kept]) <= 6


@pytest.mark.parametrize(("criterion", "seed"), [("qp", 82), ("lp", 84)])
def test_discards_are_the_best_single_ones(criterion, seed):
    """Against trying every transition: the first discard lowers the objective most; for (11) δ of the rows in all."""
    transient = drawn(small_plant(seed), 60, seed, noise=5e-3)
    problem = assemble([transient], OperatingPoint.identity(2, 1), None, "noise")

    def objective(*without):
        return solve_as_written(problem.without(np.array(without, dtype=int)), criterion, "CLARABEL")[2]

    everything = objective()
    effects = [float(np.sum((everything - objective(k)) / everything)) for k in range(60)]
    (chosen,) = fit(transient, criterion, additive="noise", discard=1).fit_summary["discarded"]
    # (10) sums the widths over one transition less here, which the choice leaves out of account
    assert effects[chosen["k"]] >= max(effects) - (0.01 if criterion == "qp" else 1e-6)
    if criterion == "lp":
        assert chosen["effect"] == pytest.approx(max(effects), rel=1e-5)


def test_a_weight_beside_the_largest_width_that_is_too_large_is_seen(monkeypatch):
    """The simplex method tells that δ is not the least, and takes over: the same optimum, ties broken alike."""
    transient = drawn(leibov2006(), 300, 4, noise=1e-3)
    expected = fit(transient, "lp", additive="noise")
    monkeypatch.setattr(programmes, "REGULARISATION", 100.0)
    model = fit(transient, "lp", additive="noise")
    np.testing.assert_allclose(model.fit_summary["objective"], expected.fit_summary["objective"], rtol=1e-7)
    np.testing.assert_allclose(model.fit_summary["mean_width"], expected.fit_summary["mean_width"], rtol=1e-3)
    assert model.fit_summary["optimality_gap"] < 1e-6 and count_outside(model, [transient]) == 0
