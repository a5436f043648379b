# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Rules of the alarm: in the model, and in its file."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from refusals import refuses

from uncertain_lti import Transient, UncertainLTI
from uncertain_lti.base.errors import ModelError
from uncertain_lti.identification import fit
from uncertain_lti.kernel.arithmetic import Window
from uncertain_lti.model.alarm_rule import AlarmRule, StatisticRule, labels
from uncertain_lti.model.horizon import Horizon, Residuals
from uncertain_lti.monitor.alarm import Alarm, Arming, Condition, Nearest, Raised, back_and_restarts, row_of, steps_back

ZEROS = np.zeros((2, 2))
RULES = (
    AlarmRule(2, 5, 1.5),
    StatisticRule("energy", 0.5, (0.2, 0.3)),
    StatisticRule("energy", 0.1, 0.5),
    StatisticRule("cusum", 1.0, 2.0, horizon=4, allowance=0.25),
    StatisticRule("chi2", 0.5, 7.0),
    StatisticRule("mewma", 0.2, 9.0),
    StatisticRule("chi2", 0.0, 8.0, horizon=4),
    AlarmRule(3, 4, 2.0, horizon=4),
)


def two_states(**options: Any) -> UncertainLTI:
    none, of_four = np.zeros((2, 0)), Residuals([0.0, 0.2], [[3.0, 0.5], [0.5, 2.0]])
    four = Horizon(4, ZEROS, none, ZEROS, none, v=[0.3, 0.3], widths="constant", residuals=of_four)
    known = Residuals([0.0, 0.1], [[1.0, 0.5], [0.5, 2.0]])
    return UncertainLTI(-np.eye(2), none, ZEROS, none, v=[0.1, 0.2], horizons=[four], residuals=known, **options)


def test_rules_of_a_kind_are_told_apart() -> None:
    assert labels(RULES) == ("containment", "energy", "energy#2", "cusum@4", "chi2", "mewma", "chi2@4", "containment@4")


def test_one_rule_for_one_step_stays_in_format_1() -> None:
    model = two_states(alarm_rule=AlarmRule(2, 3)).replace(horizons=(), residuals=None)
    data = model.to_dict()
    assert data["format"] == "uncertain-lti/1" and data["alarm"] == {"violations": 2, "window": 3, "margin": 1.0}
    refuses(ModelError, "unknown field 'alarm.rules'", UncertainLTI.from_dict, {**data, "alarm": {"rules": []}})


def test_the_containment_rule_is_replaced_among_the_others() -> None:
    model = two_states(alarm=RULES).replace(alarm_rule=AlarmRule(1, 2))
    assert model.alarm == (AlarmRule(1, 2), *RULES[1:])
    assert two_states(alarm=RULES[1:]).alarm_rule == AlarmRule(), "flags have margin 1 without a rule of their own"


@pytest.mark.parametrize(
    ("alarm", "words"),
    [
        ([], "0 rules; an alarm has 1 to"),
        ([AlarmRule(), AlarmRule(2, 2)], "two containment rules for one step"),
        ([StatisticRule("mean", 1.0, 1.0, horizon=3)], "mean is at 3 steps, and the model has bounds over 1, 4"),
        (["mean"], "alarm: a rule is of type str; give AlarmRule or StatisticRule"),
        ([StatisticRule("mean", 1.0, (1.0,) * 3)], "mean has 3 thresholds for 2 states"),
    ],
)
def test_an_alarm_that_cannot_be_is_refused(alarm: list[Any], words: str) -> None:
    refuses(ModelError, words, two_states, alarm=alarm)


def test_chi2_needs_the_covariance() -> None:
    with pytest.raises(ModelError, match="chi2 needs the covariance"):
        two_states().replace(residuals=None, alarm=[StatisticRule("chi2", 1.0, 1.0)])
    without = [two_states().horizons[0].with_residuals(None)]
    words = "mewma needs the covariance of the utilisation over 4 steps; fit the model again"
    with pytest.raises(ModelError, match=words):
        two_states().replace(horizons=without, alarm=[StatisticRule("mewma", 1.0, 1.0, horizon=4)])
    learnt = two_states().replace(horizons=without, residuals=None).with_residuals_of(two_states())
    assert learnt.replace(alarm=RULES).to_dict() == two_states(alarm=RULES).to_dict()


def test_a_state_that_follows_from_others_adds_nothing_to_the_chi_square() -> None:
    C = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    white = Residuals(np.zeros(3), C).whitening([True] * 3)
    assert np.array_equal(white, [[1.0, 0, 0], [0, 0, 0], [0, 0, 0]])
    of_one = np.outer(v := [3.0, 0.7, 1.9], v)  # rounding leaves 1e-16 of the others
    assert not Residuals(np.zeros(3), of_one).whitening([True] * 3)[1:].any()


@pytest.mark.parametrize("scheduled", [False, True])
def test_the_fit_stores_mean_and_covariance_of_its_utilisation(scheduled: bool) -> None:
    rng = np.random.default_rng(4)
    x = np.cumsum(rng.normal(size=(300, 2)) * [1.0, 3.0], axis=0) * 0.01
    run = Transient(np.arange(300) * 0.1, x, rng.normal(size=(300, 1)))
    model = fit([run], additive="noise", schedule={"x1": [-0.2, 0.2]} if scheduled else None)
    steps = run.transitions()
    centre, half = model.centre_and_half(steps.x, steps.u, steps.dt)
    r = (steps.x_next - centre) / half
    assert model.residuals is not None and model.residuals.relative
    assert model.residuals.mean == pytest.approx(r.mean(axis=0), abs=1e-12)
    assert model.residuals.covariance == pytest.approx(np.cov(r.T, bias=True), rel=1e-9)


def test_the_words_of_an_alarm_tell_rules_of_one_kind_by_their_windows() -> None:
    rules = [StatisticRule("energy", 0.1, 0.5), StatisticRule("energy", 2.0, 0.5), StatisticRule("mean", 0.0, 0.5)]
    alarm = Alarm(rules, two_states(), np.ones(2, dtype=bool))
    why = alarm.reasons([(0, -1), (1, -1), (2, -1)], [3.0, 0.0, 2.0, 0.0, 4.0, 0.0], ZEROS, np.zeros(2))
    assert [raised.words for raised in why] == [
        "energy of x1 (over 0.1 s) at 3 times its threshold",
        "energy of x1 (over 2 s) at 2 times its threshold",
        "mean of x1 at 4 times its threshold",
    ]


def test_the_nearest_statistic_is_the_one_with_the_largest_share_of_its_threshold() -> None:
    model = two_states()
    rule = StatisticRule("mean", 0.0, (2.0, 0.5))
    alarm = Alarm([rule], model, np.ones(2, dtype=bool))
    assert alarm.nearest(alarm.values()) == {}
    alarm.push(0.1, False, np.array([1.0, -0.4, 0.0, 0.0]))
    assert alarm.nearest(alarm.values()) == {"mean": Nearest("x2", pytest.approx(-0.4), 0.5)}


def test_the_farthest_statistic_is_that_of_all_verdicts_and_of_states_that_count() -> None:
    rules = [StatisticRule("energy", 0.1, 0.5), AlarmRule(2, 3), StatisticRule("mean", 0.0, 0.5)]
    values = np.array([[0.2, 0.3, 0.1, 5.0], [0.9, 3.0, -2.0, np.nan], [np.nan, np.nan, 1.0, -6.0]])
    for counted, k, raised in (
        ([True, True], 2, Raised("mean", "mean", 1, "x2", -6.0)),
        ([True, False], 1, Raised("mean", "mean", 1, "x1", -2.0)),
    ):
        assert Alarm(rules, two_states(), np.array(counted)).farthest(values) == (k, raised)
    assert Alarm(rules, two_states(), np.ones(2, dtype=bool)).farthest(np.full((3, 4), np.nan)) is None


def test_time_has_stepped_back_where_an_instant_is_not_after_the_one_before_the_last() -> None:
    """One stamp ahead, and one behind, end nothing."""
    assert [steps_back(t, 20, 10) for t in (9, 10, 11, 20, 21)] == [True, True, False, False, False]
    for stamps, back, restarts in (
        ((0, 10, 20, 10, 20), [3], [4]),
        ((0, 10, 99, 20, 30), [], []),
        ((0, 10, 20, 5, 30), [3], []),
        ((0, 10, 20, 5, 6, 7), [3], [4]),
    ):
        found = back_and_restarts(np.array(stamps))
        assert [np.flatnonzero(each).tolist() for each in found] == [back, restarts], stamps


def test_two_of_three_verdicts_of_a_horizon_and_no_verdict_changes_nothing() -> None:
    window = Window(2, 3, 1.5, (0, 1), 2)
    inside, beyond, none = ([9.0, 9.0, -1.5, 1.5], [0.0, 0.0, 0.0, -1.6], [9.0, 9.0, np.nan, np.nan])
    rows = np.array([inside, beyond, none, beyond, none, inside, inside, [0.0, 0.0, 1.6, np.nan], none])
    alarms = [window.push(True, row) for row in rows]
    assert alarms == [False, False, False, True, True, True, False, False, False]
    again, every = np.empty(len(rows), dtype=bool), np.ones(len(rows), dtype=bool)
    window.reset()
    window.push_all(every, rows[:, 2:], every, again)
    assert again.tolist() == alarms


def test_a_verdict_counts_while_the_condition_holds_and_its_grace_is_over() -> None:
    arming = Arming(Condition.parse("/machine/mode data >= 3"), 20)
    assert arming.why_off() == "alarms are off: it is not known whether /machine/mode data >= 3"
    arming.learn(float("nan"))
    assert arming.why_off() == "alarms are off: /machine/mode comes without a number in data" and arming.on is None
    arming.learn(2.5)
    assert arming.why_off() == "alarms are off until /machine/mode data >= 3" and not arming.at(90)
    arming.learn(3.0)
    assert arming.why_off() == "" and [arming.at(t) for t in (100, 119, 120)] == [False, False, True]
    arming.learn(4.0)  # it held already: the grace does not start over
    assert arming.at(121) and arming.at(110, steps_back=True), "a step back, perhaps alone, counts as the last one did"
    arming.learn(1.0)
    assert not arming.at(130) and not arming.at(125, steps_back=True)
    arming.learn(3.0)
    assert [arming.at(t) for t in (140, 159, 160)] == [False, False, True]
    said = [arming.said_on(Condition.parse(f"/machine/{which} < 7")) for which in ("mode data", "mode x", "x data")]
    assert said == [3.0, None, None]
    arming.restart(200)
    assert [arming.at(t) for t in (201, 219, 220)] == [False, False, True]
    arming.restart()
    assert [arming.at(t) for t in (300, 319, 320)] == [False, False, True]


def test_over_a_recording_a_value_counts_from_the_first_sample_decided_after_it() -> None:
    arming = Arming(Condition.parse("/machine/mode data == 3"), 0)
    armed = arming.over(np.arange(6), [2, 4], [3.0, 1.0])
    assert armed.counts.tolist() == [False, False, True, True, False, False]
    assert armed.cleared.tolist() == [True, True, False, False, True, True] and armed.asked.all()


def test_without_a_condition_alarms_count_from_the_first_verdict_or_after_the_grace() -> None:
    assert Arming(None, 0).at(5) and Arming(None, 0).why_off() == ""
    arming = Arming(None, 20)
    arming.restart(100)  # nothing was judged yet: the grace begins with the first verdict
    assert [arming.at(t) for t in (110, 129, 130)] == [False, False, True]
    known = Arming(Condition.parse("/machine/mode data == true"), 0, 1.0)
    assert known.on and known.at(7) and str(known.condition) == "/machine/mode data == 1"


def test_each_rule_names_the_states_that_it_blames() -> None:
    """Containment by the flags or its horizon's margin, a statistic beyond its threshold; masked ones never."""
    rules = [AlarmRule(1, 1), AlarmRule(1, 1, 2.0, horizon=4), StatisticRule("mean", 0.0, 1.0), RULES[4]]
    sizes, flags, values = np.array([[1.5, 0.5], [-2.0, 2.1]]), np.array([1.0, 0.0]), [1.0, -1.1, 7.0]
    alarm = Alarm(rules, two_states(), np.ones(2, dtype=bool))
    found = [
        (r.label, r.horizon, r.state, r.value) for r in alarm.reasons(enumerate([-1, -1, -1, 1]), values, sizes, flags)
    ]
    assert found == [
        ("containment", 1, "x1", 1.0), ("containment@4", 4, "x2", 1.0), ("mean", 1, "x2", -1.1), ("chi2", 1, "x2", 7.0),
    ]  # fmt: skip
    masked = Alarm(rules, two_states(), np.array([False, True])).reasons(enumerate([-1] * 3), values, sizes, flags)
    assert [(r.label, r.state) for r in masked] == [("containment", ""), ("containment@4", "x2"), ("mean", "x2")]
    (joint,) = Alarm(rules, two_states(), np.array([True, False])).reasons([(3, 0)], values, sizes, flags)
    assert joint.words == "chi2 of all states (points to x1) at 7 times its threshold"
    (nobody,) = alarm.reasons([(3, -1)], values, sizes, flags)
    assert nobody.words == "chi2 of all states at 7 times its threshold"
    over, below = (replace(nobody, value=value).words for value in (1.0004, 0.9996))
    assert "at 1.0004 times" in over and "at 0.9996 times" in below


PATHS = [("unwrap(data)", "unwrapping"), ("lag(data, 1)", "lag"), ("rate(data)", "rate")]


@pytest.mark.parametrize(("field", "what"), PATHS)
def test_a_condition_on_what_needs_a_history_is_refused(field: str, what: str) -> None:
    refuses(ModelError, f"cannot be compared, as {what} needs a history", Condition.parse, f"/machine/mode {field} > 1")


@pytest.mark.parametrize(("relative", "rows"), [((True, False), [0, 3]), ((False, True), [2, 1])])
def test_a_rule_of_all_states_looks_at_residuals_of_the_form_of_its_horizon(relative, rows) -> None:
    """Of the table, which has the utilisation of one step and of each horizon, and then the residuals likewise."""
    one, four = (Residuals([0, 0], np.eye(2), form) for form in relative)
    arrays = ZEROS, ZEROS[:, :1], ZEROS, ZEROS[:, :1]
    model = UncertainLTI(*arrays, v=[0.3, 0.3], residuals=one, horizons=[Horizon(4, *arrays, v=[1, 1], residuals=four)])
    assert [row_of(StatisticRule("chi2", 0.0, 1.0, horizon), model) for horizon in (1, 4)] == rows


def test_numbers_of_numpy_are_those_of_python():
    """As of a search over windows; a model file holds no others."""
    contained = AlarmRule(np.int64(2), np.int32(5), np.float32(1.5), np.int64(3))
    assert contained == AlarmRule(2, 5, 1.5, 3) and type(contained.window) is int
    statistic = StatisticRule("cusum", np.float32(0.5), np.float64(2.0), np.int64(3), np.float32(0.25))
    assert statistic == StatisticRule("cusum", 0.5, 2.0, 3, 0.25)
    assert {type(value) for value in statistic.to_dict().values()} == {str, int, float}
