"""Counted things, and names near to a misspelt one, in sentences."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence


def plural(count: object, word: str) -> str:
    """1 state, 2 states, no state as 0 states, and 1 pass, 2 passes; `word` may be several, the last one counted."""
    return f"{count} {word}" if count == 1 else f"{count} {_several(word)}"


def times(count: int) -> str:
    """Once, or how many times."""
    return "once" if count == 1 else f"{count} times"


def shortlist(names: Sequence[str], limit: int) -> str:
    """The first names, and how many more there are."""
    return ", ".join(names[:limit]) + (f" and {len(names) - limit} more" if len(names) > limit else "")


def meant(word: object, known: Iterable[str]) -> str:
    """(is X meant?), with the known names that are near to a word, or nothing."""
    names = {name.lower(): name for name in sorted(known)}
    near = difflib.get_close_matches(str(word).lower(), names, n=3, cutoff=0.7)
    return f" (is {' or '.join(names[n] for n in near)} meant?)" if near else ""


def _several(word: str) -> str:
    if word.endswith(("s", "x", "ch", "sh")):
        return f"{word}es"
    return f"{word[:-1]}ies" if word.endswith("y") and word[-2:-1] not in "aeiou" else f"{word}s"
