# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Command `uncertain-lti reproduce`: run the paper's experiment."""

from __future__ import annotations

import argparse

from uncertain_lti.base.errors import BagError
from uncertain_lti.cli.command import DONE, Command, print_json, print_summary


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `uncertain-lti reproduce`."""
    parser.add_argument(
        "--output", default="reproduce-output", metavar="FOLDER", help="for figures, models and numbers"
    )
    parser.add_argument("--json", action="store_true", help="print the numbers as JSON")


def run(options: argparse.Namespace) -> int:
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


COMMAND = Command(
    "reproduce",
    "run the paper's experiment on the nonlinear turbofan",
    add_arguments,
    run,
    quiet="print errors only; everything is in the folder",
)
