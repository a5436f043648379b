"""Interchange: models to and from python-control and MATLAB."""

from __future__ import annotations

import json
import math
import os
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from uncertain_lti.base.arrays import Array
from uncertain_lti.base.english import plural
from uncertain_lti.base.errors import ModelError, SignalError
from uncertain_lti.base.files import whole_file
from uncertain_lti.model.terms import ARRAYS, REQUIRED, SHAPES
from uncertain_lti.signals.signal_map import Signal, SignalMap

DRIFT = "drift"
"""Name of the input, to be held at 1, that carries the drift c of a model in a state-space system."""
_VECTORS = tuple(name for name in ARRAYS if SHAPES[name].regressor == "1")


def to_control(model: Any, dt: float | None = None, recorded: bool = False) -> Any:
    """The nominal model as a `control.StateSpace`; its outputs are the states.

    Half-widths have no place there: keep the model beside it. A drift c becomes a last input called `drift`, to be
    held at 1.

    Parameters
    ----------
    model : UncertainLTI
        The model.
    dt : float, optional
        s; the discrete system of eq. (3), x_{k+1} = x_k + dt (A x_k + B u_k). Default: dx/dt = A x + B u. Its
        elements are those of one step of (3), so `control.c2d` of it is not (3) again.
    recorded : bool
        Deviations from the steady state in recorded units; default normalised.

    Returns
    -------
    control.StateSpace
        Continuous, or discrete with the step dt.

    Raises
    ------
    ModelError
        dt is not a positive number, or a control is called `drift` beside a drift.
    """
    import control

    if dt is not None and not (math.isfinite(dt) and dt > 0):
        raise ModelError(f"dt is {dt}; it must be a positive number of seconds, or left out")
    A, B, c = np.array(model.A), np.array(model.B), np.array(model.c)
    if recorded:
        X, U = model.operating_point.X, model.operating_point.U
        A, B, c = A * X[:, None] / X, B * X[:, None] / U, c * X
    inputs = list(model.control_names)
    if c.any():
        if DRIFT in inputs:
            raise ModelError(f"a control is called '{DRIFT}', as the input for c would be; rename it")
        B, inputs = np.column_stack([B, c]), [*inputs, DRIFT]
    if dt is not None:
        A, B = np.eye(model.n) + dt * A, dt * B
    n, m = B.shape
    names = list(model.state_names)
    return control.StateSpace(
        A, B, np.eye(n), np.zeros((n, m)), 0 if dt is None else dt,
        states=names, inputs=inputs, outputs=names, remove_useless_states=False,
    )  # fmt: skip


def from_control(
    model_class: Any,
    system: Any,
    dA: ArrayLike | None = None,
    dB: ArrayLike | None = None,
    dc: ArrayLike | None = None,
    v: ArrayLike | None = None,
    *,
    signals: SignalMap | None = None,
    recorded: bool = False,
) -> Any:
    """A model from a `control.StateSpace`, the inverse of `to_control`.

    Parameters
    ----------
    model_class : type
        `UncertainLTI`.
    system : control.StateSpace
        Continuous, or discrete with a known step, by eq. (3). Its outputs must be its states.
    dA : array (n, n), optional
        Half-widths as in `UncertainLTI`, normalised; 0 by default.
    dB : array (n, m), optional
        Likewise.
    dc : array (n,), optional
        Likewise.
    v : array (n,), optional
        Likewise.
    signals : SignalMap, optional
        Names, topics and operating point; default: the system's names, values used as they are.
    recorded : bool
        The system is in recorded units; signals give the scales.

    Returns
    -------
    UncertainLTI
        Without domain and fit.

    Raises
    ------
    ModelError
        The system has other outputs than its states, its step is not known, or shapes do not fit.
    """
    A, B = np.array(system.A, dtype=np.float64), np.array(system.B, dtype=np.float64)
    n = len(A)
    C, D = np.array(system.C), np.array(system.D)
    if C.shape != (n, n) or not np.array_equal(C, np.eye(n)) or D.any():
        raise ModelError("the system's outputs are not its states; give one with C = I and D = 0")
    if system.dt is True or system.dt is None:
        raise ModelError("the system does not say its step; give it a dt in seconds, or 0 for continuous time")
    if system.dt:
        A, B = (A - np.eye(n)) / system.dt, B / system.dt
    inputs, c = list(system.input_labels), np.zeros(n)
    if inputs and inputs[-1] == DRIFT:
        c, B, inputs = B[:, -1], B[:, :-1], inputs[:-1]
    if signals is None:
        if recorded:
            raise ModelError("recorded units need the scales; give signals")
        signals = SignalMap(
            tuple(Signal(name, "", "x") for name in system.state_labels),
            tuple(Signal(name, "", "u") for name in inputs),
            source="system",
        )
    if recorded:
        X = np.array([float(s.scale) for s in signals.states])
        U = np.array([float(s.scale) for s in signals.controls])
        if (len(X), len(U)) != (n, B.shape[1]):
            raise ModelError(
                f"signals name {plural(len(X), 'state')} and {plural(len(U), 'control')}, the system {n} and "
                f"{B.shape[1]}"
            )
        A, B, c = A * X / X[:, None], B * U / X[:, None], c / X
    zero = np.zeros
    return model_class(
        A, B, zero(A.shape) if dA is None else dA, zero(B.shape) if dB is None else dB, c, dc, v, signals=signals
    )


def save_mat(model: Any, path: str | os.PathLike[str]) -> None:
    """Write a MATLAB file (version 5): A, B, dA, dB, c, dc, v, names, units, operating point and steps.

    dt, dt_min, dt_max (s) are NaN where the model does not say them. `model_json` holds the whole model file, so that
    `UncertainLTI.load_mat` gives back everything.

    Parameters
    ----------
    model : UncertainLTI
        The model.
    path : path
        The file.

    Raises
    ------
    ModelError
        The file cannot be written.
    """
    from scipy.io import savemat

    point, sampling = model.operating_point, model.sampling
    # first, so that a file that was cut has nothing, or everything
    data: dict[str, Any] = {"model_json": json.dumps(model.to_dict())}
    data |= {name: np.atleast_2d(getattr(model, name)) for name in ARRAYS}
    for name in _VECTORS:
        data[name] = data[name].T
    for name, values in (("x_steady", point.x_s), ("x_scale", point.X), ("u_steady", point.u_s), ("u_scale", point.U)):
        data[name] = values[:, None]
    for name, group in (("state", model.signals.states), ("control", model.signals.controls)):
        data[f"{name}_names"] = np.array([[s.name] for s in group], dtype=object).reshape(len(group), 1)
        data[f"{name}_units"] = np.array([[s.unit] for s in group], dtype=object).reshape(len(group), 1)
    for name, step in (("dt", sampling.dt_median), ("dt_min", sampling.dt_min), ("dt_max", sampling.dt_max)):
        data[name] = math.nan if step is None else step
    try:
        with whole_file(path) as stream:
            savemat(stream, data, do_compression=True)
    except OSError as error:
        raise ModelError(f"{path}: cannot be written: {error.strerror}; choose another place") from None


def load_mat(model_class: Any, path: str | os.PathLike[str]) -> Any:
    """Read a MATLAB file (up to version 7) with at least A, B, dA and dB.

    What else it holds of `save_mat` is taken too; matrices that were changed in MATLAB count, not those of
    `model_json`.

    Parameters
    ----------
    model_class : type
        `UncertainLTI`.
    path : path
        The file.

    Returns
    -------
    UncertainLTI
        The model.

    Raises
    ------
    ModelError
        The file is missing, is not a MATLAB file that can be read, or what it holds is no model; names the variable.
    """
    from scipy.io import loadmat

    try:
        with open(path, "rb") as stream:
            data = loadmat(stream)
    except FileNotFoundError:
        raise ModelError(f"{path}: there is no such file; check the path") from None
    except NotImplementedError:
        raise ModelError(f"{path}: is a MATLAB file of version 7.3; save it with save(..., '-v7')") from None
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {error.strerror or error}; check the path") from None
    except Exception as error:  # a damaged file leads the reader anywhere
        text = (str(error).splitlines() or [type(error).__name__])[0]
        raise ModelError(f"{path}: is not a MATLAB file that can be read ({text}); write it anew") from None
    for name in REQUIRED:
        if name not in data:
            raise ModelError(f"{path}: there is no variable '{name}'; a model needs A, B, dA and dB")
    matrices = {name: _real(data[name], name, path) for name in ARRAYS if name in data}
    n, m = len(matrices["A"]), matrices["B"].shape[1] if matrices["B"].size else 0
    for name in _VECTORS:
        if name in matrices:
            matrices[name] = matrices[name].ravel()
    matrices["B"], matrices["dB"] = (
        matrices[k].reshape(n, m) if not matrices[k].size else matrices[k] for k in ("B", "dB")
    )
    try:
        if "model_json" in data:
            whole = json.loads(_texts(data["model_json"])[0])
            if isinstance(whole, dict):
                whole |= {name: value.tolist() for name, value in matrices.items()}
            return model_class.from_dict(whole, source=os.fspath(path))
        signals = SignalMap(
            _signals(data, "state", "x", n, path), _signals(data, "control", "u", m, path), source=os.fspath(path)
        )
        return model_class(**{name: matrices.get(name) for name in ARRAYS}, signals=signals)
    except (ValueError, LookupError) as error:
        raise ModelError(f"{path}: 'model_json' or the names are damaged ({error}); write the file anew") from None
    except (ModelError, SignalError) as error:
        raise ModelError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None


def _real(value: Any, name: str, path: str | os.PathLike[str]) -> Array:
    array = value.toarray() if hasattr(value, "toarray") else np.asarray(value)  # sparse in MATLAB, too
    if array.dtype.kind not in "fiub":
        raise ModelError(f"{path}: variable '{name}' is not a real matrix")
    return np.array(array, dtype=np.float64, ndmin=2)


def _texts(value: Any) -> list[str]:
    """Strings of a cell array, or of a char matrix whose rows are padded."""
    found = []
    for item in np.asarray(value).ravel():
        while isinstance(item, np.ndarray):
            item = item.ravel()[0] if item.size else ""
        found.append(str(item).rstrip())
    return found


def _signals(
    data: dict[str, Any], kind: str, letter: str, count: int, path: str | os.PathLike[str]
) -> tuple[Signal, ...]:
    names = _texts(data[f"{kind}_names"]) if f"{kind}_names" in data else [f"{letter}{i + 1}" for i in range(count)]
    units = _texts(data[f"{kind}_units"]) if f"{kind}_units" in data else [""] * count
    point = []
    for which, default in (("steady", 0.0), ("scale", 1.0)):
        given = data.get(f"{letter}_{which}")
        point.append([default] * count if given is None else _real(given, f"{letter}_{which}", path).ravel().tolist())
    for what, values in ((f"{kind}_names", names), (f"{kind}_units", units), (f"{letter}_steady", point[0])):
        if len(values) != count:
            raise ModelError(f"{path}: '{what}' has {plural(len(values), 'entry')} for {plural(count, kind)}")
    return tuple(
        Signal(name, "", letter, steady, scale, unit)
        for name, unit, steady, scale in zip(names, units, *point, strict=True)
    )
