# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The model: bounds (6)(7) to the bit, discrepancies (4)(5), and a file that is either whole or refused."""

import json
import math
import os
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from perturbed import armed_model
from refusals import refuses
from test_signals import damaged

from uncertain_lti.base.arrays import LARGEST, LONGEST_S
from uncertain_lti.base.errors import ModelError, UncertainLTIError
from uncertain_lti.model.alarm_rule import AlarmRule, StatisticRule
from uncertain_lti.model.domain import Domain, Sampling
from uncertain_lti.model.horizon import MOST_STEPS
from uncertain_lti.model.model_file import FORMATS
from uncertain_lti.model.signature import Signature
from uncertain_lti.model.terms import ARRAYS
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.plants.leibov import leibov2006
from uncertain_lti.sampling.transient import Transient
from uncertain_lti.signals.signal_map import Signal, SignalMap

NAN, INF = math.nan, math.inf

# --- random models -------------------------------------------------------------------------------------------


def random_model(rng: np.random.Generator, n: int, m: int, additive: bool = True, size: float = 1.0) -> UncertainLTI:
    """Any signs and magnitudes, some elements and half-widths zero, an operating point of its own."""

    def elements(*shape: int) -> np.ndarray:
        values = rng.normal(size=shape) * 10.0 ** rng.uniform(-3, 1, shape) * size
        return np.where(rng.uniform(size=shape) < 0.15, 0.0, values)

    vectors = [elements(n), np.abs(elements(n)), np.abs(elements(n))] if additive else []
    signals = SignalMap(
        tuple(Signal(f"x{i}", "/x", f"d[{i}]", float(rng.normal()), float(rng.uniform(0.1, 9))) for i in range(n)),
        tuple(Signal(f"u{j}", "/u", f"d[{j}]", float(rng.normal()), float(rng.uniform(0.1, 9))) for j in range(m)),
        clock="/x",
        max_gap=0.1,
        time={"/x": "header"} | ({"/u": "log"} if m else {}),
    )
    matrices = elements(n, n), elements(n, m), np.abs(elements(n, n)), np.abs(elements(n, m))
    return UncertainLTI(*matrices, *vectors, signals=signals)


seeds = st.integers(0, 2**32 - 1)
sizes = st.tuples(st.integers(1, 6), st.integers(0, 4)) | st.sampled_from([(1, 7), (1, 20), (9, 0), (12, 12), (2, 130)])
leads = st.sampled_from([(), (1,), (7,), (2, 3), (0,), (4, 0), (4095,), (4096,), (4097,), (1, 1, 5)])


def bits(array: np.ndarray) -> bytes:
    return np.ascontiguousarray(array).tobytes()


# --- bounds (6)(7) -------------------------------------------------------------------------------------------


@given(seeds, sizes, leads, st.sampled_from(["C", "F", "strided", "reversed"]), st.booleans())
def test_one_sample_and_many_give_the_same_bits(seed, size, lead, layout, one_dt):
    rng = np.random.default_rng(seed)
    n, m = size
    model = random_model(rng, n, m)

    def laid_out(array: np.ndarray) -> np.ndarray:
        if layout == "F":
            return np.asfortranarray(array)
        if layout == "strided":
            wide = np.zeros((*array.shape[:-1], 2 * array.shape[-1]))
            wide[..., ::2] = array
            return wide[..., ::2]
        return array[..., ::-1].copy()[..., ::-1] if layout == "reversed" else array

    x, u = laid_out(rng.normal(size=(*lead, n))), laid_out(rng.normal(size=(*lead, m)))
    dt = np.float64(0.013) if one_dt else rng.uniform(1e-3, 1.0, lead)
    lower, upper = model.bounds(x, u, dt)
    assert lower.shape == upper.shape == (*lead, n)
    picked = list(np.ndindex(lead))
    for index in picked[:2] + picked[-2:] + [picked[i] for i in rng.integers(0, max(len(picked), 1), 5) if picked]:
        low, high = model.bounds(x[index], u[index], dt if one_dt else dt[index])
        assert bits(low) == bits(lower[index]) and bits(high) == bits(upper[index])


@given(seeds, sizes)
def test_every_matrix_in_the_intervals_stays_inside(seed: int, size: tuple[int, int]) -> None:
    """Equation (3) with elements anywhere in their intervals, ends and all; up to the rounding of both sides."""
    rng = np.random.default_rng(seed)
    model = random_model(rng, *size)
    x, u, dt = rng.normal(size=model.n), rng.normal(size=model.m), 0.1
    lower, upper = model.bounds(x, u, dt)
    for _ in range(20):
        draw = lambda shape: rng.choice([-1.0, 0.0, 1.0, rng.uniform(-1, 1)], shape)  # noqa: E731
        A, B = model.A + draw(model.A.shape) * model.dA, model.B + draw(model.B.shape) * model.dB
        rate = A @ x + B @ u + model.c + draw(model.n) * model.dc
        after = x + dt * rate + draw(model.n) * model.v
        slack = 1e-12 * (1.0 + np.abs(after) + upper - lower)
        assert (lower - slack <= after).all() and (after <= upper + slack).all()
    sign = np.concatenate([np.sign(x), np.sign(u)])
    widest = x + dt * ((model.A + model.dA * sign[: model.n]) @ x + (model.B + model.dB * sign[model.n :]) @ u)
    np.testing.assert_allclose(upper, widest + dt * (model.c + model.dc) + model.v, rtol=1e-9, atol=1e-12)


def test_samples_controls_and_steps_are_broadcast() -> None:
    model = random_model(np.random.default_rng(0), 3, 2)
    x, u, dt = np.ones((4, 1, 3)), np.ones(2), np.array([0.1, 0.2])
    lower, _ = model.bounds(x, u, dt)
    assert lower.shape == (4, 2, 3)
    assert bits(lower[2, 1]) == bits(model.bounds(np.ones(3), np.ones(2), 0.2)[0])


@pytest.mark.parametrize(("x", "u"), [((2,), (1,)), ((3,), (2,)), ((5, 3), (5,)), ((), (1,))])
def test_wrong_shapes_are_said(x: tuple[int, ...], u: tuple[int, ...]) -> None:
    model = random_model(np.random.default_rng(0), 3, 1)
    words = r"[xu] has shape .*; give real numbers of shape \(\.\.\., [31]\)"
    refuses(ModelError, words, model.bounds, np.ones(x), np.ones(u), 0.1)
    refuses(ModelError, "give as many of each, or one for all", model.bounds, np.ones((5, 3)), np.ones((2, 1)), 0.1)


# --- discrepancies (4)(5) and the nominal model ---------------------------------------------------------------


def naive_run(model: UncertainLTI, transient: Transient) -> np.ndarray:
    """The nominal model from the first sample on, and anew after each transition that cannot be used; normalised."""
    point = model.operating_point
    free = (transient.x - point.x_s) / point.X
    for k, dt in enumerate(transient.dt):
        if transient.usable[k]:
            u = (transient.u[k] - point.u_s) / point.U
            free[k + 1] = free[k] + dt * (model.A @ free[k] + model.B @ u + model.c)
    return free


def naive_discrepancy(model: UncertainLTI, transient: Transient, W: np.ndarray) -> tuple[float, list[float]]:
    """(4)(5) as docs/theory.md writes them, sample after sample."""
    total, largest, point = 0.0, [0.0] * model.n, model.operating_point
    errors = naive_run(model, transient) - (transient.x - point.x_s) / point.X
    for k in np.flatnonzero(transient.usable):
        weights, error = np.diag(W) if W.ndim == 1 else np.diag(W[k]) if W.ndim == 2 else W[k], errors[k + 1]
        total += float(error @ weights @ error)
        for i in range(model.n):
            largest[i] = max(largest[i], math.sqrt(weights[i, i]) * abs(error[i]))
    return total, largest


@given(seeds, st.tuples(st.integers(1, 4), st.integers(0, 3)), st.integers(0, 3), st.sampled_from([0.0, 0.1]))
def test_discrepancies_are_those_of_a_plain_loop(seed: int, size: tuple[int, int], kind: int, broken: float) -> None:
    rng = np.random.default_rng(seed)
    model = random_model(rng, *size, size=0.3)
    n, m = size
    steps = rng.choice([1, 1, 1, 1, 2, 9], 30)
    x, u = rng.normal(size=(31, n)), rng.normal(size=(31, m))
    x[rng.uniform(size=x.shape) < broken] = NAN
    transient = Transient(np.concatenate([[0], np.cumsum(steps)]) * 10_000_000, x, u, max_gap=0.05)
    root = rng.normal(size=(30, n, n))
    W = [np.ones(n), rng.uniform(0.1, 2, n), rng.uniform(0.1, 2, (30, n)), root @ np.swapaxes(root, 1, 2)][kind]
    wanted, largest = naive_discrepancy(model, transient, W)
    got = model.discrepancy(transient, None if kind == 0 else W)
    assert got[0] == pytest.approx(wanted, rel=1e-9)
    np.testing.assert_allclose(got[1], largest, rtol=1e-9)


def test_a_free_run_follows_the_controls_and_begins_again_after_gaps() -> None:
    rng = np.random.default_rng(1)
    model = random_model(rng, 2, 1)
    t = np.arange(30) * 0.1
    t[20:] += 5.0
    x, u = rng.normal(size=(30, 2)), rng.normal(size=(30, 1))
    x[10] = np.nan
    recording = Transient(t, x, u, max_gap=1.0)
    free = model.free_run(recording)
    assert np.array_equal(free.t_ns, recording.t_ns) and np.array_equal(free.u, recording.u)
    expected = model.operating_point.recorded_x(naive_run(model, recording))
    np.testing.assert_allclose(free.x, expected)
    assert np.isnan(expected[10]).all() and np.isfinite(np.delete(expected, 10, axis=0)).all()
    other = Transient(t, np.zeros((30, 3)), u)
    refuses(ModelError, "3 states and 1 control, and the model has 2 and 1", model.free_run, other)


def test_weights_of_another_shape_are_refused() -> None:
    transient = Transient([0.0, 1.0, 2.0], np.zeros((3, 2)), np.zeros((3, 1)))
    with pytest.raises(ModelError, match=r"W has shape \(3,\); it must be \(2,\), \(2, 2\) or \(2, 2, 2\)"):
        random_model(np.random.default_rng(0), 2, 1).discrepancy(transient, np.ones(3))


def test_the_published_eigenvalues_are_the_models() -> None:
    model = leibov2006()
    wanted = [-1.60, -2.00, -14.34, -15.59 - 17.00j, -15.59 + 17.00j]
    np.testing.assert_allclose(model.eigenvalues(), wanted, atol=0.005)
    assert model.spectral_radius(0.025) == pytest.approx(np.abs(1 + 0.025 * model.eigenvalues()).max(), rel=1e-12)
    assert model.spectral_radius(0.025) < 1 < model.spectral_radius(0.2)
    refuses(ModelError, "the model has no dt_median; give dt", model.spectral_radius)


# --- what a model may be -------------------------------------------------------------------------------------

ONE = np.ones((1, 1))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((np.ones((1, 2)), ONE, ONE, ONE), "A has shape"),
        ((np.ones((0, 0)), ONE, ONE, ONE), "A has shape"),
        ((ONE, np.ones((2, 1)), ONE, ONE), r"B has shape \(2, 1\); it must have 1 row"),
        ((ONE, ONE, np.ones((2, 2)), ONE), "field 'dA' has shape"),
        ((ONE, ONE, ONE, ONE, [0.0], [0.0], [-1e-300]), "field 'v' holds a negative half-width"),
        ((ONE, ONE, ONE, ONE, [0.0, 1.0]), "field 'c' has shape"),
        ((ONE, ONE * INF, ONE, ONE), "field 'B' holds a number that is not finite"),
        (([[True]], ONE, ONE, ONE), "field 'A' is not an array of numbers"),
    ],
)
def test_matrices_that_are_no_model_are_refused(arguments: Any, words: str) -> None:
    refuses(ModelError, words, UncertainLTI, *arguments)


def test_names_must_be_as_many_as_rows_and_columns() -> None:
    signals = SignalMap((Signal("a", "", "a"), Signal("b", "", "b")))
    refuses(ModelError, "2 states and 0 controls are named for A", UncertainLTI, ONE, ONE, ONE, ONE, signals=signals)


def test_a_model_is_not_changed_behind_its_back() -> None:
    A = np.zeros((1, 1))
    model = UncertainLTI(A, ONE, ONE, ONE)
    A[0, 0] = 7.0
    assert model.A[0, 0] == 0.0
    for array in (model.A, Signature("a", [1], [[[1.0]]]).moments):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 7.0
    assert model.replace(v=[2.0]).v.tolist() == [2.0] and model.v.tolist() == [0.0]


@pytest.mark.parametrize("rule", [(0, 1, 1.0), (2, 1, 1.0), (1, 0, 1.0), (1, 10**400, 1.0), (1.5, 2, 1.0), (1, 1, 0.0)])
def test_an_alarm_rule_out_of_range_is_refused(rule: tuple[Any, ...]) -> None:
    refuses(ModelError, "^alarm: ", AlarmRule, *rule)


# --- the file ------------------------------------------------------------------------------------------------


@st.composite
def models(draw: st.DrawFn) -> UncertainLTI:
    """Any model that can be saved, with everything a file holds."""
    rng = np.random.default_rng(draw(seeds))
    n, m = draw(st.tuples(st.integers(1, 3), st.integers(0, 2)))
    model = random_model(rng, n, m, additive=draw(st.booleans()))
    name = st.text(st.characters(codec="utf-8"), min_size=1, max_size=6)
    names = draw(st.lists(name, min_size=n + m, max_size=n + m, unique=True))
    number = st.floats(-LARGEST, LARGEST)
    positive = st.floats(1 / LARGEST, LARGEST)
    seconds = st.floats(1e-300, LONGEST_S)

    def listed(i: int) -> Signal:
        told = names[i], "/x" if i < n else "/u", f"d[{i}]", draw(number), draw(positive), draw(name), "pkg/msg/Type"
        of_control = (None, 0) if i < n else (draw(st.none() | st.floats(0, 1e9)), draw(st.integers(0, 5)))
        limits = draw(st.sampled_from([None, (-1.5, 2.0), (0.0, INF), (-INF, 1e9)]))
        return Signal(*told, *of_control, limits, draw(st.sampled_from([(), (2.146e9,), (-1.0, 0.1)])))

    given = [listed(i) for i in range(n + m)]
    memories = draw(st.lists(st.sampled_from(["lag(d[0], 2)", "diff(d[0])", "rate(u)"]), max_size=m, unique=True))
    for i, field in enumerate(memories, start=n):
        given[i] = replace(given[i], topic="/x", field=field, delay=0)
    limits = {"max_gap": draw(seconds), "min_step": draw(st.floats(0, 1)), "max_skew": draw(st.none() | seconds)}
    limits |= {"step": draw(st.sampled_from(["recorded", 0.002]))}
    time = {"/x": "header"} | ({"/u": "log"} if m > len(memories) else {})
    signals = SignalMap(tuple(given[:n]), tuple(given[n:]), clock="/x", time=time, **limits)
    box = [draw(hnp.arrays(float, k, elements=number)) for k in (n, n, m, m)]
    if draw(st.booleans()):
        box[0][0] = -INF
    known = {"sampling": Sampling(0.1, 0.05, 0.2), "domain": draw(st.sampled_from([Domain(*box), None]))}
    facts = {"criterion": "qp", "numbers": [1, 2.5, None], "inner": {"a": "ä"}}
    said = {"fit_summary": facts, "validation": {"inside": draw(number)}}
    A, rule = draw(hnp.arrays(float, (n, n), elements=number)), AlarmRule(2, draw(st.integers(2, 9)), draw(positive))
    return model.replace(A=A, signals=signals, alarm_rule=rule, **known, **said)


@settings(max_examples=40)
@given(models())
def test_a_saved_model_is_the_same_to_the_last_bit(tmp_path_factory, model):
    path = tmp_path_factory.getbasetemp() / "any.model.json"
    model.save(path)
    loaded = UncertainLTI.load(path)
    for name in ARRAYS:
        assert bits(getattr(loaded, name)) == bits(getattr(model, name))
    for name in ("x_min", "x_max", "u_min", "u_max"):
        assert bits(getattr(loaded.domain, name)) == bits(getattr(model.domain, name))
    assert loaded.to_dict() == model.to_dict()


def test_a_model_fitted_to_arrays_has_a_file_too(tmp_path: Path) -> None:
    model = UncertainLTI(np.eye(2), np.ones((2, 0)), np.eye(2), np.ones((2, 0)))
    model.save(tmp_path / "m.json")
    loaded = UncertainLTI.load(tmp_path / "m.json")
    assert (loaded.n, loaded.m, loaded.state_names) == (2, 0, ("x1", "x2"))
    assert loaded.bounds(np.ones(2), np.ones(0), 0.1)[0].shape == (2,)
    assert not loaded.domain.outside(np.full(2, 1e300), np.ones(0))


def test_numbers_that_json_lacks_become_null_and_the_rest_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "m.json"
    odd = {"a": NAN, "b": np.arange(2), "c": np.float64(INF), "d": np.bool_(1)}
    model = UncertainLTI(ONE, ONE, ONE, ONE, fit_summary=odd)
    model.save(path)
    assert UncertainLTI.load(path).fit_summary == {"a": None, "b": [0, 1], "c": None, "d": True}
    whole = path.read_bytes()
    for bad, remedy in (
        ({"a": object()}, "mend its fit"),
        ({"a": "bag\udcef.mcap"}, "rename the recording whose name is not UTF-8"),
        ({"a": {1, 2}}, "mend its fit"),
    ):
        refuses(ModelError, f"what JSON cannot .*{remedy}", model.replace(fit_summary=bad).save, path)
        assert path.read_bytes() == whole and os.listdir(tmp_path) == ["m.json"]


def base() -> dict[str, Any]:
    """A whole, well-formed file of two states and one control."""
    common = {"type": "std_msgs/msg/Float64", "field": "data", "unit": "", "steady": 0.5, "scale": 2.0}
    signals = [{"name": n, "topic": f"/{n}"} | common for n in ("a", "b", "u")]
    return {
        "format": FORMATS[0],
        "states": signals[:2],
        "controls": [signals[2] | {"max_hold": 0.5, "delay": 1}],
        "sampling": {
            "clock": "/a",
            "clock_type": "std_msgs/msg/Float64",
            "time": {"/a": "header", "/b": "log", "/u": "log"},
            "dt_median": 0.1,
            "dt_min": 0.05,
            "dt_max": 0.2,
            "max_gap": 0.25,
            "min_step": 0.0,
            "max_skew": 0.1,
        },
        "A": [[-1.0, 0.5], [0.0, -2.0]],
        "B": [[1.0], [2.0]],
        "dA": [[0.1, 0.2], [0.0, 0.3]],
        "dB": [[0.1], [0.0]],
        "c": [0.0, 0.1],
        "dc": [0.0, 0.1],
        "v": [0.0, 0.1],
        "domain": {"x_min": [-1.0, -1.0], "x_max": [1.0, None], "u_min": [-1.0], "u_max": [1.0]},
        "alarm": {"violations": 2, "window": 3, "margin": 1.5},
        "fit": {"criterion": "qp"},
        "validation": {},
    }


def write(folder: Path, data: Any) -> Path:
    path = folder / "damaged.model.json"
    path.write_text(json.dumps(data))
    return path


def test_the_base_of_the_damaged_files_is_whole(tmp_path: Path) -> None:
    model = UncertainLTI.load(write(tmp_path, base()))
    assert (model.n, model.m, model.alarm_rule.window, model.signals.max_skew) == (2, 1, 3, 0.1)
    assert model.to_dict() == base()


@cache
def armed_text() -> str:
    model = armed_model(np.random.default_rng(0), everything=True)
    return json.dumps(model.replace(signatures=[Signature("a fault", [1], np.ones((1, 3, 3)) / 3)]).to_dict())


def armed() -> dict[str, Any]:
    """A whole file of a model of three states: a schedule, horizons, rules, repeats, signatures."""
    return dict(json.loads(armed_text()))


def put(data: dict[str, Any], place: str, value: Any) -> Any:
    """The data with one thing at `a.b.0` replaced; `...` takes it away."""
    inner: Any = data
    *way, last = [int(p) if p.isdigit() else p for p in place.split(".")]
    for step in way:
        inner = inner[step]
    if value is ...:
        del inner[last]
    elif isinstance(inner, list) and last == len(inner):
        inner.append(value)
    else:
        inner[last] = value
    return data


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        ("format", ..., "no field 'format'"),
        (
            "format",
            "uncertain-lti/3",
            "format is 'uncertain-lti/3', and this version reads uncertain-lti/1, uncertain-lti/2",
        ),
        *[
            (name, ..., f"field '{name}' is missing")
            for name in ("states", "controls", "sampling", "A", "B", "dA", "dB")
        ],
        ("A_", [[1.0]], "unknown field 'A_'"),
        ("A", [[1.0, 2.0], [3.0]], "field 'A' is not an array of numbers"),
        ("dA", np.full((2, 2), NAN).tolist(), "field 'dA' holds a number that is not finite"),
        ("c", [True, False], "field 'c' is not an array of numbers"),
        ("dc", [0.0], "field 'dc' has shape"),
        ("dA.0.0", -1e-9, "field 'dA' holds a negative half-width"),
        ("v.0", -0.1, "field 'v' holds a negative half-width"),
        ("states.0.name", ..., r"states\[0\]: 'name' is missing"),
        ("states.0.colour", "red", r"states\[0\]: unknown key 'colour'"),
        ("states.0.scale", NAN, "scale is nan"),
        ("states.0.scale", "auto", "signal 'a': scale is auto and not resolved; give a number"),
        ("states.0.steady", INF, "signal 'a': steady is inf"),
        ("sampling", [], "field 'sampling' is not an object"),
        ("sampling.maxgap", 1.0, "unknown field 'sampling.maxgap'; known are clock"),
        ("sampling.clock", 7, "field 'sampling.clock' is 7; it must be a text"),
        ("sampling.time", {"/a": "wall"}, r"sampling.time\[/a\] is 'wall'; it must be header or log"),
        ("sampling.time", [], "field 'sampling.time' is not an object"),
        ("sampling.max_gap", 0, "field 'sampling.max_gap' is 0; it must be a positive number"),
        ("sampling.min_step", -1, "field 'sampling.min_step' is -1"),
        ("sampling.dt_median", 10**400, "field 'sampling.dt_median' is 1000"),
        ("domain", [], "field 'domain' is not an object"),
        ("domain.x_min", ..., "field 'domain.x_min' is missing"),
        ("domain.x_min", [0.0], "field 'domain.x_min' must be a list of 2 numbers"),
        ("domain.u_max", [NAN], "field 'domain.u_max' holds a number that is not finite"),
        ("domain.z_min", [], "unknown field 'domain.z_min'"),
        ("alarm", None, "field 'alarm' is not an object"),
        ("alarm.violations", True, "alarm: violations is True of window 3; it takes whole numbers"),
        ("alarm.margin", 0, "alarm: margin is 0; it must be a positive number"),
        ("alarm.latch", True, "unknown field 'alarm.latch'"),
        ("fit", [], "field 'fit' is not an object"),
        ("validation", "good", "field 'validation' is not an object"),
        # what the arithmetic cannot carry
        ("A.0.0", 1e300, r"field 'A' holds a number above 1e\+50"),
        ("v.0", 1e200, r"field 'v' holds a number above 1e\+50"),
        ("sampling.max_gap", 1e308, r"max_gap' is 1e\+308; it must be a positive number, at most 9e\+09"),
        ("sampling.dt_median", 1e300, r"dt_median' is 1e\+300; it must be a positive number, at most 9e\+09"),
        ("states.0.scale", 1e-320, r"scale is 1e-320; it must be .*, 1e-50 to 1e\+50"),
        ("states.0.steady", 1e308, r"steady is 1e\+308; it must be .*, up to 1e\+50"),
        ("alarm.margin", 1e308, r"margin is 1e\+308; it must be .*, 1e-50 to 1e\+50"),
    ],
)
def test_a_damaged_file_is_refused_by_file_and_field(place: str, value: Any, words: str, tmp_path: Path) -> None:
    refused(write(tmp_path, put(base(), place, value)), words)


def refused(path: Path, words: str) -> None:
    sentence = refuses(ModelError, words, UncertainLTI.load, path)
    assert sentence.startswith(str(path)) and len(sentence.splitlines()) == 1 and len(sentence) < 500


ENERGY = {"kind": "energy", "window_s": 1.0, "threshold": 0.5}
RULES: list[tuple[Any, str]] = [
    (7, "must be a list"),
    ([7], r"alarm.rules\[0\]' is not an object"),
    ([{"kind": "chi2", "window_s": 1.0}], r"rules\[0\].threshold' is missing"),
    ([{"kind": "containment", "violations": 1, "window": 1, "margin": "x"}], r"rules\[0\]': margin is 'x'"),
    ([{"kind": "containment", "violations": 2, "window": 1, "margin": 1}], r"rules\[0\].*violations is 2 of window 1"),
    *(
        ([ENERGY | change], rf"alarm.rules\[0\].*{words}")
        for change, words in (
            ({"kind": "median"}, "kind.* is 'median'; it must be one of containment, energy"),
            ({"window_s": -1}, "window_s of energy is -1; it must be a number of seconds, 0 for one verdict"),
            ({"window_s": True}, "window_s of energy is True"),
            ({"threshold": -1}, "threshold of energy is -1"),
            ({"threshold": [1.0, None]}, "threshold of energy"),
            ({"horizon": 1.5}, r"horizon is 1.5; it must be a whole number"),
            ({"kind": "cusum", "window_s": 0}, "window_s of cusum is 0; it must be a positive number"),
            ({"kind": "cusum", "allowance": -1}, "allowance is -1"),
            ({"kind": "chi2", "threshold": [1.0, 1.0]}, "chi2 is one number for all states"),
        )
    ),
    ([ENERGY | {"allowance": 0.1}], r"unknown field 'alarm.rules\[0\].allowance'"),
]
RESIDUALS: list[tuple[str, Any, str]] = [
    ("", [], "residuals' is not an object"),
    (".covariance", ..., "residuals.covariance' is missing"),
    (".odd", 1, "unknown field '.*residuals.odd'"),
    (".relative", 1, "relative' is 1; it must be true"),
    ("", {"mean": [0.0], "covariance": [[1.0]]}, "residuals of 1 state for 3 states"),
    (".covariance.0.1", 1e9, "not symmetric"),
    (".covariance", [[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]], "negative variance"),
    (".covariance", [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1e-10]], "negative variance"),
    (".covariance", [[1.0, 0.0, 0.0]], "has shape"),
]


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        ("blocks.0", ..., "blocks"),
        ("blocks.1.A", ..., r"blocks\[1\].A"),
        ("blocks.1.v.0", -1.0, r"blocks\[1\].v"),
        ("blocks.1.tied_to", 99, "tied_to"),
        ("blocks.1.odd", 7, "odd"),
        ("A", [[1.0]], "unknown field 'A'"),
        ("schedule.0.signal", "torque", "torque"),
        ("format", "uncertain-lti/1", "'A' is missing"),
        ("scheduling.1", {"name": "w", "topic": "", "field": "w"}, "schedules nothing"),
        ("horizons.0.steps", True, "whole number, 2 to"),
        ("horizons.0.steps", MOST_STEPS + 1, "whole number"),
        ("horizons.0.steps", 40, "two have as many steps"),
        ("horizons.0.widths", "wide", "growing or constant"),
        ("horizons.0.widths", "constant", "dA, dB or dc is not 0"),
        ("horizons.0.blocks", [], r"horizons\[0\].blocks"),
        ("horizons.0.odd", 1, "odd"),
        ("horizons", {}, "'horizons' is not a list of horizons"),
        ("horizons.0.blocks.0.A", [[1.0]], r"horizons\[0\].blocks\[0\].A"),
        ("horizons.0.blocks.0.v.1", -1.0, "negative half-width"),
        ("run", [], "'run' is not an object"),
        ("run.blocks", [], "a list of 6 blocks"),
        ("run.blocks.0.c", ..., r"'run.blocks\[0\].c' is missing; fit the model"),
        ("run.blocks.0.A.1.1", INF, "not finite"),
        ("frozen", [1.0, 1.0], "frozen"),
        ("frozen.longest_repeat_s", [1.0], "frozen"),
        ("frozen.longest_repeat_s", [[1.0, 1.0]], "a list with one number per state"),
        ("domain.step_max", [-1.0, 1.0, 1.0], "'domain.step_max' holds a negative number"),
        ("frozen.longest_repeat_s.1", -1.0, "longest_repeat_s"),
        ("frozen.longest_repeat_s.1", True, "longest_repeat_s"),
        ("frozen.largest_run", [1.0], "largest_run"),
        ("frozen.more", 1, "frozen.more"),
        ("frozen.longest_repeat_s", ..., "longest_repeat_s"),
        ("signatures.0.label", "", "label"),
        ("signatures", {}, "'signatures' must be a list of objects"),
        ("signatures.0.steps", 2, r"'signatures\[0\].steps' must be a list"),
        ("signatures.0.steps", [2, 1], "steps"),
        ("signatures.0.steps", [True], "whole numbers"),
        ("signatures.0.moments", [[[1.0]]], "states"),
        ("signatures.0.recordings", 0, "whole numbers"),
        ("signatures.0.more", 1, "unknown field"),
        ("signatures", armed()["signatures"] * 2, "different labels, at most 256"),
        ("domain.measure.cells", True, "domain.measure.cells"),
        ("domain.measure.cells", 65, "domain.measure.cells"),
        ("domain.measure.cells", 5, "domain.measure.occupied"),
        ("domain.measure.occupied", "?", "domain.measure.occupied"),
        ("domain.measure.more", 1, "domain.measure"),
        *(("alarm.rules", rules, words) for rules, words in RULES),
        *((f"residuals{place}", value, words) for place, value, words in RESIDUALS),
        *((f"horizons.0.residuals{place}", value, f"(?=.*horizon).*{words}") for place, value, words in RESIDUALS),
    ],
)
def test_a_damaged_file_with_everything_armed_is_refused_by_file_and_field(place, value, words, tmp_path):
    refused(write(tmp_path, put(armed(), place, value)), words)


def test_the_file_with_everything_armed_is_whole(tmp_path: Path) -> None:
    data = armed()
    assert UncertainLTI.load(write(tmp_path, data)).to_dict() == data
    data["alarm"] = {"rules": [ENERGY]}
    assert UncertainLTI.from_dict(data).alarm == (StatisticRule("energy", 1.0, 0.5),)


@pytest.mark.parametrize("seed", range(30))
def test_a_model_of_any_parts_comes_back_from_its_file(seed: int, tmp_path: Path) -> None:
    """Of no schedule, one or two signals, some horizons, rules of any kind, with and without a run and repeats."""
    model = armed_model(np.random.default_rng(seed))
    model.save(tmp_path / "m.model.json")
    again = UncertainLTI.load(tmp_path / "m.model.json")
    assert again.to_dict() == model.to_dict() and model.to_dict()["format"] == "uncertain-lti/2"
    for part in ("schedule", "block_data", "alarm"):
        assert getattr(again, part) == getattr(model, part), part
    for mine, theirs in zip([model, *model.horizons], [again, *again.horizons], strict=True):
        assert all(bits(getattr(mine, name)) == bits(getattr(theirs, name)) for name in ARRAYS)
    assert (again.run is None) == (model.run is None) and (again.repeats is None) == (model.repeats is None)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is not JSON"),
        (b"[" * 200_000, "is not JSON"),
        (b'{"format": ' + b"[" * 900 + b"]" * 900 + b"}", "is not JSON|format is"),
        (json.dumps(base()).encode()[:-40], "is not JSON"),
        (b'{"format": "uncertain-lti/1", "format": "uncertain-lti/1"}', "the key 'format' stands twice in one object"),
        (b"[]", "no field 'format'"),
        (b"\xef\xbb\xbf{}", "no field 'format'"),  # a mark of an editor before the text
        (b"9" * 10_000, "is not JSON"),
    ],
)
def test_a_file_that_is_no_model_is_refused(content: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / "no.model.json"
    path.write_bytes(content)
    refused(path, words)


def test_a_file_that_is_not_there_or_far_too_large(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="there is no such model file; write one with `uncertain-lti fit`"):
        UncertainLTI.load(tmp_path / "none.model.json")
    refuses(ModelError, "this is a folder, and a model file is wanted here", UncertainLTI.load, tmp_path)
    with open(tmp_path / "large.model.json", "wb") as stream:
        stream.truncate(1 << 40)
    refuses(ModelError, "larger than 64 MiB, so not a model file", UncertainLTI.load, tmp_path / "large.model.json")


@settings(max_examples=100)
@given(damaged(base, st.text(max_size=3)))
def test_a_damaged_file_is_a_model_or_an_error(tmp_path_factory: pytest.TempPathFactory, data: Any) -> None:
    """Never another exception; and what loads can be saved, loaded again and used."""
    path = write(tmp_path_factory.getbasetemp(), data)
    try:
        model = UncertainLTI.load(path)
    except UncertainLTIError as error:
        assert str(error).startswith(str(path)) and len(str(error).splitlines()) == 1
        return
    model.save(path)
    again = UncertainLTI.load(path)
    with np.errstate(all="ignore"):
        for one, other in zip(model.bounds([0.1, 0.2], [0.3], 0.1), again.bounds([0.1, 0.2], [0.3], 0.1), strict=True):
            assert bits(one) == bits(other)


# --- writing is atomic ---------------------------------------------------------------------------------------


def test_a_write_that_fails_leaves_the_old_file_and_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "m.json"
    model = random_model(np.random.default_rng(0), 2, 1)
    model.save(path)
    whole = path.read_bytes()

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(ModelError, match="cannot be written: No space left on device; choose another place"):
            model.replace(v=[1.0, 1.0]).save(path)
    assert path.read_bytes() == whole and os.listdir(tmp_path) == ["m.json"]
    (tmp_path / "folder").mkdir()
    refuses(ModelError, "folder: cannot be written", model.save, tmp_path / "folder")
    refuses(ModelError, "cannot be written: No such file or directory", model.save, tmp_path / "none" / "m.json")
    assert sorted(os.listdir(tmp_path)) == ["folder", "m.json"]
