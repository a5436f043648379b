# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The hooks before a commit: local, of tools that are installed, and true of the files that are here."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
REPOSITORIES = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
HOOKS = {hook["id"]: hook for repository in REPOSITORIES for hook in repository["hooks"]}
PATTERNS = {name: hook for name, hook in HOOKS.items() if hook["language"] == "pygrep"}


def found(hook: dict, text: bytes) -> bool:
    """What pre-commit's own search finds: line after line, or in the whole text with --multiline."""
    if "--multiline" in hook.get("args", []):
        return re.search(hook["entry"].encode(), text, re.MULTILINE | re.DOTALL) is not None
    lines = text.splitlines(keepends=True)  # pre-commit splits at \n alone, which keeps \r at the end of a line
    return any(re.search(hook["entry"].encode(), line.rstrip(b"\n")) for line in lines)


def test_no_hook_is_fetched_from_elsewhere():
    assert [repository["repo"] for repository in REPOSITORIES] == ["local"]
    assert {hook["language"] for hook in HOOKS.values()} == {"system", "pygrep"}


def test_commands_are_those_that_lint_runs():
    commands = {hook["entry"].split()[0] for name, hook in HOOKS.items() if name not in PATTERNS}
    assert commands == {"ruff", "mypy"}
    lint = re.search(r"^lint\(\) \{\n(.*?)^\}", (ROOT / "run").read_text(), re.DOTALL | re.MULTILINE)[1]
    assert all(command in lint and shutil.which(command) for command in commands)


WRONG = {
    "end-of-file": [b"no newline", b"two\n\n"],
    "trailing-whitespace": [b"blank \n", b"tab\t\n"],
    "line-ends": [b"windows\r\n"],
    "merge-conflict": [b"<<<<<<< HEAD\n", b"=======\n", b">>>>>>> other\n"],
}


@pytest.mark.parametrize("name", PATTERNS)
def test_a_pattern_finds_what_it_is_named_for_and_nothing_in_this_repository(name):
    assert all(found(PATTERNS[name], text) for text in WRONG[name])
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("not a git checkout: which files belong to it is not known")
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout
    left_out = PATTERNS[name].get("exclude", r"\A\Z")
    for path in map(ROOT.joinpath, (p for p in listed.decode().split("\0") if p and not re.search(left_out, p))):
        if path.is_file() and b"\0" not in (text := path.read_bytes()):
            assert not found(PATTERNS[name], text), path
