# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What `signature` prints."""

from __future__ import annotations

from uncertain_lti.base.english import plural
from uncertain_lti.reports.tables import table
from uncertain_lti.validation.signatures import Learnt


def signature_text(learnt: Learnt) -> str:
    """Summary for a person."""
    rows = [[s.label, str(s.recordings), str(s.verdicts), ", ".join(map(str, s.steps))] for s in learnt.signatures]
    lines = [table(("signature", "recordings", "verdicts", "steps"), rows)]
    labels = [label for _, label, _ in learnt.named]
    tried = [(label, found) for _, label, found in learnt.named if labels.count(label) > 1]
    if tried:
        right = sum(label == found for label, found in tried)
        unknown = sum(not found for _, found in tried)
        lines.append(
            f"left out in turn, {right} of {plural(len(tried), 'recording')} named as labelled, "
            f"{len(tried) - right - unknown} as another fault, {unknown} unknown"
        )
    lines += [f"'{a}' and '{b}' look alike (match {match:.2f}), so neither is named" for a, b, match in learnt.alike]
    return "\n".join(lines)
