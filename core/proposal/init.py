# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Proposal: a signals file suggested from what a recording holds, for a person to edit."""

from __future__ import annotations

import math
import os
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import accumulate, product, repeat

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array, spread
from uncertain_lti.base.errors import BagError, absent
from uncertain_lti.base.text import meant, plural, shortlist
from uncertain_lti.proposal.candidates import (
    FEWEST,
    OF_QUATERNION,
    TWO_VALUES,
    WRAPPING,
    Candidate,
    Source,
    ask_for,
    at_rest,
    bare,
    part_by_role,
    role_by_name,
    role_of_column,
    set_aside_labels,
    take_switches,
)
from uncertain_lti.proposal.choosing import assign_roles, choose
from uncertain_lti.proposal.members import all_of_them, moves_per
from uncertain_lti.proposal.process_data import ALWAYS, WEATHER, in_words, is_plant, plant_signals, run_column
from uncertain_lti.proposal.signals_file import (
    ATTITUDE,
    as_unwatched,
    memory_lines,
    name_signals,
    of_attitude,
    of_compass,
    of_wheel,
    set_operating_point,
    set_own_scale,
    signals_file,
    turn_of_count,
    words_of,
)
from uncertain_lti.recordings.formats import group_recordings
from uncertain_lti.recordings.recording import Columns, Progress, Recording, TopicFacts
from uncertain_lti.recordings.table import Table
from uncertain_lti.recordings.table_text import QUALITY, rated
from uncertain_lti.recordings.table_times import called_time
from uncertain_lti.sampling.steady_state import codes, shared_codes
from uncertain_lti.signals.field_path import FieldPath
from uncertain_lti.signals.values import TABLE, TableLayout

LONGEST_ARRAY = 35
"""Entries of an array that are looked at one by one, such as motors of a humanoid; a longer one is a matrix, a scan."""


DUST = 1e-9
"""Range of a number of a ROS message, in its SI unit, below which no sensor tells it: of a simulated joint at rest."""
MOST_VALUES = 50_000_000
"""Numbers looked at, about; of more, some recordings or a part of one."""


_CLOCK = {"time", "timestamp", "stamp", "clock", "tow", "utc", "epoch", "sec", "secs", "seconds"}  # words in its name
_CLOCK |= {"usec", "nsec", "nanosec", "odometer", "mileage", "miles"}  # parts of a stamp, or what counts the way
_CLOCK |= {"hours", "runtime", "betriebsstunden", "horas", "second", "minute", "hour"}  # of running, of a day
_ADDED = {"distance", "wh", "kwh", "mwh", "mah", "totalizer", "totaliser", "consumed", "cumulative"}
_COMPUTER = re.compile(
    r"(^|_)(elapsed|latency|cpu\d*|crc\d*|checksum|rssi|lqi|[hvptg]dop|n(um)?_?sats?|satellites?|accuracy)(_|$)|^dt$"
)  # what it took for a cycle, how busy it is, how well something is received
_COUNTER = {"count", "counter", "cycle", "cycles", "frame", "id", "seq"}  # likewise, of whole numbers
_COMPUTED = {"err", "error", "average", "avg", "mean", "sum", "total", "diff", "difference", "deviation"}
_PLACE = re.compile(r"latitude|longitude|(^|_)(lat|lon|lng)$")  # column of a place on the map
_APART = "not in every recording"
_FILL = "fill the empty cells with the number above"


_SPREAD = re.compile(r"\[(\d+)\.\.(\d+)\]")
_VARIANCE = re.compile(r"variance|(?<!process)_var(?=\[|$)")  # of an estimate


def read_sources(
    bags: Sequence[Recording], progress: Progress | None, asked: Sequence[str] = ()
) -> tuple[list[Source], list[str]]:
    """Every topic of the recordings with its numbers, those of what a person asks for whatever it is called; notes."""
    facts: dict[str, TopicFacts] = {}
    held: dict[str, Counter[str]] = defaultdict(Counter)  # in how many recordings a field is
    for bag in bags:
        for fact in bag.facts(progress):
            held[fact.info.topic].update(fact.fields)
            known = facts.get(fact.info.topic)
            if known is None or (not known.fields and fact.fields):
                facts[fact.info.topic] = fact
    sources = []
    for topic, fact in facts.items():
        total = sum(_messages(bag, topic) for bag in bags)
        if fact.info.type == TABLE:
            parts = _of_table(topic, total, {f: number == len(bags) for f, number in held[topic].items()})
            sources += parts
            for candidate in (c for source in parts for c in source.candidates):
                of_each = {bag.units.get(candidate.path, "") for bag in bags}
                candidate.unit = of_each.pop() if len(of_each) == 1 else ""
            continue
        stamped, role = fact.stamps in ("usable", "mixed"), role_by_name(topic, fact.info.type)
        if role == "apart" and any(fnmatchcase(topic, pattern.partition(":")[0]) for pattern in asked):
            role = ""
        source = Source(topic, fact.info.type, role, stamped, fact.stamp_offset)
        sources.append(source)
        if not fact.info.readable:
            source.reason, source.unreadable = fact.info.reason, True
        elif role == "apart":
            source.reason = "no signal of a machine by its name or type; if it is one, name it in --states"
        elif total < (3 if source.role == "control" else FEWEST):
            source.reason = f"{plural(total, 'message')} only"
        elif not all(_messages(bag, topic) for bag in bags):
            source.reason = _APART
        elif any(b.topics[topic].type != fact.info.type for b in bags):
            source.reason = "of different types in these recordings"
        else:
            source.candidates = _candidates(source, fact.fields)
            if not source.candidates:
                source.reason = "no number in it"
            elif role in ("state", ""):
                sources += part_by_role(source)
    some, share, said = _looked_at(bags, sources)
    for bag in some:
        _read(bag, [s for s in sources if s.candidates], share, progress)
    for source in sources:
        source.halting |= len({bool((stamp > 0).any()) for stamp in source.stamp}) > 1
        if source.candidates and not source.rate > 0:
            source.reason, source.candidates = "no time passes between its messages", []
        elif source.candidates:
            _sift(source)
    return sources, [said] * bool(said)


def _messages(bag: Recording, topic: str) -> int:
    return bag.topics[topic].count if topic in bag.topics else 0


def moving_numbers(bag: Recording, progress: Progress | None) -> tuple[list[tuple[str, str, Array, Array]], list[str]]:
    """Every number of a recording that moves.

    Returns (messages,): topic, path, time of arrival in s after the first message of them all, and values.
    """
    sources, left = read_sources([bag], progress)
    chosen = [(s, c) for s in sources if not s.reason for c in s.candidates if not c.reason]
    start = min((int(s.arrival[0][0]) for s, _ in chosen), default=0)
    found = [(s.topic, c.path, np.multiply(s.arrival[0] - start, 1e-9), c.values[0]) for s, c in chosen]
    left += [f"{s.topic}: {s.reason}" for s in sources if s.reason]
    left += [f"{s.topic} {c.path}: {c.reason}" for s in sources if not s.reason for c in s.candidates if c.reason]
    return found, left


def _of_table(topic: str, rows: int, everywhere: Mapping[str, bool]) -> list[Source]:
    """The columns of tables, those that are commands by their names apart from the others."""
    by_role: dict[str, list[str]] = {}
    beside = {bare(field) for field in everywhere}
    for field in everywhere:
        by_role.setdefault(role_of_column(field, beside), []).append(field)
    reason = f"{plural(rows, 'row')} only" if rows < FEWEST else "" if any(everywhere.values()) else _APART
    sources = []
    for role, fields in by_role.items():
        sources.append(source := Source(topic, TABLE, role, False, None, reason=reason))
        if not reason:
            source.candidates = _candidates(source, [f for f in fields if everywhere[f]])
            source.candidates += [Candidate(source, f, reason=_APART) for f in fields if not everywhere[f]]
    return sources


def _looked_at(bags: Sequence[Recording], sources: Sequence[Source]) -> tuple[Sequence[Recording], float, str]:
    """Recordings with as many numbers as memory is for, spread over all, the share of their time, and what to say."""
    wanted, order = [(s.topic, len(s.free)) for s in sources], spread(len(bags))
    together = [*accumulate(sum(count * _messages(bags[i], topic) for topic, count in wanted) for i in order)]
    taken = max(1, sum(numbers <= MOST_VALUES for numbers in together))
    some, share = [bags[i] for i in sorted(order[:taken])], min(1.0, MOST_VALUES / max(together[0], 1))
    part = f"the middle {share:.0%} of {some[0].path.name}" if share < 1.0 else f"{taken} of {len(bags)} recordings"
    said = f"of more numbers than memory is for, those of {part} were looked at"
    return some, share, said * (taken < len(bags) or share < 1.0)


def _candidates(source: Source, fields: Sequence[str]) -> list[Candidate]:
    """Paths as they would stand in a file; arrays entry by entry, long ones once with the reason."""
    found: list[Candidate] = []
    for path in (path for path in fields if not _VARIANCE.search(path)):
        size = math.prod(int(b) - int(a) + 1 for a, b in _SPREAD.findall(path))
        if size > LONGEST_ARRAY:
            found.append(Candidate(source, path, reason=f"an array of {size} numbers"))
            continue
        *inner, last = _SPREAD.split(path)  # text, first, last, text, ...
        starts, firsts, lasts = inner[::3], map(int, inner[1::3]), map(int, inner[2::3])
        entries = [[f"{text}[{i}]" for i in range(a, b + 1)] for text, a, b in zip(starts, firsts, lasts, strict=True)]
        found += [Candidate(source, "".join(parts) + last) for parts in product(*entries)]
    return found


def _read(bag: Recording, sources: Sequence[Source], share: float, progress: Progress | None) -> None:
    """Values of every candidate in one recording, or in the middle of it, such a share of its time."""
    ends = [t for s in sources for t in (bag.topics[s.topic].first, bag.topics[s.topic].last) if t is not None]
    for source in sources:
        readable = [c for c in source.candidates if not c.reason]
        paths = [FieldPath(c.path) for c in readable]
        columns = bag.columns([source.topic], [paths], progress)
        if share < 1.0:
            middle = np.abs(2 * (columns.arrival - min(ends)) - np.ptp(ends)) <= share * np.ptp(ends)
            values = columns.values[0][middle]
            columns = Columns(columns.topic[middle], columns.arrival[middle], columns.stamp[middle], [values])
        stamps = columns.stamp[columns.stamp >= 0]
        if len(stamps) > 1 and np.count_nonzero(np.diff(stamps) > 0) < 0.5 * (len(columns.arrival) - 1):
            source.halting = True
        source.arrival.append(columns.arrival)
        source.stamp.append(columns.stamp)
        for column, candidate in zip(columns.values[0].T, readable, strict=True):
            candidate.values.append(column)


def _sift(source: Source) -> None:
    """Say of each number whether it moves; angles in place of the quaternions that are some."""
    bases = {m[2] for c in source.candidates if (m := re.fullmatch(rf"({OF_QUATERNION})\((.+)\)", c.path))}
    for base in bases:
        part = re.compile(rf"{re.escape(base)}(\.[xyzw]|\[[0-3]\]|_?[0-3])").fullmatch
        is_rotation = of_attitude([c for c in source.candidates if part(c.path) and c.values])
        source.candidates = [  # the other form of the same numbers has its line
            c for c in source.candidates if not (part(c.path) if is_rotation else c.path.endswith(f"({base})"))
        ]
    numbered = [c for c in source.candidates if c.values and re.search(r"\d\]?$", c.path)]
    for of in {c.path.rstrip("]")[:-1] for c in numbered}:
        parts = [c for c in numbered if c.path.rstrip("]")[:-1] == of]
        if of_attitude(parts) and any(np.ptp(c.finite) > 0 for c in parts):
            for candidate in parts:
                candidate.reason, candidate.ready = ATTITUDE, "state"
    for candidate in source.free if source.type == TABLE else ():  # before its usual value is taken for none
        if QUALITY.fullmatch("_".join(words_of(candidate.path))) and rated(candidate.finite)[0].any():
            candidate.reason = "a quality code, by its name and values"
    each = {id(c): np.concatenate([np.empty(0), *c.values]) for c in source.free}
    measured = source.type == TABLE and source.role != "control"  # a command stands at its least, and no sensor failed
    shared = shared_codes(list(each.values())) if measured else set()
    for candidate in source.free:
        values = each[id(candidate)]
        found = {*codes(values), *(code for code in shared if (values == code).any())}
        if found:  # numbers that stand for none
            candidate.ignore = tuple(sorted(found))
            candidate.values = [np.where(np.isin(v, candidate.ignore), np.nan, v) for v in candidate.values]
        candidate.reason = _unfit(candidate, source)
    _wrapped(source)
    if source.type == TABLE:
        _leave_out_places(source)
    if all(c.reason for c in source.candidates):
        source.reason = "; ".join(f"{c.path} {c.reason}" for c in source.candidates[:3])
        source.reason += f" and {len(source.candidates) - 3} more" * (len(source.candidates) > 3)


def _unfit(candidate: Candidate, source: Source) -> str:
    """Why a number is no signal; "" if nothing is against it."""
    if not candidate.values:
        return "not read"
    values, finite = np.concatenate(candidate.values), candidate.finite
    if not len(finite):
        return "never a number"
    in_a_row = sum(np.count_nonzero(np.isfinite(v[:-1]) & np.isfinite(v[1:])) for v in candidate.values)
    if len(finite) < 0.5 * len(values) or in_a_row < 0.1 * len(values):  # of a column that is written more rarely
        what = f"rows only, so {_FILL}" if source.type == TABLE else "messages only"
        return f"a number in {len(finite)} of {len(values)} {what}"
    name = "_".join(words_of(candidate.path))
    if _COMPUTER.search(name) and (np.diff(finite) <= 0).any():  # else a clock
        return "of a computer or a receiver, by its name, and no signal of the machine"
    if finite.min() == finite.max():
        return f"{ALWAYS}{finite[0] + 0.0:.6g}"
    if source.type != TABLE and np.ptp(finite) < DUST:
        return f"moves by {np.ptp(finite):.2g} in all, which is rounding"
    counts = np.unique(finite, return_counts=True)[1]
    if (moved := len(finite) - int(counts.max())) < max(3, len(finite) // 500):
        return f"leaves its usual value in {moved} of {plural(len(finite), 'message')} only"
    known = [np.isfinite(values) for values in candidate.values]
    apart = [v[k] for v, k in zip(candidate.values, known, strict=True)]
    anew = [np.flatnonzero(np.diff(t[k]) < 0) + 1 for t, k in zip(source.arrival, known, strict=True)]
    pieces = [piece for v, at in zip(apart, anew, strict=True) for piece in np.split(v, at)]  # where the time restarts
    if source.role != "control" and all(np.ptp(piece) == 0 for piece in pieces if len(piece)):
        return "the same all through each recording: a setting, and no measurement"
    if source.role == "state" and len(counts) < 3:
        return TWO_VALUES
    if source.type == TABLE and _PLACE.search(name):
        return "a place on the map, and another run may be elsewhere"
    wheel = of_wheel(candidate)
    names = _CLOCK | _COUNTER if (finite == np.rint(finite)).all() and not wheel else _CLOCK
    if clock := called_time(candidate.path.rpartition(".")[2]) or not names.isdisjoint(words_of(candidate.path)):
        steps = np.concatenate([np.diff(v) for v in apart])
        clock = bool(np.mean(steps[steps != 0] > 0) > 0.9)  # that of a day starts anew
    if not clock and source.role not in ("control", "reference"):  # counts or adds up: in name, or from run to run
        named = not _ADDED.isdisjoint(words_of(candidate.path))
        rises = np.concatenate([np.diff(v) for v in apart]) if named else np.diff(finite)
        adds = not wheel and bool((rises >= 0).all()) and (named or (len(apart) > 1 and bool(np.mean(rises > 0) > 0.5)))
        clock = adds or all(map(_counts, candidate.values, source.arrival, repeat(wheel)))
    if clock:
        return "grows as a clock or a counter does"
    return "holds numbers beyond 1e15" if np.abs(finite).max() > 1e15 else ""


def _counts(values: Array, arrival: NDArray[np.int64], wheel: bool) -> bool:
    """Never falls, and is a whole number, but that of a wheel, or follows the time; or counts rows, or is a stamp."""
    good = np.isfinite(values)
    finite, t = values[good], (arrival[good] - arrival[0]) * 1e-9
    if len(finite) < 3 or np.ptp(t) == 0:
        return False
    moved = 1 + np.flatnonzero(np.diff(finite))
    rows = moved if FEWEST <= len(moved) < 0.5 * len(finite) else slice(None)  # of the hours that it ran, each full one
    x, y = (v[rows] - v[rows].mean() for v in (t, finite))
    slope = float(x @ y / (x @ x))
    follows = bool(((y - slope * x) ** 2).sum() < (0.002 * np.ptp(finite)) ** 2 * len(x))
    if np.mean(np.diff(finite) == 1) > 0.9 or (follows and any(abs(slope / 1000**k - 1) < 1e-3 for k in range(4))):
        return True
    if (np.diff(finite) < 0).any():
        return False
    whole = len(np.unique(finite)) >= 0.5 * len(finite) and (finite == np.rint(finite)).all()
    return follows or bool(whole and not wheel)


_OF_BODY = re.compile(
    r"(?P<place>(pos(ition)?_?)?(?P<a>[xy])(_?pos(ition)?)?(_m)?)|(v|vel|velocity|speed)_?(?P<b>[xy])|(?P<c>[xy])_?(vel|dot)"
)
"""Columns of the place of a body in a plane, and of its velocity."""
_HEADED = re.compile(r"(unwrap\()?(?P<of>.*?)_?((?P<place>[xy])|yaw|heading|theta|psi)(, 360)?\)?")
"""Columns of such a place and of where the body heads, `of` one name."""


def _leave_out_places(source: Source) -> None:
    """Leave out the place of a body that turns, or has velocities of its own: it goes where the body heads."""
    found = [(c, m) for c in source.free if (m := _OF_BODY.fullmatch(bare(c.path)))]
    places = {m["a"]: c for c, m in found if m["place"]}
    velocities = {m["b"] or m["c"]: c for c, m in found if not m["place"]}
    reason, left = "a place in a fixed frame, where the velocities are the body's", list[Candidate]()
    headed = {c: m for c in source.free if (m := _HEADED.fullmatch(c.path.lower()))}
    if len(places) == len(velocities) == 2 and not all(moves_per(velocities[axis], places[axis]) for axis in "xy"):
        left = list(places.values())
    elif len(velocities) < 2 and len(source.free) > len(headed):  # more than a pose is measured
        turning = {m["of"] for c, m in headed.items() if not m["place"] and np.ptp(c.finite) > 1.0}  # rad
        reason = "a place of a body that turns"
        left = [c for c, m in headed.items() if m["place"] and m["of"] in turning]
    for candidate in left:
        candidate.reason, candidate.ready = reason, "state"


def _drop_computed(sources: Sequence[Source]) -> None:
    """Leave out what is computed from other columns: an average, or an error, which jumps with its set point."""
    pool = [c for s in sources if s.type == TABLE for c in s.free if np.ptp(c.finite) > 0]
    named = [c for c in pool if not _COMPUTED.isdisjoint(words_of(c.path))]
    some = {c: np.concatenate(c.values)[:: 1 + len(c.values[0]) // 1000] / np.ptp(c.finite) for c in pool if named}
    for candidate in named:
        known = np.isfinite(some[candidate])
        others = [c for c in pool if c is not candidate and not c.reason and c.topic == candidate.topic]
        others = [c for c in others if np.isfinite(some[c][known]).all()]
        y, X = some[candidate][known], np.column_stack([some[c] for c in others] + [np.ones(len(known))])[known]
        share = np.linalg.lstsq(X, y, rcond=None)[0]
        if len(y) > 2 * len(share) and np.abs(X @ share - y).max() < 1e-3:
            of = [c.path for c, size in zip(others, np.abs(share), strict=False) if size > 0.01]
            candidate.reason = f"follows from {shortlist(of, 3)} of the same row"


_ANGLE = re.compile(r"angle|orient|euler|yaw|heading|roll|pitch|theta|phi|psi|azim|cours|hdg|_(deg(ree)?|rad(ian)?)s?$")


def _wrapped(source: Source) -> None:
    """Angles that jump by a turn are unwrapped, those of a quaternion and a compass always."""
    for candidate in source.free:
        angle = re.match(rf"({WRAPPING})\(", candidate.path) is not None
        finite = [values[np.isfinite(values)] for values in candidate.values]
        steps = [(np.ptp(v), np.abs(np.diff(v)).max()) for v in finite if len(v) > 1]
        low, high, turning = candidate.finite.min(), candidate.finite.max(), of_compass(candidate)
        compass = bool(turning and -180 <= low and high <= 360 and max(-low, high) > math.tau)
        called = f"{source.topic.rpartition('/')[2]} {candidate.path}".lower()
        named = turning or _ANGLE.search(called) or _ANGLE.search(f"_{candidate.unit.replace('°', 'deg')}".lower())
        turned = (t for t in (math.tau, 360.0) if any(s <= 1.1 * t and step > 0.8 * t for s, step in steps))
        turn = math.tau if angle else next(turned if named else iter(()), 360.0 * compass or turn_of_count(candidate))
        if turn:
            candidate.path = f"unwrap({candidate.path}{f', {turn:.0f}' * (turn > 7)})"
            candidate.values = [_unwrapped(v, turn) for v in candidate.values]


def _unwrapped(values: Array, turn: float) -> Array:
    finite = np.isfinite(values)
    out = values.copy()
    out[finite] = np.unwrap(values[finite], period=turn)
    return out


@dataclass(frozen=True)
class Proposal:
    """States and controls of a machine, as far as a recording tells.

    `states`: proposed states; `controls`: proposed controls; `text`: the signals file, with its reasons; `warnings`:
    what the reader should know, a sentence each; `members`: many alike, such as joints, that the file is for; the
    states and controls are those of one of them.
    """

    states: tuple[Candidate, ...]
    controls: tuple[Candidate, ...]
    text: str
    warnings: tuple[str, ...] = ()
    members: tuple[str, ...] = ()


@np.errstate(all="ignore")
def propose(
    paths: Sequence[str | os.PathLike[str]],
    progress: Progress | None = None,
    *,
    states: Sequence[str] = (),
    controls: Sequence[str] = (),
    like: str = "",
    table: TableLayout | None = None,
    delays: Progress | None = None,
) -> Proposal:
    """Suggest states and controls of a machine from recordings of it.

    Topics are classified by their names and types, and if these say nothing by what helps to predict what; of a
    topic's numbers those are proposed that move, and in whose next step the controls show, or which help to predict
    such ones. Everything else is listed in comments with the reason. Where states and commands are of many that are
    alike, such as the joints of a robot, the file is for all of them, each with states and controls of its own.

    Parameters
    ----------
    paths : sequence of path
        As for `read_transients`.
    progress : callable, optional
        As for `read_transients`.
    states : sequence of str, optional
        Topics, or TOPIC:FIELD, with `*` for any letters: what may be a state, in place of what looks like one.
    controls : sequence of str, optional
        Likewise for the controls.
    like : str, default ""
        The member of many that are alike, such as a joint, that the file is drawn up for; default the one whose command
        shows most. The file is for all members in which the same numbers move.

    table : TableLayout, optional
        Which columns of tables are time and run, or their step, for the file as well; default to look for them.
    delays : callable, optional
        As `progress`, for the delays at which controls may act; each takes a while where signals are many.

    Returns
    -------
    Proposal
        With the text of the file.

    Raises
    ------
    BagError
        A recording cannot be read, or holds nothing that could be a state, or nothing that was asked for.
    """
    bags, layout = _opened(paths, table or TableLayout())
    sources, warnings = read_sources(bags, progress, (*states, *controls))
    warnings += [warning for bag in bags for warning in bag.warnings]
    # a unit that is taken for granted is written down, so that other recordings are read alike
    taken = {bag.time_unit for bag in bags if isinstance(bag, Table)} - {""}
    layout = TableLayout.from_dict(layout.to_dict() | {"unit": taken.pop()}, "table") if len(taken) == 1 else layout
    warnings += set_aside_labels(sources, bags) if not states else []
    if not (states or controls):  # what a person asks for stays
        _drop_computed(sources)
    if rare := [c.path for s in sources for c in s.candidates if c.reason.endswith(_FILL)]:
        few = "few rows, or no two in a row, have a number of"
        warnings.append(f"{few} {shortlist(rare, 4)}; where it holds until the next one, {_FILL}")
    one_topic = len({s.topic for s in sources}) == 1  # whose rows hold every column
    if not (states or controls or like) and one_topic and is_plant(sources):
        return _of_plant(bags, sources, warnings, layout)
    if states or controls:
        ask_for(sources, states, controls, str(bags[0].path))
    switches = [] if controls else take_switches(sources)
    commands, measured = assign_roles(sources, bool(states or controls), bool(controls))
    commands += switches
    sources += [s for s in [*commands, *measured] if s not in sources]  # columns of a table
    moving = {(c.topic, c.path): c for s in sources for c in s.free}
    if not measured:
        raise BagError(f"{bags[0].path}: {_nothing(sources, warnings)}")
    chosen, doubt = choose(measured, commands, like, bool(states), delays)
    doubt = doubt or ("" if commands else at_rest(sources))
    used = [c for s in commands for c in s.free]
    if like and {c.element for c in [*chosen, *used]} != {like}:
        there = dict.fromkeys(c.element for s in sources for c in s.candidates if c.element)
        raise BagError(
            f"{bags[0].path}: no state and command of a member '{like}'{meant(like, there)}; members that have a name: "
            f"{shortlist(list(there), 20) or 'none'}"
        )
    ready = [c for s in sources for c in s.candidates if c.ready]
    further = ([c for c in ready if c.ready == kind] for kind in ("state", "control"))
    name_signals(*([*some, *more] for some, more in zip((chosen, used), further, strict=True)))
    levels = [c for c in chosen if c.why]  # mostly noise, which is never still
    set_operating_point([c for c in chosen if c not in levels] or chosen, used)
    for candidate in [*ready, *levels]:
        set_own_scale(candidate)
    warnings += [*[doubt] * bool(doubt), *as_unwatched(sources)]
    if not commands:
        unread = (s for s in sources if s.role == "control" and s.unreadable)
        warnings += [f"{s.topic} is a command by its name, and cannot be read: {s.reason}" for s in unread]
    warnings += _lacking(bags, [s.topic for s in sources if s.role == "control"])
    members = all_of_them(chosen, used, moving)
    try:
        memories = memory_lines(chosen, used)
    except ModuleNotFoundError as error:  # all but this needs no solver
        memories = []
        warnings.append(f"what lies further back was not tried: {absent(error.name) or error}")
    text = signals_file(bags, sources, chosen, used, doubt, memories, members, layout)
    return Proposal(tuple(chosen), tuple(used), text, tuple(warnings), tuple(members))


def _opened(paths: Sequence[str | os.PathLike[str]], layout: TableLayout) -> tuple[list[Recording], TableLayout]:
    bags = group_recordings(list(paths), layout=layout)
    if not bags:
        raise BagError("no recording is named; give at least one file or folder")
    if not layout.runs and (runs := run_column(bags)):
        layout = replace(layout, runs=runs)
        bags = group_recordings(list(paths), layout=layout)
    if layout.words is None and (words := in_words(bags, layout.runs)):
        layout = replace(layout, words=words)
        bags = group_recordings(list(paths), layout=layout)
    return bags, layout


def _of_plant(
    bags: Sequence[Recording], sources: Sequence[Source], warnings: Sequence[str], layout: TableLayout
) -> Proposal:
    chosen, used = plant_signals(sources)  # named as their columns
    if not chosen:
        raise BagError(f"{bags[0].path}: no column moves but commands and labels; record what is measured as well")
    text = signals_file(bags, sources, chosen, used, "", layout=layout, plant=True)
    load = "what loads the machine, such as a power that others draw, is a control: move its line to `controls`"
    told = [f"nothing in it is set or switched; {load}"] * all(c.why.startswith((ALWAYS, WEATHER)) for c in used)
    return Proposal(tuple(chosen), tuple(used), text, (*warnings, *told))


def _nothing(sources: Sequence[Source], warnings: Sequence[str]) -> str:
    why = [f"{s.topic}: {s.reason or 'a command by its name'}" for s in sources[:8]]
    reasons = "; ".join(dict.fromkeys([*why, *warnings[:3]]))
    nothing = f"nothing in it looks like the state of a machine ({reasons or 'no topics'})"
    if any(_APART in s.reason for s in sources):
        return f"{nothing}; give recordings of one machine, with the same topics and columns"
    named = "name the topics of its states in `uncertain-lti init --states`"
    return f"{nothing}; record the machine at work, and longer, or {named}"


def _lacking(bags: Sequence[Recording], commands: Sequence[str]) -> Iterator[str]:
    for topic in commands:
        lacking = [str(bag.path) for bag in bags if not _messages(bag, topic)]
        if 0 < len(lacking) < len(bags):
            without = f"{topic} looks like a command and is not in {shortlist(lacking, 3)}"
            yield f"{without}, so it is no control; leave those recordings out"
