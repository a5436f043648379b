# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What is said of the smallest faults that a model detects."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from uncertain_lti.base.english import plural
from uncertain_lti.reports.tables import number, table

COLUMNS = (
    ("sensor", ("bias", "drift", "scale", "noise")),
    ("sensor", ("spike", "freeze", "dropout", "sensor_delay")),
    ("actuator", ("offset", "loss", "stuck", "actuator_delay")),
    ("dynamics", ("time_constant", "gain")),
)
"""Kinds of faults that share a table."""
TITLES = {
    "bias": "off by",
    "drift": "drifts, per s",
    "scale": "scaled by",
    "noise": "noise",
    "spike": "one sample off by",
    "freeze": "frozen, s",
    "dropout": "reads 0, s",
    "sensor_delay": "late, s",
    "offset": "off by",
    "loss": "loses",
    "stuck": "stuck, s",
    "actuator_delay": "late, s",
    "time_constant": "time constant",
    "gain": "gain",
}
"""Heads of the columns."""
SHOWN = 6
"""Signals that the short form names."""


def detectable_data(validation: Mapping[str, Any]) -> dict[str, Any] | None:
    """The section on detectable faults of a model's validation, if it is one."""
    try:
        data = validation["detectable"]
        faults = [_typed(fault, _FAULT) for fault in data["faults"]]
        return {**_typed(data, _ABOUT), "faults": [f for f in faults if f["kind"] in TITLES]}
    except (KeyError, TypeError, ValueError, OverflowError):
        return None


def _real(value: Any) -> float | None:
    if value is None:
        return None
    if isinstance(value, str) or not math.isfinite(value):
        raise ValueError
    return float(value)


def _typed(data: Mapping[str, Any], types: Mapping[str, Any]) -> dict[str, Any]:
    """The entries of a model file, in which anything may be written, each by what makes it of its type."""
    return {key: kind(data[key]) for key, kind in types.items()} | {"refused": str(data.get("refused", ""))}


_ABOUT: Mapping[str, Any] = {"within": float, "share": float, "confidence": float, "cases": int, "left_out": int}
_FAULT: Mapping[str, Any] = {
    **dict.fromkeys(("kind", "of", "signal", "unit"), str), **dict.fromkeys(("size", "share", "delay"), _real),
    "size_interval": lambda ends: [_real(end) for end in ends], "largest": float,
    "share_interval": lambda ends: [float(end) for end in ends], "cases": int,
}  # fmt: skip


def size_text(fault: Mapping[str, Any], interval: bool = True) -> str:
    """The smallest detectable size of one fault."""
    if fault["refused"]:
        return "unknown"
    if fault["size"] is None:
        return f"not seen ({fault['share']:.0%} at {_size(fault, fault['largest'])})"
    text = _size(fault, fault["size"])
    if not interval:
        return text
    low, high = fault["size_interval"]
    return f"{text} ({_size(fault, low)} to {_size(fault, high)})"


def _size(fault: Mapping[str, Any], value: float | None) -> str:
    if value is None:
        return "more than tried"
    if fault["kind"] in ("scale", "loss", "time_constant", "gain"):
        return f"{100 * value:.3g}%"
    return f"{value:.3g}"


def detectable_tables(data: Mapping[str, Any]) -> list[tuple[tuple[str, ...], list[list[str]]]]:
    """Tables of the smallest detectable faults."""
    found = []
    for of, kinds in COLUMNS:
        faults = [f for f in data["faults"] if f["kind"] in kinds]
        there = [k for k in kinds if any(f["kind"] == k for f in faults)]
        if not there:
            continue
        rows = []
        for signal in dict.fromkeys(f["signal"] for f in faults):
            mine = {f["kind"]: f for f in faults if f["signal"] == signal}
            unit = next((f["unit"] for f in faults if f["signal"] == signal and f["kind"] in ("bias", "offset")), "")
            rows.append(
                [signal + f" [{unit}]" * bool(unit), *(size_text(mine[k]) if k in mine else "-" for k in there)]
            )
        found.append(((of, *(TITLES[k] for k in there)), rows))
    return found


def condition_text(data: Mapping[str, Any]) -> str:
    """What the sizes hold for."""
    out = data["left_out"]
    without = f"; {plural(out, 'case')} with an alarm without a fault left out" if out else ""
    return (
        f"smallest fault seen in {data['share']:.0%} of the cases within {number(data['within'])} s "
        f"({data['confidence']:.0%} interval; put into what was left out at {plural(data['cases'], 'instant')}"
        f"{without})"
    )


def detectable_text(data: Mapping[str, Any]) -> list[str]:
    """What `validate` prints of them."""
    if data["refused"]:
        return [f"which faults are seen is not known: {data['refused']}"]
    lines = [condition_text(data)]
    lines += [table(header, rows) for header, rows in detectable_tables(data)]
    lines += list(dict.fromkeys(f"unknown: {f['refused']}" for f in data["faults"] if f["refused"]))
    return lines


def detectable_words(data: Mapping[str, Any]) -> list[str]:
    """A short clause for each state and control, those of a first screen."""
    words = []
    for signal in dict.fromkeys(f["signal"] for f in data["faults"] if f["of"] != "dynamics"):
        parts = []
        for kind, what in (("bias", "off by"), ("drift", "drifts by"), ("offset", "off by"), ("loss", "loses")):
            fault = next((f for f in data["faults"] if (f["kind"], f["signal"]) == (kind, signal)), None)
            if fault is not None and not fault["refused"] and fault["size"] is not None:
                parts.append(f"{what} {size_text(fault, interval=False)} {fault['unit']}".rstrip())
            elif fault is not None and not fault["refused"]:
                parts.append(f"not even if it {what} {_size(fault, fault['largest'])} {fault['unit']}".rstrip())
        if parts:
            words.append(f"{signal}: {', '.join(parts)}")
    return words
