# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""docs/claims.md names commands that exist: files, tests and options. What they show is theirs to test."""

import itertools
import re
import shlex

import pytest
from conftest import ROOT

from uncertain_lti.cli.main import build_parser


def rows() -> list[list[str]]:
    """Cells of every row of the tables."""
    lines = (ROOT / "docs" / "claims.md").read_text().splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if re.match(r"\| (?!claim )", line)]


COMMANDS = sorted({cell for row in rows() for cell in re.findall(r"`([^`]+)`", row[1])})


def wanting(command: str) -> list[str]:
    """What of a command does not exist."""
    program, *words = itertools.dropwhile(lambda word: re.match(r"[A-Z_]+=", word), shlex.split(command))
    if program == "uncertain-lti":
        try:
            build_parser(words[0]).parse_args(words)
        except SystemExit:
            return [f"arguments of {command}"]
        return []
    if program == "pytest":
        named = [word.partition("::") for word in words[: words.index("-k") if "-k" in words else None]]
        return [file for file, _, test in named if not there(file, rf"def {test}\(" if test else "")]
    script, *given = words
    if program != "python" or not there(script, ""):
        return [script]
    values = {after for word, after in itertools.pairwise(given) if word.startswith("--")}
    return [word for word in given if word not in values and not there(script, rf"\"{word}\"|def {word}\(")]


def there(file: str, pattern: str) -> bool:
    """Whether there is a file, and this in it: a test, or what a script takes."""
    return (ROOT / file).is_file() and re.search(pattern, (ROOT / file).read_text()) is not None


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_exists(command):
    assert wanting(command) == []


@pytest.mark.parametrize(
    "command",
    [
        "uncertain-lti nothing", "uncertain-lti reproduce --nothing", "pytest tests/test_nothing.py",
        "pytest tests/test_claims.py::test_nothing", "python benchmarks/nothing.py", "python benchmarks/fit.py nothing",
        "python benchmarks/fit.py million --nothing",
    ],
)  # fmt: skip
def test_a_command_that_does_not_exist_is_found(command, capsys):
    assert wanting(command) != []


def test_every_claim_has_a_command_and_every_benchmark_a_claim():
    assert all(len(row) == 5 for row in rows())
    for row in rows():
        assert "`" in row[1] or row[1] == "the same" or set(row[0]) == {"-"}, row
    named = " ".join(COMMANDS)
    parts_of_others = {"coil", "measure", "recorded", "detectors", "shared_recordings"}
    own = {path.stem for path in (ROOT / "benchmarks").glob("*.py")} - parts_of_others
    assert all(f"benchmarks/{stem}.py" in named for stem in own)
