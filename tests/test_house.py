# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The house: rooms that import in one direction, modules without circles, a sentence at every door."""

import ast
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import yaml
from conftest import ROOT

ROOMS = (
    "base", "kernel", "signals", "recordings", "sampling", "model", "monitor", "identification", "validation",
    "proposal", "reports", "plants", "cli",
)  # fmt: skip
"""In order: a room imports from itself and from those before it."""


def modules() -> dict[str, Path]:
    found = {}
    for path in sorted((ROOT / "core").rglob("*.py")):
        parts = list(path.relative_to(ROOT / "core").with_suffix("").parts)
        found[".".join(["uncertain_lti", *(parts[:-1] if parts[-1] == "__init__" else parts)])] = path
    return found


def imported(path: Path, known: dict[str, Path]) -> set[str]:
    """Every module of the project that a file imports, wherever in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "uncertain_lti":
            for name in node.names:
                whole = f"{node.module}.{name.name}"
                found.add(whole if whole in known else node.module)
        elif isinstance(node, ast.Import):
            found |= {name.name for name in node.names if name.name.split(".")[0] == "uncertain_lti"}
    return found


def room(module: str) -> str:
    return module.split(".")[1] if "." in module else ""


def test_imports_go_one_way():
    known = modules()
    backwards = [
        f"{module} imports {other}"
        for module, path in known.items()
        if room(module)
        for other in imported(path, known)
        if room(other) and ROOMS.index(room(other)) > ROOMS.index(room(module))
    ]
    assert not backwards


def test_no_module_leads_back_to_itself():
    known = modules()
    edges = {module: imported(path, known) - {module} for module, path in known.items() if path.name != "__init__.py"}
    leaves = {module for module in edges if not edges[module] & edges.keys()}
    while leaves:
        for module in leaves:
            del edges[module]
        leaves = {module for module in edges if not edges[module] & edges.keys()}
    assert not edges, "these import each other in a circle, or what does"


def test_every_room_says_what_it_is_for_and_what_it_may_import():
    rooms = {p.parent.name for p in (ROOT / "core").glob("*/__init__.py")}
    assert rooms == set(ROOMS)
    for name in rooms:
        door = ROOT / "core" / name / "__init__.py"
        first, *_, last = (ast.get_docstring(ast.parse(door.read_text())) or "").split("\n")
        assert first.endswith(".") and "mport" in last, door
    assert [p.name for p in (ROOT / "core").glob("*.py")] == ["__init__.py"]


def test_every_command_has_a_file_and_is_registered():
    from uncertain_lti.cli.command import Command
    from uncertain_lti.cli.main import COMMANDS

    declared = set()
    for path in sorted((ROOT / "core" / "cli").glob("*.py")):
        module = import_module(f"uncertain_lti.cli.{path.stem}")
        found = [value for value in vars(module).values() if isinstance(value, Command)]
        assert path.stem in ("__init__", "command", "main", "program") or found, f"{path.name} declares no command"
        declared |= {command.name for command in found}
    assert declared == {command.name for command in COMMANDS}


def test_no_two_modules_differ_by_a_plural():
    rooms = (ROOT / "core", ROOT / "uncertain_lti_ros")
    files = [path for room in rooms for path in room.rglob("*.py*") if path.suffix != ".pyc"]
    names = [path.stem for path in {path.with_suffix("") for path in files} if path.stem != "__init__"]
    names.remove("envelope_monitor")  # the node, and what it wires
    assert len(names) == len({name.removesuffix("s") for name in names})


def test_help_imports_nothing_heavy():
    code = "import sys; from uncertain_lti.cli.main import build_parser; build_parser(); print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"numpy", "cvxpy", "osqp", "scipy", "matplotlib", "rclpy", "yaml", "mcap", "tqdm"} & set(loaded)


def test_nothing_cites_a_document_that_is_not_here():
    folders = ("core", "uncertain_lti_ros", "tests", "benchmarks", "docs", "config", "launch", "examples")
    files = [*ROOT.glob("*.*"), *(p for folder in folders for p in (ROOT / folder).rglob("*.*"))]
    known = {p.name for p in files if p.suffix == ".md"}
    for path in files:
        if path.suffix in (".py", ".md", ".yaml", ".toml", ".cfg") and "_build" not in path.parts:
            cited = set(re.findall(r"\b[A-Z]{4,}\.md\b", path.read_text(encoding="utf-8")))
            assert cited <= known, f"{path} cites {cited - known}"


def test_recipes_name_files_that_are_there_and_at_most_four_each():
    recipes = (ROOT / "CONTRIBUTING.md").read_text().partition("\n## A release")[0].split("\n### ")[1:]
    assert len(recipes) == 6
    for recipe in recipes:
        steps = re.findall(r"^\d+\. `([^`]+)`", recipe, re.MULTILINE)
        assert 1 <= len(steps) <= 4, recipe
        assert all("NAME" in step or (ROOT / step).is_file() for step in steps), steps


HEADER = "".join(f"{line}\n" for line in Path(__file__).read_text().splitlines()[:8])


def test_every_file_begins_with_the_licence():
    """As ament_copyright asks for; what is generated, or the work of others, is no Python file of the repository."""
    listed = subprocess.run(["git", "ls-files", "*.py"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    texts = {name: (ROOT / name).read_text() for name in listed.split() if (ROOT / name).exists()}
    assert len(texts) > 100 and HEADER.startswith("# Copyright ") and HEADER.endswith("under the License.\n")
    lacking = [name for name, text in texts.items() if text and not re.sub(r"\A#!.*\n", "", text).startswith(HEADER)]
    assert not lacking, "copy the first eight lines of this file"


def test_workflows_try_every_python_that_run_takes_and_pin_their_actions():
    """Read as text: nothing here can run them."""
    run = (ROOT / "run").read_text()
    versions = re.search(r"case \$version in ([\d. |]+)\) python", run)[1].split(" | ")
    folder = ROOT / ".github/workflows"
    tests, wheels = (yaml.safe_load((folder / f"{name}.yml").read_text()) for name in ("tests", "wheels"))
    assert tests["jobs"]["test"]["strategy"]["matrix"]["python"] == versions
    steps = [step for flow in (tests, wheels) for job in flow["jobs"].values() for step in job["steps"]]
    assert all(re.fullmatch(r"[\w-]+/[\w-]+@v\d+\.\d+\.\d+", step["uses"]) for step in steps if "uses" in step)
    built = next(step["env"] for step in steps if "cibuildwheel" in step.get("uses", ""))
    assert built["CIBW_BUILD"].split() == [f"cp{version.replace('.', '')}-manylinux_*" for version in versions]
    for path in re.findall(r"\{project\}/(\S+)", built["CIBW_TEST_COMMAND"]):
        assert (ROOT / path).is_file()
