# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Fitted envelopes over several steps: every window inside, least width, and which windows count."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refuses
from scipy.optimize import linprog

import uncertain_lti
from uncertain_lti import EnvelopeMonitor, Transient
from uncertain_lti.base.errors import FitError, ModelError
from uncertain_lti.identification import fit
from uncertain_lti.identification.assembly import assemble
from uncertain_lti.identification.optimum import better_run, fit_horizons, run_of
from uncertain_lti.identification.problem import Regimes
from uncertain_lti.identification.regimes import Modes
from uncertain_lti.model.horizon import Run
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.reports.check import check_data, check_text
from uncertain_lti.reports.figures import horizon_figure, save
from uncertain_lti.reports.model_text import model_text

STEPS = (2, 5, 11)


def runs(
    seed: int = 0, count: int = 3, length: int = 160, noise: float = 1e-3, modes: bool = False, bend: float = 3.0
) -> list[Transient]:
    """A damped, driven pair of states whose stiffness depends on the first."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        u = rng.choice([-1.0, 0.0, 1.0], size=length // 20 + 1).repeat(20)[:length, None]
        x = np.zeros((length, 2))
        for k in range(length - 1):
            rate = np.array([x[k, 1], -(4.0 + bend * x[k, 0]) * x[k, 0] - 1.5 * x[k, 1] + 2.0 * u[k, 0]])
            x[k + 1] = x[k] + 0.02 * rate
        x += rng.uniform(-noise, noise, x.shape)
        t = np.arange(length) * 20_000_000
        s = rng.choice([1.0, 2.0], size=8).repeat(length // 8)[:, None] if modes else None
        found.append(Transient(t, x, u, s=s))
    return found


def utilisation(model: UncertainLTI, transients: list[Transient]) -> Any:
    return np.concatenate([EnvelopeMonitor(model).check(t).horizon_utilisation[:, 1:] for t in transients])


@pytest.mark.parametrize(("criterion", "schedule"), [("qp", {"x1": 2}), ("lp", {}), ("lp", {"x1": 2})])
@pytest.mark.parametrize("widths", ["growing", "constant"])
def test_every_window_is_inside_by_the_arithmetic_of_the_verdict(criterion: Any, widths: Any, schedule: Any) -> None:
    transients = runs()
    model = fit(transients, criterion, additive="noise", schedule=schedule, horizons=STEPS, widths=widths)
    table = utilisation(model, transients)
    assert [h.steps for h in model.horizons] == list(STEPS)
    for j, facts in enumerate(model.fit_summary["horizons"]):
        there = ~np.isnan(table[:, j, 0])
        assert there.sum() == facts["windows"] == sum(len(t) - facts["steps"] for t in transients)
        assert np.abs(table[there, j]).max() <= 1.0
        assert np.abs(table[there, j]).max(axis=0).min() > 0.99  # and no wider than it must be
        assert facts["optimality_gap"] < 1e-6 and facts["seconds"] == pytest.approx(0.02 * facts["steps"])
    for horizon in model.horizons:
        assert horizon.widths == widths and bool(horizon.dA.any()) == (widths == "growing")


def windows_naively(model: UncertainLTI, transients: list[Transient], steps: int) -> tuple[Any, Any]:
    """Regressors [x_k; ū; 1] and what is left of the state after the run."""
    phi, left, run = [], [], model.run or model
    for t in transients:
        for k in range(len(t) - steps):
            x = t.x[k].copy()
            for j in range(steps):
                x = x + t.dt[k + j] * (run.A @ x + run.B @ t.u[k + j] + run.c)
            phi.append([*t.x[k], t.u[k : k + steps].mean(), 1.0])
            left.append(t.x[k + steps] - x)
    return np.array(phi), np.array(left)


@pytest.mark.parametrize("widths", ["growing", "constant"])
def test_the_largest_width_is_that_of_the_programme_as_written(widths: Any) -> None:
    transients = runs(count=2, length=80)
    model = fit(transients, "lp", additive="noise", horizons=[6], widths=widths)
    phi, left = windows_naively(model, transients, 6)
    T = 6 * 0.02
    K, p = len(phi), 3
    for i in range(2):
        half = np.column_stack([T * np.abs(phi[:, :p]), np.ones(K)])
        if widths == "constant":
            half[:, :p] = 0.0
        zero, one = np.zeros((K, 1)), np.ones((K, 1))
        rows = [
            np.hstack([T * phi, -half, zero]), np.hstack([-T * phi, -half, zero]), np.hstack([0.0 * phi, half, -one]),
        ]  # fmt: skip
        answer = linprog(
            [*np.zeros(2 * p + 2), 1.0], np.vstack(rows), np.concatenate([left[:, i], -left[:, i], np.zeros(K)]),
            bounds=[(None, None)] * (p + 1) + [(0, None)] * (p + 2),
        )  # fmt: skip
        found = model.fit_summary["horizons"][0]["max_width"][i]
        assert found == pytest.approx(2.0 * answer.x[-1], rel=1e-6)


@pytest.mark.parametrize(("additive", "drift"), [("noise", False), ("both", True)])
@pytest.mark.parametrize("knots", [None, (-0.5, 0.5)])
def test_what_is_run_are_the_least_squares_of_the_elements_that_the_model_has(additive, drift, knots):
    transients = runs()
    model = fit(transients, additive=additive, schedule={"x1": knots} if knots else None, horizons=[3])
    steps = [t.transitions() for t in transients]
    x, u, dt, after = (np.concatenate([getattr(s, name) for s in steps]) for name in ("x", "u", "dt", "x_next"))
    one = [np.ones((len(x), 1))] if drift or knots else []  # a regime has a steady state of its own
    weights = [np.ones(len(x))] if not knots else model.schedule.weights(x[:, :1].T)
    columns = np.hstack([w[:, None] * np.hstack([x, u, *one]) for w in weights]) * dt[:, None]
    expected = np.linalg.lstsq(columns, after - x, rcond=None)[0].reshape(len(weights), -1, 2)
    regimes = None if model.schedule is None else Regimes(model.schedule, (0,))
    problem = assemble(transients, model.operating_point, None, additive, regimes=regimes)
    run = run_of(problem)
    found = np.concatenate([np.atleast_3d(run.A.T).T.reshape(len(weights), 2, 2), run.B.reshape(-1, 2, 1)], axis=2)
    np.testing.assert_allclose(found, expected[:, :3].transpose(0, 2, 1), rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(run.c.reshape(-1, 2), expected[:, 3] if one else 0.0 * run.c.reshape(-1, 2), atol=1e-8)


def test_the_run_that_stays_nearer_to_the_recordings_is_taken() -> None:
    transients = runs(noise=0.0, bend=0.0)  # exact
    model = fit(transients, additive="noise", horizons=[20])
    problem = assemble(transients, model.operating_point, None, "noise")
    least_squares = run_of(problem)
    taken = better_run(model.replace(A=model.A + 2.0 * np.eye(2), run=None), problem, [20], None)
    assert taken is not None and taken.A.tobytes() == least_squares.A.tobytes()
    same = model.replace(A=least_squares.A, B=least_squares.B, c=least_squares.c, run=None)
    assert better_run(same, problem, [20], None) is None


def test_a_window_with_a_discarded_transition_is_left_out() -> None:
    transients = runs(count=1)
    x = transients[0].x.copy()
    x[80] += 3.0
    spoilt = [Transient(transients[0].t_ns, x, transients[0].u)]
    model = fit(spoilt, additive="noise", horizons=STEPS, discard=2)
    assert sorted(entry["k"] for entry in model.fit_summary["discarded"]) == [79, 80]
    for facts in model.fit_summary["horizons"]:
        assert facts["windows"] == sum(max(part - facts["steps"] + 1, 0) for part in (79, 78))
        assert facts["max_width"].max() < 0.5
    table = utilisation(model, spoilt)
    assert (np.abs(table[80]) > 1.0).any(axis=1).all()


def test_recordings_are_never_joined_and_modes_never_mixed() -> None:
    first, other, _ = runs()
    start = int(first.transitions().k[-1]) + 1  # the second recording begins at the number that would follow
    gone = np.full((start, 2), np.nan)
    x, u = np.vstack([gone, other.x]), np.vstack([np.zeros((start, 1)), other.u])
    second = Transient(np.arange(len(x)) * 20_000_000, x, u)
    model = fit([first, second], additive="noise", horizons=[4])
    assert model.fit_summary["horizons"][0]["windows"] == 2 * (len(first) - 4)
    transients = runs(modes=True)
    scheduled = fit(transients, additive="noise", schedule={"s1": Modes((1.0, 2.0))}, horizons=[4])
    expected = 0
    for t in transients:
        s = t.s[:-1, 0]
        expected += sum(len(set(s[k : k + 4])) == 1 for k in range(len(s) - 3))
    assert scheduled.fit_summary["horizons"][0]["windows"] == expected < sum(len(t) - 4 for t in transients)
    table = utilisation(scheduled, transients)
    assert (~np.isnan(table[:, 0, 0])).sum() == expected and np.nanmax(np.abs(table)) <= 1.0


def test_weights_are_those_of_the_arrival() -> None:
    (transient,) = runs(count=1, length=60)
    weights = np.ones((59, 2))
    weights[40] = 1e6  # the arrival at sample 41 is to have the least width of all
    plain = fit([transient], "lp", additive="noise", horizons=[5])
    model = fit([transient], "lp", weights=weights, additive="noise", horizons=[5])
    assert not np.array_equal(plain.horizons[0].v, model.horizons[0].v)
    z = np.hstack([transient.x, transient.u])[:-1].T

    def width_at(one: UncertainLTI, arrival: int) -> float:
        (windows,) = one.windows(np.arange(59), z, transient.dt, [5])
        _, half = one.horizons[0].centre_and_half_at(windows.z, windows.time, windows.run)
        return float(half[0, list(windows.last).index(arrival - 1)])

    assert width_at(model, 41) < width_at(plain, 41)


def test_a_horizon_that_is_asked_for_by_its_number_is_there_or_refused() -> None:
    options = {"additive": "noise", "alarm": "containment", "horizons": [4, 39]}
    for widths in ("growing", "auto"):
        with pytest.raises(FitError, match="no horizon of 39 steps: 3 windows"):
            uncertain_lti.fit(runs(length=40), "qp", widths=widths, **options)


def test_horizons_without_windows_or_numbers_are_dropped_by_name() -> None:
    transients = runs(length=40)
    model = fit(transients, additive="noise", horizons=[4, 39], drop_horizons=True)
    assert [h.steps for h in model.horizons] == [4]
    assert any("no horizon of 39 steps: 3 windows" in text for text in model.fit_summary["messages"])
    away = model.replace(A=1e4 * np.eye(2), run=None)
    problem = assemble(runs(), model.operating_point, None, "noise")
    found, _, messages, _ = fit_horizons(away, problem, [2, 140])
    assert [h.steps for h in found] == [2] and "'x1' beyond all numbers" in messages[0]


def test_check_and_figure_say_which_horizon_was_left(tmp_path: Path) -> None:
    transients = runs(count=2)
    model = fit(transients, "lp", additive="noise", horizons=STEPS, widths="constant")
    x = transients[0].x.copy()
    x[100:, 0] += 1e-3 * np.arange(60)  # a drift that one step hardly shows
    spoilt = Transient(transients[0].t_ns, x, transients[0].u)
    verdicts = EnvelopeMonitor(model).check(spoilt)
    data = check_data(model, verdicts)
    assert [h["steps"] for h in data["horizons"]] == list(STEPS)
    for j, found in enumerate(data["horizons"], 1):
        outside = np.abs(verdicts.horizon_utilisation[:, j]) > 1.0
        assert found["windows"] == len(spoilt) - found["steps"] and found["outside"] == outside.any(axis=1).sum()
        for i, state in enumerate(found["states"].values()):
            assert state["outside"] == outside[:, i].sum()
            assert (state["first"] is None) == (not state["outside"])
    assert data["horizons"][-1]["outside"] > 0
    sample = data["verdict_per_sample"][120]["horizon_utilisation"]
    assert sample == verdicts.horizon_utilisation[120].tolist() and len(sample) == 1 + len(STEPS)
    last = data["horizons"][-1]
    first = min(s["first"]["t"] for s in last["states"].values() if s["first"])
    assert f"{first:.4f} s" in check_text(data) and "windows" in check_text(data)
    again = UncertainLTI.from_dict(model.to_dict())
    assert "mean width after steps" in model_text(again)
    figure = horizon_figure(model, verdicts)
    maps = [axis for axis in figure.axes if axis.get_title("left")]
    assert [axis.get_title("left") for axis in maps] == list(model.state_names)
    labels = [text.get_text() for text in maps[0].get_yticklabels()]
    assert labels == ["1 (0.02 s)", "2 (0.04 s)", "5 (0.1 s)", "11 (0.22 s)"]
    save(horizon_figure(model, verdicts, ["x2"], (0.5, 1.0)), tmp_path / "f.png", 50)
    refuses(ModelError, "no state 'other'", horizon_figure, model, verdicts, ["other"])


def test_what_is_no_number_of_steps_is_refused() -> None:
    for bad in ([1], [2.5], [True]):
        refuses(FitError, "whole numbers of steps", fit, runs(count=1), horizons=bad)
    refuses(FitError, "cvxpy states one step", fit, runs(count=1), horizons=[3], method="cvxpy")


def test_a_horizon_whose_run_blows_up_is_dropped_and_said() -> None:
    """Its envelope would be wider than what any state ever moved over as many steps."""
    transients = runs(bend=0.0)
    problem = assemble(transients, fit(transients).operating_point, None, "noise")
    model = fit(transients, additive="noise")
    away = model.replace(run=Run(model.A + 30.0 * np.eye(2), model.B, model.c))
    found, facts, messages, _ = fit_horizons(away, problem, [2, 60], "constant")
    assert [h.steps for h in found] == [2] == [f["steps"] for f in facts]
    assert len(messages) == 1
    words = "no horizon of 60 steps: its envelope is wider than if every state stayed where it was"
    assert messages[0].startswith(words)
    kept, _, none, _ = fit_horizons(model, problem, [2, 60], "constant")
    assert [h.steps for h in kept] == [2, 60] and not none
