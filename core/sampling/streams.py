# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Streams: the wanted field values of one recording, in order of arrival."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.errors import BagError, SignalError
from uncertain_lti.recordings.recording import Progress, Recording
from uncertain_lti.signals.field_path import FieldPath
from uncertain_lti.signals.signal_map import SignalMap


@dataclass
class Stream:
    """The wanted field values of one recording in order of arrival.

    `bag`: the recording; `topic` (messages,): positions in `signals.topics`; `arrival` (messages,): log time, ns;
    `stamp` (messages,): header stamp, ns; -1 for no stamp; `values` (messages of the topic, signals on it): one array
    per topic, in the order of `signals.on(topic)`.
    """

    bag: Recording
    topic: NDArray[np.int64]
    arrival: NDArray[np.int64]
    stamp: NDArray[np.int64]
    values: list[NDArray[np.float64]]


def read_stream(bag: Recording, signals: SignalMap, progress: Progress | None = None) -> Stream:
    """Read the fields of a signals file from one recording."""
    paths = check_paths(bag, signals)
    columns = bag.columns(signals.topics, paths, progress)
    refuse_absent(bag, signals, paths, columns.values)
    return Stream(bag, columns.topic, columns.arrival, columns.stamp, columns.values)


def check_paths(bag: Recording, signals: SignalMap) -> list[list[FieldPath]]:
    """Field paths per topic; every problem of the map is found before the long read.

    What the index of a file says is wrong is looked for in the file itself before it is reported: they may differ.
    """
    if bag.indexed:
        try:
            if not _fits(bag, signals):
                bag.walk()
        except SignalError:
            bag.walk()
    _fits(bag, signals)
    return [[FieldPath(signals.signals[i].field) for i in signals.on(t)] for t in signals.topics]


def _fits(bag: Recording, signals: SignalMap) -> bool:
    """Whether every topic can be read; raises SignalError where a path of one that can be does not fit its type."""
    readable = [name for name in signals.topics if name in bag.topics and bag.topics[name].readable]
    for name in readable:
        try:
            signals.check(name, bag.topics[name].type, bag.type_fields(name))
        except SignalError as error:
            raise SignalError(f"{bag.path}: {error}") from None
    return len(readable) == len(signals.topics)


def refuse_absent(
    bag: Recording, signals: SignalMap, paths: Sequence[Sequence[FieldPath]], values: Sequence[NDArray[np.float64]]
) -> None:
    """What no message has: a topic, or what the first lacks and gave no number in any other, a mistake in the map."""
    for name, columns, read in zip(signals.topics, paths, values, strict=True):
        if not len(read):
            raise BagError(f"{bag.path}: {name} has no message; record it, or choose another topic or recording")
        for path, column in zip(columns, read.T, strict=True):
            looked_up = any(kind != "attribute" for kind, _ in path.steps)
            if not looked_up or not math.isnan(column[0]) or not np.isnan(column).all():
                continue
            notes = bag.reading_notes
            _, _, first = next(iter(bag.messages([name])))
            bag.restore_notes(*notes)
            if absent := path.absent(first):
                raise SignalError(f"field '{path.text}' of {name} in {bag.path}: {absent}")
