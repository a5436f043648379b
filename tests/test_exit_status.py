# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Exit status 1 means that the alarm was raised and nothing else, whatever goes wrong."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys

import numpy as np
import pytest
import yaml
from bag_writer import Message, Topic, write
from conftest import ROOT
from engine_bag import engine_bag
from steps import steps_of

from uncertain_lti import EnvelopeMonitor, Transient
from uncertain_lti.base.errors import BagError, absent
from uncertain_lti.base.text import printable
from uncertain_lti.cli.main import main
from uncertain_lti.identification import fit
from uncertain_lti.recordings.bag import Bag
from uncertain_lti.sampling.clock import LONGEST_NS, Status, to_ns


def commands(folder):
    """Command lines that end by themselves and print."""
    model, bag = str(folder / "m.model.json"), str(folder / "run.mcap")
    return {"topics": ["topics", bag], "check": ["check", model, bag]}


COMMAND = [sys.executable, "-m", "uncertain_lti.cli.main"]


def run(arguments, command=COMMAND, **options):
    return subprocess.run([*command, *arguments], text=True, timeout=1200, **options)


@pytest.mark.parametrize("what", ["topics", "check"])
def test_output_that_cannot_be_written(folder, what):
    with open("/dev/full", "w") as full:
        done = run(commands(folder)[what], stdout=full, stderr=subprocess.PIPE)
    assert done.returncode == 2
    assert "cannot be written" in done.stderr and "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr


def test_a_library_warns_of_nothing_on_the_terminal(tmp_path):
    """Of the largest number there is, which stands for none, numpy wrote lines of the program's own text there."""
    values = (-1.7e308 if k % 9 == 3 else 1.7e308 if k % 9 == 4 else k % 5 for k in range(60))
    rows = [f"{0.1 * k:.1f},{k % 7},{value}" for k, value in enumerate(values)]
    (tmp_path / "a.csv").write_text("\n".join(["time,a,b", *rows]))
    started = [sys.executable, "-c", "import sys; from uncertain_lti.cli import begin; sys.exit(begin())"]
    for words in (["topics"], ["plot", "--output", "a.html"]):
        done = run([*words, "a.csv"], started, capture_output=True, cwd=tmp_path)
        assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("package", ["mcap", "rosbags", "zstandard"])
def test_a_robot_that_only_monitors_is_told_what_recordings_need(folder, package):
    """There apt installs numpy and PyYAML alone. MCAP files need the first; not every file needs the others."""
    done = without([package], commands(folder)["check"])
    assert "Traceback" not in done.stderr
    if done.returncode:
        assert done.returncode == 2, done.stderr
        assert f"the Python package {package}" in done.stderr and "in the checkout: pip install ." in done.stderr
    else:
        assert package != "mcap"


@pytest.mark.parametrize(("module", "status"), [("uncertain_lti.cli.judge", 70), ("argparse", 70), ("nothing", 0)])
def test_a_damaged_installation_is_no_alarm(module, status):
    broken = f"import sys; from uncertain_lti.cli import begin; sys.modules[{module!r}] = None; sys.exit(begin())"
    done = run(["--help"], [sys.executable, "-c", broken], capture_output=True)
    assert done.returncode == status and ("the installation is damaged" in done.stderr) == (status == 70)
    assert "uncertain-lti = uncertain_lti.cli:begin" in (ROOT / "setup.py").read_text()


@pytest.mark.parametrize(
    ("number", "error"),
    [
        ("SIGINT", "KeyboardInterrupt"),
        ("SIGINT", "ImportError('umath failed to import')"),
        ("SIGTERM", "KeyboardInterrupt"),
    ],
)
@pytest.mark.parametrize(
    ("module", "said"),
    [
        ("uncertain_lti.base.errors", ": interrupted before anything was begun\n"),
        ("uncertain_lti.recordings.bag", " topics: interrupted; no half-written file is left\n"),
    ],
)
def test_an_interrupt_is_said_whatever_an_import_makes_of_it(module, said, number, error):
    """As numpy and rclpy do; `kill` ends in order, too, with no half-written file left."""
    first = (
        "import builtins, signal, sys; from uncertain_lti.cli import begin as main; real = builtins.__import__\n"
        "def interrupted(name, *rest):\n"
        f"    if name == {module!r}:\n"
        f"        try: signal.raise_signal(signal.{number})\n"
        f"        except KeyboardInterrupt: raise {error} from None\n"
        "    return real(name, *rest)\n"
        "builtins.__import__ = interrupted; sys.exit(main())"
    )
    done = run(["topics", "x.mcap"], [sys.executable, "-c", first], capture_output=True)
    assert (done.returncode, done.stderr) == (130, f"uncertain-lti{said}")


def test_nobody_reads_what_is_said(folder):
    with open("/dev/full", "w") as full:
        assert run(["check", "nothing.model.json", "nothing.mcap"], stdout=full, stderr=full).returncode == 2
    for what in ("check", "topics"):
        line = shlex.join([*COMMAND, *commands(folder)[what]])
        done = subprocess.run(["sh", "-c", f"{line} >&- 2>&-"], timeout=1200)
        assert done.returncode in (0, 2), what


def test_a_reader_that_goes_away_leaves_the_alarm_unknown(folder):
    """What `check` would have found is not known to be no alarm."""
    for what, status in (("check", 141), ("topics", 0)):
        read, wrote = os.pipe()
        os.close(read)
        env = {**os.environ, "PYTHONUNBUFFERED": ""}  # what was not written is there when Python ends
        done = run(commands(folder)[what], stdout=wrote, stderr=subprocess.PIPE, env=env)
        os.close(wrote)
        assert done.returncode == status and done.stderr == "", what


def test_a_model_is_written_whoever_reads_what_is_said(folder, tmp_path):
    """A reader that has read enough, as `| head` does, is no error and stops no work."""
    read, wrote = os.pipe()
    os.close(read)
    words = ["fit", folder / "run.mcap", "--signals", folder / "signals.yaml", "--additive", "noise"]
    words = [*map(str, words), "--output", str(tmp_path / "m.model.json")]
    done = run(words, stdout=wrote, stderr=subprocess.PIPE, env={**os.environ, "PYTHONUNBUFFERED": "1"})
    os.close(wrote)
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    assert (tmp_path / "m.model.json").exists()


SOLVERS = ("cvxpy", "daqp", "highspy", "osqp", "piqp", "scipy")


def test_in_the_environment_of_the_programs_the_remedy_is_one_command_of_run(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    (tmp_path / "made-for").write_text("use\n")
    assert absent("pyarrow") == "the Python package pyarrow is not installed; in the checkout: ./run setup --all"
    (tmp_path / "made-for").write_text("all\n")
    assert absent("pyarrow").endswith("pip install '.[tables]'")


def without(packages, words):
    gone = f"import sys; sys.modules.update(dict.fromkeys({packages!r}))"
    program = f"{gone}; from uncertain_lti.cli.main import main; sys.exit(main())"
    return run(words, [sys.executable, "-c", program], capture_output=True)


def test_init_needs_no_solver(tmp_path):
    bags = [str(ROOT / f"bags/turbofan_{name}.mcap") for name in ("pulses_up", "pulses_down")]
    done = without(SOLVERS, ["init", *bags, "--output", str(tmp_path / "signals.yaml")])
    assert done.returncode == 0, done.stderr
    assert "states:" in (tmp_path / "signals.yaml").read_text()
    assert "not tried: the Python package" in done.stderr and "pip install '.[fit]'" in done.stderr


def test_check_needs_no_solver(folder, tmp_path):
    """Not even of as many recordings as tell a drift: a robot has numpy alone."""
    check, model, bag = commands(folder)["check"]
    bags = [shutil.copy(bag, tmp_path / f"{number}.mcap") for number in range(5)]
    done = without(SOLVERS, [check, model, *map(str, bags)])
    assert done.returncode == main([check, model, *map(str, bags)]) and "not installed" not in done.stderr, done.stderr


def test_a_hint_names_an_extra_that_setup_py_has(folder):
    """The distribution is on no index: what is missing is installed from the checkout."""
    done = without(("jinja2",), ["report", *commands(folder)["check"][1:], "--output", str(folder / "page.html")])
    assert done.returncode == 2
    assert done.stderr.endswith("Python package jinja2 is not installed; in the checkout: pip install '.[plots]'\n")
    assert "'.[plots]'" in absent("PIL.Image") and absent("nobody's") == ""
    extras = dict(re.findall(r'^    "(\w+)": \[(.*?)\],', (ROOT / "setup.py").read_text(), re.M | re.S))
    for package in (*SOLVERS, "jinja2", "matplotlib", "pyarrow", "control", "distributed", "shtab"):
        extra = re.search(r"'\.\[(\w+)\]'", absent(package))[1]
        assert f'"{package}' in extras[extra]
    assert '"ros-rclpy' in extras["ros"] and "'.[ros]'" in absent("rclpy")


def test_a_name_that_the_terminal_has_no_letters_for(tmp_path):
    name = os.fsdecode(b"caf\xe9 \xe2\x88\x86.mcap")
    topic = Topic("/größe")
    write([topic], [Message("/größe", k * 10**9, b"\0\1\0\0" + bytes(8)) for k in range(5)]).save(tmp_path / name)
    done = run(["topics", str(tmp_path / name)], capture_output=True, env={**os.environ, "PYTHONIOENCODING": "ascii"})
    assert done.returncode == 0 and "gr\\xf6" in done.stdout


def test_a_fault_of_the_program_is_no_alarm(folder, monkeypatch, cli):
    from uncertain_lti.cli import judge

    def broken(name):
        raise KeyError("nobody expected this")

    monkeypatch.setattr(judge, "load_model", broken)
    said = cli(*(commands(folder)["check"]), status=70).err
    assert "Traceback" in said and "fault of the program" in said.splitlines()[-1]
    monkeypatch.setattr(judge, "load_model", lambda name: bytearray(1 << 62))
    assert "not enough memory" in cli(*(commands(folder)["check"]), status=2).err


NASTY = "/a\x1b[31m\x1b]0;title\x07\n\r\u202eb\x9b" + "n" * 100_000


def test_names_do_not_reach_the_terminal_as_they_stand(tmp_path, cli):
    """Escape sequences, line breaks, bidirectional marks, and 100 KB of it."""
    float64 = b"\0\1\0\0" + bytes(8)
    topics = [
        Topic(NASTY),
        Topic("/b", "p/msg/B", schema="not a schema\n"),
        Topic("/c" + NASTY, schema_encoding="\x1b[2J"),
    ]
    messages = [Message(t.name, k * 10**9, float64) for t in topics for k in range(3)]
    path = str(write(topics, messages).save(tmp_path / "n.mcap"))
    (tmp_path / "s.yaml").write_text('states: [{name: x, topic: "/nothing", field: data}]')
    lines = {
        ("topics", path): 0,
        ("init", path): 2,
        ("fit", path, "--signals", str(tmp_path / "s.yaml"), "--output", str(tmp_path / "m.model.json")): 2,
        ("check", "leibov2006", path): 2,
        ("check", str(tmp_path / NASTY[1:9]), path): 2,
    }
    for line, status in lines.items():
        said = cli(*list(line), status=status)
        for text in (said.out, said.err):
            assert all(c.isprintable() or c == "\n" for c in text), line
            assert max(map(len, text.split("\n"))) < 10_000, line
        assert said.err.count("\n") <= 5, line
    with pytest.raises(BagError) as error:
        list(Bag(path).messages(["/nothing"]))
    assert len(str(error.value)) <= 2000 and "\n" not in str(error.value)


def test_a_proposed_file_holds_names_as_text(tmp_path, capsys):
    """A name with a line break ends neither a comment nor a text of the proposed file."""
    name = '/a\nclock: /evil # \x1b"'
    values = np.sin(np.arange(300) / 7.0)
    names = (name, "/b\n#")
    bodies = [b"\0\1\0\0" + np.float64(3 * value).tobytes() for value in values]
    messages = [Message(t, k * 10**7, body) for k, body in enumerate(bodies) for t in names]
    path = write([Topic(t) for t in names], messages).save(tmp_path / "n.mcap")
    status = main(["init", str(path)])
    said = capsys.readouterr()
    assert status in (0, 2)
    if status == 0:
        data = yaml.safe_load(said.out)
        assert data["clock"] in names and {s["topic"] for s in data["states"]} <= set(names)


def test_a_sentence_is_one_short_line():
    assert printable("a\x1b\n\u202e\udc80\tb") == "a\\x1b\\n\\u202e\\udc80\\tb"
    assert printable("größe ∆ ±") == "größe ∆ ±"
    long = printable("begin" + "x" * 10**6 + "remedy")
    assert len(long) == 2000 and long.startswith("begin") and long.endswith("remedy")


@pytest.mark.parametrize("value", [1e308, -1e160])
def test_recorded_values_whose_squares_overflow_are_refused_by_a_fit(folder, tmp_path, capsys, cli, value):
    """Before, the solvers were left alone with them, for minutes; a check judges them as any other value."""
    path = engine_bag(
        tmp_path / "huge.mcap", change=lambda k, x: np.where(np.arange(len(x)) == 0, value, x) if k == 50 else x
    )
    capsys.readouterr()
    line = ["fit", str(path), "--signals", str(folder / "signals.yaml"), "--output", str(tmp_path / "m.model.json")]
    assert f"'fan' reaches {abs(value):.3g}" in cli(*line, status=2).err
    assert main(["check", str(folder / "m.model.json"), str(path)]) == 1


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [1e308, -1e308, 1e51])
def test_a_value_that_the_bounds_cannot_carry_has_no_verdict_live_as_offline(value):
    """What arrives there is judged by bounds that are numbers; what starts there is not judged."""
    rng = np.random.default_rng(0)
    x, u = np.cumsum(0.01 * rng.standard_normal((300, 2)), axis=0), rng.standard_normal((300, 1))
    model = fit(Transient(np.arange(300) * 0.01, x, u), additive="noise")
    x[100, 0] = u[200, 0] = value
    run = Transient(np.arange(300) * 0.01, x, u)
    monitor = EnvelopeMonitor(model)
    verdicts = monitor.check(run)
    assert np.flatnonzero(~verdicts.judged).tolist() == [0, 101, 201]
    assert verdicts.flags[100, 0] == 1.0 and np.isfinite(verdicts.lower[verdicts.judged]).all()
    assert {verdicts.statuses()[k] for k in (101, 201)} == {Status.MISSING}
    for k, live in enumerate(map(monitor.judge, steps_of(run))):
        assert live.status is verdicts.statuses()[k]
        for name in ("flags", "lower", "upper", "utilisation"):
            assert np.array_equal(getattr(live, name), getattr(verdicts, name)[k], equal_nan=True), (k, name)


def test_a_duration_beyond_64_bits_is_the_longest():
    assert to_ns(1e308) == to_ns(np.float64(1e300)) == to_ns(1e10) == to_ns(np.inf) == LONGEST_NS
    assert to_ns(-1e308) == -LONGEST_NS and to_ns(1.5) == 1_500_000_000 and to_ns(4e9) == 4 * 10**18


def test_info_on_odd_leaves_of_the_fit_is_no_defect(folder, tmp_path):
    """What a file says of its own fit may be anything; no command ends with 70 for it."""
    whole = json.loads((folder / "m.model.json").read_text())

    def leaves(value, path=()):
        if isinstance(value, dict):
            for key, inner in value.items():
                yield from leaves(inner, (*path, key))
        else:
            yield path

    path = tmp_path / "odd.model.json"
    for number, leaf in enumerate(leaves(whole["fit"])):
        data = json.loads(json.dumps(whole))
        inner = data["fit"]
        for key in leaf[:-1]:
            inner = inner[key]
        inner[leaf[-1]] = ["text", [1], {"a": None}, None][number % 4]
        path.write_text(json.dumps(data))
        assert main(["info", str(path)]) in (0, 2)


def test_a_recording_whose_name_is_not_utf8_can_be_drawn(folder, tmp_path):
    strange = tmp_path / "a\udcffb.mcap"
    strange.write_bytes((folder / "run.mcap").read_bytes())
    image = str(tmp_path / "p.png")
    assert main(["plot", str(folder / "m.model.json"), str(strange), "--output", image]) == 0
