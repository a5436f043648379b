# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Normalisation, and what `auto` resolves to."""

import math
import tracemalloc

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from uncertain_lti.base.errors import TransientError
from uncertain_lti.model.operating_point import OperatingPoint
from uncertain_lti.sampling.steady_state import (
    STILL_BAND,
    STILL_SAMPLES,
    codes,
    end_stops,
    resolve_auto,
    still_stretches,
)
from uncertain_lti.signals.signal_map import Signal

NAN, INF = math.nan, math.inf
number = st.floats(-1e6, 1e6)


@given(st.data())
def test_normalisation_is_as_method_section_1_states_it(data: st.DataObject) -> None:
    n, m = data.draw(st.integers(1, 4)), data.draw(st.integers(0, 3))
    vector = lambda size, elements: data.draw(hnp.arrays(float, size, elements=elements))  # noqa: E731
    units = (vector(size, st.floats(1e-3, 1e3)) for size in (n, m))
    point = OperatingPoint(vector(n, number), vector(m, number), *units)
    lead = data.draw(hnp.array_shapes(max_dims=2, max_side=3) | st.just(()))
    x, u = vector((*lead, n), number), vector((*lead, m), number)
    deviation = point.normalise_x(x)
    for index in np.ndindex(lead):
        for i in range(n):
            assert deviation[(*index, i)] == (x[(*index, i)] - point.x_s[i]) / point.X[i]
        for j in range(m):
            assert point.normalise_u(u)[(*index, j)] == (u[(*index, j)] - point.u_s[j]) / point.U[j]
    np.testing.assert_allclose(point.recorded_x(deviation), x, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (([0.0], [], [0.0], []), "every scale in X must be positive"),
        (([0.0], [1.0], [1.0], [-1.0]), "every scale in U must be positive"),
        (([0.0], [], [NAN], []), "X must be a vector of finite numbers"),
        (([INF], [], [1.0], []), "x_s must be a vector of finite numbers"),
        (([0.0, 1.0], [], [1.0], []), "x_s and X differ in length"),
        (([0.0], [1.0], [1.0], []), "u_s and U differ in length"),
        (([[0.0]], [], [[1.0]], []), "x_s must be a vector"),
        ((["a"], [], [1.0], []), "x_s must be a vector of real numbers"),
    ],
)
def test_a_wrong_operating_point_is_refused(arguments: tuple[list[float], ...], words: str) -> None:
    with pytest.raises(TransientError, match=words):
        OperatingPoint(*map(np.array, arguments))


def test_auto_must_be_resolved_before_it_is_used() -> None:
    states = [Signal("x", "/a", "data", steady=2.0, scale=4.0)]
    assert OperatingPoint.of(states, []).normalise_x(np.array([6.0])).tolist() == [1.0]
    with pytest.raises(TransientError, match="signal 'u': scale is auto and not resolved; give a number"):
        OperatingPoint.of(states, [Signal("u", "/a", "data", scale="auto")])


# --- still stretches -----------------------------------------------------------------------------------------


def naive_stretches(values: np.ndarray, span: np.ndarray, band: float) -> list[tuple[int, int]]:
    """From the left: the longest stretch from each start whose every column stays within the band."""
    found, start = [], 0
    while start < len(values):
        stop = start
        for end in range(start + 1, len(values) + 1):
            part = values[start:end]
            if not np.isfinite(part).all() or (part.max(axis=0) - part.min(axis=0) > band * span).any():
                break
            stop = end
        if stop - start >= STILL_SAMPLES:
            found.append((start, stop))
        start = max(stop, start + 1)
    return found


@st.composite
def recorded(draw: st.DrawFn) -> np.ndarray:
    """Stretches of rest, ramps, noise and gaps."""
    columns = draw(st.integers(1, 3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    parts = []
    for _ in range(draw(st.integers(1, 6))):
        length = draw(st.sampled_from([1, 5, STILL_SAMPLES - 1, STILL_SAMPLES, 30, 255, 256, 257, 600]))
        level = rng.integers(-2, 3, columns)
        kind = draw(st.sampled_from(["rest", "noise", "ramp", "gap"]))
        rest = np.tile(level.astype(float), (length, 1))
        rest += {"noise": 0.02, "ramp": 0.0, "rest": 0.0, "gap": 0.0}[kind] * rng.uniform(-1, 1, rest.shape)
        if kind == "ramp":
            rest += np.linspace(0, 1, length)[:, None]
        if kind == "gap":
            rest[draw(st.integers(0, length - 1)), draw(st.integers(0, columns - 1))] = NAN
        parts.append(rest)
    return np.vstack(parts)


@given(recorded(), st.sampled_from([0.0, STILL_BAND, 0.3, 1.0]))
@example(np.repeat([[0.0], [1.0]], STILL_SAMPLES, axis=0), 0.0)
def test_still_stretches_are_those_of_the_naive_search(values: np.ndarray, band: float) -> None:
    seen = np.isfinite(values)
    span = np.max(values, axis=0, where=seen, initial=-9.0) - np.min(values, axis=0, where=seen, initial=9.0)
    span = np.where(seen.any(axis=0), span, 0.0)
    assert still_stretches(values, span, band) == naive_stretches(values, span, band)


# --- the rule ------------------------------------------------------------------------------------------------


def signals(*said: tuple[object, object]) -> list[Signal]:
    return [Signal(f"s{i}", "/a", "data", steady=s, scale=c) for i, (s, c) in enumerate(said)]


def rest(level: float, length: int) -> np.ndarray:
    return np.full((length, 1), level)


AUTO = ("auto", "auto")


def test_steady_is_the_median_over_the_longest_still_stretch_and_scale_the_largest_steady_magnitude() -> None:
    ramp = np.linspace(2.0, -8.0, 9)[:, None]
    recordings = [np.vstack([rest(2.0, 20), ramp, rest(-8.0, 12)]), np.vstack([rest(3.0, 25), ramp])]
    steady, scale, words = resolve_auto(signals(AUTO), recordings)
    assert (steady, scale) == ([3.0], [8.0])
    assert words.startswith("25 still samples (every signal within 5% of its range)")


@pytest.mark.parametrize(
    ("values", "steady", "scale", "words"),
    [
        ([*[1.0] * 30, *[1.04] * 5, 2.0], 1.0, 1.0, ""),  # a median and not a mean
        ([*[0.0] * 30, -3.0, 4.0], 0.0, 7.0, ""),  # where the steady magnitude is zero, the range
        ([0.0] * 30, 0.0, 1.0, ""),  # nothing ever moves
        ([5.0] * 30, 5.0, 5.0, ""),
        ([*[0.0, 0.35] * 20, 1.0], 0.175, 0.175, "within 40% of its range"),  # doubled until there is a stretch
        ([1.0, 2.0, 6.0], 2.0, 2.0, "all samples (no still stretch)"),
    ],
)
def test_what_auto_resolves_to(values: list[float], steady: float, scale: float, words: str) -> None:
    found = resolve_auto(signals(AUTO), [np.array(values)[:, None]])
    assert found[:2] == ([pytest.approx(steady)], [pytest.approx(scale)]) and words in found[2]


def test_a_signal_that_never_comes_stays_at_zero_and_one() -> None:
    values = np.column_stack([np.arange(30.0), np.full(30, NAN), np.full(30, INF)])
    steady, scale, _ = resolve_auto(signals(AUTO, AUTO, AUTO), [values])
    assert (steady[1:], scale[1:]) == ([0.0, 0.0], [1.0, 1.0])
    assert steady[0] == 14.5


@given(st.lists(recorded(), min_size=1, max_size=2).filter(lambda r: len({x.shape[1] for x in r}) == 1), st.data())
def test_what_is_said_stays_and_what_is_resolved_can_be_used(recordings: list[np.ndarray], data: st.DataObject) -> None:
    said = [tuple(data.draw(st.sampled_from(["auto", one])) for one in (3.5, 2.5)) for _ in recordings[0].T]
    steady, scale, words = resolve_auto(signals(*said), recordings)
    assert words
    for (said_steady, said_scale), s, c in zip(said, steady, scale, strict=True):
        assert s == said_steady if said_steady != "auto" else math.isfinite(s)
        assert c == said_scale if said_scale != "auto" else 0 < c < INF
    alone, _, _ = resolve_auto(signals(*[AUTO] * len(said)), recordings)
    for (said_steady, _), s, a in zip(said, steady, alone, strict=True):
        assert said_steady != "auto" or s == a  # what one signal says does not move another


# --- end stops -----------------------------------------------------------------------------------------------


def driven(limit: float, held: int, rests: int) -> np.ndarray:
    """A joint that goes to its stop at one speed, is held there, comes back and rests."""
    there = np.linspace(0.3, limit, 40)[:, None]
    return np.vstack([rest(0.3, rests), there, rest(limit, held), there[::-1], rest(0.3, rests)])


@pytest.mark.parametrize("limit", [1.2, -0.9])
def test_a_signal_held_at_its_end_stop_is_no_steady_state(limit: float) -> None:
    values = driven(limit, held=300, rests=40)
    steady, scale, words = resolve_auto(signals(AUTO), [values])
    assert steady == [0.3] and scale == [abs(limit)]
    assert words.endswith("still samples (every signal within 5% of its range), not the 304 with s0 at an end stop")


@pytest.mark.parametrize(("begins", "other"), [(-0.9, 1.2), (1.2, -0.9)])
def test_of_two_end_stops_the_one_at_which_a_recording_begins_is_steady(begins: float, other: float) -> None:
    """A joint rests at one of its stops; at the other one it is held, and for longer."""
    there = np.linspace(begins, other, 60)[:, None]
    values = np.vstack([rest(begins, 40), there, rest(other, 300), there[::-1], rest(begins, 40)])
    steady, _, words = resolve_auto(signals(AUTO), [values])
    assert steady == [begins] and words.endswith("with s0 at an end stop") and "give `steady`" not in words


def test_where_every_recording_begins_is_rest_though_it_is_an_extreme_value() -> None:
    """A leg that stands is stretched, and goes one way from there: it was called an end stop, to be replaced."""
    away = np.linspace(-0.9, 1.2, 60)[:, None]
    values = np.vstack([rest(-0.9, 40), away, away[::-1], rest(-0.9, 60), away, away[::-1]])
    steady, _, words = resolve_auto(signals(AUTO), [values])
    assert steady == [-0.9] and "end stop" not in words


def test_a_noisy_signal_beside_one_at_its_end_stop_does_not_hide_it() -> None:
    joint = driven(1.2, held=300, rests=40)
    other = 5.0 + 0.01 * np.sin(np.arange(len(joint)) * 1.7)[:, None]
    other[:5] = 9.0
    steady, _, _ = resolve_auto(signals(AUTO, AUTO), [np.hstack([other, joint])])
    assert steady[1] == 0.3 and steady[0] == pytest.approx(5.0, abs=0.01)


def test_what_settles_by_itself_at_its_least_value_is_steady() -> None:
    heated = np.concatenate([np.linspace(20.0, 80.0, 60), 20.0 + 60.0 * np.exp(-np.arange(400) / 40.0)])
    cooling = np.round(np.concatenate([heated, np.full(300, 20.0)]), 1)[:, None]
    steady, _, words = resolve_auto(signals(AUTO), [cooling])
    assert steady == [20.0] and "end stop" not in words


def test_a_machine_at_rest_is_no_end_stop() -> None:
    up, down = np.linspace(0, 1, 40), np.linspace(1, 0, 40)
    throttle = np.concatenate([np.zeros(300), up, np.full(60, 0.7), down, np.zeros(300)])
    steady, _, words = resolve_auto(signals(AUTO), [throttle[:, None]])
    assert steady == [0.0] and "end stop" not in words


def test_an_end_stop_is_held_long_enough_at_once_and_is_one_of_many_values() -> None:
    at = STILL_SAMPLES - 2  # with the last sample of the way there and the first of the way back
    assert end_stops([driven(1.2, held=at, rests=0)]) == [[1.2]]
    assert end_stops([driven(1.2, held=at - 1, rests=0)]) == [[]]
    assert end_stops([np.vstack([driven(1.2, held=at - 3, rests=0)] * 2)]) == [[]]
    steps = np.repeat(np.linspace(0.3, 1.2, 8), [1] * 7 + [30])[:, None]
    assert end_stops([steps]) == [[]]


def test_where_nothing_is_still_but_at_an_end_stop_it_is_said() -> None:
    swing = 0.3 + 0.9 * np.abs(np.sin(np.arange(400) / 9.0))
    values = np.minimum(np.concatenate([swing, np.linspace(swing[-1], 2.0, 30), np.full(200, 1.2)]), 1.15)[:, None]
    steady, _, words = resolve_auto(signals(AUTO), [values])
    assert steady == [1.15]
    assert words.endswith("all of them with s0 at an end stop: give `steady` yourself")


def test_an_end_stop_is_held_for_ten_samples_and_reached_at_half_the_usual_speed() -> None:
    """Steps of 2 up to 79, of 1 over the ten before it: exactly half; and where nothing comes before, no speed."""
    up = np.concatenate([np.arange(1.0, 81.0, 2.0), np.arange(80.0, 91.0)])
    column = np.concatenate([up, np.full(10, 91.0)])[:, None]
    assert end_stops([column]) == [[91.0]] and end_stops([column[:-1]]) == [[]]
    at_once = np.concatenate([[90.0], np.full(10, 91.0)])[:, None]
    assert end_stops([column, at_once]) == [[91.0]]


# --- numbers that stand for no value -------------------------------------------------------------------------

ELEVEN, TENS = np.linspace(-1.0, 1.0, 11), np.linspace(0.0, 10.0, 11)


@pytest.mark.parametrize(
    ("others", "numbers", "found"),
    [
        (ELEVEN, [900.0] * 2, {900.0: 2}),
        (ELEVEN, [-900.0] * 3, {-900.0: 3}),
        (ELEVEN, [899.0] * 2, {}),  # too small
        (ELEVEN, [900.0], {}),  # once
        (ELEVEN[:9], [900.0] * 2, {}),  # of nine others
        (TENS, [3010.5] * 2, {3010.5: 2}),
        (TENS, [3010.0] * 2, {}),  # 300 times as far as the others spread, and no farther
        (np.full(5, 5.0), [-1e9], {-1e9: 1}),
        (np.full(5, 5.0), [-0.999e9], {}),
        (np.array([-999_999.0, 0.0]), [1e9], {1e9: 1}),
        (np.array([-1e6, 0.0]), [1e9], {}),
        (ELEVEN, [1e3, 1e6, 1e9, 1e12, 1e15] * 2, {1e15: 2, 1e12: 2, 1e9: 2, 1e6: 2}),  # four at most
    ],
)
def test_which_numbers_stand_for_no_value(others: np.ndarray, numbers: list[float], found: dict[float, int]) -> None:
    assert codes(np.concatenate([others, numbers, [NAN, INF]])) == found


def test_the_operating_point_of_much_takes_the_room_of_its_samples_twice() -> None:
    rows = np.random.default_rng(0).uniform(size=(5, 4000, 60))
    tracemalloc.start()
    try:
        resolve_auto([Signal(f"s{j}", "/t", f"s{j}", steady="auto", scale="auto") for j in range(60)], list(rows))
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert most < 2.0 * rows.nbytes
