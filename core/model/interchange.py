# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Interchange: a model as tables for texts, pages and notebooks, and to and from python-control and MATLAB."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uncertain_lti.base.arrays import Array, numbers
from uncertain_lti.base.errors import ModelError, SignalError
from uncertain_lti.base.files import written
from uncertain_lti.base.text import MOST, Table, html_table, list_of, named, number, numbers_of, plural
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.model.model_file import FORMATS
from uncertain_lti.model.operating_point import normalised
from uncertain_lti.model.schedule import Axis, Schedule
from uncertain_lti.model.terms import ARRAYS, REQUIRED, SHAPES
from uncertain_lti.signals.signal_map import Signal, SignalMap

DISTURBANCE = "disturbance"
"""Name of the input, to be held at 1, that carries c of a model in a state-space system; `drift` in older ones."""


def to_control(model: Any, dt: float | None = None, recorded: bool = False, knot: int | None = None) -> Any:
    """The nominal model as a `control.StateSpace`; its outputs are the states.

    Half-widths have no place there: keep the model as well. c becomes a last input called `disturbance`, to be
    held at 1. Of a scheduled model there is one system per block, each for deviations from the one operating point, all
    with the same inputs; between the knots `model.at(...)` is a model without a schedule, with a system of its own.

    Parameters
    ----------
    model : UncertainLTI
        The model.
    dt : float, optional
        s; the discrete system of eq. (3), x_{k+1} = x_k + dt (A x_k + B u_k). Default: dx/dt = A x + B u. Its
        elements are those of one step of (3), so `control.c2d` of it is not (3) again.
    recorded : bool
        Deviations from the steady state in recorded units; default normalised.
    knot : int, optional
        Of a scheduled model the number of one block, in the order of `model.blocks`; default all of them.

    Returns
    -------
    control.StateSpace, or list of it
        Continuous, or discrete with the step dt; a list of a scheduled model without `knot`, in the order of
        `model.blocks`.

    Raises
    ------
    ModelError
        dt is not a positive number, a control is called `disturbance` and there is one, or there is no such block.
    """
    dt = None if dt is None else float(numbers(dt, "dt", (), ModelError))
    if dt is not None and not (math.isfinite(dt) and dt > 0):
        raise ModelError(f"dt is {dt}; it must be a positive number of seconds, or left out")
    offset = bool(np.any(model.c))
    if offset and DISTURBANCE in model.control_names:
        raise ModelError(f"a control is called '{DISTURBANCE}', as the input for c would be; rename it")
    if model.schedule is None and knot is not None:
        raise ModelError(f"knot is {knot}, and the model has no schedule; leave it out")
    if knot is not None and not 0 <= knot < len(model.blocks):
        raise ModelError(f"knot is {knot}; the model has blocks 0 to {len(model.blocks) - 1}")
    blocks = model.blocks if knot is None else [model.blocks[knot]]
    systems = [_system(block, dt, recorded, offset) for block in blocks]
    return systems if model.schedule is not None and knot is None else systems[0]


def _system(model: Any, dt: float | None, recorded: bool, offset: bool) -> Any:
    """Of a model without a schedule; offset: whether c is an input."""
    import control

    A, B, c = np.array(model.A), np.array(model.B), np.array(model.c)
    if recorded:
        X, U = model.operating_point.X, model.operating_point.U
        A, B, c = A * X[:, None] / X, B * X[:, None] / U, c * X
    inputs = list(model.control_names)
    if offset:
        B, inputs = np.column_stack([B, c]), [*inputs, DISTURBANCE]
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
    if not np.array_equal(system.C, np.eye(n)) or np.any(system.D):
        raise ModelError("the system's outputs are not its states; give one with C = I and D = 0")
    if system.dt is True or system.dt is None:
        raise ModelError("the system does not say its step; give it a dt in seconds, or 0 for continuous time")
    if system.dt:
        A, B = (A - np.eye(n)) / system.dt, B / system.dt
    inputs, c = list(system.input_labels), np.zeros(n)
    if inputs and inputs[-1] in (DISTURBANCE, "drift"):
        c, B, inputs = B[:, -1], B[:, :-1], inputs[:-1]
    if signals is None:
        if recorded:
            raise ModelError("recorded units need the scales; give signals")
        states = tuple(Signal(name, "", "x") for name in system.state_labels)
        signals = SignalMap(states, tuple(Signal(name, "", "u") for name in inputs), source="system")
    if recorded:
        X = np.array([float(s.scale) for s in signals.states])
        U = np.array([float(s.scale) for s in signals.controls])
        if (len(X), len(U)) != (n, B.shape[1]):
            raise ModelError(
                f"signals name {plural(len(X), 'state')} and {plural(len(U), 'control')}, the system {n} and "
                f"{B.shape[1]}"
            )
        A, B, c = A * X / X[:, None], B * U / X[:, None], c / X
    dA, dB = np.zeros(A.shape) if dA is None else dA, np.zeros(B.shape) if dB is None else dB
    return model_class(A, B, dA, dB, c, dc, v, signals=signals)


def save_mat(model: Any, path: str | os.PathLike[str]) -> None:
    """Write a MATLAB file (version 5): A, B, dA, dB, c, dc, v, names, units, operating point and steps.

    dt, dt_min, dt_max (s) are NaN where the model does not say them. `model_json` holds the whole model file, so that
    `UncertainLTI.load_mat` gives back everything. Of a scheduled model the block is the last dimension: `A(:,:,r)`,
    `B(:,:,r)`, `c(:,r)`. Then there are also, one row per scheduling signal, `schedule_signals`, `schedule_kinds`
    (knots or modes) and `schedule_values` (a cell of column vectors, recorded units); per block `schedule_blocks` (the
    position, from 1, of its knot or mode on each axis), `transitions` (NaN: not known) and `tied_to` (a block from 1,
    or 0); and `scheduling_names`, `scheduling_units`, `s_steady`, `s_scale` of further scheduling signals.

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
    if model.schedule is None:
        data |= {name: array if array.ndim > 1 else array[:, None] for name, array in model.arrays.items()}
    else:
        data |= {name: np.moveaxis(array, 0, -1) for name, array in model.arrays.items()} | _schedule_variables(model)
    groups = [("state", "x", model.signals.states), ("control", "u", model.signals.controls)]
    groups += [("scheduling", "s", model.signals.scheduling)] if model.schedule is not None else []
    for name, letter, group in groups:
        data |= {f"{name}_names": _cells([s.name for s in group]), f"{name}_units": _cells([s.unit for s in group])}
        data[f"{letter}_steady"] = getattr(point, f"{letter}_s")[:, None]
        data[f"{letter}_scale"] = getattr(point, letter.upper())[:, None]
    for name, step in (("dt", sampling.dt_median), ("dt_min", sampling.dt_min), ("dt_max", sampling.dt_max)):
        data[name] = math.nan if step is None else step
    with written(path, ModelError) as stream:
        savemat(stream, data, do_compression=True)


def _cells(values: Sequence[Any]) -> NDArray[np.object_]:
    """A cell array, one row per entry."""
    cells = np.empty((len(values), 1), dtype=object)
    for row, value in zip(cells, values, strict=True):
        row[0] = value
    return cells


def _schedule_variables(model: Any) -> dict[str, Any]:
    """Variables of a scheduled model other than its arrays."""
    schedule, facts = model.schedule, model.block_data
    values = schedule.recorded_values(model.signals.signals)
    return {
        "schedule_signals": _cells([axis.signal for axis in schedule.axes]),
        "schedule_kinds": _cells(["knots" if axis.knots else "modes" for axis in schedule.axes]),
        "schedule_values": _cells([v[:, None] for v in values]),
        "schedule_blocks": np.array(schedule.indices, dtype=np.float64) + 1.0,
        "transitions": np.array([[math.nan if f.transitions is None else f.transitions] for f in facts]),
        "tied_to": np.array([[0.0 if f.tied_to is None else f.tied_to + 1.0] for f in facts]),
    }


def load_mat(model_class: Any, path: str | os.PathLike[str]) -> Any:
    """Read a MATLAB file (up to version 7) with at least A, B, dA and dB.

    What else it holds of `save_mat` is taken too; matrices, and the knots or modes of a schedule, that were changed in
    MATLAB count, not those of `model_json`.

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
    data = _variables(path)
    for name in REQUIRED:
        if name not in data:
            raise ModelError(f"{path}: there is no variable '{name}'; a model needs A, B, dA and dB")
    try:
        A, B = (_real(data[name], name) for name in ("A", "B"))
        n, m = len(A), B.shape[1] if B.size else 0
        kinds, knots, blocks = [], [], None
        if "schedule_signals" in data:
            names, kinds = _texts(data["schedule_signals"]), _texts(data["schedule_kinds"])
            knots = [_real(v, "schedule_values").ravel() for v in np.asarray(data["schedule_values"]).ravel()]
            if not len(names) == len(kinds) == len(knots) or set(kinds) - {"knots", "modes"}:
                raise ModelError(
                    "'schedule_kinds' and 'schedule_values' must have an entry per signal, of knots or modes"
                )
            blocks = math.prod(len(v) for v in knots)
        arrays = _arrays(data, n, m, blocks)
        whole = json.loads(_texts(data["model_json"])[0]) if "model_json" in data else _named(data, n, m, blocks)
        changed: Any = [whole]
        if blocks is not None:
            if "model_json" not in data:  # in recorded units, until the model has its operating point
                axes = zip(names, kinds, knots, strict=True)
                whole["schedule"] = [{"signal": name, kind: values.tolist()} for name, kind, values in axes]
            changed = whole.get("blocks") if isinstance(whole, dict) else None
            if not (isinstance(changed, list) and len(changed) == blocks and all(isinstance(b, dict) for b in changed)):
                raise ModelError(f"'model_json' does not have the {plural(blocks, 'block')} of 'schedule_values'")
        for r, block in enumerate(changed):
            if isinstance(block, dict):
                block |= {name: (array if blocks is None else array[r]).tolist() for name, array in arrays.items()}
        model = model_class.from_dict(whole, source=os.fspath(path))
        if blocks is None:
            return model
        if [axis.signal for axis in model.schedule.axes] != names:
            raise ModelError("'schedule_signals' are not those of 'model_json'")
        schedule = _schedule(model, kinds, knots)
        return model if schedule == model.schedule else model.replace(schedule=schedule)
    except (ValueError, LookupError) as error:
        raise ModelError(f"{path}: 'model_json' or the names are damaged ({error}); write the file anew") from None
    except (ModelError, SignalError) as error:
        raise ModelError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None


def _variables(path: str | os.PathLike[str]) -> dict[str, Any]:
    from scipy.io import loadmat

    try:
        with open(path, "rb") as stream:
            return dict(loadmat(stream))
    except FileNotFoundError:
        raise ModelError(f"{path}: there is no such file; check the path") from None
    except NotImplementedError:
        raise ModelError(f"{path}: is a MATLAB file of version 7.3; save it with save(..., '-v7')") from None
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {error.strerror or error}; check the path") from None
    except Exception as error:  # a damaged file leads the reader anywhere
        text = (str(error).splitlines() or [type(error).__name__])[0]
        raise ModelError(f"{path}: is not a MATLAB file that can be read ({text}); write it anew") from None


def _arrays(data: dict[str, Any], n: int, m: int, blocks: int | None) -> dict[str, Array]:
    """The arrays of a model; in the file the block is the last dimension, which MATLAB drops if it is 1."""
    arrays = {}
    for name in (name for name in ARRAYS if name in data):
        array = _real(data[name], name)
        if blocks is None:
            arrays[name] = array.ravel() if SHAPES[name].regressor == "1" else array
            continue
        shape = (*SHAPES[name].shape(n, m), blocks)
        if array.size != math.prod(shape) or (array.ndim == len(shape) and array.size and array.shape != shape):
            raise ModelError(f"variable '{name}' has shape {array.shape}; it must be {shape}, the block last")
        arrays[name] = np.moveaxis(array.reshape(shape), -1, 0)
    return arrays


def _named(data: dict[str, Any], n: int, m: int, blocks: int | None) -> dict[str, Any]:
    """The structure of a model file without arrays, from the names, units and operating point in a MATLAB file."""
    whole: dict[str, Any] = {"format": FORMATS[-1], "sampling": {}}
    whole |= {"states": _signals(data, "state", "x", n), "controls": _signals(data, "control", "u", m)}
    if blocks is None:
        return whole
    counts = _column(data, "transitions", [math.nan] * blocks, "block")
    tied_to = _column(data, "tied_to", [0.0] * blocks, "block")
    known = [None if math.isnan(count) else int(count) for count in counts]
    tied = [int(to) - 1 if to else None for to in tied_to]
    facts = [{"transitions": count, "tied_to": to} for count, to in zip(known, tied, strict=True)]
    scheduling = _signals(data, "scheduling", "s", len(_texts(data.get("scheduling_names", []))))
    return whole | {"blocks": facts} | ({"scheduling": scheduling} if scheduling else {})


def _schedule(model: Any, kinds: Sequence[str], knots: Sequence[Array]) -> Schedule:
    """The schedule with knots or modes in recorded units; those that are as the model has them keep their bits."""
    axes, point, schedule = [], model.operating_point, model.schedule
    before = schedule.recorded_values(model.signals.signals)
    each = zip(schedule.axes, before, model.scheduling_positions, kinds, knots, strict=True)
    for axis, had, i, kind, there in each:
        at = normalised(there, point.steady[i], point.scale[i])
        if len(there) == len(had):
            at = np.where(there == had, axis.values, at)
        axes.append(Axis(axis.signal, **{kind: at}))
    return Schedule(tuple(axes))


def _real(value: Any, name: str) -> Array:
    array = value.toarray() if hasattr(value, "toarray") else np.asarray(value)  # sparse in MATLAB, too
    if array.dtype.kind not in "fiub":
        raise ModelError(f"variable '{name}' is not a real matrix")
    return np.array(array, dtype=np.float64, ndmin=2)


def _texts(value: Any) -> list[str]:
    """Strings of a cell array, or of a char matrix whose rows are padded."""
    found = []
    for item in np.asarray(value).ravel():
        while isinstance(item, np.ndarray):
            item = item.ravel()[0] if item.size else ""
        found.append(str(item).rstrip())
    return found


def _signals(data: dict[str, Any], kind: str, letter: str, count: int) -> list[dict[str, Any]]:
    columns = (
        _column(data, f"{kind}_names", [f"{letter}{i + 1}" for i in range(count)], kind, _texts),
        _column(data, f"{kind}_units", [""] * count, kind, _texts),
        _column(data, f"{letter}_steady", [0.0] * count, kind),
        _column(data, f"{letter}_scale", [1.0] * count, kind),
    )
    keys = "topic", "field", "name", "unit", "steady", "scale"
    return [dict(zip(keys, ("", letter, *row), strict=True)) for row in zip(*columns, strict=True)]


def _column(
    data: dict[str, Any], name: str, usual: list[Any], what: str, read: Callable[[Any], list[Any]] | None = None
) -> list[Any]:
    """A variable as a list of numbers, or as `read` has it, as long as what is usual, which it is by default."""
    if name not in data:
        return usual
    values = _real(data[name], name).ravel().tolist() if read is None else read(data[name])
    if len(values) != len(usual):
        raise ModelError(f"'{name}' has {plural(len(values), 'entry')} for {plural(len(usual), what)}")
    return values


def overview(model: Any) -> str:
    """Nominal elements with their half-widths, or the blocks of a schedule, and the widths that the fit reached."""
    facts, below = model.fit_summary, []
    if facts.get("mean_width_recorded") is not None:
        each = zip(model.signals.states[:MOST], np.ravel(facts["mean_width_recorded"]), strict=False)
        widths = [f"{named(s.name, s.unit)} {number(float(w))}" for s, w in each]
        below.append(f"mean one-step width: {', '.join(widths)}" + ", …" * (model.n > MOST))
    for rule in model.alarm:
        margin = f", margin {number(rule.margin)}" if isinstance(rule, AlarmRule) else ""
        below.append(f"alarm: {rule.words}{margin}")
    below += [f"note: {message}" for message in facts.get("messages", [])]
    table = elements_table(model) if model.schedule is None else blocks_table(model)
    header, *rows = [[*row[: MOST + 1], *["…"] * (len(row) > MOST + 1)] for row in (table.header, *table.rows[:MOST])]
    return html_table(repr(model), header, rows + [["…"] * len(header)] * (len(table.rows) > MOST), below)


def elements_table(model: Any) -> Table:
    """Elements with their half-widths: a row per state, a column per signal and additive term."""
    columns = [(name, model.A[:, j], model.dA[:, j]) for j, name in enumerate(model.state_names)]
    columns += [(name, model.B[:, j], model.dB[:, j]) for j, name in enumerate(model.control_names)]
    for term, nominal, half in model.additive():
        if nominal.any() or half.any():
            columns.append((term.nominal or f"{term.half} ({term.word})", nominal, half))
    rows = [
        [name, *(f"{nominal[i]:.4g} ± {half[i]:.3g}" for _, nominal, half in columns)]
        for i, name in enumerate(model.state_names)
    ]
    return Table(("A, B [1/s]", *(name for name, *_ in columns)), rows)


def blocks_table(model: Any) -> Table:
    """A row per block of a scheduled model: what it rests on, and how fast it is."""
    facts = block_facts(model)
    widths = any(block["mean_width"] for block in facts)
    header = ["regime", "transitions", "elements of", "time constants [s]"]
    header += [f"{name}: mean width" for name in model.state_names] * widths
    rows = []
    for block in facts:
        transitions = "unknown" if block["transitions"] is None else str(block["transitions"])
        row = [block["regime"], transitions if block["known"] else "0, not visited"]
        row.append("its own" if block["tied_to"] is None else facts[block["tied_to"]]["regime"])
        row.append(", ".join("grows" if v is None else number(v) for v in block["time_constants"]))
        rows.append(row + [number(w) for w in block["mean_width"] or [None] * model.n] * widths)
    return Table(header, rows)


def block_facts(model: Any) -> list[dict[str, Any]]:
    """What each block of a scheduled model rests on, and how fast it is."""
    if model.schedule is None:
        return []
    fitted = list_of(model.fit_summary.get("blocks"))
    knots = model.schedule.recorded_values(model.signals.signals)
    facts = []
    for r, (data, values) in enumerate(zip(model.block_data, model.eigenvalues(), strict=True)):
        said = fitted[r] if r < len(fitted) and isinstance(fitted[r], Mapping) else {}
        widths = numbers_of(said.get("mean_width"), model.n)
        axes = zip(model.schedule.axes, knots, model.schedule.indices[r], strict=True)
        facts.append(
            {
                "regime": model.block_name(r),
                "at": {axis.signal: float(values_of[k]) for axis, values_of, k in axes},
                "transitions": data.transitions,
                "tied_to": data.tied_to,
                "known": data.known,
                "mean_width": None if widths is None else (np.array(widths) * model.operating_point.X).tolist(),
                "eigenvalues": [[float(v.real), float(v.imag)] for v in values],
                "time_constants": [-1.0 / float(v.real) if v.real < 0 else None for v in values],
            }
        )
    return facts
