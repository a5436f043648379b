# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Diagnosis: each message appears where its cause is, and not where it is not."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from tanks import Tanks

from uncertain_lti import EnvelopeMonitor, SignalMap, Transient, read_transients
from uncertain_lti.identification import evidence, fit
from uncertain_lti.identification.diagnosis import remedies
from uncertain_lti.reports.check import check_data, check_text
from uncertain_lti.reports.findings import findings
from uncertain_lti.reports.model_text import next_text
from uncertain_lti.sampling.steady_state import resolve_auto
from uncertain_lti.signals.signal_map import Signal

A = np.array([[-1.0, 0.4], [0.3, -2.5]])
B = np.array([[1.0, 0.2], [0.1, 2.0]])


def steps(rng, count, held=12):
    """Levels of both signs, drawn anew at random instants."""
    fresh = rng.random((count, 2)) < 1 / held
    levels = rng.uniform(-1, 1, (count, 2))
    u = np.zeros((count, 2))
    for k in range(1, count):
        u[k] = np.where(fresh[k], levels[k], u[k - 1])
    return u


def run(seed=0, count=1500, noise=1e-3, dt=0.05, u=None, feedback=None, lag=0, change=None, plant=(A, B), **options):
    """A linear plant under random steps, sensor noise on top; `change` edits the recorded x and u."""
    rng = np.random.default_rng(seed)
    nominal, gain = plant
    u = steps(rng, count + 1) if u is None else u.copy()
    x = np.zeros((count + 1, 2))
    for k in range(count):
        if feedback is not None:
            u[k] = u[k] * 0.2 - feedback @ x[k]
        x[k + 1] = x[k] + dt * (nominal @ x[k] + gain @ u[max(k - lag, 0)]) + dt * 2e-3 * rng.standard_normal(2)
    if feedback is not None:
        u[count] = u[count] * 0.2 - feedback @ x[count]
    x = x + noise * rng.standard_normal(x.shape)
    if change is not None:
        x, u = change(x, u)
    names = dict(state_names=["speed", "flow"], control_names=["valve", "pump"])
    t_ns = np.rint(np.arange(count + 1) * dt * 1e9).astype(np.int64)
    return Transient(t_ns, x, u, name="run", **{**names, **options})


def put(rows, state, value):
    """A change of a recording: a value, or what is made of x, in these rows of a state."""

    def change(x, u):
        x = x.copy()
        x[rows, state] = value(x) if callable(value) else value
        return x, u

    return change


def messages(*transients, additive="noise", **options):
    return fit(list(transients), additive=additive, seek_carriers=True, **options).fit_summary["messages"]


WORDS = {
    "collinear": "nearly move together",
    "weak": "moves too little",
    "feedback": "follow from the states",
    "slow": "sampling is slow",
    "frozen": "frozen sensor",
    "held": "repeats its last value",
    "delay": "better when it is taken",
    "few": "as wide as the rest needs",
    "noise": "like noise from sample to sample",
    "missing": "one sample earlier explains",
    "code": "stands for no value",
    "jitter": "the stamps jitter",
    "bursts": "come in bursts",
    "flip": "change sign together",
    "wrap": "wraps around",
}


def said(found):
    return {key for key, words in WORDS.items() if any(words in message for message in found)}


@pytest.mark.parametrize(("seed", "noise"), [*enumerate([0.0, 1e-4, 1e-3, 1e-2])])
def test_healthy_recordings_cause_no_alarm(seed, noise):
    assert said(messages(run(seed, noise=noise))) == set()


def test_controls_that_nearly_move_together_are_named_with_the_cure():
    rng = np.random.default_rng(1)
    u = steps(rng, 1501)
    u[:, 1] = 0.7 * u[:, 0] + 0.01 * u[:, 1]
    (message,) = [m for m in messages(run(u=u, noise=0.0)) if WORDS["collinear"] in m]
    assert "'valve' and 'pump'" in message and "record 'valve' moving while 'pump' rests" in message
    third = np.column_stack([u[:, 0], rng.normal(size=1501), 0 * u[:, 0]])
    third[:, 2] = third[:, 0] - third[:, 1] + 0.01 * rng.normal(size=1501)  # of three no two move together
    x = np.zeros((1501, 1))
    for k in range(1500):
        x[k + 1] = 0.9 * x[k] + third[k, :1] + 0.01 * rng.normal()
    three = Transient(0.05 * np.arange(1501), x, third, control_names=["a", "b", "c"])
    (message,) = [m for m in messages(three) if WORDS["collinear"] in m]
    assert "record 'a' moving while 'b' and 'c' rest;" in f"{message};", message


def test_signals_tied_in_several_ways_are_named_with_all_that_tie_them():
    """Of wheels and odometry 'left' and 'right' were said to move together, of a mecanum base 'fr' and 'vx'."""
    rng = np.random.default_rng(0)
    for names, turns in (
        ("left right vx wz", [[1, 1], [-0.3, 0.3]]),
        ("fl fr rl rr vx vy wz", [[1, 1, 1, 1], [-1, 1, 1, -1], [-0.5, 0.5, -0.5, 0.5]]),
    ):
        u = np.repeat(rng.normal(size=(60, len(turns))), 50, axis=0)
        base = np.zeros_like(u)
        for k in range(len(u) - 1):
            base[k + 1] = (
                base[k] + 0.05 * (u[k] / np.arange(1, len(turns) + 1) - base[k]) + 0.002 * rng.normal(size=len(turns))
            )
        x = np.hstack([10 * base @ np.array(turns), base + 0.0005 * rng.normal(size=base.shape)])
        found = messages(Transient(0.02 * np.arange(len(x)), x, u, state_names=names.split()))
        named = [
            re.findall(r"'(\w+)'", m.partition(" nearly")[0]) for m in found if WORDS["collinear"] in m and "'" in m
        ]
        assert named, found
        for some in named:
            X = x[:, [names.split().index(name) for name in some]]
            assert np.linalg.eigvalsh(np.corrcoef(X.T))[0] < 1e-3, (some, found)


def test_signals_of_which_the_level_is_most_are_not_said_to_move_together():
    """With the recorded values as they are, temperatures and a set point that is always 40 were."""
    one = run(noise=0.0)
    found = [messages(one.replace(x=one.x + level, u=one.u + 30)) for level in (0, 20)]
    assert all(WORDS["collinear"] not in text for text in found[1]), found


def test_columns_that_move_together_in_two_ways_are_named_once():
    one = run(noise=0.0)
    twice = [m for m in messages(Transient(one.t_ns, one.x[:, [0, 0, 1, 1]], one.u, name="run")) if "rank def" in m]
    assert len(twice) == len(set(twice)) > 0


def test_a_state_that_follows_its_control_is_named_with_the_cure():
    u = np.zeros((1501, 2))
    u[:, 0] = np.sin(np.arange(1501) * 0.002)  # far slower than the plant
    u[:, 1] = steps(np.random.default_rng(2), 1501)[:, 1]
    apart = (np.diag(np.diag(A)), np.diag(np.diag(B)))
    (message,) = [m for m in messages(run(u=u, noise=0.0, plant=apart)) if WORDS["collinear"] in m]
    assert "'speed' and 'valve'" in message and "steps of 'valve' that are sharper than 'speed' can follow" in message


def test_a_steady_state_far_from_what_was_recorded_is_named():
    """Such as of another unit: controls of which every step shows were said to move too little, or to move together."""
    one = run()
    for x, u, name in (([0, 1e3], [0, 0], "flow"), ([0, 0], [300, 0], "valve"), ([1e9, 2e9], [0, 0], "")):
        moved = one.replace(x=one.x + x, u=one.u + u)
        found = [m for m in messages(moved) if WORDS["weak"] in m or "rank def" in m or "steady: auto" in m]
        assert len(found) == 1 and f"'{name}" in found[0] and "and its steady state 0, so" in found[0], found
        assert not any("steady: auto" in m for m in messages(moved, additive="both"))
    assert not any("steady: auto" in m for m in messages(one))


def test_control_lost_in_the_noise_is_named():
    u = steps(np.random.default_rng(4), 1501)
    u[:, 1] *= 1e-5
    (message,) = [m for m in messages(run(u=u, noise=1e-2)) if WORDS["weak"] in m]
    assert "'pump'" in message and "its standard error" in message
    assert not any(WORDS["weak"] in m for m in messages(run(u=u, noise=0.0, count=1500, seed=4)) if "'valve'" in m)
    (message,) = [m for m in messages(run(u=u * [1e-5, 1.0], noise=1e-2)) if WORDS["weak"] in m]
    assert "each of the controls 'valve', 'pump' moves too little" in message  # one note, however many


@pytest.mark.parametrize("field", ["v", "lag(u, 1)"])
def test_a_control_that_acts_a_sample_later_is_not_called_weak_beside_that_sample(field):
    u = steps(np.random.default_rng(4), 1501)
    u[1:, 1], u[0, 1] = u[:-1, 0], 0.0
    states, controls = [Signal(name, "/a", name) for name in ("speed", "flow")], [Signal("valve", "/b", "u")]
    signals = SignalMap(states, [*controls, Signal("before", "/b", field)])
    found = messages(run(u=u, noise=1e-2, plant=(A, B * [0.0, 1.0]), signals=signals))
    assert any(WORDS["weak"] in m and "'valve'" in m for m in found) == (field == "v")


def test_control_set_by_a_feedback_is_named_and_open_loop_is_not():
    K = np.array([[2.0, 0.3], [0.1, 1.5]])
    found = messages(run(feedback=K, noise=0.0, u=np.zeros((1501, 2))))
    (message,) = [m for m in found if WORDS["feedback"] in m]  # one note, however many
    assert "the changes of each of the controls 'valve', 'pump' follow" in message
    own = 5 * steps(np.random.default_rng(6), 1501, held=6)
    topped = run(feedback=0.2 * np.eye(2), u=own, noise=0.0)  # steps of its own on top
    for healthy in (run(5, noise=0.0), topped, run(5, noise=0.0, at="both")):
        assert "feedback" not in said(messages(healthy))


def test_what_moves_axes_of_their_own_is_looked_at_by_axis():
    """A command that follows another axis, as a geared one, was called fed back, and too weak to be told from it."""
    rng, dt, count = np.random.default_rng(7), 0.01, 4000
    u, x = np.zeros((count + 1, 2)), np.zeros((count + 1, 2))
    u[:, 0] = steps(rng, count + 1)[:, 0]
    for k in range(count):
        x[k + 1] = x[k] + dt * 8 * (u[k] - x[k]) + 0.002 * rng.normal(size=2)
        u[k + 1, 1] = x[k + 1, 0] + 1e-4 * rng.normal()
    states, controls = (
        [{"name": "{}" + end, "for": ["left", "right"], "topic": topic, "field": "position[{}]"}]
        for end, topic in (("", "/s"), ("_command", "/u"))
    )
    for structure in ({}, {"structure": "own"}):
        signals = SignalMap.from_dict({"states": states, "controls": controls, **structure})
        found = messages(Transient(dt * np.arange(count + 1), x, u, signals=signals))
        assert {"feedback", "weak"} & said(found) == (set() if structure else {"feedback", "weak"}), found


@pytest.mark.parametrize(("dt", "slow"), [(0.02, False), (0.2, False), (0.5, True)])
def test_step_too_long_for_the_fastest_mode(dt, slow):
    assert ("slow" in said(messages(run(dt=dt, noise=1e-5)))) == slow


def test_frozen_sensor_is_named_with_its_stretch():
    freeze = put(slice(400, 520), 1, lambda x: x[400, 1])
    (message,) = [m for m in messages(run(change=freeze)) if WORDS["frozen"] in m]
    assert "'flow'" in message and "119 samples" in message
    assert "run at 20 s" in message


def test_a_machine_at_rest_is_not_frozen():
    at_its_end = put(slice(400, 520), 1, lambda x: x[:, 1].max())
    assert "frozen" not in said(messages(run(change=at_its_end)))
    u = steps(np.random.default_rng(7), 1501)
    u[300:700] = 0.0

    settle = put(slice(400, 700), slice(None), 0.0)
    assert "frozen" not in said(messages(run(u=u, change=settle, noise=0.0)))

    def beside_noise(x, u):  # which moves at any time: a load at its limit was a frozen sensor beside a voltage
        x, u = put(slice(300, 400), 1, lambda x: x[300, 1])(x, u)
        return np.column_stack([np.random.default_rng(1).normal(size=len(x)), x[:, 1]]), u

    assert "frozen" not in said(messages(run(u=u, change=beside_noise)))


def test_a_block_of_a_long_recording_that_ends_as_a_rest_begins_is_not_frozen():
    """Of 28500 transitions 0 to 999 and 1447 to 2446 are looked at: the first end in a repeat, and the others at 0."""
    count = 28_500

    def change(x, u):
        x = put(1000, 1, x[999, 1])(x, u)[0]
        return put(slice(1447, 1500), 1, lambda x: x[:, 1].min())(x, u)

    assert "frozen" not in said(messages(run(u=steps(np.random.default_rng(7), count + 1), count=count, change=change)))


@pytest.mark.parametrize("period", [2, 5])
def test_state_of_a_slower_topic_is_named_with_its_period(period):
    slower = put(slice(None), 1, lambda x: x[np.arange(len(x)) // period * period, 1])

    def said_of(**judged):
        states = [Signal("speed", "/a", "x"), Signal("flow", "/a", "y", **judged)]
        controls = [Signal("valve", topic, "u"), Signal("pump", topic, "v")]
        found = messages(run(change=slower, signals=SignalMap(states, controls)))
        (message,) = [m for m in found if WORDS["held"] in m]
        assert "'flow'" in message and f"every {period} samples" in message
        return message.rsplit("; ")[-1]

    topic = "/b"
    assert said_of() == "make its topic the clock, list it as a control, or leave it out"
    assert said_of(judged=True) == "take `judged: true` away"  # of a control
    topic = "/a"  # as of a table
    assert said_of() == "list it as a control, or leave it out"
    slower = put(slice(None), slice(None), lambda x: x[np.arange(len(x)) // period * period])
    (message,) = [m for m in messages(run(change=slower)) if WORDS["held"] in m]
    assert message.startswith("each of 'speed' and 'flow' repeats its last value in at least ")


@pytest.mark.parametrize(("lag", "noise"), [(1, 1e-2), (7, 1e-4)])
def test_delay_is_found_and_setting_it_mends_the_fit(lag, noise):
    transient = run(10, lag=lag, noise=noise)
    (found,) = (m for m in messages(transient) if WORDS["delay"] in m)
    assert "each of the controls 'valve', 'pump'" in found and f"`delay: {lag}`" in found
    shifted = Transient(transient.t_ns[lag:], transient.x[lag:], transient.u[: len(transient) - lag])
    assert "missing" not in said(messages(transient)) and "delay" not in said(messages(shifted))
    mended, plain = (fit(t, additive="noise").fit_summary["mean_width"] for t in (shifted, transient))
    assert (mended < plain).all()


def test_noise_predicts_nothing_on_average_however_many_regressors_there_are():
    rng = np.random.default_rng(0)
    X, U, after = (rng.normal(size=(200, 40, k)) for k in (8, 2, 5))
    shares = np.array([evidence.predicted(*drawn) for drawn in zip(X, U, after, strict=True)])
    assert abs(shares.mean()) < 0.015 and shares.min() < 0.0  # 0.256 by chance if nothing is taken off
    np.testing.assert_allclose(evidence.predicted(X[0], U[0], X[0] @ np.ones((8, 1)) + U[0] @ np.ones((2, 1))), 1.0)


def test_a_delay_that_explains_next_to_nothing_of_many_states_is_not_named():
    """Of twelve states one follows the control late: sure of enough samples, and 0 % of what is unexplained."""
    rng, count, told = np.random.default_rng(3), 3000, {}
    u = steps(rng, count)[:, :1]
    noise = 0.1 * rng.normal(size=(count, 12))
    for effect in (0.08, 0.4):
        x = np.zeros((count, 12))
        for k in range(3, count - 1):
            x[k + 1] = 0.9 * x[k] + noise[k]
            x[k + 1, 0] += effect * u[k - 3, 0]
        told[effect] = [m for m in messages(Transient(np.arange(count) * 0.05, x, u)) if WORDS["delay"] in m]
    assert told[0.08] == [] and len(told[0.4]) == 1


def test_real_recordings_say_what_is_known_of_them(recordings, signals_folder):
    def of(bags, signals):
        return fit(read_transients([recordings / b for b in bags], signals_folder / signals)).fit_summary["messages"]

    hunter = of(["hunter_se/straight_odd_t_0_5_run_01.mcap"], "hunter_se.yaml")
    assert {"collinear"} <= said(hunter)  # a straight run: the speed follows a throttle that only opens
    neato = said(of(["neato/person_follower.mcap"], "neato.yaml"))
    assert "slow" in neato and "delay" not in neato  # its signals file sets the delay
    assert "weak" in said(of(["crazyflie/yx3bag_0.mcap"], "crazyflie_vicon.yaml"))
    assert said(of(["crazyflie/rollbag_0.mcap"], "crazyflie_vicon.yaml")) == {"missing"}  # its rate, not its amplitude
    assert "missing" in said(of(["micro_gas_turbine/ex_20.mcap"], "micro_gas_turbine.yaml"))
    assert "missing" not in neato | said(hunter)
    go2 = said(of(["go2/test_3.mcap"], "go2_joint.yaml"))
    assert "jitter" in go2  # 0.12 to 4.8 ms around 2 ms
    assert not go2 & {"missing", "code", "delay", "slow", "weak", "held", "frozen"}


# --- few samples, and noise ---


def spiked(at, size=0.5):
    return put(list(at), 0, lambda x: x[list(at), 0] + size)


@pytest.mark.parametrize("at", [(400,), (400, 700, 701, 1100)])
def test_few_samples_that_carry_a_width_are_named_and_discarding_them_does_what_is_said(at):
    spoiled = run(change=spiked(at))
    (message,) = [m for m in messages(spoiled) if WORDS["few"] in m]
    assert "'speed'" in message and "run at 19.95 s, 20 s" in message  # into the first spike, and out of it
    count = int(message.split("--discard ")[1].split()[0])
    assert count == 2 * len(at) - (701 in at)
    wide, narrow = fit([spoiled], additive="noise"), fit([spoiled], additive="noise", discard=count)
    said_factor = float(message.split("'speed' ")[1].split(" times")[0])
    factor = wide.fit_summary["mean_width"][0] / narrow.fit_summary["mean_width"][0]
    assert factor == pytest.approx(said_factor, rel=0.01)
    assert not any(WORDS["few"] in m for m in narrow.fit_summary["messages"])


def test_of_many_states_with_such_samples_the_widest_are_named_and_the_rest_counted():
    parts = [run(seed=seed, change=spiked((400,))) for seed in range(5)]
    x, u = np.hstack([p.x[:, :1] for p in parts]), np.hstack([p.u for p in parts])
    (message,) = [m for m in messages(Transient(parts[0].t_ns, x, u, name="run")) if WORDS["few"] in m]
    assert " and of 1 other state as wide as" in message


def test_for_a_criterion_that_would_discard_others_the_stretch_is_named():
    (message,) = [m for m in messages(run(change=spiked((400,))), criterion="lp") if WORDS["few"] in m]
    assert "leave that stretch out" in message and "--discard" not in message


white = put(slice(None), 1, lambda x: 2.0 + 0.05 * np.random.default_rng(9).standard_normal(len(x)))


def test_a_state_that_is_noise_is_named():
    found = messages(run(change=white))
    assert "slow" not in said(found)
    (message,) = [m for m in found if WORDS["noise"] in m]
    assert message.startswith("'flow' moves like noise")


def test_remedies_go_by_what_was_found():
    assert "missing" not in remedies([], "noise", "flow")
    assert remedies([], "none", "flow") == "try --additive noise"
    assert "leave it out" in remedies(messages(run(change=white)), "noise", "flow")
    assert "sample faster" in remedies(messages(run(dt=0.5, noise=1e-5)), "noise", "flow")
    few = remedies(messages(run(change=spiked((400,)))), "noise", "speed")
    assert "few samples" in few and "faster" not in few


def test_many_signals_that_move_together_get_few_sentences():
    rng = np.random.default_rng(5)
    base = np.cumsum(rng.uniform(-1, 1, (1500, 1)), axis=0)
    x = base @ rng.uniform(0.5, 1, (1, 30)) + 1e-3 * rng.standard_normal((1500, 30))
    wide = Transient(np.arange(1500) * 0.01, x, np.zeros((1500, 0)), name="run")
    found = [m for m in messages(wide) if WORDS["collinear"] in m]
    assert (
        len(found) == 2 and "28 combinations" in found[-1] and all(len(m) < 700 for m in found)
    )  # 2 of 29 of the same


# --- a missing state ---


def resonance(turn, damping, noise, measured=(0, 1), seed=0, count=1500, dt=0.05, hidden=0.0):
    """A resonance that turns so many radians in a step, sampled exactly; `measured`: its states that are recorded."""
    rng = np.random.default_rng(seed)
    w = turn / dt
    plant = np.array([[0.0, w], [-w, -2 * damping * w]])
    values, vectors = np.linalg.eig(plant)
    F = (vectors @ np.diag(np.exp(values * dt)) @ np.linalg.inv(vectors)).real
    G = np.linalg.solve(plant, F - np.eye(2)) @ np.array([0.0, w])
    u = steps(rng, count + 1)[:, :1]
    x = np.zeros((count + 1, 2))
    for k in range(count):
        x[k + 1] = F @ x[k] + G * u[k, 0] + 2e-3 * rng.standard_normal(2)
    x = x / x.std(axis=0)
    x = (x + noise * rng.standard_normal(x.shape))[:, list(measured)]
    return Transient(np.arange(count + 1) * dt, x, u * (1 - hidden), name="run")


def test_one_jump_does_not_hide_how_noise_is_correlated():
    """The mean of two neighbours of white noise, whose correlation is a half and then none."""
    rng = np.random.default_rng(0)
    z, white = rng.normal(size=(2000, 2)), 1e-3 * rng.normal(size=2001)
    moved = white[1:] + white[:-1]
    moved[700] += 0.1
    problem = SimpleNamespace(z=z.T, N=2000, n=1, dt=np.ones(2000), x_next=(z[:, :1] + moved[:, None]).T)
    np.testing.assert_allclose(evidence._correlation(problem, np.arange(1, 2000)), [[0.5, 0.0]], atol=0.05)


@pytest.mark.parametrize("turn", [0.3, 1.6])
def test_a_missing_state_is_named_with_its_number_and_the_cure_narrows(turn):
    half = resonance(turn, 0.02, 0.01, measured=[0])
    found = messages(half)
    (message,) = [m for m in found if WORDS["missing"] in m]
    assert "'x1'" in message and "autocorrelation" in message and not {"weak", "noise"} & said(found)
    share = float(message.split("explains ")[1].split("%")[0]) / 100
    wider = Transient(half.t_ns[1:], half.x[1:], np.hstack([half.u[1:], half.x[:-1]]), name="run")
    before, after = (fit(t, additive="noise").fit_summary["mean_width"][0] for t in (half, wider))
    assert after / before < 1 - 0.5 * share
    assert "missing" not in said(messages(resonance(turn, 0.02, 0.01)))  # with both states recorded


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_a_curved_machine_lacks_no_state(noise):
    assert "missing" not in said(messages(*Tanks(1, spread=0.2).transients(6, 1, noise=noise)))


def test_a_lagged_state_as_control_is_understood(recordings, signals_folder):
    """What the message asks for is taken without complaint of the very likeness that was wanted, and narrows."""
    bag, signals = recordings / "crazyflie/rollbag_0.mcap", SignalMap.load(signals_folder / "crazyflie_vicon.yaml")
    plain = fit(read_transients(bag, signals))
    (message,) = [m for m in plain.fit_summary["messages"] if WORDS["missing"] in m]
    entry = yaml.safe_load(re.search(r"control \((\{.*\})\)", message)[1])
    added = replace(signals.states[0], name=entry["name"], field=entry["field"])
    assert (entry["topic"], entry["field"]) == (added.topic, f"lag({signals.states[0].field}, 1)")
    better = fit(read_transients(bag, replace(signals, controls=(*signals.controls, added))))
    assert better.fit_summary["mean_width"][0] < 0.6 * plain.fit_summary["mean_width"][0]
    found = better.fit_summary["messages"]
    assert not said(found) & {"collinear", "feedback", "slow", "delay"} and "unstable" not in str(found)


# --- numbers that are no movement ---


@pytest.mark.parametrize(("code", "at"), [(9999.0, [5, 6, 700]), (-32768.0, range(900))])
def test_a_number_that_stands_for_no_value_is_named_and_no_steady_state(code, at):
    spoiled = run(change=put(list(at), 0, code))
    found = messages(spoiled)
    assert WORDS["code"] in found[0] and f"'speed' is exactly {code:.9g} in {len(at)} of 1500" in found[0]
    assert not {"missing", "weak", "hidden"} & said(found)
    assert "jumps without moving" in remedies(found, "noise", "speed")
    signals = [Signal("speed", "/s", "a", steady="auto", scale="auto"), Signal("flow", "/s", "b")]
    steady, scale, words = resolve_auto(signals, [spoiled.x])
    assert abs(steady[0]) < 3 and scale[0] < 10 and f"speed {code:.9g} in {len(at)}" in words
    assert "code" not in said(messages(run()))


def attitude(flips=(), names=("qz", "qw"), count=1500):
    """Heading of a robot as two components of a quaternion."""
    rng = np.random.default_rng(0)
    u = steps(rng, count + 1)[:, :1]
    angle = np.cumsum(0.05 * u[:, 0]) * 0.5
    x = np.column_stack([np.sin(angle / 2), np.cos(angle / 2)]) + 1e-4 * rng.standard_normal((count + 1, 2))
    x = x / np.linalg.norm(x, axis=1)[:, None]
    sign = np.ones(count + 1)
    for k in flips:
        sign[k:] *= -1
    return Transient(np.arange(count + 1) * 0.05, x * sign[:, None], u, name="run", state_names=list(names)), angle


def test_a_quaternion_that_flips_is_named_with_its_cure():
    transient, _ = attitude([400, 900, 903])
    found = messages(transient)
    assert found[0].startswith("'qz' and 'qw' change sign together in 3 steps (run at 19.95 s, 44.95 s, 45.1 s)")
    assert "use roll, pitch or yaw" in found[0]
    assert "flip" not in said(messages(attitude()[0]))
    assert "flip" not in said(messages(attitude([400], names=("left", "right"))[0]))  # nobody said that it is one


def test_an_angle_that_wraps_is_named():
    _, angle = attitude()
    u = attitude()[0].u
    for x, wraps in ((angle, False), ((angle * 20 + np.pi) % (2 * np.pi) - np.pi, True)):
        found = messages(Transient(np.arange(1501) * 0.05, x[:, None], u, name="run", state_names=["yaw"]))
        assert ("wrap" in said(found)) == wraps
    assert any("use 'unwrap(yaw)'" in m for m in found)
    degrees = np.degrees((angle * 20 + np.pi) % (2 * np.pi))
    found = messages(Transient(np.arange(1501) * 0.05, degrees[:, None], u, name="run", state_names=["yaw"]))
    assert any("use 'unwrap(yaw, 360)'" in m for m in found)


def uneven(stamps_only, seed=0, noise=1e-3, count=2000, pace=1.0):
    """Exact samples of a linear plant at uneven steps, or at even ones with uneven stamps."""
    rng = np.random.default_rng(seed)
    stated = 0.05 * np.exp(0.3 * rng.standard_normal(count))
    u = steps(rng, count + 1)
    x = np.zeros((count + 1, 2))
    values, vectors = np.linalg.eig(pace * A)
    inverse = np.linalg.inv(vectors)
    for k, dt in enumerate(np.full(count, 0.05) if stamps_only else stated):
        F = vectors @ np.diag(np.exp(values * dt)) @ inverse
        x[k + 1] = F @ x[k] + np.linalg.solve(pace * A, (F - np.eye(2)) @ B @ u[k]) + dt * 2e-3 * rng.standard_normal(2)
    t = np.concatenate([[0.0], np.cumsum(stated)])
    return Transient(t, x + noise * rng.standard_normal(x.shape), u, name="run")


def test_a_check_whose_stamps_jitter_says_so_beside_its_alarm():
    """The fit saw even stamps."""
    model = fit(run(noise=1e-3))
    for found, jitters in ((uneven(True), True), (uneven(False), False)):
        data = check_data(model, EnvelopeMonitor(model).check(found), samples=False)
        assert data["alarm"] and ("  the stamps jitter" in check_text(data)) == jitters
        assert not jitters or check_text(data).endswith("and fit again")


@pytest.mark.parametrize("noise", [1e-4, 1e-2])
def test_stamps_that_jitter_are_named_and_samples_that_do_are_not(noise):
    (message,) = [m for m in messages(uneven(True, noise=noise)) if WORDS["jitter"] in m]
    assert "around 49.5 ms" in message and "stamped at the sensor" in message
    for pace in (0.3, 10.0):
        assert "jitter" not in said(messages(uneven(False, noise=noise, pace=pace)))
    assert "jitter" not in said(messages(run(noise=noise)))


def test_messages_that_come_in_bursts_are_told_how_they_count():
    """Of an even clock behind a slow link a third was lost as gaps, and the rest was taken for 20 kHz."""
    even = run()
    t = even.t_ns.astype(float)
    for tell, times in (
        (True, t[np.arange(len(t)) // 8 * 8] + 1e5 * (np.arange(len(t)) % 8)),
        (False, t),
        (False, t + np.where(np.arange(len(t)) > 300, 1e15, 0.0)),  # one long pause
        (False, np.cumsum(np.where(np.random.default_rng(3).random(len(t)) < 0.03, 1e10, 1e6))),  # sent on a change
    ):
        found = messages(Transient(np.rint(times) * 1e-9, even.x, even.u, name="run"))
        assert ("bursts" in said(found)) == tell
        assert not tell or "write `step: constant` and `max_gap: 0" in found[0]


def test_a_coarse_encoder_that_is_sampled_fast_is_no_slow_sensor():
    """It is new every few samples while it moves, and hardly ever where it comes to rest: 96 % repeats."""
    t = 1e-4 * np.arange(12_000)
    angle = 3e-4 * np.round(400 * (1.0 - np.exp(-8 * t)))
    transient = Transient(t, angle[:, None], np.empty((len(t), 0)))
    found = fit(transient, "lp", additive="noise").fit_summary["messages"]
    assert (np.diff(angle) == 0).mean() > 0.8 and not any("slower than the clock" in text for text in found)
    rng = np.random.default_rng(0)
    slow = np.repeat(np.cumsum(rng.normal(size=1800)), 5)  # while the machine rests at the end, too
    transient = Transient(
        1e-2 * np.arange(12_000), np.append(slow, np.full(3000, slow[-1]))[:, None], np.empty((12_000, 0))
    )
    found = fit(transient, "lp", additive="noise").fit_summary["messages"]
    assert any("new about every 5 samples: its topic or its sensor is slower than the clock" in text for text in found)


def test_what_asks_for_nothing_is_neither_what_to_look_at_first_nor_a_reason_for_care():
    model = fit([run()], "qp", additive="both")
    told = "Δt is constant, so dc and v cannot be told apart: v takes the width and dc is 0"
    assert told in model.fit_summary["messages"] and "look first at: Δt" not in next_text(model, "m.json")
    reasons = findings(model, "m.json", [EnvelopeMonitor(model).check(run(1))])["rely"]["reasons"]
    assert not any("Δt is constant" in reason["text"] for reason in reasons)
