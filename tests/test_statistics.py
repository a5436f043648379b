# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Statistics over a window: their formulas, live as offline."""

from array import array
from typing import Any

import numpy as np
import pytest
from refusals import refuses
from steps import steps_of

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI
from uncertain_lti.identification import fit
from uncertain_lti.identification.assembly import assemble
from uncertain_lti.identification.fleet import law_of
from uncertain_lti.identification.passes import in_a_row
from uncertain_lti.kernel.arithmetic import Statistic, Statistics, Window
from uncertain_lti.model.alarm_rule import JOINT, KINDS, AlarmRule, StatisticRule
from uncertain_lti.model.horizon import Horizon, Residuals, Run
from uncertain_lti.model.operating_point import OperatingPoint
from uncertain_lti.monitor.verdict import Verdicts
from uncertain_lti.reports.check import check_data, check_text
from uncertain_lti.reports.model_text import model_text

C = np.array([[1.0, 0.6, 0.0], [0.6, 2.0, -0.3], [0.0, -0.3, 0.5]])
MEAN = np.array([0.1, -0.2, 0.0])
MEMORY = np.array([0.5, 0.0, -0.25])
LIMIT = 10.0  # standard deviations, as the theory page says


def statistic(kind: str, window: float = 1.0, threshold: float = 1.0, n: int = 3, allowance: float = 0.0) -> Statistic:
    joint = kind in JOINT
    return Statistic(
        KINDS.index(kind), n, window, [threshold] * (1 if joint else n), [True] * n, allowance,
        MEAN[:n], Residuals(MEAN[:n], C[:n, :n]).whitening([True] * n), MEMORY[:n],
    )  # fmt: skip


def oracle(kind: str, T: float, dt: np.ndarray, rows: np.ndarray, allowance: float) -> np.ndarray:
    """The formulas of the theory page, over the whole record."""
    if kind in ("ewma", "cusum"):
        rows = np.clip(rows, -LIMIT, LIMIT)
        e, up, down = (np.zeros(rows.shape[1]) for _ in range(3))
        found = []
        for u, step in zip(rows, dt, strict=True):
            if kind == "ewma":
                found.append(e := e + (u - e) * step / (T + step))
                continue
            up = np.maximum(0, up * T / (T + step) + (u - allowance) * step / T)
            down = np.maximum(0, down * T / (T + step) + (-u - allowance) * step / T)
            found.append(np.where(up >= down, up, -down))
        return np.array(found)
    r = rows - MEAN[: rows.shape[1]]
    r[1:] -= MEMORY[: rows.shape[1]] * r[:-1]
    if kind == "mewma":
        e, spread, found = np.zeros(rows.shape[1]), 0.0, []
        root = np.linalg.cholesky(C[: rows.shape[1], : rows.shape[1]])
        for white, step in zip(np.clip(np.linalg.solve(root, r.T).T, -LIMIT, LIMIT), dt, strict=True):
            weight = step / (T + step)
            spread = (1 - weight) ** 2 * spread + weight**2 if spread else weight / (2 - weight)
            e = e + weight * (white - e)
            found.append([e @ e / spread])
        return np.array(found)
    if kind == "chi2":
        terms = np.einsum("ki,ij,kj->k", r, np.linalg.inv(C[: rows.shape[1], : rows.shape[1]]), r)[:, None]
    else:
        terms = rows**2 if kind == "energy" else rows
    found = []
    ns = np.rint(dt * 1e9).astype(int)
    for k in range(len(dt)):
        first = k
        while first > 0 and ns[first - 1 : k + 1].sum() <= round(T * 1e9):
            first -= 1
        part = slice(first, k + 1)
        found.append((terms[part] * dt[part, None]).sum(axis=0) / max(T, dt[k] if first == k else 0.0))
    return np.array(found)


@pytest.mark.parametrize(
    ("kind", "T", "jitter"),
    [
        (k, T, j)
        for k in KINDS
        for T, j in ((0.5, 0.0), (0.5, 1e-6), (0.5, 0.4), (0.001, 0.4), (0.0, 0.4))
        if T or k != "cusum"
    ],
)
def test_every_statistic_is_its_formula(kind: str, T: float, jitter: float) -> None:
    """Also over a window shorter than a step, of one verdict, or one that steps fill but for some ns."""
    rng = np.random.default_rng(1)
    dt = 0.01 * (1 + jitter * rng.uniform(-1, 1, 700))
    rows = rng.normal(size=(700, 3)) + np.linspace(0, 2, 700)[:, None]
    rows[300:303], rows[500:503] = 30.0, -40.0  # beyond LIMIT
    alarm, values = statistic(kind, T, 0.8, allowance=0.3).push_all(dt, rows)
    expected = oracle(kind, T, dt, rows, 0.3) / 0.8
    np.testing.assert_allclose(values, expected, rtol=1e-9, atol=1e-12)
    assert np.array_equal(alarm, (np.abs(values) > 1).any(axis=1)) and 0 < alarm.sum() < 700


@pytest.mark.parametrize("kind", JOINT)
@pytest.mark.parametrize(("T", "counted"), [(0.5, [True] * 3), (0.0, [True] * 3), (0.5, [True, False, True])])
def test_all_states_together_point_to_the_one_without_which_the_rest_is_least(
    kind: str, T: float, counted: list[bool]
) -> None:
    """By the low-pass of what the chi-square falls by without it; live as offline, and as before without a verdict."""
    rng = np.random.default_rng(4)
    dt, rows = rng.uniform(0.001, 0.02, 400), rng.normal(size=(400, 3))
    rows[100:150, 0] += 3.0
    rows[200:250, 2] -= 2.0
    rows[350:, 1] += 4.0
    rows[300, 0] = np.nan
    residuals = Residuals(MEAN, C)

    def made() -> Statistic:
        law = MEAN, residuals.whitening(counted), MEMORY
        return Statistic(KINDS.index(kind), 3, T, [1.0], counted, 0.0, *law)

    blamed = np.full((400, 2), 7, dtype=np.int16)
    made().push_all(dt, rows, blamed=blamed[:, 1])
    one, every = made(), []
    assert one.blamed == -1
    for step, row in zip(dt, rows, strict=True):
        Statistics([one], [0]).push(step, array("d", row))
        every.append(one.blamed)
    assert blamed[:, 1].tolist() == every and (blamed[:, 0] == 7).all()
    r = np.delete(rows, 300, axis=0) - MEAN
    r[1:] -= MEMORY * r[:-1]

    def square(states: list[bool]) -> np.ndarray:
        return np.asarray(np.square(r @ residuals.whitening(states).T).sum(axis=1))

    less = np.zeros((399, 3))
    for i in np.flatnonzero(counted):
        less[:, i] = square(counted) - square([on and j != i for j, on in enumerate(counted)])
    share = np.zeros(3)
    for k, step in enumerate(np.delete(dt, 300)):
        share = share + (less[k] - share) * step / (T + step)
        assert every[k + (k >= 300)] == share.argmax()
    assert every[300] == every[299] and set(every) == set(np.flatnonzero(counted).tolist())
    one.reset()
    assert one.blamed == -1
    Statistics([one], [0]).push(0.01, array("d", MEAN))
    assert one.blamed == -1  # nothing is unusual of any


@pytest.mark.parametrize("kind", KINDS)
def test_one_at_a_time_and_all_at_once_are_the_same_bits(kind: str) -> None:
    rng = np.random.default_rng(2)
    dt, rows = rng.uniform(0.001, 0.02, 500), rng.normal(size=(500, 3))
    rows[rng.random(500) < 0.1] = np.nan
    rows[40, 1], rows[60, 2], rows[80, 0] = np.inf, -np.inf, 1e300
    together = statistic(kind, 0.1)
    alarm, values = together.push_all(dt, rows)
    one = statistic(kind, 0.1)
    every = Statistics([one], [1])
    for k in range(500):
        assert every.push(dt[k], array("d", [7.0, *rows[k]])) == alarm[k]
        assert np.array(one.values()).tobytes() == np.array(every.values()).tobytes() == values[k].tobytes()
    assert np.isfinite(values[1:]).all()
    judged = np.arange(500) % 7 != 3
    without = statistic(kind, 0.1).push_all(dt, rows, judged)
    some = statistic(kind, 0.1).push_all(dt[judged], rows[judged])
    assert without[1][judged].tobytes() == some[1].tobytes() and np.isnan(without[1][~judged]).all()
    held = np.concatenate([[False], some[0]])[np.cumsum(judged)]  # without a verdict the alarm stays
    assert np.array_equal(without[0], held)


def test_several_take_their_parts_of_one_table_and_refuse_one_that_is_too_short() -> None:
    every = Statistics([statistic("mean", 1.0, 2.0), statistic("chi2", 1.0)], [3, 0])
    assert np.isnan(every.values()).all() and len(every.values()) == 4
    assert every.push(1.0, array("d", [0.0, 0.0, 0.0, 1.0, -3.0, 0.5]))
    assert every.values()[:3].tolist() == [0.5, -1.5, 0.25]
    refuses(ValueError, "do not fit", every.push, 1.0, array("d", [0.0] * 5))


def test_one_number_beyond_a_limit_is_enough_and_none_at_all_is_no_verdict() -> None:
    window, nan = Window(1, 1, 1.0, [0, 2], 1), float("nan")
    for table, raised in (
        ([9.0, -1.0, 9.0, 1.0], False),
        ([0.0, 0.0, 0.0, -1.5], True),
        ([0.0, nan, 0.0, nan], True),
        ([0.0, nan, 0.0, 1.0], False),
        ([0.0, nan, 0.0, nan], False),
        ([0.0, nan, 0.0, 1.5], True),
    ):
        assert window.push(False, array("d", table)) == raised, table
    refuses(ValueError, "do not fit", window.push, False, array("d", [0.0, 0.0, 0.0]))


def test_the_alarm_of_containment_counts_the_last_verdicts() -> None:
    rng = np.random.default_rng(3)
    violated, judged = rng.random(400) < 0.4, rng.random(400) < 0.8
    for needed, size in ((1, 1), (2, 3), (5, 20), (20, 20), (1, 600)):
        alarm = np.empty(400, dtype=bool)
        Window(needed, size).push_all(violated, None, judged, alarm)
        for k in range(400):
            assert alarm[k] == (violated[: k + 1][judged[: k + 1]][-size:].sum() >= needed)


@pytest.mark.parametrize("kind", ["energy", "mean", "chi2"])
def test_a_huge_value_leaves_nothing_behind(kind: str) -> None:
    """A running sum that subtracts what leaves the window would keep the rounding of 1e40 for ever."""
    rows = np.full((400, 3), 0.25)
    rows[100] = 1e20
    _, values = statistic(kind, 0.5).push_all(np.full(400, 0.01), rows)
    assert values[149].max() > 1e10
    recalled = int(kind in JOINT)  # by the residual after it
    left = values[150 + recalled :]
    assert left == pytest.approx(np.broadcast_to(values[99], left.shape), rel=1e-12)


def test_what_is_at_its_threshold_raises_no_alarm() -> None:
    alarm, _ = statistic("mean", 0.0, 2.0).push_all(np.ones(4), 2.0 * np.eye(4, 3) * [1.0, -1.0, 1.25])
    assert alarm.tolist() == [False, False, True, False]


def test_a_window_holds_a_million_verdicts_at_most() -> None:
    """However short the steps are: what it takes stays small."""
    rows = np.zeros((1_000_001, 1))
    rows[0] = 1.0
    _, values = statistic("mean", 10.0, n=1).push_all(np.full(len(rows), 1e-6), rows)
    assert values[-2:, 0] == pytest.approx([1e-7, 0.0], rel=1e-12)


def test_lists_and_other_layouts_are_the_same_numbers() -> None:
    rows = np.random.default_rng(4).normal(size=(50, 3))
    _, plain = statistic("energy", 0.2).push_all(np.full(50, 0.01), rows)
    for given in (rows.tolist(), np.asfortranarray(rows), np.stack([rows, rows], axis=1)[:, 0]):
        _, values = statistic("energy", 0.2).push_all([0.01] * 50, given)
        assert values.tobytes() == plain.tobytes()


@pytest.mark.parametrize("kind", KINDS)
def test_what_one_state_misses_changes_nothing_of_it_nor_of_the_others(kind: str) -> None:
    """Its window holds what it has; states that are seen together have no verdict."""
    rng = np.random.default_rng(4)
    rows, dt = rng.normal(size=(400, 3)), rng.choice([0.01, 0.0125, 0.03], 400)
    lost = np.zeros(400, dtype=bool)
    lost[100:180] = lost[[250, 300, 301]] = True
    some = rows.copy()
    some[lost, 1] = np.nan
    alarm, found = statistic(kind, 0.2).push_all(dt, some)
    _, plain = statistic(kind, 0.2).push_all(dt, rows)
    _, kept = statistic(kind, 0.2).push_all(dt[~lost], rows[~lost])
    own = [0] if kind in JOINT else [1]
    assert found[:, [0, 2]].tobytes() == plain[:, [0, 2]].tobytes() if kind not in JOINT else True
    assert found[~lost][:, own].tobytes() == kept[:, own].tobytes()
    last = np.maximum.accumulate(np.where(lost, 0, np.arange(400)))
    assert found[:, own].tobytes() == found[last][:, own].tobytes()
    assert np.array_equal(alarm, (np.abs(found) > 1).any(axis=1))


def test_the_joint_moving_average_of_healthy_residuals_is_distributed_like_chi_square() -> None:
    """Its mean is the number of states whatever the window and the steps are, so one threshold fits them all."""
    rng = np.random.default_rng(6)
    rows = rng.multivariate_normal(MEAN, C, size=40_000)
    for window, jitter in ((0.02, 0.0), (0.5, 0.0), (0.5, 0.9)):
        dt = 0.01 * (1 + jitter * rng.uniform(-1, 1, len(rows)))
        _, values = statistic("mewma", window).push_all(dt, rows)
        assert values[len(rows) // 10 :].mean() == pytest.approx(3.0, rel=0.1)


def test_reset_forgets_everything() -> None:
    rng = np.random.default_rng(5)
    for kind in KINDS:
        one = statistic(kind, 0.1, allowance=0.1 if kind == "cusum" else 0.0)
        first = one.push_all(np.full(90, 0.03), rng.normal(size=(90, 3)) * 9)
        one.reset()
        assert not one.alarm and np.isnan(one.values()).all() and first[0].any()
        rows = rng.normal(size=(90, 3))
        fresh = statistic(kind, 0.1, allowance=0.1 if kind == "cusum" else 0.0)
        again, new = (s.push_all(np.full(90, 0.01), rows)[1] for s in (one, fresh))
        assert again.tobytes() == new.tobytes()


# --- in the monitor ---


def model(rules: Any, n: int = 3, relative: bool = True) -> UncertainLTI:
    zeros, half, longer = (np.zeros((n, n)), np.zeros((n, 1))), 0.3, 0.5
    one, four = (half, longer) if relative else (1.0, 1.0)
    known = Residuals(MEAN[:n] / one, 0.01 * C[:n, :n] / one**2, relative)
    windows = Residuals(-MEAN[:n] / four, 0.02 * C[:n, :n] / four**2, relative)
    return UncertainLTI(
        -0.5 * np.eye(n), np.zeros((n, 1)), *zeros, v=np.full(n, half), alarm=rules, residuals=known,
        horizons=[Horizon(4, *zeros, *zeros, v=np.full(n, longer), residuals=windows)],
    )  # fmt: skip


RULES = (
    AlarmRule(3, 8),
    StatisticRule("energy", 0.5, (0.5, 0.6, 0.7)),
    StatisticRule("mean", 0.3, 0.4),
    StatisticRule("ewma", 0.3, 0.4),
    StatisticRule("cusum", 0.3, 0.5, allowance=0.2),
    StatisticRule("chi2", 0.2, 9.0),
    StatisticRule("mewma", 0.2, 30.0),
    StatisticRule("chi2", 0.0, 9.0, horizon=4),
    StatisticRule("mewma", 0.1, 20.0, horizon=4),
)


def a_run(seed: int, count: int = 400, n: int = 3, drift: float = 0.2) -> Transient:
    rng = np.random.default_rng(seed)
    x = 0.12 * rng.normal(size=(count, n))
    x[250:] += np.linspace(0, 0.3, count - 250)[:, None] * (-1.0) ** np.arange(count - 250)[:, None]
    x[330:] += drift * np.arange(count - 330)[:, None]
    x[[70, 71, 200]] = np.nan
    t = np.cumsum(rng.integers(9_000_000, 11_000_000, count))
    t[320:] -= t[320] - t[100]  # time jumps back
    return Transient(t * 1, x, np.zeros((count, 1)))


def test_a_masked_state_does_not_count() -> None:
    run = a_run(2, drift=0.0)
    x = run.x.copy()
    x[100:, 1] += 0.4 * np.minimum(np.arange(300), 100)
    run = Transient(run.t_ns, x, run.u)
    for rule in RULES:
        blamed = EnvelopeMonitor(model([rule])).check(run)
        masked = EnvelopeMonitor(model([rule]), masked=("x2",)).check(run)
        assert blamed.alarm.sum() > masked.alarm.sum()
    two = EnvelopeMonitor(model(RULES), masked=("x2",)).check(run)
    names = {r.state for k in np.flatnonzero(two.alarm) for r in two.raised(k)}
    assert "x2" not in names and "x1" in names


def test_the_alarm_says_which_rule_state_and_value_and_so_does_check() -> None:
    given = model([AlarmRule(50, 50), StatisticRule("mean", 0.05, 0.5)])
    x = np.zeros((12, 3))
    x[:, 2] = [0.0, *(-0.24 * np.arange(1, 12))]
    run = Transient(np.arange(12) * 0.01, x, np.zeros((12, 1)), state_names=["x1", "x2", "x3"], control_names=["u1"])
    verdicts = EnvelopeMonitor(given).check(run)
    (why,) = verdicts.raised(int(np.argmax(verdicts.alarm)))
    assert (why.label, why.kind, why.horizon, why.state) == ("mean", "mean", 1, "x3") and why.value < -1
    assert "mean of x3 at 1" in why.words and "its threshold" in why.words and verdicts.raised(0) == ()
    data = check_data(given, verdicts)
    (said,) = data["alarms"][0]["raised"]
    assert (said["rule"], said["state"], said["horizon"], said["words"]) == ("mean", "x3", 1, why.words)
    assert f"raised by {why.words}" in check_text(data)
    assert "alarm: mean of the utilisation over 0.05 s above 0.5" in model_text(given)


def test_a_check_of_many_alarms_never_puts_all_utilisations_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """It did once for each alarm: a million samples with 11 000 took half a minute."""
    given, run = model(RULES), a_run(3)
    verdicts = EnvelopeMonitor(given).check(run)
    over, ks = verdicts.horizon_utilisation, np.flatnonzero(verdicts.alarm & verdicts.judged).tolist()
    values, blamed = verdicts.over_thresholds()
    asked = list[Any]()
    monkeypatch.setattr(Verdicts, "horizon_utilisation", property(lambda self: asked.append(self) or over))
    for k in ks:
        rules = [(i, int(blamed[k, i])) for i in np.flatnonzero(verdicts.rule_alarms[k])]
        assert verdicts.raised(k) == verdicts.alarms.reasons(rules, values[k].tolist(), over[k], verdicts.flags[k])
    assert len(ks) > 5 and not asked
    windows = check_data(given, verdicts, samples=False)["horizons"]
    assert len(asked) == 1, "for what alarms look like"
    outside = (np.abs(over[:, 1:]) > 1.0).any(axis=2).sum(axis=0)
    assert [h["outside"] for h in windows] == outside.tolist() and outside.any()


def test_unarmed_verdicts_leave_no_trace() -> None:
    live = EnvelopeMonitor(model(RULES))
    for step in steps_of(a_run(3)):
        verdict = live.judge(step, armed=False)
        assert not verdict.alarm and np.isnan(verdict.statistics).all()


def test_rules_of_a_monitor_take_the_place_of_the_models() -> None:
    given = model(RULES)
    assert EnvelopeMonitor(given, rules=RULES[:2]).alarms.rules == RULES[:2]
    assert EnvelopeMonitor(given, violations=1).alarms.rules == (AlarmRule(1, 8), *RULES[1:])
    only = EnvelopeMonitor(given, rules=RULES[1:2])
    assert only.rule == AlarmRule() and only.alarms.rules == RULES[1:2], "flags need a margin and arm nothing"
    assert EnvelopeMonitor(given, 2, 3, rules=RULES[1:2]).alarms.rules == (AlarmRule(2, 3), RULES[1])


@pytest.mark.parametrize("relative", [True, False])
def test_chi2_at_a_horizon_is_that_of_its_windows(relative: bool) -> None:
    """r C^-1 r of x_{k+4} less the centre, over the half-width or as files of before have it; of states that count."""
    rule = StatisticRule("chi2", 0.0, 2.0, horizon=4)
    given = model([AlarmRule(50, 50), rule], relative=relative)
    run = a_run(3)
    verdicts = EnvelopeMonitor(given, masked=("x2",)).check(run)
    horizon, known = given.horizons[0], given.residuals_at(4)
    some = [0, 2]
    inverse = np.linalg.inv(known.covariance[np.ix_(some, some)])
    looked = 0
    for k in range(4, 400):
        if np.isnan(verdicts.longer_utilisation[k]).all():
            continue
        x = run.x[k - 4]
        for j in range(k - 4, k):
            x = x + run.dt[j] * (given.A @ x)
        r = ((run.x[k] - x) / (0.5 if relative else 1.0) - known.mean)[some]
        assert verdicts.statistics[k, 0] == pytest.approx(r @ inverse @ r / 2.0, rel=1e-9)
        looked += 1
    assert looked > 300 and horizon.residuals is known


def test_joint_statistics_take_the_utilisation_of_each_sample() -> None:
    """What is twice as far from the centre where the bounds are twice as wide counts the same."""
    zeros = np.zeros((2, 2)), np.zeros((2, 1))
    given = UncertainLTI(
        *zeros, zeros[0], np.array([[3.0], [5.0]]), residuals=Residuals([0.0, 0.0], [[0.2, 0.1], [0.1, 0.3]]),
        alarm=[AlarmRule(50, 50), StatisticRule("chi2", 0.0, 1.0), StatisticRule("mewma", 0.0, 1.0)],
    )  # fmt: skip
    u = np.array([1.0, 2.0, 4.0, 0.5, 1.0])[:, None]
    moved = 0.1 * u[:-1] * np.array([1.5, -2.0])
    run = Transient(np.arange(5) * 0.1, np.concatenate([[[0.0, 0.0]], np.cumsum(moved, axis=0)]), u)
    values = EnvelopeMonitor(given).check(run).statistics[1:]
    nu = np.array([0.5, -0.4])
    np.testing.assert_allclose(values, nu @ np.linalg.inv([[0.2, 0.1], [0.1, 0.3]]) @ nu, rtol=1e-12)


def test_a_masked_state_without_width_does_not_spoil_the_joint_statistic() -> None:
    """Its utilisation is infinite, and its share of the sum nothing."""
    given = model([AlarmRule(50, 50), StatisticRule("chi2", 0.0, 9.0)])
    given = given.replace(v=[0.3, 0.0, 0.3])
    x = np.zeros((5, 3))
    x[:, 1] = np.arange(5)
    run = Transient(np.arange(5) * 0.01, x, np.zeros((5, 1)))
    masked, all_count = (EnvelopeMonitor(given, masked=names).check(run) for names in (("x2",), ()))
    assert np.isinf(masked.utilisation[1:, 1]).all()
    assert np.isfinite(masked.statistics[1:]).all() and not masked.alarm.any()
    assert all_count.alarm[1:].all()


def test_joint_statistics_of_a_file_of_before_take_the_residual_itself() -> None:
    given = model(RULES, relative=False)
    data = given.to_dict()
    assert "relative" not in data["residuals"] and "relative" not in data["horizons"][0]["residuals"]
    again = UncertainLTI.from_dict(data)
    first, second = (EnvelopeMonitor(m).check(a_run(1)) for m in (given, again))
    assert first.statistics.tobytes() == second.statistics.tobytes() and again.to_dict() == data
    new = model(RULES)
    assert new.to_dict()["residuals"]["relative"] is True
    assert again.with_residuals_of(new, instead=True).residuals is again.residuals, "thresholds are for its form"
    assert new.with_residuals_of(again).horizons[0].residuals is again.horizons[0].residuals


def test_a_fit_knows_the_utilisation_of_its_windows() -> None:
    rng = np.random.default_rng(8)
    x = np.zeros((2001, 2))
    for k in range(2000):
        x[k + 1] = x[k] + 0.01 * (np.array([[-1.0, 0.5], [0.0, -2.0]]) @ x[k]) + 0.01 * rng.normal(size=2)
    run = Transient(np.arange(2001) * 0.01, x, np.zeros((2001, 0)))
    fitted = fit(run, additive="noise", horizons=[2, 10], widths="constant")  # type: ignore[arg-type]
    steps = run.transitions()
    used, _ = fitted.over_horizons(steps.k, fitted.normalised_columns(steps), steps.dt, steps.x_next)
    for j, h in enumerate((2, 10)):
        r = used[:, j][~np.isnan(used[:, j, 0])]
        assert len(r) == 2001 - h
        np.testing.assert_allclose(fitted.residuals_at(h).mean, r.mean(axis=0), rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(fitted.residuals_at(h).covariance, np.cov(r.T, bias=True), rtol=1e-9)


def test_residuals_are_those_of_least_squares_less_what_the_one_before_says_of_them(tmp_path) -> None:
    """Of noise that lasts, and by the alarm: by sample, all at once, and of a file."""
    rng = np.random.default_rng(4)
    A, B, m, count = np.array([[0.9, 0.1], [0.0, 0.8]]), np.array([[0.1], [0.3]]), np.array([0.6, 0.0]), 20_000
    x, u, e = np.zeros((count + 1, 2)), np.sign(rng.normal(size=(count + 1, 1))), np.zeros(2)
    for k in range(count):
        e = m * e + rng.multivariate_normal([0, 0], [[0.04, 0.01], [0.01, 0.02]])
        x[k + 1] = A @ x[k] + B @ u[k] + e
    run = Transient(0.1 * np.arange(count + 1), x, u)
    fitted = fit(run, "lp", additive="noise")
    law = fitted.residuals.alike(Residuals([0, 0], np.eye(2), False, Run(A, B, [0, 0])))
    assert law is not None and fitted.residuals.relative and not law.relative
    np.testing.assert_allclose(np.eye(2) + 0.1 * law.law.A, A, atol=0.05)  # refined once
    np.testing.assert_allclose(0.1 * law.law.B, B, atol=0.01)
    np.testing.assert_allclose(law.memory, m, atol=0.06)
    np.testing.assert_allclose(law.covariance, [[0.04, 0.01], [0.01, 0.02]], rtol=0.05)
    armed = fitted.replace(residuals=law, alarm=[StatisticRule("chi2", 0.0, 9.0), StatisticRule("mewma", 1.0, 9.0)])
    armed.save(tmp_path / "m.json")
    some = run.replace(slice(0, 300))
    r = some.x[1:] - some.x[:-1] - 0.1 * (some.x[:-1] @ law.law.A.T + some.u[:-1] @ law.law.B.T + law.law.c)
    r[1:] -= law.memory * r[:-1]
    chi2 = np.einsum("ki,ij,kj->k", r, np.linalg.inv(law.covariance), r)
    monitor = EnvelopeMonitor(armed)
    whole = monitor.check(some)
    one = np.array([monitor.judge(step).statistics for step in steps_of(some)])
    np.testing.assert_allclose(whole.statistics[1:, 0], chi2 / 9.0, rtol=1e-9)
    assert whole.statistics[1:].tobytes() == one[-len(r) :].tobytes()
    again = EnvelopeMonitor(UncertainLTI.load(tmp_path / "m.json")).check(some)
    assert again.statistics.tobytes() == whole.statistics.tobytes()


def test_transitions_are_in_a_row_where_one_begins_with_the_end_of_the_other() -> None:
    rng = np.random.default_rng(6)
    runs = [Transient(0.1 * np.arange(k), rng.normal(size=(k, 2)), rng.normal(size=(k, 1))) for k in (40, 30)]
    problem = assemble(runs, OperatingPoint(np.zeros(2), np.zeros(1), np.ones(2), np.ones(1)), None, "none")
    total, count = in_a_row(problem, 1.0)
    assert problem.N == 68 and count == 66 and total.shape == (12, 12) and total[3, 3] == pytest.approx(66 * 0.01)


def test_no_law_follows_from_few_transitions_or_from_what_it_explains_to_rounding() -> None:
    rng = np.random.default_rng(5)
    w = rng.normal(size=(8, 400))
    assert law_of(w @ w.T, 400, 1) is not None and law_of(w @ w.T, 11, 1) is None
    w[3] = w[:3].sum(axis=0)
    w[7] = w[4:7].sum(axis=0)
    assert law_of(w @ w.T, 400, 1) is None and law_of(np.full((8, 8), np.inf), 400, 1) is None
