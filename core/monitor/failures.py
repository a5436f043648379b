# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Failures: unexpected errors that a node counts, logs and survives."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable

_LOGGED = 5.0  # s between two log entries on unexpected errors


class Failures:
    """Unexpected errors: their number, and the last one.

    `log`: takes an entry for the log; `count`: errors so far.
    """

    def __init__(self, log: Callable[[str], None]) -> None:
        self._log = log
        self.count, self._last, self._reported = 0, "", 0
        self._logged: dict[str, float] = {}  # where: when

    def note(self, where: str, error: Exception) -> None:
        """Count an error, and log it unless one from the same place was logged just before."""
        self.count += 1
        self._last = f"{where}: {error!r}"[:300]
        now = time.monotonic()
        if now - self._logged.get(where, -_LOGGED) >= _LOGGED:
            self._logged[where] = now
            trace = "".join(traceback.format_exception(error))
            self._log(f"unexpected error {self.count}, {where}; the node goes on\n{trace}")

    def problems(self) -> list[str]:
        """What went wrong since the last report."""
        if self.count > self._reported:
            return [f"{self.count} unexpected errors, the last {self._last}"]
        return []

    def reported(self) -> None:
        """The errors so far are in a report."""
        self._reported = self.count
