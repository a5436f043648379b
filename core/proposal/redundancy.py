# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Redundancy: candidates that repeat others, are noise, or act on nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from uncertain_lti.base.arrays import Array
from uncertain_lti.identification.predictability import NOISE, predicted
from uncertain_lti.proposal.candidates import FEWEST, Candidate, Source
from uncertain_lti.proposal.effects import FAINT, SHOWS, Steps, steps_of

SHORT_DELAY = 3
"""Samples within which a control shows that keeps a state from being noise."""


def drop_functions(steps: Steps, pool: list[Candidate]) -> list[Candidate]:
    """Drop candidates that are functions of another one, whatever their topics: copies, other units, squares.

    Such a function leaves next to nothing of a candidate, or nothing but noise. Of two that are functions of each
    other, the one in which the controls show clearly more stays, else the first.
    """
    if len(steps.X) < FEWEST:
        return pool
    n = len(pool)
    shows = steps.effect(range(n)) if steps.U.shape[1] else np.zeros(n)
    kept: list[int] = []
    for i in np.argsort(-np.log(np.maximum(shows, 1.0)).round(1), kind="stable").tolist():
        source = next((j for j in kept if _function(steps.X[:, j], steps.X[:, i])), None)
        if source is not None:
            pool[i].reason = f"says what {_place(pool[source], pool[i])} says already"
            continue
        for j in [j for j in kept if _function(steps.X[:, i], steps.X[:, j])]:  # x stays, its square goes
            kept.remove(j)
            pool[j].reason = f"says what {_place(pool[i], pool[j])} says already"
        kept.append(i)
    return [pool[i] for i in sorted(kept)]


def _place(candidate: Candidate, other: Candidate) -> str:
    return candidate.path if candidate.topic == other.topic else f"{candidate.topic} {candidate.path}"


def _function(of: Array, values: Array) -> bool:
    """Whether these values (N,) are a smooth function of others at the same instants, or one sample off, but noise."""
    for shift in (0, 1, -1):
        a, b = of[max(shift, 0) : len(of) + min(shift, 0)], values[max(-shift, 0) : len(values) - max(shift, 0)]
        if np.ptp(a) == 0 or np.ptp(b) == 0:
            return False
        a = (a - a.mean()) / a.std()
        basis = np.column_stack([np.ones_like(a), a, a**2, a**3])
        rest = b - basis @ np.linalg.lstsq(basis, b, rcond=None)[0]
        share = float(rest.std() / b.std())
        memory = float(np.corrcoef(rest[1:], rest[:-1])[0, 1]) if rest.std() > 0 else 0.0
        moves = float(np.diff(b).std() / b.std())
        if share < 0.02 or (share < 0.15 and memory < 0.3 and moves < 0.7):  # white around what it follows
            return True
    return False


def drop_noise(
    pool: list[Candidate], every: dict[str, Source], used: Sequence[Candidate]
) -> tuple[list[Candidate], str]:
    """Drop candidates that are noise from sample to sample, unless all are.

    What the controls show in stays where another of its family does: all axes of a body turn by the same law.
    """
    late = [*used] * (SHORT_DELAY + 1)
    steps = steps_of(pool, every, late, [lag for lag in range(SHORT_DELAY + 1) for _ in used])
    if len(steps.X) < max(FEWEST, 2 * (len(pool) + len(late))):
        return pool, ""
    share = predicted(steps.X, steps.U, steps.X + steps.dX)
    if not (share >= NOISE).any():
        return pool, (
            "nothing here is more than noise from one sample to the next: record the machine at work before you "
            "fit a model"
        )
    shown = steps_of(pool, every, used).effect(range(len(pool))) > SHOWS
    families = {c.family for c, known in zip(pool, share, strict=True) if known >= NOISE}
    for candidate, known, seen in zip(pool, share, shown, strict=True):
        if known < NOISE and not (seen and candidate.family in families):
            candidate.reason = (
                f"noise: one sample predicts {max(0.0, known):.0%} of the variance at the next, controls included"
            )
            candidate.ready = "state"
    return [c for c in pool if not c.reason], ""


def drop_idle_controls(steps: Steps, used: Sequence[Candidate]) -> None:
    """Leave out controls that show nowhere given the others, and those that move with another one."""
    if len(steps.X) < FEWEST or len(used) < 2:
        return
    moving = np.ptp(steps.U, axis=0) > 0
    with np.errstate(invalid="ignore", divide="ignore"):
        alike = np.abs(np.corrcoef(steps.U.T)) > 0.99
    shows = steps.effect_of_each().max(axis=1, initial=0.0)
    for j, candidate in enumerate(used):
        twin = next((i for i in range(j) if alike[i, j] and not used[i].reason), None)
        if not moving[j]:
            candidate.reason = "does not move while the states are there"
        elif twin is not None:
            candidate.reason, candidate.ready = f"moves with {used[twin].topic} {used[twin].path}", "control"
        elif shows[j] < FAINT and shows.max() > SHOWS:
            candidate.reason, candidate.ready = "shows in the next step of none of the states", "control"


def prefer_rates(source: Source) -> None:
    """Of a pose and its twist the twist; of a joint's position, velocity and effort not the effort."""
    moves = {c.path for c in source.free}
    if any("twist." in p for p in moves):
        for candidate in source.free:
            if "pose." in candidate.path:
                candidate.reason = "a place in a fixed frame; its rate of change is the twist above"
    if any("angular_velocity." in p or "(orientation)" in p for p in moves):
        for candidate in source.free:
            if "linear_acceleration." in candidate.path:
                candidate.reason = "an acceleration answers within a step; add it if it has a memory of its own"
    if any(p.startswith(("position[", "velocity[")) for p in moves):
        for candidate in source.free:
            if candidate.path.startswith("effort["):
                candidate.reason = "an effort answers within a step; add it if it has a memory of its own"


def drop_copies(pool: Sequence[Candidate]) -> None:
    """Leave out what moves as another candidate of the same topic does."""
    kept: list[Candidate] = []
    for candidate in pool:
        mine = np.concatenate(candidate.values)
        for other in kept:
            theirs = np.concatenate(other.values)
            if other.topic == candidate.topic and len(mine) == len(theirs):
                both = np.isfinite(mine) & np.isfinite(theirs)
                if both.sum() > 2 and np.ptp(mine[both]) > 0 and np.ptp(theirs[both]) > 0:
                    if abs(np.corrcoef(mine[both], theirs[both])[0, 1]) > 0.9999:
                        candidate.reason = f"moves with {other.path}"
                        break
        else:
            kept.append(candidate)
