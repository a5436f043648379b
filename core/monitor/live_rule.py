# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Rule: the alarm rule of a live session, as the node's parameters give it."""

from __future__ import annotations

from dataclasses import dataclass

from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.envelope_monitor import EnvelopeMonitor


@dataclass(frozen=True)
class Rule:
    """Alarm rule as the parameters give it; 0 means that of the model.

    `violations`: m of the rule; `window`: n of the rule, in verdicts; `margin`: multiplies the half-widths; `masked`:
    states that do not count, separated by commas; `enable`: see `Condition`; empty for none; `enable_type`: message
    type of its topic; empty for that of the model or of the graph; `grace`: time of grace, s; `latch`: whether an alarm
    lasts until it is reset.
    """

    violations: int = 0
    window: int = 0
    margin: float = 0.0
    masked: str = ""
    enable: str = ""
    enable_type: str = ""
    grace: float = 0.0
    latch: bool = False

    def monitor(self, model: UncertainLTI) -> EnvelopeMonitor:
        """Monitor of a model under this rule."""
        return EnvelopeMonitor(
            model, self.violations or None, self.window or None, self.margin or None, listed_states(self.masked)
        )


def listed_states(text: str) -> list[str]:
    """Names of states, separated by commas."""
    return [name.strip() for name in text.split(",") if name.strip()]
