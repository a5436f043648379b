# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The table of output topics: what a verdict publishes, one row each."""

from collections.abc import Callable

import numpy as np
import pytest

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI
from uncertain_lti.base.errors import ModelError
from uncertain_lti.model.alarm_rule import AlarmRule, StatisticRule
from uncertain_lti.model.domain import Domain
from uncertain_lti.model.horizon import Horizon
from uncertain_lti.model.terms import ARRAYS
from uncertain_lti.monitor.outputs import (
    OUTPUTS,
    REASON,
    RECORDED,
    VECTOR_TYPE,
    VIOLATION,
    NamedVector,
    Output,
    VerdictMessages,
    VerdictRecords,
    names_of,
)
from uncertain_lti.monitor.verdict import NUMBERS, place
from uncertain_lti.plants.leibov import leibov2006
from uncertain_lti.sampling.clock import Status
from uncertain_lti.sampling.sampler import Step


def with_horizons() -> UncertainLTI:
    model = leibov2006()
    arrays = {name: getattr(model, name) for name in ARRAYS}
    return model.replace(horizons=[Horizon(h, **arrays) for h in (2, 3)])


def with_statistics() -> UncertainLTI:
    rules = [AlarmRule(2, 3), StatisticRule("energy", 0.2, 0.5, horizon=3), StatisticRule("cusum", 1.0, 2.0)]
    return with_horizons().replace(alarm=rules)


def statistics_of(model: UncertainLTI) -> tuple[str, ...]:
    return EnvelopeMonitor(model).alarms.names


@pytest.mark.parametrize("output", OUTPUTS, ids=[output.name for output in OUTPUTS])
def test_every_row_is_whole(output: Output) -> None:
    """A vector carries a number that verdicts have, one by one and over a transient; a flag carries the alarm."""
    assert output.text and bool(output.position) == (output.type == VECTOR_TYPE) == (output not in (VIOLATION, REASON))
    assert bool(output.title) == (output.view in ("states", "steps"))
    if output.position:
        assert (output.position in NUMBERS) == (output.of == "states")
        model = leibov2006() if output.of == "states" else with_statistics()
        verdicts = EnvelopeMonitor(model).check(Transient(np.arange(3.0), np.ones((3, 5)), np.ones((3, 4))))
        rows = names_of(model.state_names, model.steps, statistics_of(model))[output.of]
        assert getattr(verdicts, output.position).reshape(3, -1).shape == (3, len(rows))
        assert not output.velocity or getattr(verdicts, output.velocity).shape == (3,)


def test_names_are_unique_and_those_of_every_message_come_first() -> None:
    assert len({output.name for output in OUTPUTS}) == len(OUTPUTS)
    every = [output.when == "message" for output in RECORDED]
    assert every == sorted(every, reverse=True)


@pytest.mark.parametrize("make", [leibov2006, with_horizons, with_statistics])
def test_one_message_and_many_records_have_the_same_bytes(make: Callable[[], UncertainLTI]) -> None:
    """Of a judged sample, one outside the domain, and one without a verdict, for every vector of the table."""
    model = make()
    model = model.replace(domain=Domain(*(sign * np.ones(k) for k in (model.n, model.m) for sign in (-1.0, 1.0))))
    monitor, names = EnvelopeMonitor(model), model.state_names
    inside, outside = [0.0] * (model.n + model.m), [1e6] * (model.n + model.m)
    steps = [
        Step(Status.OK, 5, 7, 0.1, inside, inside[: model.n]),
        Step(Status.OK, 6, 8, 0.1, outside, inside[: model.n]),
        Step(Status.MISSING, 7, 9, 0.1, inside, inside[: model.n]),
    ]
    verdicts = [monitor.judge(step) for step in steps]
    assert [v.judged for v in verdicts] == [True, True, False] and verdicts[1].outside_domain
    statistics = statistics_of(model)
    every = names_of(names, model.steps, statistics)
    messages = VerdictMessages(every)
    encode = {name: messages.encoder([name]) for name in messages.outputs}
    outputs = [o for o in RECORDED if not o.position or every[o.of]]
    outputs.remove(REASON)
    assert ("horizon_utilisation" in encode) == bool(model.horizons)
    assert ("statistics" in encode) == bool(statistics) == (len(outputs) == len(RECORDED) - 1)
    numbers = {o.position: np.array([v.numbers(o.position) for v in verdicts]) for o in outputs if o.position}
    for verdict in verdicts:
        for name in numbers:
            own = verdict.packed_statistics() if name == "statistics" else verdict.packed()[place(name, model.n)]
            assert own == np.array(verdict.numbers(name)).tobytes()
    numbers |= {o.velocity: np.array([getattr(v, o.velocity) for v in verdicts]) for o in RECORDED if o.velocity}
    records = VerdictRecords(every, {output.name: i for i, output in enumerate(outputs)})
    times = np.arange(3)
    said = (np.array([getattr(v, name) for v in verdicts]) for name in ("t_ns", "judged", "alarm"))
    data, _ = records.encode(times, *said, numbers)
    for output in outputs:
        for verdict in verdicts:
            if output.position:
                (message,) = encode[output.name](verdict)
                assert (message in data) == (output.when == "message" or verdict.judged)
    for wanted in ([], ["lower"], ["state", "flags"], list(encode)):  # together as one by one
        for verdict in verdicts:
            assert messages.encoder(wanted)(verdict) == [encode[name](verdict)[0] for name in wanted]
    marks = NamedVector(names, velocities=True)
    flags = [encode["flags"](verdict)[0] for verdict in verdicts]
    velocities = [np.frombuffer(f[marks.velocity : marks.velocity + 8 * model.n], "<f8") for f in flags]
    np.testing.assert_array_equal(velocities, np.repeat([[0.0], [1.0], [np.nan]], model.n, axis=1))


@pytest.mark.parametrize("velocities", [False, True])
def test_the_middleware_reads_whatever_the_states_are_called(velocities: bool) -> None:
    pytest.importorskip("rclpy")
    from rclpy.serialization import deserialize_message
    from sensor_msgs.msg import JointState

    for names in (*(["x" * length] for length in range(10)), ["größe", "油门", "a b"], ["a"] * 5):
        numbers = [0.0] * len(names)
        same = JointState(name=names, position=numbers, velocity=numbers * velocities)
        assert deserialize_message(NamedVector(names, velocities).template, JointState) == same
    with pytest.raises(ModelError, match="cannot be sent as text"):
        NamedVector(["a\0"])


def test_the_numbers_of_horizons_are_named_by_state_and_steps() -> None:
    every = names_of(["speed", "pressure"], [5, 40])
    assert every["horizons"] == ("speed@1", "pressure@1", "speed@5", "pressure@5", "speed@40", "pressure@40")
    assert names_of(["speed"])["horizons"] == names_of(["speed"])["statistics"] == ()
