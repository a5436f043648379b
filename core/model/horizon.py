# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Horizon: the envelope of the state several steps after a measured one.

A nominal model (`Run`) is run from the measured x_k with the recorded controls over h steps to x̂; with T = Σ Δt_j and
the mean control ū = Σ Δt_j u_j / T,

    centre = x̂ + T (A' x_k + B' ū + c')
    half   = T (ΔA |x_k| + ΔB |ū| + Δc) + v

The sum is a small correction of the run, by elements of the horizon's own. With a schedule the run is blended at every
step by the recorded scheduling vector, and the elements of the horizon by that at the start. Over a whole recording it
is the free run, with its discrepancies (4) and (5), and the matrix of its recursion.
"""

from __future__ import annotations

import reprlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import Array, numbers, runs
from uncertain_lti.base.errors import ModelError
from uncertain_lti.base.text import plural
from uncertain_lti.kernel.arithmetic import blended
from uncertain_lti.model.schedule import Schedule
from uncertain_lti.model.terms import Elements, blocks_of, checked, is_whole, object_of
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.signal_map import Recalled

Widths = Literal["growing", "constant"]
"""Half-widths that grow with |x| and |u|, or are the same everywhere."""
MOST_STEPS = 10_000
"""Steps of a horizon at most: so many runs are under way at a time."""
_OF_RUN = ("A", "B", "c")


@dataclass(frozen=True)
class Windows:
    """Transitions in a row without a break, as many as a horizon has steps, and the run over them.

    `steps`: transitions of each; `start` (K,): position of the first of them among all transitions; `z` (n + m + axes,
    K): state at the begin, mean control, and scheduling vector at the begin, [x_k; ū; s_k], normalised; `run` (n, K):
    x̂, normalised; `time` (K,): T, s.
    """

    steps: int
    start: NDArray[np.intp]
    z: Array
    run: Array
    time: Array

    @property
    def last(self) -> NDArray[np.intp]:
        """Position of the last transition of each (K,): its arrival is what the envelope is compared with."""
        return self.start + (self.steps - 1)


class Run(Elements):
    """A linear model that is run over the windows of the horizons in place of the nominal one.

    The centre of the narrowest envelope of one step may be unstable in a block whose ends few samples visit; over many
    steps the least squares of the same elements often stay nearer to the machine.

    `A` (n, n): 1/s; `B` (n, m): 1/s; `c` (n,): disturbance, 1/s.
    """

    def __init__(self, A: ArrayLike, B: ArrayLike, c: ArrayLike) -> None:
        super().__init__({"A": A, "B": B, "c": c}, "run.")

    def __repr__(self) -> str:
        return f"Run({plural(self.n, 'state')}; {plural(self.m, 'control')})"

    def to_dict(self) -> dict[str, Any]:
        """As it is in a model file."""
        return {"blocks": self.blocks_to_list(_OF_RUN)}

    @classmethod
    def from_dict(cls, data: Any, n: int, m: int, blocks: int | None) -> Run:
        """From a model file."""
        parts = object_of(data, "run", ("blocks",), ("blocks",))["blocks"]
        return cls(**blocks_of(parts, "run.blocks", n, m, blocks, _OF_RUN, _OF_RUN))


def unbroken_over(k: NDArray[np.intp], vectors: Iterable[Array], schedule: Schedule | None) -> NDArray[np.int64]:
    """Of each transition the first of those that follow one another without a break, in the same modes, up to it.

    `k` (N,): sample that each begins with; recordings one after the other leave one out in between; `vectors` (axes,
    N): scheduling vectors, normalised; Returns (N,): positions.
    """
    position = np.arange(len(k), dtype=np.int64)
    broken = np.diff(k, prepend=k[:1] - 2) != 1
    for axis, s in zip(() if schedule is None else schedule.axes, vectors, strict=True):
        if axis.modes:
            broken[1:] |= s[1:] != s[:-1]
    return np.maximum.accumulate(np.where(broken, position, 0)) if len(k) else position


_OF_RESIDUALS = ("mean", "covariance")
_OF_LAW = (*_OF_RUN, "memory")
_RELATIVE = "relative"
_LEAST = 1e-12
"""Share of the state's own variance below which what the others leave of it counts as none."""


class Residuals:
    """Mean and covariance of the utilisation (x_{k+1} - centre_k) / half_k over the transitions of the fit.

    Of a horizon those of the utilisation of its envelope, over the windows of the fit. Where the spread of residuals
    does not change with x and u as the half-widths do, one covariance describes the residual itself better, normalised:
    that of a law of its own, x_{k+1} - x_k - Δt (A x_k + B u_k + c), each less so much of the one before as its memory
    says; of older files x_{k+1} - centre_k.

    `mean` (n,): mean of each state; `covariance` (n, n): symmetric, with no negative eigenvalue but by rounding, of
    what the memory leaves; `relative`: of the utilisation; False: of the residual itself; `law`: A, B and c; `memory`
    (n,): what is expected of a residual less its mean is this times the one before; `other`: what describes the same
    transitions in the other form, until the alarm takes one of them.
    """

    def __init__(
        self,
        mean: ArrayLike,
        covariance: ArrayLike,
        relative: bool = True,
        law: Run | None = None,
        memory: ArrayLike | None = None,
        other: Residuals | None = None,
    ) -> None:
        self.relative, self.law, self.other = relative, law, other
        self.mean = checked(mean, "residuals.mean", None)
        if self.mean.ndim != 1 or not self.mean.size:
            raise ModelError(f"residuals.mean has shape {self.mean.shape}; it must have one number per state")
        n = len(self.mean)
        if law is not None and relative:
            raise ModelError("residuals.relative is true, and there is a law; the utilisation has none")
        self.covariance = checked(covariance, "residuals.covariance", (n, n))
        self.memory = checked(np.zeros(n) if memory is None else memory, "residuals.memory", (n,))
        size = float(np.abs(self.covariance).max())
        if not np.allclose(self.covariance, self.covariance.T, rtol=1e-9, atol=1e-12 * size):
            raise ModelError("residuals.covariance is not symmetric; fit the model again")
        least = float(np.linalg.eigvalsh(self.covariance / (size or 1.0)).min())
        if least < -1e-9 or (np.diagonal(self.covariance) < 0).any():
            raise ModelError("residuals.covariance has a negative variance; fit the model again")
        self.mean.flags.writeable = self.covariance.flags.writeable = self.memory.flags.writeable = False

    def __repr__(self) -> str:
        return f"Residuals({len(self.mean)} states)"

    def beside(self, other: Residuals | None) -> Residuals:
        """The same with another form, or alone."""
        return Residuals(self.mean, self.covariance, self.relative, self.law, self.memory, other)

    @property
    def forms(self) -> tuple[Residuals, ...]:
        """Itself, and the other."""
        return (self,) if self.other is None else (self, self.other)

    def alike(self, form: Residuals) -> Residuals | None:
        """That of the forms which is as another is, with the rest of them; None if neither is."""
        return next((one for one in self.forms if one.form == form.form), None)

    @property
    def form(self) -> tuple[bool, bool]:
        """Whether it is relative, and whether it has a law."""
        return self.relative, self.law is not None

    def whitening(self, counted: ArrayLike) -> Array:
        """L^-1 of the counted states' covariance C = L Lᵀ: the sum of squares of L^-1 r is rᵀ C^-1 r.

        A state whose residual is exactly 0, or follows from those before it, adds nothing: its row is 0.

        `counted` (n,): states that count; Returns (n, n): lower triangular; rows and columns of states that do not
        count are 0.
        """
        n, C = len(self.mean), self.covariance
        inverse = np.zeros((n, n))
        done: list[int] = []
        for i in np.flatnonzero(np.asarray(counted, dtype=bool)).tolist():
            explained = inverse[done] @ C[:, i] if done else np.zeros(0)  # L row of i, by what came before
            left = float(C[i, i] - explained @ explained)
            if left <= _LEAST * float(C[i, i]):
                continue
            row = -(explained @ inverse[done]) if done else np.zeros(n)
            row[i] += 1.0
            inverse[i] = row / np.sqrt(left)
            done.append(i)
        return inverse

    def to_dict(self) -> dict[str, Any]:
        """The form of the model file."""
        found = {"mean": self.mean.tolist(), "covariance": self.covariance.tolist()}
        if self.law is not None:
            (law,) = self.law.blocks_to_list(_OF_RUN)
            found |= law | {"memory": self.memory.tolist()}
        return found | ({_RELATIVE: True} if self.relative else {})

    @classmethod
    def from_dict(cls, data: Any, name: str = "residuals") -> Residuals:
        """From a model file."""
        data = object_of(data, name, known=(*_OF_RESIDUALS, _RELATIVE, *_OF_LAW), needed=_OF_RESIDUALS)
        relative = data.get(_RELATIVE, False)
        if not isinstance(relative, bool):
            raise ModelError(f"field '{name}.{_RELATIVE}' is {reprlib.repr(relative)}; it must be true or false")
        given = [key for key in _OF_LAW if key in data]
        if given and len(given) < len(_OF_LAW):
            raise ModelError(f"field '{name}' has {', '.join(given)}; a law has {', '.join(_OF_LAW)}")
        try:
            law = Run(*(data[key] for key in _OF_RUN)) if given else None
            return cls(data["mean"], data["covariance"], relative, law, data.get("memory"))
        except ModelError as error:
            raise ModelError(str(error).replace("residuals", name, 1)) from None


class Horizon(Elements):
    """Elements of the envelope after a number of steps.

    `steps`: h, at least 2; `A` (n, n): correction of the centre, A', 1/s; `B` (n, m): B', 1/s; `dA` (n, n): half-widths
    on |x_k|, 1/s; `dB` (n, m): half-widths on |ū|, 1/s; `c` (n,): c', 1/s; 0 by default; `dc` (n,): half-width, 1/s; 0
    by default; `v` (n,): half-width that T does not multiply, normalised; 0 by default; `widths`: constant if dA, dB
    and dc are 0; `residuals`: of the windows of the fit; default unknown.
    """

    def __init__(
        self,
        steps: int,
        A: ArrayLike,
        B: ArrayLike,
        dA: ArrayLike,
        dB: ArrayLike,
        c: ArrayLike | None = None,
        dc: ArrayLike | None = None,
        v: ArrayLike | None = None,
        widths: Widths = "growing",
        residuals: Residuals | None = None,
    ) -> None:
        if not (is_whole(steps) and 2 <= steps <= MOST_STEPS):
            raise ModelError(f"horizons: steps is {steps!r}; it must be a whole number, 2 to {MOST_STEPS}")
        if widths not in get_args(Widths):
            raise ModelError(f"horizon of {steps} steps: widths is {widths!r}; it must be growing or constant")
        self.steps, self.widths = steps, widths
        here = f"horizon of {steps} steps: "
        super().__init__({"A": A, "B": B, "dA": dA, "dB": dB, "c": c, "dc": dc, "v": v}, here)
        if widths == "constant" and (self.dA.any() or self.dB.any() or self.dc.any()):
            raise ModelError(f"{here}widths are constant, and dA, dB or dc is not 0; call it growing")
        if residuals is not None and len(residuals.mean) != self.n:
            raise ModelError(f"{here}residuals of {plural(len(residuals.mean), 'state')} for {plural(self.n, 'state')}")
        self.residuals = residuals

    def __repr__(self) -> str:
        return f"Horizon({self.steps} steps, {self.widths} half-widths)"

    def with_residuals(self, residuals: Residuals | None) -> Horizon:
        """The same envelope with other residuals."""
        return Horizon(self.steps, **self.arrays, widths=self.widths, residuals=residuals)

    def to_dict(self) -> dict[str, Any]:
        """As it is in a model file."""
        found = {"steps": self.steps, "widths": self.widths, "blocks": self.blocks_to_list()}
        return found | ({} if self.residuals is None else {"residuals": self.residuals.to_dict()})

    @classmethod
    def list_from(cls, data: Any, n: int, m: int, blocks: int | None) -> tuple[Horizon, ...]:
        """From a model file."""
        if not isinstance(data, list):
            raise ModelError("field 'horizons' is not a list of horizons")
        found = []
        for i, entry in enumerate(data):
            here = f"horizons[{i}]"
            given = object_of(entry, here, ("blocks", "residuals", "steps", "widths"), ("steps", "blocks"))
            given |= blocks_of(given.pop("blocks"), f"{here}.blocks", n, m, blocks)
            if given.get("residuals") is not None:
                given["residuals"] = Residuals.from_dict(given["residuals"], f"{here}.residuals")
            found.append(cls(**given))
        return tuple(found)


def checked_horizons(horizons: Sequence[Horizon], model: Elements) -> tuple[Horizon, ...]:
    """Horizons of one model, the shortest first."""
    ordered = tuple(sorted(horizons, key=lambda horizon: horizon.steps))
    steps = [horizon.steps for horizon in ordered]
    if len(set(steps)) < len(steps):
        raise ModelError(f"horizons: two have as many steps, {reprlib.repr(steps)}; give each once")
    for horizon in ordered:
        model.fits(horizon, f"horizon of {horizon.steps} steps")
    return ordered


# --- the nominal model on its own ----------------------------------------------------------------------------


LONGEST_RECURSION = 400
"""Rows of the matrix of the recursion up to which it remembers earlier samples; longer memories are left out of it."""


def simulate(model: Any, x0: ArrayLike, u: ArrayLike, dt: ArrayLike, s: ArrayLike | None = None) -> Array:
    """Free run of the nominal model, x_{k+1} = x_k + Δt_k (A x_k + B u_k + c), as in eq. (3) with ΔA = ΔB = 0.

    What a signal takes from earlier samples of a state (lag, diff, rate) follows the run, as soon as the run has
    these samples.

    Parameters
    ----------
    model : UncertainLTI
        The model.
    x0 : array (n,)
        Normalised state at t_0.
    u : array (N, m)
        Normalised controls.
    dt : float or array (N,)
        Δt_k, s.
    s : array (N, q), optional
        Normalised further scheduling signals; for models that have some. A schedule on a state follows the run.

    Returns
    -------
    array (N+1, n)
        Normalised states; infinite or NaN where an unstable model runs away.
    """
    u = numbers(u, "u", (None, model.m), ModelError)
    dt = numbers(dt, "dt", (...,), ModelError)
    dt = np.broadcast_to(numbers(dt, "dt", (len(u),) if dt.ndim else (), ModelError), (len(u),))
    s = numbers(np.zeros((len(u), 0)) if s is None else s, "s", (len(u), model.q), ModelError)
    x = np.empty((len(u) + 1, model.n))
    x[0] = numbers(x0, "x0", (model.n,), ModelError)
    A, B, c = model.A, model.B, model.c
    n, m = model.n, model.m
    z = np.hstack((x[:-1], u, s))
    recalled = [r for r in model.signals.recalled if r.of < n]
    with np.errstate(over="ignore", invalid="ignore"):  # an unstable model runs away, and may
        for k in range(len(u)):
            z[k, :n] = x[k]
            for of_state in recalled:
                _recall(model, of_state, z, k, dt)
            if model.schedule is not None:
                corners = model.schedule.corners(z[k, model.scheduling_positions, None])
                A, B, c = (blended(blocks, *corners)[..., 0] for blocks in (model.A, model.B, model.c))
            x[k + 1] = x[k] + dt[k] * (A @ x[k] + B @ z[k, n : n + m] + c)
    return x


def _recall(model: Any, recalled: Recalled, z: Array, k: int, dt: Array) -> None:
    """Fill in what sample k takes from earlier ones, if the run z (N, n + m + q) has them."""
    memory, before = recalled.memory, k - recalled.memory.samples
    if before < 0:
        return
    steady, scale = model.operating_point.steady, model.operating_point.scale
    now, past = z[[k, before], recalled.of] * scale[recalled.of] + steady[recalled.of]
    value = memory.taken(now, past, dt[before])
    z[k, recalled.position] = (value - steady[recalled.position]) / scale[recalled.position]


def run_over(model: Any, transient: Transient) -> Array:
    """States of the run over each usable stretch of a recording.

    Returns (N+1, n): normalised; NaN where there is no run.
    """
    transient = model.own_signals_of(transient)
    x = model.operating_point.normalise_x(transient.x)
    u = model.operating_point.normalise_u(transient.u)
    s = model.operating_point.normalise_s(transient.s)
    usable, dt = transient.usable, transient.dt
    run = np.full(x.shape, np.nan)
    for start, stop in runs(usable):
        run[start : stop + 1] = simulate(model, x[start], u[start:stop], dt[start:stop], s[start:stop])
    return run


def free_run(model: Any, transient: Transient) -> Transient:
    """Free run of the nominal model over a recording: its controls, and nothing of its states but the first.

    The run begins again from the recorded sample at the start of every segment and after one that is not finite.

    Parameters
    ----------
    model : UncertainLTI
        The model.
    transient : Transient
        In recorded units.

    Returns
    -------
    Transient
        With the states of the run, in recorded units; NaN where there is no run.

    Raises
    ------
    ModelError
        The transient has other numbers of signals than the model.
    """
    x = model.operating_point.recorded_x(run_over(model, transient))
    return transient.replace(x=x, name=f"{transient.name}, free run of the model")


def discrepancy(model: Any, transient: Transient, W: ArrayLike | None = None) -> tuple[float, Array]:
    """Discrepancies (4) and (5) between the free-running nominal model (`free_run`) and a recorded transient.

    Parameters
    ----------
    model : UncertainLTI
        The model.
    transient : Transient
        In recorded units.
    W : array (n,), (N, n) or (N, n, n), optional
        Weights of the arrival samples; default ones.

    Returns
    -------
    sum_of_squares : float
        Eq. (4), over k = 1..N.
    largest : array (n,)
        Eq. (5) for each state.

    Raises
    ------
    ModelError
        W has another shape.
    """
    error = (run_over(model, transient) - model.operating_point.normalise_x(transient.x))[1:]
    usable = transient.usable
    weights = np.ones(model.n) if W is None else numbers(W, "W", (...,), ModelError)
    if weights.shape not in ((model.n,), (len(usable), model.n), (len(usable), model.n, model.n)):
        raise ModelError(
            f"W has shape {weights.shape}; it must be ({model.n},), ({len(usable)}, {model.n}) "
            f"or ({len(usable)}, {model.n}, {model.n})"
        )
    full = weights.ndim == 3
    diagonal = np.broadcast_to(np.diagonal(weights, axis1=1, axis2=2) if full else weights, error.shape)[usable]
    error = error[usable]
    squares = np.einsum("ki,kij,kj->", error, weights[usable], error) if full else np.sum(diagonal * error**2)
    return float(squares), np.max(np.sqrt(diagonal) * np.abs(error), axis=0, initial=0.0)


def recursion(model: Any, dt: float) -> Array:
    """Matrix that takes [x_k; x_{k-1}; ...] to the next, as far back as the model remembers its states.

    Returns (N, N): I + Δt A without a memory.
    """
    n, scale = model.n, model.operating_point.scale
    step: Array = np.eye(n) + dt * model.A
    recalled = [r for r in model.signals.recalled if r.of < n and r.position < n + model.m]
    longest = max((r.memory.samples for r in recalled), default=0)
    if not longest or longest > LONGEST_RECURSION // n:
        return step
    whole = np.zeros((*step.shape[:-2], n * (longest + 1), n * (longest + 1)))
    whole[..., :n, :n] = step
    whole[..., n:, :-n] = np.eye(n * longest)
    for r in recalled:
        column = dt * model.B[..., r.position - n] * (scale[r.of] / scale[r.position])
        column = column / dt if r.memory.kind == "rate" else column
        past = n * r.memory.samples + r.of
        if r.memory.kind == "lag":
            whole[..., :n, past] += column
        else:
            whole[..., :n, r.of] += column
            whole[..., :n, past] -= column
    return whole
