# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Figures: what they must not hide, and that they can be drawn at both extremes of size."""

import math
import os

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI
from uncertain_lti.base.errors import ModelError
from uncertain_lti.model.alarm_rule import AlarmRule, StatisticRule
from uncertain_lti.reports.charts import FEW, PIXELS, Columns, alarm_chart, columns_of
from uncertain_lti.reports.figures import (
    alarm_figure,
    coverage_figure,
    envelope_figure,
    matrices_figure,
    save,
    utilisation_figure,
)
from uncertain_lti.signals.signal_map import Signal, SignalMap

LONG = "x_$the$_total <pressure>\nbehind_the_high_pressure_compressor_état_"


def by_hand(n, m, name="x", width=1.0):
    rng = np.random.default_rng(n)
    states = tuple(Signal(name=f"{name}{i}", topic="/s", field=f"data[{i}]", unit="$kPa$", scale=2.0) for i in range(n))
    controls = tuple(Signal(name=f"u{i}", topic="/c", field=f"data[{i}]") for i in range(m))
    matrices = -np.eye(n), rng.normal(size=(n, m)), *(width * np.abs(rng.normal(size=(n, k))) for k in (n, m))
    signals = SignalMap(states=states, controls=controls)
    return UncertainLTI(*matrices, dc=np.full(n, 0.1 * width), v=np.full(n, 0.01 * width), signals=signals)


def checked(model, count, jumps=(), gaps=(), back=(), unknown=()):
    """A quiet run that jumps at some samples, with pauses before others, and where time steps back."""
    rng = np.random.default_rng(count)
    step = np.full(count, 10**7, dtype=np.int64)
    step[list(gaps)] = 10**9
    step[list(back)] = -(10**9)
    x = 0.01 * rng.normal(size=(count, model.n))
    for k in jumps:
        x[k, k % model.n] += 100.0
    x[list(unknown)] = math.nan
    u = np.zeros((count, model.m))
    return EnvelopeMonitor(model).check(Transient(10**18 + np.cumsum(step), x, u, name="/tmp/$a$.mcap", max_gap=0.1))


@settings(max_examples=30)
@given(
    count=st.integers(2 * PIXELS + 1, 10_000),
    jumps=st.lists(st.integers(1, 2 * PIXELS), max_size=20),
    gaps=st.lists(st.integers(1, 2 * PIXELS), max_size=4),
    back=st.lists(st.integers(1, 2 * PIXELS), max_size=1),
)
def test_no_violation_is_hidden_in_a_long_recording(count, jumps, gaps, back):
    """Every violated sample lies in a stretch that is marked, and every extreme is drawn."""
    model = by_hand(3, 1)
    verdicts = checked(model, count, jumps, gaps, back)
    for drawn in (columns_of(verdicts), columns_of(verdicts, 900, fine=True)):
        assert drawn.binned and len(drawn.t) <= 2 * PIXELS and (np.diff(drawn.t) >= 0).all()
        low, high = drawn.extremes(verdicts.transient.x)
        for i in range(3):
            x, bad = verdicts.transient.x[:, i], verdicts.flags[:, i] == 1.0
            marked = drawn.worst(bad, verdicts.utilisation[:, i], x)
            place = np.searchsorted(drawn.starts, np.flatnonzero(bad), side="right") - 1
            assert sorted(set(place.tolist())) == np.flatnonzero(~np.isnan(marked)).tolist()
            for b in set(place.tolist()):
                rows = np.arange(drawn.starts[b], np.append(drawn.starts, drawn.stop)[b + 1])
                rows = rows[bad[rows]]
                assert marked[b] == x[rows[np.abs(verdicts.utilisation[rows, i]).argmax()]]
            assert np.nanmax(high[:, i]) == x.max() and np.nanmin(low[:, i]) == x.min()
        assert drawn.alarm.any() == verdicts.alarm.any() == bool(drawn.alarms)


def test_every_sample_is_drawn_around_a_violation():
    t, near = np.arange(100_000) * 0.01, np.zeros(100_000, dtype=bool)
    near[[500, 70_000]] = True
    drawn = Columns.of(t, near=near, most=1000)
    for k in (500, 70_000):
        assert np.isin(np.arange(k - 100, k + 100), drawn.starts).all()


RULES = [
    [AlarmRule(1, 1, 1.0)],
    [AlarmRule(1, 1, 1.3)],
    [AlarmRule(3, 5, 1.0)],
    [AlarmRule(2, 40, 1.0), StatisticRule("energy", 0.5, 1.4)],
]


@pytest.mark.parametrize("rules", RULES)
@pytest.mark.parametrize("most", [10_000, 300])
def test_the_score_is_over_its_threshold_just_where_the_alarm_is(rules, most):
    rng = np.random.default_rng(1)
    x = 0.05 * rng.normal(size=(4000, 2))
    x[2000:2300, 1] += 0.003 * np.arange(300) * rng.choice([-1, 1], 300)
    zeros = np.zeros((2, 2))
    model = UncertainLTI(zeros, zeros[:, :1], zeros, zeros[:, :1], v=[0.2, 0.2], alarm=rules)
    run = Transient(np.arange(4000) * 0.01, x, np.zeros((4000, 1)))
    verdicts = EnvelopeMonitor(model).check(run)
    assert 0 < verdicts.alarm.sum() < 3900
    columns = columns_of(verdicts, most)
    chart = alarm_chart(model, verdicts, columns)
    score = chart.panels[0].series[0].high
    there = columns.judged & ~np.isnan(score)
    assert there.sum() >= len(score) - 1
    loud = (score > 1) if len(rules) > 1 else (score >= 1)
    assert (loud[there] <= columns.alarm[there]).all() and (score[columns.alarm] >= 1).all()
    assert [p.title for p in chart.panels][1:] == ["x2", "x1"] and chart.panels[0].note  # who did it comes first


def test_the_score_names_what_is_farthest_beyond_its_threshold():
    """`check` named the pressure at 2.4 times its threshold, and the page the speed, at 1.1 times."""
    zeros, x = np.zeros((2, 2)), np.zeros((40, 2))
    x[30:] = [0.3, 0.9]
    rules = [StatisticRule("energy", 0.01, 1.4)]
    model = UncertainLTI(zeros, zeros[:, :1], zeros, zeros[:, :1], v=[0.2, 0.2], alarm=rules)
    verdicts = EnvelopeMonitor(model).check(Transient(np.arange(40) * 0.01, x, np.zeros((40, 1))))
    assert len(verdicts.raised(int(verdicts.alarm.argmax()))) == 2
    assert "raised by energy of x2" in alarm_chart(model, verdicts, columns_of(verdicts)).panels[0].note


def ink(path):
    """Share of the pixels that are not nearly white."""
    return float((np.asarray(Image.open(path).convert("L")) < 230).mean())


SIZES = [(1, 1, "none"), (1, 2, "all"), (4, 5000, "some"), (6, 60, "all")]


@pytest.mark.parametrize("n,count,jumps", SIZES)
def test_every_size_can_be_drawn(n, count, jumps, tmp_path):
    model = by_hand(n, 3, LONG)
    at = {"none": (), "some": range(1, count, 50), "all": range(1, count)}[jumps]
    verdicts = checked(model, count, at, gaps=[count // 2], unknown=[count // 3] if count > 10 else ())
    for make in (alarm_figure, envelope_figure, utilisation_figure):
        figure = make(model, verdicts)
        save(figure, tmp_path / "f.png", 50)
        assert 0.01 < ink(tmp_path / "f.png") < 0.8
        if n == 4:
            save(make(model, verdicts, span=(0.01, 0.03)), tmp_path / "f.svg")
    with pytest.raises(ModelError, match="no state 'other'"):
        envelope_figure(model, verdicts, states=["other"])


def test_many_states_are_a_map_that_marks_the_alarms(tmp_path):
    model = by_hand(FEW + 1, 1)
    verdicts = checked(model, 200, jumps=[51, 120])
    figure = utilisation_figure(model, verdicts)
    (axis,) = figure.axes
    assert [label.get_text() for label in axis.get_yticklabels()] == list(model.state_names)
    assert len(axis.patches) == len(columns_of(verdicts).alarms) > 1
    save(figure, tmp_path / "f.png", 50)
    assert 0.01 < ink(tmp_path / "f.png") < 0.8


def test_a_panel_says_what_it_shows():
    model = by_hand(2, 1)
    verdicts = checked(model, 200, jumps=[51, 52])
    axes = envelope_figure(model, verdicts, states=["x1"]).axes
    assert len(axes) == 1 and axes[0].get_title("left") == r"x1 [\$kPa\$]"
    assert axes[0].get_title("right") == f"violated {int((verdicts.flags[:, 1] == 1).sum())}"
    assert axes[0].get_xlabel() == "time [s]"
    x, (low, high) = verdicts.transient.x[:, 1], axes[0].get_ylim()
    quiet = np.delete(x, 51)
    assert low < quiet.min() and quiet.max() < high < x[51], "the jump is marked at the edge and flattens nothing"
    looped = checked(model, 200, back=[100])
    assert "2 passes" in envelope_figure(model, looped).axes[-1].get_xlabel()


def test_an_image_on_a_full_disk_is_one_sentence_that_names_it(tmp_path, monkeypatch):
    def full(descriptor):
        raise OSError(28, "No space left on device")

    figure = matrices_figure(by_hand(2, 1, LONG))
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ModelError, match="f.svg: cannot be written: No space left on device; choose another place"):
        save(figure, tmp_path / "f.svg")


def test_half_widths_that_are_rounding_are_left_blank():
    model = by_hand(2, 1).replace(dA=np.array([[0.5, 1e-14], [0.25, 0.0]]))
    written = [text.get_text() for text in matrices_figure(model).axes[1].texts]
    assert {"0.5", "0.25"} <= set(written) and not [text for text in written if "e-14" in text]


@pytest.mark.parametrize("n, width", [(2, 0.0), (2, 1.0), (50, 1.0)])
def test_matrices_and_coverage(n, width, tmp_path):
    model = by_hand(n, 4, LONG, width)
    runs = [checked(model, 60, jumps=[7] * (k % 2)) for k in range(20 if n == 50 else 1)]
    nothing = checked(model, 1)
    figures = matrices_figure(model), coverage_figure(model, [*runs, nothing]), coverage_figure(model, [nothing])
    for k, figure in enumerate(figures):
        save(figure, tmp_path / f"{k}.png", 40)
