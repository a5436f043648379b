# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Archive: a fit over more recordings than memory holds, from arrays on disk or on the workers of a cluster."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import BagError, FitError, SignalError
from uncertain_lti.base.files import whole_file
from uncertain_lti.base.progress import CountedStep
from uncertain_lti.identification.assembly import assemble, is_constant
from uncertain_lti.identification.fitting import fit_fleet, structure_of, with_repeats
from uncertain_lti.identification.fleet import DaskFleet, Fleet
from uncertain_lti.identification.problem import Columns, DiskPartition, Problem, Regimes
from uncertain_lti.identification.regimes import Knots, asked_by, scheduled_by, signals_of, unused
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.model.operating_point import OperatingPoint
from uncertain_lti.model.repeats import Found, repeats_in
from uncertain_lti.model.schedule import Schedule
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.recordings.formats import group_recordings, open_recording
from uncertain_lti.sampling import reading
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.signal_map import SignalMap
from uncertain_lti.signals.values import Additive

_DATA = "transitions.f64"


def write_cache(folder: str | os.PathLike[str], problems: Iterable[Problem]) -> DiskPartition:
    """Write problems that come one after the other, each of which fits in memory, with weights of one.

    `folder`: made if it does not exist; a cache in it is replaced.
    """
    folder, sizes = Path(folder), list[int]()
    new = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        known = (_DATA, f".{_DATA}-")  # the second is what was not finished
        if strangers := [f.name for f in folder.iterdir() if not f.name.startswith(known)]:
            raise FitError(f"{folder}: holds {min(strangers)}, so it is no cache; name an empty or a new folder")
        (folder / _DATA).unlink(missing_ok=True)
        with whole_file(folder / _DATA) as stream:
            for problem in problems:
                for block in problem.blocks():
                    further = [] if block.s is None else [block.s]
                    table = np.vstack([block.z, *further, block.x_next, block.dt])
                    stream.write(np.ascontiguousarray(table, dtype="<f8").data)
                    sizes.append(len(block))
            if not sizes:
                raise FitError(f"{folder}: no usable transition was written")
    except BaseException as error:
        if new:
            with suppress(OSError):
                folder.rmdir()
        if isinstance(error, OSError):
            raise FitError(f"{folder}: cannot be written: {error.strerror}; choose another folder") from None
        raise
    q = 0 if problem.s is None else len(problem.s)
    return DiskPartition(folder / _DATA, sizes, problem.n, problem.p, q, np.ones(problem.n), problem.columns)


Recording = tuple[str, tuple[str, ...]]
"""Name and files of one recording."""


def fit_archive(
    paths: Sequence[str | os.PathLike[str]],
    signals: SignalMap | str | os.PathLike[str],
    criterion: str = "qp",
    additive: Additive | None = None,
    *,
    schedule: Schedule | Mapping[str, Knots] | None = None,
    cache: str | os.PathLike[str] | None = None,
    client: Any = None,
    alarm_rule: AlarmRule | None = None,
    progress: Callable[[str], None] | None = None,
) -> UncertainLTI:
    """`fit` over recordings that together need not fit in memory; each of them must.

    Parameters
    ----------
    paths : sequence of path
        As for `read_transients`; a cluster's workers must be able to read them under the same names.
    signals : SignalMap or path
        steady and scale must be numbers: `auto` would need all recordings at once.
    criterion : {"qp", "lp"}, default "qp"
        As for `fit`.
    additive : {"none", "disturbance", "noise", "both"}, optional
        As for `fit`.
    schedule : Schedule or mapping, optional
        As for `fit`, but that knots must be given, not how many.
    cache : path, optional
        Folder for the arrays, written while the bags are read; passes then read it block by block.
    client : distributed.Client, optional
        The workers read the recordings and keep the arrays. Give cache or client.
    alarm_rule : AlarmRule, optional
        As for `fit`.
    progress : callable, optional
        Called with one line of text per recording, with its number among all (a `CountedStep`), and per pass, with the
        samples still outside and the size of the working set.

    Returns
    -------
    UncertainLTI
        The same optimum as `fit` finds.

    Raises
    ------
    BagError, SignalError, FitError
        As for `read_transients` and `fit`.
    """
    if (cache is None) == (client is None):
        raise FitError("an archive is fitted from a cache or on a cluster; give one of them")
    if not isinstance(signals, SignalMap):
        paths = list(paths)
        signals = reading.load_signals(signals, paths)
    schedule = asked_by(signals) if schedule is None else schedule
    on = signals_of(schedule, [s.name for s in signals.signals])
    messages = unused([s.name for s in signals.scheduling], on)
    signals = signals.scheduled_on(on)
    refuse_auto(signals)
    say = progress or (lambda text: None)
    bags = group_recordings(list(paths), indexed=True, layout=signals.table)
    if not bags:
        raise BagError("no recording is named; give at least one file or folder")
    signals = signals.with_types(reading.types_of(bags, signals))
    recordings: list[Recording] = [(os.fspath(bag.path), tuple(map(str, bag.parts))) for bag in bags]
    del bags

    def counting(what: str) -> Callable[[int], None]:
        total = len(recordings)
        return lambda number: say(CountedStep(f"{what} ({number} of {total})", number, total))

    def visit(what: str, function: Callable[..., Any], *more: Any) -> list[Any]:
        if client is not None:
            return DaskFleet.run(client, [(function, (recording, *more)) for recording in recordings], counting(what))
        results = []
        for number, recording in enumerate(recordings, start=1):
            counting(f"{what} {recording[0]}")(number)
            results.append(function(recording, *more))
        return results

    looked = visit("looking at", survey, signals)
    _refuse_copies(recordings, [mark for _, mark in looked])
    signals = reading.resolved_by([times for times, _ in looked], signals)
    del looked
    additive = additive or signals.additive or "none"
    scheduled = scheduled_by(schedule, signals)
    regimes = None if scheduled is None else Regimes.of(scheduled, signals)
    fleet: Fleet
    dt = None
    if client is not None:
        # whether Δt is constant decides what is identifiable, and must be one answer for all partitions
        constant = additive == "both" and all(visit("steps of", _constant_dt, signals))
        columns = Columns.of(additive, constant, regimes)
        tasks = [(load, (recording, signals, columns)) for recording in recordings]
        fleet = on_workers = DaskFleet(client, tasks, counting("reading"))
        counts, named = fleet.counts, [recordings[number] for number in on_workers.kept]
    else:
        assert cache is not None
        fleet, counts, dt = _cached(cache, recordings, signals, additive, regimes, counting)
        named = recordings
    starts = np.concatenate([[0], np.cumsum(counts)])

    def where(index: int) -> str:
        which = int(np.searchsorted(starts, index, side="right")) - 1
        return f"transition {index - starts[which]} of {named[which][0]}"

    fleet.check_solvable(where, [s.name for s in signals.states])
    model = fit_fleet(
        fleet,
        signals,
        criterion,
        structure=structure_of(signals, scheduled),
        progress=progress,
        dt_median=fleet.median_dt() if dt is None else float(np.median(dt)),
        where=where,
    )
    facts = {
        **model.fit_summary,
        "messages": [*model.fit_summary.get("messages", []), *messages],
        "additive": additive,
        "weights": "ones",
        "transients": len(recordings),
        "sources": [{"file": file} for file in dict.fromkeys(file for _, files in recordings for file in files)],
    }
    return with_repeats(model.replace(fit_summary=facts, alarm_rule=alarm_rule), visit("repeats in", repeats, model))


def _cached(
    cache: str | os.PathLike[str], recordings: Sequence[Recording], signals: SignalMap, additive: Additive,
    regimes: Regimes | None, counting: Callable[[str], Callable[[int], None]],
) -> tuple[Fleet, list[int], Array]:  # fmt: skip
    counts, steps = list[int](), list[Array]()  # transitions of each recording; steps, s

    def problems() -> Iterator[Problem]:
        for number, recording in enumerate(recordings, start=1):
            counting(f"reading {recording[0]}")(number)
            problem = load(recording, signals, Columns(regimes=regimes))
            counts.append(problem.N)
            steps.append(problem.dt)
            yield problem

    partition = write_cache(cache, problems())
    dt = np.concatenate(steps)
    return Fleet([replace(partition, columns=Columns.of(additive, is_constant(dt), regimes))]), counts, dt


def refuse_auto(signals: SignalMap) -> None:
    """Steady states and scales that are to be found need all recordings at once."""
    for signal in signals.signals:
        if "auto" in (signal.steady, signal.scale):
            raise SignalError(
                f"{signals.source}: '{signal.name}' has auto, and an archive is read one recording at a time; write "
                f"numbers (a fit to a few of the recordings prints them)"
            )


def _stream(recording: Recording, signals: SignalMap) -> reading.Stream:
    return reading.read_stream(open_recording(*recording, indexed=True, layout=signals.table), signals)


def _sampled(recording: Recording, signals: SignalMap) -> Transient:
    return reading.sample(_stream(recording, signals), signals)[0]


def survey(recording: Recording, signals: SignalMap) -> tuple[reading.Times, bytes]:
    """First look at one recording, and a mark that its copies have: of times and values of all messages."""
    stream, mark = _stream(recording, signals), sha256()
    times = stream.stamp if (stream.stamp > 0).any() else stream.arrival
    for array in (stream.topic, times, *stream.values):
        mark.update(np.ascontiguousarray(array).data)
    return reading.times_of(stream, signals), mark.digest()


def _refuse_copies(recordings: Sequence[Recording], marks: Sequence[bytes]) -> None:
    named: dict[bytes, str] = {}
    for (name, _), mark in zip(recordings, marks, strict=True):
        if (twin := named.setdefault(mark, name)) is not name:
            raise reading.copy_of(name, twin)


def load(recording: Recording, signals: SignalMap, columns: Columns) -> Problem:
    """The usable transitions of one recording, normalised."""
    point = OperatingPoint.of(signals.states, signals.controls, signals.scheduling)
    problem = assemble([_sampled(recording, signals)], point, None, "none", empty=True, regimes=columns.regimes)
    return replace(problem, columns=columns)


def repeats(recording: Recording, model: UncertainLTI) -> Found:
    """What one recording has of exact repeats."""
    return repeats_in(model, _sampled(recording, model.signals))


def _constant_dt(recording: Recording, signals: SignalMap) -> bool:
    return is_constant(load(recording, signals, Columns()).dt)
