# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Files that cannot be read: what they are, what to do about them, and readers that they may break down run aside."""

from __future__ import annotations

import importlib
import os
import pickle
import resource
import shlex
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from uncertain_lti.base.errors import BagError
from uncertain_lti.base.files import MAGIC, TABLES, kind_of, natural
from uncertain_lti.base.text import printable, shortlist

SUFFIXES = (".mcap", ".db3", ".bag")
"""Suffixes of files that hold ROS messages."""


_SENTENCE = 300  # letters
_MEASUREMENTS = {b"\x89HDF": "an HDF5 file", b"MDF ": "a measurement of CAN and the like (MDF)", b"TDSm": "a TDMS file"}
"""Containers of other tools, by their first four bytes."""


def not_mcap(path: Path, head: bytes) -> BagError:
    """The error that says what a file is whose first bytes are not those of MCAP."""
    if not head:
        return BagError(f"{path}: the file is empty; record or copy it again")
    if MAGIC.startswith(head):
        return BagError(f"{path}: cut after {len(head)} bytes, before any message; record or copy it again")
    if head.startswith(b"\x28\xb5\x2f\xfd"):
        return _compressed(path)
    suffix, known = path.suffix.lower(), kind_of(path)
    text = all(byte >= 32 or byte in b"\t\r\n\f" for byte in head[:512])
    kind = "a text file" if text else "no kind of file that is known"
    wanted = f"a recording is wanted (MCAP, .db3, .bag, or a table called {', '.join(TABLES)})"
    csv = "write its messages as .csv, such as with"
    why = next(
        words
        for met, words in (
            (head.startswith(b"version https://git-lfs"),
             "a Git LFS pointer, not the recording itself; fetch it with `git lfs pull` in its repository"),
            (suffix in (".xlsx", ".xls", ".ods"), "a spreadsheet; save its sheet as .csv"),
            (head.startswith(b"ULog"), f"a log of PX4; {csv} `ulog2csv`, of times in us: `--table unit=us`"),
            (head.startswith(b"\xa3\x95"), f"a log of ArduPilot; {csv} `mavlogdump.py --format csv --types ATT`"),
            (head.startswith(tuple(_MEASUREMENTS)),
             f"{_MEASUREMENTS.get(head[:4])}; write its signals of one time as columns of a .csv file"),
            (head.startswith((b"\x04\x22\x4d\x18", b"\x1f\x8b", b"BZh", b"\xfd7zXZ", b"PK\x03\x04")),
             "compressed as a whole file or an archive; unpack it first"),
            (head.startswith(MAGIC[:5]),
             f"MCAP of another version ({head[5:6]!r}) or damaged in its first bytes; copy it again"),
            (not head.strip(b"\0"), "begins with zeros only, as after a power cut; there is no recording in it"),
            (suffix in TABLES, "a table, and a recording of ROS messages is wanted here; check the path"),
            (known, f"this is {known}, and a recording is wanted here; are the arguments swapped?"),
            (True, f"{kind}, while {wanted}; check the path and its suffix"),
        )
        if met
    )  # fmt: skip
    return BagError(f"{path}: {why}")


def missing(path: Path) -> BagError:
    """The error for a path that is not there; names the recordings in the same folder."""
    inside = sorted(path.parent.iterdir(), key=natural) if path.parent.is_dir() else ()
    there = [p for p in inside if p.suffix in (*SUFFIXES, *TABLES) or (p / "metadata.yaml").exists()]
    hint = f"; in {path.parent} there are {file_names(there)}" if there else "; check the path"
    if str(path).startswith("~") or "*" in path.name:
        hint = "; a shell replaces ~ and * only where they are not in quotes"
    if path.is_symlink():
        hint = f"; it is a link to {os.readlink(path)}, which is not there"
    if (unfinished := Path(f"{path}.part")).exists():
        hint = f"; its recording goes on, or was killed: read {unfinished}"
    return BagError(f"{path}: there is no such file or folder{hint}")


def os_error(path: Path, error: OSError) -> BagError:
    """One sentence for a file that the operating system does not hand out."""
    if isinstance(error, PermissionError):
        return BagError(f"{path}: no permission to read it; let its owner allow it with chmod +r")
    if isinstance(error, FileNotFoundError):
        return missing(path)
    return BagError(f"{path}: cannot be read ({error.strerror or error}); check the disk or copy it again")


def changed(path: Path, how: str = "") -> BagError:
    """The error for a file that is not what it was when it was opened."""
    return BagError(f"{path}: the file changed while it was read{how}; read it again when it is written")


def _compressed(path: Path) -> BagError:
    """`zstd -d` alone knows the suffix .zst, not rosbag2's .zstd."""
    plain = path.stem if path.suffix in (".zst", ".zstd") else f"{path.stem}.plain.mcap"
    command = shlex.join(["zstd", "-d", str(path), "-o", plain])
    return BagError(f"{path}: compressed as a whole file; decompress it with `{command}` and read {plain}")


def no_recording(folder: Path, inside: list[Path]) -> BagError:
    """The error for a folder without a recording; says what is in it instead."""
    for part in inside:
        if part.name.endswith(tuple(f"{suffix}.{zstd}" for suffix in SUFFIXES for zstd in ("zstd", "zst"))):
            return _compressed(part)
    folders = [p for p in inside if p.is_dir() and any(q.suffix in SUFFIXES for q in p.glob("*"))]
    if folders:
        return BagError(f"{folder}: holds no recording itself; name the folders in it: {file_names(folders)}")
    if tables := [p for p in inside if p.suffix in TABLES]:
        return BagError(f"{folder}: a folder of tables, each of which is a recording; {name_each(folder, tables)}")
    return BagError(f"{folder}: there is no {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]} file in it; check the path")


def name_each(folder: Path, inside: Sequence[Path]) -> str:
    """The remedy for a folder whose files are recordings of their own."""
    return f"name them, {shlex.quote(str(folder))}/*{inside[0].suffix}: {file_names(inside)}"


def file_names(paths: Sequence[Path]) -> str:
    """Names of files in one sentence."""
    return shortlist([path.name for path in paths], 12)


_START = "import sys; sys.path[:] = sys.argv[4:]; from uncertain_lti.recordings.unreadable import _main; _main()"
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
    """What an error says, short enough for a sentence; its end, which may be a remedy, stays."""
    return printable(" ".join(str(error).split()) or type(error).__name__, _SENTENCE)


def _main() -> None:
    module, name, path = sys.argv[1], sys.argv[2], Path(sys.argv[3])
    function = getattr(importlib.import_module(module), name)
    size = path.stat().st_size
    taken = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    seconds = _SECONDS + size // _BYTES_A_SECOND
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    most = min(taken + most_inflated(size), sys.maxsize)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    out = os.dup(1)
    os.dup2(2, 1)  # what a library prints
    try:
        found: Any = function(path)
    except BagError as error:
        found = error
    except MemoryError:
        found = BagError(f"{path}: would take more memory than a recording of its size; check where it is from")
    with open(out, "wb") as stream_out:
        pickle.dump(found, stream_out, protocol=5)
