# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The interactive plot: nothing recorded or violated is hidden, and nothing of a file becomes part of the page."""

import base64
import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from engine_bag import SIGNALS, engine_bag
from hypothesis import given, settings
from hypothesis import strategies as st

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI, read_transients
from uncertain_lti.cli.main import main
from uncertain_lti.identification import fit
from uncertain_lti.model.horizon import Horizon
from uncertain_lti.reports import interactive
from uncertain_lti.reports.interactive import interactive_page, plotted_check, plotted_transient

ASSETS = Path(interactive.__file__).parent / "assets"
HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>"


def by_hand(n=2):
    return UncertainLTI(np.zeros((n, n)), np.zeros((n, 1)), np.zeros((n, n)), np.zeros((n, 1)), v=np.full(n, 0.5))


def data_of(page):
    """The data of a page as its script reads them."""
    (text,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    return json.loads(text)["recordings"]


def array(packed):
    return np.frombuffer(base64.b64decode(packed["data"]), "<f4").astype(float) + packed["offset"]


def times(packed):
    return np.frombuffer(base64.b64decode(packed), "<f8")


def test_only_the_scripts_of_the_page_may_run():
    model = by_hand()
    signals = replace(
        model.signals, states=tuple(replace(s, name=f"{HOSTILE}{i}") for i, s in enumerate(model.signals.states))
    )
    model = model.replace(signals=signals)
    run = Transient([0.0, 0.1, 0.2], np.zeros((3, 2)), np.zeros((3, 1)), name=f"/x/{HOSTILE}", signals=signals)
    page = interactive_page(HOSTILE, [plotted_check(model, EnvelopeMonitor(model).check(run))])
    scripts = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    assert len(scripts) == 2 and page.count("</script>") == 3
    (allowed,) = re.findall(r"script-src ([^;]*);", page)
    assert allowed.split() == [
        f"'sha256-{base64.b64encode(hashlib.sha256(s.encode()).digest()).decode()}'" for s in scripts
    ]
    assert "default-src 'none'" in page and not re.search(r"<(link|img|iframe)|src=[^x]|href=", page)
    assert data_of(page)[0]["views"]["values"][0]["title"] == f"{HOSTILE}0"


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
    assert top["levels"] == [1.0] and np.nanmax(array(top["values"]["least"])) > 1 and "x1" in top["note"]
    shown, drawn = times(page["times"][0]), array(panel["values"]["least"])
    assert (
        np.isnan(drawn).sum() == 1 and np.isnan(drawn[200]) and shown[200] == shown[201] == 7.0
    )  # a gap parts the line
    keep = ~np.isnan(drawn)
    assert np.array_equal(shown[keep], verdicts.transient.t)
    assert np.allclose(drawn[keep], x[:, 0], rtol=0, atol=1e-5)
    assert np.allclose(array(panel["values"]["upper"])[keep], verdicts.upper[:, 0], rtol=0, atol=1e-5, equal_nan=True)
    marked = np.frombuffer(base64.b64decode(panel["values"]["marked"]["at"]), "<u4")
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
            marked = np.frombuffer(base64.b64decode(panel["values"]["marked"]["at"]), "<u4")
            assert np.array_equal(marked, np.flatnonzero(np.abs(of) > 1.0))
            assert len(marked) and np.isnan(of[: (5, 20)[h]]).all()


@settings(max_examples=8)
@given(count=st.integers(8000, 16_000), at=st.lists(st.integers(1, 7900), max_size=30), gap=st.integers(1, 7000))
def test_nothing_is_hidden_in_a_long_recording(count, at, gap):
    """Extremes and violations are there, and each violation is drawn by itself where there is room."""
    rng = np.random.default_rng(count)
    x = 0.05 * rng.normal(size=(count, 2))
    for k in at:
        x[k, 0] += 10.0
    t = np.arange(count) * 0.01
    t[gap:] += 5.0
    model = by_hand()
    verdicts = EnvelopeMonitor(model).check(Transient(t, x, np.zeros((count, 1)), max_gap=1.0))
    (page,) = data_of(interactive_page("p", [plotted_check(model, verdicts, recordings=40)]))
    panel = next(p for p in page["views"]["values"] if p["title"] == "x1")
    values, shown = panel["values"], times(page["times"][0])
    low, high = (array(values[key]) for key in ("least", "greatest"))
    marked = np.frombuffer(base64.b64decode(values["marked"]["at"]), "<u4")
    assert len(shown) < 0.7 * count and (np.diff(shown) >= 0).all()
    assert np.nanmax(high) == pytest.approx(x[:, 0].max(), abs=1e-5) and np.nanmin(low) == pytest.approx(
        x[:, 0].min(), abs=1e-5
    )
    bad = np.flatnonzero(verdicts.flags[:, 0] == 1.0)
    assert bool(len(bad)) == bool(len(marked))
    if len(bad):
        nearest = np.abs(shown[marked][None] - verdicts.transient.t[bad][:, None]).min(axis=1)
        assert nearest.max() < 0.01 * count / 400
    if 0 < len(at) < 5:
        assert len(marked) == len(bad) and nearest.max() < 1e-9


def test_a_long_recording_fits_into_a_page_of_two_megabytes():
    x = np.sin(np.arange(1_000_000) * 1e-4)[:, None] * np.ones(5)
    run = Transient(np.arange(1_000_000) * 0.001, x, np.zeros((1_000_000, 1)))
    assert len(interactive_page("p", [plotted_transient(run)])) < 2_000_000
    model = by_hand(5)
    page = interactive_page("p", [plotted_check(model, EnvelopeMonitor(model).check(run))])
    assert 500_000 < len(page) < 2_000_000


@pytest.fixture(scope="module")
def engine(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plot")
    (folder / "signals.yaml").write_text(SIGNALS)
    engine_bag(folder / "run.mcap")
    engine_bag(folder / "bad.mcap", change=lambda k, x: x + (5.0 if 100 <= k < 103 else 0.0) * np.eye(5)[0])
    fit(read_transients([folder / "run.mcap"], folder / "signals.yaml"), additive="noise").save(folder / "m.model.json")
    return folder


def test_the_command_draws_models_recordings_and_checks(engine, tmp_path, capsys):
    model, bad, run = (str(engine / name) for name in ("m.model.json", "bad.mcap", "run.mcap"))
    for name, head in (("m.png", b"\x89PNG"), ("m.svg", b"<?xml"), ("m.pdf", b"%PDF")):
        assert main(["plot", model, "--output", str(tmp_path / name), "-q"]) == 0
        assert main(["plot", model, "--output", str(tmp_path / name), "-q"]) == 0  # an older one gives way
        assert (tmp_path / name).read_bytes().startswith(head)
    page = tmp_path / "p.html"
    assert main(["plot", model, bad, run, "--output", str(page), "--json"]) == 1
    said = json.loads(capsys.readouterr().out)
    assert said == {"plot": str(page), "recordings": [bad, run], "alarm": True, "exit_status": 1}
    first, second = data_of(page.read_text())
    assert first["name"] == "bad.mcap" and first["alarms"] and not second["alarms"]
    assert main(["plot", model, bad, "--violations", "9", "--window", "9", "--output", str(page), "-q"]) == 0
    assert main(["plot", model, bad, "--output", str(tmp_path / "one.png"), "-q"]) == 1
    assert main(["plot", run, "--output", str(page), "-q"]) == 0
    titles = {panel["title"] for panel in data_of(page.read_text())[0]["views"]["values"]}
    assert main(["plot", run, "--signals", str(engine / "signals.yaml"), "--output", str(page), "-q"]) == 0
    assert {panel["title"] for panel in data_of(page.read_text())[0]["views"]["values"]} >= {"fan"} and len(titles) > 5


def test_what_cannot_be_drawn_is_one_sentence(engine, tmp_path, capsys):
    model, bad, run = (str(engine / name) for name in ("m.model.json", "bad.mcap", "run.mcap"))
    before = Path(model).read_bytes(), Path(run).read_bytes()
    for words, why in (
        ([model, "--output", str(tmp_path / "m.html")], "model alone is drawn as an image"),
        ([run, "--output", str(tmp_path / "r.png")], "without a model are drawn as a page"),
        ([model, run, bad, "--output", str(tmp_path / "r.png")], "an image shows one recording"),
        ([model, run, "--output", str(tmp_path / "r.gif")], "end the name in .html, .png"),
        ([model, run, "--signals", "s.yaml"], "the model has its signals"),
        ([model, run, "--output", run], "end the name in"),
        ([str(tmp_path / "no.model.json"), run, "--output", str(tmp_path / "r.html")], "no such"),
        ([str(tmp_path / "no.mcap"), "--output", str(tmp_path / "r.html")], "no such"),
        ([model, run, "--output", str(tmp_path / "no" / "r.html")], "make it first"),
    ):
        assert main(["plot", *words]) == 2
        said = capsys.readouterr()
        assert why in said.err and said.err.count("\n") == 1 and not said.out
    assert (Path(model).read_bytes(), Path(run).read_bytes()) == before and not list(tmp_path.iterdir())
