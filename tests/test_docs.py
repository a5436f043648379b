# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Every code block of the README and of docs/ runs, as a reader would run it, and says what the page says.

A block is run by its language. Comments above it say more:

    <!-- not run: REASON -->        it cannot be run here
    <!-- needs: FILE ... -->        files that an earlier page made
    <!-- status N -->               the exit status of a shell block
    <!-- background -->             it runs until the end of the page
    <!-- output -->                 a text block: what the block before printed; `...` stands for what is left out
    <!-- said -->                   a text block: lines that the last background block says, by the end of the page
    <!-- measured -->               a text block from a benchmark, which is not run here
    <!-- file: NAME -->             a Python or YAML block that is saved
    <!-- loads: KIND -->            a YAML or JSON block that the loader of signals, model or parameters takes
    <!-- merges: NAME -->           a YAML block that belongs into the signals file config/signals/NAME
"""

import contextlib
import fcntl
import html
import io
import json
import os
import pkgutil
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import yaml
from conftest import ROOT
from processes import children, own_domain

from uncertain_lti import SignalMap, UncertainLTI
from uncertain_lti.cli.main import COMMANDS, main
from uncertain_lti.identification.structure import Structure
from uncertain_lti.monitor.outputs import OUTPUTS

PATIENCE = 1200.0  # s for one block; costs nothing where all is well
PAGES = [ROOT / "README.md", *sorted(p for p in (ROOT / "docs").rglob("*.md") if "generated" not in p.name)]
LANGUAGES = {"sh", "python", "yaml", "json", "text", "matlab", "{toctree}", "{include}", "{eval-rst}"}
NOT_RUN = 14
"""Blocks that may stay unrun, all pages together."""
PROGRAMS = {"uncertain-lti": "uncertain_lti.cli.main", "envelope_monitor": "uncertain_lti_ros.envelope_monitor"}


@dataclass
class Block:
    language: str
    text: str
    line: int
    marks: dict[str, str] = field(default_factory=dict)


def blocks(page: Path) -> list[Block]:
    """Fenced blocks with the marks that stand right above them."""
    found, marks, lines = [], {}, page.read_text().splitlines()
    position = 0
    while position < len(lines):
        line = lines[position]
        marked = r"<!-- (not run|needs|status|background|output|said|measured|file|loads|merges):? ?(.*?) -->"
        if mark := re.fullmatch(marked, line):
            marks[mark[1]] = mark[2]
        elif fence := re.fullmatch(r"( *)```(\S+)(.*)", line):
            end = next(i for i in range(position + 1, len(lines)) if lines[i].strip() == "```")
            text = "\n".join(entry.removeprefix(fence[1]) for entry in lines[position + 1 : end])
            found.append(Block(fence[2], text + "\n", position + 1, marks))
            position, marks = end, {}
        elif line.strip():
            assert not marks, f"{page.name}:{position + 1}: a mark without a block"
        position += 1
    return found


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


class Reader:
    """A folder like a checkout, in which a page is followed from top to bottom."""

    def __init__(self, folder: Path, domain: int) -> None:
        self.folder = folder
        bin = folder / ".bin"
        bin.mkdir(parents=True)
        for program, module in PROGRAMS.items():
            self._script(bin / program, f'exec "{sys.executable}" -m {module} "$@"')
        self._script(bin / "python", f'exec "{sys.executable}" "$@"')
        self._script(folder / "run", 'exec "$@"')
        for shared in ("bags", "config"):
            (folder / shared).symlink_to(ROOT / shared)
        self.env = os.environ | {
            "PATH": f"{bin}{os.pathsep}{os.environ['PATH']}",
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "ROS_LOG_DIR": str(folder / ".log"),
            "PYTHONUNBUFFERED": "1",
        }
        self.said = ""
        self.names: dict[str, object] = {"__name__": "page"}
        self.background: list[tuple[subprocess.Popen, Path, list[str]]] = []

    @staticmethod
    def _script(path: Path, text: str) -> None:
        path.write_text(f"#!/bin/bash\n{text}\n")
        path.chmod(0o755)

    def follow(self, block: Block) -> None:
        if "not run" in block.marks:
            assert len(block.marks["not run"]) > 10, "say why"
            return
        if block.language == "sh":
            self._shell(block)
        elif block.language == "python":
            self._python(block)
        elif block.language in ("yaml", "json"):
            self._load(block)
        elif "output" in block.marks:
            assert shows(block.text, self.said), f"shown:\n{block.text}\nsaid:\n{self.said}"
        elif "said" in block.marks:
            self.background[-1][2].extend(block.text.splitlines())
        else:
            known = LANGUAGES - {"matlab", "text"}
            assert block.language in known or "measured" in block.marks, "say why it is not run"

    def _shell(self, block: Block) -> None:
        # Other pages name the same domain, and are followed at the same time.
        text = re.sub(r"(ROS_DOMAIN_ID)=\d+", rf"\1={self.env['ROS_DOMAIN_ID']}", block.text)
        command = ["bash", "-euo", "pipefail", "-c", text]
        if "background" in block.marks:
            log = self.folder / f".{len(self.background)}.log"
            with log.open("wb") as stream:
                here = {"cwd": self.folder, "env": self.env, "stdout": stream, "stderr": stream}
                process = subprocess.Popen(command, start_new_session=True, **here)
            self.background.append((process, log, []))
            time.sleep(3.0)  # a reader needs longer to get to the next shell
            until_idle(process)
            assert process.poll() is None, log.read_text()
            return
        here = {"cwd": self.folder, "env": self.env, "text": True, "timeout": PATIENCE}
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, **here)
        assert done.returncode == int(block.marks.get("status", 0)), done.stdout
        # without how far long work is, which a busy machine prints
        self.said = re.sub(r"(?m)^([a-z]+ing:|note: fell behind) .*\n", "", done.stdout)

    def _python(self, block: Block) -> None:
        code = compile(block.text, f"line {block.line}", "exec")
        if "file" in block.marks:
            (self.folder / block.marks["file"]).write_text(block.text)
            return
        spoken = io.StringIO()
        with contextlib.chdir(self.folder), contextlib.redirect_stdout(spoken):
            exec(code, self.names)
        self.said = spoken.getvalue()

    def _load(self, block: Block) -> None:
        kind = block.marks.get("loads")
        path = self.folder / f".block.{block.language}"
        path.write_text(block.text)
        if "file" in block.marks:
            (self.folder / block.marks["file"]).write_text(block.text)
        if kind == "signals":
            signals = SignalMap.load(path)
        elif kind == "model":
            UncertainLTI.load(path)
            return
        elif kind == "parameters":
            declared = pytest.importorskip("uncertain_lti_ros.parameters", reason="rclpy is not here").PARAMETERS
            (top,) = yaml.safe_load(block.text).values()
            assert set(flat(top["ros__parameters"])) <= {p.name for p in declared}
            return
        else:
            base = yaml.safe_load((ROOT / "config/signals" / block.marks["merges"]).read_text())
            signals = SignalMap.from_dict(base | yaml.safe_load(block.text))
        if signals.structure:
            names = [s.name for s in signals.states], [s.name for s in signals.controls]
            Structure.from_rules(signals.structure, *names)

    def close(self) -> None:
        unsaid = []
        for process, log, words in self.background:
            wanted = "".join(f"...\n{line}\n" for line in words)
            end = time.monotonic() + 120
            while not (heard := shows(f"{wanted}...", log.read_text())) and time.monotonic() < end:
                time.sleep(0.1)
            if not heard:
                unsaid.append(f"shown:\n{words}\nsaid:\n{log.read_text()}")
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGINT)
            try:
                process.wait(60)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        assert not unsaid, "\n".join(unsaid)


def until_idle(process: subprocess.Popen) -> None:
    """Wait until a program has started: neither it nor a child of it wants a core for half a second."""
    end, idle = time.monotonic() + PATIENCE, 0
    while idle < 5 and process.poll() is None and time.monotonic() < end:
        idle = 0 if any(computes(pid) for pid in (process.pid, *children(process.pid))) else idle + 1
        time.sleep(0.1)


def computes(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in ("R", "D")
    except OSError:  # it has ended
        return False


FIGURES = r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?"
NUMBER = re.compile(rf"(?<![\w.]){FIGURES}")


def shows(shown: str, said: str) -> bool:
    """Whether a page shows what was said, line by line; `...` alone stands for any lines, within one for any words.

    Blanks do not count. Whole numbers are the same; others differ by one in the last digit at most, where another
    solver or processor may round otherwise.
    """
    return _lines_match(*([" ".join(line.split()) for line in text.splitlines()] for text in (shown, said)))


def _lines_match(shown: list[str], said: list[str]) -> bool:
    if not shown:
        return not said
    if shown[0] == "...":
        return any(_lines_match(shown[1:], said[start:]) for start in range(len(said) + 1))
    return bool(said) and _same(shown[0], said[0]) and _lines_match(shown[1:], said[1:])


def _same(shown: str, said: str) -> bool:
    # a number may be said with more or fewer characters, and is compared by its value
    pattern = "(.*)".join(f"({FIGURES})".join(map(re.escape, NUMBER.split(part))) for part in shown.split("..."))
    match = re.fullmatch(pattern, said)
    if not match:
        return False
    tokens = re.findall(rf"\.\.\.|{NUMBER.pattern}", shown)
    return all(token == "..." or _near(token, found) for token, found in zip(tokens, match.groups(), strict=True))


def _near(shown: str, said: str) -> bool:
    """One number as shown and another as said."""
    if re.fullmatch(r"-?\d+", shown):
        return said == shown
    digits, _, exponent = shown.partition("e")
    last = 10.0 ** (int(exponent or 0) - len(digits.partition(".")[2]))
    return abs(float(shown) - float(said)) <= 1.01 * last


def flat(tree: dict) -> list[str]:
    """Names of the leaves, with a dot between the keys that lead to them."""
    inner = {key: flat(value) if isinstance(value, dict) else [] for key, value in tree.items()}
    return [".".join([key, *leaf]) for key, leaves in inner.items() for leaf in ([[one] for one in leaves] or [[]])]


def test_what_is_shown_is_compared_number_by_number():
    said = "first at 24.0500 s\nraised 9 times, gap 1.1e-09, widths 10.77 0.53%, speed_2 a1b\nbye\n"
    assert shows(said, said) and shows("...", said) and shows("first at 24.0501 s\n...", said)
    assert shows("...\nraised 9 times, gap ..., widths 10.76   0.53%, speed_2 ...\n...\nbye", said)
    for wrong in ("24.0502", "24.2", "24.0500 ms", "24"):
        assert not shows(said.replace("24.0500", wrong), said)
    for old, new in (("9 times", "8 times"), ("9 times", "9.5 times"), ("10.77", "10.75"), ("1.1e-09", "1.3e-09")):
        assert not shows(said.replace(old, new), said)
    assert not shows(said.replace("speed_2", "speed_3"), said) and not shows("bye", said)
    assert not shows("first at 24.0500 s", said) and not shows("...\nfirst", said) and not shows("", said)


TUTORIAL = ROOT / "docs/tutorial.md"


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[Path, dict[str, str]]:
    """A folder with signals.yaml and engine.model.json, made by the tutorial once for all workers, and what it said.

    What was said is by the line of the page.
    """
    run = os.environ.get("PYTEST_XDIST_TESTRUNUID")
    folder = tmp_path_factory.getbasetemp().parent / f"made-{run}" if run else tmp_path_factory.mktemp("made")
    folder.mkdir(exist_ok=True)
    with open(folder / "lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "said.json").exists():
            reader, said = Reader(folder / "checkout", domain=1), {}  # nothing of it starts a node
            for block in blocks(TUTORIAL):
                wanted = any(word in block.text for word in ("init", "max_hold", "uncertain-lti fit"))
                if block.language == "sh" and "not run" not in block.marks and wanted:
                    reader.follow(block)
                    said[str(block.line)] = reader.said
            (folder / "said.json").write_text(json.dumps(said))
    return folder / "checkout", json.loads((folder / "said.json").read_text())


ROS = re.compile(r"envelope_monitor --ros|uncertain-lti (play|record|demo)")


@pytest.mark.parametrize("page", PAGES, ids=name)
@pytest.mark.slow
@pytest.mark.timeout(3 * PATIENCE)
def test_every_block_runs(page, tmp_path, request):
    every = blocks(page)
    if any(ROS.search(b.text) and "not run" not in b.marks for b in every):
        pytest.importorskip("rclpy", reason="neither a ROS 2 installation nor the rclpy wheels are here")
    pytest.importorskip("cvxpy", reason="the extra oracle is not installed")
    if "control" in page.read_text():
        pytest.importorskip("control", reason="the extra control is not installed")
    with own_domain() as domain:
        reader, done = Reader(tmp_path / "checkout", domain), {}
        try:
            for block in every:
                for needed in block.marks.get("needs", "").split():
                    if not (reader.folder / needed).exists():
                        shutil.copy(request.getfixturevalue("made")[0] / needed, reader.folder)
                if page == TUTORIAL and not done:  # others may have followed a part of it
                    folder, done = request.getfixturevalue("made")
                    for path in folder.glob("[!.]*.*"):
                        shutil.copy(path, reader.folder)
                if str(block.line) in done:
                    reader.said = done[str(block.line)]
                    continue
                try:
                    reader.follow(block)
                except Exception as error:
                    raise AssertionError(f"{name(page)}:{block.line}: {error}") from error
        finally:
            reader.close()


def test_every_block_says_what_it_is():
    """A known language, no code by indentation, and few that are not run."""
    unrun = 0
    for page in PAGES:
        for block in blocks(page):
            assert block.language in LANGUAGES, f"{name(page)}:{block.line}: {block.language}"
            unrun += "not run" in block.marks
    assert unrun <= NOT_RUN
    markdown = pytest.importorskip("markdown_it", reason="the extra docs is not installed")
    for page in PAGES:
        found = markdown.MarkdownIt().parse(page.read_text())
        assert not [t.map for t in found if t.type == "code_block"], f"{name(page)}: code by indentation; fence it"
        assert not [t.map for t in found if t.type == "fence" and not t.info], f"{name(page)}: a fence without language"


def test_the_theory_names_functions_that_are_there():
    """Each dotted name of the page is one, and every equation has its place."""
    text = (ROOT / "docs/theory.md").read_text()
    names = set(re.findall(r"`([A-Za-z_]+(?:\.[A-Za-z_]+)+)`", text))
    assert len(names) > 10
    for dotted in names:
        pkgutil.resolve_name(f"uncertain_lti.{dotted}")
    for number in ("1, 2", "3", "4", "5", "6", "7", "8, 9", "10", "11"):
        assert f"\\tag{{{number}}}" in text


@pytest.mark.slow
def test_the_pages_build_without_a_warning(tmp_path, capsys):
    for package in ("sphinx", "myst_parser", "furo", "latex2mathml", "rclpy"):
        pytest.importorskip(package, reason=f"{package} is not installed")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", "-d", str(tmp_path / "trees")]
    done = subprocess.run([*command, str(ROOT / "docs"), str(tmp_path / "html")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    theory = (tmp_path / "html" / "theory.html").read_text()
    assert theory.count("<math") > 20 and "cdn" not in theory.lower()
    reference = {}
    for page in ("commands", "parameters", "topics"):
        text = re.sub(r"<[^>]+>", " ", (tmp_path / "html" / "reference" / f"{page}.html").read_text())
        reference[page] = html.unescape(text).replace("\u2013", "--")  # long dashes as they were typed
    for command in COMMANDS:  # as a user is told of them, not as the generator of the page finds them
        with pytest.raises(SystemExit):
            main([command.name, "--help"])
        for option in set(re.findall(r"--[a-z][a-z-]+", capsys.readouterr().out)) - {"--help"}:
            assert option in reference["commands"], f"{command.name} {option} is not on the built page"
    for parameter in yaml.safe_load((ROOT / "config" / "envelope_monitor.yaml").read_text()).values():
        for key in flat(parameter["ros__parameters"]):
            assert key in reference["parameters"].split(), f"{key} is not on the built page"
    for output in OUTPUTS:
        assert output.name in reference["topics"].split(), f"{output.name} is not on the built page"


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().split()) <= 900
