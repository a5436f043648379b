# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Plain data as JSON holds it."""

from __future__ import annotations

import math
from typing import Any


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
