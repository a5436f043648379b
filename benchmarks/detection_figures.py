# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Figures of detection: share detected against false alarms, and delays, of the best detector of each family."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from detection_procedure import OURS, SEVERAL, Outcome
from detection_tables import Report


@dataclass(frozen=True)
class Drawn:
    """A family of detectors in the figures: of those whose names begin so, the one that detects most."""

    label: str
    begins: tuple[str, ...]
    colour: str
    contains: str = ""


FAMILIES = (
    Drawn("3 sigma, least squares", ("least squares, 3 sigma",), "#9a9a9a"),
    Drawn("CUSUM, least squares", ("least squares, CUSUM",), "#8c6d31"),
    Drawn("MEWMA, least squares", ("least squares, MEWMA",), "#e6550d"),
    Drawn("Kalman filter, best statistic", ("Kalman",), "#d62728"),
    Drawn("PCA-SPE", ("PCA-SPE",), "#31a354"),
    Drawn("split conformal (MAPIE)", ("split conformal",), "#b07aa1"),
    Drawn("auto-encoder (scikit-learn)", ("auto-encoder",), "#756bb1"),
    Drawn("isolation forest (scikit-learn)", ("isolation forest",), "#c994c7"),
    Drawn("recorded ranges (SENTIL)", ("SENTIL",), "#17becf"),
)
MINE = (
    Drawn("ours, containment, one step", (OURS + ",",), "#6baed6", "containment"),
    Drawn("ours, best single rule", (OURS + ",",), "#08519c"),
    Drawn("ours, three rules armed together", (OURS + ",",), "#000000", "armed together"),
    Drawn("ours, as its own procedure chose", (OURS + ",",), "#e7298a", "as tuned"),
)


def early_share(o: Outcome, limit: float) -> float:
    """Detected within the time of the case, every fault counting alike."""
    return float(np.mean([(peaks > limit).mean() for peaks in o.early.values()]))


def chosen(outcomes: Mapping[str, Outcome], family: Drawn) -> str | None:
    """Of a family, the detector that detects most in time at its threshold; plain containment is that of one step."""
    names = [n for n in outcomes if n.startswith(family.begins) and family.contains in n]
    if family.contains == "containment":
        names = [n for n in names if n.endswith("containment")]
    if not family.contains:
        names = [n for n in names if not n.endswith(SEVERAL)]
    return max(names, key=lambda n: early_share(outcomes[n], outcomes[n].threshold), default=None)


def draw(reports: Sequence[Report], folder: Path) -> None:
    """ROC of every case, the best of each family; delays of the turbofan for the first page."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    groups: dict[str, list[Report]] = {}
    for report in reports:
        groups.setdefault(report.name.split(",")[0], []).append(report)
    for group, shown in groups.items():
        figure, axes = plt.subplots(1, len(shown), figsize=(5.6 * len(shown) + 2.9, 4.6), sharey=True, squeeze=False)
        for ax, report in zip(axes[0], shown, strict=True):
            for family in (*FAMILIES, *MINE):
                name = chosen(report.outcomes, family)
                if name is None:
                    continue
                o = report.outcomes[name]
                limits = np.sort(o.largest)[::-1]
                ours = family in MINE
                ax.step(
                    np.arange(len(limits)) / o.exposure, [early_share(o, limit) for limit in limits], where="post",
                    color=family.colour, label=family.label, linewidth=2.2 if ours else 1.4,
                    linestyle="-" if ours else "--",
                )  # fmt: skip
            ax.set_xscale("symlog", linthresh=report.linear)
            ax.set_xlim(0.0, report.most)
            ax.set_ylim(0.0, 1.02)
            ax.set_xlabel(f"alarmed healthy recordings {report.unit}")
            ax.set_title(report.name)
            ax.grid(alpha=0.3)
            if len(shown) == 1 or report is shown[-1]:
                ax.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.01, 1.0))
        axes[0][0].set_ylabel(shown[0].detected)
        figure.tight_layout()
        figure.savefig(folder / f"detection_roc_{group.lower().split()[-1]}.png", dpi=110)
        plt.close(figure)
    for report in reports[:1] if reports[0].name.startswith("Turbofan") else ():
        draw_delays(report, folder / "detection_delays.png")


SHOWN = (
    "fan damage × 0.5", "compressor wear × 0.5", "compressor wear × 1", "compressor wear × 2",
    "sensor drift × 0.5", "sensor drift × 1", "sensor drift × 2", "nozzle stuck", "fuel stuck",
)  # fmt: skip
"""Faults in the figure of the first page."""


def draw_delays(report: Report, path: Path) -> None:
    """Median delay of three rules armed together beside the best detector of each family."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    missed, outcomes = 40.0, report.outcomes
    figure, ax = plt.subplots(figsize=(12, 5.6))
    families = [(f, chosen(outcomes, f)) for f in (*FAMILIES, MINE[2])]
    for rank in range(1, len(SHOWN), 2):
        ax.axhspan(rank - 0.5, rank + 0.5, color="#f3f3f3", zorder=0)
    for i, (family, name) in enumerate((f, n) for f, n in families if n is not None):
        mine = family in MINE
        delays = [float(np.median(outcomes[name].delays[label])) for label in SHOWN]
        at = np.minimum(delays, missed)
        height = np.arange(len(SHOWN)) + (0.0 if mine else 0.066 * (i - 4))
        style: dict[str, Any] = (
            {"marker": "D", "s": 110, "zorder": 4} if mine else {"marker": "o", "s": 42, "zorder": 3}
        )
        ax.scatter(at, height, color="#08519c" if mine else family.colour, label=family.label, **style)
    ax.set_xscale("log")
    ticks = [0.025, 0.1, 0.5, 1, 2, 5, 10, 20, missed]
    ax.set_xticks(ticks, [*(f"{tick:g}" for tick in ticks[:-1]), "not\nseen"])
    ax.minorticks_off()
    ax.axvline(28, color="#999999", linewidth=0.8)
    ax.set_yticks(range(len(SHOWN)), SHOWN)
    ax.set_ylim(len(SHOWN) - 0.5, -0.5)
    ax.set_xlabel("median time from the fault to the alarm, s; thresholds at one false alarm per hour")
    ax.set_title(
        f"{report.name.replace('Turbofan', 'Simulated turbofan')}: faults on manoeuvres that were not recorded"
    )
    ax.grid(axis="x", alpha=0.3)
    ax.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=100)
    plt.close(figure)
