# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Update: a model and further recordings to the optimum of all, proven by what the model keeps, or refused by name."""

import json
from pathlib import Path

import numpy as np
import pytest
from engine_bag import SIGNALS, engine_bag
from refusals import refuses

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI, fit
from uncertain_lti.base.errors import FitError
from uncertain_lti.cli.main import main
from uncertain_lti.model.signature import Signature
from uncertain_lti.model.terms import ARRAYS
from uncertain_lti.validation.panel import Evidence

PAPER = {"additive": "noise", "alarm": "containment"}


def runs_of(seed, lengths, n=3, m=2, noise=0.01, dt=0.02, varies=0.05):
    """Recordings of one random stable plant whose elements vary a little, with noise."""
    rng = np.random.default_rng(seed)
    elements = np.hstack([rng.normal(size=(n, n)) / np.sqrt(n) - 2 * np.eye(n), rng.normal(size=(n, m))])
    runs = []
    for number, count in enumerate(lengths):
        x, u = np.zeros((count + 1, n)), np.zeros((count + 1, m))
        for k in range(count):
            u[k + 1] = 0.95 * u[k] + 0.3 * rng.normal(size=m)
            drawn = elements * (1 + varies * rng.uniform(-1, 1, elements.shape))
            step = dt * drawn @ np.concatenate([x[k], u[k]])
            x[k + 1] = x[k] + step + noise * rng.uniform(-1, 1, n)
        runs.append(Transient(np.arange(count + 1) * dt, x, u, name=f"run {number}"))
    return runs


def equal(one, other):
    a, b = (np.atleast_1d(np.asarray(m.fit_summary["objective"])) for m in (one, other))
    assert a == pytest.approx(b, rel=1e-9)
    for name in ARRAYS:
        assert getattr(one, name) == pytest.approx(getattr(other, name), rel=1e-6, abs=1e-7)
    for name in ("transitions", "transients", "segments"):
        assert one.fit_summary[name] == other.fit_summary[name]
    assert one.fit_summary["mean_width"] == pytest.approx(other.fit_summary["mean_width"], rel=1e-7)
    widest = np.asarray(one.fit_summary["max_width"]) / other.fit_summary["max_width"]
    assert (widest > 1.0 - 1e-7).all() and (widest < 1.05).all()  # at most so wide
    assert np.array_equal(one.domain.x_min, other.domain.x_min) and np.array_equal(one.domain.u_max, other.domain.u_max)
    assert one.domain.step_max == pytest.approx(other.domain.step_max)


@pytest.mark.parametrize("criterion", ["qp", "lp"])
@pytest.mark.parametrize("additive", ["none", "disturbance", "noise", "both"])
def test_an_update_is_the_fit_of_all(criterion, additive):
    """With more transitions than are kept, again and again, each recording given once; or refused by name."""
    runs = runs_of(7, (6000, 5000, 400, 300, 200), noise=0.0 if additive == "none" else 0.01)
    options = {"additive": additive, "alarm": "containment"}
    model, there, refused = fit(runs[:2], criterion, **options), runs[:2], 0
    for run in runs[2:]:
        there = [*there, run]
        try:
            model = model.update(run)
        except FitError as error:
            refused += 1
            again = [r for r in there if r.name in str(error).partition(" give ")[2].partition(" again,")[0]]
            assert again and run not in again
            model = model.update([*again, run])
        equal(model, fit(there, criterion, **options))
        assert all((model.bounds(r.x[:-1], r.u[:-1], 0.02)[0] <= r.x[1:]).all() for r in there)
    assert model.fit_summary["updates"] == 3 and refused < 3
    assert model.fit_summary["violations"] == 0


def test_what_the_recordings_lack_is_still_known():
    """Of all recordings what their sums show; of the earlier ones what was found in them."""
    runs = [t.replace(x=t.x[:, [0, 1, 0]], u=t.u * [1, 0]) for t in runs_of(5, (3000, 900))]
    whole, first = fit(runs, "qp", **PAPER), fit(runs[0], "qp", **PAPER)
    facts = first.fit_summary | {"messages": [*first.fit_summary["messages"], "'x1' is odd"]}
    updated = first.replace(fit_summary=facts).update(runs[1]).fit_summary
    assert updated["rank"] == whole.fit_summary["rank"] == 3
    assert updated["messages"] == ["'x1' is odd", *whole.fit_summary["messages"]]
    assert any("never moved" in text for text in updated["messages"])


def test_what_was_not_kept_is_never_left_outside():
    """Where new recordings move the elements far, the earlier ones are named, and given again they are fitted."""
    quiet, loud = runs_of(3, (20_000, 20_000))[:1], runs_of(4, (500,), noise=0.05)
    model = fit(quiet, "qp", **PAPER)
    refuses(FitError, "does not prove the optimum of all recordings; give run 0 again, together", model.update, loud)
    equal(model.update([*quiet, *loud]), fit([*quiet, *loud], "qp", **PAPER))


@pytest.mark.parametrize("seed", [0, 4])
def test_what_is_kept_is_nearest_to_the_bounds_where_every_width_is_the_largest(seed):
    """Of more transitions than a pass brings, whose widths noise alone makes and rounding alone tells apart."""
    runs = runs_of(seed, (8000,) * 4, n=8, varies=0.0)
    model = fit(runs[:3], "lp", **PAPER)
    assert model.dA.max() < 1e-9
    equal(model.update(runs[3]), fit(runs, "lp", **PAPER))


@pytest.mark.parametrize("seed", [0, 1])
def test_as_many_transitions_are_kept_as_there_is_room_for(seed):
    """Also where a few large ones are near the bounds of every state."""
    quiet, loud = runs_of(seed, (2500,) * 3, n=12, noise=0.003), runs_of(seed, (100,) * 4, n=12)
    runs = [*(t.replace(x=t.x / 3, u=t.u / 3) for t in quiet), *loud]
    equal(fit(runs[:-1], "qp", **PAPER).update(runs[-1]), fit(runs, "qp", **PAPER))


def thresholds(model):
    return np.concatenate([np.ravel(rule.threshold) for rule in model.alarm])


def test_thresholds_and_promise_are_learnt_from_all_recordings():
    """About those of a fit of all; a new recording raises no alarm afterwards, and the limit of the rate falls."""
    runs = runs_of(12, (1500,) * 7)
    model, whole = (fit(some, "qp", additive="noise") for some in (runs[:4], runs))
    updated = model.update(runs[4]).update(runs[5:])
    assert thresholds(updated) == pytest.approx(thresholds(whole), rel=0.2)
    old, new, all_at_once = (m.fit_summary["alarm"] for m in (model, updated, whole))
    assert new["hours"] == pytest.approx(all_at_once["hours"]) and new["units"] == 7
    limits = [alarm["limit_per_hour"] for alarm in (old, new, all_at_once)]
    assert limits[1] < limits[0] and limits[1] == pytest.approx(limits[2], rel=0.5)
    assert "7 recordings" in new["promises"][0] and new["note"].startswith("brought up to date: of each recording")
    x = runs[3].x.copy()
    x[700:760, 0] += 0.02 * np.where(np.arange(60) % 2, 1.0, -1.0)
    loud = Transient(runs[3].t, x, runs[3].u, name="loud")
    assert EnvelopeMonitor(model).check(loud).alarm.any()
    with_loud = model.update(loud)
    assert not EnvelopeMonitor(with_loud).check(loud).alarm.any()
    for later in (with_loud, with_loud.update(runs[4])):  # the alarm is as blind after the next one
        said = later.fit_summary["alarm"]
        times = f"{said['figure'] / model.fit_summary['alarm']['figure']:.1f} times as large as the fit before them saw"
        assert f"only changes {times}: fit all recordings together" in said["note"], said["note"]


@pytest.mark.parametrize("seed, criterion", [(12, "qp"), (3, "lp")])
def test_what_the_alarm_sees_is_by_the_bounds_after_the_update(seed, criterion):
    """With a recording of another machine they are far wider; the jumps stayed those of the bounds before it."""
    runs = runs_of(seed, (1500,) * 4)
    far = runs[3].replace(x=5.0 * runs[3].x[:, ::-1] + 40.0, name="other")
    model, whole = fit(runs[:3], criterion, additive="noise"), fit([*runs[:3], far], criterion, additive="noise")
    updated = model.update([*runs[:3], far])
    before, after, of_all = (np.array(m.fit_summary["alarm"]["biases"]) for m in (model, updated, whole))
    assert (after > 5.0 * before).all() and (after > 0.5 * of_all).all() and (after < 2.5 * of_all).all()
    assert "but for those of another machine, or in other units" in updated.fit_summary["alarm"]["note"]
    same = model.update(runs[3]).fit_summary["alarm"]
    assert same["biases"] == pytest.approx(before, rel=0.25) and "machine" not in same["note"]


def test_an_alarm_that_was_changed_stays():
    runs = runs_of(11, (1500,) * 4)
    model = fit(runs[:3], "qp", additive="noise")
    by_hand = model.replace(alarm=model.alarm[:1])
    updated = by_hand.update(runs[3])
    assert updated.alarm == by_hand.alarm
    assert "alarm is that of before the update" in updated.fit_summary["alarm"]["note"]


def test_a_recording_that_is_given_again_counts_once():
    runs = runs_of(1, (900, 800, 700))
    model = fit(runs[:2], "qp", **PAPER)
    equal(model.update(runs), fit(runs, "qp", **PAPER))
    refuses(FitError, "every recording is in the model already", model.update, runs[:2])


def test_the_file_holds_what_an_update_needs(tmp_path):
    runs = runs_of(2, (9000, 300, 200))
    model = fit(runs[:1], "lp", **PAPER)
    for run in runs[1:]:
        model.save(tmp_path / "m.json")
        model = UncertainLTI.load(tmp_path / "m.json").update(run)
    equal(model, fit(runs, "lp", **PAPER))


def test_the_file_grows_by_a_megabyte_at_most(tmp_path):
    (run,) = runs_of(0, (4000,), n=20, m=5)
    model = fit(run, "qp", **PAPER)
    model.save(tmp_path / "with.json")
    model.replace(memory=None).save(tmp_path / "without.json")
    with_it, without = ((tmp_path / f"{name}.json").stat().st_size for name in ("with", "without"))
    assert 200_000 < with_it - without < 1_000_000


def test_combinations_that_were_seen_stay_seen():
    wide, narrow = runs_of(5, (3000, 3000))
    narrow = Transient(narrow.t, 0.3 * narrow.x + 5.0, 0.3 * narrow.u, name="apart")
    model = fit(narrow, "qp", **PAPER)
    updated = model.update([wide])
    for run in (narrow, wide):
        assert not updated.domain.outside(run.x[:-1], run.u[:-1]).any()


def test_given_again_the_recordings_have_the_combinations_of_one_fit():
    runs = runs_of(4, (20_000, 900, 900), noise=0.02)
    runs[1:] = (Transient(r.t, r.x * by, r.u * by, name=r.name) for r, by in zip(runs[1:], (1.2, 1.5), strict=True))
    model = fit(runs[0], "qp", **PAPER)
    for count in (2, 3):
        model = model.update(runs[:count])
    assert np.array_equal(model.domain.measure.occupied, fit(runs, "qp", **PAPER).domain.measure.occupied)


def test_repeats_and_residuals_join():
    runs = runs_of(6, (3000, 2000))
    held = Transient(runs[1].t, np.repeat(runs[1].x[::4], 4, axis=0)[: len(runs[1])], runs[1].u, name="held")
    one, other = (fit(r, "qp", **PAPER) for r in (runs[0], held))
    updated = one.update(held)
    assert (updated.repeats.longest_repeat_s >= other.repeats.longest_repeat_s).all()
    assert np.linalg.eigvalsh(updated.residuals.covariance).min() >= 0
    quieter, joined, before = (np.diag(m.residuals.covariance) for m in (other, updated, one))
    assert (quieter < joined).all() and (joined < before).all()


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"discard": 3}, "discarded"),
        ({"count": "transient"}, "weights that differ between samples"),
        ({"horizons": [5], "widths": "constant"}, "has horizons"),
        ({"schedule": {"x1": [-0.2, 0.2]}}, "is scheduled"),
        ({"describe_data": False}, "keeps nothing of its recordings"),
    ],
)
def test_what_is_not_plain_is_refused_with_the_remedy(options, match):
    runs = runs_of(8, (600, 500, 400))
    model = fit(runs[:2], "qp", **PAPER, **options)
    refuses(FitError, f"{match}.*; fit again with all recordings", model.update, runs[2])


def test_a_model_that_was_changed_is_refused():
    runs = runs_of(8, (600, 500))
    model = fit(runs[0], "qp", **PAPER)
    with pytest.raises(FitError, match="was changed after its fit.*fit again with all recordings"):
        model.replace(A=1.01 * model.A).update(runs[1])
    damaged = {**model.memory, "kept": {}}
    refuses(FitError, "field 'memory' of the model file is damaged", model.replace(memory=damaged).update, runs[1])
    stripped = model.replace(fit_summary={})
    refuses(FitError, "field 'fit' of the model file lacks criterion, .*; fit again", stripped.update, runs[1])
    refuses(FitError, "field 'memory' of the model file is damaged", Evidence.from_dict, {"hours": [1, "A"]})
    other = Transient(runs[1].t, runs[1].x, runs[1].u, state_names=["a", "b", "c"])
    refuses(FitError, "transient has states a, b, c", model.update, other)


def test_steps_of_another_length_are_refused_if_disturbance_and_noise_were_one_term():
    model = fit(runs_of(9, (800,)), "qp", additive="both", alarm="containment")
    refuses(FitError, "steps of the model have one length", model.update, runs_of(9, (700,), dt=0.03))


def test_the_command_updates(tmp_path, capsys):
    (tmp_path / "signals.yaml").write_text("additive: disturbance\n" + SIGNALS)
    bags = [str(engine_bag(tmp_path / f"run{s}x.mcap", 80 + 15 * s, s)) for s in range(3)]
    fitted = ["--signals", str(tmp_path / "signals.yaml"), "--criterion", "qp", "--alarm", "containment", "--quiet"]
    names = [str(tmp_path / f"{name}.model.json") for name in ("old", "new", "all")]
    assert main(["fit", *bags[:2], *fitted, "--output", names[0]]) == 0
    assert main(["fit", bags[2], "--update", names[0], "--output", names[1], "--quiet"]) == 0
    assert main(["fit", *bags, *fitted, "--output", names[2]]) == 0
    old, new, whole = (UncertainLTI.load(name) for name in names)
    equal(new, whole)
    assert new.fit_summary["sources"] == whole.fit_summary["sources"] != old.fit_summary["sources"]
    capsys.readouterr()
    assert main(["info", names[1], "--json"]) == 0
    assert "memory" not in json.loads(capsys.readouterr().out)
    old.replace(signatures=[Signature("worn", [1], [np.eye(old.n)])]).save(names[0])
    assert main(["fit", bags[2], "--update", names[0], "--output", names[1], "--force"]) == 0
    said = capsys.readouterr()
    assert "its signatures" in said.err and "fitted before" not in said.out
    engine_bag(tmp_path / "run2x.mcap", 200, 2)  # it has grown
    assert main(["fit", bags[2], "--update", names[1], "--output", names[2], "--force"]) == 0
    assert f"{bags[2]}: fitted before with other samples, and both count; " in capsys.readouterr().out


def test_the_command_reads_earlier_recordings_again_where_they_are_needed(tmp_path, monkeypatch, capsys):
    """And still there and as they were: else one sentence names them."""
    monkeypatch.chdir(tmp_path)
    for name, run in (("quiet", runs_of(3, (20_000,))[0]), ("loud", runs_of(4, (500,), noise=0.05)[0])):
        table = np.column_stack([run.t, run.x, run.u])
        np.savetxt(f"{name}.csv", table, "%.12g", ",", header="t,a,b,c,u,v", comments="")
    of = [f"{{name: {name}, topic: /table, field: {name}}}" for name in "abcuv"]
    Path("s.yaml").write_text(f"additive: noise\nstates: [{', '.join(of[:3])}]\ncontrols: [{', '.join(of[3:])}]\n")
    fitted = ["--signals", "s.yaml", "--criterion", "qp", "--alarm", "containment", "--quiet", "--output"]
    assert (
        main(["fit", "quiet.csv", *fitted, "old.json"])
        == main(["fit", "quiet.csv", "loud.csv", *fitted, "all.json"])
        == 0
    )
    capsys.readouterr()
    assert main(["fit", "loud.csv", "--update", "old.json", "--output", "new.json"]) == 0
    assert (
        "what old.json keeps does not prove the optimum of all recordings: 1 earlier one read again"
        in capsys.readouterr().err
    )
    equal(UncertainLTI.load("new.json"), UncertainLTI.load("all.json"))
    Path("quiet.csv").rename("elsewhere.csv")  # a recording that is given again is found where it is now
    assert main(["fit", "loud.csv", "elsewhere.csv", "--update", "old.json", "--output", "new.json", "--force"]) == 0
    assert [s["file"] for s in UncertainLTI.load("new.json").fit_summary["sources"]] == ["elsewhere.csv", "loud.csv"]
    assert main(["fit", "loud.csv", "elsewhere.csv", "--update", "new.json", "--output", "no.json"]) == 2
    assert main(["validate", "new.json"]) == 0
    capsys.readouterr()
    known = UncertainLTI.load("all.json")  # as fitted in Python, which keeps no checksums, of recordings that are gone
    known.replace(fit_summary=known.fit_summary | {"sources": [{"file": "gone.csv"}, {"file": "loud.csv"}]}).save(
        "p.json"
    )
    np.savetxt("more.csv", table[:200], "%.12g", ",", header="t,a,b,c,u,v", comments="")
    assert main(["fit", "more.csv", "--update", "p.json", "--output", "new.json", "--force"]) == 0
    Path("elsewhere.csv").rename("quiet.csv")
    Path("quiet.csv").write_text(Path("quiet.csv").read_text() + "400.02,0,0,0,0,0\n")
    assert main(["fit", "loud.csv", "--update", "old.json", "--output", "new.json", "--force"]) == 2
    assert "give quiet.csv again, together with the new ones" in capsys.readouterr().err
