# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What the benchmarks share: the least time, the peak memory of a process, tables as Markdown."""

from __future__ import annotations

import time
from pathlib import Path


def best(function, runs=3):
    """Least wall time of some runs, s, and the last result."""
    times = []
    for _ in range(runs):
        began = time.perf_counter()
        result = function()
        times.append(time.perf_counter() - began)
    return min(times), result


def peak_memory():
    """Largest resident memory of this process, bytes; its maxrss would start from the parent's."""
    line = next(x for x in Path("/proc/self/status").read_text().splitlines() if x.startswith("VmHWM"))
    return int(line.split()[1]) * 1024


def markdown(header, rows):
    """A Markdown table."""
    return "".join("| " + " | ".join(line) + " |\n" for line in (header, ["---"] * len(header), *rows))


def table(title, header, rows):
    """Print a table with its title."""
    print(f"\n**{title}**\n\n{markdown(header, rows)}", flush=True)
