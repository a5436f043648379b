# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Samples of a run: from arrays, a data frame or a CSV file, checked, and cut into segments."""

from __future__ import annotations

import csv
import math
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import Array, real
from uncertain_lti.base.errors import TransientError, refuse_other
from uncertain_lti.base.text import plural
from uncertain_lti.sampling.clock import Status


def listed(names: Sequence[str], what: str, name: str) -> list[str]:
    """Names of columns, of which one alone is to be in a list, too."""
    if isinstance(names, str):
        raise TransientError(f"{name}: {what} is the text '{names}'; give a list of column names")
    return [str(n) for n in names]


def frame_columns(frame: Any, time: str | None, wanted: Sequence[str], name: str) -> tuple[Any, Array]:
    """Instants (N+1,), of the index by default, and wanted columns (N+1, columns) of a pandas DataFrame."""
    if not hasattr(frame, "iloc"):
        raise TransientError(f"{name}: frame is of type {type(frame).__name__}; give a pandas DataFrame")
    columns = [str(c) for c in frame.columns]

    def column(wanted: str) -> Any:
        return frame.iloc[:, _column(columns, wanted, name, lambda i: frame.iloc[:, i])]

    t = frame.index if time is None else column(str(time))
    if getattr(t.dtype, "kind", "O") in "mM":
        t = np.asarray(t, dtype=f"{t.dtype.kind}8[ns]")  # of instants with a time zone: UTC
    else:
        t = _numeric(t, str(time or "index"), name)
    return t, np.column_stack([np.empty((len(t), 0)), *(_numeric(column(c), c, name) for c in wanted)])


def csv_columns(path: str | os.PathLike[str], wanted: Sequence[str], delimiter: str, name: str) -> Array:
    """Wanted columns (rows, columns) of a CSV file; NaN where a cell is empty."""
    try:
        with open(path, encoding="utf-8-sig", newline="") as stream:
            rows = csv.reader(stream, delimiter=delimiter)
            columns = [c.strip() for c in next(rows, [])]
            if not columns:
                raise TransientError(f"{path}: the file is empty; its first line must name the columns")
            columns[0] = columns[0].removeprefix("#").strip()  # as numpy.savetxt writes a header
            cells: dict[int, list[float]] = {i: [] for i, c in enumerate(columns) if c in wanted}
            for row in rows:
                if not row or row[0].startswith("#"):
                    continue
                at = f"{path}: line {rows.line_num}"
                if len(row) != len(columns):
                    remedy = f"mend the file, or is the delimiter not {delimiter!r}?"
                    raise TransientError(f"{at} has {len(row)} cells, and the header names {len(columns)}; {remedy}")
                for i, values in cells.items():
                    values.append(_number(row[i], f"{at}: '{row[i][:40]}' in column '{columns[i]}'"))
    except FileNotFoundError:
        raise TransientError(f"{path}: there is no such file; check the path") from None
    except OSError as error:
        raise TransientError(f"{path}: cannot be read: {error.strerror}; check the path") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise TransientError(f"{path}: cannot be read as CSV: {error}; check the file") from None
    found = np.column_stack([cells[_column(columns, c, name, cells.__getitem__)] for c in wanted])
    if not len(found):
        raise TransientError(f"{path}: there is no row under the header; check the file")
    for column, values in zip(wanted, found.T, strict=True):
        if np.isnan(values).all():
            raise TransientError(f"{path}: column '{column}' holds no number; choose another")
    return found


def _number(cell: str, where: str) -> float:
    try:
        return float(cell) if cell.strip() else math.nan
    except ValueError:
        raise TransientError(f"{where} is not a number; mend it, or leave the cell empty") from None


def _column(columns: Sequence[str], wanted: str, name: str, values: Any) -> int:
    found = [i for i, c in enumerate(columns) if c == wanted]
    if not found:
        raise TransientError(f"{name}: there is no column '{wanted}'; columns are {', '.join(columns)}")
    for other in found[1:]:
        first, second = (np.asarray(values(i)) for i in (found[0], other))
        if not ((first == second) | ((first != first) & (second != second))).all():  # NaN in both is the same
            raise TransientError(f"{name}: column '{wanted}' is there twice with different values; rename one")
    return found[0]


def _numeric(column: Any, wanted: str, name: str) -> Array:
    """Column of a data frame as numbers, NaN where it has none."""
    values = column.to_numpy()
    if values.dtype.kind not in "mMc":
        try:
            return np.array(column.to_numpy(dtype=np.float64, na_value=math.nan))
        except (TypeError, ValueError, NotImplementedError):  # the last from an index of several columns
            pass
    raise TransientError(f"{name}: column '{wanted}' is not numeric; choose another or convert it")


def nanoseconds(t: ArrayLike, name: str, recorded: bool) -> NDArray[np.int64]:
    """Instants in ns; recorded: they are those of messages, which may follow each other within a few."""
    if np.ma.is_masked(t):
        where = int(np.argmax(np.ma.getmask(t)))
        raise TransientError(f"{name}: t[{where}] is masked; leave out samples without a time")
    try:
        raw = np.array(t)
    except ValueError:  # lists of several lengths
        raise TransientError(f"{name}: t is not numeric; give a vector (N+1,)") from None
    if raw.ndim != 1:
        raise TransientError(f"{name}: t has shape {raw.shape}; it must be a vector (N+1,)")
    if raw.dtype.kind in "mM":
        if np.isnat(raw).any():
            raise TransientError(f"{name}: t[{int(np.argmax(np.isnat(raw)))}] is not a time; leave that sample out")
        return raw.astype(f"{raw.dtype.kind}8[ns]").astype(np.int64)
    if raw.dtype.kind in "iu":
        if raw.size and raw.max() > np.iinfo(np.int64).max:
            remedy = "count from a later instant"
            raise TransientError(f"{name}: t reaches {raw.max()} ns, past what 64 bits hold; {remedy}")
        t_ns = raw.astype(np.int64)
        if not recorded and (step := _median_forward(t_ns)) < 5:
            remedy = "give seconds as floats"
            raise TransientError(f"{name}: integers are nanoseconds, and the steps are {step:g}; {remedy}")
        return t_ns
    try:
        if raw.size and raw.dtype.kind not in "fO":
            raise TypeError
        seconds = raw.astype(np.float64)
    except (TypeError, ValueError):
        raise TransientError(f"{name}: t is not numeric; give seconds, integer nanoseconds or datetime64") from None
    if not np.isfinite(seconds).all():
        where = int(np.argmin(np.isfinite(seconds)))
        raise TransientError(f"{name}: t[{where}] is {seconds[where]}; leave out samples without a time")
    if seconds.size and np.abs(seconds).max() > 9.2e9:
        remedy = "give seconds, or nanoseconds as an array of integers"
        raise TransientError(f"{name}: t reaches {np.abs(seconds).max():g} s; {remedy}")
    if (step := _median_forward(seconds)) < 5e-9:
        remedy = "give time in a larger unit"
        raise TransientError(f"{name}: steps of {step:g} s are too short for a nanosecond clock; {remedy}")
    return np.rint(seconds * 1e9).astype(np.int64)


def _median_forward(t: NDArray[Any]) -> float:
    """Median of the steps forward; infinite without any."""
    steps = np.diff(t)
    forward = steps[steps > 0]
    return float(np.median(forward)) if forward.size else math.inf


def matrix(values: ArrayLike, rows: int, what: str, name: str) -> Array:
    """An argument as numbers, a row per instant."""
    try:
        array = real(values)
    except (TypeError, ValueError):
        raise TransientError(f"{name}: {what} is not numeric; give real numbers, NaN where there is none") from None
    if array.ndim == 1 and what == "u" and array.size == 0:
        array = array.reshape(rows, 0)
    elif array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2 or array.shape[0] != rows:
        remedy = f"give one row of {what} per instant"
        raise TransientError(f"{name}: {what} has shape {array.shape}, and t has {rows} instants; {remedy}")
    return array


def names_of(
    given: Sequence[str] | None, signals: Sequence[Any] | None, letter: str, values: Array, name: str
) -> tuple[str, ...]:
    """Names of the columns of an argument: those given, of the signals, or its letter and a number."""
    count = values.shape[1]
    refuse_other(given, (Iterable, type(None)), f"{name}: names of {letter}", "give a list of names", TransientError)
    names = tuple(given) if given is not None else tuple(s.name for s in signals) if signals is not None else None
    if names is None:
        return tuple(f"{letter}{i + 1}" for i in range(count))
    if isinstance(given, str) or len(names) != count:
        raise TransientError(
            f"{name}: {plural(len(names), 'name')} for {plural(count, 'column')} of {letter}; give a list, one for each"
        )
    if odd := [n for n in names if not isinstance(n, str) or not n]:
        raise TransientError(f"{name}: a column of {letter} is called {odd[0]!r}; give each a name, as text")
    if len(set(names)) < count:
        raise TransientError(f"{name}: two columns of {letter} have the same name; give each its own")
    return names


def segments_of(
    t_ns: NDArray[np.int64], max_gap_ns: int, min_step_ns: int, counters: Counter[str]
) -> tuple[NDArray[np.intp], NDArray[np.int32]]:
    """Positions of the samples that stay, and the segment of each: the rules of `Sampler`."""
    steps = np.diff(t_ns)
    opens = (steps > max_gap_ns) | (steps < -max_gap_ns)
    if (opens | (steps >= max(min_step_ns, 1))).all():
        kept = np.arange(len(t_ns))
    else:  # dropping a sample changes the step of the next one, so one after the other
        positions, last = [0], int(t_ns[0])
        for position, instant in enumerate(t_ns.tolist()[1:], start=1):
            step = instant - last
            if step == 0:
                counters[Status.EQUAL.value] += 1
            elif 0 < step < min_step_ns:
                counters[Status.SHORT.value] += 1
            elif -max_gap_ns <= step < 0:
                counters[Status.LATE.value] += 1
            else:
                positions.append(position)
                last = instant
        kept = np.array(positions, dtype=np.intp)
        steps = np.diff(t_ns[kept])
        opens = (steps > max_gap_ns) | (steps < 0)
    segment = np.zeros(len(kept), dtype=np.int32)
    segment[1:] = np.cumsum(opens)
    return kept, segment
