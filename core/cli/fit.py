# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Commands `fit`, `tune`, `validate` and `signature`: from recordings to a model, and what further ones add to it."""

from __future__ import annotations

import argparse
import logging
import os
import shlex
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from importlib import import_module
from typing import TYPE_CHECKING, Any

from uncertain_lti.base.errors import BagError, FitError, ModelError, UnprovenError
from uncertain_lti.base.files import sha256
from uncertain_lti.base.text import plural
from uncertain_lti.cli import interrupted
from uncertain_lti.cli.command import OPTIONS, RECORDINGS, RULES, Result, declared, helped, load_model, model_target

if TYPE_CHECKING:
    from uncertain_lti import SignalMap, Transient, UncertainLTI


def read_fitted(options: argparse.Namespace, bags: Iterable[str], signals: SignalMap) -> Iterator[Transient]:
    """Read recordings as a model has its signals."""
    from uncertain_lti.recordings.formats import group_recordings
    from uncertain_lti.sampling.reading import read_as_fitted

    for bag in group_recordings(bags, layout=signals.table):
        transient = read_as_fitted(bag, signals, options.progress.iterate("reading"))
        options.progress.note(*transient.notes)
        yield transient


# --- fit -------------------------------------------------------------------------------------------------------------


@declared(
    "fit a model to recordings",
    helped("bags", f"{RECORDINGS}; parts of a split bag are one recording"),
    helped("--signals", "signals file (YAML): which field is which signal; not with --update", required=False),
    "--update",
    ("--output", {"required": True}),
    *("--force", "--criterion", "--additive", "--alarm", "--false-alarms", "--schedule", "--horizons", "--widths"),
    *("--json", "--discard", "--count", "--group", "--cache", "--scheduler", "--workers"),
    verbose="report every scan of the data, and what took how long",
)
def fit(options: argparse.Namespace) -> Result:
    """Fit a model and write it."""
    from uncertain_lti.reports.model_text import fit_text, next_text

    output = model_target(options.output, options.force, options.bags)
    if options.workers is not None and options.workers < 1:
        raise FitError(f"--workers is {options.workers}; give 1 or more")
    if options.update is not None:
        model = _updated(options)
    elif options.signals is None:
        raise FitError("no --signals; give the signals file, which says which field is which signal")
    else:
        archive = options.cache or options.scheduler or options.workers
        model = _fit_archive(options) if archive else _fit_in_memory(options)
    model.save(output)
    options.say(f"{fit_text(model)}\nmodel written to {output}\n{next_text(model, shlex.quote(str(output)))}")
    data = model.to_dict()
    return Result(data={"model": str(output), "fit": data["fit"], "validation": data["validation"]})


def _fit_in_memory(options: argparse.Namespace) -> UncertainLTI:
    from uncertain_lti import fit
    from uncertain_lti.validation.groups import resolve_groups

    schedule = _asked(options)
    transients = _read(options, options.signals)
    resolve_groups(transients, options.group)  # what is wrong with the key is found before the fit
    asked = ("additive", "horizons", "widths", "alarm", "false_alarms", "discard", "count")
    given = {name: getattr(options, name) for name in asked} | {"schedule": schedule, "groups": options.group}
    with options.progress.stage("fitting") as step:
        model = fit(transients, options.criterion, **given, seek_carriers=True, progress=step)
    return _with_sources(model, _files(transients), options.group)


def _read(options: argparse.Namespace, signals: str | SignalMap) -> list[Transient]:
    """The recordings that are named; a line for each of the first, and of those that lose much, says what was read."""
    from uncertain_lti import read_transients
    from uncertain_lti.reports.model_text import MOST_SHOWN, recording_text
    from uncertain_lti.sampling.reading import loses_much

    transients = read_transients(options.bags, signals, options.progress.iterate("reading"), processes=None)
    options.progress.note(*(note for transient in transients for note in transient.notes))
    for i, transient in enumerate(transients):
        if (lossy := loses_much(transient)) or i < MOST_SHOWN:
            (options.say_losses if lossy else options.say)(recording_text(transient))
    if (more := len(transients) - MOST_SHOWN) > 0:
        options.say(f"and {plural(more, 'more recording')}, named where much is not used")
    return transients


def _updated(options: argparse.Namespace) -> UncertainLTI:
    known = {"bags", "update", "output", "force", "json"}
    for name in (option if isinstance(option, str) else option[0] for option in fit.options):
        word = name.removeprefix("--").replace("-", "_")
        if word not in known and getattr(options, word) not in (None, OPTIONS[name].get("default")):
            raise FitError(f"{name} is given, and an update keeps what the model was fitted with; leave it out")
    model = load_model(options.update)
    transients = _read(options, model.signals)
    with options.progress.stage("fitting") as step:
        try:
            updated = model.update(transients, step)
        except UnprovenError:
            if not (earlier := _earlier(options, model)):
                raise
            updated = model.update([*earlier, *transients], step)
            if updated.fit_summary["transients"] > model.fit_summary["transients"] + len(transients):
                raise  # some are read in another way now, and were taken for new ones
            needed = f"what {options.update} keeps does not prove the optimum of all recordings"
            options.progress.note(f"{needed}: {plural(len(earlier), 'earlier one')} read again")
    if model.signatures:
        lost = (
            f"its signatures ({len(model.signatures)}) are of the bounds of before and are left out; learn them again"
        )
        options.progress.note(f"{options.update}: {lost}")
    there = [*model.fit_summary["sources"], *_files(transients)]
    by_mark = {source.get("sha256", source["file"]): source for source in there}  # where each was found last
    return _with_sources(updated, by_mark.values())


def _earlier(options: argparse.Namespace, model: UncertainLTI) -> list[Transient]:
    """The recordings that a model was fitted to, if all are where its file says, or beside it, and unchanged."""
    from uncertain_lti import read_transients

    files = {_found(source["file"], options.update): source.get("sha256") for source in model.fit_summary["sources"]}
    if not all(os.path.isfile(file) and sha256(file) == known for file, known in files.items()):
        return []
    return read_transients(list(files), model.signals, options.progress.iterate("reading"), processes=None)


def _fit_archive(options: argparse.Namespace) -> UncertainLTI:
    from uncertain_lti.proposal.public_fit import fit_many

    for given, what, also in (
        (options.discard, "--discard goes through all transitions", ""),
        (options.horizons or options.widths, "--horizons needs all recordings", ", or --horizons"),
        (options.group is not None, "--group needs all recordings", ""),
        (options.count != "sample", "--count transient needs all recordings", ""),
    ):
        if given:
            raise FitError(f"{what} in memory; leave out --cache, --scheduler and --workers{also}")
    schedule = _asked(options)
    if options.cache and (options.scheduler or options.workers):
        raise FitError("--cache keeps the arrays on disk and --scheduler or --workers on a cluster; choose one")
    with ExitStack() as stack:
        client = None
        if options.scheduler or options.workers:
            dask: Any = import_module("distributed")
            where = options.scheduler or stack.enter_context(_local_cluster(dask, options.workers))
            try:
                client = stack.enter_context(dask.Client(where, timeout=10))
            except (OSError, TimeoutError, ValueError):
                raise FitError(f"no Dask scheduler answers at {where}; start one with `dask scheduler`") from None
        with options.progress.stage("fitting") as step:
            asked = {name: getattr(options, name) for name in ("additive", "alarm", "false_alarms")}
            given = {"schedule": schedule, "cache": options.cache, "client": client, "progress": step}
            model = fit_many(options.bags, options.signals, options.criterion, **asked, **given)
    return _with_sources(model, [{**s, "sha256": sha256(s["file"])} for s in model.fit_summary["sources"]])


def _local_cluster(dask: Any, workers: int) -> Any:
    """Worker processes that leave Ctrl-C to this one, which ends them."""
    from uncertain_lti.sampling.reading import children_ignore_ctrl_c

    with children_ignore_ctrl_c():
        quiet = logging.CRITICAL  # of work that is broken off; what goes wrong comes back as an error
        given = {"threads_per_worker": 1, "host": "127.0.0.1", "dashboard_address": None, "silence_logs": quiet}
        try:
            return dask.LocalCluster(n_workers=workers, **given)
        except (RuntimeError, TimeoutError, OSError) as error:
            if interrupted(error):
                raise
            why = str(error.__cause__ or error) or type(error).__name__
            raise FitError(
                f"a worker could not be started ({why}); start again, with fewer workers, or with --cache"
            ) from None


def _asked(options: argparse.Namespace) -> dict[str, Any] | None:
    """The schedule of the command line, checked against the signals file before anything is read."""
    if not options.schedule:
        return None
    from uncertain_lti import SignalMap
    from uncertain_lti.identification.regimes import Modes, check_names

    names = [name for name, *_ in options.schedule]
    for name in names:
        if names.count(name) > 1:
            raise FitError(f"--schedule names '{name}' twice; give each scheduling signal once")
    check_names(names, [s.name for s in SignalMap.load(options.signals).signals])
    return {name: Modes(values) if kind == "modes" else values for name, kind, values in options.schedule}


def _files(transients: Iterable[Transient]) -> list[dict[str, str]]:
    """The files of recordings with their checksums, each once: a table may hold several."""
    names = dict.fromkeys(name for t in transients for name in t.sources)
    return [{"file": name, "sha256": sha256(name)} for name in names]


def _found(file: str, model: str) -> str:
    """A recording as the model's file names it, or beside that file."""
    beside = os.path.join(os.path.dirname(model), file)
    return beside if _is_there(beside) and not _is_there(file) else file


def _is_there(recording: str) -> bool:
    return os.path.exists(recording) or os.path.exists(recording.rpartition("[")[0])  # or one run in a table


def _with_sources(model: UncertainLTI, sources: Iterable[dict[str, Any]], group: str | None = None) -> UncertainLTI:
    """The model with the files that it was fitted to, and the key of their groups."""
    facts = {**model.fit_summary, "sources": list(sources)}
    return model.replace(fit_summary=facts | ({} if group is None else {"group": group}))


# --- tune ------------------------------------------------------------------------------------------------------------


@declared(
    "try delays, schedules and lags, and take what sees clearly smaller jumps than fit",
    helped("bags", f"{RECORDINGS} of the healthy machine; LABEL=BAG is one of a machine with the fault LABEL"),
    "--signals",
    helped("--false-alarms", "as in fit (default: what the recordings can show)"),
    *("--budget", "--group", "--output", "--force", "--json"),
    verbose="say every way that is tried, and what took how long",
)
def tune(options: argparse.Namespace) -> Result:
    """Try the ways, print them, and write the model that was chosen."""
    from uncertain_lti import read_transients, tune
    from uncertain_lti.reports.model_text import alarm_text, headline_text, tune_text
    from uncertain_lti.validation.groups import resolve_groups

    output = None if options.output is None else model_target(options.output, options.force, options.bags)
    healthy = [bag for bag in options.bags if _label(bag) is None]
    if not healthy:
        raise FitError("no recording of the healthy machine is named; give at least one without a label")
    transients = read_transients(healthy, options.signals, options.progress.iterate("reading"), processes=None)
    options.progress.note(*(note for transient in transients for note in transient.notes))
    resolve_groups(transients, options.group)
    signals = transients[0].signals
    assert signals is not None
    faulty: dict[str, list[Transient]] = {}
    for bag in options.bags:
        if (label := _label(bag)) is not None:
            faulty.setdefault(label, []).extend(read_fitted(options, [bag.partition("=")[2]], signals))
    with options.progress.stage("tuning") as step:
        given = {"budget": options.budget, "groups": options.group, "faulty": faulty, "progress": step}
        tuned = tune(transients, options.false_alarms, **given)
    data = tuned.to_dict()
    if output is not None:
        _with_sources(tuned.model, _files(transients), options.group).save(output)
    options.say("\n".join((headline_text(tuned.model), tune_text(data), alarm_text(tuned.model))))
    if output is not None:
        options.say(f"model written to {output}")
    return Result(data={"model": options.output, "tune": data})


def _label(text: str) -> str | None:
    """The label of LABEL=BAG; None for a recording without one."""
    label, given, path = text.partition("=")
    return label if given and path and not os.path.exists(text) and os.sep not in label else None


# --- validate --------------------------------------------------------------------------------------------------------


_OF_THE_FIT = "default: that of the fit; none: single recordings all the same"


@declared(
    "estimate how far to trust a model, by leaving out what it was fitted to",
    "model",
    helped("bags", f"{RECORDINGS} (default: those the model was fitted to)", nargs="*"),
    "--blocks",
    helped("--group", f"{OPTIONS['--group']['help']}; {_OF_THE_FIT}"),
    *("--gap", "--confidence"),
    helped("--false-alarms", "learn the panel again, for at most so many false alarms per hour with 90%% confidence"),
    "--within",
    helped("--output", "write the model with this validation, and the panel that was learnt, to this file"),
    *("--force", "--json"),
    verbose="say every fit, and what took how long",
)
def validate(options: argparse.Namespace) -> Result:
    """Validate the model and write it with the result, if an output is named."""
    from uncertain_lti import UncertainLTI
    from uncertain_lti.reports.model_text import validation_text
    from uncertain_lti.validation.detectable import check_within, detectable
    from uncertain_lti.validation.left_out import validate
    from uncertain_lti.validation.panel import check_rate, learn, promises
    from uncertain_lti.validation.part import fitted_parts

    check_within(options.within)
    check_rate(options.false_alarms)
    model = UncertainLTI.load(options.model)
    sources = model.fit_summary.get("sources", [])
    bags = options.bags or list(dict.fromkeys(_found(s["file"], options.model) for s in sources))
    if not bags:
        raise BagError(f"{options.model}: does not say which recordings it was fitted to; name them")
    if not options.bags and not _is_there(bags[0]):
        raise BagError(
            f"{options.model}: {bags[0]}, to which it was fitted, is not there; name its recordings after it"
        )
    if options.output is not None:
        own = os.path.exists(options.output) and os.path.samefile(options.output, options.model)
        model_target(options.output, options.force or own, bags)
    transients = list(read_fitted(options, bags, model.signals))
    with options.progress.stage("validating") as step:
        given = {name: getattr(options, name) for name in ("blocks", "gap", "confidence")}
        validation = validate(model, transients, **given, groups=options.group, progress=step)
    said: list[str] = []
    if options.false_alarms is not None:
        panel = learn(validation, fitted_parts(validation.model, transients), options.false_alarms)
        model = model.with_residuals_of(validation.model).replace(alarm=panel.rules, residuals=panel.residuals)
        said = promises(model, panel)
    data = validation.judged_as(model).to_dict() | ({"promises": said} if said else {})
    with options.progress.stage("injecting faults") as step:
        given = {"confidence": options.confidence, "progress": step}
        data["detectable"] = detectable(model, validation.parts, options.within, **given).to_dict()
    model = model.replace(validation=data)
    if options.output is not None:
        model.save(options.output)
    options.say(validation_text(data))
    if options.output is not None:
        options.say(f"model written to {options.output}; alarm: {'; or '.join(r.words for r in model.alarm)}")
    return Result(data={"model": options.output or options.model, "validation": model.to_dict()["validation"]})


# --- signature -------------------------------------------------------------------------------------------------------


_LABELLED = "a fault, and a recording of it in which the alarm is raised; several recordings may have one label"


@declared(
    "learn what known faults look like from labelled recordings",
    *("model", helped("bags", _LABELLED, metavar="LABEL=BAG"), ("--output", {"required": True})),
    *("--force", *RULES, "--json"),
)
def signature(options: argparse.Namespace) -> Result:
    """Learn the signatures and write the model with them."""
    from uncertain_lti import EnvelopeMonitor
    from uncertain_lti.monitor.likeness import learn_signatures
    from uncertain_lti.reports.model_text import signature_text

    output = model_target(options.output, options.force)
    pairs = [text.partition("=") for text in options.bags]
    for text, (label, _, bag) in zip(options.bags, pairs, strict=True):
        if not (label.strip() and bag):
            raise ModelError(f"{text!r} is not LABEL=BAG; write for example stuck_valve=run7.mcap")
    model = load_model(options.model)
    monitor = EnvelopeMonitor(model, options.violations, options.window, options.margin)
    runs = ((label, run) for label, _, bag in pairs for run in read_fitted(options, [bag], model.signals))
    learnt = learn_signatures(model, [(label, monitor.check(run)) for label, run in runs], options.force)
    model.replace(signatures=learnt.signatures).save(output)
    keys = ("label", "recordings", "verdicts", "steps")
    faults = [{key: value for key, value in s.to_dict().items() if key in keys} for s in learnt.signatures]
    named = [{"recording": r, "label": label, "named": found} for r, label, found in learnt.named]
    alike = [{"labels": [a, b], "match": match} for a, b, match in learnt.alike]
    options.say(f"{signature_text(learnt)}\nmodel written to {output}")
    return Result(data={"model": str(output), "signatures": faults, "named": named, "alike": alike})
