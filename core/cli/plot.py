# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Command `uncertain-lti plot`: draw a model, recordings, or recordings checked against a model."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from uncertain_lti.base.errors import BagError, ModelError
from uncertain_lti.cli.command import (
    ALARM,
    BAD_INPUT,
    DONE,
    SILENT,
    Command,
    add_recordings,
    load_model,
    print_json,
    print_notes,
    print_summary,
)
from uncertain_lti.cli.deployed import add_rule_arguments, checks, deployed_monitor

if TYPE_CHECKING:
    from uncertain_lti import UncertainLTI
    from uncertain_lti.recordings.recording import Recording
    from uncertain_lti.reports.interactive import Plotted


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `uncertain-lti plot`."""
    add_recordings(
        parser,
        about="a model file (an image of its elements), recordings (their signals), or a model file and then "
        "recordings (what happened, and when)",
        metavar="WHAT",
    )
    parser.add_argument("--signals", metavar="FILE", help="signals file: draw its signals, not every number that moves")
    parser.add_argument(
        "--output",
        metavar="FILE",
        help="page (.html, with zoom and hover) or image (.png, .svg, .pdf) to write (default: plot.html, of a model "
        "alone plot.png)",
    )
    add_rule_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print the path, and whether the alarm was raised, as JSON")


def run(options: argparse.Namespace) -> int:
    """Write the plot."""
    from uncertain_lti.recordings.formats import group_recordings
    from uncertain_lti.reports.page_file import HOLDS, page_target

    named = _names_model(options.bags[0])
    model = load_model(options.bags[0]) if named else None
    paths = options.bags[1:] if named else options.bags
    if model is not None and options.signals:
        raise ModelError(f"--signals {options.signals}: the model has its signals; leave the option out")
    bags = group_recordings(paths, layout=None if model is None else model.signals.table) if paths else []
    output = Path(options.output or ("plot.html" if bags else "plot.png"))
    page = output.suffix == ".html"
    if output.suffix not in HOLDS:
        raise BagError(f"{output}: a plot is a page or an image; end the name in .html, .png, .svg or .pdf")
    if page and not bags:
        raise ModelError(f"{output}: a model alone is drawn as an image; end the name in .png, .svg or .pdf")
    if not page and model is None:
        raise BagError(f"{output}: recordings without a model are drawn as a page; end the name in .html")
    if not page and len(bags) > 1:
        raise BagError(f"{output}: an image shows one recording; name one, or end the name in .html")
    page_target(output, options.bags[0] if named else "", bags)
    status = DONE
    if model is None:
        _write("Recorded", bags, _recorded(options, bags), output)
    elif bags:
        status = _plot_check(options, model, bags, output)
    else:
        from uncertain_lti.reports.figures import matrices_figure, save

        save(matrices_figure(model), output, 200)
    print_summary(options, f"plot written to {output}")
    if options.json:
        recordings = [str(bag.path) for bag in bags]
        print_json({"plot": str(output), "recordings": recordings, "alarm": status == ALARM, "exit_status": status})
    return status


def _names_model(path: str) -> bool:
    """Whether the first word names a model: the published one, or a file that begins as JSON does."""
    if not os.path.exists(path):
        return path == "leibov2006" or path.endswith(".json")
    if not os.path.isfile(path):
        return False
    with open(path, "rb") as stream:
        return stream.read(100).lstrip()[:1] == b"{"


def _plot_check(options: argparse.Namespace, model: UncertainLTI, bags: list[Recording], output: Path) -> int:
    """Plot recordings that are checked; the exit status."""
    deployed = deployed_monitor(options, model)
    model = deployed.monitor.model  # with the rules that are judged by
    plotted: list[Plotted] = []
    alarm, checked, refused = False, 0, list[dict[str, str]]()
    for _, verdicts, _ in checks("plot", options, deployed, bags, refused):
        alarm, checked = alarm or bool(verdicts.alarm.any()), checked + 1
        if output.suffix == ".html":
            from uncertain_lti.reports.interactive import plotted_check

            plotted.append(plotted_check(model, verdicts, len(bags)))
        else:
            from uncertain_lti.reports.figures import alarm_figure, save

            save(alarm_figure(model, verdicts), output, 200)
    if not checked:
        raise BagError("no recording could be checked, so nothing is drawn; name one that has the topics of the model")
    if plotted:
        _write(os.path.basename(options.bags[0]), bags, plotted, output)
    return ALARM if alarm else BAD_INPUT if refused else DONE


def _recorded(options: argparse.Namespace, bags: list[Recording]) -> list[Plotted]:
    from uncertain_lti.reports.interactive import plotted_fields, plotted_transient

    if options.signals:
        from uncertain_lti import read_transients

        reading = options.progress.iterate("reading")
        runs = read_transients([bag.path for bag in bags], options.signals, progress=reading)
        for transient in runs:
            print_notes(options, transient.notes)
        return [plotted_transient(transient, len(runs)) for transient in runs]
    from uncertain_lti.base.english import shortlist
    from uncertain_lti.proposal.reading import moving_numbers

    plotted = []
    for bag in bags:
        fields, left = moving_numbers(bag, options.progress.iterate("reading"))
        print_notes(options, bag.warnings)
        if not fields:
            raise BagError(f"{bag.path}: no number in it moves; `uncertain-lti topics {bag.path}` lists what it holds")
        note = "Every number that moves, over the time of arrival." + f" Left out: {shortlist(left, 8)}." * bool(left)
        plotted.append(plotted_fields(str(bag.path), fields, note, len(bags)))
    return plotted


def _write(title: str, bags: list[Recording], plotted: list[Plotted], output: Path) -> None:
    from uncertain_lti.base.english import shortlist
    from uncertain_lti.reports.interactive import interactive_page
    from uncertain_lti.reports.page_file import write_page

    names = [os.path.basename(bag.path) or str(bag.path) for bag in bags]
    write_page(output, interactive_page(f"{title}: {shortlist(names, 1)}", plotted))


COMMAND = Command(
    "plot",
    "draw a model, recordings, or what happened in recordings by a model",
    add_arguments,
    run,
    quiet=SILENT,
    verbose="say what took how long",
)
