# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Formats of recordings: one entry for each kind of file that can be read."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from uncertain_lti.base.errors import BagError
from uncertain_lti.base.text import shortlist
from uncertain_lti.recordings.bag import Bag, group_bags
from uncertain_lti.recordings.recording import Recording
from uncertain_lti.recordings.table import is_table, read_tables
from uncertain_lti.signals.values import TableLayout


@dataclass(frozen=True)
class Format:
    """One kind of recording.

    `name`: what it is called; `recognises`: takes a path, and returns whether this format reads it; `group`: takes
    paths that a user named together, whether an index may be believed until messages are read, and what a signals file
    says of the columns of tables; returns the recordings they are, in order.
    """

    name: str
    recognises: Callable[[Path], bool]
    group: Callable[[Sequence[Path], bool, TableLayout | None], Sequence[Recording]]


FORMATS: list[Format] = [
    Format("table", is_table, lambda paths, _, layout: read_tables(paths, layout)),
    Format("ROS recording", lambda path: True, lambda paths, indexed, _: group_bags(paths, indexed)),
]
"""Every format; the first that recognises a path reads it. Bags are last: their errors say what another file is."""


def open_recording(
    path: str | os.PathLike[str],
    parts: Sequence[str | os.PathLike[str]] = (),
    indexed: bool = False,
    layout: TableLayout | None = None,
) -> Recording:
    """Open one recording; `parts`: its files in order, if they are known to be those of a split bag."""
    if len(parts) > 1:
        return Bag(path, parts, indexed)
    recordings = group_recordings([path], indexed, layout)
    if len(recordings) != 1:
        names = shortlist([recording.path.name for recording in recordings], 6)
        raise BagError(f"{path}: holds {len(recordings)} recordings; name one of them, {names}")
    return recordings[0]


def group_recordings(
    paths: Iterable[str | os.PathLike[str]], indexed: bool = False, layout: TableLayout | None = None
) -> list[Recording]:
    """Recordings that some paths name, in the order of their first mention.

    A folder is one recording. Files are one recording each, except the parts of a split bag (`group_bags`), and a table
    with a column that tells the runs in it apart.
    """
    recordings: list[Recording] = []
    by_format = itertools.groupby(map(Path, paths), lambda path: next(f for f in FORMATS if f.recognises(path)))
    for format, some in by_format:
        recordings += format.group(list(some), indexed, layout)
    seen: set[Path] = set()
    named = (r.parts if r.path.exists() else (r.path,) for r in recordings)  # a run of a table is no file
    for part in itertools.chain.from_iterable(named):
        if part.resolve() in seen:
            raise BagError(f"{part}: named twice; name each recording once")
        seen.add(part.resolve())
    return recordings
