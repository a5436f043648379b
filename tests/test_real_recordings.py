# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Real recordings of real machines, from bag to verdict through the commands a user types."""

import numpy as np
import pytest
from scipy.linalg import expm

from uncertain_lti import EnvelopeMonitor, UncertainLTI, read_transients
from uncertain_lti.base.errors import FitError
from uncertain_lti.identification import fit
from uncertain_lti.sampling.reading import read_as_fitted

RECORDINGS = [  # recordings, signals file, additive term that its noise asks for, are pure intervals infeasible
    (("go2/test_3.mcap",), "go2_joint.yaml", "both", True),
    (("micro_gas_turbine/ex_1.mcap", "micro_gas_turbine/ex_20.mcap"), "micro_gas_turbine.yaml", "both", True),
    (("hunter_se/straight_odd_t_0_5_run_01.mcap",), "hunter_se.yaml", "disturbance", True),
    (("neato/person_follower.mcap",), "neato.yaml", "both", True),
    (("crazyflie/rollbag_0.mcap",), "crazyflie_vicon.yaml", "noise", False),
    (("crazyflie/rollbag_0.mcap",), "crazyflie_estimate.yaml", "noise", False),
]


def outside(model, transients):
    count = 0
    for t in transients:
        x, u, k = model.operating_point.normalise_x(t.x), model.operating_point.normalise_u(t.u), t.usable
        lower, upper = model.bounds(x[:-1][k], u[:-1][k], t.dt[k])
        count += int((~((lower <= x[1:][k]) & (x[1:][k] <= upper))).sum())
    return count


@pytest.mark.parametrize(("bags", "signals", "additive", "infeasible"), RECORDINGS)
@pytest.mark.parametrize("criterion", ["qp", "lp"])
def test_fit_contains_and_is_not_absurd(recordings, signals_folder, bags, signals, additive, infeasible, criterion):
    transients = read_transients([recordings / b for b in bags], signals_folder / signals)
    model = fit(transients, criterion, additive=additive)
    assert outside(model, transients) == 0
    for margin in (1.0, 1.7):
        monitor = EnvelopeMonitor(model, margin=margin)
        assert not any(monitor.check(t).frozen.any() for t in transients), "what it was fitted to is never frozen"
    steps = [t.transitions() for t in transients]
    span = np.ptp(np.vstack([s.x for s in steps]), axis=0)
    wide = model.fit_summary["mean_width_recorded"] > 0.5 * span  # an envelope as wide as the range tells nothing
    said = " ".join(m for m in model.fit_summary["messages"] if "as wide as the state's own range" in m)
    assert [f"'{name}' (" in said for name in model.state_names] == wide.tolist()
    assert "--additive" not in said, "it has one"
    try:
        pure = fit(transients, criterion, additive="none")
    except FitError as error:
        assert infeasible and "--additive noise" in str(error)
    else:
        assert not infeasible and outside(pure, transients) == 0


@pytest.mark.parametrize("joint", [0, 4, 11])
def test_go2_fit_on_every_other_second_holds_on_the_others(recordings, signals_folder, joint, tmp_path):
    """Coverage beside width on samples that were not fitted, for every joint."""
    text = (signals_folder / "go2_joint.yaml").read_text().replace("[j0]", f"[j{joint}]")
    (tmp_path / "signals.yaml").write_text(text)
    (transient,) = read_transients(recordings / "go2/test_3.mcap", tmp_path / "signals.yaml")
    seconds = [transient.replace(slice(start, start + 500)) for start in range(0, 6500, 500)]
    model = fit(seconds[::2], additive="noise")
    verdicts = [EnvelopeMonitor(model).check(part) for part in seconds[1::2]]
    judged = sum(v.judged.sum() for v in verdicts)
    unseen = sum((v.violated & ~v.outside_domain).sum() for v in verdicts)
    assert judged > 2500
    assert unseen < 0.01 * judged  # inside the fitted domain; measured: 0.03 to 0.4 %
    assert (model.fit_summary["mean_width_recorded"] < 0.6 * np.ptp(transient.transitions().x, axis=0)).all()


def test_commands_from_bag_to_verdict(recordings, signals_folder, tmp_path, cli):
    model, bag = tmp_path / "go2.model.json", recordings / "go2/test_3.mcap"
    arguments = ["fit", str(bag), "--signals", str(signals_folder / "go2_joint.yaml"), "--output", str(model)]
    assert "--additive noise" in cli(*arguments, "--additive", "none", status=2).err and not model.exists()
    assert "0 outside" in cli(*arguments).out  # the signals file says noise
    cli("check", model, bag)
    data = cli.json("check", model, bag, "--margin", 0.5, status=1)
    (result,) = data["recordings"]
    assert result["alarm"] and len(result["verdict_per_sample"]) == result["samples"] == 10449
    flags = [s["flags"] for s in result["verdict_per_sample"] if s["status"] == "ok"]
    assert len(flags) == result["verdicts"] == 6541
    assert sum(f[1] for f in flags) == result["states"]["velocity"]["violations"] > 0
    # commands end at 13 s: held no longer than max_hold, they are no input, and nothing is judged after that
    last = max(s["t_ns"] for s in result["verdict_per_sample"] if s["status"] == "ok")
    assert (last - result["verdict_per_sample"][0]["t_ns"]) * 1e-9 == pytest.approx(13.1, abs=0.3)


def test_other_run_of_the_same_machine(recordings, signals_folder):
    """Hunter SE: a repeat stays inside, another throttle level is said to leave the fitted domain."""
    names = "odd_t_0_5_run_01", "odd_t_0_5_run_02", "even_t_0_2_run_01"
    runs = {name: recordings / f"hunter_se/straight_{name}.mcap" for name in names}
    model = fit(read_transients(runs["odd_t_0_5_run_01"], signals_folder / "hunter_se.yaml"), additive="disturbance")
    same = EnvelopeMonitor(model).check(read_as_fitted(runs["odd_t_0_5_run_02"], model.signals))
    assert same.violated.sum() < 0.005 * same.judged.sum()
    assert same.outside_domain.sum() < 0.01 * same.judged.sum()
    cruising = EnvelopeMonitor(model).check(read_as_fitted(runs["even_t_0_2_run_01"], model.signals))
    assert cruising.judged.sum() > 2000


def test_gas_turbine_recordings_differ_and_the_check_says_so(recordings, signals_folder, tmp_path):
    """ex_20 jumps by 90 W from sample to sample where ex_1 moves by 20 W: fitted on one, the other is outside."""
    folder = recordings / "micro_gas_turbine"
    signals = signals_folder / "micro_gas_turbine.yaml"
    alone = fit(read_transients(folder / "ex_1.mcap", signals), additive="noise")
    strange = EnvelopeMonitor(alone).check(read_as_fitted(folder / "ex_20.mcap", alone.signals))
    assert strange.violated.sum() > 0.9 * strange.judged.sum()
    both = fit(read_transients([folder / "ex_1.mcap", folder / "ex_20.mcap"], signals), additive="noise")
    both.save(tmp_path / "m.model.json")
    model = UncertainLTI.load(tmp_path / "m.model.json")
    ramps = EnvelopeMonitor(model).check(read_as_fitted(folder / "ex_24.mcap", both.signals))
    assert ramps.violated.sum() < 0.01 * ramps.judged.sum()


def test_rlc_circuit_with_known_truth(recordings):
    """The circuit is linear and the record noisy: the fit finds the true one-step matrices, with a narrow envelope."""
    from uncertain_lti import OperatingPoint, Transient

    path = recordings / "rlc/RLC_data_id_lin.csv"
    t = Transient.from_csv(path, time="time", states=["V_C", "I_L"], controls=["V_IN"])
    R, C, L, dt = 3.0, 270e-9, 50e-6, 5e-7
    model = fit(t, additive="noise", operating_point=OperatingPoint([0, 0], [0], [100.0, 10.0], [100.0]))
    continuous = np.array([[0.0, 0.1 / C], [-10 / L, -R / L]])
    forward = (expm(continuous * dt) - np.eye(2)) / dt  # what a one-step model of this step sees
    assert outside(model, [t]) == 0
    assert (np.abs(model.A - forward) <= model.dA + 0.03 * np.abs(forward)).all()
    assert (model.fit_summary["max_width"] < 0.05).all()
