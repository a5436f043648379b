# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Models to and from python-control and MATLAB files: what comes back is what went, and means the same."""

from importlib.util import find_spec
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refuses
from test_schedule import scheduled

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI, read_transients, validate
from uncertain_lti.base.errors import ModelError, UncertainLTIError
from uncertain_lti.base.text import MOST
from uncertain_lti.identification import fit
from uncertain_lti.model.repeats import Repeats
from uncertain_lti.model.schedule import Axis, BlockData, Schedule
from uncertain_lti.model.terms import ARRAYS
from uncertain_lti.reports import figures
from uncertain_lti.signals.signal_map import Signal, SignalMap

if not find_spec("control"):
    pytest.skip("python-control is not installed", allow_module_level=True)
scipy_io = pytest.importorskip("scipy.io", reason="scipy is not installed")


def some_model(n=2, m=1, seed=0, drift=True, names=None):
    rng = np.random.default_rng(seed)
    states = tuple(Signal(f"x {i}" if names is None else names[i], "", "x", i + 1.0, 2.0 + i, "rpm") for i in range(n))
    controls = tuple(Signal(f"u{j}", "", "u", -1.0, 0.5 + j, "") for j in range(m))
    return UncertainLTI(
        rng.normal(size=(n, n)), rng.normal(size=(n, m)), rng.random((n, n)), rng.random((n, m)),
        rng.normal(size=n) if drift else None, rng.random(n), rng.random(n), signals=SignalMap(states, controls),
    )  # fmt: skip


def loaded(path, *without):
    """The variables of a MATLAB file."""
    return {k: v for k, v in scipy_io.loadmat(path).items() if not k.startswith(("__", *without))}


def same(a, b, exactly=True):
    for name in ARRAYS:
        left, right = getattr(a, name), getattr(b, name)
        assert np.array_equal(left, right) if exactly else np.allclose(left, right, rtol=1e-12, atol=1e-12), name


# --- python-control ---------------------------------------------------------------------------------------------


@settings(max_examples=20)
@given(st.integers(1, 5), st.integers(0, 3), st.integers(0, 9), st.booleans(), st.booleans())
def test_there_and_back(n, m, seed, drift, recorded):
    model = some_model(n, m, seed, drift or not m)  # a system without any input is none to python-control
    for dt in (None, 0.025):
        system = model.to_control(dt, recorded)
        assert list(system.state_labels) == list(model.state_names) and system.dt == (dt or 0)
        widths = {name: getattr(model, name) for name in ("dA", "dB", "dc", "v")}
        again = UncertainLTI.from_control(system, **widths, signals=model.signals, recorded=recorded)
        same(model, again, exactly=dt is None and not recorded)
        assert again.signals == model.signals


def test_its_simulation_is_eq_3():
    """`control.forced_response` of the discrete system is the free run of the nominal model."""
    import control

    model = some_model(3, 2, 5)
    A = model.A - 3 * np.eye(3)
    model = model.replace(A=A)
    rng, dt = np.random.default_rng(1), 0.02
    u = rng.normal(size=(50, 2))
    system = model.to_control(dt)
    drift = np.ones((1, 50))
    response = control.forced_response(system, np.arange(50) * dt, np.vstack([u.T, drift]), [0.1, 0.2, 0.3])
    assert np.allclose(response.states.T, model.simulate([0.1, 0.2, 0.3], u, dt)[:-1])
    # in recorded units the same run, scaled
    recorded = model.to_control(dt, recorded=True)
    X, U = model.operating_point.X, model.operating_point.U
    inputs, begin = np.vstack([(u * U).T, drift]), X * np.array([0.1, 0.2, 0.3])
    scaled = control.forced_response(recorded, np.arange(50) * dt, inputs, begin)
    assert np.allclose(scaled.states.T, response.states.T * X)


def test_what_is_no_model_is_refused():
    import control

    model = some_model()
    refuses(ModelError, "positive number of seconds", model.to_control, dt=0.0)
    ss = control.ss([[0.5]], [[1.0]], [[2.0]], [[0.0]])
    refuses(ModelError, "outputs are not its states", UncertainLTI.from_control, ss)
    with pytest.raises(ModelError, match="does not say its step"):
        UncertainLTI.from_control(control.ss([[0.5]], [[1.0]], [[1.0]], [[0.0]], True))
    refuses(ModelError, "need the scales", UncertainLTI.from_control, model.to_control(recorded=True), recorded=True)
    refuses(ModelError, "dA", UncertainLTI.from_control, model.to_control(), dA=[[1.0]])
    with pytest.raises(ModelError, match="called 'disturbance'"):
        UncertainLTI(
            [[1.0]], [[1.0]], [[0.0]], [[0.0]], [1.0],
            signals=SignalMap((Signal("x", "", "x"),), (Signal("disturbance", "", "u"),)),
        ).to_control()  # fmt: skip


def test_a_system_that_calls_the_disturbance_a_drift_still_reads():
    model = some_model(drift=True)
    older = model.to_control()
    older.set_inputs([*older.input_labels[:-1], "drift"])
    assert np.array_equal(UncertainLTI.from_control(older).c, model.c)


# --- MATLAB -----------------------------------------------------------------------------------------------------


@settings(max_examples=15)
@given(st.integers(1, 4), st.integers(0, 3), st.integers(0, 9))
def test_a_mat_file_gives_back_the_whole_model(tmp_path_factory, n, m, seed):
    model = some_model(n, m, seed, names=["Δp", "n 1", "T4", "x"])
    path = tmp_path_factory.mktemp("mat") / "model.mat"
    model.save_mat(path)
    again = UncertainLTI.load_mat(path)
    assert again.to_dict() == model.to_dict()
    seen = scipy_io.loadmat(path)
    assert seen["A"].shape == (n, n) and seen["B"].shape == (n, m) and seen["v"].shape == (n, 1)
    assert [str(name[0][0]) for name in seen["state_names"]] == list(model.state_names)
    assert seen["x_scale"].ravel().tolist() == model.operating_point.X.tolist()


def test_a_file_written_by_hand(tmp_path):
    """A, B, dA, dB alone, names as a char matrix padded with blanks, B sparse."""
    from scipy.sparse import csc_matrix

    path = tmp_path / "m.mat"
    scipy_io.savemat(
        path,
        {
            "A": [[-1.0, 0.5], [0.0, -2.0]], "B": csc_matrix([[0.0], [3.0]]), "dA": np.eye(2), "dB": [[0], [1]],
            "state_names": np.array(["speed", "p   "]), "x_scale": [100.0, 2.0],
        },
    )  # fmt: skip
    model = UncertainLTI.load_mat(path)
    assert model.state_names == ("speed", "p") and model.control_names == ("u1",)
    assert model.B.tolist() == [[0.0], [3.0]] and model.operating_point.X.tolist() == [100.0, 2.0]
    assert not model.v.any()


def test_mat_files_that_are_none(tmp_path):
    path = tmp_path / "m.mat"
    refuses(ModelError, "no such file", UncertainLTI.load_mat, path)
    for data in (b"", b"MATLAB 5.0", bytes(200), b"\x00" * 127 + b"\x02IM" + bytes(64)):
        path.write_bytes(data)
        refuses(ModelError, r"m\.mat", UncertainLTI.load_mat, path)
    model = some_model(2, 1)
    model.save_mat(path)
    whole = path.read_bytes()
    for cut in range(0, len(whole), len(whole) // 20):
        path.write_bytes(whole[:cut])
        try:
            assert UncertainLTI.load_mat(path).to_dict() == model.to_dict()
        except ModelError as error:
            assert "m.mat" in str(error)
    for change, words in (
        ({"A": None}, "no variable 'A'"),
        ({"dB": [[-1.0], [0.0]]}, "negative"),
        ({"B": np.array([["a"], ["b"]])}, "not a real matrix"),
        ({"v": [np.nan, 0.0]}, "finite"),
        ({"model_json": "{"}, "model_json"),
        ({"model_json": None, "state_names": np.array(["one"])}, "1 entry for 2 states"),
    ):
        model.save_mat(path)
        scipy_io.savemat(path, {k: v for k, v in (loaded(path) | change).items() if v is not None})
        refuses(ModelError, words, UncertainLTI.load_mat, path)
    refuses(ModelError, "cannot be written", model.save_mat, tmp_path / "no folder" / "m.mat")


# --- how results print ------------------------------------------------------------------------------------------


def rows_of(html):
    """Cells of every row; every tag is closed."""
    return [["".join(cell.itertext()) for cell in row] for row in ElementTree.fromstring(html).iter("tr")]


def run(n=2, steps=200, seed=0):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.normal(size=(steps // 10 + 1, 1)), 10, axis=0)[:steps]
    x = np.zeros((steps, n))
    for k in range(steps - 1):
        x[k + 1] = x[k] + 0.1 * (-x[k] + u[k]) + 1e-3 * rng.normal(size=n)
    return Transient(np.arange(steps) * 0.1, x, u, state_names=[f"<x{i}>" for i in range(n)], name="a & b")


@pytest.mark.numpy
def test_results_print_on_one_line_and_as_a_table():
    runs = [run(seed=s) for s in (0, 1)]
    model = fit(runs, additive="noise")
    verdicts = EnvelopeMonitor(model).check(runs[0])
    validation = validate(runs, additive="noise")
    for thing in (model, runs[0], verdicts, validation, EnvelopeMonitor(model), validation.parts[0]):
        assert "\n" not in repr(thing) and len(repr(thing)) < 300, repr(thing)
    for thing in (model, runs[0], verdicts, validation, model.signals):
        rows = rows_of(thing._repr_html_())
        assert len({len(row) for row in rows}) == 1 and len(rows) > 2
        assert any("<x0>" in cell for row in rows for cell in row), "names are escaped, and come back"
    first = rows_of(model._repr_html_())[1]
    assert first[1] == f"{model.A[0, 0]:.4g} ± {model.dA[0, 0]:.3g}"
    widths, cells = verdicts.upper[1:, 0] - verdicts.lower[1:, 0], rows_of(verdicts._repr_html_())[1]
    assert [float(cell) for cell in cells[3:5]] == pytest.approx([widths.mean(), widths.max()], rel=1e-2)
    assert widths.min() < 0.9 * widths.max()
    assert "inside all bounds: " in validation._repr_html_()
    assert "100.000% inside" in repr(verdicts) and "no alarm" in repr(verdicts)


def test_tables_of_large_and_of_empty_things():
    n = 50
    model = UncertainLTI(np.eye(n), np.zeros((n, 0)), np.eye(n), np.zeros((n, 0)))
    rows = rows_of(model._repr_html_())
    assert len(rows) == MOST + 2 and len(rows[0]) == MOST + 2
    empty = Transient([], np.empty((0, 2)), np.empty((0, 1)))
    rows_of(empty._repr_html_())
    still = Transient([0.0, 1.0], [[np.nan], [np.nan]], [[0.0], [0.0]])
    verdicts = EnvelopeMonitor(UncertainLTI([[0.0]], [[0.0]], [[0.0]], [[0.0]])).check(still)
    assert "none possible" in repr(verdicts)
    rows_of(verdicts._repr_html_())


def test_what_a_recording_left_out_is_not_the_number_of_its_samples():
    whole = Transient([0.0, 0.1, 0.2], np.ones((3, 1)), np.ones((3, 1)), counters={"samples": 3})
    assert "not used" not in whole._repr_html_() and "left out" not in whole._repr_html_()
    twice = Transient([0.0, 0.1, 0.1, 0.2], np.ones((4, 1)), np.ones((4, 1)), counters={"samples": 4})
    assert "not used, or without a verdict: 1 equal stamp<" in twice._repr_html_()


def test_a_notebook_shows_a_figure_without_being_told_how():
    from uncertain_lti.reports.figures import matrices_figure

    figure = matrices_figure(fit(run(seed=0), additive="noise"))
    assert figure._repr_png_().startswith(b"\x89PNG")


def test_a_run_goes_to_pandas_and_back():
    first = run(seed=3)
    late = Transient(first.t_ns + 1_700_000_000_123_456_789, first.x, first.u, state_names=first.state_names)
    for options, start in (({"absolute": True}, late.t_ns[0]), ({}, 0)):
        frame = late.to_dataframe(**options)
        states, controls = list(late.state_names), list(late.control_names)
        again = Transient.from_dataframe(frame, states=states, controls=controls)
        assert np.array_equal(again.t_ns, late.t_ns - late.t_ns[0] + start)
        assert np.array_equal(again.x, late.x) and np.array_equal(again.u, late.u)


@pytest.mark.parametrize(
    ("call", "why"),
    [
        (lambda m, r: fit("runs/*.mcap"), "transient 0 is of type str; read recordings with read_transients"),
        (lambda m, r: fit([r, m]), "transient 1 is of type UncertainLTI"),
        (lambda m, r: fit(None), "the recording is None"),
        (lambda m, r: EnvelopeMonitor("m.json"), "model is of type str; read a file with UncertainLTI.load"),
        (lambda m, r: EnvelopeMonitor(m).check([r]), "the recording is of type list"),
        (lambda m, r: read_transients([r], "s.yaml"), "a recording is of type Transient"),
        (lambda m, r: read_transients(["b.mcap"], m), "signals is of type UncertainLTI"),
        (lambda m, r: UncertainLTI.load(None), "the model file is None"),
        (lambda m, r: Transient.from_dataframe(r.x, states=["a"], controls=[]), "give a pandas DataFrame"),
        (lambda m, r: SignalMap(["speed"]), "one of states is of type str; give a Signal"),
        (lambda m, r: figures.envelope_figure(m, r), "verdicts is of type Transient"),
    ],
)
def test_a_value_of_another_type_is_refused_with_a_sentence(call, why):
    recording = run(seed=0)
    with pytest.raises(UncertainLTIError, match=why):
        call(UncertainLTI(-np.eye(3), np.zeros((3, 1)), np.eye(3), np.zeros((3, 1))), recording)


# --- scheduled models -------------------------------------------------------------------------------------------


def scheduled_model(axes, further=(), n=2, m=1):
    model = scheduled(np.random.default_rng(4), Schedule(axes), further, n, m)
    data = [BlockData(None if r == 1 else r, 0 if r == 2 else None) for r in range(model.schedule.blocks)]
    return model.replace(block_data=data)


KNOTS, GEAR = Axis("speed", knots=(-0.3, 0.1, 0.77)), Axis("gear", modes=(1.0, 2.0))
ONE_MODE = Axis("gear", modes=(3.0,))
SCHEDULES = [((KNOTS,), (), 1, 1), ((KNOTS, GEAR), ("gear",), 2, 0), ((ONE_MODE,), ("gear",), 2, 1)]


def test_a_scheduled_model_is_one_system_per_block_and_one_at_a_point():
    model = scheduled_model((KNOTS,))
    systems = model.to_control(dt=0.02)
    assert len(systems) == 3
    for r, system in enumerate(systems):
        assert np.allclose(system.A, np.eye(2) + 0.02 * model.A[r])
        assert list(system.input_labels) == ["c", "disturbance"]
        again = UncertainLTI.from_control(system, dA=model.dA[r], dB=model.dB[r], signals=model.signals)
        assert np.allclose(again.A, model.A[r]) and np.allclose(again.c, model.c[r])
    low, high = (np.hstack([s.A, s.B]) for s in systems[:2])
    middle = model.at(speed=3.0 + 2.0 * -0.1).to_control(0.02)  # half way from one knot to the next
    assert np.allclose(np.hstack([middle.A, middle.B]), (low + high) / 2)
    assert np.array_equal(model.to_control(0.02, knot=1).A, systems[1].A)
    calm = model.replace(c=np.where(np.arange(3)[:, None] == 1, model.c, 0.0))
    assert [list(s.input_labels) for s in calm.to_control()] == [["c", "disturbance"]] * 3
    for knot in (-1, 3):
        refuses(ModelError, "blocks 0 to 2", model.to_control, knot=knot)
    refuses(ModelError, "no schedule", some_model().to_control, knot=0)


@pytest.mark.parametrize(("axes", "further", "n", "m"), SCHEDULES)
def test_a_scheduled_model_comes_back_from_matlab(axes, further, n, m, tmp_path):
    repeats = Repeats(*np.random.default_rng(5).random((4, n)))
    model = scheduled_model(axes, further, n, m).replace(repeats=repeats)
    path = tmp_path / "m.mat"
    model.save_mat(path)
    assert UncertainLTI.load_mat(path).to_dict() == model.to_dict()
    data = loaded(path, "model_json")
    R = model.schedule.blocks
    for r in range(R):
        assert np.array_equal(np.reshape(data["A"], (n, n, R))[:, :, r], model.A[r])
        assert np.array_equal(data["c"][:, r], model.c[r])
    assert data["schedule_blocks"].tolist() == [[k + 1 for k in index] for index in model.schedule.indices]
    scipy_io.savemat(tmp_path / "own.mat", data)
    again = UncertainLTI.load_mat(tmp_path / "own.mat")
    same(model, again)
    assert again.block_data == model.block_data
    for mine, theirs in zip(model.schedule.axes, again.schedule.axes, strict=True):
        assert theirs.signal == mine.signal and np.allclose(theirs.values, mine.values, rtol=1e-12)
        assert bool(theirs.knots) == bool(mine.knots)
    assert [s.name for s in again.signals.scheduling] == list(further)


def test_what_was_changed_of_a_schedule_in_matlab_counts(tmp_path):
    model = scheduled_model((KNOTS,))
    model.save_mat(tmp_path / "m.mat")
    data = loaded(tmp_path / "m.mat")
    data["dA"][0, 1, 2] = 9.0
    data["schedule_values"][0, 0][1] = 3.2
    scipy_io.savemat(tmp_path / "m.mat", data)
    again = UncertainLTI.load_mat(tmp_path / "m.mat")
    assert again.dA[2, 0, 1] == 9.0 and np.array_equal(again.A, model.A)
    knots = again.schedule.axes[0].knots
    assert knots[0] == KNOTS.knots[0] and knots[2] == KNOTS.knots[2] and np.isclose(knots[1], (3.2 - 3.0) / 2.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.update(A=d["A"][:, :, :2]), "'A' has shape"),
        (lambda d: d.update(schedule_kinds=d["schedule_kinds"][:0]), "schedule_kinds"),
        (lambda d: d["schedule_values"][0, 0].__setitem__(1, 99.0), "must increase"),
        (lambda d: d.update(transitions=d["transitions"][:1]), "'transitions' has 1"),
        (lambda d: d["schedule_signals"].__setitem__((0, 0), "torque"), "'torque'"),
    ],
)
def test_a_damaged_schedule_is_refused_by_its_variable(change, words, tmp_path):
    scheduled_model((KNOTS,)).save_mat(tmp_path / "m.mat")
    data = loaded(tmp_path / "m.mat", "model_json")
    change(data)
    scipy_io.savemat(tmp_path / "m.mat", data)
    refuses(ModelError, words, UncertainLTI.load_mat, tmp_path / "m.mat")
