# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What `tune` prints."""

from __future__ import annotations

from typing import Any

from uncertain_lti.reports.tables import number, table


def tune_text(data: dict[str, Any]) -> str:
    """Every way that was tried, and what was chosen, for a person."""
    rows = [
        [
            trial["way"],
            number(trial["size"]),
            "-" if trial["width_over_range"] is None else f"{trial['width_over_range']:.2%}",
            "-" if trial["limit_per_hour"] is None else number(trial["limit_per_hour"]),
        ]
        for trial in data["trials"]
        if "refused" not in trial
    ]
    header = ("way", "jumps seen, over those of fit", "width/range", "false alarms per hour at most")
    refused = [f"  {t['way']}: {t['refused']}" for t in data["trials"] if "refused" in t]
    return "\n".join([table(header, rows), *refused, f"chosen: {data['reason']}"])
