# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The policy for SROS2 against the graph: it allows what the node has there, and nothing that it has not."""

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest
from conftest import ROOT

pytest.importorskip("rclpy", reason="rclpy is not installed")

from ros_processes import World, until
from ros_processes import world as world
from test_live import by_hand, saved

NODE = "envelope_monitor"


def allowed(kind: str, qualifier: str) -> set[str]:
    """Names of topics or services that the policy allows in this way, in full."""
    (profile,) = ElementTree.parse(ROOT / "config" / "sros2_policy.xml").iter("profile")
    assert (profile.get("ns"), profile.get("node")) == ("/", NODE)
    found: list[str] = []
    for group in profile.iter(f"{kind}s"):
        assert set(group.attrib) <= {"publish", "subscribe", "reply", "request"}
        assert {*group.attrib.values()} == {"ALLOW"}
        if qualifier in group.attrib:
            found += [str(entry.text).replace("~", f"/{NODE}") for entry in group.iter(kind)]
    assert len(set(found)) == len(found), "something is allowed twice"
    return set(found)


def test_the_policy_allows_what_the_node_does_and_nothing_else(world: World, tmp_path: Path) -> None:
    model = by_hand()
    topics = {"/plant/state": "/engine/state", "/plant/control": "/engine/control"}
    signals = replace(
        model.signals,
        states=tuple(replace(s, topic=topics[s.topic]) for s in model.signals.states),
        controls=tuple(replace(s, topic=topics[s.topic]) for s in model.signals.controls),
        clock=topics[str(model.signals.clock)],
        time={topics[t]: source for t, source in model.signals.time.items()},
    )
    world.monitor(saved(model.replace(signals=signals), tmp_path), use_sim_time=True)
    node = world.node

    def names(found: list[tuple[str, list[str]]]) -> set[str]:
        return {name for name, _ in found}

    until(lambda: NODE in node.get_node_names(), "the node in the graph")

    def subscribed() -> set[str]:
        return names(node.get_subscriber_names_and_types_by_node(NODE, "/"))

    until(lambda: subscribed() >= {"/engine/state", "/engine/control"}, "the subscriptions in the graph")
    until(lambda: allowed("service", "reply") <= names(node.get_service_names_and_types_by_node(NODE, "/")), "services")
    assert subscribed() == allowed("topic", "subscribe")
    assert names(node.get_publisher_names_and_types_by_node(NODE, "/")) == allowed("topic", "publish")
    assert names(node.get_service_names_and_types_by_node(NODE, "/")) == allowed("service", "reply")
    assert names(node.get_client_names_and_types_by_node(NODE, "/")) == allowed("service", "request") == set()
