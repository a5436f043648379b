# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Types of message fields, described the same way offline (definitions in bags) and live (rclpy classes)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class FieldType:
    """Type of one message field.

    `kind`: what one element is; `type_name`: type of one element, as the message definition writes it; `array`: none
    for a single value, 0 for a sequence of any length, n for n elements.
    """

    kind: Literal["number", "bool", "string", "message", "other"]
    type_name: str
    array: int | None = None


TypeFields = Callable[[str], Mapping[str, FieldType]]
"""Type name -> {field name: FieldType}; raises SignalError for an unknown type."""
