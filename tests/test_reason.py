# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Reasons in words: what holds the alarm and why there is no verdict, live as over a recording."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from steps import steps_of

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI
from uncertain_lti.identification import fit
from uncertain_lti.model.alarm_rule import AlarmRule, Rule, StatisticRule
from uncertain_lti.model.repeats import Repeats
from uncertain_lti.model.schedule import Axis, Schedule
from uncertain_lti.monitor.alarm import Arming, Raised
from uncertain_lti.monitor.reason import Reasons, over_recording
from uncertain_lti.reports.check import check_data, check_text
from uncertain_lti.sampling.clock import Status
from uncertain_lti.signals.signal_map import Signal, SignalMap

DT = 0.1
RULES: dict[str, tuple[Rule, ...]] = {
    "containment": (AlarmRule(2, 3),),
    "statistics": (AlarmRule(3, 3, 2.0), StatisticRule("energy", 3 * DT, 0.5), StatisticRule("mean", 5 * DT, 0.6)),
}


def model_with(rules: tuple[Rule, ...]) -> UncertainLTI:
    """Two states that keep their value, and a control that moves the first."""
    return UncertainLTI(
        A=np.zeros((2, 2)), B=[[1.0], [0.0]], dA=np.zeros((2, 2)), dB=np.zeros((2, 1)), v=[0.1, 0.1],
        alarm=rules, repeats=Repeats([0.0, 0.0], [0.0, 0.0], [0.0, 0.0]),
    )  # fmt: skip


def recording(seed: int, count: int = 300) -> Transient:
    """Noise with jumps, spells without a value, a state that stands still, and a pause."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(count, 1))
    x = np.zeros((count, 2))
    x[1:, 0] = np.cumsum(DT * u[:-1, 0])
    x += rng.uniform(-0.08, 0.08, x.shape)
    x[rng.random(count) < 0.05, 1] += 0.5
    x[40:60, 1] += np.linspace(0.0, 4.0, 20)
    x[100:104, 0], u[130, 0] = np.nan, np.nan
    x[150:170, 0], u[150:170] = x[150, 0], 3.0
    t = np.arange(count) * round(DT * 1e9)
    t[200:] += 10**10
    return Transient(t, x, u, max_gap=1.0)


def live(monitor: EnvelopeMonitor, transient: Transient) -> list[str]:
    reasons = Reasons(monitor.model, monitor.alarms.rules)
    return [reasons.take(monitor.judge(step), monitor.alarm) for step in steps_of(transient)]


def same_words(monitor: EnvelopeMonitor, transient: Transient) -> list[tuple[int, str]]:
    """Each change of the words over a recording, which are those that are said live."""
    changes = list(over_recording(monitor.check(transient), monitor.model))
    words = live(monitor, transient)
    assert changes == [(k, text) for k, text in enumerate(words) if k == 0 or text != words[k - 1]]
    return changes


@pytest.mark.parametrize("rules", RULES.values(), ids=list(RULES))
@pytest.mark.parametrize("seed", range(4))
def test_live_and_over_a_recording_the_words_are_the_same(rules: tuple[Rule, ...], seed: int) -> None:
    every = "\n".join(text for _, text in same_words(EnvelopeMonitor(model_with(rules)), recording(seed)))
    assert "alarm: frozen: x1" in every and "; no verdict on x1" in every
    assert "no verdict: x1 missing, stale, not valid or not finite" in every
    assert "no verdict: u1 missing, stale, not valid or not finite" in every
    assert "no verdict: the step is longer than max_gap" in every and "no alarm" in every
    assert f"alarm: {rules[0].words}: " in every or f"alarm: {rules[-1].words}: x2" in every


def test_while_no_alarm_could_be_raised_the_words_say_so() -> None:
    """Live and over a recording, within the grace."""
    monitor, transient = EnvelopeMonitor(model_with(RULES["containment"])), recording(0)
    armed = Arming(None, 2 * 10**9).over(transient.t_ns)
    changes = dict(over_recording(monitor.check(transient, armed), monitor.model))
    reasons = Reasons(monitor.model, monitor.alarms.rules)
    steps = zip(steps_of(transient), armed.counts.tolist(), strict=True)
    words = [reasons.take(monitor.judge(step, counts), monitor.alarm) for step, counts in steps]
    assert changes == {k: text for k, text in enumerate(words) if k == 0 or text != words[k - 1]}
    said = {off: {text for text, on in zip(words, armed.counts, strict=True) if on != off} for off in (True, False)}
    assert "alarms are off" in said[True] - said[False] and "no alarm" in said[False] - said[True]


def test_a_mode_that_is_not_listed_is_named_live_and_over_a_recording() -> None:
    gear = Schedule((Axis("gear", modes=(1.0, 2.0)),))
    named = ["x1", "x2"], ["u1"], ["gear"]
    states, controls, further = (tuple(Signal(n, f"/{n}", "data") for n in names) for names in named)
    plain = model_with(RULES["containment"])
    model = UncertainLTI(
        **{name: np.stack([getattr(plain, name)] * 2) for name in ("A", "B", "dA", "dB", "v")},
        signals=SignalMap(states, controls, further), schedule=gear, alarm=RULES["containment"],
    )  # fmt: skip
    s = np.repeat([1.0, 4.0, 5.0, 2.0, 4.0, 1.0], 50)[:, None]
    changes = same_words(EnvelopeMonitor(model), recording(0).replace(s=s, signals=model.signals))
    said = [text.split("no verdict: ")[-1] for _, text in changes]
    assert said.count("gear = 4 is not among the modes of the model, 1, 2") >= 2
    assert said.count("gear = 5 is not among the modes of the model, 1, 2") >= 1
    assert model.why_unlisted([0.0, 0.0, 0.0, 2.0]) == ""


def test_the_states_blamed_stay_named_while_the_same_rules_hold_the_alarm() -> None:
    reasons = Reasons(model_with(RULES["statistics"]), RULES["statistics"])
    energy = "mean square of the utilisation over 0.3 s above 0.5"

    def push(alarm: bool, status: Status, *raised: Raised, unknown: bool = False) -> str:
        verdict: Any = SimpleNamespace(
            status=status, armed=True, unknown_regime=unknown, raised=raised, frozen=(), withheld=(), before=[0.0] * 3,
            numbers=lambda _: [0.0] * 2,
        )  # fmt: skip
        return reasons.take(verdict, alarm)

    second = Raised("energy", "energy", 1, "x2", 2.0)
    assert push(True, Status.OK, second) == f"alarm: {energy}: x2"
    for value in (3.0, 4.0):
        assert push(True, Status.OK, Raised("energy", "energy", 1, "x1", value)) == f"alarm: {energy}: x2, x1"
    both = f"alarm: at least 3 of 3 verdicts violated; {energy}: x2"
    assert push(True, Status.OK, Raised("containment", "containment", 1, "", 1.0), second) == both
    assert push(True, Status.GAP) == f"{both}; no verdict: the step is longer than max_gap"
    latched = push(True, Status.OK)
    assert latched.startswith("alarm: latched until ~/reset, raised by at least 3 of 3 verdicts violated")
    assert push(True, Status.OK) == latched
    assert push(False, Status.OK, unknown=True) == "no alarm; a regime that was not fitted"


def test_a_jump_larger_than_any_of_the_fit_is_named_with_its_limit() -> None:
    """Live, over a recording, and in `check`; not one that stays within what was recorded."""
    rng = np.random.default_rng(5)
    u = rng.uniform(-1.0, 1.0, (400, 1))
    x = np.zeros((400, 1))
    for k in range(399):
        x[k + 1] = 0.9 * x[k] + 0.1 * u[k]
    model = fit([Transient(0.1 * np.arange(400), x, u)], additive="noise")
    largest = float(np.abs(np.diff(x[:, 0])).max())
    assert model.domain.step_max == pytest.approx([largest])
    assert UncertainLTI.from_dict(model.to_dict()).domain.step_max == pytest.approx([largest])
    spiked = x[:100].copy()
    spiked[60] += 2.0
    transient = Transient(round(1e8) * np.arange(100), spiked, u[:100])
    monitor = EnvelopeMonitor(model)
    verdicts, said = monitor.check(transient), same_words(monitor, transient)
    jumped = f"x1 jumped by {spiked[60, 0] - spiked[59, 0]:.3g} in one step (at most {largest:.3g} in the fit)"
    assert dict(said)[60] == f"alarm: at least 1 of 1 verdicts violated: x1; {jumped}"
    data = check_data(model, verdicts, samples=False)
    assert data["states"]["x1"]["jump"]["largest_in_fit"] == pytest.approx(largest)
    assert " jumped by " in check_text(data) and f"(at most {largest:.3g} in the fit) at 6.0000 s" in check_text(data)
    for quiet in (Transient(round(1e8) * np.arange(100), x[:100], u[:100]), transient.replace(slice(0, 60))):
        assert check_data(model, EnvelopeMonitor(model).check(quiet), samples=False)["states"]["x1"]["jump"] is None
    drifting = model.replace(domain=replace(model.domain, step_max=None))
    assert "jumped" not in check_text(check_data(drifting, EnvelopeMonitor(drifting).check(transient), samples=False))


@pytest.mark.parametrize(
    ("steps", "change", "remedy"),
    [
        (1, {}, "a verdict needs two samples: check a longer recording"),
        (50, {"u": np.full((50, 1), np.nan)}, "record it, or fit without it; of topics"),
        (50, {"max_gap": 0.01}, "is a topic slower than in the fit"),
        (50, {"t": round(3e9) * np.arange(50)}, "is its time in another unit? check one at the rate of the fit"),
    ],
)
def test_where_no_verdict_was_possible_the_reason_comes_with_a_remedy(steps, change, remedy):
    rng = np.random.default_rng(6)
    t, x, u = round(1e8) * np.arange(400), np.cumsum(rng.normal(size=(400, 1)), axis=0), rng.normal(size=(400, 1))
    model = fit([Transient(t, x, u)], additive="noise")
    given = {"t": t[:steps], "x": x[:steps], "u": u[:steps]} | change
    verdicts = EnvelopeMonitor(model).check(Transient(**given))
    if remedy.endswith("rate of the fit"):
        assert [text for _, text in over_recording(verdicts, model)][1].endswith("was fitted to (0.1 to 0.1 s)")
    data = check_data(model, verdicts, samples=False)
    assert data["outcome"] == "unknown" and data["reason"].startswith("no verdict was possible, so nothing is known; ")
    assert remedy in data["reason"]
    numbers = "fitted to (0.1 to 0.1 s), and most here take 3 s; "
    assert (numbers in data["reason"]) == remedy.endswith("rate of the fit")
