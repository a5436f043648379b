# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What keeps tests apart: the processes of one are ended with it, and its ROS domain is its own meanwhile; limits."""

import ctypes
import fcntl
import os
import pty
import random
import signal
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

_PR_SET_CHILD_SUBREAPER = 36
LASTING: set[int] = set()  # children that serve several tests
_HELPERS = (b"multiprocessing.resource_tracker", b"multiprocessing.forkserver")  # live as long as who imports them


_DOMAINS = range(215, 233)
"""Chosen by nobody by hand, nor by ./run; their ports lie above those that Linux gives to outgoing connections."""


@contextmanager
def own_domain(patience: float = 300.0) -> Iterator[int]:
    """A ROS domain that nothing else on this machine uses meanwhile; waits for one if all are in use."""
    end = time.monotonic() + patience
    while time.monotonic() < end:
        for number in random.sample(_DOMAINS, len(_DOMAINS)):
            try:
                lock = open(f"/tmp/uncertain-lti-test-domain-{number}", "w")
            except OSError:  # of another user
                continue
            with lock:
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except OSError:
                    continue
                if not _is_heard(number):
                    yield number
                    return
        time.sleep(0.5)
    raise RuntimeError("every ROS domain that tests take is in use")


def _is_heard(domain: int) -> bool:
    """Whether a process of this machine listens on a port of a domain; of those that no lock tells."""
    ports = range(7400 + 250 * domain, 7400 + 250 * (domain + 1))
    for table in ("/proc/net/udp", "/proc/net/udp6"):
        with suppress(OSError):  # not on Linux
            for line in Path(table).read_text().splitlines()[1:]:
                if int(line.split()[1].rpartition(":")[2], 16) in ports:
                    return True
    return False


def adopt_orphans() -> None:
    """Have processes whose parent has ended become children of this one, and so findable; on Linux."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def children(parent: int | str = "self") -> set[int]:
    """Direct children, those that ended and were not waited for included; empty when the process has gone."""
    found: set[int] = set()
    with suppress(OSError):
        for task in Path(f"/proc/{parent}/task").iterdir():
            with suppress(OSError):  # the thread has ended
                found.update(map(int, (task / "children").read_text().split()))
    return found


def runs(pid: int) -> bool:
    """Whether a process is there and has not ended; one that only waits to be waited for has ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in ("Z", "X")
    except OSError:
        return False


def end_children(before: set[int], patience: float) -> list[str]:
    """End the children that were not there before, with all their descendants.

    Those that are about to end get `patience`, s, to do so. Returns the command lines of those that had to be ended.
    """
    deadline = time.monotonic() + patience
    while (left := _strays(before)) and time.monotonic() < deadline:
        time.sleep(0.02)
    commands = [_command(pid).decode(errors="replace") for pid in left]
    while left:
        for pid in left:
            _kill_tree(pid)
        left = _strays(before)  # what their ends have orphaned
    for pid in children() - before:
        if not runs(pid):
            with suppress(OSError):
                os.waitpid(pid, os.WNOHANG)
    return commands


def _strays(before: set[int]) -> list[int]:
    new = children() - before - LASTING
    return [p for p in new if runs(p) and not any(helper in _command(p) for helper in _HELPERS)]


def _command(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").strip()
    except OSError:
        return b""


def _kill_tree(pid: int) -> None:
    below = children(pid)
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)
    for child in below:
        _kill_tree(child)


def on_a_terminal(command: list[str], until: bytes = b"", **options: Any) -> tuple[int, str]:
    """Status of a process and what it wrote to a terminal; it is interrupted once that has these words."""
    screen, terminal = pty.openpty()
    process = subprocess.Popen(command, **{"stdout": terminal, "stderr": terminal} | options)
    os.close(terminal)
    shown = b""
    with suppress(OSError):  # as the terminal ends with its last program
        while text := os.read(screen, 4096):
            shown += text
            if until and until in shown:
                process.send_signal(signal.SIGINT)
                until = b""
    os.close(screen)
    return process.wait(), shown.decode()


@contextmanager
def bounded(seconds: float, memory: float = 0) -> Iterator[None]:
    """Hold what is done to so many s of processor time, and to so many bytes of memory where a number is given."""
    begin = time.process_time()
    if not memory:
        yield
        assert time.process_time() - begin < seconds
        return
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert time.process_time() - begin < seconds
    assert peak < memory
