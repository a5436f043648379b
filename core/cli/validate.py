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
from dataclasses import replace

from uncertain_lti.base.errors import BagError
from uncertain_lti.cli.command import (
    DONE,
    GROUP,
    SILENT,
    Command,
    add_force,
    add_model,
    add_recordings,
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
        "--false-alarms",
        type=float,
        metavar="PER_HOUR",
        help="learn the panel again, for at most so many false alarms per hour with 90%% confidence",
    )
    parser.add_argument(
        "--within",
        type=float,
        metavar="S",
        help="time within which a fault shall be seen (default: 1 s or 20 steps, at most a quarter of a recording)",
    )
    parser.add_argument(
        "--output",
        metavar="MODEL",
        help="write the model with this validation, and the panel that was learnt, to this file",
    )
    add_force(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(options: argparse.Namespace) -> int:
    """Validate the model and write it with the result, if an output is named."""
    from uncertain_lti import UncertainLTI
    from uncertain_lti.recordings.formats import group_recordings
    from uncertain_lti.reports.validation_text import validation_text
    from uncertain_lti.sampling.reading import read_as_fitted
    from uncertain_lti.validation.detectable import check_within, detectable
    from uncertain_lti.validation.left_out import validate_model
    from uncertain_lti.validation.panel import learn, promises

    check_within(options.within)
    model = UncertainLTI.load(options.model)
    sources = model.fit_summary.get("sources", [])
    bags = options.bags or list(dict.fromkeys(s["file"] for s in sources))
    if not bags:
        raise BagError(f"{options.model}: does not say which recordings it was fitted to; name them")
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
    said: list[str] = []
    if options.false_alarms is not None:
        on = [s.name for s in model.signals.scheduling]
        panel = learn(validation, [t.scheduled_on(on) for t in transients], options.false_alarms)
        model = model.with_residuals_of(validation.model).replace(alarm=panel.rules)
        said = promises(model, panel)
    data = replace(validation, model=model).to_dict() | ({"promises": said} if said else {})
    with options.progress.stage("injecting faults") as step:
        data["detectable"] = detectable(
            model, validation.parts, options.within, confidence=options.confidence, progress=step
        ).to_dict()
    model = model.replace(validation=data)
    output = options.output
    if output is not None:
        model.save(output)
    if options.json:
        print_json({"model": output or options.model, "validation": model.to_dict()["validation"]})
    else:
        print_summary(options, validation_text(data))
        if output is not None:
            print_summary(options, f"model written to {output}; alarm: {'; or '.join(r.words for r in model.alarm)}")
    return DONE


COMMAND = Command(
    "validate",
    "estimate how far to trust a model, by leaving out what it was fitted to",
    add_arguments,
    run,
    quiet=SILENT,
    verbose="say every fit, and what took how long",
)
