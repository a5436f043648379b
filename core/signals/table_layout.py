# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""TableLayout: which columns of a table are its time and the run that a row is of."""

from __future__ import annotations

import reprlib
from dataclasses import asdict, dataclass
from typing import Any, Literal

from uncertain_lti.base.english import meant
from uncertain_lti.base.errors import SignalError
from uncertain_lti.signals.file_values import checked_mapping

UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
"""Units of time that a column of numbers can have, with their nanoseconds."""

TimeUnit = Literal["s", "ms", "us", "ns"]


@dataclass(frozen=True, slots=True)
class TableLayout:
    """Which columns of a table (CSV, Parquet, .mat, .npz) say when and in which run a row was recorded.

    `time`: column of the time; None to look for one; `unit`: unit of a time column of numbers; None to take it from the
    column's name and size; `runs`: column whose values tell the recordings in one file apart; None where a file is one
    recording.
    """

    time: str | None = None
    unit: TimeUnit | None = None
    runs: str | None = None

    @classmethod
    def from_dict(cls, data: Any, where: str) -> TableLayout:
        """Build from the structure of a signals file or a model file."""
        given = checked_mapping(data, where, {"time", "unit", "runs"})
        for key in ("time", "runs"):
            value = given.get(key)
            if value is not None and (isinstance(value, bool) or not isinstance(value, (str, int, float)) or not value):
                raise SignalError(f"{where}: {key} is {reprlib.repr(value)}; write the name of a column, in quotes")
        unit = given.get("unit")
        if unit not in (None, *UNITS):  # which may be no text
            raise SignalError(
                f"{where}: unit is {reprlib.repr(unit)}{meant(str(unit), UNITS)}; write one of {', '.join(UNITS)}"
            )
        names = {key: None if given.get(key) is None else str(given[key]) for key in ("time", "runs")}
        return cls(names["time"], unit, names["runs"])

    def to_dict(self) -> dict[str, str]:
        """Return what `from_dict` takes, without what is left open."""
        return {key: value for key, value in asdict(self).items() if value is not None}
