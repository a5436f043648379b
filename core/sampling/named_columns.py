# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Named columns of a data frame or of a CSV file with one header line, as numbers."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import TransientError


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
                    raise TransientError(
                        f"{at} has {len(row)} cells, and the header names {len(columns)}; mend the file, or is the "
                        f"delimiter not {delimiter!r}?"
                    )
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
