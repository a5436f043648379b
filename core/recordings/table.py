# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Table: a file of columns as a recording with one topic, whose messages are its rows."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.errors import BagError, SignalError
from uncertain_lti.base.text import plural, printable, shortlist
from uncertain_lti.recordings.recording import Columns, Progress, TopicFacts, TopicInfo
from uncertain_lti.recordings.table_files import Column, RawTable, read_table
from uncertain_lti.recordings.table_time import NO_TIME, field_name, find_column, instants
from uncertain_lti.recordings.unreadable import TABLES, missing
from uncertain_lti.signals.field_path import FieldPath, FieldType, TypeFields
from uncertain_lti.signals.values import TableLayout

TOPIC = "/table"
"""The topic of a table."""
TYPE = "table"
"""Its message type."""

_RUN = re.compile(r"(?P<file>.*)\[(?P<run>[^\[\]]*)\]")
_MOST_RUNS = 100_000
_SECOND = 10**9
_INEXACT = 2**53  # above which a float does not keep each integer
_NO_RUN = ("", "nan", "None", "NaT")


def is_table(path: Path) -> bool:
    """Whether a path names a table, or one run in it (`runs.csv[3]`)."""
    return _file_and_run(path)[0].suffix.lower() in TABLES and not path.is_dir()


class Table:
    """One run of a table.

    Rows are taken in the order of the file: where the time steps back, another run may begin, and the rules of sampling
    decide. Rows without a time are left out. A column is a field of the topic `/table`, by its name with everything but
    letters, digits and underscores replaced; a matrix is an array.

    `path`: file; with `[run]` behind it, one run in it; `parts`: its file, where that is known; `indexed`: as for every
    format; a table has no index; `layout`: which columns are time and run.
    """

    indexed = False

    def __init__(
        self, path: Path, parts: Sequence[Path] = (), indexed: bool = False, layout: TableLayout | None = None
    ) -> None:
        layout = layout or TableLayout()
        file, run = _file_and_run(path)
        if run is not None and layout.runs is None:
            raise BagError(f"{path}: names a run; say in the signals file which column does, `table: {{runs: COLUMN}}`")
        raw = _read(file)
        runs = None if run is None else _runs(file, raw, layout)
        if runs is not None and run not in runs:
            raise BagError(f"{path}: there is no run '{run}' in {file}; there are {shortlist(list(runs), 12)}")
        timed = instants(file, raw, layout)
        self._take(path, file, layout, raw, timed, None if runs is None or run is None else runs[run])

    @classmethod
    def every_run(cls, path: Path, layout: TableLayout | None = None) -> list[Table]:
        """Every run of a file; the file itself where the layout names no column for them."""
        layout = layout or TableLayout()
        file, run = _file_and_run(path)
        if run is not None or layout.runs is None:
            return [cls(path, layout=layout)]
        raw = _read(file)
        column, times, words = instants(file, raw, layout)
        tables = []
        for name, rows in _runs(file, raw, layout).items():
            table = cls.__new__(cls)
            table._take(file.with_name(f"{file.name}[{name}]"), file, layout, raw, (column, times, words), rows)
            tables.append(table)
            raw.notes, words = [], ""  # once are enough
        if not tables:
            raise BagError(f"{file}: column '{layout.runs}' is empty in every row, so it names no run")
        return tables

    def _take(
        self,
        path: Path,
        file: Path,
        layout: TableLayout,
        raw: RawTable,
        timed: tuple[str, NDArray[np.int64], str],
        rows: NDArray[np.intp] | None,
    ) -> None:
        self.path, self.parts, self.layout = path, (file,), layout
        self.size = file.stat().st_size
        time, times, words = timed
        self._warnings = [f"{file}: {note}" for note in [*raw.notes, *([words] if words else [])]]
        apart = {time, *([find_column(file, layout.runs, list(raw.columns), "the runs")] if layout.runs else [])}
        kept = np.arange(len(times)) if rows is None else rows
        known = times[kept] != NO_TIME
        if not known.all():
            number = int(np.count_nonzero(~known))
            self._warnings.append(f"{path}: {plural(number, 'row')} without a time left out")
            kept = kept[known]
        self.times = times[kept]
        self.columns_by_field: dict[str, Column] = {}
        repeats: dict[str, int] = {}
        for name, column in raw.columns.items():
            field = plain = field_name(name)
            while field in self.columns_by_field:
                repeats[plain] = repeats.get(plain, 1) + 1
                field = f"{plain}_{repeats[plain]}"
            if name not in apart:
                self.columns_by_field[field] = column if len(kept) == len(column) else column[kept]
        first, last = (int(self.times[0]), int(self.times[-1])) if len(kept) else (None, None)
        readable, reason = bool(self.columns_by_field), ""
        if not readable:
            reason = f"there is no column but the time, '{time}'"
        self.topics: Mapping[str, TopicInfo] = {
            TOPIC: TopicInfo(TOPIC, TYPE, len(kept), file.suffix[1:].lower(), readable, reason, first, last)
        }

    def __reduce__(self) -> tuple[Any, ...]:
        """For another process, which reads the file again."""
        return Table, (self.path, (), False, self.layout)

    @property
    def warnings(self) -> list[str]:
        """What is missing or left out, each one sentence that begins with the file."""
        return [printable(warning) for warning in self._warnings]

    @property
    def reading_notes(self) -> tuple[list[str], dict[str, str]]:
        """Warnings; nothing is left out later."""
        return list(self._warnings), {}

    def restore_notes(self, warnings: Sequence[str], undecoded: Mapping[str, str]) -> None:
        """Set `reading_notes`."""
        self._warnings = list(warnings)

    def walk(self) -> None:
        """Do nothing: there is no index."""

    def type_fields(self, topic: str) -> TypeFields:
        """Columns as fields."""
        self._require([topic])
        fields = {name: _field_type(column) for name, column in self.columns_by_field.items()}

        def of(type_name: str) -> Mapping[str, FieldType]:
            if type_name != TYPE:
                raise SignalError(f"{type_name}: a table has no such type; check the type")
            return fields

        return of

    def messages(self, topics: Iterable[str]) -> Iterator[tuple[str, int, Any]]:
        """Rows, one after the other."""
        if not self._require(topics):
            return iter(())
        names, columns = list(self.columns_by_field), list(self.columns_by_field.values())
        return (
            (TOPIC, int(time), SimpleNamespace(**{n: c[row] for n, c in zip(names, columns, strict=True)}))
            for row, time in enumerate(self.times)
        )

    def columns(
        self, topics: Sequence[str], paths: Sequence[Sequence[FieldPath]], progress: Progress | None = None
    ) -> Columns:
        """Numbers at some paths."""
        self._require(topics)
        number = len(self.times)
        if not topics:
            nothing = np.empty(0, dtype=np.int64)
            return Columns(nothing, nothing, nothing, [])
        values = np.empty((number, len(paths[0])))
        for column, path in zip(values.T, paths[0], strict=True):
            column[:] = self._values(path)
        if progress is not None:
            for _ in progress(range(number), number):
                pass
        none = np.full(number, -1, dtype=np.int64)
        return Columns(np.zeros(number, dtype=np.int64), self.times, none, [values])

    def facts(self, progress: Progress | None = None) -> list[TopicFacts]:
        """Rate, gaps and columns."""
        steps = np.diff(self.times)
        step = float(np.median(steps)) if len(steps) else 0.0
        fields = []
        for name, column in self.columns_by_field.items():
            if _field_type(column).kind == "number":
                fields.append(name if column.ndim == 1 else f"{name}[0..{column.shape[1] - 1}]")
        gap = float(steps.max()) * 1e-9 if len(steps) else None
        rate = _SECOND / step if step > 0 else None
        return [TopicFacts(self.topics[TOPIC], rate, gap, tuple(fields), "none", None)]

    def _values(self, path: FieldPath) -> Any:
        """What `FieldPath.read` gives for every row."""
        steps = path.steps
        column = self.columns_by_field.get(str(steps[0][1]), np.empty(0))
        if not column.size and len(self.times):
            raise BagError(
                f"{self.path}: there is no column '{steps[0][1]}'; columns there: "
                f"{shortlist(list(self.columns_by_field), 50)}"
            )
        if path.function is None and len(steps) == 1:
            return column
        if path.function is None and len(steps) == 2 and steps[1][0] == "index":
            where = int(steps[1][1])
            return column[:, where] if where < column.shape[1] else math.nan
        return [path.read(row) for _, _, row in self.messages([TOPIC])]

    def _require(self, topics: Iterable[str]) -> list[str]:
        wanted = list(topics)
        for topic in wanted:
            if topic != TOPIC:
                raise BagError(f"{self.path}: there is no topic {topic}; a table has one, {TOPIC}")
        if wanted and not self.topics[TOPIC].readable:
            raise BagError(f"{self.path}: cannot be used: {self.topics[TOPIC].reason}; choose another file")
        return wanted


def _file_and_run(path: Path) -> tuple[Path, str | None]:
    """`runs.csv` and `3` of `runs.csv[3]`."""
    match = _RUN.fullmatch(path.name)
    if match is None or path.exists():
        return path, None
    return path.with_name(match["file"]), match["run"]


def _read(file: Path) -> RawTable:
    if not file.exists():
        raise missing(file)
    return read_table(file)


def _runs(file: Path, raw: RawTable, layout: TableLayout) -> dict[str, NDArray[np.intp]]:
    """Rows of each run, by its value in the column, in order of first rows."""
    assert layout.runs is not None
    column = raw.columns[find_column(file, layout.runs, list(raw.columns), "the runs")]
    if column.ndim != 1:
        raise BagError(f"{file}: column '{layout.runs}' has several numbers a row, so it names no run")
    keys = column.astype(str)
    if column.dtype.kind == "f":
        keys = np.asarray([repr(value).removesuffix(".0") for value in column.tolist()])
        if raw.exact is not None and len(column) and bool((np.abs(column) >= _INEXACT).any()):
            keys = np.asarray(raw.exact(find_column(file, layout.runs, list(raw.columns), "the runs")))
    names, first, rows = np.unique(keys, return_index=True, return_inverse=True)
    if len(names) > _MOST_RUNS:
        raise BagError(f"{file}: column '{layout.runs}' has {len(names)} values, so it names no runs; choose another")
    order = np.argsort(rows, kind="stable")
    pieces = np.split(order, np.cumsum(np.bincount(rows, minlength=len(names)))[:-1])
    found: dict[str, NDArray[np.intp]] = {}
    for i in np.argsort(first, kind="stable").tolist():
        name = str(names[i]).replace("[", "(").replace("]", ")")
        if name in _NO_RUN:
            raw.notes.append(f"{plural(len(pieces[i]), 'row')} without a run left out")
        elif name in found:
            raise BagError(f"{file}: runs '{names[i]}' and '{name}' would have one name; rename one of them")
        else:
            found[name] = pieces[i]
    return found


def _field_type(column: Column) -> FieldType:
    if column.dtype.kind in "OM":
        return FieldType("string" if column.dtype.kind == "O" else "other", "text or instants")
    return FieldType("number", str(column.dtype), None if column.ndim == 1 else column.shape[1])
