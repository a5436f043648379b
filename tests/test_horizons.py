"""Envelopes over several steps: the model's elements, its file, and the utilisation per horizon."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI
from uncertain_lti.base.errors import ModelError
from uncertain_lti.model.horizon import MOST_STEPS, Horizon
from uncertain_lti.model.schedule import Axis, Schedule
from uncertain_lti.model.terms import ARRAYS, SHAPES

pytestmark = pytest.mark.numpy

SPEED = Schedule((Axis("x1", knots=(-0.5, 0.0, 1.0)),))


def horizon(rng: np.random.Generator, steps: int, blocks: int | None = None, n: int = 2, m: int = 1) -> Horizon:
    lead = () if blocks is None else (blocks,)
    return Horizon(steps, **{name: np.abs(rng.normal(size=(*lead, *SHAPES[name].shape(n, m)))) for name in ARRAYS})


def with_horizons(rng: np.random.Generator, steps: tuple[int, ...], schedule: Schedule | None = None) -> UncertainLTI:
    blocks = None if schedule is None else schedule.blocks
    one = horizon(rng, 2, blocks)
    return UncertainLTI(
        **{name: getattr(one, name) for name in ARRAYS},
        schedule=schedule,
        horizons=[horizon(rng, h, blocks) for h in steps],
    )


@pytest.mark.parametrize("schedule", [None, SPEED])
def test_horizons_come_back_from_the_file_in_order(schedule: Schedule | None, tmp_path: Path) -> None:
    model = with_horizons(np.random.default_rng(1), (9, 2, 4), schedule)
    assert [h.steps for h in model.horizons] == [2, 4, 9]
    model.save(tmp_path / "model.json")
    again = UncertainLTI.load(tmp_path / "model.json")
    assert again.to_dict() == model.to_dict() and model.to_dict()["format"] == "uncertain-lti/2"
    for mine, theirs in zip(model.horizons, again.horizons, strict=True):
        assert all(getattr(mine, name).tobytes() == getattr(theirs, name).tobytes() for name in ARRAYS)
    assert "2, 4, 9 steps" in repr(again)


def test_a_model_of_one_step_has_none_and_stays_in_its_format() -> None:
    model = with_horizons(np.random.default_rng(2), ())
    assert model.horizons == () and "horizons" not in model.to_dict()
    assert model.to_dict()["format"] == "uncertain-lti/1"
    transient = Transient(np.arange(5) * 0.1, np.ones((5, 2)), np.ones((5, 1)))
    verdicts = EnvelopeMonitor(model).check(transient)
    assert verdicts.horizon_utilisation.shape == (5, 1, 2)
    np.testing.assert_array_equal(verdicts.horizon_utilisation[:, 0], verdicts.utilisation)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"steps": 1}, "whole number, 2 to"),
        ({"steps": True}, "whole number"),
        ({"steps": MOST_STEPS + 1}, "whole number"),
        ({"steps": 9}, "two have as many steps"),
        ({"widths": "wide"}, "growing or constant"),
        ({"widths": "constant"}, "dA, dB or dc is not 0"),
        ({"blocks": []}, r"horizons\[0\].blocks"),
        ({"odd": 1}, "odd"),
        ({"blocks": [{"A": [[1.0]]}]}, r"horizons\[0\].blocks\[0\].A"),
        ({"blocks": [{}]}, r"horizons\[0\].blocks\[0\].A' is missing"),
    ],
)
def test_what_is_no_horizon_is_refused_by_name(change: dict[str, Any], words: str) -> None:
    data = json.loads(json.dumps(with_horizons(np.random.default_rng(3), (2, 9)).to_dict()))
    data["horizons"][0] |= change
    with pytest.raises(ModelError, match=words):
        UncertainLTI.from_dict(data, "model.json")


def test_a_negative_half_width_and_another_number_of_states_are_refused() -> None:
    rng = np.random.default_rng(4)
    data = json.loads(json.dumps(with_horizons(rng, (2,)).to_dict()))
    data["horizons"][0]["blocks"][0]["v"][1] = -1.0
    with pytest.raises(ModelError, match="negative half-width"):
        UncertainLTI.from_dict(data)
    model = with_horizons(rng, ())
    with pytest.raises(ModelError, match="do not fit the model"):
        model.replace(horizons=[horizon(rng, 3, n=3)])
    with pytest.raises(ModelError, match="do not fit the model"):
        model.replace(horizons=[horizon(rng, 3, blocks=2)])


def test_format_1_has_no_horizons() -> None:
    data = json.loads(json.dumps(with_horizons(np.random.default_rng(3), (2,)).to_dict())) | {
        "format": "uncertain-lti/1"
    }
    with pytest.raises(ModelError, match="unknown field 'horizons'"):
        UncertainLTI.from_dict(data)
