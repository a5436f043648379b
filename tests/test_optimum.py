# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The optimum: fits against independent solvers of the whole problem, and what is said of the distance from it."""

import itertools

import numpy as np
import optimum
import pytest
from conftest import ROOT
from test_identification import drawn, small_plant

from uncertain_lti import OperatingPoint, Transient, read_transients
from uncertain_lti.base.errors import FitError
from uncertain_lti.identification import fit, working_set
from uncertain_lti.identification.fleet import Fleet
from uncertain_lti.identification.structure import Structure

KEY = "optimality_gap"


@pytest.mark.parametrize("first", [10, 15])
def test_no_fit_is_above_its_optimum(first):
    """Ten of the problems that `python benchmarks/optimum.py` draws; it runs 500."""
    compared = 0
    for seed, criterion in itertools.product(range(first, first + 5), ("qp", "lp")):
        drawn = optimum.case(seed)
        found = optimum.compare(drawn, criterion)
        known = np.isfinite(found.excess)
        where = f"problem {seed}, {criterion}: {', '.join(drawn.words)}"
        assert (found.excess[known] <= 1e-6).all(), where
        if known.any() and found.gap is not None:
            assert found.gap >= found.true_gap - 2 * optimum.AGREE, where
        if found.error is not None and found.optimum is not None:
            assert not np.isfinite(found.optimum).all(), f"{where}: {found.error}"
        compared += known.any()
    assert compared >= 7


@pytest.mark.parametrize("criterion", ["qp", "lp"])
def test_a_fit_of_many_unknowns_starts_from_one_that_is_near(criterion, monkeypatch):
    """And (10) takes in what is next to its bounds before it is outside."""
    rng = np.random.default_rng(1)
    x, u = np.zeros((3001, 3)), rng.normal(size=(3001, 75))
    gain = rng.normal(size=(3, 75))
    for k in range(3000):
        x[k + 1] = 0.9 * x[k] + 0.1 * gain @ u[k] + 0.02 * rng.uniform(-1, 1, 3)
    run = Transient(0.1 * np.arange(3001), x, u)
    near, part = fit(run, criterion, additive="noise"), run.replace(slice(0, 2500))
    alone, started = (fit(part, criterion, additive="noise", near=of) for of in (None, near))
    monkeypatch.setattr("uncertain_lti.identification.solvers.VERY_MANY", 1000)
    slow = fit(part, criterion, additive="noise")
    of = [model.fit_summary["solver"] for model in (started, alone, slow)]
    assert of[0]["rounds"] <= 3 * (2 if criterion == "lp" else 1) < of[1]["rounds"]
    assert (min(of[1]["working_set"]) > max(of[2]["working_set"])) == (criterion == "qp")
    for model in (started, slow):
        assert np.allclose(model.fit_summary["objective"], alone.fit_summary["objective"], rtol=1e-7)
        assert np.allclose(model.A, alone.A, atol=1e-6)
        assert model.fit_summary[KEY] <= 1e-6


@pytest.mark.parametrize("seed", [9, 98, 108])
def test_with_knots_where_the_first_centre_contains_every_sample(seed):
    """Of `python benchmarks/optimum.py --knots`: the simplex method starts from no sample at all in some row."""
    found = optimum.compare(optimum.with_knots(seed), "lp")
    known = np.isfinite(found.excess)
    allowed = np.where(found.optimum < 1e-15, 1e-4, 1e-6)  # squares of widths that rounding makes, and BLAS with it
    assert found.error is None and known.any() and (found.excess[known] <= allowed[known]).all()
    assert found.gap >= found.true_gap - 2 * optimum.AGREE


@pytest.mark.parametrize("seed, known", [(59, True), (304, True), (84, False)])
def test_rows_that_are_solved_in_turn_have_a_bound(seed, known):
    """Full weights, and by rounding the objective falls as some half-widths grow: without end, a slope would say."""
    drawn = optimum.case(seed)
    found = optimum.compare(drawn, "qp")
    assert found.gap is not None and found.gap <= 1e-5
    assert np.isfinite(found.excess).all() == known  # where the independent solvers agree
    assert not known or found.gap >= found.true_gap - 2 * optimum.AGREE
    engine = working_set.WorkingSet(Fleet([drawn.assembled()]), drawn.options["structure"])
    engine.quadratic()
    for row in engine.rows:
        row.d = 1.01 * row.d
    assert engine.coupled_gap() >= (1 - 1 / 1.01**2) - 1e-5  # what is 1 % wider is known to be


@pytest.mark.parametrize("bag", ["turbofan_pulses_up", "turbofan_check"])
@pytest.mark.parametrize("additive", ["none", "noise", "both"])
def test_recordings_of_little_noise_reach_the_least_largest_width(bag, additive):
    transients = read_transients(ROOT / "bags" / f"{bag}.mcap", ROOT / "config" / "signals" / "turbofan.yaml")
    model = fit(transients, "lp", additive=additive, describe_data=False)
    assert model.fit_summary[KEY] <= 1e-7
    options = {"weights": None, "additive": additive, "structure": None}
    found = optimum.compare(optimum.Case(transients[0], options, point=model.operating_point), "lp")
    known = np.isfinite(found.excess)
    assert known.any() or bag == "turbofan_check"  # so exact that the other solvers do not agree
    assert (found.excess[known] <= 1e-6).all()


def plant(seed, n, m, count, noise):
    """Recordings of a random linear plant."""
    return drawn(small_plant(seed, n, m), count, seed, noise, dt=0.02)


@pytest.mark.parametrize("criterion", ["qp", "lp"])
def test_a_half_width_that_is_fixed_stays_to_the_bit(criterion):
    """Rounding is carried by the others, whatever their number."""
    transient = plant(3, 8, 4, 400, 1e-4)
    rng = np.random.default_rng(3)
    half = np.where(rng.random((8, 12)) < 0.8, 0.0, np.nan)
    half[0, :2], half[1, 3] = 0.25, 1e-3
    structure = Structure(8, 4, fixed={"dA": half[:, :8], "dB": half[:, 8:]})
    model = fit(transient, criterion, additive="noise", structure=structure)
    found = np.hstack([model.dA, model.dB])
    fixed = ~np.isnan(half)
    assert np.array_equal(found[fixed], half[fixed])
    x, u = transient.x, transient.u
    lower, upper = model.bounds(x[:-1], u[:-1], transient.dt)
    assert ((lower <= x[1:]) & (x[1:] <= upper)).all()


def test_what_fixed_half_widths_leave_outside_is_covered_at_once(monkeypatch):
    """A pass over all transitions is half of a fit, so that the repair must not feel its way."""
    passes, judge = [], Fleet.judge
    monkeypatch.setattr(Fleet, "judge", lambda self, model: passes.append(model) or judge(self, model))
    lengths = (2, 4, 8)
    model = fit(plant(7, 5, 4, 3000, 1e-4), "qp", additive="noise", horizons=lengths, widths="constant")
    assert len(model.horizons) == 3 and len(passes) == 1 + 2 * 3  # of each horizon once more for its residuals


def test_a_largest_half_width_is_not_exceeded_by_the_repair():
    transient = plant(4, 3, 2, 300, 1e-3)
    free = fit(transient, "lp", additive="noise")
    most = np.minimum(free.dA, 0.5 * free.dA.max()) * 0.9
    model = fit(transient, "lp", additive="noise", structure=Structure(3, 2, upper={"dA": most}))
    assert (model.dA <= most).all() and model.fit_summary[KEY] <= 1e-6


def test_a_row_whose_half_widths_are_all_fixed_says_that_rounding_needs_one():
    """Exact kinematics, and no width that could take the rounding of the verdict."""
    rng = np.random.default_rng(0)
    v = rng.uniform(-1, 1, 300)
    x = np.column_stack([np.concatenate([[0.1], 0.1 + np.cumsum(0.01 * v[:-1])]), v])
    nan = np.nan
    structure = Structure(2, 0, fixed={"A": [[0, 1], [nan, nan]], "dA": [[0, 0], [nan, nan]]})
    with pytest.raises(FitError, match="'x1' leaves .* outside, by rounding at least; let a half-width of this row"):
        fit(Transient(np.arange(300) * 0.01, x, np.empty((300, 0))), structure=structure)


@pytest.mark.parametrize("criterion", ["qp", "lp"])
def test_a_state_that_never_moves_has_no_distance_from_the_optimum(criterion):
    transient = plant(5, 3, 1, 200, 1e-3)
    x = transient.x.copy()
    x[:, 1] = 0.0
    model = fit(Transient(transient.t_ns, x, transient.u), criterion, additive="noise")
    assert 0 <= model.fit_summary[KEY] < 1e-6


@pytest.mark.parametrize("criterion", ["qp", "lp"])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("offset", [0.0, 1e4])
def test_a_state_and_its_lag_are_fitted(criterion, scale, offset):
    transient = plant(6, 2, 1, 600, 1e-3)
    x = np.column_stack([transient.x[1:, 0], transient.x[:-1, 0], transient.x[1:, 1]]) * scale + offset * scale
    point = OperatingPoint(np.full(3, offset * scale), np.zeros(1), np.ones(3), np.ones(1))
    model = fit(Transient(transient.t_ns[1:], x, transient.u[1:]), criterion, additive="noise", operating_point=point)
    ulp = np.spacing(np.abs(x).max())
    assert model.fit_summary["max_width"][1] <= 64 * ulp  # rounding of the verdict
    assert model.fit_summary[KEY] is None or model.fit_summary[KEY] < 1e-4


def test_a_gap_that_is_not_small_is_said(monkeypatch):
    transient = plant(7, 3, 1, 200, 1e-3)
    monkeypatch.setattr(working_set.Programmes, "duality_gap", lambda programmes: 0.2)
    monkeypatch.setattr(working_set.Programmes, "linear_gap", lambda programmes: 0.1)
    model = fit(transient, "qp", additive="noise")
    assert model.fit_summary[KEY] == pytest.approx(0.1)
    assert any("10 % above the optimum at most" in message for message in model.fit_summary["messages"])
    monkeypatch.setattr(working_set.Programmes, "duality_gap", lambda programmes: np.inf)
    monkeypatch.setattr(working_set.Programmes, "linear_gap", lambda programmes: np.inf)
    model = fit(transient, "qp", additive="noise")
    assert model.fit_summary[KEY] is None
    assert any("no bound of the distance from the optimum" in message for message in model.fit_summary["messages"])


def test_samples_that_contradict_one_another_are_not_called_impossible_alone():
    """x' = ±0.1 u: each sample fits an element without width, both do not."""
    t = np.arange(41) * 0.1
    u = np.ones((41, 1))
    u[::2] = 2.0
    x = np.zeros((41, 1))
    for k in range(40):
        x[k + 1] = x[k] + 0.1 * (3.0 if k == 20 else 1.0) * u[k]
    fixed = {"A": [[0.0]], "dA": [[0.0]], "dB": [[0.0]]}
    for criterion in ("qp", "lp"):
        with pytest.raises(FitError, match="and . other transitions? at once: each alone can be inside"):
            fit(Transient(t, x, u), criterion, structure=Structure(1, 1, fixed=fixed))
        with pytest.raises(FitError, match=r"which stays 0\.4 outside at best"):
            fit(Transient(t, x, u), criterion, structure=Structure(1, 1, fixed=fixed | {"B": [[1.0]]}))


def test_the_optimality_gap_goes_to_files_that_older_releases_read(tmp_path):
    model = fit(plant(8, 2, 1, 100, 1e-3), additive="noise")
    model.save(tmp_path / "m.json")
    assert '"gap"' in (tmp_path / "m.json").read_text() and KEY not in (tmp_path / "m.json").read_text()
    assert type(model).load(tmp_path / "m.json").fit_summary[KEY] == model.fit_summary[KEY]
