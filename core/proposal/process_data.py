# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Process data: which columns of tables are states, controls, runs, or words; all that is measured is judged."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.identification.evidence import FASTEST, held_for
from uncertain_lti.proposal.candidates import (
    FEWEST,
    READ,
    SHOWS,
    TWO_VALUES,
    Candidate,
    Source,
    Steps,
    is_label,
    steps_of,
)
from uncertain_lti.proposal.choosing import drop_copies
from uncertain_lti.proposal.signals_file import set_own_scale
from uncertain_lti.recordings.recording import Recording
from uncertain_lti.recordings.table import Table, names_signals
from uncertain_lti.recordings.table_text import field_name
from uncertain_lti.recordings.table_times import may_be
from uncertain_lti.signals.field_path import FieldPath
from uncertain_lti.signals.values import TABLE

MOST_VALUES = 8
"""Values of a command that is switched, at most."""
TOLD = 0.9
"""Share of a measurement that the controls of the same row tell from which on it answers within a row."""
LASTS = 0.5
"""Share of what they do not tell that the row before tells, from which on it has a memory of its own."""
RARE = 0.05
"""Share of the rows in which a set point changes, up to which nothing before tells of its changes."""
ALWAYS, WEATHER = "always ", "the weather, by its name, which is no fault of the machine"
"""Why a column is a control that nobody sets."""
_BY_NAME = "set by a controller or a person, by its name; "
HELD = 0.8
"""Share of an analyser's changes that come after the same number of rows, two or more."""
GATED = 0.99
"""Share of the rows in which a flow is 0 when, and only when, its pump or valve is off."""
_WEATHER = re.compile(r"(^|_)(outdoor|outside|ambient|wea(ther|bus_|sta_))(?!.*(coil|damper|fan|flow|pump|unit|valve))")
_TURNED = re.compile(r"(^|_)(x?mv|valve|pump|damper|vfd|setpoint|sp|op)(_|\d|$)")

_RUN = re.compile(
    r"(^|_)(run|trial|episode|experiment|exp|test|group|session|rollout|flight|lap|trajectory|traj|unit)s?"
    r"(_?(id|no|nr|num|number|index|idx))?$"
)  # name of a column that says which run a row is of
MOST_WORDS, _SWITCHED = 8, 0.1
"""Words of a column that is switched, and share of the rows in which it is, at most."""


def run_column(bags: Sequence[Recording]) -> str:
    """Column of tables that tells the runs in one file apart."""
    tables = [bag for bag in bags if isinstance(bag, Table)]
    names = tables[0].columns_by_field if tables and len(tables) == len(bags) else ()
    told = dict.fromkeys(names, math.inf)
    for table in tables:
        if not told:  # and the next one need not be opened
            break
        told = {name: least for name, most in told.items() if (least := min(most, _runs_told(table, name)))}
    # of a repetition of a load at a speed, the repetition
    return max(told, key=lambda name: (_RUN.search(name.lower()) is not None, told[name]), default="")


def in_words(bags: Sequence[Recording], runs: str | None) -> dict[str, list[str]]:
    """Columns of tables in which a few words change in most recordings, as of a status; the words, the usual first."""
    found: dict[str, list[Counter[str]]] = {}
    for table in (bag for bag in bags if isinstance(bag, Table)):
        for name, column in table.columns_by_field.items():
            rarely = column.dtype.kind == "O" and np.count_nonzero(column[1:] != column[:-1]) <= _SWITCHED * len(column)
            if rarely and name != runs and not is_label(name) and not may_be(column):
                found.setdefault(name, []).append(Counter(cell for row in column if (cell := str(row or "").strip())))
    words = {name: [word for word, _ in sum(each, Counter()).most_common()] for name, each in found.items()}
    changing = (name for name, each in found.items() if 2 * sum(len(of) > 1 for of in each) >= len(bags))
    return {name: words[name] for name in changing if len(words[name]) <= MOST_WORDS}


def _runs_told(table: Table, name: str) -> int:
    column = table.columns_by_field.get(name)
    if column is None or column.ndim != 1 or column.dtype.kind == "M" or len(column) < 2 * FEWEST:
        return 0
    if column.dtype.kind == "f" and not (column == np.rint(column)).all():
        return 0
    changes = 1 + np.flatnonzero(column[1:] != column[:-1])
    runs = len(changes) + 1
    if not 2 <= runs <= len(column) // FEWEST or len(set(column[[0, *changes]].tolist())) < runs:
        return 0
    of_signals = names_signals(name) and not all(topic.readable for topic in table.topics.values())
    anew = not of_signals and (np.diff(table.times)[changes - 1] < 0).all()
    return runs if _RUN.search(name.lower()) or anew else 0


def is_plant(sources: Sequence[Source]) -> bool:
    """Whether recordings are tables of a row per second or slower."""
    there = [s for s in sources if s.candidates]
    return bool(there) and all(s.type == TABLE and s.rate <= FASTEST for s in there)


def plant_signals(sources: Sequence[Source]) -> tuple[list[Candidate], list[Candidate]]:
    """States and controls, each with `why`; reasons go to what is left out.

    What is measured is a state, also where it is mostly noise from row to row: its level is judged. What is switched,
    set, or flows only while something is switched on is a control.
    """
    every = [c for s in sources for c in s.candidates if c.values]
    for candidate in every:
        if re.match(rf"{ALWAYS}|leaves its usual|{TWO_VALUES}", candidate.reason):  # what hardly moves is a signal, too
            candidate.reason = ""
    moving = [c for c in every if not c.reason and np.ptp(c.finite) > 0]
    two_valued = [c for c in moving if len(np.unique(c.finite)) == 2]
    for alike in (two_valued, [c for c in moving if c not in two_valued]):  # a power is no copy of what switches it
        drop_copies(alike, exact=True)
    free = [c for c in every if not c.reason]
    controls = [c for c in free if _is_set(c, c.source.role in ("control", "reference"))]
    switches = [c for c in controls if c.why.startswith("switched")]
    for candidate in free:
        on = next((s for s in switches if _gated(candidate, s)), None) if candidate not in controls else None
        if on is not None:
            candidate.why = f"0 whenever {on.path} is off"
            controls.append(candidate)
    stem = {c: re.sub(r"\d+", "*", c.path) for c in free}  # of `F_PU1` and `F_PU2`, and not of one unit's
    stems = [stem[c] for c in controls if not c.why.startswith(ALWAYS)]
    alike = [c for c in free if c not in controls and stems.count(stem[c]) > 1]
    for candidate in alike if len(controls) + len(alike) < len(free) else ():  # they go together, unless none is left
        candidate.why = f"one of the {stem[candidate]}, of which the others are controls"
        controls.append(candidate)
    controls += _set_or_analysed([c for c in free if c not in controls])
    known = [c for c in controls if not c.judged]
    for candidate in free:
        if candidate not in controls and not candidate.reason and (share := _told(candidate, known)) >= TOLD:
            candidate.reason = f"answers within a row: the controls of the same row tell {share:.0%} of it"
            candidate.ready = "state"
    for candidate in (c for c in controls if c.judged):
        now, after = _in_turn(candidate)
        if (moves := np.mean(now != after)) <= RARE or held_for(now, after):
            candidate.judged = False
            candidate.why = f"{_BY_NAME}not judged, as it changes in {moves:.1%} of the rows only"
    states = [c for c in free if c not in controls and not c.reason]
    for candidate in states:
        told = _known(candidate)
        candidate.why = f"one row tells {told:.0%} of the next" if told > 0.5 else "mostly noise from row to row"
    for source in sources:
        source.reason = ""
    for candidate in free:
        set_own_scale(candidate)
        candidate.name, candidate.scale = field_name(FieldPath(candidate.path).angle), candidate.scale or 1.0
        candidate.steady = 0.0  # what returns to its median would alarm on every change of load
    return states, [c for c in free if c in controls]


def _is_set(candidate: Candidate, called: bool) -> bool:
    """Whether a column is a control by its values or its name, or is `called` one; says why."""
    values = np.unique(candidate.finite)
    few = MOST_VALUES if (values == np.rint(values)).all() else 2
    by_name = called or _TURNED.search(candidate.path.removesuffix("_mV").lower())  # no manipulated variable
    if len(values) == 1:
        candidate.why = (
            f"{ALWAYS}{values[0] + 0.0:.6g} here, so its effect is unknown; a move is outside what was fitted"
        )
    elif len(values) <= (few if by_name or not READ.search(candidate.path.lower()) else 2) and not candidate.flickers:
        candidate.why = f"switched between {', '.join(f'{v + 0.0:.6g}' for v in values)}"
    elif _WEATHER.search(candidate.path.lower()):
        candidate.why = WEATHER
    elif by_name:
        candidate.why, candidate.judged = f"{_BY_NAME}judged as well", True
    else:
        return False
    return True


def _gated(candidate: Candidate, switch: Candidate) -> bool:
    """Whether a column is 0 when a switch is at its least value, and nearly only then."""
    for values, on in zip(candidate.values, switch.values, strict=True):
        off = on == np.nanmin(np.concatenate(switch.values))
        if np.mean((values == 0) == off) < GATED or np.count_nonzero(values[off] == 0) < FEWEST:
            return False
    return True


def _held_for(candidate: Candidate) -> int:
    """Rows for which nearly every value is held; 0 where it is not."""
    gaps = np.concatenate([np.diff(np.flatnonzero(np.diff(v) != 0)) for v in candidate.values])
    if len(gaps) < FEWEST:
        return 0
    counts = np.bincount(gaps)
    rows = int(np.argmax(counts))
    return rows if rows > 1 and counts[rows] >= HELD * len(gaps) else 0


def _set_or_analysed(measured: Sequence[Candidate]) -> list[Candidate]:
    """Of columns that hold each value for some rows those that are set; the others, which an analyser holds, go.

    A set value shows in the next rows, and nothing tells it before; of columns that hold as long most decide for all.
    """
    held = {c: rows for c in measured if (rows := _held_for(c))}
    rest, found = [c for c in measured if c not in held and np.ptp(c.finite) > 0], []
    for rows in dict.fromkeys(held.values()) if rest else ():
        group = [c for c in held if held[c] == rows]
        leads = steps_of(rest, group).effects()[1:].max(axis=1, initial=0.0) > SHOWS
        for j, candidate in enumerate(group):
            before = steps_of([candidate], rest)
            set_at = before.dX[:, 0] != 0
            leads[j] &= Steps(before.X[set_at], before.U[set_at], before.dX[set_at]).effects()[0, 0] <= SHOWS
        found += group if 2 * leads.sum() > len(group) else []
    for candidate, rows in held.items():
        candidate.why = f"set, for {rows} rows each: the others follow it"
        if candidate not in found:
            candidate.reason, candidate.ready = f"an analyser: holds each value for {rows} rows", "state"
    return found


def _told(candidate: Candidate, controls: Sequence[Candidate]) -> float:
    """Share of the variance that a linear function of the controls of the same row tells; 0 if the rest lasts."""
    columns = np.column_stack([np.concatenate(c.values) for c in [candidate, *controls]])
    columns = columns[np.isfinite(columns).all(axis=1)]
    y, U = columns[:, 0], np.column_stack([columns[:, 1:], np.ones(len(columns))])
    if len(y) < FEWEST * U.shape[1] or y.var() == 0:
        return 0.0
    rest = y - U @ np.linalg.lstsq(U, y, rcond=None)[0]
    lasts = rest.std() > 1e-9 * y.std() and float(np.corrcoef(rest[1:], rest[:-1])[0, 1]) ** 2 >= LASTS
    return 0.0 if lasts else 1.0 - float(rest.var() / y.var())


def _known(candidate: Candidate) -> float:
    """Share of the variance of the next row that one row tells."""
    now, after = _in_turn(candidate)
    if len(now) < 3 or np.ptp(now) == 0 or np.ptp(after) == 0:
        return 0.0
    return float(np.corrcoef(now, after)[0, 1]) ** 2


def _in_turn(candidate: Candidate) -> Array:
    """Numbers of rows, and of the next ones (2, N), where both have one."""
    pairs = np.hstack([np.stack([v[:-1], v[1:]]) for v in candidate.values])
    return np.asarray(pairs[:, np.isfinite(pairs).all(axis=0)])
