"""The command `uncertain-lti`."""

from __future__ import annotations

import argparse
import json
import logging
import os
import re
import shlex
import sys
import time
from collections.abc import Iterable, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from uncertain_lti import __version__
from uncertain_lti.base.errors import BagError, FitError, ModelError, SignalError, UncertainLTIError
from uncertain_lti.base.progress import Progress

if TYPE_CHECKING:
    from uncertain_lti import UncertainLTI

DONE, ALARM, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; exit status 0 done, 1 the alarm was raised, 2 bad usage or input, 130 interrupted."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    command = next((a for a in given if not a.startswith("-")), "")
    try:
        options = _parser(command).parse_args(given)
        with Progress(getattr(options, "quiet", False), getattr(options, "verbose", False)) as options.progress:
            return int(options.run(options))
    except UncertainLTIError as error:
        print(f"uncertain-lti {command}: {error}", file=sys.stderr)
        return BAD_INPUT
    except ModuleNotFoundError as error:
        extra = _EXTRAS.get((error.name or "").partition(".")[0])
        if extra is None:
            raise
        print(
            f"uncertain-lti {command}: the Python package {error.name} is not installed; {extra}",
            file=sys.stderr,
        )
        return BAD_INPUT
    except BrokenPipeError:  # `| head` has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except KeyboardInterrupt:
        print(f"uncertain-lti {command}: interrupted; no half-written file is left", file=sys.stderr)
        return INTERRUPTED


_FIT = "install what fitting needs: pip install 'uncertain-lti-ros[fit]'"
_ROS = "source a ROS 2 Jazzy installation, or pip install 'uncertain-lti-ros[ros]'"
_EXTRAS = {
    **dict.fromkeys(("cvxpy", "osqp", "daqp", "piqp", "highspy", "scipy"), _FIT),
    **dict.fromkeys(("rclpy", "std_msgs", "sensor_msgs", "rosgraph_msgs", "std_srvs", "uncertain_lti_ros"), _ROS),
    "distributed": "install what a cluster needs: pip install 'uncertain-lti-ros[cluster]'",
    **dict.fromkeys(("matplotlib", "PIL"), "install what figures need: pip install 'uncertain-lti-ros[plots]'"),
}


def _parser(chosen: str) -> argparse.ArgumentParser:
    """Arguments of every command; those of the ROS commands, which import rclpy, only of the chosen one."""
    parser = _Parser(
        prog="uncertain-lti",
        description="Fit an uncertain linear model to recorded transients, and tell when a machine leaves it.",
        epilog="Exit status: 0 done, 1 the alarm was raised, 2 bad usage or input, 130 interrupted by Ctrl-C.",
    )
    parser.add_argument("--version", action="version", version=f"uncertain-lti {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)

    def command(name: str, run: Any, text: str, quiet: str = "", verbose: str = "") -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        sub.set_defaults(run=run)
        if quiet:
            talk = sub.add_mutually_exclusive_group()
            talk.add_argument("-q", "--quiet", action="store_true", help=quiet)
            if verbose:
                talk.add_argument("-v", "--verbose", action="store_true", help=verbose)
        return sub

    silent = "print errors only (and with --json the data): no summary, no notes, no progress"

    topics = command(
        "topics",
        _topics,
        "list the topics of a recording, and which fields could be signals",
        "print the list and errors only: no notes, no progress",
    )
    topics.add_argument("bag", metavar="BAG", help="MCAP file, or folder of a recording")
    topics.add_argument("--json", action="store_true", help="print JSON")

    init = command(
        "init",
        _init,
        "propose a signals file for a recording, with reasons, for you to edit",
        "print errors only (and without --output the file): no summary, no notes, no progress",
    )
    init.add_argument("bags", metavar="BAG", nargs="+", help="MCAP files and folders of the same machine")
    init.add_argument("--output", metavar="FILE", help="signals file to write; must not exist yet (default: print it)")

    fit = command(
        "fit", _fit, "fit a model to recordings", silent, "say every pass over the data, and what took how long"
    )
    fit.add_argument(
        "bags", metavar="BAG", nargs="+", help="MCAP files and folders; parts of a split bag are one recording"
    )
    fit.add_argument(
        "--signals", required=True, metavar="FILE", help="signals file (YAML): which field is which signal"
    )
    fit.add_argument("--output", required=True, metavar="MODEL", help="model file to write (*.model.json)")
    fit.add_argument("--criterion", choices=("qp", "lp"), default="qp", help="(10) squared or (11) largest width")
    fit.add_argument(
        "--additive",
        choices=("none", "disturbance", "noise", "both"),
        help="further terms: drift with its half-width, measurement noise (default: the signals file's, else none)",
    )
    fit.add_argument("--json", action="store_true", help="print JSON")

    fit.add_argument(
        "--discard",
        type=_budget,
        default=0,
        metavar="K",
        help="leave at most K transitions outside (or a share such as 0.001), chosen by effect and listed",
    )
    fit.add_argument(
        "--count",
        choices=("sample", "transient"),
        default="sample",
        help="let every sample weigh the same (default), or every recording however long it is",
    )
    fit.add_argument("--cache", metavar="FOLDER", help="more recordings than memory: keep the arrays in this folder")
    fit.add_argument("--scheduler", metavar="ADDRESS", help="fit on the workers of this Dask scheduler")
    fit.add_argument("--workers", type=int, metavar="N", help="fit on a Dask cluster of N workers on this machine")

    check = command("check", _check, "check a recording against a model", silent, "say what took how long")
    check.add_argument("model", metavar="MODEL", help="model file, or leibov2006 for the published one")
    check.add_argument("bags", metavar="BAG", nargs="+", help="MCAP files and folders")
    check.add_argument("--violations", type=int, help="alarm: so many violations (default: the model's)")
    check.add_argument("--window", type=int, help="alarm: among so many last verdicts (default: the model's)")
    check.add_argument("--margin", type=float, help="factor on the half-widths (default: the model's)")
    check.add_argument("--json", action="store_true", help="print JSON with a verdict per sample")
    check.add_argument(
        "--write",
        metavar="OUT.mcap",
        help="write a copy of the recording with bounds, utilisation and flags on topics of their own; "
        "for several recordings a folder",
    )

    report = command(
        "report",
        _report,
        "write a page that says whether a model may be relied on, and what happened in recordings",
        silent,
        "say what took how long",
    )
    report.add_argument("model", metavar="MODEL", help="model file, or leibov2006 for the published one")
    report.add_argument("bags", metavar="BAG", nargs="+", help="MCAP files and folders to check against it")
    report.add_argument("--output", metavar="FILE.html", help="page to write (default: report.html; with --json none)")
    report.add_argument("--json", action="store_true", help="print the same facts as JSON")

    layout = command("layout", _layout, "write layouts of viewers for what a model's monitor publishes")
    layout.add_argument("model", metavar="MODEL", help="model file, or leibov2006 for the published one")
    layout.add_argument("--foxglove", metavar="FILE.json", help="for Foxglove and Lichtblick")
    layout.add_argument("--plotjuggler", metavar="FILE.xml", help="for PlotJuggler")
    layout.add_argument("--topics", metavar="NAME", help="what the topics begin with (default: /envelope_monitor)")

    validate = command(
        "validate",
        _validate,
        "tell how far to trust a model, by leaving out what it was fitted to",
        silent,
        "say every fit, and what took how long",
    )
    validate.add_argument("model", metavar="MODEL", help="model file")
    validate.add_argument(
        "bags", metavar="BAG", nargs="*", help="MCAP files and folders (default: those the model was fitted to)"
    )
    validate.add_argument("--blocks", type=int, help="leave out blocks: so many per recording (a single one: 10)")
    validate.add_argument("--gap", type=float, help="s beside a left-out block that are not fitted either")
    validate.add_argument("--confidence", type=float, default=0.9, help="of every interval (default: 0.9)")
    validate.add_argument(
        "--false-alarms", type=float, metavar="PER_HOUR", help="find the alarm rule that stays below so many per hour"
    )
    validate.add_argument(
        "--output",
        metavar="MODEL",
        help="write the model with this validation, and the alarm rule found, to this file; where --false-alarms "
        "finds none, nothing is written and the exit status is 2",
    )
    validate.add_argument("--json", action="store_true", help="print JSON")

    info = command("info", _info, "show what is in a model file")
    info.add_argument("model", metavar="MODEL", help="model file, or leibov2006 for the published one")
    info.add_argument("--json", action="store_true", help="print the file as JSON")

    reproduce = command(
        "reproduce",
        _reproduce,
        "run the paper's experiment on the nonlinear turbofan",
        "print errors only; everything is in the folder",
    )
    reproduce.add_argument(
        "--output", default="reproduce-output", metavar="FOLDER", help="for figures, models and numbers"
    )

    for name, module, text in (
        ("play", "player", "publish a recording through rclpy"),
        ("record", "recorder", "record topics through rclpy"),
        ("demo", "demo", "fit shipped recordings of a turbofan and watch another, in which a fault sets in, live"),
    ):
        sub = command(name, _ros(module), text)
        if name == chosen:
            import_module(f"uncertain_lti_ros.{module}").add_arguments(sub)
    return parser


def _ros(module: str) -> Any:
    def run(options: argparse.Namespace) -> int:
        return int(import_module(f"uncertain_lti_ros.{module}").run(options))

    return run


def _budget(text: str) -> float:
    """A whole number, or a share below 1."""
    try:
        return int(text) if text.isdigit() else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a whole number nor a share such as 0.001") from None


def _model_target(wish: str) -> Path:
    """Where a model goes; raises as `files.target`."""
    from uncertain_lti.base.files import target

    return target(wish, holds=b'"uncertain-lti/', kind="model file", example="machine.model.json")


class _Parser(argparse.ArgumentParser):
    """Names the nearest command, option or choice in place of a misspelt one."""

    def error(self, message: str) -> NoReturn:
        from uncertain_lti.base.english import meant

        if match := re.search(r"invalid choice: '?(.*?)'? \(choose from (.*)\)", message):
            message += meant(match[1], re.findall(r"[\w-]+", match[2]))
        elif message.startswith("unrecognized arguments: "):
            commands: list[dict[str, argparse.ArgumentParser]] = [
                a.choices for a in self._actions if isinstance(a.choices, dict)
            ]
            known = {o for group in commands for p in group.values() for o in p._option_string_actions}
            message += meant(message.split(": ")[1].split()[0].partition("=")[0], known)
        super().error(message)


def _topics(options: argparse.Namespace) -> int:
    from uncertain_lti.recordings.bag import Bag, describe
    from uncertain_lti.reports.text import number, table

    bag = Bag(options.bag)
    facts = describe(bag, options.progress.iterate("reading"))
    if options.json:
        _print_json(
            {
                "recording": str(bag.path),
                "warnings": bag.warnings,
                "topics": [
                    {
                        "topic": f.info.topic,
                        "type": f.info.type,
                        "count": f.info.count,
                        "readable": f.info.readable,
                        "reason": f.info.reason,
                        "rate": f.rate,
                        "largest_gap": f.largest_gap,
                        "header_stamps": f.stamps,
                        "log_minus_header": f.stamp_offset,
                        "fields": list(f.fields),
                    }
                    for f in facts
                ],
            }
        )
        return DONE
    _say(options, bag.warnings)
    rows = []
    for f in facts:
        stamps: str = f.stamps
        if f.stamp_offset is not None and abs(f.stamp_offset) > 1.0:
            stamps += f", log {f.stamp_offset:+.0f} s"
        rows.append([f.info.topic, f.info.type, str(f.info.count), number(f.rate), number(f.largest_gap), stamps])
    print(table(("topic", "type", "messages", "rate [1/s]", "largest gap [s]", "header stamps"), rows))
    for f in facts:
        if not f.info.readable or f.info.reason:
            print(f"{f.info.topic}: {f.info.reason}")
        if f.fields:
            print(f"{f.info.topic}: {', '.join(f.fields)}")
    return DONE


def _init(options: argparse.Namespace) -> int:
    from uncertain_lti.base.files import whole_file
    from uncertain_lti.proposal.init import propose

    output = options.output
    if output is not None and os.path.exists(output):
        raise SignalError(f"{output}: is there already; choose another output, or move it away")
    proposal = propose(options.bags, options.progress.iterate("reading"))
    _say(options, proposal.warnings)
    if output is None:
        print(proposal.text, end="")
        return DONE
    try:
        with whole_file(output) as stream:
            stream.write(proposal.text.encode())
    except OSError as error:
        raise SignalError(f"{output}: cannot be written: {error.strerror}; choose another place") from None
    options.progress.say(
        f"states: {', '.join(c.name for c in proposal.states)}\n"
        f"controls: {', '.join(c.name for c in proposal.controls) or 'none found'}\n"
        f"signals file written to {output}: read it and edit it, it says why; then\n"
        f"  uncertain-lti fit {shlex.join(options.bags)} --signals {shlex.quote(output)} --output machine.model.json"
    )
    return DONE


def _fit(options: argparse.Namespace) -> int:
    from uncertain_lti import fit, read_transients
    from uncertain_lti.base.files import sha256
    from uncertain_lti.reports.text import fit_text, left_out_text, next_text, recording_text
    from uncertain_lti.validation.left_out import leave_out_cheaply

    output = _model_target(options.output)
    if options.workers is not None and options.workers < 1:
        raise FitError(f"--workers is {options.workers}; give 1 or more")
    if options.cache or options.scheduler or options.workers:
        return _fit_archive(options, output)
    transients = read_transients(options.bags, options.signals, options.progress.iterate("reading"), processes=None)
    for transient in transients:
        if not options.json:
            _say(options, transient.notes)
        _tell(options, recording_text(transient))
    began = time.perf_counter()
    with options.progress.stage("fitting") as step:
        model = fit(
            transients,
            options.criterion,
            additive=options.additive,
            discard=options.discard,
            count=options.count,
            seek_carriers=True,
            progress=step,
        )
    sources = [{"file": name, "sha256": sha256(name)} for t in transients for name in t.sources]
    model = model.replace(fit_summary={**model.fit_summary, "sources": sources})
    with options.progress.stage("validating") as step:
        left_out = leave_out_cheaply(transients, model, time.perf_counter() - began, step)
    if left_out is not None:
        model = model.replace(validation=left_out)
    model.save(output)
    if options.json:
        data = model.to_dict()
        _print_json({"model": str(output), "fit": data["fit"], "validation": data["validation"]})
    else:
        _tell(options, fit_text(model, transients))
        if left_out is not None:
            _tell(options, left_out_text(left_out))
        _tell(options, f"model written to {output}")
        _tell(options, next_text(model, shlex.quote(str(output)), left_out))
    return DONE


def _fit_archive(options: argparse.Namespace, output: Path) -> int:
    from contextlib import ExitStack

    from uncertain_lti.base.files import sha256
    from uncertain_lti.identification.archive import fit_archive
    from uncertain_lti.reports.text import archive_text, next_text

    if options.discard:
        raise FitError("--discard goes through all transitions in memory; leave out --cache, --scheduler and --workers")
    if options.count != "sample":
        raise FitError("--count transient needs all recordings in memory; leave out --cache, --scheduler and --workers")
    if options.cache and (options.scheduler or options.workers):
        raise FitError("--cache keeps the arrays on disk and --scheduler or --workers on a cluster; choose one")
    with ExitStack() as stack:
        client = None
        if options.scheduler or options.workers:
            dask: Any = import_module("distributed")

            where = options.scheduler or stack.enter_context(_local_cluster(dask, options.workers))
            try:
                client = stack.enter_context(dask.Client(where, timeout=10))
            except (OSError, TimeoutError, ValueError):
                raise FitError(f"no Dask scheduler answers at {where}; start one with `dask scheduler`") from None
        with options.progress.stage("fitting") as step:
            model = fit_archive(
                options.bags,
                options.signals,
                options.criterion,
                options.additive,
                cache=options.cache,
                client=client,
                progress=step,
            )
    sources = [{**s, "sha256": sha256(s["file"])} for s in model.fit_summary["sources"]]
    model = model.replace(fit_summary={**model.fit_summary, "sources": sources})
    model.save(output)
    if options.json:
        _print_json({"model": str(output), "fit": model.to_dict()["fit"]})
    else:
        _tell(options, archive_text(model))
        _tell(options, f"model written to {output}")
        _tell(options, next_text(model, shlex.quote(str(output)), None))
    return DONE


def _local_cluster(dask: Any, workers: int) -> Any:
    """Worker processes that leave Ctrl-C to this one, which ends them."""
    from uncertain_lti.sampling.reading_processes import children_ignore_ctrl_c

    with children_ignore_ctrl_c():
        return dask.LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            host="127.0.0.1",
            dashboard_address=None,
            silence_logs=logging.CRITICAL,  # of work that is broken off; what goes wrong comes back as an error
        )


def _check(options: argparse.Namespace) -> int:
    from uncertain_lti import EnvelopeMonitor
    from uncertain_lti.base.english import plural
    from uncertain_lti.recordings.bag import group_recordings
    from uncertain_lti.reports.text import check_data, check_text
    from uncertain_lti.sampling.reading import read_as_fitted_with_decisions

    model = _named(options.model)
    monitor = EnvelopeMonitor(model, options.violations, options.window, options.margin)
    bags = group_recordings(options.bags)
    copies: Sequence[Path | None] = [None] * len(bags)
    if options.write is not None:
        from uncertain_lti.reports.annotate import annotate, targets

        copies = targets(options.write, bags)
    results = []
    for bag, copy in zip(bags, copies, strict=True):
        transient, decisions = read_as_fitted_with_decisions(bag, model.signals, options.progress.iterate("reading"))
        _say(options, transient.notes)
        verdicts = monitor.check(transient)
        data = check_data(model, verdicts, samples=options.json)
        results.append(data)
        _tell(options, check_text(data))
        if copy is not None:
            writing = options.progress.iterate("writing")
            made = annotate(bag.parts, verdicts, decisions, copy, model, options.model, monitor.rule, writing)
            _say(options, made.notes)
            data["written"] = {"file": str(made.path), "topics": made.topics, "messages": made.messages}
            _tell(
                options,
                f"{plural(made.messages, 'message')} and the verdicts below {made.topics} written to {made.path}",
            )
    if options.json:
        _print_json({"model": options.model, "alarm": any(r["alarm"] for r in results), "recordings": results})
    return ALARM if any(r["alarm"] for r in results) else DONE


def _report(options: argparse.Namespace) -> int:
    from uncertain_lti import EnvelopeMonitor
    from uncertain_lti.recordings.bag import group_recordings
    from uncertain_lti.reports.findings import findings, page_target
    from uncertain_lti.reports.text import findings_text
    from uncertain_lti.sampling.reading import read_as_fitted

    model = _named(options.model)
    bags = group_recordings(options.bags)
    output = page_target(options.output or (None if options.json else "report.html"), options.model, bags)
    monitor = EnvelopeMonitor(model)
    checked = []
    for bag in bags:
        transient = read_as_fitted(bag, model.signals, options.progress.iterate("reading"))
        _say(options, transient.notes)
        checked.append(monitor.check(transient))
    facts = findings(model, options.model, checked, monitor.rule)
    _tell(options, findings_text(facts))
    if output is not None:
        from uncertain_lti.reports.html import html_report, write_page

        write_page(output, html_report(model, checked, facts, options.progress.iterate("drawing", "sections")))
        _tell(options, f"report written to {output}")
    if options.json:
        _print_json(facts)
    return ALARM if facts["alarm"] else DONE


def _layout(options: argparse.Namespace) -> int:
    from uncertain_lti.reports.layouts import write_layouts

    for path in write_layouts(_named(options.model), options.foxglove, options.plotjuggler, options.topics):
        print(f"layout written to {path}")
    return DONE


def _validate(options: argparse.Namespace) -> int:
    from uncertain_lti import UncertainLTI
    from uncertain_lti.recordings.bag import group_recordings
    from uncertain_lti.reports.text import validation_text
    from uncertain_lti.sampling.reading import read_as_fitted
    from uncertain_lti.validation.calibration import calibrate
    from uncertain_lti.validation.left_out import validate_model

    model = UncertainLTI.load(options.model)
    sources = model.fit_summary.get("sources", [])
    bags = options.bags or [s["file"] for s in sources]
    if not bags:
        raise BagError(f"{options.model}: does not say which recordings it was fitted to; name them")
    if options.output is not None:
        _model_target(options.output)
    reading = options.progress.iterate("reading")
    transients = [read_as_fitted(bag, model.signals, reading) for bag in group_recordings(bags)]
    for transient in transients:
        _say(options, transient.notes)
    with options.progress.stage("validating") as step:
        validation = validate_model(
            model, transients, blocks=options.blocks, gap=options.gap, confidence=options.confidence, progress=step
        )
    data = validation.to_dict()
    refusal = ""
    if options.false_alarms is not None:
        calibration = calibrate(validation, options.false_alarms)
        data["calibration"] = calibration.to_dict()
        if calibration.alarm_rule is not None:
            model = model.replace(alarm_rule=calibration.alarm_rule)
        elif options.output is not None:
            refusal = f"{options.output}: not written: {calibration.words}"
    model = model.replace(validation=data)
    output = None if refusal else options.output
    if output is not None:
        model.save(output)
    if options.json:
        _print_json({"model": output or options.model, "validation": model.to_dict()["validation"]})
    else:
        _tell(options, validation_text(data))
        if output is not None:
            rule = f"{model.alarm_rule.violations} of {model.alarm_rule.window}, margin {model.alarm_rule.margin:.3g}"
            kept = ", unchanged" if options.false_alarms is None else ""
            _tell(options, f"model written to {output}; its alarm rule{kept}: {rule}")
    if refusal:  # whoever asked for a rule and deploys the file would deploy one without it
        raise FitError(refusal)
    return DONE


def _reproduce(options: argparse.Namespace) -> int:
    from uncertain_lti.plants.reproduce import reproduce

    try:
        with options.progress.stage("reproducing") as step:
            reproduce(options.output, options.progress.say, step)
    except OSError as error:
        raise BagError(f"{options.output}: cannot be written: {error.strerror}; choose another folder") from None
    return DONE


def _named(model: str) -> UncertainLTI:
    """The model of a file, or the paper's by its name."""
    from uncertain_lti import UncertainLTI
    from uncertain_lti.base.english import meant
    from uncertain_lti.plants.leibov import leibov2006

    if not os.path.exists(model):
        if model == "leibov2006":
            return leibov2006()
        if near := meant(model, ["leibov2006"]):
            raise ModelError(f"{model}: there is no such model file{near}; write one with `uncertain-lti fit`")
    return UncertainLTI.load(model)


def _info(options: argparse.Namespace) -> int:
    from uncertain_lti.reports.text import model_text

    model = _named(options.model)
    if options.json:
        _print_json(model.to_dict())
    else:
        print(model_text(model))
    return DONE


def _tell(options: argparse.Namespace, text: str) -> None:
    """Print part of a summary for a person, unless told otherwise."""
    if not options.json:
        options.progress.say(text)


def _print_json(data: Any) -> None:
    json.dump(data, sys.stdout, allow_nan=False, indent=1)
    sys.stdout.write("\n")


def _say(options: argparse.Namespace, notes: Iterable[str]) -> None:
    for note in notes:
        options.progress.note(note)


if __name__ == "__main__":
    sys.exit(main())
