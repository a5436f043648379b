# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The nonlinear turbofan: balances, plausibility, modes, control, faults, and the recordings made with it."""

import runpy

import numpy as np
import pytest
from conftest import ROOT

pytest.importorskip("scipy", reason="scipy, which integrates the turbofan, is not installed")

from turbofan_fleet import Ramped, first_sample, simulate_fleet

from uncertain_lti import SignalMap, read_transients
from uncertain_lti.base.errors import UncertainLTIError
from uncertain_lti.plants import turbofan as gas
from uncertain_lti.plants.turbofan import HEALTHY, T_STANDARD, Engine, GasPathSolver, engine
from uncertain_lti.plants.turbofan_runs import (
    CONTROLS,
    DT,
    KINDS,
    START_NS,
    Controller,
    Fault,
    Run,
    _advance,
    fan_speed,
    make_run,
    operating_point,
    pulses,
    simulate,
    trim,
    turbofan_signals,
)
from uncertain_lti.recordings.bag import Bag

RECORDINGS = runpy.run_path(str(ROOT / "bags/make.py"))["TURBOFAN"]
LEVERS = (68.0, 64.0, 60.0, 50.0, 40.0, 25.0, 12.0)
WALSH_FLETCHER_AIR = (0.992313, 0.236688, -1.852148, 6.083152, -8.893933, 7.097112, -3.234725, 0.794571, -0.081873)


@pytest.fixture(scope="module")
def plant() -> Engine:
    return engine()


# --- gas ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("w", [0.0, 0.02, 0.05])
def test_gas_relations_are_inverse_to_one_another(w):
    for T in (250.0, 600.0, 1700.0):
        assert gas.temperature(gas.enthalpy(T, w), w) == pytest.approx(T, rel=1e-13)
        for ratio in (0.1, 0.7, 3.0, 30.0):
            T2 = gas.isentropic_temperature(T, ratio, w)
            assert gas.pressure_ratio(T, T2, w) == pytest.approx(ratio, rel=1e-12)
        slope = (gas.enthalpy(T + 0.5, w) - gas.enthalpy(T - 0.5, w)) / 1.0
        assert slope == pytest.approx(gas.cp(T, w), rel=1e-12)


def test_specific_heat_of_air_is_that_of_walsh_and_fletcher_to_three_per_cent():
    for T in np.linspace(280.0, 1750.0, 50):
        exact = 1e3 * sum(a * (T / 1e3) ** i for i, a in enumerate(WALSH_FLETCHER_AIR))
        assert gas.cp(float(T), 0.0) == pytest.approx(exact, rel=0.023)


def test_a_choked_passage_passes_no_more_when_the_pressure_behind_it_falls():
    flows = [gas.mass_flow(0.2, 3e5, 800.0, 0.01, p) for p in (2.9e5, 2.3e5, 1.8e5, 1.6e5, 1.5e5, 1e5, 1e4)]
    assert flows[0] < flows[1] < flows[2]
    assert flows[-1] == flows[-2] == flows[-3]
    # the textbook flow function at Mach 1
    g = gas.gamma(800.0, 0.01)
    choked = 0.2 * 3e5 / np.sqrt(800.0) * np.sqrt(g / gas.R) * (2 / (g + 1)) ** ((g + 1) / (2 * (g - 1)))
    assert flows[-1] == pytest.approx(choked, rel=1e-12)


# --- steady states ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pla", LEVERS)
def test_mass_energy_and_power_balance_at_every_trimmed_point(plant, pla):
    """To 1e-9 of the flow, of the fuel's heat and of the shaft powers."""
    t = trim(pla)
    p, d = t.path, plant.design
    assert p.W2 == pytest.approx(p.W25 + p.W16, rel=1e-12)
    assert p.W4 == pytest.approx(p.W25 + p.fuel, rel=1e-12)
    assert p.W8 == pytest.approx(p.W2 + p.fuel, rel=1e-9)
    assert p.residual < 1e-9
    assert p.low_turbine_power * d.mechanical_efficiency == pytest.approx(p.fan_power, rel=1e-9)
    assert p.high_turbine_power * d.mechanical_efficiency == pytest.approx(p.compressor_power, rel=1e-9)
    # first law over the whole engine: air, heat of the fuel, bearing losses, exhaust
    heat = p.fuel * (d.combustion_efficiency * gas.HEATING_VALUE + gas.enthalpy(gas.T_REFERENCE, 1.0))
    heat -= p.fuel * gas.enthalpy(gas.T_REFERENCE, 0.0)  # the products are counted from the reference temperature
    losses = (1.0 - d.mechanical_efficiency) * (p.low_turbine_power + p.high_turbine_power)
    into = p.W2 * gas.enthalpy(T_STANDARD, 0.0) + heat + p.fuel * gas.enthalpy(gas.T_REFERENCE, 0.0)
    out = p.W8 * gas.enthalpy(p.T6, p.w6) + losses
    assert abs(into - out) < 1e-9 * p.fuel * gas.HEATING_VALUE
    rate = plant.derivative(t.x.tolist(), t.u.tolist()) / t.x
    assert np.abs(rate).max() < 1e-9


def test_maximum_regime_is_an_engine_of_its_class():
    """Beside the published figures of the RD-33; docs/turbofan.md says where and why they differ."""
    p = trim(68.0).path
    assert p.W2 == pytest.approx(76.0, rel=1e-6)
    assert p.overall_pressure_ratio == pytest.approx(21.7, rel=0.01)
    assert p.bypass_ratio == pytest.approx(0.49, rel=1e-6)
    assert p.thrust == pytest.approx(49.4e3, rel=0.03)
    assert 0.68 < p.specific_consumption < 0.79


def test_controls_act_as_they_do_on_an_engine(plant):
    point, t = operating_point(), trim(60.0)
    A, B = plant.linearise(t.x, t.u, point.X, point.U)
    gain = -np.linalg.solve(A, B)
    fuel, area, fan_vane, _ = gain.T
    assert (fuel > 0).all()  # more fuel: faster, hotter, more pressure
    assert area[0] > 0 and area[3] < 0 and area[4] < 0  # a wider nozzle unloads the turbine: the fan runs faster
    assert fan_vane[0] > 0  # closed vanes unload the fan


def test_modes_are_of_the_order_of_the_papers(plant):
    point = operating_point()
    A, _ = plant.linearise(point.x_s, point.u_s, point.X, point.U)
    values = sorted(np.linalg.eigvals(A).real, reverse=True)
    assert values[:2] == pytest.approx([-1.6, -2.0], rel=0.05)
    assert all(-23.0 < v < -14.0 for v in values[2:])
    assert not A[:2, 2:].any()  # as printed in the paper: readings do not act on the spools


# --- integration and control --------------------------------------------------------------------------------


def test_a_step_is_integrated_to_nine_digits(plant):
    """One step of the run equals a hundred with Runge and Kutta's classical method."""
    point, t = operating_point(), trim(66.0)
    u = t.u * [1.1, 1.05, 1.0, 1.0] + [0.0, 0.0, 2.0, -2.0]
    once = _advance(GasPathSolver(plant), t.x, u, point.X, HEALTHY)
    x, h = t.x.copy(), DT / 100
    solver = GasPathSolver(plant)

    def rate(x):
        return plant.derivative(x.tolist(), u.tolist(), HEALTHY, solver)

    for _ in range(100):
        a = rate(x)
        b = rate(x + 0.5 * h * a)
        c = rate(x + 0.5 * h * b)
        x = x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c))
    assert np.abs((once - x) / point.X).max() < 1e-9
    assert np.abs((once - t.x) / point.X).max() > 1e-4


@pytest.fixture(scope="module")
def accelerated():
    """From 60 to 68 deg and back to 62."""
    return simulate(Run(801, lever=((0.0, 60.0), (1.0, 68.0), (10.0, 62.0))))


def test_fan_speed_follows_the_lever(accelerated):
    x, demand = accelerated.x, [fan_speed(pla) for pla in (60.0, 68.0, 62.0)]
    for second, target in ((0.9, demand[0]), (9.9, demand[1]), (20.0, demand[2])):
        assert x[round(second / DT), 0] == pytest.approx(target, rel=2e-3)
    assert x[:, 0].max() < 1.01 * demand[1]
    assert x[-1] == pytest.approx(trim(62.0).x, rel=3e-3)
    assert accelerated.u[-1, 1:] == pytest.approx(trim(62.0).u[1:], rel=1e-2)


def test_limits_hold(plant, accelerated):
    rate = np.abs(np.diff(accelerated.u, axis=0)) / DT
    limits = [Controller.FUEL_RATE, Controller.AREA_RATE, Controller.VANE_RATE, Controller.VANE_RATE]
    assert (rate <= np.array(limits) * (1 + 1e-9)).all()
    assert rate[:, 0].max() == pytest.approx(Controller.FUEL_RATE)
    assert accelerated.x[:, 4].max() < 1.005 * Controller.TEMPERATURE_LIMIT * operating_point().x_s[4]
    assert accelerated.x[:, 1].max() < 1.002 * Controller.COMPRESSOR_LIMIT * plant.design.compressor_speed


# --- runs ---------------------------------------------------------------------------------------------------


def test_pulses_are_those_of_the_paper():
    u = np.array([pulses(k * DT, 1.0) for k in range(1201)])
    for j in range(4):
        on = np.flatnonzero(u[:, j])
        assert len(on) == 150 and (np.diff(on) == 1).all()  # 3.75 s
        assert (u[on][:, np.arange(4) != j] == 0).all()
    assert (np.count_nonzero(u, axis=1) <= 1).all()
    assert not u[:75].any() and not u[-75:].any()


def test_at_rest_nothing_moves_by_a_single_bit():
    run = simulate(Run(41, lever=((0.0, 68.0),)))
    assert (run.x == run.x[0]).all() and (run.u == run.u[0]).all()
    signals = turbofan_signals()
    assert run.x[0].tolist() == [s.steady for s in signals.states]
    assert run.u[0].tolist() == [s.steady for s in signals.controls]


def test_pulses_start_from_the_steady_state_of_the_lever():
    run, point = simulate(Run(140, 0.1, ((0.0, 62.0),))), operating_point()
    begin = trim(62.0)
    assert run.x[:75] == pytest.approx(np.tile(begin.x, (75, 1)), rel=1e-8)  # at rest until the first pulse
    assert (run.u[0] == begin.u).all()
    assert run.u[75:] - begin.u == pytest.approx(0.1 * point.U * [1, 0, 0, 0] * np.ones((65, 1)), abs=1e-12)


def test_a_run_is_the_same_every_time_and_noise_is_what_was_asked_for():
    quiet = simulate(make_run("levels", samples=201))
    runs = [simulate(make_run("levels", noise=1e-3, seed=seed, samples=201)) for seed in (5, 5, 6)]
    assert np.array_equal(runs[0].x, runs[1].x) and np.array_equal(runs[0].u, runs[1].u)
    assert not np.array_equal(runs[0].x, runs[2].x)
    error = (runs[0].x - quiet.x)[:150] / operating_point().X  # the lever rests: noise moves the loop little
    assert error.std(axis=0) == pytest.approx(np.full(5, 1e-3), rel=0.35)


@pytest.mark.parametrize("kind", KINDS)
def test_a_fault_shows_from_its_onset_and_not_before(kind):
    fault = Fault(kind, 1.0)
    lever = ((0.0, 68.0), (1.5, 62.0))
    healthy, faulty = simulate(Run(121, lever=lever)), simulate(Run(121, lever=lever, fault=fault))
    onset = first_sample(fault)
    assert np.array_equal(healthy.x[:onset], faulty.x[:onset])
    assert np.array_equal(healthy.u[:onset], faulty.u[:onset])
    last = np.abs((faulty.x[-1] - healthy.x[-1]) / operating_point().X).max()
    assert last > 1e-4
    if kind in ("sensor_bias", "fan_damage"):  # sudden: at the very sample
        assert np.abs((faulty.x[onset] - healthy.x[onset]) / operating_point().X).max() > 1e-5


def test_many_runs_at_once_are_the_runs_one_by_one():
    kinds = (None, *(Fault(kind, 0.25) for kind in KINDS))
    lever = ((0.0, 68.0), (0.2, 68.0), (0.2, 66.0), (0.4, 64.0))
    runs = [Ramped(25, lever=lever, noise=1e-4, seed=i, fault=fault) for i, fault in enumerate(kinds)]
    for run, found in zip(runs, simulate_fleet(runs), strict=True):
        one = simulate(run)
        assert np.abs((found.x - one.x) / operating_point().X).max() < 1e-6, run.fault
        assert np.abs((found.u - one.u) / operating_point().U).max() < 1e-6, run.fault


def test_a_stuck_actuator_is_recorded_as_the_command_it_ignores():
    lever = ((0.0, 68.0), (0.5, 62.0))
    run = simulate(Run(161, lever=lever, fault=Fault("nozzle_stuck", 0.25)))
    area = run.u[:, CONTROLS.index("nozzle_throat_area")]
    assert area[-1] > 1.005 * area[0]
    # the engine runs as it would with the area it is stuck at
    free = simulate(Run(161, lever=lever))
    assert run.x[-1, 3] > 1.01 * free.x[-1, 3]


def test_impossible_requests_are_refused_in_a_sentence(plant):
    for call, words in (
        (lambda: trim(70.0), "PLA is 70"),
        (lambda: Fault("gremlins", 1.0), "no fault 'gremlins'"),
        (lambda: Fault("fan_damage", 1.0, 0.0), "positive"),
        (lambda: Fault("fuel_stuck", 1.0, 2.0), "has no size"),
        (lambda: make_run("loop"), "no manoeuvre 'loop'"),
        (lambda: make_run("check", amplitude=0.1), "amplitude"),
        (lambda: make_run("pulses"), "amplitude"),
        (lambda: make_run("check", samples=1), "at least 2"),
        (lambda: make_run("check", noise=-1.0), "noise"),
        (lambda: simulate(make_run("pulses", 0.9)), "no matched gas path"),
    ):
        with pytest.raises(UncertainLTIError, match=words):
            call()


# --- shipped recordings -------------------------------------------------------------------------------------


def test_the_signals_file_says_what_the_plant_is():
    read, made = SignalMap.load(ROOT / "config/signals/turbofan.yaml"), turbofan_signals()
    for a, b in zip(read.signals, made.signals, strict=True):
        assert (a.name, a.topic, a.field, a.unit, a.max_hold) == (b.name, b.topic, b.field, b.unit, b.max_hold)
        assert a.steady == pytest.approx(b.steady, rel=1e-8, abs=1e-12)
        assert a.scale == pytest.approx(b.scale, rel=1e-8)
    assert (read.clock, read.max_gap, dict(read.time)) == (made.clock, made.max_gap, dict(made.time))


def test_a_recording_holds_what_a_simulation_gives():
    """Read from the bag that two processes made, beside the same run made here: stamps, readings and commands."""
    (bag,) = read_transients(ROOT / "bags/turbofan_check.mcap", ROOT / "config/signals/turbofan.yaml")
    made = simulate(make_run(**RECORDINGS["turbofan_check"]))
    assert bag.t_ns[0] == START_NS
    assert np.array_equal(bag.t_ns, made.t_ns)
    assert bag.usable.all()
    X, U = operating_point().X, operating_point().U
    # machines round differently in the last digits, and a reading's last digit is 1e-9
    assert np.abs((bag.x - made.x) / X).max() < 1e-8
    assert np.abs((bag.u[:-1] - made.u[:-1]) / U).max() < 1e-8


def test_every_recording_is_shipped_and_says_what_happens_in_it():
    from mcap.reader import make_reader

    for name, parameters in RECORDINGS.items():
        path = ROOT / "bags" / f"{name}.mcap"
        with path.open("rb") as stream:
            (notes,) = [r.metadata for r in make_reader(stream).iter_metadata() if r.name == "uncertain_lti"]
        assert notes["plant"] == "turbofan"
        assert all(notes[key] == str(value) for key, value in parameters.items() if key != "fault_at")
        if "fault" in parameters:
            assert float(notes["fault_at"].split()[0]) == parameters["fault_at"]
            assert notes["what happens"] == KINDS[parameters["fault"]]
        assert set(Bag(path).topics) == {"/engine/state", "/engine/control"}
    assert sum(p.stat().st_size for p in (ROOT / "bags").iterdir()) < 4 * 2**20
