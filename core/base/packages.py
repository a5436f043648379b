# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Python packages that not every installation has, and how to get them."""

from __future__ import annotations

import sys
from pathlib import Path

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


def _made_by_run() -> bool:
    """Whether this is the environment that ./run makes for the programs alone."""
    made_for = Path(sys.prefix, "made-for")
    return made_for.is_file() and made_for.read_text() == "use\n"


def absent(package: str | None) -> str:
    """That a package is not installed, and the remedy; empty where it is none of ours."""
    first = (package or "").partition(".")[0]
    for extra, packages in _EXTRAS.items():
        if first in packages.split():
            ros = "source a ROS 2 Jazzy installation, or " * (extra == "ros")
            what = "pip install " + (f"'.[{extra}]'" if extra else "., or rosdep with its folder rosdep")
            if _made_by_run():
                what = "./run setup --all"
            return f"the Python package {first} is not installed; {ros}in the checkout: {what}"
    return ""
