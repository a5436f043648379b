# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The compiled live chain and the same files uncompiled: the same verdicts, bits, counters and messages."""

from __future__ import annotations

import gc
import importlib
import json
import math
import os
import subprocess
import sys
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")

import rclpy
from hypothesis import given, settings
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from ros_processes import own_domain
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Float64MultiArray, Int32
from test_sampler import Sent, cases

from uncertain_lti import SignalMap, UncertainLTI
from uncertain_lti.base import compiled
from uncertain_lti.base.limits import LONGEST_S
from uncertain_lti.model import bounds
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.model.domain import Domain, Sampling
from uncertain_lti.model.schedule import Axis, BlockData, Schedule
from uncertain_lti.monitor.verdict import Verdict
from uncertain_lti.sampling import sampler as sampler_module
from uncertain_lti.signals.signal_map import Signal
from uncertain_lti_ros import envelope_monitor as node_module

STATE, CONTROL, SETPOINT = "/state", "/control", "/setpoint"
VECTOR, ARRAY = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
START_NS, STEP_NS = 10**18, 10_000_000

needs_compiled = pytest.mark.skipif(bool(compiled.why_not()), reason=f"not compiled: {compiled.why_not()}")
PURE_BOUNDS, PURE_SAMPLER, PURE_VERDICT, PURE_MESSAGES = (
    compiled.uncompiled(name)
    for name in ("model.bounds", "sampling.sampler", "monitor.verdict", "monitor.verdict_messages")
)


class Input:
    """Stands in for a subscription: messages arrive when the test says so."""

    def __init__(self, node: Any, topic: str, type_name: str, kind: Any, callback: Any, wish: Any, raw: bool) -> None:
        self.topic, self.type_name, self.callback = topic, type_name, callback
        self.received = self.lost = self.late = 0
        self.publishers, self.problems, self.look_soon, self.qos = 1, list[str](), False, QoSProfile(depth=1)

    def arrive(self, data: bytes) -> None:
        self.received += 1
        self.callback(data)

    def look(self) -> None:
        pass

    def destroy(self) -> None:
        pass

    def poll(self) -> None:
        pass


class Clock:
    """The node's clock, as the test sets it."""

    ros_time_is_active = True
    nanoseconds = 0

    def now(self) -> Clock:
        return self

    def to_msg(self) -> Any:
        return JointState().header.stamp


class Node(node_module.EnvelopeMonitorNode):
    """The real one; its messages come from `arrive`, and what it sends is kept."""

    def __init__(self, path: Path, silent: tuple[str, ...] = ()) -> None:
        super().__init__()
        self.sent: list[tuple[str, bytes]] = []
        self.clock = Clock()
        self.set_parameters([Parameter("model", value=str(path))])
        self.start()
        assert self.active, self.reason
        for name, output in self.outputs.publishers.items():
            output.send = self._keeps(name)
            output.listeners = int(name not in silent)
            output.poll = lambda: None
        self.tick()

    def _keeps(self, name: str) -> Callable[[bytes], None]:
        return lambda data: self.sent.append((name, data))

    def arrive(self, at_ns: int, topic: str, data: bytes) -> None:
        self.clock.nanoseconds = at_ns
        self.inputs[topic].arrive(data)

    def standing(self) -> dict[str, Any]:
        """Everything that counts for what comes next, and every count."""
        session = self.session
        assert session is not None
        last = session.last
        return {
            "counters": session.sampler.counters,
            "received": session.received,
            "received by": {topic: one.received for topic, one in self.inputs.items()},
            "unreadable": session.unreadable,
            "future": session.future,
            "judged": (session.verdicts, session.violations, session.alarms, session.alarm, session.failures),
            "window": [getattr(p, "recent", tuple(p.values())) for p in session.monitor.alarms.parts],
            "latest": repr(session.sampler.latest()),
            "enable": (session.arming.on, session.arming.value),
            "last": last and (last.t_ns, last.outside_domain, last.unknown_regime, last.alarm),
            "last numbers": last and last.packed(),
            "remembered": [
                (e.arrival_ns, e.topic, e.data, e.alarm, [told(v) for v in e.verdicts])
                for e in self.snapshots.recent.entries()
            ],
            "period": (session.period.verdicts, session.period.outside, session.period.alarm),
        }


def told(verdict: Verdict) -> tuple[Any, ...]:
    said = verdict.packed() if verdict.judged else b""
    return verdict.t_ns, verdict.n, verdict.judged, verdict.outside_domain, said


@pytest.fixture
def ros(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """Nodes whose inputs are `Input`, that keep all messages, and do nothing by the time that the test takes."""
    monkeypatch.setattr(node_module, "MatchedSubscription", Input)
    given = {"heartbeat": 3600.0, "diagnostics_period": 3600.0, "snapshot.seconds": 3600.0, "snapshot.memory": 1024.0}
    given |= {"snapshot.folder": tmp_path / "snapshots", "catch_up": 0.0, "state_timeout": 3600.0}
    arguments = [word for name, value in given.items() for word in ("-p", f"{name}:={value}")]
    with own_domain() as domain:
        rclpy.init(args=["--ros-args", *arguments], domain_id=domain)
        try:
            yield
        finally:
            rclpy.try_shutdown()
            gc.collect()  # else the nodes would still be there for the next test in this domain


def end(nodes: list[Node]) -> None:
    for node in nodes:
        node.last_standing, node.verdicts, node.alarms = node.standing(), node.session.verdicts, node.session.alarms
        node.finish()
        assert node.state_name == "finalized"
        node.destroy_node()


def saved(
    path: Path,
    n: int,
    rng: np.random.Generator,
    margin: float = 1.0,
    clock: str = "header",
    schedule: Schedule | None = None,
) -> UncertainLTI:
    """n states; two controls by stamps, one by arrival; bounds that the signals of `stream` seldom leave.

    Where the schedule names `w`, the one by arrival is no control but a further scheduling signal.
    """
    steady, scale = rng.normal(size=n + 3), rng.uniform(0.5, 2.0, n + 3)
    kinds = [(f"x{i}", STATE, VECTOR, f"position[x{i}]", None) for i in range(n)]
    kinds += [("u0", CONTROL, VECTOR, "position[u0]", 0.08), ("u1", CONTROL, VECTOR, "position[u1]", None)]
    kinds += [("w", SETPOINT, ARRAY, "data[1]", 0.3)]
    every = tuple(
        Signal(name, topic, path, float(steady[k]), float(scale[k]), type=kind, max_hold=hold)
        for k, (name, topic, kind, path, hold) in enumerate(kinds)
    )
    further = schedule is not None and "w" in [axis.signal for axis in schedule.axes]
    m = 2 if further else 3
    lead = () if schedule is None else (schedule.blocks,)
    signals = SignalMap(
        every[:n],
        every[n : n + m],
        every[n + m :],
        clock=STATE,
        max_gap=0.055,
        min_step=0.002,
        time={STATE: clock, CONTROL: "header", SETPOINT: "log"},
    )
    model = UncertainLTI(
        rng.normal(size=(*lead, n, n)),
        rng.normal(size=(*lead, n, m)),
        rng.uniform(0, 0.3, (*lead, n, n)),
        rng.uniform(0, 0.3, (*lead, n, m)),
        c=rng.normal(size=(*lead, n)),
        dc=rng.uniform(0, 0.1, (*lead, n)),
        v=rng.uniform(0.3, 0.5, (*lead, n)),
        schedule=schedule,
        block_data=schedule and [BlockData(int(r != 1)) for r in range(schedule.blocks)],
        domain=Domain(np.full(n, -0.2), np.full(n, 0.2), np.full(m, -0.2), np.full(m, np.inf)),
        signals=signals,
        sampling=Sampling(STATE, VECTOR, dict(signals.time), dt_median=0.01, max_gap=0.055),
        alarm_rule=AlarmRule(3, 20, margin),
    )
    model.save(path)
    return model


def vector(t_ns: int, values: dict[str, float], frame: str = "") -> bytes:
    message = JointState(name=list(values), position=list(values.values()))
    message.header.frame_id = frame
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(t_ns, 10**9)
    return serialize_message(message)


def array(*values: float) -> bytes:
    return serialize_message(Float64MultiArray(data=values))


FAULTS = (
    "outside", "nan state", "nan control", "no stamp", "equal", "late", "short", "gap", "reset", "future", "frame",
    "order", "cut", "flipped", "no control", "late control", "ahead control", "stale", "unstamped control", "many",
    "back control", "huge",
)  # fmt: skip


def stream(model: UncertainLTI, rng: np.random.Generator, count: int, rate: float) -> Iterator[tuple[int, str, bytes]]:
    """Arrival, topic and message; `rate`: how often something befalls them."""
    n, point = model.n, model.operating_point
    t = START_NS
    for _ in range(count):
        fault = str(rng.choice(FAULTS)) if rng.random() < rate else ""
        t += STEP_NS + int(rng.integers(-(10**6), 10**6))
        t += {"gap": 10**8, "reset": -(10**9), "stale": 4 * STEP_NS}.get(fault, 0)
        x = point.x_s + point.X * rng.normal(0, 0.05, n)
        u = point.u_s[:2] + point.U[:2] * rng.normal(0, 0.05, 2)
        if fault == "outside":
            x[rng.integers(n)] += 5.0
        if fault == "huge":
            x[rng.integers(n)] = 1e308
        if fault == "nan state":
            x[rng.integers(n)] = np.nan
        if fault == "nan control":
            u[rng.integers(2)] = rng.choice([np.nan, np.inf])
        control_t = t - int(rng.integers(10**6))
        control_t += {"late control": -3 * STEP_NS, "ahead control": 2 * 10**6, "back control": -(10**9)}.get(fault, 0)
        control_t = 0 if fault == "unstamped control" else control_t
        if rng.random() < 0.2:
            yield t - 500_000, SETPOINT, array(0.0, point.steady[n + 2] + rng.normal(0, 0.1), 1.0)
        if fault not in ("no control", "stale"):
            for k in range(int(rng.integers(2, 400)) if fault == "many" else 1):
                yield t - 200_000 + k, CONTROL, vector(control_t + k, {"u0": u[0], "u1": u[1]})
        state_t = t + {"equal": -STEP_NS, "late": -2 * STEP_NS, "short": -STEP_NS + 10**6, "future": 5 * 10**9}.get(
            fault, 0
        )
        state_t = 0 if fault == "no stamp" else state_t
        named = {f"x{i}": x[i] for i in range(n)}
        if fault == "order":
            named = dict(reversed(named.items()))
        data = vector(state_t, named, "base" if fault == "frame" else "")
        if fault == "cut":
            data = data[: int(rng.integers(len(data)))]
        if fault == "flipped":
            place = int(rng.integers(len(data)))
            data = data[:place] + bytes([data[place] ^ (1 << int(rng.integers(8)))]) + data[place + 1 :]
        yield t, STATE, data


def played(path: Path, messages: Sequence[Any], pure: bool, silent: tuple[str, ...] = (), **given: Any) -> Any:
    """What a node is left with, and what it sent, after messages; None among them is a tick, "reset" a reset."""
    with pytest.MonkeyPatch.context() as patch:
        if pure:
            patch.setattr("uncertain_lti.model.uncertain_lti.Judge", PURE_BOUNDS.Judge)
            patch.setattr("uncertain_lti.monitor.stream.Sampler", PURE_SAMPLER.Sampler)
            patch.setattr("uncertain_lti.monitor.envelope_monitor.Verdict", PURE_VERDICT.Verdict)
            patch.setattr("uncertain_lti.monitor.verdict_messages.Encoder", PURE_MESSAGES.Encoder)
            patch.setattr("uncertain_lti_ros.outputs.NamedVector", PURE_MESSAGES.NamedVector)
        node = Node(path, silent)
        if given:
            results = node.set_parameters([Parameter(name, value=value) for name, value in given.items()])
            assert all(result.successful for result in results), results
        found = []
        for k, message in enumerate(messages):
            if message is None:
                node.tick()
            elif message == "reset":
                node.session.reset()
            elif message[1] in node.inputs:
                node.arrive(*message)
            if k % 100 == 0:
                found.append(node.standing())
        end([node])
        return [*found, node.last_standing], node.sent, node


def same(path: Path, messages: Sequence[Any], **options: Any) -> Any:
    """Both play alike; returns the compiled node."""
    one, other = (played(path, messages, pure, **options) for pure in (False, True))
    assert one[0] == other[0]
    assert one[1] == other[1]
    assert one[2].verdicts == other[2].verdicts > 0
    return one[2]


def with_ticks(messages: Iterable[Any], rng: np.random.Generator, share: float) -> list[Any]:
    found: list[Any] = []
    for message in messages:
        found.append(message)
        if rng.random() < share:
            found.append(None)
    return found


KNOTS, OF_FURTHER = Axis("x0", knots=(-1.0, -0.1, 0.0, 0.2, 1.0)), Axis("w", knots=(-0.1, 0.1))
MODES = Axis("gear", modes=(1.0, 2.0, 5.0))
SCHEDULES = {
    "one block": None,
    "knots": Schedule((KNOTS,)),
    "modes": Schedule((MODES,)),
    "two": Schedule((KNOTS, OF_FURTHER)),
    "knots and modes": Schedule((MODES, OF_FURTHER)),
}


@needs_compiled
@pytest.mark.parametrize("n, m", [(1, 0), (1, 9), (5, 4), (50, 10)])
@pytest.mark.parametrize("margin", [1.0, 0.3])
@pytest.mark.parametrize("schedule", SCHEDULES.values(), ids=SCHEDULES)
def test_one_transition_is_judged_alike_to_the_last_bit(
    n: int, m: int, margin: float, schedule: Schedule | None
) -> None:
    """Compiled, uncompiled and many at once."""
    rng = np.random.default_rng([n, m])
    further = [axis.signal for axis in schedule.axes if axis.signal != "x0"] if schedule else []
    lead, total = ((schedule.blocks,) if schedule else ()), n + m + len(further)
    terms = [rng.normal(size=(*lead, n, n + m + 1)) for _ in range(2)]
    terms[1][rng.random(terms[1].shape) < 0.3] = 0.0
    steady, scale = rng.normal(size=total), rng.uniform(0.1, 2.0, total)
    if "gear" in further:
        steady[n + m + further.index("gear")], scale[n + m + further.index("gear")] = 0.0, 1.0
    signals = SignalMap(
        *(
            tuple(
                Signal(name, "", "a", steady=float(steady[first + i]), scale=float(scale[first + i]))
                for i, name in enumerate(names)
            )
            for first, names in (
                (0, [f"x{i}" for i in range(n)]),
                (n, [f"u{j}" for j in range(m)]),
                (n + m, further),
            )
        )
    )
    model = UncertainLTI(
        terms[0][..., :n], terms[0][..., n : n + m], np.abs(terms[1][..., :n]), np.abs(terms[1][..., n : n + m]),
        terms[0][..., n + m], np.abs(terms[1][..., n + m]), rng.uniform(0, 6, (*lead, n)),
        schedule=schedule, block_data=schedule and [BlockData(int(r != 1)) for r in range(schedule.blocks)],
        signals=signals, domain=Domain(np.full(n, -9.0), np.full(n, 9.0), np.full(m, -9.0), np.full(m, 9.0)),
    )  # fmt: skip
    counted = rng.random(n) < 0.7
    judges = [model.judge_of(margin, counted)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("uncertain_lti.model.uncertain_lti.Judge", PURE_BOUNDS.Judge)
        judges.append(model.judge_of(margin, counted))
    point = model.operating_point
    unlisted = unknown = 0
    assert len({type(judge).__module__ for judge in judges}) == 2
    odd = [0.0, -0.0, math.nan, math.inf, -math.inf, 1e308, 5e-324]
    seen: set[float] = set()
    for k in range(400):
        before, after = rng.normal(size=total) * 2, rng.normal(size=n) * 2
        if "gear" in further:
            before[n + m + further.index("gear")] = rng.integers(1, 7)
        if k % 4 == 0:
            before[rng.integers(total)] = rng.choice(odd)
        if k % 5 == 0:
            after[rng.integers(n)] = rng.choice(odd)
        dt = float(rng.choice([1e-3, 0.1, 0.0]))
        one, other = (judge.judge(before.tolist(), tuple(after.tolist()), dt) for judge in judges)
        z = (before - point.steady) / point.scale
        listed, strange = model.regime(z[:, None])
        unlisted += not listed[0]
        if one is None:
            assert other is None and not listed[0]
            continue
        unknown += one.unknown_regime
        assert one.unknown_regime == strange[0]
        verdict = one.contained, one.violation, one.outside_domain, one.unknown_regime
        assert verdict == (other.contained, other.violation, other.outside_domain, other.unknown_regime)
        lower, upper = model.bounds(z[:n], z[n : n + m], dt, margin, z[n + m :])
        for which, bound in ((bounds.LOWER, lower), (bounds.UPPER, upper)):
            expected = point.recorded_x(bound)
            known = ~np.isnan(expected)
            assert np.array(one.numbers(which))[known].tobytes() == expected[known].tobytes()
        for which in range(5):
            mine, theirs = np.array(one.numbers(which)), np.array(other.numbers(which))
            known = ~np.isnan(theirs)
            seen |= set(theirs[known]) if which == bounds.FLAGS else set()
            assert mine[known].tobytes() == theirs[known].tobytes() and np.isnan(mine[~known]).all()
    assert seen == {0.0, 1.0}
    assert (unlisted > 0 or "gear" not in further) and (unknown > 0) == (schedule is not None)


@pytest.mark.parametrize("module", [bounds, PURE_BOUNDS], ids=["in use", "uncompiled"])
def test_what_does_not_fit_together_is_refused_before_it_is_read(module: Any) -> None:
    one, two = np.ones((2, 4)), np.ones(2)
    point = np.zeros(3), np.ones(3), np.zeros(3), np.ones(3)
    for bad in ((one[:1], one, two), (one, one[:, :2], two), (one, one, two[:1])):
        with pytest.raises(ValueError, match="fit"):
            module.Judge(*bad, *point, 1.0, np.array([True, True]))
    with pytest.raises(ValueError, match="fit"):
        module.Judge(one, one, two, point[0][:1], *point[1:], 1.0, np.array([True, True]))
    judge = module.Judge(one, one, two, *point, 1.0, np.array([True, True]))
    for before, after in (([0.0], [0.0, 0.0]), ([0.0] * 3, [0.0]), ([], [])):
        with pytest.raises(ValueError, match="values for"):
            judge.judge(before, after, 0.1)
    with pytest.raises((TypeError, ValueError)):
        judge.judge(["a", "b", "c"], [0.0, 0.0], 0.1)


@needs_compiled
@settings(max_examples=200, deadline=None)
@given(case=cases())
def test_streams_are_sampled_alike(case: tuple[SignalMap, list[Sent]]) -> None:
    found = []
    for module in (sampler_module, PURE_SAMPLER):
        sampler, steps = module.Sampler(case[0]), []
        for sent in case[1]:
            steps += sampler.push(*sent)
        found.append(
            ([(s.status, s.t_ns, s.arrival_ns, repr((s.dt, list(s.before), list(s.after)))) for s in steps],
             sampler.counters, repr(sampler.latest()))
        )  # fmt: skip
    assert found[0] == found[1]


@needs_compiled
@pytest.mark.parametrize("clock", ["header", "log"])
@pytest.mark.parametrize(
    "n, rate, margin, schedule",
    [(1, 0.01, 1.0, None), (3, 0.3, 1.3, None), (40, 0.02, 1.0, None), (3, 0.1, 1.0, "knots"), (3, 0.1, 1.0, "two")],
)
def test_a_node_publishes_and_counts_alike(
    ros: None, tmp_path: Path, n: int, rate: float, margin: float, clock: str, schedule: str | None
) -> None:
    for seed in range(2):
        rng = np.random.default_rng([seed, n])
        model = saved(tmp_path / "model.json", n, rng, margin, clock, SCHEDULES[schedule or "one block"])
        silent = (("flags", "state"), ("predicted_lower", "lower"))[seed]
        messages = with_ticks(stream(model, rng, 400, rate), rng, 0.1)
        same(tmp_path / "model.json", messages, silent=silent)


def test_an_output_that_fails_is_reported_and_the_node_goes_on(ros: None, tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    model = saved(tmp_path / "model.json", 3, rng)
    node = Node(tmp_path / "model.json")

    def fail(data: bytes) -> None:
        raise RuntimeError("the publisher is gone")

    kept = node.outputs.publishers["upper"].send
    for k, message in enumerate(stream(model, rng, 60, 0.0)):
        if k == 60:
            node.outputs.publishers["upper"].send = fail
        if k == 70:
            node.outputs.publishers["upper"].send = kept
        node.arrive(*message)
    assert node.failures.count == node.session.failures > 0
    assert node.session.verdicts > 45
    end([node])


def at_work(folder: Path) -> tuple[Node, tuple[int, str, bytes]]:
    """A node that has judged a stream, and the message that comes next."""
    rng = np.random.default_rng(6)
    model = saved(folder / "model.json", 3, rng)
    node = Node(folder / "model.json")
    *messages, last = stream(model, rng, 60, 0.0)
    for message in messages:
        node.arrive(*message)
    assert node.session.verdicts > 40
    return node, last


def test_an_interrupt_while_something_is_sent_ends_the_process(ros: None, tmp_path: Path) -> None:
    node, last = at_work(tmp_path)

    def interrupt(data: bytes) -> None:
        raise KeyboardInterrupt

    node.outputs.publishers["upper"].send = interrupt
    with pytest.raises(KeyboardInterrupt):
        node.arrive(*last)
    assert not node.failures.count
    end([node])


def test_a_node_that_is_put_away_leaves_nothing(ros: None, tmp_path: Path) -> None:
    node, _ = at_work(tmp_path)
    end([node])
    left = weakref.ref(node)
    del node
    gc.collect()
    assert left() is None


def test_the_shortest_messages_are_taken(ros: None, tmp_path: Path) -> None:
    """A UInt8 takes five bytes; rclpy sends eight of them, others need not."""
    level = Signal("u", SETPOINT, "data", type="std_msgs/msg/UInt8")
    signals = SignalMap(
        (Signal("x0", STATE, "position[x0]", type=VECTOR),), (level,), clock=STATE, max_gap=0.055,
        time={STATE: "header", SETPOINT: "log"},
    )  # fmt: skip
    sampling = Sampling(STATE, VECTOR, dict(signals.time), dt_median=0.01, max_gap=0.055)
    UncertainLTI([[0.0]], [[0.0]], [[0.0]], [[0.0]], v=[1.0], signals=signals, sampling=sampling).save(
        tmp_path / "model.json"
    )
    messages: list[Any] = []
    for k in range(60):
        at = START_NS + k * STEP_NS
        messages += [(at, SETPOINT, bytes([0, 1, 0, 0, k])), (at, STATE, vector(at, {"x0": 3.0 * (k % 7 == 0)})), None]
    _, sent, node = played(tmp_path / "model.json", messages, False)
    assert node.verdicts == 59 and not node.failures.count and sent


def test_formats_that_come_and_go_are_learnt(ros: None, tmp_path: Path) -> None:
    rng = np.random.default_rng(9)
    model = saved(tmp_path / "model.json", 3, rng)
    node = Node(tmp_path / "model.json")
    for k, (at, topic, data) in enumerate(stream(model, rng, 3000, 0.0)):
        if topic == STATE:
            x = np.frombuffer(data[-40:-16])
            data = vector(at, {f"x{i}": x[i] for i in range(3)}, "f" * (k // 100 % 20))
        node.arrive(at, topic, data)
    assert node.session.decoded[STATE] < 150 and node.session.verdicts > 2900
    end([node])


@pytest.mark.parametrize("name", ["max_hold", "max_gap", "dt_median"])
def test_durations_without_end_are_as_good_as_others(ros: None, tmp_path: Path, name: str) -> None:
    rng = np.random.default_rng(10)
    model = saved(tmp_path / "model.json", 3, rng)
    content = json.loads((tmp_path / "model.json").read_text())
    if name == "max_hold":
        content["controls"][0][name] = LONGEST_S
    else:
        content["sampling"][name] = LONGEST_S
    (tmp_path / "model.json").write_text(json.dumps(content))
    node = same(tmp_path / "model.json", with_ticks(stream(model, rng, 60, 0.0), rng, 0.1))
    assert not node.failures.count


def test_a_clock_that_fails_is_reported_and_the_sampler_starts_over(ros: None, tmp_path: Path) -> None:
    rng = np.random.default_rng(11)
    model = saved(tmp_path / "model.json", 3, rng)
    node = Node(tmp_path / "model.json")
    for k, message in enumerate(stream(model, rng, 60, 0.0)):
        if k == 60:
            node.clock.now = lambda: 1 / 0
        node.arrive(*message)
        node.clock = Clock()
    assert node.session.failures == node.failures.count == 1 and node.session.verdicts > 50
    end([node])


IMU, MODE = "/imu", "/mode"
OPTIONS = (
    set[str](),
    {"delays"},
    {"angles"},
    {"several"},
    {"delays", "angles", "several"},
    {"memories", "angles"},
    {"memories", "several"},
    {"enable on the clock", "delays"},
    {"enable on a control", "several"},
    {"enable elsewhere"},
)


def saved_with(path: Path, options: set[str], rng: np.random.Generator, alarm: AlarmRule) -> UncertainLTI:
    """Joints, and of an inertial unit an angle and a norm; a control of whole numbers; left bounds are no rarity."""
    hold = 0.015 if "delays" in options else 0.1
    states = [
        Signal("x0", STATE, "position[x0]", type=VECTOR),
        Signal("x1", STATE, "unwrap(position[x1])" if "angles" in options else "velocity[x1]", type=VECTOR),
    ]
    where = IMU if "several" in options else STATE
    if where == IMU:
        states += [
            Signal("yaw", IMU, "unwrap(yaw(orientation))", type="sensor_msgs/msg/Imu"),
            Signal("rate", IMU, "norm(angular_velocity)", type="sensor_msgs/msg/Imu"),
        ]
    controls = [
        Signal("u0", CONTROL, "position[u0]", type=VECTOR, max_hold=hold, delay=3 if "delays" in options else 0),
        Signal("level", "/level", "data", type="std_msgs/msg/Int32", delay=1 if "delays" in options else 0),
    ]
    if "memories" in options:
        states[0] = replace(states[0], valid=(-0.1, 0.2))
        controls[1] = replace(controls[1], ignore=(2.0,))
        controls += [
            Signal("x0_before", STATE, "lag(position[x0], 2)", type=VECTOR),
            Signal("x1_rate", STATE, f"rate({states[1].field})", scale=50.0, type=VECTOR),
            Signal("u0_change", CONTROL, "diff(position[u0])", type=VECTOR, max_hold=hold),
        ]
    if "several" not in options:
        controls.append(Signal("tilt", IMU, "pitch(orientation)", type="sensor_msgs/msg/Imu", max_hold=hold))
    n, m = len(states), len(controls)
    time = {STATE: "header", CONTROL: "header", IMU: "header", "/level": "log"}
    signals = SignalMap(tuple(states), tuple(controls), clock=STATE, max_gap=0.055, min_step=0.002, time=time)
    step = 0.0101 if "memories" in options else None
    signals = replace(signals, step=step or "recorded")
    model = UncertainLTI(
        rng.normal(size=(n, n)), rng.normal(size=(n, m)), rng.uniform(0, 0.3, (n, n)), rng.uniform(0, 0.3, (n, m)),
        v=np.array([0.18, 0.5, 0.6, 0.22][:n]),
        domain=Domain(np.full(n, -3.0), np.full(n, 3.0), np.full(m, -3.0), np.full(m, 3.0)),
        signals=signals,
        sampling=Sampling(STATE, VECTOR, time, dt_median=0.01, max_gap=0.055, step=step),
        alarm_rule=alarm,
    )  # fmt: skip
    model.save(path)
    return model


def imu(t_ns: int, yaw: float, pitch: float, rate: np.ndarray) -> bytes:
    message = Imu()
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(t_ns, 10**9)
    half = np.array([pitch, yaw]) / 2
    (sp, sy), (cp, cy) = np.sin(half), np.cos(half)
    message.orientation.x, message.orientation.y = -sp * sy, sp * cy
    message.orientation.z, message.orientation.w = cp * sy, cp * cy
    message.angular_velocity.x, message.angular_velocity.y, message.angular_velocity.z = rate
    return serialize_message(message)


def stream_with(rng: np.random.Generator, count: int, rate: float) -> Iterator[tuple[int, str, bytes]]:
    t, on, frame = START_NS, True, ""
    faults = ("gap", "reset", "nan", "equal", "no imu", "no control", "back imu", "frame", "wild", "off", "mode")
    for k in range(count):
        fault = str(rng.choice(faults)) if rng.random() < rate else ""
        t += STEP_NS + int(rng.integers(-(10**6), 10**6)) + {"gap": 10**8, "reset": -(10**9)}.get(fault, 0)
        on ^= fault == "off"
        frame = "base" if fault == "frame" else frame
        turned = 0.05 * k + rng.normal(0, 0.1)
        if rng.random() < 0.1 or k == 0:
            yield t - 900_000, "/level", serialize_message(Int32(data=int(rng.integers(-2, 3))))
        if rng.random() < 0.2 or k == 0:
            yield t - 800_000, MODE, serialize_message(Int32(data=int(on) if fault != "mode" else 7))
        if fault != "no control":
            yield t - 700_000, CONTROL, vector(t - 750_000, {"u0": rng.normal(0, 0.1) + (0 if on else -5.0)})
        if fault != "no imu":
            at = t - 10**9 if fault == "back imu" and k > 0.8 * count else t - int(rng.integers(-1, 2)) * 300_000
            yield t - 600_000, IMU, imu(at, turned, rng.normal(0, 0.1), rng.normal(0, 0.1, 3))
        x = rng.normal(0, 0.05, 2)
        x[0] += {"nan": np.nan, "wild": 1e300}.get(fault, 0.0)
        message = JointState(name=["x0", "x1"], position=[x[0], np.remainder(turned + np.pi, 2 * np.pi) - np.pi])
        message.velocity, message.effort, message.header.frame_id = x.tolist(), [float(on)], frame
        stamp = t - STEP_NS if fault == "equal" else t
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
        yield t, STATE, serialize_message(message)


@needs_compiled
@pytest.mark.parametrize("options", OPTIONS, ids=lambda options: ", ".join(sorted(options)) or "plain")
@pytest.mark.parametrize("rate", [0.0, 0.03])
def test_alarms_delays_angles_and_states_on_several_topics_are_alike(
    ros: None, tmp_path: Path, options: set[str], rate: float
) -> None:
    alarms = 0
    for seed, rule in enumerate((AlarmRule(1, 1), AlarmRule(3, 8), AlarmRule(6, 40, 0.9), AlarmRule(2, 2, 1.2))):
        if seed not in (0, 1 + len(options) % 3):
            continue
        rng = np.random.default_rng([seed, len(options)])
        saved_with(tmp_path / "model.json", options, rng, rule)
        enable = {
            "enable on the clock": f"{STATE} effort[0] > 0.5",
            "enable on a control": f"{CONTROL} position[u0] >= -2.5",
            "enable elsewhere": f"{MODE} data == 1",
        }
        given: dict[str, Any] = {"enable": next((enable[option] for option in options if option in enable), "")}
        given |= {"enable_type": "std_msgs/msg/Int32"} if "enable elsewhere" in options else {}
        given |= {"latch": seed == 1, "grace": 0.15 * (seed == 2), "masked": "x0" if seed == 3 else ""}
        messages = with_ticks(stream_with(rng, 300, rate), rng, 0.05)
        node = same(tmp_path / "model.json", [*messages[:500], "reset", *messages[500:]], **given)
        assert not node.failures.count
        alarms += node.alarms
    assert alarms


def test_a_twin_of_another_source_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    code = "from uncertain_lti.base import compiled; print(compiled.why_not())"

    def reason(**environment: str) -> str:
        result = subprocess.run(
            [sys.executable, "-c", code], env={**os.environ, **environment}, capture_output=True, text=True, check=True
        )
        return result.stdout.strip()

    assert "UNCERTAIN_LTI_PURE_PYTHON is set" in reason(UNCERTAIN_LTI_PURE_PYTHON="1")
    if compiled.why_not():
        pytest.skip(f"not compiled: {compiled.why_not()}")
    assert reason() == ""
    twin = importlib.import_module("uncertain_lti.model._bounds")
    monkeypatch.setattr(twin, "SOURCE", 1)
    module = {"__name__": bounds.__name__, "__file__": bounds.__file__, "Judge": None}
    compiled.use_twin(module, ["Judge"])
    assert module["Judge"] is None and "another version" in compiled.why_not()
    monkeypatch.undo()
    compiled.use_twin(module, ["Judge"])
    assert module["Judge"] is twin.Judge and not compiled.why_not()
