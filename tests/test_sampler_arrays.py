# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Sampling in columns: to the last bit and count what the Sampler gives, one message after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_sampler import TICK, Sent, cases, loops

from uncertain_lti.sampling.reading import sample_by_message
from uncertain_lti.sampling.sampler_arrays import Samples, sample_arrays
from uncertain_lti.sampling.streams import Stream
from uncertain_lti.signals.signal_map import Signal, SignalMap


def columns(signals: SignalMap, messages: Sequence[Sent]) -> dict[str, Any]:
    """Messages as `Stream` holds them, in order of arrival."""
    messages = sorted(messages, key=lambda m: m.arrival)
    topics = signals.topics
    return {
        "topic": np.array([topics.index(m.topic) for m in messages], dtype=np.int64),
        "arrival": np.array([m.arrival for m in messages], dtype=np.int64),
        "stamp": np.array([m.stamp or -1 for m in messages], dtype=np.int64),
        "values": [
            np.array([m.values for m in messages if m.topic == t], dtype=float).reshape(-1, len(signals.on(t)))
            for t in topics
        ],
    }


def plain(samples: Samples) -> tuple[object, ...]:
    arrays = (samples.t_ns, samples.x, samples.held)
    return *((a.dtype, a.shape, a.tobytes()) for a in arrays), dict(samples.counters)


def both(signals: SignalMap, messages: Sequence[Sent]) -> tuple[Samples | None, Samples]:
    data = columns(signals, messages)
    stream = Stream(None, **data)  # type: ignore[arg-type]
    return sample_arrays(signals, **data), sample_by_message(stream, signals)


@settings(max_examples=200)
@given(cases() | cases(tame=True) | loops())
def test_the_same_as_the_sampler_or_left_to_it(case: tuple[SignalMap, list[Sent]]) -> None:
    at_once, by_message = both(*case)
    if at_once is not None:
        assert plain(at_once) == plain(by_message)


def goes_back(signals: SignalMap, messages: Sequence[Sent]) -> bool:
    """Whether a topic's own time steps back by more than max_gap, or only some of its messages have a stamp."""
    for topic in signals.topics:
        mine = sorted((m for m in messages if m.topic == topic), key=lambda m: m.arrival)
        stamps = [m.stamp for m in mine if m.stamp and m.stamp > 0]
        if signals.time[topic] == "header" and len(stamps) not in (0, len(mine)) and topic != signals.clock:
            return True
        high = 0
        for stamp in stamps:
            if stamp < high - signals.max_gap * 1e9:
                return True
            high = max(high, stamp)
    return False


@settings(max_examples=150)
@given(cases(tame=True))
def test_what_goes_forward_is_not_left_to_the_sampler(case: tuple[SignalMap, list[Sent]]) -> None:
    """Late and out of order by up to max_gap, equal stamps, gaps, NaN, stale, delayed controls, angles."""
    signals, messages = case
    if not goes_back(signals, messages):
        at_once, by_message = both(signals, messages)
        assert at_once is not None and plain(at_once) == plain(by_message)


@pytest.mark.slow
@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32),
    gap=st.sampled_from([0.05, 100.0]),
    lateness=st.sampled_from([0, 5, 150, 400]),
    lag=st.sampled_from([0, 3, 130]),
    busy=st.sampled_from([1, 1, 4]),
    waiting=st.sampled_from([0, 0, 9_990, 10_010]),
)
def test_long_recordings(seed: int, gap: float, lateness: int, lag: int, busy: int, waiting: int) -> None:
    """Later than the Sampler remembers samples, and more messages waiting than it keeps."""
    dice = np.random.default_rng(seed)
    states = (Signal("x", "/c", "unwrap(data)"), Signal("y", "/s", "data"))
    controls = (Signal("u", "/u", "data", max_hold=0.3, delay=2), Signal("v", "/u", "unwrap(data)"))
    signals = SignalMap(states, controls, clock="/c", max_gap=gap, max_skew=1.0)
    signals = replace(signals, time={"/c": "header", "/s": "log", "/u": "header"})
    messages = [Sent("/u", 0, 300 * TICK + k, (k * 0.01, 0.0)) for k in range(waiting)]  # of a time to come
    for k in range(1, 600):
        at = k * TICK
        messages.append(Sent("/c", at, at, (float(dice.normal(0, 4)),)))
        if dice.random() < 0.5:
            messages.append(Sent("/s", at, None, (float(k),)))
        for _ in range(busy):
            late = int(dice.integers(lateness + 1)) if dice.random() < 0.1 else 0
            stamp = max(1, at - (late + lag) * TICK)
            messages.append(Sent("/u", at, stamp, (float(k), float(dice.normal(0, 4)))))
    at_once, by_message = both(signals, messages)
    if at_once is not None:
        assert plain(at_once) == plain(by_message)
    if gap > 1 and waiting < 9_000:
        assert at_once is not None


def test_an_angle_that_needs_no_turn_loses_only_the_sign_of_its_zero() -> None:
    signals = SignalMap((Signal("x", "/c", "unwrap(data)"),), clock="/c", max_gap=1.0, time={"/c": "log"})
    messages = [Sent("/c", k * TICK, None, (value,)) for k, value in enumerate([0.1, -0.0, float("nan"), -0.2, -0.0])]
    at_once, by_message = both(signals, messages)
    assert at_once is not None and plain(at_once) == plain(by_message)
    assert not np.signbit(at_once.x[1, 0])


@pytest.mark.parametrize("messages", [[], [Sent("/c", 1, 1, (1.0,))]])
def test_recordings_of_no_or_one_message(messages: list[Sent]) -> None:
    signals = SignalMap((Signal("x", "/c", "data"),), clock="/c", max_gap=1.0, time={"/c": "header"})
    at_once, by_message = both(signals, messages)
    assert at_once is not None and plain(at_once) == plain(by_message)
