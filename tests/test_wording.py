"""Counted things in sentences."""

from __future__ import annotations

import pytest

from uncertain_lti.base.english import plural, times


@pytest.mark.parametrize(
    ("count", "word", "text"),
    [
        (0, "sample", "0 samples"),
        (1, "sample", "1 sample"),
        (2, "usable transition", "2 usable transitions"),
        (1, "pass", "1 pass"),
        (3, "pass", "3 passes"),
        (2, "entry", "2 entries"),
        (2, "delay", "2 delays"),
        ("?", "state", "? states"),
    ],
)
def test_words_go_by_their_count(count, word, text):
    assert plural(count, word) == text


def test_once_is_once():
    assert [times(n) for n in (1, 2, 17)] == ["once", "2 times", "17 times"]
