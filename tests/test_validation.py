# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Validation: what it counts is what happens, and its intervals contain the truth as often as they say."""

import io
import json
import time
from contextlib import redirect_stdout
from fractions import Fraction
from math import comb

import numpy as np
import pytest
import validity
from bag_writer import record
from engine_bag import SIGNALS, engine_bag
from refusals import refuses
from scipy import stats
from tanks import Tanks

import uncertain_lti
from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI
from uncertain_lti.base.errors import FitError
from uncertain_lti.cli.main import main
from uncertain_lti.identification import fit
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.monitor.alarm import back_and_restarts
from uncertain_lti.recordings.bag_files import metadata_pairs
from uncertain_lti.reports.model_text import validation_text
from uncertain_lti.validation.groups import group_names
from uncertain_lti.validation.intervals import discarding_bound, rate_interval, scenario_interval, share_interval
from uncertain_lti.validation.left_out import cut, guard_interval, remaining_spans, validate
from uncertain_lti.validation.panel import learn
from uncertain_lti.validation.part import fitted_parts, judge, rising
from uncertain_lti.validation.result import raised_on

# --- intervals ---


@pytest.mark.parametrize(("total", "parts"), [(0, 10), (3, 10), (40, 200)])
def test_rate_interval_of_single_events_is_garwoods(total, parts):
    """With many parts and no clusters the exact Poisson limits come out; with few they are wider."""
    counts = np.zeros(parts)
    counts[:total] = 1
    low, high = rate_interval(counts, 2.0, 0.9)
    exact = (stats.chi2.ppf(0.05, 2 * total) / 2 if total else 0.0, stats.chi2.isf(0.05, 2 * total + 2) / 2)
    tail, of = stats.norm.cdf(stats.t.ppf(0.05, parts - 1)), 2 * total
    wide = (stats.chi2.ppf(tail, of) / 4.0 if total else 0.0, stats.chi2.isf(tail, of + 2) / 4.0)
    assert (low, high) == pytest.approx(wide, rel=1e-9) and low <= exact[0] / 2.0 and high >= exact[1] / 2.0
    assert rate_interval(counts, 2.0, 0.95, one_sided=True) == (0.0, pytest.approx(high))
    in_fours = stats.chi2.isf(tail, of / 4.0 + 2)  # alarms are known to come so
    assert rate_interval(counts, 2.0, 0.9, 4.0)[1] == pytest.approx(in_fours)
    if parts == 200:
        assert (low, high) == pytest.approx(np.array(exact) / 2.0, rel=0.02)


@pytest.mark.parametrize("clusters", [1.0, 8.0, 40.0])
@pytest.mark.parametrize("mean_size", [1.0, 4.0])
def test_rate_interval_covers_clustered_counts(clusters, mean_size):
    """Poisson clusters of geometric size over 20 transients: the interval holds the true rate 90 % of the time."""
    rng = np.random.default_rng(7)
    hits = 0
    for _ in range(600):
        counts = [rng.geometric(1 / mean_size, rng.poisson(clusters / 20)).sum() for _ in range(20)]
        low, high = rate_interval(counts, 20.0, 0.9, size=2 * mean_size - 1)
        hits += low <= clusters / 20 * mean_size <= high
    assert hits / 600 >= 0.87


def test_nothing_is_known_of_a_single_part():
    assert rate_interval([3], 1.0, 0.9) == (0.0, np.inf)
    assert rate_interval([0, 0], 0.0, 0.9) == (0.0, np.inf)


@pytest.mark.parametrize(("hits", "trials"), [(0, 7), (3, 7), (7, 7)])
def test_share_interval_is_exact(hits, trials):
    low, high = share_interval(hits, trials, 0.9)
    below = sum(comb(trials, i) * low**i * (1 - low) ** (trials - i) for i in range(hits, trials + 1))
    above = sum(comb(trials, i) * high**i * (1 - high) ** (trials - i) for i in range(hits + 1))
    assert low == 0.0 if hits == 0 else below == pytest.approx(0.05)
    assert high == 1.0 if hits == trials else above == pytest.approx(0.05)


@pytest.mark.parametrize(("k", "N"), [(0, 8), (1, 8), (5, 12), (11, 12), (12, 12), (30, 60)])
def test_scenario_interval_solves_its_equation(k, N):
    """Checked in exact arithmetic against the polynomial of Garatti and Campi, theorem 2."""
    low, high = scenario_interval(k, N, 0.9)
    b = Fraction(1, 10)

    def polynomial(t):
        t = Fraction(t)
        first = sum((comb(i, k) * t ** (i - k) for i in range(k, N)), Fraction(0))
        second = sum((comb(i, k) * t ** (i - k) for i in range(N + 1, 4 * N + 1)), Fraction(0))
        return comb(N, k) * t ** (N - k) - b / (2 * N) * first - b / (6 * N) * second

    edge = 1e-6
    if low > 0:
        assert polynomial(1 - low - edge) > 0 > polynomial(1 - low + edge)
    if k < N:
        assert polynomial(1 - high - edge) < 0 < polynomial(1 - high + edge)
    else:
        assert high == 1.0
    assert low <= k / N <= high


def test_scenario_interval_covers_the_risk_of_an_interval_of_extremes():
    """Smallest interval around N draws: two of them support it, and its risk is known exactly."""
    rng = np.random.default_rng(3)
    draws = rng.random((2000, 30))
    risk = 1 - np.ptp(draws, axis=1)
    low, high = scenario_interval(2, 30, 0.9)
    assert np.mean((low <= risk) & (risk <= high)) >= 0.9


def test_discarding_bound_is_exact_for_one_variable():
    """Largest of N draws after the k largest are discarded: P(risk > ε) is the binomial tail itself."""
    bound = discarding_bound(1, 3, 50, 0.9)
    risk = 1 - np.sort(np.random.default_rng(4).random((20000, 50)), axis=1)[:, -4]
    assert np.mean(risk <= bound) == pytest.approx(0.9, abs=0.01)
    assert discarding_bound(60, 0, 50, 0.9) == discarding_bound(50, 49, 100, 0.9) == 1.0


# --- counting ---


@pytest.fixture(scope="module")
def runs():
    return Tanks().transients(12, seed=3, noise=1e-3)


@pytest.fixture(scope="module")
def validation(runs):
    return validate(runs, criterion="qp", additive="noise", alarm_rule=AlarmRule(2, 3))


def test_it_is_leaving_out_by_hand(runs, validation):
    data = validation.to_dict()
    said, text = data["part"], validation_text(data)
    assert all(run.name in text for run in runs)
    assert "and 5 more rows" in validation_text({**data, "part": said * 2 + said[:1]})
    for g in (0, 5, 11):
        model = fit(runs[:g] + runs[g + 1 :], additive="noise")
        verdicts = EnvelopeMonitor(model, 2, 3).check(runs[g])
        part = validation.parts[g]
        assert part.name == runs[g].name and part.judged == verdicts.judged.sum()
        assert part.violated == verdicts.violated.sum()
        assert part.unseen == (verdicts.violated & ~verdicts.outside_domain).sum()
        assert np.array_equal(part.outside.sum(axis=0), (verdicts.flags == 1).sum(axis=0))
        edges = np.count_nonzero(np.diff(verdicts.alarm.astype(int)) == 1)
        largest, found = np.nanmax(np.abs(verdicts.utilisation), axis=0), said[g]
        assert found["alarms"] == edges and found["alarm_share"] == pytest.approx(verdicts.alarm.mean() * 101 / 100)
        assert found["farthest"] == pytest.approx(largest.max())
        assert found["farthest_state"] == f"x{largest.argmax() + 1}"
        assert rising(raised_on([AlarmRule(2, 3)], part), part.starts) == edges
        width = (verdicts.upper - verdicts.lower)[verdicts.judged]
        assert part.mean_width == pytest.approx(width.mean(axis=0))
        assert part.max_width == pytest.approx(width.max(axis=0))


def test_the_summary_adds_up(validation, runs):
    data = validation.to_dict()
    json.dumps(data, allow_nan=False, default=float)
    assert data["verdicts"] == 1200 and data["hours"] == pytest.approx(120 / 3600)
    assert data["inside"] == 1 - sum(p.violated for p in validation.parts) / 1200
    assert data["parts_inside"] == sum(p.violated == 0 for p in validation.parts)
    assert data["inside_interval"][0] <= data["inside"] <= data["inside_interval"][1]
    for name, state in data["states"].items():
        i = int(name[1]) - 1
        assert state["mean_width_full"] == pytest.approx(validation.model.fit_summary["mean_width_recorded"][i])
        assert state["inside"] >= data["inside"] and 0.8 < state["left_out_to_full"] <= 1.01
    rules = [a["rule"] for a in data["false_alarms"]]
    assert rules == ["at least 2 of 3 verdicts violated", "at least 1 of 1 verdicts violated"]  # the model's own first


@pytest.mark.parametrize(("m", "n"), [(1, 1), (2, 3), (5, 10)])
def test_alarms_are_those_of_the_monitor_at_any_margin(validation, runs, m, n):
    """Also where time jumps back in the middle of a transient, and where verdicts are missing."""
    first, second = runs[:2]
    x = np.vstack([np.where(np.arange(101)[:, None] == 40, np.nan, first.x), second.x * 1.3])
    looped = Transient(np.concatenate([first.t_ns, second.t_ns]), x, np.vstack([first.u, second.u]))
    part = judge(validation.model, validation.model, looped, "looped")
    assert len(part.starts) == 2
    for margin in (0.2, 0.4, 0.77, 1.0, 1.5):
        verdicts = EnvelopeMonitor(validation.model, m, n, margin).check(looped)
        alarm, reset = verdicts.alarm, back_and_restarts(looped.t_ns)[1]
        edges = alarm & ~np.concatenate([[False], alarm[:-1]]) | alarm & reset
        assert rising(raised_on([AlarmRule(m, n, margin)], part), part.starts) == np.count_nonzero(edges)


def test_a_recording_that_leaves_the_others_envelope_changes_it():
    """What the scenario bound counts; the reverse is not so, as every recording weighs in the objective of (10)."""
    runs = Tanks().transients(15, seed=5)
    validation = validate(runs, criterion="qp", additive="noise")
    full = validation.model
    left = [g for g, part in enumerate(validation.parts) if part.violated]
    assert 3 < len(left) < 15
    for g in left:
        s = runs[g].transitions()
        low, high = full.bounds(s.x, s.u, s.dt)
        assert ((low <= s.x_next) & (s.x_next <= high)).all()  # inside with it, outside without it
    words = validate(runs, additive="noise", confidence=0.5).to_dict()["scenario"]["words"]
    assert "a guide rather than a theorem" in words


def test_blocks_keep_their_distance():
    (run,) = Tanks().transients(1, seed=6, steps=2000, noise=1e-3)
    validation = validate(run, criterion="qp", additive="noise", blocks=8, gap=2.0)
    assert validation.kind == "blocks" and len(validation.parts) == 8 and validation.gap == 2.0
    assert sum(p.judged for p in validation.parts) == 2000
    for start, stop in ((0, 251), (750, 1001), (1750, 2001)):
        pieces = remaining_spans(run, start, stop, 2.0)
        kept = np.concatenate([np.arange(a, b) for a, b in pieces])
        assert len(set(kept) & set(range(start, stop))) == 0
        distance = np.minimum(np.abs(run.t[kept] - run.t[start]), np.abs(run.t[kept] - run.t[stop - 1]))
        assert distance.min() >= 2.0 - 1e-9
        assert len(kept) >= 2001 - (stop - start) - 2 * 20
    assert "not independent" in validation.to_dict()["scenario"]["words"]


def test_a_clock_that_begins_anew_parts_the_runs_of_a_recording():
    """What is left out of five runs, each from 0 s on, takes neighbours of its own run with it, and no other run."""
    t = np.tile(np.arange(100) * 0.1, 5)
    rng = np.random.default_rng(0)
    run = Transient(t, 0.1 * rng.normal(size=(500, 1)), rng.normal(size=(500, 1)))
    assert remaining_spans(run, 230, 270, 2.0) == [(0, 211), (289, 500)]
    assert remaining_spans(run, 205, 295, 2.0) == [(0, 200), (300, 500)]
    found = validate(run, blocks=5, additive="noise")
    assert sum(part.judged for part in found.parts) == 495 and found.gap > 0.0


@pytest.mark.parametrize(("middle", "gap"), [(50, 6.0), (8, 4.0)])
def test_the_guard_is_three_of_the_slowest_time_constants_or_half_of_the_shortest_block(middle, gap):
    zeros, run = np.zeros((3, 1)), Transient(np.arange(101.0), np.zeros((101, 3)), np.zeros((101, 1)))
    model = UncertainLTI(np.diag([-0.5, -4.0, 1.0]), zeros, np.zeros((3, 3)), zeros)
    assert guard_interval(model, [(run, 0, middle + 1), (run, middle, 101)]) == pytest.approx(gap)


def test_weights_go_with_their_samples():
    runs = Tanks().transients(4, seed=8, noise=1e-3)
    rng = np.random.default_rng(0)
    weights = [rng.uniform(0.1, 10, (100, 3)) for _ in runs]
    validation = validate(runs, weights=weights, additive="noise")
    model = fit(runs[:2] + runs[3:], weights=weights[:2] + weights[3:], additive="noise")
    assert validation.parts[2].mean_width == pytest.approx(judge(model, model, runs[2], "").mean_width)
    stacked = validate(runs, weights=np.vstack(weights), additive="noise")
    assert np.array_equal(stacked.parts[2].mean_width, validation.parts[2].mean_width)
    (whole,) = Tanks().transients(1, seed=8, noise=1e-3, steps=400)
    w = rng.uniform(0.1, 10, (400, 3))
    blocks = validate(whole, weights=[w], additive="noise", blocks=4, gap=0.0)
    a, b = remaining_spans(whole, 100, 201, 0.0)
    model = fit([cut(whole, *a), cut(whole, *b)], weights=[w[a[0] : a[1] - 1], w[b[0] : b[1] - 1]], additive="noise")
    assert blocks.parts[1].mean_width == pytest.approx(judge(model, model, cut(whole, 100, 201), "").mean_width)


def test_recordings_that_are_too_short_are_refused(runs):
    short = [cut(r, 0, 7) for r in runs[:2]]
    refuses(FitError, r"without tanks 3\.0 no model can be fitted: 6 usable", validate, short, additive="noise")


def test_few_recordings_are_said_to_say_little(runs):
    data = validate(runs[:3], additive="noise").to_dict()
    assert any("3 recordings say little" in note for note in data["notes"])
    assert "not enough transients" in data["scenario"]["words"] and "interval" not in data["scenario"]
    many = validate(Tanks().transients(40, seed=9, noise=1e-3, steps=50), additive="noise").to_dict()
    assert "drawn independently" in many["scenario"]["words"]
    low, high = many["scenario"]["interval"]
    assert 0 < low < 1 - many["parts_inside_share"] < high < 0.9


def test_discards_are_counted_as_recordings():
    """One state and one control are 5 unknowns: with 2 discards 10 recordings are too few, and 11 are enough."""
    runs = [Transient(r.t_ns, r.x[:, :1], r.u) for r in Tanks().transients(11, seed=10, noise=1e-3)]
    few, enough = (validate(some, additive="noise", discard=2).to_dict() for some in (runs[:10], runs))
    assert "not enough transients" in few["scenario"]["words"]
    assert any("may discard 2" in note for note in few["notes"])
    assert enough["scenario"]["interval"] == [0.0, discarding_bound(5, 2, 11, 0.9)]
    assert "discarded transition" in enough["scenario"]["words"]


# --- groups ---


@pytest.fixture(scope="module")
def days():
    """Three machine-days of four recordings each, and their names."""
    rng = np.random.default_rng(2)
    runs = [r for g in range(3) for r in validity.variant(Tanks(), rng, 0.05).transients(4, 50 + g, noise=1e-3)]
    return runs, [f"day {g}" for g in range(3) for _ in range(4)]


def test_a_whole_group_is_left_out_at_a_time(days):
    runs, names = days
    shuffled = [7, 0, 11, 3, 5, 2, 8, 1, 9, 4, 6, 10]  # a group need not stand together
    validation = validate([runs[i] for i in shuffled], groups=[names[i] for i in shuffled], additive="noise")
    parts = {p.name: p for p in validation.parts}
    model = fit([runs[i] for i in shuffled if names[i] != "day 1"], additive="noise")
    for i in range(12):
        assert parts[runs[i].name].group == names[i]
        if names[i] == "day 1":
            verdicts = EnvelopeMonitor(model).check(runs[i])
            assert parts[runs[i].name].violated == verdicts.violated.sum()
    data = validation.to_dict()
    assert data["parts"] == 12 and data["groups"]["count"] == 3
    of_day_2 = [r.name for r, n in zip(runs, names, strict=True) if n == "day 2"]
    assert sorted(data["groups"]["recordings"]["day 2"]) == sorted(of_day_2)
    counts = [sum(p.violated for p in validation.parts if p.group == f"day {g}") for g in range(3)]
    low, high = rate_interval(counts, 1200, 0.9)
    assert data["inside_interval"] == [max(0.0, 1 - high), 1 - low]
    assert data["groups"]["inside"] == counts.count(0)
    json.dumps(data, allow_nan=False, default=float)


def test_groups_of_one_recording_are_single_recordings(runs, validation):
    alone = validate(runs, groups=range(12), criterion="qp", additive="noise", alarm_rule=AlarmRule(2, 3))
    assert [p.violated for p in alone.parts] == [p.violated for p in validation.parts]
    seen = fitted_parts(validation.model, runs)
    one, other = alone.to_dict(), validation.to_dict()
    for key in ("inside_interval", "false_alarms"):
        assert one[key] == other[key]
    assert learn(alone, seen).rules == learn(validation, seen).rules


def test_the_condition_stands_beside_every_interval(days):
    runs, names = days
    for groups, what in ((None, "recordings"), (names, "groups")):
        validation = validate(runs, groups=groups, additive="noise")
        data = validation.to_dict()
        text = validation_text(data)
        beside = f"if the {what} are independent"
        for line in text.splitlines():
            assert "90% interval" not in line or beside in line
        assert text.count("90% interval") == 3 and "holds if they are independent of one another" in text
        missed = f"{1 - 0.1 ** (1 / validation.units):.0%}"  # of such runs, one in ten samples of so many has none
        assert f"in less than {missed} of the {what} may be in none of them" in text and "show all that happens" in text


def test_wrong_options_and_wrong_groups_are_refused(days):
    runs, names = days
    for options, words in (
        (dict(blocks=1), "blocks is 1"),
        (dict(gap=1.0), "goes with blocks"),
        (dict(blocks=4, gap=-1.0), "gap is -1"),
        (dict(blocks=90), "too few for 90 blocks"),
        (dict(confidence=1.0), "confidence is 1"),
        (dict(groups=["a"] * 12), r"of one group \(a\), so nothing is left"),
        (dict(groups=["a", "b"]), "2 groups for 12 recordings"),
        (dict(groups=names, blocks=3), "groups leave out whole recordings"),
        (dict(groups="weekday"), "is no key; use folder"),
        (dict(groups="folder"), "is no file"),
        (dict(groups="hours=0"), "positive number of hours"),
        (dict(groups="hours=1"), "no time of day"),
        (dict(groups="name=["), "no regular expression"),
        (dict(groups="name=day"), "finds nothing"),
    ):
        refuses(FitError, words, validate, runs, additive="noise", **options)


def at_hour(run, hour, name="run"):
    return Transient(run.t_ns + 1_700_000_000 * 10**9 + int(hour * 3600e9), run.x, run.u, name=name)


@pytest.mark.parametrize(
    ("hours", "words"),
    [
        ([0, 0.1, 0.2, 24, 24.1, 24.3], "of 2 sessions"),
        ([0, 0.1, 0.2, 0.4, 0.5, 0.6], "of one session"),
        ([0, 24, 48, 72, 96, 120], ""),  # a day each
        ([0, 0, 0, 0, 0, 0], ""),  # simulated: all at once
        ([-472222.2 + 0.1 * i for i in range(6)], ""),  # clocks that start at nothing
    ],
)
def test_groups_that_are_likely_are_named_if_none_were_given(runs, hours, words):
    shifted = [at_hour(r, h) for r, h in zip(runs, hours, strict=False)]
    notes = validate(shifted, additive="noise").to_dict()["notes"]
    assert any(words in n for n in notes) if words else not any("session" in n for n in notes)
    if "2 sessions" in words:
        told = validate(shifted, additive="noise", groups="hours=2")
        assert [p.group for p in told.parts] == ["2023-11-14T22:13:20Z"] * 3 + ["2023-11-15T22:13:20Z"] * 3
        assert not any("session" in n for n in told.to_dict()["notes"])
        assert not any("session" in n for n in validate(shifted, additive="noise", blocks=2).to_dict()["notes"])


# --- what is promised holds: fresh plants, fresh recordings, many times ---


@pytest.mark.slow
@pytest.mark.parametrize("study", list(validity.STUDIES))
def test_intervals_contain_the_truth_as_often_as_they_say(study):
    """The first plants of `benchmarks/validity.py`, which has 200: as few would fail by chance once in a hundred."""
    held = validity.STUDIES[study](range(3 if study in validity.SLOW else 8))
    held = {what: hits for what, hits in held.items() if not what.startswith(validity.PART)}
    promised = [what for what in held if not what.startswith((validity.IN_VAIN, validity.NEITHER))]
    few = min(len(held[what]) for what in promised)
    assert few >= 3 and sum(len(hits) for hits in held.values()) >= 8
    vain = {what: hits for what, hits in held.items() if what.startswith(validity.IN_VAIN)}
    for what in promised:
        hits = held[what]
        least = stats.binom.ppf(0.01, len(hits), validity.CONFIDENCE)
        assert sum(hits) >= least, f"{what}: the 90 % interval holds in {sum(hits)} of {len(hits)} only"
    # so the warning is needed
    assert all(np.mean(hits) < 0.8 for what, hits in vain.items() if "panel" not in what), vain


# --- commands ---


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    tmp_path = tmp_path_factory.mktemp("engine")
    (tmp_path / "signals.yaml").write_text(f"additive: noise\n{SIGNALS}")
    for seed in range(6):
        engine_bag(tmp_path / f"run{seed}.mcap", seed=seed)
    with redirect_stdout(io.StringIO()) as printed:
        assert fitted(tmp_path) == 0
    (tmp_path / "printed").write_text(printed.getvalue())
    return tmp_path


def fitted(folder):
    bags = [str(folder / f"run{seed}.mcap") for seed in range(6)]
    options = ["--signals", str(folder / "signals.yaml"), "--output", str(folder / "m.json"), "--force"]
    return main(["fit", *bags, *options])


def test_fit_prints_and_stores_what_leaving_out_gives(folder):
    printed = (folder / "printed").read_text()
    assert "left out one recording at a time (6 recordings)" in printed
    assert "(6 recordings), too little to say how rare they are" in printed
    stored = UncertainLTI.load(folder / "m.json").validation
    assert stored["kind"] == "transients" and stored["parts"] == 6 and len(stored["false_alarms"]) == 2


@pytest.mark.parametrize("name", ["run.mcap", "run[1].mcap"])
def test_a_model_finds_its_recordings_beside_it(name, tmp_path, monkeypatch, cli):
    """As `fit` was run in their folder, and `validate` from another one."""
    engine_bag(tmp_path / name, 200)
    (tmp_path / "signals.yaml").write_text(SIGNALS)
    monkeypatch.chdir(tmp_path)
    cli("fit", name, "--signals", "signals.yaml", "--output", "m.model.json", "--criterion", "lp")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert "left out one block at a time (10 blocks" in cli("validate", "../m.model.json", "--blocks", "10").out
    (tmp_path / name).unlink()
    said = cli("validate", "../m.model.json", status=2).err  # whoever names no recording has no path to check
    assert f"m.model.json: {name}, to which it was fitted, is not there; name its recordings after it" in said


def test_groups_of_a_fit_are_those_of_its_validation(folder, cli):
    """Folder, metadata and name group; what the fit was told, validate goes by."""
    bags = []
    for seed in range(6):
        place = folder / f"day{seed % 3}"
        place.mkdir(exist_ok=True)
        bags.append(place / f"run{seed}_m{seed % 2}.mcap")
        content = engine_bag(bags[-1], 150, seed).read_bytes()
        pairs = b"".join(len(w).to_bytes(4, "little") + w for w in (b"machine", f"M{seed // 2}".encode()))
        about = (5).to_bytes(4, "little") + b"about" + len(pairs).to_bytes(4, "little") + pairs
        header = 8 + 9 + int.from_bytes(content[9:17], "little")
        # the footer's places no longer fit, so it goes: a file that was cut is read all the same
        bags[-1].write_bytes(content[:header] + record(12, about) + content[header:-37])
        assert metadata_pairs(bags[-1]) == {"machine": f"M{seed // 2}", "about/machine": f"M{seed // 2}"}
    model = str(folder / "grouped.json")
    command = ["fit", *map(str, bags), "--signals", str(folder / "signals.yaml"), "--output", model, "--force"]
    command += ["--criterion", "lp"]  # given, nothing is tried
    assert "lie in 3 folders" in cli(*command).out
    printed = cli(*command, "--group", "metadata=machine").out
    assert "left out one group at a time (6 recordings in 3 groups, by metadata=machine)" in printed
    assert "lie in 3 folders" not in printed
    runs = uncertain_lti.read_transients(bags, folder / "signals.yaml")
    for by, said in ((None, "3 groups, by metadata=machine"), ("none", "one recording at a time")):
        assert said in validation_text(validate(UncertainLTI.load(model), runs, groups=by).to_dict())
    outside = uncertain_lti.read_transients(folder / "run0.mcap", folder / "signals.yaml")
    assert group_names([*outside, *runs], "folder") == [folder.name, *["day0", "day1", "day2"] * 2]
    assert group_names(runs, "name=_m(\\d)") == ["0", "1"] * 3 and group_names(runs, "name=_m") == ["_m"] * 6
    said = cli(*command, "--group", "metadata=pilot", status=2).err
    assert "no 'pilot' to group by; there is about/machine, machine" in said.splitlines()[-1]


def test_what_a_fit_says_of_itself_does_not_depend_on_the_load(folder, capsys, monkeypatch):
    """The same inputs on a machine a thousand times as slow give the same validation."""
    before = UncertainLTI.load(folder / "m.json").validation
    clock = [0.0]

    def slow():
        clock[0] += 1000.0
        return clock[0]

    monkeypatch.setattr(time, "perf_counter", slow)
    monkeypatch.setattr(time, "monotonic", slow)
    assert fitted(folder) == 0
    assert UncertainLTI.load(folder / "m.json").validation == before and before["parts"] == 6


def test_validate_refuses_what_it_cannot_vouch_for(folder):
    weighted = UncertainLTI.load(folder / "m.json")
    weighted = weighted.replace(fit_summary={**weighted.fit_summary, "weights": "per state"})
    refuses(FitError, "fitted with weights", validate, weighted, [])


# --- one call ---


def test_a_model_is_validated_with_its_own_settings(runs):
    """validate(model, runs) is validate(runs, ...) with every setting of the fit given again by hand."""
    model = fit(runs[:6], "lp", additive="noise", schedule={"x1": 2}, count="transient")
    model = model.replace(alarm_rule=AlarmRule(2, 3))
    mine = uncertain_lti.validate(model, runs[:6], confidence=0.8).to_dict()
    by_hand = validate(runs[:6], full=model, criterion="lp", additive="noise", count="transient", confidence=0.8)
    assert mine == by_hand.to_dict() and "2 of 3" in mine["false_alarms"][0]["rule"]
    other = validate(runs[:6], criterion="qp", additive="noise").to_dict()
    assert mine["states"] != other["states"]
    public = uncertain_lti.validate(runs[:6], additive="noise").to_dict()
    assert public == validate(runs[:6], additive="noise").to_dict()


def test_a_model_is_not_validated_with_other_settings_or_nothing(runs):
    model = fit(runs[:3], additive="noise")
    refuses(FitError, r"give the recordings .* validate\(model, runs\)", uncertain_lti.validate, model)
    with pytest.raises(FitError, match="criterion: a model is validated with its own settings"):
        uncertain_lti.validate(model, runs[:3], criterion="lp")
    refuses(FitError, "twice", uncertain_lti.validate, runs[:3], runs[:3])
