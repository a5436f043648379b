# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What `report` prints of the findings."""

from __future__ import annotations

from typing import Any

from uncertain_lti.reports.reliance import WEIGHTS


def findings_text(facts: dict[str, Any]) -> str:
    """The answers of `findings.findings`, with the reasons, for a person."""
    lines = [f"may I rely on it? {facts['rely']['answer']}"]
    reasons = sorted(facts["rely"]["reasons"], key=lambda r: WEIGHTS.index(r["weight"]))
    lines += [f"  {r['weight']}: {r['text']}" for r in reasons]
    lines.append("what happened?")
    lines += [f"  {h['recording']}: {h['text']}" for h in facts["happened"]]
    return "\n".join(lines)
