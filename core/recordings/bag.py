"""Bag: one MCAP recording as decoded messages in order of log time."""

from __future__ import annotations

import bisect
import itertools
import os
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any, Literal, NamedTuple

from mcap.records import Schema

from uncertain_lti.base.errors import BagError, SignalError
from uncertain_lti.recordings.bag_files import listed_parts, natural, os_error, parts_of, stem_and_index
from uncertain_lti.recordings.mcap_index import outline
from uncertain_lti.recordings.mcap_records import Block, Contents, count, messages, read_block, scan
from uncertain_lti.recordings.message_types import Definition, define, header_stamp_ns, lines_of, normal_name, undefined
from uncertain_lti.signals.field_types import FieldType, TypeFields
from uncertain_lti.signals.paths import signal_paths

__all__ = [
    "Bag",
    "RawMessage",
    "RecordedChannel",
    "TopicFacts",
    "TopicInfo",
    "describe",
    "group_recordings",
    "header_stamp_ns",
]


_MOST_LINES = 100_000  # of definitions that are read in one file
_LEAST_LINES = 50  # that a definition counts for, however short it is


@dataclass(frozen=True)
class TopicInfo:
    """What a recording holds of one topic.

    Parameters
    ----------
    topic : str
        Its name.
    type : str
        Message type, `pkg/msg/Type`.
    count : int
        Messages that count.
    encoding : str
        Of its messages; `cdr` is what can be decoded.
    readable : bool
        Whether its messages can be decoded.
    reason : str
        Why not, or which of its messages are left out; empty otherwise.
    first : int or None
        First log time, ns; None without a message.
    last : int or None
        Last log time, ns; None without a message.
    """

    topic: str
    type: str
    count: int
    encoding: str
    readable: bool
    reason: str
    first: int | None
    last: int | None


@dataclass(frozen=True, eq=False)
class RecordedChannel:
    """A channel as the file describes it: everything needed to write its messages again.

    Parameters
    ----------
    topic : str
        Name of its topic.
    type : str
        Message type, `pkg/msg/Type`.
    encoding : str
        Of its messages.
    schema : Schema or None
        Its record in the file; None without one.
    metadata : mapping of str to str
        What the recorder stored of the channel, QoS for example.
    definition : Definition
        How its messages are decoded.
    counted : bool, default False
        Whether its messages are those of its topic (see `Bag` on topics with several types).
    """

    topic: str
    type: str
    encoding: str
    schema: Schema | None
    metadata: Mapping[str, str]
    definition: Definition
    counted: bool = False


class RawMessage(NamedTuple):
    """One message as recorded.

    Parameters
    ----------
    log_time_ns : int
        Log time, ns.
    publish_time_ns : int
        Publish time, ns.
    data : bytes
        Serialised message.
    channel : RecordedChannel
        What it was recorded on.
    """

    log_time_ns: int
    publish_time_ns: int
    data: bytes
    channel: RecordedChannel

    @property
    def topic(self) -> str:
        """Topic it was published on."""
        return self.channel.topic

    @property
    def type(self) -> str:
        """Message type, `pkg/msg/Type`."""
        return self.channel.type

    @property
    def encoding(self) -> str:
        """Encoding of `data`; `cdr` is what can be decoded."""
        return self.channel.encoding


class Bag:
    """One recording: an MCAP file, a folder, or the parts of a split bag.

    A folder's metadata.yaml says which files in which order; without one its files must be the parts `<stem>_<i>.mcap`
    of one split bag (see `group_recordings`), taken in natural order. The file is walked once on opening; messages are
    read and decoded while they are iterated. Of messages that are out of order only what overlaps is held, as raw
    bytes.

    Messages of one topic that has several types: the type with the most messages counts, the others are left out with a
    warning. Messages that do not fit their definition are left out with a warning as they are met.

    Parameters
    ----------
    path : path
        File or folder; with parts, the name of the recording.
    parts : sequence of path or Contents, optional
        Files in order, or what is known of them.
    indexed : bool, default False
        Where a file has an index, use what that states until messages are read; `described` gives what is needed to
        read them in blocks, and everything else walks the file first. Damage to what is never read is then not
        reported, and first and last log times of topics are those of the chunks they are in.

    Raises
    ------
    BagError
        There is no recording, or no message of it can be read.
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
        survey = _outline_or_scan if indexed else scan
        contents = [part if isinstance(part, Contents) else survey(Path(part)) for part in parts]
        self._take(contents or self._open(survey))

    def _take(self, contents: list[Contents]) -> None:
        self._contents = contents
        self._folder_warnings = list(self._warnings)
        damage = [warning for part in self._contents for warning in part.warnings]
        self._warnings += damage
        if (damage or not self._contents) and not any(part.count for part in self._contents):
            why = self._warnings[0].removeprefix(f"{self.path}: ")
            raise BagError(f"{self.path}: no message can be read ({why}); record or copy it anew")
        self._channels = [_channels(part) for part in self._contents]
        self.topics: Mapping[str, TopicInfo] = self._topics()

    def walk(self) -> None:
        """Walk every file of which only the index was read.

        Raises
        ------
        BagError
            As opening the bag does.
        """
        if any(part.indexed for part in self._contents):
            self._warnings = self._folder_warnings
            self._undecoded = {}
            self._take([scan(part.path) if part.indexed else part for part in self._contents])

    def described(self, topics: Iterable[str]) -> list[tuple[Contents, dict[int, RecordedChannel]]]:
        """Each file, and its channels that count for some topics.

        Parameters
        ----------
        topics : iterable of str
            Names.

        Returns
        -------
        list of (Contents, dict of int to RecordedChannel)
            Files in order; channels by their number in the file.

        Raises
        ------
        BagError
            As `messages`.
        """
        wanted = self._required(topics)
        return [
            (contents, _of(channels, wanted, counted=True))
            for contents, channels in zip(self._contents, self._channels, strict=True)
        ]

    def tell(self, warnings: Sequence[str], undecoded: Mapping[str, str]) -> None:
        """Take over the warnings of another process that read the same recording.

        Parameters
        ----------
        warnings : sequence of str
            As of `said`.
        undecoded : mapping of str to str
            As of `said`, by topic.
        """
        self._warnings, self._undecoded = list(warnings), dict(undecoded)

    def left_out(self, topic: str, number: int, why: str) -> str:
        """Sentence about messages that cannot be decoded.

        Parameters
        ----------
        topic : str
            Name of the topic.
        number : int
            Messages left out.
        why : str
            The reason.

        Returns
        -------
        str
            The sentence.
        """
        return f"{self.path}: {topic}: {count(number, 'message')} left out that cannot be decoded ({why})"

    @property
    def said(self) -> tuple[list[str], dict[str, str]]:
        """What `tell` takes."""
        return list(self._warnings), dict(self._undecoded)

    @property
    def contents(self) -> tuple[Contents, ...]:
        """What is known of each file; `parts` of another bag may be these."""
        return tuple(self._contents)

    @property
    def parts(self) -> tuple[Path, ...]:
        """Files of the recording in order."""
        return tuple(part.path for part in self._contents)

    @property
    def warnings(self) -> list[str]:
        """What is missing or left out, each one sentence that begins with the file; grows while messages are read."""
        return [*self._warnings, *self._undecoded.values()]

    def fields(self, type_name: str) -> Mapping[str, FieldType]:
        """Fields of a type that a readable topic has or uses.

        Parameters
        ----------
        type_name : str
            As package/msg/Name.

        Returns
        -------
        mapping of str to FieldType
            Field name -> FieldType.

        Raises
        ------
        SignalError
            The type is not defined in the recording.
        """
        for channel in self._every_channel():
            if channel.counted and type_name in channel.definition.types:
                return channel.definition.fields(type_name)
        raise SignalError(f"{type_name}: not defined in {self.path}; check the type")

    def type_fields(self, topic: str) -> TypeFields:
        """`fields` as one topic's own schema defines them.

        Parameters
        ----------
        topic : str
            Name of the topic.

        Returns
        -------
        callable
            Type name -> {field name: FieldType}.

        Raises
        ------
        BagError
            As `messages`.
        """
        self._require(topic)
        channels = (channel for channel in self._every_channel() if channel.topic == topic and channel.counted)
        return next(channels).definition.fields

    def messages(self, topics: Iterable[str]) -> Iterator[tuple[str, int, Any]]:
        """Decoded messages in order of log time, ties in file order, over all parts.

        Parameters
        ----------
        topics : iterable of str
            Names.

        Returns
        -------
        iterator of (str, int, object)
            Topic, log time in ns, message.

        Raises
        ------
        BagError
            A topic is not there (the sentence names those that are) or cannot be decoded (it says why).
        """
        self.walk()
        wanted = self._required(topics)
        return self._decoded([_of(channels, wanted, counted=True) for channels in self._channels])

    def raw_messages(self, topics: Iterable[str] | None = None) -> Iterator[RawMessage]:
        """Messages as recorded, of these topics or of all, also those that cannot be decoded; same order.

        Parameters
        ----------
        topics : iterable of str, optional
            Names; default all.

        Returns
        -------
        iterator of RawMessage
            In the order of `messages`.

        Raises
        ------
        BagError
            A topic is not there; the sentence names those that are.
        """
        self.walk()
        wanted = set(self.topics if topics is None else topics)
        for topic in sorted(wanted):
            self._require(topic, readable=False)
        return self._sorted([_of(channels, wanted) for channels in self._channels])

    def _open(self, survey: Callable[[Path], Contents]) -> list[Contents]:
        try:
            if self.path.is_dir():
                return self._folder(survey)
            if self.path.exists() and not self.path.is_file():
                raise BagError(f"{self.path}: neither a file nor a folder; check the path")
            return [survey(self.path)]
        except OSError as error:
            raise os_error(self.path, error) from None

    def _folder(self, survey: Callable[[Path], Contents]) -> list[Contents]:
        paths, listed, self._warnings = parts_of(self.path)
        contents = []
        for path in paths:
            if len(paths) > 1 and not path.stat().st_size:  # the part that was open when the power went
                self._warnings.append(f"{path}: the file is empty; it is left out")
            else:
                contents.append(survey(path))
        if not listed and (why := _not_one_recording(contents)):
            raise BagError(
                f"{self.path}: without a metadata.yaml its files do not look like one recording ({why}); name them "
                f"one by one: {', '.join(path.name for path in paths)}"
            )
        return contents

    def _topics(self) -> dict[str, TopicInfo]:
        groups: dict[str, dict[tuple[str, str, str], list[tuple[int, int]]]] = {}
        for part, channels in enumerate(self._channels):
            for key, channel in channels.items():
                kind = (channel.type, channel.encoding, channel.definition.reason)
                groups.setdefault(channel.topic, {}).setdefault(kind, []).append((part, key))
        return {topic: self._topic(topic, kinds) for topic, kinds in sorted(groups.items())}

    def _topic(self, topic: str, kinds: dict[tuple[str, str, str], list[tuple[int, int]]]) -> TopicInfo:
        """Choose the channels of a topic that count."""
        tallies = {
            kind: [self._contents[part].tally[key] for part, key in keys if key in self._contents[part].tally]
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
        of_kind = tallies[chosen]
        first = min((tally.first for tally in of_kind), default=None)
        last = max((tally.last for tally in of_kind), default=None)
        return TopicInfo(topic, type_name, counts[chosen], encoding, not chosen[2], reason, first, last)

    def _every_channel(self) -> Iterator[RecordedChannel]:
        return itertools.chain.from_iterable(channels.values() for channels in self._channels)

    def _required(self, topics: Iterable[str]) -> set[str]:
        wanted = set(topics)
        for topic in sorted(wanted):
            self._require(topic)
        return wanted

    def _require(self, topic: str, readable: bool = True) -> None:
        info = self.topics.get(topic)
        if info is None:
            there = ", ".join(self.topics) or "none"
            raise BagError(f"{self.path}: there is no topic {topic}; topics there: {there}")
        if readable and not info.readable:
            raise BagError(f"{self.path}: topic {topic} cannot be decoded: {info.reason}; choose another topic")

    def _decoded(self, channels: list[dict[int, RecordedChannel]]) -> Iterator[tuple[str, int, Any]]:
        failed: dict[str, int] = {}
        for raw in self._sorted(channels):
            channel = raw.channel
            try:
                message = channel.definition.decode(raw.data)
            except BagError as error:
                topic = channel.topic
                failed[topic] = failed.get(topic, 0) + 1
                self._undecoded[topic] = self.left_out(topic, failed[topic], str(error))
                continue
            yield channel.topic, raw.log_time_ns, message

    def _sorted(self, channels: list[dict[int, RecordedChannel]]) -> Iterator[RawMessage]:
        """Messages of these channels (by part and channel id) in order of log time, ties in file order.

        Blocks are read in order of their smallest log time; what is earlier than every block still to be read
        is final.
        """
        blocks: list[tuple[int, int, int, Block]] = []
        for part, wanted in enumerate(channels):
            for number, block in enumerate(self._contents[part].blocks):
                if not block.channels.isdisjoint(wanted):
                    blocks.append((block.start, part, number, block))
        blocks.sort(key=lambda entry: entry[:3])
        pending: list[tuple[int, int, int, int, RawMessage]] = []
        for position, (_, part, number, block) in enumerate(blocks):
            wanted = channels[part]
            records = read_block(self._contents[part].path, block)
            for key, log_time, publish_time, begin, end in messages(records):
                if channel := wanted.get(key):
                    raw = RawMessage(log_time, publish_time, records[begin:end], channel)
                    pending.append((log_time, part, number, begin, raw))
            pending.sort()  # never compares messages: no two have the same place
            following = blocks[position + 1][0] if position + 1 < len(blocks) else None
            final = len(pending) if following is None else bisect.bisect_left(pending, (following,))
            for entry in pending[:final]:
                yield entry[4]
            del pending[:final]


def _outline_or_scan(path: Path) -> Contents:
    return outline(path) or scan(path)


def _of(channels: Mapping[int, RecordedChannel], topics: set[str], counted: bool = False) -> dict[int, RecordedChannel]:
    return {
        key: channel
        for key, channel in channels.items()
        if channel.topic in topics and (channel.counted or not counted)
    }


def _channels(contents: Contents) -> dict[int, RecordedChannel]:
    """Channels of one file with their definitions, or the reason why there is none."""
    channels = {}
    seen: set[int] = set()
    lines = 0
    for key, channel in contents.channels.items():
        schema = contents.schemas.get(channel.schema_id) if channel.schema_id else None
        type_name = normal_name(schema.name) if schema else ""
        if channel.message_encoding != "cdr":
            encoding = channel.message_encoding or "no stated encoding"
            definition = undefined(type_name, f"its messages are in {encoding}, and cdr is what can be decoded")
        elif schema is None:
            definition = undefined(type_name, "the file does not say what type it has")
        else:
            if schema.id not in seen:
                seen.add(schema.id)
                lines += _LEAST_LINES + lines_of(schema.data)
            if lines > _MOST_LINES:
                definition = undefined(type_name, "the definitions of the file are too long together")
            else:
                definition = define(schema.name, schema.encoding, schema.data)
        channels[key] = RecordedChannel(
            channel.topic, type_name, channel.message_encoding, schema, channel.metadata, definition
        )
    return channels


# --- which files are one recording --------------------------------------------------------------------------


def group_recordings(paths: Iterable[str | os.PathLike[str]], indexed: bool = False) -> list[Bag]:
    """Recordings that some paths name, in the order of their first mention.

    A folder is one recording. Files are one recording each, except the parts of a split bag: files
    `<stem>_<i>.mcap` of one stem in one folder that either

    - are listed together in the metadata.yaml beside them, or
    - are numbered 0, 1, 2, ... without a hole, carry the same topics, and follow each other in log time
      without a break: each begins at most 1 s, or the longest pause inside one of them, after the one
      before ends, and overlaps it by no more than 10 % of the shorter (messages at a seam may be out of order).

    In doubt files stay apart: that loses the one transition at a seam, while joining two runs would invent one.

    Parameters
    ----------
    paths : iterable of path
        Files and folders.
    indexed : bool, default False
        As in `Bag`.

    Returns
    -------
    list of Bag
        One per recording.

    Raises
    ------
    BagError
        A file cannot be read, or is named twice.
    """
    order: list[tuple[Path, str]] = []
    files: dict[tuple[Path, str], list[Path]] = {}
    for path in map(Path, paths):
        pair = None if path.is_dir() else stem_and_index(path)
        group = (path.parent, f"{pair[0]}_*.mcap" if pair else path.name)
        if group not in files or path.is_dir():
            order.append(group)
        files.setdefault(group, []).append(path)
    bags = []
    for group in order:
        bags += _group(files[group], indexed)
    seen: set[Path] = set()
    for part in itertools.chain.from_iterable(bag.parts for bag in bags):
        if part.resolve() in seen:
            raise BagError(f"{part}: named twice; name each recording once")
        seen.add(part.resolve())
    return bags


def _group(paths: list[Path], indexed: bool) -> list[Bag]:
    if len(paths) == 1 or len(set(paths)) < len(paths):
        return [Bag(path, indexed=indexed) for path in paths]
    try:
        listed = {part.resolve(): i for i, part in enumerate(listed_parts(paths[0].parent) or [])}
    except BagError:  # about other files in the folder
        listed = {}
    if all(path.resolve() in listed for path in paths):
        paths = sorted(paths, key=lambda path: listed[path.resolve()])
        return [Bag(paths[0], paths, indexed)]
    survey = _outline_or_scan if indexed else scan
    contents = {path: survey(path) for path in paths}
    ordered = [contents[path] for path in sorted(paths, key=natural)]
    numbers = [pair[1] for part in ordered if (pair := stem_and_index(part.path))]
    if numbers[0] == 0 and not _not_one_recording(ordered):
        return [Bag(ordered[0].path, ordered)]
    return [Bag(path, [contents[path]]) for path in paths]


def _not_one_recording(parts: Sequence[Contents]) -> str:
    """Why files are not the consecutive parts of one recording; "" where they may be."""
    pause: int | None = None
    for before, after in itertools.pairwise(parts):
        names = f"{before.path.name} and {after.path.name}"
        pair = stem_and_index(before.path), stem_and_index(after.path)
        if not pair[0] or not pair[1] or pair[1][1] != pair[0][1] + 1:
            return f"{names} are not numbered one after the other"
        if not before.tally or not after.tally:
            continue  # nothing in it that could contradict
        kinds = [{(c.topic, c.type) for c in _channels(part).values()} for part in (before, after)]
        if not (kinds[0] <= kinds[1] or kinds[1] <= kinds[0]):
            return f"{names} do not carry the same topics"
        (begin, end), (next_begin, next_end) = _span(before), _span(after)
        if next_begin - end > 10**9 and pause is None:
            pause = max(_longest_pause(part) for part in parts)
        if next_begin - end > max(10**9, pause or 0):
            return f"{(next_begin - end) / 1e9:.1f} s lie between {names}"
        if next_begin < begin or (end - next_begin) * 10 > min(end - begin, next_end - next_begin):
            return f"{names} overlap in time"
    return ""


def _span(contents: Contents) -> tuple[int, int]:
    return min(block.start for block in contents.blocks), max(block.end for block in contents.blocks)


def _longest_pause(contents: Contents) -> int:
    """Longest time without any message, ns."""
    if contents.indexed:
        contents = scan(contents.path)
    times: list[int] = []
    for block in contents.blocks:
        times += (message[1] for message in messages(read_block(contents.path, block)))
    return max((b - a for a, b in itertools.pairwise(sorted(times))), default=0)


# --- what could be a signal ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class TopicFacts:
    """One topic as `uncertain-lti topics` shows it.

    Parameters
    ----------
    info : TopicInfo
        What the recording holds of it.
    rate : float or None
        That of the median log-time step, 1/s; None where there is no step or it is 0.
    largest_gap : float or None
        Longest log-time step, s; None where there is no step.
    fields : tuple of str
        Paths that can be signals; `data[0..99]` stands for `data[0]` to `data[99]`.
    stamps : {"none", "usable", "zero", "mixed"}
        Whether header stamps can be used.
    stamp_offset : float or None
        Median of log time less header stamp, s; None without a stamp.
    """

    info: TopicInfo
    rate: float | None
    largest_gap: float | None
    fields: tuple[str, ...]
    stamps: Literal["none", "usable", "zero", "mixed"]
    stamp_offset: float | None


def describe(bag: Bag, progress: Callable[[Iterable[Any], int], Iterable[Any]] | None = None) -> list[TopicFacts]:
    """Facts about every topic of a recording; reads it once, and decodes one message of each topic.

    Field paths are taken from the longest message of a topic, so that its arrays have their lengths.

    Parameters
    ----------
    bag : Bag
        The recording.
    progress : callable, optional
        Wraps the messages, given their number, as in `read_transients`.

    Returns
    -------
    list of TopicFacts
        One per topic.

    Raises
    ------
    BagError
        The recording cannot be read any more.
    """
    times: dict[str, array[int]] = {topic: array("Q") for topic in bag.topics}
    offsets: dict[str, array[float]] = {topic: array("d") for topic in bag.topics}
    zeros = dict.fromkeys(bag.topics, 0)
    longest: dict[str, RawMessage] = {}
    messages: Iterable[RawMessage] = bag.raw_messages()
    if progress is not None:
        messages = progress(messages, sum(info.count for info in bag.topics.values()))
    for raw in messages:
        channel, topic = raw.channel, raw.channel.topic
        if not channel.counted:
            continue
        times[topic].append(raw.log_time_ns)
        if channel.definition.reason:
            continue
        if topic not in longest or len(raw.data) > len(longest[topic].data):
            longest[topic] = raw
        if channel.definition.has_header:
            if stamp := channel.definition.stamp_ns(raw.data):
                offsets[topic].append((raw.log_time_ns - stamp) * 1e-9)
            else:
                zeros[topic] += 1
    return [
        _facts(info, times[topic], offsets[topic], zeros[topic], longest.get(topic))
        for topic, info in bag.topics.items()
    ]


def _facts(
    info: TopicInfo, times: array[int], offsets: array[float], zeros: int, longest: RawMessage | None
) -> TopicFacts:
    steps = [b - a for a, b in itertools.pairwise(times)]
    step = median(steps) if steps else 0
    fields: tuple[str, ...] = ()
    if longest:
        definition = longest.channel.definition
        try:
            message = definition.decode(longest.data)
            fields = tuple(signal_paths(definition.fields, definition.type_name, message))
        except BagError:
            pass  # `messages` tells it
    return TopicFacts(
        info,
        rate=1e9 / step if step else None,
        largest_gap=max(steps) * 1e-9 if steps else None,
        fields=fields,
        stamps="mixed" if zeros and offsets else "usable" if offsets else "zero" if zeros else "none",
        stamp_offset=median(offsets) if offsets else None,
    )
