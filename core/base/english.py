# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Counted things, and names near to a misspelt one, in sentences."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence

LONGEST = 2000
"""Letters of a sentence as it is shown."""


def printable(text: str, limit: int = LONGEST) -> str:
    r"""A text that came from outside, for a terminal: one line, no control characters, not too long."""
    text = _shortened(text, limit)
    if text.isprintable():
        return text
    return _shortened("".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text), limit)


def _shortened(text: str, limit: int) -> str:
    tail = limit // 3
    return text if len(text) <= limit else f"{text[: limit - tail - 5]} ... {text[-tail:]}"


def plural(count: object, word: str) -> str:
    """A count and its noun: 1 state, 2 states, 0 states; 1 pass, 2 passes."""
    return f"{count} {word}" if count == 1 else f"{count} {_several(word)}"


def times(count: int) -> str:
    """Once, or how many times."""
    return "once" if count == 1 else f"{count} times"


def shortlist(names: Sequence[str], limit: int) -> str:
    """The first names, and how many more there are."""
    return ", ".join(names[:limit]) + (f" and {len(names) - limit} more" if len(names) > limit else "")


def meant(word: object, known: Iterable[str], most: int = 3) -> str:
    """(is X meant?), with the known names that are near to a word, or nothing."""
    names = {name.lower(): name for name in sorted(known)}
    near = difflib.get_close_matches(str(word).lower(), names, n=most, cutoff=0.65 if most == 1 else 0.7)
    return f" (is {' or '.join(names[n] for n in near)} meant?)" if near else ""


def _several(word: str) -> str:
    if word.endswith(("s", "x", "ch", "sh")):
        return f"{word}es"
    return f"{word[:-1]}ies" if word.endswith("y") and word[-2:-1] not in "aeiou" else f"{word}s"
