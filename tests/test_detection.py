# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The benchmarks of detection: peers are what their names say, scores those of the papers."""

import numpy as np
import pytest

pytest.importorskip("scipy", reason="scipy, which the benchmark needs, is not installed")

from detection import Case, judged, lines_of
from detectors import DETECTORS, SKAB_RULES, averaged, least_squares, rolling
from public import batadal_score, blocks, first, peers
from tanks import Tanks


def plant(rows: int, seed: int, offset: float = 0.0) -> np.ndarray:
    """[x u] of a stable plant of two states and one input, with noise; an offset of one state from half time on."""
    rng = np.random.default_rng(seed)
    A, B = np.array([[0.8, 0.1], [0.0, 0.5]]), np.array([0.5, 1.0])
    x, u = np.zeros((rows, 2)), rng.standard_normal(rows)
    for k in range(rows - 1):
        x[k + 1] = A @ x[k] + B * u[k] + 0.05 * rng.standard_normal(2)
    x[rows // 2 :, 0] += offset
    return np.column_stack([x, u])


def test_a_mean_of_scores_waits_until_it_is_full():
    found = averaged(lambda rows: np.concatenate([[-np.inf], rows[1:, 0]]), 2)(np.array([[1.0], [2.0], [4.0], [8.0]]))
    assert found.tolist() == [-np.inf, -np.inf, 3.0, 6.0]
    assert np.isnan(rolling(np.array([3.0, 1.0, 2.0]), 3)[:2]).all() and rolling(np.array([3.0, 1.0, 2.0]), 3)[2] == 2


@pytest.mark.parametrize("name", [*DETECTORS, "least squares"])
def test_a_detector_sees_an_offset_that_breaks_the_law_of_the_healthy_rows(name, monkeypatch):
    monkeypatch.setattr("detectors.COMPONENTS", 1)
    monkeypatch.setattr("detectors.ORDER", 2)
    learn = DETECTORS.get(name, lambda rows: least_squares(rows, 2))
    score = learn([plant(600, 0), plant(300, 1)])
    healthy, faulty = score(plant(400, 2)), score(plant(400, 3, offset=3.0))
    assert len(faulty) == 400 and np.isfinite(faulty[10:]).all()
    assert np.median(faulty[210:]) > np.median(healthy[210:])
    assert faulty[200:].max() > healthy[np.isfinite(healthy)].max()


def test_least_squares_leaves_the_noise_alone():
    score = least_squares([plant(4000, 0)], 2)(plant(4000, 1))
    assert score[0] == -np.inf and score[1:].mean() == pytest.approx(2.0, abs=0.15)  # chi-square of two states


def test_a_rule_of_skab_is_quiet_on_what_it_learnt_from_and_sees_a_jump():
    rng = np.random.default_rng(0)
    healthy = 10 + rng.standard_normal((400, 8)) @ np.diag([1, 1, 1, 1, 1, 1, 0.2, 0.1])
    for name, rule in SKAB_RULES.items():
        alarm = rule(healthy)
        far = healthy + 40 * (np.arange(400) >= 200)[:, None]
        assert alarm(far)[260:].all(), name
        assert alarm(healthy).mean() < 0.2 or "MSET" in name  # its limit is one number for every machine


def test_the_score_of_batadal_is_that_of_the_paper():
    attack = np.array([0, 0, 1, 1, 1, 1, 0, 0, 1, 1, 0, 0]) == 1
    assert batadal_score(attack, attack)[0] == 1.0
    assert batadal_score(np.zeros(12, dtype=bool), attack)[0] == pytest.approx(0.25)
    score, delays, tpr, tnr = batadal_score(np.array([0, 1, 0, 0, 1, 1, 0, 0, 0, 0, 0, 0]) == 1, attack)
    assert delays == [2.0, np.inf] and tpr == pytest.approx(2 / 6) and tnr == pytest.approx(5 / 6)
    assert score == pytest.approx(((1 - (0.5 + 1.0) / 2) + (2 / 6 + 5 / 6) / 2) / 2)
    assert first(np.array([False, True])) == 1.0 and first(np.zeros(3, dtype=bool)) == np.inf


def test_blocks_partition_the_healthy_rows_and_the_limit_is_the_largest_left_out():
    rows = plant(500, 0)
    assert np.array_equal(np.concatenate([block for block, _ in blocks(rows, 5)]), rows)
    assert all(len(block) + sum(map(len, others)) == 500 for block, others in blocks(rows, 5))
    score, limit = peers(rows, 5)["PCA T2"]
    left_out = [DETECTORS["PCA T2"](others)(block).max() for block, others in blocks(rows, 5)]
    assert limit == max(left_out) and np.isfinite(score(rows)).all()


def test_a_leak_is_judged_from_its_onset_and_others_alarm_as_often_as_ours():
    tanks = Tanks()

    def runs(count: int, seed: int, fault: float = 0.0) -> list:
        return [[t] for t in tanks.transients(count, seed, noise=1e-3, fault=fault)]

    case = Case("tanks", runs(5, 1), runs(20, 2), {"leak": (runs(4, 3, 0.2), 51)})
    late = judged("late", case, lambda piece: np.arange(len(piece)) == 60)
    assert late.seen == {"leak": 1.0} and late.healthy == 1.0
    assert late.delays["leak"] == pytest.approx(case.healthy[0][0].t[60] - case.healthy[0][0].t[50])
    ours, own, equal = lines_of(case)
    assert ours.seen["leak"] == 1.0 and own[0].seen["leak"] == 1.0
    assert all(line.healthy == pytest.approx(ours.healthy) for line in equal)
