"""Course: a watch whose messages come in order, complete and within their bounds, in compiled code.

That is what nearly every message is like, and Python takes several times as long over it as the middleware takes to
deliver it. What is not like that is refused, and `Watch` goes on from where things stand. Without a C compiler at the
installation the compiled part is absent; then `Watch` does everything.
"""

from __future__ import annotations

import math
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

from uncertain_lti.sampler import LONGEST_NS, all_finite, to_ns
from uncertain_lti.verdict_messages import JUDGED, NamedVector
from uncertain_lti_ros.layout import Plan
from uncertain_lti_ros.snapshot import Entry
from uncertain_lti_ros.watch import Watch

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

Send = Callable[[bytes], None]


def why_not() -> str:
    """What keeps the compiled part from being used, in words; empty where nothing does."""
    return _why_not


@dataclass(frozen=True, slots=True)
class Contained:
    """What a `Verdict` tells of a sample within its bounds; vectors as little-endian doubles."""

    t_ns: int
    outside_domain: bool
    lower: bytes
    upper: bytes
    state: bytes
    utilisation: bytes
    judged: ClassVar[bool] = True

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.state) // 8

    def packed(self, name: str) -> bytes:
        """One of `NUMBERS`."""
        return bytes(len(self.state)) if name == "flags" else bytes(getattr(self, name))


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
    take : dict
        Of each topic what takes a serialised message; False where it is left to the watch.
    """

    def __init__(self, watch: Watch, plain: NamedVector, marked: NamedVector) -> None:
        self.watch, self.monitor = watch, watch.monitor
        sampler, model, rule = watch.sampler, watch.model, watch.monitor.rule
        self._topics = [sampler.clock, *(t for t in model.signals.topics if t != sampler.clock)]
        places = []
        for topic in self._topics:
            where, ages = sampler.places(topic)
            header = model.signals.time[topic] == "header"
            places.append((header, _integers(where), _integers(ages)))
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
        )
        self.began = False
        self._log: list[tuple[float, int, int, bytes, tuple[Any, ...] | None]] = []
        self.take: dict[str, Callable[[bytes], bool]] = {
            topic: partial(self._course.other, k) if k else self._course.sample for k, topic in enumerate(self._topics)
        }

    def resume(self, sends: Mapping[str, Send], arrival: Callable[[], int] | None, remember: bool) -> bool:
        """Go on from where the watch stands, if all is calm and in order.

        sends: of the outputs that are listened to. arrival: tells the time, ns, where that is not the computer's.
        remember: what comes is wanted from `entries`.
        """
        watch = self.watch
        dt = watch.model.sampling.dt_median
        usual = dt is None or to_ns(dt) < LONGEST_NS  # further on there is no stamp for what is predicted
        standing = watch.sampler.standing() if usual and watch.calm else None
        plans = [watch.plan(topic) for topic in self._topics]
        if standing is None or None in plans or not all_finite(standing.sample[1]):
            return False
        if any(len(kept) > _KEPT for *_, kept in standing.topics.values()):
            return False
        topics = []
        for topic, plan in zip(self._topics, plans, strict=True):
            assert plan is not None
            last, closed, kept = standing.topics.get(topic, (None, None, ()))
            messages = [(*told, _doubles(values)) for told, values in kept]
            topics.append((_layout(plan), last, closed, messages))
        told, values = standing.sample
        self._course.listen(tuple(sends.get(name) for name in OUTPUTS))
        self._course.resume((*told, _doubles(values)), tuple(topics), arrival, self._log if remember else None)
        self.began = True
        return True

    def count(self) -> float:
        """Tell the watch what has been counted; returns when ~/violation was last sent, 0 for not since then."""
        samples, outside, judged, published, topics = self._course.counts()
        self.watch.have_been_contained(samples, outside, judged, dict(zip(self._topics, topics, strict=True)))
        return float(published)

    def entries(self) -> Iterator[Entry]:
        """What came since the last call, and what was said of it."""
        for now, arrival_ns, k, data, said in self._log:
            yield Entry(now, arrival_ns, self._topics[k], data, () if said is None else (Contained(*said),), False)
        self._log.clear()

    def settle(self) -> Exception | None:
        """Hand everything over to the watch; returns what an output raised, if one did."""
        self.began = False
        told, values, dt, z, topics, failure = self._course.pause()
        step = self.watch.sampler.go_on(
            (told, values), dict(zip(self._topics[1:], topics, strict=True)), None if z is None else (dt, z)
        )
        if step is not None:
            self.watch.last = self.monitor.look(step)
        raised: Exception | None = failure
        return raised


def _integers(values: list[int]) -> bytes:
    return struct.pack(f"<{len(values)}q", *values)


def _doubles(values: Any) -> bytes:
    return np.asarray(values, dtype="<f8").tobytes()


def _layout(plan: Plan) -> tuple[bytes, bytes, int, bytes, bytes]:
    offsets = _integers([offset for offset, _ in plan.places])
    return plan.mask, plan.want, plan.stamp, offsets, "".join(code for _, code in plan.places).encode()
