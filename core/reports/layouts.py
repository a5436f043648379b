# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Layouts of Foxglove, Lichtblick and PlotJuggler, to watch live what the monitor publishes or an annotated recording.

Foxglove and Lichtblick (JSON) take a number of a JointState by its index, PlotJuggler (XML) names its curves after the
joints; so a layout is made for a model. Both are made from one table of plots.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

from jinja2 import Environment

from uncertain_lti.base.errors import ModelError
from uncertain_lti.base.files import target
from uncertain_lti.base.text import named
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.outputs import NODE, OUTPUTS, Output
from uncertain_lti.reports.pages import asset, visible, write_page
from uncertain_lti.signals.signal_map import Signal

BOUND, RECORDED, VIOLATED, CONTAINED, UNKNOWN = "#56B4E9", "#E69F00", "#D55E00", "#009E73", "#999999"
"""Distinguished by colour-blind people, on light and on dark ground (Okabe and Ito 2008)."""
_CYCLE = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
_PAGE = 6  # states that one page shows
(_ALARM,) = (output for output in OUTPUTS if output.view == "alarm")


class _Plot(NamedTuple):
    """One plot: each curve is an output, the index of a state, a label and a colour; `limits` lie across."""

    key: str
    title: str
    curves: list[tuple[Output, int, str, str]]
    limits: tuple[tuple[str, float], ...] = ()
    steps: bool = False


def _pages(states: Sequence[Signal]) -> list[tuple[str, list[_Plot], list[_Plot]]]:
    """Of each page its states, a plot of each one's bounds and sample, and plots of their verdicts together."""
    pages = []
    for page, begin in enumerate(range(0, len(states), _PAGE)):
        shown = list(enumerate(states))[begin : begin + _PAGE]
        bounds = []
        for i, state in shown:
            of = [o for o in OUTPUTS if o.view in ("bound", "sample")]
            curves = [(o, i, o.name, BOUND if o.view == "bound" else RECORDED) for o in of]
            bounds.append(_Plot(f"bounds{i}", named(state.name, state.unit), curves))
        verdicts = []
        for o in sorted((o for o in OUTPUTS if o.view in ("states", "steps")), key=lambda o: o.view):
            curves = [(o, i, state.name, _CYCLE[i % _PAGE]) for i, state in shown]
            verdicts.append(_Plot(f"{o.name}{page}", o.title, curves, o.limits, o.view == "steps"))
        pages.append((f"{begin + 1} to {begin + len(shown)}", bounds, verdicts))
    return pages


def foxglove_layout(states: Sequence[Signal], base: str = NODE) -> str:
    """Layout of Foxglove and Lichtblick: bounds and samples of each state, utilisation, flags and alarm."""
    panels: dict[str, Any] = {}

    def panel(kind: str, name: str, title: str, config: dict[str, Any]) -> str:
        key = f"{kind}!{name}"
        panels[key] = {"foxglovePanelTitle": title, "lichtblickPanelTitle": title, **config}
        return key

    def drawn(plot: _Plot) -> str:
        named = [(f"{base}/{o.name}.position[{i}]", label, colour) for o, i, label, colour in plot.curves]
        if plot.steps:
            paths = [_change(value, label) for value, label, _ in named]
            return panel("StateTransitions", plot.key, plot.title, {"isSynced": True, "paths": paths})
        named += [(f"{value:g}", label, VIOLATED) for label, value in plot.limits]
        lines = [{**_change(*line), "enabled": True, "lineSize": 1.5, "color": colour} for *line, colour in named]
        shown = {"showLegend": True, "legendDisplay": "floating", "showPlotValuesInLegend": True}
        axes = {"showXAxisLabels": True, "showYAxisLabels": True, "isSynced": True, "xAxisVal": "timestamp"}
        return panel("Plot", plot.key, plot.title, {"paths": lines, **shown, **axes, "sidebarDimension": 240})

    tabs = []
    for title, *both in _pages(states):
        bounds, verdicts = (_stack([drawn(plot) for plot in plots]) for plots in both)
        tabs.append({"title": title, "layout": _split("row", bounds, verdicts, 60)})
    body: Any = tabs[0]["layout"]
    if len(tabs) > 1:
        body = panel("Tab", "states", "states", {"activeTabIdx": 0, "tabs": tabs})
    value = f"{base}/{_ALARM.name}.data"
    looks = [("true", VIOLATED, "ALARM"), ("false", CONTAINED, "no alarm")]
    rules = [{"operator": "=", "rawValue": raw, "color": colour, "label": label} for raw, colour, label in looks]
    unknown = {"fallbackColor": UNKNOWN, "fallbackLabel": "no verdict yet"}
    alarm = panel("Indicator", "alarm", "alarm", {"path": value, "style": "background", **unknown, "rules": rules})
    paths = {"isSynced": True, "paths": [_change(value, "alarm")]}
    raised = panel("StateTransitions", "alarm", "alarm", paths)
    plain = {"globalVariables": {}, "userNodes": {}, "playbackConfig": {"speed": 1}}
    whole = {"configById": panels, **plain, "layout": _split("column", _split("row", alarm, raised, 25), body, 15)}
    return json.dumps(whole, indent=1, ensure_ascii=False) + "\n"


def plotjuggler_layout(states: Sequence[Signal], base: str = NODE) -> str:
    """Layout of PlotJuggler: bounds and samples of each state, utilisation, flags and alarm, in tabs."""
    tabs: list[tuple[str, list[tuple[str, list[tuple[str, str]]]]]] = []
    for title, *both in _pages(states):
        numbers = f" {title}" if len(states) > _PAGE else ""
        for name, plots in zip(("bounds", "verdicts"), both, strict=True):
            drawn = [
                (p.title, [(f"{base}/{o.name}/{states[i].name}/position", colour) for o, i, _, colour in p.curves])
                for p in plots
            ]
            tabs.append((f"{name}{numbers}", drawn))
        tabs[-1][1].append(("alarm", [(f"{base}/{_ALARM.name}/data", VIOLATED)]))
    made = Environment(trim_blocks=True, keep_trailing_newline=True)
    made.filters["attribute"] = lambda text: quoteattr(visible(text))
    return made.from_string(asset("plotjuggler.xml")).render(tabs=tabs)


def write_layouts(
    model: UncertainLTI, foxglove: str | None, plotjuggler: str | None, base: str | None = None
) -> list[str]:
    """Write one or both of the layouts, each whole or not at all."""
    if foxglove is None and plotjuggler is None:
        raise ModelError("no layout is asked for; give --foxglove FILE.json, --plotjuggler FILE.xml or both")
    base = NODE if base is None else f"/{base.strip('/')}"
    made = [(foxglove, b'"configById"', foxglove_layout), (plotjuggler, b"<root", plotjuggler_layout)]
    asked = [(path, holds, make) for path, holds, make in made if path is not None]
    for path, holds, _ in asked:
        target(path, holds=holds, kind="such layout", example="layout.json")
    for path, _, make in asked:
        write_page(path, make(model.signals.states, base))
    return [path for path, *_ in asked]


def _change(value: str, label: str) -> dict[str, Any]:
    return {"value": value, "label": label, "timestampMethod": "receiveTime"}


def _split(direction: str, first: Any, second: Any, percentage: float) -> dict[str, Any]:
    return {"direction": direction, "first": first, "second": second, "splitPercentage": percentage}


def _stack(panels: Sequence[Any]) -> Any:
    """Panels one below the other, equally high."""
    if len(panels) == 1:
        return panels[0]
    return _split("column", panels[0], _stack(panels[1:]), round(100 / len(panels), 3))
