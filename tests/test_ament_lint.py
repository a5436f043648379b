# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The linters of ROS 2, with this repository's settings, if an installation of ROS 2 has them."""

import pytest
from conftest import ROOT

PACKAGES = ["core", "uncertain_lti_ros", "launch", "setup.py"]
EVERYTHING = [*PACKAGES, "benchmarks", "docs", "examples", "tests"]
IN_TESTS = ["tests/checkout/uncertain_lti", "tests/checkout/uncertain_lti_ros"]  # under the names that are imported
NO_WORDS = ["D101", "D102", "D103", "D105", "D401", "D403", "D404"]
"""Codes of pydocstyle that private names, and sentences that begin with a formula, do not keep."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("linter", "options"),
    [
        ("copyright", EVERYTHING),
        ("flake8", ["--config", "setup.cfg", *EVERYTHING]),
        ("pep257", ["--convention", "numpy", "--add-ignore", *NO_WORDS, "--", *PACKAGES]),
        ("mypy", ["--config", "pyproject.toml", *IN_TESTS]),
    ],
)
def test_a_linter_of_ros_2_has_nothing_to_say(linter, options, monkeypatch, capsys):
    reason = f"ament_{linter} comes with ROS 2, and is not installed"
    main = pytest.importorskip(f"ament_{linter}.main", reason=reason).main
    monkeypatch.chdir(ROOT)
    assert main(argv=options) == 0, capsys.readouterr().out
