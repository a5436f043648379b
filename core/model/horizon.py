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
step by the recorded scheduling vector, and the elements of the horizon by that at the start.
"""

from __future__ import annotations

import reprlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.errors import ModelError
from uncertain_lti.base.text import plural
from uncertain_lti.model.schedule import Schedule
from uncertain_lti.model.terms import Elements, blocks_of, checked, is_whole, object_of

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
