# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Messages that the middleware delivers late, at the start or after a stall, cost no verdict; without rclpy."""

from collections.abc import Callable
from typing import Any

import numpy as np
import perturbed
import pytest
from bag_writer import Message as Message_
from bag_writer import Topic, write
from engine_bag import SIGNALS, engine_bag
from perturbed import Arriving as Message
from perturbed import held_up, run, session_of

from uncertain_lti import EnvelopeMonitor, UncertainLTI, read_transients
from uncertain_lti.identification import fit
from uncertain_lti.monitor.catch_up import MOST, STALL, WINDOW, CatchUp, arrival_of
from uncertain_lti.monitor.session import Rule
from uncertain_lti.plants.leibov import CONTROL_TOPIC, STATE_TOPIC
from uncertain_lti.recordings.bag import Bag
from uncertain_lti.sampling.reading import read_as_fitted

STEP = 0.025  # s, of the engine's recordings
STOPPED = 4.0  # s


@pytest.fixture(scope="module")
def engine(tmp_path_factory: pytest.TempPathFactory) -> tuple[UncertainLTI, Bag]:
    """A model of the engine and a recording of 600 samples at 40 Hz, states and controls with equal stamps."""
    folder = tmp_path_factory.mktemp("engine")
    (folder / "signals.yaml").write_text(SIGNALS)
    path = engine_bag(folder / "run.mcap", 600)
    return fit(read_transients([path], folder / "signals.yaml")), Bag(path)


def sent(bag: Bag) -> list[Message]:
    messages = list(bag.raw_messages([STATE_TOPIC, CONTROL_TOPIC]))
    began = messages[0].log_time_ns
    return [((m.log_time_ns - began) * 1e-9, m.topic, m.log_time_ns, m.data, m.log_time_ns) for m in messages]


def stopped(messages: list[Message], begin: float, chunk: int, first: str) -> list[Message]:
    return perturbed.stopped(messages, begin, chunk, first, STOPPED)


def in_parts(messages: list[Message]) -> list[Message]:
    """A stop, then what came meanwhile in three parts 0.12 s apart: at the beginning of the third topics are level."""
    end = 5.01 + STOPPED
    late = [m for m in stopped(messages, 5.01, 1, STATE_TOPIC) if end <= m[0] < end + 0.02]  # a state, its control, ...
    parts = [late[:120], late[120:160], late[160:162], late[162:]]
    come = []
    for part, at in zip(parts, (0.0, 0.12, 0.24, 0.2401), strict=True):
        for k, (before, topic, log_time, data, sent_ns) in enumerate(sorted(part, key=lambda m: m[1] != STATE_TOPIC)):
            now = end + at + 1e-5 * k
            come.append((now, topic, log_time + round((now - before) * 1e9), data, sent_ns))
    rest = [m for m in messages if not 5.01 <= m[0] < end + 0.02]
    rest = [(at if at < end else max(at, come[-1][0]), *message) for at, *message in rest]
    return sorted([*come, *rest], key=lambda m: m[0])


def two_at_once(messages: list[Message]) -> list[Message]:
    """The first two states come 0.4 steps apart, then their controls at once: none is far behind the clock topic."""
    came = messages[3][0]
    early = sorted(messages[:4], key=lambda m: m[1] != STATE_TOPIC)
    return [(came + 1e-5 * k + 0.4 * STEP * (k > 0), *message) for k, (_, *message) in enumerate(early)] + messages[4:]


DELAYS: dict[str, Callable[[list[Message]], list[Message]]] = {  # of others `perturbed.held_up_on_the_way` has any
    "two samples come at once, their states less so": two_at_once,
    "stopped, then in parts": in_parts,
    "stopped, and a pause amid the controls": lambda m: held_up(
        stopped(m, 5.01, 16, STATE_TOPIC), CONTROL_TOPIC, 9.0145, 10.4
    ),
    "stopped, and controls 3 s later": lambda m: held_up(stopped(m, 5.01, 16, STATE_TOPIC), CONTROL_TOPIC, 5.01, 12.0),
}


@pytest.mark.parametrize("delay", DELAYS.values(), ids=DELAYS.keys())
def test_every_verdict_is_that_of_the_offline_check(engine: tuple[UncertainLTI, Bag], delay: Any) -> None:
    model, bag = engine
    session = session_of(model, Rule())
    live = run(session, delay(sent(bag)))
    check = EnvelopeMonitor(model).check(read_as_fitted(bag, model.signals))
    assert session.late == 0 and session.sampler.counters["missing"] == 0
    assert len(live) == len(check.lower) == 600
    for name in ("lower", "upper", "utilisation"):
        assert np.array([v.numbers(name) for v in live]).tobytes() == getattr(check, name).tobytes()


def lagging(messages: list[Message], lag: float) -> list[Message]:
    """Stamps of the controls are so many s older than those of the states that come with them."""
    late = {CONTROL_TOPIC: lag, STATE_TOPIC: 0.0}
    shifted = [
        (at + late[t], t, log + round(late[t] * 1e9), data, sent + round(late[t] * 1e9))
        for at, t, log, data, sent in messages
    ]
    return sorted(shifted, key=lambda m: m[0])


def test_without_it_the_verdicts_are_lost(engine: tuple[UncertainLTI, Bag]) -> None:
    model, bag = engine
    session = session_of(model, Rule(), catch_up=0.0)
    assert len(run(session, held_up(sent(bag), CONTROL_TOPIC, 0.0, 0.6))) == 600
    assert session.late == 23 and session.sampler.counters["missing"] == 23


def test_what_was_put_in_order_is_counted_and_told(engine: tuple[UncertainLTI, Bag]) -> None:
    model, bag = engine
    on_time, session = session_of(model, Rule()), session_of(model, Rule())
    run(on_time, sent(bag))
    assert on_time.reordered == 0 and on_time.caught_up == ""
    run(session, held_up(sent(bag), CONTROL_TOPIC, 0.0, 0.6))
    assert session.counts(0.0)["put in order"] == str(session.reordered) != "0"
    assert "up to 0.599 s late" in session.caught_up and f"{session.reordered} messages" in session.caught_up


def test_the_reason_while_messages_wait(engine: tuple[UncertainLTI, Bag]) -> None:
    """It said that no sample could be judged, of which none had been taken."""
    session, late = session_of(engine[0], Rule()), 2.0
    for _, topic, log_time, data, sent_ns in sent(engine[1])[:40]:
        session.accept(topic, log_time, data, late, sent_ns, late)
    assert session.reason(late, 1.0) == "no verdict for more than 1 s: messages wait to be put in order"


def test_the_numbers_of_the_rule_are_not_called_as_the_counts_are(engine: tuple[UncertainLTI, Bag]) -> None:
    """`violations` of a state in /diagnostics is a count, beside which `violations: 1` of the monitor read as one."""
    counts = session_of(engine[0], Rule(violations=2, window=5)).counts(0.0)
    assert (counts["rule violations"], counts["rule window"]) == ("2", "5") and "violations" not in counts


def test_without_a_stall_nothing_waits(engine: tuple[UncertainLTI, Bag]) -> None:
    model, bag = engine
    session = session_of(model, Rule())
    messages = sent(bag)
    run(session, messages[:100], until=messages[100][0])
    for at, topic, log_time, data, sent_ns in messages[100:]:
        assert session.accept(topic, log_time, data, at, sent_ns) == ((topic, log_time, data),)


def test_a_control_that_is_late_at_its_usual_pace_stays_late(engine: tuple[UncertainLTI, Bag]) -> None:
    """As in a recording: only what comes in bursts is put in order."""
    model, bag = engine
    late = round(1.5 * STEP * 1e9)
    shifted = [
        (at + 1.5 * STEP, t, log + late, d, was + late) if t == CONTROL_TOPIC else (at, t, log, d, was)
        for at, t, log, d, was in sent(bag)
    ]
    session = session_of(model, Rule())
    run(session, sorted(shifted, key=lambda m: m[0]))
    assert session.late > 500 and session.reordered == 0


def test_a_topic_that_does_not_come_back_holds_up_nothing_for_long(engine: tuple[UncertainLTI, Bag]) -> None:
    model, bag = engine
    messages = [m for m in stopped(sent(bag), 5.01, 16, STATE_TOPIC) if m[1] == STATE_TOPIC or m[0] < 5.0]
    session = session_of(model, Rule())
    taken = [(0.0, 0.0)]
    for at, topic, log_time, data, sent_ns in messages:
        for message in session.accept(topic, log_time, data, at, sent_ns, (log_time - sent_ns) * 1e-9):
            taken.append((at, session.take(*message, at)[0] and 1.0 or 0.0))
    waits = max(b[0] - a[0] for a, b in zip(taken, taken[1:], strict=False))
    assert STOPPED < waits <= STOPPED + WINDOW + 2 * STEP
    assert len(taken) == len(messages) + 1


def test_controls_that_are_sent_no_more_hold_up_nothing(engine: tuple[UncertainLTI, Bag]) -> None:
    model, bag = engine
    messages = [m for m in sent(bag) if m[1] == STATE_TOPIC or m[0] < 0.1]
    session = session_of(model, Rule())
    waits = [at for at, *message, sent_ns in messages if not session.accept(*message, at, sent_ns)]
    assert len(messages) == 604 and max(waits) < 0.1 + STALL + 2 * STEP


def test_a_recording_that_was_paused_goes_on_soon(engine: tuple[UncertainLTI, Bag]) -> None:
    """Its stamps lag as those of messages that were held back; but they go on to."""
    model, bag = engine
    resumed = [(at + 3.0 if at > 5.01 else at, *message) for at, *message in sent(bag)]
    session = session_of(model, Rule())
    run(session, [m for m in resumed if m[0] < 5.01], until=5.01)
    waits = [at for at, *message, sent_ns in resumed if at > 5.01 and not session.accept(*message, at, sent_ns)]
    assert len(waits) > 10 and max(waits) < 8.01 + STALL + 2 * STEP


# --- CatchUp alone ------------------------------------------------------------------------------------------


def put(catch_up: CatchUp, topic: str, number: int, sent: float, now: float) -> None:
    catch_up.put((topic, number, b""), 10**18 + round(sent * 1e9), now - sent, now)


def waiting() -> CatchUp:
    return CatchUp(["x", "u"], WINDOW, True)


def test_as_long_as_a_topic_was_never_heard_each_message_waits_the_full_time() -> None:
    catch_up = waiting()
    for k in range(10):
        put(catch_up, "x", k, 0.01 * k, 0.01 * k)
    assert catch_up.ready(WINDOW - 0.001) == []
    assert [arrival for _, arrival, _ in catch_up.ready(WINDOW + 0.035)] == [0, 1, 2, 3]
    assert not catch_up.over


def test_memory_is_bounded() -> None:
    catch_up = waiting()
    for k in range(MOST + 1):
        assert not catch_up.over
        put(catch_up, "x", k, 1e-6 * k, 0.0)
    assert len(catch_up.ready(0.0)) == MOST + 1 and catch_up.over


def test_a_topic_that_is_sent_once_is_not_waited_for_again() -> None:
    """A latched message, published ten minutes before."""
    catch_up = waiting()
    put(catch_up, "u", 0, -600.0, 0.0)
    for k in range(100):
        put(catch_up, "x", k, 0.01 * k, 0.01 * k)
        if released := catch_up.ready(0.01 * k):
            break
    assert catch_up.over and released[0] == ("u", 0, b"")
    assert STALL <= 0.01 * k <= STALL + 0.011


def test_arrivals_never_go_back() -> None:
    """What is written to a snapshot in this order is read in this order."""
    catch_up = waiting()
    for begin, topic in ((1000, "x"), (2000, "u")):
        for k in range(20):
            put(catch_up, topic, begin + k, 0.01 * k - (topic == "u") * 1e-3, 0.2 + begin * 1e-6)
    released = catch_up.finish(1.0)
    assert [topic for topic, _, _ in released] == ["u", "x"] * 20
    arrivals = [arrival for _, arrival, _ in released]
    assert arrivals == sorted(arrivals)


@pytest.mark.parametrize("ahead", [-3600.0, 0.3])
def test_another_clock_of_a_publisher_changes_no_order(ahead: float) -> None:
    catch_up, order = waiting(), []
    for k in range(60):
        for topic, at in (("x", 0.01 * k), ("u", 0.01 * k + 0.003)):
            put(catch_up, topic, len(order), at + ahead * (topic == "u"), at)
            order.append(topic)
        if released := catch_up.ready(0.01 * k + 0.003):
            break
    assert catch_up.over and catch_up.reordered == 0 and len(released) == len(order)
    assert [topic for topic, _, _ in released] == order


def test_messages_of_one_topic_stay_as_they_came_where_its_clock_steps_back() -> None:
    catch_up = waiting()
    for k, sent_at in enumerate((0.3, 0.1, 0.2)):
        put(catch_up, "x", k, sent_at, 0.3 + 1e-3 * k)
    assert [k for _, k, _ in catch_up.finish(1.0)] == [0, 1, 2] and catch_up.reordered == 0


def test_messages_of_which_nobody_knows_when_they_were_sent_stay_as_they_came() -> None:
    catch_up = waiting()
    for k in range(40):
        catch_up.put(("xu"[k % 3 == 0], k, b""), 0, 0.0, 1e-3 * k)
    assert [k for _, k, _ in catch_up.finish(1.0)] == list(range(40))


def test_in_a_burst_controls_that_were_late_themselves_stay_late() -> None:
    """The node stands still, and takes what came meanwhile in order: a control that was sent late is late offline."""
    catch_up, order = waiting(), []
    sent_at = sorted(
        [("x", 0.01 * k) for k in range(60)] + [("u", 0.01 * k + (0.04 if k % 7 == 3 else -1e-4)) for k in range(60)],
        key=lambda m: m[1],
    )
    for i, (topic, at) in enumerate(sent_at):
        put(catch_up, topic, i, at, max(at, 0.35 + 1e-5 * i))
        order.append(i)
    assert [k for _, k, _ in catch_up.finish(1.0)] == order and catch_up.reordered == 0


def test_a_lag_of_more_than_a_step_is_said_live_and_when_a_recording_is_read(engine, tmp_path):
    model, bag = engine
    kinds = {topic: bag.topics[topic].type for topic in (STATE_TOPIC, CONTROL_TOPIC)}
    for steps, said in ((0.9, 0), (2.4, 1), (-2.4, 1)):
        live, session = lagging(sent(bag), steps * STEP), session_of(model, Rule())
        run(session, live)
        assert session.lags == ({CONTROL_TOPIC: pytest.approx(steps * STEP, abs=0.1 * STEP)} if said else {})
        came = [Message_(topic, log, data) for _, topic, log, data, _ in live]
        path = write([Topic(name, kind) for name, kind in kinds.items()], came).save(tmp_path / f"{steps}.mcap")
        notes = read_as_fitted(Bag(path), model.signals).notes
        begin = f"stamps on {CONTROL_TOPIC} {'lag' if steps > 0 else 'lead'} those"
        assert len([note for note in notes if begin in note and "2.4 steps" in note]) == said


@pytest.mark.parametrize("rate", [0.2, 5.0])
@pytest.mark.parametrize("lag", [0.0, 2.4, -2.4])
def test_a_lag_is_that_of_the_stamps_where_a_recording_is_played_at_another_speed(engine, rate: float, lag: float):
    model, bag = engine
    seldom = [m for i, m in enumerate(sent(bag)) if m[1] == STATE_TOPIC or i % 34 < 2]
    played = [(at / rate, *rest) for at, *rest in lagging(seldom, lag * STEP)]
    session = session_of(model, Rule())
    run(session, played, until=played[-1][0])
    assert session.lags == ({CONTROL_TOPIC: pytest.approx(lag * STEP, rel=0.2)} if lag else {})


def test_a_topic_that_has_fallen_silent_has_no_lag(engine):
    """Its last message came an hour ago, and the clock topic's arrivals jitter."""
    model, bag = engine
    rng, hour, come = np.random.default_rng(0), 3600, []
    for i, (at, topic, log, data, sent_ns) in enumerate(sent(bag)):
        if i < 40:
            stamp = int.from_bytes(data[4:8], "little") - hour
            before = data[:4] + stamp.to_bytes(4, "little") + data[8:]
            come.append((at - hour, topic, log - hour * 10**9, before, sent_ns - hour * 10**9))
        elif topic == STATE_TOPIC:
            come.append((at + rng.uniform(0.0, 0.4 * STEP), topic, log, data, sent_ns))
    session = session_of(model, Rule())
    run(session, come)
    assert session.lags == {}


@pytest.mark.parametrize(
    ("received", "taken", "before", "arrived", "case"),
    [
        (7, 10, 5, 7, "as received, however much later it is taken"),
        (4, 10, 5, 5, "in the order in which the middleware gives messages"),
        (0, 10, 5, 10, "nobody says when it was received"),
        (12, 10, 5, 10, "in the future: by another clock"),
        (4, 10, 20, 4, "the clock of the system was set back"),
    ],
)
def test_a_message_arrives_when_the_middleware_receives_it(received, taken, before, arrived, case):
    assert arrival_of(received, taken, before) == arrived, case
