# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Pages: they answer first, hide nothing that was recorded or violated, and files never become a part of them."""

import base64
import hashlib
import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from engine_bag import engine_bag

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI, read_transients
from uncertain_lti.base.files import sha256
from uncertain_lti.cli.main import main
from uncertain_lti.identification import fit
from uncertain_lti.model.horizon import Horizon
from uncertain_lti.reports import pages
from uncertain_lti.reports.findings import CARE, NO, UNKNOWN, YES, findings
from uncertain_lti.reports.pages import html_report, interactive_page, plotted_check, plotted_transient
from uncertain_lti.validation.left_out import validate

ASSETS = Path(pages.__file__).parent / "assets"
HOSTILE = "</script><script>alert(1)</script>\"'&amp;<img src=http://x/y.png onerror=alert(2)>\u202e\x07"


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
        if self.open and self.open[-1] not in ("style", "script"):
            self.text.append(data)


def needs_nothing_else(text):
    """The page, in which no script runs but its own, no handler is set and nothing is loaded; anchors stay on it."""
    page = Page(text)
    scripts = re.findall(r"<script>(.*?)</script>", text, re.DOTALL)
    assert len(scripts) == 2 and text.count("</script>") == 3
    (allowed,) = re.findall(r"default-src 'none'; script-src ([^;]*);", text)
    sums = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    assert allowed.split() == [f"'sha256-{one}'" for one in sums]
    assert not page.tags & {"img", "link", "iframe", "object", "embed", "form", "base", "video", "audio"}
    for _, name, value in page.attributes:
        assert not name.startswith("on") and name not in ("style", "src")
        assert name != "href" or value.startswith("#")
    return page


def data_of(page):
    """The data of a page as its script reads them."""
    (text,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    return json.loads(text)["recordings"]


def array(packed):
    return np.frombuffer(base64.b64decode(packed["data"]), "<f4").astype(float) + packed["offset"]


def times(packed):
    return np.frombuffer(base64.b64decode(packed), "<f8")


def marks(packed):
    return np.frombuffer(base64.b64decode(packed["marked"]["at"]), "<u4")


def by_hand(n=2):
    return UncertainLTI(np.zeros((n, n)), np.zeros((n, 1)), np.zeros((n, n)), np.zeros((n, 1)), v=np.full(n, 0.5))


@pytest.fixture(scope="module")
def engine(engine_folder, tmp_path_factory):
    folder = Path(shutil.copytree(engine_folder, tmp_path_factory.mktemp("report") / "engine"))
    engine_bag(folder / "other.mcap", steps=250, seed=5)
    fit(read_transients(folder / "run.mcap", folder / "signals.yaml"), additive="noise").save(folder / "m.model.json")
    return folder


# --- report ----------------------------------------------------------------------------------------------------------


def test_the_page_answers_first(engine, tmp_path, cli):
    out = tmp_path / "page.html"
    model = str(engine / "m.model.json")
    said = cli("report", model, engine / "bad.mcap", engine / "other.mcap", "--output", out, status=1).out
    assert "may I rely on it? unknown" in said and str(out) in said
    page = needs_nothing_else(out.read_text(encoding="utf-8"))
    text = " ".join(page.text)
    titles = ("May I rely on it?", "What happened?", "Which faults would it see?", "All recordings")
    assert [text.index(title) for title in titles] == sorted(text.index(title) for title in titles)
    weights = [line.strip().partition(":")[0] for line in said.splitlines() if line.startswith("  ")]
    listed = {weight for weight in weights if weight in ("no", "unknown", "with care", "yes")}
    assert listed and all(f"{weight}:" in text for weight in listed), "the terminal and the page use the same words"
    assert "has not been validated" in text and "bad.mcap" in text and "2.5" in text and "fan (" in text
    assert text.index("states (violations,") < text.index("last [s]"), "a phone shows the first columns"
    assert out.stat().st_size < 1_000_000 and list(tmp_path.iterdir()) == [out]
    assert {r["name"] for r in data_of(out.read_text()) if r["alarms"]} >= {"bad.mcap"}


def test_json_has_the_facts_of_the_page(engine, tmp_path, capsys, cli):
    model, bags = str(engine / "m.model.json"), [str(engine / name) for name in ("bad.mcap", "other.mcap")]
    facts = cli.json("report", model, *bags, status=1)
    checked = cli.json("check", model, *bags, status=1)["recordings"]
    for said, recording in zip(facts["recordings"], checked, strict=True):
        assert all(said[key] == recording[key] for key in ("verdicts", "violated", "alarm", "alarms", "inside"))
        for name, state in recording["states"].items():
            assert {key: said["states"][name][key] for key in state} == state
    assert facts["recordings"][0]["episodes"][0]["first"]["k"] == 100
    assert set(facts["recordings"][0]["episodes"][0]["states"]) >= {"fan"}
    assert len(facts["model"]["sha256"]) == 64 and facts["recordings"][0]["files"][0]["file"] == bags[0]
    assert facts["rely"]["answer"] in (UNKNOWN, NO) and facts["validation"] is None
    out = tmp_path / "p.html"
    assert cli.json("report", model, *bags, "--output", out, status=1) == facts and out.exists()
    assert main(["report", model, str(engine / "other.mcap"), "--output", str(out), "--quiet"]) in (0, 1)
    assert capsys.readouterr().out == ""


def test_what_was_fitted_proves_nothing(engine, cli, tmp_path):
    """And a validated model says how it did on what was left out."""
    runs = read_transients([engine / "run.mcap", engine / "other.mcap"], engine / "signals.yaml")
    model = fit(runs, additive="noise")
    model = model.replace(validation=validate(runs, additive="noise", full=model).to_dict())
    model.save(tmp_path / "v.model.json")
    source = {"file": "elsewhere/run.mcap", "sha256": sha256(engine / "run.mcap")}
    model.replace(fit_summary={**model.fit_summary, "sources": [source]}).save(tmp_path / "v.model.json")
    facts = cli.json("report", tmp_path / "v.model.json", engine / "run.mcap")
    reasons = {r["about"]: r for r in facts["rely"]["reasons"] if r["about"] != "fit"}
    assert "proves nothing" in reasons["recordings"]["text"]
    inside = model.validation["inside"]
    assert facts["validation"]["inside"] == inside
    assert reasons["validation"]["weight"] == (NO if inside < 0.9 else CARE if inside < 0.99 else YES)
    loaded = UncertainLTI.load(tmp_path / "v.model.json")
    verdicts = [EnvelopeMonitor(loaded).check(runs[0])]
    page = html_report(loaded, verdicts, findings(loaded, tmp_path / "v.model.json", verdicts))
    assert "left out one recording at a time" in page


def test_a_long_note_keeps_its_remedy(engine):
    model = UncertainLTI.load(engine / "m.model.json")
    note = f"rank deficient: {'signals of long names, ' * 30}record them moving independently, or leave one out"
    noted = model.replace(fit_summary={**model.fit_summary, "messages": [note]})
    run = read_transients(engine / "other.mcap", engine / "signals.yaml")[0]
    verdicts = [EnvelopeMonitor(noted).check(run)]
    page = html_report(noted, verdicts, findings(noted, "m.json", verdicts))
    assert "leave one out" in page.partition("What happened?</h")[0].rpartition("May I rely on it?")[2]


def test_names_from_files_are_text(engine):
    """In names, units, notes, messages, sections of the model file and paths."""
    model = UncertainLTI.load(engine / "m.model.json")
    states = tuple(replace(s, name=f"{HOSTILE}{i}", unit=HOSTILE) for i, s in enumerate(model.signals.states))
    signals = replace(model.signals, states=states)
    nasty = {
        **model.fit_summary,
        "criterion": HOSTILE,
        "messages": [HOSTILE, 3],
        "sources": [{"file": HOSTILE, "sha256": HOSTILE}, {"sha256": {"a": 1}}, HOSTILE],
        "transients": HOSTILE,
    }
    run = read_transients(engine / "bad.mcap", engine / "signals.yaml")[0]
    transient = Transient(run.t_ns, run.x, run.u, name=f"/x/{HOSTILE}", signals=signals, notes=[HOSTILE])
    good = validate([run], additive="noise").to_dict()
    states = {s.name: next(iter(good["states"].values())) for s in signals.states}
    validations = [
        {"kind": HOSTILE},
        {**good, "inside": HOSTILE},
        {**good, "false_alarms": [{**good["false_alarms"][0], "alarms": HOSTILE}]},
        {**good, "notes": [HOSTILE], "states": states},
    ]
    for validation in validations:
        changed = model.replace(signals=signals, fit_summary=nasty, validation=validation)
        verdicts = [EnvelopeMonitor(changed).check(transient)]
        facts = findings(changed, f"{HOSTILE}.json", verdicts)
        assert (facts["validation"] is not None) == ("notes" in validation and HOSTILE in validation["notes"])
        text = html_report(changed, verdicts, facts)
        needs_nothing_else(text)
        assert re.search(r"<th>[^<]*/<wbr>", text), "on paper a matrix is no wider than the page"
        assert "\u202e" not in text and "\x07" not in text and "alert(1)" in text  # shown, as text
        assert data_of(text)[0]["views"]["values"][0]["title"].startswith("</script>")
        json.dumps(facts, allow_nan=False)


def test_a_report_of_very_much_stays_one_page():
    """Of endless episodes the first, and of fifty states and forty recordings those with most violations."""
    model = by_hand()
    x = np.zeros((12 * 1050, 2))
    x[::12, 0] = 10.0
    verdicts = [EnvelopeMonitor(model).check(Transient(np.arange(len(x)) * 0.01, x, np.zeros((len(x), 1))))]
    text = html_report(model, verdicts, findings(model, "m", verdicts))
    assert len(text) < 3_000_000 and text.count("<tr>") < 200
    rng, n = np.random.default_rng(0), 50
    B, widths = rng.normal(size=(n, 3)), (0.1 * np.ones((n, n)), np.zeros((n, 3)))
    model = UncertainLTI(-np.eye(n), B, *widths, v=np.full(n, 0.05))
    runs = [0.01 * rng.normal(size=(800, n)) + (k == 7) * rng.normal(size=(800, n)) for k in range(40)]
    verdicts = [
        EnvelopeMonitor(model).check(Transient(np.arange(800) * 0.01, x, np.zeros((800, 3)), name=f"run {k}"))
        for k, x in enumerate(runs)
    ]
    text = html_report(model, verdicts, findings(model, "m", verdicts))
    needs_nothing_else(text)
    assert len(text) < 8_000_000 and [r["name"] for r in data_of(text)][0] == "run 7" and "run 39" in text


# --- panels ----------------------------------------------------------------------------------------------------------


def test_the_library_is_as_it_was_published():
    """Of uPlot 1.6.32, file by file; its licence comes with it."""
    known = {
        "uPlot.iife.min.js": "19c8d4c6ad88929a79f4ae49d6f7161566dfd0ba3d15cc495e974f787eb78f1f",
        "uPlot.min.css": "df630c6a8d6f8eeaff264b50f73ce5b114f646ffd9a0bb74f049b0a00135fa04",
    }
    assert {name: hashlib.sha256((ASSETS / name).read_bytes()).hexdigest() for name in known} == known
    assert "MIT License" in (ASSETS / "uPlot.LICENSE").read_text()


def test_a_short_recording_is_drawn_sample_by_sample():
    rng = np.random.default_rng(0)
    x = 1e6 + 0.1 * rng.normal(size=(300, 2))
    x[100, 0] += 3.0
    t = np.arange(300) * 0.01
    t[200:] += 5.0
    model = by_hand()
    verdicts = EnvelopeMonitor(model).check(Transient(t, x, rng.normal(size=(300, 1)), max_gap=1.0))
    (page,) = data_of(interactive_page("p", [plotted_check(model, verdicts)]))
    assert list(page["views"]) == ["utilisation", "values"]  # small bounds cannot be seen beside the values
    panel = page["views"]["values"][0]
    assert [p["title"] for p in page["views"]["values"]] == ["x1", "x2", "u1"] and "greatest" not in panel["values"]
    (top,) = page["top"]
    assert top["title"] not in page["note"] and top["note"] not in page["note"], "it is said above the panel"
    assert top["levels"] == [1.0] and np.nanmax(array(top["values"]["least"])) > 1 and "x1" in top["note"]
    shown, drawn = times(page["times"][0]), array(panel["values"]["least"])
    # a gap parts the line
    assert np.isnan(drawn).sum() == 1 and np.isnan(drawn[200]) and shown[200] == shown[201] == 7.0
    keep = ~np.isnan(drawn)
    assert np.array_equal(shown[keep], verdicts.transient.t)
    assert np.allclose(drawn[keep], x[:, 0], rtol=0, atol=1e-5)
    assert np.allclose(array(panel["values"]["upper"])[keep], verdicts.upper[:, 0], rtol=0, atol=1e-5, equal_nan=True)
    marked = marks(panel["values"])
    assert np.array_equal(shown[marked], verdicts.transient.t[verdicts.flags[:, 0] == 1.0])
    assert page["alarms"][0] == pytest.approx([1.0, 1.02]) and page["silent"][0] == pytest.approx([1.99, 7.0])


def test_horizons_of_the_model_are_views_of_the_plot():
    rng = np.random.default_rng(3)
    x = np.cumsum(0.01 + 0.1 * rng.normal(size=(200, 2)), axis=0)
    zeros = np.zeros((2, 2))
    further = [Horizon(h, zeros, zeros[:, :1], zeros, zeros[:, :1], v=[0.4, 0.6]) for h in (5, 20)]
    model = by_hand().replace(horizons=further)
    verdicts = EnvelopeMonitor(model).check(Transient(np.arange(200) * 0.1, x, np.zeros((200, 1))))
    page = interactive_page("p", [plotted_check(model, verdicts)])
    views = ["utilisation, 1 step", "values", "utilisation, 5 steps", "utilisation, 20 steps"]
    assert re.findall("<option>([^<]*)", page) == views
    (recording,) = data_of(page)
    for h, view in enumerate(views[2:]):
        for panel in recording["views"][view]:
            of = verdicts.longer_utilisation[:, h, model.state_names.index(panel["title"])]
            assert np.allclose(array(panel["values"]["least"]), of, atol=1e-5, equal_nan=True)
            marked = marks(panel["values"])
            assert np.array_equal(marked, np.flatnonzero(np.abs(of) > 1.0))
            assert len(marked) and np.isnan(of[: (5, 20)[h]]).all()


def test_a_long_recording_fits_into_a_page_of_two_megabytes():
    x = np.sin(np.arange(1_000_000) * 1e-4)[:, None] * np.ones(5)
    run = Transient(np.arange(1_000_000) * 0.001, x, np.zeros((1_000_000, 1)))
    assert len(interactive_page("p", [plotted_transient(run)])) < 2_000_000
    model = by_hand(5)
    page = interactive_page("p", [plotted_check(model, EnvelopeMonitor(model).check(run))])
    assert 500_000 < len(page) < 2_000_000


def test_the_command_draws_models_recordings_and_checks(engine, tmp_path, cli):
    model, bad, run = (str(engine / name) for name in ("m.model.json", "bad.mcap", "run.mcap"))
    (tmp_path / "m.png").write_bytes(b"\x89PNG of before, which gives way")
    for name, head in (("m.png", b"\x89PNG\r"), ("m.svg", b"<?xml"), ("m.pdf", b"%PDF")):
        assert main(["plot", model, "--output", str(tmp_path / name), "-q"]) == 0
        assert (tmp_path / name).read_bytes().startswith(head)
    page = tmp_path / "p.html"
    said = cli.json("plot", model, bad, run, "--output", page, status=1)
    assert said == {"plot": str(page), "recordings": [bad, run], "alarm": True, "exit_status": 1}
    first, second = data_of(page.read_text())
    assert first["name"] == "bad.mcap" and first["alarms"] and not second["alarms"]
    assert main(["plot", model, bad, "--violations", "9", "--window", "9", "--output", str(page), "-q"]) == 0
    assert main(["plot", model, bad, "--output", str(tmp_path / "one.png"), "-q"]) == 1
    assert main(["plot", run, "--output", str(page), "-q"]) == 0
    titles = {panel["title"] for panel in data_of(page.read_text())[0]["views"]["values"]}
    assert main(["plot", run, "--signals", str(engine / "signals.yaml"), "--output", str(page), "-q"]) == 0
    assert {panel["title"] for panel in data_of(page.read_text())[0]["views"]["values"]} >= {"fan"} and len(titles) > 5
    other = [str(tmp_path / name) for name in ("one.csv", "two.csv")]
    for path in other:
        Path(path).write_text("t,x\n0,1\n1,2\n")
    page.unlink()
    said = cli("plot", model, *other, "--output", page, "-q", status=2).err
    assert "no recording could be checked, so nothing is drawn" in said and not page.exists()


@pytest.mark.skipif(not shutil.which("node"), reason="node is not installed")
def test_a_browser_that_speaks_no_language_draws():
    """Chromium under LANG=C calls its language en-US@posix, of which uPlot made nothing: the page had no plot."""
    drawing = re.findall(r"<script>(.*?)</script>", interactive_page("x", []), re.DOTALL)[0]
    browser = "window = globalThis; Object.defineProperty(window, 'navigator', {value: {language: 'en-US@posix'}});"
    browser += "matchMedia = addEventListener = dispatchEvent = () => ({addEventListener() {}});"
    browser += "document = {}; devicePixelRatio = 1;"
    said = subprocess.run(
        ["node", "-"], input=f"{browser}{drawing};console.log(typeof uPlot)", capture_output=True, text=True
    )
    assert said.stdout == "function\n", said.stderr


def test_a_page_that_follows_a_monitor_says_its_alarm_from_the_start():
    """It said so at the first look at the monitor only."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no browser")
    plotted = plotted_transient(Transient(np.arange(9) * 0.1, np.zeros((9, 1)), np.zeros((9, 1))))
    page = interactive_page("/m", [replace(plotted, title="ALARM /m")], every=10**6)
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=1000", "--dump-dom"]
    with TemporaryDirectory() as folder:
        (Path(folder) / "page.html").write_text(page)
        command += [f"--user-data-dir={folder}/browser", f"file://{folder}/page.html"]
        shown = subprocess.run(command, capture_output=True, text=True, timeout=120).stdout
    assert '<h1 class="bad">ALARM /m</h1>' in shown
