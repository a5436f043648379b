# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Commands that need rclpy: play, record and demo, whose modules are imported only when one is chosen."""

from __future__ import annotations

import argparse
from importlib import import_module

from uncertain_lti.cli.command import Command


def _delegate(name: str, module: str, text: str) -> Command:
    """Make a command of a module of `uncertain_lti_ros` that has `add_arguments` and `run`."""

    def add_arguments(parser: argparse.ArgumentParser) -> None:
        import_module(f"uncertain_lti_ros.{module}").add_arguments(parser)

    def run(options: argparse.Namespace) -> int:
        return int(import_module(f"uncertain_lti_ros.{module}").run(options))

    return Command(name, text, add_arguments, run, deferred=True)


PLAY = _delegate("play", "player", "publish a recording through rclpy")
RECORD = _delegate("record", "recorder", "record topics through rclpy")
DEMO = _delegate(
    "demo", "demo", "fit shipped recordings of a turbofan and watch another, in which a fault sets in, live"
)
