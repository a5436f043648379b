# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Arrays on disk: transitions in blocks that a pass reads one after the other."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import FitError
from uncertain_lti.base.files import whole_file
from uncertain_lti.identification.columns import Columns
from uncertain_lti.identification.problem import BLOCK, Block, Problem

_FORMAT = "uncertain-lti-cache/1"
_DATA, _FACTS = "transitions.f64", "facts.json"


@dataclass(frozen=True)
class DiskPartition:
    """A `Partition` in a folder: blocks of [z; s; x_next; Δt] as float64, read again by every pass.

    Only one block is in memory at a time.

    `folder`: written by `CacheWriter`; `count`: number of transitions, N; `n`: number of states; `p`: number of states
    and controls; `weights` (n,): constant in time; `columns`: terms that are unknown; `q`: number of further scheduling
    signals.
    """

    folder: Path
    count: int
    n: int
    p: int
    weights: Array
    columns: Columns
    q: int = 0

    @property
    def N(self) -> int:
        """Number of transitions."""
        return self.count

    def blocks(self) -> Iterator[Block]:
        """All transitions, in the blocks they were written in."""
        first = self.p + self.q
        lines = first + self.n + 1
        with open(self.folder / _DATA, "rb", buffering=0) as stream:
            for start in range(0, self.count, BLOCK):
                size = min(BLOCK, self.count - start)
                data = np.fromfile(stream, dtype="<f8", count=lines * size)
                if len(data) < lines * size:
                    raise FitError(f"{self.folder}: the cache is cut short; delete the folder and fit again")
                table = data.reshape(lines, size)
                s = table[self.p : first] if self.q else None
                yield Block(start, table[: self.p], table[first:-1], table[-1], self.weights, s)

    def with_columns(self, columns: Columns) -> DiskPartition:
        """The same transitions with other unknown terms."""
        return replace(self, columns=columns)


class CacheWriter:
    """Writes a `DiskPartition` from problems that come one after the other, each of which fits in memory.

    Use it as a context: left without an error, the folder is complete; else what was written is removed.

    `folder`: made if it does not exist; a cache in it is replaced.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        self._pending: list[Array] = []
        self._waiting = 0
        self._count = 0
        self._shape: tuple[int, int, int] | None = None

    def __enter__(self) -> CacheWriter:
        self._made = not self.folder.exists()
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            strangers = {f.name for f in self.folder.iterdir()} - {_DATA, _FACTS}
            if strangers:
                raise FitError(
                    f"{self.folder}: holds {min(strangers)}, so it is no cache; name an empty or a new folder"
                )
            (self.folder / _FACTS).unlink(missing_ok=True)
            self._stream = open(self.folder / _DATA, "wb")  # closed in __exit__
        except OSError as error:
            raise FitError(f"{self.folder}: cannot be written: {error.strerror}; choose another folder") from None
        return self

    def add(self, problem: Problem) -> None:
        """Append the transitions of a recording."""
        further = [] if problem.s_columns is None else [problem.s_columns]
        shape = (problem.n, problem.p, sum(map(len, further)))
        if self._shape not in (None, shape):
            raise FitError(f"{self.folder}: recordings differ in their numbers of signals")
        self._shape = shape
        table = np.vstack([problem.z_columns, *further, problem.next_columns, problem.dt])
        self._pending.append(table)
        self._waiting += table.shape[1]
        if self._waiting >= BLOCK:
            self._write(self._waiting - self._waiting % BLOCK)

    def _write(self, size: int) -> None:
        """Write this many of the first waiting transitions, in blocks."""
        whole = np.hstack(self._pending)
        try:
            for start in range(0, size, BLOCK):
                stop = min(start + BLOCK, size)
                np.ascontiguousarray(whole[:, start:stop], dtype="<f8").tofile(self._stream)
        except OSError as error:
            raise FitError(f"{self.folder}: cannot be written: {error.strerror}; free some space") from None
        self._pending = [whole[:, size:].copy()]
        self._waiting -= size
        self._count += size

    def __exit__(self, kind: object, *_: Any) -> None:
        complete = False
        try:
            if kind is None and self._waiting:
                self._write(self._waiting)
            self._stream.close()
            if kind is None and self._shape is not None:
                n, p, q = self._shape
                facts = {"format": _FORMAT, "transitions": self._count, "n": n, "p": p, "q": q}
                with whole_file(self.folder / _FACTS) as stream:
                    stream.write(json.dumps(facts).encode())
            complete = kind is None
        finally:
            if not complete:
                self._remove()

    def _remove(self) -> None:
        self._stream.close()
        for name in (_FACTS, _DATA):
            (self.folder / name).unlink(missing_ok=True)
        if self._made:
            self.folder.rmdir()

    def partition(self, weights: Array, columns: Columns) -> DiskPartition:
        """What was written; to be asked when the context has ended.

        `weights` (n,): constant in time.
        """
        if self._shape is None:
            raise FitError(f"{self.folder}: no usable transition was written")
        n, p, q = self._shape
        return DiskPartition(self.folder, self._count, n, p, weights, columns, q)
