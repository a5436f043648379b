# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Command `uncertain-lti init`: propose a signals file."""

from __future__ import annotations

import argparse
import os
import shlex

from uncertain_lti.base.errors import SignalError
from uncertain_lti.cli.command import DONE, Command, add_recordings, print_json, print_notes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `uncertain-lti init`."""
    add_recordings(parser, " of the same machine")
    parser.add_argument(
        "--output", metavar="FILE", help="signals file to write; must not exist yet (default: print it)"
    )
    parser.add_argument(
        "--states",
        metavar="TOPIC[:FIELD]",
        nargs="+",
        default=[],
        help="what may be a state, in place of what looks like one; * stands for any letters",
    )
    parser.add_argument("--controls", metavar="TOPIC[:FIELD]", nargs="+", default=[], help="likewise for the controls")
    parser.add_argument(
        "--like",
        metavar="MEMBER",
        default="",
        help="of many alike (joints, motors) the one that the file is drawn up for, such as j3",
    )
    parser.add_argument("--json", action="store_true", help="print what is proposed as JSON, with the text of the file")


def run(options: argparse.Namespace) -> int:
    """Write or print the proposed signals file."""
    from uncertain_lti.base.english import shortlist
    from uncertain_lti.base.files import whole_file
    from uncertain_lti.proposal.init import propose

    output = options.output
    if output is not None and os.path.exists(output):
        raise SignalError(f"{output}: is there already; choose another output, or move it away")
    proposal = propose(
        options.bags,
        options.progress.iterate("reading"),
        states=options.states,
        controls=options.controls,
        like=options.like,
    )
    print_notes(options, proposal.warnings)
    if output is None and not options.json:
        print(proposal.text, end="")
        return DONE
    if output is not None:
        try:
            with whole_file(output) as stream:
                stream.write(proposal.text.encode())
        except OSError as error:
            raise SignalError(f"{output}: cannot be written: {error.strerror}; choose another place") from None
    if options.json:
        proposed = {
            kind: [
                {"name": c.name, "topic": c.topic, "field": c.path, "unit": c.unit, "delay": c.delay} for c in of_kind
            ]
            for kind, of_kind in (("states", proposal.states), ("controls", proposal.controls))
        }
        more = {"members": list(proposal.members), "warnings": list(proposal.warnings), "text": proposal.text}
        print_json({"output": output, **proposed, **more})
        return DONE
    alike = f"and the same for each of {shortlist(proposal.members, 12)}\n" if proposal.members else ""
    options.progress.say(
        f"states: {', '.join(c.name for c in proposal.states)}\n"
        f"controls: {', '.join(c.name for c in proposal.controls) or 'none found'}\n{alike}"
        f"signals file written to {output}: read it and edit it, it says why; then\n"
        f"  uncertain-lti fit {shlex.join(options.bags)} --signals {shlex.quote(output)} --output machine.model.json"
    )
    return DONE


COMMAND = Command(
    "init",
    "propose a signals file for a recording, with reasons, for you to edit",
    add_arguments,
    run,
    quiet="print errors only (and without --output the file): no summary, no notes, no progress",
)
