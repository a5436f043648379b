# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Injected faults do to recordings what they say, and the smallest detectable one is seen as often as it says."""

import json

import numpy as np
import pytest
from coil import coil_runs
from engine_bag import SIGNALS, engine_bag
from refusals import refuses
from tanks import Tanks

from uncertain_lti import Transient, UncertainLTI
from uncertain_lti.base.errors import FitError
from uncertain_lti.base.text import text_of
from uncertain_lti.identification import fit
from uncertain_lti.model.alarm_rule import AlarmRule
from uncertain_lti.plants.leibov import leibov2006, transient
from uncertain_lti.reports.model_text import detectable_blocks, detectable_data
from uncertain_lti.signals.signal_map import Signal, SignalMap
from uncertain_lti.validation import detectable as module
from uncertain_lti.validation.detectable import FEWEST, KINDS, Windows, detectable, faulty, typical_within
from uncertain_lti.validation.intervals import quantile_share_interval, share_interval
from uncertain_lti.validation.left_out import validate

ONSET = 40


def simulated(act=lambda u: u, row=None):
    """The published nominal engine; act(u): what the actuators do; row(k, rate, x, u): another right-hand side."""
    model, u = leibov2006(), transient(120, 3).u
    done = act(u.copy())
    x = np.zeros((120, 5))
    x[0] = 0.1
    for k in range(119):
        rate = model.A @ x[k] + model.B @ done[k]
        x[k + 1] = x[k] + 0.025 * (rate if row is None or k < ONSET else row(rate, model.B @ done[k]))
    names = {"state_names": model.state_names, "control_names": model.control_names}
    return Transient(0.025 * np.arange(120), x, u, max_gap=0.1, **names)


@pytest.fixture(scope="module")
def run():
    """A run of the nominal engine, which its own nominal model describes to the bit."""
    return simulated()


def inject(run, kind, signal, size, at, model=None):
    """A whole recording as it would have been with a fault from `at`, s, on."""
    i = [*run.control_names, *run.state_names].index(signal)
    i -= 0 if KINDS[kind].of == "actuator" else len(run.control_names)
    windows = Windows(run.t[None], run.x[None], run.u[None], run.s[None], int(np.searchsorted(run.t, at - 1e-12)))
    noise = np.random.default_rng(0).standard_normal((1, len(run)))
    x, u = faulty(windows, kind, i, np.array([size]), noise, model or leibov2006())
    return run.replace(x=x[0], u=u[0])


def of(run, kind, signal, size, model=None):
    return inject(run, kind, signal, size, ONSET * 0.025, model)


def test_sensor_faults_change_the_readings_of_one_sensor_from_the_onset_on(run):
    since = run.t - run.t[ONSET]
    after = since >= 0
    i, name = 2, run.state_names[2]
    x = run.x[:, i]
    late = np.concatenate([x[:4], x[:-4]])
    noise = np.random.default_rng(0).standard_normal((1, 120))[0]
    expected = {
        ("bias", -0.5): x - 0.5 * after,
        ("drift", 2.0): x + 2.0 * np.maximum(since, 0),
        ("scale", 0.1): x * (1 + 0.1 * after),
        ("noise", 0.3): x + 0.3 * noise * after,
        ("freeze", 0.26): np.where(after & (since < 0.26), x[ONSET - 1], x),
        ("dropout", 0.26): np.where(after & (since < 0.26), 0.0, x),
        ("spike", 0.7): x + 0.7 * (np.arange(120) == ONSET),
        ("sensor_delay", 0.1): np.where(after, late, x),
    }
    assert {kind for kind, _ in expected} == {name for name, kind in KINDS.items() if kind.of == "sensor"}
    for (kind, size), values in expected.items():
        faulty = of(run, kind, name, size)
        assert faulty.x[:, i] == pytest.approx(values, abs=1e-12), kind
        assert np.array_equal(np.delete(faulty.x, i, axis=1), np.delete(run.x, i, axis=1))
        assert np.array_equal(faulty.u, run.u) and np.array_equal(faulty.t_ns, run.t_ns)


@pytest.mark.parametrize("kind", [name for name, kind in KINDS.items() if kind.of != "sensor"])
def test_responses_are_exact_for_a_linear_plant(run, kind):
    """The plant simulated with the true fault, and the healthy run with the fault injected, are the same."""
    model, j, i = leibov2006(), 0, 3
    steps = {"offset": 0.1, "loss": 0.4, "stuck": 0.5, "actuator_delay": 0.1, "time_constant": 0.5, "gain": -0.3}
    size = steps[kind]

    def act(u):
        if kind == "offset":
            u[ONSET:, j] += size
        elif kind == "loss":
            u[ONSET:, j] *= 1 - size
        elif kind == "stuck":
            u[ONSET : ONSET + 20, j] = u[ONSET - 1, j]
        elif kind == "actuator_delay":
            u[ONSET:, j] = u[ONSET - 4 : -4, j]
        return u

    def row(rate, of_controls):
        rate = rate.copy()
        if kind == "time_constant":
            rate[i] /= 1 + size
        elif kind == "gain":
            rate[i] += size * of_controls[i]
        return rate

    truth = simulated(act, row)
    name = run.control_names[j] if KINDS[kind].of == "actuator" else run.state_names[i]
    faulty = of(run, kind, name, size, model)
    assert np.abs(truth.x - run.x).max() > 1e-3
    assert faulty.x == pytest.approx(truth.x, abs=1e-12)
    assert np.array_equal(faulty.x[: ONSET + 1], run.x[: ONSET + 1]) and np.array_equal(faulty.u, run.u)


def coil_error(volts, knots, size, act):
    """Error of the approximation over ten steps after the onset, relative to what the true fault changes."""
    healthy = coil_runs(range(4), samples=201, volts=volts)
    model = fit(healthy, additive="noise", schedule={"I_L": knots} if knots > 1 else None)
    wrong, moved = [], []
    for before, truth in zip(healthy, coil_runs(range(4), samples=201, volts=volts, act=act), strict=True):
        faulty = inject(before, "offset", "V_IN", size, 100 * 500e-9, model)
        wrong.append(faulty.x[100:110] - truth.x[100:110])
        moved.append(truth.x[100:110] - before.x[100:110])
    return np.sqrt(np.mean(np.square(wrong), axis=(0, 1)) / np.mean(np.square(moved), axis=(0, 1)))


def test_the_response_is_as_far_off_as_the_model():
    """Small currents leave the plant linear; else one model misses the response, and a schedule takes half of that."""
    k = np.arange(201)[:, None]
    assert (coil_error(5.0, 1, 0.5, lambda u: u + 0.5 * (k >= 100)) < 0.01).all()
    errors = [coil_error(40.0, knots, 5.0, lambda u: u + 5.0 * (k >= 100)) for knots in (1, 5)]
    assert (errors[0] > 0.7).all() and (errors[1] < 0.7).all() and (errors[1] < 0.7 * errors[0]).all()


def test_the_response_goes_on_over_missing_samples_which_stay_missing():
    x = np.zeros((60, 1))
    x[30] = np.nan
    run = Transient(0.1 * np.arange(60.0), x, np.ones((60, 1)), max_gap=0.2)
    model = UncertainLTI([[-1.0]], [[1.0]], [[0.1]], [[0.1]])
    faulty = inject(run, "offset", "u1", 1.0, 1.0, model)
    assert np.isnan(faulty.x[30, 0]) and np.isfinite(np.delete(faulty.x[:, 0], 30)).all()
    assert 0 < faulty.x[44, 0] < 1


def test_a_memory_of_a_state_follows_the_fault():
    """lag(x), diff(x) and rate(x) among the controls are those of the faulty readings, and of the response."""
    topic = {"topic": "/m", "type": "std_msgs/msg/Float64MultiArray"}
    fields = {"x": "data[0]", "was": "lag(data[0], 2)", "step": "diff(data[0])", "rate": "rate(data[0])"}
    fields["u"] = "data[1]"
    of = {name: Signal(name, field=field, scale=2.0, **topic) for name, field in fields.items()}
    signals = SignalMap((of["x"],), (of["u"], of["was"], of["step"], of["rate"]), clock="/m", max_gap=1.0)
    model = UncertainLTI([[-1.0]], [[1.0, 0.3, -0.2, 0.1]], [[0.1]], [[0.1] * 4], signals=signals)

    def recalled(t, x, k):
        past, before = (x[k - back] if k >= back else np.nan for back in (2, 1))
        return past, x[k] - before, (x[k] - before) / (t[k] - t[k - 1]) if k else np.nan

    def plant(off):
        t, x, u = 0.1 * np.arange(40.0), np.zeros(40), np.zeros((40, 4))
        u[:, 0] = 0.5
        for k in range(39):
            u[k, 1:] = np.nan_to_num(recalled(t, x, k))
            done = np.concatenate([[u[k, 0] + off * (k >= 10)], u[k, 1:]]) / 2.0
            x[k + 1] = x[k] + 0.1 * 2.0 * (-x[k] / 2.0 + model.B[0] @ done)
        u[39, 1:] = recalled(t, x, 39)
        return Transient(t, x, u, signals=signals, max_gap=1.0)

    healthy, truth = plant(0.0), plant(0.2)
    faulty = inject(healthy, "offset", "u", 0.2, 1.0, model)
    assert faulty.x == pytest.approx(truth.x, abs=1e-12) and faulty.u == pytest.approx(truth.u, abs=1e-12)
    assert np.abs(truth.x - healthy.x).max() > 0.05
    biased = inject(healthy, "bias", "x", 0.7, 1.0, model)
    expected = [recalled(biased.t, biased.x[:, 0], k) for k in range(12, 40)]
    assert biased.u[12:, 1:] == pytest.approx(np.array(expected), abs=1e-12)
    assert np.array_equal(biased.u[:10], healthy.u[:10])


def test_a_failed_actuator_has_failed_in_what_is_remembered_of_it():
    topic = {"topic": "/m", "type": "std_msgs/msg/Float64MultiArray"}
    fields = {"x": "data[0]", "u": "data[1]", "was": "lag(data[1], 2)"}
    x, *u = (Signal(name, field=field, scale=2.0, **topic) for name, field in fields.items())
    signals = SignalMap((x,), tuple(u), clock="/m", max_gap=1.0)
    model = UncertainLTI([[-1.0]], [[1.0, 0.5]], [[0.1]], [[0.1] * 2], signals=signals)

    def plant(off):
        t, x, u = 0.1 * np.arange(40.0), np.zeros(40), np.zeros((40, 2))
        u[:, 0] = np.sin(t)
        u[2:, 1] = u[:-2, 0]
        for k in range(39):
            done = (u[k] + off * np.array([k >= 10, k >= 12])) / 2.0
            x[k + 1] = x[k] + 0.1 * 2.0 * (-x[k] / 2.0 + model.B[0] @ done)
        return Transient(t, x, u, signals=signals, max_gap=1.0)

    healthy, truth = plant(0.0), plant(0.2)
    faulty = inject(healthy, "offset", "u", 0.2, 1.0, model)
    assert faulty.x == pytest.approx(truth.x, abs=1e-12) and np.array_equal(faulty.u, healthy.u)


# --- the smallest detectable fault ---


@pytest.fixture(scope="module")
def validation():
    return validate(Tanks().transients(10, seed=3, noise=1e-3), additive="noise", alarm_rule=AlarmRule(2, 3))


@pytest.fixture(scope="module")
def found(validation):
    return detectable(validation.model, validation.parts)


def test_progress_is_told_within_a_round(validation, found, monkeypatch):
    monkeypatch.setattr(module, "TOLD", 5)
    told = []
    assert repr(detectable(validation.model, validation.parts, progress=told.append)) == repr(found)
    assert len(told) > 2 * (module.ROUNDS + 2)
    numbers = [step.number for step in told]
    assert numbers == sorted(numbers) and numbers[-1] <= told[-1].total


def by_name(found):
    return {(fault.kind, fault.signal): fault for fault in found.faults}


def test_the_share_seen_is_that_of_faults_injected_one_by_one(validation, found):
    """Through another way: whole recordings with the fault, checked one by one, at the size that is reported."""
    every = module._cases(validation.model, validation.parts, found.within, module.CASES, 0)
    for kind, signal in (("bias", "x2"), ("drift", "x1"), ("offset", "u1"), ("freeze", "x3")):
        fault = by_name(found)[kind, signal]
        assert fault.size > 0 and fault.share >= 0.9 - 1e-9
        signs = np.ones(found.cases)
        if KINDS[kind].both:
            signs[np.random.default_rng([0, 1]).permutation(found.cases)[: found.cases // 2]] = -1.0
        seen = []
        for x, owner in zip(every.x, every.owner, strict=True):
            monitor = every.monitors[owner]
            run = validation.parts[owner].transient
            k = int(np.flatnonzero((run.x == x[every.onset]).all(axis=1))[0])  # the onset in its recording
            at = float(run.t[k])
            part = slice(max(k - every.onset, 0), int(np.searchsorted(run.t, at + found.within + 1e-9)))
            if monitor.check(run.replace(part)).alarm[k - part.start :].any():
                continue  # an alarm anyway
            size = float(fault.size * signs[len(seen)])
            faulty = inject(run, kind, signal, size, at, validation.model)
            seen.append(monitor.check(faulty.replace(part)).alarm[k - part.start :].any())
        assert len(seen) == found.cases
        assert np.mean(seen) == pytest.approx(fault.share, abs=1.5 / found.cases), (kind, signal)


def test_sizes_have_the_order_that_they_must_have(validation, found):
    assert json.loads(json.dumps(found.to_dict(), allow_nan=False)) == found.to_dict()
    kinds = ("bias", "drift", "offset")
    strict = detectable(validation.model.replace(alarm_rule=AlarmRule(1, 1)), validation.parts, kinds=kinds)
    wide = detectable(validation.model.replace(alarm_rule=AlarmRule(1, 1, 3.0)), validation.parts, kinds=kinds)
    wider = by_name(wide)
    for fault in strict.faults:
        assert fault.size < wider[fault.kind, fault.signal].size
        assert fault.size_interval[0] <= fault.size <= fault.size_interval[1]
        assert fault.share_interval[0] <= fault.share <= fault.share_interval[1]
    long = detectable(validation.model, validation.parts, 2.4, kinds=("drift",))
    short = detectable(validation.model, validation.parts, 0.8, kinds=("drift",))
    assert all(a.size < b.size for a, b in zip(long.faults, short.faults, strict=True))
    blind = detectable(validation.model.replace(alarm_rule=AlarmRule(1, 1, 1e6)), validation.parts, kinds=("loss",))
    assert all(f.size == np.inf and f.share_interval[0] <= f.share <= f.share_interval[1] for f in blind.faults)
    # two violations of three: the jump of a reading is one violation, a spike two
    assert all(by_name(found)["spike", s].size < np.inf for s in ("x1", "x2", "x3"))


def test_an_earlier_value_of_a_state_is_no_actuator():
    topic = {"topic": "/m", "type": "std_msgs/msg/Float64MultiArray"}
    of = [Signal(n, field=f, **topic) for n, f in (("x", "data[0]"), ("u", "data[1]"), ("was", "lag(data[0], 1)"))]
    signals, runs = SignalMap((of[0],), (of[1], of[2]), clock="/m", max_gap=1.0), []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        x, u = np.zeros(400), np.repeat(rng.normal(size=40), 10)
        for k in range(399):
            x[k + 1] = 0.8 * x[k] + 0.2 * u[k] + 0.01 * rng.normal()
        runs.append(Transient(0.1 * np.arange(399.0), x[1:, None], np.column_stack([u[1:], x[:-1]]), signals=signals))
    result = validate(runs, additive="noise", alarm_rule=AlarmRule(2, 3))
    assert [s.signal for s in detectable(result.model, result.parts, kinds=("loss",)).faults] == ["u"]


def test_what_cannot_be_known_is_refused_in_words(validation):
    too_long = detectable(validation.model, validation.parts, 100.0)
    assert "lasts 100 s without a gap" in too_long.refused and not too_long.faults
    refuses(FitError, "positive number of seconds", detectable, validation.model, validation.parts, -1.0)
    refuses(FitError, "there is no fault 'rust'", detectable, validation.model, validation.parts, kinds=("rust",))
    unstable = validation.model.replace(A=validation.model.A + 50.0 * np.eye(3))
    seen = detectable(unstable, validation.parts, kinds=("offset", "gain"))
    assert all("runs away" in fault.refused for fault in seen.faults)
    text = text_of(detectable_blocks(detectable_data({"detectable": seen.to_dict()})))
    assert "runs away" in text and "unknown" in text
    assert typical_within(validation.parts) == pytest.approx(2.0) and FEWEST > 1


def test_the_interval_of_a_share_counts_clusters():
    hits = np.arange(60) < 54
    alone = quantile_share_interval(np.arange(60), hits, 0.9)
    exact = share_interval(54, 60, 0.9)
    assert alone[0] == 0.9 and alone[1] == pytest.approx(exact, abs=0.01)
    together = quantile_share_interval(np.arange(60) // 6, hits, 0.9)  # one recording misses all of its six
    assert together[1][0] < alone[1][0] - 0.05 and together[1][1] > alone[1][1]
    assert quantile_share_interval(np.zeros(60), hits, 0.9)[1] == (0.0, 1.0)
    # their totals vary 36 / 5.4 times as much as of independent cases; those of units of nine hits each not at all
    for units, worth, count in ((np.arange(60) // 6, 9.0, 10), (np.arange(60) % 6, 60.0, 6)):
        from scipy import stats

        tail, yes, no = stats.norm.cdf(stats.t.ppf(0.05, count - 1)), 0.9 * worth, 0.1 * worth
        limits = stats.beta.ppf(tail, yes, no + 1), stats.beta.isf(tail, yes + 1, no)
        assert quantile_share_interval(units, hits, 0.9)[1] == pytest.approx(limits, rel=1e-9)
    held = 0
    rng = np.random.default_rng(1)
    for _ in range(200):
        of_recording = rng.beta(9.0, 1.0, 12)
        cases = rng.random((12, 5)) < of_recording[:, None]
        _, (low, high) = quantile_share_interval(np.repeat(np.arange(12), 5), cases.ravel(), 0.9)
        held += low <= 0.9 <= high
    assert held >= 0.87 * 200


# --- where it is said ---


def test_validate_info_and_report_say_which_faults_are_seen(tmp_path, cli):
    (tmp_path / "signals.yaml").write_text(SIGNALS)
    engine_bag(tmp_path / "run.mcap", steps=400)
    name = str(tmp_path / "m.model.json")
    words = ["--signals", str(tmp_path / "signals.yaml"), "--additive", "noise", "--output", name]
    cli("fit", tmp_path / "run.mcap", *words)
    page = tmp_path / "page.html"
    report = ["report", name, tmp_path / "run.mcap", "--output", page, "-q"]
    cli(*report)
    text = page.read_text()
    assert f"`uncertain-lti validate {name} --output {name}` finds it out" in text
    assert f"<li>{UncertainLTI.load(name).fit_summary['alarm']['promises'][1]}</li>" in text
    said = cli("validate", name, "--within", "0.5", "--output", name).out
    assert "smallest fault seen in 90% of the cases within 0.5 s" in said and "off by" in said
    data = UncertainLTI.load(name).validation["detectable"]
    fan = next(f for f in data["faults"] if (f["kind"], f["signal"]) == ("bias", "fan"))
    assert fan["size"] > 0 and f"{fan['size']:.3g}" in said
    assert f"fan: off by {fan['size']:.3g}" in cli("info", name).out
    cli(*report)
    assert "Which faults would it see?" in page.read_text() and f"off by {fan['size']:.3g}" in page.read_text()
    assert detectable_data({}) is None and detectable_data({"detectable": {"faults": [{"kind": "bias"}]}}) is None
