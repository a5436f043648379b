# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""tune(): a way is taken where its panel sees clearly smaller jumps, and never at the price of faults."""

import numpy as np
import pytest
from refusals import refuses
from tanks import Tanks

from uncertain_lti import EnvelopeMonitor, Transient, fit, tune
from uncertain_lti.base.errors import FitError
from uncertain_lti.proposal.tune import CLEARLY

DT = 0.1


def late(seed: int, by: int = 2, N: int = 400, noise: float = 2e-3) -> Transient:
    """A state that follows what was commanded some samples ago."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1, 1, N // 8 + 1), 8)[: N + 1]
    x = np.zeros(N + 1)
    for k in range(N):
        x[k + 1] = x[k] + DT * (-1.5 * x[k] + 2.0 * u[max(k - by, 0)])
    x += noise * rng.standard_normal(N + 1)
    return Transient(DT * np.arange(N + 1), x[:, None], u[:, None], name=f"r{seed}")


RUNS = [late(seed) for seed in range(5)]


@pytest.fixture(scope="module")
def tuned():
    return tune(RUNS)


def test_a_control_that_acts_late_is_taken_earlier_and_the_jumps_seen_are_smaller(tuned):
    alone = fit(RUNS)
    rows = tuned.to_dict()["trials"]
    assert rows[0]["way"] == "as fit does" and rows[0]["size"] == 1.0
    assert "earlier" in tuned.reason
    before, after = alone.fit_summary["alarm"]["biases"][0], tuned.model.fit_summary["alarm"]["biases"][0]
    assert after <= CLEARLY * before
    assert tuned.model.fit_summary["tune"] == tuned.to_dict()


def test_where_nothing_helps_fit_alone_is_what_one_gets():
    runs = Tanks().transients(5, seed=3, noise=1e-2)
    tuned = tune(runs)
    if "no way" in tuned.reason:
        assert tuned.model.alarm == fit(runs).alarm
        assert all(row["size"] > CLEARLY for row in tuned.trials[1:] if "refused" not in row)


def test_faults_that_fit_sees_are_not_given_away():
    drifting = RUNS[0].replace(x=RUNS[0].x + np.where(np.arange(401) > 200, 0.5, 0.0)[:, None])
    tuned = tune(RUNS, faulty={"bias": [drifting]})
    assert len(tuned.trials) > 1
    assert all(EnvelopeMonitor(model).check(drifting).alarm.any() for model in (fit(RUNS), tuned.model))


def test_the_budget_ends_it_with_the_best_so_far():
    tuned = tune(RUNS, budget=1e-6)
    assert len(tuned.trials) == 1 and "the time ran out" in tuned.reason
    assert tuned.model.alarm == fit(RUNS).alarm


def test_ctrl_c_keeps_what_is_done():
    said = []

    def interrupted(text):
        said.append(text)
        if text.startswith("as fit does, "):
            raise KeyboardInterrupt

    tuned = tune(RUNS, progress=interrupted)
    assert "the time ran out" in tuned.reason and tuned.model.alarm
    assert any(text.startswith("fit 1 of ") for text in said[:-1]), "the first fit says how far it is, too"


def test_what_cannot_be_tuned_is_refused():
    refuses(FitError, "positive number of seconds", tune, RUNS, budget=0)
    refuses(FitError, "cannot learn an alarm", tune, late(1, N=8))
