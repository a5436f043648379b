# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Text for people: counted things, numbers and names in sentences; lines and tables of texts, pages and notebooks."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

LONGEST = 2000
"""Letters of a sentence as it is shown."""
_NAMED = 6  # names in a sentence


def printable(text: str, limit: int = LONGEST) -> str:
    r"""A text that came from outside, for a terminal: one line, no control characters, not too long."""
    text = _shortened(text, limit)
    if text.isprintable():
        return text
    return _shortened("".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text), limit)


def _shortened(text: str, limit: int) -> str:
    tail = limit // 3
    return text if len(text) <= limit else f"{text[: limit - tail - 5]} ... {text[-tail:]}"


def plural(count: object, word: str) -> str:
    """A count and its noun: 1 state, 2 states, 0 states; 1 entry, 2 entries; 1 day, 2 days."""
    if count == 1:
        return f"{count} {word}"
    return f"{count} {word[:-1]}ies" if word[-1] == "y" and word[-2] not in "aeiou" else f"{count} {word}s"


def times(count: int) -> str:
    """Once, or how many times."""
    return "once" if count == 1 else f"{count} times"


def shortlist(names: Sequence[str], limit: int = 12) -> str:
    """The first names, and how many more there are."""
    return ", ".join(names[:limit]) + (f" and {len(names) - limit} more" if len(names) > limit else "")


def once(names: Iterable[str], between: str) -> list[str]:
    """Names of which none is there twice; the second gets a number."""
    found: dict[str, None] = {}
    repeats: dict[str, int] = {}
    for name in names:
        chosen = name
        while chosen in found:
            repeats[name] = repeats.get(name, 1) + 1
            chosen = f"{name}{between}{repeats[name]}"
        found[chosen] = None
    return list(found)


def meant(word: object, known: Iterable[str], most: int = 3) -> str:
    """(is X meant?), with the known names that are near to a word, or nothing."""
    names = {name.lower(): name for name in sorted(known)}
    near = difflib.get_close_matches(str(word).lower(), names, n=most, cutoff=0.65 if most == 1 else 0.7)
    return f" (is {' or '.join(names[n] for n in near)} meant?)" if near else ""


MOST = 12
"""Rows and columns of a matrix that are shown."""


def html_table(caption: str, header: Sequence[str], rows: Iterable[Sequence[str]], below: Sequence[str] = ()) -> str:
    """A plain table, which scrolls where it is wide; every text is escaped.

    The first column is aligned to the left, the others to the right.
    """
    head = "".join(f"<th style='{_style(i)}'>{escape(cell)}</th>" for i, cell in enumerate(header))
    lines = ("".join(f"<td style='{_style(i)}'>{escape(cell)}</td>" for i, cell in enumerate(row)) for row in rows)
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    notes = "".join(f"<div>{escape(text)}</div>" for text in below)
    return (
        f"<div><div style='overflow-x:auto'><table><caption style='text-align:left'><b>{escape(caption)}</b></caption>"
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>{notes}</div>"
    )


def _style(column: int) -> str:
    return f"text-align:{'right' if column else 'left'};white-space:nowrap"


@dataclass(frozen=True)
class Table:
    """Cells as text; columns but the first and those in `left` stand to the right; `most` rows are shown."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    left: Sequence[int] = ()
    most: int = 40

    def __str__(self) -> str:
        lines = [self.header, *self.rows[: self.most]]
        sides = [str.ljust if i == 0 or i in self.left else str.rjust for i in range(len(self.header))]
        each = zip(sides, zip(*lines, strict=True), strict=True)
        columns = [[side(cell, max(map(len, cells))) for cell in cells] for side, cells in each]
        text = ["  " + "  ".join(cells).rstrip() for cells in zip(*columns, strict=True)]
        more = len(self.rows) - self.most
        return "\n".join(text + [f"  and {plural(more, 'more row')}; --json has all"] * (more > 0))


Block = str | Table
"""A line, or a table."""


def text_of(blocks: Iterable[Block]) -> str:
    """Blocks as text for a terminal."""
    return "\n".join(map(str, blocks))


def number(value: float | None) -> str:
    """Four digits, or a dash for nothing."""
    return "-" if value is None or math.isnan(value) else f"{value:.4g}"


def lasting(hours: float) -> str:
    """A time in the unit that one would say it in."""
    seconds = 3600.0 * hours
    for most, each, unit in ((120.0, 1.0, "s"), (7200.0, 60.0, "min"), (172_800.0, 3600.0, "h")):
        if seconds < most:
            return f"{seconds / each:.3g} {unit}"
    return f"{hours / 24:.3g} days"


def moment(t: float) -> str:
    """A time in a recording, s, written out to a tenth of a millisecond, so that it can be found again."""
    return f"{round(float(t), 4):.10g}"


def apart(values: Sequence[float]) -> list[str]:
    """Numbers with as many digits, four at least, as tell those apart that differ."""
    texts: list[str] = []
    for digits in range(4, 18):
        texts = [f"{value:.{digits}g}" for value in values]
        if len(set(texts)) == len(set(values)):
            break
    return texts


def share(value: float | None, digits: int = 3) -> str:
    """A share in percent, or a dash for nothing."""
    return "-" if value is None else f"{value:.{digits}%}"


def named(name: str, unit: str) -> str:
    """A name and its unit."""
    return f"{name} [{unit}]" if unit else name


def beyond(utilisation: float | None) -> str:
    """A violated utilisation with as many digits as show that it is beyond -1 or 1; None: the bounds have no width."""
    if utilisation is None:
        return "no width"
    for digits in range(3, 10):
        text = f"{utilisation:.{digits}g}"
        if abs(float(text)) > 1.0:
            return text
    return f"just beyond {math.copysign(1.0, utilisation):.0f}"


def shortened(name: str, longest: int = 40) -> str:
    """A name for a sentence, with its middle left out where it is long."""
    return name if len(name) <= longest else f"{name[: longest // 2]}…{name[len(name) - longest // 2 + 1 :]}"


def numbers_of(value: Any, count: int) -> list[float] | None:
    """Read numbers from a model file, in which anything may be written."""
    if hasattr(value, "tolist"):  # of a model that was not written yet
        value = value.tolist()
    good = isinstance(value, (list, tuple)) and len(value) == count and all(isinstance(v, (int, float)) for v in value)
    return [float(v) for v in value] if good else None


def list_of(value: Any) -> list[Any]:
    """Read a list from a model file, in which anything may be written."""
    return list(value) if isinstance(value, (list, tuple)) else []


def finite_data(value: Any) -> Any:
    """What JSON has a text for: numpy's as Python's, and None for a number that is not finite."""
    if isinstance(value, Mapping):
        return {str(key): finite_data(v) for key, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite_data(v) for v in value]
    if hasattr(value, "tolist"):
        return finite_data(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def quoted(names: Sequence[str]) -> str:
    """'a', 'b' and 'c'; of many names the first ones, and how many others there are."""
    marked = [n if n.startswith("the ") else f"'{n}'" for n in names]
    if len(marked) > _NAMED + 1:
        return f"{', '.join(marked[:_NAMED])} and {len(marked) - _NAMED} others"
    return marked[0] if len(marked) == 1 else ", ".join(marked[:-1]) + " and " + marked[-1]
