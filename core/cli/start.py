# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Command `uncertain-lti start`: from recordings to a monitor, by `init`, `fit` and `report` as they are."""

from __future__ import annotations

import argparse
import io
import json
import os
import shlex
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from uncertain_lti.base.errors import SignalError
from uncertain_lti.cli.command import (
    SILENT,
    Command,
    add_force,
    add_recordings,
    model_target,
    print_json,
    print_summary,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `uncertain-lti start`."""
    add_recordings(parser, " of the healthy machine")
    parser.add_argument(
        "--check", metavar="BAG", nargs="+", default=[], help="recordings to report on (default: those that are fitted)"
    )
    parser.add_argument(
        "--output",
        metavar="NAME",
        default="machine",
        help="write NAME.yaml, which is used as it is if it is there already, NAME.model.json and NAME.html "
        "(default: machine)",
    )
    add_force(parser)
    parser.add_argument("--json", action="store_true", help="print what init, fit and report say, as JSON")


def run(options: argparse.Namespace) -> int:
    """Propose signals, fit, report, and print what puts the model on the robot; the exit status of the report."""
    from uncertain_lti.reports.findings_text import findings_text
    from uncertain_lti.reports.page_file import page_target

    signals, model, page = (f"{options.output}{ending}" for ending in (".yaml", ".model.json", ".html"))
    if not os.path.basename(options.output):
        raise SignalError(f"--output '{options.output}' names no file; give a name such as machine or models/machine")
    model_target(model, options.force)  # what cannot be written is found before the work
    page_target(page, model, [])
    parts: dict[str, Any] = {"signals": signals, "model": model, "report": page}
    if os.path.exists(signals):
        print_summary(options, f"signals: as {signals} has them")
    else:
        parts["init"] = _data(options, ["init", *options.bags, "--output", signals])[1]
        for kind in ("states", "controls"):
            names = ", ".join(signal["name"] for signal in parts["init"][kind])
            print_summary(options, f"{kind}: {names or 'none found'}")
        print_summary(options, f"signals file written to {signals}: it says why; edit it and start again with --force")
    forced = ["--force"] * options.force
    parts["fit"] = _data(options, ["fit", *options.bags, "--signals", signals, "--output", model, *forced])[1]
    status, facts = _data(options, ["report", model, *(options.check or options.bags), "--output", page])
    parts["findings"] = facts
    if facts is None:  # no recording could be checked, which is said
        return status
    print_summary(options, findings_text(facts))
    print_summary(options, f"what happened and when: {Path(page).resolve().as_uri()}")
    print_summary(options, _on_the_robot(model))
    if options.json:
        print_json({**parts, "exit_status": status})
    return status


def _data(options: argparse.Namespace, words: list[str]) -> tuple[int, Any]:
    """Run a command of this program; its exit status and what it prints with --json, if anything."""
    command = options.build_parser(words[0]).parse_args([*words, "--json"])
    command.progress = options.progress
    with redirect_stdout(io.StringIO()) as printed:
        status = int(command.run(command))
    text = printed.getvalue()
    return status, json.loads(text) if text else None


def _on_the_robot(model: str) -> str:
    file = os.path.basename(model)
    return (
        "on the robot, with this program installed there:\n"
        f"  scp {shlex.quote(model)} ROBOT:\n"
        f"  envelope_monitor --ros-args -p model:={shlex.quote(file)}\n"
        "  ros2 topic echo /envelope_monitor/violation"
    )


COMMAND = Command(
    "start",
    "from recordings of the healthy machine to a monitor: init, fit and report in one go",
    add_arguments,
    run,
    quiet=SILENT,
    verbose="report every scan of the data, and what took how long",
)
