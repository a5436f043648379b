# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Proposal: a signals file suggested from what a recording holds, for a person to edit."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from uncertain_lti.base.errors import BagError, TransientError, absent
from uncertain_lti.base.text import meant, shortlist
from uncertain_lti.proposal.candidates import FEWEST, Candidate, Source
from uncertain_lti.proposal.choosing import choose
from uncertain_lti.proposal.effects import earlier
from uncertain_lti.proposal.plant import is_plant, plant_signals
from uncertain_lti.proposal.reading import Iterate, read_sources, run_column
from uncertain_lti.proposal.roles import ask_for, assign_roles, at_rest
from uncertain_lti.proposal.signals_file import (
    clock_of,
    columns_of,
    entry,
    name_signals,
    set_operating_point,
    set_own_scale,
    signals_file,
)
from uncertain_lti.proposal.tune import choose_memories
from uncertain_lti.recordings.formats import group_recordings
from uncertain_lti.recordings.recording import Recording
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.functions import Memory
from uncertain_lti.signals.values import TableLayout


@dataclass(frozen=True)
class Proposal:
    """States and controls of a machine, as far as a recording tells.

    `states`: proposed states; `controls`: proposed controls; `text`: the signals file, with its reasons; `warnings`:
    what the reader should know, a sentence each; `members`: many alike, such as joints, that the file is for; the
    states and controls are those of one of them.
    """

    states: tuple[Candidate, ...]
    controls: tuple[Candidate, ...]
    text: str
    warnings: tuple[str, ...] = ()
    members: tuple[str, ...] = ()


def propose(
    paths: Sequence[str | os.PathLike[str]],
    progress: Iterate | None = None,
    *,
    states: Sequence[str] = (),
    controls: Sequence[str] = (),
    like: str = "",
) -> Proposal:
    """Suggest states and controls of a machine from recordings of it.

    Topics are classified by their names and types, and if these say nothing by what helps to predict what; of a
    topic's numbers those are proposed that move, and in whose next step the controls show, or which help to predict
    such ones. Everything else is listed in comments with the reason. Where states and commands are of many that are
    alike, such as the joints of a robot, the file is for all of them, each with states and controls of its own.

    Parameters
    ----------
    paths : sequence of path
        As for `read_transients`.
    progress : callable, optional
        As for `read_transients`.
    states : sequence of str, optional
        Topics, or TOPIC:FIELD, with `*` for any letters: what may be a state, in place of what looks like one.
    controls : sequence of str, optional
        Likewise for the controls.
    like : str, default ""
        The member of many that are alike, such as a joint, that the file is drawn up for; default the one whose command
        shows most. The file is for all members in which the same numbers move.

    Returns
    -------
    Proposal
        With the text of the file.

    Raises
    ------
    BagError
        A recording cannot be read, or holds nothing that could be a state, or nothing that was asked for.
    """
    bags = group_recordings(list(paths))
    if not bags:
        raise BagError("no recording is named; give at least one file or folder")
    runs = run_column(bags)
    if runs:
        bags = group_recordings(list(paths), layout=TableLayout(runs=runs))
    sources = read_sources(bags, progress)
    if not (states or controls or like) and is_plant(sources):
        return _of_plant(bags, sources, runs)
    if states or controls:
        ask_for(sources, states, controls, str(bags[0].path))
    commands, measured = assign_roles(sources)
    sources += [s for s in commands if not any(s is other for other in sources)]  # columns of a table
    moving = {(c.topic, c.path): c for s in sources for c in s.free}
    if not measured:
        reasons = "; ".join(f"{s.topic}: {s.reason or 'a command by its name'}" for s in sources[:8])
        raise BagError(f"{bags[0].path}: nothing in it looks like the state of a machine ({reasons or 'no topics'})")
    chosen, doubt = choose(measured, commands, like)
    doubt = doubt or ("" if commands else at_rest(sources))
    used = [c for s in commands for c in s.free]
    if like and {c.element for c in [*chosen, *used]} != {like}:
        there = dict.fromkeys(c.element for s in sources for c in s.candidates if c.element)
        raise BagError(
            f"{bags[0].path}: no state and command of a member '{like}'{meant(like, there)}; members that have a name: "
            f"{shortlist(list(there), 20) or 'none'}"
        )
    ready = [c for s in sources for c in s.candidates if c.ready]
    further = ([c for c in ready if c.ready == kind] for kind in ("state", "control"))
    name_signals(*([*some, *more] for some, more in zip((chosen, used), further, strict=True)))
    set_operating_point(chosen, used, sources)
    for candidate in ready:
        set_own_scale(candidate)
    warnings = (*(warning for bag in bags for warning in bag.warnings), *([doubt] if doubt else []))
    for topic in (s.topic for s in sources if s.role == "control"):
        lacking = [str(bag.path) for bag in bags if topic not in bag.topics or not bag.topics[topic].count]
        if 0 < len(lacking) < len(bags):
            without = f"{topic} looks like a command and is not in {shortlist(lacking, 3)}"
            warnings = (*warnings, f"{without}, so it is no control; leave those recordings out")
    members = _members(chosen, used, moving)
    try:
        memories = _memories(chosen, used, sources)
    except ModuleNotFoundError as error:  # all but this needs no solver
        memories, warnings = [], (*warnings, f"what lies further back was not tried: {absent(error.name) or error}")
    text = signals_file(bags, sources, chosen, used, doubt, memories, members, runs)
    return Proposal(tuple(chosen), tuple(used), text, warnings, tuple(members))


def _of_plant(bags: Sequence[Recording], sources: Sequence[Source], runs: str) -> Proposal:
    """The proposal for process data; names are those of the columns."""
    chosen, used = plant_signals(sources)
    if not chosen:
        raise BagError(f"{bags[0].path}: no column moves but commands and labels; record what is measured as well")
    text = signals_file(bags, sources, chosen, used, "", runs=runs, plant=True)
    return Proposal(tuple(chosen), tuple(used), text, tuple(warning for bag in bags for warning in bag.warnings))


def _members(
    states: Sequence[Candidate], controls: Sequence[Candidate], moving: Mapping[tuple[str, str], Candidate]
) -> dict[str, list[Candidate]]:
    """Members in which every number moves that is proposed of one, with these numbers; empty if there is one only."""
    group = [*states, *controls]
    one = {c.element for c in group}
    if len(one) != 1 or "" in one or not controls:
        return {}
    (like,) = one
    found = {}
    for member in dict.fromkeys(c.element for c in moving.values() if c.element):
        alike = [moving.get((c.topic, c.path.replace(f"[{like}]", f"[{member}]"))) for c in group]
        if None not in alike:
            found[member] = [c for c in alike if c is not None]
    return found if len(found) > 1 else {}


def _memories(states: Sequence[Candidate], controls: Sequence[Candidate], sources: Sequence[Source]) -> list[str]:
    """Lines of what narrows the envelope of the proposed states on left-out data."""
    group, clock = [*states, *controls], clock_of(states, sources)
    names, n, transients = [c.name for c in group], len(states), []
    for number, z in enumerate(columns_of(states, controls, sources)):
        if len(z) < FEWEST:
            continue
        z = np.column_stack([earlier(column, c.delay) for column, c in zip(z.T, group, strict=True)])
        z = (z - [c.steady for c in group]) / [c.scale or 1.0 for c in group]
        t, _ = clock.instants(clock, number)
        with suppress(TransientError):
            transients.append(Transient(t, z[:, :n], z[:, n:], state_names=names[:n], control_names=names[n:]))
    if not transients:
        return []
    chosen, width = choose_memories(transients, "noise")
    gain = f"with it, mean width x {width:.2g} on left-out data"
    lines = ["  # known before the step, so without a row of its own and without a verdict"] if chosen else []
    for one in chosen:
        of = group[names.index(one.of)]
        memory = one.memory if not of.delay else Memory("lag", of.delay + one.memory.samples)
        lag, rate = memory.kind == "lag", memory.kind == "rate"
        recalled = replace(of, name=one.name, path=memory.of(of.path), steady=of.steady if lag else 0.0, delay=0)
        recalled.unit += "/s" if of.unit and rate else ""
        lines.append(entry(recalled, comment=gain))
    return lines
