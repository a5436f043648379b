# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Tables in text: CSV as many tools write it, to named columns of numbers, instants or text."""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Mask
from uncertain_lti.base.errors import BagError
from uncertain_lti.base.text import meant, once, plural, shortlist

_DELIMITERS = ",;\t|"
_LOOK = 1 << 20  # bytes in which the shape of a CSV file is looked for
_LOOK_LINES = 60
_HIGH = 10  # lines over which a cell in quotes may go above the rows
_MISSING = {"", "na", "n/a", "nan", "null", "none", "-", "--", "nil", "#n/a", "?"}
_TRUTH = dict.fromkeys("true yes on run running open wahr ja ein an auf vrai oui".split(), 1.0)
_TRUTH |= dict.fromkeys("false no off stop stopped closed falsch nein aus zu faux non".split(), 0.0)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$|[+-]?inf(inity)?$|nan$", re.IGNORECASE)
_WITH_COMMA = re.compile(r"[+-]?(\d+,\d*|,\d+)([eE][+-]?\d+)?$")
_GROUPED = re.compile(
    r"[+-]?[1-9]\d{0,2}(?P<by>[,. '’\u00a0\u202f])\d{3}(?:(?P=by)\d{3})*(?P<rest>(?!(?P=by))[.,]\d*)?$"
)
_INSTANT = re.compile(
    r"\d{4}[-/]\d\d?[-/]\d\d?([T ]|$)|\d{1,2}:\d\d(:\d\d|$|\s*[AaPp])|\d{1,2}[./]\d{1,2}[./]\d{2,4}|"
    r"\d{1,2}-(\d{1,2}|[A-Za-z]{3})-\d{2,4}|\d{8}[T_ ]\d{6}"
)
_WIDE = {  # by which of a text's first four bytes are not 0
    **dict.fromkeys((b"\1\1\0\0", b"\0\0\1\1"), "utf-32"), b"\1\0\0\0": "utf-32-le", b"\0\0\0\1": "utf-32-be",
    b"\1\0\1\0": "utf-16-le", b"\0\1\0\1": "utf-16-be",
}  # fmt: skip
_CUT_TIME = re.compile(r"(\d:\d\d:\d\d),(?=(\d{3}),)")  # as Python's log writes 13:24:48,075
_NO_TEXT = re.compile(r"[\0-\x08\x0e-\x1a\x1c-\x1f\ufffd]")
_BEFORE_LABEL = re.compile(r"\s(?=[^\W\d][^\s:=]*\s?[:=])")
_ARROW = re.compile(r"(\d\d:\d\d:\d\d\.\d{3}) -> (.*)", re.DOTALL)  # as the serial monitor of Arduino writes a line
QUANTITY = re.compile(r"[-+]?\d[\d.,]*\s*(?P<unit>[^\W\d_]\S{0,7}|[%°]\S{0,7})")
_BASE = (
    "[munpµμkcdhMG]?(?:m|g|s|A|K|V|W|N|J|Pa|Hz|T|bar|rad|Ω|Ohm|ohm|Ah|Wh|VA|var|l|L|mol|Nm|eV)|°[CFKA]*|deg[CFKA]*|[CFHt%‰]"
    "|%RH|rpm|rev|ppm|ppb|psi|ft|lbf?|mph|mi|knots|kt|gal|Torr|atm|U|min|h|d|1"
)
_FACTOR = rf"(?:{_BASE})[²³]?(?:(?:\^|\*\*)?-?\d)?"
_UNIT = re.compile(rf"(?!(?:min|U|d|1)$){_FACTOR}(?:[*·⋅./ ]{_FACTOR})*")
_IN_BRACKETS = re.compile(r"(?P<of>.*[^\s_])[\s_]*(?:\[(?P<a>[^\[\]]+)\]|\((?P<b>[^()]+)\)|\{(?P<c>[^{}]+)\})\s*")
_MOST_COLUMNS = 20_000
_ODD_CELL = re.compile(r"could not convert string .* at row (\d+), column (\d+)")  # of numpy.loadtxt
_MOST_PASSED = 10**6  # rows that may be passed over again for such cells
_ANNOTATIONS = "#group", "#datatype", "#default"  # of InfluxDB, above each table in a file
YEARS = (1678, 2261)  # that ns since 1970 can say
ROWS_EACH = 20  # that a unit has at least, and stretches of rows that a message has, of a short log fewer
ODD_SHARE = 0.1  # of lines with another number of cells, or cells that are no time, above which a file is no table

Column = NDArray[Any]
"""Numbers, (rows,) or (rows, parts); text or cells, (rows,) of object; or instants, (rows,) of datetime64[ns]."""


@dataclass
class RawTable:
    """What a file holds.

    `columns`: by the names in the file, in their order; `notes`: what was left out or changed, each a part of a
    sentence; `exact`: gives the text of the cells of a column of numbers by its name, where there is text; `units`:
    what a line below the names says of some columns.
    """

    columns: Mapping[str, Column]
    notes: list[str] = field(default_factory=list)
    exact: Callable[[str], Sequence[str]] | None = None
    units: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Shape:
    """How a CSV file is laid out: its delimiter, the lines before the data, and the names of its columns.

    `mend`: what each line goes through first, where a tool writes times in a way of its own.
    """

    delimiter: str
    skip: int
    names: tuple[str, ...]
    units: tuple[str, ...] = ()
    note: str = ""
    mend: Callable[[str], str] | None = None


def _behind_zeros(line: str) -> str:
    """A line without what a power cut left of the one before, and the zeros behind that."""
    return line.rpartition("\0")[2]


def read_csv(path: Path) -> RawTable:
    """Read CSV, in any encoding, with what stands above its rows."""
    with open(path, "rb") as stream:
        head = stream.read(_LOOK)
    encoding = _WIDE.get(bytes(map(bool, head[:4])), "utf-8-sig")
    if encoding == "utf-8-sig" and head[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        encoding = "utf-16"
    try:
        head[:-4].decode(encoding)
    except UnicodeDecodeError as error:
        if encoding == "utf-8-sig" and error.start < len(head) - 8:
            encoding = "cp1252"  # of Windows
    start = head.decode(encoding, errors="replace").rstrip("\0")
    if zeros := "\0" in start:
        start = "\n".join(map(_behind_zeros, re.split(r"\r\n|\r|\n", start)))
    if zeros and _NO_TEXT.search(start):
        raise BagError(f"{path}: holds bytes that are no text, so it is no CSV file; unpack it if it is compressed")
    whole, decimals = start.rpartition("\n")[0], [match[2] for match in _CUT_TIME.finditer(start)]
    cut_times = any(three.startswith("0") for three in decimals)  # which numbers do not
    cut_times = cut_times and len(_CUT_TIME.findall(whole)) == len(re.findall(r"\d:\d\d:\d\d", whole))
    lines = _names_on_one_line(re.split(r"\r\n|\r|\n", start)[:_LOOK_LINES])
    mend = _behind_zeros if zeros else _without_arrow if any(map(_ARROW.match, lines)) else None
    mend = partial(_CUT_TIME.sub, r"\1.") if cut_times else mend
    lines = list(map(mend, lines)) if mend else lines
    whole_lines = lines if len(head) < _LOOK else lines[:-1] or lines
    if not mend and (labels := _common_labels(whole_lines)):
        mend, shape = _without_labels, _Shape(",", 0, labels)
        lines = list(map(mend, lines))
    else:
        shape = _shape(path, whole_lines)
    shape = replace(shape, mend=mend)
    names, notes = unique(shape.names), [shape.note] * bool(shape.note)
    units = {name: unit for name, unit in zip(names, shape.units, strict=False) if unit}
    first = [_split(line, shape.delimiter) for line in lines[shape.skip :]]
    read = _read_at_once(path, encoding, shape, names, first) or _read_cells(path, encoding, shape, names)
    return replace(read, units=units, notes=notes + read.notes)


def _read_at_once(
    path: Path, encoding: str, shape: _Shape, names: Sequence[str], first: Sequence[Sequence[str]]
) -> RawTable | None:
    """Columns of numbers where all cells are some, others of cells; None where lines have to be looked at."""
    columns_of_first = zip(*(cells for cells in first if len(cells) == len(names)), strict=True)
    numbers = [all(map(_NUMBER.match, cells)) for cells in columns_of_first]
    columns: list[Column] = []
    apart, passed = shape.delimiter.strip(" ") or None, 0
    while any(numbers) and not columns and passed < _MOST_PASSED and not shape.mend:
        kinds = [(f"f{i}", "f8" if number else "O") for i, number in enumerate(numbers)]
        try:
            with open(path, encoding=encoding, errors="replace", newline="") as text:
                table = np.loadtxt(text, kinds, None, apart, skiprows=shape.skip, quotechar='"', ndmin=1)
            columns = [np.ascontiguousarray(table[name]) for name, _ in kinds]
        except (ValueError, OverflowError) as error:
            if not (odd := _ODD_CELL.search(str(error))):
                return None
            numbers[int(odd[2]) - 1], passed = False, passed + int(odd[1])
    wholes = ["".join(cells) if cells.dtype.kind == "O" else "" for cells in columns]
    if not columns or any(mark in whole for whole in wholes for mark in ',\n\r"'):
        return None  # 1.234 may be another number where commas part decimals; a quote may not be closed
    read = _columns(names, columns, wholes, shape.delimiter)
    return replace(read, exact=partial(_texts, path, encoding, shape, names))


def _names_on_one_line(lines: list[str]) -> list[str]:
    """The lines, those of a cell in quotes that goes on put on its first, with empty ones in their places."""
    for first, line in enumerate(lines):
        if line.count('"') % 2 and re.search(r'(^|[,;\t|])\s*"[^"]*$', line):
            odd = (i for i, other in enumerate(lines) if first < i < first + _HIGH and other.count('"') % 2)
            last = next(odd, first)
            lines[first : last + 1] = [" ".join(lines[first : last + 1]), *[""] * (last - first)]
    return lines


def _without_arrow(line: str) -> str:
    """A line with its time as the first cell, or with a name for it above the others' names."""
    if not (match := _ARROW.match(line)):
        return line
    delimiter = next((delimiter for delimiter in _DELIMITERS if delimiter in match[2]), " ")
    return f"{match[1] if any(map(_is_value, _split(match[2], delimiter))) else 'time'}{delimiter}{match[2]}"


def _labelled(line: str) -> dict[str, str]:
    """Cells by the labels before them, as in `temp: 21.5, rpm: 900`; nothing where one has none."""
    line = line.strip(" \t\r\n,;")
    parts, cells = re.split(r"[,;\t]", line), {}
    for part in parts if len(parts) > 1 else _BEFORE_LABEL.split(line):
        label, mark, value = part.partition(":" if ":" in part else "=")
        if not (mark and label.lstrip()[:1].isalpha()):
            return {}
        cells[label.strip()] = value.strip()
    return cells


def _common_labels(lines: Sequence[str]) -> tuple[str, ...]:
    """The labels of nearly every line, as of what a controller prints; nothing where there are none."""
    labels = Counter(tuple(_labelled(line)) for line in lines if line.strip())
    usual, often = max(labels.items(), key=lambda item: item[1], default=((), 0))
    return usual if len(usual) > 1 and often >= max(3, (1 - ODD_SHARE) * labels.total()) else ()


def _without_labels(line: str) -> str:
    return ",".join(_labelled(line).values()) or line


def _texts(path: Path, encoding: str, shape: _Shape, names: Sequence[str], name: str) -> Sequence[str]:
    """The cells of one column as they stand, read when they are asked for."""
    where = names.index(name)
    return [cells[where].strip() for _, cells in _rows(path, encoding, shape) if len(cells) > where]


def _rows(path: Path, encoding: str, shape: _Shape) -> Iterator[tuple[int, list[str]]]:
    """Number of the line, and cells; empty lines are passed over."""
    with open(path, encoding=encoding, errors="replace", newline="") as text:
        for _ in range(shape.skip):
            text.readline()
        lines = map(shape.mend, text) if shape.mend else text
        reader = csv.reader(lines, delimiter=shape.delimiter, skipinitialspace=True)
        before = 0
        try:
            for cells in reader:
                if reader.line_num > before + 1:
                    line = shape.skip + before + 1
                    raise BagError(f"{path}: line {line} opens a quote that is not closed in it; mend it")
                before = reader.line_num
                if cells and any(cells):
                    yield shape.skip + reader.line_num, cells
        except csv.Error as error:
            raise BagError(f"{path}: line {shape.skip + reader.line_num} cannot be read ({error}); mend it") from None


def _read_cells(path: Path, encoding: str, shape: _Shape, names: Sequence[str]) -> RawTable:
    """Cell by cell: text, instants, missing numbers, decimal commas, lines with too few cells."""
    columns: list[list[str]] = [[] for _ in names]
    wide, header = len(names), [name.strip() for name in shape.names]
    known = {*header} - {""}
    first_odd = odd = line = again = 0
    for line, cells in _rows(path, encoding, shape):
        if cells[0] in _ANNOTATIONS:
            continue
        if known.intersection(map(str.strip, cells[:2])):
            plain = [cell.strip().lstrip("\ufeff") for cell in cells]  # of a file that was put behind another
            if 2 * len(known.intersection(plain)) > wide or (all(plain) and not any(map(_is_value, plain))):
                if any(a != b and not _is_value(a) for a, b in zip(plain, header, strict=False)):
                    rest = "write the rows from there on to a file of their own"
                    raise BagError(f"{path}: line {line} names other columns, or in another order; {rest}")
                again += 1
                continue
        if len(cells) != wide and not (len(cells) == wide + 1 and not cells[-1].strip()):
            odd += 1
            first_odd = first_odd or line
            continue
        for column, cell in zip(columns, cells, strict=False):
            column.append(cell)
    rows = len(columns[0])
    if odd > max(1, ODD_SHARE * (odd + rows)) or (odd and not rows):
        others = f"{plural(odd, 'line')} with another number of cells than the {wide} of its header"
        raise BagError(f"{path}: {others}, the first is line {first_odd}; mend the file, or its header")
    if not rows:
        raise BagError(f"{path}: has a header and no line of data; record or copy it again")
    notes = [f"{plural(again, 'line')} left out that repeat{'s' * (again == 1)} the names of the columns"] * bool(again)
    if odd:
        cut = " (the file ends in it)" if odd == 1 and first_odd == line else ""
        notes.append(f"{plural(odd, 'line')} with another number of cells left out, the first is line {first_odd}{cut}")
    read = _columns(names, [np.array(c, dtype=object) for c in columns], [*map("".join, columns)], shape.delimiter)
    texts = dict(zip(names, columns, strict=True))
    return replace(read, notes=notes + read.notes, exact=lambda name: [cell.strip() for cell in texts[name]])


def _columns(names: Sequence[str], columns: Sequence[Column], wholes: Sequence[str], delimiter: str) -> RawTable:
    """Columns of cells by what all of them tell, and what was done; those of numbers as they are."""
    found: dict[str, Column] = {}
    noted, odd = dict[str, list[str]](), dict[str, list[str]]()
    texts = [cells for cells, whole in zip(columns, wholes, strict=True) if "," in whole]
    point = ""  # what parts decimals, if a cell tells
    for cell in (cell.strip() for cells in texts for cell in cells if "," in cell):
        if _WITH_COMMA.match(cell) and not _GROUPED.match(cell):  # in front of decimals for certain
            point = ","
            break
        if (match := _GROUPED.match(cell)) and match["by"] == "," and _tells(match):
            point = "."
    for name, cells, whole in zip(names, columns, wholes, strict=True):
        if cells.dtype.kind != "O":
            found[name] = cells
            continue
        if name.startswith("column ") and not whole.strip():
            continue  # a delimiter at the end of each line
        # 1.234 is one number to all, and another here; `1_0` is 10 to Python alone
        if "_" not in whole and not (point == "," and any(_GROUPED.match(cell.strip()) for cell in cells)):
            with suppress(ValueError):
                found[name] = np.where(cells == "", "nan", cells).astype(np.float64)
                continue
        found[name], done, left = _column(cells.tolist(), point, delimiter)
        for note in done:
            noted.setdefault(note, []).append(name)
        odd |= {name: left} if left else {}
    if odd:
        noted[left_out(sum(map(len, odd.values())), "number", next(iter(odd.values()))[0])] = [*odd]
    words = ((note, shortlist([repr(name) for name in of], 6), "s" * (len(of) > 1)) for note, of in noted.items())
    return RawTable(found, [f"column{several} {of}: {note}" for note, of, several in words])


def _column(cells: list[str], point: str, delimiter: str) -> tuple[Column, list[str], list[str]]:
    """Numbers where most cells are some, else text; what was done; cells left out. `point`: what parts decimals."""
    plain = [cell.strip().replace("\u2212", "-") for cell in cells]  # the minus of some languages
    numbers = np.full(len(plain), np.nan)
    if by := _thousands(plain, point):
        plain = [cell.replace(by, "") if (m := _GROUPED.match(cell)) and m["by"] == by else cell for cell in plain]
    decimal = point == "," or not (point or delimiter == ",")  # in quotes between commas they may part thousands
    comma, missing, truths, odd = 0, 0, 0, list[str]()
    for i, cell in enumerate(plain):
        low = cell.lower()
        if low in _MISSING:
            missing += 1
        elif _NUMBER.match(cell):
            numbers[i] = float(cell)
        elif decimal and _WITH_COMMA.match(cell):
            numbers[i] = float(cell.replace(",", "."))
            comma += 1
        elif low in _TRUTH:
            numbers[i] = _TRUTH[low]
            truths += 1
        elif not odd and _INSTANT.match(cell):
            return np.array(plain, dtype=object), [], []
        else:
            odd.append(cell)
    if len(odd) > (ODD_SHARE if truths else 0.5) * (len(plain) - missing):
        unit = match["unit"] if (match := QUANTITY.fullmatch(odd[0])) else ""
        written = (QUANTITY.fullmatch(cell) for cell in plain if cell.lower() not in _MISSING)
        if not unit or len({*plain}) < 2 or not all(match and match["unit"] == unit for match in written):
            return np.array(plain, dtype=object), [], []
        numbers, done, odd = _column([cell.removesuffix(unit) for cell in plain], point, delimiter)
        return numbers, [*done, f"'{unit}' taken off each number"], odd
    read = [f"'{by}' between thousands taken out"] * bool(by) + ["decimal commas read as points"] * bool(comma)
    return numbers, [" and ".join(read)] * bool(read), odd


def _tells(grouped: re.Match[str]) -> bool:
    """Whether what is between its digits parts thousands for certain."""
    return bool(grouped["rest"]) or grouped[0].count(grouped["by"]) > 1


def _thousands(cells: Sequence[str], point: str) -> str:
    """What parts thousands in a column, if cells tell (`1,234.5`, `1 234`, `1.234.567`) and none denies; else ""."""
    grouped = [m for m in map(_GROUPED.match, cells) if m]
    alone = [cell for cell in cells if _is_value(cell) and not _GROUPED.match(cell)] if grouped else []
    other = {by for by, decimal in (",.", ".,") if any(decimal in cell for cell in alone)}  # no decimals are behind it
    other |= {","} if point == "." else {"."} if point and alone else set()  # or they have three decimals each
    marks = [(m["by"], _tells(m)) for m in grouped]
    found = {by for by, telling in marks if telling or by not in ",." or by in other}
    by = found.pop() if len(found) == 1 else ""
    return by if by and all(by not in cell or _GROUPED.match(cell) for cell in cells) else ""


def left_out(odd: int, what: str, first: str) -> str:
    """How many cells are no number, or no time, and the first of them."""
    return f"{plural(odd, 'cell')} that {'is' if odd == 1 else 'are'} no {what} (such as '{first[:40]}') left out"


def unique(names: Iterable[str]) -> list[str]:
    """Names of columns as they are called, each once."""
    return once([" ".join(n.replace("\ufffd", "").split()) or f"column {i}" for i, n in enumerate(names, start=1)], " ")


def field_name(column: str) -> str:
    """Name of a column as a field path takes it: `Speed [rpm]` is `Speed_rpm`."""
    name = re.sub(r"\W+", "_", column).strip("_") or "column"
    return name if re.match(r"[A-Za-z_]", name) else f"c_{name}"


def units_of(names: Sequence[str], stated: Mapping[str, str]) -> dict[str, str]:
    """Units of columns by name, of `Speed [rpm]` or below it; none where brackets tell columns of one name apart."""
    parts = {name: found for name in names if (found := _IN_BRACKETS.fullmatch(name))}
    alike = Counter(match["of"] for match in parts.values())
    alike.update(names)
    units = {n: m["a"] or m["b"] or m["c"] for n, m in parts.items() if alike[m["of"]] == 1}
    units |= {name: unit.strip("[](){} ") for name, unit in stated.items() if name in names}
    return {name: bare for name, unit in units.items() if _UNIT.fullmatch(bare := unit.strip())}


QUALITY = re.compile(r"(?i)(?P<of>(.*[\W_])?)(q|qc|qual|quality)\d*")
"""Name of a column that says what OPC thinks of the number beside it."""
_QUALITIES = (0, 4, 8, 12, 16, 20, 24, 28, 64, 68, 80, 84, 88, 192, 216)  # bad, uncertain, from _GOOD on good
_GOOD = 192


def rated(column: Column) -> tuple[Mask, Mask]:
    """Cells of a column of qualities, as OPC has them, that are good, and those that are not; none where it is none."""
    if column.dtype.kind == "O":
        words = np.array([str(cell).strip().casefold()[:4] for cell in column])
        good, bad = words == "good", ~np.isin(words, ["good", ""])
    else:
        there = np.isfinite(column) & bool(np.isin(column[np.isfinite(column)], _QUALITIES).all())
        good, bad = there & (column >= _GOOD), there & (column < _GOOD)
    return good, bad & good.any()


def without_bad(columns: Mapping[str, Column], value: str = "") -> tuple[dict[str, Column], list[str]]:
    """Columns without the numbers that the quality beside them does not call good, and how many there are.

    `value`: the column that any quality is of; default that of its name (`Level` or `Level_Value` of `Level_Q`).
    """
    found: dict[str, Column] = {}
    notes = []
    numbers = {name: c for name, c in columns.items() if c.dtype.kind in "iuf" and c.ndim == 1}
    qualities = {name: named["of"] for name, c in columns.items() if c.ndim == 1 and (named := QUALITY.fullmatch(name))}
    for quality, of in qualities.items():
        its_own = re.compile(rf"(?i){re.escape(of[:-1])}([\W_]value)?")
        kin = [value] if value else [name for name in numbers if of and its_own.fullmatch(name)]
        if columns[quality].dtype.kind in "Oiuf" and kin:
            good, bad = rated(columns[quality])
            if good.sum() > bad.sum() > 0:
                found |= {name: np.where(bad, np.nan, found.get(name, numbers[name])) for name in kin}
                notes.append(f"{plural(int(bad.sum()), 'number')} of '{kin[0]}' left out, not good by '{quality}'")
    return found, notes


def find_column(path: object, wanted: str, columns: Sequence[str], what: str) -> str:
    """Find a column by its name in the file or as a field."""
    for name in columns:
        if wanted in (name, field_name(name)):
            return name
    near, there = meant(wanted, columns), shortlist(list(columns), 50)
    none = f"there is no column '{wanted}', which the signals file names for {what}{near}"
    raise BagError(f"{path}: {none}; columns there: {there}")


def _shape(path: Path, lines: Sequence[str]) -> _Shape:
    delimiter, wide, first = _delimited(path, lines)
    split = [_split(line, delimiter) for line in lines]
    begin = _below_names(split, wide, first)
    if wide > _MOST_COLUMNS:
        raise BagError(f"{path}: has {wide} columns, more than {_MOST_COLUMNS}; write those that are needed")
    in_spaces = [line.split() for line in lines[begin:] if delimiter == " " and line.strip()]
    if any(len(c) != wide or not all(_is_value(v) or v.lower() in _MISSING for v in c) for c in in_spaces):
        raise BagError(
            f"{path}: its cells are apart by spaces, and not all are numbers, or as many in each line; write commas, "
            "semicolons or tabs between them, or record a bag in place of what `ros2 topic echo` prints"
        )
    above = [cells for cells in split[first:begin] if not any(map(_is_value, cells))]
    plain = [cells for line, cells in zip(lines[:first], split, strict=False) if not line.startswith(("#", "%"))]
    if not any(len(cells) == wide and not any(map(_is_value, cells)) for cells in [*plain, *above]):
        plain = [_split(line.lstrip("#% "), delimiter) for line in lines[:first]]
    above = plain + above
    above = [cells[:-1] if len(cells) == wide + 1 and not cells[-1] else cells for cells in above]
    rows = [cells for cells in split[begin:] if len(cells) == wide]
    named = any(len(cells) == wide and 2 * len(set(cells) - {""}) > wide for cells in above)
    if not named:  # delimiters at the end of the rows, and none of the names
        used = max((place for cells in rows for place, cell in enumerate(cells, 1) if cell), default=wide)
        above = [[*cells, *[""] * (wide - len(cells))] if used <= len(cells) < wide else cells for cells in above]
        above = [filled if len(filled := [c for c in cells if c]) == wide else cells for cells in above]
    last = next((cells for cells in reversed(above) if len(cells) > 1 and not any(map(_is_value, cells))), [])
    above = [cells for cells in above if len(cells) == wide]
    kinds = [len(set(cells) - {""}) for cells in above]
    prose = delimiter == " " and len(last) != wide  # above a header that does not fit
    lines_of_names = [i for i, kind in enumerate(kinds) if kind > 1 and not prose]
    if not lines_of_names:
        if stated := next(filter(None, (_stated(line, wide) for line in reversed(lines[:first]))), ()):
            return _Shape(delimiter, begin, stated, ())
        unlike = f"its header names {len(last)} columns and its rows have {wide} cells"
        unlike = f"{unlike}, so no column has a name; mend it" * bool(last)
        return _Shape(delimiter, begin, tuple(f"column {i + 1}" for i in range(wide)), (), unlike)
    # above the names there may be groups of them
    many = [i for i in lines_of_names if 2 * kinds[i] > wide] or lines_of_names[:1]
    chosen = next((i for i in many if any(map(_TIME.match, above[i]))), many[0])  # of as many words may be a title
    return _Shape(delimiter, begin, tuple(above[chosen]), tuple(*above[chosen + 1 : chosen + 2]))


def _delimited(path: Path, lines: Sequence[str]) -> tuple[str, int, int]:
    """The delimiter with which most lines have as many values as each other, how many, and the first line of data."""
    if all(re.fullmatch(r'\s*("[^"]*[,;\t][^"]*"\s*)?', line) for line in lines) and any(map(str.strip, lines)):
        raise BagError(f"{path}: each line is in quotes as a whole, and so one cell; take them off the lines' two ends")
    best: tuple[float, int, int, str] | None = None  # how well it fits, cells, - first line, delimiter
    for delimiter in (*_DELIMITERS, " "):
        if delimiter == " " and best:
            break  # within cells
        split = [_split(line, delimiter) for line in lines]
        fits: dict[int, float] = {}  # lines of each number of cells, as far as they hold values
        for cells in split:
            if len(cells) > 1 and any(map(_is_value, cells)):
                share = sum(_is_value(c) or c.lower() in _MISSING for c in cells) / len(cells)
                fits[len(cells)] = fits.get(len(cells), 0.0) + share
        for wide, fit in fits.items():
            begin = next(i for i, c in enumerate(split) if len(c) == wide and any(map(_is_value, c)))
            candidate = (fit, wide, -begin, delimiter)
            best = max(best, candidate) if best else candidate
    if best is None:
        alone = any(_is_value(line.strip()) for line in lines)
        kind = "one column only" if alone else "no line of numbers"
        remedy = "put the columns of a recording side by side in one file" if alone else "check the file"
        raise BagError(f"{path}: there is {kind} in it, and a table has a column of time and others; {remedy}")
    _, wide, begin, delimiter = best
    return delimiter, wide, -begin


_TIME = re.compile(r"(?i)(t|time|date|zeit|tiempo|temps)\b")
_OF_COLUMNS = re.compile(r"(?i)\b([ck]olu?m?n|colonne|spalte|campo|fields?\b|channels?\b|signals?\b|header|format)")


def _stated(line: str, wide: int) -> tuple[str, ...]:
    """Names that a comment states after a colon, as `# Columns: t y u` does, if there are as many as columns."""
    before, _, after = line.lstrip("#%; ").partition(":")
    names = re.split(r"\s*[,;|\t]\s*" if re.search(r"[,;|\t]", after) else r"\s+", after.strip())
    plain = len(set(names)) == wide and not any(map(_is_value, names))
    return tuple(names) if plain and line.startswith(("#", "%")) and _OF_COLUMNS.search(before) and all(names) else ()


_FEW = 10  # lines with a number or an instant that may come above the names


def _below_names(split: Sequence[list[str]], wide: int, begin: int) -> int:
    """The first line of data, below the names where what a tool says of the recording comes above them."""
    whole = [(i, cells, any(map(_is_value, cells))) for i, cells in enumerate(split) if len(cells) == wide]
    names = next((i for i, cells, valued in whole if not valued and 2 * len({*cells} - {""}) > wide), 0)
    if not begin < names < begin + _FEW:
        return begin
    return next((i for i, _, valued in whole if i > names and valued), begin)


def _split(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return line.split()
    try:
        cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error:  # a cell that is too long, which `_rows` refuses
        cells = line.split(delimiter)
    return [cell.strip() for cell in cells]


def _is_value(text: str) -> bool:
    """Whether a cell is a number or an instant, as names and units are not."""
    forms = _NUMBER, _WITH_COMMA, _GROUPED, _INSTANT
    return any(form.match(text) for form in forms) and text.lower() != "nan"
