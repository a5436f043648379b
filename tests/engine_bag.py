# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Recordings of the published engine, written without ROS."""

from bag_writer import Message, Topic, joint_state, write

from uncertain_lti.plants.leibov import CONTROL_TOPIC, STATE_TOPIC, transient

SIGNALS = """
states:
  - {name: fan, topic: /engine/state, field: "position[fan_speed]"}
  - {name: core, topic: /engine/state, field: "position[compressor_speed]"}
controls:
  - {name: fuel, topic: /engine/control, field: "position[main_fuel_flow]"}
  - {name: area, topic: /engine/control, field: "position[nozzle_throat_area]"}
"""


def engine_bag(path, steps=300, seed=1, change=lambda k, x: x, more=(), **run):
    """A run of the published engine as a bag, state before control at every instant, and topics with no message."""
    plant = transient(steps, seed, start_ns=10**18, **run)
    messages = []
    for k, t in enumerate(plant.t_ns.tolist()):
        x = change(k, plant.x[k])
        messages.append(Message(STATE_TOPIC, t, joint_state(t, x, plant.state_names), t))
        messages.append(Message(CONTROL_TOPIC, t, joint_state(t, plant.u[k], plant.control_names), t))
    topics = [Topic(STATE_TOPIC, "sensor_msgs/msg/JointState"), Topic(CONTROL_TOPIC, "sensor_msgs/msg/JointState")]
    return write([*topics, *more], messages).save(path)
