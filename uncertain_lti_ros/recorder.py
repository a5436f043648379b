# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""`uncertain-lti record`: topics, as they are published, to an MCAP file."""

from __future__ import annotations

import argparse
import math
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import nullcontext, suppress
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import yaml
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile

from uncertain_lti.base.errors import BagError
from uncertain_lti.base.files import target
from uncertain_lti.base.text import plural, shortlist
from uncertain_lti.cli.command import Result
from uncertain_lti.monitor.catch_up import LATE, STALL, CatchUp, arrival_of
from uncertain_lti.monitor.snapshot import BACK_NS
from uncertain_lti.recordings.mcap_writer import McapWriter
from uncertain_lti_ros.process import ArgumentError, Life, living, resolved_name, seconds
from uncertain_lti_ros.topics import CLOCK, POLL, MatchedSubscription, SimulatedTime, definition

_FLUSH = 2.0  # s; what is older is on the disk, whatever happens to the process
_LOOK = 0.5  # s between two looks at the graph
_PAUSED = 2.0  # s without a tick of /clock
_LONGEST = 6.0  # s that messages wait for others that were held up
_CLOCK = 60.0  # s later than ever: no message was on its way for so long, a clock was set


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `uncertain-lti record`."""
    parser.add_argument("topics", nargs="+", metavar="TOPIC", help="topic to record; waited for until it is there")
    parser.add_argument("--output", "-o", required=True, metavar="BAG", help="MCAP file to write; must not exist yet")
    parser.add_argument("--duration", type=seconds, metavar="S", help="stop S seconds after the first message")
    parser.add_argument("--wait", type=seconds, metavar="S", help="give up when a topic is not there after S seconds")
    parser.add_argument("--use-sim-time", action="store_true", help="take log times from /clock")
    parser.add_argument(
        "--note", action="append", default=[], type=_note, metavar="NAME=TEXT",
        help="write this to the file too, in a metadata record; may be given several times",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print what was recorded as JSON")
    parser.add_argument("-q", "--quiet", action="store_true", help="print errors only (and with --json the data)")


def run(args: argparse.Namespace) -> Result:
    """Record until a signal of `endings` or the end of the duration; the file is whole or not there.

    While recording it is called BAG.part, with all but the last seconds readable.
    """
    output = Path(args.output)
    if output.name in ("", ".."):
        raise ArgumentError(f"--output {args.output!r} names no file; give one, as in run.mcap")
    if output.suffix != ".mcap":
        output = output.with_name(f"{output.name}.mcap")
    simulated: bool = args.use_sim_time
    with living(lambda: Node(f"uncertain_lti_recorder_{os.getpid()}")) as life, _File(output, dict(args.note)) as file:
        topics = list(dict.fromkeys(resolved_name(life.node, topic) for topic in args.topics))
        named, asked = shortlist(topics), topics + [CLOCK] * simulated
        types = _wait_for(life, asked, args.wait, args.progress.note)
        taken = _InOrder(file, topics, SimulatedTime(life.node) if simulated else None)
        subscriptions = [_subscribe(life.node, topic, types[topic], file, taken) for topic in topics]
        (args.progress.note if args.json else args.say)(f"recording {named} to {output}; stop with Ctrl-C")
        stage = args.progress.stage("recording") if args.progress.shown else nullcontext(lambda _: None)
        with stage as step:
            _record(life, subscriptions, file, taken, args.duration, step, args.progress.note)
        if taken.back:
            args.progress.note(taken.back)
        if taken.fell_ns:
            whose, times = (CLOCK, "stand still there") if simulated else ("this machine's clock", "go on all the same")
            by = f"{whose} went back by up to {taken.fell_ns * 1e-9:.2g} s"
            args.progress.note(f"{by}: log times {times}, and `check` may judge otherwise than a node")
        if not file.count:
            came = f"no message came on {named}{f' after a time on {CLOCK}' * simulated}"
            raise BagError(f"{output}: not written, {came}; check who publishes")
    lost = sum(subscription.lost for subscription in subscriptions)
    on_the_way = f", {lost} lost on the way" if lost else ""
    if taken.late:
        each = shortlist([f"{count} of {topic}" for topic, count in taken.late.most_common()], 5)
        after = f"came up to {taken.latest:.2g} s after others that were sent later, and fits and checks take them so"
        on_the_way += f"; {each} {after}: record again on a less busy machine, or fewer topics"
    counted = f"{plural(file.count, 'message')} of {plural(len(subscriptions), 'topic')}"
    args.say(f"{output}: {counted} over {file.span:.1f} s{on_the_way}")
    counts = {"messages": file.count, "topics": file.counts, "span_s": file.span, "lost": lost, "late": taken.late}
    return Result(data={"bag": str(output), **counts})


def _wait_for(life: Life, topics: list[str], limit: float | None, note: Callable[[str], None]) -> dict[str, str]:
    """Type of each topic, as soon as all are there."""
    there: dict[str, list[str]] = {}
    missing = list(topics)

    def found() -> bool:
        there.clear()
        there.update(life.node.get_topic_names_and_types())
        missing[:] = [topic for topic in topics if topic not in there]
        for topic in topics:
            if len(there.get(topic, ())) > 1:
                raise BagError(f"{topic}: is published as {' and '.join(there[topic])}; record one type at a time")
        return not missing

    limit = math.inf if limit is None else limit
    if not life.until(found, min(1.0, limit)) and life.alive and limit > 1.0:
        note(f"waiting for {shortlist(missing)}")
        life.until(found, limit - 1.0)
    if missing:
        since = f" after {limit:g} s" if life.alive else ", and was waited for, so nothing is recorded"
        raise BagError(f"{shortlist(missing)}: not there{since}; start what publishes it")
    return {topic: there[topic][0] for topic in topics}


def _subscribe(node: Node, topic: str, type_name: str, file: _File, taken: _InOrder) -> MatchedSubscription:
    file.channel(topic, type_name, [info.qos_profile for info in node.get_publishers_info_by_topic(topic)])
    return MatchedSubscription(node, topic, type_name, partial(taken.take, topic))


def _record(
    life: Life, subscriptions: list[MatchedSubscription], file: _File, taken: _InOrder, duration: float | None,
    step: Callable[[str], None], note: Callable[..., None],
) -> None:  # fmt: skip
    patient = time.monotonic() + _PAUSED

    def look() -> None:
        for subscription in subscriptions:
            subscription.look()
            note(*subscription.problems)
        if taken.clock is None and life.node.count_publishers(CLOCK):
            note(f"log times are not those of {CLOCK}; --use-sim-time takes them from it")
        if taken.clock is not None and not taken.clock() and time.monotonic() >= patient:
            note(f"nothing is recorded before a time comes on {CLOCK}; is the simulation paused?")

    def poll() -> None:
        taken.release()
        for subscription in subscriptions:
            subscription.poll()
        if any(s.look_soon for s in subscriptions):
            look()

    def over() -> bool:
        file.hold()
        step(f"{file.count} messages, {file.span:.1f} s")
        limit = math.inf if duration is None or file.began is None else file.began + duration
        return bool(taken.back) or time.monotonic() >= limit

    steady = Clock(clock_type=ClockType.STEADY_TIME)  # a clock that is set back must not stop these
    for period, task in ((POLL, poll), (_LOOK, look), (_FLUSH, file.flush)):
        life.node.create_timer(period, task, clock=steady)
    life.until(over)
    taken.release(all_of_them=True)
    file.hold()


class _InOrder:
    """Messages as they come to a file; at the start and after a stall, what was held up in the order of sending.

    A process that stood still, or joins publishers that kept messages for it, gets the rest later, one topic after
    another; the live node puts that in order too.

    `clock`: gives log times, ns; None for the time of the system; `fell_ns`: by how much it fell at most; `late`: how
    many came after others that were sent over `LATE` later, and stayed so; `latest`: s at most; `back`: why it ends.
    """

    def __init__(self, file: _File, topics: Iterable[str], clock: Callable[[], int] | None) -> None:
        self._file, self._began_ns = file, time.time_ns()
        self.clock, self._logged_ns, self.back, self.fell_ns = clock, 0, "", 0
        self._ahead_ns = 0  # of log times, as the system's clock was set back
        self._came, self._least = -math.inf, dict[str, float]()
        self._heard = dict.fromkeys(topics, -math.inf)
        self._waiting: CatchUp | None = None
        self._newest_ns = 0
        self.late, self.latest = Counter[str](), 0.0

    def take(self, topic: str, data: bytes, sent_ns: int, received_ns: int) -> None:
        """Take one message, as the middleware gives it."""
        now, taken_ns = time.monotonic(), time.time_ns()
        log_ns = arrival_of(received_ns, taken_ns, self._logged_ns) if self.clock is None else self.clock()
        # what follows would lie among what was recorded
        if self.clock is not None and log_ns < self._logged_ns - BACK_NS and not self.back:
            to = f"from {self._logged_ns * 1e-9:.9g} to {log_ns * 1e-9:.9g} s"
            self.back = f"{CLOCK} went back {to}, so the recording ends there; record what follows to another file"
        if self.back or log_ns <= 0:  # no time has come on /clock
            return
        fell_ns = max(0, self._logged_ns - log_ns)
        self.fell_ns = max(self.fell_ns, fell_ns)
        self._ahead_ns += fell_ns if self.clock is None else 0
        self._logged_ns = log_ns if self.clock is None else log_ns + fell_ns
        log_ns += self._ahead_ns
        self._file.began = self._file.began or now
        way = (taken_ns - sent_ns) * 1e-9 if sent_ns else 0.0
        if now - self._came > STALL and self._waiting is None:
            lately = [other for other, heard in self._heard.items() if heard >= self._came - STALL]
            self._waiting = CatchUp(lately, _LONGEST, start=False)
        self._came = self._heard[topic] = now
        if self._waiting is not None:
            self._waiting.put((topic, log_ns, data), sent_ns, way, now)
        else:
            self._file.write(topic, log_ns, data)
        if sent_ns <= self._began_ns:
            return  # it is late for a good reason
        least = min(way, self._least.get(topic, way))
        least = self._least[topic] = way if way - least > _CLOCK else least
        by, sent_ns = way - least, sent_ns + (round(least * 1e9) if abs(least) > LATE else 0)  # by another clock
        behind = (self._newest_ns - sent_ns) * 1e-9
        self._newest_ns = max(self._newest_ns, min(sent_ns, taken_ns))
        if self._waiting is None and behind > LATE and by > LATE:
            self.late[topic] += 1
            self.latest = max(self.latest, behind)

    def release(self, all_of_them: bool = False) -> None:
        """Write what waits, once all topics come in time again."""
        if (waiting := self._waiting) is not None:
            now = time.monotonic()
            for message in waiting.finish(now) if all_of_them else waiting.ready(now):
                self._file.write(*message)
            if waiting.over:
                self._waiting = None


class _File:
    """MCAP file that gets its name only once it is whole."""

    def __init__(self, path: Path, notes: dict[str, str]) -> None:
        self.path, self._notes = path, notes
        self._part = path.with_name(f"{path.name}.part")
        self.count = 0
        self.counts: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self.began: float | None = None
        self._first = self._last = 0
        self._full: BagError | None = None

    def __enter__(self) -> _File:
        for path in (self.path, self._part):
            if path.exists():
                raise BagError(f"{path}: is there already; choose another output or move it away")
        target(self.path, holds=b"", kind="recording", example="run.mcap")
        try:
            self._stream: BinaryIO = open(self._part, "xb")
        except OSError as error:
            raise BagError(f"{self._part}: cannot be written: {error.strerror}; choose another output") from None
        self._writer = McapWriter(self._stream, "uncertain-lti")
        if self._notes:
            self._writer.metadata("uncertain_lti", self._notes)
        return self

    def __exit__(self, *_: Any) -> None:
        try:
            if self.count:
                self._writer.finish()
                self._stream.flush()
                os.fsync(self._stream.fileno())
            self._stream.close()
            if self.count and self.path.exists():
                raise BagError(f"{self.path}: came while recording; what was recorded is in {self._part}")
            if self.count:
                os.replace(self._part, self.path)
            else:
                self._part.unlink()
        except OSError as error:
            with suppress(OSError):  # or the interpreter tries again, and says so
                self._stream.close()
            raise self._failed(error, "cannot be finished", "what is in it can be read") from None

    def _failed(self, error: OSError, what: str, remedy: str) -> BagError:
        if isinstance(error, FileNotFoundError):
            return BagError(f"{self._part}: was moved or removed while recording; look for it, or record again")
        return BagError(f"{self._part}: {what}: {error.strerror}; {remedy}")

    @property
    def span(self) -> float:
        """Log time from the first to the last message, s."""
        return (self._last - self._first) * 1e-9

    def channel(self, topic: str, type_name: str, offered: list[QoSProfile]) -> None:
        schema = self._writer.schema(type_name, "ros2msg", definition(type_name).encode())
        metadata = {"offered_qos_profiles": _qos_text(offered)}
        self.counts[topic] = 0
        self._channels[topic] = self._writer.channel(schema, topic, metadata=metadata)

    def write(self, topic: str, log_time: int, data: bytes) -> None:
        if not self.count:
            self._first = log_time
        self._last = max(log_time, self._last)  # a clock that is set back must not reorder what was received
        self._to_disk(self._writer.message, self._channels[topic], self._last, bytes(data))
        self.count += 1
        self.counts[topic] += 1

    def flush(self) -> None:
        self._to_disk(self._writer.end_chunk)
        self._to_disk(self._stream.flush)
        self._to_disk(os.stat, self._part)

    def _to_disk(self, write: Callable[..., object], *arguments: Any) -> None:
        """Write, unless an error was met: rclpy prints what is raised in a callback, so `hold` raises it elsewhere."""
        try:
            if self._full is None:
                write(*arguments)
        except OSError as error:
            self._full = self._failed(error, "cannot be written", "make room")

    def hold(self) -> None:
        """Raise BagError where something could not be written."""
        if self._full is not None:
            raise self._full


_QOS = (
    "history", "depth", "reliability", "durability", "deadline", "lifespan", "liveliness", "liveliness_lease_duration",
    "avoid_ros_namespace_conventions",
)  # fmt: skip


def _qos_text(profiles: list[QoSProfile]) -> str:
    """As rosbag2 writes it since version 9 of its metadata."""

    def plain(value: Any) -> Any:
        if isinstance(value, Duration):
            return dict(zip(("sec", "nsec"), divmod(value.nanoseconds, 10**9), strict=True))
        return value.name.lower() if isinstance(value, Enum) else value

    listed = [{name: plain(getattr(profile, name)) for name in _QOS} for profile in profiles]
    return str(yaml.safe_dump(listed, sort_keys=False)) if listed else ""


def _note(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise argparse.ArgumentTypeError(f"{text!r} does not read NAME=TEXT")
    return name, value
