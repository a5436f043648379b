# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Recordings read in processes side by side: as one after the other, in what is read, said and refused."""

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path
from typing import Any

import pytest
from bag_writer import float64
from processes import runs as runs_still
from test_reading import FLOAT64, JOINT_STATE, MS, joint_state, save

import uncertain_lti.sampling.reading
from uncertain_lti.base.errors import BagError, SignalError
from uncertain_lti.recordings.formats import group_recordings
from uncertain_lti.sampling.reading import _pool, children_ignore_ctrl_c, processes_for, read_transients
from uncertain_lti.signals.signal_map import Signal, SignalMap

XU = SignalMap((Signal("x", "/x", "position[0]"),), (Signal("u", "/u", "data"),))


def runs(folder: Path, number: int = 3) -> list[Path]:
    """Recordings of their own lengths and numbers; the last is damaged, and has a message that cannot be decoded."""
    paths = []
    for run in range(number):
        messages = [("/u", 5 * MS, float64(0.5))]
        for k in range(1, 200 + 10 * run):
            messages.append(("/x", 10 * k * MS, joint_state(10 * k * MS, [k * 0.1 + run])))
            messages.append(("/u", 10 * k * MS + run, float64(k % 7) if k != 50 or run < number - 1 else b"\0\1\0\0"))
        paths.append(save(folder, {"/x": JOINT_STATE, "/u": FLOAT64}, messages, f"run_{'abcdef'[run]}.mcap"))
    data = bytearray(paths[-1].read_bytes())
    data[-30] ^= 1  # in the footer: its index does not count
    paths[-1].write_bytes(data)
    return paths


@pytest.mark.slow
def test_the_same_transients_and_remarks(tmp_path: Path) -> None:
    paths = runs(tmp_path)
    counted: list[int] = []

    def progress(items, total):  # type: ignore[no-untyped-def]
        number = 0
        for item in items:
            number += 1
            yield item
        counted.extend((number, total))

    alone = read_transients(paths, XU)
    beside = read_transients(paths, XU, progress, processes=2)
    assert counted[0] == counted[1] == sum(2 * t.counters["samples"] + 1 for t in alone)
    for one, other in zip(alone, beside, strict=True):
        for name in ("name", "notes", "counters", "sources"):
            assert getattr(one, name) == getattr(other, name)
        for name in ("t_ns", "x", "u", "segment"):
            assert getattr(one, name).tobytes() == getattr(other, name).tobytes()
    assert any("cannot be decoded" in note for note in beside[-1].notes)


@pytest.mark.parametrize("processes", ["two", [2], 1.5, 0, -1])
def test_a_number_of_processes_is_a_whole_one(tmp_path: Path, processes: Any) -> None:
    with pytest.raises(BagError, match="processes is .*; give a whole number from 1 on, or None"):
        read_transients(runs(tmp_path), XU, processes=processes)


@pytest.mark.slow
def test_what_a_process_refuses_is_one_error_here(tmp_path: Path) -> None:
    paths = runs(tmp_path)
    for process in (1, 2):
        named = SignalMap((Signal("x", "/x", "position[arm]"),))
        with pytest.raises(SignalError, match="run_a.mcap: there is no 'arm' in the message's names"):
            read_transients(paths, named, processes=process)
    late = save(tmp_path, {"/x": JOINT_STATE}, [("/x", 2**63 + 5, joint_state(1, [1.0]))], "late.mcap")
    with pytest.raises(BagError, match="late.mcap: no message can be read .1 message.* past the year 2262 left out"):
        read_transients([paths[0], late], SignalMap((Signal("x", "/x", "position[0]"),)), processes=2)


@pytest.mark.slow
def test_a_process_that_is_killed_is_an_error_and_not_a_hang(tmp_path: Path) -> None:
    script = SCRIPT.format(paths=[str(p) for p in runs(tmp_path)])
    command = [sys.executable, "-c", textwrap.dedent(script)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as reader:
        assert reader.stdout is not None
        assert reader.stdout.readline() == "reading\n"
        os.kill(first_child(reader.pid), signal.SIGKILL)
        rest, _ = reader.communicate("go on\n", timeout=300)
    assert "BagError" in rest and "the process that read it was ended" in rest


@pytest.mark.slow
def test_interrupted_it_leaves_no_process_and_no_traceback_of_theirs(tmp_path: Path) -> None:
    script = SCRIPT.format(paths=[str(p) for p in runs(tmp_path)])
    command, pipes = [sys.executable, "-c", textwrap.dedent(script)], ("stdin", "stdout", "stderr")
    streams = dict.fromkeys(pipes, subprocess.PIPE)
    reader = subprocess.Popen(command, text=True, start_new_session=True, **streams)
    with reader:
        assert reader.stdout is not None
        assert reader.stdout.readline() == "reading\n"
        child = first_child(reader.pid)
        os.killpg(reader.pid, signal.SIGINT)  # as a terminal does
        rest, errors = reader.communicate(timeout=300)
    assert rest == "interrupted\n" and errors == ""
    deadline = time.monotonic() + 60
    while runs_still(child) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not runs_still(child)


def test_ctrl_c_while_processes_start_is_neither_lost_nor_theirs() -> None:
    reached = False
    with pytest.raises(KeyboardInterrupt):
        with children_ignore_ctrl_c():
            with subprocess.Popen(["sleep", "600"]) as child:
                os.kill(os.getpid(), signal.SIGINT)
                child.send_signal(signal.SIGINT)
                child.send_signal(signal.SIGTERM)  # would come second
                assert child.wait() == -signal.SIGTERM
            reached = True
    assert reached


SCRIPT = """
    import sys, threading, time
    import uncertain_lti.sampling.reading as side
    from uncertain_lti.base.errors import BagError
    from uncertain_lti.sampling.reading import read_transients
    from uncertain_lti.signals.signal_map import Signal, SignalMap

    def progress(items, total):
        print("reading", flush=True)
        sys.stdin.readline()  # until something has happened to it
        yield from items

    signals = SignalMap((Signal("x", "/x", "position[0]"),), (Signal("u", "/u", "data"),))
    try:
        read_transients({paths} , signals, progress, processes=2)
    except BagError as error:
        print("BagError", error)
    except KeyboardInterrupt:
        print("interrupted")
"""


def first_child(parent: int) -> int:
    """A process that reads for it."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        found = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
        workers = [int(pid) for pid in found if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]
        if workers:
            return workers[0]
        time.sleep(0.01)
    raise AssertionError("no process reads for it")


def test_small_recordings_are_read_without_processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bags = group_recordings(runs(tmp_path), indexed=True)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(8), raising=False)
    assert processes_for(bags) == 1
    monkeypatch.setattr(uncertain_lti.sampling.reading, "WORTH_IT", 1000)
    assert processes_for(bags) == 3
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(2), raising=False)
    assert processes_for(bags) == 1  # which reads ahead on the other core


def test_processes_that_still_read_are_ended_where_the_reading_breaks_off() -> None:
    with pytest.raises(BagError), _pool(1) as pool:
        busy = pool.submit(time.sleep, 60.0)
        while not busy.running():
            time.sleep(0.01)
        broke_off = time.monotonic()
        raise BagError("one of them is damaged")
    assert time.monotonic() - broke_off < 30.0
