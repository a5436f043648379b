# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Weights of a schedule: interpolation between knots, modes, two signals, and what is not known."""

import math

import numpy as np
import pytest
from refusals import refuses

from uncertain_lti import EnvelopeMonitor, SignalMap, Transient, UncertainLTI
from uncertain_lti.base.errors import ModelError
from uncertain_lti.model.schedule import Axis, BlockData, Schedule
from uncertain_lti.sampling.clock import Status
from uncertain_lti.signals.signal_map import ScheduleRule, Signal

SPEED = Axis("speed", knots=(-0.5, 0.0, 1.0))
GEAR = Axis("gear", modes=(1.0, 2.0, 4.0))


def test_between_knots_the_weights_interpolate_and_beyond_them_the_end_holds() -> None:
    schedule = Schedule((SPEED,))
    s = np.array([[-2.0, -0.5, -0.25, 0.0, 0.25, 1.0, 7.0]])
    expected = [[1, 1, 0.5, 0, 0, 0, 0], [0, 0, 0.5, 1, 0.75, 0, 0], [0, 0, 0, 0, 0.25, 1, 1]]
    np.testing.assert_array_equal(schedule.weights(s), expected)
    np.testing.assert_array_equal(schedule.beyond(s), [True, False, False, False, False, False, True])


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


def test_two_signals_without_a_sample_have_no_corners() -> None:
    places, weights = Schedule((SPEED, GEAR)).corners(np.zeros((2, 0)))
    assert places.shape == weights.shape == (2, 0)


def test_a_missing_value_has_no_weights() -> None:
    assert np.isnan(Schedule((SPEED,)).weights(np.array([[np.nan]]))).all()


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
        (lambda: Schedule((Axis("a", modes=range(41)), Axis("b", modes=range(25)))), "1025 blocks; at most 1024"),
        (lambda: Schedule((SPEED,)).positions(["torque"]), "'speed'"),
        (lambda: Schedule.from_list([{"signal": "a", "knots": [0, 1], "odd": 1}]), "odd"),
        (lambda: Schedule.from_list([{"signal": "a", "knots": [0, True]}]), "knots"),
        (lambda: Schedule.from_list([{"signal": 3, "knots": [0, 1]}]), "must be an object with 'signal'"),
        (lambda: Schedule.from_list({}), "list"),
    ],
)
def test_what_is_no_schedule_is_refused_by_name(make: object, words: str) -> None:
    refuses(ModelError, words, make)  # type: ignore[operator]


def scheduled(
    rng: np.random.Generator, schedule: Schedule, further: tuple[str, ...] = (), n: int = 2, m: int = 1
) -> UncertainLTI:
    """One or two states, a control or none."""
    R = schedule.blocks
    signals = SignalMap(
        (Signal("speed", "", "a", steady=3.0, scale=2.0), Signal("b", "", "b"))[:n],
        (Signal("c", "", "c"),)[:m],
        tuple(Signal(name, "", name) for name in further),
    )
    half = [np.abs(rng.normal(size=s)) for s in ((R, n, n), (R, n, m), (R, n), (R, n))]
    nominal = [rng.normal(size=s) for s in ((R, n, n), (R, n, m), (R, n))]
    return UncertainLTI(
        nominal[0], nominal[1], half[0], half[1], nominal[2], half[2], half[3], schedule=schedule, signals=signals,
        block_data=[BlockData(r, None if r else 1) for r in range(R)],
    )  # fmt: skip


def test_at_a_knot_the_model_is_that_block_and_between_two_their_mean() -> None:
    model = scheduled(np.random.default_rng(3), Schedule((SPEED,)))
    for r, knot in enumerate(SPEED.knots):
        at = model.at(speed=3.0 + 2.0 * knot)
        np.testing.assert_allclose(at.A, model.A[r], atol=1e-15)
        np.testing.assert_array_equal(model.blocks[r].dB, model.dB[r])
    np.testing.assert_allclose(model.at(speed=3.0 + 2.0 * 0.5).A, (model.A[1] + model.A[2]) / 2, atol=1e-15)
    x = np.array([0.5, 0.3])
    lower, upper = model.bounds(x, [0.2], 0.1)
    theirs = model.at(speed=4.0).bounds(x, [0.2], 0.1)
    np.testing.assert_allclose([lower, upper], theirs, atol=1e-14)


def test_a_point_that_no_block_holds_at_is_refused_by_its_signal() -> None:
    model = scheduled(np.random.default_rng(3), Schedule((SPEED, GEAR)), ("gear",))
    assert model.at(speed=3.0, gear=2.0).schedule is None
    for speed, gear, words in (
        (3.0, 3.0, "gear = 3 is not among the modes of the model, 1, 2, 4; give one of them"),
        (np.nan, 2.0, "speed is nan; give a finite number"),
    ):
        refuses(ModelError, words, model.at, speed=speed, gear=gear)


def test_the_monitor_says_where_the_regime_is_unknown_and_gives_no_verdict_on_a_strange_mode() -> None:
    model = scheduled(np.random.default_rng(6), Schedule((SPEED, GEAR)), ("gear",))  # block 0 has no transition
    monitor = EnvelopeMonitor(model)
    t, x = np.arange(6) * 0.1, np.full((6, 2), 3.0)
    x[:, 0] = [2.0, 4.0, 4.0, 9.0, 4.0, 4.0]
    s = np.array([[1.0], [2.0], [3.0], [4.0], [math.nan], [1.0]])
    transient = Transient(t, x, np.zeros((6, 1)), s=s, signals=model.signals)
    verdicts = monitor.check(transient)
    kinds = [Status.FIRST, Status.OK, Status.OK, Status.MODE, Status.OK, Status.MISSING]
    assert verdicts.statuses() == kinds
    assert verdicts.unknown_regime.tolist() == [False, True, False, False, True, False]
    assert verdicts.outside_domain.tolist() == verdicts.unknown_regime.tolist()
    assert "no recording visited speed = 2, gear = 1" in model.why_unknown([2.0, 3.0, 0.0, 1.0])
    assert "speed = 9 is beyond its knots 2 to 5" in model.why_unknown([9.0, 3.0, 0.0, 4.0])


def test_a_free_run_follows_the_schedule() -> None:
    model = scheduled(np.random.default_rng(7), Schedule((SPEED,)))
    model = model.replace(A=model.A * 0.1, c=model.c * 0.1)
    run = model.simulate([0.2, 0.0], np.zeros((5, 1)), 0.1)
    x = np.array([0.2, 0.0])
    for k in range(5):
        at = model.at(speed=3.0 + 2.0 * float(x[0]))
        x = x + 0.1 * (at.A @ x + at.c)
        np.testing.assert_allclose(run[k + 1], x, atol=1e-14)


def test_a_signals_file_says_how_to_schedule() -> None:
    data = {
        "states": [{"name": "speed", "topic": "/s", "field": "a"}],
        "scheduling": [{"name": "gear", "topic": "/g", "field": "data", "max_hold": 0.5}],
        "schedule": [{"signal": "speed", "knots": "auto"}, {"signal": "gear", "modes": [1, 2]}],
    }
    signals = SignalMap.from_dict(data)
    assert signals.schedule == (ScheduleRule("speed", "auto"), ScheduleRule("gear", None, (1.0, 2.0)))
    assert [s.name for s in signals.signals] == ["speed", "gear"] and signals.topics == ("/s", "/g")
    flag = SignalMap.from_dict(data | {"schedule": [{"signal": "gear", "modes": [False, True]}]})
    assert flag.schedule == (ScheduleRule("gear", None, (0.0, 1.0)),)
