"""What a file is that cannot be read as a recording, and what to do about it."""

from __future__ import annotations

import shlex
import sqlite3
from collections.abc import Iterable
from pathlib import Path

from uncertain_lti.base.english import shortlist
from uncertain_lti.base.errors import BagError
from uncertain_lti.base.files import MAGIC, kind_of, natural


def not_mcap(path: Path, head: bytes) -> BagError:
    """The error that says what a file is whose first bytes are not those of MCAP.

    Parameters
    ----------
    path : Path
        The file.
    head : bytes
        Its first bytes.

    Returns
    -------
    BagError
        To be raised.
    """
    if not head:
        return BagError(f"{path}: the file is empty; record or copy it again")
    if MAGIC.startswith(head):
        return BagError(f"{path}: cut after {len(head)} bytes, before any message; record or copy it again")
    if head.startswith(b"version https://git-lfs"):
        return BagError(
            f"{path}: a Git LFS pointer, not the recording itself; fetch it with `git lfs pull` in its repository"
        )
    if head.startswith(b"SQLite format 3\0"):
        return sqlite_advice(path, [path], [path])
    if head.startswith(b"\x28\xb5\x2f\xfd"):
        return _compressed(path)
    if head.startswith((b"\x04\x22\x4d\x18", b"\x1f\x8b", b"BZh", b"\xfd7zXZ", b"PK\x03\x04")):
        return BagError(f"{path}: compressed as a whole file or an archive; unpack it first")
    if head.startswith(b"#ROSBAG V"):
        return BagError(
            f"{path}: a ROS 1 bag; convert it with `rosbags-convert --src {shlex.quote(str(path))} "
            f"--dst {shlex.quote(path.stem + '_mcap')} --dst-storage mcap`"
        )
    if head.startswith(MAGIC[:5]):
        return BagError(f"{path}: MCAP of another version ({head[5:6]!r}) or damaged in its first bytes; copy it again")
    if not head.strip(b"\0"):
        return BagError(f"{path}: begins with zeros only, as after a power cut; there is no recording in it")
    if known := kind_of(path):
        return BagError(f"{path}: this is {known}, and an MCAP recording is wanted here; are the arguments swapped?")
    kind = "a text file" if all(byte >= 32 or byte in b"\t\r\n\f" for byte in head[:512]) else "not an MCAP file"
    return BagError(f"{path}: {kind}, while an MCAP recording is wanted; check the path")


def missing(path: Path) -> BagError:
    """The error for a path that is not there; names the recordings in the same folder.

    Parameters
    ----------
    path : Path
        The path.

    Returns
    -------
    BagError
        To be raised.
    """
    there: list[Path] = []
    if path.parent.is_dir():
        there = sorted((p for p in path.parent.iterdir() if p.suffix == ".mcap"), key=natural)
    hint = f"; in {path.parent} there are {file_names(there)}" if there else "; check the path"
    return BagError(f"{path}: there is no such file or folder{hint}")


def os_error(path: Path, error: OSError) -> BagError:
    """One sentence for a file that the operating system does not hand out.

    Parameters
    ----------
    path : Path
        The file.
    error : OSError
        What the operating system raised.

    Returns
    -------
    BagError
        To be raised.
    """
    if isinstance(error, PermissionError):
        return BagError(f"{path}: no permission to read it; let its owner allow it with chmod +r")
    if isinstance(error, FileNotFoundError):
        return missing(path)
    return BagError(f"{path}: cannot be read ({error.strerror or error}); check the disk or copy it again")


def sqlite_advice(path: Path, sources: list[Path], parts: Iterable[Path]) -> BagError:
    """The error for sqlite3 storage, with the command that converts `sources`, whose database files are `parts`.

    Types that neither the file nor ROS 2 Jazzy defines would stop that command, so it leaves them out.

    Parameters
    ----------
    path : Path
        The recording as the user named it.
    sources : list of Path
        What the command converts.
    parts : iterable of Path
        Their database files.

    Returns
    -------
    BagError
        To be raised.
    """
    types: set[str] = set()
    defined: set[str] = set()
    for part in parts:
        try:
            connection = sqlite3.connect(f"{part.resolve().as_uri()}?mode=ro&immutable=1", uri=True)
            try:
                types |= {row[0] for row in connection.execute("SELECT type FROM topics")}
                if connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'message_definitions'").fetchone():
                    query = "SELECT topic_type FROM message_definitions WHERE encoded_message_definition != ''"
                    defined |= {row[0] for row in connection.execute(query)}
            finally:
                connection.close()
        except sqlite3.Error:
            continue
    if not defined:
        from rosbags.typesys import Stores, get_typestore

        defined = set(get_typestore(Stores.ROS2_JAZZY).fielddefs)
    unknown = sorted(types - defined)
    command = ["rosbags-convert", "--src", *map(str, sources), "--dst", f"{path.stem}_mcap", "--dst-storage", "mcap"]
    command += ["--src-typestore", "ros2_jazzy"]
    command += ["--exclude-msgtype", *unknown] if unknown else []
    left_out = ", which leaves out the types that it has no definition of" if unknown else ""
    return BagError(
        f"{path}: a recording in sqlite3 storage, and MCAP is wanted; convert it with `{shlex.join(command)}`{left_out}"
    )


def _compressed(path: Path) -> BagError:
    """`zstd -d` alone knows the suffix .zst, not rosbag2's .zstd."""
    plain = path.stem if path.suffix in (".zst", ".zstd") else f"{path.stem}.plain.mcap"
    command = shlex.join(["zstd", "-d", str(path), "-o", plain])
    return BagError(f"{path}: compressed as a whole file; decompress it with `{command}` and read {plain}")


def no_recording(folder: Path, inside: list[Path]) -> BagError:
    """The error for a folder without an MCAP file; says what is in it instead.

    Parameters
    ----------
    folder : Path
        The folder.
    inside : list of Path
        What is in it.

    Returns
    -------
    BagError
        To be raised.
    """
    databases = [p for p in inside if p.suffix == ".db3"]
    if databases:
        return sqlite_advice(folder, databases, databases)
    for part in inside:
        if part.name.endswith((".mcap.zstd", ".mcap.zst")):
            return _compressed(part)
    folders = [p for p in inside if p.is_dir() and any(q.suffix == ".mcap" for q in p.glob("*"))]
    if folders:
        return BagError(f"{folder}: holds no recording itself; name the folders in it: {file_names(folders)}")
    return BagError(f"{folder}: there is no .mcap file in this folder; check the path")


def file_names(paths: list[Path], limit: int = 12) -> str:
    """Names of files in one sentence.

    Parameters
    ----------
    paths : list of Path
        The files.
    limit : int, default 12
        Names at most.

    Returns
    -------
    str
        Names, and how many more there are.
    """
    return shortlist([path.name for path in paths], limit)
