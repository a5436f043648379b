# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""MCAP files that are made to hurt, seeded: well formed in parts, and wrong where parts meet."""

import random
import struct
from collections.abc import Callable, Sequence

import zstandard
from bag_writer import (
    Message,
    Topic,
    channel_record,
    chunk_index,
    chunk_record,
    message_record,
    raw_file,
    record,
    schema_record,
    statistics_record,
)

EXTREME_TIMES = (0, 1, 2**62, 2**63 - 1, 2**63, 2**64 - 1)
LARGEST_RUN = 1 << 20  # bytes of repeated records, before compression


def schema_without_end(rng: random.Random) -> str:
    """A definition that is long, deep, wide, of another editor, or cut off."""
    n = rng.choice((3, 40, 1000))
    parts = ("\n" + "=" * 80 + "\n").join
    makers: tuple[Callable[[], str], ...] = (
        lambda: "".join(f"string[{rng.choice((1, 4096, 2**31))}] a{i}\n" for i in range(8)),
        lambda: parts(["T1 a\nT1 b", *(f"MSG: p/T{i}\nT{i + 1} a\nT{i + 1} b" for i in range(1, n))]),
        lambda: parts(["T1 a", *(f"MSG: p/T{i}\nT{i + 1}[2] a" for i in range(1, n)), f"MSG: p/T{n}\n"]),
        lambda: "T a",
        lambda: "p/T a\n" + "=" * 80 + "\nMSG: p/T\np/T[] a",
        lambda: "\n" * 100_000 + "float64 data\n",
        lambda: "# x\r\n" * n + "float64 data\r\n",
        lambda: "".join(f"float64 x{i}\n" for i in range(10 * n)),
        lambda: "float64[" * n,
        lambda: "float64 " + "x" * 100_000,
        lambda: "float64[] x [" + "1," * 20 * n,
        lambda: "\x1b[2J\x00\ufeff float64 data",
        lambda: "float64[0] data\nint8[4294967296] b",
    )
    return rng.choice(makers)()


def odd_name(rng: random.Random) -> str:
    """A topic's name with what a terminal obeys, or of 100 KB, or none."""
    return rng.choice(("", "/x\x1b[31m\x07", "/y\n\r\t", "/z" + "n" * 100_000, "/\u202eabc", "no slash", "/state"))


def repeated(rng: random.Random) -> bytes:
    """One small record again and again."""
    kinds = [bytes(9), record(0x80), record(rng.randrange(1, 256)), message_record(1, 5, b"")]
    one = rng.choice([*kinds, record(5, bytes(21)), b"\xff" * 9])
    return one * (rng.choice((100, 10_000, LARGEST_RUN)) // len(one))


def stretched(rng: random.Random, part: bytes) -> bytes:
    """The same record with another length: over its neighbour, or too short."""
    (length,) = struct.unpack_from("<Q", part, 1)
    wrong = rng.choice((length + rng.randrange(1, 300), max(0, length - rng.randrange(1, 60)), 2**63, 2**64 - 1, 0))
    return part[:1] + struct.pack("<Q", wrong) + part[9:]


def hostile_file(rng: random.Random, topics: Sequence[Topic], messages: Sequence[Message]) -> bytes:
    """A file of these messages, and of what nobody would write."""
    padding = rng.choice((b"", b"", b"padding"))
    channels = {topic.name: i for i, topic in enumerate(topics, start=1)}
    definitions = [
        schema_record(i, topic, padding) + channel_record(i, topic, i, padding)
        for i, topic in enumerate(topics, start=1)
    ]
    extra = []
    for _ in range(rng.choice((0, 1, 3))):
        encoding = rng.choice(("ros2msg", "ros2msg", "ros2idl"))
        extra.append(Topic(odd_name(rng), "p/msg/T", schema=schema_without_end(rng), schema_encoding=encoding))
    for i, topic in enumerate(extra, start=len(topics) + 1):
        definitions.append(schema_record(i, topic) + channel_record(i, topic, i))
        if rng.random() < 0.3:
            definitions.append(channel_record(rng.randrange(1, i + 1), topic, rng.randrange(i + 2)))
    every = []
    for m in messages:
        time = rng.choice(EXTREME_TIMES) if rng.random() < 0.005 else m.log_time
        data = m.data
        if rng.random() < 0.02:
            data = rng.choice((b"", data[:-4], data + bytes(8), *map(zstandard.compress, (data, bytes(1 << 24)))))
        number = channels[m.topic] if rng.random() < 0.99 else rng.randrange(len(topics) + len(extra) + 2)
        every.append(message_record(number, time, data))
    size = rng.choice((7, 30, len(every)))
    parts = [b"".join(definitions)] if rng.random() < 0.5 else []
    groups = [every[i : i + size] for i in range(0, len(every), size)]
    for i, group in enumerate(groups):
        content = (b"".join(definitions) if i == 0 or rng.random() < 0.2 else b"") + b"".join(group)
        if rng.random() < 0.15:
            content += repeated(rng)
        if rng.random() < 0.1:
            content = content[: rng.randrange(len(content))]
        if rng.random() < 0.1:
            content += record(0x90, chunk_record(message_record(1, 7, b"inner")))
        kind = rng.choice(("zstd", "lz4", ""))
        stated = rng.choice((None, None, None, None, 0, len(content) + 1, 2**28, 2**40, 2**64 - 1))
        part = content if rng.random() < 0.1 else chunk_record(content, kind, stated=stated)
        parts.append(part)
    for _ in range(rng.choice((0, 1, 3))):
        kinds = [repeated(rng), record(9, struct.pack("<QQ", 1, 2) + bytes(rng.randrange(60)))]
        kinds.append(record(12, struct.pack("<I", rng.choice((0, 5, 2**32 - 1))) + bytes(rng.randrange(40))))
        kinds.append(record(rng.choice((2, 15, 0x80, 0xFF, 3, 4, 7, 8, 11)), bytes(rng.randrange(50))))
        odd = rng.choice([*kinds, chunk_record(bytes(LARGEST_RUN))])
        parts.insert(rng.randrange(len(parts) + 1), odd)
    if rng.random() < 0.4:
        at = rng.randrange(len(parts))
        parts[at] = stretched(rng, parts[at]) if len(parts[at]) > 9 else parts[at]
    if rng.random() < 0.3:
        return raw_file(*parts)
    place, indexes = len(raw_file()), []
    for part in parts:
        if len(part) > 60 and part[0] == 6 and rng.random() < 0.9:
            lie = rng.choice((0, 0, 0, 0, 1, 9, len(part) // 2, -20, 10**6))
            indexes.append(chunk_index(place + lie, part, channels=channels.values(), compression="zstd"))
        place += len(part)
    rng.shuffle(indexes)
    counts = {number: rng.choice((40, 40, 0, 2**62)) for number in channels.values()}
    statistics = statistics_record(counts, rng.choice((len(indexes), len(indexes), 0, 2**31)))
    listed = [statistics, *indexes]
    summary = b"".join(rng.sample(listed, len(listed)) if rng.random() < 0.5 else listed)
    return raw_file(*parts, summary=rng.choice((b"", summary, b"".join(definitions) + summary)))
