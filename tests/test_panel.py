# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The panel: what `fit` arms without being asked keeps to its promise, and what it says of its worth is so."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from refusals import refuses
from scipy.special import stdtrit

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI, fit
from uncertain_lti.base.errors import BagError, FitError
from uncertain_lti.identification import fitting
from uncertain_lti.identification.structure import Structure
from uncertain_lti.model.alarm_rule import JOINT, AlarmRule, StatisticRule
from uncertain_lti.model.domain import Domain
from uncertain_lti.model.horizon import Residuals
from uncertain_lti.reports.check import check_data
from uncertain_lti.reports.findings import findings
from uncertain_lti.validation import monitor_fit
from uncertain_lti.validation.detectable import _alarming
from uncertain_lti.validation.intervals import rate_interval
from uncertain_lti.validation.left_out import validate
from uncertain_lti.validation.panel import CONFIDENCE, Evidence, Panel, learn, promises, rules_for, sizes_of, worth
from uncertain_lti.validation.part import Reach, fitted_parts, rising
from uncertain_lti.validation.result import false_alarms

DT = 0.1


def plant(seed: int, steps: int = 600, bias: float = 0.0, width: float = 1.0, excited: bool = True) -> Transient:
    """Two coupled states with a control and noise; a bias of the first reading from half time on."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1, 1, steps // 20 + 1), 20)[: steps + 1, None] * excited
    x = np.zeros((steps + 1, 2))
    A, B = np.array([[-0.8, 0.3], [0.2, -1.1]]), np.array([[1.0], [0.5]])
    for k in range(steps):
        x[k + 1] = x[k] + DT * (A @ x[k] + B @ u[k])
    x += 0.01 * width * rng.standard_normal(x.shape) * excited
    x[steps // 2 :, 0] += bias
    return Transient(DT * np.arange(steps + 1), x, u, name=f"run {seed}")


@pytest.fixture(scope="module")
def runs():
    return [plant(seed) for seed in range(8)]


@pytest.fixture(scope="module")
def model(runs):
    return fit(runs)


def test_fit_alone_gives_a_panel_that_is_quiet_on_what_it_saw_and_sees_what_it_promises(model, runs):
    kinds = [(rule.kind, rule.window_s) for rule in model.alarm]
    assert kinds == [("energy", 0.0), ("energy", pytest.approx(1.05)), ("ewma", pytest.approx(10.05))]
    monitor, alarm = EnvelopeMonitor(model), model.fit_summary["alarm"]
    assert not any(monitor.check(run).alarm.any() for run in runs)
    assert alarm["worth"] == "good" and alarm["alarms"] == 0 and alarm["units"] == 8
    one_rule = rate_interval(np.zeros(8), alarm["hours"], 0.9, one_sided=True)[1]
    three_rules = rate_interval(np.full(8, 2 / 8), alarm["hours"], 0.9, one_sided=True)[1]
    assert alarm["limit_per_hour"] >= three_rules > one_rule
    seen = 0
    for seed in range(40):
        verdicts = monitor.check(plant(100 + seed, bias=(-1) ** seed * alarm["biases"][0]))
        first = np.flatnonzero(verdicts.alarm)
        seen += len(first) > 0 and first[0] == 300
    assert alarm["within"] == pytest.approx(DT) and seen >= 36  # nine of ten, as promised


@pytest.mark.parametrize(("long", "windows"), [(8, [1, 6, 30]), (9, [1, 10, 100])])
def test_of_ten_recordings_one_may_be_too_short_for_the_windows(long, windows):
    """Sixty verdicts hold ten windows of six, and two of thirty."""
    learnt = fit([plant(60, 60), *(plant(seed, 300) for seed in range(long))], "lp", additive="noise")
    assert [round(rule.window_s / DT - 0.5) if rule.window_s else 1 for rule in learnt.alarm] == windows


@pytest.mark.parametrize("count", [2, 3])
def test_what_few_short_recordings_promise_is_by_the_bounds_that_judge(count):
    """The models that leave one of them out have narrower ones."""
    few = fit([plant(seed, 100) for seed in range(count)])
    (size, _), monitor = few.fit_summary["alarm"]["biases"], EnvelopeMonitor(few)
    assert sum(monitor.check(plant(100 + i, bias=(-1) ** i * size)).alarm[300] for i in range(40)) >= 36


def test_a_slow_average_takes_four_recordings_that_say_how_far_they_differ(runs):
    for count, slow in ((1, {"mewma", "chi2"}), (3, {"mewma", "chi2"}), (4, {"ewma"})):
        assert {rule.kind for rule in fit(runs[:count], "lp", additive="noise").alarm} == {"energy", *slow}
    alone = [Transient(run.t, run.x[:, :1], run.u) for run in runs]
    one_state = fit(alone, "lp", additive="noise")
    assert [rule.kind for rule in one_state.alarm] == ["energy", "energy", "ewma"]
    assert len(one_state.residuals.forms) == 1  # no rule of it asks which form is better: the first is kept


def test_the_form_of_the_residuals_is_that_whose_threshold_encloses_less(runs):
    """Spread that grows with the control is told by half-widths; noise of readings is the same everywhere."""
    rng, u = np.random.default_rng(1), np.repeat([1.0, 0.05] * 30, 25)[:, None]
    x = np.zeros((len(u), 2))
    for k in range(len(u) - 1):
        x[k + 1] = 0.5 * x[k] + u[k] * (1.0 + 0.2 * rng.uniform(-1, 1, 2))
    uneven = fit(Transient(DT * np.arange(len(u)), x, u), "qp", additive="none")
    even = fit(runs[:1], "lp", additive="noise")
    for model, relative, slow in ((uneven, True, "mean"), (even, False, "mewma")):
        assert model.residuals.relative == relative and len(model.residuals.forms) == 1
        assert (model.residuals.law is None) == relative
        assert [rule.kind for rule in model.alarm] == ["energy", "energy", slow, "chi2"]


def test_a_law_does_without_what_nothing_depends_on_and_is_none_where_more_is_said(runs):
    """A base that counts how far its wheels turned saw no slow slip, as nothing may depend on the counts."""
    (t, x, u), n, m = (runs[0].t, runs[0].x, runs[0].u), 3, runs[0].u.shape[1]
    counted = Transient(t, np.hstack([DT * np.cumsum(x[:, :1], axis=0), x]), u)
    column = np.array([[0.0, np.nan, np.nan]] * n)
    free = Structure(n, m, {"A": column, "dA": column})
    bounded = Structure(n, m, {"A": column, "dA": column}, upper={"A": np.full((n, n), 1e6)})
    law = fitting.fit(counted, "lp", additive="noise", structure=free).residuals.other.law
    assert (law.A[:, 0] == 0.0).all() and (law.A[:, 1:] != 0.0).all()
    assert fitting.fit(counted, "lp", additive="noise", structure=bounded).residuals.other is None


def test_a_jump_that_only_both_of_two_alike_tell_counts(runs):
    rng, alike = np.random.default_rng(2), []
    for run in runs[:2]:
        other = run.x[:, :1] + 1e-4 * rng.normal(size=(len(run), 1))
        alike.append(run.replace(x=np.hstack([run.x[:, :1], other])))
    few = fit(alike[:1], "lp", additive="noise")
    size = few.fit_summary["alarm"]["biases"][1]
    alone = fit(Transient(runs[0].t, runs[0].x[:, :1], runs[0].u), "lp", additive="noise")
    assert size < 0.1 * alone.fit_summary["alarm"]["biases"][0]
    x = alike[1].x.copy()
    x[300:, 1] += size
    assert EnvelopeMonitor(few).check(alike[1].replace(x=x)).alarm[300]


def test_what_is_learnt_by_a_law_is_judged_by_it_where_it_is_injected_and_after_an_update(runs):
    model = fit(runs[:1], "lp", additive="noise")
    own = fitting.fit(runs[1:2], "lp", additive="noise")
    assert own.residuals.relative and _alarming(own, model).residuals.form == model.residuals.form == (False, True)
    later = model.update(runs[1:2])
    for name in ("covariance", "memory"):
        assert np.array_equal(getattr(later.residuals, name), getattr(model.residuals, name))
    assert np.array_equal(later.residuals.law.A, model.residuals.law.A)


def test_residuals_are_counted_from_the_law_only_where_the_model_has_taken_it(runs, tmp_path):
    """A model as fitted is as its file has it, and thresholds of an older file are for distances from the centre."""
    plain = fit(runs[:3], "lp", additive="noise", alarm="containment")
    plain.save(tmp_path / "m.json")
    fresh, read = (EnvelopeMonitor(m).check(runs[3]).residual for m in (plain, UncertainLTI.load(tmp_path / "m.json")))
    assert fresh.tobytes() == read.tobytes()
    old = plain.replace(residuals=Residuals(plain.residuals.mean, plain.residuals.covariance, relative=False))
    for part in validate(old, runs[:3]).parts:
        steps = part.transient.transitions()
        centre, _ = part.model.columns_centre_and_half(part.model.normalised_columns(steps), steps.dt)
        assert part.residual == pytest.approx(steps.x_next - centre.T, abs=1e-12)


def test_flags_stay_those_of_the_bounds(model, runs):
    """The alarm's thresholds are no margin of the flags."""
    verdicts = EnvelopeMonitor(model).check(runs[0])
    outside = (runs[0].x < verdicts.lower) | (runs[0].x > verdicts.upper)
    assert np.array_equal(outside[verdicts.judged], verdicts.flags[verdicts.judged] == 1.0)
    assert model.alarm_rule == AlarmRule()


def test_what_is_given_by_hand_is_what_one_gets(runs):
    paper = fit(runs, "qp", additive="none", alarm="containment")
    assert paper.alarm == (AlarmRule(),) and not paper.v.any() and paper.fit_summary["criterion"] == "qp"
    assert "alarm" not in paper.fit_summary
    own = (AlarmRule(2, 5), StatisticRule("energy", 1.0, 0.5))
    assert fit(runs, "lp", additive="noise", alarm=own).alarm == own
    refuses(FitError, "leave alarm or false_alarms out", fit, runs, alarm="containment", false_alarms=1.0)
    refuses(FitError, "it must be panel, containment", fit, runs, alarm="loud")


@pytest.fixture(scope="module")
def learnt(runs):
    """A model without an alarm, what leaving out gave, and the panel learnt of it."""
    full = fitting.fit(runs, "lp", additive="noise", describe_data=False)
    left = validate(runs, full=full, operating_point=full.operating_point, criterion="lp", additive="noise")
    return full, left, learn(left, fitted_parts(full, runs))


def test_thresholds_are_the_largest_sizes_with_an_allowance(learnt, runs):
    """By the formulas of the statistics over the whole record, in numpy."""
    full, left, panel = learnt
    sample, energy = (rule for rule in panel.rules if rule.kind == "energy")
    parts = left.parts
    inside = [full_utilisation(full, run) for run in runs]
    logs = np.log([np.abs(p.utilisation).max(axis=0) for p in parts])
    spread = stdtrit(7, 0.9) * math.sqrt((1 + 1 / 8) * logs.var(axis=0, ddof=1).mean())
    for i in range(2):
        every = np.concatenate([np.abs(u[:, i]) for u in [*(p.utilisation for p in parts), *inside]])
        N, top = len(every) / 2, every.max()
        allowance = math.sqrt(math.log(N * 2) / math.log(N))
        expected = np.median(every) + allowance * (top - np.median(every))
        expected = max(expected, math.exp(logs[:, i].mean() + spread))
        assert math.sqrt(sample.thresholds(2)[i]) == pytest.approx(expected, rel=1e-9)
        window = [np.convolve(p.utilisation[:, i] ** 2, np.ones(10) / 10, "valid").max() for p in parts]
        assert energy.thresholds(2)[i] > max(window) * (1 - 0.06)  # a window of 10.5 steps
    rules, evidence = [replace(rule, threshold=1.0) for rule in panel.rules], panel.evidence
    limits = np.concatenate(evidence.thresholds(rules, 2, "recording"))
    few = (np.concatenate(replace(evidence, verdicts=v).thresholds(rules, 2, "recording")) for v in (2.0, 6.0))
    assert np.array_equal(*few), "three windows are the fewest that an allowance is for"
    levels = [(sizes_of(rules, part) / limits).max(axis=1) for part in parts]
    near = min(1.0, max(0.95 * sorted(each.max() for each in levels)[-3], 0.75))  # just below the third largest
    assert evidence.near.tolist() == [rising(v > near, p.starts) for v, p in zip(levels, parts, strict=True)]
    weights = [part.judged for part in parts]
    half = np.average([part.usual_width for part in parts], axis=0, weights=weights) / 2
    middle = np.median(np.abs(np.concatenate([*(p.utilisation for p in parts), *inside])), axis=0)
    np.testing.assert_allclose(panel.biases, half * (np.sqrt(sample.thresholds(2)) + 2 * middle), rtol=1e-12)
    middle_half = np.average([part.median_width for part in parts], axis=0, weights=weights) / 2
    offsets = middle_half * np.sqrt(energy.thresholds(2))
    assert panel.figure == pytest.approx(np.exp(np.log(offsets).mean()), rel=1e-12)
    assert evidence.dt == pytest.approx(DT)


@pytest.mark.parametrize(
    ("what", "count", "verdicts", "taken"),
    [
        ("recording", 1, 4000, "a"),
        ("recording", 2, 4000, "a"),
        ("recording", 3, 4000, "an"),
        ("recording", 3, 400, "asn"),
        ("recording", 4, 4000, "an"),
        ("recording", 4, 400, "asn"),
        ("block", 5, 4000, "an"),
        ("block", 5, 400, "as"),
    ],
)
def test_thresholds_follow_from_the_evidence(what, count, verdicts, taken):
    """A window of ten steps, so 200 windows or 20, which are few: with an allowance, shared, and of the next one."""
    peaks, top, windows = np.ones((count, 2)), np.array([4.0, 8.0]), verdicts / 2 / 10
    peaks[1::2, 1] = 8.0
    logs = np.log(peaks)
    spread = math.sqrt((1 + 1 / count) * logs.var(axis=0, ddof=min(1, count - 1)).mean())
    far = stdtrit(max(1, count - 1), 0.95 if what == "block" else 0.9) * spread
    limits = {
        "a": 0.5 + math.sqrt(math.log(2 * windows) / math.log(windows)) * (top - 0.5),
        "s": np.exp(logs.mean(axis=0)) * 4.0,
        "n": np.exp(logs.mean(axis=0) + far),
    }
    limits["n"] = np.minimum(limits["n"], 1.5 * np.max([limits[kind] for kind in taken if kind != "n"], axis=0))
    one, rule = Evidence(peaks, top, np.full(2, 0.5), verdicts, np.ones((2, 2)), 1, 1, DT), StatisticRule("mean", 1, 1)
    (found,) = one.thresholds([rule], 2, what)
    above = 1.0 + 1e-10  # so that no rounding passes it
    unknown = 1.5 if count <= 2 else 1.0  # how far two recordings differ
    np.testing.assert_allclose(found, unknown * above * np.max([limits[kind] for kind in taken], axis=0), rtol=1e-12)
    assert one.learnt([rule], what)[0].threshold == tuple(found)
    assert one.learnt([StatisticRule("energy", 1, 1)], what)[0].threshold == tuple(found**2)


def test_what_never_moved_or_lies_far_outside_leaves_thresholds_alone():
    """A part that the others do not cover has no size, a state at rest in one part none there."""
    rng, rule = np.random.default_rng(0), StatisticRule("energy", 1, 1)
    peaks = np.exp(0.1 * rng.standard_normal((6, 2)))
    both = [*peaks, np.full(2, 1e-9)], np.vstack([peaks, [1e-9, peaks[0, 1]]])
    for more in (np.array(both[0]), both[1]):
        for what, verdicts in (("recording", 4000), ("block", 4000), ("block", 400)):
            rest = peaks.max(axis=0), np.full(2, 0.2), verdicts, np.ones((2, 2)), 1, 1, DT
            (one,), (other,) = (Evidence(p, *rest).thresholds([rule], 2, what) for p in (peaks, more))
            np.testing.assert_allclose(other, one, rtol=0.05)


def test_evidence_of_more_recordings_adds_up():
    """Medians by their verdicts, and widths by those that were left out."""
    one = Evidence(np.ones((2, 1)), np.full(1, 2.0), np.ones(1), 300, np.array([[1.0], [2.0]]), 100, 1.0, DT)
    both = one + Evidence(np.ones((3, 1)), np.ones(1), np.full(1, 5.0), 100, np.array([[3.0], [6.0]]), 300, 2.0, DT)
    assert (both.peaks.shape, both.top, both.median, both.verdicts) == ((5, 1), 2.0, 2.0, 400)
    assert (both.widths.tolist(), both.judged, both.hours) == ([[2.5], [5.0]], 400, 3.0)


def test_the_limit_counts_a_cluster_of_alarms_for_every_rule_but_one():
    rules = [StatisticRule("energy", window, 1) for window in (0, 1, 3)]
    counts, near = np.array([0.0, 1.0, 0.0, 0.0]), np.array([0.0, 3.0, 1.0, 0.0])  # clusters of (9 + 1) / 4
    one = Evidence(np.ones((4, 6)), np.ones(6), np.ones(6), 400, np.ones((2, 2)), 1, 5.0, DT, 1.0, counts, near)
    limit = rate_interval(counts + 2 * 2.5 / 4, 5.0, CONFIDENCE, 2.5, one_sided=True)[1]
    zero, column = np.zeros((2, 2)), np.zeros((2, 1))
    model = UncertainLTI(zero, column, zero, column, v=np.ones(2))
    assert Panel.of(model, one, rules, "recording", (), None).limit == pytest.approx(limit, rel=1e-12)


def test_false_alarms_are_counted_per_hour_of_verdicts(learnt):
    """A margin that some verdicts of the left-out recordings exceed, counted in numpy."""
    parts = learnt[1].parts
    sizes = [np.abs(part.utilisation).max(axis=1) for part in parts]
    rule = AlarmRule(margin=float(np.quantile(np.concatenate(sizes), 0.995)))
    over = [size > rule.margin for size in sizes]
    alarms = sum(int(np.count_nonzero(np.diff(each.astype(int), prepend=0) == 1)) for each in over)
    hours = DT * sum(map(len, sizes)) / 3600
    found = false_alarms(parts, [rule], 0.9)
    assert found["alarms"] == alarms > 5 and found["parts_with_alarm"] == sum(each.any() for each in over)
    assert found["per_hour"] == pytest.approx(alarms / hours)
    assert found["raised_share"] == pytest.approx(np.concatenate(over).mean())
    assert found["interval"][0] < found["per_hour"] < found["interval"][1]


def full_utilisation(model: UncertainLTI, run: Transient) -> np.ndarray:
    verdicts = EnvelopeMonitor(model).check(run)
    return verdicts.utilisation[verdicts.judged]


def test_a_rate_moves_thresholds_as_far_as_the_recordings_can_show_it(runs):
    quiet = fit(runs, "lp", additive="noise")
    rate = 10 * quiet.fit_summary["alarm"]["limit_per_hour"]
    asked = fit(runs, "lp", additive="noise", false_alarms=rate)
    assert asked.fit_summary["alarm"]["limit_per_hour"] <= rate
    pairs = zip(asked.alarm, quiet.alarm, strict=True)
    assert all((np.array(a.thresholds(2)) < np.array(b.thresholds(2))).all() for a, b in pairs)
    little = fit(runs, "lp", additive="noise", false_alarms=1e-3)
    raised = [np.divide(a.thresholds(2), b.thresholds(2)) for a, b in zip(little.alarm, quiet.alarm, strict=True)]
    evidence = Evidence.from_dict(quiet.memory["evidence"])
    rules = [replace(rule, threshold=1.0) for rule in quiet.alarm]
    factor = evidence.apart(rules, "transients").max()
    assert 1.0 < factor < 1.5 and quiet.fit_summary["alarm"]["units_alarming"] > 0
    assert np.concatenate(raised) == pytest.approx(factor**2)  # squares of sizes
    assert little.fit_summary["alarm"]["units_alarming"] == 0
    said = little.fit_summary["alarm"]["promises"][-1]
    assert "cannot show that" in said and "days more without an alarm would" in said
    refuses(FitError, "positive number per hour", fit, runs, false_alarms=-1.0, progress=pytest.fail)  # before the work


def test_the_hours_that_would_show_a_rate_show_it():
    hours, asked = 6.0, 0.1
    limit = rate_interval(np.zeros(8), hours, CONFIDENCE, one_sided=True)[1]
    evidence = Evidence(np.ones((8, 1)), np.ones(1), np.ones(1), 100, np.ones((2, 1)), 100, hours, DT)
    panel = Panel((), limit, "recording", np.ones(1), 1.0, evidence, asked=asked)
    needed = panel.needed_hours
    assert needed > hours and rate_interval(np.zeros(8), needed, CONFIDENCE, one_sided=True)[1] == pytest.approx(asked)


@pytest.mark.parametrize("n", [1, 2])
def test_states_are_judged_together_only_where_two_have_residuals_that_were_kept(n):
    zero, column = np.zeros((n, n)), np.zeros((n, 1))
    kinds = {rule.kind for rule in rules_for(UncertainLTI(zero, column, zero, column, v=np.ones(n)), 1000, 0.1)}
    assert {"energy", "mean"} <= kinds and not set(JOINT) & kinds


def test_a_single_recording_is_left_out_in_blocks_and_little_is_said_to_be_little():
    model = fit(plant(1))
    assert model.validation["kind"] == "blocks" and model.fit_summary["alarm"]["units"] == 5
    few = fit(plant(1, steps=8))
    assert "not_learnt" in few.fit_summary["alarm"] and few.alarm == (AlarmRule(),)


@pytest.mark.parametrize("steps", [20, 45])
def test_few_steps_give_a_panel_or_a_reason(steps):
    run = plant(2, steps=steps)
    alarm = fit(Transient(run.t, run.x[:, :1], run.u)).fit_summary["alarm"]
    assert ("biases" in alarm) != ("not_learnt" in alarm)


def test_windows_are_at_most_a_tenth_of_what_was_left_out(learnt):
    for steps in (5, 40, 95, 1000):
        for rule in [*rules_for(learnt[0], steps, DT), *rules_for(learnt[0], steps, DT, apart=True)]:
            window = round(rule.window_s / DT - 0.5) if rule.window_s else 1
            assert window <= max(steps / {"energy": 10, "mean": 3, "mewma": 3, "chi2": 3, "ewma": 2}[rule.kind], 1)


def test_a_rare_event_of_one_recording_does_not_silence_the_alarm(runs):
    """A control that moves in one stretch alone: how a model without it bounds it says nothing of the model of all."""

    def with_switch(run: Transient, on: bool) -> Transient:
        switch = np.zeros((len(run), 1))
        x = run.x.copy()
        if on:
            switch[200:260] = 1.0
            x[201:, 0] += np.minimum(np.arange(len(run) - 201), 60) * 0.5 * DT
        return Transient(run.t, x, np.hstack([run.u, switch]), name=run.name)

    without = fit([with_switch(run, False) for run in runs], "lp", additive="noise")
    rare = fit([with_switch(run, number == 3) for number, run in enumerate(runs)], "lp", additive="noise")
    assert rare.fit_summary["alarm"]["biases"][1] < 2 * without.fit_summary["alarm"]["biases"][1]


def test_a_recording_does_not_vouch_for_itself():
    one, other = plant(1), plant(2)
    with pytest.raises(BagError, match="holds the samples of .*; name each recording once"):
        fit([one, other, one])


def test_what_is_not_worth_having_is_said_first():
    still = fit([plant(seed, excited=False) for seed in range(3)], "lp", additive="noise")
    assert still.fit_summary["alarm"]["worth"] == "none"
    assert still.fit_summary["alarm"]["headline"].startswith("not worth having: nothing that is judged moves")


def test_what_was_left_out_vouches_unless_more_than_a_third_stand_alone(learnt):
    _, _, panel = learnt
    three = replace(panel, evidence=replace(panel.evidence, peaks=panel.evidence.peaks[:3]))
    assert [replace(three, unlike=("a",) * count).vouched for count in range(3)] == [True, True, False]


@pytest.mark.parametrize(
    ("shares", "kind", "words"),
    [
        ((0.02, 0.4), "good", "worth having: it sees jumps of 2 to 40 % of the recorded ranges"),
        (
            (0.02, 0.9),
            "good",
            "worth having: it sees jumps of 2 to 90 % of the recorded ranges, large ones alone of x2",
        ),
        ((2e-7, 0.996), "good", "worth having: it sees jumps of 0.00002 to 100 % of the recorded ranges, large"),
        ((0.6, 0.9), "some", "worth little: it sees jumps of 60 to 90 % of the recorded ranges only, which a plot "),
        ((0.02, 1.1), "some", "sees only x1: of x2 not even a jump of the whole recorded range"),
    ],
)
def test_a_monitor_that_sees_large_jumps_alone_is_not_praised(learnt, shares, kind, words):
    full, _, panel = learnt
    span = (full.domain.x_max - full.domain.x_min) * full.operating_point.X
    found = worth(full, replace(panel, biases=span * shares, unlike=()))
    assert found[0] == kind and found[1].startswith(words)
    assert "large" in words or "large" not in found[1]
    if kind == "good":  # where a third of the recordings, or most, would alarm at thresholds of the others
        panel, units = replace(panel, biases=span * shares, unlike=()), panel.units
        third = -(-units // 3)
        for alarming, said in ((third - 1, ""), (third, f"in {third} of {units} healthy"), (units, "in most healthy")):
            panel.__dict__["reached"] = np.where(np.arange(units) < alarming, 2.0, 0.5)
            assert panel.alarming == alarming and worth(full, panel)[0] == ("some" if said else "good")
            assert f"expect an alarm {said}" * bool(said) in worth(full, panel)[1]


def one_noisier(seed: int, noisier: int, states: int = 12) -> Transient:
    """States of their own, of which one has half as much noise again."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=(60, 1)), 25, axis=0)
    noise = 0.02 * rng.normal(size=(len(u), states))
    noise[:, noisier] *= 1.5
    x = np.zeros((len(u), states))
    for k in range(len(u) - 1):
        x[k + 1] = 0.9 * x[k] + 0.1 * u[k] + noise[k]
    return Transient(DT * np.arange(len(u)), x, u)


def test_thresholds_rise_where_nearly_every_recording_passes_those_of_the_others(learnt):
    """Of a hexapod with 36 states 5 of 6 did, and 6 of 9 healthy recordings were in alarm."""
    runs = [one_noisier(seed, seed) for seed in range(6)]
    model = fit(runs, "lp", additive="noise")
    evidence = Evidence.from_dict(model.memory["evidence"])
    what = model.fit_summary["alarm"]["what"]
    plain = model.replace(alarm=replace(evidence, factor=1.0).learnt(model.alarm, what))
    far = evidence.apart(plain.alarm, what)
    assert (far > 1.0).sum() > 4 and evidence.factor == far.max() < 1.5
    for rule, lower in zip(model.alarm, plain.alarm, strict=True):
        raised = np.divide(rule.thresholds(12), lower.thresholds(12))
        assert raised == pytest.approx(evidence.factor ** (1 if rule.kind == "mean" else 2), rel=1e-12)
    told = model.fit_summary["alarm"]["promises"][1]
    assert f"{evidence.factor - 1.0:.0%} higher as most pass them, none of 6 recordings would alarm" in told
    further = [one_noisier(seed, 6 + seed % 6) for seed in range(30)]
    loud, quiet = (sum(EnvelopeMonitor(one).check(run).alarm.any() for run in further) for one in (plain, model))
    assert loud > 20 and quiet == 0
    assert Evidence.from_dict(model.update([*runs, further[0]]).memory["evidence"]).factor > 1.0
    assert learnt[2].evidence.factor == 1.0  # of recordings that are alike


@pytest.mark.parametrize("moved", [0.0, 0.002, None])
def test_quiet_of_a_machine_that_is_parked_says_nothing(model, moved):
    """The bounds of a drone on the ground were 140 times as wide as all that it did."""
    run = plant(1)
    if moved is not None:
        run = run.replace(x=np.linspace([-moved, -moved], [moved, moved], len(run)), u=0 * run.u)
    data = check_data(model, EnvelopeMonitor(model).check(run), samples=False)
    assert (data["outcome"] == "unknown") == (moved is not None) == data["reason"].startswith("nothing that is judged")


def test_one_recording_does_not_vouch_for_another_day(runs, learnt):
    told = "says nothing of another day: fit 4 or more, or expect alarms"
    alarm = fit(runs[:1], "lp", additive="noise").fit_summary["alarm"]
    assert alarm["what"] == "block" and alarm["worth"] == "some" and told in alarm["headline"]
    full, _, panel = learnt
    for what in ("block", "recording"):  # also where some of its blocks are unlike the others
        kind, words = worth(full, replace(panel, unlike=("part",), what=what))
        assert kind == "some" and "not repeat" in words and (told in words) == (what == "block")
        blind = np.where(np.arange(full.n) == 0, math.inf, panel.biases)  # also where a state is hardly judged
        kind, words = worth(full, replace(panel, biases=blind, what=what))
        assert kind == "some" and words.startswith("sees only") and (told in words) == (what == "block")


def test_a_combination_that_the_others_lack_is_far_though_each_signal_is_in_its_range():
    rng, zero = np.random.default_rng(0), [[0.0]]
    x = rng.uniform(-1, 1, (200, 1))
    seen = Transient(DT * np.arange(200), x, x + 0.01 * rng.normal(size=(200, 1)))
    reach = Reach(UncertainLTI(zero, zero, zero, zero, v=[1.0]), [seen])
    for u, level in ((0.5, 0), (-0.5, 2)):
        assert reach.level(Transient([0.0, DT], [[0.5]] * 2, [[u]] * 2).transitions()).tolist() == [level]


def test_what_has_no_range_to_leave_is_never_far():
    """Where a count has got to says nothing: of wheels that were driven on, every model was unproven."""
    zero, t = np.zeros((1, 1)), DT * np.arange(200)
    none = UncertainLTI(zero, zero, zero, zero, v=[1.0], domain=Domain([0], [1], [0], [1], anywhere=[True, False]))
    count, u = np.cumsum(np.ones((200, 1)), axis=0), np.random.default_rng(0).uniform(size=(200, 1))
    reach = Reach(none, [Transient(t, count, u)])
    assert not reach.level(Transient(t, count + 1e4, u).transitions()).any()
    assert (reach.level(Transient(t, count, u + 9.0).transitions()) == 2).all()


@pytest.mark.parametrize(("share", "named"), [(0.3, 0), (0.4, 1)])
def test_a_recording_of_which_more_than_a_third_is_beyond_the_others_does_not_repeat_them(learnt, runs, share, named):
    full, left, _ = learnt
    first, *others = left.parts
    far = (np.arange(first.judged) < share * first.judged).astype(np.intp)
    given = replace(left, parts=[replace(first, extrapolated=far), *others])
    panel = learn(given, fitted_parts(full, runs))
    assert panel.unlike == (first.name,) * named
    assert (f" not repeat what the others show ({first.name})," in worth(full, panel)[1]) == bool(named)
    # that third was not counted: an excavator was promised one alarm in seven at most, and had seven in eight
    (told,) = [sentence for sentence in promises(full, panel) if "of further ones" in sentence]
    assert (" within what they cover, " in told) == ("further ones that stay there" in told) == bool(named)


def test_recordings_that_do_not_repeat_one_another_are_named(runs):
    apart = [runs[0], runs[1].replace(x=runs[1].x + 5.0), runs[2].replace(x=runs[2].x - 5.0)]
    model = fit(apart, "lp", additive="both")
    alarm = model.fit_summary["alarm"]
    assert alarm["worth"] == "unproven" and len(alarm["unlike"]) >= 2
    assert alarm["headline"].startswith("unproven: 2 recordings of 3 do not repeat what the others show")
    swapped = np.roll(runs[0].x, 1, axis=1)
    checked = [EnvelopeMonitor(model).check(run) for run in (runs[0], runs[0].replace(x=swapped))]
    quiet, loud = (check_data(model, verdicts) for verdicts in checked)
    reasons = findings(model, "machine.model.json", checked)["rely"]["reasons"]
    assert [r["weight"] for r in reasons if r["about"] == "alarm"] == ["unknown"]
    assert (quiet["outcome"], quiet["reason"]) == ("quiet", "")
    assert loud["outcome"] == "alarm" and loud["reason"] == f"the model is {alarm['headline']}"


def far_from_0(at: float = 50.0) -> list[Transient]:
    """Far from 0, widths that grow with |x| are constants; errors of a rate are least near the usual state."""
    rng = np.random.default_rng(5)

    def run(seed: int) -> Transient:
        base = plant(seed)
        x = np.array(base.x)
        for k in range(len(x) - 1):
            rate = np.array([-0.8, -1.1]) * (1 + 0.4 * rng.uniform(-1, 1, 2))
            x[k + 1] = x[k] + DT * (rate * x[k] + np.array([1.0, 0.5]) * base.u[k])
        return Transient(base.t, x + at, base.u + at, name=base.name)

    return [run(seed) for seed in range(6)]


def test_deviations_are_measured_from_the_medians_where_that_sees_clearly_smaller_jumps():
    far = far_from_0()
    model = fit(far)
    assert model.fit_summary["alarm"]["centred"] and model.fit_summary["criterion"] == "qp"
    assert np.allclose(model.operating_point.x_s, np.median(np.concatenate([t.x for t in far]), axis=0))
    assert any("medians of the recordings" in line for line in model.fit_summary["messages"])
    kept = fit(far, "lp", additive="noise")
    assert model.fit_summary["alarm"]["figure"] < 0.9 * kept.fit_summary["alarm"]["figure"]
    assert not kept.operating_point.x_s.any() and "centred" not in kept.fit_summary["alarm"]
    near = far_from_0(0.0)
    assert np.allclose(fit(near).operating_point.x_s, 0.0, atol=0.5)


def test_the_promising_way_is_fitted_again_from_its_fit_to_all(monkeypatch):
    started, given = [], monitor_fit.fit

    def noted(transients, near=None, **options):
        model = given(transients, near=near, **options)
        started.append(near is not None and bool((near.A == model.A).all()))
        return model

    monkeypatch.setattr(monitor_fit, "fit", noted)
    fit(far_from_0())
    assert started == [False, False, False, True]


def test_ways_of_machines_too_large_to_leave_out_are_compared_on_some_states(monkeypatch):
    far = far_from_0()
    sizes, given = [], monitor_fit.fit

    def noted(transients, **options):
        sizes.append(transients[0].x.shape[1])
        return given(transients, **options)

    monkeypatch.setattr(monitor_fit, "LIMIT", 10.0)
    every = fit(far)
    monkeypatch.setattr(monitor_fit, "STATES", 1)
    monkeypatch.setattr(monitor_fit, "fit", noted)
    model = fit(far)
    assert sizes == [1, 1, 1, 2] and model.alarm == every.alarm
    assert model.fit_summary["alarm"]["centred"] and (model.A == every.A).all()


def test_ways_that_state_the_same_problem_are_fitted_once(runs, monkeypatch):
    """With steps of one length, noise and disturbance are one term."""
    asked, given = [], monitor_fit.fit

    def noted(transients, **options):
        asked.append((options["criterion"], options["additive"]))
        return given(transients, **options)

    monkeypatch.setattr(monitor_fit, "fit", noted)
    late = [Transient(run.t * (1.0 + run.t), run.x, run.u, name=run.name) for run in runs]
    for some, options, there in ((runs, {}, False), (late, {}, True), (runs, {"additive": "both"}, True)):
        asked.clear()
        fit(some, **options)
        assert (("lp", "both") in asked) is there and ("qp", "both") in asked


def test_groups_are_left_out_whole(runs):
    model = fit(runs, "lp", additive="noise", groups=[0, 0, 1, 1, 2, 2, 3, 3])
    assert model.fit_summary["alarm"]["units"] == 4 and model.fit_summary["alarm"]["what"] == "group"


def test_large_problems_are_armed_by_what_was_fitted(runs, monkeypatch):
    monkeypatch.setattr("uncertain_lti.validation.monitor_fit.LIMIT", 10.0)
    model = fit(runs, "lp", additive="noise")
    alarm = model.fit_summary["alarm"]
    assert "learnt on fitted data" in alarm["note"] and len(model.alarm) == 3
    assert " fitted (8 recordings)" in alarm["promises"][0] and "left out" not in alarm["promises"][0]
    assert not any(EnvelopeMonitor(model).check(run).alarm.any() for run in runs)


def test_as_many_recordings_are_counted_as_alarm_by_what_the_others_show(runs):
    """Against fits of the others with their own panels, each checked on the one that they lack."""
    named = [
        run.replace(x=run.x + (k == 2) * 0.3 * np.sin(np.arange(len(run)))[:, None], name=f"day {k}")
        for k, run in enumerate(runs[:6])
    ]
    alarm = fit(named, "lp", additive="both").fit_summary["alarm"]
    others = [fit(named[:k] + named[k + 1 :], "lp", additive="both") for k in range(len(named))]
    loud = [EnvelopeMonitor(m).check(run).alarm.any() for m, run in zip(others, named, strict=True)]
    assert loud[2] and alarm["units_alarming"] == sum(loud) == 1
    assert re.search(
        r" 1 of 6 recordings would alarm, day 2 farthest at \d\S* times \(was the machine healthy in it,",
        alarm["promises"][1],
    )
    rate = float(re.search(r"--false-alarms (\S+)\)", alarm["promises"][1])[1])  # one above what is shown lowers them
    raised = fit(named, "lp", additive="both", false_alarms=rate)
    for rule, usual in zip(raised.alarm, fit(named, "lp", additive="both").alarm, strict=True):
        assert np.all(np.array(rule.threshold) > np.array(usual.threshold))


def test_states_that_are_blind_are_named(learnt):
    """Worth and promises follow from the sizes alone."""
    full, _, panel = learnt
    span = full.domain.x_max - full.domain.x_min
    blind = replace(panel, biases=np.array([panel.biases[0], 1.01 * span[1]]))
    assert worth(full, blind)[0] == "some" and worth(full, blind)[1].startswith("sees only x1: of x2")
    assert [worth(full, replace(panel, biases=share * span))[0] for share in (0.49, 0.99)] == ["good", "some"]
    assert worth(full, replace(panel, biases=1.01 * span))[0] == "none"
    assert "is over ten times the recorded range" in worth(full, replace(panel, biases=1e6 * span))[1]
    assert worth(full, replace(panel, biases=0.041 * span))[1].endswith("jumps of 4.1 % of the recorded range")
    assert "at most 1500 per hour with 90% confidence" in promises(full, replace(panel, limit=1523.0, asked=9.0))[0]
    assert "too little to say how rare they are" in promises(full, replace(panel, limit=1523.0))[0]
    assert "at most 15 per hour with 90% confidence" in promises(full, replace(panel, limit=15.23))[0]
    quiet = replace(panel.evidence, hours=0.008, counts=np.zeros(3), dt=0.5)
    assert "none in 28.8 s left out (8 rec" in promises(full, replace(panel, evidence=quiet))[0]
    far = promises(full, replace(panel, evidence=quiet, biases=np.array([0.25, 1.01]) * span))[2]
    assert far.startswith("sees within 0.5 s a jump of x1 ")
    assert far.endswith("; of x2 not even a jump of the whole recorded range"), "as the headline has it"
    said = promises(full, replace(panel, biases=11.0 * span))[2]
    assert said.endswith(" s of x1, x2 not even a jump of the whole recorded range")


def apart(seed: int) -> list[Transient]:
    """Each recording lies far outside what the other shows, so nothing that was left out says anything."""
    rng, t = np.random.default_rng(seed), np.arange(60) * 0.1
    return [Transient(t, c + 0.01 * rng.normal(size=(60, 1)), rng.normal(size=(60, 1))) for c in (1.0, 100.0)]


@pytest.mark.parametrize("seed", [2, 5, 8])
def test_what_a_threshold_is_learnt_from_does_not_pass_it_by_rounding(seed):
    model = fit(apart(seed))
    assert not any(EnvelopeMonitor(model).check(run).alarm.any() for run in apart(seed))


def test_recordings_far_from_one_another_give_a_panel_that_promises_no_rate():
    alarm = fit(apart(1), false_alarms=0.1).fit_summary["alarm"]
    assert alarm["hours"] == 0 and alarm["limit_per_hour"] is None
    assert "one stretch says nothing of their rate" in " ".join(alarm["promises"])
    assert alarm["promises"][-1].endswith("the recordings cannot show that; record more")


def test_where_nothing_repeats_the_simplest_way_to_fit_is_kept():
    """By its thresholds an additive term would be taken, and each comes from one recording."""
    taken = monitor_fit.choose_monitored(
        apart(0), [{"criterion": "qp", "additive": terms} for terms in ("none", "noise")]
    )
    assert taken.model.fit_summary["additive"] == "none"


def test_recordings_of_rates_far_apart_are_said_to_be_that():
    runs = [plant(seed) for seed in range(2)]
    slower = Transient(3 * runs[1].t, runs[1].x, runs[1].u, name="slower")
    assert (
        fit([Transient(runs[0].t[:1], runs[0].x[:1], runs[0].u[:1]), runs[0], slower])
        .fit_summary["alarm"]["not_learnt"]
        .endswith("fit recordings of one rate: the steps of these are of 0.1 to 0.3 s")
    )


def test_recordings_in_which_no_state_moves_give_a_model_that_says_so() -> None:
    rng = np.random.default_rng(1)
    still = Transient(0.025 * np.arange(300), np.full((300, 2), 5.0), rng.uniform(size=(300, 2)))
    alarm = fit([still]).fit_summary["alarm"]
    assert alarm["worth"] == "none" and "nothing that is judged moves in the recordings" in alarm["headline"]
