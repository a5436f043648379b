# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Bars on a terminal and silence elsewhere; an interrupt leaves whole files or none."""

import io
import json
import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from engine_bag import SIGNALS, engine_bag
from processes import on_a_terminal

from uncertain_lti import Transient
from uncertain_lti.base.files import whole_file
from uncertain_lti.base.progress import CountedStep, Progress
from uncertain_lti.cli.main import main
from uncertain_lti.identification import fit, working_set
from uncertain_lti.identification.archive import write_cache

CLI = [sys.executable, "-m", "uncertain_lti.cli.main"]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture(scope="module")
def long_run(tmp_path_factory):
    """A recording whose fit, with the left-out ones, takes seconds."""
    folder = tmp_path_factory.mktemp("long")
    (folder / "signals.yaml").write_text(SIGNALS.replace("auto", "1.0"))
    engine_bag(folder / "run.mcap", steps=1500)
    return folder


def fit_arguments(folder, output="m.model.json"):
    files = [str(folder / "run.mcap"), "--signals", str(folder / "signals.yaml")]
    return ["fit", *files, "--output", str(folder / output), "--additive", "noise", "--force"]


def test_work_goes_on_where_nobody_reads_what_it_says(long_run):
    """As after `2>&1 | head -1`: the model is written, and its summary said where somebody listens."""
    read, write = os.pipe()
    os.close(read)
    (long_run / "cut.model.json").unlink(missing_ok=True)
    command = [*CLI, *fit_arguments(long_run, "cut.model.json"), "--verbose"]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=write, text=True, timeout=120, check=False)
    os.close(write)
    assert done.returncode == 0 and "model written to" in done.stdout and (long_run / "cut.model.json").exists()


def test_a_terminal_sees_bars_that_are_gone_at_the_end(long_run):
    command = [*CLI, *fit_arguments(long_run)]
    status, written = on_a_terminal(command, stdout=subprocess.DEVNULL)
    assert status == 0
    assert "fitting: fit" in written and "%|" in written
    last = [line for line in written.replace("\r\n", "\n").splitlines() if not line.startswith("note: ")][-1]
    assert not last.split("\r")[-1].strip(), "the last thing drawn is an empty line"
    status, written = on_a_terminal([*command, "--quiet"], stdout=subprocess.DEVNULL)
    assert (status, written) == (0, "")


def test_no_terminal_no_bars(folder, cli):
    said = cli(*fit_arguments(folder))
    assert "model written" in said.out
    far = ("note: ", "reading: ", "fitting: ")  # how far long work is, which a busy machine prints
    assert "%|" not in said.err and all(line.startswith(far) for line in said.err.splitlines())
    said = cli(*fit_arguments(folder), "--quiet")
    assert (said.out, said.err) == ("", "")


def test_quiet_keeps_errors_data_and_status(folder, cli):
    model, run, bad = (str(folder / name) for name in ("m.model.json", "run.mcap", "bad.mcap"))
    assert main(["check", model, bad, "-q"]) == 1
    assert cli("validate", model, run, "-q") == ("", "")
    said = cli("check", model, run, "-q", "--json")
    assert json.loads(said.out)["alarm"] is False and not said.err
    assert cli("check", model, folder / "none.mcap", "-q", status=2).err.count("\n") == 1
    with pytest.raises(SystemExit) as refusal:
        main(["check", model, run, "-q", "-v"])
    assert refusal.value.code == 2


def test_verbose_tells_every_step(folder, cli):
    said = cli(*fit_arguments(folder), "--verbose").err.splitlines()
    lines = [line for line in said if not line.startswith("note: ")]
    assert sum("fitting: fit" in line for line in lines) == 5  # blocks left out, by one way only
    assert any("reading: " in line and "messages" in line for line in lines)
    times = [float(line.split()[0]) for line in lines]
    assert times == sorted(times)


def test_a_step_that_is_counted_moves_the_bar():
    screen = Terminal()
    with Progress(stream=screen) as progress, progress.stage("fitting") as step:
        time.sleep(0.5)
        step("state 9 of 10 is wide")  # text alone moves nothing
        time.sleep(0.2)
        step(CountedStep("fit 4 of 10: without the third", 4, 10))
        time.sleep(0.2)
        step("pass 7: 12 samples outside")
        progress.note("said while the bar stands")
    progress.note("said after it")
    said = screen.getvalue()
    assert " 30%" in said and " 80%" not in said and "pass 7: 12 samples outside" in said
    assert "note: said while the bar stands\n" in said and said.endswith("note: said after it\n")


def test_what_holds_of_several_recordings_is_one_note():
    screen = io.StringIO()
    with Progress(stream=screen) as progress:
        progress.note(*(f"{name}.csv: column 't': in ms" for name in "abcd"), "d.csv: is short", "alone")
        progress.note("d.csv: column 't': in ms", "e.csv: column 't': in ms")
    one, short, alone, later = screen.getvalue().splitlines()
    assert one == "note: a.csv, b.csv and 2 more: column 't': in ms" and later == "note: e.csv: column 't': in ms"
    assert (short, alone) == ("note: d.csv: is short", "note: alone")


def test_a_log_gets_a_line_now_and_then_with_the_time_left(monkeypatch):
    now = 0.0
    monkeypatch.setattr(time, "perf_counter", lambda: now)
    log, silent = io.StringIO(), io.StringIO()
    for stream, quiet in ((log, False), (silent, True)):
        now = 0.0
        with Progress(quiet, stream=stream) as progress, progress.stage("fitting") as step:
            for number in range(1, 31):
                now = number - 1.0
                step(CountedStep(f"row {number} of 30", number, 30))
    lines = [f"fitting: row {k} of 30, about {31 - k} s left" for k in (3, 13, 23)]
    assert (log.getvalue().splitlines(), silent.getvalue()) == (lines, "")
    with Progress(stream=log) as progress:
        for number in progress.iterate("reading")(range(5000), 5000):
            now += 0.002
            assert number < 5000
    assert log.getvalue().splitlines()[3:] == ["reading: 1024 of 5000 messages, about 8 s left"]


def test_what_is_said_of_a_pass_begins_with_how_far_the_rows_are(monkeypatch):
    """A log shows one line now and then, and hardly ever that of a row alone."""
    monkeypatch.setattr(working_set, "_HELD_BYTES", 1)
    rng, said = np.random.default_rng(0), list[str]()
    x = np.cumsum(rng.uniform(-1, 1, size=(20_002, 4)), axis=0) * 1e-3
    run = Transient(0.1 * np.arange(len(x)), x, rng.normal(size=(len(x), 1)))
    fit([run], "qp", additive="noise", describe_data=False, progress=said.append)
    begins = next(number for number, text in enumerate(said) if text.startswith("row 3 of 4, "))
    assert said[:begins] and all(text.startswith("pass ") for text in said[:begins])
    others = said[begins + 1 :]
    assert others and all(re.match(r"row 3 of 4, about \d+ s left; pass \d", text) for text in others)


def test_a_log_gets_a_line_of_many_short_parts(monkeypatch):
    now = 0.0
    monkeypatch.setattr(time, "perf_counter", lambda: now)
    log = io.StringIO()
    with Progress(stream=log) as progress:
        for _ in range(25):  # files of 1 s each
            for _ in progress.iterate("reading")(range(10), 10):
                now += 0.1
    assert [line.partition(":")[0] for line in log.getvalue().splitlines()] == ["reading"] * 2


def test_bars_go_where_an_error_passes_through():
    screen = Terminal()
    with pytest.raises(KeyboardInterrupt), Progress(stream=screen) as progress:
        wrap = progress.iterate("reading")
        for number in wrap(range(100), 100):
            time.sleep(0.02)
            if number == 50:
                raise KeyboardInterrupt
    assert "reading" in screen.getvalue()
    assert not screen.getvalue().rsplit("\r", 1)[-1].strip()


# --- whole files -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError, ValueError, SystemExit])
def test_a_file_is_whole_or_as_it_was(tmp_path, error):
    target = tmp_path / "a.bin"
    for before in (None, b"before"):
        if before is not None:
            target.write_bytes(before)
        with pytest.raises(error), whole_file(target) as stream:
            stream.write(b"half")
            raise error
        assert sorted(p.name for p in tmp_path.iterdir()) == ([] if before is None else ["a.bin"])
        assert before is None or target.read_bytes() == before
    with whole_file(target) as stream:
        stream.write(b"after")
    assert target.read_bytes() == b"after" and len(list(tmp_path.iterdir())) == 1
    assert target.stat().st_mode & 0o777 == 0o666 & ~_umask()


def _umask():
    mask = os.umask(0)
    os.umask(mask)
    return mask


def test_a_link_goes_on_pointing_where_it_does(tmp_path):
    (tmp_path / "there").mkdir()
    link = tmp_path / "m.json"
    link.symlink_to("there/m.json")
    for content in (b"one", b"two"):
        with whole_file(link) as stream:
            stream.write(content)
        assert link.is_symlink() and (tmp_path / "there" / "m.json").read_bytes() == content
    assert len(list(tmp_path.rglob("*"))) == 3


def test_what_is_no_file_is_written_to_and_stays():
    with whole_file(os.devnull) as stream:
        stream.write(b"gone")
    assert not os.path.isfile(os.devnull)


def test_an_interrupted_cache_leaves_nothing(tmp_path):
    from uncertain_lti.identification.assembly import assemble
    from uncertain_lti.model.operating_point import OperatingPoint
    from uncertain_lti.sampling.transient import Transient

    rng = np.random.default_rng(0)
    run = Transient(np.arange(50) * 0.1, rng.normal(size=(50, 1)), rng.normal(size=(50, 1)))
    problem = assemble([run], OperatingPoint.identity(1, 1), None, "none")

    def problems():
        yield problem
        raise KeyboardInterrupt

    for folder in (tmp_path / "new", tmp_path):
        with pytest.raises(KeyboardInterrupt):
            write_cache(folder, problems())
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_ctrl_c_at_any_time(long_run):
    """One line, status 130, and either the whole model or the file of before; no temporary files."""
    output = long_run / "out"
    output.mkdir()
    model, command = output / "m.model.json", [*CLI, *fit_arguments(long_run, "out/m.model.json")]
    before = '{"format": "uncertain-lti/1", "of": "before"}'
    began = time.monotonic()
    finished = subprocess.run(command, capture_output=True)
    took = time.monotonic() - began
    assert finished.returncode == 0, finished.stderr
    whole = json.loads(model.read_text())
    interrupted = 0
    for share in np.linspace(0.3, 0.9, 3):
        model.write_text(before)
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        time.sleep(share * took)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=300)
        lines = [line for line in said.splitlines() if not line.startswith(("note: ", "reading: ", "fitting: "))]
        assert [p.name for p in output.iterdir()] == ["m.model.json"]
        if process.returncode in (130, -signal.SIGINT) and "uncertain-lti fit" in said:  # the same to a shell
            interrupted += 1
            assert len(lines) == 1 and "interrupted" in lines[0], said
        elif process.returncode == 0:
            assert not lines
        else:  # before the command could begin: Python itself was starting
            assert process.returncode == -signal.SIGINT or "KeyboardInterrupt" in said
        text = model.read_text()
        assert text == before or json.loads(text)["A"] == whole["A"]
    assert interrupted
