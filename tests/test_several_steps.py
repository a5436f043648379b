# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Least squares several steps ahead: what is run over the windows of horizons where readings are noisy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from uncertain_lti import Transient
from uncertain_lti.identification import fit, horizon_fit, several_steps
from uncertain_lti.identification.assembly import assemble
from uncertain_lti.identification.columns import Regimes
from uncertain_lti.identification.fleet import Fleet
from uncertain_lti.identification.horizon_fit import better_run, run_of
from uncertain_lti.identification.problem import Problem
from uncertain_lti.identification.several_steps import Elements, _jacobian, _windows, runs_over_steps
from uncertain_lti.identification.structure import Structure
from uncertain_lti.identification.working_set import WorkingSet
from uncertain_lti.model.operating_point import OperatingPoint
from uncertain_lti.model.schedule import Axis, Schedule

A, B, DT = np.array([[0.0, 1.0], [-6.0, -1.5]]), np.array([[0.0], [3.0]]), 0.05
POINT = OperatingPoint(np.zeros(2), np.zeros(1), np.ones(2), np.ones(1))


def recordings(noise: float, count: int = 4, length: int = 400, bend: float = 0.0) -> list[Transient]:
    """A linear machine; with `bend`, one whose stiffness depends on the first state."""
    rng, found = np.random.default_rng(5), []
    for _ in range(count):
        u = rng.choice([-1.0, 0.0, 1.0], size=length // 20).repeat(20)[:, None]
        x = np.zeros((length, 2))
        for k in range(length - 1):
            x[k + 1] = x[k] + DT * (A @ x[k] + B @ u[k] - [0.0, bend * x[k, 0] ** 2])
        t = np.arange(length) * 50_000_000
        found.append(Transient(t, x + noise * rng.standard_normal(x.shape), u))
    return found


def assembled(transients: list[Transient], knots: tuple[float, ...] = ()) -> Problem:
    regimes = Regimes(Schedule((Axis("x1", knots),)), (0,)) if knots else None
    return assemble(transients, POINT, None, "noise", regimes=regimes)


def started(problem: Problem, structure: Structure | None = None) -> Any:
    rows = WorkingSet(Fleet.of(problem), structure).rows
    for row in rows:
        row.start()
    return rows


def test_noise_of_the_readings_does_not_bias_what_is_run(monkeypatch: Any) -> None:
    monkeypatch.setattr(horizon_fit, "PAYS", 0.1)
    transients = recordings(0.05)
    one = run_of(assembled(transients))
    model = fit(transients, additive="noise", operating_point=POINT, horizons=[20])
    assert model.run is not None
    assert np.abs(one.A - A).max() > 0.25  # one step ahead, the noise looks like a movement
    assert np.abs(model.run.A - A).max() < 0.1 and np.abs(model.run.B - B).max() < 0.1
    assert not (model.horizons[0].A.any() or model.horizons[0].B.any() or model.horizons[0].c.any())
    # hardly more than the noise of the readings is left over 20 steps
    assert np.abs(model.horizons[0].v).max() < 5.0 * 0.05


@pytest.mark.parametrize("knots", [(), (-0.3, 0.0, 0.3)])
def test_the_derivative_is_that_of_the_run(knots: tuple[float, ...]) -> None:
    problem = assembled(recordings(0.01, count=1, length=60, bend=2.0), knots)
    windows = _windows(problem, problem.k, 6)
    assert windows is not None
    elements = Elements(started(problem), problem.columns.count)
    theta = elements.theta(elements.first)
    found = elements.chosen(_jacobian(windows, theta, windows.steps.run(windows.begin, theta)[1]))
    for j in range(elements.size):
        moved = [elements.first.copy(), elements.first.copy()]
        moved[0][j] -= 1e-6
        moved[1][j] += 1e-6
        low, high = (windows.steps.run(windows.begin, elements.theta(v))[0][-1] for v in moved)
        np.testing.assert_allclose(found[:, j], ((high - low) / 2e-6).ravel(), atol=1e-6)


def test_what_is_known_of_elements_holds() -> None:
    nan = np.nan
    structure = Structure(
        2, 1, fixed={"A": [[0.0, 1.0], [nan, nan]], "B": [[0.0], [nan]]}, upper={"A": [[nan, nan], [-6.5, nan]]}
    )
    problem = assembled(recordings(0.05))
    found = list(runs_over_steps(problem, problem.k, started(problem, structure), 16))
    assert found
    for theta in found:
        np.testing.assert_array_equal(theta[0, :, 0], [0.0, 1.0, 0.0])
        assert theta[0, 0, 1] == -6.5  # the machine's is -6


def test_blocks_that_share_elements_share_them() -> None:
    shared = {"A": np.ones((2, 2), dtype=bool), "B": np.zeros((2, 1), dtype=bool)}
    problem = assembled(recordings(0.02, bend=2.0), (-0.3, 0.3))
    found = list(runs_over_steps(problem, problem.k, started(problem, Structure(2, 1, shared=shared)), 8))
    assert found
    for theta in found:
        np.testing.assert_array_equal(theta[0, :2], theta[1, :2])
        assert (theta[0, 2] != theta[1, 2]).all()


def test_a_window_does_not_go_over_a_gap() -> None:
    problem = assembled(recordings(0.0, count=1, length=60))
    k = problem.k + 5 * (problem.k >= 30)
    windows = _windows(problem, k, 8)
    assert windows is not None and len(windows.begin) == 2 * (30 - 8) + 1
    assert _windows(problem, 2 * problem.k, 2) is None


def test_without_noise_and_with_too_many_elements_least_squares_stay(monkeypatch: Any) -> None:
    problem = assembled(recordings(0.0))
    exact = run_of(problem)
    for theta in runs_over_steps(problem, problem.k, started(problem), 8):
        np.testing.assert_allclose(theta[0, :2].T, exact.A, atol=1e-9)
    few = assembled(recordings(0.01), (-0.4, 0.4))
    assert list(runs_over_steps(few, few.k, started(few), 8))
    monkeypatch.setattr(several_steps, "MOST_UNKNOWNS", 5)
    assert not list(runs_over_steps(few, few.k, started(few), 8))


def test_a_fitted_model_that_is_nearest_is_run_itself(monkeypatch: Any) -> None:
    monkeypatch.setattr(horizon_fit, "PAYS", 0.1)
    transients = recordings(0.05)
    model = fit(transients, additive="noise", operating_point=POINT)
    problem = assembled(transients)
    best, corrected = better_run(model, problem, [20], None)
    assert best is not None and not corrected
    assert better_run(model.replace(A=best.A, B=best.B), problem, [20], None) == (None, True)
