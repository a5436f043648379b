# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Recording: what every format of recordings offers to the rest of the program."""

from __future__ import annotations

from abc import ABC, abstractmethod
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from uncertain_lti.base.arrays import Array, Integers
from uncertain_lti.base.errors import BagError
from uncertain_lti.base.text import printable
from uncertain_lti.recordings.message_types import Definition, RawMessage
from uncertain_lti.signals.field_path import FieldPath, TypeFields, names_in, signal_paths

DATED_NS = 10**17
"""Since 1970, from which on a time is one of a calendar, and not of a run."""


@dataclass(frozen=True)
class TopicInfo:
    """What a recording holds of one topic.

    `topic`: its name; `type`: message type, `pkg/msg/Type`; `count`: messages that count; `encoding`: of its messages;
    `cdr` is what can be decoded; `readable`: whether its messages can be decoded; `reason`: why not, or which of its
    messages are left out; empty otherwise; `first`: first log time, ns; None without a message; `last`: last log time,
    ns; None without a message.
    """

    topic: str
    type: str
    count: int
    encoding: str
    readable: bool
    reason: str
    first: int | None
    last: int | None


@dataclass(frozen=True)
class TopicFacts:
    """One topic as `uncertain-lti topics` shows it.

    `info`: what the recording holds of it; `rate`: that of the median log-time step, 1/s, or of the mean one where
    messages come in bursts; None where there is no step or it is 0; `largest_gap`: longest log-time step, s; None where
    there is no step; `fields`: paths that can be signals; `data[0..99]` means `data[0]` to `data[99]`; `stamps`:
    whether header stamps can be used; `stamp_offset`: median of log time less header stamp, s; None without a stamp;
    `bursts`: whether messages come in bursts, with most steps far shorter than the mean; `elsewhere`: entries that only
    other messages of the topic name than the one that `fields` are of.
    """

    info: TopicInfo
    rate: float | None
    largest_gap: float | None
    fields: tuple[str, ...]
    stamps: Literal["none", "usable", "zero", "mixed"]
    stamp_offset: float | None
    bursts: bool = False
    elsewhere: tuple[str, ...] = ()


@dataclass
class Columns:
    """Messages of some topics in order of arrival.

    `topic` (messages,): positions in the topics asked for; `arrival` (messages,): log time, ns; `stamp` (messages,):
    header stamp, ns; -1 for no stamp; `values` (messages of the topic, paths): one array per topic; `alone`: messages
    that had to be decoded one by one.
    """

    topic: Integers
    arrival: Integers
    stamp: Integers
    values: list[Array]
    alone: int = 0


Progress = Callable[[Iterable[object], int], Iterable[object]]
"""Wraps what goes through messages, given their number, and may draw how far it has come."""


class Recording(ABC):
    """One recording of a machine, whatever the format of its files (`formats`): a format is a subclass.

    Everything that is read of a recording goes through this. Topics, types and log times are those of ROS 2 or stand
    in their place: a format without topics gives its data one, with fields that `FieldPath` reads.

    `path`: file or folder, as errors and reports call the recording; `parts`: its files, in order; `size`: bytes of
    these; `topics`: by name; `indexed`: whether reading may prove an index wrong from which some of it is known;
    `units`: of fields by path, where the file says them.
    """

    path: Path
    parts: tuple[Path, ...]
    size: int
    topics: Mapping[str, TopicInfo]
    indexed = False
    units: Mapping[str, str] = MappingProxyType({})
    _warnings: list[str]  # what is missing or left out
    _undecoded: Mapping[str, str] = MappingProxyType({})  # likewise, of messages left out by topic

    @property
    def warnings(self) -> list[str]:
        """What is missing or left out, each one sentence that begins with the file; grows while messages are read."""
        return [printable(warning) for warning in (*self._warnings, *sorted(self._undecoded.values()))]

    @property
    def reading_notes(self) -> tuple[list[str], dict[str, str]]:
        """Warnings so far, and sentences on messages left out by topic; what `restore_notes` takes."""
        return list(self._warnings), dict(self._undecoded)

    def restore_notes(self, warnings: Sequence[str], undecoded: Mapping[str, str]) -> None:
        """Set `reading_notes`, for example to those of another process that read the same recording."""
        self._warnings, self._undecoded = list(warnings), dict(undecoded)

    def walk(self) -> None:
        """Read what an index stated from the files themselves."""
        assert not self.indexed, "a format with an index reads them"

    @abstractmethod
    def type_fields(self, topic: str) -> TypeFields:
        """Fields of message types as the topic's own definition has them."""

    @abstractmethod
    def messages(self, topics: Iterable[str]) -> Iterator[tuple[str, int, Any]]:
        """Decoded messages in order of log time."""

    @abstractmethod
    def columns(
        self, topics: Sequence[str], paths: Sequence[Sequence[FieldPath]], progress: Progress | None = None
    ) -> Columns:
        """Numbers at some paths of each topic as arrays: what `FieldPath.read` gives for each of `messages`."""

    @abstractmethod
    def facts(self, progress: Progress | None = None) -> list[TopicFacts]:
        """Rates, gaps, stamps and fields of every topic, for a person who looks for signals."""


_FIRST = 50  # messages of a topic that are looked at for the names of its entries
_BURSTS = 10  # times that the mean step is longer than the median one where messages come in bursts, and each pause
_MOST_IN_BURST = 200  # messages; after more, a pause is one between sessions


class _Seen:
    """What was seen of one topic: log times, those less the stamps, stamps of 0, its longest and its first messages."""

    def __init__(self) -> None:
        self.times, self.offsets, self.zeros = array("Q"), array("d"), 0
        self.longest: RawMessage | None = None
        self.first: list[RawMessage] = []
        self.most = 0  # of the first


def topic_facts(topics: Mapping[str, TopicInfo], messages: Iterable[RawMessage]) -> list[TopicFacts]:
    """Facts about every topic of a recording; reads its messages once, and decodes one of each topic.

    Field paths are taken from the longest message of a topic, so that its arrays have their lengths.
    """
    every = {topic: _Seen() for topic in topics}
    for raw in messages:
        if not raw.channel.counted:
            continue
        seen, definition = every[raw.topic], raw.channel.definition
        seen.times.append(raw.log_time_ns)
        if definition.reason:
            continue
        if seen.longest is None:
            seen.most = _FIRST * bool(names_in(definition.fields(definition.type_name)))
        if seen.longest is None or len(raw.data) > len(seen.longest.data):
            seen.longest = raw
        if len(seen.first) < seen.most:
            seen.first.append(raw)
        if definition.has_header:
            if stamp := definition.stamp_ns(raw.data):
                seen.offsets.append((raw.log_time_ns - stamp) * 1e-9)
            else:
                seen.zeros += 1
    return [_facts(info, every[topic]) for topic, info in topics.items()]


def _facts(info: TopicInfo, seen: _Seen) -> TopicFacts:
    def paths(raw: RawMessage, definition: Definition) -> Iterator[str]:
        return signal_paths(definition.fields, definition.type_name, definition.decode(raw.data))

    times, offsets, zeros = seen.times, seen.offsets, seen.zeros
    t_ns: Integers = np.array(times, dtype=np.int64)
    steps = t_ns[1:] - t_ns[:-1]
    step, bursts = usual_step(steps)
    fields: tuple[str, ...] = ()
    elsewhere: dict[str, None] = {}
    if seen.longest:
        with suppress(BagError):  # `messages` tells it
            fields = tuple(paths(seen.longest, seen.longest.channel.definition))
            for raw in seen.first:
                elsewhere |= dict.fromkeys(paths(raw, seen.longest.channel.definition))
    return TopicFacts(
        info,
        rate=1e9 / step if step else None,
        largest_gap=float(steps.max()) * 1e-9 if len(steps) else None,
        fields=fields,
        stamps="mixed" if zeros and offsets else "usable" if offsets else "zero" if zeros else "none",
        stamp_offset=median(offsets) if offsets else None,
        bursts=bursts,
        elsewhere=tuple(path for path in elsewhere if path not in fields and ".." not in path),
    )


def usual_step(steps: Integers) -> tuple[float, bool]:
    """Step that a topic's rate is that of: the median one, or the mean where most messages come in bursts."""
    if not len(steps):
        return 0.0, False
    middle, mean = float(np.median(steps)), float(np.maximum(steps, 0).sum()) / len(steps)
    pauses = np.count_nonzero(steps > _BURSTS * middle)
    bursts = 0 <= middle * _BURSTS < mean and pauses * _MOST_IN_BURST >= len(steps)
    return (mean, True) if bursts else (middle, False)
