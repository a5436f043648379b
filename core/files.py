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


def is_mcap(path: str | os.PathLike[str]) -> bool:
    """Whether a file begins as an MCAP recording does; False where it cannot be read."""
    try:
        with open(path, "rb") as stream:
            return stream.read(5) == b"\x89MCAP"
    except OSError:
        return False
