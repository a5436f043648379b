# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.
"""The output-error method, and which form of the residuals' covariance a fit takes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from test_several_steps import A, B, assembled, recordings, started

from uncertain_lti.identification import several_steps
from uncertain_lti.identification.fleet import likelier_alone
from uncertain_lti.identification.problem import Problem
from uncertain_lti.identification.several_steps import Elements, nearest_to_all, runs_over_steps, segments
from uncertain_lti.identification.structure import Structure


def both(problem: Problem, structure: Structure | None = None, longest: int = 20) -> tuple[Any, Any, Elements]:
    """Elements by least squares several steps ahead, those by the output-error method from there, and the unknowns."""
    rows = started(problem, structure)
    *_, last = runs_over_steps(problem, problem.k, rows, longest)
    elements = Elements(rows, problem.columns.count)
    return last, nearest_to_all(problem, problem.k, elements, [last], longest), elements


def test_it_is_nearer_to_the_machine_than_least_squares_several_steps_ahead() -> None:
    problem = assembled(recordings(0.1, count=8))
    several, found, _ = both(problem)
    truth = np.column_stack([A, B])
    errors = [np.abs(theta[0, :3].T - truth).max() for theta in (several, found)]
    assert errors[1] < 0.7 * errors[0]
    assert errors[1] < 0.1


@pytest.mark.parametrize("knots", [(), (-0.3, 0.3)])
def test_no_element_makes_the_error_over_segments_smaller(knots: tuple[float, ...], monkeypatch: Any) -> None:
    monkeypatch.setattr(several_steps, "_DONE", 1e-12)
    monkeypatch.setattr(several_steps, "_ROUNDS", 40)
    monkeypatch.setattr(several_steps, "_EVERY", 1)
    problem = assembled(recordings(0.02, bend=2.0), knots)
    _, found, elements = both(problem)
    steps, recorded = segments(problem, problem.k, several_steps.LONGER * 20, 10**6)  # type: ignore[misc]

    def error(values: Any) -> float:
        """With the best initial states, states weighted by the spread of the solution: by linear least squares."""
        theta = elements.theta(values)
        free = steps.run(recorded[0], theta)[0]
        moves = np.stack([steps.run(recorded[0] + 1e-3 * e, theta)[0] - free for e in np.eye(2)], axis=-1) / 1e-3
        left, total = (recorded - free) / scale, 0.0
        for i in range(recorded.shape[1]):
            slope = (moves[:, i] / scale[:, None]).reshape(-1, 2)
            total += float(np.linalg.lstsq(slope, left[:, i].ravel(), rcond=None)[1][0])
        return total

    scale = np.ones(2)
    best = elements.values(found)
    at_best = steps.run(recorded[0], found)[0]
    scale = np.std(recorded - at_best, axis=(0, 1))
    for j in range(elements.size):
        size = 0.05 * max(abs(best[j]), 0.5)
        moved = [best + sign * size * np.eye(elements.size)[j] for sign in (-1.0, 1.0)]
        assert error(best) < min(map(error, moved)), "a step in either direction is worse"


def test_what_is_known_of_elements_holds() -> None:
    nan = np.nan
    structure = Structure(
        2, 1, fixed={"A": [[0.0, 1.0], [nan, nan]], "B": [[0.0], [nan]]}, upper={"A": [[nan, nan], [-6.5, nan]]}
    )
    _, found, _ = both(assembled(recordings(0.05)), structure)
    np.testing.assert_array_equal(found[0, :, 0], [0.0, 1.0, 0.0])
    assert found[0, 0, 1] == -6.5  # the machine's is -6
    shared = {"A": np.ones((2, 2), dtype=bool), "B": np.zeros((2, 1), dtype=bool)}
    _, found, elements = both(assembled(recordings(0.02, bend=2.0), (-0.3, 0.3)), Structure(2, 1, shared=shared), 8)
    np.testing.assert_array_equal(found[0, :2], found[1, :2])
    assert (found[0, 2] != found[1, 2]).all()
    np.testing.assert_allclose(elements.theta(elements.values(found)), found, rtol=0, atol=1e-12)


def test_segments_do_not_overlap_and_end_at_gaps() -> None:
    problem = assembled(recordings(0.0, count=1, length=60))
    k = problem.k + 5 * (problem.k >= 25)
    steps, recorded = segments(problem, k, 10, 1000)  # type: ignore[misc]
    begins = [0, 10, 25, 35, 45]
    np.testing.assert_array_equal(recorded[0], problem.z_columns[:2, begins].T)
    np.testing.assert_array_equal(recorded[-1], problem.next_columns[:, np.array(begins) + 9].T)
    assert steps.dt.shape == (10, 5)
    some = segments(problem, k, 10, 20)
    assert some is not None and some[1].shape[1] == 2
    assert segments(problem, 2 * problem.k, 2, 1000) is None


def test_without_segments_there_is_nothing() -> None:
    problem = assembled(recordings(0.01, count=1, length=40))
    rows = started(problem)
    *_, last = runs_over_steps(problem, problem.k, rows, 20)
    assert nearest_to_all(problem, problem.k, Elements(rows, 1), [last], 20) is None


def test_the_likelier_form_of_the_covariance_is_taken() -> None:
    rng = np.random.default_rng(4)
    half = np.exp(rng.uniform(-1.0, 1.0, (4000, 1))) * [1.0, 2.0]
    noise = rng.standard_normal((4000, 2)) @ [[1.0, 0.3], [0.0, 1.0]]
    assert likelier_alone(noise, half) and not likelier_alone(noise * half, half)
    assert not likelier_alone(noise, np.broadcast_to(half[:1], half.shape)), "one half-width: the same"
    few = noise.copy()
    few[:100] *= 20.0 * half[:100]  # pulses
    assert likelier_alone(few, np.where(np.arange(4000)[:, None] < 100, 20.0 * half, half))
    half[0] = 0.0
    assert not likelier_alone(noise, half)
    assert not likelier_alone(np.column_stack([noise, noise[:, 0]]), np.ones((4000, 3)))
