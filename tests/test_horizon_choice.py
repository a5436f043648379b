# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Horizons chosen by what is left out: what is asked for, what is tried, and what stays."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from refusals import refuses
from test_horizon_fit import runs

import uncertain_lti
from uncertain_lti import EnvelopeMonitor, SignalMap
from uncertain_lti.base.errors import FitError, SignalError
from uncertain_lti.base.text import text_of
from uncertain_lti.proposal import search
from uncertain_lti.proposal.search import MOST, choose_horizons, lengths_of
from uncertain_lti.reports.model_text import horizon_blocks
from uncertain_lti.signals.values import HorizonRule
from uncertain_lti.validation.left_out import validate
from uncertain_lti.validation.panel import rules_for, sizes_of

fit = partial(uncertain_lti.fit, criterion="qp", alarm="containment")
RUNS = runs(count=4, length=200, noise=1e-2, bend=0.0)


def test_lengths_are_geometric_up_to_the_longest() -> None:
    assert lengths_of(HorizonRule(longest=0.8), RUNS) == [2, 5, 10, 20, 40]
    assert lengths_of(HorizonRule(longest=60.0), RUNS)[-1] == MOST
    assert lengths_of(HorizonRule(), RUNS) == [2, 5, 10, 20]  # a tenth of the median recording
    assert lengths_of(HorizonRule(seconds=(0.5, 0.1)), RUNS) == [5, 25]
    assert lengths_of(HorizonRule(steps=(90, 3)), RUNS) == [3, 90]  # listed one by one they may be longer
    for rule in (HorizonRule(longest=0.02), HorizonRule(seconds=(0.01,))):
        refuses(FitError, r"median step is 0.02 s", lengths_of, rule, RUNS)


@pytest.mark.parametrize(
    ("data", "rule"),
    [
        ("auto", HorizonRule()),
        ([5, 20], HorizonRule(steps=(5, 20))),
        ({"longest": 1.0, "widths": "constant"}, HorizonRule(1.0, widths="constant")),
        ({"seconds": [0.1]}, HorizonRule(seconds=(0.1,))),
        ({"longest": "auto"}, HorizonRule()),
    ],
)
def test_a_rule_is_read_from_arguments_and_signals_files(data: Any, rule: HorizonRule) -> None:
    assert HorizonRule.of(data) == rule
    states = [{"name": "x", "topic": "/a", "field": "data"}]
    assert SignalMap.from_dict({"states": states, "horizons": data}).horizons == rule


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (3, "write auto"),
        ({"longest": -1.0}, "longest"),
        ({"longest": 1.0, "steps": [3]}, "longest and steps are given"),
        ({"steps": 3}, "list of numbers"),
        ({"steps": [1]}, "at least 2"),
        ({"widths": "wide"}, "auto, growing or constant"),
        ({"odd": 1}, "odd"),
    ],
)
def test_what_is_no_rule_is_refused_in_one_sentence(data: Any, words: str) -> None:
    refuses(SignalError, words, HorizonRule.of, data, "a.yaml: horizons")
    refuses(FitError, words, fit, RUNS, horizons=data)


def test_what_holds_on_left_out_data_stays_with_a_table_that_says_why() -> None:
    model = fit(RUNS, criterion="lp", additive="noise", horizons={"longest": 0.4})
    choice = model.fit_summary["horizon_choice"]
    assert choice["units"] == len(RUNS) and choice["left_out"] == "recording"
    rows = {(row["steps"], row["widths"]): row for row in choice["candidates"]}
    assert set(rows) == {(h, w) for h in (2, 5, 10, 20) for w in ("constant", "growing")}
    taken = [row for row in choice["candidates"] if row["taken"]]
    assert [(h.steps, h.widths) for h in model.horizons] == [(row["steps"], row["widths"]) for row in taken] != []
    assert taken[-1]["per_step"] < 0.8 and all(row["why"] for row in choice["candidates"])
    for row in taken:  # constant half-widths, unless growing ones are narrower
        other = rows[row["steps"], "constant" if row["widths"] == "growing" else "growing"]
        assert row["widths"] == "constant" or row["width"] < other["width"]
    text = text_of(horizon_blocks(choice))
    assert "leaving out one recording of 4" in text and text.count("(chosen)") == len(taken)
    assert any(message.startswith("horizons of ") for message in model.fit_summary["messages"])


def test_statistics_at_a_horizon_take_the_residuals_of_the_model_fitted_without() -> None:
    model = fit(RUNS, additive="noise", horizons={"steps": [4, 9]}, widths="constant")
    assert model.sampling.dt_median is not None
    rules = tuple(rules_for(model, 100, model.sampling.dt_median))
    assert {rule.horizon for rule in rules} == {1, 9} and len(rules) == 8
    assert "horizon_choice" not in model.fit_summary and [h.widths for h in model.horizons] == ["constant"] * 2
    for part, run in zip(validate(RUNS, full=model, additive="noise").parts, RUNS, strict=True):
        verdicts = EnvelopeMonitor(part.model.replace(alarm=rules)).check(run)
        expected = np.abs(verdicts.statistics[verdicts.judged])
        power = np.repeat([1 if r.kind == "mean" else 2 for r in rules], [len(r.thresholds(model.n)) for r in rules])
        np.testing.assert_allclose(sizes_of(rules, part) ** power, np.nan_to_num(expected), rtol=1e-12)


def test_a_model_with_horizons_in_its_alarm_is_validated_with_them() -> None:
    """It was fitted again without them, so that its own rules asked for rows that no part had."""
    model = uncertain_lti.fit(RUNS, "lp", additive="noise", horizons=[2, 5])
    assert 5 in {rule.horizon for rule in model.alarm}
    validation = uncertain_lti.validate(model, RUNS)
    assert validation.model.steps == model.steps
    assert validation.judged_as(model).to_dict()["false_alarms"][0]["rule"] == "; or ".join(
        rule.words for rule in model.alarm
    )


def test_horizons_that_lose_are_refused() -> None:
    """Every recording has a bias of its own in the rate: what is left out drifts off, and longer horizons show it."""
    rng = np.random.default_rng(5)
    odd = []
    for number, run in enumerate(RUNS):
        x = run.x + 0.4 * (-1) ** number * run.t[:, None] + rng.normal(0.0, 3e-3, run.x.shape)
        odd.append(type(run)(run.t_ns, x, run.u))
    chosen, table = choose_horizons(odd, HorizonRule(longest=1.2), [2, 60], additive="noise", criterion="lp")
    assert 60 not in chosen
    assert any("left-out windows are outside" in row["why"] for row in table["candidates"] if row["steps"] == 60)


def test_pieces_of_long_recordings_choose_the_same_horizons(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = {"additive": "noise", "criterion": "lp"}
    whole, _ = choose_horizons(RUNS, HorizonRule(), [2, 4, 8], **asked)
    monkeypatch.setattr(search, "_OF_HORIZONS", sum(map(len, RUNS)) // 2)
    pieces, table = choose_horizons(RUNS, HorizonRule(), [2, 4, 8], **asked)
    assert pieces == whole and table["units"] == len(RUNS)


def test_an_empty_list_means_one_step_whatever_the_signals_file_asks_for() -> None:
    states = [{"name": f"x{i}", "topic": "/a", "field": f"x{i}"} for i in (1, 2)]
    controls = [{"name": "u1", "topic": "/a", "field": "u1"}]
    horizons = {"steps": [4], "widths": "growing"}
    signals = SignalMap.from_dict({"states": states, "controls": controls, "horizons": horizons})
    asks = [type(run)(run.t_ns, run.x, run.u, signals=signals) for run in RUNS[:2]]
    assert fit(asks, additive="noise").steps == (4,)
    assert fit(asks, additive="noise", horizons=[]).steps == ()


def test_widths_without_horizons_and_weights_with_a_choice_are_refused() -> None:
    refuses(FitError, "widths is 'wide'; write auto, growing or constant", fit, RUNS, horizons=[3], widths="wide")
    refuses(FitError, "no horizons are asked for", fit, RUNS, widths="constant")
    with pytest.raises(FitError, match="transient_weights are for all"):
        fit(RUNS, horizons="auto", transient_weights=[1.0, 2.0, 1.0, 1.0])
    refuses(FitError, "groups are given", fit, RUNS, horizons=[3], widths="growing", groups=["a", "a", "b", "b"])
