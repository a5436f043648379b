"""The programs that run as nodes; what they need and is not installed is one sentence, and no traceback."""

from __future__ import annotations

import sys
import traceback
from importlib import import_module

_BAD_USAGE, _FAULT, _INTERRUPTED = 2, 70, 130


def envelope_monitor() -> int:
    """The live monitor.

    Returns
    -------
    int
        Exit status.
    """
    return _run("envelope_monitor")


def plant() -> int:
    """The published engine.

    Returns
    -------
    int
        Exit status.
    """
    return _run("plant")


def turbofan() -> int:
    """The nonlinear engine.

    Returns
    -------
    int
        Exit status.
    """
    return _run("turbofan")


def _run(name: str) -> int:
    try:
        main = import_module(f"uncertain_lti_ros.{name}").main
    except ImportError as error:
        package = (error.name or "").partition(".")[0]
        absent = isinstance(error, ModuleNotFoundError) and package
        what = f"the Python package {package} is not installed" if absent else str(error).partition("\n")[0]
        remedy = "source a ROS 2 Jazzy installation, or pip install 'uncertain-lti-ros[ros]'"
        print(f"{name}: {what}; {remedy}", file=sys.stderr)
        return _BAD_USAGE
    except KeyboardInterrupt:
        return _INTERRUPTED
    except Exception:
        return _fault(name)
    try:
        return int(main())
    except Exception:
        return _fault(name)


def _fault(name: str) -> int:
    """Print what nobody expected; a traceback alone would end with 1, which means an alarm elsewhere."""
    traceback.print_exc()
    print(f"{name}: this is a fault of the program; please report it with the lines above", file=sys.stderr)
    return _FAULT
