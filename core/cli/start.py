# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Commands `topics`, `init` and `start`: from recordings that nobody described yet to a signals file and a monitor."""

from __future__ import annotations

import argparse
import os
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from uncertain_lti.base.errors import SignalError
from uncertain_lti.base.text import printable, shortlist
from uncertain_lti.cli.command import RECORDINGS, Result, declared, helped, load_model, model_target
from uncertain_lti.signals.values import TableLayout

_LONGEST_NAME = 200  # letters
_LONGEST_LIST = 100_000


# --- topics ----------------------------------------------------------------------------------------------------------


@declared(
    "list the topics of a recording, and which fields could be signals",
    *("bag", "--table", "--json"),
    quiet="print the list and errors only: no notes, no progress",
)
def topics(options: argparse.Namespace) -> Result:
    """Print the topics of a recording and what each holds."""
    from uncertain_lti.base.text import Table, number
    from uncertain_lti.recordings.formats import open_recording

    bag = open_recording(options.bag, layout=_layout(options))
    facts = bag.facts(options.progress.iterate("reading"))
    if options.json:
        held = [
            {**{key: getattr(f.info, key) for key in ("topic", "type", "count", "readable", "reason")}, "rate": f.rate,
             "bursts": f.bursts, "largest_gap": f.largest_gap, "header_stamps": f.stamps,
             "log_minus_header": f.stamp_offset, "fields": list(f.fields)}
            for f in facts
        ]  # fmt: skip
        return Result(data={"recording": str(bag.path), "warnings": bag.warnings, "topics": held})
    options.progress.note(*bag.warnings)
    rows = []
    for f in facts:
        stamps: str = f.stamps
        if f.stamp_offset is not None and abs(f.stamp_offset) > 1.0:
            stamps += f", log {f.stamp_offset:+.0f} s"
        name, kind = printable(f.info.topic, _LONGEST_NAME), printable(f.info.type, _LONGEST_NAME)
        rate = f"{number(f.rate)} in bursts" if f.bursts else number(f.rate)
        rows.append([name, kind, str(f.info.count), rate, number(f.largest_gap), stamps])
    header = ("topic", "type", "messages", "rate [1/s]", "largest gap [s]", "header stamps")
    lines = [str(Table(header, rows, most=len(rows)))] if rows else [f"{bag.path}: there is no topic in it"]
    for f in facts:
        name = printable(f.info.topic, _LONGEST_NAME)
        if not f.info.readable or f.info.reason:
            lines.append(printable(f"{name}: {f.info.reason}"))
        if f.fields:
            lines.append(printable(f"{name}: {', '.join(f.fields)}", _LONGEST_LIST))
    return Result(text="\n".join(lines))


def _layout(options: argparse.Namespace) -> TableLayout:
    """What --table says of the columns of tables."""
    from uncertain_lti.recordings.table import is_table

    paths = [options.bag] if "bag" in options else [*options.bags, *(getattr(options, "check", None) or [])]
    if options.table and not any(is_table(Path(path)) for path in paths):
        raise SignalError(f"--table: says how a table is read, and {shortlist(paths, 3)} is none; leave it out")
    return TableLayout.from_dict(dict(pair.partition("=")[::2] for pair in options.table), "--table")


# --- init ------------------------------------------------------------------------------------------------------------


@declared(
    "propose a signals file for a recording, with reasons, for you to edit",
    helped("bags", f"{RECORDINGS} of the same machine"),
    helped("--output", "signals file to write; must not exist yet (default: print it)", metavar="FILE"),
    *("--states", "--controls", "--like", "--table"),
    helped("--json", "print what is proposed as JSON, with the text of the file"),
    quiet="print errors only (and without --output the file): no summary, no notes, no progress",
)
def init(options: argparse.Namespace) -> Result:
    """Write or print the proposed signals file."""
    from uncertain_lti.base.files import target, written
    from uncertain_lti.proposal.init import propose

    output = options.output
    if output is not None:
        if os.path.exists(output):
            raise SignalError(f"{output}: is there already; choose another output, or move it away")
        target(output, holds=b"", kind="signals file", example="signals.yaml")
    seeking, reading = options.progress.iterate("seeking what acts when", "delays"), options.progress.iterate("reading")
    chosen = {"states": options.states, "controls": options.controls, "delays": seeking}
    proposal = propose(options.bags, reading, **chosen, like=options.like, table=_layout(options))
    options.progress.note(*proposal.warnings)
    proposed = {
        kind: [{"name": c.name, "topic": c.topic, "field": c.path, "unit": c.unit, "delay": c.delay} for c in of_kind]
        for kind, of_kind in (("states", proposal.states), ("controls", proposal.controls))
    }
    more = {"members": list(proposal.members), "warnings": list(proposal.warnings), "text": proposal.text}
    data = {"output": output, **proposed, **more}
    if output is None:
        return Result(data=data, text=proposal.text.removesuffix("\n"))
    with written(output, SignalError, new=True) as stream:
        stream.write(proposal.text.encode())
    options.say(
        f"{_proposed(data)}\n"
        f"signals file written to {output}: read it and edit it, it says why; then\n"
        f"  uncertain-lti fit {shlex.join(options.bags)} --signals {shlex.quote(output)} --output machine.model.json"
    )
    return Result(data=data)


def _proposed(data: Mapping[str, Any]) -> str:
    named = {kind: shortlist([signal["name"] for signal in data[kind]], 12) for kind in ("states", "controls")}
    alike = f"\nand the same for each of {shortlist(data['members'], 12)}" if data["members"] else ""
    return f"states: {named['states']}\ncontrols: {named['controls'] or 'none found'}{alike}"


# --- start -----------------------------------------------------------------------------------------------------------


_WRITTEN = "write NAME.yaml, which is used as it is if it is there already, NAME.model.json and NAME.html"


@declared(
    "from recordings of the healthy machine to a monitor: init, fit and report in one go",
    helped("bags", f"{RECORDINGS} of the healthy machine"),
    *("--check", "--table"),
    helped("--output", f"{_WRITTEN} (default: machine)", metavar="NAME", default="machine"),
    "--force",
    helped("--json", "print what init, fit and report say, as JSON"),
    verbose="report every scan of the data, and what took how long",
)
def start(options: argparse.Namespace) -> Result:
    """Propose signals, fit, report, and print what puts the model on the robot; the exit status of the report."""
    from uncertain_lti.recordings.formats import group_recordings
    from uncertain_lti.reports.findings import NO, findings_text
    from uncertain_lti.reports.pages import page_target
    from uncertain_lti.signals.values import of_table

    endings = (".yaml", ".model.json", ".html")
    name = next((options.output.removesuffix(e) for e in endings if options.output.endswith(e)), options.output)
    signals, model, page = (f"{name}{ending}" for ending in endings)
    if not os.path.basename(name):
        raise SignalError(f"--output '{options.output}' names no file; give a name such as machine or models/machine")
    model_target(model, options.force, options.bags)  # what cannot be written is found before the work
    page_target(page, model, [])
    parts: dict[str, Any] = {"signals": signals, "model": model, "report": page}
    if os.path.exists(signals):
        if options.table:
            raise SignalError(f"{signals} is there and is used as it is; write under `table` in it what --table says")
        options.say(f"signals: as {signals} has them")
    else:
        group_recordings(options.check or [], layout=_layout(options))
        table = ["--table", *options.table] * bool(options.table)
        parts["init"] = _part(options, ["init", *options.bags, "--output", signals, *table]).data
        options.say(_proposed(parts["init"]))
        options.say(f"signals file written to {signals}: it says why; edit it and start again with --force")
    forced = ["--force"] * options.force
    fit = ["fit", *options.bags, "--signals", signals, "--output", model, *forced]
    parts["fit"] = _part(options, fit).data
    report = _part(options, ["report", model, *(options.check or options.bags), "--output", page])
    if report.data is None:  # no recording could be checked, which is said
        return report
    options.say(findings_text(report.data))
    then = (
        "on the robot, with this program installed there (docs/howto/deploy.md):\n"
        f"  scp {shlex.quote(model)} ROBOT:\n"
        f"  envelope_monitor --ros-args -p model:={shlex.quote(os.path.basename(model))}\n"
        "  ros2 topic echo /envelope_monitor/violation"
    )
    if any(map(of_table, load_model(model).signals.topics)):
        then = "not on a robot: no publisher sends a table; for that, start with recordings of the robot's topics"
    if report.data["rely"]["answer"] == NO:
        then = f"not on the robot yet: mend what is said above, in {signals} or by recording, and start with --force"
    options.say(f"what happened and when: {Path(page).resolve().as_uri()}\n{then}")
    return Result(report.status, {**parts, "findings": report.data, "exit_status": report.status})


def _part(options: argparse.Namespace, words: list[str]) -> Result:
    """Run a command of this program as with --json, but for what it says of recordings that lose much."""
    command = options.build_parser(words[0]).parse_args([*words, "--json"])
    command.progress, command.say, command.say_losses = options.progress, lambda text: None, options.say
    return command.run(command)  # type: ignore[no-any-return]
