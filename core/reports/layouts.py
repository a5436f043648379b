# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Layouts of viewers for the topics of a monitor, live or in an annotated recording.

Foxglove and Lichtblick (JSON) take a number of a JointState by its index, PlotJuggler (XML) names its curves after the
joints; so a layout is made for a model.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib.resources import files
from typing import Any
from xml.sax.saxutils import quoteattr

from jinja2 import Environment

from uncertain_lti.base.errors import ModelError
from uncertain_lti.base.files import may_replace, whole_file
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.outputs import NODE, OUTPUTS, Output
from uncertain_lti.signals.signal_map import Signal

BOUND, RECORDED, VIOLATED, CONTAINED, UNKNOWN = "#56B4E9", "#E69F00", "#D55E00", "#009E73", "#999999"
"""Distinguished by colour-blind people, on light and on dark ground (Okabe and Ito 2008)."""
_PAGE = 6  # states that one page shows
_BOUNDS = tuple(output for output in OUTPUTS if output.view in ("bound", "sample"))
_STATES = tuple(output for output in OUTPUTS if output.view == "states")
_STEPS = tuple(output for output in OUTPUTS if output.view == "steps")
_ALARMS = tuple(output for output in OUTPUTS if output.view == "alarm")


def _colour(output: Output) -> str:
    return BOUND if output.view == "bound" else RECORDED


def foxglove_layout(states: Sequence[Signal], base: str = NODE) -> dict[str, Any]:
    """Layout of Foxglove and Lichtblick: bounds and samples of each state, utilisation, flags, alarm, diagnostics."""
    panels: dict[str, Any] = {}

    def panel(kind: str, name: str, title: str, config: dict[str, Any]) -> str:
        key = f"{kind}!{name}"
        panels[key] = {"foxglovePanelTitle": title, "lichtblickPanelTitle": title, **config}
        return key

    def plot(name: str, title: str, paths: list[dict[str, Any]]) -> str:
        shown = {"showLegend": True, "legendDisplay": "floating", "showPlotValuesInLegend": True}
        axes = {"showXAxisLabels": True, "showYAxisLabels": True, "isSynced": True, "xAxisVal": "timestamp"}
        return panel("Plot", name, title, {"paths": paths, **shown, **axes, "sidebarDimension": 240})

    pages = []
    for page, begin in enumerate(range(0, len(states), _PAGE)):
        rows = []
        shown = list(enumerate(states))[begin : begin + _PAGE]
        for i, state in shown:
            title = f"{state.name} [{state.unit}]" if state.unit else state.name
            paths = [_line(f"{base}/{o.name}.position[{i}]", o.name, _colour(o), 1.5) for o in _BOUNDS]
            rows.append(plot(f"bounds{i}", title, paths))
        together = []
        for output in _STATES:
            paths = [_line(f"{base}/{output.name}.position[{i}]", state.name) for i, state in shown]
            limits = [_line(f"{value:g}", label, VIOLATED, 1.0) for label, value in output.limits]
            together.append(plot(f"{output.name}{page}", output.title, paths + limits))
        for output in _STEPS:
            paths = [_change(f"{base}/{output.name}.position[{i}]", state.name) for i, state in shown]
            steps = {"isSynced": True, "paths": paths}
            together.append(panel("StateTransitions", f"{output.name}{page}", output.title, steps))
        pages.append(_split("row", _stack(rows), _stack(together), 60))
    if len(pages) == 1:
        body: Any = pages[0]
    else:
        titles = [f"{i * _PAGE + 1} to {min((i + 1) * _PAGE, len(states))}" for i in range(len(pages))]
        tabs = [{"title": title, "layout": page} for title, page in zip(titles, pages, strict=True)]
        body = panel("Tab", "states", "states", {"activeTabIdx": 0, "tabs": tabs})
    (violation,) = _ALARMS
    value = f"{base}/{violation.name}.data"
    alarm = panel(
        "Indicator",
        "alarm",
        "alarm",
        {
            "path": value,
            "style": "background",
            "fallbackColor": UNKNOWN,
            "fallbackLabel": "no verdict yet",
            "rules": [
                {"operator": "=", "rawValue": "true", "color": VIOLATED, "label": "ALARM"},
                {"operator": "=", "rawValue": "false", "color": CONTAINED, "label": "no alarm"},
            ],
        },
    )
    steps = {"isSynced": True, "paths": [_change(value, "alarm")]}
    raised = panel("StateTransitions", "alarm", "alarm", steps)
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split("column", _split("row", alarm, raised, 25), body, 15),
    }


def plotjuggler_layout(states: Sequence[Signal], base: str = NODE) -> str:
    """Layout of PlotJuggler: bounds and samples of each state, utilisation, flags and alarm, in tabs."""
    tabs: list[tuple[str, list[tuple[str, list[tuple[str, str]]]]]] = []
    for begin in range(0, len(states), _PAGE):
        page = states[begin : begin + _PAGE]
        plots = []
        for state in page:
            title = f"{state.name} [{state.unit}]" if state.unit else state.name
            plots.append((title, [(f"{base}/{o.name}/{state.name}/position", _colour(o)) for o in _BOUNDS]))
        some = len(states) > _PAGE
        numbers = f" {begin + 1} to {begin + len(page)}" if some else ""
        tabs.append((f"bounds{numbers}", plots))
        colours = _cycle(len(page))
        verdicts = [
            (o.title, [(f"{base}/{o.name}/{s.name}/position", c) for s, c in zip(page, colours, strict=True)])
            for o in (*_STATES, *_STEPS)
        ]
        verdicts += [("alarm", [(f"{base}/{o.name}/data", VIOLATED)]) for o in _ALARMS]
        tabs.append((f"verdicts{numbers}", verdicts))
    made = Environment(trim_blocks=True, keep_trailing_newline=True)
    made.filters["attribute"] = _attribute
    text = files("uncertain_lti.reports").joinpath("assets", "plotjuggler.xml").read_text(encoding="utf-8")
    return made.from_string(text).render(tabs=tabs)


def write_layouts(
    model: UncertainLTI, foxglove: str | None, plotjuggler: str | None, base: str | None = None
) -> list[str]:
    """Write one or both of the layouts, each whole or not at all."""
    wanted = [(foxglove, foxglove_text), (plotjuggler, plotjuggler_layout)]
    if foxglove is None and plotjuggler is None:
        raise ModelError("no layout is asked for; give --foxglove FILE.json, --plotjuggler FILE.xml or both")
    base = NODE if base is None else f"/{base.strip('/')}"
    written = []
    for path, words in ((foxglove, b'"configById"'), (plotjuggler, b"<root")):
        if path is not None and not may_replace(path, holds=words):
            raise ModelError(f"{path}: is there already and is no such layout; choose another name, or move it away")
    for path, make in wanted:
        if path is not None:
            try:
                with whole_file(path) as stream:
                    stream.write(make(model.signals.states, base).encode("utf-8", "replace"))
            except OSError as error:
                raise ModelError(f"{path}: cannot be written: {error.strerror}; choose another place") from None
            written.append(path)
    return written


def foxglove_text(states: Sequence[Signal], base: str = NODE) -> str:
    """`foxglove_layout` as text."""
    return json.dumps(foxglove_layout(states, base), indent=1, ensure_ascii=False) + "\n"


def _line(value: str, label: str, colour: str = "", size: float = 1.0) -> dict[str, Any]:
    line = {"value": value, "label": label, "enabled": True, "timestampMethod": "receiveTime", "lineSize": size}
    return line | ({"color": colour} if colour else {})


def _change(value: str, label: str) -> dict[str, Any]:
    return {"value": value, "label": label, "timestampMethod": "receiveTime"}


def _split(direction: str, first: Any, second: Any, percentage: float) -> dict[str, Any]:
    return {"direction": direction, "first": first, "second": second, "splitPercentage": percentage}


def _stack(panels: Sequence[Any]) -> Any:
    """Panels one below the other, equally high."""
    if len(panels) == 1:
        return panels[0]
    return _split("column", panels[0], _stack(panels[1:]), round(100 / len(panels), 3))


def _cycle(count: int) -> list[str]:
    colours = ["#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00"]
    return [colours[i % len(colours)] for i in range(count)]


def _attribute(text: str) -> str:
    """Text of a file as a value in XML, which has no control characters."""
    return quoteattr("".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text))
