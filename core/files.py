"""Files that bear their name only once they are whole, and what a file is by its first bytes."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import BinaryIO


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Stream to a file that takes the place of `path` when the block ends without an error, and else is removed.

    Whatever ends the block early, Ctrl-C included, leaves what was there before. What is no file, such as /dev/null
    or a pipe, is written to as it stands; a link goes on pointing where it does.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    if os.path.exists(path) and not os.path.isfile(path):
        with open(path, "wb") as stream:
            yield stream
        return
    path = os.path.realpath(path)
    folder, name = os.path.split(path)
    descriptor, temporary = tempfile.mkstemp(dir=folder, prefix=f".{name[:100]}-", suffix=".tmp")
    try:
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


def may_replace(path: str | os.PathLike[str], *, holds: bytes) -> bool:
    """Whether nothing is lost at this path when a file is written there that has such words in its first 500 bytes.

    So it is where there is nothing yet, and where an older file of the same kind stands; of a folder it is not asked.
    """
    try:
        with open(path, "rb") as stream:
            head = stream.read(500)
    except OSError:
        return True
    return not head or holds in head


def kind_of(path: str | os.PathLike[str]) -> str:
    """What a file is by its first bytes, with an article: a recording, a model, signals; "" where that is not known."""
    if os.path.isdir(path):
        return "a folder"
    try:
        with open(path, "rb") as stream:
            head = stream.read(4000)
    except OSError:
        return ""
    if head.startswith(b"\x89MCAP"):
        return "an MCAP recording"
    if head.lstrip().startswith(b"{") and b'"uncertain-lti/' in head:
        return "a model file"
    lines = head.splitlines()
    return "a signals file" if any(line.startswith((b"states:", b"controls:")) for line in lines) else ""
