# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Frozen inputs: what repeats exactly while the nominal model moves it raises an alarm; what rests does not."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from steps import steps_of
from test_event_log import Rig

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI, read_transients
from uncertain_lti.base.arrays import LARGEST
from uncertain_lti.identification import fit
from uncertain_lti.model.alarm_rule import AlarmRule, StatisticRule
from uncertain_lti.model.domain import Domain, Sampling
from uncertain_lti.model.repeats import Repeats, far_longer, needs, repeat_words, repeats_in, together
from uncertain_lti.monitor.reason import over_recording
from uncertain_lti.monitor.session import ERROR, WARN
from uncertain_lti.reports.check import _repeats, check_data, check_text
from uncertain_lti.reports.findings import findings
from uncertain_lti.sampling.clock import Status
from uncertain_lti.sampling.reading import read_as_fitted
from uncertain_lti.validation.monitor_fit import fit_monitored

DT = 0.01


def repeats_of(model: UncertainLTI, transients: list[Transient]) -> Repeats:
    return together(model.n, [repeats_in(model, transient) for transient in transients])


def run(seed: int, seconds: float = 8.0, rest: tuple[float, float] = (0.0, 0.0), noise: float = 1e-4) -> Transient:
    """Position and velocity of a mass on a spring under steps of force; without noise while it rests at 0."""
    rng = np.random.default_rng(seed)
    count = round(seconds / DT)
    t = DT * np.arange(count + 1)
    u = np.repeat(rng.uniform(-1, 1, count // 50 + 2), 50)[: count + 1]
    x = np.zeros((count + 1, 2))
    resting = (t >= rest[0]) & (t < rest[1])
    u[resting] = 0.0
    for k in range(count):
        if resting[k]:
            x[k] = 0.0
        x[k + 1] = x[k] + DT * np.array([x[k, 1], -20 * x[k, 0] - 4 * x[k, 1] + 20 * u[k]])
    read = x + rng.uniform(-noise, noise, x.shape)
    read[resting] = 0.0
    return Transient(t, read, u[:, None], state_names=("position", "velocity"))


def held(transient: Transient, state: int | slice, begin: int, end: int) -> Transient:
    x = transient.x.copy()
    x[begin + 1 : end, state] = x[begin, state]
    return transient.replace(x=x)


@pytest.fixture(scope="module")
def model() -> UncertainLTI:
    return fit([run(1), run(2, rest=(3.0, 4.0))], additive="noise")


def coarse(seed: int, n: int = 5, count: int = 80) -> Transient:
    """States that sensors round to whole numbers."""
    rng, B = np.random.default_rng(seed), np.random.default_rng(0).normal(size=(n, 2))
    u, x = rng.normal(size=(count, 2)), np.zeros((count, n))
    for k in range(count - 1):
        x[k + 1] = 0.9 * x[k] + 0.3 * B @ u[k] + 0.3 * rng.normal(size=n)
    return Transient(DT * np.arange(count), np.round(x), u)


def test_what_was_left_out_tells_how_far_a_model_moves_a_healthy_repeat() -> None:
    """Of a recording that it was fitted to a model of many elements knows why a state stood still."""
    runs = [coarse(seed) for seed in range(3)]
    plain, found = fit(runs, "lp", additive="noise").repeats, fit_monitored(runs, criterion="lp", additive="noise")
    repeats = found.finished().repeats
    assert plain is not None and repeats is not None and found.validation is not None
    left = np.max([repeats_in(part.model, part.transient).most for part in found.validation.parts], axis=0)
    assert (repeats.largest_sum >= left[2]).all() and (plain.largest_sum < left[2]).any()
    assert (repeats.active_beyond >= 2.0 * left[3]).all() and (plain.active_beyond < 2.0 * left[3]).any()
    assert np.array_equal(repeats.longest_repeat_s, plain.longest_repeat_s)
    once = plain.reaching(np.array([np.zeros(5), plain.largest_run, np.full(5, 7.0), np.zeros(5)]))
    assert once.largest_sum.tolist() == [7.0] * 5 and np.array_equal(once.largest_run, plain.largest_run)
    assert np.array_equal(once.active_beyond, plain.active_beyond)
    assert np.isfinite(plain.reaching(np.full((4, 5), np.inf)).largest_run).all(), "where one ran away"


def test_a_fit_learns_the_longest_repeat_of_each_state(model: UncertainLTI) -> None:
    assert model.repeats is not None
    assert model.repeats.longest_repeat_s == pytest.approx([0.99, 0.99])
    assert (model.repeats.largest_run < 0.5).all(), "the model does not move a machine at rest"
    data = model.to_dict()
    assert list(data["frozen"]) == ["longest_repeat_s", "largest_run", "largest_sum", "active_beyond"]
    data["frozen"] = {"longest_repeat_s": [0.5, 0.25]}
    few = UncertainLTI.from_dict(data).repeats
    assert few is not None and few.to_dict() == data["frozen"]
    assert few is not None and few.longest_repeat_s.tolist() == [0.5, 0.25] and np.isinf(few.largest_run).all()


def test_of_two_that_which_calls_fewer_states_frozen_counts() -> None:
    """Noise is known where both have seen it, and as often as in both."""
    one = Repeats([1.0, 0.0], [1.0, 4.0], [2.0, 5.0], [3.0, 6.0], [500.0, 0.0])
    both = one.and_of(Repeats([0.5, 0.25], [7.0, 1.0], [8.0, 1.0], [9.0, 1.0], [700.0, 900.0]))
    assert list(both.to_dict().values()) == [[1.0, 0.25], [7.0, 4.0], [8.0, 5.0], [9.0, 6.0], [1200.0, 0.0]]


@pytest.mark.parametrize("state", [0, 1, slice(None)])
def test_a_held_state_is_reported_while_the_machine_moves(model: UncertainLTI, state: int | slice) -> None:
    late = []
    for seed, begin in zip(range(10, 14), np.random.default_rng(0).integers(100, 600, 4), strict=True):
        healthy = run(seed)
        assert not EnvelopeMonitor(model).check(healthy).frozen.any()
        frozen = held(healthy, state, int(begin), int(begin) + 150)
        verdicts = EnvelopeMonitor(model).check(frozen)
        assert not verdicts.frozen[: begin + 1].any()
        told = np.flatnonzero(verdicts.frozen.any(axis=1))
        late.append((told[0] - begin) * DT if len(told) else np.inf)
        first, end = told[0], begin + 150
        of = {(0, 1)[state]} if isinstance(state, int) else set(np.flatnonzero(verdicts.frozen.any(axis=0)).tolist())
        assert set(np.flatnonzero(verdicts.frozen.any(axis=0)).tolist()) == of
        assert verdicts.alarm[first:end].all() and not verdicts.withheld[end + 1 :].any() and verdicts.judged[end + 1]
        frozen = verdicts.frozen | np.roll(verdicts.frozen, 1, axis=0)  # after it the bounds begin at a stale value
        without = (frozen[:, None, :] & needs(model)).any(axis=2)
        assert np.array_equal(np.isnan(verdicts.flags)[first : end + 2], without[first : end + 2])
    assert max(late) <= 1.0


def three() -> UncertainLTI:
    """Three levels: the second needs the first, by 0.01 * 10 * 2 = 0.2 against 0.1; the third does not, by 0.02."""
    A = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    domain = Domain(*([side] * size for side, size in ((-1.0, 3), (1.0, 3), (-1.0, 1), (1.0, 1))))
    rules = [AlarmRule(1, 1), StatisticRule("energy", 0.05, 20.0), StatisticRule("mean", 0.1, 20.0)]
    return UncertainLTI(
        A, [[10.0], [0.0], [0.0]], 0 * A, np.zeros((3, 1)), v=[0.1] * 3, domain=domain,
        sampling=Sampling(dt_median=0.01), repeats=Repeats([0.0] * 3, [0.0] * 3, [0.0] * 3), alarm=rules,
    )  # fmt: skip


def test_a_row_needs_a_state_that_moves_it_by_more_than_its_half_width() -> None:
    model = three()
    assert needs(model).tolist() == [[True, False, False], [True, True, False], [False, False, True]]
    for element, needed in ((4.999, False), (5.001, True)):  # 0.01 * 5 * 2 is the half-width
        A = model.A.copy()
        A[2, 1] = element
        assert needs(model.replace(A=A))[2, 1] == needed
        dA = np.zeros((3, 3))
        dA[2, 1] = element  # half of which the half-width has already
        assert needs(model.replace(dA=dA, v=[0.1, 0.1, 0.1 - 0.01 * element]))[2, 1] == needed
    exact = model.replace(sampling=Sampling(dt_median=0.25), v=[0.5] * 3)
    for element, needed in ((1.0, False), (1.25, True)):  # 0.25 * 1 * 2 is the half-width to the last bit
        assert needs(exact.replace(A=[[0.0] * 3, [0.0] * 3, [element, 0.0, 0.0]]))[2, 0] == needed
    everywhere = model.replace(domain=None)
    assert needs(everywhere).tolist() == [[True, False, False], [True, True, False], [True, False, True]]


@pytest.mark.parametrize("masked", [(), ("x3",)])
def test_what_does_not_need_a_frozen_state_is_judged_on(masked: tuple[str, ...]) -> None:
    rng = np.random.default_rng(0)
    u = np.full((200, 1), 0.8)
    x = rng.uniform(-0.02, 0.02, (200, 3)) + 0.5
    x[50:100, 0] = x[50, 0]
    x[80, 2] += 5.0
    model, transient = three(), Transient(DT * np.arange(200), x, u)
    verdicts = EnvelopeMonitor(model, masked=masked).check(transient)
    told = np.flatnonzero(verdicts.frozen[:, 0])
    assert told.tolist() == list(range(told[0], 100)) and told[0] <= 53 and not verdicts.frozen[:, 1:].any()
    lost = np.isnan(verdicts.flags)
    assert lost[told[0] : 101, 0].all() and lost[told[0] : 101, 1].all() and not lost[101:].any()
    assert verdicts.alarm[told].all()
    statuses = verdicts.statuses()
    if masked:
        assert lost[told[0] : 101].all() and statuses[told[0]] is Status.FROZEN
    else:
        assert not lost[1:, 2].any() and verdicts.flags[80, 2] == 1.0 and statuses[80] is Status.OK
        assert {r.state for r in verdicts.raised(80)} == {"x3"}
        (line,) = [s for k, s in over_recording(verdicts, model) if k == 80]
        assert line.startswith("alarm: frozen: x1; ") and line.endswith("x3; no verdict on x1, x2")


def test_a_masked_state_that_leaves_its_bounds_beside_a_frozen_one_raises_no_rule() -> None:
    x = np.random.default_rng(0).uniform(-0.02, 0.02, (200, 3)) + 0.5
    x[50:100, 2] = x[50, 2]
    x[80, 1] += 5.0
    transient = Transient(DT * np.arange(200), x, np.zeros((200, 1)))
    verdicts = EnvelopeMonitor(three(), masked=("x2",)).check(transient)
    assert verdicts.frozen[80].tolist() == [False, False, True] and verdicts.flags[80, 1] == 1.0
    assert verdicts.alarm[80] and verdicts.raised(80) == ()
    live = EnvelopeMonitor(three(), masked=("x2",))
    assert [live.judge(step) for step in steps_of(transient)][80].raised == ()


NOISY = [0.0], [0.0], [0.0], [LARGEST]


@pytest.mark.parametrize(
    ("repeats", "dt", "rate", "steps"),
    [
        (([60.0], [1.0], [LARGEST], [LARGEST]), 0.25, 1.0, 5),  # beyond twice what was reached, half a width a step
        (([60.0], [0.25], [LARGEST], [LARGEST]), 0.25, 1.0, 3),  # and beyond the half-width
        (([60.0], [LARGEST], [LARGEST], [LARGEST]), 0.25, 1.0, None),  # it ran as far in the fit, of a half-width of 0
        (([1.0],), 0.25, 1.0, 5),  # not known how far: after the longest repeat
        # a coarse sensor repeats while the machine moves, up to twice the longest of the fit, however far it ran
        *((([longest], [0.1], [0.1], [LARGEST]), 0.01, 500.0, steps) for longest, steps in ((0.05, 11), (0.0, 1))),
        (([60.0], [0.1], [0.1], [LARGEST]), 0.01, 500.0, 26),
        # by noise alone: half a second of a slow state and a quarter of a fast one, if 5000 steps have shown it
        ((*NOISY, [5000.0]), 0.5, 0.0, 1),
        ((*NOISY, [5000.0]), 0.25, 0.0, 2),
        ((*NOISY, [4999.0]), 0.25, 0.0, 3),
        ((*NOISY, [1000.0]), 0.01, 0.0, 25),
        ((*NOISY, [999.0]), 0.01, 0.0, None),
    ],
)
def test_a_state_that_stops_is_frozen_beyond_what_was_recorded(repeats, dt, rate, steps):
    model = UncertainLTI([[0.0]], [[rate]], [[0.0]], [[0.0]], v=[0.5], repeats=Repeats(*repeats))
    x = np.concatenate([np.linspace(5.0, 4.0, 20), np.full(60, 4.0)])[:, None]
    for margin in (1.0, 2.0):  # half-widths are those of the model
        verdicts = EnvelopeMonitor(model, margin=margin).check(Transient(dt * np.arange(80), x, np.ones((80, 1))))
        assert np.flatnonzero(verdicts.frozen).tolist() == ([] if steps is None else list(range(19 + steps, 80)))
        assert all(not rate or why.startswith("while the model moves it by ") for why in verdicts.why_frozen.values())


@pytest.mark.parametrize(
    ("longest", "rate", "steps"),
    [(0.0, 5.0, 3), (1.0, 5.0, 3), (2.0, 0.2, 5), (3.0, 0.2, None), (4.0, 5.0, 9), (60.0, 500.0, 11)],
)
def test_at_a_sample_a_second_two_equal_ones_are_no_repeat_and_three_a_rest(
    longest: float, rate: float, steps: int | None
) -> None:
    """However far the model moves the state meanwhile; a rest of the fit may be longer the next time.

    Of a coarse sensor some equal samples are chance at any rate: up to twice the most of the fit, and ten.
    """
    repeats, sampling = Repeats([longest], [0.75], [LARGEST], [LARGEST]), Sampling(1.0, 1.0, 1.0)
    model = UncertainLTI([[0.0]], [[rate]], [[0.0]], [[0.0]], v=[0.5], repeats=repeats, sampling=sampling)
    x = np.concatenate([np.linspace(5.0, 4.0, 20), np.full(10, 4.0)])[:, None]
    verdicts = EnvelopeMonitor(model).check(Transient(np.arange(30.0), x, np.ones((30, 1))))
    assert np.flatnonzero(verdicts.frozen).tolist() == ([] if steps is None else list(range(19 + steps, 30)))


@pytest.mark.parametrize(("longest", "longer"), [(0.956, []), (0.944, [20])])
def test_a_repeat_is_longer_than_those_of_the_fit_if_it_is_by_half_a_step(longest: float, longer: list[int]) -> None:
    model = UncertainLTI([[0.0]], [[0.0]], [[0.0]], [[0.0]], v=[0.5], repeats=Repeats([longest]))
    x = np.concatenate([np.linspace(5.0, 4.0, 11), np.full(10, 4.0)])[:, None]
    verdicts = EnvelopeMonitor(model).check(Transient(0.1 * np.arange(21), x, np.ones((21, 1))))
    assert np.flatnonzero(verdicts.repeating).tolist() == longer


def test_a_sum_counts_where_another_state_has_moved_by_more_than_its_half_width() -> None:
    """The run rests at half a half-width; the sum adds as much at each step, and the other moves by a quarter."""
    zeros, A, B = np.zeros((2, 2)), np.array([[-4.0, 0.0], [0.0, 0.0]]), np.array([[1.0], [0.0]])
    model = UncertainLTI(A, B, zeros, 0 * B, v=[0.5, 0.5])
    x = np.full((20, 2), 0.25)
    x[:, 1] = 0.125 * np.arange(20)
    transient = Transient(0.25 * np.arange(20), x, np.full((20, 1), 2.0))
    for margin, longest, first in ((1.0, 0.5, 5), (2.0, 0.5, 5), (1.0, 1.5, 7)):  # and the fit has no rest as long
        known = model.replace(repeats=Repeats([longest, 0.0], [1.0, 0.0], [0.25, 0.0], [LARGEST] * 2))
        verdicts = EnvelopeMonitor(known, margin=margin).check(transient)
        assert np.flatnonzero(verdicts.frozen[:, 0]).tolist() == list(range(first, 20))
        why = f"the model's steps add up by {first / 2} half-widths (at most 0.25 in the fit)"
        assert why in verdicts.why_frozen[first, 0]


MOVING = 0.01 * np.arange(500)


def resting(read: float, other: ArrayLike = 1.0, longest: float = 0.0, push: float = 1.0) -> NDArray[np.bool_]:
    """Where a state is frozen that reads the same for 50 s, while the model moves it by `push` half-widths each second.

    `other`: what another state reads, of the model alone; `longest`: the longest repeat of the fit, s, with a run and
    a sum of one half-width.
    """
    zeros, count = np.zeros((2, 2)), 500
    known = Repeats([longest, longest], [1.0, 1.0], [1.0, 1.0], [LARGEST] * 2)
    model = UncertainLTI(zeros, [[push], [0.0]], zeros, zeros[:, :1], v=[1.0, 1.0], repeats=known)
    x = np.column_stack([np.full(count, read), np.broadcast_to(other, count)])
    return EnvelopeMonitor(model).check(Transient(0.1 * np.arange(count), x, np.ones((count, 1)))).frozen[:, 0]


def test_at_zero_or_parked_a_steady_push_is_no_sign_of_a_frozen_state() -> None:
    """A brake, friction or another posture holds a machine at rest against what the model expects."""
    assert np.flatnonzero(resting(0.5, MOVING))[0] == 20, "beyond twice the largest run, after 2.1 s"
    assert not resting(0.0, MOVING).any() and not resting(0.5).any()


def test_a_rest_may_be_longer_than_those_of_the_fit() -> None:
    """Where the fit has seen rests of a second or more, what they reached grows with the time."""
    for longest, push, frozen in ((0.9, 1.0, True), (1.0, 1.9, False), (1.0, 2.1, True), (5.0, 0.3, False)):
        assert resting(0.5, MOVING, longest, push).any() == frozen


def test_the_run_of_a_row_that_grows_by_itself_is_its_sum() -> None:
    """An own element above 0 would multiply the least step beyond all numbers."""
    t, u = 0.1 * np.arange(100), np.full((100, 1), 1e-3)
    model = UncertainLTI([[30.0]], [[1.0]], [[0.0]], [[0.0]], v=[0.5])
    found = repeats_of(model, [Transient(t, np.zeros((100, 1)), u)])
    assert found.largest_run[0] == pytest.approx(found.largest_sum[0]) == pytest.approx(99e-4 / 0.5)


def test_the_run_of_a_row_that_overshoots_goes_to_its_rest_in_a_step() -> None:
    """Followed freely, an own element below -2 a step would multiply the least step beyond all numbers, too."""
    t, u = 0.1 * np.arange(100), 1e-3 * (-1.0) ** np.arange(100)[:, None]
    model = UncertainLTI([[-50.0]], [[1.0]], [[0.0]], [[0.0]], v=[0.5])
    assert repeats_of(model, [Transient(t, np.zeros((100, 1)), u)]).largest_run[0] == pytest.approx(1e-4 / 0.5)


@pytest.mark.parametrize("beyond", [0.09, 0.11])
def test_outside_the_fitted_ranges_nothing_is_called_frozen(beyond: float) -> None:
    domain = Domain(np.zeros(1), np.ones(1), np.zeros(1), np.ones(1))
    known = Repeats([0.0], [0.0], [0.0], [0.0], [5000.0])
    model = UncertainLTI([[0.0]], [[1.0]], [[0.0]], [[0.0]], v=[0.1], repeats=known, domain=domain)
    u = np.full((30, 1), 1.0 + beyond)
    transient = Transient(0.25 * np.arange(30), np.full((30, 1), 0.5), u)
    assert EnvelopeMonitor(model).check(transient).frozen.any() == (beyond < 0.1)


def test_no_sentence_on_a_repeat_contradicts_itself() -> None:
    assert repeat_words(0.696, 2.55) == "repeats exactly for 0.696 s"
    assert repeat_words(89.34, 89.26) == "repeats exactly for 89.3 s"
    assert repeat_words(3.0, 2.0) == "repeats exactly for 3 s (at most 2 s in the fit)"
    assert repeat_words(3.0, 0.0) == "repeats exactly for 3 s (never in the fit)"
    assert repeat_words(36000.0, 510.0) == "repeats exactly for 10 h (at most 8.5 min in the fit)"


def test_a_warning_tells_of_a_repeat_that_is_far_longer_and_not_by_chance():
    """Of a healthy car the yaw rate repeated for four samples at 50 Hz, two in the fit, 'as of a machine at rest'."""
    assert not any(far_longer(*times) for times in [(0.08, 0.04), (0.03, 0.02), (0.0801, 0.04), (2.9, 2.0)])
    assert all(far_longer(*times) for times in [(0.09, 0.04), (0.3, 0.15), (3.1, 2.0), (0.02, 0.0)])


def test_a_training_recording_with_bounds_of_no_width_is_not_frozen() -> None:
    """A valve that opens once in a long recording: its half-width is 0 and any run of it is infinite."""
    rng = np.random.default_rng(0)
    level, valve = np.empty(600), np.zeros(600)
    valve[300:305] = 1.0
    level[0] = 0.0
    for k in range(599):
        level[k + 1] = level[k] + 0.1 * (valve[k] - level[k]) + rng.normal(0, 0.01)
    transient = Transient(np.arange(600.0), np.column_stack([level, valve]), rng.normal(size=(600, 1)))
    model = fit([transient], additive="both")
    narrow = model.replace(dA=0 * model.dA, dB=0 * model.dB, v=[model.v[0], 0.0], dc=[model.dc[0], 0.0])
    narrow = narrow.replace(repeats=repeats_of(narrow, [transient]))
    assert narrow.repeats is not None and narrow.repeats.largest_run[1] == LARGEST
    for one in (model, narrow):
        for margin in (1.0, 1.7):
            assert not EnvelopeMonitor(one, margin=margin).check(transient).frozen.any()


def test_a_run_beyond_all_numbers_is_learnt_as_the_largest_there_is() -> None:
    """An unstable row, held for long: the run is infinite, and then no number."""
    model = UncertainLTI([[1e6]], [[1.0]], [[0.0]], [[0.0]], v=[0.5])
    run = Transient(np.arange(200.0), np.ones((200, 1)), np.where(np.arange(200) < 100, 0.0, -1e60)[:, None])
    assert repeats_of(model, [run]).largest_run.tolist() == [LARGEST]


def test_a_parked_machine_is_a_warning(model: UncertainLTI) -> None:
    parked = run(5, seconds=12.0, rest=(2.0, 9.0))
    verdicts = EnvelopeMonitor(model).check(parked)
    assert not verdicts.frozen.any() and not verdicts.alarm[210:900].any()
    told = np.flatnonzero(verdicts.repeating[:, 0])
    assert told[0] == pytest.approx(300, abs=1) and told[-1] == 899
    data = check_data(model, verdicts)
    assert {r["state"] for r in data["repeats"]} == {"position", "velocity"} and not data["frozen"]
    assert data["repeats"][0]["seconds"] == pytest.approx(6.99)
    said = "warning: position repeats exactly for 6.99 s (at most 0.99 s in the fit) from 2.0000 s, "
    assert f"{said}as of a machine at rest" in check_text(data)
    u = parked.u.copy()
    u[400:600] = u.max()
    for last in (u[-1], np.nan):  # a value that is missing hid what moved
        u[-1] = last
        verdicts = replace(verdicts, transient=parked.replace(u=u))  # by its own verdicts it would be frozen
        assert f"{said}while {model.control_names[0]} moved" in check_text(check_data(model, verdicts))
    data = check_data(model, EnvelopeMonitor(model).check(run(5, seconds=12.0, rest=(2.0, 3.2))))
    assert data["repeats"] and "warning: " not in check_text(data), "a little longer than the 0.99 s of the fit"


def test_a_frozen_state_breaks_the_windows_of_the_horizons() -> None:
    model = fit([run(1), run(2, rest=(3.0, 4.0))], additive="noise", horizons=[2, 5])
    frozen = held(run(12), 0, 200, 350)
    verdicts = EnvelopeMonitor(model).check(frozen)
    assert verdicts.frozen.any() and np.isnan(verdicts.horizon_utilisation[340:351]).all()
    assert np.isnan(verdicts.horizon_utilisation[351:355, 2]).all()
    assert not np.isnan(verdicts.horizon_utilisation[355]).any()


def test_a_masked_state_and_a_model_without_repeats_are_not_watched(model: UncertainLTI) -> None:
    frozen = held(run(12), 0, 200, 350)
    assert EnvelopeMonitor(model).check(frozen).frozen.any()
    for monitor in (EnvelopeMonitor(model, masked=["position"]), EnvelopeMonitor(model.replace(repeats=None))):
        verdicts = monitor.check(frozen)
        assert not verdicts.frozen.any() and verdicts.judged[1:].all()


def test_a_machine_that_is_active_is_not_parked() -> None:
    """The control goes to and fro, so the model never moves the state by its wide half-width; three steps tell."""
    for dt, each, limits in ((0.1, 2, (0.3, 0.5)), (0.25, 1, (0.9, 1.1))):
        u = np.tile(np.repeat([1.0, -1.0], each), 80 // each)
        x = np.zeros((len(u), 1))
        x[:41, 0] = 0.01 * np.arange(41)  # fresh values first
        x[40:, 0] = x[40, 0]
        transient = Transient(dt * np.arange(len(u)), x, u[:, None])
        for beyond, told in zip(limits, (True, False), strict=True):
            repeats = Repeats([60.0], [0.4], [0.4], [beyond])  # of a machine that was parked for a minute
            model = UncertainLTI([[0.0]], [[1.0]], [[0.0]], [[0.0]], v=[0.5], repeats=repeats)
            frozen = EnvelopeMonitor(model).check(transient).frozen[:, 0]
            assert np.flatnonzero(frozen).tolist() == (list(range(43, len(u))) if told else [])
    parked = Transient(transient.t_ns, np.zeros_like(x), np.ones_like(transient.u))
    assert not EnvelopeMonitor(model.replace(repeats=Repeats([60.0], [40.0], [40.0], [0.0]))).check(parked).frozen.any()


@pytest.mark.parametrize(("dt", "told"), [(0.1, False), (0.26, True)])
def test_at_zero_only_activity_of_more_than_a_half_width_tells(dt: float, told: bool) -> None:
    """It is 0.4 and 1.04 half-widths here, and 0.3 would be enough elsewhere: brakes and friction hold what rests."""
    x = 0.01 * np.minimum(np.arange(80) - 40, 0.0)[:, None]
    model = UncertainLTI([[0.0]], [[1.0]], [[0.0]], [[0.0]], v=[0.5], repeats=Repeats([60.0], [0.4], [0.4], [0.3]))
    for value, frozen in ((0.0, told), (0.5, True)):
        transient = Transient(dt * np.arange(80), x + value, np.tile([1.0, -1.0], 40)[:, None])
        assert EnvelopeMonitor(model).check(transient).frozen.any() == frozen


def test_a_fit_learns_how_active_a_machine_is_whose_state_changes(model: UncertainLTI) -> None:
    """A quarter of the seconds is less active if the machine was parked, half if not; of few it is a half-width."""
    few = [run(1), run(2, rest=(3.0, 4.2))]
    many = [*few, run(3), run(4)]
    assert (repeats_of(model, few).active_beyond == 1.0).all()
    learnt = repeats_of(model, many).active_beyond
    briefly = repeats_of(model, [run(1), run(2, rest=(3.0, 3.5)), run(3), run(4)]).active_beyond
    assert (0.0 < learnt).all() and (learnt < briefly).all()
    found = [repeats_in(model, transient) for transient in (*many, held(run(5), 0, 200, 350))]
    held_once = together(model.n, found).active_beyond
    assert held_once[0] == 2.0 * max(one.most[3, 0] for one in found)
    assert held_once[0] > learnt[0] and held_once[1] == pytest.approx(learnt[1], rel=0.2)
    one, t = UncertainLTI([[0.0]], [[1.0]], [[0.0]], [[0.0]], v=[0.5]), np.arange(80)
    for x, left_out in ((t // 2, True), (t * 3 // 4, False)):  # half of four steps, and one of them, repeat
        windows = repeats_in(one, Transient(0.25 * t, x[:, None], np.zeros((80, 1)))).windows
        assert len(windows) == 20 and np.isnan(windows).all() == np.isnan(windows).any() == left_out


def noisy(seed: int, steps: int = 1500) -> Transient:
    """A level between 2 and 4 that follows a step of its control every 10 s, read once a second with noise."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(2, 4, steps // 10 + 1), 10)[: steps + 1]
    x = np.empty(steps + 1)
    x[0] = u[0]
    for k in range(steps):
        x[k + 1] = x[k] + 0.3 * (u[k] - x[k])
    return Transient(np.arange(steps + 1.0), (x + rng.normal(0, 0.2, steps + 1))[:, None], u[:, None])


def test_what_noise_changes_at_every_step_is_frozen_at_its_first_slow_repeat() -> None:
    """The model never moves it by its half-width, so only the noise tells; of a sensor at 0 nothing is known."""
    model = fit([noisy(1, 8000)], additive="noise")
    assert model.repeats is not None and model.repeats.noisy_steps[0] > 5000
    for seed in (2, 3):
        assert not EnvelopeMonitor(model).check(noisy(seed)).frozen.any()
        frozen = held(noisy(seed, 60), 0, 22, 50)
        verdicts = EnvelopeMonitor(model).check(frozen)
        assert np.flatnonzero(verdicts.frozen[:, 0]).tolist() == list(range(23, 50))
        said = "FROZEN: x1 repeats exactly for 27 s (never in the fit)"
        (line,) = [line for line in check_text(check_data(model, verdicts)).splitlines() if line.startswith(said)]
        assert ", told after 1 s, while at constant controls noise changed it " in line
        u = frozen.u.copy()
        u[33:36] = np.nan  # without a control no verdict, and yet it is one repeat
        data = check_data(model, EnvelopeMonitor(model).check(frozen.replace(u=u)))
        assert [x for x in check_text(data).splitlines() if x.startswith("FROZEN")] == [line]
        few = model.replace(repeats=Repeats([0.0], [0.0], [0.0], [LARGEST], [4999.0]))
        assert np.flatnonzero(EnvelopeMonitor(few).check(frozen).frozen)[0] == 25
    off = noisy(4, 60)
    off = off.replace(x=np.where(np.arange(61)[:, None] > 30, 0.0, off.x), u=np.where(off.t[:, None] > 20, 0.0, off.u))
    verdicts = EnvelopeMonitor(model).check(off)
    assert verdicts.repeating[32:].all() and not verdicts.frozen.any()


@pytest.mark.parametrize("recur", [False, True])
def test_noise_is_known_of_states_whose_values_never_recur(recur: bool) -> None:
    """A coarse sensor repeats by chance, sooner or later; a model that explains every change knows no noise."""
    read = noisy(1, 3000)
    known = read.replace(x=np.round(read.x, 1)) if recur else read
    model = fit([known], additive="noise")
    assert model.repeats is not None and (model.repeats.noisy_steps[0] > 1000) is not recur
    explained = UncertainLTI([[-0.3]], [[0.3]], [[0.0]], [[0.0]], v=[0.5])
    exact = Transient(np.arange(30.0), 0.7 ** np.arange(30.0)[:, None], np.zeros((30, 1)))
    assert repeats_of(explained, [exact]).noisy_steps.tolist() == [0.0]


def test_a_slow_sensor_repeats_regularly() -> None:
    """A state at a tenth of the clock's rate repeats nine times of ten, and that is no fault."""

    def slow(transient: Transient) -> Transient:
        x = transient.x.copy()
        x[:, 0] = np.repeat(x[::10, 0], 10)[: len(x)]
        return transient.replace(x=x)

    model = fit([slow(run(1)), slow(run(2))], additive="noise")
    assert model.repeats is not None and model.repeats.longest_repeat_s[0] == pytest.approx(0.09)
    assert (model.repeats.largest_run == LARGEST).tolist() == [True, False], "how far it runs between two says nothing"
    for seed in range(40, 43):
        assert not EnvelopeMonitor(model).check(slow(run(seed))).frozen.any()
        verdicts = EnvelopeMonitor(model).check(held(slow(run(seed)), 0, 200, 400))
        assert verdicts.frozen[200:340, 0].any()


def frozen_rig(repeats: Repeats, **rule: Any) -> Rig:
    """A session whose model knows so much of repeats."""
    rig = Rig(**rule)
    rig.watch(rig.model.replace(repeats=repeats, domain=None), rig.session.rule)
    return rig


def test_a_session_names_what_is_frozen() -> None:
    rig = frozen_rig(Repeats([0.0, 0.0]))
    rig.send(30)
    assert not rig.session.alarm
    rig.lines.clear()
    rig.u[:] = -0.5
    rig.send(60, frozen=1)
    assert rig.session.alarm and rig.session.last is not None
    (line,) = [line for line in rig.lines if line.startswith("alarm")]
    assert line.startswith("alarm, frozen: b repeats exactly for ") and "half-widths" in line
    monitor, a, b = rig.session.report(rig.now, 10.0)
    assert monitor.level == b.level == ERROR and "alarm: frozen: b repeats exactly for 0." in monitor.message
    assert "every state needs one that is frozen" in monitor.message and b.message.startswith("frozen: repeats exactly")
    assert a.level != ERROR and int(monitor.values["frozen"]) > 30 and monitor.values["alarm"] == "1"
    rig.send(30, frozen=1)
    _, a, _ = rig.session.report(rig.now, 10.0)
    assert (a.level, a.message) == (WARN, "no verdict: it needs a state that is frozen")
    monitor, *_ = rig.session.report(rig.now + 20.0, 10.0)
    assert "frozen" not in monitor.message.split(";")[0], "nothing arrives, so nothing is known to be frozen"
    rig.send(5)
    assert not rig.session.alarm and "the alarm is over" in " ".join(rig.lines)
    rig.send(30, frozen=1)
    rig.send(5)
    monitor, *_ = rig.session.report(rig.now, 10.0)
    assert monitor.level == ERROR and monitor.message.startswith("alarm: frozen: b"), "not a rule that raised nothing"


def test_a_session_warns_of_a_long_repeat() -> None:
    rig = frozen_rig(Repeats([0.1, 0.0]), masked="b")
    rig.x[:] = 0.0
    rig.u[:] = 0.0
    rig.send(40)
    assert not rig.session.alarm
    monitor, a, b = rig.session.report(rig.now, 10.0)
    assert a.level == WARN and "repeats exactly for 0.39 s (at most 0.1 s in the fit)" in a.message
    assert monitor.level != ERROR and b.level != WARN


def test_not_armed_it_is_named_and_raises_no_alarm(model: UncertainLTI) -> None:
    live, frozen = EnvelopeMonitor(model), held(run(12), 0, 200, 350)
    verdicts = [live.judge(step, armed=False) for step in steps_of(frozen)]
    assert not any(v.alarm for v in verdicts) and any(v.frozen for v in verdicts)
    assert Status.FROZEN in [v.status for v in verdicts]


def test_reset_clears_the_alarm_and_a_state_that_stays_frozen_raises_it_again(model: UncertainLTI) -> None:
    live = EnvelopeMonitor(model, 50, 50)
    for step in steps_of(held(run(12), 0, 200, 350))[:320]:
        live.judge(step)
    assert live.alarm
    live.reset()
    assert not live.alarm
    assert live.judge(steps_of(held(run(12), 0, 200, 350))[320]).alarm


def test_reports_name_what_is_frozen(model: UncertainLTI, tmp_path: Path) -> None:
    from uncertain_lti.reports.pages import html_report

    checked = [EnvelopeMonitor(model, 50, 50).check(held(run(12), 0, 200, 350))]
    data = check_data(model, checked[0])
    assert data["alarm"] and data["outcome"] == "alarm" and len(data["frozen"]) == 1
    (frozen,) = data["frozen"]
    assert frozen["state"] == "position" and frozen["k"] == 200 and frozen["seconds"] == pytest.approx(1.49)
    assert frozen["told_after"] < 1.0 and frozen["longest_in_fit"] == pytest.approx(0.99)
    assert any(said.endswith(" frozen") for said in data["no_verdict"])
    assert data["verdict_per_sample"][340]["status"] == "frozen" and data["verdict_per_sample"][340]["alarm"]
    line = "FROZEN: position repeats exactly for 1.49 s (at most 0.99 s in the fit) from 2.0000 s, told after "
    assert line in check_text(data) and data["alarms"][0]["frozen"] == ["position"]
    assert "  raised by a frozen position" in check_text(data).splitlines()
    facts = findings(model, "m", checked)
    assert facts["alarm"] and " frozen: position repeats exactly for 1.49 s" in facts["happened"][0]["text"]
    assert line in html_report(model, checked, facts)


def test_a_report_without_an_alarm_names_the_longest_repeat_beside_what_moves() -> None:
    """A level sensor hung for half an hour, and only `check` said so."""
    repeats = Repeats([1.0, 0.0], [LARGEST, LARGEST], [LARGEST, LARGEST], [LARGEST, LARGEST])
    model = UncertainLTI(
        np.zeros((2, 2)), np.zeros((2, 0)), np.zeros((2, 2)), np.zeros((2, 0)), v=[5, 5], repeats=repeats
    )
    x = np.sin(np.column_stack([np.arange(60), np.arange(60)]))
    x[20:30, 0], x[40:58, 0] = x[20, 0], x[40, 0]
    (happened,) = findings(
        model, "m", [EnvelopeMonitor(model).check(Transient(np.arange(60.0), x, np.zeros((60, 0))))]
    )["happened"]
    assert happened["text"].endswith(
        "x1 repeats exactly for 17 s (at most 1 s in the fit) from 40.0000 s, while x2 moved"
    )


def test_the_range_of_a_recording_is_looked_at_once_for_all_repeats(monkeypatch: pytest.MonkeyPatch) -> None:
    """It was once for each: half a million samples with 2500 repeats took a minute and a half."""
    repeats = Repeats([0.0, 0.0], [LARGEST, LARGEST], [LARGEST, LARGEST], [LARGEST, LARGEST])
    model = UncertainLTI(
        np.zeros((2, 2)), np.zeros((2, 0)), np.zeros((2, 2)), np.zeros((2, 0)), v=[5, 5], repeats=repeats
    )
    x = np.sin(np.arange(800.0)[:, None] + [0.0, 1.0])
    for k in range(10, 790, 20):
        x[k : k + 8, 0] = x[k, 0]
    x[:, 1][400:] = x[400, 1]
    x[420:760:20, 0] = np.nan  # one repeat of x2, in which verdicts pause
    verdicts = EnvelopeMonitor(model).check(Transient(np.arange(800.0), x, np.zeros((800, 0))))
    looked = list[int]()
    fmax = SimpleNamespace(reduce=lambda z: looked.append(len(z)) or np.maximum.reduce(np.nan_to_num(z, nan=-9.0)))
    with monkeypatch.context() as patched:
        patched.setattr("uncertain_lti.reports.check.np.fmax", fmax)
        found = _repeats(model, verdicts, verdicts.repeating)
    assert len(found) > 30 and len({r["state"] for r in found}) == 2 and sum(looked) < 2 * len(x)
    assert found[-1]["k"] > 0 and max(r["seconds"] for r in found if r["state"] == "x2") == 399.0


def test_a_quadruped_with_a_held_joint(recordings: Path, signals_folder: Path, tmp_path: Path) -> None:
    """Three instants of three joints, held to the end of the second, of a recording fitted on every other second."""
    missed = 0
    for joint in (0, 11):
        text = (signals_folder / "go2_joint.yaml").read_text().replace("[j0]", f"[j{joint}]")
        (tmp_path / "signals.yaml").write_text(text)
        (whole,) = read_transients(recordings / "go2/test_3.mcap", tmp_path / "signals.yaml")
        seconds = [whole.replace(slice(start, start + 500)) for start in range(0, 6500, 500)]
        model = fit(seconds[::2])
        for part in seconds[1::2]:
            assert not EnvelopeMonitor(model).check(part).frozen.any()
        for begin in (2900, 3900, 4900):  # the joints do not move before
            for state in (0, 1):
                frozen = held(whole.replace(slice(begin - 100, begin + 600)), state, 100, 700)
                told = np.flatnonzero(EnvelopeMonitor(model).check(frozen).frozen[:, state])
                missed += not (len(told) and frozen.t[told[0]] - frozen.t[100] <= 1.0)
    assert missed <= 1, "one leaves the fitted ranges, where nothing is called frozen"


@pytest.mark.parametrize(
    ("signals", "fitted", "checked"),
    [
        ("neato", ["neato/person_follower.mcap"], ["neato/draw_square.mcap"]),
        ("hunter_se", ["hunter_se/straight_odd_t_0_5_run_01.mcap"], ["hunter_se/straight_even_t_0_2_run_01.mcap"]),
        ("crazyflie_vicon", ["crazyflie/rollbag_0.mcap"], ["crazyflie/yx3bag_0.mcap", "crazyflie/yx4bag_0.mcap"]),
    ],
)
def test_healthy_recordings_raise_none(recordings, signals_folder, signals, fitted, checked):
    model = fit(read_transients([recordings / name for name in fitted], signals_folder / f"{signals}.yaml"))
    for name in checked:
        assert not EnvelopeMonitor(model).check(read_as_fitted(recordings / name, model.signals)).frozen.any()
