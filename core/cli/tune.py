# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Command `uncertain-lti tune`: what fit does not try by itself."""

from __future__ import annotations

import argparse
import math
import os
import re

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
    read_labelled,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `uncertain-lti tune`."""
    add_recordings(parser, " of the healthy machine; LABEL=BAG is one of a machine with the fault LABEL")
    add_signals(parser)
    parser.add_argument(
        "--false-alarms", type=float, metavar="PER_HOUR", help="as in fit (default: what the recordings can show)"
    )
    parser.add_argument(
        "--budget", type=_time, default=math.inf, metavar="TIME", help="stop after 90s, 10m or 1h with the best so far"
    )
    parser.add_argument("--group", metavar="KEY", help=GROUP)
    add_output(parser, required=False)
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(options: argparse.Namespace) -> int:
    """Try the ways, print them, and write the model that was chosen."""
    from uncertain_lti import Transient, read_transients, tune
    from uncertain_lti.base.files import sha256
    from uncertain_lti.reports.model_text import alarm_text, headline_text
    from uncertain_lti.reports.validation_text import tune_text
    from uncertain_lti.validation.groups import resolve_groups

    output = None if options.output is None else model_target(options.output, options.force)
    healthy = [bag for bag in options.bags if _label(bag) is None]
    if not healthy:
        raise FitError("no recording of the healthy machine is named; give at least one without a label")
    transients = read_transients(healthy, options.signals, options.progress.iterate("reading"), processes=None)
    for transient in transients:
        print_notes(options, transient.notes)
    resolve_groups(transients, options.group)
    signals = transients[0].signals
    assert signals is not None
    faulty: dict[str, list[Transient]] = {}
    pairs = [(label, bag.partition("=")[2]) for bag in options.bags if (label := _label(bag)) is not None]
    for label, run in read_labelled(options, pairs, signals):
        faulty.setdefault(label, []).append(run)
    with options.progress.stage("tuning") as step:
        tuned = tune(
            transients,
            options.false_alarms,
            budget=options.budget,
            groups=options.group,
            faulty=faulty,
            progress=step,
        )
    data = tuned.to_dict()
    if options.json:
        print_json({"model": options.output, "tune": data})
    else:
        print_summary(options, headline_text(tuned.model))
        print_summary(options, tune_text(data))
        print_summary(options, alarm_text(tuned.model))
    if output is not None:
        files = dict.fromkeys(name for t in transients for name in t.sources)
        sources = [{"file": name, "sha256": sha256(name)} for name in files]
        facts = {**tuned.model.fit_summary, "sources": sources}
        facts |= {"group": options.group} if options.group is not None else {}
        tuned.model.replace(fit_summary=facts).save(output)
        print_summary(options, f"model written to {output}")
    return DONE


def _label(text: str) -> str | None:
    """The label of LABEL=BAG; None for a recording without one."""
    label, given, path = text.partition("=")
    return label if given and path and not os.path.exists(text) and os.sep not in label else None


def _time(text: str) -> float:
    """Seconds of 90, 90s, 10m or 1h."""
    match = re.fullmatch(r"\s*([0-9.]+)\s*(s|m|min|h)?\s*", text)
    try:
        seconds = float(match[1]) * {"s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}[match[2] or "s"] if match else 0.0
    except ValueError:
        seconds = 0.0
    if not 0 < seconds < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is no time; write 90s, 10m or 1h")
    return seconds


COMMAND = Command(
    "tune",
    "try delays, schedules and lags, and take what sees clearly smaller jumps than fit",
    add_arguments,
    run,
    quiet=SILENT,
    verbose="say every way that is tried, and what took how long",
)
