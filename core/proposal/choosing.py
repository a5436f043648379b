# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Choosing: states and controls, as many as the recordings carry."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from itertools import permutations
from typing import Any

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.identification.evidence import (
    LONGEST_DELAY,
    NOISE,
    computed,
    from_both_ends,
    functions,
    lags,
    predicted,
    size_of,
    two_sensors,
)
from uncertain_lti.proposal.candidates import (
    FAINT,
    FEWEST,
    OF_QUATERNION,
    SHOWS,
    Candidate,
    Source,
    Steps,
    clock_of,
    explained,
    is_measured,
    is_physical,
    most_shown,
    steps_of,
)
from uncertain_lti.proposal.members import SHORT_DELAY, one_of_them, pair_entries
from uncertain_lti.signals.values import TABLE, of_table


def drop_functions(steps: Steps, pool: list[Candidate]) -> list[Candidate]:
    """Drop candidates that are functions of another one, or sums of several of another topic: odometry, of wheels.

    A function, be it a copy or a square, leaves next to nothing of a candidate, or nothing but noise. Of two that are
    functions of each other, the one in which the controls show clearly more stays, else the first. Two sensors of one
    quantity both stay, where each has noise of its own: a fault of one, or a slipping wheel, parts them.
    """
    if len(steps.X) < FEWEST:
        return pool
    kept: list[int] = []
    function = functions(steps.X)
    np.fill_diagonal(function, False)
    for i, j in np.argwhere(function).tolist():
        if _alike(pool[i], pool[j]) or two_sensors(*steps.X[:, [i, j]].T):
            function[i, j] = pool[i].topic == pool[j].topic and _moves_with(pool[j], pool[i], exact=True)
    sums = computed(steps.dX, [c.topic for c in pool], function)
    for i, topic in sums.items():
        pool[i].reason = f"says what {topic} says already, several of its signals together"

    def drop(i: int, source: int) -> None:
        of = pool[source]
        place = of.path if of.topic == pool[i].topic else f"{of.topic} {of.path}"
        pool[i].reason = f"says what {place} says already"

    ranked = np.argsort(-np.log(np.maximum(steps.effects()[0], 1.0)).round(1), kind="stable").tolist()
    for i in (i for i in ranked if i not in sums):
        if (source := next((j for j in kept if function[j, i]), None)) is not None:
            drop(i, source)
            continue
        for j in [j for j in kept if function[i, j]]:  # x stays, its square goes
            kept.remove(j)
            drop(j, i)
        kept.append(i)
    return [pool[i] for i in sorted(kept)]


_BURSTS = 5  # times the range of nearly all samples that of all is, from which on rare bursts hide the level of noise


def drop_noise(pool: list[Candidate], used: Sequence[Candidate]) -> tuple[list[Candidate], str]:
    """Drop candidates that are noise from sample to sample, unless all are.

    What the controls show in stays where another of its family does: all axes of a body turn by the same law.
    """
    late = [*used] * (SHORT_DELAY + 1)
    steps = steps_of(pool, late, [lag for lag in range(SHORT_DELAY + 1) for _ in used])
    if len(steps.X) < max(FEWEST, 2 * (len(pool) + len(late))):
        return pool, ""
    share = predicted(steps.X, steps.U, steps.X + steps.dX)
    if not (share >= NOISE).any():
        return pool, (
            "nothing here is more than noise from one sample to the next: record the machine at work before you "
            "fit a model"
        )
    shown = steps_of(pool, used).effects()[0] > SHOWS
    families = {c.family for c, known in zip(pool, share, strict=True) if known >= NOISE}
    for candidate, known, seen in zip(pool, share, shown, strict=True):
        if known < NOISE and not (seen and candidate.family in families):
            candidate.ready, told = "state", f"{max(0.0, known):.0%}"
            candidate.reason = f"noise: one sample predicts {told} of the variance at the next, controls included"
    return [c for c in pool if not c.reason], ""


_SET_NOW_AND_THEN = 0.01  # of the steps, in which a command changes at most that shows faintly by chance


def drop_idle_controls(steps: Steps, used: Sequence[Candidate], shows: Array) -> None:
    """Leave out controls that show nowhere given the others, and those that move with another one; `shows` (m,)."""
    if len(steps.X) < FEWEST or len(used) < 2:
        return
    with np.errstate(invalid="ignore", divide="ignore"):
        alike = np.abs(np.corrcoef(steps.U.T)) > 0.99
    held = np.mean(np.diff(steps.U, axis=0) != 0, axis=0) < _SET_NOW_AND_THEN
    faint = np.where(held & (shows.max() > STEERS * SHOWS), SHOWS, FAINT)
    for j, candidate in enumerate(used):
        twin = next((i for i in range(j) if alike[i, j] and not used[i].reason), None)
        if not np.ptp(steps.U[:, j]) > 0:
            candidate.reason = "does not move while the states are there"
        elif twin is not None:
            candidate.reason, candidate.ready = f"moves with {used[twin].topic} {used[twin].path}", "control"
        elif shows[j] < faint[j] and shows.max() > SHOWS:
            candidate.reason, candidate.ready = "shows in the next step of none of the states", "control"


_ACCELERATION = "an acceleration answers within a step; add it if it has a memory of its own"
_EFFORT = "an effort answers within a step; taken in, it shows friction and load, which a position loop hides"
_BESIDE = (
    (r"twist\.", r"pose\.", "a pose in a fixed frame; its rate of change is the twist beside it"),
    (r"angular_velocity\.|\(orientation\)", r"linear_acceleration\.", _ACCELERATION),
    (r"^velocity\[.*wheel", r"^position\[(?!.*steer).*wheel", "grows with the way; its rate of change is beside it"),
    (r"^(position|velocity)\[", r"^effort\[", _EFFORT),
)
"""What is left out beside what, and why: of pose and twist the pose, of a wheel the angle, of a joint the effort."""


def prefer_rates(source: Source) -> None:
    """Leave out what says less than what is beside it in the same topic."""
    moves = [c.path for c in source.free]
    for there, left, reason in _BESIDE:
        if any(re.search(there, path) for path in moves):
            for candidate in (c for c in source.free if re.search(left, c.path)):
                candidate.reason, candidate.ready = reason, "state" * (reason == _EFFORT)


_ROWS, _NEARLY = 1 << 14, 0.999  # of which correlations are taken at once; correlation from which on to look closer


def drop_copies(pool: Sequence[Candidate], exact: bool = False) -> list[Candidate]:
    """Leave out what moves as another candidate of the same topic does; returns the rest.

    `exact`: only what is another one but for scale, offset and the last digits: of two sensors that move together, each
    shows the faults of the other.
    """
    kept, may = list[Candidate](), _may_move_with(pool)
    for candidate in pool:
        near = (c for c in kept if (id(c), id(candidate)) in may)
        if twin := next((c for c in near if _moves_with(candidate, c, exact or _each_its_own(candidate, c))), None):
            candidate.reason = f"moves with {twin.path}"
        else:
            kept.append(candidate)
    return [c for c in kept if not c.reason]


def _may_move_with(pool: Sequence[Candidate]) -> set[tuple[int, int]]:
    """Pairs of which `_moves_with` may hold, each the one before the other: all correlations of a topic at once."""
    may: set[tuple[int, int]] = set()
    of_topic: dict[tuple[str, int], list[Candidate]] = {}
    for candidate in pool:
        of_topic.setdefault((candidate.topic, sum(map(len, candidate.values))), []).append(candidate)
    for (_, rows), group in of_topic.items():
        n = len(group)
        columns = [np.concatenate(c.values) for c in group] if n > 1 else []
        known = [column[np.isfinite(column)] for column in columns]
        middle = np.array([k.mean() if len(k) else 0.0 for k in known])
        spread = np.array([max(float(k.std()), 1e-300) if len(k) else 1.0 for k in known])
        del known
        both, s, ss, st = np.zeros((4, n, n))  # of the rows that two have: number, and sums of z, z z and z z'
        for begin in range(0, rows if columns else 0, _ROWS):
            z = (np.column_stack([c[begin : begin + _ROWS] for c in columns]) - middle) / spread
            there = np.isfinite(z).astype(np.float64)
            z = np.where(there > 0, z, 0.0)
            both += there.T @ there
            s += z.T @ there
            ss += (z**2).T @ there
            st += z.T @ z
        own = np.maximum(both * ss - s**2, 0.0)
        together = (both * st - s * s.T) ** 2 >= _NEARLY**2 * own * own.T
        may |= {(id(group[i]), id(group[j])) for i, j in zip(*np.nonzero(np.triu(together, 1)), strict=True)}
    return may


def _alike(one: Candidate, other: Candidate) -> bool:
    """Whether names of columns differ in their digits alone, as of parts that do the same: each may fail alone."""
    names = {re.sub(r"\d+", "#", c.path) for c in (one, other)}
    given = "[" not in one.path and names != {"column_#"}  # by who wrote the file, and not by its reader
    return one.topic == other.topic and of_table(one.topic) and len(names) == 1 and given


def _each_its_own(one: Candidate, other: Candidate) -> bool:
    """Whether two numbers of a topic are of parts that do the same, or each has a sensor with noise of its own."""
    a, b = _together(one, other)
    moving = len(a) >= FEWEST and min(np.ptp(a), np.ptp(b)) > 0
    return _alike(one, other) or bool(moving and two_sensors(a, b))


def _together(one: Candidate, other: Candidate) -> tuple[Array, Array]:
    a, b = np.concatenate(one.values), np.concatenate(other.values)
    both = np.isfinite(a) & np.isfinite(b)
    return a[both], b[both]


def _moves_with(one: Candidate, other: Candidate, exact: bool = False) -> bool:
    a, b = _together(one, other)
    if len(a) <= 2 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return False
    if not exact:
        return bool(abs(np.corrcoef(a, b)[0, 1]) > 0.9999)
    slope, offset = np.polyfit(b, a, 1)
    last_digits = np.diff(np.unique(a)).min() + abs(slope) * np.diff(np.unique(b)).min()
    # parts that do the same would be equal if they were copies in one unit, and what follows a set point is none
    last_digits *= one.source.role == other.source.role and not (_alike(one, other) and abs(slope - 1.0) < 0.05)
    return bool(np.abs(a - slope * b - offset).max() <= last_digits + 1e-9 * np.ptp(a))


ALIKE = 0.8
"""Rate of a topic, relative to that of the fastest, from which on both may give states of one model."""
SLOWER = 10.0  # times the rate of a topic that of the fastest is at most, where both give states of one model
BLURRED = 2.0
"""Times the variance that one sample leaves unknown of the next at their own rate that is left at a slower one, from
which on the numbers of a topic move in between."""
STILL = 1e-4
"""Likewise, from which on more of it counts: of a heading that goes round and round next to nothing is unknown."""
LOST = 0.01
"""Share of the variance that one sample may leave unknown of the next for the sake of a control that shows in a slower
topic alone."""
STEERS = 100.0
"""F statistic of one control alone from which on it counts as turning an axis of a body."""
PER_UNKNOWN = 20  # transitions per signal below which further signals are only listed
MOST, EACH = 12, 1000  # states, and controls; or as many as there are so many transitions for each


class _Room:
    """How many signals of a kind are proposed at most, and the reason for leaving out more."""

    def __init__(self, N: int, carried: int, what: str) -> None:
        most = max(MOST, N // EACH)
        self.most = min(max(1, carried), most)
        many = f"others show more or are less alike; at most {most} {what} are tried together: exchange one if need be"
        self.reason = many if carried >= most else f"the recording is too short for more than {self.most} {what}"


_REACHED = re.compile(r"^(?!.*(cmd|command|set)).*_(position|pos|angle)(_(deg|rad|pct|percent|mm))?$")
"""Name of what an actuator has reached, where something else says what it is to reach."""
ONE_NUMBER = {f"std_msgs/msg/{kind}" for kind in ("Float32", "Float64", "Int16", "Int32", "Int64", "UInt16", "UInt32")}
"""Messages of one number, which only their topic names."""
_FOLLOWED = "trajectory_msgs/msg/JointTrajectory", "control_msgs/msg/JointTrajectoryControllerState"
FEWEST_SET, MOST_SET = 3, 0.2
"""A column without a name of a command may be one if it changes so often, and in at most this share of the rows."""


def _held_columns(table: Source) -> Source | None:
    """Columns of a table that are held, and set now and then, if they show in the next step of the others.

    What is measured by its name is none. They leave the table for a topic of their own, whose role is a guess.
    """
    if table.type != TABLE:
        return None
    changed = {c: np.concatenate([np.diff(v) != 0 for v in c.values]) for c in table.free}
    rarely = [c for c, rows in changed.items() if FEWEST_SET <= rows.sum() <= MOST_SET * len(rows)]
    held = [c for c in rarely if not is_measured(c.path)]
    rest = [c for c in table.free if c not in held]
    shows = held and rest and most_shown(rest, held) > SHOWS
    return table.parted(held, "guess") if shows else None


def _within_loops(
    controls: list[Source], states: list[Source], references: Sequence[Source]
) -> tuple[list[Source], list[Source]]:
    """Controls and states, where the loop that follows a reference is part of the machine.

    What an actuator has reached (`throttle_position`) is measured, where a reference or a command shows in it. A
    reference is a control where it shows most there, or clearly in what commands hardly move, and in no command.
    """
    every = [c for s in controls for c in s.free]
    named = [c for c in every if _REACHED.search(c.path if c.source.type == TABLE else c.topic)]
    sent = [c for c in every if c not in named]
    leads = [*sent, *(c for s in references for c in s.free)]
    led = {c: max([STEERS, *(most_shown([other], [c]) for other in sent)]) for c in named}
    reached = [c for c in named if most_shown([c], leads) > led[c]]
    parts = [s.parted(some, "state") for s in controls if (some := [c for c in reached if c in s.free])]
    controls, states = [s for s in controls if s.free], [*states, *parts]
    used = [c for s in controls for c in s.free]
    short = range(SHORT_DELAY + 1 if references else 0)
    unmoved = [s for s in states if short and not _driven(s.free, used, short)[0].max(initial=0.0) > SHOWS]
    moved = {c: max(STEERS, most_shown([c], sent)) for c in reached}
    own = [c for s in states if s.type == TABLE for c in s.free]  # columns, each for itself
    inner = [r for r in references if any(most_shown([c], r.free) > by for c, by in moved.items())]
    outer = [r for r in references if r not in inner and any(_shown(s, r) > SHOWS for s in controls)]
    inner += [r for r in references if r not in outer and any(explained(s, [r]) > STEERS for s in unmoved)]
    for r in (r for r in references if r not in [*outer, *inner]):
        inner += [r] * any((F := most_shown([c], r.free)) > STEERS and F > STEERS * most_shown([c], used) for c in own)
    return [*controls, *dict.fromkeys(inner)], states


def _nearest(controls: Sequence[Source]) -> list[Source]:
    """Commands less those of which another is made: a trajectory, or `cmd_vel_nav` where a smoother sends `cmd_vel`."""
    for one, other in permutations(controls, 2):
        made = (one.type, other.type) == _FOLLOWED and one.topic.rpartition("/")[0] == other.topic.rpartition("/")[0]
        alike = is_physical(one.type) and one.type.removesuffix("Stamped") == other.type.removesuffix("Stamped")
        if alike and (one.topic.startswith(other.topic) or other.topic.startswith(one.topic)):
            made = _shown(other, one) > max(SHOWS, _shown(one, other))
        if made:
            one.reason = f"{other.topic} is made of it, and nearer to the machine"
    return [s for s in controls if not s.reason]


def _shown(command: Source, reference: Source) -> float:
    """How clearly a reference shows in the next command, or in the one that comes with it."""
    steps = (steps_of(command.free, reference.free, [lag] * len(reference.free)) for lag in (0, -1))
    return max(float(np.max(some.effects()[0], initial=0.0)) for some in steps)


def assign_roles(
    sources: Sequence[Source], asked: bool = False, sent: bool = False
) -> tuple[list[Source], list[Source]]:
    """Which topics are controls, and which may be the state; `asked`, `sent`: a person says which, or the controls."""
    moving = [s for s in sources if s.free]
    controls = [s for s in moving if s.role == "control"]
    controls = controls if sent else _nearest(controls)
    references = [s for s in moving if s.role == "reference"]
    if not controls:
        controls, references = references, []
    states = [s for s in moving if s.role == "state"]
    unknown = unnamed = [s for s in moving if s.role == ""]
    if not asked:
        controls, states = _within_loops(controls, states, references)
    for source in references:
        if source not in controls:
            source.reason = "a reference for some controller, and there is a command"
    if controls and states and not asked:  # as a column of a table, which is measured unless its name says otherwise
        states += [s for s in unknown if s.type in ONE_NUMBER]
        unknown = [s for s in unknown if s not in states]
    if controls and states and unknown and not any(explained(s, controls) > SHOWS for s in states):
        states += [s for s in unknown if explained(s, controls) > SHOWS]
        unknown = [s for s in unknown if s not in states]
    if not states:
        states, unknown = unknown, []
    if not states and len(controls) > 1:  # commands everywhere by their names: the one that the others explain best
        best = max(controls, key=lambda s: explained(s, [c for c in controls if c is not s]))
        controls, states = [c for c in controls if c is not best], [best]
    if not controls and not any(s.role == "control" for s in sources) and len(states) + len(unknown) > 1:
        maybe = (s for s in unnamed if len(states) > 1 or s not in states)  # what is measured by its name is no command
        effects = {s: max((explained(o, [s]) for o in states if o is not s), default=0.0) for s in maybe}
        if effects and max(effects.values()) > SHOWS:
            by_effect = max(effects, key=effects.__getitem__)
            by_effect.role = "guess"
            controls, states = [by_effect], [s for s in states if s is not by_effect]
            unknown = [s for s in unknown if s is not by_effect]
    if not controls:
        controls = [held for source in states if (held := _held_columns(source)) is not None]
    for source in unknown:
        source.reason = "neither state nor control by its name or type"
        for candidate in source.free if controls and explained(source, controls) > SHOWS else ():
            candidate.reason, candidate.ready = f"{source.reason}, but the controls show in it", "state"
    return controls, states


def choose(
    states: Sequence[Source], controls: Sequence[Source], like: str = "", asked: bool = False, progress: Any = None
) -> tuple[list[Candidate], str]:
    """States of the model, and a sentence where they look like none; reasons go to what is left out.

    `asked`: a person named the topics of the states, which are of one model then whatever their rates.
    """
    for source in states:
        prefer_rates(source)
    used = [c for s in controls for c in s.free]
    shows = {s.topic: explained(s, controls) if controls else math.inf for s in states}
    shown = [s for s in states if shows[s.topic] > SHOWS] or list(states)
    fastest = max(s.rate for s in shown)
    slowest = min(s.rate for s in shown) if asked else _slowest(shown, used)
    main = max((s for s in shown if s.rate >= ALIKE * fastest), key=lambda s: (shows[s.topic], s.rate, s.count))
    pool = list(main.free)
    for source in (s for s in states if s is not main):
        at_its_rate = ALIKE * slowest <= source.rate <= fastest / ALIKE
        if source in shown and at_its_rate:
            pool += source.free
            continue
        source.reason = "the controls do not show in it"
        if source in shown:
            copied = all(any(np.isin(c.finite, o.finite).mean() > 0.9 for o in main.candidates) for c in source.free)
            slow = f"comes at {source.rate:.3g} Hz, and {main.topic} at {main.rate:.3g} Hz; see --states"
            source.reason = f"says what {main.topic} says already" if copied else slow
            source.apart = "slower than the states" * (not copied)
        if at_its_rate and is_physical(source.type):  # of the machine all the same: a person may want it
            for candidate in source.free:
                candidate.reason, candidate.ready = source.reason, "state"
    pool = drop_copies(pool)
    if not all(c.element for c in used):
        pair_entries(pool, used)
    pool, used = one_of_them(pool, used, like)
    used = drop_copies(used)
    before = drop_functions(steps_of(pool, used), pool)
    pool, doubt = drop_noise(before, used)
    noise = [c for c in before if c.reason and c.topic == main.topic and main.type == TABLE]  # measured, in a table
    N = len(steps_of(pool, used).X) * clock_of(pool).share  # of all
    room = max(2, N // PER_UNKNOWN)
    used = _strongest(_driven(pool, used, [0]), used, _Room(N, room // 2, "controls"))
    states_room, every = _Room(N, room - len(used), "states"), range(LONGEST_DELAY + 1)
    driven = _driven(pool, used, progress(every, len(every)) if progress else every)
    if N < FEWEST:
        keep = pool[:MOST]
    elif all(re.search(rf"position\.[xyz]$|({OF_QUATERNION})\(", c.path) for c in pool):  # place and attitude of a body
        keep = _steered(pool, states_room, driven)
    else:
        keep = _coupled(steps_of(pool, used), pool, states_room, driven.max(axis=0, initial=0.0))
    drop_idle_controls(steps_of(keep, used), used, _driven(keep, used, [0])[1:].max(axis=1, initial=0.0))
    _delay(keep, [c for c in used if not c.reason])
    levels = [c for c in noise if np.ptp(c.finite) <= _BURSTS * np.ptp(np.percentile(c.finite, (1, 99)))]
    for candidate in levels[: max(0, states_room.most - len(keep))]:
        candidate.reason, candidate.ready, candidate.why = "", "", "mostly noise from row to row: its level is judged"
        keep.append(candidate)
    return keep, doubt


def _slowest(states: Sequence[Source], used: Sequence[Candidate]) -> float:
    """Rate of the slowest topic that tells what no faster one does, 1/s.

    At its instants these lose little, or not much where a control shows in it that shows in none of them.
    """
    first, *others = sorted(states, key=lambda s: -s.rate)
    faster, slowest = [first], first.rate
    for source in others:
        if source.rate < first.rate / SLOWER:
            break
        if source.rate < ALIKE * slowest and _tells_more(source, faster, used):
            lost = max(_lost_at(source, other, used) for other in faster)
            if lost > LOST or (lost > 0.0 and not _driven_more(source, faster, used)):
                break
            slowest = source.rate
        faster.append(source)
    return slowest


def _tells_more(source: Source, faster: Sequence[Source], used: Sequence[Candidate]) -> bool:
    """Whether some number of a topic, which is more than noise, is no function of one of faster topics."""
    others = [c for s in faster for c in s.free]
    steps, n = steps_of([*others, *source.free], used), len(others)
    if len(steps.X) < FEWEST:
        return False
    own = steps.X[:, n:][:, predicted(steps.X, steps.U, (steps.X + steps.dX)[:, n:]) >= NOISE]
    for j in range(n):
        own = own[:, ~functions(steps.X[:, [j]], own)[0]]
    return own.size > 0


def _lost_at(slower: Source, source: Source, used: Sequence[Candidate]) -> float:
    """Share of the variance of a topic's number that only its own instants tell, not one of a slower topic; most of it.

    0 where those of the latter do as well; numbers that are noise do not count.
    """
    n, shares = len(source.free), []
    for beside in ([], slower.free[:1]):
        steps = steps_of([*source.free, *beside], used)
        if len(steps.X) < FEWEST:
            return math.inf
        shares.append(predicted(steps.X[:, :n], steps.U, (steps.X + steps.dX)[:, :n]))
    own, slow = (share[shares[0] >= NOISE] for share in shares)
    clear = 1.0 - slow > np.maximum(BLURRED * (1.0 - own), STILL)
    lost = np.where(slow >= NOISE, np.where(clear, 1.0 - slow, 0.0), math.inf)
    return float(lost.max(initial=0.0))


def _driven_more(source: Source, faster: Sequence[Source], used: Sequence[Candidate]) -> bool:
    """Whether some control shows in a topic that shows in no faster one."""
    there, *elsewhere = (_driven(s.free, used)[1:].max(axis=1, initial=0.0) > SHOWS for s in (source, *faster))
    return bool((there & ~np.any(elsewhere, axis=0)).any())


def _driven(pool: Sequence[Candidate], used: Sequence[Candidate], lags: Any = range(LONGEST_DELAY + 1)) -> Array:
    """How clearly all controls, and each, show in each candidate's next step (1 + m, n), at the delay at which most."""
    found = np.zeros((1 + (m := len(used)), len(pool)))

    def most(steps: Steps) -> Array:
        if not m or len(steps.X) < FEWEST:
            return found
        return np.maximum(found, steps.effects())

    for lag in lags:
        found = most(steps_of(pool, used, [lag] * m))
    steps = steps_of(pool, [*used, *used], [0] * m + [-1] * m)
    if not m or len(steps.X) < FEWEST:
        return found
    U, V = np.hsplit(steps.U / size_of(steps.U), 2)
    # a servo carries a command out before the next message, which is the first to hold it
    servo = from_both_ends(steps.X, U, V, steps.dX, np.ones(m, dtype=bool))[0]
    return np.where(servo, most(Steps(steps.X, V, steps.dX)), found)


def _strongest(driven: Array, used: list[Candidate], room: _Room) -> list[Candidate]:
    """The controls that show most, up to a number; `driven` (1 + m, n): of all controls, and of each."""
    _first([used[j] for j in np.argsort(driven[1:].max(axis=1, initial=0.0))[::-1]], room)
    return [c for c in used if not c.reason]


def _steered(pool: list[Candidate], room: _Room, driven: Array) -> list[Candidate]:
    """Of a body's pose those in which some control shows most: all of its numbers are coupled by geometry.

    A place adds up what the attitude did, so that the attitude goes before where the controls show in it at all. Of
    each control what it shows in half as clearly as where it shows most counts. `driven` (1 + m, n): as of `_driven`.
    """
    angles = [i for i, c in enumerate(pool) if "(" in c.path and driven[0, i] > FAINT]
    among, least = (angles, FAINT) if angles else (list(range(len(pool))), SHOWS)
    shown = driven[:, among]
    best = shown.max(axis=1, initial=0.0)
    best[1:][best[1:] < STEERS] = math.inf
    clear = ((shown >= 0.5 * best[:, None]) & (shown > least)).any(axis=0)
    kept = sorted(np.array(among)[clear].tolist(), key=lambda i: -driven[0, i])[: room.most]
    for i, candidate in enumerate(pool):
        if kept and i not in kept:
            candidate.ready = "state"
            candidate.reason = "a place moves with the attitude by geometry, or the controls show less in it"
    return [pool[i] for i in sorted(kept)] or _first(pool, room)


def _coupled(steps: Steps, pool: list[Candidate], room: _Room, driven: Array) -> list[Candidate]:
    """States in whose next step the controls show, those that help to predict them, and those that follow them.

    A family, such as a body's axes, is taken or left as one; of one larger than the room all but one come last.
    """
    order, families = np.argsort(-driven, kind="stable").tolist(), [candidate.family for candidate in pool]
    kept, full, counted, strength = list[int](), set[int](), 0, dict[int, float]()
    first = {families[j]: j for j in reversed(order)}
    order.sort(key=lambda j: families.count(families[j]) > room.most and first[families[j]] != j)

    def take(strongest: int) -> None:
        family = [j for j in order if families[j] == families[strongest]]
        family = [j for j in family if j not in kept] if len(family) <= room.most else [strongest]
        (kept.extend if len(kept) + len(family) <= room.most else full.update)(family)

    for i in order:
        if driven[i] > SHOWS and i not in kept and i not in full:
            take(i)
    if not kept:
        return _first(pool, room)
    while rest := [j for j in order if j not in kept and j not in full]:
        if len(kept) > counted:
            counted, strength = len(kept), dict(zip(rest, steps.coupling(kept, rest).tolist(), strict=True))
        strongest = max(rest, key=strength.__getitem__)
        if strength[strongest] <= SHOWS:
            break
        take(strongest)
    for j, candidate in enumerate(pool):
        if j not in kept:
            alone = "in one step neither the controls nor the states above show in it, nor it in them"
            candidate.reason, candidate.ready = room.reason if j in full else alone, "state"
    return [pool[j] for j in sorted(kept)]


def _first(pool: list[Candidate], room: _Room) -> list[Candidate]:
    """The first candidates; the others have no room."""
    for candidate in pool[room.most :]:
        candidate.reason = room.reason
    return pool[: room.most]


def _delay(states: Sequence[Candidate], used: Sequence[Candidate]) -> None:
    """Samples by which each control must be taken earlier to explain clearly more of the next step: as the fit says."""
    if not used or not states:
        return
    for _ in range(2 * len(used)):
        late = [*used] * (LONGEST_DELAY + 1)
        by = [c.delay + lag for lag in range(LONGEST_DELAY + 1) for c in used]
        steps = steps_of(states, late, by)
        N = len(steps.X)
        if N < PER_UNKNOWN * (len(states) + len(used)):
            return
        u = steps.U.T.reshape(LONGEST_DELAY + 1, len(used), N)
        found = lags((steps.X / size_of(steps.X)).T, u / size_of(u[0].T)[:, None], steps.dX.T, np.ones(N))
        if not found:
            return
        first = max(found, key=lambda j: found[j][1])
        used[first].delay += found[first][0]
