# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Commands `check`, `report` and `plot`: judge recordings as the node would, and say, write or draw what came out."""

from __future__ import annotations

import argparse
import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from uncertain_lti.base.errors import BagError, ModelError, SignalError
from uncertain_lti.base.files import kind_of
from uncertain_lti.base.text import plural, shortlist
from uncertain_lti.cli.command import (
    ALARM,
    BAD_INPUT,
    DEPLOYED,
    DONE,
    PUBLISHED,
    RECORDINGS,
    UNKNOWN,
    Result,
    complain,
    declared,
    helped,
    load_model,
)

if TYPE_CHECKING:
    from uncertain_lti import UncertainLTI
    from uncertain_lti.monitor.deployed import DeployedMonitor
    from uncertain_lti.monitor.verdict import Verdicts
    from uncertain_lti.recordings.recording import Progress, Recording
    from uncertain_lti.reports.pages import Plotted
    from uncertain_lti.sampling.reading import Decisions


def deployed_monitor(options: argparse.Namespace, model: UncertainLTI) -> DeployedMonitor:
    """The monitor that the options `DEPLOYED` describe."""
    from uncertain_lti import EnvelopeMonitor
    from uncertain_lti.model.model_file import read_rules
    from uncertain_lti.monitor.alarm import Condition
    from uncertain_lti.monitor.deployed import DeployedMonitor, listed_states
    from uncertain_lti.signals.signal_map import below

    if options.rules is not None:
        rules = read_rules(options.rules, model.state_names)
        try:
            model = model.replace(alarm=rules)
        except ModelError as error:
            raise ModelError(f"{options.rules}: does not fit the model: {error}") from None
    condition = Condition.parse(options.enable)
    if options.topic_prefix.strip("/") or options.remap:
        prefix = f"/{options.topic_prefix.strip('/')}"
        read = [*model.signals.topics, *([condition.topic] if condition else [])]
        there = {topic: below(prefix, topic) for topic in read}
        remapped = dict(options.remap)
        for topic in remapped.keys() - there.values():
            raise ModelError(f"--remap {topic}: it is not read; what is read is {', '.join(there.values())}")
        there = {topic: remapped.get(name, name) for topic, name in there.items()}
        model = model.replace(signals=model.signals.moved(there.__getitem__))
        condition = condition and replace(condition, topic=there[condition.topic])
    monitor = EnvelopeMonitor(model, options.violations, options.window, options.margin, listed_states(options.masked))
    return DeployedMonitor(monitor, condition, options.grace, options.latch, options.start, options.stop)


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


class Judged:
    """Recordings judged one by one; of several, one that cannot be read is `refused` and keeps none of the others."""

    def __init__(self, options: argparse.Namespace, model: UncertainLTI, paths: Sequence[str]) -> None:
        from uncertain_lti.recordings.formats import group_recordings

        self.options, self.count, self.alarm = options, len(paths), False
        self.refused: list[dict[str, str]] = []
        group = partial(group_recordings, layout=model.signals.table)
        try:
            self.bags = group(paths)
        except BagError:
            opened = []
            for path in paths:
                with self._refusing(path):
                    group([path])
                    opened.append(path)
            self.bags = group(opened)
        self.count = len(self.bags) + len(self.refused)
        self.deployed = deployed_monitor(options, model)
        self.model = self.deployed.monitor.model  # with the rules that are judged by

    @contextmanager
    def _refusing(self, path: str) -> Iterator[None]:
        try:
            yield
        except (BagError, SignalError) as error:
            if self.count == 1:
                raise
            complain(self.options.command, str(error))
            self.refused.append({"recording": path, "error": str(error)})

    def __iter__(self) -> Iterator[tuple[Recording, Verdicts, Decisions]]:
        progress = self.options.progress
        for bag in self.bags:
            with self._refusing(str(bag.path)):
                verdicts, decisions = check_recording(self.deployed, bag, progress.iterate("reading"))
                progress.note(*verdicts.transient.notes)
                self.alarm = self.alarm or bool(verdicts.alarm.any())
                yield bag, verdicts, decisions
        if self.refused:
            all_of_them = plural(self.count, "recording")
            complain(self.options.command, f"{len(self.refused)} of {all_of_them} not checked, as said above")

    def status(self, recordings: Sequence[Mapping[str, Any]] = ()) -> int:
        """Exit status of what was judged so far, and of what is known of each recording."""
        nothing = UNKNOWN if any(r["outcome"] == "unknown" for r in recordings) else DONE
        return ALARM if self.alarm else BAD_INPUT if self.refused else nothing


# --- check -----------------------------------------------------------------------------------------------------------


_SLOW = "say what took how long"


@declared(
    "check a recording against a model",
    *(PUBLISHED, "bags", *DEPLOYED, helped("--json", "print JSON with a verdict per sample"), "--write"),
    verbose=_SLOW,
)
def check(options: argparse.Namespace) -> Result:
    """Check each recording and return whether the alarm was raised."""
    from uncertain_lti.model.domain import STRANGE, vouched
    from uncertain_lti.monitor.deployed import drift_in_words
    from uncertain_lti.reports.check import OUTCOMES, check_data, check_text, long_repeats, outcome
    from uncertain_lti.reports.findings import overview
    from uncertain_lti.reports.model_text import MOST_SHOWN

    judged = Judged(options, load_model(options.model), options.bags)
    model, bags, deployed = judged.model, judged.bags, judged.deployed
    copies: dict[Recording, Path] = {}
    if options.write is not None:
        from uncertain_lti.reports.annotate import annotate, targets

        copies = dict(zip(bags, targets(options.write, bags), strict=True))
    results, loud, calm = [], list[str](), 0
    for bag, verdicts, decisions in judged:
        data = check_data(model, verdicts, samples=options.json)
        results.append(data)
        farther = vouched(model) < (data["outside_domain_share"] or 0.0) <= STRANGE
        if farther or data["alarm"] and not data["reason"]:
            files = bag.parts if len(bag.parts) > 1 and not bag.path.is_dir() else [bag.path]
            loud += map(shlex.quote, map(str, files))
        if len(bags) > MOST_SHOWN and data["outcome"] not in OUTCOMES[:2] and not long_repeats(data):
            calm += 1
        else:
            apart = "\n" * (len(results) > calm + 1)  # some begin with a headline, before the name
            options.say(apart + check_text(data) + (f" ({words})" if (words := deployed.words()) else ""))
        if (copy := copies.get(bag)) is not None:
            writing = options.progress.iterate("writing")
            made = annotate(bag.parts, verdicts, decisions, copy, model, options.model, deployed.monitor.rule, writing)
            options.progress.note(*made.notes)
            data["written"] = {"file": str(made.path), "topics": made.topics, "messages": made.messages}
            messages = plural(made.messages, "message")
            options.say(f"{messages} and the verdicts below {made.topics} written to {made.path}")
    if len(results) > 1:
        said = f"in this table alone {plural(calm, 'recording')} without an alarm:\n"
        options.say(said * bool(calm) + str(overview(results)))
    status = judged.status(results)
    for text in (drift := drift_in_words(model, results)):
        options.say(text)
    if loud and model.memory and not deployed.words():
        name, those = shlex.quote(options.model), " ".join(loud[:3]) + " ..." * (len(loud) > 3)
        options.say(f"if the machine was healthy: uncertain-lti fit --update {name} --output {name} --force {those}")
    of_all = {"alarm": status == ALARM, "outcome": "unknown" if status == BAD_INPUT else outcome(results)}
    about: dict[str, Any] = {"model": options.model, "deployed": deployed.words(), **of_all, "exit_status": status}
    return Result(status, {**about, "recordings": results, "drift": drift, "not_checked": judged.refused})


# --- report ----------------------------------------------------------------------------------------------------------


@declared(
    "write a page that says whether a model may be relied on, and what happened in recordings",
    PUBLISHED,
    helped("bags", f"{RECORDINGS} to check against it"),
    *DEPLOYED,
    helped("--output", "page to write (default: report.html; with --json none)", metavar="FILE.html"),
    helped("--json", "print the same facts as JSON"),
    verbose=_SLOW,
)
def report(options: argparse.Namespace) -> Result:
    """Write the page or print its facts, and return whether the alarm was raised."""
    from uncertain_lti.reports.findings import findings, findings_text
    from uncertain_lti.reports.pages import html_report, page_target, write_page

    judged = Judged(options, load_model(options.model), options.bags)
    output = options.output or (None if options.json else "report.html")
    if output is not None:
        page_target(output, options.model, judged.bags)
        if not output.lower().endswith((".html", ".htm")):
            raise BagError(f"{output}: a report is a page; end the name in .html")
    checked = [verdicts for _, verdicts, _ in judged]
    if not checked:
        return Result(BAD_INPUT)
    facts = findings(judged.model, options.model, checked, judged.deployed.monitor.rule, judged.deployed.words())
    options.say(findings_text(facts))
    if output is not None:
        write_page(output, html_report(judged.model, checked, facts, options.progress.iterate("drawing", "sections")))
        options.say(f"report written to {output}")
    return Result(judged.status(facts["recordings"]), {**facts, "not_checked": judged.refused})


# --- plot ------------------------------------------------------------------------------------------------------------


_WHAT = "a model file (an image of its elements), recordings (their signals), or a model file and then recordings "
_IMAGE = "page (.html, with zoom and hover) or image (.png, .svg, .pdf) to write (default: plot.html, of a model alone "


@declared(
    "draw a model, recordings, or what happened in recordings by a model",
    helped("bags", f"{_WHAT}(what happened, and when)", metavar="WHAT"),
    helped("--signals", "signals file: draw its signals, not every number that moves", required=False),
    helped("--output", f"{_IMAGE}plot.png)", metavar="FILE"),
    *DEPLOYED,
    helped("--json", "print the path, and whether the alarm was raised, as JSON"),
    verbose=_SLOW,
)
def plot(options: argparse.Namespace) -> Result:
    """Write the plot."""
    from uncertain_lti.recordings.formats import group_recordings
    from uncertain_lti.reports.charts import base_name
    from uncertain_lti.reports.figures import alarm_figure, matrices_figure, save
    from uncertain_lti.reports.pages import HOLDS, interactive_page, page_target, plotted_check, write_page

    first = options.bags[0]
    named = first == "leibov2006" or first.endswith(".json") or kind_of(first) == "a model file"
    model = load_model(first) if named else None
    paths = options.bags[1:] if named else options.bags
    if model is not None and options.signals:
        raise ModelError(f"--signals {options.signals}: the model has its signals; leave the option out")
    judged = None if model is None or not paths else Judged(options, model, paths)
    bags = group_recordings(paths) if judged is None else judged.bags
    output = Path(options.output or ("plot.html" if paths else "plot.png"))
    page = output.suffix == ".html"
    if output.suffix not in HOLDS:
        raise BagError(f"{output}: a plot is a page or an image; end the name in .html, .png, .svg or .pdf")
    if page and not paths:
        raise ModelError(f"{output}: a model alone is drawn as an image; end the name in .png, .svg or .pdf")
    if not page and model is None:
        raise BagError(f"{output}: recordings without a model are drawn as a page; end the name in .html")
    if not page and judged is not None and judged.count > 1:
        raise BagError(f"{output}: an image shows one recording; name one, or end the name in .html")
    page_target(output, first if named else "", bags)
    if page:
        if judged is None:
            about, plotted = "Recorded", _recorded(options, bags)
        else:
            about = os.path.basename(first)
            plotted = [plotted_check(judged.model, verdicts, len(bags)) for _, verdicts, _ in judged]
        if not plotted:
            nothing = "no recording could be checked, so nothing is drawn"
            raise BagError(f"{nothing}; name one that has the topics of the model")
        title = f"{about}: {shortlist([base_name(bag.path) for bag in bags], 1)}"
        write_page(output, interactive_page(title, plotted))
    elif judged is not None:
        for _, verdicts, _ in judged:
            save(alarm_figure(judged.model, verdicts), output, 200)
    elif model is not None:
        save(matrices_figure(model), output, 200)
    options.say(f"plot written to {output}")
    status = DONE if judged is None else judged.status()
    recordings = [str(bag.path) for bag in bags]
    data = {"plot": str(output), "recordings": recordings, "alarm": status == ALARM, "exit_status": status}
    return Result(status, data)


def _recorded(options: argparse.Namespace, bags: Sequence[Recording]) -> list[Plotted]:
    from uncertain_lti.reports.pages import plotted_fields, plotted_transient

    if options.signals:
        from uncertain_lti import read_transients

        runs = read_transients([bag.path for bag in bags], options.signals, options.progress.iterate("reading"))
        options.progress.note(*(note for transient in runs for note in transient.notes))
        return [plotted_transient(transient, len(runs)) for transient in runs]
    from uncertain_lti.proposal.init import moving_numbers

    plotted = []
    for bag in bags:
        fields, left = moving_numbers(bag, options.progress.iterate("reading"))
        options.progress.note(*bag.warnings)
        if not fields:
            raise BagError(f"{bag.path}: no number in it moves; `uncertain-lti topics {bag.path}` lists what it holds")
        note = "Every number that moves, over the time of arrival." + f" Left out: {shortlist(left, 8)}." * bool(left)
        plotted.append(plotted_fields(str(bag.path), fields, note, len(bags)))
    return plotted
