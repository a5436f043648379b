# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Scheduled models: every command and report works with them, says what each regime rests on, and draws it."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_writer import Message, Topic, cdr, joint_state, write
from conftest import Command
from test_pages import needs_nothing_else
from test_schedule import GEAR, SPEED
from test_schedule import scheduled as by_hand

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI
from uncertain_lti.model.domain import Sampling
from uncertain_lti.model.interchange import block_facts
from uncertain_lti.model.schedule import Axis, BlockData, Schedule
from uncertain_lti.reports.check import check_regimes, unknown_in_words
from uncertain_lti.reports.findings import CARE, UNKNOWN
from uncertain_lti.sampling.clock import Status
from uncertain_lti.signals.signal_map import Signal, SignalMap

START = 10**18  # ns
STEP = 50_000_000  # ns
COUNT = 240
BESIDE = Axis("gear", modes=(1.0, 2.0))

CASES = {"knots": Schedule((SPEED,)), "modes": Schedule((GEAR,)), "two axes": Schedule((SPEED, BESIDE))}


def signal_map(schedule: Schedule) -> SignalMap:
    """Two states and a control on two topics, and the gear on a third."""
    further = [axis.signal for axis in schedule.axes if axis.signal == "gear"]
    kind = "sensor_msgs/msg/JointState"
    speed = Signal("speed", "/state", "position[speed]", 3.0, 2.0, "m/s", kind)
    states = speed, Signal("b", "/state", "position[b]", unit="K", type=kind)
    controls = (Signal("c", "/control", "position[c]", type=kind),)
    gear = tuple(Signal(name, "/gear", "data", type="std_msgs/msg/Float64") for name in further)
    time = {"/state": "header", "/control": "header"} | ({"/gear": "log"} if further else {})
    return SignalMap(states, controls, gear, clock="/state", max_gap=0.2, max_skew=0.2, time=time)


def model_of(case: str, **changes: Any) -> UncertainLTI:
    """The first block was never visited, the second has elements of its own, of the others one is tied to it."""
    schedule = CASES[case]
    model = by_hand(np.random.default_rng(len(case)), schedule, ("gear",) * (schedule.axes[-1].signal == "gear"))
    R = schedule.blocks
    signals, names = signal_map(schedule), ("A", "B", "c")
    small: dict[str, Any] = {name: 0.3 * getattr(model, name) for name in names}
    small["A"] = small["A"] - 1.5 * np.eye(2)
    facts = {
        "mean_width_recorded": [0.2, 0.1],
        "max_width_recorded": [0.3, 0.2],
        "blocks": [{"mean_width": [0.1 + r, 0.2], "max_width": [0.2 + r, 0.3]} if r else {} for r in range(R)],
    }
    data = [BlockData(100 * r, 1 if r in (0, R - 1) else None) for r in range(R)]
    known = {"signals": signals, "sampling": Sampling(0.05, 0.05, 0.05), "block_data": data, "fit_summary": facts}
    return model.replace(**small, **known, **changes)


def arrays(strange: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x, u and gear over all regimes; strange: a gear that no model lists, and a speed beyond the knots."""
    k = np.arange(COUNT)
    x = np.column_stack([3.0 + 1.9 * np.sin(k / 30.0), 0.2 * np.cos(k / 11.0)])
    gear = 1.0 + (k // 80) % 2
    if strange:
        gear[200:210] = 7.0
        x[220:, 0] += 10.0
    return x, 0.1 * np.sin(k / 7.0)[:, None], gear


def recording(path: Path, strange: bool = False) -> Path:
    x, u, gear = arrays(strange)
    messages = []
    for k, t in enumerate((START + STEP * np.arange(COUNT)).tolist()):
        messages.append(Message("/gear", t, cdr("std_msgs/msg/Float64", data=float(gear[k])), t))
        messages.append(Message("/control", t, joint_state(t, u[k], ["c"]), t))
        messages.append(Message("/state", t, joint_state(t, x[k], ["speed", "b"]), t + 1))
    types = {"/state": "sensor_msgs/msg/JointState", "/control": "sensor_msgs/msg/JointState"}
    topics = [Topic(name, kind) for name, kind in {**types, "/gear": "std_msgs/msg/Float64"}.items()]
    return Path(write(topics, messages).save(path))


@pytest.fixture(params=CASES)
def case(request: pytest.FixtureRequest) -> str:
    return str(request.param)


# --- commands ----------------------------------------------------------------------------------------------------


def test_info_shows_every_regime(case: str, tmp_path: Path, cli: Command) -> None:
    model = model_of(case)
    model.save(tmp_path / "m.json")
    text = cli("info", tmp_path / "m.json").out
    for r in range(len(model.blocks)):
        assert model.block_name(r) in text
    assert "0, not visited" in text and "time constants [s]" in text and "b: mean width" in text
    assert f"no recording visited 1 regime of {len(model.blocks)}" in text
    assert f"{model.block_name(len(model.blocks) - 1)} (as {model.block_name(1)})" in text
    for name in model.signals.signals:
        assert name.name in text
    data = cli.json("info", tmp_path / "m.json")
    regimes = data.pop("regimes")
    assert UncertainLTI.from_dict(data).to_dict() == model.to_dict()
    assert [r["regime"] for r in regimes] == [model.block_name(r) for r in range(len(model.blocks))]
    for r, block in enumerate(model.blocks):
        values = np.array([complex(*pair) for pair in regimes[r]["eigenvalues"]])
        np.testing.assert_allclose(values, block.eigenvalues())
        assert regimes[r]["transitions"] == 100 * r and regimes[r]["known"] == bool(r)
        assert math.isclose(-1.0 / regimes[r]["time_constants"][0], values[0].real)
    assert regimes[0]["mean_width"] is None and regimes[1]["mean_width"] == [2 * 1.1, 0.2]


def test_check_counts_by_regime(case: str, tmp_path: Path, cli: Command) -> None:
    model = model_of(case)
    model.save(tmp_path / "m.json")
    bag = recording(tmp_path / "strange.mcap", strange=True)
    text = cli("check", tmp_path / "m.json", bag, status=1).out
    (data,) = cli.json("check", tmp_path / "m.json", bag, status=1)["recordings"]
    here = data["regimes"]
    assert len(here) == len(model.blocks)
    assert sum(r["verdicts"] for r in here) == data["verdicts"] and sum(r["violated"] for r in here) == data["violated"]
    assert sum(r["unknown_regime"] for r in here) == data["unknown_regime"] > 0
    samples = data["verdict_per_sample"]
    for r, regime in enumerate(here):
        mine = [s for s in samples if s["regime"] == r]
        assert len(mine) == regime["verdicts"]
        assert sum(1 in s["flags"] for s in mine) == regime["violated"]
        assert sum(s["unknown_regime"] for s in mine) == regime["unknown_regime"]
        for i, name in enumerate(model.state_names):
            width = [s["upper"][i] - s["lower"][i] for s in mine]
            assert regime["states"][name]["violations"] == sum(s["flags"][i] == 1 for s in mine)
            if mine:
                assert math.isclose(regime["states"][name]["mean_width"], np.mean(width), rel_tol=1e-12)
        if mine:
            assert regime["regime"] in text
    words = " ".join(data["unknown"])
    assert words and all(word in text for word in data["unknown"])
    modes = sum(s["status"] == Status.MODE.value for s in samples)
    if case != "knots":
        assert modes == 10 and f"{modes} mode not in the model" in text and "10 samples with 7 have no verdict" in words
    if case != "modes":
        assert "speed is beyond its knots, 2 to 5 m/s, in" in words
    assert f"no recording visited {model.block_name(0)}" in words


def test_the_report_has_every_regime(case: str, tmp_path: Path, cli: Command) -> None:
    model = model_of(case)
    model.save(tmp_path / "m.json")
    bags = [recording(tmp_path / "run.mcap"), recording(tmp_path / "strange.mcap", strange=True)]
    out = tmp_path / "page.html"
    cli("report", tmp_path / "m.json", *bags, "--output", out, status=1)
    page = needs_nothing_else(out.read_text(encoding="utf-8"))
    text = "".join(page.text)
    for r in range(len(model.blocks)):
        assert model.block_name(r) in text
    assert "0, not visited" in text
    for signal in model.signals.scheduling:
        assert "scheduling" in text and signal.name in text
    facts = cli.json("report", tmp_path / "m.json", *bags, status=1)
    assert len(facts["model"]["regimes"]) == len(model.blocks)
    reasons = [r for r in facts["rely"]["reasons"] if r["about"] == "regimes"]
    assert any("no recording visited" in r["text"] for r in reasons)
    assert {r["weight"] for r in reasons} <= {CARE, UNKNOWN}


# --- facts -------------------------------------------------------------------------------------------------------


def test_a_regime_holds_the_block_with_the_largest_weight(case: str) -> None:
    model = model_of(case)
    rng = np.random.default_rng(0)
    z = np.vstack([rng.uniform(-1, 2, (3, 500)), rng.integers(1, 3, (model.q, 500))])
    dense = CASES[case].weights(z[list(model.scheduling_positions)])
    np.testing.assert_array_equal(model.main_block(z), dense.argmax(axis=0))
    z[list(model.scheduling_positions)] = math.nan
    assert (model.main_block(z) == -1).all()


def test_of_a_known_regime_there_is_nothing_to_say() -> None:
    model = model_of("knots").replace(block_data=[BlockData(50)] * 3)
    x, u, _ = arrays(strange=False)
    x[:, 0] = np.clip(x[:, 0], 2.0, 5.0)
    verdicts = EnvelopeMonitor(model).check(Transient(STEP * np.arange(COUNT), x, u, signals=model.signals))
    assert unknown_in_words(model, verdicts) == []
    assert sum(r["unknown_regime"] for r in check_regimes(model, verdicts)) == 0
    one = model.blocks[0]
    assert check_regimes(one, EnvelopeMonitor(one).check(verdicts.transient)) == [] == block_facts(one)


def test_what_the_file_says_of_its_blocks_may_be_anything() -> None:
    model = model_of("knots")
    for said in (None, 7, [3, "a"], [{"mean_width": "wide"}] * 3, [{"mean_width": [1.0]}] * 9, {"a": 1}):
        facts = block_facts(model.replace(fit_summary={"blocks": said}))
        assert [f["mean_width"] for f in facts] == [None] * 3
