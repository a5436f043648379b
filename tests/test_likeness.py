# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Which fault: patterns of labelled recordings are named again, unknown ones are not, and parts are pointed to."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Command
from test_event_log import Rig

import uncertain_lti
from uncertain_lti import EnvelopeMonitor, SignalMap, Transient, UncertainLTI
from uncertain_lti.base.errors import ModelError
from uncertain_lti.identification import fit
from uncertain_lti.model.signature import Signature, closeness
from uncertain_lti.monitor.likeness import MATCH, Explainer, Pattern, learn_signatures, likeness, over_recording
from uncertain_lti.monitor.session import OK
from uncertain_lti.reports.check import check_data, check_text
from uncertain_lti.reports.model_text import model_text, signature_text
from uncertain_lti.signals.signal_map import Signal

DT, ONSET = 0.02, 500
A = np.array([[-2.0, 1.0, 0.0], [0.0, -3.0, 2.0], [1.5, 0.0, -4.0]])
B = np.array([[1.0, 0.2], [0.0, 2.0], [0.5, -1.5]])
FAULTS = ("p stuck", "q stuck", "b bias", "c law")


def run(seed: int, fault: str = "", size: float = 1.0) -> Transient:
    """A linear machine under steps of two controls, with noise; a fault begins at ONSET."""
    rng = np.random.default_rng(seed)
    count = 1000
    u = np.repeat(rng.uniform(-1, 1, (count // 20 + 1, 2)), 20, axis=0)[:count]
    x = np.zeros((count, 3))
    for k in range(count - 1):
        acting, a = u[k].copy(), A
        if k >= ONSET and fault.endswith("stuck"):
            j = "pq".index(fault[0])
            acting[j] += size * (u[ONSET, j] - u[k, j])
        if k >= ONSET and fault == "c law":
            a = A.copy()
            a[2] *= 1 - 0.5 * size
        x[k + 1] = x[k] + DT * (a @ x[k] + B @ acting)
    x = x + rng.uniform(-1e-3, 1e-3, x.shape)
    if fault == "b bias":
        x[ONSET:, 1] += 0.1 * size
    names = {"state_names": ("a", "b", "c"), "control_names": ("p", "q"), "name": f"{fault} {seed}"}
    return Transient(DT * np.arange(count), x, u, **names)


@pytest.fixture(scope="module")
def model() -> UncertainLTI:
    return fit([run(seed) for seed in range(6)], additive="noise")


@pytest.fixture(scope="module")
def taught(model: UncertainLTI) -> UncertainLTI:
    monitor = EnvelopeMonitor(model)
    labelled = [(fault, monitor.check(run(100 + seed, fault))) for fault in FAULTS for seed in range(2)]
    learnt = learn_signatures(model, labelled)
    assert not learnt.alike and all(label == found for _, label, found in learnt.named)
    assert "left out in turn, 8 of 8 recordings named as labelled" in signature_text(learnt)
    return model.replace(signatures=learnt.signatures)


def test_a_frozen_state_has_no_signature() -> None:
    """It had one of zeros, of no verdict, which nothing looks like."""
    model, healthy = uncertain_lti.fit([run(seed) for seed in range(6)]), run(50)
    x = healthy.x.copy()
    x[ONSET:, 1] = x[ONSET, 1]
    verdicts = EnvelopeMonitor(model).check(healthy.replace(x=x))
    assert verdicts.alarm[ONSET + 100 :].all()
    with pytest.raises(ModelError, match="of its alarm [0-2] have every state, as a frozen one has none"):
        learn_signatures(model, [("stuck", verdicts)])


def explained(model: UncertainLTI, transient: Transient) -> list[dict[str, Any]]:
    return list(check_data(model, EnvelopeMonitor(model).check(transient))["explained"])


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("size", [0.5, 1.0, 2.0])
def test_a_known_fault_is_named(taught: UncertainLTI, fault: str, size: float) -> None:
    for seed in (200, 201, 202):
        found = max(explained(taught, run(seed, fault, size)), key=lambda like: like["verdicts"])
        assert found["label"] == fault and found["matches"][fault] >= MATCH and "points" not in found["text"]


def test_an_unknown_fault_stays_unknown(taught: UncertainLTI) -> None:
    for fault in FAULTS:
        others = taught.replace(signatures=[s for s in taught.signatures if s.label != fault])
        found = max(explained(others, run(200, fault)), key=lambda like: like["verdicts"])
        assert found["label"] is None and "looks like no known fault" in found["text"]


def test_recordings_of_one_label_that_are_not_alike_do_not_name_each_other(model: UncertainLTI) -> None:
    labelled = [("one", EnvelopeMonitor(model).check(run(100, fault))) for fault in FAULTS[:2]]
    assert [found for *_, found in learn_signatures(model, labelled).named] == ["", ""]


def test_faults_that_look_alike_are_both_named_and_neither_is_chosen(taught: UncertainLTI) -> None:
    (known,) = (s for s in taught.signatures if s.label == FAULTS[0])
    twins = taught.replace(signatures=[Signature(label, known.steps, known.moments) for label in ("one", "two")])
    found = max(explained(twins, run(200, FAULTS[0])), key=lambda like: like["verdicts"])
    assert found["label"] is None and "looks like two or one, too alike to tell (nearest two" in found["text"]
    assert "no known fault" not in found["text"]
    assert "signatures of faults: one, two" in model_text(UncertainLTI.from_dict(twins.to_dict()))


def test_no_alarm_has_no_name(taught: UncertainLTI) -> None:
    for seed in range(300, 304):
        data = check_data(taught, EnvelopeMonitor(taught, 2, 5).check(run(seed)))
        assert not data["alarm"] and not data["explained"]


@pytest.mark.parametrize(
    ("fault", "kind", "name"), [("p stuck", "actuator", "p"), ("q stuck", "actuator", "q"), ("b bias", "sensor", "b")]
)
def test_the_part_is_pointed_to_without_any_signature(model: UncertainLTI, fault: str, kind: str, name: str) -> None:
    for seed in (200, 201):
        found = max(explained(model, run(seed, fault)), key=lambda like: like["verdicts"])
        assert (kind, name) in {(part["kind"], part["name"]) for part in found["parts"]}
        assert found["label"] is None and not found["matches"]
        text = check_text(check_data(model, EnvelopeMonitor(model).check(run(seed, fault))))
        assert "points to" in text and f"{kind} {name}" in text


def test_a_pattern_starts_over_after_a_hundred_quiet_verdicts(model: UncertainLTI) -> None:
    explainer = Explainer(model)
    row, side = np.full((1 + len(model.horizons), model.n), 2.0), np.ones(model.n)
    verdicts = []
    for quiet in (0, 100, 101):
        explainer.push(row, -side, side, quiet)
        verdicts.append(explainer.pattern.verdicts)
    assert verdicts == [1, 2, 1]
    found = EnvelopeMonitor(model).check(run(200, FAULTS[0]))
    begins = [begin for begin, *_ in over_recording(model, found)]
    assert len(begins) > 1 and found.alarm[begins].all() and not found.alarm[np.subtract(begins, 1)].any()


def test_one_sample_is_not_all_of_a_pattern() -> None:
    pattern = Pattern((1,), 2)
    for row in ([1e6, 0.0], [0.0, -10.0]):  # the first counts as 10
        pattern.add(np.array([row]), np.ones(2))
    np.testing.assert_allclose(pattern.signature("some").moments, [np.eye(2) / np.sqrt(2)], rtol=1e-12)


def test_outside_the_fitted_domain_nothing_is_pointed_to(model: UncertainLTI) -> None:
    steps = (1, *(horizon.steps for horizon in model.horizons))
    table = np.tile(model.blocks[0].B[:, 0] * 100.0, (len(steps), 1))
    for outside in (False, True):
        pattern = Pattern(steps, model.n)
        for _ in range(5):
            pattern.add(table, np.ones(model.n), outside)
        assert bool(pattern.parts(model)) is not outside and pattern.verdicts == 5


def test_what_remembers_a_state_is_no_actuator() -> None:
    states = (Signal("a", "/s", "data[0]"), Signal("b", "/s", "data[1]"))
    controls = (Signal("u", "/c", "data"), Signal("a_before", "/s", "lag(data[0])"))
    B = [[0.0, 1.0], [1.0, 1.0]]
    zeros, signals = np.zeros((2, 2)), SignalMap(states, controls)
    model = UncertainLTI(np.eye(2), B, zeros, zeros, v=[1.0, 1.0], signals=signals)
    for column, named in ((0, True), (1, False)):
        pattern = Pattern((1,), 2)
        for _ in range(5):
            pattern.add(2.0 * np.array([B])[:, :, column], np.ones(2))
        assert any(part.kind == "actuator" for part in pattern.parts(model)) is named


def test_a_changed_law_points_to_its_row(model: UncertainLTI) -> None:
    found = max(explained(model, run(200, "c law")), key=lambda like: like["verdicts"])
    assert ("equation", "c") in {(part["kind"], part["name"]) for part in found["parts"]} and "c" in found["first"]


def test_live_says_what_check_says(taught: UncertainLTI) -> None:
    from steps import steps_of

    transient = run(200, "p stuck")
    monitor, explainer, quiet = EnvelopeMonitor(taught), Explainer(taught), 0
    for step in steps_of(transient):
        verdict = monitor.judge(step)
        if verdict.judged:
            quiet += 1
            if verdict.alarm:
                explainer.push(verdict.horizon_utilisation, verdict.lower, verdict.upper, quiet - 1)
                quiet = 0
    live, offline = explainer.likeness(), explained(taught, transient)[-1]
    assert live is not None
    assert (live.words, dict(live.matches)) == (offline["text"], offline["matches"])


def test_too_few_verdicts_name_nothing(taught: UncertainLTI) -> None:
    explainer = Explainer(taught)
    assert explainer.likeness() is None
    for _ in range(4):  # five are enough
        explainer.push(np.array([[3.0, 0.0, np.inf]]), -np.ones(3), np.ones(3), 0)
    like = explainer.likeness()
    assert like is not None and not like.label and not like.words


def test_the_session_says_so(taught: UncertainLTI) -> None:
    rig = Rig()
    assert rig.model.n == 2
    ones = np.zeros((1, 2, 2))
    ones[0, 1, 1] = 1.0
    rig.session.model = rig.model = rig.model.replace(signatures=[Signature("b broken", [1], ones)])
    rig.session.explainer = Explainer(rig.model)
    rig.send(20)
    rig.lines.clear()

    def jumps(count: int) -> None:
        for _ in range(count):
            rig.send(1)
            rig.x[1] += 3.0 * rig.model.centre_and_half(rig.x, rig.u, DT)[1][1]

    jumps(30)
    said = [line for line in rig.lines if "looks like" in line]
    assert len(said) == 1 and "the alarm looks like b broken (match " in said[0]
    monitor, *_ = rig.session.report(rig.now, 10.0)
    assert monitor.level != OK and "looks like b broken" in monitor.message
    before = rig.session.explainer.pattern.verdicts
    rig.send(60)  # not yet a hundred quiet verdicts
    jumps(10)
    assert rig.session.explainer.pattern.verdicts > before > 20


def test_other_bounds_have_no_signatures(taught: UncertainLTI) -> None:
    assert len(UncertainLTI.from_dict(taught.to_dict()).signatures) == 4
    assert taught.replace(v=2 * taught.v).signatures == (), "they are of the utilisation by these bounds"


def test_signatures_without_a_common_horizon_are_not_alike() -> None:
    ones = np.ones((1, 2, 2)) / 2
    assert closeness(Signature("a", [1], ones), Signature("b", [5], ones)) == 0.0
    assert closeness(Signature("a", [1], ones), Signature("b", [1], 3 * ones)) == pytest.approx(1.0)


def test_the_command(tmp_path: Path, cli: Command) -> None:
    bags = Path(__file__).resolve().parents[1] / "bags"
    model, taught = str(tmp_path / "m.model.json"), str(tmp_path / "s.model.json")
    noise = [str(p) for p in sorted(bags.glob("turbofan_*_noise.mcap"))]
    signals = str(bags.parent / "config" / "signals" / "turbofan.yaml")
    words = ["--signals", signals, "--output", model, "--criterion", "lp", "--additive", "noise"]
    cli("fit", *noise, *words)
    rule = ["--violations", "2", "--window", "5"]
    labelled = [f"{kind}={bags / f'turbofan_{kind}.mcap'}" for kind in ("fan_damage", "fuel_stuck", "nozzle_stuck")]
    assert "fan_damage" in cli("signature", model, *labelled, "--output", taught, *rule).out
    for text in labelled:
        label, _, bag = text.partition("=")
        assert f"looks like {label} (match " in cli("check", taught, bag, *rule, status=1).out
    said = cli("signature", taught, labelled[0], "--output", tmp_path / "t.model.json", *rule, status=2).err
    assert "another label" in said


@pytest.mark.parametrize(("own", "named"), [(0.0, ""), (-0.5, ""), (-2.0, "points to sensor x1 (100%)")])
def test_a_sensor_is_named_by_what_its_bias_leaves_in_its_own_equation_too(own: float, named: str) -> None:
    """Two states that move against each other are no sign of a third whose equation is as before."""
    model = UncertainLTI([[own, 0, 0], [5, -1, 0], [-5, 0, -1]], np.zeros((3, 0)), np.zeros((3, 3)), np.zeros((3, 0)))
    pattern, half = Pattern((1,), 3), np.array([4.0, 8.0, 16.0])
    for k in range(20):
        pattern.add((-1) ** k * np.array([[own, 5.0, -5.0]]) / half, half)
    assert likeness(model, pattern).words == named
