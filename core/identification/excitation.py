# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Excitation: whether the recordings move every signal enough, both ways and independently of the others."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from uncertain_lti.base.arrays import Array, Index
from uncertain_lti.identification.passes import Moments
from uncertain_lti.identification.problem import Problem

COLLINEAR = 1e-3
"""Smallest eigenvalue of the regressors' correlation below which signals move nearly together (and above rank)."""
MOST_GROUPS, MOST_NAMES = 3, 6
"""Combinations of signals that are named, and names in a sentence."""
DETERMINED = 4.0
"""Standard errors that a control's effect on some state must have to be distinguished from the noise."""
FEW = 10
"""A control that leaves its usual value in fewer transitions is not identifiable."""
ONE_SIDED = 0.05
"""A control that goes less than this share of its range to one side of its steady value is one-sided."""
FED_BACK = 0.9
"""Share of a control's changes explained by the states, from which on that is reported."""


def collinear(
    problem: Problem, moments: Moments, names: Sequence[str], limit: float, past: Collection[int] = ()
) -> list[str]:
    """Signals that nearly move together, and the recording that would separate them."""
    free = np.flatnonzero(moments.phi_scale[: problem.p] > 0)
    free = free[~np.isin(free, list(past))]
    unit = 1.0 / moments.phi_scale[free]
    values, vectors = np.linalg.eigh(moments.centre[np.ix_(free, free)] * np.outer(unit, unit) / moments.count)
    messages: list[str] = []
    groups = int(np.count_nonzero((values > limit) & (values < COLLINEAR)))
    for value, vector in zip(values, vectors.T, strict=True):
        if not limit < value < COLLINEAR:
            continue
        if len(messages) == MOST_GROUPS:
            messages.append(
                f"{groups} combinations of signals nearly move together, of which the {MOST_GROUPS} nearest are named "
                f"above: few of {len(free)} signals can be told apart; use fewer, or more controls of their own"
            )
            break
        part = [int(free[j]) for j in np.flatnonzero(np.abs(vector) > 0.3 * np.abs(vector).max())]
        if len(part) < 2:
            continue
        states = [names[j] for j in part if j < problem.n]
        controls = [names[j] for j in part if j >= problem.n]
        if not states:
            cure = f"record {quoted(controls[:1])} moving while {quoted(controls[1:])} rests"
        elif controls:
            cure = (
                f"record steps of {quoted(controls)} that are sharper than {quoted(states)} can follow, not set by a "
                f"feedback"
            )
        else:
            cure = f"excite them by other controls or from other initial states, or leave one of {quoted(states)} out"
        messages.append(
            f"{quoted([names[j] for j in part])} nearly move together (all but {value**0.5:.2%} of their size), so "
            f"their columns are poorly told apart and their elements may trade places: {cure}"
        )
    return messages


def rare(problem: Problem, names: Sequence[str]) -> dict[int, str]:
    """Controls, by column, that have one value in all but a few transitions."""
    messages = {}
    for j in range(problem.n, problem.p):
        values, counts = np.unique(problem.z[:, j], return_counts=True)
        moved = problem.N - int(counts.max())
        if len(values) > 1 and moved < FEW:
            messages[j] = (
                f"control '{names[j]}' leaves its usual value in {moved} of {problem.N} transitions only, so its "
                f"effect is not identifiable: record it moving, or leave it out"
            )
    return messages


def one_sided(problem: Problem, names: Sequence[str], known: Collection[int] = ()) -> list[str]:
    """Controls that stay on one side of their steady value."""
    messages = []
    for j in range(problem.n, problem.p):
        if j in known:
            continue
        low, high = float(problem.z[:, j].min()), float(problem.z[:, j].max())
        if low == high:  # reported as constant elsewhere
            continue
        reach = max(high, -low)
        side = "below" if low > -ONE_SIDED * reach else "above" if high < ONE_SIDED * reach else None
        if side:
            messages.append(
                f"control '{names[j]}' never goes {side} its steady value (normalised {low:.3g} to {high:.3g}): the "
                f"envelope is fitted to one side and says nothing of the other; record it moving both ways, as far as "
                f"it will move in use"
            )
    return messages


def lost(problem: Problem, moments: Moments, known: Collection[int] = ()) -> dict[int, tuple[int, float]]:
    """Controls whose effect on every state is lost in what one step leaves unexplained."""
    free = np.flatnonzero(moments.phi_scale > 0)
    centre, target = moments.centre[np.ix_(free, free)], moments.target[free]
    if not len(free) or moments.count <= len(free):
        return {}
    certainty = _certainty(centre, target, moments.rate_square, moments.count)
    found = {}
    for row, j in enumerate(free.tolist()):
        if not problem.n <= j < problem.p or j in known or moments.low[j] == moments.high[j]:
            continue
        best = int(np.argmax(certainty[row]))
        if certainty[row, best] < DETERMINED:
            found[j] = (best, float(certainty[row, best]))
    return found


def _certainty(gram: Array, cross: Array, total: Array, count: int) -> Array:
    """|Element| over its standard error, (b, t): gram (b, b), cross (b, t), sums of squares of the targets (t,)."""
    inverse = np.linalg.pinv(gram, hermitian=True)
    theta = inverse @ cross
    residual = np.maximum(total - np.einsum("ji,ji->i", theta, cross), 1e-14 * total)
    error = np.sqrt(np.maximum(np.outer(np.diagonal(inverse), residual / (count - len(gram))), 0.0))
    return np.asarray(np.abs(theta) / np.maximum(error, 1e-300))


def fed_back(problem: Problem, names: Sequence[str], past: Collection[int] = ()) -> list[str]:
    """Controls whose changes follow from the states: closed-loop recordings, or inputs too regular to separate.

    u_k - u_{k-1} is explained by x_k, x_{k-1} and u_{k-1} if a feedback sets u_k; an input that a person steps
    at will is not.
    """
    follows = successive(problem)
    if len(follows) <= 4 * problem.p:
        return []
    before, now = problem.z[follows], problem.z[follows + 1]
    n = problem.n
    basis = np.column_stack([now[:, :n], before, np.ones(len(before))])
    gram = basis.T @ basis
    messages = []
    for j in [j for j in range(n, problem.p) if j not in past]:
        change = now[:, j] - before[:, j]
        change = change - change.mean()
        size = float(change @ change)
        if size <= 1e-18 * float(now[:, j] @ now[:, j]) or np.count_nonzero(np.diff(change)) < 0.05 * len(change):
            continue
        explained = 1.0 - float(unexplained(gram, (basis.T @ change)[:, None], np.array([size]))[0]) / size
        if explained > FED_BACK:
            messages.append(
                f"the changes of control '{names[j]}' follow from the states to {explained:.0%}: a feedback sets it, "
                f"or it moves too regularly to tell; its effect cannot be told from the plant's own, so the nominal "
                f"matrices may mix both (the bounds hold for the same feedback only); record it with steps of its own"
            )
    return messages


def unexplained(gram: Array, cross: Array, total: Array) -> Array:
    """Sum of squares of each target that its least-squares fit on some regressors leaves.

    Shares below 1e-11 are not distinguished, which no decision here needs.

    `gram` (..., b, b): products of the regressors with one another; leading axes are other choices of regressors;
    `cross` (..., b, t): products of the regressors with the targets; `total` (t,): sums of squares of the targets.
    """
    size = np.sqrt(np.diagonal(gram, axis1=-2, axis2=-1))
    unit = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0)
    values, vectors = np.linalg.eigh(gram * unit[..., :, None] * unit[..., None, :])
    keep = values > 1e-11 * values[..., -1:]
    root = np.divide(1.0, np.sqrt(values, where=keep, out=np.ones_like(values)), where=keep, out=np.zeros_like(values))
    turned = np.swapaxes(vectors * root[..., None, :], -1, -2) @ (cross * unit[..., :, None])
    return np.asarray(np.maximum(total - np.einsum("...bt,...bt->...t", turned, turned), 1e-11 * total))


def triangle(columns: Array) -> Array:
    """A small matrix on which least squares is what it is on long columns, to the same digits.

    `columns` (c, N): regressors and targets; Returns (at most c, c): R of the QR decomposition of `columns`ᵀ, so that
    any sum of products of two columns is that of R's columns.
    """
    c, N = columns.shape
    width = max(4 * c, min(500, 8192 // c))  # stretches that stay in the cache, and in one thread of BLAS
    whole = N - N % width
    parts = [columns[:, whole:].T]
    if whole:
        reduced = np.asarray(np.linalg.qr(columns[:, :whole].T.reshape(-1, width, c), mode="r"))
        parts.append(reduced.reshape(-1, c))
    return np.asarray(np.linalg.qr(np.vstack(parts), mode="r"))


def least_squares(triangular: Array, regressors: Index, targets: Index, count: int) -> tuple[Array, int]:
    """Least squares on some columns, from the `triangle` of all.

    `regressors` (b,): columns; `targets` (t,): columns; Returns (b, t): elements; the least ones where the regressors
    are dependent.
    """
    limit = float(np.finfo(np.float64).eps) * max(count, len(regressors))
    found, _, rank, _ = np.linalg.lstsq(triangular[:, regressors], triangular[:, targets], rcond=limit)
    return np.asarray(found), int(rank)


def successive(problem: Problem) -> NDArray[np.intp]:
    """Transitions that the next one in the problem continues: same recording, next sample."""
    same = (problem.source[1:] == problem.source[:-1]) & (problem.k[1:] == problem.k[:-1] + 1)
    return np.flatnonzero(same)


def quoted(names: Sequence[str]) -> str:
    """'a', 'b' and 'c'; of many names the first ones, and how many others there are."""
    marked = [n if n.startswith("the ") else f"'{n}'" for n in names]
    if len(marked) > MOST_NAMES + 1:
        return f"{', '.join(marked[:MOST_NAMES])} and {len(marked) - MOST_NAMES} others"
    return marked[0] if len(marked) == 1 else ", ".join(marked[:-1]) + " and " + marked[-1]
