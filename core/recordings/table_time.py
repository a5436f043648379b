# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The time of a table: which column it is, and its instants in ns, exact where the file is."""

from __future__ import annotations

import re
from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.errors import BagError
from uncertain_lti.base.text import meant, shortlist
from uncertain_lti.recordings.mcap_records import LATEST
from uncertain_lti.recordings.table_files import YEARS as _YEARS
from uncertain_lti.recordings.table_files import Column, RawTable
from uncertain_lti.signals.values import UNITS, TableLayout

NO_TIME = -(2**63)
"""Instant of a row without one."""

_NAMES = (
    r"(__|%)?time(_?stamp)?", r"t", r"stamp", r"date_?time", r"timestamp.*", r"(elapsed|rel(ative)?|abs(olute)?|unix|"
    r"epoch|header|log|sim(ulation)?|record(ing)?)_?time.*", r"time_.*", r"t_.*", r"zeit", r"tempo?s?", r"date",
    r"sec(ond)?s?", r"m(illi)?s(ec(ond)?s?)?",
)  # fmt: skip
_UNIT = {
    "s": r"s|secs?|seconds?", "ms": r"ms|msecs?|millis(econds?)?", "us": r"us|µs|usecs?|micros(econds?)?",
    "ns": r"ns|nsecs?|nanos(econds?)?",
}  # fmt: skip
_ISO = re.compile(r"(\d{4}-\d\d-\d\d)(?:[T ](\d\d:\d\d(?::\d\d(?:[.,]\d+)?)?))?\s*(Z|UTC|[+-]\d\d:?\d\d)?$")
_DAY = re.compile(r"(\d{1,2})[/.](\d{1,2})[/.](\d\d|\d{4})(?:[T ]+(\d{1,2})(?::(\d\d)(?::(\d\d(?:[.,]\d+)?))?)?)?")
_CLOCK = re.compile(r"(\d{1,2}):(\d\d)(?::(\d\d(?:[.,]\d+)?))?$")
_EPOCHS = ((10**17, "ns"), (10**14, "us"), (10**11, "ms"))  # numbers of this size since 1970, in what unit
_LARGEST_ZONE = 14  # hours
_LARGE = 10**15  # ns, above which a float of seconds does not keep each


def field_name(column: str) -> str:
    """Name of a column as a field path takes it: `Speed [rpm]` is `Speed_rpm`."""
    name = re.sub(r"\W+", "_", column).strip("_") or "column"
    return name if re.match(r"[A-Za-z_]", name) else f"c_{name}"


def find_column(path: object, wanted: str, columns: Sequence[str], what: str) -> str:
    """Find a column by its name in the file or as a field."""
    for name in columns:
        if wanted in (name, field_name(name)):
            return name
    raise BagError(
        f"{path}: there is no column '{wanted}', which the signals file names for {what}{meant(wanted, columns)}; "
        f"columns there: {shortlist(list(columns), 50)}"
    )


def instants(path: object, table: RawTable, layout: TableLayout) -> tuple[str, NDArray[np.int64], str]:
    """Instants of the rows.

    Returns (rows,): ns; `NO_TIME` where a row has none.
    """
    names = list(table.columns)
    words = ""
    if layout.time is not None:
        column = find_column(path, layout.time, names, "the time")
    else:
        column, words = _likely(path, table)
    values = table.columns[column]
    where = f"{path}: column '{column}'"
    if values.ndim != 1:
        raise BagError(f"{where}: has several numbers a row, so it is no time; name another, `table: {{time: COLUMN}}`")
    if values.dtype.kind == "M":
        return column, values.astype("datetime64[ns]").astype(np.int64), words
    if values.dtype.kind == "O":
        return column, _of_text(where, values.tolist()), words
    unit = layout.unit or _unit(column, values, table.units.get(column, ""))
    if layout.unit is None and unit != "s":
        words = f"{words}{' and ' if words else ''}its numbers are taken for {unit}"
    return column, _of_numbers(where, table, column, UNITS[unit]), f"column '{column}': {words}" if words else ""


def _likely(path: object, table: RawTable) -> tuple[str, str]:
    """The column that is a time by its name, or by what is in it."""
    names = list(table.columns)
    called = []
    for pattern in _NAMES:
        for name in names:
            bare = re.sub(r"[\[(].*", "", name).strip().lower().replace(" ", "_").strip("/")
            if re.fullmatch(pattern, bare) and table.columns[name].ndim == 1:
                called.append(name)
    if likely := [name for name in called if _may_be(table.columns[name])] or called:
        return likely[0], ""
    dated = [name for name in names if table.columns[name].dtype.kind in "MO" and _may_be(table.columns[name])]
    if len(dated) == 1:
        return dated[0], ""
    first = next((n for n in names if not re.fullmatch(r"column 1|index|unnamed.*|row|no\.?|id|nr", n.lower())), "")
    values = table.columns[first] if first else np.empty(0)
    if first == names[0] or names[:1] == ["column 1"]:
        values = table.columns[names[0]]
        if values.ndim == 1 and values.dtype.kind in "iuf" and len(values) > 2 and (values[1:] > values[:-1]).all():
            return names[0], "it is taken for the time, as it grows from row to row"
    raise BagError(
        f"{path}: no column is called time or looks like it; rename the one that is, or name it in a signals file, "
        f"`table: {{time: COLUMN}}`; if none is, add one, in s (for rows at one step, its multiples); columns there: "
        f"{shortlist(names, 50)}"
    )


def _may_be(column: Column) -> bool:
    """Numbers, instants, or text that reads as one."""
    if column.dtype.kind != "O":
        return True
    first = next((str(cell) for cell in column if cell), "")
    return bool(_ISO.match(first) or _CLOCK.match(first) or _DAY.fullmatch(first.strip()))


def _unit(name: str, values: Column, stated: str = "") -> str:
    """Unit below the names, or in the name, such as `t_ms` or `time [us]`, else by the size of times since 1970."""
    low = name.lower().replace("μ", "µ")
    for unit, pattern in _UNIT.items():
        if re.fullmatch(rf"[\[(]?\s*({pattern})\s*[\])]?", stated.lower().replace("μ", "µ")):
            return unit
    for unit, pattern in _UNIT.items():
        if re.search(rf"[\[(]\s*({pattern})\s*[\])]", low) or re.search(rf"[_\s]({pattern})$", low):
            return unit
        if re.fullmatch(pattern, low) and unit != "s":
            return unit
    finite = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    size = float(np.median(np.abs(finite.astype(np.float64)))) if len(finite) else 0.0
    return next((unit for least, unit in _EPOCHS if size > least), "s")


def _of_numbers(where: str, table: RawTable, name: str, factor: int) -> NDArray[np.int64]:
    values = table.columns[name]
    if values.dtype.kind in "iu":
        if len(values) and max(abs(int(values.max())), abs(int(values.min()))) * factor > LATEST:
            raise _too_late(where)
        return values.astype(np.int64) * factor
    known = np.isfinite(values)
    if not known.any():
        raise BagError(f"{where}: holds no time in any row; name another column, `table: {{time: COLUMN}}`")
    largest = float(np.abs(values[known]).max()) * factor
    if largest > LATEST:
        raise _too_late(where)
    times = np.full(len(values), NO_TIME, dtype=np.int64)
    if largest > _LARGE and table.exact is not None:
        cells = table.exact(name)
        if len(cells) == len(values):
            times[known] = [_exactly(cells[i], factor, float(values[i])) for i in np.flatnonzero(known).tolist()]
            return times
    times[known] = np.rint(values[known] * factor).astype(np.int64)
    return times


def _exactly(cell: str, factor: int, value: float) -> int:
    try:
        return int((Decimal(cell) * factor).to_integral_value())
    except (InvalidOperation, ValueError, OverflowError):
        return round(value * factor)


def _too_late(where: str) -> BagError:
    return BagError(
        f"{where}: is past the year 2262 in ns; say what unit it has in the signals file, `table: {{unit: ms}}`"
    )


def _of_text(where: str, cells: Sequence[object]) -> NDArray[np.int64]:
    """ISO 8601 with or without a zone (UTC where there is none), or times of day."""
    times = np.full(len(cells), NO_TIME, dtype=np.int64)
    cells = _as_iso(where, cells)
    plain: list[str] = []
    rows: list[int] = []
    shifts: list[int] = []
    for row, cell in enumerate(cells):
        text = str(cell).strip()
        if not text:
            continue
        if match := _ISO.match(text):
            day, clock, zone = match.groups()
            plain.append(f"{day}T{(clock or '00:00').replace(',', '.')}")
            rows.append(row)
            shifts.append(_shift(where, zone))
        elif match := _CLOCK.match(text):
            hours, minutes, seconds = match.groups()
            fraction = Decimal((seconds or "0").replace(",", ".")) * 10**9
            times[row] = (int(hours) * 60 + int(minutes)) * 60 * 10**9 + int(fraction)
        else:
            raise BagError(
                f"{where}: '{text[:40]}' in row {row + 1} is neither a number nor an ISO time such as "
                f"2026-11-22T06:28:01.25Z; write all of them as one or the other"
            )
    if plain:
        for text in plain:
            if not _YEARS[0] <= int(text[:4]) <= _YEARS[1]:
                raise BagError(f"{where}: '{text[:40]}' is before {_YEARS[0]} or after {_YEARS[1]}; mend it")
        try:
            parsed = np.array(plain, dtype="datetime64[ns]").astype(np.int64)
        except ValueError:
            bad = next(text for text in plain if not _parses(text))
            raise BagError(f"{where}: '{bad[:40]}' is no day or time that there is; mend it") from None
        times[rows] = parsed - np.array(shifts, dtype=np.int64)
    if (times == NO_TIME).all():
        raise BagError(f"{where}: holds no time in any row; name another column, `table: {{time: COLUMN}}`")
    return times


def _as_iso(where: str, cells: Sequence[object]) -> Sequence[object]:
    """Days such as 13/01/14 as ISO writes them, if one order of day and month alone has every day and goes forward."""
    texts = [str(cell).strip() for cell in cells if str(cell).strip()]
    found = [m for m in map(_DAY.fullmatch, texts) if m is not None]
    if not found or len(found) < len(texts):
        return cells
    orders = []
    for day, month in ((1, 2), (2, 1)):
        texts = [
            f"{m[3] if len(m[3]) == 4 else '20' + m[3]}-{int(m[month]):02}-{int(m[day]):02}T{int(m[4] or 0):02}:"
            f"{m[5] or '00'}:{m[6] or '00'}"
            for m in found
        ]
        if all(1 <= int(text[5:7]) <= 12 for text in texts) and all(a <= b for a, b in pairwise(texts)):
            orders.append(texts)
    if len(orders) == 1 or (orders and orders[0] == orders[1]):
        iso = iter(orders[0])
        return [next(iso) if str(cell).strip() else cell for cell in cells]
    raise BagError(
        f"{where}: '{found[0][0][:40]}' and the others do not say which is day and which is month; write times such as "
        f"2026-11-22T06:28:01.25Z"
    )


def _parses(text: str) -> bool:
    try:
        np.datetime64(text, "ns")
    except ValueError:
        return False
    return True


def _shift(where: str, zone: str | None) -> int:
    """Nanoseconds by which a zone is before UTC."""
    if not zone or zone in ("Z", "UTC"):
        return 0
    sign = -1 if zone[0] == "-" else 1
    digits = zone[1:].replace(":", "")
    if int(digits[:2]) > _LARGEST_ZONE or int(digits[2:]) > 59:
        raise BagError(f"{where}: there is no time zone '{zone}'; mend it")
    return sign * (int(digits[:2]) * 60 + int(digits[2:])) * 60 * 10**9
