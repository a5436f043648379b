"""Criteria (10) and (11) to their exact optimum by solving on the few samples that matter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from uncertain_lti.base.arrays import Array, Index
from uncertain_lti.base.english import plural
from uncertain_lti.base.errors import FitError
from uncertain_lti.identification.fleet import Fleet
from uncertain_lti.identification.passes import Candidate, Moments, Samples
from uncertain_lti.identification.solvers import Sense, Simplex, dual_bound, solve_qp
from uncertain_lti.identification.structure import Structure

SUBSAMPLE = 10_000
"""Transitions of the first solve; up to twice as many are held as a whole."""
TOLERANCE = 1e-11
"""Violation, in scaled units, below which a sample counts as contained; the repair lifts the rest."""
TIE_BREAK = 1e-8
"""Weight of the squared distance of the centre beside the squared widths.

|rate - centre| <= half-width for every sample, so the sum of squared distances is at most a quarter of (10), and
the optimum of the sum is within TIE_BREAK / 4 (relative) of the optimum of (10) alone, with the centre that the
stated tie-break asks for.
"""
WIDTH_SLACK = 1e-9
"""Relative room above δ of (11) in which its ties are broken; a solver needs some."""
BOUNDED_TIE_BREAK = 1e-5
"""The same as TIE_BREAK among the optima of (11), a set so thin that the active-set solver needs the larger weight."""
REGULARISATION = 1e-4
"""Weight of the squared widths beside δ in (11), for a solver of strictly convex programmes.

With a weight that is small enough, and a small one is, the minimum of the sum is that of δ, and among its optima that
of the squared widths. Whether it was is seen from the optimum of δ alone, at the end.
"""
MAX_ROUNDS = 200
_ATTEMPTS = ((1.0, 1e-10), (10.0, 1e-8), (100.0, 1e-6))  # factor on the tie-break's weight, ridge of the centre
_JOIN = 48  # samples that join a working set per round, at least; more where there are many unknowns


@dataclass
class Solution:
    """Elements, one column per row of the model, and how they were found.

    Parameters
    ----------
    theta : array (r, n)
        Nominal elements, 1/s.
    d : array (q, n)
        Half-widths.
    violation : array (n,)
        Largest violation left, in scaled units.
    delta : array (n,) or None, optional
        Optimum of (11) on the working set, a lower bound of the optimum over all samples; None for (10).
    rounds : int, default 0
        Programmes solved on the working set.
    passes : int, default 1
        Passes over all transitions.
    working : list of int, optional
        Size of the working set of each row.
    solvers : set of str, optional
        Names of those that found it.
    gap : float or None, optional
        How far (10) is above a lower bound of its optimum at most, relative, by the dual objective; None for (11).
    """

    theta: Array
    d: Array
    violation: Array
    delta: Array | None = None
    rounds: int = 0
    passes: int = 1
    working: list[int] = field(default_factory=list)
    solvers: set[str] = field(default_factory=set)
    gap: float | None = None


class Row:
    """One row of the model in scaled unknowns ξ = [θ d], with the samples held for it and the working set among them.

    Elements that the structure fixes, and columns that are 0 in every sample, are no unknowns.

    Parameters
    ----------
    i : int
        Which row of the model.
    sums : Moments
        Of all data.
    bounds : four arrays
        Of `Structure.stacked`.
    """

    def __init__(self, i: int, sums: Moments, bounds: tuple[Array, Array, Array, Array]) -> None:
        self.i = i
        self.scale = float(sums.rate_scale[i])
        theta_low, theta_high, d_low, d_high = (b[:, i] for b in bounds)
        dead_phi, dead_psi = sums.phi_scale == 0, sums.psi_scale == 0
        fixed_phi, fixed_psi = theta_low == theta_high, d_low == d_high
        self.theta = np.where(fixed_phi, theta_low, np.clip(0.0, theta_low, theta_high))
        self.d = np.where(fixed_psi, d_low, np.where(dead_psi, d_low, 0.0))
        self.free_phi = np.flatnonzero(~dead_phi & ~fixed_phi)
        self.free_psi = np.flatnonzero(~dead_psi & ~fixed_psi)
        with np.errstate(divide="ignore"):
            unit_phi, unit_psi = 1.0 / sums.phi_scale, 1.0 / sums.psi_scale
        self.unit_phi, self.unit_psi = unit_phi[self.free_phi], unit_psi[self.free_psi]
        self.size_unit = np.where(dead_psi, 0.0, unit_psi)
        self.r, self.q = len(self.free_phi), len(self.free_psi)
        self.fixed_theta, self.fixed_d = self.theta.copy(), self.d.copy()
        self.fixed_theta[self.free_phi] = 0.0
        self.fixed_d[self.free_psi] = 0.0
        to_phi, to_psi = self.scale * self.unit_phi, self.scale * self.unit_psi
        self.lower = np.concatenate([theta_low[self.free_phi] / to_phi, d_low[self.free_psi] / to_psi])
        self.upper = np.concatenate([theta_high[self.free_phi] / to_phi, d_high[self.free_psi] / to_psi])
        inside = np.ix_(self.free_phi, self.free_phi)
        self.centre = sums.centre[inside] * np.outer(self.unit_phi, self.unit_phi) / sums.count
        target = sums.target[:, i] - sums.centre @ self.fixed_theta
        self.target = target[self.free_phi] * self.unit_phi / (sums.count * self.scale)
        plain = self._gram(sums.plain_gram, sums.count)
        self.plain, self.plain_linear, _ = plain
        self.gram, self.linear, self.known = plain if sums.gram is None else self._gram(sums.gram[i], sums.count)
        self.samples = Samples.join([], len(sums.low))
        self.pool: Index = np.empty(0, dtype=np.intp)  # positions in samples
        self.limit: float | None = None  # δ of (11) in units of scale
        self.exact = False  # (11) by the simplex method
        self.attempt = _ATTEMPTS[0]
        self._active: dict[str, Sense] = {}  # what was active in the last programme of a kind
        self._simplex: Simplex | None = None
        self._known: Index = np.empty(0, dtype=np.intp)

    def _gram(self, gram: Array, count: int) -> tuple[Array, Array, float]:
        """Squared widths as ½ dᵀ G d + gᵀ d + k in scaled units; G has order one."""
        unit = self.unit_psi
        inside = gram[np.ix_(self.free_psi, self.free_psi)] * np.outer(unit, unit) / count
        linear = (gram @ self.fixed_d)[self.free_psi] * unit / (count * self.scale)
        largest = float(np.diagonal(inside).max(initial=0.0)) or 1.0
        known = 0.5 * float(self.fixed_d @ gram @ self.fixed_d) / (count * self.scale**2)
        return inside / largest, linear / largest, known / largest

    @property
    def unknown(self) -> bool:
        """Something is left to solve for."""
        return self.r + self.q > 0

    def start(self) -> None:
        """Start from least squares, with no half-width."""
        answer = np.linalg.lstsq(self.centre + 1e-12 * np.eye(self.r), self.target, rcond=None)[0].astype(np.float64)
        self.store(np.concatenate([np.clip(answer, self.lower[: self.r], self.upper[: self.r]), np.zeros(self.q)]))

    def store(self, answer: Array) -> None:
        """Take scaled unknowns as the row's elements.

        Parameters
        ----------
        answer : array (r + q,)
            Scaled unknowns ξ.
        """
        self.theta[self.free_phi] = answer[: self.r] * self.unit_phi * self.scale
        d = np.maximum(answer[self.r :], np.maximum(self.lower[self.r :], 0.0))
        self.d[self.free_psi] = d * self.unit_psi * self.scale

    def hold(self, samples: Samples, columns_drift: bool, disturbance: bool, noise: bool) -> None:
        """Hold these samples, and the working set so far.

        Parameters
        ----------
        samples : Samples
            Of the last pass.
        columns_drift : bool
            The fit has c.
        disturbance : bool
            The fit has dc.
        noise : bool
            The fit has v.
        """
        p = len(samples.z)
        kept = self.samples[self.pool]
        self.samples = samples = Samples.join([samples, kept], p)
        self.pool = np.searchsorted(samples.index, kept.index)
        ones = np.ones(len(samples))
        phi = np.vstack([samples.z, ones]) if columns_drift else samples.z
        extra = ([ones] if disturbance else []) + ([1.0 / samples.dt] if noise else [])
        psi = np.vstack([np.abs(samples.z), *extra])
        size = self.size_unit @ psi
        size[size == 0.0] = 1.0
        # rows of the programme: each sample divided by its own size, so that one near rest weighs as any other
        self.phi = ((phi[self.free_phi] * self.unit_phi[:, None]) / size).T
        self.psi = ((psi[self.free_psi] * self.unit_psi[:, None]) / size).T
        self.y = (samples.rate - self.fixed_theta @ phi) / (size * self.scale)
        self.half = (self.fixed_d @ psi) / (size * self.scale)
        self.width = 2.0 * samples.root_weight * samples.dt * size  # √w x width = width x (ψ d + half)

    def slacks(self) -> tuple[Array, Array | None]:
        """Slack of every held sample.

        Returns
        -------
        array (K,)
            From leaving the bounds.
        array (K,) or None
            From being wider than (11) allows; None without a limit.
        """
        theta = self.theta[self.free_phi] / (self.unit_phi * self.scale)
        d = self.d[self.free_psi] / (self.unit_psi * self.scale)
        half = self.psi @ d + self.half
        inside = half - np.abs(self.y - self.phi @ theta)
        return inside, None if self.limit is None else self.limit / self.width - half

    def slack(self) -> Array:
        """Slack of every held sample, the lesser of both; see `passes.scan`.

        Returns
        -------
        array (K,)
            Negative where the sample is violated.
        """
        inside, room = self.slacks()
        return inside if room is None else np.minimum(inside, room)

    def reach(self, share: float) -> tuple[float, float]:
        """Slack below which so large a share of all samples is expected: from leaving the bounds, from being too wide.

        Where the widths of many samples are the largest one, which is so where noise alone makes them, only those
        that are too wide matter.

        Parameters
        ----------
        share : float
            Of all samples.

        Returns
        -------
        float
            Slack from leaving the bounds.
        float
            Slack from being too wide.
        """
        inside, room = self.slacks()
        least = 10 * TOLERANCE
        wanted = max(float(np.quantile(inside, share)), least)
        width = 0.0 if room is None else float(np.quantile(room, share))
        return wanted, min(width, wanted) if width > 1e-6 else 0.0

    def widen_pool(self, tolerance: float = TOLERANCE, most: int | None = None) -> bool:
        """Let the most violated held samples join the working set.

        Parameters
        ----------
        tolerance : float, optional
            Violation that is accepted, in scaled units; default TOLERANCE.
        most : int, optional
            Samples at most; default twice the unknowns, or a fixed number if that is more.

        Returns
        -------
        bool
            False where there is none to join.
        """
        slack = self.slack()
        slack[self.pool] = np.inf
        outside = np.flatnonzero(slack < -tolerance)
        most = most or max(_JOIN, 2 * (self.r + self.q))
        if len(outside) > most:
            outside = outside[np.argpartition(slack[outside], most)[:most]]
        self.pool = np.concatenate([self.pool, outside])
        return len(outside) > 0

    def containment(self, pool: Index) -> tuple[Array, Array]:
        """Containment (8)(9) of some samples as G ξ >= h.

        Parameters
        ----------
        pool : array of int
            Positions among the held samples.

        Returns
        -------
        array (2 K, r + q)
            G.
        array (2 K,)
            h.
        """
        phi, psi = self.phi[pool], self.psi[pool]
        y, half = self.y[pool], self.half[pool]
        return np.vstack([np.hstack([phi, psi]), np.hstack([-phi, psi])]), np.concatenate([y - half, -y - half])

    def hessian(self, gram: Array, linear: Array, tie_break: float, ridge: float = 1e-10) -> tuple[Array, Array]:
        """Objective of squared widths, plus the tie-break on the centre.

        Parameters
        ----------
        gram : array (q, q)
            Quadratic term of the half-widths.
        linear : array (q,)
            Their linear term.
        tie_break : float
            Weight of the centre, relative to the least diagonal element of `gram`.
        ridge : float, default 1e-10
            Added to the centre's diagonal, for what moves together in every sample.

        Returns
        -------
        array (r + q, r + q)
            H.
        array (r + q,)
            f.
        """
        H = np.zeros((self.r + self.q, self.r + self.q))
        diagonal = np.diagonal(gram)
        weight = tie_break * float(diagonal.min(initial=1.0))
        H[: self.r, : self.r] = weight * (self.centre + ridge * np.eye(self.r))
        H[self.r :, self.r :] = gram + 1e-13 * np.diag(diagonal)
        return H, np.concatenate([-weight * self.target, linear])

    # --- programmes of this row on its working set ---

    def _solve(
        self,
        kind: str,
        objective: Callable[[float, float], tuple[Array, Array]],
        G: Array,
        h: Array,
        lower: Array,
        upper: Array,
        any_solver: bool = False,
    ) -> tuple[Array, str]:
        """Solve a programme whose rows are some for each sample of the pool, from what was active last time.

        objective(factor on the tie-break, ridge) -> H, f. Raises FitError where DAQP, or any solver, gives up.
        """
        fixed, per_sample = len(lower), len(h) // max(len(self.pool), 1)
        start = None
        if kind in self._active:
            known = self._active[kind][fixed:].reshape(per_sample, -1)
            known = known[:, : len(self.pool)]  # the pool grows, but for discards
            start = np.zeros(fixed + len(h), dtype=np.int32)
            start[:fixed] = self._active[kind][:fixed]
            start[fixed:].reshape(per_sample, -1)[:, : known.shape[1]] = known
        for attempt in _ATTEMPTS:
            try:
                answer = solve_qp(*objective(*attempt), G, h, lower, upper, start, any_solver=False)
                break
            except FitError:
                continue
        else:
            if not any_solver:
                raise FitError("DAQP could not solve the quadratic programme")
            answer = solve_qp(*objective(*attempt), G, h, lower, upper)
        self.attempt = attempt
        if answer.active is not None:
            self._active[kind] = answer.active
        return answer.xi, answer.solver

    def solve_quadratic(self) -> str:
        """Solve (10) on the working set.

        Returns
        -------
        str
            Who found it.

        Raises
        ------
        FitError
            No solver found an answer.
        """
        answer, solver = self._solve(
            "quadratic",
            lambda factor, ridge: self.hessian(self.gram, self.linear, factor * TIE_BREAK, ridge),
            *self.containment(self.pool),
            self.lower,
            self.upper,
            any_solver=True,
        )
        self.store(answer)
        return solver

    def solve_regularised(self) -> str:
        """Solve (11) with a little of the squared widths on the working set.

        Returns
        -------
        str
            Who found it.

        Raises
        ------
        FitError
            No solver found an answer.
        """
        size = self.r + self.q

        def objective(factor: float, ridge: float) -> tuple[Array, Array]:
            H, f = self.hessian(self.plain, self.plain_linear, factor * BOUNDED_TIE_BREAK, ridge)
            whole = REGULARISATION * np.eye(size + 1)
            whole[:size, :size] = REGULARISATION * H
            return whole, np.append(REGULARISATION * f, 1.0)

        answer, solver = self._solve(
            "regularised",
            objective,
            *self._rows(self.pool),
            np.append(self.lower, 0.0),
            np.append(self.upper, np.inf),
        )
        self.store(answer[:-1])
        self.limit = max(float(answer[-1]), 0.0)
        self._active["bounded"] = np.delete(self._active["regularised"], size)  # all but δ
        return solver

    def solve_linear(self) -> str:
        """Solve (11) on the working set, by the simplex method.

        Returns
        -------
        str
            Who found it.

        Raises
        ------
        FitError
            There is no optimum.
        """
        if self._simplex is None:
            self._simplex = self._minimax()
        index = self.samples.index[self.pool]
        fresh = self.pool[~np.isin(index, self._known)]
        if len(fresh):
            self._simplex.add(*self._rows(fresh))
            self._known = index
        answer = self._simplex.solve()
        self.store(answer[:-1])
        self.limit = max(float(answer[-1]), 0.0)
        return "HiGHS simplex"

    def least_width(self) -> float:
        """A lower bound of δ, in units of scale: the optimum of (11) on the samples that decide it, then on more.

        Returns
        -------
        float
            In units of scale.

        Raises
        ------
        FitError
            There is no optimum.
        """
        assert self.limit is not None
        inside, room = self.slacks()
        assert room is not None
        few = 2 * (self.r + self.q)
        inside, room = inside[self.pool], room[self.pool]
        least = np.argpartition(room, few)[:few] if len(room) > few else np.arange(len(room))
        decisive = np.union1d(np.flatnonzero(inside < 1e-7), least)
        bound = 0.0
        for pool in (self.pool[decisive], self.pool):
            simplex = self._minimax()
            simplex.add(*self._rows(pool))
            bound = max(bound, float(simplex.solve()[-1]))
            if self.limit <= (1.0 + 2.0 * WIDTH_SLACK) * bound:
                break
        return bound

    def _minimax(self) -> Simplex:
        """Minimise δ, the last unknown."""
        cost = np.append(np.zeros(self.r + self.q), 1.0)
        return Simplex(cost, np.append(self.lower, 0.0), np.append(self.upper, np.inf))

    def duality_gap(self) -> float:
        """How far the squared widths of this row are above the optimum at most, relative to it.

        The tie-break adds at most TIE_BREAK / 4 of them to the optimum of the programme that is solved.

        Returns
        -------
        float
            Relative.
        """
        theta = self.theta[self.free_phi] / (self.unit_phi * self.scale)
        d = self.d[self.free_psi] / (self.unit_psi * self.scale)
        factor, ridge = self.attempt
        H, f = self.hessian(self.gram, self.linear, factor * TIE_BREAK, ridge)
        xi = np.concatenate([theta, d])
        bound = dual_bound(H, f, *self.containment(self.pool), self.lower, self.upper, xi)
        value = float(0.5 * d @ self.gram @ d + self.linear @ d) + self.known
        return _relative_gap(float(0.5 * xi @ H @ xi + f @ xi) - bound, value, factor)

    def _rows(self, pool: Index) -> tuple[Array, Array]:
        """G [ξ δ] >= h: (8), (9) and the limit on the width for samples of the pool."""
        G, h = self.containment(pool)
        width = self.width[pool]
        unit = np.minimum(1.0, 1.0 / width)[:, None]  # δ - width x (ψ d + half) >= 0, scaled to order one
        rows = np.hstack([np.zeros((len(pool), self.r)), -width[:, None] * self.psi[pool], np.ones((len(pool), 1))])
        return (
            np.vstack([np.hstack([G, np.zeros((len(G), 1))]), rows * unit]),
            np.concatenate([h, width * self.half[pool] * unit[:, 0]]),
        )

    def solve_bounded(self) -> str:
        """Least squared widths, then the centre, among the optima of (11).

        Returns
        -------
        str
            Who found it.

        Raises
        ------
        FitError
            There is no optimum.
        """
        assert self.limit is not None
        G, h = self.containment(self.pool)
        width, limit = self.width[self.pool], self.limit
        if limit > 0:
            width, limit = width / limit, 1.0
        G = np.vstack([G, np.hstack([np.zeros((len(width), self.r)), -width[:, None] * self.psi[self.pool]])])
        h = np.concatenate([h, width * self.half[self.pool] - limit])
        try:
            answer, solver = self._solve(
                "bounded",
                lambda factor, ridge: self.hessian(self.plain, self.plain_linear, factor * BOUNDED_TIE_BREAK, ridge),
                G,
                h,
                self.lower,
                self.upper,
                any_solver=self.exact,
            )
            self.store(answer)
            return solver
        except FitError:  # rounding has closed the room of WIDTH_SLACK: as near to the ties as it goes
            before = self.limit
            try:
                solver = self.solve_linear() if self.exact else self.solve_regularised()
            except FitError:
                self.exact = True
                solver = self.solve_linear()
            self.limit = max(before, self.limit * (1.0 + WIDTH_SLACK))
            return solver

    def polish(self) -> None:
        """Solve for the centre again, with the half-widths as they are: the tie-break on its own.

        Beside the squared widths it weighs so little that their rounding shows in the elements.
        """
        if self.r == 0:
            return
        phi, psi = self.phi[self.pool], self.psi[self.pool]
        half = psi @ (self.d[self.free_psi] / (self.unit_psi * self.scale)) + self.half[self.pool]
        y = self.y[self.pool]
        try:
            answer = solve_qp(
                self.centre + self.attempt[1] * np.eye(self.r),
                -self.target,
                np.vstack([phi, -phi]),
                np.concatenate([y - half, -y - half]),
                self.lower[: self.r],
                self.upper[: self.r],
                any_solver=False,
            )
        except FitError:  # the half-widths leave no room at all
            return
        self.theta[self.free_phi] = answer.xi * self.unit_phi * self.scale

    def contradiction(self) -> tuple[int, float] | None:
        """A sample that no elements within the structure can contain.

        Returns
        -------
        (int, float) or None
            Index of the sample, and its distance from the bounds, normalised; None where there is none.

        Raises
        ------
        FitError
            There is no optimum.
        """
        simplex = self._minimax()
        G, h = self.containment(self.pool)
        simplex.add(np.hstack([G, np.ones((len(G), 1))]), h)
        answer = simplex.solve()
        if answer[-1] <= 1e-9:
            return None
        short = h - G @ answer[:-1]
        worst = self.pool[int(np.argmax(short)) % len(self.pool)]
        size = self.width[worst] / (2.0 * self.samples.root_weight[worst])
        return int(self.samples.index[worst]), float(answer[-1] * size * self.scale)


def _relative_gap(above: float, value: float, factor: float = 1.0) -> float:
    """Of squared widths in scaled units; widths below a millionth of the steps themselves are rounding."""
    return max(above, 0.0) / max(value, 1e-12) + factor * TIE_BREAK / 4


class InfeasibleError(FitError):
    """A row cannot contain a transition, whatever its elements within the structure.

    Parameters
    ----------
    row : int
        The row of the model.
    index : int
        Position of the transition.
    distance : float
        How far it stays outside at best, normalised.
    """

    def __init__(self, row: int, index: int, distance: float) -> None:
        super().__init__(f"row {row} cannot contain transition {index}")
        self.row, self.index, self.distance = row, index, distance


class WorkingSet:
    """Candidate on a working set, slack of all samples in one pass, the least slack joins, until none is negative.

    A pass also brings every sample whose slack is small. How far slack can change is bounded by how far the scaled
    unknowns change (the size of a sample is linear in |z|), so while they change less than the slack that was
    brought, no other sample can leave its bounds, and the proof of optimality needs no further pass.

    Parameters
    ----------
    fleet : Fleet
        The data.
    structure : Structure, optional
        As in `fit`.
    excluded : array of int, optional
        Transitions that need not be contained.
    progress : callable, optional
        Called with one line of text per pass.
    """

    def __init__(
        self,
        fleet: Fleet,
        structure: Structure | None = None,
        excluded: Index | None = None,
        progress: Callable[[str], None] | None = None,
    ) -> None:
        self.fleet = fleet
        self.progress = progress or (lambda text: None)
        self.excluded = np.empty(0, dtype=np.intp) if excluded is None else excluded
        self.whole = fleet.N <= 2 * SUBSAMPLE
        stride = 1 if self.whole else fleet.N // SUBSAMPLE
        self.sums, self._first = fleet.moments(stride)
        columns = fleet.columns
        self._terms = (columns.drift, columns.disturbance, columns.noise)
        structure = structure or Structure(fleet.n, fleet.p - fleet.n)
        bounds = structure.stacked(*self._terms)
        self.rows = [Row(i, self.sums, bounds) for i in range(fleet.n)]
        self.solvers: set[str] = set()
        self.rounds, self.passes = 0, 1
        self._reach: Array | None = None  # (2, n)
        self._coupled_gap = 0.0

    def quadratic(self) -> Solution:
        """Solve (10).

        Returns
        -------
        Solution
            With its duality gap.

        Raises
        ------
        FitError
            No solver found an answer; `InfeasibleError` where the structure contradicts a transition.
        """
        coupled = self.sums.coupled is not None
        self._run(
            self._settle_coupled if coupled else lambda rows: self._settle(rows, Row.solve_quadratic, polish=True)
        )
        gap = self._coupled_gap if coupled else self._largest_gap()
        return replace(self._solution(), gap=gap)

    def linear(self) -> Solution:
        """Solve (11), then least sum of squared widths among its optima, then the centre.

        Returns
        -------
        Solution
            With the optimum of every row.

        Raises
        ------
        FitError
            No solver found an answer; `InfeasibleError` where the structure contradicts a transition.
        """
        deltas = np.zeros(self.fleet.n)

        def settle(rows: list[Row]) -> None:
            for row in rows:
                if not row.exact:
                    try:
                        self._settle([row], Row.solve_regularised, polish=True)
                    except InfeasibleError:
                        raise
                    except FitError:
                        row.exact = True
                if row.exact:
                    row.limit = None if row.limit is None else float(deltas[row.i]) / row.scale
                    self._settle([row], Row.solve_linear)
                if row.limit is None:  # nothing unknown: the widths are what the structure says
                    row.limit = float((row.width * row.half).max(initial=0.0))
                deltas[row.i] = row.limit * row.scale
                row.limit *= 1.0 + WIDTH_SLACK
                if row.exact:
                    self._settle([row], Row.solve_bounded, polish=True)

        self._start(settle)
        self._prove(settle)
        again = []
        for row in self.rows:
            if row.unknown:
                least = row.least_width() * row.scale
                self.solvers.add("HiGHS simplex")
                above = deltas[row.i] > (1.0 + WIDTH_SLACK) * least + 1e-13 * row.scale
                deltas[row.i] = min(deltas[row.i], least)
                if above and not row.exact:
                    row.exact = True
                    again.append(row)
        if again:  # the weight beside δ was too large for these rows
            settle(again)
            self._prove(settle)
        return self._solution(deltas)

    def _largest_gap(self) -> float:
        return max((row.duality_gap() for row in self.rows if row.unknown), default=0.0)

    @property
    def weights(self) -> Array | None:
        """Weights (n,) that are constant in time; None where they are not."""
        return self.fleet.weights

    def violation(self, theta: Array, d: Array) -> Array:
        """Largest violation of given elements over all transitions: one pass.

        Parameters
        ----------
        theta : array (r, n)
            Nominal elements, 1/s.
        d : array (q, n)
            Half-widths.

        Returns
        -------
        array (n,)
            In scaled units; 0 where none is violated.
        """
        for row in self.rows:
            row.theta, row.d, row.limit = theta[:, row.i], d[:, row.i], None
        everything = np.full(self.fleet.n, np.inf)
        found = self.fleet.scan(self._candidate(everything, everything, most=1))
        for row, (samples, _) in zip(self.rows, found, strict=True):
            self._hold(row, samples)
        return self._solution().violation

    def _solution(self, delta: Array | None = None) -> Solution:
        for row in self.rows:  # a solver may stop close to what cannot be
            if -float(row.slack().min(initial=0.0)) > 1e-8 and (found := row.contradiction()):
                raise InfeasibleError(row.i, *found)
        return Solution(
            np.column_stack([row.theta for row in self.rows]),
            np.column_stack([row.d for row in self.rows]),
            np.array([max(0.0, -float(row.slack().min(initial=0.0))) for row in self.rows]),
            delta,
            self.rounds,
            self.passes,
            [len(row.pool) for row in self.rows],
            self.solvers,
        )

    # --- all samples ---

    def _run(self, settle: Callable[[list[Row]], None]) -> None:
        self._start(settle)
        self._prove(settle)

    def _start(self, settle: Callable[[list[Row]], None]) -> None:
        """Solve on the first samples."""
        for row, samples in zip(self.rows, self._first, strict=True):
            self._hold(row, samples)
            row.start()
            row.widen_pool(most=4 * (row.r + row.q))
        settle(self.rows)

    def _prove(self, settle: Callable[[list[Row]], None]) -> None:
        """Hold the solution against all samples, and solve again, until it contains them all."""
        if self.whole:
            return
        most = 2 * SUBSAMPLE + self.fleet.N // 500
        share = 0.3 * most / self.fleet.N
        for _ in range(MAX_ROUNDS):
            wanted = np.array([row.reach(share) for row in self.rows]).T
            # the samples held after a pass are those of least slack, so the next reach would shrink: keep the first
            self._reach = wanted = wanted if self._reach is None else np.maximum(wanted, self._reach)
            found = self.fleet.scan(self._candidate(wanted[0], wanted[1], most))
            self.passes += 1
            before = [(row.theta.copy(), row.d.copy(), row.limit) for row in self.rows]
            todo = []
            left = 0
            for row, (samples, _) in zip(self.rows, found, strict=True):
                self._hold(row, samples)
                left += int((row.slack() < -TOLERANCE).sum())
                if row.widen_pool():
                    todo.append(row)
            self.progress(f"pass {self.passes}: {plural(left, 'sample')} outside, working set {self._sizes()}")
            if not todo:
                return
            settle(self.rows if self.sums.coupled is not None else todo)
            moved = [self._moved(row, *old) for row, old in zip(self.rows, before, strict=True)]
            if all(change == 0.0 or change < held for change, (_, held) in zip(moved, found, strict=True)):
                return
        raise FitError(f"the working set did not settle in {MAX_ROUNDS} passes; scale the signals to order one")

    def _candidate(self, reach: Array, room: Array, most: int) -> Candidate:
        limits = [row.limit for row in self.rows]
        limit = None
        if all(value is not None for value in limits):
            limit = np.array([float(value or 0.0) * row.scale for value, row in zip(limits, self.rows, strict=True)])
        return Candidate(
            np.column_stack([row.theta for row in self.rows]),
            np.column_stack([row.d for row in self.rows]),
            self.rows[0].size_unit,
            self.sums.rate_scale,
            limit,
            reach,
            room,
            most,
        )

    def _moved(self, row: Row, theta: Array, d: Array, limit: float | None) -> float:
        """Largest change of any sample's slack, in scaled units, since theta, d and the limit."""
        if limit is not None and row.limit is not None and row.limit < limit * (1.0 - 1e-12):
            return np.inf  # the optimum over more samples is no less, so this is rare
        p = self.fleet.p
        with np.errstate(divide="ignore", invalid="ignore"):
            per_column = np.abs(row.d - d) * np.where(row.size_unit > 0, 1.0 / row.size_unit, 0.0)
            per_column[:p] += np.abs(row.theta - theta)[:p] * np.where(
                row.size_unit[:p] > 0, 1.0 / row.size_unit[:p], 0.0
            )
        drift, disturbance, noise = self._terms
        if drift:  # |c| <= size x ..., by the term of the size that is constant in time
            change = abs(float(row.theta[p] - theta[p]))
            if disturbance:
                per_column[p] += change / row.size_unit[p]
            elif noise:
                per_column[-1] += change * self.sums.dt_max / row.size_unit[-1]
        return float(per_column.max(initial=0.0)) / row.scale * (1.0 + 1e-9)

    def _hold(self, row: Row, samples: Samples) -> None:
        if len(self.excluded):
            samples = samples[~np.isin(samples.index, self.excluded)]
        row.hold(samples, *self._terms)

    def _sizes(self) -> str:
        return "/".join(str(len(row.pool)) for row in self.rows)

    # --- held samples ---

    def _settle(self, rows: list[Row], solve: Callable[[Row], str], polish: bool = False) -> None:
        for row in rows:
            for _ in range(MAX_ROUNDS):
                if row.unknown:
                    self._guarded(row, solve)
                self.rounds += 1
                if row.unknown and row.widen_pool():
                    continue
                if polish and row.unknown:
                    row.polish()
                if not polish or not row.unknown or not row.widen_pool():
                    break
            else:
                raise FitError(f"row {row.i}: no working set after {MAX_ROUNDS} rounds; scale the signals to order one")
            if not row.unknown:
                self._known_row(row)

    def _guarded(self, row: Row, solve: Callable[[Row], str]) -> None:
        try:
            self.solvers.add(solve(row))
        except FitError:
            found = row.contradiction()
            if found is None:
                raise
            raise InfeasibleError(row.i, *found) from None

    def _known_row(self, row: Row) -> None:
        """A row that the structure fixes altogether must contain every sample but for rounding."""
        slack = row.slack() if row.limit is None else row.half - np.abs(row.y)
        worst = int(np.argmin(slack)) if len(slack) else 0
        if len(slack) and slack[worst] < -1e-9:
            size = row.width[worst] / (2.0 * row.samples.root_weight[worst])
            raise InfeasibleError(row.i, int(row.samples.index[worst]), float(-slack[worst] * size * row.scale))

    def _settle_coupled(self, rows: list[Row]) -> None:
        for _ in range(MAX_ROUNDS):
            self._solve_coupled()
            self.rounds += 1
            if not any([row.widen_pool() for row in rows]):
                return
        raise FitError(f"the working set did not settle in {MAX_ROUNDS} rounds; scale the signals to order one")

    def _solve_coupled(self) -> None:
        """(10) with full weights, which couple the rows."""
        assert self.sums.coupled is not None
        rows, q_all = self.rows, len(self.sums.psi_scale)
        keep = np.concatenate([row.i * q_all + row.free_psi for row in rows])
        unit = np.concatenate([row.unit_psi * row.scale for row in rows])
        fixed = np.concatenate([row.fixed_d for row in rows])
        gram = self.sums.coupled[np.ix_(keep, keep)] * np.outer(unit, unit)
        linear = (self.sums.coupled @ fixed)[keep] * unit
        largest = float(np.diagonal(gram).max(initial=1e-300))
        starts = np.concatenate([[0], np.cumsum([row.r + row.q for row in rows])])
        where_d = np.concatenate([np.arange(starts[k] + row.r, starts[k + 1]) for k, row in enumerate(rows)])
        H, f = np.zeros((starts[-1], starts[-1])), np.zeros(starts[-1])
        parts = [row.containment(row.pool) for row in rows]
        G = np.zeros((sum(len(h) for _, h in parts), starts[-1]))
        line = 0
        for k, (row, (block, _)) in enumerate(zip(rows, parts, strict=True)):
            mine = slice(starts[k], starts[k + 1])
            own = (
                np.diagonal(self.sums.coupled)[row.i * q_all + row.free_psi] * (row.unit_psi * row.scale) ** 2 / largest
            )
            H[mine, mine], f[mine] = row.hessian(np.diag(own), np.zeros(row.q), TIE_BREAK)
            G[line : line + len(block), mine] = block
            line += len(block)
        H[np.ix_(where_d, where_d)] = gram / largest + 1e-13 * np.diag(np.diagonal(gram) / largest)
        f[where_d] = linear / largest
        lower, upper = (np.concatenate([getattr(row, side) for row in rows]) for side in ("lower", "upper"))
        h = np.concatenate([h for _, h in parts])
        try:
            answer = solve_qp(H, f, G, h, lower, upper)
        except FitError:
            for row in rows:
                if found := row.contradiction():
                    raise InfeasibleError(row.i, *found) from None
            raise
        self.solvers.add(answer.solver)
        for k, row in enumerate(rows):
            row.store(answer.xi[starts[k] : starts[k + 1]])
        xi, d = answer.xi, answer.xi[where_d]
        above = float(0.5 * xi @ H @ xi + f @ xi) - dual_bound(H, f, G, h, lower, upper, xi)
        value = (0.5 * d @ gram @ d + linear @ d + 0.5 * fixed @ self.sums.coupled @ fixed) / largest
        self._coupled_gap = _relative_gap(above, float(value))
