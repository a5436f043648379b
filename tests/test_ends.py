# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""`fit` finds out at which end of a step the controls act, unless somebody said so or a controller answers there."""

from pathlib import Path

import numpy as np
import pytest

from uncertain_lti import EnvelopeMonitor, SignalMap, Transient, UncertainLTI, fit, tune
from uncertain_lti.proposal.public_fit import fit_many
from uncertain_lti.proposal.search import choose_ends

A, B = 0.8, 0.4
WAY = {"criterion": "lp", "additive": "noise"}


def plant(run: int, share: float, gain: float = 0.0, noise: float = 0.02) -> Transient:
    """A command that is set every eight samples, less a feedback of the reading, acts in the last `share` of the step
    before the sample at which it is recorded; with share 0, from there on."""
    rng = np.random.default_rng([run, 7])
    x, acting, target, readings, commands = 0.0, 0.0, 0.0, [], []
    for k in range(400):
        reading = x + noise * rng.normal()
        target = rng.normal() if k % 8 == 0 else target
        command = target - gain * reading
        readings.append([reading])
        commands.append([command if share == 0.0 else acting])
        x = A * x + B * ((1.0 - share) * acting + share * command if share else command) + noise * rng.normal()
        acting = command
    return Transient(np.arange(400.0), np.array(readings), np.array(commands), control_names=["u"])


@pytest.mark.parametrize(("share", "found"), [(0.0, "departure"), (0.5, "both"), (1.0, "arrival")])
@pytest.mark.parametrize("gain", [0.0, 0.5])
def test_the_end_at_which_a_command_acts_is_found(share: float, found: str, gain: float) -> None:
    runs = [plant(run, share, gain) for run in range(4)]
    at, why = choose_ends(runs, **WAY)
    assert at == found and bool(why) == (at != "departure")
    assert choose_ends(runs[:2], **WAY)[0] == found


def test_two_recordings_choose_an_end_only_where_it_is_far_better() -> None:
    runs = [plant(run, 1.0, noise=0.1) for run in range(4)]  # jumps of a half
    assert choose_ends(runs, **WAY)[0] == "arrival" and choose_ends(runs[:2], **WAY) == ("departure", "")


def test_a_controllers_answer_to_the_arrival_is_not_taken() -> None:
    """With it the bounds of a reading that is mostly noise would be narrower."""
    runs = [plant(run, 0.0, 1.5, 0.5) for run in range(4)]
    plain, both = (fit(some, alarm="containment") for some in (runs, [t.controls_at("both") for t in runs]))
    assert both.fit_summary["mean_width"][0] < 0.8 * plain.fit_summary["mean_width"][0]
    assert choose_ends(runs, **WAY) == ("departure", "")


def test_the_model_has_what_was_chosen_and_says_so(tmp_path: Path) -> None:
    runs = [plant(run, 1.0) for run in range(4)]
    model, plain = fit(runs), fit([plant(run, 1.0).controls_at("departure") for run in range(4)])
    assert [c.at for c in model.signals.controls] == ["arrival"]
    assert any(text.startswith("controls are taken at the arrival") for text in model.fit_summary["messages"])
    assert model.fit_summary["mean_width"][0] < 0.5 * plain.fit_summary["mean_width"][0]
    model.save(tmp_path / "a.model.json")
    loaded = UncertainLTI.load(tmp_path / "a.model.json")
    checked, again = (EnvelopeMonitor(m).check(plant(8, 1.0)) for m in (model, loaded))
    assert not checked.alarm.any() and (checked.alarm == again.alarm).all()
    assert [c.at for c in tune(runs).model.signals.controls] == ["arrival"]


def test_what_a_person_says_is_kept(tmp_path: Path) -> None:
    """In arrays and in a signals file, of which a fit of many recordings keeps it, too."""
    runs = [plant(run, 1.0) for run in range(4)]
    given = [Transient(t.t_ns, t.x, t.u, at="departure") for t in runs]
    for some in (given, [t.replace(slice(0, 390)) for t in given]):
        assert choose_ends(some, **WAY) == ("departure", "")
    text = "states: [{name: x, topic: /table, field: x}]\ncontrols: [{name: u, topic: /table, field: u%s}]\n"
    files = []
    for run, t in enumerate(runs):
        files.append(tmp_path / f"{run}.csv")
        rows = np.column_stack([t.t, t.x, t.u])
        np.savetxt(files[-1], rows, "%.15g", ",", header="time,x,u", comments="")
    for said, found in (("", "arrival"), (", at: departure", "departure"), (", at: both", "both")):
        (tmp_path / "signals.yaml").write_text(text % said)
        signals = SignalMap.load(tmp_path / "signals.yaml")
        assert signals.ends_given == bool(said)
        model = fit_many(files, signals, cache=tmp_path / f"cache{len(said)}")
        assert [c.at for c in model.signals.controls] == (["departure", "arrival"] if found == "both" else [found])
