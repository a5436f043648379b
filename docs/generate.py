# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Parts of the reference that come from the program: every command, and every parameter and output of the node."""

import argparse
import os
import re
from pathlib import Path

COMMANDS, PARAMETERS, TOPICS = "commands.generated.md", "parameters.generated.md", "topics.generated.md"


def write(folder: Path) -> None:
    """Write all parts to a folder, where they differ from what is there."""
    for name, text in ((COMMANDS, commands()), (PARAMETERS, parameters()), (TOPICS, topics())):
        path = folder / name
        if not path.exists() or path.read_text() != text:
            path.write_text(text)


def parsers() -> dict[str, argparse.ArgumentParser]:
    """Name -> arguments of every command."""
    from uncertain_lti.cli.main import build_parser

    def subparsers(chosen: str) -> dict[str, argparse.ArgumentParser]:
        actions = build_parser(chosen)._subparsers._group_actions  # argparse has no public way
        return dict(actions[0].choices)

    return {name: subparsers(name)[name] for name in subparsers("")}


def commands() -> str:
    """Markdown with a section for each command."""
    os.environ["COLUMNS"] = "96"
    parts = []
    for name, parser in parsers().items():
        usage = re.sub(r"\n +", "\n    ", parser.format_usage().removeprefix("usage: ").strip())
        lines = [f"## {name}", "", _escape(parser.description or ""), "", "```text", usage, "```", ""]
        rows = []
        for action in sorted(parser._actions, key=lambda a: bool(a.option_strings)):  # a stable sort
            if isinstance(action, argparse._HelpAction):
                continue
            rows.append((_called(action), _escape(action.help or "")))
        if rows:
            lines += ["| argument | meaning |", "|---|---|", *(f"| `{a}` | {b} |" for a, b in rows), ""]
        parts.append("\n".join(lines))
    return "\n".join(parts)


def _called(action: argparse.Action) -> str:
    metavar = action.metavar or (
        "{" + ",".join(map(str, action.choices)) + "}" if action.choices else action.dest.upper()
    )
    if not action.option_strings:
        return str(metavar)
    value = "" if action.nargs == 0 else f" {metavar}"
    return ", ".join(action.option_strings) + value


def _escape(text: str) -> str:
    return re.sub(r"([|*<>\[\]])", r"\\\1", text.replace("%%", "%"))


def parameters() -> str:
    """Markdown table of the parameters of envelope_monitor."""
    from uncertain_lti_ros.parameters import PARAMETERS as DECLARED

    rows = ["| parameter | default | range | at run time | meaning |", "|---|---|---|---|---|"]
    for p in DECLARED:
        default = '""' if p.default == "" else str(p.default).lower() if isinstance(p.default, bool) else str(p.default)
        limits = "" if p.low is None else f"{p.low:g} to {p.high:g}"
        rows.append(f"| `{p.name}` | `{default}` | {limits} | {'no' if p.fixed else 'yes'} | {_escape(p.text)} |")
    return "\n".join(rows) + "\n"


def topics() -> str:
    """Markdown table of the topics that envelope_monitor publishes."""
    from uncertain_lti.monitor.outputs import OUTPUTS

    rows = ["| topic | type | content |", "|---|---|---|"]
    rows += [f"| `{o.name}` | {o.type.replace('/msg/', '/')} | {o.text} |" for o in OUTPUTS]
    return "\n".join(rows) + "\n"
