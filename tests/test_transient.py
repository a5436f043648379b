# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Transients: cut as the Sampler cuts, the same from arrays, data frames and CSV, and clear about what is wrong."""

import math
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refuses
from steps import OPENING, holds

from uncertain_lti import EnvelopeMonitor, UncertainLTI, fit
from uncertain_lti.base.errors import FitError, TransientError
from uncertain_lti.sampling.clock import Status
from uncertain_lti.sampling.sampler import Sampler
from uncertain_lti.sampling.transient import Transient, controls_as
from uncertain_lti.signals.signal_map import Signal, SignalMap

NAN, INF = math.nan, math.inf
TICK = 10_000_000  # ns

# --- the same rules as the Sampler ---------------------------------------------------------------------------


@st.composite
def runs(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, float]:
    """t (ns), x, u, max_gap, min_step: equal stamps, steps back small and large, gaps, NaN."""
    n, m = draw(st.integers(1, 3)), draw(st.integers(0, 2))
    steps = draw(st.lists(st.sampled_from([1, 1, 1, 2, 2, 3, 0, 5, 6, 20, -1, -2, -5, -6, -30]), max_size=40))
    t = 100 * TICK + TICK * np.cumsum(np.array([0, *steps], dtype=np.int64))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    z = rng.normal(size=(len(t), n + m))
    broken = draw(st.sampled_from([0.0, 0.0, 0.1]))
    z[rng.uniform(size=z.shape) < broken] = NAN
    z[rng.uniform(size=z.shape) < broken / 3] = INF
    return t, z[:, :n], z[:, n:], draw(st.sampled_from([0.02, 0.05])), draw(st.sampled_from([0.0, 0.0, 0.02]))


@settings(max_examples=100)
@given(runs())
def test_cut_and_judged_usable_as_the_sampler_does(run: tuple[Any, ...]) -> None:
    t, x, u, max_gap, min_step = run
    n, m = x.shape[1], u.shape[1]
    named = (tuple(Signal(f"{a}{i}", "/c", f"{a}{i}") for i in range(k)) for a, k in (("x", n), ("u", m)))
    limits = {"max_gap": max_gap, "min_step": min_step}
    signals = SignalMap(*named, clock="/c", time={"/c": "log"}, **limits)
    sampler = Sampler(signals)
    decided = [s for i in range(len(t)) for s in sampler.push("/c", int(t[i]), None, [*x[i], *u[i]])]
    kept = [s for s in decided if not s.status.dropped]
    transient = Transient(t, x, u, max_gap=max_gap, min_step=min_step)

    holds(transient, decided)
    ok = [k for k, s in enumerate(kept) if s.status is Status.OK]
    steps = transient.transitions()
    assert steps.k.tolist() == [k - 1 for k in ok]
    for name, wanted in (("dt", [kept[k].dt for k in ok]), ("x", [kept[k].x for k in ok])):
        assert np.array_equal(getattr(steps, name), np.reshape(wanted, getattr(steps, name).shape))
    assert np.array_equal(steps.u, np.reshape([kept[k].u for k in ok], steps.u.shape))
    assert np.array_equal(steps.x_next, np.reshape([kept[k].x_next for k in ok], steps.x_next.shape))
    dropped = Counter({s.value: sampler.counters[s.value] for s in Status if s.dropped})
    assert +transient.counters == +dropped
    opens = [k for k, s in enumerate(kept) if s.status in OPENING]
    assert transient.segment.tolist() == [sum(o <= k for o in opens) - 1 for k in range(len(kept))]
    assert transient.segments == len(opens)


def test_a_part_keeps_the_step_of_its_run() -> None:
    t = [0.0, 0.1, 0.21, 0.3, 0.4]
    for step, dt in ((0.1, [0.1, 0.1]), ("recorded", [0.11, 0.09])):
        part = Transient(t, np.zeros(5), [], step=step).replace(slice(1, 4))
        np.testing.assert_allclose(part.transitions().dt, dt)


def test_what_was_counted_before_is_added_to() -> None:
    transient = Transient([0.0, 1.0, 1.0, 2.0], np.zeros(4), [], counters={"equal stamp": 2, "late /u": 3})
    assert transient.counters == {"equal stamp": 3, "late /u": 3}
    assert transient.replace(name="again").counters == transient.counters
    assert not +transient.replace(slice(1, 3)).counters


def test_the_default_gap_is_two_and_a_half_median_steps() -> None:
    steps = [1.0] * 10 + [2.5, 2.500000002, 1.0]
    t = np.concatenate([[0.0], np.cumsum(steps)])
    transient = Transient(t, np.zeros(len(t)), [])
    assert transient.max_gap == 2.5
    assert np.flatnonzero(np.diff(transient.segment)).tolist() == [11]
    assert Transient(t, np.zeros(len(t)), [], max_gap=INF).segments == 1
    assert Transient([5.0], [0.0], []).max_gap == INF


def test_the_default_gap_is_of_the_samples_that_min_step_leaves() -> None:
    t = np.arange(1000) * 0.002
    transient = Transient(t, np.zeros(1000), [], min_step=0.01)
    assert transient.max_gap == pytest.approx(0.025)
    assert np.allclose(transient.dt, 0.01) and transient.segments == 1
    assert transient.counters["short step"] == 800


# --- time ----------------------------------------------------------------------------------------------------


@given(st.integers(-(10**9), 10**9), st.lists(st.integers(5, 10**10), min_size=1, max_size=20))
def test_steps_are_differences_of_whole_nanoseconds(start: int, steps: list[int]) -> None:
    t = start * 10**9 + np.concatenate([[0], np.cumsum(steps)])
    transient = Transient(t, np.zeros(len(t)), [], max_gap=INF)
    assert transient.dt.tolist() == [s * 1e-9 for s in steps]
    assert transient.t[0] == 0.0 and transient.t[-1] == sum(steps) * 1e-9


@pytest.mark.parametrize("step_ns", [25_000_000, 100_000_000, 7_000_000, 1_000_000, 500, 123_456_789])
def test_seconds_are_rounded_to_nanoseconds(step_ns: int) -> None:
    transient = Transient(step_ns * 1e-9 * np.arange(1201), np.zeros(1201), [])
    assert transient.t_ns.tolist() == [step_ns * k for k in range(1201)]
    assert set(transient.dt.tolist()) == {step_ns * 1e-9}


def test_numpy_times_are_times() -> None:
    t = np.array(["2026-01-01T00:00:00", "2026-01-01T00:00:01"], dtype="datetime64[us]")
    assert Transient(t, [0.0, 1.0], []).dt.tolist() == [1.0]
    assert Transient(t - t[0], [0.0, 1.0], []).t_ns.tolist() == [0, 10**9]


# --- shapes, names and what a person sees ---------------------------------------------------------------------


def test_nothing_can_be_changed_afterwards_and_nothing_was_borrowed() -> None:
    x = np.zeros((3, 1))
    transient = Transient([0.0, 1.0, 2.0], x, [])
    x[:] = 7.0
    assert not transient.x.any()
    for name in ("t_ns", "x", "u", "segment"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(transient, name)[0] = 1


def test_a_control_acts_as_it_was_recorded_at_the_departure_or_at_the_arrival_of_a_step() -> None:
    """Of the samples that are left once those too soon after another are dropped."""
    t, x, u = [0.0, 1.0, 1.0, 2.0, 3.0], np.zeros((5, 1)), np.array([[0.0, 5], [1, 6], [9, 9], [2, 7], [3, 8]])
    arrival, both = Transient(t, x, u, at="arrival"), Transient(t, x, u, at={"u2": "both"})
    assert arrival.transitions().u.tolist() == [[1, 6], [2, 7], [3, 8]]
    assert (arrival.control_names, arrival.ends) == (("u1", "u2"), ("arrival", "arrival"))
    assert both.transitions().u.tolist() == [[0, 5, 6], [1, 6, 7], [2, 7, 8]]
    assert both.control_names == ("u1", "u2", "u2 at arrival") and both.ends == ("departure", "departure", "arrival")
    taken = [Signal("u1", "", "a"), Signal("u2", "", "b"), Signal("u2 at arrival", "", "b", at="arrival")]
    assert controls_as(Transient(t, x, u), taken).ends == both.ends
    again = Transient(t, x, u).controls_at("both")
    assert Transient(t[:0], x[:0], u[:0]).controls_at("arrival").u.shape == (0, u.shape[1])
    assert again.transitions().u.tolist() == [[0, 1, 5, 6], [1, 2, 6, 7], [2, 3, 7, 8]]
    assert again.controls_at("both").ends == again.ends == again.replace(slice(0, 2)).ends
    for at, words in (("end", "at is 'end'; it must be departure"), ({"v": "both"}, "there is no control 'v'")):
        refuses(TransientError, words, Transient, t, x, u, at=at)
    refuses(TransientError, "control 'u1' is at the arrival", arrival.controls_at, {"u1": "both"})


def test_a_control_that_is_delayed_or_taken_from_earlier_samples_stays_at_the_departure() -> None:
    fields = [("now", "data[0]", 0), ("late", "data[1]", 2), ("before", "lag(data[0], 1)", 0)]
    signals = SignalMap(
        [Signal("x", "/x", "data")], [Signal(name, "/u", at, delay=delay) for name, at, delay in fields]
    )
    plain = Transient(np.arange(3.0), np.zeros((3, 1)), np.zeros((3, 3)), signals=signals)
    taken = plain.controls_at("arrival")
    assert taken.ends == tuple(c.at for c in taken.signals.controls) == ("arrival", "departure", "departure")


def test_a_model_takes_controls_from_the_ends_that_it_was_fitted_to(tmp_path: Path) -> None:
    """x follows the mean of u over the step, so both ends of it are needed; the file of the model says so."""
    rng = np.random.default_rng(3)
    t, u = 0.1 * np.arange(200), rng.normal(size=(200, 1))
    x = np.concatenate([[0.0], np.cumsum(0.05 * (u[1:, 0] + u[:-1, 0]))])
    plain = Transient(t, x, u)
    model = fit([plain.controls_at("both")], "lp", additive="noise", alarm="containment")
    assert model.fit_summary["max_width"][0] < 1e-6 * np.ptp(x)
    model.save(tmp_path / "both.model.json")
    loaded = UncertainLTI.load(tmp_path / "both.model.json")
    assert [(c.name, c.at) for c in loaded.signals.controls] == [("u1", "departure"), ("u1 at arrival", "arrival")]
    assert EnvelopeMonitor(loaded).check(plain).judged[1:].all() and not np.isnan(loaded.free_run(plain).x).any()
    with pytest.raises(FitError, match="controls u1, u1 at arrival"):
        fit([plain, plain.controls_at("both")], "lp", additive="noise", alarm="containment")


def test_an_empty_run_and_a_single_sample_have_no_transition() -> None:
    for count in (0, 1):
        transient = Transient(np.zeros(count), np.zeros((count, 2)), np.zeros((count, 1)))
        assert len(transient) == count and transient.segments == count
        assert len(transient.transitions().k) == len(transient.usable) == len(transient.dt) == 0
        assert transient.statuses() == [Status.FIRST] * count
        assert "0 usable transitions" in repr(transient)
    one = Transient(np.arange(2.0), np.zeros((2, 1)), np.zeros((2, 1)))
    assert repr(one).endswith("1 usable transition in 1 segment)")


@pytest.mark.parametrize(
    ("arguments", "options", "words"),
    [
        (([0.0, 1.0], [[1.0], [2.0, 3.0]], []), {}, "x is not numeric"),
        (([0.0, 1.0], [1.0, 2.0], ["a", "b"]), {}, "u is not numeric"),
        (([0.0, 1.0], [1.0], []), {}, r"x has shape \(1, 1\), and t has 2 instants; give one row of x per instant"),
        (([0.0, 1.0], [1.0, 2.0], [1.0]), {}, r"u has shape \(1, 1\), and t has 2 instants"),
        (([0.0, 1.0], np.zeros((2, 0)), []), {}, "x has no column; give at least one state"),
        (([[0.0], [1.0]], [1.0, 2.0], []), {}, r"t has shape \(2, 1\); it must be a vector"),
        (([0.0, NAN], [1.0, 2.0], []), {}, r"t\[1\] is nan; leave out samples without a time"),
        ((np.array([0, "NaT"], "datetime64[s]"), [1.0, 2.0], []), {}, r"t\[1\] is not a time"),
        ((["a", "b"], [1.0, 2.0], []), {}, "t is not numeric; give seconds, integer nanoseconds or datetime64"),
        (([1.7e18, 1.8e18], [1.0, 2.0], []), {}, r"t reaches 1.8e\+18 s; give seconds, or nanoseconds as an array"),
        (([0, 1, 2], [1.0, 2.0, 3.0], []), {}, "integers are nanoseconds, and the steps are 1; give seconds as floats"),
        ((np.array([2**63, 2**63 + 10**9], np.uint64), [1.0, 2.0], []), {}, "past what 64 bits hold"),
        (([0.0, 1e-9], [1.0, 2.0], []), {}, "steps of 1e-09 s are too short for a nanosecond clock"),
        (([0.0, 1.0], [1.0, 2.0], []), {"max_gap": -1.0}, "max_gap is -1.0; it must be a positive number of seconds"),
        (([0.0, 1.0], [1.0, 2.0], []), {"max_gap": "1"}, "max_gap is of type str; give a number of seconds"),
        (([0.0, 1.0], [1.0, 2.0], []), {"signals": "x.yaml"}, "signals is of type str; load_signals reads a file"),
        (([0.0, 1.0], [1.0, 2.0], []), {"min_step": -1.0}, "min_step is -1.0; it must be 0 s or more"),
        (([0.0, 1.0], [1.0, 2.0], []), {"state_names": ["a", "b"]}, "2 names for 1 column of x"),
        (([0.0, 1.0], np.zeros((2, 2)), []), {"state_names": "ab"}, "give a list, one for each"),
        (([0.0, 1.0], np.zeros((2, 2)), []), {"state_names": ["a", "a"]}, "two columns of x have the same name"),
        (([0.0, 1.0], np.zeros((2, 2)), []), {"state_names": ["a", ""]}, "a column of x is called ''; give"),
        (([0.0, 1.0], np.zeros((2, 2)), []), {"state_names": [1, 2]}, "a column of x is called 1; give"),
        (([0.0, 1.0], [1.0, 2.0], []), {"state_names": 5}, "names of x is of type int; give a list of names"),
        (([0.0, 1.0], [1.0, 2.0], []), {"sources": 5}, "sources is of type int; give a list of paths"),
        (([0.0, 1.0], [1.0, 2.0], []), {"sources": [5]}, "sources: one of them is of type int; give a list of paths"),
        (([0.0, 1.0], [1.0, 2.0], []), {"notes": "abc"}, "notes is of type str; give a list of texts"),
        (([0.0, 1.0], [1.0, 2.0], []), {"counters": [1]}, "counters is of type list; give counts by name"),
        ((np.ma.masked_greater([0.0, 9.0], 5.0), [1.0, 2.0], []), {}, r"t\[1\] is masked; leave out samples without"),
    ],
)
def test_arrays_that_are_no_transient_are_refused(arguments: Any, options: Any, words: str) -> None:
    assert refuses(TransientError, words, Transient, *arguments, name="pulse", **options).startswith("pulse: ")


# --- data frames ---------------------------------------------------------------------------------------------


@pytest.fixture(name="pd")
def pandas_fixture() -> Any:
    return pytest.importorskip("pandas")


@settings(max_examples=40)
@given(runs())
def test_a_data_frame_gives_what_its_arrays_give(run: tuple[Any, ...]) -> None:
    pandas = pytest.importorskip("pandas")
    t, x, u, max_gap, min_step = run
    states, controls = [f"s{i}" for i in range(x.shape[1])], [f"c{j}" for j in range(u.shape[1])]
    frame = pandas.DataFrame(np.hstack([u, x]), columns=[*controls, *states])
    wanted = Transient(t, x, u, max_gap=max_gap, min_step=min_step)
    options = dict(states=states, controls=controls, max_gap=max_gap, min_step=min_step)
    stamps = pandas.to_datetime(t, unit="ns")
    for got in (
        Transient.from_dataframe(frame.set_axis(stamps), **options),
        Transient.from_dataframe(frame.set_axis(stamps.tz_localize("UTC").tz_convert("Asia/Tokyo")), **options),
        Transient.from_dataframe(frame.assign(when=stamps), time="when", **options),
        Transient.from_dataframe(frame.assign(when=t * 1e-9), time="when", **options),
    ):
        for name in ("t_ns", "x", "u", "segment"):
            assert np.array_equal(getattr(got, name), getattr(wanted, name), equal_nan=True)
        assert (got.state_names, got.control_names) == (tuple(states), tuple(controls))


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int64])
def test_a_step_is_any_number(kind: Any) -> None:
    assert Transient([0.0, 1.0, 2.0], [1.0, 2.0, 3.0], [], step=kind(1)).dt.tolist() == [1.0, 1.0]


def test_masked_values_are_nan() -> None:
    """As netCDF files give them; what lies under a mask is any number."""
    masked = np.ma.masked_greater([[1.0], [99.0]], 9.0)
    np.testing.assert_array_equal(Transient([0.0, 1.0], masked, masked.astype(int)).x, [[1.0], [NAN]])


def test_missing_values_of_any_kind_are_nan(pd: Any) -> None:
    frame = pd.DataFrame({"a": pd.array([1.0, None], dtype="Float64"), "b": pd.array([None, 2], dtype="Int64")})
    transient = Transient.from_dataframe(frame, states=["a", "b"], controls=[])
    np.testing.assert_array_equal(transient.x, [[1.0, NAN], [NAN, 2.0]])


def test_columns_need_not_have_texts_for_names(pd: Any) -> None:
    frame = pd.DataFrame([[0.0, 1.0, 2.0], [1.0, 3.0, 4.0]])
    transient = Transient.from_dataframe(frame, time=0, states=[1], controls=[2])  # type: ignore[arg-type]
    assert (transient.state_names, transient.x.tolist()) == (("1",), [[1.0], [3.0]])


@pytest.mark.parametrize(
    ("columns", "options", "words"),
    [
        ({}, {"states": ["y"]}, "there is no column 'y'; columns are x, u"),
        ({}, {"time": "t"}, "there is no column 't'"),
        ({"x": ["a", "b", "c"]}, {}, "column 'x' is not numeric; choose another or convert it"),
        ({"t": ["a", "b", "c"]}, {"time": "t"}, "column 't' is not numeric"),
        ({}, {"states": "x"}, "states is the text 'x'; give a list of column names"),
    ],
)
def test_a_data_frame_without_what_is_asked_is_refused(pd: Any, columns: Any, options: Any, words: str) -> None:
    frame = pd.DataFrame({"x": [1.0, 2.0, 3.0], "u": [1, 2, 3]} | columns)
    given = {"states": ["x"], "controls": ["u"]} | options
    assert refuses(TransientError, words, Transient.from_dataframe, frame, **given).startswith("data frame: ")


# --- CSV -----------------------------------------------------------------------------------------------------


def read(folder: Path, text: str | bytes, **options: Any) -> Transient:
    path = folder / "run.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return Transient.from_csv(path, **({"time": "t", "states": ["x"], "controls": ["u"]} | options))


@settings(max_examples=40)
@given(runs(), st.sampled_from([",", ";", "\t"]), st.booleans())
def test_a_csv_file_gives_what_its_arrays_give(tmp_path_factory, run, delimiter, quoted):
    t, x, u, max_gap, min_step = run
    states, controls = [f"s{i}" for i in range(x.shape[1])], [f"c{j}" for j in range(u.shape[1])]
    quote = '"{}"'.format if quoted else str
    cell = lambda v: quote("" if math.isnan(v) else repr(float(v)))  # noqa: E731
    rows = [[quote(n) for n in (*controls, "t", *states, "text")]]
    rows += [[*map(cell, u[k]), quote(repr(float(t[k] * 1e-9))), *map(cell, x[k]), "anything"] for k in range(len(t))]
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_text("\n".join(delimiter.join(row) for row in rows) + "\n\n")
    wanted = Transient(t * 1e-9, x, u, max_gap=max_gap, min_step=min_step)
    options = dict(time="t", states=states, controls=controls, delimiter=delimiter)
    if any(np.isnan(column).all() for column in np.hstack([x, u]).T):
        refuses(TransientError, "holds no number; choose another", Transient.from_csv, path, **options)
        return
    got = Transient.from_csv(path, **options, max_gap=max_gap, min_step=min_step)
    for name in ("t_ns", "x", "u", "segment"):
        assert np.array_equal(getattr(got, name), getattr(wanted, name), equal_nan=True)
    assert got.name == str(path)


@pytest.mark.parametrize(
    "text",
    [
        "t,x,u\n0,1,2\n1,2,3\n",
        b"\xef\xbb\xbft,x,u\r\n0,1,2\r\n1,2,3\r\n\r\n",
        "# t, x, u\n0, 1, 2\n# a word in between\n1, 2, 3",
        '"t","x","u"\n"0","1","2"\n"1","2","3"\n',
        "x,t,x,u\n1,0,1,2\n2,1,2,3\n",
        "u,other,t,x\n2,a,0,1\n3,b,1,2\n",
    ],
)
def test_csv_as_people_write_it(text: str | bytes, tmp_path: Path) -> None:
    transient = read(tmp_path, text)
    assert transient.t.tolist() == [0.0, 1.0]
    assert (transient.x.tolist(), transient.u.tolist()) == ([[1.0], [2.0]], [[2.0], [3.0]])


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        ("", {}, "the file is empty; its first line must name the columns"),
        ("t,x,u\n", {}, "there is no row under the header"),
        ("t;x;u\n0;1;2\n", {}, "there is no column 't'; columns are t;x;u"),
        ("t,x,u\n0,1,2\n1,2\n", {}, "line 3 has 2 cells, and the header names 3; mend the file, or is the delimiter"),
        ("t,x,u\n0,1,2\n1,a,3\n", {}, "line 3: 'a' in column 'x' is not a number; mend it, or leave the cell empty"),
        ("t,x,u\n0,1,2\n,2,3\n", {}, r"t\[1\] is nan; leave out samples without a time"),
        ("t,x,u\n0,,2\n1,,3\n", {}, "column 'x' holds no number; choose another"),
        ("t,x,u,x\n0,1,2,1\n1,2,3,7\n", {}, "column 'x' is there twice with different values; rename one"),
        ("t,x,u\n1700000000000000000,1,2\n1700000001000000000,2,3\n", {}, r"t reaches 1.7e\+18 s; give seconds"),
        (b"t,x,u\n0,1,\x80\n", {}, "cannot be read as CSV"),
        ("t,x,u\n0,1,2\0\n", {}, "is not a number"),
        ("t,x,u\n0,1," + "9" * 200_000, {}, "cannot be read as CSV|holds no number"),
    ],
)
def test_a_csv_file_without_what_is_asked_is_refused(text: Any, options: Any, words: str, tmp_path: Path) -> None:
    sentence = refuses(TransientError, words, read, tmp_path, text, **options)
    assert sentence.startswith(str(tmp_path / "run.csv"))


def test_a_csv_file_that_is_not_there(tmp_path: Path) -> None:
    for path, words in ((tmp_path / "no.csv", "there is no such file"), (tmp_path, "cannot be read: Is a directory")):
        refuses(TransientError, words, Transient.from_csv, path, time="t", states=["x"], controls=[])


def test_equal_columns_of_one_name_are_one_also_where_cells_are_empty(tmp_path: Path) -> None:
    transient = read(tmp_path, "t,x,u,x\n0,1,2,1\n1,,3,\n2,4,5,4\n")
    np.testing.assert_array_equal(transient.x, [[1.0], [NAN], [4.0]])
