# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Scan of a rosbag2 database (sqlite3 storage, .db3): its topics, and blocks of rows that are read as MCAP records.

Rows are taken in the order of their numbers, which is that of recording. What the file holds of definitions counts;
for types of which it holds none, those of its ROS 2 distribution are taken. The rows before damage count. No statement
of the file is run: what it calls a table has to be one.
"""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from mcap.records import Channel, Schema

from uncertain_lti.base.errors import BagError
from uncertain_lti.recordings.mcap_records import LATEST, RECORD, Block, Contents, Tally, count, message_record
from uncertain_lti.recordings.mcap_records import MESSAGE as MESSAGE_FIELDS
from uncertain_lti.recordings.message_types import distribution_text, normal_name
from uncertain_lti.recordings.unreadable import os_error

MAGIC = b"SQLite format 3\0"
"""First bytes of a database."""

_BLOCK = 1 << 22  # bytes of messages that are read at once
_MOST_TOPICS = (1 << 16) - 1
_LARGEST_ROW = 1 << 28  # bytes
_TABLES = ("topics", "messages")
_COLUMNS = "id, topic_id, timestamp, data"
_STEP = 100_000  # instructions of the database; a row takes about 15
_LEAST_STEPS = 100
_STEPS_A_BYTE = 10
_FEW = 100  # topics that are named to the database one by one


@dataclass(slots=True)
class Database(Contents):
    """What `scan_database` found in a file; offset and size of a block are its first row and how many numbers it spans.

    `numbers`: topic in the file -> number of its channel.
    """

    numbers: dict[int, int] = field(default_factory=dict)

    converted: ClassVar[bool] = True

    def records(self, block: Block, channels: Collection[int] | None = None) -> bytes:
        """Rows of one block as MCAP messages."""
        kept = {topic: number for topic, number in self.numbers.items() if channels is None or number in channels}
        some = f"topic_id IN ({', '.join(map(str, kept))})" if len(kept) < min(len(self.numbers), _FEW) else "1"
        rows = f"SELECT {_COLUMNS} FROM messages NOT INDEXED WHERE id >= ? AND id < ? AND {some} ORDER BY id"
        pieces = []
        try:
            with closing(_open(self.path, self.size)) as database:
                for number, topic, time, data in database.execute(rows, (block.offset, block.offset + block.size)):
                    if topic in kept and isinstance(data, bytes) and _is_time(time):
                        pieces.append(message_record(kept[topic], number, time, time, data))
        except sqlite3.Error as error:
            raise BagError(
                f"{self.path}: the file changed while it was read ({error}); read it again when it is written"
            ) from None
        return b"".join(pieces)


def scan_database(path: Path) -> Database:
    """Go through a database once and note where its messages are."""
    try:
        found = Database(path, path.stat().st_size)
    except OSError as error:
        raise os_error(path, error) from None
    try:
        with closing(_open(path, found.size)) as database:
            _refuse_others(path, database)
            _declare(found, database)
            _walk(found, database)
    except sqlite3.Error as error:
        if not found.blocks:
            raise BagError(
                f"{path}: the database is damaged ({error}); copy it again, or mend it with `sqlite3 {path.name} "
                f"'.recover' | sqlite3 mended.db3`"
            ) from None
        found.warnings.append(
            f"{path}: the database is cut or damaged ({error}); {count(found.count, 'message')} before that count"
        )
    log = path.with_name(f"{path.name}-wal")
    if log.exists() and log.stat().st_size:
        found.warnings.append(
            f"{path}: messages that were not yet written to it are in {log.name} and are not read; put them in with "
            f"`sqlite3 {path.name} 'PRAGMA wal_checkpoint'`"
        )
    return found


def _open(path: Path, size: int) -> sqlite3.Connection:
    database = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(1 << 20, min(size, _LARGEST_ROW)))
    database.execute("PRAGMA trusted_schema=OFF")
    steps = iter(range(_LEAST_STEPS + _STEPS_A_BYTE * size // _STEP))  # pages that lead to each other end as well
    database.set_progress_handler(lambda: int(next(steps, None) is None), _STEP)
    database.text_factory = lambda data: data.decode(errors="replace")
    return database


def _refuse_others(path: Path, database: sqlite3.Connection) -> None:
    """Refuse a database without the tables of a recording; a view or a virtual table could run for ever."""
    query = "SELECT name, sql FROM sqlite_master WHERE type = 'table'"
    made = {str(name): str(sql) for name, sql in database.execute(query)}
    plain = {name for name, sql in made.items() if re.match(r"CREATE TABLE\b", sql, re.IGNORECASE)}
    if not plain.issuperset(_TABLES):
        raise BagError(f"{path}: a database without the tables of a ROS 2 recording (topics, messages); check the path")
    columns = {row[1] for row in database.execute("PRAGMA table_xinfo(messages)") if not row[6]}
    topics = {row[1] for row in database.execute("PRAGMA table_xinfo(topics)") if not row[6]}
    if not columns.issuperset({"id", "topic_id", "timestamp", "data"}) or not topics.issuperset({"id", "name", "type"}):
        raise BagError(f"{path}: its tables topics and messages are not those of a ROS 2 recording; check the path")


def _declare(found: Database, database: sqlite3.Connection) -> None:
    """Channels and schemas of the file."""
    tables = {row[0] for row in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    columns = {row[1] for row in database.execute("PRAGMA table_xinfo(topics)")}
    texts: dict[str, tuple[str, bytes]] = {}
    if "message_definitions" in tables:
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions LIMIT 65536"
        for kind, encoding, text in database.execute(query):
            if text:
                data = text if isinstance(text, bytes) else str(text).encode()
                texts[normal_name(str(kind))] = str(encoding), data
    distribution = ""
    if "schema" in tables:
        row = database.execute("SELECT * FROM schema LIMIT 1").fetchone()
        distribution = str(row[1]) if row and len(row) > 1 else ""
    chosen = ", ".join(name if name in columns else "''" for name in ("serialization_format", "offered_qos_profiles"))
    schemas: dict[str, int] = {}
    borrowed = ""
    for number, row in enumerate(database.execute(f"SELECT id, name, type, {chosen} FROM topics ORDER BY id"), start=1):
        topic, name, kind, encoding, qos = row
        if not isinstance(topic, int):
            continue
        if number > _MOST_TOPICS:
            found.warnings.append(f"{found.path}: topics beyond {_MOST_TOPICS} are left out")
            break
        kind = normal_name(str(kind))
        if kind not in schemas:
            schema = schemas[kind] = len(schemas) + 1
            if kind not in texts:
                text, store = distribution_text(kind, distribution)
                texts[kind] = "ros2msg", text.encode()
                borrowed = borrowed or store
            found.schemas[schema] = Schema(schema, texts[kind][1], texts[kind][0], kind)
        metadata = {"offered_qos_profiles": str(qos)} if qos else {}
        found.numbers[topic] = number
        found.channels[number] = Channel(number, str(name), str(encoding or "cdr"), metadata, schemas[kind])
    if borrowed:
        found.warnings.append(
            f"{found.path}: the file does not hold the definitions of all its types; those of {borrowed} are used"
        )


def _is_time(value: Any) -> bool:
    return isinstance(value, int) and 0 <= value <= LATEST


def _walk(found: Database, database: sqlite3.Connection) -> None:
    """Blocks of rows, and how many messages each topic has."""
    begin: int | None = None
    length, start, end, odd = 0, 0, 0, 0
    channels: set[int] = set()
    last: int | None = None

    def close(after: int) -> None:
        nonlocal begin, length
        if begin is not None and channels:
            block = Block(begin, after - begin, "", length, start, end, frozenset(channels))
            found.blocks.append(block)
        begin, length = None, 0
        channels.clear()

    try:
        for number, topic, time, size in _rows(database):
            if last is not None and number <= last:
                raise sqlite3.DatabaseError("its rows are not in order")
            last = number
            if topic not in found.numbers or size is None:
                odd += 1
                continue
            if begin is None:
                begin, start, end = number, time, time
            channel = found.numbers[topic]
            channels.add(channel)
            start, end = min(start, time), max(end, time)
            tally = found.tally.get(channel)
            if tally is None:
                found.tally[channel] = Tally(1, time, time)
            else:
                tally.count += 1
                tally.first, tally.last = min(tally.first, time), max(tally.last, time)
            length += size + RECORD.size + MESSAGE_FIELDS.size
            if length >= _BLOCK:
                close(number + 1)
    finally:
        if last is not None:
            close(last + 1)
        if odd:
            found.warnings.append(
                f"{found.path}: {count(odd, 'message')} left out, of no topic or without a log time or data"
            )


def _rows(database: sqlite3.Connection) -> Iterator[tuple[int, int, int, int | None]]:
    """Number, topic, log time and size of each row; size None where one of them is unusable."""
    query = "SELECT id, topic_id, timestamp, length(data), typeof(data) FROM messages NOT INDEXED ORDER BY id"
    for number, topic, time, size, kind in database.execute(query):
        if not isinstance(number, int):
            raise sqlite3.DatabaseError("its rows have no numbers")
        yield number, topic, time, size if kind == "blob" and _is_time(time) else None
