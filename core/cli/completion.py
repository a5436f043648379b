# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Command `uncertain-lti completion`: print what a shell needs to complete commands, options and files."""

from __future__ import annotations

import argparse

from uncertain_lti.cli.command import DONE, Command

_FOLDERS = {"FOLDER"}
_FILES = {"BAG", "MODEL", "FILE"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `uncertain-lti completion`."""
    parser.add_argument(
        "shell",
        choices=("bash", "zsh"),
        help='whose; for this session: eval "$(uncertain-lti completion bash)", for each one: put that into ~/.bashrc '
        "or ~/.zshrc",
    )


def run(options: argparse.Namespace) -> int:
    """Print the script of a shell."""
    import shtab  # type: ignore[import-not-found, import-untyped, unused-ignore]

    parser = options.build_parser(every=True)
    commands = next(action.choices for action in parser._actions if isinstance(action.choices, dict))
    for command in commands.values():
        for action in command._actions:
            kind = str(action.metavar or "").partition(".")[0]
            if kind in _FOLDERS:
                action.complete = shtab.DIRECTORY
            elif kind in _FILES or "." in str(action.metavar or ""):
                action.complete = shtab.FILE
    print(shtab.complete(parser, shell=options.shell))
    return DONE


COMMAND = Command(
    "completion", "print what bash or zsh needs to complete commands, options and files", add_arguments, run
)
