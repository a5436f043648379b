# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Recordings into transients: field values through the Sampler, several recordings side by side."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from numbers import Integral
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import core_count, return_memory
from uncertain_lti.base.errors import BagError, SignalError, refuse_other
from uncertain_lti.base.text import meant, plural, shortlist
from uncertain_lti.recordings.formats import group_recordings, open_recording
from uncertain_lti.recordings.recording import DATED_NS, Columns, Progress, Recording
from uncertain_lti.sampling.clock import INVALID, LATE, MISSING, TOO_OLD, Status, resolve
from uncertain_lti.sampling.sampler import Sampler
from uncertain_lti.sampling.steady_state import resolve_auto
from uncertain_lti.sampling.transient import Transient, unusable
from uncertain_lti.signals.field_path import FieldPath
from uncertain_lti.signals.signal_map import SignalMap, UncarriedTopicError
from uncertain_lti.signals.values import of_table

_CLOCK = "rosgraph_msgs/msg/Clock"


@dataclass
class Stream(Columns):
    """The wanted field values of one recording in order of arrival; a topic's values in the order of `signals.on`.

    `bag`: the recording.
    """

    bag: Recording = field(kw_only=True)


def read_stream(bag: Recording, signals: SignalMap, progress: Progress | None = None) -> Stream:
    """Read the fields of a signals file from one recording."""
    paths = check_paths(bag, signals)
    columns = bag.columns(signals.topics, paths, progress)
    refuse_absent(bag, signals, paths, columns.values)
    return Stream(**vars(columns), bag=bag)


def check_paths(bag: Recording, signals: SignalMap) -> list[list[FieldPath]]:
    """Field paths per topic; every problem of the map is found before the long read.

    What the index of a file says is wrong is looked for in the file itself before it is reported: they may differ.
    """
    fits = False
    with suppress(SignalError):
        fits = bag.indexed and _fits(bag, signals)
    if not fits:
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
        for path, column in zip(columns, read.T, strict=True):
            _refuse_absent(bag, name, path, column)


def _refuse_absent(bag: Recording, topic: str, path: FieldPath, column: NDArray[np.float64]) -> None:
    looked_up = any(kind != "attribute" for kind, _ in path.steps)
    if len(column) and not (looked_up and np.isnan(column[:1]).any() and np.isnan(column).all()):
        return
    notes = bag.reading_notes
    first = next((message for _, _, message in bag.messages([topic])), None) if looked_up else None
    bag.restore_notes(*notes)
    if first is not None and (absent := path.absent(first)):
        raise SignalError(f"field '{path.text}' of {topic} in {bag.path}: {absent}")
    if not len(column):
        why = notes[1].get(topic, f"{bag.path}: {topic} has no message")
        raise BagError(f"{why}; record it, or choose another topic or recording")


Paths = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]


Times = Mapping[str, tuple[int, int, NDArray[np.int64], NDArray[np.int64]]]
"""Of each topic of a recording how many messages have a stamp and how many there are; and, if states are on it, the
stamps and the log times, ns."""


def times_of(stream: Stream, signals: SignalMap) -> Times:
    """When the messages of a recording came."""
    states = {s.topic for s in signals.states}
    times = {}
    for position, topic in enumerate(signals.topics):
        chosen = stream.topic == position
        stamps, arrivals = stream.stamp[chosen], stream.arrival[chosen]
        stamped = stamps[stamps >= 0]
        kept = len(stamps) if topic in states else 0
        times[topic] = len(stamped), len(stamps), stamped[:kept], arrivals[:kept]
    return times


def resolved_by(recordings: Sequence[Times], signals: SignalMap) -> SignalMap:
    """Resolve clock, max_gap and time sources; by default stamps, where most messages of every recording have one."""
    sources: dict[str, str] = {}
    instants: dict[str, list[NDArray[np.int64]]] = {}
    for topic in signals.topics:
        share = min((times[topic][0] / times[topic][1] for times in recordings if times[topic][1]), default=0.0)
        chosen = signals.time.get(topic)
        if chosen == "header" and not share:
            none = "time is header, and no message of a recording has a stamp; write log, or leave it out"
            raise SignalError(f"{signals.source}: topics: {topic}: {none}")
        sources[topic] = chosen or ("header" if share > 0.5 else "log")
        stamps = sources[topic] == "header"
        instants[topic] = [times[topic][2] if stamps else times[topic][3] for times in recordings]
    return resolve(signals, instants, sources)


@dataclass(frozen=True)
class Decisions:
    """What became of each clock message of a recording, in the order in which it was decided.

    A sample is decided by its own message, or, where that lacks states or controls of its instant
    (`SignalMap.decided_at_once`), by the next one that opens a sample; without a next one it is not decided.

    `arrival` (M,): arrival of the message that decided it, ns; `t_ns` (M,): its own instant, ns; `dropped` (M,): it
    made no sample. The others are the samples, one after the other; `by` (M,): which clock message decided it, counted
    in order of arrival.
    """

    arrival: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    dropped: NDArray[np.bool_]
    by: NDArray[np.int64]


def sample(stream: Stream, signals: SignalMap) -> tuple[Transient, Decisions]:
    """One recording through the `Sampler`, and which message decided each sample; signals must be resolved."""
    sampler = Sampler(signals)
    (t_ns, x, held), decisions = sampler.push_all(stream.topic, stream.arrival, stream.stamp, stream.values)
    assert signals.max_gap is not None
    m, bag = len(signals.controls), stream.bag
    cut: dict[str, Any] = {"signals": signals, "max_gap": signals.max_gap, "min_step": signals.min_step}
    read: dict[str, Any] = {"counters": sampler.counters, "sources": bag.parts, "name": os.fspath(bag.path)}
    notes = [*bag.warnings, *lags_in_words(stream, signals), *_silence(stream, signals)]
    if signals.clock and signals.time[signals.clock] == "log":
        notes += [f"{bag.path}: {other}" for other in of_another_clock(bag, signals.clock)]
    transient = Transient(t_ns, x, held[:, :m], s=held[:, m:], notes=tuple(notes), **cut, **read)
    return transient, Decisions(*decisions)


def lags_in_words(stream: Stream, signals: SignalMap) -> list[str]:
    """Topics whose stamps usually lag or lead those of the clock topic by more than a step, a sentence each."""
    clock = signals.clock or ""
    of_clock = np.flatnonzero((stream.topic == signals.topics.index(clock)) & (stream.stamp > 0))
    if signals.time[clock] != "header" or len(of_clock) < 2:
        return []
    step, said = float(np.median(np.diff(stream.stamp[of_clock]))), []
    for position, topic in enumerate(signals.topics):
        own = np.flatnonzero((stream.topic == position) & (stream.stamp > 0))
        own = own[own > of_clock[0]]
        if topic == clock or signals.time[topic] != "header" or not len(own):
            continue
        before = of_clock[np.searchsorted(of_clock, own) - 1]  # the clock message that came last
        since = np.minimum(stream.arrival[own] - stream.arrival[before], step)
        lag = float(np.median(stream.stamp[before] + since - stream.stamp[own]))
        if abs(lag) > step > 0:
            by = f"{abs(lag) * 1e-9:.3g} s, {abs(lag) / step:.3g} steps"
            way, so = "lag", "each sample has the control that had come, not the one of its instant"
            if lag < 0:
                way, so = "lead", f"right if {clock} comes so late, otherwise their clocks differ"
            said.append(f"{stream.bag.path}: stamps on {topic} {way} those on {clock} by {by}: {so}")
    return said


def _silence(stream: Stream, signals: SignalMap) -> Iterator[str]:
    """Says that the clock topic stops long before the recording does."""
    ends = [(info.first, info.last) for info in stream.bag.topics.values()]  # by an index, those of their chunks
    first, last = min(t for t, _ in ends if t is not None), max(t for _, t in ends if t is not None)
    own = stream.arrival[stream.topic == signals.topics.index(signals.clock or "")]
    quiet = last - int(own.max(initial=first))
    if quiet > max(10**9, (last - first) // 20):
        stops = f"the last message of {signals.clock} comes {quiet * 1e-9:.3g} s before the recording ends"
        yield f"{stream.bag.path}: {stops}, and nothing is judged after it; has the sensor or its driver stopped?"


def of_another_clock(bag: Recording, clock: str) -> list[str]:
    """A sentence on samples by log times, where the recording holds a simulated clock whose times are others."""
    ticks = [topic for topic, info in bag.topics.items() if info.type == _CLOCK and info.readable]
    _, log_ns, tick = next(iter(bag.messages(ticks)), (clock, 0, None)) if ticks else (clock, 0, None)
    if tick is None or abs(tick.clock.sec - log_ns * 1e-9) < 2.0:
        return []
    judges = "a monitor with use_sim_time judges other steps; record with --use-sim-time"
    return [f"{clock} goes by log times, which are not those of {ticks[0]}: {judges}"]


def read_transients(
    paths: Paths,
    signals: SignalMap | str | os.PathLike[str],
    progress: Progress | None = None,
    processes: int | None = 1,
) -> list[Transient]:
    """Read recordings as transients, all cut by one resolved signal map.

    What the map leaves open is resolved over all recordings together: time sources, clock, max_gap, message types,
    and `auto` steady states and scales (rules: `SignalMap`, `steady_state.resolve_auto`). The resolved map is
    `transient.signals`.

    Parameters
    ----------
    paths : Paths
        Recordings and folders; parts of one split bag are one recording (see `formats.group_recordings`).
    signals : SignalMap or path
        A map, or the signals file.
    progress : callable, optional
        Wraps what goes through the messages of a recording, given their number: (iterable, total) -> iterable.
    processes : int or None
        How many recordings are read at the same time, each in a process of its own; None chooses
        (`processes_for`). A script that asks for more than 1 needs `if __name__ == "__main__":`.

    Returns
    -------
    list of Transient
        One per recording.

    Raises
    ------
    BagError
        A recording cannot be read, or lacks a topic.
    SignalError
        The map does not fit the recordings.
    """
    refuse_other(paths, (Iterable, os.PathLike), "paths", "give files or folders", BagError)
    of = [paths] if isinstance(paths, (str, os.PathLike)) else list(paths)
    for path in of:
        refuse_other(path, (str, os.PathLike), "a recording", "give the path of a file or a folder", BagError)
    if not isinstance(signals, SignalMap):
        refuse_other(signals, (str, os.PathLike), "signals", "give a SignalMap or a signals file", SignalError)
        signals = load_signals(signals, of)
    bags = group_recordings(of, indexed=True, layout=signals.table)
    if not bags:
        raise BagError("no recording is named; give at least one file or folder")
    whole = "give a whole number from 1 on, or None"
    refuse_other(processes, (Integral, type(None)), "processes", whole, BagError)
    if processes is not None and processes < 1:
        raise BagError(f"processes is {processes}; {whole}")
    signals = signals.with_types(types_of(bags, signals))
    streams = read_streams(bags, signals, progress, processes)
    resolved = resolved_by([times_of(stream, signals) for stream in streams], signals)
    asked = [s for s in resolved.signals if "auto" in (s.steady, s.scale)]
    again = streams.copy() if any(FieldPath(s.field).unwrap for s in asked) else []
    transients = [sample(streams.pop(0), resolved)[0] for _ in bags]
    refuse_copies(transients)
    return_memory()
    if not asked:
        return _overlaps_told(transients)
    resolved, words = _resolve_operating_point(resolved, transients)
    if again:  # the branch of an angle starts nearest to steady
        transients = [sample(stream, resolved)[0] for stream in again]
    numbers = shortlist([f"{s.name} {s.steady:.9g} (scale {s.scale:.9g})" for s in resolved.signals], 12)
    first = (*transients[0].notes, f"operating point from {words}: {numbers}")
    return _overlaps_told(
        [t.replace(signals=resolved, notes=first if t is transients[0] else t.notes) for t in transients]
    )


def refuse_copies(transients: Iterable[Transient]) -> None:
    """A recording that is named together with its copy would count twice, and vouch for itself."""
    seen: dict[tuple[float, ...], list[Transient]] = {}
    for t in filter(len, transients):  # thousands of runs may have the same times
        at = [0, len(t) // 2, -1]
        some = np.nan_to_num(np.hstack([t.x[at], t.u[at]]))
        alike = seen.setdefault((len(t), int(t.t_ns[0]), int(t.t_ns[-1]), *some.ravel().tolist()), [])
        for twin in alike:
            pairs = (t.t_ns, twin.t_ns), (t.x, twin.x), (t.u, twin.u)
            moves = (t.x != t.x[0]).any()  # two runs of a simulation at rest are equal, too
            if moves and all(np.array_equal(one, other, equal_nan=True) for one, other in pairs):
                raise copy_of(t.name, twin.name)
        alike.append(t)


def _overlaps_told(transients: Sequence[Transient]) -> list[Transient]:
    """A note on each that holds samples of another one, as snapshots of one stretch do; by stamps of a calendar."""
    found, before = list(transients), None
    for k in sorted((k for k, t in enumerate(found) if len(t)), key=lambda k: int(found[k].t_ns.min())):
        t = found[k]
        if before is not None and DATED_NS < t.t_ns.min() <= before.t_ns.max():
            _, mine, its = np.intersect1d(t.t_ns, before.t_ns, return_indices=True)
            same = mine[(t.x[mine] == before.x[its]).all(axis=1)]
            if 2 * len(same) > len(mine) and np.ptp(t.x[same], axis=0).any():
                shared = f"{len(same)} of its {plural(len(t), 'sample')} are those of {before.name}"
                note = f"{t.name}: {shared}: they count twice, and what is left out was fitted; cut or leave out one"
                found[k] = t.replace(notes=(*t.notes, note))
        if before is None or t.t_ns.max() > before.t_ns.max():
            before = t
    return found


def copy_of(name: str, twin: str) -> BagError:
    """The error for a recording that is named together with its copy."""
    return BagError(f"{name}: holds the samples of {twin}; name each recording once")


def read_as_fitted(
    recording: Recording | str | os.PathLike[str], signals: SignalMap, progress: Progress | None = None
) -> Transient:
    """Read one recording with the signals and sampling that a model was fitted with."""
    return read_as_fitted_with_decisions(recording, signals, progress)[0]


def read_as_fitted_with_decisions(
    recording: Recording | str | os.PathLike[str], signals: SignalMap, progress: Progress | None = None
) -> tuple[Transient, Decisions]:
    """`read_as_fitted`, and which message decided each clock message."""
    if any(not s.topic for s in signals.signals):
        remedy = "check it with EnvelopeMonitor(model).check(transient)"
        raise SignalError(f"the model was fitted to arrays and names no topics; {remedy}")
    bag = recording if isinstance(recording, Recording) else open_recording(recording, (), True, signals.table)
    for topic, found in types_of([bag], signals, remap=True).items():
        expected = next(s.type for s in signals.signals if s.topic == topic)
        if expected and found != expected:
            remedy = "check a recording of the same topics"
            found = found or "of no stated type"
            raise BagError(f"{bag.path}: {topic} is {found}, and the model was fitted to {expected}; {remedy}")
    if signals.clock is None or signals.max_gap is None or any(t not in signals.time for t in signals.topics):
        unsaid = "it does not say clock, max_gap and time of every topic, so not how to cut samples"
        raise SignalError(f"{signals.source}: {unsaid}; fit the model to recordings")
    stream = read_stream(bag, signals, progress)
    stamps = stream.stamp[stream.topic == signals.topics.index(signals.clock)]
    if signals.time[signals.clock] == "header" and not (stamps > 0).any():
        remedy = "fit it to such recordings, with time: log for that topic"
        raise SignalError(f"{bag.path}: no message of {signals.clock} has a stamp, and the model uses them; {remedy}")
    transient, decisions = sample(stream, signals)
    if not len(transient):
        raise BagError(f"{bag.path}: no message of {signals.clock} makes a sample; record stamps that go forward")
    return transient, decisions


def read_field(
    recording: Recording, signals: SignalMap, decisions: Decisions, topic: str, path: FieldPath
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """A field of any topic, and after which samples of the same recording its values came.

    Returns (K,): samples that were decided before each message came; Returns (K,): the values; NaN where a message has
    no such number.
    """
    require(recording, topic)
    path.check(topic, recording.topics[topic].type, recording.type_fields(topic))
    clock = signals.clock or ""
    of_clock = [FieldPath(signals.signals[i].field) for i in signals.on(clock)]
    topics, paths = ([topic], [[path]]) if clock == topic else ([topic, clock], [[path], of_clock])
    columns = recording.columns(topics, paths)
    _refuse_absent(recording, topic, path, columns.values[0][:, 0])
    of_field = columns.topic == 0
    if clock == topic:  # clock messages before it; it goes with its own
        own, its = recording.columns([clock], [of_clock]).arrival, columns.arrival
        came = np.arange(len(its)) if len(own) == len(its) else np.searchsorted(own, its)
    else:
        came = np.cumsum(~of_field)[of_field]
    return np.searchsorted(decisions.by[~decisions.dropped], came), columns.values[0][:, 0]


def load_signals(path: str | os.PathLike[str], recordings: Sequence[str | os.PathLike[str]]) -> SignalMap:
    """A signals file; where it contradicts itself, its topics are first looked for in the recordings."""
    try:
        return SignalMap.load(path)
    except UncarriedTopicError as error:
        for bag in group_recordings(list(recordings), indexed=True):
            for topic in error.topics:
                require(bag, topic)
        raise


def require(bag: Recording, topic: str, remap: bool = False) -> None:
    """Refuse a topic that a recording lacks, with the nearest names and all of them; remap: with the option for it."""
    if topic not in bag.topics:
        there = shortlist(sorted(bag.topics), 50) or "none"
        none = f"there is no topic {topic}{meant(topic, bag.topics)}; topics there: {there}"
        if remap and bag.topics and not any(map(of_table, (topic, *bag.topics))):
            none += f"; one of another name is checked with --remap {topic}:=NAME"
        raise BagError(f"{bag.path}: {none}") from None


def types_of(bags: Sequence[Recording], signals: SignalMap, remap: bool = False) -> Mapping[str, str]:
    """Message type of each topic, which must be the same in all recordings."""
    types: dict[str, str] = {}
    for bag in bags:
        for topic in signals.topics:
            require(bag, topic, remap)
            found = bag.topics[topic].type
            if types.setdefault(topic, found) != found:
                other = f"{types[topic]} in {bags[0].path}"
                raise BagError(
                    f"{bag.path}: {topic} is {found}, and {other}; fit recordings of the same types together"
                )
    return types


def _resolve_operating_point(signals: SignalMap, transients: Sequence[Transient]) -> tuple[SignalMap, str]:
    recordings = []
    for t in transients:
        rows = np.hstack([t.x, t.u, t.s])[:-1]  # the last row has no control yet
        recordings += np.split(rows, np.flatnonzero(np.diff(t.segment[:-1])) + 1)  # nobody knows what was in a gap
    steady, scale, words = resolve_auto(signals.signals, recordings)
    filled = [replace(s, steady=a, scale=b) for s, a, b in zip(signals.signals, steady, scale, strict=True)]
    return signals.replace_signals(filled), words


def unused(transient: Transient) -> list[str]:
    """In words, how many transitions of a recording are not used, and why."""
    there = [(status.value, mask) for status, mask in unusable(transient).items() if mask.any()]
    there.sort(key=lambda of: int(of[1].argmax()))  # that which was met first is said first
    counts = {kind: int(mask.sum()) for kind, mask in there}
    counters = transient.counters
    parts = [f"{count} {kind}" for kind, count in counts.items()]
    lacking = counters.of(MISSING)
    if counts.get(MISSING, 0) > max(1.0, _FEW * len(transient)) and (most := max(lacking.values(), default=0)):
        names = [name for name, count in lacking.items() if count > 0.5 * most][:3]
        parts[list(counts).index(MISSING)] += f" {' or '.join(names)}{' or others' * (len(lacking) > len(names))}"
    parts += [f"{counters[s.value]} dropped ({s.value})" for s in Status if s.dropped and counters[s.value]]
    kinds = [(kind, *of) for kind in (LATE, TOO_OLD, INVALID) for of in sorted(counters.of(kind).items())]
    return parts + [f"{count} {kind} {name}" for kind, name, count in kinds]


_FEW = 0.01  # share of the samples without a transition that is not worth a line: before the first command, a pause


def loses_much(transient: Transient) -> bool:
    """Whether messages were dropped, or more than a few samples are not used."""
    dropped = any(transient.counters[s.value] for s in Status if s.dropped)
    return dropped or len(transient) - 1 - int(transient.usable.sum()) > _FEW * len(transient)


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
        walked, undecoded, columns = future.result()
    except BrokenProcessPool:
        ended = "the process that read it was ended, perhaps for want of memory"
        raise BagError(f"{bag.path}: {ended}; read fewer recordings at once, or fit with --cache") from None
    if walked:
        bag.walk()
    bag.restore_notes(bag.reading_notes[0], undecoded)
    return Stream(**columns, bag=bag)


def _read(bag: Recording, signals: SignalMap) -> tuple[Any, ...]:
    """In a process of its own: whether the index did not hold, messages left out by topic, and the columns."""
    indexed = bag.indexed
    columns = vars(read_stream(bag, signals))
    del columns["bag"]  # which the other process has
    return indexed and not bag.indexed, bag.reading_notes[1], columns


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
