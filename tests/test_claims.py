# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""docs/claims.md names commands that exist: files, tests and options. What they show is theirs to test."""

import ast
import itertools
import re
import shlex
from pathlib import Path

import pytest

from uncertain_lti.cli.main import build_parser

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "claims.md"


def rows() -> list[list[str]]:
    """Cells of every row of the tables."""
    lines = [
        line for line in PAGE.read_text().splitlines() if line.startswith("| ") and not line.startswith("| claim ")
    ]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


COMMANDS = sorted({cell for row in rows() for cell in re.findall(r"`([^`]+)`", row[1])})


def known_words(path: Path) -> set[str]:
    """Texts in a script, and its functions, after which some name their parts."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    texts = {node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    return texts | {node.name for node in nodes if isinstance(node, ast.FunctionDef)}


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
        missing = []
        for word in words[: words.index("-k") if "-k" in words else None]:
            file, _, test = word.partition("::")
            if not (ROOT / file).is_file():
                missing.append(file)
            elif test and f"def {test}(" not in (ROOT / file).read_text():
                missing.append(word)
        return missing
    if program != "python" or not (ROOT / words[0]).is_file():
        return [f"{program} {words[0]}"]
    known = known_words(ROOT / words[0])
    values = {after for word, after in itertools.pairwise(words) if word.startswith("--")}
    return [word for word in words[1:] if word not in known | values]


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
    shared = {
        "coil.py",
        "measure.py",
        "peers.py",
        "regime_peers.py",
        "recorded.py",
        "detectors.py",
        "shared_recordings.py",
    }  # parts of the others
    assert all(
        f"benchmarks/{path.name}" in named for path in (ROOT / "benchmarks").glob("*.py") if path.name not in shared
    )
