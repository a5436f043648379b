# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""tune(): what it chooses detects smaller faults on left-out data than the plain fit, and it says so."""

import json
import math
from dataclasses import replace

import matplotlib
import numpy as np
import pytest
from engine_bag import SIGNALS, engine_bag
from tanks import Tanks

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI, read_transients, tune
from uncertain_lti.base.errors import FitError
from uncertain_lti.cli.main import main
from uncertain_lti.proposal import tune as module
from uncertain_lti.proposal import ways
from uncertain_lti.reports.tune_figure import tune_figure
from uncertain_lti.reports.tune_text import tune_text
from uncertain_lti.validation import armed

RATE = 100.0


@pytest.fixture(scope="module", autouse=True)
def few():
    """Fewer cases, kinds of faults and windows than anybody would take: the suite has seconds for it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "COMPARED_CASES", 20)
        patch.setattr(module, "COMPARED", ("bias", "offset"))
        patch.setattr(armed, "COUNTED", ((3, 5),))
        patch.setattr(armed, "MOST_WINDOWS", 1)
        yield


@pytest.fixture(scope="module")
def runs():
    return Tanks().transients(4, seed=3, steps=60, noise=1e-3)


@pytest.fixture(scope="module")
def faulty():
    return {"leak": Tanks().transients(2, seed=8, steps=60, noise=1e-3, fault=0.5)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def tuned(runs, faulty, folder):
    return tune(runs, RATE, faulty=faulty, cache=folder)


def test_it_detects_smaller_faults_than_the_plain_fit_and_names_the_reason(tuned, runs):
    plain, chosen = tuned.trials[0], tuned.chosen
    assert plain.setting.words == "plain fit: (10), no additive term"
    assert chosen.setting.options["additive"] != "none"  # the levels are measured with noise
    rows = tuned.to_dict()["trials"]
    assert rows[tuned.to_dict()["chosen"]]["size"] < 0.8 and rows[0]["size"] == 1.0
    ratio = chosen.sizes() - plain.sizes()
    assert rows[tuned.to_dict()["chosen"]]["size"] == pytest.approx(math.exp(ratio[np.isfinite(ratio)].mean()))
    for trial in tuned.trials:
        assert trial.refused or trial.alarms <= RATE * trial.hours
    assert f"{math.exp(ratio[np.isfinite(ratio)].mean()):.3g} times the size" in tuned.reason
    model = tuned.model
    assert model.alarm == chosen.rules and model.fit_summary["tune"]["reason"] == tuned.reason
    assert not any(EnvelopeMonitor(model).check(run).alarm.any() for run in chosen.setting.prepared(runs))
    assert model.validation["detectable"]["faults"] and "false_alarms" in model.validation


def test_the_simplest_within_the_error_of_the_best_is_chosen(tuned):
    good = [t for t in tuned.trials if not t.refused and t.seen_share == max(t.seen_share for t in tuned.trials)]
    plain = tuned.trials[0]
    best = min(good, key=lambda t: np.nanmean(t.sizes() - plain.sizes()))
    assert tuned.chosen.unknowns <= best.unknowns
    assert {t.family.kinds for t in tuned.trials} >= {(), ("energy",), ("mean",), ("chi2",)}
    assert any(t.setting.options.get("horizons") for t in tuned.trials)
    assert any(t.setting.constant for t in tuned.trials)


def test_an_interrupted_search_goes_on_and_comes_to_the_same(tuned, runs, faulty, folder, monkeypatch):
    made = []
    real = module._Search._try

    def counted(self, setting, family):
        made.append(setting.words)
        return real(self, setting, family)

    monkeypatch.setattr(module._Search, "_try", counted)
    entry = min(folder.iterdir())
    entry.write_text("{damaged")
    again = tune(runs, RATE, faulty=faulty, cache=folder)
    assert len(made) == 1
    assert json.dumps(again.to_dict()) == json.dumps(tuned.to_dict())
    assert json.dumps(again.model.to_dict()) == json.dumps(tuned.model.to_dict())


def test_the_cache_does_not_ask_where_the_signals_file_lies(tmp_path, monkeypatch):
    """But whether the program is the same."""
    kept = []
    for folder in ("here", "there"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "signals.yaml").write_text(SIGNALS)
        if not kept:
            engine_bag(tmp_path / "run.mcap", seed=1)
        runs = read_transients([tmp_path / "run.mcap"], tmp_path / folder / "signals.yaml")
        kept.append(module._fingerprint(runs, {}, None))
    assert kept[0] == kept[1] != module._fingerprint(runs, {}, "folder")
    monkeypatch.setattr(module, "_PACKAGE", tmp_path)
    (tmp_path / "other.py").write_text("changed = True\n")
    assert module._fingerprint(runs, {}, None) != kept[0]


def test_a_plain_fit_that_is_chosen_is_set_beside_the_best_of_the_others(tuned):
    search = object.__new__(module._Search)
    search.trials, search.faulty = [tuned.trials[0], tuned.trials[2], tuned.trials[1]], {}
    search.plain = search.trials[0]
    best = min(search.trials[1:], key=search.score)
    reason = search._reason(search.plain, search.plain)
    assert f"the best of 2 others, {best.words}, needs {math.exp(search.score(best)):.3g} times" in reason


def test_what_is_worse_than_the_plain_fit_is_never_chosen(tuned):
    """However simple it is; what is a little better and simpler than the best is, where its error allows that."""

    def other(factor, unknowns):
        faults = [{**f, "thresholds": (factor * np.array(f["thresholds"])).tolist()} for f in plain.faults]
        return replace(plain, faults=tuple(faults), unknowns=unknowns, family=plain.family)

    plain = tuned.trials[0]
    search = object.__new__(module._Search)
    search.plain, search.faulty, search.families = plain, {}, [plain.family]
    worse, same, better = other(1.3, 1), other(0.99, 1), other(0.5, 1000)
    search.trials = [plain, worse]
    assert search.choose()[0] is plain
    search.trials = [plain, worse, same]  # within MARGIN it is no better
    assert search.choose()[0] is plain
    search.trials = [plain, worse, same, better]
    assert search.choose() == (better, better)
    assert search.score(worse) > 0.0 > search.score(better)


def test_the_budget_ends_it_and_what_was_not_tried_is_named(runs):
    tuned = tune(runs, RATE, budget=1e-6)
    assert len(tuned.trials) == 1 and tuned.chosen is tuned.trials[0]
    assert "(11), noise; alarm 1 of 1" in tuned.not_tried and "no other way could be judged" in tuned.reason
    text = tune_text(tuned.to_dict())
    assert "the budget left no time for" in text and "record next" in text
    assert f"; and {len(tuned.not_tried) - 3} more" in text and tuned.not_tried[-1] not in text


def test_labelled_recordings_count(tuned):
    seen = tuned.chosen.seen["leak"]
    assert len(seen) == 2 and sum(seen) >= max(sum(t.seen["leak"]) for t in tuned.trials if not t.refused) - 1
    assert "of the recordings with a fault" in tuned.reason


def test_a_control_that_acts_late_is_taken_earlier():
    """The delay is found, tried beside the best fit, and in the signals of what it prepares."""
    rng = np.random.default_rng(4)
    runs = []
    for _ in range(4):
        u = np.repeat(rng.normal(size=(30, 2)), 5, axis=0)
        x = np.zeros((150, 1))
        for k in range(149):
            x[k + 1] = 0.8 * x[k] + 0.2 * u[max(k - 3, 0), :1] + 0.01 * rng.normal()
        runs.append(Transient(np.arange(150) * 100_000_000, x, u))
    best = ways.plain(runs)
    found = [dict(setting.delays) for setting in ways.delays(runs, best)]
    assert found == [{"u1": 3}, {"u1": 1, "u2": 1}]
    (setting, *_) = ways.delays(runs, best)
    np.testing.assert_array_equal(setting.prepared(runs)[0].u[3:, 0], runs[0].u[:-3, 0])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ways, "fits", lambda transients: [])
        patch.setattr(armed, "COUNTED", ())
        patch.setattr(module, "STATISTICS", ())
        tuned = tune(runs, RATE)
    assert dict(tuned.chosen.setting.delays) == {"u1": 3} and "u1 3 samples earlier" in tuned.chosen.words


def test_the_figure_has_its_hours_where_nothing_raised_an_alarm(tuned, tmp_path):
    quiet = [t if "refused" in t else {**t, "alarms": 0, "per_hour": 0.0} for t in tuned.to_dict()["trials"]]
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        tune_figure({**tuned.to_dict(), "trials": quiet, "curve": []}, tmp_path / "tune.svg")
    assert f"what was left out, {tuned.chosen.hours:.3g} h" in (tmp_path / "tune.svg").read_text()


def test_what_to_record_is_named(runs):
    still = [
        Transient(r.t_ns, np.column_stack([r.x, np.zeros(len(r))]), np.column_stack([r.u, np.ones(len(r))]))
        for r in runs[:3]
    ]
    tuned = tune(still, 0.01, budget=1e-6)
    text = "\n".join(tuned.record)
    assert "3 recordings can hardly carry a choice: record 3 more recordings" in text
    assert (
        "u2 does not move" in text
        and "x4 does not move, so nothing says" in text
        and "h without an alarm would" in text
    )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"false_alarms": 0.0}, "positive number per hour"),
        ({"false_alarms": 1.0, "within": -1.0}, "positive number of seconds"),
        ({"false_alarms": 1.0, "budget": 0.0}, "budget is 0.0"),
        ({"false_alarms": 1.0, "within": 1e4}, "the plain fit cannot be judged"),
    ],
)
def test_what_cannot_be_tuned_is_refused(runs, options, words):
    with pytest.raises(FitError, match=words):
        tune(runs, **options)


def test_the_command_writes_a_model_and_a_figure(tmp_path, capsys):
    (tmp_path / "signals.yaml").write_text(SIGNALS)
    for seed in (1, 2):
        engine_bag(tmp_path / f"run{seed}.mcap", seed=seed)
    engine_bag(tmp_path / "broken.mcap", seed=3, fault_at=100)
    name, picture = str(tmp_path / "m.model.json"), tmp_path / "tune.png"
    bags = [str(tmp_path / "run1.mcap"), str(tmp_path / "run2.mcap"), f"broken={tmp_path / 'broken.mcap'}"]
    words = ["tune", *bags, "--signals", str(tmp_path / "signals.yaml"), "--false-alarms", "500", "--within", "0.5"]
    assert main([*words, "--budget", "1s", "--output", name, "--figure", str(picture)]) == 0
    said = capsys.readouterr().out
    assert "chosen:" in said and "because" in said and "record next" in said and "broken" in said
    assert picture.read_bytes()[1:4] == b"PNG"
    model = UncertainLTI.load(name)
    assert model.fit_summary["tune"]["trials"] and len(model.fit_summary["sources"]) == 2
    assert main(["check", name, bags[0], "-q"]) == 0
    capsys.readouterr()
    assert main([*words[:-4], "--false-alarms", "0"]) == 2
    assert main([*words, "--output", name]) == 2 and "--force" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main([*words, "--budget", "soon"])
    assert "write 90s, 10m or 1h" in capsys.readouterr().err
