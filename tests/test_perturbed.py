# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Live is offline, everything armed, under every disorder; `benchmarks/fuzz.py --kinds streams` tries thousands."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import perturbed
import pytest
from perturbed import CONTROL, EPOCH_NS, STATE, STEP_NS, Message, joint_state, session_of, vector

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI
from uncertain_lti.model.alarm_rule import KINDS, AlarmRule
from uncertain_lti.model.horizon import Horizon
from uncertain_lti.monitor.session import ERROR, Rule
from uncertain_lti.sampling.clock import Status

COUNTS = {perturbed.in_disorder: 16, perturbed.of_a_swapped_model: 8, perturbed.held_up_on_the_way: 8}


@pytest.mark.parametrize("case", COUNTS, ids=lambda case: case.__name__)
def test_live_is_offline(case, tmp_path: Path) -> None:
    seen, raised = Counter[Status](), set[str]()
    for seed in range(COUNTS[case]):
        ours, theirs = case(np.random.default_rng(seed), tmp_path)
        found = perturbed.difference(ours, theirs)
        assert not found, f"seed {seed}: {found}"
        seen.update(row["status"] for row in ours)
        raised |= {reason.kind for row in ours for reason in row["raised"]}
        seen["outside"] += sum(row["outside_domain"] for row in ours)
        seen["alarm"] += sum(row["alarm"] for row in ours)
    assert seen[Status.OK] > 100 * COUNTS[case] / 3 and seen["outside"] > 100 and seen["alarm"] > 500
    assert seen.keys() >= {Status.OK, Status.MISSING, Status.FROZEN}
    if case is perturbed.in_disorder:
        assert seen.keys() >= {Status.GAP, Status.RESET, Status.STEP, Status.MODE}
        assert raised == {*KINDS, "containment"}


def test_what_differs_is_found(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    model = perturbed.armed_model(rng)
    messages = perturbed.stream(model, rng, 60)
    ours = perturbed.live(perturbed.session_of(model, Rule()), messages)
    moved = model.replace(alarm_rule=None, dA=model.dA * (1 + 1e-15))
    other = perturbed.offline(moved, Rule(), messages, tmp_path / "a")
    assert "live" in perturbed.difference(ours, other)
    assert perturbed.difference(ours, ours[:-1]) == f"{len(ours)} samples live, {len(ours) - 1} offline"


def plain(seed: int = 2) -> UncertainLTI:
    """A model of two states whose controls are p and q, without limits, with a horizon."""
    model = perturbed.armed_model(np.random.default_rng(seed), everything=True)
    signals = model.signals
    controls = tuple(replace(s, valid=None, ignore=(), max_hold=None, at="departure") for s in signals.controls[:2])
    time = dict.fromkeys((STATE, CONTROL), "header")
    kept = replace(signals, states=signals.states[:2], controls=controls, scheduling=(), time=time, step="recorded")
    n = 2
    none = np.zeros((n, n))
    return UncertainLTI(
        -0.5 * np.eye(n), none, np.full((n, n), 0.1), none, v=np.full(n, 0.05), alarm_rule=AlarmRule(1, 1),
        signals=kept, sampling=model.sampling,
        horizons=[Horizon(3, none, none, none, none, v=np.full(n, 0.1))],
    )  # fmt: skip


def both(k: int, a: float = 0.3, p: float = 0.1) -> list[Message]:
    t = EPOCH_NS + k * STEP_NS
    return [Message(CONTROL, t, vector(t, p, 0.0, 0.0)), Message(STATE, t + 1, joint_state(t, [a, -0.2]))]


def test_a_message_that_cannot_be_read_leaves_the_condition_as_it_was(tmp_path: Path) -> None:
    """As in a recording, where it is left out; an alarm must not end by it."""
    model, rule = plain(), Rule(enable=f"{STATE} position[b] < 0")
    messages = both(0) + both(1) + both(2, a=0.9)
    broken = Message(STATE, messages[-1].log_time + 1, messages[-1].data[:20])
    session = session_of(model, rule)
    assert perturbed.live(session, messages)[-1]["alarm"]
    session.take(broken.topic, broken.log_time, broken.data, 0.0)
    assert session.alarm and session.arming.on and session.unreadable[STATE] == 1
    whole = [*messages, broken, *both(3, a=0.9)]
    rows = perturbed.live(session_of(model, rule), whole)
    assert not perturbed.difference(rows, perturbed.offline(model, rule, whole, tmp_path / "run.mcap"))


def test_an_unexpected_error_ends_no_latched_alarm_and_no_count() -> None:
    session = session_of(plain(), Rule(latch=True))
    perturbed.live(session, both(0) + both(1) + both(2, a=0.9))
    session.failed()
    assert session.alarm
    (row,) = perturbed.live(session, both(3))
    assert (row["status"], row["alarm"], session.sampler.counters["samples"]) == (Status.FIRST, True, 4)


def test_a_swapped_model_takes_values_that_did_not_count_for_the_one_before() -> None:
    """A control that is sent once does not come again when its limits are mended."""
    mended = plain()
    limits = [replace(s, valid=(0.5, 1.0)) if s.name == "p" else s for s in mended.signals.controls]
    wrong = mended.replace(signals=replace(mended.signals, controls=tuple(limits)))
    session = session_of(wrong, Rule())
    rows = perturbed.live(session, both(0) + both(1))
    assert rows[-1]["status"] is Status.MISSING
    after = session_of(mended, Rule())
    after.go_on_from(session)
    rows = perturbed.live(after, [m for k in (2, 3) for m in both(k) if m.topic == STATE])
    assert [row["status"] for row in rows] == [Status.FIRST, Status.OK]


def test_a_rule_over_a_horizon_stays_quiet_in_a_segment_without_a_verdict() -> None:
    model = plain().replace(alarm=[AlarmRule(1, 1, horizon=3)])
    t = EPOCH_NS + STEP_NS * np.array([0, 1, 2, 3, 4, 0, 1, 2, 3, 4])  # the first pass has no controls
    x = np.tile([0.3, -0.2], (10, 1))
    x[8:, 0] = 0.9
    u = np.where(np.arange(10)[:, None] < 5, np.nan, [[0.1, 0.0]])
    verdicts = EnvelopeMonitor(model).check(Transient(t, x, u, signals=model.signals, max_gap=0.025))
    assert verdicts.alarm.tolist() == [False] * 8 + [True] * 2


@pytest.mark.parametrize("off", [2, -2])
@pytest.mark.parametrize("every", [13, 90])
def test_single_stamps_far_off_neither_clear_an_alarm_nor_restart_the_grace(every, off, tmp_path):
    """A fault that lasts, with one stamp 2 s ahead or behind now and then: the alarm stays on, and is told as one."""
    model, rule, messages = plain(), Rule(grace=0.5, violations=2, window=5), list[Message]()
    for k in range(400):
        t = EPOCH_NS + k * STEP_NS
        stamp = t + off * 10**9 if k % every == every - 1 else t
        messages.append(Message(CONTROL, t - 1000, vector(t, 0.0, 0.0, 0.0)))
        messages.append(Message(STATE, t, joint_state(stamp, [0.3 + 0.4 * (-1) ** k, -0.2])))
    session = session_of(model, rule)
    ours = perturbed.live(session, messages[:120])
    for one in messages[120:]:
        ours += perturbed.live(session, [one])
        assert session.report(0.0, 1.0)[0].level == ERROR and session.reason(0.0, 1.0).startswith("alarm: ")
    theirs = perturbed.offline(model, rule, messages, tmp_path / "run.mcap")
    assert not perturbed.difference(ours, theirs)
    alarm = [row["alarm"] for row in ours]
    assert not any(alarm[:50]) and all(alarm[60:]), sum(alarm)
    assert sum(row["status"] is Status.RESET for row in ours) == 400 // every


def test_a_loop_starts_alarm_and_grace_over_from_its_first_sample(tmp_path: Path) -> None:
    """Known at the second: until then the step back may be one stamp that lay behind."""
    model, rule = plain(), Rule(grace=0.5, violations=1, window=1)
    once = [m for k in range(80) for m in both(k, 0.3 + 0.4 * (-1) ** k)]
    messages = [replace(m, log_time=m.log_time + 10**9 * i) for i in range(2) for m in once]
    ours = perturbed.live(session_of(model, rule), messages)
    assert not perturbed.difference(ours, perturbed.offline(model, rule, messages, tmp_path / "run.mcap"))
    alarm = [row["alarm"] for row in ours]
    assert alarm == [False] * 50 + [True] * 31 + [False] * 49 + [True] * 30
