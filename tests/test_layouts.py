# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Layouts: every topic and message path they name is in an annotated recording, and their structure is whole."""

import json
import re
from xml.etree import ElementTree

import pytest
from conftest import ROOT
from rosbags.highlevel import AnyReader

from uncertain_lti import read_transients
from uncertain_lti.cli.main import main
from uncertain_lti.identification import fit
from uncertain_lti.monitor.outputs import OUTPUTS
from uncertain_lti.reports.layouts import foxglove_layout, plotjuggler_layout
from uncertain_lti.signals.signal_map import Signal

LAYOUTS = ROOT / "config" / "layouts"
EXAMPLES = {"engine": ("leibov_fit", "leibov_check"), "turbofan": ("turbofan_levels_noise", "turbofan_fan_damage")}


@pytest.fixture(scope="module", params=EXAMPLES)
def annotated(request, tmp_path_factory):
    """Name of an example, and {topic: (type, a judged message)} of its annotated check recording."""
    folder = tmp_path_factory.mktemp("layouts")
    fitted, checked = EXAMPLES[request.param]
    runs = read_transients(ROOT / "bags" / f"{fitted}.mcap", ROOT / "config" / "signals" / f"{request.param}.yaml")
    fit(runs, additive="noise").save(folder / "m.model.json")
    out = folder / "out.mcap"
    words = [folder / "m.model.json", ROOT / "bags" / f"{checked}.mcap", "--write", out]
    assert main(["check", *map(str, words)]) == 1
    last = {}
    with AnyReader([out]) as reader:
        for connection, _, data in reader.messages():
            last[connection.topic] = (connection.msgtype, reader.deserialize(data, connection.msgtype))
    return request.param, folder / "m.model.json", last


def leaves(node):
    if isinstance(node, str):
        return [node]
    assert node.keys() == {"direction", "first", "second", "splitPercentage"} and node["direction"] in ("row", "column")
    return leaves(node["first"]) + leaves(node["second"])


def panels_of(layout):
    """Ids of all panels that are shown, those in tabs included."""
    found = leaves(layout["layout"])
    for key in list(found):
        for tab in layout["configById"][key].get("tabs", []):
            found += leaves(tab["layout"])
    return found


def paths_of(layout):
    for config in layout["configById"].values():
        yield from (path["value"] for path in config.get("paths", []))
        if "path" in config:
            yield config["path"]


def value_at(last, path):
    """What a viewer finds under `/topic.field[index]`."""
    topic, field, index = re.fullmatch(r"(/[\w/]+)\.(\w+)(?:\[(\d+)\])?", path).groups()
    value = getattr(last[topic][1], field)
    return value if index is None else value[int(index)]


def test_foxglove_names_what_is_there(annotated):
    name, _, last = annotated
    layout = json.loads((LAYOUTS / f"{name}.foxglove.json").read_text())
    named = [path for path in paths_of(layout) if not re.fullmatch(r"-?\d+", path)]
    for path in named:
        assert isinstance(float(value_at(last, path)), float)
    topics = {path.partition(".")[0] for path in named}
    assert topics == {t for t in last if t.startswith("/envelope_monitor/")} - {"/envelope_monitor/reason"}  # words
    for config in layout["configById"].values():  # an index and the name beside it belong together
        for path in config.get("paths", []):
            if path["label"] in last["/envelope_monitor/state"][1].name:
                index = int(re.search(r"\[(\d+)\]", path["value"])[1])
                assert last["/envelope_monitor/state"][1].name[index] == path["label"]


def test_plotjuggler_names_what_is_there(annotated):
    """Curves are `<topic>/<joint>/position`, and `<topic>/<field>` of other types."""
    name, _, last = annotated
    root = ElementTree.parse(LAYOUTS / f"{name}.plotjuggler.xml").getroot()
    there = set()
    for topic, (kind, message) in last.items():
        if topic.startswith("/envelope_monitor/"):
            if kind == "sensor_msgs/msg/JointState":
                there |= {f"{topic}/{joint}/position" for joint in message.name}
            elif kind != "std_msgs/msg/String":  # words are not drawn
                there.add(f"{topic}/data")
    assert {curve.get("name") for curve in root.iter("curve")} == there
    for splitter in root.iter("DockSplitter"):
        assert int(splitter.get("count")) == len(splitter) == len(splitter.get("sizes").split(";"))


def test_shipped_layouts_are_what_the_command_writes(annotated, tmp_path, cli):
    name, model, _ = annotated
    files = [tmp_path / "l.json", tmp_path / "l.xml"]
    said = cli("layout", model, "--foxglove", files[0], "--plotjuggler", files[1]).out
    assert all(str(file) in said and file.exists() for file in files)
    assert files[0].read_text() == (LAYOUTS / f"{name}.foxglove.json").read_text()
    assert files[1].read_text() == (LAYOUTS / f"{name}.plotjuggler.xml").read_text()
    assert main(["layout", str(model), "--foxglove", str(files[0]), "--topics", "robot/monitor/"]) == 0
    assert '"/robot/monitor/lower.position[0]"' in files[0].read_text()


@pytest.mark.parametrize("count", [1, 6, 7, 50])
def test_structure_is_whole(count):
    """Every panel that is shown is configured once, every configured one is shown, and no state is missing."""
    states = [Signal(name=f"x<&\"'{i}", topic="/s", field=f"data[{i}]", unit="°C") for i in range(count)]
    layout = json.loads(foxglove_layout(states))
    shown = panels_of(layout)
    assert sorted(shown) == sorted(layout["configById"]) and len(shown) == len(set(shown))
    assert layout.keys() == {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}
    named = list(paths_of(layout))
    drawn = [output.name for output in OUTPUTS if output.position and output.view]
    assert len(drawn) >= 5
    for topic in drawn:
        expected = [f"/envelope_monitor/{topic}.position[{i}]" for i in range(count)]
        assert [p for p in named if p.startswith(f"/envelope_monitor/{topic}.")] == expected
    curves = [c.get("name") for c in ElementTree.fromstring(plotjuggler_layout(states).encode()).iter("curve")]
    assert len(set(curves)) == len(drawn) * count + 1
    assert f"/envelope_monitor/lower/{states[-1].name}/position" in curves


def test_odd_names_stay_well_formed():
    states = [Signal(name="a\x07]]>é", topic="/s", field="data")]
    ElementTree.fromstring(plotjuggler_layout(states).encode())
    json.loads(foxglove_layout(states))
