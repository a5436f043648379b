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

from collections.abc import Mapping
from typing import Any

from uncertain_lti.base.english import plural
from uncertain_lti.reports.tables import number, table

_NAMED = 3  # ways that the budget left out; the model file has all


def tune_text(data: Mapping[str, Any]) -> str:
    """Summary of `Tuned.to_dict()` for a person."""
    trials = data["trials"]
    judged = sorted(
        (t for t in trials if "refused" not in t), key=lambda t: t["size"] if t["size"] is not None else 1.0
    )
    labels = list(dict.fromkeys(label for t in judged for label in t["seen"]))
    chosen = trials[data["chosen"]]
    rows = [
        [
            ("> " if t is chosen else "") + t["fit"],
            t["alarm"],
            "-" if t["size"] is None else f"x {t['size']:.3g}",
            str(t["alarms"]),
            "unknown" if t["upper_per_hour"] is None else number(t["upper_per_hour"]),
            f"{t['inside']:.2%}",
            *("/".join(map(str, t["seen"][label])) for label in labels),
        ]
        for t in judged
    ]
    header = ("fit", "alarm", "smallest fault", "false alarms", "at most per hour", "inside", *labels)
    lines = [table(header, rows)]
    refused = [t for t in trials if "refused" in t]
    lines += [f"not judged: {t['fit']}: {t['refused']}" for t in refused]
    if data["not_tried"]:
        ways = data["not_tried"]
        more = f"; and {len(ways) - _NAMED} more" if len(ways) > _NAMED else ""
        lines.append(f"the budget left no time for {plural(len(ways), 'way')}: {'; '.join(ways[:_NAMED])}{more}")
    lines.append(f"chosen: {chosen['fit']}; alarm {chosen['alarm']}")
    lines.append(f"because {data['reason']}")
    lines += [f"record next: {text}" for text in data["record"]]
    return "\n".join(lines)
