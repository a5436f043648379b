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
from importlib import import_module

from uncertain_lti.base.errors import BagError, ModelError
from uncertain_lti.cli.command import DONE, Command, add_json, add_model, load_model, print_json, print_summary


def _add_info(parser: argparse.ArgumentParser) -> None:
    add_model(parser, published=True)
    add_json(parser, "print the file as JSON; of a scheduled model with `regimes`, what each rests on")


def run_info(options: argparse.Namespace) -> int:
    """Print the model."""
    from uncertain_lti.reports.model_text import block_facts, model_text
    from uncertain_lti.reports.tables import finite_data

    model = load_model(options.model)
    if options.json:
        regimes = finite_data(block_facts(model))
        print_json(model.to_dict() | ({"regimes": regimes} if regimes else {}))
    else:
        try:
            text = model_text(model)
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            raise ModelError(
                f"{options.model}: what it says of its own fit is odd ({type(error).__name__}: {error}); fit it again, "
                f"or print it with --json"
            ) from None
        print(text)
    return DONE


def _add_layout(parser: argparse.ArgumentParser) -> None:
    add_model(parser, published=True)
    parser.add_argument("--foxglove", metavar="FILE.json", help="for Foxglove and Lichtblick")
    parser.add_argument("--plotjuggler", metavar="FILE.xml", help="for PlotJuggler")
    parser.add_argument("--topics", metavar="NAME", help="what the topics begin with (default: /envelope_monitor)")
    add_json(parser, "print the paths as JSON")


def run_layout(options: argparse.Namespace) -> int:
    """Write the layouts that are asked for."""
    from uncertain_lti.reports.layouts import write_layouts

    written = write_layouts(load_model(options.model), options.foxglove, options.plotjuggler, options.topics)
    if options.json:
        print_json({"model": options.model, "layouts": [str(path) for path in written]})
        return DONE
    for path in written:
        print(f"layout written to {path}")
    return DONE


def _add_reproduce(parser: argparse.ArgumentParser) -> None:
    about = "for figures, models and numbers"
    parser.add_argument("--output", default="reproduce-output", metavar="FOLDER", help=about)
    add_json(parser, "print the numbers as JSON")


def run_reproduce(options: argparse.Namespace) -> int:
    """Run the experiment into a folder."""
    from uncertain_lti.plants.reproduce import reproduce

    try:
        with options.progress.stage("reproducing") as step:
            data = reproduce(options.output, lambda text: print_summary(options, text), step)
    except OSError as error:
        raise BagError(f"{options.output}: cannot be written: {error.strerror}; choose another folder") from None
    if options.json:
        print_json({"output": options.output, **data})
    return DONE


def _add_completion(parser: argparse.ArgumentParser) -> None:
    about = (
        'whose; for this session: eval "$(uncertain-lti completion bash)", for each one: put that into ~/.bashrc or '
    )
    parser.add_argument("shell", choices=("bash", "zsh"), help=f"{about}~/.zshrc")


def run_completion(options: argparse.Namespace) -> int:
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
    print(shtab.complete(parser, shell=options.shell))
    return DONE


def _of_ros(name: str, module: str, text: str) -> Command:
    """A command of a module that needs rclpy and is imported only when the command is chosen."""

    def add_arguments(parser: argparse.ArgumentParser) -> None:
        import_module(f"uncertain_lti_ros.{module}").add_arguments(parser)

    def run(options: argparse.Namespace) -> int:
        return int(import_module(f"uncertain_lti_ros.{module}").run(options))

    return Command(name, text, add_arguments, run, deferred=True)


_LAYOUT = "write layouts of viewers for what a model's monitor publishes"
_REPRODUCE = "run the paper's experiment on the nonlinear turbofan"
_IN_THE_FOLDER = "print errors only; everything is in the folder"
_COMPLETION = "print what bash or zsh needs to complete commands, options and files"
_DEMO = "fit shipped recordings of a turbofan and watch another, in which a fault sets in, live"
INFO = Command("info", "show what is in a model file", _add_info, run_info)
LAYOUT = Command("layout", _LAYOUT, _add_layout, run_layout)
REPRODUCE = Command("reproduce", _REPRODUCE, _add_reproduce, run_reproduce, _IN_THE_FOLDER)
COMPLETION = Command("completion", _COMPLETION, _add_completion, run_completion)
PLAY = _of_ros("play", "player", "publish a recording through rclpy")
RECORD = _of_ros("record", "recorder", "record topics through rclpy")
DEMO = _of_ros("demo", "demo", _DEMO)
