"""Course: a watch whose messages come in order and complete, in compiled code.

That is what nearly every message is like, and Python takes several times as long over it as the middleware takes to
deliver it. What is not like that, and what turns the alarm, is refused, and `Watch` goes on from where things stand.
Without a C compiler at the installation the compiled part is absent; then `Watch` does everything.
"""

from __future__ import annotations

import math
import operator
import os
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar
from zlib import crc32

import numpy as np

from uncertain_lti.monitor.arming import Condition
from uncertain_lti.monitor.session import Watch
from uncertain_lti.monitor.snapshot import Entry
from uncertain_lti.monitor.verdict_messages import JUDGED, NamedVector
from uncertain_lti.recordings.message_reader import Plan
from uncertain_lti.sampling.sampler import LONGEST_NS, Status, Step, all_finite, to_ns

_course: Any = None
try:
    _course = import_module("uncertain_lti_ros._course")
except ImportError:
    _why_not = "its compiled part is not installed"
else:
    _why_not = ""
    _source = Path(__file__).with_name("_course.c")  # in a checkout; it may have changed since it was compiled
    if _source.exists() and crc32(_source.read_bytes()) != _course.SOURCE:
        _why_not = "its compiled part is of another version, and should be installed again"
    if os.environ.get("UNCERTAIN_LTI_PURE_PYTHON"):
        _why_not = "UNCERTAIN_LTI_PURE_PYTHON is set"

OUTPUTS = ("flags", *JUDGED, "predicted_lower", "predicted_upper", "violation")
"""In the order in which they are sent."""
_KEPT = 256  # messages of a topic that are handed over at most
_LONGEST = 10_000  # window of the alarm, and delay of a control
_MOST_TOPICS = 64
_RELATIONS = ("==", "!=", "<=", ">=", "<", ">")

Send = Callable[[bytes], None]


def why_not() -> str:
    """What keeps the compiled part from being used, in words; empty where nothing does."""
    return _why_not


@dataclass(frozen=True, slots=True)
class Judged:
    """What a `Verdict` tells of a sample; vectors as little-endian doubles."""

    t_ns: int
    outside_domain: bool
    lower: bytes
    upper: bytes
    state: bytes
    utilisation: bytes
    flags: bytes
    judged: ClassVar[bool] = True

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.state) // 8

    def packed(self, name: str) -> bytes:
        """One of `NUMBERS`."""
        return bytes(getattr(self, name))


class Course:
    """One watch under one alarm rule; only where `why_not` has nothing to say.

    Parameters
    ----------
    watch : Watch
    plain, marked : NamedVector
        Messages of the states without and with velocities.

    Attributes
    ----------
    began : bool
        Messages have been taken here since the watch last went on itself.
    taken : int
        Samples judged here since then, as far as they have been counted.
    take : dict
        Of each topic what takes a serialised message; False where it is left to the watch.
    """

    def __init__(self, watch: Watch, plain: NamedVector, marked: NamedVector) -> None:
        self.watch, self.monitor = watch, watch.monitor
        sampler, model, rule = watch.sampler, watch.model, watch.monitor.rule
        self._topics = [sampler.clock, *(t for t in model.signals.topics if t != sampler.clock)]
        places = []
        for topic in self._topics:
            header = model.signals.time[topic] == "header"
            places.append((header, *map(_integers, sampler.places(topic))))
        dt = model.sampling.dt_median
        self._course = _course.Course(
            n=model.n,
            size=model.n + model.m,
            rows=b"".join(_doubles(row) for row in watch.monitor.rows),
            point=b"".join(_doubles(row) for row in watch.monitor.point),
            margin=rule.margin,
            max_gap=sampler.max_gap_ns,
            min_step=sampler.min_step_ns,
            usual_step=-1 if dt is None else to_ns(dt),
            usual_dt=math.nan if dt is None else dt,
            plain=(plain.template, plain.position),
            marked=(marked.template, marked.position, marked.velocity),
            topics=tuple(places),
            several=not sampler.one_topic,
            delays=tuple(sampler.delays),
            counted=watch.monitor.counted,
            alarm=(rule.violations, rule.window),
        )
        self._layouts: dict[str, tuple[Any, tuple[Any, ...] | None]] = {}  # what it was made from, and the layout
        self.began, self.taken = False, 0
        self._log: list[tuple[float, int, int, bytes, tuple[Any, ...] | None]] = []
        self.take: dict[str, Callable[[bytes], bool]] = {
            topic: partial(self._course.other, k) if k else self._course.sample for k, topic in enumerate(self._topics)
        }

    @staticmethod
    def can(watch: Watch) -> bool:
        """Whether there can be one at all."""
        rule, signals = watch.monitor.rule, watch.model.signals
        longest = max((rule.window, *(c.delay for c in signals.controls)))
        return longest <= _LONGEST and len(signals.topics) <= _MOST_TOPICS

    def resume(self, sends: Mapping[str, Send], arrival: Callable[[], int] | None, remember: bool) -> bool:
        """Go on from where the watch stands, if messages have come in order.

        sends: of the outputs that are listened to. arrival: tells the time, ns, where that is not the computer's.
        remember: what comes is wanted from `entries`.
        """
        watch, monitor = self.watch, self.monitor
        dt, counts_from = watch.model.sampling.dt_median, watch.arming.counts_from
        usual = dt is None or to_ns(dt) < LONGEST_NS  # further on there is no stamp for what is predicted
        standing = watch.sampler.standing() if usual and counts_from is not None else None
        if standing is None or not all_finite(standing.sample[1]):
            return False
        if any(len(kept) > _KEPT for *_, kept in standing.topics.values()):
            return False
        layouts = [self._layout(topic) for topic in self._topics]
        if None in layouts:
            return False
        topics = []
        for topic, layout in zip(self._topics, layouts, strict=True):
            last, closed, kept = standing.topics.get(topic, (None, None, ()))
            messages = [(*told, _doubles(values)) for told, values in kept]
            topics.append((layout, last, closed, messages, _doubles(standing.previous[topic])))
        told, values = standing.sample
        self._course.listen(tuple(sends.get(name) for name in OUTPUTS))
        self._course.resume(
            (*told, _doubles(values), standing.dt, _doubles(standing.before)),
            tuple(topics),
            tuple(_doubles(line) for line in standing.lines),
            (monitor.window, monitor.alarm, watch.alarm, counts_from),
            arrival,
            self._log if remember else None,
        )
        self.began, self.taken = True, 0
        return True

    def _layout(self, topic: str) -> tuple[Any, ...] | None:
        """How the messages of a topic look, as the compiled part takes it; None where that is not known or simple."""
        watch = self.watch
        plan = watch.plan(topic)
        condition, conditional = watch.arming.condition, None
        if condition is not None and topic == watch.enable_topic:
            conditional = watch.plan_of_condition
            if conditional is None or watch.arming.on is None:
                return None
        if plan is None:
            return None
        key = plan, conditional, watch.arming.on
        if self._layouts.get(topic, (None,))[0] != key:
            self._layouts[topic] = key, _packed(plan, condition, conditional, bool(watch.arming.on))
        return self._layouts[topic][1]

    def count(self) -> float:
        """Tell the watch what has been counted; returns when ~/violation was last sent, 0 for not since then."""
        samples, outside, violations, judged, published, topics = self._course.counts()
        self.taken += samples
        of_each = struct.unpack(f"<{self.watch.model.n}q", violations)
        self.watch.have_been_judged(samples, outside, of_each, judged, dict(zip(self._topics, topics, strict=True)))
        return float(published)

    def entries(self) -> Iterator[Entry]:
        """What came since the last call, and what was said of it."""
        alarm = self.watch.alarm
        for now, arrival_ns, k, data, said in self._log:
            yield Entry(now, arrival_ns, self._topics[k], data, () if said is None else (Judged(*said),), alarm)
        self._log.clear()

    def settle(self) -> Exception | None:
        """Hand everything over to the watch; returns what an output raised, if one did."""
        self.began = False
        watch = self.watch
        topics, cut, failure = self._course.pause()
        told = dict(zip(self._topics, topics, strict=True))
        watch.sampler.go_on(
            {topic: others[:3] for topic, others in told.items() if topic != watch.sampler.clock},
            {topic: others[3] for topic, others in told.items()},
        )
        for *_, said in topics:
            if said is not None:
                watch.arming.learn(said)  # nothing new, but the number
        if cut is not None:
            sample, values, open_dt, before, lines, window, t_ns, arrival, dt, z, x_next = cut
            watch.sampler.go_on_from((sample, values), open_dt, before, lines)
            self.monitor.go_on(window)
            watch.last = self.monitor.look(Step(Status.OK, t_ns, arrival, dt, z, x_next))
        raised: Exception | None = failure
        return raised


def _integers(values: list[int]) -> bytes:
    return struct.pack(f"<{len(values)}q", *values)


def _doubles(values: Any) -> bytes:
    return np.asarray(values, dtype="<f8").tobytes()


def _packed(plan: Plan, condition: Condition | None, conditional: Plan | None, on: bool) -> tuple[Any, ...] | None:
    """A layout as the compiled part takes it, with what the enable condition wants of the same message."""
    mask, want, said = plan.mask, plan.want, None
    if conditional is not None:
        assert condition is not None
        ((places, made_by),) = conditional.values
        mask, want = (_either(some, other) for some, other in ((mask, conditional.mask), (want, conditional.want)))
        alike = len(plan.mask) == len(conditional.mask) and _both(plan, want) and _both(conditional, want)
        if made_by is not None or not alike:
            return None
        ((offset, code),) = places
        said = offset, code, _RELATIONS.index(condition.operator), condition.value, on
    numbers = [place for places, _ in plan.values for place in places]
    return (
        mask,
        want,
        plan.stamp,
        _integers([len(places) for places, _ in plan.values]),
        _integers([offset for offset, _ in numbers]),
        "".join(code for _, code in numbers).encode(),
        tuple(made_by for _, made_by in plan.values),
        said,
    )


def _either(some: bytes, others: bytes) -> bytes:
    return bytes(map(operator.or_, some, others))


def _both(plan: Plan, want: bytes) -> bool:
    """Whether a message that looks like this is of the plan's kind."""
    return bytes(map(operator.and_, plan.mask, want)) == plan.want
