# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Memory: lag, diff and rate of a field, from the signals file to the free run of a model."""

import math

import numpy as np
import pytest
from refusals import refuses

from uncertain_lti import EnvelopeMonitor, SignalMap, Transient, UncertainLTI, validate
from uncertain_lti.base.errors import ModelError, SignalError, TransientError
from uncertain_lti.model.domain import Sampling
from uncertain_lti.proposal.tune import (
    Remembered,
    memory_candidates,
    memory_of,
    recall,
    remember,
    with_delays,
)
from uncertain_lti.signals.field_path import FieldPath, Memory, parse_memory
from uncertain_lti.signals.signal_map import Signal


@pytest.mark.parametrize(
    ("text", "memory", "inner"),
    [
        ("data", None, "data"),
        ("lag(data)", Memory("lag"), "data"),
        (" lag ( position[j0] , 12 ) ", Memory("lag", 12), "position[j0]"),
        ('lag(position["a, 3"], 2)', Memory("lag", 2), 'position["a, 3"]'),
        ("diff(unwrap(yaw(pose.orientation)))", Memory("diff"), "unwrap(yaw(pose.orientation))"),
        ("rate(data[3])", Memory("rate"), "data[3]"),
    ],
)
def test_a_path_with_a_memory_is_read_and_written(text: str, memory: Memory | None, inner: str) -> None:
    assert parse_memory(text) == (memory, inner)
    assert FieldPath(text).steps == FieldPath(inner).steps and FieldPath(text).unwrap == FieldPath(inner).unwrap
    if memory is not None:
        assert parse_memory(memory.of(inner)) == (memory, inner)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("lag(data, 0)", "a lag is 1 to 1000000 samples, not 0"),
        ("lag(data, -1)", "not -1"),
        ("diff(data, 2)", "diff takes a field alone; write diff\\(data\\)"),
        ("lag(diff(data), 1)", "do not nest"),
        ("unwrap(lag(data))", "functions nest only as"),
        ("lagg(data)", "there is no function 'lagg' \\(is lag meant\\?\\)"),
    ],
)
def test_a_wrong_memory_is_refused(text: str, words: str) -> None:
    refuses(SignalError, words, FieldPath, text)


def pair(**more: object) -> dict[str, object]:
    angle = {"name": "angle", "topic": "/a", "field": "unwrap(data[0])", "steady": 6.0, "scale": 2.0, "unit": "rad"}
    memories = [{"name": kind, "topic": "/a", "field": f"{kind}(unwrap(data[0]))"} for kind in ("lag", "diff", "rate")]
    return {"states": [angle | more, *memories], "controls": [{"name": "u", "topic": "/u", "field": "data"}]}


def test_memories_among_the_states_have_no_row_and_take_over_what_is_known_of_their_field() -> None:
    signals = SignalMap.from_dict(pair(valid=[-9, None], ignore=[0.1]))
    assert [s.name for s in signals.states] == ["angle"]
    assert [s.name for s in signals.controls] == ["u", "lag", "diff", "rate"]
    lag, diff, rate = signals.controls[1:]
    assert [(s.steady, s.scale, s.unit) for s in (lag, diff, rate)] == [
        (6.0, 2.0, "rad"), (0.0, 2.0, "rad"), (0.0, 2.0, "rad/s"),
    ]  # fmt: skip
    assert {(s.valid, s.ignore) for s in (lag, diff, rate)} == {((-9.0, math.inf), (0.1,))}
    found = [(r.position, r.of, r.memory.kind) for r in signals.recalled]
    assert found == [(2, 0, "lag"), (3, 0, "diff"), (4, 0, "rate")]
    assert [signals.branch(i) for i in range(5)] == [6.0, 0.0, 6.0, 6.0, 6.0]


def test_a_delayed_copy_of_a_state_is_a_lag_too() -> None:
    before = Signal("before", "/a", "data", delay=3)
    (recalled,) = SignalMap((Signal("x", "/a", "data"),), (before,)).recalled
    assert (recalled.position, recalled.of, recalled.memory) == (1, 0, Memory("lag", 3))


def test_what_single_precision_makes_of_an_ignored_value_is_ignored() -> None:
    assert Signal("x", "/a", "data", ignore=(0.1, 1e300)).ignored == {0.1, float(np.float32(0.1)), 1e300, math.inf}


def remembering(rows: dict[str, list[float]], signals: SignalMap, dt: float = 0.1) -> UncertainLTI:
    n = len(signals.states)
    zero = {"dA": np.zeros((n, n)), "dB": np.zeros((n, len(signals.controls)))}
    return UncertainLTI(rows["A"], rows["B"], **zero, signals=signals, sampling=Sampling(dt_median=dt))


@pytest.mark.parametrize("kind", ["lag", "diff", "rate"])
def test_a_free_run_follows_its_own_memory_and_its_radius_is_that_of_the_recursion(kind: str) -> None:
    """y_{k+1} = 1.6 y_k - 0.8 y_{k-1}, an oscillator of which one state is measured, in units of its own."""
    dt, (own, past) = 0.1, {"lag": (0.6, -0.8), "diff": (-0.2, 0.8), "rate": (-0.2, 0.08)}[kind]
    y = Signal("y", "", "y", steady=2.0, scale=4.0)
    memory = Signal("m", "", f"{kind}(y)", steady=2.0 if kind == "lag" else 0.0, scale=3.0)
    signals = SignalMap((y,), (memory,))
    model = remembering({"A": [[own / dt]], "B": [[past / dt * 3.0 / 4.0]]}, signals)
    truth = [5.0, 4.0]
    for _ in range(30):
        truth.append(2.0 + 1.6 * (truth[-1] - 2.0) - 0.8 * (truth[-2] - 2.0))
    values = np.array(truth)
    recorded = Transient(dt * np.arange(32), values[:, None], np.zeros((32, 0)))
    recalled = recall(recorded, values, Memory(kind))
    u = (recalled[1:-1, None] - memory.steady) / 3.0
    u[1:] = np.nan  # what is not the run's own would show
    free = model.simulate((values[1:2] - 2.0) / 4.0, u, dt)
    np.testing.assert_allclose(free[:, 0] * 4.0 + 2.0, values[1:], rtol=1e-9)
    assert model.spectral_radius() == pytest.approx(math.sqrt(0.8))
    steps = np.where(np.arange(30) % 2, 0.2, 0.1)
    run = model.simulate((values[1:2] - 2.0) / 4.0, u, steps)[:, 0]
    at = Transient(np.append(0.0, np.cumsum(steps)), run[:, None], np.zeros((31, 0)), max_gap=1.0)
    of_run = recall(at, 4.0 * run + 2.0, Memory(kind))
    moved = steps * (model.A[0, 0] * run[:-1] + model.B[0, 0] * (of_run[:-1] - memory.steady) / 3.0)
    np.testing.assert_allclose(np.diff(run)[1:], moved[1:], rtol=1e-9, atol=1e-12)


def test_a_model_that_remembers_has_a_newer_format_and_an_older_one_may_not_say_so() -> None:
    plain = SignalMap.from_dict({"states": [{"name": "angle", "topic": "/a", "field": "data"}]})
    assert remembering({"A": [[1.0]], "B": np.zeros((1, 0))}, plain).to_dict()["format"] == "uncertain-lti/1"
    signals = SignalMap.from_dict(pair(valid=[-9, None], ignore=[0.1]))
    data = remembering({"A": [[1.0]], "B": np.ones((1, 4))}, signals).to_dict()
    assert data["format"] == "uncertain-lti/2" and data["states"][0]["valid"] == [-9.0, None]
    assert UncertainLTI.from_dict(data).signals.signals == signals.signals
    data = remembering({"A": [[1.0]], "B": np.zeros((1, 0))}, plain).to_dict()
    data["sampling"]["step"] = 0.01
    refuses(ModelError, "unknown field 'sampling.step'", UncertainLTI.from_dict, data)


def test_a_check_takes_the_step_of_the_model() -> None:
    t = np.array([0.0, 0.1, 0.25, 0.3])
    model = remembering({"A": [[1.0]], "B": np.zeros((1, 0))}, SignalMap((Signal("x", "", "x"),)))
    signals = SignalMap((Signal("x", "", "x"),), step=0.1)
    model = model.replace(sampling=Sampling(0.1), signals=signals, v=np.array([0.5]))
    verdicts = EnvelopeMonitor(model).check(Transient(t, np.ones((4, 1)), np.empty((4, 0)), max_gap=1.0))
    assert verdicts.upper[1:, 0].tolist() == [1.6] * 3


def oscillating(seed: int, blind: bool = True) -> Transient:
    """A swing whose rate is not measured, pushed by a force, with a little noise."""
    rng = np.random.default_rng(seed)
    t, push = 0.05 * np.arange(900), np.repeat(rng.normal(size=18), 50)
    x = np.zeros((900, 2))
    for k in range(899):
        x[k + 1, 1] = x[k, 1] + 0.05 * (-9.0 * x[k, 0] - 0.6 * x[k, 1] + push[k])
        x[k + 1, 0] = x[k, 0] + 0.05 * x[k + 1, 1]
    x += 1e-4 * rng.normal(size=x.shape)
    signals = SignalMap((Signal("swing", "/s", "data"),), (Signal("push", "/u", "data"),), source="swing.yaml")
    return Transient(t, x[:, :1] if blind else x, push, signals=signals if blind else None, max_gap=0.1)


def test_a_memory_that_pays_is_a_candidate_and_narrows_what_was_left_out() -> None:
    runs = [oscillating(seed) for seed in range(3)]
    rate = Remembered("swing", Memory("rate"))
    assert (rate,) in memory_candidates(runs)
    with_it = remember(runs, [rate])
    assert with_it[0].control_names == ("push", "swing_rate")
    narrow, wide = (validate(some, additive="noise") for some in (with_it, runs))
    widths = [np.mean([part.mean_width[0] for part in left.parts]) for left in (narrow, wide)]
    assert widths[0] < 0.2 * widths[1]


@pytest.mark.parametrize(("gap", "left"), [(None, 0.075), (0.2, 0.2)])
def test_no_memory_looks_back_over_a_lost_sample_unless_somebody_says_so(gap: float | None, left: float) -> None:
    run = oscillating(0)
    there = np.arange(len(run)) != 500
    signals = SignalMap((Signal("swing", "/s", "data"),), (Signal("push", "/u", "data"),), max_gap=gap or 0.125)
    lost = Transient(run.t[there], run.x[there], run.u[there], signals=signals, max_gap=gap)
    (plain,), (found,) = remember([lost], []), remember([lost], [Remembered("swing", Memory("lag"))])
    assert plain.max_gap == lost.max_gap and plain.signals == signals
    assert found.max_gap == pytest.approx(left, abs=1e-4) and found.signals is not None
    assert found.signals.max_gap == found.max_gap
    assert np.isnan(found.u[500, 1]) == (gap is None) and not np.isnan(found.u[501, 1])


def test_no_memory_is_a_candidate_where_every_state_is_measured() -> None:
    runs = [oscillating(seed, blind=False) for seed in range(2)]
    assert not any(one.of.startswith("x") for some in memory_candidates(runs) for one in some)


def test_a_delayed_control_is_that_of_a_signals_file_with_the_delay() -> None:
    """Samples and signals alike, and what the monitor replays from them."""
    run = oscillating(1)
    late = with_delays(run, {"push": 3})
    assert late.signals is not None and late.signals.controls[0].delay == 3
    np.testing.assert_array_equal(late.u[3:, 0], run.u[:-3, 0])
    assert np.isnan(late.u[:3, 0]).all() and late.control_names == run.control_names
    twice = with_delays(late, {"push": 1})
    assert twice.signals is not None and twice.signals.controls[0].delay == 4
    np.testing.assert_array_equal(twice.u[4:, 0], run.u[:-4, 0])
    arrays = Transient(run.t_ns, run.x, run.u)
    np.testing.assert_array_equal(with_delays(arrays, {"u1": 3}).u, late.u)


def test_the_lag_of_a_delayed_signal_is_as_much_longer_and_it_has_no_other_memory() -> None:
    late = Signal("push", "/u", "data", steady=2.0, unit="N", delay=3)
    lag = memory_of(late, Memory("lag", 2), "before")
    assert (lag.name, lag.field, lag.delay, lag.steady) == ("before", "lag(data, 5)", 0, 2.0)
    for kind in ("diff", "rate"):
        with pytest.raises(TransientError, match=f"'push' is delayed, and has no {kind}; take it of the field itself"):
            memory_of(late, Memory(kind), "change")  # type: ignore[arg-type]
