# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Command `uncertain-lti signature`: learn what known faults look like from labelled recordings."""

from __future__ import annotations

import argparse

from uncertain_lti.base.errors import ModelError
from uncertain_lti.cli.command import (
    DONE,
    SILENT,
    Command,
    add_json,
    add_model,
    add_output,
    add_recordings,
    load_model,
    model_target,
    print_json,
    print_summary,
    read_labelled,
)
from uncertain_lti.cli.judge import add_margin_arguments


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `uncertain-lti signature`."""
    add_model(parser)
    about = "a fault, and a recording of it in which the alarm is raised; several recordings may have one label"
    add_recordings(parser, about=about, metavar="LABEL=BAG")
    add_output(parser, required=True)
    add_margin_arguments(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> int:
    """Learn the signatures and write the model with them."""
    from uncertain_lti import EnvelopeMonitor
    from uncertain_lti.reports.validation_text import signature_text
    from uncertain_lti.validation.signatures import learn_signatures

    output = model_target(options.output, options.force)
    pairs = [text.partition("=") for text in options.bags]
    for text, (label, _, bag) in zip(options.bags, pairs, strict=True):
        if not (label.strip() and bag):
            raise ModelError(f"{text!r} is not LABEL=BAG; write for example stuck_valve=run7.mcap")
    model = load_model(options.model)
    monitor = EnvelopeMonitor(model, options.violations, options.window, options.margin)
    labelled = read_labelled(options, [(label, bag) for label, _, bag in pairs], model.signals)
    checked = [(label, monitor.check(transient)) for label, transient in labelled]
    learnt = learn_signatures(model, checked, options.force)
    model.replace(signatures=learnt.signatures).save(output)
    if options.json:
        faults = [
            {"label": s.label, "recordings": s.recordings, "verdicts": s.verdicts, "steps": list(s.steps)}
            for s in learnt.signatures
        ]
        named = [{"recording": r, "label": label, "named": found} for r, label, found in learnt.named]
        alike = [{"labels": [a, b], "match": match} for a, b, match in learnt.alike]
        print_json({"model": str(output), "signatures": faults, "named": named, "alike": alike})
    else:
        print_summary(options, signature_text(learnt))
        print_summary(options, f"model written to {output}")
    return DONE


_HELP = "learn what known faults look like from labelled recordings"
COMMAND = Command("signature", _HELP, add_arguments, run, quiet=SILENT)
