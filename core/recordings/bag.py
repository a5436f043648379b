# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Bag: one recording of ROS messages, decoded in order of log time, and which recordings some paths name."""

from __future__ import annotations

import heapq
import itertools
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from uncertain_lti.base.errors import BagError
from uncertain_lti.base.files import natural
from uncertain_lti.base.text import shortlist
from uncertain_lti.recordings.bag_arrays import ColumnReader, IndexMismatchError
from uncertain_lti.recordings.bag_files import listed_parts, not_one_recording, parts_of, stem_and_index, survey
from uncertain_lti.recordings.mcap_records import Block, Contents, count, messages
from uncertain_lti.recordings.message_types import RawMessage, RecordedChannel, define, lines_of, undefined
from uncertain_lti.recordings.recording import Columns, Progress, Recording, TopicFacts, TopicInfo, topic_facts
from uncertain_lti.recordings.unreadable import changed, name_each, os_error
from uncertain_lti.signals.field_path import FieldPath, TypeFields, full_name

_MOST_LINES = 100_000  # of definitions that are read in one file
_MOST_NAMES = 50  # of topics in an error
_MOST_HELD = 1 << 30  # bytes
_SIZE_OF_AN_ENTRY = 400  # bytes; in memory, with what Python puts around it
_NEVER = 2**64
_Described = list[tuple[Contents, dict[int, RecordedChannel]]]
_LEAST_LINES = 50  # that a definition counts for, however short it is


class Bag(Recording):
    """One recording: an MCAP file, a folder, or the parts of a split bag.

    A folder's metadata.yaml says which files in which order; without one its files must be the parts `<stem>_<i>.mcap`
    of one split bag (see `group_recordings`), taken in natural order. The file is walked once on opening; messages are
    read and decoded while they are iterated. Of messages that are out of order only what overlaps is held, as raw
    bytes.

    Messages of one topic that has several types: the type with the most messages counts, the others are left out with a
    warning. Messages that do not fit their definition are left out with a warning as they are met.

    `path`: file or folder; with parts, the name of the recording; `parts`: files in order, or what is known of them;
    `indexed`: where a file has an index, use what that states until messages are read; `described` gives what is needed
    to read them in blocks, and everything else walks the file first. Damage to what is never read is then not reported,
    and first and last log times of topics are those of the chunks they are in.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        parts: Sequence[str | os.PathLike[str] | Contents] = (),
        indexed: bool = False,
    ) -> None:
        self.path = Path(path)
        self._warnings: list[str] = []
        self._undecoded: dict[str, str] = {}
        contents = [part if isinstance(part, Contents) else survey(Path(part), indexed) for part in parts]
        self._take(contents or self._open(indexed))

    def _take(self, contents: list[Contents]) -> None:
        self._contents = contents
        self.parts = tuple(part.path for part in contents)
        self.size = sum(part.size for part in contents)
        self.indexed = any(part.indexed for part in contents)
        self._folder_warnings = list(self._warnings)
        damage = [warning for part in self._contents for warning in part.warnings]
        self._warnings += damage
        if (damage or not self._contents) and not any(part.count for part in self._contents):
            why = self._warnings[0].removeprefix(f"{self.path}: ")
            remedy = "" if "`" in why else "; record or copy it again"
            raise BagError(f"{self.path}: no message can be read ({why}){remedy}")
        self._channels = [_channels(part) for part in self._contents]
        self.topics = self._topics()

    def walk(self) -> None:
        """Walk every file of which only the index was read."""
        if self.indexed:
            self._warnings = self._folder_warnings
            self._undecoded = {}
            self._take([survey(part.path) if part.indexed else part for part in self._contents])

    def described(self, topics: Iterable[str], readable: bool = True) -> _Described:
        """Each file, and its channels of some topics: those that count and can be decoded, or all."""
        wanted = set(topics)
        for topic in sorted(wanted):
            self._require(topic, readable)
        return [
            (part, {k: c for k, c in channels.items() if c.topic in wanted and (c.counted or not readable)})
            for part, channels in zip(self._contents, self._channels, strict=True)
        ]

    def leave_out(self, undecoded: Mapping[str, tuple[int, str]]) -> None:
        """Warn of messages that cannot be decoded: topic -> how many, and why one of them cannot."""
        for topic, (number, why) in undecoded.items():
            of_them = f"{count(number, 'message')} left out that cannot be decoded ({why})"
            self._undecoded[topic] = f"{self.path}: {topic}: {of_them}"

    def __reduce__(self) -> tuple[type[Bag], tuple[Path, tuple[Contents, ...]]]:
        """For another process, which need not open the files again."""
        return Bag, (self.path, tuple(self._contents))

    def type_fields(self, topic: str) -> TypeFields:
        """Fields of message types as the topic's own definition has them."""
        self._require(topic)
        every = itertools.chain.from_iterable(channels.values() for channels in self._channels)
        return next(c for c in every if c.topic == topic and c.counted).definition.fields

    def messages(self, topics: Iterable[str]) -> Iterator[tuple[str, int, Any]]:
        """Decoded messages in order of log time, ties in file order, over all parts."""
        self.walk()
        return self._decoded(self.described(topics))

    def columns(
        self, topics: Sequence[str], paths: Sequence[Sequence[FieldPath]], progress: Progress | None = None
    ) -> Columns:
        """Numbers at some paths of each topic, read block by block; messages that cannot be decoded are left out."""
        while True:
            parts = self.described(topics)  # which an index may have named wrongly
            reader = ColumnReader(parts, {name: self.topics[name].count for name in topics}, paths)
            try:
                columns = reader.run(progress)
            except IndexMismatchError:
                if not self.indexed:
                    raise changed(self.path) from None
                self.walk()
            else:
                self.leave_out(reader.undecoded)
                return columns

    def facts(self, progress: Progress | None = None) -> list[TopicFacts]:
        """Facts about every topic; reads the recording once, and decodes one message of each topic."""
        messages: Iterable[Any] = self.raw_messages()
        if progress is not None:
            messages = progress(messages, sum(info.count for info in self.topics.values()))
        facts = topic_facts(self.topics, messages)
        notes = [
            f"{self.path}: {fact.info.topic}: {shortlist(list(fact.elsewhere), 6)} come in other messages than "
            f"{shortlist(list(fact.fields), 6)}, and the states of a model in one; fit a model for each, or publish "
            f"all together, as joint_state_publisher with source_list does"
            for fact in facts
            if fact.elsewhere
        ]
        self._warnings += [note for note in notes if note not in self._warnings]
        return facts

    def raw_messages(self, topics: Iterable[str] | None = None) -> Iterator[RawMessage]:
        """Messages as recorded, of these topics or of all, also those that cannot be decoded; same order."""
        self.walk()
        return self._sorted(self.described(self.topics if topics is None else topics, readable=False))

    def _open(self, indexed: bool) -> list[Contents]:
        try:
            if self.path.is_dir():
                return self._folder(indexed)
            if self.path.exists() and not self.path.is_file():
                raise BagError(f"{self.path}: neither a file nor a folder; check the path")
            return [survey(self.path, indexed)]
        except OSError as error:
            raise os_error(self.path, error) from None

    def _folder(self, indexed: bool) -> list[Contents]:
        paths, listed, self._warnings = parts_of(self.path)
        # the part that was open when the power went
        empty = [path for path in paths if len(paths) > 1 and not path.stat().st_size]
        self._warnings += [f"{path}: the file is empty; it is left out" for path in empty]
        contents = [survey(path, indexed) for path in paths if path not in empty]
        if not listed and (why := not_one_recording(contents)):
            unlike = f"without a metadata.yaml its files do not look like one recording ({why})"
            raise BagError(f"{self.path}: {unlike}; {name_each(self.path, paths)}")
        return contents

    def _topics(self) -> dict[str, TopicInfo]:
        groups: dict[str, dict[tuple[str, str, str], list[tuple[int, int]]]] = {}
        for part, channels in enumerate(self._channels):
            for key, channel in channels.items():
                kind = (channel.definition.type_name, channel.encoding, channel.definition.reason)
                groups.setdefault(channel.topic, {}).setdefault(kind, []).append((part, key))
        return {topic: self._topic(topic, kinds) for topic, kinds in sorted(groups.items())}

    def _topic(self, topic: str, kinds: dict[tuple[str, str, str], list[tuple[int, int]]]) -> TopicInfo:
        """Choose the channels of a topic that count."""
        tallies = {
            kind: [tally for part, key in keys if (tally := self._contents[part].tally.get(key))]
            for kind, keys in kinds.items()
        }
        counts = {kind: sum(tally.count for tally in of_kind) for kind, of_kind in tallies.items()}
        chosen = max(counts, key=lambda kind: counts[kind])
        type_name, encoding, reason = chosen
        others = [
            f"{count(number, 'message')} of {kind[0] or 'no type'} ({kind[2] or kind[1]})"
            for kind, number in counts.items()
            if kind != chosen and number
        ]
        if others:
            left_out = f"besides {type_name} it carries {' and '.join(others)}, which are left out"
            reason = f"{reason}; {left_out}" if reason else left_out
            self._warnings.append(f"{self.path}: {topic}: {left_out}")
        notes = set()
        for part, key in kinds[chosen]:
            channel = self._channels[part][key]
            notes.add(channel.definition.note)
            self._channels[part][key] = replace(channel, counted=True)
        self._warnings += [f"{self.path}: {topic}: {note}" for note in sorted(notes) if note]
        first = min((tally.first for tally in tallies[chosen]), default=None)
        last = max((tally.last for tally in tallies[chosen]), default=None)
        return TopicInfo(topic, type_name, counts[chosen], encoding, not chosen[2], reason, first, last)

    def _require(self, topic: str, readable: bool = True) -> None:
        info = self.topics.get(topic)
        if info is None:
            there = shortlist(list(self.topics), _MOST_NAMES) or "none"
            raise BagError(f"{self.path}: there is no topic {topic}; topics there: {there}")
        if readable and not info.readable:
            raise BagError(f"{self.path}: topic {topic} cannot be decoded: {info.reason}; choose another topic")

    def _decoded(self, parts: _Described) -> Iterator[tuple[str, int, Any]]:
        undecoded: dict[str, tuple[int, str]] = {}
        for raw in self._sorted(parts):
            try:
                message = raw.channel.definition.decode(raw.data)
            except BagError as error:
                number, least = undecoded.get(raw.topic, (0, str(error)))
                undecoded[raw.topic] = number + 1, min(least, str(error))
                self.leave_out(undecoded)
                continue
            yield raw.topic, raw.log_time_ns, message

    def _sorted(self, parts: _Described) -> Iterator[RawMessage]:
        """Messages of these channels of each file in order of log time, ties in file order.

        Blocks are read in order of their smallest log time; what is earlier than all that are left is final.
        """
        blocks: list[tuple[int, int, int, Block]] = sorted(
            (block.start, part, number, block)
            for part, (contents, wanted) in enumerate(parts)
            for number, block in enumerate(contents.blocks)
            if not block.channels.isdisjoint(wanted)
        )
        pending: list[tuple[int, int, int, int, RawMessage]] = []  # a heap; no two have the same place
        held = 0
        for position, (_, part, number, block) in enumerate(blocks):
            contents, wanted = parts[part]
            records = contents.records(block, wanted)
            for key, log_time, begin, end in messages(records):
                if channel := wanted.get(key):
                    raw = RawMessage(log_time, records[begin:end], channel)
                    heapq.heappush(pending, (log_time, part, number, begin, raw))
                    held += end - begin + _SIZE_OF_AN_ENTRY
            following = blocks[position + 1][0] if position + 1 < len(blocks) else _NEVER
            while pending and pending[0][0] < following:
                raw = heapq.heappop(pending)[4]
                held -= len(raw.data) + _SIZE_OF_AN_ENTRY
                yield raw
            if held > _MOST_HELD:
                waiting = f"more than {_MOST_HELD >> 20} MiB of them have to wait; put them in order with `mcap sort`"
                raise BagError(f"{self.path}: its messages are so far out of order that {waiting}")


def _channels(contents: Contents) -> dict[int, RecordedChannel]:
    """Channels of one file with their definitions, or the reason why there is none."""
    channels = {}
    seen: set[int] = set()
    lines = 0
    for key, channel in contents.channels.items():
        schema = contents.schemas.get(channel.schema_id) if channel.schema_id else None
        type_name = full_name(schema.name) if schema else ""
        if channel.message_encoding != "cdr":
            encoding = channel.message_encoding or "no stated encoding"
            remedy = "take the .bag that it was made of" if encoding == "ros1" else "write its numbers into a CSV file"
            why = f"its messages are in {encoding}, and cdr is what can be decoded: {remedy}"
            definition = undefined(type_name, why)
        elif schema is None or not type_name:
            definition = undefined(type_name, "the file does not say what type it has")
        else:
            if schema.id not in seen:
                seen.add(schema.id)
                lines += _LEAST_LINES + lines_of(schema.data)
            if lines > _MOST_LINES:
                definition = undefined(type_name, "the definitions of the file are too long together")
            else:
                definition = define(schema.name, schema.encoding, schema.data)
        channels[key] = RecordedChannel(channel.topic, channel.message_encoding, channel.metadata, definition)
    return channels


def group_bags(paths: Sequence[Path], indexed: bool = False) -> list[Bag]:
    """Bags that some paths name, in the order of their first mention.

    A folder is one recording. Files are one recording each, except the parts of a split bag: files
    `<stem>_<i>.mcap` of one stem in one folder that either

    - are listed together in the metadata.yaml of their folder, or
    - are numbered 0, 1, 2, ... without a hole, carry the same topics, and follow each other in log time
      without a break: each begins at most 1 s, or the longest pause inside one of them, after the one
      before ends, and overlaps it by no more than 10 % of the shorter (messages at a seam may be out of order).

    In doubt files stay apart: that loses the one transition at a seam, while joining two runs would invent one.
    """
    groups: dict[tuple[Path, str], list[Path]] = {}
    for path in paths:
        pair = None if path.is_dir() else stem_and_index(path)
        groups.setdefault((path.parent, f"{pair[0]}_*.mcap" if pair else path.name), []).append(path)
    return [bag for group in groups.values() for bag in _group(group, indexed)]


def _group(paths: list[Path], indexed: bool) -> list[Bag]:
    if len(paths) == 1 or len(set(paths)) < len(paths):
        return [Bag(path, indexed=indexed) for path in paths]
    try:
        listed = {part.resolve(): i for i, part in enumerate(listed_parts(paths[0].parent))}
    except BagError:  # about other files in the folder
        listed = {}
    if all(path.resolve() in listed for path in paths):
        paths = sorted(paths, key=lambda path: listed[path.resolve()])
        return [Bag(paths[0], paths, indexed)]
    contents = {path: survey(path, indexed) for path in paths}
    ordered = [contents[path] for path in sorted(paths, key=natural)]
    numbers = [pair[1] for part in ordered if (pair := stem_and_index(part.path))]
    if numbers[0] == 0 and not not_one_recording(ordered):
        return [Bag(ordered[0].path, ordered)]
    return [Bag(path, [contents[path]]) for path in paths]
