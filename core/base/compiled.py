# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Compiled twins: modules of this package built as C extensions from the very file that runs uncompiled.

A twin is called like its module with an underscore before it, and carries the checksum of the source it was built
from. It is used where it is there, fits its source and is not switched off; otherwise the module itself is used.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any
from zlib import crc32

MODULES = (
    "model.bounds",
    "monitor.envelope_monitor",
    "monitor.intake",
    "monitor.sender",
    "monitor.statistics",
    "monitor.stream",
    "monitor.verdict",
    "monitor.verdict_messages",
    "recordings.message_reader",
    "sampling.sampler",
)
"""Modules that have a twin where they were compiled; setup.py builds them."""
SWITCH = "UNCERTAIN_LTI_PURE_PYTHON"
"""Environment variable that, when it is set, keeps every twin out of use."""

_why_not: dict[str, str] = {}


def use_twin(module: dict[str, Any], names: Sequence[str]) -> None:
    """Replace these names of a module by those of its compiled twin, if that can be used."""
    whole = module["__name__"]
    twin, reason = _twin(whole, Path(module["__file__"]))
    _why_not[whole] = reason
    if twin is not None:
        module.update({name: getattr(twin, name) for name in names})


def why_not() -> str:
    """What keeps the live chain from being compiled throughout, in words; empty if nothing does."""
    for name in MODULES:
        import_module(f"uncertain_lti.{name}")
    return next((f"{name.removeprefix('uncertain_lti.')}: {why}" for name, why in _why_not.items() if why), "")


def uncompiled(name: str) -> ModuleType:
    """A module of the package once more, without its twin, for comparison."""
    found = import_module(f"uncertain_lti.{name}")
    spec = spec_from_file_location(f"{found.__name__}_uncompiled", found.__file__)
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _twin(whole: str, source: Path) -> tuple[ModuleType | None, str]:
    if whole.endswith("_uncompiled"):
        return None, ""
    if os.environ.get(SWITCH):
        return None, f"{SWITCH} is set"
    room, _, name = whole.rpartition(".")
    try:
        twin = import_module(f"{room}._{name}")
    except ImportError:
        return None, "its compiled form is not installed"
    if source.exists() and crc32(source.read_bytes()) != twin.SOURCE:  # in a checkout it may have changed since
        return None, "its compiled form was built from another version; install again"
    return twin, ""
