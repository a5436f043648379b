# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""EnvelopeMonitor: one sample at a time or a whole transient, the same bits; and which verdicts count."""

import math
import pickle
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refuses
from steps import steps_of
from test_model import random_model
from test_transient import runs

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI
from uncertain_lti.base.errors import ModelError, TransientError
from uncertain_lti.model.alarm_rule import AlarmRule, StatisticRule
from uncertain_lti.model.domain import Domain, Sampling
from uncertain_lti.sampling.clock import Status
from uncertain_lti.sampling.sampler import Step


def a_model(n: int, m: int, seed: int, **options: Any) -> UncertainLTI:
    return random_model(np.random.default_rng(seed), n, m).replace(**options)


def judge(monitor: EnvelopeMonitor, transient: Transient, **options: Any) -> list[Any]:
    return [monitor.judge(step, **options) for step in steps_of(transient)[1:]]


def a_transient(n: int, m: int, seed: int, count: int = 30) -> Transient:
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.01, 0.02, count))
    return Transient(t, rng.normal(size=(count, n)), rng.normal(size=(count, m)))


SIZES = [(1, 0), (1, 1), (1, 9), (1, 40), (2, 0), (2, 7), (3, 30), (5, 2), (8, 8), (17, 3), (50, 10), (64, 70)]


@pytest.mark.parametrize(("n", "m"), SIZES)
@pytest.mark.parametrize("margin", [1.0, 0.3])
def test_sample_by_sample_gives_the_bits_of_the_whole_transient(n: int, m: int, margin: float) -> None:
    rng = np.random.default_rng(3)
    box = Domain(-rng.uniform(0, 9, n), rng.uniform(0, 9, n), -rng.uniform(0, 9, m), rng.uniform(0, 9, m))
    model = a_model(n, m, 4, domain=box, alarm_rule=AlarmRule(2, 5))
    transient = a_transient(n, m, 5, 2100 if n == 2 else 30)  # more than are judged at a time, and fewer
    whole = EnvelopeMonitor(model, margin=margin).check(transient)
    verdicts = judge(EnvelopeMonitor(model, margin=margin), transient)
    assert 0 < len(verdicts) == whole.judged.sum()
    for k, verdict in enumerate(verdicts, 1):
        for name in ("flags", "lower", "upper", "utilisation"):
            assert getattr(verdict, name).tobytes() == getattr(whole, name)[k].tobytes(), name
        assert (verdict.outside_domain, verdict.alarm) == (whole.outside_domain[k], whole.alarm[k])


def within(low: float, value: float, high: float) -> bool:
    """Whether a value is in the fitted range, or beyond it by less than a tenth of it."""
    slack = 0.1 * (high - low) + 1e-12 * max(abs(low), abs(high))
    return low - slack <= value <= high + slack


@given(st.data())
def test_the_alarm_counts_violations_in_its_window_and_only_those_that_count(data: st.DataObject) -> None:
    window = data.draw(st.integers(1, 6))
    violations = data.draw(st.integers(1, window))
    n = 3
    masked = data.draw(st.lists(st.sampled_from(["x0", "x1"]), unique=True))
    model = a_model(n, 0, 6, alarm_rule=AlarmRule(violations, window))
    transient = a_transient(n, 0, data.draw(st.integers(0, 10**6)))
    armed = data.draw(st.lists(st.booleans(), min_size=len(transient) - 1, max_size=len(transient) - 1))
    monitor = EnvelopeMonitor(model, margin=0.5, masked=masked)
    counted: list[bool] = []
    for k in range(1, len(transient)):
        part = Transient(transient.t[k - 1 : k + 1], transient.x[k - 1 : k + 1], transient.u[k - 1 : k + 1])
        (verdict,) = judge(monitor, part, armed=armed[k - 1])
        counts = [flag for name, flag in zip(model.state_names, verdict.flags, strict=True) if name not in masked]
        counted = [*counted, 1.0 in counts] if armed[k - 1] else []
        assert verdict.alarm == (sum(counted[-window:]) >= violations)
    if all(armed):
        assert EnvelopeMonitor(model, margin=0.5, masked=masked).check(transient).alarm[-1] == verdict.alarm


def test_masks_and_rules_are_held_against_the_model() -> None:
    model = a_model(2, 0, 7)
    assert EnvelopeMonitor(model, masked=["x1"]).masked == ("x1",)
    with pytest.raises(ModelError, match="masked state 'x2' is not in the model; its states are x0, x1"):
        EnvelopeMonitor(model, masked=["x2"])
    with pytest.raises(ModelError, match="masked is of type int; give the names of states"):
        EnvelopeMonitor(model, masked=1)
    for one in ("x1", iter(["x1"]), {"x1"}):  # an iterator was used up before it masked anything
        assert EnvelopeMonitor(model, masked=one).masked == ("x1",)
    assert EnvelopeMonitor(model, *np.array([2, 3])).rule == AlarmRule(2, 3)
    with pytest.raises(ModelError, match="alarm is of type AlarmRule; give a list of AlarmRule or StatisticRule"):
        EnvelopeMonitor(model, rules=AlarmRule())
    with pytest.raises(ModelError, match="every state of the model is masked"):
        EnvelopeMonitor(model, masked=["x0", "x1"])
    with pytest.raises(ModelError, match=r"violations is 1.5 of window 3; it takes whole numbers"):
        EnvelopeMonitor(model, violations=1.5, window=3)


# --- transients with every disorder --------------------------------------------------------------------------


@st.composite
def cases(draw: st.DrawFn) -> tuple[UncertainLTI, Transient]:
    """A run with gaps, resets, dropped samples and NaN."""
    t, x, u, max_gap, min_step = draw(runs())
    n, m = x.shape[1], u.shape[1]
    window = draw(st.integers(1, 6))
    box = Domain(np.full(n, -1.0), np.full(n, 1.0), np.full(m, -1.0), np.full(m, 1.0))
    model = a_model(n, m, draw(st.integers(0, 2**32 - 1))).replace(
        domain=draw(st.sampled_from([box, None])),
        alarm_rule=AlarmRule(draw(st.integers(1, window)), window, draw(st.sampled_from([1.0, 0.5, 3.0]))),
    )
    return model, Transient(t, x, u, signals=model.signals, max_gap=max_gap, min_step=min_step)


@settings(max_examples=80)
@given(cases())
def test_verdicts_are_those_of_the_rules_worked_out_naively(case: tuple[UncertainLTI, Transient]) -> None:
    """The margin widens the bounds, which are in recorded units, and not the utilisation."""
    model, transient = case
    verdicts = EnvelopeMonitor(model).check(transient)
    point, rule = model.operating_point, model.alarm_rule
    recent: deque[bool] = deque(maxlen=rule.window)
    alarm = False
    for k, status in enumerate(transient.statuses()):
        t = [-(2**63), *transient.t_ns.tolist()]  # before the first sample nothing steps back
        if k >= 2 and t[k] < t[k - 1] and t[k + 1] <= t[k - 1] and (k == 2 or t[k] <= t[k - 2]):
            recent.clear()  # the two last samples lie before the one that came before them
            alarm = False
        assert verdicts.judged[k] == (status is Status.OK)
        if status is Status.OK:
            x = (transient.x[k - 1] - point.x_s) / point.X
            u = (transient.u[k - 1] - point.u_s) / point.U
            after = (transient.x[k] - point.x_s) / point.X
            lower, upper = model.bounds(x, u, transient.dt[k - 1], margin=rule.margin)
            centre, half = model.centre_and_half(x, u, transient.dt[k - 1])
            np.testing.assert_allclose(verdicts.utilisation[k], (after - centre) / half, rtol=1e-9, atol=1e-12)
            bounds = point.recorded_x(np.array([lower, upper]))
            np.testing.assert_allclose([verdicts.lower[k], verdicts.upper[k]], bounds, rtol=1e-9, atol=1e-9)
            inside = [low <= value <= high for low, value, high in zip(lower, after, upper, strict=True)]
            assert verdicts.flags[k].tolist() == [0.0 if i else 1.0 for i in inside]
            z, box = [*x, *u], model.domain
            ranges = zip([*box.x_min, *box.u_min], z, [*box.x_max, *box.u_max], strict=True)
            assert verdicts.outside_domain[k] == (not all(within(*of) for of in ranges))
            recent.append(not all(inside))
            alarm = sum(recent) >= rule.violations
        else:
            assert np.isnan(verdicts.flags[k]).all() and np.isnan(verdicts.lower[k]).all()
            assert not verdicts.outside_domain[k]
        assert verdicts.alarm[k] == alarm


def a_step(x: float, x_next: float, status: Status = Status.OK, dt: float = 1.0) -> Step:
    return Step(status, 0, 0, dt, [x], [x_next])


def scalar(dA: float = 0.0, v: float = 0.0, **options: Any) -> UncertainLTI:
    """x_next = x up to dA |x| dt + v."""
    empty = np.empty((1, 0))
    return UncertainLTI([[0.0]], empty, [[dA]], empty, v=[v], **options)


@pytest.mark.parametrize(
    ("x_next", "flag", "utilisation"),
    [(1.0, 0, 0.0), (1.5, 0, 1.0), (0.5, 0, -1.0), (np.nextafter(1.5, 2), 1, 1.0), (0.25, 1, -1.5), (2.0, 1, 2.0)],
)
def test_a_sample_on_its_bound_is_contained(x_next: float, flag: int, utilisation: float) -> None:
    verdict = EnvelopeMonitor(scalar(dA=0.5)).judge(a_step(1.0, x_next))
    assert (verdict.flags[0], verdict.lower[0], verdict.upper[0]) == (flag, 0.5, 1.5)
    assert verdict.utilisation[0] == pytest.approx(utilisation, rel=1e-12)
    assert verdict.alarm == bool(flag)
    whole = EnvelopeMonitor(scalar(dA=0.5)).check(Transient([0.0, 1.0], [1.0, x_next], []))
    assert whole.flags[1].tolist() == verdict.flags.tolist()


def test_where_the_bounds_have_no_width_utilisation_is_zero_or_infinite() -> None:
    monitor = EnvelopeMonitor(scalar())
    assert [monitor.judge(a_step(1.0, value)).utilisation[0] for value in (1.0, 2.0, -2.0)] == [0, math.inf, -math.inf]
    assert [monitor.judge(a_step(1.0, value)).flags[0] for value in (1.0, 2.0, -2.0)] == [0, 1, 1]


def test_silence_is_never_contained_and_ends_no_alarm() -> None:
    monitor = EnvelopeMonitor(scalar(v=1.0))
    assert monitor.judge(a_step(0.0, 5.0)).alarm
    for status in (Status.MISSING, Status.GAP, Status.EQUAL, Status.SHORT, Status.LATE, Status.UNSTAMPED):
        verdict = monitor.judge(a_step(0.0, 0.0, status))
        assert verdict.alarm and not verdict.judged
        assert all(np.isnan(part).all() for part in (verdict.flags, verdict.lower, verdict.upper, verdict.utilisation))
    assert monitor.judge(Step(Status.RESET, -(10**10), 0, 1.0, [0.0], [0.0])).alarm
    assert not monitor.judge(Step(Status.OK, 1 - 10**10, 0, 1.0, [0.0], [0.5])).alarm


def test_a_verdict_is_ordinary_where_nothing_is_to_be_said_of_it() -> None:
    monitor = EnvelopeMonitor(scalar(v=1.0))
    said = [monitor.judge(a_step(0.0, x), armed).ordinary for x in (0.5, 1.5) for armed in (True, False)]
    assert said == [True, False, False, False], "inside, and the alarm could be raised"


def test_verdicts_do_not_share_what_they_hold() -> None:
    monitor = EnvelopeMonitor(scalar(v=1.0))
    first, second = (monitor.judge(a_step(0.0, 0.0, Status.GAP)) for _ in range(2))
    first.flags[:] = 0.0
    assert np.isnan(second.flags).all() and np.isnan(monitor.judge(a_step(0.0, 0.0, Status.GAP)).flags).all()
    first, second = (monitor.judge(a_step(0.0, value)) for value in (0.5, 5.0))
    assert (first.flags[0], second.flags[0]) == (0.0, 1.0)


@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(0, 3), st.sampled_from([1.0, 2.5]))
def test_predicted_bounds_are_those_that_will_be_judged(seed: int, n: int, m: int, margin: float) -> None:
    model = a_model(n, m, seed)
    rng = np.random.default_rng(seed)
    x, u, after, dt = rng.normal(size=n), rng.normal(size=m), rng.normal(size=n), 0.02
    monitor = EnvelopeMonitor(model, margin=margin)
    lower, upper = monitor.predict(x, u, dt)
    verdict = monitor.judge(Step(Status.OK, 0, 0, dt, [*x.tolist(), *u.tolist()], after.tolist()))
    assert lower.tobytes() == verdict.lower.tobytes() and upper.tobytes() == verdict.upper.tobytes()


def test_steps_made_by_hand_are_judged_as_the_transient() -> None:
    model, rng = a_model(2, 1, 3), np.random.default_rng(3)
    run = Transient(np.arange(50) * 0.02, rng.normal(size=(50, 2)), rng.normal(size=(50, 1)))
    monitor, z = EnvelopeMonitor(model), np.hstack([run.x, run.u])
    pairs = [
        Step(Status.OK, t, t, 0.02, *pair) for t, *pair in zip(run.t_ns[1:].tolist(), z[:-1], run.x[1:], strict=True)
    ]
    by_hand, expected = [monitor.judge(step) for step in pairs], EnvelopeMonitor(model).check(run)
    assert [v.alarm for v in by_hand] == expected.alarm[1:].tolist()
    assert np.array([v.lower for v in by_hand]).tobytes() == expected.lower[1:].tobytes()
    with pytest.raises(ModelError, match=r"step: 3 and 3 values for 3 and 2 signals; give \[x; u; s\] before and x"):
        monitor.judge(Step(Status.OK, 0, 0, 0.02, z[0], z[1]))


def test_a_transient_of_other_size_is_refused() -> None:
    transient = Transient([0.0, 1.0], np.zeros((2, 2)), np.zeros((2, 1)), name="run")
    with pytest.raises(ModelError, match="run: 2 states and 1 control, and the model has 1 and 0"):
        EnvelopeMonitor(scalar()).check(transient)
    monitor = EnvelopeMonitor(a_model(2, 1, 7))
    transient = transient.replace(state_names=["x1", "x0"])  # by their places one would be judged as the other
    refuses(ModelError, "run has x1, x0, the model x0, x1; give them in the order", monitor.check, transient)
    refuses(ModelError, r"x has shape \(1,\); give real numbers of shape \(2,\)", monitor.predict, [1.0], [1.0], 0.1)


@pytest.mark.parametrize(
    "bad", [None, "abc", ["a", 1], [[1, 2], [3]], {}, object(), 1j, np.ones((2, 2, 7)), b"x", [[]]]
)
def test_arguments_that_are_no_numbers_of_their_shape_are_named(bad: Any) -> None:
    """They ended in an error of numpy that names none of them."""
    model = a_model(2, 1, 7)
    monitor, point = EnvelopeMonitor(model), model.operating_point
    x, u, z, dt = [0.1, 0.2], [0.3], [0.1, 0.2, 0.3], 0.1
    calls: list[tuple[str, Callable[[], Any]]] = [
        ("x", lambda: model.bounds(bad, u, dt)), ("u", lambda: model.bounds(x, bad, dt)),
        ("x", lambda: monitor.predict(bad, u, dt)), ("u", lambda: monitor.predict(x, bad, dt)),
        ("x0", lambda: model.simulate(bad, [u], dt)), ("u", lambda: model.simulate(x, bad, dt)),
        ("z", lambda: monitor.expect(0, bad, dt)), ("z", lambda: monitor.foresee(0, bad, dt)),
        ("dt", lambda: monitor.predict(x, u, bad)), ("dt", lambda: monitor.foresee(0, z, bad)),
        ("dt", lambda: model.simulate(x, [u], bad)), ("margin", lambda: model.bounds(x, u, dt, bad)),
        ("x", lambda: point.normalise_x(bad)), ("u", lambda: point.normalise_u(bad)),
    ]  # fmt: skip
    for name, call in calls:
        refuses(
            (ModelError, TransientError), rf"^{name} (is not numeric|has shape .*); give (real|a real|as many)", call
        )
    refuses(ModelError, "step is .*; give a Step of a Sampler", monitor.judge, bad)


def test_a_transient_without_samples_has_no_verdict() -> None:
    for count in (0, 1):
        verdicts = EnvelopeMonitor(scalar()).check(Transient(np.zeros(count), np.zeros((count, 1)), []))
        assert len(verdicts.judged) == count and not verdicts.judged.any() and not verdicts.alarm.any()


def test_verdicts_are_the_same_for_all_threads_and_processes_that_ask() -> None:
    """Statistics are computed when first asked for; threads that asked at once shared the windows, and broke memory."""
    model = random_model(np.random.default_rng(3), 2, 1)
    rules = [StatisticRule(kind, window_s=1.0, threshold=[1.0, 1.0]) for kind in ("energy", "mean", "ewma")]
    rng = np.random.default_rng(0)
    count = 60_000
    run = Transient(np.arange(count) * 0.01, rng.normal(size=(count, 2)), rng.normal(size=(count, 1)))
    monitor = EnvelopeMonitor(model, rules=rules)
    verdicts = monitor.check(run)
    expected = verdicts.statistics
    for copy in (pickle.loads(pickle.dumps(monitor.check(run))), pickle.loads(pickle.dumps(verdicts))):  # of processes
        np.testing.assert_array_equal(copy.statistics, expected)
        np.testing.assert_array_equal(copy.lower, verdicts.lower)
        assert copy.raised(9) == verdicts.raised(9) and repr(copy) == repr(verdicts)
    for _ in range(5):
        verdicts = monitor.check(run)
        with ThreadPoolExecutor(4) as pool:
            for found in pool.map(lambda _, one: one.statistics, range(4), [verdicts] * 4):
                np.testing.assert_array_equal(found, expected)


def test_each_check_starts_from_a_cleared_alarm() -> None:
    monitor = EnvelopeMonitor(scalar(v=1.0))
    transient = Transient([0.0, 1.0, 2.0], [0.0, 5.0, 5.0], [])
    first, second = monitor.check(transient), monitor.check(transient)
    assert first.alarm.tolist() == second.alarm.tolist() == [False, True, False]


@pytest.mark.parametrize("dt_ms, judged", [(4, False), (5, True), (10, True), (40, True), (41, False), (9999, False)])
def test_a_step_that_the_fit_never_saw_has_no_verdict(dt_ms: int, judged: bool) -> None:
    """An input that runs a thousand times too fast must not be called contained."""
    model = a_model(2, 1, 3, sampling=Sampling(dt_median=0.015, dt_min=0.01, dt_max=0.02))
    t = np.array([0, 15, 15 + dt_ms, 30 + dt_ms]) * 1_000_000
    transient = Transient(t, np.zeros((4, 2)), np.zeros((4, 1)), max_gap=100.0)
    monitor = EnvelopeMonitor(model)
    whole = monitor.check(transient)
    assert whole.judged.tolist() == [False, True, judged, True]
    assert whole.unfitted_step.tolist() == [False, False, not judged, False]
    expected = Status.OK if judged else Status.STEP
    assert whole.statuses()[1:] == [Status.OK, expected, Status.OK]
    verdicts = judge(EnvelopeMonitor(model), transient)
    assert [v.status for v in verdicts] == [Status.OK, expected, Status.OK]
    assert verdicts[1].judged is judged and bool(np.isnan(verdicts[1].flags).all()) is not judged
