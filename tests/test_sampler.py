# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The Sampler against its rules, worked out naively with every message in hand."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from refusals import refuses
from steps import OPENING

from uncertain_lti.base.errors import SignalError
from uncertain_lti.sampling import sampler as sampler_module
from uncertain_lti.sampling.clock import Status, median_step_ns, resolve, to_ns
from uncertain_lti.sampling.sampler import BUFFERED_MESSAGES, KEPT_OVER_A_JUMP, Sampler, Step
from uncertain_lti.signals.field_path import FieldPath
from uncertain_lti.signals.signal_map import Signal, SignalMap

TICK = 10_000_000  # ns
NAN, INF = math.nan, math.inf


class Sent(NamedTuple):
    """A message on its way in; stamp None where it has none."""

    topic: str
    arrival: int
    stamp: int | None
    values: tuple[float, ...]


# --- the reference: the rules of `sampler`, one after the other, over the whole list of messages -------------


@dataclass
class Sample:
    """An accepted clock message: which one, what it is, and which message closed it."""

    index: int
    instant: int
    status: Status
    dt: float
    closed_by: int | None = None
    reset_by: int = 0  # number of resets so far: the pass it belongs to
    chosen: dict[str, int | None] = field(default_factory=dict)
    z: list[float] = field(default_factory=list)
    missing: bool = False


class Reference:
    """What becomes of each clock message of a list.

    forgets: a message that was passed over when a sample closed is not looked at again (memory is bounded), unless
    time has jumped back; False is the letter of the rules, and the same as long as no time jumps and no topic has
    some messages with a stamp and some without.
    """

    def __init__(self, signals: SignalMap, messages: Sequence[Sent], forgets: bool) -> None:
        self.signals, self.sent, self.forgets = signals, messages, forgets
        self.max_gap, self.min_step = to_ns(signals.max_gap), to_ns(signals.min_step)
        self.n = len(signals.states)
        self.counters: Counter[str] = Counter()
        self.dropped: dict[int, tuple[Status, int]] = {}
        self.by_topic = {t: [i for i, m in enumerate(messages) if m.topic == t] for t in signals.topics}
        self.jumps = {t: self._jumps(t) for t in signals.topics}
        self.others = [t for t in signals.topics if t != signals.clock]
        self.samples = self._samples()
        self.values = {t: self._values(t) for t in signals.topics}
        for sample in self.samples:
            if sample.closed_by is not None:
                self._close(sample)
        self._delay()
        self._late()

    def stamp(self, index: int) -> int | None:
        stamp = self.sent[index].stamp
        usable = self.signals.time[self.sent[index].topic] == "header" and stamp is not None and stamp > 0
        return stamp if usable else None

    def _samples(self) -> list[Sample]:
        samples: list[Sample] = []
        resets = 0
        for index in self.by_topic[self.signals.clock]:
            by_header = self.signals.time[self.signals.clock] == "header"
            instant = self.stamp(index) if by_header else self.sent[index].arrival
            if instant is None:
                self._drop(index, Status.UNSTAMPED, self.sent[index].arrival)
                continue
            status, dt = Status.FIRST, NAN
            if samples:
                step = instant - samples[-1].instant
                if step == 0:
                    self._drop(index, Status.EQUAL, instant)
                    continue
                if step < 0 and -step <= self.max_gap:
                    self._drop(index, Status.LATE, instant)
                    continue
                if step < 0:
                    status = Status.RESET
                    resets += 1
                elif step < self.min_step:
                    self._drop(index, Status.SHORT, instant)
                    continue
                else:
                    status, dt = (Status.GAP if step > self.max_gap else Status.OK), step * 1e-9
                    if status is Status.OK and self.signals.step != "recorded":
                        dt = self.signals.step
                samples[-1].closed_by = index
            samples.append(Sample(index, instant, status, dt, reset_by=resets))
        self.counters["samples"] = len(samples)
        self.counters["gaps"] = sum(s.status is Status.GAP for s in samples)
        self.counters["resets"] = resets
        return samples

    def _drop(self, index: int, status: Status, instant: int) -> None:
        self.dropped[index] = (status, instant)
        self.counters[status.value] += 1

    def _jumps(self, topic: str) -> list[int]:
        """Messages with which a topic's own time steps back by more than max_gap."""
        found = []
        for stamped in (True, False):
            mine = [i for i in self.by_topic[topic] if (self.stamp(i) is not None) == stamped]
            instants = [self.stamp(i) if stamped else self.sent[i].arrival for i in mine]
            pairs = zip(mine[1:], instants[1:], instants, strict=False)
            found += [i for i, now, last in pairs if last - now > self.max_gap]
        return sorted(found)

    def _values(self, topic: str) -> dict[int, list[float]]:
        """Values of each message with angles unwrapped from where the stream starts anew."""
        where = self.signals.on(topic)
        clock = topic == self.signals.clock
        starts = {s.index for s in self.samples if s.status in OPENING} if clock else {*self.jumps[topic]}
        taken = [s.index for s in self.samples] if clock else self.by_topic[topic]
        values = {i: list(self.sent[i].values) for i in taken}
        for column, position in enumerate(where):
            signal = self.signals[position]
            low, high = signal.valid or (-INF, INF)
            for i in self.by_topic[topic]:
                value = self.sent[i].values[column]
                if value < low or value > high or any(value == code for code in signal.ignore):
                    self.counters[f"invalid {signal.name}"] += 1
                    if i in values:
                        values[i][column] = NAN
            if "unwrap" not in signal.field:
                continue
            last = steady = self.signals[self._recalls(position)].steady
            for i in taken:
                if i in starts:
                    last = steady
                if math.isfinite(values[i][column]):
                    turns = round((last - values[i][column]) / (2 * math.pi))
                    last = values[i][column] = values[i][column] + 2 * math.pi * turns
        return values

    def _recalls(self, position: int) -> int:
        """The state or control that a memory such as lag(data, 2) is of; the signal itself without one."""
        signal = self.signals[position]
        if "(" not in signal.field or signal.field.startswith("unwrap"):
            return position
        field = signal.field.partition("(")[2].removesuffix(")").partition(",")[0]
        for i, other in enumerate(self.signals):
            if (other.topic, other.field) == (signal.topic, field) and not other.delay:
                return i
        return position

    def age(self, sample: Sample, index: int) -> int:
        ours, theirs = self.stamp(sample.index), self.stamp(index)
        if ours is None or theirs is None:
            return self.sent[sample.index].arrival - self.sent[index].arrival
        return ours - theirs

    def jump(self, sample: Sample, topic: str) -> int:
        """The last message with which the topic stepped back before the sample closed; -1 without any."""
        return max([i for i in self.jumps[topic] if i < sample.closed_by], default=-1)

    def lag(self, topic: str, until: int) -> tuple[bool, bool]:
        """Whether a topic's time has stepped back and the clock's not yet, and the other way round.

        A topic whose time reaches the instant again that it left has sent single messages of another time.
        """
        resets = {s.index for s in self.samples if s.status is Status.RESET}
        ahead = behind = False
        last: dict[bool, int] = {}
        left: tuple[bool, int] | None = None
        for i in range(until):
            if i in resets:
                ahead, behind = False, not ahead
            if self.sent[i].topic != topic:
                continue
            stamp = self.stamp(i)
            instant, stamped = self.sent[i].arrival if stamp is None else stamp, stamp is not None
            if i in self.jumps[topic]:
                ahead, behind, left = not (behind and self.follows(i)), False, (stamped, last[stamped])
            elif left is not None and left[0] is stamped and instant >= left[1]:
                ahead = False
            last[stamped] = instant
        return ahead, behind

    def follows(self, jump: int) -> bool:
        """Whether the clock may have stepped back before a message: the open sample is as near to it as to the last."""
        sample = max((s for s in self.samples if s.index < jump), key=lambda s: s.index)
        stamped, topic = self.stamp(jump) is not None, self.sent[jump].topic
        before = max(i for i in self.by_topic[topic] if i < jump and (self.stamp(i) is not None) == stamped)
        here = self.stamp(sample.index) if stamped else self.sent[sample.index].arrival
        gone = self.stamp(before) if stamped else self.sent[before].arrival
        return here is None or abs(here - gone) >= abs(self.age(sample, jump))

    def passed_over(self, topic: str, before: Sample) -> set[int]:
        gone: set[int] = set()
        for sample, closing in zip(self.samples, self.samples[1:], strict=False):
            if sample is before:
                break
            ahead, _ = self.lag(topic, closing.index)
            if closing.status is Status.RESET or ahead or self._left(sample, topic):
                continue
            arrived = [i for i in self.by_topic[topic] if self.jump(sample, topic) <= i < sample.closed_by]
            gone |= {i for i in arrived if self.age(sample, i) >= 0} - {sample.chosen[topic]}
        return gone

    def _best(self, sample: Sample, candidates: Sequence[int]) -> tuple[int, int] | None:
        """Age and index of the message with the greatest stamp at or before the sample, ties to the latest arrival."""
        ages = [(self.age(sample, i), -i) for i in candidates if self.age(sample, i) >= 0]
        return (min(ages)[0], -min(ages)[1]) if ages else None

    def _left(self, sample: Sample, topic: str) -> tuple[int, int] | None:
        """What an open sample had chosen when its topic stepped back before the clock did: of the same pass."""
        begin = 0
        for event in self.jumps[topic]:
            _, behind = self.lag(topic, event)
            if sample.index < event < sample.closed_by and not (behind and self.follows(event)):
                candidates = {i for i in self.by_topic[topic] if begin <= i < event}
                if self.forgets:
                    candidates -= self.passed_over(topic, sample)
                if best := self._best(sample, sorted(candidates)):
                    return best
            begin = event
        return None

    def _close(self, sample: Sample) -> None:
        z = [NAN] * len(self.signals.signals)
        for topic in self.signals.topics:
            where = self.signals.on(topic)
            if topic == self.signals.clock:
                chosen, age = sample.index, 0
            else:
                candidates = [i for i in self.by_topic[topic] if self.jump(sample, topic) <= i < sample.closed_by]
                if self.forgets:
                    gone = self.passed_over(topic, sample)
                    candidates = [i for i in candidates if i not in gone]
                sample.chosen[topic] = None
                best = self._left(sample, topic) or self._best(sample, candidates)
                if best is None:
                    continue
                age, chosen = best
                sample.chosen[topic] = chosen
            for position, value in zip(where, self.values[topic][chosen], strict=True):
                signal = self.signals[position]
                limit = self.signals.max_skew or self.signals.max_gap
                recalls = signal.field.startswith(("lag", "diff", "rate"))
                of_state = recalls and signal.max_hold is None and any(s.topic == topic for s in self.signals.states)
                if position >= self.n and not of_state:
                    limit = signal.max_hold
                if limit is not None and age > to_ns(limit):
                    self.counters[f"stale {signal.name}"] += 1
                else:
                    z[position] = value
        sample.z = z

    def _delay(self) -> None:
        """u(t_k - delay) of the same segment in place of u(t_k); and what lag, diff and rate take of earlier ones."""
        closed = [s for s in self.samples if s.closed_by is not None]
        before = [list(s.z) for s in closed]
        for k, sample in enumerate(closed):
            for j, control in enumerate(self.signals.controls, start=self.n):
                kind = control.field.partition("(")[0]
                back = int(control.field.rpartition(",")[2].strip(" )")) if kind == "lag" else control.delay
                source = k - (1 if kind in ("diff", "rate") else back)
                joined = source >= 0 and not any(s.status in OPENING for s in closed[source + 1 : k + 1])
                past = before[source][j] if joined else NAN
                if kind in ("diff", "rate"):
                    past = before[k][j] - past
                sample.z[j] = past / sample.dt if kind == "rate" and joined else past
            for signal, value in zip(self.signals.signals, sample.z, strict=True):
                self.counters[f"missing {signal.name}"] += not math.isfinite(value)

    def _late(self) -> None:
        """Messages that came after a sample closed, and would have been chosen for it."""
        for topic in self.others:
            jumps = self.jumps[topic]
            for index in self.by_topic[topic]:
                passed = sum(s.status is Status.RESET and s.index < index for s in self.samples)
                for sample in self.samples:
                    if sample.closed_by is None or sample.closed_by > index or sample.reset_by != passed:
                        continue
                    if any(sample.closed_by < j <= index for j in jumps):
                        continue
                    chosen, age = sample.chosen[topic], self.age(sample, index)
                    if age >= 0 and (chosen is None or age <= self.age(sample, chosen)):
                        self.counters[f"late {topic}"] += 1
                        break

    def steps(self) -> list[list[Step]]:
        """Steps that each message decides."""
        decided: list[list[Step]] = [[] for _ in self.sent]
        n, m = self.n, len(self.signals.controls)
        nothing = np.full(n + m, NAN)
        for index, (status, instant) in self.dropped.items():
            arrival = self.sent[index].arrival
            decided[index].append(Step(status, instant, arrival, NAN, nothing.tolist(), nothing[:n].tolist()))
        arrivals = [i for i, s in enumerate(self.signals) if s.at == "arrival"]
        needed = [*self.signals.states, *(self.signals[i] for i in arrivals)]
        one_topic = all(s.topic == self.signals.clock for s in needed)
        resets = {s.index for s in self.samples if s.status is Status.RESET}
        for before, sample in zip([None, *self.samples], self.samples, strict=False):
            index = sample.index if one_topic else sample.closed_by
            if index is None:
                continue
            if one_topic:
                row = [NAN] * (n + m)
                where, values = self.signals.on(self.signals.clock), self.values[self.signals.clock][sample.index]
                for position, value in zip(where, values, strict=True):
                    row[position] = value
                at_end = np.array(row)
            else:
                at_end = np.array(sample.z)
            x_next = at_end[:n]
            z = nothing
            if before is not None and sample.status is not Status.RESET:
                z = np.array(before.z)
                z[arrivals] = NAN if not one_topic and sample.closed_by in resets else at_end[arrivals]
            status = sample.status
            if status is Status.OK and not (np.isfinite(z).all() and np.isfinite(x_next).all()):
                status = Status.MISSING
                self.counters["missing"] += 1
            arrival, rows = self.sent[sample.index].arrival, (z.tolist(), x_next.tolist())
            decided[index].append(Step(status, sample.instant, arrival, sample.dt, *rows))
        return decided


def plain(step: Step) -> tuple[object, ...]:
    """A step as something that can be compared: numbers by their bits."""
    rows = ([float(v).hex() for v in row] for row in (step.x, step.u, step.x_next))
    return step.status, step.t_ns, step.arrival_ns, float(step.dt).hex(), *rows


def run(signals: SignalMap, messages: Sequence[Sent]) -> tuple[list[list[Step]], Sampler]:
    sampler = Sampler(signals)
    return [sampler.push(*message) for message in messages], sampler


def only(steps: list[list[Step]]) -> list[Step]:
    return [step for decided in steps for step in decided]


# --- random maps and streams --------------------------------------------------------------------------------


@st.composite
def maps(draw: st.DrawFn) -> SignalMap:
    """Clock /c; a second state on /c or on /s; controls on /c, /s, /u, /v."""
    limits = st.sampled_from([None, 0.0, 0.02, 0.05, 1.0])
    fields = st.sampled_from(["data", "unwrap(data)"])
    states = [Signal("x1", "/c", draw(fields), steady=draw(st.sampled_from([0.0, 7.0])))]
    if draw(st.booleans()):
        states.append(Signal("x2", draw(st.sampled_from(["/c", "/s"])), draw(fields)))
    controls = [
        Signal(f"u{j}", topic, "data", max_hold=draw(limits), delay=draw(st.sampled_from([0, 0, 0, 1, 3])))
        for j, topic in enumerate(draw(st.lists(st.sampled_from(["/c", "/s", "/u", "/u", "/v"]), max_size=3)))
    ]
    ends = st.sampled_from(["departure", "departure", "arrival", "both"])
    listed = {(s.topic, s.field) for s in states}
    controls = [u if u.delay or (u.topic, u.field) in listed else replace(u, at=draw(ends)) for u in controls]
    memories = ["lag(data, 1)", "lag(unwrap(data), 3)", "diff(data)", "rate(data)", "rate(unwrap(data))"]
    for j, topic in enumerate(draw(st.lists(st.sampled_from(["/c", "/s", "/u"]), max_size=2))):
        controls.append(Signal(f"m{j}", topic, draw(st.sampled_from(memories)), max_hold=draw(limits)))
    valid = st.sampled_from([None, None, (-3.0, 50.0), (0.0, INF)])
    ignored = st.sampled_from([(), (), (1.0,), (100.0, -2.5)])
    if draw(st.booleans()):
        states, controls = (
            [replace(signal, valid=draw(valid), ignore=draw(ignored)) for signal in group]
            for group in (states, controls)
        )
    topics = dict.fromkeys(s.topic for s in [*states, *controls])
    limits = {"max_gap": draw(st.sampled_from([0.02, 0.05])), "min_step": draw(st.sampled_from([0.0, 0.0, 0.02]))}
    limits |= {"max_skew": draw(st.sampled_from([None, None, 0.02, 1.0]))}
    limits |= {"step": draw(st.sampled_from(["recorded", "recorded", 0.011]))}
    time = {t: draw(st.sampled_from(["header", "header", "log"])) for t in topics}
    return SignalMap(tuple(states), tuple(controls), clock="/c", time=time, **limits)


VALUES = st.sampled_from([0.0, 1.0, -2.5, 3.0, -3.1, 3.1, 6.0, 100.0])
BROKEN = st.sampled_from([NAN, INF, -INF])


@st.composite
def streams(draw: st.DrawFn, signals: SignalMap, tame: bool = False) -> list[Sent]:
    """Messages in order of arrival.

    tame: no zero stamps and no jumps, so that every rule applies to the letter.
    """
    lags = {t: draw(st.sampled_from([0, 0, 1, 3])) for t in signals.topics}
    rough = draw(st.sampled_from([0, 0, 1, 3]))  # of ten messages, how many stray
    values = draw(st.sampled_from([VALUES, VALUES, VALUES | BROKEN]))
    messages = []
    now, shift = 100, dict.fromkeys(signals.topics, 0)
    for _ in range(draw(st.integers(0, 40))):
        now += draw(st.sampled_from([0, 0, 1, 1, 1, 2, 2, 3, 25] if rough > 1 else [0, 1, 1, 1, 2]))
        topic = draw(st.sampled_from([*signals.topics, "/c"]))
        stray = draw(st.integers(0, 9)) < rough
        if not tame and draw(st.integers(0, 14)) == 0:  # time jumps, for all topics or for one
            jump = draw(st.sampled_from([-30, -6, -5, -3, -2, 40]))
            for each in draw(st.sampled_from([list(signals.topics), [topic]])):
                shift[each] += jump
            if now >= 130 and draw(st.booleans()):
                now -= 30  # as the node's clock does when a bag is played anew with /clock
        stamp: int | None = now - lags[topic] + shift[topic]
        if stray:
            stamp -= draw(st.sampled_from([1, 2, 4, -1, -3]))
        stamp = max(1, stamp) * TICK
        if stray and not tame:
            stamp = draw(st.sampled_from([stamp, stamp, None, 0, -stamp]))
        messages.append(Sent(topic, now * TICK, stamp, tuple(draw(values) for _ in signals.on(topic))))
    return messages


@st.composite
def cases(draw: st.DrawFn, tame: bool = False) -> tuple[SignalMap, list[Sent]]:
    signals = draw(maps())
    return signals, draw(streams(signals, tame))


def hold_against(reference: Reference, signals: SignalMap, messages: list[Sent]) -> None:
    got, sampler = run(signals, messages)
    wanted = reference.steps()
    for index, (mine, theirs) in enumerate(zip(got, wanted, strict=True)):
        assert [plain(s) for s in mine] == [plain(s) for s in theirs], f"at message {index}: {messages[index]}"
    counted, wanted_counts = +sampler.counters, +reference.counters
    if any(b.arrival < a.arrival for a, b in zip(messages, messages[1:], strict=False)):
        # The Sampler looks back no further than the first sample that a message is not late for: enough as long as
        # the node's clock does not step back alone.
        kept = ({key: n for key, n in c.items() if not key.startswith("late /")} for c in (counted, wanted_counts))
        counted, wanted_counts = kept
    assert counted == wanted_counts


@settings(max_examples=80)
@given(cases(tame=True))
def test_tame_streams_follow_the_letter_of_the_rules(case: tuple[SignalMap, list[Sent]]) -> None:
    """Several topics, late and out of order, equal stamps, gaps, NaN, stale, delayed: nothing is left to memory."""
    signals, messages = case
    letter = Reference(signals, messages, forgets=False)
    resets = any(s.status is Status.RESET for s in letter.samples)
    jumps = any(letter.jumps.values())
    hold_against(Reference(signals, messages, forgets=resets or jumps), signals, messages)


@settings(max_examples=200)
@given(cases())
def test_wild_streams_follow_the_rules_too(case: tuple[SignalMap, list[Sent]]) -> None:
    """With zero stamps, jumps of one topic or of all, a node clock that jumps back, in any combination."""
    signals, messages = case
    hold_against(Reference(signals, messages, forgets=True), signals, messages)


# --- what a looped bag gives --------------------------------------------------------------------------------


@st.composite
def loops(draw: st.DrawFn) -> tuple[SignalMap, list[Sent]]:
    """Two passes of one bag that overlap where they meet; the second arrives 100 ticks after the first."""
    signals = draw(maps())
    signals = replace(signals, controls=(*signals.controls, Signal("always", "/w", "data")))
    signals = replace(signals, time=dict.fromkeys(signals.topics, "header"))
    merged = sorted(
        (tick * TICK, topic)
        for topic in signals.topics
        for tick in range(draw(st.integers(1, 3)), 30, draw(st.sampled_from([1, 2, 3])))
    )
    first = [Sent(topic, t, t, tuple(draw(VALUES) for _ in signals.on(topic))) for t, topic in merged]
    second = [m._replace(arrival=m.arrival + 100 * TICK) for m in first]
    overlap = draw(st.integers(0, min(15, len(first))))
    seam = first[-overlap:] + second[:overlap] if overlap else []
    queues = {topic: [m for m in seam if m.topic == topic] for topic in signals.topics}
    mixed = [queues[m.topic].pop(0) for m in draw(st.permutations(seam))]  # topics overtake each other
    return signals, first[: len(first) - overlap] + mixed + second[overlap:]


STATE_AND_CONTROL = SignalMap(
    (Signal("x", "/c", "data", steady=0.0),),
    (Signal("u", "/c", "level"),),
    clock="/c",
    max_gap=0.05,
    time={"/c": "header"},
)
TWO_PASSES = [Sent("/c", k * TICK, at * TICK, (0.0, float(k))) for k, at in enumerate((100, 101, 102, 1, 2))]


@settings(max_examples=80)
@given(cases() | cases(tame=True) | loops())
@example((STATE_AND_CONTROL, TWO_PASSES))
def test_all_at_once_is_what_one_after_the_other_is(case: tuple[SignalMap, list[Sent]]) -> None:
    """Samples, which message decided each, and counts; the last sample of a pass has what it knows of itself."""
    signals, messages = case
    topics, n = signals.topics, len(signals.states)
    of = np.array([topics.index(m.topic) for m in messages], dtype=np.int64)
    arrival = np.array([m.arrival for m in messages], dtype=np.int64)
    stamp = np.array([m.stamp or -1 for m in messages], dtype=np.int64)
    values = [
        np.array([m.values for m in messages if m.topic == t], dtype=float).reshape(-1, len(signals.on(t)))
        for t in topics
    ]
    all_of_them = Sampler(signals)
    (t_ns, x, u), decisions = all_of_them.push_all(of, arrival, stamp, values)
    sampler, each, opened = Sampler(signals), list[list[Step]](), list[list[float]]()
    for message in messages:
        each.append(sampler.push(*message))
        opened += [sampler.latest()[1] for step in each[-1] if not step.status.dropped]
    clock = np.cumsum(of == topics.index(signals.clock)) - 1
    decided = zip(messages, each, clock.tolist(), strict=True)
    expected = [(m.arrival, s.t_ns, s.status.dropped, at) for m, steps, at in decided for s in steps]
    assert list(zip(*(row.tolist() for row in decisions), strict=True)) == expected
    made = [s for s in only(each) if not s.status.dropped]
    assert (t_ns.tolist(), x.tobytes()) == ([s.t_ns for s in made], np.array([s.after for s in made]).tobytes())
    assert all_of_them.counters == sampler.counters
    if not made:
        return
    later = max(max(m.arrival, m.stamp or 0) for m in messages) + max(TICK, round(signals.min_step * 1e9))
    (ended,) = sampler.push(signals.clock, later, later, (0.0,) * len(signals.on(signals.clock)))
    for i in range(n, len(signals)):
        signal, column = signals[i], [step.before[i] for step in [*made[1:], ended]]
        if signal.at != "departure" or signal.delay or signal.memory is not None:
            column[-1] = NAN
        elif signals.decided_at_once:
            column = [z[i] for z in opened] if i in signals.on(signals.clock) else [*column[:-1], NAN]
        np.testing.assert_equal(u[:, i - n], column)


def test_an_angle_that_needs_no_turn_loses_only_the_sign_of_its_zero() -> None:
    signals = SignalMap((Signal("x", "/c", "unwrap(data)"),), clock="/c", max_gap=1.0, time={"/c": "log"})
    arrival = np.arange(5) * TICK
    values = np.array([[0.1], [-0.0], [NAN], [-0.2], [-0.0]])
    (_, x, _), _ = Sampler(signals).push_all(np.zeros(5, dtype=np.int64), arrival, arrival, [values])
    np.testing.assert_array_equal(x, values)
    assert not np.signbit(x[1, 0])


@pytest.mark.parametrize("field", ["unwrap(data, 360)", "unwrap( data , 360.0 )"])
def test_an_angle_in_degrees_is_unwrapped_by_its_turn(field: str) -> None:
    """`fit` named jumps by 360 and advised `unwrap(heading)`, which took 6.28 degrees for a turn."""
    signals = SignalMap((Signal("x", "/c", field),), clock="/c", max_gap=1.0, time={"/c": "log"})
    arrival = np.arange(5) * TICK
    values = np.array([[350.0], [358.0], [6.0], [14.0], [350.0]])
    (_, x, _), _ = Sampler(signals).push_all(np.zeros(5, dtype=np.int64), arrival, arrival, [values])
    np.testing.assert_array_equal(x[:, 0], [-10.0, -2.0, 6.0, 14.0, -10.0])
    assert FieldPath(f"lag({field}, 2)").unwrap == FieldPath(f"rate({field})").unwrap == 360.0


def test_a_recording_that_does_not_fit_its_topics_is_refused() -> None:
    one, two = np.zeros(1, dtype=np.int64), np.zeros(2, dtype=np.int64)
    for topic, values in ((two, [np.zeros((1, 1)), np.zeros((0, 1))]), (one, [np.zeros((1, 2)), np.zeros((0, 1))])):
        refuses(ValueError, "fit", Sampler(two_topics()).push_all, topic, one, one, values)


@settings(max_examples=40)
@given(loops())
def test_each_pass_of_a_looped_bag_is_as_on_its_own(case: tuple[SignalMap, list[Sent]]) -> None:
    """However topics overtake each other where the passes meet; and nothing of a pass is late for the one before."""
    signals, messages = case
    both, _ = run(signals, messages)
    (begin,) = [i for i, decided in enumerate(both) for step in decided if step.status is Status.RESET]
    alone, _ = run(signals, [m for m in messages if m.arrival >= 100 * TICK])
    steps = [plain(step) for step in only(both[begin:]) if not step.status.dropped]
    wanted = [plain(step) for step in only(alone) if not step.status.dropped]
    assert steps[0] == (Status.RESET, *wanted[0][1:])
    assert steps[1:] == wanted[1:]


# --- the rules one by one ----------------------------------------------------------------------------------------


def two_topics(**options: object) -> SignalMap:
    """State on /c, control on /u, both with header stamps, max_gap 5 ticks."""
    said = dict(clock="/c", max_gap=0.05, time={"/c": "header", "/u": "header"})
    control = Signal("u", "/u", "data", max_hold=options.pop("max_hold", None), delay=options.pop("delay", 0))
    return SignalMap((Signal("x", "/c", "data"),), (control,), **(said | options))


def at(topic: str, arrival: int, stamp: int | None, value: float = 1.0) -> Sent:
    return Sent(topic, arrival * TICK, None if stamp is None else stamp * TICK, (value,))


def test_what_is_as_new_as_the_chosen_message_comes_late_and_what_is_older_does_not() -> None:
    sampler = Sampler(two_topics())
    for message in (at("/u", 5, 5), at("/c", 6, 6), at("/c", 7, 7)):
        sampler.push(*message)
    for stamp, late in ((4, 0), (5, 1), (6, 2)):
        sampler.push(*at("/u", 8, stamp))
        assert sampler.counters["late /u"] == late


def test_a_message_comes_late_for_one_of_the_last_hundred_closed_samples_alone() -> None:
    sampler = Sampler(two_topics(max_gap=1e6))
    for k in range(1, 301):
        sampler.push(*at("/u", k, k))
        sampler.push(*at("/c", k, k))
    for stamp, late in ((199, 0), (200, 1)):  # the sample at 300 is open
        sampler.push(*at("/u", 301, stamp))
        assert sampler.counters["late /u"] == late


STEPS_BACK = [
    "c105 u106 u101 c107 c108",
    "c101 u101 u52 u103 c54 u55 c7",
    "u50 u1 c6 u11 u12 u-33 u19 c21 c23 c28",
    "u100 c100 u50 c50 c52 u58 u51 c53",  # back with the clock and before it: the sample keeps what it had
    "c104 c51 u51 u54 u7 c54",  # back after the clock, and not to follow it: likewise
]
"""Stamps that tell a rule of a step back from its neighbour; so few streams do that drawn ones seldom show it."""


@pytest.mark.parametrize("stamps", STEPS_BACK)
def test_stated_steps_back_follow_the_rules(stamps: str) -> None:
    messages = [at(f"/{one[0]}", 100 + k, int(one[1:]), float(k)) for k, one in enumerate(stamps.split())]
    hold_against(Reference(two_topics(), messages, forgets=True), two_topics(), messages)


@pytest.mark.parametrize("control_first", [True, False])
def test_nothing_of_a_step_back_of_time_stays_once_it_is_over(control_first: bool) -> None:
    """Otherwise a hundred old messages are kept and looked through at every sample from there on."""
    sampler = Sampler(two_topics())
    for _ in range(3):
        for k in range(100, 150):
            pair = [at("/u", k, k), at("/c", k, k)]
            for message in pair if control_first else reversed(pair):
                sampler.push(*message)
        assert len(sampler.kept("/u")) <= 2
    assert sampler.counters["resets"] == 2


def test_of_a_topic_whose_time_alone_stepped_back_a_hundred_messages_are_kept() -> None:
    sampler = Sampler(two_topics())
    for k in range(400):
        for message in (at("/u", 100 + k, k or 1000), at("/c", 100 + k, 1000 + k)):
            sampler.push(*message)
        assert len(sampler.kept("/u")) <= KEPT_OVER_A_JUMP
    assert sampler.counters["late /u"] == 397
    sampler = Sampler(two_topics())
    for message in (at("/c", 100, 100), at("/c", 101, 101), at("/c", 102, 1), at("/u", 103, 1), at("/c", 104, 2)):
        sampler.push(*message)
    assert not any(name.startswith("late") for name in sampler.counters)  # for a sample of before, which had none


@settings(max_examples=40)
@given(cases())
def test_latest_changes_nothing_and_is_what_would_be_fixed_now(case: tuple[SignalMap, list[Sent]]) -> None:
    signals, messages = case
    quiet, watched, closing = Sampler(signals), Sampler(signals), Sampler(signals)
    assert watched.latest() is None
    seen: list[Step] = []
    for message in messages:
        steps = watched.push(*message)
        assert [plain(s) for s in quiet.push(*message)] == [plain(s) for s in steps]
        closing.push(*message)
        seen = seen + [s for s in steps if not s.status.dropped]
        latest = watched.latest()
        if latest is None or not signals.decided_at_once:
            continue
        assert seen[-1].t_ns == latest[0]
        assert np.array_equal(seen[-1].x_next, latest[1][: len(signals.states)], equal_nan=True)
    if latest := watched.latest():
        far = latest[0] + 10**12
        values = [0.0] * len(signals.on("/c"))
        if signals.decided_at_once:
            given = np.delete(np.arange(len(signals)), signals.arrivals)[len(signals.states) :]
            step = closing.push("/c", far, far, values)[-1]
            assert np.array_equal(np.array(step.before)[given], np.array(latest[1])[given], equal_nan=True)
    assert watched.counters == quiet.counters


def flooded(clock: str = "header") -> Sampler:
    """A sample is open, a control is held at it, and more controls have come than are kept."""
    sampler = Sampler(two_topics(max_gap=1e6, time={"/c": clock, "/u": "header"}))
    sampler.push("/u", 1, 1, [-7.0])
    sampler.push("/c", 2, 2, [0.0])
    for stamp in range(3, 3 * BUFFERED_MESSAGES):
        sampler.push("/u", stamp, stamp, [float(stamp)])
        if stamp % (BUFFERED_MESSAGES // 10) == 2:  # half of them go as 10002 comes
            assert len(kept := sampler.kept("/u")) <= BUFFERED_MESSAGES and kept[-1][0] == stamp
    return sampler


@pytest.mark.parametrize("clock", ["header", "log"])
def test_the_held_value_outlives_any_number_of_messages_while_its_sample_is_open(clock: str) -> None:
    sampler = flooded(clock)
    (step,) = sampler.push("/c", 10**6, 10**6, [0.0])
    assert step.u.tolist() == [-7.0] and step.status is Status.OK
    (step,) = sampler.push("/c", 2 * 10**6, 2 * 10**6, [0.0])
    assert step.u.tolist() == [3 * BUFFERED_MESSAGES - 1.0]


def test_ten_thousand_messages_wait_for_a_sample_and_of_one_more_the_later_half_stays() -> None:
    sampler = Sampler(two_topics())
    for k in range(1, 10_001):
        sampler.push(*at("/u", k, k))
    assert len(sampler.kept("/u")) == 10_000
    sampler.push(*at("/u", 10_001, 10_001))
    assert len(sampler.kept("/u")) == 5_001


def test_what_has_been_forgotten_is_missing_and_not_replaced_by_something_older() -> None:
    """A clock so late that more messages arrive before it than are kept."""
    sampler = flooded()
    end = 3 * BUFFERED_MESSAGES
    steps = [sampler.push("/c", end + k, stamp, [0.0])[0] for k, stamp in enumerate([100, end - 5, end - 1])]
    assert [s.u.tolist() for s in steps[:1]] == [[-7.0]]
    assert math.isnan(steps[1].u[0]) and steps[1].status is Status.MISSING
    assert steps[2].u.tolist() == [end - 5.0]
    assert sampler.counters["missing u"] == 1


@pytest.mark.parametrize(
    ("controls", "clock", "found"),
    [
        ([(3, 3), (4, 9), (5, 4), (6, 5), (7, 10)], [(20, 9), (60, 21)], math.nan),
        ([*((k, k) for k in range(3, 9)), (19, None)], [(20, 20), (60, 21), (61, 22)], 19.0),
    ],
)  # fmt: skip
def test_what_has_been_forgotten_matters_until_a_sample_finds_something_newer(
    monkeypatch: pytest.MonkeyPatch, controls: Any, clock: Any, found: float
) -> None:
    """(4, 9) is newer than what is kept; the age of 19, which has no stamp, goes by arrivals, which jitter."""
    monkeypatch.setattr(sampler_module, "BUFFERED_MESSAGES", 4)
    sampler = Sampler(two_topics(max_gap=1e6))
    sampler.push("/c", 2, 2, [0.0])
    for arrival, stamp in controls:
        sampler.push("/u", arrival, stamp, [float(arrival)])
    *_, (step,) = [sampler.push("/c", arrival, stamp, [0.0]) for arrival, stamp in clock]
    np.testing.assert_array_equal(step.u, [found])


@settings(max_examples=40)
@given(case=cases() | cases(tame=True), room=st.integers(4, 8))
def test_little_room_makes_values_missing_and_never_wrong(case: tuple[SignalMap, list[Sent]], room: int) -> None:
    signals, messages = case
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sampler_module, "KEPT_OVER_A_JUMP", 0)  # else others are kept
        patch.setattr(sampler_module, "BUFFERED_MESSAGES", room)
        sampler = Sampler(signals)
        cramped = [sampler.push(*message) for message in messages]
        assert all(len(sampler.kept(topic)) <= room for topic in signals.topics)
    sampler = Sampler(signals)
    roomy = [sampler.push(*message) for message in messages]
    for mine, theirs in zip(only(cramped), only(roomy), strict=True):
        assert (mine.t_ns, mine.arrival_ns) == (theirs.t_ns, theirs.arrival_ns)
        assert mine.status is theirs.status or mine.status is Status.MISSING
        for left, right in ((mine.x, theirs.x), (mine.u, theirs.u), (mine.x_next, theirs.x_next)):
            assert all(math.isnan(a) or a == b for a, b in zip(left, right, strict=True))


def test_max_skew_that_limits_nothing_is_an_error() -> None:
    signals = SignalMap((Signal("x", "/c", "data"),), (Signal("u", "/u", "data"),), max_skew=0.1)
    with pytest.raises(SignalError, match="all states are on /c; leave it out"):
        resolve(signals, {"/c": [np.arange(9) * TICK], "/u": [np.arange(9) * TICK]}, {"/c": "log", "/u": "log"})


# --- what a signals file leaves open -------------------------------------------------------------------------


@given(st.lists(st.lists(st.integers(0, 60), max_size=20), min_size=1, max_size=3), st.integers(0, 12))
def test_the_median_step_is_that_of_the_samples(recordings: list[list[int]], min_step: int) -> None:
    """Over the instants that a sampler without a limit on steps back keeps."""
    steps: list[int] = []
    for instants in recordings:
        last = None
        for instant in instants:
            if last is not None and (instant == last or 0 < instant - last < min_step):
                continue
            if last is not None and instant > last:
                steps.append(instant - last)
            last = instant
    found = median_step_ns([np.array(i, dtype=np.int64) for i in recordings], min_step)
    assert found == (int(np.median(steps)) if steps else None)


def test_min_step_thins_a_fast_stream_out() -> None:
    """500 Hz thinned to 100 Hz: max_gap is then 2.5 x 10 ms, not of the steps that were dropped."""
    signals = SignalMap((Signal("x", "/c", "data"),), min_step=0.01)
    resolved = resolve(signals, {"/c": [np.arange(0, 10**9, 2_000_000)]}, {"/c": "log"})
    assert resolved.max_gap == pytest.approx(0.025)


@pytest.mark.parametrize("lengths", [(2,), (40,), (2, 40), (900, 2)])
def test_a_constant_step_is_the_period_of_recordings_of_any_length(lengths: tuple[int, ...]) -> None:
    signals = SignalMap((Signal("x", "/c", "data"),), step="constant")
    resolved = resolve(signals, {"/c": [np.arange(count) * TICK for count in lengths]}, {"/c": "log"})
    assert resolved.step == pytest.approx(0.01)


def test_a_lost_sample_is_a_gap_where_memories_look_back_over_it_but_jitter_is_none() -> None:
    recalls = SignalMap((Signal("x", "/c", "data"), Signal("before", "/c", "lag(data, 1)")))
    even = np.arange(1000) * TICK
    even[500:] += TICK
    for signals, instants, steps in (
        (recalls, even, 1.5),
        (replace(recalls, controls=()), even, 2.5),
        (recalls, np.cumsum(np.where(np.arange(1000) % 50 == 0, 2, 1)) * TICK, 2.5),
        (replace(recalls, max_gap=2 * TICK * 1e-9), even, 2.0),
    ):
        assert resolve(signals, {"/c": [instants]}, {"/c": "log"}).max_gap == pytest.approx(steps * TICK * 1e-9)


def test_resolve_takes_the_slowest_state_topic_and_two_and_a_half_of_its_median_step() -> None:
    signals = SignalMap((Signal("a", "/fast", "data"), Signal("b", "/slow", "data")), (Signal("u", "/slower", "data"),))
    instants = {
        "/fast": [np.arange(0, 100) * TICK],
        "/slow": [np.array([0, 3, 6, 6, 9, 50]) * TICK, np.array([7, 4, 9]) * TICK],
        "/slower": [np.arange(0, 100, 50) * TICK],
    }
    resolved = resolve(signals, instants, {"/fast": "header", "/slow": "log", "/slower": "log"})
    assert resolved.clock == "/slow"
    assert resolved.max_gap == pytest.approx(2.5 * 3 * TICK * 1e-9)
    assert resolved.time == {"/fast": "header", "/slow": "log", "/slower": "log"}
    said = replace(signals, clock="/fast", max_gap=7.0)
    assert resolve(said, instants, resolved.time) == replace(said, time=resolved.time)


@pytest.mark.parametrize("missing", ["clock", "max_gap", "time"])
def test_an_unresolved_map_is_refused(missing: str) -> None:
    signals = replace(two_topics(), **{missing: {} if missing == "time" else None})
    refuses(SignalError, "resolved", Sampler, signals)
