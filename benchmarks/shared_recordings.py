# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Real recordings that lie beside this repository: their folder, and the signals that each machine is read with."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from uncertain_lti import Transient, read_transients
from uncertain_lti.base.errors import UncertainLTIError
from uncertain_lti.validation.left_out import cut

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared" / "data"
"""Folder of the recordings, unless a command names another."""

CRAZYPAD = """\
clock: /crazyflie/imu
additive: both
states:
  - {name: roll_rate, topic: /crazyflie/imu, field: angular_velocity.x, unit: rad/s}
  - {name: pitch_rate, topic: /crazyflie/imu, field: angular_velocity.y, unit: rad/s}
  - {name: yaw_rate, topic: /crazyflie/imu, field: angular_velocity.z, unit: rad/s}
controls:
  - {name: thrust, topic: /crazyflie/command, field: wrench.force.z, steady: auto, scale: 10000}
  - {name: roll, topic: /crazyflie/command, field: wrench.torque.x, scale: 10000}
  - {name: pitch, topic: /crazyflie/command, field: wrench.torque.y, scale: 10000}
  - {name: yaw, topic: /crazyflie/command, field: wrench.torque.z, scale: 10000}
"""


def shared(data: Path = DATA) -> Path:
    """The folder of the recordings, or the reason why it cannot be."""
    if not data.is_dir():
        raise UncertainLTIError(f"{data}: the real recordings are not there; name their folder with --data")
    return data


def signals_of(machine: str) -> str:
    """The signals file of a machine, as text."""
    return CRAZYPAD if machine == "crazypad" else (ROOT / "config" / "signals" / f"{machine}.yaml").read_text()


def read_shared(machine: str, *files: str, data: Path = DATA, text: str = "") -> list[Transient]:
    """Recordings, relative to the folder or to this repository (bags/), by the machine's signals file or that text."""
    folder = shared(data)
    with tempfile.TemporaryDirectory() as name:
        signals = Path(name) / f"{machine}.yaml"
        signals.write_text(text or signals_of(machine))
        return read_transients([ROOT / f if f.startswith("bags/") else folder / f for f in files], signals)


def crazypad_labels(data: Path = DATA) -> dict[str, Any]:
    """By flight: whether it is damaged, and when it is in the air."""
    labels = json.loads((shared(data) / "crazypad" / "labels.json").read_text())
    return {f"crazypad/{file}": label for file, label in labels.items()}


def airborne(files: Sequence[str], data: Path = DATA) -> dict[str, list[Transient]]:
    """The pieces of each of these flights of CrazyPAD while it is in the air."""
    labels = crazypad_labels(data)
    found = {}
    for file, flight in zip(files, read_shared("crazypad", *files, data=data), strict=True):
        inside = [np.flatnonzero((flight.t >= low) & (flight.t <= high)) for low, high in labels[file]["airborne_s"]]
        found[file] = [cut(flight, int(k[0]), int(k[-1]) + 1) for k in inside]
    return found
