"""The program `uncertain-lti`: finds the command, runs it and reports errors."""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Sequence
from typing import NoReturn

from uncertain_lti import __version__
from uncertain_lti.base.errors import UncertainLTIError
from uncertain_lti.base.progress import Progress
from uncertain_lti.cli import check, fit, info, init, layout, report, reproduce, ros, topics, validate
from uncertain_lti.cli.command import BAD_INPUT, DONE, INTERRUPTED, Command

COMMANDS: tuple[Command, ...] = (
    topics.COMMAND,
    init.COMMAND,
    fit.COMMAND,
    check.COMMAND,
    report.COMMAND,
    layout.COMMAND,
    validate.COMMAND,
    info.COMMAND,
    reproduce.COMMAND,
    ros.PLAY,
    ros.RECORD,
    ros.DEMO,
)
"""Every command, in the order of the help."""

_FIT = "install what fitting needs: pip install 'uncertain-lti-ros[fit]'"
_ROS = "source a ROS 2 Jazzy installation, or pip install 'uncertain-lti-ros[ros]'"
_EXTRAS = {
    **dict.fromkeys(("cvxpy", "osqp", "daqp", "piqp", "highspy", "scipy"), _FIT),
    **dict.fromkeys(("rclpy", "std_msgs", "sensor_msgs", "rosgraph_msgs", "std_srvs", "uncertain_lti_ros"), _ROS),
    "distributed": "install what a cluster needs: pip install 'uncertain-lti-ros[cluster]'",
    **dict.fromkeys(("matplotlib", "PIL"), "install what figures need: pip install 'uncertain-lti-ros[plots]'"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Parameters
    ----------
    arguments : sequence of str, optional
        Words of the command line; default those of the process.

    Returns
    -------
    int
        Exit status: 0 done, 1 the alarm was raised, 2 bad usage or input, 130 interrupted.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    command = next((a for a in given if not a.startswith("-")), "")
    try:
        options = build_parser(command).parse_args(given)
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


def build_parser(chosen: str = "") -> argparse.ArgumentParser:
    """Declare the arguments of every command; those that need rclpy, only of the chosen one.

    Parameters
    ----------
    chosen : str, default ""
        Name of the command that will run, or empty.

    Returns
    -------
    argparse.ArgumentParser
        Of the whole program.
    """
    parser = _Parser(
        prog="uncertain-lti",
        description="Fit an uncertain linear model to recorded transients, and tell when a machine leaves it.",
        epilog="Exit status: 0 done, 1 the alarm was raised, 2 bad usage or input, 130 interrupted by Ctrl-C.",
    )
    parser.add_argument("--version", action="version", version=f"uncertain-lti {__version__}")
    parsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for command in COMMANDS:
        text = command.help
        sub = parsers.add_parser(command.name, help=text, description=text[0].upper() + text[1:] + ".")
        sub.set_defaults(run=command.run)
        if command.quiet:
            output = sub.add_mutually_exclusive_group()
            output.add_argument("-q", "--quiet", action="store_true", help=command.quiet)
            if command.verbose:
                output.add_argument("-v", "--verbose", action="store_true", help=command.verbose)
        if not command.deferred or command.name == chosen:
            command.add_arguments(sub)
    return parser


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


if __name__ == "__main__":
    sys.exit(main())
