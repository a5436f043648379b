# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Tables, numbers and names as a person reads them, and data as JSON holds it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Columns aligned with spaces; the first to the left, the others to the right."""
    lines = [list(header), *(list(row) for row in rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    return "\n".join(
        "  "
        + "  ".join(
            cell.ljust(width) if i == 0 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def number(value: float | None) -> str:
    """Four digits, or a dash for nothing."""
    return "-" if value is None or math.isnan(value) else f"{value:.4g}"


def beyond(utilisation: float) -> str:
    """A violated utilisation with as many digits as show that it is beyond -1 or 1."""
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
    """Replace numbers that JSON has no text for."""
    if isinstance(value, dict):
        return {key: finite_data(v) for key, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite_data(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
