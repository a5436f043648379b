"""Make the two recordings anew: the plant node in one process, `uncertain-lti record` in another.

Run it as `./run python bags/make.py`, or with both programs on the path. It takes four minutes: the plant runs in real
time, so that log time and header stamps go at the same pace.
"""

import signal
import subprocess
import sys
from pathlib import Path

from uncertain_lti.plants.leibov import CONTROL_TOPIC, DT_NS, STATE_TOPIC

BAGS = {
    "leibov_fit": {"steps": 6000, "seed": 1, "fault_at": -1},
    "leibov_check": {"steps": 2400, "seed": 2, "fault_at": 1200},
}


def make(name: str, folder: Path) -> None:
    """Record one run of the plant, with what it was made from as a metadata record."""
    parameters = BAGS[name]
    notes = {"plant": "leibov2006", "dt": f"{DT_NS * 1e-9:g} s"} | {k: str(v) for k, v in parameters.items()}
    if parameters["fault_at"] >= 0:
        notes["leaves its intervals"] = f"{parameters['fault_at'] * DT_NS * 1e-9:g} s after the first state"
    record = ["uncertain-lti", "record", STATE_TOPIC, CONTROL_TOPIC, "--output", str(folder / f"{name}.mcap")]
    for key, value in notes.items():
        record += ["--note", f"{key}={value}"]
    plant = ["plant", "--ros-args"]
    for key, value in parameters.items():
        plant += ["-p", f"{key}:={value}"]
    recorder = subprocess.Popen(record)
    try:
        subprocess.run(plant, check=True)
    finally:
        recorder.send_signal(signal.SIGINT)
        if recorder.wait(30):
            sys.exit("the recorder failed, as said above")


if __name__ == "__main__":
    for bag in BAGS:
        make(bag, Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
