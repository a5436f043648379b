# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Whether files are the consecutive parts of one recording."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from uncertain_lti.recordings.bag_files import stem_and_index
from uncertain_lti.recordings.containers import scan
from uncertain_lti.recordings.mcap_records import Contents, messages
from uncertain_lti.recordings.message_types import normal_name


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
        contents = scan(contents.path)
    times: list[int] = []
    for block in contents.blocks:
        times += (message[1] for message in messages(contents.records(block)))
    return max((b - a for a, b in itertools.pairwise(sorted(times))), default=0)
