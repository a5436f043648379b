"""Weights of a schedule: interpolation between knots, modes, two signals, and what is not known."""

from __future__ import annotations

import numpy as np
import pytest

from uncertain_lti.base.errors import ModelError
from uncertain_lti.model.schedule import Axis, Schedule

pytestmark = pytest.mark.numpy

SPEED = Axis("speed", knots=(-0.5, 0.0, 1.0))
GEAR = Axis("gear", modes=(1.0, 2.0, 4.0))


def test_between_knots_the_weights_interpolate_and_beyond_them_the_end_holds() -> None:
    schedule = Schedule((SPEED,))
    s = np.array([[-2.0, -0.5, -0.25, 0.0, 0.25, 1.0, 7.0]])
    expected = [[1, 1, 0.5, 0, 0, 0, 0], [0, 0, 0.5, 1, 0.75, 0, 0], [0, 0, 0, 0, 0.25, 1, 1]]
    np.testing.assert_array_equal(schedule.weights(s), expected)
    np.testing.assert_array_equal(schedule.beyond(s), [True, False, False, False, False, False, True])


def test_weights_reproduce_what_is_linear_between_knots() -> None:
    rng = np.random.default_rng(5)
    s = rng.uniform(-0.5, 1.0, (1, 200))
    np.testing.assert_allclose(np.array(SPEED.knots) @ Schedule((SPEED,)).weights(s), s[0], atol=1e-15)


def test_a_mode_holds_alone_and_one_that_is_not_listed_is_unknown() -> None:
    schedule = Schedule((GEAR,))
    places, weights = schedule.corners(np.array([[4.0, 3.0, 1.0, np.nan]]))
    np.testing.assert_array_equal(places, [[2, -1, 0, -1]])
    np.testing.assert_array_equal(weights, [[1, np.nan, 1, np.nan]])
    assert not schedule.beyond(np.array([[99.0]])).any()


def test_two_signals_multiply_their_weights_with_the_first_slowest() -> None:
    schedule = Schedule((SPEED, GEAR))
    assert schedule.blocks == 9 and schedule.indices[4] == (1, 1)
    dense = schedule.weights(np.array([[0.25], [2.0]]))
    expected = np.zeros((9, 1))
    expected[4], expected[7] = 0.75, 0.25
    np.testing.assert_array_equal(dense, expected)
    both = Schedule((SPEED, Axis("load", knots=(0.0, 2.0))))
    s = np.array([np.linspace(-1, 2, 50), np.linspace(-1, 3, 50)])
    np.testing.assert_allclose(both.weights(s).sum(axis=0), 1.0, atol=1e-15)
    assert both.corners(s)[0].shape == (4, 50)


def test_a_missing_value_has_no_weights() -> None:
    assert np.isnan(Schedule((SPEED,)).weights(np.array([[np.nan]]))).all()


def test_a_schedule_comes_back_from_its_list() -> None:
    schedule = Schedule((SPEED, GEAR))
    assert Schedule.from_list(schedule.to_list()) == schedule


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Axis("speed", knots=(1.0, 1.0)), "must increase"),
        (lambda: Axis("speed", knots=(1.0,)), "one knot"),
        (lambda: Axis("speed"), "knots or modes"),
        (lambda: Axis("gear", modes=(1.0, 1.0)), "listed twice"),
        (lambda: Axis("speed", knots=(0.0, float("inf"))), "not finite"),
        (lambda: Schedule(()), "one or two"),
        (lambda: Schedule((SPEED, SPEED)), "is there twice"),
        (lambda: Schedule((SPEED,)).positions(["torque"]), "'speed'"),
        (lambda: Schedule.from_list([{"signal": "a", "knots": [0, 1], "odd": 1}]), "odd"),
        (lambda: Schedule.from_list([{"signal": "a", "knots": [0, True]}]), "knots"),
        (lambda: Schedule.from_list({}), "list"),
    ],
)
def test_what_is_no_schedule_is_refused_by_name(make: object, words: str) -> None:
    with pytest.raises(ModelError, match=words):
        make()  # type: ignore[operator]
