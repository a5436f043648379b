# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Aside: a reader that may crash, run for ever or take all memory on a damaged file is run in a process of its own."""

from __future__ import annotations

import importlib
import os
import pickle
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from uncertain_lti.base.errors import BagError

_START = "import sys; sys.path[:] = sys.argv[4:]; from uncertain_lti.recordings.aside import _main; _main()"
_LEAST_MEMORY = 1 << 30
LARGEST_RATIO = 1000
_SECONDS = 8  # of processor time, and one more for each of these bytes
_BYTES_A_SECOND = 1_000_000


def most_inflated(size: int) -> int:
    """Bytes that the content of a file of this size may have when it is decompressed."""
    return max(_LEAST_MEMORY, LARGEST_RATIO * size)


def aside(function: Callable[[Path], Any], path: Path, what: str) -> Any:
    """What a function of a module gives for a file that is `what`, worked out in another process."""
    names = [function.__module__, function.__qualname__]
    command = [sys.executable, "-c", _START, *names, str(path), *sys.path]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)
    if done.returncode:
        raise BagError(f"{path}: is damaged or no {what} (its reader broke down or did not end); copy it again")
    found = pickle.loads(done.stdout)  # made by `_main`
    if isinstance(found, BagError):
        raise found
    return found


def one_line(error: BaseException | str) -> str:
    """What an error of a library says, short enough for a sentence."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 120 else text[:120] + " ..."


def _main() -> None:
    module, name, path = sys.argv[1], sys.argv[2], Path(sys.argv[3])
    function = getattr(importlib.import_module(module), name)
    size = path.stat().st_size
    with open("/proc/self/statm", encoding="ascii") as stream:
        taken = int(stream.read().split()[0]) * resource.getpagesize()
    seconds = _SECONDS + size // _BYTES_A_SECOND
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    most = min(taken + most_inflated(size), sys.maxsize)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    out = os.dup(1)
    os.dup2(2, 1)  # what a library prints
    found: Any
    try:
        found = function(path)
    except BagError as error:
        found = error
    except MemoryError:
        found = BagError(f"{path}: would take more memory than a recording of its size; check where it is from")
    with open(out, "wb") as stream_out:
        pickle.dump(found, stream_out, protocol=5)
