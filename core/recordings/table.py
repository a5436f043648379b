# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Table: a file of columns as a recording, whose messages are its rows, each at its time.

It has one topic, but for a log of several messages or rates in one table.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, ClassVar
from weakref import WeakSet

import numpy as np

from uncertain_lti.base.arrays import Index, Integers, Mask, return_memory
from uncertain_lti.base.errors import BagError
from uncertain_lti.base.files import TABLES
from uncertain_lti.base.text import once, plural, shortlist
from uncertain_lti.recordings.recording import DATED_NS, Columns, Progress, Recording, TopicFacts, TopicInfo
from uncertain_lti.recordings.table_files import by_message, read_table
from uncertain_lti.recordings.table_text import (
    ODD_SHARE,
    QUANTITY,
    ROWS_EACH,
    Column,
    RawTable,
    field_name,
    find_column,
    unique,
    units_of,
    without_bad,
)
from uncertain_lti.recordings.table_times import NO_TIME, Instants, called_time, instants, may_be, spread
from uncertain_lti.signals.field_path import QUATERNION_ARRAYS, FieldPath, FieldType, TypeFields, of_quaternion
from uncertain_lti.signals.values import TABLE, TABLE_TOPIC, TableLayout

_PACKED = re.compile(r"[(\[\s]*[-+]?\d[\d.]*([,;|\s]+[-+]?\d[\d.eE+-]*)+[)\]\s]*")
_RUN = re.compile(r"(?P<file>.*)\[(?P<run>[^\[\]]*)\]")
_MOST_RUNS = 100_000
_HOUR = 3_600 * 10**9  # ns
_INEXACT = 2**53  # above which a float does not keep each integer
_IN_A_NAME = str.maketrans("[]/", "()-")  # a run is named as a file is
_NO_RUN = ("", "nan", "None", "NaT")
_OF_SIGNALS = (
    r"(tag|pid|var(iable)?|signal|field|point|channel|sensor|item|parameter|series|metric|topic|entity)"
    r"([\W_]*(name|id))?"
)
_NAMES = re.compile(rf"(?i)(.*[\W_])?(name|{_OF_SIGNALS})")
_VALUES = re.compile(r"(?i)_?((var|tag)?[\W_]*value|val|payload|reading|wert)")
_TOGETHER = 0.9  # of the times, that have a number of each signal
_HELD = 500_000_000  # bytes of several tables; those that follow are read anew when their numbers are asked for
_NUMBERS = "times", "columns_by_field", "_rows"


def is_table(path: Path) -> bool:
    """Whether a path names a table, or one run in it (`runs.csv[3]`)."""
    return _file_and_run(path)[0].suffix.lower() in TABLES and not path.is_dir()


class Table(Recording):
    """One run of a table.

    Rows are taken in the order of the file: where the time steps back, another run may begin, and the rules of sampling
    decide. Rows without a time are left out. A column is a field of the topic `/table`, by its name with everything but
    letters, digits and underscores replaced; a matrix is an array, and four of a quaternion are one field besides.
    Where columns have their numbers in rows of their own, each group of them is a topic below.

    `path`: file; or one run in it, `FILE[run]`; `layout`: which columns are time and run; `time_unit`: if guessed.
    """

    _reopened: ClassVar[WeakSet[Table]] = WeakSet()  # the last one, if any

    def __init__(self, path: Path, layout: TableLayout | None = None, run: _Run | None = None) -> None:
        layout = layout or TableLayout()
        file, raw, (time, times, words, self.time_unit), rows = run or _one_run(path, layout)
        self.path, self.parts, self.layout = path, (file,), layout
        self.size = file.stat().st_size
        of_file = [*raw.notes, *([words] if words else [])]
        apart = {time, *([find_column(file, layout.runs, list(raw.columns), "the runs")] if layout.runs else [])}
        signals = {name: column for name, column in raw.columns.items() if name not in apart}
        naming, value, of_each = _naming(signals, times)
        called = _NAMES.fullmatch(naming) and rows is None
        good, doubts = without_bad(signals, value) if called else ({}, [])
        wide = _side_by_side(of_each, good.get(value, signals[value]), times) if called else None
        if wide is not None:
            of_file += [*doubts, f"column '{naming}' names the signal of each number in '{value}'"]
            known = sum(int(np.isfinite(column).sum()) for column in wide[0].values())
            doubted = np.isnan(good[value]) & ~np.isnan(signals[value]) if good else np.zeros(1)
            if left := len(times) - int(np.count_nonzero(doubted)) - known:
                why = "without a name, a time or a number, or of a name and time that another row has"
                of_file.append(f"{plural(left, 'row')} left out {why}")
            names, times = unique([time, *wide[0]]), wide[1]
            raw = RawTable(dict(zip(names, [times, *wide[0].values()], strict=True)))
        every = np.arange(len(times)) if rows is None else rows
        written = time in raw.columns and raw.columns[time].dtype.kind in "OM"
        kept, of_run = _rows_in_order(every, times, time, written)
        names = [name for name in raw.columns if name not in apart]
        counts, self.times, notes = _times_of_rows(times[kept], time, {n: raw.columns[n][kept] for n in names})
        kept = kept[counts]
        self._warnings = [f"{file}: {note}" for note in of_file] + [f"{path}: {note}" for note in of_run]
        self._warnings += [f"{file}: {note}" for note in _no_numbers({name: raw.columns[name] for name in names})]
        self._warnings += [f"{path}: {note}" for note in notes]
        here = slice(None) if np.array_equal(kept, np.arange(len(times))) else kept
        fields = dict(zip(once(map(field_name, names), "_"), names, strict=True))
        units = units_of(names, raw.units)
        self.units = {field: units[name] for field, name in fields.items() if name in units}
        self.columns_by_field: dict[str, Column] = {field: raw.columns[name][here] for field, name in fields.items()}
        switched: dict[str, Column] = {}  # of columns of words
        for field, those in (layout.words or {}).items():
            if (cells := self.columns_by_field.get(field)) is not None:
                if cells.dtype.kind != "O" and raw.exact is not None:  # as of Run and Stop alone, which are numbers
                    cells = np.array(raw.exact(fields[field]), dtype=object)[here]
                switched |= _of_words(field, those[1:], [str(cell or "").strip() for cell in cells])
        switched = {name: column for name, column in switched.items() if name not in self.columns_by_field}
        self._quaternions = _quaternions(self.columns_by_field)
        reason = ""
        if not names:
            reason = f"there is no column but the time, '{time}'; choose another file"
        elif naming and wide is None:
            reason = f"column '{naming}' names the signal of a row's one number"
            reason += ", and they come at times of their own: export them at one interval" if called else ""
            reason += "; write a column for each signal" + ", or call it `signal`" * (not called)
        self._tell_topics(reason, file.suffix[1:].lower(), switched)

    def _tell_topics(self, reason: str, kind: str, switched: Mapping[str, Column]) -> None:
        """Rows and columns of each topic, of a table of such a kind, and the reason why it cannot be read, if any."""
        every = by_message(self.columns_by_field, len(self.times))
        if TABLE_TOPIC in every:
            every[TABLE_TOPIC][0].extend(switched)
        self.columns_by_field |= switched
        one = len(every) == 1 and not reason
        texts = [(n, c) for n, c in self.columns_by_field.items() if c.dtype.kind == "O"] if one else []
        some = len(texts) < len(self.columns_by_field)
        turns = ((name, _take_turns(column.tolist())) for name, column in texts if some)
        if of := next((f"{number} '{name}'" for name, number in turns if number), ""):
            say = "say so in the signals file, `table: {runs: COLUMN}`, or write a file for each"
            self._warnings.append(f"{self.path}: the rows are of {of} by turns: if they are units, {say}")
        others = [name for name, column in self.columns_by_field.items() if column.dtype.kind in "OM"]
        words = reason or f"text or instants, which are no signals: {', '.join(others)}" * bool(others)
        self._fields = {topic: fields for topic, (fields, _) in every.items()}
        self._rows = {topic: rows for topic, (_, rows) in every.items()}
        self.topics = {}
        for topic, rows in self._rows.items():
            first, last = (int(self.times[rows[0]]), int(self.times[rows[-1]])) if len(rows) else (None, None)
            self.topics[topic] = TopicInfo(topic, TABLE, len(rows), kind, not reason, words, first, last)

    def __reduce__(self) -> tuple[Any, ...]:
        """For another process, which reads the file again."""
        return Table, (self.path, self.layout)

    def let_go(self) -> None:
        """Of the numbers, which are read again when they are asked for, and held until those of another table are."""
        for name in _NUMBERS:
            vars(self).pop(name, None)
        Table._reopened.discard(self)
        return_memory()

    if not TYPE_CHECKING:

        def __getattr__(self, name):
            if name not in _NUMBERS:
                raise AttributeError(name)
            for other in [*Table._reopened]:
                other.let_go()
            again = vars(Table(self.path, self.layout))
            vars(self).update((number, again[number]) for number in _NUMBERS)
            Table._reopened.add(self)
            return getattr(self, name)

    def type_fields(self, topic: str) -> TypeFields:
        """Columns as fields."""
        self._require([topic])
        columns, quaternions = self._of(topic)
        fields = {name: _field_type(column) for name, column in columns.items()}
        fields |= {base: FieldType("message", _QUATERNION) for base in quaternions}
        number = FieldType("number", "float64")
        return lambda type_name: dict.fromkeys("xyzw", number) if type_name == _QUATERNION else fields

    def messages(self, topics: Iterable[str]) -> Iterator[tuple[str, int, Any]]:
        """Rows, one after the other."""
        wanted = list(dict.fromkeys(self._require(topics)))
        fields = [self._of(topic)[0] for topic in wanted]
        order = zip(*self._in_order(wanted), strict=True)
        rows = ((k, int(row), {name: c[row] for name, c in fields[k].items()}) for k, row in order)
        return ((wanted[k], int(self.times[row]), SimpleNamespace(**numbers)) for k, row, numbers in rows)

    def columns(
        self, topics: Sequence[str], paths: Sequence[Sequence[FieldPath]], progress: Progress | None = None
    ) -> Columns:
        """Numbers at some paths."""
        self._require(topics)
        values = []
        for topic, wanted in zip(topics, paths, strict=True):
            values.append(np.empty((len(self._rows[topic]), len(wanted))))
            for column, path in zip(values[-1].T, wanted, strict=True):
                column[:] = self._values(topic, path)
        of, rows = self._in_order(topics)
        if progress is not None:
            for _ in progress(range(len(rows)), len(rows)):
                pass
        return Columns(of, self.times[rows], np.full(len(rows), -1, dtype=np.int64), values)

    def facts(self, progress: Progress | None = None) -> list[TopicFacts]:
        """Rate, gaps and columns."""
        return [self._facts(topic) for topic in self.topics]

    def _facts(self, topic: str) -> TopicFacts:
        steps = np.diff(self.times[self._rows[topic]])
        step = float(np.median(steps)) if len(steps) else 0.0
        columns, quaternions = self._of(topic)
        slower = {f for of, fields in self._fields.items() if of != topic == TABLE_TOPIC for f in fields}
        quaternions = {base: names for base, names in quaternions.items() if slower.isdisjoint(names)}
        numbers = [(name, c) for name, c in columns.items() if _field_type(c).kind == "number" and name not in slower]
        numbered = [base for base, names in quaternions.items() if names[3].endswith("0")]
        parts = {name for base, names in quaternions.items() if base not in numbered for name in names}
        whole = [(name, c) for name, c in numbers if name not in parts]
        fields = tuple(name if c.ndim == 1 else f"{name}[0..{c.shape[1] - 1}]" for name, c in whole)
        for base in quaternions:
            axes = "" if base in numbered else "xyzw"
            fields += (*(f"{base}.{axis}" for axis in axes), *(f"{name}({base})" for name in of_quaternion()))
        gap = float(steps.max()) * 1e-9 if len(steps) else None
        return TopicFacts(self.topics[topic], 1e9 / step if step > 0 else None, gap, fields, "none", None)

    def _of(self, topic: str) -> tuple[dict[str, Column], dict[str, list[str]]]:
        """Columns of a topic, and the quaternions whose four columns are among them."""
        columns = {name: self.columns_by_field[name] for name in self._fields[topic]}
        return columns, {base: names for base, names in self._quaternions.items() if columns.keys() >= set(names)}

    def _in_order(self, topics: Sequence[str]) -> tuple[Integers, Index]:
        """Position of the topic of each message among some, and its row, as they come in the file."""
        every = [self._rows[topic] for topic in topics]
        of = np.repeat(np.arange(len(every), dtype=np.int64), [len(rows) for rows in every])
        rows = np.concatenate([np.empty(0, dtype=np.intp), *every])
        order = np.argsort(rows, kind="stable")
        return of[order], rows[order]

    def _values(self, topic: str, path: FieldPath) -> Any:
        """What `FieldPath.read` gives for every row of a topic."""
        steps, rows = path.steps, self._rows[topic]
        if parts := self._quaternions.get(str(steps[0][1])):
            columns = [self.columns_by_field[name][rows] for name in parts]
            if path.function is None:
                return columns["xyzw".index(str(steps[1][1]))]
            return list(map(path.function.of_parts, *(column.tolist() for column in columns)))
        column = self.columns_by_field[str(steps[0][1])][rows]
        if path.function is None and len(steps) == 1:
            return column
        if path.function is None and len(steps) == 2 and steps[1][0] == "index":
            where = int(steps[1][1])
            return column[:, where] if where < column.shape[1] else math.nan
        return [path.read(row) for _, _, row in self.messages([topic])]

    def _require(self, topics: Iterable[str]) -> list[str]:
        wanted = list(topics)
        if other := next((topic for topic in wanted if topic not in self.topics), None):
            raise BagError(f"{self.path}: there is no topic {other}; it has {shortlist(list(self.topics), 20)}")
        if unread := next((self.topics[topic].reason for topic in wanted if not self.topics[topic].readable), ""):
            raise BagError(f"{self.path}: cannot be used: {unread}")
        return wanted


def _of_words(field: str, words: Sequence[str], cells: Sequence[str]) -> dict[str, Column]:
    """A column of numbers for each word of a column."""
    rows = np.array(cells, dtype=str)
    names = (f"{field}_{name}" for name in once(map(field_name, words), "_"))
    return {name: np.where(rows != "", rows == word, np.nan) for name, word in zip(names, words, strict=True)}


def read_tables(paths: Sequence[Path], layout: TableLayout | None) -> list[Table]:
    """Every run of some files; those with one signal each of the same time, or in another unit, get a warning."""
    tables, steps, alone, held = list[Table](), list[tuple[float, Table]](), list[Table](), 0
    for table in (run for path in paths for run in _every_run(path, layout or TableLayout())):
        tables.append(table)
        if len(table.times) > 2:
            steps.append((float(np.median(np.diff(table.times))), table))
        columns, whole = table.columns_by_field.values(), table.parts == (table.path,)
        held += sum(column.nbytes for column in columns)
        if whole and len(table.times) and table.times[0] > DATED_NS:
            alone += [table] * (sum(column.dtype.kind not in "OM" for column in columns) == 1)
        if whole and held > _HELD and len(tables) > 1:
            table.let_go()
    least, fastest = min(steps, key=lambda one: one[0], default=(0.0, None))
    for (step, table), (unit, times) in product(steps, (("ms", 1e3), ("us", 1e6))):
        if fastest is not None and 0.8 * step < least * times < 1.25 * step:
            words = f"its steps are {step / least:.4g} times those of {fastest.path}: if its times are in {unit}"
            table._warnings.append(f"{table.path}: {words} and those in s, call its column time_{unit}")
    for other in alone[1:]:
        if np.isin(other.times, alone[0].times).mean() > 0.5:
            remedy = "if each of them is of another signal of one machine, write them as columns of one file"
            other._warnings.append(f"{other.path}: is of the time of {alone[0].path}; {remedy}")
    return tables


def _rows_in_order(rows: Index, times: Integers, time: str, written: bool) -> tuple[Index, list[str]]:
    """Rows that have a time, the oldest first, and what there is to say of their order; `written`: as dates or text."""
    notes = []
    known = times[rows] != NO_TIME
    if missing_time := int(np.count_nonzero(~known)):
        notes.append(f"{plural(missing_time, 'row')} without a time left out")
        rows = rows[known]
    steps = np.diff(times[rows])
    if (steps < 0).any() and (steps <= 0).all():
        rows = rows[::-1]
        notes.append("the newest row comes first; read from its last row to its first")
    elif (older := np.count_nonzero(steps < 0)) > 0.1 * len(rows):
        remedy = f"sort the rows by '{time}', or name a column of runs in a signals file, `table: {{runs: COLUMN}}`"
        notes.append(f"{older} of {len(rows)} rows are older than the row before: {remedy}")
    elif older and written and (abs(steps + _HOUR) <= 2 * np.median(steps)).any():
        autumn = "its time goes back by an hour, as at the end of summer time, and a new segment begins there"
        notes.append(f"{autumn}; write times in UTC, or with their zone")
    return rows, notes


def _no_numbers(columns: Mapping[str, Column]) -> list[str]:
    """A sentence for each column of text whose cells are numbers with a unit, or several in one."""
    notes = []
    for name, column in ((n, c) for n, c in columns.items() if c.dtype.kind == "O" and not may_be(c)):
        cells = [str(cell).strip() for cell in column if cell]
        cells = cells[:: len(cells) // 100 + 1]
        units = {found and found["unit"] for found in map(QUANTITY.fullmatch, cells)}
        packed = list(filter(_PACKED.fullmatch, cells))
        odd = cells if len(units) == 1 < len(set(cells)) and None not in units else packed
        if 2 * len(odd) > len(cells):
            unread = f"column '{name}' left out, as most cells are no number alone, such as '{odd[0][:40]}'"
            notes.append(f"{unread}: write one in each, without unit or separator of thousands")
    return notes


def _times_of_rows(times: Integers, time: str, columns: Mapping[str, Column]) -> tuple[Mask, Integers, list[str]]:
    """Rows that count, their times, evenly where rows of the same time flow, and what there is to say of such rows."""
    again = np.append(False, np.diff(times) == 0)
    if not (equal := np.count_nonzero(again)) > 0.1 * len(times):
        return np.ones_like(again), times, []
    late = np.flatnonzero(again)
    both = ((column[late], column[late - 1]) for column in columns.values())
    if not any(((a != b) & ((a == a) | (b == b))).any() for a, b in both):  # a missing number repeats one
        said = "repeat the row before, in its time and in all its columns, and are left out"
        return ~again, times[~again], [f"{equal} of {len(times)} rows {said}"]
    number, unit = _for_each_time(times, columns)
    if number > 1 and not unit and (np.diff(times) >= 0).all() and _flows(columns.values(), number):
        usual = float(np.median(np.diff(np.unique(times)))) * 1e-9
        even, taken = spread(times), f"they are taken to come evenly in the {usual:g} s after it: "
    else:
        each = f"are the {number} rows of a time one for each of {number} units? then "
        each += f"say so in the signals file, `table: {{runs: {unit}}}`, or " * bool(unit)
        each += "write a file for each; else "
        even, taken = times, f"only the first of such rows counts: {each * (number > 1)}"
    same = f"{equal} of {len(times)} rows have the time of a row before in column '{time}', and {taken}"
    return np.ones_like(again), even, [f"{same}write times with more decimals, or take another, `--table time=COLUMN`"]


def _for_each_time(times: Integers, columns: Mapping[str, Column]) -> tuple[int, str]:
    """Rows that a time usually has, and the column of few values that tells them apart, if there is one."""
    _, rows = np.unique(times, return_counts=True)
    number = int(np.median(rows))
    for name, column in columns.items():
        if column.ndim > 1:
            continue
        names, which = np.unique(column.astype(str) if column.dtype.kind == "O" else column, return_inverse=True)
        if 2 <= len(names) <= 2 * number and len(np.unique(np.column_stack([times, which]), axis=0)) == len(times):
            return number, name
    return number, ""


def _flows(columns: Iterable[Column], rows: int) -> bool:
    """Whether most numbers change less from row to row than over the rows of a time, which are of one machine then.

    Where none changes twice in a time, the rows of it are one sample, written number by number.
    """
    shares, changes = [], 0.0
    for column in (c for c in columns if c.dtype.kind in "iuf" and c.ndim == 1):
        values = column[np.isfinite(column)].astype(np.float64)
        if len(values) > 2 * rows and (later := float(np.abs(values[rows:] - values[:-rows]).mean())) > 0:
            shares.append(float(np.abs(np.diff(values)).mean()) / later)
            changes = max(changes, rows * float(np.mean(np.diff(values) != 0)))
    return changes >= 2 and float(np.median(shares)) < 0.5


def _take_turns(cells: Sequence[object]) -> int:
    """How many names take turns from row to row, nearly as often as if each row were of any of them; 0 if none do."""
    rows = np.array(list(Counter(cells).values()))
    if len(rows) < 2 or rows.min() < ROWS_EACH or not all(cells):
        return 0
    changes = 1.0 - float(((rows / len(cells)) ** 2).sum())
    return len(rows) if sum(a != b for a, b in pairwise(cells)) >= 0.8 * changes * len(cells) else 0


def _file_and_run(path: Path) -> tuple[Path, str | None]:
    """`runs.csv` and `3` of `runs.csv[3]`."""
    match = _RUN.fullmatch(path.name)
    if match is None or path.exists():
        return path, None
    return path.with_name(match["file"]), match["run"]


_Run = tuple[Path, RawTable, Instants, Index | None]
"""A file, what it holds, its `instants`, and the rows of one run in it; None for all."""


def _one_run(path: Path, layout: TableLayout) -> _Run:
    file, run = _file_and_run(path)
    if run is not None and layout.runs is None:
        raise BagError(f"{path}: names a run; say in the signals file which column does, `table: {{runs: COLUMN}}`")
    raw, rows = _read(file), None
    if run is not None:
        runs = _runs(file, raw, layout)
        if run not in runs:
            raise BagError(f"{path}: there is no run '{run}' in {file}; there are {shortlist(list(runs), 12)}")
        rows = runs[run]
    return file, raw, instants(file, raw, layout), rows


def _every_run(path: Path, layout: TableLayout) -> list[Table]:
    """Every run of a file; the file itself where the layout names no column for them."""
    file, run = _file_and_run(path)
    if run is not None or layout.runs is None:
        return [Table(path, layout)]
    raw = _read(file)
    timed = instants(file, raw, layout)
    tables = []
    for name, rows in _runs(file, raw, layout).items():
        tables.append(Table(file.with_name(f"{file.name}[{name}]"), layout, (file, raw, timed, rows)))
        raw.notes, timed = [], timed._replace(words="")  # once are enough
    if not tables:
        raise BagError(f"{file}: column '{layout.runs}' is empty in every row, so it names no run")
    return tables


def _read(file: Path) -> RawTable:
    raw = read_table(file)
    good, doubts = without_bad(raw.columns)
    return replace(raw, columns={**raw.columns, **good}, notes=[*raw.notes, *doubts])


def _runs(file: Path, raw: RawTable, layout: TableLayout) -> dict[str, Index]:
    """Rows of each run, by its value in the column, in order of first rows."""
    assert layout.runs is not None
    of = find_column(file, layout.runs, list(raw.columns), "the runs")
    column = raw.columns[of]
    if column.ndim != 1:
        raise BagError(f"{file}: column '{layout.runs}' has several numbers a row, so it names no run")
    keys = column.astype(str)
    if column.dtype.kind == "f":
        keys = np.asarray([repr(value).removesuffix(".0") for value in column.tolist()])
        if raw.exact is not None and len(column) and bool((np.abs(column) >= _INEXACT).any()):
            keys = np.asarray(raw.exact(of))
    of_each = _rows_of_each(keys)
    if len(of_each) > min(_MOST_RUNS, max(10, len(column) // 2)):
        values = f"{len(of_each)} values in {len(column)} rows"
        raise BagError(f"{file}: column '{layout.runs}' has {values}, so it names no runs; choose another")
    found: dict[str, Index] = {}
    for key, own in of_each.items():
        name = key.translate(_IN_A_NAME)
        if name in _NO_RUN:
            raw.notes.append(f"{plural(len(own), 'row')} without a run left out")
        elif name in found:
            raise BagError(f"{file}: runs '{key}' and '{name}' would have one name; rename one of them")
        else:
            found[name] = own
    return found


def _rows_of_each(keys: Column) -> dict[str, Index]:
    """Rows of each text (N,), in order of their first rows."""
    names, first, of = np.unique(keys, return_index=True, return_inverse=True)
    rows = np.split(np.argsort(of, kind="stable"), np.cumsum(np.bincount(of, minlength=len(names)))[:-1])
    return {str(names[i]): rows[i] for i in np.argsort(first, kind="stable").tolist()}


def names_signals(column: str) -> bool:
    """Whether a column says by its name that it names the signal of a row's number."""
    return re.fullmatch(rf"(?i)(.*[\W_])?{_OF_SIGNALS}", column) is not None


def _naming(columns: Mapping[str, Column], times: Integers) -> tuple[str, str, dict[str, Index]]:
    """The column that names the signal of each row's one number, as historians write it, that, and each name's rows.

    Few names change from row to row, or the time begins anew with each. Nothing for other tables.
    """
    every = [n for n, c in columns.items() if c.dtype.kind in "iuf" and c.ndim == 1 and not called_time(n)]
    value = [name for name in every if _VALUES.fullmatch(name)]
    texts = [name for name, column in columns.items() if column.dtype.kind == "O"]
    for naming in sorted(texts, key=lambda name: not _NAMES.fullmatch(name)) if every else ():
        numbers = value if len(value) == 1 and _NAMES.fullmatch(naming) else every  # beside a quality, or of units
        named = np.flatnonzero(columns[naming] != "")
        cells, when = columns[naming][named], times[named]
        few = len(set(cells.tolist()))
        if not 2 <= few <= len(named) // ROWS_EACH or len(named) < (1 - ODD_SHARE) * len(times):
            continue
        beside = [n for n in [*texts, *every] if n != naming and n not in numbers]
        rows = _rows_of_each(_of_units(cells.astype(str), [columns[n][named] for n in beside], when))
        order = np.concatenate([*rows.values()])
        first = np.cumsum([0, *map(len, rows.values())])[:-1]
        least, most = (of_each.reduceat(when[order], first) for of_each in (np.minimum, np.maximum))
        usual = np.diff(first, append=len(order)) >= ROWS_EACH  # a name of few rows says nothing
        anew = sum(usual) > 1 and most[usual].min() > least[usual].max() and _NAMES.fullmatch(naming)
        if 2 * np.count_nonzero(cells[1:] != cells[:-1]) > len(cells) or anew:
            of_rows = {name: columns[name][named][order] for name in numbers}
            moving = [n for n, c in of_rows.items() if (np.fmax.reduceat(c, first) > np.fmin.reduceat(c, first)).any()]
            if len(moving) == 1:  # others, such as an identifier, are the same in all rows of a name
                return naming, moving[0], {name: named[of] for name, of in rows.items()}
    return "", "", {}


def _of_units(names: Column, others: Sequence[Column], times: Integers) -> Column:
    """Names with those of units, in other columns, before them, where numbers of one name and time are of several."""

    def known(cells: Column) -> int:
        of = np.unique(cells, return_inverse=True)[1]
        order = np.lexsort((of, times))
        return 1 + int(np.count_nonzero(np.diff(of[order]) | np.diff(times[order])))

    found = known(names) if others else len(names)
    for other in others if found < _TOGETHER * len(names) else ():
        if other.dtype.kind == "f":
            other = np.array([f"{number}".removesuffix(".0") for number in other.tolist()])
        joined = np.char.add(np.char.add(other.astype(str), "\t"), names)
        if (more := known(joined)) > found:
            names, found = joined, more
    return names


def _side_by_side(
    of_each: Mapping[str, Index], values: Column, times: Integers
) -> tuple[dict[str, Column], Integers] | None:
    """A column for each name, and the times; nothing where the names do not come together, or one after the other."""
    rows = {name: timed for name, of in of_each.items() if len(timed := of[times[of] != NO_TIME])}
    stamps = np.unique(times[times != NO_TIME])
    count = min(map(len, rows.values()))
    if count < _TOGETHER * len(stamps) and all(len(of) == count for of in rows.values()):
        rounds = np.sort(times[np.array([*rows.values()])], axis=1)
        if (rounds[:, 1:].min(axis=0) > rounds[:, :-1].max(axis=0)).all():
            stamps = rounds.max(axis=0)
            return {name: values[of[np.argsort(times[of])]] for name, of in rows.items()}, stamps
    columns = {name: np.full(len(stamps), math.nan) for name in rows}
    for name, of in rows.items():
        columns[name][np.searchsorted(stamps, times[of[::-1]])] = values[of[::-1]]  # of one time the first counts
    together = min(np.isfinite(column).mean() for column in columns.values()) >= _TOGETHER
    return (columns, stamps) if together or len(by_message(columns, len(stamps))) > 1 else None  # polled in turn


_QUATERNION = "quaternion"
"""Type of four columns that are one."""


def _quaternions(columns: Mapping[str, Column]) -> dict[str, list[str]]:
    """Names of the columns of x, y, z, w, by their beginning: `q` of `qx` to `qw`, or of `q0`, `q[0]` (w) to `q[3]`."""
    found = {}
    for name in columns:
        base = name[:-1].rstrip("_")
        parts = [name[:-1] + axis for axis in ("XYZW" if name[-1] == "W" else "xyzw")]
        if name[-1] == "0" and base in QUATERNION_ARRAYS and f"{name[:-1]}4" not in columns:
            parts = [name[:-1] + entry for entry in "1230"]
        if name == parts[3] and base and base not in columns and all(part in columns for part in parts):
            if all(_field_type(columns[part]) == FieldType("number", "float64") for part in parts):
                found[base] = parts
    return found


def _field_type(column: Column) -> FieldType:
    if column.dtype.kind in "OM":
        return FieldType("string" if column.dtype.kind == "O" else "other", "text or instants")
    return FieldType("number", str(column.dtype), None if column.ndim == 1 else column.shape[1])
