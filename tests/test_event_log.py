# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The node's log: what changes is said once, with its cause; what keeps changing does not flood it."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from perturbed import session_of

from uncertain_lti import UncertainLTI
from uncertain_lti.model.alarm_rule import AlarmRule, StatisticRule
from uncertain_lti.model.domain import Sampling
from uncertain_lti.model.schedule import Axis, Schedule
from uncertain_lti.model.terms import ARRAYS
from uncertain_lti.signals.signal import Signal
from uncertain_lti.signals.signal_map import SignalMap

pytest.importorskip("rclpy", reason="rclpy is not installed")

from test_live import CONTROL, EPOCH_NS, STATE, STEP_NS, by_hand, float64, joint_state, vector

from uncertain_lti.monitor.intake import Intake, Sender
from uncertain_lti.monitor.outputs import FALSE, REASON, TRUE, VIOLATION, VerdictMessages, names_of, text_message
from uncertain_lti.monitor.session import OK, STALE, WARN, EventLog, Rule

TIMEOUT = 1.0
STEP = STEP_NS * 1e-9


class Rig:
    """A session fed by hand, and its event log; time goes on by one step with every sample."""

    def __init__(self, alarm: Sequence[AlarmRule | StatisticRule] = (AlarmRule(2, 5),), **rule: Any) -> None:
        model = self.model = by_hand(alarm=alarm)
        self.said: list[tuple[int, str]] = []
        self.now, self.t_ns = 100.0, EPOCH_NS
        self.x, self.u = np.zeros(model.n), np.full(model.m, 0.2)
        self.publishers = {STATE: 1, CONTROL: 1}
        self.problems: list[str] = []

        self.event_log = EventLog(lambda level, line: self.said.append((level, line)))
        self.watch(model, Rule(**rule))

    def watch(self, model: UncertainLTI, rule: Rule) -> None:
        self.session = session_of(model, rule, self.now, catch_up=0.0)
        self.event_log.begin(self.session, self.now)

    def take(self, topic: str, data: bytes) -> None:
        before = self.session.alarm
        ((_, arrival_ns, _),) = self.session.accept(topic, time.time_ns(), data, self.now)
        verdicts, _ = self.session.take(topic, arrival_ns, data, self.now)
        if self.session.alarm != before:
            self.event_log.turned(self.session, verdicts, self.now)

    def send(self, samples: int, off: float = 0, control: bool = True, state: bool = True, frozen: Any = None) -> None:
        point = self.model.operating_point
        held = point.recorded_x(self.x)
        for _ in range(samples):
            if control:
                self.take(CONTROL, vector(self.t_ns, *(point.u_s + point.U * self.u)))
            read = point.recorded_x(self.x)
            if frozen is not None:
                read[frozen] = held[frozen]
            if state:
                self.take(STATE, joint_state(self.t_ns, read))
            centre, half = self.model.centre_and_half(self.x, self.u, STEP)
            self.x = centre + off * half
            self.wait(STEP)

    def wait(self, seconds: float) -> None:
        """Time passes, and the event log is updated as often as by the node."""
        for _ in range(max(1, round(seconds / 0.1))):
            self.now += min(seconds, 0.1)
            self.t_ns += round(min(seconds, 0.1) * 1e9)
            self.event_log.look(self.session, self.now, TIMEOUT, self.publishers, self.problems)

    @classmethod
    def at_work(cls, **rule: Any) -> Rig:
        """One that has judged some samples and said so."""
        rig = cls(**rule)
        rig.send(10)
        rig.said.clear()
        return rig

    @property
    def lines(self) -> list[str]:
        """What was said since this was last asked for."""
        said, self.said = self.said, []
        return [line for _, line in said]


def test_the_first_verdict_is_told_and_nothing_after_it() -> None:
    rig = Rig(masked="b")
    rig.send(1000)
    assert rig.lines == ["judging a, b; alarm when at least 2 of 5 verdicts violated; masked: b"]


def test_a_message_of_the_clock_that_is_dropped_opens_no_sample() -> None:
    """So nothing is predicted from it a second time."""
    rig = Rig.at_work()
    for after, opens in ((0, True), (0, False), (STEP_NS, True)):
        data = joint_state(rig.t_ns + after, rig.x)
        assert rig.session.take(STATE, rig.t_ns + after, data, rig.now)[1] == opens


def test_a_stamp_more_than_a_second_ahead_of_its_arrival_is_of_the_future() -> None:
    rig = Rig()
    for ahead, count in ((10**9, 0), (10**9 + 1, 1)):
        rig.session.take(STATE, EPOCH_NS, joint_state(EPOCH_NS + ahead, rig.x), rig.now)
        assert rig.session.future[STATE] == count


class Listener:
    """Hears one topic."""

    listeners = 1

    def __init__(self) -> None:
        self.heard: list[bytes] = []
        self.send = self.heard.append


class NoSnapshots:
    recent = None

    def alarm_over(self, now: float) -> None:
        pass


class Publishing(Rig):
    def __init__(self) -> None:
        super().__init__([AlarmRule(1, 1)])
        self.sender, messages = Sender(self.now), VerdictMessages(names_of(("a", "b")))
        self.failures: list[Exception] = []
        failed = lambda _, error: self.failures.append(error)  # noqa: E731
        self.intake = Intake(self.sender, NoSnapshots(), self.event_log.turned, failed)
        self.intake.session, self.intake.active, self.intake.clock = self.session, True, lambda: self.t_ns
        self.listeners = {name: Listener() for name in (VIOLATION.name, REASON.name, *messages.outputs)}
        self.sender.open(self.listeners)
        self.sender.prepare(messages)

    def take(self, topic: str, data: bytes) -> None:
        self.intake.message(topic, data)
        self.at_once = [*self.said]


def test_who_listens_hears_each_sample_once_and_the_alarm_with_each_verdict() -> None:
    rig = Publishing()
    rig.send(3)
    rig.said.clear()
    rig.x = rig.x + [9.0, 0.0]
    rig.send(1)
    assert not rig.failures and [level for level, line in rig.at_once if line.startswith("alarm, at")] == [WARN]
    heard = {name: listener.heard for name, listener in rig.listeners.items()}
    assert {len(heard[name]) for name in ("lower", "upper", "state", "utilisation")} == {3}
    assert {len(heard[name]) for name in ("flags", "predicted_lower", "predicted_upper")} == {4}
    assert heard[VIOLATION.name] == [FALSE, FALSE, TRUE]
    assert rig.session.violations == [1, 0]
    assert heard[REASON.name][-1] == text_message(rig.session.reasons.text) and "a" in rig.session.reasons.text


def test_more_than_two_tenths_of_a_millisecond_for_a_message_are_slow_and_of_flags_three() -> None:
    rig = Publishing()

    def slow(_: bytes) -> None:
        end = time.thread_time() + 2.1e-4
        while time.thread_time() < end:
            pass

    rig.listeners["flags"].send = rig.listeners["state"].send = slow
    rig.send(200)
    assert rig.sender.slow_topics() == ["state"] and rig.sender.held_back > 0


def test_verdicts_are_two_of_the_longest_fitted_steps_apart_at_most() -> None:
    rig = Rig()
    assert rig.session.between_verdicts == pytest.approx(2 * STEP)  # the model knows its median step alone
    rig.session.model = rig.model.replace(sampling=Sampling(STEP, dt_max=0.7))
    assert rig.session.between_verdicts == pytest.approx(1.4)


def test_a_state_that_drifts_from_day_to_day_is_told_once_a_day() -> None:
    """Of days without an alarm, in the log and in diagnostics; an alarm is no drift."""
    rig = Rig()
    for day in range(8):
        rig.send(20, off=0.3 * 1.1**day)
        assert max(rig.session.period.largest) == pytest.approx(0.3 * 1.1**day, rel=1e-6)
        report = rig.session.report(rig.now, TIMEOUT)[0]
        for off in (3.0, 0.0):
            rig.send(10, off)
            rig.session.report(rig.now, TIMEOUT)
        rig.t_ns += 86_400 * 10**9
    words = [line for line in rig.lines if line.startswith("the largest utilisation of ")]
    assert len(words) == 4 and words[0].startswith("the largest utilisation of a rises by 10 % a day over 6 days; ")
    assert words[-1] in report.message and "over 7 days" in words[-1]


def test_an_alarm_is_a_warning_that_names_the_states_and_by_how_much_and_its_end_is_none() -> None:
    rig = Rig.at_work()
    rig.send(3, off=2.0)
    (level, line) = rig.said[-1]
    verdict = rig.session.last
    assert level == WARN and verdict is not None
    found = re.findall(r"(\w) = (\S+) is (\S+) above its bounds (\S+) to ([\d.]+)", line)
    assert [name for name, *_ in found] == ["a", "b"] and line.startswith("alarm, at least 2 of 5 verdicts violated: ")
    for i, (_, *numbers) in enumerate(found):
        value, by, lower, upper = map(float, numbers)
        said = [verdict.numbers(n)[i] for n in ("state", "lower", "upper")]
        np.testing.assert_allclose([value, lower, upper], said, rtol=1e-5)
        assert by == pytest.approx(said[0] - said[2], rel=1e-2)
    rig.said.clear()
    rig.send(10)
    ((level, line),) = rig.said
    assert level == OK and re.fullmatch(r"the alarm is over after 0\.0\d+ s", line)


def test_an_alarm_says_that_messages_came_too_late_just_before() -> None:
    rig = Rig.at_work()
    rig.session.report(rig.now, TIMEOUT)
    rig.take(CONTROL, vector(rig.t_ns - 3 * STEP_NS, 0.1, 0.1))
    rig.send(3, off=2.0)
    assert rig.lines[-1].endswith("; 1 message came too late just before")
    rig.send(9)
    rig.session.report(rig.now, TIMEOUT)
    rig.lines.clear()
    rig.send(3, off=2.0)
    assert "too late" not in rig.lines[-1]


def test_a_jump_larger_than_any_of_the_fit_is_logged_and_reported_with_its_limit() -> None:
    rig = Rig()
    rig.model = rig.model.replace(domain=replace(rig.model.domain, step_max=np.array([0.01, 1e3])))
    rig.watch(rig.model, Rule(violations=1, window=1))
    rig.send(10)
    rig.said.clear()
    rig.x[:] += 5.0
    rig.send(1)
    limit = 0.01 * rig.model.operating_point.X[0]
    (line,) = [line for line in rig.lines if line.startswith("alarm")]
    jump = 5.0 * rig.model.operating_point.X[0]
    assert f"; a jumped by {jump:.3g} in one step (at most {limit:.3g} in the fit)" in line
    assert "b jumped" not in line
    assert "a jumped by " in rig.session.report(rig.now, TIMEOUT)[0].message
    assert "; a jumped by " in rig.session.reasons.text


@pytest.mark.parametrize(("left_out", "far", "level"), [((), 8, WARN), ((0.1, 0.4), 8, OK), ((0.9,), 20, WARN)])
def test_being_outside_the_domain_is_a_warning_where_more_is_than_was_left_out(
    left_out: tuple[float, ...], far: int, level: int
) -> None:
    rig = Rig.at_work()
    domain = replace(rig.model.domain, u_min=np.full(rig.model.m, -1.0), u_max=np.full(rig.model.m, 1.0))
    parts = [{"verdicts": 100, "outside_domain": 100 * share} for share in left_out]
    rig.model = rig.model.replace(domain=domain, validation={"part": parts} if parts else None)
    rig.watch(rig.model, Rule())
    rig.send(10)
    assert rig.session.report(rig.now, TIMEOUT)[0].level == OK
    rig.send(13)
    rig.u[:] = 5.0
    rig.send(far)
    report = rig.session.report(rig.now, TIMEOUT)[0]
    assert report.level == level and "outside the fitted domain in " in report.message


def test_diagnostics_say_how_near_each_statistic_is_to_its_threshold() -> None:
    rig = Rig(alarm=(AlarmRule(2, 5), StatisticRule("energy", 5 * STEP, (0.5, 4.0))))
    rig.send(10, off=0.5)
    values = rig.session.report(rig.now, TIMEOUT)[0].values
    assert values["energy state"] == "a" and float(values["energy threshold"]) == 0.5
    assert float(values["energy"]) == pytest.approx(0.25, rel=1e-6)


def test_an_alarm_by_a_statistic_says_which_state_and_by_how_much() -> None:
    """Every sample lies within its bounds; their mean does not."""
    rig = Rig([AlarmRule(2, 5), StatisticRule("mean", 5 * STEP, 0.4)])
    rig.send(10)
    assert rig.lines[0].endswith("alarm when at least 2 of 5 verdicts violated, or mean of the utilisation over "
                                 f"{5 * STEP:.3g} s above 0.4")  # fmt: skip
    rig.send(8, off=0.6)
    (line,) = rig.lines
    assert re.fullmatch(r"alarm, mean of a at 1\S* times its threshold, mean of b at 1\S* times its threshold", line)
    assert rig.session.last is not None and not rig.session.last.violated and rig.session.last.alarm
    message = rig.session.report(rig.now, TIMEOUT)[0].message
    assert message.startswith(f"alarm: mean of the utilisation over {5 * STEP:.3g} s above 0.4: a, b")
    assert "2 of 5" not in message, "a rule that raised nothing is not named"
    rig = Rig([AlarmRule(2, 5), StatisticRule("mean", 5 * STEP, 40.0)])
    rig.send(10)
    rig.lines.clear()
    rig.send(3, off=2.0)
    assert rig.lines[0].startswith("alarm, at least 2 of 5 verdicts violated: a = ")
    assert rig.session.report(rig.now, TIMEOUT)[0].message == "alarm: at least 2 of 5 verdicts violated: a, b"


def test_masked_states_are_not_named_and_a_latched_alarm_says_what_ends_it() -> None:
    rig = Rig.at_work(masked="b", latch=True)
    rig.send(30, off=-2.0)
    (line,) = rig.lines[-1:]
    assert " below its bounds " in line and "b = " not in line and line.endswith("it lasts until ~/reset")
    assert rig.session.report(rig.now, TIMEOUT)[0].message.startswith("alarm: at least 2 of 5 verdicts violated: a")
    rig.send(50)
    assert not rig.lines
    assert rig.session.report(rig.now, TIMEOUT)[0].message.startswith("alarm: latched until ~/reset")
    rig.session.reset()
    rig.wait(0.1)
    assert [line[:21] for line in rig.lines] == ["the alarm is over aft"]


def test_a_narrow_miss_is_told_with_the_digits_that_show_it() -> None:
    rig = Rig()
    rig.x = np.full(rig.model.n, 200.0)
    rig.send(10)
    rig.lines.clear()
    rig.send(3, off=1.0000001)
    (line,) = (line for line in rig.lines if line.startswith("alarm"))
    (_, value, by, _, upper) = re.findall(r"(\w) = (\S+) is (\S+) above its bounds (\S+) to ([\d.]+)", line)[0]
    assert 0 < float(by) < 1e-4 and float(value) - float(upper) == pytest.approx(float(by), rel=0.02)


def test_a_new_rule_keeps_what_is_known_and_a_standing_alarm_where_it_latches() -> None:
    rig = Rig(enable=f"{CONTROL} vector.x > -1e9")
    rig.send(10)
    session = rig.session
    assert session.arming.on
    session.follow(replace(session.rule, enable=f"{CONTROL} vector.x < -1e9"))  # the same field: its value is known
    assert session.arming.on is False
    session.follow(replace(session.rule, enable=f"{CONTROL} vector.y > -1e9"))
    assert session.arming.on is None
    rig.wait(0.1)
    session.follow(replace(session.rule, enable=""))
    rig.wait(0.1)
    assert rig.lines[-1] == "alarms count from now on: there is no condition any more"
    rig.send(5, off=2.0)
    assert session.alarm
    session.follow(session.rule)  # the rule that there is
    assert session.alarm and not session.latched
    session.follow(replace(session.rule, latch=True))
    assert session.alarm and session.latched
    session.follow(replace(session.rule, masked="b", margin=9.0))
    assert session.alarm
    session.follow(replace(session.rule, latch=False))
    assert not session.alarm


def test_the_topic_of_the_enable_condition_is_one_to_listen_to_once_its_type_is_known() -> None:
    session, kind = Rig().session, "std_msgs/msg/Float64"
    session.follow(Rule(enable="/mode data == 3", enable_type=kind))
    assert session.types["/mode"] == kind
    session.follow(Rule(enable="/state data == 3"))
    assert not {"/mode", "/state"} & set(session.types)
    session.found_enable_type(kind)
    session.follow(Rule(enable="/state data == 4"))
    assert session.types["/state"] == kind


def test_a_report_names_the_mode_that_the_model_does_not_list() -> None:
    rig = Rig()
    p, q = (replace(control, steady=0.0, scale=1.0) for control in rig.model.signals.controls)
    both = {name: np.stack([getattr(rig.model, name)] * 2) for name in ARRAYS}
    signals, gears = replace(rig.model.signals, controls=(p, q)), Schedule((Axis("p", modes=(1.0, 2.0)),))
    rig.watch(rig.model.replace(**both, signals=signals, schedule=gears, block_data=None), Rule())
    for gear in (1.0, 4.0, 4.0):
        rig.take(CONTROL, vector(rig.t_ns, gear, 0.0))
        rig.take(STATE, joint_state(rig.t_ns, rig.x))
        rig.wait(STEP)
    said = rig.session.report(rig.now, TIMEOUT)[0].message
    assert "1 sample without a verdict: p = 4 is not among the modes of the model, 1, 2" in said


def test_an_enable_condition_without_a_number_is_told_from_one_that_is_silent() -> None:
    rig = Rig(enable=f"{STATE} effort[3] > 0")
    rig.wait(0.1)
    assert rig.lines[-1] == f"alarms are off: it is not known whether {STATE} effort[3] > 0"
    rig.send(3)
    assert rig.session.arming.why_off() == f"alarms are off: {STATE} comes without a number in effort[3]"


def test_an_alarm_that_stands_through_silence_is_told_in_the_reports() -> None:
    rig = Rig()
    rig.send(10)
    rig.send(5, off=2.0)
    rig.session.report(rig.now, TIMEOUT)
    rig.wait(5.0)
    monitor, *states = rig.session.report(rig.now, TIMEOUT)
    assert monitor.level == STALE and "alarm: it was on at the last verdict" in monitor.message
    assert f"no message on {STATE}" in monitor.message and all(one.level == STALE for one in states)
    rig.session.reset()
    assert "alarm" not in rig.session.report(rig.now, TIMEOUT)[0].message


def test_a_flapping_alarm_does_not_flood_the_log_and_each_is_named_or_counted() -> None:
    rig = Rig.at_work()
    began = rig.now
    for _ in range(100):
        rig.send(2, off=2.0)
        rig.send(8)
    alarms, minutes = rig.session.alarms, (rig.now - began) / 60
    rig.wait(11.0)
    lines = rig.lines
    starts = [line for line in lines if line.startswith("alarm,")]
    ends = [line for line in lines if line.startswith("the alarm is over after")]
    assert alarms > 80 and len(starts) <= 6 + 6 * minutes + 2 and len(ends) <= len(starts)
    assert len(starts) >= 7 and all(" above its bounds " in line for line in starts), "the later ones are named as well"
    assert re.search(r"; it is over \(\d+ alarms before it are not logged\)$", starts[-1])
    left_out = sum(int(n) for line in starts for n in re.findall(r"\((\d+) alarms? before it", line))
    assert len(starts) + left_out == alarms, "every alarm is named or counted"


@pytest.mark.parametrize("every", [1, 30])
def test_a_steady_control_that_ceases_is_told_while_its_publisher_stays(every: int) -> None:
    """One that comes every 0.3 s may be silent for 6 s."""
    rig = Rig()
    signals = rig.model.signals
    held = replace(signals, controls=tuple(replace(control, max_hold=None) for control in signals.controls))
    rig.watch(rig.model.replace(signals=held), rig.session.rule)
    for _ in range(25):
        rig.send(1)
        rig.send(every - 1, control=False)
    rig.lines.clear()
    rig.send(400, control=False)
    ceased = f"no message on {CONTROL} for 1 s, and at least every 0.01 s before; its last values count on"
    assert rig.lines == ([ceased] if every == 1 else [])
    monitor = rig.session.report(rig.now, TIMEOUT)[0]
    assert (f"no message on {CONTROL} for 4 s" in monitor.message) == (every == 1)
    assert monitor.level == (WARN if every == 1 else OK)
    rig.send(200 * every, control=False)
    rig.send(30)
    assert f"messages on {CONTROL} again" in rig.lines and not rig.session.ceased(rig.now, TIMEOUT)


def test_publishers_that_are_taken_for_one_are_in_the_reason_while_all_is_well() -> None:
    rig = Rig.at_work()
    assert rig.session.reason(rig.now, TIMEOUT) == "no alarm"
    rig.session.know_rivals([STATE])
    rig.send(1)
    said = f"{STATE}: several publishers send by turns, and are taken for one; stop all but one"
    assert said in rig.session.reason(rig.now, TIMEOUT)
    rig.session.know_rivals([])
    rig.send(1)
    assert rig.session.reason(rig.now, TIMEOUT) == "no alarm"


def test_of_a_topic_with_a_control_that_ends_no_line_says_that_its_last_values_count_on() -> None:
    rig = Rig()
    signals = rig.model.signals
    first, *others = signals.controls
    mixed = replace(signals, controls=(replace(first, max_hold=None), *others))
    rig.watch(rig.model.replace(signals=mixed), rig.session.rule)
    rig.send(25)
    rig.lines.clear()
    rig.send(400, control=False)
    silent, none = rig.lines
    assert silent == f"no message on {CONTROL} for 1.0 s"
    assert none.startswith("no verdict for 1.0 s") and f"{others[0].name} missing" in none


def test_the_reason_names_what_is_expected_and_what_was_heard_where_no_message_names_a_signal() -> None:
    rig = Rig()
    for _ in range(30):
        rig.take(STATE, joint_state(rig.t_ns, [1.0, 2.0], ("c", "d")))
        rig.wait(0.1)
    there = f"{STATE}: there is no 'a' in the message's names; names there: c, d"
    assert rig.session.reason(rig.now, TIMEOUT).startswith("no verdict for more than 1 s: nothing received on")
    rig.take(CONTROL, vector(rig.t_ns, 0.0, 0.0))
    assert rig.session.reason(rig.now, TIMEOUT) == (
        f"no verdict for more than 1 s: a, b missing, stale or not finite; {there}"
    )
    rig.send(20)
    rig.wait(2.0)
    silent = f"no verdict for more than 1 s: no message on {STATE}"
    assert rig.session.reason(rig.now, TIMEOUT) == silent
    rig.take(STATE, joint_state(rig.t_ns, [1.0, 2.0], ("c", "d")))
    assert rig.session.reason(rig.now, TIMEOUT) == f"{silent}; {there}"
    assert there in rig.session.report(rig.now, TIMEOUT)[0].message


def test_silence_of_each_input_and_its_return_are_told_once() -> None:
    rig = Rig()
    rig.wait(30.0)
    assert rig.lines == [f"no verdict yet: nothing received on {STATE}, {CONTROL}"]
    rig.send(200, state=False)
    assert rig.lines == [f"no verdict yet: nothing received on {STATE}"]
    assert rig.session.reason(rig.now, TIMEOUT) == f"no verdict for more than 1 s: nothing received on {STATE}"
    rig.send(20)
    assert rig.lines == ["judging a, b; alarm when at least 2 of 5 verdicts violated"]
    rig.wait(30.0)
    assert [re.sub(r"\d+\.\d", "#", line) for line in rig.lines] == [
        f"no message on {CONTROL} for # s",
        f"no verdict for # s: no message on {STATE}",
    ]
    rig.send(20)
    assert rig.lines == [f"messages on {CONTROL} again", "judging again, after 30.0 s without a verdict"]
    rig.send(400, control=False)
    values = rig.session.report(rig.now, TIMEOUT)[0].values
    assert float(values[f"age {CONTROL}"]) > 0.5 > float(values[f"age {STATE}"]) and int(values["stale p"]) > 20
    assert [re.sub(r"\d+\.\d", "#", line) for line in rig.lines] == [
        f"no message on {CONTROL} for # s",
        "no verdict for # s: p, q missing, stale or not finite",
    ]


def test_of_many_topics_no_line_names_them_all_nor_is_there_one_of_each() -> None:
    """Of 62 topics that fell silent at once there were 62 lines."""
    cells = tuple(Signal(f"x{i}", f"/cell{i}", "data", type="std_msgs/msg/Float64") for i in range(20))
    rig = Rig()
    rig.watch(by_hand(signals=SignalMap(cells, by_hand().signals.controls)), Rule())
    rig.publishers = {cell.topic: 1 for cell in cells} | rig.publishers
    rig.take(CONTROL, vector(rig.t_ns, 0.0, 0.0))
    for cell in cells[::-1]:
        rig.take(cell.topic, float64(0.0))
    rig.wait(5.0)
    lines = rig.lines
    assert len(lines) <= 5 and not any("x12" in line or "/cell13" in line for line in lines), lines
    assert any(line.startswith("no message on /cell1, ") and " and 8 more for " in line for line in lines), lines


def test_of_many_stalls_those_that_are_told_have_their_length() -> None:
    rig = Rig.at_work()
    for _ in range(8):
        rig.wait(2.0)
        rig.send(100)
    again = [line for line in rig.lines if line.startswith("judging again")]
    assert len(again) > 2 and all(1.9 < float(line.split()[3]) < 2.1 for line in again), again


def test_a_recording_that_is_played_again_is_told_once_at_each_pass_and_nothing_of_it_is_late() -> None:
    rig = Rig.at_work()
    for _ in range(2):
        rig.t_ns -= 10**10
        rig.send(50)
        assert rig.lines == [f"time steps back on {STATE}: a new segment begins"]
        report = rig.session.report(rig.now, TIMEOUT)[0]
        assert report.message == "1 sample without a verdict: time stepped back"
        assert report.values["late messages"] == report.values["dropped"] == "0"
    for rivals in ("several publishers", ""):
        rig.session.reasons.rivals = rivals
        rig.t_ns -= 10**10 * bool(rivals)
        rig.send(50)
        assert not rig.lines


NO_NAME = f"{STATE}: there is no '{{}}' in the message's names"


@pytest.mark.parametrize(
    ("what", "why"),
    [
        ("not a number", "a missing, stale or not finite"),
        ("a name gone", f"b missing, stale or not finite; {NO_NAME.format('b')}; names there: a, c"),
        ("another machine", f"no message on {STATE}"),  # it counts as if it had not come
        ("no message", f"{STATE}: a message "),
        ("far apart", "the step is longer than max_gap"),
        ("no stamp", f"messages on {STATE} are dropped (no stamp)"),
        ("the same stamp", f"messages on {STATE} are dropped (equal stamp)"),
    ],
)
def test_messages_that_come_and_give_no_verdict_are_told_with_the_cause(what: str, why: str) -> None:
    rig = Rig.at_work()
    fixed = rig.t_ns
    for _ in range(150):
        rig.send(1, state=False)
        x = rig.model.operating_point.recorded_x(rig.x)
        sent = {
            "not a number": joint_state(rig.t_ns, [np.nan, x[1]]),
            "a name gone": joint_state(rig.t_ns, x, ("a", "c")),
            "another machine": joint_state(rig.t_ns, x[:1], ("x",)),
            "no message": b"\x00\x01\x00\x00\x07",
            "no stamp": joint_state(0, x),
            "the same stamp": joint_state(fixed, x),
        }
        rig.take(STATE, sent.get(what, joint_state(rig.t_ns, x)))
        rig.t_ns += 10 * STEP_NS * (what == "far apart")
    (line,) = rig.lines
    assert re.match(r"no verdict for 1\.\d s: ", line) and why in line
    told, message = why.partition("; ")[2], rig.session.report(rig.now + 5.0, TIMEOUT)[0].message
    assert not told or message.count(told) == 1


@pytest.mark.parametrize(
    ("value", "said", "reported"),
    [
        (np.inf, "a missing, stale, not valid or not finite", "a signal is missing, stale or not finite (a)"),
        (1e308, *["a value is so large that its bounds are not finite"] * 2),
    ],
)
def test_infinite_values_are_named_and_those_that_no_bounds_hold_are_told(value: float, said: str, reported: str):
    rig = Rig.at_work()
    for _ in range(5):
        rig.send(1, state=False)
        rig.take(STATE, joint_state(rig.t_ns, [value, 0.3]))
        rig.t_ns += STEP_NS
    assert rig.session.reasons.text.endswith(f"no verdict: {said}")
    assert f"samples without a verdict: {reported}" in rig.session.report(rig.now, TIMEOUT)[0].message


def test_equal_times_of_receipt_tell_that_the_simulated_clock_is_coarse() -> None:
    rig = Rig()
    rig.watch(by_hand("log"), Rule())
    for k in range(150):
        for topic in ("/voltage", "/power"):
            rig.session.take(topic, EPOCH_NS + 10 * STEP_NS * (k // 10), float64(0.3), rig.now)
        rig.wait(STEP)
    (line,) = rig.lines
    told = "): /clock moves more seldom than they come; play with --clock, or by ros2 bag with --clock-topics-all"
    assert line.endswith(f"(equal stamp{told}")
    assert f"(equal stamp 135{told}" in rig.session.report(rig.now, TIMEOUT)[0].message


def test_problems_and_the_enable_condition_are_told_when_they_change() -> None:
    rig = Rig(enable=f"{CONTROL} vector.x > 0.2")
    rig.u[:] = 0.9
    rig.problems = ["/x: a publisher cannot be heard"]
    rig.wait(0.1)
    assert rig.lines == [rig.problems[0], f"alarms are off: it is not known whether {CONTROL} vector.x > 0.2"]
    rig.send(50)
    assert f"alarms count from now on: {CONTROL} vector.x > 0.2" in rig.lines
    rig.u[:] = -0.9
    rig.problems = []
    rig.send(50)
    assert rig.lines == [f"alarms are off until {CONTROL} vector.x > 0.2"]
    rig.problems = ["/x: a publisher cannot be heard"]
    rig.send(5)
    assert rig.lines == rig.problems
