"""HTML tables, as a notebook shows them in place of an object's text."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape

MOST = 12
"""Rows and columns of a matrix that are shown."""


def html_table(caption: str, header: Sequence[str], rows: Iterable[Sequence[str]], below: Sequence[str] = ()) -> str:
    """A plain table; every text is escaped. The first column stands to the left, the others to the right."""
    head = "".join(f"<th style='text-align:{_side(i)}'>{escape(cell)}</th>" for i, cell in enumerate(header))
    body = "".join(
        "<tr>" + "".join(f"<td style='text-align:{_side(i)}'>{escape(c)}</td>" for i, c in enumerate(row)) + "</tr>"
        for row in rows
    )
    notes = "".join(f"<div>{escape(text)}</div>" for text in below)
    return (
        f"<div><table><caption style='text-align:left'><b>{escape(caption)}</b></caption>"
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{notes}</div>"
    )


def _side(column: int) -> str:
    return "right" if column else "left"


def number_text(value: float | None) -> str:
    """Four digits; a dash where there is no finite number."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.4g}"


def name_with_unit(name: str, unit: str) -> str:
    """`name [unit]`, or the name alone where there is no unit."""
    return f"{name} [{unit}]" if unit else name
