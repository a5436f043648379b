# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Is a fit the optimum? Random problems, each against two independent solvers that see the whole problem at once.

python benchmarks/optimum.py              # 500 problems, both criteria; about half an hour on two cores
python benchmarks/optimum.py --count 60   # what the tests run
python benchmarks/optimum.py --seed 17    # one problem, in words
python benchmarks/optimum.py --knots --count 100    # with two to four knots of the first state

A problem counts where the two solvers agree to 1e-7. The excess is how far the objective of `fit` is above theirs,
relative to the larger of the optimum and 1e-9 of the largest step (squared and summed for eq. (10)), less what the
rounding of the verdict itself takes: a width of 16 ulps of the largest state.
"""

from __future__ import annotations

import argparse
import itertools
import time
import warnings
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from uncertain_lti import OperatingPoint, Transient
from uncertain_lti.base.errors import FitError
from uncertain_lti.identification import fit
from uncertain_lti.identification.assembly import assemble
from uncertain_lti.identification.problem import Problem, Regimes
from uncertain_lti.identification.structure import Structure
from uncertain_lti.model.schedule import Axis, Schedule

AGREE = 1e-7
"""Relative difference of two optima up to which they are one."""
LEAST = 1e-9
"""An envelope narrower than this share of the largest step is rounding."""


@dataclass
class Case:
    """A problem: what `fit` takes, and how it was drawn in words. A point is that of the transient's signals."""

    transient: Transient
    options: dict[str, Any]
    words: list[str] = field(default_factory=list)
    point: OperatingPoint | None = None

    def assembled(self) -> Problem:
        """The transitions that `fit` sees."""
        point = self.point or OperatingPoint.identity(self.transient.x.shape[1], self.transient.u.shape[1])
        schedule = self.options.get("schedule")
        regimes = schedule and Regimes(schedule, (0,))
        return assemble([self.transient], point, self.options["weights"], self.options["additive"], regimes=regimes)


def case(seed: int) -> Case:
    """A problem of a kind that machines make: n to 8, m to 4, every weight, term, structure and scale."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 9)), int(rng.integers(0, 5))
    additive = str(rng.choice(["none", "disturbance", "noise", "both"]))
    count = int(rng.integers(4 * (n + m + 2), 400))
    jitter = float(rng.choice([0.0, 0.3]))
    noise = float(rng.choice([0.0, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2]))
    spread = float(rng.choice([0.0, 1e-4, 1e-2, 0.1]))
    words = [f"n {n}", f"m {m}", f"N {count}", additive, f"noise {noise:g}", f"spread {spread:g}"]

    A = -np.diag(rng.uniform(0.5, 8, n)) + rng.uniform(-1, 1, (n, n))
    B = rng.uniform(-3, 3, (n, m))
    u = np.repeat(rng.uniform(-1, 1, (count // 12 + 1, m)), 12, axis=0)[: count + 1]
    if m == 0 or rng.random() < 0.2:  # nothing but the controls moves it, so it is drawn again now and then
        restart = 25
    else:
        restart = 0
    if m > 1 and rng.random() < 0.3:
        apart = float(rng.choice([0.0, 1e-9, 1e-6, 1e-3]))
        u[:, 1] = u[:, 0] + apart * rng.standard_normal(count + 1)
        words.append(f"controls {apart:g} apart")
    dt = np.rint(0.02e9 * (1 + jitter * rng.uniform(-1, 1, count))).astype(np.int64)
    x = np.empty((count + 1, n))
    x[0] = rng.uniform(-1, 1, n)
    for k in range(count):
        if restart and k % restart == 0:
            x[k] = rng.uniform(-1, 1, n)
        drawn = 1 + spread * rng.uniform(-1, 1, (n, n + m))
        x[k + 1] = x[k] + dt[k] * 1e-9 * ((np.hstack([A, B]) * drawn) @ np.concatenate([x[k], u[k]]))
    x += noise * rng.standard_normal(x.shape)
    if rng.random() < 0.2:
        step = float(rng.choice([1e-4, 1e-3, 1e-2]))
        x, u = np.round(x / step) * step, np.round(u / 0.05) * 0.05
        words.append(f"quantised {step:g}")
    if n > 1 and rng.random() < 0.1:
        x[1:, 1], x[0, 1] = x[:-1, 0], x[0, 0]
        words.append("a lag")
    if n > 2 and rng.random() < 0.1:
        x[:, 2] = x[:, 0] + float(rng.choice([1e-8, 1e-5])) * rng.standard_normal(count + 1)
        words.append("states near one another")
    if m and rng.random() < 0.1:
        u[:, -1] = 0.0
        words.append("a control at 0")
    if rng.random() < 0.05:
        x[:, 0] = 0.0
        words.append("a state at 0")
    if rng.random() < 0.5:
        powers = rng.uniform(-6, 6, n + m)
        x, u = x * 10.0 ** powers[:n], u * 10.0 ** powers[n:]
        words.append("scales 1e-6 to 1e6")
    kind = str(rng.choice(["ones", "per state", "per sample", "full"]))
    size = 10.0 ** rng.uniform(-2, 2, n) / np.maximum(np.abs(x).max(axis=0), 1e-9) if rng.random() < 0.7 else np.ones(n)
    weights: Any = None
    if kind == "per state":
        weights = size**2
    elif kind == "per sample":
        weights = size**2 * rng.uniform(0.1, 10, (count, n))
    elif kind == "full":
        root = rng.standard_normal((count, n, n))
        weights = (root @ root.transpose(0, 2, 1) + 0.1 * np.eye(n)) * np.outer(size, size)
    words.append(f"weights {kind}")
    structure = None
    if rng.random() < 0.3:
        structure = _structure(rng, n, m, np.hstack([A, B]) * (np.abs(x).max() <= 2))
        words.append("structure")
    t = np.concatenate([[0], np.cumsum(dt)])
    options = {"weights": weights, "additive": additive, "structure": structure}
    return Case(Transient(t, x, u, name=f"case {seed}"), options, words)


def with_knots(seed: int) -> Case:
    """The same problem without a structure, with knots of the first state, if that moves."""
    drawn, rng = case(seed), np.random.default_rng([seed, 1])
    count = int(rng.integers(2, 5))
    knots = np.quantile(drawn.transient.x[:, 0], np.linspace(0.0, 1.0, count))
    options = drawn.options | {"structure": None}
    if (np.diff(knots) > 0.0).all():
        options["schedule"] = Schedule((Axis("x1", knots=tuple(knots.tolist())),))
        drawn.words.append(f"{count} knots")
    return Case(drawn.transient, options, drawn.words)


def _structure(rng: np.random.Generator, n: int, m: int, nominal: np.ndarray) -> Structure:
    """Some nominal elements fixed near what they are, some half-widths fixed to 0 or bounded, some signs."""
    nan = np.nan
    fixed = np.where(rng.random((n, n + m)) < 0.1, nominal, nan)
    signs = np.where(rng.random((n, n + m)) < 0.2, 0.0, nan)
    lower = np.where((nominal > 0) & np.isnan(fixed), signs, nan)
    half = np.where(rng.random((n, n + m)) < float(rng.choice([0.1, 0.5])), 0.0, nan)
    least = np.where((rng.random((n, n + m)) < 0.1) & np.isnan(half), 1e-3, nan)
    return Structure(
        n,
        m,
        fixed={"A": fixed[:, :n], "B": fixed[:, n:], "dA": half[:, :n], "dB": half[:, n:]},
        lower={"A": lower[:, :n], "B": lower[:, n:], "dA": least[:, :n], "dB": least[:, n:]},
    )


# --- the whole problem, by solvers that the fit does not use in this way ---


@dataclass
class Row:
    """One row over all samples, in coordinates of order one around its least squares: θ = θ0 + T η, d = unit δ."""

    phi: np.ndarray
    psi: np.ndarray
    y: np.ndarray
    G: np.ndarray  # rows on [η d] that the structure asks for, G [η d] >= h
    h: np.ndarray
    unit: np.ndarray
    scale: float
    floor: float  # widths below it are rounding


def rows(problem: Problem, structure: Structure | None) -> list[Row]:
    """The rows of (8) and (9)."""
    n, p, columns = problem.n, problem.p, problem.columns
    of_block, _ = (structure or Structure(n, p - n)).unknowns(columns.names)
    bounds = [np.tile(b, (columns.count, 1)) for b in of_block]
    dt = problem.dt[:, None]
    phi, psi = problem.phi() * dt, problem.psi() * dt
    made = []
    for i in range(n):
        low, high, d_low, d_high = (b[:, i] for b in bounds)
        y = problem.x_next[i] - problem.z[i]
        free = np.flatnonzero((low < high) & phi.any(axis=0))
        fixed = np.where(low == high, low, 0.0)
        y = y - phi @ fixed
        floor = LEAST * float(np.abs(problem.x_next[i] - problem.z[i]).max())
        size = np.sqrt(np.mean(phi[:, free] ** 2, axis=0))
        left, values, right = np.linalg.svd(phi[:, free] / size, full_matrices=False)
        keep = values > 1e-13 * values.max(initial=0.0)
        T = (right[keep].T / values[keep]) * np.sqrt(len(y)) / size[:, None]
        theta0 = T @ (left[:, keep].T @ y) / np.sqrt(len(y))
        # twice, as the first leaves the rounding of large numbers
        y = y - phi[:, free] @ theta0
        again = T @ (left[:, keep].T @ y) / np.sqrt(len(y))
        theta0, y = theta0 + again, y - phi[:, free] @ again
        scale = max(float(np.sqrt(np.mean(y**2))), 1e-3 * floor, 1e-300)
        unit = np.sqrt(np.mean(psi**2, axis=0))
        unit = np.where(unit > 0, 1.0 / np.where(unit > 0, unit, 1.0), 0.0)
        r, q = T.shape[1], psi.shape[1]
        G, h = [], []
        for limit, sign in ((low, 1.0), (high, -1.0)):
            there = np.isfinite(limit[free])
            block = sign * T[there] * scale
            value = sign * (limit[free][there] - theta0[there])
            norm = np.maximum(np.abs(block).max(axis=1, initial=0.0), 1e-300)
            G.append(np.hstack([block / norm[:, None], np.zeros((there.sum(), q))]))
            h.append(value / norm)
        for limit, sign in ((np.where(unit > 0, d_low, 0.0), 1.0), (d_high, -1.0)):
            there = np.isfinite(limit) & ((unit > 0) | (sign > 0))
            G.append(np.hstack([np.zeros((there.sum(), r)), sign * np.eye(q)[there]]))
            h.append(sign * limit[there] / np.where(unit > 0, unit * scale, 1.0)[there])
        made.append(
            Row(
                left[:, keep] * np.sqrt(len(y)),
                psi * unit,
                y / scale,
                np.vstack(G),
                np.concatenate(h),
                unit,
                scale,
                floor,
            )
        )
    return made


def _contained(row: Row) -> tuple[np.ndarray, np.ndarray]:
    G = np.vstack([np.hstack([row.phi, row.psi]), np.hstack([-row.phi, row.psi]), row.G])
    return G, np.concatenate([row.y, -row.y, row.h])


def linear_optima(problem: Problem, structure: Structure | None) -> list[tuple[float, float]]:
    """δ of (11) per row, by HiGHS' simplex method and by Clarabel; NaN where one gives none."""
    found = []
    for i, row in enumerate(rows(problem, structure)):
        root = np.sqrt(problem.row_weights()[:, i])
        least = root.max() * row.floor
        unit = row.scale * np.sqrt(np.mean(root**2))
        width = 2.0 * row.psi * (root * row.scale / unit)[:, None]
        G, h = _contained(row)
        G = np.vstack(
            [
                np.hstack([G, np.zeros((len(G), 1))]),
                np.hstack([np.zeros((len(width), row.phi.shape[1])), -width, np.ones((len(width), 1))]),
            ]
        )
        h = np.concatenate([h, np.zeros(len(width))])
        cost = np.zeros(G.shape[1])
        cost[-1] = 1.0
        pair = [solver(np.zeros((len(cost), len(cost))), cost, G, h) for solver in (_simplex, _clarabel)]
        found.append((*(v * unit for v in pair), least))
    return found


def quadratic_optimum(problem: Problem, structure: Structure | None) -> tuple[float, float, float]:
    """Value of (10), all rows, by Clarabel and by PIQP; NaN where one gives none. The last is what is rounding."""
    made = rows(problem, structure)
    psi = problem.psi() * problem.dt[:, None]
    n = problem.n
    if problem.weights.ndim < 3:
        total, floor = np.zeros(2), 0.0
        for i, row in enumerate(made):
            weight = problem.row_weights()[:, i]
            gram = 4.0 * (row.psi * weight[:, None]).T @ row.psi / weight.sum()
            G, h = _contained(row)
            r = row.phi.shape[1]
            H = np.zeros((G.shape[1], G.shape[1]))
            H[r:, r:] = 2.0 * gram
            pair = [solver(H, np.zeros(len(H)), G, h) for solver in (_clarabel, _piqp)]
            total += np.array(pair) * row.scale**2 * weight.sum()
            floor += weight.sum() * row.floor**2
        return float(total[0]), float(total[1]), floor
    starts = np.concatenate([[0], np.cumsum([row.phi.shape[1] + row.psi.shape[1] for row in made])])
    H, G, h, floor = np.zeros((starts[-1], starts[-1])), [], [], 0.0
    where = [np.arange(starts[i] + row.phi.shape[1], starts[i + 1]) for i, row in enumerate(made)]
    for i, j in itertools.product(range(n), range(n)):
        cross = (psi * problem.weights[:, i, j][:, None]).T @ psi
        H[np.ix_(where[i], where[j])] = (
            8.0 * cross * np.outer(made[i].unit * made[i].scale, made[j].unit * made[j].scale)
        )
    largest = float(np.diagonal(H).max(initial=0.0)) or 1.0
    for i, row in enumerate(made):
        block, limit = _contained(row)
        G.append(np.zeros((len(block), starts[-1])))
        G[-1][:, starts[i] : starts[i + 1]] = block
        h.append(limit)
        floor += problem.weights[:, i, i].sum() * row.floor**2
    pair = [s(H / largest, np.zeros(len(H)), np.vstack(G), np.concatenate(h)) * largest for s in (_clarabel, _piqp)]
    return pair[0], pair[1], floor


def _simplex(H: np.ndarray, f: np.ndarray, G: np.ndarray, h: np.ndarray) -> float:
    import highspy

    highs = highspy.Highs()
    for option, value in (
        ("output_flag", False),
        ("solver", "simplex"),
        ("primal_feasibility_tolerance", 1e-10),
        ("dual_feasibility_tolerance", 1e-10),
        ("time_limit", 20.0),
    ):
        highs.setOptionValue(option, value)
    inf, size = highspy.kHighsInf, len(f)
    for c in f:
        highs.addVar(-inf, inf)
        highs.changeColCost(highs.getNumCol() - 1, c)
    highs.addRows(
        len(h),
        h,
        np.full(len(h), inf),
        G.size,
        np.arange(len(h), dtype=np.int32) * size,
        np.tile(np.arange(size, dtype=np.int32), len(h)),
        np.ascontiguousarray(G).ravel(),
    )
    highs.run()
    optimal = highs.getModelStatus() == highspy.HighsModelStatus.kOptimal
    return float(highs.getInfo().objective_function_value) if optimal else np.nan


def _clarabel(H: np.ndarray, f: np.ndarray, G: np.ndarray, h: np.ndarray) -> float:
    import clarabel
    import scipy.sparse as sparse

    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
    settings.time_limit = 20.0
    settings.max_iter = 300
    rows_, upper = sparse.csc_matrix(-G), -h
    answer = clarabel.DefaultSolver(
        sparse.csc_matrix(np.triu(H)), f, rows_, upper, [clarabel.NonnegativeConeT(len(h))], settings
    ).solve()
    return answer.obj_val if str(answer.status) in ("Solved", "AlmostSolved") else np.nan


def _piqp(H: np.ndarray, f: np.ndarray, G: np.ndarray, h: np.ndarray) -> float:
    import piqp
    import scipy.sparse as sparse

    solver = piqp.SparseSolver()
    solver.settings.eps_abs = solver.settings.eps_rel = 1e-11
    solver.settings.max_iter = 500
    solver.setup(sparse.csc_matrix(H), f, None, None, sparse.csc_matrix(G), h, None, None, None)
    status = solver.solve()
    return float(solver.result.info.primal_obj) if status == piqp.PIQP_SOLVED else np.nan


# --- the comparison ---


@dataclass
class Comparison:
    """A fit beside its optimum.

    excess (rows,): objective above the optimum, relative; NaN where the solvers do not agree. gap: what was printed,
    None where it was not. error: what `fit` refused it with.
    """

    criterion: str
    seconds: float
    excess: np.ndarray
    gap: float | None = None
    error: str | None = None
    optimum: np.ndarray | None = None
    true_gap: float = np.nan


def compare(drawn: Case, criterion: str) -> Comparison:
    """`fit` against both solvers."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        problem, structure = drawn.assembled(), drawn.options["structure"]
        began = time.process_time()
        model, error = None, None
        try:
            model = fit(drawn.transient, criterion, describe_data=False, **drawn.options)
        except FitError as refused:
            error = str(refused)
        seconds = time.process_time() - began
        if error is not None and "at rest" in error:
            return Comparison(criterion, seconds, np.empty(0), error=error)
        found = linear_optima(problem, structure) if criterion == "lp" else [quadratic_optimum(problem, structure)]
    one, other, floor = np.array(found).T
    agreed = np.abs(one - other) <= AGREE * np.maximum(np.maximum(np.abs(one), np.abs(other)), floor)
    optimum = np.where(agreed, np.minimum(one, other), np.nan)
    if model is not None and any(data.tied_to is not None for data in model.block_data):
        optimum, agreed = np.full(len(optimum), np.nan), np.zeros(len(agreed), dtype=bool)  # it has fewer unknowns
    if model is None:
        return Comparison(criterion, seconds, np.full(len(optimum), np.nan), error=error, optimum=optimum)
    objective = np.atleast_1d(np.asarray(model.fit_summary["objective"]))
    roots = np.sqrt(problem.row_weights())
    rounding = 16 * np.finfo(float).eps * np.abs(problem.x_next.T).max(axis=0)
    if criterion == "lp":
        reachable = optimum + roots.max(axis=0) * rounding
    else:
        reachable = (np.sqrt(np.maximum(optimum, 0.0)) + np.sqrt(np.sum((roots * rounding) ** 2))) ** 2
    excess = (objective - reachable) / np.maximum(np.maximum(optimum, floor), 1e-300)
    summary = model.fit_summary
    gap = summary["optimality_gap"]
    true = (objective - optimum) / np.maximum(np.maximum(objective, floor), 1e-300)
    true = np.max(true[agreed], initial=-np.inf)
    return Comparison(criterion, seconds, excess, gap, None, optimum, float(true))


def main() -> int:
    """Run the problems; exit status 1 where one is above its optimum or no answer was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", type=int, help="this problem alone")
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--knots", action="store_true", help="scheduled on the first state")
    options = parser.parse_args()
    seeds = range(options.start, options.start + options.count) if options.seed is None else [options.seed]
    compared, above, refused, low = Counter(), 0, Counter(), 0
    worst: dict[str, float] = {}
    spent, slowest = 0.0, (0.0, 0)
    for seed, criterion in itertools.product(seeds, ("qp", "lp")):
        drawn = with_knots(seed) if options.knots else case(seed)
        c = compare(drawn, criterion)
        spent += c.seconds
        slowest = max(slowest, (c.seconds, seed))
        known = int(np.isfinite(c.excess).sum())
        compared[c.criterion] += known > 0
        most = float(np.nanmax(c.excess)) if known else np.nan
        if known:
            worst[c.criterion] = max(worst.get(c.criterion, -np.inf), most)
        if c.error is not None and c.optimum is not None and np.isfinite(c.optimum).all():
            refused[c.error[:60]] += 1
        printed = "none" if c.gap is None else f"{c.gap:.1e}"
        wrong = known and c.gap is not None and not c.gap >= c.true_gap - 2 * AGREE
        low += bool(wrong)
        if most > 1e-6:
            above += 1
        if most > 1e-6 or c.error or wrong or c.seconds > 5 or options.seed is not None:
            words = ", ".join(drawn.words)
            solved = c.optimum is not None and np.isfinite(c.optimum).all()
            print(
                f"{seed} {c.criterion}: excess {most:.1e}, gap {printed}{' TOO LOW' if wrong else ''}, "
                f"{c.seconds:.1f} s, "
                f"{words}"
                + (f"\n    refused ({'solved by both' if solved else 'not solved'}): {c.error}" if c.error else ""),
                flush=True,
            )
    print(f"{len(seeds)} problems; compared {dict(compared)}, more than 1e-6 above: {above}, largest excess {worst}")
    print(f"optimality gap below the true one: {low}; refused though solved by both: {dict(refused)}")
    print(f"{spent:.0f} s in fit; slowest {slowest[0]:.1f} s (problem {slowest[1]})")
    return int(above > 0 or low > 0)


if __name__ == "__main__":
    raise SystemExit(main())
