# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Files of a recording of ROS messages: which belong together, in which order, and what was written about them."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from mcap.opcode import Opcode
from mcap.records import Metadata

from uncertain_lti.base.errors import BagError
from uncertain_lti.base.files import MAGIC, natural
from uncertain_lti.recordings.foreign import scan_foreign
from uncertain_lti.recordings.mcap_records import RECORD, Contents, messages, parse
from uncertain_lti.recordings.mcap_scan import outline, scan
from uncertain_lti.recordings.message_types import normal_name
from uncertain_lti.recordings.unreadable import SUFFIXES, file_names, no_recording, os_error
from uncertain_lti.signals.values import compose, construct

_PART = re.compile(r"(?P<stem>.*)_(?P<index>\d+)\.(?:mcap|db3|bag)")


def stem_and_index(path: Path) -> tuple[str, int] | None:
    """(`name`, 3) of `name_3.mcap`; None for other names."""
    match = _PART.fullmatch(path.name)
    return (match["stem"], int(match["index"])) if match else None


def _about(folder: Path) -> dict[str, Any]:
    """What a folder's metadata.yaml says of the recording; nothing without a usable one."""
    import yaml

    try:
        text = (folder / "metadata.yaml").read_text(encoding="utf-8")
        about = construct(compose(text))["rosbag2_bagfile_information"]
    except (OSError, ValueError, yaml.YAMLError, KeyError, TypeError, RecursionError):
        return {}
    return about if isinstance(about, dict) else {}


def listed_parts(folder: Path) -> list[Path]:
    """Parts in the order of the folder's metadata.yaml, there or not; none without a usable one."""
    about = _about(folder)
    names = about.get("relative_file_paths")
    if not isinstance(names, list):
        return []
    # Old recorders wrote the path from the folder above.
    parts = [folder / str(name) for name in names]
    parts = [part if part.exists() else folder / PurePosixPath(part).name for part in parts]
    storage = str(about.get("storage_identifier") or "")  # `ros2 bag reindex` may leave it empty
    if storage not in ("", "mcap", "sqlite3"):
        raise BagError(f"{folder}: a recording in '{storage}' storage; convert it to MCAP with ros2 bag convert")
    return parts


def parts_of(folder: Path) -> tuple[list[Path], bool, list[str]]:
    """Files of a folder that is one recording.

    Without metadata.yaml the parts are the folder's `<stem>_<i>.mcap`, `.db3` or `.bag` of one stem in natural order.
    """
    try:
        inside = sorted((p for p in folder.iterdir() if not p.name.startswith(".")), key=natural)
    except OSError as error:
        raise os_error(folder, error) from None
    found = [p for p in inside if p.suffix in SUFFIXES and not p.is_dir()]
    listed = listed_parts(folder)
    if listed:
        there = [part for part in listed if part.exists()]
        warnings = [f"{p}: metadata.yaml lists this part, and it is not there" for p in listed if p not in there]
        warnings += [f"{p}: metadata.yaml does not list this file; it is left out" for p in found if p not in there]
        if there:
            return there, True, warnings
        if len(listed) == len(found) == 1:  # renamed
            instead = f"{listed[0]}: metadata.yaml lists this file, and {found[0].name} is read, which is there instead"
            return found, False, [instead]
        others = f", or name one of those that are there: {file_names(found)}" if found else ""
        raise BagError(
            f"{folder}: metadata.yaml lists {file_names(listed)}, and none of them is there; copy them here{others}"
        )
    if not found:
        raise no_recording(folder, inside)
    stems = {pair[0] if (pair := stem_and_index(p)) else p.name for p in found}
    if len(stems) > 1:
        raise BagError(
            f"{folder}: without a metadata.yaml its files cannot be one recording; name them one by one: "
            f"{file_names(found)}"
        )
    warnings = []
    if (folder / "metadata.yaml").exists():
        warnings.append(f"{folder}: its metadata.yaml cannot be used; the files were taken by their names")
    return found, False, warnings


def survey(path: Path, indexed: bool = False) -> Contents:
    """What is in a file; if `indexed`, what its index states where it has one."""
    try:
        found = scan_foreign(path)
    except OSError as error:
        raise os_error(path, error) from None
    return found or (outline(path) if indexed else None) or scan(path)


def not_one_recording(parts: Sequence[Contents]) -> str:
    """Say why files are not the consecutive parts of one recording."""
    pause: int | None = None
    for before, after in itertools.pairwise(parts):
        names = f"{before.path.name} and {after.path.name}"
        pair = stem_and_index(before.path), stem_and_index(after.path)
        if not pair[0] or not pair[1] or pair[1][1] != pair[0][1] + 1:
            return f"{names} are not numbered one after the other"
        if not before.tally or not after.tally:
            continue  # nothing in it that could contradict
        kinds = [_kinds(part) for part in (before, after)]
        if not (kinds[0] <= kinds[1] or kinds[1] <= kinds[0]):
            return f"{names} do not carry the same topics"
        (begin, end), (next_begin, next_end) = _span(before), _span(after)
        if next_begin - end > 10**9 and pause is None:
            pause = max(_longest_pause(part) for part in parts)
        if next_begin - end > max(10**9, pause or 0):
            return f"{(next_begin - end) / 1e9:.1f} s lie between {names}"
        if next_begin < begin or (end - next_begin) * 10 > min(end - begin, next_end - next_begin):
            return f"{names} overlap in time"
    return ""


def _kinds(contents: Contents) -> set[tuple[str, str]]:
    """(topic, type) of every channel of a file."""
    schemas = contents.schemas
    return {
        (c.topic, normal_name(schemas[c.schema_id].name) if c.schema_id and c.schema_id in schemas else "")
        for c in contents.channels.values()
    }


def _span(contents: Contents) -> tuple[int, int]:
    return min(block.start for block in contents.blocks), max(block.end for block in contents.blocks)


def _longest_pause(contents: Contents) -> int:
    """Longest time without any message, ns."""
    if contents.indexed:
        contents = survey(contents.path)
    times: list[int] = []
    for block in contents.blocks:
        times += (message[1] for message in messages(contents.records(block)))
    return max((b - a for a, b in itertools.pairwise(sorted(times))), default=0)


_LARGEST = 1 << 20  # bytes of one metadata record that is read


def metadata_pairs(recording: str | os.PathLike[str]) -> dict[str, str]:
    """Pairs of a recording's metadata.yaml (`custom_data`) and of its first MCAP file's metadata records."""
    path = Path(recording)
    folder = path if path.is_dir() else path.parent
    custom = _about(folder).get("custom_data")
    pairs = {str(key): str(value) for key, value in custom.items()} if isinstance(custom, dict) else {}
    files = sorted(folder.glob("*.mcap")) if path.is_dir() else [path]
    for name, record in _records(files[0]) if files else []:
        for key, value in record.items():
            pairs.setdefault(key, value)
            pairs.setdefault(f"{name}/{key}", value)
    return pairs


def _records(path: Path) -> list[tuple[str, dict[str, str]]]:
    """Name and pairs of each metadata record; every other record is skipped without reading it."""
    found: list[tuple[str, dict[str, str]]] = []
    try:
        with open(path, "rb") as stream:
            size = stream.seek(0, 2)
            stream.seek(0)
            if stream.read(len(MAGIC)) != MAGIC:
                return found
            while len(header := stream.read(RECORD.size)) == RECORD.size:
                opcode, length = RECORD.unpack(header)
                if opcode in (0, Opcode.DATA_END, Opcode.FOOTER) or length > size - stream.tell():
                    break
                if opcode != Opcode.METADATA or length > _LARGEST:
                    stream.seek(length, 1)
                elif (record := parse(Metadata, stream.read(length))) is not None:
                    found.append((record.name, dict(record.metadata)))
    except OSError:
        pass
    return found
