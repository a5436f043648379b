# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What every command shares: its declaration, every argument declared once, exit statuses, printing, and the model."""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from uncertain_lti.base.errors import ModelError, UncertainLTIError
from uncertain_lti.base.text import printable
from uncertain_lti.signals.values import CHOICES, CRITERIA

if TYPE_CHECKING:
    from uncertain_lti import UncertainLTI

DONE, ALARM, BAD_INPUT, UNKNOWN, NOT_READ = 0, 1, 2, 3, 141
"""Exit statuses: 1 means that the alarm was raised, and nothing else; 3 that a check says nothing of the machine.

141, as shells have it, says that the reader of the output went away before it was
known whether there is an alarm. Two more are in `uncertain_lti.cli`.
"""

Option = str | tuple[str, dict[str, Any]]
"""A name in `OPTIONS`, with what is otherwise for one command."""

RECORDINGS = "recordings (MCAP, .db3, .bag, tables) and folders"
_OWN, _FIRST = "(default: the model's)", "so many s after the first sample"


def schedule(text: str) -> tuple[str, str, Any]:
    """A signal with its knots, how many, auto, or its modes."""
    name, given, knots = text.rpartition("=") if "=" in text else (text, "", "auto")
    if not name or (given and not knots):
        raise argparse.ArgumentTypeError(f"{text!r} is no schedule; write SIGNAL, SIGNAL=3 or SIGNAL=0.2,0.5,0.9")
    if knots == "auto":
        return name, "knots", knots
    kind, values = ("modes", knots[6:]) if knots.startswith("modes:") else ("knots", knots)
    try:
        if kind == "knots" and "," not in values:
            return name, kind, int(values)
        flags = {"false": 0.0, "true": 1.0} if kind == "modes" else {}
        return name, kind, [flags[v] if v in flags else float(v) for v in values.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{knots!r} is neither auto, a number of knots, knots such as 0.2,0.5,0.9 nor modes such as modes:1,2,3"
        ) from None


def _horizons(text: str) -> Any:
    """Auto, perhaps with the longest in seconds behind a colon, or seconds."""
    if text == "auto":
        return text
    try:
        if text.startswith("auto:"):
            return {"longest": float(text.removeprefix("auto:"))}
        return {"seconds": [float(value) for value in text.split(",")]}
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r} is neither auto, auto with the longest such as auto:1.0 nor seconds such as 0.1,0.5"
        ) from None


def _discard(text: str) -> float:
    """A whole number, or a share below 1."""
    try:
        return int(text) if text.isdigit() else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a whole number nor a share such as 0.001") from None


def _time(text: str) -> float:
    """Seconds of 90, 90s, 10m or 1h."""
    match = re.fullmatch(r"\s*([0-9]+\.?[0-9]*|\.[0-9]+)\s*(s|m|min|h)?\s*", text)
    seconds = float(match[1]) * {"s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}[match[2] or "s"] if match else 0.0
    if not 0 < seconds < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is no time; write 90s, 10m or 1h")
    return seconds


def _remap(text: str) -> tuple[str, str]:
    topic, assigned, name = text.partition(":=")
    if not (assigned and topic.strip("/") and name.strip("/")):
        raise argparse.ArgumentTypeError(f"{text!r} does not read TOPIC:=NAME")
    return f"/{topic.lstrip('/')}", f"/{name.lstrip('/')}"


def _file(text: str) -> str:
    """A path that no command which it is handed on to takes for an option; an empty one would be this folder."""
    if not text:
        raise argparse.ArgumentTypeError("the name is empty, as of a variable of the shell that is not set")
    return f"./{text}" if text.startswith("-") else text


def _takes(text: str, metavar: str | None = None, **more: Any) -> dict[str, Any]:
    return {"help": text, "metavar": metavar, **more}


def _flag(text: str) -> dict[str, Any]:
    return {"help": text, "action": "store_true"}


OPTIONS: dict[str, dict[str, Any]] = {
    "model": _takes("model file", "MODEL", type=_file),
    "bag": _takes("recording (MCAP, .db3, .bag, table), or folder of one", "BAG", type=_file),
    "bags": _takes(RECORDINGS, "BAG", nargs="+", type=_file),
    "shell": _takes(
        'whose; for this session: eval "$(uncertain-lti completion bash)", for each one: put that into ~/.bashrc '
        "or ~/.zshrc",
        choices=("bash", "zsh"),
    ),
    "--signals": _takes("signals file (YAML): which field is which signal", "FILE", required=True, type=_file),
    "--update": _takes(
        "fit to what this model was fitted to and to these recordings, without the former; it keeps its signals, "
        "criterion and terms",
        "MODEL",
        type=_file,
    ),
    "--output": _takes("model file to write (*.model.json)", "MODEL", type=_file),
    "--force": _flag("write over a model that is there already"),
    "--json": _flag("print JSON"),
    # how to fit
    "--criterion": _takes(
        "(10) squared or (11) largest width (default: what sees smaller jumps on left-out data)",
        choices=tuple(CRITERIA),
    ),
    "--additive": _takes(
        "further terms: disturbance c with its half-width, measurement noise (default: the signals file's, else "
        "noise, and the disturbance where it narrows the envelope clearly)",
        choices=tuple(CHOICES),
    ),
    "--alarm": _takes(
        "a small fixed panel of rules learnt on left-out data (default), or a sample outside its bounds",
        choices=("panel", "containment"),
        default="panel",
    ),
    "--false-alarms": _takes(
        "false alarms per hour at most, with 90%% confidence (default: what the recordings can show)",
        "PER_HOUR",
        type=float,
    ),
    "--schedule": _takes(
        "piecewise-linear over this signal: as many knots as the recordings carry (auto, the default), N knots, "
        "knots or modes in recorded units; once or twice (default: what the signals file says)",
        "SIGNAL[=auto|N|a,b,...|modes:a,b,...]",
        type=schedule,
        action="append",
    ),
    "--horizons": _takes(
        "further envelopes, over these seconds, or over those up to S that hold on left-out data (auto) (default: "
        "what the signals file says)",
        "auto[:S]|S,...",
        type=_horizons,
    ),
    "--widths": _takes(
        "their half-widths: growing with the state, constant, or what holds better on left-out data (auto)",
        choices=("auto", "constant", "growing"),
    ),
    "--discard": _takes(
        "leave at most K transitions outside (or a share such as 0.001), chosen by effect and listed",
        "K",
        type=_discard,
        default=0,
    ),
    "--count": _takes(
        "let every sample weigh the same (default), or every recording however long it is",
        choices=("sample", "transient"),
        default="sample",
    ),
    "--group": _takes(
        "leave out whole groups of recordings that are alike: folder, hours=H (recordings that follow one another "
        "within H hours), metadata=NAME (of the bag), name=PATTERN (of the file)",
        "KEY",
    ),
    "--cache": _takes("more recordings than memory: keep the arrays in this folder", "FOLDER"),
    "--scheduler": _takes("fit on the workers of this Dask scheduler", "ADDRESS"),
    "--workers": _takes("fit on a Dask cluster of N workers on this machine", "N", type=int),
    "--budget": _takes("stop after 90s, 10m or 1h with the best so far", "TIME", type=_time, default=math.inf),
    # how to judge
    "--rules": _takes(
        f"alarm: the rules of another model file, or of JSON as its field alarm has them {_OWN}", "FILE", type=_file
    ),
    "--violations": _takes(f"alarm: number of violations {_OWN}", type=int),
    "--window": _takes(f"alarm: number of last verdicts they are counted in {_OWN}", type=int),
    "--margin": _takes(f"factor on the half-widths {_OWN}", type=float),
    "--topic-prefix": _takes(
        "the topics of the model, and that of --enable, are below this in the recording, such as /robot1",
        "PREFIX",
        default="",
    ),
    "--remap": _takes(
        "a topic of the model, below its prefix, has another name in the recording, as by -r of the node",
        "TOPIC:=NAME",
        type=_remap,
        action="append",
        default=[],
    ),
    "--masked": _takes("states, separated by commas, that never raise the alarm", "STATES", default=""),
    "--enable": _takes(
        "no alarm unless this holds: TOPIC FIELD OPERATOR NUMBER, such as '/engine/mode data == 3'",
        "CONDITION",
        default="",
    ),
    "--grace": _takes(
        f"no alarm for {_FIRST}, a reset, and after --enable began to hold", "S", type=float, default=0.0
    ),
    "--latch": _flag("an alarm lasts to the end of the recording"),
    "--from": _takes(f"judge from {_FIRST} on", "S", dest="start", type=float),
    "--to": _takes(f"judge up to {_FIRST}", "S", dest="stop", type=float),
    "--write": _takes(
        "write a copy of the recording with bounds, utilisation and flags on topics of their own; for several "
        "recordings a folder",
        "OUT.mcap",
        type=_file,
    ),
    # how to validate
    "--blocks": _takes("leave out blocks: their number per recording (a single one: 10)", type=int),
    "--gap": _takes("s before and after a left-out block that are not fitted either", type=float),
    "--confidence": _takes("of every interval (default: 0.9)", type=float, default=0.9),
    "--within": _takes(
        "time within which a fault shall be seen (default: 1 s or 20 steps, at most a quarter of a recording)",
        "S",
        type=float,
    ),
    # how to begin
    "--states": _takes(
        "what may be a state, in place of what looks like one, also a column of a table; * stands for any letters",
        "TOPIC[:FIELD]",
        nargs="+",
        default=[],
    ),
    "--controls": _takes("likewise for the controls", "TOPIC[:FIELD]", nargs="+", default=[]),
    "--like": _takes(
        "of many alike (joints, motors) the one that the file is drawn up for, such as j3", "MEMBER", default=""
    ),
    "--table": _takes(
        "of tables, as under `table` in a signals file: time=COLUMN unit=ms, runs=COLUMN, or step=0.01, the s from row "
        "to row where no column is a time",
        "KEY=VALUE",
        nargs="+",
        default=[],
    ),
    "--check": _takes(
        "recordings to report on (default: those that are fitted)", "BAG", nargs="+", default=[], type=_file
    ),
    # layouts
    "--foxglove": _takes("for Foxglove and Lichtblick", "FILE.json"),
    "--plotjuggler": _takes("for PlotJuggler", "FILE.xml"),
    "--topics": _takes("what the topics begin with (default: /envelope_monitor)", "NAME"),
}
"""Every argument and option, as argparse takes it."""

RULES = ("--rules", "--violations", "--window", "--margin")
"""Another rule of containment, or other rules, than the model's."""
DEPLOYED = (*RULES, "--topic-prefix", "--remap", "--masked", "--enable", "--grace", "--latch", "--from", "--to")
"""The rules of the alarm and when they are armed, as the node has them as parameters."""


def helped(name: str, text: str, **more: Any) -> Option:
    """An option with another help."""
    return name, {"help": text, **more}


PUBLISHED = helped("model", "model file, or leibov2006 for the published one")
"""A model file, or the published model."""


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
            for option in self.options:
                name, changes = (option, {}) if isinstance(option, str) else option
                parser.add_argument(name, *["-o"] * (name == "--output"), **OPTIONS[name] | changes)
            parser.set_defaults(run=self.run)
        elif every or self.name == chosen:
            with nullcontext() if self.name == chosen else suppress(ModuleNotFoundError, UncertainLTIError):
                import_module("uncertain_lti_ros").hold_middleware()
                module = import_module(f"uncertain_lti_ros.{self.of_ros}")
                module.add_arguments(parser)
                parser.set_defaults(run=module.run)


def declared(help: str, *options: Option, **more: str) -> Callable[[Callable[[argparse.Namespace], Result]], Command]:
    """Declare a function as the command of its name, which runs it."""
    return lambda run: Command(run.__name__, help, options, run, **more)


def run(options: argparse.Namespace) -> int:
    """Run the command of parsed options and print what came of it."""
    options.say = options.say_losses = partial(_print_summary, options)
    result: Result = options.run(options)
    if getattr(options, "json", False):
        if result.data is not None:
            sys.stdout.writelines(_json_lines(result.data, 4))
            sys.stdout.write("\n")
    elif result.text:
        print(result.text)
    return int(result.status)


def _json_lines(data: Any, depth: int, new: str = "\n") -> Iterator[str]:
    """Text of data in lines; what is so deep in takes one, such as a sample, as the compiled encoder writes it."""
    many = isinstance(data, Iterable) and isinstance(data, Sized) and not isinstance(data, str)
    if not (depth and many and data):
        yield json.dumps(data, allow_nan=False)
        return
    named = isinstance(data, dict)
    items = data.items() if isinstance(data, dict) else (("", inner) for inner in data)
    for number, (name, inner) in enumerate(items):
        yield (("{" if named else "[") if number == 0 else ",") + f"{new} " + named * f"{json.dumps(str(name))}: "
        yield from _json_lines(inner, depth - 1, f"{new} ")
    yield new + ("}" if named else "]")


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
