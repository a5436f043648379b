# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Command `uncertain-lti fit`: fit a model to recordings."""

from __future__ import annotations

import argparse
import logging
import shlex
from importlib import import_module
from pathlib import Path
from typing import Any

from uncertain_lti.base.errors import FitError
from uncertain_lti.cli.command import (
    DONE,
    GROUP,
    SILENT,
    Command,
    add_output,
    add_recordings,
    add_signals,
    model_target,
    print_json,
    print_notes,
    print_summary,
)
from uncertain_lti.signals.choices import CHOICES


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `uncertain-lti fit`."""
    add_recordings(parser, "; parts of a split bag are one recording")
    add_signals(parser)
    add_output(parser, required=True)
    parser.add_argument(
        "--criterion",
        choices=("qp", "lp"),
        help="(10) squared or (11) largest width (default: what sees smaller jumps on left-out data)",
    )
    parser.add_argument(
        "--additive",
        choices=CHOICES,
        help="further terms: disturbance c with its half-width, measurement noise (default: the signals file's, else "
        "noise, and the disturbance where it narrows the envelope clearly)",
    )
    parser.add_argument(
        "--alarm",
        choices=("panel", "containment"),
        default="panel",
        help="a small fixed panel of rules learnt on left-out data (default), or a sample outside its bounds",
    )
    parser.add_argument(
        "--false-alarms",
        type=float,
        metavar="PER_HOUR",
        help="false alarms per hour at most, with 90%% confidence (default: what the recordings can show)",
    )
    parser.add_argument(
        "--schedule",
        type=_schedule,
        action="append",
        metavar="SIGNAL[=auto|N|a,b,...|modes:a,b,...]",
        help="piecewise-linear over this signal: as many knots as the recordings carry (auto, the default), N knots, "
        "knots or modes in recorded units; once or twice (default: what the signals file says)",
    )
    parser.add_argument(
        "--horizons",
        type=_horizons,
        metavar="auto[:S]|S,...",
        help="further envelopes, over these seconds, or over those up to S that hold on left-out data (auto) "
        "(default: what the signals file says)",
    )
    parser.add_argument(
        "--widths",
        choices=("auto", "constant", "growing"),
        help="their half-widths: growing with the state, constant, or what holds better on left-out data (auto)",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument(
        "--discard",
        type=_budget,
        default=0,
        metavar="K",
        help="leave at most K transitions outside (or a share such as 0.001), chosen by effect and listed",
    )
    parser.add_argument(
        "--count",
        choices=("sample", "transient"),
        default="sample",
        help="let every sample weigh the same (default), or every recording however long it is",
    )
    parser.add_argument("--group", metavar="KEY", help=GROUP)
    parser.add_argument("--cache", metavar="FOLDER", help="more recordings than memory: keep the arrays in this folder")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="fit on the workers of this Dask scheduler")
    parser.add_argument("--workers", type=int, metavar="N", help="fit on a Dask cluster of N workers on this machine")


def run(options: argparse.Namespace) -> int:
    """Fit a model and write it."""
    from uncertain_lti import fit, read_transients
    from uncertain_lti.base.files import sha256
    from uncertain_lti.reports.model_text import fit_text, next_text, recording_text
    from uncertain_lti.validation.groups import resolve_groups

    output = model_target(options.output, options.force)
    if options.workers is not None and options.workers < 1:
        raise FitError(f"--workers is {options.workers}; give 1 or more")
    if options.cache or options.scheduler or options.workers:
        return _fit_archive(options, output)
    schedule = _asked(options)
    transients = read_transients(options.bags, options.signals, options.progress.iterate("reading"), processes=None)
    for transient in transients:
        if not options.json:
            print_notes(options, transient.notes)
        print_summary(options, recording_text(transient))
    resolve_groups(transients, options.group)  # what is wrong with the key is found before the fit
    with options.progress.stage("fitting") as step:
        model = fit(
            transients,
            options.criterion,
            additive=options.additive,
            schedule=schedule,
            horizons=options.horizons,
            widths=options.widths,
            alarm=options.alarm,
            false_alarms=options.false_alarms,
            groups=options.group,
            discard=options.discard,
            count=options.count,
            seek_carriers=True,
            progress=step,
        )
    files = dict.fromkeys(name for t in transients for name in t.sources)  # a table may hold several
    sources = [{"file": name, "sha256": sha256(name)} for name in files]
    model = model.replace(fit_summary={**model.fit_summary, "sources": sources})
    if options.group is not None:
        model = model.replace(fit_summary={**model.fit_summary, "group": options.group})
    model.save(output)
    if options.json:
        data = model.to_dict()
        print_json({"model": str(output), "fit": data["fit"], "validation": data["validation"]})
    else:
        print_summary(options, fit_text(model))
        print_summary(options, f"model written to {output}")
        print_summary(options, next_text(model, shlex.quote(str(output))))
    return DONE


def _fit_archive(options: argparse.Namespace, output: Path) -> int:
    from contextlib import ExitStack

    from uncertain_lti.base.files import sha256
    from uncertain_lti.identification.archive import fit_archive
    from uncertain_lti.reports.model_text import fit_text, next_text

    if options.discard:
        raise FitError("--discard goes through all transitions in memory; leave out --cache, --scheduler and --workers")
    if options.horizons is not None or options.widths is not None:
        raise FitError(
            "--horizons needs all recordings in memory; leave out --cache, --scheduler and --workers, or --horizons"
        )
    schedule = _asked(options)
    if options.group is not None:
        raise FitError("--group needs all recordings in memory; leave out --cache, --scheduler and --workers")
    if options.count != "sample":
        raise FitError("--count transient needs all recordings in memory; leave out --cache, --scheduler and --workers")
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
            model = fit_archive(
                options.bags,
                options.signals,
                options.criterion or "qp",
                options.additive,
                schedule=schedule,
                cache=options.cache,
                client=client,
                progress=step,
            )
    sources = [{**s, "sha256": sha256(s["file"])} for s in model.fit_summary["sources"]]
    model = model.replace(fit_summary={**model.fit_summary, "sources": sources})
    model.save(output)
    if options.json:
        print_json({"model": str(output), "fit": model.to_dict()["fit"]})
    else:
        print_summary(options, fit_text(model))
        print_summary(options, f"model written to {output}")
        print_summary(options, next_text(model, shlex.quote(str(output))))
    return DONE


def _local_cluster(dask: Any, workers: int) -> Any:
    """Worker processes that leave Ctrl-C to this one, which ends them."""
    from uncertain_lti.sampling.reading_processes import children_ignore_ctrl_c

    with children_ignore_ctrl_c():
        return dask.LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            host="127.0.0.1",
            dashboard_address=None,
            silence_logs=logging.CRITICAL,  # of work that is broken off; what goes wrong comes back as an error
        )


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


def _schedule(text: str) -> tuple[str, str, Any]:
    """A signal with its knots, how many, auto, or its modes."""
    name, given, knots = text.rpartition("=") if "=" in text else (text, "", "auto")
    if not name or (given and not knots):
        raise argparse.ArgumentTypeError(f"{text!r} is no schedule; write SIGNAL, SIGNAL=3 or SIGNAL=0.2,0.5,0.9")
    if knots == "auto":
        return name, "knots", knots
    kind, values = ("modes", knots[6:]) if knots.startswith("modes:") else ("knots", knots)
    try:
        if kind == "knots" and "," not in values:
            return name, kind, int(values)
        flags = {"false": 0.0, "true": 1.0} if kind == "modes" else {}
        return name, kind, [flags[v] if v in flags else float(v) for v in values.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{knots!r} is neither auto, a number of knots, knots such as 0.2,0.5,0.9 nor modes such as modes:1,2,3"
        ) from None


def _horizons(text: str) -> Any:
    """Auto, perhaps with the longest in seconds behind a colon, or seconds."""
    if text == "auto":
        return text
    try:
        if text.startswith("auto:"):
            return {"longest": float(text.removeprefix("auto:"))}
        return {"seconds": [float(value) for value in text.split(",")]}
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r} is neither auto, auto with the longest such as auto:1.0 nor seconds such as 0.1,0.5"
        ) from None


def _budget(text: str) -> float:
    """A whole number, or a share below 1."""
    try:
        return int(text) if text.isdigit() else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a whole number nor a share such as 0.001") from None


COMMAND = Command(
    "fit",
    "fit a model to recordings",
    add_arguments,
    run,
    quiet=SILENT,
    verbose="report every scan of the data, and what took how long",
)
