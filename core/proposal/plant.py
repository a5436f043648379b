# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Plant: the states and controls of process data, a table of a row per second or slower."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.proposal.candidates import FEWEST, Candidate, Source
from uncertain_lti.proposal.choosing import drop_copies
from uncertain_lti.proposal.roles import role_of_column
from uncertain_lti.proposal.signals_file import set_own_scale
from uncertain_lti.recordings.table import TYPE

FASTEST = 1.05
"""Rows per second up to which a table is of a plant: most of its sensors answer within a row, and all are judged."""
MOST_VALUES = 8
"""Values of a command that is switched, at most."""
TOLD = 0.9
"""Share of a measurement that the controls of the same row tell from which on it answers within a row."""
HELD = 0.8
"""Share of an analyser's changes that come after the same number of rows, two or more."""
GATED = 0.99
"""Share of the rows in which a flow is 0 when, and only when, its pump or valve is off."""
_LABEL = re.compile(r"(anomaly|anomalous|attack|att_?flag|fault|label|^class$|change_?point|ground_?truth|is_?normal)")
_TURNED = re.compile(r"(^|_)(x?mv|valve|pump|damper|vfd|setpoint|sp|op)(_|\d|$)")


def is_plant(sources: Sequence[Source]) -> bool:
    """Whether recordings are tables of a row per second or slower."""
    there = [s for s in sources if s.candidates]
    return bool(there) and all(s.type == TYPE and s.rate <= FASTEST for s in there)


def plant_signals(sources: Sequence[Source]) -> tuple[list[Candidate], list[Candidate]]:
    """States and controls, each with `why`; reasons go to what is left out.

    What is measured is a state, also where it is mostly noise from row to row: its level is judged. What is switched,
    set, or flows only while something is switched on is a control.
    """
    every = [c for s in sources for c in s.candidates if c.values]
    for candidate in every:
        candidate.reason = _unfit(candidate)
    drop_copies([c for c in every if not c.reason and np.ptp(_finite(c)) > 0])
    free = [c for c in every if not c.reason]
    controls = [c for c in free if _is_set(c)]
    switches = [c for c in controls if c.why.startswith("switched")]
    for candidate in free:
        on = next((s for s in switches if _gated(candidate, s)), None) if candidate not in controls else None
        if on is not None:
            candidate.why = f"0 whenever {on.path} is off"
            controls.append(candidate)
    stems = [_stem(c) for c in controls if not c.why.startswith("always")]
    for candidate in free:  # alike signals go together
        if candidate not in controls and stems.count(_stem(candidate)) > 1:
            candidate.why = f"one of the {_stem(candidate)}*, of which the others are controls"
            controls.append(candidate)
    for candidate in free:
        if candidate not in controls and (rows := _held_for(candidate)):
            candidate.reason, candidate.ready = f"an analyser: holds each value for {rows} rows", "state"
    known = [c for c in controls if not c.judged]
    for candidate in free:
        if candidate not in controls and not candidate.reason and (share := _told(candidate, known)) >= TOLD:
            candidate.reason = f"answers within a row: the controls of the same row tell {share:.0%} of it"
            candidate.ready = "state"
    states = [c for c in free if c not in controls and not c.reason]
    for candidate in states:
        told = _known(candidate)
        candidate.why = f"one row tells {told:.0%} of the next" if told > 0.5 else "mostly noise from row to row"
    for source in sources:
        source.reason = ""
    for candidate in free:
        set_own_scale(candidate)
        candidate.name, candidate.scale = candidate.path, candidate.scale or 1.0
    return states, [c for c in free if any(c is one for one in controls)]


def _finite(candidate: Candidate) -> Array:
    values = np.concatenate(candidate.values)
    return np.asarray(values[np.isfinite(values)])


def _unfit(candidate: Candidate) -> str:
    """Why a column is no signal at all; what hardly moves is one."""
    if _LABEL.search(candidate.path.lower()):
        return "a label by its name, and no signal of the plant"
    reason = candidate.reason
    return "" if re.match(r"always|leaves its usual|takes two", reason) else reason


def _is_set(candidate: Candidate) -> bool:
    """Whether a column is a control by its values or its name; says why."""
    values = np.unique(_finite(candidate))
    by_name = role_of_column(candidate.path) in ("control", "reference") or _TURNED.search(candidate.path.lower())
    if len(values) == 1:
        candidate.why = (
            f"always {values[0] + 0.0:.6g} here, so its effect is unknown; a move is outside what was fitted"
        )
    elif len(values) <= 2 or (len(values) <= MOST_VALUES and (values == np.rint(values)).all()):
        candidate.why = f"switched between {', '.join(f'{v + 0.0:.6g}' for v in values)}"
    elif by_name:
        candidate.why, candidate.judged = "set by a controller or a person, by its name; judged as well", True
    else:
        return False
    return True


def _gated(candidate: Candidate, switch: Candidate) -> bool:
    """Whether a column is 0 when a switch is at its least value, and nearly only then."""
    for values, on in zip(candidate.values, switch.values, strict=True):
        off = on == np.nanmin(np.concatenate(switch.values))
        if np.mean((values == 0) == off) < GATED or not (values[off] == 0).any():
            return False
    return True


def _stem(candidate: Candidate) -> str:
    return re.sub(r"\d.*$", "", candidate.path)


def _held_for(candidate: Candidate) -> int:
    """Rows for which nearly every value is held; 0 where it is not."""
    gaps = np.concatenate([np.diff(np.flatnonzero(np.diff(v) != 0)) for v in candidate.values])
    if len(gaps) < FEWEST:
        return 0
    counts = np.bincount(gaps)
    rows = int(np.argmax(counts))
    return rows if rows > 1 and counts[rows] >= HELD * len(gaps) else 0


def _told(candidate: Candidate, controls: Sequence[Candidate]) -> float:
    """Share of the variance that a linear function of the controls of the same row tells."""
    y, U = np.concatenate(candidate.values), np.column_stack([np.concatenate(c.values) for c in [candidate, *controls]])
    good = np.isfinite(U).all(axis=1)
    y, U = y[good], np.column_stack([U[good, 1:], np.ones(good.sum())])
    if len(y) < FEWEST * U.shape[1] or y.var() == 0:
        return 0.0
    return 1.0 - float((y - U @ np.linalg.lstsq(U, y, rcond=None)[0]).var() / y.var())


def _known(candidate: Candidate) -> float:
    """Share of the variance of the next row that one row tells."""
    pairs = [(v[:-1], v[1:]) for v in candidate.values]
    now, after = (np.concatenate(side) for side in zip(*pairs, strict=True))
    good = np.isfinite(now) & np.isfinite(after)
    if good.sum() < 3 or np.ptp(now[good]) == 0 or np.ptp(after[good]) == 0:
        return 0.0
    return float(np.corrcoef(now[good], after[good])[0, 1]) ** 2
