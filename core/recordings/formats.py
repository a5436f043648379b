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
from uncertain_lti.recordings.table import Table, is_table
from uncertain_lti.signals.values import TableLayout


@dataclass(frozen=True)
class Format:
    """One kind of recording.

    `name`: what it is called; `recognises`: takes a path, and returns whether this format reads it; `open`: takes the
    path of one recording, its files in order where they are known (else none), and whether an index may be believed
    until messages are read; returns the `Recording`; `group`: takes paths that a user named together, and the same
    flag; returns the recordings they are, in order; `laid_out`: takes a path, and what a signals file says of the
    columns of tables; returns the recordings in the file. None for a format in which a file says that itself.
    """

    name: str
    recognises: Callable[[Path], bool]
    open: Callable[[Path, Sequence[Path], bool], Recording]
    group: Callable[[Sequence[Path], bool], Sequence[Recording]]
    laid_out: Callable[[Path, TableLayout], Sequence[Recording]] | None = None


FORMATS: list[Format] = [
    Format("table", is_table, Table, lambda paths, indexed: [Table(path) for path in paths], Table.every_run),
    Format("ROS recording", lambda path: True, Bag, group_bags),
]
"""Every format; the first that recognises a path reads it. Bags are last: their errors say what another file is."""


def format_of(path: Path) -> Format:
    """Find the format that reads a file or folder."""
    return next(format for format in FORMATS if format.recognises(path))


def open_recording(
    path: str | os.PathLike[str],
    parts: Sequence[str | os.PathLike[str]] = (),
    indexed: bool = False,
    layout: TableLayout | None = None,
) -> Recording:
    """Open one recording."""
    format = format_of(Path(path))
    if layout is not None and format.laid_out is not None:
        recordings = format.laid_out(Path(path), layout)
        if len(recordings) != 1:
            names = shortlist([recording.path.name for recording in recordings], 6)
            raise BagError(f"{path}: holds {len(recordings)} recordings; name one of them, {names}")
        return recordings[0]
    return format.open(Path(path), [Path(part) for part in parts], indexed)


def group_recordings(
    paths: Iterable[str | os.PathLike[str]], indexed: bool = False, layout: TableLayout | None = None
) -> list[Recording]:
    """Recordings that some paths name, in the order of their first mention.

    A folder is one recording. Files are one recording each, except the parts of a split bag (`group_bags`), and a table
    with a column that tells the runs in it apart.
    """
    recordings: list[Recording] = []
    for format, run in itertools.groupby(map(Path, paths), format_of):
        if layout is not None and format.laid_out is not None:
            recordings += itertools.chain.from_iterable(format.laid_out(path, layout) for path in run)
        else:
            recordings += format.group(list(run), indexed)
    seen: set[Path] = set()
    named = (r.parts if r.path.exists() else (r.path,) for r in recordings)  # a run of a table is no file
    for part in itertools.chain.from_iterable(named):
        if part.resolve() in seen:
            raise BagError(f"{part}: named twice; name each recording once")
        seen.add(part.resolve())
    return recordings
