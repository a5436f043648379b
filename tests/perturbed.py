# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Models with everything armed and streams with every disorder, by seed; what a live session and a check make of them.

A model may have a schedule of knots and modes, horizons, statistics, repeats, memories, limits of values, a state on a
topic of its own, a constant step. A stream drops, delays, repeats and damages messages, freezes states, pauses, jumps
and loops. `live` takes its messages as the node does; `offline` writes them to a file and checks that as `check` does.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from bag_writer import JAZZY, Layout, Message, Topic, float64, joint_state, vector, write

from uncertain_lti import EnvelopeMonitor, SignalMap, UncertainLTI
from uncertain_lti.base.arrays import LARGEST
from uncertain_lti.cli.judge import check_recording
from uncertain_lti.model.alarm_rule import JOINT, KINDS, AlarmRule, StatisticRule
from uncertain_lti.model.domain import Domain, Occupancy, Sampling
from uncertain_lti.model.horizon import Horizon, Residuals, Run
from uncertain_lti.model.repeats import Repeats
from uncertain_lti.model.schedule import Axis, BlockData, Schedule
from uncertain_lti.model.terms import ARRAYS
from uncertain_lti.monitor.alarm import Condition
from uncertain_lti.monitor.deployed import DeployedMonitor, listed_states
from uncertain_lti.monitor.session import Rule, Session, topic_types
from uncertain_lti.recordings.bag import Bag
from uncertain_lti.recordings.message_reader import MessageReader
from uncertain_lti.signals.signal_map import Signal

STATE, CONTROL, OTHER, GEAR = "/plant/state", "/plant/control", "/plant/other", "/plant/gear"
JOINT_STATE, VECTOR, FLOAT = "sensor_msgs/msg/JointState", "geometry_msgs/msg/Vector3Stamped", "std_msgs/msg/Float64"
KIND = {STATE: JOINT_STATE, CONTROL: VECTOR, OTHER: VECTOR, GEAR: FLOAT}
STEP_NS = 10_000_000
EPOCH_NS = 1_700_000_000_000_000_000
SENTINEL = -999.0
LENGTHS = (2, 3, 5, 8, 12, 20, 40)


# --- models -------------------------------------------------------------------------------------------------


def armed_model(rng: np.random.Generator, everything: bool = False) -> UncertainLTI:
    """A model of two or three states; everything: with every part that it may have."""

    def may(share: float) -> bool:
        return bool(rng.random() < share) or everything

    states = [
        Signal("a", STATE, "position[a]", 0.3, 1.7, type=JOINT_STATE),
        Signal("b", STATE, "position[b]", -0.2, 0.6, type=JOINT_STATE),
    ]
    if may(0.4):
        states.append(Signal("c", OTHER, "vector.z", 0.1, 1.1, type=VECTOR))
    controls = [
        Signal("p", CONTROL, "vector.x", 0.1, 0.9, type=VECTOR, max_hold=float(rng.choice([0.015, 0.5]))),
        Signal("q", CONTROL, "vector.y", 0.0, 1.2, type=VECTOR, delay=int(rng.integers(0, 3))),
    ]
    if may(0.5):  # only signals that remember belong to the controls
        lag = f"lag(position[a], {rng.integers(1, 4)})"
        controls.append(Signal("a_before", STATE, lag, 0.3, 1.7, type=JOINT_STATE))
    if may(0.4):
        controls.append(Signal("b_rate", STATE, "rate(position[b])", 0.0, 9.0, type=JOINT_STATE))
    if may(0.4):
        controls.append(Signal("q_change", CONTROL, "diff(vector.y)", 0.0, 0.5, type=VECTOR))
    if may(0.4):
        states[0] = replace(states[0], valid=(-1.2, 1.8))
    if may(0.4):
        states[1] = replace(states[1], ignore=(SENTINEL,))
    if may(0.4):
        controls[0] = replace(controls[0], valid=(-0.75, math.inf), ignore=(SENTINEL,))
    if may(0.4):
        controls[0] = replace(controls[0], at="arrival")
    knots, modes = may(0.6), may(0.5)
    gear = Signal("gear", GEAR, "data", type=FLOAT, max_hold=float(rng.choice([0.3, 5.0])))
    axes = [Axis("a", knots=(-0.05, 0.0, 0.08))] * knots + [Axis("gear", modes=(1.0, 2.0))] * modes
    schedule = Schedule(tuple(axes)) if axes else None
    blocks = () if schedule is None else (schedule.blocks,)
    topics = {s.topic for s in states} | {CONTROL} | ({GEAR} if modes else set())
    time = {topic: "log" if topic == GEAR else "header" for topic in topics}
    step = 1.01 * STEP_NS * 1e-9 if may(0.2) else None
    signals = SignalMap(
        tuple(states), tuple(controls), (gear,) * modes, clock=STATE, max_gap=2.5 * STEP_NS * 1e-9, time=time,
        min_step=1e-4 if may(0.3) else 0.0, step=step or "recorded",
    )  # fmt: skip
    n, m = len(states), len(controls)

    def elements(scale: float) -> dict[str, Any]:
        found = {
            "A": rng.normal(size=(*blocks, n, n)) - 2.0 * np.eye(n), "B": rng.normal(size=(*blocks, n, m)),
            "dA": rng.uniform(0.1, 0.6, (*blocks, n, n)), "dB": rng.uniform(0.1, 0.6, (*blocks, n, m)),
            "c": rng.normal(size=(*blocks, n)), "dc": rng.uniform(0.0, 0.1, (*blocks, n)),
            "v": rng.uniform(1e-4, 1e-3, (*blocks, n)),
        }  # fmt: skip
        return {name: found[name] * scale for name in ARRAYS}

    lengths = [h for h in LENGTHS if may(0.35)]

    def residuals() -> Residuals:
        spread = rng.normal(size=(n, n))
        # of the residual itself, as in files of before, or of the utilisation
        size = 1e-2 if len(lengths) == 1 else 0.3
        return Residuals(0.1 * size * rng.normal(size=n), size**2 * (spread @ spread.T + np.eye(n)), size == 0.3)

    horizons = [Horizon(h, **elements(0.4), residuals=residuals()) for h in lengths]
    run = elements(0.9)
    rules: list[Any] = [AlarmRule(int(m_ := rng.integers(1, 4)), int(m_ + rng.integers(0, 6)))]
    rules += [AlarmRule(3, 9, 1.3, horizon=h) for h in lengths[:1] if may(0.5)]
    for kind in KINDS:
        if may(0.5):
            over = int(rng.choice([1, *lengths]))
            threshold = float(rng.uniform(2, 30)) if kind in JOINT else tuple(rng.uniform(0.3, 1.5, n).tolist())
            allowance = 0.2 if kind == "cusum" else 0.0
            windows = [0.05, 0.3, 1.0] if kind == "cusum" else [0.0, 0.05, 0.3, 1.0]
            rules.append(StatisticRule(kind, float(rng.choice(windows)), threshold, over, allowance))
    size = n + m
    pairs = size * (size - 1) // 2
    return UncertainLTI(
        **elements(1.0),
        schedule=schedule,
        block_data=None if schedule is None else [BlockData(int(rng.integers(0, 2)) * 100) for _ in range(blocks[0])],
        horizons=horizons,
        run=Run(*(run[name] for name in ("A", "B", "c"))) if horizons and may(0.3) else None,
        signals=signals,
        sampling=Sampling(STEP_NS * 1e-9, 0.8 * STEP_NS * 1e-9, STEP_NS * 1e-9),
        domain=Domain(
            *(sign * rng.uniform(0.3, 1.2, k) for k in (n, m) for sign in (-1.0, 1.0)),
            Occupancy(4, rng.random((pairs, 4, 4)) < 0.9) if may(0.5) else None,
        ),
        alarm=rules,
        residuals=residuals(),
        repeats=Repeats(
            rng.choice([0.0, 0.02, 0.05], n), *rng.choice([0.0, 0.5, LARGEST], (3, n)), rng.choice([0.0, 6000.0], n)
        )
        if may(0.6)
        else None,
    )  # fmt: skip


# --- streams ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Disorder:
    """What may happen to a stream; with all false it is whole and in order, and its values are odd only."""

    order: bool = True
    """Messages come late, twice, with older stamps or with none."""
    time: bool = True
    """Stamps pause, jump and loop."""


def stream(model: UncertainLTI, rng: np.random.Generator, steps: int, disorder: Disorder = Disorder()) -> list[Message]:
    """Messages in order of receipt; states move within the model's bounds, mostly."""
    monitor, n, point = EnvelopeMonitor(model), model.n, model.operating_point
    topics = set(model.signals.topics)
    rate = float(rng.choice([0.0, 0.003, 0.01, 0.03]))  # of each kind of disorder

    def now_and_then(share: float = 1.0) -> bool:
        return bool(rng.random() < rate * share)

    found: list[tuple[int, int, Message]] = []

    def send(topic: str, log: int, data: bytes) -> None:
        found.append((log, len(found), Message(topic, log, data)))

    x, gear, t, ahead = point.recorded_x(np.zeros(n)), 1.0, EPOCH_NS, 100_000_000
    held: dict[int, tuple[float, int]] = {}  # state -> value, and until which sample it is frozen
    silent = {CONTROL: 0, OTHER: 0}
    send(GEAR, t + ahead - 1, float64(gear))
    for k in range(steps):
        u = point.u_s + point.U * rng.uniform(-1.0, 1.0, model.m)
        for i in range(n):
            if now_and_then(2.0):
                held[i] = float(x[i]), k + int(rng.integers(2, 40))
        sent = [held[i][0] if i in held and k < held[i][1] else float(x[i]) for i in range(n)]
        log = t + ahead + int(rng.integers(0, 2_000_000))
        state_log, control_log = log, log + int(rng.choice([-300_000, 300_000]))
        names: tuple[str, ...] = ("a", "b")
        values = sent[:2]
        p = float(u[0])
        kind = rng.integers(0, 8) if now_and_then(4.0) else -1
        if kind == 0:
            values, names = values[::-1], ("b", "a")
        elif kind == 1:
            names = ("a", "x")
        elif kind == 2:
            values = [float(rng.choice([math.nan, math.inf, -math.inf, 1e308])), values[1]]
        elif kind == 3:
            values = values[:1]
        elif kind == 4:
            values = [values[0], SENTINEL]
        elif kind == 5:
            values = [5.0, values[1]]  # beyond what is valid
        elif kind == 6:
            p = float(rng.choice([math.nan, SENTINEL, -3.0]))
        for topic in silent:
            if now_and_then():
                silent[topic] = k + int(rng.integers(2, 70))
        if disorder.order:
            if now_and_then(2.0):
                control_log += int(rng.integers(1, 6)) * STEP_NS
            if now_and_then():
                state_log += int(rng.integers(1, 4)) * STEP_NS
            if now_and_then():
                send(STATE, state_log + 500_000, joint_state(t, values, names))  # an equal stamp
            if now_and_then():
                send(STATE, state_log + 500_000, joint_state(t - STEP_NS // 2, values, names))
            if now_and_then():
                send(STATE, state_log + 600_000, joint_state(t + 20_000, values, names))  # a short step
            if now_and_then():
                send(STATE, state_log + 500_000, joint_state(0, values, names))
            if now_and_then():
                send(CONTROL, control_log, vector(0, p, u[1], 0.0))
            if now_and_then():
                send(STATE, state_log, joint_state(t, values, names)[: int(rng.integers(0, 60))])
        whole = joint_state(t, values, names)
        if not now_and_then(2.0):
            send(STATE, state_log, whole)
        if k >= silent[CONTROL] and not now_and_then(2.0):
            send(CONTROL, control_log, vector(t, p, float(u[1]), 0.0))
        if OTHER in topics and k >= silent[OTHER] and not now_and_then(2.0):
            send(OTHER, log + int(rng.integers(-2_000_000, 2_000_000)), vector(t, 0.0, 0.0, sent[2]))
        if GEAR in topics and rng.random() < 0.05:
            gear = float(rng.choice([1.0, 2.0, 3.0, math.nan], p=[0.47, 0.47, 0.03, 0.03]))
            send(GEAR, log + int(rng.integers(-STEP_NS, STEP_NS)), float64(gear))
        q = [gear] if model.q else []
        lower, upper = monitor.predict(x, u, STEP_NS * 1e-9, q)
        if np.isfinite(lower).all() and np.isfinite(upper).all():
            wide = 1.4 if rng.random() < 0.1 else 1.0
            moved = 0.5 * (lower + upper) + 0.5 * (upper - lower) * rng.uniform(-wide, wide, n)
            x = np.clip(moved, -1.1, 1.7)
        t += STEP_NS + int(rng.integers(-1_000_000, 1_000_000))
        if disorder.time:
            if now_and_then():  # a single stamp of another year
                year = 365 * 86400 * 10**9 * int(rng.choice([-1, 1]))
                send(STATE, state_log + 400_000, joint_state(t + year, values))
            jump = 0
            if now_and_then():
                jump = int(rng.choice([1.6, 5, 30])) * STEP_NS  # a step out of range, or a gap
            elif now_and_then(0.5):
                jump = int(rng.choice([3600, -7200, -1])) * 10**9
            elif now_and_then(0.5):
                jump = EPOCH_NS - t  # the recording is played again
            t += jump
            ahead -= min(jump, 0)  # time of receipt goes on
    return [message for *_, message in sorted(found, key=lambda entry: entry[:2])]


# --- what is made of them -----------------------------------------------------------------------------------


def deployment(model: UncertainLTI, rng: np.random.Generator) -> Rule:
    """A rule as parameters give it."""
    conditions = ["", "", f"{GEAR} data == 1", f"{STATE} position[b] > -0.4", f"{CONTROL} vector.x < 0.5"]
    masked, enable = str(rng.choice(["", "", "b"])), str(rng.choice(conditions))
    grace, latch = float(rng.choice([0.0, 0.0, 0.05, 0.4])), bool(rng.random() < 0.2)
    violations, margin = int(rng.choice([0, 0, 2])), float(rng.choice([0.0, 0.0, 1.2]))
    counted = {"violations": violations, "window": 3 if violations else 0, "margin": margin}
    return Rule(masked=masked, enable=enable, grace=grace, latch=latch, **counted)


Row = dict[str, Any]
"""What is said of one sample, arrays as bytes."""


_ARRAYS = ("flags", "lower", "upper", "utilisation", "horizon_utilisation", "statistics", "state")
_TRUTHS = ("outside_domain", "unknown_regime", "violated")


def _row(**said: Any) -> Row:
    return {
        name: np.asarray(value, dtype=np.float64).tobytes() if isinstance(value, np.ndarray) else value
        for name, value in said.items()
    }


def decoders() -> tuple[Callable[[str], Any], Callable[[str, Any], MessageReader]]:
    """What `Session` asks for: fields of a type, and readers of messages."""
    from uncertain_lti.recordings.message_types import define, jazzy_text

    definitions = {kind: define(kind, "ros2msg", jazzy_text(kind).encode()) for kind in set(KIND.values())}

    def type_fields(kind: str) -> Any:
        return next(d for d in definitions.values() if kind in d.types).fields(kind)

    def reader(kind: str, paths: Any) -> MessageReader:
        return MessageReader(kind, paths, type_fields, lambda data: JAZZY.deserialize_cdr(data, kind))

    return type_fields, reader


def session_of(model: UncertainLTI, rule: Rule, now: float = 0.0, **options: Any) -> Session:
    type_fields, reader = decoders()
    session = Session(model, rule, topic_types(model, "the model", type_fields), type_fields, reader, now, **options)
    if rule.enable and not session.enable_type:
        session.found_enable_type(KIND[session.enable_topic])
    return session


def live(session: Session, messages: Sequence[Message]) -> list[Row]:
    """What a session says of messages that it takes one by one."""
    rows = []
    for one in messages:
        verdicts, _ = session.take(one.topic, one.log_time, one.data, 0.0)
        rows += told(verdicts, session.latched)
    return rows


def told(verdicts: Sequence[Any], latched: bool = False) -> list[Row]:
    """What verdicts say of samples; messages that were dropped are none."""
    rows = []
    for v in verdicts:
        if v.status.dropped:
            assert not v.judged and math.isnan(v.flags[0])
            continue
        said = {name: getattr(v, name) for name in (*_ARRAYS, *_TRUTHS)}
        said |= {name: tuple(moved.state for moved in getattr(v, name)) for name in ("frozen", "repeating")}
        rows.append(_row(t_ns=v.t_ns, status=v.status, alarm=v.alarm or latched, raised=v.raised, **said))
    return rows


def offline(model: UncertainLTI, rule: Rule, messages: Sequence[Message], path: Path) -> list[Row]:
    """What `check` says of a recording of the messages in this order."""
    topics = [Topic(topic, kind) for topic, kind in KIND.items()]
    write(topics, messages, Layout("none", chunk_size=1 << 16)).save(path)
    given, masked = (rule.violations or None, rule.window or None, rule.margin or None), listed_states(rule.masked)
    monitor = EnvelopeMonitor(model, *given, masked)
    deployed = DeployedMonitor(monitor, Condition.parse(rule.enable), rule.grace, rule.latch)
    verdicts, _ = check_recording(deployed, Bag(path))
    rows = []
    for k, status in enumerate(verdicts.statuses()):
        said = {name: getattr(verdicts, name)[k] for name in _ARRAYS}
        said |= {name: bool(getattr(verdicts, name)[k]) for name in ("alarm", *_TRUTHS)}
        said |= {name: tuple(np.flatnonzero(getattr(verdicts, name)[k]).tolist()) for name in ("frozen", "repeating")}
        rows.append(_row(t_ns=int(verdicts.transient.t_ns[k]), status=status, raised=verdicts.raised(k), **said))
    return rows


Arriving = tuple[float, str, int, bytes, int]
"""When a message comes (s, steady), topic, time of receipt (ns), data, and when it was sent (ns)."""


def arriving(messages: Sequence[Message]) -> list[Arriving]:
    """Messages that come as they were sent."""
    began = messages[0].log_time
    return [((m.log_time - began) * 1e-9, m.topic, m.log_time, m.data, m.log_time) for m in messages]


def run(session: Session, messages: Sequence[Arriving], until: float | None = None) -> list[Any]:
    """Verdicts of a session that gets these messages, and is asked every 0.1 s what it releases, as by the node."""
    verdicts, now = list[Any](), 0.0
    end = messages[-1][0] + 10.0 if until is None else until
    for at, topic, arrival_ns, data, sent_ns in [*messages, (end, "", 0, b"", 0)]:
        while now + 0.1 < at:
            now += 0.1
            for due in session.release(now):
                verdicts += session.take(*due, now)[0]
        if topic:
            for due in session.accept(topic, arrival_ns, data, at, sent_ns, (arrival_ns - sent_ns) * 1e-9):
                verdicts += session.take(*due, at)[0]
    return verdicts


def held_up(messages: list[Arriving], topic: str, begin: float, until: float) -> list[Arriving]:
    """Messages of a topic sent from `begin` to `until` come at its end, in a burst; a microsecond between two."""
    moved = []
    for at, name, log_time, data, sent_ns in messages:
        come = until - 1e-3 + 1e-6 * len(moved) if name == topic and begin <= at < until else at
        moved.append((come, name, log_time + round((come - at) * 1e9), data, sent_ns))
    return sorted(moved, key=lambda m: m[0])


def stopped(messages: list[Arriving], begin: float, chunk: int, first: str, seconds: float) -> list[Arriving]:
    """Nothing is received for some seconds, then what came meanwhile, a chunk of one topic after one of another."""
    end = begin + seconds
    late = [m for m in messages if begin <= m[0] < end]
    topics = sorted({m[1] for m in messages}, key=lambda t: (t != first, t))
    by_topic = {t: [m for m in late if m[1] == t] for t in topics}
    order = []
    for at in range(0, len(late), chunk):
        for own in by_topic.values():
            order += own[at : at + chunk]
    burst = [(end + 2e-5 * i, *message) for i, (_, *message) in enumerate(order)]
    over = burst[-1][0] if burst else end  # no message overtakes another one of its topic
    rest = [(max(at, over) if at >= end else at, *message) for at, *message in messages if not begin <= at < end]
    was = {(m[1], m[2]): m[0] for m in messages}
    moved = [(at, t, log + round((at - was[t, log]) * 1e9), data, sent) for at, t, log, data, sent in [*burst, *rest]]
    return sorted(moved, key=lambda m: m[0])


def difference(ours: Sequence[Row], theirs: Sequence[Row]) -> str:
    """The first thing that is not the same, in words; empty without one."""
    for k, (a, b) in enumerate(zip(ours, theirs, strict=False)):
        for name in a:
            if a[name] != b[name]:
                shown = [np.frombuffer(v).tolist() if isinstance(v, bytes) else v for v in (a[name], b[name])]
                return f"sample {k} of {len(ours)}, {a['status'].value}: {name} is {shown[0]} live, {shown[1]} offline"
    return "" if len(ours) == len(theirs) else f"{len(ours)} samples live, {len(theirs)} offline"


# --- cases: each gives the rows that a live session gave, and those that should be the same ----------------------


def in_disorder(rng: np.random.Generator, folder: Path) -> tuple[list[Row], list[Row]]:
    """Any stream, as it was received."""
    model = armed_model(rng)
    messages, rule = stream(model, rng, 300), deployment(model, rng)
    return live(session_of(model, rule), messages), offline(model, rule, messages, folder / "run.mcap")


def of_a_swapped_model(rng: np.random.Generator, folder: Path) -> tuple[list[Row], list[Row]]:
    """Another model takes over between two messages; what it may keep is what came before on topics that it shares."""
    first, second = armed_model(rng), armed_model(rng)
    # not across a step back: which values of a topic are of the pass before is known to the sampler that saw the clock
    disorder = Disorder(time=False)
    messages = stream(first if len(first.signals.topics) > len(second.signals.topics) else second, rng, 300, disorder)
    rule = replace(deployment(first, rng), enable=f"{GEAR} data == 1" if first.q == second.q else "", masked="")
    at = int(rng.integers(1, len(messages)))
    before = session_of(first, rule)
    live(before, messages[:at])
    after = session_of(second, rule, arming=before.arming)
    after.go_on_from(before)
    latched = after.latched
    assert latched or not (rule.latch and before.alarm)
    theirs = first.signals

    def kept(topic: str) -> bool:
        if topic not in second.signals.topics:
            return topic == GEAR
        wanted = {second.signals[i].field for i in second.signals.on(topic)}
        return topic != STATE and topic in theirs.topics and wanted <= {theirs[i].field for i in theirs.on(topic)}

    whole = [m for m in messages[:at] if kept(m.topic)] + messages[at:]
    rows = live(after, messages[at:])
    if not {m.topic for m in whole} >= {*second.signals.topics} or not rows:
        return [], []  # it cannot be a recording of that model
    expected = offline(second, rule, whole, folder / "run.mcap")
    return rows, [{**row, "alarm": row["alarm"] or latched} for row in expected]


def held_up_on_the_way(rng: np.random.Generator, folder: Path) -> tuple[list[Row], list[Row]]:
    """Topics come in bursts at the start and after a stop, in disorder and with a lag; expected: as without bursts."""
    while (model := armed_model(rng)).q:  # by time of receipt, a topic that is held up is another one
        pass
    lag = rng.integers(0, 11) * STEP_NS // 2  # of the stamps of the controls
    messages = [
        replace(m, log_time=m.log_time + int(lag) * (m.topic == CONTROL))
        for m in stream(model, rng, 700, Disorder(time=False))
        if m.topic in model.signals.topics and m.data[4:12] != bytes(8)  # without a stamp, the time of receipt counts
    ]
    messages.sort(key=lambda m: m.log_time)
    late = arriving(messages)
    for topic in model.signals.topics:
        if rng.random() < 0.5:
            late = held_up(late, topic, 0.0, float(rng.uniform(0.1, 2.5)))
    if rng.random() < 0.7:
        first = str(rng.choice(list(model.signals.topics)))
        late = stopped(late, 4.0, int(rng.choice([3, 16, 10**6])), first, float(rng.uniform(0.3, 2.5)))
    rule = replace(deployment(model, rng), enable="", latch=False)
    return told(run(session_of(model, rule), late)), offline(model, rule, messages, folder / "run.mcap")


CASES = (in_disorder, in_disorder, of_a_swapped_model, held_up_on_the_way)
