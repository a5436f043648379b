# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The examples run as their readers would run them, and come out as they say."""

import ast
import json
import re
import subprocess
import sys
from pathlib import Path

from conftest import ROOT

EXAMPLES = ROOT / "examples"


def said_by(name: str, folder: Path, *arguments: str) -> str:
    """What a script prints, run in an empty folder."""
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_arrays_are_fitted_with_none_outside_and_only_the_changed_run_alarms(tmp_path):
    said = said_by("fit_arrays.py", tmp_path)
    assert "12000 transitions fitted, 0 outside" in said
    assert re.search(r"^healthy: .*no alarm$", said, re.MULTILINE)
    onset = float(re.search(r"^friction from 12 s: .*first alarm at (\S+) s$", said, re.MULTILINE)[1])
    assert 12.0 < onset < 13.0


def test_bags_are_fitted_and_the_figure_is_an_image_where_it_was_asked_for(tmp_path):
    said = said_by("fit_bag.py", tmp_path, "damage.png")
    assert "5 recordings fitted, 0 transitions outside" in said
    assert "first alarm at 27.300 s" in said
    assert (tmp_path / "damage.png").read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in tmp_path.iterdir()] == ["damage.png"]


def test_a_session_without_ros_gives_the_bits_of_a_check(tmp_path):
    said = said_by("live_session.py", tmp_path)
    assert said.startswith("alarm at 27.150 s\n")
    assert "monitor: alarm: at lea" in said
    assert said.endswith("1401 samples, the same bits as a check of the bag\n")


def test_a_session_imports_no_ros():
    for path in EXAMPLES.glob("*.py"):
        nodes = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Import)]
        imported = {n.name for node in nodes for n in node.names}
        imported |= {node.module for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)}
        assert not {name.partition(".")[0] for name in imported} & {"rclpy", "uncertain_lti_ros"}, path


def test_the_notebook_runs_from_its_folder_and_every_result_can_be_shown(monkeypatch, capsys):
    """Cell after cell in one namespace, without magics; what a cell ends with is shown as a notebook shows it."""
    notebook = json.loads((EXAMPLES / "envelope.ipynb").read_text())
    assert notebook["nbformat"] == 4
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in cells), "stored without results"
    monkeypatch.chdir(EXAMPLES)
    names: dict[str, object] = {"__name__": "__main__"}
    shown = []
    for cell in cells:
        tree = ast.parse("".join(line for line in cell["source"] if not line.startswith("%")), cell["id"])
        last = ast.Expression(tree.body.pop().value) if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, cell["id"], "exec"), names)
        if last is not None:
            value = eval(compile(last, cell["id"], "eval"), names)
            if hasattr(value, "savefig"):
                value.canvas.draw()
                shown.append("figure")
            elif value is not None:
                shown.append(value._repr_html_())
    said = capsys.readouterr().out
    assert shown.count("figure") == 4
    assert all(part == "figure" or "<table>" in part for part in shown)
    assert "first alarm at 24.050 s" in said
    healthy, damaged = (float(share) for share in re.findall(r"(?:healthy|damaged): (\S+)% violated", said))
    assert healthy < 1.0 < damaged


def test_every_example_is_run_here_and_listed_in_the_documentation():
    page = (ROOT / "docs" / "examples.md").read_text()
    tested = Path(__file__).read_text()
    for path in EXAMPLES.iterdir():
        if path.suffix in (".py", ".ipynb"):
            assert f'"{path.name}"' in tested
            assert f"examples/{path.name}" in page
