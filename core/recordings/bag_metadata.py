# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What whoever recorded a bag wrote about it: the pairs of its metadata, whichever file holds them."""

from __future__ import annotations

import os
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Metadata

from uncertain_lti.base.files import MAGIC
from uncertain_lti.base.plain_yaml import compose, construct
from uncertain_lti.recordings.mcap_records import RECORD, parse

_LARGEST = 1 << 20  # bytes of one metadata record that is read


def metadata_pairs(recording: str | os.PathLike[str]) -> dict[str, str]:
    """Pairs of a recording's metadata.yaml (`custom_data`) and of its first MCAP file's metadata records."""
    path = Path(recording)
    folder = path if path.is_dir() else path.parent
    pairs = _custom_data(folder / "metadata.yaml")
    files = sorted(folder.glob("*.mcap")) if path.is_dir() else [path]
    for name, record in _records(files[0]) if files else []:
        for key, value in record.items():
            pairs.setdefault(key, value)
            pairs.setdefault(f"{name}/{key}", value)
    return pairs


def _custom_data(path: Path) -> dict[str, str]:
    import yaml

    try:
        about = construct(compose(path.read_text(encoding="utf-8")))["rosbag2_bagfile_information"]
        return {str(key): str(value) for key, value in (about.get("custom_data") or {}).items()}
    except (OSError, ValueError, yaml.YAMLError, KeyError, TypeError, AttributeError, RecursionError):
        return {}


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
