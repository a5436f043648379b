# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Topics of a table: which of its columns have their numbers in the same rows."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain
from os.path import commonprefix

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.text import once
from uncertain_lti.recordings.table_text import ROWS_EACH, Column
from uncertain_lti.signals.values import TABLE_TOPIC

_MOST_KINDS = 100  # of messages
_SHARED = 0.5  # of the rows of the rarer column, from which on two columns are of one message
_SAME = 0.9  # of the rows of the fuller column, from which on two come at one rate; of the steps, that are even


def by_message(columns: Mapping[str, Column], number: int) -> dict[str, tuple[list[str], NDArray[np.intp]]]:
    """Fields and rows of each topic: of several messages by turns, each of two numbers or more, or of several rates."""
    one = {TABLE_TOPIC: (list(columns), np.arange(number))}
    names: dict[bytes, list[str]] = {}  # by where they have a number
    for name, column in columns.items():
        if column.dtype.kind not in "OM":
            there = np.isfinite(column) if column.ndim == 1 else np.ones(number, np.bool_)
            if there.all() and column.ndim == 1 and _goes_on(column):
                there = ~there  # an index or a label is of no message
            if len(names) > _MOST_KINDS:
                return one
            names.setdefault(there.tobytes(), []).append(name)
    any_row = names.pop(bytes(number), [])
    if slower := _slower(names, number):
        fullest = [name for name in columns if name not in chain(*(group for group, _ in slower.values()))]
        return {TABLE_TOPIC: (fullest, np.arange(number))} | slower
    known = {kind: np.frombuffer(kind, np.bool_) for kind in names}
    if any(there.all() for there in known.values()):
        return one
    rows = {kind: np.count_nonzero(there) for kind, there in known.items()}
    groups: list[list[bytes]] = []
    for kind in known:
        shared = {other: np.count_nonzero(known[kind] & known[other]) for group in groups for other in group}
        of = {other for other, both in shared.items() if both >= _SHARED * min(rows[kind], rows[other])}
        tied = [group for group in groups if not of.isdisjoint(group)]
        groups = [group for group in groups if group not in tied] + [[*chain(*tied), kind]]
    rows_of = [np.flatnonzero(np.any([known[kind] for kind in group], axis=0)) for group in groups]
    fields = [[name for kind in group for name in names[kind]] for group in groups]
    # where no message has two numbers, signals were written as they changed, and hold until then
    turns = [1 + np.count_nonzero(np.diff(of) > 1) >= min(ROWS_EACH, max(3, len(of) / 5)) for of in rows_of]
    if sum(turns) < 2 or max(map(len, fields)) < 2:
        return one
    begun = [(commonprefix(group), group[0]) for group in fields]
    fields[int(np.argmax([len(of) for of in rows_of]))] += any_row
    topics = once((begin.rpartition("_")[0] or begin or first for begin, first in begun), "_")
    return {f"{TABLE_TOPIC}/{topic}": of for topic, of in zip(topics, zip(fields, rows_of, strict=True), strict=True)}


def _slower(names: Mapping[bytes, list[str]], number: int) -> dict[str, tuple[list[str], NDArray[np.intp]]]:
    """Fields and rows of a topic for each slower rate, if nearly every row has a number of the fastest."""
    groups: list[tuple[NDArray[np.bool_], list[str]]] = []
    for kind in sorted(names, key=lambda kind: -kind.count(1)):
        there = np.frombuffer(kind, np.bool_)
        of = (g for first, g in groups if np.count_nonzero(first & there) >= _SAME * np.count_nonzero(first))
        if (group := next(of, None)) is not None:
            group += names[kind]
        else:
            groups.append((there, [*names[kind]]))
    if not groups or np.count_nonzero(groups[0][0]) < _SAME * number:
        return {}
    slower = {}
    for there, group in groups[1:]:
        rows = np.flatnonzero(there)
        steps = np.diff(rows)
        usual = float(np.median(steps)) if len(rows) > 3 else 0.0
        if usual >= 2 and np.mean((steps > usual / 2) & (steps < 2 * usual)) >= _SAME:
            slower[f"{TABLE_TOPIC}/{group[0]}"] = group, rows
    return slower


def _goes_on(column: Column) -> bool:
    """Whether a column is an index, a label or constant: its step from row to row is nearly always that before."""
    same = np.diff(column.astype(np.float64), 2) == 0
    return int(np.count_nonzero(same)) >= 0.9 * len(same)
