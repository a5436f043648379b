# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Times of tables: which column has them, in which unit and form, as integer nanoseconds."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from decimal import Decimal, InvalidOperation
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from uncertain_lti.base.arrays import Integers
from uncertain_lti.base.errors import BagError
from uncertain_lti.base.text import shortlist
from uncertain_lti.recordings.mcap_records import LATEST
from uncertain_lti.recordings.table_text import ODD_SHARE, YEARS, Column, RawTable, find_column, left_out
from uncertain_lti.signals.values import UNITS, TableLayout

NO_TIME = -(2**63)
"""Instant of a row without one."""

_NAMES = (
    r"(__?|%)?time(_?stamp|string)?", r"ts?", r"stamp", r"date_?time", r"timestamp.*",
    r"(elapsed|rel(ative)?|abs(olute)?|"
    r"unix|epoch|header|log|sim(ulation)?|record(ing)?)_?time.*", r"time_.*", r"((uhr|mess)_?)?zeit(stempel)?",
    r"temps|tempo", r"t_.*", r"elapsed|up_?time", r"date|datum", r"sec(ond)?s?", r"m(illi)?s(ec(ond)?s?)?",
)  # fmt: skip
_LASTS = re.compile(r"time_(since|until|till|to|run|running|on|off|in|left|remaining|with(out)?)(_.*)?")
_LONGEST_STEP = 3600  # s that a number beside the columns may say, as `Ts` of a benchmark
_GOES_BACK = 0.1  # share of rows older than the one before from which on a column `t_...` has temperatures
_OF_WHAT, _GROWS = re.compile(r"\w+time"), "it is taken for the time, as it grows from row to row"
_UNIT = {
    "s": r"s|secs?|seconds?", "ms": r"ms|msecs?|milli(s|secs?|seconds?)", "us": r"us|µs|usecs?|micro(s|secs?|seconds?)",
    "ns": r"ns|nsecs?|nano(s|secs?|seconds?)", "min": r"mins?|minutes?", "h": r"h|hrs?|hours?", "d": r"days?",
}  # fmt: skip
_ISO = re.compile(r"(\d{4}-\d\d-\d\d)(?:[T ](\d\d:\d\d(?::\d\d(?:[.,]\d+)?)?))?\s*(Z|UTC|[+-]\d\d(?::?\d\d)?)?$")
_PLAIN = re.compile(
    r"(1[7-9]|2[01])\d\d-\d\d-\d\d[T ]([01]\d|2[0-3]):[0-5]\d(:[0-5]\d(\.\d{1,9})?)?"
)  # as numpy reads it
_DAY = re.compile(
    r"(\d{1,2})[/.\s](\d{1,2})[/.\s](\d\d|\d{4})(?:[T ]+(\d{1,2})(?::(\d\d)(?::(\d\d(?:[.,]\d+)?))?)?)?"
    r"([+-]\d\d:?\d\d)?"
)
_CLOCK = re.compile(r"(\d{1,2}):(\d\d)(?::(\d\d(?:[.,]\d+)?))?$")
_DOTTED = re.compile(r"([01]?\d|2[0-3])\.([0-5]\d)\.([0-5]\d)")  # 18.00.00
_MINUTES = re.compile(r"(\d{1,2}):([0-5]\d[.,]\d+)")  # as Excel writes times with decimals
_HALF = re.compile(r"(|.*[T\s])(\d{1,2})(?:[:.](\d\d))?(?:[:.](\d\d(?:[.,:]\d+)?))?\s*([AaPp])\.?\s?[Mm]\.?")  # 1:05 PM
_NAMED = (  # months: 13-Mar-2024, Mar 13, 2024, Wed Mar 13 11:55:03 2024
    re.compile(
        r"(?:[A-Z][a-z]+,?\s+)?(?P<d>\d{1,2})[-\s/](?P<m>[A-Za-z]{3})[a-z]*\.?[-\s/,]+(?P<y>\d{4}|\d\d)\b(?P<t>.*)"
    ),
    re.compile(r"(?:[A-Z][a-z]+,?\s+)?(?P<m>[A-Za-z]{3})[a-z]*\.?\s+(?P<d>\d{1,2}),?\s+(?P<y>\d{4})\b(?P<t>.*)"),
    re.compile(r"(?:[A-Z][a-z]+\s+)?(?P<m>[A-Z][a-z]{2})\s+(?P<d>\d{1,2})(?P<t>\s[\d:.]+)\s(?P<y>\d{4})"),
)
_MONTHS = "jan feb mar apr may jun jul aug sep oct nov dec".split()
_YEAR_FIRST = re.compile(r"(\d{4})([-/.])(\d{1,2})\2(\d{1,2})(?:[T,\s]+(\d{1,2}))?((?::\d\d)*)(.*)")
_DASHED = re.compile(r"^(\d{1,2})-(\d{1,2})-((?:\d{4}|\d\d(?!\d)).*)")
_DASHES = re.compile(r"^(\d{4}-\d\d?-\d\d?)[-_T ]+(\d\d?)-(\d\d)-(\d\d)(?:[-.](\d+))?$")  # 2022-5-7--11-24-56-316
_COMPACT = re.compile(r"^((?:19|20)\d\d) ?([01]\d) ?([0-3]\d)[T_ ]?([0-2]\d) ?([0-5]\d) ?([0-5]\d(?:\.\d+)?)(.*)")
_EPOCHS = ((10**17, "ns"), (10**14, "us"), (10**11, "ms"))  # numbers of this size since 1970, in what unit
_ZONES = dict(
    UTC="Z", CET="+01:00", CEST="+02:00", MEZ="+01:00", MESZ="+02:00", BST="+01:00", JST="+09:00", EST="-05:00",
    EDT="-04:00", CST="-06:00", CDT="-05:00", MST="-07:00", MDT="-06:00", PST="-08:00", PDT="-07:00",
)  # fmt: skip
_ZONE = re.compile(rf"(?<=\S)\s+([+-]\d\d:?\d\d|{'|'.join(_ZONES)})$")  # as .NET, Python and date(1) write it
_LARGEST_ZONE = 14  # hours
_CALENDARS = (20_000, 80_000, 25_569), (690_000, 800_000, 719_529)  # days of these decades: Excel, MATLAB; 1970-01-01
_HARDLY = 1e-4  # s from row to row, below which numbers such as days of a spreadsheet hardly are s
_UNLIKELY = 100, 1000  # s from row to row, not whole minutes, from which on it hardly is in s; the other: since 1970
_MANY = 1000  # rows, from which on their numbers may be taken for a time unawares
_ODD = 10  # the same of those that are no multiple of 5 s, not since 1970
_LARGE = 10**15  # ns, above which a float of seconds does not keep each


class Instants(NamedTuple):
    """Column of the time, instants (rows,), ns or `NO_TIME`, and what was taken for granted, in words and as a unit."""

    column: str
    times: Integers
    words: str = ""
    unit: str = ""


def instants(path: object, table: RawTable, layout: TableLayout) -> Instants:
    """When the rows of a table are from."""
    if layout.step is not None:
        rows = len(next(iter(table.columns.values()), ()))
        return Instants("", np.rint(np.arange(rows) * (layout.step * 1e9)).astype(np.int64))
    if layout.time is not None:
        column, words = find_column(path, layout.time, list(table.columns), "the time"), ""
    else:
        column, words = _likely(path, table)
    said, granted = [words], ""
    values = table.columns[column]
    where = f"{path}: column '{column}'"
    if values.ndim != 1:
        raise BagError(f"{where}: has several numbers a row, so it is no time; name another, `table: {{time: COLUMN}}`")
    if values.dtype.kind == "M":
        times = values.astype("datetime64[ns]").astype(np.int64)
    elif values.dtype.kind == "O":
        cells = _with_colons(values.tolist())
        if layout.time is None and (days := _days_beside(table, column)):
            cells = [f"{day} {cell}".strip() for day, cell in zip(table.columns[days].tolist(), cells, strict=True)]
            said.append(f"its days are those of column '{days}'")
        times, order = _of_text(where, cells)
        said.append(order)
    elif layout.unit is None and _compact(values):
        times, _ = _of_text(where, [f"{value:.0f}" if value == value else "" for value in values.tolist()])
    else:
        stated = layout.unit or _unit(column, values, table.units.get(column, ""))
        unit, days = stated or "s", "write days of a spreadsheet as ISO times, or give `--table unit=d`"
        doubt = f"; {days}" * (not stated and _like_days(values))
        clock = bool(doubt) and _on_the_clock(values)
        if clock or (doubt and np.median(np.abs(np.diff(values[np.isfinite(values)]))) < _HARDLY):
            if not (clock or _says_days(table, column)):
                raise BagError(f"{where}: may be s or days: {days} (in a file `table: {{unit: d}}`); for s, `unit=s`")
            unit, doubt = "d", ""
        if unit == "s" and not stated and (step := _coarse(values)):
            doubt, likely = f", {step:.10g} from row to row", "ms" if step < 1000 else "us" if step < 1e7 else "ns"
            given = f"`--table unit={likely}` (in a signals file `table: {{unit: {likely}}}`)"
            dated = _since_1970(float(np.nanmedian(values)))
            if step >= _UNLIKELY[dated] or (step >= _ODD and step % 5 and not dated):
                raise BagError(f"{where}{doubt}: has no unit; name it time_{likely}, or give {given}; for s, `unit=s`")
            doubt += f": for others name it time_{likely}, or give {given}"
        elif unit == "s" and not stated and _counts_rows(values):
            said.append("its numbers are those of the rows, taken for s: of another rate give `--table step=0.01`")
        if layout.unit is None and (unit != "s" or doubt):
            said.append(f"its numbers are taken for {unit}{doubt}")
            granted = "" if stated else unit
        if unit == "d" and (since := _first_day(values)):
            table = replace(table, columns={column: values - since}, exact=None)
        times = _of_numbers(where, table, column, UNITS[unit])
    words = " and ".join(filter(None, said))
    return Instants(column, times, f"column '{column}': {words}" if words else "", granted)


def _says_days(table: RawTable, column: str) -> bool:
    """Whether a column of days is one by its name, or by a time beside it that grows by as many seconds."""
    span = 86_400 * np.ptp(table.columns[column])
    others = (c for n, c in table.columns.items() if n != column and called_time(n) and c.dtype.kind in "iuf")
    return bool(re.search("date|datum", column.lower()) or any(abs(np.ptp(c) / span - 1) < 1e-3 for c in others))


def _likely(path: object, table: RawTable) -> tuple[str, str]:
    """The column that is a time by its name, or by what is in it."""
    if stamp := _of_stamp(table):
        return stamp, ""
    names = list(table.columns)
    plain = [name for name in names if table.columns[name].ndim == 1]
    called = [name for pattern in _NAMES for name in plain if re.fullmatch(pattern, _bare(name))]
    still = [name for name in called if _stands_still(table.columns[name])]
    moved = [name for name in called if name not in still]
    lasting = [name for name in moved if _LASTS.fullmatch(_bare(name)) and _held(table.columns[name])]
    warm = [name for name in called if _bare(name).startswith("t_") and _goes_back(table.columns[name])]
    none_of_them = {*still, *lasting, *warm}
    called = [n for n in called if n not in none_of_them and not _of_a_minute(n, table.columns[n])]
    if likely := [name for name in called if may_be(table.columns[name])] or called:
        words_first = table.columns[called[0]].dtype.kind == "O" and not may_be(table.columns[called[0]])
        taken = called[0] if words_first and not goes_forward(table.columns[likely[0]]) else likely[0]
        taken = _clock_beside(table, taken) or taken
        finer = (n for n in plain if (called_time(n) or _OF_WHAT.fullmatch(_bare(n))) and _grows(table.columns[n]))
        column = next(finer, "") if _held(table.columns[taken]) else ""
        return (column, f"{_GROWS}, and '{taken}' does not") if column else (taken, "")
    dated = [name for name in names if table.columns[name].dtype.kind in "MO" and may_be(table.columns[name])]
    if len(dated) == 1 or (len(dated) == 2 and dated[0] == names[0]):
        return _clock_beside(table, dated[0]) or dated[0], ""
    if parts := _of_parts(table):
        return parts, "it is put together of these columns, a day more where it goes back"
    first = [n for n in names[:1] if not re.fullmatch(r"index|unnamed.*|row|no\.?|id|nr", n.lower())]
    for name in [*(n for n in names if _OF_WHAT.fullmatch(_bare(n))), *first]:
        says = name in table.units or names[1:2] == ["column 2"]  # a unit, or that none has a name
        if not _grows(values := table.columns[name]):
            continue
        counts = bool(np.mean(np.diff(values) == 1) >= (0.5 if name == "column 1" else 1.0))  # a data frame, or a part
        if says or not counts:
            each = ", a second a row; if it numbers the rows, say how many s each has, `--table step=0.01`"
            return name, _GROWS + each * (counts and name not in table.units)
    none = f"column {still[0]!r} is the same in all rows, and no other" if still else "no column"
    none = f"column {lasting[0]!r} says how long something has lasted, and no other" if lasting else none
    same = [float(table.columns[name][0]) for name in still if table.columns[name].dtype.kind in "iuf"]
    step = next((f"{value:g}" for value in same if 0 < value <= _LONGEST_STEP), "0.01")
    none = f"columns {dated[0]!r} and {dated[1]!r} hold times, and no column alone" if len(dated) > 1 else none
    texts = [n for n in names if re.search("time|date|zeit|stamp", n.lower()) and table.columns[n].dtype.kind == "O"]
    if cell := next((str(cell) for n in texts[:1] for cell in table.columns[n] if cell and not dated), ""):
        none = f"column {texts[0]!r} holds '{cell[:40]}', which is not read as a time, and no column"
    none = "; ".join([*table.notes, none])
    raise BagError(
        f"{path}: {none} is called time or looks like it; rename the one that is, or name it, `--table time=COLUMN`; "
        f"for rows at one step without a time say how many s it has, `--table step={step}` (in a signals file "
        f"`table: {{step: {step}}}`); columns there: {shortlist(names, 50)}"
    )


def spread(times: Integers) -> Integers:
    """Times that several rows share, such as whole seconds, as if the rows of each came evenly until the next.

    Beside a pause, and at both ends, they come as fast as usual.
    """
    first = np.flatnonzero(np.diff(times, prepend=times[0] - 1))
    rows, gaps = np.diff(first, append=len(times)), np.diff(times[first])
    usual, each = (int(np.median(gaps)), int(np.median(rows))) if len(gaps) else (0, 1)
    gaps = np.append(gaps, usual + 1)  # both ends are beside a pause
    ends, begins = gaps > usual, np.append(True, gaps[:-1] > usual)
    span = np.minimum(gaps, usual)
    steps = span / np.where(ends | begins, np.maximum(rows, each), rows)
    late = np.where(begins & ~ends, span - rows * steps, 0.0)
    which = np.repeat(np.arange(len(first)), rows)
    place = np.arange(len(times)) - first[which]
    return np.asarray(times + np.rint(late[which] + place * steps[which]).astype(np.int64))


def _bare(name: str) -> str:
    """Name of a column without its unit, as `_NAMES` has it."""
    low = re.sub(r"[\s/]+", "_", re.sub(r"[\[(].*", "", name).strip(" /").lower())
    return re.sub(rf"(_|(?<=time))({'|'.join(_UNIT.values())})$", "", low)


def called_time(name: str) -> bool:
    """Whether a column is a time by its name."""
    return any(re.fullmatch(pattern, _bare(name)) for pattern in _NAMES)


def _held(column: Column) -> bool:
    """Whether most rows have the value of the row before, as of a sensor slower than the rows."""
    return 2 * int(np.count_nonzero(column[1:] == column[:-1])) > len(column)


def _grows(column: Column) -> bool:
    """Whether numbers grow from each row to the next, or nearly so and are times since 1970."""
    if column.ndim != 1 or column.dtype.kind not in "iuf" or len(column) < 3:
        return False
    if (column[1:] > column[:-1]).all():
        return True
    size = float(np.nanmedian(column))
    return any(_since_1970(size / 10**digits) for digits in (0, 3, 6, 9)) and goes_forward(column)  # in s to ns


def _since_1970(seconds: float) -> bool:
    """Whether they may be since 1970, from 1998 to 2099."""
    return 0.9e9 < seconds < 4.1e9


def _days_beside(table: RawTable, column: str) -> str:
    """The one column of days alone, where this one has times of day alone; else nothing."""
    days, clocks = _days_and_clocks(table)
    return days[0] if len(days) == 1 and column in clocks else ""


def _clock_beside(table: RawTable, column: str) -> str:
    """The one column of times of day alone, where this one alone has days alone; else nothing."""
    days, clocks = _days_and_clocks(table)
    return clocks[0] if days == [column] and len(clocks) == 1 else ""


def _days_and_clocks(table: RawTable) -> tuple[list[str], list[str]]:
    """Columns of days alone, and those of times of day alone, by their first cells."""
    texts = {name: cells for name, cells in table.columns.items() if cells.dtype.kind == "O"}
    first = {name: _spelt(next((str(cell) for cell in cells if cell), "")) for name, cells in texts.items()}
    days = [name for name, text in first.items() if (m := _ISO.match(text) or _DAY.fullmatch(text)) and ":" not in m[0]]
    return days, [name for name, text in first.items() if _CLOCK.match(text)]


def _of_stamp(table: RawTable) -> str:
    """Put whole seconds since 1970 and the nanoseconds beside them together; what that is called, or nothing.

    So the stamp of a ROS message is in a table, as `ros2 topic echo --csv` writes it.
    """
    numbers = {name: c for name, c in table.columns.items() if c.ndim == 1 and c.dtype.kind in "iuf" and len(c) > 2}
    for (sec, whole), (nanosec, rest) in pairwise(numbers.items()):
        if not _since_1970(float(whole[0])):
            continue
        both = np.array([whole, rest], dtype=np.float64)
        if (both != np.rint(both)).any() or not 0 <= both[1].min() < both[1].max() < 1e9:
            continue
        next_second = np.diff(both[0]) == 1
        if both[1].max() > 5e8 and next_second.any() and np.mean(np.diff(both[1])[next_second] < 0) > 0.9:
            stamps = (both[0].astype(np.int64) * 10**9 + both[1].astype(np.int64)).astype("datetime64[ns]")
            others = {name: column for name, column in table.columns.items() if name not in (sec, nanosec)}
            table.columns = {f"{sec} {nanosec}": stamps} | others
            return f"{sec} {nanosec}"
    return ""


def _of_parts(table: RawTable) -> str:
    """Put hours, minutes and seconds together in place of their columns; what that is called, or nothing."""
    parts = [
        [n for n, c in table.columns.items() if re.fullmatch(_UNIT[unit], n.lower()) and c.dtype.kind in "iuf"][:1]
        for unit in ("h", "min", "s")
    ]
    if not all(parts):
        return ""
    clock = np.array([table.columns[name] for (name,) in parts], dtype=np.float64)
    good = ((clock >= 0) & (clock < [[24], [60], [60]])).all(axis=0)
    if good.mean() < 1 - ODD_SHARE:
        return ""
    seconds = np.where(good, [3600.0, 60.0, 1.0] @ clock, np.nan)
    seconds[good] = _past_midnight(seconds[good], 86_400)
    called = f"{':'.join(name for (name,) in parts)} [s]"
    rest = {name: column for name, column in table.columns.items() if [name] not in parts}
    table.columns = {called: seconds} | rest
    return called


def _past_midnight(clock: Column, day: int) -> Column:
    """Times of day, a day more from where they go back by more than half of one."""
    return np.asarray(clock + day * np.cumsum(np.diff(clock, prepend=clock[:1]) < -day / 2))


def _stands_still(column: Column) -> bool:
    same = column.dtype.kind in "iuf" and len(column) > 2 and (column == column[0]).sum()
    return bool(same == len(column) or (same and np.count_nonzero(column == column) == 1))


def _goes_back(column: Column) -> bool:
    """Whether it goes back often; unlike `goes_forward`, a time that stands still for many rows does not."""
    return column.dtype.kind in "iuf" and bool(np.mean(np.diff(column) < 0) > _GOES_BACK)


def _of_a_minute(name: str, column: Column) -> bool:
    """Whether it has the seconds of a clock whose minutes and hours are in other columns."""
    seconds = column.dtype.kind in "iuf" and len(column) > 1 and re.fullmatch(r"sec(ond)?s?", _bare(name)) is not None
    return seconds and bool(0 <= column.min() and column.max() < 60 and (np.diff(column) < 0).any())


def may_be(column: Column) -> bool:
    """Numbers, instants, or text that reads as one."""
    text = _spelt(next((str(cell) for cell in column if cell), "")) if column.dtype.kind == "O" else ""
    return column.dtype.kind != "O" or bool(_ISO.match(text) or _CLOCK.match(text) or _DAY.fullmatch(text))


def goes_forward(column: Column) -> bool:
    """Whether it may be a time beside another that cannot be read: a temperature is none."""
    return column.dtype.kind not in "iuf" or bool(abs(np.mean(np.sign(np.diff(column)))) > 0.8)


def _with_colons(cells: Sequence[object]) -> Sequence[object]:
    """Times of day such as 18.00.00, and minutes and seconds such as 14:11.6, as others are written."""
    texts = [str(cell).strip() for cell in cells]
    if not {".", ","} & {*"".join(texts)}:
        return cells
    if any(map(_dotted, texts)):
        return [text.replace(".", ":") if _DOTTED.fullmatch(text) else text for text in texts]
    if sum(map(bool, map(_MINUTES.fullmatch, texts))) < (1 - ODD_SHARE) * sum(map(bool, texts)):
        return cells
    found = ((row, re.fullmatch(r"(\d\d?):[0-5]\d([.,]\d+)?", text)) for row, text in enumerate(texts))
    minutes = {row: int(match[1]) for row, match in found if match}
    hours = np.cumsum(np.diff([*minutes.values()], prepend=[*minutes.values()][:1]) < -30).tolist()
    for row, hour in zip(minutes, hours, strict=True):
        texts[row] = f"{hour}:{minutes[row]:02}:{texts[row].partition(':')[2]}"
    return texts


def _dotted(text: str) -> bool:
    """Whether it is a time of day with points, and no date."""
    match = _DOTTED.fullmatch(text)
    low, high = sorted((int(match[1]), int(match[2]))) if match else (1, 1)
    return not (1 <= low <= 12 and high <= 31)


def _spelt(text: str) -> str:
    """An instant as people and controllers write it, such as 13-Mar-24 1:05:03 PM, as ISO does; else as it is."""
    text = text.strip()
    if _ISO.match(text) or _CLOCK.match(text):
        return text
    if _MINUTES.fullmatch(text):
        return f"0:{text}"
    if _dotted(text):
        return text.replace(".", ":")
    text = _DASHES.sub(lambda m: "{} {}:{}:{}".format(*m.groups()) + f".{int(m[5] or 0):03}", text)
    zone, year_last = "", re.sub(r"\s([A-Z]{3,4})\s(\d{4})$", r" \2 \1", text)
    if found := _ZONE.search(year_last):
        text, zone = year_last[: found.start()], _ZONES.get(found[1], found[1])
    if half := _HALF.fullmatch(text):
        day, hour, minutes, seconds, letter = half.groups("00")
        of = int(hour) % 12 + 12 * (letter in "Pp") if int(hour) <= 12 else int(hour)
        text = f"{day}{of:02}:{minutes}:{seconds}"
    if named := next((m for m in (pattern.fullmatch(text) for pattern in _NAMED) if m), None):
        if (month := named["m"].lower()) in _MONTHS:
            year = named["y"] if len(named["y"]) == 4 else f"20{named['y']}"
            text = f"{year}-{_MONTHS.index(month) + 1:02}-{int(named['d']):02} {named['t'].lstrip(', T')}".strip()
    text = re.sub(r"(:\d\d):(\d{3,6})$", r"\1.\2", text)  # milliseconds of a controller
    text = _COMPACT.sub(r"\1-\2-\3 \4:\5:\6\7", _DASHED.sub(r"\1/\2/\3", text))
    if dated := _YEAR_FIRST.fullmatch(text):
        year, _, month, day, hour, minutes, rest = dated.groups()
        clock = f" {int(hour):02}{minutes or ':00'}{rest}" if hour else rest
        text = f"{year}-{int(month):02}-{int(day):02}{clock}"
    text = re.sub(r"\s+GMT([+-]\d{4})?(\s\(.*\))?$", lambda gmt: gmt[1] or "Z", text)  # as browsers write it
    return text if _CLOCK.match(text) else text + zone


def _unit(name: str, values: Column, stated: str = "") -> str:
    """Unit below the names, or in the name, such as `t_ms` or `time [us]`, else by the size since 1970, or ""."""
    low = name.lower().replace("μ", "µ")
    if (values > 1.0).any():  # of a day, and no days
        low = re.sub(r"(?<=[_\s]of)[_\s]day$", "", low)
    for unit, pattern in _UNIT.items():
        if re.fullmatch(rf"[\[(]?\s*({pattern})\s*[\])]?", stated.lower().replace("μ", "µ")):
            return unit
    for unit, pattern in _UNIT.items():
        if re.search(rf"[\[(]\s*({pattern})\s*[\])]", low) or re.search(rf"([_\s]|time)({pattern})$", low):
            return unit
        if (unit != "s" or low.startswith("second")) and re.fullmatch(rf"({pattern})(_.*)?", low):
            return unit
    finite = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    size = float(np.median(np.abs(finite.astype(np.float64)))) if len(finite) else 0.0
    return next((unit for least, unit in _EPOCHS if size > least), "")


def _compact(values: Column) -> bool:
    """Whether numbers are days and times such as 20240313115503."""
    known = values[np.isfinite(values)]
    inside = bool(len(known)) and 19e12 <= known.min() <= known.max() <= 21e12
    return bool(inside) and all(_COMPACT.fullmatch(f"{value:.0f}") for value in known[:1000].tolist())


def _like_days(values: Column) -> bool:
    """Whether numbers with more than three decimals are such as Excel and MATLAB write for days of these decades."""
    return _first_day(values) > 0 and bool(((values != values.round(3)) & (values == values)).any())


def _on_the_clock(values: Column) -> bool:
    """Whether days come by an even part of an hour, as far as their digits tell; no decimal step of seconds does."""
    known = values[np.isfinite(values)]
    since = 86_400 * (known - known[0])
    step = float(np.median(np.abs(np.diff(since, prepend=0.0))))
    even = min((part for part in range(1, 3601) if 3600 % part == 0), key=lambda part: abs(part - step))
    return step < 3601 and bool(np.mean(np.abs(since - even * np.rint(since / even)) < min(0.9, 0.1 * even)) > 0.9)


def _first_day(values: Column) -> int:
    """The first of January 1970 as Excel or MATLAB count days, whichever fits; 0 if neither."""
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)
    return next((first for least, most, first in _CALENDARS if least < low and high < most), 0)


def _counts_rows(values: Column) -> bool:
    return len(values) >= _MANY and values[0] in (0, 1) and bool((np.diff(values) == 1).all())


def _coarse(values: Column) -> float:
    """Usual step of whole numbers, where it is beyond 1 and no whole minutes or hours, as of a clock of ms; else 0."""
    steps = np.diff(values[np.isfinite(values)].astype(np.float64))
    if len(steps) < 3 or (steps % 1 != 0).any():
        return 0.0
    step = float(np.median(steps))
    return step if step > 1 and (steps % (60 if step <= 3600 else 3600) != 0).mean() > 0.5 else 0.0


def _of_numbers(where: str, table: RawTable, name: str, factor: int) -> Integers:
    values = table.columns[name]
    if values.dtype.kind in "iu":
        if len(values) and max(abs(int(values.max())), abs(int(values.min()))) * factor > LATEST:
            raise _too_late(where)
        return values.astype(np.int64) * factor
    known = np.isfinite(values)
    if not known.any():
        raise BagError(f"{where}: holds no time in any row; name another column, `table: {{time: COLUMN}}`")
    sizes = np.abs(np.where(known, values, 0.0)) * factor
    if np.median(sizes[known]) > LATEST:
        raise _too_late(where)
    known &= sizes <= LATEST  # the unit is right, and a row beyond is damaged
    largest = float(sizes[known].max())
    times = np.full(len(values), NO_TIME, dtype=np.int64)
    times[known] = np.rint(values[known] * factor).astype(np.int64)
    cells = table.exact(name) if largest > _LARGE and table.exact is not None else ()
    if len(cells) == len(values):
        times[known] = [_exactly(cells[i], factor, float(values[i])) for i in np.flatnonzero(known).tolist()]
    return times


def _exactly(cell: str, factor: int, value: float) -> int:
    try:
        return int((Decimal(cell) * factor).to_integral_value())
    except (InvalidOperation, ValueError, OverflowError):
        return round(value * factor)


def _too_late(where: str) -> BagError:
    return BagError(f"{where}: is past the year 2262 in ns; say its unit in the signals file, `table: {{unit: ms}}`")


def _of_text(where: str, cells: Sequence[object]) -> tuple[Integers, str]:
    """ISO 8601 with or without a zone (UTC where there is none), or times of day; what was taken for granted.

    A cell that is neither has no time, if few are.
    """
    texts = [str(cell).strip() for cell in cells]
    if texts and all(map(_PLAIN.fullmatch, texts)):
        return _parsed(where, texts), ""
    times = np.full(len(cells), NO_TIME, dtype=np.int64)
    spelt, order = _as_iso(where, [*map(_spelt, texts)])
    plain: dict[int, str] = {}  # by row
    shifts: list[int] = []
    odd: list[int] = []
    for row, text in enumerate(spelt):
        if match := _ISO.match(text):
            plain[row], shift = _of_iso(where, *match.groups())
            shifts.append(shift)
        elif match := _CLOCK.match(text):
            hours, minutes, seconds = match.groups()
            fraction = Decimal((seconds or "0").replace(",", ".")) * 10**9
            times[row] = (int(hours) * 60 + int(minutes)) * 60 * 10**9 + int(fraction)
        elif text:
            odd.append(row)
    if odd:
        given = str(cells[odd[0]]).strip()[:40]
        if len(odd) > ODD_SHARE * sum(map(bool, spelt)):
            neither = "is neither a number nor an ISO time such as 2026-11-22T06:28:01.25Z"
            remedy = "write all of them as one or the other"
            remedy += ", with a point before decimals" * bool(re.fullmatch(r"-?\d+,\d+", given))
            raise BagError(f"{where}: '{given}' in row {odd[0] + 1} {neither}; {remedy}")
        order = " and ".join(filter(None, (order, left_out(len(odd), "time", given))))
    if plain:
        times[list(plain)] = _parsed(where, list(plain.values())) - np.array(shifts)
    else:
        times[times != NO_TIME] = _past_midnight(times[times != NO_TIME], 86_400 * 10**9)
    if (times == NO_TIME).all():
        raise BagError(f"{where}: holds no time in any row; name another column, `table: {{time: COLUMN}}`")
    return times, order


def _parsed(where: str, texts: Sequence[str]) -> Integers:
    try:
        return np.array(texts, dtype="datetime64[ns]").astype(np.int64)
    except ValueError:
        if len(texts) == 1:
            raise BagError(f"{where}: '{texts[0][:40]}' is no day or time that there is; mend it") from None
        return np.concatenate([_parsed(where, [text]) for text in texts])  # one by one, to find the one that is wrong


def _of_iso(where: str, day: str, clock: str | None, zone: str | None) -> tuple[str, int]:
    """An instant without its zone, and how far that is before UTC, ns."""
    text = f"{day}T{(clock or '00:00').replace(',', '.')}"
    if not YEARS[0] <= int(day[:4]) <= YEARS[1]:
        raise BagError(f"{where}: '{text[:40]}' is before {YEARS[0]} or after {YEARS[1]}; mend it")
    late = 86_400 * 10**9 * bool(re.search(r"T24:00(:00([.]0*)?)?$", text))  # how a day ends in ISO 8601
    text = text.replace("T24:", "T00:") if late else text
    if not zone or zone in ("Z", "UTC"):
        return text, -late
    hours, minutes = int(zone[1:3]), int(zone[3:].lstrip(":") or 0)  # +01, as PostgreSQL writes it
    if hours > _LARGEST_ZONE or minutes > 59:
        raise BagError(f"{where}: there is no time zone '{zone}'; mend it")
    return text, (hours * 60 + minutes) * 60 * 10**9 * (-1 if zone[0] == "-" else 1) - late


def _as_iso(where: str, cells: Sequence[str]) -> tuple[Sequence[str], str]:
    """Days such as 13/01/14 as ISO writes them, if one order of day and month alone has every day, or goes forward.

    Of two that do, the one by which the steps are even; where all rows are of one day, either gives the same steps.
    """
    found = [match for cell in cells if (match := _DAY.fullmatch(cell))]
    if not found or len(found) < (1 - ODD_SHARE) * sum(map(bool, cells)):
        return cells, ""
    orders = {}
    tried = [("day, month, year", 1, 2, 3), ("month, day, year", 2, 1, 3)]
    if len({m[3] for m in found}) > len({m[1] for m in found}):  # years that change more often than days are days
        tried = [("year, month, day", 3, 2, 1)]
    for order, day, month, year in tried:
        texts = [
            f"{m[year] if len(m[year]) == 4 else f'20{m[year]:0>2}'}-{int(m[month]):02}-{int(m[day]):02}"
            f"T{int(m[4] or 0):02}:{m[5] or '00'}:{m[6] or '00'}"
            for m in found
        ]
        if all(1 <= int(text[5:7]) <= 12 for text in texts):
            orders[order] = texts
    if len(orders) > 1:
        orders = {order: texts for order, texts in orders.items() if sorted(texts) in (texts, texts[::-1])}
    taken, note = list(orders), ""
    if len({tuple(texts) for texts in orders.values()}) == 2:
        even = [order for order, texts in orders.items() if _is_even(texts)]
        taken = even if len(even) == 1 else taken * (len({m.group(1, 2, 3) for m in found}) == 1)
        note = f"its dates are taken for {(taken or even or [''])[0]}"
    if not taken:
        which = f"'{found[0][0][:40]}' and the others do not say which is day and which is month"
        raise BagError(f"{where}: {which}; write times such as 2026-11-22T06:28:01.25Z")
    iso = iter(orders[taken[0]])
    return [next(iso) + (match[7] or "") if (match := _DAY.fullmatch(cell)) else cell for cell in cells], note


def _is_even(texts: Sequence[str]) -> bool:
    """Whether no step between these instants is much longer than the usual one."""
    try:
        plain, shifts = zip(*(_of_iso("", *match.groups()) for match in map(_ISO.match, texts) if match), strict=True)
        steps = np.diff(_parsed("", plain) - np.array(shifts))
    except (BagError, ValueError):
        return False
    return len(steps) > 1 and bool(steps.max() <= 2 * np.median(steps))
