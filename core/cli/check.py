# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Command `uncertain-lti check`: check recordings against a model."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from uncertain_lti.cli.command import (
    ALARM,
    BAD_INPUT,
    DONE,
    SILENT,
    UNKNOWN,
    Command,
    add_model,
    add_recordings,
    load_model,
    print_json,
    print_notes,
    print_summary,
)
from uncertain_lti.cli.deployed import add_rule_arguments, checks, deployed_monitor


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `uncertain-lti check`."""
    add_model(parser, published=True)
    add_recordings(parser)
    add_rule_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print JSON with a verdict per sample")
    parser.add_argument(
        "--write",
        metavar="OUT.mcap",
        help="write a copy of the recording with bounds, utilisation and flags on topics of their own; "
        "for several recordings a folder",
    )


def run(options: argparse.Namespace) -> int:
    """Check each recording and return whether the alarm was raised.

    Of several recordings one that cannot be checked does not keep the others from it.
    """
    from uncertain_lti.base.english import plural
    from uncertain_lti.recordings.formats import group_recordings
    from uncertain_lti.reports.check_data import check_data, outcome
    from uncertain_lti.reports.check_text import check_text

    model = load_model(options.model)
    deployed = deployed_monitor(options, model)
    model = deployed.monitor.model  # with the rules that are judged by
    bags = group_recordings(options.bags, layout=model.signals.table)
    copies: Sequence[Path | None] = [None] * len(bags)
    if options.write is not None:
        from uncertain_lti.reports.annotate import annotate, targets

        copies = targets(options.write, bags)
    results = []
    refused: list[dict[str, str]] = []
    copy_of = dict(zip(bags, copies, strict=True))
    for bag, verdicts, decisions in checks("check", options, deployed, bags, refused):
        copy = copy_of[bag]
        data = check_data(model, verdicts, samples=options.json)
        results.append(data)
        print_summary(options, check_text(data) + (f" ({words})" if (words := deployed.words()) else ""))
        if copy is not None:
            writing = options.progress.iterate("writing")
            made = annotate(bag.parts, verdicts, decisions, copy, model, options.model, deployed.monitor.rule, writing)
            print_notes(options, made.notes)
            data["written"] = {"file": str(made.path), "topics": made.topics, "messages": made.messages}
            print_summary(
                options,
                f"{plural(made.messages, 'message')} and the verdicts below {made.topics} written to {made.path}",
            )
    strange = any(r["outcome"] == "unknown" for r in results)
    status = ALARM if any(r["alarm"] for r in results) else BAD_INPUT if refused else UNKNOWN if strange else DONE
    if options.json:
        of_all = "unknown" if refused and status != ALARM else outcome(results)
        ended = {"alarm": status == ALARM, "outcome": of_all, "exit_status": status}
        print_json(
            {
                "model": options.model,
                "deployed": deployed.words(),
                **ended,
                "recordings": results,
                "not_checked": refused,
            }
        )
    return status


COMMAND = Command(
    "check", "check a recording against a model", add_arguments, run, quiet=SILENT, verbose="say what took how long"
)
