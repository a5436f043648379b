# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The program `uncertain-lti`: its commands, of which the small ones are here, and how errors are reported."""

from __future__ import annotations

import argparse
import io
import os
import re
import signal
import sys
import threading
import traceback
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NoReturn

from uncertain_lti import __version__
from uncertain_lti.base.errors import BagError, ModelError, UncertainLTIError, absent
from uncertain_lti.base.progress import Progress
from uncertain_lti.cli import FAULT, INTERRUPTED, fit, interrupted, judge, start
from uncertain_lti.cli.command import (
    BAD_INPUT,
    DONE,
    NOT_READ,
    PUBLISHED,
    Command,
    Result,
    complain,
    declared,
    drop_output,
    helped,
    load_model,
    run,
)


@declared(
    "show what is in a model file",
    PUBLISHED,
    helped("--json", "print the file as JSON; of a scheduled model with `regimes`, what each rests on"),
    quiet="",
)
def info(options: argparse.Namespace) -> Result:
    """Print the model."""
    from uncertain_lti.base.text import finite_data
    from uncertain_lti.model.interchange import block_facts
    from uncertain_lti.reports.model_text import model_text

    model = load_model(options.model)
    if options.json:
        regimes = finite_data(block_facts(model))
        return Result(data=model.replace(memory=None).to_dict() | ({"regimes": regimes} if regimes else {}))
    try:
        return Result(text=model_text(model))
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        odd = f"what it says of its own fit is odd ({type(error).__name__}: {error})"
        raise ModelError(f"{options.model}: {odd}; fit it again, or print it with --json") from None


@declared(
    "write layouts of viewers for what a model's monitor publishes",
    *(PUBLISHED, "--foxglove", "--plotjuggler", "--topics", helped("--json", "print the paths as JSON")),
    quiet="",
)
def layout(options: argparse.Namespace) -> Result:
    """Write the layouts that are asked for."""
    from uncertain_lti.reports.layouts import write_layouts

    written = write_layouts(load_model(options.model), options.foxglove, options.plotjuggler, options.topics)
    data = {"model": options.model, "layouts": [str(path) for path in written]}
    return Result(data=data, text="\n".join(f"layout written to {path}" for path in written))


@declared(
    "run the paper's experiment on the nonlinear turbofan",
    helped("--output", "for figures, models and numbers", default="reproduce-output", metavar="FOLDER"),
    helped("--json", "print the numbers as JSON"),
    quiet="print errors only; everything is in the folder",
)
def reproduce(options: argparse.Namespace) -> Result:
    """Run the experiment into a folder."""
    from uncertain_lti.plants.reproduce import reproduce

    try:
        with options.progress.stage("reproducing") as step:
            data = reproduce(options.output, options.say, step)
    except OSError as error:
        raise BagError(f"{options.output}: cannot be written: {error.strerror}; choose another folder") from None
    return Result(data={"output": options.output, **data})


@declared("print what bash or zsh needs to complete commands, options and files", "shell", quiet="")
def completion(options: argparse.Namespace) -> Result:
    """Print the script of a shell."""
    import shtab  # type: ignore[import-not-found, import-untyped, unused-ignore]

    parser = build_parser(every=True)
    commands = next(action.choices for action in parser._actions if isinstance(action.choices, dict))
    for command in commands.values():
        for action in command._actions:
            kind = str(action.metavar or "").partition(".")[0]
            if kind == "FOLDER":
                action.complete = shtab.DIRECTORY
            elif kind in ("BAG", "MODEL", "FILE") or "." in str(action.metavar or ""):
                action.complete = shtab.FILE
    return Result(text=shtab.complete(parser, shell=options.shell))


PLAY = Command("play", "publish a recording through rclpy", of_ros="player")
RECORD = Command("record", "record topics through rclpy", of_ros="recorder")
WATCH = Command("watch", "show on a page of this machine what a running monitor says", of_ros="watch")
_DEMO = "fit shipped recordings of a turbofan and watch another, in which a fault sets in, live"
DEMO = Command("demo", _DEMO, of_ros="demo")

COMMANDS: tuple[Command, ...] = (
    start.start, start.topics, start.init, fit.fit, fit.tune, judge.check, judge.report, judge.plot, layout,
    fit.validate, fit.signature, info, reproduce, PLAY, RECORD, WATCH, DEMO, completion,
)  # fmt: skip
"""Every command, in the order of the help."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    command = next((a for a in given if not a.startswith("-")), "")
    live = any(c.of_ros for c in COMMANDS if c.name == command)
    for stream in (sys.stdout, sys.stderr):  # a name that the terminal has no letters for ends nothing
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace", line_buffering=live or None)
    sys.unraisablehook = _keep_interrupt
    try:
        try:
            return _run(command, given)
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()  # what cannot be written is found while it can still be said
    except BrokenPipeError:  # `| head` has read enough
        drop_output()
        return NOT_READ if command in ("check", "report", "plot") else DONE
    except OSError as error:
        drop_output()
        why = error.strerror or error
        return _refuse(command, f"the output cannot be written ({why}); make room, or send it elsewhere")


def _keep_interrupt(unraisable: Any) -> None:
    """A Ctrl-C that comes in a callback, where Python passes over it, comes again a moment later."""
    if unraisable.exc_type is KeyboardInterrupt:
        threading.Timer(0.01, os.kill, (os.getpid(), signal.SIGINT)).start()
    else:
        sys.__unraisablehook__(unraisable)


def _run(command: str, given: Sequence[str]) -> int:
    """Run one command; raises OSError where its output cannot be written."""
    try:
        options = build_parser(command).parse_args(given)
        with Progress(getattr(options, "quiet", False), getattr(options, "verbose", False)) as options.progress:
            return run(options)
    except UncertainLTIError as error:
        return _refuse(command, str(error))
    except ModuleNotFoundError as error:
        text = absent(error.name)
        return _refuse(command, text) if text else _fault(command)
    except BrokenPipeError:
        raise
    except OSError as error:
        if error.filename is None:
            raise
        why = error.strerror or error
        return _refuse(command, f"{error.filename}: {why}; check the path, its permissions and the disk")
    except MemoryError:
        return _refuse(command, "there is not enough memory for this; give fewer or shorter recordings at a time")
    except (Exception, KeyboardInterrupt) as error:
        if not interrupted(error):
            return _fault(command)
        complain(command, "interrupted; no half-written file is left")
        return INTERRUPTED


def _refuse(command: str, text: str) -> int:
    complain(command, text)
    return BAD_INPUT


def _fault(command: str) -> int:
    """Print the traceback of what nobody expected; its exit status is not that of an alarm."""
    with suppress(OSError, AttributeError):
        traceback.print_exc()
    complain(command, "this is a fault of the program, not of what it was given; please report it with the lines above")
    return FAULT


def build_parser(chosen: str = "", every: bool = False) -> argparse.ArgumentParser:
    """Declare the arguments of every command; those that need rclpy, only of the chosen one."""
    parser = _Parser(
        prog="uncertain-lti",
        description="Fit an uncertain linear model to recorded transients, and report when a machine leaves it.",
        epilog="Exit status: 0 done, 1 the alarm was raised, 2 bad usage or input, 3 a check that says nothing of "
        "the machine, 70 a fault of this program, 130 interrupted by a signal.",
    )
    parser.add_argument("--version", action="version", version=f"uncertain-lti {__version__}")
    parser.set_defaults(build_parser=build_parser)
    parsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for command in COMMANDS:
        text = command.help
        sub = parsers.add_parser(command.name, help=text, description=text[0].upper() + text[1:] + ".")
        if command.run and command.quiet:
            output = sub.add_mutually_exclusive_group()
            output.add_argument("-q", "--quiet", action="store_true", help=command.quiet)
            if command.verbose:
                output.add_argument("-v", "--verbose", action="store_true", help=command.verbose)
        command.declare(sub, chosen, every)
    return parser


class _Parser(argparse.ArgumentParser):
    """Names the nearest command, option or choice in place of a misspelt one."""

    _given: Sequence[str] = ()

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Keep the words, for the error."""
        self._given = list(args or ())
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        from uncertain_lti.base.text import meant

        if match := re.search(r"invalid choice: '?(.*?)'? \(choose from (.*)\)", message):
            message += meant(match[1], re.findall(r"[\w-]+", match[2]), 1)
        elif message.startswith("the following arguments are required"):
            words = [word.partition("=")[0] for word in self._given if word.startswith("--")]
            odd = [w for w in words if not any(o.startswith(w) for o in self._option_string_actions)]
            message += "".join(f"; there is no {word}{meant(word, self._option_string_actions, 1)}" for word in odd)
            takers = [w for w in words if getattr(self._option_string_actions.get(w), "nargs", None) == "+"]
            message += f"; {takers[-1]} takes all that follows it, so put it last" if takers else ""
        elif message.startswith("unrecognized arguments: "):
            commands: dict[str, argparse.ArgumentParser]
            commands = dict(*(action.choices for action in self._actions if isinstance(action.choices, dict)))
            chosen = next((parser for name, parser in commands.items() if name in self._given), self)
            word = message.split(": ")[1].split()[0].partition("=")[0]
            takes = sorted(name for name, parser in commands.items() if word in parser._option_string_actions)
            message += f" (an option of {', '.join(takes)})" if takes else meant(word, chosen._option_string_actions, 1)
            if not word.startswith("-"):
                row = [str(a.metavar) for a in chosen._actions if not a.option_strings and a.nargs == "+"]
                several = f"name every {' or '.join(row)} in one row, without an option in between"
                message += f"; {several if row else f'that is one more than it takes: {chosen.prog} --help'}"
        if files := [word for word in self._given if word.startswith("-") and os.path.exists(word)]:
            message += f"; the file {files[0]} is given as ./{files[0]}"
        super().error(message)


if __name__ == "__main__":
    sys.exit(main())
