# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Errors meant for a person: one sentence that names the file, topic or field, and the remedy."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from uncertain_lti.base.text import printable


class UncertainLTIError(Exception):
    """Base of every error raised on purpose; the command line prints it without a traceback.

    Names in it may come from any file, so its text is one line without control characters.
    """

    def __str__(self) -> str:
        return printable(super().__str__())


class BagError(UncertainLTIError):
    """A recording cannot be found, opened, read or written."""


class SignalError(UncertainLTIError):
    """A signals file, a field path or a topic does not describe a number that can be read."""


class ModelError(UncertainLTIError):
    """A model file or the matrices of a model are not what the format allows."""


class TransientError(UncertainLTIError):
    """Arrays, a data frame or a CSV file do not form a transient."""


class FitError(UncertainLTIError):
    """The identification problem has no usable solution for this data."""


class UnprovenError(FitError):
    """What a model keeps of its recordings does not prove the optimum of all: earlier ones are needed again."""


def refuse_other(value: object, kind: type | tuple[type, ...], what: str, instead: str, error: type[Exception]) -> None:
    """Refuse a value of another type than the one asked for."""
    if not isinstance(value, kind):
        of = "None" if value is None else f"of type {type(value).__name__}"
        raise error(f"{what} is {of}; {instead}")


def each_of(values: Any, kind: type | tuple[type, ...], what: str, instead: str, error: type[Exception]) -> list[Any]:
    """What a list of values of a type holds; a text is none."""
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise error(f"{what} is of type {type(values).__name__}; {instead}")
    found = list(values)
    for value in found:
        refuse_other(value, kind, f"{what}: one of them", instead, error)
    return found


_EXTRAS = {
    "fit": "daqp highspy piqp scipy threadpoolctl",
    "oracle": "cvxpy osqp",
    "plots": "PIL jinja2 markupsafe matplotlib",
    "tables": "pyarrow",
    "control": "control",
    "cluster": "distributed",
    "completion": "shtab",
    "ros": "rclpy rosgraph_msgs sensor_msgs std_msgs std_srvs uncertain_lti_ros",
    "": "lz4 mcap rosbags tqdm zstandard",
}
"""What brings which packages: an extra of setup.py, or every installation."""


def absent(package: str | None) -> str:
    """That a package is not installed, and the remedy; empty where it is none of ours."""
    first = (package or "").partition(".")[0]
    for extra, packages in _EXTRAS.items():
        if first in packages.split():
            ros = "source a ROS 2 Jazzy installation, or " * (extra == "ros")
            what = "pip install " + (f"'.[{extra}]'" if extra else "., or rosdep with its folder rosdep")
            made_for = Path(sys.prefix, "made-for")  # by ./run, for the programs alone
            if made_for.is_file() and made_for.read_text() == "use\n":
                what = "./run setup --all"
            return f"the Python package {first} is not installed; {ros}in the checkout: {what}"
    return ""
