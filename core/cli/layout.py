# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Command `uncertain-lti layout`: write layouts of viewers."""

from __future__ import annotations

import argparse

from uncertain_lti.cli.command import DONE, Command, add_model, load_model, print_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `uncertain-lti layout`."""
    add_model(parser, published=True)
    parser.add_argument("--foxglove", metavar="FILE.json", help="for Foxglove and Lichtblick")
    parser.add_argument("--plotjuggler", metavar="FILE.xml", help="for PlotJuggler")
    parser.add_argument("--topics", metavar="NAME", help="what the topics begin with (default: /envelope_monitor)")
    parser.add_argument("--json", action="store_true", help="print the paths as JSON")


def run(options: argparse.Namespace) -> int:
    """Write the layouts that are asked for."""
    from uncertain_lti.reports.layouts import write_layouts

    written = write_layouts(load_model(options.model), options.foxglove, options.plotjuggler, options.topics)
    if options.json:
        print_json({"model": options.model, "layouts": [str(path) for path in written]})
        return DONE
    for path in written:
        print(f"layout written to {path}")
    return DONE


COMMAND = Command("layout", "write layouts of viewers for what a model's monitor publishes", add_arguments, run)
