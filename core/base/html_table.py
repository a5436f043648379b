# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""HTML tables, as a notebook shows them in place of an object's text."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape

MOST = 12
"""Rows and columns of a matrix that are shown."""


def html_table(caption: str, header: Sequence[str], rows: Iterable[Sequence[str]], below: Sequence[str] = ()) -> str:
    """A plain table, which scrolls where it is wide; every text is escaped.

    The first column is aligned to the left, the others to the right.
    """
    head = "".join(f"<th style='{_style(i)}'>{escape(cell)}</th>" for i, cell in enumerate(header))
    body = "".join(
        "<tr>" + "".join(f"<td style='{_style(i)}'>{escape(c)}</td>" for i, c in enumerate(row)) + "</tr>"
        for row in rows
    )
    notes = "".join(f"<div>{escape(text)}</div>" for text in below)
    return (
        f"<div><div style='overflow-x:auto'><table><caption style='text-align:left'><b>{escape(caption)}</b></caption>"
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>{notes}</div>"
    )


def _style(column: int) -> str:
    return f"text-align:{'right' if column else 'left'};white-space:nowrap"


def number_text(value: float | None) -> str:
    """Four digits; a dash where there is no finite number."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.4g}"
