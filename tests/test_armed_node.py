# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Everything armed in the node: live is offline in disorder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from uncertain_lti import UncertainLTI
from uncertain_lti.model.alarm_rule import KINDS, AlarmRule, StatisticRule
from uncertain_lti.model.horizon import Horizon, Residuals
from uncertain_lti.model.repeats import Repeats
from uncertain_lti.model.schedule import Axis, BlockData, Schedule
from uncertain_lti.model.terms import ARRAYS

pytest.importorskip("rclpy", reason="rclpy is not installed")

from ros_processes import World, open_world
from test_live import STEP_NS, Outputs, bits, by_hand, header_bag, offline, saved


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    with open_world(tmp_path) as world:
        yield world


def everything_armed() -> UncertainLTI:
    """The model by hand with a schedule, horizons, every kind of statistic at one of them, and repeats."""
    plain, rng, n = by_hand(), np.random.default_rng(4), 2

    def scheduled(scale: float = 1.0) -> dict[str, Any]:
        share = rng.uniform(0.5, 1.0, 3)
        arrays = {name: getattr(plain, name) for name in ARRAYS} | {"v": np.full(n, 0.005)}
        return {name: np.stack([scale * s * value for s in share]) for name, value in arrays.items()}

    residuals = Residuals(np.zeros(n), np.eye(n))
    lengths = (2, 5, 12)
    rules: list[Any] = [AlarmRule(2, 5), AlarmRule(2, 4, 1.2, horizon=5)]
    for i, kind in enumerate(KINDS):
        allowance = 0.1 if kind == "cusum" else 0.0
        rules.append(StatisticRule(kind, 20 * STEP_NS * 1e-9, 2.0, lengths[i % 3] if i % 2 else 1, allowance))
    return UncertainLTI(
        **scheduled(),
        schedule=Schedule((Axis("a", knots=(-0.1, 0.0, 0.1)),)),
        block_data=[BlockData(100)] * 3,
        horizons=[Horizon(h, **scheduled(0.4), residuals=residuals) for h in lengths],
        signals=plain.signals,
        sampling=plain.sampling,
        alarm=rules,
        residuals=residuals,
        repeats=Repeats(np.full(n, 0.1)),
    )


def test_everything_armed_stays_offline_in_disorder(world: World, tmp_path: Path) -> None:
    """Late, repeated, swapped, damaged and absent messages; stamps that jump, go back or are missing."""
    path = saved(everything_armed(), tmp_path)
    bag = header_bag(by_hand(), tmp_path / "run.mcap", 300)
    verdicts = offline(path, bag)
    judged = [v for v in verdicts if v.judged]
    assert len({v.status for v in verdicts}) > 3 and {v.alarm for v in judged} == {True, False}
    process = world.monitor(path)
    names = ("horizon_utilisation", "statistics")
    outputs = Outputs.of(world, *names)
    world.command("play", bag, "--rate", 2).succeed()
    outputs.hold_against(verdicts, ("a", "b"))
    for name in names:
        told = outputs.topics[name].count(len(judged))
        assert [bits(m.position) for m in told] == [bits(np.ravel(getattr(v, name))) for v in judged]
        assert sum(not np.isnan(m.position).any() for m in told) > 50
    assert world.status()["unexpected_errors"] == 0 and "Traceback" not in process.output
