# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Templates: one entry for many alike, and a structure in which each depends on its own."""

from typing import Any

import numpy as np
import pytest

from uncertain_lti import SignalMap, Transient
from uncertain_lti.base.errors import SignalError
from uncertain_lti.identification import fit
from uncertain_lti.proposal.tune import Remembered, with_memories
from uncertain_lti.signals.field_path import Memory
from uncertain_lti.signals.signal import members_of


@pytest.mark.parametrize(
    ("value", "members"),
    [
        (["j0", "...", "j3"], ["j0", "j1", "j2", "j3"]),
        (["m08", "...", "m11"], ["m08", "m09", "m10", "m11"]),
        ([1, "...", 3, "spare"], ["1", "2", "3", "spare"]),
        (["left", "right"], ["left", "right"]),
        (["a1", "...", "a2"], ["a1", "a2"]),
    ],
)
def test_members_are_listed_or_counted(value: list[Any], members: list[str]) -> None:
    assert members_of(value, "here") == members


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ("j0", "write a list, such as"),
        ([], "write a list, such as"),
        ([1.5], "write names or whole numbers"),
        (["...", "j3"], "stands between two that are counted"),
        (["j0", "..."], "stands between two that are counted"),
        (["j0", "...", "k3"], "stands between two that are counted"),
        (["j5", "...", "j3"], "stands between two that are counted"),
        (["j0", "...", "j3000"], "over 1000 members"),
        (["j0", "j0"], "listed twice"),
    ],
)
def test_wrong_members_are_refused(value: Any, words: str) -> None:
    with pytest.raises(SignalError, match=f"^here.*{words}"):
        members_of(value, "here")


def joints(count: int, **more: Any) -> dict[str, Any]:
    members = ["j0", "...", f"j{count - 1}"]
    return {
        "states": [
            {"for": members, "name": "{}", "topic": "/s", "field": "position[{}]", "valid": [-4, 4]},
            {"for": members, "name": "{}_rate", "topic": "/s", "field": "rate(position[{}])"},
            {"name": "tilt", "topic": "/s", "field": "effort[0]"},
        ],
        "controls": [{"for": members, "name": "{}_u", "topic": "/u", "field": "position[{}]", "max_hold": 0.1}],
        **more,
    }


def test_an_entry_for_many_is_as_many_entries() -> None:
    signals = SignalMap.from_dict(joints(3))
    assert [s.name for s in signals.states] == ["j0", "j1", "j2", "tilt"]
    assert [s.name for s in signals.controls] == ["j0_u", "j1_u", "j2_u", "j0_rate", "j1_rate", "j2_rate"]
    assert [s.field for s in signals.controls[-3:]] == [f"rate(position[j{k}])" for k in range(3)]
    assert signals.controls[-1].valid == (-4.0, 4.0) and signals.structure is None


def test_own_leaves_each_state_its_own_signals_and_those_of_none() -> None:
    """The elements between members are 0 whatever the data, and a memory that is added later obeys."""
    rule = {"for": ["j0", "...", "j2"], "state": "{}", "from": "{}_u", "nominal": {"min": 0}}
    signals = SignalMap.from_dict(joints(3, structure=["own", rule], additive="noise"))
    rng = np.random.default_rng(5)
    n, m = len(signals.states), len(signals.controls)
    x, u = np.cumsum(rng.normal(size=(400, n)), axis=0), rng.normal(size=(400, m))
    run = Transient(0.1 * np.arange(400), x, u, signals=signals, max_gap=1.0)
    model = fit(run)
    names = [*model.state_names, *model.control_names]
    for i, state in enumerate(model.state_names):
        row = np.concatenate([model.A[i], model.B[i]])
        half = np.concatenate([model.dA[i], model.dB[i]])
        for j, name in enumerate(names):
            apart = state != "tilt" and name != "tilt" and name[:2] != state[:2]
            assert not apart or (row[j] == 0 and half[j] == 0)
            assert apart or (name[:2] == state[:2] and "_u" in name) or row[j] != 0
    assert all(model.B[i, i] >= 0 for i in range(3))
    more = fit(with_memories(run, [Remembered("j1", Memory("lag"))]))
    assert np.flatnonzero(more.B[:, -1]).tolist() == [1, 3] and not more.dB[[0, 2], -1].any()


@pytest.mark.parametrize("own", [True, False])
def test_joints_that_move_as_one_confound_nothing_where_each_depends_on_its_own(own: bool) -> None:
    """As of a walking robot, all of whose joints were said to share their effects."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.normal(size=(60, 1)), 10, axis=0)
    x = np.zeros((len(u), 2))
    for k in range(len(u) - 1):
        x[k + 1] = 0.9 * x[k] + 0.1 * u[k] + 0.01 * rng.normal(size=2)
    signals = {
        "states": [{"for": ["a", "b"], "name": "{}", "topic": "/x", "field": "{}"}],
        "controls": [{"for": ["a", "b"], "name": "{}_command", "topic": "/u", "field": "{}"}],
    } | ({"structure": "own"} if own else {})
    transient = Transient(0.02 * np.arange(len(u)), x, np.hstack([u, u]), signals=SignalMap.from_dict(signals))
    model = fit(transient, additive="noise")
    said = [m for m in model.fit_summary["messages"] if "'a_command' and 'b_command' move together" in m]
    assert bool(said) is not own and model.fit_summary["rank"] == 3
