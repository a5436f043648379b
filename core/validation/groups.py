# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Groups of recordings that resemble one another: one machine, one day, one operator."""

from __future__ import annotations

import math
import os
import re
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.errors import FitError
from uncertain_lti.base.text import plural
from uncertain_lti.recordings.bag_files import metadata_pairs
from uncertain_lti.sampling.transient import Transient

KEYS = "folder, hours=H, metadata=NAME or name=PATTERN"
"""What a key may be; see `group_names`."""
SESSION = 1.0
"""h between the end of a recording and the start of the next up to which both are taken for one session."""
_EPOCH = 10**17  # ns; stamps below (before 1973) are no time of day


def group_names(transients: Sequence[Transient], key: str) -> list[str]:
    """The group of each recording, by a key.

    Parameters
    ----------
    transients : sequence of Transient
        As read from recordings.
    key : str
        `folder`: the folder that holds the recording. `hours=H`: recordings of which each starts at most H hours after
        another one ended. `metadata=NAME`: the value of this pair in the recording's metadata. `name=PATTERN`: what a
        regular expression finds in the file name (its first group if it has one).

    Returns
    -------
    list of str
        One name per recording.

    Raises
    ------
    FitError
        The key is none of these, or a recording has no value for it (names the recording).
    """
    kind, _, value = key.partition("=")
    if kind == "folder" and not value:
        folders = [_folder(t) for t in transients]
        common = os.path.commonpath(folders) if folders else ""
        return [os.path.relpath(f, common) if f != common else os.path.basename(f) or f for f in folders]
    if kind == "hours" and value:
        with suppress(ValueError):
            if 0 < float(value) < math.inf:
                return _sessions(transients, float(value))
        raise FitError(f"group hours={value}: give a positive number of hours, such as hours=2")
    if kind == "metadata" and value:
        return [_from_metadata(t, value) for t in transients]
    if kind == "name" and value:
        try:
            pattern = re.compile(value)
        except re.error as error:
            raise FitError(f"group name={value}: is no regular expression ({error}); mend it") from None
        return [_from_name(t, pattern) for t in transients]
    raise FitError(f"group {key!r} is no key; use {KEYS}")


def resolve_groups(transients: Sequence[Transient], groups: Sequence[Any] | str | None) -> tuple[list[str], str]:
    """The group of each recording, and in words what the groups are; ([], "") without any."""
    if groups is None:
        return [], ""
    if isinstance(groups, str):
        names, grouping = group_names(transients, groups), groups
    else:
        names, grouping = [str(g) for g in groups], "named groups"
        if len(names) != len(transients):
            raise FitError(
                f"groups names {len(names)} groups for {plural(len(transients), 'recording')}; name one each"
            )
    if len(set(names)) < 2:
        raise FitError(
            f"{plural(len(names), 'recording')}, all of one group ({names[0]}), so nothing is left to fit to when "
            f"it is left out; record another, or validate without groups"
        )
    return names, grouping


def _folder(transient: Transient) -> str:
    path = Path(transient.name).resolve()
    if not path.exists() and transient.sources:
        path = Path(transient.sources[0]).resolve()  # a run of a table
    if not path.exists():
        raise FitError(f"{transient.name}: is no file, so it has no folder; name the groups one by one")
    inside = (path.parent / "metadata.yaml").exists()  # the file of a recording that is a folder
    return str(path.parent.parent if inside else path.parent)


def _from_metadata(transient: Transient, name: str) -> str:
    pairs = metadata_pairs(transient.name)
    if name not in pairs:
        there = ", ".join(sorted(pairs)[:8]) or "none"
        raise FitError(f"{transient.name}: its metadata has no '{name}' to group by; there is {there}")
    return pairs[name]


def _from_name(transient: Transient, pattern: re.Pattern[str]) -> str:
    name = os.path.basename(os.path.normpath(transient.name))
    found = pattern.search(name)
    if found is None:
        raise FitError(f"{transient.name}: group name={pattern.pattern} finds nothing in '{name}'; mend the pattern")
    return str(found[1] if pattern.groups and found[1] is not None else found[0])


def _spans(transients: Sequence[Transient]) -> NDArray[np.int64]:
    """First and last instant of each recording, ns, (transients, 2)."""
    return np.array([(t.t_ns.min(), t.t_ns.max()) if len(t) else (0, 0) for t in transients], dtype=np.int64)


def _sessions(transients: Sequence[Transient], hours: float) -> list[str]:
    spans = _spans(transients)
    for transient, (start, _) in zip(transients, spans, strict=True):
        if start < _EPOCH:
            raise FitError(
                f"{transient.name}: its stamps are no time of day (they begin at {start * 1e-9:.6g} s), so hours "
                f"cannot group it; group by folder, metadata or name"
            )
    numbers = _chained(spans, hours)
    starts = [int(spans[numbers == number, 0].min()) // 10**9 for number in numbers]
    return [f"{np.datetime64(start, 's')}Z" for start in starts]  # to the second, so that no fit changes the name


def _chained(spans: NDArray[np.int64], hours: float) -> NDArray[np.intp]:
    """Number of the session of each recording; a session goes on as long as the next start is near enough."""
    numbers, order = np.zeros(len(spans), dtype=np.intp), np.argsort(spans[:, 0], kind="stable")
    ends = np.maximum.accumulate(spans[order, 1])
    numbers[order[1:]] = np.cumsum(spans[order[1:], 0] - ends[:-1] > hours * 3600e9)
    return numbers


def likely_groups(transients: Sequence[Transient]) -> str:
    """A sentence if recordings seem to come in groups, by the folders and the hours they are from; else "".

    Recordings that overlap in time (simulated ones, mostly) cannot be distinguished by their hours.
    """
    count = len(transients)
    if count < 3:
        return ""
    advice = "what is from one day or machine is alike, and the intervals take every recording for independent"
    spans = _spans(transients)
    ordered = spans[np.argsort(spans[:, 0])]
    if (spans[:, 0] > _EPOCH).all() and (ordered[1:, 0] > ordered[:-1, 1]).all():
        sessions = int(_chained(spans, SESSION).max()) + 1
        if sessions == 1:
            return (
                f"all {count} recordings follow one another within {SESSION:g} h: they are of one session, so another "
                f"day, machine or operator may differ more than they do; record on other days"
            )
        if sessions < count:
            return f"the {count} recordings are of {sessions} sessions: {advice}; leave whole ones out: --group hours=1"
    if all(os.path.exists(t.name) for t in transients):
        folders = Counter(_folder(t) for t in transients)
        if 1 < len(folders) < count:
            return (
                f"the {count} recordings lie in {plural(len(folders), 'folder')}: {advice}; if a folder holds such a "
                f"group, leave whole ones out: --group folder"
            )
    return ""
