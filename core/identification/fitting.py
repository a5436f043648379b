"""fit(): recorded transients to an uncertain linear model."""

from __future__ import annotations

import platform
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.errors import FitError
from uncertain_lti.identification import formulation
from uncertain_lti.identification.diagnosis import check_solvable, describe
from uncertain_lti.identification.problem import Additive, Moments, Problem, assemble, moments
from uncertain_lti.identification.repair import outside, repair
from uncertain_lti.identification.working_set import Solution, WorkingSet
from uncertain_lti.model import Alarm, Domain, Sampling, UncertainLTI
from uncertain_lti.operating_point import OperatingPoint
from uncertain_lti.signals import Signal, SignalMap
from uncertain_lti.transient import Transient

Array = NDArray[np.float64]


def fit(
    transients: Sequence[Transient] | Transient,
    criterion: Literal["qp", "lp"] = "qp",
    weights: ArrayLike | Sequence[ArrayLike] | None = None,
    additive: Additive | None = None,
    operating_point: OperatingPoint | None = None,
    *,
    method: Literal["working-set", "cvxpy"] = "working-set",
    alarm: Alarm | None = None,
    progress: Callable[[str], None] | None = None,
) -> UncertainLTI:
    """Fit dx/dt = (A ± ΔA) x + (B ± ΔB) u so that the one-step bounds contain every recorded sample.

    Leibov (2006), eq. (10), the least sum of squared widths weighted by W, or eq. (11), the least largest width
    per row. Ties: for (11) the least sum of squared widths among its optima; then, for both, the least sum of
    squared distances of the bounds' centre from the recorded next sample.

    Parameters
    ----------
    transients : Transient or sequence of Transient
        Recordings, of any lengths, of the same states and controls; never joined to one another.
    criterion : {"qp", "lp"}
        Eq. (10) or eq. (11).
    weights : array (n,), (N, n), (N, n, n), or a list with one of the latter two per transient, optional
        W(t_{k+1}) for step k of N; positive; full matrices symmetric positive definite. Off-diagonal elements
        couple the rows in (10); (11) uses the diagonal. Default ones.
    additive : {"none", "disturbance", "noise", "both"}
        Further terms: drift c with half-width dc (disturbance), half-width v of measurement noise (noise).
        Default: what the signals file says, else none.
    operating_point : OperatingPoint, optional
        Steady state and scales; default: those of the transients' signals, or values used as they are.
    method : {"working-set", "cvxpy"}
        cvxpy states the whole problem as written (OSQP, HiGHS); slow, without tie-breaks, for comparison.
    alarm : Alarm, optional
        Goes to the model file.
    progress : callable, optional
        Called with one line of text per pass over the data.

    Returns
    -------
    UncertainLTI
        With zero training transitions outside its own `bounds`. `fit["messages"]` says in words what the user
        should know; `fit["gap"]` is the relative distance of the objective from a lower bound of the optimum.

    Raises
    ------
    FitError
        The transients do not match, there are too few transitions, or no envelope exists (names the sample).
    """
    if isinstance(transients, Transient):
        transients = [transients]
    transients = list(transients)
    if criterion not in ("qp", "lp"):
        raise FitError(f"criterion is {criterion!r}; it must be qp or lp")
    if method not in ("working-set", "cvxpy"):
        raise FitError(f"method is {method!r}; it must be working-set or cvxpy")
    signals = _common_signals(transients)
    n, m = len(signals.states), len(signals.controls)
    if operating_point is None:
        operating_point = OperatingPoint.of(signals.states, signals.controls)
    elif (len(operating_point.x_s), len(operating_point.u_s)) != (n, m):
        raise FitError(
            f"the operating point has {len(operating_point.x_s)} states and {len(operating_point.u_s)} controls, "
            f"the transients {n} and {m}"
        )
    signals = _at(signals, operating_point)
    if additive is None:
        additive = signals.additive or "none"
    problem = assemble(transients, operating_point, weights, additive)
    names = [s.name for s in signals.states]
    check_solvable(problem, transients, names)
    sums = moments(problem)
    solution = _solve(problem, sums, criterion, method, progress)

    def build(theta: Array, d: Array) -> UncertainLTI:
        return _model(problem, signals, theta, d, alarm)

    model, d = repair(build, problem, sums, solution.theta, solution.d, solution.violation)
    mean_width, max_width, weighted = _widths(problem, d)
    objective = _objective(problem, sums, d) if criterion == "qp" else weighted
    # (11): δ of the programme and the widest repaired sample; (10): the working set's own objective
    reference = _lower_bound(problem, sums, solution, criterion)
    scale = np.maximum(np.abs(objective), 1e-300)
    gap = float(np.max((np.asarray(objective) - reference) / scale, initial=0.0))
    found, messages = describe(model, problem, sums, mean_width, max_width)
    X = operating_point.X
    facts: dict[str, Any] = {
        "criterion": criterion,
        "additive": additive,
        "weights": "ones" if weights is None else {1: "per state", 2: "per sample", 3: "full"}[problem.weights.ndim],
        "objective": float(objective[0]) if criterion == "qp" else objective,
        "gap": max(gap, 0.0),
        "transitions": problem.N,
        "transients": len(transients),
        "segments": sum(t.segments for t in transients),
        "mean_width": mean_width,
        "max_width": max_width,
        "mean_width_recorded": mean_width * X,
        "max_width_recorded": max_width * X,
        "violations": int(outside(model, problem).sum()),
        "rank": found,
        "spectral_radius": model.spectral_radius(),
        "messages": messages,
        "solver": {
            "method": method,
            "names": sorted(solution.solvers),
            "rounds": solution.rounds,
            "passes": solution.passes,
            "working_set": solution.working,
        },
        "sources": [{"file": t.name} for t in transients],
        "versions": _versions(),
    }
    return model.with_(fit=facts)


def _solve(
    problem: Problem, sums: Moments, criterion: str, method: str, progress: Callable[[str], None] | None
) -> Solution:
    if method == "working-set":
        engine = WorkingSet(problem, sums, progress)
        return engine.quadratic() if criterion == "qp" else engine.linear()
    theta, d, objective = formulation.solve(problem, criterion)
    engine = WorkingSet(problem, sums, progress)
    engine.solution.theta, engine.solution.d = theta, d
    violation = engine.violation()
    delta = objective if criterion == "lp" else None
    return Solution(theta, d, objective, violation, delta, solvers={"cvxpy"})


def _common_signals(transients: Sequence[Transient]) -> SignalMap:
    if not transients:
        raise FitError("no transients; give at least one recording")
    first = transients[0]
    for other in transients[1:]:
        if (other.state_names, other.control_names) != (first.state_names, first.control_names):
            raise FitError(
                f"{other.name} has states {', '.join(other.state_names)} and controls "
                f"{', '.join(other.control_names) or 'none'}, {first.name} has {', '.join(first.state_names)} and "
                f"{', '.join(first.control_names) or 'none'}; read all recordings with one signals file"
            )
        if other.signals != first.signals:
            raise FitError(f"{other.name} and {first.name} were read with different signals; read them together")
    if first.signals is not None:
        return first.signals
    return SignalMap(
        tuple(Signal(name, "", name) for name in first.state_names),
        tuple(Signal(name, "", name) for name in first.control_names),
        max_gap=None if np.isinf(first.max_gap) else first.max_gap,
        min_step=first.min_step,
        source="arrays",
    )


def _at(signals: SignalMap, point: OperatingPoint) -> SignalMap:
    return replace(
        signals,
        states=tuple(
            replace(s, steady=float(a), scale=float(b))
            for s, a, b in zip(signals.states, point.x_s, point.X, strict=True)
        ),
        controls=tuple(
            replace(s, steady=float(a), scale=float(b))
            for s, a, b in zip(signals.controls, point.u_s, point.U, strict=True)
        ),
    )


def _model(problem: Problem, signals: SignalMap, theta: Array, d: Array, alarm: Alarm | None) -> UncertainLTI:
    n, p, columns = problem.n, problem.p, problem.columns
    zeros = np.zeros(n)
    x, u = problem.z[:, :n], problem.z[:, n:]
    clock_types = [s.type for s in signals.states if s.topic == signals.clock]
    return UncertainLTI(
        theta[:n].T,
        theta[n:p].T,
        d[:n].T,
        d[n:p].T,
        theta[p] if columns.drift else zeros,
        d[p] if columns.disturbance else zeros,
        d[-1] if columns.noise else zeros,
        signals=signals,
        sampling=Sampling(
            clock=signals.clock or "",
            clock_type=clock_types[0] if clock_types else "",
            time=dict(signals.time),
            dt_median=float(np.median(problem.dt)),
            dt_min=float(problem.dt.min()),
            dt_max=float(problem.dt.max()),
            max_gap=signals.max_gap,
            min_step=signals.min_step,
            max_skew=signals.max_skew,
        ),
        domain=Domain(x.min(axis=0), x.max(axis=0), u.min(axis=0), u.max(axis=0)),
        alarm=alarm,
    )


def _objective(problem: Problem, sums: Moments, d: Array) -> Array:
    """Value of (10), (1,)."""
    if sums.coupled is not None:
        flat = d.T.ravel()
        return np.array([4.0 * flat @ sums.coupled @ flat])
    total = 0.0
    for i in range(problem.n):
        gram = sums.gram[i] if len(sums.gram) > 1 else sums.gram[0] * problem.weights[i]
        total += 4.0 * float(d[:, i] @ gram @ d[:, i])
    return np.array([total])


def _widths(problem: Problem, d: Array) -> tuple[Array, Array, Array]:
    """Mean and largest width per step, and largest √w_ii x width, each (n,), normalised."""
    total, largest = np.zeros(problem.n), np.zeros(problem.n)
    weighted = np.zeros(problem.n)
    for part in problem.blocks():
        width = 2.0 * problem.dt[part, None] * (problem.psi(part) @ d)
        total += width.sum(axis=0)
        largest = np.maximum(largest, width.max(axis=0))
        weighted = np.maximum(weighted, (width * np.sqrt(problem.row_weights(part))).max(axis=0))
    return total / problem.N, largest, weighted


def _lower_bound(problem: Problem, sums: Moments, solution: Solution, criterion: str) -> Array:
    if criterion == "qp":
        return _objective(problem, sums, solution.d)
    assert solution.delta is not None
    return solution.delta


def _versions() -> dict[str, str]:
    from importlib.metadata import PackageNotFoundError, version

    from uncertain_lti import __version__

    found = {"uncertain-lti": __version__, "python": platform.python_version()}
    for name in ("numpy", "daqp", "highspy", "cvxpy", "osqp"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
