# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Command `uncertain-lti topics`: list the topics of a recording."""

from __future__ import annotations

import argparse

from uncertain_lti.base.english import printable
from uncertain_lti.cli.command import DONE, Command, print_json, print_notes

_LONGEST_NAME = 200  # letters
_LONGEST_LIST = 100_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `uncertain-lti topics`."""
    parser.add_argument("bag", metavar="BAG", help="recording (MCAP, .db3, .bag, table), or folder of one")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(options: argparse.Namespace) -> int:
    """Print the topics of a recording and what each holds."""
    from uncertain_lti.recordings.formats import open_recording
    from uncertain_lti.reports.tables import number, table

    bag = open_recording(options.bag)
    facts = bag.facts(options.progress.iterate("reading"))
    if options.json:
        print_json(
            {
                "recording": str(bag.path),
                "warnings": bag.warnings,
                "topics": [
                    {
                        "topic": f.info.topic,
                        "type": f.info.type,
                        "count": f.info.count,
                        "readable": f.info.readable,
                        "reason": f.info.reason,
                        "rate": f.rate,
                        "bursts": f.bursts,
                        "largest_gap": f.largest_gap,
                        "header_stamps": f.stamps,
                        "log_minus_header": f.stamp_offset,
                        "fields": list(f.fields),
                    }
                    for f in facts
                ],
            }
        )
        return DONE
    print_notes(options, bag.warnings)
    rows = []
    for f in facts:
        stamps: str = f.stamps
        if f.stamp_offset is not None and abs(f.stamp_offset) > 1.0:
            stamps += f", log {f.stamp_offset:+.0f} s"
        name, kind = printable(f.info.topic, _LONGEST_NAME), printable(f.info.type, _LONGEST_NAME)
        rate = f"{number(f.rate)} in bursts" if f.bursts else number(f.rate)
        rows.append([name, kind, str(f.info.count), rate, number(f.largest_gap), stamps])
    print(table(("topic", "type", "messages", "rate [1/s]", "largest gap [s]", "header stamps"), rows))
    for f in facts:
        if not f.info.readable or f.info.reason:
            print(printable(f"{printable(f.info.topic, _LONGEST_NAME)}: {f.info.reason}"))
        if f.fields:
            print(printable(f"{printable(f.info.topic, _LONGEST_NAME)}: {', '.join(f.fields)}", _LONGEST_LIST))
    return DONE


COMMAND = Command(
    "topics",
    "list the topics of a recording, and which fields could be signals",
    add_arguments,
    run,
    quiet="print the list and errors only: no notes, no progress",
)
