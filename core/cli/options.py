# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Options: every argument of `uncertain-lti`, declared once; argparse, `--help` and the docs take it from here."""

from __future__ import annotations

import argparse
import math
import re
from typing import Any

from uncertain_lti.signals.values import CHOICES

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
    match = re.fullmatch(r"\s*([0-9.]+)\s*(s|m|min|h)?\s*", text)
    try:
        seconds = float(match[1]) * {"s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}[match[2] or "s"] if match else 0.0
    except ValueError:
        seconds = 0.0
    if not 0 < seconds < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is no time; write 90s, 10m or 1h")
    return seconds


def _takes(text: str, metavar: str | None = None, **more: Any) -> dict[str, Any]:
    return {"help": text, "metavar": metavar, **more}


def _flag(text: str) -> dict[str, Any]:
    return {"help": text, "action": "store_true"}


OPTIONS: dict[str, dict[str, Any]] = {
    "model": _takes("model file", "MODEL"),
    "bag": _takes("recording (MCAP, .db3, .bag, table), or folder of one", "BAG"),
    "bags": _takes(RECORDINGS, "BAG", nargs="+"),
    "shell": _takes(
        'whose; for this session: eval "$(uncertain-lti completion bash)", for each one: put that into ~/.bashrc '
        "or ~/.zshrc",
        choices=("bash", "zsh"),
    ),
    "--signals": _takes("signals file (YAML): which field is which signal", "FILE", required=True),
    "--update": _takes(
        "fit to what this model was fitted to and to these recordings, without the former; it keeps its signals, "
        "criterion and terms",
        "MODEL",
    ),
    "--output": _takes("model file to write (*.model.json)", "MODEL"),
    "--force": _flag("write over a model that is there already"),
    "--json": _flag("print JSON"),
    # how to fit
    "--criterion": _takes(
        "(10) squared or (11) largest width (default: what sees smaller jumps on left-out data)", choices=("qp", "lp")
    ),
    "--additive": _takes(
        "further terms: disturbance c with its half-width, measurement noise (default: the signals file's, else "
        "noise, and the disturbance where it narrows the envelope clearly)",
        choices=CHOICES,
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
    "--rules": _takes(f"alarm: the rules of another model file, or of JSON as its field alarm has them {_OWN}", "FILE"),
    "--violations": _takes(f"alarm: number of violations {_OWN}", type=int),
    "--window": _takes(f"alarm: number of last verdicts they are counted in {_OWN}", type=int),
    "--margin": _takes(f"factor on the half-widths {_OWN}", type=float),
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
        "what may be a state, in place of what looks like one; * stands for any letters",
        "TOPIC[:FIELD]",
        nargs="+",
        default=[],
    ),
    "--controls": _takes("likewise for the controls", "TOPIC[:FIELD]", nargs="+", default=[]),
    "--like": _takes(
        "of many alike (joints, motors) the one that the file is drawn up for, such as j3", "MEMBER", default=""
    ),
    "--check": _takes("recordings to report on (default: those that are fitted)", "BAG", nargs="+", default=[]),
    # layouts
    "--foxglove": _takes("for Foxglove and Lichtblick", "FILE.json"),
    "--plotjuggler": _takes("for PlotJuggler", "FILE.xml"),
    "--topics": _takes("what the topics begin with (default: /envelope_monitor)", "NAME"),
}
"""Every argument and option, as argparse takes it."""

RULES = ("--rules", "--violations", "--window", "--margin")
"""Another rule of containment, or other rules, than the model's."""
DEPLOYED = (*RULES, "--masked", "--enable", "--grace", "--latch", "--from", "--to")
"""The rules of the alarm and when they are armed, as the node has them as parameters."""


def helped(name: str, text: str, **more: Any) -> Option:
    """An option with another help."""
    return name, {"help": text, **more}


PUBLISHED = helped("model", "model file, or leibov2006 for the published one")
"""A model file, or the published model."""


def declare(parser: argparse.ArgumentParser, options: tuple[Option, ...]) -> None:
    """Declare the options of a command."""
    for option in options:
        name, changes = (option, {}) if isinstance(option, str) else option
        parser.add_argument(name, **OPTIONS[name] | changes)
