# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The saturating coil: the circuit is the one its equations say, and a schedule on its current narrows the envelope."""

import numpy as np
import pytest
from coil import STEP_NS, C, L, R, coil_runs, inductance
from scipy.linalg import expm

from uncertain_lti import EnvelopeMonitor
from uncertain_lti.identification import fit


def test_the_coil_saturates_in_both_directions():
    current = np.linspace(0.0, 100.0, 401)
    assert (inductance(current) == inductance(-current)).all()
    assert (np.diff(inductance(current)) < 0.0).all()
    assert inductance(0.0) == pytest.approx(L, rel=0.02)
    assert inductance(5.0) == pytest.approx(0.55 * L)
    assert inductance(100.0) == pytest.approx(0.1 * L, rel=0.01)


def test_at_small_currents_it_is_the_linear_circuit():
    (run,) = coil_runs([3], volts=0.1)
    coil = float(inductance(0.0))
    both = np.array([[0.0, 1.0 / C, 0.0], [-1.0 / coil, -R / coil, 1.0 / coil], [0.0, 0.0, 0.0]])
    step = expm(both * STEP_NS * 1e-9)[:2]
    x = np.zeros_like(run.x)
    for k in range(len(x) - 1):
        x[k + 1] = step @ [*x[k], *run.u[k]]
    assert np.abs(run.x[:, 1]).max() < 0.1  # far from saturation
    assert (np.abs(run.x - x).max(axis=0) < 2e-3 * np.abs(x).max(axis=0)).all()


def test_a_schedule_on_the_current_narrows_the_envelope():
    """With four knots to less than two fifths of one knot's, on runs that were not fitted, and nearly all inside."""
    fitted, fresh = coil_runs(range(20), magnitude=True), coil_runs(range(100, 110), magnitude=True)
    widths, inside = {}, {}
    for knots, runs in ((1, (coil_runs(range(20)), coil_runs(range(100, 110)))), (4, (fitted, fresh))):
        model = fit(runs[0], additive="disturbance", schedule=None if knots == 1 else {"I_L_magnitude": knots})
        seen = [EnvelopeMonitor(model, 1, 1, 1.0).check(run) for run in runs[1]]
        assert not any(EnvelopeMonitor(model, 1, 1, 1.0).check(run).violated.any() for run in runs[0])
        widths[knots] = np.vstack([(v.upper - v.lower)[v.judged] for v in seen]).mean(axis=0)
        inside[knots] = np.mean([1.0 - v.violated[v.judged].mean() for v in seen])
    assert (widths[4] < 0.4 * widths[1]).all()
    assert inside[1] > 0.995 and inside[4] > 0.99
