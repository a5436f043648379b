# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Objects of a model file: which fields they may and must have, said in one way."""

from __future__ import annotations

import reprlib
from collections.abc import Collection, Mapping
from typing import Any

from uncertain_lti.base.errors import ModelError


def object_of(
    data: Any, name: str, known: Collection[str] | None = None, needed: Collection[str] = (), remedy: str = ""
) -> dict[str, Any]:
    """An object of a model file, its fields checked."""
    if not isinstance(data, Mapping):
        raise ModelError(f"field '{name}' is not an object")
    within = f"{name}." if name else ""
    for key in needed:
        if key not in data:
            raise ModelError(f"field '{within}{key}' is missing; {remedy or 'fit the model again'}")
    for key in data:
        if known is not None and key not in known:
            unknown = f"{within}{reprlib.repr(key)[1:-1]}"
            raise ModelError(f"unknown field '{unknown}'; known are {', '.join(sorted(known))}")
    return dict(data)
