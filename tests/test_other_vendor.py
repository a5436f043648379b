# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""A subscriber of another DDS vendor gets every flag with the right content: the wire seen from outside rclpy."""

import json
from itertools import groupby
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy is not installed")
pytest.importorskip("cyclonedds", reason="the cyclonedds wheel, which subscribes here, is not installed")

from perturbed import STATE
from ros_processes import STALE, World
from ros_processes import world as world
from sensor_msgs.msg import JointState
from test_live import by_hand, everything_armed, header_bag, offline, saved

from uncertain_lti.sampling.clock import Status

# Cyclone DDS on loopback, where multicast may be missing: the peer is named.
_CONFIGURATION = """<CycloneDDS><Domain><General>
<Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces><AllowMulticast>false</AllowMulticast>
</General><Discovery><Peers><Peer address="127.0.0.1"/></Peers><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>60</MaxAutoParticipantIndex></Discovery></Domain></CycloneDDS>"""

_SUBSCRIBER = """
import json, sys, time
from dataclasses import dataclass
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, sequence, uint32
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32

@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str

@dataclass
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]

@dataclass
class Bool(IdlStruct, typename="std_msgs::msg::dds_::Bool_"):
    data: bool

wanted, domain = int(sys.argv[1]), int(sys.argv[2])
participant = DomainParticipant(domain)
qos = Qos(Policy.Reliability.Reliable(duration(seconds=1)), Policy.History.KeepAll)
flags = DataReader(participant, Topic(participant, "rt/envelope_monitor/flags", JointState), qos=qos)
violation = DataReader(participant, Topic(participant, "rt/envelope_monitor/violation", Bool), qos=qos)
while not (flags.get_matched_publications() and violation.get_matched_publications()):
    time.sleep(0.05)
time.sleep(0.5)
print("matched", flush=True)
got, beats, end = [], [], time.monotonic() + 60
while len(got) < wanted and time.monotonic() < end:
    got += [[m.header.stamp.sec, m.header.stamp.nanosec, list(m.name), list(m.position), list(m.velocity)]
            for m in flags.take(1000)]
    beats += [m.data for m in violation.take(1000)]
    time.sleep(0.01)
time.sleep(0.3)
beats += [m.data for m in violation.take(1000)]
print(json.dumps([got, beats]), flush=True)
"""


_PUBLISHER = """
import sys, time
from dataclasses import dataclass
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic

@dataclass
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    frame_id: str

participant = DomainParticipant(int(sys.argv[1]))
named = Qos(Policy.Userdata(b"typehash=RIHS01_" + b"0a" * 32 + b";"))  # as nodes name the fields of their types
writer = DataWriter(participant, Topic(participant, "rt/plant/state", JointState), qos=named)
print("there", flush=True)
time.sleep(600)
"""


def test_a_publisher_of_another_version_of_the_type_is_told(world: World, tmp_path: Path) -> None:
    world.monitor(saved(by_hand(), tmp_path))
    world.env["CYCLONEDDS_URI"] = _CONFIGURATION
    diagnostics = world.diagnostics()
    ours = world.publisher(JointState, STATE)
    World.subscribed(ours)
    since = diagnostics.count
    world.start("publisher", "-c", _PUBLISHER, world.env["ROS_DOMAIN_ID"]).says("there")
    told = f"{STATE}: a publisher sends another version of sensor_msgs/msg/JointState, which may be misread"
    diagnostics.reaches(STALE, saying=told, since=since)
    before = [array.status[0].message for array in diagnostics.topic.messages[:since]]
    assert not any("another version" in said for said in before), "nor of the same"


def test_another_vendor_hears_every_flag(world: World, tmp_path: Path) -> None:
    path = saved(everything_armed(), tmp_path)
    bag = header_bag(by_hand(), tmp_path / "run.mcap", 300)
    verdicts = offline(path, bag)
    world.monitor(path)
    world.env["CYCLONEDDS_URI"] = _CONFIGURATION
    subscriber = world.start("subscriber", "-c", _SUBSCRIBER, str(len(verdicts)), world.env["ROS_DOMAIN_ID"])
    subscriber.says("matched")
    world.command("play", bag, "--rate", 2).succeed()
    said = subscriber.succeed().splitlines()[-1]
    got, beats = json.loads(said)
    assert len(got) == len(verdicts)
    for verdict, (seconds, nanoseconds, names, position, velocity) in zip(verdicts, got, strict=True):
        np.testing.assert_array_equal(position, verdict.flags)
        outside = float(verdict.outside_domain) if verdict.judged else np.nan
        np.testing.assert_array_equal(velocity, [outside] * 2)
        assert names == ["a", "b"]
        if verdict.status is not Status.UNSTAMPED:  # without a stamp, the time of receipt stands in
            assert seconds * 10**9 + nanoseconds == verdict.t_ns
    alarms = [v.alarm for v in verdicts if v.judged]
    assert len(beats) >= len(alarms) and True in alarms
    assert turns([False, *beats]) == turns([False, *alarms])  # a heartbeat may come between, and says the same


def turns(alarms: list[bool]) -> list[bool]:
    return [alarm for alarm, _ in groupby(alarms)]
