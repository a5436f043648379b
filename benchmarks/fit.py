# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Identification against its peers, side by side in one run: time as ratios, the same optimum, nothing outside.

python benchmarks/fit.py million      # fit() on 1e6 transitions, n = 5, m = 4, against numpy.linalg.lstsq
python benchmarks/fit.py scheduled    # the same with 5 knots, against lstsq on the same 45 and 50 regressors
python benchmarks/fit.py joint        # 1e5 transitions, against the joint problem in cvxpy with Clarabel
python benchmarks/fit.py pyipm        # n = 10, m = 3, 1e5 transitions, against PyIPM (pip install PyIPM)
python benchmarks/fit.py large        # n = 50, m = 10, 1e5 transitions
python benchmarks/fit.py coupled      # off-diagonal weights, 1e5 transitions
python benchmarks/fit.py growth       # 1e4 to 1e7 transitions; writes a figure
python benchmarks/fit.py disk         # 2e7 transitions from disk, with peak memory
python benchmarks/fit.py all --quick  # everything, a tenth of the size
"""

from __future__ import annotations

import argparse
import os
import pickle
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from measure import best, peak_memory, table

from uncertain_lti.identification import fit
from uncertain_lti.identification.archive import write_cache
from uncertain_lti.identification.fitting import fit_fleet
from uncertain_lti.identification.fleet import Fleet
from uncertain_lti.identification.problem import Columns, Problem, solve_as_written
from uncertain_lti.model.schedule import Axis, Schedule
from uncertain_lti.plants.leibov import leibov2006
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.signal_map import Signal, SignalMap

DT = 0.025


def drawn(N, seed=0, noise=0.0, model=None):
    """N independent transitions of matrices drawn inside their intervals at each step: (x, u, x_next)."""
    rng = np.random.default_rng(seed)
    model = model or leibov2006()
    x, u = rng.uniform(-1, 1, (N, model.n)), rng.uniform(-1, 1, (N, model.m))
    z = np.hstack([x, u])
    nominal, spread = np.hstack([model.A, model.B]), np.hstack([model.dA, model.dB])
    x_next = x.copy()
    for i in range(model.n):
        for j in range(z.shape[1]):
            x_next[:, i] += DT * (nominal[i, j] + spread[i, j] * rng.uniform(-1, 1, N)) * z[:, j]
    if noise:
        x = x + noise * rng.standard_normal(x.shape)
        x_next += noise * rng.standard_normal(x.shape)
    return x, u, x_next


def excited(N, n, m, seed=0):
    """Random excitation of a random interval plant."""
    rng = np.random.default_rng(seed)
    A = -np.diag(rng.uniform(1, 10, n)) + rng.uniform(-1, 1, (n, n))
    from uncertain_lti import UncertainLTI

    plant = UncertainLTI(A, rng.uniform(-3, 3, (n, m)), rng.uniform(0, 1, (n, n)), rng.uniform(0, 1, (n, m)))
    return drawn(N, seed + 1, model=plant)


def problem_of(x, u, x_next, additive="none", weights=None):
    """Arrays as an identification problem, as `fit` assembles them."""
    n, N = x.shape[1], len(x)
    columns = Columns.of(additive, True)
    z = np.hstack([x, u]).T.copy()
    origin = np.zeros(N, dtype=np.intp)
    weights = np.ones(n) if weights is None else weights
    return Problem(z, x_next.T.copy(), np.full(N, DT), weights, source=origin, k=np.arange(N), columns=columns)


def names(n, m):
    """Signals without topics."""
    return SignalMap(
        tuple(Signal(f"x{i}", "", f"x{i}") for i in range(n)), tuple(Signal(f"u{j}", "", f"u{j}") for j in range(m))
    )


def outside(problem, model):
    """Samples outside by `UncertainLTI.bounds`, independent of the fit."""
    lower, upper = model.bounds(problem.z.T[:, : problem.n], problem.z.T[:, problem.n :], problem.dt)
    return int((~((lower <= problem.x_next.T) & (problem.x_next.T <= upper))).any(axis=1).sum())


def solve(problem, criterion):
    """Fit, repair and tie-breaks included; the messages in words are not."""
    signals = names(problem.n, problem.p - problem.n)
    return fit_fleet(Fleet.of(problem), signals, criterion, dt_median=DT)


def beside_least_squares(transient, regressors, rate, additive, runs, schedule=None):
    """Rows of a table: the public call against least squares on the same regressors, which only finds a centre.

    CPU time of all threads, the two in turn, the least of several: the machine may do other work.
    """
    for criterion in ("qp", "lp"):
        peer, ours = np.inf, np.inf
        for _ in range(runs):
            began = time.process_time()
            np.linalg.lstsq(regressors, rate, rcond=None)
            between = time.process_time()
            model = fit(transient, criterion, additive=additive, schedule=schedule)
            ours, peer = min(ours, time.process_time() - between), min(peer, between - began)
        lower, upper = model.bounds(transient.x[:-1], transient.u[:-1], transient.dt)
        left = int((~((lower <= transient.x[1:]) & (transient.x[1:] <= upper))).any(axis=1).sum())
        yield [
            additive, criterion, str(regressors.shape[1]), f"{peer:.3f} s", f"{ours:.3f} s", f"{ours / peer:.2f}",
            str(model.fit_summary["solver"]["passes"]), f"{model.fit_summary['optimality_gap']:.0e}", str(left),
        ]  # fmt: skip


BESIDE = [
    "noise", "additive", "criterion", "regressors", "lstsq", "fit()", "ratio", "passes", "optimality gap", "outside",
]  # fmt: skip


def million(scale):
    """One recording of a plant whose matrices do not change."""
    N = int(1e6 * scale)
    clean, rows = recorded(N), []
    for noise, kinds in ((0.0, ["none"]), (1e-4, ["noise", "disturbance", "both"])):
        x = clean.x + noise * np.random.default_rng(1).standard_normal(clean.x.shape)
        z, rate = np.hstack([x[:-1], clean.u[:-1]]), np.diff(x, axis=0) / DT
        for additive in kinds:
            beside = beside_least_squares(Transient(clean.t_ns, x, clean.u), z, rate, additive, 4)
            rows += [[f"{noise:g}", *row] for row in beside]
    table(f"fit() on a recording of {N} transitions, n = 5, m = 4: CPU time", BESIDE, rows)


def recorded(N, seed=0, schedule=None):
    """A recording of the published matrices, drawn inside their intervals at each step.

    With a schedule on a control they are weaker at one end of it than at the other, and the state at rest moves.
    """
    rng = np.random.default_rng(seed)
    model = leibov2006()
    nominal, spread = np.hstack([model.A, model.B]), np.hstack([model.dA, model.dB])
    u = np.repeat(rng.uniform(-1, 1, (N // 15 + 1, model.m)), 15, axis=0)[: N + 1]
    x = np.empty((N + 1, model.n))
    x[0] = 0.1
    strength, drift = np.ones(N + 1), np.zeros(N + 1)
    if schedule is not None:
        blocks = np.arange(schedule.blocks) / schedule.blocks
        strength, drift = np.array([0.8 + 0.4 * blocks**2, 0.2 * blocks]) @ schedule.weights(u[:, :1].T)
    for k in range(N):
        elements = nominal + spread * rng.uniform(-1, 1, spread.shape)
        x[k + 1] = x[k] + DT * (strength[k] * (elements @ np.concatenate([x[k], u[k]])) + drift[k])
    return Transient(np.arange(N + 1, dtype=np.int64) * round(DT * 1e9), x, u)


def scheduled(scale):
    """As `million`, of a plant whose matrices change with a control, fitted with five knots."""
    N, knots = int(1e6 * scale), np.linspace(-1, 1, 5)
    schedule = Schedule((Axis("u1", knots=tuple(knots.tolist())),))
    clean, rows = recorded(N, schedule=schedule), []
    for noise, kinds in ((0.0, ["disturbance"]), (1e-4, ["noise", "both"])):
        x = clean.x + noise * np.random.default_rng(1).standard_normal(clean.x.shape)
        rate, weights = np.diff(x, axis=0) / DT, schedule.weights(clean.u[:-1, :1].T)
        for additive in kinds:
            drift = [np.ones((N, 1))] if additive != "noise" else []
            z = np.hstack([x[:-1], clean.u[:-1], *drift])
            regressors = np.hstack([w[:, None] * z for w in weights])
            beside = beside_least_squares(Transient(clean.t_ns, x, clean.u), regressors, rate, additive, 2, schedule)
            rows += [[f"{noise:g}", *row] for row in beside]
    table(f"fit() with 5 knots on {N} transitions, n = 5, m = 4: CPU time", BESIDE, rows)


def joint(scale):
    """Against the problem as written, all rows, in cvxpy with Clarabel."""
    import cvxpy as cp

    N = int(1e5 * scale)
    problem = problem_of(*drawn(N))
    rows = []
    for criterion in ("qp", "lp"):
        ours, model = best(lambda c=criterion: solve(problem, c))
        peer, (_, _, objective) = best(lambda c=criterion: solve_as_written(problem, c, cp.CLARABEL), 1)
        difference = np.max(np.abs(np.asarray(model.fit_summary["objective"]) / objective - 1))
        rows.append([criterion, f"{peer:.1f} s", f"{ours:.3f} s", f"{peer / ours:.0f}", f"{difference:.0e}"])
        rows[-1].append(str(outside(problem, model)))
    header = ["criterion", "cvxpy", "ours", "times faster", "difference of objectives", "outside"]
    table(f"{N} transitions, n = 5, m = 4, against cvxpy with Clarabel", header, rows)


def pyipm(scale):
    """Against PyIPM on the same rows; its linear programme minimises the mean width."""
    try:
        import cvxopt
        from PyIPM import IPM
    except ImportError:
        print("PyIPM is not installed here (pip install PyIPM); this comparison is left out")
        return
    N = int(1e5 * scale)
    x, u, x_next = excited(N, 10, 3)
    problem = problem_of(x, u, x_next)
    z, rate = np.hstack([x, u]), (x_next - x) / DT

    cvxopt.solvers.options["show_progress"] = False

    def peer():
        for i in range(10):
            IPM(polynomial_degree=1).fit(z, rate[:, i])

    slow, _ = best(peer, 1)
    rows = []
    for criterion in ("qp", "lp"):
        ours, model = best(lambda c=criterion: solve(problem, c))
        rows.append([criterion, f"{slow:.1f} s", f"{ours:.3f} s", f"{slow / ours:.0f}", str(outside(problem, model))])
    table(f"{N} transitions, n = 10, m = 3, ten rows", ["criterion", "PyIPM", "ours", "times faster", "outside"], rows)


def large(scale):
    """Many states."""
    N = int(1e5 * scale)
    problem = problem_of(*excited(N, 50, 10))
    rows = []
    for criterion in ("qp", "lp"):
        ours, model = best(lambda c=criterion: solve(problem, c), 1)
        rows.append(
            [criterion, f"{ours:.1f} s", f"{model.fit_summary['optimality_gap']:.0e}", str(outside(problem, model))]
        )
    table(f"{N} transitions, n = 50, m = 10", ["criterion", "ours", "optimality gap", "outside"], rows)


def coupled(scale):
    """Full weights per sample couple the rows of (10)."""
    N = int(1e5 * scale)
    rng = np.random.default_rng(0)
    root = rng.standard_normal((N, 5, 5))
    weights = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(5)
    problem = problem_of(*drawn(N), weights=weights)
    ours, model = best(lambda: solve(problem, "qp"), 1)
    rows = [[f"{ours:.2f} s", f"{model.fit_summary['optimality_gap']:.0e}", str(outside(problem, model))]]
    table(f"{N} transitions, n = 5, m = 4, full W(t_k)", ["ours", "optimality gap", "outside"], rows)


def growth(scale):
    """Time against the number of transitions."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    sizes = [int(s * scale) for s in (1e4, 3e4, 1e5, 3e5, 1e6, 3e6, 1e7)]
    times = {"qp": [], "lp": [], "lstsq": []}
    rows = []
    for N in sizes:
        x, u, x_next = drawn(N)
        problem = problem_of(x, u, x_next)
        z, rate = np.hstack([x, u]), (x_next - x) / DT
        times["lstsq"].append(best(lambda z=z, rate=rate: np.linalg.lstsq(z, rate, rcond=None), 3)[0])
        for criterion in ("qp", "lp"):
            times[criterion].append(best(lambda c=criterion, p=problem: solve(p, c), 2)[0])
        rows.append([str(N), *(f"{times[name][-1]:.3f} s" for name in ("lstsq", "qp", "lp"))])
    table("growth with the number of transitions, n = 5, m = 4", ["transitions", "lstsq", "qp", "lp"], rows)
    figure = Figure(figsize=(6, 4), layout="constrained")
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    for (name, values), colour in zip(times.items(), ("#0072B2", "#D55E00", "#000000"), strict=True):
        axis.loglog(sizes, values, marker="o", color=colour, label={"qp": "(10)", "lp": "(11)"}.get(name, name))
    axis.set_xlabel("transitions")
    axis.set_ylabel("time [s]")
    axis.grid(alpha=0.3, which="both")
    axis.legend()
    path = Path("benchmark-output")
    path.mkdir(exist_ok=True)
    figure.savefig(path / "growth.png", dpi=120)
    print(f"figure: {path / 'growth.png'}")


def disk(scale):
    """More than memory: arrays on disk, passes block by block, in a process whose peak memory is measured."""
    N, parts = int(2e7 * scale), 20
    with tempfile.TemporaryDirectory() as folder:
        for stage in ("write", "fit"):
            code = (
                f"import sys; sys.path.insert(0, {os.path.dirname(os.path.abspath(__file__))!r}); "
                f"import fit; fit.disk_{stage}({folder!r}, {N}, {parts})"
            )
            subprocess.run([sys.executable, "-c", code], check=True)


def disk_write(folder, N, parts):
    """Fill the cache, a twentieth at a time."""
    began = time.perf_counter()
    partition = write_cache(Path(folder) / "cache", (problem_of(*drawn(N // parts, seed=k)) for k in range(parts)))
    (Path(folder) / "partition.pickle").write_bytes(pickle.dumps(partition))
    print(f"wrote {N} transitions in {time.perf_counter() - began:.1f} s, drawing them included")


def disk_fit(folder, N, parts):
    """Fit from the cache, then with all of it in memory: the same optimum."""
    partition = pickle.loads((Path(folder) / "partition.pickle").read_bytes())
    N = partition.N
    rows, models = [], {}

    def fitted(where, fleet):
        for criterion in ("qp", "lp"):
            took, model = best(lambda c=criterion: fit_fleet(fleet, names(5, 4), c, dt_median=DT), 1)
            peak = peak_memory() / 2**20
            count = int(fleet.judge(model).outside.sum())
            known = models.setdefault(criterion, model)
            objective = np.max(np.abs(np.divide(model.fit_summary["objective"], known.fit_summary["objective"]) - 1))
            elements = max(np.abs(getattr(model, name) - getattr(known, name)).max() for name in ("A", "B", "dA", "dB"))
            rows.append(
                [where, criterion, f"{took:.1f} s", str(model.fit_summary["solver"]["passes"]), f"{peak:.0f} MiB"]
                + [f"{model.fit_summary['optimality_gap']:.0e}", str(count), f"{objective:.0e}", f"{elements:.0e}"]
            )

    fitted("on disk", Fleet([partition]))
    z, x_next = np.empty((9, N)), np.empty((5, N))
    for block in partition.blocks():
        part = slice(block.start, block.start + len(block))
        z[:, part], x_next[:, part] = block.z, block.x_next
    origin = np.zeros(N, dtype=np.intp)
    of = {"source": origin, "k": origin, "columns": partition.columns}
    fitted("in memory", Fleet.of(Problem(z, x_next, np.full(N, DT), np.ones(5), **of)))
    header = ["arrays", "criterion", "ours", "passes", "peak memory", "optimality gap", "outside"]
    table(f"{N} transitions, n = 5, m = 4", [*header, "objective differs", "elements differ"], rows)


CLAIMS = {f.__name__: f for f in (million, scheduled, joint, pyipm, large, coupled, growth, disk)}


def main():
    """Run the claims that are named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("claims", nargs="+", choices=[*CLAIMS, "all"])
    parser.add_argument("--quick", action="store_true", help="a tenth of the size")
    options = parser.parse_args()
    print(f"{os.cpu_count()} cores, Python {platform.python_version()}, numpy {np.__version__}")
    warm = problem_of(*drawn(2000))
    for criterion in ("qp", "lp"):
        solve(warm, criterion)  # the solvers are imported on first use
    for claim in CLAIMS if "all" in options.claims else options.claims:
        CLAIMS[claim](0.1 if options.quick else 1.0)


if __name__ == "__main__":
    main()
