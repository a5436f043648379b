# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Command `uncertain-lti info`: show what is in a model file."""

from __future__ import annotations

import argparse

from uncertain_lti.base.errors import ModelError
from uncertain_lti.cli.command import DONE, Command, add_model, load_model, print_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `uncertain-lti info`."""
    add_model(parser, published=True)
    parser.add_argument(
        "--json",
        action="store_true",
        help="print the file as JSON; of a scheduled model with `regimes`, what each rests on",
    )


def run(options: argparse.Namespace) -> int:
    """Print the model."""
    from uncertain_lti.reports.model_text import model_text
    from uncertain_lti.reports.plain_data import finite_data
    from uncertain_lti.reports.regimes import block_facts

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


COMMAND = Command("info", "show what is in a model file", add_arguments, run)
