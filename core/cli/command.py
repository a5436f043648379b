# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What every command shares: its declaration, exit statuses, printing, and the model named on the command line."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from uncertain_lti.base.errors import ModelError
from uncertain_lti.base.text import printable
from uncertain_lti.cli.options import Option, declare

if TYPE_CHECKING:
    from uncertain_lti import Transient, UncertainLTI
    from uncertain_lti.signals.signal_map import SignalMap

DONE, ALARM, BAD_INPUT, UNKNOWN, NOT_READ = 0, 1, 2, 3, 141
"""Exit statuses: 1 means that the alarm was raised, and nothing else; 3 that a check says nothing of the machine.

141, as shells have it, says that the reader of the output went away before it was
known whether there is an alarm. Two more are in `uncertain_lti.cli`.
"""


@dataclass(frozen=True)
class Result:
    """What a command comes to: `data` for --json, if it has any; else `text`, which --quiet prints as well."""

    status: int = DONE
    data: Any = None
    text: str = ""


@dataclass(frozen=True)
class Command:
    """One command of `uncertain-lti`.

    The files of this room declare them, and `main.COMMANDS` lists them. A file imports at its top nothing that
    takes time to load: every command is declared whenever one is run.

    `name`: the word on the command line; `help`: what the command does, for the list of commands; `options`: its
    arguments and options; `run`: runs the command with the parsed options and returns its result; it prints nothing:
    `options.say` takes the summary for a person part by part, and `options.progress` is a `Progress`; `quiet`: what
    `--quiet` does, for the help; empty if the command has no such option; `verbose`: what `--verbose` does, likewise;
    `of_ros`: module of `uncertain_lti_ros` that declares every option, `--quiet` too, and runs; not every installation
    has what it imports.
    """

    name: str
    help: str
    options: tuple[Option, ...] = ()
    run: Callable[[argparse.Namespace], Result] | None = None
    quiet: str = "print errors only (and with --json the data): no summary, no notes, no progress"
    verbose: str = ""
    of_ros: str = ""

    def declare(self, parser: argparse.ArgumentParser, chosen: str, every: bool) -> None:
        """Declare the arguments on a parser; those of a module of ROS if it is chosen, or where it can be imported."""
        if self.run is not None:
            declare(parser, self.options)
            parser.set_defaults(run=self.run)
        elif every or self.name == chosen:
            with nullcontext() if self.name == chosen else suppress(ModuleNotFoundError):
                module = import_module(f"uncertain_lti_ros.{self.of_ros}")
                module.add_arguments(parser)
                parser.set_defaults(run=module.run)


def run(options: argparse.Namespace) -> int:
    """Run the command of parsed options and print what came of it."""
    options.say = partial(_print_summary, options)
    result: Result = options.run(options)
    if getattr(options, "json", False):
        if result.data is not None:
            json.dump(result.data, sys.stdout, allow_nan=False, indent=1)
            sys.stdout.write("\n")
    elif result.text:
        print(result.text)
    return int(result.status)


def _print_summary(options: argparse.Namespace, text: str) -> None:
    """Print part of the summary for a person, unless JSON is asked for or nothing at all.

    What is to be written is written also when `| head` has read enough; only a check has nothing more to do.
    """
    if not getattr(options, "json", False):
        try:
            options.progress.say(text)
        except BrokenPipeError:
            if options.command == "check":
                raise
            drop_output()


def drop_output(stream: TextIO | None = None) -> None:
    """Let the end of the process find nothing that it cannot write; default standard output."""
    with suppress(OSError, AttributeError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), (stream or sys.stdout).fileno())


def complain(command: str, text: str) -> None:
    """Print an error on standard error, if anybody listens."""
    try:
        print(f"uncertain-lti {command}: {printable(text)}".replace(" :", ":"), file=sys.stderr, flush=True)
    except (OSError, AttributeError):
        drop_output(sys.stderr)


def load_model(name: str) -> UncertainLTI:
    """Load the model of a file, or the published one by its name."""
    from uncertain_lti import UncertainLTI
    from uncertain_lti.base.text import meant
    from uncertain_lti.plants.leibov import leibov2006

    if not os.path.exists(name):
        if name == "leibov2006":
            return leibov2006()
        if near := meant(name, ["leibov2006"]):
            raise ModelError(f"{name}: there is no such model file{near}; write one with `uncertain-lti fit`")
    return UncertainLTI.load(name)


def read_fitted(options: argparse.Namespace, bags: Iterable[str], signals: SignalMap) -> Iterator[Transient]:
    """Read recordings as a model has its signals."""
    from uncertain_lti.recordings.formats import group_recordings
    from uncertain_lti.sampling.reading import read_as_fitted

    for bag in group_recordings(bags, layout=signals.table):
        transient = read_as_fitted(bag, signals, options.progress.iterate("reading"))
        options.progress.note(*transient.notes)
        yield transient


def read_labelled(
    options: argparse.Namespace, pairs: Iterable[tuple[str, str]], signals: SignalMap
) -> Iterator[tuple[str, Transient]]:
    """Read recordings of known faults as a model has its signals."""
    for label, name in pairs:
        for transient in read_fitted(options, [name], signals):
            yield label, transient


def model_target(path: str, force: bool, bags: Iterable[str] = ()) -> Path:
    """Where a model file of some recordings goes; with force an older one is replaced, and nothing else ever."""
    from uncertain_lti.base.errors import BagError
    from uncertain_lti.base.files import target

    for bag in bags:
        if bag.encode(errors="ignore").decode() != bag:
            raise BagError(f"{bag}: this name is not UTF-8, and a model file names its recordings; rename it first")
    chosen = target(path, holds=b'"uncertain-lti/', kind="model file", example="machine.model.json")
    if not force and chosen.is_file() and chosen.stat().st_size:
        raise BagError(f"{path}: a model is there already; choose another name, or write over it with --force")
    return chosen
