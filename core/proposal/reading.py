# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Reading: every topic of some recordings with its numbers, and which of these move."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import SignalError
from uncertain_lti.base.text import plural
from uncertain_lti.proposal.candidates import FEWEST, OF_QUATERNION, WRAPPING, Candidate, Source
from uncertain_lti.proposal.effects import residual
from uncertain_lti.proposal.roles import role_by_name, role_of_column
from uncertain_lti.recordings.recording import Recording, TopicFacts
from uncertain_lti.recordings.table import TYPE, Table
from uncertain_lti.sampling.steady_state import codes
from uncertain_lti.signals.field_path import FieldPath

Iterate = Callable[[Iterable[object], int], Iterable[object]]


LONGEST_ARRAY = 24
"""Entries of an array that are looked at one by one; a longer one is a picture, a scan or a map."""


MOST_VALUES = 50_000_000
"""Numbers read at most; fields beyond are listed and not looked at."""


_RUN = re.compile(
    r"(^|_)(run|trial|episode|experiment|exp|test|group|session|rollout|flight|lap|trajectory|traj|unit)s?"
    r"(_?(id|no|nr|num|number|index|idx))?$"
)  # name of a column that says which run a row is of


_SPREAD = re.compile(r"\[(\d+)\.\.(\d+)\]")


def read_sources(bags: Sequence[Recording], progress: Iterate | None) -> list[Source]:
    """Every topic of the recordings with its numbers."""
    facts: dict[str, TopicFacts] = {}
    for bag in bags:
        for fact in bag.facts(progress):
            known = facts.get(fact.info.topic)
            if known is None or (not known.fields and fact.fields):
                facts[fact.info.topic] = fact
    sources = []
    for topic, fact in facts.items():
        total = sum(bag.topics[topic].count for bag in bags if topic in bag.topics)
        if fact.info.type == TYPE:
            sources += _of_table(fact, total)
            continue
        stamped, role = fact.stamps in ("usable", "mixed"), role_by_name(topic, fact.info.type)
        source = Source(topic, fact.info.type, role, stamped, fact.stamp_offset)
        sources.append(source)
        if not fact.info.readable:
            source.reason = fact.info.reason
        elif source.role == "apart":
            source.reason = "no signal of a machine by its name or type"
        elif total < (3 if source.role == "control" else FEWEST):
            source.reason = f"{plural(total, 'message')} only"
        elif any(topic not in b.topics or not b.topics[topic].count for b in bags):
            source.reason = "not in every recording"
        elif any(b.topics[topic].type != fact.info.type for b in bags):
            source.reason = "of different types in these recordings"
        else:
            source.candidates = _candidates(topic, fact.fields)
            if not source.candidates:
                source.reason = "no number in it"
        if source.reason:
            source.candidates = []
    _limit(bags, sources)
    for bag in bags:
        _read(bag, [s for s in sources if s.candidates], progress)
    for source in sources:
        if source.candidates and not source.rate > 0:
            source.reason, source.candidates = "no time passes between its messages", []
        _sift(source)
    return sources


def moving_numbers(bag: Recording, progress: Iterate | None) -> tuple[list[tuple[str, str, Array, Array]], list[str]]:
    """Every number of a recording that moves.

    Returns (messages,): topic, path, time of arrival in s after the first message of them all, and values.
    """
    sources = read_sources([bag], progress)
    chosen = [(s, c) for s in sources if not s.reason for c in s.candidates if not c.reason]
    start = min((int(s.arrival[0][0]) for s, _ in chosen), default=0)
    found = [
        (s.topic, c.path, np.asarray((s.arrival[0] - start) * 1e-9, dtype=np.float64), c.values[0]) for s, c in chosen
    ]
    left = [f"{s.topic}: {s.reason}" for s in sources if s.reason]
    left += [f"{s.topic} {c.path}: {c.reason}" for s in sources if not s.reason for c in s.candidates if c.reason]
    return found, left


def run_column(bags: Sequence[Recording]) -> str:
    """Column of tables that tells the runs in one file apart."""
    tables = [bag for bag in bags if isinstance(bag, Table)]
    if not tables or len(tables) < len(bags):
        return ""
    for name in tables[0].columns_by_field:
        if all(_tells_runs(table, name) for table in tables):
            return name
    return ""


def _tells_runs(table: Table, name: str) -> bool:
    column = table.columns_by_field.get(name)
    if column is None or column.ndim != 1 or column.dtype.kind == "M" or len(column) < 2 * FEWEST:
        return False
    if column.dtype.kind == "f" and not (column == np.rint(column)).all():
        return False
    changes = 1 + np.flatnonzero(column[1:] != column[:-1])
    runs = len(changes) + 1
    if not 2 <= runs <= len(column) // FEWEST or len(set(column[[0, *changes]].tolist())) < runs:
        return False
    return bool(_RUN.search(name.lower()) or (np.diff(table.times)[changes - 1] <= 0).all())


def _of_table(fact: TopicFacts, rows: int) -> list[Source]:
    """The columns of a table, those that are commands by their names apart from the others."""
    by_role: dict[str, list[str]] = {}
    for field in fact.fields:
        by_role.setdefault(role_of_column(field), []).append(field)
    sources = []
    for role, fields in by_role.items():
        source = Source(fact.info.topic, TYPE, role, False, None)
        if rows < FEWEST:
            source.reason = f"{plural(rows, 'row')} only"
        else:
            source.candidates = _candidates(fact.info.topic, fields)
        sources.append(source)
    return sources


def _limit(bags: Sequence[Recording], sources: Sequence[Source]) -> None:
    """Look at no more numbers than memory holds: commands first, then states, from the first field on."""
    order = ("control", "state", "reference", "")
    left = MOST_VALUES
    for source in sorted((s for s in sources if s.candidates), key=lambda s: order.index(s.role)):
        for candidate in source.free:
            left -= max(1, sum(bag.topics[source.topic].count for bag in bags))
            if left < 0:
                candidate.reason = "not looked at, the recordings are too large: propose from a shorter one"


def _candidates(topic: str, fields: Sequence[str]) -> list[Candidate]:
    """Paths as they would stand in a file; arrays entry by entry, long ones once with the reason."""
    found: list[Candidate] = []
    for path in fields:
        size = math.prod(int(b) - int(a) + 1 for a, b in _SPREAD.findall(path))
        if re.search(r"(covariance|variance)", path):
            continue
        if size > LONGEST_ARRAY:
            found.append(Candidate(topic, path, reason=f"an array of {size} numbers"))
            continue
        *inner, last = _SPREAD.split(path)  # text, first, last, text, ...
        starts, firsts, lasts = inner[::3], map(int, inner[1::3]), map(int, inner[2::3])
        entries = [[f"{text}[{i}]" for i in range(a, b + 1)] for text, a, b in zip(starts, firsts, lasts, strict=True)]
        found += [Candidate(topic, "".join(parts) + last) for parts in product(*entries)]
    return found


def _read(bag: Recording, sources: Sequence[Source], progress: Iterate | None) -> None:
    """Values of every candidate in one recording."""
    for source in sources:
        readable = [c for c in source.candidates if not c.reason]
        paths = [FieldPath(c.path) for c in readable]
        try:
            columns = bag.columns([source.topic], [paths], progress)
            arrival, stamp, values = columns.arrival, columns.stamp, columns.values[0]
            stamps = columns.stamp[columns.stamp >= 0]
            if len(stamps) > 1 and np.count_nonzero(np.diff(stamps) > 0) < 0.5 * (len(arrival) - 1):
                source.halting = True
        except SignalError:
            read = [(t, [path.read(message) for path in paths]) for _, t, message in bag.messages([source.topic])]
            arrival = np.array([t for t, _ in read], dtype=np.int64)
            values = np.array([row for _, row in read], dtype=np.float64).reshape(len(read), len(paths))
            stamp = np.full(len(arrival), -1, dtype=np.int64)
        source.arrival.append(arrival)
        source.stamp.append(stamp)
        for column, candidate in zip(values.T, readable, strict=True):
            candidate.values.append(column)


def _sift(source: Source) -> None:
    """Say of each number whether it moves; angles in place of the quaternions that are some."""
    if not source.candidates:
        return
    bases = {m[2] for c in source.candidates if (m := re.fullmatch(rf"({OF_QUATERNION})\((.+)\)", c.path))}
    parts = {c.path: c for c in source.candidates}
    for base in bases:
        raw = [parts.get(f"{base}.{axis}") for axis in "xyzw"]
        read = [r for r in raw if r is not None and r.values]
        norm = np.sqrt(sum(np.concatenate(r.values) ** 2 for r in read)) if len(read) == 4 else np.zeros(1)
        unit = np.abs(norm[np.isfinite(norm)] - 1.0) < 0.02
        is_rotation = len(unit) > 0 and unit.mean() > 0.9
        for candidate in source.candidates:
            of_base = candidate.path.startswith(f"{base}.") or candidate.path.endswith(f"({base})")
            if of_base and candidate.path.endswith(f"({base})") != is_rotation:
                candidate.reason = "|"  # the other form of the same numbers has its line
    source.candidates = [c for c in source.candidates if c.reason != "|"]
    for candidate in source.free:
        _ignore(candidate)
        _judge(candidate, source)
    _wrapped(source)
    if all(c.reason for c in source.candidates):
        source.reason = "; ".join(f"{c.path} {c.reason}" for c in source.candidates[:3])
        source.reason += f" and {len(source.candidates) - 3} more" * (len(source.candidates) > 3)


def _ignore(candidate: Candidate) -> None:
    """Take numbers that stand for none out of the values."""
    found = codes(np.concatenate([np.empty(0), *candidate.values]))
    if found:
        candidate.ignore = tuple(sorted(found))
        candidate.values = [np.where(np.isin(v, candidate.ignore), np.nan, v) for v in candidate.values]


def _judge(candidate: Candidate, source: Source) -> None:
    if not candidate.values:
        candidate.reason = "not read"
        return
    values = np.concatenate(candidate.values)
    finite = values[np.isfinite(values)]
    if not len(finite):
        candidate.reason = "never a number"
    elif finite.min() == finite.max():
        candidate.reason = f"always {finite[0] + 0.0:.6g}"
    elif len(finite) < 0.5 * len(values):
        candidate.reason = f"a number in {len(finite)} of {len(values)} messages only"
    elif (moved := len(finite) - int(np.unique(finite, return_counts=True)[1].max())) < max(3, len(finite) // 500):
        candidate.reason = f"leaves its usual value in {moved} of {plural(len(finite), 'message')} only"
    elif source.role == "state" and len(np.unique(finite)) < 3:
        candidate.reason = "takes two values only"
    elif source.role != "control" and _counts(values, np.concatenate(source.arrival)):
        candidate.reason = "grows as a clock or a counter does"
    elif max(abs(float(finite.min())), abs(float(finite.max()))) > 1e15:
        candidate.reason = "holds numbers beyond 1e15"


def _counts(values: Array, arrival: NDArray[np.int64]) -> bool:
    """Never falls, and is a whole number or follows the time of arrival."""
    good = np.isfinite(values)
    finite, t = values[good], (arrival[good] - arrival[0]) * 1e-9
    if len(finite) < 3 or (np.diff(finite) < 0).any() or len(np.unique(finite)) < 0.5 * len(finite):
        return False
    if (finite == np.rint(finite)).all():
        return True
    rest = residual(t[:, None], finite[:, None])[0]
    return bool(rest < (0.002 * np.ptp(finite)) ** 2 * len(finite))


def _wrapped(source: Source) -> None:
    """Angles that jump by a turn are unwrapped, those of a quaternion always."""
    for candidate in source.free:
        angle = re.match(rf"({WRAPPING})\(", candidate.path) is not None
        jumps = 0
        for values in candidate.values:
            finite = values[np.isfinite(values)]
            if len(finite) and np.ptp(finite) <= 2.2 * np.pi:
                jumps += int((np.abs(np.diff(finite)) > 1.6 * np.pi).sum())
        if angle or (jumps and re.search(r"(angle|yaw|heading|roll|theta|phi|psi|azimuth|course)", candidate.path)):
            candidate.path = f"unwrap({candidate.path})"
            candidate.values = [_unwrapped(v) for v in candidate.values]


def _unwrapped(values: Array) -> Array:
    finite = np.isfinite(values)
    out = values.copy()
    out[finite] = np.unwrap(values[finite])
    return out
