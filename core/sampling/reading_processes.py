# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Recordings read side by side, each in a process of its own."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

from uncertain_lti.base.cores import core_count
from uncertain_lti.base.errors import BagError
from uncertain_lti.recordings.recording import Progress, Recording
from uncertain_lti.sampling.streams import Stream, check_paths, read_stream
from uncertain_lti.signals.signal_map import SignalMap

WORTH_IT = 1 << 28
"""Bytes of recordings from which on processes that have to be started first save time."""


def processes_for(bags: Sequence[Recording]) -> int:
    """How many processes to read these recordings with: 1 for small ones, and on few cores.

    One process keeps nearly two cores busy, as it reads ahead.
    """
    size = sum(bag.size for bag in bags)
    return max(1, min(len(bags), core_count() // 2)) if size >= WORTH_IT else 1


def read_streams(
    bags: Sequence[Recording], signals: SignalMap, progress: Progress | None, processes: int | None
) -> list[Stream]:
    """`read_stream` of every recording; where processes read them, progress advances by whole recordings."""
    processes = min(processes_for(bags) if processes is None else processes, len(bags))
    if processes == 1:
        return [read_stream(bag, signals, progress) for bag in bags]
    for bag in bags:
        check_paths(bag, signals)  # what is wrong with the map is found before anything is started
    counts = [sum(bag.topics[topic].count for topic in signals.topics) for bag in bags]
    with _pool(processes) as pool:
        futures = {pool.submit(_read, bag, signals): number for number, bag in enumerate(bags)}

        def messages() -> Iterator[None]:
            for future in as_completed(futures):
                yield from [None] * counts[futures[future]]

        steps: Iterable[object] = messages()
        for _ in steps if progress is None else progress(steps, sum(counts)):
            pass
        return [_stream(bag, future) for bag, future in zip(bags, futures, strict=True)]


def _stream(bag: Recording, future: Future[tuple[Any, ...]]) -> Stream:
    try:
        walked, undecoded, *columns = future.result()
    except BrokenProcessPool:
        raise BagError(
            f"{bag.path}: the process that read it was ended, perhaps for want of memory; "
            f"read fewer recordings at once, or fit with --cache"
        ) from None
    if walked:
        bag.walk()
    bag.restore_notes(bag.reading_notes[0], undecoded)
    return Stream(bag, *columns)


def _read(bag: Recording, signals: SignalMap) -> tuple[Any, ...]:
    """In a process of its own: whether the index did not hold, messages left out by topic, and the columns."""
    indexed = bag.indexed
    stream = read_stream(bag, signals)
    walked = indexed and not bag.indexed
    return walked, bag.reading_notes[1], stream.topic, stream.arrival, stream.stamp, stream.values


@contextmanager
def children_ignore_ctrl_c() -> Iterator[None]:
    """Processes that are started in the block leave Ctrl-C to this one, which takes it at the end of the block.

    They inherit that SIGINT is blocked. In another than the main thread it cannot be set.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []  # another thread may take the signal, which makes this one call the handler
    handler = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, handler)
        if came:
            signal.raise_signal(signal.SIGINT)


@contextmanager
def _pool(processes: int) -> Iterator[ProcessPoolExecutor]:
    """Processes that leave Ctrl-C to this one, which ends them where it breaks off."""
    pool = ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"))
    with children_ignore_ctrl_c():
        for _ in range(processes):
            pool.submit(os.getpid)  # each starts a process as long as none is idle
    try:
        yield pool
    except BaseException:
        for process in list((getattr(pool, "_processes", None) or {}).values()):
            process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
