# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Choice of a schedule by what is left out, suggestions, and what the command says of them."""

import argparse
import inspect
import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from refusals import refuses

import uncertain_lti
from uncertain_lti import EnvelopeMonitor, OperatingPoint, Transient, UncertainLTI, validate
from uncertain_lti.base.errors import FitError
from uncertain_lti.cli.command import schedule as _schedule
from uncertain_lti.cli.main import main
from uncertain_lti.identification import fitting
from uncertain_lti.model.horizon import run_over
from uncertain_lti.proposal.search import EXCESS, KnotCandidate, Score, choose_knots, chosen_of
from uncertain_lti.proposal.tune import promise, thinned
from uncertain_lti.signals.signal_map import ScheduleRule, Signal, SignalMap
from uncertain_lti.validation.left_out import leave_out
from uncertain_lti.validation.monitor_fit import FOLDS

DT = 0.05


def run(seed, N=800, low=-1.0, high=1.0, bend=4.0, noise=2e-4):
    """A tank whose outflow grows with its level: x1 is the level; and bend 0 makes it linear."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1, 1, (N // 20 + 1, 2)), 20, axis=0)[: N + 1]
    u[:, 0] = low + (high - low) * (u[:, 0] + 1) / 2
    x = np.zeros((N + 1, 2))
    x[0, 0] = (low + high) / 2
    for k in range(N):
        level, second = x[k]
        x[k + 1, 0] = level + DT * 2.0 * (u[k, 0] - level)
        x[k + 1, 1] = second + DT * ((-3.0 - bend * abs(level)) * second + 2.0 * u[k, 1])
    return Transient(DT * np.arange(N + 1), x + noise * rng.standard_normal(x.shape), u, name=f"run {seed}")


RUNS = [run(seed) for seed in range(6)]
LINEAR = [run(seed, bend=0.0) for seed in range(6)]
APART = [run(1, low=-1.0, high=-0.4), run(2, low=-0.2, high=0.3), run(3, low=0.5, high=1.0)]


fit = partial(uncertain_lti.fit, criterion="qp", alarm="containment")


def options(**more):
    return {"additive": "noise", **more}


@pytest.fixture(scope="module")
def model():
    return fit(RUNS, schedule={"x1": "auto"}, **options())


def test_a_plant_with_regimes_gets_knots_and_narrower_bounds_on_what_is_left_out(model):
    one = fit(RUNS, **options())
    (facts,) = model.fit_summary["schedule"]
    assert facts["chosen"] == 3 == model.schedule.blocks
    rows = {row["knots"]: row for row in facts["candidates"]}
    assert rows[3]["jumps"] < 0.3 and rows[3]["width"] < 0.3
    assert rows[3]["excess"] * rows[3]["jumps"] <= EXCESS
    assert rows[1]["width"] == rows[1]["jumps"] == 1
    inside = []
    for tested in (model, one):
        for steps in (run(seed).transitions() for seed in range(70, 80)):
            low, high = tested.bounds(steps.x, steps.u, steps.dt)
            inside.append(((low <= steps.x_next) & (steps.x_next <= high)).all(axis=1).mean())
    assert np.mean(inside[:10]) > 0.98 and np.mean(inside[10:]) > 0.98
    assert model.fit_summary["mean_width"][1] < 0.6 * one.fit_summary["mean_width"][1]


def test_the_table_is_that_of_what_is_left_out(model):
    (facts,) = model.fit_summary["schedule"]
    row = next(row for row in facts["candidates"] if row["knots"] == facts["chosen"])
    left = leave_out(RUNS, full=model, folds=FOLDS, **options())
    assert row["outside"] == pytest.approx(1 - left.to_dict()["inside"], abs=1e-12)
    assert left.model.schedule == model.schedule


@pytest.mark.parametrize("runs", [LINEAR, [run(3, 40)], [run(3, 150)], APART], ids=["linear", "40", "150", "apart"])
def test_where_knots_do_not_pay_one_is_kept_and_the_reason_said(runs):
    """A linear plant, little data, and recordings that visit different regimes."""
    model = fit(runs, schedule={"x1": "auto"}, **options())
    (facts,) = model.fit_summary["schedule"]
    assert model.schedule is None and facts["chosen"] == 1 and facts["reason"]
    assert facts["reason"] in model.fit_summary["messages"][-1]
    assert "does not pay" in facts["reason"] or runs is not LINEAR


@pytest.mark.parametrize(
    ("figures", "outside", "taken"),
    [
        ((1.0, 0.91, 0.5), (3, 3, 3), 3),
        ((1.0, 0.91, 0.91), (3, 3, 3), 1),  # not clearly smaller
        ((1.0, 0.51, 0.5), (3, 3, 3), 2),  # the fewest of which no other sees clearly smaller jumps
        ((1.0, 0.8, 0.5), (3, 3, 104), 2),  # over 1.25 times one knot's, and 0.5 % over the jumps
        ((1.0, 0.8, 0.5), (3, 3, 103), 3),
    ],
)
def test_coverage_comes_first_and_then_the_fewest_knots_of_the_clearly_smallest_jumps(figures, outside, taken):
    judged = np.full(10, 10_000.0)

    def score(figure, count):
        return Score(judged, np.full(10, float(count)), 1.0, figure)

    found = [KnotCandidate(k + 1, score=score(*of)) for k, of in enumerate(zip(figures, outside, strict=True))]
    assert chosen_of(found).count == taken


def test_a_recording_unlike_all_others_excuses_nothing():
    """That no number of knots covers one left-out part does not hide what more of them leave outside of the others."""
    judged, one = np.full(10, 2000.0), np.array([900.0, 1, 0, 1, 0, 2, 1, 0, 1, 1])
    base, more = Score(judged, one, 1.0, 1.0), Score(judged, np.array([600.0, *(one[1:] + 25)]), 1.0, 0.5)
    assert more.share < base.share and not more.holds(base)


def test_many_recordings_are_left_out_several_together():
    short = [run(seed, 100) for seed in range(23)]
    chosen, table = choose_knots(short, "x1", **options())
    assert table["units"] == FOLDS and table["left_out"] == f"{FOLDS}th part of the recordings"
    assert chosen.score.judged.sum() == 2300


def test_groups_are_left_out_together():
    _, facts = choose_knots(RUNS, "x1", groups=list("aabbcc"), **options())
    assert facts["units"] == 3 and facts["left_out"] == "group"
    refuses(FitError, "nothing out", fit, RUNS, groups=list("aabbcc"))


def with_further(transients):
    """The runs with a signal that is neither state nor control: what bends the plant, and one that is nothing to it."""
    rng = np.random.default_rng(3)
    named = ("x1", "x2"), ("u1", "u2"), ("level", "weather")
    groups = (tuple(Signal(name, "/t", name, steady=0.0, scale=1.0) for name in names) for names in named)
    signals = SignalMap(*groups, schedule=(ScheduleRule("weather", "auto"),))
    further = [np.column_stack([t.x[:, 0], np.repeat(rng.uniform(-1, 1, len(t)), 9)[: len(t)]]) for t in transients]
    return [t.replace(s=s, signals=signals) for t, s in zip(transients, further, strict=True)]


def test_a_further_signal_that_is_not_worth_knots_is_no_part_of_the_model():
    runs = with_further(LINEAR)
    model = fit(runs, additive="noise")  # scheduled on the weather, as the signals say, with knots auto
    assert model.schedule is None and model.q == 0 and not model.signals.schedule
    assert model.fit_summary["schedule"][0]["chosen"] == 1
    assert any("'level' schedules nothing" in m for m in model.fit_summary["messages"])
    plain = fit(LINEAR, schedule={}, additive="noise", operating_point=model.operating_point)
    np.testing.assert_array_equal(model.dA, plain.dA)
    left = [[part.violated for part in validate(t, full=model, additive="noise").parts] for t in (runs, LINEAR)]
    assert left[0] == left[1]
    mine, theirs = (EnvelopeMonitor(model).check(run) for run in (runs[0], LINEAR[0]))
    np.testing.assert_array_equal(mine.upper, theirs.upper)
    discrepancies = [run_over(model, t) for t in (runs[0], LINEAR[0])]
    np.testing.assert_array_equal(*discrepancies)


def test_a_further_signal_that_schedules_nothing_is_left_out_and_said():
    runs = with_further(RUNS)
    model = fit(runs, schedule={}, **options())
    assert any("'weather' schedules nothing" in m for m in model.fit_summary["messages"])
    scheduled = fit(runs, schedule={"level": 3}, **options())
    assert [s.name for s in scheduled.signals.scheduling] == ["level"]
    point = OperatingPoint.of(*(getattr(runs[0].signals, kind) for kind in ("states", "controls", "scheduling")))
    again = fit(runs, schedule={"level": 3}, operating_point=point, **options())
    np.testing.assert_array_equal(scheduled.dA, again.dA)


def test_what_is_no_choice_is_refused_by_name():
    refuses(FitError, "is x1 meant", fit, RUNS, schedule={"x11": "auto"})
    refuses(FitError, "transient_weights", fit, RUNS, schedule={"x1": "auto"}, transient_weights=[1] * 6)
    refuses(FitError, "one or two", fit, RUNS, schedule={"x1": "auto", "x2": 3, "u1": 3})
    refuses(FitError, "'most'", fit, RUNS, schedule={"x1": "most"})


def test_a_rule_for_one_knot_needs_knots_that_are_given():
    runs = with_further(RUNS)
    rules = [{"state": "x1", "from": "u2", "nominal": 0, "knot": 1}]
    changed = {"structure": rules, "schedule": (ScheduleRule("level", "auto"),)}
    runs = [t.replace(signals=replace(t.signals, **changed)) for t in runs]
    refuses(FitError, r"structure\[0\]: knot is 1, and the knots of 'level' are auto", fit, runs, **options())
    model = fit(runs, schedule={"level": 2}, **options())
    assert model.B[0, 0, 1] == 0.0 != model.B[1, 0, 1]


def test_the_identification_itself_chooses_no_knots():
    refuses(FitError, "chooses none", fitting.fit, RUNS, schedule={"x1": "auto"})


def test_pieces_hold_transitions_of_the_recording_alone():
    long = run(9, 20_000)
    (some,) = thinned([long], 1000)
    whole = long.transitions()
    steps = some.transitions()
    assert 800 <= len(steps.k) <= 1300
    place = {x.tobytes(): k for k, x in enumerate(whole.x)}
    at = [place[x.tobytes()] for x in steps.x]
    assert (steps.x_next == whole.x_next[at]).all() and (steps.u == whole.u[at]).all()
    assert max(at) > 19_000 and thinned([long], 30_000) == [long]
    both = long.controls_at("both")
    (some,) = thinned([both], 1000)
    place = {x.tobytes(): k for k, x in enumerate(both.transitions().x)}
    at = [place[x.tobytes()] for x in some.transitions().x]
    assert some.ends == both.ends and (some.transitions().u == both.transitions().u[at]).all()


def test_promise_is_largest_for_the_signal_that_bends_the_plant():
    found = promise(RUNS)
    assert min(found, key=found.get) == "x1" and found["x1"] < 0.8
    assert all(value > 0.9 for value in promise(LINEAR).values())


def test_the_public_fit_takes_what_the_identification_takes():
    inner, outer = inspect.signature(fitting.fit).parameters, inspect.signature(uncertain_lti.fit).parameters
    chosen = {"criterion", "drop_horizons", "horizons", "widths", "alarm_rule", "near"}  # here what they are chosen by
    assert [outer[name] for name in inner if name not in chosen] == [inner[n] for n in inner if n not in chosen]
    assert set(outer) - set(inner) == {"alarm", "false_alarms", "groups"}


def test_validate_keeps_the_knots_of_the_model():
    full = fit(RUNS, schedule={"x1": [-1.0, 0.1, 1.0]}, **options())
    left = validate(RUNS, full=full, **options())
    assert left.model.schedule == full.schedule
    refuses(FitError, "its own schedule", validate, RUNS, full=full, schedule={"x1": 2})


@pytest.fixture
def folder(folder):
    """A recording of an engine, whose plant is linear, and its signals file."""
    (folder / "m.model.json").unlink()
    return folder


@pytest.fixture
def command(folder, cli):
    """`fit` of that recording."""
    words = ["fit", folder / "run.mcap", "--signals", folder / "signals.yaml", "--output", folder / "m.model.json"]
    return lambda *more: cli(*words, "--additive", "noise", *more).out


def test_the_command_prints_the_table_and_the_reason(folder, command):
    printed = command("--schedule", "fan=auto")
    assert "knots on fan, by leaving out one block of 5 at a time" in printed
    assert "1 (chosen)" in printed and "note: schedule: 1 knot on fan" in printed
    assert UncertainLTI.load(folder / "m.model.json").schedule is None


def test_the_modes_of_a_flag_may_be_true_and_false():
    asked = [_schedule(text)[2] for text in ("on=modes:false,true", "on=modes:0,1")]
    assert asked[0] == asked[1] == [0.0, 1.0]
    refuses(argparse.ArgumentTypeError, "neither auto", _schedule, "on=false,true")


def test_the_command_takes_knots_and_validate_keeps_them(folder, command):
    assert len(json.loads(command("--schedule", "fan=-0.1,0,0.1", "--json"))["fit"]["blocks"]) == 3
    model = UncertainLTI.load(folder / "m.model.json")
    assert model.schedule.blocks == 3
    assert main(["validate", str(folder / "m.model.json"), "--output", str(folder / "v.model.json")]) == 0
    again = UncertainLTI.load(folder / "v.model.json")
    assert again.schedule == model.schedule


def test_the_signals_file_asks_for_a_schedule(folder, command):
    with open(folder / "signals.yaml", "a") as file:
        file.write("schedule: [{signal: fan, knots: auto}]\n")
    command()
    model = UncertainLTI.load(folder / "m.model.json")
    assert model.fit_summary["schedule"][0]["signal"] == "fan"
    assert main(["validate", str(folder / "m.model.json")]) == 0
