# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Command `uncertain-lti report`: write a page about a model and recordings."""

from __future__ import annotations

import argparse

from uncertain_lti.cli.command import (
    ALARM,
    BAD_INPUT,
    DONE,
    SILENT,
    Command,
    add_model,
    add_recordings,
    load_model,
    print_json,
    print_summary,
)
from uncertain_lti.cli.deployed import add_rule_arguments, checks, deployed_monitor


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `uncertain-lti report`."""
    add_model(parser, published=True)
    add_recordings(parser, " to check against it")
    add_rule_arguments(parser)
    parser.add_argument("--output", metavar="FILE.html", help="page to write (default: report.html; with --json none)")
    parser.add_argument("--json", action="store_true", help="print the same facts as JSON")


def run(options: argparse.Namespace) -> int:
    """Write the page or print its facts, and return whether the alarm was raised."""
    from uncertain_lti.recordings.formats import group_recordings
    from uncertain_lti.reports.findings import findings
    from uncertain_lti.reports.findings_text import findings_text
    from uncertain_lti.reports.page_file import page_target

    model = load_model(options.model)
    bags = group_recordings(options.bags, layout=model.signals.table)
    output = options.output or (None if options.json else "report.html")
    if output is not None:
        page_target(output, options.model, bags)
    deployed = deployed_monitor(options, model)
    model = deployed.monitor.model  # with the rules that are judged by
    refused: list[dict[str, str]] = []
    checked = [verdicts for _, verdicts, _ in checks("report", options, deployed, bags, refused)]
    if not checked:
        return BAD_INPUT
    facts = findings(model, options.model, checked, deployed.monitor.rule, deployed.words())
    print_summary(options, findings_text(facts))
    if output is not None:
        from uncertain_lti.reports.html import html_report
        from uncertain_lti.reports.page_file import write_page

        write_page(output, html_report(model, checked, facts, options.progress.iterate("drawing", "sections")))
        print_summary(options, f"report written to {output}")
    if options.json:
        print_json({**facts, "not_checked": refused})
    return ALARM if facts["alarm"] else BAD_INPUT if refused else DONE


COMMAND = Command(
    "report",
    "write a page that says whether a model may be relied on, and what happened in recordings",
    add_arguments,
    run,
    quiet=SILENT,
    verbose="say what took how long",
)
