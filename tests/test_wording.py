# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

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
