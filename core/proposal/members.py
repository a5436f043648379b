# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Members: of many that are alike, such as the joints of a robot, which number and which command is whose."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import permutations

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.identification.evidence import left, size_of
from uncertain_lti.proposal.candidates import FEWEST, SHOWS, Candidate, most_shown, steps_of

_INDEXED = re.compile(r"([^\[]*)\[(\d+)\](.*)")
SHORT_DELAY = 3
"""Samples within which a control shows that keeps a state from being noise, or that makes it that of a joint."""
TOGETHER = 0.9999  # correlation from which on commands cannot be told apart by what they do
ALONE = 2.0  # times what all commands leave unknown of a joint that its own one may leave
_ANGLE = re.compile(r"pos(ition)?s?$|angle")
_NEAR = 0.1  # share of its command by which an angle may come to rest elsewhere
Members = dict[str, list[Candidate]]


def _indexed(group: Sequence[Candidate]) -> list[Members]:
    """What is of each index of `motor[3].q` and `motor[3].dq`, or of `position[3]` and `velocity[3]` of one message."""
    found: dict[tuple[str, str], Members] = defaultdict(lambda: defaultdict(list))
    for candidate in (c for c in group if not c.element):
        if match := _INDEXED.fullmatch(candidate.path):
            array, index, rest = match.groups()
            found[candidate.topic, array if rest else array.rpartition(".")[0]][index].append(candidate)
    return [entries for entries in found.values() if len(entries) > 1]


def pair_entries(pool: Sequence[Candidate], used: Sequence[Candidate]) -> None:
    """Say whose the commands of an array without names are: of a joint that they alone move."""
    named: Members = defaultdict(list)
    for candidate in (c for c in pool if c.element):
        named[candidate.element].append(candidate)
    arrays = _indexed(used)
    groups = [named, *_indexed(pool)] if arrays else []
    groups = [{name: of for name, of in all_.items() if _turns(of) or _comes_to(of, used)} for all_ in groups]
    for commands in arrays:
        for members in groups:
            if whose := _whose([*commands.values()], members):
                for name, its in [*zip(whose, commands.values(), strict=True), *members.items()]:
                    for candidate in its:
                        candidate.member = name
                break


def _turns(numbers: Sequence[Candidate]) -> bool:
    """Whether one of some numbers is the rate of another one, in its unit per second."""
    return any(0.5 < moves_per(b, a) * a.source.rate < 2.0 for a, b in permutations(numbers, 2))


def _comes_to(numbers: Sequence[Candidate], used: Sequence[Candidate]) -> bool:
    """Whether it is an angle alone, which comes to rest where one of the commands, in its unit, is."""
    if len(numbers) > 1 or not _ANGLE.search(numbers[0].kind):
        return False
    steps = steps_of(numbers, used)
    if len(steps.X) < FEWEST:
        return False
    Z = np.column_stack([steps.X, steps.U, np.ones(len(steps.X))])
    back, *pulls, _ = np.linalg.lstsq(Z, steps.dX[:, 0], rcond=None)[0].tolist()
    return any(abs(pull + back) < abs(back) * _NEAR for pull in pulls)


def moves_per(rate: Candidate, place: Candidate) -> float:
    """How far a number moves in FEWEST rows per what another one adds up to; 0 if otherwise, 1 if too few rows tell."""
    move = np.concatenate([values[FEWEST:] - values[:-FEWEST] for values in place.values])
    speed = np.concatenate([np.convolve(v, np.ones(FEWEST), "valid")[:-1] for v in rate.values if len(v) > FEWEST])
    good = np.isfinite(move) & np.isfinite(speed)
    if np.count_nonzero(good) < FEWEST:
        return 1.0
    as_it_says = np.corrcoef(move[good], speed[good])[0, 1] > 0.9
    return float(np.polyfit(speed[good], move[good], 1)[0]) if as_it_says else 0.0


def _whose(commands: Sequence[Sequence[Candidate]], members: Members) -> list[str]:
    """The member of each command, of those that move together all along in their order; empty if it is not clear."""
    if not members:
        return []
    alike = np.abs(np.corrcoef([np.concatenate(own[0].values) for own in commands])) > TOGETHER
    np.fill_diagonal(alike, True)
    first, found = alike.argmax(axis=1), dict[int, str]()
    shown, lost = _shown(commands, [*members.values()])
    for kind in np.unique(first):
        mine = np.flatnonzero(first == kind)
        theirs = np.flatnonzero(first[shown.argmax(axis=0)] == kind)
        theirs = np.sort(theirs[np.argsort(-shown[kind, theirs], kind="stable")][: len(mine)])
        if len(theirs) < len(mine) or shown[kind, theirs].min() <= SHOWS or lost[kind, theirs].max() > ALONE:
            return []
        found.update(zip(mine.tolist(), ([*members][j] for j in theirs), strict=True))
    return [found[place] for place in range(len(commands))]


def _shown(commands: Sequence[Sequence[Candidate]], members: Sequence[Sequence[Candidate]]) -> tuple[Array, Array]:
    """F statistic of each command alone in each member's next step; times what all commands leave of it (m, n) each."""
    states, used = ([c for own in group for c in own] for group in (members, commands))
    of, by = (np.repeat(np.arange(len(group)), [len(own) for own in group]) for group in (members, commands))
    shown, lost = np.zeros((2, len(commands), len(members)))
    for lag in range(-1, SHORT_DELAY + 1):  # a servo carries a command out before the next message
        steps = steps_of(states, used, [lag] * len(used))
        if len(steps.X) < FEWEST:
            break
        for j in range(len(members)):
            u, dx = left(steps.X[:, of == j], steps.U / size_of(steps.U), steps.dX[:, of == j])
            gram, cross, size = u.T @ u, u.T @ dx, (dx**2).sum(axis=0)
            least = np.maximum(size - _told(gram, cross), 1e-12 * size)
            for i in range(len(commands)):
                told = _told(gram[np.ix_(by == i, by == i)], cross[by == i])
                rest = np.maximum(size - told, 1e-12 * size)
                effect = float(np.max(told / rest)) * len(dx) / np.count_nonzero(by == i)
                if effect > shown[i, j]:
                    shown[i, j], lost[i, j] = effect, np.max(rest / least)
    return shown, lost


def _told(gram: Array, cross: Array) -> Array:
    """Sum of squares that regressors tell of some columns (n,), from their products with each other and with these."""
    return np.asarray((cross * (np.linalg.pinv(gram, 1e-10, hermitian=True) @ cross)).sum(axis=0))


def one_of_them(pool: list[Candidate], used: list[Candidate], like: str) -> tuple[list[Candidate], list[Candidate]]:
    """Where states and commands are of the same members, those of the member whose command shows most."""
    shared = [e for e in dict.fromkeys(c.element for c in used) if e and any(s.element == e for s in pool)]
    if len(shared) < 2 or (not like and _most_are_others(pool, used, shared)):
        return pool, used

    def effect(element: str) -> float:
        mine, its = ([c for c in group if c.element == element] for group in (pool, used))
        return most_shown(mine, its)

    best = like if like in shared else max(shared, key=effect)
    for candidate in [*pool, *used]:
        if candidate.element != best:
            other = f"another member than {best}, which does not move as {best} does"
            alone = f"none of the members, such as {best}, each of which is judged by its own numbers alone"
            candidate.reason = f"of {other if candidate.element else alone}"
    kept = [c for c in pool if not c.reason]
    for candidate in pool:
        if not candidate.element and all(c.source is not candidate.source for c in kept):
            candidate.source.apart = f"of none of the members, such as {best}"
    return kept, [c for c in used if not c.reason]


def _most_are_others(pool: Sequence[Candidate], used: Sequence[Candidate], shared: Sequence[str]) -> bool:
    """Whether more members than have commands of their own move by commands of none, as a rover's wheels do."""
    others = [c for c in pool if c.element and c.element not in shared]
    rest = [c for c in used if c.element not in shared]
    return bool(len({c.element for c in others}) > len(shared) and rest and most_shown(others, rest) > SHOWS)


def all_of_them(
    states: Sequence[Candidate], controls: Sequence[Candidate], moving: Mapping[tuple[str, str], Candidate]
) -> dict[str, list[Candidate]]:
    """Members in which every number moves that is proposed of one, with these numbers; empty if there is one only."""
    group = [*states, *controls]
    if len({c.element for c in group}) != 1 or not group[0].element or not controls:
        return {}
    places = {(c.topic, c.shape, c.element): c for c in moving.values() if c.element}
    found = {}
    for member in dict.fromkeys(element for _, _, element in places):
        if all((c.topic, c.shape, member) in places for c in group):
            found[member] = [places[c.topic, c.shape, member] for c in group]
    return found if len(found) > 1 else {}
