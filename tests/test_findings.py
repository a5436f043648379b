# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Findings: their answers follow from the facts."""

import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_pages import by_hand

from uncertain_lti import EnvelopeMonitor, Transient
from uncertain_lti.base.text import beyond
from uncertain_lti.identification import fit
from uncertain_lti.model.alarm_rule import StatisticRule
from uncertain_lti.reports.check import APART
from uncertain_lti.reports.findings import CARE, NO, YES, findings, findings_text
from uncertain_lti.reports.pages import html_report


@given(st.lists(st.sampled_from("....vwnb"), min_size=2, max_size=120))
def test_episodes_hold_every_violation(letters):
    """v, w: a state jumps; n: a sample is missing; b: time steps back."""
    t = np.cumsum([-(10**10) if c == "b" else 10**7 for c in letters]) + 10**18
    x = np.zeros((len(letters), 2))
    for k, c in enumerate(letters):
        x[k:, 0] += 10.0 * (c == "v")
        x[k:, 1] += 10.0 * (c == "w")
    x[[c == "n" for c in letters]] = math.nan
    model = by_hand()
    verdicts = EnvelopeMonitor(model).check(Transient(t, x, np.zeros((len(letters), 1)), max_gap=0.1))
    (recording,) = findings(model, "m", [verdicts])["recordings"]
    episodes = recording["episodes"]
    bad = np.flatnonzero(verdicts.violated)
    assert recording["episode_count"] == len(episodes)
    assert sum(e["verdicts_violated"] for e in episodes) == len(bad) == recording["violated"]
    for e in episodes:
        inside = bad[(bad >= e["first"]["k"]) & (bad <= e["last"]["k"])]
        assert len(inside) == e["verdicts_violated"]
        assert (np.diff(np.cumsum(verdicts.judged)[inside]) <= APART).all()
        assert (np.diff(verdicts.transient.t_ns[e["first"]["k"] : e["last"]["k"] + 1]) > 0).all()
        for i, name in enumerate(model.state_names):
            count = int((verdicts.flags[inside, i] == 1).sum())
            assert e["states"].get(name, {"violations": 0})["violations"] == count
    for one, other in zip(episodes, episodes[1:], strict=False):
        between = int(verdicts.judged[one["last"]["k"] + 1 : other["first"]["k"] + 1].sum())
        stamps = verdicts.transient.t_ns[one["last"]["k"] : other["first"]["k"] + 1]
        assert between > APART or (np.diff(stamps) < 0).any()


def judged(widths, validation=None, **more):
    """Findings on a run of states that move between -1 and 1, by bounds of these half-widths."""
    rng = np.random.default_rng(3)
    n = len(widths)
    x = np.clip(np.cumsum(rng.uniform(-0.1, 0.1, (600, n)), axis=0), -1, 1)
    run = Transient(np.arange(600) * 0.01, x, np.zeros((600, 1)))
    model = fit([run], additive="noise").replace(A=-np.eye(n), B=np.zeros((n, 1)), v=np.array(widths))
    model = model.replace(fit_summary={"criterion": "qp"}, validation=validation or {}, **more)
    return findings(model, "m", [EnvelopeMonitor(model).check(run)])


def validated(parts_inside, parts, inside):
    """The section on validation of a model of two states."""
    state = {"inside": inside, "mean_width_left_out": 0.1, "mean_width_full": 0.1, "parts_inside": parts_inside}
    facts = {"kind": "transients", "parts": parts, "verdicts": 1000, "parts_inside": parts_inside, "hours": 1.0}
    facts |= {"inside": inside, "inside_interval": [0.9, 1.0], "parts_inside_interval": [0.0, 1.0], "confidence": 0.95}
    states = {name: {**state, "unit": ""} for name in ("x1", "x2")}
    facts |= {"condition": "c", "condition_short": "c", "groups": None, "part": [], "false_alarms": [], "notes": []}
    return {**facts, "states": states, "scenario": {"words": "w"}}


def test_bounds_half_as_wide_as_what_a_state_does_are_not_relied_on():
    """However many verdicts lie inside; one such state among many is named, and the others may be relied on."""
    good = validated(9, 10, 0.9999)
    assert judged([0.15, 0.15], good)["rely"]["answer"] == YES
    assert judged([0.9, 0.15], good)["rely"]["answer"] == NO
    assert judged([0.9, 0.9])["rely"]["answer"] == NO
    many = judged([0.15, 0.15, 0.9], {**good, "states": {f"x{i}": good["states"]["x1"] for i in (1, 2, 3)}})
    assert many["rely"]["answer"] == CARE
    assert [r["weight"] for r in many["rely"]["reasons"] if "x3 (" in r["text"]] == [CARE]


@pytest.mark.parametrize(("inside", "parts", "weight"), [(0, 2, CARE), (4, 10, CARE), (5, 10, YES), (10, 10, YES)])
def test_recordings_that_are_seldom_inside_as_a_whole_are_nothing_in_favour(inside, parts, weight):
    reasons = judged([0.15, 0.15], validated(inside, parts, 0.9956))["rely"]["reasons"]
    assert [r["weight"] for r in reasons if r["about"] == "validation"] == [weight]


def test_an_alarm_without_a_violation_is_told():
    (happened,) = judged([3.0, 3.0], alarm=(StatisticRule("mean", 0.05, 0.01),))["happened"]
    told, _, rest = happened["text"].partition(". ")
    assert told.startswith("The alarm was raised 85 times, first at 0.1 s, by mean of ")
    first, most = (float(size) for size in re.findall(r" (?:at|at most) (\S+) times", told))
    assert first < most, "how far it went, which the first verdict in alarm does not show"
    assert rest.endswith("every one inside all bounds")


def test_of_many_recordings_those_in_alarm_are_told_first():
    facts = judged([0.9, 0.9])
    quiet, alarm = ({"recording": f"{state}.mcap", "state": state, "text": "told"} for state in ("quiet", "alarm"))
    for count in (20, 150):
        lines = findings_text({**facts, "happened": [quiet] * (count - 1) + [alarm]}).splitlines()
        told = [line for line in lines if line.endswith(".mcap: told")]
        assert len(told) == 20 and (told[0 if count > 20 else -1] == "  alarm.mcap: told")
        assert ("  and 130 more; the page and --json have all" in lines) == (count > 20)


@given(st.floats(1.0, 1e6, exclude_min=True), st.sampled_from([-1.0, 1.0]))
def test_a_violation_reads_as_beyond_its_bound(size, sign):
    text = beyond(sign * size)
    if text.startswith("just beyond"):
        assert size < 1 + 1e-8 and text.endswith("-1" if sign < 0 else " 1")
    else:
        assert abs(float(text)) > 1 and float(text) == pytest.approx(sign * size, rel=0.01)


def test_no_verdict_is_no_good_news():
    model = by_hand()
    verdicts = [EnvelopeMonitor(model).check(Transient([0.0], [[0.0, 0.0]], [[0.0]]))]
    facts = findings(model, "m", verdicts)
    assert facts["rely"]["answer"] == NO and facts["happened"][0]["state"] == "unknown" and not facts["alarm"]
    assert "Nothing left" not in html_report(model, verdicts, facts)


def test_samples_without_a_verdict_are_told_with_their_reason():
    """Half the samples of a stuck sensor were called gaps and missing values."""
    x = np.arange(8.0)[:, None] * [1e-3, 1e-3]
    x[5, 0] = math.nan
    verdicts = [EnvelopeMonitor(model := by_hand()).check(Transient(np.arange(8.0), x, np.zeros((8, 1))))]
    (told,) = (r["text"] for r in findings(model, "m", verdicts)["rely"]["reasons"] if "no verdict" in r["text"])
    assert told.endswith("have no verdict (2 missing)")


def test_what_of_many_recordings_was_never_fitted_is_told_of_the_two_farthest():
    x = np.sin(np.arange(300) / 20)[:, None]
    model = fit([Transient(np.arange(300) * 0.01, x, x)], additive="noise")
    runs = [Transient(np.arange(300) * 0.01, x + 3 * far, x, name=f"run {far}") for far in (1, 2, 3, 4)]
    facts = findings(model, "m", [EnvelopeMonitor(model).check(run) for run in runs])
    (told,) = (r["text"] for r in facts["rely"]["reasons"] if "ranges seen in the fit" in r["text"])
    assert told.count("x1 at ") == 2 and told.endswith("; and others in 2 more recordings")


def test_the_headline_is_no_better_than_the_model():
    """Quiet by bounds that hold everything is no good news, and the page does not say so in green."""
    verdicts = [EnvelopeMonitor(by_hand()).check(Transient([0.0, 0.1], np.zeros((2, 2)), np.zeros((2, 1))))]
    good, wide = judged([0.15, 0.15], validated(9, 10, 0.9999)), judged([0.9, 0.9])
    assert (good["rely"]["answer"], wide["rely"]["answer"]) == (YES, NO)
    good, wide = (html_report(by_hand(), verdicts, facts) for facts in (good, wide))
    assert "Nothing left its bounds<" in good and "at least 1 of 1 verdicts violated" in good
    assert "Nothing left its bounds, which says little here<" in wide


def sways(amplitude, seed=0, name="run"):
    """A state that follows its control by half a step, with sensor noise; it moves as far as the control does."""
    rng = np.random.default_rng(seed)
    u = amplitude * np.repeat(rng.uniform(-1, 1, 50), 20)
    x = np.zeros(1000)
    for k in range(999):
        x[k + 1] = x[k] + 0.5 * (u[k] - x[k])
    x = x + 0.02 * rng.standard_normal(1000)
    return Transient(np.arange(1000) * 0.1, x[:, None], u[:, None], name=name)


def test_the_report_is_as_tight_as_the_fit():
    """A recording that moves ten times as far makes no wide bounds narrow."""
    model = fit([sways(0.05)], additive="noise")
    share = float(model.fit_summary["mean_width"][0] / (model.domain.x_max - model.domain.x_min)[0])
    assert 0.5 < share and any(f"({share:.0%})" in m for m in model.fit_summary["messages"])  # the fit says so
    for amplitude in (0.05, 0.5):
        facts = findings(model, "m", [EnvelopeMonitor(model).check(sways(amplitude, 1))])
        (reason,) = [r for r in facts["rely"]["reasons"] if r["about"] == "tightness"]
        assert reason["weight"] == NO and f"({share:.0%})" in reason["text"] and "in the fit" in reason["text"]


def test_what_weighs_most_is_printed_first():
    text = findings_text(judged([0.9, 0.9], validated(9, 10, 0.9999))).splitlines()
    weights = [line.split(":")[0].strip() for line in text[1:] if not line.startswith("what")]
    assert text[0] == "may I rely on it? no" and weights[0] == "no"
