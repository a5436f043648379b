# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Options of `check`, `report` and `plot` that say how the monitor is deployed, and the check that takes them."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from uncertain_lti.base.english import plural
from uncertain_lti.cli.command import complain, print_notes

if TYPE_CHECKING:
    from uncertain_lti import UncertainLTI
    from uncertain_lti.monitor.deployed import DeployedMonitor
    from uncertain_lti.monitor.verdicts import Verdicts
    from uncertain_lti.recordings.recording import Progress, Recording
    from uncertain_lti.sampling.sampler_arrays import Decisions


def add_margin_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare another rule of containment than the model's."""
    parser.add_argument(
        "--rules",
        metavar="FILE",
        help="alarm: the rules of another model file, or of JSON as its field alarm has them (default: the model's)",
    )
    parser.add_argument("--violations", type=int, help="alarm: number of violations (default: the model's)")
    parser.add_argument(
        "--window", type=int, help="alarm: number of last verdicts they are counted in (default: the model's)"
    )
    parser.add_argument("--margin", type=float, help="factor on the half-widths (default: the model's)")


def add_rule_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the alarm rule, as the node has them as parameters."""
    add_margin_arguments(parser)
    parser.add_argument(
        "--masked", default="", metavar="STATES", help="states, separated by commas, that never raise the alarm"
    )
    parser.add_argument(
        "--enable",
        default="",
        metavar="CONDITION",
        help="no alarm unless this holds: TOPIC FIELD OPERATOR NUMBER, such as '/engine/mode data == 3'",
    )
    parser.add_argument(
        "--grace",
        type=float,
        default=0.0,
        metavar="S",
        help="no alarm for so many s after the first sample, a reset, and after --enable began to hold",
    )
    parser.add_argument("--latch", action="store_true", help="an alarm lasts to the end of the recording")
    parser.add_argument(
        "--from", dest="start", type=float, metavar="S", help="judge from so many s after the first sample on"
    )
    parser.add_argument(
        "--to", dest="stop", type=float, metavar="S", help="judge up to so many s after the first sample"
    )


def deployed_monitor(options: argparse.Namespace, model: UncertainLTI) -> DeployedMonitor:
    """The monitor that the options of `add_rule_arguments` describe."""
    from uncertain_lti import EnvelopeMonitor
    from uncertain_lti.base.errors import ModelError
    from uncertain_lti.model.file import read_rules
    from uncertain_lti.monitor.arming import Condition
    from uncertain_lti.monitor.deployed import DeployedMonitor
    from uncertain_lti.monitor.live_rule import listed_states

    if options.rules is not None:
        rules = read_rules(options.rules)
        try:
            model = model.replace(alarm=rules)
        except ModelError as error:
            raise ModelError(f"{options.rules}: does not fit the model: {error}") from None
    monitor = EnvelopeMonitor(model, options.violations, options.window, options.margin, listed_states(options.masked))
    return DeployedMonitor(
        monitor, Condition.parse(options.enable), options.grace, options.latch, options.start, options.stop
    )


def check_recording(
    deployed: DeployedMonitor, recording: Recording, progress: Progress | None = None
) -> tuple[Verdicts, Decisions]:
    """Read one recording and judge it as the node would."""
    from uncertain_lti.sampling.reading import read_as_fitted_with_decisions, read_field

    signals = deployed.monitor.model.signals
    transient, decisions = read_as_fitted_with_decisions(recording, signals, progress)
    if (condition := deployed.condition) is None:
        return deployed.check(transient), decisions
    heard = read_field(recording, signals, decisions, condition.topic, condition.field)
    return deployed.check(transient, *heard), decisions


def checks(
    command: str,
    options: argparse.Namespace,
    deployed: DeployedMonitor,
    bags: Sequence[Recording],
    refused: list[dict[str, str]],
) -> Iterator[tuple[Recording, Verdicts, Decisions]]:
    """Read and judge recordings; of several, one that cannot be checked is `refused` and keeps none of the others."""
    from uncertain_lti.base.errors import BagError, SignalError

    for bag in bags:
        try:
            verdicts, decisions = check_recording(deployed, bag, options.progress.iterate("reading"))
        except (BagError, SignalError) as error:
            if len(bags) == 1:
                raise
            complain(command, str(error))
            refused.append({"recording": str(bag.path), "error": str(error)})
            continue
        print_notes(options, verdicts.transient.notes)
        yield bag, verdicts, decisions
    if refused:
        complain(command, f"{len(refused)} of {plural(len(bags), 'recording')} not checked, as said above")
