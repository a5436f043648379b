# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The report: its answers follow from the facts, it is one page that needs nothing else, and files never speak HTML."""

import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from engine_bag import SIGNALS, engine_bag
from hypothesis import given
from hypothesis import strategies as st

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI, read_transients
from uncertain_lti.cli.main import main
from uncertain_lti.identification import fit
from uncertain_lti.reports.findings import APART, MOST_EPISODES, findings
from uncertain_lti.reports.html import MOST_DRAWN, html_report
from uncertain_lti.reports.reliance import CARE, NO, UNKNOWN, YES
from uncertain_lti.reports.tables import beyond
from uncertain_lti.validation.left_out import validate

HOSTILE = "<script>alert(1)</script>\"'&amp;<img src=http://x/y.png onerror=alert(2)>\u202e\x07"


class Page(HTMLParser):
    """Tags, attributes and text of a page."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.tags, self.attributes, self.text, self.open = set(), [], [], []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in ("meta", "img", "br", "wbr", "input"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.text.append(data)


def needs_nothing_else(page):
    """No script, no handler, nothing that is loaded; anchors stay on the page."""
    assert not page.tags & {"script", "link", "iframe", "object", "embed", "form", "base", "video", "audio"}
    for tag, name, value in page.attributes:
        assert not name.startswith("on")
        assert name != "style" or re.fullmatch(r"(left|top):-?[\d.]+%|height:\d+px", value), value
        if name == "src":
            assert tag == "img" and value.startswith("data:image/png;base64,")
        elif name == "href":
            assert value.startswith("#")


@pytest.fixture(scope="module")
def engine(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    (folder / "signals.yaml").write_text(SIGNALS)
    engine_bag(folder / "run.mcap")
    engine_bag(folder / "other.mcap", steps=250, seed=5)
    engine_bag(folder / "bad.mcap", change=lambda k, x: x + (5.0 if 100 <= k < 103 else 0.0) * np.eye(5)[0])
    runs = read_transients([folder / "run.mcap"], folder / "signals.yaml")
    fit(runs, additive="noise").save(folder / "m.model.json")
    return folder


def test_the_page_answers_first(engine, tmp_path, capsys):
    out = tmp_path / "page.html"
    model = str(engine / "m.model.json")
    assert main(["report", model, str(engine / "bad.mcap"), str(engine / "other.mcap"), "--output", str(out)]) == 1
    said = capsys.readouterr().out
    assert "may I rely on it? unknown" in said and str(out) in said
    page = Page(out.read_text(encoding="utf-8"))
    needs_nothing_else(page)
    text = " ".join(page.text)
    first = text.index("alarm score"), text.index("May I rely on it?"), text.index("What happened?")
    assert first == tuple(sorted(first)) and first[-1] < text.index("All recordings")
    weights = [line.strip().partition(":")[0] for line in said.splitlines() if line.startswith("  ")]
    listed = {weight for weight in weights if weight in ("no", "unknown", "with care", "yes")}
    assert listed and all(f"{weight}:" in text for weight in listed), "the terminal and the page use the same words"
    assert "has not been validated" in text
    assert "bad.mcap" in text and "2.5" in text and "fan (" in text
    assert text.index("states (violations,") < text.index("last [s]"), "a phone shows the first columns"
    assert out.stat().st_size < 1_000_000
    assert list(tmp_path.iterdir()) == [out]


def test_json_has_the_facts_of_the_page(engine, tmp_path, capsys):
    model, bags = str(engine / "m.model.json"), [str(engine / name) for name in ("bad.mcap", "other.mcap")]
    assert main(["report", model, *bags, "--json"]) == 1
    facts = json.loads(capsys.readouterr().out)
    assert main(["check", model, *bags, "--json"]) == 1
    checked = json.loads(capsys.readouterr().out)["recordings"]
    for said, recording in zip(facts["recordings"], checked, strict=True):
        assert {key: said[key] for key in ("verdicts", "violated", "alarm", "alarms", "inside")} == {
            key: recording[key] for key in ("verdicts", "violated", "alarm", "alarms", "inside")
        }
        for name, state in recording["states"].items():
            assert {key: said["states"][name][key] for key in state} == state
    assert facts["recordings"][0]["episodes"][0]["first"]["k"] == 100
    assert set(facts["recordings"][0]["episodes"][0]["states"]) >= {"fan"}
    assert len(facts["model"]["sha256"]) == 64 and facts["recordings"][0]["files"][0]["file"] == bags[0]
    assert facts["rely"]["answer"] in (UNKNOWN, NO) and facts["validation"] is None
    out = tmp_path / "p.html"
    assert main(["report", model, *bags, "--json", "--output", str(out)]) == 1
    assert json.loads(capsys.readouterr().out) == facts and out.exists()
    assert main(["report", model, str(engine / "other.mcap"), "--output", str(out), "--quiet"]) in (0, 1)
    assert capsys.readouterr().out == ""


def test_what_was_fitted_proves_nothing(engine, capsys, tmp_path):
    """And a validated model says how it did on what was left out."""
    runs = read_transients([engine / "run.mcap", engine / "other.mcap"], engine / "signals.yaml")
    model = fit(runs, additive="noise")
    model = model.replace(validation=validate(runs, additive="noise", full=model).to_dict())
    model.save(tmp_path / "v.model.json")
    from uncertain_lti.reports.findings import sha256

    source = {"file": "elsewhere/run.mcap", "sha256": sha256(engine / "run.mcap")}
    model.replace(fit_summary={**model.fit_summary, "sources": [source]}).save(tmp_path / "v.model.json")
    assert main(["report", str(tmp_path / "v.model.json"), str(engine / "run.mcap"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    reasons = {r["about"]: r for r in facts["rely"]["reasons"] if r["about"] != "fit"}
    assert "proves nothing" in reasons["recordings"]["text"]
    inside = model.validation["inside"]
    assert facts["validation"]["inside"] == inside
    assert reasons["validation"]["weight"] == (NO if inside < 0.9 else CARE if inside < 0.99 else YES)
    (loaded,) = [UncertainLTI.load(tmp_path / "v.model.json")]
    verdicts = [EnvelopeMonitor(loaded).check(runs[0])]
    page = Page(html_report(loaded, verdicts, findings(loaded, tmp_path / "v.model.json", verdicts)))
    assert "Left out one recording at a time" in " ".join(page.text)


def test_names_from_files_are_text(tmp_path, engine):
    """In names, units, notes, messages, sections of the model file and paths."""
    model = UncertainLTI.load(engine / "m.model.json")
    signals = replace(
        model.signals,
        states=tuple(replace(s, name=f"{HOSTILE}{i}", unit=HOSTILE) for i, s in enumerate(model.signals.states)),
    )
    nasty = {
        **model.fit_summary,
        "criterion": HOSTILE,
        "messages": [HOSTILE, 3],
        "sources": [{"file": HOSTILE, "sha256": HOSTILE}, HOSTILE],
        "transients": HOSTILE,
    }
    run = read_transients(engine / "bad.mcap", engine / "signals.yaml")[0]
    transient = Transient(run.t_ns, run.x, run.u, name=f"/x/{HOSTILE}", signals=signals, notes=[HOSTILE])
    good = validate([run], additive="noise").to_dict()
    validations = [
        {},
        {"kind": HOSTILE},
        {**good, "inside": HOSTILE},
        {**good, "states": {s.name: next(iter(good["states"].values())) for s in signals.states}, "kind": HOSTILE},
        {**good, "false_alarms": [{**good["false_alarms"][0], "alarms": HOSTILE}]},
        {**good, "notes": [HOSTILE], "states": {s.name: next(iter(good["states"].values())) for s in signals.states}},
    ]
    for validation in validations:
        changed = model.replace(signals=signals, fit_summary=nasty, validation=validation)
        verdicts = [EnvelopeMonitor(changed).check(transient)]
        facts = findings(changed, f"{HOSTILE}.json", verdicts)
        text = html_report(changed, verdicts, facts)
        needs_nothing_else(Page(text))
        assert "<script" not in text and "\u202e" not in text and "\x07" not in text
        assert "alert(1)" in text  # shown, as text
        json.dumps(facts, allow_nan=False)


def by_hand(n=2):
    return UncertainLTI(np.zeros((n, n)), np.zeros((n, 1)), np.zeros((n, n)), np.zeros((n, 1)), v=np.full(n, 0.5))


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
        assert (
            between > APART or (np.diff(verdicts.transient.t_ns[one["last"]["k"] : other["first"]["k"] + 1]) < 0).any()
        )


def judged(widths, validation=None, decay=1.0):
    """Findings on a run of states that move between -1 and 1, by bounds of these half-widths."""
    rng = np.random.default_rng(3)
    n = len(widths)
    x = np.clip(np.cumsum(rng.uniform(-0.1, 0.1, (600, n)), axis=0), -1, 1)
    run = Transient(np.arange(600) * 0.01, x, np.zeros((600, 1)))
    model = fit([run], additive="noise").replace(A=-decay * np.eye(n), B=np.zeros((n, 1)), v=np.array(widths))
    model = model.replace(fit_summary={"criterion": "qp"}, validation=validation or {})
    return findings(model, "m", [EnvelopeMonitor(model).check(run)])


def validated(parts_inside, parts, inside):
    state = {"inside": inside, "mean_width_left_out": 0.1, "mean_width_full": 0.1, "parts_inside": parts_inside}
    facts = {"kind": "transients", "parts": parts, "verdicts": 1000, "parts_inside": parts_inside, "hours": 1.0}
    facts |= {"inside": inside, "inside_interval": [0.9, 1.0], "confidence": 0.95, "false_alarms": [], "notes": []}
    return {**facts, "states": {"x1": state, "x2": state}, "scenario": {"words": "w"}}


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


def test_a_nominal_model_that_runs_away_is_named():
    assert not any(r["about"] == "stability" for r in judged([0.15, 0.15])["rely"]["reasons"])
    (reason,) = [r for r in judged([0.15, 0.15], decay=1800.0)["rely"]["reasons"] if r["about"] == "stability"]
    assert reason["weight"] == CARE and "17 times in a step" in reason["text"]


@given(st.floats(1.0, 1e6, exclude_min=True), st.sampled_from([-1.0, 1.0]))
def test_a_violation_reads_as_beyond_its_bound(size, sign):
    text = beyond(sign * size)
    if text.startswith("just beyond"):
        assert size < 1 + 1e-8 and text.endswith("-1" if sign < 0 else " 1")
    else:
        assert abs(float(text)) > 1 and float(text) == pytest.approx(sign * size, rel=0.01)


def test_endless_violations_stay_one_page():
    model = by_hand()
    count = (APART + 2) * (MOST_EPISODES + 50)
    x = np.zeros((count, 2))
    x[:: APART + 2, 0] = 10.0
    verdicts = [EnvelopeMonitor(model).check(Transient(np.arange(count) * 0.01, x, np.zeros((count, 1))))]
    facts = findings(model, "m", verdicts)
    assert len(facts["recordings"][0]["episodes"]) == MOST_EPISODES < facts["recordings"][0]["episode_count"]
    text = html_report(model, verdicts, facts)
    assert len(text) < 3_000_000 and text.count("<tr>") < 200


def blip_and_fault():
    """A single violated sample at 1 s, and a fault from 6 s to 7 s that moves a state at every sample."""
    x = np.zeros((1000, 2))
    x[100, 0], x[600:700, 1] = 1.0, np.where(np.arange(100) % 2, 3.0, -3.0)
    model = by_hand()
    verdicts = EnvelopeMonitor(model).check(Transient(np.arange(1000) * 0.01, x, np.zeros((1000, 1)), name="r/run_1"))
    return model, verdicts, findings(model, "m", [verdicts])


def test_charts_say_what_they_show():
    """And the closer look is at the fault, not at the first sample outside."""
    model, verdicts, facts = blip_and_fault()
    assert [e["first"]["t"] for e in facts["recordings"][0]["episodes"]] == [1.0, 6.0]
    page = Page(html_report(model, [verdicts], facts))
    first, closer, whole = [value for tag, name, value in page.attributes if name == "aria-label"]
    assert "x2 101 times from 6 s, x1 2 times from 1 s" in first and "raised 2 times, first at 1 s" in first
    assert closer.startswith("Closer") and "x2 101 times from 6 s" in closer and "x1" not in closer
    assert "from 6 s" in whole and "Always inside" not in whole


def drawn(page, role):
    """Points of every path of a role, (x, y) pairs in the drawing's own coordinates."""
    paths = re.findall(rf'<path class="{role}[^"]*" d="([^"]*)"', page)
    return [
        np.array([float(v) for v in re.findall(r"[\d.]+", path.replace("h0", ""))]).reshape(-1, 2) for path in paths
    ]


def test_a_chart_draws_the_numbers():
    """Of the score, its height over the threshold; of a state, where it left its bounds; and where the alarm is."""
    model, verdicts, facts = blip_and_fault()
    page = html_report(model, [verdicts], facts)
    score, (x2, *_) = drawn(page, "score")[0], drawn(page, "violated")
    assert score[:, 1].min() < 1000 * (1 - 1 / 6) and len(x2) == 101  # above its threshold
    assert x2[:, 0].min() == round(2000 * 6.0 / 9.99)
    begins = [float(x) for x in re.findall(r'<rect class="alarm" x="([\d.]+)"', page)]
    assert begins[:2] == pytest.approx([2000 * 1.0 / 9.99, 2000 * 6.0 / 9.99], abs=0.1)


def test_names_break_between_words():
    from uncertain_lti.reports.html import environment

    name = environment().filters["name"]
    assert name("turbine_exit_total_pressure") == "turbine_<wbr>exit_<wbr>total_<wbr>pressure"
    assert name("/a//b") == "/<wbr>a//<wbr>b" and Page(name(HOSTILE)).tags == {"wbr"}


def test_no_verdict_is_no_good_news():
    model = by_hand()
    verdicts = [EnvelopeMonitor(model).check(Transient([0.0], [[0.0, 0.0]], [[0.0]]))]
    facts = findings(model, "m", verdicts)
    assert facts["rely"]["answer"] == NO and facts["happened"][0]["state"] == "unknown" and not facts["alarm"]
    assert "Nothing left" not in html_report(model, verdicts, facts)


@pytest.mark.slow
def test_fifty_states_and_forty_recordings():
    rng = np.random.default_rng(0)
    n = 50
    model = UncertainLTI(
        -np.eye(n), rng.normal(size=(n, 3)), 0.1 * np.ones((n, n)), np.zeros((n, 3)), v=np.full(n, 0.05)
    )
    runs = [0.01 * rng.normal(size=(3000, n)) + (k == 7) * rng.normal(size=(3000, n)) for k in range(40)]
    verdicts = [
        EnvelopeMonitor(model).check(Transient(np.arange(3000) * 0.01, x, np.zeros((3000, 3)), name=f"run {k}"))
        for k, x in enumerate(runs)
    ]
    text = html_report(model, verdicts, findings(model, "m", verdicts))
    needs_nothing_else(Page(text))
    assert len(text) < 6_000_000 and text.count("<figure") <= 4 * MOST_DRAWN + 1


def test_bad_places_are_one_sentence(engine, tmp_path, capsys):
    model, bag = str(engine / "m.model.json"), str(engine / "bad.mcap")
    before = Path(bag).read_bytes(), Path(model).read_bytes()
    for output, why in (
        (bag, "is about"),
        (model, "is about"),
        (str(tmp_path), "is a folder"),
        (str(tmp_path / "no" / "x.html"), "make it first"),
    ):
        assert main(["report", model, bag, "--output", output]) == 2
        said = capsys.readouterr()
        assert why in said.err and said.err.count("\n") == 1 and not said.out
    assert (Path(bag).read_bytes(), Path(model).read_bytes()) == before


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


def test_a_model_that_most_data_leaves_and_nothing_vouches_for_is_refused():
    model = fit([sways(1.0)], additive="noise")
    other = Transient(np.arange(1000) * 0.1, sways(1.0, 2).x[::-1].copy() * 1.5, sways(1.0, 3).u)
    checked = EnvelopeMonitor(model).check(other)
    facts = findings(model, "m", [checked])
    if checked.violated.sum() <= 0.5 * checked.judged.sum():
        pytest.fail("the recording is to leave the model")
    assert facts["rely"]["answer"] == NO
    vouched = model.replace(
        validation={**validated(10, 10, 1.0), "states": {"x1": validated(10, 10, 1.0)["states"]["x1"]}}
    )
    reasons = findings(vouched, "m", [EnvelopeMonitor(vouched).check(other)])["rely"]["reasons"]
    assert not any("cannot tell a fault" in r["text"] for r in reasons)  # then it may well be one


def test_what_weighs_most_is_printed_first():
    from uncertain_lti.reports.findings import findings_text

    text = findings_text(judged([0.9, 0.9], validated(9, 10, 0.9999))).splitlines()
    weights = [line.split(":")[0].strip() for line in text[1:] if not line.startswith("what")]
    assert text[0] == "may I rely on it? no" and weights[0] == "no"
