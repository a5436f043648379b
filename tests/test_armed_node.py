# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Everything armed in the node: live is offline in disorder, through a swapped model, a killed process, another QoS."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI
from uncertain_lti.model.alarm_rule import KINDS, AlarmRule, StatisticRule
from uncertain_lti.model.horizon import Horizon, Residuals
from uncertain_lti.model.repeats import Repeats
from uncertain_lti.model.schedule import Axis, BlockData, Schedule
from uncertain_lti.model.terms import ARRAYS

pytest.importorskip("rclpy", reason="rclpy is not installed")

from geometry_msgs.msg import Vector3Stamped
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_processes import Diagnostics, World, open_world, until
from sensor_msgs.msg import JointState
from test_live import (
    CONTROL,
    EPOCH_NS,
    STATE,
    STEP_NS,
    Outputs,
    bits,
    by_hand,
    header_bag,
    offline,
    saved,
    stamp_of,
)
from test_monitor_faults import NODE, stamped


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    with open_world(tmp_path) as world:
        yield world


def everything_armed(seed: int, v: float = 0.15) -> UncertainLTI:
    """The model by hand with a schedule, horizons, every kind of statistic at one of them, and repeats."""
    plain, rng, n = by_hand(), np.random.default_rng(seed), 2

    def scheduled(scale: float = 1.0) -> dict[str, Any]:
        share = rng.uniform(0.5, 1.0, 3)
        arrays = {name: getattr(plain, name) for name in ARRAYS} | {"v": np.full(n, v)}
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
    model = everything_armed(4, v=0.005)
    path = saved(model, tmp_path)
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


def test_everything_armed_stays_offline_through_a_swap_a_kill_and_a_change_of_qos(world: World, tmp_path: Path) -> None:
    models = everything_armed(1), everything_armed(2)
    paths = [saved(model, tmp_path, name) for model, name in zip(models, ("first", "second"), strict=True)]
    rng = np.random.default_rng(3)
    sent: dict[int, Any] = {}
    process = world.monitor(paths[0], diagnostics_period=0.1)
    names = ("flags", "horizon_utilisation", "statistics", "horizon_predicted_lower")
    heard = {name: world.listen(JointState, f"{NODE}/{name}").connected() for name in names}
    state, control = world.publisher(JointState, STATE), world.publisher(Vector3Stamped, CONTROL)
    world.subscribed(state, control)

    def send_one() -> int:
        t_ns = EPOCH_NS + len(sent) * STEP_NS
        sent[t_ns] = rng.normal(0.3, 0.1, 2)  # the controls stay, so that it does not matter which topic comes first
        control.publish(stamped(Vector3Stamped(), t_ns))
        state.publish(stamped(JointState(name=["a", "b"], position=sent[t_ns].tolist()), t_ns))
        time.sleep(0.005)
        return t_ns

    def send(samples: int) -> None:
        last = [send_one() for _ in range(samples)][-1]
        ends = [heard[name] for name in ("flags", "statistics")]
        until(lambda: all(last in map(stamp_of, topic.messages[-1:]) for topic in ends), "the last verdict")

    send(50)
    begins = [0, len(sent)]  # of each session, among the samples sent
    accepted, reason = world.set(model=str(paths[1]))
    assert accepted, reason
    send(50)
    process.kill()
    begins.append(len(sent))
    world.run_node("envelope_monitor", {"model": str(paths[1]), "diagnostics_period": 0.1})
    diagnostics = world.diagnostics()
    known = len(heard["statistics"].messages)

    def comes_back() -> bool:
        send_one()
        return len(heard["statistics"].messages) > known

    until(comes_back, "the second process")
    send(50)
    world.node.destroy_publisher(state)
    state = world.publisher(JointState, STATE, QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT))
    until(
        lambda: (
            (status := diagnostics.latest("envelope_monitor: monitor"))
            and Diagnostics.values(status)[f"qos {STATE}"] == "best_effort volatile"
        ),
        "a best-effort subscription",
    )
    world.subscribed(state)
    send(50)

    stamps = np.array(list(sent))
    for begin, end, model in zip(begins, [*begins[1:], len(sent)], (models[0], *models[1:] * 2), strict=True):
        flags = {stamp_of(m): m for m in heard["flags"].messages if stamps[begin] <= stamp_of(m) <= stamps[end - 1]}
        first = next(k for k, m in enumerate(flags.values()) if not np.isnan(m.position[0]))
        came = list(flags)[first - 1 :]
        assert len(came) > 45
        x, u = np.array([sent[t] for t in came]), np.zeros((len(came), 2))
        max_gap = model.signals.max_gap
        verdicts = EnvelopeMonitor(model).check(Transient(np.array(came), x, u, signals=model.signals, max_gap=max_gap))
        for k, t_ns in enumerate(came):
            np.testing.assert_array_equal(flags[t_ns].position, verdicts.flags[k])
        for name in ("horizon_utilisation", "statistics"):
            told = {stamp_of(m): np.array(m.position).tobytes() for m in heard[name].messages}
            expected = [np.ravel(getattr(verdicts, name)[k]).tobytes() for k in np.flatnonzero(verdicts.judged)]
            at = [came[k] for k in np.flatnonzero(verdicts.judged)]
            assert [told[t] for t in at if t in told] == [e for t, e in zip(at, expected, strict=True) if t in told]
            assert sum(t in told for t in at) > 40
    assert heard["horizon_predicted_lower"].messages
