# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Files of a recording: which belong together, and in which order."""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath

from uncertain_lti.base.errors import BagError
from uncertain_lti.base.files import natural
from uncertain_lti.base.plain_yaml import compose, construct
from uncertain_lti.recordings.unreadable import SUFFIXES, file_names, no_recording, os_error

_PART = re.compile(r"(?P<stem>.*)_(?P<index>\d+)\.(?:mcap|db3|bag)")


def stem_and_index(path: Path) -> tuple[str, int] | None:
    """(`name`, 3) of `name_3.mcap`; None for other names."""
    match = _PART.fullmatch(path.name)
    return (match["stem"], int(match["index"])) if match else None


def listed_parts(folder: Path) -> list[Path] | None:
    """Parts in the order of the folder's metadata.yaml, there or not; None without a usable one."""
    import yaml

    path = folder / "metadata.yaml"
    try:
        text = path.read_text(encoding="utf-8")
        about = construct(compose(text))["rosbag2_bagfile_information"]
        names = [str(name) for name in about["relative_file_paths"]]
    except (OSError, UnicodeDecodeError, ValueError, yaml.YAMLError, KeyError, TypeError, RecursionError):
        return None
    # Old recorders wrote the path from the folder above.
    parts = [folder / name for name in names]
    parts = [part if part.exists() else folder / PurePosixPath(part).name for part in parts]
    storage = str(about.get("storage_identifier") or "")  # `ros2 bag reindex` may leave it empty
    if storage not in ("", "mcap", "sqlite3"):
        raise BagError(f"{folder}: a recording in '{storage}' storage; convert it to MCAP with ros2 bag convert")
    return parts or None


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
