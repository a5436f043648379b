# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Tables in files: CSV, Parquet, Feather, .mat and .npz as named columns, and which of these are of one topic."""

from __future__ import annotations

import re
import zipfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from os.path import commonprefix
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Index, Mask
from uncertain_lti.base.errors import BagError, absent
from uncertain_lti.base.text import once, shortlist
from uncertain_lti.recordings.table_text import ROWS_EACH, YEARS, Column, RawTable, read_csv, unique
from uncertain_lti.recordings.unreadable import aside, most_inflated, one_line, os_error
from uncertain_lti.signals.values import TABLE_TOPIC

_MOST_KINDS = 100  # of messages
_SHARED = 0.5  # of the rows of the rarer column, from which on two columns are of one message
_SAME = 0.9  # of the rows of the fuller column, from which on two come at one rate; of the steps, that are even


def read_table(path: Path) -> RawTable:
    """Read a file by its suffix."""
    try:
        if not path.stat().st_size:
            raise BagError(f"{path}: the file is empty; record or copy it again")
        read: RawTable = _READERS[path.suffix.lower()](path)
    except OSError as error:
        raise os_error(path, error) from None
    except MemoryError as error:  # that a damaged file asks for, or a long one needs
        why = f" ({one_line(error)})" if str(error) else ""
        raise BagError(f"{path}: needs more memory than there is{why}; copy it again, or give a shorter one") from None
    return read


def _read_arrow(path: Path) -> RawTable:
    try:
        import pyarrow as pa  # type: ignore[import-not-found, import-untyped, unused-ignore]
        import pyarrow.feather  # type: ignore[import-not-found, import-untyped, unused-ignore]
        import pyarrow.parquet  # type: ignore[import-not-found, import-untyped, unused-ignore]
    except ImportError:
        raise BagError(f"{path}: it cannot be read: {absent('pyarrow')}") from None
    try:
        if path.suffix.lower() == ".parquet":
            rows = pa.parquet.read_metadata(path)
            if rows.num_rows * rows.num_columns * 8 > most_inflated(path.stat().st_size):
                states = f"states {rows.num_rows} rows of {rows.num_columns} columns"
                remedy = "write the columns and rows that are needed"
                raise BagError(f"{path}: {states}, which is more than is read of a file of its size; {remedy}")
            table = pa.parquet.ParquetFile(path, memory_map=False).read()
            if table.num_rows != rows.num_rows:
                states = f"it states {rows.num_rows} rows, and {table.num_rows} are read"
                raise BagError(f"{path}: is damaged: {states}; copy it again")
        else:
            table = pa.feather.read_table(path, memory_map=False)
        table.validate(full=True)
    except (pa.ArrowException, ValueError, OSError) as error:
        raise BagError(f"{path}: is damaged or no {path.suffix} file ({one_line(error)}); copy it again") from None
    found: dict[str, Any] = {}
    notes: dict[str, list[str]] = {}
    columns = dict(zip(unique(map(str, table.column_names)), table.columns, strict=True))
    for name, column in columns.items():
        kind = column.type
        if pa.types.is_dictionary(kind):
            column, kind = column.cast(kind.value_type), kind.value_type
        if pa.types.is_duration(kind):
            columns[name] = column = pa.array(np.asarray(column) / np.timedelta64(1, "s"))
            kind = column.type
        if pa.types.is_timestamp(kind) or pa.types.is_date(kind):
            found[name] = _nanoseconds(path, name, np.asarray(column))
        elif pa.types.is_boolean(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind):
            found[name] = np.asarray(column.cast(pa.float64(), safe=False), dtype=np.float64)
        elif pa.types.is_integer(kind):
            found[name] = np.asarray(column)
        elif pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_time(kind):
            texts = column.cast(pa.string()).to_pylist()  # times of day as in a CSV file
            found[name] = np.array([text or "" for text in texts], dtype=object)
        elif (rows_of := _matrix(column)) is not None:
            found[name] = rows_of
        else:
            notes.setdefault(f"of type {kind}", []).append(name)
    read = _of_one_length(path, found, notes)
    read.exact = lambda name: [str(value) for value in columns[name].to_pylist()]  # integers with gaps
    return read


def _matrix(column: Any) -> Column | None:
    """Lists of as many numbers in each row, such as the joints of an arm, as (rows, numbers); else nothing."""
    import pyarrow as pa
    import pyarrow.compute as pc  # type: ignore[import-not-found, import-untyped, unused-ignore]

    kind = column.type
    if not (pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)):
        return None
    inner, lengths = kind.value_type, pc.unique(pc.list_value_length(column)).to_pylist()
    if not (pa.types.is_floating(inner) or pa.types.is_integer(inner)) or len(lengths) != 1 or not lengths[0]:
        return None
    flat = pc.list_flatten(column).cast(pa.float64(), safe=False)
    return np.asarray(flat, dtype=np.float64).reshape(-1, lengths[0])


def _nanoseconds(path: Path, name: str, values: Column) -> Column:
    """Instants in ns, which end in 2262."""
    known = values[~np.isnat(values)]
    years = known.astype("datetime64[Y]").astype(np.int64) + 1970
    if len(years) and (years.min() < YEARS[0] or years.max() > YEARS[1]):
        raise BagError(f"{path}: column '{name}': has days before {YEARS[0]} or after {YEARS[1]}; mend it")
    return values.astype("datetime64[ns]")


def _read_mat(path: Path) -> RawTable:
    with open(path, "rb") as stream:
        head = stream.read(128)
    if head.startswith((b"MATLAB 7.3", b"\x89HDF")):
        raise BagError(f"{path}: a .mat file of version 7.3; write it again with save('{path.name}', '-v7')")
    try:
        from scipy.io import loadmat
    except ImportError:
        raise BagError(f"{path}: it cannot be read: {absent('scipy')}") from None
    try:
        variables = loadmat(path, simplify_cells=True, verify_compressed_data_integrity=True)
    except MemoryError:
        raise
    except Exception as error:  # whatever the bytes lead its reader to
        raise BagError(f"{path}: is damaged or no .mat file ({one_line(error)}); copy it again") from None
    return _of_arrays(path, {name: value for name, value in variables.items() if not name.startswith("__")})


def _read_npz(path: Path) -> RawTable:
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > most_inflated(path.stat().st_size):
                raise BagError(f"{path}: would take more memory than a recording of its size; check where it is from")
        with np.load(path, allow_pickle=False) as arrays:
            found: dict[str, Any] = {}
            for name in arrays.files:
                try:
                    found[name] = arrays[name]
                except ValueError as error:
                    if "allow_pickle" not in str(error):
                        raise
                    found[name] = None  # objects, which may run a program when they are read
    except (BagError, OSError, MemoryError):
        raise
    except Exception as error:  # whatever the bytes lead its reader to
        raise BagError(f"{path}: is damaged or no .npz file ({one_line(error)}); copy it again") from None
    return _of_arrays(path, found)


def _of_arrays(path: Path, variables: Mapping[str, Any]) -> RawTable:
    """Columns among variables: vectors, and matrices whose lines are samples; records and structures field by field."""
    found: dict[str, Any] = {}
    notes: dict[str, list[str]] = {}  # why variables are left out, and their names
    waiting = list(variables.items())[::-1]
    while waiting:
        name, value = waiting.pop()
        if isinstance(value, list) and value and all(isinstance(one, Mapping) for one in value):
            numbers = all(one.keys() == value[0].keys() and not any(map(np.ndim, one.values())) for one in value)
            each = {key: np.array([one[key] for one in value]) for key in value[0]} if numbers else {}  # a row in each
            value = each or {str(number): one for number, one in enumerate(value, 1)}
        if isinstance(value, Mapping):
            waiting += [(f"{name}_{key}", inner) for key, inner in list(value.items())[::-1]]
            continue
        array = np.asarray(value) if value is not None else np.empty(0, dtype=object)
        if {"s0", "s2", "arr"}.issubset(array.dtype.names or ()):
            save = f"t = s{{1}}.Values.Time; x = s{{1}}.Values.Data; save('{path.name}', 't', 'x', '-v7')"
            kind = next(iter(array["s2"].ravel()), "")
            kind = kind.decode(errors="replace") if isinstance(kind, bytes) else str(kind)
            what = f"an object of class {kind[:40]}: save its vectors, those of a Dataset s by {save}"
            notes.setdefault(what, []).append(name)
            continue
        if array.dtype.names:
            waiting += [(f"{name}_{key}", array[key]) for key in reversed(array.dtype.names)]
            continue
        if array.ndim == 2 and 1 in array.shape:
            array = array.ravel()
        if array.dtype.kind == "M":
            array = _nanoseconds(path, name, array)
        elif array.dtype.kind == "m":
            array = array / np.timedelta64(1, "s")
        elif array.dtype.kind in "US":
            array = np.char.decode(array, "utf-8", "replace") if array.dtype.kind == "S" else array
            array = array.astype(object)
        elif array.dtype.kind in "bf":
            array = array.astype(np.float64)
        elif array.dtype.kind not in "iu" and not _is_text(array):
            notes.setdefault("no array of numbers", []).append(name)
            continue
        if array.ndim in (1, 2) and array.shape[0] > 1:
            short = re.sub(r"_signals((?:_\d+)?)_values$", r"\1", name)  # as Simulink logs a signal beside its time
            name = name if short in found else short
            found[once([*found, name], "_")[-1] if name in found else name] = array  # `a.b` beside `a_b`
        elif array.ndim:
            notes.setdefault("no vector", []).append(name)
    return _of_one_length(path, found, notes)


def _is_text(array: NDArray[Any]) -> bool:
    return array.dtype.kind == "O" and array.ndim == 1 and len(array) > 0 and all(isinstance(v, str) for v in array)


def _of_one_length(path: Path, found: Mapping[str, Column], notes: dict[str, list[str]]) -> RawTable:
    """The columns of the length that most have; lines of a matrix count as samples, else its columns do."""
    if found and not any(map(len, found.values())):
        raise BagError(f"{path}: has columns and no row; record or copy it again")
    said = []
    matrices = [name for name, column in found.items() if column.ndim == 2]
    if len(matrices) == 1:
        matrix = found[name := matrices[0]]
        first, *rest = matrix if matrix.shape[0] < matrix.shape[1] else matrix.T
        beside = [other for other, column in found.items() if other != name and len(column) == len(first)]
        if rest and _rises(first) and not any("time" in n.lower() or _rises(found[n]) for n in beside):
            said = [f"the first line of '{name}' is taken for the time, as it grows"]  # as Simulink writes to a file
            found = {"time": first, **found, name: np.column_stack(rest)}
    vectors = [name for name, column in found.items() if column.ndim == 1]
    lengths = Counter({len(column): 0 for column in found.values()})
    for column in found.values():
        lengths[max(column.shape) if vectors else len(column)] += min(column.shape) if column.ndim > 1 else 1
    if not lengths:
        there = "; ".join(_by_reason(notes)[:3]) or "nothing"
        raise BagError(f"{path}: holds no column of numbers ({there}); save time and signals as vectors of one length")
    length = max(lengths, key=lambda number: (lengths[number], number))
    kept: dict[str, Column] = {}
    for name, column in found.items():
        if len(column) == length:
            kept[name] = column
        elif column.ndim == 2 and column.shape[1] == length:
            kept[name] = column.T
        else:
            notes.setdefault(f"not of {length} entries as the others", []).append(f"{name} ({len(column)})")
    return RawTable(kept, _by_reason(notes) + said)


def _rises(column: Column) -> bool:
    """Whether it may be a time: text and instants, or numbers that grow."""
    return column.dtype.kind not in "iuf" or bool((np.diff(column) > 0).all())


def _by_reason(notes: Mapping[str, Sequence[str]]) -> list[str]:
    """A sentence for each reason why variables are left out."""
    return [f"{shortlist([repr(name) for name in names], 4)} left out, {why}" for why, names in notes.items()]


_READERS: Mapping[str, Callable[[Path], Any]] = {
    **dict.fromkeys((".csv", ".txt", ".dat", ".tsv", ".lvm"), read_csv),
    ".parquet": _read_arrow,
    ".feather": _read_arrow,
    ".mat": lambda path: aside(_read_mat, path, ".mat file"),  # damage may break its reader down
    ".npz": _read_npz,
}


def by_message(columns: Mapping[str, Column], number: int) -> dict[str, tuple[list[str], Index]]:
    """Fields and rows of each topic: of several messages by turns, each of two numbers or more, or of several rates."""
    one = {TABLE_TOPIC: (list(columns), np.arange(number))}
    numbers = {name: column for name, column in columns.items() if column.dtype.kind not in "OM"}
    if all(column.ndim > 1 or np.isfinite(column).all() for column in numbers.values()):
        return one
    names: dict[bytes, list[str]] = {}  # by where they have a number
    for name, column in numbers.items():
        there = np.isfinite(column) if column.ndim == 1 else np.ones(number, np.bool_)
        if there.all() and column.ndim == 1 and _goes_on(column):
            there = ~there  # an index or a label is of no message
        if len(names) > _MOST_KINDS:
            return one
        names.setdefault(there.tobytes(), []).append(name)
    any_row = names.pop(bytes(number), [])
    if slower := _slower(names, number):
        return one | slower
    known = {kind: np.frombuffer(kind, np.bool_) for kind in names}
    if any(there.all() for there in known.values()):
        return one
    rows = {kind: np.count_nonzero(there) for kind, there in known.items()}
    groups: list[list[bytes]] = []
    for kind in known:
        shared = {other: np.count_nonzero(known[kind] & known[other]) for group in groups for other in group}
        of = {other for other, both in shared.items() if both >= _SHARED * min(rows[kind], rows[other])}
        tied = [group for group in groups if not of.isdisjoint(group)]
        groups = [group for group in groups if group not in tied] + [[*chain(*tied), kind]]
    rows_of = [np.flatnonzero(np.any([known[kind] for kind in group], axis=0)) for group in groups]
    fields = [[name for kind in group for name in names[kind]] for group in groups]
    # where no message has two numbers, signals were written as they changed, and hold until then
    turns = [1 + np.count_nonzero(np.diff(of) > 1) >= min(ROWS_EACH, max(3, len(of) / 5)) for of in rows_of]
    if sum(turns) < 2 or max(map(len, fields)) < 2:
        return one
    begun = [(commonprefix(group), group[0]) for group in fields]
    fields[int(np.argmax([len(of) for of in rows_of]))] += any_row
    topics = once((begin.rpartition("_")[0] or begin or first for begin, first in begun), "_")
    return {f"{TABLE_TOPIC}/{topic}": of for topic, of in zip(topics, zip(fields, rows_of, strict=True), strict=True)}


def _slower(names: Mapping[bytes, list[str]], number: int) -> dict[str, tuple[list[str], Index]]:
    """Fields and rows of a topic for each slower rate, if nearly every row has a number of the fastest."""
    groups: list[tuple[Mask, list[str]]] = []
    for kind in sorted(names, key=lambda kind: -kind.count(1)):
        there = np.frombuffer(kind, np.bool_)
        of = (g for first, g in groups if np.count_nonzero(first & there) >= _SAME * np.count_nonzero(first))
        if (group := next(of, None)) is not None:
            group += names[kind]
        else:
            groups.append((there, [*names[kind]]))
    if not groups or np.count_nonzero(groups[0][0]) < _SAME * number:
        return {}
    slower: dict[str, tuple[list[str], Index]] = {}
    order = [*chain(*names.values())]
    for there, group in groups[1:]:
        rows = np.flatnonzero(there)
        steps = np.diff(rows)
        usual = float(np.median(steps)) if len(rows) > 3 else 0.0
        few = len(rows) <= 3 and (len(rows) > 1 or bool(slower))  # as of a short recording
        if few or usual >= 2 and np.mean((steps > usual / 2) & (steps < 2 * usual)) >= _SAME:
            group.sort(key=order.index)  # whichever has a number more
            slower[f"{TABLE_TOPIC}/{group[0]}"] = group, rows
    return slower


def _goes_on(column: Column) -> bool:
    """Whether a column is an index, a label or constant: its step from row to row is nearly always that before."""
    same = np.diff(column.astype(np.float64), 2) == 0
    return int(np.count_nonzero(same)) >= 0.9 * len(same)
