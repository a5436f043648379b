"""What `play` and `record` share at the command line: a progress line, remarks, numbers."""

import sys
import time

_hushed = False


def hush(wanted: bool) -> None:
    """From here on say nothing to the person who waits, or speak again."""
    global _hushed
    _hushed = wanted


def say(text: str) -> None:
    """Remark to the person who waits, apart from the result."""
    if not _hushed:
        print(text, file=sys.stderr, flush=True)


def tell(text: str) -> None:
    """Part of the result."""
    if not _hushed:
        print(text, flush=True)


def seconds(text: str) -> float:
    """Argument that is a time: a finite number, 0 or more."""
    value = float(text)
    if not 0 <= value < float("inf"):
        raise ValueError(text)
    return value


class Progress:
    """One line on standard error that is written over, where that is a terminal."""

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty() and not _hushed
        self._shown = 0.0

    def show(self, text: str) -> None:
        """Show the text, at most five times a second."""
        if self._terminal and time.monotonic() - self._shown > 0.2:
            self._shown = time.monotonic()
            print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)

    def clear(self) -> None:
        """Take the line away."""
        if self._terminal and self._shown:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
