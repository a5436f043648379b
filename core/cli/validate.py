# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Command `uncertain-lti validate`: validate a model by leaving out what it was fitted to."""

from __future__ import annotations

import argparse
import os

from uncertain_lti.base.errors import BagError, FitError
from uncertain_lti.cli.command import (
    DONE,
    GROUP,
    SILENT,
    Command,
    add_force,
    add_model,
    add_recordings,
    add_within,
    model_target,
    print_json,
    print_notes,
    print_summary,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `uncertain-lti validate`."""
    add_model(parser)
    add_recordings(parser, " (default: those the model was fitted to)", required=False)
    parser.add_argument("--blocks", type=int, help="leave out blocks: their number per recording (a single one: 10)")
    parser.add_argument(
        "--group", metavar="KEY", help=f"{GROUP}; default: that of the fit; none: single recordings all the same"
    )
    parser.add_argument("--gap", type=float, help="s before and after a left-out block that are not fitted either")
    parser.add_argument("--confidence", type=float, default=0.9, help="of every interval (default: 0.9)")
    parser.add_argument(
        "--false-alarms", type=float, metavar="PER_HOUR", help="find the alarm rule that stays below this rate per hour"
    )
    add_within(parser)
    parser.add_argument(
        "--statistics",
        metavar="LIST",
        help="with --false-alarms: arm these statistics over a window, too: energy, mean, ewma, cusum, chi2, "
        "mewma, with commas between them, or all",
    )
    parser.add_argument(
        "--output",
        metavar="MODEL",
        help="write the model with this validation, and the alarm rule found, to this file; where --false-alarms "
        "finds none, nothing is written and the exit status is 2",
    )
    add_force(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(options: argparse.Namespace) -> int:
    """Validate the model and write it with the result, if an output is named."""
    from uncertain_lti import UncertainLTI
    from uncertain_lti.model.alarm_rule import AlarmRule
    from uncertain_lti.recordings.formats import group_recordings
    from uncertain_lti.reports.validation_text import validation_text
    from uncertain_lti.sampling.reading import read_as_fitted
    from uncertain_lti.validation.calibration import calibrate
    from uncertain_lti.validation.detectable import check_within, detectable
    from uncertain_lti.validation.fitted_model import validate_model

    check_within(options.within)
    model = UncertainLTI.load(options.model)
    sources = model.fit_summary.get("sources", [])
    bags = options.bags or list(dict.fromkeys(s["file"] for s in sources))
    if not bags:
        raise BagError(f"{options.model}: does not say which recordings it was fitted to; name them")
    if options.statistics is not None and options.false_alarms is None:
        raise FitError("--statistics goes with --false-alarms: their thresholds follow from the rate; give both")
    if options.output is not None:
        own = os.path.exists(options.output) and os.path.samefile(options.output, options.model)
        model_target(options.output, options.force or own)
    reading = options.progress.iterate("reading")
    transients = [
        read_as_fitted(bag, model.signals, reading) for bag in group_recordings(bags, layout=model.signals.table)
    ]
    for transient in transients:
        print_notes(options, transient.notes)
    with options.progress.stage("validating") as step:
        validation = validate_model(
            model,
            transients,
            blocks=options.blocks,
            gap=options.gap,
            groups=options.group,
            confidence=options.confidence,
            progress=step,
        )
    data = validation.to_dict()
    refusal = ""
    if options.false_alarms is not None:
        calibration = calibrate(
            validation, options.false_alarms, within=options.within, statistics=options.statistics or ()
        )
        data["calibration"] = calibration.to_dict()
        if calibration.alarm_rule is not None:
            model = model.with_residuals_of(validation.model).replace(alarm=calibration.rules)
        elif options.output is not None:
            refusal = f"{options.output}: not written: {calibration.words}"
    with options.progress.stage("injecting faults") as step:
        data["detectable"] = detectable(
            model, validation.parts, options.within, confidence=options.confidence, progress=step
        ).to_dict()
    model = model.replace(validation=data)
    output = None if refusal else options.output
    if output is not None:
        model.save(output)
    if options.json:
        print_json({"model": output or options.model, "validation": model.to_dict()["validation"]})
    else:
        print_summary(options, validation_text(data))
        if output is not None:
            rule = "; ".join(
                f"{r.violations} of {r.window}, margin {r.margin:.3g}" + f" over {r.horizon} steps" * (r.horizon > 1)
                if isinstance(r, AlarmRule)
                else r.words
                for r in model.alarm
            )
            kept = ", unchanged" if options.false_alarms is None else ""
            print_summary(options, f"model written to {output}; its alarm rule{kept}: {rule}")
    if refusal:  # whoever asked for a rule and deploys the file would deploy one without it
        raise FitError(refusal)
    return DONE


COMMAND = Command(
    "validate",
    "estimate how far to trust a model, by leaving out what it was fitted to",
    add_arguments,
    run,
    quiet=SILENT,
    verbose="say every fit, and what took how long",
)
