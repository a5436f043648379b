# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Bags into arrays, side by side with rosbags and mcap-ros2-support (pip install mcap-ros2-support) in one run.

python benchmarks/bag_to_arrays.py most      # a million messages, nearly all of the bag wanted, against both peers
python benchmarks/bag_to_arrays.py memory    # peak memory of a process of its own, by size of the bag
python benchmarks/bag_to_arrays.py samples   # the whole way to samples (t, x, u), against message by message
python benchmarks/bag_to_arrays.py all --quick    # everything, a tenth of the size

Recordings are written into --folder, or into one that is thrown away. Peers decode a tenth of the messages (all with
--whole); what opening the bag takes counts once, and each message as much as those did. What they give is held
against ours, to the last bit.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from measure import best, peak_memory, table
from recorded import COMPRESSIONS, FRAMES, JAZZY, ROBOT, payloads, write

from uncertain_lti.recordings.bag import Bag
from uncertain_lti.recordings.mcap_scan import crc32
from uncertain_lti.sampling.reading import read_stream, read_transients, sample
from uncertain_lti.signals.field_path import FieldPath
from uncertain_lti.signals.signal_map import Signal, SignalMap

PATHS = {
    "/joint_states": [f"{part}[{i}]" for part in ("position", "velocity") for i in range(12)],
    "/odom": ["pose.pose.position.x", "pose.pose.position.y", "twist.twist.linear.x", "twist.twist.angular.z"],
    "/imu": [f"{part}.{axis}" for part in ("angular_velocity", "linear_acceleration") for axis in "xyz"],
    "/commands": [f"data[{i}]" for i in range(12)],
}
CHUNKS = {"32 KiB": 32 << 10, "768 KiB": 768 << 10}


def recording(folder, count, compression, chunk, frames):
    """Bag of `count` messages of four topics; written once per folder."""
    path = folder / f"robot_{count}_{compression}_{chunk.replace(' ', '')}_{frames}.mcap"
    if not path.exists():
        names = FRAMES if frames == "varies" else FRAMES[:1]
        streams = [payloads(topic, count // len(ROBOT), names, seed) for seed, topic in enumerate(ROBOT)]
        write(path, ROBOT, streams, compression, CHUNKS[chunk])
    return path


def ours(path, paths):
    """Open a bag, and read fields of these topics."""
    return Bag(path, indexed=True).columns(list(paths), [[FieldPath(p) for p in every] for every in paths.values()])


def rosbags(path, topics, most):
    """Messages decoded by rosbags: see `counted`."""
    from rosbags.rosbag2 import Reader

    began = time.perf_counter()
    decode = JAZZY.deserialize_cdr
    with Reader(path) as reader:
        wanted = [c for c in reader.connections if c.topic in topics]
        messages = ((c.topic, decode(data, c.msgtype)) for c, _, data in reader.messages(wanted))
        return counted(began, itertools.islice(messages, most))


def mcap_ros2(path, topics, most):
    """The same by mcap-ros2-support."""
    from mcap_ros2.reader import read_ros2_messages

    began = time.perf_counter()
    messages = ((e.channel.topic, e.ros_msg) for e in read_ros2_messages(str(path), topics=list(topics)))
    return counted(began, itertools.islice(messages, most))


def counted(began, messages):
    """Seconds until the first message, seconds for each further one, and the first messages."""
    first = [next(messages)]
    opened = time.perf_counter()
    first += itertools.islice(messages, 2000)
    number = len(first) - 1 + sum(1 for _ in messages)
    return opened - began, (time.perf_counter() - opened) / number, first


def same(columns, paths, found):
    """Hold the first messages of each topic against what a peer decoded, to the last bit."""
    for values, (topic, texts) in zip(columns.values, paths.items(), strict=True):
        fields = [FieldPath(text) for text in texts]
        theirs = np.array([[f.read(message) for f in fields] for name, message in found if name == topic])
        assert len(theirs) and values[: len(theirs)].tobytes() == theirs.tobytes(), f"{topic}: not the same numbers"


def against_peers(path, paths, count, peers, share):
    """Ours, s, the columns, and per peer its time for all `count` messages, s."""
    mine, columns = best(lambda: ours(path, paths), 5)
    assert len(columns.topic) == count and columns.alone < 100, (len(columns.topic), columns.alone)
    theirs = []
    for peer in peers:
        runs = [peer(path, paths, max(count // share, min(count, 3000))) for _ in range(2)]
        same(columns, paths, runs[0][2])
        theirs.append(min(opening for opening, _, _ in runs) + min(each for _, each, _ in runs) * (count - 1))
    return mine, columns, theirs


def most(folder, scale, share):
    """Nearly all messages of the bag are wanted."""
    count = int(1e6 * scale)
    rows = []
    for compression, chunk, frames in itertools.product(COMPRESSIONS, CHUNKS, ("one", "varies")):
        path = recording(folder, count, compression, chunk, frames)
        size = path.stat().st_size
        mine, columns, (first, second) = against_peers(path, PATHS, count, (rosbags, mcap_ros2), share)
        rows.append(
            [compression, chunk, frames, f"{size / 1e6:.0f} MB", f"{mine:.2f} s"]
            + [f"{first / mine:.0f}", f"{second / mine:.0f}", str(columns.alone)]
        )
        keep_or_drop(folder, path)
    header = [
        "compression",
        "chunks",
        "frame_id",
        "file",
        "ours",
        "× faster than rosbags",
        "× than mcap-ros2-support",
        "decoded alone",
    ]
    table(f"{count} messages: JointState, Odometry, Imu, Float64MultiArray, of each all", header, rows)


def memory(folder, scale, share):
    """Peak memory above that of the imports and of the result, in a process of its own."""
    rows = []
    for count, compression, chunk in itertools.product(
        (int(2.5e5 * scale), int(1e6 * scale)), ("zstd", "none"), CHUNKS
    ):
        path = recording(folder, count, compression, chunk, "varies")
        command = [sys.executable, __file__, "peak", str(path)]
        before, after, result = map(
            int, subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
        )
        more = after - before - result
        rows.append(
            [str(count), compression, chunk, *(f"{size / 2**20:.0f} MiB" for size in (result, after - before, more))]
        )
        keep_or_drop(folder, path)
    table("Memory", ["messages", "compression", "chunks", "result", "peak", "peak less result"], rows)


def peak(path):
    """In a process of its own: peak memory before reading and after, and size of the result, bytes."""
    before = peak_memory()
    columns = ours(Path(path), PATHS)
    result = sum(a.nbytes for a in (columns.topic, columns.arrival, columns.stamp, *columns.values))
    print(before, peak_memory(), result)


def robot():
    """Joints are the states, commands and what the Imu measures the controls."""
    states = tuple(Signal(f"q{i}", "/joint_states", f"position[{i}]") for i in range(12))
    commands = tuple(Signal(f"c{i}", "/commands", f"data[{i}]") for i in range(12))
    return SignalMap(states, (*commands, Signal("yaw_rate", "/imu", "angular_velocity.z")))


def samples(folder, scale, share):
    """The whole way to samples, and its halves."""
    count = int(1e6 * scale)
    rows = []
    path = recording(folder, count, "zstd", "768 KiB", "one")
    both, (transient,) = best(lambda: read_transients(path, robot()))
    signals = transient.signals
    reading, stream = best(lambda: read_stream(Bag(path, indexed=True), signals))
    sampling, _ = best(lambda: sample(stream, signals))
    rows.append([f"{both:.2f} s", f"{reading:.2f} s", f"{sampling:.2f} s"])
    header = ["read_transients", "reading", "sampling"]
    table(f"{len(stream.topic)} messages of three topics into {len(transient)} samples", header, rows)
    keep_or_drop(folder, path)


KEEP = False


def keep_or_drop(folder, path):
    """Large recordings are not left lying around."""
    if not KEEP:
        path.unlink(missing_ok=True)


def main():
    """One command per claim."""
    if sys.argv[1:2] == ["peak"]:
        return peak(sys.argv[2])
    commands = {f.__name__: f for f in (most, memory, samples)}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("claims", nargs="+", choices=[*commands, "all"])
    parser.add_argument("--quick", action="store_true", help="a tenth of the size")
    parser.add_argument("--whole", action="store_true", help="peers decode every message")
    parser.add_argument("--folder", type=Path, help="keep the recordings here, and use those that are there")
    options = parser.parse_args()
    global KEEP
    KEEP = options.folder is not None
    machine = platform.processor() or platform.machine()
    print(f"{machine}, {os.cpu_count()} cores, Python {platform.python_version()}, numpy {np.__version__}")
    print(f"checksums by {crc32.__module__}; load {os.getloadavg()[0]:.1f}")
    with contextlib.ExitStack() as stack:
        folder = options.folder or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        folder.mkdir(parents=True, exist_ok=True)
        for name in commands if "all" in options.claims else options.claims:
            commands[name](folder, 0.1 if options.quick else 1.0, 1 if options.whole else 10)
    return None


if __name__ == "__main__":
    main()
