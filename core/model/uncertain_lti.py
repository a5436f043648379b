"""UncertainLTI: the uncertain linear model, its one-step bounds, discrepancies and file."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.english import plural
from uncertain_lti.base.errors import ModelError, SignalError
from uncertain_lti.base.html_table import MOST, html_table, name_with_unit, number_text
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.model.bounds import centre_and_half, lower_of, upper_of
from uncertain_lti.model.domain import Domain, Sampling
from uncertain_lti.model.file import arguments, read, structure, write
from uncertain_lti.model.operating_point import OperatingPoint
from uncertain_lti.model.terms import ADDITIVE, ARRAYS, HALF_WIDTHS, REQUIRED, SHAPES, Term, checked, regressors, tables
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.signal_map import Signal, SignalMap

_BLOCK = 65536  # products per block of the vectorised path: they stay in the cache


class UncertainLTI:
    r"""dx/dt = (A ± ΔA) x + (B ± ΔB) u + (c ± Δc), measured with noise of at most v.

    The bounds of one step from a recorded sample, Leibov (2006), eqs. (6)(7) with additive terms:

    .. math::
        h &= Δt (ΔA |x| + ΔB |u| + Δc) + v \\
        x_{min}, x_{max} &= x + Δt (A x + B u + c) ∓ h

    Parameters
    ----------
    A : array (n, n)
        Nominal elements, 1/s.
    B : array (n, m)
        The same for the controls, 1/s.
    dA : array (n, n)
        Half-widths of A, all >= 0, 1/s.
    dB : array (n, m)
        Half-widths of B, all >= 0, 1/s.
    c : array (n,), optional
        Drift, 1/s; 0 by default.
    dc : array (n,), optional
        Half-width of the drift, 1/s; 0 by default.
    v : array (n,), optional
        Half-width of measurement noise, normalised; not multiplied by Δt; 0 by default.
    signals : SignalMap, optional
        Names, topics, operating point; default names x1, x2, ..., u1, u2, ... and values used as they are.
    sampling : Sampling, optional
        How samples were cut in the fit; default unknown.
    domain : Domain, optional
        Ranges seen in the fit; default none.
    alarm_rule : AlarmRule, optional
        Default `AlarmRule()`.
    fit_summary : mapping, optional
        How the model was fitted; plain data that goes to the file as it is.
    validation : mapping, optional
        How it was validated, likewise.

    Raises
    ------
    ModelError
        Shapes do not fit, a number is not finite, or a half-width is negative; names the field.
    """

    def __init__(
        self,
        A: ArrayLike,
        B: ArrayLike,
        dA: ArrayLike,
        dB: ArrayLike,
        c: ArrayLike | None = None,
        dc: ArrayLike | None = None,
        v: ArrayLike | None = None,
        *,
        signals: SignalMap | None = None,
        sampling: Sampling | None = None,
        domain: Domain | None = None,
        alarm_rule: AlarmRule | None = None,
        fit_summary: Mapping[str, Any] | None = None,
        validation: Mapping[str, Any] | None = None,
    ) -> None:
        self.dA: Array
        self.dB: Array
        self.c: Array
        self.dc: Array
        self.v: Array
        self.A = checked(A, "A", None)
        n = len(self.A) if self.A.ndim else 0
        if self.A.shape != (n, n) or n == 0:
            raise ModelError(f"A has shape {self.A.shape}; it must be square, one row per state")
        self.B = checked(B, "B", None)
        if self.B.size == 0:
            self.B = np.zeros((n, 0))
        if self.B.ndim != 2 or self.B.shape[0] != n:
            raise ModelError(f"B has shape {self.B.shape}; it must have {plural(n, 'row')}, one per state")
        m = self.B.shape[1]
        given: dict[str, Any] = {"dA": dA, "dB": dB, "c": c, "dc": dc, "v": v}
        for name, value in given.items():
            shape = SHAPES[name].shape(n, m)
            half_width = name in HALF_WIDTHS
            value = np.zeros(shape) if value is None and name not in REQUIRED else value
            setattr(self, name, checked(value, name, shape, half_width))
        for name in ARRAYS:
            getattr(self, name).flags.writeable = False
        if signals is None:
            signals = SignalMap(
                tuple(Signal(f"x{i + 1}", "", f"x{i + 1}") for i in range(n)),
                tuple(Signal(f"u{j + 1}", "", f"u{j + 1}") for j in range(m)),
                source="model",
            )
        if (len(signals.states), len(signals.controls)) != (n, m):
            raise ModelError(
                f"{plural(len(signals.states), 'state')} and {plural(len(signals.controls), 'control')} are named for "
                f"A {self.A.shape} and B {self.B.shape}"
            )
        self.signals = signals
        self.operating_point = OperatingPoint.of(signals.states, signals.controls)
        self.sampling = sampling or _sampling(signals)
        unbounded = Domain(np.full(n, -np.inf), np.full(n, np.inf), np.full(m, -np.inf), np.full(m, np.inf))
        self.domain = domain or unbounded
        self.alarm_rule = alarm_rule or AlarmRule()
        self.fit_summary = dict(fit_summary or {})
        self.validation = dict(validation or {})
        self.tables = tables({name: getattr(self, name) for name in ARRAYS})
        self._block = max(1, _BLOCK // (n * (n + m + 1)))

    @property
    def n(self) -> int:
        """Number of states."""
        return int(self.A.shape[0])

    @property
    def m(self) -> int:
        """Number of controls."""
        return int(self.B.shape[1])

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states."""
        return tuple(s.name for s in self.signals.states)

    @property
    def control_names(self) -> tuple[str, ...]:
        """Names of the controls."""
        return tuple(s.name for s in self.signals.controls)

    def additive(self) -> list[tuple[Term, Array, Array]]:
        """Additive terms of the model.

        Returns
        -------
        list of (Term, array (n,), array (n,))
            Each with its nominal elements, 0 where it has none, and its half-widths.
        """
        zeros = np.zeros(self.n)
        return [(t, getattr(self, t.nominal) if t.nominal else zeros, getattr(self, t.half)) for t in ADDITIVE]

    def __repr__(self) -> str:
        text = f"UncertainLTI({plural(self.n, 'state')}: {', '.join(self.state_names)}; "
        text += f"{plural(self.m, 'control')}"
        if self.m:
            text += f": {', '.join(self.control_names)}"
        if "criterion" in self.fit_summary:
            count = plural(self.fit_summary.get("transitions"), "transition")
            text += f"; fitted by {self.fit_summary['criterion']} to {count}"
        return text + ")"

    def _repr_html_(self) -> str:
        """Nominal elements with their half-widths, and the widths that the fit reached."""
        names = [*self.state_names, *self.control_names]
        nominal, half = np.hstack([self.A, self.B]), np.hstack([self.dA, self.dB])
        shown = range(min(len(names), MOST))
        extra = [(t.nominal or t.half, a, b) for t, a, b in self.additive() if a.any() or b.any()]
        header = ["A, B [1/s]", *(names[j] for j in shown)]
        header += ["…"] * (len(names) > MOST) + [name for name, _, _ in extra]
        rows = []
        for i in range(min(self.n, MOST)):
            row = [self.state_names[i], *(f"{nominal[i, j]:.4g} ± {half[i, j]:.3g}" for j in shown)]
            row += ["…"] * (len(names) > MOST) + [f"{a[i]:.4g} ± {b[i]:.3g}" for _, a, b in extra]
            rows.append(row)
        if self.n > MOST:
            rows.append(["…"] * len(header))
        facts, below = self.fit_summary, []
        if facts.get("mean_width_recorded") is not None:
            widths = [
                f"{name_with_unit(s.name, s.unit)} {number_text(float(w))}"
                for s, w in zip(self.signals.states[:MOST], np.ravel(facts["mean_width_recorded"]), strict=False)
            ]
            below.append(f"mean one-step width: {', '.join(widths)}" + ", …" * (self.n > MOST))
        rule = self.alarm_rule
        below.append(f"alarm: {rule.violations} of {plural(rule.window, 'verdict')}, margin {number_text(rule.margin)}")
        below += [f"note: {message}" for message in facts.get("messages", [])]
        return html_table(repr(self), header, rows, below)

    # --- one-step bounds ---

    def centre_and_half(self, x: ArrayLike, u: ArrayLike, dt: ArrayLike) -> tuple[Array, Array]:
        """Centre and half-width of the bounds; see `bounds`.

        Parameters
        ----------
        x : array (..., n)
            Normalised state at t_k.
        u : array (..., m)
            Normalised control at t_k.
        dt : float or array (...)
            Δt_k, s.

        Returns
        -------
        array (..., n)
            Centre, normalised.
        array (..., n)
            Half-width, normalised.

        Raises
        ------
        ModelError
            Shapes do not fit.
        """
        x = np.asarray(x, dtype=np.float64)
        u = np.asarray(u, dtype=np.float64)
        dt = np.asarray(dt, dtype=np.float64)
        if x.shape[-1:] != (self.n,) or u.shape[-1:] != (self.m,):
            raise ModelError(f"x has shape {x.shape} and u {u.shape}; they must end in {self.n} and {self.m}")
        lead = np.broadcast_shapes(x.shape[:-1], u.shape[:-1], dt.shape)
        count = math.prod(lead)  # not -1: that says nothing where there are no controls
        flat_x = np.broadcast_to(x, (*lead, self.n)).reshape(count, self.n)
        flat_u = np.broadcast_to(u, (*lead, self.m)).reshape(count, self.m)
        centre, half = np.empty((self.n, count)), np.empty((self.n, count))
        self.columns_centre_and_half(
            np.vstack([flat_x.T, flat_u.T]), np.broadcast_to(dt, lead).reshape(count), centre, half
        )
        return centre.T.reshape(*lead, self.n), half.T.reshape(*lead, self.n)

    def columns_centre_and_half(self, z: Array, dt: Array, centre: Array, half: Array) -> None:
        """`centre_and_half` of samples in columns, into given arrays.

        Parameters
        ----------
        z : array (n + m, K)
            Normalised [x; u].
        dt : array (K,)
            s.
        centre, half : array (n, K)
            Take the result.
        """
        for start in range(0, len(dt), self._block):
            part = slice(start, start + self._block)
            phi = regressors(z[: self.n, part], z[self.n :, part])
            centre[:, part], half[:, part] = centre_and_half(*self.tables, phi, dt[part])

    def bounds(self, x: ArrayLike, u: ArrayLike, dt: ArrayLike, margin: float = 1.0) -> tuple[Array, Array]:
        """One-step bounds, Leibov (2006), eqs. (6)(7) with the additive terms.

        Parameters
        ----------
        x : array (..., n)
            Normalised state at t_k.
        u : array (..., m)
            Normalised control at t_k.
        dt : float or array (...)
            Δt_k, s.
        margin : float
            Multiplies the half-widths.

        Returns
        -------
        lower, upper : array (..., n)
            Normalised x_min and x_max at t_{k+1}.

        Raises
        ------
        ModelError
            Shapes do not fit.
        """
        centre, half = self.centre_and_half(x, u, dt)
        return np.asarray(lower_of(centre, half, margin)), np.asarray(upper_of(centre, half, margin))

    # --- the nominal model on its own ---

    def simulate(self, x0: ArrayLike, u: ArrayLike, dt: ArrayLike) -> Array:
        """Free run of the nominal model, x_{k+1} = x_k + Δt_k (A x_k + B u_k + c), as in eq. (3) with ΔA = ΔB = 0.

        Parameters
        ----------
        x0 : array (n,)
            Normalised state at t_0.
        u : array (N, m)
            Normalised controls.
        dt : float or array (N,)
            Δt_k, s.

        Returns
        -------
        array (N+1, n)
            Normalised states; infinite or NaN where an unstable model runs away.
        """
        u = np.asarray(u, dtype=np.float64)
        dt = np.broadcast_to(np.asarray(dt, dtype=np.float64), (len(u),))
        x = np.empty((len(u) + 1, self.n))
        x[0] = x0
        with np.errstate(over="ignore", invalid="ignore"):  # an unstable model runs away, and may
            for k in range(len(u)):
                x[k + 1] = x[k] + dt[k] * (self.A @ x[k] + self.B @ u[k] + self.c)
        return x

    def discrepancy(self, transient: Transient, W: ArrayLike | None = None) -> tuple[float, Array]:
        """Discrepancies (4) and (5) between the free-running nominal model and a recorded transient.

        The run starts anew from the recorded sample at the start of every segment, and after every sample that
        is not finite.

        Parameters
        ----------
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
        x = self.operating_point.normalise_x(transient.x)
        u = self.operating_point.normalise_u(transient.u)
        usable, dt = transient.usable, transient.dt
        error = np.full((len(usable), self.n), np.nan)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], usable, [False]]).astype(np.int8)))
        for start, stop in edges.reshape(-1, 2):
            free = self.simulate(x[start], u[start:stop], dt[start:stop])
            error[start:stop] = free[1:] - x[start + 1 : stop + 1]
        weights = np.ones(self.n) if W is None else np.asarray(W, dtype=np.float64)
        if weights.shape not in ((self.n,), (len(usable), self.n), (len(usable), self.n, self.n)):
            raise ModelError(
                f"W has shape {weights.shape}; it must be ({self.n},), ({len(usable)}, {self.n}) "
                f"or ({len(usable)}, {self.n}, {self.n})"
            )
        diagonal = np.broadcast_to(
            np.diagonal(weights, axis1=1, axis2=2) if weights.ndim == 3 else weights, error.shape
        )[usable]
        error = error[usable]
        if weights.ndim == 3:
            total = float(np.einsum("ki,kij,kj->", error, weights[usable], error))
        else:
            total = float(np.sum(diagonal * error**2))
        largest = np.max(np.sqrt(diagonal) * np.abs(error), axis=0, initial=0.0)
        return total, largest

    def eigenvalues(self) -> NDArray[np.complex128]:
        """Eigenvalues of A.

        Returns
        -------
        array (n,) of complex
            1/s, sorted by real part, greatest first.
        """
        values = np.linalg.eigvals(self.A).astype(np.complex128)
        return values[np.lexsort((values.imag, -values.real))]

    def spectral_radius(self, dt: float | None = None) -> float:
        """Largest |eigenvalue| of I + Δt A; above 1 the nominal recursion (3) runs away.

        Parameters
        ----------
        dt : float, optional
            Δt, s; default the median step of the fit.

        Returns
        -------
        float
            The radius.

        Raises
        ------
        ModelError
            dt is left out and the model has no median step.
        """
        dt = self.sampling.dt_median if dt is None else dt
        if dt is None:
            raise ModelError("spectral radius: the model has no dt_median; give dt")
        return float(np.abs(np.linalg.eigvals(np.eye(self.n) + dt * self.A)).max())

    def replace(self, **changes: Any) -> UncertainLTI:
        """The same model with some constructor arguments replaced.

        Parameters
        ----------
        **changes : object
            Constructor arguments by name.

        Returns
        -------
        UncertainLTI
            A new model.
        """
        arguments = {
            name: getattr(self, name)
            for name in (
                *ARRAYS, "signals", "sampling", "domain", "alarm_rule", "fit_summary", "validation"
            )
        }  # fmt: skip
        return UncertainLTI(**{**arguments, **changes})

    # --- other tools ---

    def to_control(self, dt: float | None = None, recorded: bool = False) -> Any:
        """The nominal model as a `control.StateSpace`; see `interchange.to_control`.

        Parameters
        ----------
        dt : float, optional
            As in `interchange.to_control`.
        recorded : bool, default False
            As in `interchange.to_control`.

        Returns
        -------
        control.StateSpace
            The nominal model.
        """
        from uncertain_lti.model.interchange import to_control

        return to_control(self, dt, recorded)

    @staticmethod
    def from_control(system: Any, **options: Any) -> UncertainLTI:
        """From a `control.StateSpace` and half-widths; see `interchange.from_control`.

        Parameters
        ----------
        system : control.StateSpace
            As in `interchange.from_control`.
        **options : object
            Further arguments of `interchange.from_control`.

        Returns
        -------
        UncertainLTI
            The model.
        """
        from uncertain_lti.model.interchange import from_control

        model: UncertainLTI = from_control(UncertainLTI, system, **options)
        return model

    def save_mat(self, path: str | os.PathLike[str]) -> None:
        """Write a MATLAB file; see `interchange.save_mat`.

        Parameters
        ----------
        path : path
            The file.
        """
        from uncertain_lti.model.interchange import save_mat

        save_mat(self, path)

    @staticmethod
    def load_mat(path: str | os.PathLike[str]) -> UncertainLTI:
        """Read a MATLAB file; see `interchange.load_mat`.

        Parameters
        ----------
        path : path
            The file.

        Returns
        -------
        UncertainLTI
            The model.
        """
        from uncertain_lti.model.interchange import load_mat

        model: UncertainLTI = load_mat(UncertainLTI, path)
        return model

    # --- the file ---

    def to_dict(self) -> dict[str, Any]:
        """The structure of the model file, in the oldest format that holds the model.

        Returns
        -------
        dict
            Plain data for JSON; null for infinite ranges.
        """
        return structure(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the model file; an existing file is replaced as a whole or not at all.

        Parameters
        ----------
        path : path
            The file.

        Raises
        ------
        ModelError
            The file cannot be written.
        """
        write(path, self.to_dict())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> UncertainLTI:
        """Read a model file.

        Parameters
        ----------
        path : path
            The file.

        Returns
        -------
        UncertainLTI
            The model.

        Raises
        ------
        ModelError
            The file is missing, is not JSON, has an unknown format, wrong shapes, numbers that are not finite,
            negative half-widths or scales that are not positive; names file and field.
        """
        return cls.from_dict(read(path), source=os.fspath(path))

    @classmethod
    def from_dict(cls, data: Any, source: str = "model") -> UncertainLTI:
        """From the structure of a model file.

        Parameters
        ----------
        data : object
            As JSON gives it.
        source : str, default "model"
            What errors call it.

        Returns
        -------
        UncertainLTI
            The model.

        Raises
        ------
        ModelError
            It is not of that form; names source and field.
        """
        try:
            return cls(**arguments(data, source))
        except RecursionError:
            raise ModelError(f"{source}: is nested too deeply; is this a model file?") from None
        except (ModelError, SignalError) as error:
            text = str(error).removeprefix(source).removeprefix(": ")
            raise ModelError(f"{source}: {' '.join(text.split())}") from None  # names may hold line breaks


def _sampling(signals: SignalMap) -> Sampling:
    """What a signal map says of sampling."""
    types = [s.type for s in signals.states if s.topic == signals.clock]
    return Sampling(
        clock=signals.clock or "",
        clock_type=types[0] if types else "",
        time=dict(signals.time),
        max_gap=signals.max_gap,
        min_step=signals.min_step,
        max_skew=signals.max_skew,
    )
