"""UncertainLTI: the uncertain linear model, its one-step bounds, discrepancies and file."""

from __future__ import annotations

import json
import math
import os
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.english import plural
from uncertain_lti.base.errors import ModelError, SignalError
from uncertain_lti.base.files import kind_of, whole_file
from uncertain_lti.base.html_table import MOST, html_table, name_with_unit, number_text
from uncertain_lti.base.limits import LARGEST, LONGEST_S
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.model.bounds import centre_and_half, lower_of, upper_of
from uncertain_lti.model.domain import Domain, Occupancy, Sampling
from uncertain_lti.model.operating_point import OperatingPoint
from uncertain_lti.model.terms import ARRAYS, HALF_WIDTHS, REQUIRED, SHAPES, regressors, tables
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.signal_map import Signal, SignalMap

FORMATS = ("uncertain-lti/1", "uncertain-lti/2")
"""Formats of model files, oldest first; the oldest that holds a model is written."""
MAX_FILE_BYTES = 64 * 2**20
_IN_FILES = {"optimality_gap": "gap"}  # keys of the fit that files of format 1 call otherwise
_IN_PYTHON = {name: key for key, name in _IN_FILES.items()}
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
        self.A = _array(A, "A", None)
        n = len(self.A) if self.A.ndim else 0
        if self.A.shape != (n, n) or n == 0:
            raise ModelError(f"A has shape {self.A.shape}; it must be square, one row per state")
        self.B = _array(B, "B", None)
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
            setattr(self, name, _array(value, name, shape, half_width))
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
        extra = [(n, a, b) for n, a, b in (("c", self.c, self.dc), ("v", np.zeros(self.n), self.v)) if (a + b).any()]
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
        """The structure of the model file, format "uncertain-lti/1".

        Returns
        -------
        dict
            Plain data for JSON; null for infinite ranges.
        """
        states = [
            {key: getattr(s, key) for key in ("name", "topic", "type", "field", "unit", "steady", "scale")}
            for s in self.signals.states
        ]
        controls = [
            {
                key: getattr(s, key)
                for key in ("name", "topic", "type", "field", "unit", "steady", "scale", "max_hold", "delay")
            }
            for s in self.signals.controls
        ]
        s = self.sampling
        return {
            "format": FORMATS[self.domain.measure is not None],
            "states": states,
            "controls": controls,
            "sampling": {
                "clock": s.clock,
                "clock_type": s.clock_type,
                "time": dict(s.time),
                "dt_median": s.dt_median,
                "dt_min": s.dt_min,
                "dt_max": s.dt_max,
                "max_gap": s.max_gap,
                "min_step": s.min_step,
                "max_skew": s.max_skew,
            },
            **{name: getattr(self, name).tolist() for name in ARRAYS},
            "domain": {
                name: [v if math.isfinite(v) else None for v in getattr(self.domain, name).tolist()]
                for name in ("x_min", "x_max", "u_min", "u_max")
            }
            | ({} if self.domain.measure is None else {"measure": self.domain.measure.to_dict()}),
            "alarm": {
                "violations": self.alarm_rule.violations,
                "window": self.alarm_rule.window,
                "margin": self.alarm_rule.margin,
            },
            "fit": _plain({_IN_FILES.get(key, key): value for key, value in self.fit_summary.items()}),
            "validation": _plain(self.validation),
        }

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
        try:
            text = _layout(self.to_dict()).encode()
        except (TypeError, ValueError, RecursionError) as error:
            raise ModelError(
                f"{path}: the model holds what JSON cannot ({error}); mend its fit or validation"
            ) from None
        try:
            with whole_file(path) as stream:
                stream.write(text)
        except OSError as error:
            raise ModelError(f"{path}: cannot be written: {error.strerror}; choose another place") from None

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
        if (kind := kind_of(path)) and kind != "a model file":
            cure = {
                "a folder": "name the file in it",
                "a signals file": "write a model with `uncertain-lti fit`",
            }.get(kind, "are the arguments swapped?")
            raise ModelError(f"{path}: this is {kind}, and a model file is wanted here; {cure}")
        try:
            if os.path.getsize(path) > MAX_FILE_BYTES:
                raise ModelError(f"{path}: larger than {MAX_FILE_BYTES >> 20} MiB, so not a model file; check the path")
            with open(path, encoding="utf-8") as stream:
                data = json.load(stream, object_pairs_hook=_distinct)
        except FileNotFoundError:
            raise ModelError(f"{path}: there is no such model file; write one with `uncertain-lti fit`") from None
        except OSError as error:
            raise ModelError(f"{path}: cannot be read: {error.strerror}; check the path") from None
        except (ValueError, RecursionError) as error:
            detail = (str(error).splitlines() or [type(error).__name__])[0][:120]
            raise ModelError(f"{path}: is not JSON ({detail}); write one with `uncertain-lti fit`") from None
        return cls.from_dict(data, source=os.fspath(path))

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
            return cls._from_dict(data, source)
        except RecursionError:
            raise ModelError(f"{source}: is nested too deeply; is this a model file?") from None
        except (ModelError, SignalError) as error:
            text = str(error).removeprefix(source).removeprefix(": ")
            raise ModelError(f"{source}: {' '.join(text.split())}") from None  # names may hold line breaks

    @classmethod
    def _from_dict(cls, data: Any, source: str) -> UncertainLTI:
        if not isinstance(data, dict) or "format" not in data:
            raise ModelError(f"no field 'format'; is this a model file written by `uncertain-lti fit` ({FORMATS[0]})?")
        if data["format"] not in FORMATS:
            raise ModelError(
                f"format is {reprlib.repr(data['format'])}, and this version reads {', '.join(FORMATS)}; fit the model "
                f"again, or use the version that wrote it"
            )
        known = {
            "format", "states", "controls", "sampling", *ARRAYS, "domain", "alarm", "fit", "validation",
        }  # fmt: skip
        for name in ("states", "controls", "sampling", *REQUIRED):
            if name not in data:
                raise ModelError(f"field '{name}' is missing; fit the model again")
        for name in data:
            if name not in known:
                raise ModelError(f"unknown field {reprlib.repr(name)}; known are {', '.join(sorted(known))}")
        said = _object(data["sampling"], "sampling", {f.name for f in fields(Sampling)})
        sampling = Sampling(
            clock=_text(said.get("clock", ""), "sampling.clock"),
            clock_type=_text(said.get("clock_type", ""), "sampling.clock_type"),
            time={
                _text(k, "sampling.time"): _text(v, f"sampling.time[{k}]")
                for k, v in _object(said.get("time", {}), "sampling.time").items()
            },
            min_step=_positive(said.get("min_step", 0.0), "sampling.min_step", zero=True) or 0.0,
            **{
                key: _positive(said.get(key), f"sampling.{key}")
                for key in ("dt_median", "dt_min", "dt_max", "max_gap", "max_skew")
            },
        )
        for topic, kind in sampling.time.items():
            if kind not in ("header", "log"):
                raise ModelError(f"sampling.time[{topic}] is {reprlib.repr(kind)}; it must be header or log")
        signals = replace(
            SignalMap.from_dict(
                {"states": data["states"], "controls": data["controls"]}, source=source, need_topics=False
            ),
            clock=sampling.clock or None,
            max_gap=sampling.max_gap,
            min_step=sampling.min_step,
            max_skew=sampling.max_skew,
            time={t: "log" if k == "log" else "header" for t, k in sampling.time.items()},
        )
        for signal in signals.signals:
            for key in ("steady", "scale"):
                if getattr(signal, key) == "auto":
                    raise ModelError(f"{key} of '{signal.name}' is auto; a model file holds numbers")
        n, m = len(signals.states), len(signals.controls)
        _array(data["A"], "A", (n, n))  # against the names, before A says how many rows the others have
        _array(data["B"], "B", (n, m))
        domain = None
        if "domain" in data:
            sizes = {"x_min": n, "x_max": n, "u_min": m, "u_max": m}
            newer = {"measure"} if data["format"] != FORMATS[0] else set()
            box = _object(data["domain"], "domain", set(sizes) | newer)
            for name in sizes:
                if name not in box:
                    raise ModelError(f"field 'domain.{name}' is missing; fit the model again")
            limits = {name: _limits(box[name], f"domain.{name}", size) for name, size in sizes.items()}
            measure = Occupancy.from_dict(box["measure"], n + m) if box.get("measure") is not None else None
            domain = Domain(**limits, measure=measure)
        alarm = _object(data.get("alarm", {}), "alarm", {f.name for f in fields(AlarmRule)})
        for key in ("violations", "window"):
            if key in alarm and (isinstance(alarm[key], bool) or not isinstance(alarm[key], int)):
                raise ModelError(f"alarm.{key} is {reprlib.repr(alarm[key])}; it must be a whole number")
        if "margin" in alarm:
            alarm["margin"] = _positive(alarm["margin"], "alarm.margin", null=False, most=LARGEST)
        arrays: dict[str, Any] = {name: data.get(name) for name in ARRAYS}
        return cls(
            **arrays,
            signals=signals,
            sampling=sampling,
            domain=domain,
            alarm_rule=AlarmRule(**alarm),
            fit_summary={_IN_PYTHON.get(k, k): v for k, v in _object(data.get("fit", {}), "fit").items()},
            validation=_object(data.get("validation", {}), "validation"),
        )


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


# --- reading and writing plain data -------------------------------------------------------------------------


def _array(value: ArrayLike, name: str, shape: tuple[int, ...] | None, half_width: bool = False) -> Array:
    try:
        if isinstance(value, Sequence) and not _numbers_only(value):
            raise TypeError
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ModelError(f"field '{name}' is not an array of numbers") from None
    if shape is not None and array.shape != shape:
        if array.size == 0 and 0 in shape:
            return np.zeros(shape)
        raise ModelError(f"field '{name}' has shape {array.shape}; it must be {shape}")
    if not np.isfinite(array).all():
        raise ModelError(f"field '{name}' holds a number that is not finite")
    if (np.abs(array) > LARGEST).any():
        raise ModelError(f"field '{name}' holds a number above {LARGEST:g}, which the arithmetic cannot carry")
    if half_width and (array < 0).any():
        raise ModelError(f"field '{name}' holds a negative half-width")
    return array


def _numbers_only(value: Any) -> bool:
    """No texts, truth values or nulls, which numpy would turn into numbers."""
    if isinstance(value, (list, tuple)):
        return all(_numbers_only(v) for v in value)
    return not isinstance(value, (str, bool)) and value is not None


def _object(value: Any, name: str, known: set[str] | None = None) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ModelError(f"field '{name}' is not an object")
    for key in value:
        if known is not None and key not in known:
            raise ModelError(f"unknown field '{name}.{key}'; known are {', '.join(sorted(known))}")
    return dict(value)


def _text(value: Any, name: str) -> str:
    if not isinstance(value, str):
        raise ModelError(f"field '{name}' is {reprlib.repr(value)}; it must be a text")
    return value


def _positive(value: Any, name: str, zero: bool = False, null: bool = True, most: float = LONGEST_S) -> float | None:
    """A number that is positive, or not negative where zero is allowed; None for null where that is."""
    if value is None and null:
        return None
    try:
        number = math.nan if isinstance(value, bool) or not isinstance(value, (int, float)) else float(value)
    except OverflowError:
        number = math.nan
    if not (0.0 < number <= most or (zero and number == 0.0)):
        limit = "" if math.isnan(number) or number <= most else f", at most {most:g}"
        raise ModelError(f"field '{name}' is {reprlib.repr(value)}; it must be a positive number{limit}")
    return number


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of a JSON file; readers would keep the last of two equal keys."""
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"the key {next(k for k in keys if keys.count(k) > 1)!r} stands twice in one object")
    return found


def _limits(value: Any, name: str, size: int) -> Array:
    """A list of numbers; null stands for no limit."""
    if not isinstance(value, list) or len(value) != size:
        raise ModelError(f"field '{name}' must be a list of {plural(size, 'number')}")
    without = -math.inf if name.endswith("min") else math.inf
    limits = _array([0.0 if v is None else v for v in value], name, (size,))
    limits[[v is None for v in value]] = without
    return limits


def _plain(value: Any) -> Any:
    """numpy and not finite numbers to what JSON has."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, (np.integer, np.bool_)):
        return value.item()
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value


def _layout(data: Mapping[str, Any]) -> str:
    """JSON with one line per matrix row, signal and entry, so that a diff can be read."""

    def flat(value: Any) -> str:
        return json.dumps(value, allow_nan=False, ensure_ascii=False)

    lines = []
    for key, value in data.items():
        if isinstance(value, list) and value and isinstance(value[0], (list, dict)):
            inner = ",\n    ".join(flat(row) for row in value)
            lines.append(f"  {flat(key)}: [\n    {inner}\n  ]")
        elif isinstance(value, dict) and value:
            inner = ",\n    ".join(f"{flat(k)}: {flat(v)}" for k, v in value.items())
            lines.append(f"  {flat(key)}: {{\n    {inner}\n  }}")
        else:
            lines.append(f"  {flat(key)}: {flat(value)}")
    return "{\n" + ",\n".join(lines) + "\n}\n"
