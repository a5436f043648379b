# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Commands `validate` and `signature`: what further judging of recordings adds to a model."""

from __future__ import annotations

import argparse
import os
from dataclasses import replace

from uncertain_lti.base.errors import BagError, ModelError
from uncertain_lti.cli.command import Command, Result, load_model, model_target, read_labelled
from uncertain_lti.cli.options import OPTIONS, RECORDINGS, RULES, helped

# --- validate --------------------------------------------------------------------------------------------------------


def run_validate(options: argparse.Namespace) -> Result:
    """Validate the model and write it with the result, if an output is named."""
    from uncertain_lti import UncertainLTI
    from uncertain_lti.recordings.formats import group_recordings
    from uncertain_lti.reports.validation_text import validation_text
    from uncertain_lti.sampling.reading import read_as_fitted
    from uncertain_lti.validation.detectable import check_within, detectable
    from uncertain_lti.validation.left_out import validate
    from uncertain_lti.validation.panel import learn, promises
    from uncertain_lti.validation.part import fitted_parts

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
        options.progress.note(*transient.notes)
    with options.progress.stage("validating") as step:
        given = {name: getattr(options, name) for name in ("blocks", "gap", "confidence")}
        validation = validate(model, transients, **given, groups=options.group, progress=step)
    said: list[str] = []
    if options.false_alarms is not None:
        panel = learn(validation, fitted_parts(validation.model, transients), options.false_alarms)
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
    options.say(validation_text(data))
    if output is not None:
        options.say(f"model written to {output}; alarm: {'; or '.join(r.words for r in model.alarm)}")
    return Result(data={"model": output or options.model, "validation": model.to_dict()["validation"]})


# --- signature -------------------------------------------------------------------------------------------------------


def run_signature(options: argparse.Namespace) -> Result:
    """Learn the signatures and write the model with them."""
    from uncertain_lti import EnvelopeMonitor
    from uncertain_lti.reports.validation_text import signature_text
    from uncertain_lti.validation.labelled_faults import learn_signatures

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
    faults = [
        {"label": s.label, "recordings": s.recordings, "verdicts": s.verdicts, "steps": list(s.steps)}
        for s in learnt.signatures
    ]
    named = [{"recording": r, "label": label, "named": found} for r, label, found in learnt.named]
    alike = [{"labels": [a, b], "match": match} for a, b, match in learnt.alike]
    options.say(f"{signature_text(learnt)}\nmodel written to {output}")
    return Result(data={"model": str(output), "signatures": faults, "named": named, "alike": alike})


VALIDATE = Command(
    "validate",
    "estimate how far to trust a model, by leaving out what it was fitted to",
    (
        "model",
        helped("bags", f"{RECORDINGS} (default: those the model was fitted to)", nargs="*"),
        "--blocks",
        helped(
            "--group", f"{OPTIONS['--group']['help']}; default: that of the fit; none: single recordings all the same"
        ),
        *("--gap", "--confidence"),
        helped(
            "--false-alarms",
            "learn the panel again, for at most so many false alarms per hour with 90%% confidence",
        ),
        "--within",
        helped("--output", "write the model with this validation, and the panel that was learnt, to this file"),
        *("--force", "--json"),
    ),
    run_validate,
    verbose="say every fit, and what took how long",
)
_LABELLED = "a fault, and a recording of it in which the alarm is raised; several recordings may have one label"
SIGNATURE = Command(
    "signature",
    "learn what known faults look like from labelled recordings",
    (
        "model",
        helped("bags", _LABELLED, metavar="LABEL=BAG"),
        ("--output", {"required": True}),
        "--force",
        *RULES,
        "--json",
    ),
    run_signature,
)
