# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The benchmark of detection: scores are those of the monitor's alarm, thresholds let through what they are to."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("scipy", reason="scipy, which the benchmark needs, is not installed")

from detection_cases import Case, Faulty, Recorded, from_whole_degrees, profile
from detection_procedure import Kind, as_tuned, evaluate, our_rules, threshold_of
from detectors import Kalman, LeastSquares, Runs, Statistic, cusum, of_window, residual_detectors
from tanks import Tanks
from temporal_logic import arrivals, formula_of, gathered, verdicts

from uncertain_lti import EnvelopeMonitor, OperatingPoint, fit
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.plants.leibov import transient
from uncertain_lti.validation.false_alarms import allowed_alarms

POINT = OperatingPoint(np.zeros(3), np.zeros(1), np.ones(3), np.ones(1))
KINDS = (
    Kind("containment"), Kind("containment", 1.0), Kind("energy", 1.0), Kind("mean", 1.0), Kind("ewma", 1.0),
    Kind("cusum", 1.0, 1, 0.05), Kind("chi2", 1.0), Kind("containment", 0.0, 5), Kind("energy", 1.0, 5),
)  # fmt: skip


@pytest.fixture(scope="module")
def case() -> Case:
    plant = Tanks()

    def recorded(count: int, seed: int, fault: float = 0.0) -> list[Recorded]:
        return Recorded.of(plant.transients(count, seed, noise=1e-3, fault=fault), POINT)

    faulty = {"outlet × 10%": Faulty(recorded(4, 4, 0.1)[0], 51)}
    return Case("tanks", recorded(6, 1), recorded(20, 2), recorded(20, 3), faulty, 2, "per 100 recordings")


def test_a_rule_raises_the_alarm_where_its_score_exceeds_its_threshold(case):
    transients = [t for runs in case.fitted for t in runs.transients]
    model = fit(transients, additive="both", horizons=[5], widths="growing", operating_point=POINT)
    ours = our_rules(model, case.fitted, KINDS)
    runs = case.faulty["outlet × 10%"].runs
    for kind, (name, score) in zip(KINDS, ours.scores("ours").items(), strict=True):
        scores = score(runs)
        assert name == f"ours, {kind.name}"
        threshold = float(np.quantile(scores[np.isfinite(scores)], 0.7))
        rule = kind.rule(threshold, ours.step)
        rules = [rule] if isinstance(rule, AlarmRule) and rule.horizon == 1 else [AlarmRule(margin=1e9), rule]
        monitor = EnvelopeMonitor(model, rules=rules)
        for t, row in zip(runs.transients, scores, strict=True):
            raised = monitor.check(t).alarm
            assert raised.any(), kind
            assert np.array_equal(raised, row > threshold), kind


def test_five_hours_of_recordings_allow_five_alarms_at_one_per_hour():
    """Their steps add up to 4.999999999999999 h, of which a calibration once let four alarmed runs through."""
    empty = np.zeros((120, 1201, 0))
    learnt = [Recorded(empty, empty, np.full((120, 1200), 0.025)) for _ in range(5)]
    hours = sum(runs.hours for runs in learnt)
    assert hours < 5.0 and allowed_alarms(1.0, hours) == 5 and allowed_alarms(2.0, hours) == 10
    assert allowed_alarms(1.0, hours - 1e-6) == 4 and allowed_alarms(1.0, 0.0) == 0


def test_a_threshold_lets_as_many_recordings_through_as_it_may(case):
    law = LeastSquares.of(case.fitted)
    for score in residual_detectors(law, case.fitted, [Statistic("3 sigma"), Statistic("CUSUM", 0.5)]).values():
        threshold = threshold_of(case, score, case.allowed)
        assert sum(int((score(runs).max(axis=1) > threshold).sum()) for runs in case.learn) == case.allowed
        outcome = evaluate(case, score)
        assert outcome.alarmed == sum(int((score(runs).max(axis=1) > threshold).sum()) for runs in case.healthy)
        mean, low, high = outcome.rate
        assert low <= mean <= high and mean == pytest.approx(100 * outcome.alarmed / 20)
        (faulty,) = case.faulty.values()
        for t, row, delay in zip(
            faulty.runs.transients, score(faulty.runs), outcome.delays["outlet × 10%"], strict=True
        ):
            after = np.flatnonzero(row[faulty.first :] > threshold)
            assert delay == (
                pytest.approx(t.t[faulty.first + after[0]] - t.t[faulty.first - 1]) if len(after) else np.inf
            )


def test_what_is_tuned_keeps_to_the_alarms_allowed_and_is_the_monitors_alarm(case):
    transients = [t for runs in case.fitted for t in runs.transients]
    model = fit(transients, additive="both", horizons=[5], widths="growing", operating_point=POINT)
    tuned = as_tuned({"ours, 1 knot": model}, replace(case, within=1.0), [("energy",)])
    monitor = EnvelopeMonitor(model, rules=tuned.rules)
    alarmed = [monitor.check(t).alarm for runs in case.learn for t in runs.transients]
    assert sum(a.any() for a in alarmed) <= case.allowed
    (faulty,) = case.faulty.values()
    for t, row in zip(faulty.runs.transients, tuned.score(faulty.runs), strict=True):
        raised = monitor.check(t).alarm
        assert raised.any() and np.array_equal(raised, row > 1.0)
    assert "1 knot" in tuned.text


def test_the_peers_are_what_their_names_say():
    rng = np.random.default_rng(0)
    values = rng.standard_normal((2, 50, 3))
    for r in range(2):
        up, down = np.zeros(3), np.zeros(3)
        for k in range(50):
            up, down = np.maximum(0, up + values[r, k] - 0.5), np.maximum(0, down - values[r, k] - 0.5)
            assert cusum(values, 0.5)[r, k] == max(*up, *down)
    largest = of_window(values[..., 0], 3, 5)
    for k in range(4, 50):
        assert largest[1, k] == np.sort(values[1, k - 4 : k + 1, 0])[-3]


def test_least_squares_and_the_filter_find_a_linear_plant():
    rng = np.random.default_rng(1)
    A, B, dt = np.array([[-1.0, 0.3], [0.0, -2.0]]), np.array([[1.0], [0.5]]), 0.1
    x, u = np.zeros((3, 400, 2)), rng.standard_normal((3, 400, 1))
    for k in range(399):
        x[:, k + 1] = x[:, k] + dt * (x[:, k] @ A.T + u[:, k] @ B.T) + 1e-3 * rng.standard_normal((3, 2))
    read = x + 0.05 * rng.standard_normal(x.shape)
    steps = np.full((3, 399), dt)
    exact = LeastSquares.of([Runs(x, u, steps)])
    assert exact.theta.T == pytest.approx(np.column_stack([A, B, np.zeros(2)]), abs=0.02)
    noisy = [Runs(read, u, steps)]
    filtered = Kalman.likeliest(noisy, exact)(noisy[0])
    assert (filtered.std(axis=(0, 1)) < 0.85 * exact(noisy[0]).std(axis=(0, 1))).all()  # it averages the sensors' noise


def test_what_is_gathered_from_messages_in_order_is_what_was_recorded():
    run = transient(200, 1)
    z, t = np.hstack([run.x, run.u]).tolist(), [round(value, 6) for value in run.t.tolist()]
    n, count = run.x.shape[1], len(run) - 1
    in_order, late = arrivals(count, ""), arrivals(count, "control", seed=2)
    assert in_order[1] == [] and late[1]
    assert gathered(z, t, n, in_order[0]) == {t[k]: z[k] for k in range(count)}
    disturbed = gathered(z, t, n, late[0])
    for k in range(count - 1):
        there = [i for topic, i in late[0][: late[0].index(("state", k + 1))] if topic == "control"]
        assert disturbed[t[k]] == z[k][:n] + z[there[-1] if k in late[1] else k][n:]
    model = fit([run])
    for order, behind in (in_order, late):
        found, counters = verdicts(model, run, order)
        assert sorted(found) == t[2:count]  # the first sample is there before any control
        for k in range(2, count):
            _, start, values = found[t[k]]
            held = k - 1 in behind
            assert start == t[k - 1] and values == z[k - 1][:n] + z[k - 1 - held][n:]
        assert sum(count for key, count in counters.items() if key.startswith("late")) == len(behind)


def test_a_range_is_left_where_it_ends():
    assert formula_of([-1.0, 2.0], [1.0, 4.0]) == "abs((z0 - (0)) / 1.01) < 1 & abs((z1 - (3)) / 1.01) < 1"
    assert formula_of([0.0], [1.0], "H[0, 1] ({})").startswith("H[0, 1] (abs((z0 - (0.5)) / 0.505")


def test_levers_start_from_whole_angles_and_differ_by_seed():
    for seed in range(12):
        moves = profile(seed)
        assert moves[0][0] == 0.0 and all(60.0 <= angle <= 68.0 for _, angle in moves)
    assert profile(1) != profile(7)
    assert from_whole_degrees(((0.0, 63.4), (1.0, 63.4), (2.0, 66.1))) == ((0.0, 63.0), (1.0, 63.0), (2.0, 66.1))
