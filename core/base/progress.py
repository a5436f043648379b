# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Progress: what a command says of itself while it works, on standard error."""

from __future__ import annotations

import io
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, TextIO

from uncertain_lti.base.text import printable, shortlist

_DELAY = 0.4  # s; what is done sooner shows no bar
_REDRAW = 0.1  # s
_FIRST_LINE, _LINE = 2.0, 10.0  # s; where no terminal is, from one line of a long part to the next
_LONGEST_LINE = 20_000  # letters of a result


class CountedStep(str):
    """A line of progress that also holds which of how many steps it is about.

    `text`: the line; `number`: which step begins, from 1; `total`: number of steps.
    """

    def __new__(cls, text: str, number: int, total: int) -> CountedStep:  # noqa: D102
        return super().__new__(cls, text)

    def __init__(self, text: str, number: int, total: int) -> None:
        self.number, self.total = number, total


class Progress:
    """Bars on a terminal, a line now and then elsewhere; remarks, unless quiet; every line of the work, where verbose.

    `iterate` gives what `read_transients(progress=)` takes, `stage` what `fit(progress=)`, `validate(progress=)` and
    `fit_archive(progress=)` take. As a context it takes its bars away however the block ends.

    `quiet`: say nothing; `verbose`: say every line that a stage is given, with the time since this object was made,
    also where no terminal is; `stream`: default standard error.
    """

    def __init__(self, quiet: bool = False, verbose: bool = False, stream: TextIO | None = None) -> None:
        self.quiet, self.verbose = quiet, verbose
        self._stream = stream or sys.stderr or io.StringIO()  # a process may have none
        self._began = self._spoke = time.perf_counter()
        self._bars: list[Any] = []
        self._noted: set[str] = set()

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        for bar in self._bars:
            bar.close()
        self._bars.clear()

    @property
    def shown(self) -> bool:
        """Whether bars are drawn."""
        return not self.quiet and self._stream.isatty()

    def note(self, *texts: str) -> None:
        """Remarks that the reader should know, unless quiet, each once: `start` reads a recording several times.

        Those of several recordings that differ in the name before the colon alone are one.
        """
        named: dict[str, list[str]] = {}
        for text in texts if not self.quiet else ():
            if text not in self._noted:
                self._noted.add(text)
                name, colon, rest = text.partition(": ")
                named.setdefault(colon + rest or name, []).append(name * bool(colon))
        for rest, names in named.items():
            self.write(f"note: {printable(shortlist(names, 2) + rest)}")

    def say(self, text: str) -> None:
        """Part of the result, on standard output, unless quiet; a bar stays below it."""
        if not self.quiet and sys.stdout is not None:
            self._print(_coloured("\n".join(printable(line, _LONGEST_LINE) for line in text.split("\n"))), sys.stdout)

    def detail(self, text: str) -> None:
        """A line for who asked to see the work."""
        if self.verbose:
            self.write(f"{time.perf_counter() - self._began:8.2f} s  {printable(text)}")

    def iterate(self, what: str, unit: str = "messages") -> Callable[[Iterable[object], int], Iterable[object]] | None:
        """Wrapper (iterable, total) -> iterable that tells how far it has come; None where nobody would see it."""

        def wrap(items: Iterable[object], total: int) -> Iterator[object]:
            began = time.perf_counter()
            if self.shown:
                drawn = {"desc": what, "total": total, "unit": f" {unit}", "unit_scale": True, "delay": _DELAY}
                with self._bar(iterable=items, **drawn) as bar:
                    yield from bar
            else:
                log = self._log(what)
                for number, item in enumerate(items):
                    if number % 1024 == 0 or total < 1024:
                        log(f"{number} of {total} {unit}", number, total)
                    yield item
            self.detail(f"{what}: {total} {unit} in {time.perf_counter() - began:.2f} s")

        return wrap if self.verbose or not self.quiet else None

    @contextmanager
    def stage(self, what: str) -> Iterator[Callable[[str], None]]:
        """Yields a callable for one line of text per step; a `CountedStep` moves the bar there."""
        began = drawn = time.perf_counter()
        log = self._log(what)
        with ExitStack() as stack:
            bar: Any = None

            def step(text: str) -> None:
                nonlocal bar, drawn
                self.detail(f"{what}: {text}")
                now = time.perf_counter()
                if not self.shown:
                    done, total = (text.number - 1, text.total) if isinstance(text, CountedStep) else (0, 0)
                    log(text, done, total)
                    return
                if now - began < _DELAY or (bar is not None and now - drawn < _REDRAW):
                    return
                drawn = now
                if bar is None:
                    bar = stack.enter_context(self._bar(bar_format="{desc} [{elapsed}]"))
                    bar.start_t -= now - began
                if isinstance(text, CountedStep):
                    bar.bar_format = "{desc} {percentage:3.0f}%|{bar}| [{elapsed}<{remaining}]"
                    bar.n, bar.total = text.number - 1, text.total
                shown = printable(text)
                bar.set_description_str(f"{what}: {shown if len(shown) <= 50 else f'{shown[:47]}...'}")

            yield step
        self.detail(f"{what}: done in {time.perf_counter() - began:.2f} s")

    def _log(self, what: str) -> Callable[[str, int, int], None]:
        """Lines on a long part of the work where no terminal is: what is about to be done, and the time left."""
        began = time.perf_counter()
        following = began + _FIRST_LINE

        def log(text: str, done: int, total: int) -> None:
            nonlocal following
            now = time.perf_counter()
            due = min(following, self._spoke + _LINE)  # many parts that are short are long together
            if now < due or self.quiet or self.verbose:  # who sees every line anyway
                return
            self._spoke, following = now, now + _LINE
            if done and " left" not in text:
                text += f", about {(now - began) / done * (total - done):.0f} s left"
            self.write(f"{what}: {printable(text)}")

        return log

    @contextmanager
    def _bar(self, **options: Any) -> Iterator[Any]:
        from tqdm import tqdm

        columns, lines = self._size()
        bar = tqdm(file=self._stream, leave=False, ncols=columns, nrows=lines, **options)
        self._bars.append(bar)
        try:
            yield bar
        finally:
            bar.close()
            if bar in self._bars:
                self._bars.remove(bar)

    def _size(self) -> tuple[int, int]:
        """Columns and lines of the terminal; some say 0."""
        try:
            columns, lines = os.get_terminal_size(self._stream.fileno())
        except (OSError, ValueError):
            columns = lines = 0
        return columns or 80, lines or 24

    def write(self, text: str) -> None:
        """A line on the stream, above the bars; the work goes on where nobody reads it any more."""
        try:
            self._print(text, self._stream)
            self._stream.flush()
        except BrokenPipeError:
            self._stream = io.StringIO()

    def _print(self, text: str, stream: TextIO) -> None:
        if self._bars:
            from tqdm import tqdm

            tqdm.write(text, file=stream)
        else:
            print(text, file=stream)


def _coloured(text: str) -> str:
    """Lines of an alarm in red, on a terminal that has colours and whose user has not refused them (no-color.org)."""
    refused = os.environ.get("NO_COLOR") or os.environ.get("TERM", "dumb") == "dumb"
    if refused or not sys.stdout.isatty():
        return text
    return "\n".join(f"\x1b[1;31m{line}\x1b[0m" if line.startswith("ALARM") else line for line in text.split("\n"))
