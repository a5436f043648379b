# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Make the recordings anew: a plant node in one process, `uncertain-lti record` in another.

    ./run python bags/make.py [FOLDER [NAME...]]

All, or those named; beside this file, or in FOLDER, where none of them may be yet. The plants run in real time, so that
log time and header stamps go at the same pace: 15 minutes for all. Those of the turbofan carry a simulated clock and
come out with the same messages every time; log times differ.
"""

import signal
import subprocess
import sys
from pathlib import Path

from uncertain_lti.plants.leibov import CONTROL_TOPIC, DT_NS, STATE_TOPIC
from uncertain_lti.plants.turbofan_runs import KINDS, LARGE, NOISE, SMALL, make_run
from uncertain_lti.recordings.bag import Bag

LEIBOV = {
    "leibov_fit": {"steps": 6000, "seed": 1, "fault_at": -1},
    "leibov_check": {"steps": 2400, "seed": 2, "fault_at": 1200},
}
TURBOFAN = {
    "turbofan_pulses_up": {"manoeuvre": "pulses", "amplitude": SMALL},
    "turbofan_pulses_down": {"manoeuvre": "pulses", "amplitude": -SMALL},
    "turbofan_pulses_up_large": {"manoeuvre": "pulses", "amplitude": LARGE},
    "turbofan_pulses_down_large": {"manoeuvre": "pulses", "amplitude": -LARGE},
    "turbofan_check": {"manoeuvre": "check"},
    "turbofan_levels": {"manoeuvre": "levels"},
    "turbofan_pulses_up_large_noise": {"manoeuvre": "pulses", "amplitude": LARGE, "noise": NOISE, "seed": 1},
    "turbofan_pulses_down_large_noise": {"manoeuvre": "pulses", "amplitude": -LARGE, "noise": NOISE, "seed": 2},
    "turbofan_levels_noise": {"manoeuvre": "levels", "noise": NOISE, "seed": 3},
    "turbofan_pulses_up_again_noise": {"manoeuvre": "pulses", "amplitude": LARGE, "noise": NOISE, "seed": 4},
    "turbofan_pulses_down_again_noise": {"manoeuvre": "pulses", "amplitude": -LARGE, "noise": NOISE, "seed": 5},
    **{
        f"turbofan_{kind}": {
            "manoeuvre": "levels", "noise": NOISE, "seed": 10 + i, "fault": kind, "fault_at": 24.0, "samples": 1401,
        }
        for i, kind in enumerate(KINDS)
    },
}  # fmt: skip
"""Name of each recording of the nonlinear engine, and the arguments of `make_run` that it is made with."""
BAGS = {
    **{name: ("plant", "leibov2006", parameters) for name, parameters in LEIBOV.items()},
    **{name: ("turbofan", "turbofan", parameters) for name, parameters in TURBOFAN.items()},
}


def make(name: str, folder: Path) -> None:
    """Record one run of its plant, with what it was made from as a metadata record."""
    node, model, parameters = BAGS[name]
    notes = {"plant": model, "dt": f"{DT_NS * 1e-9:g} s"} | {k: str(v) for k, v in parameters.items()}
    if node == "plant" and parameters["fault_at"] >= 0:
        notes["leaves its intervals"] = f"{parameters['fault_at'] * DT_NS * 1e-9:g} s after the first state"
    if "fault" in parameters:
        notes["fault_at"] = f"{parameters['fault_at']:g} s after the first state"
        notes["what happens"] = KINDS[parameters["fault"]]
    record = ["uncertain-lti", "record", STATE_TOPIC, CONTROL_TOPIC, "--output", str(folder / f"{name}.mcap")]
    for key, value in notes.items():
        record += ["--note", f"{key}={value}"]
    plant = [node, "--ros-args"]
    for key, value in parameters.items():
        plant += ["-p", f"{key}:={value}"]
    recorder = subprocess.Popen(record)
    try:
        subprocess.run(plant, check=True)
    finally:
        recorder.send_signal(signal.SIGINT)
        if recorder.wait(30):
            sys.exit("the recorder failed, as said above")
    samples = parameters["steps"] if node == "plant" else make_run(**parameters).samples
    for topic, info in Bag(folder / f"{name}.mcap").topics.items():
        if info.count != samples:
            sys.exit(f"{name}: {info.count} messages on {topic}, not {samples}; does another plant publish here?")


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    for bag in sys.argv[2:] or BAGS:
        if bag not in BAGS:
            sys.exit(f"there is no recording '{bag}'; there are {', '.join(BAGS)}")
        make(bag, folder)
