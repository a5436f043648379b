# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The paper's experiment, and the paper's solver beside the exact one."""

import io
import json
import runpy
from contextlib import redirect_stdout

import numpy as np
import pytest
from conftest import ROOT

pytest.importorskip("scipy", reason="scipy, which the experiment needs, is not installed")
pytest.importorskip("matplotlib", reason="matplotlib, which draws the figures, is not installed")

from direct_search import direct_search

from uncertain_lti import EnvelopeMonitor, UncertainLTI, read_transients
from uncertain_lti.cli.main import main
from uncertain_lti.identification import fit
from uncertain_lti.plants.leibov import transient
from uncertain_lti.plants.turbofan_runs import make_run, simulate, turbofan_signals


def objective(model, transients):
    """(10) as written: the sum of squared widths over all steps."""
    total = 0.0
    for t in transients:
        s = t.transitions()
        point = model.operating_point
        lower, upper = model.bounds(point.normalise_x(s.x), point.normalise_u(s.u), s.dt)
        total += float(np.sum((upper - lower) ** 2))
    return total


def test_the_direct_search_contains_every_sample_and_never_beats_the_exact_solver():
    runs = [transient(80, 1), transient(80, 11)]
    exact, found = fit(runs), direct_search(runs)
    monitor = EnvelopeMonitor(found.model)
    assert not any(monitor.check(run).violated.any() for run in runs)
    assert found.objective == pytest.approx(objective(found.model, runs), rel=1e-6)
    assert exact.fit_summary["objective"] <= found.objective * (1 + 1e-9)
    assert found.objective < 1.5 * exact.fit_summary["objective"]  # and it is no straw man
    assert found.rows.sum() == pytest.approx(found.objective)


def test_the_published_model_is_known_to_the_commands_by_name(cli):
    """It contains its own shipped recording up to the sample after which that leaves the intervals, and not beyond."""
    (result,) = cli.json("check", "leibov2006", ROOT / "bags/leibov_check.mcap", status=1)["recordings"]
    first = [k for k, v in enumerate(result["verdict_per_sample"]) if 1.0 in v["flags"]][0]
    assert first == 1201
    assert "-15.59-17j" in cli("info", "leibov2006").out


RECORDINGS = runpy.run_path(str(ROOT / "bags/make.py"))["TURBOFAN"]
SHIPPED = {make_run(**parameters): ROOT / f"bags/{name}.mcap" for name, parameters in RECORDINGS.items()}


def recorded(run):
    """A run as it is shipped, which test_turbofan holds against its simulation; one that is not is simulated."""
    return read_transients(SHIPPED[run], turbofan_signals())[0] if run in SHIPPED else simulate(run)


@pytest.fixture(scope="module")
def experiment(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reproduce")
    with redirect_stdout(io.StringIO()) as printed, pytest.MonkeyPatch.context() as patch:
        patch.setattr("uncertain_lti.plants.reproduce.simulate", recorded)
        assert main(["reproduce", "--output", str(folder / "new"), "--json"]) == 0
    data = json.loads((folder / "new" / "reproduce.json").read_text())
    assert json.loads(printed.getvalue()) == {"output": str(folder / "new"), **data}
    return folder / "new", data


def case(data, name, criterion="qp", additive="none"):
    wanted = name, criterion, additive
    (found,) = [c for c in data["cases"] if (c["identified_from"], c["criterion"], c["additive"]) == wanted]
    return found


@pytest.mark.slow
def test_the_experiment_shows_what_it_must(experiment):
    _, data = experiment
    assert all(c["outside_identification"] == 0 for c in data["cases"])
    for criterion in ("qp", "lp"):
        paper, wide = case(data, "+5% (the paper's)", criterion), case(data, "±30%", criterion)
        assert wide["inside_all"] >= 0.97 and wide["outside_domain"] == 0
        assert paper["inside_all"] < 0.2 and paper["outside_domain"] > 90
        assert max(wide["mean_width"]) < 0.01  # inside, and not because the bounds are wide
        noisy = case(data, "±30%, noise 0.0001", criterion, "noise")
        assert noisy["inside_all"] >= 0.97 and max(noisy["mean_width"]) < 0.02
        assert max(case(data, "±30%, noise 0.0001", criterion)["mean_width"]) > 0.05  # what pure intervals cost
        spools = [v[0] for v in wide["eigenvalues"][:2]]
        assert spools == pytest.approx([-1.6, -2.0], rel=0.1)


@pytest.mark.slow
def test_the_experiment_leaves_figures_models_and_numbers(experiment):
    folder, data = experiment
    for name in ("check.png", "check_paper_pulses.png"):
        assert (folder / name).read_bytes().startswith(b"\x89PNG")
    text = (folder / "reproduce.txt").read_text()
    for word in ("-15.59", "published", "thrust", "outside domain"):
        assert word in text
    models = list(folder.glob("*.model.json"))
    assert len(models) == len(data["cases"])
    for path in models:
        UncertainLTI.load(path)
