# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Commands that hand over to one function: what a model holds, layouts, the paper's experiment, ROS, completion."""

from __future__ import annotations

import argparse

from uncertain_lti.base.errors import BagError, ModelError
from uncertain_lti.cli.command import Command, Result, load_model
from uncertain_lti.cli.options import PUBLISHED, helped


def run_info(options: argparse.Namespace) -> Result:
    """Print the model."""
    from uncertain_lti.base.text import finite_data
    from uncertain_lti.model.overview import block_facts
    from uncertain_lti.reports.model_text import model_text

    model = load_model(options.model)
    if options.json:
        regimes = finite_data(block_facts(model))
        return Result(data=model.replace(memory=None).to_dict() | ({"regimes": regimes} if regimes else {}))
    try:
        return Result(text=model_text(model))
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise ModelError(
            f"{options.model}: what it says of its own fit is odd ({type(error).__name__}: {error}); fit it again, "
            f"or print it with --json"
        ) from None


def run_layout(options: argparse.Namespace) -> Result:
    """Write the layouts that are asked for."""
    from uncertain_lti.reports.layouts import write_layouts

    written = write_layouts(load_model(options.model), options.foxglove, options.plotjuggler, options.topics)
    data = {"model": options.model, "layouts": [str(path) for path in written]}
    return Result(data=data, text="\n".join(f"layout written to {path}" for path in written))


def run_reproduce(options: argparse.Namespace) -> Result:
    """Run the experiment into a folder."""
    from uncertain_lti.plants.reproduce import reproduce

    try:
        with options.progress.stage("reproducing") as step:
            data = reproduce(options.output, options.say, step)
    except OSError as error:
        raise BagError(f"{options.output}: cannot be written: {error.strerror}; choose another folder") from None
    return Result(data={"output": options.output, **data})


def run_completion(options: argparse.Namespace) -> Result:
    """Print the script of a shell."""
    import shtab  # type: ignore[import-not-found, import-untyped, unused-ignore]

    parser = options.build_parser(every=True)
    commands = next(action.choices for action in parser._actions if isinstance(action.choices, dict))
    for command in commands.values():
        for action in command._actions:
            kind = str(action.metavar or "").partition(".")[0]
            if kind == "FOLDER":
                action.complete = shtab.DIRECTORY
            elif kind in ("BAG", "MODEL", "FILE") or "." in str(action.metavar or ""):
                action.complete = shtab.FILE
    return Result(text=shtab.complete(parser, shell=options.shell))


INFO = Command(
    "info",
    "show what is in a model file",
    (PUBLISHED, helped("--json", "print the file as JSON; of a scheduled model with `regimes`, what each rests on")),
    run_info,
    quiet="",
)
LAYOUT = Command(
    "layout",
    "write layouts of viewers for what a model's monitor publishes",
    (PUBLISHED, "--foxglove", "--plotjuggler", "--topics", helped("--json", "print the paths as JSON")),
    run_layout,
    quiet="",
)
_FOLDER = {"default": "reproduce-output", "metavar": "FOLDER"}
REPRODUCE = Command(
    "reproduce",
    "run the paper's experiment on the nonlinear turbofan",
    (helped("--output", "for figures, models and numbers", **_FOLDER), helped("--json", "print the numbers as JSON")),
    run_reproduce,
    quiet="print errors only; everything is in the folder",
)
_COMPLETION = "print what bash or zsh needs to complete commands, options and files"
COMPLETION = Command("completion", _COMPLETION, ("shell",), run_completion, quiet="")
PLAY = Command("play", "publish a recording through rclpy", of_ros="player")
RECORD = Command("record", "record topics through rclpy", of_ros="recorder")
WATCH = Command("watch", "show on a page of this machine what a running monitor says", of_ros="watch")
_DEMO = "fit shipped recordings of a turbofan and watch another, in which a fault sets in, live"
DEMO = Command("demo", _DEMO, of_ros="demo")
