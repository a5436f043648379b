# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Processes in which solvers run that hold the interpreter's lock, so that the programmes of rows run side by side.

They import nothing of the caller's main module, which may not be guarded, and take no Ctrl-C; they end with the block
that wanted them, or with this process, whose end closes their input. Where one cannot be had or dies, the solver runs
here: the answer has the same bits.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, BinaryIO, TypeVar, cast

from uncertain_lti.base.arrays import core_count

T = TypeVar("T")

_START = "import sys; sys.path[:] = {}; from uncertain_lti.identification.solver_processes import serve; serve()"
_lock = threading.Lock()
_blocks = 0
_idle: list[subprocess.Popen[bytes]] = []


@contextmanager
def solver_processes() -> Iterator[None]:
    """Within this block `aside` may keep processes; blocks can be nested."""
    global _blocks
    with _lock:
        _blocks += 1
    try:
        yield
    finally:
        with _lock:
            _blocks -= 1
            ended = [] if _blocks else _idle[:]
            del _idle[: len(ended)]
        for process in ended:
            _end(process)


def aside(function: Callable[..., T], *arguments: Any) -> T:
    """function(*arguments), a function of a module and arguments that can be pickled, in a process of its own."""
    if not _blocks or core_count() < 2:
        return function(*arguments)
    with _lock:
        process = _idle.pop() if _idle else None
    try:
        process = process or _start()
        pickle.dump((function, arguments), _input(process), protocol=5)
        _input(process).flush()
        result = cast("T", pickle.load(cast("BinaryIO", process.stdout)))
    except BaseException as error:
        if process is not None:
            _end(process)
        if isinstance(error, (OSError, EOFError, pickle.UnpicklingError)):
            return function(*arguments)
        raise  # Ctrl-C in the middle of an answer
    with _lock:
        if _blocks:
            _idle.append(process)
            return result
    _end(process)
    return result


def serve() -> None:
    """Answer calls that arrive at the standard input until it ends; what a solver prints is no answer."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    with suppress(EOFError, BrokenPipeError):
        while True:
            function, arguments = pickle.load(sys.stdin.buffer)
            pickle.dump(function(*arguments), answers, protocol=5)
            answers.flush()


def _start() -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-c", _START.format(sys.path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        pipesize=1 << 20,
        start_new_session=True,
    )


def _input(process: subprocess.Popen[bytes]) -> BinaryIO:
    return cast("BinaryIO", process.stdin)


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    with suppress(OSError):
        process.communicate()
