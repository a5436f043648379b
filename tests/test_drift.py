# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Drift: `check` says how the largest utilisation moves over recordings, and when it reaches its threshold."""

import numpy as np
import pytest
from test_update import runs_of

from uncertain_lti import EnvelopeMonitor, Transient, fit
from uncertain_lti.monitor.deployed import Days, _student, drift_in_words
from uncertain_lti.reports.check import check_data


@pytest.fixture(scope="module")
def model():
    return fit(runs_of(1, (3000, 3000)), "qp", additive="noise", alarm="containment")


def checked(model, growth, apart, first=1_790_000_000.0, count=8):
    """Facts of recordings of a healthy plant whose deviation in x1 grows from one to the next."""
    found = []
    for number, run in enumerate(runs_of(1, (1500,) * count, noise=0.003)):
        x, t = run.x.copy(), run.t + first + number * apart
        x[750, 0] += 0.004 * np.exp(growth * number)
        found.append(check_data(model, EnvelopeMonitor(model).check(Transient(t, x, run.u)), samples=False))
    return found


def test_what_rises_is_said_with_the_day_on_which_it_is_too_much(model):
    (text,) = drift_in_words(model, checked(model, 0.1, 7 * 86_400.0))
    assert text.startswith("the largest utilisation of x1 rises by ") and "a week over 8 recordings" in text
    assert "reaches its threshold of 1 on 2026-1" in text and "if the machine is healthy, update the model" in text


def test_without_dates_recordings_are_counted(model):
    (text,) = drift_in_words(model, checked(model, 0.1, 0.0, 0.0))
    assert "a recording over 8 recordings" in text and "reaches its threshold of 1 in" in text
    (text,) = drift_in_words(model, checked(model, 0.3, 0.0, 0.0))
    assert "it is past its threshold of 1" in text


def test_what_the_model_was_fitted_to_does_not_count(model):
    """Its bounds hold them, so that all after them reach farther."""
    steady = checked(model, 0.0, 86_400.0, count=16)
    fitted = [{**one, "recording": f"run {number % 2}"} for number, one in enumerate(steady[:8])]
    for one in fitted:
        one["states"] = {name: {**state, "largest": 0.3} for name, state in one["states"].items()}
    assert drift_in_words(model, [*fitted, *steady[8:]]) == []
    other = model.replace(memory={**model.memory, "recordings": [3, ["run 9", ""]]})
    assert drift_in_words(other, [*fitted, *steady[8:]]) != []


def test_a_node_that_runs_for_weeks_says_it_of_its_days(model):
    days, noon = Days(model), int(1.79e18)
    for number in range(15):
        for part in range(3):
            assert days.words == [] or number > 5
            peaks = [0.5 * 1.05**number / (1 + part), *[0.5] * (model.n - 1)]
            days.take(noon + number * 86_400 * 10**9 + part, peaks)
    (text,) = days.words
    assert text.startswith("the largest utilisation of x1 rises by 41 % a week over 14 days")
    assert "it reaches its threshold of 1 on 2026-10-0" in text


def test_what_does_not_move_or_is_short_is_not_said(model):
    assert drift_in_words(model, checked(model, 0.0, 7 * 86_400.0)) == []
    few = [drift_in_words(model, checked(model, 0.6, 7 * 86_400.0, count=count)) for count in (4, 5)]
    assert [len(texts) for texts in few] == [0, 1]


@pytest.mark.parametrize("freedom", [3, 7, 60])
def test_chance_is_that_of_students_distribution(freedom):
    stdtrit = pytest.importorskip("scipy.special", reason="scipy, the reference, is not installed").stdtrit
    for chance in (0.01, 1e-4):
        assert _student(freedom, chance) == pytest.approx(stdtrit(freedom, 1.0 - chance / 2.0), rel=1e-7)
