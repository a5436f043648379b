# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Bags: which recordings some MCAP files and folders are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from uncertain_lti.base.errors import BagError
from uncertain_lti.base.files import natural
from uncertain_lti.recordings.bag import Bag
from uncertain_lti.recordings.bag_files import listed_parts, stem_and_index
from uncertain_lti.recordings.bag_seams import not_one_recording
from uncertain_lti.recordings.containers import outline_or_scan, scan


def group_bags(paths: Sequence[Path], indexed: bool = False) -> list[Bag]:
    """Bags that some paths name, in the order of their first mention.

    A folder is one recording. Files are one recording each, except the parts of a split bag: files
    `<stem>_<i>.mcap` of one stem in one folder that either

    - are listed together in the metadata.yaml of their folder, or
    - are numbered 0, 1, 2, ... without a hole, carry the same topics, and follow each other in log time
      without a break: each begins at most 1 s, or the longest pause inside one of them, after the one
      before ends, and overlaps it by no more than 10 % of the shorter (messages at a seam may be out of order).

    In doubt files stay apart: that loses the one transition at a seam, while joining two runs would invent one.
    """
    order: list[tuple[Path, str]] = []
    files: dict[tuple[Path, str], list[Path]] = {}
    for path in paths:
        pair = None if path.is_dir() else stem_and_index(path)
        group = (path.parent, f"{pair[0]}_*.mcap" if pair else path.name)
        if group not in files or path.is_dir():
            order.append(group)
        files.setdefault(group, []).append(path)
    bags = []
    for group in order:
        bags += _group(files[group], indexed)
    return bags


def _group(paths: list[Path], indexed: bool) -> list[Bag]:
    if len(paths) == 1 or len(set(paths)) < len(paths):
        return [Bag(path, indexed=indexed) for path in paths]
    try:
        listed = {part.resolve(): i for i, part in enumerate(listed_parts(paths[0].parent) or [])}
    except BagError:  # about other files in the folder
        listed = {}
    if all(path.resolve() in listed for path in paths):
        paths = sorted(paths, key=lambda path: listed[path.resolve()])
        return [Bag(paths[0], paths, indexed)]
    survey = outline_or_scan if indexed else scan
    contents = {path: survey(path) for path in paths}
    ordered = [contents[path] for path in sorted(paths, key=natural)]
    numbers = [pair[1] for part in ordered if (pair := stem_and_index(part.path))]
    if numbers[0] == 0 and not not_one_recording(ordered):
        return [Bag(ordered[0].path, ordered)]
    return [Bag(path, [contents[path]]) for path in paths]
