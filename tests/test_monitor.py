"""EnvelopeMonitor: one sample at a time or a whole transient, the same bits; and which verdicts count."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uncertain_lti import EnvelopeMonitor, SignalMap, Transient, UncertainLTI
from uncertain_lti.errors import ModelError
from uncertain_lti.model import Alarm, Domain
from uncertain_lti.sampler import Status, Step
from uncertain_lti.signals import Signal


def a_model(n: int, m: int, seed: int, **options: Any) -> UncertainLTI:
    rng = np.random.default_rng(seed)
    spread = 10.0 ** rng.integers(-6, 7, n + m)  # sums whose last bits depend on their order
    signals = SignalMap(
        tuple(Signal(f"x{i}", "", f"x{i}", *rng.uniform(0.1, 2, 2)) for i in range(n)),
        tuple(Signal(f"u{j}", "", f"u{j}", *rng.uniform(0.1, 2, 2)) for j in range(m)),
    )
    return UncertainLTI(
        rng.normal(size=(n, n)) * spread[:n], rng.normal(size=(n, m)) * spread[n:],
        rng.uniform(0, 1, (n, n)) * spread[:n], rng.uniform(0, 1, (n, m)) * spread[n:],
        rng.normal(size=n), rng.uniform(0, 1, n), rng.uniform(0, 1, n), signals=signals, **options,
    )  # fmt: skip


def judge(monitor: EnvelopeMonitor, transient: Transient, **options: Any) -> list[Any]:
    verdicts = []
    for k in range(1, len(transient)):
        dt = int(transient.t_ns[k] - transient.t_ns[k - 1]) * 1e-9
        step = Step(
            Status.OK, int(transient.t_ns[k]), 0, dt, transient.x[k - 1], transient.u[k - 1], transient.x[k]
        )  # fmt: skip
        verdicts.append(monitor.judge(step, **options))
    return verdicts


def a_transient(n: int, m: int, seed: int, count: int = 30) -> Transient:
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.01, 0.02, count))
    return Transient(t, rng.normal(size=(count, n)), rng.normal(size=(count, m)))


SIZES = [(1, 0), (1, 1), (1, 9), (1, 40), (2, 0), (2, 7), (3, 30), (5, 2), (8, 8), (17, 3), (50, 10), (64, 70)]


@pytest.mark.parametrize(("n", "m"), SIZES)
def test_bounds_are_summed_in_the_order_of_the_columns(n: int, m: int) -> None:
    model = a_model(n, m, 1)
    rng = np.random.default_rng(2)
    for _ in range(20):
        x, u, dt = rng.normal(size=n), rng.normal(size=m), float(rng.uniform(0.001, 0.1))
        z = [*x.tolist(), *u.tolist()]
        for i, row in enumerate(np.hstack([model.A, model.B]).tolist()):
            half_row = np.hstack([model.dA, model.dB])[i].tolist()
            rate, half = row[0] * z[0], half_row[0] * abs(z[0])
            for a, da, value in zip(row[1:], half_row[1:], z[1:], strict=True):
                rate += a * value
                half += da * abs(value)
            rate = z[i] + (rate + float(model.c[i])) * dt
            half = (half + float(model.dc[i])) * dt + float(model.v[i])
            got = [float(part[i]) for part in model.centre_and_half(x, u, dt)]
            assert got == [rate, half]


@pytest.mark.parametrize(("n", "m"), SIZES)
@pytest.mark.parametrize("margin", [1.0, 0.3])
def test_sample_by_sample_gives_the_bits_of_the_whole_transient(n: int, m: int, margin: float) -> None:
    rng = np.random.default_rng(3)
    box = Domain(-rng.uniform(0, 9, n), rng.uniform(0, 9, n), -rng.uniform(0, 9, m), rng.uniform(0, 9, m))
    model = a_model(n, m, 4, domain=box, alarm=Alarm(2, 5))
    transient = a_transient(n, m, 5)
    whole = EnvelopeMonitor(model, margin=margin).check(transient)
    verdicts = judge(EnvelopeMonitor(model, margin=margin), transient)
    assert 0 < len(verdicts) == whole.judged.sum()
    for k, verdict in enumerate(verdicts, 1):
        for name in ("flags", "lower", "upper", "utilisation"):
            assert getattr(verdict, name).tobytes() == getattr(whole, name)[k].tobytes(), name
        assert (verdict.outside_domain, verdict.alarm) == (whole.outside_domain[k], whole.alarm[k])


@given(st.data())
def test_the_alarm_counts_violations_in_its_window_and_only_those_that_count(data: st.DataObject) -> None:
    window = data.draw(st.integers(1, 6))
    violations = data.draw(st.integers(1, window))
    n = 3
    masked = data.draw(st.lists(st.sampled_from(["x0", "x1"]), unique=True))
    model = a_model(n, 0, 6, alarm=Alarm(violations, window))
    transient = a_transient(n, 0, data.draw(st.integers(0, 10**6)))
    armed = data.draw(st.lists(st.booleans(), min_size=len(transient) - 1, max_size=len(transient) - 1))
    monitor = EnvelopeMonitor(model, margin=0.5, masked=masked)
    counted: list[bool] = []
    for k in range(1, len(transient)):
        part = Transient(transient.t[k - 1 : k + 1], transient.x[k - 1 : k + 1], transient.u[k - 1 : k + 1])
        (verdict,) = judge(monitor, part, armed=armed[k - 1])
        counts = [flag for name, flag in zip(model.state_names, verdict.flags, strict=True) if name not in masked]
        counted = [*counted, 1.0 in counts] if armed[k - 1] else []
        assert verdict.alarm == (sum(counted[-window:]) >= violations)
    if all(armed):
        assert EnvelopeMonitor(model, margin=0.5, masked=masked).check(transient).alarm[-1] == verdict.alarm


def test_masks_are_held_against_the_states() -> None:
    model = a_model(2, 0, 7)
    assert EnvelopeMonitor(model, masked=["x1"]).masked == ("x1",)
    with pytest.raises(ModelError, match="masked state 'x2' is not in the model; its states are x0, x1"):
        EnvelopeMonitor(model, masked=["x2"])
    with pytest.raises(ModelError, match="every state of the model is masked"):
        EnvelopeMonitor(model, masked=["x0", "x1"])
