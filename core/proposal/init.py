"""Proposal: a signals file suggested from what a recording holds, for a person to edit."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from uncertain_lti.base.errors import BagError
from uncertain_lti.proposal.candidates import Candidate
from uncertain_lti.proposal.choosing import choose
from uncertain_lti.proposal.naming import name_signals
from uncertain_lti.proposal.quantities import set_operating_point, set_own_scale
from uncertain_lti.proposal.reading import Iterate, read_sources
from uncertain_lti.proposal.roles import assign_roles
from uncertain_lti.proposal.signals_file import signals_file
from uncertain_lti.recordings.formats import group_recordings


@dataclass(frozen=True)
class Proposal:
    """States and controls of a machine, as far as a recording tells.

    Parameters
    ----------
    states : tuple of Candidate
        Proposed states.
    controls : tuple of Candidate
        Proposed controls.
    text : str
        The signals file, with its reasons.
    warnings : tuple of str, optional
        What the reader should know, a sentence each.
    """

    states: tuple[Candidate, ...]
    controls: tuple[Candidate, ...]
    text: str
    warnings: tuple[str, ...] = ()


def propose(paths: Sequence[str | os.PathLike[str]], progress: Iterate | None = None) -> Proposal:
    """Suggest states and controls of a machine from recordings of it.

    Topics are classified by their names and types, and if these say nothing by what helps to predict what; of a
    topic's numbers those are proposed that move, and in whose next step the controls show, or which help to predict
    such ones. Everything else is listed in comments with the reason.

    Parameters
    ----------
    paths : sequence of path
        As for `read_transients`.
    progress : callable, optional
        As for `read_transients`.

    Returns
    -------
    Proposal
        With the text of the file.

    Raises
    ------
    BagError
        A recording cannot be read, or holds nothing that could be a state.
    """
    bags = group_recordings(list(paths))
    if not bags:
        raise BagError("no recording is named; give at least one file or folder")
    sources = read_sources(bags, progress)
    controls, states = assign_roles(sources)
    if not states:
        reasons = "; ".join(f"{s.topic}: {s.reason or 'a command by its name'}" for s in sources[:8])
        raise BagError(f"{bags[0].path}: nothing in it looks like the state of a machine ({reasons or 'no topics'})")
    chosen, doubt = choose(states, controls)
    used = [c for s in controls for c in s.free]
    ready = [c for s in sources for c in s.candidates if c.ready]
    name_signals(
        [*chosen, *(c for c in ready if c.ready == "state")], [*used, *(c for c in ready if c.ready == "control")]
    )
    set_operating_point(chosen, used, sources)
    for candidate in ready:
        set_own_scale(candidate)
    warnings = (*(warning for bag in bags for warning in bag.warnings), *([doubt] if doubt else []))
    return Proposal(tuple(chosen), tuple(used), signals_file(bags, sources, chosen, used, doubt), warnings)


__all__: list[Any] = ["Candidate", "Proposal", "propose"]
