# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Programmes that are solved in processes of their own."""

import subprocess
import sys

import numpy as np
import pytest

from uncertain_lti import Transient, fit
from uncertain_lti.identification import solver_processes, solvers


@pytest.fixture
def started(monkeypatch):
    """Processes that were started, as each programme of this module's plant is large enough."""
    monkeypatch.setattr(solvers, "APART", 1)
    monkeypatch.setattr(solver_processes, "core_count", lambda: 2)
    processes, start = [], solver_processes._start
    monkeypatch.setattr(solver_processes, "_start", lambda: processes.append(start()) or processes[-1])
    return processes


def plant():
    """A recording of four states."""
    rng = np.random.default_rng(3)
    x, u = np.zeros((201, 4)), rng.normal(size=(201, 1))
    for k in range(200):
        x[k + 1] = 0.9 * x[k] + 0.1 * u[k] + 1e-3 * rng.uniform(-1, 1, 4)
    return Transient(np.arange(201) * 0.1, x, u)


def elements(criterion):
    model = fit(plant(), criterion, additive="noise", alarm="containment")
    return [getattr(model, name).tobytes() for name in ("A", "dA", "B", "dB", "v")]


@pytest.mark.parametrize("criterion", ["qp", "lp"])
def test_answers_have_the_same_bits_and_the_processes_end(criterion, started):
    found = elements(criterion)
    assert len(started) in (1, 2)
    assert all(process.returncode is not None for process in started)
    started.clear()
    solvers.APART = 1000
    assert found == elements(criterion)
    assert not started


def test_a_process_that_dies_or_cannot_be_had_changes_nothing(started, monkeypatch):
    found, first = elements("qp"), solver_processes._start

    def killed():
        process = first()
        process.kill()
        process.wait()
        return process

    def none():
        raise FileNotFoundError

    for start in (killed, none):
        monkeypatch.setattr(solver_processes, "_start", start)
        assert found == elements("qp")


def test_the_main_module_of_the_caller_is_not_run_again(tmp_path):
    script = tmp_path / "unguarded.py"
    script.write_text(
        "import numpy as np\n"
        "from uncertain_lti import Transient, fit\n"
        "from uncertain_lti.identification import solver_processes, solvers\n"
        "print('once')\n"
        "solvers.APART, solver_processes.core_count = 1, lambda: 2\n"
        "start = solver_processes._start\n"
        "solver_processes._start = lambda: print('started') or start()\n"
        "x = np.random.default_rng(0).normal(size=(50, 1))\n"
        "fit(Transient(np.arange(50.0), x, np.zeros((50, 0))), 'qp', additive='noise', alarm='containment')\n"
    )
    said = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True).stdout.split()
    assert said == ["once", "started"]
