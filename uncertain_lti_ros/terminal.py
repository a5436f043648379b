# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What `play` and `record` share at the command line: a progress line, remarks, numbers."""

import argparse
import math
import sys
import time

_hushed = False


def hush(wanted: bool) -> None:
    """Suppress messages to the terminal from here on, or allow them again."""
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
    """Parse an argument that is a time: a finite number, 0 or more."""
    value = _number(text)
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is not a time; give seconds, 0 or more")
    return value


def speed(text: str) -> float:
    """Parse an argument that is a speed, times real time: a finite number above 0."""
    value = _number(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is not a speed; give a number above 0, such as 1 or 0.5")
    return value


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


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
