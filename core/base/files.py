# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Files that get their name only once they are whole, and what a file is by its first bytes."""

from __future__ import annotations

import fcntl
import glob
import hashlib
import os
import re
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from uncertain_lti.base.errors import BagError, UncertainLTIError

MAGIC = b"\x89MCAP0\r\n"
"""First and last bytes of an MCAP recording."""

_YOUNG = 10  # s


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Stream to a file that takes the place of `path` when the block ends without an error, and else is removed.

    Whatever ends the block early, Ctrl-C included, leaves what was there before. What is no file, such as /dev/null
    or a pipe, is written to in place; a link keeps pointing where it does.
    """
    if os.path.exists(path) and not os.path.isfile(path):
        with open(path, "wb") as stream:
            yield stream
        return
    path = os.path.realpath(path)
    folder, name = os.path.split(path)
    beginning = f".{name[:100]}-"
    _clear(folder, beginning)
    try:
        descriptor, temporary = tempfile.mkstemp(dir=folder, prefix=beginning, suffix=".tmp")
    except OSError as error:
        raise OSError(error.errno, error.strerror, path) from None
    try:
        with suppress(OSError):  # a file system without locks
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with os.fdopen(descriptor, "wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(temporary, 0o666 & ~mask)
        os.replace(temporary, path)
    except BaseException:
        with suppress(FileNotFoundError):
            os.unlink(temporary)
        raise


@contextmanager
def written(path: str | os.PathLike[str], refusal: type[UncertainLTIError], new: bool = False) -> Iterator[BinaryIO]:
    """`whole_file`; what the system refuses is one sentence, as is, of a new one, a file that came meanwhile."""
    try:
        with whole_file(path) as stream:
            yield stream
            if new and os.path.exists(path):
                raise refusal(f"{path}: came while this ran; choose another output, or move it away")
    except OSError as error:
        raise refusal(f"{path}: cannot be written: {error.strerror}; choose another place") from None


def _clear(folder: str, beginning: str) -> None:
    """Remove what writers of a file left that were killed, whose locks are free; a young one may not have its yet."""
    with suppress(OSError):
        for left in Path(folder or ".").glob(f"{glob.escape(beginning)}*.tmp"):
            with suppress(OSError), open(left, "rb") as stream:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if time.time() - left.stat().st_mtime > _YOUNG:
                    left.unlink()


def natural(path: Path) -> tuple[tuple[int, str], ...]:
    """Sort key that puts `bag_2` before `bag_10`."""
    return tuple((int(text), "") if text.isdigit() else (-1, text) for text in re.split(r"(\d+)", path.name))


def sha256(path: str | os.PathLike[str]) -> str:
    """Checksum of a file's content."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def target(output: str | os.PathLike[str], *, holds: bytes, kind: str, example: str) -> Path:
    """Where a file of a kind goes, that has such words in its first 500 bytes; an older one alone is replaced."""
    path = Path(output)
    if not path.parent.is_dir():
        raise BagError(f"{path}: the folder {path.parent} is not there; make it first")
    if path.is_dir():
        raise BagError(f"{path}: is a folder; name a file in it, for example {path / example}")
    with suppress(OSError), open(path if path.is_file() else os.devnull, "rb") as stream:
        head = stream.read(500)
        if head and holds not in head:
            raise BagError(f"{path}: is there already and is no {kind}; choose another name, or move it away")
    try_to_write(path)
    return path


def try_to_write(path: Path) -> None:
    """Refuse before the work what `written` would refuse after it: a folder in which nothing can be made."""
    if path.exists() and not path.is_file():
        return
    try:
        tempfile.TemporaryFile(dir=os.path.dirname(os.path.realpath(path))).close()
    except OSError as error:
        raise BagError(f"{path}: cannot be written: {error.strerror}; choose another place") from None


TABLES = (".csv", ".tsv", ".txt", ".dat", ".lvm", ".parquet", ".feather", ".mat", ".npz")
"""Suffixes of tables."""


def kind_of(path: str | os.PathLike[str]) -> str:
    """What a file is by its first bytes, or of a table by its name, with an article; "" where that is not known."""
    if os.path.isdir(path):
        return "a folder"
    if os.path.exists(path) and not os.path.isfile(path):
        return "a pipe or a device"  # to look into it would empty it, or wait for ever
    try:
        with open(path, "rb") as stream:
            head = stream.read(4000)
    except OSError:
        return ""
    if head.startswith(MAGIC[:5]):
        return "an MCAP recording"
    if head.startswith((b"SQLite format 3\0", b"#ROSBAG V")):
        return "a recorded bag"
    if head.lstrip().startswith(b"{") and b'"uncertain-lti/' in head:
        return "a model file"
    if os.fspath(path).lower().endswith(TABLES):
        return "a table"
    lines = head.splitlines()
    return "a signals file" if any(line.startswith((b"states:", b"controls:")) for line in lines) else ""
