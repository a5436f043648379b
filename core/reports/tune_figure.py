# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Figure of `tune`: the smallest detectable fault against false alarms."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Mapping
from typing import Any

NONE = 0.4
"""What no alarm is drawn as, alarms."""


def tune_figure(data: Mapping[str, Any], path: str | os.PathLike[str]) -> None:
    """Draw every way as a point, and the plain and the chosen one as lines over the false alarms allowed."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    figure, axes = plt.subplots(figsize=(7.0, 4.5), layout="constrained")
    judged = [t for t in data["trials"] if "refused" not in t and t["size"] is not None]
    hours = data["hours"]
    rate = [max(t["alarms"], NONE) / hours for t in judged]
    axes.plot(rate, [t["size"] for t in judged], ".", color="0.6", label="every way at the rate asked for")
    chosen = data["trials"][data["chosen"]]
    for way, colour in (("plain", "#0072b2"), ("chosen", "#d55e00")):
        points = sorted((max(p["alarms"], NONE) / hours, p["size"]) for p in data["curve"] if p["way"] == way)
        if points:
            axes.plot(*zip(*points, strict=True), "o-", color=colour, label=way)
    axes.set(
        xscale="log",
        yscale="log",
        xlabel=f"false alarms per hour on what was left out, {hours:.3g} h",
        ylabel="smallest detectable fault, relative to the plain fit",
    )
    axes.set_title(textwrap.fill(f"{chosen['fit']}; alarm {chosen['alarm']}", 90), fontsize="small")
    none = NONE / hours
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
    low, high = axes.get_xlim()
    if low < none:  # there the axis says what its logarithm cannot
        ticks = [t for t in axes.get_xticks() if 2.0 * none <= t <= high]
        axes.set_xticks([none, *ticks], ["none", *(f"{t:g}" for t in ticks)])
        axes.set_xlim(low, high)
    axes.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=3, fontsize="small", frameon=False)
    figure.savefig(path, dpi=150)
    plt.close(figure)
