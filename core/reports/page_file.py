# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The files that `report` and `plot` write: where a page or an image may go, and how a page is written."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from uncertain_lti.base.errors import BagError
from uncertain_lti.base.files import target, whole_file
from uncertain_lti.recordings.recording import Recording

HOLDS = {".html": b"<html", ".png": b"\x89PNG", ".svg": b"<svg", ".pdf": b"%PDF"}
"""Endings of pages and images, and what their files hold near the beginning."""


def page_target(output: str | os.PathLike[str], model_file: str, bags: Sequence[Recording]) -> Path:
    """Where a page or an image goes; an older one of the same format is replaced, a recording or the model never."""
    path = Path(output)
    image = path.suffix in HOLDS and path.suffix != ".html"
    for other in (*([Path(model_file)] if model_file else []), *(part for bag in bags for part in bag.parts)):
        if path.exists() and other.exists() and path.samefile(other):
            raise BagError(f"{path}: is what the {'plot' if image else 'report'} is about; choose another name")
    kind, example = ("image", "plot.png") if image else ("page", "report.html")
    return target(path, holds=HOLDS.get(path.suffix, b"<html"), kind=kind, example=example)


def write_page(path: str | os.PathLike[str], page: str) -> None:
    """Write a page, whole or not at all."""
    try:
        with whole_file(path) as stream:
            stream.write(page.encode("utf-8", "replace"))
    except OSError as error:
        raise BagError(f"{path}: cannot be written: {error.strerror}; choose another place") from None
